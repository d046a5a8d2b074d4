"""Chebyshev interpolation on an interval, its compiled evaluation, and the largest values of polynomials."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import numpy as np

from fingerspice.base.arrays import FloatArray
from fingerspice.base.compiled import borrow, jit, jit_rows
from fingerspice.numerics.lobatto import NODES, POINTS, TO_SERIES


def nodes(n: int, lo: float, hi: float) -> FloatArray:
    """Chebyshev points of the first kind on [lo, hi], ascending, shape (n,)."""
    return 0.5 * (lo + hi) + 0.5 * (hi - lo) * _nodes(n)


@lru_cache(maxsize=32)
def _nodes(n: int) -> FloatArray:
    return np.asarray(np.cos((np.arange(n)[::-1] + 0.5) * np.pi / n))


def coefficients(values: FloatArray) -> FloatArray:
    """Chebyshev coefficients of the interpolant through `values` at `nodes`, along axis 0."""
    n = values.shape[0]
    return _transform(n) @ values


@lru_cache(maxsize=32)
def _transform(n: int) -> FloatArray:
    # Parts of a turn, of which there are 4 n: the cosine of a large angle has fewer digits.
    parts = np.outer(np.arange(n), 2 * np.arange(n)[::-1] + 1) % (4 * n)
    matrix: FloatArray = np.cos(parts * (0.5 * np.pi / n)) * (2.0 / n)
    matrix[0] *= 0.5
    return matrix


def fit(
    function: Callable[[FloatArray], FloatArray], lo: float, hi: float, tol: float, sizes: tuple[int, ...]
) -> FloatArray | None:
    """Coefficients of the shortest interpolant on [lo, hi], of the given sizes (ascending), whose tail is below `tol`.

    This bounds the last two coefficients relative to the largest one. None where no size met it.
    """
    for size in sizes:
        c = coefficients(function(nodes(size, lo, hi)))
        magnitude = np.abs(c)
        least = tol * float(magnitude.max())
        if least < np.inf and magnitude[-2] <= least and magnitude[-1] <= least:
            # Below twice that the function's own rounding stands, not the series.
            keep = np.flatnonzero(magnitude > 2.0 * least)
            return c[: (keep[-1] + 1 if keep.size else 1)]
    return None


@jit
def evaluate(c: FloatArray, x: float) -> tuple[float, float]:
    """Value and derivative at x in [-1, 1] of the series with coefficients c (Clenshaw)."""
    value, slope, _ = _value_slope_bend(c, x)
    return value, slope


_BLOCK = 256
# Largest sum of the powers' coefficients over that of the series' own: their rounding is so much larger.
_LARGEST_GROWTH = 16.0


@jit
def to_powers(c: FloatArray, powers: FloatArray) -> bool:
    """Coefficients of 1, x, x^2, ... of a series into `powers` (c.size,); False where too many digits would cancel.

    A series that falls faster than by 1 + sqrt 2 from term to term loses none, and its powers take half the work.
    """
    n = c.size
    # T_k from T_(k-1) and T_(k-2), as rows of powers.
    before = np.zeros(n)
    now = np.zeros(n)
    now[0] = 1.0
    for k in range(n):
        powers[k] = 0.0
    size = 0.0
    for k in range(n):
        for j in range(k + 1):
            powers[j] += c[k] * now[j]
        size += abs(c[k])
        twice = 1.0 if k == 0 else 2.0
        for j in range(min(k + 1, n - 1), -1, -1):
            above = -before[j]
            before[j] = now[j]
            now[j] = above + (twice * now[j - 1] if j > 0 else 0.0)
    # The shift above went from the top down, so that `now[j - 1]` was still the row before.
    total = 0.0
    for j in range(n):
        total += abs(powers[j])
    return total <= _LARGEST_GROWTH * size


@jit_rows
def evaluate_array(c: FloatArray, x: FloatArray, lo: float, scale: float, out: FloatArray) -> None:
    """The series at (|x| - lo) scale - 1 into `out`, both of shape (n,); several at once in a processor's vector."""
    x, out, powers, room = borrow(x), borrow(out), np.empty(c.size), np.zeros((4, _BLOCK))
    as_powers, at, value = to_powers(c, powers), room[0], room[1]
    for first in range(0, x.size, _BLOCK):
        count = min(_BLOCK, x.size - first)
        # Views: an index with a sum in it keeps a loop from becoming vectors.
        here, there = x[first : first + count], out[first : first + count]
        for i in range(count):
            at[i] = (abs(here[i]) - lo) * scale - 1.0
        if as_powers:
            _horner(powers, at, value)
        else:
            _clenshaw(c, at, room[2], room[3], value)
        for i in range(count):
            there[i] = value[i]


@jit_rows
def _horner(c: FloatArray, at: FloatArray, value: FloatArray) -> None:
    """The powers at a block of places."""
    k = c.size - 1
    for i in range(_BLOCK):
        value[i] = c[k]
    # Eight steps for each pass through memory.
    while k >= 8:
        c0, c1, c2, c3 = c[k - 1], c[k - 2], c[k - 3], c[k - 4]
        c4, c5, c6, c7 = c[k - 5], c[k - 6], c[k - 7], c[k - 8]
        for i in range(_BLOCK):
            step = at[i]
            half = (((value[i] * step + c0) * step + c1) * step + c2) * step + c3
            value[i] = (((half * step + c4) * step + c5) * step + c6) * step + c7
        k -= 8
    while k > 0:
        k -= 1
        c0 = c[k]
        for i in range(_BLOCK):
            value[i] = value[i] * at[i] + c0


@jit_rows
def _clenshaw(c: FloatArray, at: FloatArray, b1: FloatArray, b2: FloatArray, value: FloatArray) -> None:
    """The series at a block of places; `b1` and `b2` are scratch."""
    for i in range(_BLOCK):
        b1[i] = 0.0
        b2[i] = 0.0
    k = c.size - 1
    # Four steps of Clenshaw's recurrence for each pass through memory.
    while k >= 4:
        c0, c1, c2, c3 = c[k], c[k - 1], c[k - 2], c[k - 3]
        for i in range(_BLOCK):
            step = 2.0 * at[i]
            older = step * b1[i] + (c0 - b2[i])
            newer = step * older + (c1 - b1[i])
            older = step * newer + (c2 - older)
            b1[i] = step * older + (c3 - newer)
            b2[i] = older
        k -= 4
    for last in range(k, 0, -1):
        c0 = c[last]
        for i in range(_BLOCK):
            newer = 2.0 * at[i] * b1[i] + (c0 - b2[i])
            b2[i] = b1[i]
            b1[i] = newer
    for i in range(_BLOCK):
        value[i] = c[0] + at[i] * b1[i] - b2[i]


@jit
def largest(values: FloatArray, sign: float) -> tuple[int, float, float]:
    """Panel, place in it (0 to 1) and value of the largest of sign times the polynomials through `values` (p, NODES).

    With the sign -1 it is the smallest value, times -1.
    """
    panel, place, best = 0, 0.0, -np.inf
    series = np.zeros(NODES)
    for p in range(values.shape[0]):
        j = 0
        for i in range(1, NODES):
            if sign * values[p, i] > sign * values[p, j]:
                j = i
        here = sign * values[p, j]
        if here > best:
            panel, place, best = p, POINTS[j], here
        # A smooth signal rises over its largest node by less than it falls to both neighbours, and over one at the end
        # by less than it falls to the second node from there: the first may lie as high on the other side of a summit.
        if j == 0:
            hidden = here - sign * values[p, 2]
        elif j == NODES - 1:
            hidden = here - sign * values[p, NODES - 3]
        else:
            hidden = 2.0 * here - sign * (values[p, j - 1] + values[p, j + 1])
        if here + hidden <= best:
            continue
        for d in range(NODES):
            series[d] = 0.0
            for i in range(NODES):
                series[d] += TO_SERIES[i, d] * sign * values[p, i]
        x, top = summit(series, 2.0 * POINTS[max(j - 1, 0)] - 1.0, 2.0 * POINTS[min(j + 1, NODES - 1)] - 1.0)
        if top > best:
            panel, place, best = p, 0.5 * (1.0 + x), top
    return panel, place, best


@jit
def summit(series: FloatArray, lo: float, hi: float) -> tuple[float, float]:
    """Where in [lo, hi] a Chebyshev series is largest, and its value there: by Newton in a bracket of its slope."""
    x = 0.5 * (lo + hi)
    value = 0.0
    for _ in range(60):
        value, slope, bend = _value_slope_bend(series, x)
        if slope > 0.0:
            lo = x
        else:
            hi = x
        new = x - slope / bend if bend < 0.0 else 0.5 * (lo + hi)
        if not lo < new < hi:
            new = 0.5 * (lo + hi)
        if abs(new - x) <= 1e-12:
            break
        x = new
    return x, value


@jit
def _value_slope_bend(c: FloatArray, x: float) -> tuple[float, float, float]:
    """The series with coefficients c at x in [-1, 1] with its first two derivatives (Clenshaw)."""
    b1, b2, d1, d2, e1, e2 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(c.size - 1, 0, -1):
        e1, e2 = 4.0 * d1 + 2.0 * x * e1 - e2, e1
        d1, d2 = 2.0 * b1 + 2.0 * x * d1 - d2, d1
        b1, b2 = c[k] + 2.0 * x * b1 - b2, b1
    return c[0] + x * b1 - b2, b1 + x * d1 - d2, 2.0 * d1 + x * e1 - e2
