"""Many series stacks at once, in lockstep: the loop of steps of `fs.batch`.

In the modes of a stack with its area held, the change of the area contributes a few per cent of the modes' rates. An
exponential Adams method (Hochbruck and Ostermann 2010, section 2.5) solves the linear part exactly:
z' = -rate z + drive x + dq n(x, y, z), with dq = 1/A - 1/A0 a polynomial in |u_gap| and n linear. Each step predicts
with order 2, evaluates the nonlinear term once, and corrects with order 3.

A block holds `LANES` scenes, one in each lane, and every quantity is a row with one entry for each lane. The only loop
over the lanes is in a function of its own, whose inner loops have constant lengths: `modes` and `powers` are tuples of
which only the length counts. So it is compiled into vector instructions without a branch, and no lane's result depends
on the others.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fingerspice.base.arrays import FloatArray
from fingerspice.base.compiled import jit, jit_rows

LANES = 16
"""Scenes of a block."""

Marks = tuple[int, ...]
"""A tuple of which only the length counts."""

Weights = tuple[FloatArray, NDArray[np.float64], NDArray[np.float64]]
"""Weights of a step of length 0; and for every piece of a window, those of its first step and of all other steps."""

# Rows of the constants: a and b in u = a x + b y + shape z, and the scale of |u| to [-1, 1]; then those of every mode.
WAVE_X, WAVE_Y, SCALE, SHAPE = 0, 1, 2, 3
# Rows of the weights, each for every mode: decay, drive; predictor's weights of the nonlinear term at this step and the
# one before; corrector's weights at the next step, this one and the one before.
DECAY, DRIVE, PREDICT, PREDICT_OLD, CORRECT, CORRECT_NOW, CORRECT_OLD, N_WEIGHTS = 0, 1, 2, 3, 4, 5, 6, 7
# Rows of the state for every mode: z, the nonlinear term now and a step before, and two scratch rows of the step.
Z, RATE, OLD, KEPT, GUESS, N_STATE = 0, 1, 2, 3, 4, 5
# Rows of the state after those: gap voltage, its peak, then the integrands' latest values and their weighted sums.
GAP, PEAK, VALUE = 0, 1, 2
ALL_MOMENTS = 3
"""Number of the integrands u^2 A, (u^2 A)^2 and u^2. (A itself has a kink where u is 0: its sum is of order 2 only.)"""


@jit
def n_constants(m: int, d: int) -> int:
    """Rows of the constants of m modes and a polynomial of degree d."""
    return SHAPE + 3 * m + m * m + d + 1


@jit
def n_state(m: int, moments: int) -> int:
    """Rows of the state."""
    return N_STATE * m + VALUE + 2 * moments


@jit_rows
def _step(
    c: FloatArray, g: FloatArray, s: FloatArray, wave_at: tuple[float, float, float], weight: float, modes: Marks,
    powers: Marks, moments: Marks,
) -> None:  # fmt: skip
    """One step of every lane; adds `weight` times the integrands at its end to their sums.

    `wave_at` holds x and y of the source at the end of the step, and x at its start.
    """
    x, y, before = wave_at
    m_all, d_all, count = len(modes), len(powers) - 1, len(moments)
    of_x, of_y = SHAPE + m_all, SHAPE + 2 * m_all
    of_z = SHAPE + 3 * m_all
    area = of_z + m_all * m_all
    own = N_STATE * m_all
    value, total = own + VALUE, own + VALUE + count
    for i in range(LANES):
        wave = c[WAVE_X * LANES + i] * x + c[WAVE_Y * LANES + i] * y
        u = wave
        for m in range(m_all):
            kept = g[(DECAY * m_all + m) * LANES + i] * s[(Z * m_all + m) * LANES + i]
            kept += g[(DRIVE * m_all + m) * LANES + i] * before
            guess = kept + g[(PREDICT * m_all + m) * LANES + i] * s[(RATE * m_all + m) * LANES + i]
            guess += g[(PREDICT_OLD * m_all + m) * LANES + i] * s[(OLD * m_all + m) * LANES + i]
            s[(KEPT * m_all + m) * LANES + i] = kept
            s[(GUESS * m_all + m) * LANES + i] = guess
            u += c[(SHAPE + m) * LANES + i] * guess
        v = abs(u) * c[SCALE * LANES + i] - 1.0
        q = c[area * LANES + i]
        for d in range(1, d_all):
            q = q * v + c[(area + d) * LANES + i]
        q *= v
        u = wave
        for m in range(m_all):
            rate = c[(of_x + m) * LANES + i] * x + c[(of_y + m) * LANES + i] * y
            for j in range(m_all):
                rate += c[(of_z + m * m_all + j) * LANES + i] * s[(GUESS * m_all + j) * LANES + i]
            rate *= q
            now = s[(RATE * m_all + m) * LANES + i]
            z = s[(KEPT * m_all + m) * LANES + i] + g[(CORRECT * m_all + m) * LANES + i] * rate
            z += g[(CORRECT_NOW * m_all + m) * LANES + i] * now
            z += g[(CORRECT_OLD * m_all + m) * LANES + i] * s[(OLD * m_all + m) * LANES + i]
            s[(Z * m_all + m) * LANES + i] = z
            s[(OLD * m_all + m) * LANES + i] = now
            s[(RATE * m_all + m) * LANES + i] = rate
            u += c[(SHAPE + m) * LANES + i] * z
        s[(own + GAP) * LANES + i] = u
        s[(own + PEAK) * LANES + i] = max(s[(own + PEAK) * LANES + i], abs(u))
        a = 1.0 / (q + c[(area + d_all) * LANES + i])
        force = u * u * a
        s[value * LANES + i] = force
        s[total * LANES + i] += weight * force
        if count > 1:
            s[(value + 1) * LANES + i] = force * force
            s[(total + 1) * LANES + i] += weight * (force * force)
            s[(value + 2) * LANES + i] = u * u
            s[(total + 2) * LANES + i] += weight * (u * u)


@jit_rows
def _add_latest(first: int, count: int, weight: float, s: FloatArray) -> None:
    """Add `weight` times the latest values to the sums."""
    for i in range(count * LANES):
        s[(first + count) * LANES + i] += weight * s[first * LANES + i]


@jit
def quadrature(k: int, steps: int) -> float:
    """Weight of value k of `steps` + 1 equidistant values in Gregory's quadrature of order 4, in step lengths.

    Simpson's rule, of the same order, serves 2 or 4 steps, where the two ends of Gregory's would overlap.
    """
    end = min(k, steps - k)
    if steps < 5:
        return (1.0 if end == 0 else 4.0 if k % 2 == 1 else 2.0) / 3.0
    return 0.375 if end == 0 else 7.0 / 6.0 if end == 1 else 23.0 / 24.0 if end == 2 else 1.0


@jit
def _start(
    c: FloatArray, still: FloatArray, s: FloatArray, x: float, y: float, modes: Marks, powers: Marks, moments: Marks
) -> None:  # fmt: skip
    """Evaluate the integrands and the nonlinear term without a step: at t = 0, and after a jump of the source."""
    _step(c, still, s, (x, y, 0.0), 0.0, modes, powers, moments)


@jit
def _window(
    c: FloatArray, g: tuple[FloatArray, FloatArray], s: FloatArray, wave: FloatArray, sign: float, steps: int,
    unit: float, trace: FloatArray, at: int, modes: Marks, powers: Marks, moments: Marks,
) -> None:  # fmt: skip
    """Take `steps` steps of one length, a range of Gregory's rule; gap voltages go to trace (LANES, n) from `at` on.

    `g` holds the weights of the first step and of all others, `unit` is the length of a step in those of the sums.
    """
    count, own = len(moments), N_STATE * len(modes)
    period, stride = wave.shape[1], trace.shape[0] // LANES
    _add_latest(own + VALUE, count, unit * quadrature(0, steps), s)
    place, before, weights = 0, sign * wave[0, 0], g[0]
    for k in range(steps):
        if trace.size > 0:
            for i in range(LANES):
                trace[i * stride + at + k] = s[(own + GAP) * LANES + i]
        place = place + 1 if place + 1 < period else 0
        x, y = sign * wave[0, place], sign * wave[1, place]
        _step(c, weights, s, (x, y, before), unit * quadrature(k + 1, steps), modes, powers, moments)
        before, weights = x, g[1]


@jit
def run(
    c: FloatArray, g: Weights, s: FloatArray, wave: FloatArray, halves: int, turned: bool, last: FloatArray,
    trace: FloatArray, modes: Marks, powers: Marks, moments: Marks,
) -> None:  # fmt: skip
    """Integrate a block's scenes over `halves` half periods, from the modes in the state `s` on.

    Parameters
    ----------
    c, g, s : ndarray
        Constants, weights and state, each flat.
    wave : ndarray, shape (2, n)
        x and y of the source at the n steps of a period. Where the source is `turned`, it jumps to its negative after
        each half period and the method restarts: then n steps are half a period, in pieces as `g` has them: of equally
        many steps, which are twice as long in every piece as in the one before.
    last : ndarray
        Takes the sums over the last period, as the state holds those over the whole run; NaN in a shorter run.
    trace : ndarray, shape (LANES * steps,) or (0,)
        The gap voltage before each step, V.
    """
    count, own = len(moments), N_STATE * len(modes)
    sums = (own + VALUE + count) * LANES
    for i in range(count * LANES):
        s[sums + i] = 0.0
        last[i] = math.nan
    for i in range(LANES):
        s[(own + PEAK) * LANES + i] = 0.0
    half = wave.shape[1] if turned else wave.shape[1] // 2
    pieces = g[1].shape[0]
    done = 0
    while done < halves:
        if done == halves - 2:
            last[:] = s[sums : sums + last.size]
        # A source without jumps is integrated in one piece up to the last period.
        ahead = 1 if turned or halves < 2 else (halves - 2 if done < halves - 2 else 2)
        # The value of a sine, as of a turned source, is the negative of its value half a period earlier.
        sign = -1.0 if done % 2 == 1 else 1.0
        restart = turned or done == 0
        if restart:
            _start(c, g[0], s, sign * wave[0, 0], sign * wave[1, 0], modes, powers, moments)
        steps, unit = ahead * half // pieces, pieces / (2.0**pieces - 1.0)
        for piece in range(pieces):
            weights = (g[1][piece] if restart else g[2][piece], g[2][piece])
            at = done * half + piece * steps
            _window(c, weights, s, wave, sign, steps, unit, trace, at, modes, powers, moments)
            unit *= 2.0
        done += ahead
    for i in range(last.size):
        last[i] = s[sums + i] - last[i]
