"""Outputs of a recording at any times, one by one: along the polynomials through the drives at all five places."""

from __future__ import annotations

import math

from fingerspice.base.arrays import FloatArray
from fingerspice.base.borrowing import borrow
from fingerspice.base.compiled import jit
from fingerspice.engine.blockcharge import weights_until
from fingerspice.engine.blockcourse import Course, inverse_area_at
from fingerspice.engine.blockcurrent import current_at
from fingerspice.engine.blockforms import FIRST_QUARTER, LAST_QUARTER, MIDDLE, OUTPUT, REFERENCE, U_GAP, Form, Z
from fingerspice.engine.blockkinks import after_kink, crossing
from fingerspice.engine.relaxation import FIRST_NEWTON, look_at_ends
from fingerspice.numerics.moments import moments


@jit
def _crossing_of(c: Course, i: int) -> tuple[float, float, float]:
    """`crossing` of step i, as in `relaxation`."""
    form, room = c.form, c.room
    share = form.area0 * inverse_area_at(form, 0.0)[0]
    start = form.k_gap * room.s[i] + share * room.end[0, i]
    middle = 0.5 * form.k_gap * (room.s[i] + room.s[i + 1]) + share * room.within[MIDDLE, 0, i]
    stop = form.k_gap * room.s[i + 1] + share * room.end[0, i + 1]
    return crossing(start, middle, stop)


@jit
def _modes_at(c: Course, r: int, h: float, i: int, at: float, w: FloatArray) -> None:
    """Modes at fraction `at` > 0 of step i, along the polynomials through the drives at all five places."""
    form, room, found = c.form, c.room, c.spare[2, :5]
    drives = room.g.shape[0]
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
        # The parabola, and what it misses at the quarters: a quartic, 0 at the ends and in the middle.
        linear += 64.0 / 3.0 * mostly_early
        square -= 64.0 / 3.0 * (both + 3.0 * mostly_early)
        cubic, fourth = 128.0 / 3.0 * (1.5 * both + mostly_early), -128.0 / 3.0 * both
        forced = linear * found[1] + at * (square * found[2] + at * (cubic * found[3] + at * fourth * found[4]))
        w[k] = w[k] * math.exp(-z) + h * at * (whole * found[0] + at * forced)
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
def _drives(form: Form, r: int, source: float, u: float, w: FloatArray, g: FloatArray) -> None:
    """Drives at a gap voltage u (V) and the modes w."""
    q0, q = form.q0[r], inverse_area_at(form, u)[0]
    for t in range(g.size):
        x = form.tap_s[1 + t] * source
        for k in range(w.size):
            x += form.taps[r, 1 + t, k] * w[k]
        g[t] = (1.0 / q - 1.0 / q0) * x if t + 1 == g.size else (q - q0) * x


@jit
def _gap_at(c: Course, r: int, h: float, i: int, at: float, w: FloatArray, g: FloatArray) -> tuple[float, float, float]:
    """Gap voltage at fraction `at` of step i, source (V), and enlargement of the modes' parts by 1/A.

    The modes and drives there go into w and g.
    """
    form, room, model = c.form, c.room, c.model
    source = room.s[i] + at * (room.s[i + 1] - room.s[i])
    for k in range(w.size):
        w[k] = room.w[k, i]
    if at > 0.0:
        _modes_at(c, r, h, i, at, w)
    x_gap = 0.0
    for k in range(w.size):
        x_gap += form.taps[r, 0, k] * w[k]
    u = (2.0 * at - 1.0) * (at - 1.0) * room.u[i]
    if at > 0.0:
        u += 4.0 * at * (1.0 - at) * room.u_within[MIDDLE, i] + at * (2.0 * at - 1.0) * room.u[i + 1]
    for _ in range(3):
        q, dq = inverse_area_at(form, u)
        b = model.area0 * x_gap
        u -= (u - model.k_gap * source - b * q) / (1.0 - b * dq)
    _drives(form, r, source, u, w, g)
    return u, source, model.area0 * inverse_area_at(form, u)[0]


@jit
def _write_point(
    c: Course, r: int, h: float, i: int, at: float, slope: float, out: FloatArray, place: int
) -> None:  # fmt: skip
    """Write one output at fraction `at` of step i; `slope` is the source's slope there, V/s."""
    room, shown = c.room, c.shown
    w, g = c.spare[0, : c.w.size], c.spare[1, : room.g.shape[0]]
    u, source, scale = _gap_at(c, r, h, i, at, w, g)
    n = shown.k.size
    for column in range(n):
        v = 0.0
        for k in range(w.size):
            v += shown.columns[r, column, k] * w[k]
        out[column, place] = shown.k[column] * source + scale * v
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
