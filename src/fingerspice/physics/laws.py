"""Ridge areas by other laws than the paper's, at gap voltages of 0 V or more; SI units."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import ArrayLike

from fingerspice.base.arrays import FloatArray
from fingerspice.physics.materials import EPS0

Values = Mapping[str, float]


def stress(u: FloatArray, v: Values) -> FloatArray:
    """Electroadhesive stress sigma_el (Eq. 2), Pa, from the gap's `d` (m) and `eps_r`."""
    return np.asarray(0.5 * EPS0 * v["eps_r"] * (u / v["d"]) ** 2)


def root(residual: Callable[..., FloatArray], low: ArrayLike, high: ArrayLike, *values: ArrayLike) -> FloatArray:
    """The root between `low` and `high` of ``residual(x, *values)``, to rounding; all of them are broadcast.

    The residual is called with the elements whose roots are not found yet, so all that it has of them is in `values`.
    """
    from scipy.optimize.elementwise import find_root

    found = find_root(residual, (low, high), args=values, tolerances={"xrtol": 4e-16, "xatol": 0.0, "fatol": 0.0})
    return np.asarray(found.x)


def dmt(u: FloatArray, v: Values) -> FloatArray:
    """Eq. 5 under the load with the attraction, N = F_N + sigma A: a Derjaguin-Muller-Toporov contact."""
    alpha, m, load, sigma = v["alpha"], v["m_exp"], v["fn"], stress(u, v)

    def missing(n: FloatArray, s: FloatArray, alpha: FloatArray, m: FloatArray, load: FloatArray) -> FloatArray:
        return n - s * alpha * n**m - load

    # Left of the root the load is too small for its area, and right of both of these too large.
    high = np.maximum(2.0 * load, (2.0 * sigma * alpha) ** (1.0 / (1.0 - m)))
    return np.asarray(alpha * root(missing, load, high, sigma, alpha, m, load) ** m)


def linear(u: FloatArray, v: Values) -> FloatArray:
    """An area in proportion to the load with the attraction, up to a largest one, as in Persson's theory.

    A = a_max erf(sqrt(pi)/2 slope N / a_max), N = F_N + sigma A.
    """
    from scipy.special import erf

    most, load, per_load = v["a_max"], v["fn"], 0.5 * np.sqrt(np.pi) * v["slope"] / v["a_max"]

    def missing(a: FloatArray, s: FloatArray, most: FloatArray, load: FloatArray, per: FloatArray) -> FloatArray:
        return np.asarray(most * erf(per * (load + s * a)) - a)

    return root(missing, 0.0, most, stress(u, v), most, load, per_load)
