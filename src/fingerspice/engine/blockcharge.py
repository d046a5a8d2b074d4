"""Charge of the blocks of a recording.

The charge of a stack under `mobile` is computed through the layer that leaks slowest, as in `engine.charge`. What that
layer stores is c A0 v exactly, where v is the modes' part of its voltage; its leakage is left to quadrature.
"""

from __future__ import annotations

from fingerspice.base.arrays import FloatArray
from fingerspice.base.compiled import jit, jit_rows
from fingerspice.engine.blockcourse import Course, inverse_area_at
from fingerspice.engine.blockforms import COLLECTED, ERROR_Q, MIDDLE, PEAK_Q, PLACES, Z
from fingerspice.engine.blockkinks import crossing
from fingerspice.engine.blockrows import area_rows, modes_into, scaled

# Rows of `Charges.steps` after the rates.
GAINED, MISSED = 5, 6


@jit_rows
def _charge_rows(
    n: int, h: FloatArray, slow: FloatArray, area0: float, kink: float, s: FloatArray, u: FloatArray,
    middle: FloatArray, ends: FloatArray, within: FloatArray, q: FloatArray, steps: FloatArray,
) -> None:  # fmt: skip
    """Charge gained in each step, its rates, and its error, into `steps` (`Charges`).

    The charge is that of Boole's rule, and its error is taken as the difference to Simpson's rule.

    The last row of `ends` (P, n) and `within` (3, P, n) is the modes' part of the slowest layer's voltage, and `area0`
    the reference area.
    """
    v = ends.shape[0] - 1
    share, c, g_area, g_total = slow[slow.size - 4], slow[slow.size - 3], slow[slow.size - 2], slow[slow.size - 1]
    for i in range(n):
        s0, s4 = s[i], s[i + 1]
        a0, a1, a2, a3 = 1.0 / q[0, i], 1.0 / q[2, i], 1.0 / q[1, i], 1.0 / q[3, i]
        a4 = 1.0 / q[0, i + 1]
        v0, v4 = ends[v, i], ends[v, i + 1]
        l0, l4 = share * s0 + area0 * v0 / a0, share * s4 + area0 * v4 / a4
        l1 = share * (0.75 * s0 + 0.25 * s4) + area0 * within[1, v, i] / a1
        l2 = share * (0.5 * s0 + 0.5 * s4) + area0 * within[0, v, i] / a2
        l3 = share * (0.25 * s0 + 0.75 * s4) + area0 * within[2, v, i] / a3
        r0 = (g_area * a0 + g_total) * l0
        r1 = (g_area * a1 + g_total) * l1
        r2 = (g_area * a2 + g_total) * l2
        r3 = (g_area * a3 + g_total) * l3
        r4 = (g_area * a4 + g_total) * l4
        simpson = (r0 + 4.0 * r2 + r4) / 6.0
        boole = (7.0 * r0 + 32.0 * r1 + 12.0 * r2 + 32.0 * r3 + 7.0 * r4) / 90.0
        # Both rules miss a part of the integral at the area's kink; this part is known and added.
        at, jump, _ = crossing(u[i], middle[i], u[i + 1])
        rest, early = 1.0 - at, max(0.5 - at, 0.0)
        by_simpson = (4.0 * early + rest) / 6.0
        by_boole = (32.0 * (max(0.25 - at, 0.0) + max(0.75 - at, 0.0)) + 12.0 * early + 7.0 * rest) / 90.0
        bent = kink * jump * g_area * (l0 + at * (l4 - l0))
        steps[0, i], steps[1, i], steps[2, i], steps[3, i], steps[4, i] = r0, r1, r2, r3, r4
        kinked = bent * (0.5 * rest * rest - by_simpson)
        off = boole - simpson - bent * (by_boole - by_simpson)
        steps[GAINED, i] = c * area0 * (v4 - v0) + h[i] * (simpson + kinked + off)
        steps[MISSED, i] = h[i] * off


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
def charge_block(c: Course, r: int, n: int, of_seen: float, local: float, others: bool) -> None:
    """Charge at the ends of a block's steps, and its error: the share `of_seen` of what is seen of it and of the modes.

    `local` is the error of the gap voltage (V) that this block itself makes: it changes the area, with which the modes'
    part of the slowest layer's voltage grows. Errors of `others`, by the sweeps and of earlier blocks, are added. The
    projections that only the charge needs are known, and `Charges.h`.
    """
    form, room, own, slow, v = c.form, c.room, c.charges, c.model.slow, c.form.tap_s.size - 1
    for place in range(len(PLACES)):
        area_rows(n, form.area, form.scale, form.shift, 0.0, room.u_within[place], own.q[1 + place])
    _charge_rows(
        n, own.h, slow, form.area0, c.shown.area_kink, room.s, room.u,
        room.u_within[MIDDLE], room.end, room.within, own.q, own.steps,
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
    stored = slow[slow.size - 3]
    # 1/A changes most per volt at 0 V.
    at_rest, _ = inverse_area_at(form, 0.0)
    moved = abs(c.shown.area_kink) * at_rest * at_rest * form.area0 * local
    for i in range(n):
        own.z[i] = z
        z += own.steps[GAINED, i]
        collected += own.current[i]
        layer = abs(own.error[i + 1]) + moved * abs(room.end[v, i + 1])
        now = abs(collected) + stored * layer / own.q[0, i + 1]
        if others:
            # Within a step, the quadrature misses as much of the integral of the rates' quartic.
            now += of_seen * abs(own.steps[MISSED, i])
        worst = now if now > worst else worst
        peak = abs(z) if abs(z) > peak else peak
    own.z[n] = z
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
