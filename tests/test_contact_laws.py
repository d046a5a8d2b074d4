"""Contact laws other than the paper's: a law of one's own, a table and the shipped ones, through every kind of run."""

import dataclasses
import pickle
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import mpmath as mp
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicSpline
from scipy.optimize import brentq

import analytic as ref
import fingerspice as fs
from fingerspice.explorer.scene import as_deck, scene
from ngspice_tools import beside
from scenes import deck, finger, refuses, table1, table1_deck, warns

Areas = Callable[[NDArray[np.float64]], NDArray[np.float64]]
P = ref.TABLE1


def stress(u: Any) -> Any:
    return 0.5 * P.eps0 * P.eps_a * (u / P.d_a) ** 2


def pulled(u: NDArray[np.float64], p: Any) -> NDArray[np.float64]:
    """A = k (F_N + sigma A), which has no end below the voltage at which k sigma is 1."""
    return p["k"] * p["fn"] / (1.0 - p["k"] * 0.5 * 8.854e-12 * p["eps_r"] * (u / p["d"]) ** 2)


def own_areas(u: Any) -> Any:
    return 60e-6 * P.force_normal / (1.0 - 60e-6 * stress(u))


LAW = fs.ContactLaw("pulled", pulled, {"k": 70e-6})
OWN = {"Xgap.law": LAW, "Xgap.k": 60e-6}
PAPERS = ("alpha", "m_exp", "beta", "n_exp", "c2")


def dmt(u: float) -> float:
    """N = F_N + sigma alpha N^m, by bisection with 30 digits: alpha N^m, m^2."""
    with mp.workdps(30):
        sigma, load = mp.mpf(stress(u)), mp.mpf(P.force_normal)
        n = mp.findroot(lambda n: n - load - sigma * P.alpha * n**P.m, (load, 100 * load), solver="anderson")
        return float(P.alpha * n**P.m)


def linear(u: float) -> float:
    with mp.workdps(30):
        per, sigma = mp.sqrt(mp.pi) / 2 * mp.mpf("72.5e-6") / mp.mpf("100e-6"), mp.mpf(stress(u))
        force = mp.mpf(P.force_normal)
        miss = lambda a: mp.mpf("1e-4") * mp.erf(per * (force + sigma * a)) - a  # noqa: E731
        return float(mp.findroot(miss, (0, 1e-4), solver="anderson"))


def reference(areas: Areas, times: NDArray[np.float64], slope: Callable[[float], float], u_start: float = 0.0) -> Any:
    """Gap voltage of Table 1 at 100 Hz under the local law, from the three layers' equations (Eq. 16) by DOP853."""
    layers = ref.table1_layers(100.0)
    c = np.array([x.c for x in layers])

    def rates(t: float, u: NDArray[np.float64]) -> NDArray[np.float64]:
        a = float(areas(np.array([abs(u[1])]))[0])
        leaks = u * np.array([1.0 / x.r_total + a / x.r_area for x in layers]) / (c * a)
        current = (slope(t) + leaks.sum()) / (1.0 / (c * a)).sum()
        return current / (c * a) - leaks

    run = solve_ivp(rates, (0.0, times[-1]), np.zeros(3), "DOP853", times, rtol=1e-11, atol=1e-10, max_step=5e-5)
    return run.y[1]


def sine_slope(t: float) -> float:
    return 200.0 * 200.0 * np.pi * np.cos(200.0 * np.pi * t)


TIMES = np.linspace(0.0, 0.02, 101)


def two_fingers(volts: float = 200.0) -> fs.Circuit:
    """The gaps Xgap1 and Xgap2 beside one another under a sine of 100 Hz."""
    lines = [*finger("drive", "0", "area1", "1", f=100.0), *finger("drive", "0", "area2", "2", f=100.0)]
    return deck(f"Vdrive drive 0 SIN(0 {volts:g} 100)", *lines, ".tran 0.2m 20m uic")


@pytest.mark.parametrize("method", ["auto", "radau"])
def test_a_law_of_ones_own_runs_a_stack(method: str) -> None:
    circuit = table1().replace(OWN)
    solution = fs.simulate(circuit, t_eval=TIMES, rtol=1e-8 if method == "auto" else 1e-6, method=method)
    expected = reference(own_areas, TIMES, sine_slope)
    peak = abs(expected).max()
    assert np.abs(solution.u_gap - expected).max() <= max(solution.error.u_gap, 2e-9 * peak)
    np.testing.assert_allclose(solution.area, own_areas(solution.u_gap), rtol=1e-12)
    force = stress(solution.u_gap) * solution.area
    np.testing.assert_allclose(solution.f_t, P.mu0 * (P.force_normal + force), rtol=1e-12)


@pytest.mark.parametrize(("law", "areas"), [("dmt", dmt), ("linear", linear)])
def test_the_laws_of_the_package_have_the_roots_of_their_equations(law: str, areas: Callable[[float], float]) -> None:
    solution = fs.simulate(table1(gap={"law": law, **dict.fromkeys(PAPERS)}), t_eval=TIMES, rtol=1e-8)
    expected = np.array([areas(abs(u)) for u in solution.u_gap.tolist()])
    np.testing.assert_allclose(solution.area, expected, rtol=1e-11)
    found = reference(np.vectorize(areas), TIMES[:11], sine_slope)
    assert np.abs(solution.u_gap[:11] - found).max() <= max(solution.error.u_gap, 1e-8 * abs(solution.u_gap).max())


def closing(u: float, soft: float = 0.5e-6, p_ref: float = 14.3e3) -> tuple[float, float]:
    """Height (m) at which the asperities carry load and attraction, and the ridge area there, m^2."""
    under = lambda h: dataclasses.replace(P, d_a=h)  # noqa: E731
    sigma = lambda h: 0.5 * P.eps0 * P.eps_a * (u / h) ** 2  # noqa: E731

    def miss(h: float) -> float:
        return float(p_ref * np.exp((P.d_a - h) / soft) - P.force_normal / ref.area(u, under(h)) - sigma(h))

    h = brentq(miss, 2.2e-6, 3.6e-6, xtol=1e-20, rtol=1e-15)
    return h, float(ref.area(u, under(h)))


def of_gap(u: float, law: str) -> tuple[float, float, float]:
    """Ridge area, m^2, height, m, and leak, S, of Table 1's gap with `law=pullin` or `r_exp`."""
    h, area = closing(abs(u)) if law == "pullin" else (P.d_a, float(ref.area(abs(u), P)))
    load = P.force_normal + 0.5 * P.eps0 * P.eps_a * (u / h) ** 2 * area
    return area, h, (load / 0.5 if law == "r_exp" else 1.0) / P.r_a


@pytest.mark.parametrize("charge_law", ["local", "mobile"])
@pytest.mark.parametrize(("law", "changes"), [("pullin", {"Xgap.law": "pullin"}), ("r_exp", {"Xgap.r_exp": 1.0})])
def test_gaps_that_close_and_leaks_that_follow_obey_kirchhoffs_law(
    law: str, changes: dict[str, Any], charge_law: str
) -> None:
    circuit = table1(f=100.0).replace({**changes, "Vdrive": fs.Sine(180.0, 100.0)})
    t = np.linspace(0.0, 4e-3, 41)
    run = fs.simulate(circuit, t_stop=4e-3, t_eval=t, rtol=1e-8, charge_law=charge_law)
    assert run.method == "radau"
    grid = np.linspace(0.0, 150.0, 601)
    area, height, leak = map(partial(CubicSpline, grid), np.array([of_gap(u, law) for u in grid]).T)
    coat, _, skin = ref.table1_layers(100.0)

    def rates(time: float, u: Any) -> Any:
        """Rates of the voltages of gap and coating; the skin has the rest."""
        e, gap = 180.0 * np.sin(2 * np.pi * 100.0 * time), abs(u[0])
        every = np.array([u[0], u[1], e - u[0] - u[1]])
        per = np.array([P.eps0 * P.eps_a / height(gap), coat.c, skin.c])
        slope = np.sign(u[0]) * per * np.array([
            area(gap, 1) - area(gap) * height(gap, 1) / height(gap), *(2 * [area(gap, 1)])
        ])  # fmt: skip
        lost = every * np.array([leak(gap), *(1.0 / x.r_total + area(gap) / x.r_area for x in (coat, skin))])
        # C_i u_i' + [mobile] C_i' u_gap' u_i + lost_i is one current i.
        matrix = np.zeros((4, 4))
        matrix[:3, :3], matrix[:3, 3], matrix[3, :3] = np.diag(per * area(gap)), -1.0, 1.0
        matrix[:3, 0] += slope * every if charge_law == "mobile" else 0.0
        drive = 180.0 * 2 * np.pi * 100.0 * np.cos(2 * np.pi * 100.0 * time)
        return np.linalg.solve(matrix, np.append(-lost, drive))[:2]

    found = solve_ivp(rates, (0.0, t[-1]), [0.0, 0.0], "DOP853", t, rtol=1e-11, atol=1e-9)
    assert np.abs(run.u_gap - found.y[0]).max() <= max(run.error.u_gap, 1e-8 * np.abs(run.u_gap).max())
    expected = np.array([of_gap(u, law) for u in run.u_gap])
    np.testing.assert_allclose(run.area, expected[:, 0], rtol=1e-9)
    pull = 0.5 * P.eps0 * P.eps_a * (run.u_gap / expected[:, 1]) ** 2 * expected[:, 0]
    np.testing.assert_allclose(run.f_el, pull, rtol=1e-9, atol=1e-12)
    periodic = fs.steady_state(circuit, rtol=1e-7, charge_law=charge_law).solution
    assert periodic.method == "radau"
    long = fs.simulate(circuit, t_stop=0.21, t_eval=0.2 + periodic.t, rtol=1e-9, charge_law=charge_law)
    assert np.abs(long.u_gap - periodic.u_gap).max() <= periodic.error.u_gap + long.error.u_gap


def test_the_load_of_r_is_that_of_the_finger_unless_given() -> None:
    one, other = ({"Xgap.r_exp": 1.0, "Xgap.fn": 1.0, **more} for more in ({}, {"Xgap.r_load": 0.5, "Xgap.r": 2e6}))
    runs = [fs.simulate(table1().replace(changes), rtol=1e-8) for changes in (one, other)]
    np.testing.assert_allclose(runs[0].u_gap, runs[1].u_gap, rtol=0.0, atol=1e-6)


@pytest.mark.filterwarnings("ignore:.*usual range")
def test_a_stiff_gap_and_an_r_that_hardly_follows_are_table_1() -> None:
    plain = fs.simulate(table1(), rtol=1e-8)
    rigid = {"Xgap.law": "pullin", "Xgap.u0": 1e-8, "Xgap.p_ref": P.force_normal / ref.area(0.0, P)}
    for changes, near in ((rigid, 3e-3), ({"Xgap.r_exp": 1e-6}, 1e-6)):
        run = fs.simulate(table1().replace(changes), rtol=1e-8)
        np.testing.assert_allclose(run.u_gap, plain.u_gap, rtol=0.0, atol=near * np.abs(plain.u_gap).max())
        for held in ("frozen", 35e-6):
            one, other = (fs.simulate(c, area=held, rtol=1e-8) for c in (table1(), table1().replace(changes)))
            np.testing.assert_allclose(other.f_el, one.f_el, rtol=0.0, atol=1e-6 * one.f_el.max())


def test_a_phasor_of_a_closing_gap_has_its_height_at_the_rms_voltage() -> None:
    found = fs.phasor(table1(f=100.0).replace({"Xgap.law": "pullin"}), 100.0)
    u = float(abs(found.u_gap[0]))
    h, area = closing(u / np.sqrt(2.0))
    assert found.area[0] == pytest.approx(area, rel=1e-9)
    assert found.f_el_mean[0] == pytest.approx(0.25 * P.eps0 * P.eps_a * (u / h) ** 2 * area, rel=1e-9)
    gains = ref.phasor_gains(100.0, area, ref.table1_layers(100.0, dataclasses.replace(P, d_a=h)))
    assert u == pytest.approx(200.0 * abs(gains[1]), rel=1e-9)


def test_pull_in_is_where_a_heights_voltage_is_largest_and_ends_a_run(tmp_path: Path) -> None:
    soft = table1(f=100.0).replace({"Xgap.law": "pullin", "Xgap.u0": 2e-6})
    heights = np.linspace(1.5e-6, 3.4e-6, 400)

    def volts(h: float) -> float:
        """The voltage at which a gap is in balance at this height."""
        p, own = 14.3e3 * np.exp((P.d_a - h) / 2e-6), dataclasses.replace(P, d_a=h)
        balance = lambda u: float(P.force_normal / ref.area(u, own) + 0.5 * P.eps0 * (u / h) ** 2 - p)  # noqa: E731
        return brentq(balance, 0.0, h * np.sqrt(2.0 * p / P.eps0))

    top = max(map(volts, heights))
    for charge_law in ("local", "mobile"):
        said = r"at [12]\.\d+ ms the gap voltage passes (\d+\.\d) V, .* of the contact law pullin are known: beyond it"
        with pytest.raises(fs.InputError, match=said) as told:
            fs.simulate(soft, charge_law=charge_law)
        met = float(str(told.value).split("passes ")[1].split(" V")[0])
        assert 0.989 * top <= met <= top
    small = fs.simulate(soft.replace({"Vdrive.amplitude": 100.0}))
    assert small.success
    assert fs.load(small.to_netcdf(tmp_path / "run.nc")).f_el_mean == small.f_el_mean
    assert pickle.loads(pickle.dumps(small)).f_el_mean == small.f_el_mean


@pytest.mark.filterwarnings("ignore:.*usual range")
@pytest.mark.parametrize(
    ("changes", "act", "said"),
    [
        ({"Xgap.law": "pullin", "Xgap.a_fix": 35.0}, fs.simulate, "a gap that closes; allowed: a_fix=0 and tau=0"),
        ({"Xgap.r_exp": 1.0, "Xgap.tau": 1e-3}, fs.simulate, "an r that follows its load; allowed: a_fix=0 and tau=0"),
        (
            {"Xgap.r_exp": 1.0},
            fs.export_netlist,
            "is not written for ngspice; allowed: another contact law, and r_exp=0",
        ),
        (
            {"Xgap.law": "pullin"},
            lambda c: fs.inverse_drive(c, force=fs.Sine(0.02, 20.0, offset=0.05)),
            "that follows its",
        ),
        ({"Xgap.law": "pullin", "Xgap.p_ref": 1.0}, fs.simulate, "contact law pullin has no area above 0 at 0 V"),
    ],
)
def test_soft_gaps_are_refused_where_they_cannot_be(changes: dict[str, Any], act: Any, said: str) -> None:
    circuit = table1().replace(changes)
    refuses(said, act, circuit)


def test_two_fingers_of_a_network_each_have_their_law() -> None:
    one = deck("Vdrive drive 0 SIN(0 200 100)", *finger("drive", "0", f=100.0), ".tran 0.2m 20m uic")
    two = two_fingers().replace({"Xgap1.law": LAW, "Xgap1.k": 60e-6, "Xgap2.law": "dmt"})
    both = fs.simulate(two, t_eval=TIMES, rtol=1e-7)
    for k, law in enumerate((OWN, {"Xgap.law": "DMT"})):
        other = fs.simulate(one.replace(law), t_eval=TIMES, rtol=1e-9)
        assert np.abs(both.u_gap[:, k] - other.u_gap).max() <= both.error.u_gap + other.error.u_gap


def test_recordings_batches_sweeps_and_fits_take_a_law(tmp_path: Path) -> None:
    values = 120.0 * np.sin(np.arange(481) * 0.2) * np.linspace(0.0, 1.0, 481)
    circuit = table1(f=100.0).replace({**OWN, "Vdrive": fs.Samples(values, 24e3)})
    run = fs.simulate(circuit, t_stop=0.02, t_eval=TIMES, rtol=1e-6)
    expected = reference(own_areas, TIMES, lambda t: np.diff(values)[min(int(t * 24e3), 479)] * 24e3)
    assert np.abs(run.u_gap - expected).max() <= max(run.error.u_gap, 1e-6 * np.abs(expected).max())
    ks = np.array([50e-6, 60e-6])
    sine = table1().replace(OWN)
    single = [fs.simulate(sine.replace({"Xgap.k": k})).f_el_mean for k in ks]
    batch = fs.batch(sine, {"Xgap.k": ks}, outputs=["f_el_mean"])
    np.testing.assert_allclose(batch.f_el_mean, single, rtol=1e-4)
    assert batch.attrs["n_ordinary"] == 0
    np.testing.assert_allclose(fs.sweep(sine, {"Xgap.k": ks}, outputs=["f_el_mean"]).f_el_mean, single, rtol=1e-4)
    frequencies = np.array([30.0, 100.0, 300.0, 1000.0])
    forces = [fs.steady_state(sine.replace({"Vdrive": fs.Sine(140.0, f)}), rtol=1e-8).f_el_mean for f in frequencies]
    data = {"frequency": frequencies, "Vdrive.amplitude": np.full(4, 140.0), "f_el_mean": np.array(forces)}
    fitted = fs.fit(sine.replace({"Xgap.k": 50e-6}), data, ["Xgap.k"], skin="own")
    assert fitted.estimates["Xgap.k"].value == pytest.approx(60e-6, rel=1e-4)
    change = fs.simulate(sine, sensitivities=["Xgap.k"], rtol=1e-9).sensitivities["Xgap.k"].f_el_mean
    steps = [fs.simulate(sine.replace({"Xgap.k": 60e-6 * by}), rtol=1e-9).f_el_mean for by in (0.999, 1.001)]
    assert change == pytest.approx((steps[1] - steps[0]) / 0.12e-6, rel=1e-5)


def test_a_phasors_area_is_that_of_the_rms_voltage() -> None:
    found = fs.phasor(table1().replace(OWN), [100.0]).area[0]
    gain = abs(ref.phasor_gains(100.0, found, ref.table1_layers(100.0))[ref.GAP])
    assert found == pytest.approx(own_areas(200.0 * gain / np.sqrt(2.0)), rel=1e-9)


@pytest.mark.parametrize("changes", [OWN, {"Xgap.p_sat": 50e3}], ids=["own law", "saturating"])
def test_the_export_for_ngspice_has_the_areas_as_points(changes: dict[str, Any]) -> None:
    circuit = table1(tran="2u 20m 0 2u uic").replace(changes)
    assert ("GAP with the contact law pulled" in fs.export_netlist(circuit)) == (changes is OWN)
    ours, _, u_gap, area = beside(circuit, rtol=1e-8)
    assert np.abs(ours.u_gap - u_gap).max() <= 1e-4 * np.abs(ours.u_gap).max()
    np.testing.assert_allclose(1e6 * ours.area, area, rtol=2e-4)


def two_scales(u: float, p_sat: float) -> tuple[float, float]:
    """Ridge and real area, m^2: Eq. 4, and A = A0 - (c2 / A0) F_T^2, F_T = sqrt(pi/8) mu p_sat A_real; 30 digits."""
    with mp.workdps(30):
        sigma, load = mp.mpf(stress(u)), mp.mpf(P.force_normal)
        first, p = ref.ridge_area_unloaded_mp(u, P, 30), mp.mpf(p_sat)
        real = lambda a: a * mp.erf(mp.sqrt(2) * (load + sigma * a) / a / p)  # noqa: E731
        loss = lambda a: P.c2 / first * (mp.sqrt(mp.pi / 8) * P.mu0 * p * real(a)) ** 2  # noqa: E731
        area = mp.findroot(lambda a: a - first + loss(a), (first / 100, first), solver="anderson")
        return float(area), float(real(area))


@pytest.mark.parametrize("p_sat", [50e3, 300e3])
def test_a_saturating_contact_has_the_areas_and_the_friction_of_its_equations(p_sat: float) -> None:
    solution = fs.simulate(table1(gap={"p_sat": p_sat}), t_eval=TIMES[:26], rtol=1e-8)
    area, real = np.array([two_scales(abs(u), p_sat) for u in solution.u_gap.tolist()]).T
    np.testing.assert_allclose(solution.area, area, rtol=1e-10)
    np.testing.assert_allclose(solution.a_real, real, rtol=1e-10)
    np.testing.assert_allclose(solution.f_t, np.sqrt(np.pi / 8.0) * P.mu0 * p_sat * real, rtol=1e-10)
    np.testing.assert_allclose(solution.friction, solution.f_t / P.force_normal, rtol=1e-14)
    areas = np.vectorize(lambda u: two_scales(u, p_sat)[0])
    found = reference(areas, TIMES[:4], sine_slope)
    assert np.abs(solution.u_gap[:4] - found).max() <= max(solution.error.u_gap, 1e-8 * abs(solution.u_gap).max())


def test_without_a_limit_of_the_pressure_nothing_changes_and_the_real_area_grows_by_the_square() -> None:
    plain, hard = fs.simulate(table1()), fs.simulate(table1(gap={"p_sat": 1e9}))
    np.testing.assert_allclose(hard.u_gap, plain.u_gap, atol=hard.error.u_gap + plain.error.u_gap)
    np.testing.assert_allclose(hard.f_t, plain.f_t, rtol=1e-9)
    assert plain.a_real is None
    assert not plain.by_name("a_real")
    u = np.array([75.0, 100.0, 125.0, 150.0])
    runs = [fs.steady_state(table1(gap={"p_sat": 300e3}).replace({"Vdrive": fs.Sine(x, 100.0)})) for x in u]
    growth = np.array([run.a_real_mean for run in runs]) - two_scales(0.0, 300e3)[1]
    assert np.polyfit(np.log(u), np.log(growth), 1)[0] == pytest.approx(1.98, abs=0.02)


def test_the_real_area_is_saved_fitted_and_differentiated_and_needs_its_pressure(tmp_path: Path) -> None:
    circuit = table1(gap={"p_sat": 300e3})
    run = fs.simulate(circuit, sensitivities=["Xgap.p_sat"])
    loaded = fs.load(run.to_netcdf(tmp_path / "run.nc"))
    np.testing.assert_array_equal(loaded.a_real, run.a_real)
    assert loaded.summary()["a_real_mean"] == run.a_real_mean
    slope = run.sensitivities["Xgap.p_sat"].a_real_mean
    ends = [fs.simulate(table1(gap={"p_sat": 300e3 * by}), rtol=1e-10).a_real_mean for by in (0.999, 1.001)]
    assert slope == pytest.approx((ends[1] - ends[0]) / 600.0, rel=1e-5)
    u = [60.0, 120.0, 180.0]
    found = fs.batch(circuit, {"Vdrive.amplitude": u}, outputs=["a_real_mean", "f_t_mean"], periodic=True, rtol=1e-7)
    data = {"Vdrive.amplitude": u, "a_real_mean": found.a_real_mean.to_numpy()}
    fitted = fs.fit(circuit.replace({"Xgap.p_sat": 200e3}), data, ["Xgap.p_sat"])
    assert fitted.estimates["Xgap.p_sat"].value == pytest.approx(300e3, rel=1e-5)
    for refused in (
        lambda: fs.batch(table1(), {"Xgap.d": [3e-6]}, outputs=["a_real_mean"]),
        lambda: fs.torch.Simulator(table1(), ["Xgap.d"], "a_real_mean"),
    ):
        refuses("a_real_mean is asked for, and no GAP has a real area", refused)
    with pytest.raises(fs.InputError, match="Xgap has p_sat=300000 Pa, slip=0 m: friction"):
        fs.inverse_drive(circuit, friction=lambda t: 0.16 + 0 * t, rate=1e4)
    refuses(r"Xgap\.p_sat is 300000 Pa", fs.fit_contact, circuit, {"fn": [0.2, 0.5], "f_t": [0.06, 0.15]}, ["Xgap.mu"])


def formed(t: NDArray[np.float64]) -> NDArray[np.float64]:
    """Friction of Table 1 at 100 Hz without a slip, from a run with many outputs."""
    return fs.simulate(table1(), t_eval=t, rtol=1e-11).f_t


SLIP, SPEED = 11.5e-6, 0.02


def test_friction_with_a_slip_is_dahls_equation_at_any_time_and_speed() -> None:
    fine = np.linspace(0.0, 0.02, 40001)
    friction = CubicSpline(fine, formed(fine))
    circuit = table1(gap={"slip": SLIP, "v": SPEED})
    run = fs.simulate(circuit, t_eval=TIMES, rtol=1e-10)
    speeds: list[Callable[[float], float]] = [lambda t: SPEED, lambda t: 0.03 + 0.02 * np.sin(40.0 * np.pi * t)]
    runs = [run, run.slide(speeds[1])]
    for speed, one in zip(speeds, runs, strict=True):
        rate = lambda t, y, speed=speed: [speed(t) / SLIP * (friction(t) - y[0]), y[0]]  # noqa: E731
        start = [friction(0.0), 0.0]
        expected = solve_ivp(rate, (0.0, 0.02), start, "DOP853", TIMES, rtol=1e-11, atol=1e-13, max_step=1e-4)
        np.testing.assert_allclose(one.f_t, expected.y[0], atol=2e-10)
        np.testing.assert_allclose(one.friction, one.f_t / P.force_normal, rtol=1e-14)
        np.testing.assert_array_equal(one.u_gap, run.u_gap)
        means = fs.simulate(circuit, t_stop=0.02, rtol=1e-9).slide(speed), fs.simulate(table1(), t_stop=0.02)
        assert means[0].f_t_mean == pytest.approx(expected.y[1, -1] / 0.02, rel=1e-8)
        assert means[1].f_t_mean != pytest.approx(expected.y[1, -1] / 0.02, rel=1e-4)


@pytest.mark.parametrize("speed", [0.005, 0.02, 0.1])
def test_a_slip_is_a_first_order_low_pass_of_the_periodic_friction(speed: float) -> None:
    plain, slow = (fs.steady_state(table1(gap=gap), rtol=1e-9).solution for gap in ({}, {"slip": SLIP, "v": speed}))
    lines = [run.spectrum("f_t", highest=1000.0) for run in (plain, slow)]
    strong = lines[0].amplitude > 1e-7
    # 13.8 Hz for each mm/s.
    cutoff = speed / (2.0 * np.pi * SLIP)
    gain = 1.0 / np.sqrt(1.0 + (lines[0].frequency / cutoff) ** 2)
    np.testing.assert_allclose(lines[1].amplitude[strong], (gain * lines[0].amplitude)[strong], rtol=1e-6)
    assert slow.f_t_mean == pytest.approx(plain.f_t_mean, rel=1e-12)
    assert slow.f_t[0] == pytest.approx(slow.f_t[-1], rel=1e-10)
    # Over several periods, whose ends are no ends of steps.
    circuit = table1(gap={"slip": SLIP, "v": speed})
    twice = fs.simulate(circuit, t_stop=0.02, t_eval=np.array([0.0, 0.01, 0.02]), start="periodic")
    np.testing.assert_allclose(twice.f_t, twice.f_t[0], rtol=1e-7)
    assert twice.f_t_mean == pytest.approx(plain.f_t_mean, rel=1e-7)


def test_a_slip_holds_for_networks_files_and_long_runs_and_is_refused_where_it_cannot(tmp_path: Path) -> None:
    both = fs.simulate(two_fingers().replace({"Xgap1.slip": SLIP, "Xgap1.v": SPEED}), t_eval=TIMES, rtol=1e-9)
    alone = fs.simulate(table1(gap={"slip": SLIP, "v": SPEED}), t_eval=TIMES, rtol=1e-9)
    np.testing.assert_allclose(both.f_t[:, 0], alone.f_t, rtol=1e-7)
    np.testing.assert_allclose(both.f_t[:, 1], fs.simulate(table1(), t_eval=TIMES, rtol=1e-9).f_t, rtol=1e-7)
    kept = pickle.loads(pickle.dumps(alone))
    np.testing.assert_array_equal(kept.f_t, alone.f_t)
    assert kept.f_t_mean == alone.f_t_mean
    alone.to_netcdf(tmp_path / "run.nc")
    np.testing.assert_array_equal(fs.load(tmp_path / "run.nc").f_t, alone.f_t)
    # Most periods of a long run are not integrated one by one, and its friction is that of every one of them.
    circuit = table1(gap={"slip": 1e-3, "v": 1e-3})
    long = fs.simulate(circuit, t_stop=3.0, t_eval=np.array([0.0, 3.0]))
    settled = fs.steady_state(circuit).solution.f_t[-1]
    begun = fs.simulate(circuit, t_stop=1.0, t_eval=np.array([0.0, 1.0])).f_t[-1]
    assert (long.f_t[-1] - settled) / (begun - settled) == pytest.approx(np.exp(-2.0), rel=1e-4)
    still = warns("Xgap has a slip and v=0: a finger at rest", table1().replace, {"Xgap.slip": SLIP})
    rest = fs.simulate(still)
    np.testing.assert_allclose(rest.f_t, 0.3 * 0.5, rtol=1e-12)
    for refused, said in (
        (lambda: next(fs.stream(circuit)), "needs the run between its outputs"),
        (lambda: fs.simulate(table1()).slide(0.02), "no GAP has a slip"),
        (lambda: alone.slide(-0.02), r"the speed of f_t is -0\.02 m/s"),
        (lambda: fs.inverse_drive(circuit, friction=lambda t: 0.16 + 0 * t, rate=1e4), "slip=0.001 m: friction"),
        (lambda: fs.load(tmp_path / "run.nc").slide(0.1), "needs the run between its outputs"),
    ):
        refuses(said, refused)


def test_a_file_keeps_the_law_and_the_figures(tmp_path: Path) -> None:
    solution = fs.simulate(table1().replace(OWN))
    loaded = fs.load(solution.to_netcdf(tmp_path / "run.nc"))
    assert loaded.circuit["Xgap"].law.name == "pulled"
    assert loaded.circuit["Xgap"].values["k"] == 60e-6
    np.testing.assert_array_equal(loaded.f_t, solution.f_t)


def test_a_table_is_a_monotone_cubic_between_its_points() -> None:
    u = np.array([0.0, 40.0, 90.0, 200.0])
    areas = np.array([35e-6, 36e-6, 40e-6, 60e-6])
    law = fs.ContactLaw.from_table("measured", u, areas)
    solution = fs.simulate(table1().replace({"Xgap.law": law}), t_eval=TIMES)
    at_points = np.interp(np.abs(solution.u_gap), u, areas)
    assert np.all((solution.area >= 35e-6 * (1.0 - 1e-6)) & (np.abs(solution.area - at_points) < 2e-6))
    values = [law.area(np.array([x]), {})[0] for x in u]
    np.testing.assert_allclose(values, areas, rtol=1e-14)


def test_the_papers_law_by_name_changes_nothing() -> None:
    plain, named = table1(), table1(gap={"law": "jkr"})
    np.testing.assert_array_equal(fs.simulate(named).u_gap, fs.simulate(plain).u_gap)
    back = plain.replace({"Xgap.law": "dmt"}).replace({"Xgap.law": "jkr"})
    assert dict(back["Xgap"].values) == dict(plain["Xgap"].values)


SHORT = fs.ContactLaw.from_table("short", [0.0, 20.0, 50.0], [35e-6, 36e-6, 37e-6])


def test_laws_of_one_name_are_told_apart_by_what_they_do(tmp_path: Path) -> None:
    first, second = (
        table1().replace({"Xgap.law": fs.ContactLaw.from_table("same", [0.0, 90.0, 200.0], [35e-6, area, area])})
        for area in (35e-6, 70e-6)
    )
    fs.simulate(first).to_netcdf(tmp_path / "run.nc")
    warns("its contact law is another one now", fs.load, tmp_path / "run.nc")
    kept = fs.simulate(pickle.loads(pickle.dumps(second))).area
    np.testing.assert_array_equal(kept, fs.simulate(second).area)
    changed = table1().replace({"Xgap.beta": 40.0, "Xgap.d": 3e-6}).replace({"Xgap.law": "dmt"})
    assert dict(changed.overrides) == {"Xgap.d": "3e-06", "Xgap.law": "dmt"}


def test_a_function_of_one_scene_alone_runs_scenes_one_by_one() -> None:
    law = fs.ContactLaw("single", lambda u, p: np.full(u.shape, 2e-6 if p["fn"] > 0.4 else 1e-6))
    found = fs.batch(table1().replace({"Xgap.law": law}), {"Xgap.fn": [0.3, 0.5]}, outputs=["f_el_mean"])
    assert found.attrs["n_ordinary"] == 2
    assert np.all(np.isfinite(found.f_el_mean))


def test_under_a_current_source_areas_end_where_they_are_not_known() -> None:
    lines = ["Idrive 0 drive SIN(0 5e-4 100)", *finger("drive", "foot", f=100.0), "Rf foot 0 1", ".tran 10u 30m uic"]
    for more in ({}, {"Xgap.tau": 1e-3}):
        with pytest.raises(fs.InputError, match="passes 300 V, up to which areas of the contact law dmt are known"):
            fs.simulate(deck(*lines).replace({"Xgap.law": "dmt", **more}))


def test_a_law_has_sliders_and_a_deck_of_the_page() -> None:
    deck_text = table1_deck(gap={"law": "linear", "slope": 60.0, **dict.fromkeys(PAPERS)})
    given = {"deck": deck_text, "overrides": {"Xgap.slope": 70.0}}
    gap = next(one for one in scene(given)["sliders"] if one["element"] == "Xgap")
    found = {one["path"]: (one["low"], one["value"], one["high"]) for one in gap["sliders"]}
    assert found["Xgap.slope"] == (0.0, 70.0, 300.0)
    assert "Xgap.alpha" not in found
    assert "contact law linear" in as_deck(given)


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: table1(gap={"law": "dmd"}), "contact law is 'dmd'; allowed: jkr, dmt, linear, pullin"),
        (lambda: table1().replace({"Xgap.law": "dmt", "Xgap.m_exp": 1.0}), "Xgap m_exp is 1; allowed: more than 0"),
        (lambda: table1().replace({"Xgap.r_exp": 11.0}), "Xgap r_exp is 11; allowed: 0 or more, from 1e-06 to 10"),
        (lambda: fs.ContactLaw("own", pulled, gap=3.5e-6), "gap(u, p)"),  # type: ignore[arg-type]
        (lambda: fs.ContactLaw("own", pulled, ["k"]), "allowed: a mapping such as"),  # type: ignore[arg-type]
        (lambda: fs.ContactLaw("own", pulled, {"k": np.inf}), "allowed: a finite number"),
        (lambda: table1(gap={"law": "dmt"}), "GAP with law=dmt has no parameter"),
        (lambda: table1().replace({"Xgap.law": "tabor"}), "contact law is 'tabor'"),
        (lambda: table1().replace({"Xgap.law": "dmt", "Xgap.beta": 3.0}), "unknown parameter 'Xgap.beta'"),
        (lambda: fs.ContactLaw("dmt", pulled), "allowed: a word but jkr, dmt, linear, pullin"),
        (lambda: fs.ContactLaw("own", pulled, {"fn": 1.0}), "a word in lower case but d, eps_r"),
        (lambda: fs.ContactLaw("own", 3.0), "allowed: a function area(u, p)"),  # type: ignore[arg-type]
        (lambda: fs.ContactLaw.from_table("t", [0.0, 1.0, 1.0], [1e-6] * 3), "is no function"),
        (lambda: fs.ContactLaw.from_table("t", [0.0, 1.0, 2.0], [1e-6, 0.0, 1e-6]), "has an area that is not above 0"),
        (lambda: fs.ContactLaw.from_table("t", [0.0, 1.0], [1e-6] * 2), "allowed: two rows of 3 or more"),
    ],
)
def test_wrong_laws_are_refused(make: Callable[[], Any], said: str) -> None:
    refuses(said.replace("(", r"\(").replace(")", r"\)"), make)


@pytest.mark.parametrize(
    ("law", "source", "said"),
    [
        (
            LAW,
            fs.Sine(300.0, 100.0),
            r"at 1\.\d+ ms the gap voltage passes 19\d\.\d V, .* of the contact law pulled",
        ),
        (SHORT, fs.Sine(200.0, 100.0), "the gap voltage passes 49.95 V, up to which areas of the contact law short"),
        (fs.ContactLaw("none", lambda u, p: np.nan * u), fs.Sine(1.0, 100.0), "no area above 0 at 0 V"),
        (fs.ContactLaw("minus", lambda u, p: 0.0 * u - 1.0), fs.Sine(1.0, 100.0), "no area above 0 at 0 V"),
        (fs.ContactLaw("single", lambda u, p: np.array(35e-6)), fs.Sine(1.0, 100.0), r"areas of shape \(\) at 1 gap"),
        (fs.ContactLaw("jump", lambda u, p: 35e-6 * (1.0 + (u > 50.0))), fs.Sine(200.0, 100.0), "without jumps"),
    ],
)
def test_areas_that_end_or_jump_are_told_with_the_voltage(law: fs.ContactLaw, source: fs.Waveform, said: str) -> None:
    refuses(said, fs.simulate, table1().replace({"Xgap.law": law, "Vdrive": source}))


def test_areas_that_end_beyond_the_runs_voltages_do_not_matter() -> None:
    # The source reaches 200 V, and the gap takes less than the 215 V at which the areas of this law end.
    assert fs.simulate(table1().replace(OWN)).success
    short = {"Xgap.law": SHORT, "Vdrive": fs.Sine(60.0, 100.0)}
    two = two_fingers(60.0).replace({"Xgap1.law": SHORT})
    assert fs.simulate(table1().replace(short)).success
    assert fs.simulate(two).success
    with pytest.raises(fs.InputError, match=r"passes 49\.95 V, up to which areas of the contact law short"):
        fs.simulate(two.replace({"Vdrive": fs.Sine(200.0, 100.0)}))
