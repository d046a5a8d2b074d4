"""The command `limits`, which maps where the mobile law folds, or what friction a largest voltage can make."""

from __future__ import annotations

from typing import Annotated

import typer

from fingerspice.base.errors import InputError
from fingerspice.cli import answers
from fingerspice.cli import design as designs
from fingerspice.cli.answers import AsJson, Deck, Name, NoPlot, Out, Overwrite, Set, Source
from fingerspice.cli.options import read_circuit
from fingerspice.cli.result_files import Results
from fingerspice.cli.terminal import Answering, progress


def limits(
    deck: Deck,
    out: Out = None,
    name: Name = None,
    overwrite: Overwrite = False,
    points: Annotated[int, typer.Option(help="Values of each parameter.")] = 9,
    span: Annotated[float, typer.Option(help="Each goes from its value over this to its value times this.")] = 10.0,
    capability: Annotated[bool, typer.Option("--capability", help="Map the friction it can make instead.")] = False,
    limit: Annotated[str | None, typer.Option(metavar="V", help="--capability: largest voltage of the source.")] = None,
    carrier: Annotated[str | None, typer.Option(metavar="HZ", help="--capability: of the drive; none.")] = None,
    changes: Set = None,
    source: Source = None,
    as_json: AsJson = False,
    no_plot: NoPlot = False,
) -> None:
    """Map where DECK folds under the mobile charge law: source voltage against load, gap and frequency.

    Examples:

      fingerspice limits circuits/fingerpad.cir --set Xgap.d=100n --points 7 --out out

      fingerspice limits circuits/fingerpad.cir --capability --limit 150 --carrier 5k
    """
    from fingerspice.studies.limits import fold_limits, grid_of
    from fingerspice.studies.reports import limits_csv, limits_text

    law = None if capability else "mobile"
    with Answering("limits", as_json, charge_law=law) as answer:
        circuit = read_circuit(deck, changes, source)
        if capability:
            answer.update(**answers.of_circuit(circuit, None))
            numbers = designs.number("--limit", limit), designs.number("--carrier", carrier)
            results = Results(deck, circuit, out, name, overwrite, None)
            found, writes = designs.capability(circuit, results, not no_plot, *numbers)
            answer.update(capability=found.to_dict())
            answer.give(lambda: str(found), writes)
            return
        if limit is not None or carrier is not None:
            raise InputError("--limit and --carrier belong to --capability")
        grid_of(points, span)
        answer.update(**answers.of_circuit(circuit, "mobile"))
        results = Results(deck, circuit, out, name, overwrite, "mobile")
        table = results.file("_limits.csv")
        picture = None if no_plot else results.file("_limits.png")
        with progress("looking for folds") as update:
            result = fold_limits(circuit, points=points, span=span, progress=update)
        results.open()
        writes = [lambda: limits_csv(result, table), *results.pictures(picture, result.plot)]
        answer.update(**result.to_dict())
        answer.give(lambda: limits_text(result), writes)
