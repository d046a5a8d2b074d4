"""Statistics on random recordings: fraction of runs whose stated error covers the true error, and their ratio.

A recording is noise of a random band at a random rate, with or without an offset; a circuit is a stack of random
layers, with either charge law, or with `--networks` such a finger behind an amplifier, beside a load or on a floating
body, with the local law. It is run at each of `RTOLS`, and once at `TIGHT` by the `exponential` method, which
gives the true errors of gap voltage, force, charge and node voltages.

Run: python tests/recording_errors.py [--recordings 100] [--first 0] [--networks].
A recording is determined by its number alone.
"""

from __future__ import annotations

import argparse
import random
import warnings
from dataclasses import dataclass

import numpy as np

import fingerspice as fs
from network_errors import AROUND, surrounded
from random_decks import layers

RTOLS, TIGHT = (1e-3, 1e-4, 1e-6, 1e-8), 1e-12
QUANTITIES = ("u_gap", "f_el", "q_source", "v_nodes")
# What the tight run may be off but for its stated error, over the peak; and the least true error, over what is not
# known of it, of which a ratio says something.
ROUNDING, KNOWN = 1e-13, 10.0


@dataclass(frozen=True)
class Recording:
    """A random recording and circuit; `kind` says in words what they are."""

    number: int
    kind: str
    circuit: fs.Circuit
    samples: fs.Samples
    law: str


@dataclass(frozen=True)
class Beside:
    """The stated error of a quantity of a run, and the true one with what is not known of it, over the peak."""

    recording: Recording
    rtol: float
    quantity: str
    stated: float
    true: float
    unknown: float

    @property
    def covered(self) -> bool:
        """Whether the stated error is not below the true one, as far as that is known."""
        return self.true <= self.stated + self.unknown

    @property
    def ratio(self) -> float | None:
        """Stated over true error; None where the true one is near rounding."""
        return self.stated / self.true if self.true > KNOWN * self.unknown else None


def noise(seed: int, count: int, rate: float, low: float, high: float) -> np.ndarray:
    """Gaussian noise of a band (Hz), its largest value 1, shape (count,)."""
    spectrum = np.fft.rfft(np.random.default_rng(seed).standard_normal(count))
    frequency = np.fft.rfftfreq(count, 1.0 / rate)
    spectrum[(frequency < low) | (frequency > high)] = 0.0
    values = np.fft.irfft(spectrum, count)
    return np.asarray(values / np.abs(values).max())


def draw(number: int, count: int = 600, network: bool = False) -> Recording:
    """Recording of a number."""
    rng = random.Random(f"recordings {number}")
    law, rate = rng.choice(("local", "mobile")), rng.choice((2e3, 8e3, 48e3, 48e3, 192e3))
    high = rate * rng.choice((0.02, 0.1, 0.4))
    volts, offset = rng.uniform(30.0, 200.0), rng.choice((0.0, 0.0, 0.5))
    entry, lines, around = "drive", layers(rng, False, "drive", "0", "area"), ""
    if network:
        law, around = "local", rng.choice(AROUND)
        entry, lines = surrounded(rng, around)
    text = ["recording", f"Vdrive {entry} 0 0", *lines, ".end\n"]
    values = volts * (offset + noise(number, count, rate, 0.1 * high, high))
    start = rng.choice((0.0, 0.0, 2.3 / rate))
    kind = f"{rate / 1e3:g} kHz, up to {high:g} Hz, {volts:.0f} V, offset {offset:g}, {law} {around}"
    return Recording(number, kind, fs.parse_netlist("\n".join(text)), fs.Samples(values, rate, start), law)


def judge(recording: Recording) -> list[Beside]:
    """Stated and true errors of all quantities at all tolerances; none where the samples were not followed."""
    samples = recording.samples
    stop = samples.start + (samples.values.size - 1.6) / samples.rate
    # Samples and other times.
    on = samples.start + np.arange(0, samples.values.size - 2, 3) / samples.rate
    t = np.sort(np.append(on, np.random.default_rng(recording.number).uniform(0.0, stop, 300)))

    def run(rtol: float, method: str) -> fs.Solution:
        return fs.simulate(
            recording.circuit, sources=samples, t_stop=stop, t_eval=t, charge_law=recording.law, rtol=rtol,
            method=method, jumps="none", start="uncharged", throw=False,
        )  # fmt: skip

    found = []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", fs.FingerspiceWarning)
        runs = {rtol: run(rtol, "auto") for rtol in RTOLS}
        if not all(one.method == "relaxation" and one.success for one in runs.values()):
            return []
        exact = run(TIGHT, "exponential")
    for rtol, one in runs.items():
        for name in QUANTITIES:
            truth, values = (
                np.column_stack(list(run.node_voltages.values())) if name == "v_nodes" else getattr(run, name)
                for run in (exact, one)
            )
            peak = float(np.abs(truth).max())
            off = float(np.abs(values - truth).max())
            unknown = getattr(exact.error, name) / peak + ROUNDING
            found.append(Beside(recording, rtol, name, getattr(one.error, name) / peak, off / peak, unknown))
    return found


def main() -> None:
    """Judge many recordings, and print a line for each quantity and tolerance."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("--recordings", type=int, default=100)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--networks", action="store_true")
    given = parser.parse_args()
    found: list[Beside] = []
    not_followed = 0
    for number in range(given.first, given.first + given.recordings):
        one = judge(draw(number, network=given.networks))
        not_followed += not one
        found += one
        for x in one:
            if not x.covered or (x.quantity != "q_source" and x.true > x.rtol):
                print(f"{number}: {x.quantity} at {x.rtol:g}: {x.true:.2e}, stated {x.stated:.2e}; {x.recording.kind}")
    print(f"{not_followed} of {given.recordings} recordings were not followed sample by sample")
    for name in QUANTITIES:
        for rtol in RTOLS:
            these = [x for x in found if x.quantity == name and x.rtol == rtol]
            ratios = np.array([x.ratio for x in these if x.ratio is not None])
            print(
                f"{name:9} at {rtol:g}: {sum(x.covered for x in these)} of {len(these)} covered, "
                f"stated/true median {np.median(ratios):.1f}, {np.mean(ratios <= 10.0):.0%} within 10"
            )


if __name__ == "__main__":
    main()
