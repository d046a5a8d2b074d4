"""One step of many lanes: an explicit step of the exponential integrator, whose innermost loops run over the lanes.

A circuit with one finger, in modes around a reference 1/A = q0, under a source s that is straight in the
step:

    z' = -rates z + gain s + feed g,   xi = k s + shape z,   g_t = (1/A - q0) (tap_s s + taps z + bent N)_t

In a stack xi is the gap voltage u, and 1/A a polynomial in |u|; under `mobile` u follows from xi and the part of it
that the modes have: with 1/A = q0 + q it is u = X + B q(u), X = k s + shape z, B = (X - k s) / q0, and the last drive
is g = A - 1/q0 times s. Where X has a share S of it, X = Y + S g, that is u = Y + C q(u) with
C = (Y - (k + S / q0) s) / q0. In a network N, the integral of A - 1/q0 over u, is one more drive, behind
the leaks: u + kappa N = xi, and both 1/A and N are polynomials in |xi| (`solve.recordings.form`).

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
from fingerspice.engine.lanes.rows import (
    END_SLOPES,
    FADED,
    NODES,
    PLACES,
    QUICK,
    SOURCES,
    WEIGHTS,
    places,
    polynomial_rows,
    project,
    rise_of,
    weights_of,
)


@jit_within_rows
def bent_drives_at(marks: Any, c: Any, weights: FloatArray, j: int, state: FloatArray) -> None:
    """Drives at node j, from xi there, but for N, and from what 1/A - q0 multiplies there.

    xi = X + B N(xi), where X is given, and B is the share of N at this node. It is solved on the tangent of N at the
    node before, and once more on the one at the place that is found. Tangents have the slope -q / d,
    d = q0 (q0 + q) - kappa q, where 1/A = q0 + q. For node 0 the start is changed: B = 0, and the rows of the last node
    are taken.
    """
    lanes, leaks, at = len(marks.lanes), len(marks.leaks), places(marks)
    drives, x = leaks + 1, at.scratch
    wide, each = (lanes, 1) if len(marks.own) > 0 else (1, 0)
    before, to, on = (j - 1, j, 1.0) if j > 0 else (0, NODES - 1, 0.0)
    # The share of xi, and with steps of `one` those of what 1/A - q0 multiplies.
    one = weights_of(marks).one
    share_at = weights_of(marks).node + (to - 1) * (1 + leaks) * one + one - 1
    for i in range(lanes):
        there, bend = state[(at.xi + before) * lanes + i], state[(at.g + before * drives + leaks) * lanes + i]
        share, q = on * weights[share_at * wide + i * each], state[at.q * lanes + i]
        without = state[(at.xi + to) * lanes + i]
        d = c.q0 * (c.q0 + q) - c.kappa * q
        xi = there + d * ((without + share * bend - there) / (d + share * q))
        state[(x + 2) * lanes + i], state[(at.xi + to) * lanes + i] = without, xi
        state[x * lanes + i] = abs(xi) * c.scale + c.shift
    polynomial_rows(lanes, c.area, state[x * lanes :], state[(x + 1) * lanes :])
    polynomial_rows(lanes, c.slope, state[x * lanes :], state[(at.q + 1) * lanes :])
    polynomial_rows(lanes, c.bend, state[x * lanes :], state[(x + 4) * lanes :])
    for i in range(lanes):
        xi, q = state[(at.xi + to) * lanes + i], state[(x + 1) * lanes + i]
        share, bend = on * weights[share_at * wide + i * each], state[(x + 4) * lanes + i]
        bend = bend if xi >= 0.0 else -bend
        d = c.q0 * (c.q0 + q) - c.kappa * q
        by = (state[(x + 2) * lanes + i] + share * bend - xi) / (d + share * q)
        bend -= q * by
        found = xi + d * by
        q += state[(at.q + 1) * lanes + i] * (abs(found) - abs(xi))
        state[(at.xi + to) * lanes + i] = found
        state[at.q * lanes + i] = q
        state[(at.g + to * drives + leaks) * lanes + i] = bend
        for t in range(leaks):
            w = state[(at.w + leaks + t) * lanes + i]
            w += (c.bent[t] + on * weights[(share_at + (1 + t) * one) * wide + i * each]) * bend
            state[(at.w + leaks + t) * lanes + i] = w
            state[(at.g + to * drives + t) * lanes + i] = q * w


@jit_within_rows
def _changes(marks: Any, c: Any, weights: FloatArray, node: int, state: FloatArray) -> None:
    """Change of N in a step at its rate at node 0 or the last one, into the first row of scratch.

    Modes that have faded follow the source and N.
    """
    lanes, active, leaks, at = len(marks.lanes), len(marks.active), len(marks.leaks), places(marks)
    drives, x = leaks + 1, at.scratch
    wide, each = (lanes, 1) if len(marks.own) > 0 else (1, 0)
    length = weights_of(marks).length
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


@jit_within_rows
def smooth(marks: Any, c: Any, weights: FloatArray, a: float, state: FloatArray) -> bool:
    """Put modes that fade within a step where they soon are, on the new line of the source if it begins there (a = 0).

    What this changes of them and of the drives is kept in the rows from `gone` on. Whether there are such modes.
    """
    lanes, m, active, leaks = len(marks.lanes), len(marks.modes), len(marks.active), len(marks.leaks)
    drives, last, at = leaks + 1, NODES - 1, places(marks)
    wide, each = (lanes, 1) if len(marks.own) > 0 else (1, 0)
    fades, length = False, weights_of(marks).length
    for i in range(lanes if len(marks.own) > 0 else 1):
        fades = fades or (a == 0.0 and c.rates[c.fast] * weights[length * wide + i * each] > FADED)
    if not fades:
        return False
    _changes(marks, c, weights, 0, state)
    for k in range(active):
        rate, over, gain, feed = c.rates[k], 1.0 / (c.rates[k] + 1e-300), c.gain[k], c.feed[k, leaks]
        for i in range(lanes):
            z, h = state[(SOURCES + k) * lanes + i], weights[length * wide + i * each]
            fed = gain * state[i]
            for t in range(drives):
                fed += c.feed[k, t] * state[(at.g + t) * lanes + i]
            changes = gain * (state[lanes + i] - state[i]) + feed * state[at.scratch * lanes + i]
            soon = (fed - changes / (rate * h + 1e-300)) * over
            soon = soon if rate * h > FADED else z
            state[(at.gone + k) * lanes + i] = z - soon
            state[(SOURCES + k) * lanes + i] = soon
    project(marks, c, 0, at.xi + last, state)
    bent_drives_at(marks, c, weights, 0, state)
    for i in range(lanes):
        state[at.xi * lanes + i] = state[(at.xi + last) * lanes + i]
        state[(at.q + 2) * lanes + i] = rise_of(c.q0, c.kappa, state[at.q * lanes + i])
        for k in range(active, m):
            state[(at.gone + k) * lanes + i] = 0.0
        for t in range(drives):
            soon = state[(at.g + last * drives + t) * lanes + i]
            state[(at.gone + m + t) * lanes + i] = state[(at.g + t) * lanes + i] - soon
            state[(at.g + t) * lanes + i] = soon
        for t in range(leaks):
            state[(at.w + t) * lanes + i] = state[(at.w + leaks + t) * lanes + i]
    return True


@jit_within_rows
def _fade(marks: Any, c: Any, weights: FloatArray, state: FloatArray) -> None:
    """Add what is left of what `smooth` has taken, and the modes' response to it by N and, as one, by the leaks."""
    lanes, m, active, leaks = len(marks.lanes), len(marks.modes), len(marks.active), len(marks.leaks)
    at, rows = places(marks), weights_of(marks)
    wide, each = (lanes, 1) if len(marks.own) > 0 else (1, 0)
    for k in range(m):
        for f in range(active):
            apart = c.rates[k] - c.rates[f]
            over, alike = 1.0 / (apart if apart != 0.0 else 1.0), abs(apart) <= 1e-6 * c.rates[f]
            for i in range(lanes):
                decay = weights[k * rows.mode * wide + i * each]
                faded = weights[f * rows.mode * wide + i * each]
                gone = state[(at.gone + f) * lanes + i]
                fed = c.feed[k, leaks] * state[(at.q + 2) * lanes + i] * c.shape[f] * gone
                if f == c.fast:
                    for t in range(leaks):
                        fed += c.feed[k, t] * state[(at.gone + m + t) * lanes + i]
                pulse = weights[rows.length * wide + i * each] * faded if alike else (faded - decay) * over
                state[(SOURCES + k) * lanes + i] += pulse * fed + (decay * gone if k == f else 0.0)


@jit_within_rows
def end_bent(marks: Any, c: Any, weights: FloatArray, fades: bool, state: FloatArray) -> None:
    """What N has beside the cubic, and fading modes; then the drives at the end of a step to node 0.

    They follow from xi there, on the tangents at the last node.
    """
    lanes, leaks, at, rows = len(marks.lanes), len(marks.leaks), places(marks), weights_of(marks)
    drives, last = leaks + 1, NODES - 1
    wide, each = (lanes, 1) if len(marks.own) > 0 else (1, 0)
    # The modes' response to what the cubic through N lacks, whose slope at the end of the step is known.
    _changes(marks, c, weights, last, state)
    for i in range(lanes):
        for j in range(NODES):
            of_cubic = END_SLOPES[j] * state[(at.g + j * drives + leaks) * lanes + i]
            state[at.scratch * lanes + i] -= of_cubic
    for k in range(len(marks.modes)):
        p = (k + 1) * rows.mode - 1
        for i in range(lanes):
            state[(SOURCES + k) * lanes + i] += weights[p * wide + i * each] * state[at.scratch * lanes + i]
    if fades:
        _fade(marks, c, weights, state)
    project(marks, c, 1, at.xi, state)
    for i in range(lanes):
        xi, found, q = state[at.xi * lanes + i], state[(at.xi + last) * lanes + i], state[at.q * lanes + i]
        bend = state[(at.g + last * drives + leaks) * lanes + i]
        bend += rise_of(c.q0, c.kappa, q) * (xi - found)
        q += state[(at.q + 1) * lanes + i] * (abs(xi) - abs(found))
        state[at.q * lanes + i], state[(at.g + leaks) * lanes + i] = q, bend
        for t in range(leaks):
            w = state[(at.w + leaks + t) * lanes + i] + c.bent[t] * bend
            state[(at.w + t) * lanes + i], state[(at.g + t) * lanes + i] = w, q * w


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
    if len(marks.mobile) > 0:
        _drives_under_mobile(marks, c, weights, 0, state)
    for t in range(leaks):
        for i in range(lanes):
            if len(marks.mobile) == 0:
                state[(at.g + t) * lanes + i] = state[(at.g + (len(marks.inner) + 1) * leaks + t) * lanes + i]
            state[(at.w + t) * lanes + i] = state[(at.w + leaks + t) * lanes + i]


# Prepare a step that begins at the part `a` of a sample: whether modes fade in it.
_begin = jit_by_kind(StackMarks=_begin_at_once, MobileMarks=_begin_at_once, NetworkMarks=smooth)
# Drives at a later node j from what is predicted there.
_drives_at_node = jit_by_kind(
    StackMarks=_drives_of_stack, MobileMarks=_drives_under_mobile, NetworkMarks=bent_drives_at
)  # fmt: skip
# From the modes at the end of a step, xi and the drives there, for the start of the next one.
_end = jit_by_kind(StackMarks=_end_of_stack, MobileMarks=_end_of_stack, NetworkMarks=end_bent)


def _step(marks: Any, c: Any, weights: FloatArray, state: FloatArray, after: FloatArray, a: float, b: float) -> None:
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


# A network's step is larger: as a function of its own it is a tenth faster, as a stack's is within its loop.
step = jit_by_kind(
    StackMarks=jit_within_rows(_step), MobileMarks=jit_within_rows(_step), NetworkMarks=jit_rows(_step)
)  # fmt: skip


@jit_within_rows
def _at_node(marks: Any, c: Any, weights: FloatArray, j: int, state: FloatArray) -> None:
    """xi at node j, and what 1/A - q0 multiplies there, from the start of the step and the drives at earlier nodes.

    From these follow the drives there.
    """
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
    _drives_at_node(marks, c, weights, j, state)


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
def _add_kinks(marks: Any, c: Any, weights: FloatArray, state: FloatArray) -> None:
    """Add the response of modes that decay fast to what the cubics miss of the drives' kinks.

    These begin at th with a straight line and a square, to which the response is known.
    """
    lanes, leaks, at = len(marks.lanes), len(marks.leaks), places(marks)
    drives, inner, rows = leaks + len(marks.bend), len(marks.inner), weights_of(marks)
    wide, each = (lanes, 1) if len(marks.own) > 0 else (1, 0)
    for k in range(len(marks.modes)):
        x, p, quick = at.scratch, k * rows.mode + inner + 5, False
        for i in range(wide):
            quick = quick or c.rates[k] * weights[rows.length * wide + i] >= QUICK
        for i in range(lanes if quick else 0):
            th, length = state[(x + 4) * lanes + i], weights[rows.length * wide + i * each]
            y, rest = max(c.rates[k] * length, QUICK), 1.0 - th
            over = 1.0 / y
            size = state[x * lanes + i] if c.rates[k] * length >= QUICK else 0.0
            # The decay from th on, as the 64th power of a series.
            v = min(y * rest, 40.0) / 64.0
            left = 1.0 - 0.25 * v * (1.0 - 0.2 * v * (1.0 - SIXTH * v))
            left = 1.0 - v * (1.0 - 0.5 * v * (1.0 - THIRD * v * left))
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
