"""Lockstep of `fs.batch` on a graphics card beside the processor: time for a scene and period against error.

Scenes are Table 1's stack with another gap, leak and amplitude; the output is the mean force of 5 periods. It prints
the card, the time of whole calls (set-up and the making of the Dataset included), that of the kernel with its copies
alone, and the largest error on 24 scenes, each run by itself at 1e-11. Compilation comes before the timings. Usage:
``python benchmarks/gpu.py [--scenes N]``; writes ``benchmarks/results/gpu.json``. It needs ``fingerspice[gpu]`` and an
NVIDIA card.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

import fingerspice as fs
from batch import PERIODS, REFERENCES, population, seconds, single
from fingerspice.engine.lockstep import card as lockcard
from fingerspice.engine.lockstep.card import card_compiler
from fingerspice.studies.batch import lockstep

HERE = Path(__file__).resolve().parent


def card_name() -> str:
    """Name of the card."""
    name = getattr(card_compiler().get_current_device(), "name", "numba's simulator of a card")
    return name.decode() if isinstance(name, bytes) else str(name)


def kernel_seconds(call: Any, repeats: int) -> float:
    """Median time in the kernel and its copies, s, during one call."""
    spent = [0.0]

    def timed(*given: Any) -> Any:
        begin = time.perf_counter()
        out = lockcard.march_on_card(*given)
        spent[-1] += time.perf_counter() - begin
        return out

    lockstep.march_on_card = timed
    try:
        for _ in range(repeats):
            spent.append(0.0)
            call()
    finally:
        lockstep.march_on_card = lockcard.march_on_card
    return float(np.median(spent[1:]))


def measure(circuit: fs.Circuit, n: int, rtol: float, device: str, repeats: int) -> dict[str, Any]:
    """One row of the table."""
    parameters = population(n, False)

    def call() -> Any:
        return fs.batch(circuit, parameters, periods=PERIODS, rtol=rtol, device=device)

    begin = time.perf_counter()
    found = call()
    first = time.perf_counter() - begin
    few = min(n, REFERENCES)
    scenes = [{path: float(x[i]) for path, x in parameters.items()} for i in range(few)]
    expected = np.array([single(circuit, changes, 1e-11, PERIODS) for changes in scenes])
    took = seconds(call, repeats)["median_s"]
    row = {"device": device, "rtol": rtol, "n": n, "first_s": first, "median_s": took, "scenes_per_s": n / took,
           "ns_per_scene_period": 1e9 * took / n / PERIODS,
           "largest_error": float(np.abs(found.f_el_mean.values[:few] / expected - 1.0).max())}  # fmt: skip
    if device == "cuda":
        row["kernel_ns_per_scene_period"] = 1e9 * kernel_seconds(call, repeats) / n / PERIODS
    return row


def main() -> None:
    """Measure and print; end with a sentence where there is no card."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", type=int, default=1_000_000)
    parser.add_argument("--repeats", type=int, default=7)
    given = parser.parse_args()
    circuit = fs.read_netlist(HERE.parent / "circuits" / "fingerpad.cir")
    try:
        fs.batch(circuit, {"Xgap.d": [3e-6]}, periods=1, device="cuda")
    except fs.InputError as error:
        sys.exit(f"gpu.py: {error}")
    print(f"{card_name()}, {given.scenes} scenes, {PERIODS} periods, medians of {given.repeats}")
    rows = []
    for rtol in (1e-4, 1e-6):
        for device in ("cuda", "cpu"):
            row = measure(circuit, given.scenes, rtol, device, given.repeats)
            rows.append(row)
            print(", ".join(f"{key} {value:.3g}" if isinstance(value, float) else f"{key} {value}"
                            for key, value in row.items()))  # fmt: skip
    (HERE / "results" / "gpu.json").write_text(json.dumps({"card": card_name(), "rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
