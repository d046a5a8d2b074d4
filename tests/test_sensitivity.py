"""Sensitivities of a run by parameters, against differences of independent solutions, and what is refused."""

from typing import Any

import numpy as np
import pytest

import analytic
import fingerspice as fs
from fingerspice.base.errors import InputError
from network_reference import Floating, Tone
from scenes import DECKS, cases, deck, every_law, floating, listed, refuses, shipped, table1

# Relative steps: the truncation of the difference is about 1e-12 of a signal, its rounding 1e-16 over the step.
STEP = 2e-4
T_STOP = 0.03
WEIGHTS = {-2: 1.0, -1: -8.0, 1: 8.0, 2: -1.0}
FINER = {-3: -1.0, -2: 9.0, -1: -45.0, 1: 45.0, 2: -9.0, 3: 1.0}
# Paths of Table 1's circuit by the paper's name of the value.
PAPER = {
    "Xgap.d": "d_a_um", "Xgap.eps_r": "eps_r_a", "Xgap.r": "R_a_ohm", "Xgap.fn": "F_N_N", "Xgap.mu": "mu0",
    "Xgap.alpha": "alpha_mm2_per_Nm", "Xgap.m_exp": "m", "Xgap.beta": "beta_mm_2mn", "Xgap.n_exp": "n",
    "Xgap.c2": "c2_mm4_per_N2", "Xcoat.d": "d_i_um", "Xcoat.eps_r": "eps_r_i", "Xcoat.r": "R_i_ohm",
    "Xskin.d": "d_sc_um",
}  # fmt: skip
SINE = {"amplitude": 200.0, "frequency": 100.0, "offset": 0.0}


@pytest.fixture
def table_1() -> fs.Circuit:
    return table1()


def changed(path: str, by: float, source: dict[str, float]) -> tuple[analytic.Parameters, dict[str, float]]:
    """Table 1 and a source with a parameter multiplied by 1 + `by`."""
    element, _, name = path.partition(".")
    if element == "Vdrive":
        return analytic.TABLE1, source | {name: source[name] * (1.0 + by)}
    key = PAPER[path]
    return analytic.parameters_from_paper(
        analytic.PAPER_TABLE1 | {key: analytic.PAPER_TABLE1[key] * (1.0 + by)}
    ), source


def solved(path: str, by: float, t: np.ndarray, source: dict[str, float], law: str) -> dict[str, np.ndarray]:
    """Signals and means of Table 1's stack from rest, with a parameter multiplied by 1 + `by`, by `analytic`."""
    parameters, wave = changed(path, by, source)
    if "offset" in wave:
        segments = analytic.sine_segments(wave["amplitude"], wave["frequency"], t[-1], offset=wave["offset"])
    else:
        segments = analytic.square_segments(wave["amplitude"], wave["frequency"], round(t[-1] * wave["frequency"]))
    run = analytic.transient(segments, t[:-1], params=parameters, law=law, freq=100.0)
    f_n, mu, force = parameters.force_normal, parameters.mu0, run.mean_force(0.0, t[-1])
    f_t = mu * (f_n + run.force)
    return {
        "u_gap": run.u_gap, "area": run.area, "f_el": run.force, "f_t": f_t, "friction": f_t / f_n,
        "f_el_mean": np.array(force), "friction_mean": np.array(mu * (1.0 + force / f_n)),
    }  # fmt: skip


def check_by_hand(paths: tuple[str, ...], source: dict[str, float], law: str, t_stop: float, tol: float) -> None:
    """Every signal's change for a change of 100 % is right to `tol` of the signal's peak."""
    t = np.append(np.linspace(0.0, t_stop, 73)[1:-1] + 1e-7, t_stop)
    wave = fs.Sine(**source) if "offset" in source else fs.Square(**source)
    run = fs.simulate(
        table1(), sources=wave, t_eval=t, t_stop=t_stop, rtol=1e-10, charge_law=law, sensitivities=paths,
        start="uncharged",
    )  # fmt: skip
    assert list(run.sensitivities) == list(paths)
    for path in paths:
        found = run.sensitivities[path]
        around = {k: solved(path, k * 1e-3, t, source, law) for k in WEIGHTS}
        for name in around[1]:
            expected = sum(weight * around[k][name] for k, weight in WEIGHTS.items()) / 12e-3
            peak = np.abs(getattr(run, name.removesuffix("_mean"))).max()
            given = np.atleast_1d(getattr(found, name) * found.value)[: max(1, np.size(expected))]
            off = np.abs(given - expected).max()
            assert off <= tol * peak, (path, name, off / peak)


@every_law
def test_every_parameter_of_a_sine(law: str) -> None:
    # Every evaluation of the equations of the law `mobile` takes a search.
    some = slice(None, None, cases(1, 3) if law == "mobile" else 1)
    check_by_hand((*PAPER, "Vdrive.amplitude", "Vdrive.frequency")[some], SINE, law, 1e-3 * cases(12, 6), 2e-8)


@every_law
def test_a_square_whose_jumps_have_two_values(table_1: fs.Circuit, law: str) -> None:
    source = {"amplitude": 200.0, "frequency": 100.0}
    paths = ("Xgap.d", "Xgap.r", "Xskin.d", "Vdrive.amplitude")[:: cases(1, 3) if law == "mobile" else 1]
    check_by_hand(paths, source, law, 0.01 * cases(2, 1), 1e-9)
    circuit = table_1.replace({"Vdrive": fs.Square(200, 100)})
    run = fs.simulate(circuit, t_stop=T_STOP, rtol=1e-8, sensitivities=("Vdrive.amplitude",), charge_law=law)
    jump = int(np.flatnonzero(np.diff(run.t) == 0.0)[0])
    before, after = run.sensitivities["Vdrive.amplitude"].u_gap[jump : jump + 2]
    assert before * after < 0.0 or abs(after - before) > 0.1 * abs(after)


@pytest.mark.parametrize(("law", "tau"), [("local", 0.0), ("mobile", 0.0), ("local", 50e-6)])
def test_networks_have_them(law: str, tau: float) -> None:
    # Amplifier, finger and body, in equations written by hand; at `tau` > 0 the area follows with a delay.
    circuit = floating("SIN(120 60 5k)", **({"tau": tau} if tau > 0.0 else {}))
    t = np.linspace(0.0, 1e-4 * cases(4, 1), 1 + cases(40, 10))[1:]
    # The equations of the other two cases take much longer.
    paths = ("Rout.value", "Vdrive.amplitude", "Cbody.value")[: 3 if (law, tau) == ("local", 0.0) else cases(2, 1)]
    run = fs.simulate(circuit, t_stop=t[-1], t_eval=t, charge_law=law, rtol=1e-10, sensitivities=paths)
    own, h = {"Rout.value": 47e3, "Cbody.value": 150e-12, "Vdrive.amplitude": 60.0}, 3e-3
    for path in paths:
        value, around = own[path], {}
        for k in FINER:
            now = own | {path: value * (1.0 + k * h)}
            reference = Floating(5000.0, now["Rout.value"], now["Cbody.value"], law == "mobile", tau)
            tone = Tone(120.0, now["Vdrive.amplitude"], 5000.0)
            around[k] = reference.response(tone, list(t), rtol=1e-13)
        for name in ("u_gap", "area"):
            expected = sum(weight * around[k][name] for k, weight in FINER.items()) / (60.0 * h)
            found = getattr(run.sensitivities[path], name) * value
            assert np.abs(found - expected).max() <= 1e-9 * np.abs(getattr(run, name)).max(), (path, name)


def difference(circuit: fs.Circuit, path: str, step: float = STEP, **how: Any) -> dict[str, np.ndarray | float]:
    """Derivatives by a parameter from four runs."""
    value = circuit.parameters[path].value
    total: dict[str, Any] = {}
    for k, weight in WEIGHTS.items():
        run = fs.simulate(circuit.replace({path: value * (1.0 + k * step)}), rtol=1e-12, **how)
        for name in ("u_gap", "area", "f_el", "f_t", "friction", "f_el_mean", "friction_mean"):
            total[name] = total.get(name, 0.0) + weight * getattr(run, name) / (12.0 * step * value)
    return total


def check(circuit: fs.Circuit, paths: tuple[str, ...], tol: float = 2e-9, **how: Any) -> None:
    """Every signal's change for a change of 100 % is that between runs, to `tol` of the signal's peak."""
    how = {"t_stop": T_STOP, "t_eval": np.linspace(0.0, T_STOP, 105)[1:-1], **how}
    run = fs.simulate(circuit, rtol=1e-10, sensitivities=paths, **how)
    for path in paths:
        found, expected = run.sensitivities[path], difference(circuit, path, **how)
        assert found.value == circuit.parameters[path].value
        for name, value in expected.items():
            peak = np.abs(getattr(run, name.removesuffix("_mean"))).max()
            off = np.abs(getattr(found, name) - value).max() * abs(found.value)
            assert off <= tol * peak, (path, name, off / peak)


def test_a_dispersive_skin() -> None:
    check(shipped("fingerpad_dispersive"), ("Xgap.d", "Xgap.r", "Xskin.d"))


@every_law
@pytest.mark.parametrize("start", ["dc", "periodic"])
def test_starts_that_move_with_the_parameter(table_1: fs.Circuit, law: str, start: str) -> None:
    circuit = table_1.replace({"Vdrive": fs.Sine(150, 100, offset=30.0)})
    check(circuit, ("Xgap.d", "Xcoat.r", "Vdrive.offset"), charge_law=law, start=start)
    check(circuit, ("Vdrive.frequency",), tol=1e-8, charge_law=law, start=start)


@every_law
def test_the_periodic_state_has_them(table_1: fs.Circuit, law: str) -> None:
    # The frequency changes the period, and so the mean over it; at 30 V of offset the force at its ends is no mean.
    circuit, paths = (
        table_1.replace({"Vdrive": fs.Sine(150, 100, offset=30.0)}),
        ("Xgap.d", "Xcoat.r", "Vdrive.frequency"),
    )
    state = fs.steady_state(circuit, rtol=1e-10, charge_law=law, sensitivities=paths)
    for path in paths:
        value = circuit.parameters[path].value
        states = {
            k: fs.steady_state(circuit.replace({path: value * (1.0 + k * STEP)}), rtol=1e-12, charge_law=law)
            for k in WEIGHTS
        }
        for name in ("f_el_mean", "f_t_mean", "friction_mean", "area_mean"):
            expected = sum(weight * getattr(states[k], name) for k, weight in WEIGHTS.items()) / (12.0 * STEP)
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
    deck = (DECKS / "divider.cir").read_text()
    circuit = fs.parse_netlist(deck)
    run = fs.simulate(circuit, sensitivities=("X2.d", "X1.d", "X1.eps_r"), rtol=1e-9)
    share = 1.0 + 2.0 / (4.0 * 3.0)
    u = 100.0 * np.sin(2.0 * np.pi * 50.0 * run.t)
    by_d = u / share**2 * 2.0 / (4.0 * 3.0) / 3e-6
    np.testing.assert_allclose(run.sensitivities["X2.d"].u_gap, by_d, atol=1e-8 * np.abs(by_d).max())
    np.testing.assert_allclose(run.sensitivities["X1.d"].u_gap, -1.5 * by_d, atol=2e-8 * np.abs(by_d).max())


@pytest.mark.parametrize(("how", "text"), listed("sensitivities"))
def test_refused(table_1: fs.Circuit, how: dict[str, Any], text: str) -> None:
    refuses(text, fs.simulate, table_1, t_stop=0.02, **how)


def test_a_parameter_near_whose_value_there_is_no_period_is_refused_in_a_periodic_state(table_1: fs.Circuit) -> None:
    circuit = table_1.replace({"Vdrive": fs.AM(150, 1000, 100)})
    with pytest.raises(InputError, match=r"Vdrive\.carrier, near whose value the source has no such period"):
        _ = fs.steady_state(circuit, sensitivities=("Vdrive.carrier",)).sensitivities
    with pytest.raises(InputError, match=r"Vdrive\.modulation, near whose value the source has no such period"):
        fs.simulate(circuit, t_stop=0.02, start="periodic", sensitivities=("Xgap.d", "Vdrive.modulation"))
    # When it is asked for, not when the run of a period is looked at.
    refuses(r"nearest: 'Xgap\.d'", fs.steady_state, circuit, sensitivities=("Xgap.dd",))


def test_a_frozen_area_has_them(table_1: fs.Circuit) -> None:
    # A linear circuit: voltages are as the amplitude, forces as its square.
    run = fs.simulate(table_1, t_stop=0.02, area="frozen", sensitivities=("source.amplitude",))
    by = run.sensitivities["Vdrive.amplitude"]
    np.testing.assert_allclose(by.value * by.u_gap, run.u_gap, atol=1e-10 * np.abs(run.u_gap).max())
    np.testing.assert_allclose(by.value * by.f_el, 2.0 * run.f_el, atol=1e-10 * run.f_el.max())
    assert np.abs(by.area).max() * by.value <= 1e-12 * run.area.max()


def test_two_fingers_have_a_column_each() -> None:
    two = shipped("two_fingers")
    path = next(p for p in two.parameters if p.endswith(".d"))
    run = fs.simulate(two, t_stop=1e-3, sensitivities=(path,), rtol=1e-6)
    assert run.sensitivities[path].u_gap.shape == run.u_gap.shape == (run.t.size, 2)


def test_what_has_no_gap_is_refused() -> None:
    divider = deck("V1 a 0 SIN(0 1 100)", "R1 a b 1k", "C1 b 0 1u", ".tran 1m 10m")
    refuses("the circuit has no GAP", fs.simulate, divider, sensitivities=("R1.value",))


def test_beside_a_zero_of_the_gap_voltage_the_area_changes_on_its_own_side(table_1: fs.Circuit) -> None:
    # The runs that are compared have their zeros some 10 ns apart.
    t = np.linspace(0.0, T_STOP, 3001)
    u = fs.simulate(table_1, t_stop=T_STOP, t_eval=t, rtol=1e-9).u_gap
    assert u is not None
    i = int(np.flatnonzero(u[2000:-1] * u[2001:] < 0.0)[0]) + 2000
    fine = np.linspace(t[i], t[i + 1], 101)
    u = fs.simulate(table_1, t_stop=T_STOP, t_eval=fine, rtol=1e-10).u_gap
    assert u is not None
    zero = float(np.interp(0.0, u * np.sign(u[-1]), fine))
    beside = zero + np.array([-2e-8, 2e-8])
    run = fs.simulate(table_1, t_stop=T_STOP, t_eval=beside, rtol=1e-10, sensitivities=["Xcoat.r"])
    assert run.u_gap is not None
    by, away = run.sensitivities["Xcoat.r"], np.abs(run.u_gap)
    assert np.all((away > 1e-4) & (away < 5e-3))
    assert run.u_gap[0] * run.u_gap[1] < 0.0
    rise = (analytic.area(1e-2) - analytic.area(0.0)) / 1e-2
    np.testing.assert_allclose(by.area, rise * np.sign(run.u_gap) * by.u_gap, rtol=1e-3)
