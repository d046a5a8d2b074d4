"""Dense algebra on matrices of a few rows, and copies of arrays, compiled; and central differences.

LAPACK through numba would cost a fifth of a second at start-up to load, for matrices of ten rows.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fingerspice.base.arrays import ComplexArray, FloatArray
from fingerspice.base.compiled import jit


@jit
def copy_to(out: FloatArray, x: FloatArray) -> None:
    """out = x, of the same shape.

    For `out[:] = x` numba compiles the text of an error about unlike shapes, which takes as long as a whole loop.
    """
    for i in range(x.size):
        out.flat[i] = x.flat[i]


@jit
def invert(matrix: FloatArray | ComplexArray) -> bool:
    """Invert a matrix (n, n) in place by Gauss-Jordan elimination with row pivoting; False where it is singular."""
    n = matrix.shape[0]
    order = np.arange(n)
    for column in range(n):
        pivot = column
        for row in range(column + 1, n):
            if abs(matrix[row, column]) > abs(matrix[pivot, column]):
                pivot = row
        size = abs(matrix[pivot, column])
        if not 0.0 < size < np.inf:
            return False
        order[column], order[pivot] = order[pivot], order[column]
        for j in range(n):
            matrix[column, j], matrix[pivot, j] = matrix[pivot, j], matrix[column, j]
        scale = 1.0 / matrix[column, column]
        matrix[column, column] = 1.0
        for j in range(n):
            matrix[column, j] *= scale
        for row in range(n):
            factor = matrix[row, column]
            if row != column and factor != 0.0:
                matrix[row, column] = 0.0
                for j in range(n):
                    matrix[row, j] -= factor * matrix[column, j]
    swapped = np.empty(n, matrix.dtype)
    for row in range(n):
        for j in range(n):
            swapped[order[j]] = matrix[row, j]
        for j in range(n):
            matrix[row, j] = swapped[j]
    return True


@jit
def diagonalise(matrix: FloatArray, vectors: FloatArray) -> None:
    """Eigenvalues of a symmetric matrix (n, n) onto its diagonal, eigenvectors into the columns of `vectors` (n, n).

    By Jacobi's cyclic rotations, which keep small eigenvalues to their own rounding (Golub and Van Loan, section 8.5).
    """
    n = matrix.shape[0]
    for p in range(n):
        for q in range(n):
            vectors[p, q] = 1.0 if p == q else 0.0
    for _ in range(60):
        rotated = False
        for p in range(n - 1):
            for q in range(p + 1, n):
                x = matrix[p, q]
                if abs(x) <= 1e-17 * np.sqrt(abs(matrix[p, p] * matrix[q, q])) or abs(x) < 1e-300:
                    continue
                rotated = True
                ratio = 0.5 * (matrix[q, q] - matrix[p, p]) / x
                t = 1.0 / (abs(ratio) + np.sqrt(1.0 + ratio * ratio))
                if ratio < 0.0:
                    t = -t
                c = 1.0 / np.sqrt(1.0 + t * t)
                s = t * c
                matrix[p, p] -= t * x
                matrix[q, q] += t * x
                matrix[p, q] = matrix[q, p] = 0.0
                for k in range(n):
                    if k not in (p, q):
                        a, b = matrix[k, p], matrix[k, q]
                        matrix[k, p] = matrix[p, k] = c * a - s * b
                        matrix[k, q] = matrix[q, k] = s * a + c * b
                    a, b = vectors[k, p], vectors[k, q]
                    vectors[k, p] = c * a - s * b
                    vectors[k, q] = s * a + c * b
        if not rotated:
            return


AT = (-2.0, -1.0, 1.0, 2.0)
"""Where a function is evaluated, in steps."""
STEP = 3e-4
"""Step relative to the argument, or to its scale, at which truncation and rounding are both about 1e-12."""
_WEIGHTS = (1.0 / 12.0, -8.0 / 12.0, 8.0 / 12.0, -1.0 / 12.0)


def derivative(values: Sequence[FloatArray | float], step: float) -> FloatArray:
    """Derivative from the values at `AT` times a step."""
    total = sum(weight * np.asarray(one, float) for weight, one in zip(_WEIGHTS, values, strict=True))
    return np.asarray(total / step)
