"""The devices of netlists: one entry per device in `devices.toml`, with its nodes and its parameters; a layer's cells.

A parameter has its unit, its default, and its legal and usual range; a value outside the usual one is warned about. The
reader, runs, phasors and the export use the entry alone. For ngspice a layer also needs a subcircuit of the same name,
nodes, parameters and defaults in `fingerspice.lib` and `fingerspice_mobile.lib`; `tests/test_devices.py` compares the
entry with the subcircuits.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from fingerspice.base.arrays import FloatArray
from fingerspice.base.errors import InputError
from fingerspice.base.units import format_si, spice_text, suspicious_mega, unit_read_as_scale
from fingerspice.physics.materials import EPS0, SKIN_BAND, SKIN_LADDER, skin_permittivity, skin_resistivity

if TYPE_CHECKING:
    from fingerspice.circuit.circuit import Circuit, Element

# Units that take a prefix, where a slip of the user is a power of 1000; in the other units the slip is m^2 for mm^2.
_PREFIXED = ("m", "N", "Pa", "ohm", "ohm m", "A", "V", "V/m", "F", "H", "S", "Hz", "s")
_THOUSANDS = tuple(sign * 3 * k for k in (1, 2, 3, 4, 5) for sign in (-1, 1))
_MILLIONS = {"mm^2": (6, -6), "mm^2/N^m": (6, -6), "mm^4/N^2": (12, -12)}


@dataclass(frozen=True)
class Usual:
    """Usual range of the size of a quantity, both ends included; 0 and inf mean "none" and cause no warning."""

    least: float
    most: float
    source: str  # Origin of the range, as words to stand in brackets
    slip: str = ""  # The unit, and the other unit for which it is often taken, such as ``newton, not millinewton``

    def warning(self, what: str, value: float, unit: str) -> str | None:
        """The warning about a value of `what`, such as ``Xgap d``, outside the range; None for a value inside."""
        if abs(value) in (0.0, math.inf) or math.isnan(value) or self.least <= abs(value) <= self.most:
            return None
        ends = f"{shown(self.least, unit if unit in _PREFIXED else '')} to {shown(self.most, unit)}"
        said = f"{what} is {shown(value, unit)}, outside {ends}, the usual range ({self.source})"
        said += f": it is in {self.slip}" if self.slip else ""
        # Usual values with the same digits and another prefix: at most three, the nearest first.
        powers = _THOUSANDS if unit in _PREFIXED else _MILLIONS.get(unit, ())
        found = [float(f"{value:.12g}") * 10.0**power for power in powers]
        meant = [spice_text(x) for x in found if self.least <= abs(x) <= self.most][:3]
        most = " or ".join([", ".join(meant[:-1]), meant[-1]] if len(meant) > 1 else meant)
        return f"{said}; was {most} meant?" if meant else said


def shown(value: float, unit: str) -> str:
    """A value with its unit; powers of a unit and angles take no prefix: 1 kmm^2 would not be 1000 mm^2."""
    return format_si(value, unit) if unit in _PREFIXED else f"{value:.4g} {unit}".rstrip()


PHASE_STEP = math.log(10.0) * 2.0 / 3.0  #: Distance of a constant-phase element's poles, in ln s.
PHASE_POLES = 2.0 * np.pi * np.exp(PHASE_STEP * np.arange(1.0, 9.0))  #: Those, 1/s, but for one beyond each end.
# Where the ends begin behind the outer poles, in steps, and how much nearer than their first moments their poles are:
# the largest error from 10 Hz to 100 kHz at all n_cpe is smallest with these, 0.36 %.
_PHASE_ENDS, _NEARER = 0.42, 1.1
Value = float | FloatArray
#: Function from an element's values (in the netlist's units), or those of several scenes (n,), to its cells in series,
#: shape (n_cell, 3) or (n_cell, 3, n): capacitance per area (F/m^2), total leakage (S) and leakage per area (S/m^2). At
#: a frequency (Hz), the second argument if not None, a dispersive material becomes one cell with its data there.
Cells = Callable[[Mapping[str, Value], float | None], FloatArray]


@dataclass(frozen=True)
class ParameterSpec:
    """One parameter of a device, in the unit of the netlist."""

    name: str
    unit: str = ""
    default: float | None = None  # None for a parameter that the netlist must give
    usual: Usual | None = None  # Range outside which a warning is given
    meaning: str = ""  # What it is, in few words, beside its slider
    first: bool = False  # Whether the explorer's page shows it at once: the paper varies it, or Table 1 gives it
    may_be_zero: bool = False
    may_be_infinite: bool = False
    # Range of all other numbers: wide enough for any device, and so narrow that products and quotients do not overflow
    least: float = 1e-30
    most: float = 1e30
    slider: float | None = None  # Upper end of the slider of a value that is 0 in the deck

    def allowed(self) -> str:
        """The allowed values in words."""
        least = "any number" if self.least < 0.0 else "0 or more" if self.may_be_zero else "more than 0"
        words = least + (" or inf" if self.may_be_infinite else "")
        return f"{words}, from {self.least:g} to {self.most:g}"

    def accepts(self, value: float) -> bool:
        """Whether a value is in range."""
        return {0.0: self.may_be_zero, math.inf: self.may_be_infinite}.get(value, self.least <= value <= self.most)

    def unusual(self, element: str, value: float) -> str | None:
        """The warning about a value outside the usual range, or None."""
        return None if self.usual is None else self.usual.warning(f"{element} {self.name}", value, self.unit)


@dataclass(frozen=True)
class DeviceSpec:
    """A device: its nodes, its parameters, and the function that gives its cells, if it has such."""

    name: str
    nodes: tuple[str, ...]
    parameters: tuple[ParameterSpec, ...]
    cells: Cells | None = None
    what: str = ""  # What it is, in few words, above its sliders
    aliases: tuple[str, ...] = ()  # Other names of the value
    beside: tuple[str, ...] = ()  # LTspice's parasitics, which become elements: rser in series, all others in parallel
    control: tuple[str, ...] = ()  # What a line names after the nodes: nodes, or elements of that kind
    data: tuple[str, ...] = ()  # Data of a part that LTspice and Qucs-S write and no calculation uses
    place: int = 4  # Among the explorer's sliders

    def __post_init__(self) -> None:
        if self.is_layer and self.cells is None:
            raise TypeError(f"device {self.name}: an area node and cells belong together; give both, or neither")

    def parameter(self, name: str) -> ParameterSpec:
        """The parameter of that name; raises KeyError if there is none."""
        return {p.name: p for p in self.parameters}[name]

    @property
    def is_layer(self) -> bool:
        """Whether the capacitance scales with the ridge contact area; a netlist calls such a device by an X line."""
        return "area" in self.nodes


def _cells(*constants: ArrayLike) -> FloatArray:
    return np.stack(np.broadcast_arrays(*constants), axis=1)


def _layer_cells(v: Mapping[str, Value], at: float | None) -> FloatArray:
    """Of a layer that leaks by a resistance r, or by its resistivity rho."""
    g_total, g_area = (1.0 / v["r"], 0.0) if "r" in v else (0.0, 1.0 / (v["rho"] * v["d"]))
    return _cells(np.array([EPS0 * v["eps_r"] / v["d"]]), np.array([g_total]), np.array([g_area]))


def _skin_cells(v: Mapping[str, Value], at: float | None) -> FloatArray:
    return _layer_cells({"d": v["d"], "eps_r": skin_permittivity(v["f"]), "rho": skin_resistivity(v["f"])}, at)


def _dispersive_cells(v: Mapping[str, Value], at: float | None) -> FloatArray:
    whole = SKIN_LADDER
    eps_r, rho = whole.cells() if at is None else (whole.permittivity([at]), whole.resistivity([at]))
    return _cells(np.divide.outer(EPS0 * eps_r, v["d"]), 0.0, 1.0 / np.multiply.outer(rho, v["d"]))


def _phase_cells(v: Mapping[str, Value], at: float | None) -> FloatArray:
    """Of 1/(q s^n), a sum of poles: with steps h and b = sin(n pi)/(pi q), at poles x the sizes b h x^(1-n).

    Beyond the poles one pole more at each end has the integral of b x^(-n)/(s + x), and nearly its first moment there.
    From 10 Hz to 100 kHz the element is exact to 0.4 %; phasors take q s^n itself.
    """
    n, q = (x[None] for x in np.broadcast_arrays(np.maximum(v["n_cpe"], 1e-6), v["q"]))
    x, near = np.multiply.outer(PHASE_POLES, np.ones_like(n[0])), _NEARER
    low, high = x[:1] * math.exp(-_PHASE_ENDS * PHASE_STEP), x[-1:] * math.exp(_PHASE_ENDS * PHASE_STEP)
    width = PHASE_STEP * np.array([0.5 + _PHASE_ENDS, *np.ones(PHASE_POLES.size - 2), 0.5 + _PHASE_ENDS])
    poles = np.concatenate([near * low * (1.0 - n) / (2.0 - n), x, high * (1.0 + n) / (n * near)])
    inner = width.reshape(-1, *[1] * (x.ndim - 1)) * x ** (1.0 - n)
    sizes = np.concatenate([low ** (1.0 - n) / (1.0 - n), inner, high ** (1.0 - n) * (1.0 + n) / (n**2 * near)])
    c = q * np.pi / (np.sin(np.pi * n) * sizes)
    return _cells(c, poles * c, 0.0 * c)


def _phase_layer_cells(v: Mapping[str, Value], at: float | None) -> FloatArray:
    return _phase_cells(v, at)[:, [0, 2, 1]]


_DATA = tomllib.loads(Path(__file__).with_name("devices.toml").read_text(encoding="utf-8"))
_USUAL, SOURCES, MEASURED = (
    {name: Usual(**one) for name, one in _DATA[table].items()} for table in ("usual", "sources", "measured")
)
"""Usual ranges by name, of sources by the unit of the parameter, and of measured values by the signal."""
_USUAL["skin_band"] = Usual(*SKIN_BAND, "where the data of Eqs. 18 and 19 were measured")
#: Usual ranges of the area of a finger's ridges, mm^2, and of the amplitude (V) under which forces are measured.
REST_AREA, MEASURING = _USUAL["rest_area"], _USUAL["measuring"]
#: What the numbers of waveforms are, in few words, where their names do not say it; those that the page shows at once.
MEANINGS, FIRST_OF_SOURCES = _DATA["waveforms"]["meanings"], _DATA["waveforms"]["first"]
_CELLS: Mapping[str, Cells] = {
    "LAYER": _layer_cells, "SLAB": _layer_cells, "GAP": _layer_cells,
    "SKIN": _skin_cells, "SKIN_DISPERSIVE": _dispersive_cells, "CPE": _phase_cells, "CPE_LAYER": _phase_layer_cells,
}  # fmt: skip


def _device(name: str, parameters: Iterable[dict[str, Any]] = (), **given: Any) -> DeviceSpec:
    """A device from its entry in the file."""
    specs = tuple(ParameterSpec(**{**one, "usual": _USUAL[one["usual"]]}) for one in parameters)
    words: dict[str, Any] = {key: tuple(x) if isinstance(x, list) else x for key, x in given.items()}
    return DeviceSpec(name, parameters=specs, cells=_CELLS.get(name), **words)


DEVICES = {one["name"]: _device(**one) for one in _DATA["device"]}  #: Every device that the reader knows, by name.
#: Parameters of GAP that do not belong to the paper's contact law.
OF_EVERY_LAW = ("d", "eps_r", "r", "fn", "mu", "a_fix", "tau", "p_sat", "slip", "v", "r_exp", "r_load", "q", "n_cpe")


def called_devices() -> tuple[str, ...]:
    """Names of the devices that X lines may call without a definition in the netlist."""
    return tuple(name for name, spec in DEVICES.items() if spec.cells is not None)


# Values


def beyond_fingers(where: str, force: float, pressure: float, area: float) -> Iterator[str]:
    """Warnings about largest values of a run (N, Pa and m^2) that no finger can have; `where` may be `` of Xgap``."""
    for value, (what, largest, unit, reason) in zip((force, pressure, area), _DATA["largest"], strict=True):
        if value > largest:
            reached = f"the {what}{where} reaches {shown(value, unit)}, over {shown(largest, unit)} ({reason})"
            yield f"{reached}: some value is probably in another unit"


# Units whose letter SPICE reads as a scale factor, with their names, and how SPICE reads them.
_UNIT_TRAPS = {"F": ("farad", "femto (1e-15)"), "N": ("newton", "nano (1e-9)")}


def unit_trap(spec: ParameterSpec, text: str) -> str | None:
    """Reason to refuse a number whose unit SPICE would read as a scale factor; None if SPICE would not."""
    word, prefix = _UNIT_TRAPS.get(spec.unit, ("", ""))
    trapped = word and unit_read_as_scale(text, spec.unit, word)
    return f"is {text!r}: SPICE reads {spec.unit} as {prefix}; write the number alone, in {word}" if trapped else None


def mega_note(text: str, value: float, spec: ParameterSpec) -> str | None:
    """The warning about a number with a capital M, which SPICE reads as milli, if the parameter is a resistance."""
    if spec.unit not in ("ohm", "ohm m") or not (meant := suspicious_mega(text)):
        return None
    return f"{text!r} is milli ({value:g} {spec.unit}), as everywhere in SPICE; for megohm write {meant}"


def unusual(element: Element) -> Iterator[tuple[str, str]]:
    """Warnings about an element's unusual values, each with the parameter's name (empty for the area at 0 V)."""
    v, own = element.values, {p.name: p.usual for p in element.spec.parameters}
    ranges = ((name, p, own.get(name, SOURCES.get(p.unit))) for name, p in element.parameters.items())
    found = [(name, usual.warning(f"{element.name} {name}", p.value, p.unit)) for name, p, usual in ranges if usual]
    if element.device == "GAP" and v["slip"] > 0.0 and v["v"] == 0.0:
        found.append(("v", f"{element.name} has a slip and v=0: a finger at rest, whose friction stays as it starts"))
    if element.device == "GAP" and element.law is None and v["a_fix"] == 0.0 and not any(text for _, text in found):
        adhesive = v["alpha"] * v["fn"] ** v["m_exp"]
        area = adhesive**2 - v["c2"] * (v["mu"] * v["fn"]) ** 2
        if area > 0.0:
            found.append(("", REST_AREA.warning(f"{element.name} area at 0 V", area / adhesive, "mm^2")))
    yield from ((name, text) for name, text in found if text is not None)


def unusual_of_changed(before: Circuit, after: Circuit) -> tuple[dict[str, str], dict[str, str]]:
    """Warnings about unusual values in the elements that differ between two circuits, with the parameters' paths."""
    found: tuple[dict[str, str], dict[str, str]] = {}, {}
    for pair in zip(before.elements, after.elements, strict=True):
        for e, texts in zip(pair, found, strict=True) if pair[0] is not pair[1] else ():
            for name, text in e.remember(("unusual",), lambda e=e: tuple(unusual(e))):  # type: ignore[misc]
                texts[text] = f"{e.name}.{name}".lower()
    return found


def concerns(warning: str, changes: Mapping[str, Any]) -> bool:
    """Whether a warning of the reader is about the notation of a value that `changes` now replaces."""
    paths = [*map(str.lower, changes)]
    # A warning that names only the source may be about its frequency.
    subjects = [*paths, *(" ".join(x.rsplit(".", 1)) for x in paths), *(x.removesuffix(".frequency") for x in paths)]
    return any(f": {subject}: " in warning.lower() for subject in subjects)


def check(circuit: Circuit) -> None:
    """Refuse values out of range and contacts that cannot exist."""
    for element in circuit.elements:
        element.remember(("checked",), partial(_check_element, element))
    if circuit.tran is not None and not circuit.tran.stop > 0.0:
        raise InputError(f"t_stop is {circuit.tran.stop:g} s; allowed: more than 0")


def _check_element(element: Element) -> None:
    v = element.values
    for spec in element.spec.parameters:
        if not spec.accepts(v[spec.name]):
            given = f"{v[spec.name]:g} {spec.unit}".rstrip()
            raise InputError(f"{element.name} {spec.name} is {given}; allowed: {spec.allowed()}", element.where)
    if element.device != "GAP" or element.law is not None:
        return
    m, n, fault = v["m_exp"], v["n_exp"], ""
    loss, exponents = math.sqrt(v["c2"]) * v["mu"] * v["fn"], f"m_exp={m:g}, n_exp={n:g}"
    if not 0.0 < m < n:
        fault = f"exponents are {exponents}; allowed: 0 < m_exp < n_exp"
    elif not (total := 1.0 / m + 1.0 / n) > 1.0:
        allowed = "more than 1 (else Eq. 4 has no single root)"
        fault = f"exponents {exponents} give 1/m + 1/n = {total:.4g}; allowed: {allowed}"
    elif v["a_fix"] == 0.0 and math.isinf(v["p_sat"]) and not (area := v["alpha"] * v["fn"] ** m) > loss:
        hint = "".join(f"; note {text}" for _, text in unusual(element))
        fault = (
            f"has no contact: friction takes the whole ridge area at 0 V (A0 = alpha fn^m_exp = {area:.4g} mm^2, "
            f"sqrt(c2) mu fn = {loss:.4g} mm^2); allowed: A0^2 > c2 mu^2 fn^2, so less load fn, less friction mu or "
            f"less c2{hint}"
        )
    if fault:
        raise InputError(f"{element.name} {fault}", element.where)
