"""Files of a netlist: their text, the folder they may be in, and the libraries of native devices as shipped."""

from __future__ import annotations

import codecs
import sys
from contextlib import nullcontext, suppress
from dataclasses import dataclass
from encodings import cp1252
from functools import cache
from pathlib import Path, PurePath

from fingerspice.base.errors import InputError, Where
from fingerspice.netlist.lexer import split_lines
from fingerspice.netlist.slips import closest, nearest

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
