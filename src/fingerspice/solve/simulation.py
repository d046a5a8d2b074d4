"""Time response of a circuit: the only place where a circuit meets an integrator."""

from __future__ import annotations

import dataclasses
import math
import time
import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from fingerspice.base.arrays import FloatArray, real_number, real_numbers
from fingerspice.base.errors import FingerspiceWarning, InputError
from fingerspice.base.units import format_si
from fingerspice.circuit.circuit import Circuit
from fingerspice.circuit.describe import Parameters, Sources, circuit_warnings, overridden
from fingerspice.circuit.network import Network
from fingerspice.physics.contact import inverse_area_range
from fingerspice.results.outcome import Plan, SolveError, Status
from fingerspice.results.record import Record
from fingerspice.results.slide import slid
from fingerspice.results.solution import Solution
from fingerspice.solve.closed_form import lead_to_fold, run_to_fold, solve_linear
from fingerspice.solve.collocation import solve as solve_exponential
from fingerspice.solve.derivatives import check_request, sensitivities_of
from fingerspice.solve.nodal import FOREIGN, solve_coupled, solve_foreign
from fingerspice.solve.periodic import asked
from fingerspice.solve.problem import Problem, asked_for, at_breakpoints, prepare, shortest_event
from fingerspice.solve.recordings import solve as solve_recording
from fingerspice.solve.runs import ROUGH, Progress, Run, excess_of, run_failure, run_warnings, warn
from fingerspice.solve.stepping import FEWEST_PERIODS
from fingerspice.waveforms.waveform import DOUBLE, refuse, require

RTOL_RANGE = (1e-13, 0.1)
METHODS = ("auto", "exponential", "radau")
# Statuses of a run by exponential steps after which another method is tried: for a stack, and for a network.
BEYOND_STACKS = (Status.FOLD, Status.TOO_MANY_STEPS, Status.STEP_UNDERFLOW)
BEYOND_NETWORKS = (*BEYOND_STACKS, Status.ERROR_NOT_MET)
TIERS = ("algebraic", "linear", "coupled")
# A scene is called stiff if its fastest rate times the source's shortest time exceeds this: stability alone would then
# limit the steps of an explicit method.
STIFF = 300.0
MOST_GROWN = 30.0  # Largest logarithm of the growth of an unstable circuit in a run
REPEATS = "periodic: once a period no longer changes the state, later ones repeat it"
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
    sensitivities: Sequence[str] = (),
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
        ``"auto"`` uses exponential steps, and once a period of the source no longer changes the state, it repeats that
        period to the end; the other methods step every period. ``"auto"`` integrates a recording (`Samples`) on a
        series stack or a network with one finger sample by sample, and a PWL of many points at uneven times on a
        series stack point by point (`Solution.method` is then ``"relaxation"``). Where a fast mode that depends on
        the area makes only short exponential steps converge, the run is repeated with ``"radau"``, an implicit method.
    tier : str
        ``"auto"``, or the model to take: ``"algebraic"``, ``"linear"`` or ``"coupled"`` (see `Plan`).
    start : str or Solution
        ``"deck"`` (as its .tran says), ``"uncharged"``, ``"dc"``, ``"periodic"`` (the periodic state, solved for
        directly), or a Solution whose final state is the start.
    charge : bool
        Whether `q_source` and `i_source` are wanted; leaving them out saves a fifth of the time.
    jumps : str
        ``"both"``: without `t_eval`, both one-sided values at each jump of a source; ``"none"``: only right-hand values
        at TSTART:TSTEP:TSTOP, so that `Solution.t` rises strictly.
    throw : bool
        Raise an error if the run fails; otherwise return the outputs before the failure, with its status.
    progress : callable, optional
        Called with the fraction of the run that is done.
    sensitivities : sequence of str
        Paths, as in `Circuit.replace`, by which signals and means are differentiated, with four more runs each.

    Raises
    ------
    InputError
        For a request that cannot be run.
    SolveError
        Where the run failed and `throw` is set; its `solution` holds the outputs before the failure.
    """
    rtol = check_arguments(rtol, method, start, jumps)
    # Of their own: results keep them, and the caller's array stays writable.
    times = None if t_eval is None else real_numbers("t_eval", t_eval, "numbers in s").copy()
    circuit = overridden(circuit, sources, parameters)
    wanted: dict[str, Any] = {"t_stop": t_stop, "charge_law": charge_law, "area": area, "start": start}
    problem = asked(circuit, t_eval=times, charge=charge, rtol=rtol, **wanted)
    compared = check_request(problem, sensitivities, method) if sensitivities else method
    solution = run_problem(problem, times, rtol, method, progress, tier, jumps)

    def run(other: Circuit, finer: float) -> Solution:
        at = None if times is None else times.copy()
        varied = asked(other, t_eval=at, charge=False, rtol=finer, **wanted)
        return run_problem(varied, at, finer, compared, None, tier, jumps)

    if sensitivities and solution.success:
        solution = dataclasses.replace(solution, sensitivities=sensitivities_of(problem, solution, sensitivities, run))
    if solution.failure is not None and throw:
        raise SolveError(solution.failure, solution)
    warn(solution, 2)
    return solution


def rtol_given(rtol: object, least: float = RTOL_RANGE[0]) -> float:
    """The largest relative error that a user allows, from `least` on; anything else is refused."""
    allowed = f"{least:g} to {RTOL_RANGE[1]:g}"
    number = real_number("rtol", rtol, allowed)
    require(least <= number <= RTOL_RANGE[1], "rtol", rtol, allowed)
    return number


def check_arguments(rtol: float, method: str = "auto", start: str | Solution = "deck", jumps: str = "both") -> float:
    """`rtol` as a number; arguments of `simulate` that no circuit can run with are refused, but for the area."""
    require(jumps in ("both", "none"), "jumps", repr(jumps), "'both' or 'none'")
    require(isinstance(method, str), "method", repr(method), "a name, such as 'auto'")
    library, _, name = method.partition(":")
    known = [f"{library}:{one}" for one in FOREIGN.get(library, ()) if name]
    if method not in (*METHODS, *known):
        known = known or [*METHODS, *(f"{library}:NAME" for library in FOREIGN)]
        raise InputError(f"unknown method {method!r}; allowed: {', '.join(known)}")
    if not (isinstance(start, Solution) or (isinstance(start, str) and start in STARTS)):
        raise InputError(f"start is {start!r}; allowed: {', '.join(map(repr, STARTS))} or a Solution")
    return rtol_given(rtol)


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
    """The model that a run would use, and the reasons; arguments as in `simulate`.

    Raises
    ------
    InputError
        For a request that cannot be run.
    """
    rtol = rtol_given(rtol)
    circuit = overridden(circuit, sources, parameters)
    t_stop = 1.0 if t_stop is None and circuit.tran is None else t_stop
    problem = prepare(circuit, t_stop=t_stop, charge_law=charge_law, area=area, charge=charge, rtol=rtol)
    for text in circuit_warnings(circuit, problem.t_stop):
        warnings.warn(text, FingerspiceWarning, stacklevel=2)
    return make_plan(problem, rtol, tier)


def make_plan(problem: Problem, rtol: float, tier: str = "auto", method: str = "auto") -> Plan:
    """The model for a problem with this error and tier asked for; a method that is named steps the coupled one."""
    refuse(tier not in ("auto", *TIERS), f"unknown tier {tier!r}; allowed: auto, {', '.join(TIERS)}")
    asked = "coupled" if tier == "auto" and method != "auto" else tier
    key = ("plan", rtol, asked, problem.start, problem.charge, problem.stored, problem.t_start, problem.t_stop)
    return problem.scene.remember(key, lambda: _plan(problem, rtol, asked))


def _plan(problem: Problem, rtol: float, tier: str) -> Plan:
    scene, model, span = problem.scene, problem.scene.model, problem.t_stop - problem.t_start
    area, changed = float(scene.net.area0[0]) if scene.fixed else math.nan, math.nan if scene.coupled else 0.0
    if model is not None and model.coupled:
        changed, area = _change(model.curve, scene.u_peak)
    elif scene.coupled and not unbounded(problem.network):
        changed = max(_change(curve, scene.u_peak)[0] for curve in scene.net.curves[scene.net.gap >= 0])
    best, reason = _best(problem, rtol, changed)
    chosen = best if tier == "auto" else tier
    if chosen != best:
        _refuse(problem, chosen, best)
        reason = f"asked for; the lightest that is right would be {best}: {reason}"
    rates, shortest = scene.rates, min(problem.network.waveform.shortest_time(), span)
    fastest, grown = float(rates.max(initial=0.0)), -span * float(rates.min(initial=0.0))
    said = f"the circuit is unstable: by itself a voltage grows by a factor of e^{grown:.3g} in {format_si(span, 's')}"
    refuse(grown > MOST_GROWN, f"{said}; allowed: feedback of the other sign or with less gain, or a shorter run")
    reasons, stiff, needed = [reason], fastest * shortest > STIFF, 0.0
    if stiff:
        reasons.append(f"stiff: the fastest rate {fastest:.3g} 1/s against {1.0 / shortest:.3g} 1/s of the source")
    if chosen == "coupled" and scene.coupled and problem.network.waveform.period:
        reasons += [REPEATS] if span / problem.network.waveform.period >= FEWEST_PERIODS else []
    if chosen == "linear" and model is not None and scene.coupled and np.any(model.rate0 > 0.0):
        needed = changed
    if problem.network.active:
        reasons.append("inductors, amplifiers or switches: voltages may oscillate or grow, which implicit steps take")
    if chosen == "coupled" and problem.network.owned:
        reasons.append("the gap's height, or its leak, follows its voltage, which implicit steps take")
    if scene.skin is not None:
        f, error = scene.skin
        reasons.append(f"skin at {f:g} Hz: its dispersion moves the gap voltage by {error:.1g}")
        needed += error
    elif scene.network.stack is not None and problem.circuit.by_device("SKIN_DISPERSIVE"):
        reasons.append(f"skin dispersive: no one frequency serves to rtol = {rtol:g}")
    if problem.network.waveform.is_sampled:
        event = format_si(shortest_event(problem), "s")
        reasons.append(f"a source is a function: an event in it shorter than {event} may be missed without breaks=")
    found = tuple(sorted(map(float, rates)))
    return Plan(chosen, tuple(reasons), problem.start, found, stiff, changed, needed, area)


def _refuse(problem: Problem, tier: str, best: str) -> None:
    """Refuse a tier that cannot describe the circuit."""
    stack, mobile = problem.network.stack, problem.scene.charge_law == "mobile"
    if stack is None and tier != "coupled":
        others = "auto" if best == "coupled" else f"auto, {best}"
        raise InputError(f"the {tier} tier is not for this network; allowed: {others} or coupled")
    if stack is not None and tier == "algebraic":
        leaking = stack.layers_of(stack.g_total + stack.g_area > 0.0)
        what = f"a stack without leaks; here {', '.join(leaking)} leak"
        raise InputError(f"the algebraic tier needs {what if leaking else 'a start without stored charge'}")
    if tier == "linear" and problem.scene.coupled and (mobile or problem.charge):
        what = "the mobile law" if mobile else "the charge (charge=False leaves it out)"
        raise InputError(f"the linear tier takes the area as fixed, and {what} needs the one that follows the voltage")


def _best(problem: Problem, rtol: float, changed: float) -> tuple[str, str]:
    """The lightest tier that is valid, and the reason.

    With capacitors outside the layers, a small change of an area may have a large effect on the voltages over many
    periods. No useful bound of that effect is known beforehand: a network is coupled however little its areas change.
    """
    scene, model, several = problem.scene, problem.scene.model, len(problem.network.fingers) > 1
    stores = scene.coupled and model is not None and model.mobile and problem.stored > 0.0
    if model is not None and not (model.rate.any() or model.rate0.any() or stores):
        return "algebraic", "no layer leaks, so the voltages follow the source at once"
    if not scene.coupled and problem.network.active:
        return "coupled", "a network with inductors, amplifiers or switches, whatever its areas"
    if not scene.coupled:
        which = f"the area{' is' if model is not None else 's are'} {scene.area_mode}"
        return "linear", f"{which if scene.fixed else 'no element has an area'}, so the circuit is linear"
    if model is None:
        follows = f"a network whose area{'s follow' if several else ' follows'} the gap voltage"
        if (free := unbounded(problem.network)) and math.isnan(changed):
            return "coupled", f"{follows}; by how much is not known beforehand: {free} sets no bound"
        return "coupled", f"{follows}, {'each ' if several else ''}by up to {_percent(changed)} of its middle"
    insulating = not model.rate0.any()
    if model.mobile or not (insulating or changed <= 0.2 * rtol):
        return "coupled", f"the area follows the voltage and moves the leaks by up to {_percent(changed)}"
    if problem.charge:
        return "coupled", "only the charge needs the area at every instant; charge=False leaves it out"
    if insulating:
        return "linear", "every leak scales with the area, so under the local law no voltage feels it"
    return "linear", f"the area changes the leaks by {changed:.2g} at most, against rtol = {rtol:g}"


def unbounded(network: Network) -> str:
    """What keeps the sources' voltages from bounding those of a network; empty if nothing does."""
    amplified = "an inductor, an amplifier or a switch" if network.active else ""
    return amplified or ("a current source" if len(network.sources) > network.n_voltage else "")


def _percent(share: float) -> str:
    """A share in percent to two digits, without an exponent where it has three."""
    return f"{float(f'{100.0 * share:.2g}'):g} %"


def _change(curve: FloatArray, u_peak: float) -> tuple[float, float]:
    """Largest relative change of 1/A under sources with peak `u_peak` (V) from its middle value, and its area (m^2)."""
    # The gap may hold the whole source voltage, and up to twice that if stored charge adds to a reversed source.
    least, largest = inverse_area_range(2.0 * u_peak, 65, curve)
    middle = 0.5 * (least + largest)
    return max(middle / least, largest / middle) - 1.0, 1.0 / middle


def run_problem(
    problem: Problem,
    t_eval: FloatArray | None = None,
    rtol: float = 1e-8,
    method: str = "auto",
    progress: Progress | None = None,
    tier: str = "auto",
    jumps: str = "both",
) -> Solution:
    """Integrate a prepared problem; arguments as in `simulate`. A failed run raises no error."""
    plan = make_plan(problem, rtol, tier, method)
    t_out, left = asked_for(problem, t_eval, jumps)
    problem = problem.at(t_out if t_eval is None else at_breakpoints(problem, t_eval), left)
    begin = time.perf_counter()
    run, name = integrated(problem, plan, rtol, method, progress)
    run.stats["wall_s"] = time.perf_counter() - begin  # type: ignore[assignment]
    # Report the times asked for, not the breakpoints to which `at_breakpoints` has moved some of them.
    t = t_out[: run.t.size] if run.status is Status.SUCCESS else run.t
    return solution_of(problem, plan, run, run.record(problem), t, rtol, name)


def integrated(
    problem: Problem, plan: Plan, rtol: float, method: str, progress: Progress | None = None
) -> tuple[Run, str]:
    """A run as planned, with its stated error compared with `rtol`, and the name of its method."""
    name = plan.tier
    if name != "coupled":
        leaks = name == "linear" and problem.network.stack is not None
        run = solve_linear(problem, np.array([plan.area]) if leaks else None, plan.error_bound)
    else:
        run, name = _stepped(problem, method, own_rtol(problem, plan, rtol), progress)
    state_error(problem, run, plan, rtol)
    return run, name


def own_rtol(problem: Problem, plan: Plan, rtol: float) -> float:
    """The part of the error asked for that is left to the integrator, after the errors of start and plan."""
    return max((1.0 if problem.begun is None else 0.5) * rtol - 2.0 * plan.error_bound, RTOL_RANGE[0])


def solution_of(
    problem: Problem, plan: Plan, run: Run, record: Record, t: FloatArray, rtol: float, name: str
) -> Solution:  # fmt: skip
    """The solution made of a run and its record, with output times `t` (s); `name` is the method."""
    scene = problem.scene
    failure = None if run.status is Status.SUCCESS else run_failure(problem, run, record)
    fundamental = scene.network.waveform.fundamental if len(scene.network.waveforms) == 1 else None
    found = Solution(
        t=t, record=record, status=run.status, failure=failure, nfev=run.nfev, stats=dict(run.stats), error=run.error,
        rtol=rtol, charge_law=scene.charge_law, area_mode=scene.area_mode, method=name, plan=plan,
        circuit=problem.circuit, state=run.state, fold_margin_min=run.margin, fundamental=fundamental,
        period=scene.network.waveform.period, warnings=tuple(run_warnings(problem, run, record)),
        first=max(problem.first, problem.t_start), t_stop=problem.t_stop, start=problem.start,
        continuous=run.continuous if run.t_failed is None else None,
    )  # fmt: skip
    slips = failure is None and any(gap.values["slip"] > 0.0 for gap in problem.circuit.by_device("GAP"))
    return slid(found) if slips else found


def _stepped(problem: Problem, method: str, rtol: float, progress: Progress | None) -> tuple[Run, str]:
    """A run of the coupled tier, and the name of its method."""
    if ":" in method:
        return solve_foreign(problem, method, rtol, progress), method
    if method == "auto" and (recorded := solve_recording(problem, rtol, progress)) is not None:
        return recorded, "relaxation"
    is_stack, reason = problem.network.stack is not None, ""
    if problem.network.active or (problem.network.owned and problem.scene.coupled):
        method = "radau"
    if method != "radau" and (is_stack or problem.scene.coupled):
        run = solve_exponential(problem, rtol, progress, repeat=method == "auto")
        if run.status not in (BEYOND_STACKS if is_stack else BEYOND_NETWORKS) or (is_stack and method == "exponential"):
            return run, "exponential"
        if is_stack and run.status is Status.FOLD and (folded := run_to_fold(problem)) is not None:
            return folded, "exponential"
        cause = "a fold is near" if run.status is Status.FOLD else run.status.cause
        reason = f"exponential steps gave up at t = {run.state.t:.4g} s, because {cause}"
    # The implicit method is the last resort: its step length does not depend on fast modes.
    run = solve_coupled(problem, rtol, progress, reason)
    if is_stack and run.status is Status.FOLD:
        run = lead_to_fold(problem, run) or run
    return run, "radau"


def state_error(problem: Problem, run: Run, plan: Plan, rtol: float) -> None:
    """Add the errors that a run's method does not estimate to its stated error, and compare that with `rtol`."""
    if plan.error_bound > 0.0 and plan.tier == "coupled":
        run.add_error(plan.error_bound * run.gaps[:, 0])
    if problem.begun is not None:
        if len(problem.begun) == len(run.gaps):
            run.add_error(*problem.begun.T)
        # The start's error is known at the gaps only, not its effect on the charge or at other nodes.
        run.charge_error = run.node_error = None
    if run.unseen is not None and run.status in (Status.SUCCESS, Status.ERROR_NOT_MET):
        # At this output the user's function differs from the table that was integrated.
        run.t_failed, off = run.unseen[:2]
        run.status = Status.SOURCE_UNSEEN if math.isfinite(off) else Status.SOURCE_NOT_FINITE
        kept = run.t < run.t_failed
        run.t, run.left, run.rows = run.t[kept], run.left[kept], run.rows[kept]
    # Of a function that gives coarser numbers than doubles, their rounding is part of the stated error, and no failure.
    coarse = run.rough if any(wave.precision > DOUBLE for wave in problem.network.waveforms) else 0.0
    if run.rough > 0.0:
        # What it does to the charge is not known.
        run.charge_error = None
        run.add_error(run.rough - coarse)
        run.detail = run.detail or ROUGH.format(run.rough)
    rounding = problem.rounding
    for gap in run.gaps:
        if 0.0 < gap[0] <= rounding:
            # To round-off the gap is at 0 V: state at least that round-off as its error, and its square for the force.
            gap[2:] = np.maximum(gap[2:], (rounding, (rounding / gap[0]) ** 2 * gap[1]))
    # A closed form is not refused for its round-off, however small `rtol` is: no other method has a smaller error.
    judged = plan.tier == "coupled" or plan.error_bound > 0.0 or run.rough > 0.0
    if run.status is Status.SUCCESS and judged and excess_of(run.gaps, rounding) > rtol:
        run.status = Status.ERROR_NOT_MET
    if coarse:
        run.add_error(coarse)
