"""A sweep divided into chunks by itself alone, what determines their bytes, and running one of them."""

from __future__ import annotations

import hashlib
import math
import warnings
from collections.abc import Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from inspect import signature
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fingerspice import __version__
from fingerspice.base.arrays import FloatArray
from fingerspice.base.errors import FingerspiceWarning, InputError
from fingerspice.circuit.circuit import Circuit
from fingerspice.circuit.describe import digests
from fingerspice.circuit.notices import scenes_warnings
from fingerspice.results.store import Array
from fingerspice.studies.batch.batch import batch
from fingerspice.studies.batch.task import LOCKSTEP, REFUSED, STATUS_NAMES, checked_scenes
from fingerspice.studies.sweep import plan as plans
from fingerspice.studies.sweep.store import STATUS, SweepStore
from fingerspice.waveforms.waveform import require

if TYPE_CHECKING:
    from xarray import Dataset

# Scenes of a chunk, if the first scene goes in lockstep, and if it does not; largest number of chunks.
CHUNK, SLOW_CHUNK, MOST_CHUNKS = 1 << 17, 1 << 8, 1 << 20
# The status of a scene that has not been run.
MISSING = len(STATUS_NAMES)
# Quantiles by which a distribution is recognised.
_PROBES = np.linspace(0.015625, 0.984375, 63)
_FREE = nullcontext()


@dataclass(frozen=True)
class Work:
    """A sweep with all that it takes to run any chunk of it; `draws` are None where nothing is drawn."""

    circuit: Circuit
    plan: plans.Plan
    draws: plans.Sequence | None
    options: Mapping[str, Any]
    store: SweepStore
    programs: str


@dataclass(frozen=True)
class Done:
    """A chunk that is in the store: how many scenes it has, and why some of them have no result."""

    count: int
    failures: list[str]


def programs() -> str:
    """What the bytes of a result depend on beside the request."""
    import scipy

    return f"fingerspice {__version__}, NumPy {np.__version__}, SciPy {scipy.__version__}"


def make_work(
    circuit: Circuit, plan: plans.Plan, options: Mapping[str, Any], path: Path
) -> tuple[Work, dict[str, Any]]:
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
    store = _divided(plan, first, path.absolute())
    require(store.chunks <= MOST_CHUNKS, "the sweep", f"{math.prod(plan.sizes):,} scenes", f"at most {MOST_CHUNKS:,} "
            f"chunks of {math.prod(store.block):,}")  # fmt: skip
    about = {key: value for key, value in first.attrs.items() if key not in ("n_ordinary", "ordinary", "failures")}
    draws = plan.sequence(store.block[-1]) if plan.drawn else None
    return Work(circuit, plan, draws, options, store, programs()), about | plan.about(circuit)


def _divided(plan: plans.Plan, first: Dataset, path: Path) -> SweepStore:
    """The store of a sweep, whose first scene has outputs of this kind."""
    size = CHUNK if int(first.status[0]) == LOCKSTEP else SLOW_CHUNK
    block: tuple[int, ...] = ()
    for length in reversed(plan.sizes):
        block = min(length, max(1, size // math.prod(block))), *block
    outputs = {
        str(name): Array(
            path / str(name), (*plan.dims, *map(str, one.dims[1:])), (*plan.sizes, *one.shape[1:]),
            (*block, *one.shape[1:]), dict(one.attrs),
        )
        for name, one in first.data_vars.items()
    }  # fmt: skip
    flags = dict(outputs[STATUS].attributes)
    flags |= {"flag_values": [*flags["flag_values"], MISSING], "flag_meanings": f"{flags['flag_meanings']} missing"}
    outputs[STATUS] = replace(outputs[STATUS], kind="i1", fill=MISSING, attributes=flags)
    drawn = {
        name: Array(path / name, ("scene",), plan.sizes[-1:], block[-1:], {"units": plan.units[name]})
        for name in plan.drawn
    }
    grid = {
        name: Array(path / name, (name,), values.shape, values.shape, plan.told(name), fill=0.0)
        for name, values in plan.grid.items()
    }
    return SweepStore(path, plan.dims, plan.sizes, block, outputs, drawn, grid)


def _check_values(circuit: Circuit, plan: plans.Plan) -> None:
    """Refuse what a parameter does not accept: values of the grid, and quantiles beyond which there are draws."""
    ends = plan.quantiles(np.repeat([[1.0 / plan.n], [1.0 - 1.0 / plan.n]], len(plan.drawn), axis=1))
    for name, values in (plan.grid | plan.fixed | ends).items():
        if not (paths := plan.paths({name: values})):
            # Sets of parameters that do not differ.
            continue
        try:
            checked_scenes(circuit, paths)
        except InputError as error:
            kind = "the distribution of" if name in plan.drawn else "the values of"
            raise InputError(f"{kind} {name}: {error}") from None


def identity_of(work: Work) -> dict[str, Any]:
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
        **_effective(work.options), "block": work.store.block,
    }  # fmt: skip


def _effective(options: Mapping[str, Any]) -> dict[str, Any]:
    """The options that determine results, given or not."""
    own = {name: one.default for name, one in signature(batch).parameters.items() if one.default is not one.empty}
    every = {**own, **options}
    del every["threads"]
    return {**every, "outputs": [every["outputs"]] if isinstance(every["outputs"], str) else list(every["outputs"])}


def run_chunk(
    work: Work, index: int, computing: AbstractContextManager[Any] = _FREE, writing: AbstractContextManager[Any] = _FREE
) -> Done:
    """Run the scenes of a chunk, write them to the store, and mark the chunk as done.

    Scenes are run within `computing`: a lock, where several chunks of a process are to be computed one after another;
    and written within `writing`.
    """
    store = work.store
    if not (store.path / "zarr.json").is_file():
        raise InputError(f"{store.path} is not there on a worker; allowed: a folder that all machines share")
    if programs() != work.programs:
        raise InputError(f"a worker has {programs()}, and the sweep is of {work.programs}; allowed: the same")
    part = store.part(index)
    with computing:
        found, draws = _computed(work, index, part)
    values = {}
    for name, one in store.outputs.items():
        own, more = found[name].values, one.shape[len(part) :]
        if own.ndim == 1 and more:
            # No scene of the chunk has a result.
            own = np.full((own.size, *more), np.nan)
        values[name] = own.reshape((*(each.stop - each.start for each in part), *more))
    with writing:
        store.write(index, values | draws)
    return Done(found.sizes["scene"], [_by_its_number(told, work, part) for told in found.attrs["failures"]])


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
