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
from fingerspice.netlist.files import MAX_BYTES, is_stream, read_stream, read_text
from fingerspice.netlist.flatten import Flattener
from fingerspice.netlist.reader import DIRECTIVES, Reader
from fingerspice.netlist.scope import Scope
from fingerspice.netlist.slips import with_comma
from fingerspice.netlist.words import Directive, Statement

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
    directives: tuple[Directive, ...]  # Those with values, as in `Flattener.directives`
    # Names, without folder, of the included libraries of native devices, whose files are not read
    includes: tuple[str, ...]
    files: tuple[Path, ...]  # The other included files, which were read
    unused: tuple[str, ...]  # Names of the directives that are accepted and have no effect here
    warnings: tuple[str, ...]  # Warnings about text that is legal but probably not meant, each with its place
    params: dict[str, float]  # Values of the deck's own `.param` definitions by lower-case name
    text: str  # The netlist as read
    path: Path | None  # Path of the file; None for a text

    def named(self, name: str) -> list[Directive]:
        """The directives of that name."""
        return [directive for directive in self.directives if directive.name == name]


def read_deck(path: str | Path) -> Deck:
    """Read a netlist file, which may include files from its own folder only.

    Standard input (``-``), a device or a pipe is a deck called ``stdin`` in the working directory.
    """
    if is_stream(Path(path)):
        return parse_deck(read_stream(Path(path)), Path("stdin"))
    return parse_deck(read_text(Path(path), str(path)), Path(path))


def parse_deck(text: str, path: Path | None = None) -> Deck:
    """Read a netlist, whose first line is the title.

    `path` is that of the file with this text; without it only the libraries of native devices can be included.
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
        scope = Scope()
        for definition in reader.root.params:
            scope.define(definition)
        scope.solve()
        flattener = Flattener()
        flattener.run(reader.root, scope)
    except InputError as error:
        raise with_comma(error, reader.warnings) from None
    for defined in reader.root.inner.values():
        # In a library it is usual that some subcircuits are never called.
        if defined.where.file == file and not (defined.called or defined.skipped):
            reader.warn(f"subcircuit '{defined.name}' is never called, and its body was not read", defined.where)
    return Deck(
        title=title,
        statements=tuple(flattener.statements),
        directives=tuple(flattener.directives),
        includes=tuple(reader.libraries),
        files=tuple(reader.files),
        unused=tuple(reader.unused),
        warnings=tuple(reader.warnings),
        params=dict(scope.values),
        text=text,
        path=path,
    )


def _reads_like_a_statement(title: str) -> bool:
    """Whether a title is probably the netlist's first statement."""
    if title.startswith("."):
        return title.split(None, 1)[0].lower() in DIRECTIVES
    return _ELEMENT_TITLE.match(title) is not None or _DEVICE_TITLE.match(title) is not None
