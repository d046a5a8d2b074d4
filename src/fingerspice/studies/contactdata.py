"""Measured areas and friction forces of a finger, from arrays or tables, for the fit of a contact."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from fingerspice.base.arrays import FloatArray
from fingerspice.base.errors import InputError
from fingerspice.studies.fitdata import SIGMA, number_columns, unit_factor
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
