"""The named sets: looking them up, showing them, and applying them to a circuit."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from functools import cache
from types import MappingProxyType
from typing import Any, overload

from fingerspice.base.errors import InputError
from fingerspice.base.pages import Page, Shown, Table
from fingerspice.base.units import format_si
from fingerspice.circuit.circuit import Circuit
from fingerspice.sets.applying import changes_by
from fingerspice.sets.reading import KINDS, Reference, SetValue, keys_in, references, tables, values_of

#: Units that take a prefix in tables.
_PREFIXED = ("m", "ohm", "V", "Hz", "N")


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
        return changes_by(self.name, self.values, self.waveform, circuit, to)

    def to_dict(self) -> dict[str, Any]:
        """The set as plain data, for JSON."""
        return {
            **{key: getattr(self, key) for key in ("name", "title", "kind", "claims", "not_claimed", "waveform")},
            "values": [vars(value) | {"assumed": value.assumed} for value in self.values.values()],
            "references": [{"key": r.key, "text": r.text(), "doi": r.doi, "url": r.url} for r in self.references],
        }

    def _page(self) -> Page:
        rows = [(v.path, quantity(v.value, v.unit), _range(v), _briefly(v)) for v in self.values.values()]
        drive = [f"waveform of the source: {self.waveform}"] if self.waveform else []
        table = Table(("", "value", "range", "source"), rows, left=4)
        said = [f"claims: {self.claims}", f"does not claim: {self.not_claimed}"]
        origins = [f"{v.path}: {v.source}; range: {v.range}" for v in self.values.values()]
        cited = [f"[{r.key}] {r.text()}" for r in self.references]
        blocks: list[str | Table] = [
            f"{self.name} ({self.kind}): {self.title}",
            *drive,
            "",
            table,
            "",
            *said,
            "",
            *origins,
            "",
            *cited,
        ]
        return Page(blocks)


class ParameterSets(Shown, Mapping[str, ParameterSet]):
    """All named sets, by name."""

    def __getitem__(self, name: str) -> ParameterSet:
        return _sets()[name]

    def __iter__(self) -> Iterator[str]:
        return iter(_sets())

    def __len__(self) -> int:
        return len(_sets())

    def _page(self) -> Page:
        rows = [(one.name, one.kind, one.title, _sourced(one)) for one in self.values()]
        return Page([Table(("name", "kind", "what it is", "values"), rows, left=4)])


def _range(value: SetValue) -> str:
    ends = (quantity(end, value.unit) for end in (value.low, value.high))
    return "this value" if value.low == value.high else " to ".join(ends)


def _briefly(value: SetValue) -> str:
    return "assumed" if value.assumed else ", ".join(keys_in(value.source))


def _sourced(one: ParameterSet) -> str:
    count = len(one.assumed)
    return f"{len(one.values)}, {count} assumed" if count else f"{len(one.values)}"


@cache
def _sets() -> dict[str, ParameterSet]:
    own = ("name", "title", "kind", "claims", "not_claimed")
    return {
        name: ParameterSet(
            **{key: table[key] for key in own},
            values=MappingProxyType(values_of(name)),
            waveform=table.get("waveform"),
        )
        for name, table in tables().items()
    }


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
        return ParameterSets()
    if not isinstance(name, str):
        raise InputError(f"parameters is given {name!r}, a {type(name).__name__}; allowed: the name of a set")
    if kind is not None and kind not in KINDS:
        raise InputError(f"kind is {kind!r}; allowed: {', '.join(KINDS)}")
    known = {own.lower(): one for own, one in _sets().items()}
    found = known.get(name.strip().lower())
    fitting = [one for one in known.values() if kind in (None, one.kind)]
    if found is None or found not in fitting:
        shown = ", ".join(one.name for one in fitting)
        if found is not None:
            raise InputError(f"the set {found.name!r} is a {found.kind}, not a {kind}; allowed: {shown}")
        near = get_close_matches(name.strip().lower(), [one.name.lower() for one in fitting], 3, 0.4)
        hint = f"nearest: {', '.join(repr(known[one].name) for one in near)}" if near else f"allowed: {shown}"
        raise InputError(f"unknown {kind or 'parameter'} set {name!r}; {hint}".replace("parameter set", "set"))
    return found


def quantity(value: float, unit: str) -> str:
    """A value with its unit, with a prefix where the unit takes one."""
    plain = unit not in _PREFIXED or value == 0.0 or not math.isfinite(value)
    return f"{value:g} {unit}".rstrip() if plain else format_si(value, unit)
