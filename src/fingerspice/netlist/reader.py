"""Reader of netlist files: sorts lines into elements, parameters, subcircuits and directives.

Included files must be in the netlist's own folder.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import NamedTuple

from fingerspice.base.errors import InputError, Where
from fingerspice.circuit.devices import layer_devices
from fingerspice.netlist.files import LIBRARIES, MAX_BYTES, inside, library_changed, read_text
from fingerspice.netlist.lexer import SPLIT, Assignment, Lexeme, Line, group, lex, logical_lines, split_lines
from fingerspice.netlist.scope import Directive, Statement, definitions
from fingerspice.netlist.slips import ELSEWHERE, decimal_comma, greek_mu, nearest

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
