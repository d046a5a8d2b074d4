"""Scenes of a batch in lockstep under sines or a square: the loop over blocks of scenes, and the runs of a block."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fingerspice.base.arrays import FloatArray, aligned
from fingerspice.base.compiled import jit
from fingerspice.engine.lockstep import step as lockstep
from fingerspice.engine.lockstep.scenes import CELL_ROWS, OMEGA, Block, Places, fill_block, put_result
from fingerspice.engine.lockstep.step import Marks, Weights, area_row, n_state, run
from fingerspice.engine.lockstep.weights import weigh

# Most periods in the search for the periodic state.
MOST_PERIODS = 16
# Whether a run has settled is judged as if its modes decayed slower than with the area held, by this factor.
SLOWER = 0.5
Source = tuple[FloatArray, tuple[FloatArray, FloatArray]]
How = tuple[int, int, int, bool, float, float]


class Stepping(NamedTuple):
    """Arrays for the steps of a block of scenes; all are overwritten."""

    # still, moving: Weights, as `lockstep.run` takes them
    still: FloatArray
    moving: NDArray[np.float64]
    s: FloatArray  # (n_state * lanes,): State
    last: FloatArray  # (n_moment * lanes,): Sums over the last period
    before: FloatArray  # (n_mode * lanes,): Modes at the start of the last period
    # (n_mode * lanes,): In the search for the periodic state, the derivative of the start by what a period leaves open,
    # with the area held. In a run from rest, an upper bound of the modes' time constants, in periods.
    back: FloatArray
    # (lanes,): What the periodic state is off, relative to the peak gap voltage; or half of what the mean force is off
    # because the last period stands for those after it, relative to that force, and infinite while it does not
    closing: FloatArray
    # (lanes,): Length of the shortest step, s; in a run from rest, then the number of half periods after which it has
    # settled
    length: FloatArray
    moments: FloatArray  # (11, lanes): Scratch of `weights.weigh`


def stepping_shapes(pieces: int, marks: Marks) -> tuple[tuple[int, ...], ...]:
    """Shapes of the arrays of a `Stepping`, for weights of so many pieces (4 without jumps)."""
    m_all, _, l_all, _, count, lanes = (len(mark) for mark in marks)
    row, modes = lockstep.N_WEIGHTS * m_all * lanes, (m_all * lanes,)
    sums = (count * lanes,)
    return (
        (row,),
        (pieces, 3, row),
        (n_state(m_all, l_all, count) * lanes,),
        sums,
        modes,
        modes,
        (lanes,),
        (lanes,),
        (11, lanes),
    )


def new_stepping(pieces: int, marks: Marks) -> Stepping:
    """Arrays for the steps of blocks of scenes, whose half periods have so many pieces (0 without jumps)."""
    return Stepping._make(aligned(stepping_shapes(pieces or 4, marks)))


@jit
def _closed(
    s: FloatArray, start: FloatArray, back: FloatArray, c: FloatArray, closing: FloatArray, tol: float, marks: Marks
) -> bool:  # fmt: skip
    """Whether a period leads every lane from its start back to it, to `tol`; if not, improve the starts.

    The improvement is a step of Newton's method with the derivative of the period map with the area held. A lane that
    is within `tol` (relative to its peak gap voltage) keeps its start.
    """
    m_all, lanes, done = len(marks[0]), len(marks[5]), True
    for i in range(lanes):
        off = 0.0
        for m in range(m_all):
            change = (s[(lockstep.Z * m_all + m) * lanes + i] - start[m * lanes + i]) * back[m * lanes + i]
            off += abs(c[(lockstep.SHAPE + m) * lanes + i] * change)
        closing[i] = off / (s[(lockstep.N_STATE * m_all + lockstep.PEAK) * lanes + i] + 1e-300)
        if closing[i] > tol:
            done = False
            for m in range(m_all):
                change = s[(lockstep.Z * m_all + m) * lanes + i] - start[m * lanes + i]
                start[m * lanes + i] += change * back[m * lanes + i]
    return done


@jit
def _settled(i: int, c: FloatArray, stepping: Stepping, steps: int, traced: bool, marks: Marks) -> float:
    """Half of what lane i's mean force is off, relative to it, if the last period stands for all that follow.

    What a mode was off the periodic state, on average over the period, is at most its change over the period times its
    time constant in periods, and so is what it changes in all later ones. The mean force changes by at most twice the
    peak voltage times this, and the area; `steps` is the number of steps of a period. If gap voltages are wanted, then
    at least what these change, relative to their peak.
    """
    s, last, before, back = stepping[2], stepping[3], stepping[4], stepping[5]
    m_all, lanes = len(marks[0]), len(marks[5])
    off, held = 0.0, area_row(m_all, len(marks[1]), len(marks[2])) + len(marks[3]) - 1
    for m in range(m_all):
        at = m * lanes + i
        off += abs(c[(lockstep.SHAPE + m) * lanes + i] * (s[lockstep.Z * m_all * lanes + at] - before[at]) * back[at])
    peak = s[(lockstep.N_STATE * m_all + lockstep.PEAK) * lanes + i]
    of_force = off * peak / (last[i] / steps * c[held * lanes + i] + 1e-300)
    return float(max(of_force, off / (peak + 1e-300)) if traced else of_force)


@jit
def _from_rest(
    c: FloatArray, g: Weights, wave: FloatArray, how: tuple[int, int, bool], tol: float, stepping: Stepping,
    trace: FloatArray, out: FloatArray, first: int, marks: Marks,
) -> None:  # fmt: skip
    """Run a block's scenes period by period, until the run ends or all have settled; see `march` for the arguments.

    A scene that has settled takes part in further periods only if others of its block do, and its results stay those
    at which it settled: no result depends on the scenes beside it. A first range of half a period makes the rest whole.
    """
    halves, steps, jumping = how
    s, last, before, closing, settled = stepping[2], stepping[3], stepping[4], stepping[6], stepping[7]
    m_all, count, lanes = len(marks[0]), len(marks[4]), len(marks[5])
    sums = (lockstep.N_STATE * m_all + lockstep.VALUE + count) * lanes
    for i in range(lanes):
        closing[i] = math.inf
    done, left = 0, lanes
    while left > 0:
        upto = done + 2 - halves % 2 if done == 0 else done + 2
        for i in range(before.size):
            before[i] = s[lockstep.Z * m_all * lanes + i]
        for i in range(last.size):
            last[i] = -s[sums + i] if done > 0 else 0.0
        run(c, g, s, wave, (done, upto, steps, jumping), trace, marks)
        for i in range(last.size):
            last[i] = last[i] + s[sums + i] if upto - done == 2 else math.nan
        done = upto
        ahead = (halves - done) // 2
        for i in range(lanes):
            if closing[i] < math.inf:
                continue
            off = 0.0
            if ahead > 0:
                off = _settled(i, c, stepping, 2 * steps, trace.size > 0, marks)
            if ahead == 0 or off <= tol:
                closing[i], settled[i] = off, done
                left -= 1
                put_result(i, s, last, off, (ahead, halves, steps), first, out, marks)
    width = trace.size // lanes
    for i in range(lanes if width > 0 else 0):
        # The last period, again and again.
        for j in range(i * width + int(settled[i]) * steps, (i + 1) * width):
            trace[j] = trace[j - 2 * steps]


@jit
def march_block(
    table: FloatArray, pending: NDArray[np.int64], first: int, places: Places,
    curves: tuple[FloatArray, FloatArray, FloatArray], source: Source, how: How, block: Block, stepping: Stepping,
    out: FloatArray, voltages: tuple[FloatArray, FloatArray], marks: Marks,
) -> None:  # fmt: skip
    """Integrate the scenes from number `first` of `pending` on, as many as there are lanes; see `march`.

    `voltages` take the gap voltages before the steps of both runs, each of shape (lanes * steps,) or (0,).
    """
    halves, half, pieces, periodic, tol, covered = how
    m_all, count, lanes, jumping = len(marks[0]), len(marks[4]), len(marks[5]), pieces > 0
    # Unpacked by position, as a compiler for graphics cards may know plain tuples only.
    c, start, rates, drive, t, top, tails, _ = block
    still, moving, s, _, _, back, closing, length, moments = stepping
    sums, omega = (lockstep.N_STATE * m_all + lockstep.VALUE + count) * lanes, (CELL_ROWS * (m_all + 1) + OMEGA) * lanes
    fill_block(table, pending, first, places, curves, (source[0], jumping, covered), block, marks)
    for i in range(lanes):
        period = 2.0 * math.pi / t[omega + i]
        for m in range(m_all):
            if periodic:
                back[m * lanes + i] = -1.0 / math.expm1(-rates[m, i] * period)
            else:
                back[m * lanes + i] = 1.0 / (SLOWER * rates[m, i] * period + 1e-300)
    g = (still, moving[: pieces if jumping else 4])
    for w in range(2):
        if source[1][w].size == 0:
            continue
        steps = half // 2 if w == 0 else half
        # All pieces together are 2^pieces - 1 times the first, which has steps / pieces of the shortest steps.
        shorter = pieces / (2.0**pieces - 1.0) if jumping else lockstep.START_TIMES[1]
        for i in range(lanes):
            length[i] = math.pi / t[omega + i] / steps * shorter
        weigh(length, rates, drive, g, moments, marks)
        for _ in range(MOST_PERIODS):
            for i in range(s.size):
                s[i] = start[i] if i < start.size else 0.0
            if not periodic:
                way = (halves, steps, jumping)
                _from_rest(c, g, source[1][w], way, tol, stepping, voltages[w], out[w], first, marks)
                break
            run(c, g, s, source[1][w], (0, halves, steps, jumping), voltages[w], marks)
            done = _closed(s, start, back, c, closing, tol, marks)
            for i in range(lanes):
                put_result(i, s, s[sums:], closing[i], (0, halves, steps), first, out[w], marks)
            if done:
                break
        for i in range(min(lanes, pending.size - first)):
            within = out[w, 2 * count, first + i] <= top[i]
            out[w, 2 * count + 2, first + i] = tails[i] if within else math.inf


@jit
def march(
    table: FloatArray, pending: NDArray[np.int64], places: Places,
    curves: tuple[FloatArray, FloatArray, FloatArray], source: Source, how: How, block: Block, stepping: Stepping,
    out: FloatArray, traces: tuple[FloatArray, FloatArray], marks: Marks,
) -> None:  # fmt: skip
    """Integrate scenes of a table, block by block, with each of two numbers of steps; the first may be none.

    Parameters
    ----------
    table : ndarray, shape (n_row, n_scene)
        `CELL_ROWS` for all cells, `N_OTHERS` rows, and two for every tone.
    pending : ndarray, shape (n,)
        Indices of the scenes to integrate.
    places : tuple
        Index of the gap among the cells, and of those with a total leakage, one for every leak of the marks.
    curves : tuple of ndarray
        Polynomial coefficients of the universal curve over X, highest power first; Chebyshev points; and the matrix
        from values at these points to polynomial coefficients (d + 1, d + 1), highest power first.
    source : tuple of ndarray
        Frequencies of the tones, in that of the source; and the waves as `lockstep.run` takes them, for both numbers of
        steps.
    how : tuple
        Number of half periods; of steps in each, in the second run (the first run has half as many, or none if its
        waves are empty); of pieces of each if the source jumps to its negative after each, else 0; whether the periodic
        state is wanted; its tolerance, relative to the peak gap voltage; and the largest gap voltage that the area's
        polynomial covers, as a ratio to its estimate.
    block, stepping
        From `scenes.new_block` and `new_stepping`.
    out : ndarray, shape (2, 2 n_moment + 3, n)
        For each run the means over it and over its last period, the peak (V), the relative error of the periodic
        state, and the relative size of the last coefficient of the area's series. The latter is infinite where the
        polynomial does not cover the voltages met.
    traces : tuple of ndarray, each of shape (n, steps)
        Gap voltage before every step of each run, V; (n, 0) for none.
    """
    lanes = len(marks[5])
    voltages = np.empty(lanes * traces[0].shape[1]), np.empty(lanes * traces[1].shape[1])
    for first in range(0, pending.size, lanes):
        march_block(table, pending, first, places, curves, source, how, block, stepping, out, voltages, marks)
        for w in range(2):
            width = traces[w].shape[1]
            for i in range(min(lanes, pending.size - first) if width > 0 else 0):
                traces[w][first + i] = voltages[w][i * width : (i + 1) * width]


@jit
def trace_changes(fine: FloatArray, coarse: FloatArray, out: FloatArray) -> None:
    """Largest difference of gap voltages (n, 2 steps) and (n, steps) at the same times, for each scene, into `out`."""
    for i in range(fine.shape[0]):
        largest = 0.0
        for j in range(coarse.shape[1]):
            off = abs(fine[i, 2 * j] - coarse[i, j])
            largest = off if off > largest else largest
        out[i] = largest


@jit
def put_traces(
    traces: FloatArray, chosen: NDArray[np.int64], stride: int, at: NDArray[np.int64], out: FloatArray
) -> None:
    """Every `stride`-th gap voltage of the `chosen` scenes, into the rows `at` of `out`, which are NaN beyond them."""
    for k in range(chosen.size):
        count, trace, row = traces.shape[1] // stride, traces[chosen[k]], out[at[k]]
        for j in range(count):
            row[j] = trace[j * stride]
        for j in range(count, row.size):
            row[j] = math.nan
