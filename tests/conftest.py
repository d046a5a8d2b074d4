"""Fixtures that more than one file uses."""

from __future__ import annotations

import gc
from collections.abc import Iterator
from pathlib import Path

import pytest

from commands import QUICK, Command, run_here
from deck_edits import edited


@pytest.fixture
def command(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> Iterator[Command]:
    """`fingerspice ARGUMENTS` in an empty folder with the deck `pad.cir`."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "120")
    Path("pad.cir").write_text(edited(QUICK))
    threshold = gc.get_threshold()
    yield lambda *arguments: run_here(monkeypatch, capsys, *arguments)
    gc.set_threshold(*threshold)
