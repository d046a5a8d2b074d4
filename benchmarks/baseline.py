"""Baseline for changes of the engine: digests and figures of scenes, times, steps, calls of compiled loops.

Run: python benchmarks/baseline.py [--quick] [--output FILE] [--against FILE]. Writes results/baseline.json; with
`--against` prints the differences from an earlier file: changed digests, changes of their figures relative to the
stated errors, and times and calls as ratios.
"""

from __future__ import annotations

import argparse
import hashlib
import itertools
import json
import os
import platform
import subprocess
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

import fingerspice as fs
from fingerspice.engine.collocation import loop
from timing import median_seconds

HERE = Path(__file__).resolve().parent
CIRCUITS = HERE.parent / "circuits"
RESULTS = HERE / "results" / "baseline.json"
LAWS, TOLERANCES = ("local", "mobile"), (1e-4, 1e-8)
#: Decks that are timed: one finger alone or in a network, and two fingers.
CIRCUITS_TIMED = ("fingerpad", "fingerpad_dispersive", "amplifier", "ungrounded_user", "current_drive", "two_fingers")
PERIODS, OUTPUTS = 100, 100
Report = dict[str, Any]


@contextmanager
def counted() -> Iterator[list[int]]:
    """Count the calls from Python to the compiled loops in the block."""
    calls = [0]
    originals = {module: module.march_on for module in (loop,)}

    def counting(inner: Callable[..., int]) -> Callable[..., int]:
        def outer(*arguments: Any) -> int:
            calls[0] += 1
            return inner(*arguments)

        return outer

    for module, original in originals.items():
        module.march_on = counting(original)  # type: ignore[assignment]
    try:
        yield calls
    finally:
        for module, original in originals.items():
            module.march_on = original


def scene(deck: Path, law: str, rtol: float) -> Report:
    """Digest of a deck's run, its figures with their stated errors, steps, and calls of compiled loops."""
    circuit = fs.read_netlist(deck)
    with counted() as calls:
        solution = fs.simulate(circuit, charge_law=law, rtol=rtol, throw=False)
    content = hashlib.sha256()
    for name, (values, _, _) in solution.signals.items():
        content.update(name.encode() + np.ascontiguousarray(values).tobytes())
    summary = solution.summary()
    keys = [k for k in summary if k.split(":")[0] in ("u_gap_peak", "f_el_max", "f_el_mean", "f_t_mean")]
    return {
        "digest": content.hexdigest(),
        "status": solution.status.name,
        "figures": {k: summary[k] for k in keys},
        "stated": {"u_gap": solution.error.u_gap, "f_el": solution.error.f_el, "q_source": solution.error.q_source},
        "steps": solution.stats["steps"],
        "rejected": solution.stats["rejected"],
        "calls": calls[0],
    }


def driven(circuit: fs.Circuit, square: bool, frequency: float) -> fs.Circuit:
    """The circuit with its first source replaced by a sine or square, and all other sources switched off."""
    name = next(e.name for e in circuit.elements if e.name[0] in "VI")
    strength = 200.0 if name[0] == "V" else 500e-6 * frequency / 5e3
    source = fs.Square(strength, frequency) if square else fs.Sine(strength, frequency)
    others = {e.name: 0.0 for e in circuit.elements if e.waveform is not None and e.name != name}
    return circuit.replace({name: source, **others})


def times(deck: str, square: bool, frequency: float, repeats: int) -> Report:
    """Times per period of a circuit at 1e-6, with every period stepped and by default, and calls of compiled loops."""
    circuit = driven(fs.read_netlist(CIRCUITS / f"{deck}.cir"), square, frequency)
    t = np.linspace(0.0, PERIODS / frequency, PERIODS * OUTPUTS + 1)
    found: Report = {"circuit": deck, "source": f"{'square' if square else 'sine'} {frequency:g} Hz"}
    for method in ("exponential", "auto"):

        def run(method: str = method) -> fs.Solution:
            return fs.simulate(circuit, t_stop=float(t[-1]), t_eval=t, rtol=1e-6, method=method, charge=False)

        try:
            with counted() as calls:
                solution = run()
        except fs.FingerspiceError as error:
            found[method] = {"failed": str(error)}
            continue
        peak = float(np.abs(solution.u_gap).max())
        found[method] = {
            "us_per_period": 1e6 * median_seconds(run, repeats) / PERIODS,
            "steps_per_period": solution.stats["steps"] / PERIODS,
            "calls_per_period": calls[0] / PERIODS,
            "stated_error_over_peak": solution.error.u_gap / peak,
        }
    return found


def line(pieces: int) -> str:
    """A deck of an RC line with a finger at its end."""
    finger = (CIRCUITS / "fingerpad_5khz.cir").read_text(encoding="utf-8")
    nodes = ["drive", *(f"n{i}" for i in range(1, pieces)), "end"]
    rungs = "\n".join(f"R{i} {a} {b} 10\nC{i} {b} 0 1p" for i, (a, b) in enumerate(itertools.pairwise(nodes)))
    return finger.replace("Xcoat   drive", f"{rungs}\nXcoat   end")


def calls_of_a_user(repeats: int) -> Report:
    """Times (s) of whole calls: five periods with the same circuit, another source or parameter; and a long line."""
    found: Report = {}
    t = np.linspace(0.0, 0.05, 101)
    for deck in ("fingerpad", "fingerpad_dispersive", "amplifier"):
        circuit = driven(fs.read_netlist(CIRCUITS / f"{deck}.cir"), False, 100.0)
        name = next(e.name for e in circuit.elements if e.name[0] == "V")
        values = iter(np.linspace(3.4, 3.6, 100_000))

        def same(circuit: fs.Circuit = circuit) -> fs.Solution:
            return fs.simulate(circuit, t_stop=0.05, t_eval=t, rtol=1e-6)

        def source(circuit: fs.Circuit = circuit, name: str = name, values: Iterator[float] = values) -> fs.Solution:
            drive = {name: fs.Sine(55.0 * next(values), 100.0)}
            return fs.simulate(circuit, sources=drive, t_stop=0.05, t_eval=t, rtol=1e-6)

        def parameter(circuit: fs.Circuit = circuit, values: Iterator[float] = values) -> fs.Solution:
            changed = circuit.replace({"Xgap.d": 1e-6 * next(values)})
            return fs.simulate(changed, t_stop=0.05, t_eval=t, rtol=1e-6)

        for what, run in (("the same", same), ("another source", source), ("another parameter", parameter)):
            found[f"{deck}: {what}"] = median_seconds(run, 10 * repeats)
    long = fs.parse_netlist(line(600))
    found["line of 600"] = median_seconds(lambda: fs.simulate(long, t_stop=1e-3, rtol=1e-6), repeats)
    return found


def revision() -> str:
    """The measured commit, with a + if files differ from it; empty without git."""
    try:
        said = subprocess.run(
            ["git", "describe", "--always", "--dirty=+"], cwd=HERE, capture_output=True, text=True, check=True
        )
    except (OSError, subprocess.CalledProcessError):
        return ""
    return said.stdout.strip()


def compare(now: Report, before: Report) -> Iterator[str]:
    """A line of text for each difference."""
    for name, scene_now in now["scenes"].items():
        was = before["scenes"].get(name)
        if was is None or was["digest"] == scene_now["digest"]:
            continue
        moved = {}
        for key, value in scene_now["figures"].items():
            stated = scene_now["stated"]["u_gap" if key.startswith("u_") else "f_el"] or 0.0
            moved[key] = abs(value - was["figures"][key]) / max(stated, 1e-300)
        worst = max(moved.values(), default=0.0)
        yield (
            f"{name}: digest changed, figures by {worst:.2g} of the stated error; steps {was['steps']} -> "
            f"{scene_now['steps']}, calls {was['calls']} -> {scene_now['calls']}"
        )
    for a, b in zip(before["times"], now["times"], strict=True):
        for method in ("exponential", "auto"):
            if "failed" not in a[method] and "failed" not in b[method]:
                x, y = a[method]["us_per_period"], b[method]["us_per_period"]
                yield f"{b['circuit']}, {b['source']}, {method}: {x:.2f} -> {y:.2f} us per period ({y / x:.2f})"
    for what, x in before["calls"].items():
        y = now["calls"].get(what, float("nan"))
        yield f"{what}: {1e3 * x:.3f} -> {1e3 * y:.3f} ms ({y / x:.2f})"


def main(arguments: list[str] | None = None) -> Report:
    """Measure, print and, unless quick, write the results."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="two decks, one repeat, nothing written")
    parser.add_argument("--output", type=Path, default=RESULTS)
    parser.add_argument("--against", type=Path, help="an earlier file to compare with")
    options = parser.parse_args(arguments)
    warnings.simplefilter("ignore", fs.FingerspiceWarning)
    decks = sorted(CIRCUITS.glob("*.cir"))[: 2 if options.quick else None]
    repeats = 1 if options.quick else 7
    timed = CIRCUITS_TIMED[:1] if options.quick else CIRCUITS_TIMED
    results: Report = {
        "machine": f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}",
        "revision": revision(),
        "scenes": {
            f"{deck.stem}, {law}, {rtol:.0e}": scene(deck, law, rtol)
            for deck in decks
            for law in LAWS
            for rtol in TOLERANCES
        },
        "times": [
            times(deck, square, frequency, repeats)
            for deck in timed
            for square in (False, True)
            for frequency in (100.0, 5000.0)
        ],
        "calls": calls_of_a_user(repeats),
    }
    if options.against is not None:
        print("\n".join(compare(results, json.loads(options.against.read_text(encoding="utf-8")))))
    else:
        print(json.dumps({k: v for k, v in results.items() if k != "scenes"}, indent=2))
    if not options.quick:
        options.output.write_text(json.dumps(results, indent=2) + "\n", encoding="utf-8")
    return results


if __name__ == "__main__":
    main()
