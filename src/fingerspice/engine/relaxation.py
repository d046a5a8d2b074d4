"""Waveform relaxation over blocks of equal steps, for recordings, whose slope jumps at every sample.

In modes around a reference q0 of q = 1/A a stack is w' = -rates w + gain U + sum_t feed_t g_t (`engine.system`). The
term of the area, g_t = (q - q0) (tap_t w + tap_k U), is a few per cent of the leaks. Between two samples U is a
straight line, to which the response is exact, and g is so smooth that a parabola through three nodes suffices: the
exponential Simpson rule, of fourth order. All steps of a block are solved together: from g at all nodes the modes
follow by a recursion, from the modes the gap voltage and the next g. Each sweep reduces the error to a share of about
|q - q0| / q0, and is a set of loops over rows of hundreds of steps, which use the processor's vectors fully.

1/A has a kink where the gap voltage is 0, so that g contains kink |u| x, with x the voltage that q multiplies. u and x
are almost straight lines across the kink. What begins of |u| x there, a straight line and a square, is known; the
modes' response to it, less that to the parabola through it, is known in closed form, and is added.

The error is measured at 1/4 and 3/4 of every step, where the interpolation error of the parabola gives the quadrature
error (Boole's rule against Simpson's). If it is too large, the block is repeated with steps half as long. Otherwise
the modes are corrected by the error seen (`correct` in `engine.blockerror`), and the share of it that is left is
measured on some blocks (`engine.blockcheck`).
"""

from __future__ import annotations

import math

import numpy as np

from fingerspice.base.arrays import FloatArray
from fingerspice.base.compiled import jit, jit_within
from fingerspice.engine.blockcourse import inverse_area_at
from fingerspice.engine.blockforms import FIRST_QUARTER, LAST_QUARTER, MIDDLE, PLACES, Form, Room
from fingerspice.engine.blockkinks import add_where, find_crossings, kink_at, kink_rows, respond_to_kinks
from fingerspice.engine.blockrows import (
    PAD,
    add,
    add_three,
    add_two,
    area_rows,
    both_ends,
    change_of,
    drives_into,
    forced_by,
    largest_of,
    modes_into,
    modes_into_three,
    newton_rows,
    of_source_and_modes,
    of_two,
    product_of,
    products_of,
    recursion,
    scaled,
    sum_of,
    three_at_ends,
    three_within,
)

# Weights of the parabola through 0, 1/2 and 1 at these places.
PARABOLA = np.array([[0.0, 1.0, 0.0], [0.375, 0.75, -0.125], [-0.125, 0.75, 0.375]])
# Most sweeps of a block, and the fraction of the error allowed that the last one may leave.
MOST_SWEEPS, LEFT = 40, 0.8
# Each sweep reduces the error of a stack by about the largest relative distance of the areas from the reference; under
# `mobile` the ratio is up to twice as large, and near a fold larger still. So much is assumed at least, until a block
# has shown what it is (`learn` in `engine.blockerror`).
LEAST_RATIO, SLOWER, MOST_RATIO = 0.001, 1.8, 0.9
# First sweep in which the places of the kinks and the rate of convergence are known well enough.
KINKED = 1
# Newton steps for the gap voltage under `mobile`, in the first sweep and in later ones; and the smallest distance to
# the fold at which they are safe.
FIRST_NEWTON, NEWTON, LEAST_MARGIN = 6, 2, 0.2


@jit
def _drives(
    form: Form, q0: float, n: int, newton: int, s: FloatArray, x: FloatArray, u: FloatArray, z: FloatArray,
    slope: FloatArray, g: FloatArray,
) -> float:  # fmt: skip
    """Gap voltages and drives from the projections x (P, n); the least distance to the fold."""
    margin, drives = 1.0, g.shape[0] - 1
    for _ in range(newton):
        margin = newton_rows(n, form.area, form.scale, form.shift, form.k_gap, form.area0, s, x[0], u, z, slope)
    area_rows(n, form.area, form.scale, form.shift, q0, u, z)
    t = 0
    while t + 1 < drives:
        products_of(n, z, x[1 + t], g[t], x[2 + t], g[1 + t])
        t += 2
    if t < drives:
        product_of(n, z, x[1 + t], g[t])
    last, share = g[drives], x[1 + drives]
    for i in range(n):
        last[i] = -z[i] / (q0 * (q0 + z[i])) * share[i]
    return margin


@jit_within
def _project(form: Form, room: Room, r: int, level: int, place: int, n: int, p: int) -> None:
    """Projection p at one place within the steps."""
    x = room.within[place, p]
    by_s, by_g = form.within_s[r, level, place, p], form.within_g[r, level, place, p]
    forced_by(n, by_s, by_g, room.s, room.g, room.g_within[MIDDLE], x)
    modes_into(n, 0, form.within[r, level, place, p], room.w, x)


@jit_within
def _project_three(form: Form, room: Room, r: int, level: int, place: int, n: int) -> None:
    """The first three projections at one place within the steps, of two modes and two drives or more."""
    x, y, z = room.within[place, 0], room.within[place, 1], room.within[place, 2]
    by_w, by_g = form.within[r, level, place], form.within_g[r, level, place]
    three_within(n, form.within_s[r, level, place], by_w, by_g, room.s, room.w, room.g, room.g_within[MIDDLE], x, y, z)
    modes_into_three(n, by_w, room.w, x, y, z)
    drives_into(n, 2, by_g[0], room.g, room.g_within[MIDDLE], x)
    drives_into(n, 2, by_g[1], room.g, room.g_within[MIDDLE], y)
    drives_into(n, 2, by_g[2], room.g, room.g_within[MIDDLE], z)


@jit_within
def _look(form: Form, room: Room, r: int, level: int, place: int, n: int, newton: int) -> float:
    """Gap voltages and drives at one place within the steps; the least distance to the fold."""
    g, first = room.g_within[place], 0
    if form.rates.shape[1] > 1 and g.shape[0] > 1:
        _project_three(form, room, r, level, place, n)
        first = 3
    for p in range(first, 1 + g.shape[0]):
        _project(form, room, r, level, place, n, p)
    both_ends(n, 1.0 - PLACES[place], PLACES[place], room.s, room.s_within)
    return _drives(
        form, form.q0[r], n, newton, room.s_within, room.within[place], room.u_within[place], room.z, room.slope, g
    )  # fmt: skip


@jit_within
def project_at_ends(form: Form, room: Room, r: int, n: int, p: int) -> None:
    """Projection p at the ends of the steps."""
    of_source_and_modes(n, form.tap_s[p], room.s, form.taps[r, p], room.w, room.end[p])


@jit_within
def look_at_ends(form: Form, room: Room, r: int, n: int, newton: int) -> float:
    """Gap voltages and drives at the ends of the steps."""
    first = 0
    if form.rates.shape[1] > 1 and room.g.shape[0] > 1:
        first = 3
        three_at_ends(n, form.tap_s, form.taps[r], room.s, room.w, room.end[0], room.end[1], room.end[2])
        modes_into_three(n, form.taps[r], room.w, room.end[0], room.end[1], room.end[2])
    for p in range(first, 1 + room.g.shape[0]):
        project_at_ends(form, room, r, n, p)
    return _drives(form, form.q0[r], n, newton, room.s, room.end, room.u, room.z, room.slope, room.g)


@jit_within
def project_for_charge(form: Form, room: Room, r: int, level: int, n: int) -> None:
    """The projections that only the charge needs, at all places; those at the quarters follow the parabolas."""
    for p in range(1 + room.g.shape[0], form.tap_s.size):
        project_at_ends(form, room, r, n + 1, p)
        for place in range(len(PLACES)):
            _project(form, room, r, level, place, n, p)


@jit_within
def find_kinks(form: Form, room: Room, n: int) -> int:
    """Crossings of 0 V, and the jumps of the slope of |u| there; how many steps have one.

    u is bent there, too. What it would be with the area at 0 V is not, and crosses 0 V at the same time.
    """
    share, middle = form.area0 * inverse_area_at(form, 0.0)[0], room.other[PAD:]
    of_two(n + 1, form.k_gap, room.s, share, room.end[0], room.slope)
    both_ends(n, 0.5 * form.k_gap, 0.5 * form.k_gap, room.s, middle)
    add(n, share, room.within[MIDDLE, 0], middle)
    count = find_crossings(n, room.slope, room.where)
    kink_rows(count, room.where, room.slope, middle, room.crossed, room.jumps, room.bends)
    return count


@jit_within
def _add_kinks(form: Form, room: Room, r: int, level: int, h: float, n: int) -> None:
    """Add the response to the kink that the parabolas miss to `room.inc`."""
    x, part, count = room.slope, room.other[PAD:], find_kinks(form, room, n)
    if count == 0:
        return
    for k in range(form.rates.shape[1]):
        sum_of(n + 1, room.kinked[k], room.end[1:], x)
        respond_to_kinks(
            count, room.where, form.rates[r, k] * h, 1.0, form.share[r, level, k], room.crossed, room.jumps, room.bends,
            x, part,
        )  # fmt: skip
        add_where(count, room.where, part, room.inc[k, PAD:])


@jit_within
def keep_drives(room: Room, n: int) -> None:
    """Keep the drives, with their sign reversed, before a sweep computes new ones."""
    for t in range(room.g.shape[0]):
        scaled(n + 1, -1.0, room.g[t], room.changed[t])
        scaled(n, -1.0, room.g_within[MIDDLE, t], room.changed_within[t])


@jit_within
def ratio_of(form: Form, room: Room, r: int, n: int, margin: float, known: float, seen: float) -> float:
    """Ratio to expect between the errors of two sweeps, at this distance to the fold.

    `known` is what a block before has shown, over the areas' distance from the reference, or 0. `seen` is the ratio of
    the last two changes, which tells too little alone: the first changes begin at the guess, and hold the corrections
    at the kinks.
    """
    strayed = largest_of(n + 1, room.z) / form.q0[r]
    if known > 0.0:
        return float(min(max(known * strayed, LEAST_RATIO), MOST_RATIO))
    strayed *= SLOWER / margin
    return float(max(seen, min(max(strayed, LEAST_RATIO), MOST_RATIO)))


@jit_within
def relax(
    form: Form, room: Room, r: int, level: int, h: float, kink: FloatArray, n: int, tol: float, known: float
) -> tuple[float, float, int]:
    """Solve n steps of length h from `room.w[:, 0]` and `room.g[:, 0]`, for the source in `room.s`.

    `known` is as in `ratio_of`. Returns the change by the last sweep (V; inf if the sweeps do not converge), the least
    distance to the fold, and the number of sweeps.
    """
    modes, drives = form.rates.shape[1], room.g.shape[0]
    for t in range(drives):
        start = room.g[t, 0]
        for i in range(n):
            room.g[t, i + 1] = start
            room.g_within[MIDDLE, t, i] = start
    # First guess: the state as at the start, under the source's own values. Newton's method begins there, and the
    # change by the first sweep is measured from there.
    charged = room.u[0] - form.k_gap * room.s[0]
    for i in range(n + 1):
        room.u[i] = room.before[i] = form.k_gap * room.s[i] + charged
    both_ends(n, 0.5, 0.5, room.u, room.u_within[MIDDLE])
    for k in range(modes):
        for t in range(drives):
            room.kinked[k, t] = h * form.feed[r, k, t] * kink[t]
    last, margin, over = math.inf, 1.0, 1.0 / tol if tol > 0.0 else 1.0
    for sweep in range(MOST_SWEEPS):
        for k in range(modes):
            own = room.inc[k, PAD:]
            forced_by(
                n, form.source[r, level, k], form.drive[r, level, k], room.s, room.g, room.g_within[MIDDLE], own
            )  # fmt: skip
        if sweep >= KINKED:
            _add_kinks(form, room, r, level, h, n)
        for k in range(modes):
            recursion(n, form.decay[r, level, k], room.inc[k], room.other, room.w[k])
        newton = FIRST_NEWTON if sweep == 0 else NEWTON
        if sweep >= KINKED:
            keep_drives(room, n)
        margin = _look(form, room, r, level, MIDDLE, n, newton)
        margin = min(margin, look_at_ends(form, room, r, n + 1, newton))
        if sweep > 0 and not margin > LEAST_MARGIN:
            return math.inf, margin, sweep
        if not abs(room.u[n]) < math.inf:
            # A NaN within the block has been carried to its end by the recursion.
            return math.inf, margin, sweep
        change = change_of(n + 1, over, room.u, room.before) / over
        if sweep > 0:
            ratio = change / last if last > 0.0 else 0.0
            if not ratio < MOST_RATIO and change > tol:
                return math.inf, margin, sweep
            if change * ratio_of(form, room, r, n, margin, known, ratio) <= LEFT * tol and sweep >= KINKED:
                return change, margin, sweep
        last = change
    return math.inf, margin, MOST_SWEEPS


@jit_within
def misfit(form: Form, room: Room, r: int, level: int, kink: FloatArray, n: int) -> None:
    """Error of the modes that each step adds, into `room.inc`: Boole's rule less Simpson's."""
    count = find_kinks(form, room, n)
    for k in range(form.rates.shape[1]):
        scaled(n, 0.0, room.s, room.inc[k, PAD:])
    for place in (FIRST_QUARTER, LAST_QUARTER):
        weight = PARABOLA[place]
        both_ends(n, weight[0], weight[2], room.u, room.u_within[place])
        add(n, weight[1], room.u_within[MIDDLE], room.u_within[place])
        _look(form, room, r, level, place, n, NEWTON)
        for t in range(room.g.shape[0]):
            off = room.g_within[place, t]
            add_three(
                n, -weight[0], room.g[t], -weight[1], room.g_within[MIDDLE, t], -weight[2], room.g[t, 1:], off
            )  # fmt: skip
            kink_at(
                count, room.where, kink[t], PLACES[place], room.crossed, room.jumps, room.bends, room.end[1 + t], off
            )  # fmt: skip
    early, late = room.g_within[FIRST_QUARTER], room.g_within[LAST_QUARTER]
    for k in range(form.rates.shape[1]):
        by = form.defect[r, level, k]
        for t in range(room.g.shape[0]):
            add_two(n, by[t, 0], early[t], by[t, 1], late[t], room.inc[k, PAD:])
