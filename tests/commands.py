"""Runs `fingerspice ARGUMENTS` in this process, for the tests of the command line."""

import json
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from fingerspice.cli import app as cli

QUICK = (".tran 10u 50m uic", ".tran 50u 20m uic")
"""A change of `deck_edits.DECK` to two periods."""


@dataclass(frozen=True)
class Result:
    """Exit code and what was printed."""

    code: int
    out: str
    err: str

    @property
    def lines(self) -> list[str]:
        """Lines on stderr, without those about compilation, which depend on the tests before."""
        return [line for line in self.err.splitlines() if ": note: compiling" not in line]

    @property
    def json(self) -> Any:
        """What a command with `--json` has printed."""
        return json.loads(self.out)

    def ok(self) -> "Result":
        """Itself, of a command that succeeded."""
        assert self.code == 0, self.err
        return self

    def refused(self, *said: str) -> "Result":
        """Itself, of a command whose request was refused with all these words on stderr."""
        assert self.code == 2, self.err
        assert [words for words in said if words not in self.err] == []
        return self


Command = Callable[..., Result]


def run_here(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], *arguments: str) -> Result:
    """Run the command in this process; whatever escapes it as an exception fails the test."""
    monkeypatch.setattr(sys, "argv", ["fingerspice", *arguments])
    capsys.readouterr()
    with pytest.raises(SystemExit) as exit_:
        cli.main()
    captured = capsys.readouterr()
    code = exit_.value.code
    assert isinstance(code, int)
    return Result(code, captured.out, captured.err)


def tree(folder: Path) -> dict[str, bytes | None]:
    """Every file under a folder with its content, hidden ones too, and every folder."""
    return {str(p.relative_to(folder)): p.read_bytes() if p.is_file() else None for p in folder.rglob("*")}
