"""Recordings from files: WAV, tables as text (CSV and the like), and tables as NPZ."""

from __future__ import annotations

import struct
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from fingerspice.base.arrays import FloatArray, positive_number
from fingerspice.base.errors import InputError
from fingerspice.waveforms.columns import Columns, read_text_columns

#: Largest size of a binary file and of a text file, bytes.
MAX_BYTES, MAX_TEXT_BYTES = 2**30, 2**26
#: Largest number of samples: an hour at 48 kHz has 1.7e8, which take 1.4 GB.
MAX_SAMPLES = 200_000_000
#: Largest size of a WAV file that is read piece by piece, bytes.
LARGEST_STREAMED = 2**40
# Largest deviation, in samples, of a file's times from those that its rate gives: the written times are rounded.
_JITTER = 0.1
_RATE_NAMES = ("rate", "fs", "sample_rate")
_TIME_NAMES = ("t", "time")
# Sizes of samples that stand for an unknown one, in headers that were written before a live stream ended: the samples
# go on to the end of the file. SoX writes the second one.
_UNKNOWN_SIZES = (0xFFFFFFFF, 0x7FFFF000)
# Most chunks of a file that are looked at, so that a crafted one takes no minutes.
_MOST_CHUNKS = 10_000
# Names of number formats that are not read.
_FORMATS = {2: "ADPCM", 6: "ALAW", 7: "MULAW", 17: "DVI_ADPCM", 85: "MPEGLAYER3"}
# First bytes of other file formats, to name the format in the message.
_OTHERS = {
    b"ID3": "MP3", b"\xff\xfb": "MP3", b"\xff\xf3": "MP3", b"OggS": "Ogg", b"fLaC": "FLAC", b"FORM": "AIFF",
    b"caff": "CAF", b"PK": "ZIP or NPZ",
}  # fmt: skip


@dataclass(frozen=True)
class Recording:
    """Values against time, either at a rate or at times."""

    values: FloatArray  # (n,): V, or A
    rate: float | None = None  # Samples per second
    times: FloatArray | None = None  # (n,): s, not decreasing


@dataclass(frozen=True)
class WavLayout:
    """Position and number format of the samples in a WAV file, so that some of them can be read."""

    path: Path
    rate: int  # Hz
    channels: int
    channel: int  # The one that is read
    count: int  # Samples of each channel
    # Number format as NumPy writes it, such as ``<i2``; NumPy itself does not know those of 3, 5, 6 or 7 bytes
    kind: str
    offset: int  # Position of the first sample, bytes

    def read(self, first: int, last: int) -> FloatArray:
        """Samples number `first` to `last` - 1 as fractions of full scale, -1 to just below 1 of integers."""
        width = int(self.kind[2])
        block = self.channels * width
        try:
            with self.path.open("rb") as file:
                file.seek(self.offset + first * block)
                raw = file.read((last - first) * block)
        except OSError as error:
            raise InputError(f"'{self.path}' cannot be read: {error.strerror}") from None
        if len(raw) < (last - first) * block:
            raise InputError(f"'{self.path}' has become shorter while it was read")
        if width in (1, 2, 4, 8):
            stored = np.frombuffer(raw, self.kind).reshape(-1, self.channels)[:, self.channel]
        else:
            # The sample fills the upper bytes of an integer that NumPy knows.
            full = 4 if width == 3 else 8
            wide = np.zeros((last - first, full), np.uint8)
            low = full - width if self.kind[0] == "<" else 0
            wide[:, low : low + width] = np.frombuffer(raw, np.uint8).reshape(-1, self.channels, width)[:, self.channel]
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
    if not whole or width > 8 or block != channels * width or (tag == 1 and pace != rate * block):
        problem = f"{channels} channels of {bits} bits take {block} bytes, at {rate} Hz {pace} bytes a second"
        raise InputError(f"'{path}' is broken: its header says that {problem}")
    if rate == 0:
        raise InputError(f"'{path}' is broken: its header gives a rate of 0 Hz")
    if length == 0:
        raise InputError(f"'{path}' holds no samples")
    if length % block:
        raise InputError(f"'{path}' is cut short or broken: {length} bytes are no whole number of samples of {block}")
    if channel is None and channels > 1:
        raise InputError(f"'{path}' has {channels} channels and none is chosen; allowed: channel=0 to {channels - 1}")
    number = 0 if channel is None else channel
    if isinstance(number, bool | str) or number != int(number) or not 0 <= number < channels:
        allowed = "channel=0, its only one" if channels == 1 else f"channel=0 to {channels - 1}"
        raise InputError(f"'{path}' has no channel {number!r}; allowed: {allowed}")
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
    if samples[1] + samples[2] > size:
        raise InputError(f"'{path}' is cut short: it ends before the samples that its header promises")
    return order, form[0], samples[1], samples[2]


def read_table(
    path: str | Path, time: str | int | None = None, value: str | int | None = None, rate: float | None = None, *,
    pairs: bool = False,
) -> Recording:  # fmt: skip
    """Columns of a table: a text file with one row per line, or an NPZ file of NumPy.

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
    if not packed:
        checked_file(path, MAX_TEXT_BYTES)
    found, own_rate = _npz_columns(path) if packed else (read_text_columns(path), None)
    found = found.paired() if pairs else found
    check_count(str(path), found.data.shape[0])
    if rate is not None and time is not None:
        raise InputError(f"'{path}': a rate and a column of times are given; allowed: one of them")
    if rate is not None and own_rate is not None and rate != own_rate:
        raise InputError(f"'{path}': the rate given is {rate:g} Hz, and its own is {own_rate:g} Hz; allowed: one rate")
    rate = own_rate if rate is None else positive_number(f"'{path}': the rate", rate, "Hz")
    columns = found.data.shape[1]
    if rate is None and columns == 1:
        raise InputError(f"'{path}' has one column and no rate; allowed: a column of times too, or rate= in Hz; "
                         "PWL FILE= takes alternating times and values")  # fmt: skip
    # A column that is named as times is one even beside a rate, which it may contradict.
    named = [i for i, name in enumerate(found.names) if name.lower() in _TIME_NAMES]
    if rate is not None and not (columns > 1 and (named or (columns == 2 and value is None))):
        return Recording(found.scaled(_chosen(found, value, "value", 1, 0), "V"), rate)
    at = named[0] if time is None and len(named) == 1 else _chosen(found, time, "time", 2, 0)
    t = found.scaled(at, "s")
    values = found.scaled(_chosen(found, value, "value", 2, 1 - at, other=at), "V")
    back = np.flatnonzero(t[1:] < t[:-1])
    if back.size:
        i = int(back[0])
        taken = "" if found.names or time is not None else " (without a header, the first of two columns is the times)"
        problem = f"{found.place(i + 1)}: the time {t[i + 1]:g} s follows {t[i]:g} s{taken}"
        raise InputError(f"{problem}; allowed: not decreasing")
    if rate is None:
        return Recording(values, None, t)
    late = np.abs((t - t[0]) * rate - np.arange(t.size)) > _JITTER
    if late.any():
        i = int(np.argmax(late))
        problem = f"the time {t[i]:g} s is not that of sample {i} at {rate:g} Hz, {t[0] + i / rate:g} s"
        raise InputError(f"{found.place(i)}: {problem}; allowed: times or a rate, or both that agree")
    return Recording(values, rate)


def checked_file(path: str | Path, most: int) -> Path:
    """The path, after a check that it is a readable ordinary file, not empty and not larger than `most` bytes."""
    path, fault = Path(path), ""
    try:
        if not path.is_file():
            there = "is not an ordinary file" if path.exists() else "does not exist"
            fault = "is a folder, not a file" if path.is_dir() else there
        else:
            path.open("rb").close()
            size = path.stat().st_size
            too_large = f"has {size / 2**20:,.0f} MiB; allowed: at most {most >> 20:,} MiB" if size > most else ""
            fault = too_large if size else "is empty"
    except (OSError, ValueError) as error:
        fault = f"cannot be read: {getattr(error, 'strerror', None) or error}"
    if fault:
        raise InputError(f"'{path}' {fault}")
    return path


def check_count(what: str, count: int) -> None:
    """Refuse more than `MAX_SAMPLES` samples, the most that are kept in memory."""
    if count > MAX_SAMPLES:
        raise InputError(f"'{what}' has {count:,} samples; allowed: at most {MAX_SAMPLES:,}")


def _chosen(
    found: Columns, column: str | int | None, role: str, most: int, default: int, other: int | None = None
) -> int:  # fmt: skip
    """Index of a column, which is not `other`; if none is given, the default in a table of at most `most` columns."""
    if column is not None:
        index = found.index(column)
        if index == other:
            raise InputError(f"'{found.file}': the column {column!r} is both time and value; allowed: two columns")
        return index
    if found.data.shape[1] > most:
        way = "name the column" if found.names else "the number of the column"
        raise InputError(f"'{found.file}' has {found.listed()}; allowed: {way} of the {role}")
    return default


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
    if size > 8 * MAX_SAMPLES:
        raise InputError(f"'{path}' unpacks to {size / 1e9:.3g} GB; allowed: at most {8e-9 * MAX_SAMPLES:g} GB")
    for name, array in loaded.items():
        if not isinstance(array, np.ndarray) or array.dtype.kind not in "iuf":
            kind = getattr(array, "dtype", "another kind")
            raise InputError(f"'{path}': the array {name!r} is of {kind}; allowed: real numbers")
        if array.ndim == 0 and name.lower() in _RATE_NAMES:
            rate = float(array)
        elif array.ndim == 1:
            arrays[name] = array.astype(float)
        else:
            problem = f"'{path}': the array {name!r} has shape {array.shape}"
            raise InputError(f"{problem}; allowed: one row a column, and one number named rate")
    lengths = {array.size for array in arrays.values()}
    if len(lengths) > 1:
        shown = ", ".join(f"{name} {array.size}" for name, array in arrays.items())
        raise InputError(f"'{path}' has arrays of different length ({shown}); allowed: one length")
    if not arrays or lengths == {0}:
        raise InputError(f"'{path}' holds no numbers")
    return Columns(path, tuple(arrays), np.column_stack(list(arrays.values()))), rate
