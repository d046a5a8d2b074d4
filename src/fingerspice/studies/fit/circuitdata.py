"""Measured data for the fit of a circuit, and what a circuit predicts of them, with derivatives by its parameters."""

from __future__ import annotations

import difflib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from fingerspice.base.arrays import BoolArray, FloatArray
from fingerspice.base.errors import InputError
from fingerspice.circuit.circuit import Circuit
from fingerspice.circuit.devices import MEASURED as USUAL
from fingerspice.circuit.devices import MEASURING
from fingerspice.circuit.statespace import build_stack, driving_sources, is_stack
from fingerspice.solve.simulation import simulate
from fingerspice.studies.batch.batch import batch
from fingerspice.studies.batch.form import REFUSED, in_lockstep_by
from fingerspice.studies.fit.measured import SIGMA, Given, Groups, measured_of
from fingerspice.studies.fit.result import Problem
from fingerspice.studies.steady import phasor, steady_state

if TYPE_CHECKING:
    from xarray import Dataset

#: Signals that can be fitted, over time or (with ``_mean``) as means, and their units.
MEASURED = {"f_el": "N", "f_t": "N", "friction": "", "area": "m^2", "u_gap": "V", "impedance": "ohm"}
#: The one measured quantity that is no mean, and the column that may stand beside it.
IMPEDANCE, PHASE = "impedance", "impedance_phase"
_MEANS = ("f_el", "f_t", "friction", "area")
_TIME = "t"
_UNITS = MEASURED | {f"{signal}_mean": unit for signal, unit in MEASURED.items()} | {_TIME: "s", PHASE: "deg"}
# Error of the runs whose derivatives a batch gives: ten times this, relative, which is far below any data's.
_SLOPES = 1e-6


@dataclass(frozen=True)
class Data:
    """Measured values with their conditions."""

    signal: str  # A key of `MEASURED`
    values: FloatArray  # (n,): Measured values in SI units: means, or, with `t`, values over time
    sigma: FloatArray | None  # (n,): Standard deviation of every value; None where it is not known
    # (n,): Path to the values that a parameter had in the measurements, in the unit of the netlist
    conditions: dict[str, FloatArray]
    t: FloatArray | None = None  # (n,): Times, s
    phase: FloatArray | None = None  # (n,): Phase of an impedance, deg
    groups: Groups | None = None  # Which measurements belong together, such as those of one finger

    @property
    def name(self) -> str:
        """Name of the measured column."""
        return self.signal if self.t is not None or self.signal == IMPEDANCE else f"{self.signal}_mean"

    @property
    def target(self) -> FloatArray:
        """What is to be predicted: the values, and after them the phases (deg) of an impedance where given."""
        return self.values if self.phase is None else np.concatenate([self.values, self.phase])

    @property
    def scale(self) -> FloatArray:
        """Scale of the residuals: sigma, or the largest value; of an impedance each value's own size."""
        sizes = np.abs(self.values)
        own = sizes if self.signal == IMPEDANCE else np.full(sizes.size, float(sizes.max()) or 1.0)
        scale = own if self.sigma is None else self.sigma
        # An error of the complex impedance, equal in all directions, is as large across as along.
        return scale if self.phase is None else np.concatenate([scale, np.degrees(scale / sizes)])

    def unusual(self) -> Iterator[str]:
        """Warnings about measured values and amplitudes that are probably in another unit."""
        if self.signal in USUAL:
            largest = float(np.abs(self.values).max())
            yield USUAL[self.signal].warning(f"the data's largest {self.name}", largest, MEASURED[self.signal]) or ""
        for path, x in self.conditions.items():
            if self.signal in _MEANS and path.endswith(".amplitude"):
                yield MEASURING.warning(f"the data's largest {path}", float(x[np.abs(x).argmax()]), "V") or ""

    @property
    def varying(self) -> dict[str, FloatArray]:
        """The conditions that are not the same in all measurements."""
        return {path: x for path, x in self.conditions.items() if np.ptp(x) > 0.0}

    def remedy(self, circuit: Circuit) -> str:
        """A measurement that would add what is missing: at another voltage, frequency or load."""
        if self.t is not None:
            return "Measure under another voltage or load as well, or fix one of them."
        varying, known = ({path.rpartition(".")[2] for path in paths} for paths in (self.varying, circuit.parameters))
        for key, text in (("amplitude", "voltage"), ("frequency", "frequency"), ("fn", "load")):
            if key in known - varying:
                return f"Measure at a second {text} as well, or fix one of them."
        return "Fix one of them to a value known from elsewhere."


def data_of(circuit: Circuit, given: Given, by: str | None = None) -> Data:
    """The checked data that a caller of `fit` gave; the column `by` tells which group a measurement belongs to."""
    if isinstance(given, Mapping) and np.iscomplexobj(given.get(IMPEDANCE, 0.0)):
        if PHASE in given:
            raise InputError(f"{IMPEDANCE} is complex, and {PHASE} is given; allowed: one of them")
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
    names = {f"{name}_mean": name for name in _MEANS}
    names |= {name: name for name in MEASURED if name != IMPEDANCE} if _TIME in columns else {IMPEDANCE: IMPEDANCE}
    measured = [name for name in columns if name in names]
    if len(measured) != 1:
        what = f"several measured columns ({', '.join(measured)})" if measured else "no measured column"
        raise InputError(
            f"{place} have {what}, and the columns {', '.join(columns)}; allowed: one of {', '.join(names)}"
        )
    (name,) = measured
    values = columns.pop(name)
    sigma, t, phase = (columns.pop(key, None) for key in (SIGMA, _TIME, PHASE))
    if phase is not None and name != IMPEDANCE:
        raise InputError(f"{place} have the column {PHASE} beside {name}; allowed: beside {IMPEDANCE}")
    _refuse_signs(name, values, place, first=0 if isinstance(given, Mapping) else 1)
    if sigma is not None and not np.all(sigma > 0.0):
        raise InputError(f"{place}: the smallest sigma is {sigma.min():g}; allowed: more than 0")
    if t is not None and (name.endswith("_mean") or np.any(np.diff(t) <= 0.0)):
        raise InputError(f"{place} have the column t; allowed: rising times, with a signal that is no mean")
    conditions: dict[str, FloatArray] = {}
    for column, x in columns.items():
        path = _path(circuit, column)
        if path in conditions:
            raise InputError(f"{place} have two columns of {path}; allowed: one")
        conditions[path] = x
    data = Data(names[name], values, sigma, conditions, t, phase, groups)
    if t is not None and data.varying:
        raise InputError(f"{place} have times and changing conditions; allowed: one run over time, or means")
    if t is not None and groups is not None:
        raise InputError(f"{place} have times and groups; allowed: groups of means or of impedances")
    return data


def _refuse_signs(name: str, values: FloatArray, place: str, first: int) -> None:
    """Refuse magnitudes of an impedance that are not above 0, and signals that are negative on average.

    A signal over time may be below 0 now and then, by noise. Rows count from `first`.
    """
    low, allowed = values < 0.0, "0 or more"
    if name == IMPEDANCE:
        low, allowed = values <= 0.0, "magnitudes above 0"
    elif name.startswith("f_el"):
        allowed += ", as the electroadhesive force counts as positive where it pulls towards the screen"
    if name == IMPEDANCE or name.endswith("_mean"):
        told = [(values[i], f"in row {i + first}") for i in np.flatnonzero(low)[:1]]
    else:
        told = [(values.mean(), "on average")] if name in _MEANS and values.mean() < 0.0 else []
    for value, where in told:
        raise InputError(f"{place}: {name} is {f'{value:g} {_UNITS[name]}'.rstrip()} {where}; allowed: {allowed}")


def _path(circuit: Circuit, name: str) -> str:
    """A condition's path; ``source.`` stands for the only source, and ``frequency`` for its frequency."""
    if name.lower() == "frequency":
        name = "source.frequency"
    element, _, parameter = name.partition(".")
    if element.lower() == "source":
        driving = driving_sources(circuit)
        if len(driving) != 1:
            raise InputError(f"{name} is the only source's, and the circuit has {len(driving)}; allowed: its name")
        name = f"{driving[0].name}.{parameter}"
    known = {path.lower(): path for path in circuit.parameters}
    if name.lower() not in known:
        near = difflib.get_close_matches(name.lower(), known, 1, 0.0)
        hint = f", such as {known[near[0]]}" if near else ""
        allowed = ", ".join((*(f"{signal}_mean" for signal in _MEANS), IMPEDANCE, PHASE, SIGMA, _TIME))
        raise InputError(
            f"the data have a column {name!r}, which is no parameter of the circuit; allowed: {allowed} with a signal, "
            f"and conditions{hint}"
        )
    return known[name.lower()]


@dataclass(frozen=True)
class Task(Problem):
    """The fit of a circuit's parameters; how it is run is said by `fit`."""

    data: Data
    average: str
    skin: str
    rtol: float
    charge_law: str | None
    watch: Callable[[], None] = lambda: None  # Called before every evaluation

    @cached_property
    def members(self) -> BoolArray:
        """Whether each unknown belongs to each measurement, shape (n_parameter, n)."""
        groups, count = self.data.groups, self.data.values.size
        own = groups.of if groups is not None else [None] * count
        return np.array([[one.label in (None, label) for label in own] for one in self.unknowns])

    @cached_property
    def places(self) -> dict[str, list[int]]:
        """Places of every fitted parameter's unknowns, by its path: one, or one for each group."""
        paths = [one.path for one in self.unknowns]
        return {path: [k for k, other in enumerate(paths) if other == path] for path in paths}

    def compared(self, values: FloatArray) -> tuple[FloatArray, FloatArray]:
        self.watch()
        if self.data.signal == IMPEDANCE:
            return super().compared(values)
        found, by = self._in_batches(values) if self._in_lockstep else self._in_single_runs(values)
        return (found - self.data.values) / self.scale, by * values / self.scale[:, None]

    def misses(self, values: FloatArray) -> FloatArray:
        """Of impedances, at the area that the deck's amplitude causes."""
        data, how = self.data, "swept" if self.skin == "follow" else "own"
        runs = [phasor(self._scene(values, row), skin=how).impedance for row in range(data.values.size)]
        z = np.array([one[0] for one in runs if one is not None])
        off = np.abs(z) - data.values
        if data.phase is not None:
            off = np.append(off, np.remainder(np.angle(z, deg=True) - data.phase + 180.0, 360.0) - 180.0)
        return np.asarray(off / self.scale)

    def _in_single_runs(self, values: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Predicted means or a signal (n,), and their derivatives by the parameters (n, n_parameter)."""
        data, over_time = self.data, self.data.t is not None
        if not over_time and self.average == "run" and self.circuit.tran is None:
            raise InputError("the deck has no .tran, and average is 'run'; allowed: a deck with .tran, or 'periodic'")
        found, by = np.empty(data.values.size), np.zeros((data.values.size, values.size))
        # A signal over time has all its values from one run.
        for row in range(1 if over_time else data.values.size):
            circuit, felt = self._scene(values, row), np.flatnonzero(self.members[:, row])
            paths = tuple(self.unknowns[k].path for k in felt)
            how = {"sensitivities": paths, "rtol": self.rtol, "charge_law": self.charge_law, "charge": False}
            if over_time or self.average == "run":
                one = simulate(circuit, t_eval=data.t if over_time else [0.0], **how)  # type: ignore[arg-type]
            else:
                one = steady_state(circuit, points=4, **how)  # type: ignore[arg-type,assignment]
            at = slice(None) if over_time else row
            found[at] = getattr(one, data.name)
            for k, path in zip(felt, paths, strict=True):
                by[at, k] = getattr(one.sensitivities[path], data.name)
        return found, by

    def _scene(self, values: FloatArray, row: int) -> Circuit:
        """The circuit of one measurement."""
        changes = {path: float(x[row]) for path, x in self.data.conditions.items()}
        changes |= {self.unknowns[k].path: float(values[k]) for k in np.flatnonzero(self.members[:, row])}
        changed = self.circuit.varied(changes)
        if self.skin == "follow":
            fundamental = build_stack(changed).waveform.fundamental if is_stack(changed) else None
            skins = {f"{e.name}.f": fundamental.frequency for e in changed.by_device("SKIN") if fundamental is not None}
            changed = changed.varied(skins)
        return changed

    @cached_property
    def _in_lockstep(self) -> bool:
        """Whether a batch predicts all measurements, and has their derivatives, in lockstep."""
        paths = {*self.data.conditions, *self.places}
        skins = {f"{e.name}.f" for e in self.circuit.by_device("SKIN")}
        if self.data.t is not None or self.charge_law is not None or (self.skin == "follow" and paths & skins):
            return False
        alone = self.skin == "own" or len(driving_sources(self.circuit)) == 1
        return alone and in_lockstep_by(self.circuit, paths, (self.data.name,), max(self.rtol, _SLOPES))

    def _in_batches(self, values: FloatArray) -> tuple[FloatArray, FloatArray]:
        """As `_in_single_runs`, all measurements at once, and derivatives with an error that suits least squares."""
        name, by, runs = self.data.name, np.zeros((self.data.values.size, values.size)), []
        slopes = max(self.rtol, _SLOPES), tuple(self.places)
        for status, (rtol, gradients) in (("gradient_status", slopes), ("status", (self.rtol, ()))):
            runs.append(self.scenes(values[None], rtol, gradients))
            if np.any(runs[-1][status].to_numpy() >= REFUSED):
                raise InputError(runs[-1].attrs["failures"][0])
        for i, own in enumerate(self.places.values()):
            by[:, own] = self.members[own].T * runs[0][f"d_{name}"].to_numpy()[:, i, None]
        return runs[1][name].to_numpy(), by

    def scenes(self, values: FloatArray, rtol: float, gradients: tuple[str, ...] = ()) -> Dataset:
        """A batch of all measurements, with every row of `values` (n_row, n_parameter) one after the other."""
        table = {path: np.tile(x, len(values)) for path, x in self.data.conditions.items()}
        table |= {path: (values[:, own] @ self.members[own]).ravel() for path, own in self.places.items()}
        return batch(
            self.circuit, table, outputs=(self.data.name,), rtol=rtol, periodic=self.average == "periodic",
            skin=self.skin, gradients=gradients,
        )  # fmt: skip
