"""Bad input on the command line: one sentence on stderr, exit code 2, and no file written or left behind."""

import itertools
import os
import shlex
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from commands import Command, tree
from deck_edits import edited
from scenes import cases, listed

FINGERSPICE = str(Path(sys.executable).with_name("fingerspice"))


@pytest.fixture
def folder(command: Command, tmp_path: Path) -> Path:
    """The command's folder with every kind of file that is no deck."""
    (tmp_path / "folder").mkdir()
    (tmp_path / "file").write_text("")
    (tmp_path / "empty.cir").write_text("")
    (tmp_path / "binary.cir").write_bytes(b"title\n\0\1\2")
    (tmp_path / "latin.cir").write_bytes(b"title\nC1 a 0 1\x81\n")
    (tmp_path / "wrong.cir").write_text(edited(("d=1u", "d=-1u")))
    (tmp_path / "endless.cir").write_text(edited((".tran 10u 50m uic", "*")))
    (tmp_path / "deck.csv").write_text(edited())
    (tmp_path / f"{'y' * 248}.cir").write_text(edited())
    return tmp_path


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        *((["run", "pad.cir", "--out", "new", *words], said) for words, said in listed("options")),
        *listed("commands"),
        *listed("usage"),
    ],
    ids=lambda x: " ".join(x) if isinstance(x, list) else "",
)
def test_bad_input_gets_a_sentence_and_leaves_nothing(command, folder, arguments, said):
    before = tree(folder)
    result = command(*arguments)
    assert (result.code, result.out) == (2, "")
    if [arguments, said] in listed("usage"):
        assert said in result.err
        assert "--help" in result.err
    else:
        (line,) = [line for line in result.lines if not line.startswith("fingerspice: warning: Xskin takes its data")]
        assert line.startswith("fingerspice: ")
        assert said in line
    assert tree(folder) == before


def test_a_fault_of_the_program_is_a_sentence_with_its_place(command: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object, **__: object) -> None:
        raise errors.pop()

    monkeypatch.setattr("fingerspice.solve.simulation.simulate", fail)
    errors = [KeyboardInterrupt(), ZeroDivisionError("float division by zero"), MemoryError()]
    result = command("run", "pad.cir")
    said = "not enough memory; allowed: fewer outputs (a longer TSTEP, or TSTART), or a shorter run"
    assert (result.code, result.lines) == (2, [f"fingerspice: {said}"])
    result = command("run", "pad.cir")
    assert result.code == 1
    (line,) = result.lines
    assert line.startswith("fingerspice: this is a fault of fingerspice, please report it with the deck (ZeroDivision")
    assert "in test_cli_errors.py:" in line
    assert command("run", "pad.cir").code == 130
    assert set(tree(Path())) == {"pad.cir"}


@pytest.mark.parametrize(("words", "said"), listed("checked_first"))
def test_arguments_are_checked_before_files(command: Command, words: str, said: str) -> None:
    Path("out").mkdir()
    for end in (".nc", "_ac.csv", "_compare.png", "_limits.csv", "_capability.csv", "_drive.wav"):
        Path(f"out/pad{end}").write_text("of someone else")
    Path("wanted.csv").write_text("time (ms),friction (mN)\n" + "".join(f"{i},{170 + i % 7}\n" for i in range(9)))
    name, *options = words.split()
    result = command(name, *(["wanted.csv"] if name == "design" else []), "pad.cir", *options)
    assert (result.code, result.out) == (2, "")
    assert said in result.err


@pytest.mark.parametrize("out", ["/proc/new", "/proc", f"new/{'x' * 300}/y", "x/y"])
def test_a_folder_that_cannot_be_made_is_told(command, tmp_path, monkeypatch, out):
    if out.startswith("/proc") and not Path("/proc/self").exists():
        pytest.skip("this system has no /proc")
    monkeypatch.setattr("fingerspice.solve.simulation.simulate", lambda *a, **k: pytest.fail("it ran"))
    if out == "x/y":
        # Root may write anywhere, so the answer of the system is put in its mouth.
        monkeypatch.setattr("fingerspice.cli.options.os.access", lambda path, mode: not mode & os.W_OK)
    before = tree(tmp_path)
    result = command("run", "pad.cir", "--out", out).refused()
    assert f"cannot write {out}/pad.nc: " in result.err or "File name too long" in result.err
    if out == "x/y":
        said = "cannot write x/y/pad.nc: no permission in .; allowed: a folder that can be written"
        assert result.lines == [f"fingerspice: {said}"]
    assert tree(tmp_path) == before


def process(*arguments: str, folder: Path, **how: Any) -> subprocess.CompletedProcess[str]:
    return subprocess.run(arguments, cwd=folder, capture_output=True, text=True, timeout=60, **how)


def test_the_installed_command_exits_with_0_1_and_2(tmp_path: Path) -> None:
    (tmp_path / "pad.cir").write_text(edited())
    done = process(FINGERSPICE, "plan", "pad.cir", folder=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    run = (FINGERSPICE, "run", "pad.cir", "--no-plot", "--charge-law", "mobile", "--set", "Xgap.d=10n")
    failed = process(*run, folder=tmp_path)
    assert failed.returncode == 1
    assert "wrote out/pad.nc" in failed.stdout
    assert failed.stderr.startswith("fingerspice: stopped at t = ")
    wrong = process(FINGERSPICE, "run", "nothing.cir", folder=tmp_path)
    assert (wrong.returncode, wrong.stdout) == (2, "")
    for text in (failed.stderr, wrong.stderr):
        assert text.count("\n") == 1
        assert "Traceback" not in text


def test_an_encoding_without_the_letters_and_closed_streams_change_nothing(tmp_path: Path) -> None:
    (tmp_path / "µ.cir").write_text(edited(("Fingerpad", "Finger µ \x1b[31m \x07 漢 " + "x" * 100_000)), "utf-8")
    done = process(FINGERSPICE, "plan", "µ.cir", folder=tmp_path, env={**os.environ, "PYTHONIOENCODING": "ascii"})
    assert (done.returncode, done.stderr) == (0, "")
    assert len(done.stdout) < 1000
    assert done.stdout.startswith("Finger \\xb5 \\x1b[31m \\x07 \\u6f22 xxx")
    words = ("µ.cir", 0), ("none.cir", 2), ("--no", 2)
    streams = "0<&- 1>&- 2>&-", "1>&-", "2>&-", "0<&-"
    # Every stream and every outcome at least once.
    some = [(words[i % 3], closed) for i, closed in enumerate(streams)]
    for (word, code), closed in itertools.product(words, streams) if cases(1, 0) else some:
        command = f"{shlex.join([FINGERSPICE, 'plan', word])} {closed}"
        assert process("sh", "-c", command, folder=tmp_path).returncode == code
