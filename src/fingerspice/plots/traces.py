"""Pictures of signals against time: one run or several, whole or a window of them, and the envelope of a long one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from difflib import get_close_matches
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from fingerspice.base.arrays import FloatArray
from fingerspice.base.errors import InputError
from fingerspice.circuit.describe import changes_text, drive_text, heading
from fingerspice.plots.drawing import (
    BLACK,
    BLUE,
    CYCLE,
    DASHES,
    FONT,
    GREEN,
    GREY,
    PURPLE,
    VERMILION,
    caption,
    dress,
    engineering,
    flat,
    from_zero,
    legend_above,
    legend_within,
    new_figure,
    peak_of,
    thin,
)  # fmt: skip
from fingerspice.results.outcome import Status
from fingerspice.results.signals import SIGNALS
from fingerspice.waveforms.waveform import require

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from fingerspice.plots.picture import Picture
    from fingerspice.results.solution import Solution

#: Oscillations in a window that are drawn as lines; of more the envelope, beside the last few of them.
MOST_DRAWN, ZOOMED = 30, 4
#: Outputs in an oscillation that show its shape.
_FEWEST = 12
#: Parts of the window that an envelope has at most, each of one oscillation or more.
_PARTS = 240
#: Letters that a legend has room for across the page, and over the left of two columns.
_PAGE, _HALF = 90, 50
#: Widths of lines in one panel, points: those that coincide lie on one another, the later the narrower and dashed.
_WIDTHS = (2.0, 1.5, 1.2, 1.0)
#: Width and opacity of a source's line, on which the others lie.
_PALE: dict[str, Any] = {"linewidth": 3.2, "alpha": 0.45, "linestyle": "-", "solid_capstyle": "butt"}


class Quantity(NamedTuple):
    """A panel: what it is of, its unit, the smallest number worth a prefix, its colour, and whether it starts at 0."""

    label: str
    unit: str
    least: float
    color: str
    from_zero: bool


VOLTAGE = Quantity("Voltage", "V", 2.0, BLUE, False)
QUANTITIES = {
    **dict.fromkeys(("u_source", "u_gap", "u_layer", "v"), VOLTAGE),
    "f_el": Quantity("Force", "N", 0.05, VERMILION, True),
    "area": Quantity("Ridge area", "mm²", 0.0, GREEN, False),
    "f_t": Quantity("Friction", "N", 0.05, PURPLE, True),
    "friction": Quantity("Friction coefficient", "", 0.0, PURPLE, True),
    "sigma_el": Quantity("Stress", "Pa", 2.0, VERMILION, True),
    "q_source": Quantity("Charge", "C", 2.0, BLUE, False),
    "i_source": Quantity("Current", "A", 2.0, BLUE, False),
    "fold_margin": Quantity("Distance to the fold", "", 0.0, BLACK, True),
}
_CALLED = {"u_source": "source", "u_gap": "gap", "f_el": "electroadhesive force", "f_t": "friction", "v": "node",
           "u_layer": "layer", "friction": "coefficient", "sigma_el": "electroadhesive stress", "q_source": "charge",
           "i_source": "current", "fold_margin": "distance to the fold"}  # fmt: skip


class Drawn(NamedTuple):
    """A run in a picture, and what it is called there."""

    solution: Solution
    label: str


@dataclass(frozen=True)
class Trace:
    """One line of a panel."""

    solution: Solution
    name: str
    label: str
    x: FloatArray
    style: dict[str, Any]


def plot_solution(
    solution: Solution,
    signals: str | Sequence[str] | None = None,
    window: tuple[float, float] | None = None,
    others: Solution | Sequence[Solution] | Mapping[str, Solution] = (),
) -> Picture:
    """Signals over one time axis; arguments as in `Solution.plot`."""
    runs = _runs(solution, others)
    panels = _panels(runs, signals)
    start, stop = _window(runs, window)
    marks = _turns(runs, panels, start, stop)
    dense = marks.size > 2 * MOST_DRAWN
    heights = [1.5 if quantity == VOLTAGE else 1.1 for quantity, _ in panels]
    options: dict[str, Any] = {"height_ratios": heights, "sharex": "col", "sharey": "row"}
    if dense:
        options["width_ratios"] = [1.5, 1.0]
    figure, axes = new_figure(len(panels), 2 if dense else 1, height=max(3.4, 0.7 + 1.15 * sum(heights)), **options)
    left, right = (axes[::2], axes[1::2]) if dense else (axes, [])
    zoomed = _zoom(marks, stop) if dense else (start, stop)
    for row, (quantity, keys) in enumerate(panels):
        traces = traces_of(runs, keys)
        factor, unit = scale_of(quantity, traces, start, stop)
        for trace in traces:
            draw_line(left[row], trace, factor, start, stop, runs, envelope=marks if dense else None)
            if dense:
                draw_line(right[row], replace(trace, label="_"), factor, *zoomed, runs)
        if keys == ["f_el"] and len(traces) == 1:
            draw_mean(left[row], traces[0], factor, unit, told=not dense)
            if dense:
                draw_mean(right[row], traces[0], factor, unit)
                legend_above(right[row], 1)
        finish_panel(left[row], quantity, unit, [factor * t.x for t in traces], _HALF if dense else _PAGE)
        if keys == ["f_t"] and len(traces) == 1:
            _coefficient(right[row] if dense else left[row], traces[0].solution, factor)
    time_axis(left, runs, start, stop)
    if dense:
        time_axis(right, runs, *zoomed)
        for ax in right:
            # Times with many digits have room for a few only.
            ax.locator_params(axis="x", nbins=3)
        count = marks.size // 2
        left[-1].set_xlabel(f"{left[-1].get_xlabel()}: envelope of {count} oscillations", fontsize=FONT)
        right[-1].set_xlabel(f"{right[-1].get_xlabel()}: the last {ZOOMED}", fontsize=FONT)
    small = _about(runs)
    t = solution.t
    if dense and np.count_nonzero((t >= zoomed[0]) & (t <= zoomed[1])) < _FEWEST * ZOOMED:
        small += f" · fewer than {_FEWEST} outputs an oscillation: their shape needs a shorter TSTEP"
    caption(figure, small, GREY if all(run.solution.success for run in runs) else VERMILION)
    figure.align_ylabels(left)
    return figure


def _runs(solution: Solution, others: Any) -> list[Drawn]:
    """Every run with what it is called: the name given, or what sets it apart."""
    from fingerspice.results.solution import Solution

    if isinstance(others, Solution):
        others = (others,)
    named = isinstance(others, Mapping)
    rest = list(others.values()) if named else list(others) if isinstance(others, Sequence) else [others]
    for other in rest:
        require(isinstance(other, Solution), "others", repr(other), "Solutions, or a mapping of names to Solutions")
    every = [solution, *rest]
    if len(every) == 1:
        return [Drawn(solution, "")]
    facts = [
        (s.circuit.title, changes_text(s.circuit), f"{s.charge_law} law", f"area {s.area_mode}", s.method,
         f"rtol {s.rtol:g}")
        for s in every
    ]  # fmt: skip
    told = [i for i in range(len(facts[0])) if len({fact[i] for fact in facts}) > 1]
    labels = [", ".join(fact[i] or "the deck as it is" for i in told) or f"run {n}" for n, fact in enumerate(facts, 1)]
    if named:
        labels[1:] = map(str, others)
    return [Drawn(s, label) for s, label in zip(every, labels, strict=True)]


def _panels(runs: list[Drawn], signals: str | Sequence[str] | None) -> list[tuple[Quantity, list[str]]]:
    """Panels from top to bottom, and the signals in each."""
    every = [run.solution.all_signals for run in runs]
    if signals is None:
        contact = any(s.gaps for s in every)
        layers = any(s.layers for s in every)
        signals = (
            ["u_source", "u_gap", "f_el", "area", "f_t"] if contact else ["u_source", "u_layer" if layers else "v"]
        )
    asked = [signals] if isinstance(signals, str) else list(signals)
    known = {name: None for s in every for key in SIGNALS for name in (key, *s.names(key)) if s.names(key)}
    panels: list[tuple[Quantity, list[str]]] = []
    for name in asked:
        if name not in known:
            near = get_close_matches(str(name), known, 1, 0.0)
            raise InputError(f"unknown signal {name!r}; nearest: {near[0]!r}; allowed: {', '.join(_short(known))}")
        quantity = QUANTITIES[name.partition(":")[0]]
        same = [keys for q, keys in panels if q == quantity]
        if same:
            same[0].append(name)
        else:
            panels.append((quantity, [name]))
    require(bool(panels), "signals", "empty", "one name or more")
    return panels


def _short(names: Mapping[str, None]) -> list[str]:
    return [name for name in names if ":" not in name] + ["and name:element"]


def _window(runs: list[Drawn], window: tuple[float, float] | None) -> tuple[float, float]:
    """Start and end of what is drawn, s."""
    times = [run.solution.t for run in runs if run.solution.t.size]
    first, last = min((float(t[0]) for t in times), default=0.0), max(_end(run.solution) for run in runs)
    if window is None:
        return first, last
    pair = isinstance(window, Sequence) and len(window) == 2
    good = pair and all(isinstance(x, (int, float, np.number)) for x in window)
    require(good, "window", repr(window), "two times in s, (start, stop)")
    start, stop = max(float(window[0]), first), min(float(window[1]), last)
    shown = any(np.count_nonzero((t >= start) & (t <= stop)) >= 2 for t in times)
    inside = f"ascending, with two outputs or more between them, from {first:g} to {last:g} s"
    require(start < stop and shown, "window", f"{window[0]:g} to {window[1]:g} s", inside)
    return start, stop


def _end(solution: Solution) -> float:
    """Where the run stopped, s."""
    return float(max(solution.state.t, solution.t[-1])) if solution.t.size else float(solution.state.t)


def _turns(runs: list[Drawn], panels: list[tuple[Quantity, list[str]]], start: float, stop: float) -> FloatArray:
    """Times (s) at which the signal of the first panel that turns most often does so: two to each oscillation."""
    best = np.zeros(0)
    for run in runs:
        t = run.solution.t
        kept = (t >= start) & (t <= stop)
        for key in panels[0][1]:
            for x in _found(run.solution, key).values():
                step = np.diff(x[kept])
                # Rounding turns, too.
                steep = np.flatnonzero(np.abs(step) > 1e-6 * peak_of(x))
                turns = steep[1:][np.signbit(step[steep[1:]]) != np.signbit(step[steep[:-1]])]
                if turns.size > best.size:
                    best = t[kept][turns]
    return best


def _zoom(marks: FloatArray, stop: float) -> tuple[float, float]:
    """Start and end of the last oscillations, s; not of the silence that may follow them."""
    first, last = float(marks[-2 * ZOOMED - 1]), float(marks[-1])
    return first, min(stop, last + 0.1 * (last - first))


def _found(solution: Solution, key: str) -> dict[str, FloatArray]:
    """A signal by name; nothing where another of the runs has that element only."""
    kind, colon, _ = key.partition(":")
    return solution.by_name(key) if not colon or key in solution.all_signals.names(kind) else {}


def traces_of(runs: Sequence[Drawn], keys: Sequence[str]) -> list[Trace]:
    """The lines of one panel: a finger has its colour in every panel, and so has a run where there are several."""
    out: list[Trace] = []
    gaps = list(dict.fromkeys(gap for run in runs for gap in run.solution.gaps))
    above = 0
    # What drives all of them alike is drawn once.
    driven = {run.solution.u_source.tobytes() for run in runs}
    for number, run in enumerate(runs):
        for key in keys:
            found = _found(run.solution, key)
            for place, (name, x) in enumerate(found.items()):
                kind, _, element = name.partition(":")
                source = kind == "u_source"
                if source and len(driven) == 1 and number > 0:
                    continue
                word = _CALLED.get(kind, kind)
                label = element if kind == "v" else f"{word} {element}".rstrip()
                if len(gaps) > 1 and element in gaps:
                    color = CYCLE[gaps.index(element) % len(CYCLE)]
                elif len(runs) > 1 and not (source and len(driven) == 1):
                    color = CYCLE[number % len(CYCLE)]
                elif source:
                    color = (GREY, *CYCLE[::-1])[place % (len(CYCLE) + 1)]
                else:
                    color = QUANTITIES[kind].color if len(found) == 1 and len(keys) <= 2 else CYCLE[above % len(CYCLE)]
                style: dict[str, Any] = {"color": color}
                if source:
                    style |= _PALE
                else:
                    style |= {"linewidth": _WIDTHS[above % 4], "linestyle": DASHES[above % 4]}
                    above += 1
                if run.label and not (source and len(driven) == 1):
                    label = f"{label}, {run.label}"
                out.append(Trace(run.solution, name, label, x, style))
    return out


def scale_of(quantity: Quantity, traces: list[Trace], start: float, stop: float) -> tuple[float, str]:
    """Factor and unit of a panel."""
    if quantity.unit == "mm²":
        return 1e6, "mm²"
    if quantity.least == 0.0:
        return 1.0, quantity.unit
    peaks = [peak_of(t.x[(t.solution.t >= start) & (t.solution.t <= stop)]) for t in traces]
    return engineering(max(peaks, default=0.0), quantity.unit, quantity.least)


def draw_line(
    ax: Axes, trace: Trace, factor: float, start: float, stop: float, runs: Sequence[Drawn],
    envelope: FloatArray | None = None,
) -> None:  # fmt: skip
    """Draw a line, or its envelope over the window; a neighbour on either side leads it out of the picture."""
    t = trace.solution.t
    first, last = max(int(np.searchsorted(t, start)) - 1, 0), int(np.searchsorted(t, stop, side="right")) + 1
    t, x = t[first:last], factor * trace.x[first:last]
    scale = time_unit(runs)[0]
    if envelope is None:
        t, x = thin(t, x)
        ax.plot(scale * t, x, label=trace.label, **{"solid_joinstyle": "round", **trace.style})
        return
    # Each part holds an oscillation, where there are any.
    parts = (stop - start) / (2.0 * float(np.median(np.diff(envelope))))
    edges = np.linspace(start, stop, max(1, int(min(parts, _PARTS))) + 1)
    begin = np.searchsorted(t, edges[:-1])
    kept = np.diff(np.append(begin, t.size)) > 0
    begin, middle = begin[kept], 0.5 * (edges[:-1] + edges[1:])[kept]
    low, high = np.minimum.reduceat(x, begin), np.maximum.reduceat(x, begin)
    pale = "alpha" in trace.style
    color = trace.style["color"]
    ax.fill_between(scale * middle, low, high, color=color, alpha=0.3 if pale else 0.2, linewidth=0.0)
    edge = {**trace.style, "linewidth": 1.6 if pale else 0.7 * trace.style["linewidth"]}
    ax.plot(scale * middle, low, **edge)
    ax.plot(scale * middle, high, **edge, label=trace.label)


def draw_mean(ax: Axes, trace: Trace, factor: float, unit: str, *, told: bool = True) -> None:
    """The mean force as a line, `told` in the legend."""
    summary = trace.solution.summary()
    periodic = summary.get("f_el_mean_periodic")
    mean = periodic if periodic is not None else summary.get("f_el_mean")
    if mean is not None:
        text = f"mean {'of the last period' if periodic is not None else 'of the run'}, {factor * mean:.4g} {unit}"
        label = text if told else "_"
        ax.axhline(factor * mean, color=BLACK, linewidth=1.0, linestyle=DASHES[1], label=label)


def finish_panel(ax: Axes, quantity: Quantity, unit: str, values: Sequence[FloatArray], room: int = _PAGE) -> None:
    """Labels, limits and legend of a panel, the latter so many letters wide."""
    dress(ax, f"{quantity.label} [{unit}]" if unit else quantity.label)
    if quantity.from_zero:
        from_zero(ax)
    else:
        ax.ticklabel_format(axis="y", useOffset=False)
        flat(ax, np.concatenate(values) if values else np.zeros(0))
    legend_within(ax, room)


def _coefficient(ax: Axes, solution: Solution, factor: float) -> None:
    """A second scale of the friction: over the load."""
    ((_, contact),) = solution.record.fingers
    load = factor * contact.f_n
    right = ax.secondary_yaxis("right", functions=(partial(np.multiply, 1.0 / load), partial(np.multiply, load)))
    right.set_ylabel("coefficient", fontsize=FONT, color=GREY)
    right.tick_params(labelsize=FONT - 0.5, color="#999999", labelcolor=GREY)
    right.spines["right"].set_color("#999999")


def time_unit(runs: Sequence[Drawn]) -> tuple[float, str]:
    """Factor and unit of the time axis."""
    return engineering(max(max(_end(run.solution), peak_of(run.solution.t)) for run in runs), "s")


def time_axis(axes: Sequence[Axes], runs: Sequence[Drawn], start: float, stop: float) -> None:
    """Limits and label of the time, s, and where a run stopped early."""
    factor, unit = time_unit(runs)
    span = (stop - start) or 1.0
    stopped = [r.solution for r in runs if r.solution.status not in (Status.SUCCESS, Status.ERROR_NOT_MET)]
    early = [s for s in stopped if start <= _end(s) <= stop]
    # Right of the last sign of it there is room to see that.
    wide = 1.08 if early else 1.0
    for ax in axes:
        ax.set_xlim(factor * start, factor * (start + span * wide))
        ax.ticklabel_format(axis="x", useOffset=False)
        for solution in early:
            end = _end(solution)
            if len(runs) == 1:
                ax.axvspan(factor * end, factor * (start + wide * span), color="#EEEEEE", zorder=0.5)
            ax.axvline(factor * end, color=VERMILION, linewidth=1.2, linestyle=DASHES[3])
    if early:
        place: dict[str, Any] = {"transform": axes[0].get_xaxis_transform(), "ha": "right", "va": "top"}
        axes[0].text(factor * _end(early[0]), 0.98, "stopped ", fontsize=FONT - 0.5, color=VERMILION, **place)
    axes[-1].set_xlabel(f"Time [{unit}]", fontsize=FONT)


def about(solution: Solution) -> str:
    """How a run was made, in one line."""
    text = " · ".join(fact for fact in _facts(solution) if fact)
    return text if solution.success else f"{text} · {solution.message}"


def _facts(solution: Solution) -> list[str]:
    """What a caption tells of a run, always the same at each place; empty where there is nothing to tell."""
    error = f"error estimate {solution.error.u_gap:.2g} V"
    if solution.gaps:
        error += f", {solution.error.f_el:.2g} N"
    return [
        heading(solution.circuit),
        drive_text(solution.circuit),
        f"{solution.charge_law} charge law",
        f"area: {solution.area_mode}" if solution.gaps else "",
        f"method {solution.method}, rtol {solution.rtol:.2g}",
        error,
    ]


def _about(runs: list[Drawn]) -> str:
    """How the runs were made: what they share once, then what each has of its own."""
    if len(runs) == 1:
        return about(runs[0].solution)
    facts = [_facts(run.solution) for run in runs]
    shared = [f for i, f in enumerate(facts[0]) if f and all(other[i] == f for other in facts)]
    own = []
    for run, fact in zip(runs, facts, strict=True):
        # What was changed is in the label.
        differs = [f for i, f in enumerate(fact[1:], 1) if f and any(other[i] != f for other in facts)]
        own.append(f"{run.label}: {', '.join(differs)}" if differs else run.label)
    title = runs[0].solution.circuit.title
    alike = all(run.solution.circuit.title == title for run in runs)
    return " · ".join([*([title] if alike and title not in shared else []), *shared, *own])
