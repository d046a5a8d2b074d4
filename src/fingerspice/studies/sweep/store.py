"""A sweep on the disk: a Zarr store whose chunks, which the sweep alone determines, any number of processes write.

A chunk is a block of scenes, one file of every array. The file of ``status`` is written last, when the others have
reached the disk, and so marks the chunk as done.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fingerspice.base.arrays import FloatArray
from fingerspice.base.errors import InputError
from fingerspice.results.store import CHECKSUM, Array, attributes_of, create
from fingerspice.studies.sweep.plan import NAMES

if TYPE_CHECKING:
    from xarray import Dataset

#: The array that marks chunks as done.
STATUS = "status"
#: Attribute of the group with the identity of the sweep, as JSON.
RUN = "sweep"


def identity(path: Path) -> dict[str, Any]:
    """What the store that is at a path holds about its sweep; refuses what is no store of a sweep."""
    try:
        return dict(json.loads(attributes_of(path)[RUN]))
    except (OSError, ValueError, KeyError, TypeError):
        raise InputError(f"{path} is there already and is no store of a sweep; allowed: another path") from None


@dataclass(frozen=True)
class SweepStore:
    """Where the chunks of a sweep are."""

    path: Path
    # dims, sizes: Dimensions of the sweep, and how many scenes each has
    dims: tuple[str, ...]
    sizes: tuple[int, ...]
    block: tuple[int, ...]  # Scenes of a chunk along each dimension
    outputs: dict[str, Array]  # With ``error`` and ``status``
    drawn: dict[str, Array]  # Parameters along ``scene``
    grid: dict[str, Array]  # Parameters along the other dimensions

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

    def _pieces(self, index: int) -> Iterator[tuple[str, Array, tuple[int, ...]]]:
        """Arrays of a chunk, and its place in each, ``status`` last; the first place of a grid has the draws."""
        place = self.place(index)
        if not any(place[:-1]):
            yield from ((name, one, place[-1:]) for name, one in self.drawn.items())
        for name in sorted(self.outputs, key=STATUS.__eq__):
            one = self.outputs[name]
            yield name, one, place + (0,) * (len(one.shape) - len(place))

    def is_done(self, index: int) -> bool:
        """Whether a chunk has been written as a whole, and has not changed since."""
        return all(one.fault(place) is None for _, one, place in self._pieces(index))

    def write(self, index: int, values: Mapping[str, NDArray[Any]]) -> None:
        """Write a chunk, and mark it as done; `values` has every array in the shape of the chunk's part."""
        try:
            for name, one, place in self._pieces(index):
                one.put(place, np.asarray(values[name]))
        except OSError as error:
            raise InputError(
                f"cannot write {self.path}: {error.strerror or error}; what is written stays, and the same command "
                "goes on from there"
            ) from None

    def open(self, run: Mapping[str, Any], about: Mapping[str, Any], grid: Mapping[str, FloatArray]) -> None:
        """Create the store, or make sure that the one there is of this sweep.

        `run` is all that determines the bytes, as plain data, and `about` has further attributes of the store; `grid`
        has the values of its parameters. Anything else there, or the store of another sweep, is refused and stays.
        """
        own = json.loads(json.dumps({**run, "kind of checksum": CHECKSUM}, default=float))
        if not os.path.lexists(self.path):
            arrays = self.outputs | self.drawn | self.grid
            try:
                create(self.path, {**about, RUN: json.dumps(own)}, arrays, grid, os.urandom(6).hex())
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

    def marked(self) -> int:
        """Number of chunks that are marked as done."""
        return sum(len(files) for _, _, files in os.walk(self.path / STATUS / "c"))

    def dataset(self) -> Dataset:
        """The sweep, whose values are read when they are used."""
        import xarray

        found: Dataset = xarray.open_zarr(self.path, chunks=None, consolidated=False, zarr_format=3)
        del found.attrs[RUN]
        found = found.set_coords(list(self.drawn))
        named = {str(name): one.attrs[NAMES] for name, one in found.coords.items() if NAMES in one.attrs}
        return found.assign_coords(named)[list(self.outputs)]
