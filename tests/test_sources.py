"""Sources in a netlist mean what they mean in ngspice, traps included, or are refused by name."""

from __future__ import annotations

import math

import numpy as np
import pytest

import fingerspice as fs
from fingerspice.netlist.netlist import source_from_text
from scenes import table1
from waveform_cases import spice_exp, spice_pulse

TRAN = "1m 100m uic"


def wave(source: str, tran: str = TRAN) -> fs.Waveform:
    waveform = table1(source, tran=tran)["Vdrive"].waveform
    assert waveform is not None
    return waveform


def refusal(source: str, tran: str = TRAN) -> fs.InputError:
    with pytest.raises(fs.InputError) as caught:
        wave(source, tran)
    assert caught.value.where is not None
    assert caught.value.where.line == 3
    return caught.value


T = np.linspace(0.0, 0.1, 997)[1:-1] + 1e-7


@pytest.mark.parametrize(
    ("source", "same"),
    [
        ("5", "DC 5"),
        ("DC 5", "dc(5)"),
        ("5 AC 1", "DC 5 AC 1 0"),
        ("SIN(0 200 100)", "sin 0 200 100"),
        ("SIN(0 200 100)", "SIN ( 0, 200, 100 )"),
        ("SIN(0 200 100)", "DC 3 AC 1 SIN(0 200 100)"),
        ("SIN(0 200 100)", "SIN(0 {100+100} '1e2')"),
        ("SIN(0 200 100)", "SIN(0 200 100 0 0 0)"),
        ("SQUARE(200 100)", "square(200 100 0.5)"),
        ("PULSE(0 1 0 1m 1m 20m 50m)", "pulse(0 1 0 1m 1m 20m 50m)"),
    ],
)
def test_spellings_of_one_source_read_alike(source: str, same: str) -> None:
    assert wave(source) == wave(same)


def test_sin_takes_degrees_and_holds_its_first_value_before_the_delay() -> None:
    read = wave("SIN(1 5 100 20m 3 30)")
    held = 1.0 + 5.0 * math.sin(math.radians(30.0))
    np.testing.assert_allclose(read.value([-1.0, 0.0, 0.01, 0.02]), held, rtol=1e-15)
    t = T[T > 0.02]
    s = t - 0.02
    expected = 1.0 + 5.0 * np.exp(-3.0 * s) * np.sin(2.0 * math.pi * 100.0 * s + math.pi / 6.0)
    np.testing.assert_allclose(read.value(t), expected, rtol=0, atol=1e-12)


def test_sin_without_a_frequency_runs_once_over_the_analysis() -> None:
    with pytest.warns(fs.FingerspiceWarning, match="SIN leaves out FREQ, which is 1/TSTOP then, 10 Hz"):
        assert wave("SIN(0 5)") == fs.Sine(5.0, 10.0)
    assert "FREQ" in str(refusal_without_tran("SIN(0 5)"))


def refusal_without_tran(source: str) -> fs.InputError:
    text = f"no analysis\nVdrive a 0 {source}\nXcoat a 0 area LAYER d=1u eps_r=3.9\nVarea area 0 35\n"
    with pytest.raises(fs.InputError) as caught:
        fs.parse_netlist(text)
    assert caught.value.where is not None
    assert caught.value.where.line == 2
    return caught.value


def test_pulse_edges_left_out_take_tstep_and_an_explicit_zero_is_a_jump() -> None:
    omitted = wave("PULSE(0 8 10m)")
    np.testing.assert_allclose(omitted.value([0.01, 0.01025, 0.0105, 0.011]), [0.0, 2.0, 4.0, 8.0], rtol=1e-12)
    ideal = wave("PULSE(0 8 10m 0 0 20m 50m)")
    # 10 ms + 50 ms is 60 ms up to rounding
    for edge, left, right in ((0.01, 0.0, 8.0), (0.03, 8.0, 0.0), (0.01 + 0.05, 0.0, 8.0)):
        assert float(ideal.value(edge, "left")) == left
        assert float(ideal.value(edge)) == right
    assert "TR, which defaults to TSTEP" in str(refusal_without_tran("PULSE(0 1)"))


def test_pulse_is_at_its_first_value_up_to_its_delay() -> None:
    read = wave("PULSE(-3 8 10m 1m 2m 20m 50m)")
    np.testing.assert_array_equal(read.value([-1.0, 0.0, 0.005, 0.01]), -3.0)
    np.testing.assert_array_equal(read.value([0.0, 0.01], "left"), -3.0)
    np.testing.assert_allclose(
        read.value(T), spice_pulse(T, -3.0, 8.0, 0.01, 0.001, 0.002, 0.02, 0.05), rtol=0, atol=1e-9
    )


def test_a_pulse_without_width_or_period_stays_up() -> None:
    for text in ("PULSE(0 8 10m 1m 1m)", "PULSE(0 8 10m 1m 1m 0 0)"):
        read = wave(text)
        np.testing.assert_array_equal(read.value([0.0111, 0.05, 0.1, 1e6]), 8.0)
        assert read.period is None


def test_exp_has_spices_defaults() -> None:
    full = wave("EXP(1 9 5m 2m 20m 7m)")
    np.testing.assert_allclose(full.value(T), spice_exp(T, 1, 9, 0.005, 0.002, 0.02, 0.007), rtol=0, atol=1e-12)
    # TD2 is TD1 + TSTEP: this one turns back after 1 ms, and both time constants are TSTEP where left out
    short = wave("EXP(0 1 1m 1m)")
    np.testing.assert_allclose(short.value(T), spice_exp(T, 0, 1, 0.001, 0.001, 0.002, 0.001), rtol=0, atol=1e-14)
    assert float(short.value(0.002)) == pytest.approx(1.0 - math.exp(-1.0), rel=1e-12)
    assert float(short.value(0.003)) < float(short.value(0.002))
    with pytest.warns(fs.FingerspiceWarning, match=r"3:16: Vdrive: EXP has TD1 = 0, .* ngspice 39, which takes TSTEP"):
        assert wave("EXP(0 1)") == fs.Exp(0.0, 1.0, 0.0, 0.001, 0.001, 0.001)


def test_pwl_holds_its_ends_and_jumps_where_two_times_are_equal() -> None:
    read = wave("PWL(10m 1 20m 5 20m -3 40m 2)")
    np.testing.assert_allclose(
        read.value([0.0, 0.01, 0.015, 0.02, 0.03, 0.04, 0.1, 1e9]), [1.0, 1.0, 3.0, -3.0, -0.5, 2.0, 2.0, 2.0]
    )
    assert float(read.value(0.02, "left")) == 5.0


@pytest.mark.parametrize("written", ["PWL(0 0 10m 4 20m 1 30m 4) {}", "PWL(0 0 10m 4 20m 1 30m 4 {})"])
def test_pwl_repeats_from_r_on_and_td_shifts_it(written: str) -> None:
    # ngspice 39 takes both ways of writing it; its manual has the first
    read = wave(written.format("r=10m"))
    head = read.value([0.005, 0.01, 0.02, 0.025])
    np.testing.assert_allclose(head, [2.0, 4.0, 1.0, 2.5])
    for k in range(1, 5):
        np.testing.assert_allclose(read.value(np.array([0.01, 0.02, 0.025]) + 0.02 * k), head[1:], rtol=1e-12)
    late = wave(written.format("r=10m td=3m"))
    np.testing.assert_allclose(late.value(T + 0.003), read.value(T), rtol=0, atol=1e-11)
    assert float(late.value(0.002)) == 0.0


def test_square_is_ours_with_a_duty() -> None:
    assert wave("SQUARE(200 100)") == fs.Square(200.0, 100.0)
    read = wave("SQUARE(200 100 0.2)")
    np.testing.assert_array_equal(
        read.value([0.0, 0.00199, 0.002, 0.0099, 0.01]), [200.0, 200.0, -200.0, -200.0, 200.0]
    )


@pytest.mark.parametrize(
    ("source", "said"),
    [
        ("AM(1 2 3 4)", "AM changed its argument order"),
        ("SFFM(1 2 3 4 5)", "SFFM changed its argument order"),
        ("WAVEFILE(sound.wav 100)", "'sound.wav' cannot be read: a netlist given as text has no folder"),
        ("TABLE(data.csv)", "'data.csv' cannot be read: a netlist given as text has no folder"),
        ("PWL(file=data.txt)", "'data.txt' cannot be read: a netlist given as text has no folder"),
        ("SINN(0 200 100)", "did you mean 'sin'?"),
        ("TRNOISE(1 2 3 4)", "unknown source 'TRNOISE'"),
        ("SIN(0)", "SIN needs 2 values, 1 given"),
        ("SIN(0 1 2 3 4 5 6)", "SIN takes at most 6 values, 7 given"),
        ("SIN(0 200 0)", "sine frequency is 0 Hz; allowed: > 0"),
        ("SIN(0 200 100) SIN(0 1 1)", "two source functions"),
        ("5 6", "a second value '6'"),
        ("SIN(0 abc 100)", "abc"),
        ("PULSE(0 1 0 1m 1m 60m 50m)", "at most the period"),
        ("PWL(0 1 2)", "pairs of time and value"),
        ("PWL(0 1 2m 3 1m 4)", "PWL times decrease: 0.001 s follows 0.002 s"),
        ("PWL(0 1 2m 3) r=1m", "PWL repeat time"),
        ("PWL(0 1 2m 3) q=1m", "q"),
        ("SQUARE(200 100 1.5)", "square duty is 1.5; allowed: between 0 and 1"),
        ("EXP(0 1 5m 1m 1m 1m)", "EXP td2 is 0.001 s; allowed: >= td1 = 0.005 s"),
        ("", "Vdrive"),
    ],
)
def test_what_is_no_source_is_refused_with_its_line_and_what_is_allowed(source: str, said: str) -> None:
    assert said in str(refusal(source))


def test_a_source_given_as_text_reads_as_in_the_deck() -> None:
    circuit = table1(tran=TRAN)
    assert source_from_text("SQUARE(200 100)", circuit) == fs.Square(200.0, 100.0)
    assert source_from_text("PULSE(0 8 10m)", circuit) == wave("PULSE(0 8 10m)")
    for text in ("SQUARE(200 100", "SQUAR(200 100)", "SIN(0 1 1)\nR1 a 0 1k", ""):
        with pytest.raises(fs.InputError):
            source_from_text(text, circuit)
