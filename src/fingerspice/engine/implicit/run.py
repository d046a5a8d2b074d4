"""Radau collocation on a network: steps, zeros of the gap voltages, jumps of the sources, outputs."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fingerspice.base.arrays import FloatArray, IntArray
from fingerspice.base.compiled import borrow, jit
from fingerspice.engine.collocation.readout import note
from fingerspice.engine.implicit.step import (
    NFEV,
    Nodal,
    dense_polynomial,
    dense_state,
    guess,
    linearise,
    step,
)
from fingerspice.engine.network import (
    at_sources,
    choose_signs,
    gap_voltage,
    rates,
)
from fingerspice.numerics.small import copy_to

# Codes returned by `advance`.
DONE, JUMP, STEP_UNDERFLOW, PAUSED = 0, 1, 2, 3
# Entries of `control`, s: the last edge; the time since then (a number of its own, as steps after a jump may be shorter
# than the rounding of the absolute time); the next step (0: choose one); the first step after the last jump; whether
# that step is still to come (1 or 0); and the last step before a pause.
BASE, T, H, H_AFTER_JUMP, JUMPED, BEFORE = 0, 1, 2, 3, 4, 5
N_CONTROL = 6
# Entries of `counters`, after the evaluations.
ACCEPTED, REJECTED, ZEROS, OUTPUT = 1, 2, 3, 4
N_COUNTERS = 5
# Steps between pauses, about a tenth of a second of computation: in a pause Python can handle a Ctrl-C and count steps.
STEPS_AT_ONCE = 250
# The shortest step is the sum of these shares of the time since the last edge and of the time to the next edge. The
# first vanishes at the edge: a transient right after it may be faster than the rounding of the absolute time.
SHORTEST, SHORTEST_FIRST = 1e-15, 1e-25
# A relative change of a source at an edge up to this size is rounding, not a jump.
ROUNDING = 1e-14


class Passage(NamedTuple):
    """An integration by implicit steps in progress."""

    # y, s_before: State, and the sources' values just before the time reached; updated
    y: FloatArray
    s_before: FloatArray
    # control, counters, peaks: Bookkeeping, updated; peaks (n_area,) in V
    control: FloatArray
    counters: IntArray
    peaks: FloatArray
    charge: bool  # Whether the output rows contain the sources' currents
    # t_out, left, rows: Output times (s, ascending), whether the left-hand limit is meant, and the rows to fill: the
    # state, then the currents
    t_out: FloatArray
    left: NDArray[np.bool_]
    rows: FloatArray
    # (n, 4): Ring buffer of the last steps tried: start and length (s), ratio of the error to the allowed one, number
    # from 1
    tried: FloatArray


@jit
def _signed(c: Nodal, i: int, t: float, h: float, theta: float, y: FloatArray) -> float:
    """Gap voltage i (V) at fraction `theta` of a step, times the sign of its branch: negative off the branch."""
    _look(c, t, h, theta, y)
    off: float = c.sign[i] * gap_voltage(c.net, c.room, i, c.work.stage)
    return off


@jit
def _look(c: Nodal, t: float, h: float, theta: float, y: FloatArray) -> None:
    """State and sources at fraction `theta` of the step that starts at y, into `work.stage` and `room`."""
    dense_state(theta, y, c.work.poly, c.work.stage)
    at_sources(c.sources, c.work.place, c.work.base[0], t + theta * h, c.room.s, c.room.ds)


@jit
def _first_zero(c: Nodal, t: float, h: float, y: FloatArray) -> tuple[float, int]:
    """First fraction of the step at which a gap voltage leaves its branch, and the index of its area; 2 and -1 if none.

    Each gap voltage is sampled at the eighths of the step, and its sign change found by regula falsi.
    """
    first = 2.0
    which = -1
    for i in range(c.sign.size):
        if c.net.gap[i] < 0:
            continue
        lo = 0.0
        f_lo = _signed(c, i, t, h, 0.0, y)
        hi = 0.0
        f_hi = 0.0
        for part in range(1, 9):
            hi = 0.125 * part
            f_hi = _signed(c, i, t, h, hi, y)
            if f_hi < 0.0:
                break
            lo = hi
            f_lo = f_hi
        if not f_hi < 0.0 or lo >= first:
            continue
        if f_lo > 0.0:
            for _ in range(100):
                mid = (lo * f_hi - hi * f_lo) / (f_hi - f_lo)
                if not lo < mid < hi:
                    mid = 0.5 * (lo + hi)
                if not lo < mid < hi:
                    break
                f_mid = _signed(c, i, t, h, mid, y)
                # Illinois variant of regula falsi: the value at the end that stays is halved.
                if f_mid < 0.0:
                    hi = mid
                    f_hi = f_mid
                    f_lo *= 0.5
                else:
                    lo = mid
                    f_lo = f_mid
                    f_hi *= 0.5
                if hi - lo <= 4e-16 or f_mid == 0.0:
                    break
        if hi < first:
            first = hi if f_lo > 0.0 else lo
            which = i
    return first, which


@jit
def _write_outputs(c: Nodal, run: Passage, t: float, h: float, t_new: float) -> None:
    """Write the outputs of one step: right-hand limits in [t, t_new), left-hand limits in (t, t_new]."""
    n_s, y, work, counters = c.net.b.shape[1], run.y, c.work, run.counters
    while counters[OUTPUT] < run.t_out.size:
        i = counters[OUTPUT]
        since = run.t_out[i] - work.base[0]
        if since > t_new or (since == t_new and not run.left[i]):
            return
        _look(c, t, h, max(0.0, min((since - t) / h, 1.0)), y)
        for j in range(y.size):
            run.rows[i, j] = work.stage[j]
        if run.charge:
            rates(c.net, c.room, False, work.stage, c.sign, work.rate)
            for j in range(n_s):
                run.rows[i, y.size + j] = work.rate[y.size - n_s + j]
        counters[OUTPUT] += 1


@jit
def _account(c: Nodal, run: Passage, t: float, h: float) -> None:
    """Update the largest |gap voltage| of every area (V), sampled at the ends and the quarters of a step."""
    for part in range(5):
        _look(c, t, h, 0.25 * part, run.y)
        for i in range(run.peaks.size):
            if c.net.gap[i] >= 0:
                run.peaks[i] = max(run.peaks[i], abs(gap_voltage(c.net, c.room, i, c.work.stage)))


@jit
def _next_edge(c: Nodal, t: float, t_end: float) -> float:
    """The next edge of a source after t, or `t_end` (s); the segments at t go into `work.place`."""
    sources, place, stop = c.sources, c.work.place, t_end
    for i in range(place.size):
        while sources.edges[sources.first[i] + place[i] + 1] <= t:
            place[i] += 1
        stop = min(stop, sources.edges[sources.first[i] + place[i] + 1])
    return stop


@jit
def _prepare(c: Nodal, run: Passage, now: FloatArray, slopes: FloatArray) -> bool:
    """Derivative of the state, into `work.rate`, and of the residual, where the sources are `now`; False at a fold."""
    copy_to(c.room.s, now)
    copy_to(c.room.ds, slopes)
    for i in range(c.sign.size):
        if c.sign[i] == 0.0:
            choose_signs(c.net, c.room, c.jump, run.y, c.sign)
            break
    if not rates(c.net, c.room, c.jump, run.y, c.sign, c.work.rate):
        return False
    copy_to(c.work.start, c.work.rate)
    linearise(c, run.y)
    run.counters[NFEV] += 2 + c.work.slope.shape[0]
    return True


@jit
def _length(c: Nodal, run: Passage, room_left: float) -> float:
    """Length of the next step, s: no more than is left to the next edge."""
    h, longest = run.control[H], c.scheme.h_max
    if h == 0.0:
        fastest = 0.0
        for j in range(c.work.slope.shape[0]):
            fastest = max(fastest, abs(c.work.start[j]) / c.scale[j])
        h = min(longest, 0.1 / fastest if fastest > 0.0 else math.inf, room_left)
    h = min(h, longest)
    if h >= room_left * (1.0 - 1e-10):
        return room_left
    return 0.5 * room_left if 2.0 * h > room_left else h


@jit
def _accepted(
    c: Nodal, run: Passage, t: float, h: float, h_before: float, room_left: float
) -> tuple[float, float]:  # fmt: skip
    """Solve a step with ever shorter lengths until its error is small enough: the length (s; 0: none is), the error."""
    counters = run.counters
    while True:
        guess(c.scheme, c.work, c.work.start, h, h_before)
        norm = step(c, t, h, run.y, counters)
        note(run.tried, counters[ACCEPTED] + counters[REJECTED], c.work.base[0] + t, h, norm)
        if norm <= 1.0:
            return h, norm
        counters[REJECTED] += 1
        h *= 0.25 if norm == math.inf else max(0.2, 0.9 * norm ** (-1.0 / c.scheme.c.size))
        if h <= SHORTEST * t + SHORTEST_FIRST * room_left:
            return 0.0, norm


@jit
def _move(c: Nodal, run: Passage, t: float, h: float, stop: float, last: bool) -> None:
    """Write the outputs of a step, and move to its end: to `stop` (s) if it is the `last` one before an edge."""
    control, base = run.control, c.work.base[0]
    t_new = stop - base if last else t + h
    if not c.jump:
        _write_outputs(c, run, t, h, t_new)
    _account(c, run, t, h)
    copy_to(run.y, c.work.y1)
    if control[JUMPED] > 0.0:
        control[H_AFTER_JUMP] = h
        control[JUMPED] = 0.0
    at_sources(c.sources, c.work.place, base, t_new, run.s_before, c.room.ds)
    control[BASE], control[T] = (stop, 0.0) if last else (base, t_new)
    run.counters[ACCEPTED] += 1


@jit
def advance(c: Nodal, run: Passage, t_end: float) -> int:
    """Step a network to `t_end` (s) through the segments of its sources, writing outputs on the way.

    Returns DONE; JUMP: a source jumps at the time reached, and the caller must apply the jump first; STEP_UNDERFLOW; or
    PAUSED: call again.
    """
    c, run = borrow(c), borrow(run)
    work, control, counters, y, sign = c.work, run.control, run.counters, run.y, c.sign
    now, slopes = np.zeros(run.s_before.size), np.zeros(run.s_before.size)
    work.place[:] = 0
    h_before = control[BEFORE]
    control[BEFORE] = 0.0
    flips = 0
    pause = counters[ACCEPTED] + counters[REJECTED] + STEPS_AT_ONCE
    while control[BASE] + control[T] < t_end:
        base, t = control[BASE], control[T]
        work.base[0] = base
        stop = _next_edge(c, base + t, t_end)
        room_left = (stop - base) - t
        at_sources(c.sources, work.place, base, t, now, slopes)
        if not c.jump:
            for i in range(now.size):
                if abs(now[i] - run.s_before[i]) > ROUNDING * max(abs(now[i]), abs(run.s_before[i])):
                    return JUMP
        if not _prepare(c, run, now, slopes):
            return STEP_UNDERFLOW
        h, norm = _accepted(c, run, t, _length(c, run, room_left), h_before, room_left)
        if h == 0.0:
            return STEP_UNDERFLOW
        last = h == room_left
        proposed = h * min(6.0, 0.9 * norm ** (-1.0 / c.scheme.c.size) if norm > 0.0 else 6.0)
        dense_polynomial(work.k, c.scheme.dense, h, work.poly)
        theta, which = (2.0, -1) if flips > 1 else _first_zero(c, t, h, y)
        if theta < 1.0:
            t_new = t + theta * h
            if t_new <= t:
                # The zero is at the start of the step: change the branch without advancing.
                sign[which] = -sign[which]
                flips += 1
                h_before = 0.0
                continue
            # Repeat the step so that it ends on the zero: collocation is most accurate at the end of a step.
            h = t_new - t
            if not step(c, t, h, y, counters) <= 2.0:
                control[H] = 0.5 * h
                h_before = 0.0
                continue
            dense_polynomial(work.k, c.scheme.dense, h, work.poly)
            last = False
        flips = 0
        _move(c, run, t, h, stop, last)
        if which >= 0 and theta <= 1.0:
            sign[which] = -sign[which]
            counters[ZEROS] += 1
        control[H] = max(proposed, control[H]) if last and h < control[H] else proposed
        h_before = h
        if counters[ACCEPTED] + counters[REJECTED] >= pause and not c.jump:
            control[BEFORE] = h_before
            return PAUSED
    return DONE
