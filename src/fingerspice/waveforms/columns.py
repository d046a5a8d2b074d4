"""Reader of text tables such as CSV: finds separators, header and units, and refuses bad cells with their line."""

from __future__ import annotations

import codecs
import re
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fingerspice.base.arrays import FloatArray
from fingerspice.base.errors import InputError
from fingerspice.base.units import parse_number

_UNIT = re.compile(r"(.*?)\s*[\[(]\s*([^\])]*?)\s*[\])]")
# Names that simulators give to a voltage between nodes or the current of an element: V(n001), I(R1), Ix(u1:in).
_PROBE = re.compile(r"[vi]\w?\((.*)\)", re.IGNORECASE)
_SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "μs": 1e-6, "ns": 1e-9}
_VOLTS = {"V": 1.0, "mV": 1e-3, "uV": 1e-6, "µV": 1e-6, "μV": 1e-6, "kV": 1e3}
_AMPERES = {"A": 1.0, "mA": 1e-3, "uA": 1e-6, "µA": 1e-6, "μA": 1e-6, "nA": 1e-9}
_NEWTONS = {"N": 1.0, "mN": 1e-3, "uN": 1e-6, "µN": 1e-6, "μN": 1e-6, "kN": 1e3}
#: Units of a column in s, of one in V (or in A, for a current), and of one in N, with their sizes.
_UNITS = {"s": _SECONDS, "V": _VOLTS | _AMPERES, "N": _NEWTONS}
_DECIMAL_COMMA = re.compile(r"[+-]?\d+,\d+")
# Lines of comments; a comment behind numbers that blanks separate, where without a blank a semicolon separates cells.
_COMMENTED = ("#", ";", "*")
_COMMENT = re.compile(r"^(\s*[^\s;]+\s[^;]*\s);.*")
# A line that begins with a number or NaN, in the first cell that is not empty, and so is no header.
_FIRST_NUMBER = re.compile(r"[\s,;\"]*(?:[+-]?\.?\d|[+-]?(?:nan|inf)\b|$)", re.IGNORECASE)
# Begins the line above each run in LTspice's export of a .step.
_STEPPED = "Step Information:"
# Largest number of column names shown in a message.
_SHOWN = 8


@dataclass(frozen=True)
class Columns:
    """Columns of numbers, with their names and units; only those that are used need be numbers, and finite."""

    file: Path
    names: tuple[str, ...]  # Without units; empty where the file has no header
    data: FloatArray  # (n_row, n_column): as written, before any conversion of units; NaN for what is no number
    units: tuple[str, ...] = ()  # Of every column, an empty text where it has none; empty where there is no header
    lines: NDArray[np.int64] | None = None  # (n_row,): of each row, from 1; None for a file without lines
    faults: dict[int, str] = field(default_factory=dict)  # About the first cell that is no number, by column
    words: tuple[str, ...] = ()  # Of the column of labels, in which each is written as its number among them

    def numbers(self, column: int) -> FloatArray:
        """The numbers of a column (n_row,), all finite; errors name the line."""
        if column in self.faults:
            raise InputError(self.faults[column])
        found = self.data[:, column]
        bad = np.flatnonzero(~np.isfinite(found))
        if bad.size:
            name = repr(self.names[column]) if self.names else str(column)
            raise InputError(f"{self.place(int(bad[0]))}: column {name} is {found[bad[0]]}; allowed: finite numbers")
        return found

    def place(self, row: int) -> str:
        """File and line (or row) of a row counted from 0, as text for messages."""
        return f"'{self.file}', " + (f"row {row}" if self.lines is None else f"line {self.lines[row]}")

    def listed(self) -> str:
        """Number and names of the columns, as text for messages."""
        count = self.data.shape[1]
        shown = ", ".join(self.names[:_SHOWN]) + (", ..." if len(self.names) > _SHOWN else "")
        called = f"({shown})" if self.names else f"without a header (0 to {count - 1})"
        return f"{count} column{'s' if count > 1 else ''} {called}"

    def index(self, column: str | int) -> int:
        """Index of a column given by its name, of which there has to be one, or by its number."""
        count = self.data.shape[1]
        if isinstance(column, str):
            if not self.names:
                raise InputError(f"'{self.file}' has no header that names a column {column!r}; allowed: its number, "
                                 f"0 to {count - 1}")  # fmt: skip
            exact = [i for i, name in enumerate(self.names) if name == column]
            found = exact or [i for i, name in enumerate(self.names) if name.lower() == column.lower()]
            if len(found) != 1:
                what = "several columns" if found else "no column"
                raise InputError(f"'{self.file}' has {what} {column!r}; it has {self.listed()}")
            return found[0]
        if not (column == int(column) and 0 <= column < count):
            raise InputError(f"'{self.file}' has no column {column}; it has {self.listed()}")
        return int(column)

    def scaled(self, column: int, to: str) -> FloatArray:
        """A column in s, V or N, shape (n_row,); one in V may be a current, in A."""
        known = _UNITS[to]
        unit = self.units[column] if self.units else ""
        factors = {name.lower(): factor for name, factor in known.items()}
        if unit and unit.lower() not in factors:
            allowed = ", ".join(name for name in known if name.isascii())
            problem = f"'{self.file}': the unit of column {self.names[column]!r} is {unit!r}"
            raise InputError(f"{problem}; allowed: {allowed}")
        return np.asarray(self.numbers(column) * (factors[unit.lower()] if unit else 1.0))

    def paired(self) -> Columns:
        """Two columns from one row or column of alternating times and values; other tables as they are."""
        rows, columns = self.data.shape
        if self.names or (rows > 1 and columns > 1):
            return self
        if self.data.size % 2:
            raise InputError(f"'{self.file}' holds {self.data.size} numbers; allowed: pairs of time and value")
        for column in range(columns):
            self.numbers(column)
        lines = None if self.lines is None else np.resize(self.lines[::2], self.data.size // 2)
        return Columns(self.file, (), self.data.reshape(-1, 2), (), lines)


def read_text_columns(path: Path, label: str | None = None) -> Columns:
    """Columns of a text file, with one count of cells in all rows; the column `label` has words. Errors name lines."""
    data, words, place = path.read_bytes(), dict[str, int](), None
    wide = data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    if b"\0" in data and not wide:
        raise InputError(f"'{path}' is no text; allowed: a table as text, or an NPZ file")
    try:
        lines = data.decode("utf-16" if wide else "utf-8-sig").splitlines()
    except UnicodeDecodeError:
        # Windows' Latin-1, in which spreadsheets and LTspice write the micro sign.
        lines = data.decode("cp1252", "replace").splitlines()
    lines = [_COMMENT.sub(r"\1", line) if ";" in line else line for line in lines]
    numbered = [(number, line) for number, line in enumerate(lines, 1) if line.strip()]
    steps = [one for one in numbered if one[1].startswith(_STEPPED)]
    if len(steps) > 1:
        said = f"'{path}', line {steps[1][0]}: the table holds {len(steps)} runs of .step, here {steps[1][1].strip()!r}"
        raise InputError(f"{said}; allowed: one run: export one step, or keep the rows of one")
    numbered = [one for one in numbered if one not in steps]
    rows = [(number, line) for number, line in numbered if not line.lstrip().startswith(_COMMENTED)]
    if label is not None and rows:
        # The rows of such a table need not begin with a number: they are those below the first.
        named = [_unit(cell)[0].lower() for cell in _cells(rows[0][1], _separator(rows[0][1]))]
        if label.lower() not in named:
            raise InputError(f"'{path}' has no column {label!r} in its header; it has {', '.join(named)}")
        place = named.index(label.lower())
    first = next((i for i, (_, line) in enumerate(rows) if (i if label else _FIRST_NUMBER.match(line))), None)
    if first is None:
        raise InputError(f"'{path}' holds no rows of numbers")
    begin, line = rows[first]
    _refuse_semicolons(path, begin, line)
    # In a comma-separated table the number of cells shows decimal commas.
    cells = line.split()
    commas = list(filter(_DECIMAL_COMMA.fullmatch, cells))
    if len(cells) > 1 and commas and not any(cell.endswith(",") for cell in cells):
        said = f"{commas[0]} has a decimal comma; allowed: points, {commas[0].replace(',', '.')}"
        raise InputError(f"'{path}', line {begin}: {said}")
    separator = _separator(line)
    count = len(_cells(line, separator))
    header = [_unit(name) for name in _header(path, numbered, begin, separator, count)]
    names, units = zip(*header, strict=True) if header else ((), ())
    table, faults = _numbers(path, rows[first:], separator, count, place, words)
    places = np.array([number for number, _ in rows[first:]])
    return Columns(path, names, table, units, places, faults, tuple(words))


def _separator(line: str) -> str | None:
    return "\t" if "\t" in line else "," if "," in line else None


def _cells(line: str, separator: str | None) -> list[str]:
    """Cells of a line without the quotes that spreadsheets put around them; None as separator splits at blanks."""
    return [cell.strip().strip('"').strip() for cell in line.strip().split(separator)]


def _unit(header: str) -> tuple[str, str]:
    """Name and unit of a column from ``name (unit)`` or ``name [unit]``; ``V(n001)`` is a name."""
    probe = _PROBE.fullmatch(header)
    if probe and probe[1] not in _VOLTS | _AMPERES:
        return header, ""
    match = _UNIT.fullmatch(header)
    return (match[1], match[2]) if match else (header, "")


def _refuse_semicolons(path: Path, number: int, line: str) -> None:
    if ";" in line:
        also = " and writes decimal commas" if any(map(_DECIMAL_COMMA.search, line.split(";"))) else ""
        problem = f"'{path}', line {number}: the table separates by semicolons{also}"
        raise InputError(f"{problem}; allowed: commas, tabs or blanks between numbers with points")


def _header(
    path: Path, numbered: list[tuple[int, str]], begin: int, separator: str | None, count: int
) -> tuple[str, ...]:
    """Column names from the line before the first numbers, which may be a comment; empty if it holds no names."""
    before = [(number, line) for number, line in numbered if number < begin]
    if not before:
        return ()
    number, line = before[-1]
    text = line.strip()
    names = tuple(_cells(text.lstrip("#"), separator))
    if len(names) == count and text[0] not in ";*":
        return names
    if text.startswith(_COMMENTED):
        return ()
    hint = ", or are its commas decimal commas" if separator == "," and count == 2 * len(names) else ""
    raise InputError(f"'{path}', line {number}: the header names {len(names)} columns, and the rows have {count}: is "
                     f"a name missing{hint}?")  # fmt: skip


def _numbers(
    path: Path, rows: list[tuple[int, str]], separator: str | None, count: int, label: int | None, words: dict[str, int]
) -> tuple[FloatArray, dict[int, str]]:
    """Numbers (n_row, count), the words of the column `label` as their numbers among `words`, and faults by column."""
    faults: dict[int, str] = {}
    with suppress(ValueError):
        if label is None:
            return np.loadtxt((line for _, line in rows), delimiter=separator, ndmin=2, comments=None), faults
    # NumPy reads neither SPICE's scales nor quoted cells, and its message does not help: read the rows one by one.
    table = np.full((len(rows), count), np.nan)
    for (number, line), found in zip(rows, table, strict=True):
        _refuse_semicolons(path, number, line)
        cells = _cells(line, separator)
        if len(cells) != count:
            raise InputError(f"'{path}', line {number} has {len(cells)} cells; allowed: {count}, as in the first row")
        for column, cell in enumerate(cells):
            try:
                found[column] = words.setdefault(cell, len(words)) if column == label else _number(cell)
            except ValueError as error:
                reason = str(error) if cell else f"the cell in column {column} is empty; allowed: numbers"
                faults.setdefault(column, f"'{path}', line {number}: {reason}")
    return table, faults


def _number(cell: str) -> float:
    try:
        return float(cell)
    except ValueError:
        return parse_number(cell)
