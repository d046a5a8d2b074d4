"""What an exponential step of a network evaluates at all its rows: the areas, and the currents that they add."""

from __future__ import annotations

from typing import Any

import numpy as np

from fingerspice.base.arrays import FloatArray, IntArray
from fingerspice.base.compiled import jit, jit_rows, jit_within
from fingerspice.engine.many_areas import form as blocks
from fingerspice.engine.many_areas.coupling import STIFF
from fingerspice.engine.many_areas.currents import Moving, answer_alone, answer_mobile, answer_together
from fingerspice.engine.many_areas.form import Form, Leaks, Work, leaks_of
from fingerspice.engine.network import Sources
from fingerspice.engine.one_area import rows as stack_rows
from fingerspice.engine.one_area.rows import polynomial_rows
from fingerspice.numerics.lobatto import BETWEEN, DERIVATIVE, NODES, POINTS, ROWS
from fingerspice.numerics.small import copy_to
from fingerspice.physics.contact import inverse_area

# From values at the nodes to slopes at all rows, per step length: slopes = values @ TO_RATES.
TO_RATES = np.ascontiguousarray(np.vstack([DERIVATIVE, BETWEEN.T @ DERIVATIVE]).T)


@jit_rows
def combine(matrix: FloatArray, rows: FloatArray, out: FloatArray) -> None:
    """out += matrix @ rows, at all rows of a step."""
    n = matrix.shape[1]
    for c in range(matrix.shape[0]):
        # Two at a time: the sum is fetched and put back half as often.
        for k in range(0, n - 1, 2):
            share, other = matrix[c, k], matrix[c, k + 1]
            for i in range(ROWS):
                out[c, i] += share * rows[k, i] + other * rows[k + 1, i]
        if n % 2 == 1:
            share = matrix[c, n - 1]
            for i in range(ROWS):
                out[c, i] += share * rows[n - 1, i]


@jit_rows
def combine_from(matrix: FloatArray, rows: FloatArray, start: FloatArray, out: FloatArray) -> None:
    """out = start + matrix @ rows, at all rows of a step."""
    n = matrix.shape[1]
    for c in range(matrix.shape[0]):
        if n == 0:
            for i in range(ROWS):
                out[c, i] = start[c, i]
        else:
            share = matrix[c, 0]
            for i in range(ROWS):
                out[c, i] = start[c, i] + share * rows[0, i]
        for k in range(1, n - 1, 2):
            share, other = matrix[c, k], matrix[c, k + 1]
            for i in range(ROWS):
                out[c, i] += share * rows[k, i] + other * rows[k + 1, i]
        if n > 1 and n % 2 == 0:
            share = matrix[c, n - 1]
            for i in range(ROWS):
                out[c, i] += share * rows[n - 1, i]


@jit_rows
def mode_rates(
    h: float, rates: FloatArray, w: FloatArray, lin: FloatArray, pull: FloatArray, stiff_only: bool, out: FloatArray
) -> None:
    """Derivatives of the modes: of stiff modes (perhaps only of these) by the derivative of their polynomials."""
    for k in range(w.shape[0]):
        rate = rates[k]
        if rate * h > STIFF:
            for i in range(ROWS):
                out[k, i] = 0.0
            for m in range(NODES):
                share = w[k, m] / h
                for i in range(ROWS):
                    out[k, i] += TO_RATES[m, i] * share
        elif not stiff_only:
            for i in range(ROWS):
                out[k, i] = lin[k, i] - rate * w[k, i] + pull[k, i]


@jit_rows
def clear(rows: FloatArray) -> None:
    for c in range(rows.shape[0]):
        for i in range(ROWS):
            rows[c, i] = 0.0


@jit_rows
def _highest(sign: float, u: FloatArray) -> float:
    highest = 0.0
    for i in range(ROWS):
        highest = max(highest, sign * u[i])
    return highest


@jit_rows
def _invert(area: FloatArray) -> None:
    for i in range(ROWS):
        area[i] = 1.0 / area[i]


@jit_rows
def _scale_slope(factor: float, area: FloatArray, slope: FloatArray) -> None:
    for i in range(ROWS):
        slope[i] *= factor * area[i] * area[i]


@jit
def wanted(
    slopes_too: bool, sign: float, powers: FloatArray, slopes: FloatArray, lo: float, scale: float, curve: FloatArray,
    u: FloatArray, area: FloatArray, slope: FloatArray,
) -> None:  # fmt: skip
    """Area at the gap voltages u (ROWS,) on the branch of a sign and, if wanted, its derivative by them."""
    if scale > 0.0 and _highest(sign, u) <= curve[1]:
        polynomial_rows(powers, lo, scale, u, sign, area)
        _invert(area)
        if slopes_too:
            polynomial_rows(slopes, lo, scale, u, sign, slope)
            _scale_slope(-scale * sign, area, slope)
    else:
        for i in range(ROWS):
            q, dq = inverse_area(max(sign * u[i], lo), curve)
            area[i] = 1.0 / q
            slope[i] = -sign * dq / (q * q)


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
            rate[i] = unit * (d[i] if rate_k * h > STIFF else lin[i] - rate_k * w[i] + forced[i])


@jit_rows
def _subtract(area: FloatArray, area0: float, more: FloatArray) -> None:
    for i in range(ROWS):
        more[i] = area[i] - area0


@jit_within
def evaluate(
    form: Form, work: Work, leaks: Leaks, several: bool, h: float, sign: FloatArray, w: FloatArray, d: FloatArray,
    pull: FloatArray, cells: FloatArray, areas: FloatArray, least: FloatArray,
) -> bool:  # fmt: skip
    """Forcing of the modes by the areas, into `pull` (m, ROWS), from the modes w (m, ROWS).

    `d` receives the derivatives of stiff modes. `cells` and `areas` are blocks of rows, whose parts that follow the
    sources are given. False beyond a fold; under `mobile`, `least` (ROWS,) receives the distance to it.
    """
    coupling, lin, rates, pace = work.own, work.modes[blocks.LIN], leaks.rates, leaks.pace
    mobile = form.mobile
    n = form.gap.shape[1]
    stiff = coupling.key[1] > 0
    u, eta, chi, rho = areas[blocks.U], cells[blocks.ETA], cells[blocks.CHI], cells[blocks.RHO]
    area, slope, rate, more = areas[blocks.AREA], areas[blocks.SLOPE], areas[blocks.RATE], areas[blocks.MORE]
    combine_from(form.gap, w, areas[blocks.U_S], u)
    clear(pull)
    if stiff:
        mode_rates(h, rates, w, lin, pull, True, d)
    for a in range(form.cell.size):
        if form.cell[a] >= 0:
            wanted(
                mobile, sign[a], form.powers[a], form.slopes[a], form.lo[a], form.scale[a], form.curves[a], u[a],
                area[a], slope[a],
            )  # fmt: skip
            k = form.slow[a]
            if k >= 0:
                _moving(
                    mobile, h, rates[k], pace[a], form.unit[a], w[k], lin[k], d[k], pull[k], area[a], slope[a], rate[a]
                )  # fmt: skip
            _subtract(area[a], form.area0[a], more[a])
    combine_from(coupling.from_modes, w, cells[blocks.ETA_S], eta)
    if stiff:
        combine(coupling.from_stiff, d[:n], eta)
    if mobile:
        combine_from(coupling.held, w, cells[blocks.CHI_S], chi)
        rows = Moving(u, more, slope, rate, chi, eta, rho, areas[blocks.KNOWN], cells[blocks.SHARE])
        answer_mobile(
            several, coupling, form.home, form.first, form.cell, rows, work.mixed, work.matrix, least
        )  # fmt: skip
        for i in range(ROWS):
            # NaN is no solution either.
            if not least[i] > 0.0:
                return False
    elif several:
        answer_together(form.home, coupling.answer, coupling.cross, more, cells[blocks.SHARE], eta, rho)
    else:
        answer_alone(form.home, coupling.answer, more, eta, rho)
    combine(coupling.feed, rho, pull[:n])
    return True


@jit_within
def follow_sources(form: Form, work: Work, gain: FloatArray) -> None:
    """The parts of a step's rows that depend on the sources alone; see `evaluate`."""
    coupling, s, ds, lin, cells, areas = work.own, work.s, work.ds, work.modes[blocks.LIN], work.cells, work.areas
    n = form.gap.shape[1]
    clear(lin)
    combine(gain, s, lin)
    clear(cells[blocks.ETA_S])
    combine(coupling.from_rates, lin[:n], cells[blocks.ETA_S])
    combine(coupling.from_slopes, ds, cells[blocks.ETA_S])
    combine(coupling.from_sources, s, cells[blocks.ETA_S])
    clear(cells[blocks.CHI_S])
    combine(coupling.from_slopes, s, cells[blocks.CHI_S])
    clear(areas[blocks.U_S])
    combine(form.gap_s, s, areas[blocks.U_S])


@jit_within
def evaluate_many(c: Any, s: Any) -> bool:
    """The forcing at the modes of the step at hand."""
    work, modes, several, h = c.work, c.work.modes, s.step[0].several > 0, s.step[0].length
    return evaluate(
        c.form, work, leaks_of(c, s), several, h, c.sign, modes[blocks.W], modes[blocks.D], modes[blocks.PULL],
        work.cells, work.areas, work.room[3],
    )  # fmt: skip


@jit_within
def probe_many(c: Any, s: Any, w: FloatArray, pull: FloatArray) -> bool:
    """The forcing at other modes w than those of the step at hand, whose own rows stay as they are."""
    work, cells, areas = c.work, c.work.spare_cells, c.work.spare_areas
    for part in (blocks.ETA_S, blocks.CHI_S, blocks.RHO):
        copy_to(cells[part], work.cells[part])
    copy_to(areas[blocks.U_S], work.areas[blocks.U_S])
    several, h = s.step[0].several > 0, s.step[0].length
    return evaluate(
        c.form, work, leaks_of(c, s), several, h, c.sign, w, work.spare[5], pull, cells, areas, work.room[1]
    )  # fmt: skip


@jit
def source_rows(
    sources: Sources, index: IntArray, t: float, h: float, slopes: bool, r: FloatArray, s: FloatArray, ds: FloatArray
) -> None:
    """Values of the sources at all rows of a step and, if wanted, their slopes."""
    for e in range(s.shape[0]):
        row = sources.first[e] + index[e]
        start = sources.edges[row]
        stack_rows.source_rows(
            sources.terms[row - e], sources.series[row - e], sources.edges[row + 1] - start, t - start, h, slopes, r[e]
        )
        for i in range(ROWS):
            s[e, i] = r[e, stack_rows.SOURCE, i]
            ds[e, i] = r[e, stack_rows.SLOPE, i]


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
