"""The commands for studies: `design`, `limits`, `fit`, `fit-contact` and `sweep`; and what a deck asks of `run`."""

from __future__ import annotations

import dataclasses
import re
import tomllib
import warnings
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from pathlib import Path
from typing import Annotated, Any

from typer import Argument

import fingerspice as fs
from fingerspice.base.announcing import paced
from fingerspice.base.errors import InputError
from fingerspice.base.files import write_aside, write_csv
from fingerspice.base.pages import Table
from fingerspice.base.units import amount_text
from fingerspice.cli.options import Job, Makes, number
from fingerspice.waveforms.waveform import refuse, require

#: Keys of a sweep's file, and the arguments of `batch` among them.
_KEYS = ("deck", "n", "seed", "indices", "outputs", "rtol", "t_stop", "periods", "periodic", "skin", "parameters")
_OPTIONS = ("outputs", "rtol", "t_stop", "periods", "periodic", "skin")
#: Kinds of a parameter there, with the numbers that each takes.
_KINDS = {
    "values": "[a, b, ...]", "linear": "[first, last, count]", "log": "[first, last, count]",
    "uniform": "[low, high]", "loguniform": "[low, high]", "normal": "[mean, standard deviation]",
    "lognormal": "[median, standard deviation of the logarithm]",
}  # fmt: skip
_MOST_TOLD, _LARGEST = 8, 1 << 20  # Most messages about scenes without a result; bytes of a sweep's file


def _report(job: Job, circuit: fs.Circuit, files: Mapping[str, str], make: Callable[[], Any], key: str = "") -> None:
    """Give the text and the data of what `make` finds, and write these files by its methods of these names.

    The files are checked first. The data are keys of the answer, or all of them one key.
    """
    job.check_files(circuit, *files)
    found = make()
    job.answer.update({key: found.to_dict()} if key else found.to_dict())
    job.give(lambda: str(found), {end: getattr(found, method) for end, method in files.items()})


def stepped(job: Job, circuit: fs.Circuit, how: Mapping[str, Any], ends: Iterable[str]) -> None:
    """The part of `run` for a deck with `.step`: a table, a data file, and a family of curves."""
    from fingerspice.plots.picture import plot_steps
    from fingerspice.results.rawfile import write_raw_steps

    job.check_files(circuit, *ends)
    said, others = beside_run(job, circuit)
    with paced("simulating the steps") as update:
        found = fs.run_steps(circuit, progress=update, **how)
    rows, columns = _rows(found)
    job.answer.update(steps=rows)
    makes: Makes = {
        ".csv": partial(_write_columns, columns), ".nc": partial(_write_netcdf, job, circuit, found),
        ".png": partial(plot_steps, found),
        ".raw": partial(write_raw_steps, found, [one.name for one in circuit.by_device("GAP")]), **others,
    }  # fmt: skip
    job.give(lambda: "\n\n".join([circuit.title, _first_rows(columns), *said]), makes)


def _rows(found: Any) -> tuple[list[dict[str, Any]], dict[str, list[Any]]]:
    """As `table_of`; steps without a result are warned of."""
    from fingerspice.studies.steps import table_of

    for text in found.attrs["failures"]:
        warnings.warn(text, fs.FingerspiceWarning, stacklevel=2)
    return table_of(found)


def _write_netcdf(job: Job, circuit: fs.Circuit, found: Any, file: Path) -> Path:
    # An empty list cannot be kept in a file.
    known = {key: value for key, value in found.attrs.items() if value != []}
    kept = found.drop_attrs(deep=False).assign_attrs({**known, "deck": circuit.text, **job.about})
    return write_aside(file, lambda aside: kept.to_netcdf(aside, engine="h5netcdf"))


def _write_columns(columns: Mapping[str, Any], file: Path) -> Path:
    return write_csv(file, list(columns), zip(*columns.values(), strict=True))


_FIRST = 40  # Most rows of a table of steps that are printed


def _first_rows(columns: Mapping[str, Any]) -> str:
    """The first rows of columns of numbers and words, as a table."""
    cells = ([x if isinstance(x, str) else f"{x:.6g}" for x in column] for column in columns.values())
    rows = [*zip(*cells, strict=True)]
    more = [f"... {len(rows) - _FIRST:,} more rows"] if len(rows) > _FIRST else []
    return "\n".join([Table(tuple(columns), rows[:_FIRST], left=0).text(), *more])


def ends_beside(circuit: fs.Circuit) -> list[str]:
    """Endings of the files of what a deck asks for beside its run."""
    kinds = {"dc": circuit.dc or (circuit.op and circuit.steps), "ac": circuit.ac}
    both = circuit.ac and circuit.steps
    return [f"_{kind}.{end}" for kind, on in kinds.items() if on for end in ("csv", "png")] + ["_ac.nc"] * bool(both)


def beside_run(job: Job, circuit: fs.Circuit) -> tuple[list[str], Makes]:
    """What a deck asks of `run` by `.op`, `.dc` and `.ac`: texts, and what writes its files by their endings."""
    from fingerspice.results.spectrum import phasor_csv
    from fingerspice.studies.steady import sweep_frequencies

    texts, makes = list[str](), dict[str, Any]()
    if circuit.op and not circuit.steps:
        found = fs.operating_points(dataclasses.replace(circuit, dc=()), charge_law=job.charge_law)
        point = {str(name): float(one) for name, one in found.data_vars.items() if name != "status"}
        job.answer.update(op=point)
        cells = [(name, amount_text(x, found[name].attrs["units"])) for name, x in point.items()]
        texts.append(Table(("operating point", ""), cells).text())
    if circuit.dc or (circuit.op and circuit.steps):
        from fingerspice.plots.picture import plot_steps

        swept = fs.operating_points(circuit, charge_law=job.charge_law)
        rows, columns = _rows(swept)
        job.answer.update(dc=rows)
        makes["_dc.csv"] = partial(_write_columns, columns)
        makes["_dc.png"] = partial(plot_steps, swept)
    if circuit.ac is not None and circuit.steps:
        from fingerspice.plots.picture import plot_steps
        from fingerspice.studies.steps import table_of

        found = fs.phasor_steps(circuit)
        rows, columns = _rows(found)
        wide, n = table_of(found.broadcast_like(found))[1], found.sizes["frequency"]
        lists = {head.partition(" [")[0]: x for head, x in wide.items() if head not in columns}
        sweeps = [row | {name: x[k * n : (k + 1) * n] for name, x in lists.items()} for k, row in enumerate(rows)]
        job.answer.update(sweeps=sweeps)
        makes |= {"_ac.csv": partial(_write_columns, wide), "_ac.png": partial(plot_steps, found),
                  "_ac.nc": partial(_write_netcdf, job, circuit, found)}  # fmt: skip
        texts.append(_first_rows(columns if len(columns) > found.status.ndim + 1 else wide))
    elif circuit.ac is not None:
        from fingerspice.plots.traces import plot_phasor

        one = fs.phasor(circuit, sweep_frequencies(circuit.ac))
        job.answer.update(sweeps=[one.to_dict()] if job.json else None)
        makes |= {"_ac.csv": partial(phasor_csv, (one,)), "_ac.png": partial(plot_phasor, (one,), circuit)}
        texts.append(str(one._page(12)))
    return texts, makes


def design(
    job: Job,
    table: Annotated[Path, Argument(metavar="FRICTION.csv", help="Columns time and friction, or force (N).")],
    carrier: Annotated[str | None, "Carrier of the drive; none by default.", "HZ"] = None,
    limit: Annotated[str | None, "Largest voltage of the source.", "V"] = None,
    slew: Annotated[str | None, "Its largest change.", "V/S"] = None,
    rate: Annotated[str | None, "Samples per second of the table and drive.", "HZ"] = None,
) -> None:
    """Find the drive of DECK that makes the friction (or force) of a table: WAV, CSV, prediction and picture.

    Example:
      fingerspice design wanted.csv circuits/fingerpad_5khz.cir --carrier 5k --limit 200
    """
    from fingerspice.studies.inverse import read_wanted

    circuit = job.read()
    given = {"carrier": carrier, "limit": limit, "slew": slew, "rate": rate}
    numbers = {key: number(f"--{key}", text, positive=True) for key, text in given.items()}
    kind, wave, end = read_wanted(table, numbers["rate"])
    wanted: dict[str, Any] = {kind: wave, "duration": end, "charge_law": job.charge_law, **numbers}
    files = {"_drive.wav": "to_wav", "_drive.csv": "to_csv", "_friction.csv": "friction_to_csv", "_design.png": "plot"}
    _report(job, circuit, files, lambda: fs.inverse_drive(circuit, **wanted))


def limits(
    job: Job,
    points: Annotated[int, "Values of each parameter."] = 9,
    span: Annotated[float, "Each goes from its value over this to its value times this."] = 10.0,
    capability: Annotated[bool, "Map the friction it can make instead."] = False,
    limit: Annotated[str | None, "--capability: largest voltage of the source.", "V"] = None,
    carrier: Annotated[str | None, "--capability: of the drive; none.", "HZ"] = None,
) -> None:
    """Map where DECK folds under the mobile charge law: source voltage against load, gap and frequency.

    Examples:
      fingerspice limits circuits/fingerpad.cir --set Xgap.d=100n --points 7 --out out
      fingerspice limits circuits/fingerpad.cir --capability --limit 150 --carrier 5k
    """
    from fingerspice.studies import limits as study

    job.charge_law = None if capability else "mobile"
    job.answer.update(charge_law=job.charge_law)
    circuit = job.read()
    if not capability:
        refuse(limit is not None or carrier is not None, "--limit and --carrier belong to --capability")
        study.grid_of(points, span)
    largest, tone = number("--limit", limit, positive=True), number("--carrier", carrier, positive=True)
    if capability and largest is None:
        # The peak of the deck's own sources.
        stop, own = circuit.tran.stop if circuit.tran else 1.0, circuit.by_device("V")
        largest = max((e.waveform.peak(0.0, stop) for e in own if e.waveform is not None), default=0.0)

    def found() -> Any:
        with paced(f"looking for {'the largest amplitudes' if capability else 'folds'}") as update:
            if largest is not None:
                return study.capability(circuit, largest, carrier=tone, progress=update)
            return study.fold_limits(circuit, points=points, span=span, progress=update)

    key = "capability" if capability else ""
    end = key or "limits"
    _report(job, circuit, {f"_{end}.csv": "to_csv", f"_{end}.png": "plot"}, found, key)


def fit(
    job: Job,
    table: Annotated[Path, Argument(metavar="DATA.csv", help="Conditions and a measured mean, with units.")],
    free: Annotated[str, "Parameters to fit: Xgap.d,Xgap.r.", "PATH,..."],
    groups: Annotated[str | None, "Free parameters of each group: finger:Xgap.d.", "COLUMN:PATH,..."] = None,
    average: Annotated[str, "periodic (periodic state) or run (over the deck's run)."] = "periodic",
    skin: Annotated[str, "own, or follow: a SKIN's f is the source's frequency."] = "own",
    profile: Annotated[bool, "Profile likelihood of every parameter."] = False,
) -> None:
    """Fit parameters of DECK to measured means or a signal over time: values with intervals, CSV and picture.

    Example:
      fingerspice fit circuits/measured.csv circuits/fingerpad.cir --free Xgap.d,Xgap.r --skin follow
    """
    grouped = None
    if groups is not None:
        column, _, paths = (part.strip() for part in groups.partition(":"))
        allowed = "a column of the data and paths, such as finger:Xgap.d,Xgap.r"
        require(bool(column and paths), "--groups", repr(groups), allowed)
        grouped = {column: _split(paths)}
    circuit = job.read()
    options: dict[str, Any] = {"groups": grouped, "average": average, "skin": skin, "charge_law": job.charge_law}
    files = {"_fit.csv": "to_csv", "_fit.png": "plot"}
    _report(job, circuit, files, lambda: fs.fit(circuit, table, _split(free), **options, profiles=profile))


def fit_contact(
    job: Job,
    tables: Annotated[list[Path], Argument(metavar="DATA.csv ...", help="Areas and friction forces, with units.")],
    free: Annotated[str | None, "alpha,m_exp,beta,n_exp,mu,c2; those that the data tell.", "NAME,..."] = None,
    finger: Annotated[str | None, "Which of several GAPs.", "GAP"] = None,
    profile: Annotated[bool, "Profile likelihood of every parameter."] = False,
) -> None:
    """Fit the contact of DECK's finger to measured ridge areas and friction forces: values with intervals.

    Example:
      fingerspice fit-contact circuits/contact.csv circuits/indentation.csv circuits/fingerpad.cir
    """
    circuit = job.read()
    names = None if free is None else _split(free)
    files = {"_contact.csv": "to_csv", "_contact.png": "plot"}
    _report(job, circuit, files, lambda: fs.fit_contact(circuit, tables, names, finger=finger, profiles=profile))


def _split(text: str) -> list[str]:
    return [part.strip() for part in text.split(",")]


def sweep(
    job: Job,
    file: Annotated[Path, Argument(metavar="SWEEP.toml", help="Deck, parameters and outputs.")],
    store: Annotated[
        Path | None, "Write piece by piece to a Zarr store, which a second call goes on with.", "OUT.zarr"
    ] = None,
    workers: Annotated[int | None, "With --store: in N processes.", "N"] = None,
    scheduler: Annotated[str | None, "With --store: by the workers of a Dask scheduler.", "ADDRESS"] = None,
    shard: Annotated[str | None, "With --store: the I-th of M parts, from 1/M to M/M.", "I/M"] = None,
) -> None:
    """Run a grid or a random population of parameters: table, NetCDF, picture, and what the variance comes from.

    Example:
      fingerspice sweep circuits/population.toml
    """
    from fingerspice.plots.picture import plot_sweep
    from fingerspice.studies import sweep as populations

    asked, job.deck = _read(file)
    job.name = job.name or file.stem
    circuit = job.read()
    parameters = {path: _parameter(path, one) for path, one in asked["parameters"].items()}
    options = {key: asked[key] for key in ("n", "seed", *_OPTIONS) if key in asked}
    if store is None:
        for option, given in (("workers", workers), ("scheduler", scheduler), ("shard", shard)):
            require(given is None, f"--{option}", "given without --store", "--store OUT.zarr, too")
        job.check_files(circuit, ".nc", ".png")
    else:
        refuse(asked.get("indices"), f"{file}: indices = true and --store are both given; allowed: one of them")
        if (part := re.fullmatch("([0-9]+)/([0-9]+)", "1/1" if shard is None else shard)) is None:
            raise InputError(f"--shard is {shard!r}; allowed: two whole numbers such as 1/8")
        part_of = int(part[1]), int(part[2])
        options |= {"store": store, "workers": workers, "scheduler": scheduler, "shard": part_of}
    found = populations.sweep(circuit, parameters, **options)
    answer, about = job.answer, found.attrs
    answer.update(scenes=int(found.status.size), sets=about.get("sets", []), n=about.get("n"), seed=about.get("seed"))
    if store is not None:
        answer["files"].append(str(store))
        answer.update(store={key: about[key] for key in ("chunks", "chunks_found", "chunks_missing", "seconds")})
        few = not about["chunks_missing"] and found.status.size <= populations.MOST_SCENES
        said = [_told(answer, found)] if few else []
        said.append(f"{about['chunks']:,} pieces ({about['chunks_found']:,} were there already) in {store}")
        if about["chunks_missing"]:
            said.append(f"{about['chunks_missing']:,} pieces of other parts are missing")
        job.give(lambda: "\n".join([*said, *about["failures"][:_MOST_TOLD]]))
        return
    output = str(next(iter(found.data_vars)))
    indices = populations.sobol(circuit, parameters, **options) if asked.get("indices") else None
    said = [_told(answer, found)]
    if indices is not None:
        shares = populations.ranking(indices, output)
        answer.update(shares=shares)
        said.append(_shared(shares, output))
    whole = found if indices is None else found.merge(indices, compat="override", combine_attrs="drop_conflicts")
    known = {key: value for key, value in whole.attrs.items() if value is not None and value != []}
    whole.attrs = {**known, "deck": circuit.text, **job.about}
    makes: Makes = {
        ".nc": lambda file: write_aside(file, lambda aside: whole.to_netcdf(aside, engine="h5netcdf")),
        ".png": partial(plot_sweep, found, output, indices),
    }
    job.give(lambda: "\n\n".join(said), makes)


def _told(answer: dict[str, Any], found: Any) -> str:
    """Fill the answer with the percentiles of a whole sweep, which this text has."""
    from fingerspice.studies.sweep import summary

    rows = summary(found)
    answer.update(figures=rows, failed=int((found.status >= 2).sum()))
    keys = {"5 %": "p5", "median": "median", "95 %": "p95", "mean": "mean"}
    cells = [(f"{row['output']}", f"{row['unit']}", *(f"{row[key]:.4g}" for key in keys.values())) for row in rows]
    return Table(("output", "unit", *keys), cells, left=2).text()


def _read(file: Path) -> tuple[dict[str, Any], Path]:
    """The file's keys, checked, and the deck."""
    try:
        size = file.stat().st_size
        refuse(size > _LARGEST, f"{file} has {size:,} bytes; allowed: at most {_LARGEST:,}")
        asked = tomllib.loads(file.read_text(encoding="utf-8"))
    except (OSError, UnicodeError, ValueError) as error:
        raise InputError(f"{file} cannot be read as TOML: {error}") from None
    for key in asked:
        refuse(key not in _KEYS, f"{file}: unknown key {key!r}; allowed: {', '.join(_KEYS)}")
    for key, kind in (("deck", str), ("parameters", dict)):
        what = "the deck's file name" if key == "deck" else "a table such as [parameters] with Xgap.d = {...}"
        require(isinstance(asked.get(key), kind) and asked[key] != kind(), f"{file}: {key}", repr(asked.get(key)), what)
    folder = file.resolve().parent
    deck = (folder / asked["deck"]).resolve()
    inside = deck.is_relative_to(folder)
    require(inside, f"{file}: deck", repr(asked["deck"]), "a file in the same folder or below it")
    return asked, deck


def _parameter(path: str, one: Any) -> Any:
    """Numbers or a distribution from ``{kind = [numbers]}``; names of sets as they are."""
    import numpy as np
    from scipy import stats

    from fingerspice.sets import KINDS

    if path in KINDS:
        # The sweep looks the sets up, and says what is allowed.
        return one
    if isinstance(one, int | float) and not isinstance(one, bool):
        return float(one)
    allowed = "a number, or one of " + ", ".join(f"{{{kind} = {what}}}" for kind, what in _KINDS.items())
    known = isinstance(one, Mapping) and len(one) == 1 and next(iter(one)) in _KINDS
    require(known, path, repr(one), allowed)
    kind, numbers = next(iter(one.items()))
    allowed = _KINDS[kind]
    given = isinstance(numbers, list) and all(isinstance(x, int | float) for x in numbers)
    match kind, list(map(float, numbers)) if given else []:
        case "values", [_, *_] as values:
            return np.array(values)
        case (("linear" | "log"), [first, last, count]):
            allowed += ", a whole count, for log above 0"
            if count.is_integer() and 1 <= count <= 100_000 and (kind == "linear" or min(first, last) > 0.0):
                return (np.linspace if kind == "linear" else np.geomspace)(first, last, int(count))
        case (("uniform" | "loguniform" | "normal" | "lognormal"), [a, b]):
            allowed += ", ascending or above 0"
            if (a < b if kind.endswith("uniform") else b > 0.0) and (a > 0.0 or not kind.startswith("log")):
                if kind.startswith("log"):
                    return stats.loguniform(a, b) if kind == "loguniform" else stats.lognorm(b, scale=a)
                return stats.uniform(a, b - a) if kind == "uniform" else stats.norm(a, b)
    raise InputError(f"{path}: {kind} is {numbers!r}; allowed: {allowed}")


def _shared(rows: list[dict[str, Any]], output: str) -> str:
    """Total indices as text: a line for each place, a column for each parameter, and what is largest where."""
    names = sorted({row["parameter"] for row in rows}, key=str.lower)
    lines, first = list[tuple[str, ...]](), dict[str, list[str]]()
    # The rows of a place stand together, the largest index first.
    for i in range(0, len(rows), len(names)):
        # A number, or the name of a set.
        values = rows[i]["place"].items()
        place = ", ".join(f"{name} = {x if isinstance(x, str) else f'{x:.4g}'}" for name, x in values)
        first.setdefault(rows[i]["parameter"], []).append(place)
        told = {row["parameter"]: "{total:.2f} ({low:.2f}-{high:.2f})".format(**row) for row in rows[i:][: len(names)]}
        lines.append((place, *(told[name] for name in names)))
    most = "; ".join(
        name + ("" if len(first) == 1 else f" ({places[0]}{f' to {places[-1]}' if len(places) > 1 else ''})")
        for name, places in first.items()
    )
    title = f"share of the variance of {output} that comes from a parameter, its interactions included (95 % interval)"
    return "\n".join([title, Table(("", *names), lines).text(), f"largest share: {most}"])
