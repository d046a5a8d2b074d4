"""Statistics on random networks: fraction of runs whose stated error covers the true error, and their ratio.

A network has one to three fingers, in parallel or in series, grounded or on a floating body, behind an amplifier with a
cable or parallel to a load, under a sine, a square, a chirp or straight lines, with either charge law. It is run at
each of `RTOLS` and once at `TIGHT`, which gives the true errors of gap voltage, force, charge and node voltages.

Run: python tests/network_errors.py [--networks 100] [--first 0]. A network is determined by its number alone.
"""

import argparse
import random
import warnings
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

import fingerspice as fs
from random_decks import layers

RTOLS, TIGHT = (1e-4, 1e-6, 1e-8), 1e-12
AROUND = ("amplifier", "load", "floating", "amplifier and floating")
SOURCES = ("sine", "square", "chirp", "lines")
QUANTITIES = ("u_gap", "f_el", "q_source", "v_nodes")
# What the tight run may be off: its stated error, and rounding, over the peak. A true error that is no more than ten
# times that is not known well enough for a ratio.
ROUNDING, KNOWN = 1e-13, 10.0


@dataclass(frozen=True)
class Network:
    """A random circuit, what it is in words, and how long it is run (s)."""

    number: int
    kind: dict[str, str]
    circuit: fs.Circuit
    law: str
    stop: float


@dataclass(frozen=True)
class Beside:
    """The stated error of a quantity of a run, and the true one with what is not known of it, over the peak."""

    of: Any  # What was drawn, a `Network` or a `recording_errors.Recording`
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


def _waveform(rng: random.Random, kind: str, f: float, volts: float) -> fs.Waveform:
    if kind == "sine":
        return fs.Sine(volts, f, offset=rng.choice((0.0, 0.3 * volts)))
    if kind == "square":
        return fs.Square(volts, f, duty=rng.choice((0.5, 0.3)))
    if kind == "chirp":
        return fs.Chirp(volts, 0.5 * f, 3.0 * f, 2.0 / f)
    # With a jump, and a piece at rest.
    t = sorted(rng.uniform(0.05, 1.9) / f for _ in range(4))
    levels = [volts * rng.uniform(-1.0, 1.0) for _ in range(4)]
    return fs.PWL((0.0, t[0], t[1], t[1], t[2], t[3]), (0.0, *levels[:3], levels[3], levels[3]))


def surrounded(
    rng: random.Random, around: str, fingers: int = 1, slow: bool = False, row: bool = False
) -> tuple[str, list[str]]:
    """Node of the source, and lines of a deck: fingers with random layers, and what is around them."""
    ground = "body" if "floating" in around else "0"
    # Where the fingers stand one behind the other, each has a node with a capacitance to ground below it.
    ends = ["drive", *(f"n{i}" for i in range(1, fingers)), ground] if row else ["drive", ground]
    lines = [f"C{node} {node} 0 {rng.uniform(20.0, 200.0):.1f}p" for node in ends[1:-1]]
    for i in range(fingers):
        top, low = (ends[i], ends[i + 1]) if row else ends
        lines += layers(rng, slow, top, low, f"area{i}", str(i))
    if "amplifier" in around:
        lines += [f"Rout amp drive {10.0 ** rng.uniform(3.0, 5.5):.4g}", f"Ccable drive 0 {rng.uniform(20, 300):.1f}p"]
    elif around == "load":
        lines += [f"Rload drive far {10.0 ** rng.uniform(4.0, 6.0):.4g}", f"Cload far 0 {rng.uniform(0.1, 2.0):.2f}n"]
    if "floating" in around:
        lines += [f"Rbody body earth {10.0 ** rng.uniform(3.0, 5.0):.4g}", f"Cbody earth 0 {rng.uniform(80, 400):.1f}p"]
    return "amp" if "amplifier" in around else "drive", lines


def draw(number: int) -> Network:
    """Network of a number."""
    rng = random.Random(f"stated errors {number}")
    around, source = AROUND[number % 4], SOURCES[number // 4 % 4]
    law, fingers = rng.choice(("local", "mobile")), rng.choice((1, 1, 2, 3))
    slow, volts, f = rng.random() < 0.15, rng.uniform(30.0, 160.0), 10.0 ** rng.uniform(1.7, 3.8)
    row = fingers > 1 and rng.random() < 0.3
    entry, lines = surrounded(rng, around, fingers, slow, row)
    text = "\n".join(
        [f"network {number}", f"Vdrive {entry} 0 0", *lines, f".tran {0.01 / f:g} {2.0 / f:g} uic", ".end\n"]
    )
    circuit = fs.parse_netlist(text).replace({"Vdrive": _waveform(rng, source, f, volts)})
    kind = {"around": around, "source": source, "law": law, "fingers": str(fingers) + (" in a row" if row else "")}
    return Network(number, kind | {"area": "slow" if slow else "at once"}, circuit, law, 2.0 / f)


def _signals(run: fs.Solution) -> dict[str, np.ndarray]:
    """The quantities, a column for each finger, source or node."""
    found = {name: getattr(run, name).reshape(run.t.size, -1) for name in QUANTITIES[:-1]}
    return found | {"v_nodes": np.column_stack(list(run.node_voltages.values()))}


def beside(of: Any, runs: dict[float, fs.Solution], exact: fs.Solution) -> list[Beside]:
    """The errors of runs by their tolerances, and what a tight run says of them."""
    truth, whole, found = _signals(exact), exact.summary(), []
    for rtol, one in runs.items():
        for name, values in _signals(one).items():
            # Of one finger over the run, whose outputs may miss it.
            peak = max(float(np.abs(truth[name]).max()), whole.get(f"{name}_peak") or 0.0)
            stated, doubt = (getattr(s.error, name) for s in (one, exact))
            if stated is not None and peak > 0.0:
                off, unknown = float(np.abs(values - truth[name]).max()), (doubt or 0.0) / peak + ROUNDING
                found.append(Beside(of, rtol, name, stated / peak, off / peak, unknown))
    return found


def judge(network: Network) -> list[Beside] | str:
    """Stated and true errors of all quantities at all tolerances; or why there is none: a fold, or no tight run."""
    # Times that are no step ends, so that no output is more right than its step.
    t = np.sort(np.random.default_rng(network.number).uniform(0.0, network.stop, 400))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", fs.FingerspiceWarning)
        exact, *runs = (
            fs.simulate(network.circuit, t_stop=network.stop, t_eval=t, charge_law=network.law, rtol=rtol, throw=False)
            for rtol in (TIGHT, *RTOLS)
        )
    if exact.status not in (fs.Status.SUCCESS, fs.Status.ERROR_NOT_MET):
        return exact.status.name
    for rtol, one in zip(RTOLS, runs, strict=True):
        if not one.success:
            return f"{one.status.name} at {rtol:g}"
    return beside(network, dict(zip(RTOLS, runs, strict=True)), exact)


def table(found: Iterable[Beside], group: Callable[[Beside], str]) -> list[str]:
    """Coverage, and median, ninth tenth and largest of stated over true error, a line for each group."""
    groups: dict[str, list[Beside]] = {}
    for x in found:
        groups.setdefault(group(x), []).append(x)
    lines = []
    for name, members in groups.items():
        ratios = np.array([x.ratio for x in members if x.ratio is not None])
        text = f"{name:34s} {sum(x.covered for x in members):5d} of {len(members):5d} covered"
        if ratios.size:
            shares = np.percentile(ratios, [50, 90])
            text += f"; stated/true of {ratios.size:4d}: {shares[0]:8.2f} {shares[1]:8.1f} {ratios.max():8.0f}"
            text += f", {np.mean(ratios <= 10.0):6.1%} within 10"
        lines.append(text)
    return lines


def coverage(found: Iterable[Beside]) -> float:
    """Share of the stated errors that cover the true ones."""
    return float(np.mean([x.covered for x in found]))


def measure(numbers: Iterable[int]) -> tuple[list[Beside], dict[int, str]]:
    """All that was judged, and why some networks were not."""
    found: list[Beside] = []
    refused: dict[int, str] = {}
    for number in numbers:
        one = judge(draw(number))
        if isinstance(one, str):
            refused[number] = one
        else:
            found += one
    return found, refused


def main(arguments: list[str] | None = None) -> None:
    """Judge networks and print how their stated errors stand."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--networks", type=int, default=100)
    parser.add_argument("--first", type=int, default=0)
    options = parser.parse_args(arguments)
    found, refused = measure(range(options.first, options.first + options.networks))
    print(f"{options.networks - len(refused)} networks judged; stated/true: median, 90 %, largest")
    for number, why in refused.items():
        print(f"  network {number} not judged: {why}")
    print("\n".join(table(found, lambda x: f"{x.quantity} at {x.rtol:g}")))
    print("\n".join(table(found, lambda x: x.quantity)))
    for part in ("around", "source", "law", "fingers", "area"):
        print("\n".join(table(found, lambda x, part=part: f"{part}: {x.of.kind[part]}")))
    worst = sorted((x for x in found if not x.covered), key=lambda x: x.stated / x.true)[:20]
    for x in worst:
        print(f"not covered: network {x.of.number} {x.quantity} at {x.rtol:g}, {x.stated / x.true:.2g} of the true")


if __name__ == "__main__":
    main()
