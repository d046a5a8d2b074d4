"""Arguments of a call that replace the circuit's own data, and the one-sentence error for a wrong argument."""

from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import fingerspice as fs
from scenes import refuses, table1, warns

SQUARE = fs.Square(200, 100)
AT_A_RATE = r"values at a rate are fs\.Samples\(values, rate\)"
A_WAVEFORM = "a waveform, a number or a function of time"
CALLS = [fs.simulate, fs.steady_state, fs.compare, fs.phasor, fs.plan]


@pytest.mark.parametrize(("call", "figure"), [
    (lambda c, **k: fs.simulate(c, t_stop=0.01, rtol=1e-6, **k), lambda s: s.f_el_mean),
    (lambda c, **k: fs.steady_state(c, rtol=1e-6, **k), lambda s: s.solution.f_el[-1]),
    (lambda c, **k: fs.compare(c, rtol=1e-6, **k), lambda s: s.coupled.f_el_mean),
    (fs.phasor, lambda p: float(p.f_el_mean[0])),
    (fs.plan, lambda p: p.sensitivity),
], ids=["simulate", "steady_state", "compare", "phasor", "plan"])  # fmt: skip
def test_sources_and_parameters_are_those_of_replace(call: Any, figure: Any) -> None:
    wanted = figure(call(table1().replace({"Vdrive": SQUARE, "Xgap.d": 3e-6})))
    assert figure(call(table1())) != wanted
    assert figure(call(table1(), sources={"vdrive": SQUARE}, parameters={"Xgap.d": 3e-6})) == wanted
    # Of a circuit with one source the name says nothing.
    assert figure(call(table1(), sources=SQUARE, parameters={"Xgap.d": 3e-6})) == wanted


def test_one_source_may_be_a_number_or_a_function_too_and_one_of_current() -> None:
    assert fs.simulate(table1(), sources=5, t_eval=[0.0, 1e-3]).u_source[0] == 5.0
    assert fs.simulate(table1(), sources=lambda t: 7.0 + 0.0 * t, t_eval=[0.0, 1e-3]).u_source[0] == 7.0
    driven = fs.read_netlist(Path(__file__).parents[1] / "circuits" / "current_drive.cir")
    by_name = fs.simulate(driven, sources={"Idrive": fs.Sine(1e-4, 5000)}, t_stop=1e-4)
    np.testing.assert_array_equal(fs.simulate(driven, sources=fs.Sine(1e-4, 5000), t_stop=1e-4).u_gap, by_name.u_gap)


@pytest.mark.parametrize("call", [*CALLS, fs.fold_limits, fs.export_netlist, lambda c: fs.large_signal(c, [100.0])])
@pytest.mark.parametrize("given", ["deck.cir", Path("deck.cir"), ("deck.cir",), np.zeros(3), None])
def test_what_is_no_circuit_is_refused_with_how_one_is_made(call: Any, given: Any) -> None:
    refuses(r"the circuit is a \w+; allowed: a Circuit, such as fs\.read_netlist\(", call, given)


# What every call refuses, and what a run does.
NO_SOURCES: list[tuple[Any, str]] = [
    ({"sources": np.zeros(5)}, rf"a source is array\(.*, a ndarray; .* {AT_A_RATE}"),
    ({"sources": (0.0, 1.0)}, r"a source is \(0\.0, 1\.0\), a tuple; .* values at a rate are fs\.Samples"),
    ({"sources": {"Vdrive": Path("x.csv")}}, rf"a source is .*x\.csv.*; allowed: {A_WAVEFORM}"),
    ({"sources": {"Vdrive2": SQUARE}}, "unknown element 'Vdrive2'; nearest: 'Vdrive'"),
    ({"sources": {"Xgap": SQUARE}}, "sources names 'Xgap', which is a GAP; allowed: a V or I element"),
    ({"sources": {3: SQUARE}}, "sources names 3, a int; allowed: names of V or I elements"),
    ({"parameters": ("Xgap.d", 3e-6)}, r"parameters is a tuple; allowed: a mapping such as \{'Xgap.d': 3e-6\}"),
    ({"parameters": "Xgap.d=3u"}, "parameters is a str; allowed: a mapping"),
]
NO_ARGUMENTS: list[tuple[Any, str]] = [
    ({"t_stop": "50m"}, "t_stop is '50m'; allowed: a number in s"),
    ({"t_stop": (0.0, 1.0)}, "t_stop is .*, a tuple; allowed: a number in s"),
    ({"t_eval": "50m"}, "t_eval is '50m'; allowed: numbers in s"),
    ({"t_eval": {"a": 1}}, "t_eval is .*; allowed: numbers in s"),
    ({"t_eval": np.ma.array([0.0, 1e-3], mask=[False, True])}, "a MaskedArray with masked values; allowed: numbers in"),
    ({"area": (1e-6, 2e-6)}, "area is .*, a tuple; allowed: 'coupled', 'mean', 'frozen' or a number in m"),
    ({"area": np.zeros(2)}, "area is .*, a ndarray; allowed"),
    ({"rtol": "1e-6"}, "rtol is '1e-6'; allowed: 1e-13 to 0.1"),
    ({"method": 3}, "method is 3; allowed: a name"),
    ({"charge_law": 3}, "charge_law is 3; allowed: 'local' or 'mobile'"),
    ({"start": 0.5}, "start is 0.5; allowed: 'deck'"),
]


@pytest.mark.parametrize(
    ("call", "given", "said"),
    [*((c, *one) for c in CALLS for one in NO_SOURCES), *((fs.simulate, *one) for one in NO_ARGUMENTS)],
)
def test_an_argument_of_another_kind_is_refused_with_one_sentence(call: Any, given: Any, said: str) -> None:
    refuses(said, call, table1(), **given)


def test_one_source_for_a_circuit_of_none_or_several_is_refused() -> None:
    alone = fs.parse_netlist("t\nC1 a 0 1n IC=5\nR1 a 0 1meg\n.tran 1u 1m uic\n")
    refuses("the circuit has none; allowed: no sources", fs.simulate, alone, sources=5.0)
    two = table1(extra="Vbias top b 0\nRb b 0 1meg")
    refuses(r"the circuit has Vdrive, Vbias; allowed: a mapping such as \{'Vdrive': ", fs.simulate, two, sources=SQUARE)


# Of every kind that a user may have -----------------------------------------------------------------------------------

NO_NUMBERS = [
    3j, np.complex64(1), True, np.True_, b"3", [1.0], (1.0,), np.ones(1), np.ma.masked, np.ma.array(1.0, mask=True),
    np.datetime64("2026"), np.timedelta64(1, "s"), np.array(1.0, object), object(), {},
]  # fmt: skip
# Calls with one number, each with a number that it takes.
ONE_NUMBER: dict[str, tuple[Any, float]] = {
    "a constant": (fs.DC, 2.0),
    "an amplitude": (lambda x: fs.Sine(x, 100.0), 2.0),
    "a frequency": (lambda x: fs.Chirp(1.0, x, 10.0, 1.0), 2.0),
    "a duty": (lambda x: fs.Square(1.0, 100.0, x), 0.5),
    "a width": (lambda x: fs.Pulse(0.0, 1.0, width=x), 2.0),
    "a depth": (lambda x: fs.AM(1.0, 1000.0, 10.0, x), 0.5),
    "a duration": (lambda x: fs.Burst(fs.DC(1.0), x), 2.0),
    "a rate": (lambda x: repr(fs.Samples([0.0, 1.0], x)), 2.0),
    "the repeat of a PWL": (lambda x: fs.PWL((0.0, 0.5, 1.0), (0.0, 1.0, 0.0), x), 0.5),
    "the period of a function": (lambda x: fs.Function(np.sin, (), x).period, 2.0),
    "a factor": (lambda x: repr(fs.Samples([0.0, 1.0], 9.0).upsampled(x)), 2.0),
    "a source": (lambda x: table1().replace({"Vdrive": x})["Vdrive"].waveform, 2.0),
    "a parameter": (lambda x: table1().replace({"Xgap.fn": x})["Xgap"].values["fn"], 2.0),
    "t_stop": (lambda x: str(fs.plan(table1(), t_stop=x)), 0.5),
    "rtol": (lambda x: str(fs.plan(table1(), rtol=x)), 2.0**-10),
    "area": (lambda x: fs.phasor(table1(), 100.0, area=x).gain[0], 2.0**-15),
    "points": (lambda x: fs.steady_state(table1(), rtol=1e-3, points=x).solution.t.size, 4.0),
}


@pytest.mark.parametrize("name", ONE_NUMBER)
def test_numbers_of_every_kind_count_as_the_double_and_nothing_else_does(name: str) -> None:
    call, number = ONE_NUMBER[name]
    double = call(number)
    kinds = [np.float64, np.float32, np.array, Fraction, np.longdouble, np.ma.array, torch.tensor]
    kinds += [int, np.uint8, np.int64] if number.is_integer() else []
    for kind in kinds:
        assert call(kind(number)) == double
    for given in NO_NUMBERS:
        refuses("allowed", call, given)


def test_a_gap_of_3_m_is_warned_about_whatever_the_number_is_made_of() -> None:
    for given in (3.0, 3, np.int8(3), np.array(3), torch.tensor(3), torch.tensor(3.0)):
        warns("Xgap d is 3 m, outside .* was 3u meant", table1().replace, {"Xgap.d": given})


ROW = np.array([0.0, 1.0, 2.0])
NO_ROWS = [
    ROW + 1j, (ROW + 0j).tolist(), np.ma.array(ROW, mask=[False, True, False]), ROW.astype(str), ["0", "1", "2"],
    ROW > 0.5, ROW.astype(object), [None, 1.0, 2.0], ROW.astype("M8[s]"), ROW.astype("m8[s]"), [[0.0], [1.0, 2.0]],
    {0: 1}, object(), torch.tensor(ROW + 1j), torch.tensor(ROW, requires_grad=True),
]  # fmt: skip
# Calls with a row of numbers.
ROWS: dict[str, Any] = {
    "samples": lambda x: fs.Samples(x, 1.0).values,
    "times of a PWL": lambda x: fs.PWL(x, [0.0, 1.0, 2.0]).times,
    "values of a PWL": lambda x: fs.PWL([0.0, 1.0, 2.0], x).values,
    "breaks": lambda x: fs.Function(np.sin, x).breaks,
    **{
        f"times of {type(wave).__name__}": wave
        for wave in (
            fs.DC(1.0), fs.Sine(1.0, 0.3), fs.Square(1.0, 0.3), fs.AM(1.0, 3.0, 0.3), fs.Chirp(1.0, 1.0, 2.0, 1.0),
            fs.Exp(0.0, 1.0, 0.0, 1.0, 1.0, 1.0), fs.Burst(fs.DC(1.0), 1.0), fs.Repeat(fs.Sine(1.0, 0.3), 1.0),
            fs.Samples([0.0, 1.0], 1.0), fs.PWL([0.0, 1.0], [0.0, 1.0]), fs.Function(np.sin),
        )
    },
    "t_eval": lambda x: fs.simulate(table1(), t_stop=2.0, t_eval=x, area="frozen", sources=fs.DC(1.0)).t,
    "a batch": lambda x: fs.batch(table1(), {"Vdrive.amplitude": x}, rtol=1e-2, periods=1.0).f_el_mean.to_numpy(),
    "a sweep": lambda x: fs.sweep(table1(), {"Vdrive.offset": x}, rtol=1e-2, periods=1.0).f_el_mean.to_numpy(),
    "a force": lambda x: fs.inverse_drive(table1(), force=x, rate=1e3, limit=1.0).drive.values,
}  # fmt: skip


@pytest.mark.parametrize("name", ROWS)
def test_rows_of_every_kind_count_as_those_of_doubles_and_nothing_else_does(name: str) -> None:
    doubles = ROWS[name](ROW)
    for given in (ROW.astype(np.uint8), ROW.astype(np.float16), np.ma.array(ROW)):
        np.testing.assert_array_equal(ROWS[name](given), doubles)
    for given in NO_ROWS:
        refuses("allowed", ROWS[name], given)


@pytest.mark.parametrize("t_stop", [1e-7, 0.3, 1e-3 / 3.0])
def test_times_that_pass_an_end_by_rounding_are_that_end(t_stop: float) -> None:
    exact = fs.simulate(table1(), t_stop=t_stop, t_eval=[0.0, t_stop], rtol=1e-6)
    for off in (1, 2, 3):
        beyond = t_stop * (1.0 + off * 2.0**-52)
        given = np.array([-1e-17 * t_stop, beyond])
        near = fs.simulate(table1(), t_stop=t_stop, t_eval=given, rtol=1e-6)
        assert given[-1] == beyond, "the caller's own array"
        np.testing.assert_array_equal(near.t, exact.t)
        np.testing.assert_array_equal(near.u_gap, exact.u_gap)
    for t_eval in ([0.0, t_stop * (1.0 + 1e-14)], [-1e-14 * t_stop, t_stop]):
        refuses(r"t_eval is .*; allowed: times from 0 s to t_stop", fs.simulate, table1(), t_stop=t_stop, t_eval=t_eval)
