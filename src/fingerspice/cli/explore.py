"""The command `explore`: it serves the local page until it is ended."""

from __future__ import annotations

import signal
import threading
from pathlib import Path
from typing import Annotated

import typer

from fingerspice.cli import answers
from fingerspice.cli.arguments import AsJson
from fingerspice.cli.options import check_output, read_circuit
from fingerspice.cli.terminal import Answering


def explore(
    deck: Annotated[
        Path | None, typer.Argument(metavar="[DECK]", help="Netlist file (.cir); the page has examples of its own.")
    ] = None,
    port: Annotated[int, typer.Option(help="Port of the loopback address; 0 takes a free one.")] = 0,
    no_browser: Annotated[bool, typer.Option("--no-browser", help="Print the link, and open no browser.")] = False,
    static: Annotated[
        Path | None, typer.Option("--static", metavar="OUT.html", help="Write the page as one file, and serve nothing.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Open a local page on which DECK's values move and the run follows; Ctrl-C ends it.

    Examples:

      fingerspice explore circuits/fingerpad.cir

      fingerspice explore --port 8000 --no-browser

      fingerspice explore circuits/click.cir --static click.html
    """
    from fingerspice.explorer.server import Explorer

    if static is not None:
        _write(deck, static, as_json)
        return
    ended = threading.Event()
    with Answering("explore", as_json) as answer:
        circuit = None if deck is None else read_circuit(deck, None, None)
        if circuit is not None:
            answer.update(**answers.of_circuit(circuit, None))
        explorer = Explorer(circuit, port)
        answer.update(url=explorer.url)
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, lambda *_: ended.set())
        answer.give(lambda: f"the explorer is at {explorer.url}\nCtrl-C ends it")
    if not no_browser:
        explorer.open()
    ended.wait()
    explorer.stop()


def _write(deck: Path | None, output: Path, as_json: bool) -> None:
    """Write the page of a deck, or of the examples, as one file."""
    from fingerspice.base.files import write_aside
    from fingerspice.explorer.static import static_page

    with Answering("explore", as_json) as answer:
        circuit = None if deck is None else read_circuit(deck, None, None)
        if circuit is not None:
            answer.update(**answers.of_circuit(circuit, None))
        check_output(output, deck)
        page = static_page(circuit)
        answer.give(str, [lambda: write_aside(output, lambda path: path.write_text(page, encoding="utf-8"))])
