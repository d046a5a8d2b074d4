"""Integration under a recorded source block by block (`engine.relaxation`): step lengths, errors, peaks."""

from __future__ import annotations

import math

from fingerspice.base.arrays import FloatArray
from fingerspice.base.borrowing import borrow
from fingerspice.base.compiled import jit
from fingerspice.engine.blockcharge import Course, steepness
from fingerspice.engine.blockerror import accept, correct, error_left, further_sweep, learn, quadrature_error
from fingerspice.engine.blockforms import (
    BLOCK,
    LEVEL,
    LEVELS,
    MARGIN,
    MEAN_Q,
    RATIO,
    REFERENCE,
    REFUSED,
    SWEEPS,
    U_GAP,
    Form,
)
from fingerspice.engine.blockoutput import write_block
from fingerspice.engine.blockrows import area_rows, largest_of
from fingerspice.engine.model import ramp
from fingerspice.engine.relaxation import (
    FIRST_NEWTON,
    LEAST_MARGIN,
    SPARE,
    look_at_ends,
    misfit,
    project_for_charge,
    relax,
)

# Codes returned by `march`.
DONE, NOT_CLOSED, TOO_COARSE = range(3)


@jit
def nearest(form: Form, q: float) -> int:
    """The reference for a value of 1/A, by the geometric means of neighbours; references are in rising order."""
    best = 0
    while best + 1 < form.q0.size and q * q > form.q0[best] * form.q0[best + 1]:
        best += 1
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
            for part in range(c.error.shape[0]):
                go_over(c, r, to, c.error[part])
            control[REFERENCE] = to
            continue
        change, margin, sweeps = relax(form, room, r, level, h, c.shown.kink, n, tol, control[RATIO])
        c.counters[SWEEPS] += sweeps
        # An error of xi is one of the gap voltage, enlarged where the area at 0 V is smaller than the reference.
        closed, local, seen, magnified = change < math.inf, math.inf, 0.0, steepest
        if closed:
            misfit(form, room, r, level, h, c.shown.kink, n)
            if form.mobile:
                area_rows(n + 1, form.area, form.scale, form.shift, 0.0, room.u, c.charges.q[0])
                # The gap voltage contains the state times 1/A, and a near fold magnifies its error.
                magnified = form.area0 * largest_of(n + 1, c.charges.q[0]) / margin
            seen = magnified * quadrature_error(c, r, level, n)
            local = rest * seen
        left = 0.0
        if local <= tol:
            correct(c, r, n, rest)
            further_sweep(c, r, level, n)
            left = magnified * error_left(c, r, n, rest)
            local += left
            if learn(c, r, n, tol, change, seen, left, local) and not local <= tol:
                # More sweeps leave less.
                c.counters[REFUSED] += n
                continue
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
        if c.shown.charge:
            project_for_charge(form, room, r, level, n)
        accept(c, r, n, local, magnified, left / max(change + seen, left) if left > 0.0 else 0.0)
        write_block(c, r, sub, count, h, start + at * spacing, t_out, out)
        at += count
        if level > 0 and local < SPARE * tol:
            control[LEVEL] -= 1.0
    return DONE
