"""A recorded source followed block by block (`engine.relaxation`): accuracy, charge, peaks and outputs.

The charge goes through the slowest layer, as in `engine.charge`. Under `local` that is the integral of
A (c V' + g V) + g0 V. A step may take the gap voltage u through most of its range, and A with it: but with
V = r u + v, r the ratio of both voltages' shares of the source, A c r u' is the derivative of c r G(u), G' = A, and v
moves as slowly as the layers leak. Quadrature is left with A c v' and the leaks.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fingerspice.base.compiled import borrow, jit, jit_rows, jit_within
from fingerspice.engine.model import Model, branch_area, ramp
from fingerspice.engine.relaxation import (
    BLOCK,
    FIRST_NEWTON,
    FIRST_QUARTER,
    LAST_QUARTER,
    LEAST_MARGIN,
    LEVELS,
    MIDDLE,
    SPARE,
    Form,
    Room,
    add_two,
    area_rows,
    look_at_ends,
    misfit,
    modes_into,
    project_for_charge,
    recursion,
    relax,
    scaled,
)
from fingerspice.numerics.moments import moments

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

# Entries of `control`: halvings of a sample, reference, and as in `engine.readout`.
LEVEL, REFERENCE, PEAK_U, PEAK_F, ERROR_U, ERROR_F, MARGIN, Z, PEAK_Q, ERROR_Q, COLLECTED, U_GAP = range(12)
N_CONTROL = 12
# Entries of `counters`.
OUTPUT, STEPS, REFUSED, SWEEPS = range(4)
# What a march returns.
DONE, NOT_CLOSED, TOO_COARSE = range(3)
# A reference serves up to so many times its own 1/A.
_FARTHEST = 1.2


class Shown(NamedTuple):
    """What is written at the outputs.

    Attributes
    ----------
    columns : ndarray, shape (r, C, m)
        Recorded voltages over k U.
    k : ndarray, shape (C,)
    slow : ndarray, shape (r, m)
        The slowest layer's share of each mode (see `Model.slow`).
    live, project : ndarray, shape (r, m, m)
        From modes to live voltages and back.
    stress : float
        Force per area and squared gap voltage, Pa/V^2.
    kink : ndarray, shape (T,)
        Slope of each drive over what it multiplies, by |u_gap| at 0 V.
    area_kink : float
        dA/d|u| at 0 V, m^2/V.
    moved : ndarray
        c r G(|u|) under `local`, a polynomial as `Form.area`, C.
    charge : bool
    """

    columns: FloatArray
    k: FloatArray
    slow: FloatArray
    live: FloatArray
    project: FloatArray
    stress: float
    kink: FloatArray
    area_kink: float
    moved: FloatArray
    charge: bool


class Charges(NamedTuple):
    """Rows of a block for the charge: 1/A at the ends and within, rates, charges, their errors, currents."""

    q: FloatArray
    q_within: FloatArray
    rate: FloatArray
    z: FloatArray
    off: FloatArray
    current: FloatArray
    error: FloatArray


def new_charges() -> Charges:
    """Room for one block."""
    n = BLOCK + 8
    return Charges(
        np.zeros(n), np.zeros((3, n)), np.zeros((3, n)), np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n)
    )  # fmt: skip


@jit_rows
def _peaks(n: int, stress: float, u: FloatArray, q: FloatArray) -> tuple[float, float, float]:
    """The largest |u|, force, and force by voltage."""
    peak, force, steepest = 0.0, 0.0, 0.0
    for i in range(n):
        x = abs(u[i])
        slope = stress * x / q[i]
        peak = x if x > peak else peak
        steepest = slope if slope > steepest else steepest
        force = slope * x if slope * x > force else force
    return peak, force, steepest


@jit_rows
def _largest(n: int, x: FloatArray) -> float:
    largest = 0.0
    for i in range(n):
        a = abs(x[i])
        largest = a if a > largest else largest
    return largest


@jit_rows
def _charge_rows(
    n: int, h: float, mobile: bool, slow: FloatArray, area0: float, kink: float, s: FloatArray, u: FloatArray,
    v: FloatArray, v_m: FloatArray, v_a: FloatArray, v_b: FloatArray, by: FloatArray, by_m: FloatArray,
    by_a: FloatArray, by_b: FloatArray, q: FloatArray, q_m: FloatArray, q_a: FloatArray, q_b: FloatArray, rate: FloatArray,
    rate_m: FloatArray, rate_end: FloatArray, gained: FloatArray, off: FloatArray,
) -> None:  # fmt: skip
    """Charge gained in each step but for what follows u, its rates at 0, 1/2 and 1, and Boole's rule less Simpson's.

    `v` is the part of the slowest layer's voltage that does not follow u, `by` that by which it leaks. What is stored
    moves with the area at the start of the step; along the polynomial of v goes what the area moves meanwhile.
    """
    share, c, g_area, g_total = slow[slow.size - 4], slow[slow.size - 3], slow[slow.size - 2], slow[slow.size - 1]
    for i in range(n):
        s0, s4 = s[i], s[i + 1]
        v0, v1, v2, v3, v4 = v[i], v_a[i], v_m[i], v_b[i], v[i + 1]
        a0, a1, a2, a3, a4 = 1.0 / q[i], 1.0 / q_a[i], 1.0 / q_m[i], 1.0 / q_b[i], 1.0 / q[i + 1]
        l0, l1, l2, l3, l4 = by[i], by_a[i], by_m[i], by_b[i], by[i + 1]
        turn = c / h
        if mobile:
            turn = 0.0
            l0 = share * s0 + area0 * l0 / a0
            l1 = share * (0.75 * s0 + 0.25 * s4) + area0 * l1 / a1
            l2 = share * (0.5 * s0 + 0.5 * s4) + area0 * l2 / a2
            l3 = share * (0.25 * s0 + 0.75 * s4) + area0 * l3 / a3
            l4 = share * s4 + area0 * l4 / a4
        r0 = (g_area * a0 + g_total) * l0
        r1 = (g_area * a1 + g_total) * l1
        r2 = (g_area * a2 + g_total) * l2
        r3 = (g_area * a3 + g_total) * l3
        r4 = (g_area * a4 + g_total) * l4
        m2, m4 = r2 + turn * (a2 - a0) * (v4 - v0), r4 + turn * (a4 - a0) * (v0 - 4.0 * v2 + 3.0 * v4)
        simpson = (r0 + 4.0 * m2 + m4) / 6.0
        # Slopes of the polynomial through all five.
        d1 = -v0 - (10.0 * v1 - 18.0 * v2 + 6.0 * v3 - v4) / 3.0
        d2 = (v0 - 8.0 * v1 + 8.0 * v3 - v4) / 3.0
        d3 = (-v0 + 6.0 * v1 - 18.0 * v2 + 10.0 * v3) / 3.0 + v4
        d4 = v0 - (16.0 * v1 - 36.0 * v2 + 48.0 * v3 - 25.0 * v4) / 3.0
        boole = (
            7.0 * r0
            + 32.0 * (r1 + turn * (a1 - a0) * d1)
            + 12.0 * (r2 + turn * (a2 - a0) * d2)
            + 32.0 * (r3 + turn * (a3 - a0) * d3)
            + 7.0 * (r4 + turn * (a4 - a0) * d4)
        ) / 90.0
        # Of the area's kink both rules miss a known part.
        x, y = u[i], u[i + 1]
        size = abs(x) + abs(y) + 1e-300
        at = abs(x) / size
        by_simpson = (abs(x) + 2.0 * abs(x + y) + abs(y)) / 6.0
        by_boole = (7.0 * (abs(x) + abs(y)) + 8.0 * (abs(3.0 * x + y) + abs(x + 3.0 * y)) + 6.0 * abs(x + y)) / 90.0
        bent = kink * (g_area * (l0 + at * (l4 - l0)) + turn * (v4 - v0))
        bent = bent if x * y < 0.0 else 0.0
        rate[i], rate_m[i], rate_end[i] = r0, m2, m4
        gained[i] = c * (area0 if mobile else a0) * (v4 - v0)
        gained[i] += h * (simpson + bent * (0.5 * (x * x + y * y) / size - by_simpson))
        off[i] = h * (boole - simpson - bent * (by_boole - by_simpson))


@jit_rows
def _leaked_error(
    n: int, h: float, slow: FloatArray, q: FloatArray, error: FloatArray, off: FloatArray
) -> None:  # fmt: skip
    """Add to a step's error of the charge what the error of the slow layer's voltage leaks in it."""
    g_area, g_total = slow[slow.size - 2], slow[slow.size - 1]
    for i in range(n):
        off[i] += 0.5 * h * (g_area / q[i] + g_total) * (error[i] + error[i + 1])


@jit
def _moved(moved: FloatArray, scale: float, shift: float, u: float) -> float:
    """Charge (C) that has followed the gap voltage: odd in it."""
    x = abs(u) * scale + shift
    total = 0.0
    for j in range(moved.size - 1, -1, -1):
        total = total * x + moved[j]
    return math.copysign(total, u)


@jit
def _moved_rows(n: int, moved: FloatArray, scale: float, shift: float, u: FloatArray, z: FloatArray) -> None:
    """Add it to charges."""
    for i in range(n):
        z[i] += _moved(moved, scale, shift, u[i])


@jit_within
def _charge(
    model: Model, form: Form, shown: Shown, room: Room, own: Charges, r: int, level: int, n: int, h: float,
    local: float, control: FloatArray,
) -> None:  # fmt: skip
    """Charge at the ends of a block's steps, and its error; `room.own` holds the error of the modes."""
    slow, p, v = model.slow, form.tap_s.size - 1, form.tap_s.size - 2
    project_for_charge(form, room, r, level, n)
    for place in (MIDDLE, FIRST_QUARTER, LAST_QUARTER):
        area_rows(n, form.area, form.scale, form.shift, 0.0, room.u_within[place], own.q_within[place])
    _charge_rows(
        n, h, form.mobile, slow, form.area0, shown.area_kink, room.s, room.u, room.end[v], room.within[MIDDLE, v],
        room.within[FIRST_QUARTER, v], room.within[LAST_QUARTER, v], room.end[p], room.within[MIDDLE, p],
        room.within[FIRST_QUARTER, p], room.within[LAST_QUARTER, p], own.q, own.q_within[MIDDLE],
        own.q_within[FIRST_QUARTER], own.q_within[LAST_QUARTER], own.rate[0], own.rate[1], own.rate[2], own.z, own.off,
    )  # fmt: skip
    for i in range(n + 1):
        own.error[i] = 0.0
    modes_into(n + 1, 0, shown.slow[r], room.own, own.error)
    _leaked_error(n, h, slow, own.q, own.error, own.off)
    z, collected = control[Z], control[COLLECTED]
    stored = slow[slow.size - 3]
    worst, peak = control[ERROR_Q], control[PEAK_Q]
    for i in range(n):
        gained = own.z[i]
        own.z[i] = z
        z += gained
        collected += own.off[i]
        now = abs(collected) + stored * (abs(own.error[i + 1]) + local) / own.q[i + 1]
        worst = now if now > worst else worst
        peak = abs(z) if abs(z) > peak else peak
    own.z[n] = z
    if not form.mobile:
        _moved_rows(n + 1, shown.moved, form.scale, form.shift, room.u, own.z)
    control[Z], control[COLLECTED], control[ERROR_Q], control[PEAK_Q] = z, collected, worst, peak


@jit
def _rate_of(
    model: Model, form: Form, shown: Shown, r: int, w: FloatArray, g: FloatArray, u_source: float, slope: float,
    u: float,
) -> float:  # fmt: skip
    """Current (A) from modes, drives, the source's value and slope, and the gap voltage."""
    slow = model.slow
    n = slow.size - 4
    dv, v, x_gap, dx_gap = 0.0, 0.0, 0.0, 0.0
    for k in range(w.size):
        dw = -form.rates[r, k] * w[k] + form.gain[r, k] * u_source
        for t in range(g.size):
            dw += form.feed[r, k, t] * g[t]
        dv += shown.slow[r, k] * dw
        v += shown.slow[r, k] * w[k]
        x_gap += form.taps[r, 0, k] * w[k]
        dx_gap += form.taps[r, 0, k] * dw
    q, dq = branch_area(model, 1.0 if u >= 0.0 else -1.0, u)
    if not form.mobile:
        leak = (slow[n + 2] + q * slow[n + 3]) * (slow[n] * u_source + v)
        return (slow[n + 1] * dv + leak + slope / model.s) / q
    scale = model.area0 * q
    lam = slow[n + 1] * dv * scale + (slow[n + 2] + q * slow[n + 3]) * (slow[n] * u_source + v * scale)
    # i = Q' with Q = A U / S + z, and u' from the area equation.
    du = (model.k_gap * slope + dx_gap * scale) / (1.0 - x_gap * model.area0 * dq)
    return lam / q + (slope / q - dq * du * u_source / (q * q)) / model.s


@jit
def _bent(at: float, a: float, b: float) -> float:
    """Integral over [0, at] of |u|, u from a to b along a straight line across 0, less that of its parabola."""
    x, y, m = abs(a), abs(b), 0.5 * abs(a + b)
    zero = x / (x + y)
    whole = x * at * (1.0 - 0.5 * at / zero) if at < zero else 0.5 * (x * zero + y * (at - zero) ** 2 / (1.0 - zero))
    square, cube = at * at, at * at * at
    parabola = x * (at - 1.5 * square + 2.0 / 3.0 * cube) + m * (2.0 * square - 4.0 / 3.0 * cube)
    missed: float = whole - parabola - y * (2.0 / 3.0 * cube - 0.5 * square)
    return missed


@jit
def _write_point(
    model: Model, form: Form, shown: Shown, room: Room, own: Charges, r: int, h: float, i: int, at: float,
    slope: float, spare: FloatArray, out: FloatArray, place: int,
) -> None:  # fmt: skip
    """One output at fraction `at` of step i, along the parabolas through the drives."""
    m, drives = form.rates.shape[1], room.g.shape[0]
    w, g, found = spare[0, :m], spare[1, :drives], spare[2, :3]
    u_source = room.s[i] + at * (room.s[i + 1] - room.s[i])
    first, middle, last = (2.0 * at - 1.0) * (at - 1.0), 4.0 * at * (1.0 - at), at * (2.0 * at - 1.0)
    for t in range(drives):
        g[t] = first * room.g[t, i] + middle * room.g_within[MIDDLE, t, i] + last * room.g[t, i + 1]
    for k in range(m):
        w[k] = room.w[k, i]
        if at > 0.0:
            z = form.rates[r, k] * h * at
            moments(z, found)
            w[k] *= math.exp(-z)
            # Constant, linear and square parts of what forces the mode along the step.
            a = form.gain[r, k] * room.s[i]
            b = form.gain[r, k] * (room.s[i + 1] - room.s[i])
            c = 0.0
            for t in range(drives):
                g0, g1, g2 = room.g[t, i], room.g_within[MIDDLE, t, i], room.g[t, i + 1]
                a += form.feed[r, k, t] * g0
                b += form.feed[r, k, t] * (4.0 * g1 - 3.0 * g0 - g2)
                c += form.feed[r, k, t] * 2.0 * (g0 - 2.0 * g1 + g2)
            w[k] += h * at * (a * found[0] + at * (b * found[1] + at * c * found[2]))
    if at > 0.0 and room.u[i] * room.u[i + 1] < 0.0:
        zero = room.u[i] / (room.u[i] - room.u[i + 1])
        bent = h * _bent(at, room.u[i], room.u[i + 1])
        for t in range(drives):
            x = room.end[1 + t, i] + zero * (room.end[1 + t, i + 1] - room.end[1 + t, i])
            for k in range(m):
                w[k] += form.feed[r, k, t] * shown.kink[t] * x * bent
    x_gap = 0.0
    for k in range(m):
        x_gap += form.taps[r, 0, k] * w[k]
    u = model.k_gap * u_source + x_gap
    scale = 1.0
    if form.mobile:
        u = room.u[i] if at == 0.0 else first * room.u[i] + middle * room.u_within[MIDDLE, i] + last * room.u[i + 1]
        for _ in range(3):
            q, dq = branch_area(model, 1.0 if u >= 0.0 else -1.0, u)
            b = model.area0 * x_gap
            u -= (u - model.k_gap * u_source - b * q) / (1.0 - b * dq)
        scale = model.area0 * branch_area(model, 1.0 if u >= 0.0 else -1.0, u)[0]
    for c in range(shown.k.size):
        v = 0.0
        for k in range(m):
            v += shown.columns[r, c, k] * w[k]
        out[c, place] = shown.k[c] * u_source + scale * v
    if shown.charge:
        slow = model.slow
        stored = 0.0
        for k in range(m):
            stored += form.taps[r, form.tap_s.size - 2, k] * (w[k] - room.w[k, i])
        followed, area = 0.0, model.area0
        if not form.mobile:
            followed = _moved(shown.moved, form.scale, form.shift, u)
            followed -= _moved(shown.moved, form.scale, form.shift, room.u[i])
            area = 1.0 / own.q[i]
        rates = (
            own.rate[0, i] * (1.0 + at * (2.0 / 3.0 * at - 1.5))
            + own.rate[1, i] * at * (2.0 - 4.0 / 3.0 * at)
            + own.rate[2, i] * at * (2.0 / 3.0 * at - 0.5)
        )
        out[shown.k.size, place] = own.z[i] + followed + slow[slow.size - 3] * area * stored + h * at * rates
        out[shown.k.size + 1, place] = _rate_of(model, form, shown, r, w, g, u_source, slope, u)


@jit_rows
def _current_rows(
    n: int, slow: FloatArray, over_s: float, h: float, s: FloatArray, dv: FloatArray, v: FloatArray, q: FloatArray,
    out: FloatArray,
) -> None:  # fmt: skip
    """The current right of the start of each step, under `local`."""
    c, g_area, g_total = slow[slow.size - 3], slow[slow.size - 2], slow[slow.size - 1]
    for i in range(n):
        out[i] = (c * dv[i] + g_area * v[i] + (s[i + 1] - s[i]) / h * over_s) / q[i] + g_total * v[i]


@jit_within
def _current(
    model: Model, form: Form, shown: Shown, room: Room, own: Charges, r: int, n: int, h: float, spare: FloatArray
) -> None:  # fmt: skip
    """The current right of the start of each step into `own.current`."""
    m, drives = form.rates.shape[1], room.g.shape[0]
    if form.mobile:
        w, g = spare[0, :m], spare[1, :drives]
        for i in range(n):
            for k in range(m):
                w[k] = room.w[k, i]
            for t in range(drives):
                g[t] = room.g[t, i]
            slope = (room.s[i + 1] - room.s[i]) / h
            own.current[i] = _rate_of(model, form, shown, r, w, g, room.s[i], slope, room.u[i])
        return
    share, by_g = spare[0, :m], spare[1, :drives]
    by_s = 0.0
    by_g[:] = 0.0
    for k in range(m):
        share[k] = -form.rates[r, k] * shown.slow[r, k]
        by_s += form.gain[r, k] * shown.slow[r, k]
        for t in range(drives):
            by_g[t] += shown.slow[r, k] * form.feed[r, k, t]
    scaled(n, by_s, room.s, room.before)
    modes_into(n, 0, share, room.w, room.before)
    modes_into(n, 0, by_g, room.g, room.before)
    _current_rows(
        n, model.slow, 1.0 / model.s, h, room.s, room.before, room.end[form.tap_s.size - 1], own.q, own.current
    )  # fmt: skip


@jit
def _every(sub: int, count: int, x: FloatArray, out: FloatArray) -> None:
    for j in range(count):
        out[j] = x[j * sub]


@jit_within
def _write_block(
    model: Model, form: Form, shown: Shown, room: Room, own: Charges, r: int, sub: int, count: int, h: float,
    start: float, spare: FloatArray, t_out: FloatArray, out: FloatArray, first: int,
) -> int:  # fmt: skip
    """Outputs from the start of a block up to, and without, its end; returns the number written so far."""
    n = count * sub
    slack = 8e-16 * (abs(start) + n * h)
    last = first
    aligned = True
    while last < t_out.size and t_out[last] < start + n * h - slack:
        j = last - first
        aligned &= j < count and abs(t_out[last] - (start + j * sub * h)) <= slack
        last += 1
    if last == first:
        return first
    if shown.charge:
        _current(model, form, shown, room, own, r, n, h, spare)
    if not aligned or last - first != count:
        for place in range(first, last):
            along = max((t_out[place] - start) / h, 0.0)
            i = min(int(along), n - 1)
            at = min(along - i, 1.0)
            if abs(t_out[place] - (start + (i + 1) * h)) <= slack and i + 1 < n:
                i, at = i + 1, 0.0
            elif abs(at * h) <= slack:
                at = 0.0
            _write_point(
                model, form, shown, room, own, r, h, i, at, (room.s[i + 1] - room.s[i]) / h, spare, out, place
            )  # fmt: skip
        return last
    for c in range(shown.k.size):
        row = room.before
        if form.mobile:
            scaled(n, 0.0, room.s, row)
            modes_into(n, 0, shown.columns[r, c], room.w, row)
            for i in range(n):
                row[i] = shown.k[c] * room.s[i] + model.area0 * own.q[i] * row[i]
        else:
            scaled(n, shown.k[c], room.s, row)
            modes_into(n, 0, shown.columns[r, c], room.w, row)
        _every(sub, count, row, out[c, first:last])
    if shown.charge:
        _every(sub, count, own.z, out[shown.k.size, first:last])
        _every(sub, count, own.current, out[shown.k.size + 1, first:last])
    return last


@jit
def _nearest(form: Form, q: float, r: int) -> int:
    """The reference for a value of 1/A: the one at hand, unless that is far off."""
    if max(q / form.q0[r], form.q0[r] / q) <= _FARTHEST:
        return r
    best = r
    for one in range(form.q0.size):
        if abs(math.log(q / form.q0[one])) < abs(math.log(q / form.q0[best])):
            best = one
    return best


@jit
def _go_over(shown: Shown, r: int, to: int, w: FloatArray, spare: FloatArray) -> None:
    """Modes around one reference as those around another."""
    m = w.size
    for i in range(m):
        spare[i] = 0.0
        for k in range(m):
            spare[i] += shown.live[r, i, k] * w[k]
    for k in range(m):
        w[k] = 0.0
        for i in range(m):
            w[k] += shown.project[to, k, i] * spare[i]


@jit
def jump(model: Model, form: Form, to: float, w: FloatArray, control: FloatArray) -> bool:
    """Take a jump of the source to `to` (V); False where it meets a fold."""
    r = int(control[REFERENCE])
    x_gap = 0.0
    for k in range(w.size):
        x_gap += form.taps[r, 0, k] * w[k]
    control[U_GAP] = ramp(model, model.k_gap * to, x_gap, control[U_GAP])
    return not math.isnan(control[U_GAP])


@jit
def march(
    model: Model, form: Form, shown: Shown, room: Room, own: Charges, values: FloatArray, at: int, stop: int,
    start: float, spacing: float, tol: float, w: FloatArray, error: FloatArray, control: FloatArray,
    counters: IntArray, spare: FloatArray, t_out: FloatArray, out: FloatArray,
) -> int:  # fmt: skip
    """Follow samples `values` at `start` + i `spacing` (s) from number `at` to `stop`.

    Outputs are written up to, and without, the end; those at the very end by `finish`. `w` and `error` (m,) are the
    modes and their error, `tol` the error of the gap voltage (V) allowed to come from a block.
    """
    form, shown, room, own, values = borrow(form), borrow(shown), borrow(room), borrow(own), borrow(values)
    m = w.size
    while at < stop:
        level, r = int(control[LEVEL]), int(control[REFERENCE])
        sub = 1 << level
        h = spacing / sub
        count = min(BLOCK >> level, stop - at)
        n = count * sub
        for j in range(count):
            for i in range(sub):
                room.s[j * sub + i] = values[at + j] + (i / sub) * (values[at + j + 1] - values[at + j])
        room.s[n] = values[at + count]
        for k in range(m):
            room.w[k, 0] = w[k]
        room.u[0] = control[U_GAP]
        look_at_ends(form, room, r, 1, FIRST_NEWTON)
        to = _nearest(form, form.q0[r] + room.z[0], r)
        if to != r:
            _go_over(shown, r, to, w, spare[0])
            _go_over(shown, r, to, error, spare[0])
            control[REFERENCE] = to
            continue
        left_over, margin, sweeps = relax(form, room, r, level, h, shown.kink, n, tol)
        counters[SWEEPS] += sweeps
        if left_over == math.inf:
            if level + 1 == LEVELS or margin <= LEAST_MARGIN:
                return NOT_CLOSED
            control[LEVEL] += 1.0
            counters[REFUSED] += n
            continue
        misfit(form, room, r, level, h, shown.kink, n)
        area_rows(n + 1, form.area, form.scale, form.shift, 0.0, room.u, own.q)
        # Of the state under `mobile` the gap voltage is 1/A times as much, and the fold magnifies it.
        magnified = model.area0 * _largest(n + 1, own.q) / margin if form.mobile else 1.0
        for i in range(n + 1):
            room.before[i] = 0.0
        carried = 0.0
        for k in range(m):
            room.own[k, 0] = 0.0
            recursion(n, form.decay[r, level, k], room.inc[k], room.other, room.own[k])
            carried += abs(form.taps[r, 0, k] * error[k])
        modes_into(n + 1, 0, form.taps[r, 0], room.own, room.before)
        local = _largest(n + 1, room.before)
        # In the middle of the steps what the parabolas miss has not cancelled yet.
        for t in range(room.g.shape[0]):
            add_two(
                n, form.early[r, level, t, 0], room.g_within[FIRST_QUARTER, t], form.early[r, level, t, 1],
                room.g_within[LAST_QUARTER, t], room.before,
            )  # fmt: skip
        local = left_over + magnified * max(local, _largest(n, room.before))
        if not local <= tol:
            if level + 1 == LEVELS:
                return TOO_COARSE
            control[LEVEL] = min(LEVELS - 1.0, level + max(1.0, math.ceil(0.25 * math.log2(local / tol))))
            counters[REFUSED] += n
            continue
        control[MARGIN] = min(control[MARGIN], margin)
        off = local + magnified * carried
        peak, force, steepest = _peaks(n + 1, shown.stress, room.u, own.q)
        control[PEAK_U], control[PEAK_F] = max(control[PEAK_U], peak), max(control[PEAK_F], force)
        control[ERROR_U], control[ERROR_F] = max(control[ERROR_U], off), max(control[ERROR_F], 2.2 * steepest * off)
        if shown.charge:
            _charge(model, form, shown, room, own, r, level, n, h, local, control)
        counters[OUTPUT] = _write_block(
            model, form, shown, room, own, r, sub, count, h, start + at * spacing, spare, t_out, out, counters[OUTPUT]
        )  # fmt: skip
        for k in range(m):
            w[k] = room.w[k, n]
            error[k] = error[k] * form.decay[r, level, k] ** n + room.own[k, n]
        control[U_GAP] = room.u[n]
        counters[STEPS] += n
        at += count
        if level > 0 and local < SPARE * tol:
            control[LEVEL] -= 1.0
    return DONE


@jit
def write_end(
    model: Model, form: Form, shown: Shown, room: Room, own: Charges, value: float, slope: float, w: FloatArray,
    control: FloatArray, counters: IntArray, spare: FloatArray, t_end: float, t_out: FloatArray,
    left: NDArray[np.bool_], every: bool, out: FloatArray,
) -> None:  # fmt: skip
    """The outputs at a time reached: left-hand ones, or `every`; `slope` is the source's there, V/s."""
    r = int(control[REFERENCE])
    for k in range(w.size):
        room.w[k, 0] = w[k]
    room.s[0] = room.s[1] = value
    room.u[0] = control[U_GAP]
    look_at_ends(form, room, r, 1, FIRST_NEWTON)
    own.z[0] = control[Z]
    if not form.mobile:
        _moved_rows(1, shown.moved, form.scale, form.shift, room.u, own.z)
    own.q[0] = 1.0
    place = counters[OUTPUT]
    while place < t_out.size and t_out[place] <= t_end and (every or left[place]):
        _write_point(model, form, shown, room, own, r, 1.0, 0, 0.0, slope, spare, out, place)
        place += 1
    counters[OUTPUT] = place
