"""Outputs of many periods from the polynomials of one: equal periods, or periods related by an affine map.

A billion periods take half a minute. They are written by compiled calls of some milliseconds, between which Python can
react to Ctrl-C; each call hands its state to the next, so that no result depends on where the calls are divided.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fingerspice.base.arrays import FloatArray
from fingerspice.base.borrowing import borrow
from fingerspice.base.compiled import jit
from fingerspice.engine.readout import WRITTEN_AT_ONCE, Outputs, write_outputs
from fingerspice.numerics.chebyshev import to_powers
from fingerspice.numerics.lobatto import NODES, ROWS
from fingerspice.numerics.small import copy_to

# Relative distance within which two times count as equal: a few units in the last place. So much the end of a step,
# shifted by whole periods, may miss an output time.
SAME_TIME = 8e-16
AT_ZERO, AT_EDGE = 1.0, 2.0
# Number of steps in one compiled call.
AT_ONCE = 1_000_000


class Kept(NamedTuple):
    """Steps kept for repetition."""

    # (n_step, 4): Start, length and reached end of each step, s; and whether it ends at a zero of the gap voltage, an
    # edge of the source, or anywhere (AT_ZERO, AT_EDGE, 0)
    times: FloatArray
    series: FloatArray  # (n_step, n_column, ROWS): Chebyshev coefficients of the output columns over the whole length


def new_kept(steps: int, columns: int) -> Kept:
    """Room for so many steps."""
    return Kept(np.zeros((steps, 4)), np.zeros((steps, columns, ROWS)))


class _Walk(NamedTuple):
    """State handed from call to call: each step's outputs in the period before, and whether it is in powers of x."""

    held: NDArray[np.int64]
    as_powers: NDArray[np.bool_]


def _new_walk(steps: int) -> _Walk:
    return _Walk(np.zeros(steps, np.int64), np.zeros(steps, np.bool_))


def _calls(periods: int, steps: int) -> Iterator[tuple[int, int]]:
    """Division of periods 0, 1, ... into calls: the first period of each call, and the first of the next one."""
    most = max(1, AT_ONCE // max(1, steps))
    for begin in range(0, periods, most):
        yield begin, min(begin + most, periods)


def repeat(
    kept: Kept, count: int, period: float, periods: int, drifts: FloatArray, first: int, outputs: Outputs
) -> int:  # fmt: skip
    """Write the outputs of the periods that follow the kept one.

    Parameters
    ----------
    kept : Kept
        `count` steps that make one period; its series are used up.
    period : float
        s.
    periods : int
        How often to repeat it.
    drifts : ndarray, shape (n_column,)
        Gain of each column in a period; only charges have one, C.
    first, outputs
        As `readout.write_outputs`.

    Returns
    -------
    int
        The first output that is left.
    """
    walk = _new_walk(count)
    for begin, end in _calls(periods, count):
        first = _repeat(kept, walk, period, begin + 1, end + 1, drifts, first, outputs)
        if first >= outputs.t.size:
            break
    return first


@jit
def _repeat(
    kept: Kept, walk: _Walk, period: float, begin: int, end: int, drifts: FloatArray, first: int, outputs: Outputs
) -> int:  # fmt: skip
    """As `repeat`, of the periods from `begin` to before `end`."""
    times, series = borrow(kept.times), borrow(kept.series)
    outputs, drifts = borrow(outputs), borrow(drifts)
    t_out, out = outputs.t, outputs.columns
    held, as_powers = borrow(walk.held), borrow(walk.as_powers)
    if begin == 1:
        _make_powers(series, np.zeros((0, 0, 0, 0)), as_powers)
    work = np.zeros((2, WRITTEN_AT_ONCE))
    for k in range(begin, end):
        shift = k * period
        before = first
        for i in range(held.size):
            if first >= t_out.size:
                break
            stop = times[i, 2] + shift
            slack = SAME_TIME * abs(stop)
            if t_out[first] > stop + slack:
                continue
            h = times[i, 1]
            reached = (times[i, 2] - times[i, 0]) / h
            # Mostly a period has as many outputs as the one before.
            held[i] = write_outputs(
                times[i, 0] + shift, h, min(reached, 1.0), stop, slack, as_powers[i], series[i], work, first, held[i],
                outputs,
            )  # fmt: skip
            first += held[i]
        for c in range(out.shape[0]):
            if drifts[c] != 0.0:
                for i in range(before, first):
                    out[c, i] += k * drifts[c]
    return first


@jit
def _make_powers(series: FloatArray, by: FloatArray, made: NDArray[np.bool_]) -> None:
    """Turn Chebyshev coefficients (n_step, n_column, ROWS) into those of 1, x, x^2, ..., which halve the work.

    This is done for steps where the powers are as exact, which `made` (n_step,) marks; the derivatives `by` (n, n_step,
    n_column, ROWS) of these steps are turned as well.
    """
    room = np.zeros(NODES)
    for i in range(made.size):
        made[i] = True
        for c in range(series.shape[1]):
            made[i] &= to_powers(series[i, c, :NODES], room)
        if not made[i]:
            continue
        for c in range(series.shape[1]):
            to_powers(series[i, c, :NODES], room)
            copy_to(series[i, c, :NODES], room)
            for m in range(by.shape[0]):
                to_powers(by[m, i, c, :NODES], room)
                copy_to(by[m, i, c, :NODES], room)


class PeriodMap(NamedTuple):
    """Affine map from the start of a period to its steps and its end, made at a period from live voltages `x`."""

    # (n_step + 1,): Where the steps begin and end in the first period, if that starts from `x` without charge, s
    marks: FloatArray
    marks_by: FloatArray  # (n_step + 1, n): Its derivative by the live voltages at the start, s/V
    series: FloatArray  # (n_step, n_column, ROWS): Chebyshev coefficients of that period's outputs, each over its step
    by: FloatArray  # (n, n_step, n_column, ROWS): Their derivative
    slope: FloatArray  # (n + 1, n): That of live voltages and charge at the end
    x: FloatArray  # (n,): V
    end: FloatArray  # (n + 1,): Live voltages (V) and charge (C) where the period from `x` ends


def approach(
    one: PeriodMap, state: FloatArray, shown: int, still: float, period: float, periods: int, first: int,
    outputs: Outputs,
) -> int:  # fmt: skip
    """Write the outputs of periods that follow one another by an affine map.

    Parameters
    ----------
    one : PeriodMap
        Its `series` and `by` are used up.
    state : ndarray, shape (n + 1,)
        Live voltages (V) and charge (C) where the first period starts, and on return where the last one ends.
    shown : int
        Columns that are voltages; after them come charge and current, if wanted.
    still : float
        Largest change of a period's start for which the period before provides the outputs, V.
    period : float
        s.
    periods : int
        How many there are.
    first, outputs
        As `readout.write_outputs`.

    Returns
    -------
    int
        The first output that is left.
    """
    walk = _new_walk(one.series.shape[0])
    formed = _Formed(
        np.full(one.x.size, np.inf), np.zeros(one.marks.size), np.zeros_like(one.series), np.ones(1, np.bool_)
    )  # fmt: skip
    for begin, stop in _calls(periods, one.series.shape[0]):
        first = _approach(one, state, shown, still, period, begin, stop, walk, formed, first, outputs)
    return first


class _Formed(NamedTuple):
    """The period that was formed last; it serves until the start has changed too much."""

    at: FloatArray  # (n,): Difference of its start from `x`, V
    stops: FloatArray  # (n_step + 1,): Its marks, s
    series: FloatArray  # (n_step, n_column, ROWS)
    stale: NDArray[np.bool_]  # (1,): Whether `stops` and `series` still belong to an earlier start than `at`


@jit
def _approach(
    one: PeriodMap, state: FloatArray, shown: int, still: float, period: float, begin: int, stop: int, walk: _Walk,
    formed: _Formed, first: int, outputs: Outputs,
) -> int:  # fmt: skip
    """As `approach`, of the periods from `begin` to before `stop`."""
    marks, series, by, slope, x, end, t_out = one.marks, one.series, one.by, one.slope, one.x, one.end, outputs.t
    n = x.size
    work = np.zeros((2, WRITTEN_AT_ONCE))
    held, stops, made = walk.held, formed.stops, formed.series
    if begin == 0:
        _make_powers(series, by, walk.as_powers)
    delta = np.zeros(n)
    for k in range(begin, stop):
        shift = k * period
        moved = 0.0
        for m in range(n):
            delta[m] = state[m] - x[m]
            moved = max(moved, abs(delta[m] - formed.at[m]))
        # Also in periods without outputs, so that no output depends on which others are asked for.
        if moved > still:
            copy_to(formed.at, delta)
            formed.stale[0] = True
        close = marks[-1] + shift
        if first < t_out.size and t_out[first] <= close + SAME_TIME * abs(close):
            if formed.stale[0]:
                _form(marks, one.marks_by, series, by, formed.at, stops, made)
                formed.stale[0] = False
            for i in range(series.shape[0]):
                since, until = stops[i] + shift, stops[i + 1] + shift
                if series.shape[1] > shown:
                    made[i, shown, 0] += state[n]
                held[i] = write_outputs(
                    since, until - since, 1.0, until, SAME_TIME * abs(until), walk.as_powers[i], made[i], work, first,
                    held[i], outputs,
                )  # fmt: skip
                first += held[i]
                if series.shape[1] > shown:
                    made[i, shown, 0] -= state[n]
        for j in range(n + 1):
            state[j] = end[j] + (state[n] if j == n else 0.0)
        for m in range(n):
            for j in range(n + 1):
                state[j] += slope[j, m] * delta[m]
    return first


@jit
def _form(
    marks: FloatArray, marks_by: FloatArray, series: FloatArray, by: FloatArray, delta: FloatArray, stops: FloatArray,
    formed: FloatArray,
) -> None:  # fmt: skip
    """Marks and series of the period whose start differs by `delta` (V), see `approach`, into `stops` and `formed`."""
    copy_to(stops, marks)
    copy_to(formed, series)
    for m in range(delta.size):
        stops += marks_by[:, m] * delta[m]
        for i in range(series.shape[0]):
            for c in range(series.shape[1]):
                for d in range(ROWS):
                    formed[i, c, d] += by[m, i, c, d] * delta[m]
