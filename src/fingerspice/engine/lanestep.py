"""One step of many lanes: an explicit step of the exponential integrator, whose innermost loops run over the lanes.

A stack under `local`, in modes around a reference 1/A = q0 (`engine.system`), under a source s that is straight in the
step:

    z' = -rates z + gain s + feed g,   u = k s + shape z,   g_t = (1/A(|u|) - q0) (tap_s s + taps z)_t

1/A is a polynomial in the gap voltage |u|. The drives g are taken at Lobatto's four nodes, where the state is predicted
with the drives held at their last value; the modes' response to the source and to the cubic through the drives is
exact. Where u crosses 0 V, g has a kink, of which the integral and the first moment that the rule misses are known on
the straight line of u, and are added. The last modes may be passive: nothing depends on them, such as the charge.

Arrays hold one row of `lanes` values after the other. Weights are shared by all lanes, or each lane has its own. What
has to be known to the compiler are the lengths of the tuples in `Marks`.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from fingerspice.base.arrays import FloatArray
from fingerspice.base.compiled import jit_rows, jit_within

# Inner nodes of Lobatto's rule with four nodes, and its weights in a step of length 1.
INNER = (0.5 - 0.1 * 5.0**0.5, 0.5 + 0.1 * 5.0**0.5)
_OUTER_WEIGHT, _INNER_WEIGHT = 1.0 / 12.0, 5.0 / 12.0
NODES = 4
# Coefficients of the Lagrange polynomials through the nodes.
BASIS = np.ascontiguousarray(np.linalg.inv(np.vander((0.0, *INNER, 1.0), increasing=True)).T)
# Weights of a mode: decay, both ends of the source, and the drive held, up to each later node; then of four drives.
PER_MODE = 4 * (NODES - 1) + NODES
# Rows of the lanes' state before those of the modes: the source at both ends of a part, and at the last sample.
SOURCES = 3


class Marks(NamedTuple):
    """Tuples of zeros; their lengths are constants of the compiled code."""

    modes: tuple[int, ...]  # All of them
    active: tuple[int, ...]  # Those that are not passive
    drives: tuple[int, ...]
    lanes: tuple[int, ...]
    own: tuple[int, ...]  # One entry if each lane has its own weights, or none


class Lanes(NamedTuple):
    """Constants of a stack in this form."""

    rates: FloatArray  # (m,): 1/s
    gain: FloatArray  # (m,)
    shape: FloatArray  # (m,): V/V
    k: float
    taps: FloatArray  # (T, m)
    tap_s: FloatArray  # (T,)
    feed: FloatArray  # (m, T)
    # area, bend (4 j + 1,): Polynomials in `scale` |u| + `shift`: 1/A - q0 (1/m^2), and N (V m^2), the integral of
    # A - 1/q0 over the gap voltage from 0 V, at positive ones
    area: FloatArray
    bend: FloatArray
    scale: float
    shift: float
    q0: float
    kink: float  # d(1/A)/d|u| at 0 V


def state_size(marks: Marks) -> int:
    """Size of the lanes' state, whose rows are in the order of `step`."""
    m, drives = len(marks.modes), len(marks.drives)
    return (SOURCES + m + NODES + NODES * drives + 2 * drives + 5 + NODES + drives) * len(marks.lanes)


@jit_rows
def _polynomial_rows(n: int, powers: FloatArray, x: FloatArray, out: FloatArray) -> None:
    """A polynomial of degree 4 k at x (n,): a tenth faster in a step than `area_rows`, which has no row of x."""
    last = powers.size - 1
    for i in range(n):
        out[i] = powers[last]
    for j in range(last - 1, 0, -4):
        c3, c2, c1, c0 = powers[j], powers[j - 1], powers[j - 2], powers[j - 3]
        for i in range(n):
            out[i] = (((out[i] * x[i] + c3) * x[i] + c2) * x[i] + c1) * x[i] + c0


@jit_rows
def step(marks: Any, c: Any, weights: FloatArray, state: FloatArray, after: FloatArray, a: float, b: float) -> None:
    """Advance every lane by the part of a sample from `a` to `b`; the source goes from its last sample to `after`.

    `weights` are those of the part's length.
    """
    lanes, m, active, drives = len(marks.lanes), len(marks.modes), len(marks.active), len(marks.drives)
    wide, each = (lanes, 1) if len(marks.own) > 0 else (1, 0)
    u_at = SOURCES + m
    g_at = u_at + NODES
    w_at = g_at + NODES * drives
    x_at = w_at + 2 * drives
    length = m * PER_MODE
    for i in range(lanes):
        before = state[2 * lanes + i]
        change = after[i] - before
        state[i], state[lanes + i] = before + a * change, before + b * change
    for j in range(1, NODES):
        at = INNER[0] if j == 1 else INNER[1] if j == 2 else 1.0
        for i in range(lanes):
            s = state[i] + at * (state[lanes + i] - state[i])
            state[(u_at + j) * lanes + i] = c.k * s
            for t in range(drives):
                state[(w_at + drives + t) * lanes + i] = c.tap_s[t] * s
        for k in range(active):
            p = k * PER_MODE + 4 * (j - 1)
            for i in range(lanes):
                fed = 0.0
                for t in range(drives):
                    fed += c.feed[k, t] * state[(g_at + (j - 1) * drives + t) * lanes + i]
                z = (
                    weights[p * wide + i * each] * state[(SOURCES + k) * lanes + i]
                    + weights[(p + 1) * wide + i * each] * state[i]
                    + weights[(p + 2) * wide + i * each] * state[lanes + i]
                    + weights[(p + 3) * wide + i * each] * fed
                )
                state[(u_at + j) * lanes + i] += c.shape[k] * z
                for t in range(drives):
                    state[(w_at + drives + t) * lanes + i] += c.taps[t, k] * z
        for i in range(lanes):
            state[x_at * lanes + i] = abs(state[(u_at + j) * lanes + i]) * c.scale + c.shift
        _polynomial_rows(lanes, c.area, state[x_at * lanes :], state[(x_at + 1) * lanes :])
        for t in range(drives):
            for i in range(lanes):
                w = state[(w_at + drives + t) * lanes + i]
                state[(g_at + j * drives + t) * lanes + i] = state[(x_at + 1) * lanes + i] * w
    for i in range(lanes):
        state[(x_at + 1) * lanes + i] = weights[length * wide + i * each]
    _kinks(lanes, drives, u_at, w_at, x_at, c.kink, state)
    for k in range(m):
        p = k * PER_MODE + 4 * (NODES - 2)
        for i in range(lanes):
            # What begins at the kink decays to the end of the step, by the cubic through what begins at the nodes.
            late = state[(x_at + 4 + NODES) * lanes + i]
            for j in range(NODES - 1):
                late += weights[(p - 4 * j) * wide + i * each] * state[(x_at + 5 + j) * lanes + i]
            z = (
                weights[p * wide + i * each] * state[(SOURCES + k) * lanes + i]
                + weights[(p + 1) * wide + i * each] * state[i]
                + weights[(p + 2) * wide + i * each] * state[lanes + i]
            )
            for t in range(drives):
                fed = late * state[(x_at + 5 + NODES + t) * lanes + i]
                for j in range(NODES):
                    fed += weights[(p + 4 + j) * wide + i * each] * state[(g_at + j * drives + t) * lanes + i]
                z += c.feed[k, t] * fed
            state[(SOURCES + k) * lanes + i] = z
    for i in range(lanes):
        u = c.k * state[lanes + i]
        for k in range(active):
            u += c.shape[k] * state[(SOURCES + k) * lanes + i]
        state[u_at * lanes + i] = u
        if b == 1.0:
            state[2 * lanes + i] = state[lanes + i]
        for t in range(drives):
            state[(g_at + t) * lanes + i] = state[(g_at + (NODES - 1) * drives + t) * lanes + i]
        for t in range(drives):
            state[(w_at + t) * lanes + i] = state[(w_at + drives + t) * lanes + i]


@jit_within
def _kinks(
    lanes: int, drives: int, u_at: int, w_at: int, x_at: int, kink: float, state: FloatArray
) -> None:  # fmt: skip
    """What the rule misses of |u| times 1 and t, in a step of length 1, and of the drives' kinks.

    On the straight line of u from u0 to u1, which is 0 at th: int |u| = (u0^2 + u1^2) / (2 |u1 - u0|) and
    int |u| (t - th) = |u1 - u0| ((1 - th)^3 - th^3) / 3, less Lobatto's sums of both.
    """
    for i in range(lanes):
        u0, u1 = state[u_at * lanes + i], state[(u_at + NODES - 1) * lanes + i]
        d = u1 - u0
        over = 1.0 / (abs(d) + 1e-300)
        th = abs(u0) * over
        om = 1.0 - th
        c0, c1 = _OUTER_WEIGHT * abs(u0), _OUTER_WEIGHT * abs(u1)
        e0, e1 = _INNER_WEIGHT * abs(u0 + INNER[0] * d), _INNER_WEIGHT * abs(u0 + INNER[1] * d)
        k0 = 0.5 * (u0 * u0 + u1 * u1) * over - c0 - c1 - e0 - e1
        k1 = abs(d) * (om * om * om - th * th * th) / 3.0
        k1 += c0 * th - c1 * om - e0 * (INNER[0] - th) - e1 * (INNER[1] - th)
        crossed, length = u0 * u1 < 0.0, state[(x_at + 1) * lanes + i]
        state[(x_at + 2) * lanes + i] = k0 if crossed else 0.0
        state[(x_at + 3) * lanes + i] = k1 if crossed else 0.0
        state[(x_at + 4) * lanes + i] = th if crossed else 0.0
        for j in range(NODES):
            share = BASIS[j, 0] + th * (BASIS[j, 1] + th * (BASIS[j, 2] + th * BASIS[j, 3]))
            state[(x_at + 5 + j) * lanes + i] = length * share if crossed else 0.0
    for t in range(drives):
        for i in range(lanes):
            k0, k1, th = state[(x_at + 2) * lanes + i], state[(x_at + 3) * lanes + i], state[(x_at + 4) * lanes + i]
            w0, w1 = state[(w_at + t) * lanes + i], state[(w_at + drives + t) * lanes + i]
            state[(x_at + 5 + NODES + t) * lanes + i] = kink * (k0 * w0 + (k0 * th + k1) * (w1 - w0))
