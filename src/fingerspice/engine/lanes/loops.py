"""Spans of samples in lanes (`step`), what is read from them, and derivatives summed back through a run."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from fingerspice.base.arrays import FloatArray, IntArray
from fingerspice.base.compiled import jit, jit_rows, jit_within
from fingerspice.engine.lanes.rows import SOURCES, WEIGHTS, Marks, places, polynomial_rows, rise_of, weigh
from fingerspice.engine.lanes.step import step
from fingerspice.numerics.modes import copy_to

# Samples that are read and written at once.
TILE = 8


@jit_within
def _put(marks: Any, starts: FloatArray, source: FloatArray, state: FloatArray) -> None:
    """Put the lanes at the modes `starts` (m, lanes) under a source (lanes,), for a step of length 0."""
    lanes = len(marks.lanes)
    state[:] = 0.0
    for i in range(lanes):
        state[2 * lanes + i] = source[i]
        for k in range(len(marks.modes)):
            state[(SOURCES + k) * lanes + i] = starts[k, i]


@jit
def span(
    marks: Marks, c: Any, weights: FloatArray, h: FloatArray, x: FloatArray, first: IntArray, count: int, parts: int,
    tol: float, state: FloatArray, kept: FloatArray, left: FloatArray,
) -> bool:  # fmt: skip
    """Advance the lanes by `count` samples, each in `parts` steps, and keep their states at the samples.

    These are the modes, from those at the first sample on, and under `mobile` the gap voltage: `kept` (m or m + 1,
    lanes, count + 1). The `weights` (2, rows, 1 or lanes) are those of a step of length 0, and of one step; where every
    lane has its own, the latter are computed here, and h (n,) has the distance (s) from each sample to the next. The
    source is x (V; n + 1,), and `first` (lanes,) the sample of each lane's start. As soon as xi differs by no more than
    `tol` (V) from what is kept already, the lanes stop: then the result is true, and `left` (m,) takes the largest
    changes of the active modes.
    """
    lanes, m, active = len(marks.lanes), len(marks.modes), len(marks.active)
    rows = m + len(marks.mobile)
    after, found = np.empty(TILE * lanes), np.empty(TILE * rows * lanes)
    length, still, flat, before, done = np.empty(lanes), weights[0].reshape(-1), weights[1].reshape(-1), x[first], 0
    _put(marks, kept[:, :, 0], before, state)
    while done < count:
        size = min(TILE, count - done)
        for i in range(lanes):
            for k in range(size):
                after[k * lanes + i] = x[first[i] + done + 1 + k]
        for k in range(size):
            if len(marks.own) > 0:
                for i in range(lanes):
                    length[i] = h[first[i] + done + k] / parts
                weigh(c, active, len(marks.inner), length, weights[1])
            # The first step has the length 0. One call for all, as the compiler puts it in place.
            for p in range(-1 if done + k == 0 else 0, parts):
                by, to = (still, before) if p < 0 else (flat, after[k * lanes :])
                step(marks, c, by, state, to, max(p, 0) / parts, (p + 1) / parts if p >= 0 else 1.0)
                for i in range(lanes if p < 0 and rows > m else 0):
                    kept[m, i, 0] = state[(SOURCES + m) * lanes + i]
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
def hand_on(left: FloatArray, added: FloatArray, before: FloatArray, out: FloatArray) -> None:
    """What is there at the start of each piece, and at the end of the last one, into `out` (rows, pieces + 1).

    First it is `before` (rows,), of which `left` (rows, pieces) remains, and each piece adds `added` (rows, pieces).
    """
    for row in range(out.shape[0]):
        out[row, 0] = before[row]
        for i in range(left.shape[1]):
            out[row, i + 1] = left[row, i] * out[row, i] + added[row, i]


# Rows of what intervals lead to, behind the modes: gap voltage at the end, and the integrals of u^2 A and A.
GAP, SQUARES, AREAS, MORE = range(4)


@jit_rows
def lead(
    marks: Any, c: Any, weights: FloatArray, z: FloatArray, x: FloatArray, to: FloatArray, h: FloatArray, parts: int,
    shifts: FloatArray, state: FloatArray, out: FloatArray,
) -> None:  # fmt: skip
    """What intervals lead to, each in `parts` steps, with each of some shifts of what they begin with.

    They begin at the modes z (m, n) and last h (n,), or all of them h (1,), s; the source goes from x to `to` (V; n,).
    The `shifts` (count, m + 2) are of the modes at the start, and of the source at start and end. The modes at the end
    and the rows named above go into `out` (count, m + MORE, n). For `weights` and `state` see `span`.
    """
    lanes, m, leaks, last = len(marks.lanes), len(marks.modes), len(marks.leaks), len(marks.inner) + 1
    at, n, still, flat = places(marks), x.size, weights[0].reshape(-1), weights[1].reshape(-1)
    modes, before, after, length = np.empty((m, lanes)), np.empty(lanes), np.empty(lanes), np.empty(lanes)
    found, u, q = np.empty((m + MORE, lanes)), np.empty(lanes), np.empty(lanes)
    for first in range(0, n, lanes):
        for i in range(lanes):
            length[i] = h[min(first + i, n - 1) if len(marks.own) > 0 else 0] / parts
        if len(marks.own) > 0:
            weigh(c, len(marks.active), len(marks.inner), length, weights[1])
        for p in range(len(shifts)):
            for i in range(lanes):
                j = min(first + i, n - 1)
                before[i], after[i] = x[j] + shifts[p, m], to[j] + shifts[p, m + 1]
                for k in range(m):
                    modes[k, i] = z[k, j] + shifts[p, k]
            _put(marks, modes, before, state)
            found[:] = 0.0
            for part in range(-1, parts):
                for node in range(last + 1 if part >= 0 else 2):
                    if node == 1:
                        by, source = (still, before) if part < 0 else (flat, after)
                        a, b = (0.0, 1.0) if part < 0 else (part / parts, (part + 1) / parts)
                        step(marks, c, by, state, source, a, b)
                    if part < 0:
                        continue
                    # After a step its end is node 0 of the next one.
                    place, share = node % last, WEIGHTS[last - 2, node]
                    for i in range(lanes):
                        u[i] = abs(state[(at.xi + place) * lanes + i]) * c.scale + c.shift
                    polynomial_rows(lanes, c.area, u, q)
                    for i in range(lanes):
                        u[i] = state[(at.xi + place) * lanes + i]
                        if len(marks.bend) > len(marks.mobile):
                            u[i] -= c.kappa * state[(at.g + place * (leaks + 1) + leaks) * lanes + i]
                        area = share * length[i] / (c.q0 + q[i])
                        found[m + SQUARES, i] += u[i] * u[i] * area
                        found[m + AREAS, i] += area
            for i in range(min(lanes, n - first)):
                found[m + GAP, i] = u[i]
                for k in range(m):
                    found[k, i] = state[(SOURCES + k) * lanes + i]
                for row in range(m + MORE):
                    out[p, row, first + i] = found[row, i]


@jit
def sum_back(
    slopes: FloatArray, of_integrals: FloatArray, of_modes: FloatArray, of_source: FloatArray, after: FloatArray
) -> None:
    """Derivatives of a number by the source at all nodes, and by the modes at the first one.

    Of what intervals lead to (`lead`) these are the `slopes` (m + MORE, m + 2, n) by the modes at the start and the
    source at start and end. The number's derivatives by the rows behind the modes are `of_integrals` (MORE, n), its own
    by the modes and the source at the nodes `of_modes` (m, n) and `of_source` (n + 1,), to which all that follows is
    added; those by the modes at the last node are `after` (m,), which takes those at the first one.
    """
    m, now = after.size, np.empty(after.size)
    for k in range(slopes.shape[2] - 1, -1, -1):
        for p in range(m + 2):
            total = 0.0
            for row in range(m):
                total += slopes[row, p, k] * after[row]
            for row in range(MORE):
                total += slopes[m + row, p, k] * of_integrals[row, k]
            if p < m:
                now[p] = total + of_modes[p, k]
            else:
                of_source[k + p - m] += total
        copy_to(after, now)


@jit_rows
def _of_source_and_modes(
    n: int, by: FloatArray, s: FloatArray, lane: int, kept: FloatArray, out: FloatArray
) -> None:  # fmt: skip
    """by[0] s + by[1:] z."""
    a, c, first = by[0], by[1], kept[0, lane]
    for i in range(n):
        out[i] = a * s[i] + c * first[i]
    for k in range(1, by.size - 1):
        own, c = kept[k, lane], by[1 + k]
        for i in range(n):
            out[i] += c * own[i]


@jit
def show(
    by: FloatArray, x: FloatArray, first: IntArray, count: int, start: int, n: int, kept: FloatArray, out: FloatArray
) -> None:
    """by[:, 0] x + by[:, 1:] z at the samples 0 to n - 1, into the rows of `out` (C, .) from column `start` on.

    Each lane has `count` of the samples from `first` on; the last lane reads one more, where n asks for it.
    """
    for i in range(first.size):
        size = n - first[i] if i + 1 == first.size else min(count, n - first[i])
        for row in range(len(by) if size > 0 else 0):
            _of_source_and_modes(size, by[row], x[first[i] :], i, kept, out[row, start + first[i] :])


@jit_rows
def polynomial_of(powers: FloatArray, scale: float, shift: float, xi: FloatArray, out: FloatArray) -> None:
    """A polynomial of `engine.lanes.rows.Lanes` at xi (n,)."""
    x = np.empty(xi.size)
    for i in range(xi.size):
        x[i] = abs(xi[i]) * scale + shift
    polynomial_rows(xi.size, powers, x, out)


@jit_rows
def flow(
    c: Any, by: FloatArray, share: float, x: FloatArray, slope: FloatArray, first: IntArray, count: int,
    kept: FloatArray, xi: FloatArray, out: FloatArray,
) -> None:  # fmt: skip
    """Rate of by[0] x + by[1:] z + share N at samples as in `show`; `slope` (n,) is the source's, V/s.

    Under `mobile` A x stands in the place of N, and xi (n,) are the gap voltages.
    """
    m, leaks, drives, n, mobile = c.rates.size, c.tap_s.size, c.feed.shape[1], xi.size, kept.shape[0] > c.rates.size
    rate, q, w, steep = np.empty(count), np.empty(count), np.empty(count), np.empty(count)
    g, of_leak = np.zeros(count), np.empty(1 + m)
    # Shares of source and modes, and of drives, in the rates of the quantity and of xi.
    by_z, by_g = np.zeros((2, 1 + m)), np.zeros((2, drives))
    for j in range(m):
        for row, own in enumerate((by[1 + j], c.shape[j])):
            by_z[row, 0] += own * c.gain[j]
            by_z[row, 1 + j] = -own * c.rates[j]
            for t in range(drives):
                by_g[row, t] += own * c.feed[j, t]
    q0, k, of_xi = c.q0, by[0], c.k
    for i in range(first.size):
        size, at = min(count, n - first[i]), first[i]
        if size <= 0:
            break
        s, rise, u, to = x[at:], slope[at:], xi[at : at + size], out[at:]
        polynomial_of(c.area, c.scale, c.shift, u, q)
        _of_source_and_modes(size, by_z[0], s, i, kept, to)
        _of_source_and_modes(size, by_z[1], s, i, kept, rate)
        # The last drive is N, which takes the sign of xi, or A - 1/q0 times the source.
        if mobile:
            polynomial_of(c.slope, c.scale, c.shift, u, steep)
            for j in range(size):
                g[j] = -q[j] / (q0 * (q0 + q[j])) * s[j]
        elif drives > leaks:
            polynomial_of(c.bend, c.scale, c.shift, u, g)
            for j in range(size):
                g[j] = g[j] if u[j] >= 0.0 else -g[j]
        for t in range(drives):
            a, b = by_g[0, t], by_g[1, t]
            if t < leaks:
                of_leak[0], of_leak[1:], bent = c.tap_s[t], c.taps[t], c.bent[t]
                _of_source_and_modes(size, of_leak, s, i, kept, w)
                for j in range(size):
                    w[j] = q[j] * (w[j] + bent * g[j])
            drive = w if t < leaks else g
            for j in range(size):
                to[j] += a * drive[j]
                rate[j] += b * drive[j]
        if mobile:
            # The rate of u is that by xi over the distance to the fold.
            for j in range(size):
                inverse, steeper = q0 + q[j], steep[j] if u[j] >= 0.0 else -steep[j]
                du = of_xi * rise[j] + rate[j] * inverse / q0
                du /= 1.0 - (u[j] - of_xi * s[j]) / inverse * steeper
                to[j] += k * rise[j] + share * (rise[j] - s[j] * steeper * du / inverse) / inverse
        else:
            for j in range(size):
                to[j] += k * rise[j] + share * rise_of(q0, c.kappa, q[j]) * (rate[j] + of_xi * rise[j])
