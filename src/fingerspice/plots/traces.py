"""Pictures of signals against time (runs together, in a window, as envelopes), of spectra and of phasors."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from difflib import get_close_matches
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from fingerspice.base.arrays import FloatArray, real_numbers
from fingerspice.base.errors import InputError
from fingerspice.base.units import format_si
from fingerspice.circuit.describe import changes_text, drive_text, heading
from fingerspice.physics.materials import SKIN_BAND
from fingerspice.plots import drawing
from fingerspice.results.outcome import Status
from fingerspice.results.record import SIGNALS, signal_of
from fingerspice.waveforms.waveform import require

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from fingerspice.circuit.circuit import Circuit
    from fingerspice.plots.picture import Picture
    from fingerspice.results.solution import Solution
    from fingerspice.results.spectrum import PhasorSolution, Spectrum

#: More than MOST_DRAWN oscillations are drawn as an envelope, with an enlargement of the last ZOOMED ones with a swing
#: of at least the fraction _LOUD of the largest.
MOST_DRAWN, ZOOMED, _LOUD = 30, 4, 0.7
_FEWEST = 12  # Smallest number of outputs in an oscillation for which its shape is visible
_PARTS = 240  # An envelope divides the window into at most this many parts, each at least one oscillation long
_PAGE, _HALF = 90, 50  # Letters for which a legend has room: across the page, and over the left of two columns
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
Drawn = tuple["Solution", str]  # A run in a picture, with its name in the legend


class Trace(NamedTuple):
    """One line of a panel: a signal's values `x` in a run, its label, and matplotlib's line style."""

    solution: Solution
    label: str
    x: FloatArray
    style: dict[str, Any]


def plot_solution(solution: Solution, signals: Any = None, window: Any = None, others: Any = ()) -> Picture:
    """Signals over one time axis; arguments as in `Solution.plot`."""
    runs = _runs(solution, others)
    panels = _panels(runs, signals)
    start, stop = _window(runs, window)
    marks, heights = _turns(runs, panels[0], start, stop)
    dense = marks.size > 2 * MOST_DRAWN
    zoomed = _zoom(marks, heights, start, stop)
    spans = [(start, stop)] if zoomed is None else [(start, stop), zoomed]
    shares = [1.5 if signal_of(keys[0]).axis == "Voltage" else 1.1 for keys in panels]
    figure, axes = drawing.new_figure(
        len(panels), len(spans), height=max(3.4, 0.7 + 1.15 * sum(shares)), height_ratios=shares,
        width_ratios=[1.5, 1.0][: len(spans)], sharex="col", sharey="row",
    )  # fmt: skip
    columns = [axes[k :: len(spans)] for k in range(len(spans))]
    for keys, first, *enlarged in zip(panels, *columns, strict=True):
        traces, factor, unit = draw_panel(first, runs, keys, start, stop, marks if dense else None)
        last = (first, *enlarged)[-1]
        for trace in traces if enlarged else ():
            _draw_line(last, trace._replace(label="_"), factor, *spans[-1], time_unit(runs)[0])
        if keys == ["f_el"] and len(traces) == 1:
            mean, of = traces[0].solution.f_el_mean_periodic, "the last period"
            if mean is None:
                mean, of = traces[0].solution.f_el_mean, "the run"
            for ax in (first, *enlarged):
                if mean is not None:
                    label = f"mean of {of}, {factor * mean:.4g} {unit}" if ax is last else "_"
                    ax.axhline(factor * mean, c=drawing.BLACK, linewidth=1.0, linestyle=drawing.DASHES[1], label=label)
            if enlarged:
                drawing.legend_above(last, 1)
        finish_panel(first, keys, traces, factor, unit, _HALF if enlarged else _PAGE)
        if keys == ["f_t"] and len(traces) == 1:
            _coefficient_axis(last, traces[0].solution, factor)
    for column, span in zip(columns, spans, strict=True):
        time_axis(column, runs, *span)
    small = about_all(runs)
    if zoomed is not None:
        for ax in columns[1]:
            # Times in an enlargement have many digits, so that only three tick labels have room.
            ax.locator_params(axis="x", nbins=3)
        whole = f"envelope of {marks.size // 2} oscillations" if dense else "the whole run"
        part = f"the last {ZOOMED}" if dense and marks[-1] <= zoomed[1] else "enlarged"
        for ax, told in zip(axes[-2:], (whole, part), strict=True):
            ax.set_xlabel(f"{ax.get_xlabel()}: {told}")
        if dense and np.count_nonzero((solution.t >= zoomed[0]) & (solution.t <= zoomed[1])) < _FEWEST * ZOOMED:
            small += f" · fewer than {_FEWEST} outputs an oscillation: their shape needs a shorter TSTEP"
    drawing.caption(figure, small, drawing.GREY if all(run.success for run, _ in runs) else drawing.VERMILION)
    figure.align_ylabels(columns[0])
    return figure


def _runs(solution: Solution, others: Any) -> list[Drawn]:
    """Every run with its name: the given name, or the facts in which the run differs from the other runs."""
    from fingerspice.results.solution import Solution

    named = isinstance(others, Mapping)
    every = [solution, *(others.values() if named else others if isinstance(others, Sequence) else [others])]
    for other in every:
        if not isinstance(other, Solution):
            raise InputError(f"others is {other!r}; allowed: Solutions, or a mapping of names to Solutions")
    if len(every) == 1:
        return [(solution, "")]
    words = [(f"{s.charge_law} law", f"area {s.area_mode}", s.method, f"rtol {s.rtol:g}") for s in every]
    facts = [(s.circuit.title, changes_text(s.circuit), *said) for s, said in zip(every, words, strict=True)]
    told = [i for i in range(len(facts[0])) if len({fact[i] for fact in facts}) > 1]
    labels = [", ".join(fact[i] or "the deck as it is" for i in told) or f"run {n}" for n, fact in enumerate(facts, 1)]
    if named:
        labels[1:] = map(str, others)
    return list(zip(every, labels, strict=True))


def _panels(runs: list[Drawn], signals: Any) -> list[list[str]]:
    """Names of the signals of each panel, from top to bottom: those of one quantity share one."""
    every = [run.record for run, _ in runs]
    if signals is None:
        inside = "u_layer" if any(s.layers for s in every) else "v"
        signals = ["u_source", *(("u_gap", "f_el", "area", "f_t") if any(s.gaps for s in every) else (inside,))]
    known = {name: None for s in every for key in SIGNALS for name in (key, *s.names(key)) if s.names(key)}
    panels: dict[str, list[str]] = {}
    for name in [signals] if isinstance(signals, str) else signals:
        if name not in known:
            near = get_close_matches(str(name), known, 1, 0.0)
            allowed = ", ".join([*(name for name in known if ":" not in name), "and name:element"])
            raise InputError(f"unknown signal {name!r}; nearest: {near[0]!r}; allowed: {allowed}")
        panels.setdefault(signal_of(name).axis, []).append(name)
    require(bool(panels), "signals", "empty", "one name or more")
    return list(panels.values())


def _window(runs: list[Drawn], window: Any) -> tuple[float, float]:
    """Start and end of the drawn interval, s."""
    times = [run.t for run, _ in runs if run.t.size]
    first, last = min((float(t[0]) for t in times), default=0.0), max(_end_of(run) for run, _ in runs)
    if window is None:
        return first, last
    ends = real_numbers("window", window, "two times in s, (start, stop)")
    require(ends.shape == (2,), "window", repr(window), "two times in s, (start, stop)")
    start, stop = max(float(ends[0]), first), min(float(ends[1]), last)
    shown = any(np.count_nonzero((t >= start) & (t <= stop)) >= 2 for t in times)
    inside = f"ascending, with two outputs or more between them, from {first:g} to {last:g} s"
    require(start < stop and shown, "window", f"{ends[0]:g} to {ends[1]:g} s", inside)
    return start, stop


def _turns(runs: list[Drawn], keys: Sequence[str], start: float, stop: float) -> tuple[FloatArray, FloatArray]:
    """Times (s) and values of the turning points, two per oscillation, of a panel's most oscillating signal."""
    best = np.zeros(0), np.zeros(0)
    for (run, _), key in itertools.product(runs, keys):
        t = run.t
        kept = (t >= start) & (t <= stop)
        for x in _columns_of(run, key).values():
            step = np.diff(x[kept])
            # Turning points of round-off are not counted.
            steep = np.flatnonzero(np.abs(step) > 1e-6 * drawing.peak_of(x))
            turns = steep[1:][np.signbit(step[steep[1:]]) != np.signbit(step[steep[:-1]])]
            if turns.size > best[0].size:
                best = t[kept][turns], x[kept][turns]
    return best


def _zoom(marks: FloatArray, heights: FloatArray, start: float, stop: float) -> tuple[float, float] | None:
    """Start and end (s) of what is enlarged: the last of many oscillations that are not small, or few as of a click."""
    if marks.size > 2 * MOST_DRAWN:
        swing = np.lib.stride_tricks.sliding_window_view(np.abs(np.diff(heights)), 2 * ZOOMED).max(axis=1)
        place = int(np.flatnonzero(swing >= _LOUD * swing.max())[-1])
        first, last = float(marks[place]), float(marks[place + 2 * ZOOMED])
        # Leave out a constant part that may follow the oscillations.
        return first, min(stop, last + 0.1 * (last - first))
    if marks.size < 2 or (around := float(marks[-1] - marks[0])) > (stop - start) / MOST_DRAWN:
        return None
    return max(start, float(marks[0]) - around), min(stop, float(marks[-1]) + around)


def _end_of(solution: Solution) -> float:
    """Time at which the run stopped, s."""
    return float(max([solution.state.t, *solution.t[-1:]]))


def _columns_of(solution: Solution, key: str) -> dict[str, FloatArray]:
    """A signal by name; empty if this run lacks the element, which another run of the picture may have."""
    kind, colon, _ = key.partition(":")
    return solution.by_name(key) if not colon or key in solution.record.names(kind) else {}


def draw_panel(
    ax: Axes, runs: Sequence[Drawn], keys: Sequence[str], start: float, stop: float, envelope: FloatArray | None = None
) -> tuple[list[Trace], float, str]:
    """Draw signals of one quantity, or with the times (s) of turning points envelopes; gives lines, factor and unit."""
    traces, signal, factor, unit = _traces_of(runs, keys), signal_of(keys[0]), 1.0, ""
    if signal.unit != "1":
        peaks = [drawing.peak_of(t.x[(t.solution.t >= start) & (t.solution.t <= stop)]) for t in traces]
        factor, unit = drawing.engineering(max(peaks, default=0.0), signal.unit, signal.least)
    for trace in traces:
        _draw_line(ax, trace, factor, start, stop, time_unit(runs)[0], envelope)
    return traces, factor, unit


def _traces_of(runs: Sequence[Drawn], keys: Sequence[str]) -> list[Trace]:
    """The lines of one panel; the colour of a finger, or of a run among several, is the same in every panel."""
    out: list[Trace] = []
    gaps = list(dict.fromkeys(gap for run, _ in runs for gap in run.gaps))
    above = 0
    # If the source is the same in all runs, it is drawn once, without the name of a run.
    shared = len({run.u_source.tobytes() for run, _ in runs}) == 1
    for (number, (run, run_name)), key in itertools.product(enumerate(runs), keys):
        found = _columns_of(run, key)
        for place, (name, x) in enumerate(found.items()):
            kind, _, element = name.partition(":")
            source = kind == "u_source"
            alone = source and shared
            if alone and number > 0:
                continue
            label = element if kind == "v" else f"{SIGNALS[kind].short} {element}".rstrip()
            if len(gaps) > 1 and element in gaps:
                color = drawing.CYCLE[gaps.index(element) % len(drawing.CYCLE)]
            elif len(runs) > 1 and not alone:
                color = drawing.CYCLE[number % len(drawing.CYCLE)]
            elif source:
                color = (drawing.GREY, *drawing.CYCLE[::-1])[place % (len(drawing.CYCLE) + 1)]
            elif len(found) == 1 and len(keys) <= 2:
                color = COLORS[SIGNALS[kind].axis]
            else:
                color = drawing.CYCLE[above % len(drawing.CYCLE)]
            style = _PALE if source else {"linewidth": _WIDTHS[above % 4], "linestyle": drawing.DASHES[above % 4]}
            above += not source
            label += f", {run_name}" if run_name and not alone else ""
            out.append(Trace(run, label, x, {"color": color, **style}))
    return out


def _draw_line(
    ax: Axes, trace: Trace, factor: float, start: float, stop: float, scale: float, envelope: FloatArray | None = None
) -> None:
    """Draw a line, or from the times (s) of its turning points its envelope, of times multiplied by `scale`."""
    t = trace.solution.t
    # One output beyond each end of the window is drawn too, so that the line reaches the edges of the picture.
    first, last = max(int(np.searchsorted(t, start)) - 1, 0), int(np.searchsorted(t, stop, side="right")) + 1
    t, x = t[first:last], factor * trace.x[first:last]
    if envelope is None:
        t, x = drawing.thin(t, x)
        ax.plot(scale * t, x, label=trace.label, **{"solid_joinstyle": "round", **trace.style})
        return
    lengths = np.diff(envelope)
    parts = (stop - start) / (2.0 * float(np.median(lengths)))
    edges = np.linspace(start, stop, max(1, int(min(parts, _PARTS))) + 1)
    middle = 0.5 * (edges[:-1] + edges[1:])
    # A span contains an oscillation, and so a maximum and a minimum, also where oscillations are longer than most, as
    # at the beginning of a chirp. A pause between bursts is no oscillation: what is beside it is much shorter.
    beside = np.pad(lengths, 1, mode="edge")
    oscillation = 2.0 * np.median([beside[:-2], lengths, beside[2:]], axis=0)
    here = np.clip(np.searchsorted(envelope, middle) - 1, 0, lengths.size - 1)
    whole = np.maximum(edges[1] - edges[0], oscillation[here])
    # At the ends of the window a span is one-sided, and as long as any other.
    begin = np.maximum(np.minimum(middle - 0.5 * whole, stop - whole), start)
    spans = np.searchsorted(t, [begin, np.minimum(begin + whole, stop)]).clip(max=t.size - 1)
    kept = spans[1] > spans[0]
    t, spans = scale * middle[kept], spans[:, kept].T.ravel()
    low, high = np.minimum.reduceat(x, spans)[::2], np.maximum.reduceat(x, spans)[::2]
    pale = "alpha" in trace.style
    ax.fill_between(t, low, high, color=trace.style["color"], alpha=0.3 if pale else 0.2, linewidth=0.0)
    edge = {**trace.style, "linewidth": 1.6 if pale else 0.7 * trace.style["linewidth"]}
    ax.plot(t, low, **edge)
    ax.plot(t, high, **edge, label=trace.label)


def finish_panel(
    ax: Axes, keys: Sequence[str], traces: Sequence[Trace], factor: float, unit: str, room: int = _PAGE
) -> None:
    """Labels, limits and legend of a panel; `room` is the number of letters that the legend has room for."""
    signal = signal_of(keys[0])
    drawing.dress(ax, f"{signal.axis} [{unit}]" if unit else signal.axis)
    if signal.from_zero:
        drawing.from_zero(ax)
    else:
        drawing.flat(ax, np.concatenate([np.zeros(0), *(factor * trace.x for trace in traces)]))
    drawing.legend_within(ax, room)


def _coefficient_axis(ax: Axes, solution: Solution, factor: float) -> None:
    """Add a second scale to the friction panel: friction force divided by the normal load."""
    load = factor * solution.record.fingers[0][1].f_n
    right = ax.secondary_yaxis("right", functions=(partial(np.multiply, 1.0 / load), partial(np.multiply, load)))
    right.set_ylabel("coefficient", fontsize=drawing.FONT, color=drawing.GREY)
    right.tick_params(labelsize=drawing.FONT - 0.5, color="#999999", labelcolor=drawing.GREY)
    right.spines["right"].set_color("#999999")


def time_unit(runs: Sequence[Drawn]) -> tuple[float, str]:
    """Factor and unit of the time axis."""
    return drawing.engineering(max(max(_end_of(run), drawing.peak_of(run.t)) for run, _ in runs), "s")


def time_axis(axes: Sequence[Axes], runs: Sequence[Drawn], start: float, stop: float) -> None:
    """Set limits (s) and label of the time axis, and mark where a run stopped early."""
    factor, unit = time_unit(runs)
    stopped = [run for run, _ in runs if run.status not in (Status.SUCCESS, Status.ERROR_NOT_MET)]
    early = [end for end in map(_end_of, stopped) if start <= end <= stop]
    # Extend the axis to the right of the end, to show that the run stopped early.
    edge = factor * (start + ((stop - start) or 1.0) * (1.08 if early else 1.0))
    for ax in axes:
        ax.set_xlim(factor * start, edge)
        ax.ticklabel_format(axis="x", useOffset=False)
        for end in early:
            if len(runs) == 1:
                ax.axvspan(factor * end, edge, color="#EEEEEE", zorder=0.5)
            ax.axvline(factor * end, color=drawing.VERMILION, linewidth=1.2, linestyle=drawing.DASHES[3])
    if early:
        axes[0].text(
            factor * early[0], 0.98, "stopped ", transform=axes[0].get_xaxis_transform(), ha="right", va="top",
            fontsize=drawing.FONT - 0.5, color=drawing.VERMILION,
        )  # fmt: skip
    axes[-1].set_xlabel(f"Time [{unit}]", fontsize=drawing.FONT)


def about_all(runs: Sequence[Drawn]) -> str:
    """Circuit, method and error of several runs: first the facts that all runs share, then each run's own facts."""
    facts = []
    for s, _ in runs:
        area, force = (f"area: {s.area_mode}", f", {s.error.f_el:.2g} N") if s.gaps else ("", "")
        facts.append((
            heading(s.circuit), drive_text(s.circuit), f"{s.charge_law} charge law", area,
            f"method {s.method}, rtol {s.rtol:.2g}", f"error estimate {s.error.u_gap:.2g} V{force}",
        ))  # fmt: skip
    if len(runs) == 1:
        return " · ".join(filter(None, (*facts[0], "" if runs[0][0].success else runs[0][0].message)))
    alike = [len(set(same)) == 1 for same in zip(*facts, strict=True)]
    shared = [f for f, same in zip(facts[0], alike, strict=True) if f and same]
    own = []
    for (_, name), fact in zip(runs, facts, strict=True):
        # Leave out the first fact (title and changed parameters), because the run's label has the changes.
        differs = [f for f, same in zip(fact[1:], alike[1:], strict=True) if f and not same]
        own.append(f"{name}: {', '.join(differs)}" if differs else name)
    titles = {run.circuit.title for run, _ in runs}
    return " · ".join([*(titles - set(shared) if len(titles) == 1 else ()), *shared, *own])


_DRAWN = 1e-6  # Amplitudes below this fraction of the largest are not drawn: they are mostly the run's errors


def plot_spectrum(spectrum: Spectrum) -> Picture:
    """Amplitudes of the lines, or the density with its confidence interval, against frequency, on logarithmic axes."""
    figure, (ax,) = drawing.new_figure(1, height=3.4)
    signal = signal_of(spectrum.signal)
    color, unit = COLORS[signal.axis], spectrum.unit.replace("^2", "²")
    label = f"{signal.text.capitalize()} {spectrum.signal.partition(':')[2]}".rstrip()
    if spectrum.amplitude is not None:
        stems(ax, spectrum.frequency, spectrum.amplitude, _DRAWN * drawing.peak_of(spectrum.amplitude), color=color)
        drawing.dress(ax, f"{label}: amplitude [{unit}]", "Frequency [Hz]")
        small = f"Fourier integrals over a period; {spectrum.frequency.size} lines, {spectrum.resolution:.4g} Hz apart"
    else:
        f = spectrum.frequency
        density, lower, upper = map(np.asarray, (spectrum.density, spectrum.lower, spectrum.upper))
        some = (f > 0.0) & (density > 0.0)
        if some.any():
            ax.fill_between(f[some], lower[some], upper[some], color=color, alpha=0.25, linewidth=0.0)
            ax.loglog(f[some], density[some], color=color, linewidth=1.2)
        drawing.dress(ax, f"{label}: density [{unit}²/Hz]", "Frequency [Hz]")
        small = (
            f"Welch's density, {spectrum.resolution:.4g} Hz wide, with the interval that holds the true one with a "
            f"probability of 95 %, as of {spectrum.segments:.3g} independent segments"
        )
    if not ax.lines:
        ax.text(0.5, 0.5, "constant", transform=ax.transAxes, ha="center", fontsize=drawing.FONT)
    rms = spectrum.variance**0.5
    drawing.caption(figure, f"{small} · mean {spectrum.mean:.4g} {unit}, rms about it {rms:.4g} {unit}")
    return figure


def stems(
    ax: Axes, f: FloatArray, size: FloatArray, least: float, *, color: str, marker: str = "o", label: str = "_"
) -> None:
    """Draw the lines of a spectrum that are larger than `least`, from the bottom of a logarithmic panel."""
    some = size > least
    if some.any():
        ax.set(xscale="log", yscale="log")
        ax.plot(f[some], size[some], color=color, marker=marker, markersize=3.5, linestyle="none", label=label)
        ax.vlines(f[some], least, size[some], color=color, linewidth=1.0)
        ax.set_ylim(bottom=least)


def plot_phasor(results: Sequence[PhasorSolution], circuit: Circuit) -> Picture:
    """Gain, phase, mean force and area against frequency, with a line per amplitude; without a GAP the nodes."""
    one, nodes = results[0], results[0].shown_nodes
    low, high = float(one.frequency.min()), float(one.frequency.max())
    figure, axes = drawing.new_figure(2, 1 if nodes else 2, height=4.6, sharex=True)
    factor, unit = drawing.engineering(drawing.peak_of(np.nan_to_num([r.f_el_mean for r in results])), "N", 0.05)
    for number, r in enumerate(results):
        order, v = np.argsort(r.frequency), np.asarray(r.v_nodes)
        style: dict[str, Any] = {"label": nodes} if nodes else {
            "label": f"{r.amplitude:.4g} V", "linestyle": ("-", "--", ":", "-.")[number % 4], "markersize": 3.5,
        }  # fmt: skip
        panels: list[tuple[FloatArray, str, str | None]] = [
            (np.abs(r.gain), "|gap voltage / source|", drawing.BLUE),
            (np.degrees(np.angle(r.gain)), "Lead of the gap voltage [°]", drawing.PURPLE),
            (factor * r.f_el_mean, f"Mean electroadhesive force [{unit}]", drawing.VERMILION),
            (1e6 * r.area, "Ridge area [mm²]", drawing.GREEN),
        ]
        if nodes:
            panels = [(np.abs(v), "Node voltage [V]", None), (np.degrees(np.angle(v)), "Phase [°]", None)]
        for ax, (values, label, color) in zip(axes, panels, strict=True):
            marker = "o" if order.size < 12 else ""
            ax.plot(r.frequency[order], values[order], color=color, linewidth=1.5, marker=marker, **style)
            drawing.dress(ax, label, "Frequency [Hz]" if ax in axes[-len(axes) // 2 :] else "", xscale="log")
    how = f"source amplitude {f'{one.amplitude:.4g} V' if np.isfinite(one.amplitude) else 'no fundamental'}"
    how = one.drive if nodes else how if len(results) == 1 else "several source amplitudes"
    if nodes:
        if np.all(np.abs(np.asarray(one.v_nodes)).max(axis=0) > 0.0):
            axes[0].set_yscale("log")
        axes[0].legend(fontsize=drawing.FONT, frameon=False)
    else:
        for ax in axes:
            ax.set_xlim(*((low, high) if low < high else (0.1 * low, 10.0 * low)))
            ax.ticklabel_format(axis="y", useOffset=False)
        drawing.from_zero(axes[0])
        drawing.from_zero(axes[2])
        drawing.flat(axes[3], 1e6 * np.concatenate([r.area for r in results]))
    if not nodes and not np.isfinite(one.amplitude):
        told = "the source has no fundamental"
        axes[2].text(0.5, 0.5, told, transform=axes[2].transAxes, ha="center", fontsize=drawing.FONT)
    if len(results) > 1:
        axes[0].legend(fontsize=drawing.FONT, frameon=False, loc="lower right", handlelength=3.0)
    outside = ((low, min(high, SKIN_BAND[0])), (max(low, SKIN_BAND[1]), high)) if circuit.by_device("SKIN") else ()
    spans = [(a, b) for a, b in outside if b > a]
    for (a, b), ax in itertools.product(spans, axes):
        ax.axvspan(a, b, color="#EEEEEE", zorder=0.5)
    shaded = "shaded: outside the skin data of Eqs. 18 and 19" if spans else ""
    drawing.caption(figure, " · ".join(p for p in (heading(circuit), how, shaded) if p))
    return figure


def plot_impedance(results: Mapping[str, PhasorSolution]) -> Picture:
    """Bode and Nyquist pictures of the impedances of named sweeps."""
    figure, (size, phase, plane, unused) = drawing.new_figure(2, 2, height=4.9)
    # The plane is as wide as the two others are side by side.
    plane.set_subplotspec(unused.get_gridspec()[1, :])  # type: ignore[index]
    unused.remove()
    impedances = [np.asarray(r.impedance) for r in results.values()]
    factor, unit = drawing.engineering(max(map(drawing.peak_of, map(np.abs, impedances))), "Ω", 0.5)
    for number, ((name, r), z) in enumerate(zip(results.items(), impedances, strict=True)):
        order = np.argsort(r.frequency)
        f, z = r.frequency[order], z[order]
        style: dict[str, Any] = {"color": drawing.CYCLE[number % 6], "linestyle": drawing.DASHES[number % 4]}
        style |= {"linewidth": 1.5, "label": name}
        size.plot(f, factor * np.abs(z), **style)
        phase.plot(f, np.degrees(np.angle(z)), **style)
        plane.plot(factor * z.real, -factor * z.imag, **style)
        # Where the whole decades lie on the curve.
        log, decades = np.log10(f), np.arange(np.ceil(np.log10(f[0]) - 1e-9), np.log10(f[-1]) + 1e-9)
        x, y = (factor * np.interp(decades, log, part) for part in (z.real, -z.imag))
        plane.plot(x, y, "o", color=style["color"], markersize=3.5)
        for at in zip(decades.tolist(), x.tolist(), y.tolist(), strict=True) if number == 0 else ():
            told: dict[str, Any] = {"fontsize": drawing.SMALL, "xytext": (4, 3), "textcoords": "offset points"}
            plane.annotate(format_si(10.0 ** at[0], "Hz"), at[1:], **told)
    drawing.dress(size, f"|Z| [{unit}]", "Frequency [Hz]", xscale="log", yscale="log")
    drawing.dress(phase, "Phase of Z [°]", "Frequency [Hz]", xscale="log")
    drawing.dress(plane, f"−Im Z [{unit}]", f"Re Z [{unit}]")
    plane.set_aspect("equal", adjustable="box")
    if len(results) > 1:
        drawing.legend_above(size, 2)
    drawing.caption(figure, heading(next(iter(results.values())).circuit))
    return figure
