"""What a contact's parameters predict of measured areas and friction forces, and the least squares through these."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fingerspice.base.arrays import FloatArray
from fingerspice.base.errors import FingerspiceWarning, InputError
from fingerspice.circuit.circuit import Circuit
from fingerspice.circuit.statespace import build_stack, contact_of, is_stack
from fingerspice.physics.contact import Contact, ridge_area
from fingerspice.studies.contactdata import Relation
from fingerspice.studies.fitresult import Fitted
from fingerspice.studies.fittask import REFUSED, followed

# Step of the differences in a parameter's logarithm, at which those of fourth order are exact to rounding.
_STEP = 1e-3
# Standard deviations of relations that have none are found in at most so many rounds, until they change by less than
# this; they are no smaller than the last.
_ROUNDS, _SETTLED, _LEAST = 30, 1e-4, 1e-9
# Fewer data than this beyond those that the parameters take up tell nothing of a standard deviation.
FEWEST = 0.5


@dataclass(frozen=True)
class ContactTask:
    """What is fitted."""

    circuit: Circuit  # With the values to start from
    gap: str  # Name of the GAP
    relations: tuple[Relation, ...]
    paths: tuple[str, ...]
    bounds: FloatArray  # (n_parameter, 2)
    # Standard deviation of the logarithms of each relation's values, where the relation has no sigma
    shares: tuple[float, ...]

    @property
    def initial(self) -> FloatArray:
        """Values to start from."""
        return np.array([self.circuit.parameters[path].value for path in self.paths])

    def contact(self, values: FloatArray) -> Contact:
        """The contact with these values."""
        changed = self.circuit.varied(dict(zip(self.paths, values.tolist(), strict=True)))
        own = build_stack(changed).contact if is_stack(changed) else None
        return contact_of(changed[self.gap]) if own is None else own

    def predict(self, values: FloatArray) -> list[FloatArray]:
        """Each relation's values as the contact has them."""
        contact = self.contact(values)
        return [_predicted(contact, relation) for relation in self.relations]

    def _misses(self, values: FloatArray) -> FloatArray:
        parts = []
        for relation, share, found in zip(self.relations, self.shares, self.predict(values), strict=True):
            if relation.sigma is not None:
                parts.append((found - relation.values) / relation.sigma)
            elif np.all(found > 0.0):
                parts.append(np.log(found / relation.values) / share)
            else:
                raise InputError("friction leaves no area; allowed: a smaller c2")
        return np.concatenate(parts)

    def residuals(self, values: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Residuals over their scale, and their derivatives; large ones of a contact that cannot be."""
        size = sum(relation.values.size for relation in self.relations)
        by = np.zeros((size, values.size))
        try:
            with warnings.catch_warnings():
                # Of values that no user has written.
                warnings.simplefilter("ignore", FingerspiceWarning)
                middle = self._misses(values)
                for k in range(values.size):
                    at = []
                    for step in (-2.0, -1.0, 1.0, 2.0):
                        moved = values.copy()
                        moved[k] *= np.exp(step * _STEP)
                        at.append(self._misses(moved))
                    by[:, k] = (at[0] - 8.0 * at[1] + 8.0 * at[2] - at[3]) / (12.0 * _STEP)
        except InputError:
            return np.full(size, REFUSED), np.zeros((size, values.size))
        return middle, by


def _predicted(contact: Contact, relation: Relation) -> FloatArray:
    if relation.kind == "indentation":
        return np.asarray(contact.beta * relation.indentation**contact.n)
    resting = relation.kind == "area"
    out = np.empty(relation.values.size)
    for i, (fn, u) in enumerate(zip(relation.fn.tolist(), relation.u_gap.tolist(), strict=True)):
        packed = replace(contact, f_n=fn, mu=0.0 if resting else contact.mu).packed
        out[i] = area = ridge_area(abs(u), packed)
        if relation.kind == "f_t":
            out[i] = contact.mu * (fn + packed[4] * u * u * area)
    return out


class Pool(NamedTuple):
    """Relations whose values have one standard deviation, as they come from the same instrument."""

    members: tuple[int, ...]  # Numbers of the relations
    at: NDArray[np.int64]  # Places of their values among the residuals
    estimated: bool  # Whether the standard deviation follows from the residuals, and is not given


def pools_of(relations: Sequence[Relation]) -> list[Pool]:
    """The relations by what they have been measured with: ridge areas against the load come from one set of images."""
    ends = np.cumsum([relation.values.size for relation in relations])
    members: dict[tuple[str, bool], list[int]] = {}
    for number, relation in enumerate(relations):
        members.setdefault((relation.kind.removesuffix("_sliding"), relation.sigma is None), []).append(number)
    return [
        Pool(tuple(own), np.concatenate([np.arange(ends[i] - relations[i].values.size, ends[i]) for i in own]), key[1])
        for key, own in members.items()
    ]


def solved(task: ContactTask) -> tuple[ContactTask, Fitted, list[float]]:
    """Least squares, with the standard deviation of every pool that has none from its own residuals.

    Returns
    -------
    task : ContactTask
        With the standard deviations found.
    Fitted
    list of float
        Degrees of freedom of each pool: its values less what the parameters take up of them; infinity where sigma is
        given.
    """
    begin, pools = task.initial, pools_of(task.relations)
    for _ in range(_ROUNDS):
        best = followed(task, begin)
        left, shares = _freedoms(best, pools), list(task.shares)
        for pool, freedom in zip(pools, left, strict=True):
            if pool.estimated and freedom >= FEWEST:
                own = task.shares[pool.members[0]] * float(np.sqrt(np.sum(best.residual[pool.at] ** 2) / freedom))
                for number in pool.members:
                    shares[number] = max(own, _LEAST)
        if max(abs(np.log(new / old)) for new, old in zip(shares, task.shares, strict=True)) < _SETTLED:
            break
        task, begin = replace(task, shares=tuple(shares)), best.values
    return task, best, left


def _freedoms(best: Fitted, pools: Sequence[Pool]) -> list[float]:
    """Degrees of freedom of each pool: its number of values less the sum of their leverages."""
    left, singular, _ = np.linalg.svd(best.by_log, full_matrices=False)
    left = left[:, singular > 1e-9 * max(float(singular.max()), 1e-300)]
    leverage = np.sum(left**2, axis=1)
    return [pool.at.size - float(leverage[pool.at].sum()) if pool.estimated else float("inf") for pool in pools]
