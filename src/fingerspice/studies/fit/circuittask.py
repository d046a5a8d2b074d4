"""What is fitted of a circuit, and what it predicts of the data, with derivatives by its parameters' logarithms."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from fingerspice.base.arrays import BoolArray, FloatArray
from fingerspice.base.errors import InputError
from fingerspice.circuit.circuit import Circuit
from fingerspice.circuit.statespace import build_stack, is_stack
from fingerspice.circuit.topology import driving_sources
from fingerspice.numerics.small import AT, STEP, derivative
from fingerspice.solve.simulation import simulate
from fingerspice.studies.batch.batch import batch
from fingerspice.studies.batch.form import in_lockstep_by
from fingerspice.studies.batch.task import REFUSED
from fingerspice.studies.fit.circuitdata import IMPEDANCE, Data
from fingerspice.studies.fit.search import Problem
from fingerspice.studies.phasors import phasor
from fingerspice.studies.steady import steady_state

if TYPE_CHECKING:
    from xarray import Dataset

# Error of the runs whose derivatives a batch gives: ten times this, relative, which is far below any data's.
_SLOPES = 1e-6


@dataclass(frozen=True)
class Task(Problem):
    """The fit of a circuit's parameters."""

    data: Data
    average: str
    skin: str
    rtol: float
    charge_law: str | None
    # (n,): What is to be predicted: the data's values, and after them the phases (deg) of an impedance where given
    target: FloatArray
    watch: Callable[[], None] = lambda: None  # Called before every evaluation

    @cached_property
    def members(self) -> BoolArray:
        """Whether each unknown belongs to each measurement, shape (n_parameter, n)."""
        groups, count = self.data.groups, self.data.values.size
        own = groups.of if groups is not None else [None] * count
        return np.array([[one.label in (None, label) for label in own] for one in self.unknowns])

    @property
    def paths(self) -> tuple[str, ...]:
        """The parameters that are fitted, each once."""
        return tuple(dict.fromkeys(one.path for one in self.unknowns))

    def of_path(self, path: str) -> list[int]:
        """Places of a parameter's unknowns: one, or one for each group."""
        return [k for k, one in enumerate(self.unknowns) if one.path == path]

    def compared(self, values: FloatArray) -> tuple[FloatArray, FloatArray]:
        self.watch()
        found, by = self._predicted(values)
        off = found - self.target
        if self.data.phase is not None:
            n = self.data.values.size
            off[n:] = np.remainder(off[n:] + 180.0, 360.0) - 180.0
        return off / self.scale, by / self.scale[:, None]

    def _predicted(self, values: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Predicted data (n,), and their derivatives by the logarithms of the parameters (n, n_parameter)."""
        data, how = self.data, {"rtol": self.rtol, "charge_law": self.charge_law, "charge": False}
        if data.t is not None:
            run = simulate(self._scene(values, 0), t_eval=data.t, sensitivities=self.paths, **how)  # type: ignore[arg-type]
            slopes = [getattr(run.sensitivities[path], data.signal) for path in self.paths]
            return np.asarray(getattr(run, data.signal)), np.array(slopes).T * values
        if data.signal == IMPEDANCE:
            moved = values * (1.0 + np.multiply.outer(STEP * np.array(AT), np.eye(values.size)))
            by = derivative([np.array([self._impedance(one) for one in each]) for each in moved], STEP)
            return self._impedance(values), by.T
        if self._in_lockstep:
            return self._in_batches(values)
        name, found, by = data.name, np.empty(data.values.size), np.zeros((data.values.size, values.size))
        for row in range(data.values.size):
            circuit = self._scene(values, row)
            felt = np.flatnonzero(self.members[:, row])
            paths = tuple(self.unknowns[k].path for k in felt)
            if self.average == "periodic":
                one = steady_state(circuit, sensitivities=paths, points=4, **how)  # type: ignore[arg-type]
            else:
                one = simulate(circuit, sensitivities=paths, t_eval=[0.0], t_stop=_end(circuit), **how)  # type: ignore[arg-type,assignment]
            found[row] = getattr(one, name)
            for k, path in zip(felt, paths, strict=True):
                by[row, k] = getattr(one.sensitivities[path], name) * values[k]
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

    def _impedance(self, values: FloatArray) -> FloatArray:
        """Magnitudes (ohm), and phases (deg) where they are given, at the area that the deck's amplitude causes."""
        how = "swept" if self.skin == "follow" else "own"
        runs = [phasor(self._scene(values, row), skin=how).impedance for row in range(self.data.values.size)]
        z = np.array([one[0] for one in runs if one is not None])
        return np.abs(z) if self.data.phase is None else np.concatenate([np.abs(z), np.degrees(np.angle(z))])

    @cached_property
    def _in_lockstep(self) -> bool:
        """Whether a batch predicts all measurements, and has their derivatives, in lockstep."""
        paths = {*self.data.conditions, *self.paths}
        skins = {f"{e.name}.f" for e in self.circuit.by_device("SKIN")}
        if self.charge_law is not None or (self.skin == "follow" and paths & skins):
            return False
        alone = self.skin == "own" or len(driving_sources(self.circuit)) == 1
        return alone and in_lockstep_by(self.circuit, paths, (self.data.name,), max(self.rtol, _SLOPES))

    def _in_batches(self, values: FloatArray) -> tuple[FloatArray, FloatArray]:
        """As `_predicted`, all measurements at once, and their derivatives with an error that suits least squares."""
        slopes = _served(self.scenes(values[None], max(self.rtol, _SLOPES), self.paths), "gradient_status")
        by = np.zeros((self.data.values.size, values.size))
        for i, path in enumerate(self.paths):
            own = self.of_path(path)
            by[:, own] = self.members[own].T * slopes[f"d_{self.data.name}"].to_numpy()[:, i, None] * values[own]
        runs = _served(self.scenes(values[None], self.rtol), "status")
        return runs[self.data.name].to_numpy(), by

    def scenes(self, values: FloatArray, rtol: float, gradients: tuple[str, ...] = ()) -> Dataset:
        """A batch of all measurements, with every row of `values` (n_row, n_parameter) one after the other."""
        table = {path: np.tile(x, len(values)) for path, x in self.data.conditions.items()}
        for path in self.paths:
            own = self.of_path(path)
            table[path] = (values[:, own] @ self.members[own]).ravel()
        return batch(
            self.circuit, table, outputs=(self.data.name,), rtol=rtol, periodic=self.average == "periodic",
            skin=self.skin, gradients=gradients,
        )  # fmt: skip


def _served(found: Dataset, status: str) -> Dataset:
    """The batch, in which no scene was refused."""
    if np.any(found[status].to_numpy() >= REFUSED):
        raise InputError(found.attrs["failures"][0])
    return found


def _end(circuit: Circuit) -> float:
    if circuit.tran is None:
        raise InputError("the deck has no .tran, and average is 'run'; allowed: a deck with .tran, or 'periodic'")
    return circuit.tran.stop
