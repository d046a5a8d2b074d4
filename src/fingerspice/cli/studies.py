"""The commands `design` and `limits`, which find a drive, a map of friction, or where the mobile law folds.

The commands `fit` and `fit-contact`, which fit parameters of a deck to measured data: table and picture.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from typer import Argument, Option

from fingerspice.base.announcing import paced
from fingerspice.base.errors import InputError
from fingerspice.base.units import parse_number
from fingerspice.cli.options import Job, Results
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
    job: Job,
    table: Annotated[Path, Argument(metavar="FRICTION.csv", help="Columns time and friction, or force (N).")],
    carrier: Annotated[str | None, Option(metavar="HZ", help="Carrier of the drive; none by default.")] = None,
    limit: Annotated[str | None, Option(metavar="V", help="Largest voltage of the source.")] = None,
    slew: Annotated[str | None, Option(metavar="V/S", help="Its largest change.")] = None,
    rate: Annotated[str | None, Option(metavar="HZ", help="Samples per second of the table and drive.")] = None,
) -> None:
    """Find the drive of DECK that makes the friction (or force) of a table: WAV, CSV, prediction and picture.

    Example:

      fingerspice design wanted.csv circuits/fingerpad_5khz.cir --carrier 5k --limit 200
    """
    from fingerspice.studies.design.inverse import inverse_drive, read_wanted

    circuit = job.read()
    given = {"carrier": carrier, "limit": limit, "slew": slew, "rate": rate}
    numbers = {key: number(f"--{key}", text) for key, text in given.items()}
    results = Results(job, circuit)
    kind, wave, end = read_wanted(table, numbers["rate"])
    results.will_write("_drive.wav", lambda file: found.to_wav(file))
    results.will_write("_drive.csv", lambda file: found.to_csv(file))
    results.will_write("_friction.csv", lambda file: found.friction_to_csv(file))
    results.will_draw("_design.png", lambda: found.plot())
    wanted: dict[str, Any] = {kind: wave}
    found = inverse_drive(circuit, duration=end, charge_law=job.charge_law, **numbers, **wanted)
    job.answer.update(**found.to_dict())
    job.answer.give(lambda: str(found), results.ready())


def limits(
    job: Job,
    points: Annotated[int, Option(help="Values of each parameter.")] = 9,
    span: Annotated[float, Option(help="Each goes from its value over this to its value times this.")] = 10.0,
    capability: Annotated[bool, Option("--capability", help="Map the friction it can make instead.")] = False,
    limit: Annotated[str | None, Option(metavar="V", help="--capability: largest voltage of the source.")] = None,
    carrier: Annotated[str | None, Option(metavar="HZ", help="--capability: of the drive; none.")] = None,
) -> None:
    """Map where DECK folds under the mobile charge law: source voltage against load, gap and frequency.

    Examples:

      fingerspice limits circuits/fingerpad.cir --set Xgap.d=100n --points 7 --out out

      fingerspice limits circuits/fingerpad.cir --capability --limit 150 --carrier 5k
    """
    from fingerspice.studies.design.folds import fold_limits, grid_of

    job.charge_law = None if capability else "mobile"
    job.answer.update(charge_law=job.charge_law)
    circuit = job.read()
    if not capability:
        if limit is not None or carrier is not None:
            raise InputError("--limit and --carrier belong to --capability")
        grid_of(points, span)
    largest, tone = number("--limit", limit), number("--carrier", carrier)
    results = Results(job, circuit)
    end = "_capability" if capability else "_limits"
    results.will_write(f"{end}.csv", lambda file: found.to_csv(file))
    results.will_draw(f"{end}.png", lambda: found.plot())
    found: Any
    if capability:
        from fingerspice.studies.design.inverse import capability as friction_map

        if largest is None:
            # The peak of the deck's own sources.
            stop, own = circuit.tran.stop if circuit.tran else 1.0, circuit.by_device("V")
            largest = max((e.waveform.peak(0.0, stop) for e in own if e.waveform is not None), default=0.0)
        with paced("looking for the largest amplitudes") as update:
            found = friction_map(circuit, largest, carrier=tone, progress=update)
    else:
        with paced("looking for folds") as update:
            found = fold_limits(circuit, points=points, span=span, progress=update)
    job.answer.update(**({"capability": found.to_dict()} if capability else found.to_dict()))
    job.answer.give(lambda: str(found), results.ready())


def fit(
    job: Job,
    table: Annotated[Path, Argument(metavar="DATA.csv", help="Conditions and a measured mean, with units.")],
    free: Annotated[str, Option(metavar="PATH,...", help="Parameters to fit: Xgap.d,Xgap.r.")],
    groups: Annotated[
        str | None, Option(metavar="COLUMN:PATH,...", help="Free parameters of each group: finger:Xgap.d.")
    ] = None,
    average: Annotated[str, Option(help="periodic (periodic state) or run (over the deck's run).")] = "periodic",
    skin: Annotated[str, Option(help="own, or follow: a SKIN's f is the source's frequency.")] = "own",
    profile: Annotated[bool, Option("--profile", help="Profile likelihood of every parameter.")] = False,
) -> None:
    """Fit parameters of DECK to measured means or a signal over time: values with intervals, CSV and picture.

    Example:

      fingerspice fit circuits/measured.csv circuits/fingerpad.cir --free Xgap.d,Xgap.r --skin follow
    """
    from fingerspice.studies.fit.circuitfit import fit as find

    grouped = None
    if groups is not None:
        column, _, paths = groups.partition(":")
        if not (column.strip() and paths.strip()):
            allowed = "a column of the data and paths, such as finger:Xgap.d,Xgap.r"
            raise InputError(f"--groups is {groups!r}; allowed: {allowed}")
        grouped = {column.strip(): [path.strip() for path in paths.split(",")]}
    circuit = job.read()
    results = Results(job, circuit)
    results.will_write("_fit.csv", lambda file: found.to_csv(file))
    results.will_draw("_fit.png", lambda: found.plot())
    found = find(
        circuit, table, [path.strip() for path in free.split(",")], groups=grouped, average=average, skin=skin,
        charge_law=job.charge_law, profiles=profile,
    )  # fmt: skip
    job.answer.update(**found.to_dict())
    job.answer.give(lambda: str(found), results.ready())


def fit_contact(
    job: Job,
    tables: Annotated[list[Path], Argument(metavar="DATA.csv ...", help="Areas and friction forces, with units.")],
    free: Annotated[
        str | None, Option(metavar="NAME,...", help="alpha,m_exp,beta,n_exp,mu,c2; those that the data tell.")
    ] = None,
    finger: Annotated[str | None, Option(metavar="GAP", help="Which of several GAPs.")] = None,
    profile: Annotated[bool, Option("--profile", help="Profile likelihood of every parameter.")] = False,
) -> None:
    """Fit the contact of DECK's finger to measured ridge areas and friction forces: values with intervals.

    Example:

      fingerspice fit-contact circuits/contact.csv circuits/indentation.csv circuits/fingerpad.cir
    """
    from fingerspice.studies.fit.contactfit import fit_contact as find

    circuit = job.read()
    names = None if free is None else [one.strip() for one in free.split(",")]
    found = find(circuit, list(tables), names, finger=finger, profiles=profile)
    results = Results(job, circuit)
    results.will_write("_contact.csv", found.to_csv)
    results.will_draw("_contact.png", found.plot)
    job.answer.update(**found.to_dict())
    job.answer.give(lambda: str(found), results.ready())
