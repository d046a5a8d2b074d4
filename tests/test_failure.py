"""The failure record of a run: time, place, cause, remedy, and the last attempted steps."""

import json
import math

import numpy as np
import pytest

import fingerspice as fs
from conftest import Command
from fingerspice.results.outcome import Attempt, Failure, last_tried
from scenes import table1


def test_the_last_steps_are_told_in_the_order_they_were_tried() -> None:
    ring = np.array([[5.0, 0.1, 0.5, 6.0], [2.0, 0.1, math.inf, 3.0], [3.0, 0.1, 2.0, 4.0], [0.0, 0.0, 0.0, 0.0]])
    assert [a.t for a in last_tried(ring)] == [2.0, 3.0, 5.0]
    assert last_tried(np.zeros((8, 4))) == ()


@pytest.mark.parametrize("beside", ["", "Rload drive 0 1meg"], ids=["stack", "network"])
def test_a_fold_says_when_where_why_and_what_to_change(beside: str) -> None:
    circuit = table1(gap={"d": "10n"}, extra=beside, tran="20u 10m uic")
    solution = fs.simulate(circuit, charge_law="mobile", throw=False, rtol=1e-6)
    failure = solution.failure
    assert failure is not None
    assert failure.status is solution.status is fs.Status.FOLD
    assert failure.element == "Xgap"
    assert failure.t is not None
    assert 0.0 < failure.t < 0.5e-3
    assert "area and gap voltage drive each other on" in failure.cause
    assert failure.action == "use less voltage, more load, or the local law"
    assert failure.u_gap == pytest.approx(float(solution.u_gap[-1]))
    assert failure.area == pytest.approx(float(solution.area[-1]))
    assert failure.fold_margin is not None
    assert abs(failure.fold_margin) <= 0.01
    assert 3 <= len(failure.tried) <= 8
    assert failure.step == failure.tried[-1].step > 0.0
    times = [a.t for a in failure.tried]
    assert times == sorted(times)
    assert times[-1] == pytest.approx(failure.t, rel=1e-2)
    assert any(a.error > 1.0 for a in failure.tried)
    with pytest.raises(fs.SolveError) as caught:
        fs.simulate(circuit, charge_law="mobile", rtol=1e-6)
    assert caught.value.failure.to_dict() == failure.to_dict()
    assert str(caught.value) == solution.message == str(failure)


def test_a_source_that_stops_being_finite_is_named() -> None:
    circuit = table1()
    solution = fs.simulate(
        circuit, sources={"Vdrive": lambda t: math.nan if t >= 3e-3 else 100.0 * t}, t_stop=5e-3, throw=False
    )
    failure = solution.failure
    assert failure is not None
    assert failure.status is fs.Status.SOURCE_NOT_FINITE
    assert failure.element == "Vdrive"
    assert failure.t == pytest.approx(3e-3, rel=1e-9)
    assert solution.t[-1] <= 3e-3


def test_an_error_that_cannot_be_met_is_put_in_figures() -> None:
    # The gap takes so little of the source that rounding of the source is more than the error asked for.
    circuit = table1(gap={"r": "1u"})
    solution = fs.simulate(circuit, t_stop=5e-3, rtol=1e-12, throw=False)
    failure = solution.failure
    assert failure is not None
    assert failure.status is fs.Status.ERROR_NOT_MET
    assert failure.t is None
    assert "estimate" in failure.cause
    assert failure.action == "ask for a larger rtol"


def test_success_has_no_failure() -> None:
    solution = fs.simulate(table1(), t_stop=1e-3)
    assert solution.failure is None
    assert solution.message == "success"


def test_the_command_line_tells_the_same_in_words_and_in_json(command: Command) -> None:
    words = ["run", "pad.cir", "--charge-law", "mobile", "--set", "Xgap.d=10n", "--no-plot"]
    plain = command(*words)
    assert plain.code == 1
    assert "last steps tried:" in plain.out
    failure = json.loads(command(*words, "--json").out)["failure"]
    assert failure["status"] == "FOLD"
    assert failure["element"] == "Xgap"
    assert set(failure) == {
        *("status", "cause", "action", "t", "step", "element", "u_gap", "area", "fold_margin", "tried")
    }
    assert set(failure["tried"][0]) == {"t", "step", "error"}
    compared = command("compare", *words[1:], "--json")
    assert compared.code == 1
    assert json.loads(compared.out)["failure"]["status"] == "FOLD"


def test_a_failure_in_words_leaves_out_what_is_not_known() -> None:
    bare = Failure(fs.Status.STEP_UNDERFLOW, "a cause", "an action")
    assert str(bare) == "a cause; an action"
    told = Failure(fs.Status.FOLD, "a cause", "an action", 1e-3, "Xgap", 2.0, 3e-6, 0.01, (Attempt(0.0, 1e-6, 0.5),))
    assert str(told) == (
        "stopped at t = 0.001 s: a cause; an action (at Xgap, just before: 2 V across the gap, area 3 mm^2, distance "
        "to the fold 0.01)"
    )
    assert told.history().count("\n") == 1


def test_a_run_near_its_fold_warns_and_says_how_near() -> None:
    circuit = table1().replace({"Vdrive": fs.Sine(50.0, 100.0), "Xgap.d": 1e-7})
    with pytest.warns(fs.FingerspiceWarning, match="fold of the mobile charge law is near"):
        near = fs.simulate(circuit, charge_law="mobile", rtol=1e-6, t_stop=0.05)
    assert near.success
    assert 0.0 < near.fold_margin_min < 0.2
    # Looked for between outputs too, and in a run that repeats its periods.
    with pytest.warns(fs.FingerspiceWarning, match="fold of the mobile charge law is near"):
        few = fs.simulate(circuit, charge_law="mobile", rtol=1e-6, t_eval=[0.0, 0.05, 0.1], t_stop=0.1)
    assert few.fold_margin.min() > 0.9
    assert few.summary()["fold_margin_min"] == pytest.approx(float(near.fold_margin.min()), rel=0.02)
    assert fs.simulate(circuit, charge_law="local", rtol=1e-6).fold_margin_min == 1.0


@pytest.mark.parametrize("t_eval", [[1e-3], [0.0, 1e-3], None])
def test_a_fold_before_or_between_outputs_leaves_what_there_is(t_eval: list[float] | None) -> None:
    circuit = table1().replace({"Xgap.d": 1e-8})
    solution = fs.simulate(circuit, charge_law="mobile", t_eval=t_eval, t_stop=2e-3, throw=False)
    assert solution.status is fs.Status.FOLD
    assert solution.t[-1] == pytest.approx(0.02332418286278 * 0.01, rel=1e-9)
    assert np.all(np.isfinite(solution.u_gap))


def test_a_fold_soon_after_a_jump_at_the_start_is_met() -> None:
    circuit = table1().replace({"Xgap.d": 1e-8})
    # A step takes the gap's share at once and less than the fold; the leak of the layers then brings it there.
    runs = [
        fs.simulate(
            circuit, sources={"Vdrive": fs.DC(u)}, start="uncharged", charge_law="mobile", t_stop=0.02, throw=False
        )
        for u in (2.0, 5.0, 20.0)
    ]
    assert all(run.status in (fs.Status.SUCCESS, fs.Status.FOLD) for run in runs)
    times = [run.failure.t for run in runs if run.failure is not None]
    assert times == sorted(times, reverse=True)
    assert times
