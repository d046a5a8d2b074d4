"""A gallery: pictures of decks and of the explorer's scenes; and its page as one file without a server."""

from __future__ import annotations

import base64
import json
import re
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from fingerspice.base.errors import FingerspiceWarning
from fingerspice.circuit.circuit import Circuit
from fingerspice.explorer import examples
from fingerspice.explorer.request import as_json, circuits_of, request_of, times_of
from fingerspice.explorer.scene import beginning, scene
from fingerspice.explorer.server import pages
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


_POLICY = "default-src 'none'; script-src 'unsafe-inline' data:; style-src 'unsafe-inline'; img-src data: blob:"
_IMPORT = re.compile(r'from "\./(\w+)\.js"')


def static_page(circuit: Circuit | None = None) -> str:
    """The page as HTML that needs no other file: with the circuit's run, or with those of all example scenes.

    Its sliders show the values, and do not move.
    """
    files = {name: content.decode("utf-8") for name, content in pages().items()}
    start = beginning(circuit)
    if circuit is not None:
        start["examples"] = []
    shown = [{"name": "own", **start["own"]}] if circuit is not None else start["examples"]
    scenes = {one["name"]: scene({"last": 2, **one["request"]}, circuit) for one in shown}
    modules = {
        name.removesuffix(".js"): _data_url(_bare(text))
        for name, text in files.items()
        if name.endswith(".js") and name not in ("app.js", "uplot.js")
    }
    parts = [
        f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">',
        f"<style>{files['uplot.css']}\n{files['style.css']}</style>",
        f"<script>{files['uplot.js']}</script>",
        f'<script type="application/json" id="baked">{_inside({"start": start, "scenes": scenes})}</script>',
        f'<script type="importmap">{json.dumps({"imports": modules})}</script>',
        f'<script type="module">{_bare(files["app.js"])}</script>',
    ]
    lines = files["index.html"].splitlines()
    first = next(i for i, line in enumerate(lines) if line.startswith('<link rel="stylesheet"'))
    kept = [
        line
        for line in lines
        if not line.startswith(('<link rel="stylesheet"', "<script src", '<script type="module"'))
    ]
    return "\n".join([*kept[:first], *parts, *kept[first:], ""])


def _bare(module: str) -> str:
    """A module that imports others by the names of the import map."""
    return _IMPORT.sub(r'from "\1"', module)


def _inside(data: Any) -> str:
    """JSON that may stand in a script element."""
    return as_json(data).decode("ascii").replace("<", "\\u003c")


def _data_url(text: str) -> str:
    return f"data:text/javascript;base64,{base64.b64encode(text.encode()).decode('ascii')}"
