"""Derivatives of a number that follows from a run by every sample of its source (`engine.adjoint`)."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from fingerspice.base.arrays import FloatArray, IntArray, real_numbers
from fingerspice.base.errors import FingerspiceWarning, InputError
from fingerspice.engine.adjoint import new_room, sweep
from fingerspice.engine.adjointsteps import Course, Wanted
from fingerspice.engine.system import System
from fingerspice.numerics.differences import AT, STEP, derivative
from fingerspice.physics.contact import inverse_areas_with_slopes
from fingerspice.results.outcome import Failure, SolveError, Status
from fingerspice.results.samplegradient import SampleGradient
from fingerspice.results.solution import Solution
from fingerspice.solve.initial import initial_state
from fingerspice.solve.problem import Problem
from fingerspice.solve.scenes import scene_of
from fingerspice.solve.simulation import asked, run_problem
from fingerspice.solve.stackstate import model_of, to_stack
from fingerspice.solve.track import prepare_system
from fingerspice.waveforms.combinations import Sum
from fingerspice.waveforms.recorded import as_samples
from fingerspice.waveforms.samples import Samples
from fingerspice.waveforms.waveform import DC

SIGNALS = ("u_gap", "area", "f_el", "f_t", "friction")
MEANS = ("area_mean", "f_el_mean", "f_t_mean", "friction_mean")
# Steps of a sample's length in each attempt; and the error wanted, relative to the largest derivative, over `rtol`.
_ATTEMPTS, _ALLOWED = (2, 4, 8, 16), 10.0
# Error of the finer steps at most, over their difference from the coarser ones, whose order is 4, or 2 where the
# integrand jumps with the area's slope.
_LEFT = 0.5
# Error of the iteration in every step, over `rtol`.
_SHARE = 1e-2


@dataclass(frozen=True)
class _Grid:
    """Steps of equal length between the samples of a recording, from the start of a run to its end."""

    t: FloatArray  # (2 n + 1,): Start, middle and end of the n steps, s
    # sample, share, width (n,): See `engine.adjoint.Course`
    sample: IntArray
    share: FloatArray
    width: FloatArray

    @property
    def coarser(self) -> _Grid:
        """Half as many steps."""
        return _Grid(self.t[::2], self.sample[::2], self.share[::2], 2.0 * self.width[::2])

    def place(self, t: FloatArray) -> tuple[IntArray, FloatArray]:
        """Steps that contain times (s), with their ends, and the fractions of them."""
        ends = self.t[::2]
        step = np.clip(np.searchsorted(ends, t, "left") - 1, 0, self.sample.size - 1)
        return step, np.clip((t - ends[step]) / (ends[step + 1] - ends[step]), 0.0, 1.0)


def _grid(wave: Samples, t0: float, t1: float, steps: int) -> _Grid:
    first, last = math.ceil((t0 - wave.start) * wave.rate - 1e-6), math.floor((t1 - wave.start) * wave.rate + 1e-6)
    inner = wave.start + np.arange(first, last + 1) / wave.rate
    slack = 1e-6 / wave.rate
    edges = np.concatenate([[t0], inner[(inner > t0 + slack) & (inner < t1 - slack)], [t1]])
    number = np.floor((0.5 * (edges[:-1] + edges[1:]) - wave.start) * wave.rate)
    along = (number >= 0) & (number < wave.count - 1)
    here = np.where(along, (edges[:-1] - wave.start) * wave.rate - number, 0.0)
    length = np.where(along, np.diff(edges) * wave.rate, 0.0)
    part = np.arange(2 * steps) / (2 * steps)
    t = np.append((edges[:-1, None] + np.diff(edges)[:, None] * part).ravel(), t1)
    share = (here[:, None] + length[:, None] * part[::2]).ravel()
    sample = np.clip(number, 0, wave.count - 1).astype(np.int64)
    return _Grid(t, np.repeat(sample, steps), share, np.repeat(length / steps, steps))


def _course(system: System, run: Solution, problem: Problem, grid: _Grid) -> Course:
    stack, model = problem.scene.stack, system.model
    assert stack is not None
    assert stack.gap is not None
    assert run.u_gap is not None
    u = np.asarray(float(stack.sign[stack.gap]) * run.u_gap)
    q, dq = inverse_areas_with_slopes(u, model.curve)
    s, rows = run.u_source, []
    for i in np.flatnonzero(model.rate0 > 0.0):
        cell = stack.state_order[i]
        v = float(stack.sign[cell]) * run.u_layer[:, stack.layer_of(cell)]
        rows.append((v - model.k[i] * s) / (model.area0 * q) if model.mobile else v)
    h = np.diff(grid.t[::2])
    x = np.ascontiguousarray(rows) if rows else np.zeros((0, u.size))
    held = (u - model.k_gap * s) / q if model.mobile else np.zeros(0)
    return Course(h, u, np.ascontiguousarray(s), held, x, q, dq * np.sign(u), grid.sample, grid.share, grid.width)


def _coarser(c: Course, grid: _Grid) -> Course:
    u, s, held, q, dq = (np.ascontiguousarray(row[::2]) for row in (c.u, c.s, c.held, c.q, c.dq))
    x = np.ascontiguousarray(c.x[:, ::2])
    return Course(np.diff(grid.t[::2]), u, s, held, x, q, dq, grid.sample, grid.share, grid.width)


@dataclass(frozen=True)
class _Weights:
    """The scalar's derivatives by u_gap, force and area at the outputs, shape (n_t,), and by the latter's means."""

    u_gap: FloatArray
    f_el: FloatArray
    area: FloatArray
    f_el_mean: float
    area_mean: float


def _weights(run: Solution, of: Mapping[str, ArrayLike]) -> _Weights:
    if not of:
        raise InputError(f"no signal is given; allowed: {', '.join((*SIGNALS, *MEANS))}")
    signals = {name: np.zeros(run.t.size) for name in SIGNALS}
    means = dict.fromkeys(MEANS, 0.0)
    for name, given in of.items():
        known = signals if name in signals else means if name in means else None
        if known is None:
            raise InputError(f"unknown signal {name!r}; allowed: {', '.join((*SIGNALS, *MEANS))}")
        value = real_numbers(name, given, "numbers, derivatives by the signal")
        shape = () if known is means else run.t.shape
        if value.shape != shape or not np.isfinite(value).all():
            raise InputError(
                f"{name} has the shape {value.shape}"
                + ("" if np.isfinite(value).all() else " and numbers that are not finite")
                + f"; allowed: the shape {shape}, finite: the derivative of a number by that signal"
            )
        if known is means:
            means[name] = float(value)
        else:
            signals[name] = value
    ((_, contact),) = run.record.fingers
    # F_t = mu (F_N + F_el), and the friction coefficient is F_t / F_N.
    force = signals["f_el"] + contact.mu * (signals["f_t"] + signals["friction"] / contact.f_n)
    mean = means["f_el_mean"] + contact.mu * (means["f_t_mean"] + means["friction_mean"] / contact.f_n)
    return _Weights(signals["u_gap"], force, signals["area"], mean, means["area_mean"])


def _wanted(weights: _Weights, run: Solution, problem: Problem, system: System, grid: _Grid) -> Wanted:
    stack = problem.scene.stack
    assert stack is not None
    assert stack.gap is not None
    assert run.u_gap is not None
    turn = float(stack.sign[stack.gap])
    u = np.asarray(turn * run.u_gap)
    q, dq = inverse_areas_with_slopes(u, system.model.curve)
    dq = dq * np.sign(u)
    by_u = turn * weights.u_gap - weights.area * dq / q**2
    by_u += weights.f_el * system.stress * u * (2.0 - u * dq / q) / q
    some = np.flatnonzero(by_u)
    step, at = grid.place(run.t[some])
    begin, fraction = grid.place(np.array([run.first]))
    length = problem.t_stop - run.first
    return Wanted(
        weights.f_el_mean / length,
        weights.area_mean / length,
        (int(begin[0]), float(fraction[0])),
        step,
        at,
        by_u[some],
    )


def _source_of(problem: Problem) -> tuple[str, float, Samples]:
    """Name, sign along the loop and samples of the only source that is a recording."""
    stack = problem.scene.stack
    if stack is None or stack.contact is None or not problem.scene.coupled:
        raise InputError(
            "derivatives by samples are asked for, and the circuit is no series stack with a GAP whose area is "
            "coupled; allowed: one"
        )
    found = []
    for element, sign in stack.sources:
        wave = None if element.waveform is None else as_samples(element.waveform)
        if wave is not None:
            found.append((element.name, float(sign), wave))
    if len(found) != 1:
        raise InputError(
            f"derivatives by samples are asked for, and {len(found)} sources of the circuit are recordings; allowed: "
            "one, such as fs.Samples, or a PWL on an even grid"
        )
    return found[0]


def _by_first_value(run: Solution, problem: Problem) -> FloatArray:
    """Derivative of the state x at the start by the source's value there."""
    scene, model = problem.scene, model_of(problem.scene)
    if not problem.initial.s_before.any():
        return np.zeros(model.gap.size)
    name, sign, wave = _source_of(problem)
    step, states = STEP * scene.u_peak, []
    for at in AT:
        other = run.circuit.replace({name: Sum((wave, DC(sign * at * step)))})
        moved = scene_of(other, scene.charge_law, "coupled", problem.t_stop, 0.0)
        inner = to_stack(moved, initial_state(other, moved, run.start))
        states.append(inner.y[:-1])
    return derivative(states, step)


def _swept(
    run: Solution, problem: Problem, system: System, weights: _Weights, wave: Samples, steps: int
) -> tuple[FloatArray, FloatArray]:  # fmt: skip
    """Derivatives by the loop's samples, with so many steps of a sample's length and with half as many, 1/V."""
    grid = _grid(wave, problem.t_start, problem.t_stop, steps)
    dense = run_problem(problem, grid.t, run.rtol, tier="coupled", start=run.start, jumps="none")
    if dense.failure is not None:
        raise SolveError(dense.failure)
    course, found = _course(system, dense, problem, grid), []
    r = int(np.argmin(np.abs(np.log(system.q0) - 0.5 * np.log(course.q.min() * course.q.max()))))
    for c, where in ((course, grid), (_coarser(course, grid.coarser), grid.coarser)):
        wanted, out = _wanted(weights, run, problem, system, where), np.zeros(wave.count)
        room = new_room(system.rates.shape[1], system.tap_k.size, np.bincount(wanted.step, minlength=1).max())
        stuck = sweep(system, r, c, wanted, _SHARE * run.rtol, room, out)
        if stuck >= 0:
            cause = "the iteration for the derivatives by samples did not close"
            at = float(where.t[2 * stuck])
            raise SolveError(Failure(Status.STEP_UNDERFLOW, cause, "a higher sample rate takes shorter steps", at))
        begun = float(room.reached @ system.project[r] @ _by_first_value(run, problem))
        # The source at the start lies between two samples.
        share = float(where.share[0])
        out[where.sample[0]] += begun * (1.0 - share)
        out[min(where.sample[0] + 1, wave.count - 1)] += begun * share
        found.append(out)
    return found[0], found[1]


def sample_gradient(run: Solution, of: Mapping[str, ArrayLike]) -> SampleGradient:
    """See `Solution.sample_gradient`."""
    if run.stored is not None or run.start == "given":
        raise InputError(
            "derivatives by samples are asked for, and the run goes on from another one or was read from a file; "
            "allowed: a run just made from its circuit's own start"
        )
    if run.failure is not None:
        raise InputError("derivatives by samples are asked for, and the run failed; allowed: a run to its end")
    problem = asked(
        run.circuit, t_stop=run.t_stop, t_eval=None, charge_law=run.charge_law, area=run.area_mode, start=run.start,
        charge=False, rtol=run.rtol,
    )  # fmt: skip
    name, sign, wave = _source_of(problem)
    weights, system = _weights(run, of), prepare_system(problem.scene, run.rtol).system
    for steps in _ATTEMPTS:
        fine, coarse = _swept(run, problem, system, weights, wave, steps)
        largest = float(np.abs(fine).max())
        error = _LEFT * float(np.abs(fine - coarse).max()) + run.rtol * largest
        if error <= _ALLOWED * run.rtol * largest:
            break
    else:
        warnings.warn(
            f"the derivatives by samples have an error of {error:.1e}, {error / largest:.0e} of the largest one; a "
            "higher sample rate makes it smaller",
            FingerspiceWarning,
            stacklevel=3,
        )
    return SampleGradient(name, wave.rate, wave.start, sign * fine, error)
