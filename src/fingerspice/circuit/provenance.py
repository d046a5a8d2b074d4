"""What a circuit is made of: its digests, the named sets of parameters that made it, and what still holds of them."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from typing import Any

from fingerspice.circuit.circuit import Circuit
from fingerspice.waveforms.samples import Samples


def remembering(circuit: Circuit, name: str, values: Mapping[str, Any]) -> Circuit:
    """The circuit, which remembers that the set of that name gave these values, by path.

    An earlier set no longer answers for the values that this one replaces.
    """
    given = {path.lower() for path in values}
    sets = {one: {p: v for p, v in old.items() if p.lower() not in given} for one, old in circuit.sets.items()}
    own = {**sets.pop(name, {}), **values}
    return circuit._with(sets={**{one: old for one, old in sets.items() if old}, name: own})


def in_force(circuit: Circuit) -> dict[str, tuple[dict[str, Any], tuple[str, ...]]]:
    """The sets applied to a circuit: of each the values still in force by path, and the paths changed since."""
    now: dict[str, Any] = {path.lower(): p.value for path, p in circuit.parameters.items()}
    now |= {e.name.lower(): e.waveform for e in circuit.elements if e.waveform is not None}
    found = {}
    for name, values in circuit.sets.items():
        # The elements of a run read from a file may be unknown; its values are then those that the file names.
        kept = {path: value for path, value in values.items() if now.get(path.lower(), value) == value}
        found[name] = kept, tuple(path for path in values if path not in kept)
    return found


def digests(circuit: Circuit) -> tuple[str, str]:
    """SHA-256 of a circuit's elements, initial voltages and step control, and of its sources' waveforms."""
    elements, sources, tran = hashlib.sha256(), hashlib.sha256(), circuit.tran
    for element in circuit.elements:
        wave = element.waveform
        elements.update(repr((element.name, element.device, element.nodes, dict(element.values))).encode())
        sources.update(repr((element.name, wave.digest() if isinstance(wave, Samples) else wave)).encode())
    elements.update(repr((dict(circuit.initial), tran and (tran.max_step, tran.uic))).encode())
    return elements.hexdigest(), sources.hexdigest()
