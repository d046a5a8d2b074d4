"""A run prepared for integration: scene, start, end, initial state, and the times of its outputs.

The sources of a run as tables for compiled code, window by window so that memory does not grow with its length.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import Literal

import numpy as np

from fingerspice.base.arrays import BoolArray, FloatArray, IntArray, Remembering, read_only, real_number
from fingerspice.base.errors import InputError
from fingerspice.circuit.circuit import Circuit
from fingerspice.circuit.describe import area_given, time_slip
from fingerspice.circuit.network import Network
from fingerspice.engine.network import Sources, at_sources
from fingerspice.results.outcome import State
from fingerspice.results.solution import Solution
from fingerspice.solve.scenes import Scene, scene_of
from fingerspice.solve.starting import initial_state, to_loop
from fingerspice.waveforms import sampling
from fingerspice.waveforms.samples import Samples
from fingerspice.waveforms.sampling import SourceTable, breakpoints_at, same_time, source_table
from fingerspice.waveforms.waveform import DC, Waveform, refuse, require

#: Most periods (or shortest time scales) of the source in a run, and most breakpoints: they take hours and a gigabyte.
MOST_PERIODS, MOST_BREAKPOINTS = 1e10, 4e9
#: Most bytes of the signals at the deck's own output times; writing a file needs three times as much memory.
MOST_BYTES = 2e9
# Round-off of a gap voltage relative to the voltages that cancel in it; finer steps cannot reduce the error below that.
ROUNDING = 2e-14
# Largest number of breakpoints in memory.
_BREAKPOINTS_AT_ONCE = 65_536
# Resolution of a time in units of its rounding error; a difference of a source's two limits at an edge is no jump if
# the source changes as much within this resolution beside the edge.
_RESOLVED = 8.0


@dataclass(frozen=True)
class Problem:
    """All data that an integrator needs."""

    circuit: Circuit
    scene: Scene
    # t_start, t_stop, first, step: Start and end of the run, first output and spacing of the outputs, s
    t_start: float
    t_stop: float
    first: float
    step: float
    initial: State
    charge: bool = True  # Whether charge and current are wanted
    start: str = "deck"  # How the run starts, as in `simulate`; ``"given"`` for the end of another run
    by_deck: bool = False  # Whether the run ends at the deck's own TSTOP
    # (n_gap, 2): Error of a periodic start, as its effect on every gap's voltage and force, V and N. The start was
    # computed with half of the error asked for; the other half is left to the run.
    begun: FloatArray | None = None
    # t_out, left (n_out,): Output times, s, ascending, and whether the left-hand limit is meant
    t_out: FloatArray = field(default_factory=lambda: np.empty(0))
    left: BoolArray = field(default_factory=lambda: np.empty(0, bool))

    def at(self, t: FloatArray, left: BoolArray) -> Problem:
        """The problem with other outputs, and with all that is known about it."""
        other = object.__new__(Problem)
        vars(other).update(vars(self), t_out=t, left=left)
        return other

    @cached_property
    def network(self) -> Network:
        return self.scene.network

    @cached_property
    def largest(self) -> float:
        """Larger one of the sources' peak and the largest live voltage of the start, V."""
        n = self.scene.network.k.shape[0]
        return float(max(self.scene.u_peak, 0.0, *map(abs, self.initial.y[:n].tolist())))

    @cached_property
    def rounding(self) -> float:
        """Round-off of a gap's voltage, V: a smaller voltage is 0, and has no sign."""
        return ROUNDING * max(self.largest, self.scene.u_size)

    @cached_property
    def inner(self) -> tuple[FloatArray, float]:
        """The start of a stack in its own equations, as in `to_loop`."""
        return to_loop(self.scene, self.initial)

    @cached_property
    def stored(self) -> float:
        """Largest voltage of a stack's start that its source does not give, V: charge between its layers."""
        return max(map(abs, self.inner[0][:-1].tolist() if self.network.stack else ()), default=0.0)

    def done(self, t: float) -> float:
        """Fraction of the run that is done at time t, s."""
        return (t - self.t_start) / (self.t_stop - self.t_start)

    def breakpoints(self) -> FloatArray:
        """The sources' breakpoints in the run, s, kept for the last run."""
        wave, span = self.network.waveform, (self.t_start, self.t_stop)
        return wave.remember(("breakpoints", *span), lambda: wave.breakpoints(*span), 1)

    def longest_step(self, share: float, start: float, stop: float) -> float:
        """Longest step (s) between two times (s): a share of the shortest time there, and what the deck allows."""
        tran, shortest = self.circuit.tran, self.network.waveform.shortest_time(start, stop)
        # Of a network with inductors or amplifiers no step needs a bound: all of them are tested by their error.
        most = math.inf if tran is None or tran.max_step is None or self.network.active else tran.max_step
        return min(share * shortest, self.t_stop - self.t_start, most)


def prepare(
    circuit: Circuit,
    *,
    t_stop: float | None = None,
    t_eval: FloatArray | None = None,
    charge_law: str | None = None,
    area: str | float = "coupled",
    start: str | Solution = "deck",
    charge: bool = True,
    rtol: float = 0.0,
) -> Problem:
    """Prepare a run, or refuse it; times of `t_eval` that pass an end of the run by rounding are set to it, in place.

    For `rtol` see `scene_of`. A run from the periodic state is prepared from the uncharged start.
    """
    t_stop = None if t_stop is None else real_number("t_stop", t_stop, "a number in s")
    if isinstance(start, Solution) and start.stored is not None:
        raise InputError("start is a solution read from a file, which a run cannot go on from; allowed: one just made")
    t_start = start.state.t if isinstance(start, Solution) else 0.0
    scene = scene_of(circuit, charge_law, area_given(area), t_stop, rtol)
    tran, wave, stop = circuit.tran, scene.network.waveform, t_stop
    if stop is None:
        endless = "no t_stop: the deck has no .tran line and none was given; give t_stop in s"
        refuse(tran is None and (t_eval is None or not t_eval.size), endless)
        stop = float(t_eval[-1]) if tran is None else t_start + tran.stop  # type: ignore[index]
    require(math.isfinite(stop) and stop > t_start, "t_stop", f"{stop:g} s", f"more than {t_start:g} s")
    if t_eval is not None:
        require(t_eval.ndim == 1 and t_eval.size > 0, "t_eval", f"of shape {t_eval.shape}", "one row of times")
        require(bool(np.all(t_eval[1:] >= t_eval[:-1])), "t_eval", "not in order", "ascending times")
        to_ends(t_eval, t_start, stop)
        first, last = float(t_eval[0]), float(t_eval[-1])
        allowed = f"times from {t_start:g} s to t_stop = {stop:g} s{time_slip(first, last, stop)}"
        require(first >= t_start and last <= stop, "t_eval", f"{first:g} s to {last:g} s", allowed)
    end = wave.remember(("end", stop), lambda: sampling.on_breakpoint(wave, stop), 1)
    return Problem(
        circuit, scene, t_start, end, t_start + (tran.start if tran else 0.0),
        tran.step if tran else (stop - t_start) / 1000.0,
        initial_state(circuit, scene, "uncharged" if start == "periodic" else start), charge or scene.network.senses,
        start if isinstance(start, str) else "given", t_stop is None and tran is not None,
    )  # fmt: skip


def to_ends(t: FloatArray, t_start: float, t_stop: float) -> None:
    """Set times (s, ascending) that pass an end of the run by rounding to that end, in place."""
    slack = same_time(t_stop)
    if t[0] < t_start:
        t[slice(*t.searchsorted([t_start - slack, t_start]))] = t_start
    if t[-1] > t_stop:
        t[slice(*t.searchsorted([t_stop, t_stop + slack], "right"))] = t_stop


def check_length(waveform: Waveform, t_start: float, t_stop: float) -> None:
    """Refuse a run with more periods or breakpoints than can be computed."""
    span = t_stop - t_start
    for count, what, most in (
        (span / waveform.shortest_time(), "periods or time constants", MOST_PERIODS),
        (span * waveform.breakpoint_rate(), "breakpoints", MOST_BREAKPOINTS),
    ):
        if not count <= most:
            told = f"{span:g} s long, {count:.3g} {what} of its source"
            raise InputError(f"the run is {told}; allowed: at most {most:.0e} of them")


def check_outputs(circuit: Circuit, count: float) -> None:
    """Refuse a number of output times for whose signals memory is too small."""

    def counted() -> int:
        of_device, nodes = {"GAP": 7, "V": 3, "I": 3}, {node for e in circuit.elements for node in e.nodes}
        return sum(of_device.get(e.device, 0) + e.spec.is_layer for e in circuit.elements) + len(nodes) + 1

    size = 8.0 * (signals := circuit.remember(("signals",), counted)) * count
    if not size <= MOST_BYTES:
        told = f"the run is one of {count:.3g} outputs with {signals} signals, {size / 1e9:.3g} GB; allowed: at most"
        raise InputError(f"{told} {MOST_BYTES / 1e9:g} GB: a longer TSTEP, or a TSTART that leaves out the beginning")


def at_breakpoints(problem: Problem, t: FloatArray) -> FloatArray:
    """Times (s), each set to the breakpoint from which it differs by rounding only: 5 ms means the jump at 5 ms.

    Recordings have no jumps, so that rounding changes nothing.
    """
    if all(isinstance(wave, (Samples, DC)) for wave in problem.network.waveforms):
        return t
    span, moved = (problem.t_start, problem.t_stop), t
    windows = 1 + int((span[1] - span[0]) * problem.network.waveform.breakpoint_rate() / _BREAKPOINTS_AT_ONCE)
    for w0, w1 in itertools.pairwise(np.linspace(*span, windows + 1)):
        edges = problem.breakpoints() if windows == 1 else problem.network.waveform.breakpoints(w0, w1)
        reach = same_time(1.0) * np.abs(edges)
        first = t.searchsorted(edges - reach)
        near = np.flatnonzero(np.abs(t.take(first, mode="clip") - edges) <= reach)
        edges, first, last = edges[near], first[near], t.searchsorted((edges + reach)[near], "right")
        for k in np.flatnonzero((t[first] != edges) | (t[last - 1] != edges)):
            moved = t.copy() if moved is t else moved
            moved[first[k] : last[k]] = edges[k]
    return moved


def asked_for(problem: Problem, t_eval: FloatArray | None, jumps: str) -> tuple[FloatArray, BoolArray]:
    """Output times (s) and whether each is left-hand: the given times, all right-hand, or the deck's."""
    check_length(problem.network.waveform, problem.t_start, problem.t_stop)
    if t_eval is not None:
        return t_eval, np.zeros(t_eval.size, bool)
    check_outputs(problem.circuit, (problem.t_stop - problem.first) / problem.step)
    key = "outputs", problem.t_start, problem.t_stop, problem.first, problem.step, jumps
    t_out = problem.network.waveform.remember(key, lambda: _output_times(problem, jumps), 1)
    # Check again, because each jump adds two outputs, of which the first is left-hand.
    check_outputs(problem.circuit, t_out.size)
    left = np.zeros(t_out.size, bool)
    np.equal(t_out[1:], t_out[:-1], out=left[:-1])
    return t_out, left


def _output_times(problem: Problem, jumps: str) -> FloatArray:
    """Times TSTART:TSTEP:TSTOP (s), unless `jumps` is "none" with two at each later jump."""
    step, first = problem.step, problem.first
    count = int(np.floor((problem.t_stop - first) / step * (1.0 + 1e-12) + 1e-9))
    grid = np.asarray(first + step * np.arange(count + 1), float)
    if grid.size and abs(grid[-1] - problem.t_stop) <= 1e-9 * step:
        grid[-1] = problem.t_stop
    found = [np.empty(0)]
    for wave in () if jumps == "none" else problem.network.waveforms:
        edges = wave.breakpoints(problem.t_start, problem.t_stop + same_time(problem.t_stop))
        edges = edges[(edges > problem.t_start + same_time(problem.t_start)) & (edges >= first)]
        if edges.size:
            # At a jump both limits differ by more than the source changes beside it, within the resolution of time: a
            # steep but continuous flank is none.
            right, before = wave.value(edges), wave.value(edges, "left")
            late = _RESOLVED * same_time(1.0) * np.abs(edges)
            moved = np.abs(wave.value(edges + late) - right) + np.abs(before - wave.value(edges - late, "left"))
            edges = edges[np.abs(right - before) > moved + 1e-12 * np.maximum(np.abs(right), np.abs(before))]
            found.append(np.where(edges > problem.t_stop - same_time(problem.t_stop), problem.t_stop, edges))
    at = np.unique(np.concatenate(found))
    if at.size:
        nearest = at[np.searchsorted(0.5 * (at[1:] + at[:-1]), grid)]
        grid, twice = grid[np.abs(grid - nearest) > 1e-9 * step], np.repeat(at, 2)
        grid = np.insert(grid, grid.searchsorted(twice), twice)
    return read_only(grid)


PERIODS_PER_WINDOW, BREAKPOINTS_PER_WINDOW = 4096.0, 2000.0
# A run of at most KEPT_WINDOWS windows leaves its tables in the waveform's cache, which holds about MOST_KEPT of them.
KEPT_WINDOWS, MOST_KEPT = 4, 16
# Number of times, evenly through the run, at which a function of arrays is looked at in any case: they take 1 ms.
LOOKS = 20_000


class Tables:
    """Tables of a problem's sources, window by window, until one of them stops being finite.

    Those of a user's function, which is expensive, are cached for the run, and others with the waveform if the run has
    few windows; in a longer run they are computed anew, in constant memory.
    """

    def __init__(self, problem: Problem, tol: float, *, no_chirps: bool = False) -> None:
        self.problem, self.no_chirps = problem, no_chirps
        self.tol = min(1e-3, max(0.05 * tol, 1e-14))
        span, wave = problem.t_stop - problem.t_start, problem.network.waveform
        # A function is sampled at the output step.
        longest = 4096.0 * problem.step if wave.is_sampled else math.inf
        longest = min(longest, PERIODS_PER_WINDOW * wave.shortest_time())
        rate = max(wave.breakpoint_rate() / BREAKPOINTS_PER_WINDOW, 1.0 / longest)
        count = max(1, int(np.ceil(span * rate)))
        # Limits (s) of the windows: short ones bound memory and the phases' round-off.
        self.edges = [problem.t_start + span * i / count for i in range(count)] + [problem.t_stop]
        self.done = -np.inf  # An iteration skips windows that end by this time (s), except the last window
        self.rough = 0.0  # Largest interpolation error (V) of a table that a finer table would not reduce
        # First output time (s) at which a user's function differs from its table, the difference (V), and its number.
        self.unseen: tuple[float, float, int] | None = None
        # Time (s) at which a source stops being finite, once the iteration has reached it.
        self.not_finite: float | None = None
        # Largest value (V or A) of each source in the windows so far, and among a few of its samples: a function that
        # rises out of next to nothing would be followed there beyond its own digits.
        peaks = [wave.kept.get("peak", (None, 0.0))[1] for wave in problem.network.waveforms]
        self.scales = [peak if np.isfinite(peak) else 0.0 for peak in peaks]
        self.keeper = Remembering() if wave.is_sampled else wave if count <= KEPT_WINDOWS else None

    def __iter__(self) -> Iterator[list[SourceTable]]:
        for w0, w1 in itertools.pairwise(self.edges):
            if w1 <= self.done and w1 < self.edges[-1]:
                continue
            # With `no_chirps`, chirps are approximated by series, so that these tables depend on the tolerance.
            key, make = ("tables", w0, w1, self.tol if self.no_chirps else None), partial(self._tables, w0, w1)
            most = max(MOST_KEPT, len(self.edges))
            tables = make() if self.keeper is None else self.keeper.remember(key, make, most)
            self.scales = [max(scale, table.scale) for scale, table in zip(self.scales, tables, strict=True)]
            self.rough = max(self.rough, *(table.rough for table in tables))
            self.not_finite = min((t.not_finite for t in tables if t.not_finite is not None), default=None)
            yield tables
            if self.not_finite is not None:
                return

    def _tables(self, w0: float, w1: float) -> list[SourceTable]:
        problem, tables = self.problem, []
        make = partial(source_table, no_chirps=self.no_chirps, shortest=shortest_event(problem))
        for place, (wave, scale) in enumerate(zip(problem.network.waveforms, self.scales, strict=True)):
            table = make(wave, w0, w1, self.tol, problem.step, scale=scale)
            if wave.is_sampled:
                off = table.unseen(wave, problem.t_out, self.tol)
                self.unseen = min((one for one in (self.unseen, off and (*off, place)) if one), default=None)
            tables.append(table)
        return tables


def shortest_event(problem: Problem) -> float:
    """Length (s) of the shortest event of a user's function that its samples surely meet."""
    one_by_one = any(wave.kept.get("one by one") for wave in problem.network.waveforms)
    return min(sampling.WIDEST * problem.step, math.inf if one_by_one else (problem.t_stop - problem.t_start) / LOOKS)


def joined(tables: list[SourceTable]) -> Sources:
    """Tables of all sources, concatenated for compiled code."""
    if len(tables) == 1:
        (one,) = tables
        return Sources(np.array([0, one.edges.size]), one.edges, one.terms, one.series)
    most = max(t.terms.shape[1] for t in tables), max(t.series.shape[1] for t in tables)
    first = np.cumsum([0, *(t.edges.size for t in tables)])
    terms = [np.pad(t.terms, ((0, 0), (0, most[0] - t.terms.shape[1]), (0, 0))) for t in tables]
    series = [np.pad(t.series, ((0, 0), (0, most[1] - t.series.shape[1]))) for t in tables]
    return Sources(first, np.concatenate([t.edges for t in tables]), np.concatenate(terms), np.concatenate(series))


def values_at(sources: Sources, t: float, side: Literal["left", "right"] = "right") -> tuple[FloatArray, FloatArray]:
    """Values of the sources at t (s) and their slopes (per second), on the given side."""
    values, slopes = np.empty((2, sources.first.size - 1))
    at_sources(sources, segment_index(sources, t, side), t, 0.0, values, slopes)
    return values, slopes


def after_the_end(problem: Problem) -> Sources | None:
    """The sources from the end of a run on, where one of them may jump there; else None."""
    stop, step = problem.t_stop, problem.step

    def make() -> Sources | None:
        if not any(breakpoints_at(wave, stop).size for wave in problem.network.waveforms):
            return None
        return joined([source_table(w, stop, stop + step, 1e-10, step) for w in problem.network.waveforms])

    return problem.network.waveform.remember(("after", stop, step), make, 1)


def segment_index(sources: Sources, t: float, side: Literal["left", "right"]) -> IntArray:
    """Index of every source's segment (n_s,) that contains t (s); at an edge, the segment on the given side."""
    spans = itertools.pairwise(sources.first)
    found = ((int(sources.edges[a:b].searchsorted(t, side)) - 1, b - a - 2) for a, b in spans)
    return np.array([min(max(i, 0), last) for i, last in found])
