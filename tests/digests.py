"""Digests of 74 runs with their stated errors, for comparison before and after a change of the engine.

A digest has gap voltages, forces and the first source's charge at 40 times. Two agree where they differ by no more than
both errors that are stated.

Run: python tests/digests.py FILE.json writes the digests where there is no such file, and compares with it otherwise.
"""

import json
import sys
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

import fingerspice as fs
from recording_errors import noise

CIRCUITS = Path(__file__).parents[1] / "circuits"
QUANTITIES = ("u_gap", "f_el", "q_source")
RATE = 48e3


def recording(high: float, seed: int = 1) -> fs.Samples:
    return fs.Samples(150.0 * noise(seed, 4800, RATE, 20.0, high), RATE)


def uneven() -> fs.PWL:
    rng = np.random.default_rng(3)
    t = np.concatenate([[0.0], np.cumsum(rng.uniform(0.2, 1.8, 2000)) * 2e-5])
    return fs.PWL(t, 100.0 * np.sin(900.0 * t) + 20.0 * np.sin(7000.0 * t + 1.0))


SOURCES: dict[str, Callable[[], fs.Waveform]] = {
    "its own": lambda: fs.DC(0.0),
    "square": lambda: fs.Square(120.0, 150.0),
    "to 1 kHz": lambda: recording(1e3),
    "to 20 kHz": lambda: recording(2e4),
    "uneven": uneven,
}


def scenes() -> Iterator[tuple[str, str, str, float]]:
    """Deck, source, law and rtol of every run."""
    for deck in ("fingerpad", "fingerpad_dispersive"):
        for source in SOURCES:
            for law in ("local", "mobile"):
                yield from ((deck, source, law, rtol) for rtol in (1e-4, 1e-6, 1e-8))


def networks() -> Iterator[tuple[str, str, str, float]]:
    for deck in ("amplifier", "ungrounded_user", "two_fingers", "current_drive"):
        for source in ("its own", "to 1 kHz") if deck != "current_drive" else ("its own",):
            yield from ((deck, source, "local", rtol) for rtol in (1e-4, 1e-8))


def digest(deck: str, source: str, law: str, rtol: float) -> dict[str, Any]:
    circuit = fs.read_netlist(CIRCUITS / f"{deck}.cir")
    name = next(e.name for e in circuit.elements if e.waveform is not None)
    given = None if source == "its own" else {name: SOURCES[source]()}
    t = np.linspace(0.0, 0.0373, 41)[1:]
    run = fs.simulate(circuit, sources=given, t_stop=0.0373, t_eval=t, charge_law=law, rtol=rtol, jumps="none")
    values = {key: np.reshape(getattr(run, key), (t.size, -1))[:, 0].tolist() for key in QUANTITIES}
    return {"method": run.method, "values": values, "errors": {key: getattr(run.error, key) for key in QUANTITIES}}


def differences(old: dict[str, Any], new: dict[str, Any]) -> list[str]:
    """Where two digests of a run differ by more than both state."""
    found = []
    for key in QUANTITIES:
        off = float(np.abs(np.subtract(old["values"][key], new["values"][key])).max())
        allowed = old["errors"][key] + new["errors"][key]
        if not off <= allowed:
            found.append(f"{key} differs by {off:.3g}, stated are {allowed:.3g}")
    return found


def main(path: Path) -> int:
    """Write or compare; returns how many runs differ."""
    warnings.simplefilter("ignore", fs.FingerspiceWarning)
    found = {" | ".join(map(str, scene)): digest(*scene) for scene in (*scenes(), *networks())}
    if not path.exists():
        path.write_text(json.dumps(found) + "\n")
        print(f"wrote {len(found)} digests")
        return 0
    known, wrong = json.loads(path.read_text()), 0
    for name, new in found.items():
        said = differences(known[name], new)
        if known[name]["method"] != new["method"]:
            print(f"{name}: {known[name]['method']} before, {new['method']} now")
        wrong += bool(said)
        for line in said:
            print(f"{name}: {line}")
    print(f"{wrong} of {len(found)} runs differ")
    return wrong


if __name__ == "__main__":
    sys.exit(min(main(Path(sys.argv[1])), 1))
