"""How the exponential steps are paced: their lengths, and what happens where the source or the gap voltage turns.

At a zero of the gap voltage a branch of the area ends: zeros are found from the values at the nodes of a step.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from fingerspice.base.arrays import FloatArray
from fingerspice.base.compiled import jit, jit_rows
from fingerspice.engine.collocation.readout import AGAIN, Control, series_of
from fingerspice.engine.one_area.model import Model, choose_branch, dot, gap_voltage, jump_charge, ramp
from fingerspice.numerics.chebyshev import evaluate, summit
from fingerspice.numerics.lobatto import DERIVATIVE, NODES, POINTS

# Ratio of neighbouring step lengths of the ladder, as a power of two: small enough to waste little, large enough for
# lengths to recur, whose tables are kept.
_RUNGS = 16.0
# A step that is to reach a zero of the gap voltage is this much longer, relative to its length.
BEYOND = 1.02
# Largest ratio of a step to the one before, and the part of it that may come from the trend of earlier steps.
_MOST_GROWTH, _MOST_TREND = 8.0, 2.5
# If the error allows a step so many times as long as one that was rejected, the reason of the rejection has passed.
_REFUTED = 1.5
# Largest ratio of the first step after an edge or a zero to the first step after the previous one; the smaller value
# holds if that step was found by rejections.
_MOST_FRESH, _TRIED_FRESH = 2.0, 1.1
# Whether a step is the first after an edge or a zero.
NOT_FRESH, AFTER_EDGE, AFTER_ZERO = range(3)


class Pace(NamedTuple):
    """How steps are chosen."""

    tol: float  # Error of the gap voltage allowed in a step, V
    h_max: float  # Longest step, s
    controlled: bool  # Whether the error governs the step; else every step is `h_max` (for measuring orders)
    charge: bool  # Whether charge and current are wanted


@jit
def nearest_level(q0: FloatArray, q: float) -> int:
    """Reference area nearest to 1/A = q, by ratio."""
    best = 0
    distance = math.inf
    for i in range(q0.size):
        d = max(q0[i] / q, q / q0[i])
        if d < distance:
            distance = d
            best = i
    return best


@jit
def enter(
    model: Model, charge: bool, u_source: float, y: FloatArray, control: Control, sign: FloatArray, branch: FloatArray
) -> bool:  # fmt: skip
    """Take a jump of the source at this time, if there is one, and the branch after it; False if it meets a fold."""
    x_gap = dot(model.gap, y)
    if not model.mobile and u_source != control.u_before and charge:
        moved, error = jump_charge(model, x_gap, control.u_before, u_source)
        y[-1] += moved
        control.error_q += error
    k_u = model.k_gap * u_source
    if model.mobile and sign[0] != 0.0:
        u = ramp(model, k_u, x_gap, control.u_gap)
        side = sign[0] if u == 0.0 else math.copysign(1.0, u)
    else:
        side = choose_branch(model, u_source, y)
        u = gap_voltage(model, k_u, x_gap, side, k_u)
    if u != u:
        return False
    side = side if model.coupled else 1.0
    if side != sign[0]:
        # The length of a new branch is not known yet.
        sign[0], branch[0, 0], branch[0, 1] = side, control.t, math.inf
    control.u_gap = u
    return True


@jit
def turn(s: Any, a: int) -> int:
    """Change the branch of area a at the start of a step, and start again with this step."""
    s.sign[a], s.branch[a, 0], s.branch[a, 1] = -s.sign[a], s.control[0].t, math.inf
    s.step[0].flips += 1
    return AGAIN


@jit
def choose_step(
    pace: Pace, tau: float, is_series: bool, branch: FloatArray, remaining: float, control: Control
) -> float:  # fmt: skip
    """Length of the next step, s: one of the ladder, or exactly to the end of a segment that cannot be continued.

    It aims at the end of the segment or of a branch, if that is as long as the one before it.
    """
    if not pace.controlled:
        return pace.h_max
    h = control.h
    if h == 0.0:
        h = 4.0 * tau
    h = min(h, pace.h_max)
    target = remaining
    for a in range(branch.shape[0]):
        ahead = branch[a, 0] + BEYOND * branch[a, 1] - control.t
        if 0.0 < ahead < target:
            target = ahead
    # `math.ceil` is an integer in compiled code: it would overflow from 1e19 steps on.
    h = target / np.ceil(target / h) if h < target else target
    if is_series:
        # A series must not be evaluated beyond its end: the last step of a segment ends exactly there.
        if h >= remaining * (1.0 - 1e-9):
            return remaining
        h = rung(h)
        return h if h < remaining else remaining
    h = rung(h)
    return h if h <= pace.h_max else rung(0.95 * pace.h_max)


@jit
def allowed_factor(error: float, tol: float) -> float:
    """Ratio of the length that the error of a step allows to the step's own length."""
    if error == 0.0:
        return 6.0
    return 0.9 * (tol / error) ** (1.0 / NODES) if error < math.inf else 0.5


@jit
def accept(h: float, wanted: float, factor: float, tries: int, fresh: int, closed: bool, control: Control) -> None:
    """Choose the length after that of a step, h (s), within its error; `control` is updated.

    `wanted` (s) is the length before a boundary or a zero cut it short, `factor` that of `allowed_factor`, `tries` the
    number of lengths that were tried, and `fresh` whether it is the first after an edge or a zero (NOT_FRESH and so
    on). `closed` is false if the last rejected length was one at which the iteration did not converge: the error of a
    shorter step says nothing about that.
    """
    # A step cut short by a boundary says little about the next one. After a jump the decays die away one by one, and
    # the length allowed grows from step to step as it did.
    growth = h * factor / control.allowed if control.allowed > 0.0 else 1.0
    control.allowed = h * factor
    proposed = h * min(_MOST_GROWTH, max(0.5, factor * min(max(growth, 1.0), _MOST_TREND)))
    proposed = max(proposed, wanted if h < wanted else 0.0)
    if closed and h * factor > _REFUTED * control.too_long:
        control.too_long = 0.0
    if control.too_long > 0.0:
        proposed = min(proposed, 0.93 * control.too_long)
        control.too_long *= growth if growth > 1.5 else 1.03
    if fresh != NOT_FRESH and h >= wanted:
        first = h * min(_MOST_FRESH if tries == 1 else _TRIED_FRESH, factor)
        if fresh == AFTER_EDGE:
            control.h_after_edge = first
        else:
            control.h_after_zero = first
    control.h = proposed


@jit
def shorten(h: float, factor: float, control: Control) -> float:
    """The length to try after a rejected one, which is remembered."""
    control.too_long = h
    control.allowed = 0.0
    shorter: float = rung(h * min(0.9, max(0.25, factor)))
    return shorter


@jit
def rung(h: float) -> float:
    """The shortest step of the ladder that is not shorter than h."""
    out: float = 2.0 ** (math.ceil(_RUNGS * math.log2(h) - 1e-9) / _RUNGS)
    return out


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
        for d in range(NODES):
            series[d] *= -sign
        x, farthest = summit(series, 2.0 * lo - 1.0, 2.0 * hi - 1.0)
        if farthest > tol:
            return float(0.5 * (1.0 + x))
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
