"""What the loop of exponential steps and its circuits share: the run, the step at hand, and periods that repeat one.

The step at hand is a record, because its parts are functions of their own, and because a run may pause between two
steps and continue in a later call. A billion periods take half a minute to write: compiled calls of some milliseconds,
each of which hands its state to the next, let Python react to Ctrl-C, and no result depends on where they are divided.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fingerspice.base.arrays import FloatArray, IntArray
from fingerspice.base.compiled import borrow, jit, jit_within
from fingerspice.engine.collocation.readout import (
    KEPT,
    OUTPUT,
    RECORDED,
    REJECTED,
    WRITTEN_AT_ONCE,
    Control,
    Outputs,
    Steps,
    record,
    series_of,
    write_outputs,
)
from fingerspice.numerics.chebyshev import to_powers
from fingerspice.numerics.lobatto import NODES
from fingerspice.numerics.small import copy_to

# Relative distance within which two times count as equal: a few units in the last place. So much the end of a step,
# shifted by whole periods, may miss an output time.
SAME_TIME = 8e-16
# Number of steps in one compiled call.
AT_ONCE = 1_000_000


class Kept(NamedTuple):
    """Steps kept for repetition."""

    times: FloatArray  # (n_step, 3): Start, length and reached end of each step, s
    series: FloatArray  # (n_step, n_column, ROWS): Chebyshev coefficients of the output columns over the whole length


def repeat(
    kept: Kept, count: int, period: float, periods: int, drifts: FloatArray, first: int, outputs: Outputs
) -> int:  # fmt: skip
    """Write the outputs, from number `first` on, of so many periods (s) that follow the kept one of `count` steps.

    `drifts` (n_column,) are the gains of the columns in a period; only charges have one, C. The kept series are used
    up. Returns the first output that is left.
    """
    # Of each step: its outputs in the period before, and whether it is in powers of x.
    held, as_powers, most = np.zeros(count, np.int64), np.zeros(count, np.bool_), max(1, AT_ONCE // max(1, count))
    for begin in range(0, periods, most):
        end = min(begin + most, periods)
        first = _repeat(kept, held, as_powers, period, begin + 1, end + 1, drifts, first, outputs)
        if first >= outputs.t.size:
            break
    return first


@jit
def _repeat(
    kept: Kept, held: IntArray, as_powers: NDArray[np.bool_], period: float, begin: int, end: int, drifts: FloatArray,
    first: int, outputs: Outputs,
) -> int:  # fmt: skip
    """As `repeat`, of the periods from `begin` to before `end`."""
    times, series = borrow(kept.times), borrow(kept.series)
    outputs, drifts = borrow(outputs), borrow(drifts)
    t_out, out = outputs.t, outputs.columns
    held, as_powers = borrow(held), borrow(as_powers)
    if begin == 1:
        _make_powers(series, as_powers)
    work = np.zeros((2, WRITTEN_AT_ONCE))
    for k in range(begin, end):
        shift = k * period
        before = first
        for i in range(held.size):
            if first >= t_out.size:
                break
            stop = times[i, 2] + shift
            slack = SAME_TIME * abs(stop)
            if t_out[first] > stop + slack:
                continue
            h = times[i, 1]
            reached = (times[i, 2] - times[i, 0]) / h
            # Mostly a period has as many outputs as the one before.
            held[i] = write_outputs(
                times[i, 0] + shift, h, min(reached, 1.0), stop, slack, as_powers[i], series[i], work, first, held[i],
                outputs,
            )  # fmt: skip
            first += held[i]
        for c in range(out.shape[0]):
            if drifts[c] != 0.0:
                for i in range(before, first):
                    out[c, i] += k * drifts[c]
    return first


@jit
def _make_powers(series: FloatArray, made: NDArray[np.bool_]) -> None:
    """Turn Chebyshev coefficients (n_step, n_column, ROWS) into those of 1, x, x^2, ..., which halve the work.

    This is done for steps where the powers are as exact, which `made` (n_step,) marks.
    """
    room = np.zeros(NODES)
    for i in range(made.size):
        made[i] = True
        for c in range(series.shape[1]):
            made[i] &= to_powers(series[i, c, :NODES], room)
        if not made[i]:
            continue
        for c in range(series.shape[1]):
            to_powers(series[i, c, :NODES], room)
            copy_to(series[i, c, :NODES], room)


# Codes returned by the loop: the end is reached; no step is short enough (a fold, or an error that cannot be met); a
# gap voltage is beyond the range of the area's polynomial; too many steps; `Steps` is full, or Python may react to
# Ctrl-C (call again); the areas need a reference that has not been made yet; the stated error is too large already; the
# periodic state was looked for, and the caller has something to do (see `engine.collocation.loop`).
DONE, NO_STEP, OUT_OF_RANGE, TOO_MANY, PAUSED, REFERENCE, EXCESSIVE, LOOKED_AT = range(8)
# Codes of the parts of a step, beside these: go on with the next part; start again with this step; try another length.
GO_ON, AGAIN, RETRY = -1, -2, -3

STEP = np.dtype([
    ("length", float),  # s: being tried
    ("wanted", float),  # s: before a boundary or a zero cut it short
    ("tabled", float),  # s: to which the exponential tables in use belong
    ("theta", float),  # Fraction of the length that counts
    ("t_new", float),  # s: reached at that fraction
    ("step_error", float),  # V: of the step, which controls its length
    ("grown", float),  # Largest ratio of a move of the gap voltage to the move of a state voltage
    ("start", float),  # s: of the source's segment at hand
    ("edge", float),  # s: its end
    ("since", float),  # s: time since its start
    ("stop", float),  # s: end of the step's range
    ("begun", float),  # s: since which evaluations are counted
    ("below", float),  # Fraction of the step at which the gap voltage dips off its branch, or 0
    ("is_paused", np.int64),
    ("index", np.int64),  # Of the source's segment
    ("level", np.int64),  # Of the reference area
    ("slot", np.int64),  # Of the tables
    ("fresh", np.int64),  # Whether it is the first after an edge or a zero
    ("tries", np.int64),  # Lengths tried
    ("flips", np.int64),  # Branches left in a row without a step
    ("converged", np.int64),  # Whether the iteration has
    ("trusted", np.int64),  # Whether it has at the last length that was rejected
    ("wrong", np.int64),  # First node off its branch, or 0
    ("crossed", np.int64),  # The area whose gap voltage ends the step by a zero, or -1
    ("evaluated", np.int64),  # Rows, at the last edge of the source
    ("most", np.int64),  # Steps allowed
    ("unconverged", np.int64),  # Iterations of this call
    ("accepted_before", np.int64),  # Steps, before this call
    ("pause_at", np.int64),  # So many accepted steps
    # Of a network
    ("has_begun", np.int64),  # Whether the call has
    ("in_jump", np.int64),  # Whether it is within a jump of the sources
    ("at_edge", np.int64),
    ("smooth", np.int64),  # Whether no voltage follows a source at once
    ("several", np.int64),  # Whether the areas are coupled
    ("whole", np.int64),  # Whether no mode counts as stiff
])  # fmt: skip
"""The step at hand."""


class LoopState(NamedTuple):
    """An integration in progress; the loop updates all arrays."""

    y: FloatArray  # State voltages (V), areas with a time constant, and charges (C)
    # Estimated error of the modes, signed; of a stack, then the number of the reference area that they belong to
    error: FloatArray
    # control, counters: Bookkeeping, see `engine.collocation.readout`
    control: Control
    counters: IntArray
    step: NDArray[Any]  # (1,): A record of type `STEP`
    # (n_area + 1, 4): Largest voltage (V) and force (N) of each gap and, in the last row, of the nodes; errors of both
    peaks: FloatArray
    # (2, n_s): Lasting errors of the charges: the sum of those of known sign (C), that of the squares of others (C^2)
    collected: FloatArray
    outputs: Outputs
    # Takes the first steps, for repeated periods, until it is full; `counters` tells how many steps there were
    kept: Kept
    steps: Steps  # Takes all steps, for figures of the run
    # (TRIED, 4): Ring buffer of the last steps tried: start and length (s), ratio of the error to the allowed one,
    # number from 1
    tried: FloatArray


@jit_within
def may_shorten(s: LoopState, since: float) -> bool:
    """Let a quarter be tried of a step that starts at a zero and is on neither branch; False where it is rounding.

    The rounding of its length is relative to the time `since` (s).
    """
    if s.step[0].length <= 1e-13 * max(since, 1e-3 * (s.step[0].stop - s.control[0].t)):
        return False
    s.counters[REJECTED] += 1
    s.control[0].h, s.step[0].flips = 0.25 * s.step[0].length, 0
    return True


@jit_within
def is_wanted(s: LoopState, t_new: float) -> bool:
    """Whether a step that ends at `t_new` (s) has outputs, or is recorded or kept."""
    first = s.counters[OUTPUT]
    return (
        s.steps.times.shape[0] > 0
        or s.kept.times.size > 0
        or (first < s.outputs.t.size and s.outputs.t[first] <= t_new)
    )


@jit_within
def write_step(s: LoopState, t: float, values: FloatArray, coefficients: FloatArray, work: FloatArray) -> None:
    """Record a finished step that began at t (s), keep it for repetition, and write its outputs.

    `values` (n_column, ROWS) are the columns at the rows of the step; `coefficients` takes their Chebyshev
    coefficients.
    """
    counters, kept_times = s.counters, s.kept.times
    h, theta, t_new = s.step[0].length, s.step[0].theta, s.step[0].t_new
    if s.steps.times.shape[0] > 0:
        record(s.steps.times, s.steps.values, counters[RECORDED], t, h, t_new, theta, values)
        counters[RECORDED] += 1
    first = counters[OUTPUT]
    has_outputs = first < s.outputs.t.size and s.outputs.t[first] <= t_new
    if not has_outputs and kept_times.size == 0:
        return
    for c in range(s.outputs.columns.shape[0]):
        series_of(values[c], coefficients[c])
    place = counters[KEPT]
    counters[KEPT] += 1
    if place < kept_times.shape[0]:
        kept_times[place, 0], kept_times[place, 1], kept_times[place, 2] = t, h, t_new
        copy_to(s.kept.series[place], coefficients[: s.outputs.columns.shape[0]])
    if has_outputs:
        counters[OUTPUT] += write_outputs(
            t, h, theta, t_new, 0.0, False, coefficients, work, first, 0, s.outputs
        )  # fmt: skip
