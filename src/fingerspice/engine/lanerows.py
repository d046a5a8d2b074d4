"""What steps of lanes (`engine.lanestep`) work with: a circuit's constants, and the rows of their weights and state.

Arrays hold one row of `lanes` values after the other. Weights are shared by all lanes, or each lane has its own. What
has to be known to the compiler are the lengths of the tuples in `Marks`.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from fingerspice.base.arrays import FloatArray
from fingerspice.base.compiled import jit_rows, jit_within

# Inner nodes of Lobatto's rule with four nodes, and its weights in a step of length 1.
INNER = (0.5 - 0.1 * 5.0**0.5, 0.5 + 0.1 * 5.0**0.5)
OUTER_WEIGHT, INNER_WEIGHT = 1.0 / 12.0, 5.0 / 12.0
NODES = 4
# Coefficients of the Lagrange polynomials through the nodes, and their slopes at the end of the step.
BASIS = np.ascontiguousarray(np.linalg.inv(np.vander((0.0, *INNER, 1.0), increasing=True)).T)
END_SLOPES = BASIS @ np.array([0.0, 1.0, 2.0, 3.0])
# Weights of a mode up to each later node: decay, both ends of the source, and leaks at all nodes but the last, 0 from
# that node on; then of the cubic through drives at all nodes.
PER_NODE = 3 + NODES - 1
PER_MODE = PER_NODE * (NODES - 1) + NODES
# In a network behind those of all modes and the step's length, for each mode: N at node j and those before, from row
# (j - 1) (j + 2) / 2 on; then a slope at the end of the step. Behind them, for each node, the share of N in xi there,
# and in what 1/A - q0 multiplies.
PER_MODE_BENT = (NODES - 1) * (NODES + 2) // 2 + 1
# Rows of the lanes' state before those of the modes: the source at both ends of a part, and at the last sample.
SOURCES = 3
# Time constants in a step from which on a mode is taken to follow the drives.
FADED = 5.0


class Marks(NamedTuple):
    """Tuples of zeros; their lengths are constants of the compiled code."""

    modes: tuple[int, ...]  # All of them
    active: tuple[int, ...]  # Those that are not passive
    leaks: tuple[int, ...]  # Drives but N
    # bend, mobile: One entry if N is a drive, or if the charge law is `mobile`; or none
    bend: tuple[int, ...]
    mobile: tuple[int, ...]
    lanes: tuple[int, ...]
    own: tuple[int, ...]  # One entry if each lane has its own weights, or none


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
    fed: int  # What the leaks feed to each mode at the nodes
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
    g = xi + NODES
    fed = g + NODES * drives
    w = fed + NODES * m
    scratch = w + 2 * leaks
    q = scratch + 5 + NODES + drives
    more = m + drives if drives > leaks else 3 if len(marks.mobile) > 0 else 0
    return Rows(xi, g, fed, w, scratch, q, q + 3, q + 3, q + 4, q + 3 + more if more > 0 else q)


places = jit_within(rows_of)


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


@jit_within
def rise_of(q0: float, kappa: float, q: float) -> float:
    """dN/dxi where 1/A = q0 + q: e / (1 + kappa e), e = A - 1/q0."""
    return -q / (q0 * (q0 + q) - kappa * q)
