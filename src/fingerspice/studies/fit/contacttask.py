"""What is fitted of a contact, and the standard deviations of what was measured, from its own residuals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from fingerspice.base.arrays import Array, FloatArray, IntArray
from fingerspice.base.errors import InputError
from fingerspice.circuit.statespace import build_stack, contact_of, is_stack
from fingerspice.numerics.small import AT, derivative
from fingerspice.physics.contact import Contact
from fingerspice.studies.fit.contactdata import Relation
from fingerspice.studies.fit.search import Fitted, Problem, followed

# Step of the differences in a parameter's logarithm, at which those of fourth order are exact to rounding.
_STEP = 1e-3
# Standard deviations of relations that have none are found in at most so many rounds, until they change by less than
# this; they are no smaller than the last.
_ROUNDS, _SETTLED, _LEAST = 30, 1e-4, 1e-9
#: Fewer data than this beyond those that the parameters take up tell nothing of a standard deviation.
FEWEST = 0.5


@dataclass(frozen=True)
class ContactTask(Problem):
    """The fit of a contact; the scale of a relation without sigma is the standard deviation of the logarithms."""

    gap: str  # Name of the GAP
    relations: tuple[Relation, ...]

    def split(self, x: Array) -> list[Array]:
        """Each relation's part of a row over all data."""
        return np.split(x, np.cumsum([one.values.size for one in self.relations])[:-1])

    def predict(self, values: FloatArray) -> list[FloatArray]:
        """Each relation's values as the contact has them."""
        paths = [one.path for one in self.unknowns]
        changed = self.circuit.varied(dict(zip(paths, values.tolist(), strict=True)))
        own: Contact | None = build_stack(changed).contact if is_stack(changed) else None
        contact = contact_of(changed[self.gap]) if own is None else own
        return [relation.predicted(contact) for relation in self.relations]

    def compared(self, values: FloatArray) -> tuple[FloatArray, FloatArray]:
        middle, by = self._misses(values), np.zeros((self.scale.size, values.size))
        for k, one in enumerate(np.eye(values.size)):
            moved = [values * np.exp(at * _STEP * one) for at in AT]
            by[:, k] = derivative([self._misses(each) for each in moved], _STEP)
        return middle, by

    def _misses(self, values: FloatArray) -> FloatArray:
        parts = []
        for relation, found in zip(self.relations, self.predict(values), strict=True):
            if relation.sigma is None and not np.all(found > 0.0):
                raise InputError("friction leaves no area; allowed: a smaller c2")
            parts.append(found - relation.values if relation.sigma is not None else np.log(found / relation.values))
        return np.concatenate(parts) / self.scale


class Pool(NamedTuple):
    """Relations whose values have one standard deviation, as they come from the same instrument."""

    name: str  # What was measured, in words
    at: IntArray  # Places of their values among the residuals
    estimated: bool  # Whether the standard deviation follows from the residuals, and is not given


def pools_of(task: ContactTask) -> list[Pool]:
    """The relations by what they have been measured with: ridge areas against the load come from one set of images."""
    places = task.split(np.arange(task.scale.size))
    members: dict[tuple[str, bool], list[tuple[str, IntArray]]] = {}
    for relation, at in zip(task.relations, places, strict=True):
        key = relation.kind.removesuffix("_sliding"), relation.sigma is None
        members.setdefault(key, []).append((relation.name, at))
    return [
        Pool(" and the ".join(name for name, _ in own), np.concatenate([at for _, at in own]), estimated)
        for (_, estimated), own in members.items()
    ]


def solved(task: ContactTask) -> tuple[ContactTask, Fitted, list[float]]:
    """Least squares, with the standard deviation of every pool that has none from its own residuals.

    Returns the task with the standard deviations found, the fit, and the degrees of freedom of each pool: its values
    less what the parameters take up of them; infinity where sigma is given.
    """
    begin, pools = task.initial, pools_of(task)
    for _ in range(_ROUNDS):
        best = followed(task.residuals, task.bounds, begin)
        left, scale = _freedoms(best, pools), task.scale.copy()
        for pool, freedom in zip(pools, left, strict=True):
            if pool.estimated and freedom >= FEWEST:
                spread = float(np.sqrt(np.sum(best.residual[pool.at] ** 2) / freedom))
                scale[pool.at] = np.maximum(scale[pool.at] * spread, _LEAST)
        if np.abs(np.log(scale / task.scale)).max() < _SETTLED:
            break
        task, begin = replace(task, scale=scale), best.values
    return task, best, left


def _freedoms(best: Fitted, pools: Sequence[Pool]) -> list[float]:
    """Degrees of freedom of each pool: its number of values less the sum of their leverages."""
    left, singular, _ = np.linalg.svd(best.by_log, full_matrices=False)
    left = left[:, singular > 1e-9 * max(float(singular.max()), 1e-300)]
    leverage = np.sum(left**2, axis=1)
    return [pool.at.size - float(leverage[pool.at].sum()) if pool.estimated else float("inf") for pool in pools]
