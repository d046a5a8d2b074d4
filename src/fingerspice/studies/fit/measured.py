"""Measured columns, from arrays or tables with names and units; those of materials also with likely slips."""

from __future__ import annotations

import csv
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from fingerspice.base.arrays import FloatArray, real_numbers
from fingerspice.base.errors import InputError
from fingerspice.netlist.reader import read_text
from fingerspice.physics.materials import EPS0
from fingerspice.waveforms.files import MAX_TEXT_BYTES, checked_file, read_text_columns

SIGMA = "sigma"
_PREFIXES = {"": 1.0, "k": 1e3, "M": 1e6, "m": 1e-3, "u": 1e-6, "µ": 1e-6, "μ": 1e-6, "n": 1e-9}
#: Columns of measured materials, and what they may be in words.
COLUMNS = ("frequency", "resistivity", "permittivity")
ALLOWED = "frequency (Hz), resistivity (ohm m), relative permittivity"
_ALL_PREFIXES = _PREFIXES | {"G": 1e9, "p": 1e-12}
_METRES = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}
_PREFIX = f"(?P<prefix>[{''.join(_ALL_PREFIXES)}]?)"
_METRE = "(?P<metre>cm|mm|m)"
_FREQUENCY = "f|freq|frequency|frequenz|hz"
_PERMITTIVITY = (
    "eps|eps_r|epsr|eps'|eps_r'|epsilon|epsilon_r|ε|ε_r|εr|ε'|eps_r_sc|permittivity|relative permittivity|"
    "relative_permittivity|dielectric constant|dk"
)

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


class _Kind(NamedTuple):
    """What a column may hold by its name and unit; of several kinds with a name the first is that without a unit."""

    column: str  # The one of `COLUMNS` that it tells
    names: str  # Pattern of its names
    units: str  # Pattern of its units
    metres: int  # Power of the metre in its unit
    meant: Callable[[FloatArray], FloatArray]  # From its values in SI units to those of the column


_KINDS = (
    _Kind("frequency", _FREQUENCY, f"{_PREFIX}[Hh]z|1/s", 0, lambda x: x),
    _Kind("frequency", _FREQUENCY, "rad/s", 0, lambda x: x / (2.0 * np.pi)),
    _Kind("frequency", "w|omega|ω|angular frequency|angular_frequency", "rad/s|1/s", 0, lambda x: x / (2.0 * np.pi)),
    _Kind("resistivity", "rho|ρ|rho_sc|resistivity|resistance",
          f"{_PREFIX}(?:[Oo]hms?|[\u03a9\u2126])[ *·.-]?{_METRE}", 1, lambda x: x),
    _Kind("resistivity", "sigma|σ|kappa|conductivity|conductance", f"{_PREFIX}S/{_METRE}", -1, lambda x: 1.0 / x),
    _Kind("permittivity", _PERMITTIVITY, "1|-", 0, lambda x: x),
    _Kind("permittivity", _PERMITTIVITY, f"{_PREFIX}F/{_METRE}", -1, lambda x: x * (1.0 / EPS0)),
)  # fmt: skip


def read_table(path: Path) -> FloatArray:
    """Rows of frequency (Hz), resistivity (ohm m) and relative permittivity from a text file of three columns.

    Columns are separated by commas, tabs or semicolons; with semicolons decimal commas are allowed. A line of names
    may give quantities, order and units of the columns; conductivities and angular frequencies are converted.
    """
    try:
        lines = read_text(path, str(path)).splitlines(keepends=True)
        mark = next((mark for mark in ";\t" if any(mark in line for line in lines)), ",")
        rows = [row for row in csv.reader(lines, delimiter=mark) if row and not row[0].lstrip().startswith("#")]
    except csv.Error as error:
        raise InputError(f"{path} cannot be read as CSV: {error}") from error
    head: list[str] = []
    numbers = []
    for place, row in enumerate(rows):
        try:
            numbers.append([float(x.replace(",", ".") if mark == ";" else x) for x in row])
        except ValueError:
            if place > 0:
                raise InputError(f"{path}, row {place + 1}: {','.join(row)!r}; allowed: three numbers") from None
            head = row
    if any(len(row) != 3 for row in numbers):
        raise InputError(f"{path} has rows that are not three numbers; allowed: {ALLOWED}")
    table = np.array(numbers, float).reshape(-1, 3)
    if len(head) != 3:
        return table
    # Columns with unknown names fill the places that the others leave.
    named: dict[str, FloatArray] = {}
    others = []
    for name, x in zip(head, table.T, strict=True):
        kind, scale = _kind(name, str(path))
        if kind is None:
            others.append(x)
            continue
        if kind.column in named:
            names = ", ".join(head)
            raise InputError(f"{path}: two columns are a {kind.column} by their names, {names}; allowed: {ALLOWED}")
        with np.errstate(divide="ignore"):
            named[kind.column] = kind.meant(scale * x)
    return np.column_stack([named[name] if name in named else others.pop(0) for name in COLUMNS])


def _kind(name: str, file: str) -> tuple[_Kind | None, float]:
    """What a column holds by its name, and the factor of its unit; None for an unknown name."""
    bare = name.strip().strip("\"'")
    match = re.fullmatch(r"(?P<what>[^\[(/]*?)\s*(?:[\[(](?P<bracket>[^\])]*)[\])]|/\s*(?P<slash>.+))?", bare)
    if match is None:
        return None, 1.0
    what, unit = match["what"].strip(), (match["bracket"] or match["slash"] or "").strip()
    known = [kind for kind in _KINDS if re.fullmatch(kind.names, what, re.IGNORECASE)]
    if not known and "_" in what and not unit:
        # A name such as f_kHz ends with its unit.
        what, _, unit = what.rpartition("_")
        known = [kind for kind in _KINDS if re.fullmatch(kind.names, what, re.IGNORECASE)]
    if not known or not unit:
        return next(iter(known), None), 1.0
    for kind in known:
        found = re.fullmatch(kind.units, unit)
        if found:
            groups = found.groupdict()
            return kind, _ALL_PREFIXES[groups.get("prefix") or ""] * _METRES[groups.get("metre") or "m"] ** kind.metres
    raise InputError(
        f"{file}: the unit of column {name.strip()!r} is not known; allowed: Hz, rad/s, ohm m, S/m, and 1 or F/m"
    )


#: Possible slips of the user, each with the function from the table as given to the table as meant.
_SLIPS: tuple[tuple[str, Callable[[FloatArray], FloatArray]], ...] = (
    ("the frequency is in rad/s", lambda t: t * (0.5 / np.pi, 1.0, 1.0)),
    ("the second column is a conductivity in S/m", lambda t: t ** (1.0, -1.0, 1.0)),
    ("the frequency is in kHz", lambda t: t * (1e3, 1.0, 1.0)),
    ("the resistivity is in ohm cm", lambda t: t * (1.0, 1e-2, 1.0)),
    ("the resistivity is in kohm m", lambda t: t * (1.0, 1e3, 1.0)),
    ("resistivity and permittivity have changed places", lambda t: t[:, [0, 2, 1]]),
    ("frequency and resistivity have changed places", lambda t: t[:, [1, 0, 2]]),
    ("frequency and permittivity have changed places", lambda t: t[:, [2, 1, 0]]),
    ("the columns are resistivity, permittivity, frequency", lambda t: t[:, [2, 0, 1]]),
    ("the columns are permittivity, frequency, resistivity", lambda t: t[:, [1, 2, 0]]),
    ("the second column is a conductivity in mS/m", lambda t: t ** (1.0, -1.0, 1.0) * (1.0, 1e3, 1.0)),
    ("the second column is a conductivity in uS/cm", lambda t: t ** (1.0, -1.0, 1.0) * (1.0, 1e4, 1.0)),
    ("the second column is a conductivity in S/cm", lambda t: t ** (1.0, -1.0, 1.0) * (1.0, 1e-2, 1.0)),
    ("the frequency is in MHz", lambda t: t * (1e6, 1.0, 1.0)),
    ("the permittivity is in F/m", lambda t: t * (1.0, 1.0, 1.0 / EPS0)),
)


def likely_slips(table: FloatArray, misfit: Callable[[FloatArray], float], least: float) -> list[str]:
    """Slips that may explain data that fit no material: at most two that reduce the misfit to less than a third.

    `misfit` is that of a table (n, 3) to the nearest causal and passive material, `least` that of the data as given.
    """
    found = []
    for text, meant in _SLIPS:
        other = meant(table)
        other = other[np.argsort(other[:, 0])]
        if np.all(np.diff(other[:, 0]) > 0.0):
            found.append((misfit(other), text))
    best = min((value for value, _ in found), default=np.inf)
    # Name two slips at most, as those with the same factor, such as kHz and kohm m, cannot be distinguished.
    return [text for value, text in found if value <= min(1.1 * best, least / 3.0)][:2]
