"""Derivatives of means in lockstep: central differences of runs with the very same steps.

These do not depend on a parameter: a difference has the error of the method and hardly any noise. The tangents of the
same steps would have this error, too: it comes from the kink of 1/A where the gap voltage is 0, which has order 1 in a
derivative.
"""

from __future__ import annotations

import numpy as np

from fingerspice.base.arrays import BoolArray, FloatArray, IntArray
from fingerspice.numerics.small import STEP
from fingerspice.studies.batch.form import table_of
from fingerspice.studies.batch.ladder import Ladder, Level, Run

# A run of degree d has this rounding error, relative, besides 2^d times 1e-16: the area's polynomial's coefficients
# lose a digit in two to the rounding with every power.
_ROUNDING, _EPS = 1e-13, 1.1e-16
# The stated error has this many changes from half the steps to all steps, under tones and under squares. Under tones a
# kink's error is about as large as the change, or larger where that is small by chance.
_STATED, _STATED_JUMPING = 3.0, 2.0


class Slopes(Ladder):
    """Derivatives by the parameters asked for; copies of a scene have one of them smaller, then larger, by a step."""

    limit = 10.0  # For a change of the parameter by all of itself
    stated = 1.0
    # What ends the search for a periodic state moves a difference by 1 / STEP of itself.
    closer = STEP
    # Kinks have order 1, with a factor that depends on where between two steps they fall.
    most_gain = 8.0
    more_degree, highest_degree = 4, 20
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
        _, change = self._changes(run.fine[0], pending)
        for j, name in enumerate(self.task.outputs):
            self.found.values[name][self.members[at]] = (change[j][:, good] / self.given[:, at]).T

    def error(self, level: Level, run: Run, pending: IntArray) -> FloatArray:
        """For a change of a parameter by all of itself, relative to the output; the largest of all."""
        own, coarse = (change / np.where(size > 0.0, size, 1.0) for size, change in (
            self._changes(run.fine[0], pending), self._changes(run.coarse[0], pending)))  # fmt: skip
        largest = np.abs(own).max(axis=(0, 1))
        change = np.abs(own - coarse).max(axis=(0, 1))
        # The third derivative of a power that has this slope, at most.
        cut = STEP**2 / 6.0 * largest * (largest + 1.0) * (largest + 2.0)
        closing, tail = run.fine[-2:].reshape(2, self.copies, -1).max(axis=1)
        # The polynomial's error is one of Chebyshev's, whose slope is larger by its degree.
        tail = level.degree * (tail + run.coarse[-1].reshape(self.copies, -1).max(axis=0))
        noise = 2.0 * closing + _ROUNDING + 2.0**level.degree * _EPS
        share = _STATED_JUMPING if self.form.jumping else _STATED
        return np.asarray(share * change + cut + tail + noise / STEP)

    def _changes(self, mean: FloatArray, pending: IntArray) -> tuple[FloatArray, FloatArray]:
        """Outputs and their changes by each parameter, for all of it, shape (n_output, n_parameter, n).

        `mean` is the mean of u^2 A in all copies of the scenes.
        """
        columns, outputs = self.columns(pending), self.task.outputs
        values = np.array([self.figure(name, mean[None], columns) for name in outputs])
        low, high = np.moveaxis(values.reshape(len(outputs), 2, len(self.wanted.paths), -1), 1, 0)
        return np.abs(0.5 * (low + high)), (high - low) / (2.0 * STEP)
