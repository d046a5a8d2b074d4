"""The page's sliders and menu of waveforms; its requests, checked, with the circuit and the times made of them."""

from __future__ import annotations

import base64
import math
import re
import tomllib
import warnings
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import cached_property, lru_cache, partial
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

import fingerspice as fs
from fingerspice.base.arrays import FloatArray
from fingerspice.base.errors import InputError
from fingerspice.base.units import parse_number, spice_text
from fingerspice.circuit.circuit import CHARGE_LAWS, nearest, number_from
from fingerspice.circuit.devices import FIRST_OF_SOURCES, MEANINGS, ParameterSpec
from fingerspice.circuit.network import network_of
from fingerspice.circuit.statespace import SLABS, count_of, driving_sources
from fingerspice.netlist.netlist import source_from_text
from fingerspice.waveforms.waveform import refuse, require

_SPAN = 100.0  # A slider goes from the deck's value over this to its value times this, within the usual range
_LINEAR = 12.0  # Ratio of the ends of a usual range up to which its slider is linear
_LARGEST_VOLTAGE = 400.0
_PREFIXED = ("m", "V", "A", "ohm", "ohm m", "F", "Hz", "s", "V/m")  # Units of values with SPICE's suffixes


def sliders(base: fs.Circuit, shown: fs.Circuit) -> list[dict[str, Any]]:
    """Sliders by element, of sources, gap and layers first; values of the deck's `base` set the ranges, which stay."""
    driving = {e.name for e in driving_sources(shown)}
    before = {e.name: e for e in base.elements}
    groups = []
    for e in sorted(shown.elements, key=lambda e: e.spec.place):
        old, specs, found = before[e.name], {p.name: p for p in e.spec.parameters}, []
        for name, one in e.parameters.items():
            value, unit, spec = one.value, one.unit, specs.get(name)
            if spec is not None:
                limits, first, meaning = _of_parameter(spec, old.values.get(name, value)), spec.first, spec.meaning
            else:
                own = getattr(old.waveform, name) if type(old.waveform) is type(e.waveform) else value
                # A source that does not drive is on an area node, and gives mm^2.
                drives = e.name in driving
                limits = _of_waveform(name, unit, own) if drives else (0.1 * abs(own), 10.0 * abs(own), False)
                unit = unit if unit != "V" else "mm^2" if not drives else "A" if e.device == "I" else "V"
                first, meaning = name in FIRST_OF_SOURCES, MEANINGS.get(name, "")
            found.append({
                "path": f"{e.name}.{name}", "unit": unit, "value": value if math.isfinite(value) else None,
                "text": value_text(value, unit), "low": limits[0], "high": limits[1], "log": limits[2],
                "first": first, "meaning": meaning,
            })  # fmt: skip
        if found:
            groups.append({"element": e.name, "device": e.device, "what": e.spec.what or e.device, "sliders": found})
    return groups


def value_text(value: float, unit: str) -> str:
    """A value for a field of the page: in SPICE's notation if its unit takes a prefix and that is the same double."""
    text = spice_text(value) if unit in _PREFIXED and math.isfinite(value) else f"{value:.12g}"
    return text if not math.isfinite(value) or parse_number(text) == value else repr(float(value))


def _of_parameter(spec: ParameterSpec, value: float) -> tuple[float, float, bool]:
    """Ends of a device parameter's slider, and whether it is logarithmic."""
    if spec.usual is None or spec.least < 0.0:  # Of a contact law, or a gain
        return min(0.0, 5.0 * value), max(0.0, 5.0 * value) or 1.0, False
    least, most = spec.usual.least, spec.usual.most
    if not math.isfinite(value):
        return least, most, True
    if spec.may_be_zero:
        return 0.0, (5.0 * value or spec.slider or most), False
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


_NAMED = re.compile(r"(?:\s*([\w.]+)\s*=)?\s*(.*)", re.DOTALL)
RECORDING = "RECORDING"  # The source that stands for the file dropped on the page
_RECORDED = re.compile(rf"\s*{RECORDING}\s*\(([^()]*)\)\s*", re.IGNORECASE)


def _argument(name: str, value: float, unit: str = "", **given: Any) -> dict[str, Any]:
    """A number of a waveform, with the slider that it has as a parameter of a source unless the menu gives its own.

    An optional one may be left out, and then has its value.
    """
    low, high, log = _of_waveform(name, unit, value)
    own = {"name": name, "unit": unit, "value": value, "low": low, "high": high, "log": log, "optional": False}
    return own | given


#: The page's menus, of waveforms and of scenes.
MENUS = tomllib.loads(Path(__file__).with_name("menus.toml").read_text(encoding="utf-8"))
#: The waveforms by function, each with its numbers in their order.
WAVEFORMS = {x["kind"]: x | {"arguments": [_argument(**one) for one in x["arguments"]]} for x in MENUS["waveform"]}
#: Waveforms that the page can say as text; their numbers are those of the menu, one of them by another name.
_TEXTS = {"Sine": "SIN", "Square": "SQUARE", "Triangle": "TRIANGLE", "Sawtooth": "SAWTOOTH", "AM": "AM", "DC": "DC"}
_FIELDS = {"envelope": "modulation"}


@contextmanager
def quiet() -> Iterator[None]:
    """Nothing inside warns: the scene itself says what there is to say."""
    with warnings.catch_warnings(action="ignore"):
        yield


def read_source(
    text: str, circuit: fs.Circuit, recording: Recording | None = None
) -> tuple[str, fs.Waveform, float | None]:
    """The source's name, its new waveform, and the gain (V) of one that is a recording.

    They are read from text such as ``SQUARE(200 100)`` or ``Vdrive=AM(200 5k 50)``. No file is read, whatever the text
    names; ``RECORDING(150)`` is the recording given.
    """
    text = _read("source", text).strip()
    names = {e.name.lower(): e.name for e in driving_sources(circuit)}
    given, said = _NAMED.fullmatch(text).groups()  # type: ignore[union-attr]
    given = given or next(iter(names), "")
    known = ", ".join(names.values()) or "none, as it has no source"
    refuse(given.lower() not in names, f"{given or text!r} is not a source of the circuit; allowed: {known}")
    name, recorded = names[given.lower()], _RECORDED.fullmatch(said)
    if recorded is None:
        with quiet():
            return name, source_from_text(said, circuit, files=False), None
    words = recorded[1].replace(",", " ").split()
    require(len(words) == 1, RECORDING, f"given {len(words)} numbers", f"{RECORDING}(gain)")
    gain = number_from(RECORDING, words[0])
    if recording is None:
        raise InputError("the source is a recording, which a link does not carry; allowed: drop its file on the page")
    return name, recording.waveform(gain), gain


def text_of(waveform: fs.Waveform) -> str | None:
    """The text that `read_source` reads as this waveform; None of one for which the page has no function."""
    kind = _TEXTS.get(type(waveform).__name__)
    if kind is None:
        return None
    names = [_FIELDS.get(a["name"], a["name"]) for a in WAVEFORMS[kind]["arguments"]]
    return f"{kind}({' '.join(value_text(getattr(waveform, name), waveform.units[name]) for name in names)})"


#: Limits of a deck and of its run: each answer has to come within seconds.
LONGEST_DECK, MOST_ELEMENTS, MOST_OVERRIDES = 100_000, 200, 500
MOST_PERIODS, MOST_TIMES, MOST_BREAKPOINTS = 200.0, 2e5, 2e5
#: Points of a curve, and most of them where a source oscillates often; points of an oscillation, and of what lies
#: between two jumps or samples.
POINTS, MOST_POINTS = 2000, 12_000
_OF_OSCILLATION, _OF_PIECE = 16, 2
MOST_SAMPLES = 200_000  # Most numbers of a recording: four seconds at 48 kHz
_LARGEST = 1e300
_AREAS = ("coupled", "mean", "frozen")
#: Texts of a request with what is allowed and their largest length, words to choose from, and ranges of numbers.
_WORDS = {
    "deck": ("the text of a netlist", LONGEST_DECK), "source": ("text such as SQUARE(200 100)", 20_000),
    "sets": ("names with commas", 2000),
}  # fmt: skip
_CHOICES = {"charge_law": CHARGE_LAWS, "skin": ("own", "follow", "dispersive")}
_RANGES = {"rtol": (1e-12, 0.1), "periods": (0.01, MOST_PERIODS), "last": (0.01, MOST_PERIODS)}


class Recording(NamedTuple):
    """A file's numbers."""

    name: str  # Of the file, for the script that "Copy as Python" gives
    values: FloatArray  # From -1 to 1 for full scale of a recording; as in the file for a table
    times: FloatArray | None  # Times of a table, s; None of a recording
    rate: float = 1.0  # Samples per second of a recording

    def waveform(self, gain: float) -> fs.Waveform:
        """The values times the gain (V) as a source."""
        if self.times is not None:
            return fs.PWL(tuple(self.times.tolist()), tuple((gain * self.values).tolist()))
        return fs.Samples(gain * self.values, self.rate)

    def python(self, gain: float) -> str:
        """The same source from its file, as Python."""
        if self.times is not None:
            return f"{gain!r} * fs.PWL.from_table({self.name!r})"
        return f"fs.Samples.from_wav({self.name!r}, {gain!r}, channel=0)"


_NAMES = ("deck", "overrides", "source", "charge_law", "area", "skin", "rtol", "periods", "last", "recording", "sets")


def _read(name: str, given: Any) -> Any:
    """A value of a request, checked; texts are as in a link."""
    match name:
        case "deck" | "source" | "sets":
            allowed, longest = _WORDS[name]
            require(isinstance(given, str), name, f"of type {type(given).__name__}", allowed)
            require(len(given) <= longest, name, f"{len(given):,} characters long", f"at most {longest:,}")
            return given
        case "charge_law" | "skin":
            require(given in _CHOICES[name], name, _short(given), " or ".join(_CHOICES[name]))
            return given
        case "area" if given in _AREAS:
            return str(given)
        case "area":
            area = given
            with suppress(ValueError):
                area = parse_number(given.strip()) if isinstance(given, str) else given
            require(_is_number(area), name, _short(given), ", ".join(_AREAS) + " or a number of m^2")
            return float(area)
        case "overrides":
            require(isinstance(given, dict), name, type(given).__name__, "an object from paths to numbers")
            require(len(given) <= MOST_OVERRIDES, name, f"{len(given):,} values", f"at most {MOST_OVERRIDES}")
            return {path: _override(path, x) for path, x in given.items()}
        case "recording":
            return _recording(given)
    least, most = _RANGES[name]
    require(_is_number(given) and least <= given <= most, name, _short(given), f"{least:g} to {most:g}")
    return float(given)


def _override(path: str, value: Any) -> float:
    if isinstance(value, str) and value.strip().lower() == "inf":
        return math.inf
    number = number_from(path, value) if isinstance(value, str) else value
    require(_is_number(number), _short(path), _short(value), "a number, or text such as 3.5u")
    return float(number)


def _recording(given: Any) -> Recording:
    keys = "an object with the keys name, values, and rate or times"
    require(isinstance(given, dict), "recording", type(given).__name__, keys)
    name, rate = given.get("name"), given.get("rate")
    require(isinstance(name, str) and len(name) <= 200, "recording name", repr(name)[:80], "a file's name")
    values = _numbers("values", given.get("values"))
    if given.get("times") is not None:
        times = _numbers("times", given["times"])
        require(times.size == values.size, "recording", f"{times.size} times, {values.size} values", "as many of each")
        return Recording(name, values, times)
    require(_is_number(rate) and 1.0 <= rate <= 1e7, "recording rate", repr(rate)[:80], "1 to 1e7 samples per second")
    return Recording(name, values, None, float(rate))


def _numbers(what: str, given: Any) -> FloatArray:
    """Numbers from base64 of little-endian doubles."""
    try:
        data = base64.b64decode(given if isinstance(given, str) else "?", validate=True)
        values = np.frombuffer(data, "<f8").astype(float)
    except ValueError:
        raise InputError(f"recording {what}: not base64 of doubles") from None
    allowed = f"2 to {MOST_SAMPLES:,}"
    require(2 <= values.size <= MOST_SAMPLES, f"recording {what}", f"{values.size:,} numbers", allowed)
    require(bool(np.isfinite(values).all()), f"recording {what}", "not finite", "finite numbers")
    return values


def asked_by(solution: fs.Solution) -> dict[str, Any]:
    """How a run was made, as far as a request can say it."""
    area: str | float = solution.area_mode
    if solution.area_mode not in _AREAS and solution.area is not None:
        # All areas of such a run are the one number that it was given.
        area = float(np.ravel(solution.area)[0])
    rtol = float(np.clip(solution.rtol, *_RANGES["rtol"]))
    asked = {"charge_law": solution.charge_law, "rtol": rtol, "area": area}
    if solution.period:
        asked["periods"] = float(f"{np.clip(solution.t_stop / solution.period, *_RANGES['periods']):.6g}")
    return asked


class Asked:
    """What the page asks for, with the circuit made of it; wrong values are refused, and unknown names left out.

    The circuit for which the page was opened, `own`, stands for its own text, and may have files and functions that a
    text from the page may not name.
    """

    deck: str  # Text of the netlist
    overrides: Mapping[str, float] = MappingProxyType({})  # Path to value, in the netlist's unit
    source: str = ""  # Another source, ``SQUARE(200 100)`` or ``NAME=SQUARE(200 100)``; empty for the deck's own
    charge_law: str | None = None  # None for the deck's own
    area: str | float = "coupled"  # As in `simulate`
    skin: str = "own"  # Data of SKIN: own, at its f; follow, at the fundamental; dispersive, at all frequencies
    rtol: float = 1e-6  # Largest error of gap voltage and force, relative to their peaks
    periods: float = 5.0  # Length of the run in periods of the source; without a period it runs to the deck's TSTOP
    last: float | None = None  # How many of the last periods are shown; None for all of the run
    recording: Recording | None = None  # The file dropped on the page, for the source ``RECORDING(gain)``
    # Named sets with commas, ``NAME`` or ``ELEMENT=NAME``, whose caveats the page shows; their values are given already
    sets: str = ""

    base: fs.Circuit  # The deck's
    circuit: fs.Circuit  # With all changes
    replaced: tuple[str, fs.Waveform] | None = None  # What `source` says: the name of the source, and its new waveform
    gain: float | None = None  # V, of a source that is a recording
    unknown: list[str]  # Sentences about names that mean nothing here

    def __init__(self, given: Any, own: fs.Circuit | None = None) -> None:
        keys = f"an object with the keys {', '.join(_NAMES)}"
        require(isinstance(given, dict), "the request", type(given).__name__, keys)
        for name in _NAMES:
            if name == "deck" or given.get(name) is not None:
                setattr(self, name, _read(name, given.get(name)))
        base = own if own is not None and self.deck == own.text else _parsed(self.deck)
        if self.skin == "dispersive":
            base = base.remember(("dispersive",), partial(_dispersive, base))
        count = f"{count_of(base):,} elements, a dispersive skin counted as its {SLABS} slabs"
        few = base is own or count_of(base) <= MOST_ELEMENTS
        refuse(not few, f"the deck has {count}; allowed: at most {MOST_ELEMENTS} on this page")
        circuit = base
        if self.source.strip():
            name, waveform, self.gain = read_source(self.source, circuit, self.recording)
            self.replaced = name, waveform
            circuit = circuit.replace({name: waveform})
        paths = {path.lower(): path for path in circuit.parameters}
        self.unknown = [_unknown("name", str(name), _NAMES) for name in given if name not in _NAMES]
        lost = [path for path in self.overrides if path.lower() not in paths]
        self.unknown += [_unknown("parameter", path, paths.values()) for path in lost]
        self.overrides = {paths[path.lower()]: x for path, x in self.overrides.items() if path.lower() in paths}
        circuit = circuit.replace(self.overrides) if self.overrides else circuit
        self.base, self.circuit = base, circuit
        fundamental = self.waveform.fundamental if self.skin == "follow" else None
        if fundamental is not None:
            self.circuit = circuit.replace({f"{e.name}.f": fundamental.frequency for e in circuit.by_device("SKIN")})

    @cached_property
    def waveform(self) -> fs.Waveform:
        """All sources as one waveform."""
        return network_of(self.circuit).waveform

    @cached_property
    def times(self) -> tuple[float, float, float | None]:
        """First time shown and end of the run, s, and the source's period, s, or None; too long a run is refused."""
        first, period = 0.0, self.waveform.period
        if period is not None and math.isfinite(period):
            stop = self.waveform.settled + self.periods * period
            if self.last is not None:
                first = max(stop - self.last * period, 0.0)
        else:
            period = None
            stop = self.circuit.tran.stop if self.circuit.tran is not None else 0.05
            if self.recording is not None and self.gain is not None:
                _, values, times, rate = self.recording
                stop = float(times[-1]) if times is not None else values.size / rate
        require(math.isfinite(stop) and stop > 0.0, "the run", f"{stop:g} s long", "more than 0 s")
        count, edges = stop / self.waveform.shortest_time(), stop * self.waveform.breakpoint_rate()
        too_long = f"{stop:g} s long, {count:.3g} periods or time constants and {edges:.3g} jumps of its source"
        allowed = f"at most {MOST_TIMES:g} of each on this page"
        require(count <= MOST_TIMES and edges <= MOST_BREAKPOINTS, "the run", too_long, allowed)
        return first, stop, period

    def points(self, first: float, last: float) -> tuple[int, str]:
        """The number of points of a curve between two times (s), and a warning where they are too few for its shape."""
        span = last - first
        count, edges = span / self.waveform.shortest_time(), span * self.waveform.breakpoint_rate()
        wanted = max(_OF_OSCILLATION * count, _OF_PIECE * edges)
        points = int(min(max(POINTS, math.ceil(wanted)), MOST_POINTS))
        if 2.0 * points >= wanted:
            return points, ""
        many = f"{count:,.0f} oscillations" if _OF_OSCILLATION * count >= _OF_PIECE * edges else f"{edges:,.0f} samples"
        few = f"the curves have {points:,} points for {many} of the source, too few for their shape; the figures in the"
        return points, f"{few} table do not suffer; fewer periods, or only the last one, show more"


@lru_cache(maxsize=32)
def _parsed(text: str) -> fs.Circuit:
    """The circuit of a text from the page, which may include no file."""
    circuit = fs.parse_netlist(text)
    driving_sources(circuit)
    return circuit


def _dispersive(circuit: fs.Circuit) -> fs.Circuit:
    """The circuit with the data of every skin at all frequencies."""
    of = {e.name: MappingProxyType({"d": e.values["d"]}) for e in circuit.by_device("SKIN")}
    wide = partial(replace, device="SKIN_DISPERSIVE")
    return replace(circuit, elements=tuple(wide(e, values=of[e.name]) if e.name in of else e for e in circuit.elements))


def _unknown(kind: str, name: str, known: Iterable[str]) -> str:
    hint = "" if (near := nearest(name, list(known))) is None else f"; nearest: {near!r}"
    return f"unknown {kind} {_short(name)}, which is left out{hint}"


def _is_number(x: Any) -> bool:
    return isinstance(x, (int, float)) and not isinstance(x, bool) and abs(x) <= _LARGEST


def _short(x: Any) -> str:
    text = repr(x)
    return text if len(text) <= 80 else f"{text[:60]}..."
