"""Measured areas and friction forces of a finger, and what a contact's parameters predict of them."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fingerspice.base.arrays import FloatArray
from fingerspice.base.errors import FingerspiceWarning, InputError
from fingerspice.circuit.circuit import Circuit
from fingerspice.circuit.statespace import build_stack, contact_of, is_stack
from fingerspice.numerics.small import AT, derivative
from fingerspice.physics.contact import Contact, ridge_area
from fingerspice.studies.fitdata import SIGMA, number_columns, unit_factor
from fingerspice.studies.fitresult import Fitted
from fingerspice.studies.fittask import REFUSED, followed
from fingerspice.waveforms.columns import read_text_columns
from fingerspice.waveforms.files import MAX_TEXT_BYTES, checked_file

#: One set of columns, or several of them; each a mapping of arrays (SI units) or the path of a table.
Given = Mapping[str, ArrayLike] | str | Path
#: Measured columns and conditions, with their units.
MEASURED = {"area": "m^2", "area_sliding": "m^2", "f_t": "N"}
CONDITIONS = {"fn": "N", "indentation": "m", "u_gap": "V"}
#: What is measured in words; an area against the indentation is a relation of its own.
NAMES = {
    "area": "ridge area at rest", "indentation": "ridge area by indentation",
    "area_sliding": "ridge area while sliding", "f_t": "friction force",
}  # fmt: skip
_ALLOWED = ", ".join([*MEASURED, *CONDITIONS, "sigma"])


@dataclass(frozen=True)
class Relation:
    """Measured values of one kind with their conditions, in SI units."""

    kind: str  # A key of `NAMES`
    values: FloatArray  # (n,)
    sigma: FloatArray | None  # (n,): Standard deviation of every value; None where it is not known
    # fn, u_gap, indentation (n,): Normal load, gap voltage and indentation; the last is 0 where it has no meaning
    fn: FloatArray
    u_gap: FloatArray
    indentation: FloatArray

    @property
    def unit(self) -> str:
        """Unit of the values."""
        return MEASURED.get(self.kind, "m^2")

    @property
    def name(self) -> str:
        """What was measured, in words."""
        return NAMES[self.kind]


def relations_of(given: Given | Sequence[Given], fn: float) -> tuple[Relation, ...]:
    """The relations in one or several sets of columns; `fn` (N) is the load where no column has it.

    Raises
    ------
    InputError
        If a column or unit is unknown, or a value is out of range.
    """
    several = [given] if isinstance(given, (str, Path, Mapping)) else given
    if not isinstance(several, Sequence) or not several:
        raise InputError(f"data is a {type(given).__name__}; allowed: a mapping of columns, a table's path, or a list")
    found: dict[tuple[str, bool], Relation] = {}
    for number, one in enumerate(several, 1):
        place = (
            f"the data in '{one}'"
            if isinstance(one, (str, Path))
            else "the data"
            if len(several) == 1
            else f"data {number}"
        )
        columns = _from_table(Path(one)) if isinstance(one, (str, Path)) else number_columns(one)
        for relation in _relations(columns, fn, place):
            key = relation.kind, relation.sigma is None
            found[key] = _joined(found[key], relation) if key in found else relation
    return tuple(found.values())


def _from_table(path: Path) -> dict[str, FloatArray]:
    table = read_text_columns(checked_file(path, MAX_TEXT_BYTES))
    if not table.names:
        raise InputError(f"'{path}' has no header; allowed: names with units, such as fn (N), area (mm^2)")
    known = MEASURED | CONDITIONS
    out: dict[str, FloatArray] = {}
    of_share: dict[str, str] = {}
    for i, (name, unit) in enumerate(zip(table.names, table.units, strict=True)):
        key = name.lower()
        measured = [own for own in MEASURED if own in map(str.lower, table.names)]
        of = measured[0] if key == SIGMA and len(measured) == 1 else key.removesuffix(f"_{SIGMA}")
        base = "" if of != key and unit == "%" else known.get(of)
        factor = unit_factor(unit, base, f"'{path}': the unit of column {name!r}") if base is not None else 1.0
        if key in out:
            raise InputError(f"'{path}' has two columns {name!r}; allowed: one")
        out[key] = factor * table.numbers(i)
        of_share |= {key: of} if of != key and unit == "%" else {}
    return out | {key: out[key] * np.abs(out[of]) for key, of in of_share.items() if of in out}


def _relations(columns: Mapping[str, FloatArray], fn: float, place: str) -> list[Relation]:
    measured = [name for name in MEASURED if name in columns]
    if not measured:
        raise InputError(f"{place} have the columns {', '.join(columns)}; allowed: one of {', '.join(MEASURED)}")
    sigmas = {name: f"{name}_{SIGMA}" for name in measured} | ({measured[0]: SIGMA} if len(measured) == 1 else {})
    sigmas = {name: key if key in columns else f"{name}_{SIGMA}" for name, key in sigmas.items()}
    unknown = [name for name in columns if name not in (*measured, *CONDITIONS, *sigmas.values())]
    if unknown:
        why = ": which of the measured columns it belongs to is not known" if unknown[0] == SIGMA else ""
        each = ", ".join(f"{name}_{SIGMA}" for name in measured)
        raise InputError(f"{place} have a column {unknown[0]!r}{why}; allowed: {_ALLOWED}, {each}")
    for name, x in columns.items():
        if name != "u_gap" and not np.all(x > 0.0):
            raise InputError(f"{place}: the smallest {name} is {x.min():g}; allowed: more than 0")
    size = columns[measured[0]].size
    at, none = columns.get("fn", np.full(size, fn)), np.zeros(size)
    u, depth = columns.get("u_gap", none), columns.get("indentation")
    if depth is not None and np.any(u != 0.0):
        raise InputError(f"{place} have the columns indentation and u_gap; allowed: indentations without voltage")
    found = []
    for name in measured:
        values, sigma = columns[name], columns.get(sigmas[name])
        if name == "area" and depth is not None:
            found.append(Relation("indentation", values, sigma, at, none, depth))
        if name != "area" or depth is None or "fn" in columns:
            found.append(Relation(name, values, sigma, at, u, none))
    return found


def _joined(a: Relation, b: Relation) -> Relation:
    pairs = [(getattr(a, name), getattr(b, name)) for name in ("values", "sigma", "fn", "u_gap", "indentation")]
    values, sigma, fn, u, depth = (None if x is None or y is None else np.concatenate([x, y]) for x, y in pairs)
    assert values is not None
    assert fn is not None
    assert u is not None
    assert depth is not None
    return Relation(a.kind, values, sigma, fn, u, depth)


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
                for k, one in enumerate(np.eye(values.size)):
                    moved = [values * np.exp(at * _STEP * one) for at in AT]
                    by[:, k] = derivative([self._misses(each) for each in moved], _STEP)
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
