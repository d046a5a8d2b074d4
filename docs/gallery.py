"""Draws every shipped deck and every example scene of the explorer, and writes the page that shows them.

The build of the documentation calls it; `python docs/gallery.py` does the same alone. What it writes, docs/gallery, is
not kept in the repository.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from fingerspice.explorer.scene import Entry, decks, draw, scenes

HERE = Path(__file__).parent
CIRCUITS = HERE.parent / "circuits"
FOLDER = HERE / "gallery"


def entries() -> Iterator[tuple[str, Entry, str]]:
    """Heading, picture, and how to run what it shows."""
    for one in decks(CIRCUITS):
        how = f"[`circuits/{one.name}.cir`](../../circuits/{one.name}.cir): `fingerspice run circuits/{one.name}.cir`"
        yield "Shipped decks", one, how
    for one in scenes():
        yield "Scenes of the explorer", one, "on the menu of `fingerspice explore`"


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
            draw(one, picture)
    (folder / "index.md").write_text(page(), encoding="utf-8")


if __name__ == "__main__":
    main()
