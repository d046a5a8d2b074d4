"""Recordings: time and error per sample, for the coupled model and the closed form, compared with a user's own code.

Noise of three bands, sampled at 48 kHz, drives Table 1's stack. Every contestant gives the gap voltage at every sample;
its error over the first tenth of a second, relative to the peak, is taken against fingerspice's `exponential` method at
1e-11. Contestants: whole calls of `fs.simulate` at four tolerances, with and without charge and current, under the law
`mobile`, and with the dispersive skin; a loop in numba (classical Runge-Kutta, one step per sample, the area from a
table); scipy's LSODA, restarted at every sample; and, for a given area, scipy's lfilter. Then one finger behind an
amplifier, on a floating body and under a current, beside the `exponential` method, which takes every sample as a corner
of straight lines.

Run: python benchmarks/recordings.py [--quick]. Medians of 7, without compile time; writes results/recordings.json.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
import tracemalloc
import warnings
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numba import njit
from scipy import integrate, signal

import fingerspice as fs
from fingerspice.physics.contact import inverse_areas
from fingerspice.solve.scenes import scene_of
from throughput import equivalent_filter, modal_gap
from timing import median_seconds

HERE = Path(__file__).resolve().parent
CIRCUITS = HERE.parent / "circuits"
RATE = 48_000.0
BANDS = (1_000.0, 8_000.0, 20_000.0)
RTOLS = (1e-3, 1e-4, 1e-6, 1e-8)
NETWORKS = ("amplifier", "ungrounded_user", "current_drive")
# Number of samples, from the start, over which errors are taken.
CHECKED = 4_801
Report = dict[str, Any]


def noise(count: int, high: float) -> np.ndarray:
    """Gaussian noise from 50 Hz to `high` (Hz), clipped at 200 V; its start does not depend on the length (count,)."""
    taps = signal.firwin(2047, [50.0, high], fs=RATE, pass_zero=False)
    white = np.random.default_rng(0).standard_normal(count + taps.size - 1)
    values = signal.oaconvolve(white, taps, "valid")
    return np.asarray(200.0 * values / (5.0 * np.std(values[:CHECKED]))).clip(-200.0, 200.0)


def stack(skin: str) -> fs.Circuit:
    """Table 1's stack with the skin device `skin`."""
    text = (CIRCUITS / "fingerpad.cir").read_text()
    frozen = "SKIN  d=350u f=100"
    assert frozen in text
    return fs.parse_netlist(text if skin == "SKIN" else text.replace(frozen, f"{skin} d=350u"))


def run(circuit: fs.Circuit, values: np.ndarray, rtol: float, **options: Any) -> fs.Solution:
    """A run driven by samples (V), with outputs at every sample."""
    count = values.size
    given = {"t_eval": np.arange(count) / RATE, "jumps": "none", "start": "uncharged"} | options
    return fs.simulate(circuit, sources=fs.Samples(values, RATE), t_stop=(count - 1) / RATE, rtol=rtol, **given)


@njit(error_model="numpy")
def _slopes(x: Any, u: float, k: Any, rate: Any, rate0: Any, gap: int, table: Any, per_volt: float, out: Any) -> None:
    place = abs(k[gap] * u + x[gap]) * per_volt
    i = min(int(place), table.size - 2)
    q = table[i] + (place - i) * (table[i + 1] - table[i])
    total, last = 0.0, 0.0
    for j in range(x.size):
        total += (rate[j] + q * rate0[j]) * (k[j] * u + x[j])
        last -= x[j]
    total += (rate[-1] + q * rate0[-1]) * (k[-1] * u + last)
    for j in range(x.size):
        out[j] = k[j] * total - (rate[j] + q * rate0[j]) * (k[j] * u + x[j])


@njit(error_model="numpy")
def _runge_kutta(
    values: Any, h: float, k: Any, rate: Any, rate0: Any, gap: int, table: Any, per_volt: float, out: Any
) -> None:
    n = k.size - 1
    x, y = np.zeros(n), np.empty(n)
    a, b, c, d = np.empty(n), np.empty(n), np.empty(n), np.empty(n)
    out[0] = k[gap] * values[0]
    for i in range(values.size - 1):
        u, v = values[i], values[i + 1]
        m = 0.5 * (u + v)
        _slopes(x, u, k, rate, rate0, gap, table, per_volt, a)
        for j in range(n):
            y[j] = x[j] + 0.5 * h * a[j]
        _slopes(y, m, k, rate, rate0, gap, table, per_volt, b)
        for j in range(n):
            y[j] = x[j] + 0.5 * h * b[j]
        _slopes(y, m, k, rate, rate0, gap, table, per_volt, c)
        for j in range(n):
            y[j] = x[j] + h * c[j]
        _slopes(y, v, k, rate, rate0, gap, table, per_volt, d)
        for j in range(n):
            x[j] += h / 6.0 * (a[j] + 2.0 * (b[j] + c[j]) + d[j])
        out[i + 1] = k[gap] * v + x[gap]


class Loop:
    """Code that a user might write: a Runge-Kutta method in numba with a table for the area."""

    def __init__(self, circuit: fs.Circuit) -> None:
        scene = scene_of(circuit, "local", "coupled", 1.0)
        assert scene.model is not None
        self.model, u = scene.model, np.linspace(0.0, 260.0, 20_001)
        self.table, self.per_volt = inverse_areas(u, self.model.curve), 1.0 / u[1]
        self.gap = int(np.flatnonzero(self.model.gap)[0])

    def __call__(self, values: np.ndarray) -> np.ndarray:
        out, m = np.empty(values.size), self.model
        _runge_kutta(values, 1.0 / RATE, m.k, m.rate, m.rate0, self.gap, self.table, self.per_volt, out)
        return out

    def lsoda(self, values: np.ndarray, rtol: float) -> np.ndarray:
        """The same equations by LSODA, with one call per sample."""
        x, m, out = np.zeros(self.model.k.size - 1), self.model, np.empty(values.size)
        out[0] = m.k[self.gap] * values[0]
        slopes = np.empty(x.size)
        for i in range(values.size - 1):
            u, rise = values[i], (values[i + 1] - values[i]) * RATE

            def rates(t: float, y: np.ndarray, u: float = u, rise: float = rise) -> np.ndarray:
                _slopes(y, u + rise * t, m.k, m.rate, m.rate0, self.gap, self.table, self.per_volt, slopes)
                return slopes

            x = integrate.solve_ivp(rates, (0.0, 1.0 / RATE), x, "LSODA", rtol=rtol, atol=200.0 * rtol).y[:, -1]
            out[i + 1] = m.k[self.gap] * values[i + 1] + x[self.gap]
        return out


def band(high: float, seconds: float, repeats: int) -> list[Report]:
    """Every contestant on noise of one band."""
    values = noise(int(seconds * RATE) + 1, high)
    out: list[Report] = []
    for skin in ("SKIN", "SKIN_DISPERSIVE"):
        circuit = stack(skin)
        exact = run(circuit, values[:CHECKED], 1e-11, method="exponential").u_gap
        peak = float(np.abs(exact).max())

        def note(
            name: str,
            action: Any,
            gap: Any,
            count: int,
            times: int = repeats,
            skin: str = skin,
            exact: Any = exact,
            peak: float = peak,
        ) -> None:
            took = median_seconds(action, times)
            off = float(np.abs(gap[:CHECKED] - exact[: gap.size]).max()) / peak
            error = off if off < 1.0 else None
            out.append(
                {
                    "band_Hz": high,
                    "skin": skin,
                    "contestant": name,
                    "samples": count,
                    "error": error,
                    "ns_per_sample": 1e9 * took / (count - 1),
                }
            )

        for rtol in RTOLS:
            for charge in (False, True):
                name = f"fingerspice {rtol:g}" + (", charge and current" if charge else "")
                found = run(circuit, values, rtol, charge=charge)
                note(
                    name,
                    lambda rtol=rtol, charge=charge, circuit=circuit: run(circuit, values, rtol, charge=charge),
                    found.u_gap,
                    values.size,
                )
        mobile = partial(run, circuit, values, charge=False, charge_law="mobile")
        found = run(circuit, values[:CHECKED], 1e-11, method="exponential", charge_law="mobile").u_gap
        most = float(np.abs(found).max())
        for rtol in RTOLS[1:]:
            name = f"fingerspice {rtol:g}, mobile"
            note(name, partial(mobile, rtol), mobile(rtol).u_gap, values.size, exact=found, peak=most)
        loop = Loop(circuit)
        note("numba loop", lambda loop=loop: loop(values), loop(values), values.size)
        few = values[:1201]
        note("scipy LSODA 1e-6", lambda loop=loop, few=few: loop.lsoda(few, 1e-6), loop.lsoda(few, 1e-6), few.size, 1)
    return out


def lengths(all_seconds: tuple[float, ...], repeats: int) -> list[Report]:
    """Time and memory of whole calls against the recording's length, at 1e-6, with force and voltage at each sample."""
    circuit, out = stack("SKIN"), []
    for seconds in all_seconds:
        values = noise(int(seconds * RATE) + 1, 8_000.0)

        def signals(values: np.ndarray = values) -> None:
            found = run(circuit, values, 1e-6, charge=False)
            found.u_gap, found.f_el  # noqa: B018

        took = median_seconds(signals, repeats if seconds < 60.0 else 1)
        tracemalloc.start()
        signals()
        most = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        out.append(
            {
                "seconds": seconds,
                "ns_per_sample": 1e9 * took / values.size,
                "times_real_time": seconds / took,
                "bytes_per_sample": most / values.size,
            }
        )
    return out


def networks(seconds: float, repeats: int) -> list[Report]:
    """Whole calls on networks with one finger, sample by sample and by the method that serves every source."""
    out = []
    for deck in NETWORKS:
        circuit = fs.read_netlist(CIRCUITS / f"{deck}.cir")
        first = next(e.name for e in circuit.elements if e.name[0] in "VI")
        # A current that gives the gap about the same voltage.
        unit = 1.0 if first[0] == "V" else 1e-6
        for high in BANDS[:2]:
            values = unit * noise(int(seconds * RATE) + 1, high)
            few = values[:CHECKED]
            waves = {"all": values, "few": few}
            drives = {which: circuit.replace({first: fs.Samples(x, RATE)}) for which, x in waves.items()}
            sizes = {which: x.size for which, x in waves.items()}

            def gap(which: str, rtol: float, method: str, drives: Any = drives, sizes: Any = sizes) -> np.ndarray:
                count = sizes[which]
                how = {"t_eval": np.arange(count - 1) / RATE, "t_stop": (count - 1) / RATE, "method": method}
                return np.asarray(fs.simulate(drives[which], charge_law="local", charge=False, rtol=rtol, **how).u_gap)

            exact = gap("few", 1e-11, "exponential")
            peak = float(np.abs(exact).max())
            for rtol in (1e-4, 1e-6):
                for which, method in (("all", "auto"), ("few", "exponential")):
                    found = gap(which, rtol, method)[: exact.size]
                    took = median_seconds(lambda w=which, r=rtol, m=method: gap(w, r, m), repeats)
                    off = float(np.abs(found - exact[: found.size]).max()) / peak
                    out.append(
                        {
                            "deck": deck, "band_Hz": high, "rtol": rtol, "method": method, "error": off,
                            "ns_per_sample": 1e9 * took / sizes[which],
                        }
                    )  # fmt: skip
    return out


def uneven(seconds: float, repeats: int) -> list[Report]:
    """Whole calls under a PWL whose points lie up to a third of a sample beside the samples of the same noise."""
    count = int(seconds * RATE) + 1
    moved = np.random.default_rng(0).uniform(-1.0, 1.0, count) / 3.0
    moved[0] = moved[-1] = 0.0
    t = (np.arange(count) + moved) / RATE
    out: list[Report] = []
    for skin in ("SKIN", "SKIN_DISPERSIVE"):
        for high in BANDS[:2]:
            values = noise(count, high)
            drives = {
                (which, method): (stack(skin).replace({"Vdrive": fs.PWL(t[:some], values[:some])}), t[:some])
                for which, method, some in (("all", "auto", count), ("few", "exponential", CHECKED))
            }

            def gap(rtol: float, key: tuple[str, str], drives: Any = drives) -> np.ndarray:
                circuit, at = drives[key]
                how = {"t_eval": at, "t_stop": at[-1], "start": "uncharged", "jumps": "none", "charge": False}
                return np.asarray(fs.simulate(circuit, rtol=rtol, method=key[1], **how).u_gap)

            exact = gap(1e-11, ("few", "exponential"))
            peak = float(np.abs(exact).max())
            for rtol in (1e-4, 1e-6):
                for key, (_, at) in drives.items():
                    found = gap(rtol, key)[: exact.size]
                    took = median_seconds(lambda k=key, r=rtol: gap(r, k), repeats)
                    # The last point of the short run is the start of no line.
                    off = float(np.abs(found - exact)[:-1].max()) / peak
                    out.append(
                        {
                            "skin": skin, "band_Hz": high, "rtol": rtol, "method": key[1], "error": off,
                            "ns_per_point": 1e9 * took / at.size,
                        }
                    )  # fmt: skip
    return out


def linear(seconds: float, repeats: int) -> Report:
    """Time of the whole call with a given area, and of lfilter with the equivalent filter."""
    values, area = noise(int(seconds * RATE) + 1, 8_000.0), 35e-6
    rates, gains, direct, weights = modal_gap(area)
    b, a = equivalent_filter(rates, gains, direct, weights)
    circuit = stack("SKIN")
    both = (
        lambda: run(circuit, values, 1e-8, area=area, charge=False).u_gap,
        lambda: signal.lfilter(b, a, values),
    )
    # By turns, so that both have the same share of what else the machine does.
    turns = np.array([[median_seconds(action, 1) for action in both] for _ in range(3 * repeats)])
    ours, theirs = np.median(turns, axis=0).tolist()
    return {
        "fingerspice_ns": 1e9 * ours / values.size,
        "lfilter_ns": 1e9 * theirs / values.size,
        "ratio": ours / theirs,
    }


def main() -> None:
    """Measure, print and write."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("--quick", action="store_true", help="short recordings, few repeats, nothing written")
    quick = parser.parse_args().quick
    warnings.simplefilter("ignore", fs.FingerspiceWarning)
    seconds, repeats = (0.2, 1) if quick else (4.0, 7)
    points = [point for high in BANDS for point in band(high, seconds, repeats)]
    for p in points:
        error = "unstable" if p["error"] is None else f"{p['error']:.1e}"
        name = f"{p['band_Hz']:6g} Hz {p['skin']:16} {p['contestant']:40}"
        print(f"{name} {error:8} {p['ns_per_sample']:12,.1f} ns a sample")
    around = networks(seconds, repeats)
    for p in around:
        name = f"{p['band_Hz']:6g} Hz {p['deck']:16} {p['method']:12} {p['rtol']:g}"
        print(f"{name} {p['error']:.1e} {p['ns_per_sample']:12,.1f} ns a sample")
    points_apart = uneven(seconds, repeats)
    for p in points_apart:
        name = f"{p['band_Hz']:6g} Hz {p['skin']:16} {p['method']:12} {p['rtol']:g}"
        print(f"uneven points {name} {p['error']:.1e} {p['ns_per_point']:12,.1f} ns a point")
    by_length = lengths((0.1, 0.2) if quick else (1.0, 10.0, 60.0, 300.0), repeats)
    for p in by_length:
        speed = f"{p['ns_per_sample']:.1f} ns a sample, {p['times_real_time']:,.0f} times real time"
        print(f"{p['seconds']:6g} s: {speed}, {p['bytes_per_sample']:.0f} bytes a sample")
    given = linear(seconds, repeats)
    ours, theirs = given["fingerspice_ns"], given["lfilter_ns"]
    print(f"area given: {ours:.1f} ns a sample, lfilter {theirs:.1f}, ratio {given['ratio']:.2f}")
    if not quick:
        commit = subprocess.run(
            ["git", "rev-parse", "--short", "HEAD"], cwd=HERE, capture_output=True, text=True, check=False
        ).stdout.strip()
        machine = {
            "processor": platform.machine(),
            "cores": os.cpu_count(),
            "python": platform.python_version(),
            "commit": commit,
        }
        report = {
            "machine": machine,
            "seconds": seconds,
            "points": points,
            "networks": around,
            "uneven": points_apart,
            "lengths": by_length,
            "area_given": given,
        }
        (HERE / "results" / "recordings.json").write_text(json.dumps(report, indent=1) + "\n")


if __name__ == "__main__":
    main()
