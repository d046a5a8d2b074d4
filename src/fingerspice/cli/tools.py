"""The commands around runs: `sets`, `check`, `export`, `explore` and `figures`."""

from __future__ import annotations

import signal
import time
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from fingerspice.base.errors import InputError
from fingerspice.base.files import write_aside
from fingerspice.cli import terminal
from fingerspice.cli.options import check_output, read_circuit, with_times
from fingerspice.cli.result_files import FOLDER
from fingerspice.cli.terminal import Answering, progress


def sets(
    name: Annotated[str | None, typer.Argument(metavar="[NAME]", help="A set; without it all are listed.")] = None,
    as_json: terminal.AsJson = False,
) -> None:
    """List the named sets of parameters, or show the values of one with their ranges and sources.

    Examples:

      fingerspice sets

      fingerspice sets moist
    """
    from fingerspice.sets.parameters import parameters

    with Answering("sets", as_json) as answer:
        found = parameters() if name is None else parameters(name)
        shown = parameters().values() if name is None else [parameters(name)]
        answer.update(parameter_sets=[one.to_dict() for one in shown])
        answer.give(lambda: str(found))


def check(
    store: Annotated[Path, typer.Argument(metavar="STORE", help="Folder that run --stream or sweep --store wrote.")],
    as_json: terminal.AsJson = False,
) -> None:
    """Verify that every chunk of a store is as it was written.

    Example:

      fingerspice check out/long.zarr
    """
    from fingerspice.results.runfile import check_store

    with Answering("check", as_json) as answer:
        chunks = check_store(store)
        answer.update(chunks=chunks)
        said = f"{store}: {sum(chunks.values()):,} chunks of {len(chunks)} arrays are as they were written"
        answer.give(lambda: said)


def export(
    deck: terminal.Deck,
    output: Annotated[Path, typer.Option("--output", "-o", metavar="FILE", help="The ngspice deck to write.")],
    charge_law: terminal.ChargeLaw = None,
    changes: terminal.Set = None,
    source: terminal.Source = None,
    stop: terminal.Stop = None,
    as_json: terminal.AsJson = False,
) -> None:
    """Write DECK as one self-contained ngspice deck: bodies included, parameters folded in.

    Example:

      fingerspice export circuits/fingerpad.cir -o fingerpad_ngspice.cir
    """
    from fingerspice.studies.export import export_netlist

    with Answering("export", as_json, charge_law=charge_law) as answer:
        circuit = read_circuit(deck, changes, source)
        answer.update(**terminal.of_circuit(circuit, charge_law))
        circuit, _ = with_times(circuit, stop)
        check_output(output, deck)
        text = export_netlist(circuit, charge_law=charge_law)
        answer.give(str, [lambda: write_aside(output, lambda path: path.write_text(text, encoding="utf-8"))])


def explore(
    deck: Annotated[
        Path | None, typer.Argument(metavar="[DECK]", help="Netlist file (.cir); the page has examples of its own.")
    ] = None,
    changes: terminal.Set = None,
    finger: terminal.Finger = None,
    coating: terminal.Coating = None,
    drive: terminal.Drive = None,
    port: Annotated[int, typer.Option(help="Port of the loopback address; 0 takes a free one.")] = 0,
    no_browser: Annotated[bool, typer.Option("--no-browser", help="Print the link, and open no browser.")] = False,
    static: Annotated[
        Path | None, typer.Option("--static", metavar="OUT.html", help="Write the page as one file, and serve nothing.")
    ] = None,
    as_json: terminal.AsJson = False,
) -> None:
    """Open a local page on which DECK's values move and the run follows; Ctrl-C ends it.

    Examples:

      fingerspice explore circuits/fingerpad.cir

      fingerspice explore circuits/fingerpad.cir --finger moist --coating 3M-insulating

      fingerspice explore --port 8000 --no-browser

      fingerspice explore circuits/click.cir --static click.html
    """
    from fingerspice.explorer.server import Explorer

    ended: list[int] = []
    with Answering("explore", as_json) as answer:
        circuit, sets = None, {"finger": finger, "coating": coating, "drive": drive}
        if deck is not None:
            circuit = read_circuit(deck, changes, None, **sets)
            answer.update(**terminal.of_circuit(circuit, None))
        for option, given in {"set": changes, **sets}.items():
            if given and deck is None:
                raise InputError(f"--{option} {given[0]!r} is given without a deck; allowed: a netlist file before it")
        if static is not None:
            from fingerspice.explorer.server import static_page

            check_output(static, deck)
            page = static_page(circuit)
            answer.give(str, [lambda: write_aside(static, lambda path: path.write_text(page, encoding="utf-8"))])
            return
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


def figures(
    out: terminal.Out = None,
    only: Annotated[list[int] | None, typer.Option(help="Only these of the paper's figures 2 to 5.")] = None,
    gallery: Annotated[
        bool,
        typer.Option("--gallery", help="The explorer's scenes instead, and the decks in the folder circuits."),
    ] = False,
    as_json: terminal.AsJson = False,
) -> None:
    """Draw the paper's Figs. 2 to 5 from scratch, each as PNG with its data as CSV; or a gallery.

    Examples:

      fingerspice figures --out out --only 4 --only 5

      fingerspice figures --gallery
    """
    folder = out or FOLDER
    with Answering("figures", as_json) as answer:
        if gallery and only:
            raise InputError("--only and --gallery are both given; allowed: one of them")
        if gallery:
            from fingerspice.explorer.scene import decks, draw, scenes

            # The decks are those of `circuits` below the current folder.
            entries, folder = [*decks(Path("circuits")), *scenes()], folder / "gallery"
            files = [folder / f"{one.name}.png" for one in entries]
            for file in files:
                check_output(file)
            folder.mkdir(parents=True, exist_ok=True)
            with progress("drawing") as update:
                for i, (one, file) in enumerate(zip(entries, files, strict=True), 1):
                    draw(one, file)
                    if update is not None:
                        update(i / len(files))
        else:
            from fingerspice.studies.figures import FIGURES, make_figures

            for number in only or FIGURES:
                for kind in ("png", "csv"):
                    check_output(folder / f"fig{number}.{kind}")
            with progress("drawing") as update:
                files = make_figures(folder, only=only, progress=update)
        answer.give(str, [partial(Path, file) for file in files])
