"""The loop of exponential steps of a network; `march` is that of a stack, and both choose step lengths by `pace`."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fingerspice.base.arrays import FloatArray, IntArray
from fingerspice.base.compiled import borrow, jit
from fingerspice.engine import netassess, netrows
from fingerspice.engine.coupling import take_coupling
from fingerspice.engine.exponential import Tables, make_tables, weigh
from fingerspice.engine.netassess import account, assess, charged, first_zero, load, store, turn_at_start, write_columns
from fingerspice.engine.netcharge import charge_error
from fingerspice.engine.netgrowth import carry
from fingerspice.engine.netrows import Form, Work, follow_sources
from fingerspice.engine.netstep import all_zero, magnified_whole, ramp_rows, solve_step, source_rows, step_charges
from fingerspice.engine.network import Sources, at_sources
from fingerspice.engine.pace import Pace, accept, allowed_factor, choose_step, rung, shorten
from fingerspice.engine.readout import (
    ACCEPTED,
    ALLOWED,
    BRANCH_LENGTH,
    BRANCH_START,
    ERROR_Q,
    H_AFTER_EDGE,
    H_AFTER_ZERO,
    KEPT,
    MAGNIFIED,
    N_CONTROL,
    N_PLACES,
    NFEV,
    OUTPUT,
    RECORDED,
    REJECTED,
    TOO_LONG,
    ZEROS,
    H,
    Steps,
    T,
    at,
    basis_at,
    error_at,
    note,
    record,
    series_of,
    write_outputs,
)  # fmt: skip
from fingerspice.engine.references import References, far_from, find, go_over, start_at
from fingerspice.engine.repeat import Kept
from fingerspice.engine.zeros import first_wrong
from fingerspice.numerics.lobatto import END, NODES, POINTS
from fingerspice.numerics.small import copy_to
from fingerspice.physics.contact import inverse_area

# Codes returned by `march`.
DONE, NO_STEP, TOO_MANY, REFERENCE, PAUSED = 0, 1, 2, 3, 4
# One entry of `control` in addition to those of `readout`: the most steps, accepted and rejected.
MOST = N_CONTROL
# Relative change of a source at an edge that counts as rounding error, not as a jump.
ROUNDING, UNNOTICED = 1e-14, 1e-9
# Distance to the fold below which another method takes over, because it needs fewer evaluations there.
NEAR_FOLD = 0.02
# Step lengths at which the iteration did not converge: if there are more than this number and this share of the steps
# taken, an implicit method is faster, and the error of such steps exceeds their estimate (a hundredfold behind a fold
# that a resistor bridges).
UNCLOSED, UNCLOSED_SHARE = 40, 0.2
# Number of modes times steps between two pauses, in which Python can react to Ctrl-C.
AT_ONCE = 40_000


@jit
def march(
    form: Form, references: References, pace: Pace, tables: Tables, work: Work, integral: FloatArray, sources: Sources,
    u_scale: float, t_end: float, y: FloatArray, error: FloatArray, sign: FloatArray, s_before: FloatArray,
    branch: FloatArray, control: FloatArray, counters: IntArray, peaks: FloatArray, collected: FloatArray,
    t_out: FloatArray, left: NDArray[np.bool_], out: FloatArray, kept: Kept, steps: Steps,
    tried: FloatArray,
) -> int:  # fmt: skip
    """Step to `t_end` through the sources' segments, writing outputs on the way.

    Within a jump of the sources the independent variable is the fraction of the jump, and time stands still: the same
    network, in which nothing leaks.

    Parameters
    ----------
    form, references, pace, tables, work, integral
        The network, the rules for steps, tables and scratch; `integral` is `lobatto.integral_table()`. The form is that
        of one reference, whose number is in `work.at`; both change if an area moves away from its reference.
    sources : Sources
    u_scale : float
        Largest voltage, V; the error of an area with a time constant is measured as a fraction of it.
    t_end : float
        s, not past the last edge; if it equals the time reached, only a jump at that time is taken.
    y : ndarray
        State as in `engine.network`; updated, as all arrays that follow.
    error : ndarray, shape (m,)
        Estimated error of the modes, signed.
    sign, s_before : ndarray
        Branch of each area (0: to be chosen), and the sources' values just before the time reached.
    branch : ndarray, shape (n_area, 2)
        Time at which each area's branch began, and length of the branch before, s.
    control, counters, peaks, collected : ndarray
        Bookkeeping, as described in `readout`, `netassess` and `charge_error`.
    t_out, left, out : ndarray
        Output times (s, ascending), whether the left-hand limit is meant, and the columns to fill: the state, then
        the currents.
    kept : Kept
        Takes the first steps, for repeated periods, until it is full.
    steps : Steps
        Takes all steps: state voltages, and areas that have a time constant.
    tried : ndarray, shape (TRIED, 4)
        Ring buffer of the last steps tried: start and length (s), ratio of the error to the allowed one, number from 1.

    Returns
    -------
    int
        DONE; NO_STEP (no step is short enough); TOO_MANY (steps); REFERENCE (the areas need a reference that has not
        been made yet); or PAUSED (call again).
    """
    # Borrowed arrays have no reference count: it would cost an atomic operation at every access to a tuple.
    form, references, tables, work, sources = (
        borrow(form), borrow(references), borrow(tables), borrow(work), borrow(sources)
    )  # fmt: skip
    kept, steps, time_branch = borrow(kept), borrow(steps), borrow(branch)
    y, error, sign, s_before = borrow(y), borrow(error), borrow(sign), borrow(s_before)
    control, counters, peaks, collected = borrow(control), borrow(counters), borrow(peaks), borrow(collected)
    t_out, left, out, tried = borrow(t_out), borrow(left), borrow(out), borrow(tried)
    integral = borrow(integral)
    mobile = form.mobile
    shape, follow, home, cell, slow = form.shape, form.follow, form.home, form.cell, form.slow
    s, ds, modes, cells, areas, values = work.s, work.ds, work.modes, work.cells, work.areas, work.values
    w, u = modes[netrows.W], areas[netrows.U]
    w0, places, room = work.w0, work.places, work.room
    kept_times, kept_series, step_times = kept.times, kept.series, steps.times
    n, n_s, m, n_area = shape.shape[0], s_before.size, form.rates.size, sign.size
    first_z = y.size - n_s
    tol, charge = pace.tol, pace.charge
    is_series = sources.series.shape[1] > 0
    index, now, slopes_now = np.zeros(n_s, np.int64), np.zeros(n_s), np.zeros(n_s)
    run, gained, basis = np.zeros((n_area, N_PLACES)), np.zeros(n_s), np.zeros(NODES)
    several = False
    for b in range(1, home.size):
        several |= home[b] != home[0]
    # Within a jump: the sources before and after it, and the quantities that are put aside for its duration.
    inside = False
    jump_from, jump_to, aside = np.zeros(n_s), np.zeros(n_s), np.zeros(control.size)
    sign_aside, jump_branch = np.zeros(n_area), np.zeros((n_area, 2))
    no_rates, no_gain, no_leaks = np.zeros(m), np.zeros((m, n_s)), np.zeros(home.size)
    nothing_lost, nothing_lost_s = np.zeros((n_s, n)), np.zeros((n_s, n_s))
    smooth = all_zero(form.tap_s, form.stored_s, follow, form.gap_s)
    areas[:] = 0.0
    start_at(form.area0, areas[netrows.AREA])
    here, size = np.zeros(n_area), np.full(m, u_scale)
    copy_to(size[:n], form.size)
    slot, h_slot, flips, fresh, whole, closing, begun, which_coupling = -1, 0.0, 0, -1, True, False, False, 0
    first_out = counters[OUTPUT]
    next_out = t_out[first_out] if first_out < t_out.size else math.inf
    pause = counters[ACCEPTED] + 1 + AT_ONCE // m
    rates, gain, g, area_pace, lost, lost_s = form.rates, form.gain, form.g, form.pace, form.lost, form.lost_s
    branch = time_branch
    own = work.own
    code, unclosed, accepted = DONE, 0, counters[ACCEPTED]
    while True:
        t = control[T]
        if inside and t >= 1.0:
            inside = False
            aside[ERROR_Q], aside[MAGNIFIED] = control[ERROR_Q], control[MAGNIFIED]
            copy_to(control, aside)
            copy_to(s_before, jump_to)
            t = control[T]
            for a in range(n_area):
                if sign[a] != sign_aside[a]:
                    time_branch[a, 0], time_branch[a, 1] = t, math.inf
            rates, gain, g, area_pace, lost, lost_s = form.rates, form.gain, form.g, form.pace, form.lost, form.lost_s
            branch, h_slot = time_branch, 0.0
        if counters[ACCEPTED] + counters[REJECTED] > control[MOST]:
            code = TOO_MANY
            break
        stop = 1.0
        at_edge = False
        if not inside:
            if begun and t >= t_end:
                break
            if counters[ACCEPTED] >= pause or counters[RECORDED] >= step_times.shape[0] > 0:
                code = PAUSED
                break
            stop = t_end
            for i in range(n_s):
                while sources.edges[sources.first[i] + index[i] + 1] <= t:
                    index[i] += 1
                at_edge |= sources.edges[sources.first[i] + index[i]] == t
                stop = min(stop, sources.edges[sources.first[i] + index[i] + 1])
            at_sources(sources, index, t, 0.0, now, slopes_now)
            # The time at which a call starts may differ from an edge by rounding.
            least = ROUNDING if at_edge else (math.inf if begun else UNNOTICED)
            begun = True
            jumps = False
            for i in range(n_s):
                jumps |= abs(now[i] - s_before[i]) > least * max(abs(now[i]), abs(s_before[i]))
            if jumps and smooth:
                copy_to(s_before, now)
            elif jumps:
                inside = True
                copy_to(aside, control)
                copy_to(sign_aside, sign)
                copy_to(jump_from, s_before)
                copy_to(jump_to, now)
                jump_branch[:] = 0.0
                control[:] = 0.0
                control[ERROR_Q], control[MAGNIFIED], control[MOST] = aside[ERROR_Q], aside[MAGNIFIED], aside[MOST]
                rates, gain, g, area_pace = no_rates, no_gain, no_leaks, no_rates
                lost, lost_s = nothing_lost, nothing_lost_s
                branch, h_slot = jump_branch, 0.0
                t, stop, at_edge = 0.0, 1.0, False
                copy_to(now, jump_from)
            if not inside and t >= t_end:
                break
        else:
            copy_to(now, s_before)
        if at_edge:
            # Step lengths after a jump are often those after the previous jump.
            control[H] = control[H_AFTER_EDGE]
            control[TOO_LONG] = 0.0
            control[ALLOWED] = 0.0
            fresh = H_AFTER_EDGE
        load(form.inverse, follow, y, now, w0)
        ahead = math.inf
        control[BRANCH_START], control[BRANCH_LENGTH] = t, math.inf
        for a in range(n_area):
            if cell[a] < 0:
                sign[a] = 1.0
                continue
            voltage = 0.0
            for k in range(n):
                voltage += form.gap[a, k] * w0[k]
            for e in range(n_s):
                voltage += form.gap_s[a, e] * now[e]
            if sign[a] == 0.0:
                sign[a] = 1.0 if voltage >= 0.0 else -1.0
                branch[a, 0], branch[a, 1] = t, math.inf
            if not inside:
                here[a] = (
                    form.unit[a] * y[slow[a]] if slow[a] >= 0 else 1.0 / inverse_area(abs(voltage), form.curves[a])[0]
                )
            end = branch[a, 0] + 1.02 * branch[a, 1] - t
            if 0.0 < end < ahead:
                ahead = end
                control[BRANCH_START], control[BRANCH_LENGTH] = branch[a, 0], branch[a, 1]
        if not inside and far_from(form, here):
            found = find(references, form, here)
            if found < 0:
                code = REFERENCE
                break
            go_over(references, found, form, error)
            work.at[0], h_slot = found, 0.0
            copy_to(size[:n], form.size)
            start_at(form.area0, areas[netrows.AREA])
            load(form.inverse, follow, y, now, w0)
        longest = Pace(tol, 1.0, True, charge) if inside else pace
        # If all rates are zero, the time constant is infinite.
        h = choose_step(longest, 1.0 / rates.max(), True, is_series and not inside, t, stop - t, control)
        wanted_h, tries = control[H], 1
        which, magnified = -1, 1.0
        while True:
            if h != h_slot:
                level = -1 if inside else work.at[0]
                slot = make_tables(
                    rates, level, h, tables.h, tables.level, tables.used, tables.decay, tables.phi, tables.miss
                )
                h_slot = h
                which_coupling = 2 * work.at[0] + inside
                take_coupling(own, which_coupling, h, rates, form.feed, form.tap, form.tap_s, form.c, g, home, cell)
                whole = own.key[1] == 0
                weigh(rates, size, tables.decay[slot], h, work.weight)
            decay, phi, miss = tables.decay[slot], tables.phi[slot], tables.miss[slot]
            if inside:
                ramp_rows(t, h, jump_from, jump_to, s, ds)
            else:
                source_rows(sources, index, t, h, charge or not smooth, work.r, s, ds)
            follow_sources(form, own, gain, s, ds, modes[netrows.LIN], cells, areas)
            passes, closed, answer = solve_step(
                form, work, own, several, h, rates, area_pace, sign, decay, phi, 0.3 * tol
            )
            counters[NFEV] += passes * NODES
            step_error = math.inf
            # An iteration that has not converged says nothing about the sign of the gap voltage.
            if closed and flips <= n_area and turn_at_start(cell, u, sign, tol, t, branch):
                flips += 1
                continue
            lowest = 1.0
            if closed:
                if mobile:
                    lowest = room[3].min()
                magnified = 1.0 / lowest
                carry(form, work, several, h, rates, area_pace, own, decay, phi, error, sign, answer)
                step_error = assess(
                    rates, h, shape, follow, form.gap, size, phi, miss, error, work.carried, w, modes[netrows.LIN],
                    modes[netrows.PULL], modes[netrows.USED], s, magnified, work.off, places, run,
                )  # fmt: skip
                if charge:
                    step_error = max(step_error, charged(cell, u, areas[netrows.AREA]))
            note(tried, counters[ACCEPTED] + counters[REJECTED], t, h, step_error / tol)
            factor = allowed_factor(step_error, tol)
            if step_error <= tol:
                accept(h, wanted_h, factor, tries, fresh, not closing, control)
                fresh = -1
                break
            tries += 1
            counters[REJECTED] += 1
            unclosed += not closed
            stuck = unclosed > UNCLOSED + UNCLOSED_SHARE * (counters[ACCEPTED] - accepted)
            # A step of this length is rounding of the time: if it is rejected, there is a singularity.
            if stuck or h <= 1e-13 * max(abs(t), 1e-3 * (stop - t)) or (whole and lowest < NEAR_FOLD):
                code = NO_STEP
                break
            shorter = 1.0
            for a in range(n_area):
                if cell[a] >= 0 and sign[a] * u[a, END] < form.lo[a]:
                    # The step went far beyond a zero, where the branch has no meaning: end soon after the zero.
                    found = first_wrong(u[a], sign[a], tol)
                    if found > 1:
                        shorter = min(shorter, 1.1 * POINTS[found])
            if shorter < 1.0:
                h = rung(h * min(0.9, shorter))
            else:
                closing = not closed
                h = shorten(h, factor, control)
                wanted_h = h
        if code != DONE:
            break
        t_new = t + h
        theta = 1.0
        if t_new >= stop or stop - t_new <= 1e-12 * h:
            t_new = stop
            theta = min(1.0, (stop - t) / h)
        if flips <= n_area:
            which, theta, t_new = first_zero(cell, u, sign, tol, t, h, theta, t_new, room[0])
        if which >= 0 and t_new <= t:
            sign[which] = -sign[which]
            branch[which, 0], branch[which, 1] = t, math.inf
            flips += 1
            continue
        if mobile and not whole:
            magnified = magnified_whole(form, work, which_coupling, several)
            take_coupling(own, which_coupling, h, rates, form.feed, form.tap, form.tap_s, form.c, g, home, cell)
        if not 0.0 < magnified < math.inf:
            code = NO_STEP
            break
        control[MAGNIFIED] = max(control[MAGNIFIED], magnified)
        flips = 0
        if charge:
            step_charges(
                form, work, own, h, rates, g, lost, lost_s, integral, sign, values[first_z : y.size], values[y.size :]
            )
            charge_error(
                form, work, h, lost, g, theta, cells[netrows.CELL_U], areas, values[first_z:], collected, control
            )  # fmt: skip
        basis_at(theta, basis)
        for e in range(n_s):
            gained[e] = at(values[first_z + e], basis) if charge else 0.0
        if not inside:
            if step_times.shape[0] > 0 or next_out <= t_new or kept_times.size > 0:
                write_columns(n, first_z, charge, shape, follow, w, s, y, values)
            if step_times.shape[0] > 0:
                record(step_times, steps.values, counters[RECORDED], t, h, t_new, theta, values)
                counters[RECORDED] += 1
            if next_out <= t_new or kept_times.size > 0:
                for i in range(out.shape[0]):
                    series_of(values[i], work.coefficients[i])
                place = counters[KEPT]
                counters[KEPT] += 1
                if place < kept_times.shape[0]:
                    kept_times[place, 0], kept_times[place, 1], kept_times[place, 2] = t, h, t_new
                    copy_to(kept_series[place], work.coefficients[: out.shape[0]])
            if next_out <= t_new:
                first_out += write_outputs(
                    t, h, theta, t_new, 0.0, False, work.coefficients, work.outputs, first_out, 0, t_out, left, out
                )  # fmt: skip
                counters[OUTPUT] = first_out
                next_out = t_out[first_out] if first_out < t_out.size else math.inf
        for a in range(n_area):
            if form.stress[a] > 0.0:
                account(u[a], areas[netrows.AREA, a], form.stress[a], theta, run[a], places, slow[a], peaks[a])
        netassess.account_nodes(form.node, form.node_s, places, work.off, peaks[n_area])
        for k in range(m):
            w0[k] = at(w[k], basis)
        if theta < 1.0:
            error_at(places, theta, error)
        else:
            for k in range(m):
                error[k] = places[k, N_PLACES - 1]
        if inside:
            for e in range(n_s):
                s_before[e] = jump_from[e] + t_new * (jump_to[e] - jump_from[e])
        else:
            at_sources(sources, index, t_new, 0.0, s_before, slopes_now)
        store(shape, follow, w0, s_before, gained, y)
        if which >= 0:
            sign[which] = -sign[which]
            branch[which, 1] = t_new - branch[which, 0]
            branch[which, 0] = t_new
            counters[ZEROS] += 1
            # The area has a kink here, which excites the fast modes again.
            if control[H_AFTER_ZERO] > 0.0:
                control[H] = control[H_AFTER_ZERO]
                control[ALLOWED] = 0.0
            fresh = H_AFTER_ZERO
        control[T] = t_new
        counters[ACCEPTED] += 1
    if inside:
        # The loop has stopped within a jump: the time is that of the jump.
        aside[ERROR_Q], aside[MAGNIFIED] = control[ERROR_Q], control[MAGNIFIED]
        copy_to(control, aside)
    return code
