"""torchdiffeq in double precision.

The right-hand side is the compiled one, called through `torch.from_numpy`, which is some forty times faster than the
same in eager torch; the contestant `eager` has the right-hand side that a torch user would write.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from peers.contest import Contestant, NotSolvedError, Outcome, Plan, installed
from problems import AMPLITUDE
from right_hand_side import compiled, open_rates

LIBRARY = "torchdiffeq"


def version() -> str | None:
    """Installed versions of torchdiffeq and torch."""
    found, torch = installed("torchdiffeq"), installed("torch")
    return None if found is None or torch is None else f"torchdiffeq {found}, torch {torch}"


def _setup(method: str, eager: bool = False) -> Callable[[Plan], Callable[[float], Outcome]]:
    fixed = method == "rk4"

    def setup(plan: Plan) -> Callable[[float], Outcome]:
        import torch
        from torchdiffeq import odeint

        rhs = compiled(plan.problem)
        torch_rates = open_rates(plan.problem, torch.sin, lambda x, top: torch.clamp(x, max=top))
        times = [torch.from_numpy(np.concatenate([[p.t0], plan.t_eval[p.first : p.last], [p.t1]])) for p in plan.pieces]

        def run(setting: float) -> Outcome:
            states = np.empty((plan.t_eval.size, 2))
            x = torch.zeros(2, dtype=torch.float64)
            nfev = 0
            for piece, t in zip(plan.pieces, times, strict=True):

                def slope(t: torch.Tensor, x: torch.Tensor, piece=piece) -> torch.Tensor:  # type: ignore[no-untyped-def]
                    nonlocal nfev
                    nfev += 1
                    if eager:
                        return torch.stack(torch_rates(t, x, piece.sign, piece.level))
                    return torch.from_numpy(rhs.rates(t.item(), x.numpy(), piece.sign, piece.level))

                if fixed:
                    # The fixed step divides the piece evenly; the setting is the number of steps per period.
                    length = piece.t1 - piece.t0
                    steps = max(1, round(setting * length / plan.problem.period))
                    keywords = {"options": {"step_size": length / steps, "interp": "cubic"}}
                else:
                    keywords = {"rtol": setting, "atol": setting * AMPLITUDE}
                with torch.no_grad():
                    y = odeint(slope, x, t, method=method, **keywords)
                if not bool(torch.isfinite(y).all()):
                    raise NotSolvedError("returned NaN and called it a success")
                states[piece.first : piece.last] = y.numpy()[1:-1]
                x = y[-1]
            return Outcome(*rhs.observe(plan.u_source, states), nfev)

        return run

    return setup


def contestants() -> list[Contestant]:
    """Two adaptive methods, one restarted at the zeros of the gap voltage, one also in eager torch, and fixed steps.

    All methods of torchdiffeq are explicit, and its best takes thousands of times the time of the fastest library: few
    settings are tried, and networks, which are stiff, are left out.
    """
    return [
        Contestant("torchdiffeq dopri5", LIBRARY, (1e-3, 1e-5, 1e-7), _setup("dopri5"), slow=True),
        Contestant(
            "torchdiffeq dopri8 +kinks", LIBRARY, (1e-3, 1e-5, 1e-7, 1e-9), _setup("dopri8"), kinks=True, slow=True
        ),
        Contestant("torchdiffeq dopri5, eager", LIBRARY, (1e-4,), _setup("dopri5", True), slow=True),
        Contestant("torchdiffeq rk4", LIBRARY, (50.0, 200.0), _setup("rk4"), "steps per period", slow=True),
    ]
