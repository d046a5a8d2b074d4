"""Constants of scenes for `engine.lockstep`: modes, response to the source, area polynomials, weights of the steps."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fingerspice.base.arrays import FloatArray
from fingerspice.base.compiled import jit, jit_rows
from fingerspice.engine.lockstep import (
    N_STATE,
    PEAK,
    SCALE,
    SHAPE,
    VALUE,
    Marks,
    area_row,
    n_constants,
)  # fmt: skip
from fingerspice.numerics.modes import write_modes

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
# A mode's rate nearer than this (relative) to the rate of a cell, a pole of the characteristic equation, has too few
# correct digits in the difference of both.
NEAR_POLE = 1e-5


@jit_rows
def _inverse_areas(
    at: float, top: FloatArray, b: FloatArray, series: FloatArray, y: FloatArray, out: FloatArray, marks: Marks
) -> None:  # fmt: skip
    """1/A at the voltages top (1 + at) / 2 of every lane, by the universal curve and the closed form of Eqs. 1 and 3.

    `b` holds the table's further rows (X, A0, stress, ...) for the lanes of the block; `y` (lanes,) is scratch.
    """
    lanes = len(marks[5])
    for i in range(lanes):
        x = b[XI * lanes + i] * (0.5 * (1.0 + at) * top[i]) * (2.0 / LARGEST_X) - 1.0
        total = series[0]
        for d in range(1, series.size):
            total = total * x + series[d]
        y[i] = total
    for i in range(lanes):
        u = 0.5 * (1.0 + at) * top[i]
        a0 = b[REST * lanes + i] * y[i]
        load, k = b[LOAD * lanes + i], b[LOSS * lanes + i] / a0
        sigma = b[STRESS * lanes + i] * u * u
        root = math.sqrt(1.0 + 4.0 * k * sigma * (load + sigma * a0))
        out[i] = (1.0 + 2.0 * k * load * sigma + root) / (2.0 * (a0 - k * load * load))


@jit_rows
def _add_row(share: float, x: FloatArray, out: FloatArray, marks: Marks) -> None:
    for i in range(len(marks[5])):
        out[i] += share * x[i]


@jit
def _read_column(table: FloatArray, scene: int, column: FloatArray) -> None:
    for j in range(column.size):
        column[j] = table[j, scene]


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


class Scratch(NamedTuple):
    """Arrays for the cells and modes of one lane, used by all in turn; all are overwritten."""

    k: FloatArray
    r: FloatArray
    moved: FloatArray
    u: FloatArray
    inverse: FloatArray
    gain: FloatArray
    feed: FloatArray
    shape: FloatArray
    floats: FloatArray
    whole: NDArray[np.int64]


@jit
def _modes(rates: FloatArray, scratch: Scratch) -> None:
    """As `numerics.modes.write_modes`, and without its iteration for three cells with different rates."""
    k, r, _, _, _, gain, feed, shape, floats, whole = scratch
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
    write_modes(r, k, (rates, gain, feed, shape), floats, whole)


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
    k, r, moved, u, inverse, gain, feed, shape, _, _ = scratch
    lanes = len(marks[5])
    total = 0.0
    for j in range(cells):
        total += 1.0 / t[j]
    for j in range(cells):
        k[j] = 1.0 / (t[j] * total)
        moved[j] = t[cells + j] / t[j]
        r[j] = t[2 * cells + j] / t[j] + inverse[0] * moved[j]
    _modes(rates, scratch)
    of_u, of_w = SHAPE + m_all, SHAPE + m_all + w_all
    of_z = of_w + l_all * w_all
    of_leak = of_z + l_all * m_all
    for m in range(m_all):
        c[(SHAPE + m) * lanes + i] = shape[gap, m]
        start[m * lanes + i] = 0.0
        drive[m] = gain[m] * t[others + N_OTHERS] if jumping else 0.0
        for n in range(l_all):
            c[(of_z + n * m_all + m) * lanes + i] = shape[leaks[n], m]
            c[(of_leak + m * l_all + n) * lanes + i] = feed[leaks[n], m] * moved[leaks[n]]
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
                    start[m * lanes + i] -= size * across
                for j in range(cells):
                    u[j] += shape[j, m] * size * (along if w % 2 == 0 else across)
        c[(of_u + w) * lanes + i] = u[gap]
        for n in range(l_all):
            c[(of_w + n * w_all + w) * lanes + i] = u[leaks[n]]


@jit
def put_result(
    i: int, s: FloatArray, last: FloatArray, closing: float, lengths: tuple[int, int, int], first: int,
    out: FloatArray, marks: Marks,
) -> None:  # fmt: skip
    """Lane i's means over the run and its last period, its peak (V), and the relative error of the periodic state.

    `lengths` are the number of periods that the last period stands for beside itself; that of half periods of the run;
    and of the steps in each.
    """
    own, count, lanes = N_STATE * len(marks[0]), len(marks[4]), len(marks[5])
    ahead, halves, steps = lengths
    if first + i >= out.shape[1]:
        return
    for j in range(count):
        total = s[(own + VALUE + count + j) * lanes + i]
        if ahead > 0:
            total += ahead * last[j * lanes + i]
        out[j, first + i] = total / (halves * steps)
        out[count + j, first + i] = last[j * lanes + i] / (2 * steps)
    out[2 * count, first + i] = s[(own + PEAK) * lanes + i]
    out[2 * count + 1, first + i] = closing


class Block(NamedTuple):
    """What `fill_block` finds of a block's scenes, and its scratch.

    Attributes
    ----------
    c : ndarray, shape (n_constants * lanes,)
        Constants, as `engine.lockstep` takes them.
    start : ndarray, shape (n_mode * lanes,)
        Modes at the start, V.
    rates, drive : ndarray, shape (n_mode, lanes)
        Rates (1/s), and drive of a source of constant pieces.
    b : ndarray, shape (N_OTHERS * lanes,)
        The table's further rows.
    top, tail : ndarray, shape (lanes,)
        Largest gap voltage that the area's polynomial covers (V), and the relative size of its last coefficient;
        infinite where the universal curve does not reach so far.
    """

    c: FloatArray
    start: FloatArray
    rates: FloatArray
    drive: FloatArray
    b: FloatArray
    top: FloatArray
    tail: FloatArray
    column: FloatArray
    work: FloatArray
    scratch: Scratch


def block_shapes(rows: int, marks: Marks) -> tuple[tuple[int, ...], ...]:
    """Shapes of the arrays of a `Block` before its scratch, for a table with so many rows."""
    m_all, w_all, l_all, d_all, _, lanes = (len(mark) for mark in marks)
    size = n_constants(m_all, w_all, l_all, d_all - 1) * lanes
    modes = (m_all, lanes)
    return (size,), (m_all * lanes,), modes, modes, (N_OTHERS * lanes,), (lanes,), (lanes,), (rows,), (2, lanes)


def scratch_shapes(marks: Marks) -> tuple[tuple[int, ...], ...]:
    """Shapes of the arrays of a `Scratch`."""
    m = len(marks[0])
    row = (m + 1,)
    return row, row, row, row, row, (m,), (m + 1, m), (m + 1, m), (2, m + 1), (2, m + 1)


def new_block(rows: int, marks: Marks) -> Block:
    """Arrays for blocks of scenes of a table with so many rows."""
    *floats, whole = scratch_shapes(marks)
    scratch = Scratch._make([*(np.empty(shape) for shape in floats), np.empty(whole, np.int64)])
    return Block._make([*(np.empty(shape) for shape in block_shapes(rows, marks)), scratch])


@jit
def fill_block(
    table: FloatArray, pending: NDArray[np.int64], first: int, places: Places,
    curves: tuple[FloatArray, FloatArray, FloatArray], source: tuple[FloatArray, bool, float], block: Block,
    marks: Marks,
) -> None:  # fmt: skip
    """Constants of the scenes from number `first` of `pending` on, into `block`.

    `source` has the frequencies of the tones, in that of the source; whether it is of constant pieces, or of straight
    lines; and the largest gap voltage that the area's polynomial covers, as a ratio to its estimate. The other
    arguments are those of `march`.
    """
    m_all, w_all, l_all, d_all, lanes = len(marks[0]), len(marks[1]), len(marks[2]), len(marks[3]) - 1, len(marks[5])
    cells, area = m_all + 1, area_row(m_all, w_all, l_all)
    c, start, rates, drive, b, top, tails, column, work, scratch = block
    for i in range(lanes):
        _read_column(table, pending[min(first + i, pending.size - 1)], column)
        for j in range(N_OTHERS):
            b[j * lanes + i] = column[CELL_ROWS * cells + j]
        top[i] = source[2] * _largest_voltage(column, places[0], cells, source[1]) + 1e-12
        c[SCALE * lanes + i] = 2.0 / top[i]
    c[area * lanes :] = 0.0
    for j in range(d_all + 1):
        _inverse_areas(curves[1][j], top, b, curves[0], work[0], work[1], marks)
        for d in range(d_all + 1):
            _add_row(curves[2][d, j], work[1], c[(area + d) * lanes : (area + d + 1) * lanes], marks)
    for i in range(lanes):
        # The coefficients of the two highest powers are 2^(d - 1) and 2^(d - 2) times those of Chebyshev's series.
        # These fall to about a third from one to the next; the last one alone may be small by chance.
        tail = max(abs(c[area * lanes + i]), 2.0 / 3.0 * abs(c[(area + 1) * lanes + i])) / 2.0 ** (d_all - 1)
        covered = b[XI * lanes + i] * top[i] <= LARGEST_X
        tails[i] = tail / c[(area + d_all) * lanes + i] if covered else math.inf
        _read_column(table, pending[min(first + i, pending.size - 1)], column)
        scratch[4][0] = c[(area + d_all) * lanes + i]
        _lane(
            i, places, column, source[0], source[1], c, start, rates[:, i], drive[:, i], scratch,
            marks,
        )  # fmt: skip
