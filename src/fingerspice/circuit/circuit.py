"""A circuit as data: elements with values in the netlist's units, and the analyses that its deck asks for."""

from __future__ import annotations

import cmath
import dataclasses
import math
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from difflib import get_close_matches
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import Any, cast

from fingerspice.base.arrays import Remembering, real_number
from fingerspice.base.errors import FingerspiceWarning, InputError, Where
from fingerspice.base.pages import Page, Shown
from fingerspice.base.units import parse_number
from fingerspice.circuit.devices import (
    DEVICES,
    OF_EVERY_LAW,
    DeviceSpec,
    check,
    concerns,
    mega_note,
    unit_trap,
    unusual_of_changed,
)
from fingerspice.circuit.laws import ContactLaw, law_of
from fingerspice.circuit.measures import Measure, Quantity
from fingerspice.waveforms.waveform import Waveform, as_waveform, refuse, require

CHARGE_LAWS = ("local", "mobile")
WORK_READINGS = ("gap", "total")
#: A value in the netlist's unit, as a number or text, or a source's waveform or function of time (s); by path.
Changes = Mapping[str, float | str | Waveform | ContactLaw | Callable[[float], float]]


@dataclass(frozen=True)
class SmallSignal:
    """``AC magnitude [phase]`` of a source: its amplitude (V or A) and phase (degrees) in an ``.ac`` sweep."""

    magnitude: float = 1.0
    phase_deg: float = 0.0

    def __post_init__(self) -> None:
        for what, value in (("magnitude", self.magnitude), ("phase", self.phase_deg)):
            require(math.isfinite(value), f"AC {what}", f"{value:g}", "a finite number")

    @property
    def phasor(self) -> complex:
        """Complex amplitude; a negative magnitude adds 180 degrees to the phase."""
        return cmath.rect(self.magnitude, math.radians(self.phase_deg))


@dataclass(frozen=True, repr=False)
class Element(Remembering):
    """One device of a circuit."""

    name: str  # As written; of an element of a subcircuit with its path, as in ``Xfinger.Xgap``
    device: str  # Entry of `DEVICES`
    nodes: tuple[str, ...]  # In lower case, with ground as ``0``
    node_names: tuple[str, ...]  # As written
    values: Mapping[str, float]  # Value of every parameter of the device, in the netlist's unit
    waveform: Waveform | None = None  # Of a source
    initial: float | None = None  # ``IC=`` of a capacitor, V, or of an inductor, A
    where: Where | None = None  # Place in the netlist
    ac: SmallSignal | None = None  # Of a source that has one
    law: ContactLaw | None = None  # Of a GAP with another one than the paper's
    control: tuple[str, ...] = ()  # Nodes or elements that control it, in lower case

    def __repr__(self) -> str:
        from fingerspice.circuit.describe import values_text

        return f"<{' '.join([self.device, self.name, *self.node_names, values_text(self)]).rstrip()}>"

    def __getstate__(self) -> dict[str, Any]:
        return {**super().__getstate__(), "values": dict(self.values)}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update({**state, "values": MappingProxyType(state["values"])})

    @property
    def spec(self) -> DeviceSpec:
        """The device's entry in the registry, or that of a GAP with its contact law."""
        return DEVICES[self.device] if self.law is None else self.law.spec

    def under(self, law: ContactLaw | None) -> Element:
        """This GAP with a contact law: with its values of parameters that both laws have, and the others' defaults."""
        other = dataclasses.replace(self, law=law)
        values = {p.name: self.values.get(p.name, p.default or 0.0) for p in other.spec.parameters}
        return dataclasses.replace(other, values=MappingProxyType(values))

    @cached_property
    def parameters(self) -> Mapping[str, Parameter]:
        """Every number of the device and of its waveform by name, with its unit."""
        found = {p.name: Parameter(self.values[p.name], p.unit) for p in self.spec.parameters}
        wave, units = self.waveform, {} if self.waveform is None else type(self.waveform).units
        return found | {x: Parameter(getattr(wave, x), unit) for x, unit in units.items() if hasattr(wave, x)}


@dataclass(frozen=True)
class Tran:
    """``.tran TSTEP TSTOP [TSTART [TMAX]] [uic]``, s; TSTEP, the spacing of outputs, does not affect the accuracy."""

    step: float
    stop: float
    start: float = 0.0
    max_step: float | None = None
    uic: bool = False


@dataclass(frozen=True)
class AcSweep:
    """``.ac DEC|OCT|LIN N FSTART FSTOP``: frequencies in Hz, N points per decade, per octave or in all."""

    scale: str
    points: int
    start: float
    stop: float


@dataclass(frozen=True)
class Step:
    """What a `.step` or `.dc` line changes, and its values in the netlist's unit.

    `name` is that of a `.param`, in lower case, or a path as in `Circuit.replace`; of a source it steps the level.
    """

    name: str
    values: tuple[float, ...]
    of_param: bool = False


@dataclass(frozen=True)
class Parameter:
    """Value and unit of one circuit parameter."""

    value: float
    unit: str


@dataclass(frozen=True, repr=False)
class Circuit(Remembering, Shown):
    """A netlist, read.

    Attributes
    ----------
    title, text : str
        Title and text of the deck.
    elements : tuple of Element
    tran : Tran or None
    ac : AcSweep or None
    initial : mapping of str to float
        ``.ic``: from canonical node to V, or to mm^2 of an area node.
    charge_law : str or None
        ``local`` or ``mobile``, as set by the included library; None if the deck includes no library.
    work : str
        Reading of Eq. 7: ``gap`` (the gap voltage is held) or ``total`` (the voltage of the whole stack is held, where
        a dispersive skin has its permittivity above all poles).
    warnings : tuple of str
        Warnings of the reader and of `replace`.
    unused : tuple of str
        Directives that are accepted and have no effect here.
    path : Path or None
    overrides : mapping of str to str
        Changes made by `replace`, from path to value as text.
    sets : mapping of str to mapping
        Named sets of parameters that were applied, each with the values that it gave, by path.
    measures : tuple of Measure
        Of its `.meas` lines.
    fourier : tuple of tuple of float and Quantity
        Of its `.four` lines: fundamental, Hz, and vector.
    saved : tuple of Quantity
        Of its `.save`, `.probe` and `.print` lines: the columns of tables and raw files; of all signals if empty.
    steps, dc : tuple of Step
        Of its `.step` lines, and of its `.dc` line, the innermost first.
    op : bool
        Whether it asks for the operating point.
    related : Remembering
        Cache of results that depend on nodes and devices alone, shared by all circuits that `replace` derives.
    """

    title: str
    elements: tuple[Element, ...]
    tran: Tran | None = None
    ac: AcSweep | None = None
    initial: Mapping[str, float] = field(default_factory=dict)
    charge_law: str | None = None
    work: str = "gap"
    warnings: tuple[str, ...] = ()
    unused: tuple[str, ...] = ()
    text: str = ""
    path: Path | None = None
    overrides: Mapping[str, str] = field(default_factory=dict)
    sets: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    measures: tuple[Measure, ...] = ()
    fourier: tuple[tuple[float, Quantity], ...] = ()
    saved: tuple[Quantity, ...] = ()
    steps: tuple[Step, ...] = ()
    dc: tuple[Step, ...] = ()
    op: bool = False
    related: Remembering = field(default_factory=Remembering, init=False, repr=False, compare=False)

    def _page(self) -> Page:
        from fingerspice.circuit.describe import circuit_page

        return circuit_page(self)

    def __getitem__(self, name: str) -> Element:
        """The element of that name, in upper or lower case.

        Raises
        ------
        InputError
            If there is none; the message gives the nearest name.
        """
        found = next((e for e in self.elements if e.name.lower() == name.lower()), None)
        if found is None:
            raise InputError(_unknown("element", name, [e.name for e in self.elements]))
        return found

    def by_device(self, *devices: str) -> tuple[Element, ...]:
        """Elements of the given devices, in deck order."""
        return tuple(e for e in self.elements if e.device in devices)

    @property
    def parameters(self) -> Mapping[str, Parameter]:
        """Every parameter by path (``Xgap.d``, ``Vdrive.amplitude``), with its value and unit as in the netlist."""
        return MappingProxyType({f"{e.name}.{name}": p for e in self.elements for name, p in e.parameters.items()})

    def draw(self, path: str | Path | None = None) -> Any:
        """Draw the schematic: a notebook shows it as SVG, and from a script ``draw().show()`` opens a window.

        Layers stand as a resistor beside a capacitor, or as a capacitor alone where they do not leak; nodes are rows,
        and the lowest one is ground.

        Parameters
        ----------
        path : str or Path, optional
            File to write, whose end says its kind: ``.svg`` or ``.png``.

        Returns
        -------
        Schematic
            A matplotlib figure.

        Raises
        ------
        InputError
            If the path has another end or cannot be written, or the circuit has too many elements for a picture.
        """
        from fingerspice.plots.schematic import draw_circuit

        return draw_circuit(self, path)

    def explore(self) -> Any:
        """Show the circuit on a local page, in a notebook below the cell (docs/explore.md).

        Returns
        -------
        Explorer
            The running page.
        """
        from fingerspice.explorer import explore

        return explore(self)

    def replace(self, changes: Changes) -> Circuit:
        """A changed circuit.

        Parameters
        ----------
        changes : mapping
            Path to value in the netlist's unit, as a number or in SPICE's notation (``{"Xgap.d": 3e-6}`` or
            ``{"Xgap.d": "3u"}``), or a source's name to a waveform or its text (``"SQUARE(200 100)"``).

        Raises
        ------
        InputError
            If a path is unknown (the message gives the nearest one), a text is no number, or a value is out of range.

        Warns
        -----
        FingerspiceWarning
            About a value outside the usual range, which was probably meant in another unit.
        """
        changed, notes, gone = self._replaced(changes)
        # The reader's warnings begin with a place in the deck.
        kept = [text for text in self.warnings if not text.endswith(gone) and not concerns(text, changes)]
        for text in notes:
            warnings.warn(text, FingerspiceWarning, stacklevel=2)
        return changed._with(warnings=(*kept, *notes)) if self.warnings or notes else changed

    def varied(self, changes: Changes) -> Circuit:
        """As `replace`, without warnings: for values that this package's sweeps choose, and not the user."""
        return self._replaced(changes)[0]

    def _replaced(self, changes: Changes) -> tuple[Circuit, list[str], tuple[str, ...]]:
        """A changed circuit, the warnings about the changes, and the warnings about values that are replaced."""
        if not isinstance(changes, Mapping) or not all(isinstance(path, str) for path in changes):
            raise InputError(f"replace is given {changes!r}; allowed: a mapping such as {{'Xgap.d': 3e-6}}")
        elements = {e.name.lower(): e for e in self.elements}
        overrides, traps = dict(self.overrides), dict[str, str]()
        # A contact law has parameters that other changes may be about.
        for path, value in sorted(changes.items(), key=lambda one: not one[0].lower().endswith(".law")):
            key = path.lower()
            name, _, parameter = key.rpartition(".")
            if key in elements and elements[key].device in "VI":
                from fingerspice.netlist.netlist import source_from_text

                waveform = source_from_text(value, self) if isinstance(value, str) else as_waveform(cast(Any, value))
                # The AC magnitude belonged to the source that is replaced.
                elements[key] = dataclasses.replace(elements[key], waveform=waveform, ac=None)
            elif name in elements and parameter == "law" and elements[name].device == "GAP":
                elements[name] = elements[name].under(law_of(value))
                # What was changed of the law that is left is forgotten.
                for old in [x for x in overrides if x.lower().rpartition(".")[0] == name]:
                    if old.lower().rpartition(".")[2] not in OF_EVERY_LAW:
                        del overrides[old]
            elif name in elements:
                elements[name], trap = _changed(elements[name], parameter, value, path)
                traps |= {key: trap} if trap else {}
            else:
                raise InputError(self._unknown_path(path))
            named = getattr(value, "__name__", str(value)) if not isinstance(value, ContactLaw) else value.name
            overrides[path] = value if isinstance(value, str) else named
        changed = self._with(elements=tuple(elements.values()), overrides=overrides)
        check(changed)
        before, after = unusual_of_changed(self, changed)
        # One warning per value is enough: none about its size where there is one about its notation.
        new = [text for text, path in after.items() if text not in before and path not in traps]
        return changed, [*traps.values(), *new], tuple(before.keys() - after.keys())

    def _with(self, **changes: Any) -> Circuit:
        """This circuit with changes that affect neither nodes nor devices, so that the cache `related` stays valid."""
        changed = dataclasses.replace(self, **changes)
        vars(changed)["related"] = self.related
        return changed

    def _unknown_path(self, path: str) -> str:
        """The message about a path that `replace` does not know."""
        name = path.rpartition(".")[0] or path
        inside = [e.name for e in self.elements if e.name.lower().startswith(f"{name.lower()}.")]
        if not inside:
            return _unknown("parameter", path, [*self.parameters, *(e.name for e in self.by_device("V", "I"))])
        shown = ", ".join(inside if len(inside) <= 8 else [*inside[:8], "..."])
        said = f"{name} is a subcircuit, whose own parameters got their values when the deck was read"
        return f"unknown parameter {path!r}: {said}; allowed: a parameter of an element inside it ({shown})"


def _changed(element: Element, parameter: str, given: Any, path: str) -> tuple[Element, str | None]:
    """An element with a new value, and a warning about the value's notation, or None."""
    known, note = element.parameters, None
    if parameter not in known:
        raise InputError(_unknown("parameter", path, [f"{element.name}.{name}" for name in known]))
    spec = element.spec.parameter(parameter) if parameter in element.values else None
    if not isinstance(given, str):
        value = real_number(path, given, f"a number {known[parameter].unit}".rstrip() + ", or text such as '3.5u'")
    elif (text := given.strip()).lower() in ("inf", "none"):
        value = math.inf
    else:
        value = number_from(path, text)
        if spec is not None:
            trap = unit_trap(spec, text)
            refuse(trap, f"{path} {trap}")
            note = mega_note(text, value, spec)
    told = f"{path}: {note}" if note else None
    if spec is not None:
        return dataclasses.replace(element, values=MappingProxyType({**element.values, parameter: value})), told
    waveform = dataclasses.replace(element.waveform, **{parameter: value})  # type: ignore[type-var]
    return dataclasses.replace(element, waveform=waveform), told


def number_from(what: str, text: str) -> float:
    """The number in a text, in SPICE's notation; `what` it is begins the message where it is none."""
    try:
        return parse_number(text.strip())
    except ValueError as error:
        raise InputError(f"{what}: {error}") from None


def _unknown(kind: str, given: str, known: list[str]) -> str:
    near = nearest(given, known)
    return f"unknown {kind} {given!r}; " + ("there is none" if near is None else f"nearest: {near!r}")


def nearest(given: str, known: list[str], least: float = 0.0) -> str | None:
    """The known name that a given one resembles most, whatever the case; None if none does by `least` (0 to 1)."""
    lower = {k.lower(): k for k in known}
    near = get_close_matches(given.lower(), lower, 1, least)
    return lower[near[0]] if near else None
