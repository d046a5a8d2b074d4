"""Derivatives of scenes in lockstep: central differences of runs with the very same steps.

The steps do not depend on a parameter, so a difference of two runs has the error of the method and hardly any noise.
The tangents of the same steps would have this error, too: it comes from the kink of 1/A where the gap voltage is 0,
which has order 1 in a derivative.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fingerspice.base.arrays import BoolArray, FloatArray
from fingerspice.circuit.circuit import Circuit
from fingerspice.engine.lockscenes import CELL_ROWS, LOAD, STRESS
from fingerspice.numerics.differences import STEP
from fingerspice.studies.batchladder import (
    COVERED,
    ENOUGH,
    FIGURES,
    MOST_PIECES,
    MOST_STEPS,
    Level,
    Run,
    first_level,
    friction_of,
    mesh_of,
)
from fingerspice.studies.batchscenes import LockstepForm, curves_of, table_of
from fingerspice.studies.batchtask import LOCKSTEP, ONE_BY_ONE, Task

#: Error allowed to a derivative, for a change of the parameter by all of itself, in errors allowed to the output.
LIMIT = 10.0
#: Smallest rtol at which derivatives are taken in lockstep: below it their kinks would take too many steps.
LEAST_RTOL = 5e-7
# Degree by which the area's polynomial grows from level to level, and the highest one: its coefficients lose a digit in
# two to the rounding with every power. A run of degree d has this rounding error, relative, besides 2^d times 1e-16.
_MORE, _HIGHEST, _ROUNDING, _EPS = 4, 20, 1e-13, 1.1e-16
# The stated error has this many changes from half the steps to all steps, under tones and under squares. Under tones a
# kink's error is about as large as the change, or larger where that is small by chance.
_STATED, _STATED_JUMPING = 3.0, 2.0
# Kinks have order 1, with a factor that depends on where between two steps they fall, so that a change may be small by
# chance: doubling the steps may not reduce the stated error by more than this factor.
_MOST_GAIN = 8.0


@dataclass(frozen=True)
class Gradients:
    """The checked request."""

    paths: tuple[str, ...]  # The parameters, in the circuit's own spelling
    outputs: tuple[str, ...]  # Outputs that have derivatives
    # Each parameter with those that grow in proportion to it: the frequency of a source with that of a skin
    together: Mapping[str, tuple[str, ...]]
    # The parameter with which the length of a run changes: the frequency, where the length is given in periods
    longer: str | None
    clock: str | None  # The frequency of the only source, if it is one of the parameters

    def values(self, circuit: Circuit, scenes: Mapping[str, FloatArray]) -> dict[str, FloatArray]:
        """Values of the parameters in all scenes, shape (n,) each."""
        n = next(iter(scenes.values())).size
        return {
            path: scenes[path] if path in scenes else np.full(n, circuit.parameters[path].value) for path in self.paths
        }


@dataclass
class Slopes:
    """Derivatives of the outputs of some scenes."""

    # (n, n_parameter): Derivatives of every output, per unit of the parameter; NaN for a scene without a result
    values: dict[str, FloatArray]
    # (n,): Stated error for a change of a parameter by all of itself, relative to the output; the largest of all
    error: FloatArray
    status: NDArray[np.int8]  # (n,): As in `Answers`
    done: BoolArray  # (n,)
    messages: dict[int, str]

    @classmethod
    def empty(cls, wanted: Gradients, n: int) -> Slopes:
        """Slopes of n scenes, none of them done."""
        values = {name: np.full((n, len(wanted.paths)), np.nan) for name in wanted.outputs}
        return cls(values, np.full(n, np.nan), np.full(n, ONE_BY_ONE, np.int8), np.zeros(n, bool), {})


class _Changes(NamedTuple):
    """Outputs and their changes for a change of each parameter by all of itself, shape (n_output, n_parameter, n)."""

    size: FloatArray
    change: FloatArray

    @property
    def relative(self) -> FloatArray:
        return self.change / np.where(self.size > 0.0, self.size, 1.0)


def climb_gradients(
    task: Task, wanted: Gradients, form: LockstepForm, scenes: Mapping[str, FloatArray], halves: int
) -> Slopes:
    """Differentiate scenes in lockstep, doubling the steps; those whose error stays too large are left as not done.

    Parameters
    ----------
    task : Task
    wanted : Gradients
    form : LockstepForm
    scenes : mapping of str to ndarray, shape (n,)
        Values by path in lower case, the wanted parameters among them.
    halves : int
        Length of the runs in half periods.
    """
    mesh = mesh_of(task, form, table_of(form, scenes), most=MOST_PIECES)
    touching, pieces = mesh.touching, mesh.pieces
    found = Slopes.empty(wanted, touching.size)
    for path in wanted.paths:
        value = scenes[path.lower()]
        touching = touching & np.isfinite(value) & (value != 0.0)
    for count in np.unique(pieces[touching]).tolist():
        chosen = np.flatnonzero(touching & (pieces == count))
        for covered in COVERED:
            some = {path: array[chosen] for path, array in scenes.items()}
            which = chosen, mesh.least[chosen]
            chosen = _climb_one(task, wanted, form, some, (halves, count), covered, which, found)
    return found


def _climb_one(
    task: Task, wanted: Gradients, form: LockstepForm, scenes: Mapping[str, FloatArray], mesh: tuple[int, int],
    covered: float, which: tuple[NDArray[np.int64], FloatArray], found: Slopes,
) -> NDArray[np.int64]:  # fmt: skip
    """Differentiate `scenes`, at `which` places of `found`; the rest is as in `batchladder`."""
    steps, degree = first_level(task.rtol, form, mesh[1])
    (place, needed), pairs = which, 2 * len(wanted.paths)
    # What ends the search for a periodic state moves a difference by 1 / STEP of itself.
    closer = replace(task, rtol=task.rtol * STEP)
    before: Run | None = None
    pending, least, outside = np.arange(place.size), np.zeros(place.size), [place[:0]]
    while pending.size and steps <= MOST_STEPS * max(form.multiples):
        curves = curves_of(form.layer.values["m_exp"], form.layer.values["n_exp"], degree)
        if curves is None:
            break
        some = {path: array[pending] for path, array in scenes.items()}
        moved = _moved(wanted, some)
        table = table_of(form, moved)
        level = Level(closer, form, mesh, steps, degree, covered, 1, False)
        run = level.run(table, np.arange(table.shape[1]), curves, before)
        rows = table[CELL_ROWS * form.cells :]
        own, coarse = (_changes(wanted, one[0], rows, friction_of(form, moved)) for one in (run.fine, run.coarse))
        share = _STATED_JUMPING if form.jumping else _STATED
        error = np.maximum(_error(own, coarse, run, degree, share), least)
        good = (error <= ENOUGH * LIMIT * task.rtol) & (needed[pending] <= steps)
        at = place[pending[good]]
        for k, path in enumerate(wanted.paths):
            for j, name in enumerate(wanted.outputs):
                found.values[name][at, k] = own.change[j, k, good] / some[path.lower()][good]
        found.error[at], found.status[at], found.done[at] = error[good], LOCKSTEP, True
        beyond = np.isinf(run.fine[-1]).reshape(pairs, -1).any(axis=0)
        outside.append(place[pending[beyond]])
        left = ~good & ~beyond
        runs = np.tile(left, pairs)
        before = Run(run.fine[:, runs], run.fine[:, runs], run.trace[runs], run.trace[runs])
        least = np.where(np.isfinite(error[left]), error[left], 0.0) / _MOST_GAIN
        pending, steps, degree = pending[left], 2 * steps, max(degree, min(degree + _MORE, _HIGHEST))
    return np.concatenate(outside)


def _moved(wanted: Gradients, scenes: Mapping[str, FloatArray]) -> dict[str, FloatArray]:
    """Every scene with each parameter smaller by a step, then with each larger, shape (2 n_parameter n,)."""
    out = {path: np.tile(array, (2, len(wanted.paths), 1)) for path, array in scenes.items()}
    for k, path in enumerate(wanted.paths):
        for other in wanted.together[path]:
            for side, sign in enumerate((-1.0, 1.0)):
                out[other.lower()][side, k] *= 1.0 + sign * STEP
    return {path: array.ravel() for path, array in out.items()}


def _changes(wanted: Gradients, mean: FloatArray, rows: FloatArray, mu: FloatArray) -> _Changes:
    """Changes of the outputs, from the means of u^2 A in the moved scenes; `rows` are the table's after its cells."""
    values = np.array([FIGURES[name][1](mean[None], rows[LOAD], rows[STRESS], mu) for name in wanted.outputs])
    low, high = np.moveaxis(values.reshape(len(wanted.outputs), 2, len(wanted.paths), -1), 1, 0)
    return _Changes(np.abs(0.5 * (low + high)), (high - low) / (2.0 * STEP))


def _error(own: _Changes, coarse: _Changes, run: Run, degree: int, share: float) -> FloatArray:
    """Stated error of every scene: of the steps (`share` of their change), the difference, polynomial and period."""
    largest = np.abs(own.relative).max(axis=(0, 1))
    change = np.abs(own.relative - coarse.relative).max(axis=(0, 1))
    # The third derivative of a power that has this slope, at most.
    cut = STEP**2 / 6.0 * largest * (largest + 1.0) * (largest + 2.0)
    pairs = run.fine.shape[1] // change.size
    closing, tail = run.fine[-2:].reshape(2, pairs, -1).max(axis=1)
    # The polynomial's error is one of Chebyshev's, whose slope is larger by its degree.
    tail = degree * (tail + run.coarse[-1].reshape(pairs, -1).max(axis=0))
    return np.asarray(share * change + cut + tail + (2.0 * closing + _ROUNDING + 2.0**degree * _EPS) / STEP)
