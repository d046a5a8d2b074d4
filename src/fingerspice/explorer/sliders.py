"""Sliders: every parameter of every element, with a range in which it makes sense; and the menu of waveforms."""

from __future__ import annotations

import math
import re
import warnings
from typing import TYPE_CHECKING, Any, NamedTuple

from fingerspice.base.errors import FingerspiceWarning, InputError
from fingerspice.base.units import parse_number, spice_text
from fingerspice.circuit.circuit import Circuit
from fingerspice.circuit.describe import MEANINGS_OF_WAVEFORMS
from fingerspice.circuit.devices import ParameterSpec
from fingerspice.circuit.topology import driving_sources
from fingerspice.netlist.netlist import source_from_text
from fingerspice.waveforms.combinations import AM
from fingerspice.waveforms.periodic import Sawtooth, Square, Triangle
from fingerspice.waveforms.waveform import DC, Sine, Waveform

if TYPE_CHECKING:
    from fingerspice.explorer.request import Recording

#: Numbers of waveforms that the page shows at once; the others it shows on request.
_FIRST_OF_SOURCES = (
    *("amplitude", "frequency", "level", "v1", "v2", "carrier", "modulation", "depth", "f0", "f1", "duration"),
    *("duty", "pulse_period", "period", "td1", "tau1", "td2", "tau2"),
)
#: Ends of sliders of values that are 0 in the deck.
_FROM_ZERO = {"a_fix": 100.0, "tau": 0.1, "mu": 1.0, "c2": 20e3}
#: A slider goes from the deck's value over this to its value times this, within the usual range.
_SPAN = 100.0
#: Ratio of the ends of a usual range up to which its slider is linear.
_LINEAR = 12.0
_LARGEST_VOLTAGE = 400.0
#: Units whose values are written with SPICE's suffixes.
_PREFIXED = ("m", "V", "A", "ohm", "ohm m", "F", "Hz", "s", "V/m")


def sliders(base: Circuit, shown: Circuit) -> list[dict[str, Any]]:
    """Sliders by element, of sources, gap and layers first; values of the deck's `base` set the ranges, which stay."""
    driving = {e.name for e in driving_sources(shown)}
    before = {e.name: e for e in base.elements}
    order = {"V": 0, "I": 0, "GAP": 1, "LAYER": 2, "SLAB": 2, "SKIN": 3, "SKIN_DISPERSIVE": 3}
    groups = []
    for e in sorted(shown.elements, key=lambda e: order.get(e.device, 4)):
        old, drives = before[e.name], e.name in driving
        rows: list[tuple[str, str, float, bool, str, tuple[float, float, bool]]] = []
        for spec in e.spec.parameters:
            limits = _of_parameter(spec, old.values.get(spec.name, e.values[spec.name]))
            rows.append((spec.name, spec.unit, e.values[spec.name], spec.first, spec.meaning, limits))
        same = type(old.waveform) is type(e.waveform)
        for name, unit in type(e.waveform).units.items() if e.waveform is not None else ():
            value = getattr(e.waveform, name, None)
            if isinstance(value, (int, float)):
                own = getattr(old.waveform, name) if same else value
                # A source that does not drive is on an area node, and gives mm^2.
                limits = _of_waveform(name, unit, own) if drives else (0.1 * abs(own), 10.0 * abs(own), False)
                unit = unit if unit != "V" else "mm^2" if not drives else "A" if e.device == "I" else "V"
                rows.append((name, unit, value, name in _FIRST_OF_SOURCES, MEANINGS_OF_WAVEFORMS.get(name, ""), limits))
        found = [
            {"path": f"{e.name}.{name}", "unit": unit, "value": value if math.isfinite(value) else None,
             "text": value_text(value, unit), "low": low, "high": high, "log": log, "first": first, "meaning": meaning}
            for name, unit, value, first, meaning, (low, high, log) in rows
        ]  # fmt: skip
        if found:
            groups.append({"element": e.name, "device": e.device, "what": e.spec.what or e.device, "sliders": found})
    return groups


def value_text(value: float, unit: str) -> str:
    """A value for a field of the page: in SPICE's notation if its unit takes a prefix and that is the same double."""
    text = spice_text(value) if unit in _PREFIXED and math.isfinite(value) else f"{value:.12g}"
    return text if not math.isfinite(value) or parse_number(text) == value else repr(float(value))


def _of_parameter(spec: ParameterSpec, value: float) -> tuple[float, float, bool]:
    """Ends of a device parameter's slider, and whether it is logarithmic."""
    assert spec.usual is not None
    least, most = spec.usual.least, spec.usual.most
    if not math.isfinite(value):
        return least, most, True
    if spec.may_be_zero:
        return 0.0, (5.0 * value or _FROM_ZERO.get(spec.name, most)), False
    if most / least <= _LINEAR:
        return min(least, value), max(most, value), False
    low, high = max(least, value / _SPAN), min(most, value * _SPAN)
    return min(low, value), max(high, value), True


def _of_waveform(name: str, unit: str, value: float) -> tuple[float, float, bool]:
    """Ends of the slider of a number of a waveform, and whether it is logarithmic."""
    if not math.isfinite(value):
        return 1e-5, 1.0, True
    if unit == "V":
        most = _LARGEST_VOLTAGE if 1.0 <= abs(value) <= _LARGEST_VOLTAGE or value == 0.0 else 2.0 * abs(value)
        return (0.0 if name == "amplitude" and value >= 0.0 else -most), most, False
    if unit == "Hz" and value > 0.0:
        return min(1.0, value), max(1e5, value), True
    if unit == "deg":
        return -180.0, 180.0, False
    if name in ("duty", "depth"):
        return 0.01 if name == "duty" else 0.0, 0.99 if name == "duty" else 1.0, False
    if unit == "s" and value > 0.0:
        return value / _SPAN, value * _SPAN, True
    return 0.0, (5.0 * abs(value) or (0.1 if unit == "s" else 1000.0)), False


#: Largest number of characters of a source's text.
LONGEST = 20_000
_NAMED = re.compile(r"(?:\s*([\w.]+)\s*=)?\s*(.*)", re.DOTALL)
#: The source that stands for the file dropped on the page.
RECORDING = "RECORDING"
_RECORDED = re.compile(rf"\s*{RECORDING}\s*\(([^()]*)\)\s*", re.IGNORECASE)


class Argument(NamedTuple):
    """One number of a waveform, with its slider's range; an optional one may be left out, and then has its `value`."""

    name: str
    unit: str
    value: float
    low: float
    high: float
    log: bool = False
    optional: bool = False


def _usual(name: str, value: float, unit: str = "Hz", *, optional: bool = False) -> Argument:
    """An argument with the range that it has as a parameter of a source."""
    return Argument(name, unit, value, *_of_waveform(name, unit, value), optional)


_AMPLITUDE, _FREQUENCY = _usual("amplitude", 200.0, "V"), _usual("frequency", 100.0)
#: By function: its name on the page, and its numbers in their order.
WAVEFORMS: dict[str, tuple[str, tuple[Argument, ...]]] = {
    "SIN": ("Sine", (_usual("offset", 0.0, "V"), _AMPLITUDE, _FREQUENCY)),
    "SQUARE": ("Square wave", (_AMPLITUDE, _FREQUENCY, _usual("duty", 0.5, "", optional=True))),
    "TRIANGLE": ("Triangle", (_AMPLITUDE, _FREQUENCY)),
    "SAWTOOTH": ("Sawtooth", (_AMPLITUDE, _FREQUENCY)),
    "AM": ("Carrier with envelope", (
        *(_AMPLITUDE, _usual("carrier", 5e3), _usual("envelope", 50.0), _usual("depth", 1.0, "", optional=True)),
    )),
    "BURST": ("Bursts", (
        *(_AMPLITUDE, _usual("frequency", 5e3), Argument("cycles", "", 10.0, 1.0, 100.0)),
        Argument("every", "s", 10e-3, 1e-3, 1.0, True),
    )),
    "CHIRP": ("Chirp", (
        *(_usual("amplitude", 150.0, "V"), _usual("from", 20.0), _usual("to", 1e3)),
        Argument("duration", "s", 0.05, 1e-2, 3.0, True),
    )),
    "EXP": ("Step that rises and falls", (
        *(_usual("low", 0.0, "V"), _usual("high", 200.0, "V"), Argument("start", "s", 1e-3, 0.0, 0.05)),
        *(Argument("rise", "s", 1e-3, 1e-5, 0.1, True), Argument("end", "s", 20e-3, 0.0, 0.1)),
        Argument("fall", "s", 2e-3, 1e-5, 0.1, True),
    )),
    RECORDING: ("Recording or table, dropped here", (Argument("gain", "V", 150.0, 0.0, 400.0),)),
    "DC": ("Constant", (_usual("level", 200.0, "V"),)),
}  # fmt: skip
#: Waveforms that the page can say as text; their numbers are those of the menu, one of them by another name.
_TEXTS = {Sine: "SIN", Square: "SQUARE", Triangle: "TRIANGLE", Sawtooth: "SAWTOOTH", AM: "AM", DC: "DC"}
_FIELDS = {"envelope": "modulation"}


def read_source(
    text: str, circuit: Circuit, recording: Recording | None = None
) -> tuple[str, Waveform, float | None]:  # fmt: skip
    """The source's name, its new waveform, and the gain (V) of one that is a recording.

    They are read from text such as ``SQUARE(200 100)`` or ``Vdrive=AM(200 5k 50)``. No file is read, whatever the text
    names; ``RECORDING(150)`` is the recording given.
    """
    if len(text) > LONGEST:
        raise InputError(f"the source has {len(text):,} characters; allowed: at most {LONGEST:,}")
    names = {e.name.lower(): e.name for e in driving_sources(circuit)}
    named = _NAMED.fullmatch(text)
    assert named is not None
    given = named[1] or next(iter(names), "")
    if given.lower() not in names:
        known = ", ".join(names.values()) or "none, as it has no source"
        raise InputError(f"{given or text!r} is not a source of the circuit; allowed: {known}")
    name, recorded = names[given.lower()], _RECORDED.fullmatch(named[2])
    if recorded is None:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", FingerspiceWarning)
            return name, source_from_text(named[2], circuit, files=False), None
    words = recorded[1].replace(",", " ").split()
    if len(words) != 1:
        raise InputError(f"{RECORDING} is given {len(words)} numbers; allowed: {RECORDING}(gain)")
    try:
        gain = parse_number(words[0])
    except ValueError as error:
        raise InputError(f"{RECORDING}: {error}") from None
    if recording is None:
        raise InputError("the source is a recording, which a link does not carry; allowed: drop its file on the page")
    return name, recording.waveform(gain), gain


def text_of(waveform: Waveform) -> str | None:
    """The text that `read_source` reads as this waveform; None of one for which the page has no function."""
    kind = _TEXTS.get(type(waveform))
    if kind is None:
        return None
    names = [_FIELDS.get(a.name, a.name) for a in WAVEFORMS[kind][1]]
    return f"{kind}({' '.join(value_text(getattr(waveform, name), waveform.units[name]) for name in names)})"
