"""Evaluation of a netlist's words: numbers, keywords, and expressions of parameters."""

from __future__ import annotations

import re
from collections import ChainMap
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, TypeAlias

from fingerspice.base.errors import InputError, Where
from fingerspice.base.units import parse_number, suspicious_mega
from fingerspice.netlist.arithmetic import CONSTANTS, RESERVED
from fingerspice.netlist.expressions import Expression, compile_expression
from fingerspice.netlist.lexer import Group, Lexeme, Line

_NUMERIC = re.compile(r"[+-]|\.?[0-9]")
_FILE_NAME = re.compile(r".*[/\\].*|.*\.[A-Za-z]\w*")
_PLAIN_NUMBER = re.compile(r"[+-]?[0-9.]+(?:[eE][+-]?[0-9]+)?[A-Za-z]*")
_OF_TIME = re.compile(r"(?<![A-Za-z])(?:t|time)(?![A-Za-z])", re.IGNORECASE)
_OPERATOR = re.compile(r"[-+*/^]")
_PAIR = re.compile(r"[({]|[)}]|'[^']*'|(?<![\w.])([A-Za-z_]\w*)\s*=(?!=)|[<>!=]=|=")


@dataclass(frozen=True, slots=True)
class Token:
    """A word that is not a number, such as a keyword, a file name or `inf`; `quoted` if it was in double quotes."""

    text: str
    where: Where
    quoted: bool = False


@dataclass(frozen=True, slots=True)
class Number:
    """A number, or an expression's value."""

    value: float  # The value in SI units
    text: str  # As written, braces included
    where: Where  # The place of its first character
    # The number with a capital M from which the value was computed: M is milli, and perhaps meant as mega
    mega: Token | None = None


Value: TypeAlias = Number | Token
#: Kinds of text that are evaluated without braces: nothing, a parameter's name, or also arithmetic. As in ngspice,
#: `R1 a b rho` and `X1 a b sub w=2*rho` are allowed, but not `R1 a b 2*rho`.
Bare: TypeAlias = Literal["nothing", "name", "arithmetic"]
Pairs: TypeAlias = tuple[dict[str, Value], dict[str, Where]]


@dataclass(frozen=True, slots=True)
class Call:
    """A word with arguments in brackets: `SIN(0 200 100)` or `SIN (0 200 100)`."""

    name: str
    args: tuple[Value, ...]
    params: dict[str, Value]
    param_where: dict[str, Where]
    where: Where


@dataclass(frozen=True, slots=True)
class Formula:
    """A parameter's definition, not yet evaluated: its name, the text of its right side, and the positions of both."""

    name: str  # as written
    text: str
    line: Line
    name_position: int
    position: int

    @property
    def where(self) -> Where:
        """Place of the parameter's name."""
        return self.line.where(self.name_position)

    def place(self, offset: int) -> Where:
        """Place of one character of the text."""
        return self.line.where(self.position + offset)


class Scope:
    """The parameters of the deck or of one subcircuit call, which also sees those of its callers.

    As in ngspice, a name that a subcircuit does not define is looked up in its caller, then in that caller's caller,
    and at last in the deck; the place of the subcircuit's definition does not matter.

    Parameters
    ----------
    parent : Scope, optional
        The scope of the caller.
    """

    def __init__(self, parent: Scope | None = None) -> None:
        self.parent = parent
        self.values: dict[str, float] = {}
        self._visible: ChainMap[str, float] = (
            parent._visible.new_child(self.values) if parent else ChainMap(self.values)
        )
        self._formulas: dict[str, Formula] = {}
        self._mega: dict[str, Token] = {}

    def define(self, formula: Formula) -> None:
        """Enter a definition. `solve` evaluates it later, so that the order of definitions does not matter."""
        name = formula.name.lower()
        if name in RESERVED:
            problem = f"parameter '{formula.name}' has the name of a function of ngspice; allowed: another name"
            raise InputError(problem, formula.where)
        if name in self._formulas:
            first = self._formulas[name].where
            raise InputError(f"parameter '{formula.name}' is defined twice, first at {first}", formula.where)
        self._formulas[name] = formula

    def preset(self, name: str, number: Number) -> None:
        """Set a parameter to its value in the call, instead of its default."""
        self.values[name] = number.value
        if number.mega is not None:
            self._mega[name] = number.mega

    def solve(self) -> None:
        """Evaluate every definition, after the definitions of the parameters in it.

        Raises
        ------
        InputError
            If parameters refer to each other in a circle or to an unknown name, or have no finite value.
        """
        compiled: dict[str, Expression] = {}
        for root in self._formulas:
            stack = [root]
            while stack:
                name = stack[-1]
                if name in self.values:
                    stack.pop()
                    continue
                formula = self._formulas[name]
                if name not in compiled:
                    compiled[name] = compile_expression(formula.text, formula.place)
                waiting = [n for n in compiled[name].names if n in self._formulas and n not in self.values]
                if not waiting:
                    self.preset(name, self._evaluate(compiled[name], formula.text, formula.place))
                elif any(n in compiled for n in waiting):
                    raise self._circle(compiled, name)  # a compiled formula without a value is on the stack: a circle
                stack.extend(waiting)

    def _circle(self, compiled: dict[str, Expression], start: str) -> InputError:
        """The error that names the parameters of a circle; following undefined names from `start` leads into it."""
        order = {start: 0}
        name = start
        while True:
            name = next(n for n in compiled[name].positions if n in compiled and n not in self.values)
            if name in order:
                break
            order[name] = len(order)
        path = list(order)[order[name] :]
        shown = [self._formulas[name].name for name in [*path, path[0]]]
        if len(shown) > 12:
            shown[6:-5] = ["..."]
        problem = f"parameters refer to each other in a circle: {' -> '.join(shown)}"
        return InputError(problem, self._formulas[path[0]].where)

    def _find(self, name: str) -> Scope | None:
        scope: Scope | None = self
        while scope is not None and name not in scope.values:
            scope = scope.parent
        return scope

    def _evaluate(self, expression: Expression, written: str, place: Callable[[int], Where]) -> Number:
        """Value of a compiled expression in this scope."""
        mega = None
        if expression.mega:
            mega = Token(expression.mega, place(expression.mega_position))
        for name in expression.names:
            scope = None if mega else self._find(name)
            if scope is not None:
                mega = scope._mega.get(name)
        return Number(expression.evaluate(self._visible, place), written, place(0), mega)

    def number(self, line: Line, lexeme: Lexeme) -> Number:
        """Value of a lexeme that must be arithmetic, with or without braces."""
        inner = lexeme.position + (lexeme.kind != "word")
        if lexeme.kind == "string":
            problem = f"a number is needed, not the text {line.written(lexeme)}"
            raise InputError(problem, line.where(lexeme.position))

        def place(offset: int) -> Where:
            return line.where(inner + offset)

        number = self._evaluate(compile_expression(lexeme.text, place), line.written(lexeme), place)
        return Number(number.value, number.text, line.where(lexeme.position), number.mega)

    def references(self, line: Line, lexeme: Lexeme) -> dict[str, float]:
        """Values in this scope of the parameters in a lexeme; empty if the lexeme is not arithmetic."""
        try:
            names = compile_expression(lexeme.text, lambda _: line.where(lexeme.position)).names
        except InputError:
            return {}
        return {name: self._visible[name] for name in names if name in self._visible}

    def value(self, line: Line, lexeme: Lexeme, bare: Bare = "nothing") -> Value:
        """Number or token of a lexeme.

        Parameters
        ----------
        line : Line
            The line of the lexeme.
        lexeme : Lexeme
            A word, string or expression.
        bare : Bare
            Kind of text that is evaluated without braces.
        """
        where = line.where(lexeme.position)
        if lexeme.kind == "string":
            return Token(lexeme.text, where, quoted=True)
        if lexeme.kind == "expression":
            return self.number(line, lexeme)
        text = lexeme.text
        if bare == "arithmetic" and _PLAIN_NUMBER.fullmatch(text):
            return self.number(line, lexeme)
        if bare != "nothing" and self._is_arithmetic(text):
            if bare == "name" and self._find(text.lower()) is None:
                raise InputError(f"arithmetic goes in braces: {{{text}}}", where)
            return self.number(line, lexeme)
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
        if self._find(text.lower()) is not None:
            return True
        if _OPERATOR.search(text) is None or _PLAIN_NUMBER.fullmatch(text):
            return False
        try:
            names = compile_expression(text, Where("", 1)).names
        except InputError:
            return False
        return all(self._find(name) is not None or name in CONSTANTS for name in names)

    def call(self, line: Line, group: Group, name: Lexeme) -> Call:
        """A call with its arguments evaluated."""
        args = tuple(self.value(line, word) for word in group.words if isinstance(word, Lexeme))
        return Call(name.text, args, *self.pairs(line, group), line.where(name.position))

    def pairs(self, line: Line, group: Group, bare: Bare = "nothing") -> Pairs:
        """Values of `key=value` pairs, and the places of their keys."""
        values = {key: self.value(line, pair.value, bare) for key, pair in group.params.items()}
        return values, {key: line.where(pair.key.position) for key, pair in group.params.items()}

    def words(self, line: Line, words: list[Lexeme | Group], bare: Bare = "nothing") -> tuple[Value | Call, ...]:
        """Values of the words that belong to no pair."""
        return tuple(
            self.value(line, word, bare)
            if isinstance(word, Lexeme)
            else self.call(line, word, word.name or Lexeme("word", "", 0))
            for word in words
        )


def param_formulas(line: Line, start: int) -> list[Formula]:
    """Definitions on a `.param` line; right sides may be arithmetic without braces, and with blanks.

    Parameters
    ----------
    line : Line
        The line.
    start : int
        The position after the directive.

    Raises
    ------
    InputError
        If the line is not a row of `name=value`.
    """
    keys: list[tuple[int, int, str]] = []  # start of the name, start of the value, the name
    depth = 0
    for match in _PAIR.finditer(line.text, start):
        found = match.group()
        depth = max(0, depth + {"(": 1, "{": 1, ")": -1, "}": -1}.get(found, 0))
        if match[1] is not None and depth == 0:
            keys.append((match.start(), match.end(), match[1]))
        elif found == "=" and depth == 0:
            problem = "the name before '=' is missing: write .param name=value (functions are not supported)"
            raise InputError(problem, line.where(match.start()))
    before = line.text[start : keys[0][0] if keys else len(line.text)].strip(" \t,")
    if before or not keys:
        given = f"'{before}'" if before else "nothing"
        raise InputError(f".param is followed by {given}: write .param name=value", line.where(start))
    ends = [*(key[0] for key in keys[1:]), len(line.text)]
    return [_formula(line, key, end) for key, end in zip(keys, ends, strict=True)]


def _formula(line: Line, key: tuple[int, int, str], end: int) -> Formula:
    begin, start, name = key
    raw = line.text[start:end]
    text = raw.strip(" \t,")
    position = start + len(raw) - len(raw.lstrip(" \t,"))
    if not text:
        raise InputError(f"missing value of '{name}'", line.where(begin))
    if text[0] in "{'":
        closing = "}" if text[0] == "{" else "'"
        if len(text) < 2 or text[-1] != closing:
            known = closing in text[1:]
            problem = f"what follows {closing} belongs inside" if known else f"{text[0]} is never closed"
            raise InputError(problem, line.where(position))
        text, position = text[1:-1], position + 1
    return Formula(name, text, line, begin, position)
