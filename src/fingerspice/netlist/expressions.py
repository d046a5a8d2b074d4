"""Arithmetic of netlists such as `{2*d + 1u}`: compiled once, and evaluated with the values of parameters.

Common slips, and directives of other simulators, have a sentence each about what to write instead.

From loose to tight an expression has `a ? b : c`, `||`, `&&`, comparisons, `+ -`, `* /`, signs, and `^` or `**`.
Functions have the same meaning as in ngspice's `.param`; `log` is the natural logarithm. An expression that ngspice and
mathematics read differently (`2^3^2`, a negative base) is refused. ngspice 39 does not know `pi`, `e`, `atan2` and
`hypot`.
"""

from __future__ import annotations

import difflib
import itertools
import math
import operator
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import lru_cache, partial
from typing import NamedTuple, TypeAlias

from fingerspice.base.errors import InputError, Where
from fingerspice.base.units import parse_number, spice_text, suspicious_mega

#: Directives that only other simulators know, each with the alternative here.
ELSEWHERE = {
    ".step": "give one value a run by --set PATH=VALUE, or loop over circuit.replace({path: value}) in Python",
    ".four": "mean, peaks and amplitude are in the summary of a run, and any harmonic in the data that it writes",
    ".temp": "nothing depends on temperature; give the values at the one that is meant",
    ".model": "there are no models; write the device's parameters on its own line",
    ".global": "give the node to each .subckt as one of its nodes",
    ".func": "write the expression where it is used, {a*b}, or into .param",
    ".op": "a .tran without uic starts from the operating point, fs.simulate(circuit, start='dc') too",
    ".dc": "run once per value by --set, such as --set Vdrive.level=5",
    ".noise": "there is no noise analysis",
    ".wave": "run writes every signal as NetCDF, or as CSV with --csv",
    ".csparam": "write .param",
    ".endl": "put the section of the library into a file and .include it",
    ".width": "leave it out",
    **dict.fromkeys((".tf", ".pz", ".net"), "gains against frequency are given by fingerspice ac"),
    **dict.fromkeys((".sens", ".data", ".alter"), "run once per value by --set"),
    **dict.fromkeys((".if", ".elseif", ".else", ".endif"), "write the case that is meant"),
    **dict.fromkeys(
        (".savebias", ".loadbias"), "a run goes on from another in Python, fs.simulate(circuit, start=solution)"
    ),
}

_LISTS = re.compile(r"\{[^{}]*\}|'[^']*'|\"[^\"]*\"")
_CALL = re.compile(r"\(([^()]*)\)")
_COMMA = re.compile(r"(?<![\w.,])([+-]?[0-9]+),([0-9]+[a-zµμ]*)(?![\w.,])", re.IGNORECASE)
_ASSIGNED = re.compile(rf"=\s*{_COMMA.pattern}", re.IGNORECASE)
_NUMBER = re.compile(r"[+-]?\.?[0-9][\w.+-]*")
_GREEK_MU = re.compile(r"(?<![\w.])([0-9.]+(?:e[+-]?[0-9]+)?)μ", re.IGNORECASE)
_UNIT = re.compile(r"(?:[tgkmunpfµμ]|meg|mil)?(?:m|v|a|s|n|f|hz|ohm|ω)?", re.IGNORECASE)


def decimal_comma(text: str) -> str | None:
    """A warning about a comma that is probably meant as a decimal point; None if there is none.

    Commas separate numbers, as in ``SIN(0,200,100)``. A comma is doubtful if blanks separate the other numbers, as in
    ``SIN(0 200 0,1)``, and in ``d=3,5u``.
    """
    bare = _LISTS.sub("x", text)
    for found in (_ASSIGNED.search(bare), *_among_blanks(bare)):
        if found:
            whole, part = found[1], found[2]
            return (
                f"{whole},{part} is two numbers, {whole} and {part}, for a comma separates; if it is a decimal comma "
                f"write {whole}.{part}"
            )
    return None


def greek_mu(text: str) -> str | None:
    """A warning about a number with the Greek letter for micro, which ngspice does not read; None if there is none."""
    found = _GREEK_MU.search(text)
    return f"{found[0]} is {found[1]}u here and {found[1]} in ngspice 39: write {found[1]}u" if found else None


def _among_blanks(bare: str) -> Iterator[re.Match[str] | None]:
    outside = _CALL.sub(" ", bare)
    # An element's name and nodes are left out: they may be numbers, and commas may separate them.
    words = outside.split()[1 if outside.lstrip().startswith(".") else 3 :]
    for chunks in ([c for c in words if "=" not in c], *(m[1].split() for m in _CALL.finditer(bare))):
        matches = [_COMMA.fullmatch(chunk) for chunk in chunks]
        others = [c for c, m in zip(chunks, matches, strict=True) if m is None]
        if all(_NUMBER.fullmatch(c) or c.isalpha() for c in others) and (others or len(chunks) == len(words) == 1):
            yield from matches


def is_unit(word: str) -> bool:
    """Whether a word may be a scale, a unit, or both."""
    return _UNIT.fullmatch(word) is not None and word != ""


def stray_word(word: str, before: str) -> str:
    """A hint if a word after ``key=value`` is a unit, separated from its number by a blank; else an empty text."""
    number = before.rpartition("=")[2].strip()
    return f"; a unit joins its number, {number}{word}" if _NUMBER.fullmatch(number) and is_unit(word) else ""


def with_comma(error: InputError, warnings: Iterable[str]) -> InputError:
    """The error, with the warning about a decimal comma in the same line, if there is one."""
    place = f"{error.where.file}:{error.where.line}:" if error.where else "none"
    found = [text.partition(": ")[2] for text in warnings if text.startswith(place) and "decimal comma" in text]
    return InputError("; note ".join([error.message, *found]), error.where) if found else error


#: Largest number and length of the known words that are compared: a comparison takes the product of the two lengths.
MAX_KNOWN, MAX_COMPARED = 1000, 60


def closest(word: str, known: Iterable[str]) -> str | None:
    """The known word whose spelling is nearest to `word`, regardless of case; None if none is similar."""
    if len(word) > MAX_COMPARED:
        return None
    lower = {name.lower(): name for name in itertools.islice(known, MAX_KNOWN) if len(name) <= MAX_COMPARED}
    close = difflib.get_close_matches(word.lower(), lower, n=1)
    return lower[close[0]] if close else None


def nearest(word: str, known: Iterable[str]) -> str:
    """The clause ``; did you mean 'x'?`` with the closest known word, or an empty text."""
    found = closest(word, known)
    return f"; did you mean '{found}'?" if found is not None else ""


#: Limits: characters of an expression, nested brackets, `?` in an expression, and signs in a row.
MAX_LENGTH, MAX_DEPTH, MAX_QUESTIONS, MAX_SIGNS = 2000, 25, 25, 3

CONSTANTS: Mapping[str, float] = {"pi": math.pi, "e": math.e}
#: Function from the values of parameters, whose names are in lower case, to the value of a part of an expression.
Term: TypeAlias = Callable[[Mapping[str, float]], float]


class Problem(Exception):
    """An error in an expression, with the position of the character at fault."""

    def __init__(self, message: str, position: int = 0) -> None:
        self.message = message
        self.position = position


def _power(base: float, exponent: float) -> float:
    """`base ^ exponent`; a negative base needs an even exponent, as ngspice takes the base's absolute value."""
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


_AS_IN_MATH = "sqrt exp log10 sin cos tan asin acos atan sinh cosh tanh asinh acosh atanh floor ceil"
#: From a name to the function, and its number of arguments.
FUNCTIONS: Mapping[str, tuple[Callable[..., float], int]] = {
    **{name: (getattr(math, name), 1) for name in _AS_IN_MATH.split()},
    "ln": (math.log, 1),
    "log": (math.log, 1),
    "arctan": (math.atan, 1),
    "abs": (abs, 1),
    "sqr": (lambda x: x * x, 1),
    "sgn": (lambda x: (x > 0.0) - (x < 0.0), 1),
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

_COMPARISONS = {
    "<": operator.lt, "<=": operator.le, ">": operator.gt, ">=": operator.ge, "==": operator.eq, "!=": operator.ne,
}  # fmt: skip
#: Operators between two values, from loose to tight. `||` and `&&` have the function of all their values' truths.
_LEVELS: tuple[Mapping[str, Callable[..., float]], ...] = (
    {"||": any},
    {"&&": all},
    _COMPARISONS,
    {"+": operator.add, "-": operator.sub},
    {"*": operator.mul, "/": operator.truediv},
)
_FAILURES: Mapping[type[Exception], str] = {
    ZeroDivisionError: "divides by zero",
    OverflowError: "is too large for a number (1.8e308)",
    ValueError: "leaves the domain of one of its functions",
}
_POWERS = ("^", "**")
#: After these a minus stands before one value of several.
_OPERATORS = frozenset(("?", ":", *_POWERS, *(sign for level in _LEVELS for sign in level)))

_LEX = re.compile(
    r"(?P<space>\s+)"
    r"|(?P<number>(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?[\w.]*)"
    r"|(?P<name>[A-Za-z_]\w*)"
    r"|(?P<op>\*\*|&&|\|\||[<>=!]=|[-+*/^<>(),?:])"
)


class _Piece(NamedTuple):
    kind: str  # number, name, op or end
    text: str
    position: int


def _pieces(text: str) -> list[_Piece]:
    """Numbers, names, operators, and at last the end."""
    pieces: list[_Piece] = []
    position = questions = 0
    while position < len(text):
        match = _LEX.match(text, position)
        if match is None:
            hint = ": a comparison is ==" if text[position] == "=" else ""
            raise Problem(f"{text[position]!r} does not belong in arithmetic{hint}", position)
        kind, found = match.lastgroup or "", match.group()
        questions += found == "?"
        if questions > MAX_QUESTIONS:
            raise Problem(f"more than {MAX_QUESTIONS} '?' in one expression", position)
        if kind != "space":
            pieces.append(_Piece(kind, found, position))
        position = match.end()
    return [*pieces, _Piece("end", "", len(text))]


class Expression:
    """A compiled expression; `Problem` is raised for a text that is not arithmetic.

    The parser is a recursive descent, only as deep as the brackets are nested: chains such as `a + b - c` are loops.
    """

    def __init__(self, text: str) -> None:
        if len(text) > MAX_LENGTH:
            raise Problem(f"an expression of {len(text)} characters: at most {MAX_LENGTH} are allowed")
        self.text = text
        self.names: dict[str, int] = {}  # In lower case, constants included, and the position of each one's first use
        self._pieces = _pieces(text)
        self._at = 0
        self._brackets: list[tuple[_Piece, bool]] = []  # open, each with whether it encloses a function's arguments
        self._term = self._condition()
        self._refuse_going_on()
        numbers = [piece for piece in self._pieces if piece.kind == "number"]
        # The first number written with a capital M, and its position
        self.mega = next(((text, position) for _, text, position in numbers if suspicious_mega(text)), None)
        self._pieces.clear()

    def evaluate(self, names: Mapping[str, float], place: Callable[[int], Where]) -> float:
        """Value of the expression, given the values of names (lower case); a value that is not finite is refused."""
        try:
            value = float(self._term(names))
        except Problem as problem:
            raise InputError(problem.message, place(problem.position)) from None
        except (ZeroDivisionError, OverflowError, ValueError) as error:
            raise InputError(f"'{self.text}' {_FAILURES[type(error)]}", place(0)) from None
        if not math.isfinite(value):
            raise InputError(f"'{self.text}' gives {value:g}, not a finite number", place(0))
        return value

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
        if kind == "end":
            if self._brackets:
                raise Problem("'(' is never closed", self._brackets[-1][0].position)
        elif text == ")":
            if not self._brackets:
                raise Problem("')' without an opening '('", position)
        elif text == ":":
            raise Problem("':' without its '?' (a ? b : c)", position)
        elif text != ",":
            raise Problem(f"an operator is missing before '{text}'", position)
        elif not (self._brackets and self._brackets[-1][1]):
            raise Problem("',' outside the arguments of a function", position)

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
            if self._at - begin > MAX_SIGNS:
                raise Problem(f"more than {MAX_SIGNS} signs in a row", sign.position)
        end, value = self._at, self._value()
        power = self._take(*_POWERS)
        if power is not None:
            if of_power:  # ngspice groups to the left, and mathematics to the right
                raise Problem("a second '^' in a row has two readings: use brackets", power.position)
            value = partial(_folded, value, [(_power, self._signed(of_power=True))])
        for index in range(max(begin, 1), end):
            before, sign, number, after = self._pieces[index - 1 : index + 3]
            moved = number.kind != "number" or (after.text in _POWERS and before.text not in _POWERS)
            if sign.text == "-" and before.text in _OPERATORS and moved:
                problem = "a '-' after an operator has two readings here: use brackets, as in 2*(-x)"
                raise Problem(problem, sign.position)
        return (lambda names: -value(names)) if negative else value

    def _value(self) -> Term:
        """A number, a name, or what is in brackets."""
        piece = self._pieces[self._at]
        kind, text, position = piece
        if text == "(":
            return self._in_brackets(False)[0]
        if kind == "op":
            raise Problem(f"a value is missing before '{text}'", position)
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
            hint = nearest(text, FUNCTIONS) or f"; functions are {' '.join(FUNCTIONS)}"
            raise Problem(f"'{text}' is not a function{hint}", position)
        return partial(_called, name, self._in_brackets(True), self.text)

    def _in_brackets(self, of_call: bool) -> list[Term]:
        """The expressions in brackets: one, or a function's arguments."""
        opening = self._pieces[self._at]
        self._brackets.append((opening, of_call))
        if len(self._brackets) > MAX_DEPTH:
            raise Problem(f"brackets nested deeper than {MAX_DEPTH}", opening.position)
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
        plural = "" if wanted == 1 else "s"
        raise Problem(f"{name} takes {wanted} argument{plural}, {given} given: {text}{more}")
    return float(function(*(argument(names) for argument in arguments)))


#: The expression of a text; raises `Problem` if it is not arithmetic.
compiled = lru_cache(maxsize=8192)(Expression)


def compile_expression(text: str, place: Callable[[int], Where]) -> Expression:
    """Check an expression, without its braces or quotes; `place` gives the place of one of its characters."""
    try:
        return compiled(text)
    except Problem as problem:
        raise InputError(problem.message, place(problem.position)) from None
