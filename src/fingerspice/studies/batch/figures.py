"""What is wanted of scenes in lockstep, with its error: figures and gap voltages, or derivatives of means."""

from __future__ import annotations

import numpy as np

from fingerspice.base.arrays import BoolArray, FloatArray, IntArray
from fingerspice.engine.lockstep.step import ALL_MOMENTS
from fingerspice.numerics.small import STEP
from fingerspice.studies.batch.form import FIGURES, table_of
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
# A run of degree d has this rounding error, relative, besides 2^d times 1e-16: the area's polynomial's coefficients
# lose a digit in two to the rounding with every power.
_ROUNDING_OF_SLOPES, _EPS = 1e-13, 1.1e-16
# The stated error of a derivative has this many changes from half the steps to all steps, under tones and under
# squares. Under tones a kink's error is about as large as the change, or larger where that is small by chance.
_STATED_SLOPES, _STATED_SLOPES_JUMPING = 3.0, 2.0


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


class Slopes(Ladder):
    """Derivatives by the parameters asked for: central differences of runs with the very same steps.

    Copies of a scene have one of the parameters smaller, then larger, by a step. The steps do not depend on a
    parameter: a difference has the error of the method and hardly any noise. The tangents of the same steps would have
    this error, too: it comes from the kink of 1/A where the gap voltage is 0, which has order 1 in a derivative.
    """

    limit = 10.0  # For a change of the parameter by all of itself
    stated = 1.0
    # What ends the search for a periodic state moves a difference by 1 / STEP of itself.
    closer = STEP
    # Kinks have order 1, with a factor that depends on where between two steps they fall.
    most_gain = 8.0
    highest_degree = 16
    gives_up = False
    named = "gradients: "
    unmet = "what does not end after half periods, or does not meet its error in lockstep"

    def prepare(self) -> None:
        """Make the copies of the scenes."""
        assert self.task.gradients is not None
        self.wanted = self.task.gradients
        self.given = np.array([self.scenes[path.lower()] for path in self.wanted.paths])  # (n_parameter, n)
        self.possible &= (np.isfinite(self.given) & (self.given != 0.0)).all(axis=0)
        self.copies = 2 * len(self.wanted.paths)
        moved = {path: np.tile(array, (2, len(self.wanted.paths), 1)) for path, array in self.scenes.items()}
        for k, path in enumerate(self.wanted.paths):
            for other in self.wanted.together[path]:
                for side, sign in enumerate((-1.0, 1.0)):
                    moved[other.lower()][side, k] *= 1.0 + sign * STEP
        self.scenes = {path: array.ravel() for path, array in moved.items()}
        self.table = table_of(self.form, self.scenes)

    def enter(self, level: Level, run: Run, pending: IntArray, good: BoolArray) -> None:
        """Per unit of the parameter."""
        at = pending[good]
        change, _ = self._changes(run.fine[0], pending)
        for j, name in enumerate(self.task.outputs):
            self.found.values[name][self.members[at]] = (change[j][:, good] / self.given[:, at]).T

    def error(self, level: Level, run: Run, pending: IntArray) -> FloatArray:
        """For a change of a parameter by all of itself, relative to the output; the largest of all."""
        (_, own), (_, coarse) = (self._changes(each[0], pending) for each in (run.fine, run.coarse))
        largest = np.abs(own).max(axis=(0, 1))
        change = np.abs(own - coarse).max(axis=(0, 1))
        # The third derivative of a power that has this slope, at most.
        cut = STEP**2 / 6.0 * largest * (largest + 1.0) * (largest + 2.0)
        closing, tail = run.fine[-2:].reshape(2, self.copies, -1).max(axis=1)
        # The polynomial's error is one of Chebyshev's, whose slope is larger by its degree.
        tail = level.degree * (tail + run.coarse[-1].reshape(self.copies, -1).max(axis=0))
        noise = 2.0 * closing + _ROUNDING_OF_SLOPES + 2.0**level.degree * _EPS
        share = _STATED_SLOPES_JUMPING if self.form.jumping else _STATED_SLOPES
        return np.asarray(share * change + cut + tail + noise / STEP)

    def _changes(self, mean: FloatArray, pending: IntArray) -> tuple[FloatArray, FloatArray]:
        """Changes of outputs by each parameter, for all of it, shape (n_output, n_parameter, n), and relative to them.

        `mean` is the mean of u^2 A in all copies of the scenes.
        """
        columns, outputs = self.columns(pending), self.task.outputs
        values = np.array([self.figure(name, mean[None], columns) for name in outputs])
        low, high = np.moveaxis(values.reshape(len(outputs), 2, len(self.wanted.paths), -1), 1, 0)
        size, change = np.abs(0.5 * (low + high)), (high - low) / (2.0 * STEP)
        return change, change / np.where(size > 0.0, size, 1.0)
