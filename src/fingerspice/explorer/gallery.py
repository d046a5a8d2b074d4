"""A gallery: pictures of decks and of the explorer's scenes; and its page as one file without a server."""

from __future__ import annotations

import base64
import json
import re
import warnings
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from fingerspice.base.errors import FingerspiceWarning
from fingerspice.circuit.circuit import Circuit
from fingerspice.explorer import beginnings
from fingerspice.explorer.request import Asked
from fingerspice.explorer.scene import beginning, scene
from fingerspice.explorer.server import framed, pages
from fingerspice.netlist.netlist import read_netlist
from fingerspice.plots.drawing import save
from fingerspice.results.solution import Solution
from fingerspice.solve.simulation import simulate


class Entry(NamedTuple):
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
        title = title[0].upper() + title[1:]
        yield Entry(path.stem, title, about.strip(), path, partial(lambda path: simulate(read_netlist(path)), path))


def scenes() -> Iterator[Entry]:
    """The example scenes of the explorer."""
    for one in beginnings.EXAMPLES:
        yield Entry(f"scene-{one.name}", one.title, one.note, Path(beginnings.__file__), partial(_run_scene, one))


def _run_scene(example: beginnings.Example) -> Solution:
    asked = Asked({"deck": example.deck, **example.asked})
    first, stop, _ = asked.times
    times = np.linspace(first, stop, 4001)
    return simulate(asked.circuit, t_stop=stop, t_eval=times, charge_law=asked.charge_law, throw=False)


def draw(entry: Entry, picture: Path) -> None:
    """Run an entry, and draw source, gap voltage and friction."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FingerspiceWarning)
        save(entry.run().plot(("u_source", "u_gap", "f_t")), picture, dpi=110.0)


_POLICY = "default-src 'none'; script-src 'unsafe-inline' data:; style-src 'unsafe-inline'; img-src data: blob:"


def static_page(circuit: Circuit | None = None) -> str:
    """The page as HTML that needs no other file, of a circuit's run or all example scenes; no slider moves on it."""
    files = {name: content.decode("utf-8") for name, content in pages().items()}
    start = beginning(circuit)
    if circuit is not None:
        start["examples"] = []
    shown = [{"name": "own", **start["own"]}] if circuit is not None else start["examples"]
    scenes = {one["name"]: scene({"last": 2, **one["request"]}, circuit) for one in shown}
    baked = base64.b64encode(framed({"start": start, "scenes": scenes})).decode("ascii")
    # Modules import each other by the names of the import map.
    bare = {
        name.removesuffix(".js"): re.sub(r'from "\./(\w+)\.js"', r'from "\1"', text)
        for name, text in files.items()
        if name.endswith(".js") and name != "uplot.js"
    }
    app = bare.pop("app")
    encoded = {name: base64.b64encode(text.encode()).decode("ascii") for name, text in bare.items()}
    imports = json.dumps({"imports": {name: f"data:text/javascript;base64,{text}" for name, text in encoded.items()}})
    parts = [
        f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">',
        f"<style>{files['uplot.css']}\n{files['style.css']}</style>",
        f"<script>{files['uplot.js']}</script>",
        f'<script type="text/plain" id="baked">{baked}</script>',
        f'<script type="importmap">{imports}</script>',
        f'<script type="module">{app}</script>',
    ]
    replaced = ('<link rel="stylesheet"', "<script src", '<script type="module"')
    lines = files["index.html"].splitlines()
    first = next(i for i, line in enumerate(lines) if line.startswith(replaced))
    return "\n".join([*lines[:first], *parts, *(x for x in lines[first:] if not x.startswith(replaced)), ""])
