"""Quantities computed from a finished step: zeros of the gap voltage, state and error inside it, outputs, peaks.

Also what the loop of exponential steps and its circuits share: the run, the step at hand, and periods that repeat one.
The step at hand is a record, because its parts are functions of their own, and because a run may pause between two
steps and continue in a later call. A billion periods take half a minute to write: compiled calls of some milliseconds,
each of which hands its state to the next, let Python react to Ctrl-C, and no result depends on where they are divided.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fingerspice.base.arrays import FloatArray, IntArray, aligned
from fingerspice.base.compiled import borrow, jit, jit_rows, jit_within
from fingerspice.numerics.lobatto import BARYCENTRIC, END, FIRST, NODES, POINTS, ROWS, TO_SERIES

CONTROL = np.dtype([
    ("t", float),  # s
    ("h", float),  # s: length of the next step
    ("u_before", float),  # V: source before `t`
    ("u_gap", float),  # V
    ("too_long", float),  # s: a length that was rejected recently
    ("h_after_edge", float),  # s: the first step taken after an edge of the source
    ("magnified", float),  # Largest change of the gap voltage for a change of 1 V of a state voltage
    ("error_q", float),  # C: largest error of the charge so far
    ("last_q", float),  # 1/m^2: 1/A where the last step ended
    ("allowed", float),  # s: length that the last step's error would have allowed; 0 if it says nothing about the next
    ("h_after_zero", float),  # s: the first step taken after a zero of the gap voltage; 0 before the first
    ("margin", float),  # Smallest distance to the fold so far
    ("peak_q", float),  # C
])  # fmt: skip
"""Bookkeeping of a run."""
Control = Any  # A record of type `CONTROL`
# Entries of `counters`: rows evaluated, steps accepted and rejected, zeros, outputs written, steps kept, recorded.
NFEV, ACCEPTED, REJECTED, ZEROS, OUTPUT, KEPT, RECORDED = 0, 1, 2, 3, 4, 5, 6
N_COUNTERS = 7
# Columns of `LoopState.peaks`.
PEAK_U, PEAK_F, ERROR_U, ERROR_F = range(4)
# Places of a step at which the error is known: its start, the three points between nodes, its end; as fractions of the
# step; and for each, the first and the last node between its neighbours.
N_PLACES = 5
_AT = np.array([0.0, *POINTS[NODES:], 1.0])
_NEAR = ((0, 1), (0, 5), (1, 9), (6, END), (10, END))
# Number of last steps tried that are kept, as rows: start and length (s), error over the one allowed, number.
TRIED = 8
# Most steps, accepted and rejected, in a window of the source, which has a few thousand periods at most. A run that
# needs more has a problem that smaller steps do not solve.
MOST_STEPS = 200_000
# Most evaluations at all rows since an edge of the source: a first allowance, and one more for each longest step that
# fits into the time since. A fast mode that the area affects may let only short steps converge, and another method is
# faster there.
FIRST_PASSES, MOST_PASSES = 20_000, 2_000
# Outputs are evaluated in groups as wide as the processor's vectors, and searched in strides.
_GROUP, _STRIDE = 8, 32


class Steps(NamedTuple):
    """Takes finished steps, as many as there is room for."""

    # (capacity, 4): Start and length (s), the end reached (s), and which fraction of the length that is: a step may be
    # shorter than the rounding of the time
    times: FloatArray
    values: FloatArray  # (capacity, n_column, NODES): The first output columns at the nodes of the whole length


def new_steps(capacity: int, columns: int) -> Steps:
    """Room for so many steps."""
    return Steps(np.empty((capacity, 4)), np.empty((capacity, columns, NODES)))


@jit
def note(tried: FloatArray, number: int, t: float, h: float, error: float) -> None:
    """Keep a step tried, its error over the one allowed, in place of the oldest."""
    place = number % tried.shape[0]
    tried[place, 0] = t
    tried[place, 1] = h
    tried[place, 2] = error
    tried[place, 3] = number + 1


class Outputs(NamedTuple):
    """Where a run's outputs go."""

    # t, left (n_out,): Output times (s, ascending), and whether the left-hand limit is meant
    t: FloatArray
    left: NDArray[np.bool_]
    columns: FloatArray  # (n_column, n_out): To be filled


class Modal(NamedTuple):
    """Arrays of the modes of a step, and of what is read from them; those with ROWS behind have a value at each row."""

    # w, base, pull, used (m, ROWS): The modes, and those without the nonlinear term; this term at them, and as used for
    # them
    w: FloatArray
    base: FloatArray
    pull: FloatArray
    used: FloatArray
    # pull_before, left_before (m, ROWS): Nonlinear term and what was left of it an iteration before
    pull_before: FloatArray
    left_before: FloatArray
    spare: FloatArray  # (6, m, ROWS): Scratch
    # w0, weight (m,): The modes at the start of the step; move of the gap voltage over it by a unit forcing of each
    w0: FloatArray
    weight: FloatArray
    # places, brief (m, N_PLACES), carried (m, N_PLACES - 1): Errors of the modes; those of their interpolation, which
    # are zero at both ends; and those carried over from earlier steps
    places: FloatArray
    brief: FloatArray
    carried: FloatArray
    run: FloatArray  # (n_area, N_PLACES): Errors of the gaps' voltages, V
    # values, coefficients (n_column, ROWS): Output columns and their Chebyshev coefficients
    values: FloatArray
    coefficients: FloatArray
    basis: FloatArray  # (NODES,): See `readout.basis_at`
    # u, guess (n_area, ROWS): Gap voltages now and an iteration before, V
    u: FloatArray
    guess: FloatArray


def new_modal(m: int, columns: int, u: FloatArray, guess: FloatArray) -> Modal:
    """Arrays for m modes and so many output columns, beside those of the gap voltages."""
    rows, wide = (m, ROWS), (columns, ROWS)
    shapes = (
        rows, rows, rows, rows, rows, rows, (6, m, ROWS), (m,), (m,), (m, N_PLACES), (m, N_PLACES),
        (m, N_PLACES - 1), (len(u), N_PLACES), wide, wide, (NODES,),
    )  # fmt: skip
    return Modal._make((*aligned(shapes), u, guess))


@jit_rows
def series_of(values: FloatArray, out: FloatArray) -> None:
    """Chebyshev coefficients (ROWS,) of the polynomial through values at the nodes."""
    for d in range(ROWS):
        total = 0.0
        for j in range(NODES):
            total += TO_SERIES[j, d] * values[j]
        out[d] = total


@jit_rows
def basis_at(theta: float, basis: FloatArray) -> None:
    """Basis polynomials at fraction `theta` of the step, into `basis` (NODES,): values there are basis @ values."""
    for j in range(NODES - 1, -1, -1):
        if theta == POINTS[j]:
            basis[:] = 0.0
            basis[j] = 1.0
            return
    total = 0.0
    for j in range(NODES):
        basis[j] = BARYCENTRIC[j] / (theta - POINTS[j])
        total += basis[j]
    share = 1.0 / total
    for j in range(NODES):
        basis[j] *= share


@jit_rows
def at(values: FloatArray, basis: FloatArray) -> float:
    """The polynomial through values at the nodes, where `basis` belongs to (see `basis_at`)."""
    total = 0.0
    for j in range(NODES):
        total += basis[j] * values[j]
    return total


@jit
def row_of(place: int) -> int:
    """Row of the work arrays that belongs to one of the `N_PLACES` places of the error."""
    if place == 0:
        return 0
    return END if place == N_PLACES - 1 else FIRST + place - 1


@jit
def end_at(theta: float, x: Modal, error: FloatArray) -> None:
    """The modes at fraction `theta` of the step, to which `basis` belongs, and their error, into `w0` and `error`.

    The error is interpolated between the places where it is known.
    """
    w, w0, places, basis, p = x.w, x.w0, x.places, x.basis, 0
    while p < N_PLACES - 2 and theta > _AT[p + 1]:
        p += 1
    share = (theta - _AT[p]) / (_AT[p + 1] - _AT[p])
    for k in range(w0.size):
        w0[k] = at(w[k], basis)
        error[k] = (1.0 - share) * places[k, p] + share * places[k, p + 1]


@jit_rows
def _values_at(
    series: FloatArray, t_out: FloatArray, t: float, scale: float, top: float, groups: int, out: FloatArray
) -> None:  # fmt: skip
    """The series at whole groups of times, so that all round alike: the inner loop is unrolled, the outer a vector."""
    for i in range(_GROUP * groups):
        x = min(max((t_out[i] - t) * scale - 1.0, -1.0), top)
        twice = 2.0 * x
        b1 = 0.0
        b2 = 0.0
        for d in range(NODES - 1, 0, -1):
            b0 = twice * b1 + (series[d] - b2)
            b2 = b1
            b1 = b0
        out[i] = series[0] + x * b1 - b2


@jit
def _outputs_within(first: int, low: float, high: float, t_out: FloatArray, left: NDArray[np.bool_]) -> int:
    """Number of outputs from number `first` on that lie in a step, known to be between `low` and `high`."""
    at = first
    while at + _STRIDE <= t_out.size and t_out[at + _STRIDE - 1] < low:
        at += _STRIDE
    while at < t_out.size and (t_out[at] < low or (t_out[at] <= high and left[at])):
        at += 1
    return at - first


@jit
def write_outputs(
    t: float, h: float, reached: float, t_new: float, slack: float, series: FloatArray, first: int, outputs: Outputs
) -> int:  # fmt: skip
    """Outputs of one step from number `first` on: right-hand ones in [t, t_new), left-hand ones in (t, t_new].

    Times within `slack` of t_new are t_new. Places after the last output are overwritten: they belong to later steps.
    Returns how many there were.
    """
    t_out, out = outputs.t, outputs.columns
    count = _outputs_within(first, t_new - slack, t_new + slack, t_out, outputs.left)
    groups = (count + _GROUP - 1) // _GROUP
    scale = 2.0 / h
    top = 2.0 * reached - 1.0
    # The last group of a run may be too wide for the array: it is written through another.
    whole = groups if first + _GROUP * groups <= t_out.size else groups - 1
    rest = first + _GROUP * whole
    for column in range(out.shape[0]):
        _values_at(series[column], t_out[first:], t, scale, top, whole, out[column, first:])
        if whole < groups:
            work = np.empty((2, _GROUP))
            for i in range(_GROUP):
                work[0, i] = t_out[min(rest + i, t_out.size - 1)]
            _values_at(series[column], work[0], t, scale, top, 1, work[1])
            for i in range(t_out.size - rest):
                out[column, rest + i] = work[1, i]
    return count


@jit_rows
def account(
    u: FloatArray, area: FloatArray, stress: float, theta: float, run: FloatArray, area_off: float, peaks: FloatArray
) -> None:  # fmt: skip
    """Peaks of a gap's voltage and force over the part of a step that counts, and the errors of both.

    `run` holds the errors of the voltage at the places, V, and `area_off` is the relative error of the area beside it.
    """
    peak, error, force, moved = peaks[PEAK_U], peaks[ERROR_U], 0.0, 0.0
    for i in range(NODES):
        if POINTS[i] <= theta:
            size = abs(u[i])
            peak = max(peak, size)
            force = max(force, stress * size * size * area[i])
    for p in range(N_PLACES):
        steepest = 0.0
        for i in range(_NEAR[p][0], _NEAR[p][1] + 1):
            if POINTS[i] <= theta:
                # F ~ u^2 A: an error du changes F by at most 2 F du / u, because the area falls with |u|.
                steepest = max(steepest, 2.0 * stress * abs(u[i]) * area[i])
        moved = max(moved, run[p] * steepest)
        error = max(error, run[p])
    peaks[PEAK_U], peaks[ERROR_U] = peak, error
    peaks[PEAK_F] = max(peaks[PEAK_F], force)
    peaks[ERROR_F] = max(peaks[ERROR_F], moved + area_off * force)


# Relative distance within which two times count as equal: a few units in the last place. So much the end of a step,
# shifted by whole periods, may miss an output time.
SAME_TIME = 8e-16
# Number of steps in one compiled call.
AT_ONCE = 1_000_000


def repeat(
    kept: Steps, count: int, period: float, periods: int, drifts: FloatArray, first: int, outputs: Outputs
) -> int:  # fmt: skip
    """Write the outputs, from number `first` on, of so many periods (s) that follow the kept one of `count` steps.

    `drifts` (n_column,) are the gains of the columns in a period; only charges have one, C. Returns the first output
    that is left.
    """
    series, most = np.empty((count, outputs.columns.shape[0], ROWS)), max(1, AT_ONCE // max(1, count))
    own = np.array([first, -1])  # Of the first of these periods, which others copy: its first output, and their number
    for begin in range(1, periods + 1, most):
        end = min(begin + most, periods + 1)
        first = _repeat(kept, series, period, begin, end, drifts, first, outputs, own)
        if first >= outputs.t.size:
            break
    return first


@jit
def _repeat(
    kept: Steps, series: FloatArray, period: float, begin: int, end: int, drifts: FloatArray, first: int,
    outputs: Outputs, own: IntArray,
) -> int:  # fmt: skip
    """As `repeat`, of the periods from `begin` to before `end`; `series` is room for the steps' series."""
    times, values, series = borrow(kept.times), borrow(kept.values), borrow(series)
    outputs, drifts = borrow(outputs), borrow(drifts)
    t_out, out, count = outputs.t, outputs.columns, series.shape[0]
    for i in range(count):
        for c in range(out.shape[0]):
            series_of(values[i, c], series[i, c])
    for k in range(begin, end):
        shift, before, start, size = k * period, first, own[0], own[1]
        if size >= 0 and _alike(outputs, start, first, size, shift - period, times[count - 1, 2] + shift):
            for c in range(out.shape[0]):
                _moved(out[c, start : start + size], (k - 1) * drifts[c], out[c, first : first + size])
            first += size
            continue
        for i in range(count):
            if first >= t_out.size:
                break
            stop = times[i, 2] + shift
            slack = SAME_TIME * abs(stop)
            if t_out[first] > stop + slack:
                continue
            h, reached = times[i, 1], (times[i, 2] - times[i, 0]) / times[i, 1]
            first += write_outputs(times[i, 0] + shift, h, min(reached, 1.0), stop, slack, series[i], first, outputs)
        for c in range(out.shape[0]):
            if drifts[c] != 0.0:
                for i in range(before, first):
                    out[c, i] += k * drifts[c]
        if k == 1:
            own[1] = first - before
    return first


@jit_rows
def _alike(outputs: Outputs, start: int, first: int, size: int, shift: float, stop: float) -> bool:
    """Whether the outputs up to the end of a period, `stop` (s), are so many from `start` on, `shift` (s) later."""
    t, left = outputs.t, outputs.left
    if first + size > t.size or (first + size < t.size and not t[first + size] > stop * (1.0 + SAME_TIME)):
        return False
    t, own, off = t[first : first + size], t[start : start + size], 0
    side, own_side = left[first : first + size], left[start : start + size]
    for i in range(size):
        off += (abs(t[i] - own[i] - shift) > SAME_TIME * stop) | (side[i] != own_side[i])
    return off == 0


@jit_rows
def _moved(x: FloatArray, by: float, out: FloatArray) -> None:
    for i in range(out.size):
        out[i] = x[i] + by


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
    ("start", float),  # s: last edge of a source, or where a network's call began; 0 within a jump of its sources
    ("edge", float),  # s: end of a stack's segment that starts there
    ("since", float),  # s: time since `start`
    ("reached", float),  # s: that at the end of the step
    ("stop", float),  # s: end of the step's range
    ("begun", float),  # s: since which evaluations are counted
    ("below", float),  # Fraction of the step at which the gap voltage dips off its branch, or 0
    ("too_far", float),  # Fraction of a rejected step at which the next one should end; see `refuse`
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
    # sign, branch (n_area,) and (n_area, 2): Of each area the sign of the gap voltage on its branch (0: to be chosen);
    # the time at which the branch began, and the length of the branch before, infinite before the first, s
    sign: FloatArray
    branch: FloatArray
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
    kept: Steps
    steps: Steps  # Takes all steps, so that figures of the run do not depend on its outputs
    # (TRIED, 4): Ring buffer of the last steps tried: start and length (s), ratio of the error to the allowed one,
    # number from 1
    tried: FloatArray


@jit_within
def may_shorten(s: LoopState) -> bool:
    """Let a quarter be tried of a step that starts at a zero and is on neither branch; False where it is rounding."""
    if s.step[0].length <= 1e-13 * max(s.step[0].since, 1e-3 * (s.step[0].stop - s.control[0].t)):
        return False
    s.counters[REJECTED] += 1
    s.control[0].h, s.step[0].flips = 0.25 * s.step[0].length, 0
    return True


@jit
def _take(steps: Steps, place: int, s: LoopState, t: float, values: FloatArray) -> None:
    """Put a finished step that began at t (s), with its output columns (n_column, ROWS), into a place of `steps`."""
    times, nodes, step = steps.times, steps.values, s.step[0]
    times[place, 0], times[place, 1], times[place, 2], times[place, 3] = t, step.length, step.t_new, step.theta
    for c in range(nodes.shape[1]):
        for j in range(NODES):
            nodes[place, c, j] = values[c, j]


@jit_within
def write_step(s: LoopState, t: float, x: Modal) -> None:
    """Record a finished step that began at t (s), keep it for repetition, and write its outputs."""
    counters, step, values, coefficients = s.counters, s.step[0], x.values, x.coefficients
    _take(s.steps, counters[RECORDED], s, t, values)
    counters[RECORDED] += 1
    if counters[KEPT] < s.kept.times.shape[0]:
        _take(s.kept, counters[KEPT], s, t, values)
    counters[KEPT] += 1
    first = counters[OUTPUT]
    if first < s.outputs.t.size and s.outputs.t[first] <= step.t_new:
        for c in range(s.outputs.columns.shape[0]):
            series_of(values[c], coefficients[c])
        counters[OUTPUT] += write_outputs(t, step.length, step.theta, step.t_new, 0.0, coefficients, first, s.outputs)
