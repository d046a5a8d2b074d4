"""The loop of exponential steps: it tries lengths until the error of a step is small enough, and goes on to the end.

What a step consists of depends on the circuit: a stack has one area and one source (`engine.stackstep`), a network any
number of both (`engine.meshstep`). The first functions below stand for those of the circuit at hand.
"""

from __future__ import annotations

import math

from fingerspice.base.arrays import FloatArray
from fingerspice.base.borrowing import borrow
from fingerspice.base.compiled import jit, jit_by_kind, jit_within
from fingerspice.engine.loopstate import (
    CONVERGED,
    DONE,
    EXCESSIVE,
    FRESH,
    GO_ON,
    LENGTH,
    LOOKED_AT,
    RETRY,
    STEP_ERROR,
    TRIES,
    TRUSTED,
    WANTED,
    LoopState,
)  # fmt: skip
from fingerspice.engine.mesh import Mesh, begin_mesh, edges_of_mesh, start_mesh, worst_of_mesh
from fingerspice.engine.meshstep import attempt_mesh, beyond_mesh, complete_mesh, end_mesh, refuse_mesh
from fingerspice.engine.pace import Pace, accept, allowed_factor, rung, shorten
from fingerspice.engine.readout import ACCEPTED, REJECTED, H, T, note
from fingerspice.engine.repeat import SAME_TIME
from fingerspice.engine.settling import ACCEPTABLE, NEXT, TRIAL, Looks, look, next_stop
from fingerspice.engine.stackend import complete_stack, end_stack, worst_of_stack
from fingerspice.engine.stackstep import (
    Stack,
    attempt_stack,
    begin_stack,
    beyond_stack,
    edges_of_stack,
    refuse_stack,
    start_stack,
)  # fmt: skip

Circuit = Stack | Mesh


@jit_by_kind(Stack=start_stack, Mesh=start_mesh)
def start(circuit: Circuit, state: LoopState) -> None:
    """Begin a call of the loop."""


@jit_by_kind(Stack=begin_stack, Mesh=begin_mesh)
def begin(circuit: Circuit, pace: Pace, state: LoopState, t_end: float) -> int:
    """Find where the next step starts, and the length to try first."""
    raise NotImplementedError


@jit_by_kind(Stack=attempt_stack, Mesh=attempt_mesh)
def attempt(circuit: Circuit, pace: Pace, state: LoopState) -> int:
    """Solve a step of the length to be tried, and estimate its error."""
    raise NotImplementedError


@jit_by_kind(Stack=refuse_stack, Mesh=refuse_mesh)
def refuse(circuit: Circuit, state: LoopState) -> int:
    """Why no shorter step would do after one that was rejected; GO_ON if one may."""
    raise NotImplementedError


@jit_by_kind(Stack=beyond_stack, Mesh=beyond_mesh)
def beyond(circuit: Circuit, pace: Pace, state: LoopState) -> float:
    """Fraction of a rejected step at which the next one should end, if it went far beyond a zero; or 2."""
    raise NotImplementedError


@jit_by_kind(Stack=complete_stack, Mesh=complete_mesh)
def complete(circuit: Circuit, pace: Pace, state: LoopState) -> int:
    """End an accepted step, write its outputs, account for its errors, and move to its end."""
    raise NotImplementedError


@jit_by_kind(Stack=end_stack, Mesh=end_mesh)
def end(circuit: Circuit, state: LoopState) -> None:
    """End a call of the loop."""


@jit_by_kind(Stack=worst_of_stack, Mesh=worst_of_mesh)
def worst(circuit: Circuit, state: LoopState) -> float:
    """Largest ratio of the estimated error to the peak so far, over the voltages and forces of all gaps."""
    raise NotImplementedError


@jit_by_kind(Stack=edges_of_stack, Mesh=edges_of_mesh)
def edges(circuit: Circuit) -> FloatArray:
    """Edges of the sources, s."""
    raise NotImplementedError


@jit
def march_on(circuit: Circuit, pace: Pace, state: LoopState, looks: Looks, t_end: float) -> int:
    """As `march`, and look for the periodic state on the way.

    Returns with EXCESSIVE where a trial of the error fails, and with LOOKED_AT where a look has found something.
    """
    circuit, state, looks = borrow(circuit), borrow(state), borrow(looks)
    while True:
        stop = next_stop(looks, edges(circuit), t_end)
        code = march(circuit, pace, state, stop)
        if code != DONE:
            return code
        slack = SAME_TIME * abs(stop)
        if stop >= looks.values[TRIAL] - slack:
            looks.values[TRIAL] = math.inf
            if worst(circuit, state) > looks.values[ACCEPTABLE]:
                return EXCESSIVE
        if stop >= looks.values[NEXT] - slack and look(looks, state):
            return LOOKED_AT
        if state.control[T] >= t_end:
            return DONE


@jit_within
def march(circuit: Circuit, pace: Pace, state: LoopState, t_end: float) -> int:
    """Step to `t_end` (s) through the source's segments, writing outputs on the way.

    Parameters
    ----------
    circuit : Stack or Mesh
        The circuit, its sources, tables and scratch arrays.
    pace : Pace
        Rules for the lengths of the steps.
    state : LoopState
        The integration so far, updated.
    t_end : float
        Where to stop, s; not past the last edge of the sources.

    Returns
    -------
    int
        A code of `engine.loopstate`.
    """
    # Arrays without a reference count: it would cost an atomic operation at every access to a tuple.
    circuit, state = borrow(circuit), borrow(state)
    state.place[TRUSTED] = 1
    start(circuit, state)
    while True:
        code = begin(circuit, pace, state, t_end)
        if code == GO_ON:
            code = _find_length(circuit, pace, state)
        if code == GO_ON:
            code = complete(circuit, pace, state)
        if code >= DONE:
            end(circuit, state)
            return code


@jit_within
def _find_length(circuit: Circuit, pace: Pace, state: LoopState) -> int:
    """Solve a step with ever shorter lengths until its error is small enough, and choose the next step's length."""
    step, place, control, counters = state.step, state.place, state.control, state.counters
    step[WANTED], place[TRIES] = control[H], 1
    while True:
        code = attempt(circuit, pace, state)
        if code == RETRY:
            continue
        if code != GO_ON:
            return code
        h, error, converged = step[LENGTH], step[STEP_ERROR], place[CONVERGED] > 0
        note(state.tried, counters[ACCEPTED] + counters[REJECTED], control[T], h, error / pace.tol)
        if converged and not pace.controlled:
            return GO_ON
        factor = allowed_factor(error, pace.tol)
        if error <= pace.tol:
            accept(h, step[WANTED], factor, place[TRIES], place[FRESH], place[TRUSTED] > 0, control)
            place[FRESH] = -1
            return GO_ON
        place[TRIES] += 1
        counters[REJECTED] += 1
        code = refuse(circuit, state)
        if code != GO_ON:
            return code
        reach = beyond(circuit, pace, state)
        if reach < 2.0:
            step[LENGTH] = rung(h * min(0.9, reach))
        else:
            step[LENGTH] = step[WANTED] = shorten(h, factor, control)
