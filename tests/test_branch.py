"""The gap voltage under `mobile` after a jump of the source: the run stays on its branch and never skips a fold."""

from __future__ import annotations

import math

import numpy as np
import pytest

import analytic as ref
import fingerspice as fs
import stress
from fingerspice.engine.one_area.model import branch_area, gap_voltage, ramp
from fingerspice.solve.problem import prepare


def model_of(scene):
    how = {"area": "coupled", "start": "deck", "charge": False, "rtol": 1e-6}
    return prepare(scene.circuit, t_stop=1.0 / scene.frequency, t_eval=None, charge_law="mobile", **how).scene.model


def reached(scene, b, u, target):
    """Where the source's share of the gap voltage meets `target` on the way from u at constant charge, by a scan.

    NaN where it turns back before; None where that is a close call. The share is u - b / A(|u|), A from the reference.
    """
    top = 4.0 * (abs(u) + abs(target) + abs(b / ref.area(0.0, scene.params)))

    def share(v):
        return v - b / ref.area(np.abs(v), scene.params)

    way = math.copysign(1.0, target - float(share(np.array([u]))[0]))
    far = np.geomspace(1e-12 * top, top, 60_000)
    grid = np.concatenate([-far[::-1], [0.0], far])
    grid = np.concatenate([[u], grid[grid > u] if way > 0.0 else grid[grid < u][::-1]])
    along = way * (share(grid) - target)
    rise = np.diff(along) / np.abs(np.diff(grid))
    met = int(np.argmax(along >= 0.0)) if np.any(along >= 0.0) else grid.size - 1
    turns = np.flatnonzero(rise[:met] < 0.0)
    if turns.size == 0 and rise[:met].min(initial=1.0) < 0.02:
        return None
    if turns.size:
        return None if rise[:met].min() > -0.02 else math.nan
    return float(np.interp(0.0, along[met - 1 : met + 1], grid[met - 1 : met + 1]))


def test_ramps_go_where_a_scan_goes_and_stop_where_it_turns_back():
    rng = np.random.default_rng(5)
    followed = folded = 0
    for number in range(400):
        scene = stress.draw(11, number)
        if not scene.touches:
            continue
        model = model_of(scene)
        u = float(rng.choice([-1.0, 1.0]) * scene.amplitude * model.k_gap * 10.0 ** rng.uniform(-4.0, 0.0))
        target = float(rng.choice([-1.0, 1.0]) * scene.amplitude * model.k_gap)
        _, dq = branch_area(model, math.copysign(1.0, u), u)
        # Charge of either sign, up to some that outweighs the source.
        b = float(rng.choice([-1.0, 1.0]) * 10.0 ** rng.uniform(-3.0, 1.0) * abs(target)) * model.area0
        if 1.0 - b * dq < 0.02:
            continue
        expected = reached(scene, b, u, target)
        if expected is None:
            continue
        found = ramp(model, target, b / model.area0, u)
        if math.isnan(expected):
            assert math.isnan(found), f"scene {number}: {found} V, past a fold"
            folded += 1
        else:
            assert found == pytest.approx(expected, rel=1e-3, abs=1e-6 * abs(target)), f"scene {number}"
            followed += 1
    assert followed > 100
    assert folded >= 10


@pytest.mark.filterwarnings("ignore::fingerspice.FingerspiceWarning")
@pytest.mark.parametrize("number", [1730, 1974, 9735])
def test_a_jump_past_a_fold_is_seen_though_the_slope_is_right_at_both_ends(number):
    # A long stride from large voltage to 0 V, or away from it, finds a rising slope on either side of a fold.
    scene = stress.draw(0, number)
    solution = fs.simulate(scene.circuit, charge_law="mobile", rtol=1e-6, throw=False)
    assert solution.status is fs.Status.FOLD
    assert solution.failure.t == pytest.approx(0.5 / scene.frequency, rel=1e-12)


def test_the_gap_voltage_is_the_root_connected_to_the_guess():
    # One layer leaks alone, so that its charge tells the voltage: u = k U - b / A folds where (k U - u) A has its top.
    scene = stress.draw(0, 661)
    model = model_of(scene)
    k_u = model.k_gap * scene.amplitude
    u = np.linspace(k_u, 0.3 * k_u, 200_001)
    held = (k_u - u) * ref.area(u, scene.params)
    top = int(np.argmax(np.diff(held) < 0.0))
    for share, there in ((0.5, True), (0.999, True), (1.001, False), (1.1, False)):
        found = gap_voltage(model, k_u, -share * held[top] / model.area0, 1.0, u[top // 2])
        assert (found == found) == there
        if there:
            assert found > u[top]
            assert (k_u - found) * float(ref.area(found, scene.params)) == pytest.approx(share * held[top], rel=1e-9)
