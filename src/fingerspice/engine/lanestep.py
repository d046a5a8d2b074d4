"""One step of many lanes: an explicit step of the exponential integrator, whose innermost loops run over the lanes.

A circuit with one finger under `local`, in modes around a reference 1/A = q0, under a source s that is straight in the
step:

    z' = -rates z + gain s + feed g,   xi = k s + shape z,   g_t = (1/A - q0) (tap_s s + taps z + bent N)_t

In a stack xi is the gap voltage u, and 1/A a polynomial in |u|. In a network N, the integral of A - 1/q0 over u, is one
more drive, behind the leaks: u + kappa N = xi, and both 1/A and N are polynomials in |xi| (`solve.netmodal`).

The drives g are taken at Lobatto's four nodes, where the state is predicted with the leaks held at their last value and
N as a line from the start of the step to the node, which is an equation for xi there. The modes' response to the source
and to the cubic through the drives is exact. Where xi crosses 0 V, g has a kink, of which the integral and the first
moment that the rule misses are known on the straight line of xi, and are added. In a network the slope of N at the end
of the step is known, too, and makes the cubic a quartic; modes that decay within a small part of a sample begin where
they soon are, and what they leave on the way decays beside them. The last modes may be passive: nothing depends on
them, such as a charge.

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
# Coefficients of the Lagrange polynomials through the nodes, and their slopes at the end of the step.
BASIS = np.ascontiguousarray(np.linalg.inv(np.vander((0.0, *INNER, 1.0), increasing=True)).T)
_END_SLOPES = BASIS @ np.array([0.0, 1.0, 2.0, 3.0])
# Weights of a mode: decay, both ends of the source, and the drive held, up to each later node; then of four drives.
PER_MODE = 4 * (NODES - 1) + NODES
# In a network behind those of all modes and the step's length: the end of a line through a drive up to each later node,
# and a slope at the end of the step.
PER_MODE_BENT = NODES
# Rows of the lanes' state before those of the modes: the source at both ends of a part, and at the last sample.
SOURCES = 3
# Time constants in a step from which on a mode is taken to follow the drives.
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
    """Constants of a circuit in this form, with T drives, of which L are leaks."""

    rates: FloatArray  # (m,): 1/s
    gain: FloatArray  # (m,)
    shape: FloatArray  # (m,): V/V
    k: float
    taps: FloatArray  # (L, m)
    # tap_s, bent (L,)
    tap_s: FloatArray
    bent: FloatArray
    feed: FloatArray  # (m, T)
    # area, slope, bend (4 j + 1,): Polynomials in `scale` |xi| + `shift`: 1/A - q0 (1/m^2), its derivative by |xi|, and
    # N (V m^2) at positive xi
    area: FloatArray
    slope: FloatArray
    bend: FloatArray
    scale: float
    shift: float
    q0: float
    kappa: float  # 1/m^2; 0 in a stack
    kinks: FloatArray  # (T,): Derivatives by |xi| at 0 V: of 1/A, and of N / xi
    fast: int  # The mode through which N acts fastest on xi


class _Rows(NamedTuple):
    """Numbers of the first rows of the state's parts."""

    xi: int  # At the nodes
    g: int  # Drives at the nodes
    w: int  # What 1/A - q0 multiplies at the start, and at the latest node
    scratch: int
    # In a network: dN/dxi at the latest node; shares of N there in xi, and in what 1/A - q0 multiplies
    rise: int
    gone: int  # What modes have beside where they soon are, and by which this changes the drives
    end: int


def rows_of(marks: Any) -> _Rows:
    """The order of the state's rows: the source's and the modes', then these."""
    m, leaks, drives = len(marks.modes), len(marks.leaks), len(marks.leaks) + len(marks.bend)
    xi = SOURCES + m
    g = xi + NODES
    w = g + NODES * drives
    scratch = w + 2 * leaks
    rise = scratch + 5 + NODES + drives
    gone = rise + 2 + leaks
    return _Rows(xi, g, w, scratch, rise, gone, gone + m + drives if drives > leaks else rise)


_rows_of = jit_within(rows_of)


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
    lanes, m, active, leaks = len(marks.lanes), len(marks.modes), len(marks.active), len(marks.leaks)
    drives, at = leaks + len(marks.bend), _rows_of(marks)
    wide, each = (lanes, 1) if len(marks.own) > 0 else (1, 0)
    length = m * PER_MODE
    for i in range(lanes):
        before = state[2 * lanes + i]
        change = after[i] - before
        state[i], state[lanes + i] = before + a * change, before + b * change
    if drives > leaks:
        _smooth(marks, c, weights, a == 0.0, state)
    for j in range(1, NODES):
        until = INNER[0] if j == 1 else INNER[1] if j == 2 else 1.0
        for i in range(lanes):
            s = state[i] + until * (state[lanes + i] - state[i])
            state[(at.xi + j) * lanes + i] = c.k * s
            for t in range(leaks):
                state[(at.w + leaks + t) * lanes + i] = c.tap_s[t] * s
            if drives > leaks:
                for t in range(1 + leaks):
                    state[(at.rise + 1 + t) * lanes + i] = 0.0
        for k in range(active):
            p, end = k * PER_MODE + 4 * (j - 1), length + 1 + k * PER_MODE_BENT + j - 1
            for i in range(lanes):
                held, fed = weights[(p + 3) * wide + i * each], 0.0
                for t in range(leaks):
                    fed += c.feed[k, t] * state[(at.g + (j - 1) * drives + t) * lanes + i]
                z = (
                    weights[p * wide + i * each] * state[(SOURCES + k) * lanes + i]
                    + weights[(p + 1) * wide + i * each] * state[i]
                    + weights[(p + 2) * wide + i * each] * state[lanes + i]
                    + held * fed
                )
                if drives > leaks:
                    by = weights[end * wide + i * each]
                    z += c.feed[k, leaks] * (held - by) * state[(at.g + leaks) * lanes + i]
                    state[(at.rise + 1) * lanes + i] += c.shape[k] * c.feed[k, leaks] * by
                    for t in range(leaks):
                        state[(at.rise + 2 + t) * lanes + i] += c.taps[t, k] * c.feed[k, leaks] * by
                state[(at.xi + j) * lanes + i] += c.shape[k] * z
                for t in range(leaks):
                    state[(at.w + leaks + t) * lanes + i] += c.taps[t, k] * z
        _drives(marks, c, j, j - 1, state)
    for i in range(lanes):
        state[(at.scratch + 1) * lanes + i] = weights[length * wide + i * each]
    _kinks(marks, c.kinks, state)
    _advance(marks, c, weights, state)
    if drives > leaks:
        _bend_end(marks, c, weights, state)
        _settle(marks, c, weights, state)
    else:
        for i in range(lanes):
            xi = c.k * state[lanes + i]
            for k in range(active):
                xi += c.shape[k] * state[(SOURCES + k) * lanes + i]
            state[at.xi * lanes + i] = xi
    for i in range(lanes):
        if b == 1.0:
            state[2 * lanes + i] = state[lanes + i]
        for t in range(drives):
            state[(at.g + t) * lanes + i] = state[(at.g + (NODES - 1) * drives + t) * lanes + i]
        for t in range(leaks):
            state[(at.w + t) * lanes + i] = state[(at.w + leaks + t) * lanes + i]


@jit_within
def _advance(marks: Any, c: Any, weights: FloatArray, state: FloatArray) -> None:
    """The modes at the end of a step, from the drives at its nodes and what the rule misses of them."""
    lanes, m, leaks, at = len(marks.lanes), len(marks.modes), len(marks.leaks), _rows_of(marks)
    drives, late_at = leaks + len(marks.bend), at.scratch + 5
    wide, each = (lanes, 1) if len(marks.own) > 0 else (1, 0)
    for k in range(m):
        p = k * PER_MODE + 4 * (NODES - 2)
        for i in range(lanes):
            # What begins at the kink decays to the end of the step, by the cubic through what begins at the nodes.
            late = state[(late_at + NODES - 1) * lanes + i]
            for j in range(NODES - 1):
                late += weights[(p - 4 * j) * wide + i * each] * state[(late_at + j) * lanes + i]
            if drives > leaks:
                late *= 1.0 if c.rates[k] * state[(at.scratch + 1) * lanes + i] < FADED else 0.0
            z = (
                weights[p * wide + i * each] * state[(SOURCES + k) * lanes + i]
                + weights[(p + 1) * wide + i * each] * state[i]
                + weights[(p + 2) * wide + i * each] * state[lanes + i]
            )
            for t in range(drives):
                fed = late * state[(late_at + NODES + t) * lanes + i]
                for j in range(NODES):
                    fed += weights[(p + 4 + j) * wide + i * each] * state[(at.g + j * drives + t) * lanes + i]
                z += c.feed[k, t] * fed
            state[(SOURCES + k) * lanes + i] = z


@jit_within
def _drives(marks: Any, c: Any, j: int, before: int, state: FloatArray) -> None:
    """Drives at node j, from xi there, but for N, and from what 1/A - q0 multiplies there.

    In a network xi = X + B N(xi), where X is given in its row, and B in the row after `rise`. It is solved once on the
    tangent of N at node `before`, and again on the one at that place.
    """
    lanes, leaks, at = len(marks.lanes), len(marks.leaks), _rows_of(marks)
    drives, x = leaks + len(marks.bend), at.scratch
    if drives > leaks:
        for i in range(lanes):
            there, bend = state[(at.xi + before) * lanes + i], state[(at.g + before * drives + leaks) * lanes + i]
            share, rest = state[(at.rise + 1) * lanes + i], state[(at.xi + j) * lanes + i]
            state[(x + 2) * lanes + i] = rest
            guess = there + (rest + share * bend - there) / (1.0 - share * state[at.rise * lanes + i])
            state[(at.xi + j) * lanes + i] = guess
    for i in range(lanes):
        state[x * lanes + i] = abs(state[(at.xi + j) * lanes + i]) * c.scale + c.shift
    _polynomial_rows(lanes, c.area, state[x * lanes :], state[(x + 1) * lanes :])
    if drives > leaks:
        _polynomial_rows(lanes, c.slope, state[x * lanes :], state[(x + 3) * lanes :])
        _polynomial_rows(lanes, c.bend, state[x * lanes :], state[(x + 4) * lanes :])
        for i in range(lanes):
            xi, q = state[(at.xi + j) * lanes + i], state[(x + 1) * lanes + i]
            bend, share = state[(x + 4) * lanes + i], state[(at.rise + 1) * lanes + i]
            bend = bend if xi >= 0.0 else -bend
            rise = rise_of(c.q0, c.kappa, q)
            change = (state[(x + 2) * lanes + i] + share * bend - xi) / (1.0 - share * rise)
            bend += rise * change
            q += state[(x + 3) * lanes + i] * (abs(xi + change) - abs(xi))
            state[(at.xi + j) * lanes + i] = xi + change
            state[(x + 1) * lanes + i] = q
            state[at.rise * lanes + i] = rise_of(c.q0, c.kappa, q)
            state[(at.g + j * drives + leaks) * lanes + i] = bend
            for t in range(leaks):
                more = c.bent[t] + state[(at.rise + 2 + t) * lanes + i]
                state[(at.w + leaks + t) * lanes + i] += more * bend
    for t in range(leaks):
        for i in range(lanes):
            w = state[(at.w + leaks + t) * lanes + i]
            state[(at.g + j * drives + t) * lanes + i] = state[(x + 1) * lanes + i] * w


@jit_within
def rise_of(q0: float, kappa: float, q: float) -> float:
    """dN/dxi where 1/A - q0 = q: e / (1 + kappa e), e = A - 1/q0."""
    return -q / (q0 * (q0 + q) - kappa * q)


@jit_within
def _rate(marks: Any, c: Any, weights: FloatArray, node: int, state: FloatArray) -> None:
    """dN/dt at node 0 or the last one into the first row of scratch; modes that have faded follow source and N."""
    lanes, active, leaks, at = len(marks.lanes), len(marks.active), len(marks.leaks), _rows_of(marks)
    drives = leaks + 1
    wide, each = (lanes, 1) if len(marks.own) > 0 else (1, 0)
    length = len(marks.modes) * PER_MODE
    for i in range(lanes):
        h = weights[length * wide + i * each]
        slope, rise = (state[lanes + i] - state[i]) / (h + 1e-300), state[at.rise * lanes + i]
        s = state[i] if node == 0 else state[lanes + i]
        rate, share = c.k * slope, 0.0
        for k in range(active):
            own = c.gain[k] * s - c.rates[k] * state[(SOURCES + k) * lanes + i]
            for t in range(drives):
                own += c.feed[k, t] * state[(at.g + node * drives + t) * lanes + i]
            follows = c.rates[k] * h > FADED
            rate += c.shape[k] * (c.gain[k] * slope / c.rates[k] if follows else own)
            share += c.shape[k] * c.feed[k, leaks] / c.rates[k] if follows else 0.0
        state[at.scratch * lanes + i] = rise * rate / (1.0 - share * rise)


@jit_within
def _smooth(marks: Any, c: Any, weights: FloatArray, begins: bool, state: FloatArray) -> None:
    """Put modes that fade within the first step of a sample where they soon are, on the new line of the source.

    What this changes of them and of the drives is kept in the rows from `gone` on.
    """
    lanes, m, active, leaks = len(marks.lanes), len(marks.modes), len(marks.active), len(marks.leaks)
    drives, last, at = leaks + 1, NODES - 1, _rows_of(marks)
    wide, each = (lanes, 1) if len(marks.own) > 0 else (1, 0)
    for i in range((m + drives) * lanes):
        state[at.gone * lanes + i] = 0.0
    fades = False
    for i in range(lanes if each else 1):
        fades = fades or c.rates[c.fast] * weights[m * PER_MODE * wide + i * each] > FADED
    if not (begins and fades):
        return
    _rate(marks, c, weights, 0, state)
    for i in range(lanes):
        s, h = state[i], weights[m * PER_MODE * wide + i * each]
        slope = (state[lanes + i] - s) / (h + 1e-300)
        xi = c.k * s
        for t in range(leaks):
            state[(at.w + leaks + t) * lanes + i] = c.tap_s[t] * s
        for k in range(active):
            z, rate = state[(SOURCES + k) * lanes + i], c.rates[k]
            if rate * h > FADED:
                fed = c.gain[k] * s
                for t in range(drives):
                    fed += c.feed[k, t] * state[(at.g + t) * lanes + i]
                changes = c.gain[k] * slope + c.feed[k, leaks] * state[at.scratch * lanes + i]
                soon = (fed - changes / rate) / rate
                state[(at.gone + k) * lanes + i] = z - soon
                state[(SOURCES + k) * lanes + i] = soon
                z = soon
            xi += c.shape[k] * z
            for t in range(leaks):
                state[(at.w + leaks + t) * lanes + i] += c.taps[t, k] * z
        state[(at.xi + last) * lanes + i] = xi
        for t in range(1 + leaks):
            state[(at.rise + 1 + t) * lanes + i] = 0.0
    _drives(marks, c, last, 0, state)
    for i in range(lanes):
        state[at.xi * lanes + i] = state[(at.xi + last) * lanes + i]
        for t in range(drives):
            smooth = state[(at.g + last * drives + t) * lanes + i]
            state[(at.gone + m + t) * lanes + i] = state[(at.g + t) * lanes + i] - smooth
            state[(at.g + t) * lanes + i] = smooth
        for t in range(leaks):
            state[(at.w + t) * lanes + i] = state[(at.w + leaks + t) * lanes + i]


@jit_within
def _bend_end(marks: Any, c: Any, weights: FloatArray, state: FloatArray) -> None:
    """Add the modes' response to what the cubic through N lacks, whose slope at the end of the step is known."""
    lanes, m, leaks, at = len(marks.lanes), len(marks.modes), len(marks.leaks), _rows_of(marks)
    drives = leaks + 1
    wide, each = (lanes, 1) if len(marks.own) > 0 else (1, 0)
    _rate(marks, c, weights, NODES - 1, state)
    for i in range(lanes):
        lacks = state[at.scratch * lanes + i] * weights[m * PER_MODE * wide + i * each]
        for j in range(NODES):
            lacks -= _END_SLOPES[j] * state[(at.g + j * drives + leaks) * lanes + i]
        state[at.scratch * lanes + i] = lacks
    for k in range(m):
        p = m * PER_MODE + 1 + k * PER_MODE_BENT + NODES - 1
        for i in range(lanes):
            by = c.feed[k, leaks] * weights[p * wide + i * each]
            state[(SOURCES + k) * lanes + i] += by * state[at.scratch * lanes + i]


@jit_within
def _settle(marks: Any, c: Any, weights: FloatArray, state: FloatArray) -> None:
    """N at the end of a step anew with the modes there, and modes and drives by it; then what fades in the step."""
    lanes, m, active, leaks = len(marks.lanes), len(marks.modes), len(marks.active), len(marks.leaks)
    drives, last, at = leaks + 1, NODES - 1, _rows_of(marks)
    wide, each = (lanes, 1) if len(marks.own) > 0 else (1, 0)
    by = 4 * last + last
    for i in range(lanes):
        bend, xi, share = state[(at.g + last * drives + leaks) * lanes + i], c.k * state[lanes + i], 0.0
        state[(at.g + leaks) * lanes + i] = bend
        state[at.xi * lanes + i] = state[(at.xi + last) * lanes + i]
        for k in range(active):
            xi += c.shape[k] * state[(SOURCES + k) * lanes + i]
            share += c.shape[k] * c.feed[k, leaks] * weights[(k * PER_MODE + by) * wide + i * each]
        state[(at.xi + last) * lanes + i] = xi - share * bend
        state[(at.rise + 1) * lanes + i] = share
        for t in range(leaks):
            w, more = c.tap_s[t] * state[lanes + i], 0.0
            for k in range(active):
                own = c.feed[k, leaks] * weights[(k * PER_MODE + by) * wide + i * each]
                w += c.taps[t, k] * (state[(SOURCES + k) * lanes + i] - own * bend)
                more += c.taps[t, k] * own
            state[(at.w + leaks + t) * lanes + i] = w
            state[(at.rise + 2 + t) * lanes + i] = more
    _drives(marks, c, last, 0, state)
    rate = c.rates[c.fast]
    for i in range(lanes):
        change = state[(at.g + last * drives + leaks) * lanes + i] - state[(at.g + leaks) * lanes + i]
        state[at.xi * lanes + i] = state[(at.xi + last) * lanes + i]
        h = weights[m * PER_MODE * wide + i * each]
        faded = weights[(c.fast * PER_MODE + 4 * (last - 1)) * wide + i * each]
        for k in range(m):
            decay = weights[(k * PER_MODE + 4 * (last - 1)) * wide + i * each]
            apart = c.rates[k] - rate
            pulse = h * faded if abs(apart) < 1e-6 * rate else (faded - decay) / apart
            fed = 0.0
            for t in range(drives):
                fed += c.feed[k, t] * state[(at.gone + m + t) * lanes + i]
            left = decay * state[(at.gone + k) * lanes + i]
            if k < active:
                state[at.xi * lanes + i] += c.shape[k] * left
            more = c.feed[k, leaks] * weights[(k * PER_MODE + by) * wide + i * each] * change
            state[(SOURCES + k) * lanes + i] += more + left + pulse * fed
        for t in range(drives):
            state[(at.g + last * drives + t) * lanes + i] += faded * state[(at.gone + m + t) * lanes + i]


@jit_within
def _kinks(marks: Any, kinks: FloatArray, state: FloatArray) -> None:
    """What the rule misses of |xi| times 1 and t, in a step of length 1, and of the drives' kinks.

    On the straight line of xi from u0 to u1, which is 0 at th: int |u| = (u0^2 + u1^2) / (2 |u1 - u0|) and
    int |u| (t - th) = |u1 - u0| ((1 - th)^3 - th^3) / 3, less Lobatto's sums of both.
    """
    lanes, leaks, drives = len(marks.lanes), len(marks.leaks), len(marks.leaks) + len(marks.bend)
    at = _rows_of(marks)
    x = at.scratch
    for i in range(lanes):
        u0, u1 = state[at.xi * lanes + i], state[(at.xi + NODES - 1) * lanes + i]
        d = u1 - u0
        over = 1.0 / (abs(d) + 1e-300)
        th = abs(u0) * over
        om = 1.0 - th
        c0, c1 = _OUTER_WEIGHT * abs(u0), _OUTER_WEIGHT * abs(u1)
        e0, e1 = _INNER_WEIGHT * abs(u0 + INNER[0] * d), _INNER_WEIGHT * abs(u0 + INNER[1] * d)
        k0 = 0.5 * (u0 * u0 + u1 * u1) * over - c0 - c1 - e0 - e1
        k1 = abs(d) * (om * om * om - th * th * th) / 3.0
        k1 += c0 * th - c1 * om - e0 * (INNER[0] - th) - e1 * (INNER[1] - th)
        crossed, length = u0 * u1 < 0.0, state[(x + 1) * lanes + i]
        state[(x + 2) * lanes + i] = k0 if crossed else 0.0
        state[(x + 3) * lanes + i] = k1 if crossed else 0.0
        state[(x + 4) * lanes + i] = th if crossed else 0.0
        for j in range(NODES):
            share = BASIS[j, 0] + th * (BASIS[j, 1] + th * (BASIS[j, 2] + th * BASIS[j, 3]))
            state[(x + 5 + j) * lanes + i] = length * share if crossed else 0.0
    for t in range(drives):
        first, second = (at.w + t, at.w + leaks + t) if t < leaks else (at.xi, at.xi + NODES - 1)
        for i in range(lanes):
            k0, k1, th = state[(x + 2) * lanes + i], state[(x + 3) * lanes + i], state[(x + 4) * lanes + i]
            w0, w1 = state[first * lanes + i], state[second * lanes + i]
            state[(x + 5 + NODES + t) * lanes + i] = kinks[t] * (k0 * w0 + (k0 * th + k1) * (w1 - w0))
