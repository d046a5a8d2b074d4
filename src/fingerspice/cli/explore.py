"""The command `explore`: it serves the local page until it is ended."""

from __future__ import annotations

import signal
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fingerspice.base.errors import InputError
from fingerspice.cli import answers
from fingerspice.cli.answers import AsJson, Coating, Drive, Finger, Set
from fingerspice.cli.options import check_output, read_circuit
from fingerspice.cli.terminal import Answering

if TYPE_CHECKING:
    from fingerspice.circuit.circuit import Circuit


def explore(
    deck: Annotated[
        Path | None, typer.Argument(metavar="[DECK]", help="Netlist file (.cir); the page has examples of its own.")
    ] = None,
    changes: Set = None,
    finger: Finger = None,
    coating: Coating = None,
    drive: Drive = None,
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

      fingerspice explore circuits/fingerpad.cir --finger moist --coating 3M-insulating

      fingerspice explore --port 8000 --no-browser

      fingerspice explore circuits/click.cir --static click.html
    """
    from fingerspice.explorer.server import Explorer

    if static is not None:
        with Answering("explore", as_json) as answer:
            _write(answer, _circuit(answer, deck, changes, finger=finger, coating=coating, drive=drive), deck, static)
        return
    ended: list[int] = []
    with Answering("explore", as_json) as answer:
        circuit = _circuit(answer, deck, changes, finger=finger, coating=coating, drive=drive)
        explorer = Explorer(circuit, port)
        answer.update(url=explorer.url)
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, lambda number, _: ended.append(number))
        answer.give(lambda: f"the explorer is at {explorer.url}\nCtrl-C ends it")
    if not no_browser:
        explorer.open()
    # An event does not do here: a signal that comes while its lock is held would wait for that lock for ever.
    while not ended:
        time.sleep(0.1)
    explorer.stop()


def _circuit(
    answer: Answering, deck: Path | None, changes: list[str] | None, **sets: list[str] | None
) -> Circuit | None:
    """The deck's circuit with its changes, of which the answer tells; None without a deck."""
    if deck is not None:
        circuit = read_circuit(deck, changes, None, **sets)
        answer.update(**answers.of_circuit(circuit, None))
        return circuit
    for option, given in {"set": changes, **sets}.items():
        if given:
            raise InputError(f"--{option} {given[0]!r} is given without a deck; allowed: a netlist file before it")
    return None


def _write(answer: Answering, circuit: Circuit | None, deck: Path | None, output: Path) -> None:
    """Write the page of a circuit, or of the examples, as one file."""
    from fingerspice.base.files import write_aside
    from fingerspice.explorer.gallery import static_page

    check_output(output, deck)
    page = static_page(circuit)
    answer.give(str, [lambda: write_aside(output, lambda path: path.write_text(page, encoding="utf-8"))])
