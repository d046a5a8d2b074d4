"""Tables of measured resistivity and permittivity: reading units from headers, and finding likely slips in numbers."""

from __future__ import annotations

import csv
import re
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from fingerspice.base.arrays import FloatArray
from fingerspice.base.errors import InputError
from fingerspice.netlist.files import read_text
from fingerspice.physics.materials import EPS0

COLUMNS = ("frequency", "resistivity", "permittivity")
ALLOWED = "frequency (Hz), resistivity (ohm m), relative permittivity"
_PREFIXES = {"": 1.0, "k": 1e3, "M": 1e6, "G": 1e9, "m": 1e-3, "u": 1e-6, "µ": 1e-6, "μ": 1e-6, "n": 1e-9, "p": 1e-12}
_METRES = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}
_PREFIX = f"(?P<prefix>[{''.join(_PREFIXES)}]?)"
_METRE = "(?P<metre>cm|mm|m)"
_FREQUENCY = "f|freq|frequency|frequenz|hz"
_PERMITTIVITY = (
    "eps|eps_r|epsr|eps'|eps_r'|epsilon|epsilon_r|ε|ε_r|εr|ε'|eps_r_sc|permittivity|relative permittivity|"
    "relative_permittivity|dielectric constant|dk"
)


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
    return _as_named(table, head, str(path)) if len(head) == 3 else table


def _as_named(table: FloatArray, head: list[str], file: str) -> FloatArray:
    """Columns put into order and SI units by their names; columns with unknown names fill the remaining places."""
    named: dict[str, FloatArray] = {}
    others = []
    for name, x in zip(head, table.T, strict=True):
        kind, scale = _kind(name, file)
        if kind is None:
            others.append(x)
            continue
        if kind.column in named:
            raise InputError(
                f"{file}: two columns are a {kind.column} by their names, {', '.join(head)}; allowed: {ALLOWED}"
            )
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
            return kind, _PREFIXES[groups.get("prefix") or ""] * _METRES[groups.get("metre") or "m"] ** kind.metres
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
