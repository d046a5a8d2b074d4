"""One step of each kind: explicit Runge-Kutta and simplified-Newton collocation, with dense output."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fingerspice.compiled import jit
from fingerspice.engine.model import Model, Segment, charge_rate, jacobian, right_hand_side, source
from fingerspice.numerics.small import inverse

FloatArray = NDArray[np.float64]


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
    guess: float,
    scale: FloatArray,
    k: FloatArray,
    y1: FloatArray,
) -> tuple[float, int]:
    """Step from `t0` (s into the segment) by `h`; fill the stages `k` (s, n + 1) and the end `y1`.

    For an explicit method k[0] is given. Returns the local error over `scale`, and the evaluations spent.
    """
    if method.implicit:
        return _collocation_step(model, method, segment, t0, h, y, sign, guess, scale, k, y1)
    return _explicit_step(model, method, segment, t0, h, y, sign, guess, scale, k, y1)


@jit
def _explicit_step(
    model: Model,
    method: Method,
    segment: Segment,
    t0: float,
    h: float,
    y: FloatArray,
    sign: float,
    guess: float,
    scale: FloatArray,
    k: FloatArray,
    y1: FloatArray,
) -> tuple[float, int]:
    stages = method.a.shape[0]
    stage = np.empty(y.size)
    norm = math.inf
    for i in range(1, stages):
        _stage_state(method.a, i, i, h, y, k, stage)
        u_source, du_source = source(segment, t0 + method.c[i] * h)
        guess = right_hand_side(model, u_source, du_source, stage, sign, guess, k[i])
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
def _newton_inverse(
    model: Model,
    method: Method,
    segment: Segment,
    t0: float,
    h: float,
    y: FloatArray,
    sign: float,
    guess: float,
    base: FloatArray,
) -> FloatArray:
    """Inverse of I - h A (x) J with J at the start of the step; `base` takes y' there."""
    n = y.size - 1
    stages = method.a.shape[0]
    u_source, du_source = source(segment, t0)
    guess = right_hand_side(model, u_source, du_source, y, sign, guess, base)
    slope = np.empty((n, n))
    jacobian(model, u_source, y, sign, guess, slope)
    matrix = np.eye(stages * n)
    for i in range(stages):
        for r in range(stages):
            for p in range(n):
                for j in range(n):
                    matrix[i * n + p, r * n + j] -= h * method.a[i, r] * slope[p, j]
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
    guess: float,
    scale: FloatArray,
    k: FloatArray,
    y1: FloatArray,
) -> tuple[float, int]:
    n = y.size - 1
    stages = method.a.shape[0]
    base = np.empty(n + 1)
    newton = _newton_inverse(model, method, segment, t0, h, y, sign, guess, base)
    nfev = 1
    if newton[0, 0] != newton[0, 0]:
        return math.inf, nfev
    for i in range(stages):
        k[i] = base
    stage = np.empty(n + 1)
    moved = np.empty(n + 1)
    residual = np.empty(stages * n)
    before = math.inf
    for iteration in range(40):
        for i in range(stages):
            _stage_state(method.a, i, stages, h, y, k, stage)
            u_source, du_source = source(segment, t0 + method.c[i] * h)
            guess = right_hand_side(model, u_source, du_source, stage, sign, guess, moved)
            residual[i * n : (i + 1) * n] = moved[:n] - k[i, :n]
            k[i, n] = charge_rate(model, u_source, du_source, stage, k[i], sign, guess)
        nfev += stages
        change = 0.0
        for i in range(stages * n):
            value = 0.0
            for j in range(stages * n):
                value += newton[i, j] * residual[j]
            k[i // n, i % n] += value
            value = abs(h * value) / scale[i % n]
            if not value <= change:
                change = value
        if not change < math.inf or (iteration > 3 and change > 0.95 * before and change > 0.1):
            return math.inf, nfev
        # Converged, or at the floor of rounding where it no longer contracts.
        if change <= 1e-4 or (iteration > 3 and change > 0.5 * before):
            break
        before = change
    _stage_state(method.a, stages - 1, stages, h, y, k, y1)
    return _error_norm(h, method.e, k, stages, scale), nfev


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
