"""Integration under a recorded source block by block (`engine.relaxation`): step lengths, errors, peaks."""

from __future__ import annotations

import math

import numpy as np

from fingerspice.base.arrays import FloatArray
from fingerspice.base.borrowing import borrow
from fingerspice.base.compiled import jit
from fingerspice.engine.blockcheck import OF_SWEEPS, compare, is_due, keep, note
from fingerspice.engine.blockcourse import Course
from fingerspice.engine.blockerror import (
    accept,
    correct,
    error_left,
    further_sweep,
    learn,
    may_coarsen,
    quadrature_error,
    refine,
)
from fingerspice.engine.blockforms import (
    BLOCK,
    LEVEL,
    LEVELS,
    MARGIN,
    MEAN_Q,
    N_SHARES,
    OF_GAP,
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
from fingerspice.engine.relaxation import FIRST_NEWTON, LEAST_MARGIN, look_at_ends, misfit, project_for_charge, relax

# Codes returned by `march`.
DONE, NOT_CLOSED, TOO_COARSE = range(3)


@jit
def _load(c: Course, values: FloatArray, at: int, count: int, level: int) -> None:
    """The source in the steps of `count` samples from number `at` on."""
    s, sub = c.room.s, 1 << level
    for j in range(count):
        here = values[at + j]
        for i in range(sub):
            s[j * sub + i] = here + (i / sub) * (values[at + j + 1] - here)
    s[count * sub] = values[at + count]


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
def change_reference(c: Course, r: int) -> bool:
    """Go over to another reference if it is nearer to the area of the last block, or of the start of this one.

    Near the reference the drives are small, and the sweeps converge fast.
    """
    control = c.control
    to = nearest(c.form, control[MEAN_Q] if control[MEAN_Q] > 0.0 else c.form.q0[r] + c.room.z[0])
    if to == r:
        return False
    go_over(c, r, to, c.w)
    for part in range(c.error.shape[0]):
        go_over(c, r, to, c.error[part])
    control[REFERENCE] = to
    return True


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
def _solve(c: Course, r: int, level: int, h: float, n: int, tol: float) -> tuple[float, float, float, float]:
    """Solve a block of n steps of length h (s) from its start in `Room` on, under the source in `Room`.

    Returns the change by the last sweep (V), the least distance to the fold, the quadrature error seen (V; both errors
    inf if the sweeps do not converge), and the ratio of an error of the gap voltage to one of the first projection.
    """
    form, room = c.form, c.room
    change, margin, sweeps = relax(form, room, r, level, h, c.shown.kink, n, tol, c.control[RATIO])
    c.counters[SWEEPS] += sweeps
    if not change < math.inf:
        return change, margin, math.inf, 1.0
    misfit(form, room, r, level, c.shown.kink, n)
    area_rows(n + 1, form.area, form.scale, form.shift, 0.0, room.u, c.charges.q[0])
    # The gap voltage contains the state times 1/A, and a near fold magnifies its error.
    magnified = form.area0 * largest_of(n + 1, c.charges.q[0]) / margin
    return change, margin, magnified * quadrature_error(c, r, level, n), magnified


@jit
def begin_block(c: Course, r: int, w: FloatArray, u: float) -> None:
    """Begin a block at the modes w and the gap voltage u (V)."""
    for k in range(w.size):
        c.room.w[k, 0] = w[k]
    c.room.u[0] = u
    look_at_ends(c.form, c.room, r, 1, FIRST_NEWTON)


@jit
def _finish(c: Course, r: int, level: int, h: float, n: int) -> None:
    """Correct a solution, and prepare what its charge follows from."""
    correct(c, r, n)
    for i in range(n):
        c.charges.h[i] = h
    if c.shown.charge:
        project_for_charge(c.form, c.room, r, level, n)


@jit
def _check(
    c: Course, values: FloatArray, at: int, count: int, r: int, level: int, h: float, seen: float
) -> None:  # fmt: skip
    """Solve `count` samples by steps of length h and half of it, and note what is left of errors such as `seen` (V)."""
    control, m, n, half = c.control, c.w.size, count << level, BLOCK >> level + 1
    errors, off, w, u = np.zeros(N_SHARES), np.zeros(N_SHARES), c.w.copy(), control[U_GAP]
    before = control.copy()
    tol = OF_SWEEPS * seen
    _load(c, values, at, count, level)
    begin_block(c, r, c.w, u)
    change, _, seen, magnified = _solve(c, r, level, h, n, tol)
    closed = change < math.inf
    if closed:
        _finish(c, r, level, h, n)
        keep(c, r, n, seen, magnified, errors)
        control[:] = before
    for done in range(0, count if closed else 0, half):
        part = min(half, count - done)
        n = part << level + 1
        _load(c, values, at + done, part, level + 1)
        begin_block(c, r, w, u)
        change, _, _, _ = _solve(c, r, level + 1, 0.5 * h, n, tol)
        closed = change < math.inf
        if not closed:
            break
        _finish(c, r, level + 1, 0.5 * h, n)
        compare(c, r, done << level, n, off)
        for k in range(m):
            w[k] = c.room.w[k, n]
        u = c.room.u[n]
    note(c, level, closed, errors, off)
    control[:] = before


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
    # Where a block was checked last: none is checked twice at a step length.
    last = (-1, 0)
    while at < stop:
        r, level = int(control[REFERENCE]), int(control[LEVEL])
        h, count = spacing / (1 << level), min(BLOCK >> level, stop - at)
        n = count << level
        _load(c, values, at, count, level)
        begin_block(c, r, c.w, control[U_GAP])
        if change_reference(c, r):
            continue
        change, margin, seen, magnified = _solve(c, r, level, h, n, tol)
        left = 0.0
        local = c.checks[level, OF_GAP] * seen
        if local <= tol:
            correct(c, r, n)
            further_sweep(c, r, level, n)
            left = magnified * error_left(c, r, n)
            local += left
            if learn(c, r, n, tol, change, seen, left, local) and not local <= tol:
                # More sweeps leave less.
                c.counters[REFUSED] += n
                continue
        if (at, level) != last and is_due(c, level, n, seen, left, tol):
            _check(c, values, at, count, r, level, h, seen)
            last = (at, level)
            continue
        if not local <= tol:
            if level + 1 == LEVELS or margin <= LEAST_MARGIN:
                return TOO_COARSE if change < math.inf else NOT_CLOSED
            refine(c, level, n, local, tol)
            continue
        control[MARGIN] = min(control[MARGIN], margin)
        for k in range(c.w.size):
            c.spare[2, k] = form.decay[r, level, k] ** n
        for i in range(n):
            c.charges.h[i] = h
        if c.shown.charge:
            project_for_charge(form, room, r, level, n)
        accept(c, r, level, n, seen, left, magnified)
        write_block(c, r, level, count, h, start + at * spacing, t_out, out)
        at += count
        if level > 0 and may_coarsen(c, level, seen, left, tol):
            control[LEVEL] = level - 1.0
    return DONE
