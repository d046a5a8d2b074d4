"""Sliders: every parameter of every element, with a range in which moving it makes sense."""

from __future__ import annotations

import math
from typing import Any

from fingerspice.base.units import parse_number, spice_text
from fingerspice.circuit.circuit import Circuit, Element
from fingerspice.circuit.describe import MEANINGS, MEANINGS_OF_WAVEFORMS
from fingerspice.circuit.devices import ParameterSpec
from fingerspice.circuit.topology import driving_sources

#: Parameters that the paper varies or Table 1 gives, by device; the page shows the others on request.
_FIRST = {
    "LAYER": ("d", "eps_r", "r"), "SLAB": ("d", "eps_r", "rho"), "SKIN": ("d", "f"), "SKIN_DISPERSIVE": ("d",),
    "GAP": ("d", "r", "fn", "mu"), "R": ("value",), "C": ("value",),
}  # fmt: skip
_FIRST_OF_SOURCES = (
    *("amplitude", "frequency", "level", "v1", "v2", "carrier", "modulation", "depth", "f0", "f1", "duration"),
    *("duty", "pulse_period", "period", "td1", "tau1", "td2", "tau2"),
)
_WHAT = {
    "LAYER": "layer", "SLAB": "layer", "SKIN": "skin", "SKIN_DISPERSIVE": "skin, dispersive", "GAP": "gap and contact",
    "R": "resistor", "C": "capacitor", "V": "voltage source", "I": "current source",
}  # fmt: skip
#: Ends of sliders of values that are 0 in the deck.
_FROM_ZERO = {"a_fix": 100.0, "tau": 0.1, "mu": 1.0, "c2": 20e3}
#: A slider goes from the deck's value over this to its value times this, within the usual range.
_SPAN = 100.0
#: Ratio of the ends of a usual range up to which its slider is linear.
_LINEAR = 12.0
_LARGEST_VOLTAGE = 400.0
#: Units whose values are written with SPICE's suffixes.
_PREFIXED = ("m", "V", "A", "ohm", "ohm m", "F", "Hz", "s", "V/m")


def sliders(base: Circuit, shown: Circuit) -> list[dict[str, Any]]:
    """The sliders by element, those of the sources, the gap and the layers first.

    Parameters
    ----------
    base : Circuit
        The circuit of the deck, whose values set the ranges, so that these stay while a slider moves.
    shown : Circuit
        The same circuit with the values of now.
    """
    driving = {e.name for e in driving_sources(shown)}
    before = {e.name: e for e in base.elements}
    groups = [_group(before[e.name], e, e.name in driving) for e in shown.elements]
    order = {"V": 0, "I": 0, "GAP": 1, "LAYER": 2, "SLAB": 2, "SKIN": 3, "SKIN_DISPERSIVE": 3}
    groups.sort(key=lambda group: order.get(group["device"], 4))
    return [group for group in groups if group["sliders"]]


def _group(base: Element, e: Element, drives: bool) -> dict[str, Any]:
    """The sliders of one element; `base` is the element in the deck."""
    found = []
    for spec in e.spec.parameters:
        value, own = e.values[spec.name], base.values.get(spec.name, e.values[spec.name])
        first = spec.name in _FIRST.get(e.device, ())
        meaning = MEANINGS.get(e.device, {}).get(spec.name, "")
        found.append(_slider(f"{e.name}.{spec.name}", spec.unit, value, first, _of_parameter(spec, own), meaning))
    if e.waveform is not None:
        same = type(base.waveform) is type(e.waveform)
        for name, unit in type(e.waveform).units.items():
            now = getattr(e.waveform, name, None)
            if not isinstance(now, (int, float)):
                continue
            own = getattr(base.waveform, name) if same else now
            limits = _of_waveform(name, unit, own) if drives else (0.1 * abs(own), 10.0 * abs(own), False)
            first = name in _FIRST_OF_SOURCES
            meaning = MEANINGS_OF_WAVEFORMS.get(name, "")
            found.append(_slider(f"{e.name}.{name}", _unit(e, unit, drives), now, first, limits, meaning))
    return {"element": e.name, "device": e.device, "what": _WHAT.get(e.device, e.device), "sliders": found}


def _unit(e: Element, unit: str, drives: bool) -> str:
    """The unit of a source's value: a source on an area node gives mm^2."""
    if unit != "V":
        return unit
    return ("A" if e.device == "I" else "V") if drives else "mm^2"


def value_text(value: float, unit: str) -> str:
    """A value for a field of the page: in SPICE's notation if its unit takes a prefix and that is the same double."""
    text = spice_text(value) if unit in _PREFIXED and math.isfinite(value) else f"{value:.12g}"
    return text if not math.isfinite(value) or parse_number(text) == value else repr(float(value))


def _slider(
    path: str, unit: str, value: float, first: bool, limits: tuple[float, float, bool], meaning: str
) -> dict[str, Any]:
    low, high, log = limits
    return {
        "path": path, "unit": unit, "value": value if math.isfinite(value) else None, "text": value_text(value, unit),
        "low": low, "high": high, "log": log, "first": first, "meaning": meaning,
    }  # fmt: skip


def _of_parameter(spec: ParameterSpec, value: float) -> tuple[float, float, bool]:
    """Ends of a device parameter's slider, and whether it is logarithmic."""
    assert spec.usual is not None
    least, most = spec.usual.least, spec.usual.most
    if not math.isfinite(value):
        return least, most, True
    if spec.may_be_zero:
        return 0.0, (5.0 * value or _FROM_ZERO.get(spec.name, most)), False
    if most / least <= _LINEAR:
        return min(least, value), max(most, value), False
    low, high = max(least, value / _SPAN), min(most, value * _SPAN)
    return min(low, value), max(high, value), True


def _of_waveform(name: str, unit: str, value: float) -> tuple[float, float, bool]:
    """Ends of the slider of a number of a waveform, and whether it is logarithmic."""
    if not math.isfinite(value):
        return 1e-5, 1.0, True
    if unit == "V":
        most = _LARGEST_VOLTAGE if 1.0 <= abs(value) <= _LARGEST_VOLTAGE or value == 0.0 else 2.0 * abs(value)
        return (0.0 if name == "amplitude" and value >= 0.0 else -most), most, False
    if unit == "Hz" and value > 0.0:
        return min(1.0, value), max(1e5, value), True
    if unit == "deg":
        return -180.0, 180.0, False
    if name in ("duty", "depth"):
        return 0.01 if name == "duty" else 0.0, 0.99 if name == "duty" else 1.0, False
    if unit == "s" and value > 0.0:
        return value / _SPAN, value * _SPAN, True
    return 0.0, (5.0 * abs(value) or (0.1 if unit == "s" else 1000.0)), False
