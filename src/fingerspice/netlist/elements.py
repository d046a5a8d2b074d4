"""Conversion of a deck's statement to its element, and to the further elements for LTspice's parasitics."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import Any

from fingerspice.base.errors import InputError, Where
from fingerspice.base.units import exponent_and_scale
from fingerspice.circuit.circuit import Element
from fingerspice.circuit.devices import DEVICES, ParameterSpec
from fingerspice.circuit.usual import mega_note, unit_trap, unusual
from fingerspice.netlist.directives import start_volts
from fingerspice.netlist.flatten import KINDS
from fingerspice.netlist.slips import nearest
from fingerspice.netlist.sources import Context, Source, read_source
from fingerspice.netlist.words import Call, Number, Statement, Token, Value

#: The parameter that gives the number of equal parts in parallel.
_COPIES = "m"


def read_elements(statement: Statement, context: Context, notes: list[str]) -> list[Element]:
    """The element of a statement, and the elements for LTspice's ``Rser``, ``Rpar`` and ``Cpar``.

    Warnings are added to `notes`.
    """
    device = statement.device or statement.letter
    parasitics = KINDS[device].beside if device in KINDS else ()
    beside = {key: statement.params[key] for key in parasitics if key in statement.params}
    own = replace(statement, params={k: v for k, v in statement.params.items() if k not in beside})
    read = READERS[statement.letter](own, context, notes)
    element = Element(statement.name, device, statement.nodes, statement.node_names, where=statement.where, **read)
    for parameter, text in unusual(element):
        named = statement.params.get(parameter)
        given = statement.body[0] if parameter == "value" and statement.body else named
        # One warning per number is enough.
        if not (isinstance(given, Number) and _doubts(given, element.spec.parameter(parameter))):
            notes.append(f"{statement.where if given is None else given.where}: {text}")
    return _with_parasitics(element, beside, notes)


def _with_parasitics(element: Element, beside: dict[str, Value], notes: list[str]) -> list[Element]:
    out = [element]
    for key, given in beside.items():
        if isinstance(given, Number) and given.value == 0.0 and key != "rpar":
            continue
        written, device = f"{element.name}.{key.capitalize()}", key[0].upper()
        value = MappingProxyType({"value": _value(written, DEVICES[device].parameter("value"), given, notes)})
        nodes, names = element.nodes, element.node_names
        if key == "rser":
            inner = written.lower()
            nodes, names = (element.nodes[0], inner), (element.node_names[0], written)
            out[0] = replace(out[0], nodes=(inner, element.nodes[1]), node_names=(written, element.node_names[1]))
        out.append(Element(written, device, nodes, names, value, where=element.where))
    return out


# How the statements with a letter are read: the fields of their elements


def _read_source(statement: Statement, context: Context, notes: list[str]) -> dict[str, Any]:
    source = source_of(statement, context)
    notes.extend(source.notes)
    return {"values": MappingProxyType({}), "waveform": source.waveform, "ac": source.ac}


def source_of(statement: Statement, context: Context) -> Source:
    """The source that a V or I element's statement describes."""
    body, params = list(statement.body), statement.params
    last = body[-1] if body else None
    if "wavefile" in params and not any(isinstance(word, Call) for word in body):
        body.append(_ltspice_wavefile(statement))
    elif params:
        # ngspice takes PWL(...) r=10m as well as PWL(... r=10m), and the brackets of PWL(file=...) may be left out.
        inner = last.params if isinstance(last, Call) else {}
        if not isinstance(last, Call | Token) or last.text.lower() != "pwl" or set(inner) & set(params):
            key = next(iter(params))
            takes = ", ".join(p.capitalize() for p in KINDS[statement.letter].beside)
            hint = f"; allowed: {takes}, besides its value" if takes else ""
            raise InputError(f"{statement.name} takes no parameter {key!r}{hint}", params[key].key)
        body[-1] = Call(last.text, last.args if isinstance(last, Call) else (), {**inner, **params}, last.where)
    return read_source(statement.name, body, context, statement.where)


def _ltspice_wavefile(statement: Statement) -> Call:
    """LTspice's ``wavefile=path [chan=n]`` as a call: 1 V at full scale, and the first channel if none is chosen."""
    path = statement.params["wavefile"]
    where = path.key or path.where
    for key, value in statement.params.items():
        if key not in ("wavefile", "chan"):
            problem = f"{statement.name} takes no parameter {key!r} beside wavefile=; allowed: chan="
            raise InputError(problem, value.key)
    channel = statement.params.get("chan", Number(0.0, "0", where))
    return Call("wavefile", (path, Number(1.0, "1", where), channel), {}, where)


def _read_device(statement: Statement, context: Context, notes: list[str]) -> dict[str, Any]:
    name, device, params = statement.name, statement.device or "", statement.params
    if statement.nodes[2] == "0":
        raise InputError(f"{name} has ground as its area; allowed: the area node of a GAP", statement.where)
    known = {p.name: p for p in DEVICES[device].parameters}
    for key, given in params.items():
        if key not in known:
            # On an X line m=... is ngspice's number of copies.
            hint = "; the exponent is m_exp" if key == _COPIES and "m_exp" in known else nearest(key, known)
            problem = f"{name}: {device} has no parameter {key!r}{hint}; allowed: {', '.join(known)}"
            raise InputError(problem, given.key)
    values = {}
    for key, spec in known.items():
        if key in params:
            values[key] = _value(name, spec, params[key], notes)
        elif spec.default is not None:
            values[key] = spec.default
        else:
            unit = f" ({spec.unit})" if spec.unit else ""
            raise InputError(f"{name}: {device} needs {key}{unit}, missing here", statement.where)
    return {"values": MappingProxyType(values)}


def _read_passive(statement: Statement, context: Context, notes: list[str]) -> dict[str, Any]:
    """Value of an R or C, and the start voltage (V) of a C."""
    name, letter, params = statement.name, statement.letter, statement.params
    kind, spec = KINDS[letter], DEVICES[letter].parameter("value")
    own = (*kind.value, _COPIES, *(("ic",) if letter == "C" else ()), *kind.data)
    for key, part in params.items():
        if key not in own and not (key == "lser" and isinstance(part, Number) and part.value == 0.0):
            shown = ", ".join(f"{k}=" for k in (*own, *kind.beside))
            reason = ", there are no inductors here" if key == "lser" else ""
            raise InputError(f"{name} takes no parameter {key!r}{reason}; allowed: {shown}", part.key)
    given = [*statement.body, *(params[key] for key in kind.value if key in params)]
    if len(given) != 1:
        raise InputError(f"{name} needs one value in {spec.unit}, {len(given)} are given", statement.where)
    word = given[0]
    if not isinstance(word, Number):
        raise InputError(f"{name} value is {word.text!r}; allowed: a number {spec.unit}", word.where)
    value = _value(name, spec, word, notes)
    copies = params.get(_COPIES)
    if copies is not None:
        if not isinstance(copies, Number) or not 1e-6 <= copies.value <= 1e6:
            raise InputError(f"{name} m is {copies.text!r}; allowed: a number of parts side by side", copies.where)
        value = value / copies.value if letter == "R" else value * copies.value
    initial = params.get("ic")
    if isinstance(initial, Token):
        raise InputError(f"{name} IC is {initial.text!r}; allowed: a number V", initial.where)
    start = None if initial is None else start_volts(f"{name} IC", initial)
    return {"values": MappingProxyType({"value": value}), "initial": start}


#: From a statement's letter to what reads it.
READERS: Mapping[str, Callable[[Statement, Context, list[str]], dict[str, Any]]] = {
    "X": _read_device,
    "R": _read_passive,
    "C": _read_passive,
    "V": _read_source,
    "I": _read_source,
}


def _value(name: str, spec: ParameterSpec, given: Value, notes: list[str]) -> float:
    """Value of one parameter; refuses or warns about units that SPICE reads as scale factors."""
    unit = f" {spec.unit}" if spec.unit else ""
    if isinstance(given, Token):
        if spec.may_be_infinite and given.text.lower() in ("inf", "none"):
            return math.inf
        allowed = f"a number{unit}, or the name of a .param"
        raise InputError(f"{name} {spec.name} is {given.text!r}; allowed: {allowed}", given.where)
    trap = unit_trap(spec, given.text)
    if trap:
        raise InputError(f"{name} {spec.name} {trap}", given.where)
    notes.extend(f"{place}: {name} {spec.name}: {doubt}" for place, doubt in _doubts(given, spec))
    if not spec.accepts(given.value):
        plain = f"{given.value:g}{unit}"
        written = plain if given.text == f"{given.value:g}" else f"{given.text} ({plain})"
        raise InputError(f"{name} {spec.name} is {written}; allowed: {spec.allowed()}", given.where)
    return given.value


def _doubts(given: Number, spec: ParameterSpec) -> list[tuple[Where, str]]:
    """Warnings about the notation of a number, each with the place that it is about."""
    found = []
    if given.mega is not None and (note := mega_note(given.mega.text, given.value, spec)):
        found.append((given.mega.where, note))
    if exponent_and_scale(given.text):
        found.append((given.where, f"{given.text} is {given.value:g}: exponent and scale both count"))
    return found
