"""What a user waits for: import, `fingerspice run`, and ten periods of every shipped deck inside Python.

Run: python benchmarks/run_times.py [--quick]. Medians of 7, compile time apart; writes results/run_times.json.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import fingerspice as fs

HERE = Path(__file__).resolve().parent
CIRCUITS = HERE.parent / "circuits"


def median_seconds(action: Callable[[], object], repeats: int) -> float:
    """Median wall time of `action`, s, after one run that is not counted."""
    action()
    times = []
    for _ in range(repeats):
        begin = time.perf_counter()
        action()
        times.append(time.perf_counter() - begin)
    return statistics.median(times)


def ten_periods(path: Path, rtol: float, repeats: int) -> dict[str, Any]:
    """Time of ten periods of a deck, with the error that the run states."""
    circuit = fs.read_netlist(path)
    period = fs.phasor(circuit).frequency[0] ** -1
    solution = fs.simulate(circuit, t_stop=10.0 * period, rtol=rtol)
    seconds = median_seconds(lambda: fs.simulate(circuit, t_stop=10.0 * period, rtol=rtol), repeats)
    return {
        "deck": path.stem,
        "rtol": rtol,
        "outputs": int(solution.t.size),
        "milliseconds": 1e3 * seconds,
        "error_over_peak": solution.error.u_gap / float(abs(solution.u_gap).max()),
        "nfev": solution.nfev,
        "method": solution.method,
    }


def command_seconds(arguments: list[str], repeats: int) -> float:
    """Median wall time of a Python command in a fresh process, s."""
    return median_seconds(
        lambda: subprocess.run([sys.executable, *arguments], check=True, capture_output=True), repeats
    )


def main(arguments: list[str] | None = None) -> dict[str, Any]:
    """Measure, print and, unless quick, write the results."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="one repeat, nothing written")
    options = parser.parse_args(arguments)
    repeats = 1 if options.quick else 7
    decks = sorted(CIRCUITS.glob("*.cir"))
    with tempfile.TemporaryDirectory() as folder:
        run = ["-m", "fingerspice", "run", str(CIRCUITS / "fingerpad.cir"), "--out", folder]
        results = {
            "machine": f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}",
            "import_s": command_seconds(["-c", "import fingerspice"], repeats)
            - command_seconds(["-c", "pass"], repeats),
            "run_s": command_seconds(run, repeats),
            "run_no_plot_s": command_seconds([*run, "--no-plot"], repeats),
            "ten_periods": [ten_periods(d, rtol, repeats) for d in decks for rtol in (1e-3, 1e-6, 1e-10)],
        }
    print(json.dumps(results, indent=2))
    if not options.quick:
        (HERE / "results" / "run_times.json").write_text(json.dumps(results, indent=2) + "\n")
    return results


if __name__ == "__main__":
    main()
