"""Fit of a circuit's parameters to measured means or signals, by least squares with exact derivatives."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from fingerspice.base.arrays import FloatArray
from fingerspice.base.errors import FingerspiceWarning, InputError
from fingerspice.circuit.arguments import require_circuit, require_number
from fingerspice.circuit.circuit import Circuit
from fingerspice.circuit.statespace import build_stack, is_stack
from fingerspice.results.outcome import SolveError
from fingerspice.solve.simulation import RTOL_RANGE, simulate
from fingerspice.studies.batch import batch
from fingerspice.studies.fitdata import Data, data_of
from fingerspice.studies.fitresult import Fit, Fitted, fit_result
from fingerspice.studies.steady import steady_state
from fingerspice.waveforms.waveform import require

# Starts lie within this factor of the parameters given, where no bounds are; and how many of them are followed.
_SPREAD, _FOLLOWED = 4.0, 3
# Relative step of a difference, where derivatives are not exact: of networks.
_STEP = 1e-4
# What a scene that cannot be run counts as, over the scale of the data.
_REFUSED = 1e6
# Error of the least squares' last step, relative, and of the means by which starts are compared.
_CLOSE, _ROUGH = 1e-8, 1e-3


@dataclass(frozen=True)
class Task:
    """What is fitted.

    Attributes
    ----------
    circuit : Circuit
        With the values to start from.
    data : Data
    paths : tuple of str
    bounds : ndarray, shape (n_parameter, 2)
        Smallest and largest values.
    average : str
    skin : str
    rtol : float
    charge_law : str or None
    scale : ndarray, shape (n,)
        By which residuals are divided.
    exact : bool
        Whether derivatives are those of a series stack, and not differences.
    """

    circuit: Circuit
    data: Data
    paths: tuple[str, ...]
    bounds: FloatArray
    average: str
    skin: str
    rtol: float
    charge_law: str | None
    scale: FloatArray
    exact: bool

    @property
    def initial(self) -> FloatArray:
        """Values to start from."""
        return np.array([self.circuit.parameters[path].value for path in self.paths])

    def scene(self, values: FloatArray, row: int) -> Circuit:
        """The circuit of one measurement."""
        changes = {path: float(x[row]) for path, x in self.data.conditions.items()}
        changed = self.circuit.varied(changes | dict(zip(self.paths, values.tolist(), strict=True)))
        if self.skin == "follow":
            fundamental = build_stack(changed).waveform.fundamental if is_stack(changed) else None
            skins = {f"{e.name}.f": fundamental.frequency for e in changed.by_device("SKIN") if fundamental is not None}
            changed = changed.varied(skins)
        return changed

    def predict(self, values: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Predicted data (n,), and their derivatives by the logarithms of the parameters (n, n_parameter)."""
        if self.exact:
            return self._predicted(values, self.paths)
        middle, _ = self._predicted(values, ())
        by = np.empty((middle.size, values.size))
        for k in range(values.size):
            pair = []
            for sign in (-1.0, 1.0):
                moved = values.copy()
                moved[k] *= 1.0 + sign * _STEP
                pair.append(self._predicted(moved, ())[0])
            by[:, k] = (pair[1] - pair[0]) / (2.0 * _STEP)
        return middle, by

    def _predicted(self, values: FloatArray, paths: tuple[str, ...]) -> tuple[FloatArray, FloatArray]:
        data, how = self.data, {"rtol": self.rtol, "charge_law": self.charge_law, "charge": False}
        if data.t is not None:
            run = simulate(self.scene(values, 0), t_eval=data.t, sensitivities=paths, **how)  # type: ignore[arg-type]
            slopes = [getattr(run.sensitivities[path], data.signal) for path in paths]
            return np.asarray(getattr(run, data.signal)), np.array(slopes).reshape(len(paths), -1).T * values[
                : len(paths)
            ]
        name, found, by = f"{data.signal}_mean", np.empty(data.values.size), np.empty((data.values.size, len(paths)))
        for row in range(data.values.size):
            circuit = self.scene(values, row)
            if self.average == "periodic":
                one = steady_state(circuit, sensitivities=paths, points=4, **how)  # type: ignore[arg-type]
            else:
                one = simulate(circuit, sensitivities=paths, t_eval=[0.0], t_stop=_end(circuit), **how)  # type: ignore[arg-type,assignment]
            found[row] = getattr(one, name)
            for k, path in enumerate(paths):
                by[row, k] = getattr(one.sensitivities[path], name) * values[k]
        return found, by

    def residuals(self, values: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Residuals over their scale, and their derivatives; large ones where a scene cannot be run."""
        try:
            with warnings.catch_warnings():
                # Of values that no user has written.
                warnings.simplefilter("ignore", FingerspiceWarning)
                found, by = self.predict(values)
        except (InputError, SolveError):
            return np.full(self.scale.size, _REFUSED), np.zeros((self.scale.size, values.size))
        return (found - self.data.values) / self.scale, by / self.scale[:, None]


def _end(circuit: Circuit) -> float:
    if circuit.tran is None:
        raise InputError("the deck has no .tran, and average is 'run'; allowed: a deck with .tran, or 'periodic'")
    return circuit.tran.stop


def fit(
    circuit: Circuit,
    data: Mapping[str, ArrayLike] | str | Path,
    parameters: Sequence[str],
    *,
    bounds: Mapping[str, tuple[float, float]] | None = None,
    average: str = "periodic",
    skin: str = "own",
    charge_law: str | None = None,
    starts: int = 8,
    rtol: float = 1e-7,
) -> Fit:
    """Fit parameters of a circuit to measured data, by least squares in their logarithms.

    Parameters
    ----------
    circuit : Circuit
        With the values to start from.
    data : mapping of str to array_like, shape (n,), or path
        Columns: the measured means (``f_el_mean``, ``f_t_mean``, ``friction_mean`` or ``area_mean``) and the conditions
        under which they were measured, as paths (``Vdrive.amplitude``, ``source.frequency``, ``Xgap.fn``); or ``t``
        and a signal over time (``f_el``, ``f_t``, ``friction``, ``area``, ``u_gap``). ``sigma`` is the standard
        deviation of every value; where it is missing, it is taken as equal for all and estimated from the residuals. A
        table (CSV) has the columns in a header, with units: ``Vdrive.amplitude (V), f_el_mean (mN)``.
    parameters : sequence of str
        Paths of the parameters to fit.
    bounds : mapping of str to tuple of float, optional
        Smallest and largest value by path.
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

    Returns
    -------
    Fit

    Raises
    ------
    InputError
        If a column, unit or path is unknown, there are fewer data than parameters, or no start can be run.
    """
    require_circuit(circuit)
    task = _task(circuit, data, parameters, bounds, average, skin, charge_law, rtol)
    require_number("starts", starts, "a whole number")
    require(starts >= 1, "starts", starts, "1 or more")
    ends = [_followed(task, begin) for begin in _starts(task, int(starts))]
    best = min(ends, key=lambda end: end.objective)
    if not best.objective < 0.5 * _REFUSED**2:
        raise InputError(
            "none of the starts can be run: there is no contact, no solution, or a value out of range; allowed: a "
            "circuit that runs under the conditions of the data"
        )
    return fit_result(
        task.circuit, task.data, task.paths, task.bounds, best, [end.objective for end in ends], task.scale
    )


def _task(
    circuit: Circuit, data: Mapping[str, ArrayLike] | str | Path, parameters: Sequence[str],
    bounds: Mapping[str, tuple[float, float]] | None, average: str, skin: str, charge_law: str | None, rtol: float,
) -> Task:  # fmt: skip
    """The checked request."""
    require(average in ("periodic", "run"), "average", repr(average), "'periodic' or 'run'")
    require(skin in ("own", "follow"), "skin", repr(skin), "'own' or 'follow'")
    require(RTOL_RANGE[0] <= rtol <= RTOL_RANGE[1], "rtol", rtol, "1e-13 to 0.1")
    if isinstance(parameters, str) or not parameters:
        raise InputError(f"parameters is {parameters!r}; allowed: a sequence of paths such as ['Xgap.d', 'Xgap.r']")
    known = {path.lower(): path for path in circuit.parameters}
    for path in parameters:
        if path.lower() not in known:
            circuit.varied({path: 1.0})
    paths = tuple(known[path.lower()] for path in parameters)
    table = data_of(circuit, data)
    both = sorted(set(paths) & set(table.conditions))
    if both:
        raise InputError(f"{both[0]} is to be fitted, and is a condition of the data; allowed: one of both")
    if table.values.size < len(paths):
        raise InputError(
            f"{table.values.size} data cannot tell {len(paths)} parameters; allowed: at least as many data"
        )
    initial = [circuit.parameters[path].value for path in paths]
    for path, value in zip(paths, initial, strict=True):
        if not (math.isfinite(value) and value > 0.0):
            raise InputError(f"{path} is {value:g}, and is fitted in its logarithm; allowed: finite and more than 0")
    sizes = np.abs(table.values)
    scale = table.sigma if table.sigma is not None else np.full(sizes.size, float(sizes.max()) or 1.0)
    exact = is_stack(circuit) and build_stack(circuit).contact is not None
    box = _bounds(paths, initial, bounds or {})
    return Task(circuit, table, paths, box, average, skin, rtol, charge_law, scale, exact)


def _bounds(paths: tuple[str, ...], initial: list[float], given: Mapping[str, tuple[float, float]]) -> FloatArray:
    lower = {path.lower(): tuple(pair) for path, pair in given.items()}
    unknown = [path for path in given if path.lower() not in {p.lower() for p in paths}]
    if unknown:
        raise InputError(f"bounds names {unknown[0]}, which is not fitted; allowed: {', '.join(paths)}")
    out = np.tile([0.0, math.inf], (len(paths), 1))
    for i, (path, value) in enumerate(zip(paths, initial, strict=True)):
        if path.lower() in lower:
            pair = lower[path.lower()]
            if len(pair) != 2 or not 0.0 <= pair[0] <= value <= pair[1] or pair[0] == pair[1]:
                raise InputError(
                    f"bounds of {path} are {pair}, and it starts at {value:g}; allowed: low <= start <= high"
                )
            out[i] = pair
    return out


def _starts(task: Task, count: int) -> list[FloatArray]:
    """The values given, and the best of others around them (a Sobol sequence, always the same)."""
    from scipy.stats import qmc

    initial = task.initial
    if count == 1 or task.data.t is not None or not task.exact:
        return [initial]
    low = np.maximum(task.bounds[:, 0], initial / _SPREAD)
    high = np.minimum(task.bounds[:, 1], initial * _SPREAD)
    share = qmc.Sobol(initial.size, scramble=False).random_base2(math.ceil(math.log2(count)))[1:count]
    tried = np.vstack([initial, np.exp(np.log(low) + share * np.log(high / low))])
    rows, n = task.data.values.size, len(tried)
    table = {path: np.tile(x, n) for path, x in task.data.conditions.items()}
    table |= {path: np.repeat(tried[:, k], rows) for k, path in enumerate(task.paths)}
    periodic = task.average == "periodic"
    found = batch(
        task.circuit, table, outputs=(f"{task.data.signal}_mean",), rtol=_ROUGH, periodic=periodic, skin=task.skin
    )[f"{task.data.signal}_mean"].to_numpy().reshape(n, rows)  # fmt: skip
    off = (((found - task.data.values) / task.scale) ** 2).sum(axis=1)
    order = np.argsort(np.where(np.isfinite(off), off, math.inf), kind="stable")
    return [initial, *(tried[i] for i in order[:_FOLLOWED].tolist() if i > 0)]


def _followed(task: Task, begin: FloatArray) -> Fitted:
    """Where least squares lead from a start."""
    from scipy.optimize import least_squares

    known: dict[bytes, tuple[FloatArray, FloatArray]] = {}

    def at(x: FloatArray) -> tuple[FloatArray, FloatArray]:
        key = x.tobytes()
        if key not in known:
            known.clear()
            known[key] = task.residuals(np.exp(x))
        return known[key]

    with np.errstate(divide="ignore"):
        box = np.log(task.bounds).T
    x0 = np.clip(np.log(begin), *box)
    found = least_squares(
        lambda x: at(x)[0], x0, lambda x: at(x)[1], bounds=box, xtol=_CLOSE, ftol=1e-12, gtol=1e-12, max_nfev=100
    )
    residual, by = at(found.x)
    return Fitted(np.exp(found.x), residual, by, float(residual @ residual), int(found.nfev), bool(found.status > 0))
