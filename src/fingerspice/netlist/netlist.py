"""Reading of a netlist, from a file or a text, into a `Circuit`: what its statements and directives mean."""

from __future__ import annotations

import math
import os
import warnings
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

from fingerspice.base.errors import FingerspiceWarning, InputError, Where
from fingerspice.base.units import exponent_and_scale, format_si
from fingerspice.circuit.circuit import WORK_READINGS, AcSweep, Circuit, Element, Step, Tran
from fingerspice.circuit.devices import DEVICES, REST_AREA, ParameterSpec, check, mega_note, unit_trap, unusual
from fingerspice.circuit.laws import ContactLaw, law_of
from fingerspice.circuit.measures import Measure, Quantity
from fingerspice.circuit.network import checked
from fingerspice.netlist.deck import parse_deck, with_comma
from fingerspice.netlist.expressions import Call, Number, Token, Value, number
from fingerspice.netlist.lexer import decimal_comma, is_unit, nearest
from fingerspice.netlist.measures import checked_steps, read_dc, read_fourier, read_measure, read_saved, read_step
from fingerspice.netlist.reader import MAX_WARNINGS, OTHERS, Context, Deck, Statement, text_of
from fingerspice.netlist.sources import read_source
from fingerspice.waveforms.waveform import DC, Waveform, check_range, refuse

_REFERENCE = 27.0  #: Temperature (°C) at which values are meant.
_MODELLED = {"SW": "S", "R": "R", "RES": "R", "C": "C", "CAP": "C"}  #: Types of models, each with its element.
_COPIES = "m"  #: The parameter that gives the number of equal parts in parallel.
LTSPICE_OUTPUTS = 10_000  #: Number of outputs of a run whose .tran has no TSTEP.
_NGSPICE_OPTIONS, _LTSPICE_OPTIONS = (OTHERS["options"][name].split() for name in ("ngspice", "ltspice"))


def read_netlist(path: str | Path) -> Circuit:
    """Read a circuit from a netlist file.

    Parameters
    ----------
    path : str or Path
        A file, or ``-`` for standard input.

    Raises
    ------
    InputError
        If the file cannot be read or has an error; the message gives its place and the allowed alternatives.
    """
    problem = f"read_netlist is given {path!r}; allowed: the path of a netlist, such as 'deck.cir'"
    refuse(not isinstance(path, str | os.PathLike), problem)
    return _circuit(parse_deck(*text_of(Path(path))))


def parse_netlist(text: str, path: str | Path | None = None) -> Circuit:
    """Read a circuit from the text of a netlist.

    Parameters
    ----------
    text : str
    path : str or Path, optional
        Path of the file with this text; the text may include files from its folder.

    Raises
    ------
    InputError
        If the text has an error; the message gives its place and the allowed alternatives.
    """
    if not isinstance(text, str):
        raise InputError(f"parse_netlist is given {text!r}; allowed: a netlist's text, whose first line is the title")
    if "\n" not in text.strip() and text.strip().lower().endswith((".cir", ".net", ".sp")):
        raise InputError(f"parse_netlist is given {text.strip()!r}, a file's name; allowed: read_netlist for a file")
    return _circuit(parse_deck(text, None if path is None else Path(path)))


def _circuit(deck: Deck) -> Circuit:
    """The circuit of a deck; an error without a place gets the deck's name, and a note if the title is a statement."""
    try:
        circuit = _read(deck, list(deck.warnings))
    except InputError as error:
        told = with_comma(error, deck.warnings)
        text = told.message if told.where else f"{deck.file}: {told.message}"
        title = [note for note in deck.warnings if "the first line is the title" in note]
        raise InputError("; note ".join([text, *title]), told.where) from None
    for note in circuit.warnings:
        warnings.warn(note, FingerspiceWarning, stacklevel=3)
    return circuit


def _read(deck: Deck, notes: list[str]) -> Circuit:
    tran = next((read_tran(directive, notes) for directive in deck.directives[".tran"]), None)
    models = read_models(deck.directives[".model"])
    context = Context(tran, None if deck.path is None else deck.path.parent, models=models, warmer=_warmer(deck))
    elements = tuple(e for statement in deck.statements for e in read_elements(statement, context, notes))
    work, unused = read_options(deck.directives[".options"])
    initial, unused_starts = read_start(deck.directives[".ic"], elements, tran is None or tran.uic)
    notes.extend(_unusual(deck, elements, tran, initial))
    more = len(notes) - MAX_WARNINGS
    if more > 1:
        notes[MAX_WARNINGS:] = [f"{more} more warnings are not shown"]
    laws = {"mobile" if "mobile" in name.lower() else "local" for name in deck.libraries}
    ac, measures = next(map(read_ac, deck.directives[".ac"]), None), list[Measure]()
    saved, fourier, steps, dc = list[Quantity](), list[tuple[float, Quantity]](), list[Step](), tuple[Step, ...]()
    for name, line, start in deck.asked:
        match name:
            case ".four":
                fourier += read_fourier(line, start, deck.params, elements)
            case ".save" | ".probe" | ".print":
                saved += read_saved(line, start, deck.params, elements, notes)
            case ".step":
                steps.append(read_step(line, start, deck.params, elements))
            case ".dc":
                refuse(dc, ".dc is given twice; allowed: one line, with two that are swept", line.where())
                dc = read_dc(line, start, deck.params, elements)
            case ".meas" | ".measure":
                measures.append(read_measure(line, start, deck.params, elements, measures))
    refuse(len(laws) > 1, "both fingerspice.lib (local law) and fingerspice_mobile.lib (mobile law) are included")
    law, said, effectless = next(iter(laws), None), tuple(notes), (*deck.unused, *unused, *unused_starts)
    read = deck.title, elements, tran, ac, initial, law, work, said, effectless, deck.text, deck.path
    wanted: dict[str, Any] = {"measures": tuple(measures), "fourier": tuple(fourier), "saved": tuple(saved)}
    stepped, op = checked_steps(steps, ".step"), any(name == ".op" for name, _, _ in deck.asked)
    return checked(Circuit(*read, **wanted, steps=stepped, dc=checked_steps(dc, ".dc"), op=op))


def at_parameters(circuit: Circuit, values: Mapping[str, float]) -> Circuit:
    """The circuit with other values of its deck's `.param` lines; what `replace` has changed stays changed.

    Raises
    ------
    InputError
        If the deck cannot be read with these values, or has other elements then.
    """

    def read(given: Mapping[str, float]) -> Circuit:
        return _read(parse_deck(circuit.text, circuit.path, given), [])

    old, new = circuit.related.remember(("deck as it is",), lambda: read({})), read(values)
    said = ", ".join(f"{name} = {value:g}" for name, value in values.items())
    alike = [e.name for e in old.elements] == [e.name for e in new.elements]
    refuse(not alike, f"with {said} the deck has other elements; allowed: values with which they stay")
    elements = []
    for was, own, now in zip(old.elements, circuit.elements, new.elements, strict=True):
        mine = {key: value for key, value in own.values.items() if was.values.get(key) != value}
        kept: dict[str, Any] = {"values": MappingProxyType({**now.values, **mine})}
        kept |= {
            name: getattr(own, name) for name in ("waveform", "ac", "law") if getattr(own, name) != getattr(was, name)
        }
        elements.append(own if was == now else replace(now, **kept))
    same = {name: getattr(new, name) for name in ("tran", "ac", "initial", "measures", "fourier")
            if getattr(circuit, name) == getattr(old, name)}  # fmt: skip
    changed = circuit._with(elements=tuple(elements), **same)
    check(changed)
    return changed


def _unusual(deck: Deck, elements: tuple[Element, ...], tran: Tran | None, initial: dict[str, float]) -> Iterator[str]:
    """Warnings about unusual areas given by start values or sources, and outputs too far apart for a source."""
    nodes = {e.nodes[2] for e in elements if e.spec.is_layer}
    areas = [("", f".ic v({node})", value) for node, value in initial.items() if node in nodes]
    for e in elements:
        if e.device == "V" and e.nodes[0] in nodes and isinstance(e.waveform, DC):
            areas.append((f"{e.where}: ", f"{e.name}, an area,", e.waveform.level))
    for place, what, area in areas:
        if text := REST_AREA.warning(what, area, "mm^2"):
            yield f"{place}{text}"
    for e in elements if tran is not None else ():
        period = e.waveform.period if e.waveform is not None else None
        # A source whose frequency is unusual has a warning already.
        if tran is not None and period is not None and tran.step > period * (1.0 + 1e-9) and not any(unusual(e)):
            step, longest = format_si(tran.step, "s"), format_si(period, "s")
            place = str(deck.directives[".tran"][0].where)
            note = f"{place}: {e.name}: TSTEP is {step}, longer than this source's period of {longest}"
            yield f"{note}: the outputs do not show its course, and the figures of a run still do"


def source_from_text(text: str, circuit: Circuit, *, files: bool = True) -> Waveform:
    """A waveform from netlist text such as ``SQUARE(200 100)`` or ``WAVEFILE(a.wav 150)``.

    SPICE's defaults come from the circuit's .tran, and file names are relative to the working directory. Without
    `files`, for a text from elsewhere, no file is read.
    """
    context, notes = Context(circuit.tran, in_deck=False, anywhere=files), list[str]()
    try:
        deck = parse_deck(f"source\nVsource a 0 {text}\n")
        refuse(len(deck.statements) != 1 or deck.directives, "not one source; allowed: such as SQUARE(200 100)")
        waveform, ac = read_source(deck.statements[0]._replace(name="source"), context, notes)
        refuse(ac is not None, "AC belongs into the deck; allowed: the source function alone, whose fundamental drives")
    except InputError as error:
        comma = decimal_comma(f"V1 a 0 {text}")
        raise InputError(f"{text!r}: {error.message}" + (f"; note {comma}" if comma else "")) from None
    for note in (*deck.warnings, *notes):
        # A note begins with a place in the one-source deck made here, which the user does not know: cut it off.
        warnings.warn(f"{text!r}: {note.partition(': ')[2]}", FingerspiceWarning, stacklevel=2)
    return waveform


def sweep_from_text(text: str) -> AcSweep:
    """A sweep from text such as ``dec 10 10 100k``."""
    try:
        sweeps = parse_deck(f"sweep\n.ac {text}\n").directives[".ac"]
        refuse(not sweeps, "not a sweep")
        return read_ac(sweeps[0])
    except InputError as error:
        raise InputError(f"{text!r}: {error.message}") from None


def read_elements(statement: Statement, context: Context, notes: list[str]) -> list[Element]:
    """The element of a statement, and those for LTspice's ``Rser``, ``Rpar`` and ``Cpar``; `notes` gets warnings."""
    name, device, nodes, names, _, params, where, control = statement
    beside = {key: params[key] for key in DEVICES[device].beside if key in params}
    own = statement._replace(params={k: v for k, v in params.items() if k not in beside})
    read: dict[str, Any] = {"control": control} if control else {}
    values: dict[str, float] = {}
    if device in "VI":
        read["waveform"], read["ac"] = read_source(own, context, notes)
    elif device == "S":
        values = _device_values(_modelled(own, context), None, notes)
    elif DEVICES[device].cells is None:
        own = _of_model(own, context) if device in "RC" else own
        values, read["initial"] = _read_passive(own, context.warmer, notes)
    else:
        if device == "GAP" and "law" in own.params:
            read["law"] = _law(own)
        values = _device_values(own, read.get("law"), notes)
    element = Element(name, device, nodes, names, MappingProxyType(values), where=where, **read)
    for parameter, text in unusual(element):
        given = statement.body[0] if statement.body and parameter in values else params.get(parameter)
        # One warning per number is enough.
        if not (isinstance(given, Number) and any(_doubts(given, element.spec.parameter(parameter)))):
            notes.append(f"{where if given is None else given.where}: {text}")
    out = [element]
    for key, part in beside.items():
        if isinstance(part, Number) and part.value == 0.0 and key != "rpar":
            continue
        written, kind = f"{name}.{key.capitalize()}", key[0].upper()
        value = MappingProxyType({"value": _value(written, DEVICES[kind].parameter("value"), part, notes)})
        ends, ends_written = nodes, names
        if key == "rser":
            inner = written.lower()
            ends, ends_written = (nodes[0], inner), (names[0], written)
            out[0] = replace(element, nodes=(inner, nodes[1]), node_names=(written, names[1]))
        out.append(Element(written, kind, ends, ends_written, value, where=where))
    return out


def read_models(directives: list[Call]) -> dict[str, Call]:
    """``.model NAME SW(key=value ...)``, brackets or not, and of R and C: parameters by name in lower case."""
    out: dict[str, Call] = {}
    for one in directives:
        name, kind = (*one.args, None, None)[:2]
        usage = "allowed: .model NAME SW(Ron=1 Roff=1meg Vt=2.5 Vh=0), .model NAME R(tc1=1m tc2=1u), or C"
        device = _MODELLED.get(kind.text.upper()) if kind is not None and len(one.args) == 2 else None
        if device is None or not isinstance(name, Token):
            raise InputError(f"{one.line.strip()!r} is not supported; {usage}", one.where)
        refuse(name.text.lower() in out, f".model {name.text} is given twice", one)
        out[name.text.lower()] = Call(device, (), kind.params if isinstance(kind, Call) else one.params, one.where)
    return out


def _of_model(statement: Statement, context: Context) -> Statement:
    """The statement of an R or C with the parameters of the model that it may name, of which its own come first."""
    words = [word for word in statement.body if isinstance(word, Token) and word.text.lower() in context.models]
    for word in words:
        model = context.models[word.text.lower()]
        wrong = model.text != statement.device or len(words) > 1
        refuse(wrong, f"{statement.name} is of the model {word.text}, which is of a {model.text}", word)
        body = tuple(one for one in statement.body if one is not word)
        own = {key: part for key, part in model.params.items() if not (body and key == statement.device.lower())}
        statement = statement._replace(body=body, params=own | statement.params)
    return statement


def _warmed(statement: Statement, warmer: float) -> float:
    """The factor on a value whose coefficients are `tc1` (1/K) and `tc2` (1/K^2), warmer than the reference by K."""
    name, params = statement.name, statement.params
    first, second = (number(params[key], f"{name} {key}").value if key in params else 0.0 for key in ("tc1", "tc2"))
    factor = 1.0 + first * warmer + second * warmer**2
    said = f"{name} is {factor:.4g} times its value where it is {warmer:g} K warmer; allowed: more than 0"
    refuse(not factor > 0.0, said, statement)
    return factor


def _warmer(deck: Deck) -> float:
    """How much warmer the deck is than its values' reference, by `.temp` and the options `temp` and `tnom`, K."""
    found = {"temp": _REFERENCE, "tnom": _REFERENCE}
    for key, value in [pair for one in deck.directives[".options"] for pair in one.params.items() if pair[0] in found]:
        # PySpice writes its unit, too.
        plain = value.text.lower().removesuffix("c").removesuffix("°")
        try:
            found[key] = value.value if isinstance(value, Number) else float(plain)
        except ValueError:
            raise InputError(f".options {key} is {value.text!r}; allowed: a number, in °C", value.where) from None
    for one in deck.directives[".temp"]:
        values, words = _numbers(one, ".temp 50")
        refuse(len(values) != 1 or words, f"{one.line.strip()!r} is not understood; allowed: .temp 50, in °C", one)
        found["temp"] = values[0].value
    return found["temp"] - found["tnom"]


def _modelled(statement: Statement, context: Context) -> Statement:
    """The statement of a switch with the parameters of the model that it names."""
    words, known = [word.text for word in statement.body], context.models
    plain = words[:1] and [x.lower() for x in words[1:]] in ([], ["off"]) and not statement.params
    refuse(not plain, f"{statement.name} needs the name of a .model, and no more but OFF", statement)
    missing = f"{statement.name} names the .model {words[0]!r}, which is missing{nearest(words[0], known) or ''}"
    refuse(words[0].lower() not in known, missing, statement)
    return statement._replace(params=known[words[0].lower()].params)


def _law(statement: Statement) -> ContactLaw | None:
    given = statement.params.pop("law")
    try:
        return law_of(given.text)
    except InputError as error:
        raise InputError(f"{statement.name}: {error.message}", given.where) from None


def _device_values(statement: Statement, law: ContactLaw | None, notes: list[str]) -> dict[str, float]:
    name, device, params, where = statement.name, statement.device, statement.params, statement.where
    refuse(statement.nodes[2:3] == ("0",), f"{name} has ground as its area; allowed: the area node of a GAP", where)
    known = {p.name: p for p in (DEVICES[device] if law is None else law.spec).parameters}
    under = "" if law is None else f" with law={law.name}"
    for key, given in params.items():
        if key not in known:
            # On an X line m=... is ngspice's number of copies.
            hint = "; the exponent is m_exp" if key == _COPIES and "m_exp" in known else nearest(key, known)
            said = f"{name}: {device}{under} has no parameter {key!r}{hint}"
            raise InputError(
                f"{said}; allowed: {', '.join([*known, *(['law'] if device == 'GAP' else [])])}", given.key
            )
    values = {}
    for key, spec in known.items():
        if key in params:
            values[key] = _value(name, spec, params[key], notes)
        elif spec.default is not None:
            values[key] = spec.default
        else:
            unit = f" ({spec.unit})" if spec.unit else ""
            raise InputError(f"{name}: {device} needs {key}{unit}, missing here", where)
    return values


def _read_passive(statement: Statement, warmer: float, notes: list[str]) -> tuple[dict[str, float], float | None]:
    """The one value of an element, and the start voltage (V) of a C or current (A) of an L."""
    name, device, params = statement.name, statement.device, statement.params
    kind, (spec,) = DEVICES[device], DEVICES[device].parameters
    copied = (_COPIES,) if device in "RCL" else ()
    own = (*kind.aliases, *copied, *(("ic",) if device in "CL" else ()), *kind.data)
    for key, part in params.items():
        if key not in own and not (key == "lser" and isinstance(part, Number) and part.value == 0.0):
            shown = ", ".join(f"{k}=" for k in (*own, *kind.beside))
            reason = "; an inductance in series is an L" if key == "lser" else ""
            raise InputError(f"{name} takes no parameter {key!r}{reason}; allowed: {shown}", part.key)
    given = [*statement.body, *(params[key] for key in kind.aliases if key in params)]
    unit = f" in {spec.unit}" if spec.unit else ""
    refuse(len(given) != 1, f"{name} needs one value{unit}, {len(given)} are given", statement)
    value = _value(name, spec, number(given[0], f"{name} {spec.name}", f"a number {spec.unit}".rstrip()), notes)
    copies = params.get(_COPIES)
    if copies is not None:
        if not isinstance(copies, Number) or not 1e-6 <= copies.value <= 1e6:
            raise InputError(f"{name} m is {copies.text!r}; allowed: a number of parts side by side", copies.where)
        value = value * copies.value if device == "C" else value / copies.value
    value *= _warmed(statement, warmer) if device in "RCL" else 1.0
    return {spec.name: value}, start_volts(f"{name} IC", params["ic"]) if "ic" in params else None


def _value(name: str, spec: ParameterSpec, given: Value, notes: list[str]) -> float:
    """Value of one parameter; refuses or warns about units that SPICE reads as scale factors."""
    unit = f" {spec.unit}" if spec.unit else ""
    if isinstance(given, Token):
        if spec.may_be_infinite and given.text.lower() in ("inf", "none"):
            return math.inf
        allowed = f"a number{unit}, or the name of a .param"
        raise InputError(f"{name} {spec.name} is {given.text!r}; allowed: {allowed}", given.where)
    trap = unit_trap(spec, given.text)
    refuse(trap, f"{name} {spec.name} {trap}", given)
    notes.extend(f"{place}: {name} {spec.name}: {doubt}" for place, doubt in _doubts(given, spec))
    if not spec.accepts(given.value):
        plain = f"{given.value:g}{unit}"
        written = plain if given.text == f"{given.value:g}" else f"{given.text} ({plain})"
        raise InputError(f"{name} {spec.name} is {written}; allowed: {spec.allowed()}", given.where)
    return given.value


def _doubts(given: Number, spec: ParameterSpec) -> Iterator[tuple[Where, str]]:
    """Warnings about the notation of a number, each with the place that it is about."""
    if given.mega is not None and (note := mega_note(given.mega.text, given.value, spec)):
        yield given.mega.where, note
    if exponent_and_scale(given.text):
        yield given.where, f"{given.text} is {given.value:g}: exponent and scale both count"


def _numbers(directive: Call, usage: str) -> tuple[list[Number], list[str]]:
    """The numbers and the other words of a directive's line."""
    for arg in directive.args:
        refuse(isinstance(arg, Call), f"{directive.text}: {arg.text!r} is not understood; allowed: {usage}", arg)
    for key, value in directive.params.items():
        raise InputError(f"{directive.text} takes no {key!r}; allowed: {usage}", value.key)
    numbers = [arg for arg in directive.args if isinstance(arg, Number)]
    return numbers, [arg.text.lower() for arg in directive.args if isinstance(arg, Token)]


def read_tran(directive: Call, notes: list[str]) -> Tran:
    """``.tran TSTEP TSTOP [TSTART [TMAX]] [uic]``; LTspice's may lack TSTEP, of which `notes` gets a warning."""
    usage = ".tran TSTEP TSTOP [TSTART [TMAX]] [uic]"
    numbers, words = _numbers(directive, usage)
    for word in words:
        if word in OTHERS["tran"]:
            raise InputError(f".tran {word}: {OTHERS['tran'][word]}", directive.where)
    apart = "; a unit joins its number, such as 20m" if any(is_unit(w) for w in words) else ""
    problem = f"{directive.line.strip()!r} is not understood; allowed: {usage}{apart}"
    refuse(any(w != "uic" for w in words) or not 1 <= len(numbers) <= 4, problem, directive)
    step, stop, start, longest = [None, numbers[0], None, None] if len(numbers) == 1 else [*numbers, None, None][:4]
    assert stop is not None
    _require(stop.value > 0.0, "TSTOP", stop, "more than 0 s")
    for what, given in (("TSTOP", stop), ("TMAX", longest)):
        _require(given is None or 1e-30 <= given.value <= 1e30, what, given, "1e-30 to 1e30 s")
    if step is None or step.value == 0.0:
        step = longest
    if step is None:
        every = stop.value / LTSPICE_OUTPUTS
        step = Number(every, f"{every:g}", directive.where)
        note = f"{directive.where}: {directive.line.strip()!r} has no TSTEP, which LTspice does not need"
        notes.append(f"{note}: {LTSPICE_OUTPUTS:,} outputs, one every {every:g} s")
    _require(step.value > 0.0, "TSTEP", step, "more than 0 s")
    _require(1e-30 <= step.value <= 1e30, "TSTEP", step, "1e-30 to 1e30 s")
    _require(step.value <= stop.value, "TSTEP", step, f"at most TSTOP = {stop.text} (the output step comes first)")
    begin = start.value if start else 0.0
    _require(0.0 <= begin < stop.value, "TSTART", start, f"0 to TSTOP = {stop.text}")
    _require((stop.value - begin) / step.value <= 1e8, "TSTEP", step, "at most 1e8 output steps in a run")
    return Tran(step.value, stop.value, begin, longest.value if longest else None, "uic" in words)


def _require(condition: bool, what: str, given: Number | None, allowed: str) -> None:
    refuse(not condition, f"{what} is {given and given.text}; allowed: {allowed}", given)


def read_ac(directive: Call) -> AcSweep:
    """``.ac DEC|OCT|LIN N FSTART FSTOP``."""
    usage = ".ac DEC|OCT|LIN N FSTART FSTOP"
    numbers, words = _numbers(directive, usage)
    if len(words) != 1 or words[0] not in ("dec", "oct", "lin") or len(numbers) != 3:
        raise InputError(f"{directive.line.strip()!r} is not understood; allowed: {usage}", directive.where)
    scale, (n, low, high) = words[0], numbers
    _require(n.value >= 1 and n.value == int(n.value) and n.value <= 1e6, "N", n, "a whole number, 1 to 1e6")
    _require(low.value > 0.0, "FSTART", low, "more than 0 Hz")
    _require(high.value >= low.value, "FSTOP", high, f"at least FSTART = {low.text}")
    for what, given in (("FSTART", low), ("FSTOP", high)):
        _require(1e-30 <= given.value <= 1e30, what, given, "1e-30 to 1e30 Hz")
    spans = 1.0 if scale == "lin" else math.log(high.value / low.value, 10.0 if scale == "dec" else 2.0)
    _require(n.value * spans <= 1e6, "N", n, f"at most 1e6 frequencies in a sweep, here {n.value * spans:.3g}")
    return AcSweep(scale, int(n.value), low.value, high.value)


def read_start(given: list[Call], elements: tuple[Element, ...], uic: bool) -> tuple[dict[str, float], list[str]]:
    """``.ic v(node)=value``: start values by canonical node, in V, or in mm^2 of an area node, and what has no effect.

    Without effect are with ``uic`` those where no layer or capacitor without ``IC=`` is, else every ``IC=``.
    """
    usage = "allowed: .ic v(node)=value"
    nodes = {node: None for e in elements for node in e.nodes}  # an ordered set
    layers = [e for e in elements if e.spec.cells is not None]
    area_nodes = {e.nodes[2] for e in layers if e.spec.is_layer}
    out: dict[str, float] = {}
    for directive in given:
        refuse(directive.args, f"{directive.line.strip()!r} is not understood; {usage}", directive)
        for key, value in directive.params.items():
            place = value.key
            refuse(not (key.startswith("v(") and key.endswith(")")), f".ic {key!r} is not understood; {usage}", place)
            if not isinstance(value, Number):
                raise InputError(f".ic {key} is {value.text!r}; allowed: a number V", place)
            node = key[2:-1]
            if node not in nodes:
                raise InputError(f".ic names node {node!r}, which is not in the circuit{nearest(node, nodes)}", place)
            refuse(node in out, f".ic gives node {node!r} twice", place)
            refuse(node == "0" and value.value != 0.0, f".ic {key} is {value.text} V; allowed: 0, it is ground", place)
            if node in area_nodes and not 1e-30 <= value.value <= 1e30:
                raise InputError(f".ic {key} is {value.text} mm^2; allowed: more than 0, from 1e-30 to 1e30", place)
            out[node] = value.value if node in area_nodes else start_volts(f".ic {key}", value)
    gaps = [e for e in layers if e.device == "GAP" and e.values["a_fix"] == 0.0]
    started = [*layers, *(e for e in elements if e.device == "C" and e.initial is None)]
    used = {node for e in started for node in e.nodes[:2]} if uic else set(out)
    used = used - area_nodes | {e.nodes[2] for e in gaps if not uic or e.values["tau"] > 0.0}
    without = [f".ic v({node})" for node in out if node not in used]
    return out, without + [f"IC= of {e.name}" for e in elements if e.initial is not None and not uic]


def start_volts(what: str, word: Value) -> float:
    """A start voltage (V), which must be within the range allowed for sources."""
    value = number(word, what, "a number V").value
    check_range(what, value, "V", word.where)
    return value


def read_options(directives: list[Call]) -> tuple[str, tuple[str, ...]]:
    """The reading of Eq. 7 that ``work`` selects, and the names of ngspice's and LTspice's options, without effect."""
    work, unused = None, []
    for directive in directives:
        names = [(key, value.text.lower(), value.key) for key, value in directive.params.items()]
        for arg in directive.args:
            if not isinstance(arg, Token):
                raise InputError(f".options {arg.text!r} is not understood; allowed: .options name=value", arg.where)
            names.append((arg.text.lower(), "", arg.where))
        for key, text, place in names:
            if key == "work":
                if text not in WORK_READINGS:
                    raise InputError(f".options work is {text!r}; allowed: {' or '.join(WORK_READINGS)}", place)
                refuse(work not in (None, text), f".options work is given twice, first {work}, then {text}", place)
                work = text
            elif key in ("temp", "tnom"):
                continue
            elif key in _NGSPICE_OPTIONS or key in _LTSPICE_OPTIONS:
                unused.append(f".options {key}")
            else:
                hint = nearest(key, [*_NGSPICE_OPTIONS, "work"])
                known = f"work={'|'.join(WORK_READINGS)}, and those of ngspice and LTspice, which have no effect here"
                raise InputError(f"unknown option {key!r}{hint}; allowed: {known}", place)
    return work or "gap", tuple(dict.fromkeys(unused))
