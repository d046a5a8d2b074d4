"""Grids and random populations of a circuit's parameters, and which of them a figure's variance comes from."""

from __future__ import annotations

import math
from collections.abc import Mapping
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from fingerspice.base.arrays import FloatArray, real_number
from fingerspice.base.errors import InputError
from fingerspice.circuit.circuit import Circuit
from fingerspice.studies.batch.batch import batch
from fingerspice.studies.batch.form import REFUSED
from fingerspice.studies.sweep.plan import BITS, Plan, make_plan, with_sets
from fingerspice.studies.sweep.workers import stored
from fingerspice.waveforms.waveform import require

if TYPE_CHECKING:
    from xarray import Dataset

# Largest number of scenes of a sweep, whose figures are kept in memory (some 100 bytes each), of a population, and of a
# population in a store.
MOST_SCENES, MOST_SAMPLES, MOST_STORED_SAMPLES = 1 << 26, 1 << 20, 1 << BITS
# Quantiles of one parameter at which its influence is shown, all others being at their medians.
QUANTILES = (0.05, 0.5, 0.95)
# Resamples of the population for the intervals of the indices. (scipy's own cannot be given a seed.)
RESAMPLES = 499


def sweep(
    circuit: Circuit,
    parameters: Mapping[str, ArrayLike | Any],
    *,
    n: int = 1024,
    seed: int = 0,
    store: Path | str | None = None,
    workers: int | None = None,
    scheduler: str | None = None,
    shard: tuple[int, int] = (1, 1),
    **options: Any,
) -> Dataset:
    """Figures over a grid of some parameters and a random population of others.

    Every array makes a dimension of the grid; a single number holds in all scenes. All
    distributions together make the dimension ``scene``: `n` points of a scrambled Sobol sequence, mapped by their
    inverse distribution functions, the same points at each place of the grid.

    Parameters
    ----------
    circuit : Circuit
    parameters : mapping of str to array_like or distribution
        Path, as in `Circuit.replace`, to numbers in the netlist's unit, or to a frozen distribution of `scipy.stats`.
        Several paths with commas between them are scaled together: their numbers are factors on the circuit's values.
        A kind of named sets, such as ``finger`` or ``coating``, goes to the name of a set (`fs.parameters`), which is
        applied first, or to a list of names, which makes a dimension of the grid.
    n : int
        Number of draws, a power of two.
    seed : int
        Of the sequence's scrambling.
    store : Path or str, optional
        Folder of a Zarr store, into which the scenes go chunk by chunk; chunks that are there already are not run
        again. Its bytes do not depend on who has run which chunk.
    workers : int, optional
        With `store`: number of processes that run its chunks. A script starts them under
        ``if __name__ == "__main__"``.
    scheduler : str, optional
        With `store`: address of a Dask scheduler, whose workers see the same folder.
    shard : tuple of int
        With `store`: (i, m) runs the chunks i, i + m, i + 2 m, ..., for i from 1 to m.
    **options
        As of `batch`: `outputs`, `rtol`, `t_stop`, `periods`, `periodic`, `skin`, `points`, `threads`.

    Returns
    -------
    xarray.Dataset
        As of `batch`, with a dimension for each array, named by its path, and ``scene`` where something is drawn. With
        `store`, values are read when they are used, and `status` is 4 where a scene has not been run. The attribute
        `chunks` is the number of chunks of the shard, `chunks_found` how many of them were there already, and
        `chunks_missing` how many the whole store lacks; `failures` are those of this call.

    Raises
    ------
    InputError
        As `batch`, for an `n` that is no power of two, and for too many scenes. With `store`, if the folder is there
        and is no store of this sweep, or the scheduler does not answer.
    """
    circuit, parameters = with_sets(circuit, parameters)
    if store is not None:
        plan = make_plan(circuit, parameters, n, seed, MOST_STORED_SAMPLES)
        return stored(circuit, plan, options, Path(store), workers, scheduler, shard)
    if workers is not None or scheduler is not None or tuple(shard) != (1, 1):
        raise InputError(
            "workers, scheduler or shard is given without store; allowed: a folder such as 'out/sweep.zarr'"
        )
    from xarray import Dataset

    plan = make_plan(circuit, parameters, n, seed, MOST_SAMPLES)
    total = math.prod(plan.sizes)
    require(total <= MOST_SCENES, "the sweep", f"{total:,} scenes", f"at most {MOST_SCENES:,}, or a store")
    draws = plan.draws()
    found = batch(circuit, plan.spread(plan.grid, draws), **options)
    data = {
        name: ((*plan.dims, *one.dims[1:]), one.values.reshape((*plan.sizes, *one.shape[1:])), one.attrs)
        for name, one in found.data_vars.items()
    }
    coords: dict[str, Any] = plan.coordinates
    coords |= {name: ("scene", values, {"units": plan.units[name]}) for name, values in draws.items()}
    coords |= {name: one for name, one in found.coords.items() if name == "turn"}
    return Dataset(data, coords, found.attrs | plan.about(circuit))


def sobol(
    circuit: Circuit,
    parameters: Mapping[str, ArrayLike | Any],
    *,
    n: int = 1024,
    seed: int = 0,
    confidence: float = 0.95,
    **options: Any,
) -> Dataset:
    """Shares of a figure's variance that come from each random parameter: Sobol indices at every place of a grid.

    The index of first order is the share that the parameter causes alone, the total one that with all its interactions
    (Saltelli et al. 2010, as `scipy.stats.sobol_indices`). n (d + 2) scenes at each place of the grid, where d
    parameters are drawn.

    Parameters
    ----------
    circuit, parameters, n, seed, **options
        As of `sweep`; one parameter or more must be a distribution, and outputs are numbers, not ``u_gap``.
    confidence : float
        Probability of the intervals, which come from resampling the population.

    Returns
    -------
    xarray.Dataset
        With the dimensions of the grid and ``parameter``: for each output ``OUTPUT_first`` and ``OUTPUT_total``, each
        with its interval (``_low``, ``_high``); over the population ``OUTPUT_mean`` and ``OUTPUT_std``; and with the
        dimension ``quantile`` ``OUTPUT_alone``, where one parameter takes these quantiles of its distribution (their
        values are ``at``), and the others their medians.

    Raises
    ------
    InputError
        As `sweep`; if nothing is drawn; and if a scene has no result, because indices need all of them.
    """
    circuit, parameters = with_sets(circuit, parameters)
    plan = make_plan(circuit, parameters, n, seed, MOST_SAMPLES)
    require(bool(plan.drawn), "parameters", "all numbers", "one distribution or more, such as scipy.stats.norm(...)")
    confidence = real_number("confidence", confidence, "a number between 0 and 1")
    require(0.0 < confidence < 1.0, "confidence", confidence, "a number between 0 and 1")
    outputs = options.get("outputs", ("f_el_mean",))
    outputs = (outputs,) if isinstance(outputs, str) else tuple(outputs)
    require("u_gap" not in outputs, "outputs", "u_gap", "figures, which are one number for each scene")
    from xarray import Dataset

    # Every place of the grid: each of its parameters with one value, shape (1,).
    places = [dict(zip(plan.grid, np.reshape(values, (-1, 1)), strict=True)) for values in product(*plan.grid.values())]
    rows = [_indices(circuit, plan, place, outputs, confidence, options) for place in places]
    data: dict[str, Any] = {}
    for i, output in enumerate(outputs):
        for kind in rows[0]:
            each = np.array([row[kind][i] for row in rows])
            own = ("parameter", "quantile")[: each.ndim - 1]
            data[f"{output}_{kind}"] = ((*plan.grid, *own), each.reshape((*plan.sizes[:-1], *each.shape[1:])))
    coords = plan.coordinates | {"parameter": list(plan.drawn), "quantile": list(QUANTILES)}
    coords["unit"] = ("parameter", [plan.units[name] for name in plan.drawn])
    data["at"] = (("parameter", "quantile"), [law.ppf(QUANTILES) for law in plan.drawn.values()])
    return Dataset(data, coords, {"n": plan.n, "seed": plan.seed, "outputs": list(outputs)})


def _indices(
    circuit: Circuit, plan: Plan, place: dict[str, FloatArray], outputs: tuple[str, ...], confidence: float,
    options: Mapping[str, Any],
) -> dict[str, FloatArray]:  # fmt: skip
    """Indices (n_output, d), their intervals, and mean and standard deviation of the outputs, at one place."""
    from scipy.stats import qmc

    def figures(x: FloatArray) -> FloatArray:
        found = batch(circuit, plan.spread(place, dict(zip(plan.drawn, x, strict=True))), **options)
        if lost := int(np.count_nonzero(found.status >= REFUSED)):
            why = f" ({found.attrs['failures'][0]})" if len(found.attrs["failures"]) else ""
            raise InputError(
                f"{lost} of {found.sizes['scene']} scenes have no result{why}, and indices need all; allowed: "
                "distributions that stay where the circuit works"
            )
        values = np.array([found[name].values for name in outputs])
        require(values.ndim == 2, "outputs", "one for each of several gaps", "figures of a circuit with one GAP")
        return values

    # Two populations, and for each parameter the first one with that parameter of the second.
    d, laws = len(plan.drawn), list(plan.drawn.values())
    points = qmc.Sobol(2 * d, bits=64, rng=plan.seed).random(plan.n).T
    pair = np.array([law.ppf(x) for law, x in zip(laws * 2, points, strict=True)], float).reshape(2, d, plan.n)
    other = np.repeat(pair[:1], d, axis=0)
    other[np.arange(d), np.arange(d)] = pair[1]
    a, b = map(figures, pair)
    mixed = np.moveaxis(figures(np.moveaxis(other, 0, -1).reshape(d, -1)).reshape(len(outputs), plan.n, d), -1, 0)
    # Then each parameter by itself.
    alone = np.full((d, len(QUANTILES), d), 0.5)
    alone[np.arange(d), :, np.arange(d)] = QUANTILES
    x = np.array([law.ppf(alone[..., j].ravel()) for j, law in enumerate(laws)])
    picks = np.random.default_rng(plan.seed).integers(0, plan.n, (RESAMPLES, plan.n))
    drawn = np.array([_saltelli(a[:, pick], b[:, pick], mixed[..., pick]) for pick in picks])
    low, high = np.quantile(drawn, [0.5 - 0.5 * confidence, 0.5 + 0.5 * confidence], axis=0)
    both, (first, total) = np.concatenate([a, b], axis=1), _saltelli(a, b, mixed)
    return {
        "first": first, "first_low": low[0], "first_high": high[0],
        "total": total, "total_low": low[1], "total_high": high[1],
        "mean": both.mean(axis=1), "std": both.std(axis=1),
        "alone": figures(x).reshape(len(outputs), d, len(QUANTILES)),
    }  # fmt: skip


def _saltelli(a: FloatArray, b: FloatArray, mixed: FloatArray) -> FloatArray:
    """Indices of first order and total ones (Saltelli et al. 2010, rows b and f of its Table 2), (2, n_output, d)."""
    both = np.concatenate([a, b], axis=1)
    middle, variance = both.mean(axis=1, keepdims=True), both.var(axis=1)
    a, b, mixed = a - middle, b - middle, mixed - middle
    with np.errstate(divide="ignore", invalid="ignore"):
        first = np.mean(b * (mixed - a), axis=-1) / variance
        total = 0.5 * np.mean((a - mixed) ** 2, axis=-1) / variance
    # A figure that does not change has indices of 0.
    return np.asarray(np.nan_to_num(np.array([first.T, total.T]), nan=0.0, posinf=0.0, neginf=0.0), float)


def ranking(found: Dataset, output: str) -> list[dict[str, Any]]:
    """Which parameters the variance of an output of `sobol` comes from: rows, at each place the largest index first.

    A row has ``place`` (values on the grid), ``parameter``, ``first``, ``total``, ``low`` and ``high`` (of ``total``).
    """
    dims = [str(dim) for dim in found[f"{output}_total"].dims[:-1]]
    rows: list[dict[str, Any]] = []
    for index in np.ndindex(*(found.sizes[dim] for dim in dims)):
        one = found.isel(dict(zip(dims, index, strict=True)))
        first, total, low, high = (
            one[f"{output}_{kind}"].values for kind in ("first", "total", "total_low", "total_high")
        )
        place = {dim: one[dim].item() for dim in dims}
        rows += [
            {
                "place": place, "parameter": str(one.parameter.values[j]), "first": float(first[j]),
                "total": float(total[j]), "low": float(low[j]), "high": float(high[j]),
            }
            for j in np.argsort(-total, kind="stable")
        ]  # fmt: skip
    return rows


def summary(found: Dataset) -> list[dict[str, float | str]]:
    """Median, 5 and 95 percent and mean of every output of `sweep`, over all its scenes, as rows."""
    rows: list[dict[str, float | str]] = []
    for name, one in found.data_vars.items():
        if name in ("error", "status", "u_gap"):
            continue
        low, middle, high = np.nanquantile(one.values, [0.05, 0.5, 0.95]).tolist()
        unit = str(one.attrs.get("units", ""))
        mean = float(np.nanmean(one.values))
        rows.append({"output": str(name), "unit": unit, "p5": low, "median": middle, "p95": high, "mean": mean})
    return rows
