"""Devices a netlist may use, their parameters, units and allowed ranges: one entry per device."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class ParameterSpec:
    """One parameter of a device, in the unit of the netlist.

    Attributes
    ----------
    name, unit : str
    default : float or None
        None: required.
    may_be_zero, may_be_infinite : bool
        Besides the positive numbers.
    least, most : float
        Of the other numbers; far from any device's, so that products and quotients stay numbers.
    """

    name: str
    unit: str
    default: float | None = None
    may_be_zero: bool = False
    may_be_infinite: bool = False
    least: float = 1e-30
    most: float = 1e30

    def allowed(self) -> str:
        """What the parameter may be, in words."""
        words = ("0 or more" if self.may_be_zero else "more than 0") + (" or inf" if self.may_be_infinite else "")
        return f"{words}, from {self.least:g} to {self.most:g}"

    def accepts(self, value: float) -> bool:
        """Whether a value is in range."""
        if value == 0.0 or math.isinf(value):
            return value >= 0.0 and (self.may_be_zero if value == 0.0 else self.may_be_infinite)
        return self.least <= value <= self.most


@dataclass(frozen=True)
class DeviceSpec:
    """A device: its nodes and parameters."""

    name: str
    nodes: tuple[str, ...]
    parameters: tuple[ParameterSpec, ...]

    def parameter(self, name: str) -> ParameterSpec:
        """The parameter of that name; KeyError where there is none."""
        return {p.name: p for p in self.parameters}[name]

    @property
    def is_layer(self) -> bool:
        """Whether its capacitance scales with the ridge contact area."""
        return "area" in self.nodes


_P = ParameterSpec
_LAYER_NODES = ("p", "n", "area")
_DIELECTRIC = (_P("d", "m"), _P("eps_r", ""))
_LEAK = _P("r", "ohm", default=math.inf, may_be_infinite=True)
_STRENGTH = _P("e_max", "V/m", default=math.inf, may_be_infinite=True)

DEVICES: dict[str, DeviceSpec] = {
    spec.name: spec
    for spec in (
        DeviceSpec("LAYER", _LAYER_NODES, (*_DIELECTRIC, _LEAK, _STRENGTH)),
        DeviceSpec("SLAB", _LAYER_NODES, (*_DIELECTRIC, _P("rho", "ohm m", may_be_infinite=True), _STRENGTH)),
        DeviceSpec("SKIN", _LAYER_NODES, (_P("d", "m"), _P("f", "Hz", least=1e-3, most=1e9))),
        DeviceSpec("SKIN_DISPERSIVE", _LAYER_NODES, (_P("d", "m"),)),
        DeviceSpec(
            "GAP",
            _LAYER_NODES,
            (
                *_DIELECTRIC,
                _LEAK,
                _P("fn", "N"),
                _P("mu", "", may_be_zero=True),
                _P("alpha", "mm^2/N^m"),
                _P("m_exp", ""),
                _P("beta", "mm^(2-n)"),
                _P("n_exp", ""),
                _P("c2", "mm^4/N^2", may_be_zero=True),
                _P("a_fix", "mm^2", default=0.0, may_be_zero=True),
                _P("tau", "s", default=0.0, may_be_zero=True),
            ),
        ),
        DeviceSpec("R", ("p", "n"), (_P("value", "ohm"),)),
        DeviceSpec("C", ("p", "n"), (_P("value", "F"),)),
        DeviceSpec("V", ("p", "n"), ()),
        DeviceSpec("I", ("p", "n"), ()),
    )
}
"""Every device the reader knows."""
