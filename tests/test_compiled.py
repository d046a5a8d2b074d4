"""Compiled code and its cache: full disks, killed processes, changed sources; and tuples passed by their address."""

import importlib
import inspect
import os
import platform
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from functools import partial
from operator import attrgetter
from pathlib import Path
from typing import Any, NamedTuple

import numba
import numpy as np
import pytest
from numba import njit

import fingerspice as fs
from fingerspice.base.announcing import LONG
from fingerspice.base.compiled import LEVELS, borrow
from processes import ended, no_room, start

faults = pytest.mark.skipif(sys.platform != "linux", reason="faults are made by Linux's means")
CIRCUITS = Path(__file__).parents[1] / "circuits"

AREA = """
from fingerspice.physics.contact import ridge_area, universal_curve, JkrContact
universal_curve(0.0, 1.9, 1.1)
c = JkrContact(3.5e-6, 1.0, 0.5, 0.3, 54.4e-6, 0.52, 32e-6 * 1e3**1.41, 1.41, 5e-9)
print(repr(ridge_area(0.0, c.packed)))
"""
# Each of the two functions that Python calls has one file.
# numba ends with the N-th of them ready, but for its name.
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


def begun(
    copy: Path,
    *arguments: str,
    code: str = AREA,
    cache: str | None = None,
    more: Mapping[str, str] = {},
    **options: Any,
) -> subprocess.Popen[str]:
    """The code in a process that finds the package there; the user has no folder for a cache but `cache`."""
    home = str(copy / "__init__.py" / "no")
    hidden = {"PYTHONPATH": str(copy.parent), "HOME": home, "XDG_CACHE_HOME": home, "PYTHONDONTWRITEBYTECODE": "1"}
    environment = {k: v for k, v in os.environ.items() if k != "NUMBA_CACHE_DIR"} | hidden
    environment |= more if cache is None else {"NUMBA_CACHE_DIR": cache}
    return start(copy, *arguments, entry=[sys.executable, "-c", code], env=environment, **options)


def area(copy: Path, *arguments: str, **options: Any) -> tuple[int, list[str], str]:
    return ended(begun(copy, *arguments, **options))


def compiled(copy: Path) -> dict[Path, int]:
    """The files of compiled code, each with the time when it was written."""
    found = {p: p.stat().st_mtime_ns for p in copy.rglob("*.nbc")}
    assert found, "nothing was cached, so this test would prove nothing"
    return found


@faults
def test_no_room_for_compiled_code_means_compiling_again(copy: Path) -> None:
    expected = (0, [], area(copy)[2])
    assert float(expected[2]) > 0.0
    for path in compiled(copy):
        path.unlink()
    assert area(copy, preexec_fn=no_room(0)) == expected
    assert not list(copy.rglob("*.nb?*"))
    # Nowhere at all, not even for root.
    shutil.rmtree(copy / "base" / "__pycache__", ignore_errors=True)
    (copy / "base" / "__pycache__").write_text("")
    assert area(copy) == expected


def test_compiled_code_that_came_with_the_package_is_used_where_nothing_can_be_written(copy: Path) -> None:
    first = area(copy, code=LOGGED + AREA)
    assert first[:2] == (0, [ONCE])
    # Copied, or unpacked from an archive: the times of its files are others.
    for path in copy.rglob("*.py"):
        os.utime(path, (1e9, 1e9))
    assert area(copy, code=SHUT + LOGGED + AREA) == (0, [], first[2])


LEVEL = {"NUMBA_CPU_NAME": "x86-64-v2", "NUMBA_CPU_FEATURES": ""}
levels = pytest.mark.skipif(platform.machine() not in ("x86_64", "AMD64"), reason="levels of x86-64")


@pytest.fixture
def came(copy: Path) -> Path:
    """The package with code for x86-64-v2 that came with it, as in a wheel."""
    assert area(copy, more=LEVEL)[0] == 0
    (copy / "objects").mkdir()
    for file in compiled(copy):
        file.rename(copy / "objects" / file.name)
    return copy


def features(*without: str) -> dict[str, str]:
    """An environment in which the processor has what x86-64-v2 asks for, but for some."""
    has = sorted(LEVELS["x86-64-v2"].difference(without))
    return {"NUMBA_CPU_NAME": "nocona", "NUMBA_CPU_FEATURES": ",".join(f"+{name}" for name in has)}


@levels
def test_a_processor_takes_code_for_a_level_of_instructions_that_it_has_and_no_other(came: Path) -> None:
    value = area(came, more=LEVEL)[2]
    # This processor, one without AVX, and the level itself, which another processor's name stands for.
    for more in ({}, features(), LEVEL):
        assert area(came, code=LOGGED + AREA, more=more) == (0, [], value)
    code, (said,), out = area(came, code=LOGGED + AREA, more=features("popcnt"))
    assert (code, float(out)) == (0, pytest.approx(float(value), rel=1e-14))
    tag = f"{sys.implementation.cache_tag}-numba-{numba.__version__}"
    assert said == f"{ONCE}; the compiled code that came with the package is for other processors, arguments or sources"
    other = "import numba; numba.__version__ = '0.68.99'\n"
    code, (said,), out = area(came, code=other + LOGGED + AREA)
    assert (code, said) == (0, f"{ONCE}; the compiled code that came with the package is for {tag}")
    assert float(out) == pytest.approx(float(value), rel=1e-14)


def test_half_written_and_damaged_code_is_compiled_again(copy: Path) -> None:
    expected = area(copy)
    for spoil in (lambda x: x[: len(x) // 2], lambda x: b"", lambda x: x[:300] + bytes(len(x) - 300), _without_code):
        files = compiled(copy)
        for file in files:
            file.write_bytes(spoil(file.read_bytes()))
        assert area(copy, code=LOGGED + AREA) == (0, [ONCE], expected[2])
        assert area(copy, code=LOGGED + AREA) == (0, [], expected[2])


def _without_code(data: bytes) -> bytes:
    """As if the disk had lost a block in the middle of the object code."""
    at = data.index(b"\x7fELF") + 200
    return data[:at] + bytes(100) + data[at + 100 :]


def test_two_processes_that_fill_one_cache_at_once_keep_code_that_works(copy: Path) -> None:
    both = [ended(one) for one in [begun(copy, code=LOGGED + AREA) for _ in range(2)]]
    assert [(code, lines) for code, lines, _ in both] == [(0, [ONCE])] * 2
    assert area(copy, code=LOGGED + AREA) == (0, [], both[0][2])


@faults
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
    "fingerspice: note: compiling the steps of a series stack, about 20 s, only once: later runs find it on the disk",
    "fingerspice: note: compiling the steps of a network, about 30 s, only once: later runs find it on the disk",
]


@faults
def test_every_wait_is_announced_with_its_own_length_also_behind_another_bar() -> None:
    program = partial(start, Path.cwd(), entry=[sys.executable, "-c", WAITS], env={**os.environ, "COLUMNS": "80"})
    logged = program()
    seen, _ = on_a_terminal(program)
    assert logged.communicate(timeout=120)[1].splitlines() == LINES
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
    unions = {("engine.collocation.loop.march_on", "Circuit"), ("engine.lanes.loops.span", "Marks")}
    assert kind in ("", first.annotation) or (name, first.annotation) in unions


def test_where_compiled_code_cannot_be_kept_it_is_said_what_to_set(copy: Path) -> None:
    code, (said,), out = area(copy, code=SHUT + LOGGED + AREA)
    assert code == 0
    assert float(out) > 0.0
    said_first = "compiling a small part, some seconds, at every run: no folder for compiled code can be written"
    assert said.startswith(said_first)
    assert said.endswith("set NUMBA_CACHE_DIR to one that can")


@faults
def test_killed_while_it_keeps_compiled_code_it_works_the_next_time(copy: Path) -> None:
    for count in ("1", "2"):
        assert area(copy, count, code=KILLED + AREA)[0] == -signal.SIGKILL
    code, lines, out = area(copy)
    assert (code, lines) == (0, [])
    assert area(copy) == (0, [], out)


def test_compiling_is_announced_by_one_line_and_repeated_only_after_a_change_of_its_sources(copy: Path) -> None:
    def change(*names: str) -> None:
        for name in names:
            with (copy / name).open("a") as source:
                source.write("\n# changed\n")

    out, err = begun(copy).communicate(timeout=120)
    assert err == f"fingerspice: note: {ONCE}\n"
    before = compiled(copy)
    change("cli/app.py", "netlist/reader.py")
    assert begun(copy).communicate(timeout=120) == (out, "")
    assert compiled(copy) == before
    # `ridge_area` stays as it is; only another module changes.
    change("numerics/small.py")
    assert area(copy) == (0, [], out)
    assert not before.keys() & compiled(copy).keys(), "a cache file from before the change is still there"


# `source` calls `chebyshev.evaluate`, which stands in another file.
ELSEWHERE = """
import numpy as np
from fingerspice.engine.network import source
print(repr(source(np.zeros((1, 6)), np.array([3.0, 0.0]), 1.0, 0.5)[0]))
"""


def test_a_change_reaches_code_that_is_cached_elsewhere(copy: Path, tmp_path: Path) -> None:
    cache = tmp_path / "cache"
    assert area(copy, code=ELSEWHERE, cache=str(cache))[2] == "3.0\n"
    compiled(cache)
    with (copy / "numerics" / "chebyshev.py").open("a") as module:
        module.write("\n\n@jit\ndef evaluate(series, x):\n    return 7.0, 0.0\n")
    assert area(copy, code=ELSEWHERE, cache=str(cache))[2] == "7.0\n"


def test_an_engine_that_is_not_to_be_compiled_is_refused_in_one_sentence(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "fingerspice", "run", str(CIRCUITS / "fingerpad.cir"), "--out", str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, env={**os.environ, "NUMBA_DISABLE_JIT": "1"})
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("fingerspice: NUMBA_DISABLE_JIT is set: ")
    assert done.stderr.count("\n") == 1


RUNS = """
import sys
import numpy as np
import fingerspice as fs

stack, network = (fs.read_netlist(f"{sys.argv[1]}/{name}.cir") for name in ("fingerpad", "ungrounded_user"))
noise = fs.Samples(100.0 * np.random.default_rng(1).standard_normal(480), 48e3)
few = fs.PWL([0.0, 2e-4, 8e-4], [0.0, 100.0, 50.0])
given, sealed = np.linspace(0.0, 1e-3, 77), np.linspace(0.0, 1e-3, 77)
sealed.flags.writeable = False
for circuit, more in [
    (stack, {}), (network, {}), (stack, {"sources": noise}), (stack, {"sources": few}), (stack, {"area": 35e-6}),
    (stack, {"area": 35e-6, "sources": noise}), (stack, {"method": "radau"}),
]:
    for t_eval in (None, given, sealed, list(given)):
        found = fs.simulate(circuit, t_stop=1e-3, t_eval=t_eval, **more)
        found.f_el, found.f_t, found.f_el_mean
    for chunk in fs.stream(circuit, t_stop=1e-3, chunk=5e-4, **more):
        chunk.u_gap
fs.inverse_drive(stack, duration=5e-3, force=lambda t: 0.02 + 0.01 * np.sin(300.0 * t))
fs.steady_state(stack)
twice = 0
for name, module in list(sys.modules.items()):
    for function in vars(module).values() if name.startswith("fingerspice.") else ():
        if hasattr(function, "py_func") and function.py_func.__module__ == name:
            kinds = [str(types).replace("readonly ", "") for types in function.signatures]
            if len(kinds) > len(set(kinds)):
                print(f"{name}.{function.py_func.__name__}", kinds if len(kinds[0]) < 500 else "", file=sys.stderr)
                twice += 1
print(twice)
"""


def test_nothing_is_compiled_twice_for_arrays_that_can_and_cannot_be_written() -> None:
    done = subprocess.run([sys.executable, "-c", RUNS, str(CIRCUITS)], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (0, "0\n"), done.stderr


PRIVATE = """
import sys
import numpy as np
from fingerspice.base.compiled import jit, jit_rows, jit_within
from fingerspice.base.compiled import LEVELS, borrow

@jit_within
def inner(x):
    return 2.0 * x

@jit_rows
def row(x, out):
    for i in range(x.size):
        out[i] = inner(x[i])

@jit
def outer(x):
    x = borrow(x)
    out = np.empty(x.size)
    row(x, out)
    return out.sum()
"""


def test_what_is_built_on_private_classes_of_numba_does_what_it_is_for(tmp_path: Path) -> None:
    (tmp_path / "made.py").write_text(PRIVATE)
    code = (
        f"import sys; sys.path.insert(0, {str(tmp_path)!r}); import numpy as np, made\n"
        "assert made.outer(np.arange(4.0)) == 12.0\n"
        # What compiled code calls has no machine code of its own, and the rest is found on the disk.
        "assert not made.inner.signatures and not made.row.signatures\n"
        "print(sum(made.outer.stats.cache_hits.values()))"
    )
    own = {"NUMBA_CACHE_DIR": str(tmp_path), "PYTHONPATH": str(Path(fs.__file__).parents[1])}
    environment, command = os.environ | own, [sys.executable, "-c", code]
    found = [subprocess.check_output(command, text=True, env=environment) for _ in range(2)]
    assert found == ["0\n", "1\n"]


#: Every private part of numba that `base.compiled` overrides, calls or reads, by its module.
PARTS = {
    "numba.core.caching": "CompileResultCacheImpl NullCache "
    "IndexDataCacheFile._load_data IndexDataCacheFile._save_data",
    "numba.core.codegen": "JITCodeLibrary._finalize_final_module JITCodeLibrary._optimize_final_module "
    "JITCodeLibrary._finalize_dynamic_globals JITCPUCodegen.magic_tuple",
    "numba.core.compiler": "CompileResult._reduce CompileResult._rebuild Flags compile_extra",
    "numba.core.dispatcher": "Dispatcher.compile Dispatcher.get_call_template Dispatcher.get_overload",
    "numba.core.runtime.nrt": "rtsys.initialize",
    "numba.core.types.functions": "BaseFunction.get_call_type",
    "numba.core.typing.templates": "AttributeTemplate make_concrete_template",
    "numba.core.targetconfig": "ConfigStack.top_or_none",
}


@pytest.mark.parametrize(("module", "names"), PARTS.items())
def test_the_private_parts_of_numba_that_are_overridden_exist(module: str, names: str) -> None:
    for name in names.split():
        attrgetter(name)(importlib.import_module(module))
    assert '"numba>=0.68,<0.69"' in (CIRCUITS.parent / "pyproject.toml").read_text()
    assert numba.__version__.startswith("0.68.")


class Outer(NamedTuple):
    x: np.ndarray
    pair: tuple[np.ndarray, np.ndarray]
    y: np.ndarray


@njit
def _filled(c):
    c = borrow(c)
    c.y[1] = c.pair[1][0] * c.x
    return c.y.sum()


def test_borrowing_leaves_every_reference_count_as_it_was() -> None:
    c = Outer(np.arange(3.0), (np.ones(2), np.full(2, 5.0)), np.zeros((2, 3)))
    arrays = (c.x, *c.pair, c.y)
    before = [sys.getrefcount(x) for x in arrays]
    assert [_filled(c) for _ in range(100)] == [15.0] * 100
    assert [sys.getrefcount(x) for x in arrays] == before
