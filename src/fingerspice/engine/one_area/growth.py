"""Propagation of a run's error through a step, by the linearised equations including the change of the area.

With the area held, an error of the modes decays with their rates. But an error du of the gap voltage also changes 1/A
by dq = q' du, which forces the modes by G du. This feedback may oppose du or amplify it: near an instability of the
circuit (a layer's leakage that rises with the area, or an area that the stored charge drives on) errors grow
thousandfold within a few steps.
"""

from __future__ import annotations

import math

import numpy as np

from fingerspice.base.arrays import FloatArray
from fingerspice.base.compiled import jit, jit_within
from fingerspice.engine.one_area.model import Model, branch_area
from fingerspice.engine.one_area.rows import DQ, SOURCE, X_GAP, Q, U, Work
from fingerspice.engine.one_area.system import System
from fingerspice.numerics.lobatto import END, NODES, POINTS

# Loop gain of the feedback through the area over a step: up to the first value the feedback is neglected, and up to the
# second one two intervals in a step are enough, beyond it one between each two nodes.
SLIGHT, _MODERATE = 0.05, 1.0
# Largest growth of the error that is admitted within one interval.
_MOST = 10.0
_MIDDLE = NODES // 2


@jit_within
def _answer(system: System, work: Work, level: int, j: int, slope: float, forced: FloatArray) -> float:
    """Forcing G of the modes by a unit error of the gap voltage at node j, into `forced` (n,).

    Returns the error of the gap voltage for a unit error of gap @ w. `slope` is that of 1/A at the node, 1/(m^2 V).
    """
    model, r, w = system.model, work.r, work.w
    push, tap, tap_k, feed = system.push[level], system.tap[level], system.tap_k, system.feed[level]
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
    """Slope of 1/A by the gap voltage at node j, 1/(m^2 V)."""
    _, slope = branch_area(model, sign, r[U, j])
    return slope


@jit_within
def loop_gain(system: System, work: Work, level: int) -> float:
    """Loop gain of the feedback through the area over a step, from its middle and its end.

    Up to `SLIGHT` the feedback may be neglected. Every step needs this, and few need `carry`.
    """
    mobile, area0, r, w, weight = system.model.mobile, system.model.area0, work.r, work.w, work.weight
    push, tap, tap_k, feed = system.push[level], system.tap[level], system.tap_k, system.feed[level]
    gain = 0.0
    for j in (_MIDDLE, END):
        # The mean slope of 1/A is enough to decide whether the feedback matters.
        q, way = r[Q, j], r[U, j] - r[U, j - _MIDDLE]
        slope = r[DQ, j] if mobile else ((q - r[Q, j - _MIDDLE]) / way if way != 0.0 else 0.0)
        loop = 0.0
        for t in range(tap_k.size):
            tapped = tap_k[t] * r[SOURCE, j]
            reach = 0.0
            for k in range(weight.size):
                tapped += tap[t, k] * w[k, j]
                reach += weight[k] * feed[k, t]
            loop += reach * tapped
        factor = 1.0
        if mobile:
            reach = 0.0
            for k in range(weight.size):
                reach += weight[k] * push[k]
            loop -= reach * r[SOURCE, j] / (area0 * q * q)
            factor = area0 * q / max(1.0 - area0 * r[X_GAP, j] * slope, 1e-12)
        gain = max(gain, abs(factor * loop * slope))
    return gain


@jit_within
def carry(
    system: System, work: Work, level: int, decay: FloatArray, h: float, sign: float, gain: float, error: FloatArray
) -> None:  # fmt: skip
    """Propagate the error of the modes (n,) through a step of length h (s) whose loop gain is `gain`.

    The error at the points between nodes and at the end goes into `work.carried`. `decay` is that of the modes at the
    rows of the step.
    """
    model, r, carried = system.model, work.r, work.carried
    rates, gap = system.rates[level], system.gap[level]
    n = gap.size
    forced = np.zeros(n)
    # Exponential trapezoidal rule: the only implicit unknown is the error `moved` of the gap voltage.
    stride = _MIDDLE if gain <= _MODERATE else 1
    moved = 0.0
    factor = _answer(system, work, level, 0, _slope(model, sign, r, 0), forced)
    for k in range(n):
        carried[k, 3] = error[k]
        moved += factor * gap[k] * error[k]
    place = 0
    for j in range(stride, NODES, stride):
        dt = h * (POINTS[j] - POINTS[j - stride])
        for k in range(n):
            fade = decay[k, _MIDDLE] if stride == _MIDDLE else math.exp(-rates[k] * dt)
            carried[k, 3] = carried[k, 3] * fade + 0.5 * _reach(rates[k], dt, fade) * forced[k] * moved
        factor = _answer(system, work, level, j, _slope(model, sign, r, j), forced)
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
        # Points between nodes that lie in this interval take the error at its end.
        while place < 3 and POINTS[NODES + place] < POINTS[j]:
            for k in range(n):
                carried[k, place] = carried[k, 3]
            place += 1


@jit
def _reach(rate: float, dt: float, fade: float) -> float:
    """Response of a mode to a unit forcing for `dt` (s), during which it decays to the fraction `fade`."""
    return dt if rate * dt < 1e-6 else (1.0 - fade) / rate
