"""The cache of compiled code: a change of any source empties it."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import fingerspice

PACKAGE = Path(fingerspice.__file__).parent


def printed(code, folder, **more):
    environment = {k: v for k, v in os.environ.items() if k != "NUMBA_CACHE_DIR"} | {"PYTHONPATH": str(folder)} | more
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment, check=True)
    return float(done.stdout)


def area_at_zero_volt(folder):
    # numba would look in the user's own cache where the package's cannot be written; here it can.
    code = (
        "from fingerspice.physics.contact import ridge_area, Contact\n"
        "c = Contact(3.5e-6, 1.0, 0.5, 0.3, 54.4e-6, 0.52, 32e-6 * 1e3**1.41, 1.41, 5e-9)\n"
        "print(repr(ridge_area(0.0, c.packed)))"
    )
    return printed(code, folder)


def test_a_change_of_one_source_reaches_the_compiled_code_of_another(tmp_path):
    copy = tmp_path / "fingerspice"
    shutil.copytree(PACKAGE, copy, ignore=shutil.ignore_patterns("__pycache__"))
    before = area_at_zero_volt(tmp_path)
    assert list(copy.rglob("*.nbc")), "nothing was cached, so this test would prove nothing"
    # `ridge_area` stays as it is; only the decorator's module changes, as any other might.
    stamp = copy / "__pycache__" / "compiled.stamp"
    with (copy / "numerics" / "small.py").open("a") as source:
        source.write("\n# changed\n")
    written = stamp.stat().st_mtime_ns
    assert area_at_zero_volt(tmp_path) == before
    assert stamp.stat().st_mtime_ns > written
    newest = max(p.stat().st_mtime_ns for p in copy.rglob("*.nbc"))
    oldest = min(p.stat().st_mtime_ns for p in copy.rglob("*.nbc"))
    assert oldest > written, "a cache file from before the change is still there"
    assert newest >= oldest


def test_a_change_of_a_file_that_nothing_compiled_depends_on_compiles_nothing(tmp_path):
    copy = tmp_path / "fingerspice"
    shutil.copytree(PACKAGE, copy, ignore=shutil.ignore_patterns("__pycache__"))
    area_at_zero_volt(tmp_path)
    before = {p: p.stat().st_mtime_ns for p in copy.rglob("*.nb[ic]")}
    assert before
    for name in ("cli/app.py", "netlist/reader.py"):
        with (copy / name).open("a") as source:
            source.write("\n# changed\n")
    area_at_zero_volt(tmp_path)
    assert {p: p.stat().st_mtime_ns for p in copy.rglob("*.nb[ic]")} == before


def test_a_change_reaches_code_that_is_cached_elsewhere(tmp_path):
    copy = tmp_path / "fingerspice"
    shutil.copytree(PACKAGE, copy, ignore=shutil.ignore_patterns("__pycache__"))
    # `source` calls `chebyshev.evaluate`, which stands in another file.
    code = (
        "import numpy as np\n"
        "from fingerspice.engine.network import Segment, source\n"
        "print(repr(source(Segment(0.0, 1.0, np.zeros((1, 6)), np.array([3.0, 0.0])), 0.5)[0]))"
    )
    cache = tmp_path / "cache"
    assert printed(code, tmp_path, NUMBA_CACHE_DIR=str(cache)) == 3.0
    assert list(cache.rglob("*.nbc")), "nothing was cached there, so this test would prove nothing"
    with (copy / "numerics" / "chebyshev.py").open("a") as module:
        module.write("\n\n@jit\ndef evaluate(series, x):\n    return 7.0, 0.0\n")
    assert printed(code, tmp_path, NUMBA_CACHE_DIR=str(cache)) == 7.0


def test_an_engine_that_is_not_to_be_compiled_is_refused_in_one_sentence(tmp_path):
    deck = Path(__file__).parents[1] / "circuits" / "fingerpad.cir"
    command = [sys.executable, "-m", "fingerspice", "run", str(deck), "--out", str(tmp_path)]
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


def test_nothing_is_compiled_twice_for_arrays_that_can_and_cannot_be_written():
    circuits = str(Path(__file__).parents[1] / "circuits")
    done = subprocess.run([sys.executable, "-c", RUNS, circuits], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (0, "0\n"), done.stderr


PRIVATE = """
import sys
import numpy as np
from fingerspice.base.compiled import jit, jit_rows, jit_within
from fingerspice.base.compiled import borrow

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


def test_what_is_built_on_private_classes_of_numba_does_what_it_is_for(tmp_path):
    (tmp_path / "made.py").write_text(PRIVATE)
    code = (
        "import sys; sys.path.insert(0, sys.argv[0]); import numpy as np, made\n"
        "assert made.outer(np.arange(4.0)) == 12.0\n"
        # What compiled code calls has no machine code of its own, and the rest is found on the disk.
        "assert not made.inner.signatures and not made.row.signatures\n"
        "print(sum(made.outer.stats.cache_hits.values()))"
    ).replace("sys.argv[0]", repr(str(tmp_path)))
    assert [printed(code, PACKAGE.parent) for _ in range(2)] == [0.0, 1.0]
