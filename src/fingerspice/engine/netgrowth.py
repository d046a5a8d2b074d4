"""How the error of a network's run is carried through a step, with what the areas answer to it.

As `fingerspice.engine.growth`, of which see; but by differences: the currents that the areas move are evaluated at
modes that are off by the error, and answer as those of the step itself do, a few times over.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fingerspice.base.compiled import jit
from fingerspice.engine.coupling import Coupling
from fingerspice.engine.exponential import respond
from fingerspice.engine.netrows import CHI_S, ETA_S, LIN, PULL, U_S, Form, W, Work, evaluate
from fingerspice.numerics.lobatto import END, NODES, ROWS

FloatArray = NDArray[np.float64]

# What the modes are moved by, over the largest; half of the digits for the difference.
_SHIFT = 1e-7
# Answers to answers that are reckoned, at most, and the change from which on the next one matters.
_PASSES, _ENOUGH = 6, 0.1


@jit
def carry(
    form: Form, work: Work, several: bool, h: float, rates: FloatArray, pace: FloatArray, coupling: Coupling,
    decay: FloatArray, phi: FloatArray, error: FloatArray, sign: FloatArray,
) -> None:  # fmt: skip
    """The error of the modes (m,) at the start of a converged step at the points between and the end: `work.carried`.

    Uses `work.spare`, `matrix`, `mixed` and one row of `room`, and leaves all else of the step as it is.
    """
    base, forced, off, shifted, d, pull = work.spare
    modes, cells, areas = work.modes, work.spare_cells, work.spare_areas
    largest = 0.0
    size = 0.0
    for k in range(error.size):
        largest = max(largest, abs(error[k]))
        for i in range(ROWS):
            base[k, i] = decay[k, i] * error[k]
            off[k, i] = base[k, i]
            size = max(size, abs(modes[W, k, i]))
    step = _SHIFT * size / largest if largest > 0.0 else 0.0
    if 0.0 < step < math.inf:
        for part in (ETA_S, CHI_S):
            cells[part] = work.cells[part]
        areas[U_S] = work.areas[U_S]
        for _ in range(_PASSES):
            before = 0.0
            for k in range(error.size):
                before = max(before, abs(off[k, END]))
                for i in range(ROWS):
                    shifted[k, i] = modes[W, k, i] + step * off[k, i]
            if not evaluate(
                form.mobile, several, h, rates, coupling, form.home, form.first, form.cell, form.area0, form.unit,
                form.slow, pace, form.gap, form.powers, form.slopes, form.lo, form.scale, form.curves, sign, shifted,
                modes[LIN], d, pull, cells, areas, work.matrix, work.mixed, work.room[1],
            ):  # fmt: skip
                break
            for k in range(error.size):
                for i in range(ROWS):
                    forced[k, i] = (pull[k, i] - modes[PULL, k, i]) / step
                    shifted[k, i] = off[k, i]
            respond(forced, phi, base, off)
            moved = 0.0
            for k in range(error.size):
                moved = max(moved, abs(off[k, END] - shifted[k, END]))
            if not moved > _ENOUGH * before:
                break
    for k in range(error.size):
        for p in range(3):
            work.carried[k, p] = off[k, NODES + p]
        work.carried[k, 3] = off[k, END]
