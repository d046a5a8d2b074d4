"""Modes of a block of series stacks with their areas held, for `engine.lockscenes`; see `engine.lockstep` for lanes."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fingerspice.base.arrays import FloatArray
from fingerspice.base.compiled import jit, jit_rows
from fingerspice.engine.lockstep import SHAPE, Marks
from fingerspice.numerics.modes import write_modes

# A mode's rate nearer than this (relative) to the rate of a cell, a pole of the characteristic equation, has too few
# correct digits in the difference of both.
NEAR_POLE = 1e-5


@jit_rows
def find_rates(
    k: FloatArray, moved: FloatArray, r: FloatArray, inverse: FloatArray, rates: FloatArray, near: FloatArray,
    marks: Marks,
) -> None:  # fmt: skip
    """Rates of the cells, into `r`, and of the modes of two or three cells; `inverse` is 1/A.

    On entry `r` holds the leakage rates by area. `near` is 1 where a mode's rate is too near to that of a cell, and for
    more cells, whose modes need an iteration.
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
        if m_all <= 2:
            for m in range(m_all):
                for j in range(cells):
                    rate = r[j * lanes + i]
                    apart = abs(rate - rates[m, i]) > NEAR_POLE * max(rate, rates[m, i])
                    unclear = unclear if apart else 1.0
        near[i] = unclear


@jit_rows
def _shapes(
    k: FloatArray, r: FloatArray, rates: FloatArray, gain: FloatArray, feed: FloatArray, shape: FloatArray,
    marks: Marks,
) -> None:  # fmt: skip
    """Modes of all lanes with such rates; `feed` and `shape` have a row for every mode of every cell."""
    m_all, lanes = len(marks[0]), len(marks[5])
    for i in range(lanes):
        for m in range(m_all):
            norm = 0.0
            for j in range(m_all + 1):
                inverse = 1.0 / (r[j * lanes + i] - rates[m, i])
                norm += k[j * lanes + i] * inverse * inverse
                shape[(j * m_all + m) * lanes + i] = k[j * lanes + i] * inverse
                feed[(j * m_all + m) * lanes + i] = inverse
            gain[m * lanes + i] = -1.0 / norm
            for j in range(m_all + 1):
                feed[(j * m_all + m) * lanes + i] *= -1.0 / norm


class Scratch(NamedTuple):
    """Arrays for the cells and modes of a block (`find_rates` and the like); and for `write_modes` those of one lane.

    The latter are rates and shares of the cells, rates and gains of the modes, their feeds and shapes, and its scratch.
    """

    k: FloatArray
    moved: FloatArray
    r: FloatArray
    near: FloatArray
    gain: FloatArray
    feed: FloatArray
    shape: FloatArray
    values: FloatArray
    own: FloatArray
    found: FloatArray
    forms: NDArray[np.float64]
    floats: FloatArray
    whole: NDArray[np.int64]


def scratch_shapes(marks: Marks) -> tuple[tuple[int, ...], ...]:
    """Shapes of the arrays of a `Scratch`."""
    m, lanes = len(marks[0]), len(marks[5])
    row, both = ((m + 1) * lanes,), ((m + 1) * m * lanes,)
    block = (row, row, row, (lanes,), (m * lanes,), both, both, (len(marks[3]) * lanes,))
    return *block, (2, m + 1), (2, m), (2, m + 1, m), (2, m + 1), (2, m + 1)


@jit
def find_modes(rates: FloatArray, scratch: Scratch, marks: Marks) -> None:
    """Modes of all lanes: in closed form, and by iteration where this would lose digits or there is none."""
    k, _, r, near, gain, feed, shape, _, own, found, forms, floats, whole = scratch
    m_all, lanes = len(marks[0]), len(marks[5])
    if m_all <= 2:
        _shapes(k, r, rates, gain, feed, shape, marks)
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


@jit_rows
def link(
    gap: int, leaks: NDArray[np.int64], moved: FloatArray, feed: FloatArray, shape: FloatArray, c: FloatArray,
    marks: Marks,
) -> None:  # fmt: skip
    """Constants by which the modes have to do with gap and leaks."""
    m_all, w_all, l_all, lanes = len(marks[0]), len(marks[1]), len(marks[2]), len(marks[5])
    of_z = SHAPE + m_all + w_all + l_all * w_all
    of_leak = of_z + l_all * m_all
    for i in range(lanes):
        for m in range(m_all):
            c[(SHAPE + m) * lanes + i] = shape[(gap * m_all + m) * lanes + i]
            for n in range(l_all):
                c[(of_z + n * m_all + m) * lanes + i] = shape[(leaks[n] * m_all + m) * lanes + i]
                c[(of_leak + m * l_all + n) * lanes + i] = (
                    feed[(leaks[n] * m_all + m) * lanes + i] * moved[leaks[n] * lanes + i]
                )
