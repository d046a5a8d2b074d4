"""Long runs chunk by chunk, in constant memory.

A run is integrated in pieces of a fixed length, whatever the chunks are: a recording on a series stack in those of
`solve.recordings`, anything else in windows of so many outputs, each a run that starts where the one before has ended.
Chunks are cut from what the pieces give, so that no bit depends on their length.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from fingerspice.base.arrays import FloatArray
from fingerspice.circuit.arguments import Parameters, Sources, overridden, require_number
from fingerspice.circuit.circuit import Circuit
from fingerspice.circuit.network import Network
from fingerspice.results.outcome import SolveError, State, Status
from fingerspice.results.plan import Plan
from fingerspice.results.record import Record
from fingerspice.results.solution import Solution
from fingerspice.solve.outputs import at_breakpoints
from fingerspice.solve.problem import Problem
from fingerspice.solve.recordings import March, Outcome, pieces_of, ready
from fingerspice.solve.runs import Run
from fingerspice.solve.simulation import (
    asked,
    check_method,
    integrated,
    own_rtol,
    planned,
    solution_of,
    state_error,
)
from fingerspice.solve.times import check_length, check_outputs
from fingerspice.waveforms.samples import Samples
from fingerspice.waveforms.sampling import on_breakpoint
from fingerspice.waveforms.waveform import require

# Outputs of a window of runs that are not followed sample by sample.
WINDOW = 1 << 14
# Length of a chunk where none is given, s.
CHUNK = 10.0

#: Where a stream stands before a piece, as plain data: with it another one goes on there, to the same bytes.
Mark = dict[str, Any]


@dataclass(frozen=True)
class Outputs:
    """Output times, evenly spaced.

    Attributes
    ----------
    start, over : float
        Time of number 0 and spacing, s; or with `rate` set the rate of a recording, Hz, from its start on.
    low, total : int
        Number of the first, and how many there are.
    stop : float
        End of the run, s.
    """

    start: float
    over: float
    rated: bool
    low: int
    total: int
    stop: float

    def times(self, i: int, j: int) -> FloatArray:
        """Times of outputs i to j - 1, s, as the arrays ``start + arange / rate`` or ``start + step * arange`` have."""
        number = np.arange(self.low + i, self.low + min(j, self.total))
        t = self.start + (number / self.over if self.rated else self.over * number)
        return np.asarray(np.minimum(t, self.stop))


def _outputs(problem: Problem, step: float | None) -> Outputs:
    """The outputs at the samples of a recording, or every `step` (s); the deck's TSTEP where there is no recording."""
    wave, first, stop = problem.waveform, max(problem.first, problem.t_start), problem.t_stop
    if step is None and isinstance(wave, Samples):
        low = math.ceil((first - wave.start) * wave.rate - 1e-6)
        total = math.floor((stop - wave.start) * wave.rate + 1e-6) - low + 1
        found = Outputs(wave.start, wave.rate, True, low, total, stop)
    else:
        step = problem.step if step is None else step
        total = math.floor((stop - first) / step * (1.0 + 1e-12) + 1e-9) + 1
        found = Outputs(first, step, False, 0, total, stop)
    require(found.total >= 1, "the run", f"one of {stop - first:g} s without any output", "a longer one")
    return found


class _Samples:
    """A recording followed sample by sample."""

    method = "relaxation"

    def __init__(self, problem: Problem, outputs: Outputs, plan: Plan, rtol: float) -> None:
        self.problem, self.outputs, self.plan, self.rtol = problem, outputs, plan, rtol
        own = own_rtol(problem, plan, rtol)
        pieces, one = pieces_of(problem), ready(problem, own)
        assert pieces is not None
        assert one is not None
        self.pieces, self.march, self.place, self.written = pieces, March(problem, one, own), 0, 0

    @staticmethod
    def serve(problem: Problem, plan: Plan, rtol: float) -> bool:
        """Whether a run can be followed so."""
        if plan.tier != "coupled" or pieces_of(problem) is None:
            return False
        return ready(problem, own_rtol(problem, plan, rtol)) is not None

    @property
    def over(self) -> bool:
        return self.place == len(self.pieces)

    def mark(self) -> Mark:
        m = self.march
        numbers = {"t": m.t, "share": m.share, "loudest": m.loudest, "u_last": m.u_last, "spacing": m.spacing}
        arrays = [x.tolist() for x in m.mark()]
        return {"written": self.written, "place": self.place, "numbers": numbers, "arrays": arrays}

    def go_to(self, mark: Mark) -> None:
        self.written, self.place = mark["written"], mark["place"]
        self.march.stand(mark["numbers"], mark["arrays"])

    def advance(self) -> tuple[FloatArray, FloatArray] | None:
        """Times (s) and rows of the next piece; None where there is no way on sample by sample."""
        piece, march, last = self.pieces[self.place], self.march, self.place + 1 == len(self.pieces)
        end = self.outputs.total if last else self._until(piece.stop)
        t = self.outputs.times(self.written, end)
        run_at = t if self.outputs.rated else at_breakpoints(_between(self.problem, piece.start, piece.stop), t)
        out = np.empty((march.width, t.size))
        march.begin_outputs()
        if march.follow(piece, piece.values(march.wave), run_at, out) is not Outcome.MET:
            return None
        if last:
            march.finish(run_at, out)
        count = march.outputs
        t, self.written, self.place = t[:count], self.written + count, self.place + 1
        return t, march.rows(run_at[:count], np.zeros(count, bool), out)

    def _until(self, t: float) -> int:
        """A number of outputs that includes all up to a time (s), and few others."""
        o = self.outputs
        number = (t - o.start) * o.over if o.rated else (t - o.start) / o.over
        return min(max(math.ceil(number) - o.low + 2, self.written), o.total)

    def run(self) -> Run:
        """How the run stands, without outputs."""
        run = self.march.run(np.empty(0), np.empty(0, bool), np.empty((0, 0)))
        if self.plan.error_bound > 0.0:
            run.add_error(self.plan.error_bound * run.gaps[:, 0])
        if self.over:
            state_error(self.problem, run, self.plan, self.rtol)
        return run


class _Windows:
    """Any run, in windows of outputs."""

    def __init__(
        self, problem: Problem, outputs: Outputs, plan: Plan, rtol: float, method: str,
    ) -> None:  # fmt: skip
        self.problem, self.outputs, self.plan, self.rtol, self.asked = problem, outputs, plan, rtol, method
        self.written, self.state, self.method = 0, problem.initial, method
        self.last: Run | None = None
        self.gaps = np.zeros((0, 4))

    @property
    def over(self) -> bool:
        return self.written == self.outputs.total or (self.last is not None and self.last.status is not Status.SUCCESS)

    def mark(self) -> Mark:
        state = {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in vars(self.state).items()}
        return {"written": self.written, "state": state, "gaps": self.gaps.tolist()}

    def go_to(self, mark: Mark) -> None:
        self.written = mark["written"]
        self.gaps = np.array(mark["gaps"], float).reshape(-1, 4)
        kept: dict[str, Any] = {k: np.array(v) if isinstance(v, list) else v for k, v in mark["state"].items()}
        self.state = State(**kept)

    def advance(self) -> tuple[FloatArray, FloatArray]:
        end = min(self.written + WINDOW, self.outputs.total)
        t, whole = self.outputs.times(self.written, end), self.problem
        stop = whole.t_stop if end == self.outputs.total else on_breakpoint(whole.waveform, float(t[-1]))
        problem = _between(whole, self.state.t, stop)
        scene = replace(whole.scene, network=within(whole.network, self.state.t, stop + whole.step))
        problem = replace(problem, scene=scene, initial=self.state)
        run_at = at_breakpoints(problem, t)
        run, self.method = integrated(problem, self.plan, run_at, np.zeros(t.size, bool), self.rtol, self.asked)
        if run.gaps.shape == self.gaps.shape:
            run.gaps = np.maximum(run.gaps, self.gaps)
        self.last, self.gaps, self.state = run, run.gaps, run.state
        self.written += run.t.size
        return t[: run.t.size], _as_shown(run.record(problem), whole)

    def run(self) -> Run:
        assert self.last is not None
        empty = np.empty(0)
        return replace(self.last, t=empty, left=np.empty(0, bool), rows=np.empty((0, 0)), continuous=None)


def _between(problem: Problem, t0: float, t1: float) -> Problem:
    """A part of a run's time, s."""
    return replace(problem, t_start=t0, t_stop=t1, first=t0)


def within(network: Network, t0: float, t1: float) -> Network:
    """A network whose recordings are those parts of them that a time (s) needs."""
    cut = [
        replace(e, waveform=e.waveform.part(t0, t1)) if isinstance(e.waveform, Samples) else e for e in network.sources
    ]
    return replace(network, sources=tuple(cut))


def _as_shown(record: Record, problem: Problem) -> FloatArray:
    """Rows as exponential steps record them, whichever method has made them (see `Scene.shown`)."""
    shown, n = problem.scene.shown.network, record.network.k.shape[0]
    if len(shown.cells) == len(record.network.cells):
        return record.rows
    place = [shown.layers.index(shown.cells[i].element) for i in shown.live]
    return np.column_stack([record.u_layer[:, place], record.rows[:, n:]])


class Stream:
    """A run chunk by chunk: an iterator of `Solution`; `fs.stream` makes it.

    Attributes
    ----------
    problem : Problem
    outputs : Outputs
        All output times.
    count : int
        Outputs of a chunk; the last one has the rest.
    done : int
        Outputs given so far.
    """

    def __init__(
        self, problem: Problem, plan: Plan, outputs: Outputs, count: int, rtol: float, method: str
    ) -> None:  # fmt: skip
        self.problem, self.plan, self.outputs, self.count, self.rtol, self.asked = (
            problem, plan, outputs, count, rtol, method,
        )  # fmt: skip
        self.done = 0
        self._source: _Samples | _Windows = (
            _Samples(problem, outputs, plan, rtol)
            if method == "auto" and _Samples.serve(problem, plan, rtol)
            else _Windows(problem, outputs, plan, rtol, method)
        )
        # What the pieces have given and no chunk has yet; and where the run stood before each of these pieces.
        self._ready: list[tuple[FloatArray, FloatArray]] = []
        self._marks: list[Mark] = []

    def __iter__(self) -> Iterator[Solution]:
        return self

    def __len__(self) -> int:
        """Number of all chunks."""
        return -(-self.outputs.total // self.count)

    def __next__(self) -> Solution:
        if self.done == self.outputs.total:
            raise StopIteration
        wanted = min(self.count, self.outputs.total - self.done)
        while sum(t.size for t, _ in self._ready) < wanted and not self._source.over:
            self._advance()
        given = self._take(wanted)
        solution = self._solution(*given)
        if solution.failure is not None:
            self.done = self.outputs.total
            raise SolveError(solution.failure, solution)
        self.done += wanted
        return solution

    def mark(self) -> Mark:
        """Where to go on for the chunk that is next, as plain data."""
        found = [m for m in [*self._marks, self._mark()] if m["written"] <= self.done]
        return found[-1]

    def go_to(self, mark: Mark, done: int) -> None:
        """Go on from a mark, where so many outputs have been given; before the first chunk only."""
        if "state" in mark and isinstance(self._source, _Samples):
            self._source = self._stepped(self._source.problem)
        self._source.go_to(mark)
        self.done = done
        while self._source.written <= done and not self._source.over:
            self._advance()
        first = self._marks[0]["written"] if self._marks else done
        self._take(done - first)

    def _mark(self) -> Mark:
        return self._source.mark()

    def _stepped(self, problem: Problem) -> _Windows:
        return _Windows(problem, self.outputs, self.plan, self.rtol, "exponential")

    def _advance(self) -> None:
        """Integrate the next piece."""
        mark = self._mark()
        found = self._source.advance()
        if found is None:
            # From here on by the steps that serve every source.
            assert isinstance(self._source, _Samples)
            self._source.go_to(mark)
            other = self._stepped(self.problem)
            other.written, other.state = mark["written"], self._source.march.state()
            self._source = other
            self._advance()
            return
        self._marks.append(mark)
        self._ready.append(found)

    def _take(self, count: int) -> tuple[FloatArray, FloatArray]:
        """The next outputs: times (s) and rows."""
        times, rows, left = [np.empty(0)], [], count
        while left > 0 and self._ready:
            t, r = self._ready[0]
            times.append(t[:left])
            rows.append(r[:left])
            if t.size <= left:
                self._ready.pop(0)
                self._marks.pop(0)
            else:
                self._ready[0] = t[left:], r[left:]
            left -= times[-1].size
        width = max(self.problem.initial.y.size, 1)
        return np.concatenate(times), np.concatenate(rows) if rows else np.empty((0, width))

    def _solution(self, t: FloatArray, rows: FloatArray) -> Solution:
        problem, run = self.problem, self._source.run()
        if self._ready:
            # What has failed since concerns a later chunk.
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

    The chunks of a run are the same to the last bit whatever their length is. Of a recording on a series stack they are
    also those of `simulate` with the same times as `t_eval`. Of other runs they are not: there each window of 16,384
    outputs is a run of its own, which starts where the one before ended.

    Parameters
    ----------
    circuit : Circuit
    chunk : float, optional
        Length of a chunk, s; 10 s by default.
    count : int, optional
        Outputs of a chunk, instead of `chunk`.
    step : float, optional
        Time between outputs, s, from TSTART on. By default outputs are at the samples of the recording that drives the
        circuit; where there is none, or several sources, TSTEP apart.
    t_stop, sources, parameters, charge_law, area, rtol, method, tier, start, charge
        As in `simulate`. A long recording is `Samples.from_wav(path, gain, at_once=False)`, or a deck's WAVEFILE.

    Returns
    -------
    Stream
        An iterator of `Solution`. At a jump of a source there is one row, the right-hand one. The stated errors of a
        chunk are the largest since the start (beyond recordings without what the state at the start of the last window
        was off), its figures those of its outputs, and its `state` is that at the end of the last piece integrated.

    Raises
    ------
    InputError
        For a request that cannot be run.
    SolveError
        While iterating, where the run fails; its `solution` holds what came after the last chunk.
    """
    check_method(method)
    for name, value in (("chunk", chunk), ("step", step)):
        if value is not None:
            require_number(name, value, "a number in s")
            require(0.0 < value < math.inf, name, f"{value:g} s", "> 0 s")
    if count is not None:
        require(isinstance(count, int) and count >= 1, "count", repr(count), "a whole number from 1 on")
        require(chunk is None, "count", "given beside chunk", "one of them")
    circuit = overridden(circuit, sources, parameters)
    problem = asked(
        circuit, t_stop=t_stop, t_eval=None, charge_law=charge_law, area=area, start=start, charge=charge, rtol=rtol
    )  # fmt: skip
    check_length(problem.waveform, problem.t_start, problem.t_stop)
    outputs = _outputs(problem, step)
    if count is None:
        spacing = 1.0 / outputs.over if outputs.rated else outputs.over
        count = max(1, round((CHUNK if chunk is None else chunk) / spacing))
    count = min(count, outputs.total)
    check_outputs(circuit, count)
    plan = planned(problem, rtol, method, tier, start if isinstance(start, str) else "given")
    return Stream(problem, plan, outputs, count, rtol, method)
