"""Fit of a circuit's parameters to measured means or signals, by least squares with exact derivatives."""

from __future__ import annotations

import itertools
import math
import time
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from fingerspice.base.announcing import Bar
from fingerspice.base.arrays import FloatArray, whole_number
from fingerspice.base.errors import FingerspiceWarning, InputError
from fingerspice.base.pages import Page, Table
from fingerspice.circuit.circuit import Circuit
from fingerspice.circuit.describe import meaning_of, require_circuit, scenes_warnings
from fingerspice.results.record import SIGNALS
from fingerspice.solve.simulation import rtol_given
from fingerspice.studies.fit.circuitdata import IMPEDANCE, MEASURED, Data, Task, data_of
from fingerspice.studies.fit.result import (
    FARTHEST,
    Drawn,
    FitResult,
    Fitted,
    Unknown,
    bounded,
    estimated,
    followed,
    misfit_note,
    profile_of,
)
from fingerspice.waveforms.waveform import require

# Starts lie within this factor of the parameters given, where no bounds are; and how many of them are followed.
_SPREAD, _FOLLOWED = 4.0, 3
# Errors of unknown size are equal shares of the data unless errors equal for all are likelier by this logarithm. The
# choice takes a degree of freedom, and is made where so many are there; else errors are taken as equal.
_CLEARLY, _CHOOSING = 2.0, 4
# Error of the means by which starts are compared.
_ROUGH = 1e-5


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

    @property
    def _count(self) -> int:
        return self.data.target.size

    def _page(self) -> Page:
        data = self.data
        share = 100.0 * self._rms / (float(np.abs(data.values).max()) or 1.0)
        equal = float(np.ptp(self.sigma)) <= 1e-9 * float(self.sigma.max())
        noise = f"estimated from the residuals, {'equal for all' if equal else 'as equal shares of the values'}"
        lines: list[str | Table] = [
            self._head(f"{data.values.size} values of {data.name}"),
            f"residual {self._rms:.3g} {MEASURED[data.signal]} rms, {share:.2g} % of the largest value; "
            f"sigma {'as given' if data.sigma is not None else noise}",
        ]
        if data.groups is not None:
            lines.append(f"groups by {data.groups.column}: {', '.join(data.groups.labels)}")
        return Page([*lines, *self._lines()])

    def _panels(self) -> list[Drawn]:
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
        return [(names, (x, data.values, self.predicted, self.sigma), label, signal, MEASURED[data.signal])]

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

    def _columns(self) -> dict[str, Any]:
        data, groups = self.data, self.data.groups
        first = {groups.column: groups.of} if groups is not None else {} if data.t is None else {"t": data.t}
        return {**first, **data.conditions, data.signal: data.values, "fitted": self.predicted, "sigma": self.sigma}


def fit(
    circuit: Circuit,
    data: Mapping[str, ArrayLike] | str | Path,
    parameters: Sequence[str],
    *,
    bounds: Mapping[str, tuple[float, float]] | None = None,
    groups: Mapping[str, Sequence[str]] | None = None,
    average: str = "periodic",
    skin: str = "own",
    charge_law: str | None = None,
    starts: int = 8,
    rtol: float = 1e-7,
    profiles: bool | Sequence[str] = False,
) -> Fit:
    """Fit parameters of a circuit to measured data, by least squares in their logarithms.

    Parameters
    ----------
    circuit : Circuit
        With the values to start from.
    data : mapping of str to array_like, shape (n,), or path
        Columns: the measured means (``f_el_mean``, ``f_t_mean``, ``friction_mean`` or ``area_mean``) and the conditions
        under which they were measured, as paths (``Vdrive.amplitude``, ``source.frequency``, ``Xgap.fn``); or ``t``
        and a signal over time (``f_el``, ``f_t``, ``friction``, ``area``, ``u_gap``); or ``frequency`` and
        ``impedance``, the magnitude (ohm) of what the source sees, with ``impedance_phase`` (deg) where it is known.
        ``sigma`` is the standard deviation of every value; where it is missing, it is estimated from the residuals, as
        equal shares of the values or, where that is clearly likelier, as equal for all (so, too, of signals over time,
        and where hardly more data than parameters are given; of impedances always as equal shares). A table (CSV) has
        the columns in a header, with units: ``Vdrive.amplitude (V), f_el_mean (mN)``.
    parameters : sequence of str
        Paths of the parameters to fit.
    bounds : mapping of str to tuple of float, optional
        Smallest and largest value by path; a thousandth and a thousand times the start by default.
    groups : mapping of str to sequence of str, optional
        The column that tells which measurements belong together, and the parameters of which every such group has its
        own: ``{"finger": ["Xgap.d"]}``. The others are the same for all.
    average : str
        ``"periodic"`` (means over a period of the periodic state) or ``"run"`` (over the deck's run).
    skin : str
        ``"own"`` (a SKIN keeps its `f`) or ``"follow"`` (its `f` is the source's frequency).
    charge_law : str, optional
        As in `simulate`.
    starts : int
        Values from which the fit may start: those of the circuit, and others around them. The best three are followed.
    rtol : float
        Error of every run.
    profiles : bool or sequence of str
        Paths whose profile likelihood is wanted, or True for all: the data are fitted again and again with the
        parameter held at values ever farther away, until the fit is too bad.

    Returns
    -------
    Fit

    Raises
    ------
    InputError
        If a column, unit or path is unknown, there are fewer data than parameters, or no start can be run.
    """
    require_circuit(circuit)
    starts, rtol = whole_number("starts", starts, 1), rtol_given(rtol)
    measured, unknowns = _request(circuit, data, parameters, groups)
    require(average in ("periodic", "run"), "average", repr(average), "'periodic' or 'run'")
    require(skin in ("own", "follow"), "skin", repr(skin), "'own' or 'follow'")
    start, box = bounded(circuit, unknowns, measured.target.size, bounds or {})
    bar, begun, count = Bar("fitting", endless=True), time.perf_counter(), itertools.count(1)

    def watch() -> None:
        number = next(count)
        if time.perf_counter() - begun > 1.0:
            bar.show(note=f"evaluation {number}")

    task = Task(start, unknowns, box, measured.scale, measured, average, skin, rtol, charge_law, watch)
    wanted = task.profiled(profiles)
    said = [*measured.unusual(), *scenes_warnings(circuit, None, measured.conditions, skin)]
    for text in filter(None, said):
        warnings.warn(text, FingerspiceWarning, stacklevel=2)
    try:
        return _fitted(task, starts, wanted)
    finally:
        bar.stop()


def _fitted(free: Task, starts: int, wanted: Sequence[str]) -> Fit:
    """The fit, with the profiles `wanted`."""
    from scipy.stats import norm, t

    data, n = free.data, free.data.values.size
    # Where no bounds are given, nothing is looked for far from the start: there are no likely values, and slow runs.
    (low, high), near, far = free.bounds.T, free.initial / FARTHEST, free.initial * FARTHEST
    walls = np.column_stack([np.where(low > 0.0, low, near), np.where(high < math.inf, high, far)])
    task = replace(free, bounds=walls)
    ends = [followed(task.residuals, walls, begin) for begin in _starts(task, starts)]
    best = min(ends, key=lambda end: end.objective)
    if not best.found:
        raise InputError(
            "none of the starts can be run: there is no contact, no solution, or a value out of range; allowed: a "
            "circuit that runs under the conditions of the data"
        )
    freedom = best.residual.size - len(task.unknowns)
    if data.sigma is None and data.t is None and data.signal != IMPEDANCE and freedom >= _CHOOSING:
        task, ends = _with_likelier_noise(task, ends, best)
        best = min(ends, key=lambda end: end.objective)
        freedom -= 1
    # Variance of the residuals over their scale, and half a 95 % interval over a standard error.
    variance, reach = math.inf, math.inf
    if data.sigma is not None:
        variance, reach = 1.0, float(norm.ppf(0.975))
    elif freedom > 0:
        variance, reach = best.objective / freedom, float(t.ppf(0.975, freedom))
    error, remedy = np.sqrt(np.diag(best.covariance) * variance), data.remedy(task.circuit)

    def of_group(label: str) -> Circuit:
        own = zip(task.unknowns, best.values.tolist(), strict=True)
        return task.circuit.varied({one.path: value for one, value in own if one.label in (None, label)})

    found = Fit(
        **estimated(
            task, best, error, [reach] * error.size, lambda _: remedy,
            misfit_note(best.objective, freedom) if data.sigma is not None else [],
        ),
        data=data,
        predicted=data.values + (best.residual * task.scale)[:n],
        sigma=data.sigma if data.sigma is not None else math.sqrt(variance) * task.scale[:n],
        objectives=tuple(end.objective for end in ends),
        freedom=freedom,
        # The geometric mean of one value is that value to the last digit.
        circuit=task.circuit.varied(
            {path: float(np.prod(best.values[own] ** (1.0 / len(own)))) for path, own in task.places.items()}
        ),
        circuits={label: of_group(label) for label in (data.groups.labels if data.groups is not None else ())},
    )  # fmt: skip
    # Of chi squared and F with one degree of freedom, quantiles are the squares of those of the normal distribution
    # and of Student's (Bates and Watts, Nonlinear regression analysis, 1988, section 6.1).
    task, room = replace(task, bounds=free.bounds), variance * reach**2
    found.profiles.update((name, profile_of(task, best, found.estimates[name], room)) for name in wanted)
    return found


def _with_likelier_noise(task: Task, ends: list[Fitted], best: Fitted) -> tuple[Task, list[Fitted]]:
    """The fits with errors that are equal shares of the data, or, where this is clearly likelier, equal for all.

    The largest likelihood of normal errors of unknown size is RSS^(-n/2) over the product of the scales.
    """
    predicted = np.abs(task.data.target + best.residual * task.scale)
    if not np.all(predicted > 0.0) or best.objective == 0.0:
        return task, ends
    shares = replace(task, scale=predicted)
    others = [followed(shares.residuals, shares.bounds, end.values) for end in ends]
    least, n = min(end.objective for end in others), predicted.size
    equal = 0.5 * n * math.log(best.objective) + float(np.log(task.scale).sum())
    likelier = 0.5 * n * math.log(least) + float(np.log(predicted).sum()) < equal + _CLEARLY
    return (shares, others) if likelier else (task, ends)


def _request(
    circuit: Circuit, given: Mapping[str, ArrayLike] | str | Path, parameters: Sequence[str],
    groups: Mapping[str, Sequence[str]] | None,
) -> tuple[Data, tuple[Unknown, ...]]:  # fmt: skip
    """The checked data, and what is to be fitted to them."""
    if isinstance(parameters, str) or not parameters:
        raise InputError(f"parameters is {parameters!r}; allowed: a sequence of paths such as ['Xgap.d', 'Xgap.r']")
    known = {path.lower(): path for path in circuit.parameters}
    for path in parameters:
        if path.lower() not in known:
            circuit.varied({path: 1.0})
    paths = tuple(known[path.lower()] for path in parameters)
    by: str | None = None
    separate: Sequence[str] = ()
    if groups is not None:
        wanted = "a mapping of a column of the data to the parameters of each group, such as {'finger': ['Xgap.d']}"
        ((by, separate),) = groups.items() if isinstance(groups, Mapping) and len(groups) == 1 else (("", ""),)
        if not isinstance(by, str) or isinstance(separate, str) or not separate:
            raise InputError(f"groups is {groups!r}; allowed: {wanted}")
        if by.lower() in known:
            raise InputError(f"groups names the column {by!r}, which is a parameter; allowed: {wanted}")
    for path in separate:
        if known.get(path.lower()) not in paths:
            raise InputError(f"groups names {path!r}, which is not fitted; allowed: {', '.join(paths)}")
    data = data_of(circuit, given, by)
    for path in paths:
        value = circuit.parameters[path].value
        require(paths.count(path) == 1, path, "named twice", "once")
        if path in data.conditions:
            raise InputError(f"{path} is to be fitted, and is a condition of the data; allowed: one of both")
        if not (math.isfinite(value) and value > 0.0):
            raise InputError(f"{path} is {value:g}, and is fitted in its logarithm; allowed: finite and more than 0")
    own = {known[path.lower()] for path in separate}
    labels = data.groups.labels if data.groups is not None else ()
    return data, tuple(Unknown(path, label) for path in paths for label in (labels if path in own else (None,)))


def _starts(task: Task, count: int) -> list[FloatArray]:
    """The values given, and the best of others around them (a Sobol sequence, always the same)."""
    from scipy.stats import qmc

    initial = task.initial
    if count == 1 or task.data.t is not None or task.data.signal == IMPEDANCE:
        return [initial]
    low = np.maximum(task.bounds[:, 0], initial / _SPREAD)
    high = np.minimum(task.bounds[:, 1], initial * _SPREAD)
    share = qmc.Sobol(initial.size, scramble=False).random_base2(math.ceil(math.log2(count)))[1:count]
    tried = np.vstack([initial, np.exp(np.log(low) + share * np.log(high / low))])
    with warnings.catch_warnings():
        # What there is to say of the data has been said.
        warnings.simplefilter("ignore", FingerspiceWarning)
        tests = task.scenes(tried, _ROUGH)
    found = tests[task.data.name].to_numpy().reshape(len(tried), -1)
    off = (((found - task.data.values) / task.scale) ** 2).sum(axis=1)
    order = np.argsort(np.where(np.isfinite(off), off, math.inf), kind="stable")
    return [initial, *(tried[i] for i in order[:_FOLLOWED].tolist() if i > 0)]
