"""A sweep chunk by chunk, into a store: by this process, or by the workers of a Dask scheduler, here or elsewhere."""

from __future__ import annotations

import logging
import time
import warnings
from collections import Counter, deque
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext
from dataclasses import dataclass
from functools import partial
from multiprocessing import parent_process
from threading import Lock
from typing import TYPE_CHECKING, Any

import numpy as np

from fingerspice import __version__
from fingerspice.base.announcing import paced
from fingerspice.base.arrays import FloatArray, keep_freed_memory
from fingerspice.base.errors import FingerspiceWarning, InputError
from fingerspice.circuit.circuit import Circuit
from fingerspice.studies import sweepplan
from fingerspice.studies.batch.batch import MESSAGES, batch
from fingerspice.studies.sweepplan import Plan

if TYPE_CHECKING:
    from xarray import Dataset

    from fingerspice.studies.sweepstore import SweepStore

# Chunks that a process has at once: it computes one while another one is waiting for the disk.
AT_ONCE = 2
_FREE = nullcontext()
_WRITING = Lock()
# How often the scheduler may give up one chunk, and chunks one after another: each time it has lost several workers.
TRIES, MOST_LOST = 2, 20
# Chunks that a scheduler is given at once, and how long it may take to answer, s.
AHEAD, PATIENCE = 4096, 5.0


@dataclass(frozen=True)
class Work:
    """A sweep with all that it takes to run any chunk of it; `draws` are None where nothing is drawn."""

    circuit: Circuit
    plan: Plan
    draws: sweepplan.Sequence | None
    options: Mapping[str, Any]
    store: SweepStore
    programs: str


@dataclass(frozen=True)
class Done:
    """A chunk that is in the store: its number, how many scenes it has, and why some of them have no result."""

    index: int
    count: int
    failures: list[str]


def programs() -> str:
    """What the bytes of a result depend on beside the request."""
    import scipy

    return f"fingerspice {__version__}, NumPy {np.__version__}, SciPy {scipy.__version__}"


def run_chunk(
    work: Work, index: int, computing: AbstractContextManager[Any] = _FREE, writing: AbstractContextManager[Any] = _FREE
) -> Done:
    """Run the scenes of a chunk, write them to the store, and mark the chunk as done.

    Scenes are run within `computing`: a lock, where several chunks of a process are to be computed one after another;
    and written within `writing`.

    Raises
    ------
    InputError
        If a value is out of range, or the store is not there or cannot be written.
    """
    store = work.store
    if not (store.path / "zarr.json").is_file():
        raise InputError(f"{store.path} is not there on a worker; allowed: a folder that all machines share")
    if programs() != work.programs:
        raise InputError(f"a worker has {programs()}, and the sweep is of {work.programs}; allowed: the same")
    part = store.part(index)
    with computing:
        found, draws = _computed(work, index, part)
    shape = tuple(one.stop - one.start for one in part)
    values = {}
    for name in store.arrays:
        own, more = found[name].values, tuple(store.arrays[name].further.values())
        if own.ndim == 1 and more:
            # No scene of the chunk has a result.
            own = np.full((own.size, *more), np.nan)
        values[name] = own.reshape((*shape, *more))
    with writing:
        store.write(index, values | draws)
    return Done(index, found.sizes["scene"], [_by_its_number(told, work, part) for told in found.attrs["failures"]])


def _computed(work: Work, index: int, part: tuple[slice, ...]) -> tuple[Dataset, dict[str, FloatArray]]:
    """The batch of a chunk's scenes, and the values that are drawn."""
    draws = {} if work.draws is None else work.draws.part(work.store.place(index)[-1])
    grid = {name: values[one] for (name, values), one in zip(work.plan.grid.items(), part, strict=False)}
    return batch(work.circuit, work.plan.spread(grid, draws), **work.options), draws


def _by_its_number(told: str, work: Work, part: tuple[slice, ...]) -> str:
    """The message about a scene of a chunk, with the scene's number in the whole sweep."""
    scene, _, message = told.partition(": ")
    place = np.unravel_index(int(scene.removeprefix("scene ")), [one.stop - one.start for one in part])
    whole = [one.start + int(i) for one, i in zip(part, place, strict=True)]
    return f"scene {np.ravel_multi_index(whole, work.plan.sizes) if whole else 0}: {message}"


def run_chunks(work: Work, shard: tuple[int, int], client: Any) -> dict[str, Any]:
    """Run the chunks of a shard that are not yet done, in this process or by the workers of a `client` of Dask.

    Returns
    -------
    dict
        `chunks` of the shard, how many were found (`chunks_found`), how many the whole store still lacks
        (`chunks_missing`), the `seconds` taken, and `failures`, why scenes have no result.

    Raises
    ------
    InputError
        As `run_chunk`, and if too many workers are lost.
    """
    begun, store = time.perf_counter(), work.store
    mine = range(shard[0] - 1, store.chunks, shard[1])
    missing = [index for index in mine if not store.is_done(index)]
    answers: Iterator[Done] = iter(())
    if missing and client is not None:
        answers = _by_scheduler(work, missing, client)
    elif missing:
        answers = _here(work, missing)
    failures: list[str] = []
    scenes, found, whole = 0, len(mine) - len(missing), max(len(mine), 1)
    with paced("sweeping", found / whole) as show:
        for number, done in enumerate(answers, found + 1):
            failures, scenes = failures + done.failures, scenes + done.count
            show(number / whole, lambda s, count=scenes: f"{count / s:,.3g} scenes/s,")
    lacking = store.chunks - store.marked()
    if not lacking:
        store.tidy()
    return {
        "chunks": len(mine), "chunks_found": found, "chunks_missing": lacking,
        "seconds": time.perf_counter() - begun, "failures": failures[:MESSAGES],
    }  # fmt: skip


def _here(work: Work, missing: Sequence[int]) -> Iterator[Done]:
    """Chunks by this process."""
    # A batch changes the filters for a while, and two of them at once for good.
    with warnings.catch_warnings(), ThreadPoolExecutor(AT_ONCE) as pool:
        warnings.simplefilter("ignore", FingerspiceWarning)
        yield from pool.map(partial(run_chunk, work, computing=Lock()), missing)


@contextmanager
def at_work(workers: int | None, scheduler: str | None) -> Iterator[Any]:
    """A client of the `workers` that run the chunks on this machine, or of those of a scheduler; None for neither.

    Raises
    ------
    InputError
        If Dask is not installed, no worker can start, or nothing answers at the scheduler's address.
    """
    if workers is None and scheduler is None:
        yield None
        return
    try:
        import distributed
    except ImportError:
        raise InputError(
            f"{'scheduler' if workers is None else 'workers'} takes the package distributed, which is not installed; "
            "allowed: pip install 'fingerspice[cluster]'"
        ) from None
    with ExitStack() as held:
        try:
            if workers is not None:
                scheduler = held.enter_context(
                    distributed.LocalCluster(
                        n_workers=workers, threads_per_worker=1, memory_limit=0, dashboard_address="127.0.0.1:0",
                        silence_logs=logging.CRITICAL,
                    )
                ).scheduler_address  # fmt: skip
            client = held.enter_context(distributed.Client(scheduler, timeout=PATIENCE, set_as_default=False))
        except (OSError, ValueError, ImportError, RuntimeError) as error:
            raise InputError(
                f"no scheduler answers at {scheduler} ({type(error).__name__}); allowed: the address that "
                "`dask scheduler` tells, such as tcp://10.0.0.1:8786"
                if workers is None
                else f"the workers did not start ({type(error).__name__}); in a script, allowed: workers under "
                "if __name__ == '__main__'"
            ) from None
        yield client


def _by_scheduler(work: Work, missing: Sequence[int], client: Any) -> Iterator[Done]:
    """Chunks by the workers of a Dask scheduler, which gives the chunks of a lost worker to others."""
    from distributed import KilledWorker, TimeoutError, as_completed

    # Held by the scheduler, not by a worker, with which it could be lost.
    held = client.submit(_same, work, pure=False)
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
            raise InputError(
                f"the sweep at the scheduler ended with {type(error).__name__}: {error}; what is written stays, and "
                "the same command goes on from there"
            ) from None
        else:
            lost[None], _ = 0, given_up.pop(index, None)
            yield answer
    for index, reason in given_up.items():
        raise _lost(f"chunk {index} of the sweep", TRIES, reason)


def _lost(chunk: str, count: int, reason: Exception) -> InputError:
    return InputError(
        f"the workers of {chunk} were lost, {count} times: {reason}; allowed: fewer workers, if the memory is too "
        "small for these; what is written stays, and the same command goes on from there"
    )


def _same(work: Work) -> Work:
    return work


def _run_and_write_aside(work: Work, index: int) -> Done:
    """A task of Dask: its worker computes the next chunk while this one is written."""
    keep_freed_memory()
    if parent_process() is not None:
        # A process of Dask's own, whose terminal may be the user's, who has been warned before the first chunk.
        warnings.simplefilter("ignore", FingerspiceWarning)
    return run_chunk(work, index, writing=_aside())


@contextmanager
def _aside() -> Iterator[None]:
    """What a task does in here takes no thread of its worker; one task at a time, so that chunks cannot pile up."""
    from distributed import secede

    with _WRITING:
        secede()
        yield
