"""What the reader makes of a deck's lines: evaluated words, and the statements and directives made of them."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TypeAlias

from fingerspice.base.errors import Where


@dataclass(frozen=True, slots=True)
class Token:
    """A word that is not a number, such as a keyword, a file name or `inf`; `quoted` if it was in double quotes."""

    text: str
    where: Where
    quoted: bool = False
    key: Where | None = field(default=None, compare=False)  # Place of the key of a `key=value` pair


@dataclass(frozen=True, slots=True)
class Number:
    """A number, or an expression's value."""

    value: float  # The value in SI units
    text: str  # As written, braces included
    where: Where  # The place of its first character
    # The number with a capital M from which the value was computed: M is milli, and perhaps meant as mega
    mega: Token | None = None
    key: Where | None = field(default=None, compare=False)  # Place of the key of a `key=value` pair


Value: TypeAlias = Number | Token


@dataclass(frozen=True, slots=True)
class Call:
    """A word with arguments in brackets: `SIN(0 200 100)` or `SIN (0 200 100)`."""

    text: str  # The word
    args: tuple[Value, ...]
    params: dict[str, Value]  # Values of `key=value` pairs by key in lower case
    where: Where


Word: TypeAlias = Number | Token | Call


@dataclass(frozen=True, slots=True)
class Directive:
    """A line such as `.tran 10u 50m uic`."""

    name: str  # Name in lower case, with its dot
    args: tuple[Word, ...]
    # Values of `key=value` pairs by key in lower case; `.ic v(area)=1` has the key ``v(area)``
    params: dict[str, Value]
    where: Where  # Place of the dot
    text: str  # The line as written, continuations joined


@dataclass(frozen=True, slots=True)
class Statement:
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
