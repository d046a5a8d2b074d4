"""A circuit as plain data and arrays, as the file of a run holds it, and made again from them."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import fields
from functools import partial
from types import MappingProxyType
from typing import Any

import numpy as np

from fingerspice.base.arrays import FloatArray
from fingerspice.circuit.circuit import AcSweep, Circuit, Element, SmallSignal, Tran
from fingerspice.circuit.loop import checked
from fingerspice.waveforms import combinations, periodic, ramps, samples
from fingerspice.waveforms import waveform as waveforms
from fingerspice.waveforms.sampling import Function, SourceTable, source_table
from fingerspice.waveforms.waveform import Waveform

#: Largest number of a circuit's samples, points and coefficients that a file keeps (64 MB).
MOST_NUMBERS = 8_000_000
_WAVEFORMS = {
    kind.__name__: kind
    for kind in (
        waveforms.DC, waveforms.Sine, periodic.Chirp, periodic.Exp, ramps.PWL, periodic.Pulse, periodic.Square,
        periodic.Triangle, periodic.Sawtooth, combinations.Sum, combinations.Product, combinations.AM,
        combinations.Burst, combinations.Repeat, samples.Samples,
    )
}  # fmt: skip
_PLAIN = ("title", "charge_law", "work", "warnings", "unused", "overrides", "initial")


class _Writer:
    """Waveforms as plain data, whose rows of numbers are collected in `arrays`."""

    def __init__(self, stop: float, rtol: float, step: float) -> None:
        self.stop, self.rtol, self.step = stop, rtol, step
        self.arrays: list[FloatArray] = []

    def plain(self, value: Any) -> Any:
        """A waveform, a row of numbers or a tuple of waveforms as plain data; anything else as it is."""
        if isinstance(value, Waveform):
            kind = samples.Samples if isinstance(value, samples.Samples) else type(value)
            if kind not in _WAVEFORMS.values():
                return self._tabulated(value)
            return {"kind": kind.__name__, **{f.name: self.plain(getattr(value, f.name)) for f in fields(kind)}}  # type: ignore[arg-type]
        if isinstance(value, np.ndarray) or (
            isinstance(value, tuple) and not any(isinstance(x, Waveform) for x in value)
        ):
            self.arrays.append(np.asarray(value, float))
            return {"array": len(self.arrays) - 1}
        return [self.plain(part) for part in value] if isinstance(value, tuple) else value

    def _tabulated(self, wave: Waveform) -> dict[str, Any]:
        """A function as the Chebyshev series by which a run represents it."""
        stop = wave.settled + wave.period if wave.period is not None else self.stop
        with warnings.catch_warnings():
            # The run has warned of edges.
            warnings.simplefilter("ignore")
            table = source_table(wave, 0.0, stop, min(1e-3, max(0.05 * self.rtol, 1e-14)), self.step)
        breaks = wave.breakpoints(0.0, stop)
        return {
            "kind": "Function", "name": getattr(getattr(wave, "function", None), "__name__", ""), "repeat": wave.period,
            "breaks": breaks[breaks < stop].tolist(), "edges": self.plain(table.edges),
            "series": self.plain(table.series),
        }  # fmt: skip


def stored_circuit(circuit: Circuit, stop: float, rtol: float) -> tuple[dict[str, Any] | str, list[FloatArray]]:
    """A circuit as plain data and arrays, or the reason why it is not kept.

    A function is kept as Chebyshev series up to the end of the run, `stop` (s), as exact as its tolerance asks.
    """
    writer = _Writer(stop, rtol, circuit.tran.step if circuit.tran else 1e-3 * stop)
    elements = [
        {f.name: getattr(e, f.name) for f in fields(Element) if f.name != "where"}
        | {"waveform": writer.plain(e.waveform), "values": dict(e.values), "ac": e.ac and vars(e.ac)}
        for e in circuit.elements
    ]
    kept = {name: getattr(circuit, name) for name in _PLAIN}
    kept |= {"tran": circuit.tran and vars(circuit.tran), "ac": circuit.ac and vars(circuit.ac), "elements": elements}
    kept["sets"] = {name: {path: writer.plain(x) for path, x in one.items()} for name, one in circuit.sets.items()}
    count = sum(array.size for array in writer.arrays)
    if count > MOST_NUMBERS:
        return f"its sources have {count:,} numbers, and a file keeps at most {MOST_NUMBERS:,}", []
    return kept, writer.arrays


def made_again(kept: Mapping[str, Any], arrays: list[FloatArray]) -> Circuit:
    """The circuit of `stored_circuit`; data that are not of a circuit raise an error of any of Python's kinds."""
    elements = tuple(
        Element(**{
            **one, "nodes": tuple(map(str, one["nodes"])), "node_names": tuple(map(str, one["node_names"])),
            "values": MappingProxyType({name: float(x) for name, x in one["values"].items()}),
            **{name: _value(one[name], arrays) for name in ("waveform", "initial")},
            "ac": one["ac"] and SmallSignal(**one["ac"]),
        })
        for one in kept["elements"]
    )  # fmt: skip
    plain = {name: kept[name] for name in _PLAIN}
    plain |= {name: tuple(map(str, kept[name])) for name in ("warnings", "unused")}
    sets = {name: {path: _value(x, arrays) for path, x in one.items()} for name, one in kept["sets"].items()}
    tran, ac = kept["tran"] and Tran(**kept["tran"]), kept["ac"] and AcSweep(**kept["ac"])
    return checked(Circuit(**{**plain, "elements": elements, "tran": tran, "ac": ac, "sets": sets}))


def _value(plain: Any, arrays: list[FloatArray]) -> Any:
    """What `_Writer.plain` was given."""
    if isinstance(plain, list):
        return tuple(_value(part, arrays) for part in plain)
    if plain is None or isinstance(plain, (int, float)):
        return plain
    if not isinstance(plain, dict):
        raise ValueError(f"{plain!r} is no waveform")
    if "array" in plain:
        return arrays[plain["array"]]
    given = {name: _value(x, arrays) for name, x in plain.items() if name not in ("kind", "name")}
    if plain["kind"] != "Function":
        for name, x in given.items():
            parts = x if isinstance(x, tuple) else (x,)
            if any(isinstance(part, Waveform) != (name in ("parts", "waveform")) for part in parts):
                raise ValueError(f"{name} of {plain['kind']} is {x!r}")
        made: Any = _WAVEFORMS[plain["kind"]]
        return made(**given)
    series = given["series"]
    table = SourceTable(given["edges"], np.zeros((len(series), 1, 6)), series)
    along = partial(_along, table, given["repeat"])
    # By its name the run's summary shows a function.
    vars(along).update({"__name__": str(plain["name"])} if plain["name"] else {})
    return Function(along, given["breaks"], given["repeat"])


def _along(table: SourceTable, repeat: float | None, t: FloatArray) -> FloatArray:
    """Values (V) of a function's table at times (s), repeated with a period (s), or held beyond its ends."""
    t = np.asarray(t, float)
    low, high = float(table.edges[0]), float(table.edges[-1])
    if repeat is not None:
        t = np.where(t > high, high - repeat + np.remainder(t - high, repeat), t)
    return table.values(np.clip(t, low, high).ravel()).reshape(t.shape)
