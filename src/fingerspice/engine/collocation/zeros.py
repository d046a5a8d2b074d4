"""Zeros of the gap voltage in a step, at which its branch of the area ends, from its values at the nodes."""

from __future__ import annotations

from fingerspice.base.arrays import FloatArray
from fingerspice.base.compiled import jit, jit_rows
from fingerspice.engine.collocation.readout import series_of
from fingerspice.numerics.chebyshev import evaluate
from fingerspice.numerics.lobatto import DERIVATIVE, NODES, POINTS


@jit_rows
def slope_at(u: FloatArray, j: int) -> float:
    """Slope at node j of the polynomial through values at the nodes, per step."""
    slope = 0.0
    for i in range(NODES):
        slope += DERIVATIVE[j, i] * u[i]
    return slope


@jit
def dip(u: FloatArray, sign: float, tol: float, wrong: int, series: FloatArray) -> float:
    """Fraction of the step at which the gap voltage is farthest off its branch between two nodes on it, or 0.

    Only nodes before node `wrong` are considered, unless that is 0; deviations up to `tol` (V) are ignored.
    """
    last = wrong if wrong > 0 else NODES
    for j in range(last):
        here = sign * u[j]
        before = sign * u[j - 1] - here if j > 0 else 0.0
        after = sign * u[j + 1] - here if j + 1 < last else 0.0
        # A parabola through three nodes falls below the lowest node by less than the sum of the differences.
        if before < 0.0 or after < 0.0 or here > before + after or (j + 1 == last and wrong > 0):
            continue
        lo = POINTS[max(j - 1, 0)]
        hi = POINTS[min(j + 1, NODES - 1)]
        if not (sign * slope_at(u, max(j - 1, 0)) < 0.0 < sign * slope_at(u, min(j + 1, NODES - 1))):
            continue
        series_of(u, series)
        for _ in range(40):
            mid = 0.5 * (lo + hi)
            _, slope = evaluate(series, 2.0 * mid - 1.0)
            if sign * slope < 0.0:
                lo = mid
            else:
                hi = mid
        lowest, _ = evaluate(series, lo + hi - 1.0)
        if sign * lowest < -tol:
            return float(0.5 * (lo + hi))
    return 0.0


@jit
def _inverted(lo: float, hi: float, at_lo: float, at_hi: float, slope_lo: float, slope_hi: float) -> float:
    """Where a function is about zero, from its values at both ends of an interval, of different sign, and its slopes.

    Hermite's cubic through the inverse function; by the secant where a slope has the wrong sign.
    """
    rise = at_hi - at_lo
    part = -at_lo / rise
    secant = lo + (hi - lo) * part
    if not (slope_lo * rise > 0.0 and slope_hi * rise > 0.0):
        return secant
    left, right = rise / slope_lo - (hi - lo), rise / slope_hi - (hi - lo)
    found = secant + part * (1.0 - part) * (left * (1.0 - part) - right * part)
    return found if lo < found < hi else secant


@jit
def zero(u: FloatArray, sign: float, last: int, below: float, series: FloatArray) -> float:
    """Fraction of the step at which the gap voltage leaves its branch.

    Between nodes `last` - 1 and `last`, or, where `below` is not 0, before that fraction of the step and after the last
    node before it.
    """
    if below > 0.0:
        last = 1
        while POINTS[last] < below:
            last += 1
    lo: float = POINTS[last - 1]
    hi: float = POINTS[last] if below == 0.0 else below
    if not sign * u[last - 1] > 0.0:
        return lo
    theta: float = 0.5 * (lo + hi)
    if below == 0.0:
        theta = _inverted(lo, hi, u[last - 1], u[last], slope_at(u, last - 1), slope_at(u, last))
    series_of(u, series)
    # Newton's method in a shrinking bracket. Each move is about the last one squared: it ends where the next one would
    # be below rounding.
    before = hi - lo
    for _ in range(60):
        value, slope = evaluate(series, 2.0 * theta - 1.0)
        if sign * value > 0.0:
            lo = theta
        else:
            hi = theta
        new = theta - 0.5 * value / slope if slope != 0.0 else lo
        if not lo <= new <= hi:
            new = 0.5 * (lo + hi)
            if not lo < new < hi:
                break
        moved = abs(new - theta)
        theta = new
        if moved * (moved / before) ** 2 <= 1e-16 or hi - lo <= 4e-16:
            break
        before = moved
    return theta


@jit
def leaves(u: FloatArray, sign: float, tol: float, series: FloatArray) -> float:
    """Fraction of the step at which the gap voltage leaves its branch, or 2; `tol` (V) as in `first_wrong`."""
    wrong = first_wrong(u, sign, tol)
    below = dip(u, sign, 0.01 * tol, wrong, series)
    return zero(u, sign, wrong, below, series) if wrong > 0 or below > 0.0 else 2.0


@jit_rows
def farthest_off(u: FloatArray, sign: float, theta: float) -> float:
    """How far the gap voltage is off its branch at the nodes up to fraction `theta` of the step at most, V."""
    off: float = 0.0
    for j in range(NODES):
        off = max(off, -sign * u[j] if POINTS[j] <= theta else 0.0)
    return off


@jit
def first_wrong(u: FloatArray, sign: float, tol: float) -> int:
    """First node past the start at which the gap voltage is off its branch, or 0.

    A voltage that stays below the error allowed, `tol` (V), may be rounding errors alone, whose zeros mean nothing.
    """
    first = 0
    largest = 0.0
    for j in range(NODES - 1, 0, -1):
        largest = max(largest, abs(u[j]))
        if sign * u[j] < 0.0:
            first = j
    return first if largest > tol else 0
