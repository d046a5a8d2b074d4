"""One fit: measured columns, least squares in the logarithms of a circuit's parameters, and what is reported."""

from __future__ import annotations

import itertools
import math
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, ClassVar, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike

from fingerspice.base.arrays import FloatArray, real_numbers
from fingerspice.base.errors import FingerspiceWarning, InputError
from fingerspice.base.files import write_csv
from fingerspice.base.pages import Page, Shown, Table
from fingerspice.circuit.circuit import Circuit
from fingerspice.numerics.modes import AT, derivative
from fingerspice.plots import drawing
from fingerspice.results.outcome import SolveError
from fingerspice.waveforms.files import read_text_columns
from fingerspice.waveforms.waveform import refuse

#: One set of measured columns, or the path of a table.
Given = Mapping[str, ArrayLike] | str | Path
#: What a name in a header means, with all names of the header beside it: the column's key, the key of the column whose
#: unit it has (of a standard deviation that of the values, else its own), and this unit, or None where none is known.
Meaning = Callable[[str, Sequence[str]], tuple[str, str, str | None]]
SIGMA = "sigma"
PREFIXES = {"": 1.0, "k": 1e3, "M": 1e6, "m": 1e-3, "u": 1e-6, "µ": 1e-6, "μ": 1e-6, "n": 1e-9}


def measured_of(
    given: Given, meaning: Meaning, example: str, by: str | None = None, place: str = "the data"
) -> tuple[dict[str, FloatArray], str, dict[str, tuple[str, ...]]]:
    """The columns (n,) that a caller gave, in SI units or, of a circuit's parameters, in those of the netlist.

    With them, where they come from, as subject of a message, which is `place` where there is no table; and the name of
    every measurement's group, by the column `by` that tells it. `example` is a header.
    """
    if isinstance(given, (str, Path)):
        place, given = f"the data in '{Path(given)}'", _from_table(Path(given), meaning, example, by)
    if not isinstance(given, Mapping) or not all(isinstance(name, str) for name in given):
        raise InputError(f"data is a {type(given).__name__}; allowed: a mapping of columns, or the path of a table")
    refuse(not given, f"{place} have no columns; allowed: measured values and their conditions, such as {example}")
    missing = by is not None and by not in given
    refuse(missing, f"the data have no column {by!r}, which groups names; they have {', '.join(given)}")
    columns = {name: real_numbers(f"data column {name!r}", x, "numbers") for name, x in given.items() if name != by}
    size = max((x.size for x in columns.values()), default=0)
    refuse(bool(columns) and size == 0, "the data have no rows; allowed: one or more measurements")
    for name, x in columns.items():
        said = f"data column {name!r} has the shape {x.shape}, others have {size} rows"
        refuse(x.shape not in ((), (size,)), f"{said}; allowed: as many, or one number for all")
        bad = np.flatnonzero(~np.isfinite(x))
        if bad.size:
            raise InputError(f"data column {name!r} is {x.flat[bad[0]]} in row {bad[0]}; allowed: finite numbers")
        # A number stands for a column of it.
        columns[name] = np.broadcast_to(x, size).copy()
    if by is None:
        return columns, place, {}
    cells = np.asarray(given[by])
    told = f"data column {by!r} tells the group; allowed: a text or a number for every measurement"
    refuse(cells.ndim != 1 or cells.dtype.kind not in "iufU", told)
    refuse(cells.size != size, f"data column {by!r} has {cells.size} rows, others have {size}; allowed: as many")
    return columns, place, {by: tuple(x if isinstance(x, str) else f"{x:g}" for x in cells.tolist())}


def _from_table(path: Path, meaning: Meaning, example: str, by: str | None) -> dict[str, ArrayLike]:
    table = read_text_columns(path, by)
    refuse(not table.names, f"'{path}' has no header; allowed: names with units, such as {example}")
    found, units, of_share = dict[str, Any](), dict[str, str](), dict[str, str]()
    for i, (name, unit) in enumerate(zip(table.names, table.units, strict=True)):
        if by is not None and name.lower() == by.lower():
            found[by] = [table.words[int(number)] for number in table.numbers(i)]
            continue
        key, values, base = meaning(name, table.names)
        refuse(key in found, f"'{path}' has two columns {name!r}; allowed: one")
        if key != values and unit == "%":
            of_share[key], base = values, ""
        # The prefix of an area is squared with its unit.
        known = {"": 1.0, "mm2": 1e-6, "mm²": 1e-6} if (squared := base == "m^2") else {"": 1.0}
        known |= {f"{x}{base}": size ** (1 + squared) for x, size in PREFIXES.items()} if base else {"%": 0.01}
        allowed = f"{base}, with k, m, u or n before it where need be" if base else "none"
        wrong = base is not None and unit not in known
        refuse(wrong, f"'{path}': the unit of column {name!r} is {unit!r}; allowed: {allowed}")
        found[key], units[key] = table.numbers(i) * (1.0 if base is None else known[unit]), unit
    for key, values in of_share.items():
        # Beside values in % (a friction coefficient), a standard deviation in % is of their unit, and no share of them.
        if units.get(values, "%") != "%":
            found[key] = found[key] * np.abs(found[values])
    return found


#: What data that cannot be predicted are off by, over their scale; an objective from the latter on is of such data.
REFUSED, NOT_FOUND = 1e6, 0.5e12
# Error of the least squares' last step, relative; and the largest number of evaluations, and of refused ones.
_CLOSE, _MOST, _MOST_REFUSALS = 1e-8, 40, 6
# Step of the differences in a parameter's logarithm, at which those of fourth order are exact to rounding.
_STEP = 1e-3
#: A profile is followed up to this factor where no bounds are, as is a search whose runs would be slow farther away.
FARTHEST = 1e3
# Singular values of the derivatives below this share of the largest are rounding; residuals this unlikely by noise of
# the given sigma are named.
_LEAST, _UNLIKELY = 1e-9, 1e-3


@dataclass(frozen=True)
class Problem:
    """What is fitted; its classes compare what the circuit predicts with the data."""

    circuit: Circuit  # With the values to start from
    names: tuple[str, ...]  # What is fitted: paths, with the group in brackets where a parameter has a value in each
    paths: tuple[str, ...]  # The path of each
    scale: FloatArray  # (n,): By which residuals are divided
    #: (n_parameter, 2): Smallest and largest values, 0 and infinity by default; made by `begun`
    bounds: FloatArray = field(default_factory=lambda: np.empty((0, 2)), kw_only=True)
    profiles: tuple[str, ...] = field(default=(), kw_only=True)  # Names whose profiles are wanted; made by `begun`
    reach: ClassVar[float] = math.inf  # A parameter is looked for up to this factor from its start without bounds

    @property
    def initial(self) -> FloatArray:
        """Values to start from."""
        return np.array([self.circuit.parameters[path].value for path in self.paths])

    @property
    def box(self) -> FloatArray:
        """The bounds within which is searched, shape (n_parameter, 2): `reach` from the start where none are given."""
        (low, high), near, far = self.bounds.T, self.initial / self.reach, self.initial * self.reach
        return np.column_stack([np.where(low > 0.0, low, near), np.where(high < math.inf, high, far)])

    def misses(self, values: FloatArray) -> FloatArray:
        """Residuals over their scale, shape (n,)."""
        raise NotImplementedError

    def remedy(self, names: tuple[str, ...]) -> str:
        """What would tell one parameter, or two apart."""
        raise NotImplementedError

    def compared(self, values: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Residuals over their scale (n,), and their derivatives by the logarithms of the values (n, n_parameter)."""
        ways = np.exp(_STEP * np.multiply.outer(AT, np.eye(values.size)))
        by = [derivative([self.misses(values * one) for one in way], _STEP) for way in ways.swapaxes(0, 1)]
        return self.misses(values), np.array(by).T

    def residuals(self, values: FloatArray) -> tuple[FloatArray, FloatArray]:
        """As `compared`; `REFUSED` for all where the circuit with these values cannot be run."""
        try:
            # Of values that no user has written.
            with warnings.catch_warnings(action="ignore", category=FingerspiceWarning):
                return self.compared(values)
        except (InputError, SolveError):
            return np.full(self.scale.size, REFUSED), np.zeros((self.scale.size, values.size))

    def begun(self, bounds: Mapping[str, tuple[float, float]], profiles: bool | Sequence[str]) -> Self:
        """With bounds and profiles as given, and a start moved into the bounds."""
        n, count, circuit, box = self.scale.size, len(self.paths), self.circuit, []
        refuse(n < count, f"{n} data cannot tell {count} parameters; allowed: at least as many data")
        given, own = {path.lower(): tuple(pair) for path, pair in bounds.items()}, {*map(str.lower, self.paths)}
        for path in bounds:
            said = f"bounds names {path}, which is not fitted; allowed: {', '.join(self.paths)}"
            refuse(path.lower() not in own, said)
        for path in self.paths:
            pair = given.get(path.lower(), (0.0, math.inf))
            wrong = len(pair) != 2 or not 0.0 <= pair[0] < pair[1]
            refuse(wrong, f"bounds of {path} are {pair}; allowed: two values with 0 <= low < high")
            value = circuit.parameters[path].value
            moved = min(max(value, pair[0]), pair[1])
            if moved != value:
                said = f"{path} is {value:g}, outside its bounds {pair[0]:g} to {pair[1]:g}: it starts at {moved:g}"
                warnings.warn(said, FingerspiceWarning, stacklevel=3)
                circuit = circuit.varied({path: moved})
            box.append(pair)
        names = {name.lower(): name for name in self.names}
        wanted = ([*names] if profiles else []) if isinstance(profiles, bool) else profiles
        for name in wanted:
            said = f"profiles names {name!r}, which is not fitted; allowed: True, or {', '.join(self.names)}"
            refuse(not isinstance(name, str) or name.lower() not in names, said)
        asked = tuple(names[name.lower()] for name in wanted)
        return replace(self, circuit=circuit, bounds=np.array(box, float), profiles=asked)


class Fitted(NamedTuple):
    """Where least squares have led."""

    values: FloatArray  # (n_parameter,)
    residual: FloatArray  # (n,): Over their scale
    by_log: FloatArray  # (n, n_parameter): Their derivatives by the logarithms of the values
    objective: float  # Sum of their squares
    evaluations: int
    closed: bool

    @property
    def covariance(self) -> FloatArray:
        """Covariance of the logarithms of the parameters, for residuals of variance 1."""
        # What no datum feels has a large variance, and not an infinite one, of which no correlation would be known.
        _, singular, right = np.linalg.svd(self.by_log, full_matrices=False)
        spread = 1.0 / np.maximum(singular, _LEAST * max(float(singular.max()), 1e-300))
        return np.asarray((right.T * spread**2) @ right)

    def beyond_sigma(self, at: Any, freedom: int, of: str = "") -> list[str]:
        """A sentence about residuals, at some places of them, that are far larger than their given sigma, else none."""
        from scipy.stats import chi2

        square = float(np.sum(self.residual[at] ** 2))
        if freedom < 1 or chi2.sf(square, freedom) > _UNLIKELY:
            return []
        said = f"The residuals{of} are {math.sqrt(square / freedom):.2g} times as large as sigma, which noise explains "
        said += "in less than one of a thousand cases: the circuit does not describe these data, or sigma is too small"
        return [f"{said}, and so are the intervals."]


def followed(
    residuals: Callable[[FloatArray], tuple[FloatArray, FloatArray]], bounds: FloatArray, begin: FloatArray,
    close: float = _CLOSE,
) -> Fitted:  # fmt: skip
    """Where least squares lead from a start; `close` is the relative error of the last step."""
    from scipy.optimize import least_squares

    refused: list[tuple[FloatArray, FloatArray]] = []

    @lru_cache(maxsize=1)
    def known(x: bytes) -> tuple[FloatArray, FloatArray]:
        # At the edge of what can be run, all further steps are refused without a run, so that the search ends.
        tried = residuals(unit * np.exp(np.frombuffer(x))) if len(refused) < _MOST_REFUSALS else refused[-1]
        if np.all(tried[0] == REFUSED):
            refused.append(tried)
        return tried

    # The first step is at most as long as the place it starts from: by a factor of e, not by that of the unit.
    begin = np.clip(begin, *bounds.T)
    x0 = np.full(begin.size, begin.size**-0.5)
    unit = begin / np.exp(x0)
    with np.errstate(divide="ignore"):
        box = np.log(bounds / unit[:, None]).T
    found = least_squares(
        lambda x: known(x.tobytes())[0], np.clip(x0, *box), lambda x: known(x.tobytes())[1], bounds=box, xtol=close,
        ftol=close**1.5, gtol=1e-12, max_nfev=_MOST,
    )  # fmt: skip
    ended, values = len(refused) < _MOST_REFUSALS, unit * np.exp(found.x)
    residual, by = known(found.x.tobytes()) if ended else residuals(values)
    return Fitted(values, residual, by, float(residual @ residual), int(found.nfev), found.status > 0 and ended)


# Two parameters are not told apart if their errors are correlated beyond this and one of them is larger than that; and
# the error of a parameter, in its logarithm, from which on nothing is known of it; the least correlation in a report.
_TOGETHER, _NOTABLE, _UNKNOWN, _TOLD = 0.98, 0.05, 0.7, 0.1
# A value this close to a bound, relative, is at it; an interval that reaches farther, in the logarithm, has no ends.
_AT_BOUND, _NO_END = 1e-6, 50.0
# Of profiles: growth of the distance from the value, in its logarithm, and error of an interval's end over that
# distance; error of the other parameters on the way; ratio of the interval's parts from which on it is called skewed.
_GROWTH, _END, _ROUGHLY, _SKEWED = 1.6, 0.01, 1e-4, 1.2


@dataclass(frozen=True)
class Estimate:
    """One fitted parameter, in the unit of the netlist."""

    path: str
    unit: str
    value: float
    initial: float
    error: float  # Standard error
    low: float  # Of the 95 % interval, which is symmetric in the logarithm
    high: float
    at_bound: bool


@dataclass(frozen=True)
class Profile:
    """The best fits with one parameter held at each of several values."""

    path: str
    values: FloatArray  # (n,): Values of the parameter, ascending
    objective: FloatArray  # (n,): Sum of the squared residuals at each, as `Fit.objective`
    limit: float  # The objective at the ends of the 95 % interval
    low: float  # Of the interval; 0 or a bound where the data set no end
    high: float  # Of the interval; infinity or a bound where the data set no end
    shape: str  # "symmetric" (in the logarithm), "skewed", "open below", "open above" or "open"


@dataclass(frozen=True, repr=False, kw_only=True)
class FitResult(Shown):
    """What results of fits have in common; `Fit` says what its attributes are."""

    circuit: Circuit
    estimates: dict[str, Estimate]
    correlation: FloatArray
    objective: float
    count: int
    freedom: int
    evaluations: int
    closed: bool
    notes: tuple[str, ...]
    profiles: dict[str, Profile]

    @classmethod
    def _reported(cls, task: Problem, best: Fitted, variance: Any, half: Any, more: Sequence[str], **own: Any) -> Self:
        """What the best fit tells, with further notes (`more`) and what is a kind's `own`.

        `variance` is that of the residuals over their scale, and `half` half an interval over a standard error of the
        logarithm, for all parameters or each.
        """
        covariance, values, known = best.covariance, best.values, task.circuit.parameters
        spread = np.sqrt(np.diag(covariance))
        correlation, error = covariance / np.outer(spread, spread), np.sqrt(np.diag(covariance) * variance)
        reach = half * error
        ratio = np.where(reach < _NO_END, np.exp(np.minimum(reach, _NO_END)), math.inf)
        with np.errstate(divide="ignore"):
            at_bound = np.any(np.abs(values[:, None] / task.box - 1.0) < _AT_BOUND, axis=1)
        columns = values, task.initial, values * error, values / ratio, values * ratio, at_bound
        units = (known[path].unit for path in task.paths)
        rows = zip(task.names, units, *(x.tolist() for x in columns), strict=True)
        estimates = {row[0]: Estimate(*row) for row in rows}
        # Of chi squared and F with one degree of freedom, quantiles are the squares of those of the normal distribution
        # and of Student's (Bates and Watts, Nonlinear regression analysis, 1988, section 6.1).
        rooms = dict(zip(task.names, np.broadcast_to(variance * half**2, spread.shape).tolist(), strict=True))
        off = dict(zip(task.names, error.tolist(), strict=True))
        bound = (f"{e.path} is at its bound, {e.value:g} {e.unit}".rstrip() for e in estimates.values() if e.at_bound)
        notes = [f"{said}: its interval is not that of a free parameter." for said in bound]
        for a, b, both in _pairs(estimates, correlation, _TOGETHER):
            if max(off[a], off[b]) > _NOTABLE:
                said = f"{a} and {b} are not told apart (correlation {both:+.4f}): they change these data in almost"
                notes.append(f"{said} the same way, and only a combination of both is known. {task.remedy((a, b))}")
        named = " ".join(notes)
        for name in task.names:
            if not off[name] < _UNKNOWN and name not in named:
                said = f"Of {name} these data tell next to nothing: its error is larger than itself."
                notes.append(f"{said} {task.remedy((name,))}")
        return cls(
            estimates=estimates, correlation=correlation, objective=best.objective, count=best.residual.size,
            evaluations=best.evaluations, closed=best.closed, notes=(*notes, *more),
            profiles={name: _profile_of(task, best, estimates[name], rooms[name]) for name in task.profiles}, **own,
        )  # fmt: skip

    def _panels(self) -> list[Any]:
        raise NotImplementedError

    @staticmethod
    def _panel(
        under: Sequence[tuple[str, str, Any]], keys: Sequence[Sequence[str]], shown: str, unit: str, *columns: Any
    ) -> Any:
        """A panel of `plot_panels`: of the conditions that which changed most is the axis, and the rest name curves."""
        (label, axis, x), *others = sorted(under, key=lambda one: -np.unique(one[2]).size)
        varying = [one for one in others if np.ptp(one[2]) > 0.0]
        rest = [[f"{name} = {y:g} {of}".rstrip() for y in values] for name, of, values in varying]
        curves = list(map(", ".join, zip(*keys, *rest, strict=True))) or [shown] * x.size
        return curves, (x, *columns), f"{label} [{axis}]" if axis else label, shown, unit

    def _columns(self) -> dict[str, Any]:
        """Columns of the table, by their heads."""
        raise NotImplementedError

    def plot(self) -> drawing.Picture:
        """Data and fit, of contacts of every relation, with the residuals below."""
        from fingerspice.plots.picture import plot_panels

        return plot_panels(self._panels())

    def to_csv(self, path: str | Path) -> Path:
        """Write conditions (in units of the netlist; of a contact in SI units), data, prediction and sigma as CSV."""
        columns = self._columns()
        return write_csv(path, columns, zip(*columns.values(), strict=True))

    def _paged(self, head: str, about: Sequence[str], *end: str) -> Page:
        """A page of what was fitted to what (`head`), the residuals (`about`), and everything else."""
        rows = [
            (
                e.path, f"{e.value:.6g}", f"{e.error:.2g}", f"{100.0 * e.error / e.value:.2g} %",
                f"{e.low:.4g} to {e.high:.4g}", e.unit, f"{e.initial:.4g}", "at a bound" if e.at_bound else "",
            )
            for e in self.estimates.values()
        ]  # fmt: skip
        table = Table(("parameter", "value", "error", "", "95 % interval", "unit", "started at", ""), rows)
        effort = f"{self.evaluations} evaluations{'' if self.closed else ', the iteration did not close'}"
        lines: list[str | Table] = [f"{head}, {effort}", *about, "", table]
        if pairs := [f"{a}, {b}: {both:+.3f}" for a, b, both in _pairs(self.estimates, self.correlation, _TOLD)]:
            lines += ["", "correlations beyond 0.1: " + "; ".join(pairs)]
        for one in self.profiles.values():
            ends = f"{one.low:.4g} to {one.high:.4g} {self.estimates[one.path].unit}, {one.shape}"
            lines.append(f"profile of {one.path}: {ends}".replace(" ,", ","))
        return Page([*lines, *(["", *self.notes] if self.notes else []), *end])

    def report(self) -> str:
        """Statistics, parameters and correlations in the layout of lmfit's ``fit_report``.

        As there, the criteria of Akaike and Bayes are n log(chi-square / n) + 2 k, and + k log(n), of n data.
        """
        estimates, square, count, k = self.estimates, self.objective, self.count, len(self.estimates)
        level = count * math.log(max(square, 1e-300) / count)
        wide = max(map(len, estimates)) + 1
        figures = {
            "# fitting method": "least_squares", "# function evals": self.evaluations, "# data points": count,
            "# variables": k, "chi-square": f"{square:.8g}",
            "reduced chi-square": f"{square / (count - k) if count > k else math.inf:.8g}",
            "Akaike info crit": f"{level + 2.0 * k:.8g}", "Bayesian info crit": f"{level + k * math.log(count):.8g}",
        }  # fmt: skip
        lines = ["[[Fit Statistics]]", *(f"    {name:<18} = {x}" for name, x in figures.items()), "[[Variables]]"]
        for name, e in estimates.items():
            share = f"({100.0 * e.error / e.value:.2f}%) (init = {e.initial:.7g})"
            lines.append(f"    {name + ':':<{wide}} {e.value: .8g} +/- {e.error:.8g} {share}")
        if pairs := sorted(_pairs(estimates, self.correlation, _TOLD), key=lambda pair: -abs(pair[2])):
            lines.append("[[Correlations]] (unreported correlations are < 0.100)")
        return "\n".join([*lines, *(f"    C({a}, {b}) = {both:+.4f}" for a, b, both in pairs)])

    def to_dict(self) -> dict[str, Any]:
        """The fit as plain numbers and texts; `parameters` has a row for each."""
        return {
            "parameters": [vars(e) for e in self.estimates.values()], "correlation": self.correlation.tolist(),
            "objective": self.objective, "notes": list(self.notes),
            "profiles": [{key: np.asarray(x).tolist() for key, x in vars(p).items()} for p in self.profiles.values()],
        }  # fmt: skip


def _pairs(names: Iterable[str], correlation: FloatArray, least: float) -> list[tuple[str, str, float]]:
    """Every two parameters whose errors are correlated by this or more, and their correlation."""
    named = itertools.combinations(enumerate(names), 2)
    return [(a, b, both) for (i, a), (j, b) in named if abs(both := float(correlation[i, j])) >= least]


def _profile_of(task: Problem, best: Fitted, one: Estimate, room: float) -> Profile:
    """The profile of a parameter; in its interval the objective is at most by `room` worse than the best."""
    from scipy.optimize import brentq

    place, limit = task.names.index(one.path), best.objective + room
    here, error = math.log(best.values[place]), one.error / one.value
    # The least objectives that were looked for, by the parameter's logarithm, and the others' values at the last.
    known, begin = {here: best.objective}, np.delete(best.values, place)

    def look(x: float) -> float:
        nonlocal begin

        def held(others: FloatArray) -> tuple[FloatArray, FloatArray]:
            residual, by = task.residuals(np.insert(others, place, math.exp(x)))
            return residual, np.delete(by, place, axis=1)

        if x not in known and begin.size:
            # From where the last value was fitted, which lies on the way.
            found = followed(held, np.delete(task.bounds, place, axis=0), begin, _ROUGHLY)
            known[x], begin = found.objective, found.values
        elif x not in known:
            residual, _ = held(begin)
            known[x] = float(residual @ residual)
        return known[x]

    def beyond(far: float, sign: int) -> float:
        # About linear in the distance, as the objective is about a parabola.
        return math.sqrt(max(look(here + sign * far) - best.objective, 0.0)) - math.sqrt(limit - best.objective)

    ends, opened = [], []
    for sign, word, bound in zip((-1, 1), (" below", " above"), task.bounds[place].tolist(), strict=True):
        begin = np.delete(best.values, place)
        with np.errstate(divide="ignore"):
            farthest = min(math.log(FARTHEST), abs(float(np.log(bound)) - here))
        near, far = 0.0, min(max(1.5 * error, 1e-6), 0.5, farthest)
        while look(here + sign * far) <= limit and far < farthest:
            near, far = far, min(_GROWTH * far, farthest)
        if look(here + sign * far) <= limit:
            opened.append(word)
            ends.append(bound)
        else:
            away = brentq(beyond, near, far, args=(sign,), xtol=_END * far, rtol=1e-6)
            ends.append(math.exp(here + sign * away))
    low, high = ends
    shape = "open" + ("" if len(opened) == 2 else "".join(opened))
    if not opened:
        reach = here - math.log(low), math.log(high) - here
        shape = "skewed" if max(reach) > _SKEWED * min(reach) else "symmetric"
    at = sorted(known)
    return Profile(one.path, np.exp(at), np.array([known[x] for x in at]), limit, low, high, shape)
