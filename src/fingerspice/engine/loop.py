"""The loop of exponential steps: it tries lengths until the error of a step is small enough, and goes on to the end.

What a step consists of depends on the circuit: a stack has one area and one source (`engine.stackstep`), a network any
number of both (`engine.netstep`). The functions at the end of this file stand for those of the circuit at hand, which
the compiler chooses by its type.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from numba.extending import overload

from fingerspice.base.compiled import borrow, jit, jit_within
from fingerspice.engine.loopstate import (
    CONVERGED,
    DONE,
    FRESH,
    GO_ON,
    LENGTH,
    RETRY,
    STEP_ERROR,
    TRIES,
    TRUSTED,
    WANTED,
    LoopState,
)  # fmt: skip
from fingerspice.engine.pace import Pace, accept, allowed_factor, rung, shorten
from fingerspice.engine.readout import ACCEPTED, REJECTED, H, T, note
from fingerspice.engine.stackend import complete_stack
from fingerspice.engine.stackstep import (
    Stack,
    attempt_stack,
    begin_stack,
    beyond_stack,
    refuse_stack,
    start_stack,
)  # fmt: skip

Circuit = Stack


@jit
def march(circuit: Circuit, pace: Pace, state: LoopState, t_end: float) -> int:
    """Step to `t_end` (s) through the source's segments, writing outputs on the way.

    Parameters
    ----------
    circuit : Stack
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
    start(circuit, state)
    while True:
        code = begin(circuit, pace, state, t_end)
        if code == GO_ON:
            code = _find_length(circuit, pace, state)
        if code == GO_ON:
            code = complete(circuit, pace, state)
        if code >= DONE:
            return code


@jit_within
def _find_length(circuit: Circuit, pace: Pace, state: LoopState) -> int:
    """Solve a step with ever shorter lengths until its error is small enough, and choose the next step's length."""
    step, place, control, counters = state.step, state.place, state.control, state.counters
    step[WANTED], place[TRIES], place[TRUSTED] = control[H], 1, 1
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
        end = beyond(circuit, state)
        if end < 2.0:
            step[LENGTH] = rung(h * min(0.9, end))
        else:
            step[LENGTH] = step[WANTED] = shorten(h, factor, control)


def start(circuit: Circuit, state: LoopState) -> None:
    """Begin a call of the loop."""
    raise NotImplementedError


def begin(circuit: Circuit, pace: Pace, state: LoopState, t_end: float) -> int:
    """Find where the next step starts, and the length to try first."""
    raise NotImplementedError


def attempt(circuit: Circuit, pace: Pace, state: LoopState) -> int:
    """Solve a step of the length to be tried, and estimate its error."""
    raise NotImplementedError


def refuse(circuit: Circuit, state: LoopState) -> int:
    """Why no shorter step would do after one that was rejected; GO_ON if one may."""
    raise NotImplementedError


def beyond(circuit: Circuit, state: LoopState) -> float:
    """Fraction of a rejected step at which the next one should end, if it went far beyond a zero; or 2."""
    raise NotImplementedError


def complete(circuit: Circuit, pace: Pace, state: LoopState) -> int:
    """End an accepted step, write its outputs, account for its errors, and move to its end."""
    raise NotImplementedError


@overload(start, inline="always", strict=False)
def _start(circuit: Any, state: Any) -> Callable[..., Any]:
    return lambda circuit, state: start_stack(circuit, state)


@overload(begin, inline="always", strict=False)
def _begin(circuit: Any, pace: Any, state: Any, t_end: Any) -> Callable[..., Any]:
    return lambda circuit, pace, state, t_end: begin_stack(circuit, pace, state, t_end)


@overload(attempt, inline="always", strict=False)
def _attempt(circuit: Any, pace: Any, state: Any) -> Callable[..., Any]:
    return lambda circuit, pace, state: attempt_stack(circuit, pace, state)


@overload(refuse, inline="always", strict=False)
def _refuse(circuit: Any, state: Any) -> Callable[..., Any]:
    return lambda circuit, state: refuse_stack(circuit, state)


@overload(beyond, inline="always", strict=False)
def _beyond(circuit: Any, state: Any) -> Callable[..., Any]:
    return lambda circuit, state: beyond_stack(circuit, state)


@overload(complete, inline="always", strict=False)
def _complete(circuit: Any, pace: Any, state: Any) -> Callable[..., Any]:
    return lambda circuit, pace, state: complete_stack(circuit, pace, state)
