"""Named sets of parameters on the page, and what had been changed in a circuit before the page was opened."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping
from functools import partial
from typing import Any

from fingerspice.base.errors import InputError
from fingerspice.circuit.circuit import Circuit, Element
from fingerspice.circuit.describe import in_force, remembering
from fingerspice.circuit.topology import driving_sources
from fingerspice.explorer.request import Request, circuits_of, request_of
from fingerspice.explorer.sliders import read_source, text_of, value_text
from fingerspice.sets.parameters import ParameterSet, parameters
from fingerspice.waveforms.waveform import Waveform


def menu() -> list[dict[str, str]]:
    """The sets as plain data, for the page's menu."""
    return [{"name": one.name, "kind": one.kind, "title": one.title} for one in parameters().values()]


def applied(given: dict[str, Any], own: Circuit | None = None) -> dict[str, Any]:
    """What the set changes in the scene that a request names in its key ``apply``, as in `Request.sets`.

    The answer has ``ok`` and ``message``; ``overrides`` (path to value as text), ``source`` (text, or None where the
    set is no drive) and ``set``, the set's entry in `Request.sets`.
    """
    asked = dict(given) if isinstance(given, dict) else {}
    entry = asked.pop("apply", None)
    try:
        if not isinstance(entry, str):
            raise InputError("apply: allowed: the name of a set, or ELEMENT=NAME")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            _, circuit, _ = circuits_of(request_of(asked), own)
            one, to = _named(entry)
            changes = one.apply(circuit, to).sets[one.name]
    except InputError as error:
        return {"ok": False, "message": str(error)}
    units = {path.lower(): parameter.unit for path, parameter in circuit.parameters.items()}
    overrides, source = {}, None
    for path, value in changes.items():
        if not isinstance(value, Waveform):
            overrides[path] = value_text(value, units[path.lower()])
        elif source is None:
            source = f"{path}={text_of(value)}" if len(driving_sources(circuit)) > 1 else text_of(value)
    return {"ok": True, "message": "", "overrides": overrides, "source": source, "set": _entry(one.name, to)}


def marked(circuit: Circuit, base: Circuit, request: Request) -> tuple[Circuit, list[str]]:
    """The circuit of a request, which remembers the request's sets, and sentences about sets that mean nothing here."""
    circuit, lost = circuit._with(sets={}), []
    for entry in request.sets:
        try:
            name, changes = base.remember(("set", entry), partial(_changes, base, entry))
        except InputError as error:
            lost.append(f"set {entry!r}, which is left out: {error}")
            continue
        circuit = remembering(circuit, name, changes)
    return circuit, lost


def sentences(circuit: Circuit, request: Request) -> list[dict[str, Any]]:
    """What the page says of each set of a request of which a value is still in force."""
    force = in_force(circuit)
    return [
        {"name": name, "to": to, "title": parameters(name).title, "caveat": parameters(name).not_claimed,
         "assumed": list(parameters(name).assumed), "changed": list(force[name][1])}
        for name, to in entries(circuit, request)
    ]  # fmt: skip


def entries(circuit: Circuit, request: Request) -> Iterator[tuple[str, str | None]]:
    """Name and element of each set of a request that still gives a value to the circuit, in their order."""
    force = in_force(circuit)
    for entry in request.sets:
        to, _, name = entry.rpartition("=")
        if name in force and force[name][0]:
            yield name, to or None


def before(circuit: Circuit) -> dict[str, Any]:
    """What had been changed in a circuit before the page was opened, as the request's overrides, source and sets.

    A source that no text of the page can say, such as a recording or a function, is in none of them.
    """
    known = {path.lower(): (path, parameter) for path, parameter in circuit.parameters.items()}
    given = {path.lower() for path in circuit.overrides}
    texts = [text for e in _replaced(circuit) if (text := _source_text(circuit, e)) is not None]
    said = {text.partition("=")[0].lower() for text in texts[:1]}
    overrides = {
        known[path][0]: value_text(known[path][1].value, known[path][1].unit)
        for path in sorted(given & set(known))
        if path.rpartition(".")[0] not in said
    }
    sets = [entry for name in circuit.sets if (entry := _applied_entry(circuit, name)) is not None]
    found = {"overrides": overrides, "source": texts[0] if texts else "", "sets": ",".join(sets)}
    return {key: value for key, value in found.items() if value}


def unsaid(circuit: Circuit) -> list[str]:
    """Names of sources that had been replaced before the page was opened, and that no text of the page can say."""
    said = [e.name for e in _replaced(circuit) if _source_text(circuit, e) is not None][:1]
    return [e.name for e in _replaced(circuit) if e.name not in said]


def _replaced(circuit: Circuit) -> list[Element]:
    """The sources that have another waveform than the deck's."""
    given = {path.lower() for path in circuit.overrides}
    return [e for e in circuit.elements if e.waveform is not None and e.name.lower() in given]


def _source_text(circuit: Circuit, element: Element) -> str | None:
    """The text of a source of now, as in `Request.source`; None where the page has none for it."""
    assert element.waveform is not None
    for text in (text_of(element.waveform), circuit.overrides.get(element.name)):
        try:
            if text is not None and read_source(f"{element.name}={text}", circuit)[1] == element.waveform:
                return f"{element.name}={text}"
        except InputError:
            continue
    return None


def _applied_entry(circuit: Circuit, name: str) -> str | None:
    """The set of that name as in `Request.sets`: applied to all, or as narrowly as gives its values in the circuit."""
    values = circuit.sets[name]
    elements = dict.fromkeys(path.rpartition(".")[0] or path for path in values)
    inside = {e.rpartition(".")[0] for e in elements}
    for to in (None, *elements, *sorted(inside - {""}, key=len, reverse=True)):
        try:
            found = parameters(name).apply(circuit, to).sets[name]
        except InputError:
            continue
        if values == found or (to is not None and values.items() <= found.items()):
            return _entry(name, to)
    return None


def _entry(name: str, to: str | None) -> str:
    """A set in `Request.sets`."""
    return name if to is None else f"{to}={name}"


def _changes(base: Circuit, entry: str) -> tuple[str, Mapping[str, Any]]:
    """Name and values, by path, of a set as in `Request.sets`."""
    one, to = _named(entry)
    return one.name, one.apply(base, to).sets[one.name]


def _named(entry: str) -> tuple[ParameterSet, str | None]:
    """A set, and the element to which alone its values go."""
    to, _, name = (part.strip() for part in entry.rpartition("="))
    return parameters(name), to or None
