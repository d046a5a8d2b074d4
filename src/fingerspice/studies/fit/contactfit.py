"""Fit of a GAP's contact to measured areas and friction forces, and contact laws compared by what they explain."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import compress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from fingerspice.base.arrays import FloatArray, IntArray
from fingerspice.base.errors import FingerspiceWarning, InputError
from fingerspice.base.pages import Page, Shown, Table
from fingerspice.circuit.circuit import Circuit
from fingerspice.circuit.describe import require_circuit
from fingerspice.circuit.devices import DEVICES
from fingerspice.circuit.laws import ContactLaw
from fingerspice.circuit.statespace import build_stack, contact_of, loop_of
from fingerspice.physics.contact import JkrContact, ridge_area
from fingerspice.studies.fit import Fit, fit
from fingerspice.studies.fit.fitting import NOT_FOUND, SIGMA, FitResult, Fitted, Given, Problem, followed, measured_of
from fingerspice.waveforms.waveform import refuse, require

#: Measured columns and conditions, with their units.
MEASURED = {"area": "m^2", "area_sliding": "m^2", "f_t": "N"}
CONDITIONS = {"fn": "N", "indentation": "m", "u_gap": "V"}
#: What is measured in words; an area against the indentation is a relation of its own.
NAMES = {
    "area": "ridge area at rest", "indentation": "ridge area by indentation",
    "area_sliding": "ridge area while sliding", "f_t": "friction force",
}  # fmt: skip
PARAMETERS = ("alpha", "m_exp", "beta", "n_exp", "mu", "c2")
# Misfit (rms, relative) of a relation from which on it is warned about; the share of its value that a measured value
# without sigma is off by, at first; and the share of an error's variance below which a relation has no part in it.
_TOO_MUCH, _SHARE, _NO_PART = 0.2, 0.1, 1e-9
# Standard deviations of relations that have none are found in at most so many rounds, until they change by less than
# this; they are no smaller than the next, as are singular values that count, relative to the largest; fewer data than
# the last beyond those that the parameters take up tell nothing of them.
_ROUNDS, _SETTLED, _LEAST, _FEWEST = 30, 1e-4, 1e-9, 0.5
#: Relations of one standard deviation, from the same instrument: what was measured, in words; places among the
#: residuals; and values less what the parameters take up of them, infinite where the standard deviation is given.
Pool = tuple[str, IntArray, float]


class Relation(NamedTuple):
    """Measured values of one kind with their conditions, in SI units, each of shape (n,)."""

    kind: str  # A key of `NAMES`
    values: FloatArray
    sigma: FloatArray | None  # Standard deviation of every value; None where it is not known
    fn: FloatArray  # Normal load
    u_gap: FloatArray
    indentation: FloatArray  # 0 where it has no meaning

    @property
    def name(self) -> str:
        """What was measured, in words."""
        return NAMES[self.kind]

    def predicted(self, contact: JkrContact) -> FloatArray:
        """The values as a contact has them (Eqs. 1 to 6), shape (n,)."""
        if self.kind == "indentation":
            return np.asarray(contact.beta * self.indentation**contact.n)
        own = replace(contact, mu=0.0) if self.kind == "area" else contact
        under = zip(self.fn.tolist(), np.abs(self.u_gap).tolist(), strict=True)
        area = np.array([ridge_area(u, replace(own, f_n=fn).packed) for fn, u in under])
        return area if self.kind != "f_t" else contact.mu * (self.fn + contact.stress(self.u_gap) * area)


def _relations_of(given: Given | Sequence[Given], fn: float) -> tuple[Relation, ...]:
    """The relations in one or several sets of columns; `fn` (N) is the load where no column has it."""
    several = [given] if isinstance(given, (str, Path, Mapping)) else given
    if not isinstance(several, Sequence) or not several:
        raise InputError(f"data is a {type(given).__name__}; allowed: a mapping of columns, a table's path, or a list")
    found: dict[tuple[str, bool], list[Any]] = {}
    for number, one in enumerate(several, 1):
        place = "the data" if len(several) == 1 else f"data {number}"
        columns, place, _ = measured_of(one, _meaning, "fn (N), area (mm^2)", place=place)
        measured = [name for name in MEASURED if name in columns]
        refuse(not measured, f"{place} have the columns {', '.join(columns)}; allowed: one of {', '.join(MEASURED)}")
        alone = len(measured) == 1 and SIGMA in columns
        sigmas = {name: SIGMA if alone else f"{name}_{SIGMA}" for name in measured}
        unknown = [name for name in columns if name not in (*measured, *CONDITIONS, *sigmas.values())]
        if unknown:
            why = ": which of the measured columns it belongs to is not known" if unknown[0] == SIGMA else ""
            allowed = ", ".join([*MEASURED, *CONDITIONS, SIGMA, *(f"{name}_{SIGMA}" for name in measured)])
            raise InputError(f"{place} have a column {unknown[0]!r}{why}; allowed: {allowed}")
        for name, x in columns.items():
            least = x.min(initial=math.inf)
            refuse(name != "u_gap" and least <= 0.0, f"{place}: the smallest {name} is {least:g}; allowed: more than 0")
        none = np.zeros(columns[measured[0]].size)
        at, u, depth = columns.get("fn", none + fn), columns.get("u_gap", none), columns.get("indentation")
        if depth is not None and np.any(u != 0.0):
            raise InputError(f"{place} have the columns indentation and u_gap; allowed: indentations without voltage")
        for name in measured:
            values, sigma = columns[name], columns.get(sigmas[name])
            if name == "area" and depth is not None:
                found.setdefault(("indentation", sigma is None), []).append((values, sigma, at, none, depth))
            if name != "area" or depth is None or "fn" in columns:
                found.setdefault((name, sigma is None), []).append((values, sigma, at, u, none))
    # Values of one kind are one relation, whichever data they come from.
    return tuple(
        Relation(kind, *(None if x[0] is None else np.concatenate(x) for x in zip(*own, strict=True)))  # type: ignore
        for (kind, _), own in found.items()
    )


def _meaning(name: str, names: Sequence[str]) -> tuple[str, str, str | None]:
    key, measured = name.lower(), [own for own in MEASURED if own in map(str.lower, names)]
    values = measured[0] if key == SIGMA and len(measured) == 1 else key.removesuffix(f"_{SIGMA}")
    return key, values, (MEASURED | CONDITIONS).get(values)


@dataclass(frozen=True)
class Task(Problem):
    """The fit of a contact; the scale of a relation without sigma is the standard deviation of the logarithms."""

    gap: str  # Name of the GAP
    relations: tuple[Relation, ...]

    def split(self, x: Any) -> list[Any]:
        """Each relation's part of a row over all data."""
        return np.split(x, np.cumsum([one.values.size for one in self.relations])[:-1])

    def predict(self, values: FloatArray) -> list[FloatArray]:
        """Each relation's values as the contact has them."""
        changed = self.circuit.varied(dict(zip(self.names, values.tolist(), strict=True)))
        own = build_stack(changed).contact if loop_of(changed) else None
        contact = contact_of(changed[self.gap]) if own is None else own
        assert isinstance(contact, JkrContact)
        return [relation.predicted(contact) for relation in self.relations]

    def misses(self, values: FloatArray) -> FloatArray:
        parts = []
        for relation, found in zip(self.relations, self.predict(values), strict=True):
            if relation.sigma is None and not np.all(found > 0.0):
                raise InputError("friction leaves no area; allowed: a smaller c2")
            parts.append(found - relation.values if relation.sigma is not None else np.log(found / relation.values))
        return np.concatenate(parts) / self.scale

    def remedy(self, names: tuple[str, ...]) -> str:
        bare, kinds = {name.rpartition(".")[2] for name in names}, {one.kind for one in self.relations}
        loads = {fn for one in self.relations if one.kind != "indentation" for fn in one.fn.tolist()}
        what = "over a wider range of loads"
        if bare <= {"alpha", "m_exp"}:
            what = f"the area {what if len(loads) > 1 else 'at a second load as well'}"
        elif bare <= {"beta", "n_exp"}:
            known = "indentation" in kinds
            what = f"the area {'over a wider range of indentations' if known else 'against the indentation as well'}"
        elif "area" not in kinds and "c2" in bare:
            what = "the area at rest as well"
        elif bare & {"beta", "n_exp"}:
            what = "the area against the indentation, or under a higher voltage"
        return f"Measure {what}, or fix one of them."


@dataclass(frozen=True, repr=False, kw_only=True)
class ContactFit(FitResult):
    """A fit of a contact to data; `circuit` is ready to run.

    Attributes
    ----------
    circuit, estimates, correlation, count, evaluations, closed, notes, profiles
        As of `Fit`.
    gap : str
        Name of the GAP.
    relations : tuple of Relation
        The data, by kind.
    predicted, sigma : tuple of ndarray
        Values and standard deviations of every relation, as the fit has them.
    objective, freedom : float, int
        Sum of the squared residuals over sigma; data less parameters.
    reach : dict of str to float
        Half of each interval in the logarithm over the standard error: Student's t, with the degrees of freedom of the
        relations that the parameter is known from.
    """

    gap: str
    relations: tuple[Relation, ...]
    predicted: tuple[FloatArray, ...]
    sigma: tuple[FloatArray, ...]
    reach: dict[str, float]

    @property
    def misfits(self) -> tuple[float, ...]:
        """Root mean square of the logarithm of prediction over data, of every relation."""
        pairs = zip(self.predicted, self.relations, strict=True)
        return tuple(float(np.sqrt(np.mean(np.log(np.maximum(x, 1e-300) / one.values) ** 2))) for x, one in pairs)

    @property
    def values(self) -> dict[str, float]:
        """Fitted values by path, as `Circuit.replace` takes them."""
        return {path: one.value for path, one in self.estimates.items()}

    @property
    def line(self) -> str:
        """The fitted parameters as a netlist has them."""
        return " ".join(f"{path.rpartition('.')[2]}={value:.6g}" for path, value in self.values.items())

    def _page(self) -> Page:
        about = []
        for one, misfit in zip(self.relations, self.misfits, strict=True):
            known = "sigma as given" if one.sigma is not None else "sigma estimated from the residuals"
            about.append(f"{one.name}: {one.values.size} values, residual {100.0 * misfit:.3g} % rms; {known}")
        head = f"contact of {self.gap}: {len(self.estimates)} parameters fitted to {self.count} values"
        return self._paged(head, about, "", f"in the deck: {self.gap} ... {self.line}")

    def _panels(self) -> list[Any]:
        panels = []
        for one, fitted, sigma in zip(self.relations, self.predicted, self.sigma, strict=True):
            under = [("normal load", "N", one.fn), ("gap voltage", "V", one.u_gap)]
            if one.kind == "indentation":
                under = [("indentation", "mm", 1e3 * one.indentation)]
            panels.append(self._panel(under, [], one.name, MEASURED.get(one.kind, "m^2"), one.values, fitted, sigma))
        return panels

    def to_dict(self) -> dict[str, Any]:
        pairs = zip(self.relations, self.misfits, strict=True)
        rows = [{"kind": one.kind, "count": int(one.values.size), "misfit": misfit} for one, misfit in pairs]
        return {"gap": self.gap, **super().to_dict(), "relations": rows}

    def _columns(self) -> dict[str, Any]:
        rows = zip(*((one.fn, one.u_gap, one.indentation, one.values) for one in self.relations), strict=True)
        names = ("fn", "u_gap", "indentation", "measured", "fitted", "sigma")
        columns = map(np.concatenate, (*rows, self.predicted, self.sigma))
        kinds = [one.kind for one in self.relations for _ in one.values]
        return {"relation": kinds, **dict(zip(names, columns, strict=True))}


def fit_contact(
    circuit: Circuit,
    data: Given | Sequence[Given],
    parameters: Sequence[str] | None = None,
    *,
    finger: str | None = None,
    bounds: Mapping[str, tuple[float, float]] | None = None,
    profiles: bool | Sequence[str] = False,
) -> ContactFit:
    """Fit the contact of a GAP (Eqs. 1 to 6) to measured ridge areas and friction forces.

    Parameters
    ----------
    circuit : Circuit
        With the values to start from, and those that are not fitted.
    data : mapping of str to array_like, shape (n,), or path, or a list of these
        Measured columns: ``area`` (m^2, at rest), ``area_sliding`` (m^2) and ``f_t`` (N, friction force); conditions:
        ``fn`` (N, normal load; the circuit's if missing), ``indentation`` (m) and ``u_gap`` (V, across the gap; 0 if
        missing). Standard deviations: ``sigma``, or ``area_sigma`` and so on where there are several measured columns;
        without, they are equal shares of the values, estimated from the residuals: one share for the areas under loads,
        one for those by indentation, one for the friction forces. A table (CSV) has the columns in a header, with
        units: ``fn (N), area (mm^2)``.
    parameters : sequence of str, optional
        Which of alpha, m_exp, beta, n_exp, mu and c2 to fit; by default all that the data depend on.
    finger : str, optional
        Name of the GAP, where there are several.
    bounds : mapping of str to tuple of float, optional
        Smallest and largest value by parameter, in the unit of the netlist.
    profiles : bool or sequence of str
        Parameters whose profile likelihood is wanted, or True for all.

    Raises
    ------
    InputError
        If a column, unit or parameter is unknown, or there are fewer data than parameters.

    Warns
    -----
    FingerspiceWarning
        If a relation misses its data by more than 20 % rms, or a value is unusual, and then probably in another unit.
    """
    require_circuit(circuit)
    gap = _gap(circuit, finger)
    own = circuit[gap].values

    def named(name: str) -> str:
        # A parameter may be given without its GAP.
        return name if "." in name else f"{gap}.{name}"

    relations = _relations_of(data, own["fn"])
    loads = np.concatenate([relation.fn for relation in relations])
    heavy = DEVICES["GAP"].parameter("fn").unusual("the data's largest", float(loads.max()))
    if heavy is not None:
        warnings.warn(heavy, FingerspiceWarning, stacklevel=2)
    names = _wanted(parameters, relations, gap)
    # The smallest load lets any contact be that is one under some load; at rest friction takes nothing off it.
    begin = {f"{gap}.fn": float(loads.min())}
    begin |= {f"{gap}.c2": 0.0} if {one.kind for one in relations} <= {"area", "indentation"} else {}
    # What is fitted in its logarithm cannot start at 0.
    begin |= {f"{gap}.{name}": DEVICES["GAP"].parameter(name).default or 0.0 for name in names if own[name] == 0.0}
    scale = np.concatenate([np.full(one.values.size, _SHARE) if one.sigma is None else one.sigma for one in relations])
    paths = tuple(map(named, names))
    limits = {named(path): pair for path, pair in (bounds or {}).items()}
    asked = profiles if isinstance(profiles, bool) else [named(path) for path in profiles]
    task = Task(circuit.varied(begin), paths, paths, scale, gap, relations).begun(limits, asked)
    task, best, pools = _solved(task)
    if best.objective >= NOT_FOUND:
        said = f"the contact of {gap} cannot be started from: friction leaves no area under the loads of the data"
        raise InputError(f"{said}; allowed: values nearer to the data, such as a smaller c2 or a larger alpha")
    # With the warnings that a user who writes these values would get.
    try:
        fitted = circuit.replace(dict(zip(paths, best.values.tolist(), strict=True)))
    except InputError as refused:
        raise InputError(f"the fitted values do not go with the circuit's others: {refused.message}") from None
    variance, reach, notes = _errors(task, best, pools)
    predicted = task.predict(best.values)
    sized = zip(relations, predicted, task.split(task.scale), strict=True)
    found = ContactFit._reported(
        task, best, variance, reach, notes, circuit=fitted, gap=gap, relations=relations, predicted=tuple(predicted),
        sigma=tuple(one.sigma if one.sigma is not None else share * values for one, values, share in sized),
        freedom=scale.size - len(paths), reach=dict(zip(paths, reach.tolist(), strict=True)),
    )  # fmt: skip
    for relation, misfit in zip(relations, found.misfits, strict=True):
        if misfit > _TOO_MUCH:
            said = f"the {relation.name} misses the data by {100.0 * misfit:.2g} % rms; its relation may not hold for"
            warnings.warn(f"{said} them, or a column is in another unit", FingerspiceWarning, stacklevel=2)
    return found


def _gap(circuit: Circuit, finger: str | None) -> str:
    gaps = {e.name.lower(): e.name for e in circuit.by_device("GAP")}
    known = ", ".join(gaps.values())
    refuse(not gaps, "this circuit has no GAP; allowed: a circuit with a finger, whose contact is fitted")
    refuse(finger is None and len(gaps) > 1, f"this circuit has several GAPs; allowed: finger= one of {known}")
    name = next(iter(gaps.values())) if finger is None else gaps.get(finger.lower(), "")
    require(bool(name), "finger", repr(finger), f"the name of a GAP, {known}")
    law = circuit[name].law
    require(law is None, f"{name}.law", repr(law and law.name), "'jkr', whose parameters are fitted here")
    p_sat = circuit[name].values["p_sat"]
    require(math.isinf(p_sat), f"{name}.p_sat", f"{p_sat:g} Pa", "inf, as the contact's friction is mu times its load")
    fixed = circuit[name].values["a_fix"]
    require(fixed == 0.0, f"{name}.a_fix", f"{fixed:g} mm^2", "0, as a given area follows no contact")
    return name


def _wanted(given: Sequence[str] | None, relations: Sequence[Relation], gap: str) -> tuple[str, ...]:
    """The parameters to fit, in the order of the netlist."""
    if given is None:
        kinds, loaded = {one.kind for one in relations}, any(one.kind.startswith("area") for one in relations)
        pressed = "indentation" in kinds or (loaded and any(np.any(one.u_gap != 0.0) for one in relations))
        return tuple(compress(PARAMETERS, (loaded, loaded, pressed, pressed, "f_t" in kinds, "area_sliding" in kinds)))
    known = ", ".join(PARAMETERS)
    require(bool(given) and not isinstance(given, str), "parameters", repr(given), f"a sequence of {known}")
    bare = [name.lower().removeprefix(f"{gap.lower()}.") for name in given]
    for name in bare:
        require(name in PARAMETERS, "parameters", repr(name), known)
        require(bare.count(name) == 1, name, "named twice", "once")
    return tuple(name for name in PARAMETERS if name in bare)


def _solved(task: Task) -> tuple[Task, Fitted, list[Pool]]:
    """Least squares, with the standard deviation of every pool that has none from its own residuals, found in rounds.

    Ridge areas against the load are a pool, from one set of images. Parameters take up of values their leverages.
    """
    from scipy.linalg import orth

    members: dict[tuple[str, bool], list[tuple[str, IntArray]]] = {}
    for relation, at in zip(task.relations, task.split(np.arange(task.scale.size)), strict=True):
        key = relation.kind.removesuffix("_sliding"), relation.sigma is None
        members.setdefault(key, []).append((relation.name, at))
    begin = task.initial
    for _ in range(_ROUNDS):
        best, pools = followed(task.residuals, task.box, begin), list[Pool]()
        leverage, scale = np.sum(orth(best.by_log, _LEAST) ** 2, axis=1), task.scale.copy()
        for (_, unknown), own in members.items():
            at = np.concatenate([at for _, at in own])
            freedom = at.size - float(leverage[at].sum()) if unknown else math.inf
            pools.append((" and the ".join(name for name, _ in own), at, freedom))
            if _FEWEST <= freedom < math.inf:
                spread = float(np.sqrt(np.sum(best.residual[at] ** 2) / freedom))
                scale[at] = np.maximum(scale[at] * spread, _LEAST)
        if np.abs(np.log(scale / task.scale)).max() < _SETTLED:
            break
        task, begin = replace(task, scale=scale), best.values
    return task, best, pools


def _errors(task: Task, best: Fitted, pools: Sequence[Pool]) -> tuple[FloatArray, FloatArray, list[str]]:
    """Variance of every parameter's residuals over their scale, Student's t with the freedom of Satterthwaite, notes.

    (F. E. Satterthwaite, Biometrics Bulletin 2, 110, 1946.) Each pool has its own variance, known from its own
    residuals, and a part in the variance of a parameter; without a measure of one that has a part, nothing is known.
    """
    from scipy.stats import t

    covariance, left = best.covariance, np.array([freedom for _, _, freedom in pools])
    parts = np.array([np.sum((covariance @ best.by_log[at].T) ** 2, axis=1) for _, at, _ in pools])
    shares = parts / np.maximum(parts.sum(axis=0), 1e-300)
    with np.errstate(divide="ignore", invalid="ignore"):
        each = shares**2 / np.where(left >= _FEWEST, left, 0.0)[:, None]
        inverse = np.where(shares > _NO_PART, each, 0.0).sum(axis=0)
        reach = t.ppf(0.975, 1.0 / inverse)
    known, notes = np.isfinite(inverse), list[str]()
    for name, at, freedom in pools:
        if freedom < _FEWEST:
            few = f"Of the {name} there are hardly more values ({at.size}) than parameters"
            notes.append(f"{few}, which leaves no measure of their errors: measure more of them, or give sigma.")
        if math.isinf(freedom):
            notes += best.beyond_sigma(at, at.size, f" of the {name}")
    if f"{task.gap}.c2" in task.names and f"{task.gap}.mu" not in task.names:
        mu = task.circuit[task.gap].values["mu"]
        told = f"c2 holds for the circuit's mu = {mu:g}: these data tell only c2 mu^2."
        notes.append(f"{told} Measure the friction force.")
    return np.where(known, 1.0, math.inf), np.where(known, reach, math.inf), notes


# Which law

#: Laws whose criteria differ by less are not told apart (Burnham and Anderson 2002, section 2.6).
NOT_TOLD_APART = 2.0


@dataclass(frozen=True, repr=False)
class LawComparison(Shown):
    """Fits of one set of data under several contact laws.

    Attributes
    ----------
    fits : dict of str to Fit
        By the name of the law, the best first.
    aic : dict of str to float
        Akaike's criterion for few data (AICc) of each; the smallest belongs to the best law.
    """

    fits: dict[str, Fit]
    aic: dict[str, float]

    @property
    def best(self) -> str:
        """Name of the law with the smallest criterion."""
        return next(iter(self.fits))

    @property
    def weights(self) -> dict[str, float]:
        """Akaike weights: how likely each law is the best of them, of data like these."""
        likely = np.exp(-0.5 * (np.array([*self.aic.values()]) - self.aic[self.best]))
        return dict(zip(self.aic, (likely / likely.sum()).tolist(), strict=True))

    @property
    def told_apart(self) -> bool:
        """Whether the data tell the best law from every other."""
        return all(x - self.aic[self.best] >= NOT_TOLD_APART for name, x in self.aic.items() if name != self.best)

    def _page(self) -> Page:
        rows = [
            (name, str(len(one.estimates)), f"{one._rms:.4g}", f"{self.aic[name] - self.aic[self.best]:.2f}",
             f"{self.weights[name]:.2f}", ", ".join(f"{e.path} = {e.value:.4g}" for e in one.estimates.values()))
            for name, one in self.fits.items()
        ]  # fmt: skip
        head = "law", "parameters", "rms residual", "AICc above the best", "weight", "fitted"
        close = [x for x in self.fits if x != self.best and self.aic[x] - self.aic[self.best] < NOT_TOLD_APART]
        said = f"{self.best} explains these data best"
        said += f", but they do not tell it from {', '.join(close)}" if close else " of these laws"
        return Page([f"{said}.", "", Table(head, rows)])

    def to_dict(self) -> dict[str, Any]:
        """The comparison as plain data, SI units."""
        one = {"best": self.best, "aic": dict(self.aic), "weights": self.weights, "told_apart": self.told_apart}
        return one | {"fits": {name: found.to_dict() for name, found in self.fits.items()}}


def compare_laws(
    circuit: Circuit, data: Given, laws: Mapping[str | ContactLaw, Sequence[str]], **how: Any
) -> LawComparison:
    """Fit data under several contact laws, and say which explains them best, or that the data cannot tell.

    Parameters
    ----------
    circuit : Circuit
        With one GAP, and the values to start from.
    data : mapping of str to array_like, shape (n,), or path
        As of `fit`, but no impedances. Without ``sigma`` errors are taken as equal for all, or as equal shares of the
        values, whichever is likelier, and the same for all laws.
    laws : mapping of str or ContactLaw to sequence of str
        The laws, and the paths of the parameters that are fitted under each.
    **how
        As of `fit`.

    Returns
    -------
    LawComparison

    Raises
    ------
    InputError
        As `fit`; and for fewer than two laws, several GAPs, or data that are no more than a law's parameters and two.
    """
    require_circuit(circuit)
    gaps = [gap.name for gap in circuit.by_device("GAP")]
    refuse(len(gaps) != 1, f"laws are compared of one GAP; this circuit has {', '.join(gaps) or 'none'}")
    refuse(len(laws) < 2, f"{len(laws)} laws are given; allowed: two or more, such as {{'jkr': [...], 'dmt': [...]}}")
    named = [law.name if isinstance(law, ContactLaw) else law for law in laws]
    under = [circuit.replace({f"{gaps[0]}.law": law}) for law in laws]
    fits = {name: fit(one, data, paths, **how) for name, one, paths in zip(named, under, laws.values(), strict=True)}
    refuse(any(one.data.signal == "impedance" for one in fits.values()), "laws are compared by means or signals")
    values = next(iter(fits.values())).data.values
    sizes = [np.full(values.size, 1.0), np.abs(values)] if np.all(values != 0.0) else [np.full(values.size, 1.0)]
    found = [_criteria(fits, size) for size in sizes]
    aic = min(found, key=lambda criteria: min(criteria.values()))
    order = sorted(fits, key=aic.__getitem__)
    return LawComparison({name: fits[name] for name in order}, {name: aic[name] for name in order})


def _criteria(fits: Mapping[str, Fit], size: Any) -> dict[str, float]:
    """AICc of fits whose errors, where they are not given, are in proportion to `size`."""
    out = {}
    for name, one in fits.items():
        n, known = one.data.values.size, one.data.sigma
        k = len(one.estimates) + (known is None)
        refuse(
            n - k - 1 < 1, f"{n} data are too few to judge {name} with {k} numbers to find; allowed: {k + 2} or more"
        )
        off = one.residual / (size if known is None else known)
        deviance = n * math.log(float(np.mean(off**2)) or 1e-300) + 2.0 * float(np.log(size).sum())
        deviance = float((off**2).sum()) if known is not None else deviance
        out[name] = deviance + 2.0 * k + 2.0 * k * (k + 1.0) / (n - k - 1.0)
    return out
