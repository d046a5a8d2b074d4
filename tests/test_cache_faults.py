"""The cache of compiled code with a full disk, or with a process killed while it writes the cache."""

from __future__ import annotations

import importlib
import inspect
import os
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import pytest

import fingerspice as fs
from fingerspice.base.announcing import LONG
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
ONCE = "compiling a small part, some seconds, only once: later runs find it on the disk"


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
    seen, out = on_a_terminal(partial(begun, copy))
    assert float(out) > 0.0
    assert "compiling a small part, some seconds, only once" in seen
    assert "\x1b[?25h" in seen.rpartition("compiling")[2]


def on_a_terminal(program: Callable[..., subprocess.Popen[str]]) -> tuple[str, str]:
    """What a program that succeeds writes to a terminal of 80 columns, and to stdout."""
    ours, theirs = os.openpty()
    process = program(stderr=theirs)
    os.close(theirs)
    seen = b""
    with suppress(OSError):
        while piece := os.read(ours, 4096):
            seen += piece
    os.close(ours)
    out, _ = process.communicate(timeout=120)
    assert process.returncode == 0
    return seen.decode(), out


WAITS = """
import time
from fingerspice.base.announcing import Bar, Compiling
sweep, compiling = Bar("sweeping"), Compiling()
sweep.show(0.25)
for kind in ("OneArea", "ManyAreas"):
    with compiling.around():
        compiling.begins("engine.collocation.loop.march_on", kind, True)
        time.sleep(1.3)
    sweep.show(0.5)
with compiling.around():
    compiling.begins("engine.collocation.loop.march_on", "ManyAreas", True)
sweep.stop()
"""
LINES = [
    "fingerspice: note: compiling the steps of a series stack, about 30 s, only once: later runs find it on the disk",
    "fingerspice: note: compiling the steps of a network, about 60 s, only once: later runs find it on the disk",
]


def test_every_wait_is_announced_with_its_own_length_also_behind_another_bar() -> None:
    program = partial(start, Path.cwd(), entry=[sys.executable, "-c", WAITS], env={**os.environ, "COLUMNS": "80"})
    _, err = program().communicate(timeout=120)
    assert err.splitlines() == LINES
    seen, _ = on_a_terminal(program)
    seen = re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", seen)
    for line in LINES:
        assert re.search(re.escape(line[19:].partition(":")[0]) + r"\s+\S+\s+0:00:01", seen)
    assert " 25 %" in seen
    assert " 50 %" in seen


@pytest.mark.parametrize(("name", "kind"), LONG)
def test_what_is_said_to_compile_for_long_is_a_function_of_that_kind(name: str, kind: str) -> None:
    module, _, function = name.rpartition(".")
    compiled = getattr(importlib.import_module(f"fingerspice.{module}"), function)
    assert compiled.targetoptions["nogil"]
    first = next(iter(inspect.signature(compiled.py_func).parameters.values()))
    unions = {("engine.collocation.loop.march_on", "Circuit"), ("engine.lanes.loops.begin", "Marks")}
    assert kind in ("", first.annotation) or (name, first.annotation) in unions


def test_where_compiled_code_cannot_be_kept_it_is_said_what_to_set(copy: Path) -> None:
    code, (said,), out = area(copy, before=SHUT + LOGGED)
    assert code == 0
    assert float(out) > 0.0
    said_first = "compiling a small part, some seconds, at every run: no folder for compiled code can be written"
    assert said.startswith(said_first)
    assert said.endswith("set NUMBA_CACHE_DIR to one that can")


def test_killed_while_it_keeps_compiled_code_it_works_the_next_time(copy: Path) -> None:
    # An index without its data, data without a name, and in the middle.
    for count in ("1", "2", "3"):
        assert area(copy, count, before=KILLED)[0] == -signal.SIGKILL
    code, lines, out = area(copy)
    assert (code, lines) == (0, [])
    assert area(copy) == (0, [], out)
