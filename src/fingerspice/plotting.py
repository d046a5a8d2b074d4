"""Pictures of results. The only file that imports matplotlib, and only when a figure is made.

Figures are made with matplotlib's object API: no pyplot, no global state, no window.
"""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fingerspice.errors import printable
from fingerspice.files import write_aside
from fingerspice.outcome import Status
from fingerspice.physics.materials import SKIN_BAND

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from fingerspice.circuit.circuit import Circuit
    from fingerspice.comparison import Comparison
    from fingerspice.phasors import PhasorSolution
    from fingerspice.solution import Solution

FloatArray = NDArray[np.float64]

# Okabe and Ito's palette, which the common colour blindnesses tell apart.
BLACK, GREY, BLUE, VERMILION = "#000000", "#777777", "#0072B2", "#D55E00"
GREEN, PURPLE, ORANGE, SKY = "#009E73", "#CC79A7", "#E69F00", "#56B4E9"

FONT, SMALL = 8.5, 7.0
WIDTH = 7.0
"""Font sizes (points) and width (inches) of a figure across a page."""

MAX_BINS = 4000
#: Characters of a name in a legend.
LONGEST_LABEL = 60
_CYCLE = (BLUE, VERMILION, GREEN, PURPLE, ORANGE, SKY)
DASHES: tuple[Any, ...] = ("-", (0, (5, 1.5)), (0, (5, 1.5, 1, 1.5)), (0, (1, 1.2)))
_PREFIXES = {-12: "p", -9: "n", -6: "µ", -3: "m", 0: "", 3: "k", 6: "M", 9: "G"}


def new_figure(rows: int, columns: int = 1, height: float = 3.0, **options: Any) -> tuple[Figure, list[Axes]]:
    """A figure of `rows` by `columns` panels, 7 inches wide and `height` inches high.

    Parameters
    ----------
    rows, columns : int
    height : float
        Inches.
    **options
        For ``Figure.subplots``: ``sharex``, ``height_ratios``, ...

    Returns
    -------
    figure : Figure
        With an Agg canvas, so that it saves without a display.
    axes : list of Axes
        Row by row.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(WIDTH, height), layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    figure.get_layout_engine().set(w_pad=0.06, h_pad=0.05)  # type: ignore[union-attr, call-arg]
    axes = figure.subplots(rows, columns, squeeze=False, **options).ravel().tolist()
    for ax in axes:
        dress(ax)
    return figure, axes


def dress(ax: Axes, ylabel: str = "", xlabel: str = "") -> None:
    """Labels, light grid, no box."""
    if ylabel:
        ax.set_ylabel(ylabel, fontsize=FONT)
    if xlabel:
        ax.set_xlabel(xlabel, fontsize=FONT)
    ax.tick_params(labelsize=FONT - 0.5, color="#999999", which="both")
    ax.spines[["top", "right"]].set_visible(False)
    ax.spines[["left", "bottom"]].set_color("#999999")
    ax.grid(True, color="#E4E4E4", linewidth=0.6)
    ax.set_axisbelow(True)


def legend_above(ax: Axes, columns: int = 4, *, right: bool = False, math: bool = False) -> None:
    """A legend over the panel, where it covers no data; without `math` names keep their ``$``."""
    place: dict[str, Any] = {"loc": "lower right" if right else "lower left", "bbox_to_anchor": (right, 1.0)}
    place |= {"borderaxespad": 0.1, "borderpad": 0.2, "handlelength": 1.8, "columnspacing": 1.2}
    legend = ax.legend(ncols=columns, fontsize=FONT - 0.5, frameon=False, **place)
    for text in legend.get_texts():
        text.set_parse_math(math)
        text.set_text(drawable(text.get_text(), LONGEST_LABEL))


def drawable(text: str, longest: int = 1000) -> str:
    """Text of a deck as it may be drawn: printable, not long, and with a box for what the font has no picture of."""
    text = printable(text, longest)
    if text.isascii():
        return text
    from matplotlib import font_manager

    known = font_manager.get_font(font_manager.findfont(font_manager.FontProperties())).get_charmap()
    return "".join(c if ord(c) in known else "□" for c in text)


def caption(figure: Figure, text: str, color: str = GREY) -> None:
    """Small print under the figure, wrapped to its width."""
    lines = textwrap.fill(drawable(text), 132, break_on_hyphens=False)
    small = figure.supxlabel(lines, x=0.012, ha="left", fontsize=SMALL, color=color)
    small.set_parse_math(False)


def save(figure: Figure, path: str | Path, *, dpi: float = 160.0) -> Path:
    """Write a figure as PNG; the file is whole or absent.

    Parameters
    ----------
    figure : Figure
    path : str or Path
    dpi : float
        Dots per inch.

    Raises
    ------
    InputError
        Where the folder cannot be written.
    """
    return write_aside(
        Path(path), lambda target: figure.savefig(target, format="png", dpi=dpi, pil_kwargs={"compress_level": 3})
    )


def engineering(peak: float, unit: str, least: float = 1.0) -> tuple[float, str]:
    """Factor and unit that bring `peak` to at least `least` and under 1000 of it: (1e3, "ms") for 0.05 s."""
    size = abs(peak) / least
    if not np.isfinite(size) or size == 0.0:
        return 1.0, unit
    power = int(np.clip(3 * np.floor(np.log10(size * (1.0 + 1e-12)) / 3.0), -12, 9))
    return 10.0**-power, _PREFIXES[power] + unit


def thin(t: FloatArray, x: FloatArray, bins: int = MAX_BINS) -> tuple[FloatArray, FloatArray]:
    """The same curve to the eye in at most about 4 points per bin: first, last, least and largest of each.

    Parameters
    ----------
    t, x : ndarray, shape (n,)
    bins : int
        More than there are dots across the page.
    """
    width = t.size // bins
    if width < 8:
        return t, x
    blocks = x[: width * bins].reshape(bins, width)
    start = width * np.arange(bins)
    tail = np.arange(width * bins, t.size)
    ends = (start, start + width - 1, start + blocks.argmin(1), start + blocks.argmax(1))
    keep = np.unique(np.concatenate([*ends, tail]))
    return t[keep], x[keep]


def plot_solution(solution: Solution) -> Figure:
    """Voltages, electroadhesive force, ridge area and friction over one time axis.

    Parameters
    ----------
    solution : Solution
        Of a circuit with or without GAP (then the voltages alone); one that stopped early shows where.

    Returns
    -------
    Figure
    """
    contact = solution.f_el is not None
    rows: dict[str, Any] = {"height": 6.2, "height_ratios": [1.5, 1.2, 1.0, 1.0]} if contact else {"height": 3.4}
    figure, axes = new_figure(4 if contact else 1, sharex=True, **rows)
    _voltages(axes[0], solution)
    if contact:
        _force(axes[1], solution)
        _area(axes[2], solution)
        _friction(axes[3], solution)
    _time_axis(axes, solution)
    caption(figure, _about(solution), GREY if solution.success else VERMILION)
    figure.align_ylabels(axes)
    return figure


def _curve(ax: Axes, solution: Solution, values: FloatArray, **style: Any) -> None:
    t, x = thin(solution.t, values)
    ax.plot(_time_unit(solution)[0] * t, x, **{"linewidth": 1.3, "solid_joinstyle": "round", **style})


def _curves(ax: Axes, solution: Solution, key: str, factor: float, label: str, **style: Any) -> None:
    """A signal, or one line for each gap or source that has it."""
    found = solution.by_name(key)
    for i, (name, x) in enumerate(found.items()):
        own = {"linestyle": DASHES[i % 4], "color": _CYCLE[(_CYCLE.index(style["color"]) + 2 * i) % 6]} if i else {}
        text = f"{label} {name.partition(':')[2]}" if len(found) > 1 else label
        _curve(ax, solution, factor * x, **{**style, **own, "label": text})


def _peak(values: FloatArray) -> float:
    return float(np.abs(values).max(initial=0.0))


def _time_unit(solution: Solution) -> tuple[float, str]:
    return engineering(max(_end(solution), _peak(solution.t)), "s")


def _end(solution: Solution) -> float:
    """Where the run stopped, s."""
    return float(max(solution.state.t, solution.t[-1])) if solution.t.size else float(solution.state.t)


def _voltages(ax: Axes, solution: Solution) -> None:
    factor, unit = engineering(_peak(solution.u_source), "V", 2.0)
    _curves(ax, solution, "u_source", factor, color=GREY, linewidth=1.0, linestyle=DASHES[1], label="source")
    if solution.u_gap is not None:
        _curves(ax, solution, "u_gap", factor, color=BLUE, label="gap")
    else:
        inside = {f"layer {name}": solution.u_layer[:, i] for i, name in enumerate(solution.layers)}
        # Without layers, what there is to see are the nodes.
        for i, (name, x) in enumerate((inside or solution.node_voltages).items()):
            _curve(ax, solution, factor * x, color=_CYCLE[i % 6], linestyle=DASHES[i % 4], label=name)
    dress(ax, f"Voltage [{unit}]")
    legend_above(ax, 5)


def _force(ax: Axes, solution: Solution) -> None:
    assert solution.f_el is not None
    factor, unit = engineering(_peak(solution.f_el), "N", 0.05)
    _curves(ax, solution, "f_el", factor, color=VERMILION, label="electroadhesive force")
    summary = solution.summary()
    periodic = summary.get("f_el_mean_periodic")
    mean = periodic if periodic is not None else summary.get("f_el_mean")
    if mean is not None:
        over = "of the last period" if periodic is not None else "of the run"
        text = f"mean {over}, {factor * mean:.4g} {unit}"
        ax.axhline(factor * mean, color=BLACK, linewidth=1.0, linestyle=DASHES[1], label=text)
    dress(ax, f"Force [{unit}]")
    _from_zero(ax)
    legend_above(ax)


def _area(ax: Axes, solution: Solution) -> None:
    assert solution.area is not None
    _curves(ax, solution, "area", 1e6, color=GREEN, label="area")
    dress(ax, "Ridge area [mm²]")
    ax.ticklabel_format(useOffset=False)
    _flat(ax, 1e6 * solution.area)


def _friction(ax: Axes, solution: Solution) -> None:
    assert solution.f_t is not None
    factor, unit = engineering(_peak(solution.f_t), "N", 0.05)
    _curves(ax, solution, "f_t", factor, color=PURPLE, label="friction")
    dress(ax, f"Friction [{unit}]")
    _from_zero(ax)
    if len(solution.gaps) > 1:
        # Each has its own load.
        return
    load = factor * solution.circuit.by_device("GAP")[0].values["fn"]
    right = ax.secondary_yaxis("right", functions=(partial(np.multiply, 1.0 / load), partial(np.multiply, load)))
    right.set_ylabel("coefficient", fontsize=FONT, color=GREY)
    right.tick_params(labelsize=FONT - 0.5, color="#999999", labelcolor=GREY)
    right.spines["right"].set_color("#999999")


def _from_zero(ax: Axes) -> None:
    """A scale from 0, so that ripple is seen at its size."""
    top = ax.get_ylim()[1]
    ax.set_ylim(0.0, top if top > 0.0 else 1.0)


def _time_axis(axes: Sequence[Axes], solution: Solution) -> None:
    factor, unit = _time_unit(solution)
    stop = _end(solution)
    start = float(solution.t[0]) if solution.t.size else 0.0
    span = (stop - start) or 1.0
    early = solution.status not in (Status.SUCCESS, Status.ERROR_NOT_MET)
    for ax in axes:
        ax.set_xlim(factor * start, factor * (start + span * (1.08 if early else 1.0)))
        if early:
            ax.axvspan(factor * stop, factor * (start + 1.08 * span), color="#EEEEEE", zorder=0.5)
            ax.axvline(factor * stop, color=VERMILION, linewidth=1.2, linestyle=DASHES[3])
    if early:
        place: dict[str, Any] = {"transform": axes[0].get_xaxis_transform(), "ha": "right", "va": "bottom"}
        axes[0].text(factor * stop, 1.0, "stopped ", fontsize=FONT - 0.5, color=VERMILION, **place)
    axes[-1].set_xlabel(f"Time [{unit}]", fontsize=FONT)


def _about(solution: Solution) -> str:
    error = f"error estimate {solution.error.u_gap:.2g} V"
    if solution.f_el is not None:
        error += f", {solution.error.f_el:.2g} N"
    parts = [solution.circuit.title, f"{solution.charge_law} charge law"]
    if solution.f_el is not None:
        parts.append(f"area: {solution.area_mode}")
    parts += [f"method {solution.method}, rtol {solution.rtol:.2g}", error]
    text = " · ".join(p for p in parts if p)
    return text if solution.success else f"{text} · {solution.message}"


def plot_phasor(results: Sequence[PhasorSolution], circuit: Circuit) -> Figure:
    """Gain, phase, mean force and area against frequency, a line per amplitude.

    Parameters
    ----------
    results : sequence of PhasorSolution
        Of sweeps; a single frequency is shown as points.
    circuit : Circuit
        They were made from.

    Returns
    -------
    Figure
    """
    figure, axes = new_figure(2, 2, height=4.6, sharex=True)
    forces = np.concatenate([r.f_el_mean for r in results])
    factor, unit = engineering(_peak(forces[np.isfinite(forces)]), "N", 0.05)
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
        _from_zero(ax)
    amplitude = results[0].amplitude
    if not np.isfinite(amplitude):
        axes[2].text(0.5, 0.5, "the source has no fundamental", transform=axes[2].transAxes, ha="center", fontsize=FONT)
    if len(results) > 1:
        axes[0].legend(fontsize=FONT, frameon=False, loc="lower right", handlelength=3.0)
    _flat(axes[3], 1e6 * np.concatenate([r.area for r in results]))
    outside = _mark_extrapolation(axes, np.sort(results[0].frequency), circuit)
    for ax in axes[2:]:
        ax.set_xlabel("Frequency [Hz]", fontsize=FONT)
    drive = f"{amplitude:.4g} V" if np.isfinite(amplitude) else "no fundamental"
    how = f"source amplitude {drive}" if len(results) == 1 else "several source amplitudes"
    caption(figure, " · ".join(p for p in (circuit.title, how, outside) if p))
    return figure


def _flat(ax: Axes, values: FloatArray) -> None:
    """A constant is shown as one, not its rounding."""
    if values.size and np.ptp(values) <= 1e-6 * _peak(values):
        ax.set_ylim(0.95 * values[0], 1.05 * values[0])


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


def plot_comparison(comparison: Comparison) -> Figure:
    """One period of the transient over the phasor's, and the figures of both in a table.

    Parameters
    ----------
    comparison : Comparison

    Returns
    -------
    Figure
    """
    figure, axes = new_figure(3, height=5.6, height_ratios=[1.3, 1.3, 0.75])
    solution, p = comparison.solution, comparison.phasor
    assert solution.f_el is not None
    source_phase = solution.fundamental.phase if solution.fundamental else 0.0
    angle = 2.0 * np.pi * comparison.frequency * solution.t + source_phase + np.radians(p.phase_deg)
    _voltages(axes[0], solution)
    per_volt = engineering(_peak(solution.u_source), "V", 2.0)[0]
    dashed = {"color": BLACK, "linestyle": DASHES[3], "linewidth": 1.5, "label": "gap, phasor"}
    _curve(axes[0], solution, per_volt * p.amplitude * np.sin(angle), **dashed)
    legend_above(axes[0])
    factor, unit = engineering(_peak(solution.f_el), "N", 0.05)
    _curve(axes[1], solution, factor * solution.f_el, color=VERMILION, label="electroadhesive force")
    force = 2.0 * p.f_el_mean * np.sin(angle) ** 2
    _curve(axes[1], solution, factor * force, **{**dashed, "label": "electroadhesive force, phasor"})
    dress(axes[1], f"Force [{unit}]")
    _from_zero(axes[1])
    legend_above(axes[1])
    _time_axis(axes[:2], solution)
    _table(axes[2], comparison)
    caption(figure, f"{_about(solution)} · periodic state; the phasor is of the fundamental alone")
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
    cells = [
        [
            f"{names[row[0]]} [{row[1].replace('deg', '°').replace('^2', '²')}]",
            *(f"{x:.5g}".replace("-", "−") for x in row[2:5]),
            *(f"{x:+.2g}".replace("-", "−") for x in row[5:]),
        ]
        for row in comparison.rows()
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
