"""The page's menu of waveforms: each a function that ``--source`` knows, or the recording dropped on the page."""

from __future__ import annotations

import re
import warnings
from dataclasses import dataclass
from typing import Any

from fingerspice.base.errors import FingerspiceWarning, InputError
from fingerspice.base.units import parse_number
from fingerspice.circuit.circuit import Circuit
from fingerspice.circuit.topology import driving_sources
from fingerspice.explorer.recordings import Recording
from fingerspice.explorer.sliders import value_text
from fingerspice.netlist.netlist import source_from_text
from fingerspice.waveforms.combinations import AM
from fingerspice.waveforms.periodic import Sawtooth, Square, Triangle
from fingerspice.waveforms.waveform import DC, Sine, Waveform

#: By function: its waveform, and the names of its numbers in their order.
_TEXTS: dict[str, tuple[type[Waveform], tuple[str, ...]]] = {
    "SIN": (Sine, ("offset", "amplitude", "frequency")),
    "SQUARE": (Square, ("amplitude", "frequency", "duty")),
    "AM": (AM, ("amplitude", "carrier", "modulation", "depth")),
    "TRIANGLE": (Triangle, ("amplitude", "frequency")),
    "SAWTOOTH": (Sawtooth, ("amplitude", "frequency")),
    "DC": (DC, ("level",)),
}
#: Largest number of characters of a source's text.
LONGEST = 20_000
_CALL = re.compile(r"\s*([A-Za-z]+)\s*\(([^()]*)\)\s*")
_NAMED = re.compile(r"\s*([\w.]+)\s*=\s*(.*)", re.DOTALL)


@dataclass(frozen=True)
class Argument:
    """One number of a waveform, with its slider's range; an optional one may be left out, and then has its `value`."""

    name: str
    unit: str
    value: float
    low: float
    high: float
    log: bool = False
    optional: bool = False


def _hz(name: str, value: float) -> Argument:
    return Argument(name, "Hz", value, 1.0, 1e5, True)


def _volt(name: str = "amplitude", value: float = 200.0) -> Argument:
    return Argument(name, "V", value, 0.0 if name == "amplitude" else -400.0, 400.0)


#: The source that stands for the file dropped on the page.
RECORDING = "RECORDING"
_DUTY = Argument("duty", "", 0.5, 0.01, 0.99, optional=True)
WAVEFORMS: dict[str, tuple[str, tuple[Argument, ...]]] = {
    "SIN": ("Sine", (_volt("offset", 0.0), _volt(), _hz("frequency", 100.0))),
    "SQUARE": ("Square wave", (_volt(), _hz("frequency", 100.0), _DUTY)),
    "TRIANGLE": ("Triangle", (_volt(), _hz("frequency", 100.0))),
    "SAWTOOTH": ("Sawtooth", (_volt(), _hz("frequency", 100.0))),
    "AM": (
        "Carrier with envelope",
        (_volt(), _hz("carrier", 5e3), _hz("envelope", 50.0), Argument("depth", "", 1.0, 0.0, 1.0, optional=True)),
    ),
    "BURST": (
        "Bursts",
        (
            *(_volt(), _hz("frequency", 5e3), Argument("cycles", "", 10.0, 1.0, 100.0)),
            Argument("every", "s", 10e-3, 1e-3, 1.0, True),
        ),
    ),
    "CHIRP": (
        "Chirp",
        (
            *(_volt(value=150.0), _hz("from", 20.0), _hz("to", 1e3)),
            Argument("duration", "s", 0.05, 1e-2, 3.0, True),
        ),
    ),
    "EXP": (
        "Step that rises and falls",
        (
            *(_volt("low", 0.0), _volt("high", 200.0), Argument("start", "s", 1e-3, 0.0, 0.05)),
            Argument("rise", "s", 1e-3, 1e-5, 0.1, True),
            *(Argument("end", "s", 20e-3, 0.0, 0.1), Argument("fall", "s", 2e-3, 1e-5, 0.1, True)),
        ),
    ),
    RECORDING: ("Recording or table, dropped here", (Argument("gain", "V", 150.0, 0.0, 400.0),)),
    "DC": ("Constant", (_volt("level", 200.0),)),
}
"""By function: its name on the page, and its numbers in their order."""


def menu() -> list[dict[str, Any]]:
    """The menu as plain data."""
    return [
        {"kind": kind, "title": title, "arguments": [vars(a) for a in arguments]}
        for kind, (title, arguments) in WAVEFORMS.items()
    ]


def read_source(text: str, circuit: Circuit, recording: Recording | None = None) -> tuple[str, Waveform]:
    """The source's name and its new waveform, from text such as ``SQUARE(200 100)`` or ``Vdrive=AM(200 5k 50)``.

    No file is read, whatever the text names; ``RECORDING(150)`` is the recording given.

    Raises
    ------
    InputError
        If the text is not a source, or the circuit has no source of that name.
    """
    if len(text) > LONGEST:
        raise InputError(f"the source has {len(text):,} characters; allowed: at most {LONGEST:,}")
    names = {e.name.lower(): e.name for e in driving_sources(circuit)}
    named = _NAMED.fullmatch(text)
    if named is not None:
        if named[1].lower() not in names:
            known = ", ".join(names.values())
            raise InputError(f"{named[1]!r} is not a source of the circuit; allowed: {known}")
        name, text = names[named[1].lower()], named[2]
    else:
        name = next(iter(names.values()))
    call = _CALL.fullmatch(text)
    if call is not None and call[1].upper() == RECORDING:
        gain = _gain(call[2])
        if recording is None:
            raise InputError(
                "the source is a recording, which a link does not carry; allowed: drop its file on the page"
            )
        return name, recording.waveform(gain)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FingerspiceWarning)
        return name, source_from_text(text, circuit, files=False)


def text_of(waveform: Waveform) -> str | None:
    """The text that `read_source` reads as this waveform; None of one for which the page has no function."""
    for kind, (made, names) in _TEXTS.items():
        if type(waveform) is made:
            numbers = [value_text(getattr(waveform, name), made.units[name]) for name in names]
            return f"{kind}({' '.join(numbers)})"
    return None


def gain_of(text: str) -> float | None:
    """The gain of a source that is a recording; None of another source."""
    named = _NAMED.fullmatch(text)
    call = _CALL.fullmatch(text if named is None else named[2])
    return _gain(call[2]) if call is not None and call[1].upper() == RECORDING else None


def _gain(text: str) -> float:
    """The number of a call of `RECORDING`."""
    words = text.replace(",", " ").split()
    if len(words) != 1:
        raise InputError(f"{RECORDING} is given {len(words)} numbers; allowed: {RECORDING}(gain)")
    try:
        return parse_number(words[0])
    except ValueError as error:
        raise InputError(f"{RECORDING}: {error}") from None
