"""The paper's claims and figures, computed; a claim that is not reproduced is a strict xfail with its reason."""

import csv
import functools
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import analytic as ref
import fingerspice as fs
from fingerspice.circuit.statespace import build_stack
from fingerspice.studies import figures
from fingerspice.studies.figures import table1_circuit
from fingerspice.studies.steady import steady_state
from scenes import dispersive_deck, refuses, table1, warns


@functools.cache
def phasor_at(f, amplitude=200.0, **changes):
    circuit = table1(f"SIN(0 {amplitude} 100)")
    if changes:
        circuit = circuit.replace({k.replace("__", "."): v for k, v in changes.items()})
    return fs.phasor(circuit, f)


@functools.cache
def square(f):
    return steady_state(table1(f"SQUARE(200 {f!r})", f), rtol=1e-9, points=2000).solution


def rise(low=100.0, high=1e4, **changes):
    return float(phasor_at(high, 140.0, **changes).f_el_mean[0] / phasor_at(low, 140.0, **changes).f_el_mean[0])


@pytest.mark.parametrize(("f", "size", "phase"), [(100.0, 0.6653, 7.94), (5000.0, 0.8768, 1.37)])
def test_gap_voltage_leads_by_some_degrees_at_100_hz_and_is_in_phase_at_5_khz(f, size, phase):
    (gain,) = phasor_at(f).gain
    assert abs(gain) == pytest.approx(size, abs=5e-5)
    assert np.degrees(np.angle(gain)) == pytest.approx(phase, abs=5e-3)


def test_gap_voltage_of_the_coupled_run_at_100_hz_is_a_little_less_than_the_phasors():
    run = steady_state(table1(), points=2000).solution
    turned = np.exp(-2j * np.pi * 100.0 * run.t)
    gain = np.trapezoid(run.u_gap * turned, run.t) / np.trapezoid(run.u_source * turned, run.t)
    assert abs(gain) == pytest.approx(0.6632, abs=5e-5)
    assert np.degrees(np.angle(gain)) == pytest.approx(8.04, abs=5e-3)


def test_with_the_skins_data_at_every_frequency_a_square_of_100_hz_gives_less_force():
    dispersive = fs.parse_netlist(dispersive_deck("SQUARE(200 100)"))
    found = steady_state(dispersive, rtol=1e-9, points=2000).solution.summary()
    own = square(100.0).summary()
    assert found["f_el_mean"] / own["f_el_mean"] == pytest.approx(1.0 - 0.019, abs=5e-4)
    assert found["f_el_max"] / own["f_el_max"] == pytest.approx(1.0 - 0.048, abs=5e-4)


@pytest.mark.xfail(reason="no physical rho(100 Hz) gives less than 64.6 % at this area; ours is 66.5 %")
def test_gap_voltage_at_100_hz_is_approximately_60_percent():
    assert abs(phasor_at(100.0).gain[0]) == pytest.approx(0.60, abs=0.03)


@pytest.mark.xfail(reason="with Table 1 the mean force rises by 72 %; other gap resistances give 3.1 to 0.9 times")
def test_force_rises_by_80_percent_with_table_1():
    assert rise() == pytest.approx(1.80, abs=0.03)


def test_the_force_rises_by_72_percent_from_100_hz_to_10_khz_and_hardly_above_2_khz():
    assert rise() == pytest.approx(1.724, abs=5e-4)
    assert rise(low=2000.0) == pytest.approx(1.03, abs=5e-3)
    for r_gap, expected in ((0.5e6, 3.06), (1e6, 1.72), (2e6, 1.21), (7e6, 0.91)):
        assert rise(Xgap__r=r_gap) == pytest.approx(expected, abs=5e-3)


def test_the_force_rises_by_45_percent_from_30_to_230_hz_where_newer_data_see_little_change():
    assert rise(30.0, 230.0) == pytest.approx(1.45, abs=5e-3)
    low, high = (ref.coupled_phasor(f, 140.0).mean_force for f in (30.0, 230.0))
    assert rise(30.0, 230.0) == pytest.approx(high / low, rel=1e-12)


def test_ridge_area_without_adhesion_is_about_37_square_millimetres():
    contact = build_stack(table1()).contact
    assert contact is not None
    assert 1e6 * contact.area_unloaded == pytest.approx(37.94, abs=5e-3)
    # Eq. 4 at 0 V, solved in 40 digits.
    assert float(contact.area_adhesive(0.0)) == pytest.approx(
        float(ref.ridge_area_unloaded_mp(0.0)), rel=1e-14, abs=0.0
    )


@pytest.mark.parametrize(("f", "force"), [(100.0, (0.1845, 0.5826, 0.2278)), (5000.0, (0.3326, 0.3829, 0.3550))])
def test_a_square_gives_a_very_volatile_force_at_100_hz_and_an_almost_constant_one_at_5_khz(f, force):
    s = square(f)
    found = s.f_el.min(), s.f_el.max(), s.summary()["f_el_mean_periodic"]
    assert found == pytest.approx(force, abs=5e-5)
    assert (np.ptp(s.f_el) < 0.15 * s.f_el.mean()) == (f == 5000.0)


@pytest.mark.parametrize(
    ("f", "transient", "phasor", "share"), [(100.0, 0.1090, 0.1113, -0.021), (5000.0, 0.1833, 0.1893, -0.032)]
)
def test_the_transient_s_mean_force_is_below_the_phasor_s_by_the_ripple(f, transient, phasor, share):
    result = fs.compare(table1(f"SIN(0 200 {f!r})", f))
    assert result.coupled.f_el_mean == pytest.approx(transient, abs=5.5e-5)
    assert result.phasor.f_el_mean == pytest.approx(phasor, abs=5.5e-5)
    assert result.coupled.f_el_mean / result.phasor.f_el_mean - 1.0 == pytest.approx(share, abs=5e-4)
    # With the phasor's area held, nothing of the difference is left.
    assert result.mean.f_el_mean == pytest.approx(result.phasor.f_el_mean, rel=1e-9)
    assert result.mean.amplitude == pytest.approx(result.phasor.amplitude, rel=1e-9)


@pytest.mark.parametrize(
    ("source", "f", "share"),
    [("SIN(0 200 100)", 100.0, -0.0019), ("SIN(0 200 5k)", 5000.0, -0.0001), ("SQUARE(200 5k)", 5000.0, 0.0006),
     ("SQUARE(200 100)", 100.0, 0.063)],
)  # fmt: skip
def test_peak_gap_voltage_of_the_mobile_law_against_the_local(source, f, share):
    circuit = table1(source, f)
    local, mobile = (steady_state(circuit, charge_law=law, points=4000).solution for law in ("local", "mobile"))
    peaks = np.abs(local.u_gap).max(), np.abs(mobile.u_gap).max()
    assert peaks[1] / peaks[0] - 1.0 == pytest.approx(share, abs=6e-5 if abs(share) < 0.01 else 5e-4)
    if source == "SQUARE(200 100)":
        assert peaks == pytest.approx((239.4, 254.4), abs=0.05)
        assert mobile.f_el.max() / local.f_el.max() - 1.0 == pytest.approx(0.089, abs=5e-4)


def test_dc_divides_by_the_resistances():
    circuit = warns("outside 10 Hz to 100 kHz", table1, "DC 1", 1.0)
    solution = fs.simulate(circuit, start="dc", t_stop=1e-3)
    assert solution.u_gap[-1] == pytest.approx(0.49, abs=5e-3)
    assert fs.simulate(table1("DC 1", 10.0), start="dc", t_stop=1e-3).u_gap[-1] == pytest.approx(0.56, abs=5e-3)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("figures")
    written = figures.make_figures(out)
    assert written == [out / f"fig{n}.{kind}" for n in (2, 3, 4, 5) for kind in ("png", "csv")]
    return out


@pytest.fixture(scope="module")
def trends() -> dict[tuple[str, float], tuple[float, float]]:
    """Elasticity and curvature of Fig. 3's mean force against each of its parameters, at frequencies (Hz)."""
    frequencies = (10.0, 100.0, 1000.0, 10000.0)
    circuit = table1_circuit().replace({"Vdrive.amplitude": figures.U0_FORCE})
    base = fs.phasor(circuit, frequencies).f_el_mean
    out: dict[tuple[str, float], tuple[float, float]] = {}
    for variation in figures.variations():
        x = np.linspace(min(variation.values), max(variation.values), 11)
        beside = variation.base * np.array([1.0 - 1e-3, 1.0 + 1e-3])
        low, high, *rows = (fs.phasor(variation.apply(circuit, v), frequencies).f_el_mean for v in (*beside, *x))
        line, y = np.column_stack([np.ones_like(x), x]), np.array(rows)
        off = np.abs(y - line @ np.linalg.lstsq(line, y, rcond=None)[0]).max(axis=0) / np.abs(y[-1] - y[0])
        slope = (high - low) / (2e-3 * base)
        out |= {(variation.name, f): (slope[i], off[i]) for i, f in enumerate(frequencies)}
    return out


def read(path: Path) -> dict[str, np.ndarray]:
    with path.open(newline="", encoding="utf-8") as stream:
        header, *rows = csv.reader(stream)
    return dict(zip(header, np.array(rows, float).T, strict=True))


def test_the_deck_in_the_package_is_table_1() -> None:
    ours, test = table1_circuit(), table1()
    assert dict(ours.parameters) == dict(test.parameters)
    assert ours.tran == test.tran


def test_every_figure_is_a_picture_with_its_data(folder: Path) -> None:
    found = sorted(p.name for p in folder.iterdir())
    assert found == [f"fig{n}.{kind}" for n in (2, 3, 4, 5) for kind in ("csv", "png")]
    for path in folder.glob("*.png"):
        with Image.open(path) as image:
            assert image.width >= 150 * 7
    for path in folder.glob("*.csv"):
        data = read(path)
        assert all(name.count("[") == 1 for name in data)
        assert all(np.isfinite(column).all() for column in data.values())


def test_one_figure_can_be_asked_for_and_one_the_model_does_not_make_is_refused_first(tmp_path: Path) -> None:
    assert [p.name for p in figures.make_figures(tmp_path, only=2)] == ["fig2.png", "fig2.csv"]
    assert len(list(tmp_path.iterdir())) == 2
    refuses(r"figure is 1; allowed: 2, 3, 4, 5", figures.make_figures, tmp_path / "out", only=[2, 1])
    assert not (tmp_path / "out").exists()


def test_fig_2_is_the_cubic_and_eq_19(folder: Path) -> None:
    data = read(folder / "fig2.csv")
    f = data["frequency [Hz]"]
    assert (f[0], f[-1]) == (10.0, 1e5)
    # Eq. 18 at z = 1 and 5, by hand: exponents 4.7661 and 2.9689.
    np.testing.assert_allclose(data["rho_sc [ohm m]"][[0, -1]], [10**4.7661, 10**2.9689], rtol=1e-8)
    # Eq. 19 at z = 1: exponent 3.75086.
    np.testing.assert_allclose(data["eps_r_sc [1]"][0], 10**3.75086, rtol=1e-8)


def test_fig_3_has_the_papers_curves(folder: Path) -> None:
    data = read(folder / "fig3.csv")
    curves = (
        "Table 1", "d_sc=200 um", "d_sc=450 um", "area=30 mm^2", "area=45 mm^2", "r_a=0.5 Mohm", "r_a=2 Mohm",
        "r_a=7 Mohm", "d_a=2 um", "d_a=5 um",
    )  # fmt: skip
    assert list(data)[1:] == [f"f_el_mean [N] {curve}" for curve in curves]
    f, base = data["frequency [Hz]"], data["f_el_mean [N] Table 1"]
    changed = table1().replace({"Vdrive.amplitude": 140.0, "Xgap.d": 2e-6})
    np.testing.assert_allclose(data["f_el_mean [N] d_a=2 um"], fs.phasor(changed, f).f_el_mean, rtol=1e-9)
    for more, less in (("d_sc=200 um", "d_sc=450 um"), ("area=45 mm^2", "area=30 mm^2"), ("d_a=2 um", "d_a=5 um")):
        assert np.all(data[f"f_el_mean [N] {more}"] > base)
        assert np.all(data[f"f_el_mean [N] {less}"] < base)


def test_scaling_the_area_scales_what_the_paper_calls_the_area() -> None:
    variation = figures.variations()[1]
    values = variation.apply(table1_circuit(), 45.0)["Xgap"].values
    assert variation.base == pytest.approx(37.94, rel=1e-4)
    assert values["alpha"] * 0.5 ** values["m_exp"] == pytest.approx(45.0, rel=1e-13)
    assert values["beta"] / values["alpha"] == pytest.approx(32.0 / 54.4, rel=1e-13)
    assert (values["m_exp"], values["n_exp"]) == (0.52, 1.41)


@pytest.mark.parametrize("number", [4, 5])
def test_figs_4_and_5_are_two_periods_of_the_periodic_state(folder: Path, number: int) -> None:
    data = read(folder / f"fig{number}.csv")
    for frequency in (100.0, 5000.0):
        part = {k: v[data["frequency [Hz]"] == frequency] for k, v in data.items()}
        t, u, force = part["t [s]"], part["u_gap [V]"], part["f_el [N]"]
        assert np.all(np.diff(t) >= 0.0)
        assert (t[0], t[-1]) == (0.0, pytest.approx(2.0 / frequency, rel=1e-9))
        middle = np.flatnonzero(np.isclose(t, 1.0 / frequency, rtol=1e-9))[-1]
        assert u[middle] == pytest.approx(u[0], abs=1e-5)
        assert u[-1] == pytest.approx(u[middle - 1] if number == 5 else u[0], abs=1e-5)
        stress = 8.854e-12 * u**2 / (2.0 * 3.5e-6**2)
        np.testing.assert_allclose(force, stress * part["area [m^2]"], rtol=1e-7, atol=1e-12)
        # Half a period later everything is turned over: rows of equal time apart from the jumps.
        assert u.max() == pytest.approx(-u.min(), rel=1e-4)
        jumps = np.count_nonzero(np.diff(t) == 0.0)
        assert jumps == (3 if number == 5 else 0)


def test_a_time_response_is_the_end_of_a_long_run() -> None:
    long = fs.simulate(table1(), t_stop=0.1, rtol=1e-8)
    sine = figures.time_response(fs.Sine, 100.0)
    assert sine.summary()["f_el_mean_periodic"] == pytest.approx(long.summary()["f_el_mean_periodic"], rel=1e-5)


@pytest.mark.parametrize(
    ("f", "ratio", "gap"), [(10.0, 3.04, -1.97), (100.0, 4.07, -1.95), (1000.0, 10.05, -1.79), (10000.0, 10.93, -1.71)]
)
def test_how_the_force_goes_with_skin_area_and_gap(trends, f, ratio, gap):
    """About linear in skin thickness and area, which matters more, and about as the inverse square of the gap."""
    (area, bent_area), (skin, bent_skin), (thin, bent_gap) = (trends[name, f] for name in ("area", "d_sc", "d_a"))
    # Off the best straight line by 6 % of the change at most for the skin (at 10 Hz), 1.2 % for the area.
    assert bent_skin < 0.06
    assert bent_area < 0.012
    assert bent_gap > 0.19
    assert skin < 0.0 < area
    assert area / -skin == pytest.approx(ratio, abs=0.01)
    assert thin == pytest.approx(gap, rel=1e-7, abs=5e-3)
