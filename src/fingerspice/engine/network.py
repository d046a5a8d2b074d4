"""A network of capacitors, resistors, sources and contacts as one compiled right-hand side.

State y = [x (n,) in volt, a (n_slow,), z (n_s,) in coulomb]: capacitor voltages, areas with a time constant (over their
values at 0 V), and the charge that each source has delivered. Cells have u = P x + Q s. With capacitances
C = c A and leaks G = g + g_A A, Kirchhoff's current law on the cuts of the live capacitors is

    P^T (C u' + [mobile: c u A'] + G u) + K x + B s = 0,     A = g(|u_gap|)  or  tau A' = g(|u_gap|) - A.

It is kept in that form, linear in x', and solved for x' only at the start of a step and for outputs.

Under `mobile` A' = dg/du u_gap' makes the matrix of x' depend on the charge; the fold is where it becomes singular. An
ideal jump is the limit of a fast ramp: the same equation in the fraction of the jump, with nothing leaking meanwhile.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from fingerspice.base.arrays import FloatArray, IntArray
from fingerspice.base.compiled import jit
from fingerspice.numerics import chebyshev
from fingerspice.numerics.modes import copy_to, solve
from fingerspice.physics.contact import inverse_area


@jit
def term_at(term: FloatArray, tau: float) -> tuple[float, float]:
    """Value and slope of one term of a segment, tau seconds into it; see `source`."""
    value, slope, n, a = term[0], 0.0, term[1], term[2]
    if n == 1.0:
        slope = value
        value *= tau
    elif n > 1.0:
        slope = value * n * tau ** (n - 1.0)
        value *= tau**n
    if a != 0.0:
        e = math.exp(a * tau)
        slope = (slope + a * value) * e
        value *= e
    omega, phi, beta = term[3], term[4], term[5]
    if omega != 0.0 or phi != 0.0 or beta != 0.0:
        phase = phi + (omega + 0.5 * beta * tau) * tau
        c = math.cos(phase)
        slope = slope * c - value * (omega + beta * tau) * math.sin(phase)
        value *= c
    return value, slope


@jit
def source(terms: FloatArray, series: FloatArray, length: float, tau: float) -> tuple[float, float]:
    """Source voltage (V) and its slope (V/s), tau seconds into a segment between two breakpoints, `length` (s) apart.

    `terms` (k, 6) are c, n, a, omega, phi, beta of c tau^n exp(a tau) cos(phi + omega tau + beta tau^2 / 2), and
    `series` (l,) are Chebyshev coefficients over the segment, or empty.
    """
    u, du = 0.0, 0.0
    for i in range(terms.shape[0]):
        if terms[i, 0] != 0.0:
            value, slope = term_at(terms[i], tau)
            u += value
            du += slope
    if series.size > 0:
        value, slope = chebyshev.evaluate(series, 2.0 * tau / length - 1.0)
        u += value
        du += slope * 2.0 / length
    return u, du


class Net(NamedTuple):
    """A reduced network with its area curves, as numbers; see `fingerspice.circuit.network.Network`."""

    mobile: bool  # Charge law
    # p, q (n_cell, n)
    p: FloatArray
    q: FloatArray
    # c, g_total, g_area (n_cell,)
    c: FloatArray
    g_total: FloatArray
    g_area: FloatArray
    place: IntArray  # (n_cell,): The area of each cell, -1 for none
    # k, b (n, n)
    k: FloatArray
    b: FloatArray
    # through, delivered (n_s, n_cell)
    through: FloatArray
    delivered: FloatArray
    cut: FloatArray  # (n_cell, n): The cells' currents enter the cuts by its transpose; p, but for controlled sources
    gap: IntArray  # (n_area,): The cell whose voltage the area follows, -1 where it is fixed
    area0: FloatArray  # (n_area,): The fixed area, or the one at 0 V, m^2
    tau: FloatArray  # (n_area,): Time constant of the area, s; 0 where it follows at once
    slow: IntArray  # (n_area,): Place of the area among those in the state; -1 if it follows at once or is fixed
    curves: FloatArray  # (n_area, l): See `fingerspice.physics.contact.inverse_area`; series padded with zeros


class Sources(NamedTuple):
    """All sources on one window of time: tables of their segments (see `source`), one after the other."""

    # (n_s + 1,): First edge of each source; its first segment has that number less the number of sources before
    first: IntArray
    edges: FloatArray  # (sum of m + 1,): s
    # terms, series (sum of m, k, 6)
    terms: FloatArray
    series: FloatArray


def ramp(before: FloatArray, after: FloatArray, t: float = 0.0) -> Sources:
    """A jump of every source as a ramp over a second from time t (s) on."""
    terms = np.zeros((before.size, 2, 6))
    terms[:, 0, 0], terms[:, 1, 0], terms[:, 1, 1] = before, after - before, 1.0
    edges = np.tile([t, t + 1.0], before.size)
    return Sources(2 * np.arange(before.size + 1, dtype=np.int64), edges, terms, np.zeros((before.size, 0)))


class Room(NamedTuple):
    """Arrays to work in: of the sources, the cells, the areas and the state."""

    s: FloatArray
    ds: FloatArray
    u: FloatArray
    along: FloatArray
    area: FloatArray
    slope: FloatArray
    rate: FloatArray
    matrix: FloatArray
    k: FloatArray
    base: FloatArray
    probe: FloatArray


@jit
def new_room(net: Net, size: int) -> Room:
    """Room for one network with a state of `size`."""
    n_cell, n_s = net.q.shape
    n, n_area = net.k.shape[0], net.gap.size
    return Room(
        np.zeros(n_s), np.zeros(n_s), np.zeros(n_cell), np.zeros(n_cell), np.zeros(n_area), np.zeros(n_area),
        np.zeros(n_area), np.zeros((n, n)), np.zeros(size), np.zeros(size), np.zeros(size),
    )  # fmt: skip


@jit
def at_sources(sources: Sources, index: IntArray, base: float, t: float, s: FloatArray, ds: FloatArray) -> None:
    """Value and slope of every source at t (s) after `base`, on the segments `index` (n_s,) of their tables."""
    for i in range(s.size):
        row = sources.first[i] + index[i]
        start = sources.edges[row]
        length = sources.edges[row + 1] - start
        # Each source has one edge more than it has segments.
        s[i], ds[i] = source(sources.terms[row - i], sources.series[row - i], length, (base - start) + t)


@jit
def next_edge(sources: Sources, index: IntArray, t: float, t_end: float) -> float:
    """The next edge of a source after t, or `t_end` (s); the segments `index` (n_s,) become those at t."""
    stop = t_end
    for i in range(index.size):
        while sources.edges[sources.first[i] + index[i] + 1] <= t:
            index[i] += 1
        stop = min(stop, sources.edges[sources.first[i] + index[i] + 1])
    return stop


@jit
def on_branch(mobile: bool, curve: FloatArray, sign: float, u: float) -> tuple[float, float]:
    """1/A and its slope d(1/A)/du at gap voltage u on the branch A(|u|) = A(sign u), continued a little past 0 V.

    Under `mobile`, beyond this continuation on the wrong side, it is the true area A(|u|), so that an iteration can
    approach the branch from there. Under `local` there is no such search, and a step across 0 V must see no kink.
    """
    if mobile and sign * u < curve[0]:
        sign = -sign
    q, dq = inverse_area(sign * u, curve)
    return q, sign * dq


@jit
def _voltages(net: Net, room: Room, y: FloatArray, k: FloatArray) -> None:
    """Cell voltages from the state and the sources in `room`, and their rates."""
    for cell in range(room.u.size):
        total = 0.0
        along = 0.0
        for j in range(net.p.shape[1]):
            total += net.p[cell, j] * y[j]
            along += net.p[cell, j] * k[j]
        for j in range(net.q.shape[1]):
            total += net.q[cell, j] * room.s[j]
            along += net.q[cell, j] * room.ds[j]
        room.u[cell] = total
        room.along[cell] = along


@jit
def _areas(net: Net, room: Room, y: FloatArray, sign: FloatArray, leak: float) -> None:
    """Areas, and the parts of their change by the gap voltage (per volt) and by time (per second)."""
    n = net.k.shape[0]
    for i in range(net.gap.size):
        room.area[i] = net.area0[i]
        room.slope[i] = 0.0
        room.rate[i] = 0.0
        if net.gap[i] >= 0:
            inverse, slope = on_branch(net.mobile, net.curves[i], sign[i], room.u[net.gap[i]])
            if net.slow[i] >= 0:
                room.area[i] = y[n + net.slow[i]] * net.area0[i]
                room.rate[i] = leak * (1.0 / inverse - room.area[i]) / net.tau[i]
            else:
                room.area[i] = 1.0 / inverse
                room.slope[i] = -slope / (inverse * inverse)


@jit
def residual(net: Net, room: Room, jump: bool, y: FloatArray, sign: FloatArray, k: FloatArray, out: FloatArray) -> None:
    """Residual of y' = `k` for the sources in `room`: currents into the cuts of the state's capacitors (A).

    For areas with a time constant it is their rate less that in `k`; for the charges it is z' itself, given x' = k.
    `sign` (n_area,) chooses the branch of each area, continued analytically through 0 V. In a `jump` time stands still
    and derivatives are by the fraction of the jump, of which `room.ds` is the whole.

    The residual is linear in k. Nothing is divided by a capacitance: the rounding error of a large current through a
    small resistance stays on the one cut that it flows through.
    """
    n, n_s = net.b.shape
    slow = y.size - n - n_s
    leak = 0.0 if jump else 1.0
    _voltages(net, room, y, k)
    _areas(net, room, y, sign, leak)
    for i in range(net.gap.size):
        if net.slow[i] >= 0:
            out[n + net.slow[i]] = room.rate[i] / net.area0[i] - k[n + net.slow[i]]
    for j in range(n):
        total = 0.0
        for i in range(n):
            total += net.k[j, i] * y[i]
        for i in range(n_s):
            total += net.b[j, i] * room.s[i]
        out[j] = -leak * total
    for j in range(n_s):
        total = 0.0
        for i in range(n):
            total += net.delivered[j, i] * y[i]
        for i in range(n_s):
            total += net.delivered[j, n + i] * room.s[i]
        out[n + slow + j] = leak * total
    for cell in range(room.u.size):
        i = net.place[cell]
        area = 1.0 if i < 0 else room.area[i]
        current = leak * (net.g_total[cell] + (0.0 if i < 0 else net.g_area[cell] * area)) * room.u[cell]
        current += net.c[cell] * area * room.along[cell]
        if net.mobile and i >= 0 and net.gap[i] >= 0:
            current += net.c[cell] * room.u[cell] * (room.rate[i] + room.slope[i] * room.along[net.gap[i]])
        for j in range(n):
            out[j] -= net.cut[cell, j] * current
        for j in range(n_s):
            out[n + slow + j] += net.through[j, cell] * current


@jit
def capacitances(net: Net, room: Room, y: FloatArray, sign: FloatArray) -> None:
    """The differential capacitance matrix of the state voltages (n, n), F, into `room.matrix`.

    It is computed from the capacitors alone: beside the current of a small resistance or of a fast source, that of a
    capacitor would be lost in rounding errors, and with it the distance to a fold.
    """
    n = net.k.shape[0]
    _voltages(net, room, y, y)
    _areas(net, room, y, sign, 0.0)
    room.matrix[:] = 0.0
    for cell in range(room.u.size):
        i = net.place[cell]
        held = net.c[cell] * (1.0 if i < 0 else room.area[i])
        felt, gap = 0.0, cell
        if net.mobile and i >= 0 and net.gap[i] >= 0:
            felt, gap = net.c[cell] * room.u[cell] * room.slope[i], net.gap[i]
        for j in range(n):
            share = net.cut[cell, j]
            if share != 0.0:
                for k in range(n):
                    room.matrix[j, k] += share * (held * net.p[cell, k] + felt * net.p[gap, k])


@jit
def rates(net: Net, room: Room, jump: bool, y: FloatArray, sign: FloatArray, out: FloatArray) -> bool:
    """Write y' into `out` for the sources in `room`; False beyond a fold, where no y' continues the solution."""
    n, n_s = net.b.shape
    capacitances(net, room, y, sign)
    room.k[:] = 0.0
    residual(net, room, jump, y, sign, room.k, out)
    if not solve(room.matrix, out[:n].reshape(n, 1)) > 0.0:
        return False
    # The charges' rates need the voltages' own.
    residual(net, room, jump, y, sign, out, room.probe)
    copy_to(out[y.size - n_s :], room.probe[y.size - n_s :])
    return True


@jit
def gap_voltage(net: Net, room: Room, i: int, y: FloatArray) -> float:
    """Voltage (V) that area i follows, for the sources in `room`."""
    cell = net.gap[i]
    total = 0.0
    for j in range(net.p.shape[1]):
        total += net.p[cell, j] * y[j]
    for j in range(net.q.shape[1]):
        total += net.q[cell, j] * room.s[j]
    return total


@jit
def choose_signs(net: Net, room: Room, jump: bool, y: FloatArray, sign: FloatArray) -> None:
    """Branches of the areas, if one is to be chosen (0): the signs of gap voltages or, at 0 V, of their derivatives."""
    if np.all(sign != 0.0):
        return
    rate = np.zeros(y.size)
    for i in range(sign.size):
        sign[i] = 1.0
    undecided = False
    for i in range(sign.size):
        if net.gap[i] >= 0:
            u = gap_voltage(net, room, i, y)
            sign[i] = -1.0 if u < 0.0 else 1.0
            undecided |= u == 0.0
    if undecided and rates(net, room, jump, y, sign, rate):
        for i in range(sign.size):
            if net.gap[i] >= 0 and gap_voltage(net, room, i, y) == 0.0:
                # `rates` has left the cells' rates there.
                sign[i] = -1.0 if room.along[net.gap[i]] < 0.0 else 1.0


@jit
def rates_at(
    net: Net, sources: Sources, index: IntArray, base: float, t: float, y: FloatArray, sign: FloatArray
) -> FloatArray:  # fmt: skip
    """y' at t (s) after `base`, on these segments of the sources (see `at_sources`); NaN past a fold."""
    room, out = new_room(net, y.size), np.empty(y.size)
    at_sources(sources, index, base, t, room.s, room.ds)
    choose_signs(net, room, False, y, sign)
    if not rates(net, room, False, y, sign, out):
        out[:] = np.nan
    return out
