"""Warnings: values that are legal but unusual, and successful runs beyond stated limits of voltage and area."""

import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.optimize import brentq

import analytic as ref
import fingerspice as fs
import recording_errors
from commands import QUICK, Command
from deck_edits import edited
from fingerspice.base.units import parse_number, spice_text
from fingerspice.circuit.describe import course_warnings, energy_outside, skin_error
from fingerspice.circuit.devices import DEVICES, REST_AREA, SOURCES
from fingerspice.waveforms.waveform import as_waveform
from scenes import deck, finger, heard, listed, refuses, table1, table1_deck, warns
from waveform_cases import CASES

every_kind = pytest.mark.parametrize("beside", ["", "Rbeside drive 0 1meg"], ids=["stack", "network"])


def of(circuit: fs.Circuit, **options: Any) -> list[str]:
    """Warnings of a run of 1 ms, which Python's own show as well."""
    run, said = heard(fs.simulate, circuit, t_stop=1e-3, rtol=1e-6, **options)
    assert said == list(run.warnings)
    return said


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


def test_a_skin_at_another_frequency_than_the_sources_is_warned_about() -> None:
    assert of(table1()) == []
    (text,) = of(table1(), sources=fs.Square(200, 5000))
    assert text == ("Xskin takes its data at f = 100 Hz, the source's fundamental is 5000 Hz; Xskin.f=5000 would match")
    assert of(table1(), sources=fs.Square(200, 5000), parameters={"Xskin.f": 5000}) == []
    warns(r"Xskin\.f=5000 would match", fs.plan, table1(), sources=fs.Square(200, 5000))
    state = fs.steady_state(table1(), sources=fs.Square(200, 5000), rtol=1e-6)
    with pytest.warns(fs.FingerspiceWarning, match=r"Xskin\.f=5000 would match"):
        assert state.solution.warnings == (text,)


def noise(low: float, high: float, rate: float = 32000.0, seconds: float = 0.2) -> fs.Samples:
    """White noise between two frequencies (Hz), 60 V rms."""
    values = recording_errors.noise(1, round(rate * seconds), rate, low, high)
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
    (text,) = of(table1(extra=".plot tran v(top)\n.nodeset v(area)=35"))
    assert text == ".plot has no effect here"


def test_options_without_effect_are_told_by_results_and_files_and_not_warned_of(tmp_path: Path) -> None:
    circuit = table1(extra=".options reltol=1e-4 work=gap\n.option plotwinsize=0\n.plot tran v(top)")
    told = ".options reltol, plotwinsize: of no effect here, where rtol alone sets the error"
    with pytest.warns(fs.FingerspiceWarning) as caught:
        run, state = fs.simulate(circuit, t_stop=1e-3, rtol=1e-6), fs.steady_state(circuit, rtol=1e-6).solution
    assert {str(w.message) for w in caught} == {".plot has no effect here"}
    loaded = fs.load(run.to_netcdf(tmp_path / "run.nc"))
    for one in (run, state, loaded):
        assert one.warnings == (told, ".plot has no effect here")


def test_a_source_that_is_not_named_stays_on_and_is_warned_about() -> None:
    text = table1_deck(skin={"f": 5000}, extra="Vbias bias 0 DC 20")
    circuit = fs.parse_netlist(text.replace("drive 0 SIN(0 200 100)", "drive bias SIN(0 200 5000)"))
    with pytest.warns(fs.FingerspiceWarning, match=r"sources names vdrive only: Vbias stays on, as in the deck"):
        run = fs.simulate(circuit, sources={"vdrive": fs.Sine(100, 5000)}, t_stop=1e-3)
    assert run.u_source[0] == 20.0
    assert [text for text in run.warnings if "stays on" in text]
    assert of(circuit, sources={"Vdrive": fs.Sine(100, 5000), "Vbias": 0}) == []


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


@pytest.mark.parametrize(("times", "said"), listed("output_times"))
def test_output_times_outside_the_run_are_refused_with_the_likely_slip(times: list[float], said: str) -> None:
    with pytest.raises(fs.InputError, match=r"times from 0 s to t_stop = 0\.04 s") as refused:
        fs.simulate(table1(), t_stop=0.04, t_eval=times)
    assert str(refused.value).endswith(said)


#: Name, a change of the deck, its path and value if it is one in Python, what the warning says, and what was meant.
SLIPS = listed("slips")


@pytest.mark.parametrize(("change", "expected", "meant"), [(change, *said) for _, change, _, *said in SLIPS])
def test_a_likely_slip_is_named_with_its_place_the_range_and_what_was_meant(change, expected: str, meant: str) -> None:
    circuit, (said,) = heard(fs.parse_netlist, edited(tuple(change)), "deck.cir")
    place, _, text = said.partition(": ")
    assert re.fullmatch(r"deck\.cir:[34567]:\d+", place)
    assert text.startswith(expected)
    assert "the usual range (" in text
    assert ("meant?" in text) == (meant != "")
    assert meant == "" or f"; was {meant}" in text
    assert circuit.warnings == (said,)


@pytest.mark.parametrize(("change", "expected"), [(change, said) for _, _, change, said, _ in SLIPS if change])
def test_a_change_in_python_and_on_the_command_line_is_warned_about_as_in_the_deck(change, expected, command) -> None:
    path, value = change
    changed, (said,) = heard(table1().replace, {path: value})
    assert said.startswith(expected)
    assert changed.warnings == (said,)
    (line,) = command("plan", "pad.cir", "--set", f"{path}={value!r}").lines[:1]
    assert line == f"fingerspice: warning: {said}"


def test_what_is_put_right_is_not_warned_about_any_more() -> None:
    with pytest.warns(fs.FingerspiceWarning):
        wrong = fs.parse_netlist(edited(("d=3.5u", "d=3.5"), ("eps_r=1 ", "eps_r=1e5 ")), "deck.cir")
    assert len(wrong.warnings) == 2
    half, said = heard(wrong.replace, {"Xgap.d": "3.5u"})
    assert said == []
    assert [text.partition(" is ")[0] for text in half.warnings] == ["deck.cir:5:36: Xgap eps_r"]
    assert half.replace({"Xgap.eps_r": 1}).warnings == ()


def test_a_number_with_a_trap_in_it_gets_one_word() -> None:
    for change in (("r=0.2meg", "r=0.2M"), ("d=350u", "d=1e-4\u00b5")):
        (said,) = heard(fs.parse_netlist, edited(change))[1]
        assert "usual" not in said
    assert "1e-4\u00b5 is 1e-10: exponent and scale both count" in said


def test_sources_of_screens_are_usual() -> None:
    for source in ("SIN(0 200 1)", "SIN(0 200 100k)", "DC 0", "PULSE(-150 150 0 1n 1n 4m 10m)"):
        assert heard(fs.parse_netlist, edited(("SIN(0 200 100)", source)))[1] == []


def test_a_deck_that_is_wholly_unusual_does_not_flood() -> None:
    chain = [f"R{i} n{i} n{i + 1} 1u" for i in range(250)]
    said = heard(fs.parse_netlist, "\n".join(["t", "V1 n0 0 5", *chain, "Re n250 0 1k", ".tran 1m 1"]))[1]
    assert len(said) == 101
    assert said[-1] == "150 more warnings are not shown"


def test_an_area_that_a_source_or_a_start_gives_in_m2_is_warned_about() -> None:
    lines = ["t", "V1 a 0 5", "X1 a 0 area LAYER d=1u eps_r=2", "Varea area 0 35u", ".tran 1m 10m"]
    (said,) = heard(fs.parse_netlist, "\n".join(lines), "d.cir")[1]
    assert said.startswith("d.cir:4:1: Varea, an area, is 3.5e-05 mm^2, outside 0.1 to 2000 mm^2")
    assert said.endswith("it is in mm^2, not m^2; was 35 meant?")
    (said, *_) = heard(fs.parse_netlist, edited((".end", ".ic v(area)=35u\n.end")))[1]
    assert said.startswith(".ic v(area) is 3.5e-05 mm^2, outside 0.1 to 2000 mm^2")


def test_a_finger_too_small_by_values_that_are_each_usual_is_warned_about() -> None:
    (said,) = heard(table1, gap={"alpha": 1, "fn": "10m", "mu": 0.5, "m_exp": 0.5, "c2": 320, "n_exp": 1.4})[1]
    # Eqs. 3 and 5 without voltage: alpha fn^m_exp = 0.1 mm^2, less c2 (mu fn)^2 over that.
    area = 0.1 - 320 * (0.5 * 0.01) ** 2 / 0.1
    assert f"Xgap area at 0 V is {area:.4g} mm^2, outside 0.1 to 2000 mm^2" in said


def test_a_load_that_leaves_no_contact_is_refused_with_the_likely_slip() -> None:
    for make in (lambda: fs.parse_netlist(edited(("fn=0.5", "fn=50"))), lambda: table1().replace({"Xgap.fn": 50})):
        refuses(r"has no contact: .* it is in newton, not millinewton; was 50m meant", make)


def test_results_out_of_this_world_are_warned_about() -> None:
    with pytest.warns(fs.FingerspiceWarning):
        circuit = table1(gap={"alpha": "54.4meg"}, tran="50u 10m uic")
    said = heard(fs.large_signal, circuit, [1e3], rtol=1e-4)[1]
    assert sum("force reaches" in text or "area reaches" in text for text in said) == 2
    for said in (heard(fs.simulate, circuit)[1], heard(fs.phasor, circuit)[1]):
        force, ridges = (text.partition(": ") for text in said if "reaches" in text)
        assert force[0].startswith("the electroadhesive force reaches ")
        assert force[0].endswith("N, over 100 N (as much as a finger bears)")
        area = re.fullmatch(r"the contact area reaches (\S+) m\^2, over 0\.001 m\^2 \(10 cm\^2, .*\)", ridges[0])
        assert area is not None
        # At rest it is alpha fn^m_exp; adhesion makes it larger.
        assert 54.4 * 0.5**0.52 <= float(area[1]) < 100.0
        assert force[2] == ridges[2] == "some value is probably in another unit"


@pytest.mark.parametrize("beside", ["", "Rbeside a 0 1meg"], ids=["stack", "network"])
def test_a_pressure_that_no_layer_bears_is_warned_about_from_10_mpa_on(beside: str) -> None:
    # eps0 (u/d)^2 / 2 = 10 MPa at 1.503 GV/m; the gap alone takes the source's voltage.
    limit = math.sqrt(2.0 * 10e6 / 8.854e-12) * 50e-9
    for factor, expected in ((0.999, 0), (1.001, 1)):
        lines = (f"V1 a 0 {factor * limit!r}", "Xgap a 0 area GAP d=50n a_fix=1", ".tran 10u 100u uic", beside)
        said = heard(fs.simulate, deck(*lines))[1]
        (*pressure,) = (text for text in said if "electric pressure" in text)
        assert len(pressure) == expected
        assert all(text.startswith("the electric pressure reaches 10.02 MPa, over 10 MPa (") for text in pressure)


def test_a_batch_of_gaps_in_the_wrong_unit_is_warned_about_once() -> None:
    said = heard(fs.batch, table1(), {"Xgap.d": [2.0, 3.0, 4.0]}, rtol=1e-3, t_stop=1e-2)[1]
    assert sum("Xgap d is" in text and "the usual range" in text for text in said) == 2


def test_an_area_given_in_mm2_in_python_is_warned_about() -> None:
    said = heard(fs.simulate, table1(tran="50u 10m uic"), area=35.0)[1]
    assert "the contact area reaches 35 m^2, over 0.001 m^2 (10 cm^2, more than a finger has)" in " ".join(said)


def test_shipped_decks_are_usual() -> None:
    for path in sorted((Path(__file__).parents[1] / "circuits").glob("*.cir")):
        circuit, said = heard(fs.read_netlist, path)
        said += heard(fs.simulate, circuit, t_stop=2e-4)[1]
        # Some begin with a rest, which is all of so short a run.
        assert [text for text in said if "covers nothing of the run" not in text] == []


def test_a_sweep_of_this_package_is_not_warned_about_value_by_value(command: Command) -> None:
    Path("pad.cir").write_text(edited(QUICK))
    said = heard(fs.large_signal, table1(), [200e3], rtol=1e-4)[1]
    assert not [text for text in said if "the usual range" in text]


# The table


PARAMETERS = [(device, p) for device, spec in DEVICES.items() for p in spec.parameters]
every_parameter = pytest.mark.parametrize(("device", "spec"), PARAMETERS, ids=[f"{d}.{p.name}" for d, p in PARAMETERS])


@every_parameter
def test_every_parameter_has_a_usual_range_with_its_source_inside_the_legal_one(device, spec):
    assert spec.usual is not None
    assert spec.least <= spec.usual.least < spec.usual.most <= spec.most
    assert len(spec.usual.source) > 10
    if spec.default is not None:
        assert spec.unusual("X", spec.default) is None
    for inside in (spec.usual.least, spec.usual.most):
        assert spec.unusual("X", inside) is None
    for outside in (spec.usual.least * (1 - 1e-9), spec.usual.most * (1 + 1e-9)):
        assert f"X {spec.name} is " in (spec.unusual("X", outside) or "")


def test_none_and_endless_are_not_unusual() -> None:
    for usual in (REST_AREA, *SOURCES.values()):
        assert usual.warning("X", 0.0, "V") is usual.warning("X", math.inf, "V") is None


def test_a_number_as_spice_writes_it_reads_as_itself() -> None:
    for value in (3.5e-6, 2e5, 54.4, 1e-3, 999.9, 1e-15, 4e9, 7e12, 123456.0):
        assert parse_number(spice_text(value)) == value
