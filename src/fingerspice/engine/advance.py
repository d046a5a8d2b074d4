"""The stepping loop: segments of the source, zeros of the gap voltage, step control, outputs."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fingerspice.base.compiled import jit
from fingerspice.engine.crossing import first_zero
from fingerspice.engine.model import (
    Model,
    branch_area,
    choose_branch,
    dot,
    gap_voltage,
    jump_charge,
    ramp,
    right_hand_side,
    turns_at_zero,
    write_row,
)
from fingerspice.engine.readout import note
from fingerspice.engine.segment import Segment, source
from fingerspice.engine.steps import Method, dense_polynomial, dense_state, take_step

FloatArray = NDArray[np.float64]

# Codes returned by `advance`.
DONE, LOG_FULL, NO_SOLUTION, STEP_UNDERFLOW, TOO_MANY = 0, 1, 2, 3, 4
# Entries of `control`: time, next step (0: choose one), branch of the area (0: choose one), source voltage
# just before the time reached, last gap voltage, smallest distance to the fold met in logged places, the
# segment's start, and the time since: what decays there may be faster than the rounding of the time itself.
T, H, SIGN, U_BEFORE, U_GAP, MARGIN, START, SINCE = 0, 1, 2, 3, 4, 5, 6, 7
N_CONTROL = 8
# Entries of `counters`: evaluations, steps accepted and rejected, zeros met, outputs written, log rows written.
NFEV, ACCEPTED, REJECTED, ZEROS, OUTPUT, LOGGED = 0, 1, 2, 3, 4, 5
N_COUNTERS = 6
# Steps taken and refused in one call, at most.
MOST_STEPS = 20_000
# Distance at which a fold counts as met, and at which it is near.
_AT_FOLD, _NEAR_FOLD = 1e-6, 1e-2


@jit
def enter(model: Model, segment: Segment, t0: float, y: FloatArray, control: FloatArray) -> tuple[float, float]:
    """Source voltage and slope, `t0` s into a segment, after taking the jump that may stand there.

    The voltage is NaN where the jump goes past a fold; then nothing is taken.
    """
    u_source, du_source = source(segment, t0)
    x_gap = dot(model.gap, y)
    jump = u_source - control[U_BEFORE]
    if t0 == 0.0 or control[SIGN] == 0.0:
        if not model.mobile and jump != 0.0:
            y[-1] += jump_charge(model, x_gap, control[U_BEFORE], u_source)[0]
        if not abs(jump) <= 1e-3 * (abs(u_source) + abs(control[U_BEFORE])):
            control[H] = 0.0
        zero = model.k_gap * u_source + x_gap
        if model.mobile and control[SIGN] != 0.0:
            before = model.k_gap * control[U_BEFORE]
            u = gap_voltage(model, before, x_gap, control[SIGN], control[U_GAP])
            u = ramp(model, model.k_gap * u_source, x_gap, u)
            if u != u:
                return math.nan, du_source
            control[U_GAP] = u
            control[SIGN] = math.copysign(1.0, u)
        else:
            control[SIGN] = choose_branch(model, u_source, y)
            control[U_GAP] = model.k_gap * u_source
        control[U_BEFORE] = u_source
        if model.coupled and abs(zero) <= 1e-13 * (abs(model.k_gap * u_source) + abs(x_gap)):
            # At a zero the branch is the one the voltage is about to take.
            dy = np.empty(y.size)
            right_hand_side(model, u_source, du_source, y, control[SIGN], control[U_GAP], dy)
            control[SIGN] = 1.0 if model.k_gap * du_source + dot(model.gap, dy) >= 0.0 else -1.0
    return u_source, du_source


@jit
def _first_step(model: Model, method: Method, rate: float) -> float:
    """A step to start with: the shortest time constant, less what the tolerance asks of a method of this order.

    `rate` (1/s) is the speed of the state in units of the local error allowed.
    """
    h = min(method.h_max, model.tau)
    if rate > 0.0 and h < math.inf:
        h *= min(1.0, 2.0 * (1.0 / (rate * h)) ** (1.0 / (method.error_order + 1.0)))
    return h


@jit
def _choose_step(
    model: Model, method: Method, remaining: float, control: FloatArray, k0: FloatArray, scale: FloatArray
) -> tuple[float, bool]:
    """Next step, and whether it ends on the boundary `remaining` seconds away."""
    h = method.h_fixed
    if h <= 0.0:
        h = control[H]
        if h == 0.0:
            rate = 0.0
            for j in range(scale.size):
                rate = max(rate, abs(k0[j]) / scale[j])
            h = _first_step(model, method, rate)
            control[H] = h
        h = min(h, method.h_max)
        if h < remaining < 2.0 * h:
            return 0.5 * remaining, False
    if h >= remaining * (1.0 - 1e-10):
        return remaining, True
    return h, False


@jit
def _controlled_step(
    model: Model,
    method: Method,
    segment: Segment,
    since: float,
    remaining: float,
    least: float,
    y: FloatArray,
    scale: FloatArray,
    control: FloatArray,
    counters: NDArray[np.int64],
    k: FloatArray,
    us: FloatArray,
    y1: FloatArray,
    tried: FloatArray,
) -> tuple[float, bool]:
    """Step until the error is met.

    Returns the step (0: none above `least`, s, is small enough) and whether it ends the segment.
    """
    h, last = _choose_step(model, method, remaining, control, k[0], scale)
    while True:
        norm, nfev = take_step(model, method, segment, since, h, y, control[SIGN], control[U_GAP], scale, k, us, y1)
        counters[NFEV] += nfev
        note(tried, counters[ACCEPTED] + counters[REJECTED], segment.start + since, h, norm)
        factor = 6.0
        if norm > 0.0:
            factor = 0.25 if norm == math.inf else 0.9 * norm ** (-1.0 / method.error_order)
        if norm <= 1.0 or (method.h_fixed > 0.0 and norm < math.inf):
            # A step cut short by a boundary says little about the next one.
            proposed = h * min(6.0, max(0.3, factor))
            control[H] = max(proposed, control[H]) if h < control[H] else proposed
            return h, last
        counters[REJECTED] += 1
        h *= min(0.9, max(0.2, factor))
        control[H] = h
        last = False
        if h <= least:
            return 0.0, False


@jit
def _nearest(c: FloatArray, us: FloatArray, u_start: float, theta: float) -> float:
    """Gap voltage (V) of the stage nearest to fraction `theta` of a step, or of its start."""
    u = u_start
    distance = theta
    for i in range(c.size):
        if abs(c[i] - theta) < distance:
            distance = abs(c[i] - theta)
            u = us[i]
    return u


@jit
def _write_log(
    model: Model,
    segment: Segment,
    since: float,
    h: float,
    reached: float,
    stop: float,
    last: bool,
    c: FloatArray,
    us: FloatArray,
    y: FloatArray,
    poly: FloatArray,
    control: FloatArray,
    counters: NDArray[np.int64],
    log: FloatArray,
) -> None:
    """What the error estimate compares, in the middle and at the end of a step: time, gap voltage, 1/A.

    The `last` step ends at `stop`.
    """
    state = np.empty(y.size)
    before = segment.start + since
    for i in range(1, 3):
        # A time that another run of the same segment reads as the same one; a step below its rounding has none.
        t = segment.start + (since + 0.5 * i * reached * h)
        theta = (t - segment.start - since) / h
        if last and i == 2:
            t = stop
            theta = reached
        if not before < t <= stop or not 0.0 < theta <= reached:
            continue
        before = t
        dense_state(theta, y, poly, state)
        u_source, _ = source(segment, t - segment.start)
        x_gap = dot(model.gap, state)
        guess = _nearest(c, us, control[U_GAP], theta)
        u = gap_voltage(model, model.k_gap * u_source, x_gap, control[SIGN], guess)
        q, dq = branch_area(model, control[SIGN], u)
        if model.mobile and model.coupled:
            control[MARGIN] = min(control[MARGIN], 1.0 - model.area0 * x_gap * dq)
        row = log[counters[LOGGED]]
        row[0] = t
        row[1] = u
        row[2] = q
        counters[LOGGED] += 1


@jit
def _write_outputs(
    model: Model,
    segment: Segment,
    since: float,
    h: float,
    reached: float,
    ended: float,
    c: FloatArray,
    us: FloatArray,
    y: FloatArray,
    poly: FloatArray,
    control: FloatArray,
    counters: NDArray[np.int64],
    t_out: FloatArray,
    left: NDArray[np.bool_],
    rows: FloatArray,
) -> None:
    """Outputs of one step: right-hand ones from `since` to before `ended`, left-hand ones after it to `ended`."""
    state = np.empty(y.size)
    while counters[OUTPUT] < t_out.size:
        i = counters[OUTPUT]
        wanted = t_out[i] - segment.start
        if wanted > ended or (wanted == ended and not left[i]):
            return
        theta = max(0.0, min((wanted - since) / h, reached))
        dense_state(theta, y, poly, state)
        u_source, du_source = source(segment, since + theta * h)
        guess = _nearest(c, us, control[U_GAP], theta)
        write_row(model, u_source, du_source, state, control[SIGN], guess, rows[i])
        counters[OUTPUT] += 1


@jit
def advance(
    model: Model,
    method: Method,
    edges: FloatArray,
    terms: FloatArray,
    series: FloatArray,
    t_end: float,
    scale: FloatArray,
    y: FloatArray,
    control: FloatArray,
    counters: NDArray[np.int64],
    t_out: FloatArray,
    left: NDArray[np.bool_],
    rows: FloatArray,
    log: FloatArray,
    tried: FloatArray,
) -> int:
    """Step the model to `t_end` through the source's segments, writing outputs on the way.

    Parameters
    ----------
    model, method
        What to step, and how.
    edges : ndarray, shape (m + 1,)
        Segment edges, s; `terms` (m, k, 6) and `series` (m, l) hold the source on each (see `Segment`).
    t_end : float
        Where to stop, s; not past the last edge.
    scale : ndarray, shape (n + 1,)
        Local error allowed in a step, in V and C; under `mobile` at the area of 0 V.
    y, control, counters : ndarray
        State and bookkeeping, updated in place.
    t_out, left, rows : ndarray
        Output times (ascending), whether the left-hand value is meant, and the rows to fill (`write_row`).
    log : ndarray, shape (l, 3)
        See `_write_log`; with no rows nothing is logged.
    tried : ndarray, shape (n, 4)
        Takes the last steps tried, in turn: start and length (s), error over the one allowed, number from 1.

    Returns
    -------
    int
        DONE, LOG_FULL (call again), NO_SOLUTION (past a fold at the time reached), STEP_UNDERFLOW or TOO_MANY steps.
    """
    k = np.zeros((method.a.shape[0], y.size))
    us = np.zeros(method.a.shape[0])
    poly = np.zeros((y.size, method.dense.shape[1]))
    y1 = np.empty(y.size)
    allowed = scale.copy()
    counters[LOGGED] = 0
    flips = 0
    index = np.searchsorted(edges, control[T], side="right") - 1
    most = counters[ACCEPTED] + counters[REJECTED] + MOST_STEPS
    while control[T] < t_end:
        if counters[ACCEPTED] + counters[REJECTED] > most:
            return TOO_MANY
        while edges[index + 1] <= control[T]:
            index += 1
        start = edges[index]
        if control[START] != start:
            control[START] = start
            control[SINCE] = control[T] - start
        since = control[SINCE]
        stop = min(edges[index + 1], t_end)
        remaining = stop - start - since
        if remaining <= 0.0:
            # Nothing but rounding is left.
            control[T] = stop
            continue
        segment = Segment(start, edges[index + 1] - start, terms[index], series[index])
        u_source, du_source = enter(model, segment, since, y, control)
        if u_source != u_source:
            return NO_SOLUTION
        u = right_hand_side(model, u_source, du_source, y, control[SIGN], control[U_GAP], k[0])
        counters[NFEV] += 1
        if u != u:
            return NO_SOLUTION
        control[U_GAP] = u
        least = 1e-15 * since + 1e-25 * segment.length
        if model.mobile:
            q, dq = branch_area(model, control[SIGN], u)
            margin = 1.0 - dot(model.gap, y) * model.area0 * dq
            if margin < _AT_FOLD:
                return NO_SOLUTION
            if margin < _NEAR_FOLD:
                # What rounding leaves of the way is not worth its many steps.
                least = max(least, 1e-8 * since)
            # The state is a voltage at the area of 0 V.
            allowed[:] = scale / (model.area0 * q)
        h, last = _controlled_step(
            model, method, segment, since, remaining, least, y, allowed, control, counters, k, us, y1, tried
        )
        if h == 0.0:
            return STEP_UNDERFLOW
        dense_polynomial(k, method.dense, h, poly)
        theta = 2.0
        if model.coupled and flips < 2:
            theta = first_zero(model, segment, since, h, control[SIGN], u, y, poly)
        ended = stop - start if last else since + h
        if theta < 1.0:
            ended = since + theta * h
            last = False
        if ended <= since:
            # The zero is here: change branch without advancing.
            control[SIGN] = -control[SIGN]
            flips += 1
            continue
        flips = 0
        if theta < 1.0 and method.implicit:
            # Collocation is more exact at the end of a step than inside: step again to end on the zero.
            norm, nfev = take_step(
                model, method, segment, since, theta * h, y, control[SIGN], control[U_GAP], scale, k, us, y1
            )
            counters[NFEV] += nfev
            if norm < math.inf:
                h *= theta
                theta = 1.0
                dense_polynomial(k, method.dense, h, poly)
        reached = min(theta, 1.0)
        _write_outputs(
            model, segment, since, h, reached, ended, method.c, us, y, poly, control, counters, t_out, left, rows
        )
        if log.shape[0] > 0:
            _write_log(model, segment, since, h, reached, stop, last, method.c, us, y, poly, control, counters, log)
        if reached < 1.0:
            dense_state(reached, y, poly, y1)
        if theta <= 1.0:
            control[SIGN] = -control[SIGN]
            control[U_GAP] = 0.0
            counters[ZEROS] += 1
        if reached == 1.0 and theta > 1.0:
            control[U_GAP] = _nearest(method.c, us, control[U_GAP], 1.0)
        y[:] = y1
        control[SINCE] = ended
        control[T] = stop if last else min(start + ended, np.nextafter(stop, start))
        control[U_BEFORE], _ = source(segment, ended)
        counters[ACCEPTED] += 1
        if theta <= 1.0 and turns_at_zero(model, dot(model.gap, y), control[SIGN]):
            control[SIGN] = -control[SIGN]
            control[MARGIN] = 0.0
            return NO_SOLUTION
        if log.shape[0] > 0 and counters[LOGGED] + 2 > log.shape[0]:
            return LOG_FULL
    return DONE
