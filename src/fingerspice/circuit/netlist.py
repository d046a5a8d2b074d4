"""From a deck's statements to a circuit: what devices, parameters and directives mean."""

from __future__ import annotations

import math
import warnings
from pathlib import Path
from types import MappingProxyType
from typing import Literal

from fingerspice.circuit.circuit import WORK_READINGS, AcSweep, Circuit, Element, Tran, check
from fingerspice.circuit.deck import Deck, Directive, Number, Statement, Token, parse_deck, read_deck
from fingerspice.circuit.devices import DEVICES, LATER, ParameterSpec
from fingerspice.circuit.expressions import nearest
from fingerspice.circuit.sources import Timing, read_source
from fingerspice.circuit.statespace import build_stack
from fingerspice.circuit.waveforms import Waveform
from fingerspice.errors import FingerspiceWarning, InputError, Where
from fingerspice.physics.materials import SKIN_BAND
from fingerspice.units import parse_number, suggest_mega, suspicious_mega, unit_read_as_scale

_UNIT_TRAPS = {"F": "farad", "N": "newton"}
_NGSPICE_OPTIONS = frozenset(
    """abstol acct bypass chgtol defad defas defl defw gmin gminsteps interp itl1 itl2 itl3 itl4 itl5 itl6 keepopinfo
    klu list maxevtiter maxopalter maxord method minbreak noacct noinit nomod nopage node noopalter numdgt opts
    pivrel pivtol ramptime reltol rshunt savecurrents seed seedinfo sparse srcsteps temp tnom trtol trytocompact
    vntol warn xmu""".split()  # noqa: SIM905
)


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
    tran = _tran(deck.tran) if deck.tran else None
    timing = Timing(tran.step if tran else None, tran.stop if tran else None)
    elements = tuple(_element(statement, timing, notes) for statement in deck.statements)
    work, unused = _options(deck.options)
    circuit = Circuit(
        title=deck.title,
        elements=elements,
        tran=tran,
        ac=_ac(deck.ac) if deck.ac else None,
        initial=_initial(deck.ic, elements),
        charge_law=_charge_law(deck.includes),
        work=work,
        warnings=tuple(notes),
        unused=(*deck.unused, *unused),
        text=deck.text,
        path=deck.path,
    )
    check(circuit)
    build_stack(circuit)
    return circuit


def _charge_law(includes: tuple[str, ...]) -> str | None:
    laws = {"mobile" if "mobile" in name.lower() else "local" for name in includes}
    if len(laws) > 1:
        raise InputError("both fingerspice.lib (local law) and fingerspice_mobile.lib (mobile law) are included")
    return laws.pop() if laws else None


def _element(statement: Statement, timing: Timing, notes: list[str]) -> Element:
    values: dict[str, float] = {}
    waveform, initial = None, None
    if statement.letter == "X":
        device = statement.device or ""
        if (device, "") in LATER:
            raise InputError(
                f"{statement.name}: {device} ({LATER[device, '']}) is not simulated by this version",
                statement.where,
            )
        values = _device_values(statement, device, notes)
    elif statement.letter in "VI":
        device = statement.letter
        if statement.params:
            key = next(iter(statement.params))
            raise InputError(f"{statement.name} takes no parameter {key!r}", statement.param_where[key])
        waveform = read_source(statement.name, statement.body, timing, statement.where)
    else:
        device = statement.letter
        values, initial = _passive_value(statement, notes)
    return Element(
        statement.name,
        device,
        statement.nodes,
        statement.node_names,
        MappingProxyType(values),
        waveform,
        initial,
        statement.where,
    )


def _device_values(statement: Statement, device: str, notes: list[str]) -> dict[str, float]:
    known = {p.name: p for p in DEVICES[device].parameters}
    for key in statement.params:
        if key not in known:
            place = statement.param_where[key]
            if (device, key) in LATER:
                raise InputError(
                    f"{statement.name} {key} ({LATER[device, key]}) is not simulated by this version", place
                )
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
    return {"value": _value(name, spec, word, notes)}, None if initial is None else initial.value


def _numbers(directive: Directive, usage: str) -> tuple[list[Number], list[str]]:
    """Numbers and bare words of a directive's line."""
    numbers: list[Number] = []
    words: list[str] = []
    for arg in directive.args:
        if isinstance(arg, Number):
            numbers.append(arg)
        elif isinstance(arg, Token):
            words.append(arg.text.lower())
        else:
            raise InputError(f"{directive.name}: {arg.name!r} is not understood; allowed: {usage}", arg.where)
    if directive.params:
        key = next(iter(directive.params))
        raise InputError(f"{directive.name} takes no {key!r}; allowed: {usage}", directive.param_where[key])
    return numbers, words


def _tran(directive: Directive) -> Tran:
    usage = ".tran TSTEP TSTOP [TSTART [TMAX]] [uic]"
    numbers, words = _numbers(directive, usage)
    if any(w != "uic" for w in words) or not 2 <= len(numbers) <= 4:
        raise InputError(f"{directive.text.strip()!r} is not understood; allowed: {usage}", directive.where)
    step, stop = numbers[0], numbers[1]
    start = numbers[2] if len(numbers) > 2 else None
    longest = numbers[3] if len(numbers) > 3 else None
    _require(step.value > 0.0, "TSTEP", step, "more than 0 s")
    _require(stop.value > 0.0, "TSTOP", stop, "more than 0 s")
    _require(step.value <= stop.value, "TSTEP", step, f"at most TSTOP = {stop.text} (the output step comes first)")
    _require(start is None or 0.0 <= start.value < stop.value, "TSTART", start, f"0 to TSTOP = {stop.text}")
    _require(longest is None or longest.value > 0.0, "TMAX", longest, "more than 0 s")
    _require(
        (stop.value - (start.value if start else 0.0)) / step.value <= 1e8,
        "TSTEP",
        step,
        "at most 1e8 output steps in a run",
    )
    return Tran(
        step.value,
        stop.value,
        start.value if start else 0.0,
        longest.value if longest else None,
        "uic" in words,
    )


def _require(condition: bool, what: str, given: Number | None, allowed: str) -> None:
    if not condition:
        assert given is not None
        raise InputError(f"{what} is {given.text}; allowed: {allowed}", given.where)


def _ac(directive: Directive) -> AcSweep:
    usage = ".ac DEC|OCT|LIN N FSTART FSTOP"
    numbers, words = _numbers(directive, usage)
    if len(words) != 1 or words[0] not in ("dec", "oct", "lin") or len(numbers) != 3:
        raise InputError(f"{directive.text.strip()!r} is not understood; allowed: {usage}", directive.where)
    n, low, high = numbers
    _require(n.value >= 1 and n.value == int(n.value) and n.value <= 1e6, "N", n, "a whole number, 1 to 1e6")
    _require(low.value > 0.0, "FSTART", low, "more than 0 Hz")
    _require(high.value >= low.value, "FSTOP", high, f"at least FSTART = {low.text}")
    scale: Literal["dec", "oct", "lin"] = words[0]  # type: ignore[assignment]
    return AcSweep(scale, int(n.value), low.value, high.value)


def _initial(directives: tuple[Directive, ...], elements: tuple[Element, ...]) -> dict[str, float]:
    usage = "allowed: .ic v(node)=value"
    nodes = list(dict.fromkeys(node for e in elements for node in e.nodes))
    area_nodes = {e.nodes[2] for e in elements if e.spec.is_layer}
    out: dict[str, float] = {}
    for directive in directives:
        if directive.args or not directive.params:
            raise InputError(f"{directive.text.strip()!r} is not understood; {usage}", directive.where)
        for key, value in directive.params.items():
            place = directive.param_where[key]
            if not (key.startswith("v(") and key.endswith(")")):
                raise InputError(f".ic {key!r} is not understood; {usage}", place)
            if not isinstance(value, Number):
                raise InputError(f".ic {key} is {value.text!r}; allowed: a number V", place)
            node = key[2:-1].strip()
            node = "0" if node == "gnd" else node
            if node not in nodes:
                raise InputError(f".ic names node {node!r}, which is not in the circuit{nearest(node, nodes)}", place)
            if node in out:
                raise InputError(f".ic gives node {node!r} twice", place)
            if node == "0" and value.value != 0.0:
                raise InputError(f".ic {key} is {value.text} V; allowed: 0, it is ground", place)
            # ngspice needs a start value for the area; here the area follows from the state.
            if node not in area_nodes:
                out[node] = value.value
    return out


def _options(directives: tuple[Directive, ...]) -> tuple[str, tuple[str, ...]]:
    """The reading of Eq. 7, and the ngspice options that have no meaning here."""
    work, unused = None, []
    for directive in directives:
        names: list[tuple[str, Number | Token | None, Where]] = [
            (key, value, directive.param_where[key]) for key, value in directive.params.items()
        ]
        for arg in directive.args:
            if not isinstance(arg, Token):
                text = arg.text if isinstance(arg, Number) else arg.name
                raise InputError(f".options {text!r} is not understood; allowed: .options name=value", arg.where)
            names.append((arg.text.lower(), None, arg.where))
        for key, value, place in names:
            if key == "work":
                text = value.text.lower() if value is not None else ""
                if text not in WORK_READINGS:
                    raise InputError(f".options work is {text!r}; allowed: {' or '.join(WORK_READINGS)}", place)
                if work not in (None, text):
                    raise InputError(f".options work is given twice, first {work}, then {text}", place)
                work = text
            elif key in _NGSPICE_OPTIONS:
                unused.append(f".options {key}")
            else:
                hint = nearest(key, [*_NGSPICE_OPTIONS, "work"])
                known = f"work={'|'.join(WORK_READINGS)}, and ngspice's own, which have no effect here"
                raise InputError(f"unknown option {key!r}{hint}; allowed: {known}", place)
    return work or "gap", tuple(dict.fromkeys(unused))


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
        return read_source("source", deck.statements[0].body, timing, deck.statements[0].where)
    except InputError as error:
        raise InputError(f"{text!r}: {error.message}") from None


def sweep_from_text(text: str) -> AcSweep:
    """A sweep from text such as ``dec 10 10 100k``.

    Raises
    ------
    InputError
        When the text is not a sweep.
    """
    try:
        deck = parse_deck(f"sweep\n.ac {text}\n")
        if deck.ac is None:
            raise InputError("not a sweep")
        return _ac(deck.ac)
    except InputError as error:
        raise InputError(f"{text!r}: {error.message}") from None
