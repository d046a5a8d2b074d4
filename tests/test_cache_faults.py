"""The cache of compiled code with a full disk, or with a process killed while it writes the cache."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

import fingerspice as fs
from processes import ended, no_room, start

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="faults are made by Linux's means")

AREA = """
from fingerspice.physics.contact import ridge_area, universal_curve, Contact
universal_curve(0.0, 1.9, 1.1)
c = Contact(3.5e-6, 1.0, 0.5, 0.3, 54.4e-6, 0.52, 32e-6 * 1e3**1.41, 1.41, 5e-9)
print(repr(ridge_area(0.0, c.packed)))
"""
# Each of the two functions that Python calls has two files.
# numba ends with the N-th file of its cache ready, but for its name.
KILLED = """
import os, sys
from numba.core import caching
calls, replace = [], os.replace
def strike(*names):
    calls.append(names)
    if len(calls) == int(sys.argv[1]):
        os.kill(os.getpid(), 9)
    replace(*names)
caching.os.replace = strike
"""


# No folder can be written, the package's neither, as for one that others installed.
SHUT = """
import tempfile
def refuse(*_, **__):
    raise PermissionError(13, "Permission denied")
tempfile.TemporaryFile = refuse
"""
# What the package logs, as the command line shows it.
LOGGED = "import logging; logging.basicConfig(level=logging.INFO, format='%(message)s')\n"
ONCE = (
    "compiling what this needs, 20 s for a series stack, 30 s for a network, a minute for recordings, only once: "
    "later runs find it on the disk"
)


@pytest.fixture
def copy(tmp_path: Path) -> Iterator[Path]:
    """The package where nothing is compiled yet."""
    package = tmp_path / "src" / "fingerspice"
    shutil.copytree(Path(fs.__file__).parent, package, ignore=shutil.ignore_patterns("__pycache__"))
    yield package
    shutil.rmtree(package)


def area(copy: Path, *arguments: str, before: str = "", **options: Any) -> tuple[int, list[str], str]:
    return ended(begun(copy, *arguments, before=before, **options))


def begun(copy: Path, *arguments: str, before: str = "", **options: Any) -> subprocess.Popen[str]:
    home = str(copy / "__init__.py" / "no")
    hidden = {"PYTHONPATH": str(copy.parent), "HOME": home, "XDG_CACHE_HOME": home, "PYTHONDONTWRITEBYTECODE": "1"}
    environment = {k: v for k, v in os.environ.items() if k != "NUMBA_CACHE_DIR"} | hidden
    entry = [sys.executable, "-c", before + AREA]
    return start(copy, *arguments, entry=entry, env=environment, **options)


def test_no_room_for_compiled_code_means_compiling_again(copy: Path) -> None:
    expected = (0, [], area(copy)[2])
    assert float(expected[2]) > 0.0
    cached = {p: p.read_bytes() for p in copy.rglob("*.nb?")}
    assert cached
    for path in cached:
        path.unlink()
    assert area(copy, preexec_fn=no_room(0)) == expected
    assert not list(copy.rglob("*.nb?*"))
    # Nowhere at all, not even for root.
    for folder in [copy, *(p for p in copy.iterdir() if p.is_dir() and p.name != "__pycache__")]:
        shutil.rmtree(folder / "__pycache__", ignore_errors=True)
        (folder / "__pycache__").write_text("")
    assert area(copy) == expected


def test_compiled_code_that_came_with_the_package_is_used_where_nothing_can_be_written(copy: Path) -> None:
    first = area(copy, before=LOGGED)
    assert first[:2] == (0, [ONCE])
    # Copied, or unpacked from an archive: the times of its files are others.
    for path in copy.rglob("*.py"):
        os.utime(path, (1e9, 1e9))
    assert area(copy, before=SHUT + LOGGED) == (0, [], first[2])


def test_compiling_is_announced_in_python_too_by_one_line_and_only_once(copy: Path) -> None:
    out, err = begun(copy).communicate(timeout=120)
    assert err == f"fingerspice: note: {ONCE}\n"
    assert begun(copy).communicate(timeout=120) == (out, "")


def test_on_a_terminal_compiling_shows_a_bar_that_goes_away(copy: Path) -> None:
    ours, theirs = os.openpty()
    process = begun(copy, stderr=theirs)
    os.close(theirs)
    seen = b""
    with suppress(OSError):
        while piece := os.read(ours, 4096):
            seen += piece
    os.close(ours)
    assert process.wait(timeout=120) == 0
    assert process.stdout is not None
    assert float(process.stdout.read()) > 0.0
    assert b"compiling what this needs" in seen
    assert b"\x1b[?25h" in seen.rpartition(b"compiling")[2]
    process.stdout.close()


def test_where_compiled_code_cannot_be_kept_it_is_said_what_to_set(copy: Path) -> None:
    code, (said,), out = area(copy, before=SHUT + LOGGED)
    assert code == 0
    assert float(out) > 0.0
    assert said.startswith("compiling, 20 s to a minute, as at every run: no folder for compiled code can be written")
    assert said.endswith("set NUMBA_CACHE_DIR to one that can")


def test_killed_while_it_keeps_compiled_code_it_works_the_next_time(copy: Path) -> None:
    # An index without its data, data without a name, and in the middle.
    for count in ("1", "2", "3"):
        assert area(copy, count, before=KILLED)[0] == -signal.SIGKILL
    code, lines, out = area(copy)
    assert (code, lines) == (0, [])
    assert area(copy) == (0, [], out)
