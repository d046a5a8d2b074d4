"""Arguments of a call that replace the circuit's own data, and the one-sentence error for a wrong argument."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import fingerspice as fs
from scenes import table1

SQUARE = fs.Square(200, 100)
CALLS = [fs.simulate, fs.steady_state, fs.compare, fs.phasor, fs.plan]


@pytest.mark.parametrize(
    ("call", "figure"),
    [
        (lambda c, **k: fs.simulate(c, t_stop=0.01, rtol=1e-6, **k), lambda s: s.f_el_mean),
        (lambda c, **k: fs.steady_state(c, rtol=1e-6, **k), lambda s: s.solution.f_el[-1]),
        (lambda c, **k: fs.compare(c, rtol=1e-6, **k), lambda s: s.coupled.f_el_mean),
        (fs.phasor, lambda p: float(p.f_el_mean[0])),
        (fs.plan, lambda p: p.sensitivity),
    ],
    ids=["simulate", "steady_state", "compare", "phasor", "plan"],
)
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
    with pytest.raises(fs.InputError, match=r"the circuit is a \w+; allowed: a Circuit, such as fs\.read_netlist\("):
        call(given)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"sources": np.zeros(5)}, r"got ndarray; values at a rate are fs\.Samples\(values, rate\)"),
        ({"sources": (0.0, 1.0)}, r"got tuple; values at a rate are fs\.Samples"),
        ({"sources": {"Vdrive": Path("x.csv")}}, "a source must be a waveform, a number or a function of time, got"),
        ({"sources": {"Vdrive2": SQUARE}}, "unknown element 'Vdrive2'; nearest: 'Vdrive'"),
        ({"sources": {"Xgap": SQUARE}}, "sources names 'Xgap', which is a GAP; allowed: a V or I element"),
        ({"sources": {3: SQUARE}}, "sources names 3, a int; allowed: names of V or I elements"),
        ({"parameters": ("Xgap.d", 3e-6)}, r"parameters is a tuple; allowed: a mapping such as \{'Xgap.d': 3e-6\}"),
        ({"parameters": "Xgap.d=3u"}, "parameters is a str; allowed: a mapping"),
    ],
)
@pytest.mark.parametrize("call", CALLS)
def test_what_is_no_source_or_parameter_is_refused_with_one_sentence(call: Any, given: Any, said: str) -> None:
    with pytest.raises(fs.InputError, match=said):
        call(table1(), **given)


def test_one_source_for_a_circuit_of_several_is_refused_with_their_names() -> None:
    two = fs.read_netlist(Path(__file__).parents[1] / "circuits" / "ungrounded_user.cir")
    names = [e.name for e in two.by_device("V", "I")]
    if len(names) == 1:
        two = table1(extra="Vbias top b 0\nRb b 0 1meg")
    with pytest.raises(fs.InputError, match=r"sources is one source, and the circuit has .*, .*; allowed: a mapping"):
        fs.simulate(two, sources=SQUARE)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"t_stop": "50m"}, "t_stop is '50m', a str; allowed: a number in s"),
        ({"t_stop": (0.0, 1.0)}, "t_stop is .*, a tuple; allowed: a number in s"),
        ({"t_eval": "50m"}, "t_eval is '50m'; allowed: numbers in s"),
        ({"t_eval": {"a": 1}}, "t_eval is .*; allowed: numbers in s"),
        ({"area": (1e-6, 2e-6)}, "area is .*, a tuple; allowed: 'coupled', 'mean', 'frozen' or a number in m"),
        ({"area": np.zeros(2)}, "area is .*, a ndarray; allowed"),
        ({"rtol": "1e-6"}, "rtol is 1e-6; allowed"),
        ({"method": 3}, "method is 3; allowed: a name"),
        ({"charge_law": 3}, "charge_law is 3; allowed: 'local' or 'mobile'"),
        ({"start": 0.5}, "start is 0.5; allowed: 'deck'"),
    ],
)
def test_arguments_of_another_kind_are_refused_with_one_sentence(given: Any, said: str) -> None:
    with pytest.raises(fs.InputError, match=said):
        fs.simulate(table1(), **given)
