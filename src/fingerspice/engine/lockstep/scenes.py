"""Constants of scenes in lockstep: modes, responses to the source and polynomials of the area, a column for each scene.

Sums are taken row by row, so that no scene's rounding depends on how many there are.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from numpy.polynomial.chebyshev import cheb2poly
from numpy.typing import NDArray

from fingerspice.base.arrays import FloatArray, IntArray
from fingerspice.base.compiled import jit, jit_rows
from fingerspice.engine.lockstep.step import SHAPE, area_row
from fingerspice.numerics import chebyshev
from fingerspice.numerics.modes import write_modes
from fingerspice.physics.contact import N_PACKED, inverse_areas_of_many

# A mode's rate nearer than this (relative) to the rate of a cell, a pole of the characteristic equation, has too few
# correct digits in the difference of both.
NEAR_POLE = 1e-5
CELL_ROWS = 3
"""Rows of a table of scenes for every cell: capacitance (F/m^2), total leakage (S), leakage per area (S/m^2).

Then come the contact's constants, as `physics.contact` packs them, the source's angular frequency (rad/s), and the
amplitudes (V) of the sine and of the cosine in each of its tones; a square's or recording's is the first of both."""

# Rows of a scene's constants, from the last one back: the relative size of the last coefficient of the area's
# polynomial, infinite where the contact's own series does not reach so far; the largest gap voltage that it covers (V);
# the source's angular frequency (rad/s); the slope of 1/A by |u| at 0 V. Before them, of every mode: voltage at the
# start (V), rate (1/s), and drive of a source of constant pieces or straight lines.
TAIL, TOP, OMEGA, SLOPE, N_LAST = 1, 2, 3, 4, 4
START, RATES, DRIVE, N_OF_MODES = 0, 1, 2, 3


def constants_of(
    table: FloatArray, places: tuple[int, int, IntArray], tones: FloatArray | None, covered: float, degree: int
) -> FloatArray | None:
    """What `march.march` takes of scenes of a table, a column each; None without a series of the area.

    `places` are the number of cells, the gap among them, and those whose leak has a total resistance; `tones` the
    frequencies of the source's tones, in its own, or None for one of constant pieces or straight lines; `covered` is
    the largest gap voltage that the area's polynomial covers, as a ratio to its estimate.
    """
    cells, gap, leaks = places
    c, total, per_area = table[: CELL_ROWS * cells].reshape(CELL_ROWS, cells, -1)
    contacts, omega = table[CELL_ROWS * cells :][:N_PACKED], table[CELL_ROWS * cells + N_PACKED]
    waves = table[CELL_ROWS * cells + N_PACKED + 1 :]
    with np.errstate(all="ignore"):
        k = 1.0 / c
        k /= sum(k)
        # The gap's share of the source is between the capacitive and the resistive divider's, with the area at rest; a
        # jump adds the difference of both, which is left of what was before.
        leak = total + contacts[1] * per_area + 1e-300
        at_last = 1.0 / (leak[gap] * sum(1.0 / leak))
        share = np.maximum(k[gap], at_last)
        if tones is None:
            share += abs(k[gap] - at_last)
        amplitude = sum(np.sqrt(waves[::2] ** 2 + waves[1::2] ** 2))
        top = covered * (amplitude * share) + 1e-12
        nodes, to_powers = _polynomials(degree)
        found = inverse_areas_of_many(np.multiply.outer(0.5 * (1.0 + nodes), top), contacts)
        if found is None:
            return None
        area = np.empty((degree + 2, top.size))
        _combine(to_powers, found[0], area)
        slope, area = 2.0 / top * area[0], area[1:]
        # The coefficients of the two highest powers are 2^(d - 1) and 2^(d - 2) times those of Chebyshev's series.
        # These fall to about a third from one to the next; the last one alone may be small by chance.
        tail = np.maximum(abs(area[0]), 2.0 / 3.0 * abs(area[1])) / 2.0 ** (degree - 1) / area[-1]
        tail = np.where(top <= found[1], tail, np.inf)
    first = area_row(cells - 1, len(waves) if tones is not None else 1, leaks.size)
    out = np.empty((first + degree + 1 + N_OF_MODES * (cells - 1) + N_LAST, top.size))
    out[0], out[first : first + degree + 1], out[-N_LAST:] = 2.0 / top, area, (slope, omega, top, tail)
    _fill(table, k, np.array([gap, *leaks]), np.empty(0) if tones is None else tones, first + degree, out)
    return out


@lru_cache(maxsize=32)
def _polynomials(degree: int) -> tuple[FloatArray, FloatArray]:
    """Chebyshev points; and the matrix from values there to the slope at -1 and the powers, the highest first."""
    at = np.eye(degree + 1)
    to_powers = np.zeros((degree + 1, degree + 1))
    for k in range(degree + 1):
        to_powers[: k + 1, k] = cheb2poly(at[k, : k + 1])
    powers, series = to_powers[::-1], chebyshev.coefficients(at)
    slopes = np.array([(-1.0) ** (k + 1) * k * k for k in range(degree + 1)])
    return chebyshev.nodes(degree + 1, -1.0, 1.0), np.vstack([slopes @ series, powers @ series])


@jit_rows
def _combine(matrix: FloatArray, values: FloatArray, out: FloatArray) -> None:
    """Rows of `out` as combinations of those of `values`."""
    for d in range(matrix.shape[0]):
        for i in range(values.shape[1]):
            out[d, i] = matrix[d, 0] * values[0, i]
        for j in range(1, values.shape[0]):
            by = matrix[d, j]
            for i in range(values.shape[1]):
                out[d, i] += by * values[j, i]


@jit
def _modes(
    r: FloatArray, k: FloatArray, found: tuple[FloatArray, FloatArray, FloatArray, FloatArray], floats: FloatArray,
    whole: NDArray[np.int64],
) -> None:  # fmt: skip
    """As `write_modes`: in closed form, or by its iteration where this would lose digits or there is none."""
    rates, gain, feed, shape = found
    near = r.size > 3
    if r.size == 2:
        rates[0] = k[0] * r[1] + k[1] * r[0]
    if r.size == 3:
        middle = 0.5 * (k[0] * (r[1] + r[2]) + k[1] * (r[0] + r[2]) + k[2] * (r[0] + r[1]))
        product = k[0] * r[1] * r[2] + k[1] * r[0] * r[2] + k[2] * r[0] * r[1]
        rates[1] = middle + math.sqrt(max(middle * middle - product, 0.0))
        rates[0] = product / rates[1]
    for m in range(0 if near else rates.size):
        norm = 0.0
        for j in range(r.size):
            apart = r[j] - rates[m]
            near = near or not abs(apart) > NEAR_POLE * max(r[j], rates[m])
            feed[j, m] = 1.0 / apart
            shape[j, m] = k[j] * feed[j, m]
            norm += shape[j, m] * feed[j, m]
        gain[m] = -1.0 / norm
        for j in range(r.size):
            feed[j, m] *= gain[m]
    if near:
        write_modes(r, k, found, floats, whole)


@jit
def _fill(
    table: FloatArray, k: FloatArray, cells_seen: IntArray, tones: FloatArray, held: int, out: FloatArray
) -> None:  # fmt: skip
    """Constants of modes and waves, scene by scene, from the shares k of the cells.

    `cells_seen` are the gap's and those of the leaks; `held` is the row of 1/A in the middle of the voltages.
    """
    cells, gap, leaks = k.shape[0], cells_seen[0], cells_seen[1:]
    modes, n_leak, n_wave, others = cells - 1, leaks.size, max(2 * tones.size, 1), CELL_ROWS * cells + N_PACKED
    by_wave = SHAPE + modes
    by_mode = by_wave + (1 + n_leak) * n_wave
    by_leak, start = by_mode + n_leak * modes, held + 1
    r, share, moved, rates, gain = np.empty(cells), np.empty(cells), np.empty(cells), np.empty(modes), np.empty(modes)
    feed, shape = np.empty((cells, modes)), np.empty((cells, modes))
    floats, whole = np.empty((2, cells)), np.empty((2, cells), np.int64)
    for i in range(table.shape[1]):
        for j in range(cells):
            inverse = 1.0 / table[j, i]
            share[j], moved[j] = k[j, i], table[cells + j, i] * inverse
            r[j] = out[held, i] * moved[j] + table[2 * cells + j, i] * inverse
        _modes(r, share, (rates, gain, feed, shape), floats, whole)
        for m in range(modes):
            out[SHAPE + m, i], out[start + m, i], out[start + modes + m, i] = shape[gap, m], 0.0, rates[m]
            out[start + 2 * modes + m, i] = gain[m] * table[others + 1, i] if tones.size == 0 else 0.0
            for x in range(n_leak):
                out[by_mode + x * modes + m, i] = shape[leaks[x], m]
                out[by_leak + m * n_leak + x, i] = feed[leaks[x], m] * moved[leaks[x]]
        for x in range(1 + n_leak):
            for w in range(n_wave):
                out[by_wave + x * n_wave + w, i] = share[cells_seen[x]] * table[others + 1 + w, i]
        for tone in range(tones.size):
            sine, cosine = table[others + 1 + 2 * tone, i], table[others + 2 + 2 * tone, i]
            turning = tones[tone] * table[others, i]
            for m in range(modes):
                # A tone's response in a mode is gain (rate - i omega) / (rate^2 + omega^2) of it. The mode starts at
                # the rest beside it.
                size = gain[m] / (rates[m] * rates[m] + turning * turning)
                along, across = size * (rates[m] * sine + turning * cosine), size * (rates[m] * cosine - turning * sine)
                out[start + m, i] -= across
                for x in range(1 + n_leak):
                    row = by_wave + x * n_wave + 2 * tone
                    out[row, i] += shape[cells_seen[x], m] * along
                    out[row + 1, i] += shape[cells_seen[x], m] * across
