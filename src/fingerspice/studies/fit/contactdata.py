"""Measured areas and friction forces of a finger, and what a contact's parameters predict of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from fingerspice.base.arrays import FloatArray
from fingerspice.base.errors import InputError
from fingerspice.physics.contact import Contact, ridge_area
from fingerspice.studies.fit.measured import SIGMA, Given, measured_of

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
        place = "the data" if len(several) == 1 else f"data {number}"
        measured = measured_of(one, _meaning, "fn (N), area (mm^2)", place=place)
        for relation in _relations(measured.columns, fn, measured.place):
            key = relation.kind, relation.sigma is None
            found[key] = _joined(found[key], relation) if key in found else relation
    return tuple(found.values())


def _meaning(name: str, names: Sequence[str]) -> tuple[str, str, str | None]:
    key, lower = name.lower(), [one.lower() for one in names]
    measured = [own for own in MEASURED if own in lower]
    values = measured[0] if key == SIGMA and len(measured) == 1 else key.removesuffix(f"_{SIGMA}")
    return key, values, (MEASURED | CONDITIONS).get(values)


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
    """Two relations of one kind as one; both have sigma, or none of them."""
    names = ("values", "sigma", "fn", "u_gap", "indentation")
    pairs = {name: (getattr(a, name), getattr(b, name)) for name in names}
    joined: dict[str, Any] = {name: np.concatenate(pair) for name, pair in pairs.items() if pair[0] is not None}
    return replace(a, **joined)
