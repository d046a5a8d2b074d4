"""How the error of a run is carried through a step, with what the area answers to it.

The modes' own decay carries an error e while the area stands still. The area answers with dq = q' du for an error du of
the gap voltage, which forces the modes by G du: that may oppose du or support it, and near an instability of the
circuit (a layer's leak that rises with the area, or an area that the stored charge drives on) errors grow thousandfold
within a few steps.
"""

from __future__ import annotations

import math

from fingerspice.base.arrays import FloatArray
from fingerspice.base.compiled import jit
from fingerspice.engine.model import Model, branch_area
from fingerspice.engine.rows import DQ, SOURCE, X_GAP, Q, U
from fingerspice.numerics.lobatto import END, NODES, POINTS

# Loop gain of the area, over a step, up to which the modes' own decay is taken for all; and up to which two halves of
# the step are short enough.
_SLIGHT, _MODERATE = 0.05, 1.0
# Growth within an interval, at most.
_MOST = 10.0
_MIDDLE = NODES // 2


@jit
def _answer(
    model: Model, push: FloatArray, tap: FloatArray, tap_k: FloatArray, feed: FloatArray, w: FloatArray,
    r: FloatArray, j: int, slope: float, forced: FloatArray,
) -> float:  # fmt: skip
    """G at a node, into `forced` (n,): forcing of the modes for an error of the gap voltage; du for one of gap @ w.

    `slope` is that of 1/A there, 1/(m^2 V).
    """
    q = r[Q, j]
    for k in range(push.size):
        forced[k] = -push[k] * r[SOURCE, j] / (model.area0 * q * q) if model.mobile else 0.0
    for t in range(tap_k.size):
        tapped = tap_k[t] * r[SOURCE, j]
        for k in range(push.size):
            tapped += tap[t, k] * w[k, j]
        for k in range(push.size):
            forced[k] += feed[k, t] * tapped
    for k in range(push.size):
        forced[k] *= slope
    if not model.mobile:
        return 1.0
    magnified: float = model.area0 * q / max(1.0 - model.area0 * r[X_GAP, j] * slope, 1e-12)
    return magnified


@jit
def _slope(model: Model, sign: float, r: FloatArray, j: int) -> float:
    """Slope of 1/A at a node, 1/(m^2 V)."""
    _, slope = branch_area(model, sign, r[U, j])
    return slope


@jit
def carry(
    model: Model, rates: FloatArray, gap: FloatArray, push: FloatArray, tap: FloatArray, tap_k: FloatArray,
    feed: FloatArray, decay: FloatArray, h: float, sign: float, w: FloatArray, r: FloatArray, error: FloatArray,
    carried: FloatArray, forced: FloatArray,
) -> None:  # fmt: skip
    """The error of the modes (n,) at the start of a step as it is at the points between and the end, into `carried`.

    `carried` (n, 4); `forced` (n,) is for passing use; see `exponential.converge` for the rest.
    """
    n = gap.size
    gain = 0.0
    for j in (_MIDDLE, END):
        # The mean slope will do to see whether it matters.
        way = r[U, j] - r[U, j - _MIDDLE]
        slope = r[DQ, j] if model.mobile else ((r[Q, j] - r[Q, j - _MIDDLE]) / way if way != 0.0 else 0.0)
        factor = _answer(model, push, tap, tap_k, feed, w, r, j, slope, forced)
        loop = 0.0
        for k in range(n):
            loop += gap[k] * forced[k] * (h if rates[k] * h < 1e-9 else (1.0 - decay[k, END]) / rates[k])
        gain = max(gain, abs(factor * loop))
    for k in range(n):
        for p in range(4):
            carried[k, p] = decay[k, NODES + p if p < 3 else END] * error[k]
    if not gain > _SLIGHT:
        return
    # By the exponential trapezoidal rule: only the gap voltage is implicit.
    stride = _MIDDLE if gain <= _MODERATE else 1
    moved = 0.0
    factor = _answer(model, push, tap, tap_k, feed, w, r, 0, _slope(model, sign, r, 0), forced)
    for k in range(n):
        carried[k, 3] = error[k]
        moved += factor * gap[k] * error[k]
    place = 0
    for j in range(stride, NODES, stride):
        dt = h * (POINTS[j] - POINTS[j - stride])
        for k in range(n):
            fade = decay[k, _MIDDLE] if stride == _MIDDLE else math.exp(-rates[k] * dt)
            carried[k, 3] = carried[k, 3] * fade + 0.5 * _reach(rates[k], dt, fade) * forced[k] * moved
        factor = _answer(model, push, tap, tap_k, feed, w, r, j, _slope(model, sign, r, j), forced)
        known = 0.0
        loop = 0.0
        for k in range(n):
            fade = decay[k, _MIDDLE] if stride == _MIDDLE else math.exp(-rates[k] * dt)
            known += factor * gap[k] * carried[k, 3]
            loop += 0.5 * factor * gap[k] * _reach(rates[k], dt, fade) * forced[k]
        moved = known / max(1.0 - loop, 1.0 / _MOST)
        for k in range(n):
            fade = decay[k, _MIDDLE] if stride == _MIDDLE else math.exp(-rates[k] * dt)
            carried[k, 3] += 0.5 * _reach(rates[k], dt, fade) * forced[k] * moved
        # The points between that have been passed.
        while place < 3 and POINTS[NODES + place] < POINTS[j]:
            for k in range(n):
                carried[k, place] = carried[k, 3]
            place += 1


@jit
def _reach(rate: float, dt: float, fade: float) -> float:
    """Response of a mode to a forcing of one for so long (s), in which it falls to `fade`."""
    return dt if rate * dt < 1e-6 else (1.0 - fade) / rate
