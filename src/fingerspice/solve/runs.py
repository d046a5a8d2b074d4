"""What every integrator shares: the source window by window, the end of a run, and what a run gives back."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fingerspice.engine.model import Model, dot, gap_voltage, write_row_at
from fingerspice.engine.segment import Segment, source
from fingerspice.results.outcome import Attempt, ErrorEstimate, State, Status
from fingerspice.results.record import Record
from fingerspice.results.refined import ClosedForm
from fingerspice.results.steps import Recorded
from fingerspice.solve.networks import NetworkProblem
from fingerspice.solve.problem import Problem
from fingerspice.solve.times import check_length
from fingerspice.waveforms.sampling import SourceTable, breakpoints_at, source_table

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
Progress = Callable[[float], None]
Continuous = Recorded | ClosedForm

# An error below this share of the voltages that cancel in the gap's is rounding: finer steps would not reach it.
ROUNDING = 2e-14
PERIODS_PER_WINDOW = 4096.0
BREAKPOINTS_PER_WINDOW = 2000.0
KEPT_WINDOWS = 4


def kept_with(prepared: dict[Any, Any], key: tuple[Any, ...], most: int, make: Callable[[], Any]) -> Any:
    """What stands in a scene's `prepared` under a key, made if need be.

    There are at most `most` entries with the same first part of the key: beyond, all of them give way. Other threads
    may take them out meanwhile, so that what has been found is looked up once.
    """
    found = prepared.get(key)
    if found is None:
        kept = [name for name in list(prepared) if name[0] == key[0]]
        for name in kept if len(kept) >= most else ():
            prepared.pop(name, None)
        found = prepared[key] = make()
    return found


@dataclass
class Run:
    """What one integration gives, and how it went.

    `t`, `left`, `live`, `z`, `current` are as in `Record`, up to the time reached; `rough` is the source's (see
    `SourceTable`), V, and `unseen` the first output (s) at which it is not what was integrated, by how much (V);
    `margin` is the smallest distance to the fold met, `tried` the last steps tried, and `continuous` the run between
    its outputs, where that is known.
    """

    t: FloatArray
    left: BoolArray
    live: FloatArray
    z: FloatArray | None
    current: FloatArray | None
    status: Status
    error: ErrorEstimate
    peak_u: float
    peak_f: float
    nfev: int
    stats: dict[str, int]
    state: State
    t_failed: float | None = None
    detail: str = ""
    rough: float = 0.0
    unseen: tuple[float, float] | None = None
    margin: float = 1.0
    tried: tuple[Attempt, ...] = ()
    continuous: Continuous | None = None

    def record(self, problem: Problem) -> Record:
        """The outputs with what they mean."""
        return Record(
            problem.stack, problem.waveform, problem.model, self.t, self.left, self.live, self.z, self.current,
            self.state.charge_offset,
        )  # fmt: skip

    def end_before(self, t: float) -> None:
        """Take back the outputs from a time (s) on."""
        kept = self.t < t
        self.t, self.left, self.live = self.t[kept], self.left[kept], self.live[:, kept]
        if self.z is not None and self.current is not None:
            self.z, self.current = self.z[kept], self.current[kept]

    def excess(self, rtol: float) -> float:
        """Estimated error over the one asked for, the larger of voltage and force."""
        return self.error.excess(rtol, self.peak_u, self.peak_f)


class Tables:
    """Tables of a problem's source, window by window.

    A user's function is expensive to look at, so its tables are kept for the run. Those of library waveforms are made
    anew, which keeps a long run's memory constant, but for a run of few windows: its tables stay with the scene.
    """

    def __init__(
        self, problem: Problem, tol: float, *, no_chirps: bool = False, t_out: FloatArray | None = None
    ) -> None:
        self.no_chirps = no_chirps
        # Times (s) at which a user's function is compared with its table, and the first that it is not like it.
        self.t_out = t_out
        self.unseen: tuple[float, float] | None = None
        # Time at which the source stopped being finite, once that has been met.
        self.not_finite: float | None = None
        self.problem = problem
        self.tol = min(1e-3, max(0.05 * tol, 1e-14))
        self.edges = windows(problem)
        # Windows that end by this time (s) are done with, but for the last.
        self.done = -np.inf
        # Largest |U| (V) of the sampled windows so far.
        self.scale = 0.0
        self.rough = 0.0
        self.kept: dict[Any, SourceTable] | None = {} if problem.scene.is_sampled else None
        if self.kept is None and len(self.edges) <= 1 + KEPT_WINDOWS:
            self.kept = problem.scene.prepared.setdefault("tables", {})
            if len(self.kept) > 16:
                self.kept.clear()

    def __iter__(self) -> Iterator[SourceTable]:
        for w0, w1 in itertools.pairwise(self.edges):
            if w1 <= self.done and w1 < self.edges[-1]:
                continue
            key = (w0, w1, self.no_chirps)
            table = self.kept.get(key) if self.kept is not None else None
            if table is None:
                table = source_table(
                    self.problem.waveform, w0, w1, self.tol, self.problem.step, no_chirps=self.no_chirps,
                    scale=self.scale,
                )  # fmt: skip
                if self.unseen is None and self.t_out is not None and self.problem.scene.is_sampled:
                    self.unseen = table.unseen(self.problem.waveform, self.t_out, self.tol)
                if self.kept is not None:
                    self.kept[key] = table
            self.scale, self.rough = max(self.scale, table.scale), max(self.rough, table.rough)
            self.not_finite = table.not_finite
            yield table
            if table.not_finite is not None:
                return

    def peak(self) -> float:
        """Largest |U| (V) of the run."""
        if self.kept is None:
            return self.problem.waveform.peak(self.problem.t_start, self.problem.t_stop)
        return max(table.scale for table in self)


def windows(problem: Problem | NetworkProblem) -> list[float]:
    """Edges of the windows the source is tabulated on: constant memory, and phases that stay exact."""
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


def after_the_end(problem: Problem, table: SourceTable) -> tuple[Segment, float]:
    """The segment that right-hand outputs at the very end of a run belong to, and how far into it they are, s."""
    stop = problem.t_stop
    if breakpoints_at(problem.waveform, stop).size:
        span = stop, problem.step
        # One entry with its key: another thread may put its own there at any time.
        kept, after = problem.scene.prepared.get("after", (None, None))
        if kept != span:
            after = source_table(problem.waveform, stop, stop + problem.step, 1e-10, problem.step)
            problem.scene.prepared["after"] = span, after
        table = after
        length = float(table.edges[1] - table.edges[0])
        return Segment(float(table.edges[0]), length, table.terms[0], table.series[0]), 0.0
    start = float(table.edges[-2])
    segment = Segment(start, float(table.edges[-1]) - start, table.terms[-1], table.series[-1])
    return segment, stop - start


def last_row(
    problem: Problem, model: Model, table: SourceTable, t: float, y: FloatArray, sign: float, u_gap: float
) -> FloatArray | None:  # fmt: skip
    """Row at the time t (s) that a failed run reached, left-hand; None before the first step, or if it is not finite.

    `model` may cover more of the area's curve than the problem's; `y`, `sign` and `u_gap` (V) are the state there, its
    branch and its gap voltage.
    """
    if t <= problem.t_start:
        return None
    i = max(int(np.searchsorted(table.edges, t, side="left")) - 1, 0)
    start = float(table.edges[i])
    segment = Segment(start, float(table.edges[i + 1]) - start, table.terms[i], table.series[i])
    row = np.empty(row_width(problem))
    u, du = source(segment, t - start)
    found = gap_voltage(model, model.k_gap * u, dot(model.gap, y), sign, u_gap)
    # By rounding of the time alone a state at a fold may have none.
    write_row_at(model, u, du, y, sign, found if found == found else u_gap, row)
    return row if np.all(np.isfinite(row)) else None


def from_rows(problem: Problem, rows: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Live layer voltages, z and current from rows of `engine.model.write_row`."""
    # Rows hold y = [x, z] after five columns; z is the last.
    live = problem.scene.live_voltages(rows[:, 0], rows[:, 2], rows[:, 5:-1])
    return live, rows[:, -1].copy(), rows[:, 3].copy()


def row_width(problem: Problem) -> int:
    """Columns of a row of `engine.model.write_row`."""
    return 5 + problem.stack.c.size
