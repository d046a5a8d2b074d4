"""Runs of a network by Radau collocation, with a coarser run beside each for the error."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from fingerspice.circuit.sampling import SourceTable, breakpoints_at, is_sampled, source_table
from fingerspice.engine import collocation
from fingerspice.engine.collocation import advance
from fingerspice.engine.network import Sources, at_sources, new_room, rates
from fingerspice.engine.radau import NFEV, Scheme, new_work
from fingerspice.engine.readout import TRIED
from fingerspice.networks import NetworkProblem
from fingerspice.numerics.tableaus import radau
from fingerspice.outcome import Attempt, ErrorEstimate, NetworkState, Status, last_tried
from fingerspice.physics.contact import inverse_areas
from fingerspice.runs import Progress, windows

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

# Of a run, and of the coarser one beside it, with its tolerance over the run's. Their difference is the error stated:
# where a step is cut short by an edge or a zero, the order alone keeps them apart.
STAGES, STAGES_BESIDE, BESIDE = 7, 5, 10.0
# What Newton's method may leave in both alike, over the error allowed in a step.
ALIKE = 0.05
# The error allowed in a step, over the one asked for.
LOCAL_SHARE = 0.2
FINEST = 1e-14
# Steps per shortest time scale of the sources: the stages of a step must not alias it.
LONGEST_STEP = 0.5
# Times that errors are looked for at.
PROBES, PROBES_PER_PERIOD, MOST_PROBES = 512, 32, 20_000
ATTEMPTS = 6
# Two runs that meet a fold agree on its time to this, relative.
FOLD_TIME = 1e-10


@dataclass
class NetworkRun:
    """What one run gives: rows of the state, then of the sources' currents where they were asked for."""

    t: FloatArray
    left: BoolArray
    rows: FloatArray
    status: Status
    error: ErrorEstimate
    peaks: FloatArray
    nfev: int
    stats: dict[str, int]
    state: NetworkState
    t_failed: float | None = None
    unseen: tuple[float, float] | None = None
    margin: float = 1.0
    tried: tuple[Attempt, ...] = ()
    # The row at the time a failed run reached.
    here: FloatArray | None = None

    def end_before(self, t: float) -> None:
        """Take back the outputs from a time (s) on."""
        kept = self.t < t
        self.t, self.left, self.rows = self.t[kept], self.left[kept], self.rows[kept]


def network_scheme(h_max: float, stages: int = STAGES) -> Scheme:
    """Radau IIA with its matrix diagonalised."""
    tableau = radau(stages)
    values, vectors = np.linalg.eig(tableau.a)
    back = np.linalg.inv(vectors)
    upper = np.flatnonzero(values.imag > -1e-12)
    # A conjugate pair gives twice the real part of one.
    twice = np.where(values.imag[upper] > 1e-12, 2.0, 1.0)
    return Scheme(
        tableau.a, tableau.c, np.ascontiguousarray(tableau.e[0]), tableau.dense, values[upper].astype(complex),
        np.ascontiguousarray(back[upper].astype(complex)),
        np.ascontiguousarray((vectors[:, upper] * twice).astype(complex)), h_max,
    )  # fmt: skip


def source_tables(problem: NetworkProblem, tol: float, *, no_chirps: bool = False) -> Iterator[list[SourceTable]]:
    """Tables of all sources, window by window, until one of them stops being finite."""
    waves = problem.scene.waveforms
    scales = [0.0] * len(waves)
    for w0, w1 in itertools.pairwise(windows(problem)):
        found = [
            source_table(wave, w0, w1, tol, problem.step, no_chirps=no_chirps, scale=scale)
            for wave, scale in zip(waves, scales, strict=True)
        ]
        scales = [max(scale, table.scale) for scale, table in zip(scales, found, strict=True)]
        yield found
        if any(table.not_finite is not None for table in found):
            return


def first_unseen(
    problem: NetworkProblem, tables: list[SourceTable], t_out: FloatArray, tol: float
) -> tuple[float, float] | None:
    """The first output at which a user's function is not what its table says, s, and by how much, V."""
    pairs = zip(problem.scene.waveforms, tables, strict=True)
    found = (table.unseen(wave, t_out, max(tol, 1e-14)) for wave, table in pairs if is_sampled(wave))
    return min((x for x in found if x is not None), default=None)


def _joined(tables: list[SourceTable]) -> Sources:
    width = max(t.terms.shape[1] for t in tables), max(t.series.shape[1] for t in tables)
    first = np.concatenate([[0], np.cumsum([t.edges.size for t in tables])]).astype(np.int64)
    terms = [np.pad(t.terms, ((0, 0), (0, width[0] - t.terms.shape[1]), (0, 0))) for t in tables]
    series = [np.pad(t.series, ((0, 0), (0, width[1] - t.series.shape[1]))) for t in tables]
    return Sources(first, np.concatenate([t.edges for t in tables]), np.concatenate(terms), np.concatenate(series))


def _ramp(before: FloatArray, after: FloatArray) -> Sources:
    """A jump of every source as a ramp over [0, 1]."""
    terms = np.zeros((before.size, 2, 6))
    terms[:, 0, 0], terms[:, 1, 0], terms[:, 1, 1] = before, after - before, 1.0
    edges = np.tile([0.0, 1.0], before.size)
    return Sources(2 * np.arange(before.size + 1, dtype=np.int64), edges, terms, np.zeros((before.size, 0)))


class _Integration:
    """One integration in progress."""

    def __init__(self, problem: NetworkProblem, scheme: Scheme, tol: float, u_scale: float) -> None:
        net = problem.scene.net
        self.problem, self.net, self.scheme, self.tol = problem, net, scheme, tol
        n, n_s = net.b.shape
        self.n, self.n_slow = n, problem.initial.y.size - n - n_s
        stored = u_scale * float(np.abs(problem.network.capacitance(problem.scene.area0)).sum()) or u_scale
        # A charge's own error is not looked at where nobody asked for it.
        charge = stored if problem.charge else np.inf
        self.scale = np.concatenate([np.full(n, u_scale), np.ones(self.n_slow), np.full(n_s, charge)])
        self.y, self.sign = problem.initial.y.copy(), problem.initial.sign.copy()
        self.s_before = problem.initial.s_before.copy()
        self.control = np.zeros(collocation.N_CONTROL)
        self.control[collocation.BASE] = problem.t_start
        self.counters = np.zeros(collocation.N_COUNTERS, np.int64)
        self.peaks = np.zeros(net.gap.size)
        self.tried = np.zeros((TRIED, 4))
        self.room = new_room(net, self.y.size)
        self.work = new_work(net, scheme.c.size, scheme.eigenvalues.size, self.y.size)

    @property
    def t(self) -> float:
        return float(self.control[collocation.BASE] + self.control[collocation.T])

    def through(self, sources: Sources, t_end: float, t_out: FloatArray, left: BoolArray, rows: FloatArray) -> int:
        """To `t_end` (s), the jumps on the way taken."""
        while True:
            code = advance(
                self.net, self.room, self.scheme, self.work, sources, False, self.problem.charge, t_end, self.y,
                self.sign, self.s_before, self.scale, self.tol, self.control, self.counters, self.peaks, t_out, left,
                rows, self.tried,
            )  # fmt: skip
            if code == collocation.PAUSED:
                continue
            if code != collocation.JUMP:
                return int(code)
            if not self.jump(_values(sources, self.t)):
                return collocation.STEP_UNDERFLOW

    def jump(self, after: FloatArray) -> bool:
        """Take a jump of the sources to their values `after`; False where that goes past a fold."""
        control = np.zeros(collocation.N_CONTROL)
        code = advance(
            self.net, self.room, self.scheme._replace(h_max=1.0), self.work, _ramp(self.s_before, after), True, False,
            1.0, self.y, self.sign, self.s_before.copy(), self.scale, self.tol, control, self.counters, self.peaks,
            np.empty(0), np.empty(0, bool), np.empty((0, self.y.size)), np.zeros((TRIED, 4)),
        )  # fmt: skip
        self.s_before[:] = after
        self.control[collocation.H] = self.control[collocation.H_AFTER_JUMP]
        self.control[collocation.JUMPED] = 1.0
        return code == collocation.DONE

    def settle_areas(self, after: FloatArray) -> None:
        """Let the areas with dynamics of their own start at g(u(0+))."""
        place = slice(self.n, self.n + self.n_slow)
        if not np.any(np.isnan(self.y[place])):
            return
        slow = [i for i in range(self.net.gap.size) if self.net.slow[i] >= 0]
        y, s_before = self.y.copy(), self.s_before.copy()
        area = np.ones(self.n_slow)
        for _ in range(60):
            self.y[:], self.s_before[:] = y, s_before
            self.y[place] = area
            self.sign[:] = 0.0
            self.jump(after)
            u = np.abs(self.net.p @ self.y[: self.n] + self.net.q @ after)
            new = area.copy()
            for i in slow:
                inverse = inverse_areas(u[[self.net.gap[i]]], self.net.curves[i])[0]
                new[self.net.slow[i]] = 1.0 / (inverse * self.net.area0[i])
            done = bool(np.all(np.abs(new - area) <= 1e-15))
            area = new
            if done:
                break
        self.y[:], self.s_before[:] = y, s_before
        self.y[place] = area
        self.sign[:] = 0.0
        self.peaks[:] = 0.0
        self.counters[:] = 0

    def state(self) -> NetworkState:
        return NetworkState(self.t, self.y.copy(), self.s_before.copy(), self.sign.copy())


def _values(sources: Sources, t: float) -> FloatArray:
    """Right-hand values of the sources at t (s)."""
    n_s = sources.first.size - 1
    out, slope, index = np.empty(n_s), np.empty(n_s), np.empty(n_s, np.int64)
    for i in range(n_s):
        edges = sources.edges[sources.first[i] : sources.first[i + 1]]
        index[i] = min(max(int(np.searchsorted(edges, t, side="right")) - 1, 0), edges.size - 2)
    at_sources(sources, index, t, 0.0, out, slope)
    return out


def _integrate(
    problem: NetworkProblem, scheme: Scheme, tol: float, u_scale: float, t_out: FloatArray, left: BoolArray,
    progress: Progress | None,
) -> NetworkRun:  # fmt: skip
    one = _Integration(problem, scheme, tol, u_scale)
    n_s = problem.initial.s_before.size
    width = one.y.size + (n_s if problem.charge else 0)
    rows = np.full((t_out.size, width), np.nan)
    status, t_failed = Status.SUCCESS, None
    rough, unseen = 0.0, None
    sources: Sources | None = None
    for tables in source_tables(problem, min(1e-3, max(0.05 * tol, 1e-14))):
        rough = max(rough, *(table.rough for table in tables))
        unseen = unseen or first_unseen(problem, tables, t_out, tol)
        broken = [table.not_finite for table in tables if table.not_finite is not None]
        if all(table.edges.size > 1 for table in tables):
            sources = _joined(tables)
            if one.t == problem.t_start:
                one.settle_areas(_values(sources, one.t))
            code = one.through(sources, min(float(t.edges[-1]) for t in tables), t_out, left, rows)
            if code == collocation.TOO_MANY:
                status, t_failed = Status.TOO_MANY_STEPS, one.t
                break
            if code == collocation.STEP_UNDERFLOW:
                folding = problem.scene.net.mobile and problem.scene.coupled
                status, t_failed = (Status.FOLD if folding else Status.STEP_UNDERFLOW), one.t
                break
        if progress is not None:
            progress((one.t - problem.t_start) / (problem.t_stop - problem.t_start))
        if broken:
            status, t_failed = Status.SOURCE_NOT_FINITE, min(broken)
            break
    state = one.state()
    done = int(one.counters[collocation.OUTPUT])
    if status is Status.SUCCESS and done < t_out.size and sources is not None:
        done += _at_the_end(one, sources, t_out[done:], left[done:], rows[done:])
    here = None
    if t_failed is not None and status is not Status.SOURCE_NOT_FINITE and sources and one.t > problem.t_start:
        here = _row(one, sources, "left")
    return NetworkRun(
        t_out[:done], left[:done], rows[:done], status, ErrorEstimate(rough, 0.0), one.peaks,
        int(one.counters[NFEV]),
        {name: int(one.counters[i]) for name, i in (
            ("steps", collocation.ACCEPTED), ("rejected", collocation.REJECTED), ("zeros", collocation.ZEROS))},
        state, t_failed, tried=last_tried(one.tried), here=here, unseen=unseen,
    )  # fmt: skip


def _at_the_end(one: _Integration, sources: Sources, t_out: FloatArray, left: BoolArray, rows: FloatArray) -> int:
    """Right-hand outputs at the very end, after the jump that may stand there; how many were written."""
    problem = one.problem
    stop = problem.t_stop
    if any(breakpoints_at(wave, stop).size for wave in problem.scene.waveforms):
        after = [source_table(w, stop, stop + problem.step, 1e-10, problem.step) for w in problem.scene.waveforms]
        sources = _joined(after)
        values = _values(sources, stop)
        if np.any(values != one.s_before) and not one.jump(values):
            return 0
    rows[:] = _row(one, sources, "right")
    return int(t_out.size)


def _row(one: _Integration, sources: Sources, side: Literal["left", "right"]) -> FloatArray:
    """What `advance` would write at the time reached, from the segments on one side of it; NaN past a fold."""
    if not one.problem.charge:
        return one.y.copy()
    room = new_room(one.net, one.y.size)
    index = np.array([
        min(max(int(np.searchsorted(sources.edges[a:b], one.t, side=side)) - 1, 0), b - a - 2)
        for a, b in itertools.pairwise(sources.first)
    ])  # fmt: skip
    at_sources(sources, index, one.t, 0.0, room.s, room.ds)
    rate = np.full(one.y.size, np.nan)
    found = rates(one.net, room, False, one.y, one.sign, rate)
    n_s = one.s_before.size
    return np.concatenate([one.y, rate[-n_s:] if found else np.full(n_s, np.nan)])


def solve_coupled(
    problem: NetworkProblem, rtol: float, t_out: FloatArray, left: BoolArray, progress: Progress | None = None
) -> NetworkRun:
    """Integrate until the stated error is within `rtol` of the peaks of every gap's voltage and force.

    The error is stated from a second run with a larger tolerance.
    """
    longest = min(LONGEST_STEP * problem.waveform.shortest_time(), problem.max_step)
    fine, coarse = network_scheme(longest, STAGES), network_scheme(longest, STAGES_BESIDE)
    at, side, probed = _with_probes(problem, t_out, left)
    n = problem.network.k.shape[0]
    u_scale = max(problem.scene.u_peak, float(np.abs(problem.initial.y[:n]).max(initial=0.0)))
    if problem.network.n_voltage < len(problem.network.sources) or u_scale == 0.0:
        u_scale = _voltage_scale(problem, coarse, max(u_scale, 1.0))
    tol, nfev = LOCAL_SHARE * rtol, 0
    folded: float | None = None
    for attempt in range(ATTEMPTS):
        beside = _integrate(problem, coarse, BESIDE * tol, u_scale, at[probed], side[probed], None)
        run = _integrate(problem, fine, tol, u_scale, at, side, progress)
        nfev += beside.nfev + run.nfev
        run.nfev = nfev
        worst = _state_error(problem, run, _only(run, probed), beside, u_scale, ALIKE * tol) / rtol
        if run.status is Status.FOLD and run.t_failed is not None and tol > FINEST:
            # What the state is off moves the fold: closer, until its time stays.
            if folded is not None and abs(run.t_failed - folded) <= FOLD_TIME * run.t_failed:
                break
            folded, tol = run.t_failed, max(0.03 * tol, FINEST)
            continue
        if run.status is not Status.SUCCESS or worst <= 1.0:
            break
        if tol <= FINEST or attempt == ATTEMPTS - 1:
            run.status = Status.ERROR_NOT_MET
            break
        tol = max(tol * min(0.3, 0.5 / worst), FINEST)
    if problem.scene.net.mobile:
        run.margin = float(problem.record(run).fold_margin.min(initial=1.0))
    run = _only(run, ~probed)
    t_end = run.state.t
    if run.here is not None and np.all(np.isfinite(run.here)) and (run.t.size == 0 or t_end > run.t[-1]):
        # A failed run's arrays end at the time it reached.
        run.t, run.left = np.append(run.t, t_end), np.append(run.left, True)
        run.rows = np.vstack([run.rows, run.here])
    return run


def _voltage_scale(problem: NetworkProblem, scheme: Scheme, guess: float) -> float:
    """Largest live voltage, V, from rough runs: that of a current drive is not known beforehand.

    From above: what is small beside the guess costs nothing, what is large beside it would be followed far too closely.
    """
    at = np.linspace(problem.t_start, problem.t_stop, PROBES)
    for _ in range(20):
        rough = _integrate(problem, scheme, 1e-2, guess, at, np.ones(at.size, bool), None)
        n = problem.network.k.shape[0]
        largest = float(np.abs(rough.rows[:, :n]).max(initial=0.0))
        if not 0.0 < largest < math.inf or 0.05 * guess <= largest <= guess:
            break
        guess = 1.5 * largest
    return guess


def _with_probes(problem: NetworkProblem, t: FloatArray, left: BoolArray) -> tuple[FloatArray, BoolArray, BoolArray]:
    """Times asked for together with those that errors are looked for at, and which are the latter.

    These are the same whichever outputs are asked for, so that no result depends on that.
    """
    span = problem.t_stop - problem.t_start
    count = int(min(max(PROBES, PROBES_PER_PERIOD * span / problem.waveform.shortest_time()), MOST_PROBES))
    probes = np.linspace(problem.t_start, problem.t_stop, count + 2)[1:-1]
    every = np.concatenate([t, probes])
    side = np.concatenate([left, np.ones(count, bool)])
    order = np.lexsort((~side, every))
    return every[order], side[order], (np.arange(every.size) >= t.size)[order]


def gap_signals(problem: NetworkProblem, run: NetworkRun) -> Iterator[tuple[FloatArray, FloatArray]]:
    """Voltage (V) and force (N) of every gap; without one, the voltage of the smallest capacitor and no force."""
    record = problem.record(run)
    if record.fingers:
        for i in range(len(record.fingers)):
            yield record.finger_voltage(i), record.finger_force(i)
    elif problem.network.cells:
        smallest = int(np.argmin(problem.network.capacitance(problem.scene.area0)))
        u = record.cell_voltage(smallest)
        yield u, np.zeros(u.size)


def _only(run: NetworkRun, keep: BoolArray) -> NetworkRun:
    """A run with only some of its outputs."""
    keep = keep[: run.t.size]
    return dataclasses.replace(run, t=run.t[keep], left=run.left[keep], rows=run.rows[keep])


def _state_error(
    problem: NetworkProblem, run: NetworkRun, probed: NetworkRun, beside: NetworkRun, u_scale: float, alike: float
) -> float:
    """Write the stated error into a run: the largest difference, what both have alike, and rounding.

    Returns it over the peaks, the larger of voltage and force.
    """
    count = min(probed.t.size, beside.t.size)
    u_error = f_error = u_peak = f_peak = 0.0
    both = (alike + 4e-15) * u_scale
    for (u, f), (v, g) in zip(gap_signals(problem, probed), gap_signals(problem, beside), strict=True):
        peak, force = float(np.abs(u).max(initial=0.0)), float(f.max(initial=0.0))
        u_error = max(u_error, float(np.abs(u[:count] - v[:count]).max(initial=0.0)) + both)
        # F ~ u^2: what moves u by du moves F by 2 F du / u.
        moved = 2.0 * both / peak * force if peak > 0.0 else 0.0
        f_error = max(f_error, float(np.abs(f[:count] - g[:count]).max(initial=0.0)) + moved)
        u_peak, f_peak = max(u_peak, peak), max(f_peak, force)
    charge = None
    if problem.charge:
        n_s = problem.initial.s_before.size
        at = slice(problem.initial.y.size - n_s, problem.initial.y.size)
        charge = float(np.abs(probed.rows[:count, at] - beside.rows[:count, at]).max(initial=0.0))
    rough = run.error.u_gap
    run.error = ErrorEstimate(u_error + rough, f_error, charge)
    return max(u_error / u_peak if u_peak > 0.0 else 0.0, f_error / f_peak if f_peak > 0.0 else 0.0)
