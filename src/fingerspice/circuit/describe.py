"""A circuit in words: its elements, its sources, the changes made after its deck was read; and its digests."""

from __future__ import annotations

import dataclasses
import hashlib
import math
from collections.abc import Mapping
from typing import Any

from fingerspice.base.pages import Page, Table
from fingerspice.base.units import format_si
from fingerspice.circuit.circuit import Circuit, Element
from fingerspice.circuit.devices import shown
from fingerspice.circuit.topology import driving
from fingerspice.waveforms.combinations import Burst, Product, Repeat, Sum
from fingerspice.waveforms.ramps import PWL
from fingerspice.waveforms.samples import Samples
from fingerspice.waveforms.sampling import Function
from fingerspice.waveforms.waveform import DC, Waveform


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
        kept = {path: value for path, value in values.items() if now.get(path.lower(), value) == value}
        found[name] = kept, tuple(path for path in values if path not in kept)
    return found


def digests(circuit: Circuit) -> tuple[str, str]:
    """SHA-256 of a circuit's elements, initial voltages and step control, and of its sources' waveforms."""
    elements, sources, tran = hashlib.sha256(), hashlib.sha256(), circuit.tran
    for element in circuit.elements:
        wave = element.waveform
        elements.update(repr((element.name, element.device, element.nodes, dict(element.values))).encode())
        sources.update(repr((element.name, wave.digest() if isinstance(wave, Samples) else wave)).encode())
    elements.update(repr((dict(circuit.initial), tran and (tran.max_step, tran.uic))).encode())
    return elements.hexdigest(), sources.hexdigest()


#: What the numbers of waveforms are, in few words.
MEANINGS_OF_WAVEFORMS = {
    "modulation": "envelope", "phase_deg": "phase", "f0": "first frequency", "f1": "last frequency", "v1": "low level",
    "v2": "high level", "td1": "rise begins", "tau1": "rise constant", "td2": "fall begins", "tau2": "fall constant",
}  # fmt: skip
#: Largest number of changes, or of sources, that one line names; the number of the others is added.
_MOST = 8
#: Largest number of elements that a circuit's page lists.
_MOST_ELEMENTS = 25


def meaning_of(circuit: Circuit, path: str) -> str:
    """A parameter in words, as in ``load of Xgap``."""
    name, _, parameter = path.rpartition(".")
    known = MEANINGS_OF_WAVEFORMS | {p.name: p.meaning for p in circuit[name].spec.parameters}
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
        if field.name not in waveform.units or value == field.default:
            continue
        text = shown(value, waveform.units[field.name].replace("V", unit))
        # A required figure is known by its position; one that has a default needs its name.
        said.append(text if field.default is dataclasses.MISSING else f"{field.name} {text}")
    return f"{type(waveform).__name__}({', '.join(said)})"


def _own_text(source: Element) -> str:
    """The waveform of a source, in volt or ampere; empty for another element."""
    return "" if source.waveform is None else waveform_text(source.waveform, "A" if source.device == "I" else "V")


def drive_text(circuit: Circuit) -> str:
    """Every source that is not 0 with its waveform: ``Vdrive: Sine(200 V, 100 Hz)``.

    Sources that were replaced are left out, since `changes_text` lists them.
    """
    replaced = {path.lower() for path in circuit.overrides} - _given_by_sets(circuit)
    on = (e for e in driving(circuit) if e.waveform not in (None, DC(0.0)) and e.name.lower() not in replaced)
    return _joined([f"{e.name}: {_own_text(e)}" for e in on])


def changes_text(circuit: Circuit) -> str:
    """Changes made after the deck was read, with the present values: ``Xgap.d = 5 um``; empty without changes.

    Values that a set of parameters gave, and that still hold, are named by the set: ``set moist``.
    """
    said = [f"set {name}" for name, (kept, _) in in_force(circuit).items() if kept]
    now = {e.name.lower(): f"{e.name} = {_own_text(e)}" for e in circuit.elements if e.waveform is not None}
    now |= {path.lower(): f"{path} = {shown(p.value, p.unit)}" for path, p in circuit.parameters.items()}
    # A path may have been changed twice, in two spellings; of one that is unknown the last text counts.
    last = {path.lower(): (path, text) for path, text in circuit.overrides.items()}
    for key in last.keys() - now.keys():
        path, text = last[key]
        kind = text.partition("(")[0]
        short = text if len(text) <= 40 else f"{kind}(...)" if kind.isidentifier() else f"{text[:36]} ..."
        now[key] = f"{path} = {short}"
    given = _given_by_sets(circuit)
    return _joined([*said, *(now[path] for path in last if path not in given)])


def _given_by_sets(circuit: Circuit) -> set[str]:
    """Paths of the values that sets of parameters gave and that still hold, in lower case."""
    return {path.lower() for kept, _ in in_force(circuit).values() for path in kept}


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
        text = values_text(e)
        rows.append((e.name, e.device, " ".join(e.node_names), text if len(text) <= 96 else f"{text[:92]} ..."))
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
    said = [f"{name}={_deck_value(value)}" for name, value in element.values.items() if math.isfinite(value)]
    return " ".join(said if element.waveform is None else [*said, _own_text(element)])


def _deck_value(value: float) -> str:
    """A number as written in decks: ``3.5u``, ``0.2meg``, ``0.3``."""
    text = format_si(value, "").replace(" ", "")
    # SPICE reads M as milli, and does not know P and E.
    if 0.01 <= abs(value) < 1e4 or text[-1:] in "PEZY":
        return f"{value:.4g}"
    return f"{text[:-1]}meg" if text.endswith("M") else text


def _joined(said: list[str]) -> str:
    more = [f"and {len(said) - _MOST} more"] if len(said) > _MOST else []
    return ", ".join([*said[:_MOST], *more])
