"""A netlist's words, and their evaluation: numbers, keywords, and expressions of parameters.

Reader of netlist files: sorts lines into elements, parameters, subcircuits and directives.

Included files must be in the netlist's own folder.
"""

from __future__ import annotations

import re
from collections import ChainMap
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import Literal, NamedTuple, TypeAlias

from fingerspice.base.errors import InputError, Where
from fingerspice.base.units import parse_number, suspicious_mega
from fingerspice.circuit.devices import layer_devices
from fingerspice.netlist.expressions import (
    CONSTANTS,
    ELSEWHERE,
    RESERVED,
    Expression,
    Problem,
    compile_expression,
    compiled,
    decimal_comma,
    greek_mu,
    nearest,
)
from fingerspice.netlist.lexer import (
    LIBRARIES,
    MAX_BYTES,
    SPLIT,
    Assignment,
    Group,
    Lexeme,
    Line,
    group,
    inside,
    lex,
    library_changed,
    logical_lines,
    read_text,
    split_lines,
)

_NUMERIC = re.compile(r"[+-]|\.?[0-9]")
_FILE_NAME = re.compile(r".*[/\\].*|.*\.[A-Za-z]\w*")
_PLAIN_NUMBER = re.compile(r"[+-]?[0-9.]+(?:[eE][+-]?[0-9]+)?[A-Za-z]*")
_OF_TIME = re.compile(r"(?<![A-Za-z])(?:t|time)(?![A-Za-z])", re.IGNORECASE)
_OPERATOR = re.compile(r"[-+*/^]")
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
    # The number with a capital M from which the value was computed: M is milli, and perhaps meant as mega
    mega: Token | None = None
    key: Where | None = None  # Place of the key of a `key=value` pair


Value: TypeAlias = Number | Token


class Call(NamedTuple):
    """A word with arguments in brackets: `SIN(0 200 100)` or `SIN (0 200 100)`."""

    text: str  # The word
    args: tuple[Value, ...]
    params: dict[str, Value]  # Values of `key=value` pairs by key in lower case
    where: Where


Word: TypeAlias = Number | Token | Call


class Directive(NamedTuple):
    """A line such as `.tran 10u 50m uic`."""

    name: str  # Name in lower case, with its dot
    args: tuple[Word, ...]
    # Values of `key=value` pairs by key in lower case; `.ic v(area)=1` has the key ``v(area)`` of the flat circuit
    params: dict[str, Value]
    where: Where  # Place of the dot
    text: str  # The line as written, continuations joined


class Statement(NamedTuple):
    """One element of the flat circuit."""

    name: str  # Name as written, with the names of the enclosing calls in front: ``Xfinger.Xgap``
    device: str  # Entry of `DEVICES`
    # Nodes in lower case, ground as ``0``; a node inside a subcircuit has the names of the enclosing calls in front
    nodes: tuple[str, ...]
    node_names: tuple[str, ...]  # The same nodes as written
    body: tuple[Word, ...]  # The words after the nodes; empty for an X
    params: dict[str, Value]  # Values of `key=value` pairs by key in lower case
    where: Where  # Place of the name


class Scope:
    """The parameters of the deck or of one subcircuit call, which also sees those of its callers (`parent`).

    As in ngspice, a name that a subcircuit does not define is looked up in its caller, then in that caller's caller,
    and at last in the deck; the place of the subcircuit's definition does not matter.
    """

    def __init__(self, definitions: Iterable[Assignment], parent: Scope | None = None) -> None:
        self.values: dict[str, float] = {}
        self._visible: ChainMap[str, float] = ChainMap(self.values, *(parent._visible.maps if parent else ()))
        # As in `Number`
        self._mega: ChainMap[str, Token | None] = ChainMap({}, *(parent._mega.maps if parent else ()))
        self._definitions: dict[str, Assignment] = {}
        for definition in definitions:
            key, name = definition.key, definition.key.text.lower()
            if name in RESERVED:
                problem = f"parameter '{key.text}' has the name of a function of ngspice; allowed: another name"
                raise InputError(problem, key.where)
            first = self._definitions.setdefault(name, definition)
            if first is not definition:
                raise InputError(f"parameter '{key.text}' is defined twice, first at {first.key.where}", key.where)

    def preset(self, name: str, number: Number) -> None:
        """Set a parameter to its value in the call, instead of its default."""
        self.values[name] = number.value
        self._mega[name] = number.mega

    def solve(self) -> dict[str, float]:
        """The parameters' values; each definition, in any order, is evaluated after those of the parameters in it."""
        known: dict[str, Expression] = {}
        for root in self._definitions:
            stack = [root]
            while stack:
                name = stack[-1]
                if name in self.values:
                    stack.pop()
                    continue
                text = self._definitions[name].value
                if name not in known:
                    known[name] = compile_expression(text.text, text.place)
                waiting = [n for n in known[name].names if n in self._definitions and n not in self.values]
                if not waiting:
                    self.preset(name, self.number(text))
                elif any(n in known for n in waiting):
                    raise self._circle(known, name)  # a compiled definition without a value is on the stack: a circle
                stack.extend(waiting)
        return self.values

    def _circle(self, known: dict[str, Expression], start: str) -> InputError:
        """The error that names the parameters of a circle; following undefined names from `start` leads into it."""
        order, name = dict[str, None](), start
        while name not in order:
            order[name] = None
            name = next(n for n in known[name].names if n in known and n not in self.values)
        path = list(order)
        path = [*path[path.index(name) :], name]
        shown = [self._definitions[name].key.text for name in path]
        if len(shown) > 12:
            shown[6:-5] = ["..."]
        problem = f"parameters refer to each other in a circle: {' -> '.join(shown)}"
        return InputError(problem, self._definitions[path[0]].key.where)

    def number(self, lexeme: Lexeme) -> Number:
        """Value of a lexeme that must be arithmetic, with or without braces."""
        if lexeme.kind == "string":
            raise InputError(f"a number is needed, not the text {lexeme.written}", lexeme.where)
        expression = compile_expression(lexeme.text, lexeme.place)
        mega = Token(expression.mega[0], lexeme.place(expression.mega[1])) if expression.mega else None
        for name in expression.names:
            mega = mega or self._mega.get(name)
        return Number(expression.evaluate(self._visible, lexeme.place), lexeme.written, lexeme.where, mega)

    def references(self, lexeme: Lexeme) -> dict[str, float]:
        """Values in this scope of the parameters in a lexeme; empty if the lexeme is not arithmetic."""
        return {name: self._visible[name] for name in _names_in(lexeme.text) or () if name in self._visible}

    def value(self, lexeme: Lexeme, bare: Bare = "nothing") -> Value:
        """Number or token of a word, string or expression; `bare` is what is evaluated without braces."""
        text, where = lexeme.text, lexeme.where
        if lexeme.kind == "string":
            return Token(text, where)
        if lexeme.kind == "expression" or (bare == "arithmetic" and _PLAIN_NUMBER.fullmatch(text)):
            return self.number(lexeme)
        if bare != "nothing" and self._is_arithmetic(text):
            if bare == "name" and text.lower() not in self._visible:
                raise InputError(f"arithmetic goes in braces: {{{text}}}", where)
            return self.number(lexeme)
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
        if text.lower() in self._visible:
            return True
        if _OPERATOR.search(text) is None or _PLAIN_NUMBER.fullmatch(text):
            return False
        names = _names_in(text)
        return names is not None and all(name in self._visible or name in CONSTANTS for name in names)

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
                args = tuple(self.value(arg) for arg in word.words if isinstance(arg, Lexeme))
                out.append(Call(word.name.text, args, self.pairs(word), word.name.where))
        return tuple(out)


def _names_in(text: str) -> Mapping[str, int] | None:
    """The names in an expression; None if it is not arithmetic."""
    try:
        return compiled(text).names
    except Problem:
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
            problem = "the name before '=' is missing: write .param name=value (functions are not supported)"
            raise InputError(problem, line.where(match.start()))
    ends = [*(key.position for key, _ in keys), len(line.text)]
    before = line.text[start : ends[0]].strip(" \t,")
    if before or not keys:
        given = f"'{before}'" if before else "nothing"
        raise InputError(f".param is followed by {given}: write .param name=value", line.where(start))
    out = []
    for (key, begin), end in zip(keys, ends[1:], strict=True):
        raw = line.text[begin:end]
        text = raw.strip(" \t,")
        if not text:
            raise InputError(f"missing value of '{key.text}'", key.where)
        value = Lexeme("word", text, begin + len(raw) - len(raw.lstrip(" \t,")), line)
        if text[0] in "{'":
            closing = "}" if text[0] == "{" else "'"
            if len(text) < 2 or text[-1] != closing:
                known = closing in text[1:]
                problem = f"what follows {closing} belongs inside" if known else f"{text[0]} is never closed"
                raise InputError(problem, value.where)
            value = value._replace(kind="expression", text=text[1:-1])
        out.append(Assignment(key, value))
    return out


#: Limits of a netlist with its included files: a word takes up to 500 bytes of memory, and a line 200.
MAX_WORDS, MAX_LINES = 1_000_000, 2_000_000
#: Largest number of warnings that are shown.
MAX_WARNINGS = 100
MAX_INCLUDES = 1000
MAX_INCLUDE_DEPTH = 32

_USED = tuple(".tran .ac .options .ic .param .subckt .ends .include .inc .lib .control .end".split())  # noqa: SIM905
_UNUSED = (".print", ".plot", ".save", ".probe", ".meas", ".measure", ".title")
#: Every directive that may stand in a deck; `Reader._direct` says what is done with it.
DIRECTIVES = (*_USED, ".option", *_UNUSED, ".nodeset", ".backanno", ".endc")


@dataclass
class Deck:
    """A netlist, into which `Reader` and `deck.Flattener` enter what they find."""

    text: str
    path: Path | None  # Path of the file; None for a text
    title: str = ""  # The first line in printable characters (see `errors.printable`)
    statements: list[Statement] = field(default_factory=list)  # In the order of the file, subcircuit calls expanded
    directives: list[Directive] = field(default_factory=list)  # Those with values
    libraries: list[str] = field(default_factory=list)  # Included files of native devices, without folder; not read
    files: list[Path] = field(default_factory=list)  # The other included files, which were read
    unused: dict[str, None] = field(default_factory=dict)  # Ordered set of the directives without effect here
    warnings: list[str] = field(default_factory=list)  # About what is probably not meant, each with its place
    params: dict[str, float] = field(default_factory=dict)  # The deck's own parameters by lower-case name

    @property
    def file(self) -> str:
        """The file's name as shown to the user."""
        return "<netlist>" if self.path is None else str(self.path)

    def named(self, name: str) -> list[Directive]:
        """The directives of that name."""
        return [directive for directive in self.directives if directive.name == name]


class DirectiveLine(NamedTuple):
    """A line that begins with a dot."""

    name: str  # In lower case, with its dot
    line: Line
    rest: int  # Position of the arguments


@dataclass(slots=True)
class Subcircuit:
    """The definition of a subcircuit, or, without a name, the deck itself."""

    name: str
    where: Where  # Place of the definition
    ports: tuple[str, ...] = ()
    defaults: list[Assignment] = field(default_factory=list)
    elements: list[Line] = field(default_factory=list)
    params: list[Assignment] = field(default_factory=list)
    directives: list[DirectiveLine] = field(default_factory=list)  # those with values; only .ic in a subcircuit
    inner: dict[str, Subcircuit] = field(default_factory=dict)
    skipped: bool = False  # has a native device's name, or is inside such a definition: its body is not read
    called: bool = False
    characters: int = 0  # number of characters of its lines


class Reader:
    """Collects the lines of a deck and of the files it includes, which must be in the folder of its path."""

    def __init__(self, deck: Deck) -> None:
        self.deck = deck
        self.root = Subcircuit("", Where(deck.file, 1))
        self._folder = None if deck.path is None else deck.path.parent.resolve()
        self._open = [self.root]
        self._control: Line | None = None
        self._ended = False
        self._reading: list[Path] = []
        self._size = self._lines = self._words = 0

    def split(self, text: str, where: Where | None = None) -> list[str]:
        """Physical lines of the deck or of an included file; refuses more than `MAX_LINES` lines in all."""
        self._lines += 1 + text.count("\n") + text.count("\r")
        if self._lines > MAX_LINES:
            problem = f"the netlist has {self._lines:,} lines; allowed: {MAX_LINES:,}, included files counted"
            raise InputError(problem, where or self.root.where)
        return split_lines(text)

    def read_deck(self, lines: list[str]) -> None:
        """Read the deck's own lines after the title."""
        for line in logical_lines(lines, self.deck.file, first=2):
            if self._ended:
                self.warn("text after .end is not read", line.place)
                break
            self._take(line)
        if self._control is not None:
            raise InputError(".control without its .endc", self._control.place)
        if len(self._open) > 1:
            raise InputError(f".subckt {self._open[-1].name} without its .ends", self._open[-1].where)

    def warn(self, message: str, where: Where) -> None:
        """Keep a warning with its place, unless there are many already."""
        kept = self.deck.warnings
        if len(kept) == MAX_WARNINGS:
            message = f"more warnings than {MAX_WARNINGS}: the others are not shown"
        if len(kept) <= MAX_WARNINGS:
            kept.append(f"{where}: {message}")

    def _take(self, line: Line) -> None:
        """Enter one line in its list."""
        start, here = line.start, self._open[-1]
        word = line.text[start:].split(None, 1)[0].lower()
        if self._control is not None:
            if word == ".endc":
                self._control = None
            return
        self._words += len(line.parts) + sum(1 for _ in islice(SPLIT.finditer(line.text), MAX_WORDS))
        if self._words > MAX_WORDS:
            problem = f"the netlist has more than {MAX_WORDS:,} words and brackets; allowed: no more"
            raise InputError(f"{problem}, samples go in by Python: fs.Samples(values, rate)", line.place)
        for sign, slip in (",", decimal_comma), ("μ", greek_mu):
            note = slip(line.text) if sign in line.text and not here.skipped else None
            if note:
                self.warn(note, line.place)
        if word[0] == ".":
            word = word.partition("(")[0].partition("=")[0]
            # In the body of a definition that is not read, only what gives it its end counts.
            if not here.skipped or word in (".subckt", ".ends", ".control"):
                name = ".param" if word == ".params" else word
                self._direct(DirectiveLine(name, line, start + len(word)))
        elif not here.skipped:
            here.elements.append(line)
            here.characters += len(line.text)

    def _direct(self, read: DirectiveLine) -> None:
        """Do what a directive asks for."""
        here, line, place = self._open[-1], read.line, read.line.place
        name, text = read.name, read.line.text[read.rest :]
        match name:
            case ".tran" | ".ac" | ".option" | ".options" | ".ic":
                if here is not self.root and name != ".ic":
                    opened = f".subckt {here.name}, which begins at {here.where}; is its .ends missing"
                    raise InputError(f"{name} does not belong inside {opened}?", place)
                if name in (".tran", ".ac"):
                    for first in here.directives:
                        if first.name == name:
                            raise InputError(f"{name} is given twice, first at {first.line.place}", place)
                here.directives.append(read._replace(name=".options") if name == ".option" else read)
            case ".param":
                here.params += definitions(line, read.rest)
                here.characters += len(line.text)
            case ".subckt":
                self._open.append(self._subcircuit(read))
            case ".ends":
                if len(self._open) == 1:
                    raise InputError(".ends without a .subckt before it", place)
                closed = self._open.pop().name
                if text.strip() and closed and text.strip().lower() != closed.lower():
                    raise InputError(f".ends {text.strip()} closes .subckt {closed}: the names differ", place)
            case ".include" | ".inc" | ".lib":
                self._include(read)
            case ".control":
                self._control = line
                self.deck.unused[name] = None
            case ".end":
                if self._reading:
                    raise InputError("only the netlist itself, not an included file, has .end", place)
                self._ended = True
            case ".endc":
                raise InputError(".endc without a .control before it", place)
            case _ if name in _UNUSED:
                self.deck.unused[name] = None
            case _ if name in (".nodeset", ".backanno"):
                pass  # These matter only to other simulators.
            case _ if name != ".global" or not set(text.lower().split()) <= {"gnd", "0"}:
                hint = nearest(name, DIRECTIVES) or f"; directives are {' '.join(_USED)}"
                hint = f": {ELSEWHERE[name]}" if name in ELSEWHERE else hint
                raise InputError(f"{name} is not supported{hint}", place)

    def _subcircuit(self, read: DirectiveLine) -> Subcircuit:
        """The subcircuit whose definition begins with a line."""
        around, line = self._open[-1], read.line
        if around.skipped:
            return Subcircuit("", line.place, skipped=True)
        words = group(lex(line, read.rest), plain=len(line.text))
        names = [word for word in words.words if isinstance(word, Lexeme) and word.text.lower() != "params:"]
        if not names or any(word.kind != "word" for word in names):
            raise InputError("write .subckt NAME node node ... key=value ...", line.place)
        name = names[0].text
        if name.upper() in layer_devices():
            self.warn(f"{name.upper()} is a native device: its .subckt is not read", names[0].where)
            return Subcircuit(name, line.place, skipped=True)
        if words.stray is not None:
            raise InputError(f"'{words.stray.text}' follows the parameters: nodes come first", words.stray.where)
        ports: dict[str, None] = {}  # an ordered set
        for word in names[1:]:
            port = word.text.lower()
            if port in ("0", "gnd"):
                raise InputError("ground is the same node everywhere and cannot be a subcircuit's node", word.where)
            if port in ports:
                raise InputError(f"node '{word.text}' is given twice", word.where)
            ports[port] = None
        defaults = list(words.params.values())
        for _, value in defaults:
            if value.kind == "string":
                raise InputError("a number is needed, not a text", value.where)
        defined = Subcircuit(name, line.place, tuple(ports), defaults, characters=len(line.text))
        first = around.inner.setdefault(name.lower(), defined)
        if first is not defined:
            raise InputError(f"subcircuit '{name}' is defined twice, first at {first.where}", defined.where)
        return defined

    def _include(self, read: DirectiveLine) -> None:
        raw = read.line.text[read.rest :]
        where = read.line.where(read.rest + len(raw) - len(raw.lstrip()))
        name = raw.strip()
        words = name.split()
        if name[:1] in ("'", '"') and name:
            inner, closed, after = name[1:].partition(name[0])
            if not closed:
                raise InputError(f"{name[0]} is never closed", where)
            name, words = inner, [inner, *after.split()]
        if not name.strip():
            raise InputError(f"{read.name} needs a file name", read.line.place)
        if len(words) > 1:
            problem = "one file name is allowed; put a name with blanks in quotes"
            if read.name == ".lib":
                problem = "sections of a library are not supported: put the section into a file and .include it"
            raise InputError(problem, where)
        folder = self._reading[-1].parent if self._reading else self._folder
        base = name.replace("\\", "/").rpartition("/")[2]
        if base.lower() in LIBRARIES.values():
            self.deck.libraries.append(base)
            if self._folder is not None and folder is not None and library_changed(self._folder, folder, name):
                problem = "differs from this version's and is not read: the devices are built in here, and only ngspice"
                self.warn(f"'{name}' {problem} would run the changed ones", where)
            return
        if folder is None or self._folder is None or self.deck.path is None:
            raise InputError(f"'{name}' cannot be included: a netlist given as text has no folder to look in", where)
        path = inside(self._folder, folder, name, where)
        if path in (self.deck.path.resolve(), *self._reading):
            raise InputError(f"'{name}' includes itself", where)
        self.deck.files.append(path)
        if len(self.deck.files) > MAX_INCLUDES or len(self._reading) >= MAX_INCLUDE_DEPTH:
            problem = f"too many included files: at most {MAX_INCLUDES}, nested {MAX_INCLUDE_DEPTH} deep"
            raise InputError(problem, where)
        text = read_text(path, name, where, self._folder)
        self._size += len(text)
        if self._size > MAX_BYTES:
            raise InputError(f"the included files are larger than {MAX_BYTES >> 20} MiB in all", where)
        self._reading.append(path)
        shown = str(Path(self.deck.file).parent / path.relative_to(self._folder))
        for line in logical_lines(self.split(text, where), shown):
            self._take(line)
        self._reading.pop()
