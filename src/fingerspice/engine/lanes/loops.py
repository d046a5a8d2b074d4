"""Spans of samples in lanes (`step`), what is read from them, and derivatives summed back through a run."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from fingerspice.base.arrays import FloatArray, IntArray
from fingerspice.base.compiled import jit, jit_rows, jit_within_rows
from fingerspice.engine.lanes import rows as lane
from fingerspice.engine.lanes.rows import Marks, places, polynomial_rows, rise_of
from fingerspice.engine.lanes.step import step
from fingerspice.engine.lanes.weights import weigh
from fingerspice.numerics.small import copy_to

# Samples that are read and written at once.
TILE = 8


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
            state[(lane.SOURCES + k) * lanes + i] = starts[k, i]
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
                weigh(c, active, len(marks.inner), length, weights)
            for p in range(parts):
                step(marks, c, flat, state, after[k * lanes :], p / parts, (p + 1) / parts)
            for i in range(rows * lanes):
                found[k * rows * lanes + i] = state[lane.SOURCES * lanes + i]
        off = 0.0
        for i in range(lanes):
            change = 0.0
            for k in range(active):
                change += abs(c.shape[k] * (state[(lane.SOURCES + k) * lanes + i] - kept[k, i, done + size]))
            off = max(off, change) if change == change else math.inf
        stops = off <= tol
        if stops:
            for k in range(active):
                left[k] = 0.0
                for i in range(lanes):
                    left[k] = max(left[k], abs(state[(lane.SOURCES + k) * lanes + i] - kept[k, i, done + size]))
            for k in range(active, m):
                for i in range(lanes):
                    shift = state[(lane.SOURCES + k) * lanes + i] - kept[k, i, done + size]
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
        weigh(c, len(marks.active), len(marks.inner), length, weights)
        for p in range(parts):
            step(marks, c, weights.reshape(-1), state, after, p / parts, (p + 1) / parts)
        for i in range(min(lanes, h.size - first)):
            for k in range(out.shape[0]):
                out[k, first + i] = state[(lane.SOURCES + k) * lanes + i]


# Rows of the derivatives behind those of the modes: gap voltage at the end, and the integrals of u^2 A and A.
GAP, SQUARES, AREAS, MORE = range(4)


@jit_within_rows
def _gap_and_area(marks: Any, c: Any, node: int, state: FloatArray, u: FloatArray, q: FloatArray) -> None:
    """Gap voltage and 1/A - q0 at a node, of every lane."""
    lanes, leaks, at = len(marks.lanes), len(marks.leaks), places(marks)
    drives = leaks + len(marks.bend)
    for i in range(lanes):
        u[i] = abs(state[(at.xi + node) * lanes + i]) * c.scale + c.shift
    polynomial_rows(lanes, c.area, u, q)
    for i in range(lanes):
        u[i] = state[(at.xi + node) * lanes + i]
        if len(marks.bend) > len(marks.mobile):
            u[i] -= c.kappa * state[(at.g + node * drives + leaks) * lanes + i]


@jit
def slopes_of(
    marks: Any, c: Any, still: FloatArray, z: FloatArray, x: FloatArray, to: FloatArray, h: FloatArray, parts: int,
    delta: FloatArray, room: tuple[FloatArray, FloatArray], out: FloatArray,
) -> None:  # fmt: skip
    """Central differences of what intervals lead to, each in `parts` steps.

    Parameters
    ----------
    still : ndarray
        As in `begin`.
    z, x, to : ndarray, shape (m, n), (n,) and (n,)
        Modes at the start of each interval, and the source at its start and end, V.
    h : ndarray, shape (n,) or (1,)
        Lengths of the intervals, or of all of them, s.
    delta : ndarray, shape (m + 1,)
        Distances to either side, of each mode and of the source.
    room : tuple of ndarray
        State and weights of the lanes, the latter of one step where all intervals share them.
    out : ndarray, shape (m + MORE, m + 2, n)
        Takes the derivatives of the modes at the end and of the rows named above, by the modes at the start and the
        source at start and end.
    """
    lanes, m, last = len(marks.lanes), len(marks.modes), len(marks.inner) + 1
    state, weights = room
    n, flat = x.size, weights.reshape(-1)
    modes, before, after, length = np.empty((m, lanes)), np.empty(lanes), np.empty(lanes), np.empty(lanes)
    found, u, q = np.empty((m + MORE, lanes)), np.empty(lanes), np.empty(lanes)
    for first in range(0, n, lanes):
        for i in range(lanes):
            length[i] = h[min(first + i, n - 1) if len(marks.own) > 0 else 0] / parts
        if len(marks.own) > 0:
            weigh(c, len(marks.active), len(marks.inner), length, weights)
        for p in range(m + 2):
            for sign in (1.0, -1.0):
                move = sign * delta[min(p, m)]
                for i in range(lanes):
                    j = min(first + i, n - 1)
                    before[i], after[i] = x[j] + (move if p == m else 0.0), to[j] + (move if p == m + 1 else 0.0)
                    for k in range(m):
                        modes[k, i] = z[k, j] + (move if p == k else 0.0)
                begin(marks, c, still, modes, before, state)
                found[:] = 0.0
                for part in range(parts):
                    for node in range(last + 1):
                        if node == 1:
                            step(marks, c, flat, state, after, part / parts, (part + 1) / parts)
                        # After a step its end is node 0 of the next one.
                        _gap_and_area(marks, c, node % last, state, u, q)
                        by = lane.WEIGHTS[last - 2, node]
                        for i in range(lanes):
                            area = by * length[i] / (c.q0 + q[i])
                            found[m + SQUARES, i] += u[i] * u[i] * area
                            found[m + AREAS, i] += area
                for i in range(lanes):
                    found[m + GAP, i] = u[i]
                    for k in range(m):
                        found[k, i] = state[(lane.SOURCES + k) * lanes + i]
                share = 0.5 / move
                for i in range(min(lanes, n - first)):
                    for row in range(m + MORE):
                        before_it = 0.0 if sign > 0.0 else out[row, p, first + i]
                        out[row, p, first + i] = before_it + share * found[row, i]


@jit
def sum_back(
    slopes: FloatArray, of_integrals: FloatArray, of_modes: FloatArray, of_source: FloatArray, after: FloatArray
) -> None:
    """Derivatives of a number by the source at all nodes, and by the modes at the first one.

    Parameters
    ----------
    slopes : ndarray, shape (m + MORE, m + 2, n)
        See `slopes_of`.
    of_integrals : ndarray, shape (MORE, n)
        Derivatives of the number by the rows behind the modes.
    of_modes : ndarray, shape (m, n)
        Its own derivatives by the modes at the nodes.
    of_source : ndarray, shape (n + 1,)
        Those by the source there, to which all that follows is added.
    after : ndarray, shape (m,)
        Derivatives by the modes at the last node; then by those at the first one.
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
    n: int, a: float, s: FloatArray, columns: FloatArray, lane: int, kept: FloatArray, out: FloatArray
) -> None:  # fmt: skip
    first, c = kept[0, lane], columns[0]
    for i in range(n):
        out[i] = a * s[i] + c * first[i]
    for k in range(1, columns.size):
        own, c = kept[k, lane], columns[k]
        for i in range(n):
            out[i] += c * own[i]


@jit_rows
def _variable(n: int, scale: float, shift: float, xi: FloatArray, x: FloatArray) -> None:
    for i in range(n):
        x[i] = abs(xi[i]) * scale + shift


@jit
def polynomial_of(powers: FloatArray, scale: float, shift: float, xi: FloatArray, out: FloatArray) -> None:
    """A polynomial of `engine.lanes.rows.Lanes` at xi (n,)."""
    x = np.empty(xi.size)
    _variable(xi.size, scale, shift, xi, x)
    polynomial_rows(xi.size, powers, x, out)


@jit
def show(
    k: float, columns: FloatArray, x: FloatArray, first: IntArray, count: int, n: int, kept: FloatArray,
    out: FloatArray,
) -> None:  # fmt: skip
    """k x + columns z at the samples 0 to n - 1, of which each lane has `count` from `first` on, into `out` (n,).

    The last lane reads one more, where the number of samples asks for it.
    """
    for i in range(first.size):
        size = n - first[i] if i + 1 == first.size else min(count, n - first[i])
        if size > 0:
            _of_source_and_modes(size, k, x[first[i] :], columns, i, kept, out[first[i] :])


@jit_rows
def _signed(n: int, xi: FloatArray, bend: FloatArray) -> None:
    """Give N the sign of xi."""
    for i in range(n):
        bend[i] = bend[i] if xi[i] >= 0.0 else -bend[i]


@jit_rows
def _of_area(n: int, q0: float, q: FloatArray, s: FloatArray, out: FloatArray) -> None:
    """A - 1/q0 times the source."""
    for i in range(n):
        out[i] = -q[i] / (q0 * (q0 + q[i])) * s[i]


@jit_rows
def _add(n: int, q: FloatArray, w: FloatArray, a: float, out: FloatArray, b: float, other: FloatArray) -> None:
    """Add a product to two rows."""
    for i in range(n):
        out[i] += a * q[i] * w[i]
        other[i] += b * q[i] * w[i]


@jit_rows
def _by_area(
    n: int, q0: float, kappa: float, k: float, k_xi: float, share: float, slope: FloatArray, q: FloatArray,
    rate: FloatArray, out: FloatArray,
) -> None:  # fmt: skip
    """Add what follows from the source's slope, and from N by xi (`rise_of`), of which `rate` is the part by modes."""
    for i in range(n):
        out[i] += k * slope[i] + share * rise_of(q0, kappa, q[i]) * (rate[i] + k_xi * slope[i])


@jit_rows
def _under_mobile(
    n: int, q0: float, k: float, k_xi: float, share: float, s: FloatArray, slope: FloatArray, u: FloatArray,
    q: FloatArray, steep: FloatArray, rate: FloatArray, out: FloatArray,
) -> None:  # fmt: skip
    """The same with A s for N, by the gap voltage u, whose rate is that by xi over the distance to the fold."""
    for i in range(n):
        inverse, rise = q0 + q[i], steep[i] if u[i] >= 0.0 else -steep[i]
        du = (k_xi * slope[i] + rate[i] * inverse / q0) / (1.0 - (u[i] - k_xi * s[i]) / inverse * rise)
        out[i] += k * slope[i] + share * (slope[i] - s[i] * rise * du / inverse) / inverse


@jit
def flow(
    c: Any, k: float, columns: FloatArray, share: float, x: FloatArray, slope: FloatArray, first: IntArray, count: int,
    n: int, kept: FloatArray, out: FloatArray,
) -> None:  # fmt: skip
    """Rate of k x + columns z + share N at the samples, as `show`; `slope` (n,) is the source's, V/s.

    Under `mobile` A x stands in the place of N, and gap voltages follow the modes in `kept`.
    """
    m, leaks, drives, mobile = c.rates.size, c.tap_s.size, c.feed.shape[1], kept.shape[0] > c.rates.size
    rise, q, xi, w, steep = np.empty(count), np.empty(count), np.empty(count), np.empty(count), np.empty(count)
    bend, one = np.zeros(count), np.ones(count)
    # Shares of source, modes and drives in the rates of the quantity and of xi.
    by_s, by_z, by_g = np.zeros(2), np.zeros((2, m)), np.zeros((2, drives))
    for j in range(m):
        for row, own in enumerate((columns[j], c.shape[j])):
            by_s[row] += own * c.gain[j]
            by_z[row, j] = -own * c.rates[j]
            for t in range(drives):
                by_g[row, t] += own * c.feed[j, t]
    for i in range(first.size):
        size, at = min(count, n - first[i]), first[i]
        if size <= 0:
            break
        s, rate = x[at:], out[at:]
        if mobile:
            copy_to(xi[:size], kept[m, i, :size])
            polynomial_of(c.slope, c.scale, c.shift, xi[:size], steep)
        else:
            _of_source_and_modes(size, c.k, s, c.shape, i, kept, xi)
        polynomial_of(c.area, c.scale, c.shift, xi[:size], q)
        _of_source_and_modes(size, by_s[0], s, by_z[0], i, kept, rate)
        _of_source_and_modes(size, by_s[1], s, by_z[1], i, kept, rise)
        if mobile:
            _of_area(size, c.q0, q, s, bend)
        elif drives > leaks:
            polynomial_of(c.bend, c.scale, c.shift, xi[:size], bend)
            _signed(size, xi, bend)
        if drives > leaks:
            _add(size, one, bend, by_g[0, leaks], rate, by_g[1, leaks], rise)
        for t in range(leaks):
            _of_source_and_modes(size, c.tap_s[t], s, c.taps[t], i, kept, w)
            for j in range(size):
                w[j] += c.bent[t] * bend[j]
            _add(size, q, w, by_g[0, t], rate, by_g[1, t], rise)
        if mobile:
            _under_mobile(size, c.q0, k, c.k, share, s, slope[at:], xi, q, steep, rise, rate)
        else:
            _by_area(size, c.q0, c.kappa, k, c.k, share, slope[at:], q, rise, rate)
