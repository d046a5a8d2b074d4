"""What a sweep runs: parameters that make a grid, parameters that are drawn, the draws, and named sets."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fingerspice.base.arrays import FloatArray, real_numbers, whole_number
from fingerspice.base.errors import InputError
from fingerspice.circuit.circuit import Circuit
from fingerspice.circuit.describe import require_circuit
from fingerspice.sets.parameters import KINDS, parameters
from fingerspice.studies.batch.form import own_path
from fingerspice.waveforms.waveform import Waveform, require


@dataclass(frozen=True)
class SetTable:
    """Several sets: their names, and by path the values in which they differ, shape (n_set,)."""

    names: tuple[str, ...]
    columns: Mapping[str, FloatArray]


def with_sets(circuit: Circuit, asked: Mapping[str, Any]) -> tuple[Circuit, dict[str, Any]]:
    """The circuit with all values that sets give to every scene, and what else is asked for.

    `asked` is as `parameters` of `sweep`: under a kind of sets, such as ``finger``, stands the name of a set (or
    ELEMENT=NAME), or a list of these, which becomes a `SetTable`.
    """
    if not isinstance(asked, Mapping):
        return circuit, asked
    rest = dict(asked)
    for kind in (kind for kind in KINDS if kind in asked):
        if isinstance(asked[kind], str):
            circuit = _applied(circuit, kind, rest.pop(kind))[0]
        else:
            circuit, rest[kind] = _together(circuit, kind, asked[kind])
    if asked and not rest:
        raise InputError(
            f"parameters is {dict(asked)!r}, and nothing varies; allowed: a list of sets, an array or a distribution "
            "beside it"
        )
    return circuit, rest


def _together(circuit: Circuit, kind: str, names: Any) -> tuple[Circuit, SetTable]:
    """The circuit with the values in which several sets agree, and those in which they differ."""
    given = list(names) if isinstance(names, list | tuple | np.ndarray) else []
    if not given or not all(isinstance(name, str) for name in given):
        raise InputError(f"{kind} is {names!r}; allowed: the name of a set of parameters, or a list of names")
    found = dict(_applied(circuit, kind, name)[1:] for name in given)
    if len(found) < len(given):
        raise InputError(f"{kind} is {given!r}, where a set is named twice; allowed: each once")
    if any(isinstance(value, Waveform) for one in found.values() for value in one.values()):
        raise InputError(
            f"{kind} is {given!r}, whose sets replace the source; allowed: one of them by itself, with arrays of "
            "numbers such as source.frequency beside it"
        )
    own = circuit.parameters
    paths = dict.fromkeys(path for one in found.values() for path in one)
    columns = {path: np.array([one.get(path, own[path].value) for one in found.values()], float) for path in paths}
    same = {path: float(each[0]) for path, each in columns.items() if (each == each[0]).all()}
    differ = {path: each for path, each in columns.items() if path not in same}
    return circuit.replace(same) if same else circuit, SetTable(tuple(found), differ)


def _applied(circuit: Circuit, kind: str, entry: str) -> tuple[Circuit, str, Mapping[str, Any]]:
    """The circuit with a set, the set's name as the sweep shows it, and the values that it gives by path."""
    to, _, name = (part.strip() for part in entry.rpartition("="))
    try:
        one = parameters(name, kind)
        changed = one.apply(circuit, to or None)
    except InputError as error:
        raise InputError(f"{kind} {entry!r}: {error.message}") from None
    return changed, f"{to}={one.name}" if to else one.name, changed.sets[one.name]


# Bits of a Sobol point, and so the largest number of draws of all.
BITS = 30
# Quantiles are taken no nearer to 0 and 1 than this, so that a distribution without bounds gives finite values.
_EDGE = 1e-12


@dataclass(frozen=True)
class Plan:
    """Parameters that make a grid, those that are drawn (`n` draws by `seed`), and those that are one number.

    Names are paths, or several paths with commas, whose numbers are factors; `own` has the paths of each and the values
    that the factors are of. A kind of named sets, such as ``finger``, is a name as well, whose numbers count the sets:
    `own` has the values of each path in all sets, and `names` those of the sets.
    """

    grid: dict[str, FloatArray]
    drawn: dict[str, Any]
    fixed: dict[str, FloatArray]
    own: dict[str, Mapping[str, float | FloatArray]]
    units: dict[str, str]
    n: int
    seed: int
    names: dict[str, tuple[str, ...]]

    @property
    def dims(self) -> tuple[str, ...]:
        """Dimensions of the sweep."""
        return (*self.grid, *(("scene",) if self.drawn else ()))

    @property
    def sizes(self) -> tuple[int, ...]:
        """Number of scenes along each dimension."""
        return (*(values.size for values in self.grid.values()), *((self.n,) if self.drawn else ()))

    def paths(self, values: Mapping[str, ArrayLike]) -> dict[str, FloatArray]:
        """Values of each path of these names."""
        found = {}
        for name, numbers in values.items():
            for path, of in self.own[name].items():
                x = np.asarray(numbers, float)
                found[path] = np.take(of, x.astype(int)) if name in self.names else np.asarray(of * x)
        return found

    def about(self, circuit: Circuit) -> dict[str, Any]:
        """Attributes of a sweep of the circuit: its draws, and the named sets in it."""
        drawn = {"n": self.n, "seed": self.seed} if self.drawn else {}
        return drawn | ({"sets": list(circuit.sets)} if circuit.sets else {})

    @property
    def coordinates(self) -> dict[str, Any]:
        """Of each dimension of the grid its numbers, or the names of its sets, for a Dataset."""
        return {
            name: (name, list(self.names[name])) if name in self.names
            else (name, values, {"units": self.units[name]})
            for name, values in self.grid.items()
        }  # fmt: skip

    def spread(self, grid: Mapping[str, FloatArray], draws: Mapping[str, FloatArray]) -> dict[str, FloatArray]:
        """Values of each path in all scenes of a part of the grid with a part of the draws, shape (n_scene,)."""
        count = next(iter(draws.values())).size if draws else 1
        mesh = np.meshgrid(*grid.values(), indexing="ij")
        places = mesh[0].size if mesh else 1
        flat = {path: np.repeat(values.ravel(), count) for path, values in zip(grid, mesh, strict=True)}
        return self.paths(self.fixed | flat | {path: np.tile(values, places) for path, values in draws.items()})

    def quantiles(self, points: FloatArray) -> dict[str, FloatArray]:
        """Values of the drawn parameters at points of the unit cube, shape (n_point, n_drawn)."""
        points = np.clip(points, _EDGE, 1.0 - _EDGE)
        return {path: np.asarray(law.ppf(points[:, i]), float) for i, (path, law) in enumerate(self.drawn.items())}

    def draws(self) -> dict[str, FloatArray]:
        """All values of the drawn parameters, shape (n,) each."""
        return self.quantiles(self.engine().random(self.n)) if self.drawn else {}

    def engine(self) -> Any:
        """The sequence of points of the unit cube, from its beginning."""
        from scipy.stats import qmc

        return qmc.Sobol(len(self.drawn), scramble=True, bits=BITS, rng=self.seed)

    def sequence(self, count: int) -> Sequence:
        """The draws, to be had in parts of `count` (a power of two, at most `n`)."""
        engine, steps, at = self.engine(), [], count
        first = _bits(engine.random(1))[0]
        while at < self.n:
            engine.fast_forward(at - engine.num_generated)
            steps.append(_bits(engine.random(1))[0] ^ first)
            at *= 2
        return Sequence(self, count, steps)


@dataclass(frozen=True, eq=False)
class Sequence:
    """The draws of a plan in parts of `count`, each of which costs the same.

    The bits of a Sobol point are a linear function of those of its index: point i + j, of two indices without a common
    bit, is the sum (exclusive or) of points i, j and 0.
    """

    plan: Plan
    count: int
    steps: list[NDArray[np.int64]]  # Sums of point 0 and the points `count`, 2 `count`, ..., (n_drawn,) each

    @cached_property
    def _first(self) -> NDArray[np.int64]:
        """Bits of the first part, shape (count, n_drawn): a process that is sent a sequence makes them once."""
        return _bits(self.plan.engine().random(self.count))

    # Two chunks may run at once, and those after them mostly have the same draws.
    @lru_cache(2)  # noqa: B019
    def part(self, number: int) -> dict[str, FloatArray]:
        """Values of the drawn parameters in the part with this number, shape (count,) each."""
        bits = self._first
        for i, step in enumerate(self.steps):
            if number >> i & 1:
                bits = bits ^ step
        return self.plan.quantiles(np.asarray(bits * 2.0**-BITS, float))


def _bits(points: FloatArray) -> NDArray[np.int64]:
    return np.asarray(points * 2.0**BITS, np.int64)


def make_plan(circuit: Circuit, parameters: Mapping[str, Any], n: int, seed: int, most: int) -> Plan:
    """The plan of checked arguments of `sweep`, with `most` draws or fewer."""
    require_circuit(circuit)
    if not isinstance(parameters, Mapping) or not parameters:
        raise InputError(f"parameters is {parameters!r}; allowed: a mapping such as {{'Xgap.d': [3e-6, 4e-6]}}")
    n, seed = whole_number("n", n, 0), whole_number("seed", seed, 0)
    power = most.bit_length() - 1
    require(1 < n <= most and n & (n - 1) == 0, "n", n, f"a power of two such as 1024, at most 2^{power}")
    plan, taken = Plan({}, {}, {}, {}, {}, n, seed, {}), Counter[str]()
    for given, value in parameters.items():
        held = isinstance(value, SetTable)
        paths = list(value.columns) if held else [own_path(circuit, one.strip()) for one in str(given).split(",")]
        taken.update(paths)
        if twice := [path for path, count in taken.items() if count > 1]:
            raise InputError(f"{twice[0]} is given twice, where sets that differ in it count; allowed: once")
        if held:
            plan.names[given], plan.own[given] = value.names, value.columns
            plan.grid[given] = np.arange(len(value.names), dtype=float)
            continue
        path, alone = ",".join(paths), len(paths) == 1
        plan.own[path] = {one: 1.0 if alone else circuit.parameters[one].value for one in paths}
        plan.units[path] = circuit.parameters[path].unit if alone else "1"
        if hasattr(value, "ppf"):
            plan.drawn[path] = value
            continue
        allowed = "a number, an array of numbers, or a frozen distribution of scipy.stats such as norm(3.5e-6, 0.3e-6)"
        array = real_numbers(path, value, allowed)
        require(array.ndim < 2 and array.size > 0, path, f"of shape {array.shape}", "numbers in one row")
        (plan.grid if array.ndim else plan.fixed)[path] = array
    return plan
