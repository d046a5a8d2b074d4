"""A network in modal form around reference areas, and what an exponential step of it evaluates at all its rows.

With areas A0 held every network is linear, x = shape v - follow s with v' = -rates v + gain s. What the areas move
beside that is a current j in each cell whose area follows a voltage,

    v' = -rates v + gain s + feed j,    j = (A - A0) (c u' + g u)  [mobile: + c u A'],    u = tap v + tap_s s.

j holds the voltages' rates, but pointwise and linearly: each row solves for them (see `fingerspice.engine.coupling`),
and where that has no solution is the fold. An area with dynamics of its own is one more mode, of rate 1 / tau. A jump
of the sources is the same in the fraction of the jump, with nothing leaking: all rates zero.

These functions take plain arrays, as those of `fingerspice.engine.rows`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fingerspice.base.compiled import jit, jit_inline, jit_rows
from fingerspice.engine.charge import DERIVATIVE
from fingerspice.engine.coupling import STIFF, Coupling, answer_all, answer_alone, new_coupling
from fingerspice.engine.exponential import N_PLACES
from fingerspice.engine.readout import WRITTEN_AT_ONCE
from fingerspice.engine.rows import N_FLAT, polynomial_rows
from fingerspice.numerics.lobatto import BETWEEN, NODES, ROWS
from fingerspice.physics.contact import inverse_area

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

# Blocks of the modes' rows.
W, BASE, LIN, D, PULL, USED, PULL_BEFORE, LEFT_BEFORE = range(8)
# Of the cells': what of eta and chi follows the sources, both in whole, rho, shares of A', voltages, currents.
ETA_S, CHI_S, ETA, CHI, RHO, SHARE, CELL_U, J = range(8)
# Of the areas': A, dA/du, A' of what time moves, A - A0, A'; gap voltages, their guess, and what follows the sources.
AREA, SLOPE, RATE, MORE, KNOWN, U, GUESS, U_S = range(8)

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
    tap, tap_s : ndarray, shape (n_f, n) and (n_f, n_s)
    c, g : ndarray, shape (n_f,)
        Capacitance and leak of the cells per area.
    home : ndarray of int, shape (n_f,)
        The area of each of these cells, ascending.
    first : ndarray of int, shape (n_area + 1,)
        Where the cells of each area begin.
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
    tap: FloatArray
    tap_s: FloatArray
    c: FloatArray
    g: FloatArray
    home: IntArray
    first: IntArray
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
    """Arrays that steps work in; those with ROWS behind hold one value for each row of a step.

    `own` is the coupling of the step at hand, `whole` that with no mode taken for stiff, and `inside` that of a jump.
    """

    r: FloatArray
    s: FloatArray
    ds: FloatArray
    modes: FloatArray
    cells: FloatArray
    areas: FloatArray
    matrix: FloatArray
    mixed: FloatArray
    own: Coupling
    whole: Coupling
    inside: Coupling
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
        np.zeros((8, cells, ROWS)),
        np.zeros((8, areas, ROWS)),
        np.zeros((cells, cells + 1, ROWS)),
        np.zeros((cells, areas + 1, ROWS)),
        new_coupling(n, cells, sources),
        new_coupling(n, cells, sources),
        new_coupling(n, cells, sources),
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
        np.zeros((8, cells, ROWS)),
        np.zeros((8, areas, ROWS)),
    )


@jit_rows
def combine(matrix: FloatArray, rows: FloatArray, out: FloatArray) -> None:
    """out += matrix @ rows, at all rows of a step."""
    n = matrix.shape[1]
    for c in range(matrix.shape[0]):
        # Two at a time: the sum is fetched and put back half as often.
        for k in range(0, n - 1, 2):
            share, other = matrix[c, k], matrix[c, k + 1]
            for i in range(ROWS):
                out[c, i] += share * rows[k, i] + other * rows[k + 1, i]
        if n % 2 == 1:
            share = matrix[c, n - 1]
            for i in range(ROWS):
                out[c, i] += share * rows[n - 1, i]


@jit_rows
def mode_rates(
    h: float, rates: FloatArray, w: FloatArray, lin: FloatArray, pull: FloatArray, stiff_only: bool, out: FloatArray
) -> None:
    """Rates of the modes; those of stiff ones, which may be all that is wanted, by their polynomials."""
    for k in range(w.shape[0]):
        rate = rates[k]
        if rate * h > STIFF:
            for i in range(ROWS):
                out[k, i] = 0.0
            for m in range(NODES):
                share = w[k, m] / h
                for i in range(ROWS):
                    out[k, i] += TO_RATES[m, i] * share
        elif not stiff_only:
            for i in range(ROWS):
                out[k, i] = lin[k, i] - rate * w[k, i] + pull[k, i]


@jit_rows
def _start(rows: FloatArray, out: FloatArray) -> None:
    for c in range(out.shape[0]):
        for i in range(ROWS):
            out[c, i] = rows[c, i]


@jit_rows
def _clear(rows: FloatArray) -> None:
    for c in range(rows.shape[0]):
        for i in range(ROWS):
            rows[c, i] = 0.0


@jit
def wanted(
    slopes_too: bool, sign: float, powers: FloatArray, slopes: FloatArray, lo: float, scale: float, curve: FloatArray,
    u: FloatArray, area: FloatArray, slope: FloatArray,
) -> None:  # fmt: skip
    """Area that the gap voltages u (ROWS,) ask for on the branch of a sign, and perhaps its slope by them."""
    highest = 0.0
    for i in range(ROWS):
        highest = max(highest, sign * u[i])
    if scale > 0.0 and highest <= curve[1]:
        polynomial_rows(powers, lo, scale, u, sign, area)
        for i in range(ROWS):
            area[i] = 1.0 / area[i]
        if slopes_too:
            polynomial_rows(slopes, lo, scale, u, sign, slope)
            for i in range(ROWS):
                slope[i] *= -scale * sign * area[i] * area[i]
    else:
        for i in range(ROWS):
            q, dq = inverse_area(max(sign * u[i], lo), curve)
            area[i] = 1.0 / q
            slope[i] = -sign * dq / (q * q)


@jit
def _areas(
    mobile: bool, h: float, rates: FloatArray, cell: IntArray, area0: FloatArray, unit: FloatArray, slow: IntArray,
    pace: FloatArray, powers: FloatArray, slopes: FloatArray, lo: FloatArray, scale: FloatArray, curves: FloatArray,
    sign: FloatArray, w: FloatArray, lin: FloatArray, d: FloatArray, pull: FloatArray, areas: FloatArray,
) -> None:  # fmt: skip
    """Areas at all rows, what their gap voltages and time move them, and the forcing of those with dynamics."""
    area, slope, rate, more, u = areas[AREA], areas[SLOPE], areas[RATE], areas[MORE], areas[U]
    for a in range(cell.size):
        if cell[a] >= 0:
            wanted(mobile, sign[a], powers[a], slopes[a], lo[a], scale[a], curves[a], u[a], area[a], slope[a])
            k = slow[a]
            if k >= 0:
                for i in range(ROWS):
                    pull[k, i] = pace[a] / unit[a] * area[a, i]
                    area[a, i] = unit[a] * w[k, i]
                    slope[a, i] = 0.0
                    rate[a, i] = unit[a] * (
                        d[k, i] if rates[k] * h > STIFF else lin[k, i] - rates[k] * w[k, i] + pull[k, i]
                    )
            for i in range(ROWS):
                more[a, i] = area[a, i] - area0[a]


@jit_inline
def evaluate(
    mobile: bool, several: bool, h: float, rates: FloatArray, coupling: Coupling, home: IntArray, first: IntArray,
    cell: IntArray, area0: FloatArray,
    unit: FloatArray, slow: IntArray, pace: FloatArray, gap: FloatArray, powers: FloatArray, slopes: FloatArray,
    lo: FloatArray, scale: FloatArray, curves: FloatArray, sign: FloatArray, w: FloatArray, lin: FloatArray,
    d: FloatArray, pull: FloatArray, cells: FloatArray, areas: FloatArray, matrix: FloatArray, mixed: FloatArray,
    least: FloatArray,
) -> bool:  # fmt: skip
    """What the areas add to the modes' rates, into `pull` (m, ROWS), from the modes w (m, ROWS).

    `lin` is gain s, and `d` takes the rates of stiff modes. `cells` and `areas` are blocks of rows, whose parts that
    follow the sources are given. False past a fold; under `mobile`, `least` (ROWS,) takes the distance to it.
    """
    n = gap.shape[1]
    n_stiff = coupling.stiff[0]
    u, eta, chi, rho = areas[U], cells[ETA], cells[CHI], cells[RHO]
    _start(areas[U_S], u)
    combine(gap, w[:n], u)
    _clear(pull)
    if n_stiff > 0:
        mode_rates(h, rates, w, lin, pull, True, d)
    _areas(
        mobile, h, rates, cell, area0, unit, slow, pace, powers, slopes, lo, scale, curves, sign, w, lin, d, pull, areas
    )
    _start(cells[ETA_S], eta)
    combine(coupling.from_modes, w[:n], eta)
    if n_stiff > 0:
        combine(coupling.from_stiff, d[:n], eta)
    if mobile:
        _start(cells[CHI_S], chi)
        combine(coupling.held, w[:n], chi)
    if mobile or several:
        answer_all(
            mobile, several, coupling.answer, coupling.gap, coupling.leak, coupling.cross, home, first, cell, u,
            areas[MORE], areas[SLOPE],
            areas[RATE], chi, eta, rho, areas[KNOWN], cells[SHARE], mixed, matrix, least,
        )  # fmt: skip
        if mobile:
            for i in range(ROWS):
                # NaN is no solution either.
                if not least[i] > 0.0:
                    return False
    else:
        answer_alone(home, coupling.answer, areas[MORE], eta, rho)
    combine(coupling.feed, rho, pull[:n])
    return True


@jit_inline
def follow_sources(
    gain: FloatArray, from_rates: FloatArray, from_sources: FloatArray, from_slopes: FloatArray, gap_s: FloatArray,
    s: FloatArray, ds: FloatArray, lin: FloatArray, cells: FloatArray, areas: FloatArray,
) -> None:  # fmt: skip
    """What of a step's rows follows the sources alone; see `evaluate`."""
    n = from_rates.shape[1]
    _clear(lin)
    combine(gain, s, lin)
    _clear(cells[ETA_S])
    combine(from_rates, lin[:n], cells[ETA_S])
    combine(from_slopes, ds, cells[ETA_S])
    combine(from_sources, s, cells[ETA_S])
    _clear(cells[CHI_S])
    combine(from_slopes, s, cells[CHI_S])
    _clear(areas[U_S])
    combine(gap_s, s, areas[U_S])
