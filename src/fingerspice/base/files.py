"""Files that are complete or absent (written aside, then renamed), and standard streams that can always be written."""

from __future__ import annotations

import csv
import io
import os
import sys
from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any

from fingerspice.base.errors import InputError

UNFINISHED = ".fingerspice-"  #: The beginning of temporary names.
_UNFINISHED: set[Path] = set()
_PIECE = 64 * 2**20


def write_aside(path: Path, write: Callable[[Path], object]) -> Path:
    """Call `write` with a temporary path in the same folder, then rename that file to `path`.

    Where `path` is a link the file that it names is replaced; a device is written directly. Refused are folders that
    cannot be written and full disks.
    """
    target = Path(os.path.realpath(path))
    temporary = target.parent / f"{UNFINISHED}{os.urandom(6).hex()}"
    hint = ""
    try:
        if path.exists() and not path.is_file():
            write(path)
            return path
        # Entered before the file exists, so that `discard_unfinished` finds it whenever a signal comes.
        _UNFINISHED.add(temporary)
        hint = "; allowed: a folder that can be written"
        target.parent.mkdir(parents=True, exist_ok=True)
        temporary.touch(exist_ok=False)
        hint = ""
        write(temporary)
        temporary.replace(target)
    except OSError as error:
        raise InputError(f"cannot write {path}: {error.strerror or error}{hint}") from None
    finally:
        _discard(temporary)
    return path


def write_csv(path: str | Path, header: Iterable[str], rows: Iterable[Iterable[object]]) -> Path:
    """As `write_aside`, a table as CSV; numbers have as many digits as it takes to read the same ones back."""

    def write(target: Path) -> None:
        with target.open("w", newline="", encoding="utf-8") as stream:
            writer = csv.writer(stream, lineterminator="\n")
            writer.writerow(header)
            writer.writerows(rows)

    return write_aside(Path(path), write)


def write_pieces(path: Path, data: memoryview) -> None:
    """Write bytes in pieces, since a Ctrl-C would have to wait for a single write of gigabytes."""
    with path.open("wb") as stream:
        for begin in range(0, data.nbytes, _PIECE):
            stream.write(data[begin : begin + _PIECE])


def write_durably(path: Path, content: bytes) -> None:
    """Replace a file as a whole: after a crash of the machine there is the old one or the new one."""

    def write(temporary: Path) -> None:
        temporary.write_bytes(content)
        settle_on_disk(temporary)

    write_aside(path, write)
    settle_on_disk(path.parent)


def settle_on_disk(path: Path) -> None:
    """Wait until a file, or the names in a folder, are on the disk."""
    number = os.open(path, os.O_RDONLY)
    try:
        os.fsync(number)
    finally:
        os.close(number)


def discard_unfinished() -> None:
    """Remove unfinished files, before the process ends."""
    for temporary in list(_UNFINISHED):
        _discard(temporary)


def _discard(temporary: Path) -> None:
    with suppress(OSError):  # Where the folder is gone, or is none, there is nothing to remove.
        temporary.unlink(missing_ok=True)
    _UNFINISHED.discard(temporary)


class _Raw(io.FileIO):
    """A stream whose reader may go away, after which writing to it does nothing and is no error."""

    def write(self, data: Any) -> int:
        try:
            return super().write(data)
        except OSError as error:
            # A failure to write to stderr is ignored; the caller has to report a full disk under stdout.
            if self.fileno() != 2 and not isinstance(error, BrokenPipeError):
                raise
            return len(data)


def mend_streams() -> None:
    """Make stdout and stderr writable for the rest of the process."""
    for number in (0, 1, 2):
        try:
            os.fstat(number)
        except OSError:
            # Opens the lowest free number, which is this one; else the first file opened would become this stream.
            os.open(os.devnull, os.O_RDWR)
    for number, name in ((1, "stdout"), (2, "stderr")):
        raw, encoding = _Raw(number, "w", closefd=False), getattr(getattr(sys, name), "encoding", None) or "utf-8"
        buffer, lines = io.BufferedWriter(raw), raw.isatty() or number == 2
        setattr(sys, name, io.TextIOWrapper(buffer, encoding, "backslashreplace", line_buffering=lines))
