"""Periodic state of a circuit under a periodic source, by Newton shooting on the live voltages."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from fingerspice.circuit.circuit import Circuit
from fingerspice.circuit.statespace import build_stack
from fingerspice.errors import InputError, SolveError
from fingerspice.problem import Problem, prepare, state_from
from fingerspice.simulation import run_problem
from fingerspice.solution import Solution, Status
from fingerspice.transient import choose_tableau, integrate

FloatArray = NDArray[np.float64]


def periodic_solution(
    circuit: Circuit,
    *,
    charge_law: str | None = None,
    area: str | float = "coupled",
    rtol: float = 1e-8,
    points: int = 1000,
) -> Solution:
    """One period of the periodic state.

    Parameters
    ----------
    circuit : Circuit
        With a periodic source.
    charge_law, area, rtol
        As in `simulate`.
    points : int
        Output steps in the period.

    Returns
    -------
    Solution
        Over one period, from the first whole period after the source has settled.

    Raises
    ------
    InputError
        For a source without a period.
    SolveError
        Where a period cannot be integrated, or the iteration does not close it.
    """
    waveform = build_stack(circuit).waveform
    period = waveform.period
    if period is None:
        raise InputError("the source has no period, so there is no periodic state to compare")
    begin = period * np.ceil(waveform.settled / period)
    problem = prepare(circuit, t_stop=begin + period, t_eval=None, charge_law=charge_law, area=area, start="uncharged")
    before = float(problem.waveform.value(begin, "left"))
    problem = dataclasses.replace(problem, t_start=begin, t_stop=begin + period, first=begin, step=period / points)
    x = _close(problem, before, rtol)
    problem = dataclasses.replace(problem, initial=state_from(problem.model, begin, x, before, problem.charge_law))
    solution = run_problem(problem, rtol=rtol)
    if not solution.success:
        raise SolveError(solution.message, solution)
    return solution


def _close(problem: Problem, before: float, rtol: float) -> FloatArray:
    """Live voltages (V) that a period leads back to, by Newton on the period map."""
    x = np.zeros(problem.stack.c.size - 1)
    scale = max(problem.waveform.peak(problem.t_start, problem.t_stop), 1e-300)
    worst = np.inf
    for _ in range(12):
        end = _after_a_period(problem, x, before, rtol)
        defect = end - x
        worst = np.abs(defect).max(initial=0.0)
        if worst <= 0.3 * rtol * scale:
            return end
        jacobian = np.empty((x.size, x.size))
        for j in range(x.size):
            step = 1e-3 * scale * np.eye(x.size)[j]
            jacobian[:, j] = (_after_a_period(problem, x + step, before, rtol) - end) / (1e-3 * scale)
        # Without leakage a direction keeps what it starts with: least squares leaves it alone.
        x = x + np.linalg.lstsq(np.eye(x.size) - jacobian, defect, rcond=1e-8)[0]
    raise SolveError(f"the periodic state did not close: {worst:.3g} V are left after a period")


def _after_a_period(problem: Problem, x: FloatArray, before: float, rtol: float) -> FloatArray:
    start = state_from(problem.model, problem.t_start, x, before, problem.charge_law)
    scale = problem.waveform.peak(problem.t_start, problem.t_stop) or 1.0
    none = np.empty(0)
    run = integrate(
        dataclasses.replace(problem, initial=start), choose_tableau(problem, rtol), 0.03 * rtol, scale,
        none, none.astype(bool), shadow=False,
    )  # fmt: skip
    if run.status is not Status.SUCCESS:
        raise SolveError(f"stopped at t = {run.t_failed:.10g} s: {run.status.value}")
    return run.state.y[:-1]
