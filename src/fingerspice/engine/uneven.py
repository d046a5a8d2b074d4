"""Integration under a PWL with dense points at uneven times, block by block, as `engine.recording` does for samples.

Every step has a length of its own, and its weights are computed with it (`engine.unevenweights`). Only series stacks
under `local` are integrated.
"""

from __future__ import annotations

import math

import numpy as np

from fingerspice.base.arrays import FloatArray, IntArray
from fingerspice.base.borrowing import borrow
from fingerspice.base.compiled import jit, jit_rows, jit_within
from fingerspice.engine.blockcheck import OF_SWEEPS, compare, is_due, keep, note
from fingerspice.engine.blockcoarse import halved, most_samples
from fingerspice.engine.blockcourse import Charges, Course
from fingerspice.engine.blockerror import accept, correct, error_left, learn, may_coarsen, refine
from fingerspice.engine.blockforms import (
    FIRST_QUARTER,
    LAST_QUARTER,
    LEVEL,
    MIDDLE,
    N_SHARES,
    OF_GAP,
    ONE,
    OUTPUT,
    PLACES,
    RATIO,
    REFERENCE,
    REFUSED,
    SWEEPS,
    U_GAP,
    WITHIN,
    Form,
    Room,
)
from fingerspice.engine.blockkinks import add_where, after_kink, kink_at
from fingerspice.engine.blockoutput import write_samples
from fingerspice.engine.blockpoints import write_points
from fingerspice.engine.blockrows import (
    add_three,
    change_of,
    largest_of,
    modes_into,
    scaled,
    sum_of,
)
from fingerspice.engine.recording import (
    DONE,
    NOT_CLOSED,
    TOO_COARSE,
    begin_block,
    change_reference,
)
from fingerspice.engine.relaxation import (
    KINKED,
    LEFT,
    MOST_RATIO,
    MOST_SWEEPS,
    PARABOLA,
    drives_at,
    find_kinks,
    keep_drives,
    look_at_ends,
    project_at_ends,
    ratio_of,
)
from fingerspice.engine.unevenweights import END, EVERY_PLACE, Steps, weigh

# The shortest step length: four halvings of the distance of two points.
SHORTEST = ONE + 4


@jit_rows
def _forced_rows(
    n: int, w: FloatArray, decay: FloatArray, c: FloatArray, f: FloatArray, f_m: FloatArray, out: FloatArray
) -> None:
    """Modes at a place: decayed from the start of each step, and forced along a parabola."""
    for i in range(n):
        out[i] = decay[i] * w[i] + c[0, i] * f[i] + c[1, i] * f_m[i] + c[2, i] * f[i + 1]


@jit_rows
def _increments(n: int, c: FloatArray, f: FloatArray, f_m: FloatArray, out: FloatArray) -> None:
    for i in range(n):
        out[i] = c[0, i] * f[i] + c[1, i] * f_m[i] + c[2, i] * f[i + 1]


@jit
def _pass(n: int, decay: FloatArray, inc: FloatArray, w: FloatArray) -> None:
    """w[i + 1] = decay[i] w[i] + inc[i]."""
    now = w[0]
    for i in range(n):
        now = decay[i] * now + inc[i]
        w[i + 1] = now


@jit_rows
def _between(n: int, at: float, s: FloatArray, out: FloatArray) -> None:
    for i in range(n):
        out[i] = s[i] + at * (s[i + 1] - s[i])


@jit_rows
def _respond_to_kinks(
    m: int, where: IntArray, rate: float, h: FloatArray, c: FloatArray, at: FloatArray, jump: FloatArray,
    bend: FloatArray, x: FloatArray, part: FloatArray,
) -> None:  # fmt: skip
    """As `blockkinks.respond_to_kinks`, for steps of different lengths with the weights c (3, n) of their parabolas."""
    for j in range(m):
        i = where[j]
        rest, early, slope = 1.0 - at[j], max(0.5 - at[j], 0.0), x[i + 1] - x[i]
        ramp, square = after_kink(rate * h[i] * rest, rest)
        ramp = h[i] * ramp - c[1, i] * early - c[2, i] * rest
        square = h[i] * square - c[1, i] * early * early - c[2, i] * rest * rest
        there = x[i] + at[j] * slope
        part[j] = jump[j] * (there * ramp + (slope + bend[j] * there) * square)


@jit_rows
def _add_product(n: int, a: float, x: FloatArray, y: FloatArray, out: FloatArray) -> None:
    for i in range(n):
        out[i] += a * x[i] * y[i]


@jit_within
def _look(form: Form, room: Room, steps: Steps, r: int, place: int, n: int, last: int) -> None:
    """Modes at a place within the steps, their projections up to number `last`, gap voltage and drives."""
    at, x = EVERY_PLACE[place], room.within[place]
    _between(n, at, room.s, room.s_within)
    for p in range(last):
        scaled(n, form.tap_s[p], room.s_within, x[p])
    for k in range(form.rates.shape[1]):
        _forced_rows(
            n, room.w[k], steps.decay[k, place], steps.parabola[k, place], steps.forced[k], steps.forced_within[k],
            steps.w[k],
        )  # fmt: skip
    for p in range(last):
        modes_into(n, 0, form.taps[r, p], steps.w, x[p])
    scaled(n, 1.0, x[0], room.u_within[place])
    drives_at(form, r, n, room, place)


@jit_within
def _add_kinks(form: Form, room: Room, steps: Steps, h: FloatArray, r: int, n: int) -> None:
    """As `relaxation._add_kinks`."""
    count = find_kinks(form, room, n)
    if count == 0:
        return
    for k in range(form.rates.shape[1]):
        sum_of(n + 1, room.kinked[k], room.end[1:], room.slope)
        _respond_to_kinks(
            count, room.where, form.rates[r, k], h, steps.parabola[k, END], room.crossed, room.jumps, room.bends,
            room.slope, room.other,
        )  # fmt: skip
        add_where(count, room.where, room.other, room.inc[k])


@jit_within
def _relax(
    form: Form, room: Room, steps: Steps, h: FloatArray, r: int, kink: FloatArray, n: int, tol: float, known: float
) -> tuple[float, int]:
    """As `relaxation.relax`, for steps with weights of their own: the change by the last sweep (V), and the sweeps."""
    modes, drives = form.rates.shape[1], room.g.shape[0]
    for t in range(drives):
        start = room.g[t, 0]
        for i in range(n):
            room.g[t, i + 1] = start
            room.g_within[MIDDLE, t, i] = start
    charged = room.u[0] - form.k_gap * room.s[0]
    for i in range(n + 1):
        room.u[i] = room.before[i] = form.k_gap * room.s[i] + charged
    for i in range(n):
        room.u_within[MIDDLE, i] = 0.5 * (room.u[i] + room.u[i + 1])
    for k in range(modes):
        for t in range(drives):
            room.kinked[k, t] = form.feed[r, k, t] * kink[t]
    last, over = math.inf, 1.0 / tol if tol > 0.0 else 1.0
    for sweep in range(MOST_SWEEPS):
        for k in range(modes):
            scaled(n + 1, form.gain[r, k], room.s, steps.forced[k])
            modes_into(n + 1, 0, form.feed[r, k], room.g, steps.forced[k])
            _between(n, 0.5, room.s, steps.low)
            scaled(n, form.gain[r, k], steps.low, steps.forced_within[k])
            modes_into(n, 0, form.feed[r, k], room.g_within[MIDDLE], steps.forced_within[k])
            _increments(n, steps.parabola[k, END], steps.forced[k], steps.forced_within[k], room.inc[k])
        if sweep >= KINKED:
            _add_kinks(form, room, steps, h, r, n)
        for k in range(modes):
            _pass(n, steps.decay[k, END], room.inc[k], room.w[k])
        if sweep >= KINKED:
            keep_drives(room, n)
        _look(form, room, steps, r, MIDDLE, n, 1 + drives)
        look_at_ends(form, room, r, n + 1, 0)
        if not abs(room.u[n]) < math.inf:
            return math.inf, sweep
        change = change_of(n + 1, over, room.u, room.before) / over
        if sweep > 0:
            ratio = change / last if last > 0.0 else 0.0
            if not ratio < MOST_RATIO and change > tol:
                return math.inf, sweep
            if change * ratio_of(form, room, r, n, 1.0, known, ratio) <= LEFT * tol and sweep >= KINKED:
                return change, sweep
        last = change
    return math.inf, MOST_SWEEPS


@jit_within
def _misfit(form: Form, room: Room, steps: Steps, r: int, kink: FloatArray, n: int, taps: int) -> float:
    """Error of the modes into `Room.own`, that of the gap voltage into `Room.before`, and the largest of that (V)."""
    modes = form.rates.shape[1]
    count = find_kinks(form, room, n)
    for k in range(modes):
        scaled(n, 0.0, room.s, room.inc[k])
    for place in (FIRST_QUARTER, LAST_QUARTER):
        _look(form, room, steps, r, place, n, taps)
        for t in range(room.g.shape[0]):
            off, weight = room.g_within[place, t], PARABOLA[place]
            add_three(
                n, -weight[0], room.g[t], -weight[1], room.g_within[MIDDLE, t], -weight[2], room.g[t, 1:], off
            )  # fmt: skip
            kink_at(
                count, room.where, kink[t], PLACES[place], room.crossed, room.jumps, room.bends, room.end[1 + t], off
            )  # fmt: skip
            for k in range(modes):
                feed = form.feed[r, k, t]
                _add_product(n, feed, steps.quarter[k, place - FIRST_QUARTER], off, room.inc[k])
    scaled(n + 1, 0.0, room.s, room.before)
    for k in range(modes):
        room.own[k, 0] = 0.0
        _pass(n, steps.decay[k, END], room.inc[k], room.own[k])
    modes_into(n + 1, 0, form.taps[r, 0], room.own, room.before)
    return largest_of(n + 1, room.before)


@jit_within
def _further_sweep(c: Course, steps: Steps, r: int, n: int) -> None:
    """As `blockerror.further_sweep`."""
    form, room, forced, within = c.form, c.room, c.room.slope, steps.low
    for k in range(c.w.size):
        scaled(n + 1, 0.0, room.s, forced)
        modes_into(n + 1, 0, form.feed[r, k], room.changed, forced)
        scaled(n, 0.0, room.s, within)
        modes_into(n, 0, form.feed[r, k], room.changed_within, within)
        _increments(n, steps.parabola[k, END], forced, within, room.inc[k])
        room.further[k, 0] = 0.0
        _pass(n, steps.decay[k, END], room.inc[k], room.further[k])


@jit
def _load(times: FloatArray, values: FloatArray, at: int, count: int, sub: int, room: Room, own: Charges) -> None:
    """Source, times and lengths of the steps from point number `at` on; each interval has `sub` equal steps."""
    for j in range(count):
        here, t, length = values[at + j], times[at + j], times[at + j + 1] - times[at + j]
        for i in range(sub):
            place = j * sub + i
            room.s[place] = here + (i / sub) * (values[at + j + 1] - here)
            own.t[place] = t + (i / sub) * length
            own.h[place] = length / sub
    room.s[count * sub], own.t[count * sub] = values[at + count], times[at + count]


@jit_within
def _write(c: Course, r: int, level: int, count: int, t_out: FloatArray, out: FloatArray) -> None:
    """Write the outputs of a block, without those at its very end."""
    sub, first, t = halved(level), c.counters[OUTPUT], c.charges.t
    n = count * sub
    slack = 8e-16 * abs(t[n])
    last, aligned = first, True
    while last < t_out.size and t_out[last] < t[n] - slack:
        j = last - first
        aligned &= j < count and abs(t_out[last] - t[min(j, count) * sub]) <= slack
        last += 1
    if last == first:
        return
    if aligned and last - first == count:
        write_samples(c, r, level, count, out, first)
    else:
        write_points(c, r, n, slack, t_out, out, last)
    c.counters[OUTPUT] = last


@jit_within
def _solve(
    c: Course, steps: Steps, r: int, n: int, tol: float, taps: int
) -> tuple[float, float]:  # fmt: skip
    """Solve a block of n steps as `recording._solve` does: the change by the last sweep and the error seen, V."""
    weigh(c.form, steps, c.charges.h, r, n)
    change, sweeps = _relax(c.form, c.room, steps, c.charges.h, r, c.shown.kink, n, tol, c.control[RATIO])
    c.counters[SWEEPS] += sweeps
    if not change < math.inf:
        return change, math.inf
    return change, _misfit(c.form, c.room, steps, r, c.shown.kink, n, taps)


@jit_within
def _finish(c: Course, steps: Steps, r: int, n: int, taps: int) -> None:
    """As `recording._finish`."""
    correct(c, r, n)
    if c.shown.charge:
        _look(c.form, c.room, steps, r, MIDDLE, n, taps)
        for p in range(1 + c.room.g.shape[0], taps):
            project_at_ends(c.form, c.room, r, n + 1, p)


@jit_within
def _check(
    c: Course, steps: Steps, times: FloatArray, values: FloatArray, at: int, count: int, r: int, level: int,
    seen: float, taps: int,
) -> None:  # fmt: skip
    """As `recording._check`."""
    control, m, sub, half = c.control, c.w.size, halved(level), most_samples(level + 1)
    errors, off, w, u = np.zeros(N_SHARES), np.zeros(N_SHARES), c.w.copy(), control[U_GAP]
    before = control.copy()
    tol = OF_SWEEPS * seen
    _load(times, values, at, count, sub, c.room, c.charges)
    begin_block(c, r, c.w, u)
    change, seen = _solve(c, steps, r, count * sub, tol, taps)
    closed = change < math.inf
    if closed:
        _finish(c, steps, r, count * sub, taps)
        keep(c, r, 0.0, count * sub, sub, seen, 1.0, errors)
        control[:] = before
    for done in range(0, count if closed else 0, half):
        part = min(half, count - done)
        n = 2 * part * sub
        _load(times, values, at + done, part, 2 * sub, c.room, c.charges)
        begin_block(c, r, w, u)
        change, _ = _solve(c, steps, r, n, tol, taps)
        closed = change < math.inf
        if not closed:
            break
        _finish(c, steps, r, n, taps)
        compare(c, r, 0.0, done * sub, n, 2 * sub, off)
        for k in range(m):
            w[k] = c.room.w[k, n]
        u = c.room.u[n]
    note(c, level, closed, errors, off)
    control[:] = before


@jit
def march(
    c: Course, steps: Steps, times: FloatArray, values: FloatArray, tol: float, t_out: FloatArray, out: FloatArray
) -> int:
    """Follow the points `times` (s) and `values` (V), straight in between, from the first to the last.

    Outputs before the end are written. `tol` is the error of the gap voltage (V) that a block may add.
    """
    c, steps, times, values = borrow(c), borrow(steps), borrow(times), borrow(values)
    form, room, control = c.form, c.room, c.control
    at, last, stop, drives = 0, (-1, 0), values.size - 1, room.g.shape[0]
    taps = form.tap_s.size if c.shown.charge else 1 + drives
    while at < stop:
        level, r = int(control[LEVEL]), int(control[REFERENCE])
        sub = halved(level)
        count = min(most_samples(level), stop - at)
        n = count * sub
        _load(times, values, at, count, sub, room, c.charges)
        begin_block(c, r, c.w, control[U_GAP])
        if change_reference(c, r):
            continue
        change, seen = _solve(c, steps, r, n, tol, taps)
        left = 0.0
        local = max(c.checks[level, OF_GAP], c.checks[level, WITHIN]) * seen
        if local <= tol:
            correct(c, r, n)
            _further_sweep(c, steps, r, n)
            left = error_left(c, r, n)
            local += left
            if learn(c, r, n, tol, change, seen, left, local) and not local <= tol:
                # More sweeps leave less.
                c.counters[REFUSED] += n
                continue
        if (at, level) != last and is_due(c, level, n, seen, left, tol):
            _check(c, steps, times, values, at, count, r, level, seen, taps)
            last = (at, level)
            continue
        if not local <= tol:
            if level == SHORTEST:
                return TOO_COARSE if change < math.inf else NOT_CLOSED
            refine(c, level, SHORTEST, n, local, tol)
            continue
        for k in range(c.w.size):
            passed = 1.0
            for i in range(n):
                passed *= steps.decay[k, END, i]
            c.spare[2, k] = passed
        if c.shown.charge:
            _look(form, room, steps, r, MIDDLE, n, taps)
            for p in range(1 + drives, taps):
                project_at_ends(form, room, r, n + 1, p)
        accept(c, r, level, n, seen, left, 1.0, left / max(change + seen, left) if left > 0.0 else 0.0)
        _write(c, r, level, count, t_out, out)
        at += count
        if level > ONE and may_coarsen(c, level, seen, left, tol):
            control[LEVEL] = level - 1.0
    return DONE
