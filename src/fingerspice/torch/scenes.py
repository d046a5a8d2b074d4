"""Scenes of one circuit as arrays: what a run answers, and its derivatives by parameters. No tensors here."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from fingerspice.base.arrays import FloatArray
from fingerspice.base.errors import FingerspiceWarning, InputError
from fingerspice.circuit.circuit import Circuit
from fingerspice.results.outcome import SolveError
from fingerspice.results.sensitivity import MEANS
from fingerspice.results.solution import Solution
from fingerspice.solve.simulation import simulate
from fingerspice.studies.batch import batch
from fingerspice.studies.batchgradients import in_lockstep_by
from fingerspice.studies.batchtask import REFUSED
from fingerspice.studies.steady import SteadyState, steady_state

if TYPE_CHECKING:
    from xarray import Dataset


@dataclass(frozen=True)
class Scenes:
    """Runs of a circuit with other values of its parameters."""

    circuit: Circuit
    outputs: tuple[str, ...]  # Names out of `SIGNALS` and `MEANS`
    t: FloatArray  # (n_t,): Times of the signals, s; empty where there are only means
    t_stop: float | None  # End of every run, s; None where only the periodic state is asked for
    periodic: bool  # Whether the periodic state is asked for, and not the run
    rtol: float

    @property
    def sizes(self) -> list[int]:
        """How many numbers each output has."""
        return [1 if name in MEANS else self.t.size for name in self.outputs]

    def values(self, paths: Sequence[str], given: FloatArray) -> FloatArray:
        """The outputs one after the other, shape (n_scene, sum of `sizes`), at values `given` (n_scene, n_path)."""
        if not self.t.size:
            return self._means(paths, given)
        out = np.empty((len(given), sum(self.sizes)))
        for i, row in enumerate(given):
            with _named(i):
                out[i] = np.concatenate([np.ravel(getattr(run, name)) for name, run in self._runs(paths, row, ())])
        return out

    def slopes(self, paths: Sequence[str], wanted: Sequence[str], given: FloatArray) -> FloatArray:
        """Derivatives of `values` by the parameters `wanted`, shape (n_scene, sum of `sizes`, n_wanted)."""
        if not self.t.size and in_lockstep_by(self.circuit, paths, self.outputs, self.rtol):
            found = self._batch(paths, given, wanted)
            return np.stack([found[f"d_{name}"].to_numpy() for name in self.outputs], axis=1)
        out = np.empty((len(given), sum(self.sizes), len(wanted)))
        for i, row in enumerate(given):
            with _named(i):
                runs = self._runs(paths, row, wanted)
                for k, path in enumerate(wanted):
                    parts = [np.ravel(getattr(run.sensitivities[path], name)) for name, run in runs]
                    out[i, :, k] = np.concatenate(parts)
        return out

    def _means(self, paths: Sequence[str], given: FloatArray) -> FloatArray:
        """Means alone, of all scenes at once."""
        found = self._batch(paths, given, ())
        return np.stack([found[name].to_numpy().reshape(len(given)) for name in self.outputs], axis=1)

    def _batch(self, paths: Sequence[str], given: FloatArray, wanted: Sequence[str]) -> Dataset:
        found = batch(
            self.circuit, dict(zip(paths, given.T, strict=True)), outputs=self.outputs, rtol=self.rtol,
            periodic=self.periodic, t_stop=None if self.periodic else self.t_stop, gradients=wanted,
        )  # fmt: skip
        bad = np.flatnonzero(found["gradient_status" if wanted else "status"].to_numpy() >= REFUSED)
        if bad.size:
            raise InputError(f"{bad.size} of {len(given)} scenes cannot be run; {found.attrs['failures'][0]}")
        return found

    def _runs(
        self, paths: Sequence[str], row: FloatArray, wanted: Sequence[str]
    ) -> list[tuple[str, Solution | SteadyState]]:
        """Every output of a scene with the run that has it."""
        circuit = self.circuit.varied(dict(zip(paths, row.tolist(), strict=True)))
        state: SteadyState | None = None
        run: Solution | None = None
        found: list[tuple[str, Solution | SteadyState]] = []
        for name in self.outputs:
            if self.periodic and name in MEANS:
                state = state or steady_state(circuit, rtol=self.rtol, points=4, charge=False, sensitivities=wanted)
                found.append((name, state))
                continue
            run = run or simulate(
                circuit, t_stop=self.t_stop, t_eval=self.t if self.t.size else np.array([self.t_stop]), rtol=self.rtol,
                charge=False, start="periodic" if self.periodic else "deck", sensitivities=wanted,
            )  # fmt: skip
            found.append((name, run))
        return found


@contextmanager
def _named(scene: int) -> Iterator[None]:
    """Names the scene in an error, and leaves out warnings about values that an optimiser has chosen."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", FingerspiceWarning)
            yield
    except (InputError, SolveError) as error:
        raise InputError(f"scene {scene}: {error}") from error
