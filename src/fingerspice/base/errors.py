"""Errors of wrong input, with their place in a netlist, and warnings.

The other error that users meet, of a solve that did not reach its end, is `fingerspice.results.outcome.SolveError`.
"""

from __future__ import annotations

from dataclasses import dataclass

#: Characters of a message; the middle of a longer one, which contains a long text of the user, is left out.
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
    """Base of every error that this package raises on purpose."""


class InputError(FingerspiceError, ValueError):
    """The input is wrong: what is wrong, what was given, what is allowed, and where.

    Parameters
    ----------
    message : str
        One sentence. The error's own `message` is shortened and printable, whatever the text of the user in it.
    where : Where, optional
        Place in the netlist, where it has one.
    """

    def __init__(self, message: str, where: Where | None = None) -> None:
        message = self.message = printable(message)
        self.where = where
        super().__init__(printable(f"{where}: {message}") if where else message)


def printable(text: str, longest: int = LONGEST_MESSAGE) -> str:
    """One line that is safe to show: control characters are escaped, and the middle of a long text is left out."""
    # Shortened before escaping, which then has little to do, and after it, since it lengthens the text.
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
