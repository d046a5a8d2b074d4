"""What every integrator of networks shares: its sources' tables, the run window by window, its end, what it gives."""

from __future__ import annotations

import itertools
from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from fingerspice.engine.network import Sources, at_sources, new_room, rates
from fingerspice.engine.readout import ACCEPTED, NFEV, OUTPUT, REJECTED, TRIED, ZEROS
from fingerspice.results.outcome import Attempt, ErrorEstimate, NetworkState, Status, last_tried
from fingerspice.solve.networks import NetworkProblem
from fingerspice.solve.runs import ROUNDING, Continuous, Progress, windows
from fingerspice.waveforms.sampling import SourceTable, breakpoints_at, is_sampled, source_table

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

# Windows whose tables stay with the scene.
KEPT_WINDOWS = 4
MOST_KEPT = 16


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
    # Where a user's function is not what was integrated: time (s), by how much (V), and which source.
    unseen: tuple[float, float, int] | None = None
    # Largest misfit of the sources' tables that no finer ones would mend, V.
    rough: float = 0.0
    margin: float = 1.0
    detail: str = ""
    tried: tuple[Attempt, ...] = ()
    # The row at the time a failed run reached.
    here: FloatArray | None = None
    # The run between its outputs, where that is known.
    continuous: Continuous | None = None
    # Of each gap: peaks of voltage (V) and force (N), and the stated errors of both.
    gaps: FloatArray = field(default_factory=lambda: np.zeros((0, 4)))

    def excess(self, u_scale: float) -> float:
        """See `excess_of`."""
        return excess_of(self.gaps, u_scale)

    def end_before(self, t: float) -> None:
        """Take back the outputs from a time (s) on."""
        kept = self.t < t
        self.t, self.left, self.rows = self.t[kept], self.left[kept], self.rows[kept]


def excess_of(gaps: FloatArray, u_scale: float) -> float:
    """Largest stated error over the peak it belongs to, in any gap's voltage or force.

    A gap that takes no more than rounding of `u_scale`, the largest voltage of the circuit (V), is at 0 V; `gaps`
    (n_gap, 4) has peaks of voltage (V) and force (N), and the stated errors of both.
    """
    u_peak, f_peak, u_error, f_error = gaps[gaps[:, 0] > ROUNDING * u_scale].T
    over = np.append(u_error / u_peak, f_error / np.where(f_peak > 0.0, f_peak, np.inf))
    return float(over.max(initial=0.0))


def source_tables(problem: NetworkProblem, tol: float, *, no_chirps: bool = False) -> Iterator[list[SourceTable]]:
    """Tables of all sources, window by window, until one of them stops being finite.

    Those of a run of few windows stay with the scene.
    """
    edges = windows(problem)
    keeps = len(edges) <= 1 + KEPT_WINDOWS and not problem.scene.is_sampled
    kept = problem.scene.prepared.setdefault("tables", {})
    key = (problem.t_start, problem.t_stop, problem.step, tol, no_chirps)
    found = kept.get(key) if keeps else None
    if found is not None:
        yield from found
        return
    waves = problem.scene.waveforms
    scales = [0.0] * len(waves)
    made = []
    for w0, w1 in itertools.pairwise(edges):
        tables = [
            source_table(wave, w0, w1, tol, problem.step, no_chirps=no_chirps, scale=scale)
            for wave, scale in zip(waves, scales, strict=True)
        ]
        scales = [max(scale, table.scale) for scale, table in zip(scales, tables, strict=True)]
        if keeps:
            made.append(tables)
        yield tables
        if any(table.not_finite is not None for table in tables):
            return
    if keeps:
        if len(kept) >= MOST_KEPT:
            kept.clear()
        kept[key] = made


def first_unseen(
    problem: NetworkProblem, tables: list[SourceTable], t_out: FloatArray, tol: float
) -> tuple[float, float, int] | None:
    """The first output at which a user's function is not what its table says, s, by how much, V, and which it is."""
    found = []
    for i, (wave, table) in enumerate(zip(problem.scene.waveforms, tables, strict=True)):
        off = table.unseen(wave, t_out, max(tol, 1e-14)) if is_sampled(wave) else None
        if off is not None:
            found.append((*off, i))
    return min(found, default=None)


def joined(tables: list[SourceTable]) -> Sources:
    width = max(t.terms.shape[1] for t in tables), max(t.series.shape[1] for t in tables)
    first = np.concatenate([[0], np.cumsum([t.edges.size for t in tables])]).astype(np.int64)
    terms = [np.pad(t.terms, ((0, 0), (0, width[0] - t.terms.shape[1]), (0, 0))) for t in tables]
    series = [np.pad(t.series, ((0, 0), (0, width[1] - t.series.shape[1]))) for t in tables]
    return Sources(first, np.concatenate([t.edges for t in tables]), np.concatenate(terms), np.concatenate(series))


def ramp(before: FloatArray, after: FloatArray) -> Sources:
    """A jump of every source as a ramp over [0, 1]."""
    terms = np.zeros((before.size, 2, 6))
    terms[:, 0, 0], terms[:, 1, 0], terms[:, 1, 1] = before, after - before, 1.0
    edges = np.tile([0.0, 1.0], before.size)
    return Sources(2 * np.arange(before.size + 1, dtype=np.int64), edges, terms, np.zeros((before.size, 0)))


def held(t: float, values: FloatArray) -> Sources:
    """Sources that stand at these values from t (s) on."""
    terms = np.zeros((values.size, 1, 6))
    terms[:, 0, 0] = values
    edges = np.tile([t, t + 1.0], values.size)
    return Sources(2 * np.arange(values.size + 1, dtype=np.int64), edges, terms, np.zeros((values.size, 0)))


class Integration(ABC):
    """One integration in progress.

    Attributes
    ----------
    t_out, left, rows : ndarray
        Output times (n_t,), whether the left-hand value is meant, and what is written there (n_t, width): the state,
        then the sources' currents where they were asked for.
    y, sign, s_before : ndarray
        The state reached, as in `NetworkState`.
    counters : ndarray of int
        As `engine.readout` counts.
    peaks : ndarray, shape (n_area,)
        V.
    tried : ndarray, shape (TRIED, 4)
    """

    counters: IntArray
    peaks: FloatArray

    def __init__(self, problem: NetworkProblem, tol: float, t_out: FloatArray, left: BoolArray) -> None:
        self.problem, self.net, self.tol, self.t_out, self.left = problem, problem.scene.net, tol, t_out, left
        self.n, n_s = self.net.b.shape
        self.y, self.sign = problem.initial.y.copy(), problem.initial.sign.copy()
        self.s_before = problem.initial.s_before.copy()
        self.n_slow = self.y.size - self.n - n_s
        self.width = self.y.size + (n_s if problem.charge else 0)
        self.rows = np.full((t_out.size, self.width), np.nan)
        self.tried = np.zeros((TRIED, 4))

    @property
    @abstractmethod
    def t(self) -> float:
        """Time reached, s."""

    @abstractmethod
    def through(self, sources: Sources, t_end: float) -> Status:
        """To `t_end` (s), the jumps on the way taken."""

    @abstractmethod
    def jump(self, after: FloatArray) -> bool:
        """Take a jump of the sources to their values `after`; False where that goes past a fold."""

    def state(self) -> NetworkState:
        return NetworkState(self.t, self.y.copy(), self.s_before.copy(), self.sign.copy())

    def stuck(self) -> Status:
        """Why no step is short enough."""
        return Status.FOLD if self.net.mobile and self.problem.scene.coupled else Status.STEP_UNDERFLOW


def values_at(sources: Sources, t: float) -> FloatArray:
    """Right-hand values of the sources at t (s)."""
    n_s = sources.first.size - 1
    out, slope, index = np.empty(n_s), np.empty(n_s), np.empty(n_s, np.int64)
    for i in range(n_s):
        edges = sources.edges[sources.first[i] : sources.first[i + 1]]
        index[i] = min(max(int(np.searchsorted(edges, t, side="right")) - 1, 0), edges.size - 2)
    at_sources(sources, index, t, 0.0, out, slope)
    return out


def integrate(one: Integration, progress: Progress | None) -> NetworkRun:
    """Run an integration to its end, or as far as it goes; the error is not stated yet."""
    problem, t_out, left = one.problem, one.t_out, one.left
    status, t_failed = Status.SUCCESS, None
    rough, unseen = 0.0, None
    sources: Sources | None = None
    for tables in source_tables(problem, min(1e-3, max(0.05 * one.tol, 1e-14))):
        rough = max(rough, *(table.rough for table in tables))
        unseen = unseen or first_unseen(problem, tables, t_out, one.tol)
        broken = [table.not_finite for table in tables if table.not_finite is not None]
        if all(table.edges.size > 1 for table in tables):
            sources = joined(tables)
            status = one.through(sources, min(float(t.edges[-1]) for t in tables))
            if status is not Status.SUCCESS:
                t_failed = one.t
                break
        if progress is not None:
            progress((one.t - problem.t_start) / (problem.t_stop - problem.t_start))
        if broken:
            status, t_failed = Status.SOURCE_NOT_FINITE, min(broken)
            break
    state = one.state()
    done = int(one.counters[OUTPUT])
    if status is Status.SUCCESS and done < t_out.size and sources is not None:
        done += _at_the_end(one, sources, done)
    here = None
    if t_failed is not None and status is not Status.SOURCE_NOT_FINITE and sources and one.t > problem.t_start:
        here = _row(one, sources, "left")
    return NetworkRun(
        t_out[:done], left[:done], one.rows[:done], status, ErrorEstimate(0.0, 0.0), one.peaks,
        int(one.counters[NFEV]),
        {name: int(one.counters[i]) for name, i in (("steps", ACCEPTED), ("rejected", REJECTED), ("zeros", ZEROS))},
        state, t_failed, tried=last_tried(one.tried), here=here, unseen=unseen, rough=rough,
    )  # fmt: skip


def _at_the_end(one: Integration, sources: Sources, done: int) -> int:
    """Right-hand outputs at the very end, after the jump that may stand there; how many were written."""
    problem = one.problem
    stop = problem.t_stop
    if any(breakpoints_at(wave, stop).size for wave in problem.scene.waveforms):
        after = [source_table(w, stop, stop + problem.step, 1e-10, problem.step) for w in problem.scene.waveforms]
        sources = joined(after)
        values = values_at(sources, stop)
        if np.any(values != one.s_before) and not one.jump(values):
            return 0
    one.rows[done:] = _row(one, sources, "right")
    return one.t_out.size - done


def _row(one: Integration, sources: Sources, side: Literal["left", "right"]) -> FloatArray:
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


def state_error(run: NetworkRun, gaps: FloatArray, u_scale: float, charge: float | None) -> float:
    """Write the stated error of a run; returns the largest over the peak it belongs to, in any gap's voltage or force.

    Parameters
    ----------
    run : NetworkRun
        What its sources are rough by moves a gap by no more than that.
    gaps : ndarray, shape (n_gap, 4)
        Peaks of voltage (V) and force (N) and the errors of both, of every gap.
    u_scale : float
        Largest voltage of the circuit, V: a gap that takes no more than rounding of it is at 0 V.
    charge : float or None
        Error of the charge, C.
    """
    rough = run.rough
    u_peak, f_peak = gaps[:, 0], gaps[:, 1]
    safe = np.where(u_peak > 0.0, u_peak, 1.0)
    u_error = gaps[:, 2] + rough
    f_error = gaps[:, 3] + 2.0 * rough / safe * f_peak
    run.error = ErrorEstimate(float(u_error.max(initial=rough)), float(f_error.max(initial=0.0)), charge)
    run.gaps = np.column_stack([u_peak, f_peak, u_error, f_error])
    return run.excess(u_scale)


def add_start_error(run: NetworkRun, gaps: FloatArray) -> None:
    """Add what the start is off, as its effect on every gap's voltage and force (n_gap, 2), V and N, to a run's error.

    What the charge collects from such a start is not known.
    """
    if len(run.gaps) == len(gaps):
        run.gaps = run.gaps + np.hstack([np.zeros_like(gaps), gaps])
    u_gap, f_el = gaps.max(axis=0, initial=0.0)
    run.error = ErrorEstimate(run.error.u_gap + float(u_gap), run.error.f_el + float(f_el))


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
