"""Pictures of phasor sweeps against frequency."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from fingerspice.base.arrays import FloatArray
from fingerspice.circuit.describe import heading
from fingerspice.physics.materials import SKIN_BAND
from fingerspice.plots import drawing

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from fingerspice.circuit.circuit import Circuit
    from fingerspice.plots.drawing import Picture
    from fingerspice.results.phasor_solution import PhasorSolution


def plot_phasor(results: Sequence[PhasorSolution], circuit: Circuit) -> Picture:
    """Gain, phase, mean force and area against frequency, with a line per amplitude.

    Parameters
    ----------
    results : sequence of PhasorSolution
        A result with a single frequency is shown as points.
    circuit : Circuit
        The circuit that the results belong to.

    Returns
    -------
    Picture
    """
    if results[0].nodes:
        return _plot_nodes(results[0], circuit)
    figure, axes = drawing.new_figure(2, 2, height=4.6, sharex=True)
    forces = np.concatenate([r.f_el_mean for r in results])
    factor, unit = drawing.engineering(drawing.peak_of(forces[np.isfinite(forces)]), "N", 0.05)
    for number, result in enumerate(results):
        order = np.argsort(result.frequency)
        f = result.frequency[order]
        for ax, values, label, color in (
            (axes[0], np.abs(result.gain), "|gap voltage / source|", drawing.BLUE),
            (axes[1], np.degrees(np.angle(result.gain)), "Lead of the gap voltage [°]", drawing.PURPLE),
            (axes[2], factor * result.f_el_mean, f"Mean electroadhesive force [{unit}]", drawing.VERMILION),
            (axes[3], 1e6 * result.area, "Ridge area [mm²]", drawing.GREEN),
        ):
            ax.plot(
                f, values[order], color=color, linewidth=1.5, marker="o" if f.size < 12 else "", markersize=3.5,
                linestyle=("-", "--", ":", "-.")[number % 4], label=f"{result.amplitude:.4g} V",
            )  # fmt: skip
            drawing.dress(ax, label)
            ax.set_xscale("log")
            ax.set_xlim(*((f[0], f[-1]) if f[0] < f[-1] else (0.1 * f[0], 10.0 * f[0])))
            ax.ticklabel_format(axis="y", useOffset=False)
    for ax in (axes[0], axes[2]):
        drawing.from_zero(ax)
    amplitude = results[0].amplitude
    if not np.isfinite(amplitude):
        place: dict[str, Any] = {"transform": axes[2].transAxes, "ha": "center", "fontsize": drawing.FONT}
        axes[2].text(0.5, 0.5, "the source has no fundamental", **place)
    if len(results) > 1:
        axes[0].legend(fontsize=drawing.FONT, frameon=False, loc="lower right", handlelength=3.0)
    drawing.flat(axes[3], 1e6 * np.concatenate([r.area for r in results]))
    outside = _mark_extrapolation(axes, np.sort(results[0].frequency), circuit)
    for ax in axes[2:]:
        ax.set_xlabel("Frequency [Hz]", fontsize=drawing.FONT)
    drive = f"{amplitude:.4g} V" if np.isfinite(amplitude) else "no fundamental"
    how = f"source amplitude {drive}" if len(results) == 1 else "several source amplitudes"
    drawing.caption(figure, " · ".join(p for p in (heading(circuit), how, outside) if p))
    return figure


def _plot_nodes(result: PhasorSolution, circuit: Circuit) -> Picture:
    """Amplitude and phase of every node's voltage against frequency."""
    assert result.v_nodes is not None
    figure, axes = drawing.new_figure(2, 1, height=4.6, sharex=True)
    order = np.argsort(result.frequency)
    v = result.v_nodes[order]
    marker = "o" if order.size < 12 else ""
    for ax, values, label in (axes[0], np.abs(v), "Node voltage [V]"), (axes[1], np.degrees(np.angle(v)), "Phase [°]"):
        ax.plot(result.frequency[order], values, linewidth=1.5, marker=marker, label=result.nodes)
        drawing.dress(ax, label)
        ax.set_xscale("log")
    if np.all(np.abs(v).max(axis=0) > 0.0):
        axes[0].set_yscale("log")
    axes[0].legend(fontsize=drawing.FONT, frameon=False)
    axes[1].set_xlabel("Frequency [Hz]", fontsize=drawing.FONT)
    outside = _mark_extrapolation(axes, np.sort(result.frequency), circuit)
    drawing.caption(figure, " · ".join(p for p in (heading(circuit), result.drive, outside) if p))
    return figure


def _mark_extrapolation(axes: Sequence[Axes], f: FloatArray, circuit: Circuit) -> str:
    """Shade the frequencies outside the data of SKIN; returns the caption's explanation of the shade."""
    low, high = f[0], f[-1]
    spans = [(low, min(high, SKIN_BAND[0])), (max(low, SKIN_BAND[1]), high)]
    spans = [s for s in spans if s[1] > s[0]]
    if not circuit.by_device("SKIN") or not spans:
        return ""
    for ax in axes:
        for a, b in spans:
            ax.axvspan(a, b, color="#EEEEEE", zorder=0.5)
    return "shaded: outside the skin data of Eqs. 18 and 19"
