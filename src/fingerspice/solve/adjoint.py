"""Derivatives of a number that follows from a run by every sample of its source.

The run is followed in lanes (`solve.recordings.block`), by so many steps in each interval between samples. What an
interval leads to is differentiated by what it starts from and by the source at its ends (`engine.lanes.loops`); back
from the end of the run, these derivatives are multiplied.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from fingerspice.base.arrays import BoolArray, FloatArray, IntArray, real_numbers
from fingerspice.base.errors import FingerspiceWarning, InputError
from fingerspice.engine.lanes.loops import AREAS, GAP, MORE, SQUARES, lead, sum_back
from fingerspice.numerics.small import AT, STEP, derivative
from fingerspice.physics.contact import inverse_areas_with_slopes
from fingerspice.results.outcome import Failure, SolveError, Status
from fingerspice.results.sensitivity import MEANS, SIGNALS, SampleGradient
from fingerspice.results.solution import Solution
from fingerspice.solve.problem import Problem
from fingerspice.solve.recordings.block import Block
from fingerspice.solve.recordings.form import LaneForm
from fingerspice.solve.recordings.pieces import driving
from fingerspice.solve.recordings.run import ready
from fingerspice.solve.simulation import asked
from fingerspice.waveforms.combinations import Sum
from fingerspice.waveforms.samples import Samples, as_samples
from fingerspice.waveforms.waveform import DC

# Steps of an interval: of the first two numbers, or below this `rtol` of the second and third, and twice as many while
# these differ; and the error wanted, relative to the largest derivative, over `rtol`.
_STEPS, _COARSE, _ALLOWED = (1, 2, 4, 8, 16, 32, 64), 1e-7, 10.0
# Distance of the differences, over the largest voltage.
_APART = 1e-5
# Intervals whose derivatives are held at once.
_AT_ONCE = 1 << 13
# Change of starts that is left, over the largest voltage; errors of the polynomials, over that asked for.
_CLOSED, _SHARE = 1e-14, 1e-2


class _Weights(NamedTuple):
    """The scalar's derivatives by u_gap, force and area at the outputs, shape (n_t,), and by the latter's means."""

    u_gap: FloatArray
    f_el: FloatArray
    area: FloatArray
    f_el_mean: float
    area_mean: float


def _weights(run: Solution, of: Mapping[str, ArrayLike]) -> _Weights:
    allowed = ", ".join((*SIGNALS, *MEANS))
    if not of:
        raise InputError(f"no signal is given; allowed: {allowed}")
    by: dict[str, Any] = dict.fromkeys(SIGNALS, np.zeros(run.t.size)) | dict.fromkeys(MEANS, 0.0)
    for name, given in of.items():
        if name not in by:
            raise InputError(f"unknown signal {name!r}; allowed: {allowed}")
        value = real_numbers(name, given, "numbers, derivatives by the signal")
        shape = () if name in MEANS else run.t.shape
        if value.shape != shape or not np.isfinite(value).all():
            raise InputError(
                f"{name} has the shape {value.shape}"
                + ("" if np.isfinite(value).all() else " and numbers that are not finite")
                + f"; allowed: the shape {shape}, finite: the derivative of a number by that signal"
            )
        by[name] = value
    ((_, contact),) = run.record.fingers
    # F_t = mu (F_N + F_el), and the friction coefficient is F_t / F_N.
    force, mean = (
        by[f"f_el{kind}"] + contact.mu * (by[f"f_t{kind}"] + by[f"friction{kind}"] / contact.f_n)
        for kind in ("", "_mean")
    )
    return _Weights(by["u_gap"], force, by["area"], float(mean), float(by["area_mean"]))


@dataclass(frozen=True)
class _Run:
    """A run between the samples of its source."""

    problem: Problem
    form: LaneForm
    name: str  # Of the source
    sign: float  # Of the source along the loop
    wave: Samples  # Its own
    t: FloatArray  # (n + 1,): Start and end of the run, samples between, and the start of the means, s
    start: FloatArray  # (m,): Modes at the start
    # (m,): Their derivatives by the source there
    moved: FloatArray

    @property
    def turn(self) -> float:
        """Sign of the gap voltage along the loop."""
        stack = self.problem.scene.stack
        return 1.0 if stack is None or stack.gap is None else float(stack.sign[stack.gap])


def _source_of(problem: Problem) -> tuple[str, float, Samples]:
    """Name, sign along the loop and samples of the only source that is a recording, beside constant ones."""
    scene, stack = problem.scene, problem.scene.stack
    if len(problem.network.fingers) != 1 or not scene.coupled:
        raise InputError(
            "derivatives by samples are asked for, and the circuit has no single GAP whose area is coupled; allowed: "
            "one"
        )
    sources = [(e, 1.0) for e in problem.network.sources] if stack is None else stack.sources
    waves = [(e.name, float(sign), None if e.waveform is None else as_samples(e.waveform)) for e, sign in sources]
    known = [(name, sign, wave) for name, sign, wave in waves if wave is not None]
    if len(known) != 1 or not isinstance(driving(problem), Samples):
        others = "sources of 0" if stack is None else "constant ones"
        raise InputError(
            f"derivatives by samples are asked for, and of the circuit's {len(waves)} sources {len(known)} are "
            f"recordings; allowed: one, such as fs.Samples, or a PWL on an even grid, beside {others}"
        )
    return known[0]


def _run_of(run: Solution) -> _Run:
    def problem_of(by: float) -> Problem:
        circuit = run.circuit if by == 0.0 else run.circuit.varied({name: Sum((wave, DC(sign * by)))})
        return asked(
            circuit, t_stop=run.t_stop, t_eval=None, charge_law=run.charge_law, area=run.area_mode, start=run.start,
            charge=False, rtol=run.rtol,
        )  # fmt: skip

    problem = problem_of(0.0)
    name, sign, wave = _source_of(problem)
    form = ready(problem, max(_SHARE * run.rtol, 1e-13)) or ready(problem, run.rtol)
    if form is None:
        raise InputError(
            "derivatives by samples are asked for, and this circuit is not followed sample by sample "
            "(docs/recordings.md); allowed: a circuit that is"
        )
    t0, t1 = problem.t_start, problem.t_stop
    first, last = math.ceil((t0 - wave.start) * wave.rate - 1e-6), math.floor((t1 - wave.start) * wave.rate + 1e-6)
    t, slack = wave.start + np.arange(first, last + 1) / wave.rate, 1e-6 / wave.rate
    t = np.concatenate([[t0], t[(t > t0 + slack) & (t < t1 - slack)], [t1]])
    if np.abs(t - run.first).min() > slack:
        t = np.insert(t, np.searchsorted(t, run.first), run.first)
    start, moved = form.start(problem)[0][: form.lanes.rates.size], np.zeros(form.lanes.rates.size)
    if problem.initial.s_before.any():
        step = STEP * problem.scene.u_peak
        moved = derivative([form.start(problem_of(at * step))[0][: moved.size] for at in AT], step)
    return _Run(problem, form, name, sign, wave, t, start, moved)


def _by_gap(weights: _Weights, run: Solution, one: _Run) -> FloatArray:
    """Derivatives of the number by the gap voltage at the outputs, along the loop."""
    ((_, contact),) = run.record.fingers
    assert run.u_gap is not None
    u = one.turn * run.u_gap
    q, dq = inverse_areas_with_slopes(u, contact.curve(one.problem.scene.u_top))
    dq = dq * np.sign(u)
    by_u = one.turn * weights.u_gap - weights.area * dq / q**2
    return np.asarray(by_u + weights.f_el * contact.stress(1.0) * u * (2.0 - u * dq / q) / q)


class _Intervals:
    """The intervals of a run between its times, with the modes at all of these."""

    def __init__(self, one: _Run, rtol: float) -> None:
        self.form, self.rtol, self.first, h = one.form, rtol, 0 if rtol >= _COARSE else 1, np.diff(one.t)
        # Lengths of the intervals (n,), or their common one (1,), s
        self.h = h if np.ptp(h) > 1e-9 * h[0] else np.array([h.mean()])
        self.x, self.m = np.ascontiguousarray(one.problem.waveform.value(one.t)), one.form.lanes.rates.size
        block, form, n = Block(one.form, self.x, self.h, True), one.form, one.t.size - 1
        peak = float(np.abs(self.x).max(initial=1e-300)) * form.gain
        solved = block.solve(one.start, _STEPS[self.first + 2], _CLOSED * peak) and block.on_one_branch
        if not solved or float(np.abs(form.gap(block.xi)).max()) > form.u_top:
            cause = "the run is not followed sample by sample, for its derivatives by samples"
            at = float(one.t[0])
            raise SolveError(Failure(Status.STEP_UNDERFLOW, cause, "a higher sample rate takes shorter steps", at))
        self.z = block.kept[: self.m, :, :-1].reshape(self.m, -1)[:, :n]
        sizes = np.append(np.abs(self.z).max(axis=1), np.abs(self.x).max())
        self.delta = _APART * np.where(sizes > 0.0, sizes, peak)

    def _slopes(self, at: IntArray, to: FloatArray, length: FloatArray, parts: int) -> FloatArray:
        """Derivatives of what intervals lead to as `sum_back` takes them, by central differences."""
        form, own, m = self.form, length.size > 1, self.m
        state, weights = form.room(own)
        if not own:
            form.weigh(length / parts, weights[1])
        apart, out = np.append(self.delta, self.delta[-1]), np.empty((2 * (m + 2), m + MORE, at.size))
        shifts, z = np.concatenate([np.diag(apart), np.diag(-apart)]), np.ascontiguousarray(self.z[:, at])
        lead(form.marks(own), form.lanes, weights, z, self.x[at], to, length, parts, shifts, state, out)
        out *= np.tile(0.5 / apart, 2)[:, None, None]
        return np.ascontiguousarray((out[: m + 2] - out[m + 2 :]).transpose(1, 0, 2))

    def slopes(self, at: IntArray, to: FloatArray, length: FloatArray, rows: BoolArray) -> list[FloatArray]:
        """Derivatives (`_slopes`) from the starts of the intervals `at`, where the source goes to `to` in a `length`.

        They come twice: as of the shortest steps, and extrapolated. `rows` says which of them are wanted.
        """
        if not length.any():
            return 2 * [self._slopes(at, to, length, 1)]
        m, many, first = self.m, length.size > 1, self.first
        coarse, fine = (self._slopes(at, to, length, parts) for parts in _STEPS[first : first + 2])
        # By the modes for what moves them, and by the source relative to the largest one.
        moved = self.delta[:m, None] * np.abs(fine[:, :m])
        scale = np.abs(fine[:, m:]).max(axis=(1, 2))[:, None] + np.zeros(m + 2)
        scale[:, :m] = moved.max(axis=(1, 2))[:, None] / self.delta[:m]
        wanted = rows[:, None, None] & (np.abs(fine - coarse) > _ALLOWED * self.rtol * scale[..., None])
        for parts in _STEPS[first + 2 :]:
            (still,) = np.nonzero(wanted.any(axis=(0, 1)))
            if not still.size:
                break
            coarse[..., still] = fine[..., still]
            fine[..., still] = self._slopes(at[still], to[still], length[still] if many else length, parts)
            off = np.abs(fine[..., still] - coarse[..., still]) > _ALLOWED * self.rtol * scale[..., None]
            wanted[..., still] = rows[:, None, None] & off
        # Steps are of third order where the source is a line and the gap voltage has no zero.
        return [fine, fine + (fine - coarse) / 7.0]


def _outputs(by: _Intervals, one: _Run, run: Solution, weights: _Weights) -> tuple[FloatArray, FloatArray]:
    """Derivatives of the number by modes (2, m, n) and source (2, n + 1) at all times, by the outputs after each."""
    n, m, t, x, by_u = by.x.size - 1, by.m, one.t, by.x, _by_gap(weights, run, one)
    of_modes, of_source = np.zeros((2, m, n)), np.zeros((2, n + 1))
    place = np.clip(np.searchsorted(t, run.t, "right") - 1, 0, n - 1)
    share = (run.t - t[place]) / (t[place + 1] - t[place])
    on = share < 1e-9
    for which, between in ((on, False), (~on, True)):
        for some in _parts_of(np.flatnonzero(which & (by_u != 0.0))):
            at, part = place[some], share[some] if between else np.zeros(some.size)
            to = x[at] + part * (x[at + 1] - x[at])
            length = part * np.diff(t)[at] if between else np.zeros(1)
            for row, found in enumerate(by.slopes(at, to, length, np.arange(m + MORE) == m + GAP)):
                of_gap = by_u[some] * found[m + GAP]
                for k in range(m):
                    np.add.at(of_modes[row, k], at, of_gap[k])
                np.add.at(of_source[row], at, of_gap[m] + (1.0 - part) * of_gap[m + 1])
                np.add.at(of_source[row], at + 1, part * of_gap[m + 1])
    return of_modes, of_source


def _swept(one: _Run, run: Solution, weights: _Weights) -> FloatArray:
    """Derivatives by the samples, with half the steps and with all, shape (2, n_sample)."""
    by, t, ((_, contact),) = _Intervals(one, run.rtol), one.t, run.record.fingers
    of_modes, of_source = _outputs(by, one, run, weights)
    n, after, means = t.size - 1, np.zeros((2, by.m)), np.zeros((MORE, t.size - 1))
    means[SQUARES], means[AREAS] = weights.f_el_mean * contact.stress(1.0), weights.area_mean
    means *= (t[:-1] >= run.first - 1e-9 * (t[-1] - t[0])) / (t[-1] - run.first)
    rows = np.append(np.ones(by.m, bool), means.any(axis=1))
    for at in reversed(_parts_of(np.arange(n))):
        a, b = at[0], at[-1] + 1
        length = by.h[a:b] if by.h.size > 1 else by.h
        for row, found in enumerate(by.slopes(at, by.x[at + 1], length, rows)):
            own = np.ascontiguousarray(means[:, a:b]), np.ascontiguousarray(of_modes[row, :, a:b])
            sum_back(found, *own, of_source[row, a : b + 1], after[row])
    of_source[:, 0] += after @ one.moved
    # Samples before the times, and how far these are beyond, in samples.
    out, place = np.zeros((2, one.wave.count)), np.clip((t - one.wave.start) * one.wave.rate, 0.0, one.wave.count - 1.0)
    first = np.minimum(np.floor(place + 1e-6), one.wave.count - 2.0).astype(np.int64)
    beyond = np.maximum(place - first, 0.0)
    for row in range(2):
        np.add.at(out[row], first, (1.0 - beyond) * of_source[row])
        np.add.at(out[row], np.minimum(first + 1, one.wave.count - 1), beyond * of_source[row])
    return out


def _parts_of(numbers: IntArray) -> list[IntArray]:
    """Rows of numbers, as many at once as memory is kept for."""
    return [numbers[a : a + _AT_ONCE] for a in range(0, numbers.size, _AT_ONCE)]


def sample_gradient(run: Solution, of: Mapping[str, ArrayLike]) -> SampleGradient:
    """See `Solution.sample_gradient`."""
    if run.stored is not None or run.start == "given":
        raise InputError(
            "derivatives by samples are asked for, and the run goes on from another one or was read from a file; "
            "allowed: a run just made from its circuit's own start"
        )
    if run.failure is not None:
        raise InputError("derivatives by samples are asked for, and the run failed; allowed: a run to its end")
    one, weights = _run_of(run), _weights(run, of)
    coarse, fine = _swept(one, run, weights)
    largest = float(np.abs(fine).max())
    error = float(np.abs(fine - coarse).max()) + run.rtol * largest
    if error > _ALLOWED * run.rtol * largest:
        warnings.warn(
            f"the derivatives by samples have an error of {error:.1e}, {error / largest:.0e} of the largest one; a "
            "higher sample rate makes it smaller",
            FingerspiceWarning,
            stacklevel=3,
        )
    return SampleGradient(one.name, one.wave.rate, one.wave.start, one.sign * fine, error)
