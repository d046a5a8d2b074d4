"""A run on the disk (``run --stream``): a Zarr store that grows chunk by chunk, and can be continued after a crash.

Every chunk of the run is one chunk of each array. The number of finished chunks is an attribute of the store's group,
whose file is replaced atomically after the chunk's data have reached the disk.

Below it stands the command `sweep`, which runs a grid or a random population that a TOML file describes.
"""

from __future__ import annotations

import fcntl
import json
import os
import re
import shutil
import time
import tomllib
import warnings
from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer

from fingerspice import __version__
from fingerspice.base.announcing import paced
from fingerspice.base.errors import FingerspiceWarning, InputError
from fingerspice.base.files import UNFINISHED, settle_on_disk, write_aside, write_durably
from fingerspice.cli import terminal
from fingerspice.cli.options import check_output, read_circuit, time_from_text
from fingerspice.cli.result_files import Results
from fingerspice.cli.terminal import Answering
from fingerspice.results.record import variables
from fingerspice.results.runfile import CHECKSUM, SIGNATURE, Array, attributes_of, create, signature, tidy, zarr_library

if TYPE_CHECKING:
    from fingerspice.circuit.circuit import Circuit
    from fingerspice.results.solution import Solution
    from fingerspice.solve.streaming import Stream


#: Attributes of the group: identity of the run, number of finished chunks, state to continue from, results so far, and
#: the number of columns of each array, 0 for one without.
RUN, DONE, MARK, SO_FAR, COLUMNS = "run", "chunks_done", "goes_on", "so_far", "arrays"
# Number of bytes of the store that are copied at once.
_PIECE = 1 << 25


class Store:
    """A store of one run in a folder.

    `run` is its identity, all inputs that determine its results, as plain data; the run has `total` outputs, and a
    chunk `count`. Within `lock`, no other process writes the store.
    """

    def __init__(self, path: Path, run: dict[str, Any], total: int, count: int) -> None:
        self.zarr = zarr_library()
        self.run = json.loads(json.dumps({**run, "kind of checksum": CHECKSUM}))
        self.path, self.total, self.count = path, total, count
        self.chunks, self.done, self.there = -(-total // count), 0, False  # Chunks of the whole run
        self.mark: dict[str, Any] = {}
        self.so_far: dict[str, Any] = {}
        self.lock = ExitStack()

    def _hold(self, folder: Path) -> None:
        """Keep other processes from the store in a folder, also after it is renamed."""
        # Without locks, as on some file systems, nothing is refused.
        with suppress(OSError):
            number = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
            self.lock.callback(os.close, number)
            try:
                fcntl.flock(number, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise self._busy() from None

    def _busy(self) -> InputError:
        return InputError(f"another process writes {self.path}; allowed: to wait for it, --name NAME, or another --out")

    def open(self, overwrite: bool) -> None:
        """Open an existing store of the same run, to continue it; with `overwrite` remove any store.

        A folder that is no store is refused, as is a store that is damaged, of another run, or being written.
        """
        if not os.path.lexists(self.path):
            return
        self._hold(self.path)
        try:
            attributes = attributes_of(self.path)
            whole = all(isinstance(attributes[key], dict) for key in (RUN, MARK, SO_FAR, COLUMNS))
            sound = attributes.get(SIGNATURE, "") in ("", signature(attributes))
            whole = whole and sound and isinstance(attributes[DONE], int) and attributes[DONE] >= 0
        except (OSError, ValueError, KeyError, TypeError):
            whole = False
        if not whole:
            raise InputError(f"{self.path} is there already and is no whole store of a run; allowed: --name or --out")
        if overwrite:
            shutil.rmtree(self.path)
            return
        self.there = True
        for key, own in self.run.items():
            held = attributes[RUN].get(key)
            if held != own:
                said = "" if len(f"{held}{own}") > 80 else f" ({held}, and this one {own})"
                what = f"{'other' if key == 'signals' else 'another'} {key.replace('_', ' ')}{said}"
                ways = "allowed: --name NAME, another --out, or --overwrite"
                raise InputError(f"{self.path} holds a run of {what}; {ways}")
        self.done, self.mark, self.so_far = attributes[DONE], attributes[MARK], attributes[SO_FAR]
        written: set[Path] = set()
        for name, columns in attributes[COLUMNS].items():
            array = self._array(name, columns)
            for place in ((chunk, *(0,) * bool(columns)) for chunk in range(self.done)):
                if fault := array.fault(place):
                    raise InputError(f"{self.path} is damaged: {array.file(place)} {fault}; allowed: --overwrite")
                written.add(array.file(place))
        # What a call that was killed has left.
        tidy(self.path)
        for file in self.path.glob("*/c/**/*"):
            if file not in written and file.is_file():
                file.unlink()

    def _array(
        self, name: str, columns: int, dims: tuple[str, ...] = (), attributes: Mapping[str, Any] | None = None
    ) -> Array:
        more = (columns,) if columns else ()
        return Array(self.path / name, dims, (self.total, *more), (self.count, *more), attributes or {})

    def write(self, chunk: int, solution: Solution, signals: list[str], about: dict[str, Any], mark: Any) -> None:
        """Write a chunk, then record it as finished; `mark` is the state from which the run continues."""
        data, coords = variables(solution, np.ones(solution.t.size, bool), signals)
        data = {"time": coords["time"], **data}
        columns = {name: values.shape[1] if values.ndim > 1 else 0 for name, (_, values, _) in data.items()}
        names = {dim: one[1].tolist() for dim, one in coords.items() if dim != "time"}
        arrays = {
            name: self._array(name, columns[name], dims, said | {d: names[d] for d in dims[1:]})
            for name, (dims, _, said) in data.items()
        }
        self.so_far = {
            "method": solution.method, "area": solution.area_mode, "tier": solution.plan.tier,
            "t_stop": solution.t_stop, "error": vars(solution.error), "fold_margin_min": solution.fold_margin_min,
        }  # fmt: skip
        try:
            if not self.there:
                self._create({**about, RUN: self.run, DONE: 0, MARK: {}, SO_FAR: {}, COLUMNS: columns}, arrays)
            for name, one in arrays.items():
                place = (chunk, *(0,) * bool(columns[name]))
                one.put(place, data[name][1])
                settle_on_disk(one.file(place).parent)
            head = json.loads((self.path / "zarr.json").read_text())
            head["attributes"] |= {DONE: chunk + 1, MARK: mark, SO_FAR: self.so_far}
            head["attributes"][SIGNATURE] = signature(head["attributes"])
            write_durably(self.path / "zarr.json", json.dumps(head, indent=1).encode())
        except OSError as error:
            raise InputError(
                f"cannot write {self.path}: {error.strerror or error}; {self.done} of {self.chunks} pieces are "
                "written, and the same command goes on from there"
            ) from None
        self.done = chunk + 1

    def _create(self, attributes: dict[str, Any], arrays: Mapping[str, Array]) -> None:
        """Create the store, which is locked before it has its name; refused if another process was faster."""
        aside = self.path.with_name(f"{UNFINISHED}{os.urandom(6).hex()}")
        try:
            create(aside, attributes, arrays, {}, os.urandom(6).hex())
            self._hold(aside)
            if self.path.exists():
                raise self._busy()
            # It fails where another process has just done the same.
            aside.rename(self.path)
            settle_on_disk(self.path.parent)
            self.there = True
        finally:
            shutil.rmtree(aside, ignore_errors=True)

    def to_netcdf(self, path: Path) -> Path:
        """Write the whole run as NetCDF, piece by piece."""
        import h5netcdf

        group = self.zarr.open_group(self.path, mode="r")
        # In an order of their own: that of a folder differs from machine to machine.
        arrays = dict(sorted(group.arrays()))
        size = sum(array.nbytes for array in arrays.values()) + 2**20

        def write(target: Path) -> None:
            # HDF5 ends the process on a full disk: reserve the room first, so that a full disk raises an error here.
            with target.open("wb") as room:
                if hasattr(os, "posix_fallocate"):
                    os.posix_fallocate(room.fileno(), 0, size)
                elif shutil.disk_usage(target.parent).free < size:
                    raise OSError(f"it takes {size / 1e9:.3g} GB, which the disk has not")
            with h5netcdf.File(target, "w") as file:
                file.dimensions["time"] = self.total
                for name, array in arrays.items():
                    names = array.metadata.dimension_names
                    for dimension, length in zip(names[1:], array.shape[1:], strict=True):
                        if dimension not in file.dimensions:
                            file.dimensions[dimension] = length
                    variable = file.create_variable(name, names, dtype="f8")
                    for key, value in array.attrs.asdict().items():
                        variable.attrs[key] = value if isinstance(value, str) else json.dumps(value)
                    rows = max(1, _PIECE // (8 * max(1, int(np.prod(array.shape[1:])))))
                    for at in range(0, self.total, rows):
                        variable[at : at + rows] = array[at : at + rows]
                file.attrs.update({k: value for k, value in group.attrs.asdict().items() if isinstance(value, str)})

        return write_aside(path, write)


def run_streamed(
    answer: Answering, results: Results, circuit: Circuit, how: dict[str, Any], *, chunk: str | None,
    signals: str | None, netcdf: bool,
) -> None:  # fmt: skip
    """Run a circuit, write its chunks to a store, and fill the answer; what a failed run has written stays."""
    from fingerspice.solve.streaming import stream

    path = results.folder / f"{results.name}.zarr"
    # The store is a folder, so check that a file can be written next to it.
    check_output(path.with_suffix(".zarr.part"), results.deck)
    names = _names(signals, circuit)
    charge = any(name in ("q_source", "i_source") for name in names)
    run = stream(circuit, chunk=time_from_text("--chunk", chunk), charge=charge, **how)
    if netcdf:
        results.will_write(".nc", lambda file: store.to_netcdf(file))
    store = Store(path, _identity(run, circuit, how, names), run.outputs.total, run.count)
    with store.lock:
        store.open(results.overwrite)
        if store.done and store.done < store.chunks:
            run.go_to(store.mark, store.done * store.count)
        results.open()
        begun, first, total = time.perf_counter(), store.done, run.outputs.total
        answer.data["files"].append(str(path))
        if first < store.chunks:
            _fill(run, store, names, results)
        took, span = time.perf_counter() - begun, run.problem.t_stop - run.problem.t_start
        said = [f"{total:,} outputs of {span:g} s in {store.chunks:,} piece{'s' if store.chunks > 1 else ''}: {path}"]
        if first < store.chunks:
            said.append(f"{(store.chunks - first) / store.chunks * span / took:,.3g} times real time")
        error = store.so_far["error"]
        said.append(f"stated error {error['u_gap']:.2g} V of the gap voltage, {error['f_el']:.2g} N of the force")
        if first:
            said.append(f"the first {first:,} were there already")
        found = {"chunks": store.chunks, "found": first, "outputs": total, "seconds": took}
        answer.update(**store.so_far, stream=found)
        answer.give(lambda: "; ".join(said), results.ready())


def _names(signals: str | None, circuit: Circuit) -> list[str]:
    """Keys of the signals that are written, of those that the circuit has."""
    from fingerspice.results.record import SIGNALS

    has = {"gap": circuit.by_device("GAP"), "layer": [e for e in circuit.elements if e.spec.is_layer]}
    allowed = [name for name, signal in SIGNALS.items() if has.get(signal.of, True)]
    if signals is None:
        return ["u_gap", "f_el"] if has["gap"] else ["u_layer"] if has["layer"] else ["v"]
    names = [name.strip() for name in signals.split(",")]
    if unknown := [name for name in names if name not in allowed]:
        raise InputError(f"--signals names {unknown[0]!r}; allowed: {', '.join(allowed)}")
    return sorted(set(names), key=list(SIGNALS).index)


def _identity(run: Stream, circuit: Circuit, how: dict[str, Any], names: list[str]) -> dict[str, Any]:
    """All inputs that determine the bytes of a store, by which a later call recognises its own store."""
    from fingerspice.base.compiled import STAMP
    from fingerspice.circuit.describe import digests

    elements, sources = digests(circuit)
    o, scene = run.outputs, run.problem.scene
    return {
        "circuit": elements, "source": sources, "rtol": how["rtol"], "charge_law": scene.charge_law,
        "area": scene.area_mode, "method": how["method"], "start": str(how["start"]), "chunk": run.count,
        "signals": names, "end": run.problem.t_stop, "output_times": [o.start, o.over, o.low, o.total],
        "program": f"fingerspice {__version__} ({STAMP[:12]}), NumPy {np.__version__}",
    }  # fmt: skip


def _fill(run: Stream, store: Store, names: list[str], results: Results) -> None:
    """Compute and write all missing chunks; a chunk is written while the next one is computed."""
    about = {key: text for key, text in results.about.items() if key != "files"}
    known: set[str] = set()
    writing: Future[None] | None = None
    start, span = run.problem.t_start, run.problem.t_stop - run.problem.t_start
    first = float(run.outputs.times(run.done, run.done + 1)[0])
    with ThreadPoolExecutor(1) as writer, paced("simulating", (first - start) / span) as show:
        for number, solution in enumerate(run, store.done):
            for text in solution.warnings:
                if text not in known:
                    known.add(text)
                    warnings.warn(text, FingerspiceWarning, stacklevel=2)
            if writing is not None:
                writing.result()
            writing = writer.submit(store.write, number, solution, names, about, run.mark())
            reached = solution.t_stop
            show((reached - start) / span, lambda s, t=reached: f"{(t - first) / s:,.3g} times real time,")
        if writing is not None:
            writing.result()


#: Keys of the file, and the arguments of `batch` among them.
_KEYS = ("deck", "n", "seed", "indices", "outputs", "rtol", "t_stop", "periods", "periodic", "skin", "parameters")
_OPTIONS = ("outputs", "rtol", "t_stop", "periods", "periodic", "skin")
#: Kinds of a parameter, with the numbers that each takes.
_KINDS = {
    "values": "[a, b, ...]", "linear": "[first, last, count]", "log": "[first, last, count]",
    "uniform": "[low, high]", "loguniform": "[low, high]", "normal": "[mean, standard deviation]",
    "lognormal": "[median, standard deviation of the logarithm]",
}  # fmt: skip
#: Largest number of messages about scenes without a result that are printed.
_MOST_TOLD = 8
#: Largest size of the file, bytes.
_LARGEST = 1 << 20


def sweep(
    file: Annotated[Path, typer.Argument(metavar="SWEEP.toml", help="Deck, parameters and outputs.")],
    out: terminal.Out = None,
    name: terminal.Name = None,
    overwrite: terminal.Overwrite = False,
    as_json: terminal.AsJson = False,
    no_plot: terminal.NoPlot = False,
    store: Annotated[
        Path | None,
        typer.Option(
            metavar="OUT.zarr", help="Write piece by piece to a Zarr store, which a second call goes on with."
        ),
    ] = None,
    workers: Annotated[int | None, typer.Option(metavar="N", help="With --store: in N processes.")] = None,
    scheduler: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help="With --store: by the workers of a Dask scheduler.")
    ] = None,
    shard: Annotated[
        str | None, typer.Option(metavar="I/M", help="With --store: the I-th of M parts, from 1/M to M/M.")
    ] = None,
) -> None:
    """Run a grid or a random population of parameters: table, NetCDF, picture, and what the variance comes from.

    Example:

      fingerspice sweep circuits/population.toml
    """
    with Answering("sweep", as_json) as answer:
        from fingerspice.plots.populations import plot_sweep
        from fingerspice.studies.sweep import populations

        asked, deck = _read(file)
        circuit = read_circuit(deck, None, None)
        parameters = {path: _parameter(path, one) for path, one in asked["parameters"].items()}
        options = {key: asked[key] for key in ("n", "seed", *_OPTIONS) if key in asked}
        answer.update(**terminal.of_circuit(circuit, None))
        if store is not None:
            if asked.get("indices"):
                raise InputError(f"{file}: indices = true and --store are both given; allowed: one of them")
            if (part := re.fullmatch("([0-9]+)/([0-9]+)", "1/1" if shard is None else shard)) is None:
                raise InputError(f"--shard is {shard!r}; allowed: two whole numbers such as 1/8")
            part_of = int(part[1]), int(part[2])
            options |= {"store": store, "workers": workers, "scheduler": scheduler, "shard": part_of}
        else:
            for option, given in (("workers", workers), ("scheduler", scheduler), ("shard", shard)):
                if given is not None:
                    raise InputError(f"--{option} is given without --store; allowed: --store OUT.zarr, too")
            results = Results(deck, circuit, out, name or file.stem, overwrite, None)
            own = {"deck": circuit.text}
            results.will_write(".nc", lambda path: _written(found, indices, own | results.about, path))
            results.will_draw(".png", lambda: plot_sweep(found, output, indices), unless=no_plot)
        found = populations.sweep(circuit, parameters, **options)
        about = found.attrs
        known = {"sets": about.get("sets", []), "n": about.get("n"), "seed": about.get("seed")}
        answer.update(scenes=int(found.status.size), **known)
        if store is not None:
            _give_stored(answer, found, store)
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
    from fingerspice.studies.sweep import populations

    rows = populations.summary(found)
    answer.update(figures=rows, failed=int((found.status >= 2).sum()))
    head = f"{'output':<24}{'unit':<8}{'5 %':>12}{'median':>12}{'95 %':>12}{'mean':>12}"
    lines = [
        f"{row['output']:<24}{row['unit']:<8}"
        + "".join(f"{row[key]:>12.4g}" for key in ("p5", "median", "p95", "mean"))
        for row in rows
    ]
    return "\n".join([head, *lines])


def _give_stored(answer: Answering, found: Any, store: Path) -> None:
    """Fill the answer with what a call has done for a store, and percentiles of a store that is whole."""
    from fingerspice.studies.sweep.populations import MOST_SCENES

    about = found.attrs
    answer.data["files"].append(str(store))
    answer.update(store={key: about[key] for key in ("chunks", "chunks_found", "chunks_missing", "seconds")})
    said = [_told(answer, found)] if not about["chunks_missing"] and found.status.size <= MOST_SCENES else []
    said.append(f"{about['chunks']:,} pieces ({about['chunks_found']:,} were there already) in {store}")
    if about["chunks_missing"]:
        said.append(f"{about['chunks_missing']:,} pieces of other parts are missing")
    answer.give(lambda: "\n".join([*said, *about["failures"][:_MOST_TOLD]]))


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
    if not isinstance(numbers, list) or not all(isinstance(x, int | float) for x in numbers) or not numbers:
        raise InputError(f"{path}: {kind} is {numbers!r}; allowed: {_KINDS[kind]}")
    if kind == "values":
        return np.array(numbers, float)
    if len(numbers) != _KINDS[kind].count(",") + 1:
        raise InputError(f"{path}: {kind} is {numbers!r}; allowed: {_KINDS[kind]}")
    if kind in ("linear", "log"):
        first, last, count = numbers
        if not (count == int(count) and 1 <= count <= 100_000) or (kind == "log" and min(first, last) <= 0.0):
            raise InputError(f"{path}: {kind} is {numbers!r}; allowed: {_KINDS[kind]}, a whole count, for log above 0")
        return (np.linspace if kind == "linear" else np.geomspace)(first, last, int(count))
    a, b = map(float, numbers)
    in_order = a < b if kind.endswith("uniform") else b > 0.0
    if not in_order or (kind.startswith("log") and a <= 0.0):
        raise InputError(f"{path}: {kind} is {numbers!r}; allowed: {_KINDS[kind]}, ascending or above 0")
    if kind.startswith("log"):
        return stats.loguniform(a, b) if kind == "loguniform" else stats.lognorm(b, scale=a)
    return stats.uniform(a, b - a) if kind == "uniform" else stats.norm(a, b)


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
    from fingerspice.base.files import write_aside

    whole = found if indices is None else found.merge(indices, compat="override", combine_attrs="drop_conflicts")
    known = {key: value for key, value in whole.attrs.items() if value is not None and value != []}
    whole.attrs = {**known, **about}
    return write_aside(path, lambda aside: whole.to_netcdf(aside, engine="h5netcdf"))
