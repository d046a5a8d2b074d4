"""Division of netlist text into logical lines, lexemes and groups, each with its line and column in the file.

Nothing here depends on the meaning of a word: the callers distinguish names, values and directives.
"""

from __future__ import annotations

import re
from bisect import bisect_right
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import islice
from typing import NamedTuple

from fingerspice.base.errors import InputError, Where

#: As in ngspice a `;`, a `//` after a blank, or a `$` between blanks starts a comment, except in double quotes.
_COMMENT = re.compile(r'"[^"]*"|(;|(?<!\S)//|(?<!\S)\$(?!\S))')
_LEX = re.compile(r"""[\s,]+|([()=])|("[^"]*")|('[^']*')|([^\s,()={}'"]+)""")
#: Pattern of a separator or a mark; their number is an upper bound of the number of words.
_SPLIT = re.compile(r"""[\s,]+|[()={}'"]""")
_BRACE = re.compile(r"[{}]")
_MARKS = ("(", ")", "=")
_KEY = re.compile(r"[A-Za-z_]\w*")
_NUMERIC = re.compile(r"[+-]?\.?[0-9]")


class Line:
    """A logical line: a physical line without its comment, joined with the `+` lines that continue it.

    Attributes
    ----------
    file : str
        The file's name as shown to the user.
    text : str
        The joined text; continuations are separated by one space.
    """

    __slots__ = ("_numbers", "_shifts", "_starts", "file", "text")

    def __init__(self, file: str, number: int, text: str) -> None:
        self.file = file
        self.text = text
        self._starts: list[int] | None = None  # only continued lines need the lists
        self._numbers = [number]
        self._shifts = [1]

    @classmethod
    def joined(cls, file: str, parts: list[tuple[int, int, str]]) -> Line:
        """Line made of (line number, column before the text, text) of each physical line."""
        line = cls(file, parts[0][0], " ".join(text for _, _, text in parts))
        line._starts, line._numbers, line._shifts = [], [], []
        start = 0
        for number, column, text in parts:
            line._starts.append(start)
            line._numbers.append(number)
            line._shifts.append(column + 1 - start)
            start += len(text) + 1
        return line

    def where(self, position: int = 0) -> Where:
        """Place of one character of the joined text."""
        index = 0 if self._starts is None else bisect_right(self._starts, position) - 1
        return Where(self.file, self._numbers[index], position + self._shifts[index])

    def written(self, lexeme: Lexeme) -> str:
        """Text of a lexeme with its braces or quotes."""
        marks = 2 * (lexeme.kind in ("expression", "string"))
        return self.text[lexeme.position : lexeme.position + len(lexeme.text) + marks]

    def words(self, most: int) -> int:
        """An upper bound of the number of lexemes, counted up to `most`."""
        return len(self._numbers) + sum(1 for _ in islice(_SPLIT.finditer(self.text), most))

    @property
    def start(self) -> int:
        """Position of the first character that is not blank."""
        return len(self.text) - len(self.text.lstrip())


class Lexeme(NamedTuple):
    """A piece of a line: `kind` is word, expression, string or one of ``( ) =``."""

    kind: str
    text: str  # without the braces or quotes
    position: int


class Assignment(NamedTuple):
    """`key = value`."""

    key: Lexeme
    value: Lexeme


@dataclass(slots=True)
class Group:
    """Words and `key=value` pairs of a line, or of a call in it such as `SIN(0 200 100)`."""

    name: Lexeme | None = None
    words: list[Lexeme | Group] = field(default_factory=list)
    params: dict[str, Assignment] = field(default_factory=dict)
    stray: Lexeme | None = None  # the first word that follows a `key=value`


def split_lines(text: str) -> list[str]:
    """Physical lines as an editor counts them, which only LF, CRLF and CR end."""
    if "\r" in text:
        text = text.replace("\r\n", "\n").replace("\r", "\n")
    return text.split("\n")


def logical_lines(lines: list[str], file: str, first: int = 1) -> Iterator[Line]:
    """Logical lines, without comments and blank lines; `first` is the number of the first physical line.

    Raises
    ------
    InputError
        If a continuation has no line before it.
    """
    pending: list[tuple[int, int, str]] = []
    for number, raw in enumerate(lines, first):
        body = _without_comment(raw)
        bare = body.lstrip()
        if not bare or bare[0] == "*":
            continue
        column = len(body) - len(bare)
        if bare[0] == "+":
            if not pending:
                problem = "'+' continues the line before, but there is none"
                raise InputError(problem, Where(file, number, column + 1))
            pending.append((number, column + 1, bare[1:]))
            continue
        if pending:
            yield _finished(file, pending)
        pending = [(number, 0, body)]
    if pending:
        yield _finished(file, pending)


def _finished(file: str, parts: list[tuple[int, int, str]]) -> Line:
    return Line(file, parts[0][0], parts[0][2]) if len(parts) == 1 else Line.joined(file, parts)


def _without_comment(raw: str) -> str:
    if ";" in raw or "$" in raw or "//" in raw:
        for match in _COMMENT.finditer(raw):
            if match[1]:
                return raw[: match.start()].rstrip()
    return raw.rstrip()


def lex(line: Line, start: int = 0) -> list[Lexeme]:
    """Lexemes of a line from a position on; blanks and commas separate them.

    Raises
    ------
    InputError
        If a brace or quote is not closed.
    """
    text, position = line.text, start
    lexemes: list[Lexeme] = []
    while position < len(text):
        match = _LEX.match(text, position)
        if match is None:
            inner = _braced(line, position)
            lexemes.append(Lexeme("expression", inner, position))
            position += len(inner) + 2
            continue
        kind = match.lastindex
        if kind == 1:
            lexemes.append(Lexeme(match[1], match[1], position))
        elif kind == 2:
            lexemes.append(Lexeme("string", match[2][1:-1], position))
        elif kind == 3:
            lexemes.append(Lexeme("expression", match[3][1:-1], position))
        elif kind == 4:
            if match[4][0] == "$":
                problem = f"'{match[4]}': a comment after '$' needs a blank between them"
                raise InputError(problem, line.where(position))
            lexemes.append(Lexeme("word", match[4], position))
        position = match.end()
    return lexemes


def _braced(line: Line, position: int) -> str:
    """Text between the opening brace at a position and the brace that closes it."""
    opening = line.text[position]
    if opening != "{":
        problem = "'}' without an opening '{'" if opening == "}" else f"{opening} is never closed"
        raise InputError(problem, line.where(position))
    depth = 0
    for match in _BRACE.finditer(line.text, position):
        depth += 1 if match.group() == "{" else -1
        if depth == 0:
            return line.text[position + 1 : match.start()]
    raise InputError("'{' is never closed", line.where(position))


def group(line: Line, lexemes: list[Lexeme], plain: int = 0, *, probes: bool = False) -> Group:
    """Sort the lexemes of a line into words, calls and `key=value` pairs.

    Parameters
    ----------
    line : Line
        The line, for places.
    lexemes : list of Lexeme
        The lexemes after the line's first word.
    plain : int
        Number of words at the beginning that are nodes, which may stand in brackets without being calls.
    probes : bool
        Whether `v(node)=value` is a pair with the key ``v(node)``.

    Raises
    ------
    InputError
        If a bracket has no partner, or a pair has no name or value, or is given twice.
    """
    top = Group()
    inside, brackets = top, list[tuple[Lexeme, Group]]()
    index, count = 0, len(lexemes)
    while index < count:
        lexeme, after = lexemes[index], index + 1
        if len(top.words) < plain and lexeme.kind == "word":
            lexeme, after = _with_brackets(lexemes, index)
        following = lexemes[after].kind if after < count else ""
        probe = _probe(lexemes, index) if probes and following == "(" else None
        if probe is not None or (following == "=" and lexeme.kind not in _MARKS):
            key, equals = probe or (lexeme, after)
            _assign(line, inside, key, lexemes, equals)
            index = equals + 2
            continue
        if lexeme.kind == "(":
            brackets.append((lexeme, inside))
        elif lexeme.kind in _MARKS:
            inside = _closed(line, lexeme, brackets)
        elif following == "(" and _may_be_called(lexeme) and len(top.words) >= plain:
            brackets.append((lexemes[after], inside))
            inside = _call(line, lexeme, inside, top)
            after += 1
        else:
            if inside.params and inside.stray is None:
                inside.stray = lexeme
            inside.words.append(lexeme)
        index = after
    if brackets:
        raise InputError("'(' is never closed", line.where(brackets[-1][0].position))
    return top


def _closed(line: Line, lexeme: Lexeme, brackets: list[tuple[Lexeme, Group]]) -> Group:
    """The group around a bracket that a `)` closes."""
    if lexeme.kind == "=":
        raise InputError("the name before '=' is missing", line.where(lexeme.position))
    if not brackets:
        raise InputError("')' without an opening '('", line.where(lexeme.position))
    return brackets.pop()[1]


def _may_be_called(lexeme: Lexeme) -> bool:
    return lexeme.kind == "word" and _NUMERIC.match(lexeme.text) is None


def _call(line: Line, name: Lexeme, inside: Group, top: Group) -> Group:
    if inside is not top:
        problem = f"'{name.text}(' inside brackets: arithmetic goes in braces, as in {{{name.text}(...)}}"
        raise InputError(problem, line.where(name.position))
    call = Group(name)
    top.words.append(call)
    return call


def _with_brackets(lexemes: list[Lexeme], index: int) -> tuple[Lexeme, int]:
    """A word with the brackets and words that touch it, as in KiCad's `Net-(C1-Pad1)`, and the index after it."""
    name, end, depth = lexemes[index].text, index + 1, 0
    closed = name, end
    while end < len(lexemes) and lexemes[end].kind in ("(", ")", "word"):
        piece = lexemes[end]
        depth += {"(": 1, ")": -1}.get(piece.kind, 0)
        if depth < 0 or piece.position != lexemes[index].position + len(name):
            break
        name, end = name + piece.text, end + 1
        closed = (name, end) if depth == 0 else closed
    return lexemes[index]._replace(text=closed[0]), closed[1]


def _probe(lexemes: list[Lexeme], index: int) -> tuple[Lexeme, int] | None:
    """`v ( node )` before an `=`, as one lexeme, and the index of that `=`."""
    end, nodes = index + 2, list[str]()
    while end < len(lexemes) and lexemes[end].kind == "word":
        node, end = _with_brackets(lexemes, end)
        nodes.append(node.text)
    if end + 1 >= len(lexemes) or lexemes[end].kind != ")" or lexemes[end + 1].kind != "=":
        return None
    name = lexemes[index]
    return Lexeme("probe", f"{name.text}({','.join(nodes)})", name.position), end + 1


def _assign(line: Line, inside: Group, key: Lexeme, lexemes: list[Lexeme], equals: int) -> None:
    """Enter the pair `key = value` whose `=` is the lexeme number `equals`."""
    name = key.text.lower()
    if key.kind not in ("word", "probe") or (key.kind == "word" and not _KEY.fullmatch(key.text)):
        problem = f"{line.written(key)} cannot be a parameter's name: letters, digits and _ are allowed"
        raise InputError(problem, line.where(key.position))
    if name in inside.params:
        first = line.where(inside.params[name].key.position)
        raise InputError(f"'{key.text}' is given twice, first at {first}", line.where(key.position))
    value = lexemes[equals + 1] if equals + 1 < len(lexemes) else None
    after = lexemes[equals + 2].kind if equals + 2 < len(lexemes) else ""
    if value is not None and (value.kind == "(" or (after == "(" and value.kind == "word")):
        problem = f"the value of '{key.text}' holds brackets: arithmetic goes in braces, as in {{(a + b)*2}}"
        raise InputError(problem, line.where(value.position))
    if value is None or value.kind in (")", "=") or (after == "=" and value.kind == "word"):
        raise InputError(f"missing value of '{key.text}'", line.where(key.position))
    inside.params[name] = Assignment(key, value)
