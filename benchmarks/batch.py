"""Scenes per second of whole calls of `fs.batch`, of a loop over `simulate`, and of other packages at the same error.

A scene is Table 1's stack with another gap, leak and amplitude, or the stack of another shipped deck; its output is the
mean force of 5 periods, or of the deck's run. The peers (JAX, diffrax, torch, numba) are those that are installed; they
run on one core. Usage:
``python benchmarks/batch.py [--quick] [--scenes N]``; writes ``benchmarks/results/batch.json`` unless quick.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import platform
import time
import tracemalloc
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numba
import numpy as np
from scipy.signal import butter, sosfilt

import fingerspice as fs
from fingerspice.circuit.statespace import build_stack
from peers import many_scenes

HERE = Path(__file__).resolve().parent
PERIODS = 5
REFERENCES = 24
PLAIN = "sine, narrow"


def population(n: int, wide: bool) -> dict[str, np.ndarray]:
    """Random parameters: gap, leak and amplitude, or with `wide` six parameters over wide ranges."""
    rng = np.random.default_rng(1)
    if not wide:
        return {
            "Xgap.d": rng.uniform(3e-6, 4e-6, n),
            "Xgap.r": 1e6 * 10.0 ** rng.uniform(-0.5, 0.5, n),
            "Vdrive.amplitude": rng.uniform(100.0, 250.0, n),
        }
    return {
        "Vdrive.frequency": 10.0 ** rng.uniform(np.log10(20.0), 4.0, n),
        "Vdrive.amplitude": rng.uniform(50.0, 300.0, n),
        "Xgap.r": 1e6 * 10.0 ** rng.uniform(-1.0, 1.0, n),
        "Xcoat.r": 2e5 * 10.0 ** rng.uniform(-1.0, 1.0, n),
        "Xgap.fn": rng.uniform(0.1, 2.0, n),
        "Xgap.d": rng.uniform(2e-6, 6e-6, n),
    }


def noise(highest: float) -> fs.Samples:
    """50 ms of noise from 50 Hz on, 150 V, at 48 kHz."""
    band = butter(4, [50.0, highest], "band", fs=48e3, output="sos")
    x = sosfilt(band, np.random.default_rng(1).standard_normal(2401))
    return fs.Samples(150.0 * x / np.abs(x).max(), 48e3)


def seconds(action: Callable[[], object], repeats: int) -> dict[str, float]:
    """Smallest and median wall time, and smallest processor time of all threads, s, after a run that is not counted."""
    action()
    times, busy = [], []
    for _ in range(repeats):
        begin, worked = time.perf_counter(), time.process_time()
        action()
        times.append(time.perf_counter() - begin)
        busy.append(time.process_time() - worked)
    return {"least_s": min(times), "median_s": float(np.median(times)), "processor_s": min(busy)}


@contextmanager
def one_core() -> Iterator[None]:
    """All threads on one core, also those that libraries start inside."""
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(before)})
    numba.set_num_threads(1)
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)


def single(circuit: fs.Circuit, changes: dict[str, float], rtol: float, periods: float | None) -> float:
    """Mean force of one scene by `simulate`, N; its length is that of the deck without `periods`."""
    changed = circuit.varied(changes)
    stop = None if periods is None else periods / changed["Vdrive"].waveform.frequency  # type: ignore[union-attr]
    return float(np.asarray(fs.simulate(changed, t_stop=stop, rtol=rtol, charge=False).f_el_mean))


def measure(
    name: str, circuit: fs.Circuit, parameters: dict[str, np.ndarray], repeats: int, periods: float | None = PERIODS
) -> list[dict[str, Any]]:
    """Scenes per second and errors of `fs.batch` at two tolerances, and of a loop over `simulate`."""
    n = next(iter(parameters.values())).size
    skin = "follow" if "Vdrive.frequency" in parameters else "own"
    few = min(n, REFERENCES)
    scenes = [{path: float(x[i]) for path, x in parameters.items()} for i in range(few)]
    if skin == "follow":
        scenes = [changes | {"Xskin.f": changes["Vdrive.frequency"]} for changes in scenes]
    expected = np.array([single(circuit, changes, 1e-11, periods) for changes in scenes])
    rows = []
    for rtol in (1e-4, 1e-6):
        for threads in (1, 2):

            def call(rtol: float = rtol, threads: int = threads) -> Any:
                return fs.batch(circuit, parameters, periods=periods, rtol=rtol, skin=skin, threads=threads)

            found = call()
            off = np.abs(found.f_el_mean.values[:few] / expected - 1.0)
            took = seconds(call, repeats)
            rows.append({"scenes": name, "who": "fs.batch", "rtol": rtol, "threads": threads, "n": n, **took,
                         "scenes_per_s": n / took["least_s"], "median_error": float(np.median(off)),
                         "largest_error": float(off.max()), "n_ordinary": found.attrs["n_ordinary"]})  # fmt: skip
        took = seconds(lambda rtol=rtol: [single(circuit, changes, rtol, periods) for changes in scenes], 3)
        rows.append({"scenes": name, "who": "loop over simulate", "rtol": rtol, "threads": 1, "n": few, **took,
                     "scenes_per_s": few / took["least_s"]})  # fmt: skip
    if name == PLAIN:
        with one_core():
            rows += peers(circuit, parameters, expected, repeats)
    return rows


def growth(circuit: fs.Circuit, largest: int) -> list[dict[str, Any]]:
    """Time and memory of a call over the number of scenes, at 1e-4 with two threads."""
    rows = []
    for n in (1, 100, 10_000, 1_000_000):
        if n > largest:
            break
        parameters = population(n, False)

        def call(parameters: dict[str, np.ndarray] = parameters) -> Any:
            return fs.batch(circuit, parameters, periods=PERIODS, rtol=1e-4, threads=2)

        took = seconds(call, 3 if n == largest else 7)
        tracemalloc.start()
        call()
        most = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        rows.append({"scenes": f"{PLAIN}, {n}", "who": "fs.batch", "rtol": 1e-4, "threads": 2, "n": n, **took,
                     "scenes_per_s": n / took["least_s"], "bytes_per_scene": most / n})  # fmt: skip
    return rows


def waveforms(circuit: fs.Circuit, n: int, repeats: int) -> list[dict[str, Any]]:
    """Gap voltages per second where all of them are returned, 200 a period of 5 periods, at 1e-4."""
    parameters, rows = population(n, False), []
    for threads in (1, 2):

        def call(threads: int = threads) -> Any:
            return fs.batch(circuit, parameters, outputs=("u_gap",), periods=PERIODS, rtol=1e-4, threads=threads)

        took = seconds(call, repeats)
        rows.append({"scenes": f"{PLAIN}, u_gap", "who": "fs.batch", "rtol": 1e-4, "threads": threads, "n": n, **took,
                     "scenes_per_s": n / took["least_s"],
                     "voltages_per_s": n * 200 * PERIODS / took["least_s"]})  # fmt: skip
    return rows


def peers(
    circuit: fs.Circuit, parameters: dict[str, np.ndarray], expected: np.ndarray, repeats: int
) -> list[dict[str, Any]]:
    """Scenes per second of other packages at the errors 1e-4 and 1e-6; without their set-up, which favours them."""
    n = min(4096, parameters["Xgap.d"].size)
    stacks = [build_stack(circuit.varied({p: float(x[i]) for p, x in parameters.items()})) for i in range(n)]
    scenes, rows = many_scenes.scenes_of(stacks, 12), []
    for who, (most, _, make) in many_scenes.CONTESTANTS.items():
        if who.split()[0] != "numba" and importlib.util.find_spec(who.split()[0].lower()) is None:
            print(f"{who}: not installed")
            continue
        for error in (1e-4, 1e-6):
            found = many_scenes.cheapest(who, scenes, PERIODS, expected, error)
            if found is None:
                print(f"{who}: no setting has an error of {error:g}")
                continue
            count = min(most, n)
            took = seconds(make(scenes.first(count), PERIODS, found[0]), repeats)
            rows.append({"scenes": PLAIN, "who": f"{who}, set-up not counted", "rtol": error, "threads": 1,
                         "n": count, "setting": found[0], **took, "scenes_per_s": count / took["least_s"],
                         "largest_error": found[1]})  # fmt: skip
    return rows


def main(arguments: list[str] | None = None) -> dict[str, Any]:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--scenes", type=int, default=40000)
    options = parser.parse_args(arguments)
    n, repeats = (64, 1) if options.quick else (options.scenes, 7)
    circuits = HERE.parent / "circuits"
    sine = fs.read_netlist(circuits / "fingerpad.cir")
    square = sine.replace({"Vdrive": fs.Square(200.0, 100.0)})
    narrow, few = population(n, False), max(n // 16, 16)
    fingers = {path: values[:few] for path, values in narrow.items() if path.startswith("X")}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        rows = measure(PLAIN, sine, narrow, repeats) + measure("sine, wide", sine, population(n, True), repeats)
        if not options.quick:
            rows += measure("square, narrow", square, population(n // 4, False), repeats)
            rows += measure("square, wide", square, population(n // 4, True), repeats)
            for deck in ("am_carrier", "fingerpad_dispersive"):
                rows += measure(deck, fs.read_netlist(circuits / f"{deck}.cir"), fingers, repeats, None)
            for highest in (1000.0, 8000.0):
                recorded = sine.replace({"Vdrive": noise(highest)})
                some = {path: values[:1024] for path, values in fingers.items()}
                rows += measure(f"recording to {highest:g} Hz", recorded, some, repeats, None)
        rows += waveforms(sine, 64 if options.quick else 8192, repeats)
        rows += growth(sine, 100 if options.quick else 1_000_000)
    results = {"python": platform.python_version(), "machine": platform.machine(), "rows": rows}
    for row in rows:
        row["scenes_per_processor_s"] = row["n"] / row["processor_s"]
        shown = ", ".join(f"{k} {v:.3g}" if isinstance(v, float) else f"{k} {v}" for k, v in row.items())
        print(shown)
    if not options.quick:
        (HERE / "results" / "batch.json").write_text(json.dumps(results, indent=1) + "\n")
    return results


if __name__ == "__main__":
    main()
