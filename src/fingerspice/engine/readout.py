"""Quantities computed from a finished step: zeros of the gap voltage, state and error inside it, outputs, peaks."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fingerspice.base.arrays import FloatArray
from fingerspice.base.compiled import jit, jit_fused, jit_rows
from fingerspice.numerics.lobatto import BARYCENTRIC, DERIVATIVE, FIRST, NODES, POINTS, ROWS, SECOND, THIRD, TO_SERIES

# Entries of `control`.
T, H, SIGN, U_BEFORE, U_GAP = 0, 1, 2, 3, 4
BRANCH_START, BRANCH_LENGTH, PEAK_U, PEAK_F, ERROR_U, ERROR_F = 5, 6, 7, 8, 9, 10
# A step length that was rejected recently, s.
TOO_LONG = 11
# The first step taken after an edge of the source, s.
H_AFTER_EDGE = 12
# Largest change of the gap voltage for a change of 1 V of a state voltage.
MAGNIFIED = 13
# Error of the charge: the largest so far (C), the sum with known signs (C), and the sum of squares of the others (C^2).
ERROR_Q, COLLECTED, SPREAD = 14, 15, 16
# 1/A where the last step ended, 1/m^2.
LAST_Q = 17
# Length that the last step's error would have allowed, s; 0 if it says nothing about the next step.
ALLOWED = 18
# The first step taken after a zero of the gap voltage, s; 0 before the first.
H_AFTER_ZERO = 19
# Smallest distance to the fold so far.
MARGIN = 20
# Largest charge so far, C.
PEAK_Q = 21
# Largest error of a node's voltage, V.
ERROR_V = 22
N_CONTROL = 23
# Entries of `counters`: rows evaluated, steps accepted and rejected, zeros, outputs written, steps kept, recorded.
NFEV, ACCEPTED, REJECTED, ZEROS, OUTPUT, KEPT, RECORDED = 0, 1, 2, 3, 4, 5, 6
N_COUNTERS = 7
# Number of last steps tried that are kept, as rows: start and length (s), error over the one allowed, number.
TRIED = 8
# Most steps, accepted and rejected, in a window of the source, which has a few thousand periods at most. A run that
# needs more has a problem that smaller steps do not solve.
MOST_STEPS = 200_000
# Most evaluations at all rows since an edge of the source: a first allowance, and one more for each longest step that
# fits into the time since. A fast mode that the area affects may let only short steps converge, and another method is
# faster there.
FIRST_PASSES, MOST_PASSES = 20_000, 2_000
# Outputs are evaluated in groups as wide as the processor's vectors, and searched in strides.
WRITTEN_AT_ONCE = _GROUP = 8
_STRIDE = 32


class Steps(NamedTuple):
    """Takes every step, so that figures of the run do not depend on its outputs.

    Attributes
    ----------
    times : ndarray, shape (capacity, 4)
        Start and length (s), the end reached (s), and which fraction of the length that is: a step may be shorter than
        the rounding of the time. No capacity: nothing is recorded.
    values : ndarray, shape (capacity, n_column, NODES)
        Recorded voltages, or the state of a network, at the nodes of the whole length.
    paused : ndarray, shape (6,)
        State of a loop that stopped because all places are taken; its first entry is 1 then, else 0.
    """

    times: FloatArray
    values: FloatArray
    paused: FloatArray


def new_steps(capacity: int, columns: int) -> Steps:
    """Room for so many steps."""
    return Steps(np.empty((capacity, 4)), np.empty((capacity, columns, NODES)), np.zeros(6))


@jit
def record(
    times: FloatArray, recorded: FloatArray, place: int, t: float, h: float, t_new: float, theta: float,
    values: FloatArray,
) -> None:  # fmt: skip
    """Put a step in its place."""
    times[place, 0], times[place, 1], times[place, 2], times[place, 3] = t, h, t_new, theta
    for c in range(recorded.shape[1]):
        for j in range(NODES):
            recorded[place, c, j] = values[c, j]


@jit
def note(tried: FloatArray, number: int, t: float, h: float, error: float) -> None:
    """Keep a step tried, its error over the one allowed, in place of the oldest."""
    place = number % tried.shape[0]
    tried[place, 0] = t
    tried[place, 1] = h
    tried[place, 2] = error
    tried[place, 3] = number + 1


@jit_rows
def series_of(values: FloatArray, out: FloatArray) -> None:
    """Chebyshev coefficients (ROWS,) of the polynomial through values at the nodes."""
    for d in range(ROWS):
        total = 0.0
        for j in range(NODES):
            total += TO_SERIES[j, d] * values[j]
        out[d] = total


@jit_fused
def _value_and_slope(series: FloatArray, x: float) -> tuple[float, float]:
    """Value and derivative of a Chebyshev series at x in [-1, 1] (Clenshaw)."""
    b1 = 0.0
    b2 = 0.0
    d1 = 0.0
    d2 = 0.0
    for d in range(NODES - 1, 0, -1):
        d0 = 2.0 * (b1 + x * d1) - d2
        b0 = 2.0 * x * b1 + (series[d] - b2)
        d2 = d1
        d1 = d0
        b2 = b1
        b1 = b0
    return x * b1 + (series[0] - b2), b1 + x * d1 - d2


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
            _, slope = _value_and_slope(series, 2.0 * mid - 1.0)
            if sign * slope < 0.0:
                lo = mid
            else:
                hi = mid
        lowest, _ = _value_and_slope(series, lo + hi - 1.0)
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
        value, slope = _value_and_slope(series, 2.0 * theta - 1.0)
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


@jit
def basis_at(theta: float, basis: FloatArray) -> None:
    """Basis polynomials at fraction `theta` of the step, into `basis` (NODES,): values there are basis @ values."""
    total = 0.0
    for j in range(NODES - 1, -1, -1):
        distance = theta - POINTS[j]
        if distance == 0.0:
            basis[:] = 0.0
            basis[j] = 1.0
            return
        basis[j] = BARYCENTRIC[j] / distance
        total += basis[j]
    for j in range(NODES):
        basis[j] /= total


@jit_rows
def at(values: FloatArray, basis: FloatArray) -> float:
    """The polynomial through values at the nodes, where `basis` belongs to (see `basis_at`)."""
    total = 0.0
    for j in range(NODES):
        total += basis[j] * values[j]
    return total


@jit
def error_at(places: FloatArray, theta: float, error: FloatArray) -> None:
    """Error of the modes at the end of a step that is cut short, interpolated between the places where it is known."""
    p = 0
    left = 0.0
    right = POINTS[FIRST]
    if theta > POINTS[THIRD]:
        p = 3
        left = POINTS[THIRD]
        right = 1.0
    elif theta > POINTS[SECOND]:
        p = 2
        left = POINTS[SECOND]
        right = POINTS[THIRD]
    elif theta > POINTS[FIRST]:
        p = 1
        left = POINTS[FIRST]
        right = POINTS[SECOND]
    share = (theta - left) / (right - left)
    for k in range(places.shape[0]):
        error[k] = (1.0 - share) * places[k, p] + share * places[k, p + 1]


@jit_rows
def layers(
    mobile: bool, area0: float, k_shown: FloatArray, shown: FloatArray, w: FloatArray, source: FloatArray,
    q: FloatArray, values: FloatArray,
) -> None:  # fmt: skip
    """Recorded voltages at all rows."""
    for i in range(shown.shape[0]):
        for j in range(ROWS):
            values[i, j] = 0.0
        for k in range(w.shape[0]):
            share = shown[i, k]
            for j in range(ROWS):
                values[i, j] += share * w[k, j]
        if mobile:
            for j in range(ROWS):
                values[i, j] *= area0 * q[j]
        share = k_shown[i]
        for j in range(ROWS):
            values[i, j] += share * source[j]


@jit_rows
def _series_at(
    series: FloatArray, t_out: FloatArray, t: float, scale: float, top: float, groups: int, out: FloatArray
) -> None:
    """The series at whole groups of times, so that all round alike: the inner loop is unrolled, the outer a vector."""
    for i in range(_GROUP * groups):
        x = min(max((t_out[i] - t) * scale - 1.0, -1.0), top)
        twice = 2.0 * x
        b1 = 0.0
        b2 = 0.0
        for d in range(NODES - 1, 0, -1):
            b0 = twice * b1 + (series[d] - b2)
            b2 = b1
            b1 = b0
        out[i] = series[0] + x * b1 - b2


@jit_rows
def _powers_at(
    powers: FloatArray, t_out: FloatArray, t: float, scale: float, top: float, groups: int, out: FloatArray
) -> None:
    """As `_series_at`, from the coefficients of 1, x, x^2, ...: half the work."""
    for i in range(_GROUP * groups):
        x = min(max((t_out[i] - t) * scale - 1.0, -1.0), top)
        value = powers[NODES - 1]
        for d in range(NODES - 2, -1, -1):
            value = value * x + powers[d]
        out[i] = value


@jit
def _outputs_within(first: int, guess: int, low: float, high: float, t_out: FloatArray, left: NDArray[np.bool_]) -> int:
    """Number of outputs from number `first` on that lie in a step, known to be between `low` and `high`."""
    after = first + guess
    if guess > 0 and after <= t_out.size and t_out[after - 1] < low and (after == t_out.size or t_out[after] > high):
        return guess
    at = first
    while at + _STRIDE <= t_out.size and t_out[at + _STRIDE - 1] < low:
        at += _STRIDE
    while at < t_out.size and (t_out[at] < low or (t_out[at] <= high and left[at])):
        at += 1
    return at - first


@jit
def write_outputs(
    t: float, h: float, reached: float, t_new: float, slack: float, powers: bool, series: FloatArray, work: FloatArray,
    first: int, guess: int, t_out: FloatArray, left: NDArray[np.bool_], out: FloatArray,
) -> int:  # fmt: skip
    """Outputs of one step from number `first` on: right-hand ones in [t, t_new), left-hand ones in (t, t_new].

    With `powers` the series holds the coefficients of 1, x, x^2, ... instead. Times within `slack` of t_new are t_new;
    `guess` is the expected number. Places after the last output are overwritten: they belong to later steps.
    `work` has shape (2, WRITTEN_AT_ONCE). Returns how many there were.
    """
    count = _outputs_within(first, guess, t_new - slack, t_new + slack, t_out, left)
    groups = (count + _GROUP - 1) // _GROUP
    scale = 2.0 / h
    top = 2.0 * reached - 1.0
    # The last group of a run may be too wide for the array: it is written through `work`.
    whole = groups if first + _GROUP * groups <= t_out.size else groups - 1
    rest = first + _GROUP * whole
    for column in range(out.shape[0]):
        if powers:
            _powers_at(series[column], t_out[first:], t, scale, top, whole, out[column, first:])
        else:
            _series_at(series[column], t_out[first:], t, scale, top, whole, out[column, first:])
        if whole < groups:
            for i in range(_GROUP):
                work[0, i] = t_out[min(rest + i, t_out.size - 1)]
            if powers:
                _powers_at(series[column], work[0], t, scale, top, 1, work[1])
            else:
                _series_at(series[column], work[0], t, scale, top, 1, work[1])
            for i in range(t_out.size - rest):
                out[column, rest + i] = work[1, i]
    return count


@jit_rows
def account(
    mobile: bool, area0: float, stress: float, u: FloatArray, q: FloatArray, x_gap: FloatArray, dq: FloatArray,
    theta: float, run_error: float, control: FloatArray,
) -> None:  # fmt: skip
    """Peaks of gap voltage and force, their largest errors and the distance to the fold in the part that counts."""
    if mobile:
        margin = control[MARGIN]
        for j in range(NODES):
            if POINTS[j] <= theta:
                margin = min(margin, 1.0 - area0 * x_gap[j] * dq[j])
        control[MARGIN] = margin
    peak_u = control[PEAK_U]
    peak_f = control[PEAK_F]
    steepest = 0.0
    for j in range(NODES):
        if POINTS[j] <= theta:
            size = abs(u[j])
            pressure = stress * size / q[j]
            peak_u = max(peak_u, size)
            peak_f = max(peak_f, pressure * size)
            # F ~ u^2 A: an error du changes F by at most 2 F du / u, because the area falls with |u|.
            steepest = max(steepest, 2.0 * pressure)
    control[PEAK_U] = peak_u
    control[PEAK_F] = peak_f
    control[ERROR_U] = max(control[ERROR_U], run_error)
    control[ERROR_F] = max(control[ERROR_F], run_error * steepest)
