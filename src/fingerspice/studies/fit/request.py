"""What a caller of a fit asks for, checked: which parameters, bounds and profiles."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping, Sequence

import numpy as np

from fingerspice.base.arrays import FloatArray
from fingerspice.base.errors import FingerspiceWarning, InputError
from fingerspice.circuit.circuit import Circuit
from fingerspice.waveforms.waveform import require


def refuse_twice(names: Sequence[str]) -> None:
    """Refuse a parameter that is named twice."""
    for name in names:
        require(names.count(name) == 1, name, "named twice", "once")


def refuse_few(count: int, unknowns: Sequence[object]) -> None:
    """Refuse fewer data than there are unknowns."""
    if count < len(unknowns):
        raise InputError(f"{count} data cannot tell {len(unknowns)} parameters; allowed: at least as many data")


def profiled(names: Sequence[str], wanted: bool | Sequence[str]) -> list[str]:
    """The unknowns whose profiles are wanted, in the circuit's own spelling."""
    if isinstance(wanted, bool):
        return list(names) if wanted else []
    known = {name.lower(): name for name in names}
    for name in wanted:
        if not isinstance(name, str) or name.lower() not in known:
            raise InputError(f"profiles names {name!r}, which is not fitted; allowed: True, or {', '.join(names)}")
    return [known[name.lower()] for name in wanted]


def bounds_of(
    circuit: Circuit, paths: tuple[str, ...], given: Mapping[str, tuple[float, float]]
) -> tuple[Circuit, FloatArray]:
    """The circuit to start from, and smallest and largest values, shape (n_parameter, 2): 0 and infinity by default.

    A start outside its bounds moves to the nearer one, with a warning.
    """
    lower = {path.lower(): tuple(pair) for path, pair in given.items()}
    unknown = [path for path in given if path.lower() not in {p.lower() for p in paths}]
    if unknown:
        raise InputError(f"bounds names {unknown[0]}, which is not fitted; allowed: {', '.join(paths)}")
    out = np.tile([0.0, math.inf], (len(paths), 1))
    for i, path in enumerate(paths):
        if path.lower() in lower:
            pair = lower[path.lower()]
            if len(pair) != 2 or not 0.0 <= pair[0] < pair[1]:
                raise InputError(f"bounds of {path} are {pair}; allowed: two values with 0 <= low < high")
            out[i] = pair
            value = circuit.parameters[path].value
            moved = min(max(value, pair[0]), pair[1])
            if moved != value:
                said = f"{path} is {value:g}, outside its bounds {pair[0]:g} to {pair[1]:g}: it starts at {moved:g}"
                warnings.warn(said, FingerspiceWarning, stacklevel=3)
                circuit = circuit.varied({path: moved})
    return circuit, out
