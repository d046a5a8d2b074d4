"""Statistics on random recordings: fraction of runs whose stated error covers the true error, and their ratio.

A recording is noise of a random band at a random rate, with or without an offset; a circuit is a stack of random
layers, with either charge law, or with `--networks` such a finger behind an amplifier, beside a load or on a floating
body, with the local law. It is run at each of `RTOLS`, and once at `TIGHT` by the `exponential` method, which
gives the true errors of gap voltage, force, charge and node voltages.

Run: python tests/recording_errors.py [--recordings 100] [--first 0] [--networks].
A recording is determined by its number alone.
"""

import argparse
import random
import warnings
from dataclasses import dataclass

import numpy as np

import fingerspice as fs
from network_errors import AROUND, QUANTITIES, TIGHT, Beside, beside, surrounded, table
from random_decks import layers

RTOLS = (1e-3, 1e-4, 1e-6, 1e-8)


@dataclass(frozen=True)
class Recording:
    """A random recording and circuit; `kind` says in words what they are."""

    number: int
    kind: str
    circuit: fs.Circuit
    samples: fs.Samples
    law: str


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


def judge(recording: Recording, rtols: tuple[float, ...] = RTOLS) -> list[Beside]:
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

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", fs.FingerspiceWarning)
        runs = {rtol: run(rtol, "auto") for rtol in rtols}
        if not all(one.method == "relaxation" and one.success for one in runs.values()):
            return []
        return beside(recording, runs, run(TIGHT, "exponential"))


def assert_that_stated_errors_hold(found: list[Beside]) -> None:
    """Of many recordings: 95 % of the errors are covered, what was asked is met, and ratios are as documented."""
    assert np.mean([x.covered for x in found]) >= 0.95
    for x in found:
        if x.quantity in ("u_gap", "f_el"):
            assert x.true <= x.rtol
    for quantity in QUANTITIES:
        ratios = [x.ratio for x in found if x.ratio is not None and x.quantity == quantity]
        assert np.median(ratios) <= 4.0
        assert np.mean(np.array(ratios) <= 10.0) >= 0.9


def main() -> None:
    """Judge many recordings, and print a line for each quantity and tolerance."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("--recordings", type=int, default=100)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--networks", action="store_true")
    given = parser.parse_args()
    drawn = [draw(number, network=given.networks) for number in range(given.first, given.first + given.recordings)]
    judged = [judge(one) for one in drawn]
    found = [x for one in judged for x in one]
    for x in found:
        if not x.covered or (x.quantity != "q_source" and x.true > x.rtol):
            print(f"{x.of.number}: {x.quantity} at {x.rtol:g}: {x.true:.2e}, stated {x.stated:.2e}; {x.of.kind}")
    print(f"{judged.count([])} of {given.recordings} recordings were not followed sample by sample")
    print("\n".join(table(found, lambda x: f"{x.quantity} at {x.rtol:g}")))


if __name__ == "__main__":
    main()
