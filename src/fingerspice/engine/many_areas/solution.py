"""Parts of a network's step: the sources at its rows, the collocation solution, and the charges."""

from __future__ import annotations

from fingerspice.base.arrays import FloatArray, IntArray
from fingerspice.base.compiled import jit, jit_rows, jit_within
from fingerspice.engine.many_areas import form as blocks
from fingerspice.engine.many_areas.charge import charge_rows
from fingerspice.engine.many_areas.currents import cell_currents
from fingerspice.engine.many_areas.form import Form, Leaks, Work
from fingerspice.engine.many_areas.rows import clear, combine, mode_rates, wanted
from fingerspice.engine.network import Sources
from fingerspice.engine.one_area import rows
from fingerspice.engine.one_area import rows as stack_work
from fingerspice.numerics.lobatto import POINTS, ROWS


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
def free(decay: FloatArray, w0: FloatArray, out: FloatArray) -> None:
    """Decay of the modes from their values at the start of a step."""
    for k in range(w0.size):
        for i in range(ROWS):
            out[k, i] = decay[k, i] * w0[k]


@jit_within
def step_charges(
    form: Form, work: Work, leaks: Leaks, h: float, integral: FloatArray, sign: FloatArray, z: FloatArray,
    current: FloatArray,
) -> None:  # fmt: skip
    """Charges gained since the start of a converged step, and currents, of the sources at its nodes."""
    modes, cells, areas = work.modes, work.cells, work.areas
    w, cell_u = modes[blocks.W], cells[blocks.CELL_U]
    mode_rates(h, leaks.rates, w, modes[blocks.LIN], modes[blocks.PULL], False, modes[blocks.D])
    clear(cell_u)
    combine(form.tap, w[: form.shape.shape[0]], cell_u)
    combine(form.tap_s, work.s, cell_u)
    cell_currents(work.own.root, cells[blocks.RHO], cells[blocks.J])
    if not form.mobile:
        for a in range(form.cell.size):
            if form.cell[a] >= 0 and form.slow[a] < 0:
                wanted(
                    True, sign[a], form.powers[a], form.slopes[a], form.lo[a], form.scale[a], form.curves[a],
                    areas[blocks.U, a], areas[blocks.AREA, a], areas[blocks.SLOPE, a],
                )  # fmt: skip
    charge_rows(form, work, leaks, h, integral, z, current)
