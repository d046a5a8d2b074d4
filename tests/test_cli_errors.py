"""Bad input on the command line: one sentence on stderr, exit code 2, and no file written or left behind."""

from __future__ import annotations

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
from scenes import cases

FINGERSPICE = str(Path(sys.executable).with_name("fingerspice"))

OPTIONS = [
    (["--set", "Xgap.d"], "--set 'Xgap.d' is not understood; allowed: PATH=VALUE, such as Xgap.d=3u"),
    (["--set", "=3u"], "--set '=3u' is not understood"),
    (["--set", "Xgap.d="], "--set 'Xgap.d=': Xgap.d: '' is not a number (examples: 10, 2.5, 1e-6, 3.5u, 0.2meg)"),
    (["--set", "Xgap.d=thick"], "--set 'Xgap.d=thick': Xgap.d: 'thick' is not a number"),
    (["--set", "Xgap.d=3x"], "--set 'Xgap.d=3x': Xgap.d: '3x' differs between simulators"),
    (["--set", "Xgap.d=nan"], "'nan' is not a number"),
    (["--set", "Xgap.d=inf"], "--set 'Xgap.d=inf': Xgap d is inf m; allowed: more than 0"),
    (["--set", "Xgap.d=-3u"], "--set 'Xgap.d=-3u': Xgap d is -3e-06 m; allowed: more than 0"),
    (["--set", "Xgap.dd=3u"], "unknown parameter 'Xgap.dd'; nearest: 'Xgap.d'"),
    (["--set", "gap.d=3u"], "unknown parameter 'gap.d'; nearest: 'Xgap.d'"),
    (["--set", "Vdrive.freq=3"], "unknown parameter 'Vdrive.freq'; nearest: 'Vdrive.frequency'"),
    (["--set", "Vdrive.frequency=0"], "--set 'Vdrive.frequency=0': sine frequency is 0 Hz; allowed: > 0"),
    (["--set", "Xgap.fn=0.5N"], "--set 'Xgap.fn=0.5N': Xgap.fn is '0.5N': SPICE reads N as nano"),
    (["--set", "Xgap.mu=2"], "--set 'Xgap.mu=2': Xgap has no contact"),
    (["--source", ""], "--source '': missing value"),
    (["--source", "SQUARE(200 100"], "--source 'SQUARE(200 100': '(' is never closed"),
    (["--source", "SQARE(200 100)"], "did you mean 'square'"),
    (["--source", "SQUARE(200)"], "SQUARE needs 2 values, 1 given; allowed: SQUARE(amplitude frequency duty)"),
    (["--source", "SQUARE(200 100)+1"], "a second value '+1'"),
    (["--source", "SIN(0 200 {f})"], "parameter 'f' is not defined"),
    (["--source", "PWL(0 0 2m 1 1m 2)"], "PWL times decrease: 0.001 s follows 0.002 s"),
    (["--source", "5\nR1 drive 0 1k"], "not one source"),
    (["--charge-law", "moble"], "charge_law is 'moble'; allowed: 'local' or 'mobile'"),
    (["--rtol", "0"], "rtol is 0.0; allowed: 1e-13 to 0.1"),
    (["--rtol", "nan"], "rtol is nan; allowed: 1e-13 to 0.1"),
    (["--method", "rk4"], "unknown method 'rk4'; allowed: auto, exponential, radau, scipy:NAME, torchdiffeq:NAME"),
    (["--method", "scipy:RK4"], "unknown method 'scipy:RK4'; allowed: scipy:RK23"),
    (["--set", "Vdrive.amplitude=1e99"], "Sine amplitude is 1e+99 V; allowed: a size up to 1e+12"),
    (["--source", "SIN(0 1e-320 100)"], "the source's peak is 9.99989e-321 V; allowed: 0, or 1e-300 V or more"),
    (["--source", "PULSE(0 1 0 1e-300 1e-300 1e-300 1e-299)"], "Pulse rise is 1e-300 s; allowed: 0, or a size from"),
    (["--source", "SIN(0 200 1e300)"], "Sine frequency is 1e+300 Hz; allowed: 0, or a size from 1e-30 to 1e+30"),
    (["--stop", "soon"], "--stop 'soon': 'soon' is not a number"),
    (["--stop", "1u"], "--stop 1e-06 s is before the second output; allowed: TSTART + TSTEP = 5e-05 s or more"),
    (["--source", "Vdriv=DC 5"], "--source 'Vdriv=DC 5': Vdriv is not a source of the circuit; allowed: Vdrive"),
    (["--source", "DC 5", "--source", "vdrive=DC 6"], "--source 'vdrive=DC 6': vdrive is given twice"),
    (["--stop", "-1"], "--stop -1 s; allowed: more than 0 s"),
    (["--start", "1"], "--start 1 s; allowed: from 0 s to less than the end, 0.02 s"),
    (["--start", "-1m"], "--start -0.001 s; allowed: from 0 s to less than the end"),
    (["--start", "20m", "--stop", "20m"], "--start 0.02 s; allowed: from 0 s to less than the end, 0.02 s"),
    (["--start", "2q"], "--start '2q'"),
    (["--source", "WAV(no.wav gain=1)"], "'no.wav' does not exist"),
    (["--start", "warm"], "start is 'warm'; allowed: 'deck', 'uncharged', 'dc', 'periodic' or a Solution"),
    (["--area", "frozn"], "area is 'frozn'; allowed: 'coupled', 'mean', 'frozen' or m^2"),
    (["--area", "-1u"], "area is -1e-06 m^2; allowed: a positive area in m^2"),
    (["--area", "nan"], "area is 'nan'; allowed"),
]

OTHERS = [
    (["run", "missing.cir"], "'missing.cir' does not exist"),
    (["run", "pat.cir"], "'pat.cir' does not exist; did you mean 'pad.cir'?"),
    (["run", "folder"], "'folder' is a folder, not a file"),
    (["run", "/proc/self/mem"], "'/proc/self/mem' cannot be read: Input/output error"),
    (["ac", "empty.cir"], "'empty.cir' is empty: a netlist begins with a title line"),
    (["compare", "binary.cir"], "'binary.cir' is not a text file (it holds NUL bytes): save it as UTF-8"),
    (["export", "latin.cir", "-o", "x.cir"], "'latin.cir' is neither UTF-8 nor Latin-1 text (byte 0x81 in line 2)"),
    (["run", "wrong.cir"], "wrong.cir:4:30: Xcoat d is -1u (-1e-06 m); allowed: more than 0"),
    (["run", "endless.cir"], "endless.cir has no .tran line; allowed: .tran TSTEP TSTOP"),
    (["run", "pad.cir", "--out", "file"], "cannot write file/pad.nc: file is not a folder; allowed: a folder"),
    (["run", "pad.cir", "--out", "file/deeper"], "cannot write file/deeper/pad.nc: file is not a folder"),
    (["ac", "pad.cir", "--out", "file"], "cannot write file/pad_ac.csv: file is not a folder"),
    (["compare", "pad.cir", "--out", "file"], "cannot write file/pad_compare.png: file is not a folder"),
    (["export", "pad.cir", "-o", "file/x.cir"], "cannot write file/x.cir: file is not a folder"),
    (["export", "pad.cir", "-o", "folder"], "cannot write folder: it is a folder; allowed: a file's name"),
    (["export", "pad.cir", "-o", "./folder/../pad.cir"], "it is the deck itself; allowed: another name or folder"),
    (["run", "deck.csv", "--csv", "--out", "."], "cannot write deck.csv: it is the deck itself"),
    (["export", "pad.cir", "-o", "x.cir", "--charge-law", "both"], "charge_law is 'both'"),
    (["ac", "pad.cir", "--sweep", "dec 10 10"], "--sweep 'dec 10 10': '.ac dec 10 10' is not understood; allowed: .ac"),
    (["ac", "pad.cir", "--sweep", ""], "--sweep '': '.ac' is not understood"),
    (["ac", "pad.cir", "--sweep", "lin 5 10 1"], "FSTOP is 1; allowed: at least FSTART = 10"),
    (["ac", "pad.cir", "--area", "couple"], "area is 'couple'; allowed: 'mean', 'frozen' or a number in m^2"),
    (["ac", "pad.cir", "--amplitude", "50"], "--amplitude goes with --area coupled, not with --area mean"),
    (["ac", "pad.cir", "--area", "coupled", "--amplitude", "-5"], "allowed: positive numbers"),
    (["ac", "pad.cir", "--sweep", "dec 1 1e-300 1e300"], "FSTART is 1e-300; allowed: 1e-30 to 1e30 Hz"),
    (["ac", "pad.cir", "--sweep", "dec 1000000 1 100k"], "at most 1e6 frequencies in a sweep, here 5e+06"),
    (["limits", "pad.cir", "--span", "inf"], "span is inf; allowed: more than 1, at most 1e6"),
    (["limits", "pad.cir", "--points", "1000000000"], "points is 1000000000; allowed: 3 to 1000"),
    (["plan", "pad.cir", "--rtol", "nan"], "rtol is nan; allowed: 1e-13 to 0.1"),
    (["plan", "pad.cir", "--rtol", "-1"], "rtol is -1.0; allowed: 1e-13 to 0.1"),
    (["run", "x" * 300], "cannot be read: File name too long"),
    (["run", "pad.cir", "--out", "x" * 300], ".nc: File name too long; allowed: a folder that can be written"),
    (["export", "pad.cir", "-o", "x" * 300], "File name too long; allowed: a folder that can be written"),
    (["limits", f"{'y' * 248}.cir"], "_limits.csv: File name too long; allowed: a folder that can be written"),
    (["plan", "pad.cir", "--area", "frozn"], "area is 'frozn'; allowed: 'coupled', 'mean', 'frozen' or m^2"),
    (["ac", "pad.cir", "--source", "DC 5"], "area='mean' needs the amplitude of the source's fundamental"),
    (["compare", "pad.cir", "--source", "DC 5"], "compare needs a source with a fundamental"),
    (["figures", "--only", "9"], "figure is 9; allowed: 2, 3, 4, 5"),
]

USAGE = [
    (["run"], "Missing argument 'DECK'"), (["export", "pad.cir"], "Missing option '--output'"),
    (["rnu", "pad.cir"], "No such command 'rnu'"), (["run", "pad.cir", "--plott"], "No such option"),
    (["run", "pad.cir", "pad.cir"], "unexpected extra argument"), (["run", "pad.cir", "--rtol", "small"], "--rtol"),
    (["figures", "--only", "two"], "--only"),
]  # fmt: skip


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
    [*((["run", "pad.cir", "--out", "new", *words], said) for words, said in OPTIONS), *OTHERS, *USAGE],
    ids=lambda x: " ".join(x) if isinstance(x, list) else "",
)
def test_bad_input_gets_a_sentence_and_leaves_nothing(
    command: Command, folder: Path, arguments: list[str], said: str
) -> None:
    before = tree(folder)
    result = command(*arguments)
    assert (result.code, result.out) == (2, "")
    if (arguments, said) in USAGE:
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


CHECKED_FIRST = [
    ("run --rtol 7", "rtol is 7.0; allowed"), ("run --method rk4", "unknown method 'rk4'"),
    ("run --area frozn", "area is 'frozn'"), ("run --start warm", "start is 'warm'"),
    ("run --jumps no", "jumps is 'no'"), ("run --stream --netcdf --rtol 7", "rtol is 7.0; allowed"),
    ("run --stream --netcdf --chunk soon", "--chunk 'soon'"), ("ac --rtol 7 --area coupled", "rtol is 7.0; allowed"),
    ("ac --area frozn", "area is 'frozn'"), ("ac --sweep dec", "--sweep 'dec'"),
    ("ac --amplitude 5", "--amplitude goes with --area coupled"), ("compare --rtol 7", "rtol is 7.0; allowed"),
    ("ac --area coupled --amplitude -5", "amplitude is [-5.0] V; allowed: positive"),
    ("limits --points 1", "points is 1; allowed: 3 to 1000"),
    ("limits --span 0.5", "span is 0.5; allowed: more than 1"),
    ("limits --capability --carrier -5", "--carrier is -5; allowed: > 0"),
    ("design --limit -3", "--limit is -3; allowed: > 0"),
]  # fmt: skip


@pytest.mark.parametrize(("words", "said"), CHECKED_FIRST)
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
def test_a_folder_that_cannot_be_made_is_told(
    command: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, out: str
) -> None:
    if out.startswith("/proc") and not Path("/proc/self").exists():
        pytest.skip("this system has no /proc")
    monkeypatch.setattr("fingerspice.solve.simulation.simulate", lambda *a, **k: pytest.fail("it ran"))
    if out == "x/y":
        # Root may write anywhere, so the answer of the system is put in its mouth.
        monkeypatch.setattr("fingerspice.cli.options.os.access", lambda path, mode: not mode & os.W_OK)
    before = tree(tmp_path)
    result = command("run", "pad.cir", "--out", out)
    assert result.code == 2
    assert f"cannot write {out}/pad.nc: " in result.err or "File name too long" in result.err
    if out == "x/y":
        said = "cannot write x/y/pad.nc: no permission in .; allowed: a folder that can be written"
        assert result.lines == [f"fingerspice: {said}"]
    assert tree(tmp_path) == before


# The command itself, in its own process


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
