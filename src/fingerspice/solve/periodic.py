"""The state that one period of a source leads back to, by Newton's method on the map of one period."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from fingerspice.base.arrays import FloatArray
from fingerspice.base.errors import InputError
from fingerspice.engine import march, shooting
from fingerspice.engine.model import choose_branch, gap_voltage
from fingerspice.engine.pace import Pace
from fingerspice.physics.contact import inverse_area
from fingerspice.results.outcome import ErrorEstimate, SolveError, State, Status
from fingerspice.solve.diagnosis import period_failure
from fingerspice.solve.period import CHARGING, Found, Period, Stopped, first_period
from fingerspice.solve.period_search import Search
from fingerspice.solve.problem import Problem
from fingerspice.solve.stackstate import StackState, from_stack, model_of
from fingerspice.solve.stepping import FINEST, LOCAL_SHARE, LONGEST_STEP, SAFETY
from fingerspice.solve.track import prepare_system
from fingerspice.waveforms.sampling import SourceTable, source_table


@dataclass(frozen=True)
class Closed:
    """A problem that starts from its periodic state, and what vouches for it.

    Attributes
    ----------
    problem : Problem
        From the first whole period after the source has settled, or from where it started if that is later.
    defect : float
        Largest change of a live voltage over a further period, V.
    map_slope : ndarray, shape (n, n)
        Derivative of the modes after a period by those before it, to about 1e-5; of areas with dynamics of their own
        too.
    memory : float
        Error of the periodic state over that of one period: what a slow mode collects over the periods it remembers.
    error : ErrorEstimate
        What the state may be off, as its effect on the gap voltage and the force of the period.
    periods : float
        Periods integrated.
    """

    problem: Problem
    defect: float
    map_slope: FloatArray
    memory: float
    error: ErrorEstimate
    periods: float


def close_period(problem: Problem, rtol: float) -> Closed:
    """Start a problem from its periodic state, keeping its length.

    The error asked for is that of the state alone, relative to the peaks over the period. Where rounding does not let
    it be met, the error stated says so.

    Raises
    ------
    InputError
        For sources without a common period.
    SolveError
        Where a period cannot be integrated, or the iteration does not close it.
    """
    if problem.waveform.period is None:
        raise InputError("the source has no period, so there is no periodic state to find")
    if problem.scene.stack is not None and problem.scene.coupled:
        initial, found = _shoot(problem, rtol)
    else:
        initial, found = _search(problem, rtol)
    moved = initial.t - problem.t_start
    started = dataclasses.replace(
        problem, t_start=initial.t, t_stop=problem.t_stop + moved, first=problem.first + moved, initial=initial,
        begun=found.gap_errors,
    )  # fmt: skip
    u_gap, f_el = map(float, found.gap_errors.max(axis=0, initial=0.0))
    return Closed(started, found.defect, found.map_slope, found.memory, ErrorEstimate(u_gap, f_el), found.periods)


def _search(problem: Problem, rtol: float) -> tuple[State, Found]:
    """The periodic state in closed form, or by one integration for every period tried."""
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
    # In closed form there is rounding only, which a run states itself.
    none = np.zeros((len(period.problem.network.fingers), 2))
    return x, np.zeros(0), Found(period.parts * defect, slope, 1.0, none, 1)


def _shoot(problem: Problem, rtol: float) -> tuple[State, Found]:
    """The periodic state of a stack, by compiled periods."""
    scene, waveform, model = problem.scene, problem.waveform, model_of(problem.scene)
    begin, half = first_period(problem), waveform.half_wave
    # A function's table is as fine as the outputs.
    key = ("period", begin, problem.step if scene.is_sampled else 0.0)
    if key not in scene.prepared:
        assert waveform.period is not None
        end = begin + (0.5 if half else 1.0) * waveform.period
        table = source_table(waveform, begin, end, 1e-13, problem.step)
        scene.prepared[key] = table, float(waveform.value(begin, "left"))
    table, before = scene.prepared[key]
    x, found = _close(problem, table, before, half, rtol)
    k_u, x_gap = model.k_gap * before, float(model.gap @ x)
    u_gap = float(gap_voltage(model, k_u, x_gap, choose_branch(model, before, x), k_u))
    offset = before / inverse_area(abs(u_gap), model.curve)[0] / model.s if model.mobile else 0.0
    state = from_stack(scene, StackState(begin, np.append(x, 0.0), before, u_gap, offset))
    return dataclasses.replace(state, sign=np.zeros(1)), found


def _close(problem: Problem, table: SourceTable, before: float, half: bool, rtol: float) -> tuple[FloatArray, Found]:
    """Live voltages (V) that a period leads back to, and what else is found; by half a period where that will do."""
    scene = problem.scene
    model, n = model_of(scene), model_of(scene).gap.size
    w, slope, counts, figures = np.zeros(n), np.zeros((n, n)), np.zeros(2, np.int64), np.zeros(shooting.N_FIGURES)
    turned = -1.0 if half else 1.0
    scale = scene.u_peak or 1.0
    longest = min(LONGEST_STEP * problem.waveform.shortest_time(), float(table.edges[-1] - table.edges[0]))
    prepared = prepare_system(scene, rtol)
    # A first guess: how much of the source's voltage the gap takes is known once a period has been closed.
    tol = LOCAL_SHARE * rtol * scale * model.k_gap
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
        errors, excess = _errors(figures, model.k_gap * scale, rtol)
        if excess <= 1.0 or pace.tol <= FINEST * scale:
            break
        tol = pace.tol * min(0.3, 0.5 / excess)
        known = True
    if code != shooting.CLOSED:
        status = Status.FOLD if model.mobile else Status.STEP_UNDERFLOW
        cause = ""
        if code == shooting.NOT_CLOSED:
            status = Status.NOT_PERIODIC
            cause = f"{status.cause}: {defect:.3g} V are left after a period"
        raise SolveError(period_failure(problem, status, None, cause))
    # Two halves: the second carries on at most what the first was off, and adds as much.
    parts = 2 if half else 1
    map_slope = slope @ slope if half else slope
    found = Found(parts * float(defect), map_slope, float(figures[6]), errors, int(counts[1]) / parts)
    return system.live[0] @ w, found


def _errors(figures: FloatArray, u_scale: float, rtol: float) -> tuple[FloatArray, float]:
    """Errors of the periodic state (1, 2), V and N, from the figures of its period, and their ratio to those asked for.

    Where the product of a peak with `rtol` underflows no error can be asked for.
    """
    peak_u, peak_f, error_u, error_f, left, _, memory = map(float, figures)
    # Rounding is an error too, and what Newton moved last was not much more than what it would move next.
    floor = 4e-16 * (peak_u + u_scale)
    steepest = 2.0 * peak_f / (peak_u or 1.0)
    u_error = memory * (SAFETY * error_u + floor) + left
    f_error = memory * (SAFETY * error_f + steepest * floor) + steepest * left
    pairs = ((u_error, rtol * peak_u), (f_error, rtol * peak_f))
    return np.array([[u_error, f_error]]), max(error / asked if asked > 0.0 else 0.0 for error, asked in pairs)
