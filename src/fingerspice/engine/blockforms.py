"""What the loops over blocks of a recording work with: constants, form and outputs of a circuit, scratch rows."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fingerspice.base.arrays import FloatArray, IntArray
from fingerspice.engine.blockrows import PAD

# Number of steps in a block; number of step lengths (levels): one sample, and its halvings.
BLOCK, LEVELS = 256, 7
# Largest degree of the polynomial for 1/A.
MOST_DEGREE = 28
# Places of a step besides its ends: its middle, and the two at which the error is measured.
PLACES = (0.5, 0.25, 0.75)
MIDDLE, FIRST_QUARTER, LAST_QUARTER = 0, 1, 2

# Entries of `control`: step length, reference, and as in `engine.readout`.
LEVEL, REFERENCE, PEAK_U, PEAK_F, ERROR_U, ERROR_F, MARGIN, Z, PEAK_Q, ERROR_Q, COLLECTED, U_GAP, ERROR_V = range(13)
# Mean 1/A of the last block, 1/m^2; 0 before the first.
MEAN_Q = 13
# Part of a change that a sweep is expected to leave, over the areas' distance from the reference; 0 if not known.
RATIO = 14
N_CONTROL = 15
# Entries of a row of `Course.checks`, one for each step length. What is left, once it is corrected, of the errors seen
# of gap voltage, force and charge, as shares; what is left of the error of nodes over the error seen of the gap voltage
# (V/V). The largest of these (V), and the number of blocks until the next check, now and after the last one.
OF_GAP, OF_FORCE, OF_NODES, OF_CHARGE, CHECKED, UNTIL_CHECK, WAITED = range(7)
N_SHARES, N_CHECKS = 4, 7
# By their order, errors grow by so much.
OF_ORDER = 16.0
# Share that is assumed at least, and before the first check.
LEAST_SHARE, UNCHECKED = 0.02, 1.0
# Entries of `counters`.
OUTPUT, STEPS, REFUSED, SWEEPS = range(4)
N_COUNTERS = 4


class Form(NamedTuple):
    """A stack around reference areas, and the weights of steps of one length and its halves.

    r references, `LEVELS` step lengths, m modes, T drives g_t, and P projections at the ends and `PLACES` of a step:
    the modes' part of the gap voltage, the taps, and the slowest layer's voltage (see `engine.blockcharge`). The last
    drive is (1/q - 1/q0) U.
    """

    q0: FloatArray  # (r,)
    rates: FloatArray
    gain: FloatArray
    decay: FloatArray  # (r, LEVELS, m): Over a step
    source: FloatArray  # (r, LEVELS, m, 2): Contribution of the source's values at both ends to a mode
    drive: FloatArray  # (r, LEVELS, m, T, 3): Contribution of the drives at 0, 1/2 and 1 to a mode
    feed: FloatArray  # (r, m, T)
    # taps, tap_s (r, P, m): Projections of modes and source
    taps: FloatArray
    tap_s: FloatArray
    # within, within_s, within_g (r, LEVELS, 3, P, m): The same at `PLACES`, from the modes at the start of a step, the
    # source at both ends, and the drives
    within: FloatArray
    within_s: FloatArray
    within_g: FloatArray
    # (r, LEVELS, m, 2): The weights of 1/2 and 1 in the integral of a parabola over a step, in units of its length
    share: FloatArray
    # (r, LEVELS, m, T, 2): Contribution of the interpolation errors at the quarters to the error of a mode
    defect: FloatArray
    area: FloatArray  # (4 k + 1,): 1/A as a polynomial in `scale` |u| + `shift`
    scale: float
    shift: float
    k_gap: float
    area0: float


class Shown(NamedTuple):
    """Constants of the outputs."""

    columns: FloatArray  # (r, C, m): Recorded voltages over k U
    k: FloatArray  # (C,)
    node: FloatArray  # (r, n_node, m): Voltages of the nodes, as `columns`
    slow: FloatArray  # (r, m): The slowest layer's share of each mode (see `Model.slow`)
    # live, project (r, m, m): From modes to live voltages and back
    live: FloatArray
    project: FloatArray
    stress: float  # Force per area and squared gap voltage, Pa/V^2
    kink: FloatArray  # (T,): Derivative by |u_gap| at 0 V of the factor of each drive
    area_kink: float  # dA/d|u| at 0 V, m^2/V
    charge: bool  # Whether the charge is wanted


class Room(NamedTuple):
    """Rows of a block to work in: of the source, modes, increments, projections, drives, and single ones.

    `changed` and `changed_within` (the middle) are drives with their sign reversed as a sweep finds
    them, and then their changes; `further` is what a further sweep would change in the modes, and `own` their
    quadrature error.
    `kept` are the gap voltages, forces, nodes' voltages and charges of a solution to be checked. `where` are the
    numbers of the steps that cross 0 V, and `crossed`, `jumps` and `bends` describe their kinks, one after the other.
    `kinked` is no row: the weights (m, T) of the kink of each drive in each mode.
    """

    s: FloatArray
    s_within: FloatArray
    w: FloatArray
    own: FloatArray
    inc: FloatArray
    other: FloatArray
    end: FloatArray
    within: FloatArray
    g: FloatArray
    g_within: FloatArray
    u: FloatArray
    u_within: FloatArray
    z: FloatArray
    slope: FloatArray
    before: FloatArray
    crossed: FloatArray
    jumps: FloatArray
    bends: FloatArray
    kinked: FloatArray
    changed: FloatArray
    changed_within: FloatArray
    further: FloatArray
    kept: FloatArray
    where: IntArray


def new_room(modes: int, drives: int, projections: int, shown: Shown) -> Room:
    """Room for a form of so many, and for what is shown of it."""
    n = BLOCK + PAD
    kept = 2 + shown.node.shape[1] + int(shown.charge)
    return Room(
        np.zeros(n), np.zeros(n), np.zeros((modes, n)),
        np.zeros((modes, n)), np.zeros((modes, n)), np.zeros(n), np.zeros((projections, n)),
        np.zeros((3, projections, n)), np.zeros((drives, n)), np.zeros((3, drives, n)), np.zeros(n), np.zeros((3, n)),
        np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n),
        np.zeros((modes, drives)), np.zeros((drives, n)), np.zeros((drives, n)), np.zeros((modes, n)),
        np.zeros((kept, n)), np.zeros(n, np.int64),
    )  # fmt: skip


def new_control() -> FloatArray:
    """The entries of `control` at the start of a run."""
    control = np.zeros(N_CONTROL)
    control[MARGIN] = 1.0
    return control


def new_checks() -> FloatArray:
    """Nothing checked yet."""
    checks = np.zeros((LEVELS, N_CHECKS))
    checks[:, :N_SHARES] = UNCHECKED
    return checks
