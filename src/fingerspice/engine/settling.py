"""Looks at whether a run under a periodic source has reached its periodic state, from within the loop of steps."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from fingerspice.base.arrays import FloatArray
from fingerspice.base.compiled import jit_within
from fingerspice.engine.loopstate import LoopState
from fingerspice.engine.readout import MAGNIFIED
from fingerspice.engine.repeat import SAME_TIME

# The coupling may make the slowest mode slower than with the area frozen; this fraction of its rate is a safe bound.
RATE_SHARE = 0.5
# Entries of `Looks.values`. Times (s): next look; first comparison of the stated error with the one asked for; start,
# period and end of the run under the periodic source.
NEXT, TRIAL, START, PERIOD, STOP = range(5)
# Error of the gap voltage allowed, V; a bound of the slowest rate, 1/s; whether the charge is wanted.
ALLOWED, RATE, HAS_CHARGE = range(5, 8)
# Largest ratio of error to peak, as estimated, that the trial accepts.
ACCEPTABLE = 8
# Periods until the next look, and until the last one, or -1; periods left after that.
COUNT, LOOKED, LEFT = range(9, 12)
# What the last look found: bound of the change of the gap voltage in all later periods, enlarged by its effect on the
# charge, V; whether the run has settled.
REMAINING, HAS_SETTLED, N_VALUES = range(12, 15)


class Looks(NamedTuple):
    """When a run looks for its periodic state, and what it has found."""

    values: FloatArray  # (N_VALUES,): The entries are named above
    before: FloatArray  # (n,): State at the last look, V
    scale: FloatArray  # (n,): Converts the first n entries of the integration's state to volts


def no_looks() -> Looks:
    """For a run that does not look for a periodic state."""
    values = np.zeros(N_VALUES)
    values[NEXT] = values[TRIAL] = math.inf
    return Looks(values, np.zeros(0), np.zeros(0))


@jit_within
def next_stop(looks: Looks, edges: FloatArray, t_end: float) -> float:
    """Time (s) of the next look or trial, or the edge of the sources that differs from it by rounding only."""
    v = looks.values
    t = float(min(v[NEXT], v[TRIAL]))
    if t < t_end:
        for i in range(edges.size):
            if abs(edges[i] - t) <= SAME_TIME * abs(edges[i]):
                return float(min(edges[i], t_end))
    return min(t, t_end)


@jit_within
def look(looks: Looks, s: LoopState) -> bool:
    """Compare the state with that of the last look; True if the caller has something to do.

    Sets what the look has found, and plans the next one.
    """
    v, before = looks.values, looks.before
    magnified = s.control[MAGNIFIED]
    v[REMAINING] = math.inf
    left = _periods_left(v, v[NEXT])
    moved = 0.0
    for k in range(before.size):
        now = looks.scale[k] * s.y[k]
        moved = max(moved, abs(now - before[k]))
        before[k] = now
    moved *= magnified
    if v[LOOKED] >= 0.0:
        passed = v[COUNT] - v[LOOKED]
        decay = min(v[RATE] * v[PERIOD] * passed, 700.0)
        # Later changes form a geometric series, or with negligible decay each period changes as much as the last.
        v[REMAINING] = moved * min(left / passed, max(1.0 / math.expm1(decay), 1e-3))
        if v[HAS_CHARGE] > 0.0:
            # The charge error of the repeated period accumulates in every later period.
            v[REMAINING] *= max(1.0, left * min(1.0, v[RATE] * v[PERIOD]))
    v[LOOKED], v[LEFT] = v[COUNT], left
    settled = v[REMAINING] <= v[ALLOWED]
    v[HAS_SETTLED] = 1.0 if settled else 0.0
    _plan(v, 1.0 if settled else _wait(v), left)
    return bool(settled or s.kept.times.size > 0)


@jit_within
def _periods_left(v: FloatArray, t: float) -> float:
    """Whole periods from t (s) to the end of the run."""
    return max(0.0, float(np.floor((v[STOP] - t) / v[PERIOD] * (1.0 + 1e-12))))


@jit_within
def _wait(v: FloatArray) -> float:
    """Periods until the run may have settled, at most twice the periods passed so far.

    In these the slowest mode of the frozen circuit decays to what is allowed.
    """
    share, per_period = v[ALLOWED] / v[REMAINING], v[RATE] / RATE_SHARE * v[PERIOD]
    if not (0.0 < share < math.inf and 0.0 < per_period < math.inf):
        return 1.0
    return float(max(1.0, min(np.ceil(-0.8 * math.log(share) / per_period), 2.0 * v[COUNT])))


@jit_within
def _plan(v: FloatArray, wait: float, left: float) -> None:
    v[COUNT] += wait
    v[NEXT] = v[START] + v[COUNT] * v[PERIOD] if wait < left else math.inf
