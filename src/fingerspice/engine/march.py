"""The loop of exponential steps: segments and jumps of the source, zeros of the gap voltage, step lengths, outputs."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fingerspice.base.arrays import FloatArray, IntArray
from fingerspice.base.compiled import borrow, jit
from fingerspice.engine.charge import charge_step
from fingerspice.engine.exponential import N_PLACES, Tables, assess, converge, make_tables, weigh
from fingerspice.engine.growth import SLIGHT, carry, loop_gain
from fingerspice.engine.model import branch_area, dot, turns_at_zero
from fingerspice.engine.nodes import node_error
from fingerspice.engine.pace import (
    Pace,
    accept,
    allowed_factor,
    change_level,
    choose_step,
    enter,
    nearest_level,
    rung,
    shorten,
    take_branch,
)
from fingerspice.engine.readout import (
    ACCEPTED,
    ALLOWED,
    BRANCH_LENGTH,
    BRANCH_START,
    ERROR_V,
    FIRST_PASSES,
    H_AFTER_EDGE,
    H_AFTER_ZERO,
    KEPT,
    LAST_Q,
    MAGNIFIED,
    MARGIN,
    MOST_PASSES,
    MOST_STEPS,
    NFEV,
    OUTPUT,
    PEAK_U,
    RECORDED,
    REJECTED,
    SIGN,
    TOO_LONG,
    U_BEFORE,
    U_GAP,
    ZEROS,
    H,
    Steps,
    T,
    account,
    at,
    basis_at,
    error_at,
    layers,
    note,
    record,
    series_of,
    write_outputs,
)  # fmt: skip
from fingerspice.engine.repeat import AT_EDGE, AT_ZERO, Kept
from fingerspice.engine.rows import DQ, GUESS, SOURCE, X_GAP, Q, U, largest_size, source_rows
from fingerspice.engine.segment import Segment, segment_at, source
from fingerspice.engine.system import System
from fingerspice.engine.work import Work
from fingerspice.engine.zeros import dip, first_wrong, zero
from fingerspice.numerics.lobatto import END, NODES, POINTS, ROWS

# Codes returned by `march`.
DONE, NO_STEP, OUT_OF_RANGE, TOO_MANY, PAUSED = 0, 1, 2, 3, 4


@jit
def march(
    system: System,
    pace: Pace,
    tables: Tables,
    work: Work,
    integral: FloatArray,
    edges: FloatArray,
    terms: FloatArray,
    series: FloatArray,
    t_end: float,
    y: FloatArray,
    error: FloatArray,
    control: FloatArray,
    counters: IntArray,
    t_out: FloatArray,
    left: NDArray[np.bool_],
    out: FloatArray,
    kept: Kept,
    steps: Steps,
    tried: FloatArray,
) -> int:
    """Step to `t_end` through the source's segments, writing outputs on the way.

    Parameters
    ----------
    system, pace, tables, work, integral
        The stack, the rules for steps, tables and scratch arrays; `integral` is `lobatto.integral_table()`.
    edges : ndarray, shape (m + 1,)
        Segment edges, s; `terms` (m, k, 6) and `series` (m, l) hold the source on each (see `Segment`).
    t_end : float
        Where to stop, s; not past the last edge.
    y : ndarray, shape (n + 1,)
        State voltages (V) and charge (C), updated in place.
    error : ndarray, shape (n + 1,)
        Estimated error of the modes, signed, and the number of the reference area that these modes belong to; updated.
    control, counters : ndarray
        Bookkeeping, updated in place.
    t_out, left, out : ndarray
        Output times (s, ascending), whether the left-hand limit is meant, and the columns to fill: recorded voltages
        (see `System.shown`), then charge and current if wanted.
    kept : Kept
        Takes the first steps, for repeated periods, until it is full; `counters` tells how many steps there were.
    steps : Steps
        Takes all steps, for figures of the run; where it is full the loop pauses.
    tried : ndarray, shape (TRIED, 4)
        Ring buffer of the last steps tried: start and length (s), ratio of the error to the allowed one, number from 1.

    Returns
    -------
    int
        DONE, NO_STEP (no step is short enough: a fold, or an error that cannot be met), OUT_OF_RANGE (a gap voltage
        beyond the range of the area's polynomial), TOO_MANY steps, or PAUSED: empty `steps`, and call again.
    """
    # Arrays are taken out of their tuples once: an access to a tuple inside the loop costs more than the array's use.
    model = system.model
    mobile, coupled, k_gap, area0, tau = model.mobile, model.coupled, model.k_gap, model.area0, model.tau
    curve, k_shown, gap_share = borrow(model.curve), borrow(system.k_shown), borrow(model.gap)
    all_shown, all_node, k_node = borrow(system.shown), borrow(system.node), borrow(system.k_node)
    q0, powers, slopes = borrow(system.q0), borrow(system.powers), borrow(system.slopes)
    all_rates, all_gain, all_push, all_gap = (
        borrow(system.rates), borrow(system.gain), borrow(system.push), borrow(system.gap)
    )  # fmt: skip
    all_slow, all_live, all_project = borrow(system.slow), borrow(system.live), borrow(system.project)
    all_tap, tap_k, all_feed, tapped = (
        borrow(system.tap), borrow(system.tap_k), borrow(system.feed), borrow(work.tapped)
    )  # fmt: skip
    lo, scale, stress, u_top = system.lo, system.scale, system.stress, system.u_top
    keys_h, keys_level, count = borrow(tables.h), borrow(tables.level), borrow(tables.used)
    all_decay, all_phi, all_miss = borrow(tables.decay), borrow(tables.phi), borrow(tables.miss)
    tol, charge, controlled = pace.tol, pace.charge, pace.controlled
    terms, series, y, error, control = borrow(terms), borrow(series), borrow(y), borrow(error), borrow(control)
    counters = borrow(counters)
    r, base, w, pull, used = borrow(work.r), borrow(work.base), borrow(work.w), borrow(work.pull), borrow(work.used)
    pull_before, left_before = borrow(work.pull_before), borrow(work.left_before)
    w0, places, sums, weight = borrow(work.w0), borrow(work.places), borrow(work.sums), borrow(work.weight)
    outputs, carried, basis = borrow(work.outputs), borrow(work.carried), borrow(work.basis)
    t_out, left, out = borrow(t_out), borrow(left), borrow(out)
    values, coefficients = borrow(work.values), borrow(work.coefficients)
    kept_times, kept_series, tried = borrow(kept.times), borrow(kept.series), borrow(tried)
    step_times, step_values, paused = borrow(steps.times), borrow(steps.values), borrow(steps.paused)
    room = step_times.shape[0]
    u_rows, q_rows, source_row = r[U], r[Q], r[SOURCE]
    n = model.gap.size
    columns, n_shown, level, slot = out.shape[0], all_shown.shape[1], -1, -1
    rates, gain, push, gap = all_rates[0], all_gain[0], all_push[0], all_gap[0]
    slow_share, live, project, shown = all_slow[0], all_live[0], all_project[0], all_shown[0]
    tap, feed = all_tap[0], all_feed[0]
    decay, phi, miss = all_decay[0], all_phi[0], all_miss[0]
    h_slot, flips = 0.0, 0
    # Entry of `control` that keeps the length of the first step after an edge or a zero; -1 for all other steps.
    fresh = -1
    first_out = int(counters[OUTPUT])
    next_out = t_out[first_out] if first_out < t_out.size else math.inf
    index = -1
    start, edge, since = 0.0, control[T], 0.0
    segment_terms, segment_series = terms[0], series[0]
    if edges[0] < control[T]:
        index = segment_at(edges, control[T]) - 1
    most = counters[ACCEPTED] + counters[REJECTED] + MOST_STEPS
    begun, evaluated = control[T], counters[NFEV]
    if paused[0] > 0.0:
        # The pause was in the middle of a segment: continue as if there had been none.
        index = segment_at(edges, control[T])
        while index >= 0 and edges[index] >= control[T]:
            index -= 1
        start, edge = edges[index], edges[index + 1]
        segment_terms, segment_series = terms[index], series[index]
        paused[0], since, begun = 0.0, paused[1], paused[2]
        fresh, evaluated, most = int(paused[3]), int(paused[4]), int(paused[5])
    while control[T] < t_end:
        t = control[T]
        if counters[RECORDED] >= room > 0:
            paused[0], paused[1], paused[2], paused[3], paused[4], paused[5] = 1.0, since, begun, fresh, evaluated, most
            return PAUSED
        if counters[ACCEPTED] + counters[REJECTED] > most:
            return TOO_MANY
        if counters[NFEV] - evaluated > NODES * FIRST_PASSES:
            longest = (t - begun) / pace.h_max
            if counters[NFEV] - evaluated > NODES * (FIRST_PASSES + MOST_PASSES * longest):
                return TOO_MANY
        if t >= edge:
            index += 1
            start = edges[index]
            edge = edges[index + 1]
            if edge <= t:
                continue
            # Time is counted from the edge: a transient after it may be faster than the rounding of t.
            since = t - start
            begun, evaluated = t, counters[NFEV]
            segment_terms, segment_series = terms[index], series[index]
            u_source, _ = source(Segment(start, edge - start, segment_terms, segment_series), t - start)
            if mobile or charge:
                if not enter(model, charge, u_source, y, control):
                    return NO_STEP
            else:
                control[U_GAP] = k_gap * u_source
                for i in range(n):
                    control[U_GAP] += gap_share[i] * y[i]
                take_branch(1.0 if control[U_GAP] >= 0.0 or not coupled else -1.0, control)
            # Try the step that was right after the edge before: similar jumps often need similar steps.
            control[H] = control[H_AFTER_EDGE]
            control[TOO_LONG] = 0.0
            control[ALLOWED] = 0.0
            fresh = H_AFTER_EDGE
        stop = min(edge, t_end)
        length = stop - start
        if q0.size > 1 or level < 0:
            now = 0
            if q0.size > 1:
                q, _ = branch_area(model, control[SIGN], control[U_GAP])
                now = nearest_level(q0, q)
            if now != level:
                if error[n] != now:
                    change_level(all_live, all_project, int(error[n]), now, error)
                    error[n] = now
                level = now
                h_slot = 0.0
                rates, gain, push, gap = all_rates[level], all_gain[level], all_push[level], all_gap[level]
                slow_share, tap, feed = all_slow[level], all_tap[level], all_feed[level]
                live, project, shown = all_live[level], all_project[level], all_shown[level]
        for k in range(n):
            w0[k] = 0.0
            for i in range(n):
                w0[k] += project[k, i] * y[i]
        h = choose_step(pace, tau, coupled, segment_series.size > 0, t, length - since, control)
        run_error = 0.0
        magnified = 1.0
        wrong = 0
        below = 0.0
        flip = False
        wanted, tries = control[H], 1
        while True:
            if h != h_slot:
                slot = make_tables(
                    rates, level, h, keys_h, keys_level, count, all_decay, all_phi, all_miss
                )  # fmt: skip
                h_slot = h
                decay, phi, miss = all_decay[slot], all_phi[slot], all_miss[slot]
                weigh(rates, gap, decay, h, weight)
            source_rows(segment_terms, segment_series, edge - start, since, h, charge, r)
            sign = control[SIGN]
            if mobile:
                for i in range(ROWS):
                    r[GUESS, i] = control[U_GAP]
            passes, closed = converge(
                mobile, coupled, k_gap, area0, q0[level], gain, gap, push, tap, tap_k, feed, tapped, powers, slopes, lo,
                scale, curve, sign, decay, phi, w0, 0.3 * tol, base, w, pull, used, pull_before, left_before, weight, r,
            )  # fmt: skip
            counters[NFEV] += passes * NODES
            wrong = first_wrong(u_rows, sign, tol) if coupled else 0
            # Node 1 may be off its branch only because the iteration did not converge: also require a start near 0 V.
            at_zero = sign * u_rows[0] <= 1e-9 * min(abs(u_rows[1]), u_top)
            if wrong == 1 and flips < 2 and at_zero:
                # The step starts at a zero, and the gap voltage leaves it to the other side: change the branch.
                flip = True
                break
            below = dip(u_rows, sign, tol, wrong, coefficients[0]) if coupled and closed else 0.0
            if 0.0 < below < POINTS[1] and at_zero:
                # The gap voltage starts at a zero and soon returns to it: a shorter step resolves this.
                counters[REJECTED] += 1
                h = rung(2.0 * below * h)
                wanted = h
                control[H] = h
                flips = 0
                continue
            step_error = math.inf
            if closed:
                for k in range(n):
                    for p in range(N_PLACES - 1):
                        carried[k, p] = decay[k, NODES + p if p < N_PLACES - 2 else END] * error[k]
                grown = loop_gain(mobile, area0, push, tap, tap_k, feed, weight, w, r)
                if grown > SLIGHT:
                    carry(model, rates, gap, push, tap, tap_k, feed, decay, h, sign, grown, w, r, error, carried)
                step_error, run_error, magnified = assess(
                    mobile, area0, gain, gap, phi, miss, error, carried, w, pull, used, r, places, sums
                )
            note(tried, counters[ACCEPTED] + counters[REJECTED], t, h, step_error / tol)
            if not controlled and closed:
                break
            factor = allowed_factor(step_error, tol)
            if step_error <= tol:
                accept(h, wanted, factor, tries, fresh, True, control)
                fresh = -1
                break
            tries += 1
            counters[REJECTED] += 1
            # A step rejected beyond the end of the area's polynomial: shorter ones would creep up to the kink there.
            if coupled and abs(control[U_GAP]) > 0.9 * u_top and largest_size(u_rows) > u_top:
                return OUT_OF_RANGE
            # A step of the size of the time's rounding is rejected: the solution has a singularity here.
            if h <= 1e-15 * since + 1e-25 * (edge - start):
                return NO_STEP
            # Close to a fold the iteration converges for very short steps only. Methods that solve the area equation
            # at every evaluation reach the fold sooner and take over.
            if mobile and 1.0 - area0 * r[X_GAP, 0] * r[DQ, 0] < 0.01:
                return NO_STEP
            if wrong > 1 and sign * u_rows[END] < lo:
                # The voltage is far beyond a zero, where the branch has no meaning: end the step soon after the zero.
                h = rung(h * min(0.9, 1.1 * POINTS[wrong]))
            else:
                h = shorten(h, factor, control)
                wanted = h
        if flip:
            if turns_at_zero(model, r[X_GAP, 0], -control[SIGN]):
                control[MARGIN] = 0.0
                return NO_STEP
            control[SIGN] = -control[SIGN]
            flips += 1
            continue
        reached = since + h
        theta = 1.0
        crossed = False
        if reached >= length or length - reached <= 1e-12 * h:
            reached = length
            theta = min(1.0, (length - since) / h)
        if (wrong > 0 or below > 0.0) and flips < 2:
            crossing = zero(u_rows, control[SIGN], wrong, below, coefficients[0])
            if since + crossing * h <= reached and crossing <= theta:
                theta = crossing
                reached = since + crossing * h
                crossed = True
                if reached <= since:
                    control[SIGN] = -control[SIGN]
                    flips += 1
                    continue
        flips = 0
        t_new = stop if reached == length else start + reached
        if charge:
            charge_step(
                model, rates, gain, gap, slow_share, w, pull, r, integral, h, y[n], places, theta, control,
                values[n_shown], values[n_shown + 1],
            )  # fmt: skip
        if room > 0 or next_out <= t_new or kept_times.size > 0:
            layers(mobile, area0, k_shown, shown, w, source_row, q_rows, values)
        if room > 0:
            record(step_times, step_values, counters[RECORDED], t, h, t_new, theta, values)
            counters[RECORDED] += 1
        if next_out <= t_new or kept_times.size > 0:
            for c in range(columns):
                series_of(values[c], coefficients[c])
            place = counters[KEPT]
            counters[KEPT] += 1
            if place < kept_times.shape[0]:
                kept_times[place, 0], kept_times[place, 1], kept_times[place, 2] = t, h, t_new
                kept_times[place, 3] = AT_ZERO if crossed else (AT_EDGE if t_new == stop else 0.0)
                for c in range(columns):
                    for d in range(ROWS):
                        kept_series[place, c, d] = coefficients[c, d]
        if next_out <= t_new:
            first_out += write_outputs(
                t, h, theta, t_new, 0.0, False, coefficients, outputs, first_out, 0, t_out, left, out
            )  # fmt: skip
            counters[OUTPUT] = first_out
            next_out = t_out[first_out] if first_out < t_out.size else math.inf
        control[MAGNIFIED] = max(control[MAGNIFIED], magnified)
        account(mobile and coupled, area0, stress, u_rows, q_rows, r[X_GAP], r[DQ], theta, run_error, control)
        v_error = node_error(mobile, area0, all_node[level], k_node, gap, w, r, places)
        control[ERROR_V] = max(control[ERROR_V], v_error)
        if theta < 1.0:
            basis_at(theta, basis)
            for k in range(n):
                w0[k] = at(w[k], basis)
            error_at(places, theta, error)
            if charge:
                y[n] = at(values[n_shown], basis)
                control[LAST_Q] = at(q_rows, basis)
            control[U_GAP] = 0.0 if crossed else at(u_rows, basis)
        else:
            for k in range(n):
                w0[k] = w[k, END]
                error[k] = places[k, N_PLACES - 1]
            if charge:
                y[n] = values[n_shown, END]
                control[LAST_Q] = q_rows[END]
            control[U_GAP] = u_rows[END]
        for i in range(n):
            y[i] = 0.0
            for k in range(n):
                y[i] += live[i, k] * w0[k]
        if crossed:
            control[SIGN] = -control[SIGN]
            control[BRANCH_LENGTH] = t_new - control[BRANCH_START]
            control[BRANCH_START] = t_new
            counters[ZEROS] += 1
            if turns_at_zero(model, dot(gap_share, y), control[SIGN]):
                control[T] = t_new
                control[SIGN] = -control[SIGN]
                control[MARGIN] = 0.0
                return NO_STEP
            # The area has a kink here, which excites fast modes again: the first step is chosen as after other zeros.
            if below > 0.0:
                # The gap voltage returns to 0 V soon.
                control[H] = 2.0 * (below - theta) * h
                control[ALLOWED] = 0.0
            elif control[H_AFTER_ZERO] > 0.0:
                control[H] = control[H_AFTER_ZERO]
                control[ALLOWED] = 0.0
            fresh = H_AFTER_ZERO
        control[T], since = t_new, reached
        if t_new >= stop:
            control[U_BEFORE], _ = source(Segment(start, edge - start, segment_terms, segment_series), t_new - start)
        counters[ACCEPTED] += 1
        if control[PEAK_U] > u_top:
            return OUT_OF_RANGE
    return DONE
