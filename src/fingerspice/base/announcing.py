"""Progress of what takes long: a bar on a terminal, one line elsewhere."""

from __future__ import annotations

import logging
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, ClassVar

_LOG = logging.getLogger("fingerspice")
#: What takes the compiler more than ten seconds, by function and class of its first argument: what it is, and the time
#: on one core of an x86-64 server of 2026.
LONG = {
    ("engine.collocation.loop.march_on", "OneArea"): "the steps of a series stack, about 20 s",
    ("engine.collocation.loop.march_on", "ManyAreas"): "the steps of a network, about 30 s",
    ("engine.lanes.loops.span", "StackMarks"): "the steps of a recording, about 10 s",
    ("engine.lanes.loops.span", "MobileMarks"): "the steps of a recording, about 10 s",
    ("engine.lanes.loops.span", "NetworkMarks"): "the steps of a recording in a network, about 20 s",
    ("engine.implicit.advance", "Nodal"): "implicit steps, about 15 s",
    ("engine.lockstep.march.march", ""): "scenes in lockstep, about 15 s",
}
NO_FOLDER = (
    "no folder for compiled code can be written, neither the package's nor the user's; set NUMBA_CACHE_DIR to one that "
    "can"
)


class Bar:
    """A progress bar on stderr, removed when stopped; none where stderr is no terminal.

    There is one bar at a time: an endless one, for an unknown amount of work, shows the time taken. It takes the place
    of any other, which comes back when it is shown next.
    """

    _standing: ClassVar[Bar | None] = None

    def __init__(self, what: str, *, endless: bool = False) -> None:
        self._what, self._endless = what, endless
        self._bar: Any = None

    def show(self, done: float = 0.0, note: str = "") -> None:
        """Show the bar with this fraction done, and a note behind it."""
        if self._bar is None:
            if not sys.stderr.isatty() or (Bar._standing is not None and not self._endless):
                return
            if Bar._standing is not None:
                Bar._standing.stop()
            from rich.console import Console
            from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

            # All of an endless bar's text has room in 80 columns.
            share = TimeElapsedColumn() if self._endless else TextColumn("{task.percentage:3.0f} %")
            bar = BarColumn(10 if self._endless else 40)
            columns = [TextColumn("{task.description}"), bar, share, TextColumn("{task.fields[note]}")]
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


@contextmanager
def paced(what: str, first: float = 0.0) -> Iterator[Callable[..., None]]:
    """A bar for work of which a share is done at first, shown after one second; gives what sets the share of now."""
    bar, begun = Bar(what), time.perf_counter()

    # `pace` gives the words for the pace from the seconds taken.
    def show(done: float, pace: Callable[[float], str] = lambda _: "") -> None:
        took = time.perf_counter() - begun
        if took > 1.0 and done > first and sys.stderr.isatty():
            minutes, seconds = divmod(int((1.0 - done) * took / (done - first)), 60)
            bar.show(done, f"{pace(took)} {minutes // 60:02}:{minutes % 60:02}:{seconds:02} left".strip())

    try:
        yield show
    finally:
        bar.stop()


class Compiling:
    """Announces that code is compiled: on a terminal by a bar each time, elsewhere by one line for each kind."""

    def __init__(self) -> None:
        self._depth = 0
        self._told: set[str] = set()
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

    def begins(self, function: str, kind: str, kept: bool, why: str = "") -> None:
        """Announce that a function is compiled, whose first argument is of this kind; whether that is kept, and why."""
        often = "only once: later runs find it on the disk" if kept else f"at every run: {NO_FOLDER}"
        text = f"compiling {LONG.get((function, kind), 'a small part, some seconds')}, {often}{why}"
        wanted = _LOG.level in (logging.NOTSET, logging.INFO)
        if wanted and self._bar is None and sys.stderr is not None and sys.stderr.isatty():
            self._bar = Bar(text.partition(":")[0], endless=True)
            self._bar.show()
        elif text not in self._told and self._bar is None:
            tell(text)
        self._told.add(text)


def tell(text: str) -> None:
    """Log one line, or write it to stderr where no logging was set up."""
    if _LOG.isEnabledFor(logging.INFO) and _LOG.hasHandlers():
        _LOG.info(text)
    elif _LOG.level == logging.NOTSET and sys.stderr is not None:
        sys.stderr.write(f"fingerspice: note: {text}\n")
        sys.stderr.flush()
