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
from fingerspice.studies.fit.circuitdata import MEASURED, Data
from fingerspice.studies.fit.circuittask import Task
from fingerspice.studies.fit.result import FitResult, covariance_of, estimated, misfit_note
from fingerspice.studies.fit.search import Fitted

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True, repr=False, kw_only=True)
class Fit(FitResult):
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

    data: Data
    predicted: FloatArray
    sigma: FloatArray
    objectives: tuple[float, ...]
    circuits: dict[str, Circuit] = field(default_factory=dict)

    @property
    def residual(self) -> FloatArray:
        """Data less prediction, in the unit of the data, shape (n,)."""
        return np.asarray(self.data.values - self.predicted)

    @property
    def _rms(self) -> float:
        return float(np.sqrt(np.mean(self.residual**2)))

    def _page(self) -> Page:
        share = 100.0 * self._rms / (float(np.abs(self.data.values).max()) or 1.0)
        lines: list[str | Table] = [
            f"{len(self.estimates)} parameters fitted to {self.data.values.size} values of {self.data.name}, "
            f"{self._effort}",
            f"residual {self._rms:.3g} {MEASURED[self.data.signal]} rms, {share:.2g} % of the largest value; "
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
        return self.data.count

    def plot(self) -> Figure:
        """Data and fit, with the residuals below."""
        from fingerspice.plots.populations import Curve, plot_fit

        data = self.data
        signal = SIGNALS[data.signal][1] if data.signal in SIGNALS else data.signal
        signal = f"mean {signal}" if data.name.endswith("_mean") else signal
        varying = sorted(data.varying.items(), key=lambda item: -np.unique(item[1]).size)
        names = ["measured and fitted"] * data.values.size
        if data.t is not None:
            x, label = data.t, "time [s]"
        elif varying:
            (path, x), others = varying[0], varying[1:]
            unit = self.circuit.parameters[path].unit
            label = meaning_of(self.circuit, path) + (f" [{unit}]" if unit else "")
            keys = [] if data.groups is None else [[f"{data.groups.column} = {one}" for one in data.groups.of]]
            for path, values in others:
                unit = self.circuit.parameters[path].unit
                keys.append([f"{meaning_of(self.circuit, path)} = {y:g} {unit}".rstrip() for y in values])
            if keys:
                names = [", ".join(told) for told in zip(*keys, strict=True)]
        else:
            x, label = np.arange(1.0, data.values.size + 1.0), "measurement"
        curves = [
            Curve(name, *(part[np.array(names) == name] for part in (x, data.values, self.predicted, self.sigma)))
            for name in dict.fromkeys(names)
        ]
        return plot_fit(curves, label, signal, MEASURED[data.signal])

    def to_dict(self) -> dict[str, Any]:
        """The fit as plain numbers and texts; `parameters` has a row for each."""
        return {
            **self._plain(),
            "groups": list(self.circuits),
            "signal": self.data.signal,
            "count": int(self.data.values.size),
            "residual_rms": self._rms,
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
            columns = {groups.column: groups.of, **columns}
        return write_csv(path, columns, zip(*columns.values(), strict=True))


def fit_result(
    task: Task, best: Fitted, objectives: Sequence[float], freedom: int, variance: float, reach: float
) -> Fit:
    """The result of the best of several fits; half an interval is `reach` standard errors."""
    data, n = task.data, task.data.values.size
    covariance, remedy = covariance_of(best.by_log), _remedy(task.circuit, data)
    return Fit(
        **estimated(
            task, best, covariance, np.sqrt(np.diag(covariance) * variance), [reach] * len(task.unknowns),
            lambda _: remedy, misfit_note(best.objective, freedom) if data.sigma is not None else [],
        ),
        data=data,
        predicted=data.values + (best.residual * task.scale)[:n],
        sigma=data.sigma if data.sigma is not None else math.sqrt(variance) * task.scale[:n],
        objectives=tuple(objectives),
        freedom=freedom,
        **_fitted_circuits(task, best.values),
    )  # fmt: skip


def _fitted_circuits(task: Task, values: FloatArray) -> dict[str, Any]:
    """`circuit` and `circuits` of a `Fit`."""
    found = list(zip(task.unknowns, values.tolist(), strict=True))
    mean = {}
    for path in task.paths:
        own = [value for one, value in found if one.path == path]
        mean[path] = own[0] if len(own) == 1 else math.exp(sum(map(math.log, own)) / len(own))
    return {
        "circuit": task.circuit.varied(mean),
        "circuits": {
            label: task.circuit.varied({one.path: value for one, value in found if one.label in (None, label)})
            for label in (task.data.groups.labels if task.data.groups is not None else ())
        },
    }


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
