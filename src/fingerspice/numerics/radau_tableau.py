"""Coefficients of Radau IIA collocation of any number of stages.

Hairer and Wanner, Solving Ordinary Differential Equations II (1996), IV.5. The test suite checks the order conditions.
"""

from __future__ import annotations

import math
from fractions import Fraction
from typing import NamedTuple

import numpy as np
from numpy.polynomial import legendre

from fingerspice.base.arrays import FloatArray


class Tableau(NamedTuple):
    """A collocation method of s stages: order 2 s - 1 at the end of a step, stiffly accurate, L-stable."""

    a: FloatArray  # (s, s): Stage weights; the last row gives the end of the step
    c: FloatArray  # (s,): Stage times in units of the step, the last one 1
    # (s,): Error weights: the highest Legendre coefficient of the increment, the part that a polynomial of one degree
    # less could not follow
    e: FloatArray
    dense: FloatArray  # (s, s): x(t + theta h) = x + h sum_i sum_j K_i dense[i, j] theta^(j + 1), of order s


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
    # The derivative is the interpolant of the stages; its integral is the dense output. In fractions: the coefficients
    # of the interpolant cancel over many digits, and rounding would leave 3e-13 of a step of seven stages.
    at = [Fraction(float(x)) for x in c]
    dense = [[x / (d + 1) for d, x in enumerate(_cardinal(at, i))] for i in range(s)]
    a = [[sum(x * t ** (d + 1) for d, x in enumerate(row)) for row in dense] for t in at]
    # The highest coefficient of the shifted Legendre polynomial of degree s is (2 s)! / s!^2.
    e = [row[-1] / math.comb(2 * s, s) for row in dense]
    return Tableau(np.array(a, float), c, np.array(e, float), np.array(dense, float))


def _cardinal(at: list[Fraction], i: int) -> list[Fraction]:
    """Coefficients of 1, theta, ... of the polynomial that is 1 at one of the nodes and 0 at the others."""
    out = [Fraction(1)]
    for j, t in enumerate(at):
        if j != i:
            higher, lower = [Fraction(0), *out], [*out, Fraction(0)]
            out = [(x - t * y) / (at[i] - t) for x, y in zip(higher, lower, strict=True)]
    return out
