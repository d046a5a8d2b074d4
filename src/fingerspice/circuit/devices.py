"""The devices of netlists: one entry per device, with its nodes, its parameters, and for a layer its cells.

The reader, runs, phasors and the export use the entry alone. For ngspice a layer also needs a subcircuit of the same
name, nodes, parameters and defaults in `fingerspice.lib` and `fingerspice_mobile.lib`; `tests/test_devices.py` compares
the entry with the subcircuits.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from fingerspice.base.arrays import FloatArray
from fingerspice.circuit.usual import REST_AREA, Usual
from fingerspice.physics.ladder import SKIN_LADDER
from fingerspice.physics.materials import EPS0, SKIN_BAND, skin_permittivity, skin_resistivity

Value = float | FloatArray
#: Function from an element's values (in the netlist's units), or those of several scenes (n,), to its cells in series,
#: shape (n_cell, 3) or (n_cell, 3, n): capacitance per area (F/m^2), total leakage (S) and leakage per area (S/m^2). At
#: a frequency (Hz), the second argument, a dispersive material becomes one cell with its data there; None gives all
#: cells of its ladder.
Cells = Callable[[Mapping[str, Value], float | None], FloatArray]


@dataclass(frozen=True)
class ParameterSpec:
    """One parameter of a device, in the unit of the netlist."""

    name: str
    unit: str
    default: float | None = None  # None for a parameter that the netlist must give
    usual: Usual | None = None  # Range outside which a warning is given
    meaning: str = ""  # What it is, in few words, beside its slider
    first: bool = False  # Whether the explorer's page shows it at once: the paper varies it, or Table 1 gives it
    may_be_zero: bool = False
    may_be_infinite: bool = False
    # least, most: Range of all other numbers: wide enough for any device, and so narrow that products and quotients do
    # not overflow
    least: float = 1e-30
    most: float = 1e30

    def allowed(self) -> str:
        """The allowed values in words."""
        words = ("0 or more" if self.may_be_zero else "more than 0") + (" or inf" if self.may_be_infinite else "")
        return f"{words}, from {self.least:g} to {self.most:g}"

    def accepts(self, value: float) -> bool:
        """Whether a value is in range."""
        special = {0.0: self.may_be_zero, math.inf: self.may_be_infinite}
        return special.get(value, self.least <= value <= self.most)

    def unusual(self, element: str, value: float) -> str | None:
        """The warning about a value outside the usual range, or None."""
        return None if self.usual is None else self.usual.warning(f"{element} {self.name}", value, self.unit)


@dataclass(frozen=True)
class DeviceSpec:
    """A device: its nodes, its parameters, and for a layer the function that gives its cells."""

    name: str
    nodes: tuple[str, ...]
    parameters: tuple[ParameterSpec, ...]
    cells: Cells | None = None
    what: str = ""  # What it is, in few words, above its sliders

    def __post_init__(self) -> None:
        if self.is_layer != (self.cells is not None):
            raise TypeError(f"device {self.name}: an area node and cells belong together; give both, or neither")

    def parameter(self, name: str) -> ParameterSpec:
        """The parameter of that name; raises KeyError if there is none."""
        return {p.name: p for p in self.parameters}[name]

    @property
    def is_layer(self) -> bool:
        """Whether the capacitance scales with the ridge contact area; a netlist calls such a device by an X line."""
        return "area" in self.nodes


def _cells(c: ArrayLike, g_total: ArrayLike, g_area: ArrayLike) -> FloatArray:
    return np.stack(np.broadcast_arrays(c, g_total, g_area), axis=1)


def _layer_cells(v: Mapping[str, Value], at: float | None) -> FloatArray:
    return _cells(np.array([EPS0 * v["eps_r"] / v["d"]]), np.array([1.0 / v["r"]]), 0.0)


def _slab_cells(v: Mapping[str, Value], at: float | None) -> FloatArray:
    return _cells(np.array([EPS0 * v["eps_r"] / v["d"]]), 0.0, np.array([1.0 / (v["rho"] * v["d"])]))


def _skin_cells(v: Mapping[str, Value], at: float | None) -> FloatArray:
    return _slab_cells({"d": v["d"], "eps_r": skin_permittivity(v["f"]), "rho": skin_resistivity(v["f"])}, at)


def _dispersive_cells(v: Mapping[str, Value], at: float | None) -> FloatArray:
    if at is None:
        eps_r, rho = SKIN_LADDER.cells()
    else:
        eps_r, rho = SKIN_LADDER.permittivity([at]), SKIN_LADDER.resistivity([at])
    return _cells(np.divide.outer(EPS0 * eps_r, v["d"]), 0.0, 1.0 / np.multiply.outer(rho, v["d"]))


# Usual ranges, each with its source.

# Sputtered and spun films have 10 nm to 10 um, foils up to 1 mm, cover glasses and screen protectors up to some mm.
_COATING = Usual(10e-9, 1e-2, "from a sputtered film to a thick glass")
# The horny layer has 10 to 20 um on most of the body and some 0.2 to 0.6 mm at the fingertip; callus has over 1 mm.
_SKIN = Usual(1e-6, 2e-3, "skin has 10 um, a fingertip 0.2 to 0.6 mm, callus over 1 mm")
# The air between rough skin and a screen: 3.5 um in Table 1; below 10 nm surfaces attract each other, and above 100 um
# the ridges (some 60 um high) do not touch the screen.
_AIR = Usual(10e-9, 100e-6, "from van der Waals contact to ridges off the screen; 3.5 um in Table 1")
_EPS_R = Usual(1.0, 1e4, "air has 1, polymers 2 to 10, ceramics up to some thousand")
# Weak conductors, such as skin at low frequencies (the first slab of its ladder), have up to 1e5.
_EPS_R_MATERIAL = Usual(1.0, 1e6, "polymers have 2 to 10, skin at low frequencies up to 1e5")
# 0.2 and 1 megohm in Table 1. Sweat in the gap (some ohm m, a few um, 35 mm^2) gives an ohm; a good polymer, 1e14 ohm m
# at 100 um, gives 1e14 ohm.
_LEAK = Usual(1.0, 1e15, "0.2 to 1 megohm in Table 1, an ohm for sweat, 1e14 ohm for a good polymer")
# Sweat has 0.7 ohm m, skin 1e3 to 1e5 (Eq. 18), the best polymers 1e16.
_RHO = Usual(0.1, 1e17, "sweat has 1 ohm m, skin 1e4, good polymers 1e14 to 1e16")
# Air has 3 MV/m, glass 10 to 40, thin polymer and oxide films 100 to 1000.
_STRENGTH = Usual(1e5, 1e10, "air has 3 MV/m, thin oxides 1 GV/m", "V/m, not V/um")
# Fingers touch with 0.1 to 5 N and press with less than 50 N; a value of 50 is probably meant in millinewton.
_LOAD = Usual(1e-3, 49.9, "a finger touches with 0.1 to 5 N", "newton, not millinewton")
_FRICTION = Usual(0.01, 5.0, "dry skin on glass has 0.1 to 1, moist skin up to 3")
# The ridge area at 1 N (Eq. 5), from a pencil's tip to a palm; Table 1 has 54.4.
_ALPHA = Usual(1.0, 2000.0, "the ridge area at 1 N; 54.4 in Table 1", "mm^2 and N")
# A smooth ball has 2/3 (Hertz), a rough plane up to 1; measured fingers have 0.2 to 0.8, Table 1 has 0.52.
_M_EXP = Usual(0.1, 1.0, "2/3 for a ball, 1 for a rough plane, 0.52 in Table 1")
_BETA = Usual(0.3, 1e4, "pi for a full disc, 32 in Table 1", "mm")
_N_EXP = Usual(0.5, 3.0, "2 for a full disc, 1.41 in Table 1")
# Table 1 has 5000: at a friction force of 0.15 N, c2 F_T^2 is then a tenth of the square of a fingertip's area.
_C2 = Usual(1.0, 1e6, "5000 in Table 1", "mm^4/N^2")
_TAU = Usual(1e-5, 60.0, "skin creeps within 1 ms to some seconds")
_BAND = Usual(*SKIN_BAND, "where the data of Eqs. 18 and 19 were measured")
# Resistances from leads to insulators; capacitances from a fraction of a picofarad between leads to a power supply's.
_OHM = Usual(1e-3, 1e15, "a lead has milliohms, an insulator up to 1e15 ohm")
_FARAD = Usual(1e-16, 1e-2, "a body has 150 pF to ground, a supply's capacitor some mF")

_P = ParameterSpec
_LAYER_NODES, _ENDS = ("p", "n", "area"), ("p", "n")
_THICKNESS, _SKIN_THICKNESS = (_P("d", "m", None, usual, "thickness", first=True) for usual in (_COATING, _SKIN))
_EPS = [_P("eps_r", "", None, usual, "permittivity", first=True) for usual in (_EPS_R, _EPS_R_MATERIAL)]
_RESISTIVITY = _P("rho", "ohm m", None, _RHO, "resistivity", first=True, may_be_infinite=True)
_TAKEN_AT = _P("f", "Hz", None, _BAND, "data taken at", first=True, least=1e-3, most=1e9)
_R = _P("r", "ohm", math.inf, _LEAK, "leak resistance", first=True, may_be_infinite=True)
_E_MAX = _P("e_max", "V/m", math.inf, _STRENGTH, "dielectric strength", may_be_infinite=True)
_DEVICES = (
    DeviceSpec("LAYER", _LAYER_NODES, (_THICKNESS, _EPS[0], _R, _E_MAX), _layer_cells, "layer"),
    DeviceSpec("SLAB", _LAYER_NODES, (_THICKNESS, _EPS[1], _RESISTIVITY, _E_MAX), _slab_cells, "layer"),
    DeviceSpec("SKIN", _LAYER_NODES, (_SKIN_THICKNESS, _TAKEN_AT), _skin_cells, "skin"),
    DeviceSpec("SKIN_DISPERSIVE", _LAYER_NODES, (_SKIN_THICKNESS,), _dispersive_cells, "skin, dispersive"),
    DeviceSpec(
        "GAP",
        _LAYER_NODES,
        # The defaults are Table 1's, and equal those of the ngspice libraries.
        (
            _P("d", "m", 3.5e-6, _AIR, "gap height", first=True),
            _P("eps_r", "", 1.0, _EPS_R, "permittivity"),
            _R,
            _P("fn", "N", 0.5, _LOAD, "load", first=True),
            _P("mu", "", 0.3, _FRICTION, "friction coeff.", first=True, may_be_zero=True),
            _P("alpha", "mm^2/N^m", 54.4, _ALPHA, "area at 1 N"),
            _P("m_exp", "", 0.52, _M_EXP, "load exp."),
            _P("beta", "mm^(2-n)", 32.0, _BETA, "area at 1 mm"),
            _P("n_exp", "", 1.41, _N_EXP, "indent exp."),
            _P("c2", "mm^4/N^2", 5000.0, _C2, "friction loss", may_be_zero=True),
            _P("a_fix", "mm^2", 0.0, REST_AREA, "fixed area", may_be_zero=True),
            _P("tau", "s", 0.0, _TAU, "area lag", may_be_zero=True),
        ),
        _layer_cells,
        "gap and contact",
    ),
    DeviceSpec("R", _ENDS, (_P("value", "ohm", None, _OHM, "resistance", first=True),), what="resistor"),
    DeviceSpec("C", _ENDS, (_P("value", "F", None, _FARAD, "capacitance", first=True),), what="capacitor"),
    DeviceSpec("V", _ENDS, (), what="voltage source"),
    DeviceSpec("I", _ENDS, (), what="current source"),
)

#: Every device that the reader knows, by name.
DEVICES = {spec.name: spec for spec in _DEVICES}


def layer_devices() -> tuple[str, ...]:
    """Names of the layer devices, which X lines may call without a definition in the netlist."""
    return tuple(name for name, spec in DEVICES.items() if spec.is_layer)
