"""Grids and random populations of a circuit's parameters, and which of them a figure's variance comes from."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from functools import lru_cache
from itertools import product
from pathlib import Path
from threading import Lock
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from fingerspice import sets
from fingerspice.base.arrays import FloatArray, real_number, real_numbers, whole_number
from fingerspice.base.errors import InputError
from fingerspice.circuit.circuit import Circuit
from fingerspice.circuit.describe import own_path, require_circuit
from fingerspice.studies.batch.batch import REFUSED, batch
from fingerspice.waveforms.waveform import Waveform, refuse, require

if TYPE_CHECKING:
    from xarray import Dataset

# Bits of a Sobol point, and so the largest number of draws of all.
BITS = 30
# Largest number of scenes of a sweep, whose figures are kept in memory (some 100 bytes each), of a population, and of a
# population in a store.
MOST_SCENES, MOST_SAMPLES, MOST_STORED_SAMPLES = 1 << 26, 1 << 20, 1 << BITS
# Quantiles of one parameter at which its influence is shown, all others being at their medians.
QUANTILES = (0.05, 0.5, 0.95)
# Quantiles are taken no nearer to 0 and 1 than this, so that a distribution without bounds gives finite values.
_EDGE = 1e-12
_DRAWING = Lock()
# Resamples of the population for the intervals of the indices. (scipy's own cannot be given a seed.)
RESAMPLES = 499
_NUMBERS = "a number, an array of numbers, or a frozen distribution of scipy.stats such as norm(3.5e-6, 0.3e-6)"


class Plan:
    """Parameters of a circuit that make a grid, those that are drawn, and those that are one number, by name.

    Names are paths, several paths with commas, whose numbers are factors, or kinds of sets, whose numbers count them.
    """

    def __init__(self, circuit: Circuit, asked: Mapping[str, Any], n: int, seed: int, most: int) -> None:
        """Of what `sweep` is asked for as its `parameters`, with `most` draws or fewer."""
        require_circuit(circuit)
        good = isinstance(asked, Mapping) and bool(asked)
        require(good, "parameters", asked, "a mapping such as {'Xgap.d': [3e-6, 4e-6]}")
        self.n, self.seed = n, seed = whole_number("n", n, 0), whole_number("seed", seed, 0)
        self.count = n  # Draws of a part: a power of two
        self._points: Any = None  # The sequence that they come from
        power = most.bit_length() - 1
        require(1 < n <= most and n & (n - 1) == 0, "n", n, f"a power of two such as 1024, at most 2^{power}")
        # The paths of each name, with the value that its numbers are factors of, or the values of the sets, (n_set,)
        self.own: dict[str, Mapping[str, float | FloatArray]] = {}
        self.names: dict[str, tuple[str, ...]] = {}  # Of the sets that a name counts
        self.units: dict[str, str] = {}
        for kind in (kind for kind in sets.KINDS if kind in asked):
            if isinstance(asked[kind], str):
                circuit = _applied(circuit, kind, asked[kind])[0]
            else:
                circuit, self.names[kind], self.own[kind] = _together(circuit, kind, asked[kind])
        rest = [name for name in asked if name in self.names or name not in sets.KINDS]
        allowed = "a list of sets, an array or a distribution beside it"
        refuse(not rest, f"parameters is {dict(asked)!r}, and nothing varies; allowed: {allowed}")
        self.circuit = circuit  # With the values that named sets give to every scene
        self.grid, self.drawn, self.fixed = dict[str, FloatArray](), dict[str, Any](), dict[str, FloatArray]()
        known, taken = circuit.parameters, Counter[str]()
        for given in rest:
            value, name = asked[given], given
            if name in self.names:
                self.grid[name], paths = np.arange(len(self.names[name]), dtype=float), list(self.own[name])
            else:
                paths = [own_path(circuit, one.strip()) for one in str(given).split(",")]
                name, alone = ",".join(paths), len(paths) == 1
                self.own[name] = {path: 1.0 if alone else known[path].value for path in paths}
                self.units[name] = known[name].unit if alone else "1"
                if hasattr(value, "ppf"):
                    self.drawn[name] = value
                else:
                    array = real_numbers(name, value, _NUMBERS)
                    row = array.ndim < 2 and array.size > 0
                    require(row, name, f"of shape {array.shape}", "numbers in one row")
                    (self.grid if array.ndim else self.fixed)[name] = array
            taken.update(paths)
            if twice := [path for path, count in taken.items() if count > 1]:
                raise InputError(f"{twice[0]} is given twice, where sets that differ in it count; allowed: once")
        # Dimensions, and the number of scenes along each; of the grid's, for a Dataset, the numbers or the sets' names
        self.dims = *self.grid, *(("scene",) if self.drawn else ())
        self.sizes = *(values.size for values in self.grid.values()), *((n,) if self.drawn else ())
        of = {name: {"units": unit} for name, unit in self.units.items()}
        shown = {name: list(self.names.get(name, values)) for name, values in self.grid.items()}
        self.coordinates: dict[str, Any] = {name: (name, x, of.get(name)) for name, x in shown.items()}
        # Attributes of the sweep: its draws, and the named sets in it
        self.about = {"n": n, "seed": seed} if self.drawn else dict[str, Any]()
        self.about |= {"sets": list(circuit.sets)} if circuit.sets else {}

    def paths(self, values: Mapping[str, ArrayLike]) -> dict[str, FloatArray]:
        """Values of each path of these names."""
        found = {}
        for name, numbers in values.items():
            for path, of in self.own[name].items():
                x = np.asarray(numbers, float)
                found[path] = np.take(of, x.astype(int)) if name in self.names else np.asarray(of * x)
        return found

    def spread(self, grid: Mapping[str, FloatArray], draws: Mapping[str, FloatArray]) -> dict[str, FloatArray]:
        """Values of each path in all scenes of a part of the grid with a part of the draws, shape (n_scene,)."""
        count = next(iter(draws.values())).size if draws else 1
        *mesh, draw = (x.ravel() for x in np.meshgrid(*grid.values(), np.arange(count), indexing="ij"))
        drawn = {path: values[draw] for path, values in draws.items()}
        return self.paths(self.fixed | dict(zip(grid, mesh, strict=True)) | drawn)

    def quantiles(self, points: FloatArray) -> dict[str, FloatArray]:
        """Values of the drawn parameters at points of the unit cube, shape (n_point, n_drawn)."""
        points = np.clip(points, _EDGE, 1.0 - _EDGE)
        return {path: np.asarray(law.ppf(points[:, i]), float) for i, (path, law) in enumerate(self.drawn.items())}

    # Two chunks may run at once, and those after them mostly have the same draws.
    @lru_cache(2)  # noqa: B019
    def draws(self, number: int = 0) -> dict[str, FloatArray]:
        """Values of the drawn parameters in the part with this number, shape (count,) each."""
        from scipy.stats import qmc

        if not self.drawn:
            return {}
        start = number * self.count
        with _DRAWING:
            # A sequence goes forward only, and parts are mostly asked for one after the other.
            if self._points is None or self._points.num_generated > start:
                self._points = qmc.Sobol(len(self.drawn), scramble=True, bits=BITS, rng=self.seed)
            if ahead := start - self._points.num_generated:
                self._points.fast_forward(ahead)
            return self.quantiles(self._points.random(self.count))


def _together(circuit: Circuit, kind: str, names: Any) -> tuple[Circuit, tuple[str, ...], dict[str, FloatArray]]:
    """The circuit with the values in which several sets agree, the sets' names, and by path values that differ."""
    given = list(names) if isinstance(names, list | tuple | np.ndarray) else []
    good = bool(given) and all(isinstance(name, str) for name in given)
    require(good, kind, repr(names), "the name of a set of parameters, or a list of names")
    found = dict(_applied(circuit, kind, name)[1:] for name in given)
    require(len(found) == len(given), kind, f"{given!r}, where a set is named twice", "each once")
    waves = any(isinstance(value, Waveform) for one in found.values() for value in one.values())
    require(not waves, kind, f"{given!r}, whose sets replace the source", "one of them by itself, with arrays of "
            "numbers such as source.frequency beside it")  # fmt: skip
    own, paths = circuit.parameters, dict.fromkeys(path for one in found.values() for path in one)
    whole = {path: np.array([one.get(path, own[path].value) for one in found.values()], float) for path in paths}
    same = {path: float(each[0]) for path, each in whole.items() if np.all(each == each[0])}
    differ = {path: each for path, each in whole.items() if path not in same}
    return circuit.replace(same) if same else circuit, tuple(found), differ


def _applied(circuit: Circuit, kind: str, entry: str) -> tuple[Circuit, str, Mapping[str, Any]]:
    """The circuit with a set, the set's name as the sweep shows it, and the values that it gives by path."""
    to, _, name = (part.strip() for part in entry.rpartition("="))
    try:
        one = sets.parameters(name, kind)
        changed = one.apply(circuit, to or None)
    except InputError as error:
        raise InputError(f"{kind} {entry!r}: {error.message}") from None
    return changed, f"{to}={one.name}" if to else one.name, changed.sets[one.name]


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
    if store is not None:
        from fingerspice.studies.sweep.chunks import stored

        plan = Plan(circuit, parameters, n, seed, MOST_STORED_SAMPLES)
        return stored(plan, options, Path(store), workers, scheduler, shard)
    useless = workers is not None or scheduler is not None or tuple(shard) != (1, 1)
    refuse(useless, "workers, scheduler or shard is given without store; allowed: a folder such as 'out/sweep.zarr'")
    from xarray import Dataset

    plan = Plan(circuit, parameters, n, seed, MOST_SAMPLES)
    total = math.prod(plan.sizes)
    require(total <= MOST_SCENES, "the sweep", f"{total:,} scenes", f"at most {MOST_SCENES:,}, or a store")
    draws = plan.draws()
    found = batch(plan.circuit, plan.spread(plan.grid, draws), **options)
    data = {
        name: ((*plan.dims, *one.dims[1:]), one.values.reshape((*plan.sizes, *one.shape[1:])), one.attrs)
        for name, one in found.data_vars.items()
    }
    coords = plan.coordinates | {name: one for name, one in found.coords.items() if name == "turn"}
    coords |= {name: ("scene", values, {"units": plan.units[name]}) for name, values in draws.items()}
    return Dataset(data, coords, found.attrs | plan.about)


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
    plan = Plan(circuit, parameters, n, seed, MOST_SAMPLES)
    require(bool(plan.drawn), "parameters", "all numbers", "one distribution or more, such as scipy.stats.norm(...)")
    confidence = real_number("confidence", confidence, "a number between 0 and 1")
    require(0.0 < confidence < 1.0, "confidence", confidence, "a number between 0 and 1")
    outputs = options.get("outputs", ("f_el_mean",))
    outputs = (outputs,) if isinstance(outputs, str) else tuple(outputs)
    require("u_gap" not in outputs, "outputs", "u_gap", "figures, which are one number for each scene")
    from scipy.stats import qmc
    from xarray import Dataset

    # Two populations, for each parameter the first one with that parameter of the second, and each parameter by itself.
    d = len(plan.drawn)
    one, other = map(plan.quantiles, np.split(qmc.Sobol(2 * d, bits=64, rng=plan.seed).random(plan.n), 2, axis=1))
    middle, ends = (plan.quantiles(np.tile(x, (d, 1)).T) for x in ([0.5] * len(QUANTILES), QUANTILES))
    mixed = [{**base, name: to[name]} for base, to in ((one, other), (middle, ends)) for name in plan.drawn]
    draws = {name: np.concatenate([part[name] for part in (one, other, *mixed)]) for name in plan.drawn}
    rows: list[dict[str, FloatArray]] = []
    for values in product(*plan.grid.values()):
        # At every place of the grid each of its parameters has one value, shape (1,).
        place = dict(zip(plan.grid, np.reshape(values, (-1, 1)), strict=True))
        found = batch(plan.circuit, plan.spread(place, draws), **options)
        lost, told = int(np.count_nonzero(found.status >= REFUSED)), ", ".join(found.attrs["failures"][:1])
        said = f"{lost} of {found.sizes['scene']} scenes have no result ({told}), and indices need all"
        refuse(lost, f"{said}; allowed: distributions that stay where the circuit works")
        rows.append(_indices(plan, np.array([found[name].values for name in outputs]), confidence))
    data: dict[str, Any] = {}
    for i, output in enumerate(outputs):
        for kind in rows[0]:
            each = np.array([row[kind][i] for row in rows])
            own = ("parameter", "quantile")[: each.ndim - 1]
            data[f"{output}_{kind}"] = ((*plan.grid, *own), each.reshape((*plan.sizes[:-1], *each.shape[1:])))
    coords = plan.coordinates | {"parameter": list(plan.drawn), "quantile": list(QUANTILES)}
    coords["unit"] = ("parameter", [plan.units[name] for name in plan.drawn])
    data["at"] = (("parameter", "quantile"), list(ends.values()))
    return Dataset(data, coords, {"n": plan.n, "seed": plan.seed, "outputs": list(outputs)})


def _indices(plan: Plan, values: FloatArray, confidence: float) -> dict[str, FloatArray]:
    """Indices (n_output, d), their intervals, and mean and standard deviation, of outputs (n_output, n_scene)."""
    require(values.ndim == 2, "outputs", "one for each of several gaps", "figures of a circuit with one GAP")
    n, d, count = plan.n, len(plan.drawn), len(values)
    a, b, mixed, single = np.split(values, [n, 2 * n, (2 + d) * n], axis=1)
    mixed = np.moveaxis(mixed.reshape(count, d, n), 1, 0)
    picks = np.random.default_rng(plan.seed).integers(0, n, (RESAMPLES, n))
    drawn = np.array([_saltelli(a[:, pick], b[:, pick], mixed[..., pick]) for pick in picks])
    low, high = np.quantile(drawn, [0.5 - 0.5 * confidence, 0.5 + 0.5 * confidence], axis=0)
    both, (first, total) = np.concatenate([a, b], axis=1), _saltelli(a, b, mixed)
    return {
        "first": first, "first_low": low[0], "first_high": high[0],
        "total": total, "total_low": low[1], "total_high": high[1],
        "mean": both.mean(axis=1), "std": both.std(axis=1), "alone": single.reshape(count, d, len(QUANTILES)),
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
    kinds = {"first": "first", "total": "total", "low": "total_low", "high": "total_high"}
    rows: list[dict[str, Any]] = []
    for index in np.ndindex(*(found.sizes[dim] for dim in dims)):
        one = found.isel(dict(zip(dims, index, strict=True)))
        place = {dim: one[dim].item() for dim in dims}
        for j in np.argsort(-one[f"{output}_total"].values, kind="stable"):
            numbers = {key: float(one[f"{output}_{kind}"][j]) for key, kind in kinds.items()}
            rows.append({"place": place, "parameter": str(one.parameter.values[j]), **numbers})
    return rows


def summary(found: Dataset) -> list[dict[str, float | str]]:
    """Median, 5 and 95 percent and mean of every output of `sweep`, over all its scenes, as rows."""
    rows: list[dict[str, float | str]] = []
    for name, one in found.data_vars.items():
        if name not in ("error", "status", "u_gap"):
            low, middle, high = np.nanquantile(one.values, [0.05, 0.5, 0.95]).tolist()
            unit, mean = str(one.attrs.get("units", "")), float(np.nanmean(one.values))
            rows.append({"output": str(name), "unit": unit, "p5": low, "median": middle, "p95": high, "mean": mean})
    return rows
