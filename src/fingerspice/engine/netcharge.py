"""Charge that the sources of a network deliver over a step, and its error; `charge` is the same for a stack."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fingerspice.base.compiled import jit, jit_rows
from fingerspice.engine.charge import DERIVATIVE
from fingerspice.engine.exponential import N_PLACES, between
from fingerspice.engine.readout import ERROR_Q
from fingerspice.numerics.lobatto import END, FIRST, NODES, POINTS, ROWS

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


@jit_rows
def _integrate(integral: FloatArray, h: float, rate: FloatArray, out: FloatArray) -> None:
    """out += the integral of `rate` from the start of the step to each node."""
    for m in range(NODES):
        share = h * rate[m]
        for i in range(ROWS):
            out[i] += integral[m, i] * share


@jit_rows
def _leaks(
    mobile: bool, h: float, c: float, g: float, u: FloatArray, more: FloatArray, leak: FloatArray, moved: FloatArray
) -> None:
    """Of a cell's current beyond the reference area what is collected (A), and what is stored since the start (C).

    Under `local` the charge that stands on the area moves with it: A - A0 at the start is taken exactly, the rest along
    the voltage's polynomial. In the rate of the voltage itself a mode that has died away still holds its own rate times
    the rounding of its voltage.
    """
    for i in range(ROWS):
        leak[i] = g * more[i] * u[i]
        moved[i] = c * (more[i] * u[i] - more[0] * u[0]) if mobile else c * more[0] * (u[i] - u[0])
    if not mobile:
        for i in range(NODES):
            slope = 0.0
            for m in range(NODES):
                slope += DERIVATIVE[i, m] * u[m]
            leak[i] += c * (more[i] - more[0]) * slope / h


@jit
def charge_rows(
    mobile: bool, h: float, stored: FloatArray, stored_s: FloatArray, lost: FloatArray, lost_s: FloatArray,
    through: FloatArray, c: FloatArray, g: FloatArray, home: IntArray, integral: FloatArray, w: FloatArray,
    rate: FloatArray, s: FloatArray, ds: FloatArray, u: FloatArray, more: FloatArray, j: FloatArray, room: FloatArray,
    z: FloatArray, current: FloatArray,
) -> None:  # fmt: skip
    """Charge since the start of a step and current of each source at the nodes, into `z` and `current` (n_s, ROWS).

    `rate` (m, ROWS) are the modes' own; `room` (3, ROWS) is for passing use.
    """
    n = stored.shape[1]
    collected, leak, moved = room[0], room[1], room[2]
    for a in range(stored.shape[0]):
        for i in range(ROWS):
            z[a, i] = 0.0
            current[a, i] = 0.0
            collected[i] = 0.0
        for k in range(n):
            for i in range(ROWS):
                current[a, i] += stored[a, k] * rate[k, i]
                collected[i] += lost[a, k] * w[k, i]
                z[a, i] += stored[a, k] * (w[k, i] - w[k, 0])
        for k in range(s.shape[0]):
            for i in range(ROWS):
                current[a, i] += stored_s[a, k] * ds[k, i]
                collected[i] += lost_s[a, k] * s[k, i]
                z[a, i] += stored_s[a, k] * (s[k, i] - s[k, 0])
        for i in range(ROWS):
            current[a, i] += collected[i]
        for b in range(c.size):
            share = through[a, b]
            if share == 0.0:
                continue
            _leaks(mobile, h, c[b], g[b], u[b], more[home[b]], leak, moved)
            for i in range(ROWS):
                current[a, i] += share * j[b, i]
                collected[i] += share * leak[i]
                z[a, i] += share * moved[i]
        _integrate(integral, h, collected, z[a])


@jit
def charge_error(
    mobile: bool, h: float, stored: FloatArray, lost: FloatArray, through: FloatArray, tap: FloatArray, c: FloatArray,
    g: FloatArray, home: IntArray, cell: IntArray, unit: FloatArray, slow: IntArray, places: FloatArray,
    early: FloatArray, theta: float, u: FloatArray, area: FloatArray, slope: FloatArray, more: FloatArray,
    z: FloatArray, collected: FloatArray, control: FloatArray,
) -> None:  # fmt: skip
    """Largest error of the charges over the part of a step that counts, from the signed error of the modes.

    With du the error of a cell's voltage and dA that of its area, a charge is off by what is stored of them now, and by
    what stays: their leak, and under `local` the integral of c (dA u' - A' du). `collected` (2, n_s) holds what stayed
    so far, and the squares of what each step added: it may have cancelled by chance. `z` is that of `charge_rows`.
    """
    n, n_f, n_area = tap.shape[1], c.size, cell.size
    off = np.zeros((N_PLACES, n_f))
    area_off = np.zeros((N_PLACES, n_area))
    for p in range(N_PLACES):
        row = _row(p)
        for b in range(n_f):
            for k in range(n):
                off[p, b] += tap[b, k] * places[k, p]
        for a in range(n_area):
            if cell[a] >= 0:
                area_off[p, a] = slope[a, row] * off[p, cell[a]]
                if slow[a] >= 0:
                    area_off[p, a] = unit[a] * places[slow[a], p]
    for source in range(stored.shape[0]):
        # Under `local` what the polynomial misses of an area between nodes counts with all that the voltage moves.
        first, second, third = between(z[source])
        missed = max(abs(first), abs(second), abs(third))
        if not mobile:
            for b in range(n_f):
                first, second, third = between(area[home[b]])
                worst = max(abs(first), abs(second), abs(third))
                missed += abs(through[source, b]) * c[b] * worst * _way(u[b])
        added = 0.0
        spread = missed
        last_leak = 0.0
        last_theta = 0.0
        for p in range(N_PLACES):
            row = _row(p)
            now = 0.0
            leak = 0.0
            turned = 0.0
            for k in range(n):
                now += stored[source, k] * (places[k, p] + (early[k] if p == 0 else 0.0))
                leak += lost[source, k] * places[k, p]
            for b in range(n_f):
                a = home[b]
                share = through[source, b]
                both = more[a, row] * off[p, b] + u[b, row] * area_off[p, a]
                leak += share * g[b] * both
                now += share * c[b] * (both if mobile else more[a, row] * off[p, b])
                if p > 0 and not mobile:
                    last = _row(p - 1)
                    turned += (
                        0.5
                        * share
                        * c[b]
                        * (
                            (area_off[p, a] + area_off[p - 1, a]) * (u[b, row] - u[b, last])
                            - (area[a, row] - area[a, last]) * (off[p, b] + off[p - 1, b])
                        )
                    )
            if p > 0:
                reached = min(POINTS[row], theta)
                part = (reached - last_theta) / (POINTS[row] - last_theta)
                stays = 0.5 * h * (POINTS[row] - last_theta) * (leak + last_leak) + turned
                added += part * stays
                spread += abs(part * stays)
            control[ERROR_Q] = max(
                control[ERROR_Q],
                abs(now + collected[0, source] + added) + math.sqrt(collected[1, source] + spread * spread) + missed,
            )
            if p > 0 and reached < POINTS[row]:
                break
            last_theta = POINTS[row] if p > 0 else 0.0
            last_leak = leak
        collected[0, source] += added
        collected[1, source] += spread * spread


@jit
def _row(place: int) -> int:
    """The row that a place of the error is."""
    if place == 0:
        return 0
    return END if place == N_PLACES - 1 else FIRST + place - 1


@jit
def _way(values: FloatArray) -> float:
    """Length of the way that values at the nodes go, up and down."""
    total = 0.0
    for i in range(1, NODES):
        total += abs(values[i] - values[i - 1])
    return total
