"""Phasor solution of layers in series (Eqs. 8 to 15), on plain arrays.

Written from the impedances, in their own order, and sharing nothing with the state space: each is the other's test.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from fingerspice.base.arrays import ComplexArray


def layer_gains(admittance: ArrayLike) -> ComplexArray:
    """Complex share of the source voltage across each layer (Eq. 11 before the modulus), shape (..., n_layer).

    The admittances are 1/Z_x = 1/R_x + i Omega C_x (Eq. 9), S; of an open layer it is 0: it takes all the voltage.
    """
    y = np.asarray(admittance, complex)
    # Impedances scaled by the smallest admittance: an open layer then needs no infinity.
    smallest = np.take_along_axis(y, np.abs(y).argmin(-1)[..., None], -1)
    with np.errstate(divide="ignore", invalid="ignore"):
        z = np.where(y == 0.0, 1.0, smallest / np.where(y == 0.0, 1.0, y))
        z = np.where((smallest == 0.0) & (y != 0.0), 0.0, z)
    return np.asarray(z / z.sum(-1, keepdims=True))


def coupled_area(area_of: Callable[[float], float], gain_of: Callable[[float], float], amplitude: float) -> float:
    """Area A = g(U_gap / sqrt 2), coupled through the mean stress and iterated to rounding (m^2).

    It follows from g, gap voltage (V) to ridge contact area (m^2), from `gain_of`, area (m^2) to |U_gap / U_0| (Eq.
    11), and from the amplitude U_0 (V). The gain lies between 0 and 1, so the root of u - U_0 |gain(g(u / sqrt 2))| is
    bracketed by 0 and U_0. Where the area answers strongly, iterating on it would swing between two values for ever.
    """
    lo, hi, before = 0.0, abs(amplitude), math.inf
    u = hi
    for _ in range(200):
        new = abs(amplitude) * gain_of(area_of(u / math.sqrt(2.0)))
        lo, hi = (u, hi) if new > u else (lo, u)
        if min(abs(new - u), hi - lo) <= 3e-16 * abs(u):
            break
        # The map contracts strongly in most scenes; where it does not halve the bracket, bisection does.
        u = new if hi - lo <= 0.5 * before and lo <= new <= hi else 0.5 * (lo + hi)
        before = hi - lo
    return float(area_of(u / math.sqrt(2.0)))
