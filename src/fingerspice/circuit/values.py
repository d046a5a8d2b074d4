"""Values of parameters: numbers in SPICE's notation, units that SPICE reads as scale factors, and unusual values."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

from fingerspice.base.arrays import real_number
from fingerspice.base.errors import InputError
from fingerspice.base.units import parse_number, suggest_mega, suspicious_mega, unit_read_as_scale
from fingerspice.circuit.devices import ParameterSpec
from fingerspice.circuit.usual import REST_AREA, SOURCES

if TYPE_CHECKING:
    from fingerspice.circuit.circuit import Circuit, Element

_UNIT_TRAPS = {"F": "farad", "N": "newton"}


def unit_trap(spec: ParameterSpec, text: str) -> str | None:
    """Reason to refuse a number whose unit SPICE would read as a scale factor; None if SPICE would not."""
    word = _UNIT_TRAPS.get(spec.unit)
    if not word or not unit_read_as_scale(text, spec.unit, word):
        return None
    prefix = {"F": "femto (1e-15)", "N": "nano (1e-9)"}[spec.unit]
    return f"is {text!r}: SPICE reads {spec.unit} as {prefix}; write the number alone, in {word}"


def is_resistance(spec: ParameterSpec) -> bool:
    """Whether the parameter is a resistance, in which a capital M is probably meant as mega."""
    return spec.unit in ("ohm", "ohm m")


def mega_note(text: str, value: float, spec: ParameterSpec) -> str:
    """The warning about a capital M in a resistance, which SPICE reads as milli."""
    return (
        f"{text!r} is milli ({value:g} {spec.unit}), as everywhere in SPICE; for mega{spec.unit.partition(' ')[0]} "
        f"write {suggest_mega(text)}"
    ).replace("megaohm", "megohm")


def value_of(path: str, given: Any, spec: ParameterSpec | None, unit: str) -> tuple[float, str | None]:
    """A parameter's new value, and a warning about how it is written, or None.

    Parameters
    ----------
    path : str
        Such as ``Xgap.d``.
    given : float or str
        Value in the netlist's unit, as a number or as a text such as ``3.5u``.
    spec : ParameterSpec or None
        None for a parameter of a waveform.
    unit : str

    Raises
    ------
    InputError
        If the value is not a number, or has a unit that SPICE reads as a scale factor.
    """
    if not isinstance(given, str):
        return real_number(path, given, f"a number {unit}".rstrip() + ", or text such as '3.5u'"), None
    text = given.strip()
    if text.lower() in ("inf", "none"):
        return math.inf, None
    try:
        value = parse_number(text)
    except ValueError as error:
        raise InputError(f"{path}: {error}") from None
    if spec is None:
        return value, None
    trap = unit_trap(spec, text)
    if trap:
        raise InputError(f"{path} {trap}")
    mega = is_resistance(spec) and suspicious_mega(text)
    return value, f"{path}: {mega_note(text, value, spec)}" if mega else None


def unusual(element: Element) -> Iterator[tuple[str, str]]:
    """Warnings about an element's unusual values, each with the parameter's name (empty for the area at 0 V)."""
    found = [(p.name, p.unusual(element.name, element.values[p.name])) for p in element.spec.parameters]
    if element.waveform is not None:
        found = [
            (name, SOURCES[unit].warning(f"{element.name} {name}", getattr(element.waveform, name), unit))
            for name, unit in type(element.waveform).units.items()
            if unit in SOURCES and hasattr(element.waveform, name)
        ]
    if element.device == "GAP" and not any(text for _, text in found):
        v = element.values
        area = (v["alpha"] * v["fn"] ** v["m_exp"]) ** 2 - v["c2"] * (v["mu"] * v["fn"]) ** 2
        if v["a_fix"] == 0.0 and area > 0.0:
            at_rest = area / (v["alpha"] * v["fn"] ** v["m_exp"])
            found.append(("", REST_AREA.warning(f"{element.name} area at 0 V", at_rest, "mm^2")))
    yield from ((name, text) for name, text in found if text is not None)


def unusual_of_changed(before: Circuit, after: Circuit) -> tuple[dict[str, str], dict[str, str]]:
    """Warnings about unusual values in the elements that differ between two circuits, one mapping for each circuit.

    Each maps a warning to the path of its parameter, in lower case.
    """
    found: tuple[dict[str, str], dict[str, str]] = {}, {}
    for pair in zip(before.elements, after.elements, strict=True):
        if pair[0] is not pair[1]:
            for texts, e in zip(found, pair, strict=True):
                if "unusual" not in e.kept:
                    e.kept["unusual"] = {text: f"{e.name}.{name}".lower() for name, text in unusual(e)}
                texts |= e.kept["unusual"]
    return found


def concerns(warning: str, changes: Mapping[str, Any]) -> bool:
    """Whether a warning of the reader is about the notation of a value that `changes` now replaces."""
    for path in changes:
        name, _, parameter = path.lower().rpartition(".")
        # A warning that names only the source may be about its frequency.
        subjects = [path.lower(), f"{name} {parameter}", *([name] if parameter == "frequency" else [])]
        if any(f": {subject}: " in warning.lower() for subject in subjects):
            return True
    return False
