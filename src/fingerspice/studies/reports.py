"""Pages of studies, and pictures of comparisons."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fingerspice.base.files import write_csv
from fingerspice.base.pages import Page, Table
from fingerspice.base.units import format_si
from fingerspice.circuit.describe import head_lines
from fingerspice.plots import drawing, lines
from fingerspice.results.outcome import SolveError
from fingerspice.results.report import summary_table

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from fingerspice.plots.picture import Picture
    from fingerspice.studies.comparison import Comparison
    from fingerspice.studies.limits import FoldLimits
    from fingerspice.studies.steady import SteadyState


def plot_comparison(comparison: Comparison) -> Picture:
    """One period of the transient and of the phasor solution in one picture, with a table of their figures."""
    figure, axes = drawing.new_figure(3, height=5.6, height_ratios=[1.3, 1.3, 0.75])
    solution, p = comparison.solution, comparison.phasor
    runs = [lines.Drawn(solution, "")]
    start, stop = float(solution.t[0]), float(solution.t[-1])
    source_phase = solution.fundamental.phase if solution.fundamental else 0.0
    turns = 2.0 * np.pi * comparison.frequency * solution.t + source_phase
    of_gaps = [p.of_gap(i) for i in range(len(comparison.gaps))]
    waves = [np.sin(turns + np.radians(one["phase_deg"])) for one in of_gaps]
    voltages = [one["amplitude"] * wave for one, wave in zip(of_gaps, waves, strict=True)]
    forces = [2.0 * one["f_el_mean"] * wave**2 for one, wave in zip(of_gaps, waves, strict=True)]
    for ax, keys, curves in zip(axes, (["u_source", "u_gap"], ["f_el"]), (voltages, forces), strict=False):
        quantity, traces = lines.QUANTITIES[keys[-1]], lines.traces_of(runs, keys)
        factor, unit = lines.scale_of(quantity, traces, start, stop)
        for trace in traces:
            lines.draw_line(ax, trace, factor, start, stop, runs)
        t = lines.time_unit(runs)[0] * solution.t
        style: dict[str, Any] = {"color": drawing.BLACK, "linestyle": drawing.DASHES[3], "linewidth": 1.5}
        for trace, curve in zip(traces[-len(curves) :], curves, strict=True):
            ax.plot(t, factor * curve, label=f"{trace.label}, phasor", **style)
        lines.finish_panel(ax, quantity, unit, [factor * trace.x for trace in traces])
    lines.time_axis(axes[:2], runs, start, stop)
    _table(axes[2], comparison)
    drawing.caption(figure, f"{lines.about(solution)} · periodic state; the phasor is of the fundamental alone")
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
    table.set_fontsize(drawing.FONT - 0.5)
    for (row, column), cell in table.get_celld().items():
        cell.set_edgecolor("#BBBBBB")
        cell.set_linewidth(0.6)
        if row == 0:
            cell.set_height(1.7 * cell.get_height())
        if column == 0:
            cell.get_text().set_horizontalalignment("left")
            cell.PAD = 0.0


def steady_page(state: SteadyState) -> Page:
    """A periodic state: its defect and stability, and the figures of its period."""
    largest = 1.0 - state.stability_margin
    found = f"periodic state of {format_si(state.period, 's')}, found in {state.periods:.3g} periods"
    left = (
        f"a further period changes the voltages by {state.defect:.2g} V at most, and leaves {100.0 * largest:.3g} % of "
        "a small disturbance"
    )
    try:
        period = summary_table(state.solution).blocks
    except SolveError as error:
        period = (error.message,)
    return Page([found, left, "", *period])


def comparison_table(comparison: Comparison) -> Page:
    """A comparison as a table, with its result in words."""
    names = {
        "amplitude": "gap voltage amplitude",
        "phase_deg": "lead over the source",
        "f_el_mean": "mean force",
        "area_mean": "mean area",
    }
    rows = []
    for row in comparison.rows():
        name, _, gap = row[0].partition(":")
        rows.append((f"{names[name]} {gap}".rstrip() + f" [{row[1]}]", *(f"{x:.6g}" for x in row[2:])))
    head = ("", "phasor", "transient, mean area", "transient, coupled", "coupled - phasor", "of it, ripple")
    said = []
    for i, gap in enumerate(comparison.gaps):
        figures = comparison.phasor, comparison.mean, comparison.coupled
        reference, mean, coupled = (f.of_gap(i)["f_el_mean"] for f in figures)
        # Round before formatting, and add 0.0, so that -0.00 is not printed.
        total = round(100.0 * (coupled / reference - 1.0), 2) + 0.0
        waveform = round(100.0 * (mean / reference - 1.0), 2) + 0.0
        said.append(
            f"mean force{f' of {gap}' if len(comparison.gaps) > 1 else ''}: {total:+.2f} % against the phasor; "
            f"{total - waveform:+.2f} % of that is the ripple of the area, {waveform:+.2f} % is the waveform's (zero "
            "for a sine)"
        )
    return Page(
        [
            *head_lines(comparison.solution.circuit),
            f"periodic state at {format_si(comparison.frequency, 'Hz')}, charge law {comparison.solution.charge_law}",
            "",
            Table(head, rows),
            "",
            *said,
        ]
    )


def limits_text(limits: FoldLimits) -> Page:
    """A map of the mobile law's fold: a sentence, and a table for each parameter."""
    own = format_si(limits.peak, "V")
    if math.isfinite(limits.voltage):
        head = (
            f"under the mobile law this deck folds at {format_si(limits.voltage, 'V')} peak; its source reaches {own}, "
            f"{100.0 * limits.peak / limits.voltage:.3g} % of that"
        )
    else:
        head = f"under the mobile law this deck does not fold; its source reaches {own}"
    lines: list[str | Table] = [*head_lines(limits.circuit), head]
    for sweep in limits.sweeps:
        rows = [
            (format_si(x, sweep.unit), format_si(u, "V") if math.isfinite(u) else "none")
            for x, u in zip(sweep.values.tolist(), sweep.voltages.tolist(), strict=True)
        ]
        lines += ["", Table((sweep.name, "folds at"), rows)]
    return Page(lines)


def limits_csv(limits: FoldLimits, path: Path) -> Path:
    """Write a map of the fold as CSV; a row without a fold has an empty voltage."""
    rows = [
        (sweep.name, x, sweep.unit, u if math.isfinite(u) else "")
        for sweep in limits.sweeps
        for x, u in zip(sweep.values.tolist(), sweep.voltages.tolist(), strict=True)
    ]
    return write_csv(path, ("parameter", "value [SI]", "unit", "fold [V]"), rows)
