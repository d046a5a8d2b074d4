"""Charge of the blocks of a recording.

The charge is computed through the layer that leaks slowest, as in `engine.charge`. Under `local` it is the integral of
A (c V' + g V) + g0 V, where V is the voltage of that layer. In one step the gap voltage u may pass through most of its
range, and A with it, so that quadrature of A c V' would need short steps. Therefore V is split into r u + v, where r is
the ratio of the shares that the layer and the gap take of the source. A c r u' is the derivative of c r G(u), G' = A,
and v moves as slowly as the layers leak: only A c v' and the leakage currents are left to quadrature.
"""

from __future__ import annotations

import math

import numpy as np

from fingerspice.base.arrays import FloatArray
from fingerspice.base.compiled import jit, jit_rows, jit_within
from fingerspice.engine.blockcourse import Course, inverse_area_at
from fingerspice.engine.blockforms import COLLECTED, ERROR_Q, MIDDLE, PEAK_Q, PLACES, SPAN, Z
from fingerspice.engine.blockkinks import crossing
from fingerspice.engine.blockrows import area_rows, modes_into, scaled

# Slopes, per step, at `PLACES` of the quartic through the values at 0, 1/4, 1/2, 3/4 and 1.
_SLOPES = np.array([[1.0, -8.0, 0.0, 8.0, -1.0], [-3.0, -10.0, 18.0, -6.0, 1.0], [-1.0, 6.0, -18.0, 10.0, 3.0]]) / 3.0
# Rows of `Charges.steps` after the rates; the last is the first of three.
GAINED, MISSED, HATS = 5, 6, 7
# Share of the triangles' integrals that may be missed: they are known to first order.
OF_HATS = 0.01


@jit_rows
def _charge_rows(
    n: int, h: FloatArray, slow: FloatArray, area0: float, kink: float, s: FloatArray, u: FloatArray,
    middle: FloatArray, ends: FloatArray, within: FloatArray, q: FloatArray, steps: FloatArray,
) -> None:  # fmt: skip
    """Charge gained in each step without c r G(u), its rates, and its error, into `steps` (`Charges`).

    The charge is that of Boole's rule, and its error is taken as the difference to Simpson's rule.

    The last two rows of `ends` (P, n) and `within` (3, P, n) are two voltages of the slowest layer: its part v, which
    does not follow u, and the voltage that drives its leakage current (under `mobile` the modes' part of it alone). The
    displacement charge c A dv is exact with the area at the start of the step; the change of the area since then is
    integrated along the polynomial of v. `area0` is the reference area under `mobile`, 0 under `local`.
    """
    mobile, v = area0 > 0.0, ends.shape[0] - 2
    share, c, g_area, g_total = slow[slow.size - 4], slow[slow.size - 3], slow[slow.size - 2], slow[slow.size - 1]
    for i in range(n):
        s0, s4 = s[i], s[i + 1]
        v0, v1, v2, v3, v4 = ends[v, i], within[1, v, i], within[0, v, i], within[2, v, i], ends[v, i + 1]
        a0, a1, a2, a3 = 1.0 / q[0, i], 1.0 / q[2, i], 1.0 / q[1, i], 1.0 / q[3, i]
        a4 = 1.0 / q[0, i + 1]
        l0, l1, l2 = ends[v + 1, i], within[1, v + 1, i], within[0, v + 1, i]
        l3, l4 = within[2, v + 1, i], ends[v + 1, i + 1]
        turn = c / h[i]
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
        # Slopes of the quartic through all five values of v; at 0 none is needed, as the area has not changed there.
        d1 = -v0 - (10.0 * v1 - 18.0 * v2 + 6.0 * v3 - v4) / 3.0
        d2 = (v0 - 8.0 * v1 + 8.0 * v3 - v4) / 3.0
        d3 = (-v0 + 6.0 * v1 - 18.0 * v2 + 10.0 * v3) / 3.0 + v4
        d4 = v0 - (16.0 * v1 - 36.0 * v2 + 48.0 * v3 - 25.0 * v4) / 3.0
        r1, r2 = r1 + turn * (a1 - a0) * d1, r2 + turn * (a2 - a0) * d2
        r3, r4 = r3 + turn * (a3 - a0) * d3, r4 + turn * (a4 - a0) * d4
        boole = (7.0 * r0 + 32.0 * r1 + 12.0 * r2 + 32.0 * r3 + 7.0 * r4) / 90.0
        # Both rules miss a part of the integral at the area's kink; this part is known and added.
        at, jump, _ = crossing(u[i], middle[i], u[i + 1])
        rest, early = 1.0 - at, max(0.5 - at, 0.0)
        by_simpson = (4.0 * early + rest) / 6.0
        by_boole = (32.0 * (max(0.25 - at, 0.0) + max(0.75 - at, 0.0)) + 12.0 * early + 7.0 * rest) / 90.0
        bent = kink * jump * (g_area * (l0 + at * (l4 - l0)) + turn * (v4 - v0))
        steps[0, i], steps[1, i], steps[2, i], steps[3, i], steps[4, i] = r0, r1, r2, r3, r4
        kinked = bent * (0.5 * rest * rest - by_simpson)
        off = boole - simpson - bent * (by_boole - by_simpson)
        steps[GAINED, i] = c * (area0 if mobile else a0) * (v4 - v0) + h[i] * (simpson + kinked + off)
        steps[MISSED, i] = h[i] * off


@jit_rows
def _triangle_rows(
    n: int, place: int, h: FloatArray, slow: FloatArray, k: FloatArray, slope: FloatArray, u: FloatArray,
    ends: FloatArray, within: FloatArray, q: FloatArray, bumps: FloatArray, steps: FloatArray,
) -> None:  # fmt: skip
    """Add to `steps` what a triangle of the source at a place within each step adds to the charge besides Boole's rule.

    Area and voltages have triangles, too. `slope` is the derivative of 1/A by |u| there, and k are the shares of the
    source in the projections, of which the first is u. The others are as in `_charge_rows`.
    """
    v = ends.shape[0] - 2
    c, g_area, g_total = slow[slow.size - 3], slow[slow.size - 2], slow[slow.size - 1]
    b0, b1, b2, b3, b4 = _SLOPES[place]
    by_boole, by_simpson = (12.0 / 90.0, 4.0 / 6.0) if place == MIDDLE else (32.0 / 90.0, 0.0)
    for i in range(n):
        a = 1.0 / q[1 + place, i]
        by_u = (-slope[i] if u[i] >= 0.0 else slope[i]) * k[0] * a * a
        rate = (
            b0 * ends[v, i] + b1 * within[1, v, i] + b2 * within[0, v, i] + b3 * within[2, v, i] + b4 * ends[v, i + 1]
        )
        change = by_u * (h[i] * g_area * within[place, v + 1, i] + c * rate)
        change = (change + h[i] * (g_area * a + g_total) * k[v + 1]) * bumps[place, i]
        steps[GAINED, i] += change * (0.25 - by_boole)
        steps[MISSED, i] -= change * (by_boole - by_simpson)
        steps[HATS + place, i] = change


@jit_rows
def _leaked_error(
    n: int, h: FloatArray, slow: FloatArray, q: FloatArray, error: FloatArray, of_seen: float, seen: FloatArray,
    off: FloatArray,
) -> None:  # fmt: skip
    """Error of the charge in each step (C): a share of that seen, and leakage by the error of the slow layer."""
    g_area, g_total = slow[slow.size - 2], slow[slow.size - 1]
    for i in range(n):
        off[i] = of_seen * seen[i] + 0.5 * h[i] * (g_area / q[i] + g_total) * (error[i] + error[i + 1])


@jit
def _add_decaying(n: int, start: float, decay: float, out: FloatArray) -> None:
    """Add a geometric series."""
    for i in range(n):
        out[i] += start
        start *= decay


@jit
def moved_with(moved: FloatArray, scale: float, shift: float, u: float) -> float:
    """The part c r G(u) of the charge (C), which follows the gap voltage u (V); it is odd in u."""
    x = abs(u) * scale + shift
    total = 0.0
    for j in range(moved.size - 1, -1, -1):
        total = total * x + moved[j]
    return math.copysign(total, u)


@jit_rows
def moved_rows(
    n: int, moved: FloatArray, scale: float, shift: float, u: FloatArray, row: FloatArray, z: FloatArray
) -> None:  # fmt: skip
    """Add `moved_with` at the gap voltages u (n,) to the charges z (n,); `row` (n,) is scratch."""
    last = moved.size - 1
    for i in range(n):
        row[i] = moved[last]
    for j in range(last - 1, -1, -1):
        c = moved[j]
        for i in range(n):
            row[i] = row[i] * (abs(u[i]) * scale + shift) + c
    for i in range(n):
        z[i] += row[i] if u[i] >= 0.0 else -row[i]


@jit
def charge_block(c: Course, r: int, n: int, of_seen: float, local: float, others: bool) -> None:
    """Charge at the ends of a block's steps, and its error: the share `of_seen` of what is seen of it and of the modes.

    `local` is the error of the gap voltage (V) that this block itself makes: under `mobile` it changes the area, with
    which the modes' part of the slowest layer's voltage grows. Errors of `others`, by the sweeps and of earlier blocks,
    are added. The projections that only the charge needs are known, and `Charges.h`.
    """
    form, room, own, slow, v = c.form, c.room, c.charges, c.model.slow, c.form.tap_s.size - 2
    for place in range(len(PLACES)):
        area_rows(n, form.area, form.scale, form.shift, 0.0, room.u_within[place], own.q[1 + place])
    _charge_rows(
        n, own.h, slow, form.area0 if form.mobile else 0.0, c.shown.area_kink, room.s, room.u,
        room.u_within[MIDDLE], room.end, room.within, own.q, own.steps,
    )  # fmt: skip
    hats = len(PLACES) if c.control[SPAN] > 1.0 else 0
    for place in range(hats):
        u = room.u_within[place]
        area_rows(n, form.coarse.slope, form.scale, form.shift, 0.0, u, own.current)
        _triangle_rows(
            n, place, own.h, slow, form.tap_s, own.current, u, room.end, room.within, own.q,
            room.bumps, own.steps,
        )  # fmt: skip
    scaled(n + 1, 0.0, room.s, own.error)
    modes_into(n + 1, 0, c.shown.slow[r], room.own, own.error)
    scaled(n + 1, of_seen, own.error, own.error)
    if others:
        modes_into(n + 1, 0, c.shown.slow[r], room.further, own.error)
        for k in range(c.w.size):
            # Errors of earlier blocks decay, as if all steps were equally long.
            carried = c.shown.slow[r, k] * (c.error[0, k] + c.error[1, k])
            _add_decaying(n + 1, carried, c.spare[2, k] ** (1.0 / n), own.error)
    _leaked_error(n, own.h, slow, own.q[0], own.error, of_seen, own.steps[MISSED], own.current)
    control = c.control
    z, collected, worst, peak = control[Z], control[COLLECTED], control[ERROR_Q], control[PEAK_Q]
    stored, moved = slow[slow.size - 3], 0.0
    if form.mobile:
        # 1/A changes most per volt at 0 V.
        at_rest, _ = inverse_area_at(form, 0.0)
        moved = abs(c.shown.area_kink) * at_rest * at_rest * form.area0 * local
    for i in range(n):
        own.z[i] = own.rest[i] = z
        z += own.steps[GAINED, i]
        collected += own.current[i]
        layer = abs(own.error[i + 1]) + moved * abs(room.end[v + 1, i + 1])
        now = abs(collected) + stored * layer / own.q[0, i + 1]
        if others:
            # Within a step, the quadrature misses as much of the integral of the rates' quartic.
            now += of_seen * abs(own.steps[MISSED, i])
            for place in range(hats):
                now += OF_HATS * abs(own.steps[HATS + place, i])
        worst = now if now > worst else worst
        peak = abs(z) if abs(z) > peak else peak
    own.z[n] = z
    if not form.mobile:
        moved_rows(n + 1, c.shown.moved, form.scale, form.shift, room.u, own.current, own.z)
    control[Z], control[COLLECTED], control[ERROR_Q], control[PEAK_Q] = z, collected, worst, peak


@jit
def weights_until(at: float) -> tuple[float, float, float, float, float]:
    """Weights of the values at 0, 1/4, 1/2, 3/4 and 1 in the integral of their quartic from 0 to `at`."""
    return (
        at * (1.0 + at * (-25.0 / 6.0 + at * (70.0 / 9.0 + at * (-20.0 / 3.0 + at * 32.0 / 15.0)))),
        at * at * (8.0 + at * (-208.0 / 9.0 + at * (24.0 - at * 128.0 / 15.0))),
        at * at * (-6.0 + at * (76.0 / 3.0 + at * (-32.0 + at * 64.0 / 5.0))),
        at * at * (8.0 / 3.0 + at * (-112.0 / 9.0 + at * (56.0 / 3.0 - at * 128.0 / 15.0))),
        at * at * (-0.5 + at * (22.0 / 9.0 + at * (-4.0 + at * 32.0 / 15.0))),
    )


@jit
def triangle_until(at: float, top: float) -> float:
    """Integral to `at` of a triangle with this top, of height 1 and half a step wide, less its quartic's."""
    early, middle, late = max(at - top + 0.25, 0.0), max(at - top, 0.0), max(at - top - 0.25, 0.0)
    whole = 2.0 * (early * early - 2.0 * middle * middle + late * late)
    return float(whole - weights_until(at)[int(4.0 * top)])


@jit_rows
def _within_rows(
    n: int, at: float, h: float, stored: FloatArray, steps: FloatArray, rest: FloatArray, v0: FloatArray, v: FloatArray,
    out: FloatArray,
) -> None:  # fmt: skip
    """Charge without c r G(u) at fraction `at` of each step, where the part v of the slowest layer's voltage is known.

    `stored` is c A at the start of the step, and the rates are integrated along their quartic and triangles.
    """
    a0, a1, a2, a3, a4 = weights_until(at)
    b0, b1, b2 = triangle_until(at, PLACES[0]), triangle_until(at, PLACES[1]), triangle_until(at, PLACES[2])
    for i in range(n):
        hats = b0 * steps[HATS, i] + b1 * steps[HATS + 1, i] + b2 * steps[HATS + 2, i]
        rates = a0 * steps[0, i] + a1 * steps[1, i] + a2 * steps[2, i] + a3 * steps[3, i] + a4 * steps[4, i]
        out[i] = rest[i] + stored[i] * (v[i] - v0[i]) + h * rates + hats


@jit_within
def charge_within(c: Course, at: float, n: int, out: FloatArray) -> None:
    """Charge (C) at fraction `at` of the steps of a block, whose rows are in `Course.inner`."""
    form, own, inner, v = c.form, c.charges, c.inner, c.form.tap_s.size - 2
    held = c.model.slow[c.model.slow.size - 3]
    for i in range(n):
        own.error[i] = held / own.q[0, i]
    _within_rows(n, at, own.h[0], own.error, own.steps, own.rest, c.room.end[v], inner.end[v], out)
    moved_rows(n, c.shown.moved, form.scale, form.shift, inner.u, own.current, out)
