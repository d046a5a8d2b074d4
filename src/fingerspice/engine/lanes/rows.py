"""What steps of lanes (`engine.lanes.step`) work with: a circuit's constants, and the rows of their weights and state.

Arrays hold one row of `lanes` values after the other. Weights are shared by all lanes, or each lane has its own. What
has to be known to the compiler are the lengths of the tuples in `Marks`.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from fingerspice.base.arrays import FloatArray
from fingerspice.base.compiled import jit_rows, jit_within_rows

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
