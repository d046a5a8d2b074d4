"""The source between two breakpoints, as numbers."""

from __future__ import annotations

import math
from typing import NamedTuple

from fingerspice.base.arrays import FloatArray
from fingerspice.base.compiled import jit
from fingerspice.numerics import chebyshev


class Segment(NamedTuple):
    """The source between two breakpoints."""

    # start, length: Seconds
    start: float
    length: float
    # (k, 6): c, n, a, omega, phi, beta of c tau^n exp(a tau) cos(phi + omega tau + beta tau^2 / 2), tau from the start
    terms: FloatArray
    series: FloatArray  # (l,): Chebyshev coefficients over the segment, or empty


@jit
def segment_at(edges: FloatArray, t: float) -> int:
    """Index of the last edge that is not after t, or -1."""
    low, high = -1, edges.size
    while high - low > 1:
        middle = (low + high) // 2
        if edges[middle] <= t:
            low = middle
        else:
            high = middle
    return low


@jit
def source(segment: Segment, tau: float) -> tuple[float, float]:
    """Source voltage (V) and its slope (V/s), tau seconds into a segment."""
    u = 0.0
    du = 0.0
    terms = segment.terms
    for i in range(terms.shape[0]):
        value = terms[i, 0]
        if value == 0.0:
            continue
        slope = 0.0
        n = terms[i, 1]
        if n == 1.0:
            slope = value
            value *= tau
        elif n > 1.0:
            slope = value * n * tau ** (n - 1.0)
            value *= tau**n
        a = terms[i, 2]
        if a != 0.0:
            e = math.exp(a * tau)
            slope = (slope + a * value) * e
            value *= e
        omega = terms[i, 3]
        phi = terms[i, 4]
        beta = terms[i, 5]
        if omega != 0.0 or phi != 0.0 or beta != 0.0:
            phase = phi + (omega + 0.5 * beta * tau) * tau
            c = math.cos(phase)
            slope = slope * c - value * (omega + beta * tau) * math.sin(phase)
            value *= c
        u += value
        du += slope
    if segment.series.size > 0:
        value, slope = chebyshev.evaluate(segment.series, 2.0 * tau / segment.length - 1.0)
        u += value
        du += slope * 2.0 / segment.length
    return u, du
