"""Constants of scenes for `step`: modes, response to the source, area polynomials, weights of the steps."""

from __future__ import annotations

import math
from itertools import islice
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fingerspice.base.arrays import FloatArray, aligned
from fingerspice.base.compiled import jit, jit_rows
from fingerspice.engine.lockstep import step as lockstep
from fingerspice.engine.lockstep.step import Marks, area_row, n_state
from fingerspice.numerics.modes import write_modes

# A mode's rate nearer than this (relative) to the rate of a cell, a pole of the characteristic equation, has too few
# correct digits in the difference of both.
NEAR_POLE = 1e-5


@jit_rows
def _in_closed_form(
    k: FloatArray, moved: FloatArray, r: FloatArray, inverse: FloatArray, rates: FloatArray, near: FloatArray,
    gain: FloatArray, feed: FloatArray, shape: FloatArray, marks: Marks,
) -> None:  # fmt: skip
    """Rates of the cells, into `r`, and the modes of two or three cells; `inverse` is 1/A.

    On entry `r` holds the leakage rates by area. `near` is 1 where a mode's rate is too near to that of a cell, and for
    more cells, whose modes need an iteration. `feed` and `shape` have a row for every mode of every cell.
    """
    m_all, lanes = len(marks[0]), len(marks[5])
    cells = m_all + 1
    for i in range(lanes):
        for j in range(cells):
            r[j * lanes + i] += inverse[i] * moved[j * lanes + i]
        unclear = 0.0 if m_all <= 2 else 1.0
        if m_all == 1:
            rates[0, i] = k[i] * r[lanes + i] + k[lanes + i] * r[i]
        if m_all == 2:
            r0, r1, r2 = r[i], r[lanes + i], r[2 * lanes + i]
            k0, k1, k2 = k[i], k[lanes + i], k[2 * lanes + i]
            middle = 0.5 * (k0 * (r1 + r2) + k1 * (r0 + r2) + k2 * (r0 + r1))
            product = k0 * r1 * r2 + k1 * r0 * r2 + k2 * r0 * r1
            faster = middle + math.sqrt(max(middle * middle - product, 0.0))
            rates[0, i], rates[1, i] = product / faster, faster
        for m in range(m_all if m_all <= 2 else 0):
            norm = 0.0
            for j in range(cells):
                rate, at = r[j * lanes + i], (j * m_all + m) * lanes + i
                apart = rate - rates[m, i]
                unclear = unclear if abs(apart) > NEAR_POLE * max(rate, rates[m, i]) else 1.0
                feed[at] = 1.0 / apart
                shape[at] = k[j * lanes + i] * feed[at]
                norm += shape[at] * feed[at]
            gain[m * lanes + i] = -1.0 / norm
            for j in range(cells):
                feed[(j * m_all + m) * lanes + i] *= -1.0 / norm
        near[i] = unclear


@jit
def _by_iteration(rates: FloatArray, scratch: Any, marks: Marks) -> None:
    """Modes of the lanes for which the closed form would lose digits, or of all where there is none."""
    k, _, r, near, gain, feed, shape, _, own, found, forms, floats, whole = scratch
    m_all, lanes = len(marks[0]), len(marks[5])
    for i in range(lanes):
        if near[i] > 0.0:
            for j in range(m_all + 1):
                own[0, j], own[1, j] = r[j * lanes + i], k[j * lanes + i]
            write_modes(own[0], own[1], (found[0], found[1], forms[0], forms[1]), floats, whole)
            for m in range(m_all):
                rates[m, i], gain[m * lanes + i] = found[0, m], found[1, m]
                for j in range(m_all + 1):
                    feed[(j * m_all + m) * lanes + i] = forms[0, j, m]
                    shape[(j * m_all + m) * lanes + i] = forms[1, j, m]


# A table of scenes has three rows for every cell: capacitance (F/m^2), total leakage (S), leakage per area (S/m^2).
CELL_ROWS = 3
# Its further rows.
XI, REST, STRESS, LOAD, LOSS, OMEGA, N_OTHERS = 0, 1, 2, 3, 4, 5, 6
"""X of Eq. 4 at 1 V, A0 at 0 V (m^2), stress at 1 V (Pa), load (N), c2 mu^2; the source's angular frequency (rad/s).
After them come the amplitudes (V) of the sine and of the cosine in each of its tones; a square's or recording's is the
first of both. Under another contact law than the paper's the powers of 1/A over X follow, the highest first, and X is
LARGEST_X where they end."""
LARGEST_X = 1.3
"""Largest X that the series of the universal curve covers."""
Scenes = tuple[
    FloatArray,  # (n_row, n_scene): Table, `CELL_ROWS` for all cells, `N_OTHERS` rows, and two for every tone
    NDArray[np.int64],  # (n,): Which of them are integrated
    tuple[int, NDArray[np.int64]],  # The gap among the cells, and those whose leak has a total resistance
    # Polynomial coefficients of the universal curve over X, highest power first; Chebyshev points; and the matrix from
    # values at these points to polynomial coefficients (d + 1, d + 1), highest power first
    tuple[FloatArray, FloatArray, FloatArray],
]
"""Scenes of a table, and what they have in common."""


@jit_rows
def _divide(
    t: FloatArray, gap: int, jumping: bool, covered: float, k: FloatArray, moved: FloatArray, own: FloatArray,
    top: FloatArray, marks: Marks,
) -> None:  # fmt: skip
    """Shares of the cells in a voltage step, their leakage rates by total resistance and by area, and the largest u.

    That is an estimate of the largest gap voltage with the area at rest, times `covered`. The gap's share of the source
    is between the capacitive and the resistive divider's; the jump of a square adds the difference of both, which is
    left of the half period before.
    """
    cells, tones, lanes = len(marks[0]) + 1, (len(marks[1]) + 1) // 2, len(marks[5])
    others, turned = CELL_ROWS * cells, 1.0 if jumping else 0.0
    for i in range(lanes):
        elastance, resistance, area = 0.0, 0.0, t[(others + REST) * lanes + i]
        for j in range(cells):
            inverse = 1.0 / t[j * lanes + i]
            total, per_area = t[(cells + j) * lanes + i], t[(2 * cells + j) * lanes + i]
            moved[j * lanes + i] = total * inverse
            own[j * lanes + i] = per_area * inverse
            k[j * lanes + i] = inverse
            elastance += inverse
            resistance += 1.0 / (total + area * per_area + 1e-300)
        for j in range(cells):
            k[j * lanes + i] /= elastance
        amplitude = 0.0
        for tone in range(tones):
            along, across = (
                t[(others + N_OTHERS + 2 * tone) * lanes + i],
                t[(others + N_OTHERS + 2 * tone + 1) * lanes + i],
            )
            amplitude += math.sqrt(along * along + across * across)
        at_once = 1.0 / (t[gap * lanes + i] * elastance)
        leak = t[(cells + gap) * lanes + i] + area * t[(2 * cells + gap) * lanes + i]
        at_last = 1.0 / ((leak + 1e-300) * resistance)
        share = max(at_once, at_last) + turned * abs(at_once - at_last)
        top[i] = covered * (amplitude * share) + 1e-12


@jit_rows
def _inverse_areas(
    at: float, top: FloatArray, b: FloatArray, own: FloatArray, series: FloatArray, y: FloatArray, out: FloatArray,
    marks: Marks,
) -> None:  # fmt: skip
    """1/A at the voltages top (1 + at) / 2 of every lane, by the universal curve and the closed form of Eqs. 1 and 3.

    `b` holds the table's further rows (X, A0, stress, ...) for the lanes of the block, `own` the powers of another law;
    `y` (lanes,) is scratch.
    """
    lanes, half = len(marks[5]), 0.5 * (1.0 + at)
    if own.size > 0:
        for i in range(lanes):
            out[i] = 0.0
        for d in range(own.size // lanes):
            for i in range(lanes):
                x = b[XI * lanes + i] * (half * top[i]) * (2.0 / LARGEST_X) - 1.0
                out[i] = out[i] * x + own[d * lanes + i]
        return
    for i in range(lanes):
        y[i] = series[0]
    for d in range(1, series.size):
        for i in range(lanes):
            x = b[XI * lanes + i] * (half * top[i]) * (2.0 / LARGEST_X) - 1.0
            y[i] = y[i] * x + series[d]
    for i in range(lanes):
        u, a = half * top[i], b[REST * lanes + i] * y[i]
        load, loss = b[LOAD * lanes + i], b[LOSS * lanes + i]
        sigma = b[STRESS * lanes + i] * u * u
        root = math.sqrt(a * a + 4.0 * loss * sigma * a * (load + sigma * a))
        out[i] = (a + 2.0 * loss * load * sigma + root) / (2.0 * (a * a - loss * load * load))


@jit_rows
def _polynomials(
    matrix: FloatArray, values: FloatArray, top: FloatArray, xi: FloatArray, area: int, c: FloatArray,
    tails: FloatArray, marks: Marks,
) -> None:  # fmt: skip
    """Coefficients of 1/A of every lane, from row `area` of the constants on, from its values at Chebyshev's points.

    With them go the scale of |u|, and behind them the derivative of 1/A by |u| at 0 V, where their variable is -1.
    `xi` is X at 1 V.
    """
    count, lanes = len(marks[3]), len(marks[5])
    for d in range(count):
        for i in range(lanes):
            total = matrix[d, 0] * values[i]
            for j in range(1, count):
                total += matrix[d, j] * values[j * lanes + i]
            c[(area + d) * lanes + i] = total
    for i in range(lanes):
        slope, value = 0.0, c[area * lanes + i]
        for d in range(1, count):
            slope = value - slope
            value = c[(area + d) * lanes + i] - value
        c[lockstep.SCALE * lanes + i] = 2.0 / top[i]
        c[(area + count) * lanes + i] = slope * c[lockstep.SCALE * lanes + i]
        # The coefficients of the two highest powers are 2^(d - 1) and 2^(d - 2) times those of Chebyshev's series.
        # These fall to about a third from one to the next; the last one alone may be small by chance.
        tail = max(abs(c[area * lanes + i]), 2.0 / 3.0 * abs(c[(area + 1) * lanes + i])) / 2.0 ** (count - 2)
        tails[i] = tail / c[(area + count - 1) * lanes + i] if xi[i] * top[i] <= LARGEST_X else math.inf


@jit_rows
def _respond(
    t: FloatArray, tones: FloatArray, lines: bool, where: tuple[int, NDArray[np.int64]], rates: FloatArray,
    k: FloatArray, moved: FloatArray, forms: tuple[FloatArray, FloatArray, FloatArray], start: FloatArray,
    drive: FloatArray, c: FloatArray, marks: Marks,
) -> None:  # fmt: skip
    """How modes and source act on gap and leaks, into the constants, and the modes at the start.

    A tone's response in a mode is gain (rate - i omega) / (rate^2 + omega^2) of it, and the modes are the rest beside
    it. Constant pieces and straight lines act on the cells at once, and drive the modes.
    """
    m_all, w_all, l_all, lanes = len(marks[0]), len(marks[1]), len(marks[2]), len(marks[5])
    (gap, leaks), (gain, feed, shape) = where, forms
    others, of_u = CELL_ROWS * (m_all + 1), lockstep.SHAPE + m_all
    of_w = of_u + w_all
    of_z = of_w + l_all * w_all
    of_leak, driven = of_z + l_all * m_all, 1.0 if lines else 0.0
    for i in range(lanes):
        for m in range(m_all):
            start[m * lanes + i] = 0.0
            c[(lockstep.SHAPE + m) * lanes + i] = shape[(gap * m_all + m) * lanes + i]
            for n in range(l_all):
                at, to = (leaks[n] * m_all + m) * lanes + i, (of_leak + m * l_all + n) * lanes + i
                c[(of_z + n * m_all + m) * lanes + i] = shape[at]
                c[to] = feed[at] * moved[leaks[n] * lanes + i]
        for tone in range((w_all + 1) // 2):
            row = others + N_OTHERS + 2 * tone
            sine, cosine = t[row * lanes + i], t[(row + 1) * lanes + i]
            omega = tones[tone] * t[(others + OMEGA) * lanes + i]
            u_sine, u_cosine = k[gap * lanes + i] * sine, k[gap * lanes + i] * cosine
            for n in range(l_all):
                c[(of_w + n * w_all + 2 * tone) * lanes + i] = k[leaks[n] * lanes + i] * sine
                if w_all > 1:
                    c[(of_w + n * w_all + 2 * tone + 1) * lanes + i] = k[leaks[n] * lanes + i] * cosine
            for m in range(m_all):
                rate = rates[m, i]
                drive[m, i] = driven * (gain[m * lanes + i] * sine)
                size = (1.0 - driven) * gain[m * lanes + i] / (rate * rate + omega * omega)
                along, across = size * (rate * sine + omega * cosine), size * (rate * cosine - omega * sine)
                start[m * lanes + i] -= across
                u_sine += c[(lockstep.SHAPE + m) * lanes + i] * along
                u_cosine += c[(lockstep.SHAPE + m) * lanes + i] * across
                for n in range(l_all):
                    by = c[(of_z + n * m_all + m) * lanes + i]
                    c[(of_w + n * w_all + 2 * tone) * lanes + i] += by * along
                    if w_all > 1:
                        c[(of_w + n * w_all + 2 * tone + 1) * lanes + i] += by * across
            c[(of_u + 2 * tone) * lanes + i] = u_sine
            if w_all > 1:
                c[(of_u + 2 * tone + 1) * lanes + i] = u_cosine


def block_shapes(
    rows: int, pieces: int, marks: Marks, portions: int = 1
) -> tuple[tuple[tuple[int, ...], ...], ...]:  # fmt: skip
    """Shapes of a block's arrays, for a table with so many rows and half periods of so many pieces (4 without jumps).

    They are in three groups: what `fill_block` finds, its scratch, and what `march.march_block` steps with.
    """
    m, w, k, d, count, lanes = (len(mark) for mark in marks)
    lane, modes, cells, both = (lanes,), (m * lanes,), ((m + 1) * lanes,), ((m + 1) * m * lanes,)
    found = (
        ((area_row(m, w, k) + d + 1) * lanes,),  # Constants, as `step` takes them
        modes,  # Modes at the start, V
        (m, lanes), (m, lanes),  # Rates (1/s), and drive of a source of constant pieces
        (rows * lanes,),  # Columns of the table
        # Largest gap voltage that the area's polynomial covers (V), and the relative size of its last coefficient;
        # infinite where the universal curve does not reach so far
        lane, lane,
    )  # fmt: skip
    # Of the cells, their share, rate by total resistance and rate; of a lane, whether a rate is near, and others; the
    # modes' gain, feed and shape; values of the area; and for `write_modes` of one lane, rates and shares of the cells,
    # rates and gains of the modes, their feeds and shapes, and its scratch.
    scratch = (
        cells, cells, cells, lane, modes, both, both, (d * lanes,), (2, m + 1), (2, m), (2, m + 1, m), (2, m + 1),
    )  # fmt: skip
    stepping = (
        (1 + pieces, lockstep.N_WEIGHTS * m * lanes),  # Weights, as `step.run` takes them
        (n_state(m, k, count) * lanes,),  # State
        (portions * count * lanes,),  # Sums over the last period, or each portion of a recording
        modes,  # Modes at the start of the last period
        # In the search for the periodic state, the derivative of the start by what a period leaves open, with the area
        # held. In a run from rest, an upper bound of the modes' time constants, in periods.
        modes,
        # What the periodic state is off, relative to the peak gap voltage; or half of what the mean force is off
        # because the last period stands for those after it, relative to that force, and infinite while it does not
        lane,
        # Length of the shortest step, s; in a run from rest, then the number of half periods after which it has settled
        lane,
        (9, lanes),  # Scratch of `step.weigh` and `step.run`
    )  # fmt: skip
    return found, scratch, stepping


def new_block(rows: int, pieces: int, marks: Marks, portions: int) -> tuple[Any, Any, Any]:
    """Arrays for blocks of scenes; `pieces` is 0 without jumps."""
    shapes = block_shapes(rows, pieces or 4, marks, portions)
    arrays = iter(aligned(shape for group in shapes for shape in group))
    found, scratch, stepping = (tuple(islice(arrays, len(group))) for group in shapes)
    return found, (*scratch, np.empty((2, len(marks[0]) + 1), np.int64)), stepping


@jit
def fill_block(
    scenes: Scenes, first: int, source: tuple[FloatArray, bool, float], found: Any, scratch: Any, marks: Marks
) -> None:
    """Find the constants of the scenes from number `first` on.

    `source` has the frequencies of the tones, in that of the source; whether it is of constant pieces, or of straight
    lines; and the largest gap voltage that the area's polynomial covers, as a ratio to its estimate.
    """
    m_all, w_all, l_all, d_all, lanes = len(marks[0]), len(marks[1]), len(marks[2]), len(marks[3]) - 1, len(marks[5])
    area = area_row(m_all, w_all, l_all)
    table, pending, (gap, _), curves = scenes
    c, start, rates, drive, t, top, tails = found
    k, moved, r, near, gain, feed, shape, values, _, _, _, _, _ = scratch
    for i in range(lanes):
        scene = pending[min(first + i, pending.size - 1)]
        for row in range(table.shape[0]):
            t[row * lanes + i] = table[row, scene]
    _divide(t, gap, source[1], source[2], k, moved, r, top, marks)
    b = t[CELL_ROWS * (m_all + 1) * lanes :]
    own = b[(N_OTHERS + 2 * ((w_all + 1) // 2)) * lanes :]
    for i in range(lanes if own.size > 0 else 0):
        # A law's areas may end before the voltage that the gap might reach.
        top[i] = min(top[i], (1.0 - 1e-12) * LARGEST_X / b[XI * lanes + i])
    for j in range(d_all + 1):
        _inverse_areas(curves[1][j], top, b, own, curves[0], near, values[j * lanes : (j + 1) * lanes], marks)
    _polynomials(curves[2], values, top, b[XI * lanes :], area, c, tails, marks)
    at_rest = c[(area + d_all) * lanes : (area + d_all + 1) * lanes]
    _in_closed_form(k, moved, r, at_rest, rates, near, gain, feed, shape, marks)
    _by_iteration(rates, scratch, marks)
    forms = gain, feed, shape
    _respond(t, source[0], source[1], scenes[2], rates, k, moved, forms, start, drive, c, marks)
