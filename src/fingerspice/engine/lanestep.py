"""One step of many lanes: an explicit step of the exponential integrator, whose innermost loops run over the lanes.

A stack under `local` in modes around a reference 1/A = q0 (`engine.system`), under a source s that is straight in the
step:

    z' = -rates z + gain s + feed g,   u = k s + shape z,   g_t = (1/A(|u|) - q0) (tap_s s + taps z)_t

The drives g are taken at Lobatto's four nodes, where the state is predicted with the drives held at their last value;
the modes' response to the source and to the cubic through the drives is exact. Where u crosses 0 V, g has a kink, of
which the integral and the first moment that the rule misses are known on the straight line of u, and are added.

A rider is one more mode of rate 0, on which nothing depends. Its rate is (A - 1/q0) P + R, where P is a sum of modes,
source and drives, R one of source and drives; it has a kink of its own. It is the charge of the source without what is
known exactly: G(u), the integral of A over the gap voltage times `moved_by`, which holds all that depends on the slope
of the source, and `held` z, which holds what follows from the modes at the area 1/q0.

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
# Weights of a mode: decay, both ends of the source, and the drive held, up to each later node; then of four drives.
PER_MODE = 4 * (NODES - 1) + NODES


class Marks(NamedTuple):
    """Tuples of zeros; their lengths are constants of the compiled code."""

    modes: tuple[int, ...]
    drives: tuple[int, ...]
    rider: tuple[int, ...]  # One entry, or none
    lanes: tuple[int, ...]
    own: tuple[int, ...]  # One entry if each lane has its own weights, or none


class Lanes(NamedTuple):
    """Constants of a scene in this form."""

    rates: FloatArray  # (m,): 1/s
    gain: FloatArray  # (m,)
    shape: FloatArray  # (m,): V/V
    k: float
    taps: FloatArray  # (T, m)
    tap_s: FloatArray  # (T,)
    feed: FloatArray  # (m, T)
    area: FloatArray  # (4 j + 1,): 1/A - q0 as a polynomial in `scale` |u| + `shift`, 1/m^2
    scale: float
    shift: float
    q0: float
    kink: float  # d(1/A)/d|u| at 0 V
    by_modes: FloatArray  # (m,): P of the rider
    # by_source, by_drives (2,), (2, T): P and R
    by_source: FloatArray
    by_drives: FloatArray
    held: FloatArray  # (m,): C/V
    area_kink: float  # dA/d|u| at 0 V, m^2/V
    moved: FloatArray  # (4 l + 1,): G(u) for positive u, a polynomial as `area`, C
    moved_by: float  # G'(u) / A, F/m^2


def places(marks: Marks) -> tuple[int, ...]:
    """Numbers of the first rows of the state's parts, and of all rows; the order is that of `step`."""
    m, drives, rider = len(marks.modes), len(marks.drives), len(marks.rider)
    sizes = (3, m + rider, NODES, NODES * drives, 2 * drives, 7 * rider, 5 + drives)
    return tuple(np.cumsum((0, *sizes)).tolist())


@jit_rows
def area_rows(n: int, area: FloatArray, x: FloatArray, q: FloatArray) -> None:
    """A polynomial at x (n,) into q (n,); its degree is a multiple of 4."""
    last = area.size - 1
    for i in range(n):
        q[i] = area[last]
    for j in range(last - 1, 0, -4):
        c3, c2, c1, c0 = area[j], area[j - 1], area[j - 2], area[j - 3]
        for i in range(n):
            q[i] = (((q[i] * x[i] + c3) * x[i] + c2) * x[i] + c1) * x[i] + c0


@jit_rows
def step(marks: Any, c: Any, weights: FloatArray, state: FloatArray, after: FloatArray, a: float, b: float) -> None:
    """Advance every lane by the part of a sample from `a` to `b`; the source goes from its last sample to `after`.

    `weights` are those of the part's length.
    """
    lanes, m, drives, rider = len(marks.lanes), len(marks.modes), len(marks.drives), len(marks.rider)
    wide, each = (lanes, 1) if len(marks.own) > 0 else (1, 0)
    z_at = 3
    u_at = z_at + m + rider
    g_at = u_at + NODES
    w_at = g_at + NODES * drives
    r_at = w_at + 2 * drives
    x_at = r_at + 7 * rider
    length = m * PER_MODE
    for i in range(lanes):
        before = state[2 * lanes + i]
        change = after[i] - before
        state[i], state[lanes + i] = before + a * change, before + b * change
    for j in range(1, NODES):
        at = INNER[0] if j == 1 else INNER[1] if j == 2 else 1.0
        for i in range(lanes):
            s0, s1 = state[i], state[lanes + i]
            s = s0 + at * (s1 - s0)
            u = c.k * s
            for t in range(drives):
                state[(w_at + drives + t) * lanes + i] = c.tap_s[t] * s
            if rider > 0:
                state[(r_at + 1) * lanes + i] = c.by_source[0] * s
                state[(r_at + 5) * lanes + i] = c.by_source[1] * s
            for k in range(m):
                p = k * PER_MODE + 4 * (j - 1)
                fed = 0.0
                for t in range(drives):
                    fed += c.feed[k, t] * state[(g_at + (j - 1) * drives + t) * lanes + i]
                z = (
                    weights[p * wide + i * each] * state[(z_at + k) * lanes + i]
                    + weights[(p + 1) * wide + i * each] * s0
                    + weights[(p + 2) * wide + i * each] * s1
                    + weights[(p + 3) * wide + i * each] * fed
                )
                u += c.shape[k] * z
                for t in range(drives):
                    state[(w_at + drives + t) * lanes + i] += c.taps[t, k] * z
                if rider > 0:
                    state[(r_at + 1) * lanes + i] += c.by_modes[k] * z
            state[(u_at + j) * lanes + i] = u
            state[x_at * lanes + i] = abs(u) * c.scale + c.shift
        area_rows(lanes, c.area, state[x_at * lanes :], state[(x_at + 1) * lanes :])
        for i in range(lanes):
            q = state[(x_at + 1) * lanes + i]
            for t in range(drives):
                g = q * state[(w_at + drives + t) * lanes + i]
                state[(g_at + j * drives + t) * lanes + i] = g
                if rider > 0:
                    state[(r_at + 1) * lanes + i] += c.by_drives[0, t] * g
                    state[(r_at + 5) * lanes + i] += c.by_drives[1, t] * g
        if rider > 0:
            _ride(lanes, j, r_at, x_at, c.q0, state)
    _kinks(lanes, drives, u_at, w_at, x_at, c.kink, state)
    for i in range(lanes):
        th = state[(x_at + 4) * lanes + i]
        for k in range(m):
            p = k * PER_MODE + 4 * (NODES - 2)
            z = (
                weights[p * wide + i * each] * state[(z_at + k) * lanes + i]
                + weights[(p + 1) * wide + i * each] * state[i]
                + weights[(p + 2) * wide + i * each] * state[lanes + i]
            )
            # What begins at the kink decays to the end of the step.
            late = weights[p * wide + i * each]
            late += th * (1.0 - late)
            late *= weights[length * wide + i * each]
            for t in range(drives):
                fed = late * state[(x_at + 5 + t) * lanes + i]
                for j in range(NODES):
                    fed += weights[(p + 4 + j) * wide + i * each] * state[(g_at + j * drives + t) * lanes + i]
                z += c.feed[k, t] * fed
            state[(z_at + k) * lanes + i] = z
    if rider > 0:
        for i in range(lanes):
            h = weights[length * wide + i * each]
            first, last = state[r_at * lanes + i], state[(r_at + 1) * lanes + i]
            k0, k1, th = state[(x_at + 2) * lanes + i], state[(x_at + 3) * lanes + i], state[(x_at + 4) * lanes + i]
            bent = c.area_kink * (k0 * first + (k0 * th + k1) * (last - first))
            for t in range(drives):
                bent += c.by_drives[1, t] * state[(x_at + 5 + t) * lanes + i]
            state[(z_at + m) * lanes + i] += h * (state[(r_at + 6) * lanes + i] + bent)
            state[r_at * lanes + i] = state[(r_at + 1) * lanes + i]
            state[(r_at + 2) * lanes + i] = state[(r_at + 3) * lanes + i]
            state[(r_at + 4) * lanes + i] = state[(r_at + 5) * lanes + i]
    for i in range(lanes):
        u = c.k * state[lanes + i]
        for k in range(m):
            u += c.shape[k] * state[(z_at + k) * lanes + i]
        state[u_at * lanes + i] = u
        if b == 1.0:
            state[2 * lanes + i] = state[lanes + i]
        for t in range(drives):
            state[(g_at + t) * lanes + i] = state[(g_at + (NODES - 1) * drives + t) * lanes + i]
            state[(w_at + t) * lanes + i] = state[(w_at + drives + t) * lanes + i]


@jit_within
def _ride(lanes: int, j: int, r_at: int, x_at: int, q0: float, state: FloatArray) -> None:
    """Rate of the rider at node j into the sum over the nodes."""
    weight = _OUTER_WEIGHT if j == NODES - 1 else _INNER_WEIGHT
    for i in range(lanes):
        if j == 1:
            held = state[(r_at + 2) * lanes + i] * state[r_at * lanes + i] + state[(r_at + 4) * lanes + i]
            state[(r_at + 6) * lanes + i] = _OUTER_WEIGHT * held
        q = state[(x_at + 1) * lanes + i]
        area = -q / (q0 * (q0 + q))
        state[(r_at + 3) * lanes + i] = area
        rate = area * state[(r_at + 1) * lanes + i] + state[(r_at + 5) * lanes + i]
        state[(r_at + 6) * lanes + i] += weight * rate


@jit_within
def _kinks(lanes: int, drives: int, u_at: int, w_at: int, x_at: int, kink: float, state: FloatArray) -> None:
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
        crossed = u0 * u1 < 0.0
        state[(x_at + 2) * lanes + i] = k0 if crossed else 0.0
        state[(x_at + 3) * lanes + i] = k1 if crossed else 0.0
        state[(x_at + 4) * lanes + i] = th if crossed else 0.0
    for t in range(drives):
        for i in range(lanes):
            k0, k1, th = state[(x_at + 2) * lanes + i], state[(x_at + 3) * lanes + i], state[(x_at + 4) * lanes + i]
            w0, w1 = state[(w_at + t) * lanes + i], state[(w_at + drives + t) * lanes + i]
            state[(x_at + 5 + t) * lanes + i] = kink * (k0 * w0 + (k0 * th + k1) * (w1 - w0))
