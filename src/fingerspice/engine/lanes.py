"""Spans of samples in lanes (`engine.lanestep`), weights of their steps, and what is read from states at samples."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from fingerspice.base.arrays import FloatArray, IntArray
from fingerspice.base.compiled import jit, jit_rows
from fingerspice.engine.blockrows import add, area_rows, of_source_and_modes, sign_as
from fingerspice.engine.lanerows import BASIS, INNER, NODES, PER_MODE, PER_MODE_BENT, SOURCES, rise_of
from fingerspice.engine.lanestep import step

# Samples that are read and written at once.
TILE = 16
# Coefficients from x on of the quartic that is 0 at the nodes and has the slope 1 at the end of the step.
_POWERS: list[float] = np.poly(np.array([0.0, *INNER, 1.0]))[3::-1].tolist()
_QUARTIC = np.array(_POWERS) / (np.array(_POWERS) @ np.arange(1.0, NODES + 1.0))


def _through(nodes: tuple[float, ...], until: float) -> FloatArray:
    """Coefficients of the Lagrange polynomials through nodes, for x from 0 at 0 to 1 at `until`, times `until`."""
    found = np.linalg.inv(np.vander(np.array(nodes) / until, increasing=True)).T
    return np.pad(until * found, ((0, 0), (0, NODES - len(nodes))))


# Weights in a network at each later node: of the leaks, which are known at the nodes before, and of N.
_PLACES = (0.0, *INNER, 1.0)
_PREDICTED = np.ascontiguousarray(np.vstack([
    _through(_PLACES[:count], _PLACES[node]) for node in range(1, NODES) for count in (node, node + 1)
]))  # fmt: skip
# Largest rate times length for which moments follow from the highest one, and that from its series.
_EARLY = 1.0


@jit_rows
def _series(n: int, share: float, h: FloatArray, m: FloatArray) -> None:
    for i in range(n):
        m[i] = 1.0 - share * h[i] * m[i]


@jit_rows
def _below(n: int, rate: float, j: int, h: FloatArray, m: FloatArray, lower: FloatArray) -> None:
    over = 1.0 / j
    for i in range(n):
        lower[i] = (1.0 - rate * h[i] * m[i]) * over


@jit_rows
def _decays(n: int, rate: float, h: FloatArray, out: FloatArray) -> None:
    """exp(-rate h), by its series at a 64th of the exponent; 0 from an exponent of 40 on."""
    for i in range(n):
        out[i] = 1.0
    for j in range(16, 0, -1):
        share = rate / (64.0 * j)
        for i in range(n):
            out[i] = 1.0 - min(share * h[i], 0.625 / j) * out[i]
    for _ in range(6):
        for i in range(n):
            out[i] *= out[i]


@jit_rows
def _late(n: int, j: int, rate: float, h: FloatArray, lower: FloatArray, m: FloatArray) -> None:
    for i in range(n):
        y = rate * h[i]
        m[i] = (1.0 - j * lower[i]) / y if y > _EARLY else m[i]


@jit
def _moments(top: int, rate: float, h: FloatArray, m: FloatArray) -> None:
    """Integrals of exp(-y (1 - x)) x^j over [0, 1] for y = rate h (n,), into the rows j = 0 to `top` of m."""
    n, longest = h.size, rate * h.max()
    terms, term = 1, 1.0
    while term > 1e-17 and terms < 24:
        term *= min(longest, _EARLY) / (top + 1 + terms)
        terms += 1
    highest = m[top]
    highest[:] = 1.0
    for j in range(terms, 0, -1):
        _series(n, rate / (top + 1 + j), h, highest)
    highest *= 1.0 / (top + 1)
    for j in range(top, 0, -1):
        _below(n, rate, j, h, m[j], m[j - 1])
    if longest > _EARLY:
        decay = m[NODES + 1]
        _decays(n, rate, h, decay)
        _late(n, 1, rate, h, decay, m[0])
        for j in range(1, top + 1):
            _late(n, j, rate, h, m[j - 1], m[j])


@jit_rows
def _until(
    n: int, rate: float, gain: float, at: float, h: FloatArray, m0: FloatArray, m1: FloatArray, decay: FloatArray,
    first: FloatArray, last: FloatArray, held: FloatArray,
) -> None:  # fmt: skip
    """Weights up to the place `at`: decay, both ends of the source, and a drive that is held."""
    for i in range(n):
        length = at * h[i]
        decay[i] = 1.0 - rate * length * m0[i]
        first[i] = gain * length * (m0[i] - at * m1[i])
        last[i] = gain * length * at * m1[i]
        held[i] = length * m0[i]


@jit_rows
def _drive(n: int, c: FloatArray, h: FloatArray, m: FloatArray, out: FloatArray) -> None:
    for i in range(n):
        out[i] = h[i] * (c[0] * m[0, i] + c[1] * m[1, i] + c[2] * m[2, i] + c[3] * m[3, i])


@jit
def _shares(c: Any, weights: FloatArray) -> None:
    """Shares of N at a node in xi, and in what 1/A - q0 multiplies, from its weights in all modes."""
    count, leaks = c.rates.size, c.tap_s.size
    first = count * (PER_MODE + PER_MODE_BENT) + 1
    weights[first:] = 0.0
    for node in range(1, NODES):
        for k in range(count):
            own = weights[count * PER_MODE + 1 + k * PER_MODE_BENT + node * node - 1 + 2 * node]
            for i in range(own.size):
                by = c.feed[k, leaks] * own[i]
                weights[first + (node - 1) * (1 + leaks), i] += c.shape[k] * by
                for t in range(leaks):
                    weights[first + (node - 1) * (1 + leaks) + 1 + t, i] += c.taps[t, k] * by


@jit
def weigh(c: Any, h: FloatArray, weights: FloatArray) -> None:
    """Weights of steps of the lengths h (n,), into the rows (n,) of `weights`, in the order of `lanestep`."""
    rates, n, m, count = c.rates, h.size, np.empty((NODES + 2, h.size)), c.rates.size
    bent = c.feed.shape[1] > c.tap_s.size
    for k in range(count):
        own, more = weights[k * PER_MODE :], weights[count * PER_MODE + 1 + k * PER_MODE_BENT :]
        for node in range(NODES - 1):
            at, rows = INNER[node] if node < NODES - 2 else 1.0, own[4 * node :]
            top = NODES if bent else 1 if node < NODES - 2 else NODES - 1
            _moments(top, rates[k] * at, h, m)
            _until(n, rates[k], c.gain[k], at, h, m[0], m[1], rows[0], rows[1], rows[2], rows[3])
            if bent:
                first = (node + 1) ** 2 - 1
                for j in range(2 * node + 3):
                    _drive(n, _PREDICTED[first + j], h, m, more[first + j])
        for j in range(NODES):
            _drive(n, BASIS[j], h, m, own[4 * (NODES - 1) + j])
        if bent:
            _drive(n, _QUARTIC, h, m[1:], more[NODES**2 - 1])
    weights[count * PER_MODE] = h
    if bent:
        _shares(c, weights)


@jit
def begin(marks: Any, c: Any, still: FloatArray, starts: FloatArray, source: FloatArray, state: FloatArray) -> None:
    """Put the lanes at the modes `starts` (m, lanes) under a source (lanes,).

    `still` are the weights of a step of length 0.
    """
    lanes, m = len(marks.lanes), len(marks.modes)
    state[:] = 0.0
    for i in range(lanes):
        state[2 * lanes + i] = source[i]
        for k in range(m):
            state[(SOURCES + k) * lanes + i] = starts[k, i]
    step(marks, c, still.reshape(-1), state, source, 0.0, 1.0)


@jit
def span(
    marks: Any, c: Any, weights: FloatArray, h: FloatArray, x: FloatArray, first: IntArray, count: int, parts: int,
    tol: float, state: FloatArray, kept: FloatArray, left: FloatArray,
) -> bool:  # fmt: skip
    """Advance the lanes by `count` samples, each in `parts` steps, and keep the modes at the samples.

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
    kept : ndarray, shape (m, lanes, count + 1)
    left : ndarray, shape (m,)
        Largest changes of the active modes where the lanes stop; left alone if they do not.

    Returns
    -------
    bool
        Whether the lanes stopped.
    """
    lanes, m, active = len(marks.lanes), len(marks.modes), len(marks.active)
    after, found = np.empty(TILE * lanes), np.empty(TILE * m * lanes)
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
                weigh(c, length, weights)
            for p in range(parts):
                step(marks, c, flat, state, after[k * lanes :], p / parts, (p + 1) / parts)
            for i in range(m * lanes):
                found[k * m * lanes + i] = state[SOURCES * lanes + i]
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
        for row in range(m):
            for i in range(lanes):
                for k in range(size):
                    kept[row, i, done + 1 + k] = found[(k * m + row) * lanes + i]
        done += size
        if stops:
            return True
    return False


@jit
def along(weights: FloatArray, x: FloatArray, first: IntArray, count: int, z: FloatArray) -> None:
    """Advance modes z (m, lanes) by `count` samples with the area at its reference and steps of one length."""
    lanes, now, after = first.size, np.empty(first.size), np.empty(first.size)
    for i in range(lanes):
        now[i] = x[first[i]]
    for t in range(count):
        for i in range(lanes):
            after[i] = x[first[i] + t + 1]
        for k in range(z.shape[0]):
            p = k * PER_MODE + 4 * (NODES - 2)
            decay, before, last = weights[p, 0], weights[p + 1, 0], weights[p + 2, 0]
            for i in range(lanes):
                z[k, i] = decay * z[k, i] + before * now[i] + last * after[i]
        for i in range(lanes):
            now[i] = after[i]


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
            of_source_and_modes(size, k, x[first[i] :], columns, kept[:, i], out[first[i] :])


@jit_rows
def _add_product(n: int, a: float, q: FloatArray, g: FloatArray, out: FloatArray) -> None:
    for i in range(n):
        out[i] += a * q[i] * g[i]


@jit_rows
def _by_area(
    n: int, q0: float, kappa: float, k: float, k_xi: float, share: float, slope: FloatArray, q: FloatArray,
    rate: FloatArray, out: FloatArray,
) -> None:  # fmt: skip
    """Add what follows from the source's slope, and from N by xi (`rise_of`), of which `rate` is the part by modes."""
    for i in range(n):
        out[i] += k * slope[i] + share * rise_of(q0, kappa, q[i]) * (rate[i] + k_xi * slope[i])


@jit
def flow(
    c: Any, k: float, columns: FloatArray, share: float, x: FloatArray, slope: FloatArray, first: IntArray, count: int,
    n: int, kept: FloatArray, out: FloatArray,
) -> None:  # fmt: skip
    """Rate of k x + columns z + share N at the samples, as `show`; `slope` (n,) is the source's, V/s."""
    m, leaks, drives = c.rates.size, c.tap_s.size, c.feed.shape[1]
    rise, q, g, bend = np.empty(count), np.empty(count), np.empty(count), np.zeros(count)
    # Shares of source, modes and drives in the rates of the quantity and of xi.
    by_s, by_z, by_g = np.zeros(2), np.zeros((2, m)), np.zeros((2, drives))
    for j in range(m):
        for row, own in enumerate((columns[j], c.shape[j])):
            by_s[row] += own * c.gain[j]
            by_z[row, j] = -own * c.rates[j]
            for t in range(drives):
                by_g[row, t] += own * c.feed[j, t]
    for lane in range(first.size):
        size, at = min(count, n - first[lane]), first[lane]
        if size <= 0:
            break
        z, s, rate = kept[:, lane], x[at:], out[at:]
        of_source_and_modes(size, c.k, s, c.shape, z, g)
        area_rows(size, c.area, c.scale, c.shift, 0.0, g, q)
        if drives > leaks:
            area_rows(size, c.bend, c.scale, c.shift, 0.0, g, bend)
            sign_as(size, g, bend)
        of_source_and_modes(size, by_s[0], s, by_z[0], z, rate)
        of_source_and_modes(size, by_s[1], s, by_z[1], z, rise)
        if drives > leaks:
            add(size, by_g[0, leaks], bend, rate)
            add(size, by_g[1, leaks], bend, rise)
        for t in range(leaks):
            of_source_and_modes(size, c.tap_s[t], s, c.taps[t], z, g)
            add(size, c.bent[t], bend, g)
            _add_product(size, by_g[0, t], q, g, rate)
            _add_product(size, by_g[1, t], q, g, rise)
        _by_area(size, c.q0, c.kappa, k, c.k, share, slope[at:], q, rise, rate)


@jit
def busiest(x: FloatArray, first: IntArray, count: int, width: int, n: int, place: IntArray) -> None:
    """Where x moves most between two samples of each lane: the first sample of one of its windows of `width`.

    Windows end before sample n; -1 where no window does.
    """
    for i in range(first.size):
        most, place[i] = -1.0, -1
        for at in range(first[i], min(first[i] + count, n) - width + 1, width):
            moves = 0.0
            for j in range(at, at + width):
                moves = max(moves, abs(x[j + 1] - x[j]))
            if moves > most:
                most, place[i] = moves, at - first[i]


@jit
def within(
    marks: Any, c: Any, still: FloatArray, starts: FloatArray, x: FloatArray,
    to: FloatArray, h: FloatArray, parts: int, state: FloatArray, out: FloatArray,
) -> None:  # fmt: skip
    """Modes (m, n) after steps of lengths h (n,) from `starts` (m, n), in `parts`; the source goes from x to `to`."""
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
        weigh(c, length, weights)
        for p in range(parts):
            step(marks, c, weights.reshape(-1), state, after, p / parts, (p + 1) / parts)
        for i in range(min(lanes, h.size - first)):
            for k in range(m):
                out[k, first + i] = state[(SOURCES + k) * lanes + i]
