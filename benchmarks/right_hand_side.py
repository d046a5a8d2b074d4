"""The right-hand side that peers integrate: written once, for numba and, under `local`, for any array library.

The right-hand side of networks is in `network_rates.py`. State x (V) of a stack: the voltages of coating and gap less
their capacitive fraction k U of the source; under `mobile` multiplied by A_R/A_R(0 V), so that no jump of the source
changes the state. The skin's part is minus the sum of the two.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from network_problems import NetworkProblem
from network_rates import network_rates
from problems import BELOW, Constants, Drive, Problem

FloatArray = NDArray[np.float64]


def local_rates(
    constants: Constants,
    drive: Drive,
    sin: Callable[[Any], Any],
    least: Callable[[Any, Any], Any],
    compile_part: Callable[[Any], Any] = lambda f: f,
) -> tuple[Callable[..., Any], Callable[..., Any]]:
    """Functions rates(t, x0, x1, sign, level) -> (x0', x1') and gap(U, x0, x1, sign) -> (u_gap, 1/A_R) for `local`.

    `sin` and `least` are the library's functions. A sign of 0 uses |u_gap|; +-1 uses the branch of that sign and its
    continuation through zero. Beyond both ends of the series the area is constant, so that a trial step far outside
    does not overflow.
    """
    (k0, k1, k2), (f0, f1, f2), (p0, p1, p2) = constants.k, constants.fixed, constants.per_area
    series, scale = constants.series[::-1], 2.0 / constants.reach
    source = compile_part(drive(sin))

    @compile_part
    def gap(u_source, x0, x1, sign):  # type: ignore[no-untyped-def]
        u = k1 * u_source + x1
        s = least(scale * (abs(u) if sign == 0.0 else sign * u) - 1.0, 1.0)
        s = -least(-s, BELOW)
        inverse = series[0] + 0.0 * s
        for c in series[1:]:
            inverse = inverse * s + c
        return u, inverse

    @compile_part
    def rates(t, x0, x1, sign, level):  # type: ignore[no-untyped-def]
        u_source = source(t, level)
        u, inverse = gap(u_source, x0, x1, sign)
        leak0 = (f0 + p0 * inverse) * (k0 * u_source + x0)
        leak1 = (f1 + p1 * inverse) * u
        leak = leak0 + leak1 + (f2 + p2 * inverse) * (k2 * u_source - x0 - x1)
        return k0 * leak - leak0, k1 * leak - leak1

    return rates, gap


def _mobile_rates(
    constants: Constants,
    drive: Drive,
    sin: Callable[[Any], Any],
    least: Callable[[Any, Any], Any],
    compile_part: Callable[[Any], Any],
) -> tuple[Callable[..., Any], Callable[..., Any]]:
    """The functions of `local_rates` for `mobile`: every evaluation solves u_gap = k U + x1 A(0)/A(|u_gap|) by Newton.

    If Newton's method does not converge, the first root from 0 V on is found by search and bisection; NaN if there is
    none.
    """
    (k0, k1, k2), (f0, f1, f2), (p0, p1, p2) = constants.k, constants.fixed, constants.per_area
    series, scale, area0 = constants.series[::-1], 2.0 / constants.reach, constants.area0
    source, reach = compile_part(drive(sin)), constants.reach

    @compile_part
    def defect(v, share, stored):  # type: ignore[no-untyped-def]
        s = -least(-least(scale * v - 1.0, 1.0), BELOW)
        inverse = series[0]
        for c in series[1:]:
            inverse = inverse * s + c
        return v - share - stored * area0 * inverse, inverse

    @compile_part
    def search(share, stored):  # type: ignore[no-untyped-def]
        side = 1.0 if share + stored >= 0.0 else -1.0
        low = 0.0
        for i in range(1, 201):
            high = i * reach / 200.0
            if defect(high, side * share, side * stored)[0] >= 0.0:
                for _ in range(60):
                    middle = 0.5 * (low + high)
                    if defect(middle, side * share, side * stored)[0] < 0.0:
                        low = middle
                    else:
                        high = middle
                return side * high, defect(high, side * share, side * stored)[1]
            low = high
        return math.nan, math.nan

    @compile_part
    def gap(u_source, x0, x1, sign):  # type: ignore[no-untyped-def]
        share = k1 * u_source
        u = share + x1
        step = 0.0
        inverse = 1.0 / area0
        # From the root at A(0) Newton's method converges on every scene of work_precision.py, as none is near the fold.
        for _ in range(30):
            side = sign if sign != 0.0 else (1.0 if u >= 0.0 else -1.0)
            s = -least(-least(scale * side * u - 1.0, 1.0), BELOW)
            inverse = series[0]
            slope = 0.0
            for c in series[1:]:
                slope = slope * s + inverse
                inverse = inverse * s + c
            if s == 1.0 or s == -BELOW:
                slope = 0.0
            step = (u - share - x1 * area0 * inverse) / (1.0 - x1 * area0 * slope * scale * side)
            u -= step
            if abs(step) <= 4e-16 * (abs(share) + abs(x1)):
                break
        # The last step is above round-off, or the root is on another branch, beyond the range of the area's series.
        if not abs(step) <= 1e-12 * (abs(share) + abs(x1)) or abs(u) > reach:
            return search(share, x1)
        return u, inverse

    @compile_part
    def rates(t, x0, x1, sign, level):  # type: ignore[no-untyped-def]
        u_source = source(t, level)
        u, inverse = gap(u_source, x0, x1, sign)
        growth = area0 * inverse
        leak0 = (f0 + p0 * inverse) * (k0 * u_source + growth * x0)
        leak1 = (f1 + p1 * inverse) * u
        leak = leak0 + leak1 + (f2 + p2 * inverse) * (k2 * u_source - growth * (x0 + x1))
        return (k0 * leak - leak0) / growth, (k1 * leak - leak1) / growth

    return rates, gap


def open_rates(
    problem: Problem, sin: Callable[[Any], Any], least: Callable[[Any, Any], Any]
) -> Callable[[Any, Any, Any, Any], Any]:
    """Function rates(t, x, sign, level) -> x' as a tuple, with an array library's own functions; `local` only."""
    if isinstance(problem, NetworkProblem):
        return network_rates(problem.around, False, problem.drive, sin, least, lambda f: f)
    stack, _ = local_rates(problem.constants, problem.drive, sin, least)
    return lambda t, x, sign, level: stack(t, x[0], x[1], sign, level)


def size_of(problem: Problem) -> int:
    """Length of the state."""
    if not isinstance(problem, NetworkProblem):
        return 2
    around = problem.around
    return 1 + int(math.isfinite(around.body)) + 2 * len(around.fingers)


@dataclass(frozen=True)
class Compiled:
    """numba's right-hand side of a problem.

    Attributes
    ----------
    size : int
        Length n of the state.
    fill : callable
        (t, x, out, sign, level): x' into `out`, shape (n,).
    rates : callable
        (t, x, sign, level) -> x', shape (n,).
    jacobian : callable
        (t, x, sign, level) -> (n, n), by finite differences: n evaluations and one at x.
    observe : callable
        (U, x) of shapes (m,), (m, n) -> u_gap in V and F_el in N, shape (m,), or (m, 2) for two fingers.
    """

    size: int
    fill: Callable[..., None]
    rates: Callable[..., FloatArray]
    jacobian: Callable[..., FloatArray]
    observe: Callable[..., tuple[FloatArray, FloatArray]]


_COMPILED: dict[str, Compiled] = {}


def compiled(problem: Problem) -> Compiled:
    """The compiled right-hand side of a problem, compiled once per process for all problems of the same name."""
    if problem.name not in _COMPILED:
        build = _network if isinstance(problem, NetworkProblem) else _stack
        fill, observe = build(problem)  # type: ignore[arg-type]
        _COMPILED[problem.name] = _around(size_of(problem), fill, observe)
    return _COMPILED[problem.name]


def _around(size: int, fill: Callable[..., None], observe: Callable[..., Any]) -> Compiled:
    """The functions that libraries call, from the function that fills in the rates."""

    @njit(error_model="numpy")
    def rates(t, x, sign, level):  # type: ignore[no-untyped-def]
        out = np.empty(size)
        fill(t, x, out, sign, level)
        return out

    @njit(error_model="numpy")
    def jacobian(t, x, sign, level):  # type: ignore[no-untyped-def]
        out = np.empty((size, size))
        base, moved = rates(t, x, sign, level), x.copy()
        # The increment is about the square root of the machine precision times the size of the state.
        d = 1e-6 * (1.0 + np.abs(x).sum())
        for j in range(size):
            moved[j] = x[j] + d
            out[:, j] = (rates(t, moved, sign, level) - base) / d
            moved[j] = x[j]
        return out

    return Compiled(size, fill, rates, jacobian, observe)


def _stack(problem: Problem) -> tuple[Callable[..., None], Callable[..., Any]]:
    constants = problem.constants
    build = _mobile_rates if problem.law == "mobile" else local_rates
    rates, gap = build(constants, problem.drive, math.sin, min, njit(error_model="numpy"))
    stress = constants.stress

    @njit(error_model="numpy")
    def fill(t, x, out, sign, level):  # type: ignore[no-untyped-def]
        out[0], out[1] = rates(t, x[0], x[1], sign, level)

    @njit(error_model="numpy")
    def observe(u_source, x):  # type: ignore[no-untyped-def]
        u_gap = np.empty(u_source.size)
        force = np.empty(u_source.size)
        for i in range(u_source.size):
            u, inverse = gap(u_source[i], x[i, 0], x[i, 1], 0.0)
            u_gap[i] = u
            force[i] = stress * u * u / inverse
        return u_gap, force

    return fill, observe


def _network(problem: NetworkProblem) -> tuple[Callable[..., None], Callable[..., Any]]:
    around, size = problem.around, size_of(problem)
    mobile = problem.law == "mobile"
    rates = network_rates(around, mobile, problem.drive, math.sin, min, njit(error_model="numpy"))
    longest = max(len(finger.series) for finger in around.fingers)
    series = np.array([(0.0,) * (longest - len(f.series)) + f.series[::-1] for f in around.fingers])
    stress = np.array(problem.stresses)
    # `first` is the index of the first gap voltage in the state.
    scale, first = 2.0 / around.reach, size - 2 * stress.size + 1

    @njit(error_model="numpy")
    def fill(t, x, out, sign, level):  # type: ignore[no-untyped-def]
        found = rates(t, x, sign, level)
        for i in range(size):
            out[i] = found[i]

    @njit(error_model="numpy")
    def gaps_of(x):  # type: ignore[no-untyped-def]
        u_gap = np.empty((x.shape[0], stress.size))
        force = np.empty((x.shape[0], stress.size))
        for i in range(x.shape[0]):
            for j in range(stress.size):
                u = x[i, first + 2 * j]
                s = min(scale * abs(u) - 1.0, 1.0)
                inverse = 0.0
                for c in series[j]:
                    inverse = inverse * s + c
                u_gap[i, j] = u
                force[i, j] = stress[j] * u * u / inverse
        return u_gap, force

    def observe(u_source: FloatArray, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        u_gap, force = gaps_of(x)
        return (u_gap[:, 0], force[:, 0]) if stress.size == 1 else (u_gap, force)

    return fill, observe
