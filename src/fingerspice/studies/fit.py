"""Fit of a circuit's parameters to measured means or signals, by least squares with exact derivatives."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from fingerspice.base.arrays import FloatArray, whole_number
from fingerspice.base.errors import FingerspiceWarning, InputError
from fingerspice.circuit.arguments import require_circuit
from fingerspice.circuit.circuit import Circuit
from fingerspice.circuit.notices import scenes_warnings
from fingerspice.solve.simulation import rtol_given
from fingerspice.studies.batch.batch import batch
from fingerspice.studies.fitdata import IMPEDANCE, Data, Unknown, data_of, group_column, unknowns_of
from fingerspice.studies.fitresult import Fit, Fitted, fit_result
from fingerspice.studies.fittask import FARTHEST, REFUSED, Task, evaluations_shown, followed, limit_of, profile_of
from fingerspice.waveforms.waveform import require

# Starts lie within this factor of the parameters given, where no bounds are; and how many of them are followed.
_SPREAD, _FOLLOWED = 4.0, 3
# Errors of unknown size are equal shares of the data unless errors equal for all are likelier by this logarithm. The
# choice takes a degree of freedom, and is made where so many are there; else errors are taken as equal.
_CLEARLY, _CHOOSING = 2.0, 4
# Error of the means by which starts are compared.
_ROUGH = 1e-5


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
    table, unknowns = _request(circuit, data, parameters, groups)
    task = _task(circuit, table, unknowns, bounds, average, skin, charge_law, rtol)
    wanted = profiled(tuple(one.name for one in task.unknowns), profiles)
    said = [*table.unusual(), *scenes_warnings(circuit, None, table.conditions, skin)]
    for text in filter(None, said):
        warnings.warn(text, FingerspiceWarning, stacklevel=2)
    with evaluations_shown() as watch:
        return _fitted(replace(task, watch=watch), starts, wanted)


def _fitted(free: Task, starts: int, wanted: Sequence[str]) -> Fit:
    """The fit, with the profiles `wanted`."""
    table, names = free.data, tuple(one.name for one in free.unknowns)
    # Where no bounds are given, nothing is looked for far from the start: there are no likely values, and slow runs.
    (low, high), near, far = free.bounds.T, free.initial / FARTHEST, free.initial * FARTHEST
    walls = np.column_stack([np.where(low > 0.0, low, near), np.where(high < math.inf, high, far)])
    task = replace(free, bounds=walls)
    ends = [followed(task, begin) for begin in _starts(task, starts)]
    best = min(ends, key=lambda end: end.objective)
    if not best.objective < 0.5 * REFUSED**2:
        raise InputError(
            "none of the starts can be run: there is no contact, no solution, or a value out of range; allowed: a "
            "circuit that runs under the conditions of the data"
        )
    spare = task.target.size - len(names)
    chosen = table.sigma is None and table.t is None and table.signal != IMPEDANCE and spare >= _CHOOSING
    if chosen:
        task, ends = _with_likelier_noise(task, ends, best)
        best = min(ends, key=lambda end: end.objective)
    objectives = [end.objective for end in ends]
    found = fit_result(
        task.circuit, table, task.unknowns, task.bounds, best, objectives, task.scale, spare - chosen
    )  # fmt: skip
    limit = limit_of(best.objective, found.freedom, given=table.sigma is not None)
    free = replace(task, bounds=free.bounds)
    return replace(
        found, profiles={name: profile_of(free, names, best, name, _error(found, name), limit) for name in wanted}
    )


def _with_likelier_noise(task: Task, ends: list[Fitted], best: Fitted) -> tuple[Task, list[Fitted]]:
    """The fits with errors that are equal shares of the data, or, where this is clearly likelier, equal for all.

    The largest likelihood of normal errors of unknown size is RSS^(-n/2) over the product of the scales.
    """
    predicted = np.abs(task.target + best.residual * task.scale)
    if not np.all(predicted > 0.0) or best.objective == 0.0:
        return task, ends
    shares = replace(task, scale=predicted)
    others = [followed(shares, end.values) for end in ends]
    least, n = min(end.objective for end in others), predicted.size
    equal = 0.5 * n * math.log(best.objective) + float(np.log(task.scale).sum())
    return (
        (shares, others)
        if 0.5 * n * math.log(least) + float(np.log(predicted).sum()) < equal + _CLEARLY
        else (task, ends)
    )


def _error(found: Fit, path: str) -> float:
    """Standard error of a parameter's logarithm."""
    return found.estimates[path].error / found.estimates[path].value


def profiled(paths: tuple[str, ...], wanted: bool | Sequence[str]) -> list[str]:
    """The paths whose profiles are wanted, in the circuit's own spelling."""
    if isinstance(wanted, bool):
        return list(paths) if wanted else []
    known = {path.lower(): path for path in paths}
    for path in wanted:
        if not isinstance(path, str) or path.lower() not in known:
            raise InputError(f"profiles names {path!r}, which is not fitted; allowed: True, or {', '.join(paths)}")
    return [known[path.lower()] for path in wanted]


def _request(
    circuit: Circuit, data: Mapping[str, ArrayLike] | str | Path, parameters: Sequence[str],
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
    refuse_twice(paths)
    by = group_column(circuit, groups)
    table = data_of(circuit, data, by)
    both = sorted(set(paths) & set(table.conditions))
    if both:
        raise InputError(f"{both[0]} is to be fitted, and is a condition of the data; allowed: one of both")
    for path in paths:
        value = circuit.parameters[path].value
        if not (math.isfinite(value) and value > 0.0):
            raise InputError(f"{path} is {value:g}, and is fitted in its logarithm; allowed: finite and more than 0")
    unknowns = unknowns_of(paths, (groups or {}).get(by or "", ()), table.groups)
    count = table.values.size * (1 if table.phase is None else 2)
    if count < len(unknowns):
        raise InputError(f"{count} data cannot tell {len(unknowns)} parameters; allowed: at least as many data")
    return table, unknowns


def refuse_twice(paths: Sequence[str]) -> None:
    """Refuse a parameter that is named twice."""
    for path in paths:
        require(paths.count(path) == 1, path, "named twice", "once")


def _task(
    circuit: Circuit, table: Data, unknowns: tuple[Unknown, ...], bounds: Mapping[str, tuple[float, float]] | None,
    average: str, skin: str, charge_law: str | None, rtol: float,
) -> Task:  # fmt: skip
    """The checked request."""
    require(average in ("periodic", "run"), "average", repr(average), "'periodic' or 'run'")
    require(skin in ("own", "follow"), "skin", repr(skin), "'own' or 'follow'")
    target, scale = _target(table)
    every = tuple(one.path for one in unknowns)
    circuit, box = bounds_of(circuit, every, bounds or {})
    return Task(circuit, table, unknowns, box, average, skin, rtol, charge_law, target, scale)


def _target(table: Data) -> tuple[FloatArray, FloatArray]:
    """What is to be predicted, and its scale: sigma, or the largest value; of an impedance each value's own size."""
    sizes = np.abs(table.values)
    if table.signal != IMPEDANCE:
        scale = table.sigma if table.sigma is not None else np.full(sizes.size, float(sizes.max()) or 1.0)
        return table.values, scale
    scale = table.sigma if table.sigma is not None else sizes
    if table.phase is None:
        return table.values, scale
    # An error of the complex impedance, equal in all directions, is as large across as along.
    return np.concatenate([table.values, table.phase]), np.concatenate([scale, np.degrees(scale / sizes)])


def bounds_of(
    circuit: Circuit, paths: tuple[str, ...], given: Mapping[str, tuple[float, float]]
) -> tuple[Circuit, FloatArray]:
    """The circuit to start from, and smallest and largest values, shape (n_parameter, 2): 0 and infinity by default.

    A start outside its bounds moves to the nearer one, with a warning.
    """
    lower = {path.lower(): tuple(pair) for path, pair in given.items()}
    unknown = [path for path in given if path.lower() not in {p.lower() for p in paths}]
    if unknown:
        raise InputError(f"bounds names {unknown[0]}, which is not fitted; allowed: {', '.join(paths)}")
    out = np.tile([0.0, math.inf], (len(paths), 1))
    for i, path in enumerate(paths):
        if path.lower() in lower:
            pair = lower[path.lower()]
            if len(pair) != 2 or not 0.0 <= pair[0] < pair[1]:
                raise InputError(f"bounds of {path} are {pair}; allowed: two values with 0 <= low < high")
            out[i] = pair
            value = circuit.parameters[path].value
            moved = min(max(value, pair[0]), pair[1])
            if moved != value:
                said = f"{path} is {value:g}, outside its bounds {pair[0]:g} to {pair[1]:g}: it starts at {moved:g}"
                warnings.warn(said, FingerspiceWarning, stacklevel=4)
                circuit = circuit.varied({path: moved})
    return circuit, out


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
    rows, n = task.data.values.size, len(tried)
    table = {path: np.tile(x, n) for path, x in task.data.conditions.items()}
    for path in dict.fromkeys(one.path for one in task.unknowns):
        own = [k for k, one in enumerate(task.unknowns) if one.path == path]
        table[path] = (tried[:, own] @ task.members[own]).ravel()
    periodic = task.average == "periodic"
    with warnings.catch_warnings():
        # What there is to say of the data has been said.
        warnings.simplefilter("ignore", FingerspiceWarning)
        tests = batch(
            task.circuit, table, outputs=(task.data.name,), rtol=_ROUGH, periodic=periodic, skin=task.skin
        )  # fmt: skip
    found = tests[task.data.name].to_numpy().reshape(n, rows)
    off = (((found - task.data.values) / task.scale) ** 2).sum(axis=1)
    order = np.argsort(np.where(np.isfinite(off), off, math.inf), kind="stable")
    return [initial, *(tried[i] for i in order[:_FOLLOWED].tolist() if i > 0)]
