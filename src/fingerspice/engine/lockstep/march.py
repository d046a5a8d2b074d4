"""Scenes of a batch in lockstep: the loop over blocks of scenes, and the runs of a block.

Under sines or a square they take the steps of `engine.lockstep.step`, which explains lanes, rows and constants; those
under one recording are here. The recording is a straight line between two samples, to which the response of the modes
is exact. Its slope jumps at every sample, which leaves no order to a multistep method. So each step takes Simpson's
rule of exponential quadrature, with one evaluation of the nonlinear term in its middle and one at its end: both are
predicted, evaluated, and the end is corrected. Where the gap voltage changes its sign within a step, what Simpson's
rule misses of the kink of 1/A is added in closed form, for a voltage that is a straight line in the step.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from fingerspice.base.arrays import FloatArray
from fingerspice.base.compiled import jit, jit_rows
from fingerspice.engine.lockstep import step as lockstep
from fingerspice.engine.lockstep.scenes import CELL_ROWS, OMEGA, Scenes, fill_block, put_result
from fingerspice.engine.lockstep.step import (
    GAP,
    N_STATE,
    PEAK,
    SCALE,
    SHAPE,
    VALUE,
    Marks,
    area_row,
    moment_integrals,
    n_state,
    run,
    weigh,
)

# Most periods in the search for the periodic state.
MOST_PERIODS = 16
# Whether a run has settled is judged as if its modes decayed slower than with the area held, by this factor.
SLOWER = 0.5
Source = tuple[FloatArray, tuple[FloatArray, FloatArray]]
"""Frequencies of the tones, in that of the source; and the waves of both numbers of steps, as `step.run` takes them."""
How = tuple[
    int,  # Number of half periods
    int,  # Steps in each, in the second run; the first has half as many, or is left out if its waves are empty
    int,  # Pieces of each if the source jumps to its negative after each, else 0
    bool,  # Whether the periodic state is wanted
    float,  # Its tolerance, relative to the peak gap voltage
    float,  # Largest gap voltage that the area's polynomial covers, as a ratio to its estimate
]


@jit
def _closed(
    s: FloatArray, start: FloatArray, back: FloatArray, c: FloatArray, closing: FloatArray, tol: float, marks: Marks
) -> bool:  # fmt: skip
    """Whether a period leads every lane from its start back to it, to `tol`; if not, improve the starts.

    The improvement is a step of Newton's method with the derivative of the period map with the area held. A lane that
    is within `tol` (relative to its peak gap voltage) keeps its start.
    """
    m_all, lanes, done = len(marks[0]), len(marks[5]), True
    for i in range(lanes):
        off = 0.0
        for m in range(m_all):
            change = (s[(lockstep.Z * m_all + m) * lanes + i] - start[m * lanes + i]) * back[m * lanes + i]
            off += abs(c[(lockstep.SHAPE + m) * lanes + i] * change)
        closing[i] = off / (s[(lockstep.N_STATE * m_all + lockstep.PEAK) * lanes + i] + 1e-300)
        if closing[i] > tol:
            done = False
            for m in range(m_all):
                change = s[(lockstep.Z * m_all + m) * lanes + i] - start[m * lanes + i]
                start[m * lanes + i] += change * back[m * lanes + i]
    return done


@jit
def _settled(i: int, c: FloatArray, stepping: Any, steps: int, traced: bool, marks: Marks) -> float:
    """Half of what lane i's mean force is off, relative to it, if the last period stands for all that follow.

    What a mode was off the periodic state, on average over the period, is at most its change over the period times its
    time constant in periods, and so is what it changes in all later ones. The mean force changes by at most twice the
    peak voltage times this, and the area; `steps` is the number of steps of a period. If gap voltages are wanted, then
    at least what these change, relative to their peak.
    """
    _, _, s, last, before, back, _, _, _ = stepping
    m_all, lanes = len(marks[0]), len(marks[5])
    off, held = 0.0, area_row(m_all, len(marks[1]), len(marks[2])) + len(marks[3]) - 1
    for m in range(m_all):
        at = m * lanes + i
        off += abs(c[(lockstep.SHAPE + m) * lanes + i] * (s[lockstep.Z * m_all * lanes + at] - before[at]) * back[at])
    peak = s[(lockstep.N_STATE * m_all + lockstep.PEAK) * lanes + i]
    of_force = off * peak / (last[i] / steps * c[held * lanes + i] + 1e-300)
    return float(max(of_force, off / (peak + 1e-300)) if traced else of_force)


@jit
def _from_rest(
    found: Any, stepping: Any, wave: FloatArray, how: tuple[int, int, int], tol: float, trace: FloatArray,
    out: FloatArray, first: int, marks: Marks,
) -> None:  # fmt: skip
    """Run a block's scenes period by period, until the run ends or all have settled.

    A scene that has settled takes part in further periods only if others of its block do, and its results stay those
    at which it settled: no result depends on the scenes beside it. A first range of half a period makes the rest whole.
    """
    halves, steps, pieces = how
    still, moving, s, last, before, _, closing, settled, _ = stepping
    m_all, count, lanes = len(marks[0]), len(marks[4]), len(marks[5])
    sums = (lockstep.N_STATE * m_all + lockstep.VALUE + count) * lanes
    for i in range(lanes):
        closing[i] = math.inf
    done, left = 0, lanes
    while left > 0:
        upto = done + 2 - halves % 2 if done == 0 else done + 2
        for i in range(before.size):
            before[i] = s[lockstep.Z * m_all * lanes + i]
        for i in range(last.size):
            last[i] = -s[sums + i] if done > 0 else 0.0
        run(found[0], (still, moving[: pieces or 4]), s, wave, (done, upto, steps, pieces > 0), trace, marks)
        for i in range(last.size):
            last[i] = last[i] + s[sums + i] if upto - done == 2 else math.nan
        done = upto
        ahead = (halves - done) // 2
        for i in range(lanes):
            if closing[i] < math.inf:
                continue
            off = 0.0
            if ahead > 0:
                off = _settled(i, found[0], stepping, 2 * steps, trace.size > 0, marks)
            if ahead == 0 or off <= tol:
                closing[i], settled[i] = off, done
                left -= 1
                put_result(i, s, last, off, (ahead, halves * steps, 2 * steps), found, first, out, marks)
    width = trace.size // lanes
    for i in range(lanes if width > 0 else 0):
        # The last period, again and again.
        for j in range(i * width + int(settled[i]) * steps, (i + 1) * width):
            trace[j] = trace[j - 2 * steps]


@jit
def march_block(
    scenes: Scenes, first: int, source: Source, how: How, block: tuple[Any, Any, Any], out: FloatArray,
    voltages: tuple[FloatArray, FloatArray], marks: Marks,
) -> None:  # fmt: skip
    """Integrate as many scenes as there are lanes, from number `first` on; see `march`.

    `voltages` take the gap voltages before the steps of both runs, each of shape (lanes * steps,) or (0,).
    """
    halves, half, pieces, periodic, tol, covered = how
    m_all, count, lanes, jumping = len(marks[0]), len(marks[4]), len(marks[5]), pieces > 0
    # Unpacked by position, as a compiler for graphics cards may know plain tuples only.
    found, scratch, stepping = block
    c, start, rates, drive, t, _, _ = found
    still, moving, s, _, _, back, closing, length, moments = stepping
    sums, omega = (lockstep.N_STATE * m_all + lockstep.VALUE + count) * lanes, (CELL_ROWS * (m_all + 1) + OMEGA) * lanes
    fill_block(scenes, first, (source[0], jumping, covered), found, scratch, marks)
    for i in range(lanes):
        period = 2.0 * math.pi / t[omega + i]
        for m in range(m_all):
            if periodic:
                back[m * lanes + i] = -1.0 / math.expm1(-rates[m, i] * period)
            else:
                back[m * lanes + i] = 1.0 / (SLOWER * rates[m, i] * period + 1e-300)
    g = (still, moving[: pieces or 4])
    for w in range(2):
        if source[1][w].size == 0:
            continue
        steps = half // 2 if w == 0 else half
        # All pieces together are 2^pieces - 1 times the first, which has steps / pieces of the shortest steps.
        shorter = pieces / (2.0**pieces - 1.0) if jumping else lockstep.START_TIMES[1]
        for i in range(lanes):
            length[i] = math.pi / t[omega + i] / steps * shorter
        weigh(length, rates, drive, g, moments, marks)
        for _ in range(MOST_PERIODS):
            for i in range(s.size):
                s[i] = start[i] if i < start.size else 0.0
            if not periodic:
                way = (halves, steps, pieces)
                _from_rest(found, stepping, source[1][w], way, tol, voltages[w], out[w], first, marks)
                break
            run(c, g, s, source[1][w], (0, halves, steps, jumping), voltages[w], marks)
            done = _closed(s, start, back, c, closing, tol, marks)
            way = (0, halves * steps, 2 * steps)
            for i in range(lanes):
                put_result(i, s, s[sums:], closing[i], way, found, first, out[w], marks)
            if done:
                break


@jit
def march(
    scenes: Scenes, source: Source, how: How, block: tuple[Any, Any, Any], out: FloatArray,
    traces: tuple[FloatArray, FloatArray], marks: Marks,
) -> None:  # fmt: skip
    """Integrate scenes of a table, block by block, with each of two numbers of steps; the first may be none.

    `out` (2, 2 n_moment + 3, n) takes for each run the means over it and over its last period, the peak (V), the
    relative error of the periodic state, and the relative size of the last coefficient of the area's series, which is
    infinite where the polynomial does not cover the voltages met. The `traces` (n, steps) take the gap voltage before
    every step of each run, V; they are (n, 0) for none.
    """
    lanes, n = len(marks[5]), scenes[1].size
    voltages = np.empty(lanes * traces[0].shape[1]), np.empty(lanes * traces[1].shape[1])
    for first in range(0, n, lanes):
        march_block(scenes, first, source, how, block, out, voltages, marks)
        for w in range(2):
            width = traces[w].shape[1]
            for i in range(min(lanes, n - first) if width > 0 else 0):
                traces[w][first + i] = voltages[w][i * width : (i + 1) * width]


# Rows of the weights, each for every mode. To the middle: decay, source at both ends, nonlinear term at the start and
# in the middle of the step before. To the end: decay, source at both ends, nonlinear term at start and middle as
# predicted, and at start, middle and end as corrected; and the integral of |u| that Simpson's rule misses.
HALF, HALF_SOURCE, HALF_SOURCE_END, HALF_NOW, HALF_OLD, DECAY, SOURCE, SOURCE_END, PREDICT, PREDICT_MIDDLE = range(10)
CORRECT, CORRECT_MIDDLE, CORRECT_END, KINK, N_WEIGHTS = 10, 11, 12, 13, 14
# Parts of the run whose shares of the means are kept, because the errors of all of them may cancel by chance.
N_PORTION = 16
# Rows of the state for every mode: z, the nonlinear term at the start of the step and in its middle, and a guess.
Z, RATE, MIDDLE, GUESS = 0, 1, 2, 3


@jit_rows
def _step(
    c: FloatArray, g: FloatArray, s: FloatArray, slope: FloatArray, ends: tuple[float, float], weight: float,
    marks: Marks,
) -> None:  # fmt: skip
    """One step of every lane; adds `weight` times the integrals of the integrands over the step to their sums.

    `ends` are the source's values at the ends of the step, `slope` the derivative of 1/A by |u| at 0 V.
    """
    modes, _, leaks, powers, moments, scenes = marks
    m_all, l_all, d_all, count, lanes = len(modes), len(leaks), len(powers) - 1, len(moments), len(scenes)
    of_u = SHAPE + m_all
    of_w = of_u + 1
    of_z = of_w + l_all
    of_leak = of_z + l_all * m_all
    area = of_leak + m_all * l_all
    own = N_STATE * m_all
    value, total = own + VALUE, own + VALUE + count
    current = total + count
    first, last = ends
    between = 0.5 * (first + last)
    for i in range(lanes):
        u = c[of_u * lanes + i] * between
        for m in range(m_all):
            z, now = s[(Z * m_all + m) * lanes + i], s[(RATE * m_all + m) * lanes + i]
            guess = g[(HALF * m_all + m) * lanes + i] * z + g[(HALF_NOW * m_all + m) * lanes + i] * now
            guess += g[(HALF_OLD * m_all + m) * lanes + i] * s[(MIDDLE * m_all + m) * lanes + i]
            guess += g[(HALF_SOURCE * m_all + m) * lanes + i] * first
            guess += g[(HALF_SOURCE_END * m_all + m) * lanes + i] * last
            s[(GUESS * m_all + m) * lanes + i] = guess
            u += c[(SHAPE + m) * lanes + i] * guess
        v = abs(u) * c[SCALE * lanes + i] - 1.0
        q = c[area * lanes + i]
        for d in range(1, d_all):
            q = q * v + c[(area + d) * lanes + i]
        q *= v
        for k in range(l_all):
            change = c[(of_w + k) * lanes + i] * between
            for m in range(m_all):
                change += c[(of_z + k * m_all + m) * lanes + i] * s[(GUESS * m_all + m) * lanes + i]
            # Beside the term itself, the voltage of the leak, which the kink's term needs.
            s[(current + k) * lanes + i] = q * change
            s[(current + l_all + k) * lanes + i] = change
        force = u * u / (q + c[(area + d_all) * lanes + i])
        square = u * u
        u = c[of_u * lanes + i] * last
        for m in range(m_all):
            rate = c[(of_leak + m * l_all) * lanes + i] * s[current * lanes + i]
            for k in range(1, l_all):
                rate += c[(of_leak + m * l_all + k) * lanes + i] * s[(current + k) * lanes + i]
            s[(MIDDLE * m_all + m) * lanes + i] = rate
            kept = g[(DECAY * m_all + m) * lanes + i] * s[(Z * m_all + m) * lanes + i]
            kept += g[(SOURCE * m_all + m) * lanes + i] * first + g[(SOURCE_END * m_all + m) * lanes + i] * last
            s[(Z * m_all + m) * lanes + i] = kept
            guess = kept + g[(PREDICT * m_all + m) * lanes + i] * s[(RATE * m_all + m) * lanes + i]
            guess += g[(PREDICT_MIDDLE * m_all + m) * lanes + i] * rate
            s[(GUESS * m_all + m) * lanes + i] = guess
            u += c[(SHAPE + m) * lanes + i] * guess
        v = abs(u) * c[SCALE * lanes + i] - 1.0
        q = c[area * lanes + i]
        for d in range(1, d_all):
            q = q * v + c[(area + d) * lanes + i]
        q *= v
        # The integral of |u| less Simpson's rule, on a straight line between both ends.
        before = s[(own + GAP) * lanes + i]
        size = abs(before) + abs(u)
        missed = (before * before + u * u) / (2.0 * size + 1e-300) - (size + 2.0 * abs(before + u)) / 6.0
        missed = slope[i] * missed if before * u < 0.0 else 0.0
        for k in range(l_all):
            change = c[(of_w + k) * lanes + i] * last
            for m in range(m_all):
                change += c[(of_z + k * m_all + m) * lanes + i] * s[(GUESS * m_all + m) * lanes + i]
            s[(current + k) * lanes + i] = q * change
            s[(current + l_all + k) * lanes + i] *= missed
        u = c[of_u * lanes + i] * last
        for m in range(m_all):
            rate = c[(of_leak + m * l_all) * lanes + i] * s[current * lanes + i]
            kink = c[(of_leak + m * l_all) * lanes + i] * s[(current + l_all) * lanes + i]
            for k in range(1, l_all):
                rate += c[(of_leak + m * l_all + k) * lanes + i] * s[(current + k) * lanes + i]
                kink += c[(of_leak + m * l_all + k) * lanes + i] * s[(current + l_all + k) * lanes + i]
            z = s[(Z * m_all + m) * lanes + i] + g[(KINK * m_all + m) * lanes + i] * kink
            z += g[(CORRECT * m_all + m) * lanes + i] * s[(RATE * m_all + m) * lanes + i]
            z += g[(CORRECT_MIDDLE * m_all + m) * lanes + i] * s[(MIDDLE * m_all + m) * lanes + i]
            z += g[(CORRECT_END * m_all + m) * lanes + i] * rate
            s[(Z * m_all + m) * lanes + i] = z
            s[(RATE * m_all + m) * lanes + i] = rate
            u += c[(SHAPE + m) * lanes + i] * z
        s[(own + GAP) * lanes + i] = u
        s[(own + PEAK) * lanes + i] = max(s[(own + PEAK) * lanes + i], abs(u))
        latest = u * u / (q + c[(area + d_all) * lanes + i])
        s[total * lanes + i] += weight * (s[value * lanes + i] + 4.0 * force + latest)
        s[value * lanes + i] = latest
        if count > 1:
            latest *= latest
            s[(total + 1) * lanes + i] += weight * (s[(value + 1) * lanes + i] + 4.0 * force * force + latest)
            s[(value + 1) * lanes + i] = latest
            s[(total + 2) * lanes + i] += weight * (s[(value + 2) * lanes + i] + 4.0 * square + u * u)
            s[(value + 2) * lanes + i] = u * u


@jit
def _weigh(h: FloatArray, rates: FloatArray, drive: FloatArray, g: FloatArray, marks: Marks) -> None:
    """Weights of a step of length h (lanes,), s; `rates` and `drive` have shape (n_mode, lanes)."""
    m_all, lanes = len(marks[0]), len(marks[5])
    for m in range(m_all):
        for i in range(lanes):
            y, length, by = rates[m, i] * h[i], h[i], drive[m, i]
            m0, m1, _, _ = moment_integrals(0.5 * y)
            half = 0.5 * length
            g[(HALF * m_all + m) * lanes + i] = 1.0 - 0.5 * y * m0
            g[(HALF_SOURCE * m_all + m) * lanes + i] = by * half * (m0 - 0.5 * m1)
            g[(HALF_SOURCE_END * m_all + m) * lanes + i] = by * half * 0.5 * m1
            g[(HALF_NOW * m_all + m) * lanes + i] = half * (m0 + m1)
            g[(HALF_OLD * m_all + m) * lanes + i] = -half * m1
            g[(KINK * m_all + m) * lanes + i] = length * (1.0 - 0.5 * y * m0)
            m0, m1, m2, _ = moment_integrals(y)
            g[(DECAY * m_all + m) * lanes + i] = 1.0 - y * m0
            g[(SOURCE * m_all + m) * lanes + i] = by * length * (m0 - m1)
            g[(SOURCE_END * m_all + m) * lanes + i] = by * length * m1
            g[(PREDICT * m_all + m) * lanes + i] = length * (m0 - 2.0 * m1)
            g[(PREDICT_MIDDLE * m_all + m) * lanes + i] = length * 2.0 * m1
            g[(CORRECT * m_all + m) * lanes + i] = length * (m0 - 3.0 * m1 + 2.0 * m2)
            g[(CORRECT_MIDDLE * m_all + m) * lanes + i] = length * 4.0 * (m1 - m2)
            g[(CORRECT_END * m_all + m) * lanes + i] = length * (2.0 * m2 - m1)


@jit
def _run(
    c: FloatArray, still: FloatArray, g: FloatArray, s: FloatArray, slope: FloatArray, values: FloatArray, parts: int,
    portions: FloatArray, marks: Marks,
) -> None:  # fmt: skip
    """Integrate a block's scenes from the uncharged state, with so many steps between two samples.

    `portions` takes the sums over each portion of the run, as the state holds those over the whole run.
    """
    size = len(marks[4]) * len(marks[5])
    # A step of length 0 evaluates the nonlinear term and the integrands.
    _step(c, still, s, slope, (values[0], values[0]), 0.0, marks)
    sums, intervals = (N_STATE * len(marks[0]) + VALUE) * len(marks[5]) + size, values.size - 1
    for p in range(N_PORTION):
        for i in range(size):
            portions[p * size + i] = -s[sums + i]
        for j in range(p * intervals // N_PORTION, (p + 1) * intervals // N_PORTION):
            here, change = values[j], (values[j + 1] - values[j]) / parts
            for k in range(parts):
                ends = (here + k * change, here + (k + 1) * change)
                _step(c, g, s, slope, ends, 1.0 / 6.0, marks)
        for i in range(size):
            portions[p * size + i] += s[sums + i]


@jit
def _slopes(c: FloatArray, area: int, degree: int, slope: FloatArray, marks: Marks) -> None:
    """Derivative of 1/A by |u| at 0 V, where the polynomial's variable is -1."""
    lanes = len(marks[5])
    for i in range(lanes):
        total, value = 0.0, c[area * lanes + i]
        for d in range(1, degree + 1):
            total = value - total
            value = c[(area + d) * lanes + i] - value
        slope[i] = total * c[SCALE * lanes + i]


@jit
def march_samples(
    scenes: Scenes, values: FloatArray, how: tuple[tuple[int, int], float], block: tuple[Any, Any, Any],
    out: FloatArray, marks: Marks,
) -> None:  # fmt: skip
    """Integrate scenes of a table under one recording, block by block, with each of two numbers of steps a sample.

    `values` are samples relative to their peak, which is the amplitude of the one wave; the table's frequency is half
    that of the samples. `how` has the steps a sample in both runs, 0 for none in the first; and the largest gap voltage
    that the area's polynomial covers, as a ratio to its estimate. `out` is as for `march.march`, with the shares of
    `N_PORTION` portions of the run in place of the last period.
    """
    m_all, l_all, d_all, count, lanes = len(marks[0]), len(marks[2]), len(marks[3]) - 1, len(marks[4]), len(marks[5])
    omega, row = (CELL_ROWS * (m_all + 1) + OMEGA) * lanes, N_WEIGHTS * m_all * lanes
    found, scratch, _ = block
    c, _, rates, drive, t, _, _ = found
    # The last rows of the state hold the voltages of the leaks.
    s, still, g = np.empty((n_state(m_all, l_all, count) + l_all) * lanes), np.zeros(row), np.empty(row)
    portions, slope, h = np.empty(N_PORTION * count * lanes), np.empty(lanes), np.empty(lanes)
    for kind in (HALF, DECAY):
        still[kind * m_all * lanes : (kind + 1) * m_all * lanes] = 1.0
    for first in range(0, scenes[1].size, lanes):
        fill_block(scenes, first, (np.ones(1), True, how[1]), found, scratch, marks)
        _slopes(c, area_row(m_all, 1, l_all), d_all, slope, marks)
        for w in range(2):
            parts = how[0][w]
            if parts == 0:
                continue
            for i in range(lanes):
                h[i] = math.pi / t[omega + i] / parts
            _weigh(h, rates, drive, g, marks)
            s[:] = 0.0
            _run(c, still, g, s, slope, values, parts, portions, marks)
            steps = (values.size - 1) * parts
            for i in range(lanes):
                put_result(i, s, portions, 0.0, (0, steps, steps), found, first, out[w], marks)
