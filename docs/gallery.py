"""Draws every shipped deck and every example scene of the explorer, and writes the page that shows them.

The build of the documentation calls it; `python docs/gallery.py` does the same alone. What it writes, docs/gallery, is
not kept in the repository.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import fingerspice as fs
from fingerspice.explorer import examples
from fingerspice.explorer.request import circuits_of, request_of, times_of
from fingerspice.plots.drawing import save

HERE = Path(__file__).parent
CIRCUITS = HERE.parent / "circuits"
FOLDER = HERE / "gallery"
SIGNALS = ("u_source", "u_gap", "f_t")


@dataclass(frozen=True)
class Entry:
    """One picture: its file name, title, explanation, how to run it, the file it is drawn from, and its run."""

    name: str
    title: str
    about: str
    how: str
    origin: Path
    run: Callable[[], fs.Solution]


def decks() -> Iterator[Entry]:
    """The shipped decks; their comments explain them."""
    for path in sorted(CIRCUITS.glob("*.cir")):
        lines = path.read_text(encoding="utf-8").splitlines()
        comments = [line[1:].strip() for line in lines[1 : lines.index(".include fingerspice.lib")] if line[:1] == "*"]
        about = re.split(r"Layers(?:,| and) contact|SI units|V\(area\)|In ngspice|Charge law:", " ".join(comments))[0]
        how = f"[`circuits/{path.name}`](../../circuits/{path.name}): `fingerspice run circuits/{path.name}`"
        title = re.sub(r"Fingerpad on a (3M-coated )?touchscreen,? (with )?", "", lines[0])
        yield Entry(
            path.stem,
            title[0].upper() + title[1:],
            about.strip(),
            how,
            path,
            lambda path=path: fs.simulate(fs.read_netlist(path)),
        )


def scenes() -> Iterator[Entry]:
    """The example scenes of the explorer."""
    for example in examples.EXAMPLES:

        def run(given: examples.Example = example) -> fs.Solution:
            request = request_of({"deck": given.deck, **given.asked})
            circuit = circuits_of(request)[1]
            first, stop, _ = times_of(circuit, request)
            times = np.linspace(first, stop, 4001)
            return fs.simulate(circuit, t_stop=stop, t_eval=times, charge_law=request.charge_law, throw=False)

        how = "on the menu of `fingerspice explore`"
        yield Entry(f"scene-{example.name}", example.title, example.note, how, Path(examples.__file__), run)


def draw(entry: Entry, folder: Path) -> None:
    """Draw an entry, if its picture is not there or older than what it shows."""
    picture = folder / f"{entry.name}.png"
    if not picture.exists() or picture.stat().st_mtime < entry.origin.stat().st_mtime:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", fs.FingerspiceWarning)
            save(entry.run().plot(SIGNALS), picture, dpi=110.0)


def page() -> str:
    """The text of the page."""
    text = [
        "# Gallery",
        "Every shipped deck and every example scene of the explorer: voltages, and the friction that the finger feels.",
    ]
    for heading, entries in (("Shipped decks", decks()), ("Scenes of the explorer", scenes())):
        text.append(f"## {heading}")
        for one in entries:
            about = f"{one.about} " if one.about else ""
            text += [f"### {one.title}", f"{about}({one.how})", f"![{one.title}]({one.name}.png)"]
    return "\n\n".join(text) + "\n"


def main(folder: Path = FOLDER) -> None:
    """Draw all pictures and write the page."""
    folder.mkdir(exist_ok=True)
    for entry in (*decks(), *scenes()):
        draw(entry, folder)
    (folder / "index.md").write_text(page(), encoding="utf-8")


if __name__ == "__main__":
    main()
