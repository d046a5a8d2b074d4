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
from fingerspice.units import suggest_mega, unit_read_as_scale

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
    tran = _tran(deck.tran) if deck.tran else None
    timing = Timing(tran.step if tran else None, tran.stop if tran else None)
    elements = tuple(_element(statement, timing, notes) for statement in deck.statements)
    work, unused = _options(deck.options)
    circuit = Circuit(
        title=deck.title,
        elements=elements,
        tran=tran,
        ac=_ac(deck.ac) if deck.ac else None,
        initial=_initial(deck.ic, {e.nodes[2] for e in elements if e.spec.is_layer}),
        charge_law=_charge_law(deck.includes),
        work=work,
        warnings=tuple(notes),
        unused=(*deck.unused, *unused),
        text=deck.text,
        path=deck.path,
    )
    check(circuit)
    build_stack(circuit)
    for note in notes:
        warnings.warn(note, FingerspiceWarning, stacklevel=3)
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
            raise InputError(
                f"{device} has no parameter {key!r}{nearest(key, known)}; allowed: {', '.join(known)}", place
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
    _catch_traps(name, spec, given, notes)
    if not spec.accepts(given.value):
        raise InputError(
            f"{name} {spec.name} is {given.text}{unit} ({given.value:g}{unit}); allowed: {spec.allowed()}",
            given.where,
        )
    return given.value


def _catch_traps(name: str, spec: ParameterSpec, given: Number, notes: list[str]) -> None:
    word = _UNIT_TRAPS.get(spec.unit)
    if word and unit_read_as_scale(given.text, spec.unit, word):
        prefix = {"F": "femto (1e-15)", "N": "nano (1e-9)"}[spec.unit]
        raise InputError(
            f"{name} {spec.name} is {given.text!r}: SPICE reads {spec.unit} as {prefix}; write the number alone, in "
            f"{word}",
            given.where,
        )
    if spec.unit == "ohm" and given.mega is not None:
        mega = given.mega
        notes.append(
            f"{mega.where}: {name} {spec.name}: {mega.text!r} is milli ({given.value:g} ohm), as everywhere in SPICE; "
            f"for megohm write {suggest_mega(mega.text)}"
        )


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


def _initial(directives: tuple[Directive, ...], area_nodes: set[str]) -> dict[str, float]:
    out = {}
    for directive in directives:
        for key, value in directive.params.items():
            place = directive.param_where[key]
            if not (key.startswith("v(") and key.endswith(")")):
                raise InputError(f".ic {key!r} is not understood; allowed: .ic v(node)=value", place)
            if not isinstance(value, Number):
                raise InputError(f".ic {key} is {value.text!r}; allowed: a number V", place)
            node = key[2:-1].strip()
            node = "0" if node == "gnd" else node
            # ngspice needs a start value for the area; here the area follows from the state.
            if node not in area_nodes:
                out[node] = value.value
    return out


def _options(directives: tuple[Directive, ...]) -> tuple[str, tuple[str, ...]]:
    """The reading of Eq. 7, and the ngspice options that have no meaning here."""
    work, unused = "gap", []
    for directive in directives:
        names: list[tuple[str, Number | Token | None, Where]] = [
            (key, value, directive.param_where[key]) for key, value in directive.params.items()
        ]
        names += [(a.text.lower(), None, a.where) for a in directive.args if isinstance(a, Token)]
        for key, value, place in names:
            if key == "work":
                text = value.text.lower() if value is not None else ""
                if text not in WORK_READINGS:
                    raise InputError(f".options work is {text!r}; allowed: {' or '.join(WORK_READINGS)}", place)
                work = text
            elif key in _NGSPICE_OPTIONS:
                unused.append(f".options {key}")
            else:
                raise InputError(f"unknown option {key!r}{nearest(key, [*_NGSPICE_OPTIONS, 'work'])}", place)
    return work, tuple(dict.fromkeys(unused))


def source_from_text(text: str, circuit: Circuit) -> Waveform:
    """A waveform from netlist text such as ``SQUARE(200 100)``, with SPICE's defaults from the circuit's .tran.

    Raises
    ------
    InputError
        When the text is not a source.
    """
    tran = circuit.tran
    line = f".tran {tran.step!r} {tran.stop!r}\n" if tran else ""
    deck = parse_deck(f"source\nVsource a 0 {text}\n{line}", Path("--source"))
    if len(deck.statements) != 1:
        raise InputError(f"--source {text!r} is not one source")
    timing = Timing(tran.step if tran else None, tran.stop if tran else None)
    return read_source("--source", deck.statements[0].body, timing, deck.statements[0].where)


def sweep_from_text(text: str) -> AcSweep:
    """A sweep from text such as ``dec 10 10 100k``.

    Raises
    ------
    InputError
        When the text is not a sweep.
    """
    deck = parse_deck(f"sweep\n.ac {text}\n", Path("--sweep"))
    if deck.ac is None:
        raise InputError(f"--sweep {text!r} is not understood; allowed: DEC|OCT|LIN N FSTART FSTOP")
    return _ac(deck.ac)
