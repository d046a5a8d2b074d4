"""Output times of a run: the deck's grid, both sides of the jumps of its sources, and times rounded to a breakpoint."""

from __future__ import annotations

import itertools

import numpy as np

from fingerspice.base.arrays import BoolArray, FloatArray
from fingerspice.solve.problem import Problem, check_length, check_outputs
from fingerspice.waveforms.samples import Samples
from fingerspice.waveforms.sampling import misses, same_time
from fingerspice.waveforms.waveform import DC, Waveform

# Resolution of a time in units of its rounding error; a difference of a source's two limits at an edge is no jump if
# the source changes as much within this resolution beside the edge.
_RESOLVED = 8.0
# Breakpoints held in memory at a time, so that memory does not grow with the length of the run.
_BREAKPOINTS_AT_ONCE = 65_536
# Output times (0.3 MB) that a waveform keeps.
KEPT_OUTPUTS = 32_768
_NONE = np.empty(0)


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
        for edge, first, last in zip(
            near, t.searchsorted(near - slack), t.searchsorted(near + slack, "right"), strict=True
        ):
            moved[first:last] = edge
    return moved


def asked_for(
    problem: Problem, t_eval: FloatArray | None, jumps: str
) -> tuple[FloatArray, BoolArray]:  # fmt: skip
    """Output times (s) and whether each is left-hand: the given times, all right-hand, or the deck's.

    Raises
    ------
    InputError
        For a run that is too long or has too many outputs.
    """
    check_length(problem.waveform, problem.t_start, problem.t_stop)
    if t_eval is not None:
        return t_eval, np.zeros(t_eval.size, bool)
    check_outputs(problem.circuit, (problem.t_stop - problem.first) / problem.step)
    key, kept = (problem.t_start, problem.t_stop, problem.first, problem.step, jumps), problem.waveform.kept
    # One entry with its key: another thread may put its own there at any time.
    known, t_out, left = kept.get("outputs", (None, _NONE, _NONE))
    if known != key:
        t_out, left = output_times(problem, jumps)
        t_out.flags.writeable = left.flags.writeable = False
        if t_out.size <= KEPT_OUTPUTS:
            kept["outputs"] = key, t_out, left
    # Check again, because each jump adds two outputs.
    check_outputs(problem.circuit, t_out.size)
    return t_out, left


def output_times(problem: Problem, jumps: str = "both") -> tuple[FloatArray, BoolArray]:
    """Times TSTART:TSTEP:TSTOP (s) and whether each is left-hand; unless `jumps` is "none", two more at each jump.

    A jump at t = 0 has no left-hand output.
    """
    step, first = problem.step, problem.first
    count = int(np.floor((problem.t_stop - first) / step * (1.0 + 1e-12) + 1e-9))
    grid = np.asarray(first + step * np.arange(count + 1), float)
    if grid.size and abs(grid[-1] - problem.t_stop) <= 1e-9 * step:
        grid[-1] = problem.t_stop
    if jumps == "none":
        return grid, np.zeros(grid.size, bool)
    at = _jumps(problem)
    if at.size:
        near = np.clip(np.searchsorted(at, grid), 1, max(at.size - 1, 1))
        distance = np.minimum(np.abs(grid - at[near - 1]), np.abs(grid - at[np.minimum(near, at.size - 1)]))
        grid = grid[distance > 1e-9 * step]
    t = np.concatenate([grid, at, at])
    left = np.concatenate([np.zeros(grid.size, bool), np.ones(at.size, bool), np.zeros(at.size, bool)])
    order = np.lexsort((~left, t))
    return np.ascontiguousarray(t[order]), np.ascontiguousarray(left[order])


def _jumps(problem: Problem) -> FloatArray:
    """Times (s, ascending) of the jumps of any source in the run, after its start."""
    stop = problem.t_stop
    rounding = same_time(stop)
    found = []
    for wave in problem.waveforms:
        edges = wave.breakpoints(problem.t_start, stop + rounding)
        edges = edges[(edges > problem.t_start + same_time(problem.t_start)) & (edges >= problem.first)]
        if edges.size:
            edges = edges[_is_jump(wave, edges)]
            found.append(np.where(edges > stop - rounding, stop, edges))
    return np.unique(np.concatenate(found)) if found else np.empty(0)


def _is_jump(wave: Waveform, edges: FloatArray) -> BoolArray:
    """Whether a waveform jumps at its edges (s): its limits differ by more than it changes beside the edge.

    That change is taken over the resolution of time, so that a steep but continuous flank is no jump.
    """
    right, left = wave.value(edges), wave.value(edges, "left")
    late = _RESOLVED * same_time(1.0) * np.abs(edges)
    moved = np.abs(wave.value(edges + late) - right) + np.abs(left - wave.value(edges - late, "left"))
    return np.asarray(np.abs(right - left) > moved + 1e-12 * np.maximum(np.abs(right), np.abs(left)))
