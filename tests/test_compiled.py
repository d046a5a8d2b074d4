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
    for name in ("cli.py", "circuit/reader.py"):
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
        "from fingerspice.engine.segment import Segment, source\n"
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
