"""What all ways of following a recording share: the source, the scale of errors, outputs, and the run that results."""

from __future__ import annotations

from abc import ABC, abstractmethod
from enum import Enum
from typing import Any

import numpy as np

from fingerspice.base.arrays import BoolArray, FloatArray
from fingerspice.results.outcome import State, Status
from fingerspice.solve.pieces import Piece, driving, spacing_of
from fingerspice.solve.problem import Problem
from fingerspice.solve.runs import Run

# The error of a piece is related to the peaks up to its end, or to this share of the largest gap voltage that the
# source may cause: noise before the first loud sound need not be exact relative to itself.
LEAST_PEAK = 1e-3


class Outcome(Enum):
    """Outcome of a piece: its error is met, or not met, or this method cannot integrate it (LOST)."""

    MET, NOT_MET, LOST = range(3)


class Following(ABC):
    """A run in progress, piece by piece.

    Attributes
    ----------
    t : float
        Time reached, s.
    share : float
        Factor of the error allowed, reduced where errors of earlier pieces add up.
    loudest : float
        Largest |U| of the source so far, V.
    u_last : float
        Value of the source at `t`, V.
    outputs : int
        Number of outputs written since `begin_outputs`.
    width : int
        Number of rows of the outputs.
    """

    outputs: int

    def __init__(self, problem: Problem, rtol: float, share: float, gain: float, width: int) -> None:
        self.problem, self.rtol, self.share, self.gain, self.width = problem, rtol, share, gain, width
        self.t, self.loudest, self.u_last = problem.t_start, 0.0, 0.0
        wave = driving(problem)
        assert wave is not None
        self.wave, self.usual = wave, spacing_of(wave)
        held = float(np.abs(problem.initial.y).max(initial=0.0))
        self.least = max(held, LEAST_PEAK * problem.scene.u_peak * gain)

    def heard(self, values: FloatArray) -> None:
        """Take notice of the source's values (V) in a piece."""
        self.loudest = max(self.loudest, float(values.max()), -float(values.min()))

    @property
    def scale(self) -> float:
        """Gap voltage to which errors are related, V."""
        return max(self.loudest * self.gain, self.least)

    def begin_outputs(self) -> None:
        """Start counting outputs from 0, for a new array of outputs."""
        self.outputs = 0

    @property
    def slope_after(self) -> float:
        """The source's slope after the end of the run, V/s."""
        after = 1e-3 * self.usual
        here, later = self.wave.value([self.problem.t_stop, self.problem.t_stop + after]).tolist()
        return float(later - here) / after

    @abstractmethod
    def follow(self, piece: Piece, values: FloatArray, t_out: FloatArray, out: FloatArray) -> Outcome:
        """Integrate a piece with the source's `values` (V), and write the outputs before its end as rows of `out`."""

    @abstractmethod
    def finish(self, t_out: FloatArray, out: FloatArray) -> None:
        """Write the outputs at the end of the run."""

    @abstractmethod
    def rows(self, t: FloatArray, left: BoolArray, out: FloatArray) -> FloatArray:
        """Outputs at times `t` (s) as rows of a record."""

    @abstractmethod
    def state(self) -> State:
        """The state reached."""

    @abstractmethod
    def stated(self) -> tuple[FloatArray, float, float | None]:
        """Peaks and stated errors as in `Run.gaps`, and stated errors of the nodes (V) and the charge (C), so far."""

    @property
    @abstractmethod
    def stats(self) -> tuple[int, int, int]:
        """Numbers of steps, of steps refused, and of evaluations."""

    @property
    def margin(self) -> float:
        """Least distance to the fold so far."""
        return 1.0

    @abstractmethod
    def mark(self) -> dict[str, Any]:
        """The state of the integration as plain data, which `stand` restores in another march through the same run."""

    @abstractmethod
    def stand(self, mark: dict[str, Any]) -> None:
        """Restore the state of another march through the same run."""

    def run(self, t: FloatArray, left: BoolArray, rows: FloatArray) -> Run:
        """The run so far, with the given outputs."""
        steps, refused, evaluated = self.stats
        stats = {"steps": steps, "rejected": refused, "zeros": 0}
        run = Run(t, left, rows, Status.SUCCESS, evaluated, stats, self.state())
        run.gaps, run.node_error, run.charge_error = self.stated()
        run.margin, run.by_layer = self.margin, self.problem.scene.stack is not None
        return run
