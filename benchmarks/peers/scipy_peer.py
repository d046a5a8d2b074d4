"""scipy: solve_ivp on the compiled right-hand side, one call per piece, and odeint, a faster interface to LSODA."""

from __future__ import annotations

import warnings
from collections.abc import Callable

import numpy as np
from scipy.integrate import odeint, solve_ivp

from peers.contest import Contestant, NotSolvedError, Outcome, Plan, installed, tolerances
from problems import AMPLITUDE
from right_hand_side import compiled

LIBRARY = "scipy"
IMPLICIT = ("Radau", "BDF")


def version() -> str | None:
    """Installed version."""
    return installed("scipy")


def _setup(method: str) -> Callable[[Plan], Callable[[float], Outcome]]:
    def setup(plan: Plan) -> Callable[[float], Outcome]:
        rhs = compiled(plan.problem)
        extra = {"jac": rhs.jacobian} if method in IMPLICIT else {}
        times = [np.append(plan.t_eval[p.first : p.last], p.t1) for p in plan.pieces]

        def run(rtol: float) -> Outcome:
            states = np.empty((plan.t_eval.size, rhs.size))
            x, nfev = np.zeros(rhs.size), 0
            for piece, t in zip(plan.pieces, times, strict=True):
                # A trial step that is far too long may overflow; scipy's step control then shortens it.
                with np.errstate(all="ignore"):
                    result = solve_ivp(
                        rhs.rates, (piece.t0, piece.t1), x, method, t, args=(piece.sign, piece.level),
                        rtol=max(rtol, 3e-14), atol=rtol * AMPLITUDE, **extra,
                    )  # fmt: skip
                if not result.success:
                    raise NotSolvedError(result.message)
                states[piece.first : piece.last] = result.y.T[:-1]
                x = result.y[:, -1]
                # Each Jacobian by finite differences takes 1 + size evaluations.
                nfev += result.nfev + (1 + rhs.size) * result.njev
            return Outcome(*rhs.observe(plan.u_source, states), nfev)

        return run

    return setup


def _setup_odeint(plan: Plan) -> Callable[[float], Outcome]:
    rhs = compiled(plan.problem)
    times = [np.concatenate([[p.t0], plan.t_eval[p.first : p.last], [p.t1]]) for p in plan.pieces]

    def run(rtol: float) -> Outcome:
        states = np.empty((plan.t_eval.size, rhs.size))
        x, nfev = np.zeros(rhs.size), 0
        for piece, t in zip(plan.pieces, times, strict=True):
            with warnings.catch_warnings(record=True) as said:
                warnings.simplefilter("always")
                y, info = odeint(
                    rhs.rates, x, t, args=(piece.sign, piece.level), tfirst=True, full_output=True,
                    rtol=rtol, atol=rtol * AMPLITUDE, mxstep=10_000_000,
                )  # fmt: skip
            if said:
                raise NotSolvedError(str(said[0].message).splitlines()[0])
            states[piece.first : piece.last] = y[1:-1]
            x = y[-1]
            nfev += int(info["nfe"][-1])
        return Outcome(*rhs.observe(plan.u_source, states), nfev)

    return run


def contestants() -> list[Contestant]:
    """Four methods and odeint; the three that are best at some error are also restarted at the gap voltage's zeros.

    On networks LSODA runs by odeint only, its faster interface; DOP853, an explicit method that needs very short steps
    there, runs without the zeros only, and BDF, which is slower than LSODA, does not run.
    """
    fine, coarse = tolerances(2, 12.5, 2 / 3), tolerances(2, 8, 1 / 2)
    best = ("odeint", "LSODA", "DOP853")
    return [
        Contestant(
            f"scipy {method}" + (" +kinks" if kinks else ""),
            LIBRARY,
            fine if method in best else coarse,
            _setup_odeint if method == "odeint" else _setup(method),
            kinks=kinks,
            mobile=True,
            networks=method in ("odeint", "Radau") or (method == "DOP853" and not kinks),
            slow=method != "odeint",
        )
        for method in (*best, *IMPLICIT)
        for kinks in (False, True)
        if method in best or not kinks
    ]
