"""Sensitivities of a run on a series stack: tangents of its voltages by parameters, and what follows from them.

The run's own steps say what the area was at every time; `engine.tangent` solves the linear equations of the tangents
along them. What a parameter does to the layers, the contact, the source and the start is a fourth-order difference of
closed formulas, which is right to about 1e-12.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fingerspice.base.arrays import FloatArray, IntArray
from fingerspice.base.errors import InputError
from fingerspice.circuit.circuit import Circuit
from fingerspice.circuit.statespace import Stack, build_stack
from fingerspice.engine.tangent import Changes, Course, between_nodes, follow
from fingerspice.numerics.differences import AT, STEP, derivative
from fingerspice.numerics.lobatto import NODES, POINTS, integral_table
from fingerspice.physics.contact import N_PACKED, areas
from fingerspice.results.outcome import Failure, SolveError, Status
from fingerspice.results.record import Record, sided
from fingerspice.results.sensitivity import Sensitivity, Tangents, sensitivity_of, tangents_at
from fingerspice.results.solution import Solution
from fingerspice.results.steps import Recorded, Stretches, basis
from fingerspice.solve.initial import initial_state
from fingerspice.solve.pieces import driving
from fingerspice.solve.problem import Problem
from fingerspice.solve.scenes import Scene, scene_of
from fingerspice.solve.stackstate import model_of, to_stack
from fingerspice.solve.track import prepare_system

# Error of every sweep relative to what is asked of the run, and the smallest that is more than rounding.
_SHARE, _FINEST = 1e-2, 1e-13
_END = integral_table()[:, NODES - 1]


@dataclass(frozen=True)
class _Varied:
    """A parameter with circuits around its value."""

    path: str
    unit: str
    value: float
    step: float
    circuits: tuple[Circuit, ...]

    def by(self, of: Sequence[FloatArray | float]) -> FloatArray:
        """Derivative by the parameter of what has these values for the circuits."""
        return derivative(of, self.step * self.value)


def _varied(problem: Problem, path: str) -> _Varied:
    circuit = problem.circuit
    known = {name.lower(): (name, one) for name, one in circuit.parameters.items()}
    if path.lower() not in known:
        # Refused with the nearest name.
        circuit.varied({path: 1.0})
    name, parameter = known[path.lower()]
    if not (math.isfinite(parameter.value) and parameter.value != 0.0):
        raise InputError(
            f"sensitivities names {name}, which is {parameter.value:g}; allowed: parameters whose value is finite and "
            "not 0, as steps are relative to it"
        )
    step, (element, _, _) = STEP, name.rpartition(".")
    if circuit[element].waveform is not None:
        # A phase is a frequency times all the time since the start.
        step /= max(1.0, 2.0 * math.pi * problem.t_stop / problem.waveform.shortest_time())
    circuits = tuple(circuit.varied({name: parameter.value * (1.0 + step * at)}) for at in AT)
    return _Varied(name, parameter.unit, parameter.value, step, circuits)


def check_request(problem: Problem, paths: Sequence[str], method: str, start: str) -> str:
    """Refuse a run that has no sensitivities here; the method that steps it.

    Raises
    ------
    InputError
        With what is allowed.
    """
    if isinstance(paths, str) or not all(isinstance(path, str) for path in paths):
        raise InputError(f"sensitivities is {paths!r}; allowed: a sequence of paths such as ('Xgap.d',)")
    scene, what = problem.scene, ""
    if scene.stack is None or scene.stack.contact is None:
        what = "the circuit is no series stack with a GAP"
    elif not scene.coupled:
        what = f"the area is {scene.area_mode}"
    elif start == "given":
        what = "the run goes on from another one"
    elif method not in ("auto", "exponential"):
        what = f"the method is {method!r}"
    if what:
        raise InputError(
            f"sensitivities are asked for, and {what}; allowed: a series stack with area='coupled', one of the other "
            "starts, and the methods 'auto' and 'exponential'"
        )
    # A recording, or a PWL with many points, is otherwise followed point by point, without steps that are kept.
    return method if driving(problem) is None else "exponential"


def _layers(one: _Varied, stack: Stack, scene: Scene) -> tuple[FloatArray, FloatArray]:
    """Changes of the cells' c, g_total and g_area (3, n_cell), and those of the contact's constants."""
    skin = None if scene.skin is None else scene.skin.frequency
    stacks = [build_stack(circuit, skin) for circuit in one.circuits]
    cells = one.by([np.array([s.c, s.g_total, s.g_area]) for s in stacks])
    packed = one.by([s.contact.packed if s.contact is not None else np.zeros(N_PACKED) for s in stacks])
    return cells, packed


def _changes(varied: Sequence[_Varied], scene: Scene) -> Changes:
    stack = scene.stack
    assert stack is not None
    assert stack.gap is not None
    order, rows = list(stack.state_order), []
    for one in varied:
        (dc, dg_total, dg_area), packed = _layers(one, stack, scene)
        ds = -float(np.sum(dc / stack.c**2))
        dk = -stack.k * (dc / stack.c + ds / stack.s)
        rate, rate0 = (
            (dg - g * dc / stack.c) / stack.c for dg, g in ((dg_area, stack.g_area), (dg_total, stack.g_total))
        )
        rows.append((np.array([dk, rate, rate0])[:, order], dk[stack.gap], packed))
    return Changes(*(np.ascontiguousarray(np.array(x, float)) for x in zip(*rows, strict=True)))


@dataclass(frozen=True)
class _Steps:
    """The steps of a run in the order of time, those of repeated periods as often as they occur."""

    stretches: Stretches
    order: IntArray  # (n,)
    # begin, end (n,): s
    begin: FloatArray
    end: FloatArray


def _in_time(stretches: Stretches) -> _Steps:
    each, count = np.arange(stretches.start.size), stretches.count
    order = np.repeat(each, count)
    which = np.arange(order.size) - np.repeat(np.cumsum(count) - count, count)
    shift = stretches.shift[order] + which * stretches.period[order]
    begin, end = stretches.start[order] + shift, stretches.reached[order] + shift
    by_time = np.argsort(begin, kind="stable")
    return _Steps(stretches, order[by_time], begin[by_time], end[by_time])


def _source_changes(varied: Sequence[_Varied], steps: _Steps, problem: Problem) -> FloatArray:
    """Changes of the source by every parameter at the rows of every step, V per unit; empty where none moves it."""
    own = problem.waveform
    waves = [[build_stack(c).waveform for c in one.circuits] for one in varied]
    if all(wave == own for several in waves for wave in several):
        return np.zeros((len(varied), 0, POINTS.size))
    t = steps.begin[:, None] + POINTS * (steps.end - steps.begin)[:, None]
    left = np.broadcast_to(POINTS == 1.0, t.shape).ravel()
    out = np.zeros((len(varied), *t.shape))
    edges = problem.breakpoints()
    for i, (one, several) in enumerate(zip(varied, waves, strict=True)):
        if all(wave == own for wave in several):
            continue
        for wave in several:
            moved = wave.breakpoints(problem.t_start, problem.t_stop)
            if moved.shape != edges.shape or not np.array_equal(moved, edges):
                raise InputError(
                    f"sensitivities names {one.path}, which moves the edges of its source; allowed: parameters that "
                    "leave them where they are, such as an amplitude, or the frequency of a sine"
                )
        out[i] = one.by([sided(wave, t.ravel(), left) for wave in several]).reshape(t.shape)
    return out


def _starts(varied: Sequence[_Varied], problem: Problem, start: str) -> FloatArray:
    """The run's own state x at the start (times A_0 under `mobile`) and its changes, shape (1 + n_parameter, n)."""
    scene, model = problem.scene, model_of(problem.scene)
    scale = model.area0 if model.mobile else 1.0
    own = scale * problem.inner.y[:-1]
    out = np.zeros((1 + len(varied), own.size))
    out[0] = own
    if start == "periodic" or not own.any():
        return out
    for i, one in enumerate(varied):
        states = []
        for circuit in one.circuits:
            other = scene_of(circuit, scene.charge_law, "coupled", problem.t_stop, 0.0)
            inner = to_stack(other, initial_state(circuit, other, start))
            area0 = model_of(other).area0 if model.mobile else 1.0
            states.append(area0 * inner.y[:-1])
        out[1 + i] = one.by(states)
    return out


def _followed(
    problem: Problem, rtol: float, course: Course, changes: Changes, start: FloatArray, steps: _Steps
) -> tuple[FloatArray, FloatArray]:
    """Changes of gap voltage and 1/A at the nodes of all steps (see `follow`), and state and tangents at the end.

    Raises
    ------
    SolveError
        Where a step's iteration does not close.
    """
    prepared = prepare_system(problem.scene, rtol)
    out, ends = np.empty((len(start) - 1, 2, course.order.size, NODES)), np.empty(start.shape)
    tol = max(_SHARE * rtol, _FINEST)
    stuck = follow(prepared.system, prepared.tables, course, changes, start, tol, out, ends)
    if stuck >= 0:
        at = float(steps.begin[stuck])
        cause = f"the iteration for the sensitivities did not close in the step at {at:.6g} s"
        raise SolveError(Failure(Status.STEP_UNDERFLOW, cause, "a smaller rtol takes shorter steps", at))
    return out, ends


def _one_period(course: Course, steps: _Steps, end: float) -> Course:
    """The steps up to a time (s); the one that goes beyond it is cut there."""
    last = min(int(np.searchsorted(steps.end, end)), steps.end.size - 1)
    share = min((end - steps.begin[last]) / (steps.end[last] - steps.begin[last]), 1.0)
    by, step = basis(share * POINTS[None])[0], steps.order[last]
    u, s = (np.vstack([x, by @ x[step, :NODES]]) for x in (course.u, course.s))
    moved = course.moved[:, : last + 1].copy()
    if moved.shape[1]:
        moved[:, last] = moved[:, last, :NODES] @ by.T
    order = np.append(course.order[:last], len(course.h))
    return Course(np.append(course.h, share * course.h[step]), order, u, s, moved)


def _longer(varied: Sequence[_Varied], problem: Problem) -> FloatArray:
    """Changes of the source's period by every parameter, s per unit."""
    own, out = problem.waveform.period, np.zeros(len(varied))
    for i, one in enumerate(varied):
        periods = [build_stack(circuit).waveform.period for circuit in one.circuits]
        if own is None or any(period is None or abs(period / own - 1.0) > 0.01 for period in periods):
            raise InputError(
                f"sensitivities of a periodic state name {one.path}, near whose value the source has no such period; "
                "allowed: other parameters, or a run from another start"
            )
        out[i] = 0.0 if all(period == own for period in periods) else one.by([period or own for period in periods])
    return out


def _drift(problem: Problem, course: Course, own: FloatArray) -> FloatArray:
    """x' of the run's own state x at its start, 1/s."""
    model, first = model_of(problem.scene), course.order[0]
    q = float(1.0 / areas(course.u[first, :1], model.curve)[0])
    k, rate, rate0 = (np.asarray(x, float) for x in (model.k, model.rate, model.rate0))
    source = course.s[first, 0] / q if model.mobile else course.s[first, 0]
    leak = (rate + q * rate0) * (k * source + np.append(own, -own.sum()))
    return np.asarray((k * leak.sum() - leak)[:-1])


def _closed(
    problem: Problem, rtol: float, course: Course, changes: Changes, start: FloatArray, steps: _Steps,
    longer: FloatArray,
) -> FloatArray:  # fmt: skip
    """The tangents at the start of a periodic state: those that a period leads back to; it grows by `longer`."""
    drift = np.outer(longer, _drift(problem, course, start[0]))
    period, n, count = problem.waveform.period or math.inf, start.shape[1], len(start) - 1
    if problem.t_stop - problem.t_start < period * (1.0 - 1e-9):
        raise InputError(
            f"sensitivities of a periodic state need a run over a whole period, {period:g} s; allowed: a longer t_stop"
        )
    course = _one_period(course, steps, problem.t_start + period)
    # Besides the parameters' own tangents, that of each live voltage alone: the derivative of the map of the period.
    more = Changes(*(np.concatenate([x, np.zeros((n, *x.shape[1:]))]) for x in changes))
    moved = np.concatenate([course.moved, np.zeros((n, *course.moved.shape[1:]))])
    first = np.concatenate([start, np.eye(n)])
    _, ends = _followed(problem, rtol, course._replace(moved=moved), more, first, steps)
    out = start.copy()
    out[1:] = np.linalg.solve(np.eye(n) - ends[1 + count :].T, (ends[1 : 1 + count] + drift).T).T
    return out


def _at_outputs(steps: _Steps, record: Record, at_nodes: FloatArray) -> FloatArray:
    """What is known at the nodes of all steps (m, n, NODES) at the outputs, shape (m, n_t)."""
    t, last = record.t, steps.end.size - 1
    # A left-hand value is that at the end of the step before.
    at = np.where(record.left, np.searchsorted(steps.end, t), np.searchsorted(steps.begin, t, "right") - 1)
    at = np.clip(at, 0, last)
    fraction = np.clip((t - steps.begin[at]) / (steps.end - steps.begin)[at], 0.0, 1.0)
    out = np.empty((len(at_nodes), t.size))
    between_nodes(at, fraction, at_nodes, out)
    return out


def _weights(problem: Problem, steps: _Steps) -> tuple[FloatArray, FloatArray]:
    """Where each step is evaluated for means from TSTART on, as fractions of it (n, NODES), and with what weights."""
    length = steps.end - steps.begin
    low = np.clip((problem.first - steps.begin) / length, 0.0, 1.0)[:, None]
    weight = (1.0 - low) * length[:, None] * _END
    return low + (1.0 - low) * POINTS[:NODES], weight / weight.sum()


def _grown(
    at: Tangents, packed: FloatArray, u: FloatArray, area: FloatArray, weight: FloatArray, growth: float
) -> Tangents:
    """The changes at the nodes, with what means over a period gain where it grows by `growth`, relative to itself."""
    stress, f_n, mu = packed[4:7]

    def gain(x: FloatArray) -> float:
        return float(growth * (x[-1] - (weight * x).sum()))

    f_el = gain(stress * u**2 * area)
    f_t = mu * f_el
    return Tangents(at.u_gap, at.area + gain(area), at.f_el + f_el, at.f_t + f_t, at.friction + f_t / f_n)


def sensitivities_of(
    problem: Problem, solution: Solution, paths: Sequence[str], start: str, over_period: bool = False
) -> dict[str, Sensitivity]:
    """Derivatives of a run's signals by parameters.

    Parameters
    ----------
    problem : Problem
    solution : Solution
        Its run by exponential steps.
    paths : sequence of str
        As in `Circuit.replace`.
    start : str
        How the run started.
    over_period : bool
        Whether means are over a period, which a parameter may change.

    Raises
    ------
    InputError
        For an unknown parameter, or one that is not covered.
    SolveError
        Where a step's iteration does not close.
    """
    varied, stack = [_varied(problem, path) for path in paths], problem.scene.stack
    stretches, record, rtol = None, solution.record, solution.rtol
    assert isinstance(record, Record)
    if isinstance(solution.continuous, Recorded):
        stretches = solution.continuous.run({}, problem.t_start, problem.t_stop)
    if stretches is None:
        raise InputError(
            "sensitivities need the steps of the run, and it has too many of them to be kept; allowed: a shorter run"
        )
    assert stack is not None
    assert stack.contact is not None
    steps, changes, turn = _in_time(stretches), _changes(varied, problem.scene), float(stack.sign[stack.gap or 0])
    every = stretches.panels(-math.inf, math.inf)
    u, s = (stretches.at_points(read, every)[1] for read in (lambda one: turn * one.u_gap, lambda one: one.u_source))
    moved = _source_changes(varied, steps, problem)
    course = Course(stretches.length * stretches.reach, steps.order, u, s, moved)
    begun, longer = _starts(varied, problem, start), np.zeros(len(varied))
    if start == "periodic":
        longer = _longer(varied, problem)
        begun = _closed(problem, rtol, course, changes, begun, steps, longer)
    nodes, _ = _followed(problem, rtol, course, changes, begun, steps)
    outputs = _at_outputs(steps, record, nodes.reshape(-1, *nodes.shape[2:])).reshape(len(varied), 2, -1)
    fraction, weight = _weights(problem, steps)
    inside = np.concatenate([u[None, steps.order, :NODES], nodes.reshape(-1, *nodes.shape[2:])])
    cut = np.flatnonzero(fraction[:, 0] > 0.0)
    inside[:, cut] = np.einsum("pqn,cpn->cpq", basis(fraction[cut]), inside[:, cut])
    flat, packed, found = inside.reshape(len(inside), -1), stack.contact.packed, {}
    area, curve = record.area, model_of(problem.scene).curve
    assert area is not None
    area_inside = areas(flat[0], curve)
    for i, one in enumerate(varied):
        by_packed = changes.contact[i]
        at_outputs = tangents_at(packed, by_packed, turn * record.u_gap, area, *outputs[i])
        at_nodes = tangents_at(packed, by_packed, flat[0], area_inside, *flat[1 + 2 * i : 3 + 2 * i])
        if over_period:
            growth = float(longer[i] / (problem.waveform.period or math.inf))
            at_nodes = _grown(at_nodes, packed, flat[0], area_inside, weight.ravel(), growth)
        found[one.path] = sensitivity_of(one.path, one.unit, one.value, at_outputs, at_nodes, weight.ravel(), turn)
    return found
