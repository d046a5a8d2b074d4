"""Source functions of a netlist as waveforms: SPICE's own, SQUARE and others, and recordings; and ``AC``."""

from __future__ import annotations

import inspect
import math
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from fingerspice.base.errors import InputError
from fingerspice.circuit.circuit import SmallSignal
from fingerspice.circuit.devices import DEVICES
from fingerspice.circuit.laws import LAWS, PAPER
from fingerspice.netlist.expressions import CONSTANTS, FUNCTIONS, Call, Number, Token, Word, evaluated, number
from fingerspice.netlist.lexer import is_unit, nearest
from fingerspice.netlist.measures import FORMS
from fingerspice.netlist.reader import DIRECTIVES, Context, Statement
from fingerspice.waveforms.files import read_table
from fingerspice.waveforms.periodic import PWL, Burst, Pulse, Repeat, Sawtooth, Square, Triangle
from fingerspice.waveforms.samples import Samples
from fingerspice.waveforms.waveform import AM, DC, Chirp, Exp, Sine, Waveform, refuse

_KEPT_BYTES = 2**25  # A larger WAV file is read in parts when needed: 32 MiB are six minutes of 16 bits at 48 kHz.


def _pwl(*points: float, r: float = -1.0, td: float = 0.0, file: Path | None = None) -> Waveform:
    refuse(points and file is not None, "PWL has points and file= too; allowed: one of them")
    if file is not None:
        table = PWL.from_table(file, pairs=True)
        given, levels = table.times, table.values
    else:
        refuse(len(points) < 2 or len(points) % 2, f"PWL needs pairs of time and value, {len(points)} numbers given")
        given, levels = points[0::2], points[1::2]
    times = tuple(t + td for t in given)
    if 0.0 <= r < given[0]:
        # If the repeated part begins before the first point, its first value is that of the first point.
        times, levels = (r + td, *times), (levels[0], *levels)
    return PWL(times, levels, r + td if r >= 0.0 else None)


def _wavefile(path: Path, /, gain: float, channel: int | None = None, *, upsample: int | None = None) -> Waveform:
    small = not path.is_file() or path.stat().st_size <= _KEPT_BYTES
    recording = Samples.from_wav(path, gain, channel, at_once=small)
    return recording if upsample is None else recording.upsampled(upsample)


def _table(
    path: Path, /, time: str | int | None = None, value: str | int | None = None, *, rate: float | None = None,
    upsample: int | None = None,
) -> Waveform:  # fmt: skip
    values, rate, times = read_table(path, time, value, rate)
    if rate is None:
        refuse(upsample is not None, "TABLE upsample goes with a rate, and this table has times")
        return PWL(times, values)  # type: ignore[arg-type]
    recording = Samples(values, rate)
    return recording if upsample is None else recording.upsampled(upsample)


def _burst(amplitude: float, frequency: float, cycles: float, every: float = 0.0, /) -> Waveform:
    burst = Burst(Sine(amplitude, frequency), cycles / frequency)
    return Repeat(burst, every) if every else burst


class Function(NamedTuple):
    """A source function.

    Its words are the parameters of `make`, in their order; those that are not positional only may be given as
    key=value. A parameter without annotation is a number. A default that is a text is an expression of the words before
    it and of the .tran line's TSTEP and TSTOP.
    """

    make: Callable[..., Waveform]
    usage: str = ""  # What is allowed, if that is not NAME(words)
    counted: bool = False  # Whether LTspice adds a number of periods
    refused: str = ""  # Why it is refused in decks, which a SPICE may read, too; --source takes it


_CHANGED = "changed its argument order between ngspice versions; write the waveform as PWL"
#: Source functions by name; an entry is all that a new source function needs.
SOURCES: Mapping[str, Function] = {
    "sin": Function(
        lambda VO, VA, FREQ="1/TSTOP", TD=0.0, THETA=0.0, PHASE=0.0, /: Sine(VA, FREQ, VO, PHASE, TD, THETA),
        counted=True,
    ),
    # TR and TF of 0 mean ideal edges here. PW and PER of 0 mean "for ever", as in ngspice.
    "pulse": Function(
        lambda V1, V2, TD=0.0, TR="TSTEP", TF="TSTEP", PW=0.0, PER=0.0, /: (
            Pulse(V1, V2, TD, TR, TF, PW or math.inf, PER or math.inf)
        ),
        counted=True,
    ),
    "exp": Function(
        lambda V1, V2, TD1=0.0, TAU1="TSTEP", TD2="TD1+TSTEP", TAU2="TSTEP", /: Exp(V1, V2, TD1, TAU1, TD2, TAU2)
    ),
    "pwl": Function(_pwl, "r, td and file"),
    "square": Function(lambda amplitude, frequency, duty=0.5, /: Square(amplitude, frequency, duty)),
    "triangle": Function(lambda amplitude, frequency, /: Triangle(amplitude, frequency)),
    "sawtooth": Function(lambda amplitude, frequency, /: Sawtooth(amplitude, frequency)),
    "chirp": Function(lambda amplitude, f0, f1, duration, /: Chirp(amplitude, f0, f1, duration)),
    "am": Function(
        lambda amplitude, carrier, envelope, depth=1.0, /: AM(amplitude, carrier, envelope, depth),
        refused=f"AM {_CHANGED}, or give it by --source",
    ),
    "burst": Function(_burst),
    "wavefile": Function(_wavefile, "WAVEFILE(path gain [channel]) with gain in V at full scale"),
    "table": Function(_table, "TABLE(path [time_column value_column]) or TABLE(path rate=RATE)"),
}  # fmt: skip
_WORDS = {function: inspect.signature(function.make).parameters for function in SOURCES.values()}
_MISSING = {"path": "names no file", "gain": "has no gain, the V at full scale"}
_KNOWN = ", ".join(name.upper() for name, function in SOURCES.items() if not function.refused)
_LEVELS = {"dc": "DC value", "ac": "AC [magnitude [phase]]"}  #: What is no source function, with what is allowed.
_ALIASES = {"sine": "sin", "wav": "wavefile"}  #: Names in LTspice, and a short one for the command line.


def read_source(statement: Statement, context: Context, notes: list[str]) -> tuple[Waveform, SmallSignal | None]:
    """Waveform and small signal of a V or I element; `notes` gets warnings about what ngspice reads differently.

    The words after its nodes are ``[DC] value``, ``AC ...`` and at most one source function.
    """
    level: float | None = None
    ac: SmallSignal | None = None
    waveform: Waveform | None = None
    name, words = statement.name, deque(_words(statement))
    while words:
        word = words.popleft()
        if isinstance(word, Number):
            problem = f"{name}: a second value {word.text!r}; allowed: one value or source function"
            refuse(level is not None or waveform is not None, f"{problem}, such as SIN(0 200 100)", word)
            level = word.value
            continue
        key = _ALIASES.get(word.text.lower(), word.text.lower())
        apart = isinstance(word, Token) and is_unit(key) and (level is not None or waveform is not None)
        refuse(apart, f"{name}: {word.text!r} stands apart; a unit joins its number, such as 5{word.text}", word)
        if isinstance(word, Token):
            numbers = list[Number]()  # A call may also be written without brackets: SIN 0 200 100.
            while words and isinstance(words[0], Number):
                numbers.append(words[0])
                words.popleft()
            word = Call(key, tuple(numbers), {}, word.where)
        if key in _LEVELS and word.params:
            problem = f"{name}: {key.upper()} has no parameter {next(iter(word.params))!r}; allowed: {_LEVELS[key]}"
            raise InputError(problem, next(iter(word.params.values())).key)
        if key == "dc":
            refuse(len(word.args) != 1, f"{name}: DC needs one value", word)
            level = number(word.args[0], f"{name} DC").value
        elif key == "ac":
            refuse(ac is not None, f"{name} has AC twice; allowed: {_LEVELS[key]} once", word)
            given = [number(arg, f"{name} AC").value for arg in word.args]
            problem = f"{name}: AC takes at most 2 values, {len(given)} given; allowed: {_LEVELS[key]}"
            refuse(len(given) > 2, problem, word)
            ac = SmallSignal(*given)
        elif waveform is not None:
            raise InputError(f"{name} has two source functions, the second is {key.upper()}", word.where)
        else:
            waveform = _read_call(name, key, word, context)
            notes.extend(f"{word.where}: {name}: {note}" for note in _differences(key, waveform, word))
    if waveform is None and level is None and ac is None:
        raise InputError(f"{name} has no value; allowed: a number or one of {_KNOWN}", statement.where)
    return waveform if waveform is not None else DC(level or 0.0), ac


def _words(statement: Statement) -> list[Word]:
    """The words after the nodes, with the `key=value` pairs behind them in the calls to which they belong."""
    name, body, params = statement.name, list(statement.body), statement.params
    last = body[-1] if body else None
    if "wavefile" in params and not any(isinstance(word, Call) for word in body):
        path = params["wavefile"]  # LTspice's `wavefile=path [chan=n]`: 1 V at full scale, first channel by default.
        where = path.key or path.where
        for key, value in params.items():
            if key not in ("wavefile", "chan"):
                raise InputError(f"{name} takes no parameter {key!r} beside wavefile=; allowed: chan=", value.key)
        channel = params.get("chan", Number(0.0, "0", where))
        body.append(Call("wavefile", (path, Number(1.0, "1", where), channel), {}, where))
    elif params:
        # ngspice takes PWL(...) r=10m as well as PWL(... r=10m), and the brackets of PWL(file=...) may be left out.
        inner = last.params if isinstance(last, Call) else {}
        if not isinstance(last, Call | Token) or last.text.lower() != "pwl" or set(inner) & set(params):
            key = next(iter(params))
            takes = ", ".join(p.capitalize() for p in DEVICES[statement.device].beside)
            hint = f"; allowed: {takes}, besides its value" if takes else ""
            raise InputError(f"{name} takes no parameter {key!r}{hint}", params[key].key)
        body[-1] = Call(last.text, last.args if isinstance(last, Call) else (), {**inner, **params}, last.where)
    return body


def _read_call(name: str, key: str, call: Call, context: Context) -> Waveform:
    function = SOURCES.get(key)
    refused = f"SFFM {_CHANGED}" if key == "sffm" else function.refused if function and context.in_deck else ""
    refuse(refused, f"{name}: {refused}", call)
    if function is None:
        hint = nearest(key, SOURCES)
        raise InputError(f"{name}: unknown source {key.upper()!r}{hint}; allowed: {_KNOWN}", call.where)
    try:
        return _made(function, call, context)
    except InputError as error:
        raise error if error.where else InputError(f"{name}: {error.message}", call.where) from None


def _listed(words: Mapping[str, inspect.Parameter]) -> list[str]:
    return [key for key, p in words.items() if p.kind <= p.POSITIONAL_OR_KEYWORD]


def _usage(name: str, listed: list[str]) -> str:
    return f"{name}({' '.join(listed)})"


def vocabulary() -> dict[str, list[str]]:
    """All that a deck may say, by kind, from the registries that its reader asks."""
    devices = []
    for one in DEVICES.values():
        pairs = [p.name if p.default is None else f"{p.name}={p.default:g}" for p in one.parameters]
        given = " ".join(x if one.cells else "value" for x in pairs) if pairs else "[DC] value, AC ..., or a source"
        given = "MODEL" if one.name == "S" else given
        letter = "X..." if one.cells else f"{one.name}..."
        heads = " ".join((*one.nodes, *one.control, *([one.name] if one.cells else [])))
        devices.append(f"{letter} {heads} {given}  ({one.what})")
    sources = {name: one for name, one in SOURCES.items() if not one.refused}
    return {
        "elements and devices": [*devices, "X... node ... NAME key=value ...  (a .subckt)"],
        "sources": [one.usage if "(" in one.usage else _usage(name.upper(), _listed(_WORDS[one]) or ["t v ..."])
                    for name, one in sources.items()],
        "laws of contact": [f"law={name}" for name in (PAPER, *LAWS)],
        "directives": list(DIRECTIVES),
        "measures": FORMS.split(),
        "functions": [f"{name}({','.join('xyz'[:count])})" for name, (_, count) in FUNCTIONS.items()],
        "constants": list(CONSTANTS),
    }  # fmt: skip


def _made(function: Function, call: Call, context: Context) -> Waveform:
    """The waveform of a call, whose words become the arguments of a source function."""
    name, given, taken = call.text.upper(), len(call.args), _WORDS[function]
    listed = _listed(taken)
    named = [key for key, p in taken.items() if p.kind in (p.POSITIONAL_OR_KEYWORD, p.KEYWORD_ONLY)]
    needed = sum(taken[key].default is inspect.Parameter.empty and key not in _MISSING for key in listed)
    usage = f"allowed: {function.usage or _usage(name, listed)}"
    refuse(given < needed, f"{name} needs {needed} values, {given} given; {usage}", call)
    if given > len(listed) > 0:
        hint = "; Ncycles is not supported, a burst is BURST(amplitude frequency cycles), in Python fs.Burst"
        usage += hint if function.counted and given == len(listed) + 1 else ""  # LTspice has one more argument.
        raise InputError(f"{name} takes at most {len(listed)} values, {given} given; {usage}", call.where)
    words: dict[str, Word] = dict(zip(listed, call.args, strict=False))
    for key, word in call.params.items():
        problem = f"{key!r} twice" if key in words else f"no parameter {key!r}"
        refuse(key in words or key not in named, f"{name} has {problem}; {usage}", word.key)
        words[key] = word
    tran, values = context.tran, dict[str, Any]()
    for key, p in taken.items():
        if key in words:
            values[key] = _argument(f"{name} {key}", str(p.annotation), words[key], context)
        elif isinstance(p.default, str):
            problem = f"{name} leaves out {key}, which defaults to {p.default}, and there is no .tran line"
            if tran is None:
                raise InputError(f"{problem}; allowed: give {key}", call.where)
            known = {"tstep": tran.step, "tstop": tran.stop} | {k.lower(): v for k, v in values.items()}
            values[key] = evaluated(p.default, known, lambda _: call.where)
        elif p.kind != p.VAR_POSITIONAL:
            refuse(p.default is p.empty, f"{name} {_MISSING.get(key)}; {usage}", call)
            values[key] = p.default
    row = [values.pop(key) for key in listed] if listed else [number(arg, f"{name} value").value for arg in call.args]
    return function.make(*row, **values)


def _argument(what: str, kind: str, word: Word, context: Context) -> Any:
    """A word as the argument of a Python function whose parameter is annotated so; a number where it is not."""
    if kind.startswith("Path"):
        return context.find(word.text, word.where)
    if kind.startswith("str") and isinstance(word, Token):
        return word.text
    value = number(word, what).value
    refuse("int" in kind and value != int(value), f"{what} is {value:g}; allowed: a whole number", word)
    return int(value) if "int" in kind else value


def _differences(key: str, waveform: Waveform, call: Call) -> Iterator[str]:
    """Warnings about numbers that ngspice 39 or LTspice reads differently, or that were left out."""
    if isinstance(waveform, Exp) and 0.0 in (waveform.td1, waveform.td2):
        which = " and ".join(n for n, x in (("TD1", waveform.td1), ("TD2", waveform.td2)) if x == 0.0)
        note = f"{key.upper()} has {which} = 0, which is 0 s here and not in ngspice 39, which takes TSTEP for TD1 = 0"
        yield f"{note} and TD1 + TSTEP for TD2 = 0; write 1f for both to start at once"
    if isinstance(waveform, Sine) and len(call.args) < 3:
        note = f"{call.text.upper()} leaves out FREQ, which is 1/TSTOP then, {waveform.frequency:g} Hz"
        yield f"{note}; its values are VO VA FREQ"
    later = [arg.text for arg in call.args[2::2] if isinstance(arg, Number) and arg.text.startswith("+")]
    if key == "pwl" and later:
        yield f"the time {later[0]} is counted from 0, as in ngspice; LTspice counts it from the point before"
