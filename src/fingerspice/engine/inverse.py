"""The source's voltage that makes a wanted gap voltage in a series stack: no search where no limit holds it.

With the gap voltage u given the area A is, and so is what flows through every layer. Per unit area (`local` law) or in
all (`mobile`) the gap holds the charge q = c u a, with a = 1 or A, and leaks j = (g_total / A + g_area) u a. Each other
cell has the charge s with s' = q' + j - r s, r = (g_total / A + g_area) / c, and the voltage s / (c a). The source's
voltage is the sum. With p = s - q there is no derivative left: p' = (j - r q) - r p, stepped by an exponential with r
at its mean and the rest a straight line.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fingerspice.base.compiled import jit
from fingerspice.physics.contact import inverse_area

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

# Where a limit holds the source the gap voltage is found by secants to this, V, in at most so many.
_CLOSE, _MOST = 1e-10, 60


@jit
def _step(
    u: float, before: FloatArray, h: float, curve: FloatArray, cells: FloatArray, gap: int, mobile: bool,
    after: FloatArray,
) -> float:  # fmt: skip
    """Voltage of the source (V) where the gap has `u` at the end of a step of `h` (s).

    `before` and `after`, shape (2, n_cell): p of each cell, and of the same (of the gap: leak j, charge q) the rates r;
    at the first time `h` is 0 and `before` zeros.
    """
    q_area = inverse_area(abs(u), curve)[0]
    scale = 1.0 / q_area if mobile else 1.0
    q = cells[gap, 0] * u * scale
    j = (cells[gap, 1] * q_area + cells[gap, 2]) * u * scale
    q0, j0 = before[1, gap], before[0, gap]
    after[0, gap], after[1, gap] = j, q
    voltage = u
    for i in range(cells.shape[0]):
        if i == gap:
            continue
        r = (cells[i, 1] * q_area + cells[i, 2]) / cells[i, 0]
        after[1, i] = r
        if h == 0.0:
            after[0, i] = 0.0
        else:
            mean = 0.5 * (r + before[1, i])
            z = mean * h
            decay = math.exp(-z)
            # Integrals over the step of what is 1 at its begin, and of what is 1 at its end, each a straight line.
            if z > 1e-3:
                all_of = (1.0 - decay) / z
                end = (1.0 - all_of) / z
            else:
                all_of = 1.0 - z * (0.5 - z / 6.0)
                end = 0.5 - z * (1.0 / 6.0 - z / 24.0)
            g0, g1 = j0 - mean * q0, j - mean * q
            after[0, i] = decay * before[0, i] + h * ((all_of - end) * g0 + end * g1)
        voltage += (after[0, i] + q) / (cells[i, 0] * scale)
    return voltage


@jit
def drive_stack(
    target: FloatArray, h: float, curve: FloatArray, cells: FloatArray, gap: int, mobile: bool, limit: float,
    change: float, drive: FloatArray, held: BoolArray,
) -> None:  # fmt: skip
    """Fill `drive` (n,) with the source's voltages (V) for the gap voltages `target` (n,), V, at steps of `h` (s).

    It starts uncharged. `cells` are c, total and areal leakage of each cell, shape (n_cell, 3). Where the source would
    pass `limit` (V) or change by more than `change` (V) in a step, it is held there, marked in `held` (n,), and the
    layers go on from the state that this makes.
    """
    before = np.zeros((2, cells.shape[0]))
    after = np.zeros((2, cells.shape[0]))
    slope = 0.0
    for i in range(cells.shape[0]):
        slope += cells[gap, 0] / cells[i, 0]
    last, step = 0.0, 0.0
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


@jit
def hold(wish: FloatArray, limit: float, change: float, drive: FloatArray, held: BoolArray) -> None:
    """Fill `drive` (n,) with `wish` (n,) within `limit` (V) and changes of `change` (V) a step; `held` marks where."""
    last = 0.0
    for n in range(wish.size):
        last = min(max(wish[n], max(-limit, last - change)), min(limit, last + change))
        drive[n] = last
        held[n] = last != wish[n]
