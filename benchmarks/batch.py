"""Scenes per second of whole calls of `fs.batch`, of a loop over `simulate`, and of a numba loop of RK4 over scenes.

A scene is Table 1's stack with another gap, leak and amplitude; its output is the mean force of 5 periods. Usage:
``python benchmarks/batch.py [--quick] [--scenes N]``; writes ``benchmarks/results/batch.json`` unless quick.
"""

from __future__ import annotations

import argparse
import json
import platform
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numba import njit

import fingerspice as fs
from fingerspice.circuit.statespace import build_stack

HERE = Path(__file__).resolve().parent
PERIODS = 5
REFERENCES = 24


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


@njit(nogil=True)
def rk4(
    c: np.ndarray, g: np.ndarray, g_area: np.ndarray, wave: np.ndarray, areas: np.ndarray, steps: int
) -> np.ndarray:
    """Mean of u_gap^2 A by the classical Runge-Kutta method, scene by scene, with linear tables of the areas."""
    n, m = c.shape
    out = np.empty(n)
    u, v, k, total = np.empty(m), np.empty(m), np.empty(m), np.empty(m)
    for s in range(n):
        inverse = np.sum(1.0 / c[s])
        u[:] = 0.0
        h = 2.0 * np.pi / wave[s, 1] / steps
        scale = (areas.shape[1] - 1) / wave[s, 0]
        mean = 0.0
        last = steps * PERIODS
        for i in range(last + 1):
            total[:] = 0.0
            for stage in range(4):
                late = 0.0 if stage == 0 else 0.5 if stage < 3 else 1.0
                source = wave[s, 0] * np.sin(wave[s, 1] * h * (i + late))
                v[:] = u if stage == 0 else u + late * h * k
                gap = abs(source / (c[s, 1] * inverse) + v[1])
                place = min(gap * scale, areas.shape[1] - 1.001)
                j = int(place)
                area = areas[s, j] + (place - j) * (areas[s, j + 1] - areas[s, j])
                if stage == 0:
                    mean += (0.5 if i in (0, last) else 1.0) * gap * gap * area
                common = 0.0
                for x in range(m):
                    k[x] = -(g[s, x] / area + g_area[s, x]) / c[s, x] * (source / (c[s, x] * inverse) + v[x])
                    common -= k[x]
                for x in range(m):
                    k[x] += common / (c[s, x] * inverse)
                total += (1.0 if stage in (0, 3) else 2.0) * k
            u += h / 6.0 * total
        out[s] = mean / last
    return out


def by_rk4(circuit: fs.Circuit, parameters: dict[str, np.ndarray], n: int, steps: int) -> Callable[[], np.ndarray]:
    """The loop of RK4 over the first n scenes; its set-up is not timed, which favours it."""
    rows = []
    for i in range(n):
        stack = build_stack(circuit.varied({p: float(x[i]) for p, x in parameters.items()}))
        assert stack.contact is not None
        wave = stack.waveform
        table = stack.contact.area(np.linspace(0.0, wave.amplitude, 2000))  # type: ignore[attr-defined]
        rows.append((stack.c, stack.g_total, stack.g_area, [wave.amplitude, 2.0 * np.pi * wave.frequency], table,  # type: ignore[attr-defined]
                     float(stack.contact.stress(1.0))))  # fmt: skip
    c, g, g_area, wave_rows, areas, stress = (np.array(column) for column in zip(*rows, strict=True))
    return lambda: stress * rk4(c, g, g_area, wave_rows, areas, steps)


def single(circuit: fs.Circuit, parameters: dict[str, np.ndarray], i: int, rtol: float, follow: bool) -> float:
    """Mean force of one scene by `simulate`, N."""
    changes = {path: float(values[i]) for path, values in parameters.items()}
    if follow:
        changes["Xskin.f"] = changes["Vdrive.frequency"]
    changed = circuit.varied(changes)
    frequency = changed["Vdrive"].waveform.frequency  # type: ignore[union-attr]
    found = fs.simulate(changed, t_stop=PERIODS / frequency, rtol=rtol, charge=False).f_el_mean
    return float(np.asarray(found))


def measure(name: str, circuit: fs.Circuit, n: int, wide: bool, repeats: int) -> list[dict[str, Any]]:
    """Scenes per second and errors of `fs.batch` at two tolerances, and of the other contestants."""
    parameters, skin = population(n, wide), "follow" if wide else "own"
    few = min(n, REFERENCES)
    expected = np.array([single(circuit, parameters, i, 1e-11, wide) for i in range(few)])
    rows = []
    for rtol in (1e-4, 1e-6):
        for threads in (1, 2):

            def call(rtol: float = rtol, threads: int = threads) -> Any:
                return fs.batch(circuit, parameters, periods=PERIODS, rtol=rtol, skin=skin, threads=threads)

            found = call()
            off = np.abs(found.f_el_mean.values[:few] / expected - 1.0)
            took = seconds(call, repeats)
            rows.append({"scenes": name, "who": "fs.batch", "rtol": rtol, "threads": threads, "n": n, **took,
                         "scenes_per_s": n / took["least_s"], "median_error": float(np.median(off)),
                         "largest_error": float(off.max()), "n_ordinary": found.attrs["n_ordinary"]})  # fmt: skip
        took = seconds(lambda rtol=rtol: [single(circuit, parameters, i, rtol, wide) for i in range(few)], 3)
        rows.append({"scenes": name, "who": "loop over simulate", "rtol": rtol, "threads": 1, "n": few, **took,
                     "scenes_per_s": few / took["least_s"]})  # fmt: skip
    if name.startswith("sine") and not wide:
        for steps in (28, 200):
            run = by_rk4(circuit, parameters, few, steps)
            off, took = np.abs(run() / expected - 1.0), seconds(run, repeats)
            rows.append({"scenes": name, "who": f"numba RK4, {steps} steps a period, set-up not counted", "threads": 1,
                         "n": few, **took, "scenes_per_s": few / took["least_s"],
                         "median_error": float(np.median(off)), "largest_error": float(off.max())})  # fmt: skip
    return rows


def main(arguments: list[str] | None = None) -> dict[str, Any]:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--scenes", type=int, default=40000)
    options = parser.parse_args(arguments)
    n, repeats = (64, 1) if options.quick else (options.scenes, 7)
    sine = fs.read_netlist(HERE.parent / "circuits" / "fingerpad.cir")
    square = sine.replace({"Vdrive": fs.Square(200.0, 100.0)})
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        rows = measure("sine, narrow", sine, n, False, repeats) + measure("sine, wide", sine, n, True, repeats)
        rows += measure("square, narrow", square, n // 4, False, repeats) if not options.quick else []
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
