"""What the areas of a network add to its modes' rates, at all rows of a step.

In the notation of `fingerspice.engine.netrows`, each cell b whose area moves takes the current

    j_b = e (c_b u_b' + g_b u_b)  [mobile: + c_b u_b A'],    e = A - A0,

beside the one at the reference area, and the currents drive the cells' own voltages: u' = u0' + M j, where u0' is what
the modes' rates are without j, and M = tap feed is symmetric and negative. With M = -V L V' in the metric of the
cells' capacitances, one area at a time, and

    eta = V' (C^1/2 u0' + C^-1/2 G u),    chi = V' C^1/2 u,

all cells of an area answer independently of one another,

    j = C^1/2 V rho,    rho_i = (e eta_i + [mobile: chi_i A']) / (1 + e L_i):

one division for each, and linear maps of the modes before and after. Cells of different areas answer one another by
what is left of M between them, `cross`. Under `mobile` A' = (dA/du) u' of the gap's own cell closes one scalar equation
for each area; where its factor, or the determinant for several areas, falls to 0 is the fold.

The rate of a mode that is much faster than the step is taken from its own polynomial, which holds j already: such modes
count in u0' and not in M.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from fingerspice.base.arrays import FloatArray, IntArray, views_of
from fingerspice.base.compiled import jit, jit_rows
from fingerspice.numerics.lobatto import ROWS
from fingerspice.numerics.small import copy_to, diagonalise

# Steps over the time constant of a mode from which on its rate is taken from its polynomial: -rate w + gain s + feed j
# would be what is left of large numbers, and j hands that on to every other mode.
STIFF = 300.0
# Over the areas, each time the currents are evaluated.
_SWEEPS = 2
# Couplings that are kept for when they are needed again, and numbers of them, at most.
_KEPT, _MOST_NUMBERS = 16, 65_536


class Coupling(NamedTuple):
    """See the module; n_f cells in the bases of their areas, n live voltages, n_s sources.

    Attributes
    ----------
    answer : ndarray, shape (n_f,)
        L, 1/m^2.
    root : ndarray, shape (n_f, n_f)
        C^1/2 V: currents of the cells from rho.
    from_modes, from_rates, from_stiff, held : ndarray, shape (n_f, n)
        eta from the modes, from what drives them, and from the rates of those that are stiff; chi from the modes.
    from_sources, from_slopes : ndarray, shape (n_f, n_s)
        eta from the sources and their slopes; chi follows the sources as eta does their slopes.
    feed : ndarray, shape (n, n_f)
        Rates of the modes from rho.
    gap, leak : ndarray, shape (n_f,)
        Rate of the voltage that the area follows is gap (eta - L chi A') / (1 + e L), summed, less leak u.
    cross : ndarray, shape (n_f, n_f)
        eta from rho of other areas.
    numbers : ndarray, shape (size,)
        All of the above, which are views of it.
    key : ndarray of int, shape (2,)
        Of what this is the coupling, and the number of stiff modes, which says which they are; -1 for nothing yet.
    kept, keys : ndarray, shape (room, size) and (room, 2)
        `numbers` and `key` of couplings that were filled in before, the oldest of which give way.
    used : ndarray of int, shape (1,)
        How many of them there were.
    """

    answer: FloatArray
    root: FloatArray
    from_modes: FloatArray
    from_rates: FloatArray
    from_stiff: FloatArray
    held: FloatArray
    from_sources: FloatArray
    from_slopes: FloatArray
    feed: FloatArray
    gap: FloatArray
    leak: FloatArray
    cross: FloatArray
    numbers: FloatArray
    key: IntArray
    kept: FloatArray
    keys: IntArray
    used: IntArray


def new_coupling(n: int, cells: int, sources: int) -> Coupling:
    """Nothing filled in yet."""
    shapes = (
        (cells,), (cells, cells), (cells, n), (cells, n), (cells, n), (cells, n), (cells, sources), (cells, sources),
        (n, cells), (cells,), (cells,), (cells, cells),
    )  # fmt: skip
    numbers, parts = views_of(shapes)
    room = max(2, min(_KEPT, _MOST_NUMBERS // max(numbers.size, 1)))
    views: dict[str, Any] = dict(zip(Coupling._fields, parts, strict=False))
    return Coupling(
        numbers=numbers,
        key=np.full(2, -1),
        kept=np.zeros((room, numbers.size)),
        keys=np.full((room, 2), -1),
        used=np.zeros(1, np.int64),
        **views,
    )


@jit
def take_coupling(
    out: Coupling, which: int, h: float, rates: FloatArray, feed: FloatArray, tap: FloatArray, tap_s: FloatArray,
    c: FloatArray, g: FloatArray, home: IntArray, cell: IntArray,
) -> None:  # fmt: skip
    """The coupling number `which` for steps of length h (s), made if it is not kept; with h = 0 no mode is stiff."""
    stiff = 0
    for k in range(rates.size):
        if rates[k] * h > STIFF:
            stiff += 1
    if out.key[0] == which and out.key[1] == stiff:
        return
    out.key[0], out.key[1] = which, stiff
    room = out.keys.shape[0]
    for slot in range(room):
        if out.keys[slot, 0] == which and out.keys[slot, 1] == stiff:
            copy_to(out.numbers, out.kept[slot])
            return
    fill_coupling(out, h, rates, feed, tap, tap_s, c, g, home, cell)
    slot = out.used[0] % room
    out.used[0] += 1
    out.keys[slot, 0], out.keys[slot, 1] = which, stiff
    copy_to(out.kept[slot], out.numbers)


@jit
def fill_coupling(
    out: Coupling, h: float, rates: FloatArray, feed: FloatArray, tap: FloatArray, tap_s: FloatArray, c: FloatArray,
    g: FloatArray, home: IntArray, cell: IntArray,
) -> None:  # fmt: skip
    """Fill in a coupling for steps of length h (s)."""
    n_f, n = tap.shape
    met = np.zeros((n_f, n_f))
    for p in range(n_f):
        for q in range(n_f):
            for k in range(n):
                if not rates[k] * h > STIFF:
                    met[p, q] += tap[p, k] * feed[k, q]
    out.root[:] = 0.0
    leaks = np.zeros((n_f, n_f))
    for a in range(cell.size):
        mine = np.flatnonzero(home == a)
        own, vectors = np.empty((mine.size, mine.size)), np.empty((mine.size, mine.size))
        for p in range(mine.size):
            for q in range(mine.size):
                b, d = mine[p], mine[q]
                own[p, q] = -0.5 * np.sqrt(c[b] * c[d]) * (met[b, d] + met[d, b])
        diagonalise(own, vectors)
        for i in range(mine.size):
            out.answer[mine[i]] = max(own[i, i], 0.0)
            for p in range(mine.size):
                b = mine[p]
                out.root[b, mine[i]] = np.sqrt(c[b]) * vectors[p, i]
                leaks[b, mine[i]] = vectors[p, i] * g[b] / np.sqrt(c[b])
                if b == cell[a]:
                    out.gap[mine[i]] = vectors[p, i] / np.sqrt(c[b])
                    out.leak[mine[i]] = g[b] / c[b]
    for i in range(n_f):
        for e in range(tap_s.shape[1]):
            out.from_slopes[i, e] = 0.0
            out.from_sources[i, e] = 0.0
            for p in range(n_f):
                out.from_slopes[i, e] += out.root[p, i] * tap_s[p, e]
                out.from_sources[i, e] += leaks[p, i] * tap_s[p, e]
        for k in range(n):
            share, leak = 0.0, 0.0
            for p in range(n_f):
                share += out.root[p, i] * tap[p, k]
                leak += leaks[p, i] * tap[p, k]
            is_stiff = rates[k] * h > STIFF
            out.held[i, k] = share
            out.from_stiff[i, k] = share if is_stiff else 0.0
            out.from_rates[i, k] = 0.0 if is_stiff else share
            out.from_modes[i, k] = leak - rates[k] * out.from_rates[i, k]
    for k in range(n):
        for i in range(n_f):
            out.feed[k, i] = 0.0
            for p in range(n_f):
                out.feed[k, i] += feed[k, p] * out.root[p, i]
    for i in range(n_f):
        for j in range(n_f):
            out.cross[i, j] = 0.0
            if home[i] != home[j]:
                for p in range(n_f):
                    for q in range(n_f):
                        out.cross[i, j] += out.root[p, i] * met[p, q] * out.root[q, j]


@jit_rows
def answer_alone(home: IntArray, answer: FloatArray, more: FloatArray, eta: FloatArray, rho: FloatArray) -> None:
    """rho under `local` where no other area answers; `more` (n_area, ROWS) is e."""
    for c in range(answer.size):
        e = more[home[c]]
        for i in range(ROWS):
            rho[c, i] = e[i] * eta[c, i] / (1.0 + e[i] * answer[c])


@jit_rows
def _rate_of_area(
    answer: FloatArray, gap: FloatArray, leak: float, first: int, last: int, u: FloatArray, more: FloatArray,
    slope: FloatArray, rate: FloatArray, chi: FloatArray, known: FloatArray, share: FloatArray, factor: FloatArray,
) -> None:  # fmt: skip
    """A' = known + sum of share_c eta_c over one area's cells first to last; `factor` (ROWS,) falls to 0 at a fold.

    `rate` is what time makes of the area, beside what its gap voltage does.
    """
    for i in range(ROWS):
        factor[i] = 1.0
    for c in range(first, last):
        for i in range(ROWS):
            factor[i] += slope[i] * gap[c] * answer[c] * chi[c, i] / (1.0 + more[i] * answer[c])
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
    """(I - cross d rho / d eta) eta = what does not hang on other areas, into `matrix` (n_f, n_f + 1, ROWS)."""
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
    """Solve the systems (n, n + 1, ROWS) of all rows at once, the solutions in the last column's place.

    Without pivoting: they are a unit matrix and as much again as the areas move. `least` is multiplied by the
    determinant or divided by it; `inverse` (ROWS,) is for passing use.
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
    """eta from the rates of the areas, by what their cells hold, into `mixed` (n_f, n_area, ROWS)."""
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


@jit
def answer_mobile(
    several: bool, answer: FloatArray, gap: FloatArray, leak: FloatArray, cross: FloatArray, home: IntArray,
    first: IntArray, cell: IntArray, u: FloatArray, more: FloatArray, slope: FloatArray, rate: FloatArray,
    chi: FloatArray, eta: FloatArray, rho: FloatArray, known: FloatArray, share: FloatArray, mixed: FloatArray,
    matrix: FloatArray, least: FloatArray,
) -> None:  # fmt: skip
    """rho under `mobile`, with all answers of the areas; `least` (ROWS,) takes the distance to the fold.

    That is the determinant of the capacitances that small changes meet, over that with every area held.
    """
    for i in range(ROWS):
        least[i] = 1.0
    spare = mixed[0, more.shape[0]]
    for a in range(cell.size):
        if cell[a] >= 0:
            c = first[a]
            _rate_of_area(
                answer, gap, leak[c], c, first[a + 1], u[a], more[a], slope[a], rate[a], chi, known[a], share, spare
            )  # fmt: skip
            for i in range(ROWS):
                least[i] *= spare[i]
    if several:
        _fill_matrix(False, home, answer, cross, more, eta, known, share, mixed, matrix)
        _eliminate(matrix, spare, least, True)
        _mix(home, answer, cross, more, chi, mixed)
        _fill_matrix(True, home, answer, cross, more, eta, known, share, mixed, matrix)
        _eliminate(matrix, spare, least, False)
        _take_solution(matrix, eta)
    answer_alone(home, answer, more, eta, rho)
    _add_rates(home, answer, more, chi, eta, known, share, rho)


@jit_rows
def answer_together(
    home: IntArray, answer: FloatArray, cross: FloatArray, more: FloatArray, own: FloatArray, eta: FloatArray,
    rho: FloatArray,
) -> None:  # fmt: skip
    """rho under `local` with the answers of other areas, from an earlier one.

    By sweeps over the areas (Gauss-Seidel), each of which leaves a fraction (A - A0)^2 / A0^2 at most; the iteration of
    the step, which starts each sweep where the last one ended, does the rest. `own` (n_f, ROWS) is for passing use.
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
                # The cells of an area do not answer one another: all of them at once.
                for c in range(n_f):
                    if home[c] == home[b]:
                        e = more[home[c]]
                        for i in range(ROWS):
                            rho[c, i] = e[i] * own[c, i] / (1.0 + e[i] * answer[c])


@jit_rows
def cell_currents(root: FloatArray, rho: FloatArray, j: FloatArray) -> None:
    """The cells' currents beside those at the reference areas, A."""
    for b in range(root.shape[0]):
        for i in range(ROWS):
            j[b, i] = 0.0
        for c in range(root.shape[0]):
            share = root[b, c]
            if share != 0.0:
                for i in range(ROWS):
                    j[b, i] += share * rho[c, i]
