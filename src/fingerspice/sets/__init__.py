"""The named sets: reading their files, looking them up, applying them to a circuit, and what to cite for a run."""

from __future__ import annotations

import dataclasses
import re
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from functools import cache
from pathlib import Path
from types import MappingProxyType
from typing import Any, overload

from fingerspice.base.errors import InputError
from fingerspice.base.pages import Page, Shown, Table
from fingerspice.base.units import format_si
from fingerspice.circuit.circuit import Circuit, Element
from fingerspice.circuit.describe import in_force, remembering, require_circuit
from fingerspice.circuit.statespace import driving_sources
from fingerspice.waveforms.periodic import Square
from fingerspice.waveforms.waveform import AM, Sine, Waveform, require

#: Waveforms of drives, by the name that a set gives.
WAVEFORMS: dict[str, type[Waveform]] = {"Sine": Sine, "Square": Square, "AM": AM}
_PREFIXED = ("m", "ohm", "V", "Hz", "N")  #: Units that take a prefix in tables.
DATA = Path(__file__).with_name("data")
#: Where a work is found, by BibTeX's names, with the words before them in a sentence.
_SAID = (("journal", ""), ("booktitle", ""), ("volume", "vol."), ("number", "no."), ("pages", "pp."), ("note", ""))
KINDS = ("scene", "finger", "load", "coating", "drive")  #: Kinds of sets, in the order in which they are listed.
#: Elements of a value, with the devices to which it is given; a source is a V element that drives.
ELEMENTS = {"gap": ("GAP",), "skin": ("SKIN", "SKIN_DISPERSIVE"), "coating": ("LAYER",), "source": ("V",)}


@dataclass(frozen=True)
class SetValue:
    """One value of a set."""

    element: str  # A key of `ELEMENTS`
    parameter: str  # As in the netlist, or a parameter of the set's waveform
    value: float
    unit: str
    low: float  # Range of the value, in `unit`
    high: float
    source: str  # Where the value comes from, with keys of references in brackets; "assumed ..." if not published
    range: str  # Where the range comes from
    optional: bool = False  # Whether a circuit may lack the parameter

    @property
    def path(self) -> str:
        """Element and parameter: ``gap.r``."""
        return f"{self.element}.{self.parameter}"

    @property
    def assumed(self) -> bool:
        """Whether no reference has this value."""
        return self.source.startswith("assumed")


@dataclass(frozen=True)
class Reference:
    """A work to cite; `doi` is empty where none is known."""

    key: str
    kind: str  # BibTeX's
    title: str
    authors: tuple[str, ...]  # ``Family, Given``; an institution is in braces
    where: Mapping[str, str]  # Journal or book title, volume, number, pages, as BibTeX names them
    year: int | None = None
    doi: str = ""
    url: str = ""

    def text(self) -> str:
        """The reference in one sentence."""
        names = [a.strip("{}") if a[0] == "{" else " ".join(reversed(a.split(", ", 1))) for a in self.authors]
        who = ", ".join(names).replace(", others", " et al.")
        # An article's number, in place of pages, needs no word.
        words = dict(_SAID) | ({} if "-" in self.where.get("pages", "") else {"pages": ""})
        said = [f"{word} {self.where[key]}".strip() for key, word in words.items() if key in self.where]
        said += [str(self.year or ""), f"doi:{self.doi}" if self.doi else self.url]
        return f"{', '.join(filter(None, [f'{who}, “{self.title}”', *said]))}."

    def bibtex(self) -> str:
        """The reference as a BibTeX entry, in UTF-8."""
        fields = {"author": " and ".join(self.authors), "title": f"{{{self.title}}}", **self.where}
        fields |= {"year": str(self.year or ""), "doi": self.doi, "url": self.url}
        fields |= {"pages": fields["pages"].replace("-", "--")} if "pages" in fields else {}
        lines = [f"  {name} = {{{value.replace('&', chr(92) + '&')}}}," for name, value in fields.items() if value]
        return "\n".join([f"@{self.kind}{{{self.key},", *lines, "}"])


def keys_in(text: str) -> list[str]:
    """The keys of references that a text names in brackets."""
    return re.findall(r"\[(\w+)\]", text)


@cache
def references() -> Mapping[str, Reference]:
    """Every reference by its key."""
    found = tomllib.loads((DATA / "references.toml").read_text(encoding="utf-8"))
    for key, data in found.items():
        where = MappingProxyType({name: str(data.pop(name)) for name, _ in _SAID if name in data})
        found[key] = Reference(key=key, where=where, **data | {"authors": tuple(data["authors"])})
    return MappingProxyType(found)


@cache
def tables() -> Mapping[str, Mapping[str, Any]]:
    """The table of every set by its name, as its file has it."""
    files = sorted(DATA.glob("*.toml"), key=lambda file: file.stem.lower())
    found = [tomllib.loads(file.read_text(encoding="utf-8")) for file in files if file.stem != "references"]
    found.sort(key=lambda one: KINDS.index(one["kind"]))
    return MappingProxyType({one["name"]: one for one in found})


@dataclass(frozen=True, repr=False)
class ParameterSet(Shown):
    """A named set of parameters, each value with its source.

    Attributes
    ----------
    name, title : str
    kind : str
        ``finger``, ``load``, ``coating``, ``drive``, or ``scene`` for several of these.
    claims, not_claimed : str
        What the set says, and what it does not, with keys of references in brackets.
    values : mapping of str to SetValue
        By element and parameter, as in ``gap.r``.
    waveform : str or None
        Waveform of a drive, a name of this package such as ``Sine``.
    """

    name: str
    title: str
    kind: str
    claims: str
    not_claimed: str
    values: Mapping[str, SetValue]
    waveform: str | None = None

    @property
    def references(self) -> tuple[Reference, ...]:
        """The works from which values, ranges and claims come, in the order in which the set names them."""
        texts = [self.claims, *(t for v in self.values.values() for t in (v.source, v.range)), self.not_claimed]
        return tuple(references()[key] for key in dict.fromkeys(key for text in texts for key in keys_in(text)))

    @property
    def assumed(self) -> tuple[str, ...]:
        """Paths of the values that no reference has."""
        return tuple(path for path, value in self.values.items() if value.assumed)

    def apply(self, circuit: Circuit, to: str | None = None) -> Circuit:
        """The circuit with the values of this set, which it remembers for `Solution.cite`.

        Every GAP, skin and LAYER gets the values of its kind, and the one source the drive. A value that is
        ``optional`` is left out where the circuit has no place for it.

        Parameters
        ----------
        circuit : Circuit
        to : str, optional
            Name of an element, or of a subcircuit, to which alone the values go.

        Raises
        ------
        InputError
            If the circuit lacks a layer or source that the set has values for, or if it is not clear which is meant.

        Warns
        -----
        FingerspiceWarning
            As `Circuit.replace`.
        """
        require_circuit(circuit)
        changes: dict[str, float | Waveform] = {}
        for kind in dict.fromkeys(value.element for value in self.values.values()):
            own = [value for value in self.values.values() if value.element == kind]
            figures = {value.parameter: value.value for value in own}
            for e in self._elements(kind, circuit, to, needed=not all(value.optional for value in own)):
                if kind == "source":
                    changes[e.name] = WAVEFORMS[str(self.waveform)](**figures)
                else:
                    changes |= {f"{e.name}.{name}": value for name, value in figures.items() if name in e.values}
        return remembering(circuit.replace(changes), self.name, changes)

    def _elements(self, kind: str, circuit: Circuit, to: str | None, needed: bool) -> list[Element]:
        """The elements that the values for a kind of element go to, refused if it is not clear which are meant."""
        devices, name = ELEMENTS[kind], self.name
        known = [e for e in (driving_sources(circuit) if kind == "source" else circuit.elements) if e.device in devices]
        found = [e for e in known if to is None or f"{e.name}.".lower().startswith(f"{to}.".lower())]
        what = "driving V source" if kind == "source" else " or ".join(devices)
        if not found and needed:
            inside = "the circuit" if to is None else f"{to!r} of the circuit"
            there = f"its {', '.join(e.name for e in known)}" if known else f"a circuit with a {what}"
            raise InputError(f"the set {name!r} has values for a {what}, which {inside} lacks; allowed: {there}")
        # A finger has one layer of each kind on its area; two would be two parts of the screen, of which one is meant.
        if len(found) > len({"" if kind == "source" else e.nodes[2] for e in found}):
            both = f"the set {name!r} has values for one {what}, and the circuit has {', '.join(e.name for e in found)}"
            way = f"to={found[0].name!r}, or {found[0].name}={name} on the command line"
            raise InputError(f"{both}; allowed: one of these names ({way})")
        return found

    def to_dict(self) -> dict[str, Any]:
        """The set as plain data, for JSON."""
        return {
            **{key: getattr(self, key) for key in ("name", "title", "kind", "claims", "not_claimed", "waveform")},
            "values": [vars(value) | {"assumed": value.assumed} for value in self.values.values()],
            "references": [{"key": r.key, "text": r.text(), "doi": r.doi, "url": r.url} for r in self.references],
        }

    def _page(self) -> Page:
        rows = []
        for v in self.values.values():
            ends = "this value" if v.low == v.high else f"{quantity(v.low, v.unit)} to {quantity(v.high, v.unit)}"
            origin = "assumed" if v.assumed else ", ".join(keys_in(v.source))
            rows.append((v.path, quantity(v.value, v.unit), ends, origin))
        return Page([
            f"{self.name} ({self.kind}): {self.title}",
            *([f"waveform of the source: {self.waveform}"] if self.waveform else []),
            *("", Table(("", "value", "range", "source"), rows, left=4), ""),
            *(f"claims: {self.claims}", f"does not claim: {self.not_claimed}", ""),
            *(f"{v.path}: {v.source}; range: {v.range}" for v in self.values.values()),
            *("", *(f"[{r.key}] {r.text()}" for r in self.references)),
        ])  # fmt: skip


class ParameterSets(Shown, dict[str, ParameterSet]):
    """All named sets, by name."""

    def _page(self) -> Page:
        rows = []
        for one in self.values():
            assumed = f", {len(one.assumed)} assumed" if one.assumed else ""
            rows.append((one.name, one.kind, one.title, f"{len(one.values)}{assumed}"))
        return Page([Table(("name", "kind", "what it is", "values"), rows, left=4)])


@cache
def _set(name: str) -> ParameterSet:
    """A set, with the values of the sets that it includes and its own in their place."""
    table, values = tables()[name], dict[str, SetValue]()
    for other in table.get("includes", ()):
        values |= _set(other).values
    for one in table["values"]:
        value = SetValue(**{**one, "value": float(one["value"])})
        values[value.path] = value
    own = {key: table[key] for key in ("name", "title", "kind", "claims", "not_claimed")}
    return ParameterSet(**own, values=MappingProxyType(values), waveform=table.get("waveform"))


@overload
def parameters() -> ParameterSets: ...
@overload
def parameters(name: str, kind: str | None = None) -> ParameterSet: ...


def parameters(name: str | None = None, kind: str | None = None) -> ParameterSets | ParameterSet:
    """A named set of parameters, or the list of all sets.

    Parameters
    ----------
    name : str, optional
        In upper or lower case; the list of all sets without it.
    kind : str, optional
        Kind that the set has to have.

    Raises
    ------
    InputError
        If there is no such set; the message gives the nearest names.
    """
    if name is None:
        return ParameterSets({own: _set(own) for own in tables()})
    if not isinstance(name, str):
        raise InputError(f"parameters is given {name!r}, a {type(name).__name__}; allowed: the name of a set")
    require(kind is None or kind in KINDS, "kind", repr(kind), ", ".join(KINDS))
    known, key = {own.lower(): _set(own) for own in tables()}, name.strip().lower()
    fitting = {own: one for own, one in known.items() if kind in (None, one.kind)}
    if key not in fitting:
        shown = ", ".join(one.name for one in fitting.values())
        if (found := known.get(key)) is not None:
            raise InputError(f"the set {found.name!r} is a {found.kind}, not a {kind}; allowed: {shown}")
        near = ", ".join(repr(fitting[one].name) for one in get_close_matches(key, fitting, 3, 0.4))
        hint = f"nearest: {near}" if near else f"allowed: {shown}"
        raise InputError(f"unknown {f'{kind} ' if kind else ''}set {name!r}; {hint}")
    return fitting[key]


def quantity(value: float, unit: str) -> str:
    """A value with its unit, with a prefix where the unit takes one."""
    return format_si(value, unit) if unit in _PREFIXED else f"{value:g} {unit}".rstrip()


_MODEL = "Forsbach2021"  #: The paper whose model is simulated.
#: Programs that integrated the run, by the part of the method's name before the colon.
_METHODS = {"scipy": "SciPy", "torchdiffeq": "torchdiffeq"}


@dataclass(frozen=True, repr=False)
class Citation(Shown):
    """What to cite for a run.

    Attributes
    ----------
    statements : tuple of str
        What was used, one sentence or more each, with keys of references in brackets.
    references : tuple of Reference
        The works named in the statements, and those from which the values of the sets come.
    """

    statements: tuple[str, ...]
    references: tuple[Reference, ...]

    @property
    def bibtex(self) -> str:
        """The references as BibTeX entries, in UTF-8."""
        return "\n\n".join(reference.bibtex() for reference in self.references)

    def _page(self) -> Page:
        return Page([*self.statements, "", *(f"[{r.key}] {r.text()}" for r in self.references), "", self.bibtex])


def cite(circuit: Circuit, method: str) -> Citation:
    """What to cite for a run of a circuit by a method."""
    from fingerspice import __version__

    known = references()
    program = dataclasses.replace(known["fingerspice"], where={"note": f"version {__version__}"})
    found: dict[str, Reference] = {_MODEL: known[_MODEL], program.key: program}
    said = [f"The model is that of [{_MODEL}], simulated with fingerspice {__version__} [{program.key}]."]
    for name, (kept, changed) in in_force(circuit).items():
        one = parameters(name)
        given = {path: _given(one, circuit, path) for path in kept}
        own = [f"The set {name} ({one.title}) gave {', '.join(given)}"]
        assumed = [path for path, values in given.items() if any(value.assumed for value in values)]
        own += [f"assumed, not published: {', '.join(assumed)}"] if assumed else []
        own += [f"changed since: {', '.join(changed)}"] if changed else []
        gone = f"All values of the set {name} were changed since it was applied."
        said.append(f"{'; '.join(own)}." if given else gone)
        # The works behind the values that were used; those that only say how far a value may vary are not cited.
        texts = [one.claims, *(value.source for values in given.values() for value in values)] if kept else []
        found |= {key: known[key] for text in texts for key in keys_in(text)}
    said += [] if circuit.sets else ["No set of parameters was applied."]
    rest = f"All other values are those of the deck “{circuit.title}” and of changes made to it"
    said.append(f"{rest}; cite their sources, which the program does not know.")
    if (key := _METHODS.get(method.partition(":")[0])) is not None:
        said.append(f"The method {method} is that of [{key}].")
        found[key] = known[key]
    return Citation(tuple(said), tuple(found.values()))


def _given(one: ParameterSet, circuit: Circuit, path: str) -> list[SetValue]:
    """The values of a set that a path of the circuit got: one, or those of a waveform."""
    name, _, parameter = path.rpartition(".")
    devices = {e.name: e.device for e in circuit.elements}
    if path in devices or not name:
        return [value for value in one.values.values() if value.element == "source"]
    fitting = [value for value in one.values.values() if value.parameter == parameter]
    # Where the elements are unknown, any value of the set with this parameter may be meant.
    return [value for value in fitting if name not in devices or devices[name] in ELEMENTS[value.element]]
