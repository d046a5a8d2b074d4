"""The source voltage that produces a wanted gap voltage in a series stack, without a search unless a limit applies.

A given gap voltage u determines the area A and the current through the stack. Per unit area (`local` law) or in total
(`mobile`) the gap stores the charge q = c u a, with a = 1 or A, and leaks j = (g_total / A + g_area) u a. Each other
cell stores the charge s with s' = q' + j - r s, r = (g_total / A + g_area) / c, and has the voltage s / (c a). The
source voltage is the sum over the cells. For p = s - q the derivative of q drops out: p' = (j - r q) - r p. A step
solves this exactly for r at its mean over the step and a forcing that is a straight line.
"""

from __future__ import annotations

import math

import numpy as np

from fingerspice.base.arrays import BoolArray, FloatArray
from fingerspice.base.compiled import jit
from fingerspice.numerics.linear import moments
from fingerspice.physics.contact import inverse_area

# Where a limit holds the source, the secant method finds the gap voltage: tolerance of the source voltage (V), and most
# iterations.
_CLOSE, _MOST = 1e-10, 60


@jit
def _step(
    u: float, before: FloatArray, h: float, curve: FloatArray, cells: FloatArray, gap: int, mobile: bool,
    after: FloatArray,
) -> float:  # fmt: skip
    """Source voltage (V) at the end of a step of `h` (s) at which the gap voltage is `u` (V).

    `before` and `after`, shape (2, n_cell), are the states at the start and the end: p of each cell in the first row,
    its r in the second one. The gap's column holds its leakage j and its charge q instead. At the first sample `h` is 0
    and `before` is zero.
    """
    q_area = inverse_area(abs(u), curve)[0]
    scale = 1.0 / q_area if mobile else 1.0
    q = cells[gap, 0] * u * scale
    j = (cells[gap, 1] * q_area + cells[gap, 2]) * u * scale
    q0, j0 = before[1, gap], before[0, gap]
    after[0, gap], after[1, gap] = j, q
    voltage, response = u, np.empty(2)
    for i in range(cells.shape[0]):
        if i == gap:
            continue
        r = (cells[i, 1] * q_area + cells[i, 2]) / cells[i, 0]
        after[1, i] = r
        mean = 0.5 * (r + before[1, i])
        # Responses to a constant forcing of 1, and to one that rises from 0 to 1 at the end, over the step length.
        moments(mean * h, response)
        g0, g1 = j0 - mean * q0, j - mean * q
        forced = (response[0] - response[1]) * g0 + response[1] * g1
        after[0, i] = math.exp(-mean * h) * before[0, i] + h * forced
        voltage += (after[0, i] + q) / (cells[i, 0] * scale)
    return voltage


@jit
def drive_stack(
    target: FloatArray, h: float, curve: FloatArray, cells: FloatArray, gap: int, mobile: bool, limit: float,
    change: float, drive: FloatArray, held: BoolArray,
) -> None:  # fmt: skip
    """Fill `drive` (n,) with the source voltages (V) for the gap voltages `target` (n,), V, at steps of `h` (s).

    The stack starts uncharged. `cells`, shape (n_cell, 3), are capacitance per area, total and areal leakage of each
    cell. Where the source would pass `limit` (V) or change by more than `change` (V) in a step, it is held at that
    limit, the sample is marked in `held` (n,), and the layers go on from the state at the gap voltage that results. Of
    a gap alone, the drive is `target` within the limits.
    """
    before = np.zeros((2, cells.shape[0]))
    after = np.zeros((2, cells.shape[0]))
    slope, last, step = np.sum(cells[gap, 0] / cells[:, 0]), 0.0, 0.0
    for n in range(target.size):
        u = target[n]
        voltage = _step(u, before, step, curve, cells, gap, mobile, after)
        least, most = max(-limit, last - change), min(limit, last + change)
        allowed = min(max(voltage, least), most)
        held[n] = allowed != voltage
        if held[n]:
            other, miss_other = u, voltage - allowed
            u -= miss_other / slope
            for _ in range(_MOST):
                miss = _step(u, before, step, curve, cells, gap, mobile, after) - allowed
                if abs(miss) <= _CLOSE or miss == miss_other:
                    break
                new = u - miss * (u - other) / (miss - miss_other)
                other, miss_other, u = u, miss, new
            voltage = allowed
        drive[n] = voltage
        last, step = voltage, h
        before, after = after, before
