"""The result of a fit: values with intervals, correlations, and what the data cannot tell."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fingerspice.base.arrays import FloatArray
from fingerspice.base.pages import Page, Shown, Table
from fingerspice.circuit.circuit import Circuit
from fingerspice.studies.drive_files import write_columns
from fingerspice.studies.fitdata import MEASURED, Data

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Two parameters are not told apart if their errors are correlated beyond this and one of them is larger than that; and
# the error of a parameter, in its logarithm, from which on nothing is known of it.
_TOGETHER, _NOTABLE, _UNKNOWN = 0.98, 0.05, 0.7
# Singular values of the derivatives below this share of the largest are rounding.
_LEAST = 1e-9
# A value this close to a bound, relative, is at it.
_AT_BOUND = 1e-6


@dataclass(frozen=True)
class Fitted:
    """Where least squares have led: values, residuals over their scale, and their derivatives by logarithms."""

    values: FloatArray
    residual: FloatArray
    by_log: FloatArray
    objective: float
    evaluations: int
    closed: bool


@dataclass(frozen=True)
class Estimate:
    """One fitted parameter, in the unit of the netlist.

    Attributes
    ----------
    path, unit : str
    value, initial : float
    error : float
        Standard error.
    low, high : float
        95 % interval, symmetric in the logarithm.
    at_bound : bool
    """

    path: str
    unit: str
    value: float
    initial: float
    error: float
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


@dataclass(frozen=True, repr=False)
class Fit(Shown):
    """A fit of parameters to data; `circuit` is ready to run.

    Attributes
    ----------
    circuit : Circuit
        With the fitted values.
    estimates : dict of str to Estimate
        By path.
    correlation : ndarray, shape (n_parameter, n_parameter)
        Of the errors of the logarithms.
    data : Data
    predicted : ndarray, shape (n,)
        The data as the fitted circuit gives them.
    sigma : ndarray, shape (n,)
        Standard deviation of every value: as given, or as the residuals have it.
    objective : float
        Sum of the squared residuals over sigma as given, or over the largest value of the data.
    objectives : tuple of float
        That reached from every start that was followed.
    freedom : int
        Data less parameters.
    evaluations : int
    closed : bool
        Whether the iteration closed.
    notes : tuple of str
        What the data do not tell, and which measurement would.
    profiles : dict of str to Profile
        By path, as far as they were asked for.
    """

    circuit: Circuit
    estimates: dict[str, Estimate]
    correlation: FloatArray
    data: Data
    predicted: FloatArray
    sigma: FloatArray
    objective: float
    objectives: tuple[float, ...]
    freedom: int
    evaluations: int
    closed: bool
    notes: tuple[str, ...]
    profiles: dict[str, Profile] = field(default_factory=dict)

    @property
    def residual(self) -> FloatArray:
        """Data less prediction, in the unit of the data, shape (n,)."""
        return np.asarray(self.data.values - self.predicted)

    def _page(self) -> Page:
        rows = [
            (
                e.path, f"{e.value:.6g}", f"{e.error:.2g}", f"{100.0 * e.error / e.value:.2g} %",
                f"{e.low:.4g} to {e.high:.4g}", e.unit, f"{e.initial:.4g}", "at a bound" if e.at_bound else "",
            )
            for e in self.estimates.values()
        ]  # fmt: skip
        rms = float(np.sqrt(np.mean(self.residual**2)))
        peak = float(np.abs(self.data.values).max()) or 1.0
        lines: list[str | Table] = [
            f"{len(rows)} parameters fitted to {self.data.values.size} values of {self.data.name}, "
            f"{self.evaluations} evaluations{'' if self.closed else ', the iteration did not close'}",
            f"residual {rms:.3g} {MEASURED[self.data.signal]} rms, {100.0 * rms / peak:.2g} % of the largest value; "
            f"{'sigma as given' if self.data.sigma is not None else 'sigma estimated from the residuals'}",
            "",
            Table(("parameter", "value", "error", "", "95 % interval", "unit", "started at", ""), rows),
        ]
        pairs = [
            f"{a}, {b}: {self.correlation[i, j]:+.3f}"
            for (i, a), (j, b) in itertools.combinations(enumerate(self.estimates), 2)
            if abs(self.correlation[i, j]) > 0.1
        ]
        if pairs:
            lines += ["", "correlations beyond 0.1: " + "; ".join(pairs)]
        for one in self.profiles.values():
            unit = self.estimates[one.path].unit
            lines += [f"profile of {one.path}: {one.low:.4g} to {one.high:.4g} {unit}, {one.shape}"]
        return Page([*lines, *(["", *self.notes] if self.notes else [])])

    def plot(self) -> Figure:
        """Data and fit, with the residuals below."""
        from fingerspice.plots.fits import Curve, plot_fit

        data, signal = self.data, self.data.name
        varying = sorted(data.varying.items(), key=lambda item: -np.unique(item[1]).size)
        groups, names = np.zeros(data.values.size, int), ["measured and fitted"]
        if data.t is not None:
            x, label = data.t, "time [s]"
        elif varying:
            (path, x), others = varying[0], varying[1:]
            label = self._labelled(path)
            if others:
                kinds, groups = np.unique(np.column_stack([y for _, y in others]), axis=0, return_inverse=True)
                paths = [self._labelled(path) for path, _ in others]
                names = [", ".join(f"{a} = {b:g}" for a, b in zip(paths, kind, strict=True)) for kind in kinds]
        else:
            x, label = np.arange(1.0, data.values.size + 1.0), "measurement"
        curves = [
            Curve(name, x[own], data.values[own], self.predicted[own], self.sigma[own])
            for group, name in enumerate(names)
            for own in [groups == group]
        ]
        return plot_fit(curves, label, signal, MEASURED[data.signal])

    def _labelled(self, path: str) -> str:
        unit = self.circuit.parameters[path].unit
        return f"{path} [{unit}]" if unit else path

    def to_dict(self) -> dict[str, Any]:
        """The fit as plain numbers and texts; `parameters` has a row for each."""
        return {
            "parameters": [vars(e) for e in self.estimates.values()],
            "correlation": self.correlation.tolist(),
            "signal": self.data.signal,
            "count": int(self.data.values.size),
            "residual_rms": float(np.sqrt(np.mean(self.residual**2))),
            "objective": self.objective,
            "objectives": list(self.objectives),
            "notes": list(self.notes),
            "profiles": [
                {**vars(one), "values": one.values.tolist(), "objective": one.objective.tolist()}
                for one in self.profiles.values()
            ],
        }

    def to_csv(self, path: str | Path) -> Path:
        """Write conditions, data, prediction and sigma as CSV.

        Raises
        ------
        InputError
            If the folder cannot be written.
        """
        data = self.data
        columns = {"t": data.t} if data.t is not None else {}
        columns |= {**data.conditions, data.signal: data.values, "fitted": self.predicted, "sigma": self.sigma}
        return write_columns(Path(path), tuple(columns), tuple(columns.values()))


def fit_result(
    circuit: Circuit, data: Data, paths: tuple[str, ...], bounds: FloatArray, best: Fitted, objectives: Sequence[float],
    scale: FloatArray,
) -> Fit:  # fmt: skip
    """The result of the best of several fits."""
    from scipy.stats import norm, t

    freedom, n = best.residual.size - len(paths), data.values.size
    at_bound = [
        bool(np.any(np.abs(value / pair[np.isfinite(pair) & (pair > 0.0)] - 1.0) < _AT_BOUND))
        for value, pair in zip(best.values, bounds, strict=True)
    ]
    variance = 1.0 if data.sigma is not None else best.objective / freedom if freedom > 0 else math.inf
    _, singular, right = np.linalg.svd(best.by_log, full_matrices=False)
    # Combinations of parameters that no datum feels have a large error, and not an infinite one, of which no
    # correlation would be known.
    spread = 1.0 / np.maximum(singular, _LEAST * max(float(singular.max()), 1e-300))
    unit_covariance = (right.T * spread**2) @ right
    error = np.sqrt(np.diag(unit_covariance))
    correlation = unit_covariance / np.outer(error, error)
    error *= math.sqrt(variance)
    reach = float(norm.ppf(0.975) if data.sigma is not None else t.ppf(0.975, freedom) if freedom > 0 else math.inf)
    estimates = {
        path: Estimate(
            path, circuit.parameters[path].unit, float(value), circuit.parameters[path].value, float(value * off),
            float(value * math.exp(-min(reach * off, 700.0))), float(value * math.exp(min(reach * off, 700.0))), bound,
        )
        for path, value, off, bound in zip(paths, best.values, error, at_bound, strict=True)
    }  # fmt: skip
    sigma = data.sigma if data.sigma is not None else math.sqrt(variance) * scale[:n]
    notes = _notes(circuit, data, paths, estimates, correlation, error)
    fitted = circuit.varied(dict(zip(paths, best.values.tolist(), strict=True)))
    return Fit(
        fitted, estimates, correlation, data, data.values + (best.residual * scale)[:n], sigma, best.objective,
        tuple(objectives), freedom, best.evaluations, best.closed, notes,
    )  # fmt: skip


def _notes(
    circuit: Circuit, data: Data, paths: tuple[str, ...], estimates: dict[str, Estimate], correlation: FloatArray,
    error: FloatArray,
) -> tuple[str, ...]:  # fmt: skip
    """What the data do not tell, and what would."""
    found, remedy = [], _remedy(circuit, data)
    for e in estimates.values():
        if e.at_bound:
            own = f"{e.value:g} {e.unit}".rstrip()
            found.append(f"{e.path} is at its bound, {own}: its interval is not that of a free parameter.")
    for i, j in itertools.combinations(range(len(paths)), 2):
        if abs(correlation[i, j]) > _TOGETHER and max(error[i], error[j]) > _NOTABLE:
            found.append(
                f"{paths[i]} and {paths[j]} are not told apart (correlation {correlation[i, j]:+.4f}): they change "
                f"these data in almost the same way, and only a combination of both is known. {remedy}"
            )
    named = " ".join(found)
    for path, off in zip(paths, error, strict=True):
        if not off < _UNKNOWN and path not in named:
            found.append(f"Of {path} these data tell next to nothing: its error is larger than itself. {remedy}")
    return tuple(found)


def _remedy(circuit: Circuit, data: Data) -> str:
    """A measurement that would add what is missing: at another voltage, frequency or load."""
    varying = {path.rpartition(".")[2] for path in data.varying}
    missing = [
        text
        for key, text in (("amplitude", "voltage"), ("frequency", "frequency"), ("fn", "load"))
        if key not in varying and any(path.rpartition(".")[2] == key for path in circuit.parameters)
    ]
    if data.t is not None:
        return "Measure under another voltage or load as well, or fix one of them."
    if not missing:
        return "Fix one of them to a value known from elsewhere."
    return f"Measure at a second {missing[0]} as well, or fix one of them."
