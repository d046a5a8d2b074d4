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
from fingerspice.engine.recording import largest_of

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
    """Weights of the steps of a block for m modes, at the places `PLACES` and at the end of a step.

    Attributes
    ----------
    decay : ndarray, shape (m, 4, n)
        Over the part of a step up to the place.
    parabola : ndarray, shape (m, 4, 3, n)
        Contribution of a forcing at 0, 1/2 and 1, s.
    quarter : ndarray, shape (m, 2, 2, n)
        Contribution of the errors at the quarters to the middle and to the end, s.
    forced, forced_within : ndarray, shape (m, n)
        Forcing of the modes at the ends and in the middle of the steps.
    w : ndarray, shape (m, n)
        Modes at a place.
    top, low : ndarray, shape (n,)
        Scratch.
    """

    decay: FloatArray
    parabola: FloatArray
    quarter: FloatArray
    forced: FloatArray
    forced_within: FloatArray
    w: FloatArray
    top: FloatArray
    low: FloatArray


def new_steps(modes: int) -> Steps:
    """Room for the weights of so many modes."""
    n = BLOCK + 8
    return Steps(
        np.zeros((modes, 4, n)), np.zeros((modes, 4, 3, n)), np.zeros((modes, 2, 2, n)),
        np.zeros((modes, n)), np.zeros((modes, n)), np.zeros((modes, n)), np.zeros(n), np.zeros(n),
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
def _three(n: int, rate: float, at: float, h: FloatArray, e: FloatArray, top: FloatArray, out: FloatArray) -> None:
    """Weights of a parabola at 0, 1/2 and 1 up to the place `at`."""
    for i in range(n):
        y = rate * h[i] * at
        early = y < 4.0
        safe = max(y, 1e-300)
        m2 = e[i] * top[i]
        m1 = 0.5 * (1.0 - y * m2)
        m0 = 1.0 - y * m1
        l0 = (1.0 - e[i]) / safe
        l1 = (1.0 - l0) / safe
        l2 = (1.0 - 2.0 * l1) / safe
        a = h[i] * at * (m0 if early else l0)
        b = h[i] * at * at * (m1 if early else l1)
        c = h[i] * at * at * at * (m2 if early else l2)
        out[0, i] = a - 3.0 * b + 2.0 * c
        out[1, i] = 4.0 * (b - c)
        out[2, i] = 2.0 * c - b


@jit_rows
def _five(
    n: int, rate: float, at: float, h: FloatArray, e: FloatArray, top: FloatArray, first: FloatArray, last: FloatArray,
    parabola: FloatArray, quarter: FloatArray,
) -> None:  # fmt: skip
    """Weights up to the place `at`: of a parabola, and of a quartic that is 1 at one quarter and 0 at other nodes."""
    a1, a2, a3, a4, b1, b2, b3, b4 = (
        first[0], first[1], first[2], first[3], last[0], last[1], last[2], last[3],
    )  # fmt: skip
    for i in range(n):
        y = rate * h[i] * at
        early = y < 4.0
        safe = max(y, 1e-300)
        m4 = e[i] * top[i]
        m3 = 0.25 * (1.0 - y * m4)
        m2 = (1.0 - y * m3) / 3.0
        m1 = 0.5 * (1.0 - y * m2)
        m0 = 1.0 - y * m1
        l0 = (1.0 - e[i]) / safe
        l1 = (1.0 - l0) / safe
        l2 = (1.0 - 2.0 * l1) / safe
        l3 = (1.0 - 3.0 * l2) / safe
        l4 = (1.0 - 4.0 * l3) / safe
        own = h[i] * at
        w0 = own * (m0 if early else l0)
        own *= at
        w1 = own * (m1 if early else l1)
        own *= at
        w2 = own * (m2 if early else l2)
        own *= at
        w3 = own * (m3 if early else l3)
        own *= at
        w4 = own * (m4 if early else l4)
        parabola[0, i] = w0 - 3.0 * w1 + 2.0 * w2
        parabola[1, i] = 4.0 * (w1 - w2)
        parabola[2, i] = 2.0 * w2 - w1
        quarter[0, i] = a1 * w1 + a2 * w2 + a3 * w3 + a4 * w4
        quarter[1, i] = b1 * w1 + b2 * w2 + b3 * w3 + b4 * w4


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
        for place in (FIRST_QUARTER, LAST_QUARTER):
            at = EVERY_PLACE[place]
            _series(n, terms, _THREE, rate * at, h, steps.top)
            _three(n, rate, at, h, decay[place], steps.top, steps.parabola[k, place])
        for i in range(2):
            place = END if i == 1 else MIDDLE
            at = EVERY_PLACE[place]
            _series(n, terms, _FIVE, rate * at, h, steps.top)
            _five(
                n, rate, at, h, decay[place], steps.top, _QUARTERS[0], _QUARTERS[1], steps.parabola[k, place],
                steps.quarter[k, i],
            )  # fmt: skip
