"""A deck, and what the reader makes of its lines: evaluated words, and the statements and directives made of them."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple, TypeAlias

from fingerspice.base.errors import Where


class Token(NamedTuple):
    """A word that is not a number, such as a keyword, a file name or `inf`; `quoted` if it was in double quotes."""

    text: str
    where: Where
    quoted: bool = False
    key: Where | None = None  # Place of the key of a `key=value` pair


class Number(NamedTuple):
    """A number, or an expression's value."""

    value: float  # The value in SI units
    text: str  # As written, braces included
    where: Where  # The place of its first character
    # The number with a capital M from which the value was computed: M is milli, and perhaps meant as mega
    mega: Token | None = None
    key: Where | None = None  # Place of the key of a `key=value` pair


Value: TypeAlias = Number | Token


class Call(NamedTuple):
    """A word with arguments in brackets: `SIN(0 200 100)` or `SIN (0 200 100)`."""

    text: str  # The word
    args: tuple[Value, ...]
    params: dict[str, Value]  # Values of `key=value` pairs by key in lower case
    where: Where


Word: TypeAlias = Number | Token | Call


class Directive(NamedTuple):
    """A line such as `.tran 10u 50m uic`."""

    name: str  # Name in lower case, with its dot
    args: tuple[Word, ...]
    # Values of `key=value` pairs by key in lower case; `.ic v(area)=1` has the key ``v(area)`` of the flat circuit
    params: dict[str, Value]
    where: Where  # Place of the dot
    text: str  # The line as written, continuations joined


class Statement(NamedTuple):
    """One element of the flat circuit."""

    name: str  # Name as written, with the names of the enclosing calls in front: ``Xfinger.Xgap``
    letter: str  # R, C, V, I, or X for a native device
    # Nodes in lower case, ground as ``0``; a node inside a subcircuit has the names of the enclosing calls in front
    nodes: tuple[str, ...]
    node_names: tuple[str, ...]  # The same nodes as written
    device: str | None  # A native device's name in upper case
    body: tuple[Word, ...]  # The words after the nodes; empty for an X
    params: dict[str, Value]  # Values of `key=value` pairs by key in lower case
    where: Where  # Place of the name


@dataclass
class Deck:
    """A netlist, into which `reader.Reader` and `deck.Flattener` enter what they find."""

    text: str
    path: Path | None  # Path of the file; None for a text
    title: str = ""  # The first line in printable characters (see `errors.printable`)
    statements: list[Statement] = field(default_factory=list)  # In the order of the file, subcircuit calls expanded
    directives: list[Directive] = field(default_factory=list)  # Those with values
    libraries: list[str] = field(default_factory=list)  # Included files of native devices, without folder; not read
    files: list[Path] = field(default_factory=list)  # The other included files, which were read
    unused: dict[str, None] = field(default_factory=dict)  # Ordered set of the directives without effect here
    warnings: list[str] = field(default_factory=list)  # About what is probably not meant, each with its place
    params: dict[str, float] = field(default_factory=dict)  # The deck's own parameters by lower-case name

    @property
    def file(self) -> str:
        """The file's name as shown to the user."""
        return "<netlist>" if self.path is None else str(self.path)

    def named(self, name: str) -> list[Directive]:
        """The directives of that name."""
        return [directive for directive in self.directives if directive.name == name]
