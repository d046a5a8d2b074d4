"""The end of a step of a series stack, and what remains of it: outputs, errors, the state; see `step`."""

from __future__ import annotations

import numpy as np

from fingerspice.base.arrays import FloatArray
from fingerspice.base.compiled import jit, jit_rows, jit_within
from fingerspice.engine.collocation.exponential import between
from fingerspice.engine.collocation.loopstate import (
    AGAIN,
    GO_ON,
    NO_STEP,
    OUT_OF_RANGE,
    LoopState,
    is_wanted,
    may_shorten,
    write_step,
)
from fingerspice.engine.collocation.readout import (
    ACCEPTED,
    ERROR_U,
    N_PLACES,
    PEAK_U,
    ZEROS,
    account,
    at,
    basis_at,
    error_at,
    layers,
    row_of,
)
from fingerspice.engine.collocation.step_control import AFTER_ZERO, Pace
from fingerspice.engine.collocation.zeros import farthest_off, zero
from fingerspice.engine.one_area.charge import charge_step
from fingerspice.engine.one_area.model import dot, turns_at_zero
from fingerspice.engine.one_area.rows import DQ, SCRATCH, SOURCE, X_GAP, Q, U
from fingerspice.engine.one_area.step import OneArea, flip, source_voltage
from fingerspice.numerics.lobatto import END, NODES, POINTS, ROWS


@jit
def node_error(
    mobile: bool, area0: float, node: FloatArray, k_node: FloatArray, gap: FloatArray, w: FloatArray, r: FloatArray,
    places: FloatArray,
) -> float:  # fmt: skip
    """Largest error of any node's voltage over a step (V) from that of the modes; see `assess`.

    Under `mobile` the voltages are the modes times 1/A: their error contains that of A, and the interpolation error of
    the product.
    """
    if not mobile:
        return _linear_error(node, k_node, r[SOURCE], places)
    own, missed, values = np.zeros((places.shape[0], N_PLACES)), np.zeros(N_PLACES), np.zeros(ROWS)
    moved = np.zeros(N_PLACES)
    for p in range(N_PLACES):
        for k in range(gap.size):
            own[k, p] = area0 * r[Q, row_of(p)] * places[k, p]
    for k in range(gap.size):
        missed[1], missed[2], missed[3] = between(w[k])
        for p in range(N_PLACES):
            own[k, p] -= area0 * r[Q, row_of(p)] * missed[p]
            moved[p] += gap[k] * own[k, p]
    for p in range(N_PLACES):
        row = row_of(p)
        moved[p] *= area0 * r[DQ, row] / max(1.0 - area0 * r[X_GAP, row] * r[DQ, row], 1e-12)
    worst = 0.0
    for i in range(k_node.size):
        for j in range(ROWS):
            values[j] = 0.0
            for k in range(gap.size):
                values[j] += node[i, k] * w[k, j]
            values[j] *= area0 * r[Q, j]
            values[j] += k_node[i] * r[SOURCE, j]
        missed[1], missed[2], missed[3] = between(values)
        for p in range(N_PLACES):
            total = missed[p]
            for k in range(gap.size):
                total += node[i, k] * (own[k, p] + moved[p] * w[k, row_of(p)])
            worst = max(worst, abs(total))
    return worst


@jit_rows
def _linear_error(node: FloatArray, k_node: FloatArray, source: FloatArray, places: FloatArray) -> float:
    """Largest error of a node's voltage under `local`, where the voltages are linear in the modes and the source, V."""
    first, second, third = between(source)
    worst = 0.0
    for i in range(k_node.size):
        share = k_node[i]
        at_start, at_first, at_second, at_third, at_end = 0.0, share * first, share * second, share * third, 0.0
        for k in range(places.shape[0]):
            share = node[i, k]
            at_start += share * places[k, 0]
            at_first += share * places[k, 1]
            at_second += share * places[k, 2]
            at_third += share * places[k, 3]
            at_end += share * places[k, 4]
        worst = max(worst, abs(at_start), abs(at_first), abs(at_second), abs(at_third), abs(at_end))
    return worst


@jit_within
def complete_one(c: OneArea, pace: Pace, s: LoopState) -> int:
    """End an accepted step at a zero or an edge, write its outputs, account for its errors, and move to its end."""
    step, control, t = s.step[0], s.control[0], s.control[0].t
    h, since, length = step.length, step.since, step.stop - step.start
    reached = since + h
    step.theta, step.crossed = 1.0, -1
    if reached >= length or length - reached <= 1e-12 * h:
        reached = length
        step.theta = min(1.0, (length - since) / h)
    if step.wrong > 0 or step.below > 0.0:
        crossing = zero(c.work.r[U], control.sign, step.wrong, step.below, c.work.coefficients[0])
        if since + crossing * h <= since:
            if step.flips < 2:
                return flip(s)
            if farthest_off(c.work.r[U], control.sign, step.theta) > pace.tol and may_shorten(s, since):
                return AGAIN
        elif since + crossing * h <= reached and crossing <= step.theta:
            step.theta, reached, step.crossed = crossing, since + crossing * h, 0
    step.flips = 0
    step.t_new = step.stop if reached == length else step.start + reached
    _write(c, pace, s, t)
    _account(c, s)
    _move(c, pace.charge, s)
    if step.crossed >= 0 and not _cross(c, s):
        return NO_STEP
    control.t, step.since = step.t_new, reached
    if control.t >= step.stop:
        control.u_before = source_voltage(c, s, control.t - step.start)
    s.counters[ACCEPTED] += 1
    return OUT_OF_RANGE if s.peaks[0, PEAK_U] > c.system.u_top else GO_ON


@jit_within
def _write(c: OneArea, pace: Pace, s: LoopState, t: float) -> None:
    """Charge of a step that began at t (s), and its outputs."""
    system, work, step, level = c.system, c.work, s.step[0], s.step[0].level
    model, shown, values = system.model, system.shown[level], work.values
    n_shown = shown.shape[0]
    if pace.charge:
        charge_step(
            system, work, level, c.integral, step.length, s.y[work.w0.size], step.theta, s.control[0], s.collected,
            values[n_shown], values[n_shown + 1],
        )  # fmt: skip
    if not is_wanted(s, step.t_new):
        return
    layers(model.mobile, model.area0, system.k_shown, shown, work.w, work.r[SOURCE], work.r[Q], values)
    write_step(s, t, values, work.coefficients, work.outputs)


@jit_within
def _account(c: OneArea, s: LoopState) -> None:
    """Peaks of a step, and the errors of the run in it."""
    system, work, step, control, level = c.system, c.work, s.step[0], s.control[0], s.step[0].level
    model, r = system.model, c.work.r
    control.magnified = max(control.magnified, step.grown)
    for i in range(ROWS):
        r[SCRATCH, i] = 1.0 / r[Q, i]
        if model.mobile and model.coupled and i < NODES and POINTS[i] <= step.theta:
            control.margin = min(control.margin, 1.0 - model.area0 * r[X_GAP, i] * r[DQ, i])
    account(r[U], r[SCRATCH], system.stress, step.theta, work.run, 0.0, s.peaks[0])
    v_error = node_error(
        model.mobile, model.area0, system.node[level], system.k_node, system.gap[level], work.w, r, work.places
    )  # fmt: skip
    s.peaks[1, ERROR_U] = max(s.peaks[1, ERROR_U], v_error)


@jit_within
def _move(c: OneArea, charge: bool, s: LoopState) -> None:
    """State and error at the end of a step, or where it is cut short."""
    system, work, control, theta, y = c.system, c.work, s.control[0], s.step[0].theta, s.y
    n, r, w, w0, places, basis, error = work.w0.size, work.r, work.w, work.w0, work.places, work.basis, s.error
    n_shown = system.shown.shape[1]
    if theta < 1.0:
        basis_at(theta, basis)
        for k in range(n):
            w0[k] = at(w[k], basis)
        error_at(places, theta, error)
        if charge:
            y[n], control.last_q = at(work.values[n_shown], basis), at(r[Q], basis)
        control.u_gap = 0.0 if s.step[0].crossed >= 0 else at(r[U], basis)
    else:
        for k in range(n):
            w0[k], error[k] = w[k, END], places[k, N_PLACES - 1]
        if charge:
            y[n], control.last_q = work.values[n_shown, END], r[Q, END]
        control.u_gap = r[U, END]
    live = system.live[s.step[0].level]
    for i in range(n):
        y[i] = 0.0
        for k in range(n):
            y[i] += live[i, k] * w0[k]


@jit_within
def _cross(c: OneArea, s: LoopState) -> bool:
    """Change the branch at a zero of the gap voltage, which ends a step; False at a fold there."""
    step, control, model, t_new = s.step[0], s.control[0], c.system.model, s.step[0].t_new
    control.sign = -control.sign
    control.branch_length = t_new - control.branch_start
    control.branch_start = t_new
    s.counters[ZEROS] += 1
    if turns_at_zero(model, dot(model.gap, s.y), control.sign):
        control.t = t_new
        control.sign = -control.sign
        control.margin = 0.0
        return False
    # The area has a kink here, which excites fast modes again: the first step is chosen as after other zeros.
    if step.below > 0.0:
        # The gap voltage returns to 0 V soon.
        control.h = 2.0 * (step.below - step.theta) * step.length
        control.allowed = 0.0
    elif control.h_after_zero > 0.0:
        control.h = control.h_after_zero
        control.allowed = 0.0
    s.step[0].fresh = AFTER_ZERO
    return True


@jit_within
def end_one(c: OneArea, s: LoopState) -> None:
    """End a call of the loop: nothing is left to do."""
