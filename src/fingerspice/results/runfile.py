"""The NetCDF file of a run, written and read back; and Zarr stores, created whole and filled chunk by chunk.

A chunk's file is its bytes and their CRC-32C, as Zarr's codec of that name has it, so that every program that reads a
store through Zarr refuses a chunk whose bytes have changed. Which chunks are done is known to the stores themselves:
those of runs are in `cli/store.py`, and those of sweeps in `studies/sweep/chunks.py`.
"""

from __future__ import annotations

import io
import json
import math
import os
import shutil
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, is_dataclass, replace
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fingerspice.base import files
from fingerspice.base.arrays import FloatArray
from fingerspice.base.errors import FingerspiceWarning, InputError
from fingerspice.base.files import UNFINISHED, settle_on_disk, write_pieces
from fingerspice.circuit.circuit import AcSweep, Circuit, Element, SmallSignal, Tran
from fingerspice.circuit.describe import law_digest
from fingerspice.circuit.laws import ContactLaw, law_of
from fingerspice.circuit.network import checked
from fingerspice.numerics.lobatto import NODES
from fingerspice.physics.contact import Contact
from fingerspice.results.measures import Fourier, Measured
from fingerspice.results.outcome import Attempt, ErrorEstimate, Failure, Plan, State, Status
from fingerspice.results.record import StoredRecord, kept_rows, variables
from fingerspice.results.solution import Solution
from fingerspice.results.steps import Recorded, whole_steps
from fingerspice.waveforms import periodic, samples, waveform
from fingerspice.waveforms.sampling import Function, SourceTable, source_table
from fingerspice.waveforms.waveform import Fundamental, Waveform, refuse

CHECKSUM, SIGNATURE = "crc32c", "checksum"  # Name of the checksum in a store's identity; key of its attributes' own
_SIZE = 4


def zarr_library() -> Any:
    """The library that writes Zarr; an `InputError` if it is not installed."""
    try:
        import zarr
    except ImportError:
        way = "pip install 'fingerspice[stream]'"
        raise InputError(f"a store is written as Zarr, and the package zarr is not installed; allowed: {way}") from None
    return zarr


def _checksum(content: bytes) -> bytes:
    """The bytes that follow those of a chunk in its file."""
    import google_crc32c

    return int(google_crc32c.value(content)).to_bytes(_SIZE, "little")


def signature(attributes: Mapping[str, Any]) -> str:
    """Checksum of a store's attributes, without itself."""
    return _checksum(json.dumps({**attributes, SIGNATURE: ""}, sort_keys=True).encode()).hex()


def attributes_of(path: Path) -> dict[str, Any]:
    """Attributes of a store's group; an OSError, ValueError, KeyError or TypeError if there is no store."""
    return dict(json.loads((path / "zarr.json").read_text())["attributes"])


@dataclass(frozen=True)
class Array:
    """An array of a store, whose chunks are written and checked one by one."""

    path: Path
    dims: tuple[str, ...]
    shape: tuple[int, ...]
    chunk: tuple[int, ...]
    attributes: Mapping[str, Any]
    kind: str = "<f8"
    fill: float = math.nan  # The value where nothing has been written

    def file(self, place: tuple[int, ...]) -> Path:
        """File of the chunk with this number along each dimension."""
        return Path(self.path, "c", *map(str, place))

    def fault(self, place: tuple[int, ...]) -> str | None:
        """What is wrong with a chunk; None if it is as it was written."""
        return _fault(self.file(place), math.prod(self.chunk) * np.dtype(self.kind).itemsize)

    def put(self, place: tuple[int, ...], values: NDArray[Any]) -> None:
        """Write a chunk, which may be smaller at the array's edge, durably but for its name, which a crash may lose."""
        whole = np.full(self.chunk, self.fill, self.kind)
        whole[tuple(map(slice, values.shape))] = values
        content = whole.tobytes()
        temporary = self.path / f"{UNFINISHED}{os.urandom(6).hex()}"
        temporary.write_bytes(content + _checksum(content))
        settle_on_disk(temporary)
        file = self.file(place)
        file.parent.mkdir(parents=True, exist_ok=True)
        try:
            temporary.replace(file)
        except FileNotFoundError:
            # Another process has written the same chunk, and the whole store is done and tidied up.
            if not file.exists():
                raise


def create(
    path: Path, attributes: dict[str, Any], arrays: Mapping[str, Array], known: Mapping[str, NDArray[Any]],
    hold: Callable[[Path], None] = lambda _: None,  # Is given the store before it has its name
) -> bool:  # fmt: skip
    """Create a store without values but those `known`, one chunk each; False if another process was faster."""
    zarr = zarr_library()
    path.parent.mkdir(parents=True, exist_ok=True)
    aside = path.with_name(f"{UNFINISHED}{os.urandom(6).hex()}")
    try:
        group = zarr.create_group(aside, zarr_format=3, attributes=attributes)
        for name, one in arrays.items():
            group.create_array(
                name, shape=one.shape, chunks=one.chunk, dtype=one.kind, compressors=[zarr.codecs.Crc32cCodec()],
                fill_value=one.fill, dimension_names=one.dims, attributes=one.attributes,
            )  # fmt: skip
        for name, values in known.items():
            replace(arrays[name], path=aside / name).put((0,) * values.ndim, values)
        hold(aside)
        try:
            aside.rename(path)
        except OSError:
            if path.is_dir():
                return False
            raise
        settle_on_disk(path.parent)
        return True
    finally:
        shutil.rmtree(aside, ignore_errors=True)


def tidy(path: Path) -> None:
    """Remove the unfinished files of processes that were killed."""
    for file in (*path.glob(f"{UNFINISHED}*"), *path.glob(f"*/{UNFINISHED}*")):
        file.unlink(missing_ok=True)


def check_store(path: Path) -> dict[str, int]:
    """Number of chunks of each array of a store, all as they were written; else an error names the first fault."""
    try:
        head = attributes_of(path)
        about = {file.parent.name: json.loads(file.read_text()) for file in sorted(path.glob("*/zarr.json"))}
        codecs = [one["name"] for array in about.values() for one in array["codecs"]]
        sizes = {
            name: np.dtype(array["data_type"]).itemsize * math.prod(array["chunk_grid"]["configuration"]["chunk_shape"])
            for name, array in about.items()
        }
    except (OSError, ValueError, KeyError, TypeError):
        raise InputError(f"{path} is no whole store; allowed: one that --stream or --store wrote") from None
    told = "has no checksums, as an earlier version wrote it: a changed byte would not be seen"
    refuse(codecs.count(CHECKSUM) < len(about), f"{path} {told}; allowed: a store written anew")
    found = {name: [file for file in (path / name / "c").rglob("*") if file.is_file()] for name in about}
    bad = [f"{path / 'zarr.json'} has changed"] if head.get(SIGNATURE, "") not in ("", signature(head)) else []
    for name, chunks in found.items():
        bad += [f"{file} {what}" for file in sorted(chunks) if (what := _fault(file, sizes[name])) is not None]
    # A run names how many chunks are done; of a sweep those are done that have a status.
    done = head.get("chunks_done", len(found.get("status", ())))
    dims = about["status"]["dimension_names"] if "status" in about else []
    for name, array in about.items():
        own = array["dimension_names"]
        least = done if own[: len(dims)] == dims and name not in dims else int(name in own)
        bad += [f"{path / name} has {len(found[name])} of {least} chunks"] if len(found[name]) < least else []
    if bad:
        more = f" (and {len(bad) - 1} more)" if len(bad) > 1 else ""
        ways = "a run with --overwrite, or a sweep's command, which runs its chunk again"
        raise InputError(f"{path} is damaged: {bad[0]}{more}; allowed: {ways}")
    return {name: len(files) for name, files in found.items()}


def _fault(file: Path, size: int) -> str | None:
    """What is wrong with the file of a chunk of so many bytes; None if it is as it was written."""
    try:
        content = file.read_bytes() if file.stat().st_size == size + _SIZE else b""
    except OSError:
        content = b""
    if not content:
        return "is missing or cut short"
    return None if content[size:] == _checksum(content[:size]) else "has changed since it was written"


GROUP, FORMAT = "fingerspice", 1  # The NetCDF group with what `load` needs besides the variables; its format
_ALLOWED = "allowed: a NetCDF file that to_netcdf or the command wrote"
MOST_NUMBERS = 8_000_000  # Largest number of a circuit's samples, points and coefficients that a file keeps (64 MB)
_WAVEFORMS = {
    kind.__name__: kind
    for kind in (
        waveform.DC, waveform.Sine, waveform.Chirp, waveform.Exp, periodic.PWL, periodic.Pulse, periodic.Square,
        periodic.Triangle, periodic.Sawtooth, waveform.Sum, waveform.Product, waveform.AM, periodic.Burst,
        periodic.Repeat, samples.Samples,
    )
}  # fmt: skip
_OF_CONTACT = ("d", "eps_r", "f_n", "mu", "p_sat")  # What the signals of a run need of a contact
# Attributes of circuits and elements that a file does not hold here.
_LEFT_OUT = ("where", "text", "path", "measures", "fourier", "saved", "steps", "dc")


def _failure(plain: dict[str, Any]) -> Failure:
    own = {**plain, "status": Status[plain["status"]], "tried": tuple(Attempt(**a) for a in plain["tried"])}
    return Failure(**{key: x for key, x in own.items() if key != "step"})


def _state(plain: dict[str, Any]) -> State:
    y, before, sign = (np.array(plain.get(k, d), float) for k, d in (("y", []), ("s_before", []), ("sign", [0.0])))
    return State(float(plain["t"]), y, before, sign, str(plain["charge_law"]))


#: Attributes of a solution that its file holds as plain data, how each is made plain, and how it is made again.
_PLAIN: dict[str, tuple[Callable[[Any], Any], Callable[[Any], Any]]] = {
    "nfev": (int, int), "error": (vars, lambda plain: ErrorEstimate(**plain)), "rtol": (float, float),
    # Without the wall time, so that the same run gives the same file.
    "stats": (lambda x: {k: v for k, v in x.items() if isinstance(v, (int, float, str)) and k != "wall_s"}, dict),
    "charge_law": (str, str), "area_mode": (str, str), "method": (str, str),
    "plan": (Plan.to_dict, lambda x: Plan(**{**x, "reasons": tuple(x["reasons"]), "rates": tuple(x["rates"])})),
    "status": (lambda status: status.name, lambda name: Status[name]),
    "failure": (lambda failure: failure and failure.to_dict(), lambda plain: plain and _failure(plain)),
    "fundamental": (lambda x: x and vars(x), lambda plain: plain and Fundamental(**plain)),
    "period": (lambda x: x, lambda x: x), "fold_margin_min": (float, float),
    "warnings": (list, lambda plain: tuple(map(str, plain))), "first": (float, float), "t_stop": (float, float),
    "state": (lambda x: {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in vars(x).items()}, _state),
}  # fmt: skip


def write_netcdf(solution: Solution, path: Path, jumps: str) -> Path:
    """Write the variables as a NetCDF file, with a group of further data that `load` needs."""
    import h5netcdf
    import h5py

    keep = kept_rows(solution, jumps)

    def write(target: Path) -> None:
        # HDF5 would end the process on a full disk, so let it write into memory.
        content = io.BytesIO()
        with h5netcdf.File(content, "w") as file:
            data, coords = variables(solution, keep)
            for name, (_, values, _) in coords.items():
                file.dimensions[name] = values.size
            for name, (dimensions, values, attributes) in {**coords, **data}.items():
                kind = h5py.string_dtype() if values.dtype == object else values.dtype
                file.create_variable(name, dimensions, dtype=kind, data=values).attrs.update(attributes)
            file.attrs.update(solution.provenance())
            group = file.create_group(GROUP)
            circuit, arrays = stored_circuit(solution.circuit, solution.t_stop, solution.rtol)
            between = solution._between()
            run = {"format": FORMAT, **{name: plain(getattr(solution, name)) for name, (plain, _) in _PLAIN.items()}}
            run |= {
                "sources": list(solution.sources), "signals": list(solution.signals),
                "contacts": [[name, _of_contact(contact)] for name, contact in solution.record.fingers],
                "laws": [law_digest(e) for e in solution.circuit.elements],
                "overrides": dict(solution.circuit.overrides), "summary": solution.summary(), "circuit": circuit,
                "arrays": len(arrays), "between": between and between[0],
                "measured": {name: list(one) for name, one in solution.measured.items()},
                "fourier": {k: x if isinstance(x, str) else x.plain() for k, x in solution.fourier.items()},
            }  # fmt: skip
            group.attrs["run"] = json.dumps(run, default=float)
            tables = {f"circuit{k}": array for k, array in enumerate(arrays)}
            if between is not None:
                tables["between"] = between[1]
            if not keep.all():
                # Only `load` uses the left-hand rows of jumps; they form one table, because each variable takes time.
                rows = [np.flatnonzero(~keep), *(x[~keep] for x, _, _ in solution.signals.values())]
                tables["before"] = np.column_stack(rows)
            for name, table in tables.items():
                axes = tuple(f"{name}_{axis}" for axis in range(table.ndim))
                dimensions = ("jump", "signal") if name == "before" else axes
                group.dimensions.update(zip(dimensions, table.shape, strict=True))
                group.create_variable(name, dimensions, dtype=float, data=table)
        write_pieces(target, content.getbuffer())

    return files.write_aside(path, write)


def _of_contact(contact: Contact) -> dict[str, float]:
    return {name: getattr(contact, name) for name in _OF_CONTACT}


def load(path: str | Path) -> Solution:
    """Read a run back from a file of `Solution.to_netcdf` or of ``fingerspice run``.

    Signals with both rows of each jump, figures, error, status and warnings are those of the run, and so are the lines
    of its spectra. The circuit is made again from the elements in the file, with the samples of recordings, and with a
    function as the Chebyshev series by which the run represented it. Where these are more than 8 million numbers, it
    has no elements, and a warning is issued. No run can start from a loaded one.

    Parameters
    ----------
    path : str or Path

    Raises
    ------
    InputError
        For a missing file, or one that this package did not write.
    """
    import h5netcdf

    path = Path(path)
    refuse(not path.is_file(), f"{path} is not a file; {_ALLOWED}")
    try:
        with h5netcdf.File(path, "r") as file:
            refuse(GROUP not in file.groups, f"{path} is no run of fingerspice; {_ALLOWED}")
            return _solution(file)
    except InputError:
        raise
    except (OSError, KeyError, ValueError, TypeError, AttributeError, IndexError, RecursionError) as error:
        raise InputError(f"{path} cannot be read as a run ({type(error).__name__}: {error}); {_ALLOWED}") from None


def _solution(file: Any) -> Solution:
    group = file.groups[GROUP]
    run = json.loads(_text(group.attrs["run"]))
    if run["format"] != FORMAT:
        raise InputError(f"the file has format {run['format']!r}; allowed: {FORMAT}, so another version wrote it")
    signals = [str(name) for name in run["signals"]]
    # A table of all signals in their order, with the left-hand rows of jumps put back in their places.
    keys = ["time", *dict.fromkeys(name.partition(":")[0] for name in signals)]
    table = np.column_stack([np.asarray(file.variables[key][...], float) for key in keys])
    if "before" in group.variables:
        before = np.asarray(group.variables["before"][...], float)
        # np.insert takes places in the array without the inserted rows.
        places = before[:, 0].astype(int) - np.arange(len(before))
        before[:, 0] = table[places, 0]
        table = np.insert(table, places, before, axis=0)
    t = table[:, 0].copy()
    if np.any(np.diff(t) < 0.0):
        raise ValueError("its times do not ascend")
    fingers = tuple((str(name), Contact(**values)) for name, values in run["contacts"])
    sources = tuple(map(str, run["sources"]))
    continuous = None
    if "between" in group.variables:
        # The last period, of which each panel is a step.
        period = np.asarray(group.variables["between"][...], float)
        begin, end = period[::NODES, 0], period[NODES - 1 :: NODES, 0]
        values = period[:, 1:].reshape(begin.size, NODES, -1).transpose(0, 2, 1)
        make = partial(StoredRecord, tuple(map(str, run["between"])), sources, fingers)
        continuous = Recorded(whole_steps(begin, end), values, float(run["t_stop"]) - float(run["period"]), make)
    found = Solution(
        t=t, record=StoredRecord(signals, sources, fingers, t, None, table[:, 1:]), circuit=_circuit(file, run),
        continuous=continuous, stored=dict(run["summary"]),
        **{name: make(run[name]) for name, (_, make) in _PLAIN.items()},
    )  # fmt: skip
    vars(found)["measured"] = {name: Measured(*one) for name, one in run.get("measured", {}).items()}
    harmonics = run.get("fourier", {}).items()
    vars(found)["fourier"] = {name: one if isinstance(one, str) else Fourier.made(one) for name, one in harmonics}
    return found


def _text(value: Any) -> str:
    return value.decode() if isinstance(value, bytes) else str(value)


def _circuit(file: Any, run: dict[str, Any]) -> Circuit:
    kept = run.get("circuit", "an earlier version wrote it")
    group = file.groups[GROUP]
    try:
        if isinstance(kept, str):
            raise ValueError(kept)
        arrays = [np.asarray(group.variables[f"circuit{k}"][...], float) for k in range(int(run["arrays"]))]
        again = made_again(kept, arrays)
        if (laws := [law_digest(e) for e in again.elements]) != run.get("laws", [""] * len(laws)):
            raise ValueError("its contact law is another one now")
        return again._with(text=_text(file.attrs["deck"]))
    except (InputError, ValueError, TypeError, KeyError, IndexError, AttributeError, ArithmeticError) as error:
        told = f"the circuit of this run cannot be made again from its file ({error}); its elements are left out"
        warnings.warn(told, FingerspiceWarning, stacklevel=4)
        title, deck, sets = map(_text, (file.attrs["title"], file.attrs["deck"], file.attrs.get("sets", "{}")))
        return Circuit(title, (), text=deck, overrides=dict(run["overrides"]), sets=json.loads(sets))


def stored_circuit(circuit: Circuit, stop: float, rtol: float) -> tuple[dict[str, Any] | str, list[FloatArray]]:
    """A circuit as plain data and arrays, or the reason why it is not kept.

    A function is kept as Chebyshev series up to the end of the run, `stop` (s), as exact as its tolerance asks.
    """
    arrays: list[FloatArray] = []

    def plain(value: Any) -> Any:
        if isinstance(value, Waveform):
            kind: Any = samples.Samples if isinstance(value, samples.Samples) else type(value)
            if kind in _WAVEFORMS.values():
                return plain({"kind": kind.__name__} | {f.name: getattr(value, f.name) for f in fields(kind)})
            end = stop if value.period is None else value.settled + value.period
            step = circuit.tran.step if circuit.tran else 1e-3 * stop
            # The run has warned of edges.
            with warnings.catch_warnings(action="ignore"):
                table = source_table(value, 0.0, end, min(1e-3, max(0.05 * rtol, 1e-14)), step)
            breaks = value.breakpoints(0.0, end)
            name = getattr(getattr(value, "function", None), "__name__", "")
            own = {"kind": "Function", "name": name, "repeat": value.period, "breaks": breaks[breaks < end].tolist()}
            return plain(own | {"edges": table.edges, "series": table.series})
        if isinstance(value, ContactLaw):
            return value.name
        if is_dataclass(value):
            names = [f.name for f in fields(value) if f.init and f.name not in _LEFT_OUT]
            return {name: plain(getattr(value, name)) for name in names}
        if isinstance(value, Mapping):
            return {name: plain(x) for name, x in value.items()}
        if isinstance(value, np.ndarray) or (isinstance(value, tuple) and value and isinstance(value[0], float)):
            arrays.append(np.asarray(value, float))
            return {"array": len(arrays) - 1}
        return [*map(plain, value)] if isinstance(value, (tuple, list)) else value

    kept = plain(circuit)
    count = sum(array.size for array in arrays)
    if count > MOST_NUMBERS:
        return f"its sources have {count:,} numbers, and a file keeps at most {MOST_NUMBERS:,}", []
    return kept, arrays


def made_again(kept: Any, arrays: list[FloatArray]) -> Circuit:
    """The circuit of `stored_circuit`; data that are not of a circuit raise an error of any of Python's kinds."""

    def made(plain: Any) -> Any:
        if isinstance(plain, list):
            return tuple(map(made, plain))
        if not isinstance(plain, dict):
            return plain
        if isinstance(plain.get("array"), int):
            return arrays[plain["array"]]
        given = {name: made(x) for name, x in plain.items()}
        # What a node of that name begins with is a number.
        if not isinstance(given.get("kind"), str):
            return given
        if (kind := given.pop("kind")) != "Function":
            waveform: Any = _WAVEFORMS[kind]
            return waveform(**given)
        series, name = given["series"], given["name"]
        table = SourceTable(given["edges"], np.zeros((len(series), 1, 6)), series)
        along = partial(_along, table, given["repeat"])
        # By its name the run's summary shows a function.
        vars(along).update({"__name__": str(name)} if name else {})
        return Function(along, given["breaks"], given["repeat"])

    own = made(kept)
    for one in own["elements"]:
        one["values"] = MappingProxyType({name: float(x) for name, x in one["values"].items()})
        one["ac"] = one["ac"] and SmallSignal(**one["ac"])
        one["law"] = one.get("law") and law_of(one["law"])
        if not isinstance(one["waveform"], (Waveform, type(None))):
            raise ValueError(f"{one['waveform']!r} is no waveform")
    own["elements"] = tuple(Element(**one) for one in own["elements"])
    tran, ac = own["tran"] and Tran(**own["tran"]), own["ac"] and AcSweep(**own["ac"])
    return checked(Circuit(**{**own, "tran": tran, "ac": ac}))


def _along(table: SourceTable, repeat: float | None, t: FloatArray) -> FloatArray:
    """Values (V) of a function's table at times (s), repeated with a period (s), or held beyond its ends."""
    t = np.asarray(t, float)
    low, high = float(table.edges[0]), float(table.edges[-1])
    if repeat is not None:
        t = np.where(t > high, high - repeat + np.remainder(t - high, repeat), t)
    return table.values(np.clip(t, low, high).ravel()).reshape(t.shape)
