"""Outputs of periods from the polynomials of one: the same again, or moved by what its start has moved."""

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
AT_ZERO, AT_EDGE = 1.0, 2.0


class Kept(NamedTuple):
    """Steps kept for repetition.

    Attributes
    ----------
    times : ndarray, shape (n_step, 4)
        Start, length and reached end of each step, s; and whether it ends at a zero of the gap voltage, an edge of the
        source, or anywhere (AT_ZERO, AT_EDGE, 0).
    series : ndarray, shape (n_step, n_column, ROWS)
        Chebyshev coefficients of the output columns over the whole length.
    """

    times: FloatArray
    series: FloatArray


def new_kept(steps: int, columns: int) -> Kept:
    """Room for so many steps."""
    return Kept(np.zeros((steps, 4)), np.zeros((steps, columns, ROWS)))


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
    as_powers = np.zeros(count, np.bool_)
    for i in range(count):
        as_powers[i] = _may_be_powers(series[i])
        if as_powers[i]:
            _make_powers(series[i])
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


@jit
def _may_be_powers(series: FloatArray) -> bool:
    """Whether columns of coefficients (n_column, ROWS) are as exact as those of 1, x, x^2, ..., half the work."""
    room = np.zeros(NODES)
    small = True
    for c in range(series.shape[0]):
        small &= to_powers(series[c, :NODES], room)
    return small


@jit
def _make_powers(series: FloatArray) -> None:
    """Turn columns (n_column, ROWS) into coefficients of 1, x, x^2, ..."""
    room = np.zeros(NODES)
    for c in range(series.shape[0]):
        to_powers(series[c, :NODES], room)
        series[c, :NODES] = room


@jit
def approach(
    marks: FloatArray, marks_by: FloatArray, series: FloatArray, by: FloatArray, slope: FloatArray, x: FloatArray,
    end: FloatArray, state: FloatArray, shown: int, still: float, period: float, periods: int, first: int,
    t_out: FloatArray, left: NDArray[np.bool_], out: FloatArray,
) -> int:  # fmt: skip
    """Write the outputs of periods that follow one another by an affine map.

    Parameters
    ----------
    marks : ndarray, shape (n_step + 1,)
        Where the steps begin and end in the first period, if that starts from live voltages `x` (n,) without charge, s.
    marks_by : ndarray, shape (n_step + 1, n)
        Its derivative by the live voltages at the start, s/V.
    series : ndarray, shape (n_step, n_column, ROWS)
        Chebyshev coefficients of that period's outputs, each over its step; used up.
    by : ndarray, shape (n, n_step, n_column, ROWS)
        Their derivative; used up.
    slope : ndarray, shape (n + 1, n)
        That of live voltages and charge at the end.
    end, state : ndarray, shape (n + 1,)
        Live voltages (V) and charge (C): `end` where the period from `x` ends; `state` where the first period starts,
        and on return where the last one ends.
    shown : int
        Columns that are voltages; after them come charge and current, if wanted.
    still : float
        What a period may start off the one before and have its outputs, V.
    period : float
        s.
    periods : int
        How many there are.
    first, t_out, left, out
        As `readout.write_outputs`.

    Returns
    -------
    int
        The first output that is left.
    """
    n = x.size
    work = np.zeros((2, WRITTEN_AT_ONCE))
    held = np.zeros(series.shape[0], np.int64)
    as_powers = np.zeros(series.shape[0], np.bool_)
    for i in range(series.shape[0]):
        as_powers[i] = _may_be_powers(series[i])
        if as_powers[i]:
            _make_powers(series[i])
            for m in range(n):
                _make_powers(by[m, i])
    formed = np.zeros_like(series)
    stops = np.zeros(marks.size)
    delta = np.zeros(n)
    formed_at = np.full(n, np.inf)
    stale = True
    for k in range(periods):
        shift = k * period
        moved = 0.0
        for m in range(n):
            delta[m] = state[m] - x[m]
            moved = max(moved, abs(delta[m] - formed_at[m]))
        # Whether outputs are asked for or not: none of them depends on the others.
        if moved > still:
            formed_at[:] = delta
            stale = True
        close = marks[-1] + shift
        if first < t_out.size and t_out[first] <= close + _SLACK * abs(close):
            if stale:
                _form(marks, marks_by, series, by, formed_at, stops, formed)
                stale = False
            for i in range(series.shape[0]):
                begin, stop = stops[i] + shift, stops[i + 1] + shift
                if series.shape[1] > shown:
                    formed[i, shown, 0] += state[n]
                held[i] = write_outputs(
                    begin, stop - begin, 1.0, stop, _SLACK * abs(stop), as_powers[i], formed[i], work, first, held[i],
                    t_out, left, out,
                )  # fmt: skip
                first += held[i]
                if series.shape[1] > shown:
                    formed[i, shown, 0] -= state[n]
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
    """Marks and series of the period that starts `delta` (V) off, see `approach`, into `stops` and `formed`."""
    stops[:] = marks
    formed[:] = series
    for m in range(delta.size):
        stops += marks_by[:, m] * delta[m]
        for i in range(series.shape[0]):
            for c in range(series.shape[1]):
                for d in range(ROWS):
                    formed[i, c, d] += by[m, i, c, d] * delta[m]
