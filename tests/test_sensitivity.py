"""Sensitivities of a run by parameters, against fourth-order differences of runs at 1e-12, and what is refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import fingerspice as fs
from fingerspice.base.errors import InputError
from scenes import table1

CIRCUITS = Path(__file__).parents[1] / "circuits"
# Relative steps: the truncation of the difference is about 1e-12 of a signal, its rounding 1e-16 over the step.
STEP = 2e-4
T_STOP = 0.03


@pytest.fixture
def table_1() -> fs.Circuit:
    return table1()


def difference(circuit: fs.Circuit, path: str, step: float = STEP, **how: Any) -> dict[str, np.ndarray | float]:
    """Derivatives by a parameter from four runs."""
    value = circuit.parameters[path].value
    weights = {-2: 1.0, -1: -8.0, 1: 8.0, 2: -1.0}
    total: dict[str, Any] = {}
    for k, weight in weights.items():
        run = fs.simulate(circuit.replace({path: value * (1.0 + k * step)}), rtol=1e-12, **how)
        for name in ("u_gap", "area", "f_el", "f_t", "friction", "f_el_mean", "friction_mean"):
            total[name] = total.get(name, 0.0) + weight * getattr(run, name) / (12.0 * step * value)
    return total


def check(circuit: fs.Circuit, paths: tuple[str, ...], tol: float = 2e-9, **how: Any) -> None:
    """Every signal's change for a change of 100 % is right to `tol` of the signal's peak."""
    how = {"t_stop": T_STOP, "t_eval": np.linspace(0.0, T_STOP, 105)[1:-1], **how}
    run = fs.simulate(circuit, rtol=1e-10, sensitivities=paths, **how)
    assert list(run.sensitivities) == list(paths)
    for path in paths:
        found, expected = run.sensitivities[path], difference(circuit, path, **how)
        assert found.value == circuit.parameters[path].value
        for name, value in expected.items():
            peak = np.abs(getattr(run, name.removesuffix("_mean"))).max()
            off = np.abs(getattr(found, name) - value).max() * abs(found.value)
            assert off <= tol * peak, (path, name, off / peak)


@pytest.mark.parametrize("law", ["local", "mobile"])
def test_every_parameter_of_a_sine(table_1: fs.Circuit, law: str) -> None:
    gap = ("d", "eps_r", "r", "fn", "mu", "alpha", "m_exp", "beta", "n_exp", "c2")
    others = ("Xcoat.d", "Xcoat.eps_r", "Xcoat.r", "Xskin.d", "Vdrive.amplitude", "Vdrive.frequency")
    check(table_1, (*(f"Xgap.{name}" for name in gap), *others), tol=1e-8, charge_law=law)


@pytest.mark.parametrize("law", ["local", "mobile"])
def test_a_square_whose_jumps_have_two_values(table_1: fs.Circuit, law: str) -> None:
    circuit = table_1.replace({"Vdrive": fs.Square(200, 100)})
    check(circuit, ("Xgap.d", "Xgap.r", "Xskin.d", "Vdrive.amplitude"), charge_law=law)
    run = fs.simulate(circuit, t_stop=T_STOP, rtol=1e-8, sensitivities=("Vdrive.amplitude",), charge_law=law)
    jump = int(np.flatnonzero(np.diff(run.t) == 0.0)[0])
    before, after = run.sensitivities["Vdrive.amplitude"].u_gap[jump : jump + 2]
    assert before * after < 0.0 or abs(after - before) > 0.1 * abs(after)


def test_a_dispersive_skin() -> None:
    check(fs.read_netlist(CIRCUITS / "fingerpad_dispersive.cir"), ("Xgap.d", "Xgap.r", "Xskin.d"))


@pytest.mark.parametrize("law", ["local", "mobile"])
@pytest.mark.parametrize("start", ["dc", "periodic"])
def test_starts_that_move_with_the_parameter(table_1: fs.Circuit, law: str, start: str) -> None:
    circuit = table_1.replace({"Vdrive": fs.Sine(150, 100, offset=30.0)})
    check(circuit, ("Xgap.d", "Xcoat.r", "Vdrive.offset"), charge_law=law, start=start)
    check(circuit, ("Vdrive.frequency",), tol=1e-8, charge_law=law, start=start)


@pytest.mark.parametrize("law", ["local", "mobile"])
def test_the_periodic_state_has_them(table_1: fs.Circuit, law: str) -> None:
    # The frequency changes the period, and so the mean over it; at 30 V of offset the force at its ends is no mean.
    circuit, paths = (
        table_1.replace({"Vdrive": fs.Sine(150, 100, offset=30.0)}),
        ("Xgap.d", "Xcoat.r", "Vdrive.frequency"),
    )
    state = fs.steady_state(circuit, rtol=1e-10, charge_law=law, sensitivities=paths)
    for path in paths:
        value, weights = circuit.parameters[path].value, {-2: 1.0, -1: -8.0, 1: 8.0, 2: -1.0}
        states = {
            k: fs.steady_state(circuit.replace({path: value * (1.0 + k * STEP)}), rtol=1e-12, charge_law=law)
            for k in weights
        }
        for name in ("f_el_mean", "f_t_mean", "friction_mean", "area_mean"):
            expected = sum(weight * getattr(states[k], name) for k, weight in weights.items()) / (12.0 * STEP)
            found = getattr(state.sensitivities[path], name) * value
            assert found == pytest.approx(expected, abs=2e-9 * getattr(state, name)), (path, name)


def test_repeated_periods_are_followed_one_by_one(table_1: fs.Circuit) -> None:
    run = fs.simulate(table_1, t_stop=0.3, rtol=1e-8, sensitivities=("Xgap.r",))
    assert run.stats["repeated"] > 0
    every = fs.simulate(table_1, t_stop=0.3, rtol=1e-8, sensitivities=("Xgap.r",), method="exponential")
    one, other = run.sensitivities["Xgap.r"], every.sensitivities["Xgap.r"]
    assert abs(one.f_el_mean - other.f_el_mean) <= 1e-7 * abs(other.f_el_mean)


def uneven(points: int, stop: float) -> fs.PWL:
    """A PWL on no even grid."""
    t = np.sort(np.random.default_rng(4).uniform(0.0, stop, points))
    return fs.PWL(np.append(0.0, t), np.append(0.0, 150.0 * np.sin(2.0 * np.pi * 150.0 * t)))


def test_points_at_uneven_times_have_them(table_1: fs.Circuit) -> None:
    circuit = table_1.replace({"Vdrive": uneven(1100, T_STOP)})
    how: dict[str, Any] = {"t_stop": T_STOP, "t_eval": np.linspace(0.0, T_STOP, 20)[1:], "charge": False}
    assert fs.simulate(circuit, rtol=1e-6, **how).method == "relaxation"
    paths = ("Xgap.d", "Xcoat.r")
    run = fs.simulate(circuit, rtol=1e-8, sensitivities=paths, **how)
    for path in paths:
        # One difference of second order: its truncation is about 1e-7 of a signal.
        value = circuit.parameters[path].value
        low, high = (
            fs.simulate(circuit.replace({path: by * value}), rtol=1e-11, method="exponential", **how)
            for by in (1.0 - STEP, 1.0 + STEP)
        )
        for name in ("u_gap", "f_el", "f_el_mean"):
            found = value * getattr(run.sensitivities[path], name)
            expected = (getattr(high, name) - getattr(low, name)) / (2.0 * STEP)
            assert np.abs(found - expected).max() <= 1e-6 * np.abs(getattr(run, name.removesuffix("_mean"))).max()


def test_without_leaks_a_gap_divides_the_voltage() -> None:
    # u_gap = U / (1 + d1 / (eps1 d)): the capacitances of a series stack, whatever the area.
    deck = """divider
.include fingerspice.lib
V1 a 0 SIN(0 100 50)
X1 a b area LAYER d=2u eps_r=4
X2 b 0 area GAP d=3u fn=0.5
.tran 1m 40m uic
.end"""
    circuit = fs.parse_netlist(deck)
    run = fs.simulate(circuit, sensitivities=("X2.d", "X1.d", "X1.eps_r"), rtol=1e-9)
    share = 1.0 + 2.0 / (4.0 * 3.0)
    u = 100.0 * np.sin(2.0 * np.pi * 50.0 * run.t)
    by_d = u / share**2 * 2.0 / (4.0 * 3.0) / 3e-6
    np.testing.assert_allclose(run.sensitivities["X2.d"].u_gap, by_d, atol=1e-8 * np.abs(by_d).max())
    np.testing.assert_allclose(run.sensitivities["X1.d"].u_gap, -1.5 * by_d, atol=2e-8 * np.abs(by_d).max())


@pytest.mark.parametrize(
    ("how", "text"),
    [
        ({"sensitivities": ("Xgap.dd",)}, "nearest: 'Xgap.d'"),
        ({"sensitivities": "Xgap.d"}, "a sequence of paths"),
        ({"sensitivities": ("Xgap.tau",)}, "not 0"),
        ({"sensitivities": ("Xgap.d",), "area": "frozen"}, "the area is frozen"),
        ({"sensitivities": ("Xgap.d",), "method": "radau"}, "the method is 'radau'"),
        ({"sensitivities": ("Vdrive.frequency",), "sources": fs.Square(200, 100)}, "moves the edges of its source"),
    ],
)
def test_refused(table_1: fs.Circuit, how: dict[str, Any], text: str) -> None:
    with pytest.raises(InputError, match=text):
        fs.simulate(table_1, t_stop=0.02, **how)


def test_a_parameter_near_whose_value_there_is_no_period_is_refused_in_a_periodic_state(table_1: fs.Circuit) -> None:
    circuit = table_1.replace({"Vdrive": fs.AM(150, 1000, 100)})
    with pytest.raises(InputError, match=r"Vdrive\.carrier, near whose value the source has no such period"):
        _ = fs.steady_state(circuit, sensitivities=("Vdrive.carrier",)).sensitivities
    with pytest.raises(InputError, match=r"Vdrive\.modulation, near whose value the source has no such period"):
        fs.simulate(circuit, t_stop=0.02, start="periodic", sensitivities=("Xgap.d", "Vdrive.modulation"))


def test_networks_are_refused() -> None:
    two_fingers = fs.read_netlist(CIRCUITS / "two_fingers.cir")
    with pytest.raises(InputError, match="no series stack"):
        fs.simulate(
            two_fingers, t_stop=1e-3, sensitivities=(next(p for p in two_fingers.parameters if p.endswith(".d")),)
        )
