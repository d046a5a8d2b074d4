"""The files of a netlist on the disk: their text, their folder, and the libraries of native devices."""

from __future__ import annotations

import codecs
from dataclasses import dataclass
from encodings import cp1252
from pathlib import Path, PurePath

from fingerspice.base.errors import InputError, Where
from fingerspice.netlist.lexer import split_lines
from fingerspice.netlist.library import LIBRARIES, library_text
from fingerspice.netlist.spelling import closest, nearest

MAX_BYTES = 64 * 2**20
#: Of all files that a deck's sources name.
MAX_SOURCE_BYTES = 2**30

#: Libraries with ngspice's bodies of the native devices; the one that is included says which charge law is meant.
NATIVE_LIBRARIES = tuple(LIBRARIES.values())


def read_text(path: Path, shown: str, where: Where | None = None, root: Path | None = None) -> str:
    """Text of a netlist or table.

    Parameters
    ----------
    path : Path
    shown : str
        The path as the user wrote it.
    where : Where, optional
        Place of the line that names the file.
    root : Path, optional
        Folder outside which no file's name may be told.

    Raises
    ------
    InputError
        When the file is missing, no ordinary file, too large, or not text in UTF-8, Latin-1 or marked UTF-16.
    """
    try:
        if path.is_dir():
            raise InputError(f"'{shown}' is a folder, not a file", where)
        if not path.exists():
            raise InputError(f"'{shown}' does not exist{_similar_file(path, shown, root)}", where)
        if not path.is_file():
            raise InputError(f"'{shown}' is not an ordinary file", where)
        if path.stat().st_size > MAX_BYTES:
            raise InputError(f"'{shown}' is larger than {MAX_BYTES >> 20} MiB", where)
        data = path.read_bytes()
    except (OSError, ValueError) as error:  # InputError is a ValueError
        if isinstance(error, InputError):
            raise
        reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
        raise InputError(f"'{shown}' cannot be read: {reason}", where) from None
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        # LTspice writes UTF-16 where a name has letters that Latin-1 lacks.
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
    """Where sources find recordings and tables: for a deck in its folder or below, for a text of the user's anywhere.

    Attributes
    ----------
    folder : Path or None
        The deck's; None for a deck given as text, which has none.
    anywhere : bool
        Whether any file may be read, named from the working directory: so it is for what a user, and no deck, asks for.
    size : int
        Bytes of the files named so far, each as often as it is named.
    """

    folder: Path | None = None
    anywhere: bool = False
    size: int = 0

    def find(self, name: str, where: Where) -> Path:
        """Path of a file, where `where` names it; refused where it lies outside the folder.

        Raises
        ------
        InputError
            One sentence with the place.
        """
        path = Path(name).expanduser() if self.anywhere else self._below(name, where)
        if path.is_file():
            self.size += path.stat().st_size
            if self.size > MAX_SOURCE_BYTES:
                raise InputError(f"the sources' files are larger than {MAX_SOURCE_BYTES >> 20:,} MiB in all", where)
        return path

    def _below(self, name: str, where: Where) -> Path:
        if self.folder is None:
            raise InputError(f"'{name}' cannot be read: a netlist given as text has no folder to look in", where)
        # The line may stand in an included file, whose name begins with the deck's folder as the user wrote it.
        folder = Path(where.file).parent
        path = inside(self.folder.resolve(), folder, name, where)
        if not path.exists():
            raise InputError(f"'{name}' does not exist{_similar_file(path, name, self.folder.resolve())}", where)
        return folder / name.replace("\\", "/")


def library_changed(root: Path, folder: Path, name: str) -> bool:
    """Whether there is a library of that name in the netlist's folder that differs from this version's."""
    try:
        path = (folder / name.replace("\\", "/")).resolve()
        if not path.is_relative_to(root) or not path.is_file():
            return False
        own = library_text(next(law for law, file in LIBRARIES.items() if file == path.name.lower()))
        # A character has up to four bytes.
        if path.stat().st_size > 4 * len(own):
            return True
        text = read_text(path, name)
        return text != own and _lines(text) != _lines(own)
    except (OSError, ValueError, RuntimeError):
        # A file that cannot be read is not this version's library.
        return True


def _lines(text: str) -> list[str]:
    return [line.rstrip() for line in split_lines(text.rstrip())]


def _similar_file(path: Path, shown: str, root: Path | None) -> str:
    """The clause ``; did you mean 'folder/file'?`` for a missing file, or an empty text.

    Looked at are the file's folder; where that is missing, the folder with the nearest name in its place; and then the
    folder that should contain it. What is proposed is written as the missing file is, with its folder.
    """
    folder, below = path.parent, [path.name]
    while not folder.is_dir() and folder != folder.parent:
        folder, below = folder.parent, [folder.name, *below]
    if root is not None and not folder.is_relative_to(root):
        return ""
    # As in `shown`, which may begin elsewhere than `path`.
    written = PurePath(shown.replace("\\", "/")).parts[: -len(below)]
    found = _nearest_path(folder, below)
    if found is None and len(below) > 1:
        found = _nearest_path(folder, below[-1:])
    # A library of native devices is not read, and need not be there.
    names = [*([found[-1]] if found else []), *(NATIVE_LIBRARIES if root is not None else ())]
    name = closest(path.name, names)
    if found is not None and name in (found[-1], None):
        return f"; did you mean '{PurePath(*written, *found).as_posix()}'?"
    return nearest(path.name, names)


def _nearest_path(folder: Path, parts: list[str]) -> list[str] | None:
    """A file below a folder, found by the nearest name for each of the parts; None where there is none."""
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
