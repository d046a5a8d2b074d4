"""One step of each kind: explicit Runge-Kutta and simplified-Newton collocation, with dense output."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fingerspice.base.compiled import jit
from fingerspice.engine.model import Model, branch_area, charge_rate, dot, jacobian, rates_at, right_hand_side
from fingerspice.engine.segment import Segment, source
from fingerspice.numerics.small import inverse

FloatArray = NDArray[np.float64]


# What rounding may leave of Newton's last move, over the local error allowed.
_FLOOR = 0.02


class Method(NamedTuple):
    """A tableau as numbers (see `fingerspice.numerics.tableaus.Tableau`) and how its step is chosen.

    `h_fixed` > 0 turns error control off and takes steps of that length (s), for measuring orders.
    """

    implicit: bool
    a: FloatArray
    c: FloatArray
    e: FloatArray
    dense: FloatArray
    n_end: int
    error_order: int
    h_max: float
    h_fixed: float


@jit
def take_step(
    model: Model,
    method: Method,
    segment: Segment,
    t0: float,
    h: float,
    y: FloatArray,
    sign: float,
    u: float,
    scale: FloatArray,
    k: FloatArray,
    us: FloatArray,
    y1: FloatArray,
) -> tuple[float, int]:
    """Step from `t0` (s into the segment) by `h`; fill the stages `k` (s, n + 1) and the end `y1`.

    `u` is the gap voltage (V) at the start, `us` (s,) takes that of every stage. For an explicit method k[0] is given.
    Returns the local error over `scale`, and the evaluations spent.
    """
    if method.implicit:
        return _collocation_step(model, method, segment, t0, h, y, sign, u, scale, k, us, y1)
    return _explicit_step(model, method, segment, t0, h, y, sign, u, scale, k, us, y1)


@jit
def _explicit_step(
    model: Model,
    method: Method,
    segment: Segment,
    t0: float,
    h: float,
    y: FloatArray,
    sign: float,
    u: float,
    scale: FloatArray,
    k: FloatArray,
    us: FloatArray,
    y1: FloatArray,
) -> tuple[float, int]:
    stages = method.a.shape[0]
    stage = np.empty(y.size)
    norm = math.inf
    us[0] = u
    for i in range(1, stages):
        _stage_state(method.a, i, i, h, y, k, stage)
        u_source, du_source = source(segment, t0 + method.c[i] * h)
        us[i] = right_hand_side(model, u_source, du_source, stage, sign, us[i - 1], k[i])
        if i == method.n_end:
            y1[:] = stage
            norm = _error_norm(h, method.e, k, i + 1, scale)
            # The stages past this one serve the dense output only.
            if method.h_fixed <= 0.0 and not norm <= 1.0:
                return norm, i
    return norm, stages - 1


@jit
def _stage_state(a: FloatArray, i: int, upto: int, h: float, y: FloatArray, k: FloatArray, out: FloatArray) -> None:
    for j in range(out.size):
        value = 0.0
        for r in range(upto):
            value += a[i, r] * k[r, j]
        out[j] = y[j] + h * value


@jit
def _error_norm(h: float, e: FloatArray, k: FloatArray, stages: int, scale: FloatArray) -> float:
    """Largest local error over `scale`; with a companion row, DOP853's combination of both. NaN is infinite."""
    norm = 0.0
    for j in range(scale.size):
        first = 0.0
        second = 0.0
        for r in range(stages):
            first += e[0, r] * k[r, j]
            second += e[1, r] * k[r, j]
        value = abs(first)
        if second != 0.0:
            value = first * first / math.sqrt(first * first + 0.01 * second * second)
        value *= h / scale[j]
        if not value <= norm:
            norm = value
    return norm if norm == norm else math.inf


@jit
def _newton_inverse(method: Method, h: float, slopes: FloatArray) -> FloatArray:
    """Inverse of I - h A (x) J, with J of every stage in `slopes` (s, n, n)."""
    stages, n, _ = slopes.shape
    matrix = np.eye(stages * n)
    for i in range(stages):
        for r in range(stages):
            for p in range(n):
                for j in range(n):
                    matrix[i * n + p, r * n + j] -= h * method.a[i, r] * slopes[r, p, j]
    return inverse(matrix)


@jit
def _collocation_step(
    model: Model,
    method: Method,
    segment: Segment,
    t0: float,
    h: float,
    y: FloatArray,
    sign: float,
    u: float,
    scale: FloatArray,
    k: FloatArray,
    us: FloatArray,
    y1: FloatArray,
) -> tuple[float, int]:
    """By Newton on the rates and, under `mobile`, the gap voltages of all stages at once.

    Near a fold no gap voltage is found from a state alone: the one at hand may be past the fold of the new state.
    """
    n = y.size - 1
    stages = method.a.shape[0]
    slopes = np.empty((stages, n, n))
    by_u = np.empty((stages, n))
    u_source, du_source = source(segment, t0)
    rates_at(model, u_source, du_source, y, sign, u, k[0])
    jacobian(model, u_source, y, sign, u, slopes[0], by_u[0])
    us[:] = u
    for i in range(1, stages):
        slopes[i] = slopes[0]
        by_u[i] = by_u[0]
        k[i] = k[0]
    if model.mobile:
        # What rounding leaves of a fast leak leads far from where the voltages are.
        k[:] = 0.0
    newton = _newton_inverse(method, h, slopes)
    nfev = 1
    if newton[0, 0] != newton[0, 0]:
        return math.inf, nfev
    stage = np.empty(n + 1)
    moved = np.empty(n + 1)
    residual = np.empty(stages * n)
    move = np.empty((stages, n))
    # Of the area equation, at every stage: what is left of it, its slope, and how its voltage follows gap @ x.
    off = np.zeros(stages)
    margin = np.ones(stages)
    follows = np.ones(stages)
    before = math.inf
    slow = False
    for iteration in range(40):
        for i in range(stages):
            _stage_state(method.a, i, stages, h, y, k, stage)
            u_source, du_source = source(segment, t0 + method.c[i] * h)
            x_gap = dot(model.gap, stage)
            if model.mobile:
                q, dq = branch_area(model, sign, us[i])
                follows[i] = model.area0 * q
                off[i] = us[i] - model.k_gap * u_source - follows[i] * x_gap
                margin[i] = 1.0 - x_gap * model.area0 * dq
                if not margin[i] > 0.0:
                    return math.inf, nfev
            else:
                us[i] = model.k_gap * u_source + x_gap
            if slow:
                # Near a fold the stiff mode's rate changes within a step: one slope would not do for all stages.
                jacobian(model, u_source, stage, sign, us[i], slopes[i], by_u[i])
            rates_at(model, u_source, du_source, stage, sign, us[i], moved)
            for p in range(n):
                residual[i * n + p] = moved[p] - k[i, p] - by_u[i, p] * off[i] / margin[i]
            k[i, n] = charge_rate(model, u_source, du_source, stage, k[i], sign, us[i])
        nfev += stages
        if slow:
            newton = _newton_inverse(method, h, slopes)
        for i in range(stages * n):
            value = 0.0
            for j in range(stages * n):
                value += newton[i, j] * residual[j]
            move[i // n, i % n] = value
        share = _take(model, method, h, sign, move, off, margin, follows, us, k)
        change = 0.0
        for i in range(stages * n):
            value = abs(h * move[i // n, i % n]) / scale[i % n]
            if not value <= change:
                change = value
        if not change < math.inf or (iteration > 5 and change > 0.95 * before and change > _FLOOR and share == 1.0):
            return math.inf, nfev
        # Converged, or at the floor of rounding where it no longer contracts.
        if share == 1.0 and (change <= 1e-4 or (iteration > 5 and change > 0.5 * before and change <= _FLOOR)):
            break
        slow = iteration > 0 and change > 0.1 * before
        before = change
    else:
        return math.inf, nfev
    _stage_state(method.a, stages - 1, stages, h, y, k, y1)
    return _error_norm(h, method.e, k, stages, scale), nfev


@jit
def _take(
    model: Model, method: Method, h: float, sign: float, move: FloatArray, off: FloatArray, margin: FloatArray,
    follows: FloatArray, us: FloatArray, k: FloatArray,
) -> float:  # fmt: skip
    """Take Newton's move of the rates and gap voltages, or a share of it; returns that."""
    stages, n = move.shape
    share = 1.0
    if model.mobile:
        moves = np.empty(stages)
        for i in range(stages):
            x_gap = 0.0
            for r in range(stages):
                x_gap += h * method.a[i, r] * dot(model.gap, move[r])
            moves[i] = (follows[i] * x_gap - off[i]) / margin[i]
        for i in range(stages):
            # No farther at once than the area changes by a third.
            q, _ = branch_area(model, sign, us[i])
            while share > 1e-6:
                new, _ = branch_area(model, sign, us[i] + share * moves[i])
                if abs(new - q) < 0.3 * min(new, q):
                    break
                share *= 0.5
        for i in range(stages):
            us[i] += share * moves[i]
    for i in range(stages):
        for p in range(n):
            k[i, p] += share * move[i, p]
    return share


@jit
def dense_polynomial(k: FloatArray, dense: FloatArray, h: float, poly: FloatArray) -> None:
    """Coefficients (n + 1, degree) of theta, theta^2, ... of the state's increment inside the step."""
    for j in range(poly.shape[0]):
        for d in range(poly.shape[1]):
            value = 0.0
            for r in range(dense.shape[0]):
                value += dense[r, d] * k[r, j]
            poly[j, d] = h * value


@jit
def dense_state(theta: float, y: FloatArray, poly: FloatArray, out: FloatArray) -> None:
    """State at fraction `theta` of the step that starts at `y`."""
    for j in range(y.size):
        value = 0.0
        for d in range(poly.shape[1] - 1, -1, -1):
            value = (value + poly[j, d]) * theta
        out[j] = y[j] + value
