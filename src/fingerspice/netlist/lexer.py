"""The text of a netlist's files, divided into logical lines, lexemes and groups, each with its line and column.

Files may be in the netlist's folder; the libraries of native devices are those shipped. Nothing here depends on the
meaning of a word: the callers distinguish names, values and directives.
"""

from __future__ import annotations

import codecs
import re
import sys
from bisect import bisect_right
from collections.abc import Iterator
from contextlib import nullcontext, suppress
from dataclasses import dataclass, field
from encodings import cp1252
from functools import cache
from itertools import chain
from pathlib import Path, PurePath
from typing import NamedTuple

from fingerspice.base.errors import InputError, Where
from fingerspice.netlist.expressions import closest, nearest

#: Libraries with ngspice's subcircuits of the native devices; the included library determines the charge law.
LIBRARIES = {"local": "fingerspice.lib", "mobile": "fingerspice_mobile.lib"}

#: Largest size of a file, and of all the files that a deck's sources name, bytes.
MAX_BYTES, MAX_SOURCE_BYTES = 64 * 2**20, 2**30


@cache
def library_text(law: str) -> str:
    """Text of a charge law's library, from the installed package or the source tree."""
    name = LIBRARIES[law]
    package = Path(__file__).resolve().parents[1]
    for folder in (package / "lib", package.parents[1] / "circuits"):
        path = folder / name
        if path.is_file():
            return path.read_text(encoding="utf-8")
    raise InputError(f"{name} is missing from this installation; reinstall fingerspice")


def read_text(path: Path, shown: str, where: Where | None = None, root: Path | None = None) -> str:
    """Text of a netlist or table in UTF-8, Latin-1, or UTF-16 with a mark.

    `shown` is the path as the user wrote it at the place `where`; files outside the folder `root` are not proposed.
    """
    try:
        if path.is_dir():
            problem = "is a folder, not a file"
        elif not path.exists():
            problem = f"does not exist{_similar_file(path, shown, root)}"
        elif not path.is_file():
            problem = "is not an ordinary file"
        elif path.stat().st_size > MAX_BYTES:
            problem = f"is larger than {MAX_BYTES >> 20} MiB"
        else:
            return _decoded(path.read_bytes(), shown, where)
    except InputError:
        raise
    except (OSError, ValueError) as error:
        problem = f"cannot be read: {_reason(error)}"
    raise InputError(f"'{shown}' {problem}", where)


def _reason(error: Exception) -> str:
    return error.strerror if isinstance(error, OSError) and error.strerror else str(error)


def read_stream(path: Path) -> str | None:
    """Text of a deck from standard input (``-``), a device, or a pipe such as bash's ``<(...)``; None for a file."""
    stream = str(path) in ("-", "/dev/stdin") or path.is_relative_to("/dev/fd")
    with suppress(OSError):
        stream = stream or path.is_fifo() or path.is_char_device()
    if not stream:
        return None
    try:
        with nullcontext(sys.stdin.buffer) if str(path) == "-" else path.open("rb") as source:
            data = source.read(MAX_BYTES + 1)
    except OSError as error:
        raise InputError(f"'{path}' cannot be read: {_reason(error)}") from None
    if len(data) > MAX_BYTES:
        raise InputError(f"'{path}' is larger than {MAX_BYTES >> 20} MiB")
    return _decoded(data, str(path), None)


def _decoded(data: bytes, shown: str, where: Where | None) -> str:
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        # LTspice writes UTF-16 if a name has letters that Latin-1 lacks.
        return data.decode("utf-16", "replace")
    if b"\0" in data:
        raise InputError(f"'{shown}' is not a text file (it holds NUL bytes): save it as UTF-8", where)
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        broken = error.start
    try:
        # LTspice writes its micro sign in the Latin-1 of Windows.
        return cp1252.Codec().decode(data)[0]
    except UnicodeDecodeError:
        number = data[:broken].count(b"\n") + 1
        problem = f"'{shown}' is neither UTF-8 nor Latin-1 text (byte 0x{data[broken]:02x} in line {number})"
        raise InputError(f"{problem}: save it as UTF-8", where) from None


@dataclass
class SourceFiles:
    """Finds the recordings and tables of sources: a deck's in its folder or below, a user's own anywhere."""

    folder: Path | None = None  # Folder of the deck; None for a deck given as text
    # Whether any file may be read, relative to the working directory: for sources given by the user, not by a deck
    anywhere: bool = False
    size: int = 0  # Total size of the files named so far, bytes; a file counts each time that it is named

    def find(self, name: str, where: Where) -> Path:
        """Path of a file named at the place `where`; one outside the folder is refused, and too much in all."""
        try:
            if self.anywhere:
                path = Path(name).expanduser()
            elif self.folder is None:
                raise InputError(f"'{name}' cannot be read: a netlist given as text has no folder to look in", where)
            else:
                # The line may stand in an included file, whose name begins with the deck's folder as the user wrote it.
                folder, root = Path(where.file).parent, self.folder.resolve()
                path = inside(root, folder, name, where)
                if not path.exists():
                    raise InputError(f"'{name}' does not exist{_similar_file(path, name, root)}", where)
                path = folder / name.replace("\\", "/")
            self.size += path.stat().st_size if path.is_file() else 0
        except (OSError, RuntimeError) as error:  # a name that is too long, or the folder of an unknown user
            raise InputError(f"'{name}' cannot be read: {_reason(error)}", where) from None
        if self.size > MAX_SOURCE_BYTES:
            raise InputError(f"the sources' files are larger than {MAX_SOURCE_BYTES >> 20:,} MiB in all", where)
        return path


def library_changed(root: Path, folder: Path, name: str) -> bool:
    """Whether the netlist's folder has a library of that name that differs from this version's."""
    try:
        path = (folder / name.replace("\\", "/")).resolve()
        if not path.is_relative_to(root) or not path.is_file():
            return False
        own = library_text(next(law for law, file in LIBRARIES.items() if file == path.name.lower()))
        # A file of more than four bytes per character cannot be equal, and need not be read.
        if path.stat().st_size > 4 * len(own):
            return True
        text = read_text(path, name)
        read, shipped = ([line.rstrip() for line in split_lines(x.rstrip())] for x in (text, own))
        return read != shipped
    except (OSError, ValueError, RuntimeError):
        # A file that cannot be read is not this version's library.
        return True


def _similar_file(path: Path, shown: str, root: Path | None) -> str:
    """The clause ``; did you mean 'folder/file'?`` for a missing file, or an empty text.

    The search goes through the file's folder or, if that is missing, the folder with the nearest name, and then through
    the parent folder. The proposal is written relative to the same folder as the missing file's name.
    """
    folder, below = path.parent, [path.name]
    while not folder.is_dir() and folder != folder.parent:
        folder, below = folder.parent, [folder.name, *below]
    if root is not None and not folder.is_relative_to(root):
        return ""
    # Use the beginning of `shown`, because `path` may be relative to another folder.
    written = PurePath(shown.replace("\\", "/")).parts[: -len(below)]
    found = _nearest_path(folder, below)
    if found is None and len(below) > 1:
        found = _nearest_path(folder, below[-1:])
    # A library of native devices is built in and need not exist in the folder: propose it, too.
    names = [*([found[-1]] if found else []), *(LIBRARIES.values() if root is not None else ())]
    name = closest(path.name, names)
    if found is not None and name in (found[-1], None):
        return f"; did you mean '{PurePath(*written, *found).as_posix()}'?"
    return nearest(path.name, names)


def _nearest_path(folder: Path, parts: list[str]) -> list[str] | None:
    """A file below a folder, found by the nearest name for each part of its path; None if there is none."""
    found: list[str] = []
    for number, part in enumerate(parts, 1):
        try:
            entries = [e.name for e in folder.joinpath(*found).iterdir() if e.is_dir() == (number < len(parts))]
        except OSError:
            return None
        name = part if part in entries else closest(part, sorted(entries))
        if name is None:
            return None
        found.append(name)
    return found


def inside(root: Path, folder: Path, name: str, where: Where) -> Path:
    """Resolved path of an included file; one outside the netlist's folder is refused."""
    try:
        path = (folder / name.replace("\\", "/")).resolve()
        allowed = path.is_relative_to(root)
    except (OSError, ValueError, RuntimeError):  # RuntimeError: a circle of links
        raise InputError(f"'{name}' is not a usable file name", where) from None
    if not allowed:
        raise InputError(f"'{name}' lies outside the netlist's folder, where nothing is read", where)
    return path


#: As in ngspice a `;`, a `//` after a blank, or a `$` between blanks starts a comment, except in double quotes.
_COMMENT = re.compile(r'"[^"]*"|(;|(?<!\S)//|(?<!\S)\$(?!\S))')
_LEX = re.compile(r"""[\s,]+|([()=])|("[^"]*")|('[^']*')|([^\s,()={}'"]+)""")
#: Pattern of a separator or a mark; their number is an upper bound of the number of words.
SPLIT = re.compile(r"""[\s,]+|[()={}'"]""")
_BRACE = re.compile(r"[{}]")
_MARKS = ("(", ")", "=")
MAX_NAME = 400  # Characters of a name
_KEY = re.compile(r"[A-Za-z_]\w*")
_NUMERIC = re.compile(r"[+-]?\.?[0-9]")


class Line(NamedTuple):
    """A logical line: a physical line without its comment, joined by one space with the `+` lines that continue it."""

    file: str  # The file's name as shown to the user
    text: str
    # Of each physical line: the position of its text, its number, and what a position in it lacks to its column
    parts: tuple[tuple[int, int, int], ...]

    def where(self, position: int) -> Where:
        """Place of one character of the text."""
        _, number, shift = self.parts[bisect_right(self.parts, position, key=lambda part: part[0]) - 1]
        return Where(self.file, number, position + shift)

    @property
    def start(self) -> int:
        """Position of the first character that is not blank."""
        return len(self.text) - len(self.text.lstrip())

    @property
    def place(self) -> Where:
        """Place of the first character that is not blank."""
        return self.where(self.start)


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
    if "\r" in text:
        text = text.replace("\r\n", "\n").replace("\r", "\n")
    return text.split("\n")


def logical_lines(lines: list[str], file: str, first: int = 1) -> Iterator[Line]:
    """Logical lines, without comments and blank lines; `first` is the number of the first physical line."""
    texts, parts, length = list[str](), list[tuple[int, int, int]](), 0
    for number, raw in enumerate(chain(lines, ("after the last line",)), first):
        comment = None
        if ";" in raw or "$" in raw or "//" in raw:
            comment = next((match.start() for match in _COMMENT.finditer(raw) if match[1]), None)
        text = raw[:comment].rstrip()
        bare = text.lstrip()
        if not bare or bare[0] == "*":
            continue
        column = 1
        if bare[0] == "+":
            column += len(text) - len(bare) + 1
            if not texts:
                raise InputError("'+' continues the line before, but there is none", Where(file, number, column - 1))
            text = bare[1:]
        elif texts:
            yield Line(file, " ".join(texts), tuple(parts))
            texts, parts, length = [], [], 0
        texts.append(text)
        parts.append((length, number, column - length))
        length += len(text) + 1


def lex(line: Line, start: int = 0) -> list[Lexeme]:
    """Lexemes of a line from a position on; blanks and commas separate them."""
    text, position = line.text, start
    lexemes: list[Lexeme] = []
    while position < len(text):
        match = _LEX.match(text, position)
        if match is None:
            opening, depth = text[position], 0
            if opening != "{":
                problem = "'}' without an opening '{'" if opening == "}" else f"{opening} is never closed"
                raise InputError(problem, line.where(position))
            for brace in _BRACE.finditer(text, position):
                depth += 1 if brace.group() == "{" else -1
                if depth == 0:
                    break
            if depth != 0:
                raise InputError("'{' is never closed", line.where(position))
            lexemes.append(Lexeme("expression", text[position + 1 : brace.start()], position, line))
            position = brace.end()
            continue
        mark, string, quoted, word = match.groups()
        if mark:
            lexemes.append(Lexeme(mark, mark, position, line))
        elif string or quoted:
            kind, inner = ("string", string) if string else ("expression", quoted)
            lexemes.append(Lexeme(kind, inner[1:-1], position, line))
        elif word:
            if word[0] == "$":
                raise InputError(f"'{word}': a comment after '$' needs a blank between them", line.where(position))
            lexemes.append(Lexeme("word", word, position, line))
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
        probe = _probe(lexemes, index) if probes and following == "(" else None
        if probe is not None or (following == "=" and lexeme.kind not in _MARKS):
            key, equals = probe or (lexeme, after)
            _assign(inside, key, lexemes[equals + 1 : equals + 3])
            index = equals + 2
            continue
        if lexeme.kind == "(":
            brackets.append((lexeme, inside))
        elif lexeme.kind == "=":
            raise InputError("the name before '=' is missing", lexeme.where)
        elif lexeme.kind == ")":
            if not brackets:
                raise InputError("')' without an opening '('", lexeme.where)
            inside = brackets.pop()[1]
        elif following == "(" and lexeme.kind == "word" and not _NUMERIC.match(lexeme.text) and len(top.words) >= plain:
            if inside is not top:
                name = lexeme.text
                problem = f"'{name}(' inside brackets: arithmetic goes in braces, as in {{{name}(...)}}"
                raise InputError(problem, lexeme.where)
            brackets.append((lexemes[after], inside))
            inside = Group(lexeme)
            top.words.append(inside)
            after += 1
        else:
            if inside.params and inside.stray is None:
                inside.stray = lexeme
            inside.words.append(lexeme)
        index = after
    if brackets:
        raise InputError("'(' is never closed", brackets[-1][0].where)
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
    name = key.text.lower()
    if key.kind not in ("word", "probe") or (key.kind == "word" and not _KEY.fullmatch(key.text)):
        problem = f"{key.written} cannot be a parameter's name: letters, digits and _ are allowed"
        raise InputError(problem, key.where)
    if name in inside.params:
        first = inside.params[name].key.where
        raise InputError(f"'{key.text}' is given twice, first at {first}", key.where)
    value = following[0] if following else None
    after = following[1].kind if len(following) > 1 else ""
    if value is not None and (value.kind == "(" or (after == "(" and value.kind == "word")):
        problem = f"the value of '{key.text}' holds brackets: arithmetic goes in braces, as in {{(a + b)*2}}"
        raise InputError(problem, value.where)
    if value is None or value.kind in (")", "=") or (after == "=" and value.kind == "word"):
        raise InputError(f"missing value of '{key.text}'", key.where)
    inside.params[name] = Assignment(key, value)
