"""What the quadrature and the sweeps leave in a block of a recording: measured, and added up along the recording.

The modes of the last sweep follow from the drives of the sweep before. They are corrected by the quadrature error that
the quarters of the steps show, and the drives at the ends of the steps are then computed again. The response of the
modes to the change of the drives is what a further sweep would change. It is not added to the modes but stated: it is
their error by the sweeps, but for its own response, which is a few per cent of it.
"""

from __future__ import annotations

import math

from fingerspice.base.arrays import FloatArray
from fingerspice.base.compiled import jit, jit_rows, jit_within
from fingerspice.engine.blockcharge import charge_block
from fingerspice.engine.blockcheck import FORCE
from fingerspice.engine.blockcourse import Course
from fingerspice.engine.blockforms import (
    CHECKED,
    ERROR_F,
    ERROR_U,
    ERROR_V,
    LEVEL,
    LEVELS,
    MEAN_Q,
    MIDDLE,
    OF_CHARGE,
    OF_FORCE,
    OF_GAP,
    OF_NODES,
    OF_ORDER,
    PEAK_F,
    PEAK_U,
    RATIO,
    REFUSED,
    STEPS,
    U_GAP,
    UNTIL_CHECK,
)
from fingerspice.engine.blockrows import (
    PAD,
    add,
    add_both_ends,
    add_three,
    add_to_all,
    largest_of,
    modes_into,
    recursion,
    scaled,
)
from fingerspice.engine.relaxation import LEFT, MOST_RATIO, NEWTON, look_at_ends

# The part of a change that a sweep leaves is taken to be so many times what the block before has shown, and at least
# this share of the areas' distance from the reference.
CAUTION, LEAST = 2.0, 0.01
# Parts of a block at whose starts the errors of earlier blocks are taken for the force: eight, by three square roots.
PARTS = 8
# Below this share of the error allowed, changes show nothing but rounding.
SHOWING = 1e-3


@jit_rows
def _force_rows(
    n: int, stress: float, u: FloatArray, q: FloatArray, a: float, seen: FloatArray, left: FloatArray,
    slope: FloatArray, force: FloatArray, off: FloatArray,
) -> float:  # fmt: skip
    """Half the derivative of the force by the gap voltage, the force, and its error, each in its row; the mean q.

    The error of the gap voltage is a |seen| + |left|. The derivative does not contain that of the area.
    """
    total = 0.0
    for i in range(n):
        x = abs(u[i])
        slope[i] = stress * x / q[i]
        force[i] = slope[i] * x
        total += q[i]
    for i in range(n):
        off[i] = slope[i] * (a * abs(seen[i]) + abs(left[i]))
    return total / n


@jit_within
def quadrature_error(c: Course, r: int, level: int, n: int) -> float:
    """Largest quadrature error seen in the first projection, V; that of the modes into `Room.own`."""
    form, room = c.form, c.room
    for k in range(c.w.size):
        room.own[k, 0] = 0.0
        recursion(n, form.decay[r, level, k], room.inc[k], room.other, room.own[k])
    scaled(n + 1, 0.0, room.s, room.before)
    modes_into(n + 1, 0, form.taps[r, 0], room.own, room.before)
    return largest_of(n + 1, room.before)


@jit
def correct(c: Course, r: int, n: int) -> None:
    """Correct the modes by the error seen; 1/A at the steps' ends.

    `Room.changed` then holds the change of the drives since those that the last sweep began with.
    """
    form, room = c.form, c.room
    for k in range(c.w.size):
        add(n + 1, 1.0, room.own[k], room.w[k])
    for t in range(room.g.shape[0]):
        # In the middle, the drives change by the correction as the mean of the ends does.
        add(n, 1.0, room.g_within[MIDDLE, t], room.changed_within[t])
        add_both_ends(n, -0.5, room.g[t], room.changed_within[t])
    look_at_ends(form, room, r, n + 1, NEWTON)
    for t in range(room.g.shape[0]):
        add_both_ends(n, 0.5, room.g[t], room.changed_within[t])
        add(n + 1, 1.0, room.g[t], room.changed[t])
    add_to_all(n + 1, form.q0[r], room.z, c.charges.q[0])


@jit
def further_sweep(c: Course, r: int, level: int, n: int) -> None:
    """What a further sweep would change in the modes, into `Room.further`."""
    form, room = c.form, c.room
    for k in range(c.w.size):
        inc = room.inc[k, PAD:]
        scaled(n, 0.0, room.s, inc)
        for t in range(room.g.shape[0]):
            by = form.drive[r, level, k, t]
            add_three(
                n, by[0], room.changed[t], by[1], room.changed_within[t], by[2], room.changed[t, 1:], inc
            )  # fmt: skip
        room.further[k, 0] = 0.0
        recursion(n, form.decay[r, level, k], room.inc[k], room.other, room.further[k])


@jit_within
def error_left(c: Course, r: int, n: int) -> float:
    """Largest change of the first projection by a further sweep, into `Room.slope`, V."""
    room = c.room
    scaled(n + 1, 0.0, room.s, room.slope)
    modes_into(n + 1, 0, c.form.taps[r, 0], room.further, room.slope)
    return largest_of(n + 1, room.slope)


@jit_within
def learn(
    c: Course, r: int, n: int, tol: float, change: float, seen: float, left: float, local: float
) -> bool:  # fmt: skip
    """Learn which part of a change a sweep leaves, and tell whether more sweeps would reduce the error much.

    All in V: the change by the last sweep, the quadrature error seen, what a further sweep would change, and all of the
    error. If that is above `tol`, so large a change is not taken for the last one again.
    """
    strayed = largest_of(n + 1, c.room.z) / c.form.q0[r]
    if not change + seen > SHOWING * tol or not strayed > 0.0:
        return False
    ratio = max(CAUTION * left / ((change + seen) * strayed), LEAST)
    if local > tol and change > 0.0:
        ratio = max(ratio, CAUTION * tol / (change * strayed))
    c.control[RATIO] = ratio
    # More sweeps do not reduce what the correction by the quadrature error changes.
    stays = local - left * change / (change + seen)
    return bool(stays <= LEFT * tol and ratio * strayed < MOST_RATIO)


@jit_within
def _largest_sum(c: Course, row: FloatArray, modes: FloatArray, n: int, out: FloatArray) -> float:
    """Largest modulus of the sum `row` (m,) @ `modes` (m, n + 1), which `out` becomes."""
    scaled(n + 1, row[0], modes[0], out)
    modes_into(n + 1, 1, row, modes, out)
    return largest_of(n + 1, out)


@jit_within
def _node_error(c: Course, r: int, n: int, known: float) -> float:
    """Largest error of a node's voltage by sweeps and earlier blocks, or `known` (V) if it is not larger."""
    for i in range(c.shown.node.shape[1]):
        row = c.shown.node[r, i]
        carried = _carried(c, row)
        if carried + _most(c, row) > known:
            known = max(known, _largest_sum(c, row, c.room.further, n, c.room.slope) + carried)
    return known


@jit_within
def _most(c: Course, row: FloatArray) -> float:
    """Most that a further sweep may change in the quantity `row` (m,) @ modes, by the largest changes of modes."""
    total = 0.0
    for k in range(c.w.size):
        total += abs(row[k]) * c.spare[0, k]
    return total


@jit_within
def _carried(c: Course, row: FloatArray) -> float:
    """Most that the errors of earlier blocks add to the quantity `row` (m,) @ modes."""
    total = 0.0
    for k in range(c.w.size):
        total += abs(row[k] * c.error[0, k]) + abs(row[k] * c.error[1, k])
    return total


@jit_within
def _force_error(c: Course, r: int, n: int) -> float:
    """Largest error of the force but for `FORCE`, from `_force_rows`, with the decaying errors of earlier blocks."""
    room, left, worst, first = c.room, c.spare[1], 0.0, 0
    for k in range(c.w.size):
        left[k] = abs(c.form.taps[r, 0, k]) * (abs(c.error[0, k]) + abs(c.error[1, k]))
    for part in range(PARTS):
        carried, stop = 0.0, (part + 1) * n // PARTS
        for k in range(c.w.size):
            carried += left[k]
            left[k] *= math.sqrt(math.sqrt(math.sqrt(c.spare[2, k])))
        count = stop + 1 - first
        off = largest_of(count, room.bends[first:]) + carried * largest_of(count, room.crossed[first:])
        worst, first = max(worst, off), stop
    return worst


@jit
def accept(c: Course, r: int, level: int, n: int, seen: float, left: float, magnified: float) -> None:
    """Account for the peaks and errors of an accepted block, and move to its end.

    `seen` and `left` are the errors of the gap voltage by the quadrature and by the sweeps, V, and `magnified` the
    ratio of such an error to one of the first projection. Row 2 of `Course.spare` has the decay of every mode over the
    block, and `Charges.h` the lengths of its steps.
    """
    room, control, checked = c.room, c.control, c.checks[level]
    carried = _carried(c, c.form.taps[r, 0])
    control[MEAN_Q] = _force_rows(
        n + 1, c.shown.stress, room.u, c.charges.q[0], checked[OF_FORCE], room.before, room.slope, room.crossed,
        room.jumps, room.bends,
    )  # fmt: skip
    peak = largest_of(n + 1, room.u)
    control[PEAK_F] = max(control[PEAK_F], largest_of(n + 1, room.jumps))
    control[PEAK_U] = max(control[PEAK_U], peak)
    quadrature, others = checked[OF_GAP] * seen, left + magnified * carried
    control[ERROR_U] = max(control[ERROR_U], quadrature + others)
    control[ERROR_F] = max(control[ERROR_F], FORCE * magnified * _force_error(c, r, n))
    for k in range(c.w.size):
        c.spare[0, k] = largest_of(n + 1, room.further[k])
    # An error of the gap voltage changes the area, and thereby other voltages.
    known = checked[OF_NODES] * seen + others
    error = _node_error(c, r, n, max(control[ERROR_V] - known, 0.0) / magnified)
    control[ERROR_V] = max(control[ERROR_V], known + magnified * error)
    if c.shown.charge:
        charge_block(c, r, n, checked[OF_CHARGE], quadrature + left, True)
    for k in range(c.w.size):
        c.w[k] = room.w[k, n]
        c.error[0, k] = c.error[0, k] * c.spare[2, k] + checked[OF_GAP] * room.own[k, n]
        c.error[1, k] = c.error[1, k] * c.spare[2, k] + room.further[k, n]
    control[U_GAP] = room.u[n]
    c.counters[STEPS] += n
    checked[UNTIL_CHECK] -= 1.0


@jit_within
def refine(c: Course, level: int, n: int, local: float, tol: float) -> None:
    """Go to shorter steps, as the error `local` (V) of a block is above `tol`."""
    halvings = max(1.0, math.ceil(0.25 * math.log2(local / tol))) if local < math.inf else 1.0
    c.control[LEVEL] = min(LEVELS - 1.0, level + halvings)
    c.counters[REFUSED] += n


@jit_within
def may_coarsen(c: Course, level: int, seen: float, left: float, tol: float) -> bool:
    """Whether steps twice as long would meet `tol`, after a block with these errors (V)."""
    checks = c.checks
    share = max(checks[level, OF_GAP], checks[level - 1, OF_GAP] if checks[level - 1, CHECKED] > 0.0 else 0.0)
    return bool(OF_ORDER * share * seen + left < tol)
