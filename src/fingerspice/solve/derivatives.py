"""Derivatives of runs: of signals by parameters, and of a number by every sample of the source.

By parameters they are fourth-order differences of runs with a much smaller error than the run's own. At an `rtol` of
1e-10 the gap voltages of networks are differentiated to 1e-9 of their peaks, for a change of a parameter by all of
itself, and all signals to 2e-9 (tests/test_sensitivity.py).

For those by samples the run is followed in lanes (`solve.recordings.block`), by so many steps in each interval between
samples. What an interval leads to is differentiated by what it starts from and by the source at its ends
(`engine.lanes.loops`); back from the end of the run, these derivatives are multiplied.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from fingerspice.base.arrays import BoolArray, FloatArray, IntArray, real_numbers
from fingerspice.base.errors import FingerspiceWarning, InputError
from fingerspice.circuit.circuit import Circuit
from fingerspice.circuit.describe import own_path
from fingerspice.circuit.network import network_of
from fingerspice.engine.lanes.loops import AREAS, GAP, MORE, SQUARES, lead, sum_back
from fingerspice.numerics.modes import AT, STEP, derivative
from fingerspice.physics.contact import inverse_areas_with_slopes
from fingerspice.results.outcome import Failure, SolveError, Status
from fingerspice.results.solution import DERIVED, MEANS, SampleGradient, Sensitivity, Solution
from fingerspice.solve.periodic import asked
from fingerspice.solve.problem import Problem
from fingerspice.solve.recordings.block import Block, driving, ready
from fingerspice.waveforms.samples import Samples, as_samples
from fingerspice.waveforms.waveform import DC, Sum, Waveform, refuse

# Error asked of the runs that are compared, over the run's own, and the least one; and what may be left of it where
# rounding is in the way, over the run's own.
_SHARE, _FINEST, _KNOWN = 1e-3, 3e-13, 1e-2
# Step relative to a parameter, at which what the runs' errors and the difference's truncation do are about the same;
# and shares of it for outputs at which the gap voltage changes its sign in a step.
_STEP, _CLOSER = 5e-4, (0.03, 1e-3)
# Steps between two samples: of the first two numbers, or below this `rtol` of the second and third, and twice as many
# while these differ; and the error wanted, relative to the largest derivative, over `rtol`.
_STEPS, _COARSE, _ALLOWED = (1, 2, 4, 8, 16, 32, 64, 128), 1e-7, 10.0
# Distance of the differences, over the largest voltage.
_APART = 1e-5
# Intervals whose derivatives are held at once.
_AT_ONCE = 1 << 13
# Change of starts that is left, over the largest voltage; errors of the polynomials, over that asked for.
_CLOSED, _OF_AREA = 1e-14, 1e-2
_ASKED = "derivatives by samples are asked for, and "

# The same run of another circuit, with another `rtol`.
Runner = Callable[[Circuit, float], Solution]


def check_signals(circuit: Circuit, names: Iterable[str], varied: Iterable[str] = ()) -> None:
    """Refuse the real area, or its figures, among names where neither a GAP nor a parameter that varies is a p_sat."""
    asked = [name for name in names if name.startswith("a_real")]
    none = all(math.isinf(gap.values["p_sat"]) for gap in circuit.by_device("GAP"))
    unknown = bool(asked) and none and not any(path.lower().endswith(".p_sat") for path in varied)
    refuse(unknown, f"{', '.join(asked)} is asked for, and no GAP has a real area; allowed: with p_sat, as p_sat=300k")


class _Parameter:
    """A parameter by which a run is differentiated; refused if it is unknown, or not covered."""

    def __init__(self, problem: Problem, path: str) -> None:
        self.circuit, self.path = problem.circuit, own_path(problem.circuit, path)
        parameter = self.circuit.parameters[self.path]
        self.value, self.unit, self.step = parameter.value, parameter.unit, _STEP
        said = f"sensitivities names {self.path}, which is {self.value:g}; allowed: parameters whose value is finite"
        refuse(not (math.isfinite(self.value) and self.value != 0.0), f"{said} and not 0, as steps are relative to it")
        element, span = self.path.rpartition(".")[0], (problem.t_start, problem.t_stop)
        own = self.circuit[element].waveform
        if own is None:
            return
        # A phase is a frequency times all the time since the start.
        self.step /= max(1.0, 2.0 * math.pi * problem.t_stop / own.shortest_time())
        said = f"sensitivities names {self.path}, which moves the edges of its source; allowed: parameters that leave"
        said = f"{said} them where they are, such as an amplitude, or the frequency of a sine"
        for wave in (circuit[element].waveform for circuit in self.circuits()):
            refuse(wave is None or not np.array_equal(wave.breakpoints(*span), own.breakpoints(*span)), said)

    def circuits(self, share: float = 1.0) -> list[Circuit]:
        """Circuits around its value, with a `share` of the step."""
        return [self.circuit.varied({self.path: self.value * (1.0 + share * self.step * at)}) for at in AT]

    def by(self, values: Sequence[FloatArray | float], share: float = 1.0) -> FloatArray:
        """Derivative of what has these values for the circuits."""
        return derivative(values, share * self.step * self.value)

    def longer(self) -> float:
        """Relative change of the sources' common period, per unit of the parameter; NaN where there is none near it."""
        networks = map(network_of, (self.circuit, *self.circuits()))
        own, *periods = (network.waveform.period or math.nan for network in networks)
        if not max(abs(period / own - 1.0) for period in periods) <= 0.01:
            return math.nan
        return float(self.by(periods)) / own if set(periods) != {own} else 0.0

    def runs(self, share: float, run: Runner, solution: Solution) -> list[Solution]:
        """The runs of `circuits`, whose errors are small enough, and whose outputs are at one time."""
        found = [run(circuit, max(_SHARE * solution.rtol, _FINEST)) for circuit in self.circuits(share)]
        for other in found:
            largest = float(np.abs(np.asarray(other.u_gap)).max())
            known = other.status is Status.ERROR_NOT_MET and other.error.u_gap <= _KNOWN * solution.rtol * largest
            if other.failure is not None and not known:
                raise SolveError(other.failure, solution)
            said = f"sensitivities names {self.path}, which moves the times at which the run has outputs"
            refuse(not np.array_equal(other.t, solution.t), f"{said}; allowed: other parameters, or given t_eval")
        return found


def check_request(problem: Problem, paths: Sequence[str], method: str) -> str:
    """Refuse a run that has no sensitivities; the method of the runs that are compared."""
    wrong = isinstance(paths, str) or not all(isinstance(path, str) for path in paths)
    refuse(wrong, f"sensitivities is {paths!r}; allowed: a sequence of paths such as ('Xgap.d',)")
    allowed = "a circuit with a GAP, one of the other starts, and the methods 'auto' and 'exponential'"
    for what, refused in (
        ("the circuit has no GAP", not problem.network.fingers),
        ("the run goes on from another one", problem.start == "given"),
        (f"the method is {method!r}", method not in ("auto", "exponential")),
    ):
        refuse(refused, f"sensitivities are asked for, and {what}; allowed: {allowed}")
    for path in paths:
        _Parameter(problem, path)
    # A recording, or a PWL with many points, is otherwise followed point by point, to no error as small as needed here.
    return method if driving(problem)[1] is None else "exponential"


def sensitivities_of(
    problem: Problem, solution: Solution, paths: Sequence[str], run: Runner, over_period: bool = False
) -> dict[str, Sensitivity]:
    """Derivatives of a run's signals and means; `over_period`: of means over a period, which a parameter may change."""
    found = {}
    for one in [_Parameter(problem, path) for path in paths]:
        longer = one.longer() if problem.begun is not None else 0.0
        said = f"sensitivities of a periodic state name {one.path}, near whose value the source has no such period"
        refuse(math.isnan(longer), f"{said}; allowed: other parameters, or a run from another start")
        runs = one.runs(1.0, run, solution)
        known = [name for name in (*DERIVED, *MEANS) if getattr(solution, name) is not None]
        by: dict[str, Any] = {name: one.by([getattr(other, name) for other in runs]) for name in known}
        for share in _CLOSER:
            # The area has a kink where the gap voltage is 0.
            signs = np.sign([np.reshape(np.asarray(other.u_gap), (other.t.size, -1)) for other in runs])
            turned = np.any(signs != signs[0], axis=(0, 2))
            if not turned.any():
                break
            runs = one.runs(share, run, solution)
            for name in by.keys() & DERIVED:
                by[name][turned] = one.by([getattr(other, name)[turned] for other in runs], share)
        for name in by.keys() & MEANS if over_period else ():
            # The mean over a period that grows takes up what the signal is at its end.
            at_end = getattr(solution, name.removesuffix("_mean"))[-1]
            by[name] = by[name] + longer * (at_end - getattr(solution, name))
        found[one.path] = Sensitivity(one.path, one.unit, one.value, **by)
    return found


def _weights(run: Solution, of: Mapping[str, ArrayLike]) -> dict[str, Any]:
    """The number's derivatives by u_gap, force and area at the outputs, shape (n_t,), and by the latter's means."""
    ((_, contact),) = run.record.fingers
    # With a p_sat or a slip friction is no longer in proportion to the force.
    plain = math.isinf(contact.p_sat) and not any(run.record.slides)
    left_out = ("a_real",) if plain else ("a_real", "f_t", "friction")
    allowed = ", ".join(name for name in (*DERIVED, *MEANS) if not name.startswith(left_out))
    refuse(not of, f"no signal is given; allowed: {allowed}")
    by: dict[str, Any] = dict.fromkeys(DERIVED, np.zeros(run.t.size)) | dict.fromkeys(MEANS, 0.0)
    for name, given in of.items():
        refuse(name not in allowed.split(", "), f"unknown signal {name!r}; allowed: {allowed}")
        value = real_numbers(name, given, "numbers, derivatives by the signal")
        shape, finite = () if name in MEANS else run.t.shape, bool(np.isfinite(value).all())
        if value.shape != shape or not finite:
            said = f"{name} has the shape {value.shape}{'' if finite else ' and numbers that are not finite'}"
            raise InputError(f"{said}; allowed: the shape {shape}, finite: the derivative of a number by that signal")
        by[name] = value
    # F_t = mu (F_N + F_el), and the friction coefficient is F_t / F_N.
    for kind in ("", "_mean"):
        by[f"f_el{kind}"] = by[f"f_el{kind}"] + contact.mu * (by[f"f_t{kind}"] + by[f"friction{kind}"] / contact.f_n)
    return by


class _Intervals:
    """The intervals of a run between the samples of its source, its outputs, and the start of its means."""

    def __init__(self, run: Solution, of: Mapping[str, ArrayLike]) -> None:
        self.run, self.problem = run, _problem(run, {})
        problem, rtol = self.problem, run.rtol
        if len(problem.network.fingers) != 1 or not problem.scene.coupled:
            raise InputError(f"{_ASKED}the circuit has no single GAP whose area is coupled; allowed: one")
        # Of each source: its name, its sign along the loop, and its samples.
        drives = problem.network.drives
        waves = [(e.name, sign, as_samples(e.waveform)) for e, sign in drives if e.waveform is not None]
        known = [(name, sign, wave) for name, sign, wave in waves if wave is not None]
        if len(known) != 1 or not isinstance(driving(problem)[1], Samples):
            others = "sources of 0" if problem.network.stack is None else "constant ones"
            said = f"of the circuit's {len(waves)} sources {len(known)} are recordings; allowed: one, such as"
            raise InputError(f"{_ASKED}{said} fs.Samples, or a PWL on an even grid, beside {others}")
        ((self.name, self.sign, wave),) = known
        form = ready(problem, max(_OF_AREA * rtol, 1e-13)) or ready(problem, rtol)
        if form is None:
            said = "this circuit is not followed sample by sample (docs/recordings.md)"
            raise InputError(f"{_ASKED}{said}; allowed: a circuit that is")
        self.wave, self.form, self.m, self.by = wave, form, form.lanes.rates.size, _weights(run, of)
        self.parts = _STEPS if rtol >= _COARSE else _STEPS[1:]
        t0, t1, self.slack = problem.t_start, problem.t_stop, 1e-6 / wave.rate
        first, last = math.ceil((t0 - wave.start) * wave.rate - 1e-6), math.floor((t1 - wave.start) * wave.rate + 1e-6)
        # Only the outputs that count.
        more = np.append(run.t[np.any([self.by[name] for name in DERIVED], axis=0)], run.first)
        more = more[np.abs((more - wave.start) * wave.rate % 1.0 - 0.5) < 0.5 - 1e-6]
        t = np.unique(np.concatenate([wave.start + np.arange(first, last + 1) / wave.rate, more]))
        t = np.concatenate([[t0], t[(t > t0 + self.slack) & (t < t1 - self.slack)], [t1]])
        # (n + 1,): Start and end of the run, and samples and outputs between, s
        self.t = t[np.append(True, np.diff(t) > self.slack)]
        # (n + 1,): The source at these times
        self.x, h = np.ascontiguousarray(problem.network.waveform.value(self.t)), np.diff(self.t)
        # Lengths of the intervals (n,), or their common one (1,), s
        self.h = h if np.ptp(h) > 1e-9 * h[0] else np.array([h.mean()])

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

    def slopes(self, at: IntArray, rows: BoolArray) -> list[FloatArray]:
        """Derivatives (`_slopes`) of what the intervals `at` lead to, of which `rows` says which are wanted.

        They come twice, for the error: as of long steps, and extrapolated.
        """
        m, many, to, zero = self.m, self.h.size > 1, self.x[at + 1], self.xi[at] * self.xi[at + 1] < 0.0
        # Steps are of third order, but where the gap voltage has a zero of first order: all of the difference is error.
        allowed = np.where(zero, 1.0, _ALLOWED) * self.run.rtol
        length = self.h[at] if many else self.h
        coarse, fine = (self._slopes(at, to, length, parts) for parts in self.parts[:2])
        # By the modes for what moves them, and by the source relative to the largest one.
        moved = self.delta[:m, None] * np.abs(fine[:, :m])
        scale = np.abs(fine[:, m:]).max(axis=(1, 2))[:, None] + np.zeros(m + 2)
        scale[:, :m] = moved.max(axis=(1, 2))[:, None] / self.delta[:m]
        wanted = rows[:, None, None] & (np.abs(fine - coarse) > allowed * scale[..., None])
        for parts in self.parts[2:]:
            (still,) = np.nonzero(wanted.any(axis=(0, 1)))
            if not still.size:
                break
            coarse[..., still] = fine[..., still]
            fine[..., still] = self._slopes(at[still], to[still], length[still] if many else length, parts)
            off = np.abs(fine[..., still] - coarse[..., still]) > allowed[still] * scale[..., None]
            wanted[..., still] = rows[:, None, None] & off
        return [np.where(zero, coarse, fine), fine + (fine - coarse) / 7.0]

    def outputs(self) -> tuple[FloatArray, FloatArray]:
        """Derivatives of a number, by its outputs, by the modes (m, n + 1) and the source (n + 1,) at all times."""
        m, run, by, stack = self.m, self.run, self.by, self.problem.network.stack
        ((_, contact),) = run.record.fingers
        assert run.u_gap is not None
        # By the gap voltage along the loop.
        turn = 1.0 if stack is None or stack.gap is None else float(stack.sign[stack.gap])
        u = turn * run.u_gap
        q, dq = inverse_areas_with_slopes(u, contact.curve(self.problem.scene.u_top))
        dq = dq * np.sign(u)
        by_u = turn * by["u_gap"] - by["area"] * dq / q**2
        by_u = by_u + by["f_el"] * contact.stress(1.0) * u * (2.0 - u * dq / q) / q
        of_modes, of_source = np.zeros((m, self.t.size)), np.zeros(self.t.size)
        place = np.searchsorted(self.t, run.t - self.slack)
        counting = np.flatnonzero(by_u)
        for some in np.split(counting, range(_AT_ONCE, counting.size, _AT_ONCE)):
            at = place[some]
            of_gap = by_u[some] * self._slopes(at, self.x[at], np.zeros(1), 1)[m + GAP]
            np.add.at(of_modes.T, at, of_gap[:m].T)
            np.add.at(of_source, at, of_gap[m] + of_gap[m + 1])
        return of_modes, of_source

    def swept(self) -> FloatArray:
        """Derivatives of a number by the samples, with half the steps and with all, shape (2, n_sample)."""
        t, m, by, wave, form, ((_, contact),) = self.t, self.m, self.by, self.wave, self.form, self.run.record.fingers
        block, start = Block(form, self.x, self.h, True), form.start(self.problem)[0][:m]
        peak = float(np.abs(self.x).max(initial=1e-300)) * form.gain
        solved = block.solve(start, self.parts[2], _CLOSED * peak) and block.on_one_branch
        if not solved or float(np.abs(form.gap(block.xi)).max()) > form.u_top:
            cause = "the run is not followed sample by sample, for its derivatives by samples"
            action = "a higher sample rate takes shorter steps"
            raise SolveError(Failure(Status.STEP_UNDERFLOW, cause, action, float(t[0])))
        # The modes and xi at all times (m, n + 1), (n + 1,), and the distances of their differences (m + 1,).
        starts = block.kept[:m, :, :-1].reshape(m, -1)[:, : t.size - 1]
        self.z, self.xi = np.column_stack([starts, block.end()[:m]]), block.xi.copy()
        sizes = np.append(np.abs(self.z).max(axis=1), np.abs(self.x).max())
        self.delta = _APART * np.where(sizes > 0.0, sizes, peak)
        of_modes, by_outputs = self.outputs()
        n, means = t.size - 1, np.zeros((MORE, t.size - 1))
        of_source, after = np.tile(by_outputs, (2, 1)), np.tile(of_modes[:, n], (2, 1))
        means[SQUARES], means[AREAS] = by["f_el_mean"] * contact.stress(1.0), by["area_mean"]
        means *= (t[:-1] >= self.run.first - 1e-9 * (t[-1] - t[0])) / (t[-1] - self.run.first)
        rows = np.append(np.ones(m, bool), means.any(axis=1))
        for at in reversed(np.split(np.arange(n), range(_AT_ONCE, n, _AT_ONCE))):
            a, b = at[0], at[-1] + 1
            own = np.ascontiguousarray(means[:, a:b]), np.ascontiguousarray(of_modes[:, a:b])
            for row, found in enumerate(self.slopes(at, rows)):
                sum_back(found, *own, of_source[row, a : b + 1], after[row])
        if self.problem.initial.s_before.any():
            # The modes at the start follow the source there.
            step = STEP * self.problem.scene.u_peak
            moved = [Sum((wave, DC(self.sign * at * step))) for at in AT]
            begun = [form.start(_problem(self.run, {self.name: one})) for one in moved]
            of_source[:, 0] += after @ derivative([start[:m] for start, _ in begun], step)
        # Samples before the times, and how far these are beyond, in samples.
        place = np.clip((t - wave.start) * wave.rate, 0.0, wave.count - 1.0)
        first = np.minimum(np.floor(place + 1e-6), wave.count - 2.0).astype(np.int64)
        beyond = np.maximum(place - first, 0.0)
        at, shares = np.append(first, first + 1), np.append(1.0 - beyond, beyond)
        return np.array([np.bincount(at, shares * np.tile(found, 2), wave.count) for found in of_source])


def _problem(run: Solution, sources: dict[str, Waveform]) -> Problem:
    """The problem of a run, with these sources in place of its own."""
    circuit = run.circuit.varied(sources) if sources else run.circuit
    how: dict[str, Any] = {"t_stop": run.t_stop, "charge_law": run.charge_law, "area": run.area_mode}
    return asked(circuit, start=run.start, charge=False, rtol=run.rtol, **how)


def sample_gradient(run: Solution, of: Mapping[str, ArrayLike]) -> SampleGradient:
    """See `Solution.sample_gradient`."""
    said = f"{_ASKED}the run goes on from another one or was read from a file; allowed: a run just made"
    refuse(run.stored is not None or run.start == "given", f"{said} from its circuit's own start")
    refuse(run.failure is not None, f"{_ASKED}the run failed; allowed: a run to its end")
    one = _Intervals(run, of)
    coarse, fine = one.swept()
    largest = float(np.abs(fine).max())
    error = float(np.abs(fine - coarse).max()) + run.rtol * largest
    if error > _ALLOWED * run.rtol * largest:
        said = f"the derivatives by samples have an error of {error:.1e}, {error / largest:.0e} of the largest one"
        warnings.warn(f"{said}; a higher sample rate makes it smaller", FingerspiceWarning, stacklevel=3)
    return SampleGradient(one.name, one.wave.rate, one.wave.start, one.sign * fine, error)
