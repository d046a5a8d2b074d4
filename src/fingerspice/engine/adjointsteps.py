"""The steps of a backward sweep (`engine.adjoint`): the run along them, what is wanted, and where they are cut."""

from __future__ import annotations

import math
from typing import NamedTuple

from fingerspice.base.arrays import FloatArray, IntArray
from fingerspice.base.compiled import jit_within
from fingerspice.engine.model import Model
from fingerspice.physics.contact import inverse_area

SHORTEST = 1e-9
"""Shortest part of a step that is cut off."""
# Length of the first part before a jump of the adjoint state, in time constants of the fastest mode; and the growth of
# the distance from the jump from part to part.
_FIRST, _GROWTH = 0.25, 1.5
# Parts before one jump at most.
MOST_PARTS = 40


class Course(NamedTuple):
    """A run at the start, middle and end of n steps: node 2 j begins step j."""

    h: FloatArray  # (n,): Lengths of the steps, s
    # u, s (2 n + 1,): Gap voltage and source along the loop, V
    u: FloatArray
    s: FloatArray
    # (2 n + 1,): Under `mobile` (u - k_gap U) A (V m^2), which is smooth where u is 0 and its slope jumps; else no
    # entry
    held: FloatArray
    x: FloatArray  # (n_tap, 2 n + 1): X_t, V
    # q, dq (2 n + 1,): 1/A (1/m^2) and its derivative by the gap voltage
    q: FloatArray
    dq: FloatArray
    sample: IntArray  # (n,): Number of the sample before each step
    # share, width (n,): Where each step starts between this sample and the next one, and its length, in distances of
    # samples
    share: FloatArray
    width: FloatArray


class Wanted(NamedTuple):
    """The scalar J: the mean of an integrand from a time on, and values at single times."""

    # by_force, by_area: Weights of force (1/N) and area (1/m^2) in the integrand, over the length of its interval (s)
    by_force: float
    by_area: float
    since: tuple[int, float]  # Step, and fraction of it, at which this interval begins
    step: IntArray  # (m,): Step of each value, ascending
    at: FloatArray  # (m,): Fraction of the step, ascending in each step
    weight: FloatArray  # (m,): Derivative of J by the gap voltage there, 1/V


@jit_within
def parabola(x: float, a: float, m: float, b: float) -> float:
    """The parabola through values at 0, 1/2 and 1."""
    return float(a + x * (4.0 * m - 3.0 * a - b + 2.0 * x * (a - 2.0 * m + b)))


@jit_within
def crosses(c: Course, node: int) -> bool:
    """Whether the gap voltage changes its sign in the step from `node`, or is 0 at one of its ends."""
    return bool(c.u[node] * c.u[node + 2] <= 0.0 or c.u[node] * c.u[node + 1] <= 0.0)


@jit_within
def _zeros(a: float, m: float, b: float, out: FloatArray) -> int:
    """Zeros of the parabola through values at 0, 1/2 and 1, into `out` (2,); their number."""
    slope, bend, count = 4.0 * m - 3.0 * a - b, 2.0 * (a - 2.0 * m + b), 0
    square = slope * slope - 4.0 * bend * a
    if not square >= 0.0:
        return 0
    total = -0.5 * (slope + math.copysign(math.sqrt(square), slope))
    if total != 0.0:
        out[count], count = a / total, count + 1
    if bend != 0.0:
        out[count], count = total / bend, count + 1
    return count


@jit_within
def cut(model: Model, c: Course, wanted: Wanted, j: int, value: int, fast: float, out: FloatArray) -> tuple[int, int]:
    """Fractions at which step j is cut, ascending, without its ends, into `out`.

    They are zeros of the gap voltage, the start of the integrand's interval, and the times of values, the last of which
    is number `value` of all. Before such a time, modes with up to `fast` time constants in the step decay from the jump
    there: parts whose lengths grow follow them. Returns the number of fractions, and the number of the last value
    before this step.
    """
    node, count = 2 * j, 0
    if crosses(c, node):
        if model.mobile:
            # This is 0 where u is, and smooth there.
            rest, k = inverse_area(0.0, model.curve)[0], model.k_gap
            a, m, b = c.held[node] * rest, c.held[node + 1] * rest, c.held[node + 2] * rest
            count = _zeros(a + k * c.s[node], m + k * c.s[node + 1], b + k * c.s[node + 2], out)
        else:
            count = _zeros(c.u[node], c.u[node + 1], c.u[node + 2], out)
    if j == wanted.since[0]:
        out[count], count = wanted.since[1], count + 1
    while value >= 0 and wanted.step[value] == j:
        at = wanted.at[value]
        out[count], count, value = at, count + 1, value - 1
        length = _FIRST / fast if fast > 2.0 * _FIRST else 1.0
        while length < 0.5 * at and count < out.size:
            out[count], count, length = at - length, count + 1, _GROWTH * length
    if count > 1:
        out[:count].sort()
    kept, last = 0, 0.0
    for i in range(count):
        if out[i] > last + SHORTEST and out[i] < 1.0 - SHORTEST:
            out[kept] = last = out[i]
            kept += 1
    return kept, value
