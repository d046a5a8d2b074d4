"""Radau collocation on a network: steps, zeros of the gap voltages, jumps of the sources, outputs."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fingerspice.compiled import borrow, jit, jit_inline
from fingerspice.engine.network import (
    Net,
    Room,
    Sources,
    at_sources,
    capacitances,
    choose_signs,
    gap_voltage,
    lend,
    lend_room,
    rates,
    residual,
)

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
IntArray = NDArray[np.int64]

# Codes returned by `advance`.
DONE, JUMP, STEP_UNDERFLOW, TOO_MANY = 0, 1, 2, 3
# Entries of `control`: an edge, the time since (steps after a jump may be shorter than the rounding of the time
# itself), the next step (0: choose one), the first step after the last jump, and whether that is looked for.
BASE, T, H, H_AFTER_JUMP, JUMPED = 0, 1, 2, 3, 4
N_CONTROL = 5
# Entries of `counters`.
NFEV, ACCEPTED, REJECTED, ZEROS, OUTPUT = 0, 1, 2, 3, 4
N_COUNTERS = 5
# Steps taken and refused, in a run: what needs more has a cause that smaller steps do not mend.
MOST_STEPS = 2_000_000
# A source's change at an edge, relative, that is its rounding and no jump.
ROUNDING = 1e-14
# What Newton's method leaves, over the error allowed in a step.
CONVERGED = 0.01
# How far a step's polynomial is followed past its end for a guess of the next one, in its own length.
FARTHEST = 2.0


class Scheme(NamedTuple):
    """Radau IIA as numbers (see `fingerspice.numerics.tableaus.Tableau`), with its matrix diagonalised.

    Attributes
    ----------
    a, c, e, dense : ndarray
        The tableau's; `e` (s,) gives the highest Legendre coefficient of the increment.
    eigenvalues : ndarray of complex, shape (m,)
        Of `a`: one of each conjugate pair, and the real one.
    to, back : ndarray of complex, shape (m, s) and (s, m)
        a = Re(back diag(eigenvalues) to).
    h_max : float
        s.
    """

    a: FloatArray
    c: FloatArray
    e: FloatArray
    dense: FloatArray
    eigenvalues: ComplexArray
    to: ComplexArray
    back: ComplexArray
    h_max: float


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
    base: FloatArray
    s: FloatArray
    ds: FloatArray


@jit
def new_work(net: Net, stages: int, n_eigen: int, size: int) -> Work:
    """Room for steps of a state of `size`."""
    n_s = net.b.shape[1]
    m = size - n_s
    return Work(
        np.zeros((stages, size)), np.zeros((size, stages)), np.zeros((m, m)), np.zeros((m, m)), np.zeros(m),
        np.zeros((n_eigen, m, m), np.complex128), np.zeros(size), np.zeros(size), np.zeros(size),
        np.zeros((stages, m)), np.zeros(n_s, np.int64), np.zeros(1), np.zeros((stages, n_s)), np.zeros((stages, n_s)),
    )  # fmt: skip


@jit_inline
def _lend_work(work: Work) -> Work:
    return Work(
        borrow(work.k), borrow(work.poly), borrow(work.slope), borrow(work.mass), borrow(work.weight),
        borrow(work.newton), borrow(work.rate), borrow(work.stage), borrow(work.y1), borrow(work.residual),
        borrow(work.place), borrow(work.base), borrow(work.s), borrow(work.ds),
    )  # fmt: skip


@jit
def _invert(matrix: ComplexArray) -> bool:
    """Inverse in place by Gauss-Jordan elimination with row pivoting; False where it is singular."""
    n = matrix.shape[0]
    order = np.arange(n)
    for column in range(n):
        pivot = column
        for row in range(column + 1, n):
            if abs(matrix[row, column]) > abs(matrix[pivot, column]):
                pivot = row
        size = abs(matrix[pivot, column])
        if not 0.0 < size < np.inf:
            return False
        order[column], order[pivot] = order[pivot], order[column]
        for j in range(n):
            matrix[column, j], matrix[pivot, j] = matrix[pivot, j], matrix[column, j]
        scale = 1.0 / matrix[column, column]
        matrix[column, column] = 1.0
        for j in range(n):
            matrix[column, j] *= scale
        for row in range(n):
            factor = matrix[row, column]
            if row != column and factor != 0.0:
                matrix[row, column] = 0.0
                for j in range(n):
                    matrix[row, j] -= factor * matrix[column, j]
    swapped = np.empty(n, matrix.dtype)
    for row in range(n):
        for j in range(n):
            swapped[order[j]] = matrix[row, j]
        for j in range(n):
            matrix[row, j] = swapped[j]
    return True


@jit
def _linearise(
    net: Net, room: Room, work: Work, jump: bool, y: FloatArray, sign: FloatArray, scale: FloatArray
) -> None:
    """Derivatives of the residual by the state, by differences, and by its rate, at the rate in `work.rate`.

    Only the part of the state that feeds back; rows over their largest capacitance, as currents are tiny beside rates
    of areas. The sources are those in `room`.
    """
    n = net.k.shape[0]
    m = work.slope.shape[0]
    capacitances(net, room, y, sign)
    work.mass[:] = 0.0
    for i in range(m):
        largest = 1.0 if i >= n else 0.0
        for j in range(n):
            if i < n:
                work.mass[i, j] = room.matrix[i, j]
                largest = max(largest, abs(room.matrix[i, j]))
        if i >= n:
            work.mass[i, i] = 1.0
        work.weight[i] = 1.0 / largest
    work.stage[:] = y
    residual(net, room, jump, y, sign, work.rate, room.base)
    for j in range(m):
        change = 1e-7 * (abs(y[j]) + scale[j])
        work.stage[j] = y[j] + change
        residual(net, room, jump, work.stage, sign, work.rate, room.probe)
        work.stage[j] = y[j]
        for i in range(m):
            work.slope[i, j] = work.weight[i] * (room.probe[i] - room.base[i]) / change
            work.mass[i, j] *= work.weight[i]


@jit
def _prepare_newton(scheme: Scheme, work: Work, h: float) -> bool:
    """Inverses of M - h lambda J for every eigenvalue of the scheme."""
    m = work.slope.shape[0]
    for e in range(scheme.eigenvalues.size):
        for i in range(m):
            for j in range(m):
                work.newton[e, i, j] = work.mass[i, j] - h * scheme.eigenvalues[e] * work.slope[i, j]
        if not _invert(work.newton[e]):
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
def _step(
    net: Net, room: Room, scheme: Scheme, work: Work, sources: Sources, jump: bool, t: float, h: float, y: FloatArray,
    sign: FloatArray, scale: FloatArray, tol: float, counters: IntArray,
) -> float:  # fmt: skip
    """Collocation over [t, t + h] with `work.slope` as Newton's matrix: stages in `work.k`, the end in `work.y1`.

    `work.k` holds a guess of the stages. Returns the error over `tol` times `scale`; inf where it does not converge.
    """
    stages, m = work.residual.shape
    if not _prepare_newton(scheme, work, h):
        return math.inf
    k = work.k
    for i in range(stages):
        at_sources(sources, work.place, work.base[0], t + scheme.c[i] * h, work.s[i], work.ds[i])
    before = math.inf
    for iteration in range(12):
        for i in range(stages):
            for j in range(y.size):
                value = 0.0
                for r in range(stages):
                    value += scheme.a[i, r] * k[r, j]
                work.stage[j] = y[j] + h * value
            room.s[:] = work.s[i]
            room.ds[:] = work.ds[i]
            residual(net, room, jump, work.stage, sign, k[i], room.base)
            for j in range(m):
                work.residual[i, j] = work.weight[j] * room.base[j]
            # Nothing depends on the charges: they are only collected.
            for j in range(m, y.size):
                k[i, j] = room.base[j]
        counters[NFEV] += stages
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
        # What is left, as each iteration takes the same share off; or at rounding, where nothing falls any more.
        falls = change / before if iteration > 0 else 0.5
        left = change * falls / (1.0 - falls) if falls < 1.0 else math.inf
        if left <= CONVERGED * tol or (iteration > 2 and falls > 0.3 and change <= 1e-13):
            break
        before = change
    else:
        return math.inf
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
    if net.mobile and norm <= 1.0:
        # Past a fold there may be a solution that does not continue this one.
        room.s[:] = work.s[stages - 1]
        room.ds[:] = work.ds[stages - 1]
        if not rates(net, room, jump, work.y1, sign, work.rate):
            return math.inf
    return norm if norm == norm else math.inf


@jit
def _to_polynomial(scheme: Scheme, work: Work, h: float) -> None:
    for j in range(work.poly.shape[0]):
        for d in range(work.poly.shape[1]):
            value = 0.0
            for r in range(scheme.dense.shape[0]):
                value += scheme.dense[r, d] * work.k[r, j]
            work.poly[j, d] = h * value


@jit
def _guess(scheme: Scheme, work: Work, start: FloatArray, h: float, h_before: float) -> None:
    """Stages of the next step from the polynomial of the one before, or where there is none from the rate now."""
    follows = h_before > 0.0 and h <= FARTHEST * h_before
    for i in range(scheme.c.size):
        theta = 1.0 + scheme.c[i] * h / h_before if follows else 0.0
        for j in range(start.size):
            if follows:
                value = 0.0
                for d in range(work.poly.shape[1] - 1, -1, -1):
                    value = value * theta + (d + 1.0) * work.poly[j, d]
                work.k[i, j] = value / h_before
            else:
                work.k[i, j] = start[j]


@jit
def _inside(theta: float, y: FloatArray, poly: FloatArray, out: FloatArray) -> None:
    """State at fraction `theta` of the step that starts at `y`."""
    for j in range(y.size):
        value = 0.0
        for d in range(poly.shape[1] - 1, -1, -1):
            value = (value + poly[j, d]) * theta
        out[j] = y[j] + value


@jit
def _signed(
    net: Net, room: Room, work: Work, sources: Sources, i: int, sign: float, t: float, h: float, theta: float,
    y: FloatArray,
) -> float:  # fmt: skip
    _inside(theta, y, work.poly, work.stage)
    at_sources(sources, work.place, work.base[0], t + theta * h, room.s, room.ds)
    return sign * gap_voltage(net, room, i, work.stage)


@jit
def _first_zero(
    net: Net, room: Room, work: Work, sources: Sources, t: float, h: float, y: FloatArray, sign: FloatArray
) -> tuple[float, int]:
    """First fraction of the step at which a gap voltage leaves its branch, and whose; 2 where none does."""
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
                # Illinois: the end that stays counts half.
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
    """Outputs of one step: right-hand ones in [t, t_new), left-hand ones in (t, t_new]."""
    n_s = net.b.shape[1]
    while counters[OUTPUT] < t_out.size:
        i = counters[OUTPUT]
        since = t_out[i] - work.base[0]
        if since > t_new or (since == t_new and not left[i]):
            return
        theta = max(0.0, min((since - t) / h, 1.0))
        _inside(theta, y, work.poly, work.stage)
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
    """Largest |gap voltage| of every area (V), met at the ends and the quarters of steps."""
    for part in range(5):
        _inside(0.25 * part, y, work.poly, work.stage)
        at_sources(sources, work.place, work.base[0], t + 0.25 * part * h, room.s, room.ds)
        for i in range(peaks.size):
            if net.gap[i] >= 0:
                peaks[i] = max(peaks[i], abs(gap_voltage(net, room, i, work.stage)))


@jit
def advance(
    net: Net, room: Room, scheme: Scheme, work: Work, sources: Sources, jump: bool, charge: bool, t_end: float,
    y: FloatArray, sign: FloatArray, s_before: FloatArray, scale: FloatArray, tol: float, control: FloatArray,
    counters: IntArray, peaks: FloatArray, t_out: FloatArray, left: NDArray[np.bool_], rows: FloatArray,
) -> int:  # fmt: skip
    """Step a network to `t_end` through the segments of its sources, writing outputs on the way.

    Parameters
    ----------
    net, scheme, sources
        What to step, how, and what drives it; `room` and `work` to do it in.
    jump : bool
        Whether the sources' "time" is the fraction of a jump.
    charge : bool
        Whether rows get the sources' currents.
    t_end : float
        s, not past the last edge.
    y, sign, s_before : ndarray
        State, branch of each area (0: choose) and the sources' values just before the time reached; updated.
    scale : ndarray, shape (size,)
        Of each entry of the state.
    tol : float
        Error allowed in a step, over `scale`.
    control, counters, peaks : ndarray
        Bookkeeping, updated; peaks (n_area,) in V.
    t_out, left, rows : ndarray
        Output times (ascending), whether the left-hand value is meant, and the rows to fill: the state, then the
        currents.

    Returns
    -------
    int
        DONE; JUMP: a source jumps at the time reached, take that first; STEP_UNDERFLOW; or TOO_MANY steps.
    """
    net, room, work = lend(net), lend_room(room), _lend_work(work)
    scheme = Scheme(
        borrow(scheme.a), borrow(scheme.c), borrow(scheme.e), borrow(scheme.dense), borrow(scheme.eigenvalues),
        borrow(scheme.to), borrow(scheme.back), scheme.h_max,
    )  # fmt: skip
    sources = Sources(borrow(sources.first), borrow(sources.edges), borrow(sources.terms), borrow(sources.series))
    y, sign, s_before, scale = borrow(y), borrow(sign), borrow(s_before), borrow(scale)
    control, counters, peaks = borrow(control), borrow(counters), borrow(peaks)
    t_out, left, rows = borrow(t_out), borrow(left), borrow(rows)
    n_s = s_before.size
    now = np.zeros(n_s)
    slopes = np.zeros(n_s)
    work.place[:] = 0
    h_before = 0.0
    flips = 0
    while control[BASE] + control[T] < t_end:
        base = control[BASE]
        t = control[T]
        work.base[0] = base
        if counters[ACCEPTED] + counters[REJECTED] > MOST_STEPS:
            return TOO_MANY
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
        room.s[:] = now
        room.ds[:] = slopes
        for i in range(sign.size):
            if sign[i] == 0.0:
                choose_signs(net, room, jump, y, sign)
                break
        if not rates(net, room, jump, y, sign, work.rate):
            return STEP_UNDERFLOW
        start = work.rate.copy()
        _linearise(net, room, work, jump, y, sign, scale)
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
            _guess(scheme, work, start, h, h_before)
            norm = _step(net, room, scheme, work, sources, jump, t, h, y, sign, scale, tol, counters)
            if norm <= 1.0:
                break
            counters[REJECTED] += 1
            h *= 0.25 if norm == math.inf else max(0.2, 0.9 * norm ** (-1.0 / scheme.c.size))
            last = False
            if h <= 1e-15 * max(t, 1e-3 * room_left):
                return STEP_UNDERFLOW
        proposed = h * min(6.0, 0.9 * norm ** (-1.0 / scheme.c.size) if norm > 0.0 else 6.0)
        _to_polynomial(scheme, work, h)
        theta, which = (2.0, -1) if flips > 1 else _first_zero(net, room, work, sources, t, h, y, sign)
        if theta < 1.0:
            t_new = t + theta * h
            if t_new <= t:
                # The zero is here: change branch without advancing.
                sign[which] = -sign[which]
                flips += 1
                h_before = 0.0
                continue
            # A step that ends on the zero has it where collocation is most exact.
            h = t_new - t
            if not _step(net, room, scheme, work, sources, jump, t, h, y, sign, scale, tol, counters) <= 2.0:
                control[H] = 0.5 * h
                h_before = 0.0
                continue
            _to_polynomial(scheme, work, h)
            last = False
        flips = 0
        t_new = stop - base if last else t + h
        if not jump:
            _write_outputs(net, room, work, sources, charge, t, h, t_new, y, sign, counters, t_out, left, rows)
        _account(net, room, work, sources, t, h, y, peaks)
        if which >= 0 and theta <= 1.0:
            sign[which] = -sign[which]
            counters[ZEROS] += 1
        y[:] = work.y1
        if control[JUMPED] > 0.0:
            control[H_AFTER_JUMP] = h
            control[JUMPED] = 0.0
        control[H] = max(proposed, control[H]) if last and h < control[H] else proposed
        at_sources(sources, work.place, base, t_new, s_before, slopes)
        control[BASE], control[T] = (stop, 0.0) if last else (base, t_new)
        h_before = h
        counters[ACCEPTED] += 1
    return DONE
