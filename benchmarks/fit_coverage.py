"""How often the intervals of fits to synthetic data cover the true values, and whether what data cannot tell is named.

Run: python benchmarks/fit_coverage.py [--sets N] [--quick]. 500 sets take about half an hour and write
results/fit_coverage.json; docs/fit.md has the figures. Every set has new noise of 2 %.

- Gap, its resistance and alpha, from 15 mean forces at three voltages and five frequencies: with sigma given; with it
  unknown and equal for all forces; and with it unknown and an equal share of every force.
- The six parameters of a contact, from areas and friction forces of which each kind has its own unknown error.
- Gap and alpha, at one voltage and one frequency, which tell nothing but a product of the two: named in how many of 20
  fits to fingers drawn at random? And the same for gap and resistance at three voltages and five frequencies, which are
  known: named in how many?
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import numpy as np

import fingerspice as fs
from fingerspice.studies.fit.fitting import Estimate

ROOT = Path(__file__).resolve().parent.parent
RESULTS = Path(__file__).resolve().parent / "results" / "fit_coverage.json"
TRUE = {"Xgap.d": 3.1e-6, "Xgap.r": 1.4e6, "Xgap.alpha": 48.0}
CONTACT = {"alpha": 48.0, "m_exp": 0.45, "beta": 40.0, "n_exp": 1.6, "mu": 0.35, "c2": 4000.0}
NOISE = 0.02
VOLTAGES, FREQUENCIES = (100.0, 150.0, 200.0), (20.0, 50.0, 100.0, 200.0, 500.0)


def forces(finger: fs.Circuit, voltages: tuple[float, ...], frequencies: tuple[float, ...]) -> dict[str, np.ndarray]:
    """Mean forces of a finger without noise, with their conditions."""
    u, f = (x.ravel() for x in np.meshgrid(voltages, frequencies))
    runs = [
        fs.steady_state(finger, parameters={"Vdrive.amplitude": a, "Vdrive.frequency": b, "Xskin.f": b}, rtol=1e-9)
        for a, b in zip(u, f, strict=True)
    ]
    return {"Vdrive.amplitude": u, "source.frequency": f, "f_el_mean": np.array([run.f_el_mean for run in runs])}


def share_covered(found: list[dict[str, Estimate]], true: dict[str, float]) -> dict[str, float]:
    """Share of the fits whose interval holds the true value, by parameter."""
    return {path: float(np.mean([one[path].low <= x <= one[path].high for one in found])) for path, x in true.items()}


def of_forces(circuit: fs.Circuit, kind: str, sets: int) -> dict[str, float]:
    """Coverage for gap, resistance and alpha; `kind` says what is known of the noise: given, equal or shares."""
    data, found = forces(circuit.replace(TRUE), VOLTAGES, FREQUENCIES), []
    force = data["f_el_mean"]
    sigma = NOISE * (np.full(force.size, force.mean()) if kind == "equal" else force)
    for seed in range(sets):
        noisy = force + sigma * np.random.default_rng(seed).standard_normal(force.size)
        own = {**data, "f_el_mean": noisy, **({"sigma": sigma} if kind == "given" else {})}
        found.append(fs.fit(circuit, own, list(TRUE), skin="follow", starts=1, rtol=1e-5).estimates)
    return share_covered(found, TRUE)


def of_contacts(circuit: fs.Circuit, sets: int) -> dict[str, float]:
    """Coverage for a contact's six parameters."""
    c, fn, depth, found = CONTACT, np.geomspace(0.1, 2.0, 8), np.linspace(0.3, 1.2, 8), []
    rest, friction = c["alpha"] * fn ** c["m_exp"], c["mu"] * fn
    sliding, pressed = rest - c["c2"] * friction**2 / rest, c["beta"] * depth ** c["n_exp"]
    for seed in range(sets):
        rng = np.random.default_rng(seed)
        one, two, three, four = (np.exp(s * rng.standard_normal(8)) for s in (0.05, 0.05, 0.08, 0.03))
        loaded = {"fn": fn, "area": 1e-6 * rest * one, "area_sliding": 1e-6 * sliding * two, "f_t": friction * three}
        own = [loaded, {"indentation": 1e-3 * depth, "area": 1e-6 * pressed * four}]
        found.append(fs.fit_contact(circuit, own).estimates)
    return share_covered(found, {f"Xgap.{name}": value for name, value in c.items()})


def named(
    circuit: fs.Circuit, paths: list[str], conditions: tuple[tuple[float, ...], ...], sets: int, count: int
) -> int:
    """In how many fits to fingers drawn at random it is said that the parameters are not told apart."""
    said = 0
    for seed in range(sets):
        rng = np.random.default_rng(seed)
        drawn = {path: value * float(np.exp(0.2 * rng.standard_normal())) for path, value in TRUE.items()}
        finger = circuit.replace(drawn)
        data = {name: np.tile(x, count) for name, x in forces(finger, *conditions).items()}
        data["f_el_mean"] = data["f_el_mean"] * (1.0 + NOISE * rng.standard_normal(data["f_el_mean"].size))
        start = circuit.replace({path: value for path, value in drawn.items() if path not in paths})
        notes = fs.fit(start, data, paths, skin="follow", starts=1, rtol=1e-5).notes
        said += any(all(path in note for path in paths) and "not told apart" in note for note in notes)
    return said


def main(arguments: list[str] | None = None) -> dict[str, Any]:
    """Run everything, and print and write the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sets", type=int, default=500)
    parser.add_argument("--quick", action="store_true", help="two sets of each, and nothing is written")
    given = parser.parse_args(arguments)
    sets, few = (2, 2) if given.quick else (given.sets, 20)
    circuit, begin = fs.read_netlist(ROOT / "circuits" / "fingerpad.cir"), time.perf_counter()
    results: dict[str, Any] = {"sets": sets, "coverage": {}}
    for kind in ("given", "equal", "shares"):
        results["coverage"][kind] = of_forces(circuit, kind, sets)
        print(f"sigma {kind}: {results['coverage'][kind]}", flush=True)
    results["coverage"]["contact"] = of_contacts(circuit, sets)
    print(f"contact: {results['coverage']['contact']}", flush=True)
    one = ((200.0,), (100.0,))
    results["named"] = {
        "of": few,
        "gap and alpha at one voltage and frequency": named(circuit, ["Xgap.d", "Xgap.alpha"], one, few, 6),
        "gap and resistance at several": named(circuit, ["Xgap.d", "Xgap.r"], (VOLTAGES, FREQUENCIES), few, 1),
    }
    print(f"named: {results['named']}; {time.perf_counter() - begin:.0f} s")
    if not given.quick:
        RESULTS.write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")
    return results


if __name__ == "__main__":
    main()
