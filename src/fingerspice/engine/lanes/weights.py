"""Weights of steps of lanes (`engine.lanes.step`) by their lengths, and steps with the area held."""

from __future__ import annotations

from typing import Any

import numpy as np

from fingerspice.base.arrays import FloatArray, IntArray
from fingerspice.base.compiled import jit, jit_rows, jit_within
from fingerspice.engine.lanes.rows import BASIS, FADED, INNER, NODES, PLACES, QUICK, weighed
from fingerspice.numerics.small import copy_to

# Coefficients from x on of the quartic that is 0 at the nodes and has the slope 1 at the end of the step.
_POWERS: list[float] = np.poly(np.array([0.0, *INNER, 1.0]))[3::-1].tolist()
_QUARTIC = np.array([_POWERS]) / (np.array(_POWERS) @ np.arange(1.0, NODES + 1.0))


def _through(nodes: tuple[float, ...], until: float) -> FloatArray:
    """Coefficients of the Lagrange polynomials through nodes, for x from 0 at 0 to 1 at `until`, times `until`."""
    found = np.linalg.inv(np.vander(np.array(nodes) / until, increasing=True)).T
    return np.pad(until * found, ((0, 0), (0, NODES - len(nodes))))


# At each later node weights by rule: of the leaks, which are known at the nodes before, and of the last drive.
_LEAKS, _BENDS = (
    np.ascontiguousarray([
        np.vstack([_through(tuple(places[: j + more]), float(places[j])) for j in range(1, NODES)])
        for places in PLACES
    ])
    for more in (0, 1)
)  # fmt: skip
# The first prediction misses the slope of the leaks. With four nodes the second one is given the opposite error, so
# that both cancel at the end of the step, whose method is then of third order.
_LEAKS[1, 1:3, 0] += np.array([-0.5, 0.5]) * INNER[0]
_weighed = jit_within(weighed)
# Largest rate times length for which moments follow from the highest one, and that from its series.
_EARLY = 1.0


@jit_rows
def _moments(top: int, rate: float, h: FloatArray, m: FloatArray) -> None:
    """Integrals of exp(-y (1 - x)) x^j over [0, 1] for y = rate h (n,), into the rows j = 0 to `top` of m.

    Behind them exp(-y) takes the last row of m, if some y is large: by its series at a 64th of y; 0 from 40 on.
    """
    n, longest, over = h.size, rate * h.max(), 1.0 / (top + 1)
    terms, term = 1, 1.0
    while term > 1e-17 and terms < 24:
        term *= min(longest, _EARLY) / (top + 1 + terms)
        terms += 1
    highest, decay = m[top], m[NODES + 1]
    for i in range(n):
        highest[i] = 1.0
    for j in range(terms, 0, -1):
        share = rate / (top + 1 + j)
        for i in range(n):
            highest[i] = 1.0 - share * h[i] * highest[i]
    for i in range(n):
        highest[i] *= over
    for j in range(top, 0, -1):
        _below(n, rate, j, h, m[j], m[j - 1])
    if longest > _EARLY:
        for i in range(n):
            decay[i] = 1.0
        for j in range(16, 0, -1):
            share = rate / (64.0 * j)
            for i in range(n):
                decay[i] = 1.0 - min(share * h[i], 0.625 / j) * decay[i]
        for _ in range(6):
            for i in range(n):
                decay[i] *= decay[i]
        _late(n, 1, rate, h, decay, m[0])
        for j in range(1, top + 1):
            _late(n, j, rate, h, m[j - 1], m[j])


@jit_rows
def _below(n: int, rate: float, j: int, h: FloatArray, m: FloatArray, lower: FloatArray) -> None:
    over = 1.0 / j
    for i in range(n):
        lower[i] = (1.0 - rate * h[i] * m[i]) * over


@jit_rows
def _late(n: int, j: int, rate: float, h: FloatArray, lower: FloatArray, m: FloatArray) -> None:
    for i in range(n):
        y = rate * h[i]
        m[i] = (1.0 - j * lower[i]) / y if y > _EARLY else m[i]


@jit_rows
def _until(
    n: int, rate: float, gain: float, at: float, h: FloatArray, m0: FloatArray, m1: FloatArray, decay: FloatArray,
    first: FloatArray, last: FloatArray,
) -> None:  # fmt: skip
    """Weights up to the place `at`: decay, and both ends of the source."""
    for i in range(n):
        length = at * h[i]
        decay[i] = 1.0 - rate * length * m0[i]
        first[i] = gain * length * (m0[i] - at * m1[i])
        last[i] = gain * length * at * m1[i]


@jit_rows
def _late_times(n: int, inner: int, rate: float, quick: float, h: FloatArray, own: FloatArray) -> None:
    """What multiplies powers of a kink's place: the polynomial through the decays to the end, times h; 0 if quick."""
    basis = BASIS[inner - 1]
    for i in range(n):
        d0, d1, d2 = own[0, i], own[1, i], own[2, i] if inner > 1 else 1.0
        length = h[i] if rate * h[i] < quick else 0.0
        for p in range(inner + 2):
            own[1 + p, i] = length * (d0 * basis[0, p] + d1 * basis[1, p] + d2 * basis[2, p] + basis[3, p])


@jit_rows
def _drive(n: int, c: FloatArray, h: FloatArray, m: FloatArray, out: FloatArray) -> None:
    """Weights of drives by the coefficients of their polynomials, one row of `c` each, into rows of `out`."""
    for r in range(c.shape[0]):
        c0, c1, c2, c3 = c[r, 0], c[r, 1], c[r, 2], c[r, 3]
        for i in range(n):
            out[r, i] = h[i] * (c0 * m[0, i] + c1 * m[1, i] + c2 * m[2, i] + c3 * m[3, i])


@jit_rows
def _gather(
    k: int, j: int, active: int, inner: int, shape: FloatArray, taps: FloatArray, feed: FloatArray, found: FloatArray,
    weights: FloatArray,
) -> None:  # fmt: skip
    """Add what mode k does to the quantities at node j, by its weights there.

    `found` has the decay, the weights of the source, of the leaks at the nodes before, and of N at these and itself.
    """
    n, leaks, drives, last = found.shape[1], taps.shape[0], feed.shape[1], inner + 1
    for p in range(1 + leaks):
        by = shape[k] if p == 0 else taps[p - 1, k]
        for i in range(n):
            weights[p, 0, i] += by * found[1, i]
            weights[p, 1, i] += by * found[2, i]
            weights[p, 2 + k, i] = by * found[0, i]
        for node in range(j):
            for t in range(leaks):
                share, row = by * feed[k, t], 2 + active + node * drives + t
                for i in range(n):
                    weights[p, row, i] += share * found[3 + node, i]
        for node in range((j + 1) * (drives - leaks)):
            share, row = by * feed[k, leaks], 2 + active + (node * drives + leaks if node < j else last * drives)
            for i in range(n):
                weights[p, row, i] += share * found[3 + j + node, i]


@jit
def weigh(c: Any, active: int, inner: int, h: FloatArray, weights: FloatArray) -> None:
    """Weights of steps of the lengths h (n,), into the rows (n,) of `weights` (`engine.lanes.rows.Weighed`)."""
    rates, n, m, count, leaks = c.rates, h.size, np.zeros((NODES + 2, h.size)), c.rates.size, c.tap_s.size
    drives, found = c.feed.shape[1], np.empty((3 + 2 * NODES, h.size))
    bent, nodes, places = drives - leaks, inner + 2, PLACES[inner - 1]
    rows = _weighed(count, active, inner, leaks, bent)
    at_nodes = weights[rows.node :].reshape((nodes - 1, 1 + leaks, rows.one, n))
    at_nodes[:] = 0.0
    for j in range(1, nodes):
        at = places[j]
        for p in range(1 + leaks):
            by = c.k if p == 0 else c.tap_s[p - 1]
            at_nodes[j - 1, p, 0] = by * (1.0 - at)
            at_nodes[j - 1, p, 1] = by * at
    for k in range(count):
        own = weights[k * rows.mode :]
        for j in range(1, nodes):
            at = places[j]
            _moments(NODES if bent > 0 else j, rates[k] * at, h, m)
            _until(n, rates[k], c.gain[k], at, h, m[0], m[1], found[0], found[1], found[2])
            copy_to(own[nodes - 1 - j], found[0])
            if k < active:
                _drive(n, _LEAKS[inner - 1][j * (j - 1) // 2 :][:j], h, m, found[3:])
                if bent > 0:
                    _drive(n, _BENDS[inner - 1][(j - 1) * (j + 2) // 2 :][: j + 1], h, m, found[3 + j :])
                _gather(k, j, active, inner, c.shape, c.taps, c.feed, found, at_nodes[j - 1])
        _late_times(n, inner, rates[k], FADED if c.kappa > 0.0 else QUICK, h, own)
        copy_to(own[nodes + 1 : nodes + 3], found[1:3])
        _drive(n, BASIS[inner - 1][:nodes], h, m, found)
        for j in range(nodes * drives):
            for i in range(n):
                own[nodes + 3 + j, i] = c.feed[k, j % drives] * found[j // drives, i]
        if bent > 0:
            _drive(n, _QUARTIC, h, m[1:], found)
            for i in range(n):
                own[rows.mode - 1, i] = c.feed[k, leaks] * found[0, i]
    copy_to(weights[rows.length], h)


@jit_rows
def _advanced(n: int, each: int, own: FloatArray, before: FloatArray, after: FloatArray, z: FloatArray) -> None:
    """A mode at the end of a step by the weights of `_until`, which all share where `each` is 0."""
    for i in range(n):
        z[i] = own[0, i * each] * z[i] + own[1, i * each] * before[i] + own[2, i * each] * after[i]


@jit
def along(c: Any, h: FloatArray, x: FloatArray, first: IntArray, count: int, z: FloatArray) -> None:
    """Advance modes z (m, lanes) by `count` samples with the area at its reference.

    h has the distance (s) from each sample to the next, or one for all.
    """
    lanes, each = first.size, 1 if h.size > 1 else 0
    wide = lanes if each else 1
    m, length, rows = np.empty((NODES + 2, wide)), np.full(wide, h[0]), np.empty((z.shape[0], 3, wide))
    before, after = x[first], np.empty(lanes)
    for t in range(count):
        if each:
            for i in range(lanes):
                length[i] = h[first[i] + t]
        for i in range(lanes):
            after[i] = x[first[i] + t + 1]
        for k in range(z.shape[0]):
            own = rows[k]
            if each or t == 0:
                _moments(1, c.rates[k], length, m)
                _until(wide, c.rates[k], c.gain[k], 1.0, length, m[0], m[1], own[0], own[1], own[2])
            _advanced(lanes, each, own, before, after, z[k])
        before, after = after, before
