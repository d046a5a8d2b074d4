"""A netlist's words, and their evaluation: numbers, keywords, and expressions of parameters."""

from __future__ import annotations

import re
from collections import ChainMap
from collections.abc import Iterable, Mapping
from typing import Literal, NamedTuple, TypeAlias

from fingerspice.base.errors import InputError, Where
from fingerspice.base.units import parse_number, suspicious_mega
from fingerspice.netlist.expressions import CONSTANTS, RESERVED, Expression, Problem, compile_expression, compiled
from fingerspice.netlist.lexer import Assignment, Group, Lexeme, Line

_NUMERIC = re.compile(r"[+-]|\.?[0-9]")
_FILE_NAME = re.compile(r".*[/\\].*|.*\.[A-Za-z]\w*")
_PLAIN_NUMBER = re.compile(r"[+-]?[0-9.]+(?:[eE][+-]?[0-9]+)?[A-Za-z]*")
_OF_TIME = re.compile(r"(?<![A-Za-z])(?:t|time)(?![A-Za-z])", re.IGNORECASE)
_OPERATOR = re.compile(r"[-+*/^]")
_PAIR = re.compile(r"[({]|[)}]|'[^']*'|(?<![\w.])([A-Za-z_]\w*)\s*=(?!=)|[<>!=]=|=")

#: Kinds of text that are evaluated without braces: nothing, a parameter's name, or also arithmetic. As in ngspice,
#: `R1 a b rho` and `X1 a b sub w=2*rho` are allowed, but not `R1 a b 2*rho`.
Bare: TypeAlias = Literal["nothing", "name", "arithmetic"]


class Token(NamedTuple):
    """A word that is not a number, such as a keyword, a file name, `inf`, or what was in double quotes."""

    text: str
    where: Where
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
    device: str  # Entry of `DEVICES`
    # Nodes in lower case, ground as ``0``; a node inside a subcircuit has the names of the enclosing calls in front
    nodes: tuple[str, ...]
    node_names: tuple[str, ...]  # The same nodes as written
    body: tuple[Word, ...]  # The words after the nodes; empty for an X
    params: dict[str, Value]  # Values of `key=value` pairs by key in lower case
    where: Where  # Place of the name


class Scope:
    """The parameters of the deck or of one subcircuit call, which also sees those of its callers (`parent`).

    As in ngspice, a name that a subcircuit does not define is looked up in its caller, then in that caller's caller,
    and at last in the deck; the place of the subcircuit's definition does not matter.
    """

    def __init__(self, definitions: Iterable[Assignment], parent: Scope | None = None) -> None:
        self.values: dict[str, float] = {}
        self._visible: ChainMap[str, float] = ChainMap(self.values, *(parent._visible.maps if parent else ()))
        # As in `Number`
        self._mega: ChainMap[str, Token | None] = ChainMap({}, *(parent._mega.maps if parent else ()))
        self._definitions: dict[str, Assignment] = {}
        for definition in definitions:
            key, name = definition.key, definition.key.text.lower()
            if name in RESERVED:
                problem = f"parameter '{key.text}' has the name of a function of ngspice; allowed: another name"
                raise InputError(problem, key.where)
            first = self._definitions.setdefault(name, definition)
            if first is not definition:
                raise InputError(f"parameter '{key.text}' is defined twice, first at {first.key.where}", key.where)

    def preset(self, name: str, number: Number) -> None:
        """Set a parameter to its value in the call, instead of its default."""
        self.values[name] = number.value
        self._mega[name] = number.mega

    def solve(self) -> dict[str, float]:
        """The parameters' values; each definition, in any order, is evaluated after those of the parameters in it."""
        known: dict[str, Expression] = {}
        for root in self._definitions:
            stack = [root]
            while stack:
                name = stack[-1]
                if name in self.values:
                    stack.pop()
                    continue
                text = self._definitions[name].value
                if name not in known:
                    known[name] = compile_expression(text.text, text.place)
                waiting = [n for n in known[name].names if n in self._definitions and n not in self.values]
                if not waiting:
                    self.preset(name, self.number(text))
                elif any(n in known for n in waiting):
                    raise self._circle(known, name)  # a compiled definition without a value is on the stack: a circle
                stack.extend(waiting)
        return self.values

    def _circle(self, known: dict[str, Expression], start: str) -> InputError:
        """The error that names the parameters of a circle; following undefined names from `start` leads into it."""
        order, name = dict[str, None](), start
        while name not in order:
            order[name] = None
            name = next(n for n in known[name].names if n in known and n not in self.values)
        path = list(order)
        path = [*path[path.index(name) :], name]
        shown = [self._definitions[name].key.text for name in path]
        if len(shown) > 12:
            shown[6:-5] = ["..."]
        problem = f"parameters refer to each other in a circle: {' -> '.join(shown)}"
        return InputError(problem, self._definitions[path[0]].key.where)

    def number(self, lexeme: Lexeme) -> Number:
        """Value of a lexeme that must be arithmetic, with or without braces."""
        if lexeme.kind == "string":
            raise InputError(f"a number is needed, not the text {lexeme.written}", lexeme.where)
        expression = compile_expression(lexeme.text, lexeme.place)
        mega = Token(expression.mega[0], lexeme.place(expression.mega[1])) if expression.mega else None
        for name in expression.names:
            mega = mega or self._mega.get(name)
        return Number(expression.evaluate(self._visible, lexeme.place), lexeme.written, lexeme.where, mega)

    def references(self, lexeme: Lexeme) -> dict[str, float]:
        """Values in this scope of the parameters in a lexeme; empty if the lexeme is not arithmetic."""
        return {name: self._visible[name] for name in _names_in(lexeme.text) or () if name in self._visible}

    def value(self, lexeme: Lexeme, bare: Bare = "nothing") -> Value:
        """Number or token of a word, string or expression; `bare` is what is evaluated without braces."""
        text, where = lexeme.text, lexeme.where
        if lexeme.kind == "string":
            return Token(text, where)
        if lexeme.kind == "expression" or (bare == "arithmetic" and _PLAIN_NUMBER.fullmatch(text)):
            return self.number(lexeme)
        if bare != "nothing" and self._is_arithmetic(text):
            if bare == "name" and text.lower() not in self._visible:
                raise InputError(f"arithmetic goes in braces: {{{text}}}", where)
            return self.number(lexeme)
        if _NUMERIC.match(text) is None:
            return Token(text, where)
        try:
            mega = Token(text, where) if suspicious_mega(text) else None
            return Number(parse_number(text), text, where, mega)
        except ValueError as error:
            if _FILE_NAME.fullmatch(text):
                return Token(text, where)
            hint = f"; arithmetic goes in braces: {{{text}}}" if _OPERATOR.search(text) else ""
            if _OF_TIME.search(text):
                hint = "; a function of time is SIN(VO VA FREQ), PULSE or PWL, or given in Python, sources={'V1': f}"
            raise InputError(f"{error}{hint}", where) from None

    def _is_arithmetic(self, text: str) -> bool:
        """Whether a word without braces is arithmetic of numbers and known parameters only."""
        if text.lower() in self._visible:
            return True
        if _OPERATOR.search(text) is None or _PLAIN_NUMBER.fullmatch(text):
            return False
        names = _names_in(text)
        return names is not None and all(name in self._visible or name in CONSTANTS for name in names)

    def pairs(self, group: Group, bare: Bare = "nothing") -> dict[str, Value]:
        """Values of `key=value` pairs, each with the place of its key."""
        return {name: self.value(value, bare)._replace(key=key.where) for name, (key, value) in group.params.items()}

    def words(self, words: list[Lexeme | Group], bare: Bare = "nothing") -> tuple[Word, ...]:
        """Values of the words that belong to no pair; a group is a call, which has no calls in it."""
        out: list[Word] = []
        for word in words:
            if isinstance(word, Lexeme):
                out.append(self.value(word, bare))
            elif word.name is not None:
                args = tuple(self.value(arg) for arg in word.words if isinstance(arg, Lexeme))
                out.append(Call(word.name.text, args, self.pairs(word), word.name.where))
        return tuple(out)


def _names_in(text: str) -> Mapping[str, int] | None:
    """The names in an expression; None if it is not arithmetic."""
    try:
        return compiled(text).names
    except Problem:
        return None


def definitions(line: Line, start: int) -> list[Assignment]:
    """Definitions on a `.param` line; right sides may be arithmetic without braces, and with blanks."""
    keys: list[tuple[Lexeme, int]] = []  # the name, and the position after its `=`
    depth = 0
    for match in _PAIR.finditer(line.text, start):
        found = match.group()
        depth = max(0, depth + {"(": 1, "{": 1, ")": -1, "}": -1}.get(found, 0))
        if match[1] is not None and depth == 0:
            keys.append((Lexeme("word", match[1], match.start(), line), match.end()))
        elif found == "=" and depth == 0:
            problem = "the name before '=' is missing: write .param name=value (functions are not supported)"
            raise InputError(problem, line.where(match.start()))
    ends = [*(key.position for key, _ in keys), len(line.text)]
    before = line.text[start : ends[0]].strip(" \t,")
    if before or not keys:
        given = f"'{before}'" if before else "nothing"
        raise InputError(f".param is followed by {given}: write .param name=value", line.where(start))
    out = []
    for (key, begin), end in zip(keys, ends[1:], strict=True):
        raw = line.text[begin:end]
        text = raw.strip(" \t,")
        if not text:
            raise InputError(f"missing value of '{key.text}'", key.where)
        value = Lexeme("word", text, begin + len(raw) - len(raw.lstrip(" \t,")), line)
        if text[0] in "{'":
            closing = "}" if text[0] == "{" else "'"
            if len(text) < 2 or text[-1] != closing:
                known = closing in text[1:]
                problem = f"what follows {closing} belongs inside" if known else f"{text[0]} is never closed"
                raise InputError(problem, value.where)
            value = value._replace(kind="expression", text=text[1:-1])
        out.append(Assignment(key, value))
    return out
