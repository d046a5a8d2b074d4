"""Outputs of many equal periods from the polynomials of one.

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
# Number of steps in one compiled call.
AT_ONCE = 1_000_000


class Kept(NamedTuple):
    """Steps kept for repetition."""

    times: FloatArray  # (n_step, 3): Start, length and reached end of each step, s
    series: FloatArray  # (n_step, n_column, ROWS): Chebyshev coefficients of the output columns over the whole length


def new_kept(steps: int, columns: int) -> Kept:
    """Room for so many steps."""
    return Kept(np.zeros((steps, 3)), np.zeros((steps, columns, ROWS)))


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
        _make_powers(series, as_powers)
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
def _make_powers(series: FloatArray, made: NDArray[np.bool_]) -> None:
    """Turn Chebyshev coefficients (n_step, n_column, ROWS) into those of 1, x, x^2, ..., which halve the work.

    This is done for steps where the powers are as exact, which `made` (n_step,) marks.
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
