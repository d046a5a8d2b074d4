"""One step of many lanes: an explicit step of the exponential integrator, whose innermost loops run over the lanes.

A circuit with one finger under `local`, in modes around a reference 1/A = q0, under a source s that is straight in the
step (`solve.netmodal` has the equations; in a stack kappa and the drive N are 0):

    z' = -rates z + gain s + feed g            xi = k s + shape z        u = xi - kappa N(xi)
    g_t = (1/A - q0) (tap_s s + taps z + bent N)_t,  and N as the last drive

1/A and N, the integral of A - 1/q0 over the gap voltage u, are polynomials in |xi|. The drives g are taken at Lobatto's
four nodes, where the state is predicted with the drives held at their last value; the modes' response to the source and
to the cubic through the drives is exact. Where xi crosses 0 V, g has a kink, of which the integral and the first moment
that the rule misses are known on the straight line of xi, and are added. The last modes may be passive: nothing depends
on them, such as charges.

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
# Rows of the lanes' state before those of the modes: the source at both ends of a part, and at the last sample.
SOURCES = 3
# Time constants in a step from which on a mode is taken to follow the drives, and leaves a decaying part in N.
FADED = 5.0


class Marks(NamedTuple):
    """Tuples of zeros; their lengths are constants of the compiled code."""

    modes: tuple[int, ...]  # All of them
    active: tuple[int, ...]  # Those that are not passive
    leaks: tuple[int, ...]  # Drives but N
    bend: tuple[int, ...]  # One entry if N is a drive, or none
    lanes: tuple[int, ...]
    own: tuple[int, ...]  # One entry if each lane has its own weights, or none


class Lanes(NamedTuple):
    """Constants of a circuit in this form; T drives, of which L are leaks."""

    rates: FloatArray  # (m,): 1/s
    gain: FloatArray  # (m,)
    shape: FloatArray  # (m,): V/V
    k: float
    taps: FloatArray  # (L, m)
    # tap_s, bent (L,)
    tap_s: FloatArray
    bent: FloatArray
    feed: FloatArray  # (m, T)
    # area, bend (4 j + 1,): 1/A - q0 (1/m^2), and N (V m^2) for positive xi, as polynomials in `scale` |xi| + `shift`
    area: FloatArray
    bend: FloatArray
    scale: float
    shift: float
    q0: float
    kappa: float  # 1/m^2
    kinks: FloatArray  # (T,): Derivatives by |xi| at 0 V: of 1/A, and of N / xi
    fast: int  # The mode that follows N within a small part of a sample; -1 if there is none


def places(marks: Marks) -> tuple[int, ...]:
    """Numbers of the first rows of the state's parts, and of all rows; the order is that of `step`."""
    m, leaks, drives = len(marks.modes), len(marks.leaks), len(marks.leaks) + len(marks.bend)
    sizes = (SOURCES, m, NODES, NODES * drives, 2 * leaks, 5 + 2 * drives)
    return tuple(np.cumsum((0, *sizes)).tolist())


@jit_rows
def polynomial_rows(n: int, powers: FloatArray, x: FloatArray, out: FloatArray) -> None:
    """A polynomial at x (n,) into `out` (n,); its degree is a multiple of 4."""
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
    lanes, m, active, leaks = len(marks.lanes), len(marks.modes), len(marks.active), len(marks.leaks)
    drives, last = leaks + len(marks.bend), NODES - 1
    wide, each = (lanes, 1) if len(marks.own) > 0 else (1, 0)
    u_at = SOURCES + m
    g_at = u_at + NODES
    w_at = g_at + NODES * drives
    x_at = w_at + 2 * leaks
    length = m * PER_MODE
    for i in range(lanes):
        before = state[2 * lanes + i]
        change = after[i] - before
        state[i], state[lanes + i] = before + a * change, before + b * change
    if drives > leaks:
        for i in range(drives * lanes):
            state[(x_at + 5 + drives) * lanes + i] = 0.0
        if a == 0.0 and c.fast >= 0:
            _smooth(marks, c, length * wide, each, u_at, g_at, w_at, x_at, weights, state)
    for j in range(1, NODES):
        at = INNER[0] if j == 1 else INNER[1] if j == 2 else 1.0
        for i in range(lanes):
            s0, s1 = state[i], state[lanes + i]
            s = s0 + at * (s1 - s0)
            xi = c.k * s
            for t in range(leaks):
                state[(w_at + leaks + t) * lanes + i] = c.tap_s[t] * s
            for k in range(active):
                p = k * PER_MODE + 4 * (j - 1)
                fed = 0.0
                for t in range(drives):
                    fed += c.feed[k, t] * state[(g_at + (j - 1) * drives + t) * lanes + i]
                z = (
                    weights[p * wide + i * each] * state[(SOURCES + k) * lanes + i]
                    + weights[(p + 1) * wide + i * each] * s0
                    + weights[(p + 2) * wide + i * each] * s1
                    + weights[(p + 3) * wide + i * each] * fed
                )
                xi += c.shape[k] * z
                for t in range(leaks):
                    state[(w_at + leaks + t) * lanes + i] += c.taps[t, k] * z
            state[(u_at + j) * lanes + i] = xi
        _drives(lanes, leaks, drives, c, u_at + j, w_at + leaks, g_at + j * drives, x_at, state)
    _kinks(lanes, leaks, drives, u_at, w_at, x_at, c.kinks, state)
    for i in range(lanes):
        th, h = state[(x_at + 4) * lanes + i], weights[length * wide + i * each]
        for k in range(m):
            p = k * PER_MODE + 4 * (last - 1)
            z = (
                weights[p * wide + i * each] * state[(SOURCES + k) * lanes + i]
                + weights[(p + 1) * wide + i * each] * state[i]
                + weights[(p + 2) * wide + i * each] * state[lanes + i]
            )
            # What begins at the kink decays to the end of the step, about as exp(-x).
            x = c.rates[k] * h * (1.0 - th)
            late = h / (1.0 + x * (1.0 + x * (0.5 + x / 6.0)))
            for t in range(drives):
                fed = late * state[(x_at + 5 + t) * lanes + i]
                for j in range(NODES):
                    fed += weights[(p + 4 + j) * wide + i * each] * state[(g_at + j * drives + t) * lanes + i]
                if drives > leaks and c.fast >= 0:
                    gone = weights[p * wide + i * each] / c.rates[c.fast]
                    fed += gone * state[(x_at + 5 + drives + t) * lanes + i]
                z += c.feed[k, t] * fed
            state[(SOURCES + k) * lanes + i] = z
    for i in range(lanes):
        xi = c.k * state[lanes + i]
        for k in range(active):
            xi += c.shape[k] * state[(SOURCES + k) * lanes + i]
        state[u_at * lanes + i] = xi
        if b == 1.0:
            state[2 * lanes + i] = state[lanes + i]
        for t in range(leaks):
            state[(w_at + t) * lanes + i] = state[(w_at + leaks + t) * lanes + i]
    if drives > leaks:
        _settle(marks, c, wide, each, u_at, g_at, w_at, x_at, weights, state)
    for t in range(drives):
        for i in range(lanes):
            state[(g_at + t) * lanes + i] = state[(g_at + last * drives + t) * lanes + i]


@jit_within
def _drives(
    lanes: int, leaks: int, drives: int, c: Any, u: int, w: int, g: int, x_at: int, state: FloatArray
) -> None:  # fmt: skip
    """Drives into the rows from g on, from xi in row u and the linear parts of the taps in the rows from w on."""
    for i in range(lanes):
        state[x_at * lanes + i] = abs(state[u * lanes + i]) * c.scale + c.shift
    polynomial_rows(lanes, c.area, state[x_at * lanes :], state[(x_at + 1) * lanes :])
    if drives > leaks:
        bend = state[(g + leaks) * lanes :]
        polynomial_rows(lanes, c.bend, state[x_at * lanes :], bend)
        for i in range(lanes):
            bend[i] = bend[i] if state[u * lanes + i] >= 0.0 else -bend[i]
            for t in range(leaks):
                state[(w + t) * lanes + i] += c.bent[t] * bend[i]
    for t in range(leaks):
        for i in range(lanes):
            state[(g + t) * lanes + i] = state[(x_at + 1) * lanes + i] * state[(w + t) * lanes + i]


@jit_within
def _smooth(
    marks: Any, c: Any, length: int, each: int, u_at: int, g_at: int, w_at: int, x_at: int, weights: FloatArray,
    state: FloatArray,
) -> None:  # fmt: skip
    """Take what decays within a small part of the step out of the drives at its start, where the slope has jumped.

    The fast mode is put where it soon is, on the new line of the source. What it takes off the drives goes to the last
    rows.
    """
    lanes, active, leaks = len(marks.lanes), len(marks.active), len(marks.leaks)
    drives, last, fast = leaks + len(marks.bend), NODES - 1, c.fast
    rate, gain = c.rates[fast], c.gain[fast]
    for i in range(lanes):
        s, h = state[i], weights[length + i * each]
        fed = gain * s
        for t in range(drives):
            fed += c.feed[fast, t] * state[(g_at + t) * lanes + i]
        slope = (state[lanes + i] - s) / (h + 1e-300)
        soon = (fed - gain * slope / rate) / rate
        soon = soon if rate * h > FADED else state[(SOURCES + fast) * lanes + i]
        xi = c.k * s
        for t in range(leaks):
            state[(w_at + leaks + t) * lanes + i] = c.tap_s[t] * s
        for k in range(active):
            z = soon if k == fast else state[(SOURCES + k) * lanes + i]
            xi += c.shape[k] * z
            for t in range(leaks):
                state[(w_at + leaks + t) * lanes + i] += c.taps[t, k] * z
        state[(u_at + last) * lanes + i] = xi
    _drives(lanes, leaks, drives, c, u_at + last, w_at + leaks, g_at + last * drives, x_at, state)
    for t in range(drives):
        for i in range(lanes):
            smooth = state[(g_at + last * drives + t) * lanes + i]
            fades = rate * weights[length + i * each] > FADED
            state[(x_at + 5 + drives + t) * lanes + i] = state[(g_at + t) * lanes + i] - smooth if fades else 0.0
            state[(g_at + t) * lanes + i] = smooth if fades else state[(g_at + t) * lanes + i]


@jit_within
def _settle(
    marks: Any, c: Any, wide: int, each: int, u_at: int, g_at: int, w_at: int, x_at: int, weights: FloatArray,
    state: FloatArray,
) -> None:  # fmt: skip
    """Drives at the end of a step from the modes there, and the modes by these drives: N acts at full strength."""
    lanes, m, active, leaks = len(marks.lanes), len(marks.modes), len(marks.active), len(marks.leaks)
    drives, last = leaks + len(marks.bend), NODES - 1
    for i in range(lanes):
        for t in range(leaks):
            state[(w_at + leaks + t) * lanes + i] = c.tap_s[t] * state[lanes + i]
            for k in range(active):
                state[(w_at + leaks + t) * lanes + i] += c.taps[t, k] * state[(SOURCES + k) * lanes + i]
    _drives(lanes, leaks, drives, c, u_at, w_at + leaks, g_at, x_at, state)
    for i in range(lanes):
        for k in range(m):
            by = weights[(k * PER_MODE + 4 * last + last) * wide + i * each]
            for t in range(drives):
                change = state[(g_at + t) * lanes + i] - state[(g_at + last * drives + t) * lanes + i]
                state[(SOURCES + k) * lanes + i] += c.feed[k, t] * by * change
    for t in range(drives):
        for i in range(lanes):
            state[(g_at + last * drives + t) * lanes + i] = state[(g_at + t) * lanes + i]
    for t in range(leaks):
        for i in range(lanes):
            state[(w_at + t) * lanes + i] = state[(w_at + leaks + t) * lanes + i]


@jit_within
def _kinks(
    lanes: int, leaks: int, drives: int, u_at: int, w_at: int, x_at: int, kinks: FloatArray, state: FloatArray
) -> None:  # fmt: skip
    """What the rule misses of |xi| times 1 and t, in a step of length 1, and of the drives' kinks.

    On the straight line of xi from u0 to u1, which is 0 at th: int |u| = (u0^2 + u1^2) / (2 |u1 - u0|) and
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
        first = w_at + t if t < leaks else u_at
        second = w_at + leaks + t if t < leaks else u_at + NODES - 1
        for i in range(lanes):
            k0, k1, th = state[(x_at + 2) * lanes + i], state[(x_at + 3) * lanes + i], state[(x_at + 4) * lanes + i]
            w0, w1 = state[first * lanes + i], state[second * lanes + i]
            state[(x_at + 5 + t) * lanes + i] = kinks[t] * (k0 * w0 + (k0 * th + k1) * (w1 - w0))
