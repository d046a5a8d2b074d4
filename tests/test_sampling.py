"""A user's function as a source: declared breaks are exact, undeclared ones are found and warned about."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import fingerspice as fs
from fingerspice.waveforms import sampling
from fingerspice.waveforms.sampling import SourceTable, source_table
from scenes import cases, heard, refuses, table1, table1_deck
from waveform_cases import compiled

STEP = 1e-5
TOL = 1e-10
WITHOUT_TRAN = table1_deck(tran="1u 1m").replace(".tran 1u 1m\n", "")


def read(table: SourceTable, t: np.ndarray) -> np.ndarray:
    return compiled(table, t)[:, 0]


class Counted:
    """A function that counts its calls which gave a value, and the values."""

    def __init__(self, function) -> None:
        self.function, self.calls, self.values = function, 0, 0

    def __call__(self, t):
        found = self.function(t)
        self.calls, self.values = self.calls + 1, self.values + np.size(t)
        return found


def step_at(time: float):
    return lambda t: np.where(np.asarray(t) < time, 50.0, 200.0) + 30.0 * np.sin(2.0 * math.pi * 100.0 * np.asarray(t))


def spike_at(time: float, width: float):
    """A bell of that full width at half maximum, on a slow sine."""
    return lambda t: 100.0 * 0.5 ** (2.0 * (t - time) / width) ** 2 + 50.0 * np.sin(2.0 * math.pi * 100.0 * t)


@pytest.mark.parametrize(
    "function",
    [
        lambda t: 200.0 * np.sin(2.0 * math.pi * 100.0 * t) ** 3,
        lambda t: 200.0 * np.exp(-t / 3e-3) * np.cos(2.0 * math.pi * 5000.0 * t),
        lambda t: 200.0 / (1.0 + ((t - 0.007) / 1e-3) ** 2),
        lambda t: 200.0 * np.sin(2.0 * math.pi * (100.0 + 1e5 * t) * t),
    ],
)
def test_a_smooth_function_is_met_to_the_tolerance_without_a_warning(function) -> None:
    table = source_table(fs.Function(function), 0.0, 0.02, TOL, STEP)
    t = np.sort(np.random.default_rng(3).uniform(0.0, 0.02, 1000))
    np.testing.assert_allclose(read(table, t), function(t), rtol=0, atol=2.0 * TOL * 200.0)


def test_functions_of_a_number_and_of_arrays_give_the_same_table() -> None:
    tables = [
        source_table(fs.Function(f), 0.0, 0.01, TOL, STEP)
        for f in (
            lambda t: 3.0 * np.sin(700.0 * t),
            lambda t: 3.0 * math.sin(700.0 * t),
            lambda t: 3.0 * math.sin(700.0 * t) if t >= 0.0 else 0.0,
        )
    ]
    for table in tables[1:]:
        np.testing.assert_array_equal(table.edges, tables[0].edges)
        np.testing.assert_allclose(table.series, tables[0].series, rtol=0, atol=1e-14)


def test_a_function_that_misreads_arrays_without_raising_is_called_with_numbers() -> None:
    def by_the_first(t):
        return np.full(np.shape(t), 2.0 if np.ravel(t)[0] > 0.005 else 1.0)

    np.testing.assert_array_equal(fs.Function(by_the_first).value([0.004, 0.006, 0.007]), [1.0, 2.0, 2.0])


@pytest.mark.parametrize(
    "given", ["a", None, [1.0, 2.0], 1j, np.array([1j, 2j]), True, np.ma.masked, np.datetime64("2026")]
)
def test_a_function_that_returns_no_number_is_refused_with_what_it_returned_and_its_time(given: object) -> None:
    refuses(r"the source function returned .* allowed: one number", fs.Function(lambda t: given).value, [0.001, 0.002])
    with pytest.raises(fs.InputError, match=r"the source function returned .* at t = 0\.002 s; allowed: one number"):
        fs.Function(lambda t: given).value(0.002)


def test_a_function_that_works_in_place_leaves_the_times_as_they_are() -> None:
    def in_place(t):
        t *= 2.0 * np.pi * 100.0
        return 150.0 * np.sin(t)

    def of_arrays_only(t):
        t[t < 0.0] = 0.0
        return 150.0 * np.sin(2.0 * np.pi * 100.0 * t)

    t = np.linspace(0.0, 0.02, 7)
    for function in (in_place, of_arrays_only):
        np.testing.assert_array_equal(fs.Function(function)(t), 150.0 * np.sin(t * (2.0 * np.pi * 100.0)))
        run = fs.simulate(table1(), sources=function, t_stop=0.02, rtol=1e-6)
        exact = fs.simulate(table1(), sources=fs.Sine(150.0, 100.0), t_stop=0.02, t_eval=run.t, rtol=1e-9)
        assert np.abs(run.u_gap - exact.u_gap).max() <= run.error.u_gap + exact.error.u_gap
    np.testing.assert_array_equal(t, np.linspace(0.0, 0.02, 7))


@pytest.mark.parametrize("kind", [np.float32, np.float16])
@pytest.mark.parametrize("rtol", [1e-8, 1e-4])
@pytest.mark.parametrize("shape", ["sine", "chirp", "sum", "clock"])
def test_coarser_numbers_than_doubles_are_taken_as_they_are_and_their_rounding_is_stated(kind, rtol, shape):
    def exact(t):
        if shape == "chirp":
            return 120.0 * np.sin(2.0 * np.pi * (50.0 + 4000.0 * t) * t)
        return 80.0 + 60.0 * np.sin(2.0 * np.pi * 150.0 * t) + (30.0 * np.sin(2000.0 * t) if shape == "sum" else 0.0)

    # The time itself may be coarse, too.
    coarse = Counted(lambda t: exact(np.asarray(t, np.float32) if shape == "clock" else t).astype(kind))

    with pytest.warns(fs.FingerspiceWarning, match="the source function of Vdrive gives numbers rounded to"):
        run = fs.simulate(table1(), sources=coarse, t_stop=0.03, rtol=rtol)
    true = fs.simulate(table1(), sources=exact, t_stop=0.03, t_eval=run.t, rtol=1e-9)
    assert np.abs(run.u_gap - true.u_gap).max() <= run.error.u_gap
    assert np.abs(run.f_el - true.f_el).max() <= run.error.f_el
    # Of what single precision has, not of something much coarser.
    assert run.error.u_gap < 1e3 * max(rtol, np.finfo(kind).eps) * 150.0
    assert coarse.values < 1_000_000


def test_precision_is_that_of_the_coarsest_part() -> None:
    single = fs.Function(lambda t: np.float32(t))
    sums = (single, single + fs.DC(1.0), single * fs.Sine(1.0, 1.0))
    for wave in (*sums, fs.Burst(single, 1.0), fs.Repeat(single, 1.0)):
        wave(np.array([0.25, 0.5]))
        assert wave.precision == 2.0**-23
    assert fs.Function(lambda t: t).precision == fs.Sine(1.0, 1.0).precision == 2.0**-52


@settings(max_examples=cases(25, 8), derandomize=True, deadline=None)
@given(time=st.floats(1e-4, 0.0199))
def test_a_declared_jump_is_an_edge_of_the_table_with_both_sides_right(time: float) -> None:
    wave = fs.Function(step_at(time), breaks=(time,))
    table = source_table(wave, 0.0, 0.02, TOL, STEP)
    assert time in table.edges
    t = np.array([0.0, time - 1e-9, time, time + 1e-9, 0.02])
    t = t[t >= 0.0]
    np.testing.assert_allclose(read(table, t), wave.value(t), rtol=0, atol=2e-8)
    assert float(wave.value(time) - wave.value(time, "left")) == pytest.approx(150.0, abs=1e-9)


def test_breaks_of_a_periodic_function_come_back_in_every_period_each_once() -> None:
    wave = fs.Function(lambda t: np.where(t % 0.01 < 0.004, 1.0, -1.0), breaks=(0.0, 0.004), repeat=0.01)
    expected = np.sort(np.concatenate([np.arange(10) * 0.01, np.arange(10) * 0.01 + 0.004]))
    np.testing.assert_allclose(wave.breakpoints(0.0, 0.095), expected, rtol=1e-15)
    # its end named as well as its start, which is the same edge
    both = fs.Function(wave.function, breaks=(0.0, 0.004, 0.01), repeat=0.01)
    np.testing.assert_allclose(both.breakpoints(0.0, 0.095), expected, rtol=1e-15)


def test_the_sides_of_a_break_do_not_depend_on_the_rounding_of_the_function() -> None:
    """The sine of 6 pi is not 0 in floating point: at a break itself this square is on the wrong side."""
    wave = fs.Function(lambda t: 100.0 * np.sign(np.sin(2.0 * math.pi * 100.0 * t)), breaks=(0.0, 0.005), repeat=0.01)
    edges = wave.breakpoints(0.0, 0.0375)
    np.testing.assert_array_equal(wave.value(edges), np.tile([100.0, -100.0], 4))
    np.testing.assert_array_equal(wave.value(edges, "left"), np.tile([-100.0, 100.0], 4))
    one, other = (fs.simulate(table1(), sources=w, t_stop=0.04) for w in (wave, fs.Square(100.0, 100.0)))
    for key in ("u_layer:Xskin", "v:top"):
        assert np.ptp(one.signals[key][0]) == pytest.approx(np.ptp(other.signals[key][0]), rel=1e-9)
        assert one.spectrum(key).amplitude == pytest.approx(other.spectrum(key).amplitude, rel=0, abs=1e-7)


@pytest.mark.parametrize("time", [0.0123456789, 0.0031, 0.012, 0.01234])
def test_an_undeclared_jump_is_found_and_warned_about_with_its_time_and_size(time: float) -> None:
    table, (message,) = heard(source_table, fs.Function(step_at(time)), 0.0, 0.02, TOL, STEP)
    assert "jumps by 150 V" in message
    assert f"at t = {time:.9g} s" in message
    assert "breaks=" in message
    assert np.abs(table.edges - time).min() < 1e-13
    t = np.array([time - 1e-9, time + 1e-9, 0.001, 0.0199])
    np.testing.assert_allclose(read(table, t), step_at(time)(t), rtol=0, atol=1e-7)


def test_several_undeclared_jumps_are_counted_in_one_warning() -> None:
    def square(t):
        return np.where(np.floor((t - 0.000123) / 0.005) % 2.0 == 0.0, 200.0, -200.0)

    _, (message,) = heard(source_table, fs.Function(square), 0.0, 0.02, TOL, STEP)
    assert "at t = 0.000123 s and 3 more times" in message


@pytest.mark.parametrize("width", [0.5, 0.2])
@pytest.mark.parametrize("time", [0.0020037, 0.0123456, 0.0179911])
def test_a_spike_narrower_than_the_step_is_resolved_and_warned_about_with_its_time(width: float, time: float) -> None:
    wave = fs.Function(spike_at(time, width * STEP))
    table, (message,) = heard(source_table, wave, 0.0, 0.02, TOL, STEP)
    assert "narrower than the output step 1e-05 s" in message
    seen = float(message.partition("near t = ")[2].partition(" s")[0])
    assert seen == pytest.approx(time, abs=2.0 * STEP)
    t = time + np.linspace(-2.0, 2.0, 81) * STEP
    np.testing.assert_allclose(read(table, t), wave.value(t), rtol=0, atol=2.0 * TOL * 150.0)


@settings(max_examples=cases(25, 8), derandomize=True, deadline=None)
@given(time=st.floats(1e-4, 0.0015))
def test_a_rectangular_pulse_of_half_a_step_is_never_missed(time: float) -> None:
    wave = fs.Function(lambda t: np.where((t >= time) & (t < time + 0.5 * STEP), 100.0, 0.0) + 10.0)
    table, said = heard(source_table, wave, 0.0, 0.002, TOL, STEP)
    assert said
    t = time + np.array([-0.3, 0.1, 0.25, 0.4, 0.8]) * STEP
    np.testing.assert_allclose(read(table, t), wave.value(t), rtol=0, atol=1e-7)


def test_a_function_known_only_to_the_rounding_of_its_phase_costs_no_more_for_it() -> None:
    """5 kHz near one second: the phase is 3e4 rad, known to 3e-12. A finer tolerance cannot be proved."""
    sine = Counted(lambda t: 200.0 * np.sin(2.0 * math.pi * 5000.0 * t))
    table = source_table(fs.Function(sine), 1.0, 1.01, 1e-12, STEP)
    assert sine.values < 200_000, "refining noise"
    t = np.linspace(1.0, 1.01, 500)[:-1]
    np.testing.assert_allclose(read(table, t), sine(t), rtol=0, atol=200.0 * 2e-11)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("start", [0.003, 0.0030001234, 0.0])
def test_nan_and_inf_end_the_table_where_they_begin(bad: float, start: float) -> None:
    wave = fs.Function(lambda t: np.where(t < start, np.sin(700.0 * t), bad))
    table = source_table(wave, 0.0, 0.02, TOL, STEP)
    assert table.not_finite == pytest.approx(start, abs=1e-11)
    assert table.edges[-1] <= start + 1e-11
    if start > 0.0:
        assert table.edges[-1] >= start - 1e-11
        t = np.linspace(0.0, 0.999 * start, 50)
        np.testing.assert_allclose(read(table, t), np.sin(700.0 * t), rtol=0, atol=2.0 * TOL)


def test_a_run_names_the_time_and_the_source_of_a_nan_and_keeps_what_came_before() -> None:
    with pytest.raises(fs.SolveError, match=r"t = 0\.003.* s: a source gave NaN or inf.*Vdrive") as caught:
        fs.simulate(table1(), sources={"Vdrive": lambda t: np.where(t < 0.003, 10.0 * t, math.nan)}, rtol=1e-6)
    partial = caught.value.solution
    assert partial is not None
    assert not partial.success
    assert 0.0029 < partial.t[-1] <= 0.003
    assert np.isfinite(partial.u_gap).all()


def test_a_function_that_fades_below_the_smallest_numbers_is_not_followed_there() -> None:
    fading = Counted(lambda t: 200.0 * math.sin(2e4 * t) * math.exp(-((t / 2e-3) ** 2)))
    run = fs.simulate(table1(), sources={"Vdrive": fading}, t_stop=0.08, rtol=1e-8, t_eval=np.linspace(0.0, 0.08, 99))
    assert run.success
    assert fading.calls < 2_000_000


DICE = np.random.default_rng(5)


def rough(t):
    """The same at the same time, and smooth only below 1e-15 s."""
    return 100.0 * np.sin(1e15 * np.asarray(t) ** 2)


@pytest.mark.parametrize(
    "noise", [lambda t: DICE.random(), lambda t: np.where(np.asarray(t) < 0.013, 5.0, DICE.random(np.shape(t)))]
)
def test_noise_is_refused_with_what_it_gave_twice_at_one_time(noise) -> None:
    with pytest.raises(fs.InputError, match=r"V and then .* V at the same t = .*give fs\.Samples\(values, rate\)"):
        source_table(fs.Function(noise), 0.0, 0.02, TOL, STEP)


@pytest.mark.parametrize("run", [fs.simulate, lambda c, sources: fs.steady_state(c.replace(sources))])
def test_noise_as_a_source_is_refused_at_once(run) -> None:
    noise = fs.Function(lambda t: DICE.random(), repeat=0.01)
    refuses("allowed: the same value at the same time", run, table1(), sources={"Vdrive": noise})


def test_a_function_that_never_becomes_smooth_is_refused_after_a_bounded_number_of_calls(monkeypatch):
    monkeypatch.setattr(sampling, "_MOST_DEEP", cases(10_000, 1_000))
    counted = Counted(rough)
    with pytest.raises(fs.InputError, match=r"too rough to be followed near t = .*give fs\.Samples\(values, rate\)"):
        source_table(fs.Function(counted), 0.0, 2.0 * STEP, TOL, STEP)
    assert counted.calls < cases(100_000, 11_000)


def test_jumps_that_are_many_but_far_apart_are_still_followed() -> None:
    held = np.random.default_rng(1).normal(size=60)
    with pytest.warns(fs.FingerspiceWarning, match="and 57 more times"):
        source_table(fs.Function(lambda t: held[(np.asarray(t) * 1e4).astype(int)]), 0.0, 0.0059, TOL, STEP)


def rectangle(start: float, width: float):
    return lambda t: np.where((t >= start) & (t < start + width), 100.0, 0.0)


def triangle(start: float, width: float):
    return lambda t: 100.0 * np.maximum(0.0, 1.0 - np.abs((t - start) * 2.0 / width - 1.0))


@pytest.mark.parametrize("shape", [rectangle, triangle])
@settings(max_examples=cases(100, 15), derandomize=True, deadline=None)
@given(length=st.floats(-3.0, 1.0), at=st.floats(0.01, 0.98))
def test_a_pulse_of_a_tenth_of_a_step_is_found_in_a_run_of_a_thousand_steps(shape, length: float, at: float) -> None:
    length = 10.0**length
    step = length / 1000.0
    wave = fs.Function(lambda t: 50.0 * np.sin(40.0 * t / length) + shape(at * length, 0.1 * step)(t))
    table, said = heard(source_table, wave, 0.0, length, TOL, step, shortest=length / 2e4)
    assert said
    t = at * length + np.array([-0.05, 0.02, 0.05, 0.08, 0.2]) * step
    np.testing.assert_allclose(read(table, t), wave.value(t), rtol=0, atol=1e-5)


def test_a_run_meets_the_pulse_of_a_function_and_plan_and_warning_say_what_it_would_miss() -> None:
    circuit = fs.parse_netlist(WITHOUT_TRAN)
    pulse = rectangle(3.21, 2e-3)
    run, said = heard(fs.simulate, circuit, sources=lambda t: pulse(t) + 1.0, t_stop=20.0, rtol=1e-3)
    assert any("the source function jumps by 100 V at t = 3.21" in text for text in said)
    exact = fs.simulate(circuit, sources=fs.Pulse(1.0, 101.0, 3.21, width=2e-3), t_stop=20.0, rtol=1e-6)
    assert run.summary()["u_gap_max"] == pytest.approx(exact.summary()["u_gap_max"], rel=2e-3)
    (said,) = [text for text in run.warnings if "looked at every 1 ms" in text]
    assert "breaks=" in said
    assert any("an event in it shorter than 1 ms may be missed without breaks=" in text for text in run.plan.reasons)


def test_nothing_is_said_of_events_where_the_run_is_short_or_the_edges_are_declared() -> None:
    circuit = fs.parse_netlist(WITHOUT_TRAN)
    for wave, stop in (
        (lambda t: 100.0 * np.sin(600.0 * t), 0.05),
        (fs.Function(lambda t: 1.0 + 0.0 * t, (0.1,)), 20.0),
    ):
        _, said = heard(fs.simulate, circuit, sources=wave, t_stop=stop, rtol=1e-3)
        assert not any("looked at" in text for text in said)


def test_a_function_of_single_numbers_is_not_called_more_often_for_short_events() -> None:
    one, many = Counted(lambda t: 100.0 * math.sin(600.0 * t)), Counted(lambda t: 100.0 * np.sin(600.0 * t))
    for function in (one, many):
        fs.simulate(fs.parse_netlist(WITHOUT_TRAN), sources=function, t_stop=0.05, rtol=1e-4)
    assert 15_000 < many.values - one.values < 25_000


@pytest.mark.parametrize("middle", [0.005, 0.01234567, 0.0333])
@pytest.mark.parametrize("width", [1e-3, 1e-5])
@pytest.mark.parametrize("rtol", [1e-4, 1e-8])
def test_a_function_that_rises_out_of_next_to_nothing_costs_no_more(middle: float, width: float, rtol: float) -> None:
    bump = Counted(lambda t: 100.0 * np.exp(-(((t - middle) / width) ** 2)))
    run = fs.simulate(table1(), sources=fs.Function(bump, breaks=(middle,)), t_stop=0.05, rtol=rtol, charge=False)
    assert bump.values < 200_000
    # Capacitors alone share it as 0.9, resistors alone as 0.5.
    assert 50.0 < run.u_gap_peak < 92.0


def test_a_waveform_of_one_s_own_without_terms_is_sampled() -> None:
    own = type(
        "Own", (fs.Waveform,), {"_quick": 0.01, "value": lambda self, t, side="right": fs.Sine(200, 100).value(t)}
    )
    assert any("a source is a function" in reason for reason in fs.plan(table1(), sources=own(), t_stop=0.02).reasons)
