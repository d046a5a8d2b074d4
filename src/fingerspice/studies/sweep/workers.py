"""A sweep into a store: its chunks run by this process, or by the workers of a Dask scheduler, here or elsewhere."""

from __future__ import annotations

import logging
import os
import time
import warnings
from collections import Counter, deque
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from functools import partial
from multiprocessing import parent_process
from pathlib import Path
from threading import Lock
from typing import TYPE_CHECKING, Any

from fingerspice.base.announcing import paced
from fingerspice.base.arrays import keep_freed_memory, whole_number
from fingerspice.base.errors import FingerspiceWarning, InputError
from fingerspice.circuit.circuit import Circuit
from fingerspice.results.runfile import tidy
from fingerspice.studies.batch.batch import MESSAGES
from fingerspice.studies.sweep.chunks import Work, identity_at, make_work
from fingerspice.studies.sweep.plan import Plan
from fingerspice.waveforms.waveform import require

if TYPE_CHECKING:
    from xarray import Dataset

# What is known of a chunk that has been run: the number of its scenes, and why some of them have no result.
Ran = tuple[int, list[str]]
# Chunks that a process has at once: it computes one while another one is waiting for the disk.
AT_ONCE = 2
_WRITING = Lock()
# How often the scheduler may give up one chunk, and chunks one after another: each time it has lost several workers.
TRIES, MOST_LOST = 2, 20
# Chunks that a scheduler is given at once, and how long it may take to answer, s.
AHEAD, PATIENCE = 4096, 5.0


def stored(
    circuit: Circuit, plan: Plan, options: Mapping[str, Any], path: Path, workers: int | None, scheduler: str | None,
    shard: tuple[int, int],
) -> Dataset:  # fmt: skip
    """Run the missing chunks of a sweep, or of a shard of it, and return what the store has."""
    if workers is not None:
        whole_number("workers", workers, 1)
        if scheduler is not None:
            raise InputError("workers and scheduler are both given; allowed: one of them")
    good = len(shard) == 2 and all(isinstance(x, int) for x in shard) and 1 <= shard[0] <= shard[1]
    require(good, "shard", shard, "two whole numbers (i, m), with i from 1 to m")
    if os.path.lexists(path):
        identity_at(path)
    work, about = make_work(circuit, plan, options, path)
    if workers is not None or scheduler is not None:
        work = replace(work, options={"threads": 1, **options})
    with at_work(None if workers is None else min(workers, work.chunks), scheduler) as client:
        work.open(about)
        begun, mine = time.perf_counter(), range(shard[0] - 1, work.chunks, shard[1])
        missing = [index for index in mine if not work.is_done(index)]
        answers = _here(work, missing) if client is None or not missing else _by_scheduler(work, missing, client)
        failures: list[str] = []
        scenes, there, whole = 0, len(mine) - len(missing), max(len(mine), 1)
        with paced("sweeping", there / whole) as show:
            for number, (count, told) in enumerate(answers, there + 1):
                failures, scenes = failures + told, scenes + count
                show(number / whole, lambda s, count=scenes: f"{count / s:,.3g} scenes/s,")
        lacking = work.chunks - work.marked()
        if not lacking:
            tidy(work.path)
        took = time.perf_counter() - begun
    found = work.dataset()
    found.attrs |= {"chunks": len(mine), "chunks_found": there, "chunks_missing": lacking, "seconds": took}
    found.attrs["failures"] = failures[:MESSAGES]
    return found


def _here(work: Work, missing: Sequence[int]) -> Iterator[Ran]:
    """Chunks by this process."""
    # A batch changes the filters for a while, and two of them at once for good.
    with warnings.catch_warnings(), ThreadPoolExecutor(AT_ONCE) as pool:
        warnings.simplefilter("ignore", FingerspiceWarning)
        yield from pool.map(partial(work.run_chunk, computing=Lock()), missing)


@contextmanager
def at_work(workers: int | None, scheduler: str | None) -> Iterator[Any]:
    """A client of the `workers` that run the chunks on this machine, or of those of a scheduler; None for neither."""
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


def _run_and_write_aside(work: Work, index: int) -> Ran:
    """A task of Dask: its worker computes the next chunk while this one is written."""
    keep_freed_memory()
    if parent_process() is not None:
        # A process of Dask's own, whose terminal may be the user's, who has been warned before the first chunk.
        warnings.simplefilter("ignore", FingerspiceWarning)
    return work.run_chunk(index, writing=_aside())


@contextmanager
def _aside() -> Iterator[None]:
    """What a task does in here takes no thread of its worker; one task at a time, so that chunks cannot pile up."""
    from distributed import secede

    with _WRITING:
        secede()
        yield
