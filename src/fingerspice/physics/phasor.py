"""Phasor solution of layers in series (Eqs. 8 to 15), on plain arrays.

Written from the impedances, in their own order, and sharing nothing with the state space: each is the other's test.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from fingerspice.base.arrays import ComplexArray, FloatArray
from fingerspice.base.errors import InputError


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


def settled_areas(following: Callable[[FloatArray], FloatArray], area: FloatArray) -> FloatArray:
    """Areas (n,) that follow from their own voltages, to rounding, by the secant method for each, m^2.

    `following` gives the areas that follow from the voltages at areas; the first guess is `area`. Where an area answers
    strongly, going on from what follows would swing between two values for ever.
    """
    before, last = (area, area), math.inf
    for attempt in range(200):
        new = following(area)
        step = new - area
        off = float(np.abs(step / area).max())
        # At the rounding of the network's voltages steps grow no smaller. NaN and inf are for the caller to refuse.
        if off <= 1e-14 or last <= off < (1e-12 if attempt < 100 else 1e-9) or not math.isfinite(off):
            return new
        share = np.ones(area.size)
        if attempt:
            with np.errstate(divide="ignore", invalid="ignore"):
                share = (before[0] - area) / (step - before[1])
            share = np.where(share > 0.0, np.minimum(np.maximum(share, 1e-3), 4.0), 1.0)
        before, last, area = (area, step), off, np.maximum(area + share * step, 0.1 * new)
    raise InputError("the phasor's areas do not settle; allowed: area='frozen' or an area in m^2")
