"""A sweep on the disk: a Zarr store whose chunks, which the sweep alone determines, any number of processes write.

A chunk is a block of scenes, one file of every array. The file of ``status`` is written last, when the others have
reached the disk, and so marks the chunk as done.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import shutil
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from inspect import signature
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fingerspice.base.arrays import FloatArray, whole_number
from fingerspice.base.errors import FingerspiceWarning, InputError
from fingerspice.base.files import UNFINISHED, settle_on_disk
from fingerspice.circuit.circuit import Circuit
from fingerspice.circuit.describe import digests
from fingerspice.circuit.notices import scenes_warnings
from fingerspice.results.datafiles import CHECKSUM, checksum, fault, zarr_library
from fingerspice.studies.batch.batch import batch
from fingerspice.studies.batch.task import LOCKSTEP, REFUSED, STATUS_NAMES, checked_scenes
from fingerspice.studies.sweepchunks import Work, at_work, programs, run_chunks
from fingerspice.studies.sweepplan import Plan
from fingerspice.waveforms.waveform import require

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


# Scenes of a chunk, if the first scene goes in lockstep, and if it does not; largest number of chunks.
CHUNK, SLOW_CHUNK, MOST_CHUNKS = 1 << 17, 1 << 8, 1 << 20
# Quantiles by which a distribution is recognised.
_PROBES = np.linspace(0.015625, 0.984375, 63)


def stored(
    circuit: Circuit, plan: Plan, options: Mapping[str, Any], path: Path, workers: int | None, scheduler: str | None,
    shard: tuple[int, int],
) -> Dataset:  # fmt: skip
    """Run the missing chunks of a sweep, or of a shard of it, and return what the store has.

    Raises
    ------
    InputError
        If the request or a value is not allowed, the folder is there and is no store of this sweep, or the scheduler
        does not answer.
    """
    _check(workers, scheduler, shard)
    if os.path.lexists(path):
        identity(path)
    work, about = _work(circuit, plan, options, path)
    if workers is not None or scheduler is not None:
        work = Work(work.circuit, plan, work.draws, {"threads": 1, **options}, work.store, work.programs)
    grid = {
        name: (values, {NAMES: list(plan.tables[name].names)} if name in plan.tables else {"units": plan.units[name]})
        for name, values in plan.grid.items()
    }
    with at_work(None if workers is None else min(workers, work.store.chunks), scheduler) as client:
        work.store.open(_identity(work, options), about, grid)
        told = run_chunks(work, shard, client)
    found = work.store.dataset()
    found.attrs |= told
    return found


def _check(workers: int | None, scheduler: str | None, shard: tuple[int, int]) -> None:
    if workers is not None:
        whole_number("workers", workers, 1)
        if scheduler is not None:
            raise InputError("workers and scheduler are both given; allowed: one of them")
    good = len(shard) == 2 and all(isinstance(x, int) for x in shard) and 1 <= shard[0] <= shard[1]
    require(good, "shard", shard, "two whole numbers (i, m), with i from 1 to m")


def _work(circuit: Circuit, plan: Plan, options: Mapping[str, Any], path: Path) -> tuple[Work, dict[str, Any]]:
    """The sweep as chunks, and the attributes of its store; its first scene is run to see what outputs there are."""
    _check_values(circuit, plan)
    middle = plan.quantiles(np.full((1, len(plan.drawn)), 0.5))
    ends = plan.spread({name: values[[0, -1]] for name, values in plan.grid.items()}, middle)
    skin = options.get("skin", "own")
    for text in scenes_warnings(circuit, options.get("t_stop"), checked_scenes(circuit, ends), skin):
        warnings.warn(text, FingerspiceWarning, stacklevel=4)
    with warnings.catch_warnings():
        # Of one scene.
        warnings.simplefilter("ignore", FingerspiceWarning)
        first = batch(circuit, plan.spread({name: values[:1] for name, values in plan.grid.items()}, middle), **options)
    if "u_gap" in first:
        raise InputError("outputs are u_gap, and a store has figures, which are one number for each scene")
    if int(first.status[0]) >= REFUSED and len(circuit.by_device("GAP")) > 1:
        raise InputError(f"the middle of the sweep has no result ({first.attrs['failures'][0]}); allowed: one that has")
    size = CHUNK if int(first.status[0]) == LOCKSTEP else SLOW_CHUNK
    block: list[int] = []
    for length in reversed(plan.sizes):
        block.insert(0, min(length, max(1, size // math.prod(block))))
    arrays = {
        str(name): Variable(
            {str(dim): one.sizes[dim] for dim in one.dims[1:]}, "i1" if name == STATUS else "<f8", dict(one.attrs)
        )
        for name, one in first.data_vars.items()
    }
    flags = arrays[STATUS].attributes
    flags |= {"flag_values": [*flags["flag_values"], MISSING], "flag_meanings": f"{flags['flag_meanings']} missing"}
    drawn = {name: plan.units[name] for name in plan.drawn}
    store = SweepStore(path.absolute(), plan.dims, plan.sizes, tuple(block), arrays, drawn)
    require(store.chunks <= MOST_CHUNKS, "the sweep", f"{math.prod(plan.sizes):,} scenes", f"at most {MOST_CHUNKS:,} "
            f"chunks of {math.prod(block):,}")  # fmt: skip
    about = {key: value for key, value in first.attrs.items() if key not in ("n_ordinary", "ordinary", "failures")}
    about |= {"n": plan.n, "seed": plan.seed} if plan.drawn else {}
    about |= {"sets": list(circuit.sets)} if circuit.sets else {}
    draws = plan.sequence(block[-1]) if plan.drawn else None
    return Work(circuit, plan, draws, options, store, programs()), about


def _check_values(circuit: Circuit, plan: Plan) -> None:
    """Refuse what a parameter does not accept: values of the grid, and quantiles beyond which there are draws."""
    ends = plan.quantiles(np.repeat([[1.0 / plan.n], [1.0 - 1.0 / plan.n]], len(plan.drawn), axis=1))
    for name, values in (plan.grid | plan.fixed | ends).items():
        try:
            checked_scenes(circuit, plan.paths({name: values}))
        except InputError as error:
            kind = "the distribution of" if name in plan.drawn else "the values of"
            raise InputError(f"{kind} {name}: {error}") from None


def _identity(work: Work, options: Mapping[str, Any]) -> dict[str, Any]:
    """All inputs that determine the bytes of a store, by which a later call recognises its own store."""
    circuit, plan = work.circuit, work.plan
    values: dict[str, Any] = {}
    for name, one in (plan.grid | plan.fixed).items():
        values[name] = hashlib.sha256(one.tobytes()).hexdigest() if one.size > 8 else one.tolist()
        if name in plan.tables:
            sets = plan.tables[name]
            values[name] = [sets.names, {path: each.tolist() for path, each in sets.columns.items()}]
    for name, law in plan.drawn.items():
        # Nine digits are the same on every machine.
        values[name] = [f"{x:.9g}" for x in law.ppf(_PROBES)]
    return {
        "programs": work.programs, "circuit": digests(circuit), "law of the deck": circuit.charge_law,
        "times": repr(circuit.tran), "list of parameters": list(values),
        **{f"range of {name}": value for name, value in values.items()},
        **({"n": plan.n, "seed": plan.seed} if plan.drawn else {}),
        **_effective(options), "block": work.store.block,
    }  # fmt: skip


def _effective(options: Mapping[str, Any]) -> dict[str, Any]:
    """The options that determine results, given or not."""
    own = {name: one.default for name, one in signature(batch).parameters.items() if one.default is not one.empty}
    every = {**own, **options}
    del every["threads"]
    return {**every, "outputs": [every["outputs"]] if isinstance(every["outputs"], str) else list(every["outputs"])}
