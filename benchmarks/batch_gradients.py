"""Cost of the derivatives of `fs.batch` in runs, and their errors, beside a loop over single runs.

A scene is Table 1's stack with another gap, leak and amplitude; its derivatives are those of the mean force by these
three. A call with derivatives and one without are timed in turn. Usage:
``python benchmarks/batch_gradients.py [--quick] [--scenes N]``; writes ``results/batch_gradients.json`` unless quick.
"""

from __future__ import annotations

import argparse
import json
import platform
import time
import warnings
from pathlib import Path
from typing import Any

import numpy as np

import fingerspice as fs
from batch import PERIODS, REFERENCES, population

HERE = Path(__file__).resolve().parent
PATHS = ("Xgap.d", "Xgap.r", "Vdrive.amplitude")


def single(circuit: fs.Circuit, changes: dict[str, float], rtol: float, periodic: bool) -> tuple[float, list[float]]:
    """Mean force of one scene (N), and its changes for a change of each parameter by all of itself."""
    changed = circuit.varied(changes)
    if periodic:
        run: Any = fs.steady_state(changed, rtol=rtol, points=4, charge=False, sensitivities=PATHS)
    else:
        stop = PERIODS / changed["Vdrive"].waveform.frequency  # type: ignore[union-attr]
        run = fs.simulate(changed, t_stop=stop, t_eval=[stop], rtol=rtol, charge=False, sensitivities=PATHS)
    return run.f_el_mean, [run.sensitivities[path].f_el_mean * changes[path] for path in PATHS]


def measure(name: str, circuit: fs.Circuit, n: int, repeats: int, periodic: bool) -> list[dict[str, Any]]:
    """Costs and errors of derivatives by one and by three parameters, on one thread, at two tolerances."""
    parameters = population(n, False)
    few = min(n, REFERENCES)
    scenes = [{path: float(x[i]) for path, x in parameters.items()} for i in range(few)]
    expected = [single(circuit, changes, 1e-11, periodic) for changes in scenes]
    force, right = np.array([one[0] for one in expected]), np.array([one[1] for one in expected])
    size = np.stack([parameters[path][:few] for path in PATHS], axis=1)
    how: dict[str, Any] = {"periodic": True} if periodic else {"periods": PERIODS}
    rows = []
    for rtol in (1e-4, 1e-6):
        times: dict[int, list[float]] = {0: [], 1: [], 3: []}
        for _ in range(repeats + 1):
            for count, took in times.items():
                begin = time.perf_counter()
                found = fs.batch(circuit, parameters, rtol=rtol, threads=1, gradients=PATHS[:count], **how)
                took.append(time.perf_counter() - begin)
        # The first round is not counted: it compiles.
        plain, one, three = (min(took[1:]) for took in times.values())
        begin = time.perf_counter()
        for changes in scenes:
            single(circuit, changes, rtol, periodic)
        alone = (time.perf_counter() - begin) / few
        off = np.abs(found.d_f_el_mean.values[:few] * size - right).max(axis=1) / force
        rows.append({
            "scenes": name, "rtol": rtol, "n": n, "plain_s": plain, "one_parameter_s": one, "three_parameters_s": three,
            "runs_per_parameter_of_one": one / plain - 1.0, "runs_per_parameter_of_three": (three / plain - 1.0) / 3.0,
            "scenes_per_s": n / three, "single_scenes_per_s": 1.0 / alone, "largest_error": float(off.max()),
            "largest_stated_error": float(found.gradient_error.max()),
            "n_ordinary": found.attrs["n_ordinary_gradients"],
        })  # fmt: skip
    return rows


def main(arguments: list[str] | None = None) -> dict[str, Any]:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--scenes", type=int, default=20000)
    options = parser.parse_args(arguments)
    n, repeats = (16, 1) if options.quick else (options.scenes, 7)
    sine = fs.read_netlist(HERE.parent / "circuits" / "fingerpad.cir")
    square = sine.replace({"Vdrive": fs.Square(200.0, 100.0)})
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        rows = measure("sine, 5 periods", sine, n, repeats, False)
        rows += measure("sine, periodic state", sine, n, repeats, True)
        rows += measure("square, 5 periods", square, n // 4, repeats, False)
    results = {"python": platform.python_version(), "machine": platform.machine(), "rows": rows}
    for row in rows:
        print(", ".join(f"{k} {v:.3g}" if isinstance(v, float) else f"{k} {v}" for k, v in row.items()))
    if not options.quick:
        (HERE / "results" / "batch_gradients.json").write_text(json.dumps(results, indent=1) + "\n")
    return results


if __name__ == "__main__":
    main()
