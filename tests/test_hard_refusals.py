"""The hard cases without a solution: each is refused with time, place, cause and remedy, without wrong values.

Also the failure record of a run, and jumps under `mobile`: a run stays on its branch and never skips a fold.
"""

import dataclasses
import math
import re
import warnings
from functools import lru_cache

import numpy as np
import pytest

import analytic as ref
import fingerspice as fs
import stress
from fingerspice.results.outcome import Failure
from hard_cases_reference import StackFold, stack_fold
from scenes import deck, finger, table1

SINE = ref.sine_segments(200.0, 100.0, 0.02)
V = "Vdrive drive 0 SIN(0 200 100)"


# What is changed, where the table puts the fold in periods, and how near the run is asked to come to it.
FOLDS = {
    "gap of 10 nm": ({"Xgap.d": 10e-9}, {"d_a": 10e-9}, 0.0233, 1e-9),
    # The gap voltage follows a slow drift: the distance to the fold goes with the square of the time that is left, and
    # its last 1e-15 are the last 1e-8 of the time.
    "load of 0.1 mN": ({"Xgap.fn": 1e-4}, {"force_normal": 1e-4}, 0.082, 5e-8),
}


@lru_cache(None)
def fold_of(case: str) -> StackFold:
    return stack_fold(dataclasses.replace(ref.TABLE1, **FOLDS[case][1]), 200.0, 100.0)


@pytest.mark.parametrize("case", FOLDS)
def test_the_reference_fold_is_where_the_table_says_by_two_methods(case: str) -> None:
    params = dataclasses.replace(ref.TABLE1, **FOLDS[case][1])
    one, other = fold_of(case), stack_fold(params, 200.0, 100.0, method="Radau")
    assert one.t == pytest.approx(other.t, rel=1e-11)
    assert one.t / 0.01 == pytest.approx(FOLDS[case][2], abs=5e-4 if case == "load of 0.1 mN" else 5e-5)
    if case == "gap of 10 nm":
        # The collocation of `analytic.py` meets the same one, as near as it extrapolates.
        near = ref.transient(SINE, [], law="mobile", freq=100.0, params=params).fold
        assert near.t == pytest.approx(one.t, rel=1e-8)


@pytest.mark.parametrize("case", FOLDS)
def test_a_run_past_the_fold_stops_there_and_says_where_how_near_why_and_what_to_change(case: str) -> None:
    changes, params, _, near = FOLDS[case]
    fold = fold_of(case)
    with pytest.raises(fs.SolveError) as caught:
        fs.simulate(table1().replace(changes), charge_law="mobile")
    said, kept = str(caught.value), caught.value.solution
    assert said.startswith(f"stopped at t = {fold.t:.6g}"[:-1])
    assert "no solution past this time" in said
    assert "area and gap voltage drive each other on" in said
    assert "use less voltage, more load, or" in said
    assert f"{fold.u_gap:.3f} V across the gap, area {1e6 * fold.area:.4g} mm^2, distance to the fold" in said
    assert (kept.status, kept.success) == (fs.Status.FOLD, False)
    assert kept.state.t == pytest.approx(fold.t, rel=near)
    # What came before is kept, and ends at the fold.
    assert kept.t[-1] <= fold.t * (1.0 + near)
    assert kept.t[-1] >= fold.t * (1.0 - 1e-3)
    assert np.all(np.isfinite(kept.u_layer))
    assert kept.stats["steps"] + kept.stats["rejected"] <= 5000
    # Over nine tenths of the way its error is the one asked for, and the one stated.
    before = kept.t < 0.9 * fold.t
    assert before.sum() > 10
    whole, segments = dataclasses.replace(ref.TABLE1, **params), ref.sine_segments(200.0, 100.0, 0.9 * fold.t)
    expected = ref.transient(segments, kept.t[before], law="mobile", freq=100.0, params=whole, tol=1e-12)
    error = float(np.abs(kept.u_gap[before] - expected.u_gap).max())
    assert error <= min(kept.rtol * fold.u_gap, kept.error.u_gap)


@pytest.mark.parametrize("case", FOLDS)
def test_the_local_law_has_no_fold_in_the_same_scene(case: str) -> None:
    changes, params, *_ = FOLDS[case]
    t = np.linspace(0.0, 0.0199, 57)
    expected = ref.transient(SINE, t, freq=100.0, params=dataclasses.replace(ref.TABLE1, **params))
    with warnings.catch_warnings():
        # Next to no contact is left.
        warnings.filterwarnings("ignore", "the contact area falls")
        solution = fs.simulate(table1().replace(changes), t_eval=t, t_stop=0.02)
    assert np.abs(solution.u_gap - expected.u_gap).max() <= 1e-8 * np.abs(expected.u_gap).max()


@pytest.mark.filterwarnings("ignore:the contact area falls")
@pytest.mark.parametrize(("gap", "rtol"), [(5e-8, 3e-3), (1e-7, 1e-2), (2e-7, 3e-3)])
def test_a_fold_is_not_believed_while_a_finer_run_meets_it_elsewhere(gap: float, rtol: float) -> None:
    # Steps as coarse as these errors ask for end a hundred-thousandth to a ten-thousandth of the time too late.
    fold = stack_fold(dataclasses.replace(ref.TABLE1, d_a=gap), 200.0, 100.0)
    circuit = table1().replace({"Xgap.d": gap})
    kept = fs.simulate(circuit, charge_law="mobile", method="radau", rtol=rtol, throw=False)
    assert kept.status is fs.Status.FOLD
    assert kept.state.t == pytest.approx(fold.t, rel=1e-5)


def test_a_square_of_two_kilovolt_jumps_past_the_fold_at_its_first_reversal() -> None:
    expected = ref.transient(ref.square_segments(2000.0, 100.0, 1), [], law="mobile", freq=100.0)
    with pytest.raises(fs.SolveError, match="the source jumps past the fold at this time") as caught:
        fs.simulate(table1(), sources={"Vdrive": fs.Square(2000.0, 100.0)}, charge_law="mobile")
    assert str(caught.value).startswith("stopped at t = 0.005 s:")
    kept = caught.value.solution
    assert kept.state.t == pytest.approx(expected.fold.t, rel=1e-15)
    before = expected.at(kept.t[:-1])
    assert np.abs(kept.u_gap[:-1] - before.u_gap).max() <= 1e-8 * np.abs(before.u_gap).max()
    assert np.all(np.isfinite(kept.u_layer))


def test_behind_a_resistor_the_fold_is_where_the_gap_takes_its_largest_charge() -> None:
    # 1 ohm changes nothing else, yet the run ends a fifth earlier: past that charge no resistor holds the gap.
    fold = stack_fold(dataclasses.replace(ref.TABLE1, d_a=10e-9), 200.0, 100.0, resisted=True)
    assert fold.t < 0.81 * fold_of("gap of 10 nm").t
    lines = V, *finger("drive", "body", f=100.0, d="10n"), ".tran 1u 1m uic"
    decks = [deck(*lines, f"Rbody body 0 {r_series}") for r_series in (1.0, 0.01)]
    runs = [fs.simulate(one, charge_law="mobile", rtol=1e-10, throw=False) for one in decks]
    assert all(run.status is fs.Status.FOLD for run in runs)
    assert "distance to the fold" in runs[0].message
    assert "at Xgap" in runs[0].message
    late = [run.state.t / fold.t - 1.0 for run in runs]
    assert 0.0 <= late[1] < 0.2 * late[0] < 1e-6


@lru_cache(None)
def first_3_ms(law: str) -> ref.Transient:
    return ref.transient(ref.sine_segments(200.0, 100.0, 3.01e-3), [], law=law, freq=100.0)


NETWORK = (V, *finger("drive", "body", f=100.0), "Cbody body 0 200p", ".tran 10u 20m uic")


@pytest.mark.parametrize(
    ("bad", "law"),
    [*((bad, law) for bad in (math.nan, math.inf, -math.inf) for law in ("local", "mobile")), (math.nan, None)],
)
def test_a_source_without_a_number_is_named_with_the_time_and_nothing_follows(bad: float, law: str | None) -> None:
    def source(t: np.ndarray) -> np.ndarray:
        return np.where(np.asarray(t) < 3e-3, 200.0 * np.sin(2.0 * np.pi * 100.0 * np.asarray(t)), bad)

    circuit = deck(*NETWORK) if law is None else table1()
    with pytest.raises(fs.SolveError) as caught:
        fs.simulate(circuit, sources={"Vdrive": source}, charge_law=law, t_stop=0.02)
    for part in ("t = 0.003 s: a source gave NaN or inf", "Vdrive", "nothing after this time is a result"):
        assert part in str(caught.value)
    kept = caught.value.solution
    assert kept.status is fs.Status.SOURCE_NOT_FINITE
    assert (kept.failure.element, kept.failure.t) == ("Vdrive", pytest.approx(3e-3, rel=1e-9))
    assert kept.t[-1] == pytest.approx(3e-3, rel=1e-10)
    # The last row may stand at 3 ms itself, with the value from the left.
    assert kept.t[-1] <= 3e-3
    assert np.all(np.isfinite(kept.u_gap))
    if law is not None:
        expected = first_3_ms(law).at(kept.t)
        assert np.abs(kept.u_gap - expected.u_gap).max() <= 1e-8 * np.abs(expected.u_gap).max()


def test_nan_at_one_instant_that_is_an_output_is_not_passed_over() -> None:
    def source(t: np.ndarray) -> np.ndarray:
        return np.where(np.asarray(t) == 3e-3, np.nan, 200.0 * np.sin(2.0 * np.pi * 100.0 * np.asarray(t)))

    with pytest.raises(fs.SolveError, match="NaN or inf"):
        fs.simulate(table1(), sources={"Vdrive": source}, t_stop=0.02, t_eval=[1e-3, 3e-3, 0.02])


STACK = ["Vdrive drive 0 50", *(re.sub(r" r=\S+", "", line) for line in finger("drive", "0", f=100.0))]


@pytest.mark.parametrize(
    ("lines", "said"),
    [(STACK, ("Xcoat and Xgap", "a leakage (r=...)")), (["V1 a 0 5", "C1 a b 1n", "C2 b 0 3n"], ("C1 and C2",))],
    ids=["stack", "network"],
)
def test_a_node_reached_by_capacitors_only_has_no_operating_point(lines: list[str], said: tuple[str, ...]) -> None:
    with pytest.raises(fs.InputError) as caught:
        fs.simulate(deck(*lines, ".tran 10u 10m"))
    for part in ("no DC operating point", *said, "uic"):
        assert part in str(caught.value)
    # With uic it is what the capacitors make of it.
    solution = fs.simulate(deck(*lines, ".tran 10u 10m uic"))
    if lines is not STACK:
        np.testing.assert_allclose(solution.node_voltages["b"], 1.25, rtol=1e-14)
        return
    coat, gap, skin = ref.table1_layers(100.0)
    layers = (dataclasses.replace(coat, r_total=math.inf), dataclasses.replace(gap, r_total=math.inf), skin)
    expected = ref.transient([(0.0, 0.011, 50.0)], solution.t, layers=layers)
    assert np.abs(solution.u_gap - expected.u_gap).max() <= 1e-8 * np.abs(expected.u_gap).max()


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
    assert failure.history().count("\n") == len(failure.tried)
    with pytest.raises(fs.SolveError) as caught:
        fs.simulate(circuit, charge_law="mobile", rtol=1e-6)
    assert caught.value.failure.to_dict() == failure.to_dict()
    assert str(caught.value) == solution.message == str(failure)


def test_an_error_that_cannot_be_met_is_put_in_figures() -> None:
    # The gap takes so little of the source that rounding of the source is more than the error asked for.
    solution = fs.simulate(table1(gap={"r": "1u"}), t_stop=5e-3, rtol=1e-12, throw=False)
    failure = solution.failure
    assert failure is not None
    assert failure.status is fs.Status.ERROR_NOT_MET
    assert failure.t is None
    # What is not known is left out.
    assert str(failure) == f"{failure.cause}; {failure.action} (at Xgap)"
    assert str(Failure(failure.status, "a cause", "an action")) == "a cause; an action"
    assert "estimate" in failure.cause
    assert failure.action == "ask for a larger rtol"


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
    far = fs.simulate(circuit, charge_law="local", rtol=1e-6)
    assert (far.fold_margin_min, far.failure, far.message) == (1.0, None, "success")


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


@pytest.mark.filterwarnings("ignore::fingerspice.FingerspiceWarning")
@pytest.mark.parametrize("number", [1730, 1974, 9735])
def test_a_jump_past_a_fold_is_seen_though_the_slope_is_right_at_both_ends(number):
    # A long stride from large voltage to 0 V, or away from it, finds a rising slope on either side of a fold.
    scene = stress.draw(0, number)
    solution = fs.simulate(scene.circuit, charge_law="mobile", rtol=1e-6, throw=False)
    assert solution.status is fs.Status.FOLD
    assert solution.failure.t == pytest.approx(0.5 / scene.frequency, rel=1e-12)
