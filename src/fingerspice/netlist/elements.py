"""Conversion of a deck's statement to its element, and to the further elements for LTspice's parasitics."""

from __future__ import annotations

import math
from dataclasses import replace
from types import MappingProxyType

from fingerspice.base.errors import InputError
from fingerspice.base.units import exponent_and_scale
from fingerspice.circuit.circuit import Element
from fingerspice.circuit.devices import DEVICES, ParameterSpec
from fingerspice.circuit.usual import is_resistance, mega_note, unit_trap, unusual
from fingerspice.netlist.deck import Call, Number, Statement, Token
from fingerspice.netlist.directives import start_volts
from fingerspice.netlist.scope import Value
from fingerspice.netlist.slips import nearest
from fingerspice.netlist.sources import Context, Source, read_source

#: LTspice's parasitics, which become elements: ``rser`` in series at the first node, all others in parallel.
_PARASITICS = {"V": ("rser", "cpar"), "C": ("rser", "rpar", "cpar")}
#: Data of a part that LTspice and Qucs-S write and no calculation uses.
_PART_DATA = {"R": ("tol", "pwr", "tc1", "tc2"), "C": ("tol", "v", "irms", "mfg", "pn", "type", "tc1", "tc2")}
#: Other names of the value; and the parameter that gives the number of equal parts in parallel.
_VALUE_NAMES = {"R": ("r", "resistance"), "C": ("c", "capacitance")}
_COPIES = "m"


def read_elements(statement: Statement, context: Context, notes: list[str]) -> list[Element]:
    """The element of a statement, and the elements for LTspice's ``Rser``, ``Rpar`` and ``Cpar``.

    Parameters
    ----------
    statement : Statement
    context : Context
    notes : list of str
        List to which warnings are added.

    Raises
    ------
    InputError
        If the statement is wrong; the message has the place.
    """
    device = statement.device or statement.letter
    values: dict[str, float] = {}
    source, initial = None, None
    beside = {key: statement.params[key] for key in _PARASITICS.get(device, ()) if key in statement.params}
    own = replace(statement, params={k: v for k, v in statement.params.items() if k not in beside})
    if DEVICES[device].is_layer:
        if statement.nodes[2] == "0":
            raise InputError(
                f"{statement.name} has ground as its area; allowed: the area node of a GAP", statement.where
            )
        values = _device_values(own, device, notes)
    elif device in "VI":
        source = source_of(own, context)
        notes.extend(source.notes)
    else:
        values, initial = _passive_value(own, notes)
    element = Element(
        statement.name,
        device,
        statement.nodes,
        statement.node_names,
        MappingProxyType(values),
        None if source is None else source.waveform,
        initial,
        statement.where,
        None if source is None else source.ac,
    )
    for parameter, text in unusual(element):
        given = _given(statement, parameter)
        if not (isinstance(given, Number) and _is_noted(given, element.spec.parameter(parameter))):
            notes.append(f"{statement.where if given is None else given.where}: {text}")
    return _with_parasitics(element, beside, notes)


def _given(statement: Statement, parameter: str) -> Value | Call | None:
    if parameter == "value" and statement.body:
        return statement.body[0]
    return statement.params.get(parameter)


def _is_noted(given: Number, spec: ParameterSpec) -> bool:
    """Whether `_value` already warns about the notation of a number: one warning per number is enough."""
    return (given.mega is not None and is_resistance(spec)) or exponent_and_scale(given.text)


def _with_parasitics(element: Element, beside: dict[str, Value], notes: list[str]) -> list[Element]:
    out = [element]
    for key, given in beside.items():
        written = f"{element.name}.{key.capitalize()}"
        device = key[0].upper()
        spec = DEVICES[device].parameter("value")
        if isinstance(given, Number) and given.value == 0.0 and key != "rpar":
            continue
        value = MappingProxyType({"value": _value(written, spec, given, notes)})
        nodes, names = element.nodes, element.node_names
        if key == "rser":
            inner = written.lower()
            nodes, names = (element.nodes[0], inner), (element.node_names[0], written)
            out[0] = replace(out[0], nodes=(inner, element.nodes[1]), node_names=(written, element.node_names[1]))
        out.append(Element(written, device, nodes, names, value, where=element.where))
    return out


def source_of(statement: Statement, context: Context) -> Source:
    """The source that a V or I element's statement describes.

    Raises
    ------
    InputError
        If the words do not describe a source; the message has the place.
    """
    body = list(statement.body)
    if "wavefile" in statement.params and not any(isinstance(word, Call) for word in body):
        return read_source(statement.name, [*body, _ltspice_wavefile(statement)], context, statement.where)
    last = body[-1] if body else None
    if isinstance(last, Token) and last.text.lower() == "pwl":
        # The brackets of PWL(file=...) may be left out.
        last = Call(last.text, (), {}, {}, last.where)
    if statement.params:
        if not isinstance(last, Call) or last.name.lower() != "pwl" or set(last.params) & set(statement.params):
            key = next(iter(statement.params))
            takes = ", ".join(p.capitalize() for p in _PARASITICS.get(statement.letter, ()))
            hint = f"; allowed: {takes}, besides its value" if takes else ""
            raise InputError(f"{statement.name} takes no parameter {key!r}{hint}", statement.param_where[key])
        # ngspice takes PWL(...) r=10m as well as PWL(... r=10m).
        body[-1] = replace(
            last,
            params={**last.params, **statement.params},
            param_where={**last.param_where, **statement.param_where},
        )
    return read_source(statement.name, body, context, statement.where)


def _ltspice_wavefile(statement: Statement) -> Call:
    """LTspice's ``wavefile=path [chan=n]`` as a call: 1 V at full scale, and the first channel if none is chosen."""
    where = statement.param_where["wavefile"]
    for key in statement.params:
        if key not in ("wavefile", "chan"):
            raise InputError(f"{statement.name} takes no parameter {key!r} beside wavefile=; allowed: chan=",
                             statement.param_where[key])  # fmt: skip
    channel = statement.params.get("chan", Number(0.0, "0", where))
    return Call("wavefile", (statement.params["wavefile"], Number(1.0, "1", where), channel), {}, {}, where)


def _device_values(statement: Statement, device: str, notes: list[str]) -> dict[str, float]:
    known = {p.name: p for p in DEVICES[device].parameters}
    for key in statement.params:
        if key not in known:
            place = statement.param_where[key]
            # On an X line m=... is ngspice's number of copies.
            hint = "; the exponent is m_exp" if key == _COPIES and "m_exp" in known else nearest(key, known)
            raise InputError(
                f"{statement.name}: {device} has no parameter {key!r}{hint}; allowed: {', '.join(known)}", place
            )
    out = {}
    for name, spec in known.items():
        if name in statement.params:
            out[name] = _value(statement.name, spec, statement.params[name], notes)
        elif spec.default is not None:
            out[name] = spec.default
        else:
            unit = f" ({spec.unit})" if spec.unit else ""
            raise InputError(f"{statement.name}: {device} needs {name}{unit}, missing here", statement.where)
    return out


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
    if given.mega is not None and is_resistance(spec):
        notes.append(f"{given.mega.where}: {name} {spec.name}: {mega_note(given.mega.text, given.value, spec)}")
    if exponent_and_scale(given.text):
        notes.append(
            f"{given.where}: {name} {spec.name}: {given.text} is {given.value:g}: exponent and scale both count"
        )
    if not spec.accepts(given.value):
        plain = f"{given.value:g}{unit}"
        written = plain if given.text == f"{given.value:g}" else f"{given.text} ({plain})"
        raise InputError(f"{name} {spec.name} is {written}; allowed: {spec.allowed()}", given.where)
    return given.value


def _passive_value(statement: Statement, notes: list[str]) -> tuple[dict[str, float], float | None]:
    """Value of an R or C, and the start voltage (V) of a C, or None."""
    name, letter = statement.name, statement.letter
    spec = DEVICES[letter].parameter("value")
    own = (*_VALUE_NAMES[letter], _COPIES, *(("ic",) if letter == "C" else ()), *_PART_DATA[letter])
    for key, part in statement.params.items():
        if key == "lser" and isinstance(part, Number) and part.value == 0.0:
            continue
        if key not in own:
            shown = ", ".join(f"{k}=" for k in (*own, *_PARASITICS.get(letter, ())))
            reason = ", there are no inductors here" if key == "lser" else ""
            raise InputError(f"{name} takes no parameter {key!r}{reason}; allowed: {shown}", statement.param_where[key])
    named = [statement.params[key] for key in _VALUE_NAMES[letter] if key in statement.params]
    given = [*statement.body, *named]
    if len(given) != 1:
        raise InputError(f"{name} needs one value in {spec.unit}, {len(given)} are given", statement.where)
    word = given[0]
    if not isinstance(word, Number):
        text = word.text if isinstance(word, Token) else word.name
        raise InputError(f"{name} value is {text!r}; allowed: a number {spec.unit}", word.where)
    value = _value(name, spec, word, notes)
    if _COPIES in statement.params:
        copies = statement.params[_COPIES]
        if not isinstance(copies, Number) or not 1e-6 <= copies.value <= 1e6:
            raise InputError(f"{name} m is {copies.text!r}; allowed: a number of parts side by side", copies.where)
        value = value / copies.value if letter == "R" else value * copies.value
    initial = statement.params.get("ic")
    if isinstance(initial, Token):
        raise InputError(f"{name} IC is {initial.text!r}; allowed: a number V", initial.where)
    start = None if initial is None else start_volts(f"{name} IC", initial)
    return {"value": value}, start
