"""A network for the loop of exponential steps (`engine.collocation.loop`): any number of areas and sources.

A step begins at an edge or within a jump of the sources, around the reference that fits the areas.

The functions that the loop calls take the run in progress as `s` (see `engine.collocation.readout`) and the network
as `c`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from fingerspice.base.arrays import FloatArray, IntArray
from fingerspice.base.compiled import jit, jit_within
from fingerspice.engine.collocation import exponential, readout, step_control
from fingerspice.engine.collocation.exponential import Tables
from fingerspice.engine.collocation.readout import LoopState
from fingerspice.engine.collocation.step_control import Pace
from fingerspice.engine.many_areas import error as errors
from fingerspice.engine.many_areas import form as forms
from fingerspice.engine.many_areas.coupling import take_coupling
from fingerspice.engine.many_areas.form import Form, Work
from fingerspice.engine.network import Sources, at_sources, next_edge
from fingerspice.engine.one_area.model import dot
from fingerspice.engine.one_area.system import LEVEL_RATIO
from fingerspice.numerics.lobatto import END, NODES, POINTS, combine, multiply
from fingerspice.numerics.modes import apply, copy_to
from fingerspice.physics.contact import inverse_area

# Ratio of an area to its reference beyond which another one is taken.
FARTHEST = 1.2


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


# Relative change of a source at an edge that counts as rounding error, not as a jump.
_ROUNDING, _UNNOTICED = 1e-14, 1e-9


class ManyAreas(NamedTuple):
    """A network and its sources, as the loop takes them; it updates all but `sources`.

    Within a jump of the sources the independent variable is the fraction of the jump, and time stands still: the same
    network, in which nothing leaks.
    """

    # form, held, references, tables, work: The network in modal form around a reference, whose number is in `work.at`,
    # and the same within a jump (see `form.held`); all references; tables of exponentials, and scratch arrays
    form: Form
    held: Form
    references: References
    tables: Tables
    work: Work
    integral: FloatArray  # `lobatto.integral_table()`
    sources: Sources
    u_scale: float  # Largest voltage, V; the error of an area with a time constant is measured as a fraction of it
    s_before: FloatArray  # (n_s,): The sources' values just before the time reached


@jit
def start(c: ManyAreas, s: LoopState) -> None:
    """Begin a window of the sources."""
    form, work, step, counters = c.form, c.work, s.step[0], s.counters
    n = form.shape.shape[0]
    step.fresh, step.start, step.since = step_control.NOT_FRESH, s.control[0].t, 0.0
    step.in_jump, step.has_begun, step.unconverged = 0, 0, 0
    step.accepted_before = counters[readout.ACCEPTED]
    step.several = 0
    for b in range(1, form.home.size):
        step.several |= int(form.home[b] != form.home[0])
    step.smooth = int(not (form.tap_s.any() or form.stored_s.any() or form.follow.any() or form.gap_s.any()))
    for i in range(work.segment.size):
        work.segment[i] = 0
    work.areas[:] = 0.0
    for k in range(work.size.size):
        work.size[k] = form.size[k] if k < n else c.u_scale


@jit
def begin(c: ManyAreas, pace: Pace, s: LoopState, t_end: float) -> int:
    """Where the next step starts: at an edge of a source, within a jump, or later; and its length."""
    form, work, step, control = c.form, c.work, s.step[0], s.control[0]
    if step.in_jump > 0 and control.t >= 1.0:
        _leave_jump(c, s)
    step.stop, step.at_edge = 1.0, 0
    if step.in_jump > 0:
        copy_to(work.now, c.s_before)
    else:
        if step.has_begun > 0 and control.t >= t_end:
            return readout.DONE
        _look_at_sources(c, s, t_end)
        if step.in_jump == 0 and control.t >= t_end:
            return readout.DONE
    t = control.t
    if step.at_edge > 0:
        step.start, step.since = t, 0.0
        # Step lengths after a jump are often those after the previous jump.
        control.h, control.too_long, control.allowed = control.h_after_edge, 0.0, 0.0
        step.fresh = step_control.AFTER_EDGE
    errors.load(form.inverse, form.follow, s.y, work.now, work.modal.w0)
    _choose_branches(c, s, t)
    if step.in_jump == 0 and far_from(form, work.here) and not _take_reference(c, s):
        return readout.REFERENCE
    rates = forms.form_of(c, s).rates
    longest = Pace(pace.tol, 1.0, True, pace.charge) if step.in_jump > 0 else pace
    is_series = c.sources.series.shape[1] > 0 and step.in_jump == 0
    # If all rates are zero, the time constant is infinite.
    remaining = step.stop - step.start - step.since
    step.length = step_control.choose_step(longest, 1.0 / rates.max(), is_series, s.branch, remaining, control)
    return readout.GO_ON


@jit
def _look_at_sources(c: ManyAreas, s: LoopState, t_end: float) -> None:
    """The sources' segments and values at the present time, and the next edge; a jump of any of them is entered."""
    work, step, sources, before, t = c.work, s.step[0], c.sources, c.s_before, s.control[0].t
    segment, now = work.segment, work.now
    step.stop = next_edge(sources, segment, t, t_end)
    for i in range(now.size):
        step.at_edge |= int(sources.edges[sources.first[i] + segment[i]] == t)
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


@jit
def _enter_jump(c: ManyAreas, s: LoopState) -> None:
    """Go on in the fraction of a jump from the sources' values before it to those now."""
    jump, step, control = c.work.jump, s.step[0], s.control[0]
    step.in_jump, step.at_edge = 1, 0
    jump.control[0] = s.control[0]
    copy_to(jump.sign, s.sign)
    copy_to(jump.before, c.s_before)
    copy_to(jump.after, c.work.now)
    copy_to(jump.branch, s.branch)
    s.branch[:] = 0.0
    s.control[0] = jump.control[1]
    control.error_q, control.magnified = jump.control[0].error_q, jump.control[0].magnified
    step.tabled, step.start, step.since, step.stop = 0.0, 0.0, 0.0, 1.0
    copy_to(c.work.now, jump.before)


@jit
def _leave_jump(c: ManyAreas, s: LoopState) -> None:
    """Go on in time after a jump."""
    jump = c.work.jump
    resume_time(c, s)
    copy_to(c.s_before, jump.after)
    for a in range(s.sign.size):
        if s.sign[a] != jump.sign[a]:
            s.branch[a, 0], s.branch[a, 1] = s.control[0].t, math.inf
    s.step[0].tabled, s.step[0].start, s.step[0].since = 0.0, s.control[0].t, 0.0


@jit
def resume_time(c: ManyAreas, s: LoopState) -> None:
    """Take the bookkeeping of before a jump, with the errors that the jump has added."""
    jump, control = c.work.jump, s.control[0]
    jump.control[0].error_q, jump.control[0].magnified = control.error_q, control.magnified
    s.control[0] = jump.control[0]
    copy_to(s.branch, jump.branch)
    s.step[0].in_jump = 0


@jit
def _choose_branches(c: ManyAreas, s: LoopState, t: float) -> None:
    """The areas at the start of a step and, where it is not known yet, the branch of each."""
    form, work, sign, branch = c.form, c.work, s.sign, s.branch
    in_jump, w0, now = s.step[0].in_jump > 0, work.modal.w0, work.now
    for a in range(sign.size):
        if form.cell[a] < 0:
            sign[a] = 1.0
            continue
        voltage = dot(form.gap[a], w0) + dot(form.gap_s[a], now)
        if sign[a] == 0.0:
            sign[a] = 1.0 if voltage >= 0.0 else -1.0
            branch[a, 0], branch[a, 1] = t, math.inf
        if not in_jump:
            slow = form.slow[a]
            work.here[a] = (
                form.unit[a] * s.y[slow] if slow >= 0 else 1.0 / inverse_area(abs(voltage), form.curves[a])[0]
            )


@jit
def _take_reference(c: ManyAreas, s: LoopState) -> bool:
    """Go over to the reference nearest to the present areas, with the error; False if it has not been made yet."""
    form, work, x = c.form, c.work, c.work.modal.w0
    found = find(c.references, form, work.here)
    if found < 0:
        return False
    apply(form.shape, s.error, x)
    copy_to(form.numbers, c.references.numbers[found])
    apply(form.inverse, x, s.error)
    work.at[0], s.step[0].tabled = found, 0.0
    copy_to(work.size[: form.shape.shape[0]], form.size)
    errors.load(form.inverse, form.follow, s.y, work.now, work.modal.w0)
    return True


# Distance to the fold below which another method takes over, because it needs fewer evaluations there.
_NEAR_FOLD = 0.02
# Step lengths at which the iteration did not converge: if there are more than this number and this share of the steps
# taken, an implicit method is faster, and the error of such steps exceeds their estimate (a hundredfold behind a fold
# that a resistor bridges).
_UNCONVERGED, _UNCONVERGED_SHARE = 40, 0.2


@jit_within
def _take_coupling(c: ManyAreas, s: LoopState, h: float) -> None:
    """The coupling of the areas for steps of length h (s)."""
    which = 2 * c.work.at[0] + int(s.step[0].in_jump > 0)
    take_coupling(c.work.own, which, h, forms.form_of(c, s))


@jit_within
def attempt(c: ManyAreas, pace: Pace, s: LoopState) -> int:
    """Solve a step of the length to be tried, and estimate its error (infinite where it did not converge)."""
    form, work, x, step, tol = forms.form_of(c, s), c.work, c.work.modal, s.step[0], pace.tol
    branch, t, in_jump, h, u = s.branch, s.control[0].t, s.step[0].in_jump > 0, s.step[0].length, x.u
    if h != step.tabled:
        exponential.take_tables(c, s, -1 if in_jump else work.at[0], h, form.rates, work.size)
        _take_coupling(c, s, h)
        step.whole = int(work.own.key[1] == 0)
    if in_jump:
        forms.ramp_rows(t, h, work.jump.before, work.jump.after, work.s, work.ds)
    else:
        slopes = pace.charge or step.smooth == 0
        forms.source_rows(c.sources, work.segment, t, h, slopes, work.room, work.s, work.ds)
    forms.follow_sources(form, work)
    x.guess[:] = 0.0
    work.cells[forms.RHO] = 0.0
    exponential.free(c.tables.decay[step.slot], x.w0, x.w)
    exponential.respond(work.lin, c.tables.phi[step.slot], x.w, x.base)
    passes, closed, answer = exponential.converge(c, s, 0.3 * tol)
    s.counters[readout.NFEV] += passes * NODES
    step.converged, step.step_error, step.grown = int(closed), math.inf, 1.0
    # An iteration that has not converged says nothing about the sign of the gap voltage.
    if not closed:
        return readout.GO_ON
    if step.flips <= s.sign.size and errors.turn_at_start(form.cell, u, s.sign, tol, t, branch):
        step.flips += 1
        return readout.RETRY
    if form.mobile:
        step.grown = 1.0 / work.room[3].min()
    exponential.carry(c, s, form.gap, answer)
    error, area = errors.assess(c, s), work.areas[forms.AREA]
    step.step_error = max(error, errors.charged(form.cell, u, area, c.tables.lobes)) if pace.charge else error
    return readout.GO_ON


@jit
def refuse(c: ManyAreas, pace: Pace, s: LoopState) -> int:
    """Why no shorter step would do after one that was rejected; GO_ON if one may.

    `too_far` is set to the fraction of it at which the next one should end, soon after a zero far beyond which it went,
    as there the branch of an area has no meaning, and the error says nothing; or to 2.
    """
    form, u, step, t = c.form, c.work.modal.u, s.step[0], s.control[0].t
    step.too_far = 2.0
    for a in range(s.sign.size):
        if form.cell[a] >= 0 and s.sign[a] * u[a, END] < form.lo[a]:
            found = step_control.first_wrong(u[a], s.sign[a], pace.tol)
            if found > 1 and 1.1 * POINTS[found] < 1.0:
                step.too_far = min(step.too_far, 1.1 * POINTS[found])
    step.unconverged += int(step.converged == 0)
    # The error of a shorter step says nothing about the length at which the iteration converges.
    step.trusted = step.converged
    accepted = s.counters[readout.ACCEPTED] - step.accepted_before
    stuck = step.unconverged > _UNCONVERGED + _UNCONVERGED_SHARE * accepted
    # A step of this length is rounding of the time: if it is rejected, there is a singularity.
    lost = step.length <= 1e-13 * max(abs(t), 1e-3 * (step.stop - t))
    return readout.NO_STEP if stuck or lost or (step.whole > 0 and 1.0 / step.grown < _NEAR_FOLD) else readout.GO_ON


@jit_within
def crossing(c: ManyAreas, pace: Pace, s: LoopState, a: int) -> float:
    """Fraction of an accepted step at which the gap voltage of area a leaves its branch, or 2."""
    if c.form.cell[a] < 0:
        return 2.0
    return float(step_control.leaves(c.work.modal.u[a], s.sign[a], pace.tol, c.work.room[0]))


@jit
def _magnified_whole(c: ManyAreas, s: LoopState) -> float:
    """Inverse distance of a step to the fold with all modes, also those that the step takes for stiff.

    The coupling in use becomes that in which no mode is taken for stiff.
    """
    form, work, spare = c.form, c.work, c.work.spare_cells
    _take_coupling(c, s, 0.0)
    spare[forms.ETA] = 0.0
    multiply(work.own.held, work.modal.w[: form.shape.shape[0]], None, spare[forms.CHI])
    combine(work.own.from_slopes, work.s, 0, spare[forms.CHI])
    forms.answer_mobile(form, work, s.step[0].several > 0, spare, work.areas, work.room[3])
    least: float = work.room[3, :NODES].min()
    return 1.0 / least


@jit_within
def finish(c: ManyAreas, charge: bool, s: LoopState) -> int:
    """Charges, outputs, peaks and errors of a step, and the state at its end or where it is cut."""
    form, work, step, x, values = forms.form_of(c, s), c.work, s.step[0], c.work.modal, c.work.modal.values
    n_y, n_s, theta, before, jump = s.y.size, c.s_before.size, step.theta, c.s_before, work.jump
    if form.mobile and step.whole == 0:
        step.grown = _magnified_whole(c, s)
        _take_coupling(c, s, step.length)
    if not 0.0 < step.grown < math.inf:
        return readout.NO_STEP
    s.control[0].magnified = max(s.control[0].magnified, step.grown)
    readout.basis_at(theta, x.basis)
    if charge:
        z, h = values[n_y - n_s : n_y], step.length
        errors.step_charges(form, work, h, c.integral, s.sign, z, values[n_y:])
        errors.charge_error(form, work, c.tables.lobes, h, theta, z, s.collected, s.control[0])
    for e in range(n_s):
        work.gained[e] = readout.at(values[n_y - n_s + e], x.basis) if charge else 0.0
    if step.in_jump == 0:
        errors.write_columns(form.shape, form.follow, x.w, work.s, s.y, charge, values)
        readout.write_step(s, s.control[0].t, x)
    for a in range(s.sign.size):
        if form.stress[a] > 0.0:
            area_off = 0.0
            if form.slow[a] >= 0:
                # The mode of a delayed area is the area itself.
                for p in range(readout.N_PLACES):
                    area_off = max(area_off, abs(x.places[form.slow[a], p]))
            area = work.areas[forms.AREA, a]
            readout.account(x.u[a], area, form.stress[a], theta, x.run[a], area_off, s.peaks[a])
    v_error = exponential.node_error(form.node, form.node_s, x.places, work.off)
    s.peaks[-1, readout.ERROR_U] = max(s.peaks[-1, readout.ERROR_U], v_error)
    readout.end_at(theta, x, s.error)
    if step.in_jump > 0:
        for e in range(n_s):
            before[e] = jump.before[e] + step.t_new * (jump.after[e] - jump.before[e])
    else:
        at_sources(c.sources, work.segment, step.t_new, 0.0, before, work.slopes_now)
    errors.store(form.shape, form.follow, x.w0, before, work.gained, s.y)
    return readout.GO_ON


@jit
def end(c: ManyAreas, s: LoopState) -> None:
    """End a call of the loop: if it stopped within a jump, the time is that of the jump."""
    if s.step[0].in_jump > 0:
        resume_time(c, s)
