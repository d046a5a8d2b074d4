"""CVODE of SUNDIALS, through scikit-sundae, which calls the compiled right-hand side from its Python callback."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from peers.contest import Contestant, FloatArray, NotSolvedError, Outcome, Plan, installed, tolerances
from problems import AMPLITUDE
from right_hand_side import compiled

LIBRARY = "CVODE"


def version() -> str | None:
    """Installed version of scikit-sundae."""
    found = installed("scikit-sundae")
    return found and f"scikit-sundae {found}"


def _setup(method: str) -> Callable[[Plan], Callable[[float], Outcome]]:
    def setup(plan: Plan) -> Callable[[float], Outcome]:
        from sksundae.cvode import CVODE

        rhs = compiled(plan.problem)
        times = [np.concatenate([[p.t0], plan.t_eval[p.first : p.last], [p.t1]]) for p in plan.pieces]

        now = [0.0, 0.0]

        def rates(t: float, x: FloatArray, out: FloatArray) -> None:
            rhs.fill(t, x, out, now[0], now[1])

        def jacobian(t: float, x: FloatArray, rate: FloatArray, out: FloatArray) -> None:
            out[:] = rhs.jacobian(t, x, now[0], now[1])

        def run(rtol: float) -> Outcome:
            states = np.empty((plan.t_eval.size, rhs.size))
            x, nfev = np.zeros(rhs.size), 0
            solver = CVODE(
                rates, method=method, rtol=rtol, atol=rtol * AMPLITUDE, jacfn=jacobian, max_num_steps=10_000_000
            )
            for piece, t in zip(plan.pieces, times, strict=True):
                now[:] = [piece.sign, piece.level]
                result = solver.solve(t, x)
                if not result.success:
                    raise NotSolvedError(result.message)
                # With only two times CVODE returns its own steps instead, so a piece without outputs is skipped here.
                if piece.last > piece.first:
                    states[piece.first : piece.last] = result.y[1:-1]
                x = result.y[-1].copy()
                nfev += result.nfev + (1 + rhs.size) * result.njev
            return Outcome(*rhs.observe(plan.u_source, states), nfev)

        return run

    return setup


def contestants() -> list[Contestant]:
    """BDF and Adams, each also restarted at the zeros of the gap voltage; only BDF on networks, which are stiff."""
    return [
        Contestant(
            f"CVODE {method}" + (" +kinks" if kinks else ""),
            LIBRARY, tolerances(2, 12.5, 2 / 3), _setup(method), kinks=kinks, mobile=True,
            networks=method == "BDF", slow=True,
        )
        for method in ("BDF", "Adams")
        for kinks in (False, True)
    ]  # fmt: skip
