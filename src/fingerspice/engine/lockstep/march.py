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

from fingerspice.base.arrays import FloatArray, aligned
from fingerspice.base.compiled import borrow, jit, jit_rows
from fingerspice.engine.lockstep import step as lockstep
from fingerspice.engine.lockstep.scenes import DRIVE, N_LAST, N_OF_MODES, OMEGA, RATES, START, TAIL, TOP
from fingerspice.engine.lockstep.step import (
    GAP,
    N_STATE,
    PEAK,
    SHAPE,
    VALUE,
    Marks,
    area_change,
    area_row,
    double,
    moments_over,
    n_state,
    plus,
    rows_of,
    run,
    weigh,
    weigh_rows,
)

# Most periods in the search for the periodic state.
MOST_PERIODS = 16
# Whether a run has settled is judged as if its modes decayed slower than with the area held, by this factor.
SLOWER = 0.5
Waves = tuple[FloatArray, FloatArray]
"""The waves of both numbers of steps, as `step.run` takes them."""
How = tuple[
    int,  # Number of half periods
    int,  # Steps in each, in the second run; the first has half as many, or is left out if its waves are empty
    int,  # Pieces of each if the source jumps to its negative after each, else 0
    bool,  # Whether the periodic state is wanted
    float,  # Its tolerance, relative to the peak gap voltage
]


def block_shapes(pieces: int, marks: Marks) -> tuple[tuple[int, ...], ...]:
    """Shapes of a block's arrays, for half periods of so many pieces (4 without jumps)."""
    m, w, k, d, count, lanes = (len(mark) for mark in marks)
    weights = lockstep.N_WEIGHTS * m * lanes
    return (
        ((area_row(m, w, k) + d + N_OF_MODES * m + N_LAST) * lanes,),  # Constants: columns of `scenes.constants_of`
        (weights,), (pieces, 3, weights),  # Weights, as `step.run` takes them
        (n_state(m, k, count) * lanes,),  # State
        (count * lanes,),  # Sums over the last period
        (m * lanes,),  # Modes at the start of the last period
        # In the search for the periodic state, the derivative of the start by what a period leaves open, with the area
        # held. In a run from rest, an upper bound of the modes' time constants, in periods.
        (m * lanes,),
        # What the periodic state is off, relative to the peak gap voltage; or half of what the mean force is off
        # because the last period stands for those after it, relative to that force, and infinite while it does not
        (lanes,),
        # Length of the shortest step, s; in a run from rest, then the number of half periods after which it has settled
        (lanes,),
        (11, lanes),  # Scratch of `step.weigh`
    )  # fmt: skip


def new_block(pieces: int, marks: Marks) -> tuple[FloatArray, ...]:
    """Arrays for blocks of scenes; `pieces` is 0 without jumps."""
    return tuple(aligned(block_shapes(pieces or 4, marks)))


@jit
def _load(scenes: FloatArray, first: int, c: FloatArray, marks: Marks) -> None:
    """The constants of the scenes from number `first` on; the last one again in lanes beyond."""
    lanes = len(marks[5])
    for row in range(scenes.shape[0]):
        for i in range(lanes):
            c[row * lanes + i] = scenes[row, min(first + i, scenes.shape[1] - 1)]


@jit
def _of_modes(c: FloatArray, row: int, marks: Marks) -> FloatArray:
    """One of the rows of every mode that come after the polynomial."""
    m, w, k, d, lanes = len(marks[0]), len(marks[1]), len(marks[2]), len(marks[3]), len(marks[5])
    begin = (area_row(m, w, k) + d + row * m) * lanes
    return c[begin : begin + m * lanes]


@jit
def _put_result(
    i: int, c: FloatArray, s: FloatArray, parts: FloatArray, closing: float, lengths: tuple[int, int, int], first: int,
    out: FloatArray, marks: Marks,
) -> None:  # fmt: skip
    """Write lane i's column of `out`, which `march` describes; `parts` are the sums over parts of the run.

    `lengths` are how often the last part stands for others beside itself; steps of the run; and steps of a part, or of
    the run, of which each part then has its share.
    """
    own, count, lanes = N_STATE * len(marks[0]), len(marks[4]), len(marks[5])
    ahead, steps, of_part = lengths
    at, peak = first + i, s[(own + PEAK) * lanes + i]
    if at >= out.shape[1]:
        return
    for j in range(count):
        total = s[(own + VALUE + count + j) * lanes + i]
        if ahead > 0:
            total += ahead * parts[j * lanes + i]
        out[j, at] = total / steps
        for k in range(j, out.shape[0] - 3 - count, count):
            out[count + k, at] = parts[k * lanes + i] / of_part
    out[-3, at], out[-2, at] = peak, closing
    out[-1, at] = c[c.size - TAIL * lanes + i] if peak <= c[c.size - TOP * lanes + i] else math.inf


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
            off += abs(c[(SHAPE + m) * lanes + i] * change)
        closing[i] = off / (s[(N_STATE * m_all + PEAK) * lanes + i] + 1e-300)
        if closing[i] > tol:
            done = False
            for m in range(m_all):
                change = s[(lockstep.Z * m_all + m) * lanes + i] - start[m * lanes + i]
                start[m * lanes + i] += change * back[m * lanes + i]
    return done


@jit
def _settled(i: int, block: Any, steps: int, traced: bool, marks: Marks) -> float:
    """Half of what lane i's mean force is off, relative to it, if the last period stands for all that follow.

    What a mode was off the periodic state, on average over the period, is at most its change over the period times its
    time constant in periods, and so is what it changes in all later ones. The mean force changes by at most twice the
    peak voltage times this, and the area; `steps` is the number of steps of a period. If gap voltages are wanted, then
    at least what these change, relative to their peak.
    """
    c, _, _, s, last, before, back, _, _, _ = block
    m_all, lanes = len(marks[0]), len(marks[5])
    off, held = 0.0, area_row(m_all, len(marks[1]), len(marks[2])) + len(marks[3]) - 1
    for m in range(m_all):
        at = m * lanes + i
        off += abs(c[(SHAPE + m) * lanes + i] * (s[lockstep.Z * m_all * lanes + at] - before[at]) * back[at])
    peak = s[(N_STATE * m_all + PEAK) * lanes + i]
    of_force = off * peak / (last[i] / steps * c[held * lanes + i] + 1e-300)
    return float(max(of_force, off / (peak + 1e-300)) if traced else of_force)


@jit
def _from_rest(
    block: Any, wave: FloatArray, how: tuple[int, int, int], tol: float, trace: FloatArray, out: FloatArray, first: int,
    marks: Marks,
) -> None:  # fmt: skip
    """Run a block's scenes period by period, until the run ends or all have settled.

    A scene that has settled takes part in further periods only if others of its block do, and its results stay those
    at which it settled: no result depends on the scenes beside it. A first range of half a period makes the rest whole.
    """
    halves, steps, pieces = how
    c, still, moving, s, last, before, _, closing, settled, _ = block
    m_all, count, lanes = len(marks[0]), len(marks[4]), len(marks[5])
    sums = (N_STATE * m_all + VALUE + count) * lanes
    for i in range(lanes):
        closing[i] = math.inf
    done, left = 0, lanes
    while left > 0:
        upto = done + 2 - halves % 2 if done == 0 else done + 2
        for i in range(before.size):
            before[i] = s[lockstep.Z * m_all * lanes + i]
        for i in range(last.size):
            last[i] = -s[sums + i] if done > 0 else 0.0
        run(c, (still, moving[: pieces or 4]), s, wave, (done, upto, steps, pieces > 0), trace, marks)
        for i in range(last.size):
            last[i] = last[i] + s[sums + i] if upto - done == 2 else math.nan
        done = upto
        ahead = (halves - done) // 2
        for i in range(lanes):
            if closing[i] < math.inf:
                continue
            off = 0.0
            if ahead > 0:
                off = _settled(i, block, 2 * steps, trace.size > 0, marks)
            if ahead == 0 or off <= tol:
                closing[i], settled[i] = off, done
                left -= 1
                _put_result(i, c, s, last, off, (ahead, halves * steps, 2 * steps), first, out, marks)
    width = trace.size // lanes
    for i in range(lanes if width > 0 else 0):
        # The last period, again and again.
        for j in range(i * width + int(settled[i]) * steps, (i + 1) * width):
            trace[j] = trace[j - 2 * steps]


@jit
def march_block(
    scenes: FloatArray, first: int, waves: Waves, how: How, block: Any, out: FloatArray,
    voltages: tuple[FloatArray, FloatArray], marks: Marks,
) -> None:  # fmt: skip
    """Integrate as many scenes as there are lanes, from number `first` on; see `march`.

    `voltages` take the gap voltages before the steps of both runs, each of shape (lanes * steps,) or (0,).
    """
    halves, half, pieces, periodic, tol = how
    m_all, count, lanes, jumping = len(marks[0]), len(marks[4]), len(marks[5]), pieces > 0
    # Unpacked by position, as a compiler for graphics cards may know plain tuples only.
    c, still, moving, s, _, _, back, closing, length, scratch = block
    _load(scenes, first, c, marks)
    start, rates, drive = _of_modes(c, START, marks), _of_modes(c, RATES, marks), _of_modes(c, DRIVE, marks)
    sums, omega = (N_STATE * m_all + VALUE + count) * lanes, c.size - OMEGA * lanes
    for i in range(m_all * lanes):
        turns = rates[i] * 2.0 * math.pi / c[omega + i % lanes]
        back[i] = -1.0 / math.expm1(-turns) if periodic else 1.0 / (SLOWER * turns + 1e-300)
    g = (still, moving[: pieces or 4])
    for w in range(2):
        if waves[w].size == 0:
            continue
        steps = half // 2 if w == 0 else half
        # All pieces together are 2^pieces - 1 times the first, which has steps / pieces of the shortest steps.
        shorter = pieces / (2.0**pieces - 1.0) if jumping else lockstep.START_TIMES[1]
        for i in range(lanes):
            length[i] = math.pi / c[omega + i] / steps * shorter
        weigh(length, rates, drive, g, scratch, marks)
        for _ in range(MOST_PERIODS):
            for i in range(s.size):
                s[i] = start[i] if i < start.size else 0.0
            if not periodic:
                _from_rest(block, waves[w], (halves, steps, pieces), tol, voltages[w], out[w], first, marks)
                break
            run(c, g, s, waves[w], (0, halves, steps, jumping), voltages[w], marks)
            done = _closed(s, start, back, c, closing, tol, marks)
            for i in range(lanes):
                way = (0, halves * steps, 2 * steps)
                _put_result(i, c, s, s[sums:], closing[i], way, first, out[w], marks)
            if done:
                break


@jit
def march(
    scenes: FloatArray, waves: Waves, how: How, block: Any, out: FloatArray, traces: tuple[FloatArray, FloatArray],
    marks: Marks,
) -> None:  # fmt: skip
    """Integrate scenes, columns of constants, block by block, with each of two numbers of steps; the first may be none.

    `out` (2, 2 n_moment + 3, n) takes for each run the means over it and over its last period, the peak (V), the
    relative error of the periodic state, and the relative size of the last coefficient of the area's series, which is
    infinite where the polynomial does not cover the voltages met. The `traces` (n, steps) take the gap voltage before
    every step of each run, V; they are (n, 0) for none.
    """
    lanes, n = len(marks[5]), scenes.shape[1]
    voltages = np.empty(lanes * traces[0].shape[1]), np.empty(lanes * traces[1].shape[1])
    for first in range(0, n, lanes):
        march_block(scenes, first, waves, how, block, out, voltages, marks)
        for w in range(2):
            width = traces[w].shape[1]
            for i in range(min(lanes, n - first) if width > 0 else 0):
                traces[w][first + i] = voltages[w][i * width : (i + 1) * width]


# Rows of the weights under a recording, each for every mode: of the modes and the nonlinear term at the start of the
# step and in the middle of the one before, for the middle, then (its own middle) for the prediction at the end; of the
# nonlinear term at start, middle and end as corrected; of the integral of |u| that Simpson's rule misses; and of the
# source at both ends, for middle and end.
HALF, HALF_NOW, DECAY, PREDICT, CORRECT, CORRECT_END, KINK = 0, 1, 3, 4, 6, 8, 9
HALF_SOURCE, SOURCE, N_WEIGHTS = 10, 12, 14
# Their polynomials by powers, in that order without the decays and the kink.
_TABLEAU = np.array([
    [1, 1, 0, 0], [0, -1, 0, 0], [1, -2, 0, 0], [0, 2, 0, 0], [1, -3, 2, 0], [0, 4, -4, 0], [0, -1, 2, 0],
    [1, -0.5, 0, 0], [0, 0.5, 0, 0], [1, -1, 0, 0], [0, 1, 0, 0],
], float)  # fmt: skip
# Parts of the run whose shares of the means are kept, because the errors of all of them may cancel by chance.
N_PORTION = 16
# Rows of the state for every mode: z, the nonlinear term at the start of the step and in its middle, and a guess.
Z, RATE, MIDDLE, GUESS = 0, 1, 2, 3


@jit_rows
def _step(
    c: FloatArray, g: FloatArray, s: FloatArray, ends: tuple[float, float], weight: float, marks: Marks
) -> None:  # fmt: skip
    """One step of every lane; adds `weight` times the integrals of the integrands over the step to their sums.

    `ends` are the source's values at the ends of the step.
    """
    m_all, l_all, count, lanes = len(marks[0]), len(marks[2]), len(marks[4]), len(marks[5])
    c, g, s = borrow(c), borrow(g), borrow(s)
    own, held = N_STATE * m_all, area_row(m_all, 1, l_all) + len(marks[3]) - 1
    of_u, of_w, of_z, of_leak, value, total, current = rows_of(marks, N_STATE)
    first, last = ends
    # A number that the compiler knows, from which it sees that no index counts from the end.
    between, slope = 0.5 * (first + last), held + 1 + N_OF_MODES * m_all
    for i in range(lanes):
        for m in range(m_all):
            guess = plus(0.0, g, HALF * m_all + m, s, Z * m_all + m, (3, m_all), lanes, i)
            guess += g[(HALF_SOURCE * m_all + m) * lanes + i] * first
            guess += g[((HALF_SOURCE + 1) * m_all + m) * lanes + i] * last
            s[(GUESS * m_all + m) * lanes + i] = guess
        u = plus(c[of_u * lanes + i] * between, c, SHAPE, s, GUESS * m_all, (m_all, 1), lanes, i)
        q = area_change(u, c, marks, i)
        for k in range(l_all):
            change = c[(of_w + k) * lanes + i] * between
            change = plus(change, c, of_z + k * m_all, s, GUESS * m_all, (m_all, 1), lanes, i)
            # Beside the term itself, the voltage of the leak, which the kink's term needs.
            s[(current + k) * lanes + i] = q * change
            s[(current + l_all + k) * lanes + i] = change
        square = u * u
        force = square / (q + c[held * lanes + i])
        for m in range(m_all):
            s[(MIDDLE * m_all + m) * lanes + i] = plus(0.0, c, of_leak + m * l_all, s, current, (l_all, 1), lanes, i)
            kept = g[(DECAY * m_all + m) * lanes + i] * s[(Z * m_all + m) * lanes + i]
            kept += g[(SOURCE * m_all + m) * lanes + i] * first + g[((SOURCE + 1) * m_all + m) * lanes + i] * last
            s[(Z * m_all + m) * lanes + i] = kept
            s[(GUESS * m_all + m) * lanes + i] = plus(
                kept, g, PREDICT * m_all + m, s, RATE * m_all + m, (2, m_all), lanes, i
            )
        u = plus(c[of_u * lanes + i] * last, c, SHAPE, s, GUESS * m_all, (m_all, 1), lanes, i)
        q = area_change(u, c, marks, i)
        # The integral of |u| less Simpson's rule, on a straight line between both ends.
        before = s[(own + GAP) * lanes + i]
        size = abs(before) + abs(u)
        missed = (before * before + u * u) / (2.0 * size + 1e-300) - (size + 2.0 * abs(before + u)) / 6.0
        missed = c[slope * lanes + i] * missed if before * u < 0.0 else 0.0
        for k in range(l_all):
            change = c[(of_w + k) * lanes + i] * last
            change = plus(change, c, of_z + k * m_all, s, GUESS * m_all, (m_all, 1), lanes, i)
            s[(current + k) * lanes + i] = q * change
            s[(current + l_all + k) * lanes + i] *= missed
        for m in range(m_all):
            rate = plus(0.0, c, of_leak + m * l_all, s, current, (l_all, 1), lanes, i)
            kink = plus(0.0, c, of_leak + m * l_all, s, current + l_all, (l_all, 1), lanes, i)
            z = s[(Z * m_all + m) * lanes + i] + g[(KINK * m_all + m) * lanes + i] * kink
            z = plus(z, g, CORRECT * m_all + m, s, RATE * m_all + m, (2, m_all), lanes, i)
            s[(Z * m_all + m) * lanes + i] = z + g[(CORRECT_END * m_all + m) * lanes + i] * rate
            s[(RATE * m_all + m) * lanes + i] = rate
        u = plus(c[of_u * lanes + i] * last, c, SHAPE, s, Z * m_all, (m_all, 1), lanes, i)
        s[(own + GAP) * lanes + i] = u
        s[(own + PEAK) * lanes + i] = max(s[(own + PEAK) * lanes + i], abs(u))
        latest = u * u / (q + c[held * lanes + i])
        s[total * lanes + i] += weight * (s[value * lanes + i] + 4.0 * force + latest)
        s[value * lanes + i] = latest
        if count > 1:
            latest *= latest
            s[(total + 1) * lanes + i] += weight * (s[(value + 1) * lanes + i] + 4.0 * force * force + latest)
            s[(value + 1) * lanes + i] = latest
            s[(total + 2) * lanes + i] += weight * (s[(value + 2) * lanes + i] + 4.0 * square + u * u)
            s[(value + 2) * lanes + i] = u * u


@jit
def _weigh(
    h: FloatArray, rates: FloatArray, drive: FloatArray, g: FloatArray, scratch: FloatArray, marks: Marks
) -> None:  # fmt: skip
    """Weights of a step of length h (lanes,), s; the arrays are as for `step.weigh`."""
    m_all, lanes = len(marks[0]), len(marks[5])
    half, whole, by = scratch[:5], scratch[5:10], scratch[10]
    for m in range(m_all):
        for i in range(lanes):
            by[i] = 0.5 * h[i]
        moments_over(rates[m * lanes : (m + 1) * lanes], by, half, whole, marks)
        weigh_rows(_TABLEAU[:2], by, half, g, HALF_NOW, m, marks)
        double(half, whole, marks)
        weigh_rows(_TABLEAU[2:7], h, whole, g, PREDICT, m, marks)
        for i in range(lanes):
            g[(HALF * m_all + m) * lanes + i] = half[0, i]
            g[(DECAY * m_all + m) * lanes + i] = whole[0, i]
            g[(KINK * m_all + m) * lanes + i] = h[i] * half[0, i]
            by[i] *= drive[m * lanes + i]
        weigh_rows(_TABLEAU[7:9], by, half, g, HALF_SOURCE, m, marks)
        for i in range(lanes):
            by[i] *= 2.0
        weigh_rows(_TABLEAU[9:], by, whole, g, SOURCE, m, marks)


@jit
def march_samples(
    scenes: FloatArray, values: FloatArray, parts: tuple[int, int], out: FloatArray, marks: Marks
) -> None:  # fmt: skip
    """Integrate scenes, columns of constants, under one recording, with each of two numbers of steps a sample, or 0.

    `values` are samples relative to their peak, which is the amplitude of the one wave; the frequency of the constants
    is half that of the samples. `out` is as for `march`, with the shares of `N_PORTION` portions of the run in place of
    the last period.
    """
    m_all, l_all, count, lanes = len(marks[0]), len(marks[2]), len(marks[4]), len(marks[5])
    row, size, intervals = N_WEIGHTS * m_all * lanes, count * lanes, values.size - 1
    # The last rows of the state hold the voltages of the leaks.
    s, still, g = np.empty((n_state(m_all, l_all, count) + l_all) * lanes), np.zeros(row), np.empty(row)
    c, h, scratch = np.empty(scenes.shape[0] * lanes), np.empty(lanes), np.empty((11, lanes))
    portions = np.empty(N_PORTION * size)
    sums = (N_STATE * m_all + VALUE + count) * lanes
    for kind in (HALF, DECAY):
        still[kind * m_all * lanes : (kind + 1) * m_all * lanes] = 1.0
    for first in range(0, scenes.shape[1], lanes):
        _load(scenes, first, c, marks)
        for w in range(2):
            if parts[w] == 0:
                continue
            for i in range(lanes):
                h[i] = math.pi / c[c.size - OMEGA * lanes + i] / parts[w]
            _weigh(h, _of_modes(c, RATES, marks), _of_modes(c, DRIVE, marks), g, scratch, marks)
            s[:] = 0.0
            # A step of length 0 evaluates the nonlinear term and the integrands.
            _step(c, still, s, (values[0], values[0]), 0.0, marks)
            for p in range(N_PORTION):
                for i in range(size):
                    portions[p * size + i] = -s[sums + i]
                for j in range(p * intervals // N_PORTION, (p + 1) * intervals // N_PORTION):
                    here, change = values[j], (values[j + 1] - values[j]) / parts[w]
                    for k in range(parts[w]):
                        _step(c, g, s, (here + k * change, here + (k + 1) * change), 1.0 / 6.0, marks)
                for i in range(size):
                    portions[p * size + i] += s[sums + i]
            steps = intervals * parts[w]
            for i in range(lanes):
                _put_result(i, c, s, portions, 0.0, (0, steps, steps), first, out[w], marks)
