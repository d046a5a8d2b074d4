"""Sources in a netlist mean what they mean in ngspice, traps included, or are refused by name.

What the waveforms are as functions of time is tested by their formulas in `test_waveforms.py`.
"""

from __future__ import annotations

import pytest

import fingerspice as fs
from fingerspice.netlist.netlist import source_from_text
from scenes import table1

TRAN = "1m 100m uic"


def wave(source: str, tran: str = TRAN) -> fs.Waveform:
    waveform = table1(source, tran=tran)["Vdrive"].waveform
    assert waveform is not None
    return waveform


SHAPE, LEVELS = (0.0, 10e-3, 20e-3, 30e-3), (0.0, 4.0, 1.0, 4.0)
# The step of the analysis is 1 ms. "Then" is the same source in another spelling, or as it is made in Python.
SAME: list[tuple[str, str | fs.Waveform]] = [
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
    ("SIN(1 5 100 20m 3 30)", fs.Sine(5.0, 100.0, 1.0, phase_deg=30.0, delay=0.02, damping=3.0)),
    # Edges left out take TSTEP, and an explicit zero is a jump; without width and period the pulse stays up.
    ("PULSE(0 8 10m)", fs.Pulse(0.0, 8.0, 0.01, 1e-3, 1e-3)),
    ("PULSE(0 8 10m 1m 1m)", fs.Pulse(0.0, 8.0, 0.01, 1e-3, 1e-3)),
    ("PULSE(0 8 10m 1m 1m 0 0)", fs.Pulse(0.0, 8.0, 0.01, 1e-3, 1e-3)),
    ("PULSE(0 8 10m 0 0 20m 50m)", fs.Pulse(0.0, 8.0, 0.01, 0.0, 0.0, 0.02, 0.05)),
    ("PULSE(-3 8 10m 1m 2m 20m 50m)", fs.Pulse(-3.0, 8.0, 0.01, 1e-3, 2e-3, 0.02, 0.05)),
    # TD2 is TD1 + TSTEP, and both time constants are TSTEP where left out.
    ("EXP(1 9 5m 2m 20m 7m)", fs.Exp(1.0, 9.0, 5e-3, 2e-3, 0.02, 7e-3)),
    ("EXP(0 1 1m 1m)", fs.Exp(0.0, 1.0, 1e-3, 1e-3, 2e-3, 1e-3)),
    ("PWL(10m 1 20m 5 20m -3 40m 2)", fs.PWL((0.01, 0.02, 0.02, 0.04), (1.0, 5.0, -3.0, 2.0))),
    # ngspice 39 takes both ways of writing it; its manual has the first.
    *(
        (text, fs.PWL(tuple(t + td for t in SHAPE), LEVELS, 0.01 + td))
        for text, td in (
            ("PWL(0 0 10m 4 20m 1 30m 4) r=10m", 0.0),
            ("PWL(0 0 10m 4 20m 1 30m 4 r=10m)", 0.0),
            ("PWL(0 0 10m 4 20m 1 30m 4) r=10m td=3m", 3e-3),
            ("PWL(0 0 10m 4 20m 1 30m 4 r=10m td=3m)", 3e-3),
        )
    ),
    ("SQUARE(200 100 0.2)", fs.Square(200.0, 100.0, duty=0.2)),
    ("SQUARE(200 100)", fs.Square(200.0, 100.0)),
]


@pytest.mark.parametrize(("source", "then"), SAME, ids=[text for text, _ in SAME])
def test_a_source_is_the_one_that_spice_makes_of_it(source: str, then: str | fs.Waveform) -> None:
    assert wave(source) == (wave(then) if isinstance(then, str) else then)


def test_an_edge_that_is_a_sum_of_times_has_both_its_sides() -> None:
    # 10 ms + 50 ms is 60 ms up to rounding.
    ideal = wave("PULSE(0 8 10m 0 0 20m 50m)")
    for edge, left, right in ((0.01, 0.0, 8.0), (0.03, 8.0, 0.0), (0.01 + 0.05, 0.0, 8.0)):
        assert (float(ideal.value(edge, "left")), float(ideal.value(edge))) == (left, right)


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


@pytest.mark.parametrize(
    ("source", "said"),
    [
        ("WAVEFILE(sound.wav 100)", "'sound.wav' cannot be read: a netlist given as text has no folder"),
        ("TABLE(data.csv)", "'data.csv' cannot be read: a netlist given as text has no folder"),
        ("PWL(file=data.txt)", "'data.txt' cannot be read: a netlist given as text has no folder"),
        ("SINN(0 200 100)", "did you mean 'sin'?"),
        ("TRNOISE(1 2 3 4)", "unknown source 'TRNOISE'"),
        ("DC(5 x=1)", "Vdrive: DC has no parameter 'x'; allowed: DC value"),
        ("5 AC(1 90 r=2)", "Vdrive: AC has no parameter 'r'; allowed: AC [magnitude [phase]]"),
        ("SIN(0)", "SIN needs 2 values, 1 given"),
        ("SIN(0 1 2 3 4 5 6)", "SIN takes at most 6 values, 7 given"),
        ("SIN(0 200 0)", "sine frequency is 0 Hz; allowed: > 0"),
        ("SIN(0 200 100) SIN(0 1 1)", "two source functions"),
        ("SIN(0 abc 100)", "abc"),
        ("PULSE(0 1 0 1m 1m 60m 50m)", "at most the period"),
        ("PWL(0 1 2)", "pairs of time and value"),
        ("PWL(0 1 2m 3) r=1m", "PWL repeat time"),
        ("PWL(0 1 2m 3) q=1m", "q"),
        ("SQUARE(200 100 1.5)", "square duty is 1.5; allowed: between 0 and 1"),
        ("EXP(0 1 5m 1m 1m 1m)", "EXP td2 is 0.001 s; allowed: >= td1 = 0.005 s"),
        ("", "Vdrive"),
    ],
)
def test_what_is_no_source_is_refused_with_its_line_and_what_is_allowed(source: str, said: str) -> None:
    with pytest.raises(fs.InputError) as caught:
        wave(source)
    assert caught.value.where is not None
    assert caught.value.where.line == 3
    assert said in str(caught.value)


def test_a_source_given_as_text_reads_as_in_the_deck() -> None:
    circuit = table1(tran=TRAN)
    assert source_from_text("SQUARE(200 100)", circuit) == fs.Square(200.0, 100.0)
    assert source_from_text("PULSE(0 8 10m)", circuit) == wave("PULSE(0 8 10m)")
    for text in ("SQUARE(200 100", "SQUAR(200 100)", "SIN(0 1 1)\nR1 a 0 1k", ""):
        with pytest.raises(fs.InputError):
            source_from_text(text, circuit)
