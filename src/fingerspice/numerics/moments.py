"""Moments of a decaying exponential, from which the weights of exponential quadrature follow."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from fingerspice.base.arrays import FloatArray
from fingerspice.base.compiled import jit

# Beyond, each moment follows from the one below; before, that would lose digits, and they follow from the highest.
_LATE = 4.0


@jit
def moments(z: float, out: FloatArray) -> None:
    """Integrals of exp(-z (1 - x)) x^j over [0, 1] for z >= 0 into `out` (count,), j from 0; to a few roundings."""
    count = out.size
    if z > _LATE:
        out[0] = -math.expm1(-z) / z
        for j in range(1, count):
            out[j] = (1.0 - j * out[j - 1]) / z
        return
    # exp(-z) sum of z^k / (k! (k + count)): all terms are positive, and once one is small the next are smaller.
    total, term, k = 0.0, 1.0, 0.0
    while term > 1e-17 * total:
        total += term / (k + count)
        k += 1.0
        term *= z / k
    out[count - 1] = math.exp(-z) * total
    for j in range(count - 1, 0, -1):
        out[j - 1] = (1.0 - z * out[j]) / j


@jit
def _fill(z: FloatArray, basis: FloatArray, until: float, out: FloatArray) -> None:
    count = basis.shape[1]
    found = np.empty(count)
    for i in range(z.size):
        moments(z[i] * until, found)
        for a in range(basis.shape[0]):
            out[i, a] = 0.0
            for j in range(count):
                out[i, a] += basis[a, j] * until ** (j + 1) * found[j]


@lru_cache(maxsize=16)
def _basis(nodes: tuple[float, ...]) -> FloatArray:
    """Coefficients of the Lagrange polynomials of these nodes, shape (n_nodes, n_nodes)."""
    return np.ascontiguousarray(np.linalg.inv(np.vander(nodes, increasing=True)).T)


def weights(z: FloatArray, nodes: tuple[float, ...], until: float = 1.0) -> FloatArray:
    """Weights of values at `nodes` in the integral of exp(-z (until - x)) f(x) over [0, until], f their polynomial.

    Parameters
    ----------
    z : ndarray
        Not negative.
    nodes : tuple of float
        In [0, 1].
    until : float
        In (0, 1].

    Returns
    -------
    ndarray, shape (*z.shape, n_nodes)
    """
    out = np.empty((z.size, len(nodes)))
    _fill(np.ravel(z), _basis(nodes), until, out)
    return out.reshape(*z.shape, len(nodes))
