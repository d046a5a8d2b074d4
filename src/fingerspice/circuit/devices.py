"""Devices a netlist may use: one entry each, with nodes, parameters, and what a layer is made of.

An entry is all that the reader, a run, a phasor and the export need. For ngspice a layer has a body of the same name,
nodes, parameters and defaults in `fingerspice.lib` and `fingerspice_mobile.lib`; `tests/test_devices.py` goes through
the entries and says what is missing there.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from fingerspice.base.arrays import FloatArray
from fingerspice.circuit.usual import REST_AREA, Usual
from fingerspice.physics.ladder import SKIN_LADDER
from fingerspice.physics.materials import EPS0, SKIN_BAND, skin_permittivity, skin_resistivity

#: Values in the netlist's units, and the frequency (Hz) whose data a dispersive material takes, or None for its cells:
#: c (F/m^2), total leakage (S) and leakage per area (S/m^2) of cells in series, shape (n_cell, 3).
Cells = Callable[[Mapping[str, float], float | None], FloatArray]


@dataclass(frozen=True)
class ParameterSpec:
    """One parameter of a device, in the unit of the netlist.

    Attributes
    ----------
    name, unit : str
    default : float or None
        None: required.
    usual : Usual or None
        Outside it a warning is given.
    may_be_zero, may_be_infinite : bool
        Besides the positive numbers.
    least, most : float
        Of the other numbers; far from any device's, so that products and quotients stay numbers.
    """

    name: str
    unit: str
    default: float | None = None
    usual: Usual | None = None
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

    def unusual(self, element: str, value: float) -> str | None:
        """The warning about a value outside the usual range, or None."""
        return None if self.usual is None else self.usual.warning(f"{element} {self.name}", value, self.unit)


@dataclass(frozen=True)
class DeviceSpec:
    """A device: its nodes and parameters, and of a layer the cells it is made of."""

    name: str
    nodes: tuple[str, ...]
    parameters: tuple[ParameterSpec, ...]
    cells: Cells | None = None

    def __post_init__(self) -> None:
        if self.is_layer != (self.cells is not None):
            raise TypeError(f"device {self.name}: an area node and cells belong together; give both, or neither")

    def parameter(self, name: str) -> ParameterSpec:
        """The parameter of that name; KeyError where there is none."""
        return {p.name: p for p in self.parameters}[name]

    @property
    def is_layer(self) -> bool:
        """Whether its capacitance scales with the ridge contact area; in a netlist it is then an X."""
        return "area" in self.nodes


def _slabs(d: float, eps_r: FloatArray, rho: FloatArray) -> FloatArray:
    return np.column_stack([EPS0 * eps_r / d, np.zeros(eps_r.size), 1.0 / (rho * d)])


def _layer_cells(v: Mapping[str, float], at: float | None) -> FloatArray:
    return np.array([[EPS0 * v["eps_r"] / v["d"], 1.0 / v["r"], 0.0]])


def _slab_cells(v: Mapping[str, float], at: float | None) -> FloatArray:
    return _slabs(v["d"], np.array([v["eps_r"]]), np.array([v["rho"]]))


def _skin_cells(v: Mapping[str, float], at: float | None) -> FloatArray:
    return _slabs(v["d"], skin_permittivity([v["f"]]), skin_resistivity([v["f"]]))


def _dispersive_cells(v: Mapping[str, float], at: float | None) -> FloatArray:
    if at is None:
        return _slabs(v["d"], *SKIN_LADDER.cells())
    return _slabs(v["d"], SKIN_LADDER.permittivity([at]), SKIN_LADDER.resistivity([at]))


_P = ParameterSpec
_LAYER_NODES = ("p", "n", "area")

# Usual ranges, each with what it is taken from.

# Sputtered and spun films have 10 nm to 10 um, foils up to 1 mm, cover glasses and screen protectors up to some mm.
_COATING = Usual(10e-9, 1e-2, "from a sputtered film to a thick glass")
# The horny layer has 10 to 20 um on most of the body and some 0.2 to 0.6 mm at the fingertip; callus has over 1 mm.
_SKIN = Usual(1e-6, 2e-3, "skin has 10 um, a fingertip 0.2 to 0.6 mm, callus over 1 mm")
# The air between rough skin and a screen: 3.5 um in Table 1; below 10 nm surfaces attract each other, above 100 um the
# ridges (some 60 um high) are off the screen.
_AIR = Usual(10e-9, 100e-6, "from van der Waals contact to ridges off the screen; 3.5 um in Table 1")
# Air has 1, polymers 2 to 10, ceramics up to some thousand.
_EPS_R = Usual(1.0, 1e4, "air has 1, polymers 2 to 10, ceramics up to some thousand")
# Of what conducts a little, such as skin at low frequencies (the ladder's first slab), it is up to 1e5.
_EPS_R_MATERIAL = Usual(1.0, 1e6, "polymers have 2 to 10, skin at low frequencies up to 1e5")
# 0.2 and 1 megohm in Table 1. Sweat in the gap (some ohm m, a few um, 35 mm^2) gives an ohm; a good polymer, 1e14 ohm m
# at 100 um, gives 1e14 ohm.
_LEAK = Usual(1.0, 1e15, "0.2 to 1 megohm in Table 1, an ohm for sweat, 1e14 ohm for a good polymer")
# Sweat has 0.7 ohm m, skin 1e3 to 1e5 (Eq. 18), the best polymers 1e16.
_RHO = Usual(0.1, 1e17, "sweat has 1 ohm m, skin 1e4, good polymers 1e14 to 1e16")
# Air has 3 MV/m, glass 10 to 40, thin polymer and oxide films 100 to 1000.
_STRENGTH = Usual(1e5, 1e10, "air has 3 MV/m, thin oxides 1 GV/m", "V/m, not V/um")
# Fingers touch with 0.1 to 5 N and press with less than 50 N, so that 50 itself is more likely millinewton.
_LOAD = Usual(1e-3, 49.9, "a finger touches with 0.1 to 5 N", "newton, not millinewton")
# Dry skin on glass has 0.1 to 1, moist skin up to 3 and more.
_FRICTION = Usual(0.01, 5.0, "dry skin on glass has 0.1 to 1, moist skin up to 3")
# Table 1 has 54.4; at 1 N this is the area (Eq. 5), which may be that of a pencil's tip or of a palm.
_ALPHA = Usual(1.0, 2000.0, "the ridge area at 1 N; 54.4 in Table 1", "mm^2 and N")
# 2/3 for a smooth ball (Hertz), up to 1 for a rough plane; measured fingers have 0.2 to 0.8, Table 1 0.52.
_M_EXP = Usual(0.1, 1.0, "2/3 for a ball, 1 for a rough plane, 0.52 in Table 1")
# Table 1 has 32 and 1.41: area against the contact's radius, pi and 2 for a disc that is all in contact.
_BETA = Usual(0.3, 1e4, "pi for a full disc, 32 in Table 1", "mm")
_N_EXP = Usual(0.5, 3.0, "2 for a full disc, 1.41 in Table 1")
# Table 1 has 5000: at 0.15 N of friction a tenth of a fingertip's area squared.
_C2 = Usual(1.0, 1e6, "5000 in Table 1", "mm^4/N^2")
# Skin creeps within 1 ms to some seconds.
_TAU = Usual(1e-5, 60.0, "skin creeps within 1 ms to some seconds")
_BAND = Usual(*SKIN_BAND, "where the data of Eqs. 18 and 19 were measured")
# From a lead to an insulator; from a picofarad's fraction between leads to a supply's capacitor.
_OHM = Usual(1e-3, 1e15, "a lead has milliohms, an insulator up to 1e15 ohm")
_FARAD = Usual(1e-16, 1e-2, "a body has 150 pF to ground, a supply's capacitor some mF")

_EPS = _P("eps_r", "", usual=_EPS_R)
_R = _P("r", "ohm", math.inf, _LEAK, may_be_infinite=True)
_E_MAX = _P("e_max", "V/m", math.inf, _STRENGTH, may_be_infinite=True)

DEVICES: dict[str, DeviceSpec] = {
    spec.name: spec
    for spec in (
        DeviceSpec("LAYER", _LAYER_NODES, (_P("d", "m", usual=_COATING), _EPS, _R, _E_MAX), _layer_cells),
        DeviceSpec(
            "SLAB",
            _LAYER_NODES,
            (
                _P("d", "m", usual=_COATING),
                _P("eps_r", "", usual=_EPS_R_MATERIAL),
                _P("rho", "ohm m", usual=_RHO, may_be_infinite=True),
                _E_MAX,
            ),
            _slab_cells,
        ),
        DeviceSpec(
            "SKIN",
            _LAYER_NODES,
            (_P("d", "m", usual=_SKIN), _P("f", "Hz", usual=_BAND, least=1e-3, most=1e9)),
            _skin_cells,
        ),
        DeviceSpec("SKIN_DISPERSIVE", _LAYER_NODES, (_P("d", "m", usual=_SKIN),), _dispersive_cells),
        DeviceSpec(
            "GAP",
            _LAYER_NODES,
            # The defaults are those of the ngspice libraries: Table 1.
            (
                _P("d", "m", 3.5e-6, _AIR),
                _P("eps_r", "", 1.0, _EPS_R),
                _R,
                _P("fn", "N", 0.5, _LOAD),
                _P("mu", "", 0.3, _FRICTION, may_be_zero=True),
                _P("alpha", "mm^2/N^m", 54.4, _ALPHA),
                _P("m_exp", "", 0.52, _M_EXP),
                _P("beta", "mm^(2-n)", 32.0, _BETA),
                _P("n_exp", "", 1.41, _N_EXP),
                _P("c2", "mm^4/N^2", 5000.0, _C2, may_be_zero=True),
                _P("a_fix", "mm^2", 0.0, REST_AREA, may_be_zero=True),
                _P("tau", "s", 0.0, _TAU, may_be_zero=True),
            ),
            _layer_cells,
        ),
        DeviceSpec("R", ("p", "n"), (_P("value", "ohm", usual=_OHM),)),
        DeviceSpec("C", ("p", "n"), (_P("value", "F", usual=_FARAD),)),
        DeviceSpec("V", ("p", "n"), ()),
        DeviceSpec("I", ("p", "n"), ()),
    )
}
"""Every device the reader knows."""


def layer_devices() -> tuple[str, ...]:
    """Names of the layers, which need no definition in a netlist: X lines call them."""
    return tuple(name for name, spec in DEVICES.items() if spec.is_layer)
