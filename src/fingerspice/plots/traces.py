"""Pictures of signals against time (runs together, in a window, as envelopes), of spectra and of phasors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from difflib import get_close_matches
from typing import TYPE_CHECKING, Any

import numpy as np

from fingerspice.base.arrays import FloatArray, real_numbers
from fingerspice.base.errors import InputError
from fingerspice.circuit.describe import changes_text, heading
from fingerspice.physics.materials import SKIN_BAND
from fingerspice.plots import drawing, lines
from fingerspice.plots.lines import Drawn
from fingerspice.results.record import SIGNALS, Signal, signal_of
from fingerspice.waveforms.waveform import require

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from fingerspice.circuit.circuit import Circuit
    from fingerspice.plots.picture import Picture
    from fingerspice.results.solution import Solution
    from fingerspice.results.spectrum import PhasorSolution, Spectrum

#: Up to MOST_DRAWN oscillations are drawn as lines. More are drawn as an envelope, with an enlargement of the last
#: ZOOMED oscillations whose swing is at least the fraction _LOUD of the largest swing.
MOST_DRAWN, ZOOMED, _LOUD = 30, 4, 0.7
#: Smallest number of outputs in an oscillation for which its shape is visible.
_FEWEST = 12


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
    marks, heights = _turns(runs, panels, start, stop)
    dense = marks.size > 2 * MOST_DRAWN
    zoomed = _zoom(marks, heights, start, stop)
    shares = [1.5 if signal.axis == "Voltage" else 1.1 for signal, _ in panels]
    widths = [1.0] if zoomed is None else [1.5, 1.0]
    figure, axes = drawing.new_figure(
        len(panels), len(widths), height=max(3.4, 0.7 + 1.15 * sum(shares)), height_ratios=shares, width_ratios=widths,
        sharex="col", sharey="row",
    )  # fmt: skip
    left, right = axes[:: len(widths)], [] if zoomed is None else axes[1::2]
    for row, (signal, keys) in enumerate(panels):
        traces = lines.traces_of(runs, keys)
        factor, unit = lines.scale_of(signal, traces, start, stop)
        for trace in traces:
            lines.draw_line(left[row], trace, factor, start, stop, runs, envelope=marks if dense else None)
            if zoomed is not None:
                lines.draw_line(right[row], trace._replace(label="_"), factor, *zoomed, runs)
        if keys == ["f_el"] and len(traces) == 1:
            lines.draw_mean(left[row], traces[0], factor, unit, told=not right)
            if right:
                lines.draw_mean(right[row], traces[0], factor, unit)
                drawing.legend_above(right[row], 1)
        room = lines.HALF if right else lines.PAGE
        lines.finish_panel(left[row], signal, unit, [factor * t.x for t in traces], room)
        if keys == ["f_t"] and len(traces) == 1:
            lines.coefficient_axis((right or left)[row], traces[0].solution, factor)
    lines.time_axis(left, runs, start, stop)
    small = lines.about_all(runs)
    if zoomed is not None:
        lines.time_axis(right, runs, *zoomed)
        for ax in right:
            # Times in an enlargement have many digits, so that only three tick labels have room.
            ax.locator_params(axis="x", nbins=3)
        whole = f"envelope of {marks.size // 2} oscillations" if dense else "the whole run"
        part = f"the last {ZOOMED}" if dense and marks[-1] <= zoomed[1] else "enlarged"
        left[-1].set_xlabel(f"{left[-1].get_xlabel()}: {whole}", fontsize=drawing.FONT)
        right[-1].set_xlabel(f"{right[-1].get_xlabel()}: {part}", fontsize=drawing.FONT)
        t = solution.t
        if dense and np.count_nonzero((t >= zoomed[0]) & (t <= zoomed[1])) < _FEWEST * ZOOMED:
            small += f" · fewer than {_FEWEST} outputs an oscillation: their shape needs a shorter TSTEP"
    drawing.caption(figure, small, drawing.GREY if all(run.solution.success for run in runs) else drawing.VERMILION)
    figure.align_ylabels(left)
    return figure


def _runs(solution: Solution, others: Any) -> list[Drawn]:
    """Every run with its name: the given name, or the facts in which the run differs from the other runs."""
    from fingerspice.results.solution import Solution

    named = isinstance(others, Mapping)
    rest = [*(others.values() if named else others if isinstance(others, Sequence) else [others])]
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


def _panels(runs: list[Drawn], signals: str | Sequence[str] | None) -> list[tuple[Signal, list[str]]]:
    """Panels from top to bottom, each with its first signal and the names of all."""
    every = [run.solution.record for run in runs]
    if signals is None:
        inside = "u_layer" if any(s.layers for s in every) else "v"
        contact = any(s.gaps for s in every)
        signals = ["u_source", *(("u_gap", "f_el", "area", "f_t") if contact else (inside,))]
    asked = [signals] if isinstance(signals, str) else list(signals)
    known = {name: None for s in every for key in SIGNALS for name in (key, *s.names(key)) if s.names(key)}
    panels: list[tuple[Signal, list[str]]] = []
    for name in asked:
        if name not in known:
            near = get_close_matches(str(name), known, 1, 0.0)
            allowed = ", ".join([*(name for name in known if ":" not in name), "and name:element"])
            raise InputError(f"unknown signal {name!r}; nearest: {near[0]!r}; allowed: {allowed}")
        signal = signal_of(name)
        same = [keys for other, keys in panels if other.axis == signal.axis]
        if same:
            same[0].append(name)
        else:
            panels.append((signal, [name]))
    require(bool(panels), "signals", "empty", "one name or more")
    return panels


def _window(runs: list[Drawn], window: tuple[float, float] | None) -> tuple[float, float]:
    """Start and end of the drawn interval, s."""
    times = [run.solution.t for run in runs if run.solution.t.size]
    first, last = min((float(t[0]) for t in times), default=0.0), max(lines.end_of(run.solution) for run in runs)
    if window is None:
        return first, last
    ends = real_numbers("window", window, "two times in s, (start, stop)")
    require(ends.shape == (2,), "window", repr(window), "two times in s, (start, stop)")
    start, stop = max(float(ends[0]), first), min(float(ends[1]), last)
    shown = any(np.count_nonzero((t >= start) & (t <= stop)) >= 2 for t in times)
    inside = f"ascending, with two outputs or more between them, from {first:g} to {last:g} s"
    require(start < stop and shown, "window", f"{ends[0]:g} to {ends[1]:g} s", inside)
    return start, stop


def _turns(
    runs: list[Drawn], panels: list[tuple[Signal, list[str]]], start: float, stop: float
) -> tuple[FloatArray, FloatArray]:
    """Times (s) and values of the turning points, two per oscillation, of the first panel's most oscillating signal."""
    best = np.zeros(0), np.zeros(0)
    for run in runs:
        t = run.solution.t
        kept = (t >= start) & (t <= stop)
        for key in panels[0][1]:
            for x in lines.columns_of(run.solution, key).values():
                step = np.diff(x[kept])
                # Turning points of round-off are not counted.
                steep = np.flatnonzero(np.abs(step) > 1e-6 * drawing.peak_of(x))
                turns = steep[1:][np.signbit(step[steep[1:]]) != np.signbit(step[steep[:-1]])]
                if turns.size > best[0].size:
                    best = t[kept][turns], x[kept][turns]
    return best


def _zoom(marks: FloatArray, heights: FloatArray, start: float, stop: float) -> tuple[float, float] | None:
    """Start and end (s) of the interval that is enlarged in a second column; None if no enlargement is needed.

    With many oscillations, the interval holds the last ones that are not small. With few oscillations in a small part
    of the time, such as a click, it holds all of them.
    """
    length = 2 * ZOOMED
    if marks.size > 2 * MOST_DRAWN:
        swing = np.lib.stride_tricks.sliding_window_view(np.abs(np.diff(heights)), length).max(axis=1)
        place = int(np.flatnonzero(swing >= _LOUD * swing.max())[-1])
        first, last = float(marks[place]), float(marks[place + length])
        # Leave out a constant part that may follow the oscillations.
        return first, min(stop, last + 0.1 * (last - first))
    if marks.size < 2 or marks[-1] - marks[0] > (stop - start) / MOST_DRAWN:
        return None
    around = float(marks[-1] - marks[0])
    return max(start, float(marks[0]) - around), min(stop, float(marks[-1]) + around)


#: Amplitudes below this fraction of the largest are not drawn: they are mostly numerical errors of the run.
_DRAWN = 1e-6


def plot_spectrum(spectrum: Spectrum) -> Picture:
    """Amplitudes of the lines, or the density with its confidence interval, against frequency, on logarithmic axes."""
    figure, (ax,) = drawing.new_figure(1, height=3.4)
    signal = signal_of(spectrum.signal)
    color, unit = lines.COLORS[signal.axis], spectrum.unit.replace("^2", "²")
    label = f"{signal.text.capitalize()} {spectrum.signal.partition(':')[2]}".rstrip()
    if spectrum.amplitude is not None:
        least = _DRAWN * drawing.peak_of(spectrum.amplitude)
        stems(ax, spectrum.frequency, spectrum.amplitude, least, color=color)
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
    if results[0].nodes:
        return _plot_nodes(results[0], circuit)
    figure, axes = drawing.new_figure(2, 2, height=4.6, sharex=True)
    forces = np.concatenate([r.f_el_mean for r in results])
    factor, unit = drawing.engineering(drawing.peak_of(forces[np.isfinite(forces)]), "N", 0.05)
    for number, result in enumerate(results):
        f = np.sort(result.frequency)
        dashes, name = ("-", "--", ":", "-.")[number % 4], f"{result.amplitude:.4g} V"
        for ax, values, label, color in (
            (axes[0], np.abs(result.gain), "|gap voltage / source|", drawing.BLUE),
            (axes[1], np.degrees(np.angle(result.gain)), "Lead of the gap voltage [°]", drawing.PURPLE),
            (axes[2], factor * result.f_el_mean, f"Mean electroadhesive force [{unit}]", drawing.VERMILION),
            (axes[3], 1e6 * result.area, "Ridge area [mm²]", drawing.GREEN),
        ):
            _against_frequency(ax, result, values, label, color=color, linestyle=dashes, label=name, markersize=3.5)
            ax.set_xlim(*((f[0], f[-1]) if f[0] < f[-1] else (0.1 * f[0], 10.0 * f[0])))
            ax.ticklabel_format(axis="y", useOffset=False)
    for ax in (axes[0], axes[2]):
        drawing.from_zero(ax)
    amplitude = results[0].amplitude
    if not np.isfinite(amplitude):
        told = "the source has no fundamental"
        axes[2].text(0.5, 0.5, told, transform=axes[2].transAxes, ha="center", fontsize=drawing.FONT)
    if len(results) > 1:
        axes[0].legend(fontsize=drawing.FONT, frameon=False, loc="lower right", handlelength=3.0)
    drawing.flat(axes[3], 1e6 * np.concatenate([r.area for r in results]))
    drive = f"{amplitude:.4g} V" if np.isfinite(amplitude) else "no fundamental"
    how = f"source amplitude {drive}" if len(results) == 1 else "several source amplitudes"
    return _finished(figure, axes, 2, results[0], circuit, how)


def _plot_nodes(result: PhasorSolution, circuit: Circuit) -> Picture:
    """Amplitude and phase of every node's voltage against frequency."""
    v = np.asarray(result.v_nodes)
    figure, axes = drawing.new_figure(2, 1, height=4.6, sharex=True)
    _against_frequency(axes[0], result, np.abs(v), "Node voltage [V]", label=result.nodes)
    _against_frequency(axes[1], result, np.degrees(np.angle(v)), "Phase [°]")
    if np.all(np.abs(v).max(axis=0) > 0.0):
        axes[0].set_yscale("log")
    axes[0].legend(fontsize=drawing.FONT, frameon=False)
    return _finished(figure, axes, 1, result, circuit, result.drive)


def _against_frequency(ax: Axes, result: PhasorSolution, values: FloatArray, y_label: str, **style: Any) -> None:
    order = np.argsort(result.frequency)
    marker = "o" if order.size < 12 else ""
    ax.plot(result.frequency[order], values[order], linewidth=1.5, marker=marker, **style)
    drawing.dress(ax, y_label)
    ax.set_xscale("log")


def _finished(
    figure: Picture, axes: Sequence[Axes], columns: int, result: PhasorSolution, circuit: Circuit, how: str
) -> Picture:
    """The picture with its caption, the lowest row's label, and frequencies outside the data of SKIN shaded."""
    f = result.frequency
    low, high = f.min(), f.max()
    outside = ((low, min(high, SKIN_BAND[0])), (max(low, SKIN_BAND[1]), high)) if circuit.by_device("SKIN") else ()
    spans = [(a, b) for a, b in outside if b > a]
    for ax in axes:
        for a, b in spans:
            ax.axvspan(a, b, color="#EEEEEE", zorder=0.5)
    for ax in axes[-columns:]:
        ax.set_xlabel("Frequency [Hz]", fontsize=drawing.FONT)
    shaded = "shaded: outside the skin data of Eqs. 18 and 19" if spans else ""
    drawing.caption(figure, " · ".join(p for p in (heading(circuit), how, shaded) if p))
    return figure
