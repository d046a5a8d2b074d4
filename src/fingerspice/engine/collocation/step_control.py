"""How the exponential steps are paced: their lengths, and what happens where the source or the gap voltage turns."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fingerspice.base.arrays import FloatArray
from fingerspice.base.compiled import jit
from fingerspice.engine.collocation.readout import (
    Control,
)
from fingerspice.engine.network import Segment, source
from fingerspice.engine.one_area.model import Model, choose_branch, dot, gap_voltage, jump_charge, ramp, write_row_at
from fingerspice.numerics.lobatto import NODES

# Ratio of neighbouring step lengths of the ladder, as a power of two: small enough to waste little, large enough for
# lengths to recur, whose tables are kept.
_RUNGS = 16.0
# A step that is to reach a zero of the gap voltage is this much longer, relative to its length.
_BEYOND = 1.02
# Largest ratio of a step to the one before, and the part of it that may come from the trend of earlier steps.
_MOST_GROWTH, _MOST_TREND = 8.0, 2.5
# If the error allows a step so many times as long as one that was rejected, the reason of the rejection has passed.
_REFUTED = 1.5
# Largest ratio of the first step after an edge or a zero to the first step after the previous one; the smaller value
# holds if that step was found by rejections.
_MOST_FRESH, _TRIED_FRESH = 2.0, 1.1
# Whether a step is the first after an edge or a zero.
NOT_FRESH, AFTER_EDGE, AFTER_ZERO = range(3)


class Pace(NamedTuple):
    """How steps are chosen."""

    tol: float  # Error of the gap voltage allowed in a step, V
    h_max: float  # Longest step, s
    controlled: bool  # Whether the error governs the step; else every step is `h_max` (for measuring orders)
    charge: bool  # Whether charge and current are wanted


@jit
def nearest_level(q0: FloatArray, q: float) -> int:
    """Reference area nearest to 1/A = q, by ratio."""
    best = 0
    distance = math.inf
    for i in range(q0.size):
        d = max(q0[i] / q, q / q0[i])
        if d < distance:
            distance = d
            best = i
    return best


@jit
def enter(model: Model, charge: bool, u_source: float, y: FloatArray, control: Control) -> bool:
    """Take a jump of the source at this time, if there is one, and the branch after it; False if it meets a fold."""
    x_gap = dot(model.gap, y)
    if not model.mobile and u_source != control.u_before and charge:
        moved, error = jump_charge(model, x_gap, control.u_before, u_source)
        y[-1] += moved
        control.error_q += error
    k_u = model.k_gap * u_source
    if model.mobile and control.sign != 0.0:
        u = ramp(model, k_u, x_gap, control.u_gap)
        sign = control.sign if u == 0.0 else math.copysign(1.0, u)
    else:
        sign = choose_branch(model, u_source, y)
        u = gap_voltage(model, k_u, x_gap, sign, k_u)
    if u != u:
        return False
    take_branch(sign if model.coupled else 1.0, control)
    control.u_gap = u
    return True


@jit
def end_row(
    model: Model, segment: Segment, tau: float, charge: bool, y: FloatArray, controls: NDArray[Any], row: FloatArray
) -> None:
    """Output row (see `model.write_row`) `tau` s into a segment, at 0 after the jump of the source that may begin it.

    The jump's charge is added to `y`, its branch goes into `controls` (1,); the row is NaN where the jump passes a
    fold.
    """
    control = controls[0]
    u_source, du_source = source(segment, tau)
    if tau == 0.0 and not enter(model, charge, u_source, y, control):
        u_source = math.nan
    u = gap_voltage(model, model.k_gap * u_source, dot(model.gap, y), control.sign, control.u_gap)
    write_row_at(model, u_source, du_source, y, control.sign, u, row)


@jit
def take_branch(sign: float, control: Control) -> None:
    """Take the branch of a sign; a new branch starts here, and its length is not known yet."""
    if sign != control.sign:
        control.branch_start = control.t
        control.branch_length = math.inf
    control.sign = sign


@jit
def choose_step(
    pace: Pace, tau: float, coupled: bool, is_series: bool, t: float, remaining: float, control: Control
) -> float:
    """Length of the next step, s: one of the ladder, or exactly to the end of a segment that cannot be continued."""
    if not pace.controlled:
        return pace.h_max
    h = control.h
    if h == 0.0:
        h = 4.0 * tau
    h = min(h, pace.h_max)
    ahead = control.branch_start + _BEYOND * control.branch_length - t
    target = remaining
    if coupled and 0.0 < ahead < remaining:
        target = ahead
    h = target / math.ceil(target / h) if h < target else target
    if is_series:
        # A series must not be evaluated beyond its end: the last step of a segment ends exactly there.
        if h >= remaining * (1.0 - 1e-9):
            return remaining
        h = rung(h)
        return h if h < remaining else remaining
    h = rung(h)
    return h if h <= pace.h_max else rung(0.95 * pace.h_max)


@jit
def allowed_factor(error: float, tol: float) -> float:
    """Ratio of the length that the error of a step allows to the step's own length."""
    if error == 0.0:
        return 6.0
    return 0.9 * (tol / error) ** (1.0 / NODES) if error < math.inf else 0.5


@jit
def accept(h: float, wanted: float, factor: float, tries: int, fresh: int, closed: bool, control: Control) -> None:
    """Choose the length after that of a step, h (s), within its error; `control` is updated.

    `wanted` (s) is the length before a boundary or a zero cut it short, `factor` that of `allowed_factor`, `tries` the
    number of lengths that were tried, and `fresh` whether it is the first after an edge or a zero (NOT_FRESH and so
    on). `closed` is false if the last rejected length was one at which the iteration did not converge: the error of a
    shorter step says nothing about that.
    """
    # A step cut short by a boundary says little about the next one. After a jump the decays die away one by one, and
    # the length allowed grows from step to step as it did.
    growth = h * factor / control.allowed if control.allowed > 0.0 else 1.0
    control.allowed = h * factor
    proposed = h * min(_MOST_GROWTH, max(0.5, factor * min(max(growth, 1.0), _MOST_TREND)))
    proposed = max(proposed, wanted if h < wanted else 0.0)
    if closed and h * factor > _REFUTED * control.too_long:
        control.too_long = 0.0
    if control.too_long > 0.0:
        proposed = min(proposed, 0.93 * control.too_long)
        control.too_long *= growth if growth > 1.5 else 1.03
    if fresh != NOT_FRESH and h >= wanted:
        first = h * min(_MOST_FRESH if tries == 1 else _TRIED_FRESH, factor)
        if fresh == AFTER_EDGE:
            control.h_after_edge = first
        else:
            control.h_after_zero = first
    control.h = proposed


@jit
def shorten(h: float, factor: float, control: Control) -> float:
    """The length to try after a rejected one, which is remembered."""
    control.too_long = h
    control.allowed = 0.0
    shorter: float = rung(h * min(0.9, max(0.25, factor)))
    return shorter


@jit
def rung(h: float) -> float:
    """The shortest step of the ladder that is not shorter than h."""
    out: float = 2.0 ** (math.ceil(_RUNGS * math.log2(h) - 1e-9) / _RUNGS)
    return out


@jit
def change_level(live: FloatArray, project: FloatArray, old: int, new: int, error: FloatArray) -> None:
    """Carry the modes' error from one reference area to another."""
    n = live.shape[1]
    x = np.zeros(n)
    for i in range(n):
        for k in range(n):
            x[i] += live[old, i, k] * error[k]
    for k in range(n):
        error[k] = 0.0
        for i in range(n):
            error[k] += project[new, k, i] * x[i]
