"""From the values of a set to those of a circuit: which elements are meant, and what the circuit remembers."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping

from fingerspice.base.errors import InputError
from fingerspice.circuit.arguments import require_circuit
from fingerspice.circuit.circuit import Circuit, Element
from fingerspice.circuit.provenance import remembering
from fingerspice.circuit.topology import driving_sources
from fingerspice.sets.reading import ELEMENTS, SetValue
from fingerspice.waveforms.combinations import AM
from fingerspice.waveforms.periodic import Square
from fingerspice.waveforms.waveform import Sine, Waveform

#: Waveforms of drives, by the name that a set gives.
WAVEFORMS: dict[str, type[Waveform]] = {"Sine": Sine, "Square": Square, "AM": AM}


def changes_by(
    name: str, values: Mapping[str, SetValue], waveform: str | None, circuit: Circuit, to: str | None
) -> Circuit:
    """The circuit with the values of the set of that name, as `ParameterSet.apply` describes it."""
    require_circuit(circuit)
    changes: dict[str, float | Waveform] = {}
    for kind in dict.fromkeys(value.element for value in values.values()):
        own = [value for value in values.values() if value.element == kind]
        needed = not all(value.optional for value in own)
        elements = _elements(name, kind, circuit, to, needed)
        if kind == "source":
            assert waveform is not None
            changes[elements[0].name] = WAVEFORMS[waveform](**{value.parameter: value.value for value in own})
            continue
        changes |= {
            f"{element.name}.{value.parameter}": value.value
            for element in elements
            for value in own
            if value.parameter in element.values
        }
    return remembering(circuit.replace(changes), name, changes)


def _elements(name: str, kind: str, circuit: Circuit, to: str | None, needed: bool) -> list[Element]:
    """The elements that a set's values for a kind of element go to.

    Raises
    ------
    InputError
        If there is none and one is needed, or if it is not clear which is meant.
    """
    devices = ELEMENTS[kind]
    known = driving_sources(circuit) if kind == "source" else list(circuit.elements)
    known = [e for e in known if e.device in devices]
    found = [e for e in known if to is None or f"{e.name}.".lower().startswith(f"{to}.".lower())]
    what = {"source": "driving V source"}.get(kind, " or ".join(devices))
    if not found and needed:
        inside = "the circuit" if to is None else f"{to!r} of the circuit"
        there = f"its {', '.join(e.name for e in known)}" if known else f"a circuit with a {what}"
        raise InputError(f"the set {name!r} has values for a {what}, which {inside} lacks; allowed: {there}")
    # A finger has one layer of each kind on its area; two would be two parts of the screen, of which one is meant.
    at = Counter("" if kind == "source" else e.nodes[2] for e in found)
    if any(count > 1 for count in at.values()):
        names = ", ".join(e.name for e in found)
        raise InputError(
            f"the set {name!r} has values for one {what}, and the circuit has {names}; allowed: one of these names "
            f"(to={found[0].name!r}, or {found[0].name}={name} on the command line)"
        )
    return found
