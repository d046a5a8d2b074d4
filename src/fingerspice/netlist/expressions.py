"""Values of a netlist's words: numbers, keywords, and arithmetic such as `{2*d + 1u}` of parameters.

From loose to tight an expression has `a ? b : c`, `||`, `&&`, comparisons, `+ -`, `* /`, signs, and `^` or `**`.
Functions have the same meaning as in ngspice's `.param`; `log` is the natural logarithm. An expression that ngspice and
mathematics read differently (`2^3^2`, a negative base) is refused. ngspice 39 does not know `pi`, `e`, `atan2` and
`hypot`.
"""

from __future__ import annotations

import math
import operator
import re
from collections import ChainMap
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from functools import lru_cache, partial
from graphlib import CycleError, TopologicalSorter
from types import MappingProxyType
from typing import Any, Literal, NamedTuple, TypeAlias

from fingerspice.base.errors import InputError, Where
from fingerspice.base.units import parse_number, spice_text, suspicious_mega
from fingerspice.netlist.lexer import Assignment, Group, Lexeme, Line, nearest
from fingerspice.waveforms.waveform import refuse

MAX_LENGTH, MAX_DEPTH, MAX_QUESTIONS, MAX_SIGNS = 2000, 25, 25, 3  #: Characters, brackets, `?`, signs in a row.
MAX_CALLS = 1000  #: Of the deck's functions in one expression's function.

CONSTANTS: Mapping[str, float] = {"pi": math.pi, "e": math.e}
#: Function from the values of parameters, whose names are in lower case, to the value of a part of an expression.
Term: TypeAlias = Callable[[Mapping[str, float]], float]


class Problem(Exception):
    """An error in an expression, with the position of the character at fault."""

    def __init__(self, message: str, position: int = 0) -> None:
        self.message, self.position = message, position


def _refuse(wrong: object, message: str, position: int = 0) -> None:
    if wrong:
        raise Problem(message, position)


def _power(base: float, exponent: float) -> float:
    """`base ^ exponent`; a negative base needs an even exponent, as ngspice takes the base's absolute value."""
    problem = f"({base:g})^({exponent:g}) has a negative base, whose absolute value ngspice takes"
    _refuse(base < 0.0 and exponent % 2.0 != 0.0, f"{problem}: write pow(x, y) or abs(x)^y")
    return math.pow(base, exponent)


def _pwr(base: float, exponent: float) -> float:
    _refuse(base < 0.0, "pwr of a negative base differs between simulators: write pow(x, y) or pow(abs(x), y)")
    return math.pow(base, exponent)


_AS_IN_MATH = "sqrt exp log10 sin cos tan asin acos atan sinh cosh tanh asinh acosh atanh floor ceil"
#: From a name to the function, and its number of arguments.
FUNCTIONS: Mapping[str, tuple[Callable[..., float], int]] = {
    **{name: (getattr(math, name), 1) for name in _AS_IN_MATH.split()},
    "ln": (math.log, 1), "log": (math.log, 1), "arctan": (math.atan, 1), "abs": (abs, 1), "sqr": (lambda x: x * x, 1),
    "sgn": (lambda x: (x > 0.0) - (x < 0.0), 1), "int": (math.trunc, 1), "nint": (round, 1), "min": (min, 2),
    "max": (max, 2), "pow": (math.pow, 2), "pwr": (_pwr, 2), "atan2": (math.atan2, 2), "hypot": (math.hypot, 2),
    "ternary_fcn": (lambda condition, yes, no: yes if condition else no, 3),
}  # fmt: skip
#: Names of functions in ngspice 39, where a parameter of such a name is not read: `{max + 1}` is 1.
RESERVED = frozenset((*FUNCTIONS, "agauss", "aunif", "gauss", "limit", "unif"))

_COMPARISONS = {
    "<": operator.lt, "<=": operator.le, ">": operator.gt, ">=": operator.ge, "==": operator.eq, "!=": operator.ne,
}  # fmt: skip
#: Operators between two values, from loose to tight. `||` and `&&` have the function of all their values' truths.
_LEVELS: tuple[Mapping[str, Callable[..., float]], ...] = (
    {"||": any}, {"&&": all}, _COMPARISONS,
    {"+": operator.add, "-": operator.sub}, {"*": operator.mul, "/": operator.truediv},
)  # fmt: skip
_FAILURES: Mapping[type[Exception], str] = {
    ZeroDivisionError: "divides by zero",
    OverflowError: "is too large for a number (1.8e308)",
    ValueError: "leaves the domain of one of its functions",
}
_POWERS = ("^", "**")
#: After these a minus stands before one value of several.
_OPERATORS = frozenset(("?", ":", *_POWERS, *(sign for level in _LEVELS for sign in level)))

_LEX = re.compile(
    r"\s*(?:(?P<number>(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?[\w.]*)"
    r"|(?P<name>[A-Za-z_]\w*)"
    r"|(?P<op>\*\*|&&|\|\||[<>=!]=|[-+*/^<>(),?:])|(?P<other>\S))"
)


class _Piece(NamedTuple):
    kind: str  # number, name, op or end
    text: str
    position: int


class Expression:
    """A compiled expression; `Problem` is raised for a text that is not arithmetic.

    The parser is a recursive descent, only as deep as the brackets are nested: chains such as `a + b - c` are loops.
    """

    def __init__(self, text: str) -> None:
        _refuse(len(text) > MAX_LENGTH, f"an expression of {len(text)} characters: at most {MAX_LENGTH} are allowed")
        self.text = text
        self.names: dict[str, int] = {}  # In lower case, constants included, and the position of each one's first use
        self.calls: list[str] = []  # Functions that are not in `FUNCTIONS`, once for each call
        self.mega: tuple[str, int] | None = None  # The first number written with a capital M, and its position
        self._pieces: list[_Piece] = []
        self._at = questions = 0
        self._brackets: list[tuple[_Piece, bool]] = []  # open, each with whether it encloses a function's arguments
        for match in _LEX.finditer(text.rstrip()):
            kind = match.lastgroup or ""
            found, position = match[kind], match.start(kind)
            if kind == "other":
                hint = ": a comparison is ==" if found == "=" else ""
                raise Problem(f"{found!r} does not belong in arithmetic{hint}", position)
            questions += found == "?"
            _refuse(questions > MAX_QUESTIONS, f"more than {MAX_QUESTIONS} '?' in one expression", position)
            self._pieces.append(_Piece(kind, found, position))
            if kind == "number" and self.mega is None and suspicious_mega(found):
                self.mega = found, position
        self._pieces.append(_Piece("end", "", len(text)))
        self.term = self._condition()
        self._refuse_going_on()
        self._pieces.clear()

    def _take(self, *texts: str) -> _Piece | None:
        """The next piece if it is one of these."""
        piece = self._pieces[self._at]
        if piece.text not in texts:
            return None
        self._at += 1
        return piece

    def _refuse_going_on(self) -> None:
        """Refuse what cannot follow a complete value."""
        kind, text, position = self._pieces[self._at]
        if kind == "end" and self._brackets:
            raise Problem("'(' is never closed", self._brackets[-1][0].position)
        _refuse(text == ")" and not self._brackets, "')' without an opening '('", position)
        _refuse(text == ":", "':' without its '?' (a ? b : c)", position)
        if text == "," and not (self._brackets and self._brackets[-1][1]):
            raise Problem("',' outside the arguments of a function", position)
        _refuse(text not in ("", ")", ","), f"an operator is missing before '{text}'", position)

    def _condition(self) -> Term:
        """`a ? b : c`; conditions after `:` group to the right."""
        test = self._chain(0)
        asked = self._take("?")
        if asked is None:
            return test
        yes = self._chain(0)
        nested = self._take("?")
        if nested is not None:  # ngspice 39 takes 5 as 1?0?5:6:7
            raise Problem("a condition between '?' and ':' has two readings: use brackets", nested.position)
        if self._take(":") is None:
            self._refuse_going_on()
            raise Problem("'?' without its ':' (a ? b : c)", asked.position)
        no = self._condition()
        return lambda names: yes(names) if test(names) != 0.0 else no(names)

    def _chain(self, level: int) -> Term:
        """Values joined by the operators of a level; `a<b<c` is refused, which is ambiguous."""
        if level == len(_LEVELS):
            return self._signed()
        operators = _LEVELS[level]
        first, rest = self._chain(level + 1), list[tuple[Callable[..., float], Term]]()
        while (found := self._take(*operators)) is not None:
            if rest and operators is _COMPARISONS:
                raise Problem(f"a second '{found.text}' in a row has two readings: use brackets", found.position)
            rest.append((operators[found.text], self._chain(level + 1)))
        if not rest:
            return first
        if operators is _LEVELS[0] or operators is _LEVELS[1]:
            decide = rest[0][0]
            terms = [first, *(term for _, term in rest)]
            return lambda names: float(decide(term(names) != 0.0 for term in terms))
        return partial(_folded, first, rest)

    def _signed(self, of_power: bool = False) -> Term:
        """A value or a power behind its signs; in an exponent (`of_power`) no second power follows.

        ngspice moves a minus after an operator to the next number in the text, wherever that stands, so that `2*-(3)+4`
        is 2 there, and applies it before a power, so that `2*-3^2` is 18: such a minus is refused.
        """
        begin, negative = self._at, False
        while (sign := self._take("+", "-")) is not None:
            negative ^= sign.text == "-"
            _refuse(self._at - begin > MAX_SIGNS, f"more than {MAX_SIGNS} signs in a row", sign.position)
        end, value = self._at, self._value()
        power = self._take(*_POWERS)
        if power is not None:
            _refuse(of_power, "a second '^' in a row has two readings: use brackets", power.position)
            value = partial(_folded, value, [(_power, self._signed(of_power=True))])
        for index in range(max(begin, 1), end):
            before, sign, number, after = self._pieces[index - 1 : index + 3]
            moved = number.kind != "number" or (after.text in _POWERS and before.text not in _POWERS)
            problem = "a '-' after an operator has two readings here: use brackets, as in 2*(-x)"
            _refuse(sign.text == "-" and before.text in _OPERATORS and moved, problem, sign.position)
        return (lambda names: -value(names)) if negative else value

    def _value(self) -> Term:
        """A number, a name, or what is in brackets."""
        kind, text, position = piece = self._pieces[self._at]
        if text == "(":
            return self._in_brackets(False)[0]
        _refuse(kind == "op", f"a value is missing before '{text}'", position)
        if kind == "end":
            self._refuse_going_on()
            raise Problem("a value is missing at the end" if self._at else "the expression is empty", position)
        self._at += 1
        name = text.lower()
        if kind == "number":
            try:
                number = parse_number(text)
            except ValueError as error:
                raise Problem(str(error), position) from None
            if name.lstrip("0123456789.e+-").startswith("mil"):
                written = f"write {spice_text(number)}"
                raise Problem(f"'{text}' differs between simulators, ngspice 39 reads milli here: {written}", position)
            return lambda names: number
        if self._pieces[self._at].text != "(":
            self.names.setdefault(name, position)
            return partial(_looked_up, piece)
        if name not in FUNCTIONS:
            self.calls.append(name)
            return partial(_defined, piece, self._in_brackets(True))
        return partial(_called, name, self._in_brackets(True), self.text)

    def _in_brackets(self, of_call: bool) -> list[Term]:
        """The expressions in brackets: one, or a function's arguments."""
        opening = self._pieces[self._at]
        self._brackets.append((opening, of_call))
        _refuse(len(self._brackets) > MAX_DEPTH, f"brackets nested deeper than {MAX_DEPTH}", opening.position)
        terms: list[Term] = []
        while self._pieces[self._at].text != ")" or not terms:
            self._at += 1  # the opening bracket, or a comma
            terms.append(self._condition())
            self._refuse_going_on()
        self._at += 1
        self._brackets.pop()
        return terms


def _folded(first: Term, rest: list[tuple[Callable[..., float], Term]], names: Mapping[str, float]) -> float:
    """Value of a chain, from left to right."""
    value = first(names)
    for function, term in rest:
        value = float(function(value, term(names)))
    return value


def _looked_up(piece: _Piece, names: Mapping[str, float]) -> float:
    name = piece.text.lower()
    if name in names:
        return names[name]
    if name in CONSTANTS:
        return CONSTANTS[name]
    hint = f": the function is written {name}(...)" if name in FUNCTIONS else nearest(name, [*CONSTANTS, *names])
    if name == "time":
        hint = ": a function of time is SIN, PULSE or PWL, or given in Python, sources={'V1': f}"
    raise Problem(f"parameter '{piece.text}' is not defined{hint}", piece.position)


def _called(name: str, arguments: list[Term], text: str, names: Mapping[str, float]) -> float:
    function, wanted = FUNCTIONS[name]
    given = len(arguments)
    if given != wanted:
        more = f"; write {name}({name}(a, b), c), as ngspice 39 leaves some out" if given > 2 == wanted else ""
        raise Problem(f"{name} takes {wanted} argument{'' if wanted == 1 else 's'}, {given} given: {text}{more}")
    return float(function(*(argument(names) for argument in arguments)))


class DeckFunction(NamedTuple):
    """A function of a `.func` line, whose body may have the deck's parameters; scopes have it as ``name(``."""

    name: str  # Lower case, as the arguments
    arguments: tuple[str, ...]
    body: Lexeme


def _defined(piece: _Piece, arguments: list[Term], names: Mapping[str, Any]) -> float:
    name = piece.text.lower()
    function: DeckFunction | None = names.get(f"{name}(")
    if function is None:
        known = [*FUNCTIONS, *(one[:-1] for one in names if one.endswith("("))]
        hint = nearest(piece.text, known) or f"; functions are {' '.join(known)}"
        raise Problem(f"'{piece.text}' is not a function{hint}", piece.position)
    wanted = len(function.arguments)
    told = f"{name} takes {wanted} argument{'' if wanted == 1 else 's'}, {len(arguments)} given"
    _refuse(len(arguments) != wanted, told, piece.position)
    own = {key: argument(names) for key, argument in zip(function.arguments, arguments, strict=True)}
    try:
        return compiled(function.body.text).term(ChainMap(own, names))  # type: ignore[arg-type]
    except Problem as problem:
        raise Problem(f"in {name} of {function.body.where}: {problem.message}", piece.position) from None


def definition_of(line: Line, start: int) -> DeckFunction:
    """The function of a `.func` line, ``name(x, y) {x*y}``, whose body may stand without braces or behind a sign."""
    match = _FUNCTION.fullmatch(line.text, start)
    if match is None:
        raise InputError("write .func name(x, y) {x*y}", line.where(start))
    name, arguments = match[1].lower(), tuple(one.strip().lower() for one in match[2].split(","))
    refuse(name in RESERVED, f"function '{match[1]}' is built in; allowed: another name", line.where(match.start(1)))
    wrong = [one for one in arguments if not one.isidentifier() or arguments.count(one) > 1]
    refuse(
        wrong, f"an argument of {match[1]} is {', '.join(wrong[:1])!r}; allowed: names, each once", line.where(start)
    )
    begin, end = match.span(3)
    if line.text[begin : begin + 1] + line.text[end - 1 : end] in ("{}", "''"):
        begin, end = begin + 1, end - 1
    return DeckFunction(name, arguments, Lexeme("expression", line.text[begin:end], begin, line))


def in_scope(functions: Mapping[str, DeckFunction]) -> dict[str, DeckFunction]:
    """Functions by their names in a scope, refused where one calls itself."""
    calls = {name: [one for one in _expression(f.body).calls if one in functions] for name, f in functions.items()}
    size: dict[str, tuple[int, int]] = {}  # Calls that one makes in all, and their depth
    try:
        for name in TopologicalSorter(calls).static_order():
            below = [size[one] for one in calls[name]]
            count, depth = size[name] = 1 + sum(n for n, _ in below), 1 + max((d for _, d in below), default=0)
            most = f"a call of {name} makes {count:,}, {depth} deep; allowed: {MAX_CALLS:,}, {MAX_DEPTH} deep"
            refuse(count > MAX_CALLS or depth > MAX_DEPTH, most, functions[name].body)
    except CycleError as error:
        path, place = " -> ".join(error.args[1][::-1]), functions[error.args[1][0]].body.where
        raise InputError(f"functions refer to each other in a circle: {path}", place) from None
    return {f"{name}(": one for name, one in functions.items()}


def _expression(body: Lexeme) -> Expression:
    try:
        return compiled(body.text)
    except Problem as problem:
        raise InputError(problem.message, body.place(problem.position)) from None


compiled = lru_cache(maxsize=8192)(Expression)  #: The expression of a text; raises `Problem` if it is not arithmetic.


def evaluated(text: str, names: Mapping[str, float], place: Callable[[int], Where]) -> float:
    """Finite value of an expression without its braces, given those of names; `place` is that of a character."""
    try:
        value = float(compiled(text).term(names))
    except Problem as problem:
        raise InputError(problem.message, place(problem.position)) from None
    except (ZeroDivisionError, OverflowError, ValueError) as error:
        raise InputError(f"'{text}' {_FAILURES[type(error)]}", place(0)) from None
    if not math.isfinite(value):
        raise InputError(f"'{text}' gives {value:g}, not a finite number", place(0))
    return value


_NUMERIC = re.compile(r"[+-]|\.?[0-9]")
_FILE_NAME = re.compile(r".*[/\\].*|.*\.[A-Za-z]\w*")
_PLAIN_NUMBER = re.compile(r"[+-]?[0-9.]+(?:[eE][+-]?[0-9]+)?[A-Za-z]*")
_OF_TIME = re.compile(r"(?<![A-Za-z])(?:t|time)(?![A-Za-z])", re.IGNORECASE)
_OPERATOR = re.compile(r"[-+*/^]")
_FUNCTION = re.compile(r"\s*([A-Za-z_]\w*)\s*\(([^()]*)\)\s*=?\s*(\S.*?)\s*")
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
    mega: Token | None = None  # The number with a capital M, milli and perhaps meant as mega, that the value is from
    key: Where | None = None  # Place of the key of a `key=value` pair


Value: TypeAlias = Number | Token


class Call(NamedTuple):
    """A word with arguments in brackets, `SIN(0 200 100)` or `SIN (0 200 100)`; or a directive, `.tran 1u 1m`."""

    text: str  # The word; the directive's name in lower case, with its dot
    args: tuple[Word, ...]  # Of a word only numbers and tokens
    params: dict[str, Value]  # By key in lower case; `.ic v(area)=1` has the key ``v(area)`` of the flat circuit
    where: Where
    line: str = ""  # That of a directive as written, continuations joined


Word: TypeAlias = Number | Token | Call


def number(word: Word, what: str, allowed: str = "a number or {expression}") -> Number:
    """The word, which must be a number; `what` names it in the message."""
    if not isinstance(word, Number):
        raise InputError(f"{what} is {word.text!r}; allowed: {allowed}", word.where)
    return word


class Scope:
    """The parameters of the deck or of one subcircuit call, which also sees those of its callers (`parent`).

    As in ngspice, a name that a subcircuit does not define is looked up in its caller, then in that caller's caller,
    and at last in the deck; the place of the subcircuit's definition does not matter.
    """

    def __init__(
        self, definitions: Iterable[Assignment], parent: Scope | None = None,
        functions: Mapping[str, DeckFunction] = MappingProxyType({}),
    ) -> None:  # fmt: skip
        self.values: dict[str, float] = {}
        above: Any = parent._visible.maps if parent else (functions,)
        self._visible: ChainMap[str, Any] = ChainMap(self.values, *above)
        self._mega: ChainMap[str, Token | None] = ChainMap({}, *(parent._mega.maps if parent else ()))  # As in `Number`
        self._definitions: dict[str, Assignment] = {}
        for definition in definitions:
            key, name = definition.key, definition.key.text.lower()
            problem = f"parameter '{key.text}' has the name of a function of ngspice; allowed: another name"
            refuse(name in RESERVED, problem, key)
            first = self._definitions.setdefault(name, definition)
            if first is not definition:
                raise InputError(f"parameter '{key.text}' is defined twice, first at {first.key.where}", key.where)

    def preset(self, name: str, number: Number) -> None:
        """Set a parameter to its value in the call, instead of its default."""
        self.values[name], self._mega[name] = number.value, number.mega

    def solve(self) -> dict[str, float]:
        """The parameters' values; each definition, in any order, is evaluated after those of the parameters in it."""
        texts = {name: one.value for name, one in self._definitions.items() if name not in self.values}
        # What is no arithmetic has no names, and is refused when its turn comes.
        graph = {name: self._needs(text.text) for name, text in texts.items()}
        try:
            for name in filter(texts.__contains__, TopologicalSorter(graph).static_order()):
                self.preset(name, self.number(texts[name]))
        except CycleError as error:
            # From a parameter to those in its definition, which graphlib gives backwards.
            circle = error.args[1][:0:-1]
            path = [circle[-1], *circle]
            shown = [self._definitions[name].key.text for name in path]
            if len(shown) > 12:
                shown[6:-5] = ["..."]
            problem = f"parameters refer to each other in a circle: {' -> '.join(shown)}"
            raise InputError(problem, self._definitions[path[0]].key.where) from None
        return self.values

    def _needs(self, text: str) -> set[str]:
        """The names in an expression and in the bodies of the functions that it calls."""
        with suppress(Problem):
            found = compiled(text)
            called = (self._visible.get(f"{name}(") for name in found.calls)
            bodies = (
                self._needs(one.body.text) - set(one.arguments) for one in called if isinstance(one, DeckFunction)
            )
            return set(found.names).union(*bodies)
        return set()

    def number(self, lexeme: Lexeme) -> Number:
        """Value of a lexeme that must be arithmetic, with or without braces."""
        if lexeme.kind == "string":
            raise InputError(f"a number is needed, not the text {lexeme.written}", lexeme.where)
        value, expression = evaluated(lexeme.text, self._visible, lexeme.place), compiled(lexeme.text)
        mega = Token(expression.mega[0], lexeme.place(expression.mega[1])) if expression.mega else None
        mega = mega or next(filter(None, map(self._mega.get, expression.names)), None)
        return Number(value, lexeme.written, lexeme.where, mega)

    def references(self, lexeme: Lexeme) -> dict[str, float]:
        """Values in this scope of the parameters in a lexeme; empty if the lexeme is not arithmetic."""
        return {name: self._visible[name] for name in _names_in(lexeme.text) or () if name in self._visible}

    def value(self, lexeme: Lexeme, bare: Bare = "nothing") -> Value:
        """Number or token of a word, string or expression; `bare` is what is evaluated without braces."""
        text, where, known = lexeme.text, lexeme.where, lexeme.text.lower() in self._visible
        if lexeme.kind == "string":
            return Token(text, where)
        plain, signs = _PLAIN_NUMBER.fullmatch(text), _OPERATOR.search(text)
        if lexeme.kind == "expression" or (bare == "arithmetic" and plain):
            return self.number(lexeme)
        if bare != "nothing" and not known and signs and not plain:
            names = _names_in(text)  # Arithmetic of numbers and known parameters only
            if names is not None and all(name in self._visible or name in CONSTANTS for name in names):
                refuse(bare == "name", f"arithmetic goes in braces: {{{text}}}", where)
                known = True
        if bare != "nothing" and known:
            return self.number(lexeme)
        if _NUMERIC.match(text) is None:
            return Token(text, where)
        try:
            return Number(parse_number(text), text, where, Token(text, where) if suspicious_mega(text) else None)
        except ValueError as error:
            if _FILE_NAME.fullmatch(text):
                return Token(text, where)
            hint = f"; arithmetic goes in braces: {{{text}}}" if signs else ""
            if _OF_TIME.search(text):
                hint = "; a function of time is SIN(VO VA FREQ), PULSE or PWL, or given in Python, sources={'V1': f}"
            raise InputError(f"{error}{hint}", where) from None

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
                args = tuple(self.value(arg, bare) for arg in word.words if isinstance(arg, Lexeme))
                out.append(Call(word.name.text, args, self.pairs(word, bare), word.name.where))
        return tuple(out)


def _names_in(text: str) -> Mapping[str, int] | None:
    """The names in an expression; None if it is not arithmetic."""
    with suppress(Problem):
        return compiled(text).names
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
            problem = "the name before '=' is missing: write .param name=value, and functions as .func name(x) {2*x}"
            raise InputError(problem, line.where(match.start()))
    ends = [*(key.position for key, _ in keys), len(line.text)]
    before = line.text[start : ends[0]].strip(" \t,")
    given = f"'{before}'" if before else "nothing"
    refuse(before or not keys, f".param is followed by {given}: write .param name=value", line.where(start))
    out = []
    for (key, begin), end in zip(keys, ends[1:], strict=True):
        raw = line.text[begin:end]
        text = raw.strip(" \t,")
        refuse(not text, f"missing value of '{key.text}'", key)
        value = Lexeme("word", text, begin + len(raw) - len(raw.lstrip(" \t,")), line)
        if text[0] in "{'":
            closing = "}" if text[0] == "{" else "'"
            problem = f"what follows {closing} belongs inside" if closing in text[1:] else f"{text[0]} is never closed"
            refuse(len(text) < 2 or text[-1] != closing, problem, value)
            value = value._replace(kind="expression", text=text[1:-1])
        out.append(Assignment(key, value))
    return out
