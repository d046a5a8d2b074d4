"""Quantities computed from a finished step: zeros of the gap voltage, state and error inside it, outputs, peaks."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fingerspice.base.arrays import FloatArray
from fingerspice.base.compiled import jit, jit_rows
from fingerspice.numerics.lobatto import BARYCENTRIC, END, FIRST, NODES, POINTS, ROWS, TO_SERIES

CONTROL = np.dtype([
    ("t", float),  # s
    ("h", float),  # s: length of the next step
    ("sign", float),  # Of the gap voltage, on the branch of the area
    ("u_before", float),  # V: source before `t`
    ("u_gap", float),  # V
    ("branch_start", float),  # s
    ("branch_length", float),  # s: of the branch before; infinite before the first
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
WRITTEN_AT_ONCE = _GROUP = 8
_STRIDE = 32


class Steps(NamedTuple):
    """Takes every step, so that figures of the run do not depend on its outputs."""

    # (capacity, 4): Start and length (s), the end reached (s), and which fraction of the length that is: a step may be
    # shorter than the rounding of the time. No capacity: nothing is recorded.
    times: FloatArray
    # (capacity, n_column, NODES): Recorded voltages, or the state of a network, at the nodes of the whole length
    values: FloatArray


def new_steps(capacity: int, columns: int) -> Steps:
    """Room for so many steps."""
    return Steps(np.empty((capacity, 4)), np.empty((capacity, columns, NODES)))


@jit
def record(
    times: FloatArray, recorded: FloatArray, place: int, t: float, h: float, t_new: float, theta: float,
    values: FloatArray,
) -> None:  # fmt: skip
    """Put a step in its place."""
    times[place, 0], times[place, 1], times[place, 2], times[place, 3] = t, h, t_new, theta
    for c in range(recorded.shape[1]):
        for j in range(NODES):
            recorded[place, c, j] = values[c, j]


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


@jit_rows
def series_of(values: FloatArray, out: FloatArray) -> None:
    """Chebyshev coefficients (ROWS,) of the polynomial through values at the nodes."""
    for d in range(ROWS):
        total = 0.0
        for j in range(NODES):
            total += TO_SERIES[j, d] * values[j]
        out[d] = total


@jit
def basis_at(theta: float, basis: FloatArray) -> None:
    """Basis polynomials at fraction `theta` of the step, into `basis` (NODES,): values there are basis @ values."""
    total = 0.0
    for j in range(NODES - 1, -1, -1):
        distance = theta - POINTS[j]
        if distance == 0.0:
            basis[:] = 0.0
            basis[j] = 1.0
            return
        basis[j] = BARYCENTRIC[j] / distance
        total += basis[j]
    for j in range(NODES):
        basis[j] /= total


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
def error_at(places: FloatArray, theta: float, error: FloatArray) -> None:
    """Error of the modes at the end of a step that is cut short, interpolated between the places where it is known."""
    p = 0
    while p < N_PLACES - 2 and theta > _AT[p + 1]:
        p += 1
    share = (theta - _AT[p]) / (_AT[p + 1] - _AT[p])
    for k in range(places.shape[0]):
        error[k] = (1.0 - share) * places[k, p] + share * places[k, p + 1]


@jit_rows
def layers(
    mobile: bool, area0: float, k_shown: FloatArray, shown: FloatArray, w: FloatArray, source: FloatArray,
    q: FloatArray, values: FloatArray,
) -> None:  # fmt: skip
    """Recorded voltages at all rows."""
    for i in range(shown.shape[0]):
        for j in range(ROWS):
            values[i, j] = 0.0
        for k in range(w.shape[0]):
            share = shown[i, k]
            for j in range(ROWS):
                values[i, j] += share * w[k, j]
        if mobile:
            for j in range(ROWS):
                values[i, j] *= area0 * q[j]
        share = k_shown[i]
        for j in range(ROWS):
            values[i, j] += share * source[j]


@jit_rows
def _series_at(
    series: FloatArray, t_out: FloatArray, t: float, scale: float, top: float, groups: int, out: FloatArray
) -> None:
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


@jit_rows
def _powers_at(
    powers: FloatArray, t_out: FloatArray, t: float, scale: float, top: float, groups: int, out: FloatArray
) -> None:
    """As `_series_at`, from the coefficients of 1, x, x^2, ...: half the work."""
    for i in range(_GROUP * groups):
        x = min(max((t_out[i] - t) * scale - 1.0, -1.0), top)
        value = powers[NODES - 1]
        for d in range(NODES - 2, -1, -1):
            value = value * x + powers[d]
        out[i] = value


@jit
def _outputs_within(first: int, guess: int, low: float, high: float, t_out: FloatArray, left: NDArray[np.bool_]) -> int:
    """Number of outputs from number `first` on that lie in a step, known to be between `low` and `high`."""
    after = first + guess
    if guess > 0 and after <= t_out.size and t_out[after - 1] < low and (after == t_out.size or t_out[after] > high):
        return guess
    at = first
    while at + _STRIDE <= t_out.size and t_out[at + _STRIDE - 1] < low:
        at += _STRIDE
    while at < t_out.size and (t_out[at] < low or (t_out[at] <= high and left[at])):
        at += 1
    return at - first


@jit
def write_outputs(
    t: float, h: float, reached: float, t_new: float, slack: float, powers: bool, series: FloatArray, work: FloatArray,
    first: int, guess: int, outputs: Outputs,
) -> int:  # fmt: skip
    """Outputs of one step from number `first` on: right-hand ones in [t, t_new), left-hand ones in (t, t_new].

    With `powers` the series holds the coefficients of 1, x, x^2, ... instead. Times within `slack` of t_new are t_new;
    `guess` is the expected number. Places after the last output are overwritten: they belong to later steps.
    `work` has shape (2, WRITTEN_AT_ONCE). Returns how many there were.
    """
    t_out, out = outputs.t, outputs.columns
    count = _outputs_within(first, guess, t_new - slack, t_new + slack, t_out, outputs.left)
    groups = (count + _GROUP - 1) // _GROUP
    scale = 2.0 / h
    top = 2.0 * reached - 1.0
    # The last group of a run may be too wide for the array: it is written through `work`.
    whole = groups if first + _GROUP * groups <= t_out.size else groups - 1
    rest = first + _GROUP * whole
    for column in range(out.shape[0]):
        if powers:
            _powers_at(series[column], t_out[first:], t, scale, top, whole, out[column, first:])
        else:
            _series_at(series[column], t_out[first:], t, scale, top, whole, out[column, first:])
        if whole < groups:
            for i in range(_GROUP):
                work[0, i] = t_out[min(rest + i, t_out.size - 1)]
            if powers:
                _powers_at(series[column], work[0], t, scale, top, 1, work[1])
            else:
                _series_at(series[column], work[0], t, scale, top, 1, work[1])
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
    force = 0.0
    for i in range(NODES):
        if POINTS[i] <= theta:
            size = abs(u[i])
            peaks[PEAK_U] = max(peaks[PEAK_U], size)
            force = max(force, stress * size * size * area[i])
    moved = 0.0
    for p in range(N_PLACES):
        steepest = 0.0
        for i in range(_NEAR[p][0], _NEAR[p][1] + 1):
            if POINTS[i] <= theta:
                # F ~ u^2 A: an error du changes F by at most 2 F du / u, because the area falls with |u|.
                steepest = max(steepest, 2.0 * stress * abs(u[i]) * area[i])
        moved = max(moved, run[p] * steepest)
        peaks[ERROR_U] = max(peaks[ERROR_U], run[p])
    peaks[PEAK_F] = max(peaks[PEAK_F], force)
    peaks[ERROR_F] = max(peaks[ERROR_F], moved + area_off * force)
