"""Share of the quadrature error seen that is left in a block of a recording once it is corrected: measured.

The quarters of the steps show the quadrature error, by which the modes are corrected. What the correction leaves is a
small share of it: of smooth drives hardly anything, and at a kink of 1/A as much as the place within the step decides.
The share is therefore measured. Some blocks, more of them at the beginning, are solved twice, with sweeps that leave
next to nothing. In the second solution the steps are half as long, and a sixteenth of the error remains. The largest
difference between both, over the largest error seen, is the share of the blocks that follow at this step length. Gap
voltage, force, nodes and charges have shares of their own.
"""

from __future__ import annotations

from fingerspice.base.arrays import FloatArray
from fingerspice.base.compiled import jit, jit_rows, jit_within
from fingerspice.engine.blockcharge import charge_block
from fingerspice.engine.blockcourse import Course
from fingerspice.engine.blockforms import (
    CHECKED,
    COLLECTED,
    ERROR_Q,
    LEAST_SHARE,
    LEVELS,
    N_SHARES,
    OF_CHARGE,
    OF_FORCE,
    OF_GAP,
    OF_NODES,
    UNTIL_CHECK,
    WAITED,
)
from fingerspice.engine.blockrows import largest_of, modes_into, scaled

# The share stated is so many times the one measured, and at least so much of the one stated before.
CAUTION, REMEMBERED = 1.3, 0.7
# From one check to the next the number of blocks grows by this factor, up to the largest; and an error seen that is so
# many times the largest one checked is checked at once.
RARER, MOST_WAIT, LOUDER = 4.0, 128.0, 2.0
# Share of the error seen that the sweeps may leave in both solutions of a check.
OF_SWEEPS = 0.005
# Shares of the gap voltage below which the error seen is rounding, and of what the sweeps leave below which the error
# left by quadrature does not matter.
ROUNDING, MATTERS = 1e-12, 0.1
# Upper bound of the derivative of the force by the gap voltage, over force / voltage: 2, and the area's share in it.
FORCE = 2.2


@jit_rows
def _forces(n: int, stress: float, q: FloatArray, u: FloatArray) -> None:
    """Turn gap voltages into forces."""
    for i in range(n):
        u[i] *= stress * u[i] / q[i]


@jit_rows
def _enlarge(n: int, area0: float, q: FloatArray, x: FloatArray) -> None:
    for i in range(n):
        x[i] *= area0 * q[i]


@jit_rows
def _largest_product(n: int, u: FloatArray, q: FloatArray, error: FloatArray) -> float:
    """Largest |u error| / q."""
    largest = 0.0
    for i in range(n):
        a = abs(u[i] * error[i]) / q[i]
        largest = a if a > largest else largest
    return largest


@jit_rows
def _largest_difference(n: int, x: FloatArray, y: FloatArray) -> float:
    """Largest |x - y|, with every second entry of y."""
    largest = 0.0
    for i in range(n):
        a = abs(x[i] - y[2 * i])
        largest = a if a > largest else largest
    return largest


@jit_within
def is_due(c: Course, level: int, n: int, seen: float, left: float, tol: float) -> bool:
    """Whether to check a block with these errors of the gap voltage by quadrature and sweeps (V).

    So it is after so many blocks, or if the error is larger than any checked, and if it is neither rounding, nor far
    from what is allowed, nor of no importance beside what the sweeps leave.
    """
    noted = c.checks[level]
    if noted[UNTIL_CHECK] > 0.0 and not seen > LOUDER * noted[CHECKED]:
        return False
    matters = noted[OF_GAP] * seen > MATTERS * left
    shows = seen > ROUNDING * largest_of(n + 1, c.room.u) and LEAST_SHARE * seen <= tol
    return level + 1 < LEVELS and matters and shows


@jit_within
def _row(c: Course, r: int, j: int, n: int, out: FloatArray) -> None:
    """Row j of what is compared in n places: gap voltage, force, voltages of the nodes but for the source, charges."""
    form, room, shown, q = c.form, c.room, c.shown, c.charges.q[0]
    node, charge = j - 2, j - 2 - shown.node.shape[1]
    if charge >= 0:
        scaled(n, 1.0, c.charges.z, out)
    elif node >= 0:
        scaled(n, 0.0, room.s, out)
        modes_into(n, 0, shown.node[r, node], room.w, out)
        _enlarge(n, form.area0, q, out)
    else:
        scaled(n, 1.0, room.u, out)
        if j == 1:
            _forces(n, shown.stress, q, out)


@jit
def keep(c: Course, r: int, n: int, seen: float, magnified: float, errors: FloatArray) -> None:
    """Keep what a corrected solution of n steps shows, and note the errors seen, of which shares are left, in `errors`.

    `seen` is the error of the gap voltage (V), and `magnified` is as in
    `blockerror.accept`. The projections that the charge needs are known.
    """
    room, control = c.room, c.control
    if c.shown.charge:
        control[COLLECTED] = control[ERROR_Q] = 0.0
        charge_block(c, r, n, 1.0, seen, False)
    for j in range(room.kept.shape[0]):
        _row(c, r, j, n + 1, room.kept[j])
    steepest = _largest_product(n + 1, room.kept[0], c.charges.q[0], room.before)
    errors[:] = seen
    errors[OF_FORCE] = FORCE * magnified * c.shown.stress * steepest
    if c.shown.charge:
        errors[OF_CHARGE] = control[ERROR_Q]


@jit
def compare(c: Course, r: int, first: int, n: int, errors: FloatArray) -> None:
    """Note the largest differences of n steps to what was kept, from its step `first` on, in `errors`."""
    room = c.room
    if c.shown.charge:
        charge_block(c, r, n, 1.0, 0.0, False)
    for j in range(room.kept.shape[0]):
        _row(c, r, j, n + 1, room.slope)
        charge = j >= 2 + c.shown.node.shape[1]
        kind = (OF_GAP, OF_FORCE)[j] if j < 2 else OF_CHARGE if charge else OF_NODES
        errors[kind] = max(errors[kind], _largest_difference(n // 2 + 1, room.kept[j, first:], room.slope))


@jit_within
def note(c: Course, level: int, closed: bool, seen: FloatArray, off: FloatArray) -> None:
    """Note which shares of the errors `seen` the correction left, `off`; none if a solution was not `closed`."""
    noted = c.checks[level]
    if closed:
        for kind in range(N_SHARES):
            share = CAUTION * off[kind] / seen[kind] if seen[kind] > 0.0 else 0.0
            share = max(share, LEAST_SHARE)
            noted[kind] = max(share, REMEMBERED * noted[kind]) if noted[CHECKED] > 0.0 else share
        noted[CHECKED] = max(seen[OF_GAP], noted[CHECKED])
    noted[WAITED] = min(max(1.0, RARER * noted[WAITED]), MOST_WAIT)
    noted[UNTIL_CHECK] = noted[WAITED]
