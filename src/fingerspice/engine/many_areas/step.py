"""A step of a network, for the loop of exponential steps (`engine.collocation.loop`): any number of areas and sources.

The functions that the loop calls take the run in progress as `s` (see `engine.collocation.loopstate`) and the network
as `c`.
"""

from __future__ import annotations

import math

from fingerspice.base.compiled import jit_within
from fingerspice.engine.collocation.exponential import carry, make_tables
from fingerspice.engine.collocation.iteration import Iterates, converge, respond, weigh
from fingerspice.engine.collocation.loopstate import (
    AGAIN,
    GO_ON,
    NO_STEP,
    RETRY,
    LoopState,
    is_wanted,
    may_shorten,
    write_step,
)
from fingerspice.engine.collocation.readout import (
    ACCEPTED,
    N_PLACES,
    NFEV,
    ZEROS,
    account,
    at,
    basis_at,
    error_at,
)
from fingerspice.engine.collocation.step_control import AFTER_ZERO, Pace
from fingerspice.engine.collocation.zeros import farthest_off, first_wrong
from fingerspice.engine.many_areas import form as blocks
from fingerspice.engine.many_areas.begin import ManyAreas, branch_of, resume_time
from fingerspice.engine.many_areas.charge import charge_error, step_charges
from fingerspice.engine.many_areas.coupling import take_coupling
from fingerspice.engine.many_areas.currents import Moving, answer_mobile
from fingerspice.engine.many_areas.error import (
    account_nodes,
    assess,
    charged,
    first_zero,
    store,
    turn_at_start,
    write_columns,
)
from fingerspice.engine.many_areas.form import leaks_of
from fingerspice.engine.many_areas.rows import clear, combine, follow_sources, free, ramp_rows, source_rows
from fingerspice.engine.network import at_sources
from fingerspice.numerics.lobatto import END, NODES, POINTS

# Distance to the fold below which another method takes over, because it needs fewer evaluations there.
_NEAR_FOLD = 0.02
# Step lengths at which the iteration did not converge: if there are more than this number and this share of the steps
# taken, an implicit method is faster, and the error of such steps exceeds their estimate (a hundredfold behind a fold
# that a resistor bridges).
_UNCONVERGED, _UNCONVERGED_SHARE = 40, 0.2


@jit_within
def _take_coupling(c: ManyAreas, s: LoopState) -> None:
    """The coupling of the areas for steps of the length to be tried."""
    form, work, leaks = c.form, c.work, leaks_of(c, s)
    which = 2 * work.at[0] + int(s.step[0].in_jump > 0)
    take_coupling(
        work.own, which, s.step[0].length, leaks.rates, form.feed, form.tap, form.tap_s, form.c, leaks.g, form.home,
        form.cell,
    )  # fmt: skip


@jit_within
def attempt_many(c: ManyAreas, pace: Pace, s: LoopState) -> int:
    """Solve a step of the length to be tried, and estimate its error (infinite where it did not converge)."""
    form, work, step, tables, tol = c.form, c.work, s.step[0], c.tables, pace.tol
    leaks, branch, t, in_jump = leaks_of(c, s), branch_of(c, s), s.control[0].t, s.step[0].in_jump > 0
    h = step.length
    if h != step.tabled:
        step.slot = make_tables(
            leaks.rates, -1 if in_jump else work.at[0], h, tables.h, tables.level, tables.used, tables.decay,
            tables.phi, tables.miss,
        )  # fmt: skip
        step.tabled = h
        _take_coupling(c, s)
        step.whole = int(work.own.key[1] == 0)
        weigh(leaks.rates, work.size, tables.decay[step.slot], h, work.weight)
    if in_jump:
        ramp_rows(t, h, work.jump.before, work.jump.after, work.s, work.ds)
    else:
        slopes = pace.charge or step.smooth == 0
        source_rows(c.sources, work.segment, t, h, slopes, work.r, work.s, work.ds)
    follow_sources(form, work, leaks.gain)
    modes, u, guess = work.modes, work.areas[blocks.U], work.areas[blocks.GUESS]
    w, base, pull = modes[blocks.W], modes[blocks.BASE], modes[blocks.PULL]
    clear(guess)
    clear(work.cells[blocks.RHO])
    free(tables.decay[step.slot], work.w0, w)
    respond(modes[blocks.LIN], tables.phi[step.slot], w, base)
    used, pull_before, left_before = modes[blocks.USED], modes[blocks.PULL_BEFORE], modes[blocks.LEFT_BEFORE]
    iterates = Iterates(w, base, pull, used, pull_before, left_before, work.weight, u, guess)
    passes, closed, answer = converge(c, s, iterates, 0.3 * tol)
    s.counters[NFEV] += passes * NODES
    step.converged, step.step_error, step.grown = int(closed), math.inf, 1.0
    # An iteration that has not converged says nothing about the sign of the gap voltage.
    if not closed:
        return GO_ON
    if step.flips <= c.sign.size and turn_at_start(form.cell, u, c.sign, tol, t, branch):
        step.flips += 1
        return RETRY
    if form.mobile:
        step.grown = 1.0 / work.room[3].min()
    carry(c, s, w, pull, answer)
    error = assess(form, work, leaks, tables, step.slot, h, s.error, step.grown)
    step.step_error = max(error, charged(form.cell, u, work.areas[blocks.AREA])) if pace.charge else error
    return GO_ON


@jit_within
def refuse_many(c: ManyAreas, s: LoopState) -> int:
    """Why no shorter step would do after one that was rejected; GO_ON if one may."""
    step, t = s.step[0], s.control[0].t
    step.unconverged += int(step.converged == 0)
    # The error of a shorter step says nothing about the length at which the iteration converges.
    step.trusted = step.converged
    accepted = s.counters[ACCEPTED] - step.accepted_before
    stuck = step.unconverged > _UNCONVERGED + _UNCONVERGED_SHARE * accepted
    # A step of this length is rounding of the time: if it is rejected, there is a singularity.
    lost = step.length <= 1e-13 * max(abs(t), 1e-3 * (step.stop - t))
    return NO_STEP if stuck or lost or (step.whole > 0 and 1.0 / step.grown < _NEAR_FOLD) else GO_ON


@jit_within
def beyond_many(c: ManyAreas, pace: Pace, s: LoopState) -> float:
    """Fraction of a rejected step at which the next one should end, soon after a zero far beyond which it went; or 2.

    There the branch of an area has no meaning, and the error says nothing.
    """
    form, u, end = c.form, c.work.areas[blocks.U], 1.0
    for a in range(c.sign.size):
        if form.cell[a] >= 0 and c.sign[a] * u[a, END] < form.lo[a]:
            found = first_wrong(u[a], c.sign[a], pace.tol)
            if found > 1:
                end = min(end, 1.1 * POINTS[found])
    return end if end < 1.0 else 2.0


@jit_within
def complete_many(c: ManyAreas, pace: Pace, s: LoopState) -> int:
    """End an accepted step at a zero or an edge, write its outputs, account for its errors, and move to its end."""
    work, step, control, t = c.work, s.step[0], s.control[0], s.control[0].t
    h, stop = step.length, step.stop
    step.t_new, step.theta, step.crossed = t + h, 1.0, -1
    if step.t_new >= stop or stop - step.t_new <= 1e-12 * h:
        step.t_new, step.theta = stop, min(1.0, (stop - t) / h)
    u, turned_enough = work.areas[blocks.U], step.flips > c.sign.size
    step.crossed, step.theta, step.t_new = first_zero(
        c.form.cell, u, c.sign, pace.tol, t, h, step.theta, step.t_new, turned_enough, work.room[0]
    )  # fmt: skip
    a = step.crossed
    if a >= 0 and step.t_new <= t:
        branch = branch_of(c, s)
        c.sign[a], branch[a, 0], branch[a, 1] = -c.sign[a], t, math.inf
        step.flips += 1
        return AGAIN
    if turned_enough:
        off = 0.0
        for b in range(c.sign.size):
            if c.form.cell[b] >= 0:
                off = max(off, farthest_off(u[b], c.sign[b], step.theta))
        if off > pace.tol and may_shorten(s, t):
            return AGAIN
    if c.form.mobile and step.whole == 0:
        step.grown = _magnified_whole(c, s)
        _take_coupling(c, s)
    if not 0.0 < step.grown < math.inf:
        return NO_STEP
    control.magnified = max(control.magnified, step.grown)
    step.flips = 0
    basis_at(step.theta, work.basis)
    _write(c, pace, s, t)
    _account(c, s)
    _move(c, s)
    if a >= 0:
        _cross(c, s, a)
    control.t = step.t_new
    s.counters[ACCEPTED] += 1
    return GO_ON


@jit_within
def _magnified_whole(c: ManyAreas, s: LoopState) -> float:
    """Inverse distance of a step to the fold with all modes, also those that the step takes for stiff.

    The coupling in use becomes that in which no mode is taken for stiff.
    """
    form, work = c.form, c.work
    own, areas, spare = work.own, work.areas, work.spare_cells
    which = 2 * work.at[0] + int(s.step[0].in_jump > 0)
    take_coupling(own, which, 0.0, form.rates, form.feed, form.tap, form.tap_s, form.c, form.g, form.home, form.cell)
    clear(spare[blocks.CHI])
    clear(spare[blocks.ETA])
    combine(own.held, work.modes[blocks.W][: form.shape.shape[0]], spare[blocks.CHI])
    combine(own.from_slopes, work.s, spare[blocks.CHI])
    rows = Moving(
        areas[blocks.U], areas[blocks.MORE], areas[blocks.SLOPE], areas[blocks.RATE], spare[blocks.CHI],
        spare[blocks.ETA], spare[blocks.RHO], work.spare_areas[blocks.KNOWN], spare[blocks.SHARE],
    )  # fmt: skip
    answer_mobile(
        s.step[0].several > 0, own, form.home, form.first, form.cell, rows, work.mixed, work.matrix, work.room[3]
    )  # fmt: skip
    least: float = work.room[3, :NODES].min()
    return 1.0 / least


@jit_within
def _write(c: ManyAreas, pace: Pace, s: LoopState, t: float) -> None:
    """Charges of a step that began at t (s or, in a jump, a fraction), and its outputs."""
    form, work, step, values = c.form, c.work, s.step[0], c.work.values
    leaks, first_z, n_y = leaks_of(c, s), s.y.size - c.s_before.size, s.y.size
    if pace.charge:
        step_charges(form, work, leaks, step.length, c.integral, c.sign, values[first_z:n_y], values[n_y:])
        charge_error(
            form, work, step.length, leaks.lost, leaks.g, step.theta, work.cells[blocks.CELL_U], work.areas,
            values[first_z:], s.collected, s.control[0],
        )  # fmt: skip
    for e in range(c.s_before.size):
        work.gained[e] = at(values[first_z + e], work.basis) if pace.charge else 0.0
    if s.step[0].in_jump > 0 or not is_wanted(s, step.t_new):
        return
    write_columns(
        form.shape.shape[0], first_z, pace.charge, form.shape, form.follow, work.modes[blocks.W], work.s, s.y, values
    )  # fmt: skip
    write_step(s, t, values, work.coefficients, work.outputs)


@jit_within
def _account(c: ManyAreas, s: LoopState) -> None:
    """Peaks of a step, and the errors of the run in it."""
    form, work, areas = c.form, c.work, c.work.areas
    for a in range(c.sign.size):
        if form.stress[a] > 0.0:
            area_off = 0.0
            if form.slow[a] >= 0:
                # The mode of a delayed area is the area itself.
                for p in range(N_PLACES):
                    area_off = max(area_off, abs(work.places[form.slow[a], p]))
            account(
                areas[blocks.U, a], areas[blocks.AREA, a], form.stress[a], s.step[0].theta, work.run[a], area_off,
                s.peaks[a],
            )  # fmt: skip
    account_nodes(form.node, form.node_s, work.places, work.off, s.peaks[c.sign.size])


@jit_within
def _move(c: ManyAreas, s: LoopState) -> None:
    """State and error at the end of a step, or where it is cut short."""
    form, work, theta, t_new = c.form, c.work, s.step[0].theta, s.step[0].t_new
    w, w0, before, after = work.modes[blocks.W], work.w0, work.jump.before, work.jump.after
    for k in range(w0.size):
        w0[k] = at(w[k], work.basis)
    if theta < 1.0:
        error_at(work.places, theta, s.error)
    else:
        for k in range(w0.size):
            s.error[k] = work.places[k, N_PLACES - 1]
    if s.step[0].in_jump > 0:
        for e in range(before.size):
            c.s_before[e] = before[e] + t_new * (after[e] - before[e])
    else:
        at_sources(c.sources, work.segment, t_new, 0.0, c.s_before, work.slopes_now)
    store(form.shape, form.follow, w0, c.s_before, work.gained, s.y)


@jit_within
def _cross(c: ManyAreas, s: LoopState, a: int) -> None:
    """Change the branch of area a at a zero of its gap voltage, which ends a step."""
    control, branch, t_new = s.control[0], branch_of(c, s), s.step[0].t_new
    c.sign[a] = -c.sign[a]
    branch[a, 0], branch[a, 1] = t_new, t_new - branch[a, 0]
    s.counters[ZEROS] += 1
    # The area has a kink here, which excites the fast modes again.
    if control.h_after_zero > 0.0:
        control.h, control.allowed = control.h_after_zero, 0.0
    s.step[0].fresh = AFTER_ZERO


@jit_within
def end_many(c: ManyAreas, s: LoopState) -> None:
    """End a call of the loop: if it stopped within a jump, the time is that of the jump."""
    if s.step[0].in_jump > 0:
        resume_time(c, s)
