"""The result of a fit: values with intervals, correlations, and what the data cannot tell."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fingerspice.base.arrays import FloatArray
from fingerspice.base.files import write_csv
from fingerspice.base.pages import Page, Table
from fingerspice.circuit.circuit import Circuit
from fingerspice.circuit.describe import meaning_of
from fingerspice.results.signals import SIGNALS
from fingerspice.studies.fitdata import MEASURED, Data, Unknown, fitted_circuits
from fingerspice.studies.fitestimates import (
    Estimate,
    Estimates,
    Profile,
    correlation_of,
    covariance_of,
    estimate_of,
    misfit_note,
    notes_of,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class Fitted:
    """Where least squares have led: values, residuals over their scale, and their derivatives by logarithms."""

    values: FloatArray
    residual: FloatArray
    by_log: FloatArray
    objective: float
    evaluations: int
    closed: bool


@dataclass(frozen=True, repr=False)
class Fit(Estimates):
    """A fit of parameters to data; `circuit` is ready to run.

    Attributes
    ----------
    circuit : Circuit
        With the fitted values.
    estimates : dict of str to Estimate
        By path; that of a group's parameter is followed by the group in brackets: ``Xgap.d[left]``.
    correlation : ndarray, shape (n_parameter, n_parameter)
        Of the errors of the logarithms.
    data : Data
    predicted : ndarray, shape (n,)
        The data as the fitted circuit gives them.
    sigma : ndarray, shape (n,)
        Standard deviation of every value: as given, or as the residuals have it.
    objective : float
        Sum of the squared residuals over sigma as given, or over the largest value of the data, or, where errors are
        likelier equal shares of the values, over these.
    objectives : tuple of float
        That reached from every start that was followed.
    freedom : int
        Data less parameters, and less one where the residuals say whether errors are equal or shares.
    evaluations : int
    closed : bool
        Whether the iteration closed.
    notes : tuple of str
        What the data do not tell, and which measurement would.
    circuits : dict of str to Circuit
        With groups: the circuit of each, by its name. `circuit` then has the geometric means of their parameters.
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
    circuits: dict[str, Circuit] = field(default_factory=dict)
    profiles: dict[str, Profile] = field(default_factory=dict)

    @property
    def residual(self) -> FloatArray:
        """Data less prediction, in the unit of the data, shape (n,)."""
        return np.asarray(self.data.values - self.predicted)

    def _page(self) -> Page:
        rms = float(np.sqrt(np.mean(self.residual**2)))
        peak = float(np.abs(self.data.values).max()) or 1.0
        lines: list[str | Table] = [
            f"{len(self.estimates)} parameters fitted to {self.data.values.size} values of {self.data.name}, "
            f"{self.evaluations} evaluations{'' if self.closed else ', the iteration did not close'}",
            f"residual {rms:.3g} {MEASURED[self.data.signal]} rms, {100.0 * rms / peak:.2g} % of the largest value; "
            f"{self._noise()}",
        ]
        if self.data.groups is not None:
            lines.append(f"groups by {self.data.groups.column}: {', '.join(self.data.groups.labels)}")
        return Page([*lines, *self._lines()])

    def _noise(self) -> str:
        if self.data.sigma is not None:
            return "sigma as given"
        equal = float(np.ptp(self.sigma)) <= 1e-9 * float(self.sigma.max())
        return f"sigma estimated from the residuals, {'equal for all' if equal else 'as equal shares of the values'}"

    @property
    def _count(self) -> int:
        return self.data.values.size * (1 if self.data.phase is None else 2)

    def plot(self) -> Figure:
        """Data and fit, with the residuals below."""
        from fingerspice.plots.populations import Curve, plot_fit

        data, circuit = self.data, self.circuit
        signal = SIGNALS[data.signal][1] if data.signal in SIGNALS else data.signal
        signal = f"mean {signal}" if data.name.endswith("_mean") else signal
        varying = sorted(data.varying.items(), key=lambda item: -np.unique(item[1]).size)
        groups, names = np.zeros(data.values.size, int), ["measured and fitted"]
        if data.t is not None:
            x, label = data.t, "time [s]"
        elif varying:
            (path, x), others = varying[0], varying[1:]
            unit = circuit.parameters[path].unit
            label = meaning_of(circuit, path) + (f" [{unit}]" if unit else "")
            keys = [
                (meaning_of(circuit, path), [f"{y:g} {circuit.parameters[path].unit}".rstrip() for y in values])
                for path, values in others
            ]
            if data.groups is not None:
                keys.insert(0, (data.groups.column, [data.groups.labels[i] for i in data.groups.of]))
            if keys:
                told = [", ".join(f"{a} = {b[row]}" for a, b in keys) for row in range(x.size)]
                names = list(dict.fromkeys(told))
                groups = np.array([names.index(one) for one in told])
        else:
            x, label = np.arange(1.0, data.values.size + 1.0), "measurement"
        curves = [
            Curve(name, x[own], data.values[own], self.predicted[own], self.sigma[own])
            for group, name in enumerate(names)
            for own in [groups == group]
        ]
        return plot_fit(curves, label, signal, MEASURED[data.signal])

    def to_dict(self) -> dict[str, Any]:
        """The fit as plain numbers and texts; `parameters` has a row for each."""
        return {
            **self._plain(),
            "groups": list(self.circuits),
            "signal": self.data.signal,
            "count": int(self.data.values.size),
            "residual_rms": float(np.sqrt(np.mean(self.residual**2))),
            "objectives": list(self.objectives),
        }

    def to_csv(self, path: str | Path) -> Path:
        """Write conditions, data, prediction and sigma as CSV.

        Raises
        ------
        InputError
            If the folder cannot be written.
        """
        data, groups = self.data, self.data.groups
        columns: dict[str, Any] = {"t": data.t} if data.t is not None else {}
        columns |= {**data.conditions, data.signal: data.values, "fitted": self.predicted, "sigma": self.sigma}
        if groups is not None:
            columns = {groups.column: [groups.labels[i] for i in groups.of], **columns}
        return write_csv(path, columns, zip(*columns.values(), strict=True))


def fit_result(
    circuit: Circuit, data: Data, unknowns: tuple[Unknown, ...], bounds: FloatArray, best: Fitted,
    objectives: Sequence[float], scale: FloatArray, freedom: int,
) -> Fit:  # fmt: skip
    """The result of the best of several fits."""
    from scipy.stats import norm, t

    n = data.values.size
    variance = 1.0 if data.sigma is not None else best.objective / freedom if freedom > 0 else math.inf
    covariance = covariance_of(best.by_log)
    error = np.sqrt(np.diag(covariance) * variance)
    reach = float(norm.ppf(0.975) if data.sigma is not None else t.ppf(0.975, freedom) if freedom > 0 else math.inf)
    estimates = {}
    for one, value, off, box in zip(unknowns, best.values.tolist(), error.tolist(), bounds, strict=True):
        start = circuit.parameters[one.path]
        estimates[one.name] = estimate_of(one.name, start.unit, start.value, value, off, reach, box)
    sigma = data.sigma if data.sigma is not None else math.sqrt(variance) * scale[:n]
    correlation, remedy = correlation_of(covariance), _remedy(circuit, data)
    notes = notes_of(estimates, correlation, error.tolist(), lambda _: remedy)
    notes += misfit_note(best.objective, freedom) if data.sigma is not None else []
    fitted, each = fitted_circuits(circuit, unknowns, best.values.tolist(), data.groups)
    return Fit(
        fitted, estimates, correlation, data, data.values + (best.residual * scale)[:n], sigma, best.objective,
        tuple(objectives), freedom, best.evaluations, best.closed, tuple(notes), each,
    )  # fmt: skip


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
