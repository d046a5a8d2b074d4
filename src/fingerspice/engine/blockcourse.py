"""State of the loops over blocks of a recording, and 1/A with its slope at single voltages."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fingerspice.base.arrays import FloatArray
from fingerspice.base.compiled import jit
from fingerspice.engine.blockforms import BLOCK, Form, Room, Shown
from fingerspice.engine.model import Model


class Charges(NamedTuple):
    """Rows of a block for the charge."""

    q: FloatArray  # (4, n): 1/A at the ends of the steps and at `PLACES`, 1/m^2
    # (7, n): Rate of the charge at 0, 1/4, 1/2, 3/4 and 1 of each step (A), the charge gained in the step, and its
    # error (C)
    steps: FloatArray
    # z, current, error (n,): Charge (C) and current (A) at the starts of the steps, and error of the slowest layer's
    # voltage (V)
    z: FloatArray
    current: FloatArray
    error: FloatArray
    # h, t (n,): Lengths of the steps, and their limits, s; the limits are needed for outputs within steps only
    h: FloatArray
    t: FloatArray


class Course(NamedTuple):
    """State and scratch arrays of the loop along a recording.

    `w` (m,) are the modes, and the rows of `error` (2, m) the parts of their error that quadrature and sweeps leave;
    `spare` (3, n) is scratch for single outputs; `engine.blockforms` lists the entries of `control`, `counters` and
    `checks` (LEVELS, N_CHECKS).
    """

    model: Model
    form: Form
    shown: Shown
    room: Room
    charges: Charges
    spare: FloatArray
    w: FloatArray
    error: FloatArray
    control: FloatArray
    counters: NDArray[np.int64]
    checks: FloatArray


def new_charges() -> Charges:
    """Rows for one block, all zero."""
    n = BLOCK + 8
    return Charges(np.zeros((4, n)), np.zeros((7, n)), *np.zeros((5, n)))


@jit
def inverse_area_at(form: Form, u: float) -> tuple[float, float]:
    """1/A and its derivative with respect to the gap voltage, from the polynomial that the blocks use."""
    x = abs(u) * form.scale + form.shift
    q, slope = 0.0, 0.0
    for j in range(form.area.size - 1, -1, -1):
        slope = slope * x + q
        q = q * x + form.area[j]
    return q, (slope if u >= 0.0 else -slope) * form.scale
