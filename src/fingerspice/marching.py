"""Own integration by exponential collocation: the coupled tier, with its error followed step by step."""

from __future__ import annotations

import dataclasses

import numpy as np

from fingerspice.circuit.sampling import SourceTable, same_time
from fingerspice.engine import advance, march, readout
from fingerspice.engine import repeat as repetition
from fingerspice.engine.exponential import Tables as StepTables
from fingerspice.engine.exponential import new_tables
from fingerspice.engine.march import Work
from fingerspice.engine.model import Segment, choose_branch, source, write_row
from fingerspice.engine.pace import Pace
from fingerspice.engine.system import System, area_range, build_system
from fingerspice.numerics.lobatto import integral_table
from fingerspice.outcome import ErrorEstimate, State, Status, last_tried
from fingerspice.problem import Problem, Scene
from fingerspice.runs import (
    ROUNDING,
    BoolArray,
    FloatArray,
    Progress,
    Run,
    Tables,
    after_the_end,
    from_rows,
    row_width,
)  # fmt: skip
from fingerspice.settling import Settling

# The largest error between nodes may stand beside the two points where it is looked for, and signs may cancel there.
SAFETY = 2.5
# The error allowed in a step, over the one asked for: the force doubles it, and steps add up.
LOCAL_SHARE = 0.15
# The smallest error of a step that is more than rounding, over the voltage scale.
FINEST = 4e-15
# Of 1/A, relative: finer, the polynomial would give way to the long series, which nobody's voltage can tell.
AREA_ROUNDING = 2e-14
# Steps per shortest time scale of the source: the points of a step must not alias it.
LONGEST_STEP = 0.6
# Steps of a period that is kept, at most: 1 MB.
KEPT_STEPS = 2000


@dataclasses.dataclass(frozen=True)
class Prepared:
    """A scene's system with the tables it has needed so far, and arrays to work in.

    Threads may share it: compiled code holds the interpreter's lock, and leaves nothing in `work` for its next call.
    """

    system: System
    tables: StepTables
    work: Work
    integral: FloatArray


def prepare_system(scene: Scene, rtol: float, u_top: float = 0.0) -> Prepared:
    """The modal system of a scene, made on first use; with the area's curve up to `u_top` (V) if that is given."""
    # One system serves a decade of tolerances.
    decade = int(np.floor(np.log10(rtol)))
    key = ("system", decade, u_top)
    if key not in scene.prepared:
        model = scene.model
        if u_top > 0.0:
            assert scene.stack.contact is not None
            model = model._replace(curve=scene.stack.contact.curve(u_top))
        contact = scene.stack.contact
        stress = 0.0 if contact is None else float(contact.stress(1.0))
        system = build_system(
            model, max(1e-3 * 10.0**decade, AREA_ROUNDING), area_range(model, max(scene.u_peak, u_top)),
            scene.stack.grouping, stress,
        )  # fmt: skip
        n = model.gap.size
        scene.prepared[key] = Prepared(system, new_tables(n), march.new_work(n), integral_table())
    prepared: Prepared = scene.prepared[key]
    return prepared


@dataclasses.dataclass
class Track:
    """One integration in progress; see `engine.march.march`."""

    problem: Problem
    prepared: Prepared
    pace: Pace
    t_out: FloatArray
    left: BoolArray

    def __post_init__(self) -> None:
        start = self.problem.initial
        n = self.problem.model.gap.size
        self.y = start.y.copy()
        self.error = np.zeros(n + 1)
        self.control = np.zeros(readout.N_CONTROL)
        self.control[readout.T] = self.problem.t_start
        self.control[readout.U_BEFORE] = start.u_before
        self.control[readout.BRANCH_LENGTH] = np.inf
        self.control[readout.MARGIN] = 1.0
        self.counters = np.zeros(readout.N_COUNTERS, np.int64)
        self.tried = np.zeros((readout.TRIED, 4))
        self.shown = self.prepared.system.k_shown.size
        self.out = np.empty((self.shown + 2 if self.pace.charge else self.shown, self.t_out.size))
        self.repeated = 0
        self.forget()

    @property
    def t(self) -> float:
        return float(self.control[readout.T])

    def advance(self, table: SourceTable, t_end: float) -> int:
        """March to `t_end` (s) through a table."""
        p = self.prepared
        mine = (self.y, self.error, self.control, self.counters)
        return int(
            march.march(
                p.system, self.pace, p.tables, p.work, p.integral, table.edges, table.terms, table.series, t_end,
                *mine, self.t_out, self.left, self.out, self.kept, self.tried,
            )
        )  # fmt: skip

    def forget(self) -> None:
        """Keep no steps."""
        self.kept = repetition.new_kept(0, self.out.shape[0])

    def keep(self) -> None:
        """Keep the steps that follow."""
        self.kept = repetition.new_kept(KEPT_STEPS, self.out.shape[0])
        self.counters[readout.KEPT] = 0
        self.before = float(self.y[-1]), float(self.control[readout.COLLECTED]), float(self.control[readout.SPREAD])

    @property
    def keeps_all(self) -> bool:
        """Whether all steps since `keep` are kept."""
        return 0 < int(self.counters[readout.KEPT]) <= len(self.kept.times)

    def repeat(self, settling: Settling) -> None:
        """Let the period that is kept stand for the whole ones that follow."""
        periods, period = settling.periods_left(self.t), settling.period
        charge, collected, spread = self.before
        drift = float(self.y[-1]) - charge
        drifts = np.zeros(self.out.shape[0])
        if self.pace.charge:
            drifts[-2] = drift
        first, kept = int(self.counters[readout.OUTPUT]), int(self.counters[readout.KEPT])
        self.counters[readout.OUTPUT] = repetition.repeat(
            self.kept, kept, period, periods, drifts, first, self.t_out, self.left, self.out
        )
        self.y[-1] += periods * drift
        self.control[readout.T] += periods * period
        self.control[readout.BRANCH_START] += periods * period
        self.control[readout.ERROR_U] += settling.remaining
        if self.control[readout.PEAK_U] > 0.0:
            steepest = 2.0 * self.control[readout.PEAK_F] / self.control[readout.PEAK_U]
            self.control[readout.ERROR_F] += settling.remaining * steepest
        if self.pace.charge:
            # What the kept period is off is off in every one that it stands for.
            model = self.prepared.system.model
            missed = self.control[readout.COLLECTED] - collected
            self.control[readout.COLLECTED] += periods * missed
            self.control[readout.ERROR_Q] += (
                periods * (abs(missed) + np.sqrt(self.control[readout.SPREAD] - spread))
                + float(model.slow[-3]) * model.area0 * settling.remaining
            )  # fmt: skip
        self.repeated = periods
        self.forget()

    def row(self, segment: Segment, tau: float, y: FloatArray) -> FloatArray:
        """A row of `write_row` from a state, `tau` s into a segment."""
        model = self.prepared.system.model
        row = np.empty(row_width(self.problem))
        u, du = source(segment, tau)
        write_row(model, u, du, y, choose_branch(model, u, y), model.k_gap * u, row)
        return row

    def finish(self, table: SourceTable) -> None:
        """Write the right-hand outputs at the very end of the run."""
        first = int(self.counters[readout.OUTPUT])
        if first == self.t_out.size:
            return
        segment, tau = after_the_end(self.problem, table)
        control = np.zeros(advance.N_CONTROL)
        control[advance.U_BEFORE] = self.control[readout.U_BEFORE]
        # Takes the charge of a jump that stands at the end; the state itself stays before it.
        y = self.y.copy()
        advance.enter(self.prepared.system.model, segment, tau, y, control)
        live, z, current = from_rows(self.problem, self.row(segment, tau, y)[None, :])
        n = live.shape[0]
        self.out[:n, first:] = live
        if self.pace.charge:
            self.out[n, first:] = z
            self.out[n + 1, first:] = current
        self.counters[readout.OUTPUT] = self.t_out.size

    def last(self, table: SourceTable) -> FloatArray | None:
        """Row at the time a failed run reached, left-hand; None before the first step."""
        if self.t <= self.problem.t_start:
            return None
        i = max(int(np.searchsorted(table.edges, self.t, side="left")) - 1, 0)
        start = float(table.edges[i])
        segment = Segment(start, float(table.edges[i + 1]) - start, table.terms[i], table.series[i])
        row = self.row(segment, self.t - start, self.y)
        return row if np.all(np.isfinite(row)) else None


def integrate(
    problem: Problem,
    prepared: Prepared,
    tol: float,
    t_out: FloatArray,
    left: BoolArray,
    tables: Tables,
    *,
    h_fixed: float = 0.0,
    repeat: bool = True,
    progress: Progress | None = None,
) -> Run | None:
    """Integrate once with an error of the gap voltage of `tol` (V) in every step.

    Parameters
    ----------
    problem : Problem
    prepared : Prepared
    tol : float
        V.
    t_out, left : ndarray, shape (n_out,)
        Output times (s, ascending) and whether the left-hand value is meant.
    tables : Tables
        The source's.
    h_fixed : float
        Fixed step in s, without error control, if positive.
    repeat : bool
        Whether one period may stand for those after it, once the state no longer changes from one to the next.
    progress : callable, optional
        Called with the fraction of the run that is done.

    Returns
    -------
    Run or None
        None where the gap voltage left the range of the area's curve.
    """
    span = problem.t_stop - problem.t_start
    longest = h_fixed or min(LONGEST_STEP * problem.waveform.shortest_time(), span, problem.max_step)
    track = Track(problem, prepared, Pace(tol, longest, h_fixed == 0.0, problem.charge), t_out, left)
    settling = Settling(problem, prepared.system.rates, tol)
    if h_fixed > 0.0 or not repeat:
        settling.next = np.inf
    status, t_failed, last = Status.SUCCESS, None, None
    tables.done = -np.inf
    table = None
    for table in tables:
        code = _through(track, table, settling) if table.edges.size > 1 else march.DONE
        tables.done = track.t
        if progress is not None:
            progress((track.t - problem.t_start) / span)
        if code == march.OUT_OF_RANGE:
            return None
        if code in (march.NO_STEP, march.TOO_MANY):
            folding = problem.model.mobile and problem.model.coupled
            status = Status.FOLD if folding else Status.STEP_UNDERFLOW
            status = Status.TOO_MANY_STEPS if code == march.TOO_MANY else status
            t_failed = track.t
            break
        if table.not_finite is not None:
            status, t_failed = Status.SOURCE_NOT_FINITE, table.not_finite
            break
    if status is Status.SUCCESS and table is not None:
        track.finish(table)
    elif table is not None and table.edges.size > 1:
        last = track.last(table)
    run = _run(problem, track, status, t_failed, last)
    run.rough, run.unseen = tables.rough, tables.unseen
    return run


def _through(track: Track, table: SourceTable, settling: Settling) -> int:
    """To the end of a table, or past it where a settled run repeats its last period."""
    end = float(table.edges[-1])
    while True:
        stop = min(settling.snapped(table.edges), end)
        code = track.advance(table, stop)
        if code != march.DONE or stop < settling.next - same_time(stop):
            return code
        if not settling.look(track.y[:-1], float(track.control[readout.MAGNIFIED])):
            track.forget()
        elif track.keeps_all:
            track.repeat(settling)
            settling.next = np.inf
        elif track.kept.times.size:
            # Too many steps to keep: it goes on as it is.
            track.forget()
            settling.next = np.inf
        else:
            track.keep()
        if track.t >= end:
            return code


def _run(problem: Problem, track: Track, status: Status, t_failed: float | None, last: FloatArray | None) -> Run:
    c, control = track.counters, track.control
    n, n_out = track.shown, int(c[readout.OUTPUT])
    t, side, out = track.t_out[:n_out], track.left[:n_out], track.out[:, :n_out]
    if last is not None and (n_out == 0 or track.t > t[-1]):
        # A failed run's arrays end at the time it reached.
        live, z, current = from_rows(problem, last[None, :])
        extra = np.vstack([live, z, current]) if track.pace.charge else live
        t, side, out = np.append(t, track.t), np.append(side, True), np.hstack([out, extra])
    peak_u, peak_f = float(control[readout.PEAK_U]), float(control[readout.PEAK_F])
    # Rounding is an error too.
    floor = 4e-16 * (peak_u + problem.model.k_gap * problem.scene.u_peak)
    return Run(
        t,
        side,
        out[:n],
        out[n] if track.pace.charge else None,
        out[n + 1] if track.pace.charge else None,
        status=status,
        error=ErrorEstimate(
            SAFETY * float(control[readout.ERROR_U]) + floor,
            SAFETY * float(control[readout.ERROR_F]) + 2.0 * floor / (peak_u or 1.0) * peak_f,
            _charge_error(problem, track, peak_u) if track.pace.charge else None,
        ),
        peak_u=peak_u,
        peak_f=peak_f,
        nfev=int(c[readout.NFEV]),
        stats={
            "steps": int(c[readout.ACCEPTED]),
            "rejected": int(c[readout.REJECTED]),
            "zeros": int(c[readout.ZEROS]),
            "repeated": track.repeated,
        },
        state=State(
            track.t,
            track.y.copy(),
            float(control[readout.U_BEFORE]),
            problem.initial.charge_offset,
            problem.scene.charge_law,
        ),
        t_failed=t_failed,
        margin=float(control[readout.MARGIN]),
        tried=last_tried(track.tried),
    )


def _charge_error(problem: Problem, track: Track, peak_u: float) -> float:
    """Estimated error of the charge, C; every step adds the rounding of the charge that a layer holds."""
    model = problem.model
    held = float(model.slow[-3]) * model.area0 * (problem.scene.u_peak + peak_u)
    steps = 1.0 + float(track.counters[readout.ACCEPTED])
    # Twice as safe: what leaks between nodes is looked for at a few places only, and against the reference 1.7 times as
    # much was met in a stack that leaks fast throughout.
    return 2.0 * SAFETY * float(track.control[readout.ERROR_Q]) + 4e-16 * held * steps


def solve(
    problem: Problem,
    rtol: float,
    t_out: FloatArray,
    left: BoolArray,
    progress: Progress | None = None,
    *,
    repeat: bool = True,
) -> Run:
    """Integrate until the estimated global error is within `rtol` of the peaks.

    The first attempt's tolerance is a guess; each further one follows from the error estimated.
    """
    scene, model = problem.scene, problem.model
    tables = Tables(problem, LOCAL_SHARE * rtol, t_out=t_out)
    peak = scene.u_peak or tables.peak()
    start = float(np.abs(problem.initial.y[:-1]).max(initial=0.0))
    u_scale = max(peak * model.k_gap if np.isfinite(peak) else 0.0, start) or 1.0
    tol = LOCAL_SHARE * rtol
    prepared, nfev, attempts = prepare_system(scene, rtol), 0, 0
    while True:
        local = max(tol, FINEST) * u_scale
        run = integrate(problem, prepared, local, t_out, left, tables, repeat=repeat, progress=progress)
        if run is None:
            prepared = prepare_system(scene, rtol, 1.5 * prepared.system.u_top)
            continue
        nfev += run.nfev
        run.nfev = nfev
        attempts += 1
        worst = run.excess(rtol)
        if run.status is not Status.SUCCESS or worst <= 1.0:
            return run
        if rtol * run.peak_u < ROUNDING * u_scale or tol <= FINEST or attempts == 6:
            run.status = Status.ERROR_NOT_MET
            return run
        tol = tol * min(0.3, 0.5 / worst)
