"""Zarr stores: arrays that are created whole and filled chunk by chunk, with the checksums of their chunks.

A chunk's file is its bytes and their CRC-32C, as Zarr's codec of that name has it, so that every program that reads a
store through Zarr refuses a chunk whose bytes have changed. Which chunks are done is known to the stores themselves:
those of runs are in `cli/store.py`, and those of sweeps in `studies/sweep/chunks.py`.
"""

from __future__ import annotations

import json
import math
import os
import shutil
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fingerspice.base.errors import InputError
from fingerspice.base.files import UNFINISHED, settle_on_disk

#: Name of the checksum, in the identity of a store; key of the checksum of a store's attributes among them.
CHECKSUM, SIGNATURE = "crc32c", "checksum"
_SIZE = 4


def zarr_library() -> Any:
    """The library that writes Zarr; an `InputError` if it is not installed."""
    try:
        import zarr
    except ImportError:
        raise InputError(
            "a store is written as Zarr, and the package zarr is not installed; allowed: pip install "
            "'fingerspice[stream]'"
        ) from None
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
        if values.shape != self.chunk:
            whole = np.full(self.chunk, self.fill, self.kind)
            whole[tuple(map(slice, values.shape))] = values
            values = whole
        content = np.ascontiguousarray(values, self.kind).tobytes()
        temporary = self.path / f"{UNFINISHED}{os.urandom(6).hex()}"
        with temporary.open("wb") as stream:
            stream.write(content + _checksum(content))
            stream.flush()
            os.fsync(stream.fileno())
        file = self.file(place)
        file.parent.mkdir(parents=True, exist_ok=True)
        try:
            temporary.replace(file)
        except FileNotFoundError:
            # Another process has written the same chunk, and the whole store is done and tidied up.
            if not file.exists():
                raise


def create(
    path: Path, attributes: dict[str, Any], arrays: Mapping[str, Array], known: Mapping[str, NDArray[Any]], suffix: str
) -> None:
    """Create a store without values, but for those `known` as one chunk each, under a temporary name, and rename it."""
    zarr = zarr_library()
    path.parent.mkdir(parents=True, exist_ok=True)
    aside = path.with_name(f"{UNFINISHED}{suffix}")
    shutil.rmtree(aside, ignore_errors=True)
    try:
        group = zarr.create_group(aside, zarr_format=3, attributes=attributes)
        for name, one in arrays.items():
            group.create_array(
                name, shape=one.shape, chunks=one.chunk, dtype=one.kind, compressors=[zarr.codecs.Crc32cCodec()],
                fill_value=one.fill, dimension_names=one.dims, attributes=one.attributes,
            )  # fmt: skip
        for name, values in known.items():
            replace(arrays[name], path=aside / name).put((0,) * values.ndim, values)
        try:
            aside.rename(path)
        except OSError:
            # Another process was faster.
            if not path.is_dir():
                raise
        settle_on_disk(path.parent)
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
    if codecs.count(CHECKSUM) < len(about):
        raise InputError(f"{path} has no checksums, as an earlier version wrote it: a changed byte would not be seen; "
                         "allowed: a store written anew")  # fmt: skip
    found = {name: [file for file in (path / name / "c").rglob("*") if file.is_file()] for name in about}
    bad = [f"{path / 'zarr.json'} has changed"] if head.get(SIGNATURE, "") not in ("", signature(head)) else []
    for name, chunks in found.items():
        told = [(file, _fault(file, sizes[name])) for file in sorted(chunks)]
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


def _fault(file: Path, size: int) -> str | None:
    """What is wrong with the file of a chunk of so many bytes; None if it is as it was written."""
    try:
        content = file.read_bytes() if file.stat().st_size == size + _SIZE else b""
    except OSError:
        content = b""
    if not content:
        return "is missing or cut short"
    return None if content[size:] == _checksum(content[:size]) else "has changed since it was written"
