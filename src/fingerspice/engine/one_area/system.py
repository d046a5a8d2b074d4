"""A stack in modal form around reference areas, for the exponential steps.

With q = 1/A near a reference q0, every stack is a linear system with one nonlinear term:

    w' = -rates w + gain U + (q - q0) feed (tap w + tap_k U)                          local
    w' = -rates w + gain U / (A0 q0) + (1/q - 1/q0) push U / A0 + (q - q0) feed tap w   mobile

where tap w + tap_k U are the voltages of the cells whose leak does not scale with the area: few, however many modes.

u_gap = k_gap U + gap w under `local`, and k_gap U + A0 q gap w under `mobile`. The linear part is solved exactly;
the iteration is on the terms of the area alone.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fingerspice.base.arrays import FloatArray
from fingerspice.base.compiled import jit
from fingerspice.engine.one_area.model import Model
from fingerspice.numerics.chebyshev import evaluate, fit, to_powers
from fingerspice.numerics.modes import modes
from fingerspice.physics.contact import N_PACKED, ridge_area, ridge_area_array

DEGREE = 27
"""Degree of the polynomial for 1/A; if it is not exact enough, a longer Chebyshev series is used."""
# Lengths of the longer series, and its error by rounding. It is made as exact as that for every tolerance: some
# circuits magnify an error of the area a thousandfold, and terms cost little.
_LONG_SIZES, _LONG_ROUNDING = (48, 64, 96, 128, 160), 9e-13
# Ratio of neighbouring reference values of 1/A: the nonlinear term is at most an eighth of the linear leak.
LEVEL_RATIO = 1.28


# Error of the polynomial over the error asked for, and the smallest error asked of it: below rounding the long series
# would replace it without any visible effect.
_AREA_SHARE, _AREA_ROUNDING = 1e-3, 2e-14


class System(NamedTuple):
    """See the module; arrays have one row per reference area."""

    model: Model
    q0: FloatArray  # (n_level,): Reference values of 1/A, 1/m^2, ascending
    # rates, gain, push, gap, slow (n_level, n): `slow` holds the slowest layer's share of each mode (see `Model.slow`)
    rates: FloatArray
    gain: FloatArray
    push: FloatArray
    gap: FloatArray
    slow: FloatArray
    tap: FloatArray  # (n_level, n_tap, n)
    tap_k: FloatArray  # (n_tap,): Zero under `mobile`
    feed: FloatArray  # (n_level, n, n_tap)
    # live, project (n_level, n, n): x = live @ w for the live voltages, w = project @ x
    live: FloatArray
    project: FloatArray
    shown: FloatArray  # (n_level, n_column, n): Recorded voltages over k_shown U, as `live` gives the live ones
    k_shown: FloatArray  # (n_column,)
    node: FloatArray  # (n_level, n_node, n): Voltages of the nodes in the same way, over k_node U
    k_node: FloatArray  # (n_node,)
    # powers, slopes (DEGREE + 1,): 1/A as a polynomial in (u - lo) * scale - 1, and its derivative; longer ones hold
    # coefficients of Chebyshev series
    powers: FloatArray
    slopes: FloatArray
    # lo, scale: Lowest gap voltage (V) of the branch's continuation, and 1/V; scale is 0 where Eq. 4 is solved at every
    # evaluation instead.
    lo: float
    scale: float
    u_top: float  # Largest gap voltage (V) that the model's curve covers
    stress: float  # Force per area and squared gap voltage, Pa/V^2


def build_system(
    model: Model, tol: float, q_range: tuple[float, float], grouping: FloatArray, nodes: FloatArray,
    stress: float = 0.0, ratio: float = LEVEL_RATIO,
) -> System:  # fmt: skip
    """Modal form of a model for 1/A (1/m^2) within `q_range`, with 1/A to the relative error `tol`.

    `grouping` (n_column, n) tells which state voltages add up to each recorded one, and `nodes` (n_node, n + 1) has the
    voltages of the nodes from the live ones and U. `stress` is the force per area and squared gap voltage (Pa/V^2),
    `ratio` the largest one of neighbouring reference areas.
    """
    forms = _forms(model, q_range[0], q_range[1], grouping, nodes, ratio)
    return System._make((model, *forms, *area_polynomial(model.curve, tol), float(model.curve[1]), stress))


@jit
def _forms(model: Model, lowest: float, highest: float, grouping: FloatArray, nodes: FloatArray, ratio: float) -> Any:
    """The arrays of a `System` from `q0` to `k_node`, for reference areas whose 1/A is from `lowest` to `highest`."""
    mobile, area0, rate, rate0 = model.mobile, model.area0, model.rate, model.rate0
    k, gap, slow = model.k, model.gap, model.slow
    n = gap.size
    levels = max(1, math.ceil(math.log(highest / lowest) / math.log(ratio)))
    leaking = np.flatnonzero(rate0 > 0.0)
    tap_k = np.zeros(leaking.size)
    q0, rates, gain, push, own, slowest = (
        np.empty(levels), np.empty((levels, n)), np.empty((levels, n)), np.zeros((levels, n)), np.zeros((levels, n)),
        np.zeros((levels, n)),
    )  # fmt: skip
    tap, feed = np.empty((levels, leaking.size, n)), np.empty((levels, n, leaking.size))
    live, project = np.empty((levels, n, n)), np.empty((levels, n, n))
    shown, node = np.zeros((levels, grouping.shape[0], n)), np.zeros((levels, nodes.shape[0], n))
    for level in range(levels):
        q = lowest * (highest / lowest) ** ((level + 0.5) / levels)
        q0[level] = q
        its_rates, its_gain, its_feed, shape = modes(rate + q * rate0, k)
        share = 1.0 / (area0 * q) if mobile else 1.0
        for m in range(n):
            rates[level, m], gain[level, m] = its_rates[m], its_gain[m] * share
            for i in range(n + 1):
                push[level, m] += its_feed[i, m] * rate[i] * k[i]
            for i in range(n):
                own[level, m] += gap[i] * shape[i, m]
                slowest[level, m] += slow[i] * shape[i, m]
                live[level, i, m] = shape[i, m]
                # `feed` takes -p + k sum(p) to modes; x is that of p = -x, as it sums to zero.
                project[level, m, i] = its_feed[n, m] - its_feed[i, m]
                for c in range(grouping.shape[0]):
                    shown[level, c, m] += grouping[c, i] * shape[i, m]
                for v in range(nodes.shape[0]):
                    node[level, v, m] += nodes[v, i] * shape[i, m]
            for j in range(leaking.size):
                tap[level, j, m] = shape[leaking[j], m]
                feed[level, m, j] = its_feed[leaking[j], m] * rate0[leaking[j]]
    k_shown, k_node = np.zeros(grouping.shape[0]), nodes[:, n].copy()
    for i in range(n):
        k_shown += grouping[:, i] * k[i]
        k_node += nodes[:, i] * k[i]
    if not mobile:
        for j in range(leaking.size):
            tap_k[j] = k[leaking[j]]
    return q0, rates, gain, push, own, slowest, tap, tap_k, feed, live, project, shown, k_shown, node, k_node


def area_error(decade: int) -> float:
    """Relative error allowed of the area's polynomial if an error of that decade is asked for."""
    return max(_AREA_SHARE * 10.0**decade, _AREA_ROUNDING)


def area_missed(curve: FloatArray, decade: int) -> float:
    """Largest relative error of 1/A in the form of a `Contact.curve` that a run uses (see `area_polynomial`)."""
    series = np.abs(curve[2 + N_PACKED :])
    if series.size == 1 or not curve[0] < curve[1]:
        return 0.0
    if not series.size or not series[0] > 0.0:
        return area_error(decade)
    return float(series[_kept(curve, area_error(decade)) :].sum() / _at_rest(curve))


def _kept(curve: FloatArray, tol: float) -> int:
    """Number of terms of a curve's series for an error of `tol` of 1/A: those of a polynomial, or all."""
    left = np.abs(curve[2 + N_PACKED + DEGREE + 1 :]).sum()
    size = curve.size - 2 - N_PACKED
    return min(DEGREE + 1, size) if left <= tol * _at_rest(curve) else size


def _at_rest(curve: FloatArray) -> float:
    """1/A at 0 V (1/m^2); in the range of a series it is nowhere much less."""
    packed = curve[2 : 2 + N_PACKED]
    return float(packed[1] / (packed[1] ** 2 - packed[7] * packed[5] ** 2))


def area_polynomial(curve: FloatArray, tol: float) -> tuple[FloatArray, FloatArray, float, float]:
    """1/A as a polynomial, its slopes, `lo` and `scale` (see `System`) from a `Contact.curve`.

    A polynomial of `DEGREE` in powers if its relative error is at most `tol`; else a longer Chebyshev series.
    """
    lo, hi, series = float(curve[0]), float(curve[1]), curve[2 + N_PACKED :]
    none = np.zeros(DEGREE + 1), np.zeros(DEGREE + 1), lo, 0.0
    if series.size == 1:
        # The area is fixed.
        return np.append(series, none[0][1:]), none[1], 0.0, 1.0
    if not lo < hi:
        return none
    scale = 2.0 / (hi - lo)
    if series.size and series[0] > 0.0:
        series = series[: _kept(curve, tol)]
        powers, slopes = np.zeros(DEGREE + 1), np.zeros(DEGREE + 1)
        enough = series.size <= DEGREE + 1
        if enough and _to_polynomial(series, powers, slopes, max(2.0 * tol, 4e-15) * _at_rest(curve)):
            return powers, slopes, lo, scale
    elif (found := _long_series(curve, tol)) is None:
        return none
    else:
        series = found
    long, slope = _both(series, max(series.size, DEGREE + 2))
    return long, slope, lo, scale


def _long_series(curve: FloatArray, tol: float) -> FloatArray | None:
    """A series over a curve's range, longer than those of curves; None if its rounding error exceeds `tol`."""
    if tol < _LONG_ROUNDING:
        return None
    packed = curve[2 : 2 + N_PACKED]
    # 1/A rises to many times its value at 0 V, so that the error allowed is a smaller share of the largest term.
    share = 0.1 * _LONG_ROUNDING * _at_rest(curve) * float(ridge_area(curve[1], packed))
    return fit(lambda u: 1.0 / np.asarray(ridge_area_array(u, packed)), curve[0], curve[1], share, _LONG_SIZES)


def _both(series: FloatArray, width: int) -> tuple[FloatArray, FloatArray]:
    """A Chebyshev series and that of its derivative, both with zeros up to `width` terms."""
    long, slope = np.zeros((2, width))
    long[: series.size] = series
    slope[: series.size - 1] = np.polynomial.chebyshev.chebder(series)
    return long, slope


def area_polynomials(
    curves: FloatArray, follows: NDArray[np.bool_], tol: float
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """`area_polynomial` of several areas, one a row, all of them of one length; zeros for those that do not follow."""
    found = [area_polynomial(curve, tol) for curve in curves[follows]]
    width = max((powers.size for powers, _, _, _ in found), default=DEGREE + 1)
    powers, slopes = np.zeros((2, follows.size, width))
    lo, scale = np.zeros((2, follows.size))
    for i, curve, (power, slope, low, one) in zip(np.flatnonzero(follows), curves[follows], found, strict=True):
        lo[i], scale[i] = low, one
        if power.size == DEGREE + 1 < width and one > 0.0:
            # Beside a longer series, this one has to be a Chebyshev series, too.
            power, slope = _both(curve[2 + N_PACKED :][: _kept(curve, tol)], width)
        powers[i, : power.size], slopes[i, : slope.size] = power, slope
    return powers, slopes, lo, scale


@jit
def _to_polynomial(series: FloatArray, powers: FloatArray, slopes: FloatArray, allowed: float) -> bool:
    """Turn as many terms of a Chebyshev series into powers as there is room for, with their derivative.

    True if the powers differ by at most `allowed` from the whole series, at 33 points.
    """
    kept = min(series.size, powers.size)
    to_powers(series[:kept], powers[:kept])
    for j in range(1, kept):
        slopes[j - 1] = j * powers[j]
    worst = 0.0
    for i in range(33):
        x = i / 16.0 - 1.0
        value = 0.0
        for j in range(kept - 1, -1, -1):
            value = value * x + powers[j]
        worst = max(worst, abs(value - evaluate(series, x)[0]))
    return worst <= allowed
