"""Runs under a recorded source, sample by sample, in pieces of fixed length.

The error of each piece is judged at its end, independently of later pieces. Its outputs are therefore the same however
long the run is, and whether all outputs are held in one array or streamed in chunks.
"""

from __future__ import annotations

import threading
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from fingerspice.base.arrays import BoolArray, FloatArray
from fingerspice.results.record import Record
from fingerspice.solve.laneform import LaneForm, rounded_peak, stack
from fingerspice.solve.lanes import LaneMarch, Outcome
from fingerspice.solve.netforms import finger
from fingerspice.solve.pieces import Piece, pieces_of
from fingerspice.solve.problem import Problem
from fingerspice.solve.runs import Progress, Run, closed_form, kept_with

# Share of the blocks' allowed error in the first and in the second attempt at the whole run: where errors decay slowly
# and add up, a later piece cannot make up for errors of the earlier ones.
BEGINNINGS = (1.0, 0.03)
# Number of forms cached with a scene or a stack, of up to 0.2 MB each: one for each tolerance, peak and thread.
MOST_FORMS = 16


def _decade(rtol: float) -> float:
    return float(10.0 ** np.floor(np.log10(rtol)))


def ready(problem: Problem, rtol: float) -> LaneForm | None:
    """The scene prepared for this method, cached by decade; None where it does not apply."""
    kept, *key = _kept(problem, rtol)
    make = finger if problem.scene.stack is None else stack
    one: LaneForm | None = kept_with(kept, ("followed", *key), MOST_FORMS, partial(make, problem, _decade(rtol)))
    return one


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
        march = LaneMarch(problem, one, rtol, share)
        out = np.empty((march.width, t_out.size))
        outcome = _through(march, pieces, t_out, out, progress)
        if outcome is Outcome.LOST:
            return None
        if outcome is Outcome.MET:
            march.finish(t_out, out)
            run = march.run(t_out, left, march.rows(t_out.size, out))
            run.stats["rejected"] += refused
            if run.excess(problem.rounding) > rtol:
                # The peaks of the run stayed below LEAST_PEAK of the expected one, to which the pieces' errors related.
                continue
            look = partial(_look, replace(problem, charge=False), rtol)
            run.continuous = closed_form(problem, look, rtol)
            return run
        refused += march.refused
    return None


def _through(
    march: LaneMarch, pieces: list[Piece], t_out: FloatArray, out: FloatArray, progress: Progress | None
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
