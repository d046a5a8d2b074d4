"""Linear systems in modal form, w_k' = -rate_k w_k + gain_k U(t), driven by samples joined by straight lines.

In each stretch of samples the modes run from zero, and what they had before decays in closed form beside that. So the
state is rounded once in a stretch, with the rounding carried on: a slow mode does not add up that of every sample.
"""

from __future__ import annotations

import math

import numpy as np

from fingerspice.base.arrays import FloatArray, read_only
from fingerspice.base.compiled import jit, jit_fused

# Beyond, each moment follows from the one below; before, that would lose digits, and they follow from the highest.
_LATE = 4.0


@jit
def moments(z: float, out: FloatArray) -> None:
    """Integrals of exp(-z (1 - x)) x^j over [0, 1] for z >= 0 into `out` (count,), j from 0; to a few roundings."""
    count = out.size
    if z > _LATE:
        out[0] = -math.expm1(-z) / z
        for j in range(1, count):
            out[j] = (1.0 - j * out[j - 1]) / z
        return
    # exp(-z) sum of z^k / (k! (k + count)): all terms are positive, and once one is small the next are smaller.
    total, term, k = 0.0, 1.0, 0.0
    while term > 1e-17 * total:
        total += term / (k + count)
        k += 1.0
        term *= z / k
    out[count - 1] = math.exp(-z) * total
    for j in range(count - 1, 0, -1):
        out[j - 1] = (1.0 - z * out[j]) / j


_STRETCH = 500
# Below, a number counts as zero, before it becomes a (slow) denormal one.
_SMALLEST = 1e-300


@jit_fused
def _run(x: FloatArray, before: float, fall: FloatArray, by: FloatArray, out: FloatArray) -> None:
    """Two modes w <- fall w + by[:, 0] u_before + by[:, 1] u from zero: chains that the processor runs side by side."""
    e, f, v, w = fall[0], fall[1], 0.0, 0.0
    for i in range(x.size):
        v = e * v + (by[0, 0] * before + by[0, 1] * x[i])
        w = f * w + (by[1, 0] * before + by[1, 1] * x[i])
        out[0, i], out[1, i] = v, w
        before = x[i]


@jit_fused
def _hold(
    u: FloatArray, z: FloatArray, by: FloatArray, direct: FloatArray, weights: FloatArray, state: FloatArray,
    y: FloatArray,
) -> None:  # fmt: skip
    """Outputs y (n_y, m) of an even number of modes; `state` (n,) at the first of u (m,) is taken to the last.

    `z` is rate dt, and `by` (n, 2) has the weights of the samples at the start and the end of a step.
    """
    n, room, carry = z.size, np.empty((2, _STRETCH)), np.zeros(z.size)
    fall = np.empty((n, _STRETCH))
    for k in range(n):
        for i in range(_STRETCH):
            fall[k, i] = math.exp(-z[k] * (i + 1.0))
            if fall[k, i] < _SMALLEST:
                fall[k, i] = 0.0
    for j in range(direct.size):
        y[j, 0] = direct[j] * u[0]
        for k in range(n):
            y[j, 0] += weights[j, k] * state[k]
    for s in range(1, u.size, _STRETCH):
        x = u[s : s + _STRETCH]
        size = x.size
        for j in range(direct.size):
            out, g = y[j, s : s + size], direct[j]
            for i in range(size):
                out[i] = g * x[i]
        for k in range(0, n, 2):
            _run(x, u[s - 1], fall[k : k + 2, 0], by[k : k + 2], room)
            v, w, v_fall, w_fall = room[0, :size], room[1, :size], fall[k, :size], fall[k + 1, :size]
            for j in range(direct.size):
                out, g, h = y[j, s : s + size], weights[j, k], weights[j, k + 1]
                g_before, h_before = g * state[k], h * state[k + 1]
                for i in range(size):
                    out[i] += (g * v[i] + g_before * v_fall[i]) + (h * w[i] + h_before * w_fall[i])
            for j in range(2):
                # A slow mode is what it was and a change; a fast one keeps its digits as it decays.
                old, path = state[k + j], z[k + j] * size
                kept, left = (old, math.expm1(-path)) if path < 0.5 else (0.0, math.exp(-path))
                change = room[j, size - 1] + (left * old + carry[k + j])
                new = kept + change
                carry[k + j] = (kept - new) + change
                state[k + j] = 0.0 if abs(new) < _SMALLEST else new


def first_order_hold(
    u: FloatArray, dt: float, rates: FloatArray, gains: FloatArray, direct: FloatArray, weights: FloatArray,
    w0: FloatArray,
) -> tuple[FloatArray, FloatArray]:  # fmt: skip
    """Outputs y = direct U + weights w (n_y, m) at samples joined by straight lines, and the state at the last one.

    `u` (m,) are one or more samples, `dt` (s) apart; `rates` (1/s, 0 or more) and `gains` (n,) are of the modes w,
    whose state at the first sample is `w0`; `direct` (n_y,) is the share of the input that appears at once.
    """
    n, y = rates.size, np.empty((direct.size, u.size))
    # A last mode without gain or weight completes an odd number.
    pairs = n + n % 2
    z, by, shares, state = np.zeros(pairs), np.zeros((pairs, 2)), np.zeros((direct.size, pairs)), np.zeros(pairs)
    z[:n], shares[:, :n], state[:n] = rates * dt, weights, w0
    for one, row in zip(z[:n].tolist(), by, strict=False):
        moments(one, row)
    # Of a straight line, by its values at both ends.
    by[:n] = np.column_stack([by[:n, 0] - by[:n, 1], by[:n, 1]]) * (gains * dt)[:, None]
    _hold(read_only(np.ascontiguousarray(u)), z, by, np.ascontiguousarray(direct), shares, state, y)
    return y, state[:n]
