"""Many series stacks at once, in lockstep: the steps of `fs.batch`, and their weights.

In the modes of a stack with its area held, the change of the area contributes a few per cent of the modes' rates.
Exponential quadrature (Hochbruck and Ostermann 2010, section 2.1) solves the linear part exactly:
z' = -rate z + drive w + n(w, z), with n linear in dq = 1/A - 1/A0 times the voltages of the leaks, which are the cells
whose leak has a total resistance, and dq a polynomial in |u_gap|. The waves w are sine and cosine of every tone of the
source, without a drive, as z is then what is left beside the steady response; or the value of a source that is a
straight line in every step. Each step takes Simpson's rule, with one evaluation of the nonlinear term in its middle and
one at its end: both are predicted, evaluated, and the end is corrected. Where the gap voltage changes its sign within a
step, what Simpson's rule misses of the kink of 1/A is added in closed form, for a voltage that is then a straight line.

A block holds `LANES` scenes, one in each lane, and every quantity is a row with one entry for each lane. The only loop
over the lanes is in a function of its own, whose loops have constant lengths: those of tuples without content. So it is
compiled into vector instructions without a branch, and no lane's result depends on the others. On a graphics card a
block is one scene, in a thread of its own (`engine.lockstep.card`).
"""

from __future__ import annotations

from fingerspice.base.arrays import FloatArray
from fingerspice.base.compiled import jit, jit_rows, jit_within_rows
from fingerspice.numerics.linear import moments as integrals

LANES = 32
"""Scenes of a block on the processor."""
START, START_STEPS = 3, (0, 0, 1, 2)
"""Doublings of the shortest step, an eighth, to a step; and to the steps that a run without jumps begins with."""
START_TIMES = (0.0, 0.0625, 0.125, 0.1875, 0.25, 0.375, 0.5, 0.75, 1.0)
"""Times of their ends and middles, in steps."""
# Number of doublings that give the moments of half a step, and the largest product of rate and length that they serve.
_DOUBLED = 6
_MOST = 0.3 * 2.0**_DOUBLED

Mark = tuple[tuple[()], ...]
"""A tuple of which only the length counts, which compiled code knows as a constant; it is passed without any cost."""
Marks = tuple[Mark, Mark, Mark, Mark, Mark, Mark]
"""Marks for the modes, waves, leaks, powers of the polynomial, moments and lanes."""

# Rows of the constants: the scale of |u| to [-1, 1]; u by modes, and by waves; the voltages of the leaks by waves, and
# by modes, leak after leak; n by leaks, mode after mode; the polynomial of 1/A; and its derivative by |u| at 0 V.
SCALE, SHAPE = 0, 1
# Rows of the weights, each for every mode. To the middle: decay, source at both ends, and the powers of the polynomial
# that predicts the nonlinear term. To the end: decay, source at both ends, nonlinear term at start and middle and their
# second difference, as predicted; at start, middle and end, as corrected; and what Simpson's rule misses of |u|.
HALF, HALF_SOURCE, HALF_SOURCE_END, HALF_NOW, HALF_TREND, HALF_CURVE, DECAY, SOURCE, SOURCE_END = range(9)
PREDICT, PREDICT_MIDDLE, PREDICT_CURVE, CORRECT, CORRECT_MIDDLE, CORRECT_END, KINK, N_WEIGHTS = range(9, 17)
# Rows of the state for every mode: z, the nonlinear term at the start of the step, in the middle of the step before and
# at the start of that, and a guess.
Z, RATE, MIDDLE, OLD, GUESS, N_STATE = 0, 1, 2, 3, 4, 5
# Rows of the state after those: gap voltage, its peak, then the integrands' latest values and their weighted sums, and
# last dq times the voltage of every leak, and this voltage.
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
    return N_STATE * m + VALUE + 2 * moments + 2 * k


@jit_rows
def _shortest(rates: FloatArray, h: FloatArray, moments: FloatArray, marks: Marks) -> None:
    """Moments of every lane, shape (4, lanes), over a 64th of half a step, whose sum needs no exponential function."""
    for i in range(len(marks[5])):
        y = rates[i] * h[i] * (0.5 / 2.0**_DOUBLED)
        total = 0.0
        for j in range(11, -1, -1):
            total = 1.0 - y * total * (1.0 / (j + 4.0))
        m2 = total * (1.0 / 3.0)
        m1 = 0.5 * (1.0 - y * m2)
        m0 = 1.0 - y * m1
        moments[0, i], moments[1, i], moments[2, i], moments[3, i] = 1.0 - y * m0, m0, m1, m2


@jit_rows
def _double(moments: FloatArray, longer: FloatArray, marks: Marks) -> None:
    """Moments over twice the length of a step, shape (4, lanes): exp(-y), then the integrals of exp(-y (1 - s)) s^k."""
    for i in range(len(marks[5])):
        e, m0, m1, m2 = moments[0, i], moments[1, i], moments[2, i], moments[3, i]
        longer[0, i] = e * e
        longer[1, i] = 0.5 * (e * m0 + m0)
        longer[2, i] = 0.25 * (e * m1 + m0 + m1)
        longer[3, i] = 0.125 * (e * m2 + m0 + 2.0 * m1 + m2)


@jit_rows
def _weigh_rows(
    h: FloatArray, drive: FloatArray, half: FloatArray, whole: FloatArray, g: FloatArray, mode: int, marks: Marks
) -> None:
    """Weights of a step of length h (lanes,) for one mode, from its moments over half of it and over all of it."""
    m_all, lanes = len(marks[0]), len(marks[5])
    for i in range(lanes):
        length, by, m0, m1, m2 = 0.5 * h[i], drive[i], half[1, i], half[2, i], half[3, i]
        g[(HALF * m_all + mode) * lanes + i] = half[0, i]
        g[(HALF_SOURCE * m_all + mode) * lanes + i] = by * length * (m0 - 0.5 * m1)
        g[(HALF_SOURCE_END * m_all + mode) * lanes + i] = by * length * 0.5 * m1
        g[(HALF_NOW * m_all + mode) * lanes + i] = length * m0
        g[(HALF_TREND * m_all + mode) * lanes + i] = length * m1
        g[(HALF_CURVE * m_all + mode) * lanes + i] = length * 0.5 * m2
        g[(KINK * m_all + mode) * lanes + i] = h[i] * half[0, i]
    for i in range(lanes):
        length, by, m0, m1, m2 = h[i], drive[i], whole[1, i], whole[2, i], whole[3, i]
        g[(DECAY * m_all + mode) * lanes + i] = whole[0, i]
        g[(SOURCE * m_all + mode) * lanes + i] = by * length * (m0 - m1)
        g[(SOURCE_END * m_all + mode) * lanes + i] = by * length * m1
        g[(PREDICT * m_all + mode) * lanes + i] = length * (m0 - 2.0 * m1)
        g[(PREDICT_MIDDLE * m_all + mode) * lanes + i] = length * 2.0 * m1
        g[(PREDICT_CURVE * m_all + mode) * lanes + i] = length * (4.0 * m2 - 2.0 * m1)
        g[(CORRECT * m_all + mode) * lanes + i] = length * (m0 - 3.0 * m1 + 2.0 * m2)
        g[(CORRECT_MIDDLE * m_all + mode) * lanes + i] = length * 4.0 * (m1 - m2)
        g[(CORRECT_END * m_all + mode) * lanes + i] = length * (2.0 * m2 - m1)


@jit
def weigh(
    shortest: FloatArray, rates: FloatArray, drive: FloatArray, g: FloatArray, scratch: FloatArray, marks: Marks
) -> None:  # fmt: skip
    """Weights of every lane, (1 + pieces, n): for a step of length 0 and for the pieces, each twice as long.

    Steps of the first piece have the length `shortest` (s). `rates` and `drive` have shape (n_mode, lanes); `scratch`
    (9, lanes) is overwritten.
    """
    m_all, lanes = len(marks[0]), len(marks[5])
    still, h = g[0], scratch[8]
    still[:] = 0.0
    still[HALF * m_all * lanes : (HALF + 1) * m_all * lanes] = 1.0
    still[DECAY * m_all * lanes : (DECAY + 1) * m_all * lanes] = 1.0
    for m in range(m_all):
        half, whole = scratch[:4], scratch[4:8]
        for i in range(lanes):
            h[i] = shortest[i]
        _shortest(rates[m], shortest, half, marks)
        for _ in range(_DOUBLED):
            _double(half, whole, marks)
            half, whole = whole, half
        for i in range(lanes):
            y = 0.5 * rates[m, i] * h[i]
            if y > _MOST:
                integrals(y, half[1:, i])
                half[0, i] = 1.0 - y * half[1, i]
        for piece in range(1, g.shape[0]):
            _double(half, whole, marks)
            _weigh_rows(h, drive[m], half, whole, g[piece], m, marks)
            half, whole = whole, half
            for i in range(lanes):
                h[i] *= 2.0


@jit_within_rows
def _change(c: FloatArray, u: float, area: int, powers: Mark, lanes: int, i: int) -> float:
    """dq at a gap voltage: the polynomial, of degree 4 k, without its last term, which belongs to 1/A0."""
    v = abs(u) * c[SCALE * lanes + i] - 1.0
    # Four sums in powers of v^4, as in a single one every product would wait for the last.
    square, at = v * v, area * lanes + i
    fourth, third, second, first = c[at], c[at + lanes], c[at + 2 * lanes], c[at + 3 * lanes]
    for d in range(4, len(powers) - 1, 4):
        by, at = square * square, (area + d) * lanes + i
        fourth, third = fourth * by + c[at], third * by + c[at + lanes]
        second, first = second * by + c[at + 2 * lanes], first * by + c[at + 3 * lanes]
    return float(v * ((fourth * v + third) * square + (second * v + first)))


@jit_within_rows
def _by_waves(c: FloatArray, row: int, wave: FloatArray, at: int, waves: Mark, lanes: int, i: int) -> float:
    total = c[row * lanes + i] * wave[at, 0]
    for w in range(1, len(waves)):
        total += c[(row + w) * lanes + i] * wave[at, w]
    return float(total)


@jit_rows
def step(
    c: FloatArray, g: FloatArray, s: FloatArray, wave: FloatArray, rows: tuple[int, int, int], trend: float,
    weight: float, marks: Marks,
) -> None:  # fmt: skip
    """One step of every lane; adds `weight` times Simpson's sums of the integrands over it to their sums.

    `rows` of `wave` hold the waves at the start, in the middle and at the end of the step; `trend` is the length of the
    step over that of the one before, 0 for a step that has none before it.
    """
    modes, waves, leaks, powers, moments, scenes = marks
    m_all, w_all, l_all, count, lanes = len(modes), len(waves), len(leaks), len(moments), len(scenes)
    of_u = SHAPE + m_all
    of_w = of_u + w_all
    of_z = of_w + l_all * w_all
    of_leak = of_z + l_all * m_all
    area = of_leak + m_all * l_all
    rest, slope = area + len(powers) - 1, area + len(powers)
    own = N_STATE * m_all
    value, total = own + VALUE, own + VALUE + count
    current = total + count
    begin, middle, end = rows
    first, last, share = wave[begin, 0], wave[end, 0], trend / (1.0 + trend)
    for i in range(lanes):
        u = _by_waves(c, of_u, wave, middle, waves, lanes, i)
        for m in range(m_all):
            now, between = s[(RATE * m_all + m) * lanes + i], s[(MIDDLE * m_all + m) * lanes + i]
            curve = trend * ((now - between) - (between - s[(OLD * m_all + m) * lanes + i]))
            guess = g[(HALF * m_all + m) * lanes + i] * s[(Z * m_all + m) * lanes + i]
            guess += g[(HALF_NOW * m_all + m) * lanes + i] * now
            guess += g[(HALF_TREND * m_all + m) * lanes + i] * (trend * (now - between) + 0.5 * curve)
            guess += g[(HALF_CURVE * m_all + m) * lanes + i] * (trend * curve)
            if w_all == 1:
                guess += g[(HALF_SOURCE * m_all + m) * lanes + i] * first
                guess += g[(HALF_SOURCE_END * m_all + m) * lanes + i] * last
            s[(GUESS * m_all + m) * lanes + i] = guess
            u += c[(SHAPE + m) * lanes + i] * guess
        q = _change(c, u, area, powers, lanes, i)
        for k in range(l_all):
            change = _by_waves(c, of_w + k * w_all, wave, middle, waves, lanes, i)
            for m in range(m_all):
                change += c[(of_z + k * m_all + m) * lanes + i] * s[(GUESS * m_all + m) * lanes + i]
            s[(current + k) * lanes + i] = q * change
            s[(current + l_all + k) * lanes + i] = change
        square = u * u
        force = square / (q + c[rest * lanes + i])
        at_end = _by_waves(c, of_u, wave, end, waves, lanes, i)
        u = at_end
        for m in range(m_all):
            rate = c[(of_leak + m * l_all) * lanes + i] * s[current * lanes + i]
            for k in range(1, l_all):
                rate += c[(of_leak + m * l_all + k) * lanes + i] * s[(current + k) * lanes + i]
            now = s[(RATE * m_all + m) * lanes + i]
            # The polynomial through the middle of the step before, the start and the middle of this one.
            curve = share * ((rate - now) - trend * (now - s[(MIDDLE * m_all + m) * lanes + i]))
            s[(MIDDLE * m_all + m) * lanes + i] = rate
            kept = g[(DECAY * m_all + m) * lanes + i] * s[(Z * m_all + m) * lanes + i]
            if w_all == 1:
                kept += g[(SOURCE * m_all + m) * lanes + i] * first + g[(SOURCE_END * m_all + m) * lanes + i] * last
            s[(Z * m_all + m) * lanes + i] = kept
            guess = kept + g[(PREDICT * m_all + m) * lanes + i] * now
            guess += g[(PREDICT_MIDDLE * m_all + m) * lanes + i] * rate
            guess += g[(PREDICT_CURVE * m_all + m) * lanes + i] * curve
            s[(GUESS * m_all + m) * lanes + i] = guess
            u += c[(SHAPE + m) * lanes + i] * guess
        q = _change(c, u, area, powers, lanes, i)
        # The integral of |u| less Simpson's rule, on a straight line between both ends.
        before = s[(own + GAP) * lanes + i]
        size = abs(before) + abs(u)
        missed = (before * before + u * u) / (2.0 * size + 1e-300) - (size + 2.0 * abs(before + u)) / 6.0
        missed = c[slope * lanes + i] * missed if before * u < 0.0 else 0.0
        for k in range(l_all):
            change = _by_waves(c, of_w + k * w_all, wave, end, waves, lanes, i)
            for m in range(m_all):
                change += c[(of_z + k * m_all + m) * lanes + i] * s[(GUESS * m_all + m) * lanes + i]
            s[(current + k) * lanes + i] = q * change
            s[(current + l_all + k) * lanes + i] *= missed
        u = at_end
        for m in range(m_all):
            rate = c[(of_leak + m * l_all) * lanes + i] * s[current * lanes + i]
            kink = c[(of_leak + m * l_all) * lanes + i] * s[(current + l_all) * lanes + i]
            for k in range(1, l_all):
                rate += c[(of_leak + m * l_all + k) * lanes + i] * s[(current + k) * lanes + i]
                kink += c[(of_leak + m * l_all + k) * lanes + i] * s[(current + l_all + k) * lanes + i]
            z = s[(Z * m_all + m) * lanes + i] + g[(KINK * m_all + m) * lanes + i] * kink
            now = s[(RATE * m_all + m) * lanes + i]
            z += g[(CORRECT * m_all + m) * lanes + i] * now
            z += g[(CORRECT_MIDDLE * m_all + m) * lanes + i] * s[(MIDDLE * m_all + m) * lanes + i]
            z += g[(CORRECT_END * m_all + m) * lanes + i] * rate
            s[(Z * m_all + m) * lanes + i] = z
            s[(OLD * m_all + m) * lanes + i] = now
            s[(RATE * m_all + m) * lanes + i] = rate
            u += c[(SHAPE + m) * lanes + i] * z
        s[(own + GAP) * lanes + i] = u
        s[(own + PEAK) * lanes + i] = max(s[(own + PEAK) * lanes + i], abs(u))
        latest = u * u / (q + c[rest * lanes + i])
        s[total * lanes + i] += weight * (s[value * lanes + i] + 4.0 * force + latest)
        s[value * lanes + i] = latest
        if count > 1:
            latest *= latest
            s[(total + 1) * lanes + i] += weight * (s[(value + 1) * lanes + i] + 4.0 * force * force + latest)
            s[(value + 1) * lanes + i] = latest
            s[(total + 2) * lanes + i] += weight * (s[(value + 2) * lanes + i] + 4.0 * square + u * u)
            s[(value + 2) * lanes + i] = u * u


@jit
def run(
    c: FloatArray, g: FloatArray, s: FloatArray, wave: FloatArray, how: tuple[int, int, int, int, bool],
    samples: FloatArray, trace: FloatArray, marks: Marks,
) -> None:  # fmt: skip
    """Integrate a block's scenes over some steps, from the state `s` on: at the start modes, and 0 for the rest.

    `wave` (2 n + 9, len(waves)) has the waves at ends and middles of the n steps of a period, and at `START_TIMES`; of
    a turned source (2, 1) its values in both halves of a period. Of a recording, `samples` (n, 1) are joined by lines,
    which three rows of `wave` take on the way. `how` is the number of steps that lie behind, 0 at the start of a run;
    and of those when this ends; number of steps in each half period, or between two samples; number of pieces, 0 for
    waves; and whether the source is recorded. A turned source is constant for a half period, then jumps to its
    negative, and the method restarts. Such a half period has the pieces that `g` has: of equally many steps, which are
    twice as long in every piece as in the one before; between two samples there is one. The `trace` (n, steps) takes
    the gap voltage of the first n lanes before each step of the run, V; (n, 0) for none.
    """
    done, upto, half, pieces, recorded = how
    period, turned = wave.shape[0] - len(START_TIMES), pieces > 0 and not recorded
    shortest, before = (pieces / (2.0**pieces - 1.0), 0) if pieces > 0 else (0.125, START)
    for k in range(done, upto):
        starts, piece = k == 0 or (turned and k % half == 0), k % half * pieces // half if pieces > 0 else START
        parts = len(START_STEPS) if k == 0 and pieces == 0 else 1
        # A step of length 0 evaluates the nonlinear term and the integrands.
        for part in range(-1 if starts else 0, parts):
            for i in range(min(trace.shape[0], len(marks[5])) if part == 0 and trace.size > 0 else 0):
                trace[i, k] = s[(N_STATE * len(marks[0]) + GAP) * len(marks[5]) + i]
            if parts > 1:
                piece = START_STEPS[max(part, 0)]
            if recorded:
                rows, here = (0, 1, 2), samples[k // half, 0]
                change = (samples[k // half + 1, 0] - here) / half
                for i in range(3):
                    wave[i, 0] = here + (k % half + (0.5 * i if part >= 0 else 0.0)) * change
            elif turned:
                at = k // half % 2
                rows = at, at, at
            else:
                at = period + 2 * max(part, 0) if k == 0 else 2 * k % period
                rows = (at, at, at) if part < 0 else (at, at + 1, at + 2 if at + 2 != period else 0)
            trend = 0.0 if part < 0 or (part == 0 and starts) else 2.0 ** (piece - before)
            weight = 0.0 if part < 0 else shortest * 2.0**piece / 6.0
            step(c, g[0 if part < 0 else 1 + piece], s, wave, rows, trend, weight, marks)
            before = piece
