"""Reader of netlist files: sorts lines into elements, parameters, subcircuits and directives.

Included files must be in the netlist's own folder.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from fingerspice.base.errors import InputError, Where
from fingerspice.circuit.devices import layer_devices
from fingerspice.netlist.files import MAX_BYTES, NATIVE_LIBRARIES, inside, library_changed, read_text
from fingerspice.netlist.lexer import Group, Lexeme, Line, group, lex, logical_lines, split_lines
from fingerspice.netlist.scope import Formula, param_formulas
from fingerspice.netlist.slips import ELSEWHERE, decimal_comma, greek_mu, nearest

#: Limits of a netlist with its included files: a word takes up to 500 bytes of memory, and a line 200.
MAX_WORDS, MAX_LINES = 1_000_000, 2_000_000
#: Largest number of warnings that are shown.
MAX_WARNINGS = 100
MAX_INCLUDES = 1000
MAX_INCLUDE_DEPTH = 32

#: Directives without effect here: those in UNUSED cause a warning; those in SILENT only matter to other simulators.
UNUSED = (".print", ".plot", ".save", ".probe", ".meas", ".measure", ".title")
SILENT = (".nodeset", ".backanno")
ANALYSES = (".tran", ".ac", ".options", ".option")
STRUCTURE = (".ic", ".param", ".subckt", ".ends", ".include", ".inc", ".lib", ".control", ".end")
DIRECTIVES = (*ANALYSES, *STRUCTURE, *UNUSED, *SILENT, ".endc")


@dataclass(slots=True)
class Subcircuit:
    """The definition of a subcircuit, or, without a name, the deck itself."""

    name: str
    line: Line | None = None
    ports: tuple[str, ...] = ()
    defaults: list[Formula] = field(default_factory=list)
    elements: list[Line] = field(default_factory=list)
    params: list[Formula] = field(default_factory=list)
    starts: list[tuple[Line, int]] = field(default_factory=list)  # .ic lines, and the positions of their arguments
    inner: dict[str, Subcircuit] = field(default_factory=dict)
    skipped: bool = False  # has a native device's name, or is inside such a definition: its body is not read
    called: bool = False
    characters: int = 0  # number of characters of its lines


class Reader:
    """Collects the lines of a deck and of the files it includes.

    Parameters
    ----------
    file : str
        The deck's name as shown to the user.
    path : Path, optional
        The deck's path. Its folder is the only one from which files are included.
    """

    def __init__(self, file: str, path: Path | None) -> None:
        self.file = file
        self.folder = path.parent.resolve() if path is not None else None
        self._top = path.resolve() if path is not None else None
        self.root = Subcircuit("")
        self.analyses: list[tuple[str, Line, int]] = []  # name, line, and position of the arguments
        self.libraries: list[str] = []
        self.files: list[Path] = []
        self.unused: dict[str, None] = {}  # an ordered set
        self.warnings: list[str] = []
        self._open = [self.root]
        self._control: Line | None = None
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
        source = logical_lines(lines[1:], self.file, first=2)
        for line in source:
            if self._take(line, self.folder):
                self._warn_after_end(next(source, None))
                break
        if self._control is not None:
            raise InputError(".control without its .endc", self._control.where(self._control.start))
        if len(self._open) > 1:
            left = self._open[-1]
            raise InputError(f".subckt {left.name} without its .ends", _where(left))

    def warn(self, message: str, where: Where) -> None:
        """Keep a warning with its place, unless there are many already."""
        if len(self.warnings) < MAX_WARNINGS:
            self.warnings.append(f"{where}: {message}")
        elif len(self.warnings) == MAX_WARNINGS:
            self.warnings.append(f"{where}: more warnings than {MAX_WARNINGS}: the others are not shown")

    def _warn_after_end(self, line: Line | None) -> None:
        if line is not None:
            self.warn("text after .end is not read", line.where(line.start))

    def _take(self, line: Line, folder: Path | None) -> bool:
        """Enter one line in its list; returns whether the line ends the deck."""
        start = line.start
        word = line.text[start:].split(None, 1)[0].lower()
        if self._control is not None:
            if word == ".endc":
                self._control = None
            return False
        self._words += line.words(MAX_WORDS)
        if self._words > MAX_WORDS:
            problem = f"the netlist has more than {MAX_WORDS:,} words and brackets; allowed: no more"
            raise InputError(f"{problem}, samples go in by Python: fs.Samples(values, rate)", _place(line))
        for sign, slip in (",", decimal_comma), ("μ", greek_mu):
            note = slip(line.text) if sign in line.text and not self._open[-1].skipped else None
            if note:
                self.warn(note, _place(line))
        if word[0] != ".":
            here = self._open[-1]
            if not here.skipped:
                here.elements.append(line)
                here.characters += len(line.text)
            return False
        word = word.partition("(")[0].partition("=")[0]
        return self._directive(word, line, start + len(word), folder)

    def _directive(self, word: str, line: Line, rest: int, folder: Path | None) -> bool:
        """Enter a directive whose arguments start at position `rest`; returns whether the line ends the deck."""
        here = self._open[-1]
        if word == ".subckt":
            self._open_subcircuit(line, rest)
        elif word == ".ends":
            self._close_subcircuit(line, rest)
        elif word == ".control":
            self._control = line
            self.unused[word] = None
        elif here.skipped:
            pass
        elif word == ".end":
            if self._reading:
                raise InputError("only the netlist itself, not an included file, has .end", _place(line))
            return True
        elif word in (".param", ".params"):
            here.params.extend(param_formulas(line, rest))
            here.characters += len(line.text)
        elif word == ".ic":
            here.starts.append((line, rest))
        elif word in (".include", ".inc", ".lib"):
            self._include(word, line, rest, folder)
        elif word in UNUSED:
            self.unused[word] = None
        elif word in SILENT or (word == ".global" and set(line.text[rest:].lower().split()) <= {"gnd", "0"}):
            pass
        elif word in ANALYSES:
            if here is not self.root:
                opened = f".subckt {here.name}, which begins at {_where(here)}; is its .ends missing"
                raise InputError(f"{word} does not belong inside {opened}?", _place(line))
            self.analyses.append((".options" if word == ".option" else word, line, rest))
        else:
            raise InputError(_unknown_directive(word), _place(line))
        return False

    def _open_subcircuit(self, line: Line, rest: int) -> None:
        around = self._open[-1]
        if around.skipped:
            self._open.append(Subcircuit("", line, skipped=True))
            return
        words = group(line, lex(line, rest), plain=len(line.text))
        names = [word for word in words.words if isinstance(word, Lexeme)]
        names = [word for word in names if word.text.lower() != "params:"]
        if not names or any(word.kind != "word" for word in names):
            raise InputError("write .subckt NAME node node ... key=value ...", _place(line))
        name = names[0].text
        defined = Subcircuit(name, line)
        if name.upper() in layer_devices():
            problem = f"{name.upper()} is a native device: its .subckt is not read"
            self.warn(problem, line.where(names[0].position))
            defined.skipped = True
        else:
            if words.stray is not None:
                problem = f"'{words.stray.text}' follows the parameters: nodes come first"
                raise InputError(problem, line.where(words.stray.position))
            defined.ports = _ports(line, names[1:])
            defined.defaults = _defaults(line, words)
            defined.characters = len(line.text)
            _refuse_second(around, defined)
            around.inner[name.lower()] = defined
        self._open.append(defined)

    def _close_subcircuit(self, line: Line, rest: int) -> None:
        if len(self._open) == 1:
            raise InputError(".ends without a .subckt before it", _place(line))
        closing = self._open.pop()
        name = line.text[rest:].strip()
        if name and closing.name and name.lower() != closing.name.lower():
            raise InputError(f".ends {name} closes .subckt {closing.name}: the names differ", _place(line))

    def _include(self, word: str, line: Line, rest: int, folder: Path | None) -> None:
        name, position = _file_name(word, line, rest)
        where = line.where(position)
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
            self._take(inner, path.parent)
        self._reading.pop()


def _file_name(word: str, line: Line, rest: int) -> tuple[str, int]:
    """The file name on an include line, and its position."""
    raw = line.text[rest:]
    position = rest + len(raw) - len(raw.lstrip())
    name = raw.strip()
    if name[:1] in ("'", '"') and name:
        inner, closed, after = name[1:].partition(name[0])
        if not closed:
            raise InputError(f"{name[0]} is never closed", line.where(position))
        name, words = inner, [inner, *after.split()]
    else:
        words = name.split()
    if not name.strip():
        raise InputError(f"{word} needs a file name", _place(line))
    if len(words) > 1 and word == ".lib":
        problem = "sections of a library are not supported: put the section into a file and .include it"
        raise InputError(problem, line.where(position))
    if len(words) > 1:
        raise InputError("one file name is allowed; put a name with blanks in quotes", line.where(position))
    return name, position


def _ports(line: Line, words: list[Lexeme]) -> tuple[str, ...]:
    ports: dict[str, None] = {}  # an ordered set
    for word in words:
        port = word.text.lower()
        if port in ("0", "gnd"):
            problem = "ground is the same node everywhere and cannot be a subcircuit's node"
            raise InputError(problem, line.where(word.position))
        if port in ports:
            raise InputError(f"node '{word.text}' is given twice", line.where(word.position))
        ports[port] = None
    return tuple(ports)


def _defaults(line: Line, words: Group) -> list[Formula]:
    """Parameters of a .subckt line, with their defaults."""
    found = []
    for key, value in words.params.values():
        if value.kind == "string":
            raise InputError("a number is needed, not a text", line.where(value.position))
        position = value.position + (value.kind != "word")
        found.append(Formula(key.text, value.text, line, key.position, position))
    return found


def _refuse_second(around: Subcircuit, defined: Subcircuit) -> None:
    first = around.inner.get(defined.name.lower())
    if first is not None:
        problem = f"subcircuit '{defined.name}' is defined twice, first at {_where(first)}"
        raise InputError(problem, _where(defined))


def _unknown_directive(word: str) -> str:
    if word == ".endc":
        return ".endc without a .control before it"
    if word in ELSEWHERE:
        return f"{word} is not supported: {ELSEWHERE[word]}"
    known = nearest(word, DIRECTIVES) or f"; directives are {' '.join((*ANALYSES[:-1], *STRUCTURE))}"
    return f"{word} is not supported{known}"


def _place(line: Line) -> Where:
    return line.where(line.start)


def _where(defined: Subcircuit) -> Where | None:
    return _place(defined.line) if defined.line is not None else None
