"""Parts of a network's step: the sources at its rows, the collocation solution, and the charges."""

from __future__ import annotations

import math

from fingerspice.base.arrays import FloatArray, IntArray
from fingerspice.base.compiled import jit, jit_rows, jit_within
from fingerspice.engine import netrows, rows
from fingerspice.engine import work as stack_work
from fingerspice.engine.coupling import Coupling, answer_mobile, cell_currents, take_coupling
from fingerspice.engine.exponential import distance, mix, plain, respond
from fingerspice.engine.netassess import moved
from fingerspice.engine.netcharge import charge_rows
from fingerspice.engine.netrows import Form, Work, clear, combine, evaluate, mode_rates, wanted
from fingerspice.engine.network import Sources
from fingerspice.numerics.lobatto import NODES, POINTS, ROWS


@jit
def source_rows(
    sources: Sources, index: IntArray, t: float, h: float, slopes: bool, r: FloatArray, s: FloatArray, ds: FloatArray
) -> None:
    """Values of the sources at all rows of a step and, if wanted, their slopes."""
    for e in range(s.shape[0]):
        row = sources.first[e] + index[e]
        start = sources.edges[row]
        rows.source_rows(
            sources.terms[row - e], sources.series[row - e], sources.edges[row + 1] - start, t - start, h, slopes, r[e]
        )
        for i in range(ROWS):
            s[e, i] = r[e, stack_work.SOURCE, i]
            ds[e, i] = r[e, stack_work.SLOPE, i]


@jit
def ramp_rows(t: float, h: float, before: FloatArray, after: FloatArray, s: FloatArray, ds: FloatArray) -> None:
    """Values and slopes of the sources at all rows of a step within a jump, which starts at the fraction t."""
    for e in range(before.size):
        for i in range(ROWS):
            ds[e, i] = after[e] - before[e]
            s[e, i] = before[e] + (t + POINTS[i] * h) * ds[e, i]


@jit_rows
def _free(decay: FloatArray, w0: FloatArray, out: FloatArray) -> None:
    """Decay of the modes from their values at the start of a step."""
    for k in range(w0.size):
        for i in range(ROWS):
            out[k, i] = decay[k, i] * w0[k]


@jit_within
def solve_step(
    form: Form, work: Work, own: Coupling, several: bool, h: float, rates: FloatArray, area_pace: FloatArray,
    sign: FloatArray, decay: FloatArray, phi: FloatArray, tol: float,
) -> tuple[int, bool, float]:  # fmt: skip
    """Collocation solution of a step from the modes `work.w0`, by iteration on the currents that the areas add.

    Returns the number of evaluations, whether the gap voltages are settled to `tol` (V), and the factor by which the
    first iteration reduced the change of the currents: how strongly the areas answer to a change of the modes.
    """
    modes, cells, areas, weight = work.modes, work.cells, work.areas, work.weight
    w, base, lin, pull, used = (
        modes[netrows.W], modes[netrows.BASE], modes[netrows.LIN], modes[netrows.PULL], modes[netrows.USED]
    )  # fmt: skip
    pull_before, left_before = modes[netrows.PULL_BEFORE], modes[netrows.LEFT_BEFORE]
    u, guess = areas[netrows.U], areas[netrows.GUESS]
    clear(used)
    clear(guess)
    clear(cells[netrows.RHO])
    _free(decay, work.w0, w)
    respond(lin, phi, w, base)
    current = base
    slowly = False
    step = 0.0
    answer = 0.0
    for iteration in range(1, 41):
        if iteration > 1:
            if slowly:
                step = mix(pull, used, weight, pull_before, left_before)
            else:
                step = plain(pull, used, weight, pull_before, left_before)
            respond(used, phi, base, w)
            current = w
        if not evaluate(
            form, own, several, h, rates, area_pace, sign, current, lin, modes[netrows.D], pull, cells, areas,
            work.matrix, work.mixed, work.room[3],
        ):  # fmt: skip
            return iteration, False, answer
        change = moved(u, guess)
        if iteration == 1:
            continue
        # The next change of the gap voltages, estimated from their change for the last change of the currents.
        off = distance(pull, used, weight)
        if iteration == 2 and step > 0.0:
            answer = off / step
        if not off < math.inf:
            return iteration, False, answer
        if change * off <= tol * step:
            return iteration, True, answer
        slowly = off > 0.15 * step
    return 40, False, answer


@jit_within
def step_charges(
    form: Form, work: Work, own: Coupling, h: float, rates: FloatArray, g: FloatArray, lost: FloatArray,
    lost_s: FloatArray, integral: FloatArray, sign: FloatArray, z: FloatArray, current: FloatArray,
) -> None:  # fmt: skip
    """Charges gained since the start of a converged step, and currents, of the sources at its nodes."""
    modes, cells, areas = work.modes, work.cells, work.areas
    w, cell_u = modes[netrows.W], cells[netrows.CELL_U]
    mode_rates(h, rates, w, modes[netrows.LIN], modes[netrows.PULL], False, modes[netrows.D])
    clear(cell_u)
    combine(form.tap, w[: form.shape.shape[0]], cell_u)
    combine(form.tap_s, work.s, cell_u)
    cell_currents(own.root, cells[netrows.RHO], cells[netrows.J])
    if not form.mobile:
        for a in range(form.cell.size):
            if form.cell[a] >= 0 and form.slow[a] < 0:
                wanted(
                    True, sign[a], form.powers[a], form.slopes[a], form.lo[a], form.scale[a], form.curves[a],
                    areas[netrows.U, a], areas[netrows.AREA, a], areas[netrows.SLOPE, a],
                )  # fmt: skip
    charge_rows(
        form.mobile, h, form.stored, form.stored_s, lost, lost_s, form.through, form.c, g, form.home, integral, w,
        modes[netrows.D], work.s, work.ds, cell_u, areas[netrows.MORE], cells[netrows.J], work.room, z, current,
    )  # fmt: skip


@jit
def all_zero(a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray) -> bool:
    """Whether all entries are 0."""
    for x in (a, b, c, d):
        for i in range(x.shape[0]):
            for j in range(x.shape[1]):
                if x[i, j] != 0.0:
                    return False
    return True


@jit
def magnified_whole(form: Form, work: Work, which: int, several: bool) -> float:
    """Inverse distance of a step to the fold with all modes, also those that the step takes for stiff.

    `work.own` becomes coupling number `which`, in which no mode is taken for stiff.
    """
    whole, areas, spare = work.own, work.areas, work.spare_cells
    take_coupling(whole, which, 0.0, form.rates, form.feed, form.tap, form.tap_s, form.c, form.g, form.home, form.cell)
    clear(spare[netrows.CHI])
    clear(spare[netrows.ETA])
    combine(whole.held, work.modes[netrows.W][: form.shape.shape[0]], spare[netrows.CHI])
    combine(whole.from_slopes, work.s, spare[netrows.CHI])
    answer_mobile(
        several, whole.answer, whole.gap, whole.leak, whole.cross, form.home, form.first, form.cell,
        areas[netrows.U], areas[netrows.MORE], areas[netrows.SLOPE], areas[netrows.RATE], spare[netrows.CHI],
        spare[netrows.ETA], spare[netrows.RHO], work.spare_areas[netrows.KNOWN], spare[netrows.SHARE], work.mixed,
        work.matrix, work.room[3],
    )  # fmt: skip
    least: float = work.room[3, :NODES].min()
    return 1.0 / least
