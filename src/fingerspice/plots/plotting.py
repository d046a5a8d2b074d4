"""Pictures of sweeps and comparisons."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from fingerspice.circuit.describe import heading
from fingerspice.physics.materials import SKIN_BAND
from fingerspice.plots.drawing import (
    BLACK,
    BLUE,
    DASHES,
    FONT,
    GREEN,
    PURPLE,
    VERMILION,
    caption,
    dress,
    engineering,
    flat,
    from_zero,
    new_figure,
    peak_of,
)  # fmt: skip
from fingerspice.plots.traces import (
    QUANTITIES,
    Drawn,
    about,
    draw_line,
    finish_panel,
    scale_of,
    time_axis,
    time_unit,
    traces_of,
)  # fmt: skip

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from fingerspice.circuit.circuit import Circuit
    from fingerspice.plots.picture import Picture
    from fingerspice.results.phasor_solution import PhasorSolution
    from fingerspice.studies.comparison import Comparison

FloatArray = NDArray[np.float64]


def plot_phasor(results: Sequence[PhasorSolution], circuit: Circuit) -> Picture:
    """Gain, phase, mean force and area against frequency, a line per amplitude.

    Parameters
    ----------
    results : sequence of PhasorSolution
        Of sweeps; a single frequency is shown as points.
    circuit : Circuit
        They were made from.

    Returns
    -------
    Picture
    """
    figure, axes = new_figure(2, 2, height=4.6, sharex=True)
    forces = np.concatenate([r.f_el_mean for r in results])
    factor, unit = engineering(peak_of(forces[np.isfinite(forces)]), "N", 0.05)
    for number, result in enumerate(results):
        order = np.argsort(result.frequency)
        f = result.frequency[order]
        for ax, values, label, color in (
            (axes[0], np.abs(result.gain), "|gap voltage / source|", BLUE),
            (axes[1], np.degrees(np.angle(result.gain)), "Lead of the gap voltage [°]", PURPLE),
            (axes[2], factor * result.f_el_mean, f"Mean electroadhesive force [{unit}]", VERMILION),
            (axes[3], 1e6 * result.area, "Ridge area [mm²]", GREEN),
        ):
            ax.plot(
                f, values[order], color=color, linewidth=1.5, marker="o" if f.size < 12 else "", markersize=3.5,
                linestyle=("-", "--", ":", "-.")[number % 4], label=f"{result.amplitude:.4g} V",
            )  # fmt: skip
            dress(ax, label)
            ax.set_xscale("log")
            ax.set_xlim(*((f[0], f[-1]) if f[0] < f[-1] else (0.1 * f[0], 10.0 * f[0])))
            ax.ticklabel_format(axis="y", useOffset=False)
    for ax in (axes[0], axes[2]):
        from_zero(ax)
    amplitude = results[0].amplitude
    if not np.isfinite(amplitude):
        axes[2].text(0.5, 0.5, "the source has no fundamental", transform=axes[2].transAxes, ha="center", fontsize=FONT)
    if len(results) > 1:
        axes[0].legend(fontsize=FONT, frameon=False, loc="lower right", handlelength=3.0)
    flat(axes[3], 1e6 * np.concatenate([r.area for r in results]))
    outside = _mark_extrapolation(axes, np.sort(results[0].frequency), circuit)
    for ax in axes[2:]:
        ax.set_xlabel("Frequency [Hz]", fontsize=FONT)
    drive = f"{amplitude:.4g} V" if np.isfinite(amplitude) else "no fundamental"
    how = f"source amplitude {drive}" if len(results) == 1 else "several source amplitudes"
    caption(figure, " · ".join(p for p in (heading(circuit), how, outside) if p))
    return figure


def _mark_extrapolation(axes: Sequence[Axes], f: FloatArray, circuit: Circuit) -> str:
    """Shade frequencies outside the data of SKIN; what the shade means."""
    low, high = f[0], f[-1]
    spans = [(low, min(high, SKIN_BAND[0])), (max(low, SKIN_BAND[1]), high)]
    spans = [s for s in spans if s[1] > s[0]]
    if not circuit.by_device("SKIN") or not spans:
        return ""
    for ax in axes:
        for a, b in spans:
            ax.axvspan(a, b, color="#EEEEEE", zorder=0.5)
    return "shaded: outside the skin data of Eqs. 18 and 19"


def plot_comparison(comparison: Comparison) -> Picture:
    """One period of the transient over the phasor's, and the figures of both in a table.

    Parameters
    ----------
    comparison : Comparison

    Returns
    -------
    Picture
    """
    figure, axes = new_figure(3, height=5.6, height_ratios=[1.3, 1.3, 0.75])
    solution, p = comparison.solution, comparison.phasor
    runs = [Drawn(solution, "")]
    start, stop = float(solution.t[0]), float(solution.t[-1])
    source_phase = solution.fundamental.phase if solution.fundamental else 0.0
    turns = 2.0 * np.pi * comparison.frequency * solution.t + source_phase
    of_gaps = [p.of_gap(i) for i in range(len(comparison.gaps))]
    waves = [np.sin(turns + np.radians(one["phase_deg"])) for one in of_gaps]
    voltages = [one["amplitude"] * wave for one, wave in zip(of_gaps, waves, strict=True)]
    forces = [2.0 * one["f_el_mean"] * wave**2 for one, wave in zip(of_gaps, waves, strict=True)]
    for ax, keys, curves in zip(axes, (["u_source", "u_gap"], ["f_el"]), (voltages, forces), strict=False):
        quantity, traces = QUANTITIES[keys[-1]], traces_of(runs, keys)
        factor, unit = scale_of(quantity, traces, start, stop)
        for trace in traces:
            draw_line(ax, trace, factor, start, stop, runs)
        for trace, curve in zip(traces[-len(curves) :], curves, strict=True):
            ax.plot(
                time_unit(runs)[0] * solution.t, factor * curve, color=BLACK, linestyle=DASHES[3], linewidth=1.5,
                label=f"{trace.label}, phasor",
            )  # fmt: skip
        finish_panel(ax, quantity, unit, [factor * trace.x for trace in traces])
    time_axis(axes[:2], runs, start, stop)
    _table(axes[2], comparison)
    caption(figure, f"{about(solution)} · periodic state; the phasor is of the fundamental alone")
    figure.align_ylabels(axes[:2])
    return figure


def _table(ax: Axes, comparison: Comparison) -> None:
    names = {
        "amplitude": "Gap voltage at the fundamental",
        "phase_deg": "Its lead over the source",
        "f_el_mean": "Mean electroadhesive force",
        "area_mean": "Mean ridge area",
    }
    text = "|phasor|transient,\nmean area|transient,\ncoupled|coupled −\nphasor|of it, ripple\nof the area"
    head = text.split("|")
    split = [row[0].partition(":") for row in comparison.rows()]
    labels = [f"{names[name]} {gap}".rstrip() for name, _, gap in split]
    cells = [
        [
            f"{label} [{row[1].replace('deg', '°').replace('^2', '²')}]",
            *(f"{x:.5g}".replace("-", "−") for x in row[2:5]),
            *(f"{x:+.2g}".replace("-", "−") for x in row[5:]),
        ]
        for label, row in zip(labels, comparison.rows(), strict=True)
    ]
    ax.axis("off")
    widths = [0.36, *[0.128] * 5]
    table = ax.table([head, *cells], cellLoc="right", loc="center", edges="horizontal", colWidths=widths)
    table.auto_set_font_size(False)
    table.set_fontsize(FONT - 0.5)
    for (row, column), cell in table.get_celld().items():
        cell.set_edgecolor("#BBBBBB")
        cell.set_linewidth(0.6)
        if row == 0:
            cell.set_height(1.7 * cell.get_height())
        if column == 0:
            cell.get_text().set_horizontalalignment("left")
            cell.PAD = 0.0
