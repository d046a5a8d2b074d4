"""Parts of the pictures against time: panels, lines, time axis and caption."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from fingerspice.base.arrays import FloatArray, IntArray
from fingerspice.circuit.describe import drive_text, heading
from fingerspice.plots import drawing
from fingerspice.results.outcome import Status
from fingerspice.results.record import SIGNALS, Signal

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from fingerspice.results.solution import Solution

#: An envelope divides the window into at most this many parts, each at least one oscillation long.
_PARTS = 240
#: Number of letters for which a legend has room: across the page, and over the left one of two columns.
PAGE, HALF = 90, 50
#: Line widths (points) in one panel: later lines are narrower and dashed, so that all stay visible where they coincide.
_WIDTHS = (2.0, 1.5, 1.2, 1.0)
#: A source is drawn wide and pale, and the other lines are drawn on top of it.
_PALE: dict[str, Any] = {"linewidth": 3.2, "alpha": 0.45, "linestyle": "-", "solid_capstyle": "butt"}


#: Colour of a panel's line where there is one, by its label.
COLORS = {
    "Voltage": drawing.BLUE, "Charge": drawing.BLUE, "Current": drawing.BLUE, "Ridge area": drawing.GREEN,
    "Friction": drawing.PURPLE, "Friction coefficient": drawing.PURPLE, "Distance to the fold": drawing.BLACK,
    "Force": drawing.VERMILION, "Stress": drawing.VERMILION,
}  # fmt: skip


class Drawn(NamedTuple):
    """A run in a picture, with its name in the legend."""

    solution: Solution
    label: str


class Trace(NamedTuple):
    """One line of a panel: a signal's values `x` in a run, its label, and matplotlib's line style."""

    solution: Solution
    label: str
    x: FloatArray
    style: dict[str, Any]


def end_of(solution: Solution) -> float:
    """Time at which the run stopped, s."""
    return float(max([solution.state.t, *solution.t[-1:]]))


def columns_of(solution: Solution, key: str) -> dict[str, FloatArray]:
    """A signal by name; empty if this run lacks the element, which another run of the picture may have."""
    kind, colon, _ = key.partition(":")
    return solution.by_name(key) if not colon or key in solution.record.names(kind) else {}


def traces_of(runs: Sequence[Drawn], keys: Sequence[str]) -> list[Trace]:
    """The lines of one panel; the colour of a finger, or of a run among several, is the same in every panel."""
    out: list[Trace] = []
    gaps = list(dict.fromkeys(gap for run in runs for gap in run.solution.gaps))
    above = 0
    # If the source is the same in all runs, it is drawn once, without the name of a run.
    shared = len({run.solution.u_source.tobytes() for run in runs}) == 1
    for number, run in enumerate(runs):
        for key in keys:
            found = columns_of(run.solution, key)
            for place, (name, x) in enumerate(found.items()):
                kind, _, element = name.partition(":")
                source = kind == "u_source"
                if source and shared and number > 0:
                    continue
                label = element if kind == "v" else f"{SIGNALS[kind].short} {element}".rstrip()
                if len(gaps) > 1 and element in gaps:
                    color = drawing.CYCLE[gaps.index(element) % len(drawing.CYCLE)]
                elif len(runs) > 1 and not (source and shared):
                    color = drawing.CYCLE[number % len(drawing.CYCLE)]
                elif source:
                    color = (drawing.GREY, *drawing.CYCLE[::-1])[place % (len(drawing.CYCLE) + 1)]
                elif len(found) == 1 and len(keys) <= 2:
                    color = COLORS[SIGNALS[kind].axis]
                else:
                    color = drawing.CYCLE[above % len(drawing.CYCLE)]
                style = _PALE if source else {"linewidth": _WIDTHS[above % 4], "linestyle": drawing.DASHES[above % 4]}
                above += not source
                if run.label and not (source and shared):
                    label = f"{label}, {run.label}"
                out.append(Trace(run.solution, label, x, {"color": color, **style}))
    return out


def scale_of(signal: Signal, traces: list[Trace], start: float, stop: float) -> tuple[float, str]:
    """Factor and unit of a panel."""
    if signal.unit == "1":
        return 1.0, ""
    peaks = [drawing.peak_of(t.x[(t.solution.t >= start) & (t.solution.t <= stop)]) for t in traces]
    return drawing.engineering(max(peaks, default=0.0), signal.unit, signal.least)


def draw_line(
    ax: Axes, trace: Trace, factor: float, start: float, stop: float, runs: Sequence[Drawn],
    envelope: FloatArray | None = None,
) -> None:  # fmt: skip
    """Draw a line from `start` to `stop` (s), or with the times (s) of its turning points `envelope` its envelope."""
    t = trace.solution.t
    # One output beyond each end of the window is drawn too, so that the line reaches the edges of the picture.
    first, last = max(int(np.searchsorted(t, start)) - 1, 0), int(np.searchsorted(t, stop, side="right")) + 1
    t, x = t[first:last], factor * trace.x[first:last]
    scale = time_unit(runs)[0]
    if envelope is None:
        t, x = drawing.thin(t, x)
        ax.plot(scale * t, x, label=trace.label, **{"solid_joinstyle": "round", **trace.style})
        return
    middle, spans = _envelope_spans(t, start, stop, envelope)
    low, high = np.minimum.reduceat(x, spans)[::2], np.maximum.reduceat(x, spans)[::2]
    pale = "alpha" in trace.style
    ax.fill_between(scale * middle, low, high, color=trace.style["color"], alpha=0.3 if pale else 0.2, linewidth=0.0)
    edge = {**trace.style, "linewidth": 1.6 if pale else 0.7 * trace.style["linewidth"]}
    ax.plot(scale * middle, low, **edge)
    ax.plot(scale * middle, high, **edge, label=trace.label)


def _envelope_spans(t: FloatArray, start: float, stop: float, turns: FloatArray) -> tuple[FloatArray, IntArray]:
    """The middles (s) of an envelope's parts, and the first output and the one after the last of each part's span."""
    lengths = np.diff(turns)
    parts = (stop - start) / (2.0 * float(np.median(lengths)))
    edges = np.linspace(start, stop, max(1, int(min(parts, _PARTS))) + 1)
    middle = 0.5 * (edges[:-1] + edges[1:])
    # A span contains an oscillation, and so a maximum and a minimum, also where oscillations are longer than most, as
    # at the beginning of a chirp. A pause between bursts is no oscillation: what is beside it is much shorter.
    beside = np.pad(lengths, 1, mode="edge")
    oscillation = 2.0 * np.median([beside[:-2], lengths, beside[2:]], axis=0)
    here = np.clip(np.searchsorted(turns, middle) - 1, 0, lengths.size - 1)
    whole = np.maximum(edges[1] - edges[0], oscillation[here])
    # At the ends of the window a span is one-sided, and as long as any other.
    begin = np.maximum(np.minimum(middle - 0.5 * whole, stop - whole), start)
    first = np.searchsorted(t, begin)
    after = np.minimum(np.searchsorted(t, np.minimum(begin + whole, stop)), t.size - 1)
    kept = after > first
    return middle[kept], np.column_stack([first, after])[kept].ravel()


def draw_mean(ax: Axes, trace: Trace, factor: float, unit: str, *, told: bool = True) -> None:
    """Draw the mean force as a horizontal line; with `told` the legend names it."""
    summary = trace.solution.summary()
    means = {"of the last period": summary.get("f_el_mean_periodic"), "of the run": summary.get("f_el_mean")}
    known = [(of, factor * mean) for of, mean in means.items() if mean is not None]
    if known:
        label = f"mean {known[0][0]}, {known[0][1]:.4g} {unit}" if told else "_"
        ax.axhline(known[0][1], color=drawing.BLACK, linewidth=1.0, linestyle=drawing.DASHES[1], label=label)


def finish_panel(ax: Axes, signal: Signal, unit: str, values: Sequence[FloatArray], room: int = PAGE) -> None:
    """Labels, limits and legend of a panel; `room` is the number of letters that the legend has room for."""
    drawing.dress(ax, f"{signal.axis} [{unit}]" if unit else signal.axis)
    if signal.from_zero:
        drawing.from_zero(ax)
    else:
        ax.ticklabel_format(axis="y", useOffset=False)
        drawing.flat(ax, np.concatenate(values) if values else np.zeros(0))
    drawing.legend_within(ax, room)


def coefficient_axis(ax: Axes, solution: Solution, factor: float) -> None:
    """Add a second scale to the friction panel: friction force divided by the normal load."""
    ((_, contact),) = solution.record.fingers
    load = factor * contact.f_n
    right = ax.secondary_yaxis("right", functions=(partial(np.multiply, 1.0 / load), partial(np.multiply, load)))
    right.set_ylabel("coefficient", fontsize=drawing.FONT, color=drawing.GREY)
    right.tick_params(labelsize=drawing.FONT - 0.5, color="#999999", labelcolor=drawing.GREY)
    right.spines["right"].set_color("#999999")


def time_unit(runs: Sequence[Drawn]) -> tuple[float, str]:
    """Factor and unit of the time axis."""
    return drawing.engineering(max(max(end_of(run.solution), drawing.peak_of(run.solution.t)) for run in runs), "s")


def time_axis(axes: Sequence[Axes], runs: Sequence[Drawn], start: float, stop: float) -> None:
    """Set limits (s) and label of the time axis, and mark where a run stopped early."""
    factor, unit = time_unit(runs)
    span = (stop - start) or 1.0
    stopped = [r.solution for r in runs if r.solution.status not in (Status.SUCCESS, Status.ERROR_NOT_MET)]
    early = [s for s in stopped if start <= end_of(s) <= stop]
    # Extend the axis to the right of the end, to show that the run stopped early.
    wide = 1.08 if early else 1.0
    for ax in axes:
        ax.set_xlim(factor * start, factor * (start + span * wide))
        ax.ticklabel_format(axis="x", useOffset=False)
        for solution in early:
            end = end_of(solution)
            if len(runs) == 1:
                ax.axvspan(factor * end, factor * (start + wide * span), color="#EEEEEE", zorder=0.5)
            ax.axvline(factor * end, color=drawing.VERMILION, linewidth=1.2, linestyle=drawing.DASHES[3])
    if early:
        axes[0].text(
            factor * end_of(early[0]), 0.98, "stopped ", transform=axes[0].get_xaxis_transform(), ha="right", va="top",
            fontsize=drawing.FONT - 0.5, color=drawing.VERMILION,
        )  # fmt: skip
    axes[-1].set_xlabel(f"Time [{unit}]", fontsize=drawing.FONT)


def _facts(solution: Solution) -> list[str]:
    """Facts of a run for its caption, each always at the same index; an empty text if a fact does not apply."""
    area, force = (f"area: {solution.area_mode}", f", {solution.error.f_el:.2g} N") if solution.gaps else ("", "")
    return [
        heading(solution.circuit),
        drive_text(solution.circuit),
        f"{solution.charge_law} charge law",
        area,
        f"method {solution.method}, rtol {solution.rtol:.2g}",
        f"error estimate {solution.error.u_gap:.2g} V{force}",
    ]


def about_all(runs: list[Drawn]) -> str:
    """Circuit, method and error of several runs: first the facts that all runs share, then each run's own facts."""
    facts = [_facts(run.solution) for run in runs]
    if len(runs) == 1:
        end = [] if runs[0].solution.success else [runs[0].solution.message]
        return " · ".join([fact for fact in facts[0] if fact] + end)
    shared = [f for i, f in enumerate(facts[0]) if f and all(other[i] == f for other in facts)]
    own = []
    for run, fact in zip(runs, facts, strict=True):
        # Leave out the first fact (title and changed parameters), because the run's label has the changes.
        differs = [f for i, f in enumerate(fact[1:], 1) if f and any(other[i] != f for other in facts)]
        own.append(f"{run.label}: {', '.join(differs)}" if differs else run.label)
    title = runs[0].solution.circuit.title
    alike = all(run.solution.circuit.title == title for run in runs)
    return " · ".join([*([title] if alike and title not in shared else []), *shared, *own])
