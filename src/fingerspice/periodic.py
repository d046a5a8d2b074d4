"""Periodic state of a circuit under a periodic source, found directly, with its certificate and its stability."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fingerspice.circuit.circuit import Circuit
from fingerspice.circuit.sampling import source_table
from fingerspice.circuit.waveforms import require
from fingerspice.engine import march, shooting
from fingerspice.errors import InputError, SolveError
from fingerspice.marching import LONGEST_STEP, prepare_system
from fingerspice.problem import Problem, prepare, state_from
from fingerspice.simulation import RTOL_RANGE, run_problem
from fingerspice.solution import Solution, Status

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class SteadyState:
    """One period of the periodic state, and what vouches for it.

    Attributes
    ----------
    solution : Solution
        Over one period, from the first whole period after the source has settled.
    defect : float
        Largest change of a layer voltage over a further period, V.
    multipliers : ndarray, shape (n_layer - 1,)
        Sizes of the Floquet multipliers: what a period leaves of a small disturbance, by mode, to about 1e-3.
    periods : int
        Periods integrated to find it.
    """

    solution: Solution
    defect: float
    multipliers: FloatArray
    periods: int

    @property
    def stability_margin(self) -> float:
        """One less the largest multiplier: 0 where a disturbance stays for ever."""
        return 1.0 - float(self.multipliers.max(initial=0.0))


def steady_state(
    circuit: Circuit,
    *,
    charge_law: str | None = None,
    area: str | float = "coupled",
    rtol: float = 1e-8,
    points: int = 200,
    charge: bool = True,
) -> SteadyState:
    """Periodic state of a circuit, by Newton's method on the map of one period.

    Parameters
    ----------
    circuit : Circuit
        With a periodic source.
    charge_law, area, rtol, charge
        As in `simulate`.
    points : int
        Output steps in the period.

    Returns
    -------
    SteadyState

    Raises
    ------
    InputError
        For a source without a period.
    SolveError
        Where a period cannot be integrated, or the iteration does not close it.
    """
    require(RTOL_RANGE[0] <= rtol <= RTOL_RANGE[1], "rtol", rtol, "1e-13 to 0.1")
    problem = circuit.remember(("period", charge_law, area), lambda: _one_period(circuit, charge_law, area))
    problem = dataclasses.replace(problem, step=(problem.t_stop - problem.t_start) / points, charge=charge)
    before = problem.initial.u_before
    x, defect, slope, counts = _close(problem, before, rtol)
    law = problem.scene.charge_law
    problem = dataclasses.replace(problem, initial=state_from(problem.model, problem.t_start, x, before, law))
    solution = run_problem(problem, rtol=rtol)
    if not solution.success:
        raise SolveError(solution.message, solution)
    multipliers = np.abs(np.linalg.eigvals(slope)) if x.size else np.zeros(0)
    return SteadyState(solution, defect, multipliers, int(counts[1]))


def _one_period(circuit: Circuit, charge_law: str | None, area: str | float) -> Problem:
    """The first whole period after the source has settled, its `initial` holding the source just before it."""
    problem = prepare(circuit, t_stop=1.0, t_eval=None, charge_law=charge_law, area=area, start="uncharged")
    waveform = problem.waveform
    if waveform.period is None:
        raise InputError("the source has no period, so there is no periodic state to find")
    begin = waveform.period * float(np.ceil(waveform.settled / waveform.period))
    problem = prepare(
        circuit, t_stop=begin + waveform.period, t_eval=None, charge_law=charge_law, area=area, start="uncharged"
    )
    initial = dataclasses.replace(problem.initial, t=begin, u_before=float(waveform.value(begin, "left")))
    return dataclasses.replace(problem, t_start=begin, t_stop=begin + waveform.period, first=begin, initial=initial)


def _close(problem: Problem, before: float, rtol: float) -> tuple[FloatArray, float, FloatArray, NDArray[np.int64]]:
    """Live voltages (V) that a period leads back to, their change over it, the map's derivative, and the work."""
    scene = problem.scene
    n = problem.model.gap.size
    x, slope, counts = np.zeros(n), np.zeros((n, n)), np.zeros(2, np.int64)
    scale = scene.u_peak or 1.0
    table = source_table(problem.waveform, problem.t_start, problem.t_stop, 0.05 * rtol, problem.step)
    span = problem.t_stop - problem.t_start
    longest = min(LONGEST_STEP * problem.waveform.shortest_time(), span)
    pace = march.Pace(0.1 * rtol * scale * problem.model.k_gap, longest, True, False)
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
