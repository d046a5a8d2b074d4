"""The dispersive stratum corneum: its ladder, its fit, and its effect in every tier."""

import re
from pathlib import Path

import numpy as np
import pytest

import analytic as ref
import fingerspice as fs
from fingerspice.circuit.describe import energy_outside
from fingerspice.physics.materials import EPS0, SKIN_BAND, SKIN_LADDER, skin_permittivity, skin_resistivity
from scenes import CIRCUITS, cases, dispersive_deck, every_law, refuses, table1_deck, warns

BAND = np.geomspace(*SKIN_BAND, 401)
D = 350e-6
AREA = 34.8e-6


def admittivity(f: np.ndarray) -> np.ndarray:
    """Eqs. 18 and 19 as one complex number, S/m."""
    return np.asarray(1.0 / skin_resistivity(f) + 2j * np.pi * f * EPS0 * skin_permittivity(f))


def eqs_18_19(f: np.ndarray) -> np.ndarray:
    """The same as rows of data."""
    return np.column_stack([f, skin_resistivity(f), skin_permittivity(f)])


def dispersive(source: str = "SIN(0 200 100)", library: str = "fingerspice.lib") -> fs.Circuit:
    """Table 1's deck with the dispersive skin."""
    return fs.parse_netlist(dispersive_deck(source, library=library))


def cells() -> tuple[ref.Layer, ...]:
    """Coating, gap and the cells of the skin, for the independent reference."""
    eps_r, rho = SKIN_LADDER.cells()
    coat, gap, _ = ref.table1_layers(100.0)
    return (coat, gap, *(ref.Layer(EPS0 * e / D, r_area=r * D) for e, r in zip(eps_r, rho, strict=True)))


def gap_gain(f: np.ndarray) -> np.ndarray:
    """Phasor of the gap voltage over the source's at AREA, from the admittivity of the ladder."""
    s = 2j * np.pi * f
    coat, gap, _ = ref.table1_layers(100.0)
    z = [1.0 / (s * x.c * AREA + 1.0 / x.r_total) for x in (coat, gap)]
    p, k = np.array(SKIN_LADDER.poles), np.array(SKIN_LADDER.weights)
    y = SKIN_LADDER.conductivity + s * EPS0 * SKIN_LADDER.eps_inf + (s[..., None] * k / (s[..., None] + p)).sum(-1)
    return np.asarray(z[1] / (z[0] + z[1] + D / (y * AREA)))


def test_the_ladder_is_equations_18_and_19_over_the_band() -> None:
    misfit = np.abs(SKIN_LADDER.admittivity(BAND) / admittivity(BAND) - 1.0)
    assert np.sqrt(np.mean(misfit**2)) <= 0.021
    assert misfit.max() <= 0.035
    assert len(SKIN_LADDER.poles) <= 8
    assert min(SKIN_LADDER.eps_inf, SKIN_LADDER.conductivity, *SKIN_LADDER.weights) > 0.0


def test_a_refit_gives_the_numbers_in_the_package() -> None:
    fit = fs.fit_material(eqs_18_19(np.geomspace(*SKIN_BAND, 161)))
    assert len(fit.ladder.poles) == len(SKIN_LADDER.poles)
    for name in ("conductivity", "eps_inf", "poles", "weights"):
        np.testing.assert_allclose(getattr(fit.ladder, name), getattr(SKIN_LADDER, name), rtol=2e-3, err_msg=name)
    assert fit.rms <= 0.021
    assert fit.kramers_kronig.rms == pytest.approx(0.0198, abs=2e-4)


def test_cells_in_series_are_the_branches_side_by_side() -> None:
    f = np.geomspace(1e-3, 1e9, 301)
    eps_r, rho = SKIN_LADDER.cells()
    assert eps_r.size == len(SKIN_LADDER.poles) + 1
    assert min(eps_r.min(), rho.min()) > 0.0
    series = sum(1.0 / (1.0 / r + 2j * np.pi * f * EPS0 * e) for e, r in zip(eps_r, rho, strict=True))
    np.testing.assert_allclose(series * SKIN_LADDER.admittivity(f), 1.0, rtol=1e-12)


@pytest.mark.parametrize("library", ["fingerspice.lib", "fingerspice_mobile.lib"])
def test_the_libraries_hold_the_cells_of_the_package(library: str) -> None:
    body = re.search(r"\.subckt SKIN_DISPERSIVE.*?\.ends", (CIRCUITS / library).read_text(), re.DOTALL)
    assert body is not None
    slabs = re.findall(r"SLAB d=\{d\} eps_r=(\S+) rho=(\S+)", body.group())
    np.testing.assert_allclose(np.array(slabs, float).T, SKIN_LADDER.cells(), rtol=1e-12)


def test_debye_terms_are_found_again() -> None:
    terms = ((900.0, 2e-3, 0.0), (80.0, 4e-5, 0.0))
    fit = fs.fit_material(fs.ColeCole(12.0, terms, 1e-5), poles=2)
    assert fit.largest <= 1e-6
    assert fit.ladder.eps_inf == pytest.approx(12.0, rel=1e-4)
    assert fit.ladder.conductivity == pytest.approx(1e-5, rel=1e-4)
    np.testing.assert_allclose(fit.ladder.poles, [1.0 / t for _, t, _ in terms], rtol=1e-4)
    np.testing.assert_allclose(fit.ladder.weights, [EPS0 * d / t for d, t, _ in terms], rtol=1e-4)


@pytest.mark.filterwarnings("ignore:the ladder misses the data")
@pytest.mark.parametrize("error", [0.05, 0.01, 1e-3])
def test_more_branches_are_taken_for_less_error(error: float) -> None:
    material = fs.ColeCole(5.0, ((1000.0, 1e-3, 0.2), (60.0, 3e-6, 0.1)), 2e-5)
    fit = fs.fit_material(material, error=error)
    f = np.geomspace(10.0, 1e5, 300)
    misfit = np.abs(fit.ladder.admittivity(f) / material.admittivity(f) - 1.0)
    assert np.sqrt(np.mean(misfit**2)) <= 1.1 * error
    assert fs.fit_material(material, poles=len(fit.ladder.poles) - 1).rms > error
    assert fit.kramers_kronig.rms <= 1e-4


def test_inconsistent_data_are_reported() -> None:
    rows = eqs_18_19(np.geomspace(*SKIN_BAND, 81))
    rows[40, 1] *= 2.0
    report = fs.fit_material(rows, poles=5).kramers_kronig
    assert report.largest > 0.15
    assert report.frequency[np.argmax(report.misfit)] == pytest.approx(1e3, rel=1e-9)


def test_bad_requests_are_refused(tmp_path: Path) -> None:
    rows = eqs_18_19(np.geomspace(*SKIN_BAND, 21))
    for call, says in (
        (lambda: fs.fit_material(rows, poles=3, error=0.1), "one of them"),
        (lambda: fs.fit_material(rows, poles=0), "poles is 0"),
        (lambda: fs.fit_material(rows, error=0.0), "error is 0"),
        (lambda: fs.fit_material(tmp_path / "missing.csv"), "does not exist"),
        (lambda: fs.ColeCole(1.0, ((1.0, 1.0, 1.0),)), "alpha is 1"),
        (lambda: fs.fit_material(rows, poles=3).to_netlist("my skin"), "name is 'my skin'"),
    ):
        refuses(says, call)


@every_law
def test_a_fitted_material_in_a_netlist_is_the_device_of_the_same_ladder(law: str) -> None:
    fit = fs.MaterialFit(SKIN_LADDER, 0.0, 0.0, BAND, BAND, None, BAND)  # type: ignore[arg-type]
    text = table1_deck(extra=fit.to_netlist("MYSKIN"))
    own = fs.parse_netlist(re.sub(r"SKIN +d=(\S+) +f=\S+", r"MYSKIN d=\1", text))
    t = np.linspace(0.0, 0.02, 101)
    a, b = (fs.simulate(c, t_stop=0.02, t_eval=t, rtol=1e-9, charge_law=law) for c in (own, dispersive()))
    assert np.abs(a.u_gap - b.u_gap).max() <= 1e-8 * np.abs(b.u_gap).max()


def periodic(waveform: fs.Waveform, t: np.ndarray) -> np.ndarray:
    """Gap voltage at phases t of the periodic state at AREA, by the linear tier."""
    assert waveform.period is not None
    circuit = dispersive().replace({"Vdrive": waveform})
    run = fs.simulate(circuit, area=AREA, start="periodic", t_stop=waveform.period, t_eval=t, rtol=1e-12)
    assert run.plan.tier == "linear"
    return np.asarray(run.u_gap)


def lines(amplitudes: np.ndarray, frequencies: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Sum of the phasors of lines Im(a exp(i w t)) through the gap's gain."""
    phasors = amplitudes * gap_gain(frequencies)
    return np.asarray((phasors[:, None] * np.exp(2j * np.pi * frequencies[:, None] * t)).imag.sum(axis=0))


def test_a_square_is_the_superposition_of_its_phasors() -> None:
    f0, n = 130.0, np.arange(1, 400_001, 2)
    t = (np.arange(12) + 0.5) / 24.0 / f0
    # The jump and the slope after it are known in closed form: what is left falls with the cube of the harmonic.
    top = 1e13
    share = gap_gain(np.array([top])).real[0]
    leak = (2j * np.pi * top * (gap_gain(np.array([top])) - share)).real[0]
    want = np.zeros(t.size)
    for part in np.array_split(n, 40):
        f = part * f0
        rest = gap_gain(f) - share - leak / (2j * np.pi * f)
        want += ((800.0 / np.pi / part * rest)[:, None] * np.exp(2j * np.pi * f[:, None] * t)).imag.sum(axis=0)
    # A square of 200 V, and its integral: a triangle of mean zero.
    want += 200.0 * share + leak * 200.0 * (t - 0.25 / f0)
    got = periodic(fs.Square(200.0, f0), t)
    assert np.abs(got - want).max() <= 1e-9 * np.abs(want).max()


def test_am_and_noise_are_the_superposition_of_their_phasors() -> None:
    t = np.linspace(0.0, 0.02, 77)
    got = periodic(fs.AM(200.0, 5000.0, 50.0), t)
    # (1 + sin(w t)) sin(W t) / 2: the carrier, and half of it in lines beside.
    f = np.array([5000.0, 4950.0, 5050.0])
    a = np.array([100.0, 50.0j, -50.0j])
    want = lines(a, f, t)
    assert np.abs(got - want).max() <= 1e-9 * np.abs(want).max()
    rng = np.random.default_rng(7)
    f, a, phase = 50.0 * np.arange(1, 61), rng.uniform(1.0, 9.0, 60), rng.uniform(-180.0, 180.0, 60)
    noise = fs.Sum(tuple(fs.Sine(x, y, phase_deg=z) for x, y, z in zip(a, f, phase, strict=True)))
    want = lines(a * np.exp(1j * np.radians(phase)), f, t)
    assert np.abs(periodic(noise, t) - want).max() <= 1e-9 * np.abs(want).max()


@every_law
@pytest.mark.parametrize("shape", ["sine", "square"])
def test_the_coupled_run_is_the_independent_references(shape: str, law: str) -> None:
    f, periods, rtol = 100.0, cases(3, 1), 1e-9
    segments, waveform = ref.square_segments(200.0, f, periods), fs.Square(200.0, f)
    if shape == "sine":
        segments, waveform = ref.sine_segments(200.0, f, periods / f), fs.Sine(200.0, f)
    t = (np.arange(90) + 0.5) / 90.0 * periods / f
    exact = ref.transient(segments, t, law=law, layers=cells())
    run = fs.simulate(
        dispersive().replace({"Vdrive": waveform}), t_stop=periods / f, t_eval=t, rtol=rtol, charge_law=law
    )
    true = np.abs(run.u_gap - exact.u_gap).max()
    assert true <= rtol * np.abs(exact.u_gap).max()
    assert true <= run.error.u_gap <= rtol * np.abs(exact.u_gap).max() * 1.01
    assert np.abs(run.q_source - exact.q).max() <= 10.0 * rtol * np.abs(exact.q).max()
    # The skin is one layer for its user.
    assert run.layers == ("Xcoat", "Xgap", "Xskin")
    assert np.abs(run.u_layer[:, 2] - exact.u[:, 2:].sum(axis=1)).max() <= rtol * 200.0


def test_phasors_use_the_same_ladder() -> None:
    f = np.geomspace(*SKIN_BAND, 21)
    solution = fs.phasor(dispersive(), f, area=AREA)
    np.testing.assert_allclose(solution.gain, gap_gain(f), rtol=1e-12)


@every_law
def test_the_periodic_state_is_reached_from_the_operating_point_too(law: str) -> None:
    circuit = dispersive("SIN(5 150 300)")
    state = fs.steady_state(circuit, charge_law=law, rtol=1e-8)
    late = fs.simulate(circuit, charge_law=law, rtol=1e-8, start="dc", t_stop=0.2, t_eval=0.15 + state.solution.t[:-1])
    peak = np.abs(late.u_gap).max()
    assert np.abs(late.u_gap - state.solution.u_gap[:-1]).max() <= 3e-8 * peak


def test_a_loose_error_lets_a_sine_take_the_skin_at_its_frequency() -> None:
    circuit = dispersive()
    loose = fs.simulate(circuit, rtol=0.1, t_stop=0.05)
    assert any("skin at 100 Hz" in r for r in loose.plan.reasons)
    tight = fs.simulate(circuit, rtol=1e-6, t_stop=0.05)
    assert any("skin dispersive" in r for r in tight.plan.reasons)
    true = np.abs(loose.u_gap - tight.u_gap).max()
    assert 0.0 < true <= loose.error.u_gap <= 0.1 * np.abs(loose.u_gap).max()
    assert np.abs(loose.f_el - tight.f_el).max() <= loose.error.f_el


def test_no_single_frequency_stands_for_a_broad_spectrum_and_a_plain_skin_is_not_touched() -> None:
    ramps = fs.PWL((0.0, 5e-3, 9e-3, 0.05), (0.0, 200.0, -100.0, 30.0))
    for waveform in (fs.Square(200.0, 100.0), fs.Chirp(200.0, 20.0, 2e3, 0.05), ramps):
        plan = fs.plan(dispersive().replace({"Vdrive": waveform}), rtol=0.01, t_stop=0.05)
        assert any("skin dispersive" in r for r in plan.reasons)
    plan = fs.plan(fs.parse_netlist(table1_deck()), rtol=0.1)
    assert not any("skin" in r for r in plan.reasons)


OUTSIDE = {
    "SIN(0 200 2)": "100 % below 10 Hz", "SIN(100 100 1k)": "67 % below 10 Hz",
    "SIN(0 200 300k)": "100 % above 100 kHz", "SQUARE(200 20k)": "above 100 kHz",
}  # fmt: skip


@pytest.mark.parametrize("source", OUTSIDE)
def test_energy_outside_the_data_is_warned_about(source: str) -> None:
    warns(OUTSIDE[source], fs.simulate, dispersive(source), t_stop=2e-3, rtol=1e-4)


@pytest.mark.parametrize(
    "waveform",
    [fs.Sine(200.0, 100.0), fs.Square(200.0, 100.0), fs.AM(200.0, 5e3, 50.0), fs.Chirp(200.0, 20.0, 20e3, 0.04)],
    ids=["sine", "square", "AM", "chirp"],
)
def test_energy_inside_is_not(waveform: fs.Waveform, recwarn: pytest.WarningsRecorder) -> None:
    run = fs.simulate(dispersive().replace({"Vdrive": waveform}), t_stop=0.04, rtol=1e-4)
    assert run.warnings == ()
    assert not recwarn.list


def test_the_share_above_the_band_is_that_of_the_squares_harmonics() -> None:
    below, above = energy_outside(fs.Square(200.0, 3000.0), 1.0)
    n = np.arange(1, 34, 2)
    assert below == pytest.approx(0.0, abs=1e-12)
    assert above == pytest.approx(1.0 - (8.0 / np.pi**2 / n**2).sum(), rel=0.02)


@pytest.mark.parametrize("layer", ["LAYER d=1u eps_r=3.9 r=0.2meg e_max=1meg", "SLAB d=1u eps_r=3.9 rho=1g e_max=1meg"])
def test_a_dielectric_beyond_its_strength_is_warned_about(layer: str) -> None:
    text = re.sub(r"LAYER d=1u eps_r=3.9 r=\S+", layer, table1_deck("SIN(0 200 5k)", 5000.0))
    with pytest.warns(fs.FingerspiceWarning, match=r"the field in Xcoat reaches \S+ V/m.*strength is 1e\+06 V/m"):
        run = fs.simulate(fs.parse_netlist(text), t_stop=1e-3, rtol=1e-6)
    field = np.abs(run.u_layer[:, 0]).max() / 1e-6
    assert field > 1e6
    strong = fs.parse_netlist(text.replace("e_max=1meg", f"e_max={field * 1.001}"))
    assert fs.simulate(strong, t_stop=1e-3, rtol=1e-6).warnings == ()
