"""What the command line prints: nothing that a deck could turn against the terminal, and no traceback."""

from __future__ import annotations

import json
import logging
import math
import os
import sys
import time
import traceback
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NoReturn

from fingerspice.base.announcing import Bar
from fingerspice.base.errors import FingerspiceWarning, InputError, printable
from fingerspice.cli.answers import OWN, blank
from fingerspice.results.outcome import SolveError

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
    except Exception as error:
        _fail(said_of(error), 2 if is_input(error) else 1)


def is_input(error: Exception) -> bool:
    """Whether it is the input, or what it asks for, that has to change."""
    return isinstance(error, (InputError, MemoryError))


def said_of(error: Exception) -> str:
    """An error in one sentence."""
    if isinstance(error, (InputError, SolveError)):
        return str(error)
    if isinstance(error, MemoryError):
        return "not enough memory; allowed: fewer outputs (a longer TSTEP, or TSTART), or a shorter run"
    place = traceback.extract_tb(error.__traceback__)[-1]
    said = f"{type(error).__name__} in {Path(place.filename).name}:{place.lineno}, {error}"
    return f"this is a fault of fingerspice, please report it with the deck ({said})"


def _fail(message: str, code: int) -> NoReturn:
    complain(message)
    raise SystemExit(code)


class Answering:
    """One command's answer: gathered on the way, said at its end in the language asked for.

    Used as a context: warnings become lines on stderr, each once, and part of the answer; where JSON is wanted it is
    printed however the command ends.

    Parameters
    ----------
    command : str
    as_json : bool
    known : any
        What the answer holds from the start.
    """

    def __init__(self, command: str, as_json: bool, **known: Any) -> None:
        self.as_json = as_json
        self.data = {**blank(command), **known}
        self._warnings = warnings.catch_warnings()

    def __enter__(self) -> Answering:
        self._warnings.__enter__()
        warnings.simplefilter("always", FingerspiceWarning)
        warnings.showwarning = self._show
        return self

    def _show(self, message: Warning | str, category: type[Warning], *_: Any, **__: Any) -> None:
        text = str(message)
        if text not in self.data["warnings"]:
            self.data["warnings"].append(text)
            complain(f"warning: {text}")

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: Any) -> None:
        self._warnings.__exit__(kind, error, None)
        if not self.as_json or not (error is None or isinstance(error, Exception)):
            return
        if error is None:
            self.data.update(success=True, status="SUCCESS", message="success")
        elif isinstance(error, SolveError):
            failure = error.failure
            self.data.update(status=failure.status.name, message=error.message, failure=failure.to_dict())
        else:
            self.data.update(status="BAD_INPUT" if is_input(error) else "FAULT", message=said_of(error))
        say_json(self.data)

    def update(self, **found: Any) -> None:
        """Add what was found."""
        self.data.update(found)

    def give(self, text: Callable[[], str], writes: Sequence[Write] = ()) -> None:
        """Write files, then say in words what was found, and where JSON is not wanted instead.

        Where a file cannot be written, what was found is said all the same, and then why the file is missing.

        Parameters
        ----------
        text : callable
            What was found.
        writes : sequence of callable
            Each writes a file and returns its path.

        Raises
        ------
        InputError
            Where a file cannot be written.
        """
        files: list[str] = self.data["files"]
        failed = None
        try:
            for write in writes:
                files.append(str(write()))
        except InputError as error:
            failed = error
        said = [*filter(None, [text()]), *(f"wrote {file}" for file in files)]
        if said and not self.as_json:
            say("\n".join(said))
        if failed is not None:
            raise failed


def answer_usage(message: str) -> None:
    """The answer to a command line that is none, where it asks for JSON."""
    words = sys.argv[1:]
    if "--json" in words:
        command = next((word for word in words if word in OWN), None)
        say_json({**blank(command), "status": "BAD_INPUT", "message": message})


@contextmanager
def progress(what: str = "simulating") -> Iterator[Callable[[float], None] | None]:
    """A bar on a terminal, shown only once what is done takes more than a second."""
    if not sys.stderr.isatty():
        yield None
        return
    bar = Bar(what)
    begin = time.perf_counter()

    def update(done: float) -> None:
        if time.perf_counter() - begin > 1.0:
            bar.show(done)

    try:
        yield update
    finally:
        bar.stop()
