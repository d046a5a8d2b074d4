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
# Looks with finer steps after which the charge counts as settled with the voltages: what is left of it is stated.
_FINE_LOOKS = 3
# Entries of `Looks.values`. Times (s): next look; first comparison of the stated error with the one asked for; start,
# period and end of the run under the periodic source.
NEXT, TRIAL, START, PERIOD, STOP = range(5)
# Error of the gap voltage allowed, V; a bound of the slowest rate, 1/s; whether the charge is wanted.
ALLOWED, RATE, HAS_CHARGE = range(5, 8)
# Largest ratio of error to peak, as estimated, that the trial accepts.
ACCEPTABLE = 8
# Periods until the next look, and until the last one, or -1; periods left after that.
COUNT, LOOKED, LEFT = range(9, 12)
# What the last look found: bound of the change of the gap voltage in all later periods, and that enlarged by its effect
# on the charge, V; whether the run has settled.
DISTANCE, REMAINING, HAS_SETTLED = range(12, 15)
# Looks since steps are finer, as the voltages had settled and the charge had not; 0 before that.
FINE, N_VALUES = 15, 16


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
    left = max(0.0, float(np.floor((v[STOP] - v[NEXT]) / v[PERIOD] * (1.0 + 1e-12))))
    v[LEFT] = left
    if s.kept.times.size > 0:
        # The period that is to be repeated has passed.
        return True
    moved = 0.0
    for k in range(before.size):
        now = looks.scale[k] * s.y[k]
        moved = max(moved, abs(now - before[k]))
        before[k] = now
    moved *= s.control[MAGNIFIED]
    v[DISTANCE] = v[REMAINING] = math.inf
    # Periods in which the slowest mode of the frozen circuit decays to 1/e.
    memory = RATE_SHARE / (v[RATE] * v[PERIOD])
    wait = 1.0
    if v[LOOKED] >= 0.0:
        passed = v[COUNT] - v[LOOKED]
        decay = min(v[RATE] * v[PERIOD] * passed, 700.0)
        # Later changes form a geometric series, or with negligible decay each period changes as much as the last.
        v[DISTANCE] = v[REMAINING] = moved * min(left / passed, max(1.0 / math.expm1(decay), 1e-3))
        if v[HAS_CHARGE] > 0.0:
            # The charge error of the repeated period accumulates in every later period.
            v[REMAINING] *= max(1.0, left * min(1.0, v[RATE] * v[PERIOD]))
        # Until the distance has decayed to what is allowed, and long enough that the steps' errors are not most of a
        # change.
        wait = 0.8 * memory * max(1.0, math.log(max(v[DISTANCE] / v[ALLOWED], 1e-300)))
        wait = max(1.0, min(float(np.ceil(wait)), 2.0 * v[COUNT]))
    near = v[DISTANCE] <= v[ALLOWED]
    settled = near and (v[FINE] > _FINE_LOOKS or v[REMAINING] <= v[ALLOWED])
    v[FINE] += 1.0 if v[FINE] > 0.0 else 0.0
    v[HAS_SETTLED], v[LOOKED] = 1.0 if settled else 0.0, v[COUNT]
    v[COUNT] += 1.0 if settled else wait
    v[NEXT] = v[START] + v[COUNT] * v[PERIOD] if v[COUNT] - v[LOOKED] < left else math.inf
    return bool(settled or (near and v[FINE] == 0.0))
