"""Arrays that exponential steps of a stack work in, made once."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fingerspice.base.arrays import FloatArray
from fingerspice.engine.readout import N_PLACES, WRITTEN_AT_ONCE
from fingerspice.numerics.lobatto import NODES, ROWS

# Rows of `Work.r`: source (V) and its slope (V/s), k_gap U, gap voltage and its guess (V), gap w, 1/A (1/m^2), its
# slope by the gap voltage, and two rows of scratch.
SOURCE, SLOPE, FREE, U, GUESS, X_GAP, Q, DQ, SCRATCH, MORE = range(10)
N_FLAT = 10


class Work(NamedTuple):
    """Arrays that a stack's steps work in; those with ROWS behind hold one value for each row of a step.

    Attributes
    ----------
    r : ndarray, shape (N_FLAT, ROWS)
        See above.
    base, w, pull, used, pull_before, left_before : ndarray, shape (n, ROWS)
        The modes without and with the nonlinear term, this term at them and as it was used for them, and both of the
        iteration before (see `exponential.converge`).
    w0, weight : ndarray, shape (n,)
        The modes at the start of the step; effect of each on the gap voltage (see `exponential.weigh`).
    places, carried : ndarray, shape (n, N_PLACES) and (n, N_PLACES - 1)
        Errors of the modes, and those carried over from earlier steps.
    values, coefficients : ndarray, shape (n + 2, ROWS)
        Output columns and their Chebyshev coefficients.
    tapped : ndarray, shape (n + 1, ROWS)
        Leaks that do not scale with the area.
    outputs, sums, basis : ndarray
        Scratch.
    """

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
