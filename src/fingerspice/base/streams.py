"""Standard streams that can be written in any case: closed, a pipe without reader, an encoding without µ."""

from __future__ import annotations

import io
import os
import sys
from typing import Any


class _Raw(io.FileIO):
    """A stream whose reader may go away, after which writing to it does nothing and is no error."""

    def write(self, data: Any) -> int:
        try:
            return super().write(data)
        except BrokenPipeError:
            return len(data)
        except OSError:
            # A failure to write to stderr is ignored; the caller has to report a full disk under stdout.
            if self.fileno() != 2:
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
    sys.stdout = _mended(sys.stdout, 1)
    sys.stderr = _mended(sys.stderr, 2)


def _mended(stream: Any, number: int) -> io.TextIOWrapper:
    raw = _Raw(number, "w", closefd=False)
    return io.TextIOWrapper(
        io.BufferedWriter(raw), encoding=getattr(stream, "encoding", None) or "utf-8", errors="backslashreplace",
        line_buffering=raw.isatty() or number == 2,
    )  # fmt: skip
