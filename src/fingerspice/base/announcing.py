"""Progress of what takes long: a bar on a terminal, one line elsewhere."""

from __future__ import annotations

import logging
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, ClassVar

_LOG = logging.getLogger("fingerspice")


class Bar:
    """A progress bar on stderr, removed when stopped; none where stderr is no terminal, or another bar is shown.

    Parameters
    ----------
    what : str
        Description of the work.
    endless : bool
        Whether the amount of work is unknown, so that the bar shows the time taken.
    """

    _standing: ClassVar[Bar | None] = None

    def __init__(self, what: str, *, endless: bool = False) -> None:
        self._what, self._endless = what, endless
        self._bar: Any = None

    def show(self, done: float = 0.0, note: str = "") -> None:
        """Show the bar with this fraction done, and a note behind it."""
        if self._bar is None:
            if Bar._standing is not None or not sys.stderr.isatty():
                return
            from rich.console import Console
            from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

            share = TimeElapsedColumn() if self._endless else TextColumn("{task.percentage:3.0f} %")
            columns = [TextColumn("{task.description}"), BarColumn(), share, TextColumn("{task.fields[note]}")]
            self._bar = Progress(*columns, console=Console(stderr=True), transient=True)
            self._bar.add_task(self._what, total=None if self._endless else 1.0, note="")
            self._bar.start()
            Bar._standing = self
        self._bar.update(self._bar.task_ids[0], completed=done, note=note)

    def stop(self) -> None:
        """Remove the bar."""
        if self._bar is not None:
            self._bar.stop()
            self._bar, Bar._standing = None, None


class Compiling:
    """Announces that code is compiled: on a terminal by a bar each time, elsewhere by one line in a process."""

    def __init__(self) -> None:
        self._depth, self._told = 0, False
        self._bar: Bar | None = None

    @contextmanager
    def around(self) -> Iterator[None]:
        """Context of whatever may compile; contexts nest, as compiling a function compiles those that it calls."""
        self._depth += 1
        try:
            yield
        finally:
            self._depth -= 1
            if self._depth == 0 and self._bar is not None:
                self._bar.stop()
                self._bar = None

    def begins(self, text: str) -> None:
        """Announce that something is compiled."""
        wanted = _LOG.level in (logging.NOTSET, logging.INFO)
        if wanted and self._bar is None and sys.stderr is not None and sys.stderr.isatty():
            self._bar = Bar(text, endless=True)
            self._bar.show()
        elif not self._told and self._bar is None:
            _tell(text)
        self._told = True


def _tell(text: str) -> None:
    """Log one line, or write it to stderr where no logging was set up."""
    if _LOG.isEnabledFor(logging.INFO) and _LOG.hasHandlers():
        _LOG.info(text)
    elif _LOG.level == logging.NOTSET and sys.stderr is not None:
        sys.stderr.write(f"fingerspice: note: {text}\n")
        sys.stderr.flush()
