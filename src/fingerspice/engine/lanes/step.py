"""One step of many lanes: an explicit step of the exponential integrator, whose innermost loops run over the lanes.

A circuit with one finger, in modes around a reference 1/A = q0, under a source s that is straight in the
step:

    z' = -rates z + gain s + feed g,   xi = k s + shape z,   g_t = (1/A - q0) (tap_s s + taps z + bent N)_t

In a stack xi is the gap voltage u, and 1/A a polynomial in |u|; under `mobile` u follows from xi and the part of it
that the modes have: with 1/A = q0 + q it is u = X + B q(u), X = k s + shape z, B = (X - k s) / q0, and the last drive
is g = A - 1/q0 times s. Where X has a share S of it, X = Y + S g, that is u = Y + C q(u) with
C = (Y - (k + S / q0) s) / q0. In a network N, the integral of A - 1/q0 over u, is one more drive, behind
the leaks: u + kappa N = xi, and both 1/A and N are polynomials in |xi| (`solve.recordings.networks`).

The drives g are taken at the nodes of Lobatto's rule with four of them, or of Simpson's for larger errors. There the
state is predicted with polynomials through the leaks at the nodes before, and through N at these and the node itself,
which is an equation for xi. The modes' response to the source and to the polynomial through the drives is exact. Where
xi crosses 0 V, g has a kink, of which the integral and the first moment that the rule misses are known on the straight
line of xi, and are added. In a network the slope of N at the end of the step is known, too, and makes the cubic a
quartic; modes that decay within a small part of a sample begin where they soon are, and what they leave on the way
decays beside them. The last modes may be passive: nothing depends on them, such as a charge.
"""

from __future__ import annotations

from typing import Any

from fingerspice.base.arrays import FloatArray
from fingerspice.base.compiled import jit_by_kind, jit_rows, jit_within_rows
from fingerspice.engine.lanes.bend import bent_drives_at, end_bent, smooth
from fingerspice.engine.lanes.rows import (
    PLACES,
    QUICK,
    SOURCES,
    WEIGHTS,
    places,
    polynomial_rows,
    project,
    weights_of,
)

# The compiler makes no products of divisions.
THIRD, SIXTH = 1.0 / 3.0, 1.0 / 6.0


@jit_within_rows
def _drives_under_mobile(marks: Any, c: Any, weights: FloatArray, j: int, state: FloatArray) -> None:
    """Gap voltage and drives at node j, or for 0 at the end, from Y there, and from what multiplies 1/A - q0 there.

    The equation is solved on the tangent of q at the node before, and once more on the one at the place that is found.
    """
    lanes, leaks, at = len(marks.lanes), len(marks.leaks), places(marks)
    wide, each = (lanes, 1) if len(marks.own) > 0 else (1, 0)
    x, over, flat, one = at.scratch, 1.0 / c.q0, at.flat + (0 if j == 0 else 1), weights_of(marks).one
    # At the end X is known.
    on, until = 1.0 if j > 0 else 0.0, PLACES[len(marks.inner) - 1, j] if j > 0 else 1.0
    before = j - 1 if j > 0 else len(marks.inner) + 1
    share_at = weights_of(marks).node + (max(j, 1) - 1) * (1 + leaks) * one + one - 1
    for i in range(lanes):
        source = state[i] + until * (state[lanes + i] - state[i])
        whole, there, q = state[(at.xi + j) * lanes + i], state[(at.xi + before) * lanes + i], state[at.q * lanes + i]
        share = (whole - (c.k + on * weights[share_at * wide + i * each] * over) * source) * over
        u = there + (whole + share * q - there) / (1.0 - share * state[(at.q + 1) * lanes + i])
        state[(at.q + 2) * lanes + i] = share
        state[flat * lanes + i] = whole + share * c.rest
        state[(at.xi + j) * lanes + i] = u
        state[x * lanes + i] = abs(u) * c.scale + c.shift
        state[(x + 2) * lanes + i] = whole
        state[(x + 4) * lanes + i] = source
    polynomial_rows(lanes, c.area, state[x * lanes :], state[(x + 1) * lanes :])
    polynomial_rows(lanes, c.slope, state[x * lanes :], state[(x + 3) * lanes :])
    for i in range(lanes):
        u, q, share = state[(at.xi + j) * lanes + i], state[(x + 1) * lanes + i], state[(at.q + 2) * lanes + i]
        slope = state[(x + 3) * lanes + i]
        slope = slope if u >= 0.0 else -slope
        by = (state[(x + 2) * lanes + i] + share * q - u) / (1.0 - share * slope)
        q += slope * by
        state[(at.xi + j) * lanes + i] = u + by
        state[at.q * lanes + i], state[(at.q + 1) * lanes + i] = q, slope
        if j == 0:
            state[at.fold * lanes + i] = max(state[at.fold * lanes + i], share * slope)
        last = -q / (c.q0 * (c.q0 + q)) * state[(x + 4) * lanes + i]
        state[(at.g + j * (leaks + 1) + leaks) * lanes + i] = last
        for t in range(leaks):
            w = state[(at.w + leaks + t) * lanes + i]
            w += on * weights[(share_at + (1 + t) * one) * wide + i * each] * last
            state[(at.w + leaks + t) * lanes + i] = w
            state[(at.g + j * (leaks + 1) + t) * lanes + i] = q * w


@jit_within_rows
def _drives_of_stack(marks: Any, c: Any, weights: FloatArray, j: int, state: FloatArray) -> None:
    lanes, leaks, at = len(marks.lanes), len(marks.leaks), places(marks)
    x = at.scratch
    for i in range(lanes):
        state[x * lanes + i] = abs(state[(at.xi + j) * lanes + i]) * c.scale + c.shift
    polynomial_rows(lanes, c.area, state[x * lanes :], state[(x + 1) * lanes :])
    for i in range(lanes):
        q = state[(x + 1) * lanes + i]
        for t in range(leaks):
            state[(at.g + j * leaks + t) * lanes + i] = q * state[(at.w + leaks + t) * lanes + i]


@jit_within_rows
def _begin_at_once(marks: Any, c: Any, weights: FloatArray, a: float, state: FloatArray) -> bool:
    return False


@jit_within_rows
def _end_of_stack(marks: Any, c: Any, weights: FloatArray, fades: bool, state: FloatArray) -> None:
    lanes, leaks, at = len(marks.lanes), len(marks.leaks), places(marks)
    _add_kinks(marks, c, weights, state)
    project(marks, c, 1, at.xi, state)
    for t in range(leaks):
        for i in range(lanes):
            state[(at.g + t) * lanes + i] = state[(at.g + (len(marks.inner) + 1) * leaks + t) * lanes + i]
            state[(at.w + t) * lanes + i] = state[(at.w + leaks + t) * lanes + i]


@jit_within_rows
def _end_under_mobile(marks: Any, c: Any, weights: FloatArray, fades: bool, state: FloatArray) -> None:
    lanes, leaks, at = len(marks.lanes), len(marks.leaks), places(marks)
    _add_kinks(marks, c, weights, state)
    project(marks, c, 1, at.xi, state)
    _drives_under_mobile(marks, c, weights, 0, state)
    for t in range(leaks):
        for i in range(lanes):
            state[(at.w + t) * lanes + i] = state[(at.w + leaks + t) * lanes + i]


def _of_kind(*given: Any) -> Any:
    """Stands for the functions below in Python; compiled code calls one of those named there."""
    raise NotImplementedError


# Prepare a step that begins at the part `a` of a sample: whether modes fade in it.
_begin = jit_by_kind(StackMarks=_begin_at_once, MobileMarks=_begin_at_once, NetworkMarks=smooth)(_of_kind)
# Drives at a later node j from what is predicted there.
_drives_at = jit_by_kind(
    StackMarks=_drives_of_stack, MobileMarks=_drives_under_mobile, NetworkMarks=bent_drives_at
)(_of_kind)  # fmt: skip
# From the modes at the end of a step, xi and the drives there, for the start of the next one.
_end = jit_by_kind(StackMarks=_end_of_stack, MobileMarks=_end_under_mobile, NetworkMarks=end_bent)(_of_kind)


@jit_rows
def step(marks: Any, c: Any, weights: FloatArray, state: FloatArray, after: FloatArray, a: float, b: float) -> None:
    """Advance every lane by the part of a sample from `a` to `b`; the source goes from its last sample to `after`.

    `weights` are those of the part's length.
    """
    lanes = len(marks.lanes)
    for i in range(lanes):
        before = state[2 * lanes + i]
        change = after[i] - before
        state[i], state[lanes + i] = before + a * change, before + b * change
    fades = _begin(marks, c, weights, a, state)
    # Numbers that the compiler knows: it then unrolls the sums in them.
    _at_node(marks, c, weights, 1, state)
    _at_node(marks, c, weights, 2, state)
    if len(marks.inner) > 1:
        _at_node(marks, c, weights, 3, state)
    _kinks(marks, c, state)
    _advance(marks, c, weights, state)
    _end(marks, c, weights, fades, state)
    if b == 1.0:
        for i in range(lanes):
            state[2 * lanes + i] = state[lanes + i]


@jit_within_rows
def _at_node(marks: Any, c: Any, weights: FloatArray, j: int, state: FloatArray) -> None:
    _predict(marks, weights, j, state)
    _drives_at(marks, c, weights, j, state)


@jit_within_rows
def _predict(marks: Any, weights: FloatArray, j: int, state: FloatArray) -> None:
    """xi at node j, and what 1/A - q0 multiplies there, from the start of the step and the drives at earlier nodes."""
    lanes, active, leaks = len(marks.lanes), len(marks.active), len(marks.leaks)
    at, rows = places(marks), weights_of(marks)
    wide, each = (lanes, 1) if len(marks.own) > 0 else (1, 0)
    for i in range(lanes):
        for p in range(1 + leaks):
            first = rows.node + ((j - 1) * (1 + leaks) + p) * rows.one
            to = at.xi + j if p == 0 else at.w + leaks + p - 1
            x = weights[first * wide + i * each] * state[i] + weights[(first + 1) * wide + i * each] * state[lanes + i]
            for k in range(active):
                x += weights[(first + 2 + k) * wide + i * each] * state[(SOURCES + k) * lanes + i]
            for n in range(j * (leaks + len(marks.bend))):
                x += weights[(first + 2 + active + n) * wide + i * each] * state[(at.g + n) * lanes + i]
            state[to * lanes + i] = x


@jit_within_rows
def _advance(marks: Any, c: Any, weights: FloatArray, state: FloatArray) -> None:
    """The modes at the end of a step, from the drives at its nodes and what the rule misses of them."""
    lanes, leaks, at = len(marks.lanes), len(marks.leaks), places(marks)
    drives, nodes = leaks + len(marks.bend), len(marks.inner) + 2
    wide, each = (lanes, 1) if len(marks.own) > 0 else (1, 0)
    for k in range(len(marks.modes)):
        p = k * weights_of(marks).mode
        for i in range(lanes):
            th, late = state[(at.scratch + 4) * lanes + i], weights[(p + nodes) * wide + i * each]
            for j in range(nodes - 1, 0, -1):
                late = late * th + weights[(p + j) * wide + i * each]
            z = (
                weights[p * wide + i * each] * state[(SOURCES + k) * lanes + i]
                + weights[(p + nodes + 1) * wide + i * each] * state[i]
                + weights[(p + nodes + 2) * wide + i * each] * state[lanes + i]
            )
            for t in range(drives):
                z += c.feed[k, t] * late * state[(at.scratch + 5 + t) * lanes + i]
            for n in range(nodes * drives):
                z += weights[(p + nodes + 3 + n) * wide + i * each] * state[(at.g + n) * lanes + i]
            state[(SOURCES + k) * lanes + i] = z


@jit_within_rows
def _add_kinks_to(marks: Any, c: Any, k: int, weights: FloatArray, state: FloatArray) -> None:
    """Add the response of mode k, which decays fast, to what the cubics miss of the drives' kinks.

    These begin at th with a straight line and a square, to which the response is known.
    """
    lanes, leaks, at = len(marks.lanes), len(marks.leaks), places(marks)
    drives, inner = leaks + len(marks.bend), len(marks.inner)
    wide, each = (lanes, 1) if len(marks.own) > 0 else (1, 0)
    x, p = at.scratch, k * weights_of(marks).mode + inner + 5
    for i in range(lanes):
        th, length = state[(x + 4) * lanes + i], weights[weights_of(marks).length * wide + i * each]
        y, rest = max(c.rates[k] * length, QUICK), 1.0 - th
        over = 1.0 / y
        size = state[x * lanes + i] if c.rates[k] * length >= QUICK else 0.0
        # The decay from th on, as the 64th power of a series.
        v = min(y * rest, 40.0) / 64.0
        left = 1.0 - v * (1.0 - 0.5 * v * (1.0 - THIRD * v * (1.0 - 0.25 * v * (1.0 - 0.2 * v * (1.0 - SIXTH * v)))))
        for _ in range(6):
            left *= left
        straight = (rest - (1.0 - left) * over) * over
        square = (rest * rest - 2.0 * straight) * over
        for t in range(drives):
            w = state[(at.w + t if t < leaks else 0) * lanes + i]
            rise = state[(at.w + leaks + t if t < leaks else 1) * lanes + i]
            rise -= w
            w += th * rise
            more = c.feed[k, t] * length * (w * straight + rise * square)
            for j in range(1, inner + 2):
                since = max(PLACES[inner - 1, j] - th, 0.0)
                more -= weights[(p + j * drives + t) * wide + i * each] * since * (w + rise * since)
            state[(SOURCES + k) * lanes + i] += c.kinks[t] * size * more


@jit_within_rows
def _add_kinks(marks: Any, c: Any, weights: FloatArray, state: FloatArray) -> None:
    count, first = len(marks.lanes) if len(marks.own) > 0 else 1, weights_of(marks).length
    for k in range(len(marks.modes)):
        quick = False
        for i in range(count):
            quick = quick or c.rates[k] * weights[first * count + i] >= QUICK
        if quick:
            _add_kinks_to(marks, c, k, weights, state)


@jit_within_rows
def _kinks(marks: Any, c: Any, state: FloatArray) -> None:
    """What the rule misses of |xi| times 1 and t, in a step of length 1, and of the drives' kinks.

    On the straight line of xi from u0 to u1, which is 0 at th: int |u| = (u0^2 + u1^2) / (2 |u1 - u0|) and
    int |u| (t - th) = |u1 - u0| ((1 - th)^3 - th^3) / 3, less the rule's sums of both.
    """
    lanes, leaks, drives = len(marks.lanes), len(marks.leaks), len(marks.leaks) + len(marks.bend)
    at = places(marks)
    x, inner, rule = at.scratch, len(marks.inner), len(marks.inner) - 1
    begins, ends = (at.flat, at.flat + 1) if len(marks.mobile) > 0 else (at.xi, at.xi + inner + 1)
    for i in range(lanes):
        u0, u1 = state[begins * lanes + i], state[ends * lanes + i]
        d = u1 - u0
        over = 1.0 / (abs(d) + 1e-300)
        th = abs(u0) * over
        om = 1.0 - th
        c0, c1 = WEIGHTS[rule, 0] * abs(u0), WEIGHTS[rule, 0] * abs(u1)
        k0 = 0.5 * (u0 * u0 + u1 * u1) * over - c0 - c1
        k1 = abs(d) * (om * om * om - th * th * th) * THIRD + c0 * th - c1 * om
        for j in range(1, inner + 1):
            share = WEIGHTS[rule, j] * abs(u0 + PLACES[rule, j] * d)
            k0 -= share
            k1 -= share * (PLACES[rule, j] - th)
        crossed = u0 * u1 < 0.0
        state[x * lanes + i] = 2.0 * abs(d) if crossed else 0.0
        state[(x + 2) * lanes + i] = k0 if crossed else 0.0
        state[(x + 3) * lanes + i] = k1 if crossed else 0.0
        state[(x + 4) * lanes + i] = th if crossed else 0.0
    # u rises 1 / (1 -+ b) as much as xi with the area at 0 V, on its two sides.
    for i in range(lanes if len(marks.mobile) > 0 else 0):
        b = c.steep * state[(at.q + 2) * lanes + i]
        by = 1.0 / (1.0 - b * b)
        state[x * lanes + i] *= by
        state[(x + 2) * lanes + i] *= by
        state[(x + 3) * lanes + i] *= by
    for i in range(lanes):
        k0, k1, th = state[(x + 2) * lanes + i], state[(x + 3) * lanes + i], state[(x + 4) * lanes + i]
        for t in range(drives):
            first, second = (0, 1) if len(marks.mobile) > 0 else (at.xi, at.xi + inner + 1)
            first, second = (at.w + t, at.w + leaks + t) if t < leaks else (first, second)
            w0, w1 = state[first * lanes + i], state[second * lanes + i]
            state[(x + 5 + t) * lanes + i] = c.kinks[t] * (k0 * w0 + (k0 * th + k1) * (w1 - w0))
