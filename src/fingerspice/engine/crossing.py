"""Where the gap voltage leaves its branch within a step of the stepping loop."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fingerspice.base.compiled import jit
from fingerspice.engine.model import Model, walk
from fingerspice.engine.segment import Segment, source

FloatArray = NDArray[np.float64]


@jit
def _zero_function(
    model: Model,
    segment: Segment,
    t0: float,
    h: float,
    theta: float,
    sign: float,
    u_start: float,
    y: FloatArray,
    poly: FloatArray,
) -> float:
    """A function with the sign of the gap voltage on its branch, and its zeros: k U + x_gap.

    `u_start` is the gap voltage (V) at the start of the step.
    """
    u_source, _ = source(segment, t0 + theta * h)
    x_gap = 0.0
    for j in range(model.gap.size):
        x = 0.0
        for d in range(poly.shape[1] - 1, -1, -1):
            x = (x + poly[j, d]) * theta
        x_gap += model.gap[j] * (y[j] + x)
    zero = model.k_gap * u_source + x_gap
    if model.mobile and sign * zero < 0.0 and x_gap != 0.0:
        # The sum is of the area at 0 V; at another area the voltage may keep its sign.
        u = walk(model, model.k_gap * u_source, x_gap * model.area0, sign, u_start, True)
        # No root is a fold, not a zero: the next step will say so.
        if u != 0.0:
            return u if u == u else sign
    return zero


@jit
def first_zero(
    model: Model, segment: Segment, t0: float, h: float, sign: float, u_start: float, y: FloatArray, poly: FloatArray
) -> float:
    """First fraction of the step at which the gap voltage leaves its branch, or 2 where it does not."""
    lo = 0.0
    f_lo = sign * _zero_function(model, segment, t0, h, 0.0, sign, u_start, y, poly)
    hi = 0.0
    f_hi = 0.0
    for i in range(1, 5):
        hi = 0.25 * i
        f_hi = sign * _zero_function(model, segment, t0, h, hi, sign, u_start, y, poly)
        if f_hi < 0.0:
            break
        lo = hi
        f_lo = f_hi
    if not f_hi < 0.0:
        return 2.0
    if not f_lo > 0.0:
        return lo
    # Illinois variant of regula falsi: superlinear, and the bracket never opens.
    for _ in range(100):
        mid = (lo * f_hi - hi * f_lo) / (f_hi - f_lo)
        if not lo < mid < hi:
            mid = 0.5 * (lo + hi)
        if not lo < mid < hi:
            break
        f_mid = sign * _zero_function(model, segment, t0, h, mid, sign, u_start, y, poly)
        if f_mid < 0.0:
            hi = mid
            f_hi = f_mid
            f_lo *= 0.5
        else:
            lo = mid
            f_lo = f_mid
            f_hi *= 0.5
        if hi - lo <= 4e-16 or f_mid == 0.0:
            break
    return hi if f_hi < 0.0 and f_lo != 0.0 else lo
