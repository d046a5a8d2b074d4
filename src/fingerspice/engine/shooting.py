"""Periodic state of a stack by Newton's method on the map of one period; compiled, so that the steps are the cost."""

from __future__ import annotations

import numpy as np

from fingerspice.base.arrays import FloatArray, IntArray
from fingerspice.base.compiled import jit
from fingerspice.engine.loop import march
from fingerspice.engine.loopstate import DONE, STEP, Kept, LoopState
from fingerspice.engine.pace import Pace
from fingerspice.engine.readout import (
    CONTROL,
    N_COUNTERS,
    NFEV,
    TRIED,
    Outputs,
    Steps,
)  # fmt: skip
from fingerspice.engine.stackstep import Stack
from fingerspice.engine.system import System
from fingerspice.numerics.lobatto import NODES, ROWS
from fingerspice.numerics.small import inverse

CLOSED, NOT_CLOSED = 100, 101
"""Codes returned by `close_period`, in addition to those of `march`."""
N_FIGURES = 7
"""Figures of a period: peaks of gap voltage (V) and force (N), their errors, the last change of the gap voltage by
Newton's method (V), the length of the first step (s), and the largest factor by which an error of the state voltages
that is made in every period grows until it is periodic."""
# Tolerance of the map's derivative, over the voltage scale.
_SLOPE_TOL, _LEAST_SLOPE_TOL = 1e-7, 1e-9
# Tolerance of a first guess, over the voltage scale.
_CRUDE_TOL = 1e-4


@jit
def _map(
    stack: Stack, pace: Pace, u_before: float, turned: float, w: FloatArray, counters: IntArray, end: FloatArray,
    figures: FloatArray,
) -> int:  # fmt: skip
    """Integrate modes w over the table; `end` receives them at its end, times `turned`, `figures` peaks and errors."""
    n, system, edges = w.size, stack.system, stack.edges
    controls = np.zeros(1, CONTROL)
    control = controls[0]
    control.t = edges[0]
    control.u_before = u_before
    control.branch_length = np.inf
    control.h_after_edge = figures[5]
    y = np.zeros(n + 1)
    for i in range(n):
        for k in range(n):
            y[i] += system.live[0, i, k] * w[k]
    count = np.zeros(N_COUNTERS, np.int64)
    state = LoopState(
        y, np.zeros(n + 1), controls, count, np.zeros(1, STEP),
        Outputs(np.zeros(0), np.zeros(0, np.bool_), np.zeros((n, 0))), Kept(np.zeros((0, 4)), np.zeros((0, n, ROWS))),
        Steps(np.zeros((0, 4)), np.zeros((0, n, NODES))), np.zeros((TRIED, 4)),
    )  # fmt: skip
    code = march(stack, pace, state, edges[-1])
    for k in range(n):
        end[k] = 0.0
        for i in range(n):
            end[k] += turned * system.project[0, k, i] * y[i]
    figures[0] = control.peak_u
    figures[1] = control.peak_f
    figures[2] = control.error_u
    figures[3] = control.error_f
    figures[5] = control.h_after_edge
    counters[NFEV] += count[NFEV]
    counters[1] += 1
    return code


@jit
def close_period(
    stack: Stack, pace: Pace, u_before: float, turned: float, scale: float, known: bool, w: FloatArray,
    slope: FloatArray, counters: IntArray, figures: FloatArray,
) -> tuple[int, float]:  # fmt: skip
    """Find modes that a period maps onto themselves. A mode that does not decay keeps its first value.

    Parameters
    ----------
    stack, pace
        As in `march`; the edges of its source span one period, or half of one.
    u_before : float
        Source voltage just before the period, V.
    turned : float
        -1 if the table is half a period, which leads to the state with its sign changed; else 1.
    scale : float
        Voltage scale, V.
    known : bool
        Whether `slope` is that of an earlier call, from near the solution.
    w : ndarray, shape (n,)
        Modes of the first reference area: a first guess if `known`, else zeros; the solution on return.
    slope : ndarray, shape (n, n)
        Takes the derivative of the map of the modes, to about 1e-5.
    counters : ndarray of int, shape (2,)
        Evaluations and periods, added to.
    figures : ndarray, shape (N_FIGURES,)
        Filled with those of the last period.

    Returns
    -------
    code : int
        CLOSED, NOT_CLOSED, or what `march` returned.
    defect : float
        Largest change of a live voltage over the last period integrated, V.
    """
    n, system, edges = w.size, stack.system, stack.edges
    end = np.zeros(n)
    out = np.zeros(n)
    move = np.zeros(n)
    shifted = np.zeros(n)
    slowest = np.inf
    for k in range(n):
        if system.rates[0, k] > 0.0:
            slowest = min(slowest, system.rates[0, k])
    # The decay of a mode over the period must be visible in the slope of the map.
    span = edges[-1] - edges[0]
    forgets = min(1.0, slowest * span)
    fine = Pace(max(_SLOPE_TOL * forgets, _LEAST_SLOPE_TOL) * scale, pace.h_max, pace.controlled, False)
    plain = Pace(pace.tol, pace.h_max, pace.controlled, False)
    solver = _solver(slope, system.rates[0])
    unused = np.zeros(N_FIGURES)
    worst = 0.0
    if not known:
        # First solve with the area fixed: near enough for the slope of the map to be that at the solution.
        crude = Pace(_CRUDE_TOL * scale, pace.h_max, pace.controlled, False)
        code = _map(stack, crude, u_before, turned, w, counters, end, unused)
        if code != DONE:
            return code, worst
        figures[5] = unused[5] * (fine.tol / crude.tol) ** (1.0 / NODES)
        for k in range(n):
            if system.rates[0, k] > 0.0:
                w[k] += (end[k] - w[k]) / (1.0 - turned * np.exp(-system.rates[0, k] * span))
    for round_ in range(40):
        first = round_ == 0 and not known
        # The slope is needed no more accurately than the first guess is.
        here = fine if first else plain
        code = _map(
            stack, here, u_before, turned, w, counters, end, figures
        )  # fmt: skip
        if code != DONE:
            return code, worst
        unused[5] = figures[5]
        if first:
            figures[5] *= (plain.tol / fine.tol) ** (1.0 / NODES)
        before = worst
        for k in range(n):
            move[k] = end[k] - w[k] if system.rates[0, k] > 0.0 else 0.0
        worst = _largest_voltage(system, move)
        if first or (round_ > 3 and worst > 0.3 * before):
            for j in range(n):
                for k in range(n):
                    slope[k, j] = 1.0 if k == j else 0.0
                    shifted[k] = w[k]
                if system.rates[0, j] <= 0.0:
                    continue
                # A hundredth of the scale in the largest voltage of the mode.
                move_by = 0.01 * scale / max(np.abs(system.live[0, :, j]).max(), 1e-300)
                shifted[j] += move_by
                code = _map(
                    stack, here, u_before, turned, shifted, counters, out, unused
                )  # fmt: skip
                if code != DONE:
                    return code, worst
                for k in range(n):
                    slope[k, j] = (out[k] - end[k]) / move_by
            solver = _solver(slope, system.rates[0])
        step = np.zeros(n)
        for k in range(n):
            for j in range(n):
                step[k] += solver[k, j] * move[j]
            w[k] += step[k]
        figures[4] = 0.0
        for k in range(n):
            figures[4] += system.gap[0, k] * step[k]
        figures[4] = abs(figures[4])
        # The next Newton step would be this one times the error of the slope.
        if not first and (_largest_voltage(system, step) <= pace.tol or worst <= 1e-15 * scale):
            figures[6] = _memory(system, solver)
            return CLOSED, worst
    return NOT_CLOSED, worst


@jit
def _largest_voltage(system: System, w: FloatArray) -> float:
    """Largest live voltage of modes w, V."""
    worst = 0.0
    for i in range(w.size):
        x = 0.0
        for k in range(w.size):
            x += system.live[0, i, k] * w[k]
        worst = max(worst, abs(x))
    return worst


@jit
def _memory(system: System, solver: FloatArray) -> float:
    """Largest factor by which an error made in every period grows; modes that do not decay are left out."""
    n = solver.shape[0]
    worst = 1.0
    for i in range(n):
        total = 0.0
        for j in range(n):
            moved = 0.0
            for k in range(n):
                for m in range(n):
                    if system.rates[0, k] > 0.0 and system.rates[0, m] > 0.0:
                        moved += system.live[0, i, k] * solver[k, m] * system.project[0, m, j]
            total += abs(moved)
        worst = max(worst, total)
    return worst


@jit
def _solver(slope: FloatArray, rates: FloatArray) -> FloatArray:
    """Inverse of 1 - slope on the modes that decay, the identity on the others."""
    n = rates.size
    matrix = np.eye(n)
    for k in range(n):
        for j in range(n):
            if rates[k] > 0.0 and rates[j] > 0.0:
                matrix[k, j] -= slope[k, j]
    return inverse(matrix)
