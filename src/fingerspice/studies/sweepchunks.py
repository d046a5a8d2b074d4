"""A sweep chunk by chunk, into a store: by this process, by processes of its own, or by the workers of a scheduler."""

from __future__ import annotations

import multiprocessing
import signal
import time
import warnings
from collections import Counter, deque
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from dataclasses import dataclass, field
from functools import partial
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from multiprocessing.reduction import ForkingPickler
from threading import Lock
from typing import TYPE_CHECKING, Any

import numpy as np

from fingerspice import __version__
from fingerspice.base.announcing import paced
from fingerspice.base.arrays import FloatArray, keep_freed_memory
from fingerspice.base.errors import FingerspiceWarning, InputError
from fingerspice.circuit.circuit import Circuit
from fingerspice.studies import sweepplan
from fingerspice.studies.batch import MESSAGES, batch
from fingerspice.studies.sweepplan import Plan

if TYPE_CHECKING:
    from xarray import Dataset

    from fingerspice.studies.sweepstore import SweepStore

# Chunks that a process has at once: it computes one while another one is waiting for the disk.
AT_ONCE = 2
_FREE = nullcontext()
_WRITING = Lock()
# Workers that may be lost with one chunk, and one after another while no chunk is finished.
TRIES, MOST_LOST = 3, 20
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


def run_chunks(work: Work, shard: tuple[int, int], workers: int | None, client: Any) -> dict[str, Any]:
    """Run the chunks of a shard that are not yet done.

    They are run in this process, in `workers` processes, or by the workers of a `client` of Dask.

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
    elif missing and workers is not None:
        answers = _by_processes(work, missing, min(workers, len(missing)))
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


@dataclass
class _Worker:
    """A process, the pipe to it, the chunks that it has, and whether it has told that it is there."""

    process: BaseProcess
    pipe: Connection
    has: set[int] = field(default_factory=set)
    ready: bool = False


def _by_processes(work: Work, missing: Sequence[int], count: int) -> Iterator[Done]:
    """Chunks by processes of this machine; the chunk of a process that is lost goes to another one."""
    try:
        sent = bytes(ForkingPickler.dumps(work))
    except (AttributeError, TypeError, ValueError) as error:
        raise InputError(f"the sweep cannot be sent to other processes: {error}") from None
    todo, left, lost = deque(missing), len(missing), Counter[int | None]()
    crew = {worker.pipe: worker for worker in (_hired(sent) for _ in range(count))}
    try:
        while left:
            for pipe in wait(list(crew)):
                assert isinstance(pipe, Connection)
                worker = crew[pipe]
                try:
                    answer = pipe.recv()
                except (EOFError, OSError):
                    del crew[pipe]
                    lost.update({None, *worker.has})
                    _mourn(worker, lost)
                    todo.extend(worker.has)
                    new = _hired(sent)
                    crew[new.pipe] = new
                    continue
                if isinstance(answer, Exception):
                    raise answer
                worker.ready = True
                if answer is not None:
                    worker.has.remove(answer.index)
                # A chunk that a worker was lost with is run alone, so that it alone is blamed.
                while todo and len(worker.has) < (1 if lost.keys() & {todo[0], *worker.has} else AT_ONCE):
                    worker.has.add(todo[0])
                    # A process that is lost meanwhile is found by its closed pipe.
                    with suppress(OSError):
                        pipe.send(todo.popleft())
                if answer is not None:
                    lost[None], left = 0, left - 1
                    yield answer
    finally:
        for worker in crew.values():
            worker.process.terminate()
            worker.pipe.close()
        for worker in crew.values():
            worker.process.join()


def _hired(sent: bytes) -> _Worker:
    """A new process, to which the sweep is sent."""
    context = multiprocessing.get_context("spawn")
    own, other = context.Pipe()
    process = context.Process(target=_serve, args=(other,), daemon=True)
    process.start()
    other.close()
    with suppress(OSError):
        own.send_bytes(sent)
    return _Worker(process, own)


def _mourn(worker: _Worker, lost: Counter[int | None]) -> None:
    """Refuse to go on where workers cannot start, or too many were lost in a row or with one chunk."""
    worker.pipe.close()
    worker.process.join()
    code = worker.process.exitcode
    if not worker.ready and code is not None and code > 0:
        raise InputError(
            f"a worker ended with code {code} before it began; in a script, allowed: workers under "
            "if __name__ == '__main__'"
        )
    _give_up(lost, f", the last with code {code}")


def _give_up(lost: Counter[int | None], last: str) -> None:
    """Refuse to go on where too many workers were lost with one chunk, or in a row (counted under None)."""
    for index, count in lost.items():
        if count >= (MOST_LOST if index is None else TRIES):
            how = "one after another" if index is None else f"with chunk {index} of the sweep"
            raise InputError(
                f"{count} workers were lost {how}{last}; allowed: fewer workers, if the memory is too small for these; "
                "what is written stays, and the same command goes on from there"
            )


def _serve(pipe: Connection) -> None:
    """A worker: runs the chunks that it is told to until the pipe is closed."""
    # Ctrl-C is for the process that has started this one.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    warnings.simplefilter("ignore")
    sending, computing = Lock(), Lock()

    def tell(answer: Done | Exception | None) -> None:
        with sending, suppress(OSError):
            pipe.send(answer)

    def run(index: int) -> None:
        try:
            tell(run_chunk(work, index, computing))
        except Exception as error:
            tell(error)

    with suppress(EOFError, OSError), ThreadPoolExecutor(AT_ONCE) as pool:
        work: Work = pipe.recv()
        tell(None)
        while True:
            pool.submit(run, pipe.recv())


@contextmanager
def scheduled(address: str | None) -> Iterator[Any]:
    """The client of a Dask scheduler; None without an address.

    Raises
    ------
    InputError
        If Dask is not installed, or nothing answers at this address.
    """
    if address is None:
        yield None
        return
    try:
        import distributed
    except ImportError:
        raise InputError(
            "scheduler takes the package distributed, which is not installed; allowed: pip install "
            "'fingerspice[cluster]'"
        ) from None
    try:
        client = distributed.Client(address, timeout=PATIENCE, set_as_default=False)
    except (OSError, ValueError, ImportError, RuntimeError) as error:
        raise InputError(
            f"no scheduler answers at {address} ({type(error).__name__}); allowed: the address that `dask scheduler` "
            "tells, such as tcp://10.0.0.1:8786"
        ) from None
    with client:
        yield client


def _by_scheduler(work: Work, missing: Sequence[int], client: Any) -> Iterator[Done]:
    """Chunks by the workers of a Dask scheduler, which gives the chunks of a lost worker to others."""
    from distributed import KilledWorker, TimeoutError, as_completed

    # Held by the scheduler, not by a worker, with which it could be lost.
    held = client.submit(_same, work, pure=False)
    todo, lost = deque(missing), Counter[int | None]()
    running: dict[Any, int] = {}
    waiting = as_completed(loop=client.loop)
    while todo or running:
        while todo and len(running) < AHEAD:
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
            _give_up(lost, f": {error}")
            todo.append(index)
        except Exception as error:
            raise InputError(
                f"the sweep at the scheduler ended with {type(error).__name__}: {error}; what is written stays, and "
                "the same command goes on from there"
            ) from None
        else:
            lost[None] = 0
            yield answer


def _same(work: Work) -> Work:
    return work


def _run_and_write_aside(work: Work, index: int) -> Done:
    """A task of Dask: its worker computes the next chunk while this one is written."""
    keep_freed_memory()
    return run_chunk(work, index, writing=_aside())


@contextmanager
def _aside() -> Iterator[None]:
    """What a task does in here takes no thread of its worker; one task at a time, so that chunks cannot pile up."""
    from distributed import secede

    with _WRITING:
        secede()
        yield
