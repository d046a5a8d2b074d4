"""The hard cases that have a solution: solved to the requested error, in a bounded number of steps, without a warning.

Long runs are in test_hard_runs.py, and cases without a solution in test_hard_refusals.py. References are
independent of the package.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from functools import lru_cache
from typing import Any

import numpy as np
import pytest

import analytic as ref
import fingerspice as fs
from scenes import deck, table1

every_law = pytest.mark.parametrize("law", ["local", "mobile"])
T = np.linspace(0.0, 0.0199, 57)
NS = 1e-9
CONTACT = "fn=0.5 mu=0.3 alpha=54.4 m_exp=0.52 beta=32 n_exp=1.41 c2=5000"


def run(source: Any, law: str = "local", circuit: fs.Circuit | None = None, **options: Any) -> fs.Solution:
    circuit = table1() if circuit is None else circuit
    return fs.simulate(circuit, sources={"Vdrive": source}, charge_law=law, **{"t_stop": 0.02} | options)


def check(solution: fs.Solution, expected: ref.Transient, steps: int, rounded: float = 0.0) -> None:
    """Error within what was asked for and within what is stated, of voltage and force; few steps, little work.

    `rounded` (V) is what rounding of the output times alone makes of the source.
    """
    peak, strongest = np.abs(expected.u_gap).max(), expected.force.max()
    gap, force = np.abs(solution.u_gap - expected.u_gap).max(), np.abs(solution.f_el - expected.force).max()
    assert solution.success
    assert gap <= solution.rtol * peak
    assert gap <= solution.error.u_gap + rounded
    assert force <= solution.rtol * strongest
    assert force <= solution.error.f_el + 2.0 * rounded / peak * strongest
    assert solution.error.u_gap <= 1.001 * solution.rtol * peak
    # What the gap misses is in the other layers too, which share the same states.
    assert np.abs(solution.u_layer - expected.u).max() <= 3.0 * solution.rtol * peak + rounded
    assert solution.stats["steps"] <= steps
    # A step is some iterations of 13 nodes; none gets stuck.
    assert solution.nfev <= 30 * 13 * (solution.stats["steps"] + solution.stats["rejected"])


# Extreme leaks ----------------------------------------------------------------------------------------------

LEAKS = {
    "R_i = 1 ohm": (1.0, 1e6),
    "R_i = 1e15": (1e15, 1e6),
    "R_a = 1e12": (2e5, 1e12),
    "R_i = 1 ohm, R_a = 1e12": (1.0, 1e12),
    "coating a pure capacitor": (math.inf, 1e6),
    "gap a pure capacitor": (2e5, math.inf),
    "both pure capacitors": (math.inf, math.inf),
}
SHAPES = {
    "sine": (fs.Sine(200.0, 100.0), ref.sine_segments(200.0, 100.0, 0.02)),
    "square": (fs.Square(120.0, 100.0), ref.square_segments(120.0, 100.0, 2)),
}


@every_law
@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("case", LEAKS)
def test_extreme_leaks_are_solved_without_a_step_explosion(case: str, shape: str, law: str) -> None:
    (r_coat, r_gap), (source, segments) = LEAKS[case], SHAPES[shape]
    coat, gap, skin = ref.table1_layers(100.0)
    layers = (dataclasses.replace(coat, r_total=r_coat), dataclasses.replace(gap, r_total=r_gap), skin)
    # No output on a jump: the last time of each half period is just before it.
    t = T + 1e-7
    expected = ref.transient(segments, t, law=law, layers=layers, tol=1e-12, stages=20)
    left_out = {r: None if math.isinf(r) else r for r in (r_coat, r_gap)}
    circuit = table1(coat={"r": left_out[r_coat]}, gap={"r": left_out[r_gap]})
    # A square behind 1 ohm begins every half period with something over in nanoseconds.
    check(run(source, law, circuit, t_eval=t), expected, steps=1000 if r_coat == 1.0 else 100)


@every_law
@pytest.mark.parametrize("method", ["auto", "exponential"])
def test_without_any_resistor_the_stack_is_a_divider(method: str, law: str) -> None:
    # Uncharged and without leaks nothing is stored on the interfaces: u_x = U d_x/eps_x / sum, under both laws.
    circuit = deck(
        "Vdrive drive 0 SIN(0 200 100)",
        "Xcoat drive top area LAYER d=1u eps_r=3.9",
        f"Xgap top skin area GAP d=3.5u eps_r=1 {CONTACT}",
        "Xskin skin 0 area LAYER d=350u eps_r=1000",
    )
    depth = np.array([1e-6 / 3.9, 3.5e-6, 350e-6 / 1000.0])
    u = 200.0 * np.sin(2.0 * math.pi * 100.0 * T)
    solution = fs.simulate(circuit, t_eval=T, t_stop=0.02, charge_law=law, method=method)
    want = u[:, None] * depth / depth.sum()
    assert np.abs(solution.u_layer - want).max() <= 1e-8 * np.abs(want[:, 1]).max()
    force = 8.854e-12 * want[:, 1] ** 2 / (2.0 * 3.5e-6**2) * ref.area(want[:, 1])
    assert np.abs(solution.f_el - force).max() <= 1e-8 * force.max()
    if method == "auto":
        assert solution.method == "algebraic"
        assert solution.nfev == 0
        assert np.abs(solution.u_layer - want).max() <= 1e-14 * 200.0
    else:
        assert solution.stats["steps"] <= 50


# Jumps ------------------------------------------------------------------------------------------------------

JUMPS = {
    "at t = 0": [(0.0, 0.0), (0.0, 120.0), (0.01, -30.0)],
    "at t_stop": [(0.0, 40.0), (0.01, 120.0), (0.01, -80.0), (0.02, -80.0)],
    "at t = 0 and t_stop": [(0.0, 0.0), (0.0, 120.0), (0.01, 60.0), (0.01, -60.0), (0.02, -60.0)],
    "two 1 ns apart": [(0.0, 0.0), (3e-3, 0.0), (3e-3, 150.0), (3e-3 + NS, 150.0), (3e-3 + NS, -50.0), (0.02, -50.0)],
    "on an output time": [(0.0, 0.0), (4e-3, 90.0), (4e-3, -60.0), (0.02, -60.0)],
}


@every_law
@pytest.mark.parametrize("given", ["outputs of the deck", "outputs asked for"])
@pytest.mark.parametrize("case", JUMPS)
def test_both_one_sided_values_of_a_jump_are_right(case: str, given: str, law: str) -> None:
    points = JUMPS[case]
    source = fs.PWL(*zip(*points, strict=True))
    times = [t for t, _ in points]
    jumps = np.array(sorted({t for t in times if times.count(t) == 2 and t > 0.0}))
    expected = ref.transient(ref.pwl_segments(points), [], law=law, freq=100.0)
    circuit = table1(tran="100u 10m uic")
    if given == "outputs asked for":
        # A jump asked for by its time has its right-hand value, at the end too; just before it is its left-hand one.
        t = np.unique(np.concatenate([[0.0], jumps, np.linspace(0.0, 0.01, 41)]))
        solution = run(source, law, circuit, t_stop=0.01, t_eval=t)
        check(solution, expected.at(t), steps=60)
        return
    solution = run(source, law, circuit, t_stop=0.01)
    twice = np.flatnonzero(np.diff(solution.t) == 0.0)
    np.testing.assert_allclose(solution.t[twice], jumps, rtol=1e-15)
    left = np.zeros(solution.t.size, bool)
    left[twice] = True
    one, other = expected.at(solution.t[left], side="left"), expected.at(solution.t[~left])
    signals = {name: np.empty((left.size, *getattr(other, name).shape[1:])) for name in ("u", "area", "force", "q")}
    for name, values in signals.items():
        values[left], values[~left] = getattr(one, name), getattr(other, name)
    whole = dataclasses.replace(other, t=solution.t, **signals)
    check(solution, whole, steps=60)
    assert np.abs(solution.q_source - whole.q).max() <= 1e-8 * np.abs(whole.q).max()
    jumped = solution.u_source[twice + 1] - solution.u_source[twice]
    sizes = [b - a for (t, a), (s, b) in itertools.pairwise(points) if t == s > 0.0]
    np.testing.assert_allclose(jumped, sizes, rtol=1e-13)


@every_law
def test_a_jump_from_rest_divides_as_the_capacitors_do(law: str) -> None:
    c = np.array([x.c for x in ref.table1_layers(100.0)])
    solution = run(fs.DC(200.0), law, t_eval=[0.0], t_stop=1e-3)
    # Layer voltages are parts of 200 V, and rounded as these are.
    np.testing.assert_allclose(solution.u_layer[0], 200.0 / c / np.sum(1.0 / c), rtol=1e-14, atol=4e-16 * 200.0)


# Edges of 1 ns ----------------------------------------------------------------------------------------------


def pulse(start: float, width: float) -> list[tuple[float, float]]:
    """Corners of a pulse of 200 V with edges of 1 ns, up to 10 ms."""
    rise = [(start, 0.0), (start + NS, 200.0)]
    return [(0.0, 0.0), *rise, (start + NS + width, 200.0), (start + 2.0 * NS + width, 0.0), (0.01, 0.0)]


def around(points: list[tuple[float, float]]) -> np.ndarray:
    """Output times everywhere and inside every edge."""
    inside = [t + x * NS for t, _ in points[1:-1] for x in (-0.5, 0.1, 0.5)]
    return np.unique(np.concatenate([np.linspace(0.0, 9.99e-3, 101), inside]))


# An edge makes 200 V of 1 ns: at 3 ms, rounding of a time is felt.
EDGE_ROUNDED = 2.0 * float(np.spacing(3e-3)) * 200.0 / NS


@every_law
@pytest.mark.parametrize("width", [NS, 20e-6, 2e-3], ids=["1 ns", "20 us", "2 ms"])
@pytest.mark.parametrize("kind", ["PWL", "deck"])
def test_declared_edges_of_a_nanosecond_are_not_missed(kind: str, width: float, law: str) -> None:
    points = pulse(3e-3, width)
    t = around(points)
    expected = ref.transient(ref.pwl_segments(points), t, law=law, freq=100.0)
    if kind == "deck":
        circuit = table1(f"PULSE(0 200 3m 1n 1n {width!r} 1)")
        solution = fs.simulate(circuit, t_stop=0.01, t_eval=t, charge_law=law)
    else:
        solution = run(fs.PWL(*zip(*points, strict=True)), law, t_stop=0.01, t_eval=t)
    check(solution, expected, steps=100, rounded=EDGE_ROUNDED)


@every_law
def test_undeclared_edges_of_a_nanosecond_are_found_and_resolved(law: str) -> None:
    points = pulse(3.00123e-3, 2e-3)
    t = around(points)
    expected = ref.transient(ref.pwl_segments(points), t, law=law, freq=100.0)
    with pytest.warns(fs.FingerspiceWarning, match=r"feature narrower than the output step .* near t = 0\.00300123"):
        solution = run(lambda t: np.interp(t, *zip(*points, strict=True)), law, t_stop=0.01, t_eval=t)
    check(solution, expected, steps=1000, rounded=EDGE_ROUNDED)


# 3 ms is where two series of this run meet: their points come no nearer than 0.6 us to such places.
def edge_at_a_cut(t: np.ndarray) -> np.ndarray:
    return np.interp(t, [3e-3, 3e-3 + NS], [0.0, 200.0])


def test_an_undeclared_edge_between_two_series_is_resolved_and_said() -> None:
    t = np.linspace(0.0, 9.99e-3, 101)
    segments = ref.pwl_segments([(0.0, 0.0), (3e-3, 0.0), (3e-3 + NS, 200.0), (0.01, 200.0)])
    expected = ref.transient(segments, t, freq=100.0)
    with pytest.warns(
        fs.FingerspiceWarning, match=r"feature narrower than the output step 1e-05 s near t = 0\.0030000"
    ):
        solution = run(edge_at_a_cut, t_stop=0.01, t_eval=t)
    off = np.abs(solution.u_gap - expected.u_gap).max()
    assert off <= 1e-8 * np.abs(expected.u_gap).max()
    assert off <= solution.error.u_gap


def test_an_undeclared_pulse_that_outputs_stand_in_is_not_missed_without_a_word() -> None:
    points = pulse(3e-3, NS)
    with pytest.raises(fs.SolveError, match="a feature at this output that its samples missed"):
        run(lambda t: np.interp(t, *zip(*points, strict=True)), t_stop=0.01, t_eval=around(points))


# High voltage -----------------------------------------------------------------------------------------------


@lru_cache(None)
def two_kilovolt(shape: str, law: str) -> ref.Transient:
    segments = {"sine": ref.sine_segments(2000.0, 100.0, 0.02), "square": ref.square_segments(2000.0, 100.0, 2)}
    return ref.transient(segments[shape], T + 1e-7, law=law, freq=100.0)


@pytest.mark.parametrize("shape", ["sine", "square"])
def test_the_two_kilovolt_scenes_are_as_hard_as_they_are_said_to_be(shape: str) -> None:
    scene = two_kilovolt(shape, "local")
    peak = scene.extremes(0.0, 0.02)["u_gap_max"]
    if shape == "sine":
        assert peak == pytest.approx(769.0, abs=0.5)
        assert 1e6 * float(ref.area(peak)) == pytest.approx(7.6, abs=0.05)
    else:
        x_per_volt = ref._contact_constants(ref.TABLE1, 1.0)[2]
        assert x_per_volt * peak == pytest.approx(1.8, abs=0.05)


@pytest.mark.parametrize(("shape", "law"), [("sine", "local"), ("square", "local"), ("sine", "mobile")])
def test_two_kilovolt_are_solved_and_the_breakdown_of_air_is_warned_about(shape: str, law: str) -> None:
    source = {"sine": fs.Sine(2000.0, 100.0), "square": fs.Square(2000.0, 100.0)}[shape]
    with pytest.warns(fs.FingerspiceWarning) as said:
        solution = run(source, law, t_eval=T + 1e-7)
    # The square leaves a thirtieth of the contact, the sine more than a fifth.
    about = ["air breaks down", "contact area falls to 1.31 mm^2"][: 2 if shape == "square" else 1]
    assert len(said) == len(about)
    for warning, part in zip(said, about, strict=True):
        assert part in str(warning.message)
    check(solution, two_kilovolt(shape, law), steps=200)
