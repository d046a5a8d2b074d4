"""Source functions of a netlist as waveforms: SPICE's own, SQUARE and others, and recordings; and ``AC``."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from fingerspice.base.errors import InputError, Where
from fingerspice.circuit.circuit import SmallSignal
from fingerspice.netlist.deck import Call, Number, Token
from fingerspice.netlist.files import SourceFiles
from fingerspice.netlist.slips import is_unit, nearest
from fingerspice.waveforms.combinations import AM, Burst, Repeat
from fingerspice.waveforms.files import read_table
from fingerspice.waveforms.periodic import Chirp, Exp, Pulse, Sawtooth, Square, Triangle
from fingerspice.waveforms.ramps import PWL
from fingerspice.waveforms.samples import Samples
from fingerspice.waveforms.waveform import DC, Sine, Waveform

Word = Number | Token | Call
_SIN = ("VO", "VA", "FREQ", "TD", "THETA", "PHASE")
_PULSE = ("V1", "V2", "TD", "TR", "TF", "PW", "PER")
#: Functions to which LTspice adds a number of periods.
_COUNTED = (_SIN, _PULSE)
_KEPT_BYTES = 2**25  # A larger WAV file is read in parts when needed: 32 MiB are six minutes of 16 bits at 48 kHz.
#: Names in LTspice, and a short one for the command line.
_ALIASES = {"sine": "sin", "wav": "wavefile"}
#: Functions of a waveform's own numbers: the waveform, the names of the numbers, and how many of them are needed.
_PLAIN: dict[str, tuple[Callable[..., Waveform], tuple[str, ...], int]] = {
    "square": (Square, ("amplitude", "frequency", "duty"), 2),
    "triangle": (Triangle, ("amplitude", "frequency"), 2),
    "sawtooth": (Sawtooth, ("amplitude", "frequency"), 2),
    "chirp": (Chirp, ("amplitude", "f0", "f1", "duration"), 4),
    "am": (AM, ("amplitude", "carrier", "envelope", "depth"), 3),
}


@dataclass(frozen=True)
class Context:
    """Data that the text of a source may refer to."""

    # step, stop: TSTEP and TSTOP of the deck (s), on which SPICE's defaults depend; None without a .tran line
    step: float | None = None
    stop: float | None = None
    files: SourceFiles = field(default_factory=SourceFiles)  # Finds recordings and tables
    in_deck: bool = True  # Whether the text stands in a deck, which a SPICE may read, too


@dataclass(frozen=True)
class _Arguments:
    """Positional arguments of one source call, by name."""

    call: Call
    names: tuple[str, ...]
    required: int
    context: Context

    def __post_init__(self) -> None:
        given = len(self.call.args)
        usage = f"{self.call.name.upper()}({' '.join(self.names)})"
        if given < self.required:
            raise InputError(
                f"{self.call.name.upper()} needs {self.required} values, {given} given; allowed: {usage}",
                self.call.where,
            )
        if given > len(self.names):
            # LTspice has one more argument, Ncycles.
            hint = "; Ncycles is not supported, a burst is BURST(amplitude frequency cycles), in Python fs.Burst"
            usage += hint if self.names in _COUNTED and given == len(self.names) + 1 else ""
            raise InputError(
                f"{self.call.name.upper()} takes at most {len(self.names)} values, {given} given; allowed: {usage}",
                self.call.where,
            )

    def get(self, name: str, default: float | None = None) -> float:
        index = self.names.index(name)
        if index < len(self.call.args):
            return _number(self.call.args[index], f"{self.call.name.upper()} {name}")
        assert default is not None
        return default

    def step_or(self, name: str) -> float:
        """An argument whose SPICE default is TSTEP."""
        if self.names.index(name) < len(self.call.args):
            return self.get(name)
        if self.context.step is None:
            raise InputError(
                f"{self.call.name.upper()} leaves out {name}, which defaults to TSTEP, and there is no .tran line; "
                f"allowed: give {name}",
                self.call.where,
            )
        return self.context.step


def _number(word: Word, what: str) -> float:
    if isinstance(word, Number):
        return word.value
    text = word.text if isinstance(word, Token) else word.name
    raise InputError(f"{what} is {text!r}; allowed: a number or {{expression}}", word.where)


def _sin(call: Call, context: Context) -> Waveform:
    a = _Arguments(call, _SIN, 2, context)
    frequency = a.get("FREQ", 1.0 / context.stop if context.stop else math.nan)
    if math.isnan(frequency):
        raise InputError("SIN leaves out FREQ, which defaults to 1/TSTOP, and there is no .tran line", call.where)
    return Sine(a.get("VA"), frequency, a.get("VO"), a.get("PHASE", 0.0), a.get("TD", 0.0), a.get("THETA", 0.0))


def _pulse(call: Call, context: Context) -> Waveform:
    a = _Arguments(call, _PULSE, 2, context)
    # TR and TF of 0 mean ideal edges here. PW and PER of 0 mean "for ever", as in ngspice.
    return Pulse(
        a.get("V1"),
        a.get("V2"),
        a.get("TD", 0.0),
        a.step_or("TR"),
        a.step_or("TF"),
        a.get("PW", 0.0) or math.inf,
        a.get("PER", 0.0) or math.inf,
    )


def _exp(call: Call, context: Context) -> Waveform:
    a = _Arguments(call, ("V1", "V2", "TD1", "TAU1", "TD2", "TAU2"), 2, context)
    td1 = a.get("TD1", 0.0)
    td2 = a.get("TD2") if len(call.args) > 4 else td1 + a.step_or("TD2")
    return Exp(a.get("V1"), a.get("V2"), td1, a.step_or("TAU1"), td2, a.step_or("TAU2"))


def _pwl(call: Call, context: Context) -> Waveform:
    for key, value in call.params.items():
        if key not in ("r", "td", "file"):
            place = call.param_where.get(key, call.where)
            raise InputError(f"PWL has no parameter {key!r}; allowed: r, td and file", place)
        if key != "file":
            _number(value, f"PWL {key}")
    if "file" in call.params:
        if call.args:
            raise InputError("PWL has points and file= too; allowed: one of them", call.where)
        points = PWL.from_table(context.files.find(*_path(call, call.params["file"])), pairs=True)
        given, levels = points.times, points.values
    else:
        numbers = [_number(arg, "PWL value") for arg in call.args]
        if len(numbers) < 2 or len(numbers) % 2:
            raise InputError(f"PWL needs pairs of time and value, {len(numbers)} numbers given", call.where)
        given, levels = tuple(numbers[0::2]), tuple(numbers[1::2])
    shift = _number(call.params["td"], "PWL td") if "td" in call.params else 0.0
    repeat = _number(call.params["r"], "PWL r") if "r" in call.params else -1.0
    times = tuple(t + shift for t in given)
    if 0.0 <= repeat < given[0]:
        # If the repeated part begins before the first point, its first value is that of the first point.
        times, levels = (repeat + shift, *times), (levels[0], *levels)
    return PWL(times, levels, repeat + shift if repeat >= 0.0 else None)


def _path(call: Call, word: Word | None) -> tuple[str, Where]:
    """The name of a file, and its place."""
    if word is None:
        raise InputError(f"{call.name.upper()} names no file; allowed: {_OF_FILES[_kind(call)]}", call.where)
    return word.name if isinstance(word, Call) else word.text, word.where


def _kind(call: Call) -> str:
    return _ALIASES.get(call.name.lower(), call.name.lower())


def _named(call: Call, names: tuple[str, ...], keys: tuple[str, ...]) -> dict[str, Word]:
    """Words of a call by name: positional words take the `names` in order; `keys` may be given as key=value."""
    usage = f"allowed: {_OF_FILES[_kind(call)]}"
    if len(call.args) > len(names):
        raise InputError(f"{call.name.upper()} takes at most {len(names)} values, {len(call.args)} given; {usage}",
                         call.where)  # fmt: skip
    words: dict[str, Word] = dict(zip(names, call.args, strict=False))
    for key, value in call.params.items():
        if key not in keys or key in words:
            problem = f"{key!r} twice" if key in words else f"no parameter {key!r}"
            raise InputError(f"{call.name.upper()} has {problem}; {usage}", call.param_where.get(key, call.where))
        words[key] = value
    return words


def _whole(words: dict[str, Word], key: str) -> int | None:
    """A whole number by its name; None if it is left out."""
    if key not in words:
        return None
    value = _number(words[key], key)
    if value != int(value):
        raise InputError(f"{key} is {value:g}; allowed: a whole number", words[key].where)
    return int(value)


def _column(words: dict[str, Word], key: str) -> str | int | None:
    """A column's name or number; None if it is left out."""
    word = words.get(key)
    return word.text if isinstance(word, Token) else _whole(words, key)


def _wavefile(call: Call, context: Context) -> Waveform:
    words = _named(call, ("path", "gain", "channel"), ("gain", "channel", "upsample"))
    path = context.files.find(*_path(call, words.get("path")))
    if "gain" not in words:
        raise InputError(f"{call.name.upper()} has no gain, the V at full scale; allowed: {_OF_FILES['wavefile']}",
                         call.where)  # fmt: skip
    factor, small = _whole(words, "upsample"), not path.is_file() or path.stat().st_size <= _KEPT_BYTES
    read = Samples.from_wav(path, _number(words["gain"], "gain"), _whole(words, "channel"), at_once=small)
    return read if factor is None else read.upsampled(factor)


def _table(call: Call, context: Context) -> Waveform:
    words = _named(call, ("path", "time", "value"), ("time", "value", "rate", "upsample"))
    path = context.files.find(*_path(call, words.get("path")))
    rate = _number(words["rate"], "TABLE rate") if "rate" in words else None
    table = read_table(path, _column(words, "time"), _column(words, "value"), rate)
    factor = _whole(words, "upsample")
    if table.rate is not None:
        recording = Samples(table.values, table.rate)
        return recording if factor is None else recording.upsampled(factor)
    if factor is not None:
        raise InputError("TABLE upsample goes with a rate, and this table has times", call.where)
    return PWL(table.times, table.values)  # type: ignore[arg-type]


def _plain(call: Call, context: Context) -> Waveform:
    """A waveform of its own numbers, in their order."""
    made, names, required = _PLAIN[_kind(call)]
    a = _Arguments(call, names, required, context)
    return made(*(a.get(name) for name in names[: len(call.args)]))


def _burst(call: Call, context: Context) -> Waveform:
    a = _Arguments(call, ("amplitude", "frequency", "cycles", "every"), 3, context)
    frequency, every = a.get("frequency"), a.get("every", 0.0)
    tone = Sine(a.get("amplitude"), frequency)
    burst = Burst(tone, a.get("cycles") / frequency)
    return Repeat(burst, every) if every else burst


SOURCES: dict[str, Callable[[Call, Context], Waveform]] = {
    "sin": _sin, "pulse": _pulse, "exp": _exp, "pwl": _pwl, **dict.fromkeys(_PLAIN, _plain), "burst": _burst,
    "wavefile": _wavefile, "table": _table,
}  # fmt: skip
"""Source functions by name; an entry is all that a new source function needs."""

_OF_FILES = {
    "wavefile": "WAVEFILE(path gain [channel]) with gain in V at full scale",
    "table": "TABLE(path [time_column value_column]) or TABLE(path rate=RATE)",
    "pwl": "PWL FILE=path",
}

_REFUSED = {  # in decks, which a SPICE may read, too; --source takes an AM
    "am": "AM changed its argument order between ngspice versions; write the waveform as PWL, or give it by --source",
    "sffm": "SFFM changed its argument order between ngspice versions; write the waveform as PWL",
}


@dataclass(frozen=True)
class Source:
    """Waveform and small signal of a V or I element, from the words after its nodes."""

    waveform: Waveform
    ac: SmallSignal | None = None
    notes: tuple[str, ...] = ()  # Warnings about words that ngspice reads differently


def read_source(name: str, body: Sequence[Word], context: Context, where: Where) -> Source:
    """Read the words after the nodes of a V or I element.

    Parameters
    ----------
    name : str
        Name of the element.
    body : sequence of words
        ``[DC] value``, ``AC ...`` and at most one source function.
    context : Context
    where : Where
        Place of the element.

    Raises
    ------
    InputError
        If the words do not describe a source; the message has the place.
    """
    level: float | None = None
    ac: SmallSignal | None = None
    waveform: Waveform | None = None
    notes: tuple[str, ...] = ()
    words = deque(body)
    while words:
        word = words.popleft()
        if isinstance(word, Number):
            if level is not None or waveform is not None:
                allowed = "one value or source function, such as SIN(0 200 100)"
                raise InputError(f"{name}: a second value {word.text!r}; allowed: {allowed}", word.where)
            level = word.value
            continue
        key = (word.text if isinstance(word, Token) else word.name).lower()
        key = _ALIASES.get(key, key)
        if isinstance(word, Token) and is_unit(key) and (level is not None or waveform is not None):
            problem = f"{name}: {word.text!r} stands apart; a unit joins its number, such as 5{word.text}"
            raise InputError(problem, word.where)
        call = word if isinstance(word, Call) else None
        if call is None:
            # A call may also be written without brackets: SIN 0 200 100.
            call = Call(key, tuple(_leading_numbers(words)), {}, {}, word.where)
        if key == "dc":
            if len(call.args) != 1:
                raise InputError(f"{name}: DC needs one value", word.where)
            level = _number(call.args[0], f"{name} DC")
        elif key == "ac":
            if ac is not None:
                raise InputError(f"{name} has AC twice; allowed: AC [magnitude [phase]] once", word.where)
            ac = _small_signal(name, call)
        elif waveform is not None:
            raise InputError(f"{name} has two source functions, the second is {key.upper()}", word.where)
        else:
            waveform = _read_call(name, key, call, context)
            notes = _differences(name, key, waveform, call)
    if waveform is None and level is None and ac is None:
        raise InputError(f"{name} has no value; allowed: a number or one of {_known()}", where)
    return Source(waveform if waveform is not None else DC(level or 0.0), ac, notes)


def _small_signal(name: str, call: Call) -> SmallSignal:
    """``AC [magnitude [phase]]``, by default 1 and 0 degrees."""
    numbers = [_number(arg, f"{name} AC") for arg in call.args]
    if len(numbers) > 2:
        raise InputError(f"{name}: AC takes at most 2 values, {len(numbers)} given; allowed: AC [magnitude [phase]]",
                         call.where)  # fmt: skip
    return SmallSignal(*numbers)


def _differences(name: str, key: str, waveform: Waveform, call: Call) -> tuple[str, ...]:
    """Warnings about numbers that ngspice 39 or LTspice reads differently, or that were left out."""
    if isinstance(waveform, Exp) and 0.0 in (waveform.td1, waveform.td2):
        which = " and ".join(n for n, x in (("TD1", waveform.td1), ("TD2", waveform.td2)) if x == 0.0)
        return (
            f"{call.where}: {name}: {key.upper()} has {which} = 0, which is 0 s here and not in ngspice 39, which "
            "takes TSTEP for TD1 = 0 and TD1 + TSTEP for TD2 = 0; write 1f for both to start at once",
        )
    if key == "sin" and len(call.args) < 3:
        assert isinstance(waveform, Sine)
        return (
            f"{call.where}: {name}: {call.name.upper()} leaves out FREQ, which is 1/TSTOP then, "
            f"{waveform.frequency:g} Hz; its values are VO VA FREQ",
        )
    later = [arg.text for arg in call.args[2::2] if isinstance(arg, Number) and arg.text.startswith("+")]
    if key == "pwl" and later:
        return (
            f"{call.where}: {name}: the time {later[0]} is counted from 0, as in ngspice; LTspice counts it from the "
            "point before",
        )
    return ()


def _leading_numbers(words: deque[Word]) -> list[Number]:
    out = []
    while words and isinstance(words[0], Number):
        out.append(words[0])
        words.popleft()
    return out


def _read_call(name: str, key: str, call: Call, context: Context) -> Waveform:
    if key in _REFUSED and (context.in_deck or key not in SOURCES):
        raise InputError(f"{name}: {_REFUSED[key]}", call.where)
    if key not in SOURCES:
        raise InputError(
            f"{name}: unknown source {key.upper()!r}{nearest(key, SOURCES)}; allowed: {_known()}", call.where
        )
    try:
        return SOURCES[key](call, context)
    except InputError as error:
        raise error if error.where else InputError(f"{name}: {error.message}", call.where) from None


def _known() -> str:
    return ", ".join(s.upper() for s in SOURCES if s not in _REFUSED)
