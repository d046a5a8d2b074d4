"""Runs under a recorded source, sample by sample, in pieces of fixed length.

The error of each piece is judged at its end, independently of later pieces. Its outputs are therefore the same however
long the run is, and whether all outputs are held in one array or streamed in chunks.
"""

from __future__ import annotations

import math
import threading
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from fingerspice.base.arrays import FloatArray
from fingerspice.circuit.network import Network
from fingerspice.results.outcome import Plan, State, Status
from fingerspice.results.record import Record
from fingerspice.solve.problem import Problem, at_breakpoints
from fingerspice.solve.recordings.form import LaneForm, rounded_peak, stack
from fingerspice.solve.recordings.march import LaneMarch, Outcome
from fingerspice.solve.recordings.networks import finger
from fingerspice.solve.recordings.pieces import Piece, pieces_of
from fingerspice.solve.runs import Progress, Run, closed_form
from fingerspice.solve.scenes import kept_with
from fingerspice.solve.simulation import integrated, own_rtol, state_error
from fingerspice.waveforms.samples import Samples
from fingerspice.waveforms.sampling import on_breakpoint
from fingerspice.waveforms.waveform import require

# Share of the blocks' allowed error in the first and in the second attempt at the whole run: where errors decay slowly
# and add up, a later piece cannot make up for errors of the earlier ones.
BEGINNINGS = (1.0, 0.03)
# Number of forms cached with a scene or a stack, of up to 0.2 MB each: one for each tolerance, peak and thread.
MOST_FORMS = 16


def ready(problem: Problem, rtol: float) -> LaneForm | None:
    """The scene prepared for this method and a decade of errors; None where it does not apply.

    It is cached with the scene, or with a stack for all sources of about its peak.
    """
    scene, decade = problem.scene, float(10.0 ** np.floor(np.log10(rtol)))
    key: tuple[Any, ...] = "followed", decade, problem.charge, threading.get_ident()
    if scene.stack is not None:
        key = *key, scene.charge_law, rounded_peak(scene.u_peak)
    kept, make = (scene.prepared, finger) if scene.stack is None else (scene.stack.kept, stack)
    one: LaneForm | None = kept_with(kept, key, MOST_FORMS, partial(make, problem, decade))
    return one


def _prepared(problem: Problem, rtol: float) -> tuple[list[Piece], LaneForm] | None:
    """The pieces of a run and the scene prepared for them; None where this method does not apply."""
    pieces = pieces_of(problem)
    one = None if pieces is None else ready(problem, rtol)
    return None if pieces is None or one is None else (pieces, one)


def solve(problem: Problem, rtol: float, progress: Progress | None = None) -> Run | None:
    """A run sample by sample; None where this method does not apply (no recording) or does not meet the error."""
    found = _prepared(problem, rtol)
    if found is None:
        return None
    pieces, one = found
    refused, t_out, left = 0, problem.t_out, problem.left
    for share in BEGINNINGS:
        march = LaneMarch(problem, one, rtol, share)
        out = march.outputs_at(t_out)
        for piece in pieces:
            outcome = march.follow(piece, t_out, out)
            if outcome is not Outcome.MET:
                break
            if progress is not None:
                progress((march.t - problem.t_start) / (problem.t_stop - problem.t_start))
        if outcome is Outcome.LOST:
            return None
        if outcome is Outcome.NOT_MET:
            refused += march.refused
            continue
        march.finish(t_out, out)
        run = march.run(t_out, left, one.recorded(problem, out))
        run.stats["rejected"] += refused
        # Else the peaks stayed below LEAST_PEAK of the expected one, to which the pieces' errors related.
        if run.excess(problem.rounding) <= rtol:
            run.continuous = closed_form(replace(problem, charge=False), partial(_again, rtol=rtol), rtol)
            return run
    return None


def _again(problem: Problem, rtol: float) -> Run:
    """The same run with other outputs."""
    run = solve(problem, rtol)
    assert run is not None
    return run


# Number of outputs in a window of a run that is not integrated sample by sample.
WINDOW = 1 << 14

#: State of a stream before a piece, as plain data: another stream continues from it with the same bytes.
Mark = dict[str, Any]


@dataclass(frozen=True)
class Outputs:
    """Output times, evenly spaced."""

    # start, over: Time of output number 0, s, and spacing, s; if `rated`, `over` is the rate of a recording, Hz
    start: float
    over: float
    rated: bool  # Whether the outputs are at the samples of a recording
    # low, total: Number of the first output, and how many outputs there are
    low: int
    total: int
    stop: float  # End of the run, s

    def times(self, i: int, j: int) -> FloatArray:
        """Times of outputs i to j - 1, s, rounded as ``start + arange / rate`` or ``start + step * arange`` are."""
        number = np.arange(self.low + i, self.low + min(j, self.total))
        t = self.start + (number / self.over if self.rated else self.over * number)
        return np.asarray(np.minimum(t, self.stop))


def outputs_of(problem: Problem, step: float | None) -> Outputs:
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


class BySamples:
    """A recording integrated sample by sample, in the pieces of `solve.recordings.run`."""

    method = "relaxation"

    def __init__(
        self, problem: Problem, outputs: Outputs, plan: Plan, rtol: float, pieces: list[Piece], march: LaneMarch
    ) -> None:
        self.problem, self.outputs, self.plan, self.rtol = problem, outputs, plan, rtol
        self.pieces, self.march, self.place, self.written = pieces, march, 0, 0

    @staticmethod
    def of(problem: Problem, outputs: Outputs, plan: Plan, rtol: float) -> BySamples | None:
        """A run that can be integrated this way, or None."""
        own = own_rtol(problem, plan, rtol)
        found = _prepared(problem, own) if plan.tier == "coupled" else None
        return found and BySamples(problem, outputs, plan, rtol, found[0], LaneMarch(problem, found[1], own))

    @property
    def over(self) -> bool:
        return self.place == len(self.pieces)

    def mark(self) -> Mark:
        return {"written": self.written, "place": self.place, "march": self.march.mark()}

    def go_to(self, mark: Mark) -> None:
        self.written, self.place = mark["written"], mark["place"]
        self.march.stand(mark["march"])

    def advance(self) -> tuple[FloatArray, FloatArray] | None:
        """Times (s) and rows of the next piece; None where the method for recordings fails on it."""
        piece, march, o, last = self.pieces[self.place], self.march, self.outputs, self.place + 1 == len(self.pieces)
        # All outputs up to the end of the piece, and a few more.
        number = (piece.stop - o.start) * o.over if o.rated else (piece.stop - o.start) / o.over
        end = o.total if last else min(max(math.ceil(number) - o.low + 2, self.written), o.total)
        t = o.times(self.written, end)
        run_at = t if o.rated else at_breakpoints(_between(self.problem, piece.start, piece.stop), t)
        out = march.outputs_at(run_at)
        if march.follow(piece, run_at, out) is not Outcome.MET:
            return None
        if last:
            march.finish(run_at, out)
        count = march.outputs
        self.written, self.place = self.written + count, self.place + 1
        return t[:count], march.form.recorded(self.problem, out[:, :count])

    def run(self) -> Run:
        """The run so far, without outputs."""
        run = self.march.run(np.empty(0), np.empty(0, bool), np.empty((0, 0)))
        if self.plan.error_bound > 0.0:
            run.add_error(self.plan.error_bound * run.gaps[:, 0])
        if self.over:
            state_error(self.problem, run, self.plan, self.rtol)
        return run


class ByWindows:
    """Any run, in windows of a fixed number of outputs."""

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
        problem = problem.at(at_breakpoints(problem, t), np.zeros(t.size, bool))
        run, self.method = integrated(problem, self.plan, self.rtol, self.asked)
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
    """The problem restricted to the times from t0 to t1, s."""
    return replace(problem, t_start=t0, t_stop=t1, first=t0)


def within(network: Network, t0: float, t1: float) -> Network:
    """The network with its recordings cut to the samples needed from t0 to t1, s."""
    cut = [
        replace(e, waveform=e.waveform.part(t0, t1)) if isinstance(e.waveform, Samples) else e for e in network.sources
    ]
    return replace(network, sources=tuple(cut))


def _as_shown(record: Record, problem: Problem) -> FloatArray:
    """Rows in the form of exponential steps (see `Scene.shown`), whichever method has computed them."""
    shown, n = problem.scene.shown.network, record.network.k.shape[0]
    if len(shown.cells) == len(record.network.cells):
        return record.rows
    place = [shown.layers.index(shown.cells[i].element) for i in shown.live]
    return np.column_stack([record.u_layer[:, place], record.rows[:, n:]])
