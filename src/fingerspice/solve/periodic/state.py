"""The periodic state, which one period of the source maps to itself, by Newton's method on the map of one period."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from fingerspice.base.arrays import FloatArray
from fingerspice.base.errors import InputError
from fingerspice.results.outcome import ErrorEstimate, SolveError, State, Status
from fingerspice.solve.periodic.period import CHARGING, Found, Period, Stopped
from fingerspice.solve.periodic.search import Search
from fingerspice.solve.problem import Problem
from fingerspice.solve.runs import period_failure


@dataclass(frozen=True)
class Closed:
    """A problem that starts from its periodic state, with the error of that state."""

    # It starts with the first whole period after the source has become periodic, not before its original start
    problem: Problem
    defect: float  # Largest change of a live voltage over a further period, V
    # (n, n): Jacobian matrix of the period map, to about 1e-5; its variables are the modes and the areas with a time
    # constant
    map_slope: FloatArray
    # Error of the periodic state relative to the error of one period: a slow mode accumulates the errors of the periods
    # within its memory
    memory: float
    error: ErrorEstimate  # Error of the state, as its effect on the gap voltage and the force of the period
    periods: float  # Number of periods integrated


def close_period(problem: Problem, rtol: float) -> Closed:
    """Start a problem from its periodic state, keeping its length.

    `rtol` bounds the error of the state alone, relative to the peaks over the period. Where round-off exceeds it, the
    stated error is larger than `rtol`, and no error is raised.

    Raises
    ------
    InputError
        For sources without a common period.
    SolveError
        Where a period cannot be integrated, or Newton's method does not converge.
    """
    if problem.waveform.period is None:
        raise InputError("the source has no period, so there is no periodic state to find")
    initial, found = _search(problem, rtol)
    moved = initial.t - problem.t_start
    started = dataclasses.replace(
        problem, t_start=initial.t, t_stop=problem.t_stop + moved, first=problem.first + moved, initial=initial,
        begun=found.gap_errors,
    )  # fmt: skip
    u_gap, f_el = map(float, found.gap_errors.max(axis=0, initial=0.0))
    return Closed(started, found.defect, found.map_slope, found.memory, ErrorEstimate(u_gap, f_el), found.periods)


def _search(problem: Problem, rtol: float) -> tuple[State, Found]:
    """The periodic state of any circuit: in closed form, or by a Newton search with one integration per iterate."""
    try:
        period = Period(problem)
        x, areas, found = Search(period, rtol).close() if problem.scene.coupled else _closed_form(period)
    except Stopped as stopped:
        raise SolveError(period_failure(problem, stopped.status, stopped.t)) from None
    y = np.concatenate([x, areas, np.zeros(period.before.size)])
    sign = np.zeros(problem.scene.net.gap.size)
    return State(period.begin, y, period.before, sign, problem.scene.charge_law), found


def _closed_form(period: Period) -> tuple[FloatArray, FloatArray, Found]:
    """Live voltages (V) of the periodic state of a circuit with fixed areas."""
    modes = period.modes
    start, end, _ = period.linear_state(modes)
    if not np.all(np.isfinite(start)):
        raise SolveError(period_failure(period.problem, Status.NOT_PERIODIC, None, CHARGING))
    sign = 1.0 if period.parts == 1 else -1.0
    defect = float(np.abs(modes.shape @ (sign * end - start)).max(initial=0.0))
    slope = np.diag(np.exp(-period.rates * period.span * period.parts))
    x = period.voltages(start + period.kept)
    # The only error of the closed form is round-off, which the run adds to its stated error itself.
    none = np.zeros((len(period.problem.network.fingers), 2))
    return x, np.zeros(0), Found(period.parts * defect, slope, 1.0, none, 1)
