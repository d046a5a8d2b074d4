"""This package, as called by a user: the time includes preparation, error estimate and every output array."""

from __future__ import annotations

from collections.abc import Callable

import fingerspice as fs
from peers.contest import Contestant, Outcome, Plan, installed, tolerances
from problems import Problem

LIBRARY = "fingerspice"


def version() -> str | None:
    """Installed version."""
    return installed("fingerspice")


def ours(problem: Problem, rtol: float, method: str, plan: Plan, circuit: fs.Circuit) -> Outcome:
    """One run of a problem, without the charge, which no peer computes."""
    run = fs.simulate(
        circuit, t_stop=plan.t_stop, t_eval=plan.t_eval, rtol=rtol, method=method, charge_law=problem.law, charge=False
    )
    assert run.u_gap is not None
    assert run.f_el is not None
    return Outcome(run.u_gap, run.f_el, run.nfev)


def _setup(method: str) -> Callable[[Plan], Callable[[float], Outcome]]:
    def setup(plan: Plan) -> Callable[[float], Outcome]:
        circuit = plan.problem.circuit()
        return lambda rtol: ours(plan.problem, rtol, method, plan, circuit)

    return setup


def contestants() -> list[Contestant]:
    """Methods of this package: `auto`, the default; `exponential`, which steps every period; and `radau`."""
    auto, stepped = (
        Contestant(library, library, tolerances(2, 12), _setup(method), mobile=True, networks=True, compile_limit=300.0)
        for library, method in ((LIBRARY, "auto"), (f"{LIBRARY}, every period", "exponential"))
    )
    radau = Contestant(
        "fingerspice radau", f"{LIBRARY}, Radau", (1e-3, 1e-6, 1e-9), _setup("radau"), slow=True, compile_limit=120.0
    )
    return [auto, stepped, radau]
