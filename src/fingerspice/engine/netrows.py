"""A network in modal form around reference areas, and what an exponential step of it evaluates at all its rows.

With areas A0 held every network is linear, x = shape v - follow s with v' = -rates v + gain s. What the areas move
beside that is a current j in each cell whose area follows a voltage,

    v' = -rates v + gain s + feed j,    j = (A - A0) (c u' + g u)  [mobile: + c u A'],    u = tap v + tap_s s.

j holds the voltages' rates, but pointwise and linearly: each row solves for them, in as many unknowns as there are such
cells, and the determinant of that is the distance to the fold. An area with dynamics of its own is one more mode, of
rate 1 / tau. A jump of the sources is the same in the fraction of the jump, with nothing leaking: all rates zero.

These functions take plain arrays, as those of `fingerspice.engine.rows`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fingerspice.base.compiled import jit, jit_inline, jit_rows
from fingerspice.engine.charge import DERIVATIVE
from fingerspice.engine.exponential import N_PLACES
from fingerspice.engine.readout import WRITTEN_AT_ONCE
from fingerspice.engine.rows import N_FLAT, polynomial_rows
from fingerspice.numerics.lobatto import BETWEEN, NODES, ROWS
from fingerspice.physics.contact import inverse_area

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

# Blocks of the modes' rows, of the cells', and of the areas'; then gap voltages and a guess of them.
W, BASE, LIN, D, PULL, USED, PULL_BEFORE, LEFT_BEFORE = range(8)
FREE, FREE_RATE, CELL_U, DU, J = range(5)
AREA, SLOPE, RATE, MORE, U, GUESS = range(6)

# Steps over the time constant of a mode from which on its rate is taken from its polynomial: -rate w + gain s + feed j
# would be what is left of large numbers, and j hands that on to every other mode.
STIFF = 300.0
# From values at the nodes to slopes at all rows, per step length: slopes = values @ TO_RATES.
TO_RATES = np.ascontiguousarray(np.vstack([DERIVATIVE, BETWEEN.T @ DERIVATIVE]).T)


class Form(NamedTuple):
    """See the module. n live voltages, m modes with those of slow areas behind, n_f cells whose area moves.

    Attributes
    ----------
    mobile : bool
        Charge law.
    rates : ndarray, shape (m,)
    gain : ndarray, shape (m, n_s)
    shape, inverse : ndarray, shape (n, n)
        v = inverse (x + follow s).
    follow : ndarray, shape (n, n_s)
    feed : ndarray, shape (m, n_f)
    met : ndarray, shape (n_f, n_f)
        tap @ feed.
    tap, tap_s : ndarray, shape (n_f, n) and (n_f, n_s)
    c, g : ndarray, shape (n_f,)
        Capacitance and leak of the cells per area.
    home : ndarray of int, shape (n_f,)
        The area of each of these cells.
    cell : ndarray of int, shape (n_area,)
        The one of them whose voltage the area follows; -1 where it is fixed.
    area0, unit : ndarray, shape (n_area,)
        Reference area, and the area at 0 V that slow ones are counted in, m^2.
    slow : ndarray of int, shape (n_area,)
        The mode of each area, -1 where it has none; `pace` (n_area,) is its rate, 1/s.
    gap, gap_s : ndarray, shape (n_area, n) and (n_area, n_s)
        Voltage of each area's GAP from x and s; zero without one.
    stress : ndarray, shape (n_area,)
        Force per area and squared gap voltage, Pa/V^2.
    powers, slopes : ndarray, shape (n_area, DEGREE + 1)
        1/A as `engine.system.System` has it; with `lo`, `scale` (n_area,) and the long way, `curves`.
    stored, stored_s, lost, lost_s : ndarray, shape (n_s, n) and (n_s, n_s)
        Current that each source delivers at the reference areas: stored v' + stored_s s' + lost v + lost_s s.
    through : ndarray, shape (n_s, n_f)
        And what of j comes on top.
    """

    mobile: bool
    rates: FloatArray
    gain: FloatArray
    shape: FloatArray
    inverse: FloatArray
    follow: FloatArray
    feed: FloatArray
    met: FloatArray
    tap: FloatArray
    tap_s: FloatArray
    c: FloatArray
    g: FloatArray
    home: IntArray
    cell: IntArray
    area0: FloatArray
    unit: FloatArray
    slow: IntArray
    pace: FloatArray
    gap: FloatArray
    gap_s: FloatArray
    stress: FloatArray
    powers: FloatArray
    slopes: FloatArray
    lo: FloatArray
    scale: FloatArray
    curves: FloatArray
    stored: FloatArray
    stored_s: FloatArray
    lost: FloatArray
    lost_s: FloatArray
    through: FloatArray


class Work(NamedTuple):
    """Arrays that steps work in; those with ROWS behind hold one value for each row of a step."""

    r: FloatArray
    s: FloatArray
    ds: FloatArray
    modes: FloatArray
    cells: FloatArray
    areas: FloatArray
    matrix: FloatArray
    small: FloatArray
    met: FloatArray
    w0: FloatArray
    places: FloatArray
    weight: FloatArray
    values: FloatArray
    coefficients: FloatArray
    outputs: FloatArray
    room: FloatArray
    x: FloatArray
    carried: FloatArray
    spare: FloatArray
    spare_cells: FloatArray
    spare_areas: FloatArray


def new_work(n: int, modes: int, cells: int, areas: int, sources: int, columns: int) -> Work:
    """Work arrays for so many live voltages, modes, cells whose area moves, areas, sources and output columns."""
    return Work(
        np.zeros((sources, N_FLAT, ROWS)),
        np.zeros((sources, ROWS)),
        np.zeros((sources, ROWS)),
        np.zeros((8, modes, ROWS)),
        np.zeros((5, cells, ROWS)),
        np.zeros((6, areas, ROWS)),
        np.zeros((cells, cells + 1 + areas, ROWS)),
        np.zeros((areas, areas + 1, ROWS)),
        np.zeros((cells, cells)),
        np.zeros(modes),
        np.zeros((modes, N_PLACES)),
        np.zeros(modes),
        np.zeros((columns, ROWS)),
        np.zeros((columns, ROWS)),
        np.zeros((2, WRITTEN_AT_ONCE)),
        np.zeros((4, ROWS)),
        np.zeros((n, 5)),
        np.zeros((modes, N_PLACES - 1)),
        np.zeros((6, modes, ROWS)),
        np.zeros((5, cells, ROWS)),
        np.zeros((6, areas, ROWS)),
    )


@jit_rows
def combine(matrix: FloatArray, rows: FloatArray, out: FloatArray) -> None:
    """out += matrix @ rows, at all rows of a step."""
    for c in range(matrix.shape[0]):
        for k in range(matrix.shape[1]):
            share = matrix[c, k]
            for i in range(ROWS):
                out[c, i] += share * rows[k, i]


@jit_rows
def _straight(h: float, rates: FloatArray, w: FloatArray, lin: FloatArray, out: FloatArray) -> None:
    """What the modes' rates are without j; of stiff ones, with it."""
    for k in range(w.shape[0]):
        rate = rates[k]
        if rate * h > STIFF:
            for i in range(ROWS):
                out[k, i] = 0.0
            for m in range(NODES):
                share = w[k, m] / h
                for i in range(ROWS):
                    out[k, i] += TO_RATES[m, i] * share
        else:
            for i in range(ROWS):
                out[k, i] = lin[k, i] - rate * w[k, i]


@jit
def meet(h: float, rates: FloatArray, feed: FloatArray, tap: FloatArray, met: FloatArray) -> bool:
    """Rates of the cells' voltages for each j, into `met` (n_f, n_f): tap @ feed but for the stiff modes.

    Whether that was all of them.
    """
    whole = True
    for a in range(met.shape[0]):
        for b in range(met.shape[1]):
            met[a, b] = 0.0
            for k in range(tap.shape[1]):
                if rates[k] * h > STIFF:
                    whole = False
                else:
                    met[a, b] += tap[a, k] * feed[k, b]
    return whole


@jit_rows
def _copy(rows: FloatArray, out: FloatArray) -> None:
    for c in range(out.shape[0]):
        for i in range(ROWS):
            out[c, i] = rows[c, i]


@jit
def _wanted(
    sign: float, powers: FloatArray, slopes: FloatArray, lo: float, scale: float, curve: FloatArray, u: FloatArray,
    area: FloatArray, slope: FloatArray,
) -> None:  # fmt: skip
    """Area that the gap voltages u (ROWS,) ask for on the branch of a sign, and its slope by them."""
    highest = 0.0
    for i in range(ROWS):
        highest = max(highest, sign * u[i])
    if scale > 0.0 and highest <= curve[1]:
        polynomial_rows(powers, lo, scale, u, sign, area)
        polynomial_rows(slopes, lo, scale, u, sign, slope)
        for i in range(ROWS):
            area[i] = 1.0 / area[i]
            slope[i] *= -scale * sign * area[i] * area[i]
    else:
        for i in range(ROWS):
            q, dq = inverse_area(max(sign * u[i], lo), curve)
            area[i] = 1.0 / q
            slope[i] = -sign * dq / (q * q)


@jit_rows
def _known(
    mobile: bool, c: float, g: float, u: FloatArray, more: FloatArray, rate: FloatArray, known: FloatArray
) -> None:
    """The part of a cell's j that does not hold the voltages' rates; `more` is A - A0, `rate` what time makes of A."""
    for i in range(ROWS):
        known[i] = g * more[i] * u[i]
        if mobile:
            known[i] += c * u[i] * rate[i]


@jit_rows
def _add_column(met: FloatArray, b: int, at: int, factor: float, size: FloatArray, matrix: FloatArray) -> None:
    """Take met[:, b] factor size from column `at` of the matrices (n_f, n_f + 1, ROWS)."""
    for a in range(met.shape[0]):
        share = factor * met[a, b]
        for i in range(ROWS):
            matrix[a, at, i] -= share * size[i]


@jit_rows
def _eliminate(matrix: FloatArray, columns: int) -> None:
    """Solve the systems (n, n + columns, ROWS) of all rows at once; the solutions take the last columns' place.

    Without pivoting: they are a unit matrix and as much again as the areas move. Pivots stay on the diagonal.
    """
    n = matrix.shape[0]
    for p in range(n):
        for a in range(p + 1, n):
            for b in range(p + 1, n + columns):
                for i in range(ROWS):
                    matrix[a, b, i] -= matrix[a, p, i] / matrix[p, p, i] * matrix[p, b, i]
    for p in range(n - 1, -1, -1):
        for c in range(n, n + columns):
            for b in range(p + 1, n):
                for i in range(ROWS):
                    matrix[p, c, i] -= matrix[p, b, i] * matrix[b, c, i]
            for i in range(ROWS):
                matrix[p, c, i] /= matrix[p, p, i]


@jit
def _fold(matrix: FloatArray, small: FloatArray, cell: IntArray, least: FloatArray) -> None:
    """Finish what `matrix` has solved with the rates of the gaps' voltages as given, one more column each.

    `least` takes the distance to the fold: the determinant of the capacitances that small changes meet, over that with
    every area held.
    """
    n, n_area = matrix.shape[0], cell.size
    for a in range(n_area):
        for b in range(n_area + 1):
            for i in range(ROWS):
                small[a, b, i] = 1.0 if a == b else 0.0
        if cell[a] >= 0:
            for i in range(ROWS):
                small[a, n_area, i] = matrix[cell[a], n, i]
            for b in range(n_area):
                for i in range(ROWS):
                    small[a, b, i] -= matrix[cell[a], n + 1 + b, i]
    _eliminate(small, 1)
    for i in range(ROWS):
        least[i] = 1.0
    for a in range(n_area):
        for i in range(ROWS):
            least[i] *= small[a, a, i]
        for c in range(n):
            for i in range(ROWS):
                matrix[c, n, i] += matrix[c, n + 1 + a, i] * small[a, n_area, i]


@jit
def couple(
    mobile: bool, met: FloatArray, c: FloatArray, home: IntArray, cell: IntArray, u: FloatArray, slope: FloatArray,
    more: FloatArray, du: FloatArray, known: FloatArray, matrix: FloatArray, small: FloatArray, least: FloatArray,
) -> None:  # fmt: skip
    """Rates of the cells' voltages into column n_f of `matrix`, from those without j and what of j is known.

    Under `mobile`, c u A' holds the rate of the gap's own voltage: one more unknown for each area.
    """
    n_f = c.size
    columns = 1 + cell.size if mobile else 1
    for a in range(n_f):
        for b in range(n_f + columns):
            for i in range(ROWS):
                matrix[a, b, i] = 1.0 if a == b else 0.0
        for i in range(ROWS):
            matrix[a, n_f, i] = du[a, i]
    for b in range(n_f):
        _add_column(met, b, b, c[b], more[home[b]], matrix)
        _add_column(met, b, n_f, -1.0, known[b], matrix)
        if mobile:
            for i in range(ROWS):
                least[i] = u[b, i] * slope[home[b], i]
            _add_column(met, b, n_f + 1 + home[b], -c[b], least, matrix)
    _eliminate(matrix, columns)
    if mobile:
        _fold(matrix, small, cell, least)


@jit_rows
def _times(factor: float, a: FloatArray, b: FloatArray, out: FloatArray) -> None:
    for i in range(ROWS):
        out[i] += factor * a[i] * b[i]


@jit_inline
def evaluate(
    mobile: bool, h: float, rates: FloatArray, feed: FloatArray, tap: FloatArray, met: FloatArray, c: FloatArray,
    g: FloatArray, home: IntArray, cell: IntArray, area0: FloatArray, unit: FloatArray, slow: IntArray,
    pace: FloatArray, powers: FloatArray, slopes: FloatArray, lo: FloatArray, scale: FloatArray, curves: FloatArray,
    sign: FloatArray, w: FloatArray, lin: FloatArray, d: FloatArray, pull: FloatArray, cells: FloatArray,
    areas: FloatArray, matrix: FloatArray, small: FloatArray, least: FloatArray,
) -> bool:  # fmt: skip
    """Voltages and currents of the cells from the modes w (m, ROWS), and what the areas add to the modes' rates.

    `lin` is gain s, and `d` takes the modes' rates without j. `cells` and `areas` are blocks of rows: of the cells what
    of the voltages and their rates follows the sources, then voltages, rates and j; of the areas A, dA/du, A' of what
    time moves, and A - A0. False past a fold; under `mobile`, `least` (ROWS,) takes the distance to it.
    """
    n = tap.shape[1]
    free, free_rate, u, du, j = cells[FREE], cells[FREE_RATE], cells[CELL_U], cells[DU], cells[J]
    area, slope, rate, more = areas[AREA], areas[SLOPE], areas[RATE], areas[MORE]
    _straight(h, rates, w, lin, d)
    _copy(free, u)
    combine(tap, w[:n], u)
    _copy(free_rate, du)
    combine(tap, d[:n], du)
    for k in range(pull.shape[0]):
        for i in range(ROWS):
            pull[k, i] = 0.0
    for a in range(cell.size):
        if cell[a] >= 0:
            _wanted(sign[a], powers[a], slopes[a], lo[a], scale[a], curves[a], u[cell[a]], area[a], slope[a])
            k = slow[a]
            if k >= 0:
                for i in range(ROWS):
                    pull[k, i] = pace[a] / unit[a] * area[a, i]
                    area[a, i] = unit[a] * w[k, i]
                    slope[a, i] = 0.0
                    rate[a, i] = unit[a] * (d[k, i] if rates[k] * h > STIFF else d[k, i] + pull[k, i])
            for i in range(ROWS):
                more[a, i] = area[a, i] - area0[a]
    n_f = c.size
    for a in range(n_f):
        _known(mobile, c[a], g[a], u[a], more[home[a]], rate[home[a]], j[a])
    couple(mobile, met, c, home, cell, u, slope, more, du, j, matrix, small, least)
    if mobile:
        for i in range(ROWS):
            # NaN is no solution either.
            if not least[i] > 0.0:
                return False
    for b in range(n_f):
        for i in range(ROWS):
            du[b, i] = matrix[b, n_f, i]
    for b in range(n_f):
        _times(c[b], more[home[b]], du[b], j[b])
        if mobile:
            for i in range(ROWS):
                matrix[b, n_f, i] = u[b, i] * slope[home[b], i]
            _times(c[b], matrix[b, n_f], du[cell[home[b]]], j[b])
    combine(feed, j, pull)
    return True
