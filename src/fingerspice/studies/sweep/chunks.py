"""A sweep into a Zarr store, in chunks that any number of processes run, here or by the workers of a Dask scheduler.

The sweep alone divides itself into chunks. A chunk is a block of scenes, one file of every array. The file of
``status`` is written last, when the others have reached the disk, and so marks the chunk as done.
"""

from __future__ import annotations

import hashlib
import json
import logging
import math
import os
import time
import warnings
from collections import Counter, deque
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import replace
from functools import partial
from inspect import signature
from multiprocessing import parent_process
from pathlib import Path
from threading import Lock
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fingerspice import __version__
from fingerspice.base.announcing import paced
from fingerspice.base.arrays import keep_freed_memory, whole_number
from fingerspice.base.errors import FingerspiceWarning, InputError
from fingerspice.circuit.describe import digests, scenes_warnings
from fingerspice.results.runfile import CHECKSUM, Array, attributes_of, create, tidy
from fingerspice.studies.batch.batch import MESSAGES, STATUS_NAMES, batch, checked_scenes
from fingerspice.studies.batch.lockstep import LOCKSTEP
from fingerspice.studies.sweep import Plan
from fingerspice.waveforms.waveform import refuse, require

if TYPE_CHECKING:
    from xarray import Dataset

# Scenes of a chunk, if the first scene goes in lockstep, and if it does not; largest number of chunks.
CHUNK, SLOW_CHUNK, MOST_CHUNKS = 1 << 17, 1 << 8, 1 << 20
# The array that marks chunks as done, and the status of a scene that has not been run.
STATUS, MISSING = "status", len(STATUS_NAMES)
# Attribute of the group with the identity of the sweep, as JSON; of a coordinate that counts named sets, their names.
RUN, NAMES = "sweep", "names"
# Quantiles by which a distribution is recognised.
_PROBES = np.linspace(0.015625, 0.984375, 63)
# Chunks that a process has at once: it computes one while another one is waiting for the disk.
AT_ONCE = 2
_FREE, _WRITING = nullcontext(), Lock()
# How often the scheduler may give up one chunk, and chunks one after another: each time it has lost several workers.
TRIES, MOST_LOST = 2, 20
# Chunks that a scheduler is given at once, and how long it may take to answer, s.
AHEAD, PATIENCE = 4096, 5.0
_GOES_ON = "what is written stays, and the same command goes on from there"
# What is known of a chunk that has been run: the number of its scenes, and why some of them have no result.
Ran = tuple[int, list[str]]


def programs() -> str:
    """What the bytes of a result depend on beside the request."""
    import scipy

    return f"fingerspice {__version__}, NumPy {np.__version__}, SciPy {scipy.__version__}"


class Work:
    """A sweep with its store, and all that it takes to run any chunk of it."""

    def __init__(self, plan: Plan, options: Mapping[str, Any], path: Path) -> None:
        """The first scene is run to see what outputs there are; `options` are those of `batch`."""
        self.plan, self.path, self.programs, self.options = plan, path.absolute(), programs(), options
        circuit = plan.circuit
        # What a parameter does not accept: values of the grid, and quantiles beyond which there are draws.
        beyond = plan.quantiles(np.repeat([[1.0 / plan.n], [1.0 - 1.0 / plan.n]], len(plan.drawn), axis=1))
        for name, values in (plan.grid | plan.fixed | beyond).items():
            try:
                # Sets of parameters that do not differ have no paths.
                if paths := plan.paths({name: values}):
                    checked_scenes(circuit, paths)
            except InputError as error:
                kind = "the distribution of" if name in plan.drawn else "the values of"
                raise InputError(f"{kind} {name}: {error}") from None
        middle = plan.quantiles(np.full((1, len(plan.drawn)), 0.5))
        ends = checked_scenes(circuit, plan.spread({name: x[[0, -1]] for name, x in plan.grid.items()}, middle))
        for text in scenes_warnings(circuit, options.get("t_stop"), ends, options.get("skin", "own")):
            warnings.warn(text, FingerspiceWarning, stacklevel=4)
        # The warnings are those of one scene.
        with warnings.catch_warnings(action="ignore", category=FingerspiceWarning):
            first = batch(circuit, {path: values[:1] for path, values in ends.items()}, **options)
        refuse("u_gap" in first, "outputs are u_gap, and a store has figures, which are one number for each scene")
        self.block: tuple[int, ...] = ()  # Scenes of a chunk along each dimension
        for length in reversed(plan.sizes):
            size = CHUNK if first.status[0] == LOCKSTEP else SLOW_CHUNK
            self.block = min(length, max(1, size // math.prod(self.block))), *self.block
        self._grid = tuple(-(-size // own) for size, own in zip(plan.sizes, self.block, strict=True))
        self.chunks = math.prod(self._grid)
        require(self.chunks <= MOST_CHUNKS, "the sweep", f"{math.prod(plan.sizes):,} scenes", "at most "
                f"{MOST_CHUNKS:,} chunks of {math.prod(self.block):,}")  # fmt: skip
        plan.count = self.block[-1] if plan.drawn else plan.n
        # With ``error`` and, as the last, ``status``
        self.outputs = {
            str(name): Array(
                self.path / str(name), (*plan.dims, *map(str, one.dims[1:])), (*plan.sizes, *one.shape[1:]),
                (*self.block, *one.shape[1:]), dict(one.attrs),
            )
            for name, one in first.data_vars.items()
        }  # fmt: skip
        flags = {"flag_values": list(range(MISSING + 1)), "flag_meanings": " ".join((*STATUS_NAMES, "missing"))}
        self.outputs[STATUS] = replace(self.outputs.pop(STATUS), kind="i1", fill=MISSING, attributes=flags)
        # The drawn parameters
        self.drawn = {
            name: Array(self.path / name, ("scene",), plan.sizes[-1:], self.block[-1:], {"units": plan.units[name]})
            for name in plan.drawn
        }
        without = ("n_ordinary", "ordinary", "failures")
        self.about = {key: value for key, value in first.attrs.items() if key not in without} | plan.about

    def _place(self, index: int) -> tuple[int, ...]:
        """Number of a chunk along each dimension: chunks one after another have the same draws at other places."""
        return tuple(int(i) for i in np.unravel_index(index, self._grid, "F" if self.plan.drawn else "C"))

    def pieces(self, index: int) -> Iterator[tuple[str, Array, tuple[int, ...]]]:
        """Arrays of a chunk, and its place in each, ``status`` last; the first place of a grid has the draws."""
        at = dict(zip(self.plan.dims, self._place(index), strict=True))
        first = not any(at[name] for name in self.plan.grid)
        for name, one in ((self.drawn if first else {}) | self.outputs).items():
            yield name, one, tuple(at.get(dim, 0) for dim in one.dims)

    def open(self) -> None:
        """Create the store, or make sure that the one there is of this sweep: anything else there is refused."""
        own = json.loads(json.dumps({**self._identity(), "kind of checksum": CHECKSUM}, default=float))
        if not os.path.lexists(self.path):
            plan, arrays = self.plan, self.outputs | self.drawn
            for name, values in plan.grid.items():
                of = {NAMES: list(plan.names[name])} if name in plan.names else {"units": plan.units[name]}
                arrays[name] = Array(self.path / name, (name,), values.shape, values.shape, of, fill=0.0)
            try:
                create(self.path, {**self.about, RUN: json.dumps(own)}, arrays, plan.grid)
            except OSError as error:
                raise InputError(f"cannot write {self.path}: {error.strerror or error}") from None
        held = _identity_at(self.path)
        if differ := [key for key in {**own, **held} if held.get(key) != own.get(key)]:
            key, told = differ[0], [str(one.get(differ[0])) for one in (held, own)]
            said = "" if max(map(len, told)) > 40 else f" ({told[0]}, and this one {told[1]})"
            raise InputError(f"{self.path} holds a sweep of another {key.replace('_', ' ')}{said}; allowed: another "
                             "path, or to remove that folder")  # fmt: skip

    def _identity(self) -> dict[str, Any]:
        """All inputs that determine the bytes of the store, by which a later call recognises it."""
        plan, circuit, values = self.plan, self.plan.circuit, dict[str, Any]()
        for name, one in (plan.grid | plan.fixed).items():
            values[name] = hashlib.sha256(one.tobytes()).hexdigest() if one.size > 8 else one.tolist()
            if name in plan.names:
                values[name] = [plan.names[name], {path: np.ravel(x).tolist() for path, x in plan.own[name].items()}]
        # Nine digits are the same on every machine.
        values |= {name: [f"{x:.9g}" for x in law.ppf(_PROBES)] for name, law in plan.drawn.items()}
        # Options count alike, given or not.
        known = signature(batch).parameters.items()
        options = {name: one.default for name, one in known if one.default is not one.empty} | dict(self.options)
        del options["threads"]
        outputs = options["outputs"]
        options["outputs"] = [outputs] if isinstance(outputs, str) else list(outputs)
        return {
            "programs": self.programs, "circuit": digests(circuit), "law of the deck": circuit.charge_law,
            "times": repr(circuit.tran), "list of parameters": list(values),
            **{f"range of {name}": value for name, value in values.items()},
            **({"n": plan.n, "seed": plan.seed} if plan.drawn else {}),
            **options, "block": self.block,
        }  # fmt: skip

    def run_chunk(
        self, index: int, computing: AbstractContextManager[Any] = _FREE, writing: AbstractContextManager[Any] = _FREE
    ) -> Ran:
        """Run the scenes of a chunk within `computing`, such as a lock, and write them within `writing`."""
        there, own = (self.path / "zarr.json").is_file(), programs()
        refuse(not there, f"{self.path} is not there on a worker; allowed: a folder that all machines share")
        refuse(own != self.programs, f"a worker has {own}, and the sweep is of {self.programs}; allowed: the same")
        plan, at = self.plan, self._place(index)
        ranges = zip(at, self.block, plan.sizes, strict=True)
        part = tuple(slice(i * own, min((i + 1) * own, size)) for i, own, size in ranges)
        sizes = tuple(one.stop - one.start for one in part)
        with computing:
            draws = plan.draws(at[-1]) if at else {}
            grid = {name: values[one] for (name, values), one in zip(plan.grid.items(), part, strict=False)}
            found = batch(plan.circuit, plan.spread(grid, draws), **self.options)
        figures = {x: found[x].values.reshape((*sizes, *one.shape[len(part) :])) for x, one in self.outputs.items()}
        with writing:
            self._write(index, {**draws, **figures})
        failures = []
        for told in found.attrs["failures"]:
            # Scenes are told by their numbers in the whole sweep; a sweep without dimensions is one scene.
            scene, _, message = told.removeprefix("scene ").partition(": ")
            place = np.add([one.start for one in part], np.unravel_index(int(scene), sizes)).astype(int)
            failures.append(f"scene {np.ravel_multi_index(tuple(place), plan.sizes) if part else 0}: {message}")
        return found.sizes["scene"], failures

    def _write(self, index: int, values: Mapping[str, NDArray[Any]]) -> None:
        try:
            for name, one, place in self.pieces(index):
                one.put(place, values[name])
        except OSError as error:
            raise InputError(f"cannot write {self.path}: {error.strerror or error}; {_GOES_ON}") from None


def _identity_at(path: Path) -> dict[str, Any]:
    """What the store that is at a path holds about its sweep; refuses what is no store of a sweep."""
    try:
        return dict(json.loads(attributes_of(path)[RUN]))
    except (OSError, ValueError, KeyError, TypeError):
        raise InputError(f"{path} is there already and is no store of a sweep; allowed: another path") from None


def stored(
    plan: Plan, options: Mapping[str, Any], path: Path, workers: int | None, scheduler: str | None,
    shard: tuple[int, int],
) -> Dataset:  # fmt: skip
    """Run the missing chunks of a sweep, or of a shard of it, and return what the store has, read when it is used."""
    from xarray import open_zarr

    if workers is not None:
        whole_number("workers", workers, 1)
        refuse(scheduler is not None, "workers and scheduler are both given; allowed: one of them")
    good = len(shard) == 2 and all(isinstance(x, int) for x in shard) and 1 <= shard[0] <= shard[1]
    require(good, "shard", shard, "two whole numbers (i, m), with i from 1 to m")
    if os.path.lexists(path):
        _identity_at(path)
    here = workers is None and scheduler is None
    work = Work(plan, options if here else {"threads": 1, **options}, path)
    with nullcontext() if here else _client(workers and min(workers, work.chunks), scheduler) as client:
        work.open()
        begun, mine = time.perf_counter(), range(shard[0] - 1, work.chunks, shard[1])
        # Chunks that have not been written as a whole, or have changed since
        missing = [i for i in mine if any(one.fault(place) is not None for _, one, place in work.pieces(i))]
        answers = _here(work, missing) if here or not missing else _by_scheduler(work, missing, client)
        failures: list[str] = []
        scenes, there, whole = 0, len(mine) - len(missing), max(len(mine), 1)
        with paced("sweeping", there / whole) as show:
            for number, (count, told) in enumerate(answers, there + 1):
                failures, scenes = failures + told, scenes + count
                show(number / whole, lambda s, count=scenes: f"{count / s:,.3g} scenes/s,")
        lacking = work.chunks - sum(len(files) for _, _, files in os.walk(work.path / STATUS / "c"))
        if not lacking:
            tidy(work.path)
        took = time.perf_counter() - begun
    found: Dataset = open_zarr(work.path, chunks=None, consolidated=False, zarr_format=3).set_coords(list(work.drawn))
    found = found.assign_coords(plan.coordinates)[list(work.outputs)]
    del found.attrs[RUN]
    found.attrs |= {"chunks": len(mine), "chunks_found": there, "chunks_missing": lacking, "seconds": took}
    found.attrs["failures"] = failures[:MESSAGES]
    return found


def _here(work: Work, missing: Sequence[int]) -> Iterator[Ran]:
    """Chunks by this process."""
    # A batch changes the filters for a while, and two of them at once for good.
    with warnings.catch_warnings(action="ignore", category=FingerspiceWarning), ThreadPoolExecutor(AT_ONCE) as pool:
        yield from pool.map(partial(work.run_chunk, computing=Lock()), missing)


@contextmanager
def _client(workers: int | None, scheduler: str | None) -> Iterator[Any]:
    """A client of so many `workers` on this machine, or of those of a scheduler."""
    try:
        import distributed
    except ImportError:
        raise InputError(f"{'scheduler' if workers is None else 'workers'} takes the package distributed, which is not "
                         "installed; allowed: pip install 'fingerspice[cluster]'") from None  # fmt: skip
    own = {
        "n_workers": workers, "threads_per_worker": 1, "memory_limit": 0, "dashboard_address": "127.0.0.1:0",
        "silence_logs": logging.CRITICAL,
    }  # fmt: skip
    try:
        client = distributed.Client(scheduler, timeout=PATIENCE, set_as_default=False, **(own if workers else {}))
    except (OSError, ValueError, ImportError, RuntimeError) as error:
        fault, hint = "the workers did not start", "in a script, allowed: workers under if __name__ == '__main__'"
        if workers is None:
            fault = f"no scheduler answers at {scheduler}"
            hint = "allowed: the address that `dask scheduler` tells, such as tcp://10.0.0.1:8786"
        raise InputError(f"{fault} ({type(error).__name__}); {hint}") from None
    # Workers that it has started end with it.
    with client:
        yield client


def _by_scheduler(work: Work, missing: Sequence[int], client: Any) -> Iterator[Ran]:
    """Chunks by the workers of a Dask scheduler, which gives the chunks of a lost worker to others."""
    from distributed import KilledWorker, TimeoutError, as_completed

    # Held by the scheduler, not by a worker, with which it could be lost.
    held = client.submit(lambda: work, pure=False)
    todo, lost = deque(missing), Counter[int | None]()
    running: dict[Any, int] = {}
    given_up: dict[int, Exception] = {}
    waiting = as_completed(loop=client.loop)
    while todo or running:
        # A chunk that workers were lost with is run alone, so that it alone is blamed.
        while todo and len(running) < (1 if lost.keys() & {todo[0], *running.values()} else AHEAD):
            index = todo.popleft()
            future = client.submit(_run_and_write_aside, held, index, pure=False)
            running[future] = index
            waiting.add(future)
        future = next(waiting)
        index = running.pop(future)
        try:
            answer = future.result(timeout=PATIENCE)
        except InputError:
            raise
        except (KilledWorker, TimeoutError) as error:
            # The scheduler gives a chunk up that several workers were lost with; and an answer that is lost with its
            # worker does not come before the chunk has been run again.
            lost.update((None, index) if isinstance(error, KilledWorker) else (None,))
            if lost[None] == MOST_LOST:
                raise _lost("one chunk after another", MOST_LOST, error) from None
            given_up[index] = error
            if lost[index] < TRIES:
                todo.append(index)
        except Exception as error:
            ended = f"the sweep at the scheduler ended with {type(error).__name__}"
            raise InputError(f"{ended}: {error}; {_GOES_ON}") from None
        else:
            lost[None], _ = 0, given_up.pop(index, None)
            yield answer
    for index, reason in given_up.items():
        raise _lost(f"chunk {index} of the sweep", TRIES, reason)


def _lost(chunk: str, count: int, reason: Exception) -> InputError:
    return InputError(f"the workers of {chunk} were lost, {count} times: {reason}; allowed: fewer workers, if the "
                      f"memory is too small for these; {_GOES_ON}")  # fmt: skip


def _run_and_write_aside(work: Work, index: int) -> Ran:
    """A task of Dask: its worker computes the next chunk while this one is written."""
    from distributed import secede

    keep_freed_memory()
    if parent_process() is not None:
        # A process of Dask's own, whose terminal may be the user's, who has been warned before the first chunk.
        warnings.simplefilter("ignore", FingerspiceWarning)

    @contextmanager
    def aside() -> Iterator[None]:
        # What is done in here takes no thread of the worker; one task at a time, so that chunks cannot pile up.
        with _WRITING:
            secede()
            yield

    return work.run_chunk(index, writing=aside())
