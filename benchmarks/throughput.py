"""Speed of the tiers against number of samples, run length, number of layers, and tolerance.

Run: python benchmarks/throughput.py [--quick]. Medians of 9 in one process, without compile time; writes
results/throughput.json. The linear tier with a sampled source is compared with scipy's lfilter on the equivalent filter
(the same two poles), with dlsim, and with a plain copy.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
from pathlib import Path
from typing import Any

import numpy as np
from scipy import signal

import fingerspice as fs
from fingerspice.numerics.linear import first_order_hold, moments
from timing import median_seconds

HERE = Path(__file__).resolve().parent
DECK = HERE.parent / "circuits" / "fingerpad.cir"
DT = 1e-5
Report = dict[str, Any]


def modal_gap(area: float) -> tuple[Any, Any, Any, Any]:
    """Rates, gains, direct feedthrough (1,) and weights (1, n) of the gap voltage of Table 1 at one area (m^2)."""
    from fingerspice.solve.scenes import scene_of

    scene = scene_of(fs.read_netlist(DECK), "local", area, 1.0)
    modes, (gap,) = scene.modes, scene.measured
    return modes.rates, np.ascontiguousarray(modes.gains[:, 0]), -modes.follow[[gap], 0], modes.shape[[gap]]


def equivalent_filter(rates: Any, gains: Any, direct: Any, weights: Any) -> tuple[Any, Any]:
    """Numerator and denominator of the filter with the same first-order-hold response, for lfilter."""
    b, a = direct, np.array([1.0])
    found = np.empty(2)
    for rate, gain, weight in zip(rates, gains, weights[0], strict=True):
        moments(float(rate * DT), found)
        here, before = found[1], found[0] - found[1]
        pole = np.array([1.0, -np.exp(-rate * DT)])
        part = weight * gain * DT * np.array([here, before])
        b = np.polyadd(np.convolve(b, pole), np.convolve(part, a))
        a = np.convolve(a, pole)
    return b, a


def samples(count: int, repeats: int) -> Report:
    """ns per sample of the recursion, its peers and a copy, and the difference between recursion and lfilter."""
    rng = np.random.default_rng(1)
    # lfilter starts from a source that is zero one sample before the first, so start at zero.
    u = np.cumsum(np.append(0.0, rng.standard_normal(count - 1))) / np.sqrt(count)
    rates, gains, direct, weights = modal_gap(35e-6)
    b, a = equivalent_filter(rates, gains, direct, weights)
    out = np.empty_like(u)
    rest = np.zeros(len(rates))
    ours = first_order_hold(u, DT, rates, gains, direct, weights, rest)[0][0]
    theirs = signal.lfilter(b, a, u)
    figures = {
        "copy": median_seconds(lambda: np.copyto(out, u), repeats),
        "fingerspice": median_seconds(lambda: first_order_hold(u, DT, rates, gains, direct, weights, rest), repeats),
        "lfilter": median_seconds(lambda: signal.lfilter(b, a, u), repeats),
    }
    few = min(count, 20_000)
    system = signal.dlti(b, a, dt=DT)
    figures["dlsim"] = median_seconds(lambda: signal.dlsim(system, u[:few]), max(1, repeats // 3)) * count / few
    return {
        "samples": count,
        "ns_per_sample": {name: 1e9 * seconds / count for name, seconds in figures.items()},
        "ours_over_lfilter": figures["fingerspice"] / figures["lfilter"],
        "difference_over_peak": float(np.abs(ours - theirs).max() / np.abs(theirs).max()),
    }


def lengths(counts: list[int], repeats: int) -> list[Report]:
    """ns per sample of the recursion against run length."""
    rates, gains, direct, weights = modal_gap(35e-6)
    out = []
    for count in counts:
        u = np.sin(np.arange(count) * 0.01)
        rest = np.zeros(len(rates))

        def run(u: Any = u, rest: Any = rest) -> object:
            return first_order_hold(u, DT, rates, gains, direct, weights, rest)

        seconds = median_seconds(run, repeats if count < 1e7 else 1)
        out.append({"samples": count, "ns_per_sample": 1e9 * seconds / count})
    return out


def chain(layers: int) -> fs.Circuit:
    """A gap among `layers` - 1 leaky layers, driven by a sine of 1 kHz."""
    gap = "d=3.5u eps_r=1 r=1meg fn=0.5 mu=0.3 alpha=54.4 m_exp=0.52 beta=32 n_exp=1.41 c2=5000"
    lines = ["a chain", "V1 n0 0 SIN(0 200 1k)", f"Xgap n0 {'0' if layers == 1 else 'n1'} a GAP {gap}"]
    for i in range(1, layers):
        node = "0" if i == layers - 1 else f"n{i + 1}"
        lines.append(f"X{i} n{i} {node} a LAYER d={1.0 + 0.1 * i!r}u eps_r=3.9 r={0.1 + 0.05 * i!r}meg")
    return fs.parse_netlist("\n".join([*lines, ".tran 10u 20m uic", ""]))


def layers(numbers: list[int], repeats: int) -> list[Report]:
    """us per period against the number of layers, in closed form and coupled, at 1e-6."""
    out = []
    for number in numbers:
        circuit = chain(number)
        t = np.arange(2000) * 1e-5

        def run(area: str, circuit: fs.Circuit = circuit, t: Any = t) -> object:
            return fs.simulate(circuit, t_stop=0.02, t_eval=t, rtol=1e-6, area=area, charge=False).u_gap

        out.append(
            {
                "layers": number,
                "linear_us_per_period": 1e6 * median_seconds(lambda run=run: run("frozen"), repeats) / 20,
                "coupled_us_per_period": 1e6 * median_seconds(lambda run=run: run("coupled"), repeats) / 20,
            }
        )
    return out


def tolerances(exponents: range, repeats: int) -> list[Report]:
    """us per period of Table 1's 100 Hz sine against the requested error."""
    circuit = fs.read_netlist(DECK)
    t = (np.arange(10_000) + 0.5) * 1e-4
    out = []
    for exponent in exponents:
        rtol = 10.0**-exponent

        def run(rtol: float = rtol) -> fs.Solution:
            return fs.simulate(circuit, t_stop=1.0, t_eval=t, rtol=rtol, charge=False)

        solution = run()
        assert solution.u_gap is not None
        stated = solution.error.u_gap / float(np.abs(solution.u_gap).max())
        out.append({"rtol": rtol, "stated_error": stated, "us_per_period": 1e6 * median_seconds(run, repeats) / 100})
    return out


def main(arguments: list[str] | None = None) -> Report:
    """Measure, print and, unless quick, write the results."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="small sizes, one repeat, nothing written")
    quick = parser.parse_args(arguments).quick
    repeats = 1 if quick else 9
    results = {
        "machine": f"{platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}",
        "samples": samples(20_000 if quick else 1_000_000, repeats),
        "lengths": lengths([10**i for i in range(3, 5 if quick else 9)], repeats),
        "layers": layers([1, 2, 8] if quick else [1, 2, 4, 8, 16, 32, 64], repeats),
        "tolerances": tolerances(range(3, 5) if quick else range(2, 13), repeats),
    }
    print(json.dumps(results, indent=2))
    if not quick:
        (HERE / "results" / "throughput.json").write_text(json.dumps(results, indent=2) + "\n")
    return results


if __name__ == "__main__":
    main()
