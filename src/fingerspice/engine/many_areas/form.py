"""A network in modal form around reference areas, and the arrays that its steps work in.

With its areas fixed at A0 every network is linear: x = shape v - follow s with v' = -rates v + gain s. The change of an
area adds a current j in each cell whose area follows a voltage,

    v' = -rates v + gain s + feed j,    j = (A - A0) (c u' + g u)  [mobile: + c u A'],    u = tap v + tap_s s.

j contains the derivatives of the voltages, but linearly and at the same time only, so that each row of a step solves
for them (see `fingerspice.engine.many_areas.coupling`); the fold is where this equation has no solution. An area with a
time constant is one more mode, of rate 1 / tau. Within a jump of the sources the independent variable is the fraction
of the jump, and nothing leaks: all rates are zero.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fingerspice.base.arrays import FloatArray, IntArray
from fingerspice.base.compiled import jit_within
from fingerspice.engine.collocation.readout import CONTROL, N_PLACES, WRITTEN_AT_ONCE
from fingerspice.engine.many_areas.coupling import Coupling, new_coupling
from fingerspice.engine.one_area.rows import N_FLAT
from fingerspice.numerics.lobatto import NODES, ROWS

# Blocks of the modes' rows.
W, BASE, LIN, D, PULL, USED, PULL_BEFORE, LEFT_BEFORE = range(8)
# Blocks of the cells' rows: the parts of eta and chi that follow the sources, eta and chi, rho, shares of A', voltages,
# currents.
ETA_S, CHI_S, ETA, CHI, RHO, SHARE, CELL_U, J = range(8)
# Blocks of the areas' rows: A, dA/du, the part of A' that depends on time, A - A0, A'; gap voltages, their guess, and
# their part that follows the sources.
AREA, SLOPE, RATE, MORE, KNOWN, U, GUESS, U_S = range(8)


class Form(NamedTuple):
    """See the module. n live voltages, m modes with those of slow areas behind, n_f cells whose area moves."""

    # (size,): All numbers that depend on the reference areas; the arrays named in `REFERRED` are views of it, so that a
    # change of the reference areas is one copy
    numbers: FloatArray
    rates: FloatArray  # (m,)
    gain: FloatArray  # (m, n_s)
    # shape, inverse (n, n): v = inverse (x + follow s)
    shape: FloatArray
    inverse: FloatArray
    follow: FloatArray  # (n, n_s)
    feed: FloatArray  # (m, n_f)
    # tap, tap_s (n_f, n) and (n_f, n_s)
    tap: FloatArray
    tap_s: FloatArray
    area0: FloatArray  # (n_area,): Reference area, m^2
    # gap, gap_s (n_area, n) and (n_area, n_s): Voltage of each area's GAP from x and s; zero without one
    gap: FloatArray
    gap_s: FloatArray
    # node, node_s (n_node, n) and (n_node, n_s): Voltage of each node from the same
    node: FloatArray
    node_s: FloatArray
    size: FloatArray  # (n,): Euclidean norm of the state voltages (V) for one unit of each mode
    # stored, stored_s, lost, lost_s (n_s, n) and (n_s, n_s): Current that each source delivers at the reference areas:
    # stored v' + stored_s s' + lost v + lost_s s
    stored: FloatArray
    stored_s: FloatArray
    lost: FloatArray
    lost_s: FloatArray
    mobile: bool  # Charge law
    # c, g (n_f,): Capacitance and leak of the cells per area
    c: FloatArray
    g: FloatArray
    home: IntArray  # (n_f,): The area of each of these cells, ascending
    first: IntArray  # (n_area + 1,): First of these cells of each area
    cell: IntArray  # (n_area,): The cell whose voltage the area follows; -1 if the area is fixed
    unit: FloatArray  # (n_area,): The area at 0 V, m^2: areas with a time constant are states in units of it
    # slow, pace (n_area,): The mode of each area that has a time constant, else -1, and its rate, 1/s
    slow: IntArray
    pace: FloatArray
    stress: FloatArray  # (n_area,): Force per area and squared gap voltage, Pa/V^2
    # powers, slopes, lo, scale (n_area, DEGREE + 1) and (n_area,): 1/A as in `engine.one_area.system.System`; `curves`
    # solve Eq. 4 where these do not reach
    powers: FloatArray
    slopes: FloatArray
    lo: FloatArray
    scale: FloatArray
    curves: FloatArray
    through: FloatArray  # (n_s, n_f): Share of the current j of each cell that the source delivers in addition


#: The fields of a `Form` that belong to its reference areas, in the order in which they stand in its `numbers`.
REFERRED = Form._fields[1:19]


class Leaks(NamedTuple):
    """What leaks in a form, by the names that it has there; within a jump of the sources all of these are 0."""

    rates: FloatArray
    gain: FloatArray
    g: FloatArray
    pace: FloatArray
    lost: FloatArray
    lost_s: FloatArray


class Jump(NamedTuple):
    """A jump of the sources in progress, and what is put aside for its duration."""

    # before, after (n_s,): Values of the sources before and after it, V or A
    before: FloatArray
    after: FloatArray
    # control (2,), sign: Bookkeeping before the jump and at its start, and branches of the areas before it
    control: NDArray[Any]
    sign: FloatArray
    branch: FloatArray  # (n_area, 2): As `ManyAreas.branch`, by the fraction of the jump
    leaks: Leaks  # Zeros


class Work(NamedTuple):
    """Arrays that steps work in; those with ROWS behind hold one value for each row of a step."""

    r: FloatArray
    s: FloatArray
    ds: FloatArray
    modes: FloatArray
    cells: FloatArray
    areas: FloatArray
    matrix: FloatArray
    mixed: FloatArray
    own: Coupling  # Of the step at hand
    at: IntArray  # (1,): Number of the reference in use
    w0: FloatArray
    places: FloatArray
    weight: FloatArray
    values: FloatArray
    coefficients: FloatArray
    outputs: FloatArray
    room: FloatArray
    off: FloatArray
    slips: FloatArray
    cell_slips: FloatArray
    carried: FloatArray
    spare: FloatArray
    spare_cells: FloatArray
    spare_areas: FloatArray
    # segment, now, slopes_now (n_s,): Segment of each source at hand; values and slopes at the start of the step
    segment: IntArray
    now: FloatArray
    slopes_now: FloatArray
    here: FloatArray  # (n_area,): Areas at the start of the step
    size: FloatArray  # (m,): As that of the form, with the voltage scale behind
    gained: FloatArray  # (n_s,): Charges of a step
    run: FloatArray  # (n_area, N_PLACES): Errors of the gaps' voltages
    basis: FloatArray
    jump: Jump


def new_work(n: int, modes: int, cells: int, areas: int, sources: int, columns: int) -> Work:
    """Work arrays for so many live voltages, modes, cells whose area moves, areas, sources and output columns."""
    z, whole = np.zeros, np.int64
    leaks = Leaks(z(modes), z((modes, sources)), z(cells), z(areas), z((sources, n)), z((sources, sources)))
    jump = Jump(z(sources), z(sources), z(2, CONTROL), z(areas), z((areas, 2)), leaks)
    return Work(
        z((sources, N_FLAT, ROWS)), z((sources, ROWS)), z((sources, ROWS)), z((8, modes, ROWS)), z((8, cells, ROWS)),
        z((8, areas, ROWS)), z((cells, cells + 1, ROWS)), z((cells, areas + 1, ROWS)), new_coupling(n, cells, sources),
        z(1, whole), z(modes), z((modes, N_PLACES)), z(modes), z((columns, ROWS)), z((columns, ROWS)),
        z((2, WRITTEN_AT_ONCE)), z((4, ROWS)), z((N_PLACES, modes + sources)), z((2, modes, N_PLACES)),
        z((2, N_PLACES, cells + areas)), z((modes, N_PLACES - 1)), z((6, modes, ROWS)), z((8, cells, ROWS)),
        z((8, areas, ROWS)), z(sources, whole), z(sources), z(sources), z(areas), z(modes), z(sources),
        z((areas, N_PLACES)), z(NODES), jump,
    )  # fmt: skip


@jit_within
def leaks_of(c: Any, s: Any) -> Leaks:
    """What leaks at present: nothing within a jump of the sources."""
    form, none = c.form, c.work.jump.leaks
    if s.step[0].in_jump > 0:
        return Leaks(none.rates, none.gain, none.g, none.pace, none.lost, none.lost_s)
    return Leaks(form.rates, form.gain, form.g, form.pace, form.lost, form.lost_s)
