"""The periodic state, which one period of the source maps to itself, by Newton's method on the map of one period."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from fingerspice.base.arrays import FloatArray
from fingerspice.base.errors import InputError
from fingerspice.engine import shooting
from fingerspice.engine.loopstate import OUT_OF_RANGE
from fingerspice.engine.model import choose_branch, gap_voltage
from fingerspice.engine.pace import Pace
from fingerspice.engine.stackstep import Stack
from fingerspice.physics.contact import inverse_area
from fingerspice.results.outcome import ErrorEstimate, SolveError, State, Status
from fingerspice.solve.initial import StackState, from_stack, model_of
from fingerspice.solve.period import CHARGING, Found, Period, Stopped, first_period
from fingerspice.solve.period_search import Search
from fingerspice.solve.problem import Problem
from fingerspice.solve.runs import period_failure
from fingerspice.solve.stepping import FINEST, LOCAL_SHARE, LONGEST_STEP, SAFETY
from fingerspice.solve.track import prepare_system
from fingerspice.waveforms.sampling import SourceTable, source_table

# In the search for a periodic state, the longest step allowed after each that was not good enough, over the last.
_SHORTER = 0.8
# Above this rtol the bound of what slow modes hold can be met, and alone is stated.
_BOUNDED = 1e-9


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


def _shoot(problem: Problem, rtol: float) -> tuple[State, Found]:
    """The periodic state of a stack, by a Newton search that is compiled as a whole."""
    scene, waveform, model = problem.scene, problem.waveform, model_of(problem.scene)
    begin, half = first_period(problem), waveform.half_wave
    # The table of a user's function is as fine as the outputs, so it is cached by the output step.
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
    """Live voltages (V) of the periodic state, and its figures; with `half`, the map is that of half a period."""
    scene = problem.scene
    model, n = model_of(scene), model_of(scene).gap.size
    w, slope, counts, figures = np.zeros(n), np.zeros((n, n)), np.zeros(2, np.int64), np.zeros(shooting.N_FIGURES)
    turned = -1.0 if half else 1.0
    scale = scene.u_peak or 1.0
    longest = min(LONGEST_STEP * problem.waveform.shortest_time(), float(table.edges[-1] - table.edges[0]))
    prepared = prepare_system(scene, rtol)
    # The first tolerance assumes the gap's capacitive share of the source's voltage; its peak is known only later.
    tol = LOCAL_SHARE * rtol * scale * model.k_gap
    last: _Closing | None = None
    best: _Closing | None = None
    while True:
        system = prepared.system
        if last is None:
            w = np.zeros(n)
        pace = Pace(max(tol, FINEST * scale), longest, True, False)
        code, defect = shooting.close_period(
            Stack(
                system, prepared.tables, prepared.work, prepared.integral, table.edges, table.terms, table.series
            ), pace, before, turned, scale, last is not None, w, slope, counts, figures,
        )  # fmt: skip
        if code == OUT_OF_RANGE:
            prepared = prepare_system(scene, rtol, 1.5 * system.u_top)
            last = best = None
            continue
        # Where chance in the steps, times the memory, is more than `tol`, Newton's last step says how much it is.
        if code != shooting.CLOSED and (last is None or code != shooting.NOT_CLOSED):
            break
        last = _judged(w.copy(), figures.copy(), float(defect), last, system.gap[0], model.k_gap * scale, rtol)
        best = last if best is None or last.excess < best.excess else best
        if last.excess <= 1.0 or pace.tol <= FINEST * scale:
            break
        # As a period without memory asks for; all steps are shorter, also those that `tol` does not limit.
        tol, longest = pace.tol * min(0.3, 0.5 / last.plain), _SHORTER * longest
    if best is None:
        status = Status.FOLD if model.mobile else Status.STEP_UNDERFLOW
        cause = ""
        if code == shooting.NOT_CLOSED:
            status = Status.NOT_PERIODIC
            cause = f"{status.cause}: {defect:.3g} V are left after a period"
        raise SolveError(period_failure(problem, status, None, cause))
    # The defect of two half periods is at most twice that of one: the map does not enlarge the first half's defect.
    parts = 2 if half else 1
    map_slope = slope @ slope if half else slope
    memory = float(best.figures[6])
    return system.live[0] @ best.w, Found(parts * best.defect, map_slope, memory, best.errors, int(counts[1]) / parts)


class _Closing(NamedTuple):
    """A periodic state: its modes (V), the figures of its period (`shooting.N_FIGURES`) and its defect (V).

    Then its errors (1, 2), V and N; the largest ratio of an error to the error asked for; and that ratio if no error
    were kept from earlier periods. A ratio counts as 0 where the error asked for, a peak times `rtol`, underflows to 0.
    """

    w: FloatArray
    figures: FloatArray
    defect: float
    errors: FloatArray
    excess: float
    plain: float


def _judged(
    w: FloatArray, figures: FloatArray, defect: float, coarser: _Closing | None, gap: FloatArray, u_scale: float,
    rtol: float,
) -> _Closing:  # fmt: skip
    """A periodic state with its errors, by those of its steps and by that found with longer steps.

    Slow modes may hold the errors of all periods within their memory, if these are alike; or they are off by what they
    have moved from the state found with longer steps. `gap` is the gap voltage by modes.
    """
    peak_u, peak_f, error_u, error_f, left, _, memory = map(float, figures)
    # Add round-off, and `left`, the last step of Newton's method, as an estimate of the error that remains after it.
    floor = memory * 4e-16 * (peak_u + u_scale)
    steepest = 2.0 * peak_f / (peak_u or 1.0)
    moved = np.inf
    if coarser is not None and rtol <= _BOUNDED:
        moved = SAFETY * float(np.abs(gap * (w - coarser.w)).sum())
    own = np.array([SAFETY * error_u + floor + left, SAFETY * error_f + steepest * (floor + left)])
    held = np.minimum((memory - 1.0) * SAFETY * np.array([error_u, error_f]), np.array([1.0, steepest]) * moved)
    asked = rtol * np.array([peak_u, peak_f])
    excess, plain = (float(np.divide(x, asked, where=asked > 0.0, out=np.zeros(2)).max()) for x in (own + held, own))
    return _Closing(w, figures, defect, (own + held)[None], excess, plain)
