"""Charge through the terminals over a step, and its error: both are computed through the layer that leaks slowest."""

from __future__ import annotations

import math
from typing import Any

from fingerspice.base.arrays import FloatArray
from fingerspice.base.compiled import jit, jit_rows, jit_within
from fingerspice.engine.collocation.exponential import between, largest
from fingerspice.engine.collocation.readout import N_PLACES, Control, row_of
from fingerspice.engine.one_area.model import Model
from fingerspice.engine.one_area.rows import DQ, MORE, SCRATCH, SLOPE, SOURCE, X_GAP, Q, U, Work
from fingerspice.numerics.lobatto import NODES, POINTS, ROWS, TO_SLOPES

# The interpolation error of a rate changes its sign at every node, so that its integral is at most this fraction of its
# largest value times the step length. The fraction is 0.03 to 0.14 where the error is a Chebyshev polynomial of degree
# 13 to 21. Where the area changes tenfold within a step the error is no such polynomial; the fraction is then 0.22 in
# scene 7391 of tests/stress.py.
LOBE, _STEEP_LOBE, _STEEP = 0.15, 0.3, 10.0


@jit_within
def charge_step(c: Any, s: Any, z: FloatArray, current: FloatArray) -> None:
    """Charge z (C) and current (A) at the nodes of the step at hand of a stack.

    Both are computed through the layer that leaks slowest: the sum over all leaks would be a small difference of large
    currents. The charge that this layer stores follows from its voltages, not from the integral of w': for a fast mode
    that has decayed w' still contains its rate times the error of w, and quadrature over a step much longer than the
    mode's time constant would turn this into charge. `places` holds the error of the modes, of which the part up to
    fraction `theta` of the step counts.
    """
    system, work, step, control, level = c.system, c.work, s.step[0], s.control[0], s.step[0].level
    model, r, w, pull = system.model, work.r, work.modal.w, work.modal.pull
    h, theta, z0 = step.length, step.theta, s.y[-1]
    rates, gain, gap, slow_share = system.rates[level], system.gain[level], system.gap[level], system.slow[level]
    n = rates.size
    slow = model.slow
    voltage, leak = r[SCRATCH], r[MORE]
    for j in range(ROWS):
        dv = 0.0
        v = 0.0
        dx_gap = 0.0
        for k in range(n):
            dw = -rates[k] * w[k, j] + gain[k] * r[SOURCE, j] + pull[k, j]
            dv += slow_share[k] * dw
            v += slow_share[k] * w[k, j]
            dx_gap += gap[k] * dw
        q = r[Q, j]
        scale = model.area0 * q if model.mobile else 1.0
        lam = slow[n + 1] * dv * scale + (slow[n + 2] + q * slow[n + 3]) * (slow[n] * r[SOURCE, j] + v * scale)
        # The voltage whose change, times the capacitance A_0 c (`mobile`) or A c (`local`), is stored charge.
        voltage[j] = v if model.mobile else slow[n] * r[SOURCE, j] + v
        leak[j] = (slow[n + 2] / q + slow[n + 3]) * (slow[n] * r[SOURCE, j] + v * scale)
        if model.mobile:
            # i = Q' with Q = A U / S + z, and u' from the area equation.
            margin = 1.0 - r[X_GAP, j] * model.area0 * r[DQ, j]
            du = (model.k_gap * r[SLOPE, j] + dx_gap * scale) / margin
            current[j] = lam / q + (r[SLOPE, j] / q - r[DQ, j] * du * r[SOURCE, j] / (q * q)) / model.s
        else:
            current[j] = (lam + r[SLOPE, j] / model.s) / q
    start = model.area0 if model.mobile else 1.0 / r[Q, 0]
    if not model.mobile and model.coupled:
        # Charge A c dv: exact with A at the start of the step; the change of A is integrated along the polynomial.
        _add_moves(slow[n + 1] / h, voltage, r[Q], leak)
    missed, kept = _missed(r[Q], leak, c.tables.lobes, h)
    for i in range(ROWS):
        z[i] = z0
    integrate(c.integral, h, leak, z)
    for j in range(NODES):
        z[j] += slow[n + 1] * start * (voltage[j] - voltage[0])
        control.peak_q = max(control.peak_q, abs(z[j]))
    kept = missed if theta < 1.0 else kept
    _account(model, gap, slow_share, work, h, theta, missed, kept, control, s.collected)


@jit_rows
def _add_moves(factor: float, voltage: FloatArray, q: FloatArray, rate: FloatArray) -> None:
    """Add to `rate` factor (A - A at the start) times the slope of the voltage's polynomial, per step length."""
    for j in range(ROWS):
        slope = 0.0
        for m in range(NODES):
            slope += TO_SLOPES[m, j] * voltage[m]
        rate[j] += factor * (1.0 / q[j] - 1.0 / q[0]) * slope


@jit_rows
def integrate(integral: FloatArray, h: float, rate: FloatArray, out: FloatArray) -> None:
    """out += the integral of `rate` from the start of the step to each node."""
    for m in range(NODES):
        share = h * rate[m]
        for i in range(ROWS):
            out[i] += integral[m, i] * share


@jit
def _account(
    model: Model, gap: FloatArray, slow_share: FloatArray, work: Work, h: float, theta: float, missed: float,
    kept: float, control: Control, collected: FloatArray,
) -> None:  # fmt: skip
    """Update the largest error of the charge, over the part of a step that counts, from the signed error of the modes.

    Let dv be the error of the slow layer's voltage and dA the error of the area. At a given time the charge has the
    error c A dv. It also keeps a lasting error: the leakage of dv and, under `local`, the integral of
    c (dA v' - A' dv), which vanishes where the slow layer is the gap, whose voltage determines the area. The
    interpolation error of the modes changes its sign at every node: it counts in the former error and is left out of
    the latter. `missed` is the error of the charge within the step by interpolation of its rate, and `kept` the part of
    it that lasts, C.
    """
    n, slow, r, w, places, brief = gap.size, model.slow, work.r, work.modal.w, work.modal.places, work.modal.brief
    capacitance, g_area, g_total = slow[n + 1], slow[n + 2], slow[n + 3]
    last_area, last_voltage, last_gap, last_error, last_gap_error = 0.0, 0.0, 0.0, 0.0, 0.0
    last_theta = 0.0
    added = 0.0
    collected[1, 0] += kept * kept
    for p in range(N_PLACES):
        row = row_of(p)
        q = r[Q, row]
        area = 1.0 / q
        v, error, gap_error, between_nodes, gap_between = 0.0, 0.0, 0.0, 0.0, 0.0
        for k in range(n):
            v += slow_share[k] * w[k, row]
            error += slow_share[k] * places[k, p]
            gap_error += gap[k] * places[k, p]
            between_nodes += slow_share[k] * brief[k, p]
            gap_between += gap[k] * brief[k, p]
        now = capacitance * area * error
        lasting, lasting_gap = error - between_nodes, gap_error - gap_between
        if model.mobile:
            # Q = A U / S + z has the error of A, too, by that of u, which the fold magnifies.
            scale = model.area0 * q
            magnified = scale / max(1.0 - model.area0 * r[X_GAP, row] * r[DQ, row], 1e-12)
            now = capacitance * model.area0 * error - r[DQ, row] * area * area * magnified * gap_error * (
                r[SOURCE, row] / model.s
            )
            lasting_gap *= magnified
            lasting = scale * lasting + v * scale * r[DQ, row] * area * lasting_gap
            v *= scale
        voltage = slow[n] * r[SOURCE, row] + v
        if p == 0:
            if not model.mobile and control.last_q > 0.0:
                # A jump's charge is an integral of A over the gap voltage; the error of the latter shifts both limits.
                added += (area - 1.0 / control.last_q) * lasting_gap / (model.k_gap * model.s)
        else:
            reached = min(POINTS[row], theta)
            part = (reached - last_theta) / (POINTS[row] - last_theta)
            mean_error = 0.5 * (lasting + last_error)
            move = area - last_area
            slope = move / (r[U, row] - last_gap) if r[U, row] != last_gap else 0.0
            mean_area_error = 0.5 * slope * (lasting_gap + last_gap_error)
            leak = (g_total + g_area * area) * mean_error + g_area * 0.5 * (voltage + last_voltage) * mean_area_error
            stays = h * (POINTS[row] - last_theta) * leak
            if not model.mobile:
                stays += capacitance * (mean_area_error * (voltage - last_voltage) - move * mean_error)
            added += part * stays
            if reached < POINTS[row]:
                break
            last_theta = reached
        known = now + collected[0, 0] + added
        # The signs of `missed` and of the shares in `collected[1]` are not known: add squares.
        control.error_q = max(control.error_q, math.sqrt(known * known + missed * missed + collected[1, 0]))
        last_area, last_voltage, last_gap = area, voltage, r[U, row]
        last_error, last_gap_error = lasting, lasting_gap
    collected[0, 0] += added


@jit
def _missed(q: FloatArray, rate: FloatArray, lobes: FloatArray, h: float) -> tuple[float, float]:
    """Error of the charge (C) within a step, and at its end, by interpolation of the charge's rate.

    Where the area falls by decades within a step, this error shows long before the voltages' own interpolation errors.
    At the end of the step the quadrature has twice the order of the interpolation: there the relative error of the rate
    counts squared.
    """
    first, second, third = between(lobes, rate)
    worst = abs(largest(first, second, third))
    lowest, highest, size = q[0], q[0], 0.0
    for j in range(NODES):
        lowest, highest, size = min(lowest, q[j]), max(highest, q[j]), max(size, abs(rate[j]))
    lobe = (_STEEP_LOBE if highest > _STEEP * lowest else LOBE) * h * worst
    return lobe, lobe * worst / size if worst < size else lobe
