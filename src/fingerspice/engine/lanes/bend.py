"""What a network adds to a step of lanes (`engine.lanes.step`): N as a drive, and modes that fade within a sample."""

from __future__ import annotations

from typing import Any

from fingerspice.base.arrays import FloatArray
from fingerspice.base.compiled import jit_within_rows
from fingerspice.engine.lanes.rows import (
    END_SLOPES,
    FADED,
    NODES,
    SOURCES,
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
def _bend_end(marks: Any, c: Any, weights: FloatArray, state: FloatArray) -> None:
    """Add the modes' response to what the cubic through N lacks, whose slope at the end of the step is known."""
    lanes, m, leaks, at = len(marks.lanes), len(marks.modes), len(marks.leaks), places(marks)
    drives = leaks + 1
    wide, each = (lanes, 1) if len(marks.own) > 0 else (1, 0)
    _changes(marks, c, weights, NODES - 1, state)
    for i in range(lanes):
        for j in range(NODES):
            of_cubic = END_SLOPES[j] * state[(at.g + j * drives + leaks) * lanes + i]
            state[at.scratch * lanes + i] -= of_cubic
    for k in range(m):
        p = (k + 1) * weights_of(marks).mode - 1
        for i in range(lanes):
            state[(SOURCES + k) * lanes + i] += weights[p * wide + i * each] * state[at.scratch * lanes + i]


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
    lanes, leaks, at = len(marks.lanes), len(marks.leaks), places(marks)
    drives, last = leaks + 1, NODES - 1
    _bend_end(marks, c, weights, state)
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
