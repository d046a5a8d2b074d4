"""A gallery: pictures of decks and of the explorer's example scenes."""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fingerspice.base.errors import FingerspiceWarning
from fingerspice.explorer import examples
from fingerspice.explorer.request import circuits_of, request_of, times_of
from fingerspice.netlist.netlist import read_netlist
from fingerspice.plots.drawing import save
from fingerspice.results.solution import Solution
from fingerspice.solve.simulation import simulate

SIGNALS = ("u_source", "u_gap", "f_t")


@dataclass(frozen=True)
class Entry:
    """One picture."""

    name: str  # Of its file, without the suffix
    # title, about: What it shows, in a line, and the comment of the deck or the note of the scene
    title: str
    about: str
    origin: Path  # File that it is drawn from
    run: Callable[[], Solution]  # Runs it


def decks(folder: Path) -> Iterator[Entry]:
    """The decks of a folder; their comments explain them."""
    for path in sorted(folder.glob("*.cir")):
        lines = path.read_text(encoding="utf-8").splitlines()
        end = lines.index(".include fingerspice.lib") if ".include fingerspice.lib" in lines else len(lines)
        comments = [line[1:].strip() for line in lines[1:end] if line[:1] == "*"]
        about = re.split(r"Layers(?:,| and) contact|SI units|V\(area\)|In ngspice|Charge law:", " ".join(comments))[0]
        title = re.sub(r"Fingerpad on a (3M-coated )?touchscreen,? (with )?", "", lines[0]) or path.stem

        def run(path: Path = path) -> Solution:
            return simulate(read_netlist(path))

        yield Entry(path.stem, title[0].upper() + title[1:], about.strip(), path, run)


def scenes() -> Iterator[Entry]:
    """The example scenes of the explorer."""
    for example in examples.EXAMPLES:

        def run(given: examples.Example = example) -> Solution:
            request = request_of({"deck": given.deck, **given.asked})
            circuit = circuits_of(request)[1]
            first, stop, _ = times_of(circuit, request)
            times = np.linspace(first, stop, 4001)
            return simulate(circuit, t_stop=stop, t_eval=times, charge_law=request.charge_law, throw=False)

        yield Entry(f"scene-{example.name}", example.title, example.note, Path(examples.__file__), run)


def draw(entry: Entry, picture: Path) -> None:
    """Run an entry, and draw source, gap voltage and friction."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FingerspiceWarning)
        save(entry.run().plot(SIGNALS), picture, dpi=110.0)
