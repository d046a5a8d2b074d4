"""Test whether a run under a periodic source has reached its periodic state: then one period gives all later ones."""

from __future__ import annotations

import math

import numpy as np

from fingerspice.base.arrays import FloatArray
from fingerspice.engine import settling as looks
from fingerspice.engine.settling import Looks
from fingerspice.solve.problem import Problem

# Runs of fewer periods are integrated throughout, because nothing would be saved.
FEWEST_PERIODS = 6.0
# Number of the source's periods after which a run's error is first compared with its peaks, where ten times as many
# are left.
TRIAL_PERIODS = 2.0
# Remaining change allowed over all later periods, as a fraction of the error allowed in a step.
_SHARE = 1.0 / 3.0


class Settling:
    """Compares the states after whole periods until later periods no longer change them.

    The compiled loop does so (`engine.settling`); this class begins it and reads what it finds.

    Parameters
    ----------
    problem : Problem
    rates : ndarray
        Rates of the modes with the area frozen, 1/s.
    tol : float
        Error of the gap voltage allowed in a step, V.
    scale : ndarray, shape (n,)
        Converts the first n entries of the integration's state to volts.

    Attributes
    ----------
    looks : Looks
        As the compiled loop takes it.
    period, allowed : float
        Period of the source, s; remaining change allowed, V.
    """

    def __init__(self, problem: Problem, rates: FloatArray, tol: float, scale: FloatArray) -> None:
        self.period = problem.waveform.period or math.inf
        self.allowed = _SHARE * tol
        start = max(problem.t_start, problem.waveform.settled)
        live = rates[rates > 0.0]
        values = np.zeros(looks.N_VALUES)
        self.looks = Looks(values, np.zeros(scale.size), scale)
        values[looks.START], values[looks.STOP], values[looks.PERIOD] = start, problem.t_stop, self.period
        values[looks.ALLOWED], values[looks.HAS_CHARGE], values[looks.LOOKED] = self.allowed, problem.charge, -1.0
        # A mode with rate 0 keeps its charge for ever, so that it does not limit the time to the periodic state.
        values[looks.RATE] = looks.RATE_SHARE * float(live.min()) if live.size else math.inf
        values[looks.DISTANCE] = values[looks.REMAINING] = values[looks.TRIAL] = math.inf
        self._periods = (problem.t_stop - start) / self.period * (1.0 + 1e-12)
        values[looks.NEXT] = start if self._periods >= FEWEST_PERIODS else math.inf

    def try_out(self, acceptable: float) -> None:
        """Compare the ratio of estimated error to peak with the `acceptable` one after a few periods."""
        values = self.looks.values
        if self._periods >= 1.0 + 10.0 * TRIAL_PERIODS:
            values[looks.TRIAL] = values[looks.START] + TRIAL_PERIODS * self.period
            values[looks.ACCEPTABLE] = acceptable

    def refine(self, share: float) -> None:
        """Go on with this share of the error allowed, as the voltages have settled, and not the charge."""
        self.allowed *= share
        self.looks.values[looks.ALLOWED], self.looks.values[looks.FINE] = self.allowed, 1.0

    def stop_looking(self) -> None:
        """Integrate to the end without further looks."""
        self.looks.values[looks.NEXT] = math.inf

    @property
    def has_settled(self) -> bool:
        """Whether the last look found that later periods no longer change the state."""
        return bool(self.looks.values[looks.HAS_SETTLED])

    @property
    def left(self) -> int:
        """Whole periods from the last look to the end of the run."""
        return int(self.looks.values[looks.LEFT])

    @property
    def remaining(self) -> tuple[float, float]:
        """Bound of the change of the gap voltage after the last look, V; then enlarged by its effect on the charge."""
        return float(self.looks.values[looks.DISTANCE]), float(self.looks.values[looks.REMAINING])
