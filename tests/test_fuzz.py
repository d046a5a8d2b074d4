"""Any text input is accepted or refused in one sentence; and the fuzzer finds faults that are put in on purpose."""

import contextlib
import dataclasses
import os
import random
import subprocess
import sys
import time
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import fuzz
from deck_edits import evaluate
from fingerspice.base.errors import InputError, Where
from fingerspice.netlist.expressions import FUNCTIONS, compiled
from fingerspice.netlist.lexer import group, lex, logical_lines, split_lines
from scenes import cases

HERE = Where("deck.cir", 1)


def test_inputs_of_every_kind_are_taken_or_refused() -> None:
    report = fuzz.run(cases(20_000, 800))
    assert report.defects == []
    for name in fuzz.TARGETS:
        # A fuzzer whose inputs are all refused at the door reads nothing.
        assert report.counts[name, "taken"] > 0.1 * report.counts[name, "refused"]


class Unclear(fuzz.FingerspiceWarning, InputError):
    """A message of ours that its base has not made clear."""

    def __init__(self, message: str) -> None:
        self.message = message

    def __str__(self) -> str:
        return self.message


def raising(error: Exception) -> fuzz.Target:
    def target(rng: random.Random, bench: fuzz.Bench) -> None:
        raise error

    return target


def touching(do: Callable[[Path], object]) -> fuzz.Target:
    def target(rng: random.Random, bench: fuzz.Bench) -> None:
        with fuzz.WATCH.over(bench.folder):
            do(bench.folder)

    return target


CODE = compile("1+1", "<unknown>", "eval")
CLEAR_SCREEN = "\x1b[2J"
DEFECTS: dict[str, tuple[fuzz.Target, str]] = {
    "a traceback": (raising(KeyError("x")), "KeyError"),
    "numpy's own warning": (lambda rng, bench: np.array([1e308]) * 10.0, "RuntimeWarning: overflow"),
    "an empty message": (raising(Unclear(" ")), "no clear sentence"),
    "two lines": (raising(Unclear("one\ntwo")), "no clear sentence"),
    "a terminal's commands": (raising(Unclear("\x1b[31m")), "no clear sentence"),
    "an endless message": (raising(Unclear("x" * 5000)), "no clear sentence"),
    "a message of Python's": (raising(Unclear("Traceback (most recent call last)")), "no clear sentence"),
    "a file beside the folder": (touching(lambda folder: (folder / "../outside.lib").read_text()), "open"),
    "a link out of the folder": (touching(lambda folder: (folder / "link.lib").read_text()), "open"),
    "a file written": (touching(lambda folder: (folder / "part.lib").write_text("x")), "open"),
    "a folder listed": (touching(lambda folder: os.listdir("/")), "os.listdir"),
    "code evaluated": (touching(lambda folder: eval(CODE)), "exec"),
    "code compiled": (touching(lambda folder: compile("import os", "<unknown>", "exec")), "compile"),
    "a command": (touching(lambda folder: subprocess.run(["true"], check=True)), "subprocess"),
    "a gigabyte": (lambda rng, bench: np.zeros(8 * fuzz.ROOM * 2**20, np.uint8), "MemoryError"),
    "a warning that clears the screen": (
        lambda rng, bench: warnings.warn(Unclear(CLEAR_SCREEN), stacklevel=1),
        "no clear warning",
    ),
    "a title that clears the screen": (
        lambda rng, bench: fuzz._shown_well(dataclasses.replace(bench.circuit, title=CLEAR_SCREEN)),
        "not fit to be shown",
    ),
}


def test_every_planted_defect_is_caught() -> None:
    defects = fuzz.run(len(DEFECTS), targets={name: (target, 1) for name, (target, _) in DEFECTS.items()}).defects
    for number, (defect, (name, (_, says))) in enumerate(zip(defects, DEFECTS.items(), strict=True)):
        assert defect.startswith(f"--seed 0 --first {number} --inputs 1: {name}: ")
        assert says in defect


def test_an_input_without_an_end_is_caught(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fuzz, "SECONDS", 0.1)
    (defect,) = fuzz.run(1, targets={"endless": (lambda rng, bench: time.sleep(60), 1)}).defects
    assert "no answer after" in defect


def test_memory_that_is_kept_is_caught(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fuzz, "MEMORY", 5)
    kept: list[np.ndarray] = []
    report = fuzz.run(40, targets={"leak": (lambda rng, bench: kept.append(np.ones(2**20)), 1)})
    assert "MiB more memory" in report.defects[-1]


def test_reading_the_same_again_keeps_nothing() -> None:
    count = cases(400, 40)

    def blocks_after() -> int:
        fuzz.run(count, seed="again")
        compiled.cache_clear()
        fuzz.gc.collect()
        return sys.getallocatedblocks()

    blocks_after()
    first = blocks_after()
    assert blocks_after() < first + count


def test_an_input_is_the_same_every_time_and_alone() -> None:
    seen: list[float] = []
    targets: dict[str, tuple[fuzz.Target, int]] = {"note": (lambda rng, bench: seen.append(rng.random()), 1)}
    fuzz.run(5, "7", targets)
    fuzz.run(1, "7", targets, first=3)
    assert seen[5] == seen[3]
    assert len(set(seen)) == 5


# Where shrinking to the smallest example is worth more than many inputs.
many = settings(max_examples=cases(500, 60), deadline=None)


_NAME = st.text(st.characters(categories=["Lu", "Ll", "Lo", "Lm", "Nd", "Nl", "No", "Mn", "Pc"]), max_size=4).map(
    "a{}".format
)


@many
@given(_NAME, _NAME, st.sampled_from([*FUNCTIONS, "("]))
def test_names_in_any_alphabet_are_themselves(name: str, other: str, function: str) -> None:
    text = f"{name}+1" if function == "(" else f"{name}+0*{function}({other})"
    with contextlib.suppress(InputError):
        assert evaluate(text, {name: 2.0, other: 1.0}, HERE) in (2.0, 3.0, 1.0)


@many
@given(st.text(max_size=80))
def test_the_pieces_of_any_text_have_places_in_it(text: str) -> None:
    with contextlib.suppress(InputError):
        for line in logical_lines(split_lines(text), "deck.cir"):
            lexemes = lex(line)
            group(lexemes, probes=True)
            for lexeme in lexemes:
                where = lexeme.where
                written = split_lines(text)[where.line - 1][where.column - 1 :]
                assert lexeme.written[:1] == written[:1]


def test_the_fuzzer_is_a_command(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(sys, "argv", ["fuzz.py", "--inputs", "100", "--seed", "5"])
    assert fuzz.main() == 0
    assert "100 inputs in" in capsys.readouterr().out


@pytest.fixture(autouse=True)
def _leave_warnings_alone() -> None:
    warnings.simplefilter("ignore", fuzz.FingerspiceWarning)
