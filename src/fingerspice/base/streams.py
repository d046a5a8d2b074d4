"""Standard streams that hold whatever is done to them: closed, a pipe without a reader, an encoding without µ."""

from __future__ import annotations

import io
import os
import sys
from typing import Any


class _Raw(io.FileIO):
    """A stream to a reader that may go: what is written then is gone too, and no error."""

    def write(self, data: Any) -> int:
        try:
            return super().write(data)
        except BrokenPipeError:
            return len(data)
        except OSError:
            # Of what stderr says nothing depends on; a full disk under stdout is for the caller to tell.
            if self.fileno() != 2:
                raise
            return len(data)


def mend_streams() -> None:
    """Make stdout and stderr writable for the rest of the process."""
    for number in (0, 1, 2):
        try:
            os.fstat(number)
        except OSError:
            # The lowest number that is free, which is this one: else the first file opened would become a stream.
            os.open(os.devnull, os.O_RDWR)
    sys.stdout = _mended(sys.stdout, 1)
    sys.stderr = _mended(sys.stderr, 2)


def _mended(stream: Any, number: int) -> io.TextIOWrapper:
    raw = _Raw(number, "w", closefd=False)
    return io.TextIOWrapper(
        io.BufferedWriter(raw), encoding=getattr(stream, "encoding", None) or "utf-8", errors="backslashreplace",
        line_buffering=raw.isatty() or number == 2,
    )  # fmt: skip
