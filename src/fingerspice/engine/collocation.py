"""Radau collocation on a network: steps, zeros of the gap voltages, jumps of the sources, outputs."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fingerspice.base.arrays import FloatArray, IntArray
from fingerspice.base.borrowing import borrow
from fingerspice.base.compiled import jit
from fingerspice.engine.network import (
    Net,
    Room,
    Sources,
    at_sources,
    choose_signs,
    gap_voltage,
    rates,
)
from fingerspice.engine.radau import (
    NFEV,
    Scheme,
    Work,
    dense_polynomial,
    dense_state,
    guess,
    linearise,
    step,
)
from fingerspice.engine.readout import note
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


@jit
def _signed(
    net: Net, room: Room, work: Work, sources: Sources, i: int, sign: float, t: float, h: float, theta: float,
    y: FloatArray,
) -> float:  # fmt: skip
    """Gap voltage i (V) at fraction `theta` of a step, times the sign of its branch: negative off the branch."""
    dense_state(theta, y, work.poly, work.stage)
    at_sources(sources, work.place, work.base[0], t + theta * h, room.s, room.ds)
    return sign * gap_voltage(net, room, i, work.stage)


@jit
def _first_zero(
    net: Net, room: Room, work: Work, sources: Sources, t: float, h: float, y: FloatArray, sign: FloatArray
) -> tuple[float, int]:
    """First fraction of the step at which a gap voltage leaves its branch, and the index of its area; 2 and -1 if none.

    Each gap voltage is sampled at the eighths of the step, and its sign change found by regula falsi.
    """
    first = 2.0
    which = -1
    for i in range(sign.size):
        if net.gap[i] < 0:
            continue
        lo = 0.0
        f_lo = _signed(net, room, work, sources, i, sign[i], t, h, 0.0, y)
        hi = 0.0
        f_hi = 0.0
        for part in range(1, 9):
            hi = 0.125 * part
            f_hi = _signed(net, room, work, sources, i, sign[i], t, h, hi, y)
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
                f_mid = _signed(net, room, work, sources, i, sign[i], t, h, mid, y)
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
def _write_outputs(
    net: Net, room: Room, work: Work, sources: Sources, charge: bool, t: float, h: float, t_new: float, y: FloatArray,
    sign: FloatArray, counters: IntArray, t_out: FloatArray, left: NDArray[np.bool_], rows: FloatArray,
) -> None:  # fmt: skip
    """Write the outputs of one step: right-hand limits in [t, t_new), left-hand limits in (t, t_new]."""
    n_s = net.b.shape[1]
    while counters[OUTPUT] < t_out.size:
        i = counters[OUTPUT]
        since = t_out[i] - work.base[0]
        if since > t_new or (since == t_new and not left[i]):
            return
        theta = max(0.0, min((since - t) / h, 1.0))
        dense_state(theta, y, work.poly, work.stage)
        for j in range(y.size):
            rows[i, j] = work.stage[j]
        if charge:
            at_sources(sources, work.place, work.base[0], t + theta * h, room.s, room.ds)
            rates(net, room, False, work.stage, sign, work.rate)
            for j in range(n_s):
                rows[i, y.size + j] = work.rate[y.size - n_s + j]
        counters[OUTPUT] += 1


@jit
def _account(
    net: Net, room: Room, work: Work, sources: Sources, t: float, h: float, y: FloatArray, peaks: FloatArray
) -> None:
    """Update the largest |gap voltage| of every area (V), sampled at the ends and the quarters of a step."""
    for part in range(5):
        dense_state(0.25 * part, y, work.poly, work.stage)
        at_sources(sources, work.place, work.base[0], t + 0.25 * part * h, room.s, room.ds)
        for i in range(peaks.size):
            if net.gap[i] >= 0:
                peaks[i] = max(peaks[i], abs(gap_voltage(net, room, i, work.stage)))


@jit
def advance(
    net: Net, room: Room, scheme: Scheme, work: Work, sources: Sources, jump: bool, charge: bool, t_end: float,
    y: FloatArray, sign: FloatArray, s_before: FloatArray, scale: FloatArray, tol: float, control: FloatArray,
    counters: IntArray, peaks: FloatArray, t_out: FloatArray, left: NDArray[np.bool_], rows: FloatArray,
    tried: FloatArray,
) -> int:  # fmt: skip
    """Step a network to `t_end` through the segments of its sources, writing outputs on the way.

    Parameters
    ----------
    net, scheme, sources
        The network, the Runge-Kutta scheme and the sources; `room` and `work` are scratch arrays.
    jump : bool
        Whether the sources' "time" is the fraction of a jump.
    charge : bool
        Whether the output rows contain the sources' currents.
    t_end : float
        Where to stop, s; not past the last edge.
    y, sign, s_before : ndarray
        State, branch of each area (0: choose) and the sources' values just before the time reached; updated.
    scale : ndarray, shape (size,)
        Size of each entry of the state, to which its error is relative.
    tol : float
        Error allowed in a step, as a fraction of `scale`.
    control, counters, peaks : ndarray
        Bookkeeping, updated; peaks (n_area,) in V.
    t_out, left, rows : ndarray
        Output times (s, ascending), whether the left-hand limit is meant, and the rows to fill: the state, then the
        currents.
    tried : ndarray, shape (n, 4)
        Ring buffer of the last steps tried: start and length (s), ratio of the error to the allowed one, number from 1.

    Returns
    -------
    int
        DONE; JUMP: a source jumps at the time reached, and the caller must apply the jump first; STEP_UNDERFLOW; or
        PAUSED: call again.
    """
    net, room, work, scheme, sources = borrow(net), borrow(room), borrow(work), borrow(scheme), borrow(sources)
    y, sign, s_before, scale = borrow(y), borrow(sign), borrow(s_before), borrow(scale)
    control, counters, peaks = borrow(control), borrow(counters), borrow(peaks)
    t_out, left, rows = borrow(t_out), borrow(left), borrow(rows)
    n_s = s_before.size
    now = np.zeros(n_s)
    slopes = np.zeros(n_s)
    work.place[:] = 0
    h_before = control[BEFORE]
    control[BEFORE] = 0.0
    flips = 0
    pause = counters[ACCEPTED] + counters[REJECTED] + STEPS_AT_ONCE
    while control[BASE] + control[T] < t_end:
        base = control[BASE]
        t = control[T]
        work.base[0] = base
        stop = t_end
        for i in range(n_s):
            while sources.edges[sources.first[i] + work.place[i] + 1] <= base + t:
                work.place[i] += 1
            stop = min(stop, sources.edges[sources.first[i] + work.place[i] + 1])
        room_left = (stop - base) - t
        at_sources(sources, work.place, base, t, now, slopes)
        if not jump:
            for i in range(n_s):
                if abs(now[i] - s_before[i]) > ROUNDING * max(abs(now[i]), abs(s_before[i])):
                    return JUMP
        copy_to(room.s, now)
        copy_to(room.ds, slopes)
        for i in range(sign.size):
            if sign[i] == 0.0:
                choose_signs(net, room, jump, y, sign)
                break
        if not rates(net, room, jump, y, sign, work.rate):
            return STEP_UNDERFLOW
        start = work.rate.copy()
        linearise(net, room, work, jump, y, sign, scale)
        counters[NFEV] += 2 + work.slope.shape[0]
        h = control[H]
        if h == 0.0:
            fastest = 0.0
            for j in range(work.slope.shape[0]):
                fastest = max(fastest, abs(start[j]) / scale[j])
            h = min(scheme.h_max, 0.1 / fastest if fastest > 0.0 else math.inf, room_left)
        h = min(h, scheme.h_max)
        last = h >= room_left * (1.0 - 1e-10)
        if last:
            h = room_left
        elif 2.0 * h > room_left:
            h = 0.5 * room_left
        while True:
            guess(scheme, work, start, h, h_before)
            norm = step(net, room, scheme, work, sources, jump, t, h, y, sign, scale, tol, counters)
            note(tried, counters[ACCEPTED] + counters[REJECTED], base + t, h, norm)
            if norm <= 1.0:
                break
            counters[REJECTED] += 1
            h *= 0.25 if norm == math.inf else max(0.2, 0.9 * norm ** (-1.0 / scheme.c.size))
            last = False
            if h <= SHORTEST * t + SHORTEST_FIRST * room_left:
                return STEP_UNDERFLOW
        proposed = h * min(6.0, 0.9 * norm ** (-1.0 / scheme.c.size) if norm > 0.0 else 6.0)
        dense_polynomial(work.k, scheme.dense, h, work.poly)
        theta, which = (2.0, -1) if flips > 1 else _first_zero(net, room, work, sources, t, h, y, sign)
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
            if not step(net, room, scheme, work, sources, jump, t, h, y, sign, scale, tol, counters) <= 2.0:
                control[H] = 0.5 * h
                h_before = 0.0
                continue
            dense_polynomial(work.k, scheme.dense, h, work.poly)
            last = False
        flips = 0
        t_new = stop - base if last else t + h
        if not jump:
            _write_outputs(net, room, work, sources, charge, t, h, t_new, y, sign, counters, t_out, left, rows)
        _account(net, room, work, sources, t, h, y, peaks)
        if which >= 0 and theta <= 1.0:
            sign[which] = -sign[which]
            counters[ZEROS] += 1
        copy_to(y, work.y1)
        if control[JUMPED] > 0.0:
            control[H_AFTER_JUMP] = h
            control[JUMPED] = 0.0
        control[H] = max(proposed, control[H]) if last and h < control[H] else proposed
        at_sources(sources, work.place, base, t_new, s_before, slopes)
        control[BASE], control[T] = (stop, 0.0) if last else (base, t_new)
        h_before = h
        counters[ACCEPTED] += 1
        if counters[ACCEPTED] + counters[REJECTED] >= pause and not jump:
            control[BEFORE] = h_before
            return PAUSED
    return DONE
