"""The commands `design` and `limits`, which find a drive, a map of friction, or where the mobile law folds.

The commands `fit` and `fit-contact`, which fit parameters of a deck to measured data: table and picture.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from fingerspice.base.errors import InputError
from fingerspice.base.units import parse_number
from fingerspice.cli import terminal
from fingerspice.cli.options import read_circuit
from fingerspice.cli.result_files import Results
from fingerspice.cli.terminal import Answering, AsJson, ChargeLaw, Deck, Name, NoPlot, Out, Overwrite, Set, progress
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
    deck: terminal.Deck,
    out: terminal.Out = None,
    name: terminal.Name = None,
    overwrite: terminal.Overwrite = False,
    carrier: Annotated[str | None, typer.Option(metavar="HZ", help="Carrier of the drive; none by default.")] = None,
    limit: Annotated[str | None, typer.Option(metavar="V", help="Largest voltage of the source.")] = None,
    slew: Annotated[str | None, typer.Option(metavar="V/S", help="Its largest change.")] = None,
    rate: Annotated[str | None, typer.Option(metavar="HZ", help="Samples per second of the table and drive.")] = None,
    charge_law: terminal.ChargeLaw = None,
    changes: terminal.Set = None,
    as_json: terminal.AsJson = False,
    no_plot: terminal.NoPlot = False,
) -> None:
    """Find the drive of DECK that makes the friction (or force) of a table: WAV, CSV, prediction and picture.

    Example:

      fingerspice design wanted.csv circuits/fingerpad_5khz.cir --carrier 5k --limit 200
    """
    from fingerspice.studies.inverse import inverse_drive, read_wanted

    with Answering("design", as_json, charge_law=charge_law) as answer:
        circuit = read_circuit(deck, changes, None)
        answer.update(**terminal.of_circuit(circuit, charge_law))
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
    deck: terminal.Deck,
    out: terminal.Out = None,
    name: terminal.Name = None,
    overwrite: terminal.Overwrite = False,
    points: Annotated[int, typer.Option(help="Values of each parameter.")] = 9,
    span: Annotated[float, typer.Option(help="Each goes from its value over this to its value times this.")] = 10.0,
    capability: Annotated[bool, typer.Option("--capability", help="Map the friction it can make instead.")] = False,
    limit: Annotated[str | None, typer.Option(metavar="V", help="--capability: largest voltage of the source.")] = None,
    carrier: Annotated[str | None, typer.Option(metavar="HZ", help="--capability: of the drive; none.")] = None,
    changes: terminal.Set = None,
    source: terminal.Source = None,
    as_json: terminal.AsJson = False,
    no_plot: terminal.NoPlot = False,
) -> None:
    """Map where DECK folds under the mobile charge law: source voltage against load, gap and frequency.

    Examples:

      fingerspice limits circuits/fingerpad.cir --set Xgap.d=100n --points 7 --out out

      fingerspice limits circuits/fingerpad.cir --capability --limit 150 --carrier 5k
    """
    from fingerspice.studies.limits import fold_limits, grid_of

    law = None if capability else "mobile"
    with Answering("limits", as_json, charge_law=law) as answer:
        circuit = read_circuit(deck, changes, source)
        if not capability:
            if limit is not None or carrier is not None:
                raise InputError("--limit and --carrier belong to --capability")
            grid_of(points, span)
        answer.update(**terminal.of_circuit(circuit, law))
        largest, tone = number("--limit", limit), number("--carrier", carrier)
        results = Results(deck, circuit, out, name, overwrite, law)
        end = "_capability" if capability else "_limits"
        results.will_write(f"{end}.csv", lambda file: found.to_csv(file))
        results.will_draw(f"{end}.png", lambda: found.plot(), unless=no_plot)
        found: Any
        if capability:
            from fingerspice.studies.limits import capability as friction_map

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


def fit(
    table: Annotated[Path, typer.Argument(metavar="DATA.csv", help="Conditions and a measured mean, with units.")],
    deck: Deck,
    free: Annotated[str, typer.Option(metavar="PATH,...", help="Parameters to fit: Xgap.d,Xgap.r.")],
    groups: Annotated[
        str | None, typer.Option(metavar="COLUMN:PATH,...", help="Free parameters of each group: finger:Xgap.d.")
    ] = None,
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
        from fingerspice.studies.fit.circuitfit import fit as find

        grouped = None
        if groups is not None:
            column, _, paths = groups.partition(":")
            if not (column.strip() and paths.strip()):
                allowed = "a column of the data and paths, such as finger:Xgap.d,Xgap.r"
                raise InputError(f"--groups is {groups!r}; allowed: {allowed}")
            grouped = {column.strip(): [path.strip() for path in paths.split(",")]}
        circuit = read_circuit(deck, changes, None)
        answer.update(**terminal.of_circuit(circuit, charge_law))
        results = Results(deck, circuit, out, name, overwrite, charge_law)
        results.will_write("_fit.csv", lambda file: found.to_csv(file))
        results.will_draw("_fit.png", lambda: found.plot(), unless=no_plot)
        found = find(
            circuit, table, [path.strip() for path in free.split(",")], groups=grouped, average=average, skin=skin,
            charge_law=charge_law, profiles=profile,
        )  # fmt: skip
        answer.update(**found.to_dict())
        answer.give(lambda: str(found), results.ready())


def fit_contact(
    tables: Annotated[
        list[Path], typer.Argument(metavar="DATA.csv ...", help="Areas and friction forces, with units.")
    ],
    deck: Deck,
    free: Annotated[
        str | None, typer.Option(metavar="NAME,...", help="alpha,m_exp,beta,n_exp,mu,c2; those that the data tell.")
    ] = None,
    finger: Annotated[str | None, typer.Option(metavar="GAP", help="Which of several GAPs.")] = None,
    out: Out = None,
    name: Name = None,
    overwrite: Overwrite = False,
    profile: Annotated[bool, typer.Option("--profile", help="Profile likelihood of every parameter.")] = False,
    changes: Set = None,
    as_json: AsJson = False,
    no_plot: NoPlot = False,
) -> None:
    """Fit the contact of DECK's finger to measured ridge areas and friction forces: values with intervals.

    Example:

      fingerspice fit-contact circuits/contact.csv circuits/indentation.csv circuits/fingerpad.cir
    """
    with Answering("fit-contact", as_json) as answer:
        from fingerspice.studies.fit.contactfit import fit_contact as find

        circuit = read_circuit(deck, changes, None)
        answer.update(**terminal.of_circuit(circuit, None))
        names = None if free is None else [one.strip() for one in free.split(",")]
        found = find(circuit, list(tables), names, finger=finger, profiles=profile)
        results = Results(deck, circuit, out, name, overwrite, None)
        results.will_write("_contact.csv", found.to_csv)
        results.will_draw("_contact.png", found.plot, unless=no_plot)
        answer.update(**found.to_dict())
        answer.give(lambda: str(found), results.ready())
