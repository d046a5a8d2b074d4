"""Checks of a call's arguments: the circuit, its changed sources and parameters, numbers and times."""

from __future__ import annotations

import dataclasses
import math
import warnings
from collections.abc import Callable, Mapping
from typing import Any

from fingerspice.base.arrays import real_number
from fingerspice.base.errors import FingerspiceWarning, InputError
from fingerspice.circuit.circuit import Circuit
from fingerspice.circuit.topology import driving_sources
from fingerspice.waveforms.waveform import DC, Waveform, require

#: A waveform, a constant (V, or A of a current source), or a function of time (s).
Source = Waveform | float | Callable[[float], float]
Sources = Mapping[str, Source] | Source
Parameters = Mapping[str, float]


def overridden(circuit: Circuit, sources: Sources | None = None, parameters: Parameters | None = None) -> Circuit:
    """The circuit with the sources and parameters given in a call, with warnings about sources that stay on.

    For a circuit with one source, its waveform, constant or function alone is enough; `parameters` is as in
    `Circuit.replace`.
    """
    require_circuit(circuit)
    if parameters:
        given = f"a {type(parameters).__name__}"
        require(isinstance(parameters, Mapping), "parameters", given, "a mapping such as {'Xgap.d': 3e-6}")
        circuit = circuit.replace(parameters)
    if sources is None or (isinstance(sources, Mapping) and not sources):
        return circuit
    driving = driving_sources(circuit)
    if not isinstance(sources, Mapping):
        has = f"one source, and the circuit has {', '.join(e.name for e in driving) or 'none'}"
        allowed = f"a mapping such as {{{driving[0].name!r}: ...}}" if driving else "no sources"
        require(len(driving) == 1, "sources", has, allowed)
        sources = {driving[0].name: sources}
    for name in sources:
        if not isinstance(name, str):
            raise InputError(f"sources names {name!r}, a {type(name).__name__}; allowed: names of V or I elements")
        if circuit[name].device not in "VI":
            raise InputError(f"sources names {name!r}, which is a {circuit[name].device}; allowed: a V or I element")
    named = {name.lower() for name in sources}
    on = [e.name for e in driving if e.name.lower() not in named and e.waveform not in (None, DC(0.0))]
    if on and any(e.name.lower() in named for e in driving):
        text = (
            f"sources names {', '.join(sources)} only: {', '.join(on)} stays on, as in the deck; 0 would switch it off"
        )
        warnings.warn(text, FingerspiceWarning, stacklevel=3)
        circuit = dataclasses.replace(circuit, warnings=(*circuit.warnings, text))
    return circuit.replace({circuit[name].name: value for name, value in sources.items()})


def require_circuit(circuit: Any) -> None:
    """Refuse anything but a circuit, and say how a circuit is made."""
    if not isinstance(circuit, Circuit):
        raise InputError(
            f"the circuit is a {type(circuit).__name__}; allowed: a Circuit, such as fs.read_netlist('deck.cir') gives"
        )


def area_given(area: Any) -> str | float:
    """An area as one of the model's modes or a positive number, m^2."""
    if isinstance(area, str):
        require(area in ("coupled", "mean", "frozen"), "area", repr(area), "'coupled', 'mean', 'frozen' or m^2")
        return area
    number = real_number("area", area, "'coupled', 'mean', 'frozen' or a number in m^2")
    require(math.isfinite(number) and number > 0.0, "area", f"{number:g} m^2", "a positive area in m^2")
    return number
