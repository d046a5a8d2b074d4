"""Estimated perception: the skin's mechanics, the thresholds against their sources, levels, and the command line."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import fingerspice as fs
from commands import Command
from fingerspice import studies
from fingerspice.studies.feel import FINGERPAD, GRAVITY, SkinMechanics, Threshold, android_threshold, feel
from scenes import deck, listed, refuses, table1

ROOT = Path(__file__).parents[1]
EPS0, D, MU, LOAD = 8.854e-12, 3.5e-6, 0.3, 0.5
#: Some points of Android's array, as its source has them.
ANDROID = {0.4: -97.81, 2.0: -69.86, 10.37: -48.52, 72.0: -31.55, 103.68: -31.77, 200.0: -30.86, 400.0: -19.81}
FLAT = Threshold("flat", (1.0, 1000.0), (0.0, 0.0))


@pytest.fixture(scope="module")
def frozen() -> fs.Solution:
    """A periodic run whose friction is that of a sine: the area does not change."""
    return fs.simulate(table1(), area="frozen", start="periodic", t_stop=0.01)


@pytest.mark.parametrize("frequency", [20.0, 160.0, 700.0])
def test_the_skin_moves_as_its_equation_of_motion_says(frequency: float) -> None:
    skin = SkinMechanics("any", 2e-4, 0.4, 1.5e3)
    omega = 2.0 * math.pi * frequency

    def motion(t: float, y: np.ndarray) -> list[float]:
        force = math.sin(omega * t)
        return [y[1], (force - skin.damping * y[1] - skin.stiffness * y[0]) / skin.mass]

    # The free motion dies away with mass / damping, 1 ms at most.
    period = 1.0 / frequency
    begin = math.ceil(0.1 / period) * period
    t = begin + np.linspace(0.0, period, 33)[:-1]
    found = solve_ivp(motion, (0.0, t[-1]), [0.0, 0.0], t_eval=t, method="DOP853", rtol=1e-10, atol=1e-16)
    amplitude = 2.0 * np.mean(found.y[0] * np.exp(-1j * omega * t)) * 1j
    np.testing.assert_allclose(skin.displacement(np.array([frequency]))[0], amplitude, rtol=1e-6)
    np.testing.assert_allclose(skin.acceleration(np.array([frequency]))[0], -(omega**2) * amplitude, rtol=1e-6)


def test_skin_and_thresholds_are_those_of_their_sources() -> None:
    assert (studies.feel.DIFFERENCE_DB, studies.feel.WEBER_FRICTION) == (1.21, 0.11)
    # The fingerpad is a spring at low and a mass at high frequencies.
    assert (FINGERPAD.mass, FINGERPAD.damping, FINGERPAD.stiffness) == (1e-4, 1.0, 1e3)
    low, high = np.abs(FINGERPAD.displacement(np.array([0.1]))), np.abs(FINGERPAD.acceleration(np.array([1e6])))
    np.testing.assert_allclose([low[0], high[0]], [1e-3, 1e4], rtol=1e-5)
    table = android_threshold()
    assert table.frequency.size == 41
    assert (table.frequency[0], table.frequency[-1]) == (0.4, 400.0)
    found = table.acceleration(np.array(list(ANDROID)))
    np.testing.assert_allclose(found, GRAVITY * 10.0 ** (np.array(list(ANDROID.values())) / 20.0), rtol=1e-12)
    # Decibels are linear in frequency between two points: 15 Hz has -44.35, 17.92 Hz has -41.96.
    middle = table.acceleration(np.array([16.46]))[0]
    assert 20.0 * math.log10(middle / GRAVITY) == pytest.approx(-43.155, abs=1e-9)
    assert np.isnan(table.acceleration(np.array([0.3, 401.0]))).all()


def test_the_tables_head_has_licence_and_origin() -> None:
    text = (ROOT / "src/fingerspice/studies/least_perceptible_acceleration.csv").read_text()
    head = "".join(line for line in text.splitlines() if line.startswith("#"))
    for said in ("Android Open Source Project", "Apache License, Version 2.0", "BasicToPwleSegmentAdapter.java"):
        assert said in head
    assert "least_perceptible_acceleration.csv" in (ROOT / "NOTICE").read_text()
    assert "Apache License" in (ROOT / "LICENSES" / "Apache-2.0.txt").read_text()


def test_the_level_of_a_sines_friction_is_that_of_the_formula(frozen: fs.Solution) -> None:
    found = feel(frozen, threshold=FLAT)
    area = float(frozen.area[0])
    # With a constant area the friction of a sine is one line at twice its frequency.
    force = MU * EPS0 * area * frozen.u_gap_amplitude**2 / (4.0 * D**2)
    omega = 2.0 * math.pi * 200.0
    size = omega**2 * force / abs(1e3 - 1e-4 * omega**2 + 1j * omega)
    place = found.strongest
    assert found.frequency[place] == pytest.approx(200.0)
    assert found.force[place] == pytest.approx(force, rel=1e-7)
    assert found.displacement[place] == pytest.approx(size / omega**2, rel=1e-7)
    assert found.acceleration[place] == pytest.approx(size, rel=1e-7)
    assert found.highest == pytest.approx(20.0 * math.log10(size), abs=1e-6)
    assert found.steps == pytest.approx(20.0 * math.log10(size) / 1.21, rel=1e-6)
    mean = MU * LOAD + force
    assert found.change == pytest.approx(2.0 * force / (mean + force), rel=1e-7)
    assert found.change_felt


def test_what_is_weak_or_too_fast_is_not_felt() -> None:
    weak = feel(fs.simulate(table1("SIN(0 2 100)"), start="periodic", t_stop=0.01))
    assert (weak.felt, weak.steps, weak.change_felt) == (False, None, False)
    assert "below the threshold" in weak.verdict()
    fast = feel(fs.simulate(table1("SIN(0 200 5k)", f=5e3), start="periodic", t_stop=2e-4))
    assert (fast.felt, fast.highest) == (False, None)
    assert "no part of the friction" in fast.verdict()


@pytest.mark.parametrize("frequency", [200.0, 240.0, 499.0])
@pytest.mark.parametrize("amplitude", [1.0, 150.0])
def test_friction_beyond_the_table_is_felt_not_felt_or_not_known(frequency: float, amplitude: float) -> None:
    run = fs.simulate(table1(f"SIN(0 {amplitude} {frequency})", f=frequency), start="periodic", t_stop=0.01, rtol=1e-5)
    table = android_threshold()
    # What may be felt is felt if the threshold stays where its table ends.
    longer = Threshold("longer", [*table.frequency, 1e3], [*table.level, table.level[-1]], table.reference)
    possible, found = feel(run, threshold=longer), feel(run)
    assert possible.felt is (amplitude == 150.0)
    assert found.felt is (None if possible.felt and frequency > 200.0 else possible.felt)
    if frequency > 200.0:
        assert found.unjudged.level == pytest.approx(possible.highest, abs=1e-9)
        assert f"at {2 * frequency:g} Hz, outside the threshold's frequencies" in found.verdict()
        assert found.change_felt is found.felt


def test_friction_below_the_table_is_compared_by_its_displacement() -> None:
    run = fs.simulate(table1("SIN(0 200 20)", f=20), start="periodic", t_stop=0.05, rtol=1e-5)
    found = feel(run, threshold=Threshold("from 50 Hz", (50.0, 1000.0), (20.0, 20.0)))
    line = int(found.force.argmax())
    # 10 m/s^2 at 50 Hz.
    level = 20.0 * math.log10(found.displacement[line] * (2.0 * math.pi * 50.0) ** 2 / 10.0)
    assert (found.unjudged.frequency, found.unjudged.level) == pytest.approx((40.0, level))
    assert (found.felt, level < 0.0) == (False, True)
    assert "too weak to be felt" in found.verdict()


@pytest.mark.parametrize(("amplitude", "felt"), [(200.0, None), (0.1, False)])
def test_a_run_too_short_to_resolve_its_friction_has_no_verdict(amplitude: float, felt: bool | None) -> None:
    chirp = fs.Chirp(amplitude, 40.0, 60.0, 0.05)
    run = fs.simulate(table1(), sources=chirp, t_stop=0.05, t_eval=np.arange(0.0, 0.05, 1e-4), rtol=1e-5)
    found = feel(run)
    assert found.felt is felt
    assert found.unjudged.slower
    # The friction varies at 80 to 120 Hz, below all bands: its rms about the mean is that of the outputs.
    assert found.unjudged.force == pytest.approx(math.sqrt(2.0) * float(np.std(run.f_t)), rel=0.2)
    assert "which only a longer run resolves" in found.verdict()


@pytest.mark.parametrize("frequency", [15.0, 30.0, 60.0, 180.0])
def test_below_60_hz_squares_are_felt_at_lower_voltages_than_sines_by_their_fast_lines(frequency: float) -> None:
    # Measured by Vardar, Güçlü and Basdogan (2016 and 2017, doi:10.1109/TOH.2017.2704603): at 60 Hz and above squares
    # have no advantage, and what feels squares is the Pacinian channel, which is best at 200 to 300 Hz.
    circuit = table1(skin={"f": frequency})
    waves = fs.Sine(20.0, frequency), fs.Square(20.0, frequency)
    sine, square = (feel(fs.steady_state(circuit, sources=wave, rtol=1e-5).solution) for wave in waves)
    more = square.highest - sine.highest
    if frequency < 60.0:
        assert more > 6.0
        assert 200.0 <= square.frequency[square.strongest] <= 300.0
    else:
        # Here the square loses up to 3.2 dB, a factor of 1.2 of voltage, as every line is judged alone.
        assert more < 1.0


def test_a_source_without_a_period_is_felt_in_third_octaves() -> None:
    # A tone of 80 Hz without a period of its own, so that the force has 160 Hz.
    t = np.arange(0.0, 2.0, 2e-4)
    chirp = fs.Chirp(200.0, 80.0, 80.001, 2.0)
    found = feel(fs.simulate(table1(), sources={"Vdrive": chirp}, area="frozen", t_stop=2.0, t_eval=t, rtol=1e-6))
    tone = feel(fs.simulate(table1("SIN(0 200 80)"), area="frozen", start="periodic", t_stop=0.0125))
    assert (found.kind, tone.kind) == ("bands", "lines")
    place = found.strongest
    assert found.frequency[place] == pytest.approx(1e3 * 2.0 ** (-8 / 3))
    # The band holds all of the tone, whose frequency is not its middle.
    assert found.force[place] == pytest.approx(tone.force.max(), rel=1e-3)
    assert "third octave" in found.verdict()
    np.testing.assert_allclose(np.diff(np.log2(found.frequency)), 1.0 / 3.0)


def test_a_period_with_too_many_lines_is_felt_in_third_octaves() -> None:
    t = np.arange(0.0, 8.0, 5e-4)
    found = feel(fs.simulate(table1(), sources=fs.AM(200, 100, 0.25), t_stop=8.0, t_eval=t, rtol=1e-5))
    assert (found.kind, found.felt) == ("bands", True)
    assert found.frequency[found.strongest] == pytest.approx(198.4, abs=0.1)


def test_bands_add_up_to_the_variance_of_noise() -> None:
    source = fs.Samples(60.0 * np.random.default_rng(3).standard_normal(8000), rate=2000.0)
    t = np.arange(0.0, 3.9, 1e-4)
    solution = fs.simulate(table1(), sources=source, area="frozen", t_stop=3.9, t_eval=t, rtol=1e-5)
    found, spectrum = feel(solution), solution.spectrum()
    low, high = found.frequency[0] / 2.0 ** (1 / 6), found.frequency[-1] * 2.0 ** (1 / 6)
    inside = (spectrum.frequency >= low) & (spectrum.frequency < high)
    expected = spectrum.density[inside].sum() * spectrum.resolution
    assert 0.5 * np.sum(found.force**2) == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize(("kind", "given", "named", "said"), listed("feelings"))
def test_mechanics_and_thresholds_without_sense_are_refused(kind: str, given: list[Any], named: Any, said: str) -> None:
    refuses(said, getattr(studies.feel, kind), *given, **named)


def test_what_cannot_be_felt_is_refused(frozen: fs.Solution) -> None:
    for given, said in (
        ({"signal": "u_gap"}, "'f_t', the friction force"),
        ({"threshold": 3.0}, "a Threshold"),
        ({"mechanics": "soft"}, "a SkinMechanics"),
    ):
        refuses(said, feel, frozen, **given)
    refuses("no GAP", feel, fs.simulate(deck("V1 a 0 SIN(0 1 100)", "R1 a 0 1k", ".tran 1m 20m")))


def test_the_picture_has_the_threshold_and_every_finger() -> None:
    circuit = fs.read_netlist(ROOT / "circuits" / "two_fingers.cir")
    solution = fs.simulate(circuit, sources={"Vdrive": fs.Sine(200.0, 50.0)}, t_stop=0.04, rtol=1e-5)
    firm, light = (feel(solution, f"f_t:{gap}") for gap in solution.gaps)
    (ax,) = firm.plot([light]).axes
    _, names = ax.get_legend_handles_labels()
    assert names[0] == "Android's least perceptible acceleration"
    assert names[1:] == ["skin, lines Xfirm.Xgap", "skin, lines Xlight.Xgap"]
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("Frequency [Hz]", "Acceleration amplitude [m/s²]")
    assert (ax.get_xscale(), ax.get_yscale()) == ("log", "log")
    caption = firm.plot([light]).get_supxlabel().replace("\n", " ")
    assert "held in the hand, not of a bare" in caption
    assert firm.verdict() in caption


def test_run_says_what_is_felt_and_draws_it(command: Command) -> None:
    result = command("run", "pad.cir", "--feel", "--out", "out").ok()
    assert "felt: strongest at 200 Hz" in result.out
    assert "held in the hand" in result.out
    assert Path("out/pad_feel.png").is_file()
    found = json.loads(command("run", "pad.cir", "--feel", "--json", "--no-plot", "--out", "out").out)
    assert [Path(file).name for file in found["files"]] == ["pad.nc"]
    (finger,) = found["feel"]
    assert (finger["felt"], finger["kind"], finger["strongest"]) == (True, "lines", 200.0)
    assert finger["lines"][1].keys() == {"frequency", "force", "displacement", "acceleration", "level_db"}
    document = (ROOT / "docs" / "json.md").read_text()
    assert all(f"`{key}`" in document for key in (*finger, *finger["lines"][0]))
    assert json.loads(command("run", "pad.cir", "--json", "--no-plot", "--out", "out").out)["feel"] is None


def test_run_refuses_to_feel_without_a_gap_before_it_runs(command: Command) -> None:
    Path("rc.cir").write_text("t\nV1 a 0 SIN(0 10 100)\nR1 a 0 1k\n.tran 100u 20m uic\n")
    result = command("run", "rc.cir", "--feel")
    assert (result.code, result.out) == (2, "")
    assert result.lines == ["fingerspice: --feel: the circuit has no GAP, so there is no friction to feel"]
    assert not Path("out").exists()


def test_a_run_whose_friction_cannot_be_judged_keeps_its_files(command: Command) -> None:
    # Ten outputs are too few for a density.
    words = ("run", "pad.cir", "--feel", "--source", "PWL(0 0 1m 200)", "--stop", "0.4m", "--no-plot", "--out", "out")
    command(*words).refused("64 outputs or more")
    assert Path("out/pad.nc").is_file()
