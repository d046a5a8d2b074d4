"""LSODA through numbalsoda: solver and right-hand side both compiled, no Python in between.

Its package builds from source and needs a Fortran compiler.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from peers.contest import Contestant, NotSolvedError, Outcome, Plan, installed, tolerances
from problems import AMPLITUDE
from right_hand_side import compiled

LIBRARY = "numbalsoda"


def version() -> str | None:
    """Installed version."""
    return installed("numbalsoda")


def _setup(plan: Plan) -> Callable[[float], Outcome]:
    from numba import carray, cfunc, njit
    from numbalsoda import lsoda, lsoda_sig

    rhs = compiled(plan.problem)
    scalar_rates = rhs.scalar_rates

    @cfunc(lsoda_sig, error_model="numpy")
    def rates(t, x_, out_, data_):  # type: ignore[no-untyped-def]
        x, out, data = carray(x_, (2,)), carray(out_, (2,)), carray(data_, (3,))
        data[2] += 1.0
        out[0], out[1] = scalar_rates(t, x[0], x[1], data[0], data[1])

    signs = np.array([p.sign for p in plan.pieces])
    levels = np.array([p.level for p in plan.pieces])
    first = np.array([p.first for p in plan.pieces])
    last = np.array([p.last for p in plan.pieces])
    starts, stops = np.array([p.t0 for p in plan.pieces]), np.array([p.t1 for p in plan.pieces])

    @njit(error_model="numpy")
    def solve(address, rtol, t_eval):  # type: ignore[no-untyped-def]
        states = np.empty((t_eval.size, 2))
        x = np.zeros(2)
        nfev = 0.0
        good = True
        for i in range(signs.size):
            times = np.empty(last[i] - first[i] + 2)
            times[0], times[1:-1], times[-1] = starts[i], t_eval[first[i] : last[i]], stops[i]
            data = np.array([signs[i], levels[i], 0.0])
            y, success = lsoda(address, x, times, data, rtol, rtol * AMPLITUDE, 10_000_000)
            good = good and success
            states[first[i] : last[i]] = y[1:-1]
            x = y[-1].copy()
            nfev += data[2]
        return states, nfev, good

    def run(rtol: float) -> Outcome:
        states, nfev, good = solve(rates.address, rtol, plan.t_eval)
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
            compile_limit=60.0,
        )
        for kinks in (False, True)
    ]
