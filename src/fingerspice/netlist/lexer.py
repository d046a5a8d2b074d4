"""Text of a netlist divided into logical lines, lexemes and groups, each with its line and column; hints about slips.

Nothing here depends on the meaning of a word: the callers distinguish names, values and directives.
"""

from __future__ import annotations

import itertools
import re
from bisect import bisect_right
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

from fingerspice.base.errors import InputError, Where
from fingerspice.circuit.circuit import nearest as most_alike
from fingerspice.waveforms.waveform import refuse

_LISTS = re.compile(r"\{[^{}]*\}|'[^']*'|\"[^\"]*\"")
_CALL = re.compile(r"\(([^()]*)\)")
_COMMA = re.compile(r"(?<![\w.,])([+-]?[0-9]+),([0-9]+[a-zµμ]*)(?![\w.,])", re.IGNORECASE)
_ASSIGNED = re.compile(rf"=\s*{_COMMA.pattern}", re.IGNORECASE)
NUMBER = re.compile(r"[+-]?\.?[0-9][\w.+-]*")
_UNIT = re.compile(r"(?:[tgkmunpfµμ]|meg|mil)?(?:m|v|a|s|n|f|hz|ohm|ω)?", re.IGNORECASE)
MAX_KNOWN, MAX_COMPARED = 1000, 60  #: Number and length of the words compared, which takes the product of two lengths.


def decimal_comma(text: str) -> str | None:
    """A warning about a comma that is probably meant as a decimal point; None if there is none.

    Commas separate numbers, as in ``SIN(0,200,100)``. A comma is doubtful if blanks separate the other numbers, as in
    ``SIN(0 200 0,1)``, and in ``d=3,5u``.
    """
    bare = _LISTS.sub("x", text)
    found, outside = [_ASSIGNED.search(bare)], _CALL.sub(" ", bare)
    # An element's name and nodes are left out: they may be numbers, and commas may separate them.
    words = outside.split()[1 if outside.lstrip().startswith(".") else 3 :]
    for chunks in ([c for c in words if "=" not in c], *(m[1].split() for m in _CALL.finditer(bare))):
        matches = [_COMMA.fullmatch(chunk) for chunk in chunks]
        others = [c for c, m in zip(chunks, matches, strict=True) if m is None]
        if all(NUMBER.fullmatch(c) or c.isalpha() for c in others) and (others or len(chunks) == len(words) == 1):
            found += matches
    for whole, part in (match.groups() for match in filter(None, found)):
        said = f"{whole},{part} is two numbers, {whole} and {part}, for a comma separates"
        return f"{said}; if it is a decimal comma write {whole}.{part}"
    return None


def is_unit(word: str) -> bool:
    """Whether a word may be a scale, a unit, or both."""
    return _UNIT.fullmatch(word) is not None and word != ""


def closest(word: str, known: Iterable[str]) -> str | None:
    """The known word whose spelling is nearest to `word`, regardless of case; None if none is similar."""
    short = [name for name in itertools.islice(known, MAX_KNOWN) if len(name) <= MAX_COMPARED]
    return None if len(word) > MAX_COMPARED else most_alike(word, short, least=0.6)


def nearest(word: str, known: Iterable[str]) -> str:
    """The clause ``; did you mean 'x'?`` with the closest known word, or an empty text."""
    found = closest(word, known)
    return f"; did you mean '{found}'?" if found is not None else ""


#: As in ngspice a `;`, a `//` after a blank, or a `$` between blanks starts a comment, except in double quotes.
_COMMENT = re.compile(r'"[^"]*"|(;|(?<!\S)//|(?<!\S)\$(?!\S))')
_LEX = re.compile(r"""[\s,]+|([()=])|("[^"]*")|('[^']*')|([^\s,()={}'"]+)""")
SPLIT = re.compile(r"""[\s,]+|[()={}'"]""")  #: A separator or a mark: there are no more words than these.
_BRACE = re.compile(r"[{}]")
MAX_NAME = 400  # Characters of a name
_KEY = re.compile(r"[A-Za-z_]\w*")
_NUMERIC = re.compile(r"[+-]?\.?[0-9]")


class Line(NamedTuple):
    """A logical line: a physical line without its comment, joined by one space with the `+` lines that continue it."""

    file: str  # The file's name as shown to the user
    text: str  # From the first character that is not blank
    parts: tuple[tuple[int, int, int], ...]  # Of each physical line: position of its text, number, column less position

    def where(self, position: int = 0) -> Where:
        """Place of one character of the text."""
        _, number, shift = self.parts[bisect_right(self.parts, position, key=lambda part: part[0]) - 1]
        return Where(self.file, number, position + shift)


class Lexeme(NamedTuple):
    """A piece of a line."""

    kind: str  # word, expression, string, probe, or one of ( ) =
    text: str  # without the braces or quotes
    position: int
    line: Line

    @property
    def where(self) -> Where:
        """Place of the first character."""
        return self.line.where(self.position)

    def place(self, offset: int) -> Where:
        """Place of one character of the text."""
        return self.line.where(self.position + (self.kind in ("expression", "string")) + offset)

    @property
    def written(self) -> str:
        """The text with its braces or quotes."""
        marks = 2 * (self.kind in ("expression", "string"))
        return self.line.text[self.position : self.position + len(self.text) + marks]


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
    return text.replace("\r\n", "\n").replace("\r", "\n").split("\n")


def logical_lines(lines: list[str], file: str, first: int = 1) -> Iterator[Line]:
    """Logical lines, without comments and blank lines; `first` is the number of the first physical line."""
    texts, parts, length = list[str](), list[tuple[int, int, int]](), 0
    for number, raw in enumerate(itertools.chain(lines, ("after the last line",)), first):
        comment = None
        if ";" in raw or "$" in raw or "//" in raw:
            comment = next((match.start() for match in _COMMENT.finditer(raw) if match[1]), None)
        text = raw[:comment].rstrip()
        bare = text.lstrip()
        if not bare or bare[0] == "*":
            continue
        column = 1 + len(text) - len(bare)
        if bare[0] == "+":
            refuse(not texts, "'+' continues the line before, but there is none", Where(file, number, column))
            column, bare = column + 1, bare[1:]
        elif texts:
            yield Line(file, " ".join(texts), tuple(parts))
            texts, parts, length = [], [], 0
        texts.append(bare)
        parts.append((length, number, column - length))
        length += len(bare) + 1


def lex(line: Line, start: int = 0) -> list[Lexeme]:
    """Lexemes of a line from a position on; blanks and commas separate them."""
    text, position, lexemes = line.text, start, list[Lexeme]()
    while position < len(text):
        match = _LEX.match(text, position)
        if match is None:
            opening, depth = text[position], 0
            problem = "'}' without an opening '{'" if opening == "}" else f"{opening} is never closed"
            refuse(opening != "{", problem, line.where(position))
            for brace in _BRACE.finditer(text, position):
                depth += 1 if brace.group() == "{" else -1
                if depth == 0:
                    break
            refuse(depth != 0, "'{' is never closed", line.where(position))
            lexemes.append(Lexeme("expression", text[position + 1 : brace.start()], position, line))
            position = brace.end()
            continue
        mark, string, quoted, word = match.groups()
        if word and word[0] == "$":
            raise InputError(f"'{word}': a comment after '$' needs a blank between them", line.where(position))
        if mark or word:
            lexemes.append(Lexeme(mark or "word", mark or word, position, line))
        elif string or quoted:
            lexemes.append(Lexeme("string" if string else "expression", (string or quoted)[1:-1], position, line))
        position = match.end()
    return lexemes


def group(lexemes: list[Lexeme], plain: int = 0, *, probes: bool = False) -> Group:
    """Sort the lexemes after a line's first word into words, calls and `key=value` pairs.

    The first `plain` words are nodes, which may stand in brackets without being calls. With `probes`, `v(node)=value`
    is a pair with the key ``v(node)``.
    """
    top = Group()
    inside, brackets = top, list[tuple[Lexeme, Group]]()
    index, count = 0, len(lexemes)
    while index < count:
        lexeme, after = lexemes[index], index + 1
        if len(top.words) < plain and lexeme.kind == "word":
            lexeme, after = _with_brackets(lexemes, index)
        following = lexemes[after].kind if after < count else ""
        probe = _probe(lexemes, index) if probes and following == "(" and not _NUMERIC.match(lexeme.text) else None
        if probe is not None or (following == "=" and lexeme.kind not in ("(", ")", "=")):
            key, equals = probe or (lexeme, after)
            _assign(inside, key, lexemes[equals + 1 : equals + 3])
            index = equals + 2
            continue
        if lexeme.kind == "(":
            brackets.append((lexeme, inside))
        elif lexeme.kind == "=":
            raise InputError("the name before '=' is missing", lexeme.where)
        elif lexeme.kind == ")":
            refuse(not brackets, "')' without an opening '('", lexeme)
            inside = brackets.pop()[1]
        elif following == "(" and lexeme.kind == "word" and not _NUMERIC.match(lexeme.text) and len(top.words) >= plain:
            problem = f"'{lexeme.text}(' inside brackets: arithmetic goes in braces, as in {{{lexeme.text}(...)}}"
            refuse(inside is not top, problem, lexeme)
            brackets.append((lexemes[after], inside))
            inside = Group(lexeme)
            top.words.append(inside)
            after += 1
        else:
            if inside.params and inside.stray is None:
                inside.stray = lexeme
            inside.words.append(lexeme)
        index = after
    refuse(brackets, "'(' is never closed", brackets[-1][0] if brackets else None)
    return top


def _with_brackets(lexemes: list[Lexeme], index: int) -> tuple[Lexeme, int]:
    """A word with the brackets and words that touch it, as in KiCad's `Net-(C1-Pad1)`, and the index after it."""
    name, end, depth = lexemes[index].text, index + 1, 0
    closed = name, end
    while end < len(lexemes) and len(name) <= MAX_NAME and lexemes[end].kind in ("(", ")", "word"):
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
    if [lexeme.kind for lexeme in lexemes[end : end + 2]] != [")", "="]:
        return None
    name = lexemes[index]
    return name._replace(kind="probe", text=f"{name.text}({','.join(nodes)})"), end + 1


def _assign(inside: Group, key: Lexeme, following: list[Lexeme]) -> None:
    """Enter the pair `key = value`, given up to two of the lexemes after its `=`."""
    name, place, problem = key.text.lower(), key, ""
    kinds = [lexeme.kind for lexeme in following]
    if key.kind not in ("word", "probe") or (key.kind == "word" and not _KEY.fullmatch(key.text)):
        problem = f"{key.written} cannot be a parameter's name: letters, digits and _ are allowed"
    elif name in inside.params:
        problem = f"'{key.text}' is given twice, first at {inside.params[name].key.where}"
    elif kinds[:1] == ["("] or kinds == ["word", "("]:
        problem = f"the value of '{key.text}' holds brackets: arithmetic goes in braces, as in {{(a + b)*2}}"
        place = following[0]
    elif not kinds or kinds[0] in (")", "=") or kinds == ["word", "="]:
        problem = f"missing value of '{key.text}'"
    refuse(problem, problem, place)
    inside.params[name] = Assignment(key, following[0])
