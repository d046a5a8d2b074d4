"""A period kept as polynomials, and its outputs written again: what a periodic scene needs once it has settled."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fingerspice.compiled import borrow, jit
from fingerspice.engine.readout import WRITTEN_AT_ONCE, write_outputs
from fingerspice.numerics.chebyshev import to_powers
from fingerspice.numerics.lobatto import NODES, ROWS

FloatArray = NDArray[np.float64]

# A boundary of a step, moved by whole periods, is one of the times asked for if it is this near, relative.
_SLACK = 8e-16


class Kept(NamedTuple):
    """Steps kept for repetition.

    Attributes
    ----------
    times : ndarray, shape (n_step, 3)
        Start, length and reached end of each step, s.
    series : ndarray, shape (n_step, n_column, ROWS)
        Chebyshev coefficients of the output columns over the whole length.
    """

    times: FloatArray
    series: FloatArray


def new_kept(steps: int, columns: int) -> Kept:
    """Room for so many steps."""
    return Kept(np.zeros((steps, 3)), np.zeros((steps, columns, ROWS)))


@jit
def repeat(
    kept: Kept, count: int, period: float, periods: int, drifts: FloatArray, first: int, t_out: FloatArray,
    left: NDArray[np.bool_], out: FloatArray,
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
        What each column gains in a period: a charge does, C.
    first, t_out, left, out
        As `readout.write_outputs`.

    Returns
    -------
    int
        The first output that is left.
    """
    times, series = borrow(kept.times), borrow(kept.series)
    t_out, left, out, drifts = borrow(t_out), borrow(left), borrow(out), borrow(drifts)
    work = np.zeros((2, WRITTEN_AT_ONCE))
    # Outputs of each step in the period before: mostly as many as now.
    held = np.zeros(count, np.int64)
    # Powers take half the work, and are as exact where their coefficients stay small.
    as_powers = np.zeros(count, np.bool_)
    room = np.zeros(NODES)
    for i in range(count):
        as_powers[i] = True
        for c in range(out.shape[0]):
            as_powers[i] &= to_powers(series[i, c, :NODES], room)
        if as_powers[i]:
            for c in range(out.shape[0]):
                to_powers(series[i, c, :NODES], room)
                series[i, c, :NODES] = room
    for k in range(1, periods + 1):
        shift = k * period
        before = first
        for i in range(count):
            if first >= t_out.size:
                break
            end = times[i, 2] + shift
            slack = _SLACK * abs(end)
            if t_out[first] > end + slack:
                continue
            h = times[i, 1]
            reached = (times[i, 2] - times[i, 0]) / h
            held[i] = write_outputs(
                times[i, 0] + shift, h, min(reached, 1.0), end, slack, as_powers[i], series[i], work, first, held[i],
                t_out, left, out,
            )  # fmt: skip
            first += held[i]
        for c in range(out.shape[0]):
            if drifts[c] != 0.0:
                for i in range(before, first):
                    out[c, i] += k * drifts[c]
    return first
