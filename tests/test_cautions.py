"""Warnings about successful runs: they appear from the stated limits of voltage and area on."""

import math
import re
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.optimize import brentq

import analytic as ref
import fingerspice as fs
from fingerspice.circuit.describe import course_warnings, energy_outside, skin_error
from fingerspice.waveforms.waveform import as_waveform
from scenes import deck, finger, table1, table1_deck
from waveform_cases import CASES

every_kind = pytest.mark.parametrize("beside", ["", "Rbeside drive 0 1meg"], ids=["stack", "network"])


def of(circuit: fs.Circuit, **options: Any) -> list[str]:
    """Warnings of a run of 1 ms, which Python's own show as well."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", fs.FingerspiceWarning)
        run = fs.simulate(circuit, t_stop=1e-3, rtol=1e-6, **options)
    assert [str(w.message) for w in caught] == list(run.warnings)
    return list(run.warnings)


def said(volt: float, beside: str) -> list[str]:
    """What is warned of when a voltage jumps to Table 1's finger, and the area follows it."""
    circuit = table1(f"DC {volt!r}", tran="10u 1m uic", extra=beside)
    return [text for text in of(circuit) if "has no fundamental" not in text]


def jumps_to(u_gap: float) -> float:
    """Source (V) of which the gap takes so much (V) at once; afterwards it has less, for the layers leak."""
    c = [layer.c for layer in ref.table1_layers(100.0)]
    return u_gap * c[ref.GAP] * sum(1.0 / x for x in c)


@every_kind
def test_a_contact_is_warned_about_where_a_fifth_of_it_is_left(beside: str) -> None:
    rest = float(ref.area(0.0))
    u_gap = brentq(lambda u: float(ref.area(u)) - 0.2 * rest, 300.0, 2000.0, xtol=1e-9)
    assert not any("contact area" in text for text in said(jumps_to(0.999 * u_gap), beside))
    (text,) = (text for text in said(jumps_to(1.001 * u_gap), beside) if "contact area" in text)
    assert f"falls to {1e6 * float(ref.area(1.001 * u_gap)):.3g} mm^2, below 20 % of the 35 mm^2 at 0 V" in text


@every_kind
def test_the_breakdown_of_air_is_warned_about_from_300_v_on(beside: str) -> None:
    assert said(jumps_to(299.9), beside) == []
    (text,) = said(jumps_to(300.1), beside)
    assert "reaches 300.1 V; air breaks down above about 300 V" in text


def test_each_of_two_fingers_is_warned_about_by_its_name() -> None:
    drives = f"Vdrive drive 0 {jumps_to(320.0)!r}", f"Vlow low 0 {jumps_to(200.0)!r}"
    fingers = *finger("low", "0", f=100.0), *finger("drive", "0", "area2", "Far", f=100.0)
    (text,) = of(deck(*drives, *fingers, ".tran 10u 1m uic"))
    assert "the gap voltage of XgapFar reaches 320 V" in text


# The circuit -------------------------------------------------------------------------------------------------


def test_a_skin_at_another_frequency_than_the_sources_is_warned_about() -> None:
    assert of(table1()) == []
    (text,) = of(table1(), sources=fs.Square(200, 5000))
    assert text == ("Xskin takes its data at f = 100 Hz, the source's fundamental is 5000 Hz; Xskin.f=5000 would match")
    assert of(table1(), sources=fs.Square(200, 5000), parameters={"Xskin.f": 5000}) == []
    with pytest.warns(fs.FingerspiceWarning, match=r"Xskin\.f=5000 would match"):
        fs.plan(table1(), sources=fs.Square(200, 5000))
    state = fs.steady_state(table1(), sources=fs.Square(200, 5000), rtol=1e-6)
    with pytest.warns(fs.FingerspiceWarning, match=r"Xskin\.f=5000 would match"):
        assert state.solution.warnings == (text,)


def noise(low: float, high: float, rate: float = 32000.0, seconds: float = 0.2) -> fs.Samples:
    """White noise between two frequencies (Hz), 60 V rms."""
    lines = np.fft.rfft(np.random.default_rng(1).standard_normal(round(rate * seconds)))
    f = np.fft.rfftfreq(round(rate * seconds), 1.0 / rate)
    values = np.fft.irfft(np.where((f > low) & (f < high), lines, 0.0))
    return fs.Samples(60.0 * values / values.std(), rate)


@pytest.mark.parametrize(("low", "high", "f"), [(50.0, 1000.0, 100.0), (50.0, 8000.0, 100.0), (20.0, 200.0, 5000.0)])
@every_kind
def test_a_recording_on_a_skin_of_one_frequency_has_its_error(low: float, high: float, f: float, beside: str) -> None:
    wave = noise(low, high)
    text = table1_deck("DC 0", f, tran="50u 0.2 uic", extra=beside)
    one, every = fs.parse_netlist(text), fs.parse_netlist(text.replace(f"SKIN d=350u f={f}", "SKIN_DISPERSIVE d=350u"))
    with pytest.warns(fs.FingerspiceWarning, match="has no fundamental") as caught:
        held = fs.simulate(one, sources=wave, rtol=1e-4, method="exponential")
    right = fs.simulate(every, sources=wave, rtol=1e-4, method="exponential")
    pattern = r"the mean force is about (\S+) % too (large|small); SKIN_DISPERSIVE d=350u"
    ((size, side),) = re.findall(pattern, str(caught[0].message))
    said = float(size) / 100.0 * (1.0 if side == "large" else -1.0)
    # The warning knows the linear response at rest; coupled the error is a little different.
    assert said == pytest.approx(held.f_el_mean / right.f_el_mean - 1.0, rel=0.1)  # type: ignore[operator]


@pytest.mark.parametrize("seconds", [30.0, 33.7, 200.0])
def test_the_error_of_a_long_recording_is_that_of_its_pieces(seconds: float) -> None:
    short, rate = noise(50.0, 1000.0, 8000.0, 2.0), 8000.0
    circuit = table1()
    error = skin_error(circuit, short, 2.0)
    repeated = fs.Samples(np.tile(short.values, math.ceil(seconds / 2.0)), rate)
    assert error is not None
    assert skin_error(circuit, repeated, seconds) == pytest.approx(error, rel=0.05)
    # Below 10 Hz there is nothing, and above a kilohertz only what straight lines add.
    assert energy_outside(repeated, seconds)[0] < 1e-3
    assert sum(energy_outside(repeated, seconds, (40.0, 1100.0))) < 1e-2


def test_the_error_of_skin_data_at_one_frequency_follows_the_circuit_not_the_one_before() -> None:
    circuit, wave = table1(), noise(50.0, 1000.0, 8000.0, 2.0)
    changes: list[dict[str, Any]] = [{}, {"Xgap.d": 7e-6}, {"Vdrive": wave}, {"Xskin.f": 1000.0}, {}]
    for _ in range(2):
        errors = [skin_error(circuit.replace(change), wave, 2.0) for change in changes]
        assert errors == [skin_error(table1().replace(change), wave, 2.0) for change in changes]
    assert len(set(errors)) == 3
    # One that is not finite has none.
    assert skin_error(circuit, as_waveform(lambda t: math.nan * t), 2.0) is None


def test_directives_without_effect_are_warned_about_but_not_those_for_ngspice() -> None:
    (text,) = of(table1(extra=".meas tran top max v(top)\n.nodeset v(area)=35\n.options reltol=1e-4"))
    assert text == ".meas has no effect here"


def test_a_source_that_is_not_named_stays_on_and_is_warned_about() -> None:
    text = table1_deck(skin={"f": 5000}, extra="Vbias bias 0 DC 20")
    circuit = fs.parse_netlist(text.replace("drive 0 SIN(0 200 100)", "drive bias SIN(0 200 5000)"))
    with pytest.warns(fs.FingerspiceWarning, match=r"sources names vdrive only: Vbias stays on, as in the deck"):
        run = fs.simulate(circuit, sources={"vdrive": fs.Sine(100, 5000)}, t_stop=1e-3)
    assert run.u_source[0] == 20.0
    assert [text for text in run.warnings if "stays on" in text]
    assert of(circuit, sources={"Vdrive": fs.Sine(100, 5000), "Vbias": 0}) == []


# Sources that miss the run ------------------------------------------------------------------------------------

NOISE = np.random.default_rng(0).normal(0.0, 50.0, 2001)
ROW = np.arange(2001)
# A source, and what is said of it in a run of 1 ms; nothing of one that is ordinary.
MISSING = {
    "a clock's times": (fs.PWL(1.76e9 + 1e-3 * ROW, NOISE), "probably a clock's: subtract the first"),
    "times in ms": (
        fs.PWL(0.5 + 1e-3 * ROW, NOISE),
        "Vdrive changes from 0.5 s to 2.5 s only, and covers nothing of the "
        "run from 0 s to 0.001 s, in which it stays at 6.287; its times are probably in ms",
    ),
    "times in us": (fs.PWL(50.0 + ROW, NOISE), "probably in ms or us"),
    "a late texture": (fs.Samples(NOISE, 1e6, start=2e-3), "a run to 0.004 s contains it"),
    "before the run": (fs.Samples(NOISE, 1e6, start=-1.0), "from -1 s to -0.998 s only, and covers nothing"),
    "a late burst": (fs.Burst(fs.Sine(100.0, 5e3), 1e-3, delay=2e-3), "it stays at 0; a run to 0.003 s contains it"),
    "a late pulse": (fs.Pulse(5.0, 100.0, delay=2e-3), "from 0.002 s to 0.002 s only, and covers nothing"),
    "late pulses": (fs.Pulse(5.0, 100.0, 2e-3, 0.0, 0.0, 1e-3, 2e-3), "from 0.002 s on only, and covers nothing"),
    "a late sine": (fs.Sine(100.0, 1e3, offset=7.0, delay=2e-3), "in which it stays at 7"),
    "a late step": (fs.Exp(3.0, 100.0, 2e-3, 1e-3, 3e-3, 1e-3), "in which it stays at 3"),
    "a late part of a sum": (fs.Pulse(0.0, 9.0, delay=2e-3) + 5.0, "in which it stays at 5"),
    "a short recording": (fs.Samples(NOISE[:101], 1e9), "0.01 % of the run to 0.001 s"),
    "nothing": (fs.Samples(np.append(np.zeros(2001), NOISE), 1e6), "the sources are 0 all the time, and nothing is"),
    "nothing of a function": (lambda t: 0.0 * t, "the sources are 0 all the time, and nothing is charged"),
    "a short burst": (fs.Burst(fs.Sine(100.0, 5e3), 2e-4, delay=1e-4), None),
    "a short PWL": (fs.PWL((0.0, 1e-6, 2e-6), (0.0, 50.0, 0.0)), None),
    "a texture inside": (fs.Samples(NOISE[:101], 1e6, start=5e-4), None),
    "a step before": (fs.Pulse(0.0, 100.0, delay=-1.0), None),
    "a constant": (fs.DC(5.0), None),
}


@pytest.mark.filterwarnings("ignore:.* has no fundamental")
@pytest.mark.parametrize("name", MISSING)
def test_a_source_that_misses_the_run_is_told_with_the_likely_slip(name: str) -> None:
    source, said = MISSING[name]
    told = [text for text in of(table1(), sources=source) if "fundamental" not in text]
    told = [text for text in told if said is None or "Vdrive rate" not in text]
    assert len(told) == (said is not None), told
    assert all(said in text for text in told)


def test_a_batch_says_that_the_recording_misses_their_run() -> None:
    values = {"Xgap.d": [3e-6, 4e-6]}
    with pytest.warns(fs.FingerspiceWarning, match="Vdrive changes from 0.002 s to 0.004 s only, and covers nothing"):
        found = fs.batch(table1().replace({"Vdrive": fs.Samples(NOISE, 1e6, start=2e-3)}), values, t_stop=1e-3)
    # It stays at its first value.
    held = fs.batch(table1().replace({"Vdrive": fs.DC(float(NOISE[0]))}), values, t_stop=1e-3)
    assert np.allclose(found.f_el_mean, held.f_el_mean, rtol=1e-6, atol=0.0)


def test_a_waveform_is_constant_before_and_after_its_course() -> None:
    for case in CASES:
        first, last = case.waveform.course
        for low, high in ((-1.0, min(first, 1e3)), (max(last, -1.0), 1e3)):
            if low < high < math.inf:
                t = np.random.default_rng(3).uniform(low, high, 200)
                assert np.ptp(case.waveform.value(t)) == 0.0, case.name


def test_no_source_of_a_shipped_deck_misses_its_run() -> None:
    for path in Path(__file__).parents[1].joinpath("circuits").glob("*.cir"):
        circuit = fs.read_netlist(path)
        assert list(course_warnings(circuit, 0.0, circuit.tran.stop, by_deck=True)) == []  # type: ignore[union-attr]


def test_a_recording_that_the_decks_own_end_cuts_off_is_told() -> None:
    circuit = table1("PWL(" + " ".join(f"{i * 1e-5:g} {i % 7}" for i in range(150)) + ")", tran="10u 1m uic")
    said = "the recording ends at 0.00149 s, and the run at the deck's TSTOP = 0.001 s; --stop 0.00149 takes all of it"
    with pytest.warns(fs.FingerspiceWarning, match=re.escape(said)):
        run = fs.simulate(circuit, rtol=1e-6)
    assert any(said in text for text in run.warnings)
    with warnings.catch_warnings():
        warnings.filterwarnings("error", message=".*the recording ends")
        warnings.filterwarnings("ignore", message=".* has no fundamental")
        fs.simulate(circuit, rtol=1e-6, t_stop=1e-3)


@pytest.mark.parametrize(("times", "said"), [
    ([0.0, 20.0, 40.0], "; its times are probably in ms, and count as s here"),
    ([0.0, 4e4], "; its times are probably in ms or us, and count as s here"),
    ([1.76e9, 1.76e9 + 1.0], "; its times are probably a clock's: subtract the first of them"),
    ([0.0, 0.06], "; a run to 0.06 s contains it"),
    ([-1.0, 0.01], "t_stop = 0.04 s"),
])  # fmt: skip
def test_output_times_outside_the_run_are_refused_with_the_likely_slip(times: list[float], said: str) -> None:
    with pytest.raises(fs.InputError, match=r"times from 0 s to t_stop = 0\.04 s") as refused:
        fs.simulate(table1(), t_stop=0.04, t_eval=times)
    assert str(refused.value).endswith(said)
