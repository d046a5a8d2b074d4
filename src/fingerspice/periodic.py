"""The state that one period of a source leads back to, by Newton's method on the map of one period."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fingerspice.circuit.sampling import SourceTable, source_table
from fingerspice.engine import march, shooting
from fingerspice.errors import InputError, SolveError
from fingerspice.marching import LOCAL_SHARE, LONGEST_STEP, prepare_system
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
        Derivative of the live voltages after a period by those before it, to about 1e-3.
    periods : int
        Periods integrated.
    """

    problem: Problem
    defect: float
    map_slope: FloatArray
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
        scene.prepared[key] = source_table(waveform, begin, begin + waveform.period, 1e-13, problem.step)
    before = float(waveform.value(begin, "left"))
    x, defect, slope, counts = _close(problem, scene.prepared[key], before, rtol)
    moved = begin - problem.t_start
    initial = state_from(problem.model, begin, x, before, scene.charge_law)
    problem = dataclasses.replace(
        problem, t_start=begin, t_stop=problem.t_stop + moved, first=problem.first + moved, initial=initial
    )
    return Closed(problem, defect, slope, int(counts[1]))


def _close(
    problem: Problem, table: SourceTable, before: float, rtol: float
) -> tuple[FloatArray, float, FloatArray, NDArray[np.int64]]:
    """Live voltages (V) that a period leads back to, their change over it, the map's derivative, and the work."""
    scene = problem.scene
    n = problem.model.gap.size
    x, slope, counts = np.zeros(n), np.zeros((n, n)), np.zeros(2, np.int64)
    scale = scene.u_peak or 1.0
    longest = min(LONGEST_STEP * problem.waveform.shortest_time(), float(table.edges[-1] - table.edges[0]))
    pace = march.Pace(LOCAL_SHARE * rtol * scale * problem.model.k_gap, longest, True, False)
    prepared = prepare_system(scene, rtol)
    code, defect = march.OUT_OF_RANGE, 0.0
    while code == march.OUT_OF_RANGE:
        code, defect = shooting.close_period(
            prepared.system, pace, prepared.tables, prepared.work, prepared.integral, table.edges, table.terms,
            table.series, before, scale, x, slope, counts,
        )  # fmt: skip
        if code == march.OUT_OF_RANGE:
            prepared = prepare_system(scene, rtol, 1.5 * prepared.system.u_top)
            x[:] = 0.0
    if code == shooting.NOT_CLOSED:
        raise SolveError(f"the periodic state did not close: {defect:.3g} V are left after a period")
    if code != shooting.CLOSED:
        folding = problem.model.mobile and problem.model.coupled
        status = Status.FOLD if folding else Status.STEP_UNDERFLOW
        raise SolveError(f"no periodic state was reached: {status.value}")
    return x, float(defect), slope, counts
