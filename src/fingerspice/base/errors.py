"""The two ways a request can fail: the input is wrong, or the solve did not finish."""

from __future__ import annotations

from dataclasses import dataclass

#: Characters of a message; of a longer one, which holds a long text of the user's, the middle is left out.
LONGEST_MESSAGE = 1000


@dataclass(frozen=True)
class Where:
    """A place in a netlist: file name as shown to the user, line and column (both from 1)."""

    file: str
    line: int
    column: int = 1

    def __str__(self) -> str:
        return f"{self.file}:{self.line}:{self.column}"


class FingerspiceError(Exception):
    """Base of every error this package raises on purpose."""


class InputError(FingerspiceError, ValueError):
    """The input is wrong: what is wrong, what was given, what is allowed, and where.

    Parameters
    ----------
    message : str
        One clear sentence; whatever was given and stands in it, the error's own is short and printable.
    where : Where, optional
        The place in the netlist, where there is one.
    """

    def __init__(self, message: str, where: Where | None = None) -> None:
        message = self.message = printable(message)
        self.where = where
        super().__init__(printable(f"{where}: {message}") if where else message)


def printable(text: str, longest: int = LONGEST_MESSAGE) -> str:
    """One line that may be shown whoever wrote it: control characters escaped, the middle of a long text left out."""
    # Cut first, so that little is escaped, and again, as what is escaped is longer.
    text = _shortened(text, longest)
    if text.isprintable():
        return text
    return _shortened("".join(c if c.isprintable() else repr(c)[1:-1] for c in text), longest)


def _shortened(text: str, longest: int) -> str:
    return text if len(text) <= longest else f"{text[: longest // 2]} ... {text[-(longest // 4) :]}"


class FingerspiceWarning(UserWarning):
    """Something in the input is legal but probably not what was meant."""

    def __init__(self, message: str) -> None:
        super().__init__(printable(message))
