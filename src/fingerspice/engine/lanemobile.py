"""What the law `mobile` adds to a step of lanes (`engine.lanestep`): the gap voltage follows from an equation.

With 1/A = q0 + q, the gap voltage is u = X + B q(u), where X = k s + shape z and B = (X - k s) / q0. The last drive is
g = A - 1/q0 times the source s. Where X has a share S of it, X = Y + S g, that is u = Y + C q(u) with
C = (Y - (k + S / q0) s) / q0.
"""

from __future__ import annotations

from typing import Any

from fingerspice.base.arrays import FloatArray
from fingerspice.base.compiled import jit_within_rows
from fingerspice.engine.lanerows import INNER, places, polynomial_rows, weights_of


@jit_within_rows
def drives_under_mobile(marks: Any, c: Any, weights: FloatArray, j: int, before: int, state: FloatArray) -> None:
    """Gap voltage and drives at node j, or for 0 at the end, from Y there, and from what multiplies 1/A - q0 there.

    The equation is solved on the tangent of q at node `before`, and once more on the one at the place that is found.
    """
    lanes, leaks, at = len(marks.lanes), len(marks.leaks), places(marks)
    wide, each = (lanes, 1) if len(marks.own) > 0 else (1, 0)
    x, over, flat, one = at.scratch, 1.0 / c.q0, at.flat + (0 if j == 0 else 1), weights_of(marks).one
    # At the end X is known.
    on, until = 1.0 if j > 0 else 0.0, INNER[0] if j == 1 else INNER[1] if j == 2 else 1.0
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
def drives_under_mobile_at(marks: Any, c: Any, weights: FloatArray, j: int, state: FloatArray) -> None:
    """The same at a later node."""
    drives_under_mobile(marks, c, weights, j, j - 1, state)


@jit_within_rows
def weaken_kinks(marks: Any, c: Any, state: FloatArray) -> None:
    """Scale what the rule misses of |xi|: u rises 1 / (1 -+ b) as much as xi with the area at 0 V on its two sides."""
    lanes, at = len(marks.lanes), places(marks)
    for i in range(lanes):
        b = c.steep * state[(at.q + 2) * lanes + i]
        by = 1.0 / (1.0 - b * b)
        state[at.scratch * lanes + i] *= by
        state[(at.scratch + 2) * lanes + i] *= by
        state[(at.scratch + 3) * lanes + i] *= by
