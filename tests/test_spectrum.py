"""Spectra: Parseval's theorem, known tones, the confidence interval of a density, and refused arguments."""

import math
import pickle
from pathlib import Path

import numpy as np
import pytest

import fingerspice as fs
from fingerspice.results.spectrum import equivalent_segments, interval
from scenes import deck, listed, refuses, table1, warns

RATE = 8000.0


def resistor(source: fs.Waveform, stop: float, **options: object) -> fs.Solution:
    """The source alone: a signal that is known exactly."""
    circuit = deck("V1 a 0 DC 1", "R1 a 0 1k", ".tran 125u 1")
    return fs.simulate(circuit, sources={"V1": source}, t_stop=stop, **options)  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def sine() -> fs.Solution:
    return fs.simulate(table1())


@pytest.fixture(scope="module")
def noise() -> fs.Solution:
    values = np.random.default_rng(1).standard_normal(24_001)
    return resistor(fs.Samples(values, rate=RATE), 3.0, t_eval=np.arange(24_000) / RATE)


def test_the_lines_are_the_tones_of_the_source_and_those_of_a_square_its_fourier_series() -> None:
    tones = fs.Sine(3.0, 100.0) + fs.Sine(0.5, 300.0, phase_deg=40.0) + 2.0
    found = resistor(tones, 0.05).spectrum("u_source")
    expected = np.zeros(found.frequency.size)
    expected[[0, 2]] = 3.0, 0.5
    np.testing.assert_allclose(found.frequency, 100.0 * np.arange(1, 1001))
    np.testing.assert_allclose(found.amplitude, expected, rtol=0, atol=1e-11)
    assert found.mean == pytest.approx(2.0, rel=1e-12)
    assert found.variance == pytest.approx(0.5 * (3.0**2 + 0.5**2), rel=1e-12)

    found = resistor(fs.Square(2.0, 100.0), 0.05).spectrum("u_source", highest=50e3)
    n = np.arange(1, 501)
    np.testing.assert_allclose(found.amplitude, np.where(n % 2, 8.0 / (math.pi * n), 0.0), rtol=0, atol=1e-9)


def test_half_the_squares_of_the_lines_are_the_variance(sine: fs.Solution, tmp_path: Path) -> None:
    summary = sine.summary()
    found = sine.spectrum("u_gap")
    variance = summary["u_gap_rms_periodic"] ** 2 - summary["u_gap_mean_periodic"] ** 2
    assert found.shown_variance == pytest.approx(variance, rel=1e-9)
    assert found.amplitude[0] == pytest.approx(summary["u_gap_amplitude"], rel=1e-9)
    friction = sine.spectrum()
    assert friction.shown_variance == pytest.approx(friction.variance, rel=1e-9)
    assert friction.mean == pytest.approx(summary["f_t_mean_periodic"], rel=1e-9)
    read = fs.load(sine.to_netcdf(tmp_path / "x.nc")).spectrum()
    np.testing.assert_allclose(read.amplitude, friction.amplitude, rtol=0, atol=1e-11)  # type: ignore[arg-type]


def test_a_run_whose_last_period_repeats_an_earlier_one_is_read_with_its_lines(tmp_path: Path) -> None:
    # The steps in its file had the times of the earlier period, and its lines were lost.
    run = fs.simulate(table1("SIN(0 200 5k)"), t_stop=0.02, rtol=1e-6)
    assert run.stats["repeated"] > 20
    again = fs.load(run.to_netcdf(tmp_path / "x.nc"))
    for signal in ("f_t", "u_gap", "u_source"):
        one, other = run.spectrum(signal), again.spectrum(signal)
        np.testing.assert_allclose(other.amplitude, one.amplitude, rtol=0, atol=1e-11 * one.amplitude[0] + 1e-11)


def test_the_lines_do_not_depend_on_the_outputs() -> None:
    few, many = (fs.steady_state(table1(), points=n).solution.spectrum() for n in (5, 400))
    np.testing.assert_allclose(few.amplitude, many.amplitude, rtol=0, atol=1e-10)


def test_charge_and_current_have_the_lines_of_their_outputs() -> None:
    run = fs.simulate(table1(), area="frozen", start="periodic", t_stop=0.02, t_eval=np.linspace(0.0, 0.02, 2001))
    charge, current = run.spectrum("q_source"), run.spectrum("i_source")
    assert current.amplitude[0] == pytest.approx(2.0 * np.pi * 100.0 * charge.amplitude[0], rel=1e-6)
    assert charge.amplitude[1:20].max() <= 1e-6 * charge.amplitude[0]


def test_the_integral_of_a_tones_density_is_its_variance() -> None:
    solution = resistor(fs.Sine(3.0, 500.0), 1.0)
    found = solution.spectrum("u_source", method="welch", resolution=10.0)
    assert found.resolution == pytest.approx(10.0)
    assert found.shown_variance == pytest.approx(4.5, rel=1e-4)
    assert found.frequency[found.density.argmax()] == pytest.approx(500.0)


def test_the_interval_covers_the_density_of_white_noise_and_narrows_with_the_resolution(noise: fs.Solution) -> None:
    with pytest.warns(fs.FingerspiceWarning, match="folded"):
        found, coarse, fine = (noise.spectrum("u_source", resolution=f) for f in (None, 50.0, 2.0))
    inside = slice(2, -2)
    true = 2.0 / RATE
    covered = np.mean((found.lower[inside] <= true) & (true <= found.upper[inside]))
    assert abs(covered - 0.95) < 0.01
    assert found.shown_variance == pytest.approx(found.variance, rel=0.01)
    assert coarse.segments > 20 * fine.segments
    low, high = interval(1e6)
    assert (low, high) == pytest.approx((1.0, 1.0), abs=3e-3)


def test_overlapping_segments_count_as_fewer() -> None:
    box, hann = np.ones(100), np.sin(np.pi * np.arange(100) / 100) ** 2
    assert equivalent_segments(box, 100, 7) == 7.0
    # Boxes that overlap by half are correlated by 1/2, and Hann windows by 1/6.
    assert equivalent_segments(box, 50, 9) == pytest.approx(9.0 / (1.0 + 2.0 * (8.0 / 9.0) / 4.0))
    assert equivalent_segments(hann, 50, 9) == pytest.approx(9.0 / (1.0 + 2.0 * (8.0 / 9.0) / 36.0))


def test_the_rows_that_jumps_add_are_left_out() -> None:
    # The jumps lie between the outputs, and two lie on outputs.
    solution = resistor(fs.PWL((0.0, 0.1, 0.1, 0.20003, 0.20003, 1.0), (0.0, 0.0, 1.0, 1.0, 0.0, 0.0)), 1.0)
    assert np.any(np.diff(solution.t) == 0.0)
    found = solution.spectrum("u_source")
    inside = (np.arange(8001) >= 800) & (np.arange(8001) <= 1600)
    assert found.variance == pytest.approx(np.var(inside), rel=1e-3)
    # From a time on, after which it is constant.
    assert solution.spectrum("u_source", since=0.5).variance == pytest.approx(0.0, abs=1e-20)


def test_outputs_too_rare_for_the_force_are_told() -> None:
    # The force of a sine of 3 kHz has 6 kHz, which half the rate of the outputs has to reach.
    rare, often = (
        fs.simulate(table1(), sources=fs.Chirp(100.0, 3e3, 3.001e3, 0.02), t_eval=np.arange(0.0, 0.02, h), rtol=1e-6)
        for h in (100e-6, 60e-6)
    )
    warns(r"half the rate of the outputs, 5000 Hz.*shorter step", rare.spectrum)
    often.spectrum()


def test_a_period_that_is_not_yet_periodic_is_told() -> None:
    circuit = deck("V1 a 0 SIN(5 1 100)", "R1 a b 1meg", "C1 b 0 100n", ".tran 100u 20m uic")
    warns("start='periodic'", fs.simulate(circuit).spectrum, "v:b")
    fs.simulate(circuit, start="periodic").spectrum("v:b")


@pytest.mark.parametrize("jumps", ["both", "none"])
def test_a_signal_that_jumps_at_the_end_of_its_period_is_periodic(jumps: str) -> None:
    square = fs.simulate(table1("SQUARE(200 100)"), start="periodic", t_stop=0.01, jumps=jumps)
    found = square.spectrum("u_gap")
    assert 0.99 < found.shown_variance / found.variance < 1.0


@pytest.mark.parametrize(("options", "said"), [*listed("spectra"), ({"resolution": math.nan}, "a number of Hz, > 0")])
def test_what_a_spectrum_refuses(sine: fs.Solution, options: dict[str, object], said: str) -> None:
    refuses(said, sine.spectrum, **options)


def test_uneven_outputs_are_refused_with_the_remedy() -> None:
    solution = resistor(fs.PWL((0.0, 1.0), (0.0, 1.0)), 1.0, t_eval=np.linspace(0.0, 1.0, 500) ** 2)
    refuses(r"not evenly spaced.*\.tran line's step, or even times in t_eval", solution.spectrum, "u_source")
    refuses("holds no whole period", solution.spectrum, "u_source", method="lines")


def test_two_fingers_have_a_spectrum_each() -> None:
    circuit = fs.read_netlist(Path(__file__).parents[1] / "circuits" / "two_fingers.cir")
    solution = fs.simulate(circuit, rtol=1e-6)
    refuses(r"2 columns.*f_t:Xfirm\.Xgap, f_t:Xlight\.Xgap", solution.spectrum)
    firm, light = (solution.spectrum(f"f_t:{name}") for name in solution.gaps)
    assert firm.shown_variance > light.shown_variance > 0.0


def test_a_spectrum_is_read_only_and_shown_as_text_and_picture(sine: fs.Solution, noise: fs.Solution) -> None:
    lines = sine.spectrum()
    density = warns("folded", noise.spectrum, "u_source")
    for found in (lines, pickle.loads(pickle.dumps(lines))):
        assert not found.amplitude.flags.writeable
    assert "200 Hz" in str(lines)
    assert "independent segments" in str(density)
    assert [f.axes[0].get_ylabel() for f in (lines.plot(), density.plot())] == [
        "Friction force: amplitude [N]",
        "Source voltage: density [V²/Hz]",
    ]
    flat = resistor(fs.DC(1.0), 0.05).spectrum("u_source")
    flat.plot().savefig(Path("/dev/null"), format="png")
