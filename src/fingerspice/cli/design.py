"""The commands `design` and `limits`, which find a drive, a map of friction, or where the mobile law folds."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer

from fingerspice.base.errors import InputError
from fingerspice.base.units import parse_number
from fingerspice.circuit.circuit import Circuit
from fingerspice.cli import answers
from fingerspice.cli.answers import AsJson, ChargeLaw, Deck, Name, NoPlot, Out, Overwrite, Set, Source
from fingerspice.cli.options import read_circuit
from fingerspice.cli.result_files import Results
from fingerspice.cli.terminal import Answering, progress
from fingerspice.waveforms.waveform import require

Writes = list[Callable[[], Path]]


def number(option: str, text: str | None) -> float | None:
    """The positive number of an option, with SPICE's scales; None if the option is not given.

    Raises
    ------
    InputError
        If the text is not a positive number.
    """
    if text is None:
        return None
    try:
        value = parse_number(text)
    except ValueError as error:
        raise InputError(f"{option}: {error}") from None
    require(value > 0.0, option, text, "> 0")
    return value


def find_drive(
    table: Path, circuit: Circuit, results: Results, picture: bool, options: dict[str, Any]
) -> tuple[Any, Writes]:
    """The drive for the friction or force of a table, and the functions that write its files."""
    from fingerspice.studies.design.inverse import inverse_drive
    from fingerspice.studies.wanted import read_wanted

    kind, profile = read_wanted(table, options["rate"])
    files = [results.file(end) for end in ("_drive.wav", "_drive.csv", "_friction.csv")]
    image = results.file("_design.png") if picture else None
    found = inverse_drive(circuit, duration=profile.duration, **{**options, kind: profile.wave})
    results.open()
    return found, [
        lambda: found.to_wav(files[0]), lambda: found.to_csv(files[1]), lambda: found.friction_to_csv(files[2]),
        *results.pictures(image, found.plot),
    ]  # fmt: skip


def map_capability(
    circuit: Circuit, results: Results, picture: bool, limit: float | None, carrier: float | None
) -> tuple[Any, Writes]:
    """The map of the friction that the screen can produce, and the functions that write its files."""
    from fingerspice.studies.design.capability import capability as find

    if limit is None:
        peaks = [e.waveform.peak(0.0, circuit.tran.stop if circuit.tran else 1.0)
                 for e in circuit.by_device("V") if e.waveform is not None]  # fmt: skip
        limit = max(peaks, default=0.0)
    table = results.file("_capability.csv")
    image = results.file("_capability.png") if picture else None
    with progress("looking for the largest amplitudes") as update:
        found = find(circuit, limit, carrier=carrier, progress=update)
    results.open()
    return found, [lambda: found.to_csv(table), *results.pictures(image, found.plot)]


def design(
    table: Annotated[Path, typer.Argument(metavar="FRICTION.csv", help="Columns time and friction, or force (N).")],
    deck: Deck,
    out: Out = None,
    name: Name = None,
    overwrite: Overwrite = False,
    carrier: Annotated[str | None, typer.Option(metavar="HZ", help="Carrier of the drive; none by default.")] = None,
    limit: Annotated[str | None, typer.Option(metavar="V", help="Largest voltage of the source.")] = None,
    slew: Annotated[str | None, typer.Option(metavar="V/S", help="Its largest change.")] = None,
    rate: Annotated[str | None, typer.Option(metavar="HZ", help="Samples per second of the table and drive.")] = None,
    charge_law: ChargeLaw = None,
    changes: Set = None,
    as_json: AsJson = False,
    no_plot: NoPlot = False,
) -> None:
    """Find the drive of DECK that makes the friction (or force) of a table: WAV, CSV, prediction and picture.

    Example:

      fingerspice design wanted.csv circuits/fingerpad_5khz.cir --carrier 5k --limit 200
    """
    with Answering("design", as_json, charge_law=charge_law) as answer:
        circuit = read_circuit(deck, changes, None)
        answer.update(**answers.of_circuit(circuit, charge_law))
        given = {"carrier": carrier, "limit": limit, "slew": slew, "rate": rate}
        numbers = {key: number(f"--{key}", text) for key, text in given.items()}
        results = Results(deck, circuit, out, name, overwrite, charge_law)
        found, writes = find_drive(table, circuit, results, not no_plot, {**numbers, "charge_law": charge_law})
        answer.update(**found.to_dict())
        answer.give(lambda: str(found), writes)


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
    from fingerspice.studies.design.folds import fold_limits, grid_of

    law = None if capability else "mobile"
    with Answering("limits", as_json, charge_law=law) as answer:
        circuit = read_circuit(deck, changes, source)
        if capability:
            answer.update(**answers.of_circuit(circuit, None))
            numbers = number("--limit", limit), number("--carrier", carrier)
            results = Results(deck, circuit, out, name, overwrite, None)
            found, writes = map_capability(circuit, results, not no_plot, *numbers)
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
        writes = [lambda: result.to_csv(table), *results.pictures(picture, result.plot)]
        answer.update(**result.to_dict())
        answer.give(lambda: str(result), writes)
