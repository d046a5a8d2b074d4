"""The grammar of `.meas`, `.four`, `.save`, `.step` and `.dc` lines."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from functools import partial

from fingerspice.base.errors import InputError, Where
from fingerspice.base.units import parse_number
from fingerspice.circuit.circuit import Element, Step
from fingerspice.circuit.measures import EDGES, LAST, OF_DEVICES, PARTS, Crossing, Measure, Quantity, Vector
from fingerspice.netlist.expressions import CONSTANTS, FUNCTIONS, Problem, compiled, evaluated
from fingerspice.netlist.lexer import Line, nearest
from fingerspice.waveforms.waveform import refuse

_VECTOR = r"@[\w.]+\[\w+\]|[A-Za-z_]\w*\((?:[^()]|\([^()]*\))*\)"
_WORDS = re.compile(rf"\s*(?:(?P<sign>=)|(?P<braced>\{{[^{{}}]*\}}|'[^']*')|(?P<vector>{_VECTOR})|(?P<word>[^\s=]+))")
_IN_BRACES = re.compile(_VECTOR)
_ALIASES = {"integral": "integ", "derivative": "deriv", "average": "avg"}
FORMS = "AVG RMS MIN MAX PP INTEG MIN_AT MAX_AT FIND DERIV WHEN TRIG PARAM"
# Words at which a vector or an expression of vectors has ended.
_STOPS = ("=", "from", "to", "at", "when", "val", "td", "targ", *EDGES)
_OTHERS = ("dc", "op", "noise", "tf", "sp")  # Analyses of which nothing is measured here


def _of_vectors(text: str, params: Mapping[str, float], *x: float) -> float:
    """Value of an expression at values of its vectors."""
    return compiled(text).term({**params, **{f"vector_{i}": one for i, one in enumerate(x)}})


def _of_measures(text: str, params: Mapping[str, float], measured: Mapping[str, float]) -> float:
    """Value of an expression at values of other measures."""
    return compiled(text).term({**params, **measured})


class _Line:
    """The words of a `.meas` or `.four` line after its name, read one after the other."""

    def __init__(
        self, line: Line, start: int, params: Mapping[str, float], elements: Sequence[Element], name: str = ".meas"
    ) -> None:
        self.line, self.params, self.elements, self.name = line, params, elements, name
        self.words = [(m.lastgroup or "", m[m.lastgroup or 0], m.start(m.lastgroup or 0))
                      for m in _WORDS.finditer(line.text, start)]  # fmt: skip
        self.at, self.ac = 0, False

    @property
    def where(self) -> Where:
        """Place of the next word, or of the line's end."""
        return self.line.where(self.words[self.at][2] if self.at < len(self.words) else len(self.line.text))

    def peek(self) -> str:
        """The next word in lower case; empty at the end."""
        return self.words[self.at][1].lower() if self.at < len(self.words) else ""

    def take(self, what: str) -> tuple[str, str]:
        """Kind and text of the next word."""
        refuse(self.at >= len(self.words), f"{self.name} ends where {what} is missing", self)
        kind, text, _ = self.words[self.at]
        self.at += 1
        return kind, text

    def word(self, *allowed: str) -> str:
        """The next word if it is one of these, which is passed; empty otherwise."""
        found = self.peek() if self.peek() in allowed else ""
        self.at += bool(found)
        return found

    def number(self, what: str) -> float:
        """A number, a parameter or an expression of these."""
        place = self.where
        kind, text = self.take(what)
        plain = kind == "word" and text.lower() not in self.params
        inner = text[1:-1] if kind == "braced" else text
        try:
            return parse_number(text) if plain else evaluated(inner, self.params, lambda _: place)
        except ValueError:
            raise InputError(f"{self.name} has {text!r} where {what} belongs; allowed: a number", place) from None

    def quantity(self) -> Quantity:
        """A vector, or an expression of vectors: as it is, in braces, in quotes, or as ``par('...')``."""
        place, first = self.where, self.at
        self.take("a vector")
        while self.at < len(self.words) and self.peek() not in _STOPS and not self._next_vector():
            self.at += 1
        end = self.words[self.at][2] if self.at < len(self.words) else len(self.line.text)
        text = self.line.text[self.words[first][2] : end].strip()
        alone = self.at == first + 1 and self.words[first][0] == "vector"
        if text.lower().startswith("par(") and text[-1] == ")":
            text, alone = text[4:-1].strip(), False
        if alone and self._is_vector(text):
            return Quantity(text, (self.vector(text, place),))
        if _IN_BRACES.search(text) is None:
            allowed = "V(node), V(a,b), I(Vx), I(Rx), F_EL(Xgap), @Xgap[f_el], or an expression of such"
            raise InputError(f"{self.name} has {text!r} where a vector belongs; allowed: {allowed}", place)
        inner = text[1:-1] if text[0] in "{'" and text[-1] in "}'" else text
        found: list[str] = []
        bare = _IN_BRACES.sub(lambda m: self._named(m[0], found), inner)
        vectors, params = tuple(self.vector(one, place) for one in found), dict(self.params)
        self.check(bare, {*params, *(f"vector_{i}" for i in range(len(found)))}, place)
        return Quantity(text, vectors, partial(_of_vectors, bare, params))

    def _next_vector(self) -> bool:
        """Whether the next word is another vector, and no part of the expression before it."""
        kind, _, position = self.words[self.at]
        _, before, start = self.words[self.at - 1]
        apart = start + len(before) < position
        return apart and kind in ("vector", "braced") and before[-1] not in "+-*/^<>?:,"

    @staticmethod
    def _is_vector(text: str) -> bool:
        """Whether a call names a vector and no function."""
        return text[0] == "@" or text.partition("(")[0].lower() not in FUNCTIONS

    @staticmethod
    def _named(text: str, found: list[str]) -> str:
        """A vector's name in an expression; a function's call stays as it is."""
        name, _, inside = text.partition("(")
        if not _Line._is_vector(text):
            return f"{name}({_IN_BRACES.sub(lambda m: _Line._named(m[0], found), inside)}" if inside else text
        found.append(text)
        return f"vector_{len(found) - 1}"

    def check(self, text: str, known: Iterable[str], place: Where) -> Iterable[str]:
        """The names in an expression, which have to be known."""
        try:
            names = compiled(text).names
        except Problem as problem:
            raise InputError(f"{self.name} {text!r}: {problem.message}", place) from None
        for name in names.keys() - {*known, *CONSTANTS}:
            raise InputError(f"{self.name} {text!r}: {name!r} is not defined{nearest(name, known)}", place)
        return names

    def vector(self, text: str, place: Where) -> Vector:
        """A vector that the circuit has."""
        if text[0] == "@":
            element, _, key = text[1:-1].partition("[")
            inside = [element]
        else:
            key, _, rest = text.partition("(")
            # A comma within brackets belongs to a name.
            inside = [part.strip() for part in re.split(r",(?![^(]*\))", rest[:-1])]
        key = key.lower()
        if key in (PARTS if self.ac else PARTS[:1]):
            known = {node: None for e in self.elements for node in e.nodes} | {"0": None, "gnd": None}
            names = tuple("0" if name.lower() == "gnd" else name.lower() for name in inside)
            what, wrong = "node", next((name for name in names if name not in known), None)
            refuse(not 1 <= len(names) <= 2, f"{self.name} {text} names {len(names)} nodes; allowed: one or two", place)
        else:
            of = {"i": None, **OF_DEVICES}
            said = f"{self.name} {text} is no vector{nearest(key, of)}; allowed: V, I, {', '.join(OF_DEVICES)}"
            refuse(key not in of, said, place)
            elements = {e.name.lower(): e for e in self.elements if key in ("i", "u") or e.device == "GAP"}
            names = (inside[0].lower(),)
            known, what = dict.fromkeys(elements), "element" if key == "i" else "layer" if key == "u" else "GAP"
            wrong = next((name for name in names if name not in known), None)
            key = OF_DEVICES.get(key, key)
        if wrong is not None:
            raise InputError(f"{self.name} {text}: the circuit has no {what} {wrong!r}{nearest(wrong, known)}", place)
        return Vector(key, names)

    def pairs(self, allowed: Sequence[str]) -> dict[str, float]:
        """Values of ``KEY=value`` pairs with these keys, as far as they go."""
        found: dict[str, float] = {}
        while (key := self.peek()) in allowed:
            self.at += 1
            self.word("=")
            last = key in EDGES and self.peek() == "last"
            self.at += last
            found[key] = LAST if last else self.number(f"the value of {key.upper()}")
        return found

    def crossing(self) -> Crossing:
        """``AT=time``, or ``quantity=value`` or ``quantity VAL=value`` with which of the crossings is meant."""
        if self.peek() == "at":
            return Crossing(None, self.pairs(("at",))["at"])
        before, of, value = self.pairs(("val", "td", *EDGES)), self.quantity(), math.nan
        if self.word("="):
            if self.words[self.at : self.at + 1] and self.words[self.at][0] == "vector":
                of, value = of.less(self.quantity()), 0.0
            else:
                value = self.number("the value that is crossed")
        more = before | self.pairs(("val", "td", *EDGES))
        value = more.get("val", value)
        refuse(math.isnan(value), f"{self.name} has no value that {of.text} crosses; allowed: {of.text}=1", self)
        edge, *others = [edge for edge in EDGES if edge in more] or ["cross"]
        refuse(others, f"{self.name} has {edge.upper()} and {', '.join(others).upper()}; allowed: one of them", self)
        number = more.get(edge, 1)
        refuse(number != LAST and not (number >= 1 and number == int(number)),
               f"{self.name} counts {edge.upper()}={number:g}; allowed: 1, 2, ... or LAST", self)  # fmt: skip
        return Crossing(of, value, edge, int(number), more.get("td", 0.0))


def read_measure(
    line: Line, start: int, params: Mapping[str, float], elements: Sequence[Element], before: Sequence[Measure]
) -> Measure:
    """A `.meas` line, whose text after the directive begins at `start`; `before` are the measures above it.

    Raises
    ------
    InputError
        For an unknown form, a vector that the circuit does not have, and a name that was given before.
    """
    words = _Line(line, start, params, elements)
    # LTspice's lines may lack the analysis.
    analysis = words.word("tran", "ac", *_OTHERS) or "tran"
    name = words.take("the measure's name")[1]
    words.ac = analysis == "ac"
    refuse(any(one.name.lower() == name.lower() for one in before), f".meas {name} is given twice", line.where(start))
    if analysis in _OTHERS:
        return Measure(name, "none", refused=f"a measure of {analysis.upper()} is not made here")
    kind = words.take("what is measured")[1].lower()
    kind = _ALIASES.get(kind, kind)
    refuse(kind not in FORMS.lower().split(), f".meas {name} {kind!r}; allowed: {FORMS}", line.where(start))
    of = start_at = stop_at = formula = None
    needs: tuple[str, ...] = ()
    if kind == "param":
        words.word("=")
        place = words.where
        text = line.text[words.words[words.at][2] :] if words.at < len(words.words) else ""
        text, words.at = text.strip().strip("\"'{}").strip(), len(words.words)
        refuse(not text, f".meas {name} PARAM has no expression", place)
        known = {one.name.lower() for one in before}
        needs = tuple(known.intersection(words.check(text, {*known, *params}, place)))
        formula = partial(_of_measures, text, dict(params))
    elif kind == "trig":
        start_at = words.crossing()
        refuse(words.take("TARG")[1].lower() != "targ", f".meas {name}: TRIG needs TARG after it", line.where(start))
        stop_at = words.crossing()
    elif kind == "when":
        start_at = words.crossing()
    else:
        of = words.quantity()
        if kind in ("find", "deriv"):
            words.word("when")
            start_at = words.crossing()
    window = words.pairs(("from", "to", "td"))
    if words.at < len(words.words):
        raise InputError(f".meas {name}: {words.peek()!r} is not understood here", words.where)
    since, until = window.get("from", window.get("td")), window.get("to")
    return Measure(name, kind, of, start_at, stop_at, since, until, needs, formula, analysis=analysis)


def read_fourier(
    line: Line, start: int, params: Mapping[str, float], elements: Sequence[Element]
) -> list[tuple[float, Quantity]]:
    """A `.four` line: the fundamental (Hz) with each of its vectors.

    Raises
    ------
    InputError
        For a frequency that is not above 0, and for vectors that the circuit does not have.
    """
    words = _Line(line, start, params, elements, ".four")
    frequency = words.number("the fundamental")
    refuse(not frequency > 0.0, f".four has a fundamental of {frequency:g} Hz; allowed: more than 0", line.where(start))
    found = list[tuple[float, Quantity]]()
    while words.at < len(words.words) or not found:
        found.append((frequency, words.quantity()))
    return found


def read_saved(
    line: Line, start: int, params: Mapping[str, float], elements: Sequence[Element], notes: list[str]
) -> list[Quantity]:
    """The vectors of a `.save`, `.probe` or `.print tran` line; those that the circuit lacks make a warning each."""
    words, found = _Line(line, start, params, elements, ".save"), list[Quantity]()
    if words.word("ac", "dc", "op", "noise"):
        return []
    words.word("tran")
    while words.at < len(words.words):
        place, first = words.where, words.at
        if words.word("all", "allv", "alli"):
            continue
        try:
            found.append(words.quantity())
        except InputError as error:
            words.at = max(words.at, first + 1)
            notes.append(f"{place}: {error.message}; it is left out of the files")
    return found


_MOST_STEPS = 100_000  # Values of all steps together


def read_step(line: Line, start: int, params: Mapping[str, float], elements: Sequence[Element]) -> Step:
    """A `.step` line: ``[param] NAME first last increment``, ``NAME list value ...``, or ``dec|oct NAME f l points``.

    Raises
    ------
    InputError
        For a name that is no parameter, no path and no source, and for no values or too many.
    """
    words = _Line(line, start, params, elements, ".step")
    scale = words.word("dec", "oct", "lin")
    words.word("param")
    stepped = _stepped(words)
    if words.word("list"):
        values = []
        while words.at < len(words.words):
            values.append(words.number("a value"))
        refuse(not values, ".step has a list without values; allowed: list 1 2 5", words)
    else:
        values = _spaced(words, scale)
    if words.at < len(words.words):
        raise InputError(f".step: {words.peek()!r} is not understood here", words.where)
    return Step(stepped.name, tuple(values), stepped.of_param)


def read_dc(line: Line, start: int, params: Mapping[str, float], elements: Sequence[Element]) -> tuple[Step, ...]:
    """A `.dc` line: ``NAME first last increment``, twice for two that are swept, the first one fastest.

    Raises
    ------
    InputError
        As `read_step`.
    """
    words, found = _Line(line, start, params, elements, ".dc"), list[Step]()
    while words.at < len(words.words) or not found:
        one = _stepped(words)
        found.append(Step(one.name, tuple(_spaced(words)), one.of_param))
    return tuple(found)


def _stepped(words: _Line) -> Step:
    """The next word as what is stepped, without its values."""
    place, written = words.where, words.take("what is stepped")[1]
    key = written.lower()
    refuse(key == "temp", f"{words.name} temp: the temperature is not stepped here; allowed: a .param, or R1", place)
    if key in words.params and not key.endswith("("):
        return Step(key, (), True)
    known = {f"{e.name}.{name}".lower(): f"{e.name}.{name}" for e in words.elements for name in e.parameters}
    # The name alone of a source is its level, and of an element with one value that value.
    known |= {e.name.lower(): e.name for e in words.elements if e.device in ("V", "I")}
    known |= {e.name.lower(): f"{e.name}.{name}" for e in words.elements if len(e.values) == 1 for name in e.values}
    hint = nearest(key, [*known, *(one for one in words.params if not one.endswith("("))])
    allowed = "a .param, a source, or a path such as Xgap.d"
    refuse(key not in known, f"{words.name} {written!r} is not there{hint}; allowed: {allowed}", place)
    return Step(known[key], ())


def _spaced(words: _Line, scale: str = "") -> list[float]:
    """Values from the next three numbers: first, last, and the increment or the points of a decade or octave."""
    place = words.where
    first, last, step = (words.number(what) for what in ("the first value", "the last value", "the increment"))
    base = {"dec": 10.0, "oct": 2.0}.get(scale)
    if base:
        good = first > 0.0 and last > 0.0 and step >= 1.0
        refuse(not good, f"{words.name} {scale} from {first:g} to {last:g} with {step:g} points; "
               "allowed: values above 0, and 1 or more points", place)  # fmt: skip
        count = abs(math.log(last / first, base)) * step
    else:
        refuse(step == 0.0 or (last - first) * step < 0.0, f"{words.name} from {first:g} to {last:g} by {step:g} "
               "has no values; allowed: an increment that leads from the first to the last", place)  # fmt: skip
        count = (last - first) / step
    refuse(count >= _MOST_STEPS, f"{words.name} has {count:.3g} values; allowed: {_MOST_STEPS:,}", place)
    number = range(math.floor(count * (1.0 + 1e-9) + 1e-9) + 1)
    values = (first * base ** math.copysign(k / step, last - first) if base else first + k * step for k in number)
    return [float(f"{x:.14g}") for x in values]


def checked_steps(steps: Sequence[Step], name: str) -> tuple[Step, ...]:
    """Several steps, nested, the first one innermost; refused are more than three, and too many values in all."""
    count = math.prod(len(one.values) for one in steps)
    refuse(len(steps) > 3, f"{len(steps)} {name} lines; allowed: three, nested")
    refuse(count > _MOST_STEPS, f"{name} has {count:,} values in all; allowed: {_MOST_STEPS:,}")
    twice = [one.name for k, one in enumerate(steps) if one.name in [other.name for other in steps[:k]]]
    refuse(twice, f"{name} steps {', '.join(twice)} twice; allowed: once")
    return tuple(steps)
