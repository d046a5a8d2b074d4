"""Looks at whether a run under a periodic source has reached its periodic state, from within the loop of steps."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from fingerspice.base.arrays import FloatArray
from fingerspice.base.compiled import jit_within
from fingerspice.engine.loopstate import LoopState
from fingerspice.engine.readout import ACCEPTED, MAGNIFIED, PEAK_U
from fingerspice.engine.repeat import SAME_TIME

# Overhead of an extrapolation in units of steps: once, and for each of its periods (one per live voltage, and three).
_CALLS, _CALL = 50, 10
# The coupling may make the slowest mode slower than with the area frozen; this fraction of its rate is a safe bound.
RATE_SHARE = 0.5
# Entries of `Looks.values`. Times (s): next look; first comparison of the stated error with the one asked for; start,
# period and end of the run under the periodic source.
NEXT, TRIAL, START, PERIOD, STOP = range(5)
# Error of the gap voltage allowed, V; a bound of the slowest rate, 1/s; factor of the distance at which the period map
# is tried as a linear one; number of modes that decay; whether the charge is wanted, and whether extrapolations are.
ALLOWED, RATE, NEAREST, MODES, HAS_CHARGE, LEAPS = range(5, 11)
# Largest ratio of error to peak, as estimated, that the trial accepts.
ACCEPTABLE = 11
# Periods until the next look, and until the last one, or -1; periods left after that; steps of a period.
COUNT, LOOKED, LEFT, STEPS = range(12, 16)
# What the last look found: distance at which an extrapolation is tried; bound of the change of the gap voltage in all
# later periods, and that enlarged by its effect on the charge, V; whether the run has settled; whether an extrapolation
# may pay off.
NEAR, DISTANCE, REMAINING, HAS_SETTLED, MAY_LEAP = range(16, 21)
# Set by the caller after a look: periods of an extrapolation that was accepted; ratio of error to the allowed one of
# one that was rejected.
LEAPT, EXCESS = 21, 22
N_VALUES = 23


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
def take_result(looks: Looks) -> None:
    """Account for an extrapolation that the caller has tried since the last look."""
    v = looks.values
    if v[LEAPT] > 0.0:
        v[COUNT] = v[LOOKED] = v[LOOKED] + v[LEAPT]
        _plan(v, 1.0, _periods_left(v, v[START] + v[LOOKED] * v[PERIOD]))
    elif v[EXCESS] > 0.0:
        # The error of a linear map goes with the square of the distance, hence the root. Wait until nearer.
        v[NEAR] = max(v[ALLOWED], v[DISTANCE] * min(0.5, 0.7 / math.sqrt(v[EXCESS])))
        v[COUNT] = v[LOOKED]
        _plan(v, _wait(v), _periods_left(v, v[START] + v[LOOKED] * v[PERIOD]))
    v[LEAPT] = v[EXCESS] = 0.0


@jit_within
def look(looks: Looks, s: LoopState) -> bool:
    """Compare the state with that of the last look; True if the caller has something to do.

    Sets what the look has found, and plans the next one.
    """
    v, before = looks.values, looks.before
    magnified = s.control[MAGNIFIED]
    v[STEPS] = v[LEAPS] * s.counters[ACCEPTED] / max(v[COUNT], 1.0)
    if v[LEAPS] > 0.0 and s.control[PEAK_U] > 0.0:
        v[NEAR] = max(v[ALLOWED], min(v[NEAR], v[NEAREST] * math.sqrt(v[ALLOWED] * s.control[PEAK_U])))
    v[DISTANCE] = v[REMAINING] = math.inf
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
        v[DISTANCE] = moved * min(left / passed, max(1.0 / math.expm1(decay), 1e-3))
        v[REMAINING] = v[DISTANCE]
        if v[HAS_CHARGE] > 0.0:
            # The charge error of the repeated period accumulates in every later period.
            v[REMAINING] *= max(1.0, left * min(1.0, v[RATE] * v[PERIOD]))
    v[LOOKED], v[LEFT] = v[COUNT], left
    settled = v[REMAINING] <= v[ALLOWED]
    v[HAS_SETTLED] = 1.0 if settled else 0.0
    v[MAY_LEAP] = 1.0 if v[LEAPS] > 0.0 and v[DISTANCE] <= v[NEAR] and _is_far(v, left) else 0.0
    _plan(v, 1.0 if settled else _wait(v), left)
    return bool(settled or v[MAY_LEAP] > 0.0 or s.kept.times.size > 0)


@jit_within
def _periods_left(v: FloatArray, t: float) -> float:
    """Whole periods from t (s) to the end of the run."""
    return max(0.0, float(np.floor((v[STOP] - t) / v[PERIOD] * (1.0 + 1e-12))))


@jit_within
def _until(v: FloatArray, share: float) -> float:
    """Periods in which the slowest mode of the frozen circuit decays to `share`; NaN where that is undefined."""
    per_period = v[RATE] / RATE_SHARE * v[PERIOD]
    if not (0.0 < share < math.inf and 0.0 < per_period < math.inf):
        return math.nan
    return float(-math.log(share) / per_period)


@jit_within
def _is_far(v: FloatArray, left: float) -> bool:
    """Whether an extrapolation saves more than twice its own cost, both counted in steps."""
    if v[DISTANCE] > v[ALLOWED]:
        until = _until(v, v[ALLOWED] / v[REMAINING])
        if until != until:
            return False
        left = min(until, left)
    # Otherwise only the charge has not settled. It may never do so, because truncation errors of the steps keep
    # the states of successive periods different: all remaining periods would be integrated.
    saved = left * v[STEPS]
    return bool(saved > 2.0 * ((v[MODES] + 3.0) * (v[STEPS] + _CALL) + _CALLS))


@jit_within
def _wait(v: FloatArray) -> float:
    """Periods until the run may have settled or may be extrapolated, at most twice the periods passed so far."""
    wait = _until(v, v[ALLOWED] / v[REMAINING])
    if _is_far(v, math.inf):
        wait = _until(v, v[NEAR] / v[DISTANCE])
    return 1.0 if wait != wait else max(1.0, min(float(np.ceil(0.8 * wait)), 2.0 * v[COUNT]))


@jit_within
def _plan(v: FloatArray, wait: float, left: float) -> None:
    v[COUNT] += wait
    v[NEXT] = v[START] + v[COUNT] * v[PERIOD] if wait < left else math.inf
