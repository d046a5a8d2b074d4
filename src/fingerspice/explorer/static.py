"""The explorer's page as one file without a server: scenes as they are, to look at and to pin."""

from __future__ import annotations

import base64
import json
import re
from typing import Any

from fingerspice.circuit.circuit import Circuit
from fingerspice.explorer.encoding import as_json
from fingerspice.explorer.scene import scene
from fingerspice.explorer.server import beginning, pages

_POLICY = "default-src 'none'; script-src 'unsafe-inline' data:; style-src 'unsafe-inline'; img-src data: blob:"
_IMPORT = re.compile(r'from "\./(\w+)\.js"')


def static_page(circuit: Circuit | None = None) -> str:
    """The page as HTML that needs no other file: with the circuit's run, or with those of all example scenes.

    Parameters
    ----------
    circuit : Circuit, optional

    Returns
    -------
    str
        The page. Its sliders show the values, and do not move.
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
