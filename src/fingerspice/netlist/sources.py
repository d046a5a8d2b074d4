"""Source functions of a netlist as waveforms: those that all SPICEs share, and SQUARE; and ``AC``."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from fingerspice.base.errors import InputError, Where
from fingerspice.circuit.circuit import SmallSignal
from fingerspice.netlist.deck import Call, Number, Token
from fingerspice.netlist.slips import is_unit
from fingerspice.netlist.spelling import nearest
from fingerspice.waveforms.periodic import Square
from fingerspice.waveforms.ramps import PWL, Pulse
from fingerspice.waveforms.transients import Exp
from fingerspice.waveforms.waveform import DC, Sine, Waveform

Word = Number | Token | Call
_SIN = ("VO", "VA", "FREQ", "TD", "THETA", "PHASE")
_PULSE = ("V1", "V2", "TD", "TR", "TF", "PW", "PER")
#: Functions to which LTspice adds a number of periods.
_COUNTED = (_SIN, _PULSE)
#: Names in LTspice.
_ALIASES = {"sine": "sin"}


@dataclass(frozen=True)
class Timing:
    """TSTEP and TSTOP of the deck (s), on which SPICE's defaults depend; None without a .tran line."""

    step: float | None
    stop: float | None


@dataclass(frozen=True)
class _Arguments:
    """Positional arguments of one source call, by name."""

    call: Call
    names: tuple[str, ...]
    required: int
    timing: Timing

    def __post_init__(self) -> None:
        given = len(self.call.args)
        usage = f"{self.call.name.upper()}({' '.join(self.names)})"
        if given < self.required:
            raise InputError(
                f"{self.call.name.upper()} needs {self.required} values, {given} given; allowed: {usage}",
                self.call.where,
            )
        if given > len(self.names):
            # LTspice has one more, Ncycles.
            hint = "; Ncycles is not supported, in Python a burst is a product, fs.Sine(...) * fs.Pulse(...)"
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
        if self.timing.step is None:
            raise InputError(
                f"{self.call.name.upper()} leaves out {name}, which defaults to TSTEP, and there is no .tran line; "
                f"allowed: give {name}",
                self.call.where,
            )
        return self.timing.step


def _number(word: Word, what: str) -> float:
    if isinstance(word, Number):
        return word.value
    text = word.text if isinstance(word, Token) else word.name
    raise InputError(f"{what} is {text!r}; allowed: a number or {{expression}}", word.where)


def _sin(call: Call, timing: Timing) -> Waveform:
    a = _Arguments(call, _SIN, 2, timing)
    frequency = a.get("FREQ", 1.0 / timing.stop if timing.stop else math.nan)
    if math.isnan(frequency):
        raise InputError("SIN leaves out FREQ, which defaults to 1/TSTOP, and there is no .tran line", call.where)
    return Sine(a.get("VA"), frequency, a.get("VO"), a.get("PHASE", 0.0), a.get("TD", 0.0), a.get("THETA", 0.0))


def _pulse(call: Call, timing: Timing) -> Waveform:
    a = _Arguments(call, _PULSE, 2, timing)
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


def _exp(call: Call, timing: Timing) -> Waveform:
    a = _Arguments(call, ("V1", "V2", "TD1", "TAU1", "TD2", "TAU2"), 2, timing)
    td1 = a.get("TD1", 0.0)
    td2 = a.get("TD2") if len(call.args) > 4 else td1 + a.step_or("TD2")
    return Exp(a.get("V1"), a.get("V2"), td1, a.step_or("TAU1"), td2, a.step_or("TAU2"))


def _pwl(call: Call, timing: Timing) -> Waveform:
    for key, value in call.params.items():
        if key not in ("r", "td"):
            place = call.param_where.get(key, call.where)
            if key == "file":
                raise InputError(
                    "PWL(file=...) is not supported (it aborts ngspice 39); write the points, PWL(t1 v1 t2 v2 ...), or "
                    "give them in Python, fs.PWL(times, values) or fs.Samples(values, rate)",
                    place,
                )
            raise InputError(f"PWL has no parameter {key!r}; allowed: r and td", place)
        _number(value, f"PWL {key}")
    values = [_number(arg, "PWL value") for arg in call.args]
    if len(values) < 2 or len(values) % 2:
        raise InputError(f"PWL needs pairs of time and value, {len(values)} numbers given", call.where)
    shift = _number(call.params["td"], "PWL td") if "td" in call.params else 0.0
    repeat = _number(call.params["r"], "PWL r") if "r" in call.params else -1.0
    times = [t + shift for t in values[0::2]]
    if repeat >= 0.0 and repeat not in values[0::2] and repeat < values[0]:
        # Where the repeated part begins before the first point, it begins with the first value.
        times, values = [repeat + shift, *times], [repeat, values[1], *values]
    return PWL(tuple(times), tuple(values[1::2]), repeat + shift if repeat >= 0.0 else None)


def _square(call: Call, timing: Timing) -> Waveform:
    a = _Arguments(call, ("amplitude", "frequency", "duty"), 2, timing)
    return Square(a.get("amplitude"), a.get("frequency"), a.get("duty", 0.5))


SOURCES: dict[str, Callable[[Call, Timing], Waveform]] = {
    "sin": _sin,
    "pulse": _pulse,
    "exp": _exp,
    "pwl": _pwl,
    "square": _square,
}
"""Source functions by name: add one here to teach the reader another."""

_REFUSED = {
    "am": "AM changed its argument order between ngspice versions; write the waveform as PWL, or give it in Python",
    "sffm": "SFFM changed its argument order between ngspice versions; write the waveform as PWL",
    "wavefile": "WAVEFILE is not supported by this version; give the samples in Python: fs.Samples(values, rate)",
    "table": "TABLE is not supported by this version; write the points as PWL(t1 v1 t2 v2 ...)",
}


@dataclass(frozen=True)
class Source:
    """A V or I element as the words after its nodes describe it.

    Attributes
    ----------
    waveform : Waveform
    ac : SmallSignal or None
    notes : tuple of str
        Warnings of words that ngspice reads differently.
    """

    waveform: Waveform
    ac: SmallSignal | None = None
    notes: tuple[str, ...] = ()


def read_source(name: str, body: Sequence[Word], timing: Timing, where: Where) -> Source:
    """Read the words after the nodes of a V or I element.

    Parameters
    ----------
    name : str
        The element.
    body : sequence of words
        ``[DC] value``, ``AC ...`` and at most one source function.
    timing : Timing
    where : Where
        Place of the element.

    Raises
    ------
    InputError
        One sentence with the place.
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
            waveform = _read_call(name, key, call, timing)
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
    """Warnings of numbers that ngspice 39 or LTspice reads differently, or that were left out."""
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


def _read_call(name: str, key: str, call: Call, timing: Timing) -> Waveform:
    if key in _REFUSED:
        raise InputError(f"{name}: {_REFUSED[key]}", call.where)
    if key not in SOURCES:
        raise InputError(
            f"{name}: unknown source {key.upper()!r}{nearest(key, SOURCES)}; allowed: {_known()}", call.where
        )
    try:
        return SOURCES[key](call, timing)
    except InputError as error:
        raise error if error.where else InputError(f"{name}: {error.message}", call.where) from None


def _known() -> str:
    return ", ".join(s.upper() for s in SOURCES)
