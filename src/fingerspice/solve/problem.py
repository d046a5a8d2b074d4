"""A run prepared for integration: scene, start, end, initial state, and the times of its outputs."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import cast

import numpy as np

from fingerspice.base.arrays import BoolArray, FloatArray, real_number
from fingerspice.base.errors import InputError
from fingerspice.circuit.arguments import area_given
from fingerspice.circuit.circuit import Circuit
from fingerspice.circuit.network import Network
from fingerspice.circuit.notices import time_slip
from fingerspice.results.outcome import State
from fingerspice.results.solution import Solution
from fingerspice.solve.initial import StackState, initial_state, to_stack
from fingerspice.solve.scenes import Scene, kept_with, scene_of
from fingerspice.waveforms.samples import Samples
from fingerspice.waveforms.sampling import misses, on_breakpoint, same_time
from fingerspice.waveforms.waveform import DC, Waveform, require

#: Most periods (or shortest time scales) of the source in a run, and most breakpoints: they take hours and a gigabyte.
MOST_PERIODS, MOST_BREAKPOINTS = 1e10, 4e9
#: Most bytes of the signals at the deck's own output times; writing a file needs three times as much memory.
MOST_BYTES = 2e9
# Round-off of a gap voltage relative to the voltages that cancel in it; finer steps cannot reduce the error below that.
ROUNDING = 2e-14
# Largest number of breakpoints (64 kB) and of output times (0.3 MB) cached with a waveform.
KEPT_BREAKPOINTS, KEPT_OUTPUTS = 8192, 32_768
# Resolution of a time in units of its rounding error; a difference of a source's two limits at an edge is no jump if
# the source changes as much within this resolution beside the edge.
_RESOLVED = 8.0
# Breakpoints held in memory at a time, so that memory does not grow with the length of the run.
_BREAKPOINTS_AT_ONCE = 65_536


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
        """The problem with other outputs."""
        return replace(self, t_out=t, left=left)

    @property
    def network(self) -> Network:
        return self.scene.network

    @property
    def waveform(self) -> Waveform:
        return self.scene.waveform

    @property
    def waveforms(self) -> tuple[Waveform, ...]:
        return self.scene.waveforms

    @cached_property
    def largest(self) -> float:
        """Larger one of the sources' peak and the largest live voltage of the start, V."""
        n = self.scene.network.k.shape[0]
        return max(self.scene.u_peak, float(np.abs(self.initial.y[:n]).max(initial=0.0)))

    @property
    def rounding(self) -> float:
        """Round-off of a gap's voltage, V: a smaller voltage is 0, and has no sign."""
        return ROUNDING * max(self.largest, self.scene.u_size)

    @cached_property
    def inner(self) -> StackState:
        """The start of a stack in the form of its own equations."""
        state, inner = self.scene.prepared.get("inner", (None, None))
        if state is not self.initial:
            _, inner = self.scene.prepared["inner"] = self.initial, to_stack(self.scene, self.initial)
        return cast("StackState", inner)

    def done(self, t: float) -> float:
        """Fraction of the run that is done at time t, s."""
        return (t - self.t_start) / (self.t_stop - self.t_start)

    def breakpoints(self) -> FloatArray:
        """The sources' breakpoints in the run, s; the waveform caches them if they are few."""
        kept, key = self.waveform.kept, ("breakpoints", self.t_start, self.t_stop)
        edges = kept_with(kept, key, 1, lambda: self.waveform.breakpoints(self.t_start, self.t_stop))
        if edges.size > KEPT_BREAKPOINTS:
            kept.pop(key, None)
        return edges

    @property
    def max_step(self) -> float:
        """Longest step (s) that the deck's .tran line allows."""
        tran = self.circuit.tran
        return math.inf if tran is None or tran.max_step is None else tran.max_step


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

    `rtol` decides whether a dispersive skin's data may be taken at one frequency. A run from the periodic state is
    prepared from the uncharged start.
    """
    t_stop = None if t_stop is None else real_number("t_stop", t_stop, "a number in s")
    if isinstance(start, Solution) and start.stored is not None:
        raise InputError("start is a solution read from a file, which a run cannot go on from; allowed: one just made")
    t_start = start.state.t if isinstance(start, Solution) else 0.0
    scene = scene_of(circuit, charge_law, area_given(area), t_stop, rtol)
    stop = _end(circuit, t_start, t_stop, t_eval)
    tran, wave = circuit.tran, scene.waveform
    end = kept_with(wave.kept, ("end", stop), 1, lambda: on_breakpoint(wave, stop))
    return Problem(
        circuit, scene, t_start, end, t_start + (tran.start if tran else 0.0),
        tran.step if tran else (stop - t_start) / 1000.0,
        initial_state(circuit, scene, "uncharged" if start == "periodic" else start), charge,
        start if isinstance(start, str) else "given", t_stop is None and tran is not None,
    )  # fmt: skip


def _end(circuit: Circuit, t_start: float, t_stop: float | None, t_eval: FloatArray | None) -> float:
    """End of the run, s, with its output times checked against it."""
    if t_stop is None:
        if circuit.tran is not None:
            t_stop = t_start + circuit.tran.stop
        elif t_eval is not None and t_eval.size:
            t_stop = float(t_eval[-1])
        else:
            raise InputError("no t_stop: the deck has no .tran line and none was given; give t_stop in s")
    require(math.isfinite(t_stop) and t_stop > t_start, "t_stop", f"{t_stop:g} s", f"more than {t_start:g} s")
    if t_eval is not None:
        require(t_eval.ndim == 1 and t_eval.size > 0, "t_eval", f"of shape {t_eval.shape}", "one row of times")
        require(bool(np.all(t_eval[1:] >= t_eval[:-1])), "t_eval", "not in order", "ascending times")
        to_ends(t_eval, t_start, t_stop)
        first, last = float(t_eval[0]), float(t_eval[-1])
        allowed = f"times from {t_start:g} s to t_stop = {t_stop:g} s{time_slip(first, last, t_stop)}"
        require(first >= t_start and last <= t_stop, "t_eval", f"{first:g} s to {last:g} s", allowed)
    return t_stop


def to_ends(t: FloatArray, t_start: float, t_stop: float) -> None:
    """Set times (s, ascending) that pass an end of the run by rounding to that end, in place."""
    slack = same_time(t_stop)
    t[slice(*t.searchsorted([t_start - slack, t_start]))] = t_start
    t[slice(*t.searchsorted([t_stop, t_stop + slack], "right"))] = t_stop


def check_length(waveform: Waveform, t_start: float, t_stop: float) -> None:
    """Refuse a run with more periods or breakpoints than can be computed."""
    span = t_stop - t_start
    for count, what, most in (
        (span / waveform.shortest_time(), "periods or time constants", MOST_PERIODS),
        (span * waveform.breakpoint_rate(), "breakpoints", MOST_BREAKPOINTS),
    ):
        told = f"{span:g} s long, {count:.3g} {what} of its source"
        require(count <= most, "the run", told, f"at most {most:.0e} of them")


def check_outputs(circuit: Circuit, count: float) -> None:
    """Refuse a number of output times for whose signals memory is too small."""

    def columns() -> int:
        devices = [element.device for element in circuit.elements]
        layers = sum(element.spec.is_layer for element in circuit.elements)
        nodes = len({node for element in circuit.elements for node in element.nodes})
        return layers + nodes + 7 * devices.count("GAP") + 3 * (devices.count("V") + devices.count("I")) + 1

    signals = circuit.remember("columns", columns)
    size = 8.0 * signals * count
    require(
        size <= MOST_BYTES,
        "the run",
        f"one of {count:.3g} outputs with {signals} signals, {size / 1e9:.3g} GB",
        f"at most {MOST_BYTES / 1e9:g} GB: a longer TSTEP, or a TSTART that leaves out the beginning",
    )


def at_breakpoints(problem: Problem, t: FloatArray) -> FloatArray:
    """Times (s), each set to the breakpoint from which it differs by rounding only: 5 ms means the jump at 5 ms.

    Recordings have no jumps, so that rounding changes nothing.
    """
    if all(isinstance(wave, Samples | DC) for wave in problem.waveforms):
        return t
    span = problem.t_start, problem.t_stop
    windows = 1 + int((span[1] - span[0]) * problem.waveform.breakpoint_rate() / _BREAKPOINTS_AT_ONCE)
    moved = t
    for w0, w1 in itertools.pairwise(span if windows == 1 else np.linspace(*span, windows + 1)):
        edges = problem.breakpoints() if windows == 1 else problem.waveform.breakpoints(w0, w1)
        near = edges[misses(t, edges, same_time(1.0))] if edges.size else edges
        moved = t.copy() if near.size and moved is t else moved
        slack = same_time(1.0) * np.abs(near)
        spans = zip(near, t.searchsorted(near - slack), t.searchsorted(near + slack, "right"), strict=True)
        for edge, first, last in spans:
            moved[first:last] = edge
    return moved


def asked_for(problem: Problem, t_eval: FloatArray | None, jumps: str) -> tuple[FloatArray, BoolArray]:
    """Output times (s) and whether each is left-hand: the given times, all right-hand, or the deck's."""
    check_length(problem.waveform, problem.t_start, problem.t_stop)
    if t_eval is not None:
        return t_eval, np.zeros(t_eval.size, bool)
    check_outputs(problem.circuit, (problem.t_stop - problem.first) / problem.step)
    kept, key = problem.waveform.kept, ("outputs", problem.t_start, problem.t_stop, problem.first, problem.step, jumps)
    t_out, left = kept_with(kept, key, 1, lambda: _output_times(problem, jumps))
    if t_out.size > KEPT_OUTPUTS:
        kept.pop(key, None)
    # Check again, because each jump adds two outputs.
    check_outputs(problem.circuit, t_out.size)
    return t_out, left


def _output_times(problem: Problem, jumps: str) -> tuple[FloatArray, BoolArray]:
    """Times TSTART:TSTEP:TSTOP (s) and whether each is left-hand; unless `jumps` is "none", two more at each jump.

    A jump at t = 0 has no left-hand output.
    """
    step, first = problem.step, problem.first
    count = int(np.floor((problem.t_stop - first) / step * (1.0 + 1e-12) + 1e-9))
    grid = np.asarray(first + step * np.arange(count + 1), float)
    if grid.size and abs(grid[-1] - problem.t_stop) <= 1e-9 * step:
        grid[-1] = problem.t_stop
    at = np.empty(0) if jumps == "none" else _jumps(problem)
    if at.size:
        near = np.clip(np.searchsorted(at, grid), 1, max(at.size - 1, 1))
        distance = np.minimum(np.abs(grid - at[near - 1]), np.abs(grid - at[np.minimum(near, at.size - 1)]))
        grid = grid[distance > 1e-9 * step]
    t = np.concatenate([grid, at, at])
    left = np.zeros(t.size, bool)
    left[grid.size : grid.size + at.size] = True
    order = np.lexsort((~left, t))
    t, left = t[order], left[order]
    t.flags.writeable = left.flags.writeable = False
    return t, left


def _jumps(problem: Problem) -> FloatArray:
    """Times (s, ascending) of the jumps of any source in the run, after its start.

    A jump is an edge at which both limits differ by more than the source changes beside it, within the resolution of
    time, so that a steep but continuous flank is no jump.
    """
    stop, found = problem.t_stop, [np.empty(0)]
    rounding = same_time(stop)
    for wave in problem.waveforms:
        edges = wave.breakpoints(problem.t_start, stop + rounding)
        edges = edges[(edges > problem.t_start + same_time(problem.t_start)) & (edges >= problem.first)]
        if edges.size:
            right, left = wave.value(edges), wave.value(edges, "left")
            late = _RESOLVED * same_time(1.0) * np.abs(edges)
            moved = np.abs(wave.value(edges + late) - right) + np.abs(left - wave.value(edges - late, "left"))
            edges = edges[np.abs(right - left) > moved + 1e-12 * np.maximum(np.abs(right), np.abs(left))]
            found.append(np.where(edges > stop - rounding, stop, edges))
    return np.unique(np.concatenate(found))
