"""Results as tables and variables, and the checksums of Zarr stores.

A chunk's file is its bytes and their CRC-32C, as Zarr's codec of that name has it, so that every program that reads a
store through Zarr refuses a chunk whose bytes have changed.
"""

from __future__ import annotations

import json
import math
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fingerspice.base.arrays import BoolArray
from fingerspice.base.errors import InputError
from fingerspice.results.signals import SIGNALS
from fingerspice.waveforms.waveform import require

if TYPE_CHECKING:
    from fingerspice.results.solution import Solution

#: Name of the checksum, in the identity of a store; key of the checksum of a store's attributes among them.
CHECKSUM, SIGNATURE = "crc32c", "checksum"
_SIZE = 4


def zarr_library() -> Any:
    """The library that writes Zarr.

    Raises
    ------
    InputError
        If it is not installed.
    """
    try:
        import zarr
    except ImportError:
        raise InputError(
            "a store is written as Zarr, and the package zarr is not installed; allowed: pip install "
            "'fingerspice[stream]'"
        ) from None
    return zarr


def checksum(content: bytes) -> bytes:
    """The bytes that follow those of a chunk in its file."""
    import google_crc32c

    return int(google_crc32c.value(content)).to_bytes(_SIZE, "little")


def signature(attributes: Mapping[str, Any]) -> str:
    """Checksum of a store's attributes, without itself."""
    return checksum(json.dumps({**attributes, SIGNATURE: ""}, sort_keys=True).encode()).hex()


def fault(file: Path, size: int) -> str | None:
    """What is wrong with the file of a chunk of so many bytes; None if it is as it was written."""
    try:
        content = file.read_bytes() if file.stat().st_size == size + _SIZE else b""
    except OSError:
        content = b""
    if not content:
        return "is missing or cut short"
    return None if content[size:] == checksum(content[:size]) else "has changed since it was written"


def check_store(path: Path) -> dict[str, int]:
    """Number of chunks of each array of a store, all of which are as they were written.

    Raises
    ------
    InputError
        If it is no store of a run or a sweep, has no checksums, or is damaged; the message names the first file at
        fault.
    """
    try:
        head = json.loads((path / "zarr.json").read_text())["attributes"]
        about = {file.parent.name: json.loads(file.read_text()) for file in sorted(path.glob("*/zarr.json"))}
        codecs = [one["name"] for array in about.values() for one in array["codecs"]]
        grids = {name: _grid(array) for name, array in about.items()}
    except (OSError, ValueError, KeyError, TypeError, ZeroDivisionError):
        raise InputError(f"{path} is no whole store; allowed: one that --stream or --store wrote") from None
    if codecs.count(CHECKSUM) < len(about):
        raise InputError(f"{path} has no checksums, as an earlier version wrote it: a changed byte would not be seen; "
                         "allowed: a store written anew")  # fmt: skip
    found = {name: [file for file in (path / name / "c").rglob("*") if file.is_file()] for name in about}
    bad = [f"{path / 'zarr.json'} has changed"] if head.get(SIGNATURE, "") not in ("", signature(head)) else []
    for name, chunks in found.items():
        told = [(file, fault(file, grids[name][1])) for file in sorted(chunks)]
        bad += [f"{file} {what}" for file, what in told if what is not None]
    # A run names how many chunks are done; of a sweep those are done that have a status.
    done = head.get("chunks_done", len(found.get("status", ())))
    dims = about["status"]["dimension_names"] if "status" in about else []
    for name, array in about.items():
        own = array["dimension_names"]
        least = done if own[: len(dims)] == dims and name not in dims else int(name in own)
        bad += [f"{path / name} has {len(found[name])} of {least} chunks"] if len(found[name]) < least else []
    if bad:
        more = f" (and {len(bad) - 1} more)" if len(bad) > 1 else ""
        raise InputError(f"{path} is damaged: {bad[0]}{more}; allowed: the command that wrote it, which runs a sweep's "
                         "chunk again, and a run with --overwrite")  # fmt: skip
    return {name: len(files) for name, files in found.items()}


def _grid(array: Mapping[str, Any]) -> tuple[int, int]:
    """Number of chunks of an array from its description, and the bytes of one."""
    shape, chunk = array["shape"], array["chunk_grid"]["configuration"]["chunk_shape"]
    count = math.prod(-(-whole // own) for whole, own in zip(shape, chunk, strict=True))
    return count, math.prod(chunk) * np.dtype(array["data_type"]).itemsize


#: Dimensions, values and attributes of a variable, as xarray and NetCDF take them.
Variable = tuple[tuple[str, ...], NDArray[Any], dict[str, str]]


def kept_rows(solution: Solution, jumps: str) -> BoolArray:
    """Mask of the rows that are written, shape (n_t,): all rows, or all but the left-hand rows of jumps."""
    require(jumps in ("right", "both"), "jumps", repr(jumps), "'right' or 'both'")
    keep = np.ones(solution.t.size, bool)
    if jumps == "right" and solution.t.size:
        keep[:-1] = np.diff(solution.t) > 0.0
    return keep


def variables(
    solution: Solution, keep: BoolArray, wanted: Collection[str] = SIGNALS
) -> tuple[dict[str, Variable], dict[str, Variable]]:
    """Variables and coordinates of the data files, with the rows in `keep` and those signals that are wanted."""
    data: dict[str, Variable] = {}
    coords: dict[str, Variable] = {"time": (("time",), solution.t[keep], {"units": "s", "long_name": "time"})}
    for key, signal in SIGNALS.items():
        columns = [x[keep] for x in solution.by_name(key).values()] if key in wanted else []
        several = key in ("u_layer", "v")
        about = {"units": signal.unit, "long_name": signal.text}
        if len(columns) > 1 or (several and key in wanted):
            coords[signal.of] = ((signal.of,), np.array(solution.all_signals.columns(key), dtype=object), {})
            table = np.column_stack([np.zeros((int(keep.sum()), 0)), *columns])
            data[key] = (("time", signal.of), table, about)
        elif columns:
            data[key] = (("time",), columns[0], about)
    return data, coords
