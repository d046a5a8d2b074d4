"""The state that one period of a source leads back to, by Newton's method on the map of one period."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fingerspice.circuit.sampling import SourceTable, source_table
from fingerspice.engine import march, shooting
from fingerspice.engine.pace import Pace
from fingerspice.engine.system import System
from fingerspice.errors import InputError, SolveError
from fingerspice.marching import LOCAL_SHARE, LONGEST_STEP, prepare_system
from fingerspice.numerics import linear
from fingerspice.problem import Problem, state_from
from fingerspice.solution import Status

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class Closed:
    """A problem that starts from its periodic state, and what vouches for it.

    Attributes
    ----------
    problem : Problem
        From the first whole period after the source has settled, or from where it started if that is later.
    defect : float
        Largest change of a live voltage over a further period, V.
    map_slope : ndarray, shape (n_layer - 1, n_layer - 1)
        Derivative of the modes after a period by those before it, to about 1e-6.
    memory : float
        Error of the periodic state over that of one period: what a slow mode collects over the periods it remembers.
    periods : int
        Periods integrated.
    """

    problem: Problem
    defect: float
    map_slope: FloatArray
    memory: float
    periods: int


def close_period(problem: Problem, rtol: float) -> Closed:
    """Start a problem from its periodic state, keeping its length.

    Raises
    ------
    InputError
        For a source without a period.
    SolveError
        Where a period cannot be integrated, or the iteration does not close it.
    """
    scene, waveform = problem.scene, problem.waveform
    if waveform.period is None:
        raise InputError("the source has no period, so there is no periodic state to find")
    begin = waveform.period * float(np.ceil(max(waveform.settled, problem.t_start) / waveform.period))
    key = ("period", begin)
    if key not in scene.prepared:
        scene.prepared[key] = source_table(
            waveform, begin, begin + waveform.period, 1e-13, problem.step, no_chirps=not problem.model.coupled
        )
    before = float(waveform.value(begin, "left"))
    if problem.model.coupled:
        x, defect, slope, memory, periods = _close(problem, scene.prepared[key], before, rtol)
    else:
        x, defect, slope, memory, periods = _close_linear(problem, scene.prepared[key], rtol)
    moved = begin - problem.t_start
    initial = state_from(problem.model, begin, x, before, scene.charge_law)
    problem = dataclasses.replace(
        problem, t_start=begin, t_stop=problem.t_stop + moved, first=problem.first + moved, initial=initial
    )
    return Closed(problem, defect, slope, memory, periods)


def _close(
    problem: Problem, table: SourceTable, before: float, rtol: float
) -> tuple[FloatArray, float, FloatArray, float, int]:
    """Live voltages (V) that a period leads back to; see `Closed` for the rest."""
    scene = problem.scene
    n = problem.model.gap.size
    w, slope, counts = np.zeros(n), np.zeros((n, n)), np.zeros(2, np.int64)
    scale = scene.u_peak or 1.0
    longest = min(LONGEST_STEP * problem.waveform.shortest_time(), float(table.edges[-1] - table.edges[0]))
    prepared = prepare_system(scene, rtol)
    # Largest V that the state itself is allowed to be off.
    tol = LOCAL_SHARE * rtol * scale * problem.model.k_gap
    share = 1.0
    while True:
        system = prepared.system
        pace = Pace(max(share * tol, 1e-15 * scale), longest, True, False)
        code, defect = shooting.close_period(
            system, pace, prepared.tables, prepared.work, prepared.integral, table.edges, table.terms, table.series,
            before, scale, w, slope, counts,
        )  # fmt: skip
        if code == march.OUT_OF_RANGE:
            prepared = prepare_system(scene, rtol, 1.5 * system.u_top)
            w[:] = 0.0
            continue
        memory = _memory(system, slope)
        if code != shooting.CLOSED or share * memory <= 2.0 or pace.tol <= 1e-15 * scale:
            break
        share = 1.0 / memory
    if code == shooting.NOT_CLOSED:
        raise SolveError(f"the periodic state did not close: {defect:.3g} V are left after a period")
    if code != shooting.CLOSED:
        folding = problem.model.mobile and problem.model.coupled
        status = Status.FOLD if folding else Status.STEP_UNDERFLOW
        raise SolveError(f"no periodic state was reached: {status.value}")
    return system.live[0] @ w, float(defect), slope, memory, int(counts[1])


def _close_linear(
    problem: Problem, table: SourceTable, rtol: float
) -> tuple[FloatArray, float, FloatArray, float, int]:
    """As `_close`, in closed form, for an area that does not follow the voltage."""
    system = prepare_system(problem.scene, rtol).system
    rates, gains = system.rates[0], system.gain[0]
    w = linear.periodic_state(rates, gains, table.edges, table.terms, table.series)
    # A mode that does not decay keeps what it starts with.
    w = np.where(rates > 0.0, w, 0.0)
    _, end = linear.respond(rates, gains, table.edges, table.terms, table.series, w, np.empty(0))
    live = system.live[0]
    defect = float(np.abs(live @ (end - w)).max(initial=0.0))
    return live @ w, defect, np.diag(np.exp(-rates * (table.edges[-1] - table.edges[0]))), 1.0, 1


def _memory(system: System, slope: FloatArray) -> float:
    """Largest factor by which an error of the live voltages made in every period grows until it is periodic.

    Modes that do not decay keep what they start with: nothing is collected there.
    """
    decaying = system.rates[0] > 0.0
    if not decaying.any():
        return 1.0
    solver = np.linalg.inv(np.eye(int(decaying.sum())) - slope[np.ix_(decaying, decaying)])
    in_volts = system.live[0][:, decaying] @ solver @ system.project[0][decaying]
    return max(1.0, float(np.abs(in_volts).sum(axis=1).max()))
