"""The loop of exponential steps: it tries lengths until the error of a step is small enough, and goes on to the end.

What a step consists of depends on the circuit: a stack has one area and one source (`engine.one_area.step`), a network
any number of both (`engine.many_areas.step`). The first functions below stand for those of the circuit at hand.

The loop is not inlined, nor is what begins a step of a network (`jit`): all in one function would take the compiler
much longer. What an inlined function calls is inlined with it, even where it does not say so.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from fingerspice.base.arrays import FloatArray
from fingerspice.base.compiled import borrow, jit, jit_by_kind, jit_within
from fingerspice.engine.collocation import readout, step_control
from fingerspice.engine.collocation.readout import LoopState
from fingerspice.engine.collocation.step_control import NOT_FRESH, Pace, accept, allowed_factor, rung, shorten
from fingerspice.engine.many_areas import step as network
from fingerspice.engine.many_areas.step import ManyAreas
from fingerspice.engine.one_area import step as stack
from fingerspice.engine.one_area.step import OneArea

# The coupling may make the slowest mode slower than with the area frozen; this fraction of its rate is a safe bound.
RATE_SHARE = 0.5
# Part of the largest gap voltage up to which another one is taken for 0.
_UNNOTICED = 1e-9
# Looks with finer steps after which the charge counts as settled with the voltages: what is left of it is stated.
_FINE_LOOKS = 3
# Entries of `Looks.values`. Times (s): next look; first comparison of the stated error with the one asked for; start,
# period and end of the run under the periodic source.
NEXT, TRIAL, START, PERIOD, STOP = range(5)
# Error of the gap voltage allowed, V; a bound of the slowest rate, 1/s; whether the charge is wanted.
ALLOWED, RATE, HAS_CHARGE = range(5, 8)
# Largest ratio of error to peak, as estimated, that the trial accepts.
ACCEPTABLE = 8
# Periods until the next look, and until the last one, or -1; periods left after that.
COUNT, LOOKED, LEFT = range(9, 12)
# What the last look found: bound of the change of the gap voltage in all later periods, and that enlarged by its effect
# on the charge, V; whether the run has settled.
DISTANCE, REMAINING, HAS_SETTLED = range(12, 15)
# Looks since steps are finer, as the voltages had settled and the charge had not; 0 before that.
FINE, N_VALUES = 15, 16


class Looks(NamedTuple):
    """When a run looks for its periodic state, and what it has found."""

    values: FloatArray  # (N_VALUES,): The entries are named above
    before: FloatArray  # (n,): State at the last look, V
    scale: FloatArray  # (n,): Converts the first n entries of the integration's state to volts


def no_looks() -> Looks:
    """For a run that does not look for a periodic state."""
    values = np.zeros(N_VALUES)
    values[NEXT] = values[TRIAL] = math.inf
    return Looks(values, np.zeros(0), np.zeros(0))


@jit
def next_stop(looks: Looks, edges: FloatArray, t_end: float) -> float:
    """Time (s) of the next look or trial, or the edge of the sources that differs from it by rounding only."""
    v = looks.values
    t = float(min(v[NEXT], v[TRIAL]))
    if t < t_end:
        for i in range(edges.size):
            if abs(edges[i] - t) <= readout.SAME_TIME * abs(edges[i]):
                return float(min(edges[i], t_end))
    return min(t, t_end)


@jit
def look(looks: Looks, s: LoopState) -> bool:
    """Compare the state with that of the last look; True if the caller has something to do.

    Sets what the look has found, and plans the next one.
    """
    v, before = looks.values, looks.before
    left = max(0.0, float(np.floor((v[STOP] - v[NEXT]) / v[PERIOD] * (1.0 + 1e-12))))
    v[LEFT] = left
    if s.kept.times.size > 0:
        # The period that is to be repeated has passed.
        return True
    moved = 0.0
    for k in range(before.size):
        now = looks.scale[k] * s.y[k]
        moved = max(moved, abs(now - before[k]))
        before[k] = now
    moved *= s.control[0].magnified
    v[DISTANCE] = v[REMAINING] = math.inf
    # Periods in which the slowest mode of the frozen circuit decays to 1/e.
    memory = RATE_SHARE / (v[RATE] * v[PERIOD])
    wait = 1.0
    if v[LOOKED] >= 0.0:
        passed = v[COUNT] - v[LOOKED]
        decay = min(v[RATE] * v[PERIOD] * passed, 700.0)
        # Later changes form a geometric series, or with negligible decay each period changes as much as the last.
        v[DISTANCE] = v[REMAINING] = moved * min(left / passed, max(1.0 / math.expm1(decay), 1e-3))
        if v[HAS_CHARGE] > 0.0:
            # The charge error of the repeated period accumulates in every later period.
            v[REMAINING] *= max(1.0, left * min(1.0, v[RATE] * v[PERIOD]))
        # Until the distance has decayed to what is allowed, and long enough that the steps' errors are not most of a
        # change.
        wait = 0.8 * memory * max(1.0, math.log(max(v[DISTANCE] / v[ALLOWED], 1e-300)))
        wait = max(1.0, min(float(np.ceil(wait)), 2.0 * v[COUNT]))
    near = v[DISTANCE] <= v[ALLOWED]
    settled = near and (v[FINE] > _FINE_LOOKS or v[REMAINING] <= v[ALLOWED])
    v[FINE] += 1.0 if v[FINE] > 0.0 else 0.0
    v[HAS_SETTLED], v[LOOKED] = 1.0 if settled else 0.0, v[COUNT]
    v[COUNT] += 1.0 if settled else wait
    v[NEXT] = v[START] + v[COUNT] * v[PERIOD] if v[COUNT] - v[LOOKED] < left else math.inf
    return bool(settled or (near and v[FINE] == 0.0))


Circuit = OneArea | ManyAreas
# The parts of a step, which both kinds of circuits have: begin a call of the loop; find where the next step starts, and
# the length to try first; solve a step of that length, and estimate its error; tell why no shorter step would do after
# one that was rejected (GO_ON if one may), and whether it went far beyond a zero; the fraction of an accepted one at
# which the gap voltage of an area leaves its branch, or 2; write its outputs, account for its errors, and take the
# state at its end; end a call.
_start, _begin, _attempt, _refuse, _crossing, _finish, _end = (
    jit_by_kind(OneArea=getattr(stack, part), ManyAreas=getattr(network, part))
    for part in ("start", "begin", "attempt", "refuse", "crossing", "finish", "end")
)


@jit
def worst(peaks: FloatArray) -> float:
    """Largest ratio of the estimated error to the peak so far, over the voltages and forces of all gaps."""
    found, largest = 0.0, 0.0
    for a in range(peaks.shape[0]):
        largest = max(largest, peaks[a, readout.PEAK_U])
    for a in range(peaks.shape[0] - 1):
        if peaks[a, readout.PEAK_U] > _UNNOTICED * largest:
            found = max(found, peaks[a, readout.ERROR_U] / peaks[a, readout.PEAK_U])
            if peaks[a, readout.PEAK_F] > 0.0:
                found = max(found, peaks[a, readout.ERROR_F] / peaks[a, readout.PEAK_F])
    return found


@jit
def march_on(circuit: Circuit, pace: Pace, state: LoopState, looks: Looks, t_end: float) -> int:
    """As `march`, and look for the periodic state on the way.

    Returns with EXCESSIVE where a trial of the error fails, and with LOOKED_AT where a look has found something.
    """
    circuit, state, looks = borrow(circuit), borrow(state), borrow(looks)
    while True:
        stop = next_stop(looks, circuit.sources.edges, t_end)
        code = march(circuit, pace, state, stop)
        if code != readout.DONE:
            return code
        slack = readout.SAME_TIME * abs(stop)
        if stop >= looks.values[TRIAL] - slack:
            looks.values[TRIAL] = math.inf
            if worst(state.peaks) > looks.values[ACCEPTABLE]:
                return readout.EXCESSIVE
        if stop >= looks.values[NEXT] - slack and look(looks, state):
            return readout.LOOKED_AT
        if state.control[0].t >= t_end:
            return readout.DONE


@jit
def march(circuit: Circuit, pace: Pace, state: LoopState, t_end: float) -> int:
    """Step to `t_end` (s; not past the last edge of the sources), writing outputs on the way.

    `pace` has the rules for the lengths of the steps, `state` is the integration so far, which is updated. Returns a
    code of `engine.collocation.readout`.
    """
    # Arrays without a reference count: it would cost an atomic operation at every access to a tuple.
    circuit, state = borrow(circuit), borrow(state)
    step, control, counters = state.step[0], state.control[0], state.counters
    # Other runs may have used the tables since the last call.
    step.trusted, step.tabled, step.level, step.flips = 1, 0.0, -1, 0
    if step.is_paused == 0:
        _start(circuit, state)
    step.is_paused = 0
    while True:
        code: int = readout.TOO_MANY
        if step.in_jump == 0 and control.t < t_end and counters[readout.RECORDED] >= state.steps.times.shape[0]:
            step.is_paused, code = 1, readout.PAUSED
        elif counters[readout.ACCEPTED] + counters[readout.REJECTED] <= step.most:
            code = _begin(circuit, pace, state, t_end)
        if code == readout.GO_ON:
            code = _find_length(circuit, pace, state)
        if code == readout.GO_ON:
            code = _complete(circuit, pace, state)
        if code >= readout.DONE:
            _end(circuit, state)
            return code


@jit
def _find_length(circuit: Circuit, pace: Pace, state: LoopState) -> int:
    """Solve a step with ever shorter lengths until its error is small enough, and choose the next step's length."""
    step, control, counters = state.step[0], state.control[0], state.counters
    step.wanted, step.tries = control.h, 1
    while True:
        code: int = _attempt(circuit, pace, state)
        if code == readout.RETRY:
            continue
        if code != readout.GO_ON:
            return code
        h, error, converged = step.length, step.step_error, step.converged > 0
        readout.note(
            state.tried, counters[readout.ACCEPTED] + counters[readout.REJECTED], control.t, h, error / pace.tol
        )
        if converged and not pace.controlled:
            return readout.GO_ON
        factor = allowed_factor(error, pace.tol)
        if error <= pace.tol:
            accept(h, step.wanted, factor, step.tries, step.fresh, step.trusted > 0, control)
            step.fresh = NOT_FRESH
            return readout.GO_ON
        step.tries += 1
        counters[readout.REJECTED] += 1
        code = _refuse(circuit, pace, state)
        if code != readout.GO_ON:
            return code
        if step.too_far < 2.0:
            step.length = rung(h * min(0.9, step.too_far))
        else:
            step.length = step.wanted = shorten(h, factor, control)


@jit_within
def _complete(circuit: Circuit, pace: Pace, state: LoopState) -> int:
    """End an accepted step at a zero or an edge, and move there."""
    step, control, sign, branch = state.step[0], state.control[0], state.sign, state.branch
    h, length, turned_enough = step.length, step.stop - step.start, step.flips > sign.size
    step.theta, step.reached, step.crossed = 1.0, step.since + h, -1
    if step.reached >= length or length - step.reached <= 1e-12 * h:
        step.theta, step.reached = min(1.0, (length - step.since) / h), length
    off = 0.0
    for a in range(sign.size):
        fraction = _crossing(circuit, pace, state, a)
        reached = step.since + fraction * h
        # Zeros at the start of the step are passed over after some turns.
        if fraction <= step.theta and reached <= step.reached and not (turned_enough and reached <= step.since):
            step.theta, step.reached, step.crossed = fraction, reached, a
    a = step.crossed
    if a >= 0 and step.reached <= step.since:
        return int(step_control.turn(state, a))
    for b in range(sign.size if turned_enough else 0):
        off = max(off, step_control.farthest_off(circuit.work.modal.u[b], sign[b], step.theta))
    if off > pace.tol and readout.may_shorten(state):
        return readout.AGAIN
    step.flips, step.t_new = 0, step.stop if step.reached == length else step.start + step.reached
    code: int = _finish(circuit, pace.charge, state)
    if code != readout.GO_ON:
        return code
    if a >= 0:
        sign[a], branch[a, 0], branch[a, 1] = -sign[a], step.t_new, step.t_new - branch[a, 0]
        state.counters[readout.ZEROS] += 1
        # The area has a kink here, which excites fast modes again: the first step is chosen as after other zeros.
        if step.below > 0.0:
            # The gap voltage returns to 0 V soon.
            control.h, control.allowed = 2.0 * (step.below - step.theta) * h, 0.0
        elif control.h_after_zero > 0.0:
            control.h, control.allowed = control.h_after_zero, 0.0
        step.fresh = step_control.AFTER_ZERO
    control.t, step.since = step.t_new, step.reached
    state.counters[readout.ACCEPTED] += 1
    return readout.GO_ON
