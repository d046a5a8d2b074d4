"""Scenes of a batch in lockstep: the loop over blocks of scenes, and the runs of a block.

They take the steps of `engine.lockstep.step`, which explains lanes, rows and constants: under sines or a square period
by period, under a recording portion by portion.
"""

from __future__ import annotations

import math
from typing import Any

from fingerspice.base.arrays import FloatArray
from fingerspice.base.compiled import jit
from fingerspice.engine.lockstep import step as lockstep
from fingerspice.engine.lockstep.scenes import CELL_ROWS, OMEGA, Scenes, fill_block
from fingerspice.engine.lockstep.step import Marks, area_row, run, weigh

# Most periods in the search for the periodic state.
MOST_PERIODS = 16
# Whether a run has settled is judged as if its modes decayed slower than with the area held, by this factor.
SLOWER = 0.5
# Parts of a run under a recording whose shares of the means are kept, because the errors of all may cancel by chance.
N_PORTION = 16
Source = tuple[FloatArray, tuple[FloatArray, FloatArray], bool]
"""Frequencies of the tones, in that of the source; the waves of both numbers of steps, as `step.run` takes them; and
whether they are a recording's samples, relative to their peak, which is the amplitude of the one wave."""
How = tuple[
    int,  # Number of half periods; a recording has one between two samples
    int,  # Steps in each, in the second run; the first has half as many, or is left out if its waves are empty
    int,  # Pieces of each if the source jumps to its negative after each, 1 for a recording, else 0
    bool,  # Whether the periodic state is wanted
    float,  # Its tolerance, relative to the peak gap voltage
    float,  # Largest gap voltage that the area's polynomial covers, as a ratio to its estimate
]


@jit
def _off(i: int, c: FloatArray, stepping: Any, steps: int, periodic: bool, traced: bool, marks: Marks) -> float:
    """What a range of the run of lane i has left open, relative to its peak gap voltage or to its mean force.

    For the periodic state this is the change that a step of Newton's method makes to the gap voltage at the start, with
    the derivative of the period map with the area held. In a run from rest it is half of what the mean force is off if
    the last period stands for all that follow: what a mode was off the periodic state, on average over the period, is
    at most its change over the period times its time constant in periods, and so is what it changes in all later ones.
    The mean force changes by at most twice the peak voltage times this, and the area; `steps` is the number of steps of
    a period. If gap voltages are wanted, then at least what these change, relative to their peak.
    """
    _, s, last, before, back, _, _, _ = stepping
    m_all, lanes = len(marks[0]), len(marks[5])
    off, held = 0.0, area_row(m_all, len(marks[1]), len(marks[2])) + len(marks[3]) - 1
    for m in range(m_all):
        at = m * lanes + i
        change = (s[lockstep.Z * m_all * lanes + at] - before[at]) * back[at]
        off += abs(c[(lockstep.SHAPE + m) * lanes + i] * change)
    peak = s[(lockstep.N_STATE * m_all + lockstep.PEAK) * lanes + i]
    of_force, of_voltage = off * peak / (last[i] / steps * c[held * lanes + i] + 1e-300), off / (peak + 1e-300)
    return float(of_voltage if periodic else max(of_force, of_voltage) if traced else of_force)


@jit
def _integrate(
    found: Any, stepping: Any, wave: FloatArray, samples: FloatArray, how: tuple[int, int, int, bool, bool, float],
    trace: FloatArray, out: FloatArray, first: int, marks: Marks,
) -> None:  # fmt: skip
    """Run a block's scenes range by range, with weights that are known, and write their columns of `out`.

    In search of the periodic state the one range is the run, again and again, until it leads every lane from its start
    back to it; a lane that does so keeps its start. A run from rest has periods, of which the first may be half a one;
    a scene that has settled takes part in further ones only if others of its block do, and its results stay those at
    which it settled: no result depends on the scenes beside it. A recording has portions, whose sums are all kept.
    `how` is as `How`, but for steps in the run's half periods, and whether the source is recorded before the tolerance.
    """
    halves, steps, pieces, periodic, recorded, tol = how
    c, start, _, _, _, covered, tails = found
    g, s, last, before, back, closing, settled, _ = stepping
    m_all, count, lanes = len(marks[0]), len(marks[4]), len(marks[5])
    own, size, ends = lockstep.N_STATE * m_all, count * lanes, N_PORTION if recorded else halves
    sums, of_part = (own + lockstep.VALUE) * lanes + size, (halves if recorded else 2) * steps
    for i in range(lanes):
        closing[i] = math.inf
    done, left, turns = 0, lanes, 0
    while left > 0:
        for i in range(s.size if done == 0 else 0):
            s[i] = start[i] if i < start.size else 0.0
        half_of_period = done == 0 and halves % 2 == 1
        upto = halves if periodic else done + (1 if recorded or half_of_period else 2)
        place = done * size if recorded else 0
        for i in range(before.size):
            before[i] = s[lockstep.Z * m_all * lanes + i]
        for i in range(size):
            last[place + i] = math.nan if half_of_period and not recorded else -s[sums + i]
        way = (done * halves // ends * steps, upto * halves // ends * steps, steps, pieces, recorded)
        run(c, g, s, wave, way, samples, trace, marks)
        for i in range(size):
            last[place + i] += s[sums + i]
        done, turns, again = upto, turns + 1, False
        ahead = (ends - done) // 2
        for i in range(lanes):
            if closing[i] < math.inf and not periodic:
                continue
            off = 0.0 if done == ends else math.inf
            if periodic or (done < ends and not recorded):
                off = _off(i, c, stepping, 2 * steps, periodic, trace.size > 0, marks)
            if periodic and off > tol:
                again = turns < MOST_PERIODS
                for at in range(i, m_all * lanes, lanes):
                    start[at] += (s[lockstep.Z * m_all * lanes + at] - before[at]) * back[at]
            # After half a period it is not a number.
            if done < ends and not off <= tol:
                continue
            closing[i], settled[i], left = off, done, left - 1
            for j in range(count if first + i < out.shape[1] else 0):
                total, peak = s[sums + j * lanes + i], s[(own + lockstep.PEAK) * lanes + i]
                if ahead > 0:
                    total += ahead * last[j * lanes + i]
                out[j, first + i] = total / (halves * steps)
                for k in range(j, out.shape[0] - 3 - count, count):
                    out[count + k, first + i] = last[k * lanes + i] / of_part
                out[-3, first + i], out[-2, first + i] = peak, off
                out[-1, first + i] = tails[i] if peak <= covered[i] else math.inf
        if again:
            done, left = 0, lanes
    for i in range(min(lanes, trace.shape[0]) if trace.size > 0 else 0):
        # The last period, again and again.
        for j in range(int(settled[i]) * steps, trace.shape[1]):
            trace[i, j] = trace[i, j - 2 * steps]


@jit
def march_block(
    scenes: Scenes, first: int, source: Source, how: How, block: tuple[Any, Any, Any], out: FloatArray,
    traces: tuple[FloatArray, FloatArray], marks: Marks,
) -> None:  # fmt: skip
    """Integrate as many scenes as there are lanes, from number `first` on; see `march`."""
    halves, half, pieces, periodic, tol, covered = how
    m_all, lanes, lines = len(marks[0]), len(marks[5]), pieces > 0
    # Unpacked by position, as a compiler for graphics cards may know plain tuples only.
    found, scratch, stepping = block
    _, _, rates, drive, t, _, _ = found
    g, _, _, _, back, _, length, moments = stepping
    omega = (CELL_ROWS * (m_all + 1) + OMEGA) * lanes
    fill_block(scenes, first, (source[0], lines, covered), found, scratch, marks)
    for i in range(lanes):
        period = 2.0 * math.pi / t[omega + i]
        for m in range(m_all):
            if periodic:
                back[m * lanes + i] = -1.0 / math.expm1(-rates[m, i] * period)
            else:
                back[m * lanes + i] = 1.0 / (SLOWER * rates[m, i] * period + 1e-300)
    for w in range(1 if source[1][0].size == 0 else 0, 2):
        given, steps = source[1][w], half // 2 if w == 0 else half
        # All pieces together are 2^pieces - 1 times the first, which has steps / pieces of the shortest steps.
        shorter = pieces / (2.0**pieces - 1.0) if lines else lockstep.START_TIMES[2]
        for i in range(lanes):
            length[i] = math.pi / t[omega + i] / steps * shorter
        weigh(length, rates, drive, g[: 1 + (pieces or 4)], moments, marks)
        way = (halves, steps, pieces, periodic, source[2], tol)
        wave = moments if source[2] else given  # Of a recording, rows that are written on the way
        _integrate(found, stepping, wave, given, way, traces[w][first:], out[w], first, marks)


@jit
def march(
    scenes: Scenes, source: Source, how: How, block: tuple[Any, Any, Any], out: FloatArray,
    traces: tuple[FloatArray, FloatArray], marks: Marks,
) -> None:  # fmt: skip
    """Integrate scenes of a table, block by block, with each of two numbers of steps; the first may be none.

    `out` (2, 2 n_moment + 3, n) takes for each run the means over it and over its last period, or under a recording the
    shares of `N_PORTION` portions of the run, n_moment each; the peak (V); the relative error of the periodic state;
    and the relative size of the last coefficient of the area's series, which is infinite where the polynomial does not
    cover the voltages met. The `traces` (n, steps) take the gap voltage before every step of each run, V; they are
    (n, 0) for none.
    """
    for first in range(0, scenes[1].size, len(marks[5])):
        march_block(scenes, first, source, how, block, out, traces, marks)
