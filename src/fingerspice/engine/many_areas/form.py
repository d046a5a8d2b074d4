"""A network in modal form around reference areas, and the arrays that its steps work in.

With its areas fixed at A0 every network is linear: x = shape v - follow s with v' = -rates v + gain s. The change of an
area adds a current j in each cell whose area follows a voltage,

    v' = -rates v + gain s + feed j,    j = (A - A0) (c u' + g u)  [mobile: + c u A'],    u = tap v + tap_s s.

j contains the derivatives of the voltages, but linearly and at the same time only, so that each row of a step solves
for them (see `fingerspice.engine.many_areas.coupling`); the fold is where this equation has no solution. An area with a
time constant is one more mode, of rate 1 / tau. Within a jump of the sources the independent variable is the fraction
of the jump, and nothing leaks: all rates are zero.

An exponential step evaluates at all its rows the areas, and the currents that they add.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fingerspice.base.arrays import FloatArray, IntArray
from fingerspice.base.compiled import jit, jit_rows, jit_within
from fingerspice.engine.collocation.readout import CONTROL, N_PLACES, Modal, new_modal
from fingerspice.engine.many_areas import coupling as couplings
from fingerspice.engine.network import Sources
from fingerspice.engine.one_area import rows as stack_rows
from fingerspice.engine.one_area.rows import area_rows, largest_size
from fingerspice.numerics.lobatto import NODES, POINTS, ROWS, TO_SLOPES, combine, multiply
from fingerspice.numerics.modes import copy_to

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


def held(form: Form) -> Form:
    """The form within a jump of the sources, in which nothing leaks; all else are the same arrays."""
    leaks = "rates", "gain", "g", "pace", "lost", "lost_s"
    return form._replace(**{name: np.zeros_like(getattr(form, name)) for name in leaks})


class Jump(NamedTuple):
    """A jump of the sources in progress, and what is put aside for its duration."""

    # before, after (n_s,): Values of the sources before and after it, V or A
    before: FloatArray
    after: FloatArray
    # control (2,), sign: Bookkeeping before the jump and at its start, and branches of the areas before it
    control: NDArray[Any]
    sign: FloatArray
    branch: FloatArray  # (n_area, 2): `LoopState.branch` before it; within a jump it goes by the fraction of the jump


class Work(NamedTuple):
    """Arrays that steps work in; those with ROWS behind hold one value for each row of a step."""

    modal: Modal
    s: FloatArray
    ds: FloatArray
    # lin, d (m, ROWS): Forcing of the modes by the sources; derivatives of the modes
    lin: FloatArray
    d: FloatArray
    cells: FloatArray
    areas: FloatArray
    matrix: FloatArray
    mixed: FloatArray
    own: couplings.Coupling  # Of the step at hand
    at: IntArray  # (1,): Number of the reference in use
    room: FloatArray
    off: FloatArray  # (N_PLACES, m + n_s): Interpolation errors of the modes and the sources
    slips: FloatArray
    cell_slips: FloatArray
    spare_cells: FloatArray
    spare_areas: FloatArray
    # segment, now, slopes_now (n_s,): Segment of each source at hand; values and slopes at the start of the step
    segment: IntArray
    now: FloatArray
    slopes_now: FloatArray
    here: FloatArray  # (n_area,): Areas at the start of the step
    size: FloatArray  # (m,): As that of the form, with the voltage scale behind
    gained: FloatArray  # (n_s,): Charges of a step
    jump: Jump


def new_network_work(n: int, modes: int, cells: int, areas: int, sources: int, columns: int) -> Work:
    """Work arrays for so many live voltages, modes, cells whose area moves, areas, sources and output columns."""
    z, whole = np.zeros, np.int64
    jump = Jump(z(sources), z(sources), z(2, CONTROL), z(areas), z((areas, 2)))
    own, of_areas = couplings.new_coupling(n, cells, sources), z((8, areas, ROWS))
    return Work(
        new_modal(modes, columns, of_areas[U], of_areas[GUESS]), z((sources, ROWS)), z((sources, ROWS)),
        z((modes, ROWS)), z((modes, ROWS)), z((8, cells, ROWS)), of_areas, z((cells, cells + 1, ROWS)),
        z((cells, areas + 1, ROWS)), own, z(1, whole), z((4, ROWS)), z((N_PLACES, modes + sources)),
        z((2, modes, N_PLACES)), z((2, N_PLACES, cells + areas)), z((8, cells, ROWS)), z((8, areas, ROWS)),
        z(sources, whole), z(sources), z(sources), z(areas), z(modes), z(sources), jump,
    )  # fmt: skip


@jit_within
def form_of(c: Any, s: Any) -> Form:
    """The form at present: within a jump of the sources nothing leaks."""
    form: Form = c.held if s.step[0].in_jump > 0 else c.form
    return form


@jit_rows
def mode_rates(
    h: float, rates: FloatArray, w: FloatArray, lin: FloatArray, pull: FloatArray, stiff_only: bool, out: FloatArray
) -> None:
    """Derivatives of the modes: of stiff modes (perhaps only of these) by the derivative of their polynomials."""
    for k in range(w.shape[0]):
        rate = rates[k]
        if rate * h > couplings.STIFF:
            for i in range(ROWS):
                total = 0.0
                for m in range(NODES):
                    total += TO_SLOPES[m, i] * w[k, m]
                out[k, i] = total / h
        elif not stiff_only:
            for i in range(ROWS):
                out[k, i] = lin[k, i] - rate * w[k, i] + pull[k, i]


@jit_rows
def _inverted(q: FloatArray, dq: FloatArray, slopes_too: bool) -> None:
    """The area and, if wanted, its slope in place of 1/A and the slope of that."""
    for i in range(ROWS):
        q[i] = 1.0 / q[i]
    if slopes_too:
        for i in range(ROWS):
            dq[i] *= -q[i] * q[i]


@jit
def wanted(form: Form, a: int, slopes_too: bool, sign: float, areas: FloatArray) -> None:
    """Area a at its gap voltages on the branch of a sign and, if wanted, its derivative by them."""
    curve, u, area, slope = form.curves[a], areas[U, a], areas[AREA, a], areas[SLOPE, a]
    scale = form.scale[a] if largest_size(u) <= curve[1] else 0.0
    area_rows(form.powers[a], form.slopes[a], form.lo[a], scale, curve, u, sign, slopes_too, area, slope)
    _inverted(area, slope, slopes_too)


@jit_rows
def _moving(
    mobile: bool, h: float, rate_k: float, pace: float, unit: float, w: FloatArray, lin: FloatArray, d: FloatArray,
    forced: FloatArray, area: FloatArray, slope: FloatArray, rate: FloatArray,
) -> None:  # fmt: skip
    """An area with a time constant: its forcing by the equilibrium area in `area`; then the area and its derivative."""
    for i in range(ROWS):
        forced[i] = pace / unit * area[i]
        area[i] = unit * w[i]
        slope[i] = 0.0
    if mobile:
        for i in range(ROWS):
            rate[i] = unit * (d[i] if rate_k * h > couplings.STIFF else lin[i] - rate_k * w[i] + forced[i])


@jit_rows
def _subtract(area: FloatArray, area0: float, more: FloatArray) -> None:
    for i in range(ROWS):
        more[i] = area[i] - area0


@jit_within
def evaluate_many(c: Any, s: Any, w: FloatArray, pull: FloatArray, probing: bool) -> bool:
    """Write the forcing of the modes w by the areas into `pull` (m, ROWS), and what it comes from into rows of `Work`.

    With `probing`, the modes are not those of the step at hand, and other rows are taken, so that those of the step
    stay as they are. False beyond a fold.
    """
    form, work, sign, h, several = form_of(c, s), c.work, s.sign, s.step[0].length, s.step[0].several > 0
    # Derivatives of stiff modes, blocks of rows, and the distance to the fold.
    d, cells, areas, least = work.d, work.cells, work.areas, work.room[3]
    if probing:
        d, cells, areas, least = work.modal.spare[5], work.spare_cells, work.spare_areas, work.room[1]
        for part in (ETA_S, CHI_S, RHO):
            copy_to(cells[part], work.cells[part])
        copy_to(areas[U_S], work.areas[U_S])
    coupling, lin, rates, mobile = work.own, work.lin, form.rates, form.mobile
    n = form.gap.shape[1]
    stiff = coupling.key[1] > 0
    eta, rho = cells[ETA], cells[RHO]
    area, slope, rate, more = areas[AREA], areas[SLOPE], areas[RATE], areas[MORE]
    multiply(form.gap, w, areas[U_S], areas[U])
    pull[:] = 0.0
    if stiff:
        mode_rates(h, rates, w, lin, pull, True, d)
    for a in range(form.cell.size):
        if form.cell[a] >= 0:
            wanted(form, a, mobile, sign[a], areas)
            k = form.slow[a]
            if k >= 0:
                _moving(
                    mobile, h, rates[k], form.pace[a], form.unit[a], w[k], lin[k], d[k], pull[k], area[a], slope[a],
                    rate[a],
                )  # fmt: skip
            _subtract(area[a], form.area0[a], more[a])
    multiply(coupling.from_modes, w, cells[ETA_S], eta)
    if stiff:
        combine(coupling.from_stiff, d[:n], 0, eta)
    if mobile:
        multiply(coupling.held, w, cells[CHI_S], cells[CHI])
        answer_mobile(form, work, several, cells, areas, least)
        for i in range(ROWS):
            # NaN is no solution either.
            if not least[i] > 0.0:
                return False
    elif several:
        couplings.answer_together(form.home, coupling.answer, coupling.cross, more, cells[SHARE], eta, rho)
    else:
        couplings.answer_alone(form.home, coupling.answer, more, eta, rho)
    combine(coupling.feed, rho, 0, pull[:n])
    return True


@jit_within
def answer_mobile(
    form: Form, work: Work, several: bool, cells: FloatArray, areas: FloatArray, least: FloatArray
) -> None:  # fmt: skip
    """rho under `mobile`, with all couplings of the areas; `least` (ROWS,) takes the distance to the fold.

    This is the ratio of two determinants of the capacitances for small changes: with moving areas to with areas held.
    """
    home, x, mixed, matrix = form.home, work.own, work.mixed, work.matrix
    answer, more, chi, eta, known, share = x.answer, areas[MORE], cells[CHI], cells[ETA], areas[KNOWN], cells[SHARE]
    for i in range(ROWS):
        least[i] = 1.0
    spare = mixed[0, more.shape[0]]
    for a in range(form.cell.size):
        if form.cell[a] >= 0:
            c, last = form.first[a], form.first[a + 1]
            u, slope, rate = areas[U, a], areas[SLOPE, a], areas[RATE, a]
            couplings.distance_of_area(answer, x.gap, c, last, more[a], slope, chi, spare)
            couplings.rate_of_area(answer, x.gap, x.leak[c], c, last, u, more[a], slope, rate, spare, known[a], share)
            for i in range(ROWS):
                least[i] *= spare[i]
    if several:
        couplings.fill_matrix(False, home, answer, x.cross, more, eta, known, share, mixed, matrix)
        couplings.eliminate(matrix, spare, least, True)
        couplings.mix(home, answer, x.cross, more, chi, mixed)
        couplings.fill_matrix(True, home, answer, x.cross, more, eta, known, share, mixed, matrix)
        couplings.eliminate(matrix, spare, least, False)
        for b in range(answer.size):
            copy_to(eta[b], matrix[b, answer.size])
    couplings.answer_alone(home, answer, more, eta, cells[RHO])
    couplings.add_rates(home, answer, more, chi, eta, known, share, cells[RHO])


@jit_within
def follow_sources(form: Form, work: Work) -> None:
    """The parts of a step's rows that depend on the sources alone; see `evaluate_many`."""
    coupling, s, ds, lin, cells, areas = work.own, work.s, work.ds, work.lin, work.cells, work.areas
    n = form.gap.shape[1]
    multiply(form.gain, s, None, lin)
    multiply(coupling.from_rates, lin[:n], None, cells[ETA_S])
    combine(coupling.from_slopes, ds, 0, cells[ETA_S])
    combine(coupling.from_sources, s, 0, cells[ETA_S])
    multiply(coupling.from_slopes, s, None, cells[CHI_S])
    multiply(form.gap_s, s, None, areas[U_S])
    # Areas that do not follow a voltage stay as at the reference.
    for a in range(form.area0.size):
        for i in range(ROWS):
            areas[AREA, a, i] = form.area0[a]


@jit
def source_rows(
    sources: Sources, index: IntArray, t: float, h: float, slopes: bool, room: FloatArray, s: FloatArray, ds: FloatArray
) -> None:
    """Values of the sources at all rows of a step and, if wanted, their slopes."""
    for e in range(s.shape[0]):
        row = sources.first[e] + index[e]
        start = sources.edges[row]
        stack_rows.source_rows(
            sources.terms[row - e], sources.series[row - e], sources.edges[row + 1] - start, t - start, h, slopes, s[e],
            ds[e], room,
        )  # fmt: skip


@jit
def ramp_rows(t: float, h: float, before: FloatArray, after: FloatArray, s: FloatArray, ds: FloatArray) -> None:
    """Values and slopes of the sources at all rows of a step within a jump, which starts at the fraction t."""
    for e in range(before.size):
        for i in range(ROWS):
            ds[e, i] = after[e] - before[e]
            s[e, i] = before[e] + (t + POINTS[i] * h) * ds[e, i]
