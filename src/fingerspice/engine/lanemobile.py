"""What the law `mobile` adds to a step of lanes (`engine.lanestep`): the gap voltage follows from an equation.

With 1/A = q0 + q, the gap voltage is u = X + B q(u), where X = k s + shape z and B = (X - k s) / q0. The last drive is
A - 1/q0 times the source.
"""

from __future__ import annotations

from typing import Any

from fingerspice.base.arrays import FloatArray
from fingerspice.base.compiled import jit_within
from fingerspice.engine.lanerows import places, polynomial_rows


@jit_within
def drives_under_mobile(marks: Any, c: Any, j: int, before: int, state: FloatArray) -> None:
    """Gap voltage and drives at node j, from X there, and from what multiplies the terms of the area there.

    The equation is solved on the tangent of q at node `before`, and once more on the one at the place that is found.
    """
    lanes, drives, at = len(marks.lanes), len(marks.leaks), places(marks)
    x, source, over = at.scratch, at.w + 2 * drives - 1, 1.0 / c.q0
    flat = at.flat + (0 if j == 0 else 1)
    for i in range(lanes):
        whole, there, q = state[(at.xi + j) * lanes + i], state[(at.xi + before) * lanes + i], state[at.q * lanes + i]
        share = (whole - c.k * state[source * lanes + i]) * over
        u = there + (whole + share * q - there) / (1.0 - share * state[(at.q + 1) * lanes + i])
        state[(at.q + 2) * lanes + i] = share
        state[flat * lanes + i] = whole + share * c.rest
        state[(at.xi + j) * lanes + i] = u
        state[x * lanes + i] = abs(u) * c.scale + c.shift
        state[(x + 2) * lanes + i] = whole
    polynomial_rows(lanes, c.area, state[x * lanes :], state[(x + 1) * lanes :])
    polynomial_rows(lanes, c.slope, state[x * lanes :], state[(x + 3) * lanes :])
    for i in range(lanes):
        u, q, share = state[(at.xi + j) * lanes + i], state[(x + 1) * lanes + i], state[(at.q + 2) * lanes + i]
        slope = state[(x + 3) * lanes + i]
        slope = slope if u >= 0.0 else -slope
        by = (state[(x + 2) * lanes + i] + share * q - u) / (1.0 - share * slope)
        q += slope * by
        state[(at.xi + j) * lanes + i] = u + by
        state[(x + 1) * lanes + i] = q
        state[at.q * lanes + i], state[(at.q + 1) * lanes + i] = q, slope
        state[at.fold * lanes + i] = max(state[at.fold * lanes + i], share * slope)
    for t in range(drives):
        for i in range(lanes):
            q, w = state[(x + 1) * lanes + i], state[(at.w + drives + t) * lanes + i]
            factor = q if t + 1 < drives else -q / (c.q0 * (c.q0 + q))
            state[(at.g + j * drives + t) * lanes + i] = factor * w


@jit_within
def weaken_kinks(marks: Any, c: Any, state: FloatArray) -> None:
    """Scale what the rule misses of |xi|: u rises 1 / (1 -+ b) as much as xi with the area at 0 V on its two sides."""
    lanes, at = len(marks.lanes), places(marks)
    for i in range(lanes):
        b = c.steep * state[(at.q + 2) * lanes + i]
        by = 1.0 / (1.0 - b * b)
        state[at.scratch * lanes + i] *= by
        state[(at.scratch + 2) * lanes + i] *= by
        state[(at.scratch + 3) * lanes + i] *= by
