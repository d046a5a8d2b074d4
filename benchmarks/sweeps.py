"""What a store costs a sweep of a million scenes, and whether a sweep that is killed again and again keeps its bytes.

A scene is Table 1's stack with another gap, leak and skin; its output is the mean force of 5 periods at 1e-4. Usage:
``python benchmarks/sweeps.py [--quick] [--kills N]``; writes ``benchmarks/results/sweeps.json`` unless quick.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import platform
import random
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from scipy import stats

import fingerspice as fs

HERE = Path(__file__).resolve().parent
DECK = HERE.parent / "circuits" / "fingerpad.cir"
PARAMETERS: dict[str, Any] = {
    "Xgap.d": stats.lognorm(0.1, scale=3.5e-6),
    "Xgap.r": stats.lognorm(0.4, scale=1e6),
    "Xskin.d": stats.norm(350e-6, 30e-6),
}
FILE = """deck = "fingerpad.cir"
n = {n}
outputs = ["f_el_mean"]
periods = 5
[parameters]
"Xgap.d" = {{ lognormal = [3.5e-6, 0.1] }}
"Xgap.r" = {{ lognormal = [1e6, 0.4] }}
"Xskin.d" = {{ normal = [350e-6, 30e-6] }}
"""


def measured(n: int, repeats: int, folder: Path) -> list[dict[str, Any]]:
    """Seconds of a sweep in memory and into a store, and bytes on the disk.

    All ways take turns, so that other work on the machine disturbs them alike. Processes (Dask's workers) take time to
    start: they have a second sweep of four times as many scenes, and its further scenes cost the difference.
    """
    store = folder / "own.zarr"
    ways: dict[str, tuple[int, Callable[[int], Any]]] = {
        "memory, 1 thread": (n, lambda n: _swept(n, threads=1)),
        "store, 1 thread": (n, lambda n: _swept(n, threads=1, store=store)),
        "memory, 2 threads": (n, lambda n: _swept(n, threads=2)),
        "store, 2 threads": (n, lambda n: _swept(n, threads=2, store=store)),
        "store, 2 processes": (n, lambda n: _swept(n, workers=2, store=store)),
        "store, 2 processes, more": (4 * n, lambda n: _swept(n, workers=2, store=store)),
    }
    _swept(n)
    times: dict[str, list[tuple[float, float]]] = {who: [] for who in ways}
    rows = []
    for _ in range(repeats):
        for who, (size, sweep) in ways.items():
            shutil.rmtree(store, ignore_errors=True)
            begin, worked = time.perf_counter(), _processor_seconds()
            found = sweep(size)
            times[who].append((time.perf_counter() - begin, _processor_seconds() - worked))
            assert found.attrs.get("chunks_missing", 0) == 0
    for who, (size, _) in ways.items():
        wall, busy = (np.array(one) for one in zip(*times[who], strict=True))
        rows.append({"who": who, "n": size, "median_s": float(np.median(wall)), "least_s": float(wall.min()),
                     "processor_s": float(busy.min()), "scenes_per_s": size / float(np.median(wall))})  # fmt: skip
        print(rows[-1])
    held = sum(p.stat().st_size for p in store.rglob("*") if p.is_file())
    rows.append({"who": "store, bytes on the disk", "n": size, "bytes_per_scene": held / size})
    return rows


def _swept(n: int, **how: Any) -> Any:
    return fs.sweep(fs.read_netlist(DECK), PARAMETERS, n=n, outputs=("f_el_mean",), periods=5, **how)


def _processor_seconds() -> float:
    """Processor time of this process and of those that it has started and that have ended, s."""
    both = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(one.ru_utime + one.ru_stime for one in both)


def indices(n: int, repeats: int) -> dict[str, Any]:
    """Seconds of Sobol indices of four parameters, with their intervals, by one thread."""
    circuit, parameters = fs.read_netlist(DECK), {**PARAMETERS, "Xgap.alpha": stats.lognorm(0.1, scale=54.4)}
    times = []
    for _ in range(repeats + 1):
        begin = time.perf_counter()
        fs.sobol(circuit, parameters, n=n, outputs=("f_el_mean",), periods=5, threads=1)
        times.append(time.perf_counter() - begin)
    row = {"who": "Sobol indices, 1 thread", "n": n * (len(parameters) + 2), "median_s": float(np.median(times[1:]))}
    print(row)
    return row


def digest(store: Path) -> str:
    """Digest of all files of a store, with their names."""
    told = hashlib.sha256()
    for file in sorted(p for p in store.rglob("*") if p.is_file()):
        told.update(str(file.relative_to(store)).encode() + file.read_bytes())
    return told.hexdigest()


def killed(n: int, kills: int, folder: Path) -> dict[str, Any]:
    """Whether a sweep of the command line, killed at random moments, ends with the bytes of one that was not."""
    shutil.copy(DECK, folder)
    (folder / "sweep.toml").write_text(FILE.format(n=n))
    command = [sys.executable, "-m", "fingerspice", "sweep", str(folder / "sweep.toml"), "--no-plot"]
    command += ["--out", str(folder / "out"), "--overwrite", "--store"]
    subprocess.run([*command, str(folder / "whole.zarr")], check=True, capture_output=True)
    store, done = folder / "killed.zarr", 0
    rng = random.Random(1)
    for kill in range(kills):
        more = ["--workers", "2"] if kill % 2 else []
        process = subprocess.Popen([*command, str(store), *more], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        time.sleep(rng.uniform(1.0, 2.5))
        done += process.poll() is None
        process.kill()
        process.wait()
    subprocess.run([*command, str(store)], check=True, capture_output=True)
    found = {"n": n, "kills": done, "same_bytes": digest(store) == digest(folder / "whole.zarr")}
    print(found)
    return found


def main(arguments: list[str] | None = None) -> dict[str, Any]:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--kills", type=int, default=20)
    options = parser.parse_args(arguments)
    n, repeats, kills = (1 << 12, 1, 1) if options.quick else (1 << 20, 5, options.kills)
    with tempfile.TemporaryDirectory() as name:
        rows = [*measured(n, repeats, Path(name)), indices(64 if options.quick else 4096, repeats)]
        found = killed(16 * n, kills, Path(name))
    results = {"python": platform.python_version(), "machine": platform.machine(), "rows": rows, "killed": found}
    if not options.quick:
        (HERE / "results" / "sweeps.json").write_text(json.dumps(results, indent=1) + "\n")
    return results


if __name__ == "__main__":
    main()
