"""Arithmetic of netlists: `{2*d + 1u}` to a float, through a whitelist over `ast`, never `eval`.

Three steps, each of which bounds the next: tokens (SPICE numbers, names, operators) with their columns; a
check of their order and nesting, which finds every syntax error; Python's own parser, whose tree is then
walked through a table of allowed nodes.

The functions mean what they mean in ngspice's `.param`; `log` is the natural one. Where ngspice and
mathematics part (`2^3^2`, a negative base) the expression is refused. `pi`, `e`, `atan2` and `hypot`
are not known to ngspice 39.
"""

from __future__ import annotations

import ast
import difflib
import itertools
import math
import operator
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple, TypeAlias

from fingerspice.base.errors import InputError, Where
from fingerspice.base.units import parse_number, suspicious_mega

MAX_LENGTH = 2000
MAX_DEPTH = 25
MAX_SIGNS = 3
#: Of the words among which the nearest spelling is looked for: how many, and how many characters each.
MAX_KNOWN, MAX_COMPARED = 1000, 60

CONSTANTS: Mapping[str, float] = {"pi": math.pi, "e": math.e}


class _Problem(Exception):
    """What is wrong, and at which character of the expression."""

    def __init__(self, message: str, position: int = 0) -> None:
        self.message = message
        self.position = position


def _power(base: float, exponent: float) -> float:
    if base < 0.0 and not (exponent % 2.0 == 0.0):
        raise _Problem(
            f"({base:g})^({exponent:g}) has a negative base, whose absolute value ngspice takes: "
            "write pow(x, y) or abs(x)^y"
        )
    return math.pow(base, exponent)


def _pwr(base: float, exponent: float) -> float:
    if base < 0.0:
        raise _Problem("pwr of a negative base differs between simulators: write pow(x, y) or pow(abs(x), y)")
    return math.pow(base, exponent)


def _sgn(x: float) -> float:
    return float((x > 0.0) - (x < 0.0))


_AS_IN_MATH = (
    *("sqrt", "exp", "log10", "sin", "cos", "tan", "asin", "acos", "atan", "sinh", "cosh", "tanh"),
    *("asinh", "acosh", "atanh", "floor", "ceil"),
)
#: Function, fewest and most arguments, by name.
FUNCTIONS: Mapping[str, tuple[Callable[..., float], int, int]] = {
    **{name: (getattr(math, name), 1, 1) for name in _AS_IN_MATH},
    "ln": (math.log, 1, 1),
    "log": (math.log, 1, 1),
    "arctan": (math.atan, 1, 1),
    "abs": (abs, 1, 1),
    "sqr": (lambda x: x * x, 1, 1),
    "sgn": (_sgn, 1, 1),
    "int": (math.trunc, 1, 1),
    "nint": (round, 1, 1),
    "min": (min, 2, 99),
    "max": (max, 2, 99),
    "pow": (math.pow, 2, 2),
    "pwr": (_pwr, 2, 2),
    "atan2": (math.atan2, 2, 2),
    "hypot": (math.hypot, 2, 2),
    "ternary_fcn": (lambda condition, yes, no: yes if condition else no, 3, 3),
}

_BINARY: Mapping[type[ast.operator], Callable[[float, float], float]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.Pow: _power,
}
_COMPARE: Mapping[type[ast.cmpop], Callable[[float, float], bool]] = {
    ast.Lt: operator.lt,
    ast.LtE: operator.le,
    ast.Gt: operator.gt,
    ast.GtE: operator.ge,
    ast.Eq: operator.eq,
    ast.NotEq: operator.ne,
}
_COMPARISONS = ("<", "<=", ">", ">=", "==", "!=")
_SPELLING = {"^": "**", "&&": "and", "||": "or"}

#: The place of an expression: of its first character, or of each (an expression may go over several lines).
Place: TypeAlias = Where | Callable[[int], Where]

_LEX = re.compile(
    r"(?P<space>\s+)"
    r"|(?P<number>(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?[\w.]*)"
    r"|(?P<name>[A-Za-z_]\w*)"
    r"|(?P<op>\*\*|&&|\|\||[<>=!]=|[-+*/^<>(),?:])"
)


class _Lexeme(NamedTuple):
    kind: str  # number, name, call or op
    text: str
    position: int


@dataclass(frozen=True, slots=True)
class Expression:
    """A checked expression: what it reads, and its tree."""

    text: str
    names: tuple[str, ...]  # lower case, each once, constants included when used
    positions: Mapping[str, int]  # first use of each name
    mega: str  # its first number written with capital M, or ""
    mega_position: int
    tree: ast.expr
    value: float | None  # when it is one literal

    def evaluate(self, names: Mapping[str, float], where: Place) -> float:
        """Value for the given names (lower case); `where` is the place of its first character."""
        if self.value is not None:
            return self.value
        try:
            return _finite(self, names)
        except _Problem as problem:
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
        When the text is not arithmetic, a name or function is unknown, or the result is not finite.
    """
    lower = {name.lower(): value for name, value in names.items()}
    return compile_expression(text, where).evaluate(lower, where)


def compile_expression(text: str, where: Place) -> Expression:
    """Check an expression once, to be evaluated many times; raises `InputError` when it is not arithmetic."""
    try:
        return _compile(text)
    except _Problem as problem:
        raise InputError(problem.message, _at(where, problem.position)) from None


def nearest(word: str, known: Iterable[str]) -> str:
    """The clause ``; did you mean 'x'?`` for the nearest known spelling, or an empty text.

    Of many known words the first are looked at, and no long ones: comparing takes the product of their lengths.
    """
    if len(word) > MAX_COMPARED:
        return ""
    lower = {name.lower(): name for name in itertools.islice(known, MAX_KNOWN) if len(name) <= MAX_COMPARED}
    close = difflib.get_close_matches(word.lower(), lower, n=1)
    return f"; did you mean '{lower[close[0]]}'?" if close else ""


def _at(where: Place, position: int) -> Where:
    if callable(where):
        return where(position)
    return Where(where.file, where.line, where.column + position)


@lru_cache(maxsize=8192)
def _compile(text: str) -> Expression:
    if len(text) > MAX_LENGTH:
        raise _Problem(f"an expression of {len(text)} characters: at most {MAX_LENGTH} are allowed")
    lexemes = _lex(text)
    _check_order(lexemes, len(text))
    positions: dict[str, int] = {}
    for lexeme in lexemes:
        if lexeme.kind == "name":
            positions.setdefault(lexeme.text.lower(), lexeme.position)
    nothing = _Lexeme("", "", 0)
    mega = next((x for x in lexemes if x.kind == "number" and suspicious_mega(x.text)), nothing)
    if len(lexemes) == 1 and lexemes[0].kind == "number":
        value = _number(lexemes[0])
        return Expression(text, (), {}, mega.text, mega.position, ast.Constant(value), value)
    python = _to_python(lexemes, {name: number for number, name in enumerate(positions)})
    try:
        tree = ast.parse(python, mode="eval").body
    except (SyntaxError, RecursionError, MemoryError) as error:  # the checks above should leave none
        raise _Problem(f"'{text}' is not arithmetic ({type(error).__name__})") from None
    return Expression(text, tuple(positions), positions, mega.text, mega.position, tree, None)


def _lex(text: str) -> list[_Lexeme]:
    """Split into numbers, names, calls and operators."""
    lexemes: list[_Lexeme] = []
    position = 0
    while position < len(text):
        match = _LEX.match(text, position)
        if match is None:
            hint = ": a comparison is ==" if text[position] == "=" else ""
            raise _Problem(f"{text[position]!r} does not belong in arithmetic{hint}", position)
        kind = match.lastgroup or ""
        if kind != "space":
            lexeme = _Lexeme(kind, match.group(), position)
            if lexeme.text == "(" and lexemes and lexemes[-1].kind == "name":
                lexemes[-1] = lexemes[-1]._replace(kind="call")
            lexemes.append(lexeme)
        position = match.end()
    return lexemes


def _check_order(lexemes: list[_Lexeme], end: int) -> None:
    """Refuse every sequence that is not an expression, and every nesting too deep to parse."""
    open_brackets: list[tuple[_Lexeme, bool]] = []  # and whether each holds a function's arguments
    wants_value, previous, signs, questions = True, "", 0, 0
    for index, (kind, text, position) in enumerate(lexemes):
        if wants_value and kind in ("number", "name", "call"):
            wants_value, signs = kind == "call", 0
        elif text == "(" and wants_value:
            open_brackets.append((lexemes[index], previous == "call"))
            if len(open_brackets) > MAX_DEPTH:
                raise _Problem(f"brackets nested deeper than {MAX_DEPTH}", position)
        elif wants_value and text in ("+", "-"):
            signs += 1
            if signs > MAX_SIGNS:
                raise _Problem(f"more than {MAX_SIGNS} signs in a row", position)
        elif wants_value:
            raise _Problem(f"a value is missing before '{text}'", position)
        elif kind != "op" or text == "(":
            raise _Problem(f"an operator is missing before '{text}'", position)
        elif text == ")":
            if not open_brackets:
                raise _Problem("')' without an opening '('", position)
            open_brackets.pop()
        elif text == "," and not (open_brackets and open_brackets[-1][1]):
            raise _Problem("',' outside the arguments of a function", position)
        else:
            wants_value = True
            questions += text == "?"
            if questions > MAX_DEPTH:
                raise _Problem(f"more than {MAX_DEPTH} '?' in one expression", position)
        previous = kind
    if open_brackets:
        raise _Problem("'(' is never closed", open_brackets[-1][0].position)
    if wants_value:
        raise _Problem("a value is missing at the end" if lexemes else "the expression is empty", end)


class _Level:
    """The pieces of Python text inside one pair of brackets since its last comma, with their positions."""

    def __init__(self, opening: str) -> None:
        self.done = opening
        self.pieces: list[tuple[str, int]] = []

    def close(self) -> str:
        """Text of this level so far, where inner brackets are one piece each."""
        _refuse_chains(self.pieces)
        text = _conditional(self.pieces)
        self.pieces = []
        return text


def _to_python(lexemes: list[_Lexeme], order: Mapping[str, int]) -> str:
    """Python text of checked lexemes: numbers in full, names by their number, functions with a prefix.

    So no name is a Python word, and none is changed by the parser, which normalises Unicode.
    """
    levels = [_Level("")]
    for lexeme in lexemes:
        kind, text, position = lexeme
        level = levels[-1]
        if kind == "number":
            level.pieces.append((repr(_number(lexeme)), position))
        elif kind == "call" and text.lower() not in FUNCTIONS:
            hint = nearest(text, FUNCTIONS) or f"; functions are {' '.join(FUNCTIONS)}"
            raise _Problem(f"'{text}' is not a function{hint}", position)
        elif kind == "call":
            level.pieces.append((f"f_{text.lower()}", position))
        elif kind == "name":
            level.pieces.append((f"n{order[text.lower()]}", position))
        elif text == "(":
            levels.append(_Level("("))
        elif text == ")":
            levels.pop()
            levels[-1].pieces.append((f"{level.done}{level.close()})", position))
        elif text == ",":
            level.done += f"{level.close()}, "
        else:
            level.pieces.append((_SPELLING.get(text, text), position))
    return levels[0].close()


def _refuse_chains(pieces: list[tuple[str, int]]) -> None:
    """`a^b^c` groups to the left in ngspice and to the right in mathematics; `a<b<c` means two things."""
    power = comparison = ""
    previous = ""
    for text, position in pieces:
        if (text == "**" and power) or (text in _COMPARISONS and comparison):
            shown = "^" if text == "**" else text
            raise _Problem(f"a second '{shown}' in a row has two readings: use brackets", position)
        if text == "**":
            power = text
        elif text in "+-*/" and previous != "**":
            power = ""
        elif text in _COMPARISONS:
            power, comparison = "", text
        elif text in ("and", "or", "?", ":"):
            power = comparison = ""
        previous = text


def _conditional(pieces: list[tuple[str, int]]) -> str:
    """Join pieces; `a ? b : c` becomes `(b) if (a) else (c)`, binding to the right as in C."""
    waiting: list[int] = []  # indices of `?` without their `:`
    pairs: dict[int, int] = {}
    for index, (text, position) in enumerate(pieces):
        if text == "?":
            waiting.append(index)
        elif text == ":" and not waiting:
            raise _Problem("':' without its '?' (a ? b : c)", position)
        elif text == ":":
            pairs[waiting.pop()] = index
    if waiting:
        raise _Problem("'?' without its ':' (a ? b : c)", pieces[waiting[-1]][1])

    def join(start: int, end: int) -> str:
        question = next((i for i in range(start, end) if i in pairs), None)
        if question is None:
            return " ".join(text for text, _ in pieces[start:end])
        yes, no = join(question + 1, pairs[question]), join(pairs[question] + 1, end)
        return f"(({yes}) if ({join(start, question)}) else ({no}))"

    return join(0, len(pieces))


def _number(lexeme: _Lexeme) -> float:
    try:
        return parse_number(lexeme.text)
    except ValueError as error:
        raise _Problem(str(error), lexeme.position) from None


def _finite(expression: Expression, names: Mapping[str, float]) -> float:
    """Walk the tree, and accept a finite result only."""
    try:
        value = float(_walk(expression.tree, names, expression))
    except RecursionError:  # the limits on nesting should leave none
        raise _Problem(f"'{expression.text}' is nested too deeply") from None
    except ZeroDivisionError:
        raise _Problem(f"'{expression.text}' divides by zero") from None
    except OverflowError:
        raise _Problem(f"'{expression.text}' is too large for a number (1.8e308)") from None
    except ValueError:
        raise _Problem(f"'{expression.text}' leaves the domain of one of its functions") from None
    if not math.isfinite(value):
        raise _Problem(f"'{expression.text}' gives {value:g}, not a finite number")
    return value


def _walk(node: ast.expr, names: Mapping[str, float], expression: Expression) -> float:
    """Value of one node of the whitelist; depth is bounded by the nesting that was let in."""
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
    raise _Problem(f"'{expression.text}' is not arithmetic")


def _walk_chain(node: ast.BinOp, names: Mapping[str, float], expression: Expression) -> float:
    """`a + b - c ...` leans to the left as deep as it is long: go down its spine without recursion."""
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
    position = expression.positions[name]
    written = expression.text[position : position + len(name)]
    raise _Problem(f"parameter '{written}' is not defined{hint}", position)


def _call(node: ast.Call, names: Mapping[str, float], expression: Expression) -> float:
    name = node.func.id[2:] if isinstance(node.func, ast.Name) else ""
    function, fewest, most = FUNCTIONS[name]
    if not fewest <= len(node.args) <= most:
        wanted = f"{fewest}" if fewest == most else f"at least {fewest}"
        plural = "" if wanted == "1" else "s"
        raise _Problem(f"{name} takes {wanted} argument{plural}, {len(node.args)} given: {expression.text}")
    return float(function(*(_walk(argument, names, expression) for argument in node.args)))
