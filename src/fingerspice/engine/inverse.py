"""The drive of a series stack whose gap voltage is prescribed.

With the gap voltage u(t) the area A(t) is known, and so is the current per area through every cell of the loop: what
charges and leaks through the gap. Every other cell x, of capacitance c and leak per area l = g_total / A + g_area, then
answers it alone. With r = c_gap / c_x, lambda = l / c and u_x = r u + y,

    y' = -lambda_x y + r (lambda_gap - lambda_x) u                                              local

and the same for the charge per area at rest, with Q = c_gap A u in place of r u, under `mobile`. No derivative of u is
needed, and the loop's voltage is the sum over the cells.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from fingerspice.base.arrays import BoolArray, FloatArray
from fingerspice.base.compiled import jit
from fingerspice.numerics.moments import moments
from fingerspice.physics.contact import inverse_area

# Steps of Newton's method with a fixed slope where a limit decides, and their error over the gap voltage.
_MOST_TRIES, _CLOSE = 60, 1e-13


class Cells(NamedTuple):
    """The cells of a loop beside the gap.

    Attributes
    ----------
    mobile : bool
        Charge law.
    c, g_total, g_area : ndarray, shape (n,)
        Capacitance per area (F/m^2), leak (S) and leak per area (S/m^2) of the other cells.
    gap : ndarray, shape (3,)
        The same of the gap.
    curve : ndarray
        Of the area, see `physics.contact.inverse_area`.
    """

    mobile: bool
    c: FloatArray
    g_total: FloatArray
    g_area: FloatArray
    gap: FloatArray
    curve: FloatArray


@jit
def _forcing(cells: Cells, x: int, u: float) -> tuple[float, float, float]:
    """Rate of a cell (1/s), its forcing, and r u or Q, at a gap voltage."""
    q = inverse_area(abs(u), cells.curve)[0]
    rate = (cells.g_total[x] * q + cells.g_area[x]) / cells.c[x]
    own = (cells.gap[1] * q + cells.gap[2]) / cells.gap[0]
    held = cells.gap[0] * u / q if cells.mobile else cells.gap[0] / cells.c[x] * u
    return rate, (own - rate) * held, held


@jit
def _end(cells: Cells, x: int, h: float, y: float, u0: float, middle: float, u1: float, room: FloatArray) -> float:
    """y of a cell at the end of a step, by the exponential of its mean rate and Simpson's points.

    What the rate departs from its mean is taken from a first solution without that.
    """
    rate0, forced0, _ = _forcing(cells, x, u0)
    rate_m, forced_m, _ = _forcing(cells, x, middle)
    rate1, forced1, _ = _forcing(cells, x, u1)
    mean = (rate0 + 4.0 * rate_m + rate1) / 6.0
    moments(mean * h, room)
    decay: float = math.exp(-mean * h)
    w1 = h * (2.0 * room[2] - room[1])
    w_m = h * 4.0 * (room[1] - room[2])
    w0 = h * (room[0] - 3.0 * room[1] + 2.0 * room[2])
    end: float = decay * y + w0 * forced0 + w_m * forced_m + w1 * forced1
    for _ in range(2):
        half = 0.5 * (y + end)
        if mean * h < 1.0:
            # Hermite's cubic; over many time constants its slopes would swing it out.
            half += 0.125 * h * (forced0 - rate0 * y - forced1 + rate1 * end)
        end = (
            decay * y + w0 * (forced0 - (rate0 - mean) * y) + w_m * (forced_m - (rate_m - mean) * half)
            + w1 * (forced1 - (rate1 - mean) * end)
        )  # fmt: skip
    return end


@jit
def _loop_voltage(
    cells: Cells, h: float, y: FloatArray, u0: float, middle: float, u1: float, room: FloatArray, ends: FloatArray
) -> float:
    """Voltage around the loop at the end of a step, whose y are written into `ends`."""
    total = u1
    q = inverse_area(abs(u1), cells.curve)[0]
    for x in range(y.size):
        ends[x] = _end(cells, x, h, y[x], u0, middle, u1, room)
        held = cells.gap[0] * u1 / q if cells.mobile else cells.gap[0] / cells.c[x] * u1
        total += (ends[x] + held) * (q / cells.c[x] if cells.mobile else 1.0)
    return total


@jit
def drive(
    cells: Cells, wanted: FloatArray, h: float, limit: float, slew: float, u: FloatArray, loop: FloatArray,
    limited: BoolArray,
) -> bool:  # fmt: skip
    """The drive of a stack that starts without charge; False where no gap voltage belongs to a limited one.

    Parameters
    ----------
    cells : Cells
    wanted : ndarray, shape (2 n - 1,)
        Gap voltage (V) wanted at the samples and halfway between them.
    h : float
        Time between samples, s.
    limit, slew : float
        Largest size of the drive (V), and of its slope (V/s) between samples; inf for none.
    u, loop, limited : ndarray, shape (n,)
        Take the gap voltage, the voltage around the loop, and whether a limit has decided it.
    """
    share = 1.0
    for x in range(cells.c.size):
        share += cells.gap[0] / cells.c[x]
    y, ends, room = np.zeros(cells.c.size), np.zeros(cells.c.size), np.zeros(3)
    loop[0] = min(max(share * wanted[0], -limit), limit)
    u[0] = loop[0] / share
    limited[0] = u[0] != wanted[0]
    for k in range(1, u.size):
        on_track = not limited[k - 1]
        target = wanted[2 * k]
        middle = wanted[2 * k - 1] if on_track else 0.5 * (u[k - 1] + target)
        needed = _loop_voltage(cells, h, y, u[k - 1], middle, target, room, ends)
        low, high = max(-limit, loop[k - 1] - slew * h), min(limit, loop[k - 1] + slew * h)
        u[k], loop[k], limited[k] = target, min(max(needed, low), high), not low <= needed <= high
        if limited[k]:
            found = target
            for _ in range(_MOST_TRIES):
                step = (loop[k] - needed) / share
                found += step
                needed = _loop_voltage(cells, h, y, u[k - 1], 0.5 * (u[k - 1] + found), found, room, ends)
                if abs(step) <= _CLOSE * max(abs(found), abs(u[k - 1])):
                    break
            if not abs(needed - loop[k]) <= 1e-9 * abs(loop[k]) + 1e-12:
                return False
            u[k] = found
        for x in range(y.size):
            y[x] = ends[x]
    return True
