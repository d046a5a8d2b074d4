"""Many series stacks at once, in lockstep: the steps of `fs.batch`, and their weights.

In the modes of a stack with its area held, the change of the area contributes a few per cent of the modes' rates. An
exponential Adams method (Hochbruck and Ostermann 2010, section 2.5) solves the linear part exactly:
z' = -rate z + drive w + n(w, z), with n linear in dq = 1/A - 1/A0 times the voltages of the leaks, which are the cells
whose leak has a total resistance, and dq a polynomial in |u_gap|. The waves w are sine and cosine of every tone of the
source, without a drive, as z is then what is left beside the steady response; or the value of a source of constant
pieces. Each step predicts with order 3, evaluates the nonlinear term once, and corrects with order 4.

A block holds `LANES` scenes, one in each lane, and every quantity is a row with one entry for each lane. The only loop
over the lanes is in a function of its own, whose loops have constant lengths: those of tuples without content. So it is
compiled into vector instructions without a branch, and no lane's result depends on the others. On a graphics card a
block is one scene, in a thread of its own (`engine.lockstep.card`).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fingerspice.base.arrays import FloatArray
from fingerspice.base.compiled import borrow, jit, jit_rows, jit_within_rows


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
def double(moments: FloatArray, longer: FloatArray, marks: Marks) -> None:
    """Moments over twice the length of a step, shape (5, lanes): exp(-y), then those of `moment_integrals`."""
    for i in range(len(marks[5])):
        e, m0, m1, m2, m3 = moments[0, i], moments[1, i], moments[2, i], moments[3, i], moments[4, i]
        longer[0, i] = e * e
        longer[1, i] = 0.5 * (e * m0 + m0)
        longer[2, i] = 0.25 * (e * m1 + m0 + m1)
        longer[3, i] = 0.125 * (e * m2 + m0 + 2.0 * m1 + m2)
        longer[4, i] = 0.0625 * (e * m3 + m0 + 3.0 * (m1 + m2) + m3)


@jit
def moments_over(rates: FloatArray, h: FloatArray, moments: FloatArray, other: FloatArray, marks: Marks) -> None:
    """Moments of a mode of every lane over steps of length h (lanes,), s, as of `double`; `other` is overwritten."""
    _shortest(rates, h, moments, marks)
    for _ in range(_DOUBLED // 2):
        double(moments, other, marks)
        double(other, moments, marks)
    for i in range(len(marks[5])):
        y = rates[i] * h[i]
        if y > _MOST:
            moments[1, i], moments[2, i], moments[3, i], moments[4, i] = moment_integrals(y)
            moments[0, i] = 1.0 - y * moments[1, i]


@jit_rows
def weigh_rows(
    powers: FloatArray, by: FloatArray, moments: FloatArray, g: FloatArray, first: int, mode: int, marks: Marks
) -> None:  # fmt: skip
    """Weights of one mode from row `first` on: integrals of polynomials, given by powers (n, 4), times `by`."""
    n_modes, lanes = len(marks[0]), len(marks[5])
    for row in range(powers.shape[0]):
        p0, p1, p2, p3 = powers[row, 0], powers[row, 1], powers[row, 2], powers[row, 3]
        at = ((first + row) * n_modes + mode) * lanes
        for i in range(lanes):
            total = p0 * moments[1, i] + p1 * moments[2, i] + p2 * moments[3, i] + p3 * moments[4, i]
            g[at + i] = by[i] * total


@jit_rows
def _weigh_linear(
    drive: FloatArray, h: FloatArray, moments: FloatArray, g: FloatArray, mode: int, marks: Marks
) -> None:
    """Weights of one mode itself, and of a constant source."""
    n_modes, lanes = len(marks[0]), len(marks[5])
    for i in range(lanes):
        g[(DECAY * n_modes + mode) * lanes + i] = moments[0, i]
        g[(DRIVE * n_modes + mode) * lanes + i] = drive[i] * h[i] * moments[1, i]


@jit
def weigh(
    shortest: FloatArray, rates: FloatArray, drive: FloatArray, g: Weights, scratch: FloatArray, marks: Marks
) -> None:  # fmt: skip
    """Weights of every lane for a step of length 0 and for the pieces, the first of steps of length `shortest` (s).

    `rates` and `drive` have every mode's (n_mode * lanes,); `scratch` (11, lanes) is overwritten.
    """
    m_all, lanes = len(marks[0]), len(marks[5])
    still, moving = g
    still[:] = 0.0
    still[DECAY * m_all * lanes : (DECAY + 1) * m_all * lanes] = 1.0
    h = scratch[10]
    for m in range(m_all):
        now, longer = scratch[:5], scratch[5:10]
        moments_over(rates[m * lanes : (m + 1) * lanes], shortest, now, longer, marks)
        for i in range(lanes):
            h[i] = shortest[i]
        for piece in range(moving.shape[0]):
            for step in range(3):
                _weigh_linear(drive[m * lanes : (m + 1) * lanes], h, now, moving[piece, step], m, marks)
                powers = _POLYNOMIALS[_KINDS[min(piece, 1), step]]
                weigh_rows(powers, h, now, moving[piece, step], PREDICT, m, marks)
            double(now, longer, marks)
            now, longer = longer, now
            for i in range(lanes):
                h[i] *= 2.0


LANES = 32
"""Scenes of a block on the processor."""
START_TIMES = (0.0, 0.125, 0.25, 0.375, 0.5, 0.75, 1.0, 1.5, 2.0)
"""Times of the shorter steps at the start of a run without jumps, in steps."""
START = len(START_TIMES) - 1

Mark = tuple[tuple[()], ...]
"""A tuple of which only the length counts, which compiled code knows as a constant; it is passed without any cost."""
Marks = tuple[Mark, Mark, Mark, Mark, Mark, Mark]
"""Marks for the modes, waves, leaks, powers of the polynomial, moments and lanes."""

Weights = tuple[FloatArray, NDArray[np.float64]]
"""Weights of a step of length 0; and for every piece of a window those of its first and second step and of all others,
shape (pieces, 3, n)."""

# Rows of the constants: the scale of |u| to [-1, 1]; u by modes, and by waves; the voltages of the leaks by waves, and
# by modes, leak after leak; n by leaks, mode after mode; and the polynomial of 1/A.
SCALE, SHAPE = 0, 1
# Rows of the weights, each for every mode: decay, drive; predictor's weights of the nonlinear term at this step and the
# two before; corrector's weights at the next step, this one and the two before.
DECAY, DRIVE, PREDICT, CORRECT, CORRECT_NOW, N_WEIGHTS = 0, 1, 2, 5, 6, 9
# Rows of the state for every mode: z, the nonlinear term now, one and two steps before, and two scratch rows of a step.
Z, RATE, OLD, OLDER, KEPT, GUESS, N_STATE = 0, 1, 2, 3, 4, 5, 6
# Rows of the state after those: gap voltage, its peak, then the integrands' latest values and their weighted sums, and
# last dq times the voltage of every leak.
GAP, PEAK, VALUE = 0, 1, 2
ALL_MOMENTS = 3
"""Number of the integrands u^2 A, (u^2 A)^2 and u^2. (A itself has a kink where u is 0: its sum is of order 2 only.)"""


def marks_of(modes: int, waves: int, leaks: int, powers: int, moments: int, lanes: int = LANES) -> Marks:
    """The marks of these lengths."""
    return ((),) * modes, ((),) * waves, ((),) * leaks, ((),) * powers, ((),) * moments, ((),) * lanes


@jit
def area_row(m: int, w: int, k: int) -> int:
    """First row of the area's polynomial, with m modes, w waves and k leaks."""
    return SHAPE + m + w + k * w + 2 * k * m


@jit
def n_state(m: int, k: int, moments: int) -> int:
    """Rows of the state, with m modes and k leaks."""
    return N_STATE * m + VALUE + 2 * moments + k


@jit_within_rows
def rows_of(marks: Marks, own: int) -> tuple[int, int, int, int, int, int, int]:
    """Rows of the constants: u by waves, leaks by waves and by modes, modes by leaks; of the state, behind `own` rows
    for every mode: integrands, their sums, and the leaks' terms."""
    m_all, w_all, l_all, count = len(marks[0]), len(marks[1]), len(marks[2]), len(marks[4])
    of_u = SHAPE + m_all
    of_w = of_u + w_all
    of_z = of_w + l_all * w_all
    value = own * m_all + VALUE
    return of_u, of_w, of_z, of_z + l_all * m_all, value, value + count, value + 2 * count


@jit_within_rows
def plus(
    total: float, a: FloatArray, at: int, b: FloatArray, of: int, how: tuple[int, int], lanes: int, i: int
) -> float:  # fmt: skip
    """The total and the products of some rows of a, from row `at` on, and b; `how`: number and distance of rows."""
    for j in range(how[0]):
        total += a[(at + j * how[1]) * lanes + i] * b[(of + j * how[1]) * lanes + i]
    return total


@jit_within_rows
def area_change(u: float, c: FloatArray, marks: Marks, i: int) -> float:
    """1/A, less its value in the middle of the voltages, which the linear part of the equations has."""
    d_all, lanes = len(marks[3]) - 1, len(marks[5])
    area = area_row(len(marks[0]), len(marks[1]), len(marks[2]))
    v: float = abs(u) * c[SCALE * lanes + i] - 1.0
    q: float = c[area * lanes + i]
    for d in range(1, d_all):
        q = q * v + c[(area + d) * lanes + i]
    return q * v


@jit_rows
def _step(
    c: FloatArray, g: FloatArray, s: FloatArray, source: FloatArray, before: float, weight: float, marks: Marks,
) -> None:  # fmt: skip
    """One step of every lane; adds `weight` times the integrands at its end to their sums.

    `source` holds the waves at the end of the step, and `before` the first of them at its start.
    """
    m_all, w_all, l_all, count, lanes = len(marks[0]), len(marks[1]), len(marks[2]), len(marks[4]), len(marks[5])
    c, g, s = borrow(c), borrow(g), borrow(s)
    own, held = N_STATE * m_all, area_row(m_all, w_all, l_all) + len(marks[3]) - 1
    of_u, of_w, of_z, of_leak, value, total, current = rows_of(marks, N_STATE)
    for i in range(lanes):
        wave = 0.0
        for w in range(w_all):
            wave += c[(of_u + w) * lanes + i] * source[w]
        u = wave
        for m in range(m_all):
            kept = g[(DECAY * m_all + m) * lanes + i] * s[(Z * m_all + m) * lanes + i]
            kept += g[(DRIVE * m_all + m) * lanes + i] * before
            s[(KEPT * m_all + m) * lanes + i] = kept
            # By the nonlinear term at this step and the two before
            guess = plus(kept, g, PREDICT * m_all + m, s, RATE * m_all + m, (3, m_all), lanes, i)
            s[(GUESS * m_all + m) * lanes + i] = guess
            u += c[(SHAPE + m) * lanes + i] * guess
        q = area_change(u, c, marks, i)
        for k in range(l_all):
            change = 0.0
            for w in range(w_all):
                change += c[(of_w + k * w_all + w) * lanes + i] * source[w]
            change = plus(change, c, of_z + k * m_all, s, GUESS * m_all, (m_all, 1), lanes, i)
            s[(current + k) * lanes + i] = q * change
        u = wave
        for m in range(m_all):
            rate = plus(0.0, c, of_leak + m * l_all, s, current, (l_all, 1), lanes, i)
            now, old = s[(RATE * m_all + m) * lanes + i], s[(OLD * m_all + m) * lanes + i]
            z = s[(KEPT * m_all + m) * lanes + i] + g[(CORRECT * m_all + m) * lanes + i] * rate
            z = plus(z, g, CORRECT_NOW * m_all + m, s, RATE * m_all + m, (3, m_all), lanes, i)
            s[(Z * m_all + m) * lanes + i] = z
            s[(OLDER * m_all + m) * lanes + i] = old
            s[(OLD * m_all + m) * lanes + i] = now
            s[(RATE * m_all + m) * lanes + i] = rate
            u += c[(SHAPE + m) * lanes + i] * z
        s[(own + GAP) * lanes + i] = u
        s[(own + PEAK) * lanes + i] = max(s[(own + PEAK) * lanes + i], abs(u))
        force = u * u * (1.0 / (q + c[held * lanes + i]))
        s[value * lanes + i] = force
        s[total * lanes + i] += weight * force
        if count > 1:
            s[(value + 1) * lanes + i] = force * force
            s[(total + 1) * lanes + i] += weight * (force * force)
            s[(value + 2) * lanes + i] = u * u
            s[(total + 2) * lanes + i] += weight * (u * u)


@jit_rows
def _add_latest(first: int, count: int, weight: float, s: FloatArray, marks: Marks) -> None:
    """Add `weight` times the latest values to the sums."""
    lanes = len(marks[5])
    for i in range(count * lanes):
        s[(first + count) * lanes + i] += weight * s[first * lanes + i]


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
def _record(s: FloatArray, gap: int, trace: FloatArray, at: int, marks: Marks) -> None:
    """Write the gap voltages, row `gap` of the state, into column `at` of the trace, shape (lanes, n)."""
    if trace.size > 0:
        lanes = len(marks[5])
        stride = trace.size // lanes
        for i in range(lanes):
            trace[i * stride + at] = s[gap * lanes + i]


@jit
def _window(
    c: FloatArray, g: NDArray[np.float64], s: FloatArray, wave: FloatArray, places: tuple[int, int, int],
    steps: tuple[int, int], unit: float, trace: FloatArray, at: int, marks: Marks,
) -> None:  # fmt: skip
    """Take steps of one length, a range of Gregory's rule.

    `g` (3, n) are weights of the first, second and further steps; `places` the row of the waves at the start, its
    change from step to step, and the row after which the first one follows; `steps` their number, and how many of this
    length precede them; `unit` their length in that of the sums. The `trace` takes the gap voltages before the steps,
    from column `at` on unless that is negative.
    """
    count, own = len(marks[4]), N_STATE * len(marks[0])
    place, stride, period = places
    _add_latest(own + VALUE, count, unit * quadrature(0, steps[0]), s, marks)
    for k in range(steps[0]):
        if at >= 0:
            _record(s, own + GAP, trace, at + k, marks)
        before = wave[place, 0]
        place = place + stride if place + stride != period else 0
        weight = unit * quadrature(k + 1, steps[0])
        _step(c, g[min(k + steps[1], 2)], s, wave[place], before, weight, marks)


@jit
def _ease_in(
    c: FloatArray, g: NDArray[np.float64], s: FloatArray, wave: FloatArray, trace: FloatArray, marks: Marks
) -> None:  # fmt: skip
    """The first two steps of a run, in `START` shorter ones, as the first of all has no step before it."""
    period, gap = wave.shape[0] - START - 1, N_STATE * len(marks[0]) + GAP
    _record(s, gap, trace, 0, marks)
    _window(c, g[0], s, wave, (period, 1, period), (4, 0), 0.125, trace, -1, marks)
    _window(c, g[1], s, wave, (period + 4, 1, period), (2, 0), 0.25, trace, -1, marks)
    _record(s, gap, trace, 1, marks)
    _window(c, g[2], s, wave, (period + 6, 1, period), (2, 0), 0.5, trace, -1, marks)


@jit
def run(
    c: FloatArray, g: Weights, s: FloatArray, wave: FloatArray, how: tuple[int, int, int, bool], trace: FloatArray,
    marks: Marks,
) -> None:  # fmt: skip
    """Integrate a block's scenes over some half periods, from the state `s` on: at the start modes, and 0 for the rest.

    `wave` (n + START + 1, len(waves)) has the waves at the n steps of a period, and at `START_TIMES`; of a turned
    source (2, 1) its values in both halves of a period. `how` is the number of half periods that lie behind, 0 at the
    start of a run; and of those when this ends; number of steps in each; and whether the source is turned: it is
    constant for a half period, then jumps to its negative, and the method restarts. Such a half period has the pieces
    that `g` has: of equally many steps, which are twice as long in every piece as in the one before. Without jumps, all
    of these half periods are a range of Gregory's rule. The `trace` (lanes * steps,) or (0,) takes the gap voltage
    before each step of the run, V.
    """
    done, halves, half, turned = how
    pieces = g[1].shape[0]
    if not turned:
        begun = 0
        if done == 0:
            _step(c, g[0], s, wave[0], 0.0, 0.0, marks)
            _ease_in(c, g[1], s, wave, trace, marks)
            begun = 2
        steps, before = (halves - done) * half - begun, 0 if done == 0 else 2
        place = (done % 2 * half + begun) % (2 * half)
        _window(c, g[1][3], s, wave, (place, 1, 2 * half), (steps, before), 1.0, trace, done * half + begun, marks)
        return
    for window in range(done, halves):
        # A step of length 0 evaluates the nonlinear term and the integrands.
        _step(c, g[0], s, wave[window % 2], 0.0, 0.0, marks)
        steps, unit = half // pieces, pieces / (2.0**pieces - 1.0)
        for piece in range(pieces):
            at = window * half + piece * steps
            _window(c, g[1][piece], s, wave, (window % 2, 0, -1), (steps, 0), unit, trace, at, marks)
            unit *= 2.0
