"""One step of exponential collocation: the linear part exact, the area's by iteration, the error by what it misses."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fingerspice.compiled import jit, jit_inline, jit_rows
from fingerspice.engine.rows import DQ, GUESS, SOURCE, X_GAP, Q, U, evaluate, moved
from fingerspice.numerics.lobatto import BETWEEN, END, FIRST, MISS, NODES, ROWS, SECOND, fill_table

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

N_SLOTS = 48
# Places between which the error is followed: start, the two points between nodes, end.
N_PLACES = 4


class Tables(NamedTuple):
    """Exponentials and their integrals, by step length and reference area, made when first needed.

    Attributes
    ----------
    h : ndarray, shape (N_SLOTS,)
        Step length of each slot, s.
    level, used : ndarray of int
        Reference area of each slot, and [slots in use, slot used last].
    decay, phi, miss : ndarray, shape (N_SLOTS, n, ...)
        See `fill_table`; `phi` and `miss` times h.
    """

    h: FloatArray
    level: IntArray
    used: IntArray
    decay: FloatArray
    phi: FloatArray
    miss: FloatArray


def new_tables(n: int) -> Tables:
    """No tables yet, for n modes."""
    return Tables(
        np.zeros(N_SLOTS),
        np.full(N_SLOTS, -1),
        np.zeros(2, np.int64),
        np.zeros((N_SLOTS, n, ROWS)),
        np.zeros((N_SLOTS, n, NODES, ROWS)),
        np.zeros((N_SLOTS, n, ROWS)),
    )


@jit
def make_tables(
    rates: FloatArray, level: int, h: float, keys_h: FloatArray, keys_level: IntArray, count: IntArray,
    decay: FloatArray, phi: FloatArray, miss: FloatArray,
) -> int:  # fmt: skip
    """The slot with the tables of a step, filled now if need be; when all are in use the oldest give way."""
    for slot in range(min(count[0], N_SLOTS)):
        if keys_h[slot] == h and keys_level[slot] == level:
            count[1] = slot
            return slot
    slot = int(count[0] % N_SLOTS)
    count[0] += 1
    # Beyond twice the slots the count means only "all in use" and where to go on.
    if count[0] >= 2 * N_SLOTS:
        count[0] -= N_SLOTS
    count[1] = slot
    keys_h[slot] = h
    keys_level[slot] = level
    for k in range(rates.size):
        fill_table(rates[k] * h, decay[slot, k], phi[slot, k], miss[slot, k])
        for i in range(ROWS):
            miss[slot, k, i] *= h
            for j in range(NODES):
                phi[slot, k, j, i] *= h
    return slot


@jit_rows
def _respond(forcing: FloatArray, phi: FloatArray, base: FloatArray, w: FloatArray) -> None:
    """w = base + response to `forcing` (n, ROWS), of which the nodes count."""
    for k in range(w.shape[0]):
        for i in range(ROWS):
            total = base[k, i]
            for j in range(NODES):
                total += phi[k, j, i] * forcing[k, j]
            w[k, i] = total


@jit_rows
def _linear(
    gain: FloatArray, decay: FloatArray, phi: FloatArray, w0: FloatArray, source: FloatArray, base: FloatArray,
    w: FloatArray,
) -> None:  # fmt: skip
    """Response to the start and the source with the area at its reference, into `base` and `w`."""
    for k in range(w0.size):
        factor = gain[k]
        start = w0[k]
        for i in range(ROWS):
            total = 0.0
            for j in range(NODES):
                total += phi[k, j, i] * source[j]
            base[k, i] = decay[k, i] * start + factor * total
        for i in range(ROWS):
            w[k, i] = base[k, i]


@jit_rows
def _copy(a: FloatArray, b: FloatArray) -> None:
    for k in range(a.shape[0]):
        for i in range(ROWS):
            b[k, i] = a[k, i]


@jit_inline
def converge(
    mobile: bool, coupled: bool, k_gap: float, area0: float, q0: float, gain: FloatArray, gap: FloatArray,
    push: FloatArray, turn: FloatArray, powers: FloatArray, slopes: FloatArray, lo: float, scale: float,
    curve: FloatArray, sign: float, decay: FloatArray, phi: FloatArray, w0: FloatArray, tol: float,
    base: FloatArray, w: FloatArray, pull: FloatArray, used: FloatArray, r: FloatArray,
) -> tuple[int, bool]:  # fmt: skip
    """Fill `w` with the collocation solution of a step, iterating on the nonlinear term.

    Returns the number of evaluations at all rows, and whether the iteration closed to `tol` (V). `pull` is the
    nonlinear term at that solution, `used` the one that led to it.
    """
    _linear(gain, decay, phi, w0, r[SOURCE], base, w)
    for k in range(w0.size):
        for i in range(ROWS):
            used[k, i] = 0.0
    if not evaluate(
        mobile, k_gap, area0, q0, gap, push, turn, powers, slopes, lo, scale, curve, sign, w, pull, r
    ):  # fmt: skip
        return 1, False
    if not coupled:
        return 1, True
    for i in range(ROWS):
        r[GUESS, i] = r[U, i]
    earlier = 0.0
    for iteration in range(2, 41):
        _copy(pull, used)
        _respond(used, phi, base, w)
        if not evaluate(
            mobile, k_gap, area0, q0, gap, push, turn, powers, slopes, lo, scale, curve, sign, w, pull, r
        ):  # fmt: skip
            return iteration, False
        change = moved(r[U], r[GUESS])
        if not change < math.inf:
            return iteration, False
        if iteration == 2:
            if change <= 0.1 * tol:
                return iteration, True
        else:
            ratio = change / earlier if earlier > 0.0 else 0.0
            if ratio < 0.9 and change * ratio <= tol * (1.0 - ratio):
                return iteration, True
            if iteration > 5 and ratio > 0.8:
                return iteration, change <= tol
        earlier = change
    return 40, False


@jit_rows
def _between(values: FloatArray) -> tuple[float, float]:
    """What the polynomial through values at the nodes misses at the two points between."""
    first = 0.0
    second = 0.0
    for j in range(NODES):
        first += BETWEEN[j, 0] * values[j]
        second += BETWEEN[j, 1] * values[j]
    return values[FIRST] - first, values[SECOND] - second


@jit_rows
def _left_over(phi: FloatArray, pull: FloatArray, used: FloatArray) -> tuple[float, float, float]:
    """Response to what the iteration left, at the points between and the end."""
    first = 0.0
    second = 0.0
    end = 0.0
    for j in range(NODES):
        left = pull[j] - used[j]
        first += phi[j, FIRST] * left
        second += phi[j, SECOND] * left
        end += phi[j, END] * left
    return first, second, end


@jit_inline
def assess(
    mobile: bool, area0: float, gain: FloatArray, gap: FloatArray, decay: FloatArray, phi: FloatArray,
    miss: FloatArray, error: FloatArray, w: FloatArray, pull: FloatArray, used: FloatArray, r: FloatArray,
    places: FloatArray,
) -> tuple[float, float]:  # fmt: skip
    """Error of a converged step, from what its polynomial misses between nodes and what its iteration left.

    Parameters
    ----------
    error : ndarray, shape (n,)
        Error of the modes at the start of the step, signed.
    places : ndarray, shape (n, N_PLACES)
        Filled with the error of the modes at the start, the points between and the end; dense output included.

    Returns
    -------
    step, run : float
        Largest error of the gap voltage in the step, V: what the polynomial of this step misses (a longer or shorter
        one misses more or less), and all of it with what the iteration left and what came before.
    """
    source_first, source_second = _between(r[SOURCE])
    # The outputs are read off the polynomial through the nodes' gap voltages.
    dense_first, dense_second = _between(r[U])
    step_first = 0.0
    step_second = 0.0
    step_end = 0.0
    run_first = 0.0
    run_second = 0.0
    run_end = 0.0
    for k in range(gain.size):
        pull_first, pull_second = _between(pull[k])
        mode_first, mode_second = _between(w[k])
        first = (gain[k] * source_first + pull_first) / MISS[0]
        second = (gain[k] * source_second + pull_second) / MISS[1]
        missed = first if abs(first) > abs(second) else second
        left_first, left_second, left_end = _left_over(phi[k], pull[k], used[k])
        all_first = decay[k, FIRST] * error[k] + left_first + miss[k, FIRST] * missed
        all_second = decay[k, SECOND] * error[k] + left_second + miss[k, SECOND] * missed
        places[k, 0] = error[k]
        places[k, 1] = all_first + mode_first
        places[k, 2] = all_second + mode_second
        places[k, 3] = decay[k, END] * error[k] + left_end + miss[k, END] * missed
        step_first += gap[k] * miss[k, FIRST] * missed
        step_second += gap[k] * miss[k, SECOND] * missed
        step_end += gap[k] * miss[k, END] * missed
        run_first += gap[k] * all_first
        run_second += gap[k] * all_second
        run_end += gap[k] * places[k, 3]
    by_first = 1.0
    by_second = 1.0
    by_end = 1.0
    if mobile:
        # The gap's part of the voltages is over A, and the fold magnifies its error.
        by_first = area0 * r[Q, FIRST] / max(1.0 - area0 * r[X_GAP, FIRST] * r[DQ, FIRST], 1e-12)
        by_second = area0 * r[Q, SECOND] / max(1.0 - area0 * r[X_GAP, SECOND] * r[DQ, SECOND], 1e-12)
        by_end = area0 * r[Q, END] / max(1.0 - area0 * r[X_GAP, END] * r[DQ, END], 1e-12)
    # The charge is the integral of A dU among others: what the polynomial misses of 1/A counts with the source's move.
    area_first, area_second = _between(r[Q])
    swing = 0.3 * abs(r[SOURCE, END] - r[SOURCE, 0])
    charged = swing * max(abs(area_first), abs(area_second)) / r[Q, 0]
    return (
        max(
            abs(by_first * step_first + dense_first),
            abs(by_second * step_second + dense_second),
            abs(by_end * step_end),
            charged,
        ),
        max(abs(by_first * run_first + dense_first), abs(by_second * run_second + dense_second), abs(by_end * run_end)),
    )
