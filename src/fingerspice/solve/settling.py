"""When a run under a periodic source looks whether it has reached its periodic state: `engine.settling` does."""

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


def looks_of(problem: Problem, rates: FloatArray, tol: float, scale: FloatArray, repeat: bool) -> Looks:
    """The looks of a run, none where it is not to `repeat` a period.

    Parameters
    ----------
    problem : Problem
    rates : ndarray
        Rates of the modes with the area frozen, 1/s.
    tol : float
        Error of the gap voltage allowed in a step, V.
    scale : ndarray, shape (n,)
        Converts the first n entries of the integration's state to volts.
    repeat : bool
    """
    period, start = problem.waveform.period or math.inf, max(problem.t_start, problem.waveform.settled)
    live, values = rates[rates > 0.0], np.zeros(looks.N_VALUES)
    values[looks.START], values[looks.STOP], values[looks.PERIOD] = start, problem.t_stop, period
    values[looks.ALLOWED], values[looks.HAS_CHARGE], values[looks.LOOKED] = _SHARE * tol, problem.charge, -1.0
    # A mode with rate 0 keeps its charge for ever, so that it does not limit the time to the periodic state.
    values[looks.RATE] = looks.RATE_SHARE * float(live.min()) if live.size else math.inf
    values[looks.DISTANCE] = values[looks.REMAINING] = values[looks.TRIAL] = math.inf
    values[looks.NEXT] = start if repeat and periods_of(values) >= FEWEST_PERIODS else math.inf
    return Looks(values, np.zeros(scale.size), scale)


def periods_of(values: FloatArray) -> float:
    """Number of periods of a run, from the values of its looks."""
    return float((values[looks.STOP] - values[looks.START]) / values[looks.PERIOD] * (1.0 + 1e-12))


def try_out(values: FloatArray, acceptable: float) -> None:
    """Compare the ratio of estimated error to peak with the `acceptable` one after a few periods."""
    if periods_of(values) >= 1.0 + 10.0 * TRIAL_PERIODS:
        values[looks.TRIAL] = values[looks.START] + TRIAL_PERIODS * values[looks.PERIOD]
        values[looks.ACCEPTABLE] = acceptable
