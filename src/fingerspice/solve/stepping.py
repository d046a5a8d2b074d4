"""Own integration of a problem: windows of the source, a shadow run for the error, and global error control."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from fingerspice.engine import advance as loop
from fingerspice.engine.model import write_row
from fingerspice.engine.readout import TRIED
from fingerspice.engine.steps import Method
from fingerspice.numerics.tableaus import Tableau
from fingerspice.results.outcome import ErrorEstimate, State, Status, last_tried
from fingerspice.solve.problem import Problem
from fingerspice.solve.runs import (
    ROUNDING,
    BoolArray,
    FloatArray,
    Progress,
    Run,
    Tables,
    after_the_end,
    from_rows,
    last_row,
    row_width,
)
from fingerspice.waveforms.sampling import SourceTable

LOG_ROWS = 1024
# A fold stands where the shadow meets it as soon, relative; where no run does better, one with such an error, over the
# peak, is still believed.
FOLD_SPREAD, FOLD_ERROR = 1e-5, 0.01
# Steps taken and refused, the shadow's too, to begin with and over the run: what needs more has a cause that smaller
# steps do not mend.
FIRST_STEPS, MOST_STEPS = 20_000, 10_000_000
# The smallest local error, over the voltage scale, that another attempt is worth: the shadow's is near rounding.
FINEST = 1e-14
# The shadow run's tolerance over the main run's: far enough that their difference is the main run's error.
SHADOW = 0.03
# The estimate is the largest difference met in the middle and at the end of steps; between them it may be larger.
SAFETY = 3.0
# The local error allowed in a step, over the global error asked for. Errors of the past decay in a leaky stack.
LOCAL_SHARE = 0.2


@dataclass
class Track:
    """One integration in progress."""

    problem: Problem
    method: Method
    scale: FloatArray
    t_out: FloatArray
    left: BoolArray
    rows: FloatArray
    log: FloatArray
    y: FloatArray = field(init=False)
    control: FloatArray = field(init=False)
    counters: NDArray[np.int64] = field(init=False)
    tried: FloatArray = field(init=False)

    def __post_init__(self) -> None:
        start = self.problem.initial
        self.y = start.y.copy()
        self.control = np.zeros(loop.N_CONTROL)
        self.control[loop.T] = self.problem.t_start
        self.control[loop.START] = np.nan
        self.control[loop.U_BEFORE] = start.u_before
        self.control[loop.MARGIN] = 1.0
        if self.problem.model.mobile and abs(start.u_gap) > 0.0:
            self.control[loop.U_GAP], self.control[loop.SIGN] = start.u_gap, np.sign(start.u_gap)
        self.counters = np.zeros(loop.N_COUNTERS, np.int64)
        self.tried = np.zeros((TRIED, 4))

    @property
    def t(self) -> float:
        return float(self.control[loop.T])

    @property
    def steps(self) -> int:
        """Steps taken and refused."""
        return int(self.counters[loop.ACCEPTED] + self.counters[loop.REJECTED])

    @property
    def log_rows(self) -> FloatArray:
        return self.log[: self.counters[loop.LOGGED]]

    def advance(self, table: SourceTable, t_end: float) -> int:
        return int(
            loop.advance(
                self.problem.model, self.method, table.edges, table.terms, table.series, t_end, self.scale,
                self.y, self.control, self.counters, self.t_out, self.left, self.rows, self.log, self.tried,
            )
        )  # fmt: skip

    def follow(self, table: SourceTable, main: Track) -> int:
        """Go where `main` has gone, with outputs at its log times in `rows`."""
        self.t_out = np.ascontiguousarray(main.log_rows[:, 0])
        self.left = np.ones(self.t_out.size, bool)
        self.rows = np.full((self.t_out.size, self.rows.shape[1]), np.nan)
        self.counters[loop.OUTPUT] = 0
        return self.advance(table, main.t)

    def finish(self, table: SourceTable) -> None:
        """Write the right-hand outputs at the very end of the run."""
        pending = range(int(self.counters[loop.OUTPUT]), self.t_out.size)
        if not pending:
            return
        segment, tau = after_the_end(self.problem, table)
        u, du = loop.enter(self.problem.model, segment, tau, self.y, self.control)
        for i in pending:
            write_row(
                self.problem.model,
                u,
                du,
                self.y,
                self.control[loop.SIGN],
                self.control[loop.U_GAP],
                self.rows[i],
            )
            self.counters[loop.OUTPUT] += 1


def method_from(tableau: Tableau, problem: Problem, h_fixed: float = 0.0) -> Method:
    """A tableau as the compiled code takes it, its step bounded by the source's own time scale and the deck's TMAX."""
    # Zeros of the gap voltage are looked for at quarters of a step: four steps per period cannot hide one.
    h_max = min(0.25 * problem.waveform.shortest_time(), problem.max_step)
    # One memory layout for every tableau: another one would be another compilation.
    a, c, e, dense = (np.ascontiguousarray(x) for x in (tableau.a, tableau.c, tableau.e, tableau.dense))
    return Method(tableau.implicit, a, c, e, dense, tableau.n_end, tableau.error_order, h_max, h_fixed)


def integrate(
    problem: Problem,
    tableau: Tableau,
    tol: float,
    u_scale: float,
    t_out: FloatArray,
    left: BoolArray,
    *,
    tables: Tables | None = None,
    h_fixed: float = 0.0,
    shadow: bool = True,
    progress: Progress | None = None,
) -> Run:
    """Integrate once with local error `tol` * `u_scale` (V) per step.

    Parameters
    ----------
    problem : Problem
    tableau : Tableau
    tol, u_scale : float
        Local error over the voltage scale, and that scale in V.
    t_out, left : ndarray, shape (n_out,)
        Output times (s, ascending) and whether the left-hand value is meant.
    tables : Tables, optional
        The source's, where they are made already.
    h_fixed : float
        Fixed step in s, without error control, if positive.
    shadow : bool
        Whether to run a second integration for the error estimate.
    progress : callable, optional
        Called with the fraction of the run that is done.
    """
    tables = tables or Tables(problem, tol)
    width = row_width(problem)
    method = method_from(tableau, problem, h_fixed)
    z_scale = u_scale * problem.model.area0 / problem.model.s
    scale = tol * np.append(np.full(problem.stack.c.size - 1, u_scale), z_scale)
    rows = np.full((t_out.size, width), np.nan)
    log = np.empty((LOG_ROWS, 3))
    main = Track(problem, method, scale, t_out, left, rows, log)
    # Only voltages are compared.
    finer = np.append(SHADOW * scale[:-1], np.inf)
    other = Track(problem, method, finer, t_out[:0], left[:0], rows[:0], log[:0])
    meter = _Meter(problem)
    status, t_failed, last, spread = Status.SUCCESS, None, None, np.inf
    table = None
    for table in tables:
        code = loop.LOG_FULL
        while code == loop.LOG_FULL:
            code = main.advance(table, float(table.edges[-1])) if table.edges.size > 1 else loop.DONE
            if shadow and other.follow(table, main) == loop.TOO_MANY:
                code = loop.TOO_MANY
            meter.compare(main.log_rows, other.rows if shadow else None)
            done = (main.t - problem.t_start) / (problem.t_stop - problem.t_start)
            if progress is not None:
                progress(done)
            if code == loop.LOG_FULL and main.steps + other.steps > FIRST_STEPS + done * MOST_STEPS:
                code = loop.TOO_MANY
        if code in (loop.NO_SOLUTION, loop.STEP_UNDERFLOW, loop.TOO_MANY):
            folding = problem.model.mobile and problem.model.coupled
            status = Status.FOLD if folding else Status.STEP_UNDERFLOW
            status = Status.TOO_MANY_STEPS if code == loop.TOO_MANY else status
            t_failed = main.t
            if status is Status.FOLD and shadow and other.advance(table, float(table.edges[-1])) != loop.TOO_MANY:
                spread = abs(other.t - main.t)
            break
        if table.not_finite is not None:
            status, t_failed = Status.SOURCE_NOT_FINITE, table.not_finite
            break
    if status is Status.SUCCESS and table is not None:
        main.finish(table)
    elif table is not None and table.edges.size > 1:
        sign, u_gap = main.control[loop.SIGN], main.control[loop.U_GAP]
        last = last_row(problem, problem.model, table, main.t, main.y, sign, u_gap)
    c = main.counters
    n_out = int(c[loop.OUTPUT])
    t, side, rows = t_out[:n_out], left[:n_out], main.rows[:n_out]
    if last is not None and (n_out == 0 or main.t > t[-1]):
        # A failed run's arrays end at the time it reached.
        t, side, rows = np.append(t, main.t), np.append(side, True), np.vstack([rows, last])
    return Run(
        t,
        side,
        *from_rows(problem, rows),
        status=status,
        error=meter.error(),
        peak_u=meter.peak_u,
        peak_f=meter.peak_f,
        nfev=int(c[loop.NFEV] + other.counters[loop.NFEV]),
        stats={
            "steps": int(c[loop.ACCEPTED]),
            "rejected": int(c[loop.REJECTED]),
            "zeros": int(c[loop.ZEROS]),
            "nfev_solution": int(c[loop.NFEV]),
        },
        state=State(
            main.t,
            main.y.copy(),
            float(main.control[loop.U_BEFORE]),
            problem.initial.charge_offset,
            problem.scene.charge_law,
            float(main.control[loop.U_GAP]),
        ),
        t_failed=t_failed,
        margin=float(main.control[loop.MARGIN]),
        fold_spread=spread,
        tried=last_tried(main.tried),
        rough=tables.rough,
        unseen=tables.unseen,
    )


@dataclass
class _Meter:
    """Peaks of the run, and the largest difference between it and its shadow."""

    problem: Problem
    peak_u: float = 0.0
    peak_f: float = 0.0
    diff_u: float = 0.0
    diff_f: float = 0.0

    def compare(self, log: FloatArray, shadow_rows: FloatArray | None) -> None:
        if log.shape[0] == 0:
            return
        force = self.problem.scene.force(log[:, 1], log[:, 2])
        self.peak_u = max(self.peak_u, float(np.abs(log[:, 1]).max()))
        self.peak_f = max(self.peak_f, float(force.max()))
        if shadow_rows is None:
            return
        # The shadow may have stopped at a fold before the end of the log.
        n = int(np.count_nonzero(np.isfinite(shadow_rows[:, 1])))
        if n:
            other = self.problem.scene.force(shadow_rows[:n, 1], shadow_rows[:n, 2])
            self.diff_u = max(self.diff_u, float(np.abs(shadow_rows[:n, 1] - log[:n, 1]).max()))
            self.diff_f = max(self.diff_f, float(np.abs(other - force[:n]).max()))

    def error(self) -> ErrorEstimate:
        # Rounding is an error too, and two runs may share it.
        return ErrorEstimate(SAFETY * self.diff_u + 4e-16 * self.peak_u, SAFETY * self.diff_f + 4e-16 * self.peak_f)


def solve(
    problem: Problem,
    rtol: float,
    tableau: Tableau,
    t_out: FloatArray,
    left: BoolArray,
    progress: Progress | None = None,
) -> Run:
    """Integrate until the estimated global error is within `rtol` of the peaks.

    The first attempt's local tolerance is a guess; each further one follows from the error measured.
    """
    tables = Tables(problem, LOCAL_SHARE * rtol, t_out=t_out)
    u_scale = problem.scene.u_peak or tables.peak()
    u_scale = u_scale * problem.model.k_gap if np.isfinite(u_scale) and u_scale > 0.0 else 1.0
    u_scale = max(u_scale, float(np.abs(problem.initial.y[:-1]).max(initial=0.0)))
    tol = LOCAL_SHARE * rtol
    finest = min(FINEST, 0.05 * tol)
    nfev, before = 0, None
    for _attempt in range(6):
        run = integrate(problem, tableau, tol, u_scale, t_out, left, tables=tables, progress=progress)
        nfev += run.nfev
        run.nfev = nfev
        if run.status is Status.TOO_MANY_STEPS and before is not None:
            # Steps that small are held up by rounding: the attempt before is as good as it gets.
            run = before
            break
        if run.status is Status.FOLD:
            # A fold magnifies errors of the voltage.
            met = run.fold_spread <= FOLD_SPREAD * (run.state.t - problem.t_start)
            enough, less = met or run.error.u_gap <= rtol * run.peak_u, 0.01
        elif run.status is Status.SUCCESS:
            worst = run.excess(rtol)
            enough, less = worst <= 1.0, min(0.3, 0.5 / worst) if worst > 0.0 else 0.3
        else:
            return run
        if enough:
            return run
        if rtol * run.peak_u < ROUNDING * u_scale or tol <= finest:
            break
        tol, before = max(less * tol, finest), run
    # A fold that is met by a run that is half error may stand anywhere.
    if run.status is not Status.FOLD or run.error.u_gap > FOLD_ERROR * run.peak_u:
        run.status = Status.ERROR_NOT_MET
    return run
