"""The paper's figures, computed by the package, and the numbers that the paper's text gives about them."""

import csv
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import fingerspice as fs
from fingerspice.studies import figures
from fingerspice.studies.figures import TABLE1_DECK, table1_circuit
from scenes import table1


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
    shipped = Path(__file__).parents[1] / "circuits" / "fingerpad.cir"
    assert dict(fs.read_netlist(shipped).parameters) == dict(ours.parameters)
    assert fs.parse_netlist(TABLE1_DECK).title == fs.read_netlist(shipped).title


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
    with pytest.raises(fs.InputError, match=r"figure is 1; allowed: 2, 3, 4, 5"):
        figures.make_figures(tmp_path / "out", only=[2, 1])
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
    ("f", "ratio", "gap"),
    [(10.0, 3.04, -1.97), (100.0, 4.07, -1.95), (1000.0, 10.05, -1.79), (10000.0, 10.93, -1.71)],
)
def test_how_the_force_goes_with_skin_area_and_gap(
    trends: dict[tuple[str, float], tuple[float, float]], f: float, ratio: float, gap: float
) -> None:
    """About linear in skin thickness and area, which matters more, and about as the inverse square of the gap."""
    (area, bent_area), (skin, bent_skin), (thin, bent_gap) = (trends[name, f] for name in ("area", "d_sc", "d_a"))
    # Off the best straight line by 6 % of the change at most for the skin (at 10 Hz), 1.2 % for the area.
    assert bent_skin < 0.06
    assert bent_area < 0.012
    assert bent_gap > 0.19
    assert skin < 0.0 < area
    assert area / -skin == pytest.approx(ratio, abs=0.01)
    assert thin == pytest.approx(gap, rel=1e-7, abs=5e-3)
