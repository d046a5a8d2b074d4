"""Files of a netlist, and its lines sorted into elements, parameters, subcircuits and directives.

Files may be in the netlist's own folder; the libraries of native devices are those shipped.
"""

from __future__ import annotations

import codecs
import re
import sys
import tomllib
from collections import defaultdict
from collections.abc import Iterable, Mapping
from contextlib import nullcontext, suppress
from dataclasses import dataclass, field
from encodings import cp1252
from functools import cache
from itertools import islice
from pathlib import Path, PurePath
from typing import Any, NamedTuple

from fingerspice.base.errors import InputError, Where
from fingerspice.circuit.circuit import Tran
from fingerspice.circuit.devices import called_devices
from fingerspice.netlist import lexer
from fingerspice.netlist.expressions import Call, DeckFunction, Value, Word, definition_of, definitions
from fingerspice.netlist.lexer import Assignment, Lexeme, Line, decimal_comma, group, lex, logical_lines, nearest
from fingerspice.waveforms.files import file_fault
from fingerspice.waveforms.waveform import refuse

#: Libraries with ngspice's subcircuits of the native devices; the included library determines the charge law.
LIBRARIES = {"local": "fingerspice.lib", "mobile": "fingerspice_mobile.lib"}

MAX_BYTES, MAX_SOURCE_BYTES = 64 * 2**20, 2**30  #: Of a file, and of all the files that a deck's sources name.


@cache
def shipped_text(name: str) -> str:
    """Text of a charge law's library, or of a file of `circuits`, from the installed package or the source tree."""
    name = LIBRARIES.get(name, name)
    package = Path(__file__).resolve().parents[1]
    for folder in (package / "lib", package.parents[1] / "circuits"):
        if (path := folder / name).is_file():
            return path.read_text(encoding="utf-8")
    raise InputError(f"{name} is missing from this installation; reinstall fingerspice")


def read_text(path: Path, shown: str, where: Where | None = None, root: Path | None = None) -> str:
    """Text of a netlist or table in UTF-8, Latin-1, or UTF-16 with a mark.

    `shown` is the path as the user wrote it at the place `where`; files outside the folder `root` are not proposed.
    """
    if not (fault := file_fault(path, MAX_BYTES)):
        return _decoded(path.read_bytes(), shown, where)
    hint = _similar_file(path, shown, root) if fault == "does not exist" else ""
    raise InputError(f"'{shown}' {fault}{hint}", where)


def text_of(path: Path) -> tuple[str, Path]:
    """Text and path of a deck; standard input (``-``), a device or a pipe such as ``<(...)`` has the path ``stdin``."""
    stream = str(path) in ("-", "/dev/stdin") or path.is_relative_to("/dev/fd")
    with suppress(OSError):
        stream = stream or path.is_fifo() or path.is_char_device()
    if not stream:
        return read_text(path, str(path)), path
    try:
        with nullcontext(sys.stdin.buffer) if str(path) == "-" else path.open("rb") as source:
            data = source.read(MAX_BYTES + 1)
    except OSError as error:
        raise InputError(f"'{path}' cannot be read: {error.strerror or error}") from None
    refuse(len(data) > MAX_BYTES, f"'{path}' is larger than {MAX_BYTES >> 20} MiB")
    return _decoded(data, str(path), None), Path("stdin")


def _decoded(data: bytes, shown: str, where: Where | None) -> str:
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return data.decode("utf-16", "replace")  # LTspice writes UTF-16 if a name has letters that Latin-1 lacks.
    refuse(b"\0" in data, f"'{shown}' is not a text file (it holds NUL bytes): save it as UTF-8", where)
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        broken = error.start
    try:
        return cp1252.Codec().decode(data)[0]  # LTspice writes its micro sign in the Latin-1 of Windows.
    except UnicodeDecodeError:
        number = data[:broken].count(b"\n") + 1
        problem = f"'{shown}' is neither UTF-8 nor Latin-1 text (byte 0x{data[broken]:02x} in line {number})"
        raise InputError(f"{problem}: save it as UTF-8", where) from None


@dataclass
class Context:
    """What a source may refer to: the .tran line, and files, a deck's in its folder or below, a user's own anywhere."""

    tran: Tran | None  # On whose times SPICE's defaults depend
    folder: Path | None = None  # Folder of the deck; None for a deck given as text
    in_deck: bool = True  # Whether the source stands in a deck, which a SPICE may read, too
    models: Mapping[str, Call] = field(default_factory=dict)  # By name in lower case
    warmer: float = 0.0  # Than the temperature at which values are meant, K
    anywhere: bool = False  # Whether any file may be read, relative to the working directory: for a user's own sources
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
            raise InputError(f"'{name}' cannot be read: {getattr(error, 'strerror', None) or error}", where) from None
        most = f"{MAX_SOURCE_BYTES >> 20:,} MiB"
        refuse(self.size > MAX_SOURCE_BYTES, f"the sources' files are larger than {most} in all", where)
        return path


def library_changed(root: Path, folder: Path, name: str) -> bool:
    """Whether the netlist's folder has a library of that name that differs from this version's."""
    try:
        path = (folder / name.replace("\\", "/")).resolve()
        if not path.is_relative_to(root) or not path.is_file():
            return False
        own = shipped_text(path.name.lower())
        lines = ([line.rstrip() for line in lexer.split_lines(x.rstrip())] for x in (read_text(path, name), own))
        return next(lines) != next(lines)
    except (OSError, ValueError, RuntimeError):
        return True  # A file that cannot be read is not this version's library.


def _similar_file(path: Path, shown: str, root: Path | None) -> str:
    """The clause ``; did you mean 'folder/file'?`` for a missing file, written as its name is, or an empty text.

    The search goes through the file's folder, or else that with the nearest name, and then through the parent folder.
    """
    folder, below = path.parent, [path.name]
    while not folder.is_dir() and folder != folder.parent:
        folder, below = folder.parent, [folder.name, *below]
    if root is not None and not folder.is_relative_to(root):
        return ""
    # Use the beginning of `shown`, because `path` may be relative to another folder.
    written = PurePath(shown.replace("\\", "/")).parts[: -len(below)]
    found = _nearest_path(folder, below) or _nearest_path(folder, below[-1:])
    # A library of native devices is built in and need not exist in the folder: propose it, too.
    names = [*([found[-1]] if found else []), *(LIBRARIES.values() if root is not None else ())]
    if found is not None and lexer.closest(path.name, names) in (found[-1], None):
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
        name = part if part in entries else lexer.closest(part, sorted(entries))
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
    refuse(not allowed, f"'{name}' lies outside the netlist's folder, where nothing is read", where)
    return path


_GREEK_MU = re.compile(r"(?<![\w.])([0-9.]+(?:e[+-]?[0-9]+)?)μ", re.IGNORECASE)
#: What only other simulators know: directives, each with the alternative here, elements, words of .tran, options.
OTHERS = tomllib.loads(Path(__file__).with_name("elsewhere.toml").read_text(encoding="utf-8"))
ELSEWHERE: Mapping[str, str] = OTHERS["directives"]
MAX_WORDS, MAX_LINES = 1_000_000, 2_000_000  #: Of all files: a word takes up to 500 bytes of memory, and a line 200.
MAX_WARNINGS = 100  #: Largest number of warnings that are shown.
MAX_INCLUDES = 1000
MAX_INCLUDE_DEPTH = 32

_USED = (
    ".tran", ".ac", ".op", ".dc", ".step", ".meas", ".measure", ".four", ".save", ".probe", ".print", ".options", ".ic",
    ".param", ".func", ".global", ".subckt", ".ends", ".include", ".inc", ".lib", ".endl", ".model", ".temp",
    ".control", ".end",
)  # fmt: skip
_UNUSED = (".plot", ".title")
#: Every directive that may stand in a deck; `Deck._direct` says what is done with it.
DIRECTIVES = (*_USED, ".option", *_UNUSED, ".nodeset", ".backanno", ".endc")


class Statement(NamedTuple):
    """One element of the flat circuit."""

    name: str  # Name as written, with the names of the enclosing calls in front: ``Xfinger.Xgap``
    device: str  # Entry of `DEVICES`
    nodes: tuple[str, ...]  # In lower case, ground as ``0``; inside a subcircuit with the enclosing calls in front
    node_names: tuple[str, ...]  # The same nodes as written
    body: tuple[Word, ...]  # The words after the nodes; empty for an X
    params: dict[str, Value]  # Values of `key=value` pairs by key in lower case
    where: Where  # Place of the name
    control: tuple[str, ...] = ()  # Nodes or elements that control it, in lower case


@dataclass(slots=True)
class Subcircuit:
    """The definition of a subcircuit, or, without a name, the deck itself."""

    name: str
    where: Where  # Place of the definition
    ports: tuple[str, ...] = ()
    defaults: list[Assignment] = field(default_factory=list)
    elements: list[Line] = field(default_factory=list)
    params: list[Assignment] = field(default_factory=list)
    # Those with values, in a subcircuit only .ic: name in lower case with its dot, and the position of the arguments
    directives: list[tuple[str, Line, int]] = field(default_factory=list)
    inner: dict[str, Subcircuit] = field(default_factory=dict)
    skipped: bool = False  # has a native device's name, or is inside such a definition: its body is not read
    called: bool = False
    characters: int = 0  # number of characters of its lines


@dataclass
class Deck:
    """A netlist: its lines, and those of the files that it includes from the folder of its path, sorted."""

    text: str
    path: Path | None  # Path of the file; None for a text
    title: str = ""  # The first line in printable characters (see `errors.printable`)
    statements: list[Statement] = field(default_factory=list)  # In the order of the file, subcircuit calls expanded
    directives: dict[str, list[Call]] = field(default_factory=lambda: defaultdict(list))  # Those with values, by name
    libraries: list[str] = field(default_factory=list)  # Included files of native devices, without folder; not read
    files: list[Path] = field(default_factory=list)  # The other included files, which were read
    unused: dict[str, None] = field(default_factory=dict)  # Ordered set of the directives without effect here
    warnings: list[str] = field(default_factory=list)  # About what is probably not meant, each with its place
    params: dict[str, Any] = field(default_factory=dict)  # The deck's own parameters and functions, as a scope has them
    # Names of the lines that ask for something of the whole deck, these, and where their arguments begin
    asked: list[tuple[str, Line, int]] = field(default_factory=list)
    functions: dict[str, DeckFunction] = field(default_factory=dict)  # Those of `.func` by name in lower case
    shared: dict[str, str] = field(default_factory=dict)  # Nodes of `.global`, as written, by name in lower case

    def __post_init__(self) -> None:
        self.root = Subcircuit("", Where(self.file, 1))
        self._folder = None if self.path is None else self.path.parent.resolve()
        self._open = [self.root]
        self._control: Line | None = None
        self._ended = False
        self._reading: list[Path] = []
        self._size = self._lines = self._words = 0
        self.names: dict[str, Where] = {}  # Place of each element, by its name in lower case
        self.expanded = self.expanded_text = 0  # Lines and characters of the subcircuit calls expanded

    @property
    def file(self) -> str:
        """The file's name as shown to the user."""
        return "<netlist>" if self.path is None else str(self.path)

    def split(self, text: str, where: Where | None = None) -> list[str]:
        """Physical lines of the deck or of an included file; refuses more than `MAX_LINES` lines in all."""
        self._lines += 1 + text.count("\n") + text.count("\r")
        problem = f"the netlist has {self._lines:,} lines; allowed: {MAX_LINES:,}, included files counted"
        refuse(self._lines > MAX_LINES, problem, where or self.root.where)
        return lexer.split_lines(text)

    def read_lines(self, lines: list[str]) -> None:
        """Read the deck's own lines after the title."""
        for line in logical_lines(lines, self.file, first=2):
            if self._ended:
                self.warn("text after .end is not read", line.where())
                break
            self._take(line)
        if self._control is not None:
            raise InputError(".control without its .endc", self._control.where())
        refuse(len(self._open) > 1, f".subckt {self._open[-1].name} without its .ends", self._open[-1])

    def warn(self, message: str, where: Where) -> None:
        """Keep a warning with its place, unless there are many already."""
        kept = self.warnings
        if len(kept) == MAX_WARNINGS:
            message = f"more warnings than {MAX_WARNINGS}: the others are not shown"
        if len(kept) <= MAX_WARNINGS:
            kept.append(f"{where}: {message}")

    def _take(self, line: Line) -> None:
        """Enter one line in its list."""
        here, word = self._open[-1], line.text.split(None, 1)[0].lower()
        if self._control is not None:
            if word == ".endc":
                self._control = None
            return
        self._words += len(line.parts) + sum(1 for _ in islice(lexer.SPLIT.finditer(line.text), MAX_WORDS))
        if self._words > MAX_WORDS:
            problem = f"the netlist has more than {MAX_WORDS:,} words and brackets; allowed: no more"
            raise InputError(f"{problem}, samples go in by Python: fs.Samples(values, rate)", line.where())
        if not here.skipped and "," in line.text and (note := decimal_comma(line.text)):
            self.warn(note, line.where())
        if not here.skipped and "μ" in line.text and (found := _GREEK_MU.search(line.text)):
            self.warn(f"{found[0]} is {found[1]}u here and {found[1]} in ngspice 39: write {found[1]}u", line.where())
        if word[0] == ".":
            word = word.partition("(")[0].partition("=")[0]
            # In the body of a definition that is not read, only what gives it its end counts.
            if not here.skipped or word in (".subckt", ".ends", ".control"):
                self._direct(".param" if word == ".params" else word, line, len(word))
        elif not here.skipped:
            here.elements.append(line)
            here.characters += len(line.text)

    def _direct(self, name: str, line: Line, rest: int) -> None:
        """Do what a directive asks for, whose arguments begin at a position of its line."""
        here, place, text = self._open[-1], line.where(), line.text[rest:]
        match name:
            case ".tran" | ".ac" | ".option" | ".options" | ".ic" | ".model" | ".temp":
                opened = f".subckt {here.name}, which begins at {here.where}; is its .ends missing"
                refuse(here is not self.root and name != ".ic", f"{name} does not belong inside {opened}?", place)
                if name in (".tran", ".ac"):
                    for other, first, _ in here.directives:
                        refuse(other == name, f"{name} is given twice, first at {first.where()}", place)
                here.directives.append((".options" if name == ".option" else name, line, rest))
            case ".meas" | ".measure" | ".four" | ".step" | ".dc" | ".op" | ".save" | ".probe" | ".print":
                refuse(here is not self.root, f"{name} does not belong inside .subckt {here.name}", place)
                self.asked.append((name, line, rest))
            case ".param":
                here.params += definitions(line, rest)
                here.characters += len(line.text)
            case ".subckt":
                self._open.append(self._subcircuit(line, rest))
            case ".ends":
                refuse(len(self._open) == 1, ".ends without a .subckt before it", place)
                closed = self._open.pop().name
                if text.strip() and closed and text.strip().lower() != closed.lower():
                    raise InputError(f".ends {text.strip()} closes .subckt {closed}: the names differ", place)
            case ".include" | ".inc" | ".lib":
                self._include(name, line, rest)
            case ".control":
                self._control = line
                self.unused[name] = None
            case ".end":
                refuse(self._reading, "only the netlist itself, not an included file, has .end", place)
                self._ended = True
            case ".endl":
                raise InputError(".endl without its .lib: a section is read by .lib FILE SECTION", place)
            case ".endc":
                raise InputError(".endc without a .control before it", place)
            case _ if name in _UNUSED:
                self.unused[name] = None
            case _ if name in (".nodeset", ".backanno"):
                pass  # These matter only to other simulators.
            case ".global":
                names = lex(line, rest)
                refuse(not names or any(one.kind != "word" for one in names), "write .global node node ...", place)
                self.shared |= {one.text.lower(): one.text for one in names}
            case ".func":
                function = definition_of(line, rest)
                twice = self.functions.setdefault(function.name, function) is not function
                refuse(twice, f"function '{function.name}' is defined twice", place)
            case _:
                hint = nearest(name, DIRECTIVES) or f"; directives are {' '.join(_USED)}"
                hint = f": {ELSEWHERE[name]}" if name in ELSEWHERE else hint
                raise InputError(f"{name} is not supported{hint}", place)

    def _subcircuit(self, line: Line, rest: int) -> Subcircuit:
        around = self._open[-1]
        if around.skipped:
            return Subcircuit("", line.where(), skipped=True)
        words = group(lex(line, rest), plain=len(line.text))
        names = [word for word in words.words if isinstance(word, Lexeme) and word.text.lower() != "params:"]
        if not names or any(word.kind != "word" for word in names):
            raise InputError("write .subckt NAME node node ... key=value ...", line.where())
        name = names[0].text
        if name.upper() in called_devices():
            self.warn(f"{name.upper()} is a native device: its .subckt is not read", names[0].where)
            return Subcircuit(name, line.where(), skipped=True)
        if words.stray is not None:
            raise InputError(f"'{words.stray.text}' follows the parameters: nodes come first", words.stray.where)
        ports: dict[str, None] = {}  # an ordered set
        for word in names[1:]:
            port = word.text.lower()
            refuse(port in ("0", "gnd"), "ground is the same node everywhere and cannot be a subcircuit's node", word)
            refuse(port in ports, f"node '{word.text}' is given twice", word)
            ports[port] = None
        defaults = list(words.params.values())
        for _, value in defaults:
            refuse(value.kind == "string", "a number is needed, not a text", value)
        defined = Subcircuit(name, line.where(), tuple(ports), defaults, characters=len(line.text))
        first = around.inner.setdefault(name.lower(), defined)
        refuse(first is not defined, f"subcircuit '{name}' is defined twice, first at {first.where}", defined)
        return defined

    def _include(self, directive: str, line: Line, rest: int) -> None:
        raw = line.text[rest:]
        name, where = raw.strip(), line.where(rest + len(raw) - len(raw.lstrip()))
        words = name.split()
        if name[:1] in ("'", '"') and name:
            inner, closed, after = name[1:].partition(name[0])
            refuse(not closed, f"{name[0]} is never closed", where)
            name, words = inner, [inner, *after.split()]
        refuse(not name.strip(), f"{directive} needs a file name", line.where())
        section = words.pop().lower() if directive == ".lib" and len(words) == 2 else ""
        name = name if not section or name == words[0] else words[0]
        refuse(len(words) > 1, "one file name is allowed; put a name with blanks in quotes", where)
        begins = directive == ".lib" and self._reading and "." not in name
        refuse(begins, f"'{name}' begins a section of a library; allowed: .lib FILE SECTION, which reads one", where)
        folder = self._reading[-1].parent if self._reading else self._folder
        base = name.replace("\\", "/").rpartition("/")[2]
        if base.lower() in LIBRARIES.values():
            self.libraries.append(base)
            if self._folder is not None and folder is not None and library_changed(self._folder, folder, name):
                problem = "differs from this version's and is not read: the devices are built in here, and only ngspice"
                self.warn(f"'{name}' {problem} would run the changed ones", where)
            return
        if folder is None or self._folder is None or self.path is None:
            raise InputError(f"'{name}' cannot be included: a netlist given as text has no folder to look in", where)
        path = inside(self._folder, folder, name, where)
        refuse(path in (self.path.resolve(), *self._reading), f"'{name}' includes itself", where)
        self.files.append(path)
        problem = f"too many included files: at most {MAX_INCLUDES}, nested {MAX_INCLUDE_DEPTH} deep"
        refuse(len(self.files) > MAX_INCLUDES or len(self._reading) >= MAX_INCLUDE_DEPTH, problem, where)
        text = read_text(path, name, where, self._folder)
        self._size += len(text)
        refuse(self._size > MAX_BYTES, f"the included files are larger than {MAX_BYTES >> 20} MiB in all", where)
        self._reading.append(path)
        shown = str(Path(self.file).parent / path.relative_to(self._folder))
        lines = logical_lines(self.split(text, where), shown)
        for included in _section(lines, section, where) if section else lines:
            self._take(included)
        self._reading.pop()


def _section(lines: Iterable[Line], name: str, where: Where) -> list[Line]:
    """The lines of a library between ``.lib NAME`` and ``.endl``."""
    found, here = dict[str, list[Line]](), ""
    for line in lines:
        words = line.text.lower().split()
        if words[0] == ".lib" and len(words) == 2 and not here:
            here = words[1]
            found.setdefault(here, [])
        elif words[0] == ".endl":
            here = ""
        elif here:
            found[here].append(line)
    hint = nearest(name, found) or f"; its sections are {', '.join(found) or 'none'}"
    refuse(name not in found, f"the library has no section '{name}'{hint}", where)
    refuse(here, f"section '{here}' of the library has no .endl", where)
    return found[name]
