"""Radau collocation on a network: steps, zeros of the gap voltages, jumps of the sources, outputs.

A step is solved by simplified Newton iterations in the eigenvectors of the tableau, and has a dense output.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fingerspice.base.arrays import ComplexArray, FloatArray, IntArray
from fingerspice.base.compiled import borrow, jit
from fingerspice.engine import network
from fingerspice.engine.collocation.readout import note
from fingerspice.engine.collocation.step_control import leaves
from fingerspice.numerics.lobatto import NODES, POINTS, ROWS, Scheme
from fingerspice.numerics.modes import copy_to, solve

# Entry of `counters`: evaluations of the right-hand side.
NFEV = 0
# Error that Newton's method may leave, over the error allowed in a step.
CONVERGED = 0.01
# Length over which a step's polynomial is extrapolated for a guess of the next step, over the step's own length.
FARTHEST = 2.0


class Work(NamedTuple):
    """Arrays of one integration."""

    k: FloatArray
    poly: FloatArray
    slope: FloatArray
    mass: FloatArray
    weight: FloatArray
    newton: ComplexArray
    rate: FloatArray
    stage: FloatArray
    y1: FloatArray
    residual: FloatArray
    place: IntArray
    s: FloatArray
    ds: FloatArray


class Nodal(NamedTuple):
    """An integration of a network by implicit steps in progress; `room` and `work` are scratch arrays."""

    net: network.Net
    room: network.Room
    scheme: Scheme
    work: Work
    sources: network.Sources
    jump: bool  # Whether the sources' "time" is the fraction of a jump
    scale: FloatArray  # (size,): Size of each entry of the state, to which its error is relative
    tol: float  # Error allowed in a step, as a fraction of `scale`
    # y, s_before, sign: State, the sources' values just before the time reached, and the branch of each area (0: to be
    # chosen); updated
    y: FloatArray
    s_before: FloatArray
    sign: FloatArray
    # control, counters, peaks: Bookkeeping, updated; peaks (n_area,) in V
    control: FloatArray
    counters: IntArray
    peaks: FloatArray
    # (n, 4): Ring buffer of the last steps tried: start and length (s), ratio of the error to the allowed one, number
    # from 1
    tried: FloatArray
    charge: bool  # Whether the output rows contain the sources' currents
    # t_out, left, rows: Output times (s, ascending), whether the left-hand limit is meant, and the rows to fill: the
    # state, then the currents
    t_out: FloatArray
    left: NDArray[np.bool_]
    rows: FloatArray


@jit
def new_work(net: network.Net, stages: int, n_eigen: int, size: int) -> Work:
    """Room for steps of a state of `size`."""
    n_s = net.b.shape[1]
    m = size - n_s
    return Work(
        np.zeros((stages, size)), np.zeros((size, stages)), np.zeros((m, m)), np.zeros((m, m)), np.zeros(m),
        np.zeros((n_eigen, m, m), np.complex128), np.zeros(size), np.zeros(size), np.zeros(size),
        np.zeros((stages, m)), np.zeros(n_s, np.int64), np.zeros((stages, n_s)), np.zeros((stages, n_s)),
    )  # fmt: skip


@jit
def linearise(c: Nodal) -> None:
    """Derivatives of the residual by the state (by differences) and by its time derivative, at `work.rate`.

    Only for the part of the state on which the residual depends; each row is divided by its largest capacitance,
    because currents are tiny beside the derivatives of areas. The sources are those in `room`.
    """
    net, room, work, jump, sign, scale, y = c.net, c.room, c.work, c.jump, c.sign, c.scale, c.y
    n = net.k.shape[0]
    m = work.slope.shape[0]
    network.capacitances(net, room, y, sign)
    work.mass[:] = np.eye(m)
    work.mass[:n, :n] = room.matrix
    for i in range(m):
        work.weight[i] = 1.0 / np.abs(work.mass[i]).max()
    copy_to(work.stage, y)
    network.residual(net, room, jump, y, sign, work.rate, room.base)
    for j in range(m):
        change = 1e-7 * (abs(y[j]) + scale[j])
        work.stage[j] = y[j] + change
        network.residual(net, room, jump, work.stage, sign, work.rate, room.probe)
        work.stage[j] = y[j]
        for i in range(m):
            work.slope[i, j] = work.weight[i] * (room.probe[i] - room.base[i]) / change
            work.mass[i, j] *= work.weight[i]


@jit
def _prepare_newton(scheme: Scheme, work: Work, h: float) -> bool:
    """Inverses of M - h lambda J for every eigenvalue of the scheme."""
    m = work.slope.shape[0]
    matrix = np.zeros((m, m), np.complex128)
    for e in range(scheme.eigenvalues.size):
        for i in range(m):
            for j in range(m):
                matrix[i, j] = work.mass[i, j] - h * scheme.eigenvalues[e] * work.slope[i, j]
                work.newton[e, i, j] = 1.0 if i == j else 0.0
        if solve(matrix, work.newton[e]) == 0.0:
            return False
    return True


@jit
def _solve_newton(scheme: Scheme, work: Work) -> None:
    """(1 (x) M - h a (x) J)^-1 residual into `work.residual`."""
    stages, m = work.residual.shape
    left = np.zeros(m, np.complex128)
    turned = np.zeros((scheme.eigenvalues.size, m), np.complex128)
    for e in range(scheme.eigenvalues.size):
        for j in range(m):
            left[j] = 0.0
            for i in range(stages):
                left[j] += scheme.to[e, i] * work.residual[i, j]
        for i in range(m):
            for j in range(m):
                turned[e, i] += work.newton[e, i, j] * left[j]
    for i in range(stages):
        for j in range(m):
            total = 0.0
            for e in range(scheme.eigenvalues.size):
                total += (scheme.back[i, e] * turned[e, j]).real
            work.residual[i, j] = total


@jit
def _stage(c: Nodal, i: int, h: float) -> None:
    """State at a stage of a step, into `work.stage`, and the sources there."""
    scheme, work, y = c.scheme, c.work, c.y
    copy_to(c.room.s, work.s[i])
    copy_to(c.room.ds, work.ds[i])
    for j in range(y.size):
        value = 0.0
        for r in range(scheme.c.size):
            value += scheme.a[i, r] * work.k[r, j]
        work.stage[j] = y[j] + h * value


@jit
def _residuals(c: Nodal, h: float) -> None:
    """Weighted residuals of all stages into `work.residual`, and the charges' rates into `work.k`."""
    net, room, work, jump, sign = c.net, c.room, c.work, c.jump, c.sign
    stages, m = work.residual.shape
    for i in range(stages):
        _stage(c, i, h)
        network.residual(net, room, jump, work.stage, sign, work.k[i], room.base)
        for j in range(m):
            work.residual[i, j] = work.weight[j] * room.base[j]
        # Nothing depends on the charges: they are only integrated.
        for j in range(m, room.base.size):
            work.k[i, j] = room.base[j]
    c.counters[NFEV] += stages


@jit
def step(c: Nodal, t: float, h: float) -> float:
    """Collocation over [t, t + h] with `work.slope` as Newton's matrix: stages in `work.k`, the end in `work.y1`.

    `work.k` holds a guess of the stages. Returns the error over `tol` times `scale`; inf where it does not converge.
    """
    scheme, work, scale, tol, y = c.scheme, c.work, c.scale, c.tol, c.y
    stages, m = work.residual.shape
    if not _prepare_newton(scheme, work, h):
        return math.inf
    k = work.k
    for i in range(stages):
        network.at_sources(c.sources, work.place, c.control[BASE], t + scheme.c[i] * h, work.s[i], work.ds[i])
    before = math.inf
    for iteration in range(12):
        _residuals(c, h)
        _solve_newton(scheme, work)
        change = 0.0
        for i in range(stages):
            for j in range(m):
                k[i, j] += work.residual[i, j]
                value = abs(h * work.residual[i, j]) / scale[j]
                if not value <= change:
                    change = value
        if not change < math.inf or (iteration > 1 and change > before and change > tol):
            return math.inf
        # The remaining error, if every iteration reduces it by the same factor; or rounding errors, which do not fall.
        falls = change / before if iteration > 0 else 0.5
        left = change * falls / (1.0 - falls) if falls < 1.0 else math.inf
        if left <= CONVERGED * tol or (iteration > 2 and falls > 0.3 and change <= 1e-13):
            break
        before = change
    else:
        return math.inf
    if y.size > m and scale[m] < math.inf:
        # The charges' derivatives belong to the last iteration but one: evaluate them again if charges are wanted.
        _residuals(c, h)
    norm = 0.0
    for j in range(y.size):
        top = 0.0
        end = 0.0
        for r in range(stages):
            top += scheme.e[r] * k[r, j]
            end += scheme.a[stages - 1, r] * k[r, j]
        work.y1[j] = y[j] + h * end
        value = abs(h * top) / (tol * scale[j])
        if not value <= norm:
            norm = value
    if c.net.mobile and norm <= 1.0:
        # Beyond a fold there may be a solution that does not continue this one, and a step may reach it.
        for i in range(stages):
            _stage(c, i, h)
            if not network.rates(c.net, c.room, c.jump, work.stage, c.sign, c.room.base):
                return math.inf
    return norm if norm == norm else math.inf


@jit
def guess(scheme: Scheme, work: Work, h: float, h_before: float) -> None:
    """Guess of the next step's stages from the polynomial of the step before or, without one, from `work.rate`."""
    follows = h_before > 0.0 and h <= FARTHEST * h_before
    for i in range(scheme.c.size):
        theta = 1.0 + scheme.c[i] * h / h_before if follows else 0.0
        for j in range(work.rate.size):
            if follows:
                value = 0.0
                for d in range(work.poly.shape[1] - 1, -1, -1):
                    value = value * theta + (d + 1.0) * work.poly[j, d]
                work.k[i, j] = value / h_before
            else:
                work.k[i, j] = work.rate[j]


@jit
def dense_polynomial(k: FloatArray, dense: FloatArray, h: float, poly: FloatArray) -> None:
    """Coefficients (size, stages) of theta, theta^2, ... of the state's increment inside the step."""
    for j in range(poly.shape[0]):
        for d in range(poly.shape[1]):
            value = 0.0
            for r in range(dense.shape[0]):
                value += dense[r, d] * k[r, j]
            poly[j, d] = h * value


@jit
def dense_state(theta: float, y: FloatArray, poly: FloatArray, out: FloatArray) -> None:
    """State at fraction `theta` of the step that starts at `y`."""
    for j in range(y.size):
        value = 0.0
        for d in range(poly.shape[1] - 1, -1, -1):
            value = (value + poly[j, d]) * theta
        out[j] = y[j] + value


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
def _look(c: Nodal, t: float, h: float, theta: float) -> None:
    """State and sources at fraction `theta` of a step, into `work.stage` and `room`."""
    dense_state(theta, c.y, c.work.poly, c.work.stage)
    network.at_sources(c.sources, c.work.place, c.control[BASE], t + theta * h, c.room.s, c.room.ds)


@jit
def _first_zero(c: Nodal, t: float, h: float) -> tuple[float, int]:
    """First fraction of the step at which a gap voltage leaves its branch, and the index of its area; 2 and -1 if none.

    It is a zero of the polynomial through the gap voltage at the nodes of an exponential step.
    """
    u, series = np.zeros((c.sign.size, NODES)), np.zeros(ROWS)
    for j in range(NODES):
        _look(c, t, h, POINTS[j])
        for i in range(c.sign.size):
            if c.net.gap[i] >= 0:
                u[i, j] = network.gap_voltage(c.net, c.room, i, c.work.stage)
    first, which = 2.0, -1
    for i in range(c.sign.size):
        found = leaves(u[i], c.sign[i], 0.0, series)
        if found < first:
            first, which = found, i
    return first, which


@jit
def _write_outputs(c: Nodal, t: float, h: float, t_new: float) -> None:
    """Write the outputs of one step: right-hand limits in [t, t_new), left-hand limits in (t, t_new]."""
    n_s, size, work, counters = c.net.b.shape[1], c.y.size, c.work, c.counters
    while counters[OUTPUT] < c.t_out.size:
        i = counters[OUTPUT]
        since = c.t_out[i] - c.control[BASE]
        if since > t_new or (since == t_new and not c.left[i]):
            return
        _look(c, t, h, max(0.0, min((since - t) / h, 1.0)))
        for j in range(size):
            c.rows[i, j] = work.stage[j]
        if c.charge:
            network.rates(c.net, c.room, False, work.stage, c.sign, work.rate)
            for j in range(n_s):
                c.rows[i, size + j] = work.rate[size - n_s + j]
        counters[OUTPUT] += 1


@jit
def _account(c: Nodal, t: float, h: float) -> None:
    """Update the largest |gap voltage| of every area (V), sampled at the ends and the quarters of a step."""
    for part in range(5):
        _look(c, t, h, 0.25 * part)
        for i in range(c.peaks.size):
            if c.net.gap[i] >= 0:
                c.peaks[i] = max(c.peaks[i], abs(network.gap_voltage(c.net, c.room, i, c.work.stage)))


@jit
def _prepare(c: Nodal, now: FloatArray, slopes: FloatArray) -> bool:
    """Derivative of the state, into `work.rate`, and of the residual, where the sources are `now`; False at a fold."""
    copy_to(c.room.s, now)
    copy_to(c.room.ds, slopes)
    network.choose_signs(c.net, c.room, c.jump, c.y, c.sign)
    if not network.rates(c.net, c.room, c.jump, c.y, c.sign, c.work.rate):
        return False
    linearise(c)
    c.counters[NFEV] += 2 + c.work.slope.shape[0]
    return True


@jit
def _length(c: Nodal, room_left: float) -> float:
    """Length of the next step, s: no more than is left to the next edge."""
    h, longest = c.control[H], c.scheme.h_max
    if h == 0.0:
        fastest = 0.0
        for j in range(c.work.slope.shape[0]):
            fastest = max(fastest, abs(c.work.rate[j]) / c.scale[j])
        h = min(longest, 0.1 / fastest if fastest > 0.0 else math.inf, room_left)
    h = min(h, longest)
    if h >= room_left * (1.0 - 1e-10):
        return room_left
    return 0.5 * room_left if 2.0 * h > room_left else h


@jit
def _accepted(c: Nodal, t: float, h: float, h_before: float, room_left: float) -> tuple[float, float]:
    """Solve a step with ever shorter lengths until its error is small enough: the length (s; 0: none is), the error."""
    counters = c.counters
    while True:
        guess(c.scheme, c.work, h, h_before)
        norm = step(c, t, h)
        note(c.tried, counters[ACCEPTED] + counters[REJECTED], c.control[BASE] + t, h, norm)
        if norm <= 1.0:
            return h, norm
        counters[REJECTED] += 1
        h *= 0.25 if norm == math.inf else max(0.2, 0.9 * norm ** (-1.0 / c.scheme.c.size))
        if h <= SHORTEST * t + SHORTEST_FIRST * room_left:
            return 0.0, norm


@jit
def _move(c: Nodal, t: float, h: float, stop: float, last: bool) -> None:
    """Write the outputs of a step, and move to its end: to `stop` (s) if it is the `last` one before an edge."""
    control, base = c.control, c.control[BASE]
    t_new = stop - base if last else t + h
    if not c.jump:
        _write_outputs(c, t, h, t_new)
    _account(c, t, h)
    copy_to(c.y, c.work.y1)
    if control[JUMPED] > 0.0:
        control[H_AFTER_JUMP] = h
        control[JUMPED] = 0.0
    network.at_sources(c.sources, c.work.place, base, t_new, c.s_before, c.room.ds)
    control[BASE], control[T] = (stop, 0.0) if last else (base, t_new)
    c.counters[ACCEPTED] += 1


@jit
def _beyond(c: Nodal) -> int:
    """Number of gaps whose voltage has passed the largest one of their areas' curves."""
    count = 0
    for i in range(c.peaks.size):
        if c.net.gap[i] >= 0 and c.peaks[i] > c.net.curves[i, 1]:
            count += 1
    return count


@jit
def advance(c: Nodal, t_end: float) -> int:
    """Step a network to `t_end` (s) through the segments of its sources, writing outputs on the way.

    Returns DONE; JUMP: a source jumps at the time reached, and the caller must apply the jump first; STEP_UNDERFLOW; or
    PAUSED: call again, unless a gap's voltage has passed the end of its contact law.
    """
    c = borrow(c)
    work, control, counters, sign = c.work, c.control, c.counters, c.sign
    now, slopes = np.zeros(c.s_before.size), np.zeros(c.s_before.size)
    work.place[:] = 0
    h_before = control[BEFORE]
    control[BEFORE] = 0.0
    flips = 0
    pause = counters[ACCEPTED] + counters[REJECTED] + STEPS_AT_ONCE
    while control[BASE] + control[T] < t_end:
        base, t = control[BASE], control[T]
        stop = network.next_edge(c.sources, work.place, base + t, t_end)
        room_left = (stop - base) - t
        network.at_sources(c.sources, work.place, base, t, now, slopes)
        if not c.jump:
            for i in range(now.size):
                if abs(now[i] - c.s_before[i]) > ROUNDING * max(abs(now[i]), abs(c.s_before[i])):
                    return JUMP
        if not _prepare(c, now, slopes):
            return STEP_UNDERFLOW
        h, norm = _accepted(c, t, _length(c, room_left), h_before, room_left)
        if h == 0.0:
            return STEP_UNDERFLOW
        last = h == room_left
        proposed = h * min(6.0, 0.9 * norm ** (-1.0 / c.scheme.c.size) if norm > 0.0 else 6.0)
        dense_polynomial(work.k, c.scheme.dense, h, work.poly)
        theta, which = (2.0, -1) if flips > 1 else _first_zero(c, t, h)
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
            if not step(c, t, h) <= 2.0:
                control[H] = 0.5 * h
                h_before = 0.0
                continue
            dense_polynomial(work.k, c.scheme.dense, h, work.poly)
            last = False
        flips = 0
        beyond = _beyond(c)
        _move(c, t, h, stop, last)
        if which >= 0 and theta <= 1.0:
            sign[which] = -sign[which]
            counters[ZEROS] += 1
        control[H] = max(proposed, control[H]) if last and h < control[H] else proposed
        h_before = h
        if (counters[ACCEPTED] + counters[REJECTED] >= pause or _beyond(c) > beyond) and not c.jump:
            control[BEFORE] = h_before
            return PAUSED
    return DONE


def pass_jump(c: Nodal, before: FloatArray) -> bool:
    """Take the state through a jump of the sources from `before`, a ramp from 0 to 1; False where it meets a fold."""
    scheme, control, tried = c.scheme._replace(h_max=1.0), np.zeros(N_CONTROL), np.zeros_like(c.tried)
    through = c._replace(scheme=scheme, jump=True, s_before=before, control=control, tried=tried)
    return bool(advance(through, 1.0) == DONE)
