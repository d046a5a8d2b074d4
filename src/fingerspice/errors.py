"""The two ways a request can fail: the input is wrong, or the solve did not finish."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from fingerspice.outcome import Failure
    from fingerspice.solution import Solution


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
        message = self.message = _shown(message)
        self.where = where
        super().__init__(f"{where}: {message}" if where else message)


def _shown(message: str) -> str:
    """A message with control characters escaped, and of bounded length."""
    if len(message) > LONGEST_MESSAGE:
        message = f"{message[: LONGEST_MESSAGE // 2]} ... {message[-LONGEST_MESSAGE // 4 :]}"
    if message.isprintable():
        return message
    return "".join(c if c.isprintable() else repr(c)[1:-1] for c in message)


class SolveError(FingerspiceError, RuntimeError):
    """The solve did not reach its end: `failure` says why, when and where, `solution` holds what came before."""

    def __init__(self, failure: Failure, solution: Solution | None = None) -> None:
        self.failure = failure
        self.message = str(failure)
        self.solution = solution
        super().__init__(self.message)


class FingerspiceWarning(UserWarning):
    """Something in the input is legal but probably not what was meant."""
