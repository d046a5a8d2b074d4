"""What the page asks for: its values checked, and the circuit made of them; and how answers are written."""

from __future__ import annotations

import base64
import binascii
import dataclasses
import json
import math
import struct
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from types import MappingProxyType
from typing import Any

import numpy as np

from fingerspice.base.arrays import FloatArray
from fingerspice.base.errors import InputError
from fingerspice.base.units import parse_number
from fingerspice.circuit.circuit import CHARGE_LAWS, Circuit, nearest
from fingerspice.circuit.loop import network_of
from fingerspice.circuit.topology import SLABS, count_of, driving_sources
from fingerspice.explorer.sliders import gain_of, read_source
from fingerspice.netlist.netlist import parse_netlist
from fingerspice.results.solution import Solution
from fingerspice.waveforms.combinations import Sum
from fingerspice.waveforms.ramps import PWL
from fingerspice.waveforms.samples import Samples
from fingerspice.waveforms.waveform import Waveform, require

#: Limits of a deck and of its run: each answer has to come within seconds.
LONGEST_DECK, MOST_ELEMENTS, MOST_OVERRIDES = 100_000, 200, 500
MOST_PERIODS, MOST_TIMES, MOST_BREAKPOINTS = 200.0, 2e5, 2e5
#: Points of a curve, and most of them where a source oscillates often; points of an oscillation, and of what lies
#: between two jumps or samples.
POINTS, MOST_POINTS = 2000, 12_000
_OF_OSCILLATION, _OF_PIECE = 16, 2
SKINS = ("own", "follow", "dispersive")
_LARGEST, _LONGEST_SETS = 1e300, 2000
_AREAS = ("coupled", "mean", "frozen")
_RANGES = {"rtol": (1e-12, 0.1), "periods": (0.01, MOST_PERIODS), "last": (0.01, MOST_PERIODS)}

#: Most numbers of a recording: four seconds at 48 kHz.
MOST_SAMPLES = 200_000
_KEYS_OF_RECORDING = "an object with the keys name, values, and rate or times"


@dataclass(frozen=True, eq=False)
class Recording:
    """A file's numbers."""

    name: str  # Of the file, for the script that "Copy as Python" gives
    values: FloatArray  # From -1 to 1 for full scale of a recording; as in the file for a table
    rate: float | None = None  # Samples per second
    times: FloatArray | None = None  # Times of a table, s

    @property
    def duration(self) -> float:
        """Time of the last value, s."""
        return float(self.times[-1]) if self.times is not None else self.values.size / (self.rate or 1.0)

    def waveform(self, gain: float) -> Waveform:
        """The values times the gain (V) as a source."""
        if self.times is not None:
            return PWL(tuple(self.times.tolist()), tuple((gain * self.values).tolist()))
        assert self.rate is not None
        return Samples(gain * self.values, self.rate)

    def python(self, gain: float) -> str:
        """The same source from its file, as Python."""
        if self.times is not None:
            return f"{gain!r} * fs.PWL.from_table({self.name!r})"
        return f"fs.Samples.from_wav({self.name!r}, {gain!r}, channel=0)"


@dataclass(frozen=True)
class Request:
    """What the page asks for."""

    deck: str  # Text of the netlist
    overrides: Mapping[str, float] = field(default_factory=dict)  # Path to value, in the netlist's unit
    # Text of another source, ``SQUARE(200 100)`` or ``NAME=SQUARE(200 100)``; empty for the deck's own
    source: str = ""
    charge_law: str | None = None  # None for the deck's own
    area: str | float = "coupled"  # As in `simulate`
    # ``own``: the data of SKIN are taken at its f; ``follow``: at the source's fundamental; ``dispersive``: at all
    # frequencies
    skin: str = "own"
    rtol: float = 1e-6  # Largest error of gap voltage and force, relative to their peaks
    # Length of the run in periods of the source; a source without a period runs to the deck's TSTOP
    periods: float = 5.0
    last: float | None = None  # How many of the last periods are shown; None for all of the run
    recording: Recording | None = None  # The file dropped on the page, for the source ``RECORDING(gain)``
    # Named sets whose values are in `overrides` and `source`, as ``NAME`` or ``ELEMENT=NAME``; they change nothing, and
    # the page shows their caveats
    sets: tuple[str, ...] = ()
    unknown: tuple[str, ...] = ()  # Names that mean nothing here, each in a sentence


_NAMES = tuple(f.name for f in dataclasses.fields(Request) if f.name != "unknown")


def request_of(given: Any) -> Request:
    """A request from plain data; wrong values are refused, and names that are not known only noted."""
    require(
        isinstance(given, dict), "the request", type(given).__name__, "an object with the keys " + ", ".join(_NAMES)
    )
    unknown = tuple(_unknown("name", str(name), _NAMES) for name in given if name not in _NAMES)
    asked = {name: given[name] for name in _NAMES if given.get(name) is not None}
    deck, source = asked.get("deck"), asked.get("source", "")
    require(isinstance(deck, str), "deck", f"of type {type(deck).__name__}", "the text of a netlist")
    assert isinstance(deck, str)
    require(len(deck) <= LONGEST_DECK, "deck", f"{len(deck):,} characters long", f"at most {LONGEST_DECK:,}")
    require(isinstance(source, str), "source", f"of type {type(source).__name__}", "text such as SQUARE(200 100)")
    for name, allowed in (("charge_law", CHARGE_LAWS), ("skin", SKINS)):
        require(asked.get(name, allowed[0]) in allowed, name, _short(asked.get(name)), " or ".join(allowed))
    sets = asked.get("sets", "")
    good = isinstance(sets, str) and len(sets) <= _LONGEST_SETS
    require(good, "sets", _short(sets), f"names with commas, at most {_LONGEST_SETS:,} characters")
    if "area" in asked:
        asked["area"] = _area(asked["area"])
    for name, (least, most) in _RANGES.items():
        if name in asked:
            good = _is_number(asked[name]) and least <= asked[name] <= most
            require(good, name, _short(asked[name]), f"{least:g} to {most:g}")
            asked[name] = float(asked[name])
    asked |= {"source": source.strip(), "overrides": _overrides(asked.get("overrides", {}))}
    asked["sets"] = tuple(filter(None, map(str.strip, sets.split(","))))
    if "recording" in asked:
        asked["recording"] = recording_of(asked["recording"])
    return Request(**asked, unknown=unknown)


def _area(given: Any) -> str | float:
    """The area of a run: a mode's name, or a number of m^2, which a link gives as text."""
    if given in _AREAS:
        return str(given)
    try:
        area = parse_number(given.strip()) if isinstance(given, str) else given
    except ValueError:
        area = None
    require(_is_number(area), "area", _short(given), ", ".join(_AREAS) + " or a number of m^2")
    assert area is not None
    return float(area)


def recording_of(given: Any) -> Recording:
    """A recording from plain data, checked."""
    require(isinstance(given, dict), "recording", type(given).__name__, _KEYS_OF_RECORDING)
    name, rate = given.get("name"), given.get("rate")
    require(isinstance(name, str) and len(name) <= 200, "recording name", repr(name)[:80], "a file's name")
    values = _numbers("values", given.get("values"))
    if given.get("times") is not None:
        times = _numbers("times", given["times"])
        require(times.size == values.size, "recording", f"{times.size} times, {values.size} values", "as many of each")
        return Recording(name, values, times=times)
    good = isinstance(rate, (int, float)) and not isinstance(rate, bool) and 1.0 <= rate <= 1e7
    require(good, "recording rate", repr(rate)[:80], "1 to 1e7 samples per second")
    assert rate is not None
    return Recording(name, values, float(rate))


def _numbers(what: str, given: Any) -> FloatArray:
    """Numbers from base64 of little-endian doubles."""
    try:
        data = base64.b64decode(given if isinstance(given, str) else "?", validate=True)
        values = np.frombuffer(data, "<f8").astype(float)
    except (ValueError, binascii.Error):
        raise InputError(f"recording {what}: not base64 of doubles") from None
    allowed = f"2 to {MOST_SAMPLES:,}"
    require(2 <= values.size <= MOST_SAMPLES, f"recording {what}", f"{values.size:,} numbers", allowed)
    require(bool(np.isfinite(values).all()), f"recording {what}", "not finite", "finite numbers")
    return values


def asked_by(solution: Solution) -> dict[str, Any]:
    """How a run was made, as far as a request can say it."""
    area: str | float = solution.area_mode
    if solution.area_mode not in _AREAS and solution.area is not None:
        # All areas of such a run are the one number that it was given.
        area = float(np.ravel(solution.area)[0])
    asked = {"charge_law": solution.charge_law, "rtol": _within("rtol", solution.rtol), "area": area}
    if solution.period:
        asked["periods"] = float(f"{_within('periods', solution.t_stop / solution.period):.6g}")
    return asked


def _within(name: str, value: float) -> float:
    least, most = _RANGES[name]
    return min(max(value, least), most)


def _overrides(given: Any) -> dict[str, float]:
    """Values by path; texts are numbers in SPICE's notation."""
    require(isinstance(given, dict), "overrides", type(given).__name__, "an object from paths to numbers")
    require(len(given) <= MOST_OVERRIDES, "overrides", f"{len(given):,} values", f"at most {MOST_OVERRIDES}")
    found: dict[str, float] = {}
    for path, value in given.items():
        if isinstance(value, str) and value.strip().lower() == "inf":
            found[path] = math.inf
            continue
        try:
            number = parse_number(value.strip()) if isinstance(value, str) else value
        except ValueError as error:
            raise InputError(f"{path}: {error}") from None
        require(_is_number(number), _short(path), _short(value), "a number, or text such as 3.5u")
        found[path] = float(number)
    return found


def circuits_of(request: Request, own: Circuit | None = None) -> tuple[Circuit, Circuit, tuple[str, ...]]:
    """The deck's circuit, the circuit with all changes, and sentences about names that it does not know.

    The circuit for which the page was opened, `own`, stands for its own text, and may have files and functions that a
    text from the page may not name.
    """
    base = own if own is not None and request.deck == own.text else _parsed(request.deck)
    if request.skin == "dispersive":
        own_skins = base
        base = base.remember("dispersive", lambda: _dispersive(own_skins))
    if base is not own:
        _refuse_large(base)
    circuit = base
    if request.source:
        name, waveform = read_source(request.source, circuit, request.recording)
        circuit = circuit.replace({name: waveform})
    paths = {path.lower(): path for path in circuit.parameters}
    known = {paths[path.lower()]: x for path, x in request.overrides.items() if path.lower() in paths}
    lost = [path for path in request.overrides if path.lower() not in paths]
    if known:
        circuit = circuit.replace(known)
    if request.skin == "follow":
        circuit = _following(circuit)
    return base, circuit, tuple(_unknown("parameter", path, circuit.parameters) for path in lost)


def waveform_of(circuit: Circuit) -> Waveform:
    """All sources of a circuit as one waveform."""
    waveforms = network_of(circuit).waveforms
    return waveforms[0] if len(waveforms) == 1 else Sum(waveforms)


def times_of(circuit: Circuit, request: Request) -> tuple[float, float, float | None]:
    """First time shown and end of the run, s, and the period of the source, s, or None.

    A run that is too long for a page that answers at once is refused.
    """
    waveform = waveform_of(circuit)
    period = waveform.period
    first = 0.0
    if period is None or not math.isfinite(period):
        period = None
        stop = circuit.tran.stop if circuit.tran is not None else 0.05
        if request.recording is not None and gain_of(request.source) is not None:
            stop = request.recording.duration
    else:
        stop = waveform.settled + request.periods * period
        if request.last is not None:
            first = max(stop - request.last * period, 0.0)
    require(math.isfinite(stop) and stop > 0.0, "the run", f"{stop:g} s long", "more than 0 s")
    count, edges = stop / waveform.shortest_time(), stop * waveform.breakpoint_rate()
    too_long = f"{stop:g} s long, {count:.3g} periods or time constants and {edges:.3g} jumps of its source"
    allowed = f"at most {MOST_TIMES:g} of each on this page"
    require(count <= MOST_TIMES and edges <= MOST_BREAKPOINTS, "the run", too_long, allowed)
    return first, stop, period


def points_of(circuit: Circuit, first: float, last: float) -> tuple[int, str]:
    """The number of points of a curve between two times (s), and a warning where they are too few for its shape."""
    waveform = waveform_of(circuit)
    count, edges = (last - first) / waveform.shortest_time(), (last - first) * waveform.breakpoint_rate()
    wanted = max(_OF_OSCILLATION * count, _OF_PIECE * edges)
    points = int(min(max(POINTS, math.ceil(wanted)), MOST_POINTS))
    if 2.0 * points >= wanted:
        return points, ""
    many = f"{count:,.0f} oscillations" if _OF_OSCILLATION * count >= _OF_PIECE * edges else f"{edges:,.0f} samples"
    return points, (
        f"the curves have {points:,} points for {many} of the source, too few for their shape; the figures in the "
        "table do not suffer; fewer periods, or only the last one, show more"
    )


@lru_cache(maxsize=32)
def _parsed(text: str) -> Circuit:
    """The circuit of a text from the page, which may include no file."""
    circuit = parse_netlist(text)
    driving_sources(circuit)
    return circuit


def _refuse_large(circuit: Circuit) -> None:
    """Refuse a circuit whose run would take longer than a page may."""
    if count_of(circuit) > MOST_ELEMENTS:
        raise InputError(
            f"the deck has {count_of(circuit):,} elements, a dispersive skin counted as its {SLABS} slabs; allowed: "
            f"at most {MOST_ELEMENTS} on this page"
        )


def _dispersive(circuit: Circuit) -> Circuit:
    """The circuit with the data of every skin at all frequencies."""
    elements = tuple(
        dataclasses.replace(e, device="SKIN_DISPERSIVE", values=MappingProxyType({"d": e.values["d"]}))
        if e.device == "SKIN"
        else e
        for e in circuit.elements
    )
    return dataclasses.replace(circuit, elements=elements)


def _following(circuit: Circuit) -> Circuit:
    """The circuit with the data of every skin at the source's fundamental."""
    fundamental = waveform_of(circuit).fundamental
    if fundamental is None:
        return circuit
    return circuit.replace({f"{e.name}.f": fundamental.frequency for e in circuit.by_device("SKIN")})


def _unknown(kind: str, name: str, known: Iterable[str]) -> str:
    near = nearest(name, list(known))
    hint = "" if near is None else f"; nearest: {near!r}"
    return f"unknown {kind} {_short(name)}, which is left out{hint}"


def _is_number(x: Any) -> bool:
    return isinstance(x, (int, float)) and not isinstance(x, bool) and abs(x) <= _LARGEST


def _short(x: Any) -> str:
    text = repr(x)
    return text if len(text) <= 80 else f"{text[:60]}..."


def as_json(data: Any) -> bytes:
    """Data as JSON: arrays of numbers as base64 of little-endian doubles, and null for what is not finite."""
    return _dumped(data, lambda x: {"f64": base64.b64encode(_doubles(x)).decode("ascii")})


def framed(data: Any) -> bytes:
    """Data as the JSON's length and the number of doubles (four bytes each), the JSON, and the doubles of all arrays.

    All numbers are little-endian. In the JSON an array is its place among the doubles, and its size. The doubles begin
    at a multiple of eight bytes, so that the page need not copy them.
    """
    arrays: list[bytes] = []
    places: dict[int, list[int]] = {}
    end = 0

    def place(x: Any) -> dict[str, list[int]]:
        nonlocal end
        if id(x) not in places:
            arrays.append(_doubles(x))
            places[id(x)] = [end, x.size]
            end += x.size
        return {"f64": places[id(x)]}

    text = _dumped(data, place)
    text += b" " * (-len(text) % 8)
    return b"".join([struct.pack("<II", len(text), end), text, *arrays])


def _doubles(x: Any) -> bytes:
    assert isinstance(x, np.ndarray)
    return np.ascontiguousarray(x, "<f8").tobytes()


def _dumped(data: Any, array: Callable[[Any], Any]) -> bytes:
    """Data as JSON, with `array` for its arrays, and null for what is not finite."""

    def finite(x: Any) -> Any:
        if isinstance(x, dict):
            return {key: finite(value) for key, value in x.items()}
        if isinstance(x, list | tuple):
            return [finite(value) for value in x]
        return x if not isinstance(x, float) or math.isfinite(x) else None

    try:
        return json.dumps(data, allow_nan=False, default=array).encode()
    except ValueError:
        # Seldom, and all data have to be gone through.
        return json.dumps(finite(data), allow_nan=False, default=array).encode()
