"""Error and peaks of a finished step of a network; `exponential.assess` and `readout` do the same for a stack."""

from __future__ import annotations

import math

import numpy as np

from fingerspice.base.arrays import FloatArray, IntArray
from fingerspice.base.compiled import jit, jit_rows, jit_within
from fingerspice.engine.collocation.exponential import Tables, between, largest, left_over
from fingerspice.engine.collocation.readout import ERROR_U, N_PLACES
from fingerspice.engine.collocation.zeros import first_wrong, leaves
from fingerspice.engine.many_areas.form import LIN, PULL, USED, Form, Leaks, W, Work
from fingerspice.engine.many_areas.rows import combine
from fingerspice.numerics.lobatto import DERIVATIVE, END, MISS, NODES, POINTS, ROWS

# A decay that is over within this fraction of the step, a third of the way to the first node, is not seen by the
# polynomials.
_EARLY = POINTS[1] / 3.0
# Rows at which the response to the interpolation error is taken for the points between the nodes and for the end: this
# error changes its sign at every node, so that its integral is largest at the nodes beside those points.
_WORST = (1, NODES // 2, 9, END)


@jit
def load(inverse: FloatArray, follow: FloatArray, y: FloatArray, s: FloatArray, w: FloatArray) -> None:
    """Modes from the state and the sources' values."""
    n = inverse.shape[0]
    for k in range(n):
        w[k] = 0.0
    for i in range(n):
        x = y[i]
        for e in range(s.size):
            x += follow[i, e] * s[e]
        for k in range(n):
            w[k] += inverse[k, i] * x
    for k in range(n, w.size):
        w[k] = y[k]


@jit
def store(
    shape: FloatArray, follow: FloatArray, w: FloatArray, s: FloatArray, gained: FloatArray, y: FloatArray
) -> None:
    """State from the modes, the sources' values and the charges gained in the step."""
    n = shape.shape[0]
    for i in range(n):
        y[i] = 0.0
        for k in range(n):
            y[i] += shape[i, k] * w[k]
        for e in range(s.size):
            y[i] -= follow[i, e] * s[e]
    for k in range(n, w.size):
        y[k] = w[k]
    for e in range(s.size):
        y[w.size + e] += gained[e]


@jit_rows
def _largest_voltage(shape: FloatArray, follow: FloatArray, m: int, off: FloatArray) -> float:
    """Largest error of a state voltage, V, from the errors `off` of the m modes and, behind them, of the sources."""
    n = shape.shape[0]
    largest_one = 0.0
    for i in range(n):
        for p in range(off.shape[0]):
            total = 0.0
            for k in range(n):
                total += shape[i, k] * off[p, k]
            for e in range(follow.shape[1]):
                total -= follow[i, e] * off[p, m + e]
            # NaN is too large as well.
            if not abs(total) <= largest_one:
                largest_one = abs(total)
    return largest_one


@jit_within
def assess(
    form: Form, work: Work, leaks: Leaks, tables: Tables, slot: int, h: float, error: FloatArray, magnified: float
) -> float:  # fmt: skip
    """Error of a converged step, V, from the interpolation errors between its nodes; see `exponential.assess`.

    `work.places` receives the errors of the modes, `work.run` those of the gaps' voltages; both contain the residual of
    the iteration and the errors of earlier steps. `work.off` receives the interpolation errors of the modes, and of the
    sources behind them, at the points between the nodes and at the end; its last row is that of a decay which is over
    before the first node.
    """
    modes, s, off, places, run, carried, size = (
        work.modes, work.s, work.off, work.places, work.run, work.carried, work.size
    )  # fmt: skip
    w, lin, pull, used = modes[W], modes[LIN], modes[PULL], modes[USED]
    shape, follow, gap, rates, phi, miss = (
        form.shape, form.follow, form.gap, leaks.rates, tables.phi[slot], tables.miss[slot]
    )  # fmt: skip
    n, m = shape.shape[0], w.shape[0]
    left = work.room[2]
    for j in range(s.shape[0]):
        off[0, m + j], off[1, m + j], off[2, m + j] = between(s[j])
    for k in range(w.shape[0]):
        lin_first, lin_second, lin_third = between(lin[k])
        pull_first, pull_second, pull_third = between(pull[k])
        missed = largest(
            (lin_first + pull_first) / MISS[0], (lin_second + pull_second) / MISS[1], (lin_third + pull_third) / MISS[2]
        )
        left_over(phi[k], pull[k], used[k], left)
        places[k, 0] = error[k]
        mode_first, mode_second, mode_third = between(w[k])
        # The slope of the mode at the start shows such a decay: it differs by the decay's size times its rate.
        fall = 0.0
        for j in range(NODES):
            fall += DERIVATIVE[0, j] * w[k, j]
        fall = lin[k, 0] + pull[k, 0] - rates[k] * w[k, 0] - fall / h
        off[4, k] = fall / (rates[k] + 1.0 / (_EARLY * h))
        for p in range(4):
            fresh = magnified * miss[k, _WORST[p]] * missed
            places[k, p + 1] = carried[k, p] + magnified * left[p] + fresh
            off[p, k] = fresh
        off[0, k] += mode_first
        off[1, k] += mode_second
        off[2, k] += mode_third
        places[k, 1] += mode_first
        places[k, 2] += mode_second
        places[k, 3] += mode_third
    step = _largest_voltage(shape, follow, m, off)
    for k in range(n, w.shape[0]):
        for p in range(4):
            if not size[k] * abs(off[p, k]) <= step:
                step = size[k] * abs(off[p, k])
    for a in range(run.shape[0]):
        for p in range(N_PLACES):
            total = 0.0
            for k in range(n):
                total += gap[a, k] * (places[k, p] + (off[4, k] if p == 0 else 0.0))
            run[a, p] = abs(total)
    return step


@jit
def charged(cell: IntArray, u: FloatArray, area: FloatArray) -> float:
    """Interpolation error of the areas as a voltage, V: it enters the charge through the integral of A du."""
    worst = 0.0
    for a in range(cell.size):
        if cell[a] >= 0:
            first, second, third = between(area[a])
            swing = 0.3 * abs(u[a, END] - u[a, 0])
            worst = max(worst, swing * abs(largest(first, second, third)) / area[a, 0])
    return worst


@jit
def turn_at_start(cell: IntArray, u: FloatArray, sign: FloatArray, tol: float, t: float, branch: FloatArray) -> bool:
    """Switch the branch of every area whose gap voltage starts at 0 and leaves to the other side; True if one did."""
    turned = False
    for a in range(cell.size):
        if cell[a] >= 0 and sign[a] * u[a, 0] <= 1e-9 * abs(u[a, 1]) and first_wrong(u[a], sign[a], tol) == 1:
            sign[a] = -sign[a]
            branch[a, 0], branch[a, 1] = t, math.inf
            turned = True
    return turned


@jit
def first_zero(
    cell: IntArray, u: FloatArray, sign: FloatArray, tol: float, t: float, h: float, theta: float, t_new: float,
    later: bool, series: FloatArray,
) -> tuple[int, float, float]:  # fmt: skip
    """The area whose gap voltage is the first to leave its branch before t_new, or -1; the fraction and the time.

    With `later` zeros at the start of the step are passed over.
    """
    which = -1
    for a in range(cell.size):
        if cell[a] >= 0:
            crossing = leaves(u[a], sign[a], tol, series)
            if crossing <= theta and t + crossing * h <= t_new and not (later and t + crossing * h <= t):
                which, theta, t_new = a, crossing, t + crossing * h
    return which, theta, t_new


@jit_rows
def account_nodes(
    node: FloatArray, node_s: FloatArray, places: FloatArray, off: FloatArray, peaks: FloatArray
) -> None:  # fmt: skip
    """Largest error of any node's voltage over a step, from that of the modes and the sources (see `assess`)."""
    m, n = places.shape[0], node.shape[1]
    error = np.empty((N_PLACES, n))
    for k in range(n):
        for p in range(N_PLACES):
            error[p, k] = places[k, p] + (off[4, k] if p == 0 else 0.0)
    largest_one = peaks[ERROR_U]
    for i in range(node.shape[0]):
        for p in range(N_PLACES):
            total = 0.0
            for k in range(n):
                total += node[i, k] * error[p, k]
            if 0 < p < N_PLACES - 1:
                for e in range(node_s.shape[1]):
                    total += node_s[i, e] * off[p - 1, m + e]
            largest_one = max(largest_one, abs(total))
    peaks[ERROR_U] = largest_one


@jit_rows
def write_columns(
    n: int, first_z: int, charge: bool, shape: FloatArray, follow: FloatArray, w: FloatArray, s: FloatArray,
    y: FloatArray, values: FloatArray,
) -> None:  # fmt: skip
    """Write the state at all rows into the first rows of `values`; charges, if wanted, as gained since the start."""
    for j in range(n):
        for i in range(ROWS):
            values[j, i] = 0.0
        for e in range(s.shape[0]):
            for i in range(ROWS):
                values[j, i] -= follow[j, e] * s[e, i]
    combine(shape, w[:n], values[:n])
    for k in range(n, first_z):
        for i in range(ROWS):
            values[k, i] = w[k, i]
    for e in range(first_z, y.size):
        for i in range(ROWS):
            values[e, i] = y[e] + (values[e, i] if charge else 0.0)
