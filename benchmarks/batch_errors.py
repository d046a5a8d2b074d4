"""True errors of scenes in lockstep, over asked and over stated ones, under every kind of source and start.

Fingers of four decades of leaks, both resistances, start uncharged under a source of any phase; the runs compared with
are exponential steps at 1e-11. Usage: ``python benchmarks/batch_errors.py [--quick] [--scenes N] [--seed N]
[--only NAME]``; writes ``benchmarks/results/batch_errors.json`` unless quick, or one kind is asked for.
"""

from __future__ import annotations

import argparse
import json
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

import fingerspice as fs
from batch import noise

HERE = Path(__file__).resolve().parent
OUTPUTS = ("f_el_mean", "f_t_rms", "u_gap_rms")
#: Lengths of the runs in periods of 100 Hz.
PERIODS = (0.5, 1, 5)
Random = np.random.Generator


def _sine(r: Random) -> fs.Waveform:
    return fs.Sine(r.uniform(50, 300), 100.0, phase_deg=r.uniform(0, 360))


def _plain(r: Random) -> fs.Waveform:
    return fs.Sine(r.uniform(50, 300), 100.0)


def _offset(r: Random) -> fs.Waveform:
    return fs.Sine(r.uniform(50, 200), 100.0, offset=r.uniform(-100, 100), phase_deg=r.uniform(0, 360))


def _late(r: Random) -> fs.Waveform:
    return fs.Sine(r.uniform(50, 300), 100.0, delay=r.uniform(0.0, 0.004))


def _am(r: Random) -> fs.Waveform:
    return fs.AM(r.uniform(50, 300), 1000.0, 100.0, r.uniform(0.2, 1.0), r.uniform(0, 360))


def _square(r: Random) -> fs.Waveform:
    return fs.Square(r.uniform(50, 300), 100.0)


def _recording(r: Random) -> fs.Waveform:
    samples = noise(1000.0)
    begin = int(r.integers(500))
    return fs.Samples(samples.values[begin:], samples.rate)


#: By kind: the source of the scenes, and a second one in series where there is one.
KINDS: dict[str, tuple[Callable[[Random], fs.Waveform], ...]] = {
    "sine from 0 V": (_plain,), "sine of any phase": (_sine,), "two sines": (_sine, _sine), "AM": (_am,),
    "square": (_square,), "recording": (_recording,), "sine with offset": (_offset,), "late sine": (_late,),
}  # fmt: skip


def circuit_of(kind: str, r: Random) -> fs.Circuit:
    """Table 1's stack with the sources of a kind; of two, the second has five times the frequency."""
    text = (HERE.parent / "circuits" / "fingerpad.cir").read_text()
    line = next(line for line in text.splitlines() if line.startswith("Vdrive"))
    two = text.replace(line, "Vdrive drive between SIN(0 200 100)\nVmore between 0 SIN(0 200 500)")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        circuit = fs.parse_netlist(two if len(KINDS[kind]) > 1 else text)
    first, *others = (make(r) for make in KINDS[kind])
    changes: dict[str, Any] = {"Vdrive": first}
    for more in others:
        assert isinstance(more, fs.Sine)
        changes["Vmore"] = fs.Sine(more.amplitude, 500.0, phase_deg=more.phase_deg)
    return circuit.replace(changes)


def fingers(n: int, r: Random) -> dict[str, np.ndarray]:
    return {
        "Xgap.r": 10.0 ** r.uniform(4.0, 8.0, n),
        "Xcoat.r": 10.0 ** r.uniform(3.0, 7.0, n),
        "Xgap.fn": r.uniform(0.1, 2.0, n),
        "Xgap.d": r.uniform(2e-6, 6e-6, n),
    }


def expected(circuit: fs.Circuit, scenes: dict[str, np.ndarray], stop: float) -> np.ndarray:
    """The outputs of single runs, shape (n_output, n_scene)."""
    rows = []
    for i in range(scenes["Xgap.r"].size):
        one = circuit.varied({path: float(values[i]) for path, values in scenes.items()})
        run = fs.simulate(one, t_stop=stop, t_eval=[stop], rtol=1e-11, method="exponential", charge=False)
        rows.append([run.summary()[name] for name in OUTPUTS])
    return np.array(rows).T


def measure(kind: str, n: int, seed: int, tolerances: tuple[float, ...]) -> list[dict[str, Any]]:
    """How far the outputs of batches are off, of runs of every length, at every tolerance."""
    r, rows = np.random.default_rng(seed), []
    for periods in PERIODS:
        circuit, scenes = circuit_of(kind, r), fingers(n, r)
        true = expected(circuit, scenes, periods / 100.0)
        for rtol in tolerances:
            found = fs.batch(circuit, scenes, outputs=OUTPUTS, t_stop=periods / 100.0, rtol=rtol)
            off = np.abs(np.array([found[name].to_numpy() for name in OUTPUTS]) / true - 1.0).max(axis=0)
            stated, single = found.error.to_numpy(), found.attrs["n_ordinary"]
            rows.append({"kind": kind, "periods": periods, "rtol": rtol, "n": n, "n_ordinary": single,
                         "off_over_asked": float(off.max() / rtol), "missed": int(np.sum(off > rtol)),
                         "off_over_stated": float((off / stated).max()),
                         "covered": float(np.mean(off <= stated + 1e-10))})  # fmt: skip
            print("{kind:18} {periods:3g} periods {rtol:.0e}: off over asked {off_over_asked:8.2f}, over stated "
                  "{off_over_stated:8.2f}, covered {covered:6.1%}, one by one {n_ordinary} of {n}"
                  .format(**rows[-1]), flush=True)  # fmt: skip
    return rows


def main(arguments: list[str] | None = None) -> dict[str, Any]:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--scenes", type=int, default=60)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", choices=sorted(KINDS))
    options = parser.parse_args(arguments)
    n, tolerances = (4, (1e-4,)) if options.quick else (options.scenes, (1e-4, 1e-6, 1e-7))
    kinds = [options.only] if options.only else ["sine of any phase"] if options.quick else list(KINDS)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        rows = [row for kind in kinds for row in measure(kind, n, options.seed, tolerances)]
    results = {"rows": rows}
    if not (options.quick or options.only):
        (HERE / "results" / "batch_errors.json").write_text(json.dumps(results, indent=1) + "\n")
    return results


if __name__ == "__main__":
    main()
