"""A netlist file as a flat list of evaluated statements.

A statement has a name, nodes and values; `elements`, `sources` and `directives` give it a meaning. The steps are those
of `lexer` (from text to words), `reader` (lines by kind, included files), `scope` (parameters and values) and `flatten`
(subcircuit calls). Every error has its place in the file.
"""

from __future__ import annotations

import re
from pathlib import Path

from fingerspice.base.errors import InputError, Where, printable
from fingerspice.circuit.devices import layer_devices
from fingerspice.netlist.files import MAX_BYTES, is_stream, read_stream, read_text
from fingerspice.netlist.flatten import Flattener
from fingerspice.netlist.reader import DIRECTIVES, Reader
from fingerspice.netlist.slips import with_comma
from fingerspice.netlist.words import Deck

#: Largest number of characters of a title that are shown; the middle of a longer title is left out.
LONGEST_TITLE = 200

_TITLE = re.compile(r"^\.title\s+", re.IGNORECASE)
_VALUE = r"(?:\{|'|[-+.\d]|(?:dc|ac|sine?|pulse|exp|pwl|square|chirp|burst|wavefile|table)\b)"
#: Titles that are probably the netlist's first statement.
_STATEMENT = re.compile(
    rf"[rcvi]\w*\s+\S+\s+\S+\s+{_VALUE}|x\w*(?:\s+\S+){{3}}\s+(?:{'|'.join(layer_devices())})(?:\s|$)"
    rf"|(?:{'|'.join(map(re.escape, DIRECTIVES))})(?:\s|$)",
    re.IGNORECASE,
)


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
    deck = Deck(text, path)
    if not text.strip("\ufeff \t\r\n"):
        raise InputError(f"'{deck.file}' is empty: a netlist begins with a title line")
    if len(text) > MAX_BYTES:
        raise InputError(f"'{deck.file}' is larger than {MAX_BYTES >> 20} MiB")
    if "\0" in text:
        raise InputError(f"'{deck.file}' is not text (it holds NUL characters)")
    reader = Reader(deck)
    title, *lines = reader.split(text.removeprefix("\ufeff"))
    deck.title = printable(_TITLE.sub("", title.strip()), LONGEST_TITLE)
    if _STATEMENT.match(deck.title):
        problem = f"the first line is the title, but '{deck.title}' reads like a statement: add a title above"
        reader.warn(problem, Where(deck.file, 1))
    try:
        reader.read_deck(lines)
        Flattener(deck).run(reader.root)
    except InputError as error:
        raise with_comma(error, deck.warnings) from None
    for defined in reader.root.inner.values():
        # In a library it is usual that some subcircuits are never called.
        if defined.where.file == deck.file and not (defined.called or defined.skipped):
            reader.warn(f"subcircuit '{defined.name}' is never called, and its body was not read", defined.where)
    return deck
