"""Time response of a circuit: the only place where a circuit meets an integrator."""

from __future__ import annotations

import dataclasses
import math
import time
import warnings

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fingerspice.base.errors import FingerspiceWarning, InputError
from fingerspice.circuit.arguments import Parameters, Sources, overridden, require_area, require_number, times_given
from fingerspice.circuit.circuit import Circuit
from fingerspice.circuit.notices import circuit_warnings
from fingerspice.circuit.statespace import is_stack
from fingerspice.results.network_record import NetworkRecord
from fingerspice.results.outcome import ErrorEstimate, Failure, SolveError, Status
from fingerspice.results.plan import Plan
from fingerspice.results.record import Record
from fingerspice.results.solution import Solution
from fingerspice.solve.cautions import network_warnings, stack_warnings
from fingerspice.solve.diagnosis import ROUGH, network_failure, stack_failure
from fingerspice.solve.direct import solve_algebraic, solve_linear
from fingerspice.solve.marching import solve as solve_marching
from fingerspice.solve.netmarching import solve_network
from fingerspice.solve.netruns import NetworkRun, add_start_error
from fingerspice.solve.network_periodic import close_network_period
from fingerspice.solve.networks import NetworkProblem, prepare_network
from fingerspice.solve.nodal import solve_coupled
from fingerspice.solve.outputs import asked_for, at_breakpoints
from fingerspice.solve.periodic import close_period
from fingerspice.solve.planning import make_plan, plan_network
from fingerspice.solve.problem import Problem, prepare
from fingerspice.solve.runs import ROUNDING, Progress, Run
from fingerspice.solve.superposition import solve_fixed
from fingerspice.waveforms.waveform import require

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

RTOL_RANGE = (1e-13, 0.1)
METHODS, LIBRARIES = ("auto", "exponential", "radau"), ("scipy", "torchdiffeq")
STARTS = ("deck", "uncharged", "dc", "periodic")


def simulate(
    circuit: Circuit,
    *,
    t_stop: float | None = None,
    t_eval: ArrayLike | None = None,
    sources: Sources | None = None,
    parameters: Parameters | None = None,
    charge_law: str | None = None,
    area: str | float = "coupled",
    rtol: float = 1e-8,
    method: str = "auto",
    tier: str = "auto",
    start: str | Solution = "deck",
    charge: bool = True,
    jumps: str = "both",
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
    sources : mapping or waveform, optional
        Source name to a waveform, a constant (V) or a plain function of time (s) in V; or one of these alone where the
        circuit has one source. Sources that are not named stay as they are.
    parameters : mapping, optional
        Path to value, as in `Circuit.replace`: ``{"Xgap.d": 3e-6}``.
    charge_law : str, optional
        ``"local"`` or ``"mobile"``; the included library's by default, else local.
    area : str or float
        ``"coupled"`` (every instant), ``"mean"`` (the phasor's), ``"frozen"`` (at 0 V), or m^2. An area fixed by
        the deck comes before the first three.
    rtol : float
        Largest error of the gap voltage relative to its peak over the run, and of the force likewise.
    method : str
        ``"auto"``, an own stepper (``"exponential"``, ``"radau"``), ``"scipy:NAME"`` or ``"torchdiffeq:NAME"``.
        ``"auto"`` steps as ``"exponential"`` does, and once a period of the source no longer changes the state it lets
        that period stand for those that follow; the others step every period. Where a fast mode that the area moves
        lets only short steps converge, ``"auto"`` goes on as ``"radau"``, an implicit method.
    tier : str
        ``"auto"``, or the model to take: ``"algebraic"``, ``"linear"`` or ``"coupled"`` (see `Plan`).
    start : str or Solution
        ``"deck"`` (as its .tran says), ``"uncharged"``, ``"dc"``, ``"periodic"`` (the periodic state, solved for
        directly), or a Solution to go on from.
    charge : bool
        Whether `q_source` and `i_source` are wanted; leaving them out saves a fifth of the time.
    jumps : str
        ``"both"``: without `t_eval`, both one-sided values at each jump of a source; ``"none"``: no rows but those at
        TSTART:TSTEP:TSTOP, right-hand values, so that `Solution.t` rises strictly.
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
    _check_rtol(rtol)
    require(jumps in ("both", "none"), "jumps", repr(jumps), "'both' or 'none'")
    if t_stop is not None:
        require_number("t_stop", t_stop, "a number in s")
    require_area(area)
    _check_method(method)
    known = isinstance(start, Solution) or (isinstance(start, str) and start in STARTS)
    require(known, "start", repr(start), f"{', '.join(map(repr, STARTS))} or a Solution")
    if isinstance(start, Solution) and start.stored is not None:
        raise InputError("start is a solution read from a file, which a run cannot go on from; allowed: one just made")
    circuit = overridden(circuit, sources, parameters)
    times = times_given("t_eval", t_eval)
    how = start if isinstance(start, str) else "given"
    first = "uncharged" if start == "periodic" else start
    if not is_stack(circuit):
        network = prepare_network(
            circuit, t_stop=t_stop, t_eval=times, charge_law=charge_law, area=area, start=first, charge=charge
        )
        if start == "periodic":
            network = close_network_period(network, 0.5 * rtol).problem
            _check_settled(times, network)
        run = run_network(network, times, rtol, method, progress, tier, how, jumps)
        return _given_back(run, throw)
    problem, error = prepare(
        circuit, t_stop=t_stop, t_eval=times, charge_law=charge_law, area=area, start=first, charge=charge, rtol=rtol
    ), None  # fmt: skip
    if start == "periodic":
        closed = close_period(problem, 0.5 * rtol)
        problem, error = closed.problem, closed.error
        _check_settled(times, problem)
    return _given_back(run_problem(problem, times, rtol, method, progress, tier, how, error, jumps), throw)


def _check_settled(times: FloatArray | None, problem: Problem | NetworkProblem) -> None:
    """Refuse outputs (s) before the periodic state that a run starts from."""
    if times is not None and times[0] < problem.t_start:
        raise InputError(
            f"t_eval starts at {times[0]:g} s; allowed: from {problem.t_start:g} s on, where the source has "
            "settled and its periodic state exists"
        )


def _check_rtol(rtol: float) -> None:
    good = isinstance(rtol, (int, float)) and RTOL_RANGE[0] <= rtol <= RTOL_RANGE[1]
    require(good, "rtol", rtol, "1e-13 to 0.1")


def _check_method(method: str) -> None:
    require(isinstance(method, str), "method", repr(method), "a name, such as 'auto'")
    library, _, name = method.partition(":")
    if method not in METHODS and not (library in LIBRARIES and name):
        known = [*METHODS, *(f"{library}:NAME" for library in LIBRARIES)]
        raise InputError(f"unknown method {method!r}; allowed: {', '.join(known)}")


def _given_back(solution: Solution, throw: bool) -> Solution:
    """A solution with its warnings said, but for those of the circuit, which came first; or a failed run's error."""
    if solution.failure is not None and throw:
        raise SolveError(solution.failure, solution)
    for text in solution.warnings:
        if text not in solution.circuit.warnings:
            warnings.warn(text, FingerspiceWarning, stacklevel=3)
    return solution


def plan(
    circuit: Circuit,
    *,
    t_stop: float | None = None,
    sources: Sources | None = None,
    parameters: Parameters | None = None,
    charge_law: str | None = None,
    area: str | float = "coupled",
    rtol: float = 1e-8,
    tier: str = "auto",
    charge: bool = True,
) -> Plan:
    """Which model a run would take, and why; arguments as in `simulate`.

    Raises
    ------
    InputError
        For a request that cannot be run.
    """
    _check_rtol(rtol)
    require_area(area)
    circuit = overridden(circuit, sources, parameters)
    if t_stop is None and circuit.tran is None:
        t_stop = 1.0
    for text in circuit_warnings(circuit):
        warnings.warn(text, FingerspiceWarning, stacklevel=2)
    if not is_stack(circuit):
        network = prepare_network(
            circuit, t_stop=t_stop, t_eval=None, charge_law=charge_law, area=area, start="deck", charge=charge
        )
        return plan_network(network, tier)
    problem = prepare(
        circuit, t_stop=t_stop, t_eval=None, charge_law=charge_law, area=area, start="deck", charge=charge, rtol=rtol
    )  # fmt: skip
    return make_plan(problem, rtol, tier)


def run_problem(
    problem: Problem,
    t_eval: FloatArray | None = None,
    rtol: float = 1e-8,
    method: str = "auto",
    progress: Progress | None = None,
    tier: str = "auto",
    start: str = "deck",
    begun: ErrorEstimate | None = None,
    jumps: str = "both",
) -> Solution:
    """Integrate a problem made ready; arguments as in `simulate`. Never raises for a failed run.

    `begun` is the error that the start brings along, which was to be half of what is asked for; the run has the rest.
    """
    # A method steps, and what is stepped is the coupled model.
    plan = make_plan(problem, rtol, "coupled" if tier == "auto" and method != "auto" else tier, start)
    t_out, left = asked_for(problem, t_eval, jumps)
    run_at = t_out if t_eval is None else at_breakpoints(problem, t_eval)
    begin = time.perf_counter()
    if plan.tier == "algebraic":
        run, name = solve_algebraic(problem, run_at, left), plan.tier
    elif plan.tier == "linear":
        run, name = solve_linear(problem, run_at, left, plan.area, plan.error_bound), plan.tier
    else:
        # What the start and the plan give away is part of the error asked for.
        own = max((1.0 if begun is None else 0.5) * rtol - 2.0 * plan.error_bound, RTOL_RANGE[0])
        run, name = _run(problem, method, own, run_at, left, progress)
        _add_error(run, plan.error_bound * run.peak_u)
    if begun is not None:
        _add_error(run, begun.u_gap, begun.f_el)
        # What the charge collects from where it starts is not known.
        run.error = dataclasses.replace(run.error, q_source=None)
    _mind_unseen(run)
    if run.rough > 0.0:
        _add_error(run, run.rough)
        run.detail = run.detail or ROUGH.format(run.rough)
    rounding = ROUNDING * problem.scene.u_peak
    ended = run.status in (Status.SUCCESS, Status.ERROR_NOT_MET) and run.t_failed is None
    if ended and run.state.t == problem.t_stop and run.peak_u <= rounding:
        # Zero, as far as numbers can tell; the force goes with the square.
        share = rounding / run.peak_u if run.peak_u > 0.0 else 0.0
        run.status, run.error = Status.SUCCESS, run.error.at_least(share * run.peak_u, share**2 * run.peak_f)
    elif run.status is Status.SUCCESS and run.excess(rtol) > 1.0:
        run.status = Status.ERROR_NOT_MET
    return _solution(problem, run, rtol, name, t_out, time.perf_counter() - begin, plan)


def run_network(
    problem: NetworkProblem,
    t_eval: FloatArray | None = None,
    rtol: float = 1e-8,
    method: str = "auto",
    progress: Progress | None = None,
    tier: str = "auto",
    start: str = "deck",
    jumps: str = "both",
) -> Solution:
    """As `run_problem`, for a network."""
    plan = plan_network(problem, "coupled" if tier == "auto" and method != "auto" else tier, start)
    t_out, left = asked_for(problem, t_eval, jumps)
    run_at = t_out if t_eval is None else at_breakpoints(problem, t_eval)
    begin = time.perf_counter()
    # What the start gives away is part of the error asked for.
    own = rtol if problem.begun is None else max(0.5 * rtol, RTOL_RANGE[0])
    if plan.tier == "linear":
        run, name = solve_fixed(problem, run_at, left), plan.tier
    else:
        run, name = _run_network(problem, method, own, run_at, left, progress)
    wall = time.perf_counter() - begin
    if problem.begun is not None:
        add_start_error(run, problem.begun)
    _mind_unseen(run)
    # The rounding of a closed form is stated, and no reason to refuse it: no other method would do better.
    minded = problem.network.fingers and (plan.tier != "linear" or run.rough > 0.0)
    if run.status is Status.SUCCESS and minded and run.excess(problem.scene.u_peak) > rtol:
        run.status = Status.ERROR_NOT_MET
    record = problem.record(run)
    t = np.concatenate([t_out[: run.t.size], run.t[t_out.size :]]) if run.status is Status.SUCCESS else run.t.copy()
    failure = None if run.status is Status.SUCCESS else network_failure(problem, run, record)
    warned = tuple(network_warnings(problem, run, record))
    return _packed(problem, run, record, t, failure, rtol, name, plan, wall, warned)


def _run_network(
    problem: NetworkProblem, method: str, rtol: float, t_out: FloatArray, left: BoolArray, progress: Progress | None
) -> tuple[NetworkRun, str]:
    """As `_run`, for a network."""
    if ":" in method:
        from fingerspice.solve.foreign import solve_foreign

        return solve_foreign(problem, method, rtol, t_out, left, progress), method
    if method != "radau" and problem.scene.coupled:
        found = solve_network(problem, rtol, t_out, left, progress, repeat=method == "auto")
        if found is not None:
            return found, "exponential"
    return solve_coupled(problem, rtol, t_out, left, progress), "radau"


def _mind_unseen(run: Run | NetworkRun) -> None:
    """A run of a source that its outputs show to be another one than was integrated fails there."""
    if run.unseen is not None and run.status in (Status.SUCCESS, Status.ERROR_NOT_MET):
        run.t_failed, off = run.unseen[:2]
        run.status = Status.SOURCE_UNSEEN if math.isfinite(off) else Status.SOURCE_NOT_FINITE
        run.end_before(run.t_failed)


def _add_error(run: Run, u_gap: float, f_el: float | None = None) -> None:
    """Add to a run's error what it does not know of, V and N: a force goes with the square of its voltage."""
    if f_el is None:
        f_el = 2.0 * u_gap / run.peak_u * run.peak_f if run.peak_u > 0.0 else 0.0
    run.error = dataclasses.replace(run.error, u_gap=run.error.u_gap + u_gap, f_el=run.error.f_el + f_el)


def _run(
    problem: Problem, method: str, rtol: float, t_out: FloatArray, left: BoolArray, progress: Progress | None
) -> tuple[Run, str]:
    from fingerspice.solve.stacked import solve_otherwise

    if method not in ("auto", "exponential"):
        return solve_otherwise(problem, method, rtol, t_out, left, progress), method
    run = solve_marching(problem, rtol, t_out, left, progress, repeat=method == "auto")
    if run.status not in (Status.FOLD, Status.TOO_MANY_STEPS) or method == "exponential":
        return run, "exponential"
    from fingerspice.solve.folding import run_to_fold

    folded = run_to_fold(problem, t_out, left) if run.status is Status.FOLD else None
    if folded is not None:
        return folded, "exponential"
    # No fold is near, or none at all: for an implicit method, which no fast mode holds up.
    return solve_otherwise(problem, "radau", rtol, t_out, left, progress), "radau"


def _solution(
    problem: Problem, run: Run, rtol: float, method: str, t_out: FloatArray, wall: float, plan: Plan
) -> Solution:
    record = run.record(problem)
    # The times asked for, not those that rounding moved onto a breakpoint.
    t = np.concatenate([t_out[: run.t.size], run.t[t_out.size :]]) if run.status is Status.SUCCESS else run.t.copy()
    warned = tuple(stack_warnings(problem, run, record))
    failure = None if run.status is Status.SUCCESS else stack_failure(problem, run, record)
    return _packed(problem, run, record, t, failure, rtol, method, plan, wall, warned)


def _packed(
    problem: Problem | NetworkProblem, run: Run | NetworkRun, record: Record | NetworkRecord, t: FloatArray,
    failure: Failure | None, rtol: float, method: str, plan: Plan, wall: float, warned: tuple[str, ...],
) -> Solution:  # fmt: skip
    scene = problem.scene
    return Solution(
        t=t,
        record=record,
        status=run.status,
        failure=failure,
        nfev=run.nfev,
        stats={**run.stats, "wall_s": wall},
        error=run.error,
        rtol=rtol,
        charge_law=scene.charge_law,
        area_mode=scene.area_mode,
        method=method,
        plan=plan,
        circuit=problem.circuit,
        state=run.state,
        fold_margin_min=run.margin,
        fundamental=scene.fundamental,
        period=scene.waveform.period,
        warnings=warned,
        first=max(problem.first, problem.t_start),
        t_stop=problem.t_stop,
        continuous=run.continuous if run.t_failed is None else None,
    )
