"""Measured areas and friction forces of a finger, and what a contact's parameters predict of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fingerspice.base.arrays import FloatArray
from fingerspice.base.errors import InputError
from fingerspice.circuit.statespace import build_stack, contact_of, is_stack
from fingerspice.physics.contact import Contact, ridge_area
from fingerspice.studies.fit.measured import SIGMA, Given, measured_of
from fingerspice.studies.fit.search import Problem

#: Measured columns and conditions, with their units.
MEASURED = {"area": "m^2", "area_sliding": "m^2", "f_t": "N"}
CONDITIONS = {"fn": "N", "indentation": "m", "u_gap": "V"}
#: What is measured in words; an area against the indentation is a relation of its own.
NAMES = {
    "area": "ridge area at rest", "indentation": "ridge area by indentation",
    "area_sliding": "ridge area while sliding", "f_t": "friction force",
}  # fmt: skip


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
    def name(self) -> str:
        """What was measured, in words."""
        return NAMES[self.kind]

    def predicted(self, contact: Contact) -> FloatArray:
        """The values as a contact has them (Eqs. 1 to 6), shape (n,)."""
        if self.kind == "indentation":
            return np.asarray(contact.beta * self.indentation**contact.n)
        resting = self.kind == "area"
        out = np.empty(self.values.size)
        for i, (fn, u) in enumerate(zip(self.fn.tolist(), self.u_gap.tolist(), strict=True)):
            packed = replace(contact, f_n=fn, mu=0.0 if resting else contact.mu).packed
            out[i] = area = ridge_area(abs(u), packed)
            if self.kind == "f_t":
                out[i] = contact.mu * (fn + packed[4] * u * u * area)
        return out


def relations_of(given: Given | Sequence[Given], fn: float) -> tuple[Relation, ...]:
    """The relations in one or several sets of columns; `fn` (N) is the load where no column has it."""
    several = [given] if isinstance(given, (str, Path, Mapping)) else given
    if not isinstance(several, Sequence) or not several:
        raise InputError(f"data is a {type(given).__name__}; allowed: a mapping of columns, a table's path, or a list")
    found: dict[tuple[str, bool], Relation] = {}
    for number, one in enumerate(several, 1):
        place = "the data" if len(several) == 1 else f"data {number}"
        columns, place, _ = measured_of(one, _meaning, "fn (N), area (mm^2)", place=place)
        measured = [name for name in MEASURED if name in columns]
        if not measured:
            raise InputError(f"{place} have the columns {', '.join(columns)}; allowed: one of {', '.join(MEASURED)}")
        alone = len(measured) == 1 and SIGMA in columns
        sigmas = {name: SIGMA if alone else f"{name}_{SIGMA}" for name in measured}
        unknown = [name for name in columns if name not in (*measured, *CONDITIONS, *sigmas.values())]
        if unknown:
            why = ": which of the measured columns it belongs to is not known" if unknown[0] == SIGMA else ""
            allowed = ", ".join([*MEASURED, *CONDITIONS, SIGMA, *(f"{name}_{SIGMA}" for name in measured)])
            raise InputError(f"{place} have a column {unknown[0]!r}{why}; allowed: {allowed}")
        for name, x in columns.items():
            if name != "u_gap" and not np.all(x > 0.0):
                raise InputError(f"{place}: the smallest {name} is {x.min():g}; allowed: more than 0")
        none = np.zeros(columns[measured[0]].size)
        at, u, depth = columns.get("fn", none + fn), columns.get("u_gap", none), columns.get("indentation")
        if depth is not None and np.any(u != 0.0):
            raise InputError(f"{place} have the columns indentation and u_gap; allowed: indentations without voltage")
        own = []
        for name in measured:
            values, sigma = columns[name], columns.get(sigmas[name])
            if name == "area" and depth is not None:
                own.append(Relation("indentation", values, sigma, at, none, depth))
            if name != "area" or depth is None or "fn" in columns:
                own.append(Relation(name, values, sigma, at, u, none))
        for relation in own:
            key = relation.kind, relation.sigma is None
            if key in found:
                known = {name: x for name, x in vars(found[key]).items() if isinstance(x, np.ndarray)}
                joined: Any = {name: np.concatenate([x, getattr(relation, name)]) for name, x in known.items()}
                relation = replace(relation, **joined)
            found[key] = relation
    return tuple(found.values())


def _meaning(name: str, names: Sequence[str]) -> tuple[str, str, str | None]:
    key, lower = name.lower(), [one.lower() for one in names]
    measured = [own for own in MEASURED if own in lower]
    values = measured[0] if key == SIGMA and len(measured) == 1 else key.removesuffix(f"_{SIGMA}")
    return key, values, (MEASURED | CONDITIONS).get(values)


@dataclass(frozen=True)
class ContactTask(Problem):
    """The fit of a contact; the scale of a relation without sigma is the standard deviation of the logarithms."""

    gap: str  # Name of the GAP
    relations: tuple[Relation, ...]

    def split(self, x: NDArray[Any]) -> list[NDArray[Any]]:
        """Each relation's part of a row over all data."""
        return np.split(x, np.cumsum([one.values.size for one in self.relations])[:-1])

    def predict(self, values: FloatArray) -> list[FloatArray]:
        """Each relation's values as the contact has them."""
        changed = self.circuit.varied(dict(zip(self.names, values.tolist(), strict=True)))
        own = build_stack(changed).contact if is_stack(changed) else None
        contact = contact_of(changed[self.gap]) if own is None else own
        return [relation.predicted(contact) for relation in self.relations]

    def misses(self, values: FloatArray) -> FloatArray:
        parts = []
        for relation, found in zip(self.relations, self.predict(values), strict=True):
            if relation.sigma is None and not np.all(found > 0.0):
                raise InputError("friction leaves no area; allowed: a smaller c2")
            parts.append(found - relation.values if relation.sigma is not None else np.log(found / relation.values))
        return np.concatenate(parts) / self.scale
