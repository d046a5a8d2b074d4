"""Checks of a call's arguments: the circuit, the sources and parameters changed for the call, numbers and times."""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from fingerspice.base.arrays import FloatArray
from fingerspice.base.errors import FingerspiceWarning, InputError
from fingerspice.circuit.circuit import Circuit
from fingerspice.circuit.topology import driving_sources
from fingerspice.waveforms.waveform import DC, Waveform

#: A waveform, a constant (V, or A of a current source), or a function of time (s).
Source = Waveform | float | Callable[[float], float]
Sources = Mapping[str, Source] | Source
Parameters = Mapping[str, float]


def overridden(circuit: Circuit, sources: Sources | None = None, parameters: Parameters | None = None) -> Circuit:
    """The circuit with the sources and parameters of a call.

    Parameters
    ----------
    circuit : Circuit
    sources : mapping or waveform, optional
        From the name of a source to a waveform, a constant (V) or a function of time (s); or one of these alone, where
        the circuit has one source.
    parameters : mapping, optional
        From path to value, as in `Circuit.replace`.

    Raises
    ------
    InputError
        For anything but a circuit, an unknown name, or a source without its name where the circuit has several.

    Warns
    -----
    FingerspiceWarning
        Where other sources than those named in `sources` remain switched on.
    """
    require_circuit(circuit)
    if parameters:
        if not isinstance(parameters, Mapping):
            raise InputError(
                f"parameters is a {type(parameters).__name__}; allowed: a mapping such as {{'Xgap.d': 3e-6}}"
            )
        circuit = circuit.replace(parameters)
    if sources is None or (isinstance(sources, Mapping) and not sources):
        return circuit
    driving = driving_sources(circuit)
    if not isinstance(sources, Mapping):
        if len(driving) != 1:
            names = ", ".join(e.name for e in driving)
            raise InputError(
                f"sources is one source, and the circuit has {names}; allowed: a mapping such as "
                f"{{{driving[0].name!r}: ...}}"
            )
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
    """Refuse anything but a circuit.

    Raises
    ------
    InputError
        With what was given, and how a circuit is made.
    """
    if not isinstance(circuit, Circuit):
        raise InputError(
            f"the circuit is a {type(circuit).__name__}; allowed: a Circuit, such as fs.read_netlist('deck.cir') gives"
        )


def require_number(what: str, given: Any, allowed: str) -> None:
    """Refuse anything but a real number.

    Raises
    ------
    InputError
        With what was given.
    """
    if isinstance(given, bool) or not isinstance(given, (int, float, np.integer, np.floating)):
        raise InputError(f"{what} is {given!r}, a {type(given).__name__}; allowed: {allowed}")


def require_area(area: Any) -> None:
    """Refuse anything but a text or a number; which names of modes there are is checked by the model.

    Raises
    ------
    InputError
        With what was given.
    """
    if not isinstance(area, str):
        require_number("area", area, "'coupled', 'mean', 'frozen' or a number in m^2")


def times_given(what: str, given: ArrayLike | None) -> FloatArray | None:
    """Times as an array, s.

    Raises
    ------
    InputError
        For anything but numbers.
    """
    try:
        return None if given is None else np.asarray(given, float)
    except (TypeError, ValueError):
        raise InputError(f"{what} is {given!r}; allowed: numbers in s") from None
