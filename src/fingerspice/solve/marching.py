"""Integration by our own exponential steps, repeated with smaller tolerances until the stated error is met."""

from __future__ import annotations

from fingerspice.results.outcome import Status
from fingerspice.solve.many_areas import March
from fingerspice.solve.one_area import Track, scale_of
from fingerspice.solve.problem import Problem, Tables
from fingerspice.solve.runs import Progress, Run, integrate
from fingerspice.solve.stepping import FINEST, LOCAL_SHARE, OutOfRangeError

ATTEMPTS = 6
# Voltage scale of a circuit whose sources give none, before any voltage has been computed, V.
GUESS = 1.0


def stepping(problem: Problem, rtol: float, tol: float, u_scale: float, top: float, repeat: bool) -> Track | March:
    """An integration with an error of `tol` times `u_scale` (V) in every step, in a run that is asked for `rtol`.

    A stack's area curve reaches `top` (V) if that is above 0.
    """
    if problem.scene.stack is None:
        return March(problem, rtol, tol, u_scale, repeat)
    return Track(problem, rtol, tol * u_scale, top, repeat)


def solve(problem: Problem, rtol: float, progress: Progress | None = None, *, repeat: bool = True) -> Run:
    """Integrate until the stated error is within `rtol` of the peaks of every gap's voltage and force.

    The tolerance of the first attempt is a guess; each further one follows from the previous attempt's stated error.
    With `repeat`, later periods may repeat one period, once the state no longer changes from one to the next.
    """
    tables = Tables(problem, LOCAL_SHARE * rtol)
    is_stack = problem.scene.stack is not None
    met = tables.peak() if is_stack or problem.scene.is_sampled else 0.0
    u_scale = scale_of(problem, met) if is_stack else max(problem.largest, met) or GUESS
    tol, top, nfev, attempts, tries_out = LOCAL_SHARE * rtol, 0.0, 0, 0, True
    # The voltages of sources that cancel are rounding errors of those of their parts.
    finest = FINEST * max(1.0, problem.scene.u_size / u_scale)
    while True:
        one = stepping(problem, rtol, max(tol, finest), u_scale, top, repeat)
        if tries_out:
            one.try_out(rtol)
        try:
            run = integrate(one, tables, progress)
        except OutOfRangeError as error:
            top = 1.5 * error.top
            continue
        run.by_layer = True
        run.end_where_it_stopped()
        nfev += run.nfev
        run.nfev = nfev
        run.stats["repeated"] = one.repeated
        run.continuous = one.recorded()
        one.stated(run)
        attempts += 1
        worst = run.excess(problem.rounding) / rtol
        # A trial (`try_out`) that predicts too large an error stops the run early, with ERROR_NOT_MET.
        is_whole = run.status is not Status.ERROR_NOT_MET
        if is_whole and (run.status is not Status.SUCCESS or worst <= 1.0):
            return run
        peak = float(run.gaps[:, 0].max(initial=0.0))
        # A peak smaller than its own error may still vanish with a finer tolerance, so that case is not hopeless.
        hopeless = rtol * peak < problem.rounding and run.error.u_gap < peak
        if hopeless or tol <= finest or attempts >= ATTEMPTS:
            if is_whole:
                run.status = Status.ERROR_NOT_MET
                return run
            tries_out = False
            continue
        finer = tol * min(0.3, 0.5 / worst)
        # If edges or zeros kept the steps short, their error is below `tol`, and only a tolerance below that error
        # shortens them. Not for a network: this could lead below the error of its areas' polynomials, made for `rtol`.
        tol = min(finer, 0.5 / worst * run.error.u_gap / u_scale) if is_stack else finer
