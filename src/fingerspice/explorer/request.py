"""What the page asks for: its values checked, and the circuit and the times of its run made of them."""

from __future__ import annotations

import base64
import dataclasses
import math
import warnings
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import cached_property, lru_cache, partial
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from fingerspice.base.arrays import FloatArray
from fingerspice.base.errors import InputError
from fingerspice.base.units import parse_number
from fingerspice.circuit.circuit import CHARGE_LAWS, Circuit, nearest
from fingerspice.circuit.loop import network_of
from fingerspice.circuit.topology import SLABS, count_of, driving_sources
from fingerspice.explorer.sliders import read_source
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
#: Most numbers of a recording: four seconds at 48 kHz.
MOST_SAMPLES = 200_000
_LARGEST, _LONGEST_SETS = 1e300, 2000
_AREAS = ("coupled", "mean", "frozen")
_RANGES = {"rtol": (1e-12, 0.1), "periods": (0.01, MOST_PERIODS), "last": (0.01, MOST_PERIODS)}


class Recording(NamedTuple):
    """A file's numbers."""

    name: str  # Of the file, for the script that "Copy as Python" gives
    values: FloatArray  # From -1 to 1 for full scale of a recording; as in the file for a table
    times: FloatArray | None  # Times of a table, s; None of a recording
    rate: float = 1.0  # Samples per second of a recording

    def waveform(self, gain: float) -> Waveform:
        """The values times the gain (V) as a source."""
        if self.times is not None:
            return PWL(tuple(self.times.tolist()), tuple((gain * self.values).tolist()))
        return Samples(gain * self.values, self.rate)

    def python(self, gain: float) -> str:
        """The same source from its file, as Python."""
        if self.times is not None:
            return f"{gain!r} * fs.PWL.from_table({self.name!r})"
        return f"fs.Samples.from_wav({self.name!r}, {gain!r}, channel=0)"


_NAMES = (
    *("deck", "overrides", "source", "charge_law", "area", "skin", "rtol", "periods", "last", "recording", "sets"),
)  # fmt: skip


def _read(name: str, given: Any) -> Any:
    """A value of a request, checked; texts are as in a link."""
    match name:
        case "deck":
            require(isinstance(given, str), name, f"of type {type(given).__name__}", "the text of a netlist")
            require(len(given) <= LONGEST_DECK, name, f"{len(given):,} characters long", f"at most {LONGEST_DECK:,}")
            return given
        case "source":
            require(isinstance(given, str), name, f"of type {type(given).__name__}", "text such as SQUARE(200 100)")
            return given.strip()
        case "charge_law" | "skin":
            allowed = CHARGE_LAWS if name == "charge_law" else ("own", "follow", "dispersive")
            require(given in allowed, name, _short(given), " or ".join(allowed))
            return given
        case "sets":
            good = isinstance(given, str) and len(given) <= _LONGEST_SETS
            require(good, name, _short(given), f"names with commas, at most {_LONGEST_SETS:,} characters")
            return tuple(filter(None, map(str.strip, given.split(","))))
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
            return {path: _override(path, value) for path, value in given.items()}
        case "recording":
            return _recording(given)
    least, most = _RANGES[name]
    require(_is_number(given) and least <= given <= most, name, _short(given), f"{least:g} to {most:g}")
    return float(given)


def _override(path: str, value: Any) -> float:
    if isinstance(value, str) and value.strip().lower() == "inf":
        return math.inf
    try:
        number = parse_number(value.strip()) if isinstance(value, str) else value
    except ValueError as error:
        raise InputError(f"{path}: {error}") from None
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
    good = _is_number(rate) and 1.0 <= rate <= 1e7
    require(good, "recording rate", repr(rate)[:80], "1 to 1e7 samples per second")
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


@contextmanager
def quiet() -> Iterator[None]:
    """Nothing inside warns: the scene itself says what there is to say."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


def asked_by(solution: Solution) -> dict[str, Any]:
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

    base: Circuit  # The deck's
    circuit: Circuit  # With all changes
    replaced: tuple[str, Waveform] | None = None  # What `source` says: the name of the source, and its new waveform
    gain: float | None = None  # V, of a source that is a recording
    unknown: list[str]  # Sentences about names that mean nothing here

    def __init__(self, given: Any, own: Circuit | None = None) -> None:
        keys = f"an object with the keys {', '.join(_NAMES)}"
        require(isinstance(given, dict), "the request", type(given).__name__, keys)
        for name in _NAMES:
            if name == "deck" or given.get(name) is not None:
                setattr(self, name, _read(name, given.get(name)))
        base = own if own is not None and self.deck == own.text else _parsed(self.deck)
        if self.skin == "dispersive":
            base = base.remember("dispersive", partial(_dispersive, base))
        if base is not own and count_of(base) > MOST_ELEMENTS:
            raise InputError(
                f"the deck has {count_of(base):,} elements, a dispersive skin counted as its {SLABS} slabs; allowed: "
                f"at most {MOST_ELEMENTS} on this page"
            )
        circuit = base
        if self.source:
            name, waveform, self.gain = read_source(self.source, circuit, self.recording)
            self.replaced = name, waveform
            circuit = circuit.replace({name: waveform})
        paths = {path.lower(): path for path in circuit.parameters}
        known = {paths[path.lower()]: x for path, x in self.overrides.items() if path.lower() in paths}
        self.unknown = [_unknown("name", str(name), _NAMES) for name in given if name not in _NAMES]
        lost = [path for path in self.overrides if path.lower() not in paths]
        self.unknown += [_unknown("parameter", path, paths.values()) for path in lost]
        if known:
            circuit = circuit.replace(known)
        self.base, self.circuit = base, circuit
        fundamental = self.waveform.fundamental if self.skin == "follow" else None
        if fundamental is not None:
            self.circuit = circuit.replace({f"{e.name}.f": fundamental.frequency for e in circuit.by_device("SKIN")})

    @cached_property
    def waveform(self) -> Waveform:
        """All sources as one waveform."""
        waveforms = network_of(self.circuit).waveforms
        return waveforms[0] if len(waveforms) == 1 else Sum(waveforms)

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


def _dispersive(circuit: Circuit) -> Circuit:
    """The circuit with the data of every skin at all frequencies."""
    elements = tuple(
        dataclasses.replace(e, device="SKIN_DISPERSIVE", values=MappingProxyType({"d": e.values["d"]}))
        if e.device == "SKIN"
        else e
        for e in circuit.elements
    )
    return dataclasses.replace(circuit, elements=elements)


def _unknown(kind: str, name: str, known: Iterable[str]) -> str:
    near = nearest(name, list(known))
    hint = "" if near is None else f"; nearest: {near!r}"
    return f"unknown {kind} {_short(name)}, which is left out{hint}"


def _is_number(x: Any) -> bool:
    return isinstance(x, (int, float)) and not isinstance(x, bool) and abs(x) <= _LARGEST


def _short(x: Any) -> str:
    text = repr(x)
    return text if len(text) <= 80 else f"{text[:60]}..."
