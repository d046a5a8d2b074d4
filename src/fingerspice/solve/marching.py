"""Own integration by exponential collocation: the coupled tier, with its error followed step by step."""

from __future__ import annotations

import numpy as np

from fingerspice.engine import march, readout
from fingerspice.engine.pace import Pace
from fingerspice.results.outcome import ErrorEstimate, State, Status, last_tried
from fingerspice.solve.approach import leap
from fingerspice.solve.problem import Problem
from fingerspice.solve.runs import (
    ROUNDING,
    BoolArray,
    FloatArray,
    Progress,
    Run,
    Tables,
    from_rows,
    last_row,
)  # fmt: skip
from fingerspice.solve.settling import Settling
from fingerspice.solve.track import FINEST, SAFETY, Prepared, Track, prepare_system
from fingerspice.waveforms.sampling import SourceTable, same_time

# The error allowed in a step, over the one asked for: the force doubles it, and steps add up.
LOCAL_SHARE = 0.15
# Steps per shortest time scale of the source: the points of a step must not alias it.
LONGEST_STEP = 0.6


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
        model, control = prepared.system.model, track.control
        last = last_row(problem, model, table, track.t, track.y, control[readout.SIGN], control[readout.U_GAP])
    run = _run(problem, track, status, t_failed, last)
    run.rough, run.unseen = tables.rough, tables.unseen
    return run


def _through(track: Track, table: SourceTable, settling: Settling) -> int:
    """To the end of a table, or past it where a settled run repeats its last period."""
    end = float(table.edges[-1])
    while True:
        stop = min(settling.snapped(table.edges, settling.next), end)
        code = track.advance(table, stop)
        if code != march.DONE or stop < settling.next - same_time(stop):
            return code
        c = track.control
        if not settling.look(
            track.y[:-1], float(c[readout.MAGNIFIED]), float(c[readout.PEAK_U]), int(track.counters[readout.ACCEPTED])
        ):
            track.forget()
            if settling.may_leap:
                leap(track, table, settling)
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
            float(control[readout.U_GAP]),
        ),
        t_failed=t_failed,
        margin=float(control[readout.MARGIN]),
        tried=last_tried(track.tried),
        continuous=track.recorded(),
    )


def _charge_error(problem: Problem, track: Track, peak_u: float) -> float:
    """Estimated error of the charge, C; every step adds the rounding of the charge that a layer holds."""
    model = problem.model
    held = float(model.slow[-3]) * model.area0 * (problem.scene.u_peak + peak_u)
    steps = 1.0 + float(track.counters[readout.ACCEPTED])
    # Whatever the area's polynomial misses, all charge that is moved misses too.
    missed = track.prepared.area_error * (held + float(track.control[readout.PEAK_Q])) if model.coupled else 0.0
    # Twice as safe: what leaks between nodes is looked for at a few places only, and against the reference 1.7 times as
    # much was met in a stack that leaks fast throughout.
    return 2.0 * SAFETY * float(track.control[readout.ERROR_Q]) + 4e-16 * held * steps + missed


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
        # A peak that is no more than the error may yet turn out to be none.
        hopeless = rtol * run.peak_u < ROUNDING * u_scale and run.error.u_gap < run.peak_u
        if hopeless or tol <= FINEST or attempts == 6:
            run.status = Status.ERROR_NOT_MET
            return run
        # Steps that something else than their error kept short are shortened by a tolerance below what they made only.
        tol = min(tol * min(0.3, 0.5 / worst), 0.5 / worst * run.error.u_gap / u_scale)
