"""Runs under a recorded source, sample by sample, in pieces of fixed length.

One finger under `local` goes in lanes (`solve.lanes`), stacks under `mobile` go block by block (`engine.recording`).

The error of each piece is judged at its end, independently of later pieces. Its outputs are therefore the same however
long the run is, and whether all outputs are held in one array or streamed in chunks.
"""

from __future__ import annotations

import threading
from collections.abc import Iterable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from fingerspice.base.arrays import BoolArray, FloatArray, IntArray, read_only
from fingerspice.engine import blockforms, recording
from fingerspice.engine.blockforms import BLOCK, Form
from fingerspice.engine.blockpoints import write_end
from fingerspice.results.outcome import State
from fingerspice.results.record import Record
from fingerspice.solve.following import Following, Outcome
from fingerspice.solve.forms import Followed, followed
from fingerspice.solve.laneform import LaneForm, rounded_peak, stack
from fingerspice.solve.lanes import LaneMarch
from fingerspice.solve.netforms import finger
from fingerspice.solve.pieces import Piece, pieces_of
from fingerspice.solve.problem import Problem
from fingerspice.solve.runs import Progress, Run, closed_form, excess_of, kept_with

# Error allowed in a block, relative to the error asked for; ratio of stated to estimated error; attempts at a piece.
SHARE, SAFETY, ATTEMPTS = 0.28, 1.75, 4
# Share of the error asked for that another attempt at a piece is to have.
ENOUGH = 0.85
# Share of the blocks' allowed error in the first and in the second attempt at the whole run: where errors decay slowly
# and add up, a later piece cannot make up for errors of the earlier ones.
BEGINNINGS = (1.0, 0.03)
# Number of forms cached with a scene or a stack, of up to 0.2 MB each: one for each tolerance, sample spacing, peak and
# thread.
MOST_FORMS = 16


class March(Following):
    """A recording of a stack under `mobile` in progress."""

    def __init__(self, problem: Problem, one: Followed, rtol: float, share: float = 1.0) -> None:
        super().__init__(problem, rtol, share, one.system.model.k_gap, one.width)
        self.one, self.spacing = one, 0.0
        self.course = one.course(problem, self._form(self.usual))

    def _form(self, spacing: float) -> Form:
        kept, *key = _kept(self.problem, self.rtol)
        form: Form = kept_with(kept, ("form", spacing, *key), MOST_FORMS, partial(self.one.form, spacing))
        return form

    def follow(self, piece: Piece, values: FloatArray, t_out: FloatArray, out: FloatArray) -> Outcome:
        """Integrate a piece with the source's `values` (V), and write the outputs before its end as rows of `out`."""
        one, control, t_out = self.one, self.course.control, read_only(t_out)
        if piece.spacing != self.spacing:
            # The source may jump where the spacing changes, and does so at the start of the run.
            self.course, self.spacing = self.course._replace(form=self._form(piece.spacing)), piece.spacing
            self.course.checks[:] = blockforms.new_checks()
            if not recording.jump(self.course, float(values[0])):
                return Outcome.LOST
        self.heard(values)
        before = [x.copy() for x in self._parts()]
        for _ in range(ATTEMPTS):
            tol = self.share * SHARE * self.rtol * self.scale
            code = recording.march(
                self.course, values, 0, values.size - 1, piece.start, piece.spacing, tol, t_out, out
            )  # fmt: skip
            if code != recording.DONE or control[blockforms.PEAK_U] > one.system.u_top:
                return Outcome.LOST
            gaps, _, _ = self.stated()
            gaps[0, 0], gaps[0, 1] = max(gaps[0, 0], self.least), max(gaps[0, 1], self._force(self.least))
            excess = excess_of(gaps, self.problem.rounding) / self.rtol
            if excess <= 1.0:
                self.t, self.u_last = piece.stop, float(values[-1])
                return Outcome.MET
            refused = self.course.counters[blockforms.REFUSED]
            self._recall(before)
            self.course.counters[blockforms.REFUSED] = refused
            self.share *= ENOUGH / excess
        return Outcome.NOT_MET

    def _force(self, u_gap: float) -> float:
        """Force (N) at a gap voltage (V), with the area at 0 V."""
        return self.one.shown.stress * u_gap**2 / self.one.q_rest

    def _parts(self) -> tuple[FloatArray | IntArray, ...]:
        c = self.course
        return c.w, c.error, c.control, c.counters, c.checks

    def _recall(self, parts: Iterable[FloatArray | IntArray]) -> None:
        for x, kept in zip(self._parts(), parts, strict=True):
            x[:] = kept

    def mark(self) -> dict[str, Any]:
        names = ("t", "share", "loudest", "u_last", "spacing")
        return {name: getattr(self, name) for name in names} | {"parts": [x.tolist() for x in self._parts()]}

    def stand(self, mark: dict[str, Any]) -> None:
        self._recall([np.array(x) for x in mark["parts"]])
        for name in mark.keys() - {"parts"}:
            setattr(self, name, mark[name])
        self.course = self.course._replace(form=self._form(self.spacing or self.usual))

    @property
    def outputs(self) -> int:
        return int(self.course.counters[blockforms.OUTPUT])

    @outputs.setter
    def outputs(self, count: int) -> None:
        self.course.counters[blockforms.OUTPUT] = count

    def finish(self, t_out: FloatArray, out: FloatArray) -> None:
        write_end(self.course, self.u_last, self.slope_after, read_only(t_out), out)

    def rows(self, t: FloatArray, left: BoolArray, out: FloatArray) -> FloatArray:
        return self.one.rows(self.problem, t, left, out)

    def state(self) -> State:
        return self.one.state(self.problem, self.course, self.t, self.u_last)

    def stated(self) -> tuple[FloatArray, float, float | None]:
        control, u_peak = self.course.control, self.problem.scene.u_peak
        peak_u, peak_f = float(control[blockforms.PEAK_U]), float(control[blockforms.PEAK_F])
        # Round-off adds to the errors estimated in the blocks.
        missed = self.one.missed
        floor = 4e-16 * (peak_u + self.gain * max(u_peak, self.loudest)) + missed * peak_u
        u_error = SAFETY * float(control[blockforms.ERROR_U]) + floor
        f_error = SAFETY * float(control[blockforms.ERROR_F])
        f_error += (2.0 * floor / (peak_u or 1.0) + missed) * peak_f
        node_error = SAFETY * float(control[blockforms.ERROR_V]) + 4e-16 * (peak_u + u_peak) + missed * peak_u
        charge_error = None
        if self.problem.charge:
            charge_error = SAFETY * float(control[blockforms.ERROR_Q])
            charge_error += self.one.charge_error(self.problem, self.course, peak_u)
        return np.array([[peak_u, peak_f, u_error, f_error]]), node_error, charge_error

    @property
    def stats(self) -> tuple[int, int, int]:
        steps, refused, sweeps = self.course.counters[blockforms.STEPS :].tolist()
        return steps, refused, 2 * BLOCK * sweeps

    @property
    def margin(self) -> float:
        return float(self.course.control[blockforms.MARGIN])


def _decade(rtol: float) -> float:
    return float(10.0 ** np.floor(np.log10(rtol)))


def ready(problem: Problem, rtol: float) -> LaneForm | Followed | None:
    """The scene prepared for this method, cached by decade; None where it does not apply."""
    kept, *key = _kept(problem, rtol)
    make = finger if problem.scene.stack is None else followed if problem.scene.net.mobile else stack
    one: LaneForm | Followed | None = kept_with(
        kept, ("followed", *key), MOST_FORMS, partial(make, problem, _decade(rtol))
    )
    return one


def march_of(problem: Problem, one: LaneForm | Followed, rtol: float, share: float = 1.0) -> Following:
    """A run that begins, with the scene as `ready` has prepared it."""
    return LaneMarch(problem, one, rtol, share) if isinstance(one, LaneForm) else March(problem, one, rtol, share)


def _kept(problem: Problem, rtol: float) -> tuple[Any, ...]:
    """Where preparations for a problem are cached, and the key; a stack's hold for all sources of about its peak."""
    scene = problem.scene
    key = _decade(rtol), problem.charge, threading.get_ident()
    if scene.stack is None:
        return scene.prepared, *key
    return scene.stack.kept, scene.charge_law, rounded_peak(scene.u_peak), *key


def solve(problem: Problem, rtol: float, t_out: FloatArray, left: BoolArray, progress: Progress | None) -> Run | None:
    """A run sample by sample; None where this method does not apply (no recording) or does not meet the error."""
    pieces = pieces_of(problem)
    one = None if pieces is None else ready(problem, rtol)
    if pieces is None or one is None:
        return None
    refused = 0
    for share in BEGINNINGS:
        march = march_of(problem, one, rtol, share)
        out = np.empty((march.width, t_out.size))
        outcome = _through(march, pieces, t_out, out, progress)
        if outcome is Outcome.LOST:
            return None
        if outcome is Outcome.MET:
            march.finish(t_out, out)
            run = march.run(t_out, left, march.rows(t_out, left, out))
            run.stats["rejected"] += refused
            if run.excess(problem.rounding) > rtol:
                # The peaks of the run stayed below LEAST_PEAK of the expected one, to which the pieces' errors related.
                continue
            look = partial(_look, replace(problem, charge=False), rtol)
            run.continuous = closed_form(problem, look, rtol)
            return run
        refused += march.stats[1]
    return None


def _through(
    march: Following, pieces: list[Piece], t_out: FloatArray, out: FloatArray, progress: Progress | None
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
