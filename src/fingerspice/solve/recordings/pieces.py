"""Pieces of a run whose source is a recording, or a PWL with dense points at uneven times."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace

import numpy as np

from fingerspice.base.arrays import FloatArray
from fingerspice.solve.problem import Problem
from fingerspice.solve.recordings.networks import recording_of
from fingerspice.waveforms.ramps import PWL
from fingerspice.waveforms.samples import MOST_PER_POINT, Samples, as_samples

# Fewest samples for which this method pays, and the samples of a piece; pieces begin at multiples of that number.
LEAST_SAMPLES, PIECE = 64, 1 << 18
# Fewest points of a PWL at uneven times for which its own steps pay, whose loop has to be compiled once.
LEAST_POINTS = 1000
# Longest step on a line between two points, over their median distance.
LONGEST = 4.0


@dataclass(frozen=True)
class Piece:
    """A part of a run with evenly spaced samples, or with the points of a PWL."""

    # start, spacing: Time of the first sample and distance of the samples, s
    start: float
    spacing: float
    # first, last: Numbers of the first and the last sample; both 0 for a single step between two times that are no
    # samples
    first: int = 0
    last: int = 0
    # Whether its steps grow from its start on: where a run of a network starts, the source may jump, after which fast
    # modes decay that no step of a sample resolves
    grows: bool = False
    # (n,): Of the points of a PWL at uneven times, s; None for samples. `spacing` is then the mean distance in the run.
    times: FloatArray | None = None

    @property
    def stop(self) -> float:
        if self.times is not None:
            return float(self.times[-1])
        return self.start + max(self.last - self.first, 1) * self.spacing

    def values(self, wave: Samples | PWL) -> FloatArray:
        """The source at the limits of the steps, V."""
        if self.times is not None:
            return wave.value(self.times)
        assert isinstance(wave, Samples)
        if self.first == self.last:
            return wave.value([self.start, self.start + self.spacing])
        return wave.between(self.first, self.last + 1)


def driving(problem: Problem) -> Samples | PWL | None:
    """The recording that drives a stack, or one source of a network whose other sources are at 0; else None.

    For a stack it may also be a PWL with many points, without jump in the run.
    """
    if problem.scene.stack is not None:
        wave = problem.waveform
        samples = as_samples(wave)
        if samples is None and isinstance(wave, PWL) and wave.repeat is None:
            return None if _points(problem, wave) is None else wave
        return samples
    found = recording_of(problem)
    return None if found is None else found[1]


def _points(problem: Problem, wave: PWL) -> FloatArray | None:
    """Times (s) of the points within a run, with its start and end, and with more on long lines; None if not dense.

    They are kept with the waveform, for the last run that asked.
    """
    key = problem.t_start, problem.t_stop
    found: tuple[tuple[float, float], FloatArray | None] | None = wave.kept.get("points")
    if found is None or found[0] != key:
        found = wave.kept["points"] = key, _dense(wave.knots[0], *key)
    return found[1]


def _dense(t: FloatArray, t0: float, t1: float) -> FloatArray | None:
    slack = 1e-6 * (t1 - t0) / t.size
    inside = np.concatenate([[t0], t[(t > t0 + slack) & (t < t1 - slack)], [t1]])
    intervals = np.diff(inside)
    if inside.size < LEAST_POINTS or not np.all(intervals > 0.0):
        return None
    parts = np.ceil(intervals / (LONGEST * np.median(intervals))).astype(int)
    if parts.sum() > 2 * inside.size:
        return None
    if parts.sum() == parts.size:
        return inside
    before = np.repeat(np.concatenate([[0], np.cumsum(parts)[:-1]]), parts)
    share = (np.arange(before.size) - before) / np.repeat(parts, parts)
    return np.append(np.repeat(inside[:-1], parts) + share * np.repeat(intervals, parts), t1)


def spacing_of(wave: Samples | PWL) -> float:
    """The (mean) distance of the samples or points, s."""
    return 1.0 / wave.rate if isinstance(wave, Samples) else (wave.times[-1] - wave.times[0]) / (len(wave.times) - 1)


def pieces_of(problem: Problem) -> list[Piece] | None:
    """The pieces of a run with a moving area that is driven by a recording of enough samples; else None."""
    wave = driving(problem) if problem.scene.coupled else None
    if wave is None:
        return None
    if isinstance(wave, PWL):
        points, spacing = _points(problem, wave), spacing_of(wave)
        assert points is not None
        edges = [*range(0, points.size - 1, PIECE), points.size - 1]
        return [Piece(float(points[a]), spacing, times=points[a : b + 1]) for a, b in itertools.pairwise(edges)]
    spacing, t0, t1 = 1.0 / wave.rate, problem.t_start, problem.t_stop
    first, last = math.ceil((t0 - wave.start) * wave.rate - 1e-6), math.floor((t1 - wave.start) * wave.rate + 1e-6)
    if last - first < LEAST_SAMPLES:
        return None
    if (
        not any(isinstance(one, Samples) for one in problem.waveforms)
        and last - first > MOST_PER_POINT * problem.breakpoints().size
    ):
        # In most of the run the source is one long line, of which the other methods need few steps.
        return None
    grows, begin, end = problem.scene.stack is None, wave.start + first * spacing, wave.start + last * spacing
    early = begin - t0 > 1e-6 * spacing
    edges = [first, *range((first // PIECE + 1) * PIECE, last, PIECE), last]
    if grows and not early:
        edges.insert(1, first + 1)
    out = [Piece(wave.start + a * spacing, spacing, a, b) for a, b in itertools.pairwise(edges) if a < b]
    if early:
        out.insert(0, Piece(t0, begin - t0))
    if grows:
        out[0] = replace(out[0], grows=True)
    if t1 - end > 1e-6 * spacing:
        out.append(Piece(end, t1 - end))
    return out
