"""Coefficients of Radau IIA collocation of any number of stages.

Hairer and Wanner, Solving Ordinary Differential Equations II (1996), IV.5. The test suite checks the order conditions.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.polynomial import legendre, polynomial
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


class Tableau(NamedTuple):
    """A collocation method of s stages: order 2 s - 1 at the end of a step, stiffly accurate, L-stable.

    Attributes
    ----------
    a : ndarray, shape (s, s)
        Stage weights; the last row gives the end of the step.
    c : ndarray, shape (s,)
        Stage times in units of the step, the last one 1.
    e : ndarray, shape (s,)
        Error weights: the highest Legendre coefficient of the increment, the part that a polynomial of one degree less
        could not follow.
    dense : ndarray, shape (s, s)
        x(t + theta h) = x + h sum_i sum_j K_i dense[i, j] theta^(j + 1), of order s.
    """

    a: FloatArray
    c: FloatArray
    e: FloatArray
    dense: FloatArray


def radau(stages: int) -> Tableau:
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
    # The derivative is the interpolant of the stages; its integral is the dense output.
    power = np.linalg.inv(np.vander(c, increasing=True))
    dense = (power / np.arange(1.0, s + 1.0)[:, None]).T
    a = (np.vander(c, s, increasing=True) * c[:, None]) @ dense.T
    top = np.zeros((s + 1, s))
    top[1:] = dense.T
    e = np.array([legendre.poly2leg(_on_symmetric_interval(top[:, i]))[s] for i in range(s)])
    return Tableau(a, c, e, dense)


def _on_symmetric_interval(coefficients: FloatArray) -> FloatArray:
    """Coefficients in x of a polynomial given in theta = (1 + x) / 2."""
    out = np.zeros(1)
    for value in coefficients[::-1]:
        out = polynomial.polyadd(polynomial.polymul(out, [0.5, 0.5]), [value])
    full = np.zeros(coefficients.size)
    full[: out.size] = out
    return full
