"""Evaluation of netlist arithmetic such as `{2*d + 1u}`, by a whitelist of `ast` nodes, never by `eval`.

There are three steps. `arithmetic` divides the text into SPICE numbers, names and operators, and checks their order and
nesting, which finds every syntax error. Python's own parser then builds a tree. This module evaluates the tree, which
may contain only the kinds of nodes in the tables below.

Functions have the same meaning as in ngspice's `.param`; `log` is the natural logarithm. An expression that ngspice and
mathematics read differently (`2^3^2`, a negative base) is refused. ngspice 39 does not know `pi`, `e`, `atan2` and
`hypot`.
"""

from __future__ import annotations

import ast
import math
import operator
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import TypeAlias

from fingerspice.base.errors import InputError, Where
from fingerspice.base.units import suspicious_mega
from fingerspice.netlist.arithmetic import (
    CONSTANTS,
    FUNCTIONS,
    Lexeme,
    Problem,
    check_order,
    lexemes_of,
    number_of,
    power,
    to_python,
)
from fingerspice.netlist.slips import nearest

#: Largest number of characters of an expression.
MAX_LENGTH = 2000

_BINARY: Mapping[type[ast.operator], Callable[[float, float], float]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.Pow: power,
}
_COMPARE: Mapping[type[ast.cmpop], Callable[[float, float], bool]] = {
    ast.Lt: operator.lt,
    ast.LtE: operator.le,
    ast.Gt: operator.gt,
    ast.GtE: operator.ge,
    ast.Eq: operator.eq,
    ast.NotEq: operator.ne,
}
#: The place of an expression in its file: the place of its first character or, for an expression over several lines, a
#: function from a character's position to its place.
Place: TypeAlias = Where | Callable[[int], Where]


@dataclass(frozen=True, slots=True)
class Expression:
    """A checked expression."""

    text: str
    names: tuple[str, ...]  # The names in the expression, constants included, in lower case, each once
    positions: Mapping[str, int]  # Position of the first use of each name
    # mega, mega_position: The first number written with a capital M, or an empty text, and its position
    mega: str
    mega_position: int
    tree: ast.expr
    value: float | None  # Value of an expression that is a single number; None for all others

    def evaluate(self, names: Mapping[str, float], where: Place) -> float:
        """Value of the expression, given the values of names (lower case); `where` is its place, for messages."""
        if self.value is not None:
            return self.value
        try:
            return _finite(self, names)
        except Problem as problem:
            raise InputError(problem.message, _at(where, problem.position)) from None


def evaluate(text: str, names: Mapping[str, float], where: Where) -> float:
    """Value of an expression without its braces or quotes.

    Parameters
    ----------
    text : str
        Arithmetic with + - * / ** ^, comparisons, && ||, `a ? b : c`, SPICE numbers, functions and names.
    names : Mapping[str, float]
        Values of the names; matched without case.
    where : Where
        The place of the first character, for messages.

    Raises
    ------
    InputError
        If the text is not arithmetic, a name or function is unknown, or the result is not finite.
    """
    lower = {name.lower(): value for name, value in names.items()}
    return compile_expression(text, where).evaluate(lower, where)


def compile_expression(text: str, where: Place) -> Expression:
    """Check an expression, so that it can be evaluated many times.

    Raises
    ------
    InputError
        If the text is not arithmetic.
    """
    try:
        return _compile(text)
    except Problem as problem:
        raise InputError(problem.message, _at(where, problem.position)) from None


def _at(where: Place, position: int) -> Where:
    if callable(where):
        return where(position)
    return Where(where.file, where.line, where.column + position)


@lru_cache(maxsize=8192)
def _compile(text: str) -> Expression:
    if len(text) > MAX_LENGTH:
        raise Problem(f"an expression of {len(text)} characters: at most {MAX_LENGTH} are allowed")
    lexemes = lexemes_of(text)
    check_order(lexemes, len(text))
    positions: dict[str, int] = {}
    for lexeme in lexemes:
        if lexeme.kind == "name":
            positions.setdefault(lexeme.text.lower(), lexeme.position)
    nothing = Lexeme("", "", 0)
    mega = next((x for x in lexemes if x.kind == "number" and suspicious_mega(x.text)), nothing)
    if len(lexemes) == 1 and lexemes[0].kind == "number":
        value = number_of(lexemes[0])
        return Expression(text, (), {}, mega.text, mega.position, ast.Constant(value), value)
    python = to_python(lexemes, {name: number for number, name in enumerate(positions)})
    try:
        tree = ast.parse(python, mode="eval").body
    except (SyntaxError, RecursionError, MemoryError) as error:  # never expected, as the checks above find all errors
        raise Problem(f"'{text}' is not arithmetic ({type(error).__name__})") from None
    return Expression(text, tuple(positions), positions, mega.text, mega.position, tree, None)


def _finite(expression: Expression, names: Mapping[str, float]) -> float:
    """Value of an expression; refuses a value that is not a finite number."""
    try:
        value = float(_walk(expression.tree, names, expression))
    except RecursionError:  # never expected, because of the limits of nesting
        raise Problem(f"'{expression.text}' is nested too deeply") from None
    except ZeroDivisionError:
        raise Problem(f"'{expression.text}' divides by zero") from None
    except OverflowError:
        raise Problem(f"'{expression.text}' is too large for a number (1.8e308)") from None
    except ValueError:
        raise Problem(f"'{expression.text}' leaves the domain of one of its functions") from None
    if not math.isfinite(value):
        raise Problem(f"'{expression.text}' gives {value:g}, not a finite number")
    return value


def _walk(node: ast.expr, names: Mapping[str, float], expression: Expression) -> float:
    """Value of one node of an allowed kind; the recursion is only as deep as the nesting of brackets."""
    if isinstance(node, ast.Constant) and type(node.value) is float:
        return node.value
    if isinstance(node, ast.Name):
        return _look_up(expression.names[int(node.id[1:])], names, expression)
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub | ast.UAdd):
        value = _walk(node.operand, names, expression)
        return -value if isinstance(node.op, ast.USub) else value
    if isinstance(node, ast.BinOp) and type(node.op) in _BINARY:
        return _walk_chain(node, names, expression)
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
        return _call(node, names, expression)
    if isinstance(node, ast.Compare) and len(node.ops) == 1:
        left, right = _walk(node.left, names, expression), _walk(node.comparators[0], names, expression)
        return float(_COMPARE[type(node.ops[0])](left, right))
    if isinstance(node, ast.BoolOp):
        truths = (_walk(value, names, expression) != 0.0 for value in node.values)
        return float(all(truths) if isinstance(node.op, ast.And) else any(truths))
    if isinstance(node, ast.IfExp):
        chosen = node.body if _walk(node.test, names, expression) != 0.0 else node.orelse
        return _walk(chosen, names, expression)
    raise Problem(f"'{expression.text}' is not arithmetic")


def _walk_chain(node: ast.BinOp, names: Mapping[str, float], expression: Expression) -> float:
    """Value of a chain `a + b - c ...` by a loop, because its tree is as deep as the chain is long."""
    spine: list[ast.BinOp] = []
    left: ast.expr = node
    while isinstance(left, ast.BinOp):
        spine.append(left)
        left = left.left
    value = _walk(left, names, expression)
    for step in reversed(spine):
        value = _BINARY[type(step.op)](value, _walk(step.right, names, expression))
    return value


def _look_up(name: str, names: Mapping[str, float], expression: Expression) -> float:
    if name in names:
        return names[name]
    if name in CONSTANTS:
        return CONSTANTS[name]
    hint = f": the function is written {name}(...)" if name in FUNCTIONS else nearest(name, [*CONSTANTS, *names])
    if name == "time":
        hint = ": a function of time is SIN, PULSE or PWL, or given in Python, sources={'V1': f}"
    position = expression.positions[name]
    written = expression.text[position : position + len(name)]
    raise Problem(f"parameter '{written}' is not defined{hint}", position)


def _call(node: ast.Call, names: Mapping[str, float], expression: Expression) -> float:
    name = node.func.id[2:] if isinstance(node.func, ast.Name) else ""
    function, wanted = FUNCTIONS[name]
    given = len(node.args)
    if given != wanted:
        more = f"; write {name}({name}(a, b), c), as ngspice 39 leaves some out" if given > 2 == wanted else ""
        plural = "" if wanted == 1 else "s"
        raise Problem(f"{name} takes {wanted} argument{plural}, {given} given: {expression.text}{more}")
    return float(function(*(_walk(argument, names, expression) for argument in node.args)))
