"""Source functions of a netlist as waveforms: SPICE's own, SQUARE and others, and recordings; and ``AC``."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import NamedTuple, NoReturn

from fingerspice.base.errors import InputError, Where
from fingerspice.circuit.circuit import SmallSignal
from fingerspice.circuit.devices import DEVICES
from fingerspice.netlist.expressions import Call, Number, Token, Word, number
from fingerspice.netlist.lexer import is_unit, nearest
from fingerspice.netlist.reader import Context, Statement
from fingerspice.waveforms.files import read_table
from fingerspice.waveforms.periodic import PWL, Burst, Pulse, Repeat, Sawtooth, Square, Triangle
from fingerspice.waveforms.samples import Samples
from fingerspice.waveforms.waveform import AM, DC, Chirp, Exp, Sine, Waveform, refuse

_KEPT_BYTES = 2**25  # A larger WAV file is read in parts when needed: 32 MiB are six minutes of 16 bits at 48 kHz.


class _Arguments:
    """The words of one call of a source function, by name, and how they are read."""

    def __init__(self, call: Call, function: Function, context: Context) -> None:
        self.call, self.context = call, context
        self.name = call.text.upper()
        names, given = function.names.split(), len(call.args)
        self.usage = f"allowed: {function.usage or f'{self.name}({function.names})'}"
        if given < function.required:
            self.refuse(f"{self.name} needs {function.required} values, {given} given")
        if given > len(names) > 0:
            hint = "; Ncycles is not supported, a burst is BURST(amplitude frequency cycles), in Python fs.Burst"
            self.usage += hint if function.counted and given == len(names) + 1 else ""  # LTspice has one more argument.
            self.refuse(f"{self.name} takes at most {len(names)} values, {given} given")
        self.words: dict[str, Word] = dict(zip(names, call.args, strict=False))
        for key, value in call.params.items():
            if key not in function.keys.split() or key in self.words:
                problem = f"{key!r} twice" if key in self.words else f"no parameter {key!r}"
                self.refuse(f"{self.name} has {problem}", value.key)
            self.words[key] = value

    def refuse(self, problem: str, where: Where | None = None) -> NoReturn:
        """Raise the error about the call, or about one of its words."""
        raise InputError(f"{problem}; {self.usage}", where or self.call.where)

    def get(self, name: str, default: float = math.nan) -> float:
        return number(self.words[name], f"{self.name} {name}").value if name in self.words else default

    def step_or(self, name: str) -> float:
        """An argument whose SPICE default is TSTEP."""
        tran = self.context.tran
        problem = f"{self.name} leaves out {name}, which defaults to TSTEP, and there is no .tran line"
        refuse(name not in self.words and tran is None, f"{problem}; allowed: give {name}", self.call)
        return self.get(name, tran.step if tran else math.nan)

    def whole(self, name: str) -> int | None:
        if name not in self.words:
            return None
        value = number(self.words[name], name).value
        refuse(value != int(value), f"{name} is {value:g}; allowed: a whole number", self.words[name])
        return int(value)

    def column(self, name: str) -> str | int | None:
        word = self.words.get(name)
        return word.text if isinstance(word, Token) else self.whole(name)

    def upsampled(self, recording: Samples) -> Samples:
        factor = self.whole("upsample")
        return recording if factor is None else recording.upsampled(factor)

    def file(self, name: str = "path") -> Path:
        if name not in self.words:
            self.refuse(f"{self.name} names no file")
        return self.context.find(self.words[name].text, self.words[name].where)


def _sin(a: _Arguments) -> Waveform:
    tran = a.context.tran
    frequency = a.get("FREQ", 1.0 / tran.stop if tran else math.nan)
    refuse(math.isnan(frequency), "SIN leaves out FREQ, which defaults to 1/TSTOP, and there is no .tran line", a.call)
    return Sine(a.get("VA"), frequency, a.get("VO"), a.get("PHASE", 0.0), a.get("TD", 0.0), a.get("THETA", 0.0))


def _pulse(a: _Arguments) -> Waveform:
    # TR and TF of 0 mean ideal edges here. PW and PER of 0 mean "for ever", as in ngspice.
    forever = (a.get("PW", 0.0) or math.inf, a.get("PER", 0.0) or math.inf)
    return Pulse(a.get("V1"), a.get("V2"), a.get("TD", 0.0), a.step_or("TR"), a.step_or("TF"), *forever)


def _exp(a: _Arguments) -> Waveform:
    td1 = a.get("TD1", 0.0)
    td2 = a.get("TD2") if "TD2" in a.words else td1 + a.step_or("TD2")
    return Exp(a.get("V1"), a.get("V2"), td1, a.step_or("TAU1"), td2, a.step_or("TAU2"))


def _pwl(a: _Arguments) -> Waveform:
    shift, repeat = a.get("td", 0.0), a.get("r", -1.0)
    if "file" in a.words:
        refuse(a.call.args, "PWL has points and file= too; allowed: one of them", a.call)
        points = PWL.from_table(a.file("file"), pairs=True)
        given, levels = points.times, points.values
    else:
        numbers = [number(arg, "PWL value").value for arg in a.call.args]
        if len(numbers) < 2 or len(numbers) % 2:
            raise InputError(f"PWL needs pairs of time and value, {len(numbers)} numbers given", a.call.where)
        given, levels = tuple(numbers[0::2]), tuple(numbers[1::2])
    times = tuple(t + shift for t in given)
    if 0.0 <= repeat < given[0]:
        # If the repeated part begins before the first point, its first value is that of the first point.
        times, levels = (repeat + shift, *times), (levels[0], *levels)
    return PWL(times, levels, repeat + shift if repeat >= 0.0 else None)


def _wavefile(a: _Arguments) -> Waveform:
    path = a.file()
    if "gain" not in a.words:
        a.refuse(f"{a.name} has no gain, the V at full scale")
    small = not path.is_file() or path.stat().st_size <= _KEPT_BYTES
    return a.upsampled(Samples.from_wav(path, number(a.words["gain"], "gain").value, a.whole("channel"), at_once=small))


def _table(a: _Arguments) -> Waveform:
    path, given = a.file(), a.get("rate") if "rate" in a.words else None
    values, rate, times = read_table(path, a.column("time"), a.column("value"), given)
    if rate is not None:
        return a.upsampled(Samples(values, rate))
    refuse("upsample" in a.words, "TABLE upsample goes with a rate, and this table has times", a.call)
    return PWL(times, values)  # type: ignore[arg-type]


def _burst(a: _Arguments) -> Waveform:
    frequency, every = a.get("frequency"), a.get("every", 0.0)
    burst = Burst(Sine(a.get("amplitude"), frequency), a.get("cycles") / frequency)
    return Repeat(burst, every) if every else burst


def _plain(made: Callable[..., Waveform]) -> Callable[[_Arguments], Waveform]:
    """A waveform of its own numbers, in their order."""
    return lambda a: made(*(a.get(name) for name in a.words))


class Function(NamedTuple):
    """A source function."""

    make: Callable[[_Arguments], Waveform]
    names: str  # Names of its words, in their order; empty for any number of words
    required: int = 0  # Number of words that are needed
    keys: str = ""  # Words that may be given as key=value
    usage: str = ""  # What is allowed, if that is not NAME(names)
    counted: bool = False  # Whether LTspice adds a number of periods
    refused: str = ""  # Why it is refused in decks, which a SPICE may read, too; --source takes it


_CHANGED = "changed its argument order between ngspice versions; write the waveform as PWL"
#: Source functions by name; an entry is all that a new source function needs.
SOURCES: Mapping[str, Function] = {
    "sin": Function(_sin, "VO VA FREQ TD THETA PHASE", 2, counted=True),
    "pulse": Function(_pulse, "V1 V2 TD TR TF PW PER", 2, counted=True),
    "exp": Function(_exp, "V1 V2 TD1 TAU1 TD2 TAU2", 2),
    "pwl": Function(_pwl, "", keys="r td file", usage="r, td and file"),
    "square": Function(_plain(Square), "amplitude frequency duty", 2),
    "triangle": Function(_plain(Triangle), "amplitude frequency", 2),
    "sawtooth": Function(_plain(Sawtooth), "amplitude frequency", 2),
    "chirp": Function(_plain(Chirp), "amplitude f0 f1 duration", 4),
    "am": Function(_plain(AM), "amplitude carrier envelope depth", 3, refused=f"AM {_CHANGED}, or give it by --source"),
    "burst": Function(_burst, "amplitude frequency cycles every", 3),
    "wavefile": Function(
        _wavefile, "path gain channel", keys="gain channel upsample",
        usage="WAVEFILE(path gain [channel]) with gain in V at full scale",
    ),
    "table": Function(
        _table, "path time value", keys="time value rate upsample",
        usage="TABLE(path [time_column value_column]) or TABLE(path rate=RATE)",
    ),
}  # fmt: skip
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
        return function.make(_Arguments(call, function, context))
    except InputError as error:
        raise error if error.where else InputError(f"{name}: {error.message}", call.where) from None


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
