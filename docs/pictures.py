"""Draws the pictures of the pages into docs/pictures, from runs of the engine: `python docs/pictures.py [NAME ...]`."""

from __future__ import annotations

import contextlib
import re
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import evidence as rows
import numpy as np

import fingerspice as fs
from fingerspice.circuit.statespace import build_stack
from fingerspice.numerics.lobatto import NODES, POINTS
from fingerspice.physics.contact import JkrContact
from fingerspice.plots.drawing import BLACK, BLUE, GREY, SKY, VERMILION, dress, legend_above, new_figure, save

HERE = Path(__file__).parent
FOLDER = HERE / "pictures"
CIRCUITS = HERE.parent / "circuits"
PICTURES: dict[str, Callable[[], Any]] = {}


def picture(draw: Callable[[], Any]) -> Callable[[], Any]:
    """Register a function that returns a figure; its name is the picture's."""
    PICTURES[draw.__name__] = draw
    return draw


def finger(name: str = "fingerpad") -> fs.Circuit:
    """A shipped deck."""
    return fs.read_netlist(CIRCUITS / f"{name}.cir")


def contact_of(circuit: fs.Circuit) -> JkrContact:
    """The contact of a series stack."""
    contact = build_stack(circuit).contact
    assert contact is not None
    return contact


@picture
def tutorial_first() -> Any:
    """The first run of the tutorial."""
    return fs.simulate(finger()).plot()


@picture
def tutorial_texture() -> Any:
    """The drive for the texture of the tutorial, by the page's own lines."""
    page = (HERE / "start" / "tutorial.md").read_text(encoding="utf-8")
    deck = re.findall(r"^```spice\n(.*?)^```$", page, re.MULTILINE | re.DOTALL)[0]
    code = next(c for c in re.findall(r"^```python\n(.*?)^```$", page, re.M | re.S) if "inverse_drive" in c)
    names: dict[str, Any] = {"np": np, "fs": fs, "finger": fs.parse_netlist(deck)}
    with contextlib.redirect_stdout(None):
        exec(code, names)
    return names["found"].plot()


@picture
def model_circuit() -> Any:
    """The three layers as a circuit."""
    return finger().draw()


@picture
def model_area() -> Any:
    """Area and force against the gap voltage: Eqs. 1 to 4."""
    contact = contact_of(finger())
    u = np.linspace(-300.0, 300.0, 1201)
    area = contact.area(u)
    figure, (left, right) = new_figure(1, 2, height=2.6)
    dress(left, "Ridge contact area [mm²]", "Gap voltage [V]")
    left.plot(u, 1e6 * contact.area_adhesive(u), color=SKY, linestyle="--", label="without friction (Eq. 4)")
    left.plot(u, 1e6 * area, color=BLUE, label="with friction (Eq. 3)")
    legend_above(left, 1)
    dress(right, "Electroadhesive force [mN]", "Gap voltage [V]")
    right.plot(u, 1e3 * contact.stress(u) * area, color=VERMILION, label="coupled area")
    rest = contact.area_at_rest
    right.plot(u, 1e3 * contact.stress(u) * rest, color=GREY, linestyle="--", label="area held at its value at 0 V")
    legend_above(right, 1)
    return figure


@picture
def collocation() -> Any:
    """The steps of a period, and inside one of them the polynomial through 13 nodes."""
    period, first = 0.01, 0.02
    run = fs.simulate(
        finger(), rtol=1e-8, t_eval=np.linspace(first - 2e-3, first + period, 2401), t_stop=0.05, charge=False
    )
    starts, whole, _, reach = run.continuous.times[:4]  # type: ignore[union-attr]
    lengths = whole * reach
    inside = (starts + lengths > first + 1e-9) & (starts + lengths < first + period + 1e-9)
    starts, lengths = starts[inside], lengths[inside]
    assert starts.size == 6, "the page says six steps"
    figure, (top, bottom) = new_figure(2, height=4.4)
    dress(top, "Voltage [V]", "Time [ms]")
    top.set_xlim(1e3 * starts[0], 1e3 * (starts[-1] + lengths[-1]))
    top.plot(1e3 * run.t, run.u_source, color=GREY, linestyle="--", label="source")
    top.plot(1e3 * run.t, run.u_gap, color=BLUE, label="gap")
    for k, (start, length) in enumerate(zip(starts, lengths, strict=True)):
        top.axvspan(1e3 * start, 1e3 * (start + length), color=SKY, alpha=0.25 if k % 2 == 0 else 0.0, linewidth=0)
    nodes = (starts[:, None] + lengths[:, None] * POINTS[:NODES]).ravel()
    top.plot(1e3 * nodes, np.interp(nodes, run.t, run.u_gap), "o", color=BLUE, markersize=2.5, label="nodes")
    legend_above(top)
    longest = int(np.argmax(lengths))
    start, length = starts[longest], lengths[longest]
    fraction = np.linspace(0.0, 1.0, 301)
    exact = _drop(run, start + length * fraction)
    at_nodes = _drop(run, start + length * POINTS[:NODES])
    series = np.polynomial.Chebyshev.fit(POINTS[:NODES], at_nodes, NODES - 1, domain=[0, 1])
    miss = np.abs(series(fraction) - exact).max()
    assert miss < 2e-3 * np.ptp(exact), miss
    dress(bottom, "Area less that\nat rest [mm²]", "Time within the longest step [ms]")
    bottom.plot(1e3 * (start + length * fraction), series(fraction), color=BLUE, label="polynomial of degree 12")
    bottom.plot(1e3 * (start + length * POINTS[:NODES]), at_nodes, "o", color=BLACK, markersize=4, label="13 nodes")
    legend_above(bottom)
    return figure


def _drop(run: fs.Solution, t: Any) -> Any:
    """Area less the area at rest, mm^2."""
    contact = contact_of(run.circuit)
    return 1e6 * (contact.area(np.interp(t, run.t, run.u_gap)) - contact.area_at_rest)


@picture
def error_estimate() -> Any:
    """Asked, stated and true error of the gap voltage, from 1e-3 to 1e-11."""
    figure, panels = new_figure(1, 2, height=3.0, sharey=True)
    scenes = {"sine, 100 Hz": fs.Sine(200, 100), "square wave, 100 Hz": fs.Square(200, 100)}
    for ax, (name, source) in zip(panels, scenes.items(), strict=True):
        t = np.linspace(0.0, 0.05, 997)
        best = fs.simulate(finger(), sources=source, t_eval=t, rtol=1e-13)
        peak = np.abs(best.u_gap).max()
        asked = 10.0 ** -np.arange(3.0, 11.5, 0.5)
        runs = [fs.simulate(finger(), sources=source, t_eval=t, rtol=rtol) for rtol in asked]
        stated = [float(np.max(run.error.u_gap)) / peak for run in runs]
        true = [np.abs(run.u_gap - best.u_gap).max() / peak for run in runs]
        assert 1.0 < np.median(np.divide(stated, true)) < 4.0, "the page says a factor of about 2"
        dress(ax, "Error of the gap voltage / its peak" if ax is panels[0] else "", "Error asked for (rtol)")
        ax.loglog(asked, asked, color=GREY, linestyle="--", label="asked for")
        ax.loglog(asked, stated, "s-", color=VERMILION, markersize=4, label="stated")
        ax.loglog(asked, true, "o-", color=BLUE, markersize=4, label="true")
        ax.set_xticks(asked[::4])
        ax.minorticks_off()
        ax.invert_xaxis()
        ax.set_title(name, fontsize=8, loc="left")
    panels[0].legend(frameon=False, fontsize=8)
    return figure


@picture
def fold() -> Any:
    """A run that ends at a fold, and the curve of states on which it came there."""
    stay, ramp = 5e-3, 0.1e-3
    source = fs.PWL([0.0, 1e-4, stay, stay + ramp], [0.0, 200.0, 200.0, -200.0])
    t = np.r_[np.linspace(0.0, stay, 400), np.linspace(stay, stay + ramp, 4000)[1:]]
    circuit = finger().replace({"Xgap.d": 1e-6})
    run = fs.simulate(circuit, charge_law="mobile", sources=source, t_eval=t, throw=False)
    assert run.status is fs.Status.FOLD
    stack = build_stack(run.circuit)
    contact = contact_of(run.circuit)
    share = (1.0 / stack.c[stack.gap]) / (1.0 / stack.c).sum()
    # u = share U + x A(0 V) / A(u) with the leaked charge as a voltage x, which hardly moves during the ramp.
    rest, last = contact.area_at_rest, float(run.u_gap[-1])
    x = (last - share * float(run.u_source[-1])) * float(contact.area(last)) / rest
    u = np.linspace(-400.0, -20.0, 2001)
    needed = (u - x * rest / contact.area(u)) / share
    end = int(np.argmin(needed))
    assert round(needed[end]) == -128, "the page says so"
    figure, (left, right) = new_figure(1, 2, height=3.0)
    dress(left, "Voltage [V]", "Time [ms]")
    left.plot(1e3 * run.t, run.u_source, color=GREY, linestyle="--", label="source")
    left.plot(1e3 * run.t, run.u_gap, color=BLUE, label="gap")
    left.plot(1e3 * run.t[-1], last, "o", color=VERMILION, label="end of the run")
    legend_above(left)
    dress(right, "Gap voltage [V]", "Source voltage [V]")
    right.plot(needed[end:], u[end:], color=BLUE, label="states")
    right.plot(needed[:end], u[:end], color=BLUE, linestyle=":", label="never reached")
    right.plot(run.u_source[-1], last, "o", color=VERMILION, label="end of the run")
    right.set_xlim(needed[end] - 30.0, None)
    right.axvspan(needed[end] - 30.0, needed[end], color=GREY, alpha=0.2, linewidth=0)
    right.text(needed[end] - 5.0, -300.0, "no solution", rotation=90, ha="right", fontsize=8)
    legend_above(right)
    return figure


@picture
def periods() -> Any:
    """How a run forgets its start, and what the repeated periods save."""
    period, per, rtol = 0.01, 100, 1e-6
    t = np.arange(12 * per + 1) * period / per
    stepped = fs.simulate(finger(), t_eval=t, t_stop=float(t[-1]), rtol=1e-12, method="exponential")
    shape = stepped.u_gap[:-1].reshape(-1, per)
    change = np.abs(np.diff(shape, axis=0)).max(axis=1) / np.abs(shape).max()
    figure, (left, right) = new_figure(1, 2, height=2.9)
    dress(left, "Change of the gap voltage\nfrom period to period / its peak", "Period")
    left.semilogy(np.arange(2, change.size + 2), change, "o-", color=BLUE, markersize=3.5)
    left.axhline(rtol, color=GREY, linestyle="--")
    left.text(12.0, 1.4 * rtol, "error asked for: 1e-6", ha="right", fontsize=8)
    dress(right, "Evaluations of the right-hand side", "Periods simulated")
    counts = (5, 10, 20, 50, 100, 200)
    for method, color, mark, label in (
        ("exponential", VERMILION, "s", "every period stepped"),
        ("auto", BLUE, "o", "periods repeated"),
    ):
        calls = [fs.simulate(finger(), t_stop=n * period, rtol=rtol, method=method).nfev for n in counts]
        right.loglog(counts, calls, f"{mark}-", color=color, markersize=4, label=label)
    right.set_xticks(counts, [str(n) for n in counts])
    right.minorticks_off()
    legend_above(right)
    return figure


@picture
def evidence() -> Any:
    """Attraction against frequency for other gaps, and the voltages at which sine and square are felt."""
    figure, (left, right) = new_figure(1, 2, height=3.3)
    f = np.geomspace(10.0, 1e5, 81)
    dress(left, "Mean attraction at 140 V [mN]", "Frequency [Hz]")
    for circuit, style, color, label in (
        (finger(), "-", BLUE, "Table 1, R_a of 1 MΩ"),
        (finger().replace({"Xgap.r": 0.5e6}), "--", SKY, "0.5 MΩ"),
        (finger().replace({"Xgap.r": 7e6}), "-.", VERMILION, "7 MΩ"),
        (rows.constant_phase(), ":", BLACK, "constant-phase element"),
    ):
        force = fs.phasor(circuit.replace({"Vdrive.amplitude": 140.0}), f).f_el_mean
        left.semilogx(f, 1e3 * force, style, color=color, label=label)
    left.set_ylim(0.0, None)
    left.axvspan(30.0, 230.0, color=GREY, alpha=0.15, linewidth=0)
    left.text(83.0, 4.0, "30 to 230 Hz:\nsmall effect measured", ha="center", fontsize=7)
    legend_above(left, 2)
    dress(right, "Threshold voltage [V]", "Frequency [Hz]")
    waves = (fs.Sine, "o-", BLUE, "sine"), (fs.Square, "s--", VERMILION, "square wave")
    tried = [15.0, 20.0, 30.0, 40.0, 50.0, 60.0, 80.0, 100.0, 120.0, 140.0, 160.0, 180.0, 200.0]
    for wave, style, color, label in waves:
        volts = [rows.threshold(wave, x) for x in tried]
        right.loglog(tried, volts, style, color=color, markersize=3.5, label=label)
    right.axvline(60.0, color=GREY, linestyle=":")
    right.text(62.0, 75.0, "60 Hz, measured crossing\n(Vardar 2017)", fontsize=7)
    ticks = [15, 30, 60, 120, 240]
    right.set_xticks(ticks, [str(x) for x in ticks])
    right.set_yticks([15, 20, 30, 50, 100], ["15", "20", "30", "50", "100"])
    right.minorticks_off()
    right.set_xlim(14.0, 250.0)
    legend_above(right)
    return figure


def main() -> None:
    """Draw every picture."""
    FOLDER.mkdir(exist_ok=True)
    for name, draw in PICTURES.items():
        if name in (sys.argv[1:] or PICTURES):
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", fs.FingerspiceWarning)
                save(draw(), FOLDER / f"{name}.png", dpi=150.0)


if __name__ == "__main__":
    main()
