"""A netlist file as a flat list of evaluated statements.

A statement has a name, nodes and values; `elements`, `sources` and `directives` give it a meaning. The steps are those
of `lexer` (from text to words), `reader` (lines by kind, included files), `scope` (parameters and values) and `flatten`
(subcircuit calls). Every error has its place in the file.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from fingerspice.base.errors import InputError, Where, printable
from fingerspice.circuit.devices import layer_devices
from fingerspice.netlist.files import MAX_BYTES, NATIVE_LIBRARIES, is_stream, read_stream, read_text
from fingerspice.netlist.flatten import Directive, Flattener, Statement, directive_of
from fingerspice.netlist.reader import DIRECTIVES, Reader, Subcircuit
from fingerspice.netlist.scope import Call, Number, Scope, Token
from fingerspice.netlist.slips import with_comma

__all__ = [
    "NATIVE_LIBRARIES",
    "Call",
    "Deck",
    "Directive",
    "Number",
    "Statement",
    "Token",
    "parse_deck",
    "read_deck",
]

#: Largest number of characters of a title that are shown; the middle of a longer title is left out.
LONGEST_TITLE = 200

_TITLE = re.compile(r"^\.title\s+", re.IGNORECASE)
_VALUE = r"(?:\{|'|[-+.\d]|(?:dc|ac|sine?|pulse|exp|pwl|square|chirp|burst|wavefile|table)\b)"
_ELEMENT_TITLE = re.compile(rf"[rcvi]\w*\s+\S+\s+\S+\s+{_VALUE}", re.IGNORECASE)
_DEVICE_TITLE = re.compile(rf"x\w*(?:\s+\S+){{3}}\s+(?:{'|'.join(layer_devices())})(?:\s|$)", re.IGNORECASE)


@dataclass(frozen=True, slots=True)
class Deck:
    """A netlist, read and flattened."""

    title: str  # The first line in printable characters (see `errors.printable`); `text` has the line as written
    statements: tuple[Statement, ...]  # Elements in the order of the file, subcircuit calls expanded
    # tran, ac: The analyses; each may be given once
    tran: Directive | None
    ac: Directive | None
    # ic, options: Start values, as in `Flattener.starts`, and options, in the order of the file
    ic: tuple[Directive, ...]
    options: tuple[Directive, ...]
    # Names, without folder, of the included libraries of native devices, whose files are not read
    includes: tuple[str, ...]
    files: tuple[Path, ...]  # The other included files, which were read
    unused: tuple[str, ...]  # Names of the directives that are accepted and have no effect here
    warnings: tuple[str, ...]  # Warnings about text that is legal but probably not meant, each with its place
    params: dict[str, float]  # Values of the deck's own `.param` definitions by lower-case name
    text: str  # The netlist as read
    path: Path | None  # Path of the file; None for a text


def read_deck(path: str | Path) -> Deck:
    """Read a netlist file.

    Parameters
    ----------
    path : str or Path
        The file. It may include files from its own folder only. Standard input (``-``), a device or a pipe is a deck
        called ``stdin`` in the working directory.

    Raises
    ------
    InputError
        If the file cannot be read (missing, a folder, empty, too large, not text) or has an error.
    """
    if is_stream(Path(path)):
        return parse_deck(read_stream(Path(path)), Path("stdin"))
    return parse_deck(read_text(Path(path), str(path)), Path(path))


def parse_deck(text: str, path: Path | None = None) -> Deck:
    """Read a netlist.

    Parameters
    ----------
    text : str
        The whole netlist; its first line is the title.
    path : Path, optional
        Path of the file with this text; without it only the libraries of native devices can be included.

    Raises
    ------
    InputError
        If the text has an error; the message gives its place and the allowed alternatives.
    """
    file = str(path) if path is not None else "<netlist>"
    if not text.strip("\ufeff \t\r\n"):
        raise InputError(f"'{file}' is empty: a netlist begins with a title line")
    if len(text) > MAX_BYTES:
        raise InputError(f"'{file}' is larger than {MAX_BYTES >> 20} MiB")
    if "\0" in text:
        raise InputError(f"'{file}' is not text (it holds NUL characters)")
    reader = Reader(file, path)
    lines = reader.split(text.removeprefix("\ufeff"))
    title = printable(_TITLE.sub("", lines[0].strip()), LONGEST_TITLE)
    if _reads_like_a_statement(title):
        problem = f"the first line is the title, but '{title}' reads like a statement: add a title above"
        reader.warn(problem, Where(file, 1))
    try:
        reader.read_deck(lines)
        return _assemble(reader, title, text, path)
    except InputError as error:
        raise with_comma(error, reader.warnings) from None


def _assemble(reader: Reader, title: str, text: str, path: Path | None) -> Deck:
    """Evaluate parameters, then statements, then directives."""
    scope = Scope()
    for formula in reader.root.params:
        scope.define(formula)
    scope.solve()
    flattener = Flattener()
    flattener.run(reader.root, scope)
    directives = [directive_of(*analysis, scope) for analysis in reader.analyses]
    _warn_uncalled(reader, reader.root)
    return Deck(
        title=title,
        statements=tuple(flattener.statements),
        tran=_only(directives, ".tran"),
        ac=_only(directives, ".ac"),
        ic=tuple(flattener.starts),
        options=tuple(d for d in directives if d.name == ".options"),
        includes=tuple(reader.libraries),
        files=tuple(reader.files),
        unused=tuple(reader.unused),
        warnings=tuple(reader.warnings),
        params=dict(scope.values),
        text=text,
        path=path,
    )


def _only(directives: list[Directive], name: str) -> Directive | None:
    found = [directive for directive in directives if directive.name == name]
    if len(found) > 1:
        raise InputError(f"{name} is given twice, first at {found[0].where}", found[1].where)
    return found[0] if found else None


def _warn_uncalled(reader: Reader, root: Subcircuit) -> None:
    """Warn about subcircuits that the deck itself defines and never calls; in a library that is usual."""
    for defined in root.inner.values():
        where = defined.line.where(defined.line.start) if defined.line is not None else None
        if where is not None and where.file == reader.file and not (defined.called or defined.skipped):
            reader.warn(f"subcircuit '{defined.name}' is never called, and its body was not read", where)


def _reads_like_a_statement(title: str) -> bool:
    """Whether a title is probably the netlist's first statement."""
    if title.startswith("."):
        return title.split(None, 1)[0].lower() in DIRECTIVES
    return _ELEMENT_TITLE.match(title) is not None or _DEVICE_TITLE.match(title) is not None
