"""How the error of a network's run is carried through a step, with what the areas answer to it.

The method is that of `fingerspice.engine.growth`, but with differences: the currents that the areas cause are evaluated
once more at modes shifted by the error, and the response to their change is iterated a few times.
"""

from __future__ import annotations

import math

from fingerspice.base.arrays import FloatArray
from fingerspice.base.compiled import jit_rows, jit_within
from fingerspice.engine.exponential import Tables, respond
from fingerspice.engine.netform import CHI_S, ETA_S, PULL, RHO, U_S, Form, Leaks, W, Work
from fingerspice.engine.netrows import evaluate
from fingerspice.engine.readout import N_PLACES
from fingerspice.numerics.lobatto import END, NODES, ROWS
from fingerspice.numerics.small import copy_to

# Shift of the modes for the difference, over the largest mode: half of the digits are left for the difference.
_SHIFT = 1e-7
# Answer of the areas up to which it is neglected: the error carried changes by at most 6 times as much of itself.
_SLIGHT = 0.01
# Most iterations, and the relative change below which the next iteration does not matter.
_PASSES, _ENOUGH = 6, 0.1


@jit_rows
def _shift(w: FloatArray, step: float, off: FloatArray, out: FloatArray) -> None:
    for k in range(out.shape[0]):
        for i in range(ROWS):
            out[k, i] = w[k, i] + step * off[k, i]


@jit_rows
def _difference(a: FloatArray, b: FloatArray, factor: float, out: FloatArray) -> None:
    for k in range(out.shape[0]):
        for i in range(ROWS):
            out[k, i] = factor * (a[k, i] - b[k, i])


@jit_within
def carry(
    form: Form, work: Work, leaks: Leaks, tables: Tables, slot: int, several: bool, h: float, error: FloatArray,
    sign: FloatArray, answer: float,
) -> None:  # fmt: skip
    """Carry the error of the modes (m,) from the start of a converged step to the points between and the end.

    The result is `work.carried`. `answer` is how strongly the areas answered to the last change of the modes (see
    `solve_step`): where they hardly do, the error decays with the modes. `work.spare`, `matrix`, `mixed` and one row of
    `room` are overwritten, nothing else.
    """
    base, forced, off, shifted, d, pull = work.spare
    decay, phi = tables.decay[slot], tables.phi[slot]
    if answer <= _SLIGHT:
        for k in range(error.size):
            for p in range(N_PLACES - 1):
                work.carried[k, p] = decay[k, NODES + p if p < N_PLACES - 2 else END] * error[k]
        return
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
        for part in (ETA_S, CHI_S, RHO):
            copy_to(cells[part], work.cells[part])
        copy_to(areas[U_S], work.areas[U_S])
        for _ in range(_PASSES):
            before = 0.0
            for k in range(error.size):
                before = max(before, abs(off[k, END]))
            _shift(modes[W], step, off, shifted)
            if not evaluate(
                form, work, leaks, several, h, sign, shifted, d, pull, cells, areas, work.room[1]
            ):  # fmt: skip
                break
            _difference(pull, modes[PULL], 1.0 / step, forced)
            moved = 0.0
            for k in range(error.size):
                shifted[k, 0] = off[k, END]
            respond(forced, phi, base, off)
            for k in range(error.size):
                moved = max(moved, abs(off[k, END] - shifted[k, 0]))
            if not moved > _ENOUGH * before:
                break
    for k in range(error.size):
        for p in range(3):
            work.carried[k, p] = off[k, NODES + p]
        work.carried[k, 3] = off[k, END]
