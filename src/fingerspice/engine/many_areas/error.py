"""A finished step of a network: its error and peaks, the charge that the sources deliver over it, and that one's error.

`engine.collocation.exponential`, `engine.collocation.readout` and `engine.one_area.charge` do the same for a stack.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from fingerspice.base.arrays import FloatArray, IntArray
from fingerspice.base.compiled import jit, jit_rows, jit_within
from fingerspice.engine.collocation.exponential import between, largest, mode_error
from fingerspice.engine.collocation.readout import N_PLACES, Control, row_of
from fingerspice.engine.collocation.step_control import first_wrong
from fingerspice.engine.many_areas import form as forms
from fingerspice.engine.many_areas.form import Form, Work
from fingerspice.engine.one_area.charge import LOBE, integrate
from fingerspice.numerics.lobatto import DERIVATIVE, END, NODES, POINTS, ROWS, combine, multiply
from fingerspice.numerics.modes import apply

# A decay that is over within this fraction of the step, a third of the way to the first node, is not seen by the
# polynomials.
_EARLY = POINTS[1] / 3.0
# Rows at which the response to the interpolation error is taken for the points between the nodes and for the end: this
# error changes its sign at every node, so that its integral is largest at the nodes beside those points.
_WORST = (1, NODES // 2, 9, END)


@jit
def load(inverse: FloatArray, follow: FloatArray, y: FloatArray, s: FloatArray, w: FloatArray) -> None:
    """Modes from the state and the sources' values."""
    n = inverse.shape[0]
    for k in range(n):
        w[k] = 0.0
    for i in range(n):
        x = y[i]
        for e in range(s.size):
            x += follow[i, e] * s[e]
        for k in range(n):
            w[k] += inverse[k, i] * x
    for k in range(n, w.size):
        w[k] = y[k]


@jit
def store(
    shape: FloatArray, follow: FloatArray, w: FloatArray, s: FloatArray, gained: FloatArray, y: FloatArray
) -> None:
    """State from the modes, the sources' values and the charges gained in the step."""
    n = shape.shape[0]
    apply(shape, w, y)
    for i in range(n):
        for e in range(s.size):
            y[i] -= follow[i, e] * s[e]
    for k in range(n, w.size):
        y[k] = w[k]
    for e in range(s.size):
        y[w.size + e] += gained[e]


@jit_rows
def _largest_voltage(shape: FloatArray, follow: FloatArray, m: int, off: FloatArray) -> float:
    """Largest error of a state voltage, V, from the errors `off` of the m modes and, behind them, of the sources."""
    n = shape.shape[0]
    largest_one = 0.0
    for i in range(n):
        for p in range(off.shape[0]):
            total = 0.0
            for k in range(n):
                total += shape[i, k] * off[p, k]
            for e in range(follow.shape[1]):
                total -= follow[i, e] * off[p, m + e]
            # NaN is too large as well.
            if not abs(total) <= largest_one:
                largest_one = abs(total)
    return largest_one


@jit_within
def assess(c: Any, s: Any) -> float:
    """Error of a converged step, V, from the interpolation errors between its nodes; see `exponential.mode_error`.

    `places` receives the errors of the modes, `run` those of the gaps' voltages; both contain the residual of
    the iteration and the errors of earlier steps. `work.off` receives the interpolation errors of the modes, and of the
    sources behind them, at the points between the nodes and at the end; its last row is that of a decay which is over
    before the first node.
    """
    form, work, error, step, x = forms.form_of(c, s), c.work, s.error, s.step[0], c.work.modal
    lin, off, size, h, magnified = work.lin, work.off, work.size, step.length, step.grown
    w, pull, places, run, gap, rates = x.w, x.pull, x.places, x.run, form.gap, form.rates
    n, m = gap.shape[1], w.shape[0]
    for j in range(work.s.shape[0]):
        off[0, m + j], off[1, m + j], off[2, m + j] = between(c.tables.lobes, work.s[j])
    for k in range(m):
        mode_error(x, k, between(c.tables.lobes, lin[k]), c.tables, step.slot, _WORST, magnified, error[k], off)
        # The slope of the mode at the start shows such a decay: it differs by the decay's size times its rate.
        fall = 0.0
        for j in range(NODES):
            fall += DERIVATIVE[0, j] * w[k, j]
        fall = lin[k, 0] + pull[k, 0] - rates[k] * w[k, 0] - fall / h
        off[4, k] = fall / (rates[k] + 1.0 / (_EARLY * h))
        for p in range(3):
            off[p, k] += x.brief[k, p + 1]
            places[k, p + 1] += x.brief[k, p + 1]
    largest_one: float = _largest_voltage(form.shape, form.follow, m, off)
    for k in range(n, m):
        for p in range(4):
            if not size[k] * abs(off[p, k]) <= largest_one:
                largest_one = size[k] * abs(off[p, k])
    for a in range(run.shape[0]):
        for p in range(N_PLACES):
            total = 0.0
            for k in range(n):
                total += gap[a, k] * (places[k, p] + (off[4, k] if p == 0 else 0.0))
            run[a, p] = abs(total)
    return largest_one


@jit
def charged(cell: IntArray, u: FloatArray, area: FloatArray, lobes: FloatArray) -> float:
    """Interpolation error of the areas as a voltage, V: it enters the charge through the integral of A du."""
    worst = 0.0
    for a in range(cell.size):
        if cell[a] >= 0:
            first, second, third = between(lobes, area[a])
            swing = 0.3 * abs(u[a, END] - u[a, 0])
            worst = max(worst, swing * abs(largest(first, second, third)) / area[a, 0])
    return worst


@jit
def turn_at_start(cell: IntArray, u: FloatArray, sign: FloatArray, tol: float, t: float, branch: FloatArray) -> bool:
    """Switch the branch of every area whose gap voltage starts at 0 and leaves to the other side; True if one did."""
    turned = False
    for a in range(cell.size):
        if cell[a] >= 0 and sign[a] * u[a, 0] <= 1e-9 * abs(u[a, 1]) and first_wrong(u[a], sign[a], tol) == 1:
            sign[a] = -sign[a]
            branch[a, 0], branch[a, 1] = t, math.inf
            turned = True
    return turned


@jit_rows
def write_columns(
    shape: FloatArray, follow: FloatArray, w: FloatArray, s: FloatArray, y: FloatArray, charge: bool, values: FloatArray
) -> None:
    """Write the state at all rows into the first rows of `values`; charges, if wanted, as gained since the start."""
    n, m = shape.shape[0], w.shape[0]
    multiply(follow, s, None, values)
    for j in range(n):
        for i in range(ROWS):
            values[j, i] = -values[j, i]
    combine(shape, w, 0, values)
    for k in range(n, m):
        for i in range(ROWS):
            values[k, i] = w[k, i]
    for e in range(m, y.size):
        for i in range(ROWS):
            values[e, i] = y[e] + (values[e, i] if charge else 0.0)


# Largest integral within a step of a function that changes its sign at every node, as the node polynomial does, over
# the function's size and the step's length.
_HALF_LOBE = 0.041


@jit_rows
def _leaks(
    mobile: bool, h: float, c: float, g: float, u: FloatArray, more: FloatArray, leak: FloatArray, moved: FloatArray
) -> None:
    """A cell's current beyond the one at the reference area: the part to be integrated (A) and the charge stored (C).

    The stored charge counts from the start of the step. Under `local` the charge on the area moves with the area: the
    part of A - A0 at the start is exact, the rest is integrated along the polynomial of the voltage. The voltage's own
    rate would not do, because a decayed mode contributes its rate times the rounding error of its voltage.
    """
    for i in range(ROWS):
        leak[i] = g * more[i] * u[i]
        moved[i] = c * (more[i] * u[i] - more[0] * u[0]) if mobile else c * more[0] * (u[i] - u[0])
    if not mobile:
        for i in range(NODES):
            slope = 0.0
            for m in range(NODES):
                slope += DERIVATIVE[i, m] * u[m]
            leak[i] += c * (more[i] - more[0]) * slope / h


@jit
def charge_error(
    form: Form, work: Work, lobes: FloatArray, h: float, theta: float, z: FloatArray, collected: FloatArray,
    control: Control,
) -> None:  # fmt: skip
    """Largest error of the charges over the part of a step that counts, from the signed error of the modes.

    With du the error of a cell's voltage and dA that of its area, the error of a charge has a stored part, which goes
    with du and dA at the time, and a lasting part: their leak and, under `local`, the integral of c (dA u' - A' du).
    Interpolation errors change their sign at every node: they are stored, but over a whole step nothing of them leaks.
    If a step is cut short, the lobe between the last two nodes lasts.

    `places` are the errors of the modes, and `work.off` the interpolation errors of this step among them (see
    `assess`); `z` (n_s, ROWS) are the charges gained. `collected` (2, n_s) has the lasting errors so far: the sum of
    those with a known sign, and the sum of squares of the others.
    """
    places, missed, cell_slips, areas = work.modal.places, work.off, work.cell_slips, work.areas
    lasting, brief, u, more = work.slips[0], work.slips[1], work.cells[forms.CELL_U], work.areas[forms.MORE]
    for k in range(places.shape[0]):
        for p in range(N_PLACES):
            brief[k, p] = missed[p - 1, k] if 0 < p < N_PLACES - 1 else (missed[4, k] if p == 0 else 0.0)
            lasting[k, p] = places[k, p] - (brief[k, p] if p > 0 else 0.0)
    _cell_errors(form, lasting, areas[forms.SLOPE], cell_slips[0])
    _cell_errors(form, brief, areas[forms.SLOPE], cell_slips[1])
    off_briefly, mobile = np.empty(N_PLACES), form.mobile
    for source in range(form.stored.shape[0]):
        between_nodes = between(lobes, z[source])
        swing, end, lobe, apart = 0.0, 0.0, 0.0, 0.0
        if not mobile:
            swing, end = _area_missed(form, source, work, lobes)
        for p in range(1, N_PLACES - 1):
            leak = _part(form, source, p, form.lost, form.g, True, brief, cell_slips[1], u, more)
            lobe = max(lobe, _HALF_LOBE * h * abs(leak))
        for p in range(N_PLACES):
            held = _part(form, source, p, form.stored, form.c, mobile, brief, cell_slips[1], u, more)
            own = between_nodes[p - 1] if 0 < p < N_PLACES - 1 else 0.0
            off_briefly[p] = max(abs(held), abs(own), swing, lobe)
            apart = max(apart, abs(own - held) if 0 < p < N_PLACES - 1 else 0.0)
        # After a step that is cut short its lobes last, and the difference between its charge and its modes. The signs
        # of both are unknown.
        kept = end if theta == 1.0 else math.sqrt(swing * swing + lobe * lobe + apart * apart)
        collected[1, source] += kept * kept
        added, last_leak, last_theta = 0.0, 0.0, 0.0
        for p in range(N_PLACES):
            row = row_of(p)
            leak = _part(form, source, p, form.lost, form.g, True, lasting, cell_slips[0], u, more)
            if p > 0:
                reached = min(POINTS[row], theta)
                part = (reached - last_theta) / (POINTS[row] - last_theta)
                turned = 0.0 if mobile else _turned(form, source, p, cell_slips[0], u, areas[forms.AREA])
                added += part * (0.5 * h * (POINTS[row] - last_theta) * (leak + last_leak) + turned)
                last_theta = POINTS[row]
            last_leak = leak
            now = _part(form, source, p, form.stored, form.c, mobile, lasting, cell_slips[0], u, more)
            known = now + collected[0, source] + added
            error = math.sqrt(known * known + off_briefly[p] * off_briefly[p] + collected[1, source])
            control.error_q = max(control.error_q, error)
            if last_theta > theta:
                break
        collected[0, source] += added


@jit
def _cell_errors(form: Form, places: FloatArray, slope: FloatArray, off: FloatArray) -> None:
    """Errors of the cells' voltages (V) and, behind them, of the areas (m^2) at the places, from those of the modes."""
    n_f = form.c.size
    for p in range(N_PLACES):
        for b in range(n_f):
            for k in range(form.tap.shape[1]):
                off[p, b] += form.tap[b, k] * places[k, p]
        for a in range(form.cell.size):
            if form.slow[a] >= 0:
                off[p, n_f + a] = form.unit[a] * places[form.slow[a], p]
            elif form.cell[a] >= 0:
                off[p, n_f + a] = slope[a, row_of(p)] * off[p, form.cell[a]]


@jit
def _part(
    form: Form, source: int, p: int, by_mode: FloatArray, by_cell: FloatArray, moves: bool, places: FloatArray,
    off: FloatArray, u: FloatArray, more: FloatArray,
) -> float:  # fmt: skip
    """Stored part of a charge's error at a place (C), or the rate (A) at which it leaks; `moves`: by the areas, too."""
    total = 0.0
    row = row_of(p)
    for k in range(by_mode.shape[1]):
        total += by_mode[source, k] * places[k, p]
    for b in range(by_cell.size):
        a = form.home[b]
        both = more[a, row] * off[p, b]
        if moves:
            both += u[b, row] * off[p, by_cell.size + a]
        total += form.through[source, b] * by_cell[b] * both
    return total


@jit
def _turned(form: Form, source: int, p: int, off: FloatArray, u: FloatArray, area: FloatArray) -> float:
    """Integral of c (dA u' - A' du) from the place before, C."""
    total = 0.0
    row, last = row_of(p), row_of(p - 1)
    for b in range(form.c.size):
        a = form.home[b]
        area_off = off[p, form.c.size + a] + off[p - 1, form.c.size + a]
        both = area_off * (u[b, row] - u[b, last]) - (area[a, row] - area[a, last]) * (off[p, b] + off[p - 1, b])
        total += 0.5 * form.through[source, b] * form.c[b] * both
    return total


@jit
def _area_missed(form: Form, source: int, work: Work, lobes: FloatArray) -> tuple[float, float]:
    """Errors of the integral of c A u' by the interpolation of the areas, within a step and at its end, C.

    Within the step the error is the lobe between two nodes. At the end the quadrature rule has twice the order, so that
    the relative interpolation error counts squared.
    """
    way, end, u, area = 0.0, 0.0, work.cells[forms.CELL_U], work.areas[forms.AREA]
    for b in range(form.c.size):
        a = form.home[b]
        first, second, third = between(lobes, area[a])
        worst = max(abs(first), abs(second), abs(third))
        total = 0.0
        for i in range(1, NODES):
            total += abs(u[b, i] - u[b, i - 1])
        lobe = LOBE * abs(form.through[source, b]) * form.c[b] * worst * total
        way += lobe
        end += lobe * min(1.0, worst / area[a, 0])
    return way, end


@jit_within
def step_charges(
    form: Form, work: Work, h: float, integral: FloatArray, sign: FloatArray, z: FloatArray, current: FloatArray
) -> None:
    """Charges gained since the start of a converged step, and currents, of the sources at its nodes: (n_s, ROWS)."""
    w, rate, s, ds, n = work.modal.w, work.d, work.s, work.ds, form.shape.shape[0]
    stored, stored_s, c, g, home = form.stored, form.stored_s, form.c, form.g, form.home
    u, more, j, room = work.cells[forms.CELL_U], work.areas[forms.MORE], work.cells[forms.J], work.room
    collected, leak, moved = room[0], room[1], room[2]
    forms.mode_rates(h, form.rates, w, work.lin, work.modal.pull, False, rate)
    multiply(form.tap, w[:n], None, u)
    combine(form.tap_s, s, 0, u)
    multiply(work.own.root, work.cells[forms.RHO], None, j)
    if not form.mobile:
        for a in range(form.cell.size):
            if form.cell[a] >= 0 and form.slow[a] < 0:
                forms.wanted(form, a, True, sign[a], work.areas)
    multiply(stored, rate, None, current)
    combine(stored_s, ds, 0, current)
    for a in range(stored.shape[0]):
        multiply(form.lost[a : a + 1], w, None, room[:1])
        combine(form.lost_s[a : a + 1], s, 0, room[:1])
        for i in range(ROWS):
            z[a, i] = 0.0
        for k in range(n):
            for i in range(ROWS):
                z[a, i] += stored[a, k] * (w[k, i] - w[k, 0])
        for k in range(s.shape[0]):
            for i in range(ROWS):
                z[a, i] += stored_s[a, k] * (s[k, i] - s[k, 0])
        for i in range(ROWS):
            current[a, i] += collected[i]
        for b in range(c.size):
            share = form.through[a, b]
            if share == 0.0:
                continue
            _leaks(form.mobile, h, c[b], g[b], u[b], more[home[b]], leak, moved)
            for i in range(ROWS):
                current[a, i] += share * j[b, i]
                collected[i] += share * leak[i]
                z[a, i] += share * moved[i]
        integrate(integral, h, collected, z[a])
