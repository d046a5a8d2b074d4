"""Scenes of a batch in lockstep: the loop over blocks of scenes, and the runs of a block.

They take the steps of `engine.lockstep.step`, which explains lanes, rows and constants: under sines or a square period
by period, under a recording sample by sample.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from fingerspice.base.arrays import FloatArray
from fingerspice.base.compiled import jit
from fingerspice.engine.lockstep import step as lockstep
from fingerspice.engine.lockstep.scenes import CELL_ROWS, OMEGA, Scenes, fill_block, put_result
from fingerspice.engine.lockstep.step import Marks, area_row, run, step, weigh

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
        shorter = pieces / (2.0**pieces - 1.0) if jumping else lockstep.START_TIMES[2]
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


# Parts of the run whose shares of the means are kept, because the errors of all of them may cancel by chance.
N_PORTION = 16


@jit
def _run(
    c: FloatArray, g: lockstep.Weights, s: FloatArray, values: FloatArray, parts: int, portions: FloatArray,
    marks: Marks,
) -> None:  # fmt: skip
    """Integrate a block's scenes from the uncharged state, with so many steps between two samples.

    `portions` takes the sums over each portion of the run, as the state holds those over the whole run.
    """
    size, source, trend = len(marks[4]) * len(marks[5]), np.empty((3, 1)), 0.0
    sums, intervals = (lockstep.N_STATE * len(marks[0]) + lockstep.VALUE) * len(marks[5]) + size, values.size - 1
    for p in range(N_PORTION):
        for i in range(size):
            portions[p * size + i] = -s[sums + i]
        for j in range(p * intervals // N_PORTION, (p + 1) * intervals // N_PORTION):
            here, change = values[j], (values[j + 1] - values[j]) / parts
            # A step of length 0 evaluates the nonlinear term and the integrands.
            for k in range(-1 if j == 0 else 0, parts):
                for i in range(3):
                    source[i, 0] = here + (k + 0.5 * i) * change if k >= 0 else here
                rows = source[0], source[1], source[2]
                step(c, g[0] if k < 0 else g[1][0], s, rows, trend, 1.0 / 6.0 if k >= 0 else 0.0, marks)
                trend = 1.0 if k >= 0 else 0.0
        for i in range(size):
            portions[p * size + i] += s[sums + i]


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
    count, lanes, omega = len(marks[4]), len(marks[5]), (CELL_ROWS * (len(marks[0]) + 1) + OMEGA) * len(marks[5])
    found, scratch, stepping = block
    c, _, rates, drive, t, _, _ = found
    still, moving, s, _, _, _, _, length, moments = stepping
    portions, g = np.empty(N_PORTION * count * lanes), (still, moving[:1])
    for first in range(0, scenes[1].size, lanes):
        fill_block(scenes, first, (np.ones(1), True, how[1]), found, scratch, marks)
        for w in range(2):
            parts = how[0][w]
            if parts == 0:
                continue
            for i in range(lanes):
                length[i] = math.pi / t[omega + i] / parts
            weigh(length, rates, drive, g, moments, marks)
            s[:] = 0.0
            _run(c, g, s, values, parts, portions, marks)
            steps = (values.size - 1) * parts
            for i in range(lanes):
                put_result(i, s, portions, 0.0, (0, steps, steps), found, first, out[w], marks)
