"""Streams: long runs chunk by chunk, in constant memory.

A run is integrated in pieces whose length does not depend on the chunks: one that `solve.recordings.run` follows in the
pieces that it takes, any other run in windows of a fixed number of outputs, each starting from the final state of the
window before. Chunks are cut from the outputs of the pieces, so that no bit depends on their length.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from fingerspice.base.arrays import FloatArray, positive_number, whole_number
from fingerspice.circuit.circuit import Circuit
from fingerspice.circuit.describe import Parameters, Sources, overridden
from fingerspice.results.outcome import Plan, SolveError, Status
from fingerspice.results.record import Record
from fingerspice.results.solution import Solution
from fingerspice.solve.planning import asked, make_plan
from fingerspice.solve.problem import Problem, check_length, check_outputs
from fingerspice.solve.recordings.run import BySamples, ByWindows, Mark, Outputs, outputs_of, within
from fingerspice.solve.simulation import check_arguments, solution_of
from fingerspice.waveforms.waveform import require

# Default length of a chunk, s.
CHUNK = 10.0


class Stream:
    """A run chunk by chunk: an iterator over `Solution` objects, made by `fs.stream`.

    Attributes
    ----------
    problem : Problem
    outputs : Outputs
        All output times.
    count : int
        Number of outputs in a chunk; the last chunk may have fewer.
    done : int
        Number of outputs in the chunks returned so far.
    """

    def __init__(self, problem: Problem, plan: Plan, outputs: Outputs, count: int, rtol: float, method: str) -> None:
        self.problem, self.plan, self.outputs, self.count, self.rtol = problem, plan, outputs, count, rtol
        self.done = 0
        by_samples = BySamples.of(problem, outputs, plan, rtol) if method == "auto" else None
        self._source: BySamples | ByWindows = by_samples or ByWindows(problem, outputs, plan, rtol, method)
        # Integrated pieces whose outputs no chunk has contained yet: the mark before each, times (s) and rows.
        self._ready: list[tuple[Mark, FloatArray, FloatArray]] = []

    def __iter__(self) -> Iterator[Solution]:
        return self

    def __len__(self) -> int:
        """Total number of chunks."""
        return -(-self.outputs.total // self.count)

    def __next__(self) -> Solution:
        if self.done == self.outputs.total:
            raise StopIteration
        wanted = min(self.count, self.outputs.total - self.done)
        self._reach(self.done + wanted)
        solution = self._solution(*self._take(wanted))
        if solution.failure is not None:
            self.done = self.outputs.total
            raise SolveError(solution.failure, solution)
        self.done += wanted
        return solution

    def mark(self) -> Mark:
        """The state before the piece that contains the next chunk's first output, as plain data; see `go_to`."""
        marks = [*(mark for mark, _, _ in self._ready), self._source.mark()]
        return [mark for mark in marks if mark["written"] <= self.done][-1]

    def go_to(self, mark: Mark, done: int) -> None:
        """Continue a stream from its mark, after `done` outputs; allowed before this stream's first chunk only."""
        if "state" in mark and isinstance(self._source, BySamples):
            self._source = self._stepped()
        self._source.go_to(mark)
        self.done = done
        self._reach(done + 1)
        self._take(done - (self._ready[0][0]["written"] if self._ready else done))

    def _stepped(self) -> ByWindows:
        """The method for a recording that the one for recordings fails on."""
        return ByWindows(self.problem, self.outputs, self.plan, self.rtol, "exponential")

    def _reach(self, written: int) -> None:
        """Integrate pieces until so many outputs are there, or the run ends."""
        while self._source.written < written and not self._source.over:
            mark = self._source.mark()
            found = self._source.advance()
            if found is None:
                # Integrate this piece, and the rest, by exponential steps.
                assert isinstance(self._source, BySamples)
                self._source.go_to(mark)
                other = self._stepped()
                other.written, other.state = mark["written"], self._source.march.state
                self._source = other
                mark, found = other.mark(), other.advance()
            self._ready.append((mark, *found))

    def _take(self, count: int) -> tuple[FloatArray, FloatArray]:
        """Take the next `count` outputs, or all if there are fewer: times (s) and rows."""
        times, rows, left = [np.empty(0)], [], count
        while left > 0 and self._ready:
            mark, t, r = self._ready.pop(0)
            times.append(t[:left])
            rows.append(r[:left])
            if t.size > left:
                self._ready.insert(0, (mark, t[left:], r[left:]))
            left -= times[-1].size
        width = max(self.problem.initial.y.size, 1)
        return np.concatenate(times), np.concatenate(rows) if rows else np.empty((0, width))

    def _solution(self, t: FloatArray, rows: FloatArray) -> Solution:
        problem, run = self.problem, self._source.run()
        if self._ready:
            # A failure concerns a later chunk if outputs before it are still waiting for their chunk.
            run.status, run.t_failed = Status.SUCCESS, None
        shown = problem.scene.shown
        span = (float(t[0]), float(t[-1])) if t.size else (problem.t_start, problem.t_start)
        network = within(shown.network, *span)
        record = Record(network, shown.net, t, np.zeros(t.size, bool), np.ascontiguousarray(rows), problem.charge)
        found = solution_of(problem, self.plan, run, record, t, self.rtol, self._source.method)
        return replace(found, first=span[0], t_stop=span[1])


def stream(
    circuit: Circuit,
    *,
    chunk: float | None = None,
    count: int | None = None,
    step: float | None = None,
    t_stop: float | None = None,
    sources: Sources | None = None,
    parameters: Parameters | None = None,
    charge_law: str | None = None,
    area: str | float = "coupled",
    rtol: float = 1e-8,
    method: str = "auto",
    tier: str = "auto",
    start: str | Solution = "deck",
    charge: bool = True,
) -> Stream:
    """Simulate a circuit in time chunk by chunk, in memory that does not grow with the length of the run.

    The outputs are the same to the last bit whatever the length of the chunks. Where a run is followed sample by sample
    (recordings on a series stack or a network with one finger, see `simulate`) they also equal those of `simulate` with
    the same times as `t_eval`. For other runs they do not, because each window of 16,384 outputs is a run of its own,
    which starts from the final state of the window before.

    Parameters
    ----------
    circuit : Circuit
    chunk : float, optional
        Length of a chunk, s; 10 s by default.
    count : int, optional
        Number of outputs in a chunk, instead of `chunk`.
    step : float, optional
        Time between outputs, s, from TSTART on. By default the outputs are at the samples of the recording that drives
        the circuit; without a recording, or with several sources, they are TSTEP apart.
    t_stop, sources, parameters, charge_law, area, rtol, method, tier, start, charge
        As in `simulate`. A long recording is `Samples.from_wav(path, gain, at_once=False)`, or a deck's WAVEFILE.

    Returns
    -------
    Stream
        An iterator over `Solution` objects. At a jump of a source there is one row, the right-hand one. The stated
        errors of a chunk are the largest since the start (except for recordings, they do not include the error of the
        state at the start of the last window). Its figures are computed from its outputs, and its `state` is the state
        at the end of the last piece integrated.

    Raises
    ------
    InputError
        For a request that cannot be run.
    SolveError
        While iterating, where the run fails; its `solution` holds the outputs after the last chunk.
    """
    rtol = check_arguments(rtol, method, area, start)
    chunk = None if chunk is None else positive_number("chunk", chunk, "s")
    step = None if step is None else positive_number("step", step, "s")
    if count is not None:
        count = whole_number("count", count, 1)
        require(chunk is None, "count", "given beside chunk", "one of them")
    circuit = overridden(circuit, sources, parameters)
    how: dict[str, Any] = {"t_stop": t_stop, "charge_law": charge_law, "area": area, "start": start}
    problem = asked(circuit, charge=charge, rtol=rtol, **how)
    check_length(problem.waveform, problem.t_start, problem.t_stop)
    outputs = outputs_of(problem, step)
    if count is None:
        spacing = 1.0 / outputs.over if outputs.rated else outputs.over
        count = max(1, round((CHUNK if chunk is None else chunk) / spacing))
    count = min(count, outputs.total)
    check_outputs(circuit, count)
    return Stream(problem, make_plan(problem, rtol, tier, method), outputs, count, rtol, method)
