"""Measured columns, from arrays or a table with names and units, and which measurements belong together."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from fingerspice.base.arrays import FloatArray, real_numbers
from fingerspice.base.errors import InputError
from fingerspice.waveforms.columns import read_text_columns
from fingerspice.waveforms.files import MAX_TEXT_BYTES, checked_file

SIGMA = "sigma"
_PREFIXES = {"": 1.0, "k": 1e3, "M": 1e6, "m": 1e-3, "u": 1e-6, "µ": 1e-6, "μ": 1e-6, "n": 1e-9}

#: One set of columns, or the path of a table.
Given = Mapping[str, ArrayLike] | str | Path
#: What a name in a header means, with all names of the header beside it: the column's key, the key of the column whose
#: unit it has (of a standard deviation that of the values, else its own), and this unit, or None where none is known.
Meaning = Callable[[str, Sequence[str]], tuple[str, str, str | None]]
#: Columns (n,) in SI units or, of a circuit's parameters, those of the netlist; where they come from, as subject of a
#: message; and the groups.
Measured = tuple[dict[str, FloatArray], str, "Groups | None"]


class Groups(NamedTuple):
    """The group of every measurement."""

    column: str  # Name of the column that tells it
    of: tuple[str, ...]  # Name of each measurement's group

    @property
    def labels(self) -> tuple[str, ...]:
        """Every group's name, in the order of the data."""
        return tuple(dict.fromkeys(self.of))


def measured_of(
    given: Given, meaning: Meaning, example: str, by: str | None = None, place: str = "the data"
) -> Measured:
    """The columns that a caller gave, finite numbers; that named `by` tells the group of a measurement.

    `example` shows the header that a table needs, and `place` names columns that come from none.
    """
    if isinstance(given, (str, Path)):
        return _from_table(Path(given), meaning, example, by)
    if not isinstance(given, Mapping) or not all(isinstance(name, str) for name in given):
        raise InputError(f"data is a {type(given).__name__}; allowed: a mapping of columns, or the path of a table")
    if by is not None and by not in given:
        raise InputError(f"the data have no column {by!r}, which groups names; they have {', '.join(given)}")
    found = {name: real_numbers(f"data column {name!r}", x, "numbers") for name, x in given.items() if name != by}
    size = max((x.size for x in found.values()), default=0)
    for name, x in found.items():
        if x.shape not in ((), (size,)):
            raise InputError(
                f"data column {name!r} has the shape {x.shape}, others have {size} rows; allowed: as many, or one "
                "number for all"
            )
        bad = np.flatnonzero(~np.isfinite(x))
        if bad.size:
            raise InputError(f"data column {name!r} is {x.flat[bad[0]]} in row {bad[0]}; allowed: finite numbers")
    # A number stands for a column of it.
    columns = {name: np.broadcast_to(x, size).copy() for name, x in found.items()}
    if by is None:
        return columns, place, None
    cells = np.asarray(given[by])
    if cells.ndim != 1 or cells.dtype.kind not in "iufU":
        raise InputError(f"data column {by!r} tells the group; allowed: a text or a number for every measurement")
    if cells.size != size:
        raise InputError(f"data column {by!r} has {cells.size} rows, others have {size}; allowed: as many")
    return columns, place, Groups(by, tuple(x if isinstance(x, str) else f"{x:g}" for x in cells.tolist()))


def _from_table(path: Path, meaning: Meaning, example: str, by: str | None) -> Measured:
    table = read_text_columns(checked_file(path, MAX_TEXT_BYTES), by)
    if not table.names:
        raise InputError(f"'{path}' has no header; allowed: names with units, such as {example}")
    found: dict[str, FloatArray] = {}
    units: dict[str, str] = {}
    of_share: dict[str, str] = {}
    groups: Groups | None = None
    for i, (name, unit) in enumerate(zip(table.names, table.units, strict=True)):
        if by is not None and name.lower() == by.lower():
            groups = Groups(by, tuple(table.words[int(number)] for number in table.numbers(i)))
            continue
        key, values, base = meaning(name, table.names)
        if key in found:
            raise InputError(f"'{path}' has two columns {name!r}; allowed: one")
        if key != values and unit == "%":
            of_share[key], base = values, ""
        factor = 1.0 if base is None else _unit_factor(unit, base, f"'{path}': the unit of column {name!r}")
        found[key], units[key] = table.numbers(i) * factor, unit
    for key, values in of_share.items():
        # Beside values in % (a friction coefficient), a standard deviation in % is of their unit, and no share of them.
        if units.get(values, "%") != "%":
            found[key] = found[key] * np.abs(found[values])
    return found, f"the data in '{path}'", groups


def _unit_factor(unit: str, base: str, what: str) -> float:
    """A header's unit over the unit `base`; the prefix of an area is squared with it."""
    power = 2 if base == "m^2" else 1
    known = {prefix + base: factor**power for prefix, factor in _PREFIXES.items()} if base else {"%": 0.01}
    known |= {"": 1.0} | (dict.fromkeys(("mm2", "mm²"), 1e-6) if power == 2 else {})
    if unit in known:
        return known[unit]
    scaled = ", with k, m, u or n before it where need be" if base else ""
    raise InputError(f"{what} is {unit!r}; allowed: {base or 'none'}{scaled}")
