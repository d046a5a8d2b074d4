"""One step of Radau collocation on a network: simplified Newton in the eigenvectors of the tableau, dense output."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from fingerspice.base.arrays import ComplexArray, FloatArray, IntArray
from fingerspice.base.compiled import jit
from fingerspice.engine.network import Net, Room, Sources, at_sources, capacitances, rates, residual
from fingerspice.numerics.small import copy_to, invert

# Entry of `counters`: evaluations of the right-hand side.
NFEV = 0
# Error that Newton's method may leave, over the error allowed in a step.
CONVERGED = 0.01
# Length over which a step's polynomial is extrapolated for a guess of the next step, over the step's own length.
FARTHEST = 2.0


class Scheme(NamedTuple):
    """Radau IIA as numbers (see `fingerspice.numerics.lobatto.Tableau`), with its matrix diagonalised."""

    # a, c, e, dense: The tableau's; `e` (s,) gives the highest Legendre coefficient of the increment
    a: FloatArray
    c: FloatArray
    e: FloatArray
    dense: FloatArray
    eigenvalues: ComplexArray  # (m,): Of `a`: one of each conjugate pair, and the real one
    # to, back (m, s): a = Re(back diag(eigenvalues) to)
    to: ComplexArray
    back: ComplexArray
    h_max: float  # s


class Work(NamedTuple):
    """Arrays of one integration."""

    k: FloatArray
    poly: FloatArray
    slope: FloatArray
    mass: FloatArray
    weight: FloatArray
    newton: ComplexArray
    rate: FloatArray
    start: FloatArray
    stage: FloatArray
    y1: FloatArray
    residual: FloatArray
    place: IntArray
    base: FloatArray
    s: FloatArray
    ds: FloatArray


class Nodal(NamedTuple):
    """A network and its sources, as the implicit steps take them; `room` and `work` are scratch arrays."""

    net: Net
    room: Room
    scheme: Scheme
    work: Work
    sources: Sources
    jump: bool  # Whether the sources' "time" is the fraction of a jump
    sign: FloatArray  # (n_area,): Branch of each area; 0: to be chosen
    scale: FloatArray  # (size,): Size of each entry of the state, to which its error is relative
    tol: float  # Error allowed in a step, as a fraction of `scale`


@jit
def new_work(net: Net, stages: int, n_eigen: int, size: int) -> Work:
    """Room for steps of a state of `size`."""
    n_s = net.b.shape[1]
    m = size - n_s
    return Work(
        np.zeros((stages, size)), np.zeros((size, stages)), np.zeros((m, m)), np.zeros((m, m)), np.zeros(m),
        np.zeros((n_eigen, m, m), np.complex128), np.zeros(size), np.zeros(size), np.zeros(size), np.zeros(size),
        np.zeros((stages, m)), np.zeros(n_s, np.int64), np.zeros(1), np.zeros((stages, n_s)), np.zeros((stages, n_s)),
    )  # fmt: skip


@jit
def linearise(c: Nodal, y: FloatArray) -> None:
    """Derivatives of the residual by the state (by differences) and by its time derivative, at `work.rate`.

    Only for the part of the state on which the residual depends; each row is divided by its largest capacitance,
    because currents are tiny beside the derivatives of areas. The sources are those in `room`.
    """
    net, room, work, jump, sign, scale = c.net, c.room, c.work, c.jump, c.sign, c.scale
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
    copy_to(work.stage, y)
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
        if not invert(work.newton[e]):
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
def _stage(scheme: Scheme, work: Work, i: int, h: float, y: FloatArray) -> None:
    """State at a stage of the step that starts at `y`, into `work.stage`."""
    for j in range(y.size):
        value = 0.0
        for r in range(scheme.c.size):
            value += scheme.a[i, r] * work.k[r, j]
        work.stage[j] = y[j] + h * value


@jit
def _residuals(c: Nodal, h: float, y: FloatArray) -> None:
    """Weighted residuals of all stages into `work.residual`, and the charges' rates into `work.k`."""
    net, room, scheme, work, jump, sign = c.net, c.room, c.scheme, c.work, c.jump, c.sign
    stages, m = work.residual.shape
    for i in range(stages):
        _stage(scheme, work, i, h, y)
        copy_to(room.s, work.s[i])
        copy_to(room.ds, work.ds[i])
        residual(net, room, jump, work.stage, sign, work.k[i], room.base)
        for j in range(m):
            work.residual[i, j] = work.weight[j] * room.base[j]
        # Nothing depends on the charges: they are only integrated.
        for j in range(m, y.size):
            work.k[i, j] = room.base[j]


@jit
def step(c: Nodal, t: float, h: float, y: FloatArray, counters: IntArray) -> float:
    """Collocation over [t, t + h] with `work.slope` as Newton's matrix: stages in `work.k`, the end in `work.y1`.

    `work.k` holds a guess of the stages. Returns the error over `tol` times `scale`; inf where it does not converge.
    """
    net, room, scheme, work, jump, sign, scale, tol = (
        c.net, c.room, c.scheme, c.work, c.jump, c.sign, c.scale, c.tol
    )  # fmt: skip
    stages, m = work.residual.shape
    if not _prepare_newton(scheme, work, h):
        return math.inf
    k = work.k
    for i in range(stages):
        at_sources(c.sources, work.place, work.base[0], t + scheme.c[i] * h, work.s[i], work.ds[i])
    before = math.inf
    for iteration in range(12):
        _residuals(c, h, y)
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
        _residuals(c, h, y)
        counters[NFEV] += stages
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
        # Beyond a fold there may be a solution that does not continue this one, and a step may reach it.
        for i in range(stages):
            _stage(scheme, work, i, h, y)
            copy_to(room.s, work.s[i])
            copy_to(room.ds, work.ds[i])
            if not rates(net, room, jump, work.stage, sign, work.rate):
                return math.inf
    return norm if norm == norm else math.inf


@jit
def guess(scheme: Scheme, work: Work, start: FloatArray, h: float, h_before: float) -> None:
    """Guess of the next step's stages from the polynomial of the step before or, without one, the derivative now."""
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
