"""The state that one period leads back to, by Newton on the period map: compiled, so that only steps cost."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fingerspice.compiled import jit
from fingerspice.engine.exponential import Tables
from fingerspice.engine.march import DONE, Pace, Work, march
from fingerspice.engine.readout import BRANCH_LENGTH, N_CONTROL, N_COUNTERS, NFEV, U_BEFORE, T
from fingerspice.engine.system import System

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

CLOSED, NOT_CLOSED = 100, 101
"""Codes of `close_period` beside those of `march`."""
# Tolerance of the first approach and of the map's derivative, over the voltage scale.
_ROUGH = 1e-4


@jit
def _map(
    system: System, pace: Pace, tables: Tables, work: Work, integral: FloatArray, edges: FloatArray, terms: FloatArray,
    series: FloatArray, u_before: float, x: FloatArray, counters: IntArray, y: FloatArray,
) -> int:  # fmt: skip
    """One period from live voltages x; y takes the state at its end."""
    n = x.size
    control = np.zeros(N_CONTROL)
    control[T] = edges[0]
    control[U_BEFORE] = u_before
    control[BRANCH_LENGTH] = np.inf
    y[:n] = x
    y[n] = 0.0
    none = np.zeros(0)
    count = np.zeros(N_COUNTERS, np.int64)
    code = march(
        system, pace, tables, work, integral, edges, terms, series, edges[-1], y, np.zeros(n + 1), control, count,
        none, np.zeros(0, np.bool_), np.zeros((n, 0)),
    )  # fmt: skip
    counters[NFEV] += count[NFEV]
    counters[1] += 1
    return code


@jit
def solve_live(matrix: FloatArray, right: FloatArray) -> FloatArray:
    """Solution of a small square system; directions without a pivot, which nothing decides, stay at zero."""
    n = right.size
    a = matrix.copy()
    b = right.copy()
    columns = np.arange(n)
    rank = 0
    for step in range(n):
        best = 0.0
        row = step
        column = step
        for i in range(step, n):
            for j in range(step, n):
                if abs(a[i, j]) > best:
                    best = abs(a[i, j])
                    row = i
                    column = j
        if best < 1e-9:
            break
        rank += 1
        for j in range(n):
            a[step, j], a[row, j] = a[row, j], a[step, j]
        b[step], b[row] = b[row], b[step]
        for i in range(n):
            a[i, step], a[i, column] = a[i, column], a[i, step]
        columns[step], columns[column] = columns[column], columns[step]
        for i in range(step + 1, n):
            factor = a[i, step] / a[step, step]
            for j in range(step, n):
                a[i, j] -= factor * a[step, j]
            b[i] -= factor * b[step]
    out = np.zeros(n)
    for i in range(rank - 1, -1, -1):
        value = b[i]
        for j in range(i + 1, rank):
            value -= a[i, j] * out[columns[j]]
        out[columns[i]] = value / a[i, i]
    return out


@jit
def close_period(
    system: System, pace: Pace, tables: Tables, work: Work, integral: FloatArray, edges: FloatArray, terms: FloatArray,
    series: FloatArray, u_before: float, scale: float, x: FloatArray, slope: FloatArray, counters: IntArray,
) -> tuple[int, float]:  # fmt: skip
    """Find live voltages that a period leads back to.

    Parameters
    ----------
    system, pace, tables, work, integral, edges, terms, series
        As `march`; the edges span one period.
    u_before : float
        Source voltage just before the period, V.
    scale : float
        Voltage scale, V.
    x : ndarray, shape (n,)
        First guess, V; the solution on return.
    slope : ndarray, shape (n, n)
        Takes the derivative of the period map, to about 1e-3.
    counters : ndarray of int, shape (2,)
        Evaluations and periods, added to.

    Returns
    -------
    code : int
        CLOSED, NOT_CLOSED, or what `march` returned.
    defect : float
        Largest change of a live voltage over a further period from the solution, V.
    """
    n = x.size
    y = np.zeros(n + 1)
    shifted = np.zeros(n)
    end = np.zeros(n)
    move = np.zeros(n)
    rough = Pace(max(pace.tol, _ROUGH * scale), pace.h_max, pace.controlled, False)
    tight = Pace(pace.tol, pace.h_max, pace.controlled, False)
    left = np.zeros((n, n))
    worst = 0.0
    for round_ in range(40):
        here = rough if round_ < 2 else tight
        code = _map(system, here, tables, work, integral, edges, terms, series, u_before, x, counters, y)
        if code != DONE:
            return code, worst
        before = worst
        worst = 0.0
        for i in range(n):
            end[i] = y[i]
            move[i] = end[i] - x[i]
            worst = max(worst, abs(move[i]))
        if round_ >= 2 and worst <= pace.tol:
            return CLOSED, worst
        if round_ == 0 or (round_ > 3 and worst > 0.3 * before):
            for j in range(n):
                for i in range(n):
                    shifted[i] = x[i]
                shifted[j] += 0.01 * scale
                code = _map(system, here, tables, work, integral, edges, terms, series, u_before, shifted, counters, y)
                if code != DONE:
                    return code, worst
                for i in range(n):
                    slope[i, j] = (y[i] - end[i]) / (0.01 * scale)
            for i in range(n):
                for j in range(n):
                    left[i, j] = (1.0 if i == j else 0.0) - slope[i, j]
        step = solve_live(left, move)
        for i in range(n):
            x[i] += step[i]
    return NOT_CLOSED, worst
