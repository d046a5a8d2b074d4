"""The result of a contact's fit: values for the deck with their intervals, and what the data cannot tell."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fingerspice.base.arrays import FloatArray
from fingerspice.base.files import write_csv
from fingerspice.base.pages import Page
from fingerspice.circuit.circuit import Circuit
from fingerspice.studies.fit.contactdata import FEWEST, ContactTask, Pool, Relation, pools_of
from fingerspice.studies.fit.result import FitResult, covariance_of, estimated, misfit_note
from fingerspice.studies.fit.search import Fitted

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# The share of an error's variance below which a relation has no part in it.
_NO_PART = 1e-9


@dataclass(frozen=True, repr=False, kw_only=True)
class ContactFit(FitResult):
    """A fit of a contact to data; `circuit` is ready to run.

    Attributes
    ----------
    circuit, estimates, correlation, evaluations, closed, notes, profiles
        As of `Fit`.
    gap : str
        Name of the GAP.
    relations : tuple of Relation
        The data, by kind.
    predicted, sigma : tuple of ndarray
        Values and standard deviations of every relation, as the fit has them.
    misfits : tuple of float
        Root mean square of the logarithm of prediction over data, of every relation.
    objective : float
        Sum of the squared residuals over sigma.
    freedom : int
        Data less parameters.
    reach : dict of str to float
        Half of each interval in the logarithm over the standard error: Student's t, with the degrees of freedom of the
        relations that the parameter is known from.
    """

    gap: str
    relations: tuple[Relation, ...]
    predicted: tuple[FloatArray, ...]
    sigma: tuple[FloatArray, ...]
    misfits: tuple[float, ...]
    reach: dict[str, float]

    @property
    def values(self) -> dict[str, float]:
        """Fitted values by path, as `Circuit.replace` takes them."""
        return {path: one.value for path, one in self.estimates.items()}

    @property
    def line(self) -> str:
        """The fitted parameters as a netlist has them."""
        return " ".join(f"{path.rpartition('.')[2]}={one.value:.6g}" for path, one in self.estimates.items())

    def _page(self) -> Page:
        fitted = f"{len(self.estimates)} parameters fitted to {self._count} values"
        lines = [f"contact of {self.gap}: {fitted}, {self._effort}"]
        for one, misfit in zip(self.relations, self.misfits, strict=True):
            known = "sigma as given" if one.sigma is not None else "sigma estimated from the residuals"
            lines.append(f"{one.name}: {one.values.size} values, residual {100.0 * misfit:.3g} % rms; {known}")
        return Page([*lines, *self._lines(), "", f"in the deck: {self.gap} ... {self.line}"])

    @property
    def _count(self) -> int:
        return self.freedom + len(self.estimates)

    def plot(self) -> Figure:
        """Data and fit of every relation, with the residuals below."""
        from fingerspice.plots.populations import Curve, Panel, plot_panels

        panels = []
        for one, fitted, sigma in zip(self.relations, self.predicted, self.sigma, strict=True):
            x, label, others, name = _abscissa(one)
            kinds = np.unique(others)
            curves = [
                Curve(
                    name.format(kind) if kinds.size > 1 else one.name,
                    *(part[others == kind] for part in (x, one.values, fitted, sigma)),
                )
                for kind in kinds
            ]
            panels.append(Panel(curves, label, one.name, one.unit))
        return plot_panels(panels)

    def to_dict(self) -> dict[str, Any]:
        """The fit as plain numbers and texts; `parameters` has a row for each."""
        return {
            "gap": self.gap,
            **self._plain(),
            "relations": [
                {"kind": one.kind, "count": int(one.values.size), "misfit": misfit}
                for one, misfit in zip(self.relations, self.misfits, strict=True)
            ],
        }

    def to_csv(self, path: str | Path) -> Path:
        """Write conditions, data, prediction and sigma as CSV, SI units.

        Raises
        ------
        InputError
            If the folder cannot be written.
        """
        header = "relation", "fn", "u_gap", "indentation", "measured", "fitted", "sigma"
        rows = [
            (one.kind, *row)
            for one, fitted, sigma in zip(self.relations, self.predicted, self.sigma, strict=True)
            for row in np.column_stack([one.fn, one.u_gap, one.indentation, one.values, fitted, sigma])
        ]
        return write_csv(path, header, rows)


def _abscissa(one: Relation) -> tuple[FloatArray, str, FloatArray, str]:
    """Values along the axis and its label, and those of the condition that tells curves apart with a curve's name."""
    if one.kind == "indentation":
        return 1e3 * one.indentation, "indentation [mm]", np.zeros(one.fn.size), ""
    if np.unique(one.u_gap).size > np.unique(one.fn).size:
        return one.u_gap, "gap voltage [V]", one.fn, "normal load = {:g} N"
    return one.fn, "normal load [N]", one.u_gap, "gap voltage = {:g} V"


def contact_result(circuit: Circuit, task: ContactTask, best: Fitted, freedom: Sequence[float]) -> ContactFit:
    """The result of a fit; `freedom` has the degrees of freedom of every pool."""
    covariance, pools, predicted = covariance_of(best.by_log), pools_of(task), task.predict(best.values)
    error, reach = _errors(best, covariance, pools, freedom)
    return ContactFit(
        **estimated(
            task, best, covariance, error, reach, lambda names: _remedy(task, names),
            _further_notes(task, best, pools, freedom),
        ),
        circuit=circuit,
        gap=task.gap,
        relations=task.relations,
        predicted=tuple(predicted),
        sigma=tuple(
            one.sigma if one.sigma is not None else share * found
            for one, share, found in zip(task.relations, task.split(task.scale), predicted, strict=True)
        ),
        misfits=tuple(
            float(np.sqrt(np.mean(np.log(np.maximum(found, 1e-300) / one.values) ** 2)))
            for one, found in zip(task.relations, predicted, strict=True)
        ),
        freedom=best.residual.size - len(task.unknowns),
        reach=dict(zip(task.names, reach, strict=True)),
    )  # fmt: skip


def _errors(
    best: Fitted, covariance: FloatArray, pools: Sequence[Pool], freedom: Sequence[float]
) -> tuple[FloatArray, list[float]]:
    """Standard errors of the logarithms, and Student's t with the degrees of freedom of Satterthwaite.

    (F. E. Satterthwaite, Biometrics Bulletin 2, 110, 1946.) Each pool has its own variance, known from its own
    residuals, and a part in the variance of a parameter.
    """
    from scipy.stats import norm, t

    parts = np.array([np.sum((covariance @ best.by_log[pool.at].T) ** 2, axis=1) for pool in pools])
    error, reach = np.sqrt(np.diag(covariance)), []
    for k, own in enumerate(parts.T):
        shares = own / max(float(own.sum()), 1e-300)
        felt = [(share, left) for share, left in zip(shares.tolist(), freedom, strict=True) if share > _NO_PART]
        inverse = sum(share**2 / left if left >= FEWEST else math.inf for share, left in felt)
        if math.isinf(inverse):
            error[k] = math.inf
        reach.append(float(norm.ppf(0.975) if inverse == 0.0 else t.ppf(0.975, 1.0 / inverse) if inverse < math.inf
                           else math.inf))  # fmt: skip
    return error, reach


def _further_notes(task: ContactTask, best: Fitted, pools: Sequence[Pool], freedom: Sequence[float]) -> list[str]:
    found = []
    for pool, left in zip(pools, freedom, strict=True):
        if left < FEWEST:
            found.append(
                f"Of the {pool.name} there are hardly more values ({pool.at.size}) than parameters, which leaves no "
                "measure of their errors: measure more of them, or give sigma."
            )
        if not pool.estimated:
            own = misfit_note(float(np.sum(best.residual[pool.at] ** 2)), pool.at.size)
            found += [note.replace("The residuals", f"The residuals of the {pool.name}", 1) for note in own]
    fitted = {path.rpartition(".")[2] for path in task.names}
    if "c2" in fitted and "mu" not in fitted:
        mu = task.circuit[task.gap].values["mu"]
        found.append(
            f"c2 holds for the circuit's mu = {mu:g}: these data tell only c2 mu^2. Measure the friction force."
        )
    return found


def _remedy(task: ContactTask, names: tuple[str, ...]) -> str:
    """The measurement that would tell one parameter, or two apart."""
    bare = {name.rpartition(".")[2] for name in names}
    kinds = {one.kind for one in task.relations}
    loads = np.concatenate([one.fn for one in task.relations if one.kind != "indentation"] or [np.ones(1)])
    if bare <= {"alpha", "m_exp"}:
        if float(np.ptp(loads)) == 0.0:
            return "Measure the area at a second load as well, or fix one of them."
        return "Measure the area over a wider range of loads, or fix one of them."
    if bare <= {"beta", "n_exp"}:
        if "indentation" not in kinds:
            return "Measure the area against the indentation as well, or fix one of them."
        return "Measure the area over a wider range of indentations, or fix one of them."
    if "area" not in kinds and "c2" in bare:
        return "Measure the area at rest as well, or fix one of them."
    if bare & {"beta", "n_exp"}:
        return "Measure the area against the indentation, or under a higher voltage, or fix one of them."
    return "Measure over a wider range of loads, or fix one of them."
