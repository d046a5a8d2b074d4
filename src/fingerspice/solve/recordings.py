"""Runs of a series stack under a recorded source, sample by sample, in pieces of fixed length; see `engine.recording`.

The error of each piece is judged at its end, independently of later pieces. Its outputs are therefore the same however
long the run is, and whether all outputs are held in one array or streamed in chunks.
"""

from __future__ import annotations

import itertools
import math
import threading
from dataclasses import dataclass, replace
from enum import Enum
from functools import partial

import numpy as np

from fingerspice.base.arrays import BoolArray, FloatArray, IntArray
from fingerspice.engine import recording, relaxation
from fingerspice.engine.blockcharge import Course, new_charges
from fingerspice.engine.blockoutput import write_end
from fingerspice.engine.relaxation import BLOCK, Form
from fingerspice.results.outcome import State, Status
from fingerspice.results.record import Record, sided
from fingerspice.results.refined import ClosedForm
from fingerspice.solve.forms import Followed, followed, form_of
from fingerspice.solve.problem import Problem
from fingerspice.solve.runs import Progress, Run, excess_of, kept_with
from fingerspice.solve.stackstate import StackState, from_stack, model_of
from fingerspice.solve.track import as_recorded, on_branch
from fingerspice.waveforms.recorded import MOST_PER_POINT, as_samples
from fingerspice.waveforms.samples import Samples

# Fewest samples for which this method pays, and the samples of a piece; pieces begin at multiples of that number.
LEAST_SAMPLES, PIECE = 64, 1 << 16
# Error allowed in a block, relative to the error asked for; ratio of stated to estimated error; attempts at a piece.
SHARE, SAFETY, ATTEMPTS = 0.2, 2.0, 4
# The error of a piece is related to the peaks up to its end, or to this share of the largest gap voltage that the
# source may cause: noise before the first loud sound need not be exact relative to itself.
LEAST_PEAK = 1e-3
# Share of the blocks' allowed error in the first and in the second attempt at the whole run: where errors decay slowly
# and add up, a later piece cannot make up for errors of the earlier ones.
BEGINNINGS = (1.0, 0.03)
# Number of forms cached with a scene, of up to 0.2 MB each: one for each tolerance, sample spacing and thread.
MOST_FORMS = 16


@dataclass(frozen=True)
class Piece:
    """A part of a run with evenly spaced samples.

    Attributes
    ----------
    start, spacing : float
        Time of the first sample and distance of the samples, s.
    first, last : int
        Numbers of the first and the last sample; both 0 for a single step between two times that are no samples.
    """

    start: float
    spacing: float
    first: int = 0
    last: int = 0

    @property
    def stop(self) -> float:
        return self.start + max(self.last - self.first, 1) * self.spacing

    def values(self, wave: Samples) -> FloatArray:
        """The source at the limits of the steps, V."""
        if self.first == self.last:
            return wave.value([self.start, self.start + self.spacing])
        return wave.between(self.first, self.last + 1)


def pieces_of(problem: Problem) -> list[Piece] | None:
    """The pieces of a run if it is a coupled stack driven by a recording of enough samples; else None."""
    if problem.scene.stack is None or not problem.scene.coupled:
        return None
    wave = as_samples(problem.waveform)
    if wave is None:
        return None
    spacing, t0, t1 = 1.0 / wave.rate, problem.t_start, problem.t_stop
    first, last = math.ceil((t0 - wave.start) * wave.rate - 1e-6), math.floor((t1 - wave.start) * wave.rate + 1e-6)
    if last - first < LEAST_SAMPLES:
        return None
    if wave is not problem.waveform and last - first > MOST_PER_POINT * problem.breakpoints().size:
        # In most of the run the source is one long line, of which the other methods need few steps.
        return None
    edges = [first, *range((first // PIECE + 1) * PIECE, last, PIECE), last]
    out = [Piece(wave.start + a * spacing, spacing, a, b) for a, b in itertools.pairwise(edges)]
    begin, end = out[0].start, wave.start + last * spacing
    if begin - t0 > 1e-6 * spacing:
        out.insert(0, Piece(t0, begin - t0))
    if t1 - end > 1e-6 * spacing:
        out.append(Piece(end, t1 - end))
    return out


class Outcome(Enum):
    """Outcome of a piece: its error is met, or not met, or this method cannot integrate it (LOST)."""

    MET, NOT_MET, LOST = range(3)


class March:
    """A run in progress, piece by piece.

    Attributes
    ----------
    t : float
        Time reached, s.
    share : float
        Factor of the error allowed in a block, reduced each time that a piece is rejected.
    loudest : float
        Largest |U| of the source so far, V.
    """

    def __init__(self, problem: Problem, one: Followed, rtol: float, share: float = 1.0) -> None:
        self.problem, self.one, self.rtol, self.share = problem, one, rtol, share
        self.t, self.loudest, self.u_last, self.spacing = problem.t_start, 0.0, 0.0, 0.0
        system, start = one.system, problem.inner
        m, drives = system.rates.shape[1], one.shown.kink.size
        r = int(np.argmin(np.abs(np.log(system.q0 / one.q_rest))))
        control, counters = np.zeros(relaxation.N_CONTROL), np.zeros(relaxation.N_COUNTERS, np.int64)
        control[relaxation.MARGIN], control[relaxation.REFERENCE], control[relaxation.U_GAP] = 1.0, r, start.u_gap
        control[relaxation.Z] = start.y[-1] - one.charge_with(start.u_gap)
        self.width = one.shown.k.size + (2 if problem.charge else 0)
        self.course = Course(
            system.model, self._form(1.0 / self.wave.rate), one.shown, relaxation.new_room(m, drives, drives + 3),
            new_charges(), np.zeros((3, max(m, drives, 3))), system.project[r] @ start.y[:-1], np.zeros(m), control,
            counters,
        )  # fmt: skip
        held = float(np.abs(problem.initial.y).max(initial=0.0))
        whole = max(problem.scene.u_peak * model_of(problem.scene).k_gap, held)
        self.least = max(held, LEAST_PEAK * whole)

    @property
    def wave(self) -> Samples:
        wave = as_samples(self.problem.waveform)
        assert wave is not None
        return wave

    def _form(self, spacing: float) -> Form:
        kept, decade = self.problem.scene.prepared, _decade(self.rtol)
        make = partial(form_of, self.one.system, self.one.area, spacing)
        form: Form = kept_with(kept, ("form", decade, spacing, threading.get_ident()), MOST_FORMS, make)
        return form

    def follow(self, piece: Piece, values: FloatArray, t_out: FloatArray, out: FloatArray) -> Outcome:
        """Integrate a piece with the source's `values` (V), and write the outputs before its end as rows of `out`."""
        one, control, k_gap = self.one, self.course.control, self.one.system.model.k_gap
        if piece.spacing != self.spacing:
            # The source may jump where the spacing changes, and does so at the start of the run.
            self.course, self.spacing = self.course._replace(form=self._form(piece.spacing)), piece.spacing
            if not recording.jump(self.course, float(values[0])):
                return Outcome.LOST
        self.loudest = max(self.loudest, float(values.max()), -float(values.min()))
        scale = max(self.loudest * k_gap, self.least)
        before = self.mark()
        for _ in range(ATTEMPTS):
            tol = self.share * SHARE * self.rtol * scale
            code = recording.march(
                self.course, values, 0, values.size - 1, piece.start, piece.spacing, tol, t_out, out
            )  # fmt: skip
            if code != recording.DONE or control[relaxation.PEAK_U] > one.system.u_top:
                return Outcome.LOST
            gaps, _, _ = self.stated()
            gaps[0, 0], gaps[0, 1] = max(gaps[0, 0], self.least), max(gaps[0, 1], self._force(self.least))
            excess = excess_of(gaps, self.problem.largest) / self.rtol
            if excess <= 1.0:
                self.t, self.u_last = piece.stop, float(values[-1])
                return Outcome.MET
            refused = self.course.counters[relaxation.REFUSED]
            self.recall(before)
            self.course.counters[relaxation.REFUSED] = refused
            self.share *= min(0.3, 0.5 / excess)
        return Outcome.NOT_MET

    def _force(self, u_gap: float) -> float:
        """Force (N) at a gap voltage (V), with the area at 0 V."""
        return self.one.shown.stress * u_gap**2 / self.one.q_rest

    def _parts(self) -> tuple[FloatArray | IntArray, ...]:
        c = self.course
        return c.w, c.error, c.control, c.counters

    def mark(self) -> list[FloatArray | IntArray]:
        """A copy of the state of the integration, which `recall` restores."""
        return [x.copy() for x in self._parts()]

    def recall(self, mark: list[FloatArray | IntArray]) -> None:
        for x, kept in zip(self._parts(), mark, strict=True):
            x[:] = kept

    def stand(self, numbers: dict[str, float], arrays: list[list[float]]) -> None:
        """Restore the state of another march through the same run, from its attributes and its `mark`."""
        for name, value in numbers.items():
            setattr(self, name, value)
        self.recall([np.array(x) for x in arrays])
        self.course = self.course._replace(form=self._form(self.spacing or 1.0 / self.wave.rate))

    @property
    def outputs(self) -> int:
        """Number of outputs written since `begin_outputs`."""
        return int(self.course.counters[relaxation.OUTPUT])

    def begin_outputs(self) -> None:
        """Start counting outputs from 0, for a new array of outputs."""
        self.course.counters[relaxation.OUTPUT] = 0

    def finish(self, t_out: FloatArray, out: FloatArray) -> None:
        """Write the outputs at the end of the run."""
        stop, after = self.problem.t_stop, 1e-3 / self.wave.rate
        here, later = self.wave.value([stop, stop + after]).tolist()
        write_end(self.course, self.u_last, (later - here) / after, t_out, out)

    def rows(self, t: FloatArray, left: BoolArray, out: FloatArray) -> FloatArray:
        """Outputs at times `t` (s) as rows of a record."""
        model = self.one.system.model
        u = sided(self.wave, t, left) if self.problem.charge and model.mobile else np.empty(0)
        return as_recorded(self.problem, model, out[:, : t.size].T, u)

    def state(self) -> State:
        """The state reached."""
        control, system, offset = self.course.control, self.one.system, self.problem.inner.offset
        u_gap = float(control[relaxation.U_GAP])
        live = system.live[int(control[relaxation.REFERENCE])] @ self.course.w
        y = np.append(live, control[relaxation.Z] + self.one.charge_with(u_gap))
        state = StackState(self.t, y, self.u_last, u_gap, offset)
        return from_stack(self.problem.scene, on_branch(system.model, state, math.copysign(1.0, u_gap)))

    def stated(self) -> tuple[FloatArray, float, float | None]:
        """Peaks and stated errors as in `Run.gaps`, and stated errors of the nodes (V) and the charge (C), so far."""
        control, model, u_peak = self.course.control, self.one.system.model, self.problem.scene.u_peak
        peak_u, peak_f = float(control[relaxation.PEAK_U]), float(control[relaxation.PEAK_F])
        # Round-off adds to the errors estimated in the blocks.
        floor = 4e-16 * (peak_u + model.k_gap * u_peak)
        u_error = SAFETY * float(control[relaxation.ERROR_U]) + floor
        f_error = SAFETY * float(control[relaxation.ERROR_F]) + 2.0 * floor / (peak_u or 1.0) * peak_f
        node_error = SAFETY * float(control[relaxation.ERROR_V]) + 4e-16 * (peak_u + u_peak)
        if not self.problem.charge:
            return np.array([[peak_u, peak_f, u_error, f_error]]), node_error, None
        held = float(model.slow[-3]) * model.area0 * (u_peak + peak_u)
        rounding = 4e-16 * held * (1.0 + int(self.course.counters[relaxation.STEPS]))
        charge_error = SAFETY * float(control[relaxation.ERROR_Q]) + rounding
        return np.array([[peak_u, peak_f, u_error, f_error]]), node_error, charge_error

    def run(self, t: FloatArray, left: BoolArray, rows: FloatArray) -> Run:
        """The run so far, with the given outputs."""
        counters = self.course.counters
        stats = {"steps": int(counters[relaxation.STEPS]), "rejected": int(counters[relaxation.REFUSED]), "zeros": 0}
        evaluated = 2 * BLOCK * int(counters[relaxation.SWEEPS])
        run = Run(t, left, rows, Status.SUCCESS, evaluated, stats, self.state())
        run.gaps, run.node_error, run.charge_error = self.stated()
        run.margin, run.by_layer = float(self.course.control[relaxation.MARGIN]), True
        return run


def _decade(rtol: float) -> float:
    return float(10.0 ** np.floor(np.log10(rtol)))


def ready(problem: Problem, rtol: float) -> Followed | None:
    """The scene prepared for this method, cached by decade; None where no polynomial represents 1/A well enough."""
    decade, kept = _decade(rtol), problem.scene.prepared
    key = ("followed", decade, problem.charge, threading.get_ident())
    one: Followed | None = kept_with(kept, key, MOST_FORMS, lambda: followed(problem, decade))
    return one


def solve(problem: Problem, rtol: float, t_out: FloatArray, left: BoolArray, progress: Progress | None) -> Run | None:
    """A run sample by sample; None where this method does not apply (no recording) or does not meet the error."""
    pieces = pieces_of(problem)
    one = None if pieces is None else ready(problem, rtol)
    if pieces is None or one is None:
        return None
    refused = 0
    for share in BEGINNINGS:
        march = March(problem, one, rtol, share)
        out = np.empty((march.width, t_out.size))
        outcome = _through(march, pieces, t_out, out, progress)
        if outcome is Outcome.LOST:
            return None
        if outcome is Outcome.MET:
            march.finish(t_out, out)
            run = march.run(t_out, left, march.rows(t_out, left, out))
            run.stats["rejected"] += refused
            if run.excess(problem.largest) > rtol:
                # The peaks of the run stayed below LEAST_PEAK of the expected one, to which the pieces' errors related.
                continue
            look = partial(_look, replace(problem, charge=False), rtol)
            run.continuous = ClosedForm(
                look, problem.waveform, problem.t_start, problem.first, problem.t_stop, rtol
            )  # fmt: skip
            return run
        refused += int(march.course.counters[relaxation.REFUSED])
    return None


def _through(
    march: March, pieces: list[Piece], t_out: FloatArray, out: FloatArray, progress: Progress | None
) -> Outcome:  # fmt: skip
    """Integrate all pieces, up to the first that is not MET."""
    problem = march.problem
    for piece in pieces:
        outcome = march.follow(piece, piece.values(march.wave), t_out, out)
        if outcome is not Outcome.MET:
            return outcome
        if progress is not None:
            progress((march.t - problem.t_start) / (problem.t_stop - problem.t_start))
    return Outcome.MET


def _look(problem: Problem, rtol: float, t: FloatArray, left: BoolArray) -> Record:
    """A record of the same run at other output times."""
    run = solve(problem, rtol, t, left, None)
    assert run is not None
    return run.record(problem)
