"""Currents that a network's areas add at all rows of a step (`engine.many_areas.coupling`)."""

from __future__ import annotations

from typing import NamedTuple

from fingerspice.base.arrays import FloatArray, IntArray
from fingerspice.base.compiled import jit_rows, jit_within
from fingerspice.engine.many_areas.coupling import Coupling
from fingerspice.numerics.lobatto import ROWS

# Gauss-Seidel sweeps over the areas in each evaluation of the currents.
_SWEEPS = 2


@jit_rows
def answer_alone(home: IntArray, answer: FloatArray, more: FloatArray, eta: FloatArray, rho: FloatArray) -> None:
    """rho under `local` where the areas are not coupled with one another; `more` (n_area, ROWS) is e."""
    for c in range(answer.size):
        e = more[home[c]]
        for i in range(ROWS):
            rho[c, i] = e[i] * eta[c, i] / (1.0 + e[i] * answer[c])


@jit_rows
def _distance_of_area(
    answer: FloatArray, gap: FloatArray, first: int, last: int, more: FloatArray, slope: FloatArray, chi: FloatArray,
    factor: FloatArray,
) -> None:  # fmt: skip
    """Distance to the fold of one area with the cells first to last, into `factor` (ROWS,): it is 0 at a fold."""
    for i in range(ROWS):
        factor[i] = 1.0
    for c in range(first, last):
        for i in range(ROWS):
            factor[i] += slope[i] * gap[c] * answer[c] * chi[c, i] / (1.0 + more[i] * answer[c])


@jit_rows
def _rate_of_area(
    answer: FloatArray, gap: FloatArray, leak: float, first: int, last: int, u: FloatArray, more: FloatArray,
    slope: FloatArray, rate: FloatArray, factor: FloatArray, known: FloatArray, share: FloatArray,
) -> None:  # fmt: skip
    """A' = known + sum of share_c eta_c over one area's cells first to last; `factor` is its distance to the fold.

    `rate` is the part of A' that does not come from the gap voltage (an area that follows with a delay).
    """
    for i in range(ROWS):
        known[i] = (rate[i] - slope[i] * leak * u[i]) / factor[i]
    for c in range(first, last):
        for i in range(ROWS):
            share[c, i] = slope[i] * gap[c] / ((1.0 + more[i] * answer[c]) * factor[i])


@jit_rows
def _fill_matrix(
    slopes: bool, home: IntArray, answer: FloatArray, cross: FloatArray, more: FloatArray, eta: FloatArray,
    known: FloatArray, share: FloatArray, mixed: FloatArray, matrix: FloatArray,
) -> None:  # fmt: skip
    """(I - cross d rho / d eta) eta = part of eta independent of other areas, into `matrix` (n_f, n_f + 1, ROWS)."""
    n_f, n_area = answer.size, more.shape[0]
    for b in range(n_f):
        for c in range(n_f):
            for i in range(ROWS):
                matrix[b, c, i] = 1.0 if b == c else 0.0
            x = cross[b, c]
            if x != 0.0:
                e = more[home[c]]
                for i in range(ROWS):
                    matrix[b, c, i] = -x * e[i] / (1.0 + e[i] * answer[c])
            if slopes:
                for i in range(ROWS):
                    matrix[b, c, i] -= mixed[b, home[c], i] * share[c, i]
        for i in range(ROWS):
            matrix[b, n_f, i] = eta[b, i]
        if slopes:
            for a in range(n_area):
                for i in range(ROWS):
                    matrix[b, n_f, i] += mixed[b, a, i] * known[a, i]


@jit_rows
def _eliminate(matrix: FloatArray, inverse: FloatArray, least: FloatArray, divide: bool) -> None:
    """Solve the systems (n, n + 1, ROWS) of all rows at once; the solutions replace the last column.

    No pivots are sought: the matrices differ from the unit matrix by as much as the areas move. `least` is multiplied
    by the determinant or, with `divide`, divided by it; `inverse` (ROWS,) is scratch.
    """
    n = matrix.shape[0]
    for p in range(n):
        for i in range(ROWS):
            inverse[i] = 1.0 / matrix[p, p, i]
        for i in range(ROWS):
            least[i] *= inverse[i] if divide else matrix[p, p, i]
        for b in range(p + 1, n + 1):
            for i in range(ROWS):
                matrix[p, b, i] *= inverse[i]
        for a in range(p + 1, n):
            for b in range(p + 1, n + 1):
                for i in range(ROWS):
                    matrix[a, b, i] -= matrix[a, p, i] * matrix[p, b, i]
    for p in range(n - 2, -1, -1):
        for b in range(p + 1, n):
            for i in range(ROWS):
                matrix[p, n, i] -= matrix[p, b, i] * matrix[b, n, i]


@jit_rows
def _mix(
    home: IntArray, answer: FloatArray, cross: FloatArray, more: FloatArray, chi: FloatArray, mixed: FloatArray
) -> None:
    """Derivative of eta by the rates A' of other areas, through their cells' chi, into `mixed` (n_f, n_area, ROWS)."""
    for b in range(answer.size):
        for a in range(more.shape[0]):
            for i in range(ROWS):
                mixed[b, a, i] = 0.0
        for c in range(answer.size):
            x = cross[b, c]
            if x != 0.0:
                e = more[home[c]]
                for i in range(ROWS):
                    mixed[b, home[c], i] += x * chi[c, i] / (1.0 + e[i] * answer[c])


@jit_rows
def _take_solution(matrix: FloatArray, eta: FloatArray) -> None:
    n = matrix.shape[0]
    for b in range(n):
        for i in range(ROWS):
            eta[b, i] = matrix[b, n, i]


@jit_rows
def _add_rates(
    home: IntArray, answer: FloatArray, more: FloatArray, chi: FloatArray, eta: FloatArray, known: FloatArray,
    share: FloatArray, rho: FloatArray,
) -> None:  # fmt: skip
    """rho += chi A' / (1 + e L); `known` (n_area, ROWS) becomes A'."""
    for c in range(answer.size):
        for i in range(ROWS):
            known[home[c], i] += share[c, i] * eta[c, i]
    for c in range(answer.size):
        e = more[home[c]]
        for i in range(ROWS):
            rho[c, i] += chi[c, i] * known[home[c], i] / (1.0 + e[i] * answer[c])


class Moving(NamedTuple):
    """Rows of a step that the currents under `mobile` depend on, and those that receive them."""

    # u, more, slope, rate (n_area, ROWS): Gap voltage, A - A0, dA/du, and the part of A' that does not come from the
    # gap voltage
    u: FloatArray
    more: FloatArray
    slope: FloatArray
    rate: FloatArray
    # chi, eta, rho (n_f, ROWS): See the module
    chi: FloatArray
    eta: FloatArray
    rho: FloatArray
    # known, share (n_area, ROWS): Scratch
    known: FloatArray
    share: FloatArray


@jit_within
def answer_mobile(
    several: bool, x: Coupling, home: IntArray, first: IntArray, cell: IntArray, rows: Moving, mixed: FloatArray,
    matrix: FloatArray, least: FloatArray,
) -> None:  # fmt: skip
    """rho under `mobile`, with all couplings of the areas; `least` (ROWS,) takes the distance to the fold.

    This is the ratio of two determinants of the capacitances for small changes: with moving areas to with areas held.
    """
    answer, more, chi, eta, known, share = x.answer, rows.more, rows.chi, rows.eta, rows.known, rows.share
    for i in range(ROWS):
        least[i] = 1.0
    spare = mixed[0, more.shape[0]]
    for a in range(cell.size):
        if cell[a] >= 0:
            c, last = first[a], first[a + 1]
            _distance_of_area(answer, x.gap, c, last, more[a], rows.slope[a], chi, spare)
            _rate_of_area(
                answer, x.gap, x.leak[c], c, last, rows.u[a], more[a], rows.slope[a], rows.rate[a], spare, known[a],
                share,
            )  # fmt: skip
            for i in range(ROWS):
                least[i] *= spare[i]
    if several:
        _fill_matrix(False, home, answer, x.cross, more, eta, known, share, mixed, matrix)
        _eliminate(matrix, spare, least, True)
        _mix(home, answer, x.cross, more, chi, mixed)
        _fill_matrix(True, home, answer, x.cross, more, eta, known, share, mixed, matrix)
        _eliminate(matrix, spare, least, False)
        _take_solution(matrix, eta)
    answer_alone(home, answer, more, eta, rows.rho)
    _add_rates(home, answer, more, chi, eta, known, share, rows.rho)


@jit_rows
def answer_together(
    home: IntArray, answer: FloatArray, cross: FloatArray, more: FloatArray, own: FloatArray, eta: FloatArray,
    rho: FloatArray,
) -> None:  # fmt: skip
    """rho under `local` where the areas are coupled, improved from its last value by Gauss-Seidel sweeps.

    A sweep reduces the error to at most the fraction (A - A0)^2 / A0^2 of it. The step's own iteration, whose every
    evaluation goes on from the last rho, reduces it further. `own` (n_f, ROWS) is scratch.
    """
    n_f = answer.size
    for _ in range(_SWEEPS):
        for b in range(n_f):
            for i in range(ROWS):
                own[b, i] = eta[b, i]
            for c in range(n_f):
                x = cross[b, c]
                if x != 0.0:
                    for i in range(ROWS):
                        own[b, i] += x * rho[c, i]
            if b + 1 == n_f or home[b + 1] != home[b]:
                # The cells of an area are independent of one another: update all of them at once.
                for c in range(n_f):
                    if home[c] == home[b]:
                        e = more[home[c]]
                        for i in range(ROWS):
                            rho[c, i] = e[i] * own[c, i] / (1.0 + e[i] * answer[c])


@jit_rows
def cell_currents(root: FloatArray, rho: FloatArray, j: FloatArray) -> None:
    """The cells' currents beside those at the reference areas (A), from rho."""
    for b in range(root.shape[0]):
        for i in range(ROWS):
            j[b, i] = 0.0
        for c in range(root.shape[0]):
            share = root[b, c]
            if share != 0.0:
                for i in range(ROWS):
                    j[b, i] += share * rho[c, i]
