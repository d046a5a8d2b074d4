"""Entry of the `fingerspice` command and of `python -m fingerspice`; it handles signals before loading anything."""

from __future__ import annotations

import gc
import os
import signal
from types import FrameType

from fingerspice.base.files import discard_unfinished, mend_streams

_STOPS = {signal.SIGINT: "interrupted", signal.SIGTERM: "terminated"}


def _stop(number: int, _: FrameType | None) -> None:
    """End the process at once: libraries would catch an exception in their callbacks."""
    discard_unfinished()
    # A progress bar may be shown on a terminal, with the cursor hidden.
    tidy = b"\r\x1b[K\x1b[?25h" if os.isatty(2) else b""
    text = f"fingerspice: {_STOPS[signal.Signals(number)]}; nothing half-written is left\n"
    try:
        os.write(2, tidy + text.encode())
    finally:
        os._exit(128 + number)


def main() -> None:
    """Run the command."""
    for number in _STOPS:
        # A signal that is ignored was switched off by whoever started this process, as nohup does.
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, _stop)
    mend_streams()
    from fingerspice.cli.app import main as command

    try:
        command()
    finally:
        # Everything has been written: a signal during the interpreter's shutdown is ignored.
        for number in _STOPS:
            signal.signal(number, signal.SIG_IGN)
        # Else the interpreter would look through a million objects for cycles before it ends, for a fifth of a run.
        gc.freeze()


if __name__ == "__main__":
    main()
