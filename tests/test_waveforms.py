"""Waveforms: value, both sides of a jump, breakpoints, fundamental, the table for compiled code, text in netlists."""

import math
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad

import fingerspice as fs
from fingerspice.netlist.netlist import source_from_text
from fingerspice.waveforms import periodic, sampling
from fingerspice.waveforms import waveform as waveforms
from fingerspice.waveforms.samples import as_samples
from fingerspice.waveforms.sampling import source_table
from fingerspice.waveforms.waveform import as_waveform
from scenes import listed, refuses, table1
from waveform_cases import CASES, Case, compiled

every_case = pytest.mark.parametrize("case", CASES, ids=lambda c: c.name)
periodic_case = pytest.mark.parametrize("case", [c for c in CASES if c.tone], ids=lambda c: c.name)


def pieces(case: Case) -> list[tuple[float, float]]:
    """The smooth pieces of [0, end], by the formula's own edges."""
    inner = [x for x in case.edges if 1e-12 < x < case.end - 1e-12]
    return list(pairwise([0.0, *inner, case.end]))


def inside(case: Case, count: int = 40, margin: float = 1e-6) -> np.ndarray:
    """Times in every piece, none closer to an edge than `margin` of the piece."""
    x = np.modf(np.arange(1, count + 1) * 0.618033988749895)[0]
    x = margin + (1.0 - 2.0 * margin) * np.sort(x)
    return np.concatenate([a + (b - a) * x for a, b in pieces(case)])


def size(case: Case) -> float:
    return float(np.abs(case.formula(inside(case))).max())


def table_values(case: Case, t0: float, t1: float, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Voltage and slope by the compiled evaluation of the waveform's table."""
    table = source_table(case.waveform, t0, t1, 1e-14, 1e-4)
    values, slopes = compiled(table, t).T
    return values, slopes


def test_every_waveform_class_is_in_the_registry() -> None:
    named = {type(c.waveform) for c in CASES}
    abstract = (fs.Waveform, periodic.Ramps)
    for module in (periodic, sampling, waveforms):
        for name, item in vars(module).items():
            if isinstance(item, type) and issubclass(item, fs.Waveform) and not name.startswith("_"):
                assert item in named or item in abstract, f"{name} has no case"


@every_case
def test_the_value_is_the_formulas_between_the_edges_for_times_of_any_shape(case: Case) -> None:
    t = inside(case)
    values = case.waveform.value(t)
    np.testing.assert_allclose(values, case.formula(t), rtol=0, atol=1e-12 * size(case))
    for same in (case.waveform.value(t, "left"), case.waveform(t), [float(case.waveform.value(float(x))) for x in t]):
        np.testing.assert_array_equal(same, values)
    assert case.waveform.value(float(t[0])).shape == ()
    np.testing.assert_array_equal(case.waveform.value(t.reshape(2, -1)), values.reshape(2, -1))
    for side in ("right", "left"):
        assert case.waveform.value(np.empty(0), side).shape == (0,)


@every_case
def test_the_two_sides_of_an_edge_are_the_limits_from_the_two_sides(case: Case) -> None:
    edges = case.waveform.breakpoints(1e-9, case.end - 1e-9)
    if not edges.size:
        return
    step = 1e-11
    slope = np.abs(np.diff(case.formula(inside(case, 400)))).max() / np.diff(inside(case, 400)).min()
    atol = min(2.0 * step * slope, 1e-5 * size(case)) + 1e-12 * size(case)
    np.testing.assert_allclose(case.waveform.value(edges), case.formula(edges + step), rtol=0, atol=atol)
    np.testing.assert_allclose(case.waveform.value(edges, "left"), case.formula(edges - step), rtol=0, atol=atol)


@every_case
def test_the_breakpoints_of_a_window_are_all_edges_of_the_formula_each_once_and_in_order(case: Case) -> None:
    found = case.waveform.breakpoints(0.0, case.end)
    assert np.all(np.diff(found) > 1e-12)
    for edge in case.edges:
        assert np.abs(found - edge).min() < 1e-15, f"{edge} s is not a breakpoint"
    # what is no edge of the formula must be harmless: both sides alike
    for b in (b for b in found if all(abs(b - e) > 1e-12 for e in case.edges)):
        assert case.waveform.value(b) == pytest.approx(case.waveform.value(b, "left"), abs=1e-9 * size(case))
    large = case.waveform.breakpoints(0.0, 0.1)
    for t0, t1 in ((0.0, 0.01), (0.0123, 0.0377), (0.02, 0.03)):
        within = large[(large >= t0) & (large <= t1)]
        np.testing.assert_array_equal(case.waveform.breakpoints(t0, t1), within)


@every_case
def test_between_its_breakpoints_the_waveform_is_smooth(case: Case) -> None:
    """A polynomial of degree 24 through short panels must reproduce what lies between its points."""
    longest = min(2e-3, 0.5 * case.waveform.shortest_time())
    edges = np.unique([0.0, *case.waveform.breakpoints(0.0, case.end), case.end])
    x = np.cos((np.arange(25) + 0.5) * math.pi / 25)
    proof = np.modf(np.arange(1, 14) * 0.618033988749895)[0] * 2.0 - 1.0
    for a, b in pairwise(edges):
        cuts = np.linspace(a, b, math.ceil((b - a) / longest) + 1)
        for c, d in pairwise(cuts):
            middle, half = 0.5 * (c + d), 0.5 * (d - c)
            series = np.polynomial.chebyshev.chebfit(x, case.waveform.value(middle + half * x), 24)
            between = np.polynomial.chebyshev.chebval(proof, series)
            exact = case.waveform.value(middle + half * proof)
            np.testing.assert_allclose(between, exact, rtol=0, atol=1e-10 * size(case))


@every_case
def test_the_compiled_table_has_the_values_of_the_waveform_and_the_slope_of_the_formula(case: Case) -> None:
    for window in ((0.0, 0.05), (0.0137, 0.0421)):
        t = inside(case, 15)
        t = t[(t > window[0]) & (t < window[1])]
        values, _ = table_values(case, *window, t)
        np.testing.assert_allclose(values, case.waveform.value(t), rtol=0, atol=1e-12 * size(case))
    t = inside(case, 9, margin=0.05)
    h = 0.003 * min(case.waveform.shortest_time(), min(b - a for a, b in pieces(case)))
    f = case.formula
    numeric = (8.0 * (f(t + h) - f(t - h)) - (f(t + 2.0 * h) - f(t - 2.0 * h))) / (12.0 * h)
    _, slopes = table_values(case, 0.0, case.end, t)
    np.testing.assert_allclose(slopes, numeric, rtol=2e-7, atol=1e-10 * size(case) / h)


@pytest.mark.parametrize("case", [c for c in CASES if c.name != "function"], ids=lambda c: c.name)
def test_late_in_a_long_run_the_table_still_has_the_formulas_values(case: Case) -> None:
    # 1000 s in, a time is known to 1e-13 s: the value to 1e-13 of what the slope makes of a second
    t0 = 1000.0
    t = t0 + np.linspace(0.0003, 0.0397, 60)
    values, slopes = table_values(case, t0, t0 + 0.04, t)
    far = np.abs(t[:, None] - case.waveform.breakpoints(t0, t0 + 0.04)[None, :]).min(1, initial=1.0) > 1e-9
    allowed = 4e-13 * np.abs(slopes) + 4e-12 * size(case)
    assert np.all((np.abs(values - case.waveform.value(t)) <= allowed)[far])


@every_case
def test_the_period_is_the_one_of_the_formula(case: Case) -> None:
    assert case.waveform.period == (None if case.period is None else pytest.approx(case.period, rel=1e-13))
    if case.period is not None:
        assert case.waveform.settled == pytest.approx(case.settled, abs=1e-15)
        t = case.settled + np.linspace(0.0, 3.0, 211)[1:-1] * case.period + 1e-7 * case.period
        whole, half, third = (
            np.abs(case.waveform.value(t + case.period / n) - case.waveform.value(t)).max() for n in (1.0, 2.0, 3.0)
        )
        assert whole <= 1e-11 * size(case)
        assert min(half, third) > 0.01 * size(case), "a shorter period would do"


@periodic_case
def test_the_fundamental_is_the_fourier_integral_of_the_formula(case: Case) -> None:
    assert case.period is not None
    assert case.tone is not None
    start, omega = case.settled, 2.0 * math.pi * case.tone
    edges = case.waveform.breakpoints(start, start + case.period)
    cuts = np.unique([start, *edges, *np.linspace(start, start + case.period, 41), start + case.period])
    total = 0j
    for a, b in pairwise(cuts):
        if b - a < 1e-14:
            continue
        for part, weight in ((1.0, np.cos), (-1j, np.sin)):
            share = lambda t, w=weight: float(case.formula(np.array([t]))[0] * w(omega * t))  # noqa: E731
            total += part * quad(share, a, b, epsabs=1e-13, limit=50)[0]
    # U = Im(P exp(i omega t))
    expected = 2j * total / case.period
    found = case.waveform.fundamental
    assert found is not None
    assert found.frequency == pytest.approx(case.tone, rel=1e-14)
    assert found.amplitude == pytest.approx(abs(expected), rel=1e-9)
    difference = found.phase - math.atan2(expected.imag, expected.real)
    assert math.remainder(difference, 2.0 * math.pi) == pytest.approx(0.0, abs=1e-9)


SINE = fs.Sine(1.0, 100.0)
TONELESS = (
    fs.DC(3.0), fs.Sine(0.0, 100.0), fs.Sine(3.0, 100.0, damping=1.0), fs.Chirp(1.0, 10.0, 100.0, 1.0),
    fs.PWL((0.0, 1.0), (0.0, 1.0)), fs.Pulse(0.0, 1.0, 0.001), SINE + fs.Sine(-1.0, 100.0), fs.Function(np.sin),
    SINE + fs.Sine(1.0, 100.0 * math.pi), fs.Sine(1.0, 200.0) + fs.Sine(1.0, 300.0),
    SINE + fs.Chirp(1.0, 10.0, 100.0, 1.0),
)  # fmt: skip


def test_what_has_no_fundamental_says_so() -> None:
    assert [repr(waveform) for waveform in TONELESS if waveform.fundamental is not None] == []


simple = st.one_of(
    st.builds(fs.DC, st.floats(-5.0, 5.0)),
    st.builds(fs.Sine, st.floats(-5.0, 5.0), st.floats(10.0, 500.0), st.floats(-2.0, 2.0), st.floats(-180.0, 180.0)),
    st.builds(fs.Square, st.floats(0.1, 5.0), st.floats(10.0, 300.0), st.floats(0.1, 0.9)),
    st.builds(fs.Sawtooth, st.floats(0.1, 5.0), st.floats(10.0, 300.0)),
    st.builds(fs.Chirp, st.floats(0.1, 5.0), st.floats(10.0, 300.0), st.floats(10.0, 300.0), st.floats(0.005, 0.1)),
)


@settings(max_examples=40, derandomize=True, deadline=None)
@given(a=simple, b=simple, c=simple)
def test_sums_and_products_have_those_of_the_values(a: fs.Waveform, b: fs.Waveform, c: fs.Waveform) -> None:
    combined = (a + b) * c + a * b
    t = np.sort(np.modf(np.arange(1, 30) * 0.618033988749895)[0]) * 0.04
    expected = (a.value(t) + b.value(t)) * c.value(t) + a.value(t) * b.value(t)
    np.testing.assert_allclose(combined.value(t), expected, rtol=0, atol=1e-13 * 150.0)
    far = np.abs(t[:, None] - combined.breakpoints(0.0, 0.04)[None, :]).min(1, initial=1.0) > 1e-12
    values, _ = table_values(Case("", combined, combined.value), 0.0, 0.04, t[far])
    np.testing.assert_allclose(values, expected[far], rtol=0, atol=1e-12 * 150.0)


def test_numbers_and_functions_become_waveforms_and_other_things_do_not() -> None:
    assert as_waveform(3) == fs.DC(3.0)
    assert isinstance(as_waveform(math.sin), fs.Function)
    wave = fs.Sine(1.0, 10.0)
    assert as_waveform(wave) is wave
    assert float((2.0 + wave).value(0.025)) == pytest.approx(3.0)
    assert float((2.0 * wave).value(0.025)) == pytest.approx(2.0)
    said = r"a source is 'SIN\(0 1 1\)'; allowed: a waveform, a number or a function of time"
    refuses(said, as_waveform, "SIN(0 1 1)")


def test_an_edge_is_at_the_time_a_user_writes_for_it() -> None:
    """k / f, rounded once: 0.075 s is an edge of 100 Hz, not a time just before one."""
    k = np.arange(400)
    for frequency in (7.0, 50.0, 60.0, 100.0, 5000.0):
        square = fs.Square(1.0, frequency)
        for at, side, level in ((k, "right", 1.0), (k, "left", -1.0), (k + 0.5, "right", -1.0), (k + 0.5, "left", 1.0)):
            np.testing.assert_array_equal(square.value(at / frequency, side), level)


def test_a_run_gives_the_right_hand_value_at_a_time_that_is_an_edge_up_to_rounding() -> None:
    """The second edge is at 0.01 + 0.05 = 0.060000000000000005 s; the user writes 0.06."""
    circuit = table1("PULSE(0 8 10m 0 0 20m 50m)", tran="1m 70m uic")
    solution = fs.simulate(circuit, t_eval=[0.01, 0.03, 0.06], rtol=1e-6)
    np.testing.assert_array_equal(solution.t, [0.01, 0.03, 0.06])
    np.testing.assert_array_equal(solution.u_source, [8.0, 0.0, 8.0])


@pytest.mark.parametrize(
    ("kind", "given", "named", "message"),
    [
        *listed("waveforms"),
        ("Samples", [[1j, 2], 1e3], {}, "samples is [1j, 2], a list of complex numbers; allowed: two or more"),
        ("Function", [math.sin], {"repeat": -1.0}, "function period is -1 s; allowed: a number of s, > 0"),
    ],
)
def test_bad_arguments_are_refused_with_what_is_allowed(kind, given, named, message: str) -> None:
    with pytest.raises(fs.InputError) as caught:
        getattr(fs, kind)(*given, **named)
    assert message in str(caught.value)
    assert "allowed" in str(caught.value) or "follows" in message or "three times" in message


def test_the_texts_of_long_pwls_and_recordings_are_short_and_tell_them_apart() -> None:
    t = tuple(np.linspace(0.0, 1.0, 10_001).tolist())
    one, same, other = fs.PWL(t, t), fs.PWL(t, t), fs.PWL(t, (*t[:-1], 0.5))
    assert repr(one) == repr(same) != repr(other)
    assert repr(one).startswith("PWL(10001 points, 0 s to 1 s, sha256 ")
    assert repr(fs.PWL((0.0, 1.0), (0.0, 2.0))) == "PWL(times=(0.0, 1.0), values=(0.0, 2.0), repeat=None)"
    values = np.arange(3000.0)
    moved = np.where(values == 1500.0, values + 1e-9, values)
    texts = {repr(fs.Samples(*given)) for given in ((values, 1e3), (moved, 1e3), (values, 2e3), (values, 1e3, 1.0))}
    assert len(texts) == 4
    assert repr(fs.Samples(values, 1e3)) in texts
    assert all(len(text) < 100 for text in texts)
    assert len({repr(fs.Samples(x, 1e3) + fs.Sine(1.0, 50.0)) for x in (values, moved)}) == 2


@every_case
def test_a_minus_turns_a_waveform_over_and_subtracts(case: Case) -> None:
    wave, other, t = case.waveform, fs.Sine(2.0, 1.0), np.linspace(0.0, 0.3, 101)
    np.testing.assert_array_equal((-wave).value(t), -wave.value(t))
    np.testing.assert_allclose((1.0 - wave).value(t), 1.0 - wave.value(t), atol=1e-15)
    np.testing.assert_allclose((wave - other).value(t), wave.value(t) - other.value(t), atol=1e-15)


def test_a_recording_turned_over_runs_sample_by_sample_like_the_recording() -> None:
    samples = fs.Samples(np.sin(np.arange(500.0)), 1e4)
    turned = as_samples(-samples)
    assert turned is not None
    np.testing.assert_array_equal(turned.values, -samples.values)


def test_only_a_square_has_a_duty() -> None:
    for wave in (fs.Triangle(100.0, 50.0), fs.Sawtooth(100.0, 50.0)):
        circuit = table1().replace({"Vdrive": wave})
        refuses(r"unknown parameter 'Vdrive\.duty'; nearest: 'Vdrive\.\w+'", circuit.replace, {"Vdrive.duty": 0.3})


# In a netlist: what they mean in ngspice, traps included --------------------------------------------------------

TRAN = "1m 100m uic"


def wave(source: str, tran: str = TRAN) -> fs.Waveform:
    waveform = table1(source, tran=tran)["Vdrive"].waveform
    assert waveform is not None
    return waveform


SHAPE, LEVELS = (0.0, 10e-3, 20e-3, 30e-3), (0.0, 4.0, 1.0, 4.0)
BURST = fs.Burst(fs.Sine(200.0, 5000.0), 10.0 / 5000.0)
# The step of the analysis is 1 ms. "Then" is the same source in another spelling, or as it is made in Python.
SAME: list[tuple[str, str | fs.Waveform]] = [
    *listed("spellings"),
    ("SIN(1 5 100 20m 3 30)", fs.Sine(5.0, 100.0, 1.0, phase_deg=30.0, delay=0.02, damping=3.0)),
    ("PULSE(0 8 10m)", fs.Pulse(0.0, 8.0, 0.01, 1e-3, 1e-3)),
    ("PULSE(0 8 10m 1m 1m)", fs.Pulse(0.0, 8.0, 0.01, 1e-3, 1e-3)),
    ("PULSE(0 8 10m 1m 1m 0 0)", fs.Pulse(0.0, 8.0, 0.01, 1e-3, 1e-3)),
    ("PULSE(0 8 10m 0 0 20m 50m)", fs.Pulse(0.0, 8.0, 0.01, 0.0, 0.0, 0.02, 0.05)),
    ("PULSE(-3 8 10m 1m 2m 20m 50m)", fs.Pulse(-3.0, 8.0, 0.01, 1e-3, 2e-3, 0.02, 0.05)),
    ("EXP(1 9 5m 2m 20m 7m)", fs.Exp(1.0, 9.0, 5e-3, 2e-3, 0.02, 7e-3)),
    ("EXP(0 1 1m 1m)", fs.Exp(0.0, 1.0, 1e-3, 1e-3, 2e-3, 1e-3)),
    ("PWL(10m 1 20m 5 20m -3 40m 2)", fs.PWL((0.01, 0.02, 0.02, 0.04), (1.0, 5.0, -3.0, 2.0))),
    *(
        (text, fs.PWL(tuple(t + td for t in SHAPE), LEVELS, 0.01 + td))
        for text, td in (
            ("PWL(0 0 10m 4 20m 1 30m 4) r=10m", 0.0),
            ("PWL(0 0 10m 4 20m 1 30m 4 r=10m)", 0.0),
            ("PWL(0 0 10m 4 20m 1 30m 4) r=10m td=3m", 3e-3),
            ("PWL(0 0 10m 4 20m 1 30m 4 r=10m td=3m)", 3e-3),
        )
    ),
    ("CHIRP(150 20 2k 0.3)", fs.Chirp(150.0, 20.0, 2000.0, 0.3)),
    ("BURST(200 5k 10)", BURST),
    ("BURST(200 5k 10 10m)", fs.Repeat(BURST, 0.01)),
    ("TRIANGLE(200 100)", fs.Triangle(200.0, 100.0)),
    ("sawtooth(200 100)", fs.Sawtooth(200.0, 100.0)),
    ("SQUARE(200 100 0.2)", fs.Square(200.0, 100.0, duty=0.2)),
    ("SQUARE(200 100)", fs.Square(200.0, 100.0)),
]


@pytest.mark.parametrize(("source", "then"), SAME, ids=[text for text, _ in SAME])
def test_a_source_is_the_one_that_spice_makes_of_it(source: str, then: str | fs.Waveform) -> None:
    assert wave(source) == (wave(then) if isinstance(then, str) else then)


def test_what_follows_from_the_analysis_is_said() -> None:
    with pytest.warns(fs.FingerspiceWarning, match="SIN leaves out FREQ, which is 1/TSTOP then, 10 Hz"):
        assert wave("SIN(0 5)") == fs.Sine(5.0, 10.0)
    with pytest.warns(fs.FingerspiceWarning, match=r"3:16: Vdrive: EXP has TD1 = 0, .* ngspice 39, which takes TSTEP"):
        assert wave("EXP(0 1)") == fs.Exp(0.0, 1.0, 0.0, 0.001, 0.001, 0.001)
    for source, said in (("SIN(0 5)", "FREQ"), ("PULSE(0 1)", "TR, which defaults to TSTEP")):
        text = f"no analysis\nVdrive a 0 {source}\nXcoat a 0 area LAYER d=1u eps_r=3.9\nVarea area 0 35\n"
        with pytest.raises(fs.InputError, match=said) as caught:
            fs.parse_netlist(text)
        assert caught.value.where is not None
        assert caught.value.where.line == 2


def test_a_source_given_as_text_reads_as_in_the_deck() -> None:
    circuit = table1(tran=TRAN)
    for text in (text for text, _ in SAME if "AC" not in text):
        assert source_from_text(text, circuit) == wave(text)
    # Which a deck does not take, as simulators differ about it.
    assert source_from_text("AM(200 5k 50)", circuit) == fs.AM(200.0, 5e3, 50.0)
    assert source_from_text("am(200, 5k, 50, 0.5)", circuit) == fs.AM(200.0, 5e3, 50.0, 0.5)
    for text in ("SQUARE(200 100", "SQUAR(200 100)", "SIN(0 1 1)\nR1 a 0 1k", ""):
        with pytest.raises(fs.InputError):
            source_from_text(text, circuit)
