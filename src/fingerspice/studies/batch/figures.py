"""Figures and gap voltages of scenes in lockstep, with their errors."""

from __future__ import annotations

import numpy as np

from fingerspice.base.arrays import BoolArray, FloatArray, IntArray
from fingerspice.engine.lockstep.step import ALL_MOMENTS
from fingerspice.studies.batch.form import FIGURES
from fingerspice.studies.batch.ladder import Ladder, Level, Run

# The relative round-off added to every stated error.
_ROUNDING = 1e-11
# The error is estimated as this share of the change from half the steps to all steps, by the smallest rtol served. The
# order is 4, which would give a fifteenth. But the kink of 1/A where the gap voltage is 0 has order 2, with a factor
# that depends on where between two steps it falls: that is most of a small error. Pieces of 4 and of 8 steps are still
# far from the order.
_STATED, _STATED_JUMPING = ((5e-6, 0.25), (5e-7, 0.5), (0.0, 0.8)), 0.5
# Where a step is longer than this many of the fastest time constants, the start of a run from rest is not resolved, and
# the change is no larger than the error; it is smaller where that start is most of the error.
_STIFF, _STATED_STIFF = 2.0, ((5e-6, 0.8), (0.0, 2.5))
# A gap voltage shows the kinks at its zeros more than means do.
_STATED_TRACED = 0.8
# Under a recording the order is 3, which would give a seventh, and 2 for what the zeros of the gap voltage leave; but
# 1, which gives 1, for a dispersive skin, some of whose modes decay from each sample on within a part of a step.
_STATED_RECORDED, _STATED_DISPERSIVE = 0.5, 1.0
# What decays after a start away from 0 V meets steps of several lengths, whose errors may cancel with half the steps.
_STATED_STARTED = 2.0


class Figures(Ladder):
    """The outputs that a batch is asked for."""

    most_gain = 24.0
    named = ""
    unmet = "what does not end after half periods or at a sample, or does not meet its error in lockstep"

    def prepare(self) -> None:
        """Find the rows of the moments that the figures need."""
        self.names = [name for name in self.task.outputs if name != "u_gap"]
        self.needed = sorted({i for name in self.names for i in FIGURES[name.removesuffix("_periodic")][0]} or {0})
        self.n_moment = ALL_MOMENTS if self.needed[-1] else 1

    def enter(self, level: Level, run: Run, pending: IntArray, good: BoolArray) -> None:
        """Of the moments, those of the last period are the second ones."""
        at = pending[good]
        for name in self.names:
            first = self.n_moment if name.endswith("_periodic") or self.task.periodic else 0
            moments = run.fine[first : first + self.n_moment, good]
            self.found.values[name][self.members[at]] = self.figure(name, moments, at)
        if self.task.traced:
            u, some = self.found.values["u_gap"], run.trace[good, :: level.steps // self.task.points]
            u[self.members[at], : some.shape[1]] = some
            u[self.members[at], some.shape[1] :] = np.nan

    def error(self, level: Level, run: Run, pending: IntArray) -> FloatArray:
        """The largest of all outputs, relative to themselves."""
        peak, closing, tail = run.fine[-3:]
        changes = [np.zeros(peak.size)]
        for row in self.needed:
            size, change = np.abs(run.fine[row]), np.abs(run.fine[row] - run.coarse[row])
            later = row + self.n_moment
            if self.form.recording is not None:
                # Each zero of the gap voltage adds an error as if by chance, so that the sum of all may be small by
                # chance with half the steps, and not with all of them. The root of the sum of their squares is not.
                portions = slice(later, -3, self.n_moment)
                change = np.maximum(change, np.linalg.norm(run.fine[portions] - run.coarse[portions], axis=0))
            elif level.halves > 1:
                last = np.abs(run.fine[later])
                changes.append(np.abs(run.fine[later] - run.coarse[later]) / np.where(last > 0.0, last, 1.0))
            changes.append(change / np.where(size > 0.0, size, 1.0))
        if self.task.traced:
            off = np.abs(run.trace[:, : 2 * run.trace_coarse.shape[1] : 2] - run.trace_coarse).max(axis=1)
            changes.append(off / np.where(peak > 0.0, peak, 1.0))
        # The area's polynomial of the run with half the steps may be another one.
        change = np.max(changes, axis=0) + run.coarse[-1]
        share = self._share(level, self.decays[pending], self.least[pending])
        return np.asarray(share * change + tail + 2.0 * closing + _ROUNDING)

    def _share(self, level: Level, decays: FloatArray, least: FloatArray) -> FloatArray | float:
        """The error as a share of the change."""
        if self.form.recording is not None:
            stack = self.form.stack
            return _STATED_RECORDED if self.form.cells == len(stack.layers) else _STATED_DISPERSIVE
        if self.form.jumping:
            return _STATED_JUMPING
        own, stiff = (next(s for rtol, s in shares if self.task.rtol >= rtol) for shares in (_STATED, _STATED_STIFF))
        own = _STATED_TRACED if self.task.traced else own
        share = np.where(2.0 * decays > _STIFF * level.steps, max(own, stiff), own)
        # A start away from 0 V asks for more steps than there are decays in a half period, any other for fewer.
        return np.where(least > decays, _STATED_STARTED, share)
