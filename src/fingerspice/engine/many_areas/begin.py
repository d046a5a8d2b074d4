"""A network as the loop of exponential steps takes it: edges, jumps, and the reference that fits its areas."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from fingerspice.base.arrays import FloatArray, IntArray
from fingerspice.base.compiled import jit, jit_within
from fingerspice.engine.collocation.exponential import Tables
from fingerspice.engine.collocation.loopstate import DONE, GO_ON, PAUSED, REFERENCE, TOO_MANY, LoopState
from fingerspice.engine.collocation.readout import (
    ACCEPTED,
    RECORDED,
    REJECTED,
)
from fingerspice.engine.collocation.step_control import AFTER_EDGE, NOT_FRESH, Pace, choose_step
from fingerspice.engine.many_areas import form as blocks
from fingerspice.engine.many_areas.error import load
from fingerspice.engine.many_areas.form import Form, Work, leaks_of
from fingerspice.engine.network import Sources, at_sources
from fingerspice.numerics.small import copy_to
from fingerspice.physics.contact import inverse_area

# Ratio of neighbouring reference areas, and the ratio of an area to its reference beyond which another one is taken.
LEVEL_RATIO, FARTHEST = 1.28, 1.2


class References(NamedTuple):
    """The forms of a network around several reference areas."""

    levels: IntArray  # (room, n_area): Areas of each reference over those at 0 V, as powers of LEVEL_RATIO
    numbers: FloatArray  # (room, size): See `Form`
    # used, wanted (1,): Number of references; the levels that were looked for last
    used: IntArray
    wanted: IntArray


@jit
def far_from(form: Form, area: FloatArray) -> bool:
    """Whether some area (n_area,) is too far away from its reference."""
    for a in range(area.size):
        if form.cell[a] >= 0 and max(area[a] / form.area0[a], form.area0[a] / area[a]) > FARTHEST:
            return True
    return False


@jit
def find(references: References, form: Form, area: FloatArray) -> int:
    """The reference nearest to these areas (n_area,), or -1 if it has not been made; its levels into `wanted`."""
    wanted = references.wanted
    for a in range(area.size):
        wanted[a] = 0
        if form.cell[a] >= 0:
            wanted[a] = round(math.log(area[a] / form.unit[a]) / math.log(LEVEL_RATIO))
    for one in range(references.used[0]):
        same = True
        for a in range(area.size):
            same &= references.levels[one, a] == wanted[a]
        if same:
            return one
    return -1


@jit
def go_over(references: References, one: int, form: Form, error: FloatArray) -> None:
    """Turn a form into that of another reference, and transform the error of the modes."""
    n = form.shape.shape[0]
    x = np.zeros(n)
    for i in range(n):
        for k in range(n):
            x[i] += form.shape[i, k] * error[k]
    copy_to(form.numbers, references.numbers[one])
    for k in range(n):
        error[k] = 0.0
        for i in range(n):
            error[k] += form.inverse[k, i] * x[i]


@jit
def start_at(area0: FloatArray, area: FloatArray) -> None:
    """Areas (n_area, ROWS) as at their references."""
    for a in range(area0.size):
        for i in range(area.shape[1]):
            area[a, i] = area0[a]


# Relative change of a source at an edge that counts as rounding error, not as a jump.
_ROUNDING, _UNNOTICED = 1e-14, 1e-9
# Number of modes times steps between two pauses, in which Python can react to Ctrl-C.
_AT_ONCE = 40_000
# A step that is to reach a zero of a gap voltage is this much longer, relative to the branch.
_BEYOND = 1.02


class ManyAreas(NamedTuple):
    """A network and its sources, as the loop takes them; it updates all but `sources`.

    Within a jump of the sources the independent variable is the fraction of the jump, and time stands still: the same
    network, in which nothing leaks.
    """

    # form, references, tables, work: The network in modal form around a reference, whose number is in `work.at`; all
    # references; tables of exponentials, and scratch arrays
    form: Form
    references: References
    tables: Tables
    work: Work
    integral: FloatArray  # `lobatto.integral_table()`
    sources: Sources
    u_scale: float  # Largest voltage, V; the error of an area with a time constant is measured as a fraction of it
    # sign, s_before: Branch of each area (0: to be chosen), and the sources' values just before the time reached
    sign: FloatArray
    s_before: FloatArray
    branch: FloatArray  # (n_area, 2): Time at which each area's branch began, and length of the branch before, s


@jit_within
def branch_of(c: ManyAreas, s: LoopState) -> FloatArray:
    """Where the areas' branches began: in time, or within a jump."""
    return c.work.jump.branch if s.step[0].in_jump > 0 else c.branch


@jit_within
def start_many(c: ManyAreas, s: LoopState) -> None:
    """Begin a call of the loop, or go on after a pause, which changes nothing."""
    form, work, step, counters = c.form, c.work, s.step[0], s.counters
    n = form.shape.shape[0]
    step.pause_at = counters[ACCEPTED] + 1 + _AT_ONCE // form.rates.size
    # Other runs may have used the tables since the last call.
    s.step[0].tabled = 0.0
    if step.is_paused > 0:
        step.is_paused = 0
        return
    step.flips, step.fresh = 0, NOT_FRESH
    step.in_jump, step.has_begun, step.unconverged = 0, 0, 0
    step.accepted_before = counters[ACCEPTED]
    step.several = 0
    for b in range(1, form.home.size):
        step.several |= int(form.home[b] != form.home[0])
    step.smooth = int(
        _all_zero(form.tap_s) and _all_zero(form.stored_s) and _all_zero(form.follow) and _all_zero(form.gap_s)
    )
    for i in range(work.segment.size):
        work.segment[i] = 0
    work.areas[:] = 0.0
    start_at(form.area0, work.areas[blocks.AREA])
    for k in range(work.size.size):
        work.size[k] = form.size[k] if k < n else c.u_scale


@jit
def _all_zero(x: FloatArray) -> bool:
    for i in range(x.shape[0]):
        for j in range(x.shape[1]):
            if x[i, j] != 0.0:
                return False
    return True


@jit_within
def begin_many(c: ManyAreas, pace: Pace, s: LoopState, t_end: float) -> int:
    """Where the next step starts: at an edge of a source, within a jump, or later; and its length."""
    form, work, step, control, counters = c.form, c.work, s.step[0], s.control[0], s.counters
    if step.in_jump > 0 and control.t >= 1.0:
        _leave_jump(c, s)
    if counters[ACCEPTED] + counters[REJECTED] > step.most:
        return TOO_MANY
    step.stop, step.at_edge = 1.0, 0
    if step.in_jump > 0:
        copy_to(work.now, c.s_before)
    else:
        if step.has_begun > 0 and control.t >= t_end:
            return DONE
        if counters[ACCEPTED] >= step.pause_at or counters[RECORDED] >= s.steps.times.shape[0] > 0:
            step.is_paused = 1
            return PAUSED
        _look_at_sources(c, s, t_end)
        if step.in_jump == 0 and control.t >= t_end:
            return DONE
    t = control.t
    if step.at_edge > 0:
        # Step lengths after a jump are often those after the previous jump.
        control.h, control.too_long, control.allowed = control.h_after_edge, 0.0, 0.0
        step.fresh = AFTER_EDGE
    load(form.inverse, form.follow, s.y, work.now, work.w0)
    _choose_branches(c, s, t)
    if step.in_jump == 0 and far_from(form, work.here) and not _take_reference(c, s):
        return REFERENCE
    rates = leaks_of(c, s).rates
    longest = Pace(pace.tol, 1.0, True, pace.charge) if step.in_jump > 0 else pace
    is_series = c.sources.series.shape[1] > 0 and step.in_jump == 0
    # If all rates are zero, the time constant is infinite.
    step.length = choose_step(longest, 1.0 / rates.max(), True, is_series, t, step.stop - t, control)
    return GO_ON


@jit_within
def _look_at_sources(c: ManyAreas, s: LoopState, t_end: float) -> None:
    """The sources' segments and values at the present time, and the next edge; a jump of any of them is entered."""
    work, step, sources, before, t = c.work, s.step[0], c.sources, c.s_before, s.control[0].t
    segment, now, stop = work.segment, work.now, t_end
    for i in range(now.size):
        while sources.edges[sources.first[i] + segment[i] + 1] <= t:
            segment[i] += 1
        step.at_edge |= int(sources.edges[sources.first[i] + segment[i]] == t)
        stop = min(stop, sources.edges[sources.first[i] + segment[i] + 1])
    s.step[0].stop = stop
    at_sources(sources, segment, t, 0.0, now, work.slopes_now)
    # The time at which a call starts may differ from an edge by rounding.
    least = _ROUNDING if step.at_edge > 0 else (math.inf if step.has_begun > 0 else _UNNOTICED)
    step.has_begun = 1
    jumps = False
    for i in range(now.size):
        jumps |= abs(now[i] - before[i]) > least * max(abs(now[i]), abs(before[i]))
    if jumps and step.smooth > 0:
        copy_to(before, now)
    elif jumps:
        _enter_jump(c, s)


@jit_within
def _enter_jump(c: ManyAreas, s: LoopState) -> None:
    """Go on in the fraction of a jump from the sources' values before it to those now."""
    jump, step, control = c.work.jump, s.step[0], s.control[0]
    step.in_jump, step.at_edge = 1, 0
    jump.control[0] = s.control[0]
    copy_to(jump.sign, c.sign)
    copy_to(jump.before, c.s_before)
    copy_to(jump.after, c.work.now)
    jump.branch[:] = 0.0
    s.control[0] = jump.control[1]
    control.error_q, control.magnified = jump.control[0].error_q, jump.control[0].magnified
    s.step[0].tabled, s.step[0].stop = 0.0, 1.0
    copy_to(c.work.now, jump.before)


@jit_within
def _leave_jump(c: ManyAreas, s: LoopState) -> None:
    """Go on in time after a jump."""
    jump = c.work.jump
    resume_time(c, s)
    copy_to(c.s_before, jump.after)
    for a in range(c.sign.size):
        if c.sign[a] != jump.sign[a]:
            c.branch[a, 0], c.branch[a, 1] = s.control[0].t, math.inf
    s.step[0].tabled = 0.0


@jit_within
def resume_time(c: ManyAreas, s: LoopState) -> None:
    """Take the bookkeeping of before a jump, with the errors that the jump has added."""
    jump, control = c.work.jump, s.control[0]
    jump.control[0].error_q, jump.control[0].magnified = control.error_q, control.magnified
    s.control[0] = jump.control[0]
    s.step[0].in_jump = 0


@jit_within
def _choose_branches(c: ManyAreas, s: LoopState, t: float) -> None:
    """The areas at the start of a step and, where it is not known yet, the branch of each; the next zero to expect."""
    form, work, control, sign = c.form, c.work, s.control[0], c.sign
    branch, in_jump, w0, now = branch_of(c, s), s.step[0].in_jump > 0, c.work.w0, c.work.now
    ahead = math.inf
    control.branch_start, control.branch_length = t, math.inf
    for a in range(sign.size):
        if form.cell[a] < 0:
            sign[a] = 1.0
            continue
        voltage = 0.0
        for k in range(form.gap.shape[1]):
            voltage += form.gap[a, k] * w0[k]
        for e in range(now.size):
            voltage += form.gap_s[a, e] * now[e]
        if sign[a] == 0.0:
            sign[a] = 1.0 if voltage >= 0.0 else -1.0
            branch[a, 0], branch[a, 1] = t, math.inf
        if not in_jump:
            slow = form.slow[a]
            work.here[a] = (
                form.unit[a] * s.y[slow] if slow >= 0 else 1.0 / inverse_area(abs(voltage), form.curves[a])[0]
            )
        end = branch[a, 0] + _BEYOND * branch[a, 1] - t
        if 0.0 < end < ahead:
            ahead = end
            control.branch_start, control.branch_length = branch[a, 0], branch[a, 1]


@jit_within
def _take_reference(c: ManyAreas, s: LoopState) -> bool:
    """Go over to the reference nearest to the present areas; False if it has not been made yet."""
    form, work = c.form, c.work
    found = find(c.references, form, work.here)
    if found < 0:
        return False
    go_over(c.references, found, form, s.error)
    work.at[0], s.step[0].tabled = found, 0.0
    copy_to(work.size[: form.shape.shape[0]], form.size)
    start_at(form.area0, work.areas[blocks.AREA])
    load(form.inverse, form.follow, s.y, work.now, work.w0)
    return True
