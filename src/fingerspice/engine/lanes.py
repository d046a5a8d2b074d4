"""Spans of samples in lanes (`engine.lanestep`)."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from fingerspice.base.arrays import FloatArray, IntArray
from fingerspice.base.compiled import jit
from fingerspice.engine.lanerows import SOURCES, Marks, places
from fingerspice.engine.lanestep import step
from fingerspice.engine.laneweights import weigh

# Samples that are read and written at once.
TILE = 16


@jit
def begin(marks: Marks, c: Any, still: FloatArray, starts: FloatArray, source: FloatArray, state: FloatArray) -> None:
    """Put the lanes at the modes `starts` (m, lanes) under a source (lanes,).

    `still` are the weights of a step of length 0.
    """
    lanes, m, at = len(marks.lanes), len(marks.modes), places(marks)
    state[:] = 0.0
    for i in range(lanes):
        state[2 * lanes + i] = source[i]
        for k in range(m):
            state[(SOURCES + k) * lanes + i] = starts[k, i]
    step(marks, c, still.reshape(-1), state, source, 0.0, 1.0)
    if len(marks.mobile) > 0:
        # On the way to the gap voltage the distance to the fold tells nothing.
        for i in range(lanes):
            state[at.fold * lanes + i] = state[(at.q + 2) * lanes + i] * state[(at.q + 1) * lanes + i]


@jit
def span(
    marks: Any, c: Any, weights: FloatArray, h: FloatArray, x: FloatArray, first: IntArray, count: int, parts: int,
    tol: float, state: FloatArray, kept: FloatArray, left: FloatArray,
) -> bool:  # fmt: skip
    """Advance the lanes by `count` samples, each in `parts` steps, and keep their states at the samples.

    These are the modes, and under `mobile` the gap voltage.

    Parameters
    ----------
    weights : ndarray, shape (rows, 1) or (rows, lanes)
        Of one step; where every lane has its own, they are computed here.
    h : ndarray, shape (n,)
        Distance (s) from each sample to the next, where lanes have their own.
    x, first : ndarray, shape (n + 1,) and (lanes,)
        The source (V), and the sample of each lane's start.
    tol : float
        Change (V) of xi against what is kept already, at which the lanes may stop; negative for none.
    state : ndarray
        Of the lanes, see `begin`.
    kept : ndarray, shape (m or m + 1, lanes, count + 1)
    left : ndarray, shape (m,)
        Largest changes of the active modes where the lanes stop; left alone if they do not.

    Returns
    -------
    bool
        Whether the lanes stopped.
    """
    lanes, m, active = len(marks.lanes), len(marks.modes), len(marks.active)
    rows = m + len(marks.mobile)
    after, found = np.empty(TILE * lanes), np.empty(TILE * rows * lanes)
    length, flat = np.empty(lanes), weights.reshape(-1)
    done = 0
    while done < count:
        size = min(TILE, count - done)
        for i in range(lanes):
            for k in range(size):
                after[k * lanes + i] = x[first[i] + done + 1 + k]
        for k in range(size):
            if len(marks.own) > 0:
                for i in range(lanes):
                    length[i] = h[first[i] + done + k] / parts
                weigh(c, active, length, weights)
            for p in range(parts):
                step(marks, c, flat, state, after[k * lanes :], p / parts, (p + 1) / parts)
            for i in range(rows * lanes):
                found[k * rows * lanes + i] = state[SOURCES * lanes + i]
        off = 0.0
        for i in range(lanes):
            change = 0.0
            for k in range(active):
                change += abs(c.shape[k] * (state[(SOURCES + k) * lanes + i] - kept[k, i, done + size]))
            off = max(off, change) if change == change else math.inf
        stops = off <= tol
        if stops:
            for k in range(active):
                left[k] = 0.0
                for i in range(lanes):
                    left[k] = max(left[k], abs(state[(SOURCES + k) * lanes + i] - kept[k, i, done + size]))
            for k in range(active, m):
                for i in range(lanes):
                    shift = state[(SOURCES + k) * lanes + i] - kept[k, i, done + size]
                    for j in range(done + size + 1, count + 1):
                        kept[k, i, j] += shift
        for row in range(rows):
            for i in range(lanes):
                for k in range(size):
                    kept[row, i, done + 1 + k] = found[(k * rows + row) * lanes + i]
        done += size
        if stops:
            return True
    return False


@jit
def within(
    marks: Any, c: Any, still: FloatArray, starts: FloatArray, x: FloatArray,
    to: FloatArray, h: FloatArray, parts: int, state: FloatArray, out: FloatArray,
) -> None:  # fmt: skip
    """States as in `span` (rows, n) after steps of lengths h (n,), in `parts`, from `starts` (m, n).

    The source goes from x to `to`.
    """
    lanes, m = len(marks.lanes), len(marks.modes)
    rows = still.size // lanes
    weights = np.empty((rows, lanes))
    modes, before, after, length = np.empty((m, lanes)), np.empty(lanes), np.empty(lanes), np.empty(lanes)
    for first in range(0, h.size, lanes):
        for i in range(lanes):
            j = min(first + i, h.size - 1)
            before[i], after[i], length[i] = x[j], to[j], h[j] / parts
            for k in range(m):
                modes[k, i] = starts[k, j]
        begin(marks, c, still, modes, before, state)
        weigh(c, len(marks.active), length, weights)
        for p in range(parts):
            step(marks, c, weights.reshape(-1), state, after, p / parts, (p + 1) / parts)
        for i in range(min(lanes, h.size - first)):
            for k in range(out.shape[0]):
                out[k, first + i] = state[(SOURCES + k) * lanes + i]
