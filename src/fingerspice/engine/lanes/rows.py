"""What steps of lanes (`engine.lanes.step`) work with: a circuit's constants, and the rows of their weights and state.

Arrays hold one row of `lanes` values after the other. Weights are shared by all lanes, or each lane has its own. What
has to be known to the compiler are the lengths of the tuples in `Marks`.

Weights follow from the lengths of the steps. Steps with the area held are here, too.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from fingerspice.base.arrays import FloatArray, IntArray
from fingerspice.base.compiled import jit, jit_rows, jit_within_rows
from fingerspice.numerics.modes import copy_to

# Lobatto's rules with three nodes (Simpson's) and with four, in a step of length 1: their nodes, weights, and the
# coefficients of the Lagrange polynomials through the nodes, one row each. The first rule's fourth node has no use.
INNER = (0.5 - 0.1 * 5.0**0.5, 0.5 + 0.1 * 5.0**0.5)
PLACES = np.array([[0.0, 0.5, 1.0, 2.0], [0.0, *INNER, 1.0]])
WEIGHTS = np.array([[1.0, 4.0, 1.0, 0.0], [0.5, 2.5, 2.5, 0.5]]) / 6.0
# Networks always take the longer one.
NODES, _POWERS = 4, (np.vander(PLACES[n - 3, :n], increasing=True) for n in (3, 4))
BASIS = np.ascontiguousarray([np.pad(np.linalg.inv(x).T, (0, NODES - len(x))) for x in _POWERS])
END_SLOPES = BASIS[1] @ np.array([0.0, 1.0, 2.0, 3.0])
# Rows of the lanes' state before those of the modes: the source at both ends of a part, and at the last sample.
SOURCES = 3
# Time constants in a step from which on a mode is taken to follow the drives.
FADED = 5.0
# Time constants in a step from which on a mode's response to kinks is computed in closed form in a stack.
QUICK = 0.25


class Marks(NamedTuple):
    """Tuples of zeros; their lengths are constants of the compiled code."""

    modes: tuple[int, ...]  # All of them
    active: tuple[int, ...]  # Those that are not passive
    inner: tuple[int, ...]  # Nodes within a step
    leaks: tuple[int, ...]  # Drives but N
    # bend, mobile: One entry if there is a drive beside the leaks (N in a network, or A - 1/q0 times the source under
    # `mobile`), and under `mobile`; or none
    bend: tuple[int, ...]
    mobile: tuple[int, ...]
    lanes: tuple[int, ...]
    own: tuple[int, ...]  # One entry if each lane has its own weights, or none


class StackMarks(Marks):
    """Of a stack under `local`."""


class MobileMarks(Marks):
    """Of a stack under `mobile`."""


class NetworkMarks(Marks):
    """Of a network."""


class Lanes(NamedTuple):
    """Constants of a circuit in this form, with T drives, of which L are leaks."""

    rates: FloatArray  # (m,): 1/s
    gain: FloatArray  # (m,)
    shape: FloatArray  # (m,): V/V
    k: float  # V/V or V/A
    taps: FloatArray  # (L, m)
    # tap_s, bent (L,)
    tap_s: FloatArray
    bent: FloatArray
    feed: FloatArray  # (m, T)
    # area, slope, bend (4 j + 1,): Polynomials in `scale` |xi| + `shift`, or |u| under `mobile`: 1/A - q0 (1/m^2), its
    # derivative, and N (V m^2) at positive xi
    area: FloatArray
    slope: FloatArray
    bend: FloatArray
    scale: float
    shift: float
    q0: float
    kappa: float  # 1/m^2; 0 in a stack
    kinks: FloatArray  # (T,): Derivatives by |xi| at 0 V of the factors of the drives; of N, of N / xi
    # rest, steep: 1/A - q0 (1/m^2) at 0 V, and its derivative
    rest: float
    steep: float
    fast: int  # The mode through which N acts fastest on xi


class Rows(NamedTuple):
    """Numbers of the first rows of the state's parts."""

    xi: int  # At the nodes
    g: int  # Drives at the nodes
    w: int  # What 1/A - q0 multiplies at the start, and at the latest node
    scratch: int
    q: int  # 1/A - q0 at the latest node, its derivative, and in a network dN/dxi where fading modes soon are, or B
    # In a network:
    gone: int  # What modes have beside where they soon are, and by which this changes the drives
    # Under `mobile`:
    fold: int  # Least distance to the fold, less 1, with its sign reversed
    flat: int  # xi with the area at 0 V at the start, and at the latest node
    end: int


def rows_of(marks: Any) -> Rows:
    """The order of the state's rows: the source's and the modes', then these."""
    m, leaks, drives = len(marks.modes), len(marks.leaks), len(marks.leaks) + len(marks.bend)
    xi = SOURCES + m
    g = xi + len(marks.inner) + 2
    w = g + (len(marks.inner) + 2) * drives
    scratch = w + 2 * leaks
    q = scratch + 5 + drives
    more = 3 if len(marks.mobile) > 0 else m + drives if drives > leaks else 0
    return Rows(xi, g, w, scratch, q, q + 3, q + 3, q + 4, q + 3 + more if more > 0 else q)


places = jit_within_rows(rows_of)


class Weighed(NamedTuple):
    """Rows of the weights of a step.

    Each mode has its decay; the time for which what begins within the step acts at its end, as a cubic in where it
    begins, unless the mode is quick; its response to the source at both ends, and to each drive at each node; in a
    network also to what N has beside the cubic, by its slope at the end. Behind the row of the step's length, each
    later node has xi, and what 1/A - q0 multiplies in each leak: by the source at both ends, by the active modes, and
    by each drive at each node but the last; in a network also by N at this node.
    """

    mode: int  # Rows of a mode
    length: int
    node: int  # First row of those of nodes
    one: int  # Rows of one quantity at a node
    end: int


def weighed(modes: int, active: int, inner: int, leaks: int, bend: int) -> Weighed:
    """The rows of the weights with so many modes, active modes, nodes within a step, leaks, and 1 for a network."""
    drives, nodes = leaks + bend, inner + 2
    mode, one = nodes + 3 + nodes * drives + bend, 2 + active + (nodes - 1) * drives + bend
    length = modes * mode
    return Weighed(mode, length, length + 1, one, length + 1 + (nodes - 1) * (1 + leaks) * one)


@jit_within_rows
def weights_of(marks: Any) -> Weighed:
    """The same for the marks of compiled code."""
    return _weighed(len(marks.modes), len(marks.active), len(marks.inner), len(marks.leaks), len(marks.bend))


_weighed = jit_within_rows(weighed)


@jit_within_rows
def project(marks: Any, c: Any, place: int, to: int, state: FloatArray) -> None:
    """xi, into row `to`, and what 1/A - q0 multiplies but for N, from the modes and the source at one end."""
    lanes, active, leaks, at = len(marks.lanes), len(marks.active), len(marks.leaks), places(marks)
    for i in range(lanes):
        source = state[place * lanes + i]
        xi = c.k * source
        for k in range(active):
            xi += c.shape[k] * state[(SOURCES + k) * lanes + i]
        state[to * lanes + i] = xi
        for t in range(leaks):
            w = c.tap_s[t] * source
            for k in range(active):
                w += c.taps[t, k] * state[(SOURCES + k) * lanes + i]
            state[(at.w + leaks + t) * lanes + i] = w


@jit_rows
def polynomial_rows(n: int, powers: FloatArray, x: FloatArray, out: FloatArray) -> None:
    """A polynomial of degree 4 k at x (n,): a tenth faster in a step than `area_rows`, which has no row of x."""
    last = powers.size - 1
    for i in range(n):
        out[i] = powers[last]
    for j in range(last - 1, 0, -4):
        c3, c2, c1, c0 = powers[j], powers[j - 1], powers[j - 2], powers[j - 3]
        for i in range(n):
            out[i] = (((out[i] * x[i] + c3) * x[i] + c2) * x[i] + c1) * x[i] + c0


@jit_within_rows
def rise_of(q0: float, kappa: float, q: float) -> float:
    """dN/dxi where 1/A = q0 + q: e / (1 + kappa e), e = A - 1/q0."""
    return -q / (q0 * (q0 + q) - kappa * q)


# Coefficients from x on of the quartic that is 0 at the nodes and has the slope 1 at the end of the step.
_QUARTIC_POWERS: list[float] = np.poly(np.array([0.0, *INNER, 1.0]))[3::-1].tolist()
_QUARTIC = np.array([_QUARTIC_POWERS]) / (np.array(_QUARTIC_POWERS) @ np.arange(1.0, NODES + 1.0))


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
        over, upper, lower = 1.0 / j, m[j], m[j - 1]
        for i in range(n):
            lower[i] = (1.0 - rate * h[i] * upper[i]) * over
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
        for j in range(top + 1):
            times, lower, upper = max(j, 1), m[j - 1] if j > 0 else decay, m[j]
            for i in range(n):
                y = rate * h[i]
                upper[i] = (1.0 - times * lower[i]) / y if y > _EARLY else upper[i]


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
def along(
    c: Any, h: FloatArray, x: FloatArray, first: IntArray, count: int, z: FloatArray, width: int, moves: FloatArray
) -> None:  # fmt: skip
    """Advance modes z (m, lanes) by `count` samples with the area at its reference.

    h has the distance (s) from each sample to the next, or one for all. The largest moves of the source in windows
    of `width` samples go into `moves` (windows, lanes).
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
            own, mode = rows[k], z[k]
            if each or t == 0:
                _moments(1, c.rates[k], length, m)
                _until(wide, c.rates[k], c.gain[k], 1.0, length, m[0], m[1], own[0], own[1], own[2])
            for i in range(lanes):
                mode[i] = own[0, i * each] * mode[i] + own[1, i * each] * before[i] + own[2, i * each] * after[i]
        if t // width < len(moves):
            most, begins = moves[t // width], t % width == 0
            for i in range(lanes):
                move = abs(after[i] - before[i])
                most[i] = move if begins or move > most[i] else most[i]
        before, after = after, before
