"""Collocation at Gauss-Lobatto points against an exact exponential: nodes, bases and tables, compiled; and Radau IIA of
any number of stages (Hairer and Wanner, Solving Ordinary Differential Equations II, 1996, IV.5).

On a step of length h a mode w' = -rate w + g(t) has, with g interpolated at the nodes, the exact solution

    w(c_i h) = exp(-rate c_i h) w(0) + h sum_j phi_ij g(c_j h),
    phi_ij = integral over [0, c_i] of exp(-rate h (c_i - s)) l_j(s) ds

(Hochbruck and Ostermann 2010, exponential Runge-Kutta methods of collocation type). Three points between the nodes
are rows of the tables, too: the difference between solution and interpolant there is the error.

The sizes are constants, so that the compiler unrolls every inner loop.
"""

from __future__ import annotations

import math
from fractions import Fraction
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.polynomial import chebyshev, legendre

from fingerspice.base.arrays import ComplexArray, FloatArray
from fingerspice.base.compiled import jit, jit_fused, jit_rows

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
LOBES = np.hstack([-BETWEEN.T, np.eye(3)])
"""From values at the rows to those at the points between less the interpolated ones, shape (3, ROWS)."""
DERIVATIVE = np.zeros((NODES, NODES))
"""Differentiation matrix: slope at each node, per step length, of the polynomial through values at the nodes."""
for _i in range(NODES):
    for _j in set(range(NODES)) - {_i}:
        DERIVATIVE[_i, _j] = BARYCENTRIC[_j] / BARYCENTRIC[_i] / (_X[_i] - _X[_j])
    DERIVATIVE[_i, _i] = -DERIVATIVE[_i].sum()
TO_SLOPES = np.ascontiguousarray(np.vstack([DERIVATIVE, BETWEEN.T @ DERIVATIVE]).T)
"""From values at the nodes to slopes at all rows, per step length, shape (NODES, ROWS): slopes = values @ TO_SLOPES."""
_SCALE = float(np.abs(np.prod(_BETWEEN[:, None] - _X, axis=1)).max())
MISS = np.prod(_BETWEEN[:, None] - _X, axis=1) / _SCALE
"""The node polynomial, of largest size 1, at the points between, shape (3,)."""
TO_SERIES = np.zeros((NODES, ROWS))
"""From values at the nodes to Chebyshev coefficients, shape (NODES, ROWS): coefficients = values @ TO_SERIES.

The last columns are zero, for loops over whole vectors."""
TO_SERIES[:, :NODES] = np.linalg.inv(chebyshev.chebvander(2.0 * _X - 1.0, NODES - 1)).T
# For z below this, by Gauss's rule from each node to the next; from it on by integration by parts. Both are right to a
# few roundings on their sides of it, and far beyond.
_LATE = 60.0
_GAUSS = 12
_GAUSS_X, _GAUSS_W = (0.5 * x for x in legendre.leggauss(_GAUSS))
_GAUSS_X = _GAUSS_X + 0.5
# The row from which each row is continued, and the distance; these distances without repetitions.
_FROM = np.array([0, *range(NODES - 1), 0, 5, 9])
_LENGTH = POINTS - POINTS[_FROM]
_LENGTHS, _KIND = np.unique(_LENGTH.round(14), return_inverse=True)
_LENGTHS = np.array([_LENGTH[kind == _KIND].mean() for kind in range(_LENGTHS.size)])
# At Gauss's points: basis polynomials, shape (ROWS, _GAUSS, NODES), and the node polynomial.
_OFF = (POINTS[:, None] - _LENGTH[:, None] * (1.0 - _GAUSS_X))[:, :, None] - _X
# The first row has the distance 0, and its point is a node.
_OFF[_OFF == 0.0] = 1e-300
_BASIS = BARYCENTRIC / _OFF
_BASIS = np.ascontiguousarray(_BASIS / _BASIS.sum(axis=2, keepdims=True))
_PRODUCT = np.prod(_OFF, axis=2) / _SCALE


def _derivatives() -> tuple[FloatArray, FloatArray]:
    """Derivatives of the basis polynomials, shape (NODES, NODES, ROWS), and of the node polynomial, at the rows."""
    away = POINTS[:, None].astype(np.longdouble) - _X
    own = np.zeros((ROWS, NODES + 1, NODES + 1), np.longdouble)
    own[:, :, 0] = 1.0
    for m in range(NODES):
        times = own * away[:, m, None, None]
        times[:, :, 1:] += own[:, :, :-1]
        # The last of them is the node polynomial, with every factor; each other one lacks its own.
        times[:, m] = own[:, m]
        own = times
    own *= np.cumprod([1, *range(1, NODES + 1)]).astype(np.longdouble)
    between = [np.prod((x - np.delete(_X, j)).astype(np.longdouble)) for j, x in enumerate(_X)]
    basis = own[:, :NODES, :NODES] / np.array(between)[None, :, None]
    return np.ascontiguousarray(basis.T, float), np.ascontiguousarray(own[:, NODES].T / _SCALE, float)


# At the rows, by order: shape (NODES, NODES, ROWS) and (NODES + 1, ROWS).
_SLOPES, _PRODUCT_SLOPES = _derivatives()
_LARGEST = np.abs(_SLOPES).max(axis=(1, 2))


@jit_fused
def _fill_early(z: float, phi: FloatArray, miss: FloatArray) -> None:
    """`phi` and `miss` from row to row: the integral up to the last row decays, and the integral since is added."""
    fades = np.empty(_LENGTHS.size)
    weights = np.empty((_LENGTHS.size, _GAUSS))
    for kind in range(_LENGTHS.size):
        length = _LENGTHS[kind]
        fades[kind] = math.exp(-z * length)
        for g in range(_GAUSS):
            weights[kind, g] = length * _GAUSS_W[g] * math.exp(-z * length * (1.0 - _GAUSS_X[g]))
    for i in range(ROWS):
        kind, last = _KIND[i], _FROM[i]
        for j in range(NODES):
            phi[j, i] = fades[kind] * phi[j, last] if i > 0 else 0.0
        miss[i] = fades[kind] * miss[last] if i > 0 else 0.0
        if i > 0:
            for g in range(_GAUSS):
                weight = weights[kind, g]
                for j in range(NODES):
                    phi[j, i] += weight * _BASIS[i, g, j]
                miss[i] += weight * _PRODUCT[i, g]


@jit_fused
def _fill_late(z: float, decay: FloatArray, phi: FloatArray, miss: FloatArray) -> None:
    """The same by parts, with l the polynomial: l / z - l' / z^2 + ... at c_i, less as much at 0 that has decayed."""
    last = NODES - 1
    while last > 0 and _LARGEST[last] < 1e-18 * z**last:
        last -= 1
    q = 1.0 / z
    for j in range(NODES):
        for i in range(ROWS):
            phi[j, i] = _SLOPES[last, j, i] * q
    for k in range(last - 1, -1, -1):
        for j in range(NODES):
            for i in range(ROWS):
                phi[j, i] = (_SLOPES[k, j, i] - phi[j, i]) * q
    for i in range(ROWS):
        miss[i] = _PRODUCT_SLOPES[NODES, i] * q
    for k in range(NODES - 1, -1, -1):
        for i in range(ROWS):
            miss[i] = (_PRODUCT_SLOPES[k, i] - miss[i]) * q
    for j in range(NODES):
        start = phi[j, 0]
        for i in range(ROWS):
            phi[j, i] -= decay[i] * start
    start = miss[0]
    for i in range(ROWS):
        miss[i] -= decay[i] * start


@jit
def fill_table(z: float, decay: FloatArray, phi: FloatArray, miss: FloatArray) -> None:
    """Tables of one mode for z = rate * h >= 0, in units of h.

    Fills `decay` (ROWS,), exp(-z c_i); `phi` (NODES, ROWS); and `miss` (ROWS,), the response to a forcing that is
    the node polynomial, of largest size 1.
    """
    for i in range(ROWS):
        x = z * POINTS[i]
        # Denormal numbers would slow every later product down.
        decay[i] = math.exp(-x) if x < 690.0 else 0.0
    if z < _LATE:
        _fill_early(z, phi, miss)
    else:
        _fill_late(z, decay, phi, miss)


@cache
def integral_table() -> FloatArray:
    """`phi` of a mode with rate zero: integrals over [0, c_i] of the interpolant, shape (NODES, ROWS)."""
    phi = np.empty((NODES, ROWS))
    fill_table(0.0, np.empty(ROWS), phi, np.empty(ROWS))
    return phi


class Scheme(NamedTuple):
    """Radau IIA of s stages as numbers: order 2 s - 1 at the end of a step, stiffly accurate, L-stable."""

    a: FloatArray  # (s, s): Stage weights; the last row gives the end of the step
    c: FloatArray  # (s,): Stage times in units of the step, the last one 1
    # (s,): Error weights: the highest Legendre coefficient of the increment, the part that a polynomial of one degree
    # less could not follow
    e: FloatArray
    dense: FloatArray  # (s, s): x(t + theta h) = x + h sum_i sum_j K_i dense[i, j] theta^(j + 1), of order s
    eigenvalues: ComplexArray  # (m,): Of `a`: one of each conjugate pair, and the real one
    # to, back (m, s): a = Re(back diag(eigenvalues) to), so that each eigenvalue needs a linear system of n only
    to: ComplexArray
    back: ComplexArray
    h_max: float  # s


@cache
def radau_scheme(stages: int) -> Scheme:
    """Radau IIA with `stages` nodes."""
    s = stages
    # Nodes: roots of P_s - P_{s-1} mapped to (0, 1]; the last is 1.
    coefficients = np.zeros(s + 1)
    coefficients[s - 1 :] = -1.0, 1.0
    roots = np.sort(legendre.legroots(coefficients).real)
    for _ in range(3):
        roots -= legendre.legval(roots, coefficients) / legendre.legval(roots, legendre.legder(coefficients))
    c = 0.5 * (roots + 1.0)
    c[-1] = 1.0
    # The derivative is the interpolant of the stages; its integral is the dense output. In fractions: the coefficients
    # of the interpolant cancel over many digits, and rounding would leave 3e-13 of a step of seven stages.
    at = [Fraction(float(x)) for x in c]
    dense = [[x / (d + 1) for d, x in enumerate(_cardinal(at, i))] for i in range(s)]
    a = np.array([[sum(x * t ** (d + 1) for d, x in enumerate(row)) for row in dense] for t in at], float)
    # The highest coefficient of the shifted Legendre polynomial of degree s is (2 s)! / s!^2.
    e = [row[-1] / math.comb(2 * s, s) for row in dense]
    values, vectors = np.linalg.eig(a)
    back = np.linalg.inv(vectors)
    upper = np.flatnonzero(values.imag > -1e-12)
    # Of a conjugate pair keep one eigenvalue: the pair's contribution is twice its real part.
    twice = np.where(values.imag[upper] > 1e-12, 2.0, 1.0)
    return Scheme(
        a, c, np.array(e, float), np.array(dense, float), values[upper].astype(complex),
        np.ascontiguousarray(back[upper].astype(complex)),
        np.ascontiguousarray((vectors[:, upper] * twice).astype(complex)), np.inf,
    )  # fmt: skip


def _cardinal(at: list[Fraction], i: int) -> list[Fraction]:
    """Coefficients of 1, theta, ... of the polynomial that is 1 at one of the nodes and 0 at the others."""
    out = [Fraction(1)]
    for j, t in enumerate(at):
        if j != i:
            higher, lower = [Fraction(0), *out], [*out, Fraction(0)]
            out = [(x - t * y) / (at[i] - t) for x, y in zip(higher, lower, strict=True)]
    return out


@jit_rows
def combine(matrix: FloatArray, rows: FloatArray, since: int, out: FloatArray) -> None:
    """out += matrix @ rows, at all rows of a step, from column `since` of the matrix on."""
    n = matrix.shape[1]
    for c in range(matrix.shape[0]):
        # Two at a time: the sum is fetched and put back half as often.
        for k in range(since, n - 1, 2):
            share, other = matrix[c, k], matrix[c, k + 1]
            for i in range(ROWS):
                out[c, i] += share * rows[k, i] + other * rows[k + 1, i]
        if (n - since) % 2 == 1:
            share = matrix[c, n - 1]
            for i in range(ROWS):
                out[c, i] += share * rows[n - 1, i]


@jit_rows
def multiply(matrix: FloatArray, rows: FloatArray, start: FloatArray | None, out: FloatArray) -> None:
    """out = matrix @ rows, and `start` if that is given, at all rows of a step."""
    n, even = matrix.shape[1], matrix.shape[1] % 2 == 0
    for c in range(matrix.shape[0]):
        for i in range(ROWS):
            total = 0.0 if start is None else start[c, i]
            if n > 0:
                total += matrix[c, 0] * rows[0, i]
            if n > 0 and even:
                total += matrix[c, 1] * rows[1, i]
            out[c, i] = total
    combine(matrix, rows, 2 if even else 1, out)
