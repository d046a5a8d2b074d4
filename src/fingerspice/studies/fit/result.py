"""Least squares in the logarithms of a circuit's parameters: their bounds, and the way from a start.

What every fit reports: parameters with intervals, correlations, profiles, and what the data cannot tell.
"""

from __future__ import annotations

import itertools
import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from fingerspice.base.arrays import FloatArray
from fingerspice.base.errors import FingerspiceWarning, InputError
from fingerspice.base.files import write_csv
from fingerspice.base.pages import Page, Shown, Table
from fingerspice.circuit.circuit import Circuit
from fingerspice.numerics.modes import AT, derivative
from fingerspice.results.outcome import SolveError

if TYPE_CHECKING:
    from fingerspice.plots.picture import Drawn, Picture

#: What data that cannot be predicted are off by, over their scale.
REFUSED = 1e6
# Error of the least squares' last step, relative; and the largest number of evaluations, and of refused ones.
_CLOSE, _MOST, _MOST_REFUSALS = 1e-8, 40, 6
# Step of the differences in a parameter's logarithm, at which those of fourth order are exact to rounding.
_STEP = 1e-3
# A parameter is looked for up to this factor from its start, and a profile is followed so far, where no bounds are.
_FARTHEST = 1e3
# Singular values of the derivatives below this share of the largest are rounding.
_LEAST = 1e-9
# Residuals this unlikely by noise of the given sigma are named.
_UNLIKELY = 1e-3


def bounded(
    circuit: Circuit, paths: Sequence[str], count: int, given: Mapping[str, tuple[float, float]]
) -> tuple[Circuit, FloatArray]:
    """The circuit to start from, and smallest and largest values, shape (n_parameter, 2): 0 and infinity by default.

    A start outside its bounds moves to the nearer one, with a warning. Fewer data (`count`) than `paths` are refused.
    """
    if count < len(paths):
        raise InputError(f"{count} data cannot tell {len(paths)} parameters; allowed: at least as many data")
    for path in given:
        if path.lower() not in map(str.lower, paths):
            raise InputError(f"bounds names {path}, which is not fitted; allowed: {', '.join(paths)}")
    lower, out = {path.lower(): tuple(pair) for path, pair in given.items()}, []
    for path in paths:
        pair = lower.get(path.lower(), (0.0, math.inf))
        if len(pair) != 2 or not 0.0 <= pair[0] < pair[1]:
            raise InputError(f"bounds of {path} are {pair}; allowed: two values with 0 <= low < high")
        value = circuit.parameters[path].value
        moved = min(max(value, pair[0]), pair[1])
        if moved != value:
            said = f"{path} is {value:g}, outside its bounds {pair[0]:g} to {pair[1]:g}: it starts at {moved:g}"
            warnings.warn(said, FingerspiceWarning, stacklevel=3)
            circuit = circuit.varied({path: moved})
        out.append(pair)
    return circuit, np.array(out, float)


@dataclass(frozen=True)
class Problem:
    """What is fitted; its classes compare what the circuit predicts with the data."""

    circuit: Circuit  # With the values to start from
    names: tuple[str, ...]  # What is fitted: paths, with the group in brackets where a parameter has a value in each
    paths: tuple[str, ...]  # The path of each
    bounds: FloatArray  # (n_parameter, 2): Smallest and largest values
    scale: FloatArray  # (n,): By which residuals are divided

    @property
    def initial(self) -> FloatArray:
        """Values to start from."""
        return np.array([self.circuit.parameters[path].value for path in self.paths])

    @property
    def walls(self) -> FloatArray:
        """Bounds also where none are given, far from the start: there are no likely values, and slow runs."""
        (low, high), near, far = self.bounds.T, self.initial / _FARTHEST, self.initial * _FARTHEST
        return np.column_stack([np.where(low > 0.0, low, near), np.where(high < math.inf, high, far)])

    def misses(self, values: FloatArray) -> FloatArray:
        """Residuals over their scale, shape (n,)."""
        raise NotImplementedError

    def compared(self, values: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Residuals over their scale (n,), and their derivatives by the logarithms of the values (n, n_parameter)."""
        ways = np.exp(_STEP * np.multiply.outer(AT, np.eye(values.size)))
        by = [derivative([self.misses(values * one) for one in way], _STEP) for way in ways.swapaxes(0, 1)]
        return self.misses(values), np.array(by).T

    def residuals(self, values: FloatArray) -> tuple[FloatArray, FloatArray]:
        """As `compared`; `REFUSED` for all where the circuit with these values cannot be run."""
        try:
            with warnings.catch_warnings():
                # Of values that no user has written.
                warnings.simplefilter("ignore", FingerspiceWarning)
                return self.compared(values)
        except (InputError, SolveError):
            return np.full(self.scale.size, REFUSED), np.zeros((self.scale.size, values.size))

    def profiled(self, wanted: bool | Sequence[str]) -> list[str]:
        """The names whose profiles are wanted, in the circuit's own spelling."""
        if isinstance(wanted, bool):
            return list(self.names) if wanted else []
        known = {name.lower(): name for name in self.names}
        for name in wanted:
            if not isinstance(name, str) or name.lower() not in known:
                allowed = ", ".join(self.names)
                raise InputError(f"profiles names {name!r}, which is not fitted; allowed: True, or {allowed}")
        return [known[name.lower()] for name in wanted]


class Fitted(NamedTuple):
    """Where least squares have led."""

    values: FloatArray  # (n_parameter,)
    residual: FloatArray  # (n,): Over their scale
    by_log: FloatArray  # (n, n_parameter): Their derivatives by the logarithms of the values
    objective: float  # Sum of their squares
    evaluations: int
    closed: bool

    @property
    def found(self) -> bool:
        """Whether the data can be predicted with these values."""
        return self.objective < 0.5 * REFUSED**2

    @property
    def covariance(self) -> FloatArray:
        """Covariance of the logarithms of the parameters, for residuals of variance 1.

        Combinations of parameters that no datum feels have a large variance, and not an infinite one, of which no
        correlation would be known.
        """
        _, singular, right = np.linalg.svd(self.by_log, full_matrices=False)
        spread = 1.0 / np.maximum(singular, _LEAST * max(float(singular.max()), 1e-300))
        return np.asarray((right.T * spread**2) @ right)

    def beyond_sigma(self, at: Any, freedom: int, of: str = "") -> list[str]:
        """A sentence about residuals, at some places of them, that are far larger than their given sigma, else none."""
        from scipy.stats import chi2

        square = float(np.sum(self.residual[at] ** 2))
        if freedom < 1 or chi2.sf(square, freedom) > _UNLIKELY:
            return []
        return [
            f"The residuals{of} are {math.sqrt(square / freedom):.2g} times as large as sigma, which noise explains in "
            "less than one of a thousand cases: the circuit does not describe these data, or sigma is too small, and "
            "so are the intervals."
        ]


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


# Results

# Two parameters are not told apart if their errors are correlated beyond this and one of them is larger than that; and
# the error of a parameter, in its logarithm, from which on nothing is known of it.
_TOGETHER, _NOTABLE, _UNKNOWN = 0.98, 0.05, 0.7
# A value this close to a bound, relative, is at it.
_AT_BOUND = 1e-6
# An interval that reaches farther than this, in the logarithm, has no ends.
_NO_END = 50.0
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
    # low, high: 95 % interval, symmetric in the logarithm
    low: float
    high: float
    at_bound: bool


@dataclass(frozen=True)
class Profile:
    """The best fits with one parameter held at each of several values.

    Attributes
    ----------
    path : str
    values : ndarray, shape (n,)
        Values of the parameter, ascending.
    objective : ndarray, shape (n,)
        Sum of the squared residuals at each, as `Fit.objective`.
    limit : float
        The objective at the ends of the 95 % interval.
    low, high : float
        The interval; 0 or a bound, and infinity or a bound, where the data set no end.
    shape : str
        ``"symmetric"`` (in the logarithm), ``"skewed"``, ``"open below"``, ``"open above"`` or ``"open"``.
    """

    path: str
    values: FloatArray
    objective: FloatArray
    limit: float
    low: float
    high: float
    shape: str


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
    profiles: dict[str, Profile] = field(default_factory=dict)

    def _panels(self) -> list[Drawn]:
        raise NotImplementedError

    def _columns(self) -> dict[str, Any]:
        """Columns of the table, by their heads."""
        raise NotImplementedError

    def plot(self) -> Picture:
        """Data and fit, of contacts of every relation, with the residuals below."""
        from fingerspice.plots.picture import plot_panels

        return plot_panels(self._panels())

    def to_csv(self, path: str | Path) -> Path:
        """Write conditions (in the units of the netlist; of a contact in SI units), data, prediction and sigma as CSV.

        Raises
        ------
        InputError
            If the folder cannot be written.
        """
        columns = self._columns()
        return write_csv(path, columns, zip(*columns.values(), strict=True))

    @property
    def _pairs(self) -> list[tuple[str, str, float]]:
        """Every two parameters, and the correlation of their errors."""
        named = itertools.combinations(enumerate(self.estimates), 2)
        return [(a, b, float(self.correlation[i, j])) for (i, a), (j, b) in named]

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
        pairs = [f"{a}, {b}: {both:+.3f}" for a, b, both in self._pairs if abs(both) > 0.1]
        if pairs:
            lines += ["", "correlations beyond 0.1: " + "; ".join(pairs)]
        for one in self.profiles.values():
            ends = f"{one.low:.4g} to {one.high:.4g} {self.estimates[one.path].unit}, {one.shape}"
            lines.append(f"profile of {one.path}: {ends}".replace(" ,", ","))
        return Page([*lines, *(["", *self.notes] if self.notes else []), *end])

    def report(self) -> str:
        """Statistics, parameters and correlations in the layout of lmfit's ``fit_report``.

        As there, the criteria of Akaike and Bayes are n log(chi-square / n) + 2 k, and + k log(n), of n data and k
        parameters.
        """
        estimates, square, count, k = self.estimates, self.objective, self.count, len(self.estimates)
        level = count * math.log(max(square, 1e-300) / count)
        wide = max(map(len, estimates)) + 1
        lines = [
            "[[Fit Statistics]]",
            "    # fitting method   = least_squares",
            f"    # function evals   = {self.evaluations}",
            f"    # data points      = {count}",
            f"    # variables        = {k}",
            f"    chi-square         = {square:.8g}",
            f"    reduced chi-square = {square / (count - k) if count > k else math.inf:.8g}",
            f"    Akaike info crit   = {level + 2.0 * k:.8g}",
            f"    Bayesian info crit = {level + k * math.log(count):.8g}",
            "[[Variables]]",
        ]
        for name, e in estimates.items():
            share = f"({100.0 * e.error / e.value:.2f}%) (init = {e.initial:.7g})"
            lines.append(f"    {name + ':':<{wide}} {e.value: .8g} +/- {e.error:.8g} {share}")
        pairs = sorted((pair for pair in self._pairs if abs(pair[2]) >= 0.1), key=lambda pair: -abs(pair[2]))
        if pairs:
            lines.append("[[Correlations]] (unreported correlations are < 0.100)")
        return "\n".join([*lines, *(f"    C({a}, {b}) = {both:+.4f}" for a, b, both in pairs)])

    def to_dict(self) -> dict[str, Any]:
        """The fit as plain numbers and texts; `parameters` has a row for each."""
        return {
            "parameters": [vars(e) for e in self.estimates.values()],
            "correlation": self.correlation.tolist(),
            "objective": self.objective,
            "notes": list(self.notes),
            "profiles": [
                {name: np.asarray(x).tolist() for name, x in vars(one).items()} for one in self.profiles.values()
            ],
        }


def estimated(
    task: Problem, best: Fitted, error: FloatArray, reach: FloatArray,
    remedy: Callable[[tuple[str, ...]], str], more: Sequence[str],
) -> dict[str, Any]:  # fmt: skip
    """Fields of a `FitResult` from the best fit.

    `error` has the standard errors of the logarithms and `reach` how many of them half an interval is; `remedy` says of
    one or two parameters what would tell them, and `more` are further notes.
    """
    estimates, notes = {}, []
    numbers = (x.tolist() for x in (task.initial, best.values, error, reach))
    for name, path, box, start, value, off, far in zip(task.names, task.paths, task.bounds, *numbers, strict=True):
        at_bound = bool(np.any(np.abs(value / box[np.isfinite(box) & (box > 0.0)] - 1.0) < _AT_BOUND))
        ratio = math.exp(far * off) if far * off < _NO_END else math.inf
        unit = task.circuit.parameters[path].unit
        estimates[name] = Estimate(name, unit, value, start, value * off, value / ratio, value * ratio, at_bound)
        if at_bound:
            own = f"{value:g} {unit}".rstrip()
            notes.append(f"{name} is at its bound, {own}: its interval is not that of a free parameter.")
    covariance = best.covariance
    spread = np.sqrt(np.diag(covariance))
    correlation = covariance / np.outer(spread, spread)
    for (i, a), (j, b) in itertools.combinations(enumerate(task.names), 2):
        if abs(correlation[i, j]) > _TOGETHER and max(error[i], error[j]) > _NOTABLE:
            notes.append(
                f"{a} and {b} are not told apart (correlation {correlation[i, j]:+.4f}): they change these data in "
                f"almost the same way, and only a combination of both is known. {remedy((a, b))}"
            )
    named = " ".join(notes)
    notes += [
        f"Of {name} these data tell next to nothing: its error is larger than itself. {remedy((name,))}"
        for name, off in zip(task.names, error.tolist(), strict=True)
        if not off < _UNKNOWN and name not in named
    ]
    return {
        "estimates": estimates, "correlation": correlation, "objective": best.objective, "count": best.residual.size,
        "evaluations": best.evaluations, "closed": best.closed, "notes": (*notes, *more),
    }  # fmt: skip


def profile_of(task: Problem, best: Fitted, one: Estimate, room: float) -> Profile:
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
    for sign, word, bound in zip((-1, 1), ("below", "above"), task.bounds[place].tolist(), strict=True):
        begin = np.delete(best.values, place)
        with np.errstate(divide="ignore"):
            farthest = min(math.log(_FARTHEST), abs(float(np.log(bound)) - here))
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
    if opened:
        shape = "open" if len(opened) == 2 else f"open {opened[0]}"
    else:
        reach = here - math.log(low), math.log(high) - here
        shape = "skewed" if max(reach) > _SKEWED * min(reach) else "symmetric"
    at = sorted(known)
    return Profile(one.path, np.exp(at), np.array([known[x] for x in at]), limit, low, high, shape)
