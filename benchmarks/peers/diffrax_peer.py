"""diffrax on JAX in double precision: the whole run is one compiled function, whose compilation is timed separately.

The pieces between the source's jumps are the iterations of a scan; the zeros of the gap voltage are `jump_ts` of the
step controller.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from peers.contest import Contestant, NotSolvedError, Outcome, Plan, installed, tolerances
from problems import AMPLITUDE
from right_hand_side import compiled, open_rates, size_of

LIBRARY = "diffrax"
MAX_STEPS = 500_000
"""Largest number of steps per piece; a method for non-stiff problems then gives up within the time limit."""


def version() -> str | None:
    """Installed versions of diffrax and jaxlib."""
    found, jaxlib = installed("diffrax"), installed("jaxlib")
    return None if found is None or jaxlib is None else f"diffrax {found}, jaxlib {jaxlib}"


def _setup(method: str) -> Callable[[Plan], Callable[[float], Outcome]]:
    def setup(plan: Plan) -> Callable[[float], Outcome]:
        import diffrax
        import jax
        import jax.numpy as jnp

        jax.config.update("jax_enable_x64", True)
        rates, size = open_rates(plan.problem, jnp.sin, jnp.minimum), size_of(plan.problem)
        solver = getattr(diffrax, method)()
        # The zeros are only given if the source has no jumps: of a square, the gap voltage changes its sign at the
        # jumps.
        segments = plan.problem.pieces(plan.periods)
        zeros = jnp.asarray(plan.zeros) if plan.zeros and len(segments) == 1 else None

        def rhs(t, x, level):  # type: ignore[no-untyped-def]
            return jnp.stack(rates(t, x, 0.0, level))

        term = diffrax.ODETerm(rhs)

        @jax.jit
        def solve(rtol, starts, stops, levels, times):  # type: ignore[no-untyped-def]
            def piece(x, given):  # type: ignore[no-untyped-def]
                start, stop, level, t = given
                control = diffrax.PIDController(rtol=rtol, atol=rtol * AMPLITUDE)
                if zeros is not None:
                    control = diffrax.ClipStepSizeController(control, jump_ts=zeros)
                run = diffrax.diffeqsolve(
                    term, solver, start, stop, None, x, level, stepsize_controller=control, throw=False,
                    saveat=diffrax.SaveAt(ts=t, t1=True), max_steps=MAX_STEPS,
                )  # fmt: skip
                good = diffrax.is_okay(run.result)
                return run.ys[-1], (run.ys[:-1], run.stats["num_steps"], good)

            return jax.lax.scan(piece, jnp.zeros(size), (starts, stops, levels, times))

        given = (
            np.array([p.t0 for p in segments]),
            np.array([p.t1 for p in segments]),
            np.array([p.level for p in segments]),
            plan.t_eval.reshape(len(segments), -1),
        )
        observe = compiled(plan.problem).observe
        # Evaluations per step: the number of stages, less one for a first-same-as-last method. diffrax does not count
        # the evaluations of Newton's iterations.
        per_step = {"Tsit5": 6, "Dopri8": 13}.get(method)

        def run(rtol: float) -> Outcome:
            _, (states, steps, good) = solve(rtol, *given)
            if not bool(good.all()):
                raise NotSolvedError(f"gave up (most steps allowed: {MAX_STEPS})")
            nfev = None if per_step is None else per_step * int(steps.sum())
            return Outcome(*observe(plan.u_source, np.asarray(states).reshape(-1, size)), nfev)

        return run

    return setup


def contestants() -> list[Contestant]:
    """Two explicit methods and a stiff one, each also restarted at the zeros of the gap voltage.

    Dopri8 is left out on networks because it was slower than Tsit5 at every error; so is the stiff method with the
    zeros, because it was slower than without them.
    """
    settings = {
        "Tsit5": tolerances(2, 12.5, 2 / 3), "Dopri8": tolerances(2, 12.5, 2 / 3), "Kvaerno5": (1e-2, 1e-4, 1e-6)
    }  # fmt: skip
    return [
        Contestant(
            f"diffrax {method}" + (" +kinks" if kinks else ""),
            LIBRARY,
            tried,
            _setup(method),
            kinks=kinks,
            whole=True,
            networks=method == "Tsit5" or (method == "Kvaerno5" and not kinks),
            compile_limit=60.0,
        )
        for method, tried in settings.items()
        for kinks in (False, True)
    ]
