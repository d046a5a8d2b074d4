"""A network in modal form around reference areas, and what an exponential step of it evaluates at all its rows.

With its areas fixed at A0 every network is linear: x = shape v - follow s with v' = -rates v + gain s. The change of an
area adds a current j in each cell whose area follows a voltage,

    v' = -rates v + gain s + feed j,    j = (A - A0) (c u' + g u)  [mobile: + c u A'],    u = tap v + tap_s s.

j contains the derivatives of the voltages, but linearly and at the same time only, so that each row of a step solves
for them (see `fingerspice.engine.coupling`); the fold is where this equation has no solution. An area with a time
constant is one more mode, of rate 1 / tau. Within a jump of the sources the independent variable is the fraction of the
jump, and nothing leaks: all rates are zero.

These functions take plain arrays, as those of `fingerspice.engine.rows` do.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fingerspice.base.arrays import FloatArray, IntArray
from fingerspice.base.compiled import jit, jit_rows, jit_within
from fingerspice.engine.coupling import STIFF, Coupling, answer_alone, answer_mobile, answer_together, new_coupling
from fingerspice.engine.readout import N_PLACES, WRITTEN_AT_ONCE
from fingerspice.engine.rows import polynomial_rows
from fingerspice.engine.work import N_FLAT
from fingerspice.numerics.lobatto import BETWEEN, DERIVATIVE, NODES, ROWS
from fingerspice.physics.contact import inverse_area

# Blocks of the modes' rows.
W, BASE, LIN, D, PULL, USED, PULL_BEFORE, LEFT_BEFORE = range(8)
# Blocks of the cells' rows: the parts of eta and chi that follow the sources, eta and chi, rho, shares of A', voltages,
# currents.
ETA_S, CHI_S, ETA, CHI, RHO, SHARE, CELL_U, J = range(8)
# Blocks of the areas' rows: A, dA/du, the part of A' that depends on time, A - A0, A'; gap voltages, their guess, and
# their part that follows the sources.
AREA, SLOPE, RATE, MORE, KNOWN, U, GUESS, U_S = range(8)

# From values at the nodes to slopes at all rows, per step length: slopes = values @ TO_RATES.
TO_RATES = np.ascontiguousarray(np.vstack([DERIVATIVE, BETWEEN.T @ DERIVATIVE]).T)


class Form(NamedTuple):
    """See the module. n live voltages, m modes with those of slow areas behind, n_f cells whose area moves.

    Attributes
    ----------
    numbers : ndarray, shape (size,)
        All numbers that depend on the reference areas; the arrays named in `REFERRED` are views of it, so that a change
        of the reference areas is one copy.
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
        First of these cells of each area.
    cell : ndarray of int, shape (n_area,)
        The cell whose voltage the area follows; -1 if the area is fixed.
    area0, unit : ndarray, shape (n_area,)
        Reference area, and the area at 0 V, m^2: areas with a time constant are states in units of it.
    slow : ndarray of int, shape (n_area,)
        The mode of each area that has a time constant, else -1; `pace` (n_area,) is its rate, 1/s.
    gap, gap_s : ndarray, shape (n_area, n) and (n_area, n_s)
        Voltage of each area's GAP from x and s; zero without one.
    node, node_s : ndarray, shape (n_node, n) and (n_node, n_s)
        Voltage of each node from the same.
    size : ndarray, shape (n,)
        Euclidean norm of the state voltages (V) for one unit of each mode.
    mobile : bool
        Charge law.
    stress : ndarray, shape (n_area,)
        Force per area and squared gap voltage, Pa/V^2.
    powers, slopes : ndarray, shape (n_area, DEGREE + 1)
        1/A as in `engine.system.System`, with `lo`, `scale` (n_area,); `curves` solve Eq. 4 where these do not reach.
    stored, stored_s, lost, lost_s : ndarray, shape (n_s, n) and (n_s, n_s)
        Current that each source delivers at the reference areas: stored v' + stored_s s' + lost v + lost_s s.
    through : ndarray, shape (n_s, n_f)
        Share of the current j of each cell that the source delivers in addition.
    """

    numbers: FloatArray
    rates: FloatArray
    gain: FloatArray
    shape: FloatArray
    inverse: FloatArray
    follow: FloatArray
    feed: FloatArray
    tap: FloatArray
    tap_s: FloatArray
    area0: FloatArray
    gap: FloatArray
    gap_s: FloatArray
    node: FloatArray
    node_s: FloatArray
    size: FloatArray
    stored: FloatArray
    stored_s: FloatArray
    lost: FloatArray
    lost_s: FloatArray
    mobile: bool
    c: FloatArray
    g: FloatArray
    home: IntArray
    first: IntArray
    cell: IntArray
    unit: FloatArray
    slow: IntArray
    pace: FloatArray
    stress: FloatArray
    powers: FloatArray
    slopes: FloatArray
    lo: FloatArray
    scale: FloatArray
    curves: FloatArray
    through: FloatArray


#: The fields of a `Form` that belong to its reference areas, in the order in which they stand in its `numbers`.
REFERRED = Form._fields[1:19]


class Work(NamedTuple):
    """Arrays that steps work in; those with ROWS behind hold one value for each row of a step.

    `own` is the coupling of the step at hand, and `at` (1,) the number of the reference in use.
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
    at: IntArray
    w0: FloatArray
    places: FloatArray
    weight: FloatArray
    values: FloatArray
    coefficients: FloatArray
    outputs: FloatArray
    room: FloatArray
    off: FloatArray
    slips: FloatArray
    cell_slips: FloatArray
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
        np.zeros(1, np.int64),
        np.zeros(modes),
        np.zeros((modes, N_PLACES)),
        np.zeros(modes),
        np.zeros((columns, ROWS)),
        np.zeros((columns, ROWS)),
        np.zeros((2, WRITTEN_AT_ONCE)),
        np.zeros((4, ROWS)),
        np.zeros((N_PLACES, modes + sources)),
        np.zeros((2, modes, N_PLACES)),
        np.zeros((2, N_PLACES, cells + areas)),
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
def combine_from(matrix: FloatArray, rows: FloatArray, start: FloatArray, out: FloatArray) -> None:
    """out = start + matrix @ rows, at all rows of a step."""
    n = matrix.shape[1]
    for c in range(matrix.shape[0]):
        if n == 0:
            for i in range(ROWS):
                out[c, i] = start[c, i]
        else:
            share = matrix[c, 0]
            for i in range(ROWS):
                out[c, i] = start[c, i] + share * rows[0, i]
        for k in range(1, n - 1, 2):
            share, other = matrix[c, k], matrix[c, k + 1]
            for i in range(ROWS):
                out[c, i] += share * rows[k, i] + other * rows[k + 1, i]
        if n > 1 and n % 2 == 0:
            share = matrix[c, n - 1]
            for i in range(ROWS):
                out[c, i] += share * rows[n - 1, i]


@jit_rows
def mode_rates(
    h: float, rates: FloatArray, w: FloatArray, lin: FloatArray, pull: FloatArray, stiff_only: bool, out: FloatArray
) -> None:
    """Derivatives of the modes: of stiff modes (perhaps only of these) by the derivative of their polynomials."""
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
def clear(rows: FloatArray) -> None:
    for c in range(rows.shape[0]):
        for i in range(ROWS):
            rows[c, i] = 0.0


@jit_rows
def _highest(sign: float, u: FloatArray) -> float:
    highest = 0.0
    for i in range(ROWS):
        highest = max(highest, sign * u[i])
    return highest


@jit_rows
def _invert(area: FloatArray) -> None:
    for i in range(ROWS):
        area[i] = 1.0 / area[i]


@jit_rows
def _scale_slope(factor: float, area: FloatArray, slope: FloatArray) -> None:
    for i in range(ROWS):
        slope[i] *= factor * area[i] * area[i]


@jit
def wanted(
    slopes_too: bool, sign: float, powers: FloatArray, slopes: FloatArray, lo: float, scale: float, curve: FloatArray,
    u: FloatArray, area: FloatArray, slope: FloatArray,
) -> None:  # fmt: skip
    """Area at the gap voltages u (ROWS,) on the branch of a sign and, if wanted, its derivative by them."""
    if scale > 0.0 and _highest(sign, u) <= curve[1]:
        polynomial_rows(powers, lo, scale, u, sign, area)
        _invert(area)
        if slopes_too:
            polynomial_rows(slopes, lo, scale, u, sign, slope)
            _scale_slope(-scale * sign, area, slope)
    else:
        for i in range(ROWS):
            q, dq = inverse_area(max(sign * u[i], lo), curve)
            area[i] = 1.0 / q
            slope[i] = -sign * dq / (q * q)


@jit_rows
def _moving(
    mobile: bool, h: float, rate_k: float, pace: float, unit: float, w: FloatArray, lin: FloatArray, d: FloatArray,
    forced: FloatArray, area: FloatArray, slope: FloatArray, rate: FloatArray,
) -> None:  # fmt: skip
    """An area with a time constant: its forcing by the equilibrium area in `area`; then the area and its derivative."""
    for i in range(ROWS):
        forced[i] = pace / unit * area[i]
        area[i] = unit * w[i]
        slope[i] = 0.0
    if mobile:
        for i in range(ROWS):
            rate[i] = unit * (d[i] if rate_k * h > STIFF else lin[i] - rate_k * w[i] + forced[i])


@jit_rows
def _subtract(area: FloatArray, area0: float, more: FloatArray) -> None:
    for i in range(ROWS):
        more[i] = area[i] - area0


@jit_within
def evaluate(
    form: Form, coupling: Coupling, several: bool, h: float, rates: FloatArray, pace: FloatArray, sign: FloatArray,
    w: FloatArray, lin: FloatArray, d: FloatArray, pull: FloatArray, cells: FloatArray, areas: FloatArray,
    matrix: FloatArray, mixed: FloatArray, least: FloatArray,
) -> bool:  # fmt: skip
    """Forcing of the modes by the areas, into `pull` (m, ROWS), from the modes w (m, ROWS).

    `lin` is gain s, and `d` receives the derivatives of stiff modes. `cells` and `areas` are blocks of rows, whose
    parts that follow the sources are given. False beyond a fold; under `mobile`, `least` (ROWS,) receives the distance
    to it.
    """
    mobile = form.mobile
    n = form.gap.shape[1]
    stiff = coupling.key[1] > 0
    u, eta, chi, rho = areas[U], cells[ETA], cells[CHI], cells[RHO]
    area, slope, rate, more = areas[AREA], areas[SLOPE], areas[RATE], areas[MORE]
    combine_from(form.gap, w, areas[U_S], u)
    clear(pull)
    if stiff:
        mode_rates(h, rates, w, lin, pull, True, d)
    for a in range(form.cell.size):
        if form.cell[a] >= 0:
            wanted(
                mobile, sign[a], form.powers[a], form.slopes[a], form.lo[a], form.scale[a], form.curves[a], u[a],
                area[a], slope[a],
            )  # fmt: skip
            k = form.slow[a]
            if k >= 0:
                _moving(
                    mobile, h, rates[k], pace[a], form.unit[a], w[k], lin[k], d[k], pull[k], area[a], slope[a], rate[a]
                )  # fmt: skip
            _subtract(area[a], form.area0[a], more[a])
    combine_from(coupling.from_modes, w, cells[ETA_S], eta)
    if stiff:
        combine(coupling.from_stiff, d[:n], eta)
    if mobile:
        combine_from(coupling.held, w, cells[CHI_S], chi)
        answer_mobile(
            several, coupling.answer, coupling.gap, coupling.leak, coupling.cross, form.home, form.first, form.cell, u,
            more, slope, rate, chi, eta, rho, areas[KNOWN], cells[SHARE], mixed, matrix, least,
        )  # fmt: skip
        for i in range(ROWS):
            # NaN is no solution either.
            if not least[i] > 0.0:
                return False
    elif several:
        answer_together(form.home, coupling.answer, coupling.cross, more, cells[SHARE], eta, rho)
    else:
        answer_alone(form.home, coupling.answer, more, eta, rho)
    combine(coupling.feed, rho, pull[:n])
    return True


@jit_within
def follow_sources(
    form: Form, coupling: Coupling, gain: FloatArray, s: FloatArray, ds: FloatArray, lin: FloatArray,
    cells: FloatArray, areas: FloatArray,
) -> None:  # fmt: skip
    """The parts of a step's rows that depend on the sources alone; see `evaluate`."""
    n = form.gap.shape[1]
    clear(lin)
    combine(gain, s, lin)
    clear(cells[ETA_S])
    combine(coupling.from_rates, lin[:n], cells[ETA_S])
    combine(coupling.from_slopes, ds, cells[ETA_S])
    combine(coupling.from_sources, s, cells[ETA_S])
    clear(cells[CHI_S])
    combine(coupling.from_slopes, s, cells[CHI_S])
    clear(areas[U_S])
    combine(form.gap_s, s, areas[U_S])
