"""Kills, interrupts, full disks and closed pipes: files are complete or absent, exit codes are right, reruns work."""

import importlib
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

import fingerspice as fs
from commands import QUICK, Command
from deck_edits import edited
from fingerspice.base.files import write_aside
from processes import ended, no_room_here, start
from scenes import CIRCUITS, cases, listed, refuses

COMMANDS = dict(listed("interrupted"))
# The command, with what ends it just where it would hurt: PLACE is patched to strike when called for the N-th time.
STRUCK = """
import os, pathlib, sys
from fingerspice.base import files
from fingerspice.__main__ import main
place, count, number = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
sys.argv[1:4] = []
owner = files if place == "write_pieces" else pathlib.Path
calls, original = [], getattr(owner, place)
def strike(self, *arguments):
    calls.append(1)
    if len(calls) == count:
        if place == "write_pieces":
            original(self, arguments[0][:1000])
        os.kill(os.getpid(), number)
    return original(self, *arguments)
setattr(owner, place, strike)
main()
"""
BROKEN_OFF = {signal.SIGINT: (130, "interrupted"), signal.SIGTERM: (143, "terminated")}
CAUGHT = "SigCgt:"

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="faults are made by Linux's means")


def written(folder: Path) -> dict[str, bytes]:
    return {p.name: p.read_bytes() for p in folder.iterdir()} if folder.is_dir() else {}


def minded(process: subprocess.Popen[str]) -> None:
    """Wait until the command minds signals: before, they are Python's, which has just begun."""
    while process.poll() is None:
        status = Path(f"/proc/{process.pid}/status").read_text()
        caught = int(next(line for line in status.splitlines() if line.startswith(CAUGHT)).split()[1], 16)
        if caught >> (signal.SIGTERM - 1) & 1:
            return
        time.sleep(0.002)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "pad.cir").write_text(edited(QUICK))
    return tmp_path


@pytest.fixture(scope="module")
def right(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """What `run` writes when nothing disturbs it."""
    return undisturbed("run", tmp_path_factory.mktemp("undisturbed"))


def undisturbed(name: str, folder: Path) -> dict[str, bytes]:
    (folder / "pad.cir").write_text(edited(QUICK))
    arguments, files = COMMANDS[name]
    assert ended(start(folder, *arguments))[:2] == (0, [])
    assert sorted(written(folder / "out")) == files
    return written(folder / "out")


def check(name: str, out: Path, right: dict[str, bytes], *, killed: bool) -> None:
    """Outputs are those of an undisturbed run or absent; only a process that was killed leaves what it was writing."""
    for file, content in written(out).items():
        if killed and file.startswith(".fingerspice-"):
            continue
        assert content == right[file], f"{name}: {file} is not whole"


def rerun(command: Command, folder: Path, right: dict[str, bytes]) -> None:
    assert command(*COMMANDS["run"][0]).code == 0
    assert {n: c for n, c in written(folder / "out").items() if not n.startswith(".fingerspice-")} == right


def strike(folder: Path, name: str, number: int, delay: float, right: dict[str, bytes]) -> int:
    """Start a command, send it a signal `delay` s after it minds them, and look at what it leaves; its exit code."""
    process = start(folder, *COMMANDS[name][0])
    minded(process)
    time.sleep(delay)
    process.send_signal(number)
    code, lines, _ = ended(process)
    check(name, folder / "out", right, killed=number == signal.SIGKILL)
    if code == 0:
        assert set(written(folder / "out")) >= set(right)
    elif number == signal.SIGKILL:
        assert code == -number
    else:
        expected, word = BROKEN_OFF[signal.Signals(number)]
        assert (code, lines) == (expected, [f"fingerspice: {word}; nothing half-written is left"])
    return code


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGINT, signal.SIGTERM], ids=lambda n: n.name)
def test_at_any_moment_a_signal_leaves_whole_files_or_none(folder: Path, right: dict[str, bytes], number: int) -> None:
    first = 0.1 if number == signal.SIGINT else 0.6
    strike(folder, "run", number, first, right)
    # Under stress every command, at moments spread over the first seconds by the golden ratio.
    for i, name in enumerate(COMMANDS if cases(1, 0) else ()):
        (folder / name).mkdir()
        whole = undisturbed(name, folder / name)
        for k in range(10):
            strike(folder / name, name, number, 3.0 * ((10 * i + k) * 0.6180339887 % 1.0), whole)
            for left in (folder / name / "out").glob(".fingerspice-*"):
                left.unlink()
        assert undisturbed(name, folder / name) == whole


@pytest.mark.parametrize(("number", "place", "count", "done"), [
    (signal.SIGKILL, "write_pieces", 1, []),
    (signal.SIGKILL, "replace", 2, ["pad.nc"]),
    (signal.SIGINT, "write_pieces", 1, []),
    (signal.SIGINT, "replace", 2, ["pad.nc"]),
    (signal.SIGTERM, "replace", 1, []),
])  # fmt: skip
def test_while_a_file_is_written_too(folder, right, command, number, place, count, done):
    out = folder / "out"
    out.mkdir()
    for file in right:
        (out / file).write_bytes(b"of a run before")
    entry = [sys.executable, "-c", STRUCK, place, str(count), str(int(number))]
    code, lines, _ = ended(start(folder, *COMMANDS["run"][0], entry=entry))
    left = written(out)
    assert {name: left[name] for name in right} == {
        name: right[name] if name in done else b"of a run before" for name in right
    }
    hidden = [name for name in left if name not in right]
    if number is signal.SIGKILL:
        assert code == -number
        assert len(hidden) == 1
        rerun(command, folder, right)
    else:
        assert code == BROKEN_OFF[number][0]
        assert lines == [f"fingerspice: {BROKEN_OFF[number][1]}; nothing half-written is left"]
        assert hidden == []


# The command, which does something else than its arguments say, and tells when that begins.
SOLVING = """
import sys
import fingerspice as fs
import fingerspice.__main__ as m
import fingerspice.cli.app
def solve():
    circuit = fs.read_netlist("long.cir")
    print("begins", flush=True)
    fs.simulate(circuit, {})
fingerspice.cli.app.main = solve
sys.argv[1:] = []
m.main()
"""


@pytest.mark.parametrize(("number", "deck", "how"), [
    # Every period is stepped: the whole run takes over a minute.
    (signal.SIGINT, "two_fingers", "t_stop=100.0, t_eval=[1.0], method='exponential'"),
    # A billion periods are walked over: minutes.
    (signal.SIGINT, "", "t_stop=1e5, t_eval=[1e5]"),
    (signal.SIGTERM, "", "t_stop=1e5, t_eval=[1e5]"),
])  # fmt: skip
def test_a_signal_is_heard_during_a_long_run(tmp_path: Path, number: signal.Signals, deck: str, how: str) -> None:
    text = edited(("SIN(0 200 100)", "SIN(0 200 100k)"), ("r=1meg", "r=10g"))
    (tmp_path / "long.cir").write_text((CIRCUITS / f"{deck}.cir").read_text() if deck else text)
    process = start(tmp_path, entry=[sys.executable, "-c", SOLVING.format(how)])
    assert process.stdout is not None
    assert process.stdout.readline() == "begins\n"
    time.sleep(1.0)
    begin = time.perf_counter()
    process.send_signal(number)
    assert ended(process)[0] == 128 + number
    assert time.perf_counter() - begin < 20.0


def test_ctrl_c_after_all_is_done_comes_too_late(tmp_path: Path) -> None:
    late = "import atexit, os; atexit.register(os.kill, os.getpid(), 2); from fingerspice.__main__ import main; main()"
    code, lines, out = ended(start(tmp_path, "--version", entry=[sys.executable, "-c", late]))
    assert (code, lines, out) == (0, [], f"fingerspice {fs.__version__}\n")


def test_a_command_without_ctrl_c_and_standard_output_writes_its_files(folder: Path, right: dict[str, bytes]) -> None:
    def switched_off() -> None:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        os.close(1)

    process = start(folder, *COMMANDS["run"][0], preexec_fn=switched_off)
    minded(process)
    process.send_signal(signal.SIGINT)
    assert ended(process)[:2] == (0, [])
    assert written(folder / "out") == right


@pytest.mark.parametrize(("name", "size", "first", "before", "found"), listed("full_disks"))
def test_a_full_disk_is_one_sentence_and_no_half_file_and_what_was_found_is_printed(
    folder: Path, right: dict[str, bytes], command: Command, name: str, size: int, first: str, before: list[str],
    found: str,
) -> None:  # fmt: skip
    # Matplotlib's list of fonts, made on a full disk, would be broken for everyone after.
    importlib.import_module("matplotlib.font_manager")
    with no_room_here(size):
        done = command(*COMMANDS[name][0])
    lines = [line for line in done.lines if not line.startswith("fingerspice: warning")]
    assert (done.code, lines) == (2, [f"fingerspice: cannot write out/{first}: File too large"])
    assert found in done.out
    assert bool(done.out) == bool(found)
    assert f"wrote out/{first}" not in done.out
    assert list(written(folder / "out")) == before
    if name == "run":
        rerun(command, folder, right)


def test_a_report_that_finds_no_room_is_told_and_the_files_are_whole(folder: Path, right: dict[str, bytes]) -> None:
    assert ended(start(folder, "--help", stdout=subprocess.DEVNULL))[0] == 0
    for arguments in (COMMANDS["run"][0], ["--version"]):
        with open("/dev/full", "w") as full:
            code, lines, _ = ended(start(folder, *arguments, stdout=full))
        assert (code, lines) == (2, ["fingerspice: cannot write to the standard output: No space left on device"])
    assert written(folder / "out") == right


FAILS = ["run", "pad.cir", "--no-plot", "--charge-law", "mobile", "--set", "Xgap.d=10n"]


@pytest.mark.parametrize(("arguments", "expected", "stream"), [
    (["plan", "pad.cir"], 0, "stdout"),
    (FAILS, 1, "stdout"),
    (["plan", "pad.cir", "--set", "Xcoat.r=0.2M"], 0, "stderr"),
    (["plan", "none.cir"], 2, "stderr"),
    (["plan", "--no"], 2, "stderr"),
], ids=["text", "a failure", "warnings", "a refusal", "bad usage"])  # fmt: skip
def test_what_nobody_reads_changes_no_exit_code(folder: Path, arguments: list[str], expected: int, stream: str) -> None:
    reading, writing = os.pipe()
    os.close(reading)
    process = start(folder, *arguments, **{stream: writing})
    os.close(writing)
    code, lines, _ = ended(process)
    assert code == expected
    assert len(lines) == (expected if stream == "stdout" else 0)
    if stream == "stderr":
        with open("/dev/full", "w") as full:
            process = start(folder, *arguments, stderr=full, stdout=subprocess.DEVNULL)
            assert process.wait(60) == expected


@pytest.mark.parametrize("name", ["run", "ac", "compare", "figures"])
def test_a_folder_in_the_place_of_a_picture_is_refused_before_the_run(command: Command, name: str) -> None:
    picture = COMMANDS[name][1][-1]
    Path("out", picture).mkdir(parents=True)
    result = command(*COMMANDS[name][0]).refused()
    assert result.lines == [f"fingerspice: cannot write out/{picture}: it is a folder; allowed: a file's name"]
    assert [p.name for p in Path("out").iterdir()] == [picture]


def test_a_link_is_followed_a_pipe_written_as_it_is_and_a_file_gets_the_usual_permissions(tmp_path: Path) -> None:
    def write(path: Path) -> Path:
        return write_aside(path, lambda p: p.write_text("new"))

    (tmp_path / "else").mkdir()
    (tmp_path / "else" / "there").write_text("old")
    for link, target in (("link", "else/there"), ("dangling", "else/none")):
        (tmp_path / link).symlink_to(target)
        write(tmp_path / link)
        assert (tmp_path / link).is_symlink()
        assert (tmp_path / target).read_text() == "new"
    os.mkfifo(tmp_path / "pipe")
    got: list[str] = []
    reader = threading.Thread(target=lambda: got.append((tmp_path / "pipe").read_text()))
    reader.start()
    write(tmp_path / "pipe")
    reader.join()
    assert got == ["new"]
    assert (tmp_path / "pipe").is_fifo()
    # By a link: were it replaced as a file is, the link would go, not the device.
    (tmp_path / "full").symlink_to("/dev/full")
    refuses(r"cannot write .*full: No space left on device", write, tmp_path / "full")
    assert (tmp_path / "full").is_symlink()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["dangling", "else", "full", "link", "pipe"]
    before = os.umask(0o077)
    try:
        path = write(tmp_path / (250 * "x"))
    finally:
        os.umask(before)
    assert path.stat().st_mode & 0o777 == 0o600
