"""Runs of any circuit by implicit steps, and by the integrators of scipy and torchdiffeq.

A run by Radau collocation has a second, coarser run beside it, from which its error is estimated. Libraries control a
local error only: theirs is measured against such a run, and as long as it is too large, their tolerance is reduced.
"""

from __future__ import annotations

import itertools
import math
import threading
import time
import warnings
from collections.abc import Callable
from functools import partial
from importlib.util import find_spec
from operator import itemgetter
from typing import Any

import numpy as np

from fingerspice.base.announcing import tell
from fingerspice.base.arrays import BoolArray, FloatArray
from fingerspice.base.errors import InputError
from fingerspice.base.units import format_si
from fingerspice.engine import implicit
from fingerspice.engine.implicit import Nodal, advance, new_work
from fingerspice.engine.network import Sources, new_room, ramp, rates_at
from fingerspice.numerics.lobatto import Scheme, radau_scheme
from fingerspice.physics.contact import inverse_area
from fingerspice.results.outcome import Status
from fingerspice.solve import runs
from fingerspice.solve.problem import ROUNDING, Problem, Tables, segment_index, values_at
from fingerspice.solve.runs import Integration, Progress, Run, apart, closed_form, excess_of, gap_signals, integrate

# Stages of a run and of the coarser run, and the ratio of the coarser run's tolerance to the run's. They need different
# orders as well: where edges or zeros cut the steps short, both runs take the same steps, whatever their tolerances.
STAGES, STAGES_BESIDE, BESIDE = 7, 5, 10.0
# Residual of Newton's method that both runs may have in common, as a fraction of the step tolerance; and the longest
# step, relative to the shortest time scale of the sources, which its stages must not alias.
ALIKE, LONGEST_STEP = 0.05, 0.5
# Error allowed in a step, over the one asked for; the least one, and rounding that all errors have, over the voltages.
LOCAL_SHARE, FINEST, ROUNDED = 0.2, 1e-14, 4e-15
# Number of equidistant times at which the two runs are compared: least, per period, and most.
PROBES, PROBES_PER_PERIOD, MOST_PROBES = 512, 32, 20_000
# They are also compared after at most so many edges of the sources, at these fractions of the time to the next edge.
MOST_EDGES, AFTER_EDGE = 256, np.geomspace(1e-15, 0.3, 30)
# The same for circuits whose voltages may oscillate, and how much larger their error may be between these times.
OSCILLATING, UNSEEN = np.geomspace(1e-9, 0.3, 170), 1.5
ATTEMPTS, TELL_AFTER = 6, 3.0  # Number of attempts, and time after which the expected time of a run is announced, s
# Difference of a fold's times in two successive runs at which the fold is accepted at once, over its time; and the one
# at which it is accepted after the last attempt, over its time or the source's shortest time, if that is longer.
FOLD_TIME, FOLD_SPREAD = 1e-10, 1e-5
# Part of a run's stated error that its polynomials between outputs may be off by; and the least area that the scale of
# the charge counts with, over that at 0 V: with less, rounding may ask for minutes.
_BETWEEN, LEAST_SHARE = 0.1, 1e-3
# Limit of accepted and rejected steps: at the start, and over the whole run. A run that needs more has a cause that
# smaller steps do not remove.
FIRST_STEPS, MOST_STEPS = 20_000, 10_000_000


class Collocation(Integration):
    """One integration in progress; see `engine.implicit.advance`."""

    def __init__(
        self, problem: Problem, scheme: Scheme, tol: float, u_scale: float, progress: Progress | None = None
    ) -> None:
        super().__init__(problem)
        self.scheme, self.tol, self.progress = scheme, tol, progress
        self.rows = np.full((self.t_out.size, self.y.size + problem.charge * self.s_before.size), np.nan)
        least = problem.scene.net.area0.copy()
        for i, contact in enumerate(problem.network.contacts):
            if contact is not None and self.net.gap[i] >= 0:
                # Where voltage presses an area away, its charge moves at voltages that are a small part of the peak.
                pressed = 1.0 / inverse_area(u_scale, self.net.curves[i])[0]
                least[i] = min(least[i], max(pressed, LEAST_SHARE * least[i]))
        stored = u_scale * float(np.abs(problem.network.capacitance(least)).sum()) or u_scale
        # With an infinite scale the error of the charge does not control the steps, unless charge was asked for.
        charge, sizes = stored if problem.charge else np.inf, [self.n, self.n_slow, self.s_before.size]
        self.scale = np.repeat([u_scale, 1.0, charge], sizes)
        self.control, self.counters = np.zeros(implicit.N_CONTROL), np.zeros(implicit.N_COUNTERS, np.int64)
        self.control[implicit.BASE] = problem.t_start
        if problem.network.active:
            # A step longer than the fastest mode would be tested at its end only, where that has decayed.
            fastest = max(abs(problem.scene.decay), default=math.inf)
            self.control[[implicit.H, implicit.H_AFTER_JUMP]] = 1.0 / max(fastest, 1e-300)
        self.peaks = np.zeros(self.net.gap.size)
        self.room = new_room(self.net, self.y.size)
        self.work = new_work(self.net, scheme.c.size, scheme.eigenvalues.size, self.y.size)

    @property
    def t(self) -> float:
        return float(self.control[implicit.BASE] + self.control[implicit.T])

    @property
    def met(self) -> FloatArray:
        """(n_finger, 4): Peaks of the gaps' voltages (V) and forces (N) so far, as in `Run.gaps`, without errors."""
        out = np.zeros((len(self.problem.network.fingers), 4))
        for row, i in zip(out, self.problem.network.fingers, strict=True):
            peak, contact = float(self.peaks[i]), self.problem.network.contacts[i]
            assert contact is not None
            area = float(contact.area(peak)) if self.net.gap[i] >= 0 else float(self.net.area0[i])
            row[:2] = peak, float(contact.stress(peak)) * area
        return out

    def nodal(self, sources: Sources) -> Nodal:
        """The network with these sources, as the compiled steps take it."""
        return Nodal(
            self.net, self.room, self.scheme, self.work, sources, False, self.scale, self.tol, self.y, self.s_before,
            self.sign, self.control, self.counters, self.peaks, self.tried, self.problem.charge, self.t_out, self.left,
            self.rows,
        )  # fmt: skip

    def through(self, sources: Sources, t_end: float) -> Status:
        if (course := self.problem.network.course) is None:
            return self.between(sources, t_end)
        times, on = course.changes(self.problem.t_stop)
        status, k = Status.SUCCESS, int(times.searchsorted(self.t, "right"))
        while status is Status.SUCCESS and self.t < t_end:
            self.net = self.problem.scene.switched(tuple(on[k].tolist()))
            status = self.between(sources, min(t_end, float(times[k])) if k < times.size else t_end)
            # The first step after a change is as long as that after the last one.
            self.control[[implicit.H, implicit.JUMPED]] = self.control[implicit.H_AFTER_JUMP], 1.0
            k += 1
        return status

    def between(self, sources: Sources, t_end: float) -> Status:
        """As `through`, while no switch changes."""
        run = self.nodal(sources)
        while True:
            code = advance(run, t_end)
            for i in self.problem.network.fingers:
                runs.refuse_beyond_law(self.problem, i, float(self.peaks[i]), f"at {format_si(self.t, 's')} ")
            if code == implicit.DONE:
                return Status.SUCCESS
            if code == implicit.PAUSED:
                done = self.problem.done(self.t)
                taken = self.counters[implicit.ACCEPTED] + self.counters[implicit.REJECTED]
                if taken > FIRST_STEPS + done * MOST_STEPS:
                    return Status.TOO_MANY_STEPS
                if self.progress is not None:
                    self.progress(done)
            elif code == implicit.STEP_UNDERFLOW or not self.jump(values_at(sources, self.t)[0]):
                return self.stuck()

    def jump(self, after: FloatArray) -> bool:
        met = implicit.pass_jump(self.nodal(ramp(self.s_before, after)), self.s_before.copy())
        self.s_before[:] = after
        self.control[[implicit.H, implicit.JUMPED]] = self.control[implicit.H_AFTER_JUMP], 1.0
        return met


def pass_through(
    problem: Problem, sources: Sources, tol: float, u_scale: float
) -> tuple[Status, Collocation, FloatArray]:
    """Integrate a problem without outputs: its status, the run, and its final error, estimated by a coarser run."""
    ends = []
    for scheme, share in zip(_schemes(problem), (BESIDE, 1.0), strict=True):
        one = Collocation(problem, scheme, max(share * tol, FINEST), u_scale)
        status = one.through(sources, problem.t_stop)
        ends.append(one.y)
        if status is not Status.SUCCESS:
            break
    return status, one, ends[-1] - ends[0]


def _schemes(problem: Problem) -> tuple[Scheme, Scheme]:
    """The coarser run's method and the run's."""
    longest = problem.longest_step(LONGEST_STEP, problem.t_start, problem.t_stop)
    return radau_scheme(STAGES_BESIDE)._replace(h_max=longest), radau_scheme(STAGES)._replace(h_max=longest)


def _integrate(
    problem: Problem, method: Scheme | str, tol: float, u_scale: float, progress: Progress | None = None
) -> Run:
    kind: Any = Foreign if isinstance(method, str) else Collocation
    one: Collocation = kind(problem, method, tol, u_scale, progress)
    run = integrate(one, Tables(problem, tol), progress)
    run.gaps = one.met
    return run


def solve_coupled(problem: Problem, rtol: float, progress: Progress | None = None, reason: str = "") -> Run:
    """Integrate until the stated error is within `rtol` of the peaks of every gap's voltage and force.

    The stated error is the difference from a second run of lower order with a larger tolerance. `reason` says why this
    method took over from another; a run that takes long is announced with it, and with its expected time.
    """
    progress = _announced(progress, f"{reason}: " if reason else "")
    (coarse, fine), mobile = _schemes(problem), problem.scene.net.mobile
    probing, probed = _with_probes(problem)
    compared = probing.at(probing.t_out[probed], probing.left[probed])
    u_scale = problem.largest
    if problem.network.active or problem.network.n_voltage < len(problem.network.sources) or u_scale == 0.0:
        u_scale = _voltage_scale(problem, coarse, max(u_scale, 1.0))
    finest = FINEST * max(1.0, problem.scene.u_size / u_scale)
    tol, nfev, folded = max(LOCAL_SHARE * rtol, finest), 0, math.inf
    folds: list[tuple[float, Run]] = []
    for attempt in range(ATTEMPTS):
        last = tol <= finest or attempt == ATTEMPTS - 1
        beside = _integrate(compared, coarse, BESIDE * tol, u_scale, progress)
        run = _integrate(probing, fine, tol, u_scale, progress)
        nfev += beside.nfev + run.nfev
        run.nfev = nfev
        worst = _stated(problem, run, run.only(probed), beside, u_scale, ALIKE * tol) / rtol
        finer = 0.03
        if mobile and run.record(problem).fold_margin.min(initial=1.0) < runs.PAST_FOLD:
            # A step has crossed a fold onto a branch of the area equation that no continuous path reaches.
            run.status = Status.ERROR_NOT_MET
        elif run.status is Status.FOLD and run.t_failed is not None:
            # The error of the state shifts the fold: reduce the tolerance until the fold's time no longer moves.
            moved, folded = abs(run.t_failed - folded), run.t_failed
            folds.append((moved, run))
            last |= moved <= FOLD_TIME * folded
        elif run.status is not Status.SUCCESS or (worst <= 1.0 and beside.status is not Status.FOLD):
            break
        else:
            # Also where the coarser run alone has met a fold. Rounding of the nodes' voltages may be too large, too.
            last |= 0.0 < rtol * run.gaps[:, 0].max(initial=0.0) < ROUNDED * u_scale
            run.status = Status.ERROR_NOT_MET if last else run.status
            finer = min(0.3, 0.5 / worst if worst > 0.0 else 0.3)
        if last:
            break
        tol = max(finer * tol, finest)
    span = max(folded, min(problem.network.waveform.shortest_time(), problem.t_stop - problem.t_start))
    # Round-off may dominate at the finest tolerances: take the run whose fold differs least from its predecessor's.
    moved, nearest = min(folds, key=itemgetter(0), default=(math.nan, run))
    believed = moved <= FOLD_SPREAD * span
    if run.status is Status.FOLD or (believed and run.status is not Status.SUCCESS):
        run = nearest
        run.status, run.nfev = Status.FOLD if believed else Status.ERROR_NOT_MET, nfev
    margin = float(run.record(problem).fold_margin.min(initial=1.0)) if mobile else run.margin
    run = run.only(~probed)
    run.end_where_it_stopped()
    run.margin = min(margin, float(run.record(problem).fold_margin[-1])) if mobile and run.t.size else margin
    again = partial(_integrate, method=fine, tol=tol, u_scale=u_scale)
    run.continuous = closed_form(problem, again, _BETWEEN * excess_of(run.gaps, problem.rounding))
    run.note = f"{reason}; implicit steps took over, {run.stats['steps']} of them" if reason else ""
    return run


def _announced(progress: Progress | None, reason: str) -> Progress:
    """Progress of implicit steps, which tells once how long they are expected to take."""
    # Time and progress at the first call, because the compiler may have worked before it; infinite once that was told.
    first: tuple[float, float] | None = None

    def update(done: float) -> None:
        nonlocal first
        first = first or (time.perf_counter(), done)
        taken, more = time.perf_counter() - first[0], done - first[1]
        if taken > TELL_AFTER and more > 0.0:
            # A run consists of the coarser one, which comes first, and the finer one.
            tell(f"{reason}implicit steps take about {2.0 * taken / more:.2g} s in all")
            first = math.inf, done
        if progress is not None:
            progress(done)

    return update


def _voltage_scale(problem: Problem, scheme: Scheme, guess: float) -> float:
    """Largest live voltage, V, from coarse runs: under a current drive, or an amplifier, it is not known beforehand.

    A high guess is better than a low one: a coarse run whose voltages are much smaller than the guess is cheap, whereas
    much larger voltages would be integrated far too accurately.
    """
    probing = problem.at(np.linspace(problem.t_start, problem.t_stop, PROBES), np.ones(PROBES, bool))
    for _ in range(20):
        rough = _integrate(probing, scheme, 1e-2, guess)
        largest = float(np.abs(rough.rows[:, : problem.network.k.shape[0]]).max(initial=0.0))
        if not 0.0 < largest < math.inf or 0.05 * guess <= largest <= guess:
            break
        near, guess = problem.network.active and largest <= guess / 0.05, 1.5 * largest
        if near:
            break
    return guess


def _with_probes(problem: Problem) -> tuple[Problem, BoolArray]:
    """The problem with more outputs, at which the error is estimated, and a mask of these.

    They do not depend on the output times, so that neither the error nor the tolerance depends on them.
    """
    span = problem.t_stop - problem.t_start
    count = int(min(max(PROBES, PROBES_PER_PERIOD * span / problem.network.waveform.shortest_time()), MOST_PROBES))
    probes = np.linspace(problem.t_start, problem.t_stop, count + 2)[1:-1]
    # Transients right after an edge may decay between two equidistant times, so look at them on a logarithmic grid.
    edges = np.unique(np.append(problem.breakpoints(), [problem.t_start, problem.t_stop]))
    some = np.arange(0, edges.size - 1, math.ceil(edges.size / MOST_EDGES))
    behind = OSCILLATING if problem.network.active else AFTER_EDGE
    after = (edges[some, None] + np.diff(edges)[some, None] * behind).ravel()
    probes = np.concatenate([probes, after[after < problem.t_stop]])
    every = np.concatenate([problem.t_out, probes])
    side = np.concatenate([problem.left, ~np.isin(probes, edges)])
    order = np.lexsort((~side, every))
    return problem.at(every[order], side[order]), (np.arange(every.size) >= problem.t_out.size)[order]


def _stated(problem: Problem, run: Run, probed: Run, beside: Run, u_scale: float, alike: float) -> float:
    """Write the stated error into a run: the largest difference of both runs, their common error `alike`, and rounding.

    Returns the largest stated error relative to the peak of its gap, of voltages and forces.
    """
    gaps, fine, coarse = [], probed.record(problem), beside.record(problem)
    more = UNSEEN if problem.network.active else 1.0
    # Between the times compared, the steps may have seen larger voltages, and forces if the area has no time constant.
    met = itertools.chain(run.gaps[:, :2].tolist(), itertools.repeat((0.0, 0.0)))
    for (u, f), (v, g), (u_met, f_met) in zip(gap_signals(fine), gap_signals(coarse), met, strict=False):
        peak, force = max(float(np.abs(u).max(initial=0.0)), u_met), max(float(f.max(initial=0.0)), f_met)
        gaps.append((peak, force, more * apart(u, v), more * apart(f, g)))
    run.gaps, run.node_error = np.array(gaps).reshape(-1, 4), more * runs.nodes_apart(fine, coarse)
    run.add_error((alike + ROUNDED) * u_scale)
    if problem.charge:
        at = slice(problem.initial.y.size - problem.initial.s_before.size, problem.initial.y.size)
        run.charge_error = more * apart(probed.rows[:, at], beside.rows[:, at])
    return excess_of(run.gaps, max(ROUNDING * u_scale, problem.rounding))


_QUIET = threading.Lock()
SCIPY_METHODS = ("RK23", "RK45", "DOP853", "Radau", "BDF", "LSODA")
_TORCH_ORDER = {"rk4": 4, "midpoint": 2, "euler": 1}  # Of those with fixed steps
TORCH_METHODS = ("dopri5", "dopri8", "bosh3", "adaptive_heun", *_TORCH_ORDER)
FOREIGN = {"scipy": SCIPY_METHODS, "torchdiffeq": TORCH_METHODS}  #: Methods of the libraries
# Tolerances of our own run and of the library's first run, relative to the error asked for.
REFERENCE, FIRST = 0.03, 0.1
Rate = Callable[[float, FloatArray], FloatArray]


class _FailedError(Exception):
    """A library's integrator gave up."""


class Foreign(Collocation):
    """One integration by a library, from edge to edge of the sources; jumps are integrated as in `Collocation`."""

    def __init__(self, problem: Problem, method: str, tol: float, u_scale: float, progress: Progress | None) -> None:
        super().__init__(problem, radau_scheme(STAGES), tol, u_scale, progress)
        self.library, _, self.name = method.partition(":")
        # Without a request for charge its scale is infinite, which libraries cannot take: 1 C is as good as infinite.
        self.scale = np.where(np.isfinite(self.scale), self.scale, 1.0)

    def _by_scipy(self, rate: Rate, times: FloatArray) -> tuple[FloatArray, int]:
        """States at `times` (s, ascending from 0) of y' = rate(t, y), and the number of evaluations."""
        from scipy.integrate import solve_ivp

        how = {"rtol": max(self.tol, 3e-14), "atol": self.tol * self.scale}
        # Warning filters belong to the whole process: change them in one thread at a time, for scipy's warnings only.
        with _QUIET, warnings.catch_warnings():
            warnings.filterwarnings("ignore", module=r"scipy\.")
            try:
                found = solve_ivp(rate, (0.0, times[-1]), self.y.copy(), self.name, times, **how)
            except ValueError as error:
                # Past a fold y' is NaN, and scipy's implicit methods refuse to factor a matrix with NaN.
                raise _FailedError(f"scipy: {error}") from None
        # LSODA reports success even if the state is NaN.
        if found.status < 0 or not np.all(np.isfinite(found.y[:, -1])):
            raise _FailedError(str(found.message))
        return found.y.T, int(found.nfev)

    def _by_torch(self, rate: Rate, times: FloatArray) -> tuple[FloatArray, int]:
        """As `_by_scipy`."""
        import torch
        from torchdiffeq import odeint

        count, length, tol, scale = 0, float(times[-1]), self.tol, self.scale

        def slope(t: torch.Tensor, z: torch.Tensor) -> torch.Tensor:
            nonlocal count
            count += 1
            # torchdiffeq takes one atol for all entries, so each entry is integrated in units of its scale.
            found = rate(float(t), z.numpy() * scale) / scale
            # Past a fold y' is NaN, which would make torchdiffeq's step NaN; it rejects the step if y' is huge.
            return torch.from_numpy(np.where(np.isfinite(found), found, 1e9 / length))

        how: dict[str, Any] = {"method": self.name, "rtol": max(tol, 3e-14), "atol": tol, "options": {}}
        if (order := _TORCH_ORDER.get(self.name)) is not None:
            # A fixed step h from the tolerance, with the error model (h / tau)^order, tau the shortest time constant.
            longest = min(1.0 / max(float(self.problem.scene.rates.max(initial=0.0)), 1e-300), length / 4.0)
            how["options"] = {"step_size": min(longest, 2.0 * longest * tol ** (1.0 / order))}
        try:
            with torch.no_grad():
                states = odeint(slope, torch.from_numpy(self.y / scale), torch.from_numpy(times), **how).numpy() * scale
        except AssertionError as error:
            short = "torchdiffeq's step underflowed: its methods are explicit, and this scene may be too stiff for them"
            raise _FailedError(short if "underflow in dt" in str(error) else str(error)) from None
        if not np.all(np.isfinite(states[-1])):
            raise _FailedError("torchdiffeq returned NaN")
        return states, count

    def between(self, sources: Sources, t_end: float) -> Status:
        edges = np.unique(sources.edges)
        for stop in np.append(edges[(edges > self.t) & (edges < t_end)], t_end).tolist():
            after, _ = values_at(sources, self.t)
            jumps = np.abs(after - self.s_before) > implicit.ROUNDING * np.maximum(abs(after), abs(self.s_before))
            if np.any(jumps) and not self.jump(after):
                return self.stuck()
            try:
                self._piece(sources, stop)
            except _FailedError as error:
                self.detail = str(error)
                return Status.METHOD_FAILED
        return Status.SUCCESS

    def _piece(self, sources: Sources, stop: float) -> None:
        """Integrate to `stop` (s)."""
        base, n_s, index = self.t, self.s_before.size, segment_index(sources, self.t, "right")

        def rate(t: float, y: FloatArray) -> FloatArray:
            self.sign[:] = 0.0
            return np.asarray(rates_at(self.net, sources, index, base, t, np.ascontiguousarray(y), self.sign))

        done = int(self.counters[implicit.OUTPUT])
        inside = (self.t_out < stop) | ((self.t_out == stop) & self.left)
        times = self.t_out[done : int(np.count_nonzero(inside))] - base
        every = np.unique(np.concatenate([[0.0], times, [stop - base]]))
        states, used = (self._by_scipy if self.library == "scipy" else self._by_torch)(rate, every)
        for row, since, state in zip(self.rows[done:], times, states[np.searchsorted(every, times)], strict=False):
            row[: state.size] = state
            if self.problem.charge:
                row[state.size :] = rate(float(since), state)[-n_s:]
        self.counters[[implicit.OUTPUT, implicit.NFEV, implicit.ACCEPTED]] += len(times), used, 1
        self.y[:] = states[-1]
        # The last call leaves the branches as they are at the end.
        rate(stop - base, self.y)
        self.s_before[:], _ = values_at(sources, stop, "left")
        self.control[implicit.BASE] = stop


def solve_foreign(problem: Problem, method: str, rtol: float, progress: Progress | None = None) -> Run:
    """Integrate with a library's method until the error against our own Radau is within `rtol` of the peaks."""
    if method.startswith("torchdiffeq:") and not all(map(find_spec, ("torch", "torchdiffeq"))):
        raise InputError(f"method '{method}' needs torchdiffeq; pip install 'fingerspice[torch]'")
    reference = solve_coupled(problem, max(REFERENCE * rtol, 1e-13))
    ours, u_scale = reference.record(problem), float(reference.gaps[:, 0].max(initial=0.0)) or 1.0
    tol, nfev = FIRST * rtol, 0
    for _ in range(ATTEMPTS):
        run = _integrate(problem, method, tol, u_scale, progress)
        theirs, nfev = run.record(problem), nfev + run.nfev
        run.nfev, run.margin, run.gaps = nfev, reference.margin, reference.gaps.copy()
        for gap, mine, other in zip(run.gaps, gap_signals(ours), gap_signals(theirs), strict=True):
            gap[2:] += list(map(apart, mine, other))
        run.node_error = (reference.node_error or 0.0) + runs.nodes_apart(ours, theirs)
        worst = excess_of(run.gaps, max(ROUNDING * u_scale, problem.rounding)) / rtol
        if run.status is not Status.SUCCESS:
            if reference.status is Status.FOLD:
                run.status, run.t_failed = reference.status, reference.t_failed
            return run
        if worst <= 1.0:
            again = partial(_integrate, method=method, tol=tol, u_scale=u_scale)
            run.continuous = closed_form(problem, again, rtol)
            return run
        tol = max(tol * min(0.3, 0.5 / worst), 1e-16)
    run.status = Status.ERROR_NOT_MET
    return run
