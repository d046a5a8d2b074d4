"""The commands for studies: tables, files and pictures of each.

`design` finds a drive, `limits` a map of friction or where the mobile law folds; `fit` and `fit-contact` fit parameters
of a deck to measured data; `sweep` runs a grid or a random population that a TOML file describes.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

from typer import Argument, Option

from fingerspice.base.announcing import paced
from fingerspice.base.errors import InputError
from fingerspice.base.files import write_aside
from fingerspice.base.units import parse_number
from fingerspice.cli.options import Job, Results
from fingerspice.cli.terminal import Answering
from fingerspice.waveforms.waveform import require

#: Keys of a sweep's file, and the arguments of `batch` among them.
_KEYS = ("deck", "n", "seed", "indices", "outputs", "rtol", "t_stop", "periods", "periodic", "skin", "parameters")
_OPTIONS = ("outputs", "rtol", "t_stop", "periods", "periodic", "skin")
#: Kinds of a parameter there, with the numbers that each takes.
_KINDS = {
    "values": "[a, b, ...]", "linear": "[first, last, count]", "log": "[first, last, count]",
    "uniform": "[low, high]", "loguniform": "[low, high]", "normal": "[mean, standard deviation]",
    "lognormal": "[median, standard deviation of the logarithm]",
}  # fmt: skip
#: Largest number of messages about scenes without a result that are printed.
_MOST_TOLD = 8
#: Largest size of a sweep's file, bytes.
_LARGEST = 1 << 20


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
    from fingerspice.studies.inverse import inverse_drive, read_wanted

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
    from fingerspice.studies.limits import fold_limits, grid_of

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
        from fingerspice.studies.limits import capability as friction_map

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


def sweep(
    job: Job,
    file: Annotated[Path, Argument(metavar="SWEEP.toml", help="Deck, parameters and outputs.")],
    store: Annotated[
        Path | None,
        Option(metavar="OUT.zarr", help="Write piece by piece to a Zarr store, which a second call goes on with."),
    ] = None,
    workers: Annotated[int | None, Option(metavar="N", help="With --store: in N processes.")] = None,
    scheduler: Annotated[
        str | None, Option(metavar="ADDRESS", help="With --store: by the workers of a Dask scheduler.")
    ] = None,
    shard: Annotated[
        str | None, Option(metavar="I/M", help="With --store: the I-th of M parts, from 1/M to M/M.")
    ] = None,
) -> None:
    """Run a grid or a random population of parameters: table, NetCDF, picture, and what the variance comes from.

    Example:

      fingerspice sweep circuits/population.toml
    """
    from fingerspice.plots.picture import plot_sweep
    from fingerspice.studies.sweep import populations

    asked, job.deck = _read(file)
    job.name = job.name or file.stem
    circuit = job.read()
    parameters = {path: _parameter(path, one) for path, one in asked["parameters"].items()}
    options = {key: asked[key] for key in ("n", "seed", *_OPTIONS) if key in asked}
    if store is None:
        for option, given in (("workers", workers), ("scheduler", scheduler), ("shard", shard)):
            if given is not None:
                raise InputError(f"--{option} is given without --store; allowed: --store OUT.zarr, too")
        results = Results(job, circuit)
        own = {"deck": circuit.text}
        results.will_write(".nc", lambda path: _written(found, indices, own | results.about, path))
        results.will_draw(".png", lambda: plot_sweep(found, output, indices))
    else:
        if asked.get("indices"):
            raise InputError(f"{file}: indices = true and --store are both given; allowed: one of them")
        if (part := re.fullmatch("([0-9]+)/([0-9]+)", "1/1" if shard is None else shard)) is None:
            raise InputError(f"--shard is {shard!r}; allowed: two whole numbers such as 1/8")
        part_of = int(part[1]), int(part[2])
        options |= {"store": store, "workers": workers, "scheduler": scheduler, "shard": part_of}
    found = populations.sweep(circuit, parameters, **options)
    answer, about = job.answer, found.attrs
    known = {"sets": about.get("sets", []), "n": about.get("n"), "seed": about.get("seed")}
    answer.update(scenes=int(found.status.size), **known)
    if store is not None:
        answer.data["files"].append(str(store))
        answer.update(store={key: about[key] for key in ("chunks", "chunks_found", "chunks_missing", "seconds")})
        whole = not about["chunks_missing"] and found.status.size <= populations.MOST_SCENES
        said = [_told(answer, found)] if whole else []
        said.append(f"{about['chunks']:,} pieces ({about['chunks_found']:,} were there already) in {store}")
        if about["chunks_missing"]:
            said.append(f"{about['chunks_missing']:,} pieces of other parts are missing")
        answer.give(lambda: "\n".join([*said, *about["failures"][:_MOST_TOLD]]))
        return
    output = str(next(iter(found.data_vars)))
    indices = populations.sobol(circuit, parameters, **options) if asked.get("indices") else None
    said = [_told(answer, found)]
    if indices is not None:
        shares = populations.ranking(indices, output)
        answer.update(shares=shares)
        said.append(_shared(shares, output))
    answer.give(lambda: "\n\n".join(said), results.ready())


def _told(answer: Answering, found: Any) -> str:
    """Fill the answer with the percentiles of a whole sweep, which this text has."""
    from fingerspice.studies.sweep.populations import summary

    rows = summary(found)
    answer.update(figures=rows, failed=int((found.status >= 2).sum()))
    lines = [f"{'output':<24}{'unit':<8}{'5 %':>12}{'median':>12}{'95 %':>12}{'mean':>12}"]
    for row in rows:
        figures = [f"{row[key]:>12.4g}" for key in ("p5", "median", "p95", "mean")]
        lines.append(f"{row['output']:<24}{row['unit']:<8}{''.join(figures)}")
    return "\n".join(lines)


def _read(file: Path) -> tuple[dict[str, Any], Path]:
    """The file's keys, checked, and the deck."""
    try:
        if file.stat().st_size > _LARGEST:
            raise InputError(f"{file} has {file.stat().st_size:,} bytes; allowed: at most {_LARGEST:,}")
        asked = tomllib.loads(file.read_text(encoding="utf-8"))
    except (OSError, UnicodeError, ValueError) as error:
        raise InputError(f"{file} cannot be read as TOML: {error}") from None
    for key in asked:
        if key not in _KEYS:
            raise InputError(f"{file}: unknown key {key!r}; allowed: {', '.join(_KEYS)}")
    for key, kind in (("deck", str), ("parameters", dict)):
        if not isinstance(asked.get(key), kind) or not asked[key]:
            what = "the deck's file name" if key == "deck" else "a table such as [parameters] with Xgap.d = {...}"
            raise InputError(f"{file}: {key} is {asked.get(key)!r}; allowed: {what}")
    folder = file.resolve().parent
    deck = (folder / asked["deck"]).resolve()
    if not deck.is_relative_to(folder):
        raise InputError(f"{file}: deck is {asked['deck']!r}; allowed: a file in the same folder or below it")
    return asked, deck


def _parameter(path: str, one: Any) -> Any:
    """Numbers or a distribution from ``{kind = [numbers]}``; names of sets as they are."""
    import numpy as np
    from scipy import stats

    from fingerspice.sets.parameters import KINDS

    if path in KINDS:
        # The sweep looks the sets up, and says what is allowed.
        return one
    if isinstance(one, int | float) and not isinstance(one, bool):
        return float(one)
    allowed = "a number, or one of " + ", ".join(f"{{{kind} = {what}}}" for kind, what in _KINDS.items())
    if not isinstance(one, Mapping) or len(one) != 1 or next(iter(one)) not in _KINDS:
        raise InputError(f"{path} is {one!r}; allowed: {allowed}")
    kind, numbers = next(iter(one.items()))
    allowed = _KINDS[kind]
    good = isinstance(numbers, list) and len(numbers) > 0 and all(isinstance(x, int | float) for x in numbers)
    if good and kind == "values":
        return np.array(numbers, float)
    if good and len(numbers) == allowed.count(",") + 1 == 3:
        allowed += ", a whole count, for log above 0"
        first, last, count = map(float, numbers)
        if count.is_integer() and 1 <= count <= 100_000 and (kind == "linear" or min(first, last) > 0.0):
            return (np.linspace if kind == "linear" else np.geomspace)(first, last, int(count))
    elif good and len(numbers) == allowed.count(",") + 1:
        allowed += ", ascending or above 0"
        a, b = map(float, numbers)
        if (a < b if kind.endswith("uniform") else b > 0.0) and (a > 0.0 or not kind.startswith("log")):
            if kind.startswith("log"):
                return stats.loguniform(a, b) if kind == "loguniform" else stats.lognorm(b, scale=a)
            return stats.uniform(a, b - a) if kind == "uniform" else stats.norm(a, b)
    raise InputError(f"{path}: {kind} is {numbers!r}; allowed: {allowed}")


def _shared(rows: list[dict[str, Any]], output: str) -> str:
    """Total indices as text: a line for each place, a column for each parameter, and what is largest where."""
    widths = {name: max(len(name), 16) + 2 for name in sorted({row["parameter"] for row in rows}, key=str.lower)}
    lines: dict[str, dict[str, str]] = {}
    first: dict[str, list[str]] = {}
    for row in rows:
        # A number, or the name of a set.
        shown = {name: x if isinstance(x, str) else f"{x:.4g}" for name, x in row["place"].items()}
        place = ", ".join(f"{name} = {text}" for name, text in shown.items())
        if place not in lines:
            first.setdefault(row["parameter"], []).append(place)
        told = f"{row['total']:.2f} ({row['low']:.2f}-{row['high']:.2f})"
        lines.setdefault(place, {})[row["parameter"]] = told
    wide = max(len(place) for place in lines) + 2 * any(lines)
    head = " " * wide + "".join(f"{name:>{width}}" for name, width in widths.items())
    body = [
        f"{place:<{wide}}" + "".join(f"{told[name]:>{width}}" for name, width in widths.items())
        for place, told in lines.items()
    ]
    most = "; ".join(
        name + ("" if len(first) == 1 else f" ({places[0]}{f' to {places[-1]}' if len(places) > 1 else ''})")
        for name, places in first.items()
    )
    title = f"share of the variance of {output} that comes from a parameter, its interactions included (95 % interval)"
    return "\n".join([title, head, *body, f"largest share: {most}"])


def _written(found: Any, indices: Any, about: Mapping[str, str], path: Path) -> Path:
    """Write both Datasets into one NetCDF file, with what it is about."""
    whole = found if indices is None else found.merge(indices, compat="override", combine_attrs="drop_conflicts")
    known = {key: value for key, value in whole.attrs.items() if value is not None and value != []}
    whole.attrs = {**known, **about}
    return write_aside(path, lambda aside: whole.to_netcdf(aside, engine="h5netcdf"))
