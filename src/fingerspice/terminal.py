"""What the command line prints: nothing that a deck could turn against the terminal, and no traceback."""

from __future__ import annotations

import json
import logging
import math
import os
import sys
import traceback
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NoReturn

from fingerspice.errors import FingerspiceWarning, InputError, SolveError, printable

#: Characters of a printed line; of a longer one the middle is left out.
LONGEST_LINE = 2000
Report = dict[str, Any]
Write = Callable[[], Path]


def json_text(data: Report) -> str:
    """JSON with null for what is not a number: NaN is no JSON."""

    def clean(x: Any) -> Any:
        if isinstance(x, dict):
            return {k: clean(v) for k, v in x.items()}
        if isinstance(x, list | tuple):
            return [clean(v) for v in x]
        return None if isinstance(x, float) and not math.isfinite(x) else x

    return json.dumps(clean(data), indent=2, allow_nan=False)


def say(text: str = "", end: str = "\n") -> None:
    """Print lines of text, whoever wrote them."""
    _print("\n".join(printable(line, LONGEST_LINE) for line in text.split("\n")), end)


def say_json(data: Report) -> None:
    """Print data as JSON, in which nothing but ASCII stands."""
    _print(json_text(data), "\n")


def _print(text: str, end: str) -> None:
    """Print, and know that it has arrived: a full disk is bad input, a reader (head, less) that has gone is nothing."""
    try:
        print(text, end=end, flush=True)
    except OSError as error:
        # Python would try again at its end, and complain.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        if not isinstance(error, BrokenPipeError):
            raise InputError(f"cannot write to the standard output: {error.strerror}") from None


def complain(text: str) -> None:
    """A line on stderr; that nobody reads it changes nothing."""
    try:
        print(f"fingerspice: {printable(text, LONGEST_LINE)}", file=sys.stderr, flush=True)
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stderr.fileno())


class _Notes(logging.Handler):
    """What the package logs (that it compiles, and where it could not keep what it compiled), as lines on stderr."""

    def emit(self, record: logging.LogRecord) -> None:
        complain(f"note: {record.getMessage()}")


_NOTES = _Notes()


def listen() -> None:
    """Show what the package logs."""
    logger = logging.getLogger("fingerspice")
    logger.setLevel(logging.INFO)
    logger.addHandler(_NOTES)


@contextmanager
def plain_errors() -> Iterator[None]:
    """One sentence instead of a traceback, and the exit code that says which kind."""
    try:
        yield
    except InputError as error:
        _fail(str(error), 2)
    except SolveError as error:
        _fail(str(error), 1)
    except MemoryError:
        _fail("not enough memory; allowed: fewer outputs (a longer TSTEP, or TSTART), or a shorter run", 2)
    except Exception as error:
        place = traceback.extract_tb(error.__traceback__)[-1]
        said = f"{type(error).__name__} in {Path(place.filename).name}:{place.lineno}, {error}"
        _fail(f"this is a fault of fingerspice, please report it with the deck ({said})", 1)


def _fail(message: str, code: int) -> NoReturn:
    complain(message)
    raise SystemExit(code)


def report(as_json: bool, figures: Callable[[], Report], text: Callable[[], str], writes: Sequence[Write]) -> None:
    """Write what a command found, then say it in the language asked for.

    Where a file cannot be written, what was found is said all the same, and then why the file is missing.

    Parameters
    ----------
    as_json : bool
    figures, text : callable
        What was found, as data and in words.
    writes : sequence of callable
        Each writes a file and returns its path.

    Raises
    ------
    InputError
        Where a file cannot be written.
    """
    files: list[Path] = []
    failed = None
    try:
        for write in writes:
            files.append(write())
    except InputError as error:
        failed = error
    if as_json:
        say_json({**figures(), "files": [str(f) for f in files]})
    else:
        say("\n".join([text(), *(f"wrote {f}" for f in files)]))
    if failed is not None:
        raise failed


@contextmanager
def warnings_as_lines() -> Iterator[None]:
    """Our own warnings as plain lines on stderr, each once."""
    with warnings.catch_warnings():
        warnings.simplefilter("always", FingerspiceWarning)
        seen: set[str] = set()

        def show(message: Warning | str, category: type[Warning], *_: Any, **__: Any) -> None:
            text = str(message)
            if text not in seen:
                seen.add(text)
                complain(f"warning: {text}")

        warnings.showwarning = show
        yield


@contextmanager
def failure_as_json(wanted: bool) -> Iterator[None]:
    """A failed solve as JSON too, where that is the language spoken."""
    try:
        yield
    except SolveError as error:
        if wanted:
            say_json({"success": False, "message": error.message, "failure": error.failure.to_dict()})
        raise


@contextmanager
def progress() -> Iterator[Callable[[float], None] | None]:
    """A bar on a terminal, shown only once a run takes more than a second."""
    if not sys.stderr.isatty():
        yield None
        return
    import time

    from rich.console import Console
    from rich.progress import Progress

    bar = Progress(console=Console(stderr=True), transient=True)
    begin = time.perf_counter()
    task = bar.add_task("simulating", total=1.0)

    def update(done: float) -> None:
        if time.perf_counter() - begin > 1.0:
            if not bar.live.is_started:
                bar.start()
            bar.update(task, completed=done)

    try:
        yield update
    finally:
        if bar.live.is_started:
            bar.stop()
