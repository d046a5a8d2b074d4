"""Streams: long runs chunk by chunk, in constant memory.

A run is integrated in pieces whose length does not depend on the chunks: one that `solve.recordings` follows in the
pieces that it takes, any other run in windows of a fixed number of outputs, each starting from the final state of the
window before. Chunks are cut from the outputs of the pieces, so that no bit depends on their length.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from fingerspice.base.arrays import FloatArray, positive_number, whole_number
from fingerspice.circuit.circuit import Circuit
from fingerspice.circuit.describe import Parameters, Sources, overridden
from fingerspice.circuit.network import Network
from fingerspice.results.outcome import Plan, SolveError, State, Status
from fingerspice.results.record import Record
from fingerspice.results.solution import Solution
from fingerspice.solve.periodic import asked
from fingerspice.solve.problem import Problem, at_breakpoints, check_length, check_outputs
from fingerspice.solve.recordings import LaneMarch, LostError, prepared
from fingerspice.solve.runs import Run
from fingerspice.solve.simulation import check_arguments, integrated, make_plan, own_rtol, solution_of, state_error
from fingerspice.solve.starting import as_shown
from fingerspice.waveforms.samples import Samples
from fingerspice.waveforms.sampling import on_breakpoint
from fingerspice.waveforms.waveform import require

# Default length of a chunk, s; number of outputs in a window of a run that is not integrated sample by sample.
CHUNK, WINDOW = 10.0, 1 << 14
_NO_OUTPUTS = np.empty(0), np.empty(0, bool), np.empty((0, 0))
#: State of a stream before a piece, as plain data: another stream continues from it with the same bytes.
Mark = dict[str, Any]


class Outputs:
    """Output times, evenly spaced: at the samples of a recording, or every `step` (s); else the deck's TSTEP apart."""

    def __init__(self, problem: Problem, step: float | None) -> None:
        wave, first, self.stop = problem.network.waveform, max(problem.first, problem.t_start), problem.t_stop
        # Number of the first output, and how many there are; time of output number 0, s, and spacing of all, s.
        self.low, self.start, self.spacing = 0, first, problem.step if step is None else step
        # Of a recording, whose samples are the outputs.
        self.rate: float | None = None
        if step is None and isinstance(wave, Samples):
            self.start, self.spacing, self.rate = wave.start, 1.0 / wave.rate, wave.rate
            self.low = math.ceil((first - wave.start) * wave.rate - 1e-6)
            self.total = math.floor((self.stop - wave.start) * wave.rate + 1e-6) - self.low + 1
        else:
            self.total = math.floor((self.stop - first) / self.spacing * (1.0 + 1e-12) + 1e-9) + 1
        require(self.total >= 1, "the run", f"one of {self.stop - first:g} s without any output", "a longer one")

    def times(self, i: int, j: int) -> FloatArray:
        """Times of outputs i to j - 1, s, rounded as ``start + arange / rate`` or ``start + step * arange`` are."""
        number = np.arange(self.low + i, self.low + min(j, self.total))
        t = self.start + (self.spacing * number if self.rate is None else number / self.rate)
        return np.asarray(np.minimum(t, self.stop))


class Stream(Iterator[Solution]):
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
        # Outputs in the chunks returned so far, and outputs integrated. Of the latest piece: the state before it, and
        # the times (s) and rows that no chunk has contained yet; None where there are none.
        self.done, self._written = 0, 0
        self._rest: tuple[Mark, FloatArray, FloatArray] | None = None
        # Of a recording that is followed sample by sample.
        own, by_samples = own_rtol(problem, plan, rtol), method == "auto" and plan.tier == "coupled"
        found = prepared(problem, own) if by_samples else None
        self._march = None if found is None else LaneMarch(problem, *found, own)
        # Of a run in windows, such as what the method for recordings fails on: the method asked for, and the one used
        # and the run of the last window.
        self._asked, self._method = (method, method) if found is None else ("exponential", "relaxation")
        self._last = Run(*_NO_OUTPUTS, Status.SUCCESS, 0, {}, problem.initial)

    def __len__(self) -> int:
        """Total number of chunks."""
        return -(-self.outputs.total // self.count)

    def __next__(self) -> Solution:
        if self.done == self.outputs.total:
            raise StopIteration
        wanted = min(self.count, self.outputs.total - self.done)
        solution = self._solution(*self._take(wanted))
        if solution.failure is not None:
            self.done = self.outputs.total
            raise SolveError(solution.failure, solution)
        self.done += wanted
        return solution

    def mark(self) -> Mark:
        """The state before the piece that contains the next chunk's first output, as plain data; see `go_to`."""
        return self._here() if self._rest is None else self._rest[0]

    def go_to(self, mark: Mark, done: int) -> None:
        """Continue a stream from its mark, after `done` outputs; allowed before this stream's first chunk only."""
        kept: Mark = {name: np.array(value) if isinstance(value, list) else value for name, value in mark.items()}
        self._written, self.done = kept.pop("written"), done
        if self._march is not None and "gaps" not in kept:
            vars(self._march).update(kept)
        else:
            gaps, self._march = kept.pop("gaps").reshape(-1, 4), None
            self._last = replace(self._last, state=State(**kept), gaps=gaps)
        if done > self._written:
            self._take(done - self._written)

    def _here(self) -> Mark:
        """The mark of the state reached."""
        last = self._last
        kept = {**vars(last.state), "gaps": last.gaps} if self._march is None else self._march.mark()
        return {"written": self._written} | {name: np.asarray(value).tolist() for name, value in kept.items()}

    @property
    def _over(self) -> bool:
        """Whether the run has reached its end, or failed."""
        return self._last.status is not Status.SUCCESS or self._written == self.outputs.total

    def _take(self, count: int) -> tuple[FloatArray, FloatArray]:
        """The next `count` outputs, or fewer where the run ends before: times (s) and rows."""
        found: list[tuple[FloatArray, FloatArray]] = []
        while count > 0 and (self._rest is not None or not self._over):
            before, t, rows = self._rest or (
                self._here(), *(self._window() if self._march is None else self._piece(self._march)),
            )  # fmt: skip
            found.append((t[:count], rows[:count]))
            self._rest = (before, t[count:], rows[count:]) if t.size > count else None
            count -= t.size
        if len(found) == 1:
            return found[0]
        # The numbers of a column stay together in memory, as they are read. Windows have unwanted charges, too.
        width = min(rows.shape[1] for _, rows in found)
        return np.concatenate([t for t, _ in found]), np.concatenate([rows.T[:width] for _, rows in found], axis=1).T

    def _piece(self, march: LaneMarch) -> tuple[FloatArray, FloatArray]:
        """Times (s) and rows of the next piece of a recording."""
        piece, o = march.pieces[march.place], self.outputs
        # All outputs up to the end of the piece, and a few more.
        end = math.ceil((piece.stop - o.start) / o.spacing) - o.low + 2
        t = o.times(self._written, max(end, self._written))
        run_at = at_breakpoints(replace(self.problem, t_start=piece.start, t_stop=piece.stop), t)
        out = march.outputs_at(run_at)
        try:
            march.follow(run_at, out)
        except LostError:
            # The state before this piece, and what has been stated so far.
            self._last, self._march = march.run(*_NO_OUTPUTS), None
            return self._window()
        count = march.outputs
        self._written += count
        return t[:count], out[:, :count].T

    def _window(self) -> tuple[FloatArray, FloatArray]:
        """Times (s) and rows of the next window."""
        end = min(self._written + WINDOW, self.outputs.total)
        t, whole = self.outputs.times(self._written, end), self.problem
        stop = whole.t_stop if end == self.outputs.total else on_breakpoint(whole.network.waveform, float(t[-1]))
        state = self._last.state
        start = state.t
        scene = replace(whole.scene, network=within(whole.network, start, stop + whole.step))
        problem = replace(whole, scene=scene, t_start=start, t_stop=stop, first=start, initial=state)
        problem = problem.at(at_breakpoints(problem, t), np.zeros(t.size, bool))
        run, self._method = integrated(problem, self.plan, self.rtol, self._asked)
        if run.gaps.shape == self._last.gaps.shape:
            run.gaps = np.maximum(run.gaps, self._last.gaps)
        self._last, self._written = run, self._written + run.t.size
        # In the form of exponential steps, whichever method has computed them.
        t = t[: run.t.size] if run.status is Status.SUCCESS else run.t
        return t, run.rows if run.by_layer else as_shown(whole.scene, run.rows)

    def _solution(self, t: FloatArray, rows: FloatArray) -> Solution:
        problem = self.problem
        if self._march is not None:
            run = self._march.run(*_NO_OUTPUTS)
            state_error(problem, run, self.plan, self.rtol)
        else:
            run = replace(self._last.only(np.zeros(self._last.t.size, bool)), continuous=None)
        if self._rest is not None or not self._over:
            # A failure concerns a later chunk if outputs before it are still waiting for their chunk.
            run.status, run.t_failed = Status.SUCCESS, None
        shown = problem.scene.shown
        span = (float(t[0]), float(t[-1])) if t.size else (problem.t_start, problem.t_start)
        record = Record(within(shown.network, *span), shown.net, t, np.zeros(t.size, bool), rows, problem.charge)
        found = solution_of(problem, self.plan, run, record, t, self.rtol, self._method)
        return replace(found, first=span[0], t_stop=span[1])


def within(network: Network, t0: float, t1: float) -> Network:
    """The network with its recordings cut to the samples needed from t0 to t1, s."""
    cut = (
        replace(e, waveform=e.waveform.part(t0, t1)) if isinstance(e.waveform, Samples) else e for e in network.sources
    )
    return replace(network, sources=tuple(cut))


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
    rtol = check_arguments(rtol, method, start)
    require(chunk is None or count is None, "count", "given beside chunk", "one of them")
    length = positive_number("chunk", CHUNK if chunk is None else chunk, "s")
    step = None if step is None else positive_number("step", step, "s")
    count = None if count is None else whole_number("count", count, 1)
    circuit = overridden(circuit, sources, parameters)
    problem = asked(circuit, t_stop=t_stop, charge_law=charge_law, area=area, start=start, charge=charge, rtol=rtol)
    check_length(problem.network.waveform, problem.t_start, problem.t_stop)
    outputs = Outputs(problem, step)
    count = min(count or max(1, round(length / outputs.spacing)), outputs.total)
    check_outputs(circuit, count)
    return Stream(problem, make_plan(problem, rtol, tier, method), outputs, count, rtol, method)
