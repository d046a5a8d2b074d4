"""Arrays that exponential steps of a stack work in, made once."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fingerspice.base.arrays import FloatArray
from fingerspice.engine.exponential import N_PLACES
from fingerspice.engine.readout import WRITTEN_AT_ONCE
from fingerspice.engine.rows import N_FLAT
from fingerspice.numerics.lobatto import NODES, ROWS


class Work(NamedTuple):
    """Arrays that steps work in: those of `fingerspice.engine.rows`, and the loop's own."""

    r: FloatArray
    base: FloatArray
    w: FloatArray
    pull: FloatArray
    used: FloatArray
    pull_before: FloatArray
    left_before: FloatArray
    w0: FloatArray
    places: FloatArray
    carried: FloatArray
    values: FloatArray
    coefficients: FloatArray
    outputs: FloatArray
    sums: FloatArray
    weight: FloatArray
    basis: FloatArray
    tapped: FloatArray


def new_work(n: int) -> Work:
    """Work arrays for n modes."""
    return Work(
        np.zeros((N_FLAT, ROWS)),
        np.zeros((n, ROWS)),
        np.zeros((n, ROWS)),
        np.zeros((n, ROWS)),
        np.zeros((n, ROWS)),
        np.zeros((n, ROWS)),
        np.zeros((n, ROWS)),
        np.zeros(n),
        np.zeros((n, N_PLACES)),
        np.zeros((n, N_PLACES - 1)),
        np.zeros((n + 2, ROWS)),
        np.zeros((n + 2, ROWS)),
        np.zeros((2, WRITTEN_AT_ONCE)),
        np.zeros((4, 4)),
        np.zeros(n),
        np.zeros(NODES),
        np.zeros((n + 1, ROWS)),
    )
