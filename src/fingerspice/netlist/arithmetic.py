"""A netlist's arithmetic: its functions, which mean the same as in ngspice's `.param`, and its text in Python.

A check of order and nesting of the lexemes finds every syntax error, so that Python's parser only gets correct text of
limited nesting.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from typing import NamedTuple

from fingerspice.base.units import parse_number, spice_text
from fingerspice.netlist.slips import nearest

CONSTANTS: Mapping[str, float] = {"pi": math.pi, "e": math.e}


class Problem(Exception):
    """An error in an expression, with the position of the character at fault."""

    def __init__(self, message: str, position: int = 0) -> None:
        self.message = message
        self.position = position


def power(base: float, exponent: float) -> float:
    """`base ** exponent`; a negative base needs an even exponent, as ngspice takes the base's absolute value."""
    if base < 0.0 and not (exponent % 2.0 == 0.0):
        raise Problem(
            f"({base:g})^({exponent:g}) has a negative base, whose absolute value ngspice takes: "
            "write pow(x, y) or abs(x)^y"
        )
    return math.pow(base, exponent)


def _pwr(base: float, exponent: float) -> float:
    if base < 0.0:
        raise Problem("pwr of a negative base differs between simulators: write pow(x, y) or pow(abs(x), y)")
    return math.pow(base, exponent)


def _sgn(x: float) -> float:
    return float((x > 0.0) - (x < 0.0))


_AS_IN_MATH = (
    *("sqrt", "exp", "log10", "sin", "cos", "tan", "asin", "acos", "atan", "sinh", "cosh", "tanh"),
    *("asinh", "acosh", "atanh", "floor", "ceil"),
)
#: From a name to the function, and its number of arguments.
FUNCTIONS: Mapping[str, tuple[Callable[..., float], int]] = {
    **{name: (getattr(math, name), 1) for name in _AS_IN_MATH},
    "ln": (math.log, 1),
    "log": (math.log, 1),
    "arctan": (math.atan, 1),
    "abs": (abs, 1),
    "sqr": (lambda x: x * x, 1),
    "sgn": (_sgn, 1),
    "int": (math.trunc, 1),
    "nint": (round, 1),
    "min": (min, 2),
    "max": (max, 2),
    "pow": (math.pow, 2),
    "pwr": (_pwr, 2),
    "atan2": (math.atan2, 2),
    "hypot": (math.hypot, 2),
    "ternary_fcn": (lambda condition, yes, no: yes if condition else no, 3),
}
#: Names of functions in ngspice 39, where a parameter of such a name is not read: `{max + 1}` is 1.
RESERVED = frozenset((*FUNCTIONS, "agauss", "aunif", "gauss", "limit", "unif"))


#: Largest nesting of brackets (and number of `?`), and largest number of signs in a row.
MAX_DEPTH, MAX_SIGNS = 25, 3
_COMPARISONS = ("<", "<=", ">", ">=", "==", "!=")
_SPELLING = {"^": "**", "&&": "and", "||": "or"}
_OPERATORS = (*"+-*/?:", *_SPELLING.values(), *_COMPARISONS)


_LEX = re.compile(
    r"(?P<space>\s+)"
    r"|(?P<number>(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?[\w.]*)"
    r"|(?P<name>[A-Za-z_]\w*)"
    r"|(?P<op>\*\*|&&|\|\||[<>=!]=|[-+*/^<>(),?:])"
)


class Lexeme(NamedTuple):
    """A piece of an expression, and the position of its first character."""

    kind: str  # number, name, call or op
    text: str
    position: int


def lexemes_of(text: str) -> list[Lexeme]:
    """Divide a text into numbers, names, calls and operators."""
    lexemes: list[Lexeme] = []
    position = 0
    while position < len(text):
        match = _LEX.match(text, position)
        if match is None:
            hint = ": a comparison is ==" if text[position] == "=" else ""
            raise Problem(f"{text[position]!r} does not belong in arithmetic{hint}", position)
        kind = match.lastgroup or ""
        if kind != "space":
            lexeme = Lexeme(kind, match.group(), position)
            if lexeme.text == "(" and lexemes and lexemes[-1].kind == "name":
                lexemes[-1] = lexemes[-1]._replace(kind="call")
            lexemes.append(lexeme)
        position = match.end()
    return lexemes


def check_order(lexemes: list[Lexeme], end: int) -> None:
    """Refuse every sequence of lexemes that is not an expression, or is nested too deeply to be parsed."""
    open_brackets: list[tuple[Lexeme, bool]] = []  # each with whether it encloses a function's arguments
    wants_value, previous, signs, questions = True, "", 0, 0
    for index, (kind, text, position) in enumerate(lexemes):
        if wants_value and kind in ("number", "name", "call"):
            wants_value, signs = kind == "call", 0
        elif text == "(" and wants_value:
            open_brackets.append((lexemes[index], previous == "call"))
            if len(open_brackets) > MAX_DEPTH:
                raise Problem(f"brackets nested deeper than {MAX_DEPTH}", position)
        elif wants_value and text in ("+", "-"):
            signs += 1
            if signs > MAX_SIGNS:
                raise Problem(f"more than {MAX_SIGNS} signs in a row", position)
        elif wants_value:
            raise Problem(f"a value is missing before '{text}'", position)
        elif kind != "op" or text == "(":
            raise Problem(f"an operator is missing before '{text}'", position)
        elif text == ")":
            if not open_brackets:
                raise Problem("')' without an opening '('", position)
            open_brackets.pop()
        elif text == "," and not (open_brackets and open_brackets[-1][1]):
            raise Problem("',' outside the arguments of a function", position)
        else:
            wants_value = True
            questions += text == "?"
            if questions > MAX_DEPTH:
                raise Problem(f"more than {MAX_DEPTH} '?' in one expression", position)
        previous = kind
    if open_brackets:
        raise Problem("'(' is never closed", open_brackets[-1][0].position)
    if wants_value:
        raise Problem("a value is missing at the end" if lexemes else "the expression is empty", end)


class _Level:
    """Python text inside one pair of brackets: `done` up to the last comma, then pieces with their positions."""

    def __init__(self, opening: str) -> None:
        self.done = opening
        self.pieces: list[tuple[str, int]] = []

    def close(self) -> str:
        """Text of the pieces, where an inner bracket is one piece; clears the pieces for the next argument."""
        _refuse_chains(self.pieces)
        text = _conditional(self.pieces)
        self.pieces = []
        return text


def to_python(lexemes: list[Lexeme], order: Mapping[str, int]) -> str:
    """Python text of checked lexemes: numbers in full, names as n and their number in `order`, functions as f_name.

    A numbered name cannot be a keyword of Python, and the parser cannot change it by normalising Unicode.
    """
    levels = [_Level("")]
    for lexeme in lexemes:
        kind, text, position = lexeme
        level = levels[-1]
        if kind == "number":
            level.pieces.append((repr(number_of(lexeme)), position))
        elif kind == "call" and text.lower() not in FUNCTIONS:
            hint = nearest(text, FUNCTIONS) or f"; functions are {' '.join(FUNCTIONS)}"
            raise Problem(f"'{text}' is not a function{hint}", position)
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
    """Refuse `a^b^c`, which ngspice groups to the left, mathematics to the right, and `a<b<c`, which is ambiguous.

    Refuse also signs that ngspice moves: after an operator its minus belongs to the next number in the text, wherever
    that stands, so that `2*-(3)+4` is 2 there, and is applied before a power, so that `2*-3^2` is 18.
    """
    power = comparison = ""
    previous = ""
    for index, (text, position) in enumerate(pieces):
        if text == "-" and previous in _OPERATORS:
            value, after = (piece for piece, _ in [*pieces[index + 1 :], ("", 0)][:2])
            if not value[0].isdigit() or (after == "**" and previous != "**"):
                raise Problem("a '-' after an operator has two readings here: use brackets, as in 2*(-x)", position)
        if (text == "**" and power) or (text in _COMPARISONS and comparison):
            shown = "^" if text == "**" else text
            raise Problem(f"a second '{shown}' in a row has two readings: use brackets", position)
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
    """Join pieces, and write `a ? b : c` as `((b) if (a) else (c))`; conditions after `:` group to the right."""
    chunks: list[list[str]] = [[]]
    asked = 0
    for text, position in pieces:
        waits = len(chunks) % 2 == 0  # for the ':' of a '?'
        if text == ":" and not waits:
            raise Problem("':' without its '?' (a ? b : c)", position)
        if text == "?" and waits:  # ngspice 39 takes 5 as 1?0?5:6:7
            raise Problem("a condition between '?' and ':' has two readings: use brackets", position)
        if text in ("?", ":"):
            asked = position
            chunks.append([])
        else:
            chunks[-1].append(text)
    if len(chunks) % 2 == 0:
        raise Problem("'?' without its ':' (a ? b : c)", asked)
    *others, value = (" ".join(chunk) for chunk in chunks)
    for yes, test in zip(others[::-2], others[-2::-2], strict=True):
        value = f"(({yes}) if ({test}) else ({value}))"
    return value


def number_of(lexeme: Lexeme) -> float:
    """Value of a number; refuses mil, which ngspice's arithmetic takes for milli."""
    try:
        value = parse_number(lexeme.text)
    except ValueError as error:
        raise Problem(str(error), lexeme.position) from None
    if lexeme.text.lower().lstrip("0123456789.e+-").startswith("mil"):
        problem = f"'{lexeme.text}' differs between simulators, ngspice 39 reads milli here: write {spice_text(value)}"
        raise Problem(problem, lexeme.position)
    return value
