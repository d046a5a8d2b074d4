"""Files of a command's results, which are named after the deck and never replace results of another circuit."""

from __future__ import annotations

import hashlib
import html
import json
import re
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fingerspice.base.errors import InputError
from fingerspice.base.files import write_aside
from fingerspice.cli.options import check_output
from fingerspice.cli.terminal import complain

if TYPE_CHECKING:
    from fingerspice.circuit.circuit import Circuit

#: Folder of the results unless another one is named.
FOLDER = Path("out")
#: First bytes of the tables that the commands write.
_HEADS = (
    b"t [s],u_source", b"frequency [Hz],gain [1],", b"parameter,value [SI],unit,", b"time (s),drive (V)",
    b"time (s),wanted force (N),",
)  # fmt: skip


class Results:
    """The files of one command, which has `circuit`, with all changes, from `deck`.

    They go into `folder` (`FOLDER` by default) under `name` (that of the deck) with their endings; with `overwrite`
    they may replace files of other or unknown circuits. `charge_law` is that asked for.
    """

    def __init__(
        self, deck: Path, circuit: Circuit, folder: Path | None, name: str | None, overwrite: bool,
        charge_law: str | None,
    ) -> None:  # fmt: skip
        if name is not None and (name in ("", ".", "..") or Path(name).name != name or not name.isprintable()):
            raise InputError(
                f"--name is {name!r}; allowed: a file's name without folder and end; --out names the folder"
            )
        self.deck, self.folder, self.overwrite = deck, folder or FOLDER, overwrite
        self.name = name or (circuit.path or deck).stem
        self.named = folder is not None
        self.names: list[str] = []
        self.noted = False
        self.circuit = circuit
        self._own = {
            "program": "fingerspice", "title": circuit.title, "file": str(circuit.path or ""),
            "deck_sha256": _hash(circuit.text), "overrides": json.dumps(dict(circuit.overrides)),
            "charge_law": charge_law or circuit.charge_law or "local",
        }  # fmt: skip
        self._writes: list[Callable[[], Path]] = []

    def file(self, end: str) -> Path:
        """Path of the file with this ending; refused if it cannot be written, or must not be replaced."""
        file = self.folder / f"{self.name}{end}"
        check_output(file, self.deck)
        self.names.append(file.name)
        if file.is_file() and not self.overwrite:
            self._check(file)
        return file

    @property
    def about(self) -> dict[str, str]:
        """Texts kept in a picture: the circuit, and the files that were made with the picture."""
        return {**self._own, "files": json.dumps(self.names)}

    def will_write(self, end: str, write: Callable[[Path], Path]) -> None:
        """Check the file with this ending now, and let `ready` have the function that writes it."""
        file = self.file(end)
        self._writes.append(lambda: write(file))

    def will_draw(self, end: str, draw: Callable[[], Any], *, unless: bool) -> None:
        """As `will_write`, of the picture that a function draws, unless none is wanted."""
        self._writes += self.pictures(None if unless else self.file(end), draw)

    def ready(self) -> list[Callable[[], Path]]:
        """The functions that write the files, for which there is a folder now."""
        if self._writes:
            self.open()
        return self._writes

    def pictures(self, path: Path | None, draw: Callable[[], Any]) -> list[Callable[[], Path]]:
        """The function that draws and writes a picture; none without a path."""
        if path is None:
            return []

        def write() -> Path:
            from fingerspice.plots.drawing import save

            return save(draw(), path, about=self.about)

        return [write]

    def open(self) -> None:
        """When the default folder is created, put a .gitignore into it, to keep results out of version control."""
        if not self.named and not self.folder.exists():
            # Ignore an error: writing the results will then fail as well, with a message.
            with suppress(InputError):
                write_aside(self.folder / ".gitignore", lambda path: path.write_text("*\n"))

    def _check(self, file: Path) -> None:
        held = _held(file)
        ways = "allowed: --name NAME, another --out, or --overwrite"
        if held is None and _is_table(file):
            complain(f"note: {file} is replaced; a table alone does not say which circuit it is of")
            return
        if held is None:
            raise InputError(f"{file} is there already, and nothing says which circuit it is of; {ways}")
        same_deck = held["deck_sha256"] == self._own["deck_sha256"]
        if json.loads(held["overrides"]) != dict(self.circuit.overrides):
            said, own = _of(held), _of(self._own)
        elif held["charge_law"] != self._own["charge_law"]:
            said, own = (f"under the {x['charge_law']} law" for x in (held, self._own))
        elif not same_deck and (held.get("file", "") != self._own["file"] or not held.get("file")):
            said, own = f"of the deck {held.get('file') or 'of another text'}", f"of {self.deck}"
        else:
            if not same_deck and not self.noted:
                self.noted = True
                complain(f"note: the results in {self.folder} are of an earlier text of {self.deck} and are replaced")
            return
        raise InputError(f"{file} holds a result {said}, and this one is {own}; {ways}")


def _of(held: Mapping[str, str]) -> str:
    changed = json.loads(held["overrides"])
    if not changed:
        return "of the deck as it is"
    said = [f"{path}={value if len(value) <= 40 else value[:36] + ' ...'}" for path, value in changed.items()]
    return f"with {', '.join(said[:8])}"


def _hash(text: str) -> str:
    return hashlib.sha256(text.encode("utf-8", "replace")).hexdigest()


def _held(file: Path) -> dict[str, str] | None:
    """Attributes of a file that name its deck, changes and charge law; None if it has none."""
    try:
        found = _attributes(file)
        known = all(isinstance(found.get(key), str) for key in ("deck_sha256", "overrides", "charge_law"))
        return found if known and isinstance(json.loads(found["overrides"]), dict) else None
    except (OSError, ValueError, KeyError, TypeError, AttributeError, SyntaxError):
        # The file was not written by this package.
        return None


def _attributes(file: Path) -> dict[str, Any]:
    """Texts kept in a file; of a table, those in the picture of the same name, if it lists the table's file."""
    if file.suffix == ".nc":
        import h5netcdf

        with h5netcdf.File(file, "r") as data:
            attributes = {str(key): str(value) for key, value in data.attrs.items()}
        return {**attributes, "deck_sha256": _hash(attributes["deck"])}
    if file.suffix == ".svg":
        # A schematic has them as its description.
        found = re.search(r"<dc:description>(.*?)</dc:description>", file.read_text(encoding="utf-8"), re.DOTALL)
        return {} if found is None else dict(json.loads(html.unescape(found[1])))
    from PIL import Image

    picture = file.with_suffix(".png")
    if not picture.is_file():
        # `design` writes NAME_drive.wav, NAME_drive.csv and NAME_friction.csv with the picture NAME_design.png.
        picture = file.with_name(f"{file.stem.rpartition('_')[0]}_design.png")
    with Image.open(picture) as image:
        image.load()
        text: dict[str, Any] = dict(getattr(image, "text", {}))
    return text if file.name in json.loads(text.get("files", "[]")) else {}


def _is_table(file: Path) -> bool:
    """Whether a file begins like the tables that the commands write; a WAV file, whether such a table is beside it."""
    with suppress(OSError), (file.with_suffix(".csv") if file.suffix == ".wav" else file).open("rb") as stream:
        return stream.read(100).startswith(_HEADS)
    return False
