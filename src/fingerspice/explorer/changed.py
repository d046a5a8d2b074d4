"""Named sets of parameters on the page, and what had been changed in a circuit before the page was opened."""

from __future__ import annotations

from functools import partial
from typing import Any

from fingerspice.base.errors import InputError
from fingerspice.circuit.circuit import Circuit, Element
from fingerspice.circuit.describe import in_force, remembering
from fingerspice.circuit.topology import driving_sources
from fingerspice.explorer.request import Asked, quiet
from fingerspice.explorer.sliders import read_source, text_of, value_text
from fingerspice.sets.parameters import parameters
from fingerspice.waveforms.waveform import Waveform


@quiet()
def applied(given: dict[str, Any], own: Circuit | None = None) -> dict[str, Any]:
    """What the set changes in the scene that a request names in its key ``apply``, as in `Asked.sets`.

    The answer has ``ok`` and ``message``; ``overrides`` (path to value as text), ``source`` (text, or None where the
    set is no drive) and ``set``, the set's entry in `Asked.sets`. `InputError` says why a set does not fit.
    """
    asked = dict(given) if isinstance(given, dict) else {}
    entry = asked.pop("apply", None)
    if not isinstance(entry, str):
        raise InputError("apply: allowed: the name of a set, or ELEMENT=NAME")
    circuit = Asked(asked, own).circuit
    name, to, changes = _changes(circuit, entry)
    units = {path.lower(): parameter.unit for path, parameter in circuit.parameters.items()}
    overrides, source = {}, None
    for path, value in changes.items():
        if not isinstance(value, Waveform):
            overrides[path] = value_text(value, units[path.lower()])
        elif source is None:
            source = f"{path}={text_of(value)}" if len(driving_sources(circuit)) > 1 else text_of(value)
    return {"ok": True, "message": "", "overrides": overrides, "source": source, "set": f"{to}={name}" if to else name}


def in_scene(asked: Asked) -> tuple[list[dict[str, Any]], set[str], list[str]]:
    """What the page says of each set with a value in force, the paths that sets give, and sets that mean nothing."""
    circuit, given, lost = asked.circuit._with(sets={}), [], []
    for entry in asked.sets:
        try:
            name, to, changes = asked.base.remember(("set", entry), partial(_changes, asked.base, entry))
        except InputError as error:
            lost.append(f"set {entry!r}, which is left out: {error}")
            continue
        given.append((name, to))
        circuit = remembering(circuit, name, changes)
    force = in_force(circuit)
    said = [
        {"name": name, "to": to, "title": parameters(name).title, "caveat": parameters(name).not_claimed,
         "assumed": list(parameters(name).assumed), "changed": list(force[name][1])}
        for name, to in given
        if name in force and force[name][0]
    ]  # fmt: skip
    return said, {path.lower() for kept, _ in force.values() for path in kept}, lost


def before(circuit: Circuit) -> tuple[dict[str, Any], list[str]]:
    """What had been changed in a circuit before the page was opened, as the request's overrides, source and sets.

    With it go the names of replaced sources that it does not say: a request has one, and a recording or a function has
    no text.
    """
    known = {path.lower(): (path, parameter) for path, parameter in circuit.parameters.items()}
    given = {path.lower() for path in circuit.overrides}
    replaced = [e for e in circuit.elements if e.waveform is not None and e.name.lower() in given]
    texts = {e.name: text for e in replaced if (text := _source_text(circuit, e)) is not None}
    said = list(texts)[:1]
    overrides = {
        known[path][0]: value_text(known[path][1].value, known[path][1].unit)
        for path in sorted(given & set(known))
        if path.rpartition(".")[0] not in map(str.lower, said)
    }
    sets = ",".join(filter(None, (_entry(circuit, name) for name in circuit.sets)))
    found = {"overrides": overrides, "source": "".join(texts[name] for name in said), "sets": sets}
    return {key: value for key, value in found.items() if value}, [e.name for e in replaced if e.name not in said]


def _source_text(circuit: Circuit, element: Element) -> str | None:
    """The text of a source of now, as in `Asked.source`; None where the page has none for it."""
    assert element.waveform is not None
    for text in (text_of(element.waveform), circuit.overrides.get(element.name)):
        try:
            if text is not None and read_source(f"{element.name}={text}", circuit)[1] == element.waveform:
                return f"{element.name}={text}"
        except InputError:
            continue
    return None


def _entry(circuit: Circuit, name: str) -> str | None:
    """The set of that name as in `Asked.sets`: applied to all, or as narrowly as gives its values in the circuit."""
    values = circuit.sets[name]
    elements = dict.fromkeys(path.rpartition(".")[0] or path for path in values)
    inside = {e.rpartition(".")[0] for e in elements}
    for to in (None, *elements, *sorted(inside - {""}, key=len, reverse=True)):
        try:
            found = parameters(name).apply(circuit, to).sets[name]
        except InputError:
            continue
        if values == found or (to is not None and values.items() <= found.items()):
            return f"{to}={name}" if to else name
    return None


def _changes(circuit: Circuit, entry: str) -> tuple[str, str | None, dict[str, Any]]:
    """Name and element of a set as in `Asked.sets`, and what it gives to a circuit, by path."""
    to, _, name = (part.strip() for part in entry.rpartition("="))
    one = parameters(name)
    return one.name, to or None, dict(one.apply(circuit, to or None).sets[one.name])
