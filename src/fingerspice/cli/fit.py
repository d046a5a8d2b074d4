"""The command `fit`, which fits parameters of a deck to measured data and writes table and picture."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer

from fingerspice.cli import answers
from fingerspice.cli.arguments import AsJson, ChargeLaw, Deck, Name, NoPlot, Out, Overwrite, Set
from fingerspice.cli.options import read_circuit
from fingerspice.cli.result_files import Results
from fingerspice.cli.terminal import Answering


def fit(
    table: Annotated[Path, typer.Argument(metavar="DATA.csv", help="Conditions and a measured mean, with units.")],
    deck: Deck,
    free: Annotated[str, typer.Option(metavar="PATH,...", help="Parameters to fit: Xgap.d,Xgap.r.")],
    out: Out = None,
    name: Name = None,
    overwrite: Overwrite = False,
    average: Annotated[str, typer.Option(help="periodic (periodic state) or run (over the deck's run).")] = "periodic",
    skin: Annotated[str, typer.Option(help="own, or follow: a SKIN's f is the source's frequency.")] = "own",
    profile: Annotated[bool, typer.Option("--profile", help="Profile likelihood of every parameter.")] = False,
    charge_law: ChargeLaw = None,
    changes: Set = None,
    as_json: AsJson = False,
    no_plot: NoPlot = False,
) -> None:
    """Fit parameters of DECK to measured means or a signal over time: values with intervals, CSV and picture.

    Example:

      fingerspice fit circuits/measured.csv circuits/fingerpad.cir --free Xgap.d,Xgap.r --skin follow
    """
    with Answering("fit", as_json, charge_law=charge_law) as answer:
        from fingerspice.plots.drawing import save
        from fingerspice.studies.fit import fit as find

        circuit = read_circuit(deck, changes, None)
        answer.update(**answers.of_circuit(circuit, charge_law))
        results = Results(deck, circuit, out, name, overwrite, charge_law)
        file, image = results.file("_fit.csv"), None if no_plot else results.file("_fit.png")
        paths = [path.strip() for path in free.split(",")]
        found = find(circuit, table, paths, average=average, skin=skin, charge_law=charge_law, profiles=profile)
        results.open()
        writes: list[Callable[[], Path]] = [lambda: found.to_csv(file)]
        if image is not None:
            writes.append(lambda: save(found.plot(), image, about=results.about))
        answer.update(**found.to_dict())
        answer.give(lambda: str(found), writes)
