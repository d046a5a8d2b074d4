"""Draws every shipped deck and every example scene of the explorer, and writes the page that shows them.

The build of the documentation calls it; `python docs/gallery.py` does the same alone. What it writes, docs/gallery, is
not kept in the repository.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import fingerspice as fs
from fingerspice.explorer import scene
from fingerspice.explorer.scene import draw, shown_runs

HERE = Path(__file__).parent
CIRCUITS = HERE.parent / "circuits"
FOLDER = HERE / "gallery"


class Entry(NamedTuple):
    """One picture of the gallery."""

    name: str  # Of its file, without the suffix
    title: str  # What it shows, in a line
    about: str  # The comment of the deck, or the note of the scene
    origin: Path  # File that it is drawn from
    run: Callable[[], fs.Solution]


def entries() -> Iterator[tuple[str, Entry, str]]:
    """Heading, picture, and how to run what it shows."""
    runs = shown_runs(CIRCUITS)
    for path in sorted(CIRCUITS.glob("*.cir")):
        how = f"[`circuits/{path.name}`](../../circuits/{path.name}): `fingerspice run circuits/{path.name}`"
        yield "Shipped decks", Entry(path.stem, *comment_of(path), path, runs[path.stem]), how
    for one in scene.EXAMPLES:
        name, menus = f"scene-{one['name']}", Path(scene.__file__).with_name("menus.toml")
        entry = Entry(name, one["title"], one["note"], menus, runs[name])
        yield "Scenes of the explorer", entry, "on the menu of `fingerspice explore`"


def comment_of(path: Path) -> tuple[str, str]:
    """Title of a deck, and the part of its comment that explains it."""
    lines = path.read_text(encoding="utf-8").splitlines()
    end = lines.index(".include fingerspice.lib") if ".include fingerspice.lib" in lines else len(lines)
    comments = [line[1:].strip() for line in lines[1:end] if line[:1] == "*"]
    about = re.split(r"Layers(?:,| and) contact|SI units|V\(area\)|In ngspice|Charge law:", " ".join(comments))[0]
    title = re.sub(r"Fingerpad on a (3M-coated )?touchscreen,? (with )?", "", lines[0]) or path.stem
    return title[0].upper() + title[1:], about.strip()


def page() -> str:
    """The text of the page."""
    text = [
        "# Gallery",
        "Every shipped deck and every example scene of the explorer: voltages, and the friction that the finger feels. "
        "`fingerspice figures --gallery` draws the same pictures.",
    ]
    for heading, one, how in entries():
        if f"## {heading}" not in text:
            text.append(f"## {heading}")
        about = f"{one.about} " if one.about else ""
        text += [f"### {one.title}", f"{about}({how})", f"![{one.title}]({one.name}.png)"]
    return "\n\n".join(text) + "\n"


def main(folder: Path = FOLDER) -> None:
    """Draw the pictures that are missing, or older than what they show, and write the page."""
    folder.mkdir(exist_ok=True)
    for _, one, _ in entries():
        picture = folder / f"{one.name}.png"
        if not picture.exists() or picture.stat().st_mtime < one.origin.stat().st_mtime:
            draw(one.run, picture)
    (folder / "index.md").write_text(page(), encoding="utf-8")


if __name__ == "__main__":
    main()
