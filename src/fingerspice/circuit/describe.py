"""A circuit in words and its digests, checks of a call's arguments, and warnings before a run.

What is said about a skin's data rests on the source's spectrum: its energy outside their band, and the error of data
held at one frequency.
"""

from __future__ import annotations

import dataclasses
import hashlib
import math
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from functools import lru_cache
from typing import Any

import numpy as np

from fingerspice.base.arrays import FloatArray, real_number
from fingerspice.base.errors import FingerspiceWarning, InputError
from fingerspice.base.pages import Page, Table
from fingerspice.base.units import format_si
from fingerspice.circuit.circuit import Circuit, Element
from fingerspice.circuit.devices import MEANINGS, shown, unusual_of_changed
from fingerspice.circuit.network import network_of, with_skin_held
from fingerspice.circuit.statespace import contact_of, driving, driving_sources, shared
from fingerspice.physics.contact import LawContact
from fingerspice.physics.materials import SKIN_BAND
from fingerspice.physics.phasor import layer_gains
from fingerspice.waveforms.periodic import PWL, Burst, Repeat
from fingerspice.waveforms.samples import Samples, as_samples
from fingerspice.waveforms.sampling import Function
from fingerspice.waveforms.waveform import DC, OFF, Product, Sum, Waveform, require


def remembering(circuit: Circuit, name: str, values: Mapping[str, Any]) -> Circuit:
    """The circuit, which remembers that the set of that name gave these values, by path.

    An earlier set no longer answers for the values that this one replaces.
    """
    given = {path.lower() for path in values}
    sets = {one: {p: v for p, v in old.items() if p.lower() not in given} for one, old in circuit.sets.items()}
    own = {**sets.pop(name, {}), **values}
    return circuit._with(sets={**{one: old for one, old in sets.items() if old}, name: own})


def in_force(circuit: Circuit) -> dict[str, tuple[dict[str, Any], tuple[str, ...]]]:
    """The sets applied to a circuit: of each the values still in force by path, and the paths changed since."""
    now: dict[str, Any] = {path.lower(): p.value for path, p in circuit.parameters.items()}
    now |= {e.name.lower(): e.waveform for e in circuit.elements if e.waveform is not None}
    found = {}
    for name, values in circuit.sets.items():
        # The elements of a run read from a file may be unknown; its values are then those that the file names.
        kept = {path: x for path, x in values.items() if now.get(path.lower(), None if circuit.elements else x) == x}
        found[name] = kept, tuple(path for path in values if path not in kept)
    return found


def law_digest(element: Element) -> str:
    """What tells a GAP's contact law from others, of the same name too; empty for the paper's and other devices."""
    contact = contact_of(element) if element.law is not None else None
    return f"{contact.law} {contact.digest}" if isinstance(contact, LawContact) else ""


def digests(circuit: Circuit) -> tuple[str, str]:
    """SHA-256 of a circuit's elements, initial voltages and step control, and of its sources' waveforms."""
    elements, sources, tran = hashlib.sha256(), hashlib.sha256(), circuit.tran
    for element in circuit.elements:
        wave = element.waveform
        elements.update(repr((element.name, element.device, element.nodes, dict(element.values))).encode())
        elements.update((law_digest(element) or " ".join(element.control)).encode())
        sources.update(repr((element.name, wave.digest() if isinstance(wave, Samples) else wave)).encode())
    elements.update(repr((dict(circuit.initial), tran and (tran.max_step, tran.uic))).encode())
    return elements.hexdigest(), sources.hexdigest()


_MOST, _MOST_ELEMENTS = 8, 25  # Most changes or sources that a line names, and most elements that a page lists.


def meaning_of(circuit: Circuit, path: str) -> str:
    """A parameter in words, as in ``load of Xgap``."""
    name, _, parameter = path.rpartition(".")
    known = MEANINGS | {p.name: p.meaning for p in circuit[name].spec.parameters}
    return f"{known.get(parameter, parameter)} of {name}"


def waveform_text(waveform: Waveform, unit: str = "V") -> str:
    """A waveform with its figures, as in ``Square(200 V, 100 Hz)``; `unit` is A for a current source."""
    if isinstance(waveform, DC):
        return f"DC {format_si(waveform.level, unit)}"
    if isinstance(waveform, Sum | Product):
        sign = " + " if isinstance(waveform, Sum) else " * "
        return f"({sign.join(waveform_text(part, unit) for part in waveform.parts)})"
    if isinstance(waveform, Function):
        return f"function {getattr(waveform.function, '__name__', 'of time')}"
    said = [f"{len(waveform.times)} points"] if isinstance(waveform, PWL) else []
    said += [f"{waveform.count} values"] if isinstance(waveform, Samples) else []
    said += [waveform_text(waveform.waveform, unit)] if isinstance(waveform, Burst | Repeat) else []
    for field in dataclasses.fields(waveform):  # type: ignore[arg-type]
        value = getattr(waveform, field.name)
        if field.name in waveform.units and value != field.default:
            # A required figure is known by its position; one that has a default needs its name.
            name = "" if field.default is dataclasses.MISSING else f"{field.name} "
            said.append(name + shown(value, waveform.units[field.name].replace("V", unit)))
    return f"{type(waveform).__name__}({', '.join(said)})"


def _own_text(source: Element) -> str:
    """The waveform of a source, in volt or ampere; empty for another element."""
    return "" if source.waveform is None else waveform_text(source.waveform, "A" if source.device == "I" else "V")


def drive_text(circuit: Circuit) -> str:
    """Every source that is not 0 with its waveform: ``Vdrive: Sine(200 V, 100 Hz)``.

    Sources that were replaced are left out, since `changes_text` lists them.
    """
    kept = {path.lower() for values, _ in in_force(circuit).values() for path in values}
    replaced = {path.lower() for path in circuit.overrides} - kept
    on = (e for e in driving(circuit) if e.waveform not in (None, OFF) and e.name.lower() not in replaced)
    return _joined([f"{e.name}: {_own_text(e)}" for e in on])


def changes_text(circuit: Circuit) -> str:
    """Changes made after the deck was read, with the present values: ``Xgap.d = 5 um``; empty without changes.

    Values that a set of parameters gave, and that still hold, are named by the set: ``set moist``.
    """
    sets = {name: kept for name, (kept, _) in in_force(circuit).items() if kept}
    now = {e.name.lower(): f"{e.name} = {_own_text(e)}" for e in circuit.elements if e.waveform is not None}
    now |= {path.lower(): f"{path} = {shown(p.value, p.unit)}" for path, p in circuit.parameters.items()}
    # A path may have been changed twice, in two spellings; of one that is unknown the last text counts.
    last = {path.lower(): (path, text) for path, text in circuit.overrides.items()}
    for key in last.keys() - now.keys():
        path, text = last[key]
        kind = text.partition("(")[0]
        short = text if len(text) <= 40 else f"{kind}(...)" if kind.isidentifier() else f"{text[:36]} ..."
        now[key] = f"{path} = {short}"
    given = {path.lower() for kept in sets.values() for path in kept}
    return _joined([*(f"set {name}" for name in sets), *(now[path] for path in last if path not in given)])


def heading(circuit: Circuit) -> str:
    """The deck's title, and the changes made after it was read."""
    changed = changes_text(circuit)
    return f"{circuit.title} (changed: {changed})" if changed else circuit.title


def head_lines(circuit: Circuit) -> list[str]:
    """Lines at the top of a report: the heading, and the sources that are not 0, if there are any."""
    return [heading(circuit), *filter(None, [drive_text(circuit)])]


def circuit_page(circuit: Circuit) -> Page:
    """The elements of a circuit and the analyses of its deck."""
    rows = []
    for e in circuit.elements[:_MOST_ELEMENTS]:
        text, nodes = values_text(e), " ".join((*e.node_names, *e.control))
        rows.append((e.name, e.device, nodes, text if len(text) <= 96 else f"{text[:92]} ..."))
    table = Table(("", "device", "nodes", "values, in the units of the netlist"), rows, left=4)
    more, tran, ac = len(circuit.elements) - len(rows), circuit.tran, circuit.ac
    lines: list[str | Table] = [heading(circuit), "", table, *([f"... and {more} more elements"] if more else []), ""]
    if tran is not None:
        since = f" from {format_si(tran.start, 's')} on" if tran.start else ""
        lines.append(f".tran: {format_si(tran.stop, 's')}, an output every {format_si(tran.step, 's')}{since}")
    if ac is not None:
        lines.append(f".ac: {format_si(ac.start, 'Hz')} to {format_si(ac.stop, 'Hz')}")
    return Page([*lines, f"charge law: {circuit.charge_law or 'local (the deck names none)'}"])


def values_text(element: Element) -> str:
    """Values of an element in the units of the netlist, without those that are infinite, and its waveform."""
    said = [] if element.law is None else [f"law={element.law.name}"]
    for name, value in element.values.items():
        text = f"{value:.4g}" if 0.01 <= abs(value) < 1e4 else format_si(value, "").replace(" ", "").replace("M", "meg")
        said += [f"{name}={text}"] if math.isfinite(value) else []
    return " ".join(said if element.waveform is None else [*said, _own_text(element)])


def _joined(said: list[str]) -> str:
    return ", ".join([*said[:_MOST], *([f"and {len(said) - _MOST} more"] if len(said) > _MOST else [])])


#: A waveform, a constant (V, or A of a current source), or a function of time (s).
Source = Waveform | float | Callable[[float], float]
Sources = Mapping[str, Source] | Source
Parameters = Mapping[str, float]


def overridden(circuit: Circuit, sources: Sources | None = None, parameters: Parameters | None = None) -> Circuit:
    """The circuit with the sources and parameters given in a call, with warnings about sources that stay on.

    For a circuit with one source, its waveform, constant or function alone is enough; `parameters` is as in
    `Circuit.replace`.
    """
    require_circuit(circuit)
    if parameters:
        given = f"a {type(parameters).__name__}"
        require(isinstance(parameters, Mapping), "parameters", given, "a mapping such as {'Xgap.d': 3e-6}")
        circuit = circuit.replace(parameters)
    if sources is None or (isinstance(sources, Mapping) and not sources):
        return circuit
    driving = driving_sources(circuit)
    if not isinstance(sources, Mapping):
        has = f"one source, and the circuit has {', '.join(e.name for e in driving) or 'none'}"
        allowed = f"a mapping such as {{{driving[0].name!r}: ...}}" if driving else "no sources"
        require(len(driving) == 1, "sources", has, allowed)
        sources = {driving[0].name: sources}
    for name in sources:
        if not isinstance(name, str):
            raise InputError(f"sources names {name!r}, a {type(name).__name__}; allowed: names of V or I elements")
        if circuit[name].device not in "VI":
            raise InputError(f"sources names {name!r}, which is a {circuit[name].device}; allowed: a V or I element")
    named = {name.lower() for name in sources}
    on = [e.name for e in driving if e.name.lower() not in named and e.waveform not in (None, OFF)]
    if on and any(e.name.lower() in named for e in driving):
        only, stay = ", ".join(sources), ", ".join(on)
        text = f"sources names {only} only: {stay} stays on, as in the deck; 0 would switch it off"
        warnings.warn(text, FingerspiceWarning, stacklevel=3)
        circuit = dataclasses.replace(circuit, warnings=(*circuit.warnings, text))
    return circuit.replace({circuit[name].name: value for name, value in sources.items()})


def own_path(circuit: Circuit, path: Any) -> str:
    """A path in the circuit's own spelling; ``source.`` stands for the only source."""
    if isinstance(path, str) and path.lower().startswith("source."):
        on = driving_sources(circuit)
        if not any(e.name.lower() == "source" for e in circuit.elements) and len(on) == 1:
            path = f"{on[0].name}.{path.partition('.')[2]}"
    known = {name.lower(): name for name in circuit.parameters}
    if not isinstance(path, str) or path.lower() not in known:
        # The circuit raises the error about an unknown path, which gives the nearest name.
        circuit.varied({path: 1.0})
        raise InputError(f"{path!r} is no parameter that takes numbers; allowed: a path such as 'Xgap.d'")
    return known[path.lower()]


def require_circuit(circuit: Any) -> None:
    """Refuse anything but a circuit, and say how a circuit is made."""
    allowed = "a Circuit, such as fs.read_netlist('deck.cir') gives"
    require(isinstance(circuit, Circuit), "the circuit", f"a {type(circuit).__name__}", allowed)


def area_given(area: Any) -> str | float:
    """An area as one of the model's modes or a positive number, m^2."""
    if isinstance(area, str):
        require(area in ("coupled", "mean", "frozen"), "area", repr(area), "'coupled', 'mean', 'frozen' or m^2")
        return area
    number = real_number("area", area, "'coupled', 'mean', 'frozen' or a number in m^2")
    require(math.isfinite(number) and number > 0.0, "area", f"{number:g} m^2", "a positive area in m^2")
    return number


# Largest relative difference of frequencies that are the same, and smallest one of the mean force that is given as a
# number; and the words by which a warning about a SKIN begins.
_SAME, _LITTLE, _TAKES = 1e-9, 0.005, "takes its data at f ="
# Smallest number of points that make a PWL a recording, which is meant to be run to its end and not to be a step in a
# longer run; and the smallest fraction of a run that a recording fills without a warning.
_RECORDED, _FILLED = 100, 0.01
# Times (s) from `_CLOCK` on are those of a clock (this is a day in 1973, counted from 1970); times beyond the end of a
# run by a factor of `_OTHER_UNIT` or more are probably in another unit.
_CLOCK, _OTHER_UNIT = 1e8, 20.0
# Largest number of samples of a spectrum; and of periods over which a skin's data at one frequency are judged.
_MOST_SAMPLES, _PERIODS = 2**17, 16
# Number of pieces that represent a long run of a source without period; frequencies of gains, Hz; and Hann's windows.
_PIECES, _GRID = 4, np.geomspace(*SKIN_BAND, 49)
_window = lru_cache(maxsize=8)(np.hanning)
# Least length (s) of a piece of a recording, two periods of the lowest frequency of the skin's data; and the number of
# samples up to which straight lines between them are looked at instead.
_LEAST, _FEW = 2.0 / SKIN_BAND[0], 4096
NOTABLE = 0.01  # A source is in a band if no more than this fraction of its energy is outside.
# The area's harmonics also drive currents through the skin. Skin data held at the fundamental cause an additional
# relative error of at most COUPLING times the relative change of the area; 0.004 was found for a change of a quarter.
COUPLING = 0.05


def circuit_warnings(circuit: Circuit, t_stop: float | None) -> tuple[str, ...]:
    """Warnings about directives without effect, and about a SKIN whose single frequency does not suit its source.

    The run is taken to end at `t_stop` (s), or at the deck's own end where that is None.
    """
    stop = t_stop or (math.nan if circuit.tran is None else circuit.tran.stop)
    return circuit.remember(("notices", stop), lambda: (*directive_warnings(circuit), *_skin_warnings(circuit, stop)))


def directive_warnings(circuit: Circuit) -> tuple[str, ...]:
    """Warnings about directives without effect, but for those of ngspice's options."""
    stepped = [".step has no effect in one run: fingerspice run and fs.run_steps take it"] if circuit.steps else []
    return (*(f"{name} has no effect here" for name in circuit.unused if not name.startswith(".options")), *stepped)


def option_notes(circuit: Circuit) -> tuple[str, ...]:
    """What a result says of the deck's options without effect, of which nobody is warned: decks have them by habit."""
    names = ", ".join(name.removeprefix(".options ") for name in circuit.unused if name.startswith(".options "))
    return (f".options {names}: of no effect here, where rtol alone sets the error",) if names else ()


def course_warnings(circuit: Circuit, start: float, stop: float, by_deck: bool) -> Iterator[str]:
    """Warnings about sources that miss the run from `start` to `stop` (s), fill little of it, or are cut off by it.

    A recording is cut off without a warning unless the deck's own TSTOP does it, as `by_deck` says.
    """
    for name, wave in ((e.name, e.waveform) for e in driving(circuit) if e.waveform is not None):
        (first, last), recording = wave.course, as_samples(wave)
        # Of a recording or table; 0 of other waveforms.
        table = len(wave.times) if isinstance(wave, PWL) and wave.repeat is None else 0
        count = table if recording is None else recording.count
        if (count > 1 and last < start == 0.0) or stop <= first < math.inf:
            until = f" to {last:g} s" if last < math.inf else " on"
            where = f"the run from {start:g} s to {stop:g} s, in which it stays at {wave.value(stop, 'left'):.4g}"
            slip = time_slip(first, last, stop)
            yield f"{name} changes from {first:g} s{until} only, and covers nothing of {where}{slip}"
        elif count >= _RECORDED and last - first < _FILLED * (stop - start):
            share = f"{100.0 * (last - first) / stop:.2g} % of the run to {stop:g} s, and constant in the rest"
            unit = "its times, or its rate, are probably in another unit"
            yield f"{name}: the recording, from {first:g} s to {last:g} s, is {share}; {unit}"
        elif by_deck and count >= _RECORDED and last > stop + (last - first) / (count - 1):
            ends = f"{name}: the recording ends at {last:g} s, and the run at the deck's TSTOP = {stop:g} s"
            yield f"{ends}; --stop {last:.9g} takes all of it (in Python t_stop={last:.9g})"


def time_slip(first: float, last: float, stop: float) -> str:
    """End of a message about times from `first` to `last` (s) that are not in a run to `stop`: the likely slip."""
    if first >= _CLOCK:
        return "; its times are probably a clock's: subtract the first of them"
    beyond = (first if first > stop else last) / stop
    if _OTHER_UNIT <= beyond < math.inf:
        unit = "ms" if beyond <= 1e3 * (1.0 + 1e-9) else "ms or us"
        return f"; its times are probably in {unit}, and count as s here"
    return f"; a run to {last:g} s contains it" if stop < last < math.inf else ""


def scenes_warnings(
    circuit: Circuit, t_stop: float | None, scenes: Mapping[str, FloatArray], skin: str = "own"
) -> Iterator[str]:
    """Warnings about several scenes: unusual values, sources that miss the run, a SKIN whose single frequency is wrong.

    `t_stop` is as in `circuit_warnings`, `skin` as in `batch`, and `scenes` has the values (n,) of each parameter.
    """
    for path, values in scenes.items():
        for end in sorted({values.min(), values.max()}):
            with suppress(InputError):  # A scene that cannot be run says so itself.
                yield from unusual_of_changed(circuit, circuit.varied({path: float(end)}))[1]
    stop = t_stop or (math.nan if circuit.tran is None else circuit.tran.stop)
    if not any(path.startswith(f"{e.name}.") for e in driving(circuit) for path in scenes):
        yield from course_warnings(circuit, 0.0, stop, t_stop is None)
    if skin != "own":
        return

    def span(f: FloatArray) -> str:
        return " to ".join(f"{end:g}" for end in sorted({float(f.min()), float(f.max())})) + " Hz"

    own = [f"{e.name}.f" for e in circuit.by_device("SKIN")]
    on = driving_sources(circuit) if own else []
    clocks = [f"{e.name}.{name}" for e in on for name in ("frequency", "carrier")]
    if not any(path in scenes for path in (*own, *clocks)):
        yield from (text for text in circuit_warnings(circuit, t_stop) if _TAKES in text)
    elif len(on) == 1 and on[0].waveform is not None and on[0].waveform.fundamental is not None:
        fixed = np.array(on[0].waveform.fundamental.frequency)
        at = next((scenes[path] for path in clocks if path in scenes), fixed)
        for path in own:
            f = scenes.get(path, np.array(circuit.parameters[path].value))
            if np.any(np.abs(f / at - 1.0) > _SAME):
                taken = f"{path.removesuffix('.f')} {_TAKES} {span(f)}, the source's fundamental is {span(at)}"
                yield f"{taken}; with skin 'follow' they are taken at the fundamental"


def _skin_warnings(circuit: Circuit, stop: float) -> Iterator[str]:
    skins = circuit.by_device("SKIN")
    waves = network_of(circuit).waveforms if skins else ()
    # With several sources only the user can know at which frequency the skin data should be taken.
    for skin in skins if len(waves) == 1 else ():
        (wave,), fundamental, known = waves, waves[0].fundamental, 0.0 < stop < math.inf
        f = skin.values["f"]
        taken = f"{skin.name} {_TAKES} {f:g} Hz"
        if fundamental is not None and abs(f / fundamental.frequency - 1.0) > _SAME:
            own = f"{fundamental.frequency:g}"
            yield f"{taken}, the source's fundamental is {own} Hz; {skin.name}.f={own} would match"
        elif fundamental is None and not (known and is_near(wave, stop, f)):
            error = skin_error(circuit, wave, stop) if known else None
            off = f"may be {'5 to 10' if error is None else f'{100.0 * _LITTLE:g}'} % off"
            if error is not None and abs(error) >= _LITTLE:
                off = f"is about {100.0 * abs(error):.2g} % too {'large' if error > 0.0 else 'small'}"
            right = f"SKIN_DISPERSIVE d={1e6 * skin.values['d']:g}u is right for any source"
            yield f"{taken}, and the source has no fundamental: the mean force {off}; {right}"


# Spectra


def _enough(span: float, rate: float) -> int:
    """Number of samples of a span (s), a power of two: at least `rate` per second, but at most `_MOST_SAMPLES`."""
    return int(min(_MOST_SAMPLES, max(1024, 2 ** math.ceil(math.log2(span * rate)))))


def _samples(waveform: Waveform, t0: float, t1: float, count: int) -> FloatArray:
    """The source at the midpoints of `count` equal intervals."""
    return np.asarray(waveform.value(t0 + (np.arange(count) + 0.5) * ((t1 - t0) / count)))


def _energies(waveform: Waveform, t_stop: float, highest: float) -> tuple[FloatArray, FloatArray]:
    """Frequencies (Hz) up to about twice `highest` (Hz), and the source's energy at each, in arbitrary units.

    For a periodic source the spectrum is taken over one period, and else over the run to `t_stop` (s) with a Hann
    window, because the ends of the run would count as jumps. For a run of too many samples the spectra of several
    pieces spread over the run are added. A source with values that are not finite has energy 0.
    """

    def make() -> tuple[FloatArray, FloatArray]:
        t0, span, rate, pieces = 0.0, t_stop, 4.0 * highest, 1
        if (periodic := waveform.period) is not None:
            t0, span = waveform.settled, periodic
        elif span * rate > _MOST_SAMPLES:
            own = max(2.0 * waveform.breakpoint_rate(), 16.0 / waveform.shortest_time())
            rate = min(rate, own or rate)
            pieces = 1 if span * rate <= _MOST_SAMPLES else _PIECES
        count = _enough(span, rate) // pieces
        length = span if pieces == 1 else count / rate
        window = 1.0 if periodic is not None else _window(count)
        total: FloatArray = np.zeros(1)
        for start in np.linspace(t0, t0 + span - length, pieces).tolist():
            u = _samples(waveform, start, start + length, count)
            if not np.all(np.isfinite(u)):
                return np.zeros(1), np.zeros(1)
            total = total + np.abs(np.fft.rfft(u * window)) ** 2
        total[1:] *= 2.0
        return np.arange(total.size) / length, total

    return waveform.remember(("energies", t_stop, highest), make, 2)


def _recorded(wave: Waveform, t_stop: float) -> tuple[FloatArray, FloatArray] | None:
    """As `_energies`, from the samples themselves: pieces spread over the run to `t_stop` (s); None for few samples."""
    last = min(wave.count, math.floor((t_stop - wave.start) * wave.rate) + 1) if isinstance(wave, Samples) else 0
    if not isinstance(wave, Samples) or last < _FEW:
        return None

    def make() -> tuple[FloatArray, FloatArray]:
        # A power of two, as the Fourier transform of a number with a large prime factor takes many times as long.
        count = min(2 ** int(math.log2(last)), 2 ** math.ceil(math.log2(_LEAST * wave.rate)), _MOST_SAMPLES)
        starts = np.unique(np.linspace(0, last - count, min(_PIECES, math.ceil(last / count))).astype(int))
        total, window = np.zeros(count // 2 + 1), _window(count)
        for i in starts.tolist():
            lines = np.fft.rfft(wave.between(i, i + count) * window)
            total += lines.real**2 + lines.imag**2
        total[1:] *= 2.0
        return np.arange(total.size) * (wave.rate / count), total

    return wave.remember(("spectrum", t_stop), make, 1)


def energy_outside(waveform: Waveform, t_stop: float, band: tuple[float, float] = SKIN_BAND) -> tuple[float, float]:
    """Fractions of the source's energy in a run to `t_stop` (s) below and above a band (Hz); see `_energies`."""
    low, high = band
    # Above their rate, straight lines between samples of white noise have 0.3 % of its energy.
    slow = isinstance(waveform, Samples) and waveform.rate <= high
    f, energy = (_recorded(waveform, t_stop) if slow else None) or _energies(waveform, t_stop, high)
    total = float(energy.sum())
    # The window spreads a line over the neighbouring bins, so one bin below the band counts as inside.
    below = f < low - (f[1] if waveform.period is None and f.size > 1 else 0.0)
    return (float(energy[below].sum() / total), float(energy[f > high].sum() / total)) if total > 0.0 else (0.0, 0.0)


def is_near(waveform: Waveform, t_stop: float, frequency: float) -> bool:
    """Whether 99 % of a source's energy is within 5 % of a frequency (Hz), as of a carrier with a slow envelope.

    In that band the skin's data change by 3 %.
    """
    if (found := _recorded(waveform, t_stop)) is not None:
        # A coarse look at a recording suffices if it finds a fifth of the energy more than half an octave away.
        (f, energy), blurred = found, 2.0 * found[0][1]
        far = (f < frequency / 1.4 - blurred) | (f > 1.4 * frequency + blurred)
        if energy[far].sum() > 0.2 * energy.sum() > 0.0:
            return False
    return sum(energy_outside(waveform, t_stop, (0.95 * frequency, 1.05 * frequency))) < NOTABLE


def skin_error(circuit: Circuit, waveform: Waveform, t_stop: float) -> float | None:
    """Relative error of the mean force due to SKIN's data held at one frequency, for a circuit with one source.

    It is estimated by the relative error of the mean square of the gap voltage, from the linear response at the areas
    at rest and the source's spectrum over the run to `t_stop` (s); of several fingers the largest error counts. Outside
    the band of the skin's data the response at the band's ends is used. None if the response cannot be computed.
    """

    def squared_gains() -> list[FloatArray] | None:
        """Of each gap (n_gap, _GRID.size), with the skin's own data at each frequency and with those held at one."""
        networks = network_of(circuit), network_of(with_skin_held(circuit))
        gaps, areas = [gap for gap in networks[0].gaps if gap is not None], networks[0].areas_at_rest
        with suppress(np.linalg.LinAlgError):
            return [np.abs(n.phasors(_GRID, areas, np.ones(1, complex)).T[gaps]) ** 2 for n in networks]
        return None

    squares = shared(circuit, ("squared gains",), squared_gains)
    f, energy = _recorded(waveform, t_stop) or _energies(waveform, t_stop, SKIN_BAND[1])
    if squares is None or f.size < 2:
        return None

    def at_lines() -> list[list[FloatArray]]:
        # The gains are interpolated in log f; beyond the ends of the grid they are those of the ends.
        place = np.log(np.maximum(f, SKIN_BAND[0]))
        return [[np.interp(place, np.log(_GRID), row) for row in square] for square in squares]

    gains = shared(circuit, ("gains at", f.size, f[-1]), at_lines)
    right, held = (np.array([energy @ row for row in rows]) for rows in gains)
    if not (right.size and np.all(right > 0.0) and np.all(np.isfinite(held / right))):
        return None
    return float(max(held / right - 1.0, key=abs))


def spectrum_warning(circuit: Circuit, waveform: Waveform, t_stop: float) -> Iterator[str]:
    """A warning where a dispersive skin is driven outside the band of its data."""
    skins = circuit.by_device("SKIN_DISPERSIVE")
    if not skins or not 0.0 < t_stop < math.inf:
        return
    shares = waveform.remember(("outside", t_stop), lambda: energy_outside(waveform, t_stop), 1)
    found = zip(shares, (f"below {SKIN_BAND[0]:g} Hz", f"above {SKIN_BAND[1] / 1e3:g} kHz"), strict=True)
    far = (f"{100.0 * share:.{0 if share > 0.1 else 1}f} % {where}" for share, where in found if share > NOTABLE)
    if parts := " and ".join(far):
        yield f"of the source's energy {parts} lie outside the band of the data behind {skins[0].name}"


def freezing_error(circuit: Circuit, frequency: float, area: float, sensitivity: float, t_stop: float) -> float:
    """Error of the gap voltage, relative to its peak, if a dispersive skin's data are taken at one frequency (Hz).

    It is the error of the linear response at one area (m^2) from the uncharged start to `t_stop` (s), by superposition
    of phasors, plus an estimate of the error due to the change of the area, `sensitivity` relative to the area.
    """
    networks = network_of(circuit), network_of(circuit, frequency)
    span = min(t_stop, _PERIODS / frequency)
    u = _samples(networks[0].waveform, 0.0, span, _enough(span, 200.0 * frequency))
    # The run is padded with zeros to twice its length, because the discrete transform is cyclic.
    lines = np.fft.rfft(u, 2 * u.size)
    f = np.arange(1, lines.size) / (2.0 * span)
    gains = [layer_gains(one.admittances(f, np.array([area])))[:, one.gaps[0]] for one in networks]
    responses = (np.append(0.0, gain * lines[1:]) for gain in (gains[0], gains[1] - gains[0]))
    peak, missed = (float(np.abs(np.fft.irfft(one)[: u.size]).max()) for one in responses)
    return missed / peak + COUPLING * sensitivity if peak > 0.0 and math.isfinite(peak) else math.inf
