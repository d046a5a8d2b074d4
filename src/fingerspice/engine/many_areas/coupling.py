"""Currents of a network's cells beside those at the reference areas, which add to the modes' rates at all rows.

In the notation of `fingerspice.engine.many_areas.form`, each cell b whose area moves carries the current

    j_b = e (c_b u_b' + g_b u_b)  [mobile: + c_b u_b A'],    e = A - A0,

beside the current at the reference area. These currents in turn drive the cells' voltages: u' = u0' + M j, where u0' is
the rate without j, and M = tap feed is symmetric and negative. For one area at a time let C^1/2 M C^1/2 = -V L V', with
the cells' capacitances C and the eigenvectors V, and

    eta = V' (C^1/2 u0' + C^-1/2 G u),    chi = V' C^1/2 u.

Then the equations of an area's cells are independent of one another,

    j = C^1/2 V rho,    rho_i = (e eta_i + [mobile: chi_i A']) / (1 + e L_i):

one division for each, and linear maps of the modes before and after. Cells of different areas stay coupled by the
blocks of M between them, `cross`. Under `mobile` A' = (dA/du) u' of the gap's own cell closes one scalar equation for
each area; the fold is where its factor, or for several areas the determinant, falls to 0.

The rate of a mode that is much faster than the step is the slope of its interpolation polynomial, which contains the
effect of j already: such modes count in u0' and not in M.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from fingerspice.base.arrays import FloatArray, IntArray, views_of
from fingerspice.base.compiled import jit, jit_rows
from fingerspice.numerics.lobatto import ROWS
from fingerspice.numerics.modes import copy_to, diagonalise

# From this ratio of step length to time constant on, a mode's rate is the slope of its polynomial: -rate w + gain s +
# feed j would be a small difference of large numbers, and j would pass its rounding on to every other mode.
STIFF = 300.0
# Most couplings that are kept for reuse, and most numbers in all of them (two are kept whatever their size).
_KEPT, _MOST_NUMBERS = 16, 65_536


class Coupling(NamedTuple):
    """Maps to and from eta, chi and rho of the module; n_f cells in their areas' bases, n modes, n_s sources."""

    answer: FloatArray  # (n_f,): L, 1/m^2
    root: FloatArray  # (n_f, n_f): C^1/2 V: currents of the cells from rho
    # from_modes, from_rates, from_stiff, held (n_f, n): eta from the modes, from their forcing, and from the rates of
    # the stiff ones; chi from the modes
    from_modes: FloatArray
    from_rates: FloatArray
    from_stiff: FloatArray
    held: FloatArray
    # from_sources, from_slopes (n_f, n_s): eta from the sources and from their slopes; `from_slopes` also maps the
    # sources to chi
    from_sources: FloatArray
    from_slopes: FloatArray
    feed: FloatArray  # (n, n_f): Rates of the modes from rho
    # gap, leak (n_f,): The voltage u that the area follows has the rate sum of gap (eta - L chi A') / (1 + e L), less
    # leak u
    gap: FloatArray
    leak: FloatArray
    cross: FloatArray  # (n_f, n_f): eta from rho of other areas
    numbers: FloatArray  # (size,): Memory of all arrays above, which are views of it
    # (2,): Number of this coupling as the caller counts them, and number of stiff modes (the fastest ones); -1: not
    # filled
    key: IntArray
    # kept, keys (room, size): Cache: `numbers` and `key` of couplings filled in before; a new one overwrites the oldest
    kept: FloatArray
    keys: IntArray
    used: IntArray  # (1,): How many couplings have been put into the cache


def new_coupling(n: int, cells: int, sources: int) -> Coupling:
    """A coupling with an empty cache, not filled in yet."""
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
def take_coupling(out: Coupling, which: int, h: float, form: Any) -> None:
    """Set `out` to coupling `which` for steps of length h (s), from the cache or anew; with h = 0 no mode is stiff."""
    stiff = 0
    for k in range(form.rates.size):
        if form.rates[k] * h > STIFF:
            stiff += 1
    if out.key[0] == which and out.key[1] == stiff:
        return
    out.key[0], out.key[1] = which, stiff
    room = out.keys.shape[0]
    for slot in range(room):
        if out.keys[slot, 0] == which and out.keys[slot, 1] == stiff:
            copy_to(out.numbers, out.kept[slot])
            return
    _fill_coupling(out, h, form)
    slot = out.used[0] % room
    out.used[0] += 1
    out.keys[slot, 0], out.keys[slot, 1] = which, stiff
    copy_to(out.kept[slot], out.numbers)


@jit
def _fill_coupling(out: Coupling, h: float, form: Any) -> None:
    """Compute the coupling for steps of length h (s), with the eigenvectors of each area's cells."""
    rates, feed, tap, tap_s, c, g = form.rates, form.feed, form.tap, form.tap_s, form.c, form.g
    home, cell = form.home, form.cell
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
def distance_of_area(
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
def rate_of_area(
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
def fill_matrix(
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
def eliminate(matrix: FloatArray, inverse: FloatArray, least: FloatArray, divide: bool) -> None:
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
def mix(
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
def add_rates(
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


@jit_rows
def answer_together(
    home: IntArray, answer: FloatArray, cross: FloatArray, more: FloatArray, share: FloatArray, eta: FloatArray,
    rho: FloatArray,
) -> None:  # fmt: skip
    """rho under `local` where the areas are coupled, improved from its last value by Gauss-Seidel sweeps.

    A sweep reduces the error to at most the fraction (A - A0)^2 / A0^2 of it. The step's own iteration, whose every
    evaluation goes on from the last rho, reduces it further. `share` (n_f, ROWS) is scratch.
    """
    n_f = answer.size
    for b in range(n_f):
        e, own = more[home[b]], answer[b]
        for i in range(ROWS):
            share[b, i] = e[i] / (1.0 + e[i] * own)
    for _ in range(_SWEEPS):
        for b in range(n_f):
            for i in range(ROWS):
                rho[b, i] = eta[b, i]
            # Only the cells of other areas count.
            for c in range(n_f):
                x = cross[b, c]
                if x != 0.0:
                    for i in range(ROWS):
                        rho[b, i] += x * rho[c, i]
            for i in range(ROWS):
                rho[b, i] *= share[b, i]
