"""Modes of relaxation elements that share one constraint, and dense algebra on matrices of a few rows, compiled.

LAPACK through numba would cost a fifth of a second at start-up to load, for matrices of ten rows.

Modes are found by their secular equation. Elements x' = -h + k sum(h), h_l = r_l (x_l + k_l U), with sum(k) = 1 and
sum(x) = 0, have as rates the roots of

    sum_l k_l / (r_l - rate) = 0,

one between any two neighbouring r. Every difference r_l - rate is kept to full relative precision (as divide and
conquer eigensolvers do: Gu and Eisenstat 1995), so rates twelve decades apart do not spoil each other.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

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
def apply(matrix: FloatArray, x: FloatArray, out: FloatArray) -> None:
    """out = matrix @ x, of the first entries of both."""
    for k in range(matrix.shape[0]):
        total = 0.0
        for i in range(matrix.shape[1]):
            total += matrix[k, i] * x[i]
        out[k] = total


@jit
def solve(matrix: FloatArray | ComplexArray, x: FloatArray | ComplexArray) -> float:
    """matrix^-1 x into x (n, m) by elimination with row pivoting; `matrix` (n, n) is used up.

    Returns the sign of the determinant of a real matrix; 0 where one, real or complex, is singular.
    """
    n, sign = matrix.shape[0], 1.0
    for column in range(n):
        pivot = column
        for row in range(column + 1, n):
            if abs(matrix[row, column]) > abs(matrix[pivot, column]):
                pivot = row
        if pivot != column:
            sign = -sign
            for k in range(x.shape[1]):
                x[column, k], x[pivot, k] = x[pivot, k], x[column, k]
            for j in range(column, n):
                matrix[column, j], matrix[pivot, j] = matrix[pivot, j], matrix[column, j]
        if not 0.0 < abs(matrix[column, column]) < np.inf:
            return 0.0
        if matrix[column, column].real < 0.0:
            sign = -sign
        for row in range(column + 1, n):
            factor = matrix[row, column] / matrix[column, column]
            if factor != 0.0:
                for j in range(column + 1, n):
                    matrix[row, j] -= factor * matrix[column, j]
                for k in range(x.shape[1]):
                    x[row, k] -= factor * x[column, k]
    for row in range(n - 1, -1, -1):
        for j in range(row + 1, n):
            for k in range(x.shape[1]):
                x[row, k] -= matrix[row, j] * x[j, k]
        for k in range(x.shape[1]):
            x[row, k] /= matrix[row, row]
    return sign


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


@jit
def _root_between(r: FloatArray, k: FloatArray, i: int) -> tuple[int, float]:
    """Root between the ascending poles r[i] < r[i + 1], as the index of the nearer pole and the distance from it."""
    gap = r[i + 1] - r[i]
    middle = 0.0
    for j in range(r.size):
        middle += k[j] / (r[j] - r[i] - 0.5 * gap)
    # The function rises from -inf to inf between the poles: its sign in the middle names the nearer one.
    origin = i if middle >= 0.0 else i + 1
    lo = 0.0 if middle >= 0.0 else -0.5 * gap
    hi = 0.5 * gap if middle >= 0.0 else 0.0
    # Start from the two neighbouring poles alone, then Newton inside a bracket that only closes.
    share = k[i] / (k[i] + k[i + 1])
    x = share * gap if middle >= 0.0 else (share - 1.0) * gap
    for _ in range(200):
        if not lo < x < hi:
            x = 0.5 * (lo + hi)
        value = 0.0
        slope = 0.0
        for j in range(r.size):
            term = 1.0 / (r[j] - r[origin] - x)
            value += k[j] * term
            slope += k[j] * term * term
        if value >= 0.0:
            hi = x
        else:
            lo = x
        # Newton on x * value, which has no pole at x = 0.
        turn = value + x * slope
        step = -x * value / turn if turn != 0.0 else math.inf
        if abs(step) <= 2e-16 * abs(x) or hi - lo <= 2e-16 * max(abs(lo), abs(hi)):
            break
        x += step
    return origin, x


@jit
def _ascending(r: FloatArray, order: NDArray[np.int64]) -> None:
    """Write the indices that put the few rates in ascending order; equal ones stay in theirs."""
    for i in range(r.size):
        place = i
        while place > 0 and r[order[place - 1]] > r[i]:
            order[place] = order[place - 1]
            place -= 1
        order[place] = i


@jit
def modes(r: FloatArray, k: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Modal form of x' = -h + k sum(h) + (-p + k sum(p)).

    Of r (1/s, >= 0) and k (> 0, of sum 1), both (n + 1,). Returns `rates` and `gain` (n,), `feed` and `shape` (n + 1,
    n): w' = -rates w + gain U + p @ feed, and x = shape @ w.
    """
    n = r.size - 1
    rates, gain, feed, shape = np.empty(n), np.empty(n), np.empty((n + 1, n)), np.empty((n + 1, n))
    write_modes(r, k, (rates, gain, feed, shape), np.empty((2, n + 1)), np.empty((2, n + 1), np.int64))
    return rates, gain, feed, shape


@jit
def write_modes(
    r: FloatArray, k: FloatArray, found: tuple[FloatArray, FloatArray, FloatArray, FloatArray], floats: FloatArray,
    whole: NDArray[np.int64],
) -> None:  # fmt: skip
    """As `modes`, into given arrays; `floats` and `whole`, of shape (2, n + 1), are overwritten."""
    n = r.size - 1
    rates, gain, feed, shape = found
    gain[:] = 0.0
    shape[:] = 0.0
    # Equal rates act as one element on the rest; between themselves they relax with that very rate.
    poles, shares = floats[0], floats[1]
    order, group = whole[0], whole[1]
    _ascending(r, order)
    count = 0
    at = 0
    for m in range(n + 1):
        i = order[m]
        if count > 0 and r[i] <= poles[count - 1] * (1.0 + 4e-16):
            share = shares[count - 1]
            # Mode of this element against the group so far, orthogonal in 1/k.
            for place in range(m):
                j = order[place]
                if group[j] == count - 1:
                    shape[j, at] = k[j] / share
            shape[i, at] = -1.0
            norm = 1.0 / share + 1.0 / k[i]
            for j in range(n + 1):
                feed[j, at] = -shape[j, at] / k[j] / norm
            rates[at] = r[i]
            at += 1
            shares[count - 1] += k[i]
        else:
            poles[count] = r[i]
            shares[count] = k[i]
            count += 1
        group[i] = count - 1
    poles = poles[:count]
    shares = shares[:count]
    for i in range(count - 1):
        origin, x = _root_between(poles, shares, i)
        rates[at] = poles[origin] + x
        norm = 0.0
        for g in range(count):
            norm += shares[g] / (poles[g] - poles[origin] - x) ** 2
        gain[at] = -1.0 / norm
        for j in range(n + 1):
            inverse = 1.0 / (poles[group[j]] - poles[origin] - x)
            shape[j, at] = k[j] * inverse
            feed[j, at] = -inverse / norm
        at += 1
