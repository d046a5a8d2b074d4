"""Waiting times of a user: import, `fingerspice run`, every shipped deck, periodic states, dispersive skins.

Run: python benchmarks/run_times.py [--quick]. Medians of 7, without compile time; writes results/run_times.json.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
import sys
import tempfile
import warnings
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

import fingerspice as fs
from fingerspice.physics.materials import skin_permittivity, skin_resistivity
from timing import median_seconds

HERE = Path(__file__).resolve().parent
CIRCUITS = HERE.parent / "circuits"


def as_shipped(path: Path, rtol: float, repeats: int) -> dict[str, Any]:
    """Time of a deck over its own .tran, with the stated error of the run."""
    circuit = fs.read_netlist(path)
    solution = fs.simulate(circuit, rtol=rtol)
    seconds = median_seconds(lambda: fs.simulate(circuit, rtol=rtol), repeats)
    return {
        "deck": path.stem,
        "rtol": rtol,
        "outputs": int(solution.t.size),
        "periods": None if solution.period is None else float(solution.t[-1]) / solution.period,
        "milliseconds": 1e3 * seconds,
        "error_over_peak": solution.error.u_gap / float(abs(solution.u_gap).max()),
        "nfev": solution.nfev,
        "method": solution.method,
    }


SCENES = (fs.Sine(200.0, 100.0), fs.Square(200.0, 100.0), fs.Sine(200.0, 5000.0), fs.Square(200.0, 5000.0))


def steady_seconds(source: fs.Sine | fs.Square, repeats: int) -> dict[str, Any]:
    """Time of the periodic state of Table 1 at rtol 1e-10, without its signals."""
    circuit = fs.read_netlist(CIRCUITS / "fingerpad.cir").replace({"Vdrive": source, "Xskin.f": source.frequency})
    state = fs.steady_state(circuit, rtol=1e-10, charge=False)
    seconds = median_seconds(lambda: fs.steady_state(circuit, rtol=1e-10, charge=False), 20 * repeats)
    name = f"{type(source).__name__.lower()} {source.frequency:g} Hz"
    return {"scene": name, "microseconds": 1e6 * seconds, "periods": state.periods, "defect_V": state.defect}


@lru_cache(maxsize=1)
def eight_poles() -> str:
    """A ladder of eight poles fitted to the skin's data, as a subcircuit."""
    f = np.geomspace(10.0, 1e5, 161)
    rows = np.column_stack([f, skin_resistivity(f), skin_permittivity(f)])
    return fs.fit_material(rows, poles=8).to_netlist("EIGHT")


def dispersion_cost(source: fs.Sine | fs.Square, rtol: float, method: str, repeats: int) -> dict[str, Any]:
    """Time per period with the skin frozen at one frequency, with the shipped ladder, and with eight poles."""
    frozen = (CIRCUITS / "fingerpad.cir").read_text(encoding="utf-8")
    skin = f"SKIN  d=350u f={source.frequency:g}"
    texts = {
        "frozen": frozen.replace("SKIN  d=350u f=100", skin),
        "shipped": frozen.replace("SKIN  d=350u f=100", "SKIN_DISPERSIVE d=350u"),
        "eight poles": frozen.replace("SKIN  d=350u f=100", "EIGHT d=350u").replace(".end\n", eight_poles() + ".end\n"),
    }
    periods = 50
    t = np.linspace(0.0, periods / source.frequency, 100 * periods + 1)
    found: dict[str, Any] = {
        "scene": f"{type(source).__name__.lower()} {source.frequency:g} Hz",
        "rtol": rtol,
        "method": method,
    }
    for name, text in texts.items():
        circuit = fs.parse_netlist(text).replace({"Vdrive": source})
        seconds = median_seconds(
            lambda circuit=circuit: fs.simulate(  # type: ignore[misc]
                circuit, t_stop=float(t[-1]), t_eval=t, rtol=rtol, charge=False, method=method
            ),
            repeats,
        )
        found[f"{name}: us per period"] = 1e6 * seconds / periods
    return found


def command_seconds(arguments: list[str], repeats: int) -> float:
    """Median wall time of a Python command in a fresh process, s."""
    return median_seconds(
        lambda: subprocess.run([sys.executable, *arguments], check=True, capture_output=True), repeats
    )


def main(arguments: list[str] | None = None) -> dict[str, Any]:
    """Measure, print and, unless quick, write the results."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="one repeat, scene and tolerance, nothing written")
    options = parser.parse_args(arguments)
    repeats = 1 if options.quick else 7
    tolerances = (1e-3,) if options.quick else (1e-3, 1e-6, 1e-10)
    scenes = SCENES[:1] if options.quick else SCENES
    warnings.simplefilter("ignore", fs.FingerspiceWarning)
    decks = sorted(CIRCUITS.glob("*.cir"))
    with tempfile.TemporaryDirectory() as folder:
        run = ["-m", "fingerspice", "run", str(CIRCUITS / "fingerpad.cir"), "--out", folder]
        results = {
            "machine": f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}",
            "import_s": command_seconds(["-c", "import fingerspice"], repeats)
            - command_seconds(["-c", "pass"], repeats),
            "run_s": command_seconds(run, repeats),
            "run_no_plot_s": command_seconds([*run, "--no-plot"], repeats),
            "periodic_state": [steady_seconds(source, repeats) for source in scenes],
            "dispersion": [
                dispersion_cost(s, rtol, method, repeats)
                for s in scenes
                for rtol in tolerances
                for method in ("auto", "exponential")
            ],
            "as_shipped": [as_shipped(d, rtol, repeats) for d in decks for rtol in tolerances],
        }
    print(json.dumps(results, indent=2))
    if not options.quick:
        (HERE / "results" / "run_times.json").write_text(json.dumps(results, indent=2) + "\n")
    return results


if __name__ == "__main__":
    main()
