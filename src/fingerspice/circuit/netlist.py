"""From a deck's statements to a circuit: what devices, parameters and directives mean."""

from __future__ import annotations

import math
import warnings
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType

from fingerspice.circuit.circuit import Circuit, Element, check
from fingerspice.circuit.deck import Call, Deck, Number, Statement, Token, parse_deck, read_deck
from fingerspice.circuit.devices import DEVICES, ParameterSpec
from fingerspice.circuit.directives import (
    read_ac,
    read_initial,
    read_options,
    read_tran,
    start_volts,
    unused_starts,
)
from fingerspice.circuit.expressions import nearest
from fingerspice.circuit.network import build_network
from fingerspice.circuit.sources import Source, Timing, read_source
from fingerspice.circuit.statespace import build_stack, is_stack
from fingerspice.circuit.waveforms import Waveform
from fingerspice.errors import FingerspiceWarning, InputError
from fingerspice.physics.materials import SKIN_BAND
from fingerspice.units import parse_number, suggest_mega, suspicious_mega, unit_read_as_scale

_UNIT_TRAPS = {"F": "farad", "N": "newton"}


def read_netlist(path: str | Path) -> Circuit:
    """Read a circuit from a netlist file.

    Parameters
    ----------
    path : str or Path

    Raises
    ------
    InputError
        When the file cannot be read or anything in it is wrong; the message says where and what is allowed.
    """
    return _circuit(read_deck(path))


def parse_netlist(text: str, path: str | Path | None = None) -> Circuit:
    """Read a circuit from a netlist's text.

    Parameters
    ----------
    text : str
    path : str or Path, optional
        Where the text came from: its folder is the one includes may use.

    Raises
    ------
    InputError
        When anything in it is wrong; the message says where and what is allowed.
    """
    return _circuit(parse_deck(text, None if path is None else Path(path)))


def _circuit(deck: Deck) -> Circuit:
    notes: list[str] = list(deck.warnings)
    try:
        circuit = _read(deck, notes)
    except InputError as error:
        raise _in_deck(error, deck) from None
    for note in notes:
        warnings.warn(note, FingerspiceWarning, stacklevel=3)
    return circuit


def _in_deck(error: InputError, deck: Deck) -> InputError:
    """A refusal with the file where it has no place of its own, and with a title that swallowed a statement."""
    text = error.message if error.where else f"{deck.path or '<netlist>'}: {error.message}"
    title = [note for note in deck.warnings if "the first line is the title" in note]
    return InputError("; note ".join([text, *title]), error.where)


def _read(deck: Deck, notes: list[str]) -> Circuit:
    tran = read_tran(deck.tran) if deck.tran else None
    timing = Timing(tran.step if tran else None, tran.stop if tran else None)
    elements = tuple(_element(statement, timing, notes) for statement in deck.statements)
    work, unused = read_options(deck.options)
    initial = read_initial(deck.ic, elements)
    circuit = Circuit(
        title=deck.title,
        elements=elements,
        tran=tran,
        ac=read_ac(deck.ac) if deck.ac else None,
        initial=initial,
        charge_law=_charge_law(deck.includes),
        work=work,
        warnings=tuple(notes),
        unused=(*deck.unused, *unused, *unused_starts(initial, elements, tran is None or tran.uic)),
        text=deck.text,
        path=deck.path,
    )
    check(circuit)
    if is_stack(circuit):
        build_stack(circuit)
    else:
        build_network(circuit)
    return circuit


def _charge_law(includes: tuple[str, ...]) -> str | None:
    laws = {"mobile" if "mobile" in name.lower() else "local" for name in includes}
    if len(laws) > 1:
        raise InputError("both fingerspice.lib (local law) and fingerspice_mobile.lib (mobile law) are included")
    return laws.pop() if laws else None


def _element(statement: Statement, timing: Timing, notes: list[str]) -> Element:
    values: dict[str, float] = {}
    source, initial = None, None
    if statement.letter == "X":
        device = statement.device or ""
        values = _device_values(statement, device, notes)
    elif statement.letter in "VI":
        device = statement.letter
        source = _source(statement, timing)
        notes.extend(source.notes)
    else:
        device = statement.letter
        values, initial = _passive_value(statement, notes)
    return Element(
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


def _source(statement: Statement, timing: Timing) -> Source:
    body = list(statement.body)
    if statement.params:
        last = body[-1] if body else None
        if not isinstance(last, Call) or last.name.lower() != "pwl" or set(last.params) & set(statement.params):
            key = next(iter(statement.params))
            raise InputError(f"{statement.name} takes no parameter {key!r}", statement.param_where[key])
        # ngspice takes PWL(...) r=10m as well as PWL(... r=10m).
        body[-1] = replace(
            last,
            params={**last.params, **statement.params},
            param_where={**last.param_where, **statement.param_where},
        )
    return read_source(statement.name, body, timing, statement.where)


def _device_values(statement: Statement, device: str, notes: list[str]) -> dict[str, float]:
    known = {p.name: p for p in DEVICES[device].parameters}
    for key in statement.params:
        if key not in known:
            place = statement.param_where[key]
            # ngspice reads m=... on an X line as so many copies.
            hint = "; the exponent is m_exp" if key == "m" and "m_exp" in known else nearest(key, known)
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
    if device == "SKIN" and not SKIN_BAND[0] <= out["f"] <= SKIN_BAND[1]:
        notes.append(
            f"{statement.where}: {statement.name} f = {out['f']:g} Hz is outside 10 Hz to 100 kHz, where the data of "
            "Eqs. 18 and 19 were measured"
        )
    return out


def _value(name: str, spec: ParameterSpec, given: Number | Token, notes: list[str]) -> float:
    """One parameter's number, with the unit traps of SPICE caught."""
    unit = f" {spec.unit}" if spec.unit else ""
    if isinstance(given, Token):
        if spec.may_be_infinite and given.text.lower() in ("inf", "none"):
            return math.inf
        raise InputError(f"{name} {spec.name} is {given.text!r}; allowed: a number{unit}", given.where)
    trap = _unit_trap(spec, given.text)
    if trap:
        raise InputError(f"{name} {spec.name} {trap}", given.where)
    if given.mega is not None and spec.unit in ("ohm", "ohm m"):
        notes.append(f"{given.mega.where}: {name} {spec.name}: {_mega_note(given.mega.text, given.value, spec)}")
    if not spec.accepts(given.value):
        plain = f"{given.value:g}{unit}"
        written = plain if given.text == f"{given.value:g}" else f"{given.text} ({plain})"
        raise InputError(f"{name} {spec.name} is {written}; allowed: {spec.allowed()}", given.where)
    return given.value


def _unit_trap(spec: ParameterSpec, text: str) -> str | None:
    """Why a number whose unit SPICE takes for a scale is refused."""
    word = _UNIT_TRAPS.get(spec.unit)
    if not word or not unit_read_as_scale(text, spec.unit, word):
        return None
    prefix = {"F": "femto (1e-15)", "N": "nano (1e-9)"}[spec.unit]
    return f"is {text!r}: SPICE reads {spec.unit} as {prefix}; write the number alone, in {word}"


def _mega_note(text: str, value: float, spec: ParameterSpec) -> str:
    """What to say where a resistance holds a capital M."""
    return (
        f"{text!r} is milli ({value:g} {spec.unit}), as everywhere in SPICE; for mega{spec.unit.partition(' ')[0]} "
        f"write {suggest_mega(text)}"
    ).replace("megaohm", "megohm")


def value_from_text(circuit: Circuit, path: str, text: str) -> tuple[float, str | None]:
    """A parameter's new value from text such as ``3u``, the unit traps of the netlist caught; and a warning.

    Parameters
    ----------
    circuit : Circuit
    path : str
        Such as ``Xgap.d``; of an unknown path only the number is read.
    text : str

    Raises
    ------
    InputError
        When the text is not a number, or its unit is one that SPICE takes for a scale.
    """
    if text.lower() in ("inf", "none"):
        return math.inf, None
    try:
        value = parse_number(text)
    except ValueError as error:
        raise InputError(str(error)) from None
    name, _, parameter = path.lower().rpartition(".")
    element = next((e for e in circuit.elements if e.name.lower() == name), None)
    spec = next((p for p in element.spec.parameters if p.name == parameter), None) if element else None
    if spec is None:
        return value, None
    trap = _unit_trap(spec, text)
    if trap:
        raise InputError(f"{path} {trap}")
    mega = spec.unit in ("ohm", "ohm m") and suspicious_mega(text)
    return value, f"{path}: {_mega_note(text, value, spec)}" if mega else None


def _passive_value(statement: Statement, notes: list[str]) -> tuple[dict[str, float], float | None]:
    name, letter = statement.name, statement.letter
    spec = DEVICES[letter].parameter("value")
    allowed = {"R": (), "C": ("ic",)}[letter]
    for key in statement.params:
        if key not in allowed:
            raise InputError(f"{name} takes no parameter {key!r}", statement.param_where[key])
    if len(statement.body) != 1:
        raise InputError(f"{name} needs one value in {spec.unit}", statement.where)
    word = statement.body[0]
    if not isinstance(word, Number):
        text = word.text if isinstance(word, Token) else word.name
        raise InputError(f"{name} value is {text!r}; allowed: a number {spec.unit}", word.where)
    initial = statement.params.get("ic")
    if isinstance(initial, Token):
        raise InputError(f"{name} IC is {initial.text!r}; allowed: a number V", initial.where)
    start = None if initial is None else start_volts(f"{name} IC", initial)
    return {"value": _value(name, spec, word, notes)}, start


def source_from_text(text: str, circuit: Circuit) -> Waveform:
    """A waveform from netlist text such as ``SQUARE(200 100)``, with SPICE's defaults from the circuit's .tran.

    Raises
    ------
    InputError
        When the text is not a source.
    """
    tran = circuit.tran
    line = f".tran {tran.step!r} {tran.stop!r}\n" if tran else ""
    timing = Timing(tran.step if tran else None, tran.stop if tran else None)
    try:
        deck = parse_deck(f"source\nVsource a 0 {text}\n{line}")
        if len(deck.statements) != 1 or deck.statements[0].params:
            raise InputError("not one source; allowed: such as SQUARE(200 100)")
        source = read_source("source", deck.statements[0].body, timing, deck.statements[0].where)
        if source.ac is not None:
            raise InputError("AC belongs into the deck; allowed: the source function alone, whose fundamental drives")
        return source.waveform
    except InputError as error:
        raise InputError(f"{text!r}: {error.message}") from None
