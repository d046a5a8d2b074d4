"""A sweep on the disk: a Zarr store whose chunks any number of processes write, in any order.

A chunk is a block of scenes, one file of every array. The file of ``status`` is written last, when the others have
reached the disk, and so marks the chunk as done.
"""

from __future__ import annotations

import json
import math
import os
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fingerspice.base.arrays import FloatArray
from fingerspice.base.errors import InputError
from fingerspice.base.files import UNFINISHED, settle_on_disk
from fingerspice.results.stores import CHECKSUM, checksum, fault, zarr_library
from fingerspice.studies.batchtask import STATUS_NAMES

if TYPE_CHECKING:
    from xarray import Dataset

#: The array that marks chunks as done, and its value where a scene has not been run.
STATUS, MISSING = "status", len(STATUS_NAMES)
#: Attribute of a coordinate that counts named sets of parameters: their names.
NAMES = "names"
#: Attribute of the group with the identity of the sweep, as JSON.
RUN = "sweep"


def identity(path: Path) -> dict[str, Any]:
    """What the store that is at a path holds about its sweep; refuses what is no store of a sweep."""
    try:
        return dict(json.loads(json.loads((path / "zarr.json").read_text())["attributes"][RUN]))
    except (OSError, ValueError, KeyError, TypeError):
        raise InputError(f"{path} is there already and is no store of a sweep; allowed: another path") from None


@dataclass(frozen=True)
class Variable:
    """An array of the store: its dimensions beyond those of the sweep, their sizes, its type and its attributes."""

    further: dict[str, int]
    kind: str
    attributes: dict[str, Any]


@dataclass(frozen=True)
class SweepStore:
    """Where the chunks of a sweep are."""

    path: Path
    # dims, sizes: Dimensions of the sweep, and how many scenes each has
    dims: tuple[str, ...]
    sizes: tuple[int, ...]
    block: tuple[int, ...]  # Scenes of a chunk along each dimension
    arrays: dict[str, Variable]  # Outputs, ``error`` and ``status``
    drawn: dict[str, str]  # Parameters along ``scene``, with their units

    @property
    def chunks(self) -> int:
        """Number of chunks."""
        return math.prod(self._grid)

    @property
    def _grid(self) -> tuple[int, ...]:
        return tuple(-(-size // own) for size, own in zip(self.sizes, self.block, strict=True))

    def place(self, index: int) -> tuple[int, ...]:
        """Number of a chunk along each dimension: chunks one after another have the same draws at other places."""
        return tuple(int(i) for i in np.unravel_index(index, self._grid, "F" if self.drawn else "C"))

    def part(self, index: int) -> tuple[slice, ...]:
        """Scenes of a chunk along each dimension."""
        ranges = zip(self.place(index), self.block, self.sizes, strict=True)
        return tuple(slice(i * own, min((i + 1) * own, size)) for i, own, size in ranges)

    def is_done(self, index: int) -> bool:
        """Whether a chunk has been written as a whole, and has not changed since."""
        return all(fault(file, size) is None for file, size in self._files(index).values())

    def write(self, index: int, values: Mapping[str, NDArray[Any]]) -> None:
        """Write a chunk, and mark it as done; `values` has every array in the shape of the chunk's part.

        Raises
        ------
        InputError
            If it cannot be written; the chunks before it stay.
        """
        files = self._files(index)
        try:
            for name in sorted(files, key=STATUS.__eq__):
                self._put(files[name][0], self._padded(name, np.asarray(values[name])))
        except OSError as error:
            raise InputError(
                f"cannot write {self.path}: {error.strerror or error}; what is written stays, and the same command "
                "goes on from there"
            ) from None

    def _put(self, file: Path, content: bytes) -> None:
        """Write a file under a temporary name, and rename it once it is on the disk.

        The name may be lost in a crash of the machine: the chunk is not done then, whatever else of it is there.
        """
        temporary = self.path / STATUS / f"{UNFINISHED}{os.urandom(6).hex()}"
        with temporary.open("wb") as stream:
            stream.write(content + checksum(content))
            stream.flush()
            os.fsync(stream.fileno())
        file.parent.mkdir(parents=True, exist_ok=True)
        try:
            temporary.replace(file)
        except FileNotFoundError:
            # Another process has written the same chunk, and the whole sweep is done and tidied up.
            if not file.exists():
                raise

    def _files(self, index: int) -> dict[str, tuple[Path, int]]:
        """File and size (without checksum) of each array's part in a chunk; the first place of a grid has the draws."""
        place = self.place(index)
        found = {}
        for name, one in self.arrays.items():
            file = Path(self.path, name, "c", *map(str, place), *("0" for _ in one.further))
            size = math.prod((*self.block, *one.further.values())) * np.dtype(one.kind).itemsize
            found[name] = file, size
        if not any(place[:-1]):
            found |= {name: (Path(self.path, name, "c", str(place[-1])), 8 * self.block[-1]) for name in self.drawn}
        return found

    def _padded(self, name: str, values: NDArray[Any]) -> bytes:
        """The bytes of a chunk, which is full at the edge of an array, too."""
        one = self.arrays.get(name)
        if one is None:
            shape, kind, empty = self.block[-1:], "<f8", math.nan
        else:
            shape, kind = (*self.block, *one.further.values()), one.kind
            empty = MISSING if name == STATUS else math.nan
        if values.shape == shape:
            return np.ascontiguousarray(values, kind).tobytes()
        whole = np.full(shape, empty, kind)
        whole[tuple(slice(size) for size in values.shape)] = values
        return whole.tobytes()

    def open(
        self, run: Mapping[str, Any], about: Mapping[str, Any], grid: Mapping[str, tuple[FloatArray, dict[str, Any]]]
    ) -> None:
        """Create the store, or make sure that the one there is of this sweep.

        Parameters
        ----------
        run : mapping
            All that determines the bytes, as plain data.
        about : mapping
            Further attributes of the store.
        grid : mapping
            Values and attributes (the unit, or `NAMES`) of each parameter of the grid.

        Raises
        ------
        InputError
            If there is something else, or a store of another sweep; nothing is changed then.
        """
        own = json.loads(json.dumps({**run, "kind of checksum": CHECKSUM}, default=float))
        if not os.path.lexists(self.path):
            try:
                self._create({**about, RUN: json.dumps(own)}, grid)
            except OSError as error:
                raise InputError(f"cannot write {self.path}: {error.strerror or error}") from None
        held = identity(self.path)
        if differ := [key for key in {**own, **held} if held.get(key) != own.get(key)]:
            key, told = differ[0], [str(one.get(differ[0])) for one in (held, own)]
            said = "" if max(map(len, told)) > 40 else f" ({told[0]}, and this one {told[1]})"
            raise InputError(
                f"{self.path} holds a sweep of another {key.replace('_', ' ')}{said}; allowed: another path, or to "
                "remove that folder"
            )

    def _create(self, attributes: dict[str, Any], grid: Mapping[str, tuple[FloatArray, dict[str, Any]]]) -> None:
        """Create the store with its arrays, still without values, under a temporary name, then rename it."""
        zarr = zarr_library()
        sums = [zarr.codecs.Crc32cCodec()]
        self.path.parent.mkdir(parents=True, exist_ok=True)
        aside = self.path.with_name(f"{UNFINISHED}{os.urandom(6).hex()}")
        try:
            group = zarr.create_group(aside, zarr_format=3, attributes=attributes)
            for name, one in self.arrays.items():
                dims, more = (*self.dims, *one.further), tuple(one.further.values())
                group.create_array(
                    name, shape=(*self.sizes, *more), chunks=(*self.block, *more), dtype=one.kind, compressors=sums,
                    fill_value=MISSING if name == STATUS else math.nan, dimension_names=dims, attributes=one.attributes,
                )  # fmt: skip
            for name, unit in self.drawn.items():
                group.create_array(
                    name, shape=self.sizes[-1:], chunks=self.block[-1:], dtype="<f8", compressors=sums,
                    fill_value=math.nan, dimension_names=("scene",), attributes={"units": unit},
                )  # fmt: skip
            for name, (values, attributes) in grid.items():
                group.create_array(
                    name, data=values, chunks=values.shape, compressors=sums, dimension_names=(name,),
                    attributes=attributes,
                )  # fmt: skip
            try:
                aside.rename(self.path)
            except OSError:
                # Another process was faster.
                if not self.path.is_dir():
                    raise
            settle_on_disk(self.path.parent)
        finally:
            shutil.rmtree(aside, ignore_errors=True)

    def marked(self) -> int:
        """Number of chunks that are marked as done."""
        return sum(len(files) for _, _, files in os.walk(self.path / STATUS / "c"))

    def tidy(self) -> None:
        """Remove the unfinished files of processes that were killed, once every chunk is done."""
        for file in (self.path / STATUS).glob(f"{UNFINISHED}*"):
            file.unlink(missing_ok=True)

    def dataset(self) -> Dataset:
        """The sweep, whose values are read when they are used."""
        import xarray

        found: Dataset = xarray.open_zarr(self.path, chunks=None, consolidated=False, zarr_format=3)
        del found.attrs[RUN]
        found = found.set_coords(list(self.drawn))
        named = {str(name): one.attrs[NAMES] for name, one in found.coords.items() if NAMES in one.attrs}
        found = found.assign_coords(named)
        return found[list(self.arrays)]
