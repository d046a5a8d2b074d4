"""Error of the voltages of a stack's nodes over a step."""

from __future__ import annotations

import numpy as np

from fingerspice.base.arrays import FloatArray
from fingerspice.base.compiled import jit, jit_rows
from fingerspice.engine.exponential import between
from fingerspice.engine.readout import N_PLACES, row_of
from fingerspice.engine.work import DQ, SOURCE, X_GAP, Q
from fingerspice.numerics.lobatto import ROWS


@jit
def node_error(
    mobile: bool, area0: float, node: FloatArray, k_node: FloatArray, gap: FloatArray, w: FloatArray, r: FloatArray,
    places: FloatArray,
) -> float:  # fmt: skip
    """Largest error of any node's voltage over a step (V) from that of the modes; see `assess`.

    Under `mobile` the voltages are the modes times 1/A: their error contains that of A, and the interpolation error of
    the product.
    """
    if not mobile:
        return _linear_error(node, k_node, r[SOURCE], places)
    own, missed, values = np.zeros((places.shape[0], N_PLACES)), np.zeros(N_PLACES), np.zeros(ROWS)
    moved = np.zeros(N_PLACES)
    for p in range(N_PLACES):
        for k in range(gap.size):
            own[k, p] = area0 * r[Q, row_of(p)] * places[k, p]
    for k in range(gap.size):
        missed[1], missed[2], missed[3] = between(w[k])
        for p in range(N_PLACES):
            own[k, p] -= area0 * r[Q, row_of(p)] * missed[p]
            moved[p] += gap[k] * own[k, p]
    for p in range(N_PLACES):
        row = row_of(p)
        moved[p] *= area0 * r[DQ, row] / max(1.0 - area0 * r[X_GAP, row] * r[DQ, row], 1e-12)
    worst = 0.0
    for i in range(k_node.size):
        for j in range(ROWS):
            values[j] = 0.0
            for k in range(gap.size):
                values[j] += node[i, k] * w[k, j]
            values[j] *= area0 * r[Q, j]
            values[j] += k_node[i] * r[SOURCE, j]
        missed[1], missed[2], missed[3] = between(values)
        for p in range(N_PLACES):
            total = missed[p]
            for k in range(gap.size):
                total += node[i, k] * (own[k, p] + moved[p] * w[k, row_of(p)])
            worst = max(worst, abs(total))
    return worst


@jit_rows
def _linear_error(node: FloatArray, k_node: FloatArray, source: FloatArray, places: FloatArray) -> float:
    """Largest error of a node's voltage under `local`, where the voltages are linear in the modes and the source, V."""
    first, second, third = between(source)
    worst = 0.0
    for i in range(k_node.size):
        share = k_node[i]
        at_start, at_first, at_second, at_third, at_end = 0.0, share * first, share * second, share * third, 0.0
        for k in range(places.shape[0]):
            share = node[i, k]
            at_start += share * places[k, 0]
            at_first += share * places[k, 1]
            at_second += share * places[k, 2]
            at_third += share * places[k, 3]
            at_end += share * places[k, 4]
        worst = max(worst, abs(at_start), abs(at_first), abs(at_second), abs(at_third), abs(at_end))
    return worst
