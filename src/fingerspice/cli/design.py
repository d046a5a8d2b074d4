"""The commands `design` and `limits`, which find a drive, a map of friction, or where the mobile law folds."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from fingerspice.base.errors import InputError
from fingerspice.base.units import parse_number
from fingerspice.cli import answers
from fingerspice.cli.options import read_circuit
from fingerspice.cli.result_files import Results
from fingerspice.cli.terminal import Answering, progress
from fingerspice.waveforms.waveform import require


def number(option: str, text: str | None) -> float | None:
    """The positive number of an option, with SPICE's scales; None if the option is not given."""
    if text is None:
        return None
    try:
        value = parse_number(text)
    except ValueError as error:
        raise InputError(f"{option}: {error}") from None
    require(value > 0.0, option, text, "> 0")
    return value


def design(
    table: Annotated[Path, typer.Argument(metavar="FRICTION.csv", help="Columns time and friction, or force (N).")],
    deck: answers.Deck,
    out: answers.Out = None,
    name: answers.Name = None,
    overwrite: answers.Overwrite = False,
    carrier: Annotated[str | None, typer.Option(metavar="HZ", help="Carrier of the drive; none by default.")] = None,
    limit: Annotated[str | None, typer.Option(metavar="V", help="Largest voltage of the source.")] = None,
    slew: Annotated[str | None, typer.Option(metavar="V/S", help="Its largest change.")] = None,
    rate: Annotated[str | None, typer.Option(metavar="HZ", help="Samples per second of the table and drive.")] = None,
    charge_law: answers.ChargeLaw = None,
    changes: answers.Set = None,
    as_json: answers.AsJson = False,
    no_plot: answers.NoPlot = False,
) -> None:
    """Find the drive of DECK that makes the friction (or force) of a table: WAV, CSV, prediction and picture.

    Example:

      fingerspice design wanted.csv circuits/fingerpad_5khz.cir --carrier 5k --limit 200
    """
    from fingerspice.studies.design.inverse import inverse_drive, read_wanted

    with Answering("design", as_json, charge_law=charge_law) as answer:
        circuit = read_circuit(deck, changes, None)
        answer.update(**answers.of_circuit(circuit, charge_law))
        given = {"carrier": carrier, "limit": limit, "slew": slew, "rate": rate}
        numbers = {key: number(f"--{key}", text) for key, text in given.items()}
        results = Results(deck, circuit, out, name, overwrite, charge_law)
        kind, wave, end = read_wanted(table, numbers["rate"])
        results.will_write("_drive.wav", lambda file: found.to_wav(file))
        results.will_write("_drive.csv", lambda file: found.to_csv(file))
        results.will_write("_friction.csv", lambda file: found.friction_to_csv(file))
        results.will_draw("_design.png", lambda: found.plot(), unless=no_plot)
        wanted: dict[str, Any] = {kind: wave}
        found = inverse_drive(circuit, duration=end, charge_law=charge_law, **numbers, **wanted)
        answer.update(**found.to_dict())
        answer.give(lambda: str(found), results.ready())


def limits(
    deck: answers.Deck,
    out: answers.Out = None,
    name: answers.Name = None,
    overwrite: answers.Overwrite = False,
    points: Annotated[int, typer.Option(help="Values of each parameter.")] = 9,
    span: Annotated[float, typer.Option(help="Each goes from its value over this to its value times this.")] = 10.0,
    capability: Annotated[bool, typer.Option("--capability", help="Map the friction it can make instead.")] = False,
    limit: Annotated[str | None, typer.Option(metavar="V", help="--capability: largest voltage of the source.")] = None,
    carrier: Annotated[str | None, typer.Option(metavar="HZ", help="--capability: of the drive; none.")] = None,
    changes: answers.Set = None,
    source: answers.Source = None,
    as_json: answers.AsJson = False,
    no_plot: answers.NoPlot = False,
) -> None:
    """Map where DECK folds under the mobile charge law: source voltage against load, gap and frequency.

    Examples:

      fingerspice limits circuits/fingerpad.cir --set Xgap.d=100n --points 7 --out out

      fingerspice limits circuits/fingerpad.cir --capability --limit 150 --carrier 5k
    """
    from fingerspice.studies.design.folds import fold_limits, grid_of

    law = None if capability else "mobile"
    with Answering("limits", as_json, charge_law=law) as answer:
        circuit = read_circuit(deck, changes, source)
        if not capability:
            if limit is not None or carrier is not None:
                raise InputError("--limit and --carrier belong to --capability")
            grid_of(points, span)
        answer.update(**answers.of_circuit(circuit, law))
        largest, tone = number("--limit", limit), number("--carrier", carrier)
        results = Results(deck, circuit, out, name, overwrite, law)
        end = "_capability" if capability else "_limits"
        results.will_write(f"{end}.csv", lambda file: found.to_csv(file))
        results.will_draw(f"{end}.png", lambda: found.plot(), unless=no_plot)
        found: Any
        if capability:
            from fingerspice.studies.design.capability import capability as friction_map

            if largest is None:
                # The peak of the deck's own sources.
                stop, own = circuit.tran.stop if circuit.tran else 1.0, circuit.by_device("V")
                largest = max((e.waveform.peak(0.0, stop) for e in own if e.waveform is not None), default=0.0)
            with progress("looking for the largest amplitudes") as update:
                found = friction_map(circuit, largest, carrier=tone, progress=update)
        else:
            with progress("looking for folds") as update:
                found = fold_limits(circuit, points=points, span=span, progress=update)
        answer.update(**({"capability": found.to_dict()} if capability else found.to_dict()))
        answer.give(lambda: str(found), results.ready())
