"""The state that one period of a source leads back to, by Newton's method on the map of one period."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from fingerspice.base.errors import InputError
from fingerspice.engine import march, shooting
from fingerspice.engine.pace import Pace
from fingerspice.numerics import linear
from fingerspice.results.outcome import ErrorEstimate, Failure, SolveError, Status
from fingerspice.solve.marching import LOCAL_SHARE, LONGEST_STEP
from fingerspice.solve.networks import NetworkProblem
from fingerspice.solve.problem import Problem, state_from
from fingerspice.solve.track import FINEST, SAFETY, prepare_system
from fingerspice.waveforms.sampling import SourceTable, source_table

FloatArray = NDArray[np.float64]
AnyProblem = TypeVar("AnyProblem", Problem, NetworkProblem)


@dataclass(frozen=True)
class Closed(Generic[AnyProblem]):
    """A problem that starts from its periodic state, and what vouches for it.

    Attributes
    ----------
    problem : Problem or NetworkProblem
        From the first whole period after the source has settled, or from where it started if that is later.
    defect : float
        Largest change of a live voltage over a further period, V.
    map_slope : ndarray, shape (n, n)
        Derivative of the modes after a period by those before it, to about 1e-5; of a network's areas with dynamics of
        their own too.
    memory : float
        Error of the periodic state over that of one period: what a slow mode collects over the periods it remembers.
    error : ErrorEstimate
        What the state may be off, as its effect on the gap voltage and the force of the period.
    periods : float
        Periods integrated.
    """

    problem: AnyProblem
    defect: float
    map_slope: FloatArray
    memory: float
    error: ErrorEstimate
    periods: float


def close_period(problem: Problem, rtol: float) -> Closed[Problem]:
    """Start a problem from its periodic state, keeping its length.

    The error asked for is that of the state alone, relative to the peaks over the period. Where rounding does not let
    it be met, the error stated says so.

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
    half = waveform.half_wave and problem.model.coupled
    # A function's table is as fine as the outputs.
    key = ("period", begin, problem.step if scene.is_sampled else 0.0)
    if key not in scene.prepared:
        end = begin + (0.5 if half else 1.0) * waveform.period
        table = source_table(waveform, begin, end, 1e-13, problem.step, no_chirps=not problem.model.coupled)
        scene.prepared[key] = table, float(waveform.value(begin, "left"))
    table, before = scene.prepared[key]
    if problem.model.coupled:
        x, found = _close(problem, table, before, half, rtol)
    else:
        x, found = _close_linear(problem, table, rtol)
    moved = begin - problem.t_start
    initial = state_from(problem.model, begin, x, before, scene.charge_law)
    problem = dataclasses.replace(
        problem, t_start=begin, t_stop=problem.t_stop + moved, first=problem.first + moved, initial=initial
    )
    return Closed(problem, **found)


def _close(
    problem: Problem, table: SourceTable, before: float, half: bool, rtol: float
) -> tuple[FloatArray, dict[str, Any]]:
    """Live voltages (V) that a period leads back to, and the rest of `Closed`; by half a period where that will do."""
    scene = problem.scene
    n = problem.model.gap.size
    w, slope, counts, figures = np.zeros(n), np.zeros((n, n)), np.zeros(2, np.int64), np.zeros(shooting.N_FIGURES)
    turned = -1.0 if half else 1.0
    scale = scene.u_peak or 1.0
    longest = min(LONGEST_STEP * problem.waveform.shortest_time(), float(table.edges[-1] - table.edges[0]))
    prepared = prepare_system(scene, rtol)
    # A first guess: how much of the source's voltage the gap takes is known once a period has been closed.
    tol = LOCAL_SHARE * rtol * scale * problem.model.k_gap
    known = False
    while True:
        system = prepared.system
        if not known:
            w = np.zeros(n)
        pace = Pace(max(tol, FINEST * scale), longest, True, False)
        code, defect = shooting.close_period(
            system, pace, prepared.tables, prepared.work, prepared.integral, table.edges, table.terms, table.series,
            before, turned, scale, known, w, slope, counts, figures,
        )  # fmt: skip
        if code == march.OUT_OF_RANGE:
            prepared = prepare_system(scene, rtol, 1.5 * system.u_top)
            known = False
            continue
        if code != shooting.CLOSED:
            break
        error, excess = _error(figures, problem.model.k_gap * scale, rtol)
        if excess <= 1.0 or pace.tol <= FINEST * scale:
            break
        tol = pace.tol * min(0.3, 0.5 / excess)
        known = True
    if code != shooting.CLOSED:
        raise SolveError(_failure(problem, code, float(defect)))
    # Two halves: the second carries on at most what the first was off, and adds as much.
    parts = 2 if half else 1
    return system.live[0] @ w, {
        "defect": parts * float(defect), "map_slope": slope @ slope if half else slope,
        "memory": float(figures[6]), "error": error, "periods": int(counts[1]) / parts,
    }  # fmt: skip


def _failure(problem: Problem, code: int, defect: float) -> Failure:
    """Why no periodic state was reached."""
    status = Status.NOT_PERIODIC
    cause = f"{status.cause}: {defect:.3g} V are left after a period"
    if code != shooting.NOT_CLOSED:
        status = Status.FOLD if problem.model.mobile and problem.model.coupled else Status.STEP_UNDERFLOW
        cause = f"no periodic state was reached: {status.cause}"
    layers = problem.stack.layers
    return Failure(status, cause, status.action, element=layers[problem.scene.probe_layer].name if layers else "")


def _error(figures: FloatArray, u_scale: float, rtol: float) -> tuple[ErrorEstimate, float]:
    """Error of the periodic state from the figures of its period, and that error over the one asked for."""
    peak_u, peak_f, error_u, error_f, left, _, memory = map(float, figures)
    # Rounding is an error too, and what Newton moved last was not much more than what it would move next.
    floor = 4e-16 * (peak_u + u_scale)
    steepest = 2.0 * peak_f / (peak_u or 1.0)
    error = ErrorEstimate(
        memory * (SAFETY * error_u + floor) + left, memory * (SAFETY * error_f + steepest * floor) + steepest * left
    )
    return error, error.excess(rtol, peak_u, peak_f)


def _close_linear(problem: Problem, table: SourceTable, rtol: float) -> tuple[FloatArray, dict[str, Any]]:
    """As `_close`, in closed form, for an area that does not follow the voltage."""
    system = prepare_system(problem.scene, rtol).system
    rates, gains = system.rates[0], system.gain[0]
    w = linear.periodic_state(rates, gains, table.edges, table.terms, table.series)
    # A mode that does not decay keeps what it starts with.
    w = np.where(rates > 0.0, w, 0.0)
    _, end = linear.respond(rates, gains, table.edges, table.terms, table.series, w, np.empty(0))
    live = system.live[0]
    defect = float(np.abs(live @ (end - w)).max(initial=0.0))
    slope = np.diag(np.exp(-rates * (table.edges[-1] - table.edges[0])))
    # In closed form there is rounding only, which a run states itself.
    return live @ w, {
        "defect": defect, "map_slope": slope, "memory": 1.0, "error": ErrorEstimate(0.0, 0.0), "periods": 1,
    }  # fmt: skip
