"""Steps of a series stack, for the loop of exponential steps (`engine.collocation.loop`): one area and one source.

The functions that the loop calls take the run in progress as `s` (see `engine.collocation.readout`) and the stack as
`c`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from fingerspice.base.arrays import FloatArray
from fingerspice.base.compiled import jit, jit_within
from fingerspice.engine.collocation import exponential, readout, step_control
from fingerspice.engine.collocation.exponential import Tables, between, largest
from fingerspice.engine.collocation.readout import N_PLACES, LoopState
from fingerspice.engine.collocation.step_control import Pace
from fingerspice.engine.network import Sources, on_branch, source
from fingerspice.engine.one_area import rows
from fingerspice.engine.one_area.charge import charge_step
from fingerspice.engine.one_area.model import dot, turns_at_zero
from fingerspice.engine.one_area.rows import DQ, GUESS, SCRATCH, SLOPE, SOURCE, X_GAP, Q, U, Work
from fingerspice.engine.one_area.system import System
from fingerspice.numerics.lobatto import END, FIRST, MISS, NODES, POINTS, ROWS, SECOND, THIRD, combine, multiply
from fingerspice.numerics.modes import apply

# A gap voltage below this fraction of the one at the next node counts as 0.
_AT_ZERO = 1e-9
# Distance to the fold below which the iteration converges for very short steps only. Methods that solve the area
# equation at every evaluation reach the fold sooner and take over.
_NEAR_FOLD = 0.01


class OneArea(NamedTuple):
    """A stack and its source, as the loop takes it."""

    # system, tables, work: The modal system, its tables of exponentials, and scratch arrays
    system: System
    tables: Tables
    work: Work
    integral: FloatArray  # `lobatto.integral_table()`
    sources: Sources  # One alone


@jit_within
def start(c: OneArea, s: LoopState) -> None:
    """Begin a window of the source."""
    step, control, counters = s.step[0], s.control[0], s.counters
    # The segment is found and entered at the first step, as the edge is not after the present time.
    step.index, step.start, step.edge, step.since, step.begun = -1, 0.0, control.t, 0.0, control.t
    step.fresh, step.evaluated = step_control.NOT_FRESH, counters[readout.NFEV]
    step.most = counters[readout.ACCEPTED] + counters[readout.REJECTED] + readout.MOST_STEPS


@jit_within
def begin(c: OneArea, pace: Pace, s: LoopState, t_end: float) -> int:
    """Where the next step starts: after a jump of the source, from the modes of the reference area; and its length."""
    step, control, counters = s.step[0], s.control[0], s.counters
    model, t = c.system.model, control.t
    if not t < t_end:
        return readout.DONE
    evaluated = counters[readout.NFEV] - step.evaluated
    if evaluated > NODES * readout.FIRST_PASSES:
        longest = (t - step.begun) / pace.h_max
        if evaluated > NODES * (readout.FIRST_PASSES + readout.MOST_PASSES * longest):
            return readout.TOO_MANY
    while t >= step.edge:
        step.index += 1
        step.start, step.edge = c.sources.edges[step.index], c.sources.edges[step.index + 1]
        if step.edge > t and not _enter_segment(c, pace, s):
            return readout.NO_STEP
    step.stop = min(step.edge, t_end)
    _take_level(c, s)
    apply(c.system.project[step.level], s.y, c.work.modal.w0)
    length = step.stop - step.start
    step.length = step_control.choose_step(
        pace, model.tau, c.sources.series.shape[1] > 0, s.branch, length - step.since, control
    )  # fmt: skip
    return readout.GO_ON


@jit_within
def _enter_segment(c: OneArea, pace: Pace, s: LoopState) -> bool:
    """Take the jump of the source at the start of a segment; False if it meets a fold."""
    step, control = s.step[0], s.control[0]
    # Time is counted from the edge: a transient after it may be faster than the rounding of t.
    step.since = control.t - step.start
    step.begun, step.evaluated = control.t, s.counters[readout.NFEV]
    u = source_voltage(c, s, step.since)
    if not step_control.enter(c.system.model, pace.charge, u, s.y, control, s.sign, s.branch):
        return False
    # Try the step that was right after the edge before: similar jumps often need similar steps.
    control.h, control.too_long, control.allowed = control.h_after_edge, 0.0, 0.0
    step.fresh = step_control.AFTER_EDGE
    return True


@jit_within
def source_voltage(c: OneArea, s: LoopState, tau: float) -> float:
    """Source voltage (V) `tau` s into the segment at hand."""
    step = s.step[0]
    u, _ = source(c.sources.terms[step.index], c.sources.series[step.index], step.edge - step.start, tau)
    return u


@jit_within
def _take_level(c: OneArea, s: LoopState) -> None:
    """Go over to the reference area nearest to the present area; the error of the modes goes along."""
    system, step, error = c.system, s.step[0], s.error
    n, now = system.model.gap.size, 0
    if system.q0.size > 1:
        q = s.control[0].last_q
        if step.fresh == step_control.AFTER_EDGE or not q > 0.0:
            q, _ = on_branch(system.model.mobile, system.model.curve, s.sign[0], s.control[0].u_gap)
        now = step_control.nearest_level(system.q0, q)
    if now == step.level:
        return
    if error[n] != now:
        # The modes at the start of the step are not there yet.
        x = c.work.modal.w0
        apply(system.live[int(error[n])], error, x)
        apply(system.project[now], x, error)
        error[n] = now
    step.level, s.step[0].tabled = now, 0.0


@jit_within
def attempt(c: OneArea, pace: Pace, s: LoopState) -> int:
    """Solve a step of the length to be tried, and estimate its error (infinite where it did not converge)."""
    system, x, step, control, counters = c.system, c.work.modal, s.step[0], s.control[0], s.counters
    model, r, tol, level, sign = system.model, c.work.r, pace.tol, s.step[0].level, s.sign[0]
    h, u_rows = step.length, r[U]
    if h != step.tabled:
        exponential.take_tables(c, s, level, h, system.rates[level], system.gap[level])
    rows.source_rows(
        c.sources.terms[step.index], c.sources.series[step.index], step.edge - step.start, step.since, h, pace.charge,
        r[SOURCE], r[SLOPE], r[SCRATCH:],
    )  # fmt: skip
    if model.mobile:
        for i in range(ROWS):
            r[GUESS, i] = control.u_gap
    # With the area held at its reference: the modes' decay, and their response to the source.
    exponential.free(c.tables.decay[step.slot], x.w0, x.w)
    multiply(system.gain[level][:, np.newaxis], r[SOURCE : SOURCE + 1], None, x.used)
    exponential.respond(x.used, c.tables.phi[step.slot], x.w, x.base)
    passes, closed, answer = exponential.converge(c, s, 0.3 * tol)
    counters[readout.NFEV] += passes * NODES
    step.wrong = step_control.first_wrong(u_rows, sign, tol) if model.coupled else 0
    # Node 1 may be off its branch only because the iteration did not converge: also require a start near 0 V.
    at_zero = sign * u_rows[0] <= _AT_ZERO * min(abs(u_rows[1]), system.u_top)
    if step.wrong == 1 and step.flips < 2 and at_zero:
        # The step starts at a zero, and the gap voltage leaves it to the other side: change the branch.
        if turns_at_zero(model, r[X_GAP, 0], -sign):
            control.margin = 0.0
            return readout.NO_STEP
        return step_control.turn(s, 0)
    step.below = step_control.dip(u_rows, sign, tol, step.wrong, x.coefficients[0]) if model.coupled and closed else 0.0
    if 0.0 < step.below < POINTS[1] and at_zero:
        # The gap voltage starts at a zero and soon returns to it: a shorter step resolves this.
        counters[readout.REJECTED] += 1
        step.length = step_control.rung(2.0 * step.below * h)
        step.wanted = control.h = step.length
        step.flips = 0
        return readout.RETRY
    step.converged, step.step_error = int(closed), math.inf
    if closed:
        exponential.carry(c, s, system.gap[level : level + 1], answer)
        step.step_error, step.grown = _assess(c, s)
    return readout.GO_ON


@jit_within
def _assess(c: OneArea, s: LoopState) -> tuple[float, float]:
    """Error of a converged step: interpolation error between the nodes, residual of the iteration, earlier error.

    `places` takes the errors of the modes, that of the dense output included, `run` the whole error of the gap voltage.
    Returned are the largest error of the gap voltage by this step's interpolation alone (V), which controls the step's
    length, and the largest ratio of a move of the gap voltage to the move of a state voltage that causes it.
    """
    system, work, step, x, level = c.system, c.work, s.step[0], c.work.modal, s.step[0].level
    r, off, sums, run, gain, gap = work.r, work.off, work.sums, x.run[0], system.gain[level], system.gap[level]
    mobile, area0, places, n = system.model.mobile, system.model.area0, x.places, x.w0.size
    off[0, n], off[1, n], off[2, n] = between(c.tables.lobes, r[SOURCE])
    # Outputs are read from the polynomial through the gap voltages at the nodes: its interpolation error counts.
    sums[:] = 0.0
    sums[0, 0], sums[0, 1], sums[0, 2] = between(c.tables.lobes, r[U])
    for k in range(n):
        lin = (gain[k] * off[0, n], gain[k] * off[1, n], gain[k] * off[2, n])
        exponential.mode_error(x, k, lin, c.tables, step.slot, (FIRST, SECOND, THIRD, END), 1.0, s.error[k], off)
        for p in range(4):
            sums[1, p] += gap[k] * off[p, k]
            sums[2, p] += gap[k] * places[k, p + 1]
        for p in range(N_PLACES):
            places[k, p] += x.brief[k, p]
    worst, magnified, run[0] = 0.0, 1.0, 0.0
    for p in range(4):
        row = readout.row_of(p + 1)
        factor = 1.0
        if mobile:
            # The modes' part of the gap voltage is multiplied by A_0 / A, and its error grows near the fold.
            factor = area0 * r[Q, row] / max(1.0 - area0 * r[X_GAP, row] * r[DQ, row], 1e-12)
            magnified = max(magnified, factor)
        worst = max(worst, abs(factor * sums[1, p] + sums[0, p]))
        run[p + 1] = abs(factor * sums[2, p] + sums[0, p])
    # The charge contains the integral of A dU: the interpolation error of 1/A counts times the change of the source.
    area_first, area_second, area_third = between(c.tables.lobes, r[Q])
    swing = 0.3 * abs(r[SOURCE, END] - r[SOURCE, 0])
    missed = abs(largest(area_first / MISS[0], area_second / MISS[1], area_third / MISS[2]))
    return max(worst, swing * missed / r[Q, 0]), magnified


@jit_within
def refuse(c: OneArea, pace: Pace, s: LoopState) -> int:
    """Why no shorter step would do after one that was rejected; GO_ON if one may.

    `too_far` is set to the fraction of it at which the next one should end, soon after a zero far beyond which it went,
    as there the branch of an area has no meaning, and the error says nothing; or to 2.
    """
    system, step, r = c.system, s.step[0], c.work.r
    model, wrong = system.model, step.wrong
    step.too_far = 1.1 * POINTS[wrong] if wrong > 1 and s.sign[0] * r[U, END] < system.lo else 2.0
    # A step rejected beyond the end of the area's polynomial: shorter ones would creep up to the kink there.
    if model.coupled and abs(s.control[0].u_gap) > 0.9 * system.u_top and rows.largest_size(r[U]) > system.u_top:
        return readout.OUT_OF_RANGE
    # A step of the size of the time's rounding is rejected: the solution has a singularity here.
    if step.length <= 1e-15 * step.since + 1e-25 * (step.edge - step.start):
        return readout.NO_STEP
    if model.mobile and 1.0 - model.area0 * r[X_GAP, 0] * r[DQ, 0] < _NEAR_FOLD:
        return readout.NO_STEP
    return readout.GO_ON


@jit
def _node_error(c: OneArea, level: int) -> float:
    """Largest error of any node's voltage over a step (V) from that of the modes; see `_assess`.

    Under `mobile` the voltages are the modes times 1/A: their error contains that of A, and the interpolation error of
    the product.
    """
    system, r, x, node_s = c.system, c.work.r, c.work.modal, c.system.k_node[:, np.newaxis]
    area0, gap, n = system.model.area0, system.gap[level], x.w.shape[0]
    if not system.model.mobile:
        return exponential.node_error(system.node[level], node_s, x.places, c.work.off)
    own, values, moved = np.zeros((n, N_PLACES)), np.zeros(ROWS), np.zeros(N_PLACES)
    for p in range(N_PLACES):
        row = readout.row_of(p)
        scale = area0 * r[Q, row]
        for k in range(n):
            own[k, p] = scale * (x.places[k, p] - x.brief[k, p])
            moved[p] += gap[k] * own[k, p]
        moved[p] *= area0 * r[DQ, row] / max(1.0 - area0 * r[X_GAP, row] * r[DQ, row], 1e-12)
    for k in range(n):
        for j in range(ROWS):
            values[j] = area0 * r[Q, j] * x.w[k, j]
        missed = between(c.tables.lobes, values)
        for p in range(N_PLACES):
            own[k, p] += moved[p] * x.w[k, readout.row_of(p)] + (missed[p - 1] if 0 < p < N_PLACES - 1 else 0.0)
    return exponential.node_error(system.node[level], node_s, own, c.work.off)


@jit_within
def crossing(c: OneArea, pace: Pace, s: LoopState, a: int) -> float:
    """Fraction of an accepted step at which the gap voltage leaves its branch, or 2."""
    wrong, below = s.step[0].wrong, s.step[0].below
    if wrong == 0 and below == 0.0:
        return 2.0
    return float(step_control.zero(c.work.r[U], s.sign[0], wrong, below, c.work.modal.coefficients[0]))


@jit_within
def finish(c: OneArea, charge: bool, s: LoopState) -> int:
    """Charge, outputs, peaks and errors of a step, and the state at its end or where it is cut."""
    system, r, step, control, x, y = c.system, c.work.r, s.step[0], s.control[0], c.work.modal, s.y
    model, shown, values, theta = system.model, system.shown[step.level], x.values, step.theta
    n_shown = shown.shape[0]
    if charge:
        charge_step(c, s, values[n_shown], values[n_shown + 1])
    multiply(shown, x.w, None, values)
    for i in range(n_shown if model.mobile else 0):
        for j in range(ROWS):
            values[i, j] *= model.area0 * r[Q, j]
    combine(system.k_shown[:, np.newaxis], r[SOURCE : SOURCE + 1], 0, values)
    readout.write_step(s, control.t, x)
    control.magnified = max(control.magnified, step.grown)
    for i in range(ROWS):
        r[SCRATCH, i] = 1.0 / r[Q, i]
    for i in range(NODES if model.mobile and model.coupled else 0):
        if POINTS[i] <= theta:
            control.margin = min(control.margin, 1.0 - model.area0 * r[X_GAP, i] * r[DQ, i])
    readout.account(r[U], r[SCRATCH], system.stress, theta, x.run[0], 0.0, s.peaks[0])
    s.peaks[1, readout.ERROR_U] = max(s.peaks[1, readout.ERROR_U], _node_error(c, step.level))
    readout.basis_at(theta, x.basis)
    readout.end_at(theta, x, s.error)
    if charge:
        y[-1] = readout.at(values[n_shown], x.basis)
    control.last_q = readout.at(r[Q], x.basis)
    control.u_gap = 0.0 if step.crossed >= 0 else readout.at(r[U], x.basis)
    apply(system.live[step.level], x.w0, y)
    if step.crossed >= 0 and turns_at_zero(model, dot(model.gap, y), -s.sign[0]):
        control.t, control.margin = step.t_new, 0.0
        return readout.NO_STEP
    if step.t_new >= step.stop:
        control.u_before = source_voltage(c, s, step.t_new - step.start)
    return readout.OUT_OF_RANGE if s.peaks[0, readout.PEAK_U] > system.u_top else readout.GO_ON


@jit_within
def end(c: OneArea, s: LoopState) -> None:
    """End a call of the loop: nothing is left to do."""
