"""Weights of steps that all have their own lengths, for `engine.uneven`.

They follow from the moments of a decaying exponential (`numerics.moments`), whose series the rows of a block evaluate
together.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from fingerspice.base.arrays import FloatArray
from fingerspice.base.compiled import jit_rows, jit_within
from fingerspice.engine.blockforms import BLOCK, FIRST_QUARTER, LAST_QUARTER, MIDDLE, PLACES, Form
from fingerspice.engine.blockrows import largest_of

# Place that is the end of a step, beside `PLACES`.
END = 3
EVERY_PLACE = np.array([*PLACES, 1.0])
# Beyond this, moments follow from the lowest; before, from the highest, by a series (see `numerics.moments`).
_LATE = 4.0
# Coefficients 1/(k! (k + count)) of that series for three and for five moments.
_FACTORIALS = np.cumprod(np.maximum(np.arange(36.0), 1.0))
_THREE, _FIVE = (1.0 / (_FACTORIALS * (np.arange(36.0) + count)) for count in (3.0, 5.0))
# Polynomials that are 1 at one quarter of a step, and 0 at the other, at both ends and in the middle; from the power 1.
_QUARTERS = np.array([
    np.poly(np.setdiff1d([0.0, 0.25, 0.5, 0.75, 1.0], at))[::-1][1:]
    / np.polyval(np.poly(np.setdiff1d([0.0, 0.25, 0.5, 0.75, 1.0], at)), at)
    for at in (0.25, 0.75)
])  # fmt: skip


class Steps(NamedTuple):
    """Weights of the steps of a block for m modes, at the places `PLACES` and at the end of a step."""

    decay: FloatArray  # (m, 4, n): Over the part of a step up to the place
    parabola: FloatArray  # (m, 4, 3, n): Contribution of a forcing at 0, 1/2 and 1, s
    quarter: FloatArray  # (m, 2, n): Contribution of the errors at the quarters to the end, s
    # forced, forced_within (m, n): Forcing of the modes at the ends and in the middle of the steps
    forced: FloatArray
    forced_within: FloatArray
    w: FloatArray  # (m, n): Modes at a place
    moments: FloatArray  # (5, n)
    low: FloatArray  # (n,): Scratch


def new_steps(modes: int) -> Steps:
    """Room for the weights of so many modes."""
    n = BLOCK + 8
    return Steps(
        np.zeros((modes, 4, n)), np.zeros((modes, 4, 3, n)), np.zeros((modes, 2, n)),
        np.zeros((modes, n)), np.zeros((modes, n)), np.zeros((modes, n)), np.zeros((5, n)), np.zeros(n),
    )  # fmt: skip


@jit_rows
def _decays(n: int, rate: float, h: FloatArray, decay: FloatArray) -> None:
    for i in range(n):
        decay[FIRST_QUARTER, i] = math.exp(-0.25 * rate * h[i])
    for i in range(n):
        e = decay[FIRST_QUARTER, i]
        decay[MIDDLE, i] = e * e
        decay[LAST_QUARTER, i] = e * e * e
        decay[END, i] = e * e * e * e


@jit_rows
def _series(n: int, terms: int, c: FloatArray, rate: float, h: FloatArray, out: FloatArray) -> None:
    """Polynomial with the first 4 `terms` + 1 coefficients c at min(rate h, `_LATE`)."""
    d = 4 * terms
    for i in range(n):
        out[i] = c[d]
    for j in range(d, 0, -4):
        c3, c2, c1, c0 = c[j - 1], c[j - 2], c[j - 3], c[j - 4]
        for i in range(n):
            y = min(rate * h[i], 4.0)
            out[i] = (((out[i] * y + c3) * y + c2) * y + c1) * y + c0


@jit_rows
def _early(n: int, rate: float, h: FloatArray, e: FloatArray, m: FloatArray) -> None:
    """Moments below the highest, which the last row of m holds without its factor exp(-rate h)."""
    top = m.shape[0] - 1
    for i in range(n):
        m[top, i] *= e[i]
    for j in range(top, 0, -1):
        over = 1.0 / j
        for i in range(n):
            m[j - 1, i] = over * (1.0 - rate * h[i] * m[j, i])


@jit_rows
def _late(n: int, rate: float, h: FloatArray, e: FloatArray, m: FloatArray) -> None:
    """Replace the moments of the steps beyond `_LATE` time constants by those that follow from the lowest."""
    for i in range(n):
        y = max(rate * h[i], _LATE)
        late, over = rate * h[i] >= _LATE, 1.0 / y
        value = (1.0 - e[i]) * over
        m[0, i] = value if late else m[0, i]
        for j in range(1, m.shape[0]):
            value = (1.0 - j * value) * over
            m[j, i] = value if late else m[j, i]


@jit_rows
def _parabolas(n: int, at: float, h: FloatArray, m: FloatArray, out: FloatArray) -> None:
    """Weights of a parabola at 0, 1/2 and 1 up to the place `at`."""
    for i in range(n):
        a = h[i] * at * m[0, i]
        b = h[i] * at * at * m[1, i]
        c = h[i] * at * at * at * m[2, i]
        out[0, i] = a - 3.0 * b + 2.0 * c
        out[1, i] = 4.0 * (b - c)
        out[2, i] = 2.0 * c - b


@jit_rows
def _quartics(n: int, h: FloatArray, m: FloatArray, c: FloatArray, out: FloatArray) -> None:
    """Weights of a quartic with the coefficients c, from that of the power 1 on."""
    for i in range(n):
        out[i] = h[i] * (c[0] * m[1, i] + c[1] * m[2, i] + c[2] * m[3, i] + c[3] * m[4, i])


@jit_within
def weigh(form: Form, steps: Steps, h: FloatArray, r: int, n: int) -> None:
    """Compute the weights of n steps for every mode."""
    longest = largest_of(n, h)
    for k in range(form.rates.shape[1]):
        rate, decay = form.rates[r, k], steps.decay[k]
        _decays(n, rate, h, decay)
        y = min(rate * longest, _LATE)
        # Terms until the next is rounding.
        terms, term = 1, 1.0
        while terms < 8 and term > 1e-17:
            for j in range(4 * terms - 3, 4 * terms + 1):
                term *= y / j
            terms += 1
        for place in range(EVERY_PLACE.size):
            at, last = EVERY_PLACE[place], place == END
            m = steps.moments if last else steps.moments[:3]
            _series(n, terms, _FIVE if last else _THREE, rate * at, h, m[m.shape[0] - 1])
            _early(n, rate * at, h, decay[place], m)
            if rate * at * longest >= _LATE:
                _late(n, rate * at, h, decay[place], m)
            _parabolas(n, at, h, m, steps.parabola[k, place])
            for quarter in range(2 if last else 0):
                _quartics(n, h, m, _QUARTERS[quarter], steps.quarter[k, quarter])
