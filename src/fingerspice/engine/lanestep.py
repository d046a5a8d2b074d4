"""One step of many lanes: an explicit step of the exponential integrator, whose innermost loops run over the lanes.

A circuit with one finger under `local`, in modes around a reference 1/A = q0, under a source s that is straight in the
step:

    z' = -rates z + gain s + feed g,   xi = k s + shape z,   g_t = (1/A - q0) (tap_s s + taps z + bent N)_t

In a stack xi is the gap voltage u, and 1/A a polynomial in |u|. In a network N, the integral of A - 1/q0 over u, is one
more drive, behind the leaks: u + kappa N = xi, and both 1/A and N are polynomials in |xi| (`solve.netmodal`).

The drives g are taken at Lobatto's four nodes. There the state of a stack is predicted with the drives held at their
last value; in a network with the polynomial through the leaks at the nodes before and through N at these and the node
itself, which is an equation for xi. The modes' response to the source and to the cubic through the drives is exact.
Where xi crosses 0 V, g has a kink, of which the integral and the first moment that the rule misses are known on the
straight line of xi, and are added. In a network the slope of N at the end of the step is known, too, and makes the
cubic a quartic; modes that decay within a small part of a sample begin where they soon are, and what they leave on the
way decays beside them. The last modes may be passive: nothing depends on them, such as a charge.

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
# In a network behind those of all modes and the step's length, for each mode: for node j of the later ones leaks at the
# j nodes before, from row j^2 - 1 on, and N at these and itself; then a slope at the end of the step. Behind them, for
# each of these nodes, the share of N there in xi and in what 1/A - q0 multiplies.
PER_MODE_BENT = NODES**2
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
    q: int  # In a network: 1/A - q0 at the latest node, its derivative by |xi|, and dN/dxi where fading modes soon are
    gone: int  # What modes have beside where they soon are, and by which this changes the drives
    end: int


def rows_of(marks: Any) -> _Rows:
    """The order of the state's rows: the source's and the modes', then these."""
    m, leaks, drives = len(marks.modes), len(marks.leaks), len(marks.leaks) + len(marks.bend)
    xi = SOURCES + m
    g = xi + NODES
    w = g + NODES * drives
    scratch = w + 2 * leaks
    q = scratch + 5 + NODES + drives
    return _Rows(xi, g, w, scratch, q, q + 3, q + 3 + m + drives if drives > leaks else q)


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
    fades = drives > leaks and a == 0.0 and _smooth(marks, c, weights, state)
    for j in range(1, NODES):
        until = INNER[0] if j == 1 else INNER[1] if j == 2 else 1.0
        for i in range(lanes):
            s = state[i] + until * (state[lanes + i] - state[i])
            state[(at.xi + j) * lanes + i] = c.k * s
            for t in range(leaks):
                state[(at.w + leaks + t) * lanes + i] = c.tap_s[t] * s
        for k in range(active):
            p = k * PER_MODE + 4 * (j - 1)
            for i in range(lanes):
                state[at.scratch * lanes + i] = (
                    weights[p * wide + i * each] * state[(SOURCES + k) * lanes + i]
                    + weights[(p + 1) * wide + i * each] * state[i]
                    + weights[(p + 2) * wide + i * each] * state[lanes + i]
                )
            if drives > leaks:
                _add_predicted(marks, c, k, j, weights, state)
            else:
                for i in range(lanes):
                    fed = 0.0
                    for t in range(leaks):
                        fed += c.feed[k, t] * state[(at.g + (j - 1) * drives + t) * lanes + i]
                    state[at.scratch * lanes + i] += weights[(p + 3) * wide + i * each] * fed
            for i in range(lanes):
                z = state[at.scratch * lanes + i]
                state[(at.xi + j) * lanes + i] += c.shape[k] * z
                for t in range(leaks):
                    state[(at.w + leaks + t) * lanes + i] += c.taps[t, k] * z
        _drives(marks, c, weights, j, j - 1, j - 1, state)
    for i in range(lanes):
        state[(at.scratch + 1) * lanes + i] = weights[length * wide + i * each]
    _kinks(marks, c.kinks, state)
    _advance(marks, c, weights, state)
    if drives > leaks:
        _bend_end(marks, c, weights, state)
        if fades:
            _fade(marks, c, weights, state)
        _end(marks, c, state)
    else:
        for i in range(lanes):
            xi = c.k * state[lanes + i]
            for k in range(active):
                xi += c.shape[k] * state[(SOURCES + k) * lanes + i]
            state[at.xi * lanes + i] = xi
            for t in range(drives):
                state[(at.g + t) * lanes + i] = state[(at.g + (NODES - 1) * drives + t) * lanes + i]
            for t in range(leaks):
                state[(at.w + t) * lanes + i] = state[(at.w + leaks + t) * lanes + i]
    if b == 1.0:
        for i in range(lanes):
            state[2 * lanes + i] = state[lanes + i]


@jit_within
def _add_predicted(marks: Any, c: Any, k: int, j: int, weights: FloatArray, state: FloatArray) -> None:
    """Add mode k's response to leaks and N at the nodes before j to the first row of scratch."""
    lanes, leaks, at = len(marks.lanes), len(marks.leaks), _rows_of(marks)
    drives, own = leaks + 1, len(marks.modes) * PER_MODE + k * PER_MODE_BENT + j * j
    wide, each = (lanes, 1) if len(marks.own) > 0 else (1, 0)
    for node in range(j):
        for i in range(lanes):
            fed = 0.0
            for t in range(leaks):
                fed += c.feed[k, t] * state[(at.g + node * drives + t) * lanes + i]
            bend = c.feed[k, leaks] * state[(at.g + node * drives + leaks) * lanes + i]
            by_leaks, by_bend = weights[(own + node) * wide + i * each], weights[(own + j + node) * wide + i * each]
            state[at.scratch * lanes + i] += by_leaks * fed + by_bend * bend


@jit_within
def _end(marks: Any, c: Any, state: FloatArray) -> None:
    """xi and the drives at the end of a step, from the modes there and on the tangents at the last node, to node 0."""
    lanes, active, leaks, at = len(marks.lanes), len(marks.active), len(marks.leaks), _rows_of(marks)
    drives, last = leaks + 1, NODES - 1
    for i in range(lanes):
        state[at.xi * lanes + i] = c.k * state[lanes + i]
        for t in range(leaks):
            state[(at.w + t) * lanes + i] = c.tap_s[t] * state[lanes + i]
    for k in range(active):
        for i in range(lanes):
            z = state[(SOURCES + k) * lanes + i]
            state[at.xi * lanes + i] += c.shape[k] * z
            for t in range(leaks):
                state[(at.w + t) * lanes + i] += c.taps[t, k] * z
    for i in range(lanes):
        xi, found, q = state[at.xi * lanes + i], state[(at.xi + last) * lanes + i], state[at.q * lanes + i]
        bend = state[(at.g + last * drives + leaks) * lanes + i]
        bend -= q / (c.q0 * (c.q0 + q) - c.kappa * q) * (xi - found)
        q += state[(at.q + 1) * lanes + i] * (abs(xi) - abs(found))
        state[at.q * lanes + i], state[(at.g + leaks) * lanes + i] = q, bend
        for t in range(leaks):
            w = state[(at.w + t) * lanes + i] + c.bent[t] * bend
            state[(at.w + t) * lanes + i], state[(at.g + t) * lanes + i] = w, q * w


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
def _drives(marks: Any, c: Any, weights: FloatArray, j: int, before: int, shared: int, state: FloatArray) -> None:
    """Drives at node j, from xi there, but for N, and from what 1/A - q0 multiplies there.

    In a network xi = X + B N(xi), where X is given, and B is the share number `shared`, or 0 if that is negative. It is
    solved on the tangent of N at node `before`, and once more on the one at the place that is found. Tangents have the
    slope -q / d, d = q0 (q0 + q) - kappa q, where 1/A = q0 + q.
    """
    lanes, leaks, at = len(marks.lanes), len(marks.leaks), _rows_of(marks)
    drives, x = leaks + len(marks.bend), at.scratch
    wide, each = (lanes, 1) if len(marks.own) > 0 else (1, 0)
    count = len(marks.modes)
    share_at, on = count * (PER_MODE + PER_MODE_BENT) + 1 + max(shared, 0) * (1 + leaks), 1.0 if shared >= 0 else 0.0
    if drives > leaks:
        for i in range(lanes):
            there, bend = state[(at.xi + before) * lanes + i], state[(at.g + before * drives + leaks) * lanes + i]
            share, q = on * weights[share_at * wide + i * each], state[at.q * lanes + i]
            without = state[(at.xi + j) * lanes + i]
            d = c.q0 * (c.q0 + q) - c.kappa * q
            state[(x + 2) * lanes + i] = without
            state[(at.xi + j) * lanes + i] = there + d * ((without + share * bend - there) / (d + share * q))
    for i in range(lanes):
        state[x * lanes + i] = abs(state[(at.xi + j) * lanes + i]) * c.scale + c.shift
    _polynomial_rows(lanes, c.area, state[x * lanes :], state[(x + 1) * lanes :])
    if drives > leaks:
        _polynomial_rows(lanes, c.slope, state[x * lanes :], state[(at.q + 1) * lanes :])
        _polynomial_rows(lanes, c.bend, state[x * lanes :], state[(x + 4) * lanes :])
        for i in range(lanes):
            xi, q, share = (
                state[(at.xi + j) * lanes + i],
                state[(x + 1) * lanes + i],
                on * weights[share_at * wide + i * each],
            )
            bend = state[(x + 4) * lanes + i]
            bend = bend if xi >= 0.0 else -bend
            d = c.q0 * (c.q0 + q) - c.kappa * q
            by = (state[(x + 2) * lanes + i] + share * bend - xi) / (d + share * q)
            bend -= q * by
            found = xi + d * by
            q += state[(at.q + 1) * lanes + i] * (abs(found) - abs(xi))
            state[(at.xi + j) * lanes + i] = found
            state[(x + 1) * lanes + i] = q
            state[at.q * lanes + i] = q
            state[(at.g + j * drives + leaks) * lanes + i] = bend
            for t in range(leaks):
                more = c.bent[t] + on * weights[(share_at + 1 + t) * wide + i * each]
                state[(at.w + leaks + t) * lanes + i] += more * bend
    for t in range(leaks):
        for i in range(lanes):
            w = state[(at.w + leaks + t) * lanes + i]
            state[(at.g + j * drives + t) * lanes + i] = state[(x + 1) * lanes + i] * w


@jit_within
def _changes(marks: Any, c: Any, weights: FloatArray, node: int, state: FloatArray) -> None:
    """Change of N in a step at its rate at node 0 or the last one, into the first row of scratch.

    Modes that have faded follow the source and N.
    """
    lanes, active, leaks, at = len(marks.lanes), len(marks.active), len(marks.leaks), _rows_of(marks)
    drives, x = leaks + 1, at.scratch
    wide, each = (lanes, 1) if len(marks.own) > 0 else (1, 0)
    length = len(marks.modes) * PER_MODE
    for i in range(lanes):
        state[x * lanes + i] = c.k * (state[lanes + i] - state[i])
        state[(x + 2) * lanes + i] = 0.0
    for k in range(active):
        rate, over, shape, gain, feed = c.rates[k], 1.0 / (c.rates[k] + 1e-300), c.shape[k], c.gain[k], c.feed[k, leaks]
        for i in range(lanes):
            h = weights[length * wide + i * each]
            own = gain * (state[i] if node == 0 else state[lanes + i]) - rate * state[(SOURCES + k) * lanes + i]
            for t in range(drives):
                own += c.feed[k, t] * state[(at.g + node * drives + t) * lanes + i]
            follows = rate * h > FADED
            state[x * lanes + i] += shape * (gain * (state[lanes + i] - state[i]) * over if follows else h * own)
            state[(x + 2) * lanes + i] += shape * feed * over if follows else 0.0
    for i in range(lanes):
        q = state[at.q * lanes + i]
        d = c.q0 * (c.q0 + q) - c.kappa * q
        state[x * lanes + i] *= -q / (d + state[(x + 2) * lanes + i] * q)


@jit_within
def _smooth(marks: Any, c: Any, weights: FloatArray, state: FloatArray) -> bool:
    """Put modes that fade within the first step of a sample where they soon are, on the new line of the source.

    What this changes of them and of the drives is kept in the rows from `gone` on. Whether there are such modes.
    """
    lanes, m, active, leaks = len(marks.lanes), len(marks.modes), len(marks.active), len(marks.leaks)
    drives, last, at = leaks + 1, NODES - 1, _rows_of(marks)
    wide, each = (lanes, 1) if len(marks.own) > 0 else (1, 0)
    fades = False
    for i in range(lanes if len(marks.own) > 0 else 1):
        fades = fades or c.rates[c.fast] * weights[m * PER_MODE * wide + i * each] > FADED
    if not fades:
        return False
    _changes(marks, c, weights, 0, state)
    for i in range(lanes):
        state[(at.xi + last) * lanes + i] = c.k * state[i]
        for t in range(leaks):
            state[(at.w + leaks + t) * lanes + i] = c.tap_s[t] * state[i]
    for k in range(active):
        rate, over, gain, feed = c.rates[k], 1.0 / (c.rates[k] + 1e-300), c.gain[k], c.feed[k, leaks]
        for i in range(lanes):
            z, h = state[(SOURCES + k) * lanes + i], weights[m * PER_MODE * wide + i * each]
            fed = gain * state[i]
            for t in range(drives):
                fed += c.feed[k, t] * state[(at.g + t) * lanes + i]
            changes = gain * (state[lanes + i] - state[i]) + feed * state[at.scratch * lanes + i]
            soon = (fed - changes / (rate * h + 1e-300)) * over
            soon = soon if rate * h > FADED else z
            state[(at.gone + k) * lanes + i] = z - soon
            state[(SOURCES + k) * lanes + i] = soon
            state[(at.xi + last) * lanes + i] += c.shape[k] * soon
            for t in range(leaks):
                state[(at.w + leaks + t) * lanes + i] += c.taps[t, k] * soon
    _drives(marks, c, weights, last, 0, -1, state)
    for i in range(lanes):
        state[at.xi * lanes + i] = state[(at.xi + last) * lanes + i]
        state[(at.q + 2) * lanes + i] = rise_of(c.q0, c.kappa, state[at.q * lanes + i])
        for k in range(active, m):
            state[(at.gone + k) * lanes + i] = 0.0
        for t in range(drives):
            smooth = state[(at.g + last * drives + t) * lanes + i]
            state[(at.gone + m + t) * lanes + i] = state[(at.g + t) * lanes + i] - smooth
            state[(at.g + t) * lanes + i] = smooth
        for t in range(leaks):
            state[(at.w + t) * lanes + i] = state[(at.w + leaks + t) * lanes + i]
    return True


@jit_within
def _bend_end(marks: Any, c: Any, weights: FloatArray, state: FloatArray) -> None:
    """Add the modes' response to what the cubic through N lacks, whose slope at the end of the step is known."""
    lanes, m, leaks, at = len(marks.lanes), len(marks.modes), len(marks.leaks), _rows_of(marks)
    drives = leaks + 1
    wide, each = (lanes, 1) if len(marks.own) > 0 else (1, 0)
    _changes(marks, c, weights, NODES - 1, state)
    for i in range(lanes):
        for j in range(NODES):
            of_cubic = _END_SLOPES[j] * state[(at.g + j * drives + leaks) * lanes + i]
            state[at.scratch * lanes + i] -= of_cubic
    for k in range(m):
        p = m * PER_MODE + (k + 1) * PER_MODE_BENT
        for i in range(lanes):
            by = c.feed[k, leaks] * weights[p * wide + i * each]
            state[(SOURCES + k) * lanes + i] += by * state[at.scratch * lanes + i]


@jit_within
def _fade(marks: Any, c: Any, weights: FloatArray, state: FloatArray) -> None:
    """Add what is left of what `_smooth` has taken, and the modes' response to it by N and, as one, by the leaks."""
    lanes, m, active, leaks = len(marks.lanes), len(marks.modes), len(marks.active), len(marks.leaks)
    at, wide, each = _rows_of(marks), 1, 0
    if len(marks.own) > 0:
        wide, each = lanes, 1
    end = 4 * (NODES - 2)
    for k in range(m):
        for f in range(active):
            apart = c.rates[k] - c.rates[f]
            over, alike = 1.0 / (apart if apart != 0.0 else 1.0), abs(apart) <= 1e-6 * c.rates[f]
            for i in range(lanes):
                decay, faded = (
                    weights[(k * PER_MODE + end) * wide + i * each],
                    weights[(f * PER_MODE + end) * wide + i * each],
                )
                gone = state[(at.gone + f) * lanes + i]
                fed = c.feed[k, leaks] * state[(at.q + 2) * lanes + i] * c.shape[f] * gone
                if f == c.fast:
                    for t in range(leaks):
                        fed += c.feed[k, t] * state[(at.gone + m + t) * lanes + i]
                pulse = weights[m * PER_MODE * wide + i * each] * faded if alike else (faded - decay) * over
                state[(SOURCES + k) * lanes + i] += pulse * fed + (decay * gone if k == f else 0.0)


@jit_within
def rise_of(q0: float, kappa: float, q: float) -> float:
    """dN/dxi where 1/A = q0 + q: e / (1 + kappa e), e = A - 1/q0."""
    return -q / (q0 * (q0 + q) - kappa * q)


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
