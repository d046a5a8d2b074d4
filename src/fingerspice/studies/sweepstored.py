"""A sweep that goes into a store: its chunks, which the sweep alone determines, and its identity."""

from __future__ import annotations

import hashlib
import math
import os
import warnings
from collections.abc import Mapping
from inspect import signature
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fingerspice.base.arrays import whole_number
from fingerspice.base.errors import FingerspiceWarning, InputError
from fingerspice.circuit.circuit import Circuit
from fingerspice.circuit.notices import scenes_warnings
from fingerspice.circuit.provenance import digests
from fingerspice.studies.batch import batch, checked_scenes
from fingerspice.studies.batchtask import LOCKSTEP, REFUSED
from fingerspice.studies.sweepchunks import Work, programs, run_chunks, scheduled
from fingerspice.studies.sweepplan import Plan
from fingerspice.studies.sweepstore import MISSING, NAMES, STATUS, SweepStore, Variable, identity
from fingerspice.waveforms.waveform import require

if TYPE_CHECKING:
    from xarray import Dataset

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
    with scheduled(scheduler) as client:
        work.store.open(_identity(work, options), about, grid)
        told = run_chunks(work, shard, workers, client)
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
