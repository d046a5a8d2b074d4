"""The sources of a run as tables for compiled code, window by window so that memory does not grow with its length."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import Any, Literal

import numpy as np

from fingerspice.base.arrays import FloatArray, IntArray
from fingerspice.engine.network import Segment, Sources, at_sources
from fingerspice.solve.problem import Problem, check_length
from fingerspice.solve.scenes import kept_with
from fingerspice.waveforms.refining import WIDEST
from fingerspice.waveforms.sampling import SourceTable, breakpoints_at, is_sampled, source_table
from fingerspice.waveforms.waveform import Waveform

PERIODS_PER_WINDOW = 4096.0
BREAKPOINTS_PER_WINDOW = 2000.0
# A run of at most KEPT_WINDOWS windows leaves its tables in the waveform's cache, which holds about MOST_KEPT of them.
KEPT_WINDOWS, MOST_KEPT = 4, 16
# Number of times, evenly through the run, at which a function of arrays is looked at in any case: they take 1 ms.
LOOKS = 20_000


class Tables:
    """Tables of a problem's sources, window by window, until one of them stops being finite.

    A user's function is expensive to evaluate, so its tables are cached for the run. The tables of library waveforms
    are cached with the waveform if the run has few windows; in a longer run they are computed anew, in constant memory.
    """

    def __init__(self, problem: Problem, tol: float, *, no_chirps: bool = False) -> None:
        self.problem, self.no_chirps = problem, no_chirps
        self.tol = min(1e-3, max(0.05 * tol, 1e-14))
        self.edges = _windows(problem)
        # An iteration skips windows that end by this time (s), except the last window.
        self.done = -np.inf
        # Largest interpolation error (V) of a table that a finer table would not reduce.
        self.rough = 0.0
        # First output time (s) at which a user's function differs from its table, the difference (V), and its number.
        self.unseen: tuple[float, float, int] | None = None
        # Time (s) at which a source stops being finite, once the iteration has reached it.
        self.not_finite: float | None = None
        # Largest value (V or A) of each source in the windows so far, and among a few of its samples: a function that
        # rises out of next to nothing would be followed there beyond its own digits.
        peaks = [wave.kept.get("peak", (None, 0.0))[1] for wave in problem.waveforms]
        self.scales = [peak if np.isfinite(peak) else 0.0 for peak in peaks]
        self.kept: dict[Any, list[SourceTable]] | None = {} if problem.scene.is_sampled else None
        if self.kept is None and len(self.edges) <= 1 + KEPT_WINDOWS:
            self.kept = problem.waveform.kept.setdefault("tables", {})
            if len(self.kept) > MOST_KEPT:
                self.kept.clear()

    def __iter__(self) -> Iterator[list[SourceTable]]:
        for w0, w1 in itertools.pairwise(self.edges):
            if w1 <= self.done and w1 < self.edges[-1]:
                continue
            # With `no_chirps`, chirps are approximated by series, so that these tables depend on the tolerance.
            key = (w0, w1, self.tol if self.no_chirps else None)
            tables = self.kept.get(key) if self.kept is not None else None
            if tables is None:
                tables = [self._table(wave, w0, w1, i) for i, wave in enumerate(self.problem.waveforms)]
                if self.kept is not None:
                    self.kept[key] = tables
            self.scales = [max(scale, table.scale) for scale, table in zip(self.scales, tables, strict=True)]
            self.rough = max(self.rough, *(table.rough for table in tables))
            self.not_finite = min((t.not_finite for t in tables if t.not_finite is not None), default=None)
            yield tables
            if self.not_finite is not None:
                return

    def _table(self, wave: Waveform, w0: float, w1: float, place: int) -> SourceTable:
        problem = self.problem
        table = source_table(
            wave, w0, w1, self.tol, problem.step, no_chirps=self.no_chirps, scale=self.scales[place],
            shortest=shortest_event(problem),
        )  # fmt: skip
        if problem.scene.is_sampled and is_sampled(wave):
            off = table.unseen(wave, problem.t_out, self.tol)
            self.unseen = min((one for one in (self.unseen, off and (*off, place)) if one), default=None)
        return table

    def peak(self) -> float:
        """Largest source voltage (V) of the run; of users' functions also between the samples that a scene knows."""
        problem, n_voltage = self.problem, self.problem.network.n_voltage
        if not problem.scene.is_sampled:
            return problem.scene.u_peak or problem.waveform.peak(problem.t_start, problem.t_stop)
        met = (table.scale for tables in self for table in tables[:n_voltage])
        return max(met, default=0.0) or problem.scene.u_peak


def shortest_event(problem: Problem) -> float:
    """Length (s) of the shortest event of a user's function that its samples surely meet."""
    met = WIDEST * problem.step
    if any(wave.kept.get("one by one") for wave in problem.waveforms):
        return met
    return min(met, (problem.t_stop - problem.t_start) / LOOKS)


def _windows(problem: Problem) -> list[float]:
    """Limits (s) of the windows for the sources' tables: short windows bound memory and the phases' round-off."""
    check_length(problem.waveform, problem.t_start, problem.t_stop)
    span = problem.t_stop - problem.t_start
    rate = max(
        problem.waveform.breakpoint_rate() / BREAKPOINTS_PER_WINDOW,
        1.0 / (PERIODS_PER_WINDOW * problem.waveform.shortest_time()),
        # A function is sampled at the output step.
        1.0 / (4096.0 * problem.step) if problem.scene.is_sampled else 0.0,
    )
    count = max(1, int(np.ceil(span * rate)))
    return [problem.t_start + span * i / count for i in range(count)] + [problem.t_stop]


def joined(tables: list[SourceTable]) -> Sources:
    """Tables of all sources, concatenated for compiled code."""
    if len(tables) == 1:
        (one,) = tables
        return Sources(np.array([0, one.edges.size]), one.edges, one.terms, one.series)
    width = max(t.terms.shape[1] for t in tables), max(t.series.shape[1] for t in tables)
    first = np.concatenate([[0], np.cumsum([t.edges.size for t in tables])]).astype(np.int64)
    terms = [np.pad(t.terms, ((0, 0), (0, width[0] - t.terms.shape[1]), (0, 0))) for t in tables]
    series = [np.pad(t.series, ((0, 0), (0, width[1] - t.series.shape[1]))) for t in tables]
    return Sources(first, np.concatenate([t.edges for t in tables]), np.concatenate(terms), np.concatenate(series))


def ramp(before: FloatArray, after: FloatArray, t: float = 0.0) -> Sources:
    """A jump of every source as a ramp over a second from time t (s) on."""
    terms = np.zeros((before.size, 2, 6))
    terms[:, 0, 0], terms[:, 1, 0], terms[:, 1, 1] = before, after - before, 1.0
    edges = np.tile([t, t + 1.0], before.size)
    return Sources(2 * np.arange(before.size + 1, dtype=np.int64), edges, terms, np.zeros((before.size, 0)))


def values_at(sources: Sources, t: float) -> FloatArray:
    """Right-hand values of the sources at t (s)."""
    out, slope = np.empty((2, sources.first.size - 1))
    at_sources(sources, segment_index(sources, t, "right"), t, 0.0, out, slope)
    return out


def after_the_end(problem: Problem) -> Sources | None:
    """The sources from the end of a run on, where one of them may jump there; else None."""
    stop = problem.t_stop
    if not any(breakpoints_at(wave, stop).size for wave in problem.waveforms):
        return None

    def make() -> Sources:
        return joined([source_table(w, stop, stop + problem.step, 1e-10, problem.step) for w in problem.waveforms])

    return kept_with(problem.waveform.kept, ("after", stop, problem.step), 1, make)


def segment_index(sources: Sources, t: float, side: Literal["left", "right"]) -> IntArray:
    """Index of every source's segment (n_s,) that contains t (s); at an edge, the segment on the given side."""
    return np.array([
        min(max(int(np.searchsorted(sources.edges[a:b], t, side=side)) - 1, 0), b - a - 2)
        for a, b in itertools.pairwise(sources.first)
    ])  # fmt: skip


def segment_of(sources: Sources, t: float, side: Literal["left", "right"]) -> tuple[Segment, float]:
    """The segment of a single source that contains time t (s), and the time since the segment's start, s."""
    (i,) = segment_index(sources, t, side).tolist()
    start = float(sources.edges[i])
    return Segment(start, float(sources.edges[i + 1]) - start, sources.terms[i], sources.series[i]), t - start
