"""Weights of the steps of `step`: integrals of a mode's decay with the polynomials of an Adams method."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fingerspice.base.arrays import FloatArray
from fingerspice.base.compiled import jit, jit_rows
from fingerspice.engine.lockstep.step import DECAY, DRIVE, PREDICT, Marks, Weights


@jit
def moment_integrals(y: float) -> tuple[float, float, float, float]:
    """Integrals of exp(-y (1 - s)) s^k over [0, 1] for k = 0, 1, 2, 3, y >= 0."""
    if y < 0.3:
        # k = 3: the sum of (-y)^j 3! / (j + 4)! from its last term on; then a recursion down to k = 0, which damps
        # rounding.
        total = 0.0
        for j in range(11, -1, -1):
            total = 1.0 - y * total * (1.0 / (j + 5.0))
        third = total / 4.0
        second = (1.0 - y * third) / 3.0
        first = 0.5 * (1.0 - y * second)
        return 1.0 - y * first, first, second, third
    zeroth = -math.expm1(-y) / y
    first = (1.0 - zeroth) / y
    second = (1.0 - 2.0 * first) / y
    return zeroth, first, second, (1.0 - 3.0 * second) / y


def _basis(nodes: tuple[float, ...], rows: int) -> NDArray[np.float64]:
    """Powers, lowest first, of the Lagrange polynomials of some nodes; rows beyond them are 0."""
    out = np.zeros((rows, 4))
    for i, node in enumerate(nodes):
        others = [x for x in nodes if x != node]
        powers = np.poly(others) / np.prod([node - x for x in others]) if others else np.ones(1)
        out[i, : powers.size] = powers[::-1]
    return out


# Steps by the values that they have: none before the start of the step (the first of all), one (the second), two at
# equal distances, and the first and second step after the step has been doubled. The distances are in steps.
_BEFORE = ((), (-1.0,), (-1.0, -2.0), (-0.5, -1.0), (-1.0, -1.5))
#: For each kind of step, the polynomials of predictor (3) and corrector (4) by powers, shape (5, 7, 4).
_POLYNOMIALS = np.stack([
    np.concatenate([_basis((0.0, *before), 3), _basis((1.0, 0.0, *before), 4)]) for before in _BEFORE
])  # fmt: skip
# Number of doublings that give the moments of a step, and the largest product of rate and step that they serve.
_DOUBLED = 6
_MOST = 0.3 * 2.0**_DOUBLED
#: Kinds of the first, second and further steps: of the first piece, and of the others.
_KINDS = np.array([[0, 1, 2], [3, 4, 2]])


@jit_rows
def _shortest(rates: FloatArray, h: FloatArray, moments: FloatArray, marks: Marks) -> None:
    """Moments of every lane, shape (5, lanes), over a 64th of a step, whose sum needs no exponential function."""
    for i in range(len(marks[5])):
        y = rates[i] * h[i] * (1.0 / 2.0**_DOUBLED)
        total = 0.0
        for j in range(11, -1, -1):
            total = 1.0 - y * total * (1.0 / (j + 5.0))
        m3 = total / 4.0
        m2 = (1.0 - y * m3) * (1.0 / 3.0)
        m1 = 0.5 * (1.0 - y * m2)
        m0 = 1.0 - y * m1
        moments[0, i], moments[1, i], moments[2, i], moments[3, i], moments[4, i] = 1.0 - y * m0, m0, m1, m2, m3


@jit_rows
def _double(moments: FloatArray, longer: FloatArray, marks: Marks) -> None:
    """Moments over twice the length of a step, shape (5, lanes): exp(-y), then those of `moment_integrals`."""
    for i in range(len(marks[5])):
        e, m0, m1, m2, m3 = moments[0, i], moments[1, i], moments[2, i], moments[3, i], moments[4, i]
        longer[0, i] = e * e
        longer[1, i] = 0.5 * (e * m0 + m0)
        longer[2, i] = 0.25 * (e * m1 + m0 + m1)
        longer[3, i] = 0.125 * (e * m2 + m0 + 2.0 * m1 + m2)
        longer[4, i] = 0.0625 * (e * m3 + m0 + 3.0 * (m1 + m2) + m3)


@jit_rows
def _weigh_rows(
    powers: FloatArray, h: FloatArray, drive: FloatArray, moments: FloatArray, g: FloatArray, mode: int, marks: Marks
) -> None:  # fmt: skip
    """Weights of a step of length h (lanes,) for one mode, from its moments and the polynomials of its kind, (7, 4)."""
    n_modes, lanes = len(marks[0]), len(marks[5])
    for i in range(lanes):
        g[(DECAY * n_modes + mode) * lanes + i] = moments[0, i]
        g[(DRIVE * n_modes + mode) * lanes + i] = drive[i] * h[i] * moments[1, i]
    for row in range(7):
        p0, p1, p2, p3 = powers[row, 0], powers[row, 1], powers[row, 2], powers[row, 3]
        at = ((PREDICT + row) * n_modes + mode) * lanes
        for i in range(lanes):
            total = p0 * moments[1, i] + p1 * moments[2, i] + p2 * moments[3, i] + p3 * moments[4, i]
            g[at + i] = h[i] * total


@jit
def weigh(
    shortest: FloatArray, rates: FloatArray, drive: FloatArray, g: Weights, scratch: FloatArray, marks: Marks
) -> None:  # fmt: skip
    """Weights of every lane for a step of length 0 and for the pieces, the first of steps of length `shortest` (s).

    `rates` and `drive` have shape (n_mode, lanes); `scratch` (11, lanes) is overwritten.
    """
    m_all, lanes = len(marks[0]), len(marks[5])
    still, moving = g
    still[:] = 0.0
    still[DECAY * m_all * lanes : (DECAY + 1) * m_all * lanes] = 1.0
    h = scratch[10]
    for m in range(m_all):
        now, longer = scratch[:5], scratch[5:10]
        for i in range(lanes):
            h[i] = shortest[i]
        _shortest(rates[m], shortest, now, marks)
        for _ in range(_DOUBLED):
            _double(now, longer, marks)
            now, longer = longer, now
        for i in range(lanes):
            y = rates[m, i] * h[i]
            if y > _MOST:
                now[1, i], now[2, i], now[3, i], now[4, i] = moment_integrals(y)
                now[0, i] = 1.0 - y * now[1, i]
        for piece in range(moving.shape[0]):
            for step in range(3):
                _weigh_rows(_POLYNOMIALS[_KINDS[min(piece, 1), step]], h, drive[m], now, moving[piece, step], m, marks)
            _double(now, longer, marks)
            now, longer = longer, now
            for i in range(lanes):
                h[i] *= 2.0
