"""LSODA through numbalsoda: solver and right-hand side both compiled, no Python in between.

Its package builds from source and needs a Fortran compiler.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any

import numpy as np

from peers.contest import Contestant, FloatArray, NotSolvedError, Outcome, Plan, installed, tolerances
from problems import AMPLITUDE, Problem
from right_hand_side import compiled

LIBRARY = "numbalsoda"


def version() -> str | None:
    """Installed version."""
    return installed("numbalsoda")


@lru_cache(maxsize=1)
def _solver() -> Callable[..., tuple[FloatArray, float, bool]]:
    """The compiled loop over the pieces; arguments: address of the rates, state length, rtol, times, pieces (n, 6)."""
    from numba import njit
    from numbalsoda import lsoda

    @njit(error_model="numpy")
    def solve(address, size, rtol, t_eval, pieces):  # type: ignore[no-untyped-def]
        states = np.empty((t_eval.size, size))
        x = np.zeros(size)
        nfev = 0.0
        good = True
        for i in range(pieces.shape[0]):
            first, last = int(pieces[i, 4]), int(pieces[i, 5])
            times = np.empty(last - first + 2)
            times[0], times[1:-1], times[-1] = pieces[i, 0], t_eval[first:last], pieces[i, 1]
            data = np.array([pieces[i, 2], pieces[i, 3], 0.0])
            y, success = lsoda(address, x, times, data, rtol, rtol * AMPLITUDE, 10_000_000)
            good = good and success
            states[first:last] = y[1:-1]
            x = y[-1].copy()
            nfev += data[2]
        return states, nfev, good

    return solve


@lru_cache(maxsize=1)
def _rates(problem: Problem) -> Any:
    """The rates as a C function that counts its calls."""
    from numba import carray, cfunc
    from numbalsoda import lsoda_sig

    rhs = compiled(problem)
    fill, size = rhs.fill, rhs.size

    @cfunc(lsoda_sig, error_model="numpy")
    def rates(t, x_, out_, data_):  # type: ignore[no-untyped-def]
        x, out, data = carray(x_, (size,)), carray(out_, (size,)), carray(data_, (3,))
        data[2] += 1.0
        fill(t, x, out, data[0], data[1])

    return rates


def _setup(plan: Plan) -> Callable[[float], Outcome]:
    rhs, rates, solve = compiled(plan.problem), _rates(plan.problem), _solver()
    pieces = np.array([(p.t0, p.t1, p.sign, p.level, p.first, p.last) for p in plan.pieces])

    def run(rtol: float) -> Outcome:
        states, nfev, good = solve(rates.address, rhs.size, rtol, plan.t_eval, pieces)
        if not good:
            raise NotSolvedError("says that it failed")
        return Outcome(*rhs.observe(plan.u_source, states), int(nfev))

    return run


def contestants() -> list[Contestant]:
    """One method, also restarted at the zeros of the gap voltage."""
    return [
        Contestant(
            "numbalsoda" + (" +kinks" if kinks else ""),
            LIBRARY,
            tolerances(2, 13),
            _setup,
            kinks=kinks,
            mobile=True,
            networks=True,
            compile_limit=60.0,
        )
        for kinks in (False, True)
    ]
