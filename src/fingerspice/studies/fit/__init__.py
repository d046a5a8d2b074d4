"""Fit of a circuit's parameters to measured means or signals, by least squares with exact derivatives."""

from __future__ import annotations

import itertools
import math
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from fingerspice.base.announcing import Bar
from fingerspice.base.arrays import FloatArray, IntArray, whole_number
from fingerspice.base.errors import FingerspiceWarning, InputError
from fingerspice.base.pages import Page
from fingerspice.circuit import devices
from fingerspice.circuit.circuit import CHARGE_LAWS, Circuit, nearest
from fingerspice.circuit.describe import meaning_of, own_path, require_circuit, scenes_warnings
from fingerspice.circuit.network import network_of
from fingerspice.circuit.statespace import driving_sources
from fingerspice.results.outcome import SolveError
from fingerspice.results.record import SIGNALS
from fingerspice.solve.simulation import rtol_given, simulate
from fingerspice.studies.batch.batch import REFUSED, batch
from fingerspice.studies.fit.fitting import FARTHEST, NOT_FOUND, SIGMA, FitResult, Given, Problem, followed, measured_of
from fingerspice.studies.steady import phasor
from fingerspice.waveforms.waveform import Sine, refuse, require

if TYPE_CHECKING:
    from xarray import Dataset

#: Signals that can be fitted, over time or (with ``_mean``) as means, and their units.
MEASURED = {"f_el": "N", "f_t": "N", "friction": "", "area": "m^2", "a_real": "m^2", "u_gap": "V", "impedance": "ohm"}
#: The one measured quantity that is no mean, and the column that may stand beside it.
IMPEDANCE, PHASE = "impedance", "impedance_phase"
_MEANS = ("f_el", "f_t", "friction", "area", "a_real")
_TIME, _PARTS = "t", ("impedance_re", "impedance_im")
_UNITS = MEASURED | {f"{signal}_mean": unit for signal, unit in MEASURED.items()} | {_TIME: "s", PHASE: "deg"}
_UNITS |= dict.fromkeys(_PARTS, "ohm")
# Error of the runs whose derivatives a batch gives: ten times this, relative, which is far below any data's; and of the
# means by which starts are compared.
_SLOPES, _ROUGH = 1e-6, 1e-5
# Starts lie within this factor of the parameters given, where no bounds are; and how many of them are followed.
_SPREAD, _FOLLOWED = 4.0, 3
# Errors of unknown size are equal shares of the data unless errors equal for all are likelier by this logarithm. The
# choice takes a degree of freedom, and is made where so many are there; else errors are taken as equal.
_CLEARLY, _CHOOSING = 2.0, 4


@dataclass(frozen=True)
class Data:
    """Measured values with their conditions."""

    signal: str  # A key of `MEASURED`
    values: FloatArray  # (n,): Measured values in SI units: means, or, with `t`, values over time
    sigma: FloatArray | None  # (n,): Standard deviation of every value; None where it is not known
    conditions: dict[str, FloatArray]  # (n,): Values of parameters by path, in the unit of the netlist
    t: FloatArray | None  # (n,): Times, s
    phase: FloatArray | None  # (n,): Phase of an impedance, deg
    groups: dict[str, tuple[str, ...]]  # (n,): The group of each, by column

    @property
    def name(self) -> str:
        """Name of the measured column."""
        return self.signal if self.t is not None or self.signal == IMPEDANCE else f"{self.signal}_mean"

    @property
    def scale(self) -> FloatArray:
        """Scale of the residuals: sigma, the largest value, or an impedance's own size; those of phases come last."""
        sizes = np.abs(self.values)
        own = sizes if self.signal == IMPEDANCE else np.full(sizes.size, float(sizes.max()) or 1.0)
        scale = own if self.sigma is None else self.sigma
        # An error of the complex impedance, equal in all directions, is as large across as along.
        return scale if self.phase is None else np.concatenate([scale, np.degrees(scale / sizes)])

    def unusual(self) -> Iterator[str | None]:
        """Warnings about measured values and amplitudes that are probably in another unit."""
        said = "the data's largest"
        if (usual := devices.MEASURED.get(self.signal)) is not None:
            yield usual.warning(f"{said} {self.name}", np.abs(self.values).max(), MEASURED[self.signal])
        for path, x in self.conditions.items():
            if self.signal in _MEANS and path.endswith(".amplitude"):
                yield devices.MEASURING.warning(f"{said} {path}", float(x[np.abs(x).argmax()]), "V")

    @property
    def varying(self) -> dict[str, FloatArray]:
        """The conditions that are not the same in all measurements."""
        return {path: x for path, x in self.conditions.items() if np.ptp(x) > 0.0}


def _data_of(circuit: Circuit, given: Given, by: str | None) -> Data:
    """The checked data that a caller gave; the column `by` tells which group a measurement belongs to."""
    if isinstance(given, Mapping) and np.iscomplexobj(given.get(IMPEDANCE, 0.0)):
        require(PHASE not in given, IMPEDANCE, f"complex, and {PHASE} is given", "one of them")
        z = np.asanyarray(given[IMPEDANCE])
        given = {**given, IMPEDANCE: np.abs(z), PHASE: np.angle(z, deg=True)}

    def meaning(name: str, names: Sequence[str]) -> tuple[str, str, str]:
        key = {"time": _TIME, _TIME: _TIME, SIGMA: SIGMA}.get(name.lower(), name)
        if key == SIGMA:
            measured = next((one for one in names if one.removesuffix("_mean") in MEASURED), "")
            return SIGMA, measured, _UNITS.get(measured, "")
        return key, key, _UNITS[key] if key in _UNITS else circuit.parameters[_path(circuit, name)].unit

    try:
        columns, place, groups = measured_of(given, meaning, "Vdrive.amplitude (V), f_el_mean (N)", by)
    except InputError as refused:
        if by is not None or "no rows of numbers" not in refused.message:
            raise
        raise InputError(f"{refused.message}; allowed: numbers, and names in the column that groups names") from None
    if columns.keys() & set(_PARTS):
        said = f"{place} have a part of a complex impedance; allowed: both {' and '.join(_PARTS)}, without {IMPEDANCE}"
        refuse(not columns.keys() >= set(_PARTS) or columns.keys() & {IMPEDANCE, PHASE}, said)
        real, imaginary = (columns.pop(part) for part in _PARTS)
        columns |= {IMPEDANCE: np.hypot(real, imaginary), PHASE: np.degrees(np.arctan2(imaginary, real))}
    names = {f"{name}_mean": name for name in _MEANS}
    names |= {name: name for name in MEASURED if name != IMPEDANCE} if _TIME in columns else {IMPEDANCE: IMPEDANCE}
    measured = [name for name in columns if name in names]
    what = f"several measured columns ({', '.join(measured)})" if measured else "no measured column"
    said = f"{place} have {what}, and the columns {', '.join(columns)}; allowed: one of {', '.join(names)}"
    refuse(len(measured) != 1, said)
    (name,), values = measured, columns.pop(measured[0])
    sigma, t, phase = (columns.pop(key, None) for key in (SIGMA, _TIME, PHASE))
    alone = phase is not None and name != IMPEDANCE
    refuse(alone, f"{place} have the column {PHASE} beside {name}; allowed: beside {IMPEDANCE}")
    # A signal over time may be below 0 now and then, by noise, but not on average; magnitudes never are 0.
    each = name == IMPEDANCE or name.endswith("_mean")
    checked = values if each else values.mean(keepdims=True)
    low = np.flatnonzero(checked <= 0.0 if name == IMPEDANCE else checked < 0.0)
    if low.size and (each or name in _MEANS):
        where = f"in row {low[0] + (0 if isinstance(given, Mapping) else 1)}" if each else "on average"
        allowed = "magnitudes above 0" if name == IMPEDANCE else "0 or more"
        if name.startswith("f_el"):
            allowed += ", as the electroadhesive force counts as positive where it pulls towards the screen"
        value = f"{checked[low[0]]:g} {_UNITS[name]}".rstrip()
        raise InputError(f"{place}: {name} is {value} {where}; allowed: {allowed}")
    least = math.inf if sigma is None else sigma.min(initial=math.inf)
    refuse(least <= 0.0, f"{place}: the smallest sigma is {least:g}; allowed: more than 0")
    conditions: dict[str, FloatArray] = {}
    for column, x in columns.items():
        path = _path(circuit, column)
        refuse(path in conditions, f"{place} have two columns of {path}; allowed: one")
        conditions[path] = x
    data = Data(names[name], values, sigma, conditions, t, phase, groups)
    if t is not None:
        wrong = name.endswith("_mean") or np.any(np.diff(t) <= 0.0)
        refuse(wrong, f"{place} have the column t; allowed: rising times, with a signal that is no mean")
        refuse(data.varying, f"{place} have times and changing conditions; allowed: one run over time, or means")
        refuse(groups, f"{place} have times and groups; allowed: groups of means or of impedances")
    return data


def _path(circuit: Circuit, name: str) -> str:
    """A condition's path; ``source.`` stands for the only source, and ``frequency`` for its frequency."""
    name = "source.frequency" if name.lower() == "frequency" else name
    if name.lower().startswith("source.") and (count := len(driving_sources(circuit))) != 1:
        raise InputError(f"{name} is the only source's, and the circuit has {count}; allowed: its name")
    with suppress(InputError):
        return own_path(circuit, name)
    near = nearest(name, [*circuit.parameters])
    allowed = ", ".join((*(f"{signal}_mean" for signal in _MEANS), IMPEDANCE, PHASE, SIGMA, _TIME))
    allowed += f" with a signal, and conditions{'' if near is None else f', such as {near}'}"
    raise InputError(f"the data have a column {name!r}, which is no parameter of the circuit; allowed: {allowed}")


@dataclass(frozen=True)
class Task(Problem):
    """The fit of a circuit's parameters; how it is run is said by `fit`."""

    data: Data
    places: dict[str, IntArray]  # (n,): Path to the place among the values of that which each measurement has
    average: str
    skin: str
    rtol: float
    charge_law: str | None
    watch: Callable[[], None]  # Called before every evaluation
    reach: ClassVar[float] = FARTHEST  # There are no likely values beyond it, and slow runs

    def remedy(self, names: tuple[str, ...]) -> str:
        """A measurement that would add what is missing: at another voltage, frequency or load."""
        if self.data.t is not None:
            return "Measure under another voltage or load as well, or fix one of them."
        both = self.data.varying, self.circuit.parameters
        varying, known = ({path.rpartition(".")[2] for path in paths} for paths in both)
        for key, text in (("amplitude", "voltage"), ("frequency", "frequency"), ("fn", "load")):
            if key in known - varying:
                return f"Measure at a second {text} as well, or fix one of them."
        return "Fix one of them to a value known from elsewhere."

    def compared(self, values: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Of a signal by one run, of means by batches; their derivatives with an error that suits least squares."""
        self.watch()
        data, paths = self.data, self.paths
        if data.signal == IMPEDANCE:
            return super().compared(values)
        if data.t is not None:
            circuit = self.scene(values, 0, data.conditions)
            waves = network_of(circuit).waveforms
            if self.skin == "follow" and len(waves) == 1 and (sine := waves[0].fundamental) is not None:
                circuit = circuit.varied({f"{e.name}.f": sine.frequency for e in circuit.by_device("SKIN")})
            run = simulate(
                circuit, t_eval=data.t, rtol=self.rtol, charge_law=self.charge_law, charge=False, sensitivities=paths
            )
            found = getattr(run, data.name)
            by = np.array([getattr(run.sensitivities[path], data.name) for path in paths]).T
        else:
            slopes = self.scenes(values[None], max(self.rtol, _SLOPES), tuple(self.places))
            means = self.scenes(values[None], self.rtol)
            for one, status in ((slopes, "gradient_status"), (means, "status")):
                if np.any(one[status].to_numpy() >= REFUSED):
                    raise InputError(one.attrs["failures"][0])
            found, by = means[data.name].to_numpy(), np.zeros((data.values.size, values.size))
            for i, at in enumerate(self.places.values()):
                by[np.arange(at.size), at] = slopes[f"d_{data.name}"].to_numpy()[:, i]
        return (found - data.values) / self.scale, by * values / self.scale[:, None]

    def scene(self, values: FloatArray, row: int, conditions: Mapping[str, FloatArray]) -> Circuit:
        """The circuit of one measurement, under some conditions."""
        changes = {path: float(x[row]) for path, x in conditions.items()}
        return self.circuit.varied(changes | {path: float(values[at[row]]) for path, at in self.places.items()})

    def misses(self, values: FloatArray) -> FloatArray:
        """Of impedances, at the area that the deck's amplitude causes."""
        data, on, skin = self.data, driving_sources(self.circuit), "swept" if self.skin == "follow" else "own"
        # Rows that differ in a sine's frequency alone are one sweep; with AC, a sweep would have its amplitude.
        conditions, z, sweeps = dict(data.conditions), np.empty(data.values.size, complex), dict[Any, list[int]]()
        plain = len(on) == 1 and isinstance(on[0].waveform, Sine) and all(e.ac is None for e in self.circuit.elements)
        f = conditions.pop(f"{on[0].name}.frequency", None) if plain else None
        for i, shared in enumerate(zip(*conditions.values(), *self.places.values(), strict=True)):
            sweeps.setdefault(i if f is None else shared, []).append(i)
        for rows in sweeps.values():
            scene = self.scene(values, rows[0], data.conditions)
            found = phasor(scene, None if f is None else f[rows], skin=skin).impedance
            refuse(found is None, "several sources see no impedance; allowed: a circuit with one source")
            z[rows] = found
        off = np.abs(z) - data.values
        if data.phase is not None:
            off = np.append(off, np.remainder(np.angle(z, deg=True) - data.phase + 180.0, 360.0) - 180.0)
        return np.asarray(off / self.scale)

    def scenes(self, values: FloatArray, rtol: float, gradients: tuple[str, ...] = ()) -> Dataset:
        """A batch of all measurements, with every row of `values` (n_row, n_parameter) one after the other."""
        table = {path: np.tile(x, len(values)) for path, x in self.data.conditions.items()}
        table |= {path: values[:, at].ravel() for path, at in self.places.items()}
        circuit = self.circuit if self.charge_law is None else replace(self.circuit, charge_law=self.charge_law)
        outputs, periodic = (self.data.name,), self.average == "periodic"
        return batch(circuit, table, outputs=outputs, rtol=rtol, periodic=periodic, skin=self.skin, gradients=gradients)


@dataclass(frozen=True, repr=False, kw_only=True)
class Fit(FitResult):
    """A fit of parameters to data; `circuit` has the fitted values, and is ready to run.

    Attributes
    ----------
    circuit : Circuit
    estimates : dict of str to Estimate
        By path; that of a group's parameter is followed by the group in brackets: ``Xgap.d[left]``.
    correlation : ndarray, shape (n_parameter, n_parameter)
        Of the errors of the logarithms.
    data : Data
    predicted, sigma : ndarray, shape (n,)
        The data as the fitted circuit gives them; standard deviation of each: as given, or as the residuals have it.
    objective : float
        Sum of the squared residuals over sigma as given, or over the largest value of the data, or, where errors are
        likelier equal shares of the values, over these.
    objectives : tuple of float
        That reached from every start that was followed.
    count, freedom, evaluations : int
        Number of residuals; data less parameters, and less one where residuals say if errors are equal or shares.
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
    circuits: dict[str, Circuit]

    @property
    def residual(self) -> FloatArray:
        """Data less prediction, in the unit of the data, shape (n,)."""
        return np.asarray(self.data.values - self.predicted)

    @property
    def _rms(self) -> float:
        return float(np.sqrt(np.mean(self.residual**2)))

    def _page(self) -> Page:
        data = self.data
        share = 100.0 * self._rms / (float(np.abs(data.values).max()) or 1.0)
        known = "as given"
        if data.sigma is None:
            lowest, highest = float(self.sigma.min()), float(self.sigma.max())
            known = "estimated from the residuals, as equal shares of the values"
            if lowest >= highest * (1.0 - 1e-9):
                known = "estimated from the residuals, equal for all"
            if highest == np.inf:
                known = "unknown, as there are no more values than parameters"
        head = f"{len(self.estimates)} parameters fitted to {data.values.size} values of {data.name}"
        size = f"{self._rms:.3g} {MEASURED[data.signal]} rms, {share:.2g} % of the largest value"
        groups = [f"groups by {column}: {', '.join(dict.fromkeys(of))}" for column, of in data.groups.items()]
        return self._paged(head, [f"residual {size}; sigma {known}", *groups])

    def _panels(self) -> list[Any]:
        data, circuit = self.data, self.circuit
        signal = SIGNALS[data.signal][1] if data.signal in SIGNALS else data.signal
        signal = f"mean {signal}" if data.name.endswith("_mean") else signal
        axes = [(meaning_of(circuit, path), circuit.parameters[path].unit, x) for path, x in data.varying.items()]
        numbers = np.arange(1.0, data.values.size + 1.0, dtype=np.float64)
        # Conditions that vary go without times.
        alone = ("measurement", "", numbers) if data.t is None else ("time", "s", data.t)
        keys = [[f"{column} = {one}" for one in of] for column, of in data.groups.items() if axes]
        columns = data.values, self.predicted, self.sigma
        return [self._panel(axes or [alone], keys, signal, MEASURED[data.signal], *columns)]

    def to_dict(self) -> dict[str, Any]:
        return super().to_dict() | {
            "groups": list(self.circuits), "signal": self.data.signal, "count": int(self.data.values.size),
            "residual_rms": self._rms, "objectives": list(self.objectives),
        }  # fmt: skip

    def _columns(self) -> dict[str, Any]:
        data, time = self.data, {} if self.data.t is None else {"t": self.data.t}
        known = {**data.groups, **time, **data.conditions, data.signal: data.values}
        return {**known, "fitted": self.predicted, "sigma": self.sigma}


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
        Columns: the measured means (``f_el_mean``, ``f_t_mean``, ``friction_mean``, ``area_mean``, ``a_real_mean``) and
        the conditions under which they were measured, as paths (``Vdrive.amplitude``, ``source.frequency``,
        ``Xgap.fn``); or ``t`` and a signal over time (``f_el``, ``f_t``, ``friction``, ``area``, ``a_real``,
        ``u_gap``); or ``frequency`` and what the source sees: ``impedance``, its magnitude (ohm), with
        ``impedance_phase`` (deg) where it is known, or complex, or its parts ``impedance_re``, ``impedance_im`` (ohm).
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

    Raises
    ------
    InputError
        If a column, unit or path is unknown, there are fewer data than parameters, or no start can be run.
    """
    require_circuit(circuit)
    starts, rtol = whole_number("starts", starts, 1), rtol_given(rtol)
    measured, names, paths, places = _request(circuit, data, parameters, groups)
    require(average in ("periodic", "run"), "average", repr(average), "'periodic' or 'run'")
    require(skin in ("own", "follow"), "skin", repr(skin), "'own' or 'follow'")
    require(charge_law in (None, *CHARGE_LAWS), "charge_law", repr(charge_law), " or ".join(map(repr, CHARGE_LAWS)))
    gaps = len(circuit.by_device("GAP"))
    if gaps > 1 or (gaps == 0 and measured.signal != IMPEDANCE):
        raise InputError(f"the circuit has {gaps} GAPs; allowed: one, to which the data belong")
    if average == "run" and circuit.tran is None and measured.name.endswith("_mean"):
        raise InputError("the deck has no .tran, and average is 'run'; allowed: a deck with .tran, or 'periodic'")
    bar, begun, count = Bar("fitting", endless=True), time.perf_counter(), itertools.count(1)

    def watch() -> None:
        number = next(count)
        if time.perf_counter() - begun > 1.0:
            bar.show(note=f"evaluation {number}")

    task = Task(circuit, names, paths, measured.scale, measured, places, average, skin, rtol, charge_law, watch)
    task = task.begun({own_path(circuit, path): box for path, box in (bounds or {}).items()}, profiles)
    for text in filter(None, (*measured.unusual(), *scenes_warnings(circuit, None, measured.conditions, skin))):
        warnings.warn(text, FingerspiceWarning, stacklevel=2)
    try:
        return _fitted(task, starts)
    finally:
        bar.stop()


def _request(
    circuit: Circuit, given: Given, parameters: Sequence[str], groups: Mapping[str, Sequence[str]] | None
) -> tuple[Data, tuple[str, ...], tuple[str, ...], dict[str, IntArray]]:
    """The checked data; and names, paths and places, as `Task` has them, of what is to be fitted to them."""
    good = not isinstance(parameters, str) and bool(parameters)
    require(good, "parameters", repr(parameters), "a sequence of paths such as ['Xgap.d', 'Xgap.r']")
    fitted = [own_path(circuit, path) for path in parameters]
    by: str | None = None
    separate: Sequence[str] = ()
    if groups is not None:
        wanted = "a mapping of a column of the data to the parameters of each group, such as {'finger': ['Xgap.d']}"
        ((by, separate),) = groups.items() if isinstance(groups, Mapping) and len(groups) == 1 else (("", ""),)
        good = isinstance(by, str) and not isinstance(separate, str) and bool(separate)
        require(good, "groups", repr(groups), wanted)
        known = by.lower() in map(str.lower, circuit.parameters)
        refuse(known, f"groups names the column {by!r}, which is a parameter; allowed: {wanted}")
    for path in separate:
        said = f"groups names {path!r}, which is not fitted; allowed: {', '.join(fitted)}"
        refuse(path.lower() not in map(str.lower, fitted), said)
    data = _data_of(circuit, given, by)
    names, paths, places = list[str](), list[str](), dict[str, IntArray]()
    (of,) = data.groups.values() or ((),)
    every = list(dict.fromkeys(of))
    for path in fitted:
        value = circuit.parameters[path].value
        require(fitted.count(path) == 1, path, "named twice", "once")
        require(path not in data.conditions, path, "to be fitted, and is a condition of the data", "one of both")
        require(0.0 < value < math.inf, path, f"{value:g}, and is fitted in its logarithm", "finite and more than 0")
        places[path], labels = np.full(data.values.size, len(names)), [path]
        if path.lower() in map(str.lower, separate):
            places[path] += [every.index(label) for label in of]
            labels = [f"{path}[{label}]" for label in every]
        names += labels
        paths += [path] * len(labels)
    return data, tuple(names), tuple(paths), places


def _fitted(task: Task, starts: int) -> Fit:
    from scipy.stats import t

    data, n = task.data, task.data.values.size
    ends = [followed(task.residuals, task.box, begin) for begin in _starts(task, starts)]
    best = min(ends, key=lambda end: end.objective)
    if best.objective >= NOT_FOUND:
        try:
            task.compared(best.values)
        except (InputError, SolveError) as refused:
            raise InputError(f"none of the starts can be run: {refused}") from None
    freedom = best.residual.size - len(task.names)
    if data.sigma is None and data.t is None and data.signal != IMPEDANCE and freedom >= _CHOOSING:
        freedom -= 1
        predicted = np.abs(data.values + best.residual * task.scale)
        if np.all(predicted > 0.0) and best.objective != 0.0:
            shares = replace(task, scale=predicted)
            others = [followed(shares.residuals, shares.box, end.values) for end in ends]
            other = min(others, key=lambda end: end.objective)
            least = other.objective
            # The largest likelihood of normal errors of unknown size is RSS^(-n/2) over the product of the scales.
            equal = 0.5 * n * math.log(best.objective) + float(np.log(task.scale).sum())
            # Shares that fit to the last bit are the likelier ones.
            if least == 0.0 or 0.5 * n * math.log(least) + float(np.log(predicted).sum()) < equal + _CLEARLY:
                task, ends, best = shares, others, other
    # Of a known sigma Student's t is that of infinitely many degrees of freedom; with none left, nothing is known.
    left = math.inf if data.sigma is not None else freedom
    variance = 1.0 if left == math.inf else best.objective / left if left > 0 else math.inf
    reach = float(t.ppf(0.975, left)) if left > 0 else math.inf
    # The geometric mean of one value is that value to the last digit.
    means = {path: best.values[np.unique(at)] for path, at in task.places.items()}
    (of,) = data.groups.values() or ((),)
    return Fit._reported(
        task, best, variance, reach, best.beyond_sigma(..., freedom) if data.sigma is not None else [],
        data=data, freedom=freedom, predicted=data.values + (best.residual * task.scale)[:n],
        sigma=data.sigma if data.sigma is not None else math.sqrt(variance) * task.scale[:n],
        objectives=tuple(end.objective for end in ends),
        circuit=task.circuit.varied({path: float(np.prod(x ** (1.0 / x.size))) for path, x in means.items()}),
        circuits={label: task.scene(best.values, of.index(label), {}) for label in dict.fromkeys(of)},
    )  # fmt: skip


def _starts(task: Task, count: int) -> list[FloatArray]:
    """The values given, and the best of others around them (a Sobol sequence, always the same)."""
    from scipy.stats import qmc

    initial = task.initial
    if count == 1 or task.data.t is not None or task.data.signal == IMPEDANCE:
        return [initial]
    low = np.maximum(task.box[:, 0], initial / _SPREAD)
    high = np.minimum(task.box[:, 1], initial * _SPREAD)
    share = qmc.Sobol(initial.size, scramble=False).random_base2(math.ceil(math.log2(count)))[1:count]
    tried = np.vstack([initial, np.exp(np.log(low) + share * np.log(high / low))])
    # What there is to say of the data has been said.
    with warnings.catch_warnings(action="ignore", category=FingerspiceWarning):
        tests = task.scenes(tried, _ROUGH)
    found = tests[task.data.name].to_numpy().reshape(len(tried), -1)
    off = (((found - task.data.values) / task.scale) ** 2).sum(axis=1)
    order = np.argsort(np.where(np.isfinite(off), off, math.inf), kind="stable")
    return [initial, *(tried[i] for i in order[:_FOLLOWED].tolist() if i > 0)]
