"""Named sets of parameters in sweeps: one for all scenes, or several as a dimension of the grid."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from fingerspice.base.arrays import FloatArray
from fingerspice.base.errors import InputError
from fingerspice.circuit.circuit import Circuit
from fingerspice.sets.parameters import parameters
from fingerspice.sets.reading import KINDS
from fingerspice.waveforms.waveform import Waveform


@dataclass(frozen=True)
class SetTable:
    """Several sets: their names, and by path the values in which they differ, shape (n_set,)."""

    names: tuple[str, ...]
    columns: Mapping[str, FloatArray]


def with_sets(circuit: Circuit, asked: Mapping[str, Any]) -> tuple[Circuit, dict[str, Any]]:
    """The circuit with all values that sets give to every scene, and what else is asked for.

    Parameters
    ----------
    circuit : Circuit
    asked : mapping
        As `parameters` of `sweep`: under a kind of sets, such as ``finger``, stands the name of a set (or
        ELEMENT=NAME), or a list of these, which becomes a `SetTable`.

    Raises
    ------
    InputError
        If there is no such set of this kind, the circuit has no place for its values, one is given twice, or one of
        several replaces the source.
    """
    if not isinstance(asked, Mapping):
        return circuit, asked
    rest = dict(asked)
    for kind in (kind for kind in KINDS if kind in asked):
        if isinstance(asked[kind], str):
            circuit, _ = _applied(circuit, kind, rest.pop(kind))
        else:
            circuit, rest[kind] = _together(circuit, kind, asked[kind])
    if asked and not rest:
        raise InputError(
            f"parameters is {dict(asked)!r}, and nothing varies; allowed: a list of sets, an array or a distribution "
            "beside it"
        )
    return circuit, rest


def _together(circuit: Circuit, kind: str, names: Any) -> tuple[Circuit, SetTable]:
    """The circuit with the values in which several sets agree, and those in which they differ."""
    given = list(names) if isinstance(names, list | tuple | np.ndarray) else []
    if not given or not all(isinstance(name, str) for name in given):
        raise InputError(f"{kind} is {names!r}; allowed: the name of a set of parameters, or a list of names")
    found = dict(_given(circuit, kind, name) for name in given)
    if len(found) < len(given):
        raise InputError(f"{kind} is {given!r}, where a set is named twice; allowed: each once")
    if any(isinstance(value, Waveform) for one in found.values() for value in one.values()):
        raise InputError(
            f"{kind} is {given!r}, whose sets replace the source; allowed: one of them by itself, with arrays of "
            "numbers such as source.frequency beside it"
        )
    own = circuit.parameters
    paths = dict.fromkeys(path for one in found.values() for path in one)
    columns = {path: np.array([one.get(path, own[path].value) for one in found.values()], float) for path in paths}
    same = {path: float(each[0]) for path, each in columns.items() if (each == each[0]).all()}
    differ = {path: each for path, each in columns.items() if path not in same}
    return circuit.replace(same) if same else circuit, SetTable(tuple(found), differ)


def _given(circuit: Circuit, kind: str, entry: str) -> tuple[str, Mapping[str, Any]]:
    """The name of a set as the sweep shows it, and the values that it gives by path."""
    changed, name = _applied(circuit, kind, entry)
    to = entry.rpartition("=")[0].strip()
    return f"{to}={name}" if to else name, changed.sets[name]


def _applied(circuit: Circuit, kind: str, entry: str) -> tuple[Circuit, str]:
    """The circuit with a set, and the set's name."""
    to, _, name = (part.strip() for part in entry.rpartition("="))
    try:
        one = parameters(name, kind)
        return one.apply(circuit, to or None), one.name
    except InputError as error:
        raise InputError(f"{kind} {entry!r}: {error.message}") from None
