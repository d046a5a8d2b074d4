"""Integration under a recorded source block by block (`engine.relaxation`): step lengths, errors, peaks."""

from __future__ import annotations

import math

from fingerspice.base.arrays import FloatArray
from fingerspice.base.borrowing import borrow
from fingerspice.base.compiled import jit, jit_rows, jit_within
from fingerspice.engine.blockcharge import Course, charge_block, steepness
from fingerspice.engine.blockforms import (
    BLOCK,
    ERROR_F,
    ERROR_Q,
    ERROR_U,
    ERROR_V,
    LEVEL,
    LEVELS,
    MARGIN,
    MEAN_Q,
    PEAK_F,
    PEAK_U,
    REFERENCE,
    REFUSED,
    STEPS,
    SWEEPS,
    U_GAP,
    Form,
)
from fingerspice.engine.blockoutput import write_block
from fingerspice.engine.blockrows import add, add_to_all, area_rows, largest_of, modes_into, recursion, scaled, settle
from fingerspice.engine.model import ramp
from fingerspice.engine.relaxation import (
    FIRST_NEWTON,
    LEAST_MARGIN,
    NEWTON,
    SLOWER,
    SPARE,
    look_at_ends,
    misfit,
    project_for_charge,
    relax,
)

# Codes returned by `march`.
DONE, NOT_CLOSED, TOO_COARSE = range(3)


@jit_rows
def peaks_of(
    n: int, stress: float, u: FloatArray, q: FloatArray, error: FloatArray
) -> tuple[float, float, float, float, float]:  # fmt: skip
    """The largest |u|, force, force over voltage, and that times the error of the voltage in its place; the mean q."""
    peak, force, steepest, worst, total = 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(n):
        x = abs(u[i])
        slope = stress * x / q[i]
        peak = x if x > peak else peak
        steepest = slope if slope > steepest else steepest
        force = slope * x if slope * x > force else force
        off = slope * abs(error[i])
        worst = off if off > worst else worst
        total += q[i]
    return peak, force, steepest, worst, total / n


@jit
def nearest(form: Form, q: float) -> int:
    """The reference for a value of 1/A."""
    best = 0
    for one in range(1, form.q0.size):
        if abs(math.log(q / form.q0[one])) < abs(math.log(q / form.q0[best])):
            best = one
    return best


@jit
def go_over(c: Course, r: int, to: int, w: FloatArray) -> None:
    """Transform modes around one reference into those around another."""
    live, shown = c.spare[0], c.shown
    for i in range(w.size):
        live[i] = 0.0
        for k in range(w.size):
            live[i] += shown.live[r, i, k] * w[k]
    for k in range(w.size):
        w[k] = 0.0
        for i in range(w.size):
            w[k] += shown.project[to, k, i] * live[i]


@jit
def jump(c: Course, to: float) -> bool:
    """Take a jump of the source to `to` (V); False where it meets a fold."""
    r, model = int(c.control[REFERENCE]), c.model
    x_gap = 0.0
    for k in range(c.w.size):
        x_gap += c.form.taps[r, 0, k] * c.w[k]
    c.control[U_GAP] = ramp(model, model.k_gap * to, x_gap, c.control[U_GAP])
    return not math.isnan(c.control[U_GAP])


@jit
def _sources(values: FloatArray, at: int, count: int, sub: int, s: FloatArray) -> None:
    """The source's values at the ends of steps, `sub` of which make a sample's length."""
    if sub == 1:
        for j in range(count + 1):
            s[j] = values[at + j]
        return
    for j in range(count):
        here = values[at + j]
        for i in range(sub):
            s[j * sub + i] = here + (i / sub) * (values[at + j + 1] - here)
    s[count * sub] = values[at + count]


@jit_within
def _block_error(c: Course, r: int, level: int, n: int) -> float:
    """Largest error of the gap voltage that a block adds, V; the errors of the modes go into `Room.own`."""
    form, room = c.form, c.room
    for k in range(c.w.size):
        room.own[k, 0] = 0.0
        recursion(n, form.decay[r, level, k], room.inc[k], room.other, room.own[k])
    scaled(n + 1, 0.0, room.s, room.before)
    modes_into(n + 1, 0, form.taps[r, 0], room.own, room.before)
    return largest_of(n + 1, room.before)


@jit_within
def _largest_error(c: Course, rows: FloatArray, n: int) -> float:
    """The largest error in a block of any of the quantities `rows` (n_row, m) @ modes."""
    room, worst = c.room, 0.0
    for i in range(rows.shape[0]):
        scaled(n + 1, 0.0, room.s, room.before)
        modes_into(n + 1, 0, rows[i], room.own, room.before)
        carried = 0.0
        for k in range(c.w.size):
            carried += abs(rows[i, k] * c.error[k])
        worst = max(worst, largest_of(n + 1, room.before) + carried)
    return worst


@jit_within
def correct(c: Course, r: int, n: int, rest: float) -> None:
    """Correct the modes by the error seen, of which the share `rest` is left in `Room.own`; 1/A at the steps' ends."""
    form, room = c.form, c.room
    for k in range(c.w.size):
        settle(n + 1, rest, room.own[k], room.w[k])
    look_at_ends(form, room, r, n + 1, NEWTON)
    add_to_all(n + 1, form.q0[r], room.z, c.charges.q[0])


@jit_within
def accept(c: Course, r: int, n: int, rest: float, local: float, left_over: float, magnified: float) -> None:
    """Account for the peaks and errors of an accepted block, and move to its end.

    `rest` is the share of the error in `Room.before` that is left. `local` is the error of the gap voltage that the
    block adds, V; `left_over` is its part from the iteration. Row 2 of `Course.spare` has the decay of every mode over
    the block, and `Charges.h` the lengths of its steps.
    """
    room, control = c.room, c.control
    carried = 0.0
    for k in range(c.w.size):
        carried += abs(c.form.taps[r, 0, k] * c.error[k])
    gap = room.u
    if c.form.bend.size > 0:
        gap = room.slope
        scaled(n + 1, 1.0, room.u, gap)
        add(n + 1, -c.form.kappa, room.g[room.g.shape[0] - 1], gap)
    peak, force, steepest, worst, control[MEAN_Q] = peaks_of(n + 1, c.shown.stress, gap, c.charges.q[0], room.before)
    control[PEAK_U], control[PEAK_F] = max(control[PEAK_U], peak), max(control[PEAK_F], force)
    off_u = local + magnified * carried
    # The force is proportional to the square of the voltage, and depends a little on the area.
    off = rest * magnified * worst + steepest * (left_over + magnified * carried)
    control[ERROR_U] = max(control[ERROR_U], off_u)
    control[ERROR_F] = max(control[ERROR_F], 2.2 * off)
    # An error of the gap voltage changes the area, and thereby other voltages.
    # The sweeps leave larger errors at the nodes of a network than in the gap.
    node_error = left_over * (SLOWER if c.form.bend.size > 0 else 1.0)
    node_error += magnified * _largest_error(c, c.shown.node[r], n)
    control[ERROR_V] = max(control[ERROR_V], c.shown.moves[0] * off_u + node_error)
    first = c.shown.k.size - c.shown.flows
    if c.shown.flows > 0:
        charge_error = _largest_error(c, c.shown.columns[r, first:], n)
        charge_error += c.shown.capacitance * left_over + c.shown.moves[1] * off_u
        control[ERROR_Q] = max(control[ERROR_Q], charge_error)
    if c.shown.charge:
        charge_block(c, r, n, local, left_over)
    for k in range(c.w.size):
        c.w[k] = room.w[k, n]
        c.error[k] = c.error[k] * c.spare[2, k] + room.own[k, n]
    control[U_GAP] = room.u[n]
    c.counters[STEPS] += n


@jit
def march(
    c: Course, values: FloatArray, at: int, stop: int, start: float, spacing: float, tol: float, t_out: FloatArray,
    out: FloatArray,
) -> int:  # fmt: skip
    """Follow samples `values` at `start` + i `spacing` (s) from number `at` to `stop`.

    Outputs before the end are written. `tol` is the error of the gap voltage (V) that a block may add.
    """
    c, values = borrow(c), borrow(values)
    form, room, control = c.form, c.room, c.control
    steepest = steepness(form, 0.0)
    while at < stop:
        level, r = int(control[LEVEL]), int(control[REFERENCE])
        sub = 1 << level
        h, count, rest = spacing / sub, min(BLOCK >> level, stop - at), form.rest[r, level]
        n = count * sub
        _sources(values, at, count, sub, room.s)
        for k in range(c.w.size):
            room.w[k, 0] = c.w[k]
        room.u[0] = control[U_GAP]
        look_at_ends(form, room, r, 1, FIRST_NEWTON)
        # Near the area of the last block the drives are small, and the sweeps converge fast.
        to = nearest(form, control[MEAN_Q] if control[MEAN_Q] > 0.0 else form.q0[r] + room.z[0])
        if to != r:
            go_over(c, r, to, c.w)
            go_over(c, r, to, c.error)
            control[REFERENCE] = to
            continue
        left_over, margin, sweeps = relax(form, room, r, level, h, c.shown.kink, n, tol)
        c.counters[SWEEPS] += sweeps
        # An error of xi is one of the gap voltage, enlarged where the area at 0 V is smaller than the reference.
        closed, local, magnified = left_over < math.inf, math.inf, steepest
        if closed:
            misfit(form, room, r, level, h, c.shown.kink, n)
            if form.mobile:
                area_rows(n + 1, form.area, form.scale, form.shift, 0.0, room.u, c.charges.q[0])
                # The gap voltage contains the state times 1/A, and a near fold magnifies its error.
                magnified = form.area0 * largest_of(n + 1, c.charges.q[0]) / margin
            local = left_over + rest * magnified * _block_error(c, r, level, n)
        if not local <= tol:
            if level + 1 == LEVELS or margin <= LEAST_MARGIN:
                return TOO_COARSE if closed else NOT_CLOSED
            halvings = max(1.0, math.ceil(0.25 * math.log2(local / tol))) if closed else 1.0
            control[LEVEL] = min(LEVELS - 1.0, level + halvings)
            c.counters[REFUSED] += n
            continue
        control[MARGIN] = min(control[MARGIN], margin)
        for k in range(c.w.size):
            c.spare[2, k] = form.decay[r, level, k] ** n
        for i in range(n):
            c.charges.h[i] = h
        correct(c, r, n, rest)
        if c.shown.charge:
            project_for_charge(form, room, r, level, n)
        accept(c, r, n, rest, local, left_over, magnified)
        write_block(c, r, sub, count, h, start + at * spacing, t_out, out)
        at += count
        if level > 0 and local < SPARE * tol:
            control[LEVEL] -= 1.0
    return DONE
