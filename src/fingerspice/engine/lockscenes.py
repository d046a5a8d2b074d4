"""Constants of scenes for `engine.lockstep`: modes, response to the source, area polynomials, weights of the steps."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fingerspice.base.arrays import FloatArray
from fingerspice.base.compiled import jit, jit_rows
from fingerspice.engine.lockstep import (
    LANES,
    N_STATE,
    N_WEIGHTS,
    PEAK,
    SCALE,
    SHAPE,
    START_TIMES,
    VALUE,
    Marks,
    Z,
    area_row,
    n_constants,
    n_state,
    run,
)  # fmt: skip
from fingerspice.engine.lockweights import weigh
from fingerspice.numerics.modes import modes as modes_of

# A table of scenes has three rows for every cell: capacitance (F/m^2), total leakage (S), leakage per area (S/m^2).
CELL_ROWS = 3
# Its further rows.
XI, REST, STRESS, LOAD, LOSS, OMEGA, N_OTHERS = 0, 1, 2, 3, 4, 5, 6
"""X of Eq. 4 at 1 V, A0 at 0 V (m^2), stress at 1 V (Pa), load (N), c2 mu^2; the source's angular frequency (rad/s).
After them come amplitude (V) and phase (rad) of each of its tones."""
LARGEST_X = 1.3
"""Largest X that the series of the universal curve covers."""
Places = tuple[int, NDArray[np.int64]]
"""Index of the gap among the cells, and of the cells whose leak has a total resistance."""
Scratch = tuple[
    FloatArray, FloatArray, FloatArray, FloatArray, FloatArray, FloatArray, FloatArray, FloatArray
]  # fmt: skip
# A mode's rate nearer than this (relative) to the rate of a cell, a pole of the characteristic equation, has too few
# correct digits in the difference of both.
NEAR_POLE = 1e-5
# Most periods in the search for the periodic state.
MOST_PERIODS = 16


@jit_rows
def _inverse_areas(
    n: int, at: float, top: FloatArray, b: FloatArray, series: FloatArray, y: FloatArray, out: FloatArray
) -> None:  # fmt: skip
    """1/A at the voltages top (1 + at) / 2 of every lane, by the universal curve and the closed form of Eqs. 1 and 3.

    `b` holds the table's further rows (X, A0, stress, ...) for the lanes of the block; `y` (LANES,) is scratch.
    """
    for i in range(LANES):
        x = b[XI * LANES + i] * (0.5 * (1.0 + at) * top[i]) * (2.0 / LARGEST_X) - 1.0
        total = series[0]
        for d in range(1, n):
            total = total * x + series[d]
        y[i] = total
    for i in range(LANES):
        u = 0.5 * (1.0 + at) * top[i]
        a0 = b[REST * LANES + i] * y[i]
        load, k = b[LOAD * LANES + i], b[LOSS * LANES + i] / a0
        sigma = b[STRESS * LANES + i] * u * u
        root = math.sqrt(1.0 + 4.0 * k * sigma * (load + sigma * a0))
        out[i] = (1.0 + 2.0 * k * load * sigma + root) / (2.0 * (a0 - k * load * load))


@jit_rows
def _add_row(share: float, x: FloatArray, out: FloatArray) -> None:
    for i in range(LANES):
        out[i] += share * x[i]


@jit
def _largest_voltage(t: FloatArray, gap: int, cells: int, jumping: bool) -> float:
    """Estimate of the largest gap voltage (V) of the scene with column t of the table, its area at rest held.

    The gap's share of the source is between the capacitive and the resistive divider's; the jump of a square adds the
    difference of both, which is left of the half period before.
    """
    elastance, resistance = 0.0, 0.0
    area = t[CELL_ROWS * cells + REST]
    for j in range(cells):
        elastance += 1.0 / t[j]
        resistance += 1.0 / (t[cells + j] + area * t[2 * cells + j] + 1e-300)
    at_once = 1.0 / (t[gap] * elastance)
    at_last = 1.0 / ((t[cells + gap] + area * t[2 * cells + gap] + 1e-300) * resistance)
    share = max(at_once, at_last) + (abs(at_once - at_last) if jumping else 0.0)
    amplitude = 0.0
    for row in range(CELL_ROWS * cells + N_OTHERS, t.size, 2):
        amplitude += abs(t[row])
    return float(amplitude * share)


@jit
def _three_modes(r: FloatArray, k: FloatArray, rates: FloatArray) -> bool:
    """The two rates of the modes of three cells from a quadratic; False where one is too near to a cell's own rate."""
    b = k[0] * (r[1] + r[2]) + k[1] * (r[0] + r[2]) + k[2] * (r[0] + r[1])
    c = k[0] * r[1] * r[2] + k[1] * r[0] * r[2] + k[2] * r[0] * r[1]
    square = b * b - 4.0 * c
    if not square > 0.0:
        return False
    rates[1] = 0.5 * (b + math.sqrt(square))
    rates[0] = c / rates[1]
    for m in range(2):
        for j in range(3):
            if not abs(r[j] - rates[m]) > NEAR_POLE * max(r[j], rates[m]):
                return False
    return True


@jit
def _modes(
    r: FloatArray, k: FloatArray, rates: FloatArray, gain: FloatArray, feed: FloatArray, shape: FloatArray
) -> None:
    """As `numerics.modes.modes`, into given arrays, and without its iteration for three cells with different rates."""
    if r.size == 3 and _three_modes(r, k, rates):
        for m in range(2):
            norm = 0.0
            for j in range(3):
                shape[j, m] = k[j] / (r[j] - rates[m])
                norm += shape[j, m] * shape[j, m] / k[j]
            gain[m] = -1.0 / norm
            for j in range(3):
                feed[j, m] = -shape[j, m] / k[j] / norm
        return
    found = modes_of(r, k)
    rates[:], gain[:], feed[:], shape[:] = found[0], found[1], found[2], found[3]


@jit
def _scratch(m: int) -> Scratch:
    """Scratch for the cells and modes of one lane, used by all in turn: allocation for each would double the time."""
    row = np.empty((5, m + 1))
    return row[0], row[1], row[2], row[3], row[4], np.empty(m), np.empty((m + 1, m)), np.empty((m + 1, m))


@jit
def _lane(
    i: int, places: Places, t: FloatArray, tones: FloatArray, jumping: bool, c: FloatArray, start: FloatArray,
    rates: FloatArray, drive: FloatArray, scratch: Scratch, marks: Marks,
) -> None:  # fmt: skip
    """Constants and start of lane i from its column t of the table, with 1/A0 already in `scratch`."""
    gap, leaks = places
    m_all, w_all, l_all = len(marks[0]), len(marks[1]), leaks.size
    cells = m_all + 1
    others = CELL_ROWS * cells
    k, r, moved, u, inverse, gain, feed, shape = scratch
    total = 0.0
    for j in range(cells):
        total += 1.0 / t[j]
    for j in range(cells):
        k[j] = 1.0 / (t[j] * total)
        moved[j] = t[cells + j] / t[j]
        r[j] = t[2 * cells + j] / t[j] + inverse[0] * moved[j]
    _modes(r, k, rates, gain, feed, shape)
    of_u, of_w = SHAPE + m_all, SHAPE + m_all + w_all
    of_z = of_w + l_all * w_all
    of_leak = of_z + l_all * m_all
    for m in range(m_all):
        c[(SHAPE + m) * LANES + i] = shape[gap, m]
        start[m * LANES + i] = 0.0
        drive[m] = gain[m] * t[others + N_OTHERS] if jumping else 0.0
        for n in range(l_all):
            c[(of_z + n * m_all + m) * LANES + i] = shape[leaks[n], m]
            c[(of_leak + m * l_all + n) * LANES + i] = feed[leaks[n], m] * moved[leaks[n]]
    for w in range(w_all):
        # The cells' voltages at a unit of the wave: sine, then cosine, of a tone.
        amplitude, phase = t[others + N_OTHERS + w // 2 * 2], t[others + N_OTHERS + w // 2 * 2 + 1]
        omega = tones[w // 2] * t[others + OMEGA]
        sine, cosine = (0.0, 1.0) if jumping else (math.sin(phase), math.cos(phase))
        for j in range(cells):
            u[j] = k[j] * amplitude * (cosine if w % 2 == 0 else sine)
        if not jumping:
            for m in range(m_all):
                # z is the mode less its steady response to the tone, gain (rate - i omega) / (rate^2 + omega^2) of it.
                size = gain[m] * amplitude / (rates[m] * rates[m] + omega * omega)
                along, across = rates[m] * cosine + omega * sine, rates[m] * sine - omega * cosine
                if w % 2 == 1:
                    start[m * LANES + i] -= size * across
                for j in range(cells):
                    u[j] += shape[j, m] * size * (along if w % 2 == 0 else across)
        c[(of_u + w) * LANES + i] = u[gap]
        for n in range(l_all):
            c[(of_w + n * w_all + w) * LANES + i] = u[leaks[n]]


@jit
def _closed(
    s: FloatArray, start: FloatArray, back: FloatArray, c: FloatArray, closing: FloatArray, tol: float, marks: Marks
) -> bool:  # fmt: skip
    """Whether a period leads every lane from its start back to it, to `tol`; if not, improve the starts.

    The improvement is a step of Newton's method with the derivative of the period map with the area held. A lane that
    is within `tol` (relative to its peak gap voltage) keeps its start.
    """
    m_all, done = len(marks[0]), True
    for i in range(LANES):
        off = 0.0
        for m in range(m_all):
            change = (s[(Z * m_all + m) * LANES + i] - start[m * LANES + i]) * back[m * LANES + i]
            off += abs(c[(SHAPE + m) * LANES + i] * change)
        closing[i] = off / (s[(N_STATE * m_all + PEAK) * LANES + i] + 1e-300)
        if closing[i] > tol:
            done = False
            for m in range(m_all):
                change = s[(Z * m_all + m) * LANES + i] - start[m * LANES + i]
                start[m * LANES + i] += change * back[m * LANES + i]
    return done


@jit
def put_results(
    s: FloatArray, last: FloatArray, closing: FloatArray, steps: tuple[float, float], first: int, out: FloatArray,
    marks: Marks,
) -> None:  # fmt: skip
    """Means over the run and over its last period, the peak (V), and the relative error of the periodic state."""
    own, count = N_STATE * len(marks[0]), len(marks[4])
    for i in range(min(LANES, out.shape[1] - first)):
        for j in range(count):
            out[j, first + i] = s[(own + VALUE + count + j) * LANES + i] / steps[0]
            out[count + j, first + i] = last[j * LANES + i] / steps[1]
        out[2 * count, first + i] = s[(own + PEAK) * LANES + i]
        out[2 * count + 1, first + i] = closing[i]


class Block(NamedTuple):
    """What `fill_block` finds of a block's scenes, and its scratch.

    Attributes
    ----------
    start : ndarray, shape (n_mode * LANES,)
        Modes at the start, V.
    rates, drive : ndarray, shape (n_mode, LANES)
        Rates (1/s), and drive of a source of constant pieces.
    b : ndarray, shape (N_OTHERS * LANES,)
        The table's further rows.
    top, tail : ndarray, shape (LANES,)
        Largest gap voltage that the area's polynomial covers (V), and the relative size of its last coefficient;
        infinite where the universal curve does not reach so far.
    """

    start: FloatArray
    rates: FloatArray
    drive: FloatArray
    b: FloatArray
    top: FloatArray
    tail: FloatArray
    column: FloatArray
    work: FloatArray
    scratch: Scratch


@jit
def new_block(rows: int, marks: Marks) -> Block:
    """Arrays for blocks of scenes of a table with so many rows."""
    m = len(marks[0])
    return Block(
        np.empty(m * LANES), np.empty((m, LANES)), np.empty((m, LANES)), np.empty(N_OTHERS * LANES), np.empty(LANES),
        np.empty(LANES), np.empty(rows), np.empty((2, LANES)), _scratch(m),
    )  # fmt: skip


@jit
def fill_block(
    table: FloatArray, pending: NDArray[np.int64], first: int, places: Places,
    curves: tuple[FloatArray, FloatArray, FloatArray], source: tuple[FloatArray, bool, float], block: Block,
    c: FloatArray, marks: Marks,
) -> None:  # fmt: skip
    """Constants of the scenes from number `first` of `pending` on, into `c` and `block`.

    `source` has the frequencies of the tones, in that of the source; whether it is of constant pieces, or of straight
    lines; and the largest gap voltage that the area's polynomial covers, as a ratio to its estimate. The other
    arguments are those of `march`.
    """
    m_all, w_all, l_all, d_all = len(marks[0]), len(marks[1]), len(marks[2]), len(marks[3]) - 1
    cells, area = m_all + 1, area_row(m_all, w_all, l_all)
    column, b, top = block.column, block.b, block.top
    for i in range(LANES):
        column[:] = table[:, pending[min(first + i, pending.size - 1)]]
        for j in range(N_OTHERS):
            b[j * LANES + i] = column[CELL_ROWS * cells + j]
        top[i] = source[2] * _largest_voltage(column, places[0], cells, source[1]) + 1e-12
        c[SCALE * LANES + i] = 2.0 / top[i]
    c[area * LANES :] = 0.0
    for j in range(d_all + 1):
        _inverse_areas(curves[0].size, curves[1][j], top, b, curves[0], block.work[0], block.work[1])
        for d in range(d_all + 1):
            _add_row(curves[2][d, j], block.work[1], c[(area + d) * LANES : (area + d + 1) * LANES])
    for i in range(LANES):
        # The coefficients of the two highest powers are 2^(d - 1) and 2^(d - 2) times those of Chebyshev's series.
        # These fall to about a third from one to the next; the last one alone may be small by chance.
        tail = max(abs(c[area * LANES + i]), 2.0 / 3.0 * abs(c[(area + 1) * LANES + i])) / 2.0 ** (d_all - 1)
        covered = b[XI * LANES + i] * top[i] <= LARGEST_X
        block.tail[i] = tail / c[(area + d_all) * LANES + i] if covered else math.inf
        column[:] = table[:, pending[min(first + i, pending.size - 1)]]
        block.scratch[4][0] = c[(area + d_all) * LANES + i]
        _lane(
            i, places, column, source[0], source[1], c, block.start, block.rates[:, i], block.drive[:, i],
            block.scratch, marks,
        )  # fmt: skip


@jit
def march(
    table: FloatArray, pending: NDArray[np.int64], places: Places,
    curves: tuple[FloatArray, FloatArray, FloatArray], source: tuple[FloatArray, tuple[FloatArray, FloatArray]],
    how: tuple[int, int, int, bool, float, float], out: FloatArray, traces: tuple[FloatArray, FloatArray],
    marks: Marks,
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
    out : ndarray, shape (2, 2 n_moment + 3, n)
        For each run the means over it and over its last period, the peak (V), the relative error of the periodic
        state, and the relative size of the last coefficient of the area's series. The latter is infinite where the
        polynomial does not cover the voltages met.
    traces : tuple of ndarray, each of shape (n, steps)
        Gap voltage before every step of each run, V; (n, 0) for none.
    """
    m_all, w_all, l_all, d_all, count = len(marks[0]), len(marks[1]), len(marks[2]), len(marks[3]) - 1, len(marks[4])
    halves, half, pieces, periodic, tol, covered = how
    jumping = pieces > 0
    row = N_WEIGHTS * m_all * LANES
    c = np.zeros(n_constants(m_all, w_all, l_all, d_all) * LANES)
    g = (np.empty(row), np.empty((pieces if jumping else 4, 3, row)))
    s, last = np.empty(n_state(m_all, l_all, count) * LANES), np.empty(count * LANES)
    block, back, closing = new_block(table.shape[0], marks), np.zeros(m_all * LANES), np.zeros(LANES)
    start, rates, b, top = block.start, block.rates, block.b, block.top
    length, moments = np.empty(LANES), np.empty((11, LANES))
    voltages = np.empty(LANES * traces[0].shape[1]), np.empty(LANES * traces[1].shape[1])
    for first in range(0, pending.size, LANES):
        fill_block(table, pending, first, places, curves, (source[0], jumping, covered), block, c, marks)
        for i in range(LANES):
            if periodic:
                period = 2.0 * math.pi / b[OMEGA * LANES + i]
                for m in range(m_all):
                    back[m * LANES + i] = -1.0 / math.expm1(-rates[m, i] * period)
        for w in range(2):
            if source[1][w].size == 0:
                continue
            steps = half // 2 if w == 0 else half
            # All pieces together are 2^pieces - 1 times the first, which has steps / pieces of the shortest steps.
            shorter = pieces / (2.0**pieces - 1.0) if jumping else START_TIMES[1]
            for i in range(LANES):
                length[i] = math.pi / b[OMEGA * LANES + i] / steps * shorter
            weigh(length, rates, block.drive, g, moments, marks)
            for _ in range(MOST_PERIODS if periodic else 1):
                s[:] = 0.0
                s[: m_all * LANES] = start
                size = (halves, steps, jumping)
                run(c, g, s, source[1][w], size, last, voltages[w], marks)
                if not periodic or _closed(s, start, back, c, closing, tol, marks):
                    break
            put_results(s, last, closing, (float(halves * steps), 2.0 * steps), first, out[w], marks)
            for i in range(min(LANES, pending.size - first)):
                out[w, 2 * count + 2, first + i] = block.tail[i] if out[w, 2 * count, first + i] <= top[i] else math.inf
                width = traces[w].shape[1]
                traces[w][first + i] = voltages[w][i * width : (i + 1) * width]
