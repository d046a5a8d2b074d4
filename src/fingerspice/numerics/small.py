"""Dense algebra on matrices of a few rows, compiled.

LAPACK through numba would cost a fifth of a second at start-up to load, for matrices of ten rows.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fingerspice.compiled import jit

FloatArray = NDArray[np.float64]


@jit
def inverse(matrix: FloatArray) -> FloatArray:
    """Inverse of a square matrix (n, n) by Gauss-Jordan elimination with row pivoting; NaN where it is singular."""
    n = matrix.shape[0]
    a = matrix.copy()
    out = np.eye(n)
    for column in range(n):
        pivot = column
        for row in range(column + 1, n):
            if abs(a[row, column]) > abs(a[pivot, column]):
                pivot = row
        size = abs(a[pivot, column])
        if not 0.0 < size < np.inf:
            return np.full((n, n), np.nan)
        for j in range(n):
            a[column, j], a[pivot, j] = a[pivot, j], a[column, j]
            out[column, j], out[pivot, j] = out[pivot, j], out[column, j]
        scale = 1.0 / a[column, column]
        for j in range(n):
            a[column, j] *= scale
            out[column, j] *= scale
        for row in range(n):
            factor = a[row, column]
            if row != column and factor != 0.0:
                for j in range(n):
                    a[row, j] -= factor * a[column, j]
                    out[row, j] -= factor * out[column, j]
    return out
