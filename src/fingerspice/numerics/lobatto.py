"""Collocation at Gauss-Lobatto points against an exact exponential: nodes, bases and tables, compiled.

On a step of length h a mode w' = -rate w + g(t) has, with g interpolated at the nodes, the exact solution

    w(c_i h) = exp(-rate c_i h) w(0) + h sum_j phi_ij g(c_j h),
    phi_ij = integral over [0, c_i] of exp(-rate h (c_i - s)) l_j(s) ds

(Hochbruck and Ostermann 2010, exponential Runge-Kutta methods of collocation type). Three points between the nodes
are rows of the tables too: what a solution misses there is its error.

The sizes are constants, so that the compiler unrolls every inner loop.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from numpy.polynomial import chebyshev, legendre
from numpy.typing import NDArray

from fingerspice.base.compiled import jit_fused

FloatArray = NDArray[np.float64]

NODES = 13
ROWS = 16
"""The nodes, ascending from 0 to 1, and three points between them."""
FIRST, SECOND, THIRD, END = NODES, NODES + 1, NODES + 2, NODES - 1
"""Rows of the points between, and of the end of the step."""


def _nodes() -> FloatArray:
    inner = legendre.Legendre.basis(NODES - 1).deriv().roots()
    x = np.concatenate([[-1.0], np.sort(inner.real), [1.0]])
    return np.asarray(0.5 * (0.5 * (x - x[::-1]) + 1.0))


def _lagrange(at: FloatArray, nodes: FloatArray, weights: FloatArray) -> FloatArray:
    """Basis polynomials (n_at, n) at points off the nodes."""
    q = weights / (at[:, None] - nodes)
    return np.asarray(q / q.sum(axis=1, keepdims=True))


_X = _nodes()
BARYCENTRIC = 1.0 / np.array([np.prod(4.0 * (x - np.delete(_X, i))) for i, x in enumerate(_X)])
"""Barycentric weights of the nodes (times a constant), shape (NODES,)."""
# Midway between neighbours: first of all, where a fast mode's decay after an edge or zero would hide, and at two more
# distances from the middle, so that no error of the next few orders is small at all.
_BETWEEN = np.array([0.5 * (_X[i] + _X[i + 1]) for i in (0, 5, 9)])
POINTS = np.concatenate([_X, _BETWEEN])
"""Fractions of the step, shape (ROWS,)."""
BETWEEN = np.ascontiguousarray(_lagrange(_BETWEEN, _X, BARYCENTRIC).T)
"""Interpolation from the nodes to the points between, shape (NODES, 3)."""
_SCALE = float(np.abs(np.prod(_BETWEEN[:, None] - _X, axis=1)).max())
MISS = np.prod(_BETWEEN[:, None] - _X, axis=1) / _SCALE
"""The node polynomial, of largest size 1, at the points between, shape (3,)."""
TO_SERIES = np.zeros((NODES, ROWS))
"""From values at the nodes to Chebyshev coefficients, shape (NODES, ROWS): coefficients = values @ TO_SERIES.

The last columns are zero, for loops over whole vectors."""
TO_SERIES[:, :NODES] = np.linalg.inv(chebyshev.chebvander(2.0 * _X - 1.0, NODES - 1)).T
_GAUSS_X, _GAUSS_W = legendre.leggauss(32)
_GAUSS_X, _GAUSS_W = 0.5 * (_GAUSS_X + 1.0), 0.5 * _GAUSS_W
# exp(-45) of the largest value is below rounding.
_REACH = 45.0
_END_WEIGHT = _GAUSS_W * np.exp(-_REACH * _GAUSS_X)
_INVERSE_SCALE = 1.0 / _SCALE


# Where Gauss's rule over [0, c_i] stands: basis polynomials, shape (ROWS, 32, NODES), and the node polynomial.
_AT = POINTS[:, None] * (1.0 - _GAUSS_X)
_OFF = _AT[:, :, None] - _X
# The node at 0 and 1 is no Gauss point; only the row of c = 0, which has no integral, meets one.
_OFF[_OFF == 0.0] = 1e-300
_BASIS = BARYCENTRIC / _OFF
_BASIS = np.ascontiguousarray(_BASIS / _BASIS.sum(axis=2, keepdims=True))
_PRODUCT = np.prod(_OFF, axis=2) / _SCALE


@jit_fused
def fill_table(z: float, decay: FloatArray, phi: FloatArray, miss: FloatArray) -> None:
    """Tables of one mode for z = rate * h >= 0, in units of h.

    Fills `decay` (ROWS,), exp(-z c_i); `phi` (NODES, ROWS); and `miss` (ROWS,), the response to a forcing that is
    the node polynomial, of largest size 1.
    """
    basis = np.empty(NODES)
    sums = np.empty(NODES)
    for i in range(ROWS):
        x = z * POINTS[i]
        # Denormal numbers would slow every later product down.
        decay[i] = math.exp(-x) if x < 690.0 else 0.0
        for j in range(NODES):
            sums[j] = 0.0
        missed = 0.0
        if x > _REACH:
            # All that counts of exp(-z (c_i - s)) is close to the end.
            reach = _REACH / z
            for g in range(_GAUSS_X.size):
                s = POINTS[i] - reach * _GAUSS_X[g]
                total = 0.0
                product = _INVERSE_SCALE
                for j in range(NODES):
                    distance = s - POINTS[j]
                    product *= distance
                    basis[j] = BARYCENTRIC[j] / distance if distance != 0.0 else 1e300
                    total += basis[j]
                weight = reach * _END_WEIGHT[g]
                share = weight / total
                for j in range(NODES):
                    sums[j] += share * basis[j]
                missed += weight * product
        elif i > 0:
            for g in range(_GAUSS_X.size):
                weight = POINTS[i] * _GAUSS_W[g] * math.exp(-x * _GAUSS_X[g])
                for j in range(NODES):
                    sums[j] += weight * _BASIS[i, g, j]
                missed += weight * _PRODUCT[i, g]
        miss[i] = missed
        for j in range(NODES):
            phi[j, i] = sums[j]


@lru_cache(maxsize=1)
def integral_table() -> FloatArray:
    """`phi` of a mode with rate zero: integrals over [0, c_i] of the interpolant, shape (NODES, ROWS)."""
    phi = np.empty((NODES, ROWS))
    fill_table(0.0, np.empty(ROWS), phi, np.empty(ROWS))
    return phi
