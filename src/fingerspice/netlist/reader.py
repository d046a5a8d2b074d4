"""Reader of netlist files: sorts lines into elements, parameters, subcircuits and directives.

Included files must be in the netlist's own folder.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from fingerspice.base.errors import InputError, Where
from fingerspice.circuit.devices import layer_devices
from fingerspice.netlist.files import MAX_BYTES, NATIVE_LIBRARIES, inside, library_changed, read_text
from fingerspice.netlist.lexer import Assignment, Lexeme, Line, group, lex, logical_lines, split_lines
from fingerspice.netlist.scope import definitions
from fingerspice.netlist.slips import ELSEWHERE, decimal_comma, greek_mu, nearest

#: Limits of a netlist with its included files: a word takes up to 500 bytes of memory, and a line 200.
MAX_WORDS, MAX_LINES = 1_000_000, 2_000_000
#: Largest number of warnings that are shown.
MAX_WARNINGS = 100
MAX_INCLUDES = 1000
MAX_INCLUDE_DEPTH = 32


class DirectiveLine(NamedTuple):
    """A line that begins with a dot."""

    name: str  # In lower case, with its dot
    line: Line
    rest: int  # Position of the arguments

    @property
    def text(self) -> str:
        """The arguments as written."""
        return self.line.text[self.rest :]


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
    """Collects the lines of a deck and of the files it includes.

    `file` is the deck's name as shown to the user. Files are included from the folder of its `path` only.
    """

    def __init__(self, file: str, path: Path | None) -> None:
        self.file = file
        self.folder = path.parent.resolve() if path is not None else None
        self._top = path.resolve() if path is not None else None
        self.root = Subcircuit("", Where(file, 1))
        self.libraries: list[str] = []
        self.files: list[Path] = []
        self.unused: dict[str, None] = {}  # an ordered set
        self.warnings: list[str] = []
        self._open = [self.root]
        self._control: Line | None = None
        self._ended = False
        self._reading: list[Path] = []
        self._size = 0
        self._lines = 0
        self._words = 0

    def split(self, text: str, where: Where | None = None) -> list[str]:
        """Physical lines of the deck or of an included file; refuses more than `MAX_LINES` lines in all."""
        self._lines += 1 + text.count("\n") + text.count("\r")
        if self._lines > MAX_LINES:
            problem = f"the netlist has {self._lines:,} lines; allowed: {MAX_LINES:,}, included files counted"
            raise InputError(problem, where or Where(self.file, 1))
        return split_lines(text)

    def read_deck(self, lines: list[str]) -> None:
        """Read the deck's own lines after the first, which is the title."""
        for line in logical_lines(lines[1:], self.file, first=2):
            if self._ended:
                self.warn("text after .end is not read", line.place)
                break
            self._take(line)
        if self._control is not None:
            raise InputError(".control without its .endc", self._control.place)
        if len(self._open) > 1:
            left = self._open[-1]
            raise InputError(f".subckt {left.name} without its .ends", left.where)

    def warn(self, message: str, where: Where) -> None:
        """Keep a warning with its place, unless there are many already."""
        if len(self.warnings) < MAX_WARNINGS:
            self.warnings.append(f"{where}: {message}")
        elif len(self.warnings) == MAX_WARNINGS:
            self.warnings.append(f"{where}: more warnings than {MAX_WARNINGS}: the others are not shown")

    def _take(self, line: Line) -> None:
        """Enter one line in its list."""
        start, here = line.start, self._open[-1]
        word = line.text[start:].split(None, 1)[0].lower()
        if self._control is not None:
            if word == ".endc":
                self._control = None
            return
        self._words += line.words(MAX_WORDS)
        if self._words > MAX_WORDS:
            problem = f"the netlist has more than {MAX_WORDS:,} words and brackets; allowed: no more"
            raise InputError(f"{problem}, samples go in by Python: fs.Samples(values, rate)", line.place)
        for sign, slip in (",", decimal_comma), ("μ", greek_mu):
            note = slip(line.text) if sign in line.text and not here.skipped else None
            if note:
                self.warn(note, line.place)
        if word[0] == ".":
            word = word.partition("(")[0].partition("=")[0]
            read = DirectiveLine(_ALIASES.get(word, word), line, start + len(word))
            if not here.skipped or word in _OF_STRUCTURE:
                DIRECTIVES.get(read.name, Reader._refuse)(self, read)
        elif not here.skipped:
            here.elements.append(line)
            here.characters += len(line.text)

    # What is done with a directive, by its name in DIRECTIVES

    def _open_subcircuit(self, read: DirectiveLine) -> None:
        around, line = self._open[-1], read.line
        if around.skipped:
            self._open.append(Subcircuit("", line.place, skipped=True))
            return
        words = group(lex(line, read.rest), plain=len(line.text))
        names = [word for word in words.words if isinstance(word, Lexeme) and word.text.lower() != "params:"]
        if not names or any(word.kind != "word" for word in names):
            raise InputError("write .subckt NAME node node ... key=value ...", line.place)
        name = names[0].text
        defined = Subcircuit(name, line.place)
        if name.upper() in layer_devices():
            self.warn(f"{name.upper()} is a native device: its .subckt is not read", names[0].where)
            defined.skipped = True
        else:
            if words.stray is not None:
                raise InputError(f"'{words.stray.text}' follows the parameters: nodes come first", words.stray.where)
            defined.ports = _ports(names[1:])
            defined.defaults = list(words.params.values())
            for _, value in defined.defaults:
                if value.kind == "string":
                    raise InputError("a number is needed, not a text", value.where)
            defined.characters = len(line.text)
            first = around.inner.setdefault(name.lower(), defined)
            if first is not defined:
                raise InputError(f"subcircuit '{name}' is defined twice, first at {first.where}", defined.where)
        self._open.append(defined)

    def _close_subcircuit(self, read: DirectiveLine) -> None:
        if len(self._open) == 1:
            raise InputError(".ends without a .subckt before it", read.line.place)
        closing, name = self._open.pop(), read.text.strip()
        if name and closing.name and name.lower() != closing.name.lower():
            raise InputError(f".ends {name} closes .subckt {closing.name}: the names differ", read.line.place)

    def _begin_control(self, read: DirectiveLine) -> None:
        self._control = read.line
        self.unused[read.name] = None

    def _end(self, read: DirectiveLine) -> None:
        if self._reading:
            raise InputError("only the netlist itself, not an included file, has .end", read.line.place)
        self._ended = True

    def _define(self, read: DirectiveLine) -> None:
        self._open[-1].params.extend(definitions(read.line, read.rest))
        self._open[-1].characters += len(read.line.text)

    def _keep(self, read: DirectiveLine) -> None:
        here = self._open[-1]
        if here is not self.root and read.name != ".ic":
            opened = f".subckt {here.name}, which begins at {here.where}; is its .ends missing"
            raise InputError(f"{read.name} does not belong inside {opened}?", read.line.place)
        first = next((one for one in here.directives if one.name == read.name), None) if read.name in _ONCE else None
        if first is not None:
            raise InputError(f"{read.name} is given twice, first at {first.line.place}", read.line.place)
        here.directives.append(read._replace(name=".options") if read.name == ".option" else read)

    def _leave_unused(self, read: DirectiveLine) -> None:
        self.unused[read.name] = None

    def _pass_over(self, read: DirectiveLine) -> None:
        """A directive that only matters to other simulators."""

    def _refuse(self, read: DirectiveLine) -> None:
        word = read.name
        if word == ".global" and set(read.text.lower().split()) <= {"gnd", "0"}:
            return
        if word == ".endc":
            problem = ".endc without a .control before it"
        elif word in ELSEWHERE:
            problem = f"{word} is not supported: {ELSEWHERE[word]}"
        else:
            without_effect = (Reader._leave_unused, Reader._pass_over, Reader._refuse)
            used = [name for name, done in DIRECTIVES.items() if done not in without_effect and name != ".option"]
            known = nearest(word, DIRECTIVES) or f"; directives are {' '.join(used)}"
            problem = f"{word} is not supported{known}"
        raise InputError(problem, read.line.place)

    def _include(self, read: DirectiveLine) -> None:
        name, where = _file_name(read)
        folder = self._reading[-1].parent if self._reading else self.folder
        base = name.replace("\\", "/").rpartition("/")[2]
        if base.lower() in NATIVE_LIBRARIES:
            self.libraries.append(base)
            if self.folder is not None and folder is not None and library_changed(self.folder, folder, name):
                self.warn(
                    f"'{name}' differs from this version's and is not read: the devices are built in here, and only "
                    "ngspice would run the changed ones",
                    where,
                )
            return
        if folder is None or self.folder is None:
            problem = f"'{name}' cannot be included: a netlist given as text has no folder to look in"
            raise InputError(problem, where)
        path = inside(self.folder, folder, name, where)
        if path == self._top or path in self._reading:
            raise InputError(f"'{name}' includes itself", where)
        self.files.append(path)
        if len(self.files) > MAX_INCLUDES or len(self._reading) >= MAX_INCLUDE_DEPTH:
            problem = f"too many included files: at most {MAX_INCLUDES}, nested {MAX_INCLUDE_DEPTH} deep"
            raise InputError(problem, where)
        text = read_text(path, name, where, self.folder)
        self._size += len(text)
        if self._size > MAX_BYTES:
            raise InputError(f"the included files are larger than {MAX_BYTES >> 20} MiB in all", where)
        self._reading.append(path)
        shown = str(Path(self.file).parent / path.relative_to(self.folder))
        for inner in logical_lines(self.split(text, where), shown):
            self._take(inner)
        self._reading.pop()


#: Every directive that may stand in a deck, with what is done with it.
DIRECTIVES: Mapping[str, Callable[[Reader, DirectiveLine], None]] = {
    **dict.fromkeys((".tran", ".ac", ".options", ".option", ".ic"), Reader._keep),
    ".param": Reader._define,
    ".subckt": Reader._open_subcircuit,
    ".ends": Reader._close_subcircuit,
    **dict.fromkeys((".include", ".inc", ".lib"), Reader._include),
    ".control": Reader._begin_control,
    ".end": Reader._end,
    **dict.fromkeys((".print", ".plot", ".save", ".probe", ".meas", ".measure", ".title"), Reader._leave_unused),
    **dict.fromkeys((".nodeset", ".backanno"), Reader._pass_over),
    ".endc": Reader._refuse,  # where no .control is open
}
#: Directives that count also in the body of a definition that is not read.
_OF_STRUCTURE = (".subckt", ".ends", ".control")
_ALIASES = {".params": ".param"}
_ONCE = (".tran", ".ac")


def _file_name(read: DirectiveLine) -> tuple[str, Where]:
    """The file name on an include line, and its place."""
    raw = read.text
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
    return name, where


def _ports(words: list[Lexeme]) -> tuple[str, ...]:
    ports: dict[str, None] = {}  # an ordered set
    for word in words:
        port = word.text.lower()
        if port in ("0", "gnd"):
            problem = "ground is the same node everywhere and cannot be a subcircuit's node"
            raise InputError(problem, word.where)
        if port in ports:
            raise InputError(f"node '{word.text}' is given twice", word.where)
        ports[port] = None
    return tuple(ports)
