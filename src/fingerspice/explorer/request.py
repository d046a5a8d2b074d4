"""What the page asks for: its values checked, and the circuit made of them."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from difflib import get_close_matches
from functools import lru_cache
from types import MappingProxyType
from typing import Any

import numpy as np

from fingerspice.base.errors import InputError
from fingerspice.base.units import parse_number
from fingerspice.circuit.circuit import CHARGE_LAWS, Circuit
from fingerspice.circuit.loop import network_of
from fingerspice.circuit.topology import driving_sources
from fingerspice.explorer.recordings import Recording, recording_of
from fingerspice.explorer.sliders import gain_of, read_source
from fingerspice.netlist.netlist import parse_netlist
from fingerspice.physics.ladder import SKIN_LADDER
from fingerspice.results.solution import Solution
from fingerspice.waveforms.combinations import Sum
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
    # Named sets whose values are in `overrides` and `source`, as ``NAME`` or ``ELEMENT=NAME`` with commas; they change
    # nothing, and the page shows their caveats
    sets: str = ""
    unknown: tuple[str, ...] = ()  # Names that mean nothing here, each in a sentence


_NAMES = tuple(f.name for f in dataclasses.fields(Request) if f.name != "unknown")


def request_of(given: Any) -> Request:
    """A request from plain data.

    Raises
    ------
    InputError
        If a value is wrong; names that are not known are only noted.
    """
    require(
        isinstance(given, dict), "the request", type(given).__name__, "an object with the keys " + ", ".join(_NAMES)
    )
    unknown = tuple(_unknown("name", str(name), list(_NAMES)) for name in given if name not in _NAMES)
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
    for name in (name for name in ("rtol", "periods", "last") if name in asked):
        value = asked[name]
        most = 0.1 if name == "rtol" else MOST_PERIODS
        good = _is_number(value) and (1e-12 if name == "rtol" else 0.01) <= value <= most
        require(good, name, _short(value), "1e-12 to 0.1" if name == "rtol" else f"0.01 to {most:g}")
        asked[name] = float(value)
    asked |= {"source": source.strip(), "overrides": _overrides(asked.get("overrides", {}))}
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


def asked_by(solution: Solution) -> dict[str, Any]:
    """How a run was made, as far as a request can say it."""
    asked: dict[str, Any] = {"charge_law": solution.charge_law, "rtol": min(max(solution.rtol, 1e-12), 0.1)}
    asked["area"] = solution.area_mode
    if solution.area_mode not in _AREAS and solution.area is not None:
        # All areas of such a run are the one number that it was given.
        asked["area"] = float(np.ravel(solution.area)[0])
    if solution.period:
        asked["periods"] = float(f"{min(max(solution.t_stop / solution.period, 0.01), MOST_PERIODS):.6g}")
    return asked


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

    Parameters
    ----------
    request : Request
    own : Circuit, optional
        The circuit for which the page was opened. It stands for its own text, and may have files and functions that a
        text from the page may not name.

    Raises
    ------
    InputError
        If the deck, the source or a value is wrong.
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
    return base, circuit, tuple(_unknown("parameter", path, list(circuit.parameters)) for path in lost)


def waveform_of(circuit: Circuit) -> Waveform:
    """All sources of a circuit as one waveform."""
    waveforms = network_of(circuit).waveforms
    return waveforms[0] if len(waveforms) == 1 else Sum(waveforms)


def times_of(circuit: Circuit, request: Request) -> tuple[float, float, float | None]:
    """First time shown and end of the run, s, and the period of the source, s, or None.

    Raises
    ------
    InputError
        If the run is too long for a page that answers at once.
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
    slabs = len(SKIN_LADDER.poles)
    count = len(circuit.elements) + slabs * len(circuit.by_device("SKIN_DISPERSIVE"))
    if count > MOST_ELEMENTS:
        raise InputError(
            f"the deck has {count:,} elements, a dispersive skin counted as its {slabs + 1} slabs; allowed: at most "
            f"{MOST_ELEMENTS} on this page"
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


def _unknown(kind: str, name: str, known: list[str]) -> str:
    near = get_close_matches(name.lower(), {k.lower(): k for k in known}, 1, 0.0)
    hint = next((f"; nearest: {k!r}" for k in known if near and k.lower() == near[0]), "")
    return f"unknown {kind} {_short(name)}, which is left out{hint}"


def _is_number(x: Any) -> bool:
    return isinstance(x, (int, float)) and not isinstance(x, bool) and abs(x) <= _LARGEST


def _short(x: Any) -> str:
    text = repr(x)
    return text if len(text) <= 80 else f"{text[:60]}..."
