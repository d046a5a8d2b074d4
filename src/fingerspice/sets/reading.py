"""The sets' files: what a set, a value and a reference consist of, and reading them from ``data/``."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from types import MappingProxyType
from typing import Any

DATA = Path(__file__).with_name("data")
#: Kinds of sets, in the order in which they are listed.
KINDS = ("scene", "finger", "load", "coating", "drive")
#: Elements of a value, with the devices to which it is given; a source is a V element that drives.
ELEMENTS = {"gap": ("GAP",), "skin": ("SKIN", "SKIN_DISPERSIVE"), "coating": ("LAYER",), "source": ("V",)}
_KEY = re.compile(r"\[(\w+)\]")


@dataclass(frozen=True)
class SetValue:
    """One value of a set."""

    element: str  # A key of `ELEMENTS`
    parameter: str  # As in the netlist, or a parameter of the set's waveform
    value: float
    unit: str
    # low, high: The range of the value, in `unit`
    low: float
    high: float
    # source, range: Where value and range come from, with keys of references in brackets; a source that begins with
    # ``assumed`` is no published value
    source: str
    range: str
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

    # key, kind, title: The kind is BibTeX's
    key: str
    kind: str
    title: str
    authors: tuple[str, ...]  # ``Family, Given``; an institution is in braces
    year: int | None
    where: Mapping[str, str]  # Journal or book title, volume, number, pages, as BibTeX names them
    doi: str
    url: str

    def text(self) -> str:
        """The reference in one sentence."""
        names = [a.strip("{}") if a[0] == "{" else " ".join(reversed(a.split(", ", 1))) for a in self.authors]
        who = ", ".join(names).replace(", others", " et al.")
        said = [f"{who}, “{self.title}”"]
        for key, word in _SAID:
            if key in self.where:
                # An article's number, in place of pages, needs no word.
                bare = key == "pages" and "-" not in self.where[key]
                said.append(self.where[key] if bare else f"{word} {self.where[key]}".strip())
        said += [str(self.year)] if self.year else []
        said += [f"doi:{self.doi}" if self.doi else self.url] if self.doi or self.url else []
        return f"{', '.join(said)}."

    def bibtex(self) -> str:
        """The reference as a BibTeX entry, in UTF-8."""
        fields = {"author": " and ".join(self.authors), "title": f"{{{self.title}}}", **self.where}
        fields |= {"pages": self.where["pages"].replace("-", "--")} if "pages" in self.where else {}
        fields |= {"year": str(self.year or ""), "doi": self.doi, "url": self.url}
        lines = [f"  {name} = {{{value.replace('&', chr(92) + '&')}}}," for name, value in fields.items() if value]
        return "\n".join([f"@{self.kind}{{{self.key},", *lines, "}"])


_SAID = (("journal", ""), ("booktitle", ""), ("volume", "vol."), ("number", "no."), ("pages", "pp."), ("note", ""))


def keys_in(text: str) -> list[str]:
    """The keys of references that a text names in brackets."""
    return _KEY.findall(text)


@cache
def references() -> Mapping[str, Reference]:
    """Every reference by its key."""
    found = {}
    for key, data in tomllib.loads((DATA / "references.toml").read_text(encoding="utf-8")).items():
        where = MappingProxyType({name: str(data[name]) for name, _ in _SAID if name in data})
        own = (key, data["kind"], data["title"], tuple(data["authors"]), data.get("year"), where)
        found[key] = Reference(*own, data.get("doi", ""), data.get("url", ""))
    return MappingProxyType(found)


@cache
def tables() -> Mapping[str, Mapping[str, Any]]:
    """The table of every set by its name, as its file has it."""
    files = sorted(DATA.glob("*.toml"), key=lambda file: file.stem.lower())
    found = [tomllib.loads(file.read_text(encoding="utf-8")) for file in files if file.stem != "references"]
    found.sort(key=lambda one: KINDS.index(one["kind"]))
    return MappingProxyType({one["name"]: one for one in found})


def values_of(name: str) -> dict[str, SetValue]:
    """The values of a set by path: those of the sets that it includes, and its own in their place."""
    table = tables()[name]
    found: dict[str, SetValue] = {}
    for other in table.get("includes", ()):
        found |= values_of(other)
    own = (SetValue(**{**one, "value": float(one["value"])}) for one in table["values"])
    return found | {value.path: value for value in own}
