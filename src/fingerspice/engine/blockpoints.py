"""Outputs of a recording at any times, one by one: along the polynomials through the drives at all five places."""

from __future__ import annotations

import math

import numpy as np

from fingerspice.base.arrays import FloatArray
from fingerspice.base.borrowing import borrow
from fingerspice.base.compiled import jit, jit_inline
from fingerspice.engine.blockcharge import weights_until
from fingerspice.engine.blockcourse import Course, bend_at, inverse_area_at, steepness
from fingerspice.engine.blockcurrent import current_at
from fingerspice.engine.blockforms import (
    FIRST_QUARTER,
    LAST_QUARTER,
    MIDDLE,
    OUTPUT,
    REFERENCE,
    U_GAP,
    Form,
    Z,
)
from fingerspice.engine.blockkinks import after_kink, crossing
from fingerspice.engine.relaxation import FIRST_NEWTON, look_at_ends
from fingerspice.numerics.moments import moments

# Fractions of a step at which checks compare what is within steps, in one of so many samples: after each sample, fast
# modes of a network decay.
APART = 4
PLACES_WITHIN = (0.015625, 0.0625, 0.1875, 0.4375)


@jit_inline
def missed_at(at: float, early: float, late: float) -> float:
    """What a drive has besides its parabola at a fraction of a step, from what it has at the quarters of the step.

    A polynomial of fourth degree, which is 0 at the ends and in the middle.
    """
    return -128.0 / 3.0 * at * (at - 0.5) * (at - 1.0) * ((early + late) * at - (0.75 * early + 0.25 * late))


@jit
def _crossing_of(c: Course, i: int) -> tuple[float, float, float]:
    """`crossing` of step i, as in `relaxation`."""
    form, room = c.form, c.room
    start, middle, stop = room.u[i], room.u_within[MIDDLE, i], room.u[i + 1]
    if form.mobile:
        share = form.area0 * inverse_area_at(form, 0.0)[0]
        start = form.k_gap * room.s[i] + share * room.end[0, i]
        middle = 0.5 * form.k_gap * (room.s[i] + room.s[i + 1]) + share * room.within[MIDDLE, 0, i]
        stop = form.k_gap * room.s[i + 1] + share * room.end[0, i + 1]
    return crossing(start, middle, stop)


@jit
def _add_kink(c: Course, i: int, at: float, g: FloatArray) -> None:
    """Add to the drives at fraction `at` of step i what their kink has besides the parabola through it."""
    zero, jump, bend = _crossing_of(c, i)
    if jump == 0.0:
        return
    middle, last = 4.0 * at * (1.0 - at), at * (2.0 * at - 1.0)
    since, early, rest = max(at - zero, 0.0), max(0.5 - zero, 0.0), 1.0 - zero
    ramp = since - middle * early - last * rest
    square = since * since - middle * early * early - last * rest * rest
    for t in range(g.size):
        x, slope = c.room.end[1 + t, i], c.room.end[1 + t, i + 1] - c.room.end[1 + t, i]
        there = x + zero * slope
        g[t] += c.shown.kink[t] * jump * (there * ramp + (slope + bend * there) * square)


@jit
def _modes_at(c: Course, r: int, h: float, i: int, at: float, w: FloatArray) -> None:
    """Modes at fraction `at` > 0 of step i, along the polynomials through the drives at all five places."""
    form, room, found = c.form, c.room, c.spare[2, :5]
    drives = room.g.shape[0]
    pulse = room.pulse[i] if form.fast >= 0 else 0.0
    half = math.exp(-0.5 * form.rates[r, max(form.fast, 0)] * h)
    whole_step = half * half
    for k in range(w.size):
        z = form.rates[r, k] * h * at
        moments(z, found)
        # Constant, linear and square coefficient of the mode's forcing, a parabola in the fraction of the step.
        whole, linear, square = form.gain[r, k] * room.s[i], form.gain[r, k] * (room.s[i + 1] - room.s[i]), 0.0
        both, mostly_early = 0.0, 0.0
        for t in range(drives):
            g0, g1, g2 = room.g[t, i], room.g_within[MIDDLE, t, i], room.g[t, i + 1]
            whole += form.feed[r, k, t] * g0
            linear += form.feed[r, k, t] * (4.0 * g1 - 3.0 * g0 - g2)
            square += form.feed[r, k, t] * 2.0 * (g0 - 2.0 * g1 + g2)
            early, late = room.g_within[FIRST_QUARTER, t, i], room.g_within[LAST_QUARTER, t, i]
            both += form.feed[r, k, t] * (early + late)
            mostly_early += form.feed[r, k, t] * (0.75 * early + 0.25 * late)
        # The parabola and what it misses at the quarters, as in `missed_at`.
        linear += 64.0 / 3.0 * mostly_early
        square -= 64.0 / 3.0 * (both + 3.0 * mostly_early)
        cubic, fourth = 128.0 / 3.0 * (1.5 * both + mostly_early), -128.0 / 3.0 * both
        forced = linear * found[1] + at * (square * found[2] + at * (cubic * found[3] + at * fourth * found[4]))
        w[k] = w[k] * math.exp(-z) + h * at * (whole * found[0] + at * forced)
        if pulse != 0.0:
            # The parabola through the part of N that is exp(-rate t), and its response.
            shown = found[0] + at * (
                (4.0 * half - 3.0 - whole_step) * found[1] + 2.0 * at * (1.0 - 2.0 * half + whole_step) * found[2]
            )
            true = math.exp(-z)
            if k != form.fast:
                gone = form.rates[r, form.fast] * h * at
                true = (math.exp(-gone) - true) / (z - gone)
            w[k] += form.feed[r, k, drives - 1] * pulse * h * at * (true - shown)
    zero, jump, bend = _crossing_of(c, i)
    if jump > 0.0:
        early, rest, since = max(0.5 - zero, 0.0), 1.0 - zero, max(at - zero, 0.0)
        for k in range(w.size):
            # The kink's correction as in `respond_to_kinks`, but up to fraction `at` instead of the end of the step.
            moments(form.rates[r, k] * h * at, found)
            one, two = at * at * found[1], at * at * at * found[2]
            by_middle, by_end = 4.0 * (one - two), 2.0 * two - one
            ramp, bent = after_kink(form.rates[r, k] * h * since, since)
            ramp -= by_middle * early + by_end * rest
            bent -= by_middle * early * early + by_end * rest * rest
            for t in range(drives):
                slope = room.end[1 + t, i + 1] - room.end[1 + t, i]
                there = room.end[1 + t, i] + zero * slope
                own = there * ramp + (slope + bend * there) * bent
                w[k] += form.feed[r, k, t] * c.shown.kink[t] * h * jump * own


@jit
def _charge_at(c: Course, r: int, h: float, i: int, at: float, w: FloatArray) -> float:
    """Charge (C) at fraction `at` of step i, where the modes w are known."""
    form, room, own = c.form, c.room, c.charges
    p, stored = form.tap_s.size - 1, 0.0
    for k in range(w.size):
        stored += form.taps[r, p, k] * (w[k] - room.w[k, i])
    rates = 0.0
    for j, weight in enumerate(weights_until(at)):
        rates += weight * own.steps[j, i]
    return float(own.z[i] + c.model.slow[c.model.slow.size - 3] * form.area0 * stored + h * rates)


@jit
def _follow_fast(c: Course, r: int, since: float, source: float, w: FloatArray, g: FloatArray) -> None:
    """Correct the mode that follows N at once, and the drive N, for what the parabola misses `since` (s) after a node.

    The ends and the middle of a step need no correction. Between them the parabola misses a kink of the slope.
    """
    form, last = c.form, g.size - 1
    rate = form.rates[r, form.fast]
    start, shown = w[form.fast], g[last]
    share = form.feed[r, form.fast, last] / rate * (1.0 - math.exp(-rate * since))
    for _ in range(3):
        xi = form.k_gap * source
        for k in range(w.size):
            xi += form.taps[r, 0, k] * w[k]
        g[last] = bend_at(form, xi)
        w[form.fast] = start + share * (g[last] - shown)


@jit
def _write_flows(
    c: Course, r: int, w: FloatArray, g: FloatArray, source: float, slope: float, xi: float, out: FloatArray
) -> None:  # fmt: skip
    """Write the rates (A) of the columns that are charges; `slope` is the source's, V/s."""
    form, shown = c.form, c.shown
    for i in range(shown.flows):
        out[i] = shown.k[shown.k.size - shown.flows + i] * slope
    rate_xi = form.k_gap * slope
    for k in range(w.size):
        rate = form.gain[r, k] * source - form.rates[r, k] * w[k]
        for t in range(g.size):
            rate += form.feed[r, k, t] * g[t]
        rate_xi += form.taps[r, 0, k] * rate
        for i in range(shown.flows):
            out[i] += shown.columns[r, shown.k.size - shown.flows + i, k] * rate
    q, _ = inverse_area_at(form, xi)
    rate_bend = (1.0 / q - 1.0 / form.q0[r]) * steepness(form, xi) * rate_xi
    for i in range(shown.flows):
        out[i] += shown.bend[shown.k.size - shown.flows + i] * rate_bend


@jit
def _network_drives(
    c: Course, r: int, h: float, i: int, at: float, source: float, w: FloatArray, g: FloatArray
) -> None:  # fmt: skip
    """Drives of a network at fraction `at` of step i, along their polynomials; the modes w there follow a fast N."""
    form, room = c.form, c.room
    first, middle, last = (2.0 * at - 1.0) * (at - 1.0), 4.0 * at * (1.0 - at), at * (2.0 * at - 1.0)
    for t in range(g.size):
        g[t] = first * room.g[t, i] + middle * room.g_within[MIDDLE, t, i] + last * room.g[t, i + 1]
        g[t] += missed_at(at, room.g_within[FIRST_QUARTER, t, i], room.g_within[LAST_QUARTER, t, i])
    if form.fast >= 0:
        faded = form.rates[r, form.fast] * h
        parabola = first + middle * math.exp(-0.5 * faded) + last * math.exp(-faded)
        g[g.size - 1] += room.pulse[i] * (math.exp(-faded * at) - parabola)
    if at > 0.0:
        _add_kink(c, i, at, g)
        if form.fast >= 0:
            _follow_fast(c, r, h * at, source, w, g)


@jit
def _stack_drives(form: Form, r: int, source: float, u: float, w: FloatArray, g: FloatArray) -> None:
    """Drives of a stack at a gap voltage u (V) and the modes w."""
    q0, q = form.q0[r], inverse_area_at(form, u)[0]
    for t in range(g.size):
        x = form.tap_s[1 + t] * source
        for k in range(w.size):
            x += form.taps[r, 1 + t, k] * w[k]
        g[t] = (1.0 / q - 1.0 / q0) * x if form.mobile and t + 1 == g.size else (q - q0) * x


@jit
def _gap_at(c: Course, r: int, h: float, i: int, at: float, w: FloatArray, g: FloatArray) -> tuple[float, float, float]:
    """Gap voltage (in a network xi) at fraction `at` of step i, source (V), and enlargement of the modes' parts by 1/A.

    The modes and drives there go into w and g.
    """
    form, room, model = c.form, c.room, c.model
    source = room.s[i] + at * (room.s[i + 1] - room.s[i])
    for k in range(w.size):
        w[k] = room.w[k, i]
    if at > 0.0:
        _modes_at(c, r, h, i, at, w)
    if form.bend.size > 0:
        _network_drives(c, r, h, i, at, source, w, g)
    x_gap = 0.0
    for k in range(w.size):
        x_gap += form.taps[r, 0, k] * w[k]
    u, scale = model.k_gap * source + x_gap, 1.0
    if form.mobile:
        u = (2.0 * at - 1.0) * (at - 1.0) * room.u[i]
        if at > 0.0:
            u += 4.0 * at * (1.0 - at) * room.u_within[MIDDLE, i] + at * (2.0 * at - 1.0) * room.u[i + 1]
        for _ in range(3):
            q, dq = inverse_area_at(form, u)
            b = model.area0 * x_gap
            u -= (u - model.k_gap * source - b * q) / (1.0 - b * dq)
        scale = model.area0 * inverse_area_at(form, u)[0]
    if form.bend.size == 0:
        _stack_drives(form, r, source, u, w, g)
    return u, source, scale


@jit
def show_within(c: Course, r: int, h: float, first: int, count: int, sub: int, stretch: float, out: FloatArray) -> None:
    """Gap voltages (V) and forces (N) of a network within steps of length h (s), into the two rows of `out`.

    They are those after one in `APART` of `count` samples, at `PLACES_WITHIN` x `stretch`. `sub` steps make a sample,
    and `first` is the number of the first sample.
    """
    w, g = np.empty(c.w.size), np.empty(c.room.g.shape[0])
    for j in range(count):
        place, rest = divmod(first + j, APART)
        if rest == 0:
            at = PLACES_WITHIN[place % len(PLACES_WITHIN)] * stretch
            xi, _, _ = _gap_at(c, r, h, j * sub, at, w, g)
            u = xi - c.form.kappa * bend_at(c.form, xi)
            q, _ = inverse_area_at(c.form, xi)
            out[0, place], out[1, place] = u, c.shown.stress * u * u / q


@jit
def _write_point(
    c: Course, r: int, h: float, i: int, at: float, slope: float, out: FloatArray, place: int
) -> None:  # fmt: skip
    """Write one output at fraction `at` of step i; `slope` is the source's slope there, V/s."""
    form, room, shown = c.form, c.room, c.shown
    w, g = c.spare[0, : c.w.size], c.spare[1, : room.g.shape[0]]
    u, source, scale = _gap_at(c, r, h, i, at, w, g)
    n = shown.k.size
    bent = bend_at(form, u) if form.bend.size > 0 else 0.0
    for column in range(n):
        v = 0.0
        for k in range(w.size):
            v += shown.columns[r, column, k] * w[k]
        if form.bend.size > 0:
            v += shown.bend[column] * bent
        out[column, place] = shown.k[column] * source + scale * v
    if shown.flows > 0:
        _write_flows(c, r, w, g, source, slope, u, out[n:, place])
    if shown.charge:
        out[n, place] = _charge_at(c, r, h, i, at, w)
        out[n + 1, place] = current_at(c, r, w, g, source, slope, u)


@jit
def write_points(c: Course, r: int, n: int, slack: float, t_out: FloatArray, out: FloatArray, last: int) -> None:
    """Write the outputs before number `last` one by one, at any times in the block, whose steps `Charges` lists."""
    c = borrow(c)
    s, t, h, i = c.room.s, c.charges.t, c.charges.h, 0
    for place in range(c.counters[OUTPUT], last):
        while i + 1 < n and t_out[place] >= t[i + 1] - slack:
            i += 1
        since = t_out[place] - t[i]
        at = 0.0 if since <= slack else min(since / h[i], 1.0)
        _write_point(c, r, h[i], i, at, (s[i + 1] - s[i]) / h[i], out, place)


@jit
def write_end(c: Course, value: float, slope: float, t_out: FloatArray, out: FloatArray) -> None:
    """Write the outputs at the end of a run, where the source has this value (V) and slope (V/s)."""
    r = int(c.control[REFERENCE])
    room, form = c.room, c.form
    for k in range(c.w.size):
        room.w[k, 0] = c.w[k]
    room.s[0] = room.s[1] = value
    room.u[0] = c.control[U_GAP]
    look_at_ends(form, room, r, 1, FIRST_NEWTON)
    c.charges.z[0] = c.control[Z]
    c.charges.q[0, 0] = 1.0
    c.charges.steps[:, 0] = 0.0
    for place in range(c.counters[OUTPUT], t_out.size):
        _write_point(c, r, 1.0, 0, 0.0, slope, out, place)
    c.counters[OUTPUT] = t_out.size
