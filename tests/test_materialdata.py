"""Tables of measured materials: units in headers, and the likely slip that is named if the data fit no material."""

import warnings
from pathlib import Path

import numpy as np
import pytest

import fingerspice as fs
from fingerspice.physics.materials import EPS0, SKIN_BAND, skin_permittivity, skin_resistivity
from fingerspice.studies.fit.materialfit import read_table
from scenes import cases, listed

F = np.geomspace(*SKIN_BAND, 41)
RHO, EPS = skin_resistivity(F), skin_permittivity(F)
TABLE = np.column_stack([F, RHO, EPS])


def written(path: Path, head: str, columns: tuple[np.ndarray, ...], mark: str = ",") -> Path:
    """A file of columns with a line of names."""
    rows = "\n".join(mark.join(f"{x:.17g}" for x in row) for row in zip(*columns, strict=True))
    path.write_text(f"{head}\n{rows.replace('.', ',') if mark == ';' else rows}\n", encoding="utf-8")
    return path


@pytest.mark.parametrize(
    ("head", "columns"),
    [
        ("f,rho,eps_r", (F, RHO, EPS)),
        ("frequency [Hz],resistivity [ohm m],relative permittivity [1]", (F, RHO, EPS)),
        ("f (kHz),rho (ohm cm),eps'", (F / 1e3, RHO * 100.0, EPS)),
        ("f_MHz,rho/kΩm,eps_r", (F / 1e6, RHO / 1e3, EPS)),
        ("omega [rad/s],rho,eps_r", (2.0 * np.pi * F, RHO, EPS)),
        ("f [rad/s],rho,eps_r", (2.0 * np.pi * F, RHO, EPS)),
        ("f,sigma [mS/m],eps_r", (F, 1e3 / RHO, EPS)),
        ("f,conductivity / uS/cm,eps_r", (F, 1e4 / RHO, EPS)),
        ("eps_r,f,rho", (EPS, F, RHO)),
        ("sigma [S/m],eps [F/m],frequency [Hz]", (1.0 / RHO, EPS * EPS0, F)),
        ("first,second,third", (F, RHO, EPS)),
        ("eps_r,one,two", (EPS, F, RHO)),
    ],
)
@pytest.mark.parametrize("mark", [",", ";", "\t"])
def test_a_header_says_what_the_columns_are(
    tmp_path: Path, head: str, columns: tuple[np.ndarray, ...], mark: str
) -> None:
    path = written(tmp_path / "skin.csv", head.replace(",", mark), columns, mark)
    np.testing.assert_allclose(read_table(path), TABLE, rtol=1e-12)


ROWS = "\n1,2,3\n2,2,3\n3,2,3\n"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        *listed("materials"),
        (f"f [furlong],rho,eps_r{ROWS}", r"the unit of column 'f \[furlong\]' is not known; allowed: Hz, rad/s, ohm m"),
        (f"f,rho [ohm],eps_r{ROWS}", r"the unit of column 'rho \[ohm\]' is not known"),
        (f"f,rho,sigma{ROWS}", "two columns are a resistivity by their names, f, rho, sigma; allowed: frequency"),
        ('"' + "1" * 140_000, "field larger than field limit"),
    ],
)
def test_files_that_are_no_material_are_refused(tmp_path: Path, text: str, said: str) -> None:
    path = tmp_path / "bad.csv"
    path.write_text(text)
    with pytest.raises(fs.InputError, match=said):
        fs.fit_material(path)


@pytest.mark.parametrize(
    ("order", "power", "factors", "named"),
    [
        ([0, 1, 2], 1, [2.0 * np.pi, 1.0, 1.0], "the frequency is in rad/s"),
        ([0, 1, 2], 1, [1e-3, 1.0, 1.0], "the frequency is in kHz"),
        ([0, 1, 2], 1, [1.0, 100.0, 1.0], "the resistivity is in ohm cm"),
        ([0, 1, 2], 1, [1.0, 1e-3, 1.0], "the resistivity is in kohm m"),
        ([0, 1, 2], -1, [1.0, 1.0, 1.0], "the second column is a conductivity in S/m"),
        ([0, 1, 2], -1, [1.0, 1e3, 1.0], "the second column is a conductivity in mS/m"),
        ([0, 2, 1], 1, [1.0, 1.0, 1.0], "resistivity and permittivity have changed places"),
        ([1, 0, 2], 1, [1.0, 1.0, 1.0], "frequency and resistivity have changed places"),
        ([2, 1, 0], 1, [1.0, 1.0, 1.0], "frequency and permittivity have changed places"),
    ],
)
def test_the_likely_slip_is_named(order: list[int], power: int, factors: list[float], named: str) -> None:
    # A slip of a factor of 6 is a fifth off a material, one of 1000 is none.
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            fs.fit_material((TABLE ** [1, power, 1] * factors)[:, order])
            said = str(caught[0].message)
        except fs.InputError as error:
            said = str(error)
    assert "% (rms) from any causal and passive material (Kramers-Kronig); likely " in said
    assert named in said


def test_data_that_are_no_material_for_no_known_reason_are_warned_about_then_refused() -> None:
    rough = np.random.default_rng(2).normal(size=(F.size, 2))
    some, much = (TABLE * np.column_stack([np.ones(F.size), np.exp(x * rough)]) for x in (0.25, 1.0))
    with pytest.warns(fs.FingerspiceWarning, match=r"the data are .* % .rms. from any causal .*Kramers-Kronig.$"):
        fit = fs.fit_material(some)
    assert 0.1 < fit.kramers_kronig.rms < fit.rms < 0.3
    with pytest.raises(fs.InputError, match=r"passive material \(Kramers-Kronig\); allowed: at most"):
        fs.fit_material(much)


def test_a_drift_too_small_for_a_refusal_is_told_from_noise() -> None:
    material = fs.ColeCole(10.0, ((1e4, 1e-3, 0.1), (100.0, 1e-6, 0.2)), 1e-4)
    y = material.admittivity(F)
    true = np.column_stack([F, 1.0 / y.real, y.imag / (2.0 * np.pi * F * EPS0)])
    drift = true * np.column_stack([np.ones(F.size), np.geomspace(1.0, 1.3, F.size), np.ones(F.size)])
    with pytest.warns(fs.FingerspiceWarning, match=r"the data are 4.4 % \(rms\) from .* along a smooth course, as of"):
        found = fs.fit_material(drift).kramers_kronig
    assert 0.03 < found.rms < 0.1
    assert found.systematic > 0.5
    # As large a misfit by noise is no cause for a warning; several draws, as one may pass by chance.
    for seed in range(cases(10, 4)):
        rough = np.exp(0.05 * np.random.default_rng(seed).normal(size=(F.size, 2)))
        noisy = fs.fit_material(true * np.column_stack([np.ones(F.size), rough])).kramers_kronig
        assert noisy.rms > 0.03
        assert noisy.systematic < 0.5


def test_too_few_poles_are_warned_about_then_refused() -> None:
    broad = fs.ColeCole(5.0, ((1000.0, 1e-3, 0.2), (60.0, 3e-6, 0.1)), 2e-5)
    with pytest.warns(fs.FingerspiceWarning, match="the ladder misses the data by .* % rms; more poles would come"):
        assert 0.1 < fs.fit_material(broad, poles=1).rms < 0.3
    steep = fs.ColeCole(3.0, ((1e6, 1e-2, 0.0), (1e4, 1e-4, 0.0), (100.0, 1e-6, 0.0)), 1e-7, (1.0, 1e7))
    with pytest.raises(fs.InputError, match=r"the ladder misses the data by .* % rms; allowed: at most 30 %, so more"):
        fs.fit_material(steep, poles=1)


def test_a_fit_draws_itself_and_gives_the_lines_for_a_deck(tmp_path: Path) -> None:
    fit = fs.fit_material(TABLE)
    given = TABLE, TABLE[::-1], written(tmp_path / "skin.csv", "f,rho,eps_r", (F, RHO, EPS))
    assert len({fs.fit_material(one, poles=4).ladder for one in given}) == 1
    axes = fit.plot().axes
    np.testing.assert_allclose(axes[0].lines[0].get_ydata(), RHO, rtol=1e-12)
    np.testing.assert_allclose(axes[1].lines[0].get_ydata(), EPS, rtol=1e-12)
    assert np.asarray(axes[2].lines[0].get_ydata()).max() == pytest.approx(100.0 * fit.largest)
    # As the docstring has it.
    (tmp_path / "myskin.lib").write_text(fit.to_netlist("MYSKIN"))
    deck = (Path(__file__).parents[1] / "circuits" / "fingerpad_dispersive.cir").read_text()
    lines = deck.replace("SKIN_DISPERSIVE", "MYSKIN").splitlines()
    (tmp_path / "deck.cir").write_text("\n".join([lines[0], ".include myskin.lib", *lines[1:]]))
    circuit = fs.read_netlist(tmp_path / "deck.cir")
    assert len(circuit.by_device("SLAB")) == len(fit.ladder.poles) + 1
