"""The loop of exponential steps: segments and jumps of the source, zeros of the gap voltage, step lengths, outputs."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fingerspice.compiled import borrow, jit, jit_fused, jit_rows
from fingerspice.engine.exponential import N_PLACES, Tables, assess, converge, make_tables
from fingerspice.engine.model import Model, Segment, branch_area, choose_branch, dot, gap_voltage, jump_charge, source
from fingerspice.engine.rows import DQ, GUESS, N_FLAT, SLOPE, SOURCE, X_GAP, Q, U, source_rows
from fingerspice.engine.system import System
from fingerspice.numerics.lobatto import BARYCENTRIC, END, FIRST, NODES, POINTS, ROWS, SECOND, TO_SERIES

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

# Codes returned by `march`.
DONE, NO_STEP, OUT_OF_RANGE = 0, 1, 2
# Entries of `control`.
T, H, SIGN, U_BEFORE, U_GAP = 0, 1, 2, 3, 4
BRANCH_START, BRANCH_LENGTH, PEAK_U, PEAK_F, ERROR_U, ERROR_F = 5, 6, 7, 8, 9, 10
N_CONTROL = 11
# Entries of `counters`: rows evaluated, steps accepted and refused, zeros met, outputs written.
NFEV, ACCEPTED, REJECTED, ZEROS, OUTPUT = 0, 1, 2, 3, 4
N_COUNTERS = 5
# Neighbouring step lengths of the ladder, as a power of two: fine enough to waste little, coarse enough to recur.
_RUNGS = 16.0
# A step meant to reach a zero of the gap voltage goes this much farther.
_BEYOND = 1.02
_BLOCK = 32


class Pace(NamedTuple):
    """How steps are chosen.

    Attributes
    ----------
    tol : float
        Error of the gap voltage allowed in a step, V.
    h_max : float
        Longest step, s.
    controlled : bool
        Whether the error governs the step; else every step is `h_max` (for measuring orders).
    charge : bool
        Whether charge and current are wanted.
    """

    tol: float
    h_max: float
    controlled: bool
    charge: bool


class Work(NamedTuple):
    """Arrays that steps work in: those of `fingerspice.engine.rows`, and the loop's own."""

    r: FloatArray
    base: FloatArray
    w: FloatArray
    pull: FloatArray
    used: FloatArray
    w0: FloatArray
    places: FloatArray
    values: FloatArray
    coefficients: FloatArray
    block: FloatArray


def new_work(n: int) -> Work:
    """Work arrays for n modes."""
    return Work(
        np.zeros((N_FLAT, ROWS)),
        np.zeros((n, ROWS)),
        np.zeros((n, ROWS)),
        np.zeros((n, ROWS)),
        np.zeros((n, ROWS)),
        np.zeros(n),
        np.zeros((n, N_PLACES)),
        np.zeros((n + 2, NODES)),
        np.zeros((n + 2, NODES)),
        np.zeros((4, _BLOCK)),
    )


@jit
def _nearest_level(q0: FloatArray, q: float) -> int:
    """Reference area nearest to 1/A = q, by ratio."""
    best = 0
    distance = math.inf
    for i in range(q0.size):
        d = max(q0[i] / q, q / q0[i])
        if d < distance:
            distance = d
            best = i
    return best


@jit
def _enter(model: Model, charge: bool, segment: Segment, t0: float, y: FloatArray, control: FloatArray) -> None:
    """Take the jump of the source that may stand `t0` s into a segment, and choose the branch after it."""
    u_source, _ = source(segment, t0)
    x_gap = dot(model.gap, y)
    jump = u_source - control[U_BEFORE]
    if not model.mobile and jump != 0.0 and charge:
        y[-1] += jump_charge(model, x_gap, control[U_BEFORE], u_source)
    sign = choose_branch(model, u_source, y)
    if sign != control[SIGN]:
        control[BRANCH_START] = control[T]
        control[BRANCH_LENGTH] = math.inf
    control[SIGN] = sign
    control[U_BEFORE] = u_source
    control[U_GAP] = gap_voltage(model, model.k_gap * u_source, x_gap, sign, model.k_gap * u_source)


@jit
def _choose_step(
    pace: Pace, tau: float, coupled: bool, is_series: bool, t: float, remaining: float, control: FloatArray
) -> float:
    """Length of the next step, s: on the ladder, or to the very end of a segment that cannot be continued."""
    if not pace.controlled:
        return pace.h_max
    h = control[H]
    if h == 0.0:
        h = 4.0 * tau
    h = min(h, pace.h_max)
    ahead = control[BRANCH_START] + _BEYOND * control[BRANCH_LENGTH] - t
    target = remaining
    if coupled and 0.0 < ahead < remaining:
        target = ahead
    h = target / math.ceil(target / h) if h < target else target
    if is_series:
        # A series is worthless past its end: the last step of a segment has its exact length.
        if h >= remaining * (1.0 - 1e-9):
            return remaining
        h = _rung(h)
        return h if h < remaining else remaining
    h = _rung(h)
    return h if h <= pace.h_max else _rung(0.95 * pace.h_max)


@jit
def _rung(h: float) -> float:
    """The shortest step of the ladder that is not shorter than h."""
    out: float = 2.0 ** (math.ceil(_RUNGS * math.log2(h) - 1e-9) / _RUNGS)
    return out


@jit_rows
def _series_of(values: FloatArray, out: FloatArray) -> None:
    """Chebyshev coefficients of the polynomial through values at the nodes."""
    for d in range(NODES):
        total = 0.0
        for j in range(NODES):
            total += TO_SERIES[j, d] * values[j]
        out[d] = total


@jit_fused
def _value_and_slope(series: FloatArray, x: float) -> tuple[float, float]:
    """Value and derivative of a Chebyshev series at x in [-1, 1] (Clenshaw)."""
    b1 = 0.0
    b2 = 0.0
    d1 = 0.0
    d2 = 0.0
    for d in range(NODES - 1, 0, -1):
        d0 = 2.0 * (b1 + x * d1) - d2
        b0 = 2.0 * x * b1 + (series[d] - b2)
        d2 = d1
        d1 = d0
        b2 = b1
        b1 = b0
    return x * b1 + (series[0] - b2), b1 + x * d1 - d2


@jit
def _zero(u: FloatArray, sign: float, last: int, series: FloatArray) -> float:
    """Fraction of the step at which the gap voltage leaves its branch, between nodes `last` - 1 and `last`."""
    lo: float = POINTS[last - 1]
    hi: float = POINTS[last]
    if not sign * u[last - 1] > 0.0:
        return lo
    _series_of(u, series)
    theta: float = lo + (hi - lo) * u[last - 1] / (u[last - 1] - u[last])
    # Newton, in a bracket that only closes.
    for _ in range(60):
        value, slope = _value_and_slope(series, 2.0 * theta - 1.0)
        if sign * value > 0.0:
            lo = theta
        else:
            hi = theta
        new = theta - 0.5 * value / slope if slope != 0.0 else lo
        if not lo < new < hi:
            if hi - lo <= 4e-16 or abs(new - theta) <= 2e-16:
                break
            new = 0.5 * (lo + hi)
        moved = abs(new - theta)
        theta = new
        if moved <= 2e-16:
            break
    return theta


@jit
def _first_wrong(u: FloatArray, sign: float) -> int:
    """First node past the start at which the gap voltage is off its branch, or 0."""
    for j in range(1, NODES):
        if sign * u[j] < 0.0:
            return j
    return 0


@jit
def _at(values: FloatArray, theta: float) -> float:
    """The polynomial through values at the nodes, at fraction `theta` of the step."""
    top = 0.0
    bottom = 0.0
    for j in range(NODES):
        distance = theta - POINTS[j]
        if distance == 0.0:
            value: float = values[j]
            return value
        weight = BARYCENTRIC[j] / distance
        top += weight * values[j]
        bottom += weight
    return top / bottom


@jit
def _error_at(places: FloatArray, theta: float, error: FloatArray) -> None:
    """Error of the modes where a step is cut short: between the places it is known at."""
    for k in range(places.shape[0]):
        left = 0.0
        right = POINTS[FIRST]
        p = 0
        if theta > POINTS[SECOND]:
            left = POINTS[SECOND]
            right = 1.0
            p = 2
        elif theta > POINTS[FIRST]:
            left = POINTS[FIRST]
            right = POINTS[SECOND]
            p = 1
        share = (theta - left) / (right - left)
        error[k] = (1.0 - share) * places[k, p] + share * places[k, p + 1]


@jit
def _charge_rates(
    model: Model, rates: FloatArray, gain: FloatArray, gap: FloatArray, slow_share: FloatArray, w: FloatArray,
    pull: FloatArray, r: FloatArray, rate: FloatArray, current: FloatArray,
) -> None:  # fmt: skip
    """z' and the current at the nodes, through the layer that leaks slowest (see `model.charge_rate`)."""
    n = rates.size
    slow = model.slow
    for j in range(NODES):
        dv = 0.0
        v = 0.0
        dx_gap = 0.0
        for k in range(n):
            dw = -rates[k] * w[k, j] + gain[k] * r[SOURCE, j] + pull[k, j]
            dv += slow_share[k] * dw
            v += slow_share[k] * w[k, j]
            dx_gap += gap[k] * dw
        q = r[Q, j]
        scale = model.area0 * q if model.mobile else 1.0
        voltage = slow[n] * r[SOURCE, j] + v * scale
        lam = slow[n + 1] * dv * scale + (slow[n + 2] + q * slow[n + 3]) * voltage
        if model.mobile:
            rate[j] = lam / q
            # i = Q' with Q = A U / S + z, and u' from the area equation.
            margin = 1.0 - r[X_GAP, j] * model.area0 * r[DQ, j]
            du = (model.k_gap * r[SLOPE, j] + dx_gap * scale) / margin
            current[j] = rate[j] + (r[SLOPE, j] / q - r[DQ, j] * du * r[SOURCE, j] / (q * q)) / model.s
        else:
            rate[j] = (lam + r[SLOPE, j] / model.s) / q
            current[j] = rate[j]


@jit_rows
def _integrate(integral: FloatArray, h: float, z0: float, rate: FloatArray, z: FloatArray) -> None:
    """z at the nodes from z' there; in place is allowed."""
    total = np.zeros(NODES)
    for m in range(NODES):
        for j in range(NODES):
            total[j] += integral[m, j] * rate[m]
    for j in range(NODES):
        z[j] = z0 + h * total[j]


@jit_rows
def _layers(
    mobile: bool, area0: float, k_layer: FloatArray, live: FloatArray, w: FloatArray, source: FloatArray, q: FloatArray,
    values: FloatArray,
) -> None:  # fmt: skip
    """Live layer voltages at the nodes."""
    for i in range(w.shape[0]):
        for j in range(NODES):
            values[i, j] = 0.0
        for k in range(w.shape[0]):
            share = live[i, k]
            for j in range(NODES):
                values[i, j] += share * w[k, j]
        if mobile:
            for j in range(NODES):
                values[i, j] *= area0 * q[j]
        share = k_layer[i]
        for j in range(NODES):
            values[i, j] += share * source[j]


@jit_rows
def _clenshaw_block(series: FloatArray, x: FloatArray, b1: FloatArray, b2: FloatArray, out: FloatArray) -> None:
    """The series at _BLOCK places at once."""
    for i in range(_BLOCK):
        b1[i] = 0.0
        b2[i] = 0.0
    for d in range(NODES - 1, 0, -1):
        c = series[d]
        for i in range(_BLOCK):
            b0 = c + 2.0 * x[i] * b1[i] - b2[i]
            b2[i] = b1[i]
            b1[i] = b0
    for i in range(_BLOCK):
        out[i] = series[0] + x[i] * b1[i] - b2[i]


@jit
def _write_outputs(
    t: float, h: float, reached: float, t_new: float, series: FloatArray, block: FloatArray,
    counters: IntArray, t_out: FloatArray, left: NDArray[np.bool_], out: FloatArray,
) -> None:  # fmt: skip
    """Outputs of one step: right-hand ones in [t, t_new), left-hand ones in (t, t_new]."""
    x = block[0]
    scale = 2.0 / h
    while True:
        first = counters[OUTPUT]
        count = 0
        while count < _BLOCK and first + count < t_out.size:
            time = t_out[first + count]
            if time > t_new or (time == t_new and not left[first + count]):
                break
            x[count] = min(max((time - t) * scale - 1.0, -1.0), 2.0 * reached - 1.0)
            count += 1
        if count == 0:
            return
        for column in range(out.shape[0]):
            _clenshaw_block(series[column], x, block[1], block[2], block[3])
            for i in range(count):
                out[column, first + i] = block[3, i]
        counters[OUTPUT] += count


@jit_rows
def _account(stress: float, u: FloatArray, q: FloatArray, theta: float, run_error: float, control: FloatArray) -> None:
    """Peaks of gap voltage and force, and the largest error of each, over the part of a step that counts."""
    peak_u = control[PEAK_U]
    peak_f = control[PEAK_F]
    steepest = 0.0
    for j in range(NODES):
        if POINTS[j] <= theta:
            size = abs(u[j])
            pressure = stress * size / q[j]
            peak_u = max(peak_u, size)
            peak_f = max(peak_f, pressure * size)
            # F ~ u^2 A: what moves u by du moves F by at most 2 F du / u, as the area falls with u.
            steepest = max(steepest, 2.0 * pressure)
    control[PEAK_U] = peak_u
    control[PEAK_F] = peak_f
    control[ERROR_U] = max(control[ERROR_U], run_error)
    control[ERROR_F] = max(control[ERROR_F], run_error * steepest)


@jit
def _change_level(live: FloatArray, project: FloatArray, old: int, new: int, error: FloatArray) -> None:
    """Carry the modes' error from one reference area to another."""
    n = live.shape[1]
    x = np.zeros(n)
    for i in range(n):
        for k in range(n):
            x[i] += live[old, i, k] * error[k]
    for k in range(n):
        error[k] = 0.0
        for i in range(n):
            error[k] += project[new, k, i] * x[i]


@jit
def march(
    system: System,
    pace: Pace,
    tables: Tables,
    work: Work,
    integral: FloatArray,
    edges: FloatArray,
    terms: FloatArray,
    series: FloatArray,
    t_end: float,
    y: FloatArray,
    error: FloatArray,
    control: FloatArray,
    counters: IntArray,
    t_out: FloatArray,
    left: NDArray[np.bool_],
    out: FloatArray,
) -> int:
    """Step to `t_end` through the source's segments, writing outputs on the way.

    Parameters
    ----------
    system, pace, tables, work, integral
        What to step, how and where; `integral` is `lobatto.integral_table()`.
    edges : ndarray, shape (m + 1,)
        Segment edges, s; `terms` (m, k, 6) and `series` (m, l) hold the source on each (see `Segment`).
    t_end : float
        Where to stop, s; not past the last edge.
    y : ndarray, shape (n + 1,)
        Live voltages (V) and charge (C), updated in place.
    error : ndarray, shape (n + 1,)
        Estimated error of the modes, signed, and the reference area it belongs to; updated in place.
    control, counters : ndarray
        Bookkeeping, updated in place.
    t_out, left, out : ndarray
        Output times (ascending), whether the left-hand value is meant, and the columns to fill: live layer voltages
        (n), then charge and current if wanted.

    Returns
    -------
    int
        DONE, NO_STEP (no step is short enough: a fold, or an error that cannot be met) or OUT_OF_RANGE (a gap voltage
        beyond the range of the area's polynomial).
    """
    # Arrays are taken out of their tuples once: doing it where they are used costs more than the use.
    model = system.model
    mobile, coupled, k_gap, area0, tau = model.mobile, model.coupled, model.k_gap, model.area0, model.tau
    curve, k_layer = borrow(model.curve), borrow(model.k)
    q0, powers, slopes = borrow(system.q0), borrow(system.powers), borrow(system.slopes)
    all_rates, all_gain, all_push, all_gap = (
        borrow(system.rates), borrow(system.gain), borrow(system.push), borrow(system.gap)
    )  # fmt: skip
    all_slow, all_turn, all_live, all_project = (
        borrow(system.slow), borrow(system.turn), borrow(system.live), borrow(system.project)
    )  # fmt: skip
    lo, scale, stress, u_top = system.lo, system.scale, system.stress, system.u_top
    keys_h, keys_level, count = borrow(tables.h), borrow(tables.level), borrow(tables.used)
    all_decay, all_phi, all_miss = borrow(tables.decay), borrow(tables.phi), borrow(tables.miss)
    tol, charge, controlled = pace.tol, pace.charge, pace.controlled
    terms, series, y, error, control = borrow(terms), borrow(series), borrow(y), borrow(error), borrow(control)
    counters = borrow(counters)
    r, base, w, pull, used = borrow(work.r), borrow(work.base), borrow(work.w), borrow(work.pull), borrow(work.used)
    w0, places, block = borrow(work.w0), borrow(work.places), borrow(work.block)
    values, coefficients = borrow(work.values), borrow(work.coefficients)
    u_rows, q_rows, source_row = r[U], r[Q], r[SOURCE]
    n = model.gap.size
    columns = out.shape[0]
    level, slot = -1, -1
    rates, gain, push, gap = all_rates[0], all_gain[0], all_push[0], all_gap[0]
    slow_share, turn, live, project = all_slow[0], all_turn[0], all_live[0], all_project[0]
    decay, phi, miss = all_decay[0], all_phi[0], all_miss[0]
    h_slot = 0.0
    flips = 0
    next_out = t_out[counters[OUTPUT]] if counters[OUTPUT] < t_out.size else math.inf
    index = -1
    start = 0.0
    edge = control[T]
    segment_terms, segment_series = terms[0], series[0]
    if edges[0] < control[T]:
        index = np.searchsorted(edges, control[T], side="right") - 2
    while control[T] < t_end:
        t = control[T]
        if t >= edge:
            index += 1
            start = edges[index]
            edge = edges[index + 1]
            if edge <= t:
                continue
            segment_terms, segment_series = terms[index], series[index]
            _enter(model, charge, Segment(start, edge - start, segment_terms, segment_series), t - start, y, control)
            control[H] = 0.0
            if control[U_GAP] != control[U_GAP]:
                return NO_STEP
        t0 = t - start
        stop = min(edge, t_end)
        if q0.size > 1 or level < 0:
            now = 0
            if q0.size > 1:
                q, _ = branch_area(model, control[SIGN], control[U_GAP])
                now = _nearest_level(q0, q)
            if now != level:
                if error[n] != now:
                    _change_level(all_live, all_project, int(error[n]), now, error)
                    error[n] = now
                level = now
                h_slot = 0.0
                rates, gain, push, gap = all_rates[level], all_gain[level], all_push[level], all_gap[level]
                slow_share, turn = all_slow[level], all_turn[level]
                live, project = all_live[level], all_project[level]
        for k in range(n):
            w0[k] = 0.0
            for i in range(n):
                w0[k] += project[k, i] * y[i]
        h = _choose_step(pace, tau, coupled, segment_series.size > 0, t, stop - t, control)
        run_error = 0.0
        wrong = 0
        flip = False
        wanted = control[H]
        while True:
            if h != h_slot:
                slot = make_tables(
                    rates, level, h, keys_h, keys_level, count, all_decay, all_phi, all_miss
                )  # fmt: skip
                h_slot = h
                decay, phi, miss = all_decay[slot], all_phi[slot], all_miss[slot]
            source_rows(segment_terms, segment_series, edge - start, t0, h, charge, r)
            sign = control[SIGN]
            if mobile:
                for i in range(ROWS):
                    r[GUESS, i] = control[U_GAP]
            passes, closed = converge(
                mobile, coupled, k_gap, area0, q0[level], gain, gap, push, turn, powers, slopes, lo, scale, curve, sign,
                decay, phi, w0, 0.1 * tol, base, w, pull, used, r,
            )  # fmt: skip
            counters[NFEV] += passes * NODES
            wrong = _first_wrong(u_rows, sign) if coupled else 0
            if wrong == 1 and flips < 2 and sign * u_rows[0] <= 1e-9 * abs(u_rows[1]):
                # The step starts at a zero and leaves on the other side.
                flip = True
                break
            step_error = math.inf
            if closed:
                step_error, run_error = assess(
                    mobile, area0, gain, gap, decay, phi, miss, error, w, pull, used, r, places
                )
            if not controlled and closed:
                break
            factor = 6.0
            if step_error > 0.0:
                factor = 0.9 * (tol / step_error) ** (1.0 / NODES) if step_error < math.inf else 0.5
            if step_error <= tol:
                # A step cut short by a boundary says little about the next one.
                control[H] = max(h * min(6.0, max(0.5, factor)), wanted if h < wanted else 0.0)
                break
            counters[REJECTED] += 1
            # Refused at this length: a singularity, of which rounding hides the last bit.
            if h <= 1e-13 * max(abs(t), 1e-3 * (edge - start)):
                return NO_STEP
            # Close to a fold the iteration closes on short steps only: methods that solve the area equation at
            # every evaluation get there sooner.
            if mobile and 1.0 - area0 * r[X_GAP, 0] * r[DQ, 0] < 0.01:
                return NO_STEP
            if wrong > 1 and sign * u_rows[END] < lo:
                # It went far over a zero, where the branch has no meaning: end soon after the zero.
                h = _rung(h * min(0.9, 1.1 * POINTS[wrong]))
            else:
                h = _rung(h * min(0.9, max(0.25, factor)))
                wanted = h
        if flip:
            control[SIGN] = -control[SIGN]
            flips += 1
            continue
        t_new = t + h
        theta = 1.0
        crossed = False
        if t_new >= stop or stop - t_new <= 1e-12 * h:
            t_new = stop
            theta = min(1.0, (stop - t) / h)
        if wrong > 0 and flips < 2:
            zero = _zero(u_rows, control[SIGN], wrong, coefficients[0])
            if t + zero * h <= t_new and zero <= theta:
                theta = zero
                t_new = t + zero * h
                crossed = True
                if t_new <= t:
                    control[SIGN] = -control[SIGN]
                    flips += 1
                    continue
        flips = 0
        if charge:
            _charge_rates(model, rates, gain, gap, slow_share, w, pull, r, values[n], values[n + 1])
            _integrate(integral, h, y[n], values[n], values[n])
        if next_out <= t_new:
            _layers(mobile, area0, k_layer, live, w, source_row, q_rows, values)
            for c in range(columns):
                _series_of(values[c], coefficients[c])
            _write_outputs(t, h, theta, t_new, coefficients, block, counters, t_out, left, out)
            next_out = t_out[counters[OUTPUT]] if counters[OUTPUT] < t_out.size else math.inf
        _account(stress, u_rows, q_rows, theta, run_error, control)
        if theta < 1.0:
            for k in range(n):
                w0[k] = _at(w[k], theta)
            _error_at(places, theta, error)
            if charge:
                y[n] = _at(values[n], theta)
            control[U_GAP] = 0.0 if crossed else _at(u_rows, theta)
        else:
            for k in range(n):
                w0[k] = w[k, END]
                error[k] = places[k, N_PLACES - 1]
            if charge:
                y[n] = values[n, END]
            control[U_GAP] = u_rows[END]
        for i in range(n):
            y[i] = 0.0
            for k in range(n):
                y[i] += live[i, k] * w0[k]
        if crossed:
            control[SIGN] = -control[SIGN]
            control[BRANCH_LENGTH] = t_new - control[BRANCH_START]
            control[BRANCH_START] = t_new
            counters[ZEROS] += 1
        control[T] = t_new
        if t_new >= stop:
            control[U_BEFORE], _ = source(Segment(start, edge - start, segment_terms, segment_series), t_new - start)
        counters[ACCEPTED] += 1
        if control[PEAK_U] > u_top:
            return OUT_OF_RANGE
    return DONE
