"""Recordings and tables from files: WAV, text such as CSV, and NPZ; what is wrong in a file is refused by its line."""

from __future__ import annotations

import codecs
import re
import struct
import zipfile
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import dropwhile
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from fingerspice.base.arrays import FloatArray, positive_number
from fingerspice.base.errors import InputError
from fingerspice.base.units import parse_number
from fingerspice.waveforms.waveform import refuse

_UNIT = re.compile(r"(.*?)\s*[\[(]\s*([^\])]*?)\s*[\])]")
_BEFORE_UNIT = re.compile(r"\s+(?=[\[(])")  # A blank that separates no columns
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
_STEPPED = "Step Information:"  # Begins the line above each run in LTspice's export of a .step.
_SHOWN = 8  # Largest number of column names shown in a message.


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
        refuse(column in self.faults, self.faults.get(column, ""))
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

    def index(self, column: str | int | None, role: str, most: int, default: int) -> int:
        """Index of a column given by its name, of which there has to be one, or by its number; else the default.

        A table of more than `most` columns has no default for the role.
        """
        count = self.data.shape[1]
        if column is None:
            way = "name the column" if self.names else "the number of the column"
            refuse(count > most, f"'{self.file}' has {self.listed()}; allowed: {way} of the {role}")
            return default
        if isinstance(column, str):
            problem = f"'{self.file}' has no header that names a column {column!r}"
            refuse(not self.names, f"{problem}; allowed: its number, 0 to {count - 1}")
            exact = [i for i, name in enumerate(self.names) if name == column]
            found = exact or [i for i, name in enumerate(self.names) if name.lower() == column.lower()]
            what = "several columns" if found else "no column"
            refuse(len(found) != 1, f"'{self.file}' has {what} {column!r}; it has {self.listed()}")
            return found[0]
        if not (column == int(column) and 0 <= column < count):
            raise InputError(f"'{self.file}' has no column {column}; it has {self.listed()}")
        return int(column)

    def scaled(self, column: int, to: str) -> FloatArray:
        """A column in s, V or N, shape (n_row,); one in V may be a current, in A."""
        known = _UNITS[to]
        unit = self.units[column] if self.units else ""
        factors = {name.lower(): factor for name, factor in known.items()}
        # A capital M may be mega, a factor of 1e9 beside milli.
        if unit and (unit.lower() not in factors or unit[0] == "M"):
            allowed = ", ".join(name for name in known if name.isascii())
            problem = f"'{self.file}': the unit of column {self.names[column]!r} is {unit!r}"
            raise InputError(f"{problem}; allowed: {allowed}")
        return np.asarray(self.numbers(column) * (factors[unit.lower()] if unit else 1.0))

    def paired(self) -> Columns:
        """Two columns from one row or column of alternating times and values; other tables as they are."""
        rows, columns = self.data.shape
        if self.names or (rows > 1 and columns > 1):
            return self
        refuse(self.data.size % 2, f"'{self.file}' holds {self.data.size} numbers; allowed: pairs of time and value")
        for column in range(columns):
            self.numbers(column)
        lines = None if self.lines is None else np.resize(self.lines[::2], self.data.size // 2)
        return Columns(self.file, (), self.data.reshape(-1, 2), (), lines)


def read_text_columns(path: str | Path, label: str | None = None) -> Columns:
    """Columns of a text file, with one count of cells in all rows; the column `label` has words. Errors name lines."""
    path = checked_file(path, MAX_TEXT_BYTES)
    numbered = _lines(path)
    rows = [(number, line) for number, line in numbered if not line.lstrip().startswith(_COMMENTED)]
    place = None
    if label is not None and rows:
        # The rows of such a table need not begin with a number: they are those below the first.
        named = [_unit(cell)[0].lower() for cell in _cells(rows[0][1], _separator(rows[0][1]))]
        refuse(label.lower() not in named, f"'{path}' has no column {label!r} in its header; it has {', '.join(named)}")
        place = named.index(label.lower())
    rows = rows[1:] if label else list(dropwhile(lambda row: not _FIRST_NUMBER.match(row[1]), rows))
    refuse(not rows, f"'{path}' holds no rows of numbers")
    begin, line = rows[0]
    _refuse_semicolons(path, begin, line)
    # In a comma-separated table the number of cells shows decimal commas.
    cells = line.split()
    commas = list(filter(_DECIMAL_COMMA.fullmatch, cells))
    if len(cells) > 1 and commas and not any(cell.endswith(",") for cell in cells):
        said = f"{commas[0]} has a decimal comma; allowed: points, {commas[0].replace(',', '.')}"
        raise InputError(f"'{path}', line {begin}: {said}")
    separator = _separator(line)
    count = len(_cells(line, separator))
    # The line above the first numbers has the names, unless it is a comment or, here `;`, there is none.
    number, text = [(0, ";"), *((one, above.strip()) for one, above in numbered if one < begin)][-1]
    text = _BEFORE_UNIT.sub("", text) if separator is None else text
    header = _cells(text.lstrip("#"), separator)
    if len(header) != count or text[0] in ";*":
        hint = ", or are its commas decimal commas" if separator == "," and count == 2 * len(header) else ""
        problem = f"'{path}', line {number}: the header names {len(header)} columns, and the rows have {count}"
        refuse(not text.startswith(_COMMENTED), f"{problem}: is a name missing{hint}?")
        header = []
    names, units = zip(*map(_unit, header), strict=True) if header else ((), ())
    table, faults, words = _numbers(path, rows, separator, count, place)
    return Columns(path, names, table, units, np.array([number for number, _ in rows]), faults, words)


def _lines(path: Path) -> list[tuple[int, str]]:
    """The lines of a text file that are not empty, by their numbers from 1, without comments behind numbers."""
    data = path.read_bytes()
    wide = data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    refuse(b"\0" in data and not wide, f"'{path}' is no text; allowed: a table as text, or an NPZ file")
    try:
        lines = data.decode("utf-16" if wide else "utf-8-sig").splitlines()
    except UnicodeDecodeError:
        # Windows' Latin-1, in which spreadsheets and LTspice write the micro sign.
        lines = data.decode("cp1252", "replace").splitlines()
    lines = [_COMMENT.sub(r"\1", line) if ";" in line else line for line in lines]
    steps = [(number, line) for number, line in enumerate(lines, 1) if line.startswith(_STEPPED)]
    if len(steps) > 1:
        said = f"'{path}', line {steps[1][0]}: the table holds {len(steps)} runs of .step, here {steps[1][1].strip()!r}"
        raise InputError(f"{said}; allowed: one run: export one step, or keep the rows of one")
    return [one for one in enumerate(lines, 1) if one[1].strip() and one not in steps]


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


def _numbers(
    path: Path, rows: list[tuple[int, str]], separator: str | None, count: int, label: int | None
) -> tuple[FloatArray, dict[int, str], tuple[str, ...]]:
    """Numbers (n_row, count), faults by column, and the words of the column `label`, which has their places."""
    faults, words = dict[int, str](), dict[str, int]()
    with suppress(ValueError):
        if label is None:
            return np.loadtxt((line for _, line in rows), delimiter=separator, ndmin=2, comments=None), {}, ()
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
    return table, faults, tuple(words)


def _number(cell: str) -> float:
    with suppress(ValueError):
        return float(cell)
    return parse_number(cell)


MAX_BYTES, MAX_TEXT_BYTES = 2**30, 2**26  #: Largest size of a binary file and of a text file, bytes.
MAX_SAMPLES = 200_000_000  #: Largest number of samples: an hour at 48 kHz has 1.7e8, which take 1.4 GB.
LARGEST_STREAMED = 2**40  #: Largest size of a WAV file that is read piece by piece, bytes.
_JITTER = 0.1  # Largest distance, in samples, of a file's times from those of its rate: written times are rounded.
_RATE_NAMES = ("rate", "fs", "sample_rate")
_TIME_NAMES = ("t", "time")
# Sizes that stand for an unknown one in a live stream's header, the second by SoX: samples go on to the file's end.
_UNKNOWN_SIZES = (0xFFFFFFFF, 0x7FFFF000)
_MOST_CHUNKS = 10_000  # Most chunks of a file that are looked at, so that a crafted one takes no minutes.
_FORMATS = {2: "ADPCM", 6: "ALAW", 7: "MULAW", 17: "DVI_ADPCM", 85: "MPEGLAYER3"}  # Number formats that are not read.
_OTHERS = {  # First bytes of other file formats, to name the format in the message.
    b"ID3": "MP3", b"\xff\xfb": "MP3", b"\xff\xf3": "MP3", b"OggS": "Ogg", b"fLaC": "FLAC", b"FORM": "AIFF",
    b"caff": "CAF", b"PK": "ZIP or NPZ",
}  # fmt: skip


@dataclass(frozen=True)
class WavLayout:
    """Position and number format of the samples in a WAV file, so that some of them can be read."""

    path: Path
    rate: int  # Hz
    channels: int
    channel: int  # The one that is read
    count: int  # Samples of each channel
    kind: str  # As NumPy writes it, such as ``<i2``; NumPy itself does not know those of 3, 5, 6 or 7 bytes
    offset: int  # Position of the first sample, bytes

    def read(self, first: int, last: int) -> FloatArray:
        """Samples number `first` to `last` - 1 as fractions of full scale, -1 to just below 1 of integers."""
        width = int(self.kind[2])
        block = self.channels * width
        try:
            raw = np.fromfile(self.path, np.uint8, (last - first) * block, offset=self.offset + first * block)
        except OSError as error:
            raise InputError(f"'{self.path}' cannot be read: {error.strerror}") from None
        refuse(raw.size < (last - first) * block, f"'{self.path}' has become shorter while it was read")
        if width in (1, 2, 4, 8):
            stored = raw.view(self.kind).reshape(-1, self.channels)[:, self.channel]
        else:
            # The sample fills the upper bytes of an integer that NumPy knows.
            full = 4 if width == 3 else 8
            wide = np.zeros((last - first, full), np.uint8)
            low = full - width if self.kind[0] == "<" else 0
            wide[:, low : low + width] = raw.reshape(-1, self.channels, width)[:, self.channel]
            stored = wide.view(f"{self.kind[0]}i{full}")[:, 0]
        values = stored.astype(float)
        if width == 1:
            values -= 128.0  # Only integers of 8 bits have no sign
        if self.kind[1] != "f":
            values /= 2.0 ** (8 * stored.dtype.itemsize - 1)
        return values


def wav_layout(path: str | Path, channel: int | None = None, most: int = LARGEST_STREAMED) -> WavLayout:
    """Position of the samples of one channel, counted from 0, of a WAV file of at most `most` bytes."""
    path = checked_file(path, most)
    with path.open("rb") as file:
        order, form, offset, length = _wav_chunks(path, file)
    tag, channels, rate, pace, block, bits = struct.unpack(order + "HHIIHH", form[:16])
    if tag == 0xFFFE and form[28:40] == struct.pack(order + "HH", 0, 16) + bytes.fromhex("800000aa00389b71"):
        (tag,) = struct.unpack(order + "I", form[24:28])
    if tag not in (1, 3):
        raise InputError(f"'{path}' holds samples as {_FORMATS.get(tag, hex(tag))}; allowed: PCM or float (convert it)")
    width = block // max(channels, 1)
    whole = bits == 8 * width and width in (4, 8) if tag == 3 else 0 < bits <= 8 * width and (bits > 8 or width == 1)
    # Of floats, some programs write no number of bytes a second.
    said = f"{channels} channels of {bits} bits take {block} bytes, at {rate} Hz {pace} bytes a second"
    wrong = not whole or width > 8 or block != channels * width or (tag == 1 and pace != rate * block)
    refuse(wrong, f"'{path}' is broken: its header says that {said}")
    refuse(rate == 0, f"'{path}' is broken: its header gives a rate of 0 Hz")
    refuse(length == 0, f"'{path}' holds no samples")
    refuse(length % block, f"'{path}' is cut short or broken: {length} bytes are no whole number of samples of {block}")
    allowed = "channel=0, its only one" if channels == 1 else f"channel=0 to {channels - 1}"
    refuse(channel is None and channels > 1, f"'{path}' has {channels} channels and none is chosen; allowed: {allowed}")
    number = 0 if channel is None else channel
    wrong = isinstance(number, bool | str) or number != int(number) or not 0 <= number < channels
    refuse(wrong, f"'{path}' has no channel {number!r}; allowed: {allowed}")
    kind = f"{order}{'f' if tag == 3 else 'u' if width == 1 else 'i'}{width}"
    return WavLayout(path, rate, channels, int(number), length // block, kind, offset)


def _wav_chunks(path: Path, file: BinaryIO) -> tuple[str, bytes, int, int]:
    """Byte order, format chunk, and position and length of the samples, bytes."""
    start = file.read(12)
    order = {b"RIFF": "<", b"RIFX": ">", b"RF64": "<"}.get(start[:4])
    if order is None or (len(start) == 12 and start[8:] != b"WAVE"):
        kind = next((f", it begins as {name} does" for magic, name in _OTHERS.items() if start.startswith(magic)), "")
        raise InputError(f"'{path}' is no WAV file{kind}; allowed: WAV (convert it), or a table by TABLE")
    size, at, long = file.seek(0, 2), 12, None
    # Behind the end that the header gives there may be anything, such as tags of players.
    end = struct.unpack(order + "I", start[4:8])[0] + 8 if len(start) == 12 else 0
    found: dict[bytes, tuple[bytes, int, int]] = {}
    for _ in range(_MOST_CHUNKS):
        if at + 8 > size or (at >= end and b"data" in found):
            break
        file.seek(at)
        entry = file.read(8)
        name, (length,) = entry[:4], struct.unpack(order + "I", entry[4:])
        body, at = file.read(min(length, 40)), at + 8
        if name in found and name in (b"fmt ", b"data"):
            raise InputError(f"'{path}' holds two {name.decode().strip()!r} chunks; allowed: one")
        if name == b"ds64" and start[:4] == b"RF64" and len(body) >= 16:
            end, long = (x + y for x, y in zip(struct.unpack("<QQ", body[:16]), (8, 0), strict=True))
        elif name == b"data" and long is not None:
            if length not in (0xFFFFFFFF, long):
                raise InputError(f"'{path}' is broken: its header gives {length} and {long} bytes of samples")
            length = long
        elif name == b"data" and start[:4] != b"RF64" and length in _UNKNOWN_SIZES and at + length > size:
            length = size - at
        found[name] = body, at, length
        at += length + (length & 1)
    form, samples = found.get(b"fmt ", (b"", 0, 0)), found.get(b"data")
    if samples is None or len(form[0]) < 16 or form[1] > samples[1]:
        raise InputError(f"'{path}' is broken or cut short: it cannot be read as WAV to its end")
    refuse(sum(samples[1:]) > size, f"'{path}' is cut short: it ends before the samples that its header promises")
    return order, form[0], samples[1], samples[2]


def read_table(
    path: str | Path, time: str | int | None = None, value: str | int | None = None, rate: float | None = None, *,
    pairs: bool = False,
) -> tuple[FloatArray, float | None, FloatArray | None]:  # fmt: skip
    """Values (V or A) of a table with their rate (Hz) or their times (s): a text of one row a line, or NumPy's NPZ.

    Numbers in a text have decimal points and may have SPICE's scales (``1m``); commas, tabs or blanks separate them.
    Lines that begin with ``#``, ``;`` or ``*`` are comments, and so is what follows a blank and ``;`` behind numbers.
    The line before the first numbers may name the columns, with units in brackets: ``time (ms), drive [kV]``; the units
    s and V are assumed where none is given. Of two columns the one named ``t`` or ``time`` is the times, or else the
    first one, with a header or without. An NPZ file holds one array per column, and may hold a number named ``rate``
    instead of times.

    Columns are given by name, or by number from 0, where more than one choice is possible, and the rate (Hz) where
    there are no times. With `pairs` one row or column holds alternating times and values, as in a file of SPICE's PWL.
    Errors name the line.
    """
    path = checked_file(path, MAX_BYTES)
    with path.open("rb") as file:
        packed = file.read(4) == b"PK\x03\x04" or path.suffix.lower() == ".npz"
    found, own_rate = _npz_columns(path) if packed else (read_text_columns(path), None)
    found = found.paired() if pairs else found
    check_count(str(path), found.data.shape[0])
    if rate is not None and time is not None:
        raise InputError(f"'{path}': a rate and a column of times are given; allowed: one of them")
    if rate is not None and own_rate is not None and rate != own_rate:
        raise InputError(f"'{path}': the rate given is {rate:g} Hz, and its own is {own_rate:g} Hz; allowed: one rate")
    rate = own_rate if rate is None else positive_number(f"'{path}': the rate", rate, "Hz")
    columns = found.data.shape[1]
    allowed = "a column of times too, or rate= in Hz; PWL FILE= takes alternating times and values"
    refuse(rate is None and columns == 1, f"'{path}' has one column and no rate; allowed: {allowed}")
    # A column that is named as times is one even beside a rate, which it may contradict.
    named = [i for i, name in enumerate(found.names) if name.lower() in _TIME_NAMES]
    if rate is not None and not (columns > 1 and (named or (columns == 2 and value is None))):
        return found.scaled(found.index(value, "value", 1, 0), "V"), rate, None
    at = named[0] if time is None and len(named) == 1 else found.index(time, "time", 2, 0)
    t = found.scaled(at, "s")
    chosen = found.index(value, "value", 2, 1 - at)
    refuse(chosen == at, f"'{path}': the column {value!r} is both time and value; allowed: two columns")
    values = found.scaled(chosen, "V")
    back = np.flatnonzero(t[1:] < t[:-1])
    if back.size:
        i = int(back[0])
        taken = "" if found.names or time is not None else " (without a header, the first of two columns is the times)"
        problem = f"{found.place(i + 1)}: the time {t[i + 1]:g} s follows {t[i]:g} s{taken}"
        raise InputError(f"{problem}; allowed: not decreasing")
    if rate is None:
        return values, None, t
    late = np.abs((t - t[0]) * rate - np.arange(t.size)) > _JITTER
    if late.any():
        i = int(np.argmax(late))
        problem = f"the time {t[i]:g} s is not that of sample {i} at {rate:g} Hz, {t[0] + i / rate:g} s"
        raise InputError(f"{found.place(i)}: {problem}; allowed: times or a rate, or both that agree")
    return values, rate, None


def checked_file(path: str | Path, most: int) -> Path:
    """The path, after a check that it is a readable ordinary file, not empty and not larger than `most` bytes."""
    path = Path(path)
    refuse(fault := file_fault(path, most) or ("" if path.stat().st_size else "is empty"), f"'{path}' {fault}")
    return path


def file_fault(path: Path, most: int) -> str:
    """Why an ordinary file of at most `most` bytes cannot be read; an empty text for one that can."""
    try:
        if not path.is_file():
            there = "is not an ordinary file" if path.exists() else "does not exist"
            return "is a folder, not a file" if path.is_dir() else there
        with path.open("rb") as file:
            size = len(file.read(1)) and file.seek(0, 2)
        return f"has {size / 2**20:,.0f} MiB; allowed: at most {most >> 20:,} MiB" if size > most else ""
    except (OSError, ValueError) as error:
        return f"cannot be read: {getattr(error, 'strerror', None) or error}"


def check_count(what: str, count: int) -> None:
    """Refuse more than `MAX_SAMPLES` samples, the most that are kept in memory."""
    refuse(count > MAX_SAMPLES, f"'{what}' has {count:,} samples; allowed: at most {MAX_SAMPLES:,}")


def _npz_columns(path: Path) -> tuple[Columns, float | None]:
    """The arrays of an NPZ file as columns, and its rate (Hz) where it has one."""
    rate, arrays, loaded = None, dict[str, FloatArray](), dict[str, Any]()
    try:
        with zipfile.ZipFile(path) as packed:
            size = sum(entry.file_size for entry in packed.infolist())
        if size <= 8 * MAX_SAMPLES:
            with np.load(path) as file:
                loaded = dict(file)
    # Exceptions of zipfile and NumPy for broken files, and for arrays of objects, which NumPy refuses to load.
    except (ValueError, OSError, zipfile.BadZipFile, EOFError, KeyError, MemoryError, NotImplementedError) as error:
        raise InputError(f"'{path}' cannot be read as NPZ: {str(error).partition('. ')[0]}") from None
    most = 8 * MAX_SAMPLES
    refuse(size > most, f"'{path}' unpacks to {size / 1e9:.3g} GB; allowed: at most {1e-9 * most:g} GB")
    for name, array in loaded.items():
        kind = getattr(array, "dtype", "another kind")
        real = isinstance(array, np.ndarray) and array.dtype.kind in "iuf"
        refuse(not real, f"'{path}': the array {name!r} is of {kind}; allowed: real numbers")
        if array.ndim == 0 and name.lower() in _RATE_NAMES:
            rate = float(array)
        elif array.ndim == 1:
            arrays[name] = array.astype(float)
        else:
            problem = f"'{path}': the array {name!r} has shape {array.shape}"
            raise InputError(f"{problem}; allowed: one row a column, and one number named rate")
    lengths = {array.size for array in arrays.values()}
    shown = ", ".join(f"{name} {array.size}" for name, array in arrays.items())
    refuse(len(lengths) > 1, f"'{path}' has arrays of different length ({shown}); allowed: one length")
    refuse(not arrays or lengths == {0}, f"'{path}' holds no numbers")
    return Columns(path, tuple(arrays), np.column_stack(list(arrays.values()))), rate
