"""Time response of a circuit: the only place where a circuit meets an integrator."""

from __future__ import annotations

import dataclasses
import time
import warnings
from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fingerspice.circuit.circuit import Circuit
from fingerspice.circuit.sampling import breakpoints_at, same_time
from fingerspice.circuit.waveforms import Waveform, as_waveform, require
from fingerspice.errors import FingerspiceWarning, InputError, SolveError
from fingerspice.numerics.tableaus import TABLEAUS
from fingerspice.problem import Problem, prepare
from fingerspice.solution import Solution, Status
from fingerspice.transient import Progress, Run, choose_tableau, solve

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

RTOL_RANGE = (1e-13, 0.1)
BREAKDOWN_VOLTAGE = 300.0


def simulate(
    circuit: Circuit,
    *,
    t_stop: float | None = None,
    t_eval: ArrayLike | None = None,
    sources: Mapping[str, Waveform | float | Callable[[float], float]] | None = None,
    charge_law: str | None = None,
    area: str | float = "coupled",
    rtol: float = 1e-8,
    method: str = "auto",
    start: str | Solution = "deck",
    throw: bool = True,
    progress: Progress | None = None,
) -> Solution:
    """Simulate a circuit in time.

    Parameters
    ----------
    circuit : Circuit
    t_stop : float, optional
        End, s; the deck's TSTOP by default (counted from the start where `start` is a Solution).
    t_eval : array_like, optional
        Output times, s, ascending; right-hand values at jumps. By default TSTART:TSTEP:TSTOP, and both
        one-sided values at each jump.
    sources : mapping, optional
        Source name to a waveform, a constant (V) or a plain function of time (s) in V.
    charge_law : str, optional
        ``"local"`` or ``"mobile"``; the included library's by default, else local.
    area : str or float
        ``"coupled"`` (every instant), ``"mean"`` (the phasor's), ``"frozen"`` (at 0 V), or m^2. An area fixed by
        the deck comes before the first three.
    rtol : float
        Largest error of the gap voltage relative to its peak over the run, and of the force likewise.
    method : str
        ``"auto"``, an own stepper (``"dp5"``, ``"dop853"``, ``"radau9"``), ``"scipy:NAME"`` or ``"torchdiffeq:NAME"``.
    start : str or Solution
        ``"deck"`` (as its .tran says), ``"uncharged"``, ``"dc"``, or a Solution to go on from.
    throw : bool
        Raise where the run fails; otherwise return what came before, with its status.
    progress : callable, optional
        Called with the fraction done.

    Returns
    -------
    Solution

    Raises
    ------
    InputError
        For a request that cannot be run.
    SolveError
        Where the run failed and `throw` is set; its `solution` holds what came before.
    """
    require(
        isinstance(rtol, (int, float)) and RTOL_RANGE[0] <= rtol <= RTOL_RANGE[1],
        "rtol",
        rtol,
        "1e-13 to 0.1",
    )
    if sources:
        circuit = _with_sources(circuit, sources)
    times = None if t_eval is None else np.asarray(t_eval, float)
    problem = prepare(circuit, t_stop=t_stop, t_eval=times, charge_law=charge_law, area=area, start=start)
    solution = run_problem(problem, times, rtol, method, progress)
    if not solution.success and throw:
        raise SolveError(solution.message, solution)
    for text in solution.warnings:
        warnings.warn(text, FingerspiceWarning, stacklevel=2)
    return solution


def run_problem(
    problem: Problem,
    t_eval: FloatArray | None = None,
    rtol: float = 1e-8,
    method: str = "auto",
    progress: Progress | None = None,
) -> Solution:
    """Integrate a problem made ready; arguments as in `simulate`. Never raises for a failed run."""
    if t_eval is None:
        t_out, left = output_times(problem)
        run_at = t_out
    else:
        t_out, left = t_eval, np.zeros(t_eval.size, bool)
        run_at = _at_breakpoints(problem, t_eval)
    begin = time.perf_counter()
    run, name = _run(problem, method, rtol, run_at, left, progress)
    return _solution(problem, run, rtol, name, t_out, time.perf_counter() - begin)


def _at_breakpoints(problem: Problem, t: FloatArray) -> FloatArray:
    """Times moved onto the breakpoint they miss by rounding, so that 5 ms means the jump at 5 ms."""
    edges = problem.waveform.breakpoints(problem.t_start, problem.t_stop)
    if not edges.size:
        return t
    nearest = edges[np.clip(np.searchsorted(edges, t), 0, edges.size - 1)]
    return np.ascontiguousarray(np.where(np.abs(nearest - t) <= same_time(1.0) * np.abs(t), nearest, t))


def _with_sources(circuit: Circuit, sources: Mapping[str, Waveform | float | Callable[[float], float]]) -> Circuit:
    for name in sources:
        if circuit[name].device != "V":
            raise InputError(f"sources names {name!r}, which is a {circuit[name].device}; allowed: a V element")
    return circuit.replace({circuit[name].name: as_waveform(value) for name, value in sources.items()})


def _run(
    problem: Problem, method: str, rtol: float, t_out: FloatArray, left: BoolArray, progress: Progress | None
) -> tuple[Run, str]:
    library, _, name = method.partition(":")
    if library in ("scipy", "torchdiffeq") and name:
        from fingerspice.foreign import solve_foreign

        return solve_foreign(problem, library, name, rtol, t_out, left), method
    if method != "auto" and method not in TABLEAUS:
        known = ["auto", *TABLEAUS, "scipy:NAME", "torchdiffeq:NAME"]
        raise InputError(f"unknown method {method!r}; allowed: {', '.join(known)}")
    tableau = choose_tableau(problem, rtol) if method == "auto" else TABLEAUS[method]
    return solve(problem, rtol, tableau, t_out, left, progress), tableau.name


def output_times(problem: Problem) -> tuple[FloatArray, BoolArray]:
    """TSTART:TSTEP:TSTOP with two entries (left, right) at each jump; t = 0 once, right-hand."""
    step, first = problem.step, problem.first
    count = int(np.floor((problem.t_stop - first) / step * (1.0 + 1e-12) + 1e-9))
    grid = first + step * np.arange(count + 1)
    if grid.size and abs(grid[-1] - problem.t_stop) <= 1e-9 * step:
        grid[-1] = problem.t_stop
    rounding = same_time(problem.t_stop)
    edges = problem.waveform.breakpoints(problem.t_start, problem.t_stop + rounding)
    edges = edges[(edges > problem.t_start + same_time(problem.t_start)) & (edges >= first)]
    size = np.abs(problem.waveform.value(edges) - problem.waveform.value(edges, "left"))
    level = np.maximum(np.abs(problem.waveform.value(edges)), np.abs(problem.waveform.value(edges, "left")))
    jumps = edges[size > 1e-12 * level]
    jumps = np.where(jumps > problem.t_stop - rounding, problem.t_stop, jumps)
    if jumps.size:
        near = np.clip(np.searchsorted(jumps, grid), 1, max(jumps.size - 1, 1))
        distance = np.minimum(np.abs(grid - jumps[near - 1]), np.abs(grid - jumps[np.minimum(near, jumps.size - 1)]))
        grid = grid[distance > 1e-9 * step]
    t = np.concatenate([grid, jumps, jumps])
    left = np.concatenate([np.zeros(grid.size, bool), np.ones(jumps.size, bool), np.zeros(jumps.size, bool)])
    order = np.lexsort((~left, t))
    return np.ascontiguousarray(t[order]), np.ascontiguousarray(left[order])


def _solution(problem: Problem, run: Run, rtol: float, method: str, t_out: FloatArray, wall: float) -> Solution:
    rows = run.rows[: run.n_out]
    t = t_out[: run.n_out].copy()
    if run.last is not None and (t.size == 0 or run.state.t > t[-1]):
        # A failed run's arrays end at the time it reached.
        rows = np.vstack([rows, run.last])
        t = np.append(t, run.state.t)
    stack, model = problem.stack, problem.model
    u_source, probe, inverse, current, margin, z = (rows[:, i].copy() for i in range(6))
    # Rows hold y = [x, z] after five columns; z is the last.
    x, z = rows[:, 5:-1], rows[:, -1].copy()
    along = problem.layer_voltages(u_source, inverse, x)
    if stack.gap is not None:
        along[:, stack.gap] = probe
    u_layer = along * stack.sign
    area = 1.0 / inverse
    charge = (area * u_source / model.s + z if model.mobile else z) - problem.initial.charge_offset
    u_gap = sigma = f_el = f_t = friction = None
    if stack.contact is not None and stack.gap is not None:
        u_gap = u_layer[:, stack.gap].copy()
        sigma = stack.contact.stress(u_gap)
        f_el = sigma * area
        f_t = stack.contact.mu * (stack.contact.f_n + f_el)
        friction = f_t / stack.contact.f_n
    u_sources = {
        e.name: np.asarray(u_source * s if len(stack.sources) == 1 else _source_values(e.waveform, t, u_source))
        for e, s in stack.sources
    }
    fundamental = stack.waveform.fundamental
    return Solution(
        t=t,
        u_source=u_source,
        u_layer=u_layer,
        layers=tuple(e.name for e in stack.layers),
        u_gap=u_gap,
        area=area,
        sigma_el=sigma,
        f_el=f_el,
        f_t=f_t,
        friction=friction,
        node_voltages=stack.node_voltages(u_layer, u_sources),
        q_source=charge,
        i_source=current,
        fold_margin=margin,
        status=run.status,
        message=_message(problem, run),
        nfev=run.nfev,
        stats={**run.stats, "wall_s": wall},
        error=run.error,
        rtol=rtol,
        charge_law=problem.charge_law,
        area_mode=problem.area_mode,
        method=method,
        circuit=problem.circuit,
        state=dataclasses.replace(run.state),
        fundamental=fundamental,
        period=stack.waveform.period,
        warnings=tuple(_physics_warnings(problem, run)),
    )


def _source_values(waveform: Waveform | None, t: FloatArray, like: FloatArray) -> FloatArray:
    """Values of one of several sources, left-hand at the first row of a jump."""
    assert waveform is not None
    out = waveform.value(t)
    first = np.flatnonzero(np.diff(t) == 0.0)
    out[first] = waveform.value(t[first], "left")
    return np.asarray(out, like.dtype)


def _message(problem: Problem, run: Run) -> str:
    text = run.status.value
    if run.t_failed is not None:
        text = f"stopped at t = {run.t_failed:.10g} s: {text}"
        if run.status is Status.SOURCE_NOT_FINITE:
            names = ", ".join(e.name for e, _ in problem.stack.sources)
            text += f" (source {names})"
        elif run.status is Status.FOLD and run.last is not None:
            last = run.last
            if breakpoints_at(problem.waveform, run.t_failed).size:
                text += "; the source jumps past the fold at this time"
            text += (
                f" (just before: {last[1]:.4g} V across the gap, area {1e6 / last[2]:.4g} mm^2, "
                f"distance to the fold {last[4]:.3g})"
            )
    if run.detail:
        text += f" ({run.detail})"
    if run.status is Status.ERROR_NOT_MET:
        text += f" (estimate {run.error.u_gap:.3g} V of {run.peak_u:.3g} V peak"
        source = problem.waveform.peak(problem.t_start, problem.t_stop)
        if run.peak_u < 1e-4 * source:
            text += (
                f"; the gap takes almost nothing of the {source:.3g} V of the source, and rounding of these limits it"
            )
        text += ")"
    return text


def _physics_warnings(problem: Problem, run: Run) -> list[str]:
    if problem.stack.gap is not None and run.peak_u > BREAKDOWN_VOLTAGE:
        return [
            f"the gap voltage reaches {run.peak_u:.4g} V; air breaks down above about {BREAKDOWN_VOLTAGE:g} V "
            "(Paschen minimum 327 V), which the model does not contain"
        ]
    return []
