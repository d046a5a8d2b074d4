"""Outputs of a stack that does not leak, whose voltages follow the source without delay."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fingerspice.base.arrays import FloatArray
from fingerspice.base.compiled import jit
from fingerspice.engine.model import Model, choose_branch, dot, jump_charge, write_row
from fingerspice.engine.segment import Segment, source


@jit
def source_at(
    edges: FloatArray, terms: FloatArray, series: FloatArray, t: FloatArray, left: NDArray[np.bool_]
) -> tuple[FloatArray, FloatArray]:
    """Source voltage (V) and slope (V/s) at times t (ascending, inside the edges), shape (n,) each."""
    u = np.empty(t.size)
    slope = np.empty(t.size)
    index = 0
    for i in range(t.size):
        while index < edges.size - 2 and (t[i] > edges[index + 1] or (t[i] == edges[index + 1] and not left[i])):
            index += 1
        segment = Segment(edges[index], edges[index + 1] - edges[index], terms[index], series[index])
        u[i], slope[i] = source(segment, t[i] - edges[index])
    return u, slope


@jit
def follow(model: Model, u: FloatArray, slope: FloatArray, y: FloatArray, u_before: float, rows: FloatArray) -> float:
    """Fill `rows` (see `write_row`) for source voltages u and slopes, from state y at source voltage `u_before`.

    The charge that flows between two source voltages depends on these two alone, not on the path between them, so that
    each row is computed from `u_before`. Returns the largest error of the charge, C.
    """
    here = y.copy()
    worst = 0.0
    for i in range(u.size):
        if not model.mobile:
            moved, error = jump_charge(model, dot(model.gap, y), u_before, u[i])
            here[-1] = y[-1] + moved
            worst = max(worst, error)
        sign = choose_branch(model, u[i], here)
        write_row(model, u[i], slope[i], here, sign, model.k_gap * u[i], rows[i])
    return worst
