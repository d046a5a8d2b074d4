"""Largest values of polynomials that are known at Gauss-Lobatto nodes, panel by panel."""

from __future__ import annotations

import numpy as np

from fingerspice.base.arrays import FloatArray
from fingerspice.base.compiled import jit
from fingerspice.numerics.lobatto import NODES, POINTS, TO_SERIES


@jit
def largest(values: FloatArray, sign: float) -> tuple[int, float, float]:
    """Panel, place in it (0 to 1) and value of the largest of sign times the polynomials.

    Parameters
    ----------
    values : ndarray, shape (p, NODES)
        At the nodes of each panel.
    sign : float
        -1 for the smallest value, which is returned times -1.
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
        x, top = _summit(series, 2.0 * POINTS[max(j - 1, 0)] - 1.0, 2.0 * POINTS[min(j + 1, NODES - 1)] - 1.0)
        if top > best:
            panel, place, best = p, 0.5 * (1.0 + x), top
    return panel, place, best


@jit
def _summit(series: FloatArray, lo: float, hi: float) -> tuple[float, float]:
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
def _value_slope_bend(series: FloatArray, x: float) -> tuple[float, float, float]:
    """A Chebyshev series at x in [-1, 1] with its first two derivatives (Clenshaw)."""
    b1, b2, d1, d2, e1, e2 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(NODES - 1, 0, -1):
        e1, e2 = 4.0 * d1 + 2.0 * x * e1 - e2, e1
        d1, d2 = 2.0 * b1 + 2.0 * x * d1 - d2, d1
        b1, b2 = 2.0 * x * b1 - b2 + series[k], b1
    return x * b1 - b2 + series[0], b1 + x * d1 - d2, 2.0 * d1 + x * e1 - e2
