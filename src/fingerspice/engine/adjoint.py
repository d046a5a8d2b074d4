"""Adjoint of a series stack under a recording: how one number that follows from a run changes with every sample.

Along a run the equations of small changes are linear, so that one backward sweep gives the derivatives of a
scalar J by the source at all times (Cao, Li, Petzold and Serban 2003, section 2.1). In the modes of `engine.system`,
with q = 1/A, z = q - q0 and the voltages or states X_t that the term of the area multiplies, it solves

    -l' = -rates l + sum_t z tap_t phi_t + gap du/dx_gap e,    phi_t = feed_t l,
    e = dq/du (sum_t phi_t X_t - y) + rho.

rho is the derivative of the integrand of J by the gap voltage u. Under `mobile` y = U push l / (q^2 A0), else 0. The
derivative of J by the source at a time is

    gain l + z sum_t phi_t tap_k_t + (1/q - 1/q0) push l / A0 + e du/dU,

whose integral with the weight of a sample between its neighbours is the derivative by that sample. A value of J at one
time lets l jump there. Each step takes the exponential Simpson rule of `engine.relaxation`, backwards; a step is cut
where u is 0, where dq/du jumps, and at the times of values.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from fingerspice.base.arrays import FloatArray
from fingerspice.base.borrowing import borrow
from fingerspice.base.compiled import jit, jit_within
from fingerspice.engine.adjointsteps import MOST_PARTS, SHORTEST, Course, Wanted, crosses, cut, parabola
from fingerspice.engine.system import System
from fingerspice.numerics.moments import moments
from fingerspice.physics.contact import inverse_area

# Sweeps of a step at most.
_MOST_SWEEPS = 40
# Time constants of a mode in a step from which on its integral is exact; before, Simpson's rule is, to rounding.
_DECAYS = 0.02
# Relative difference of step lengths that is rounding.
_SAME = 1e-9
# Steps of Newton's method for a gap voltage under `mobile` that a parabola has to four digits.
_NEWTON = 2


class Room(NamedTuple):
    """Arrays of a sweep."""

    reached: FloatArray  # (n,): The adjoint state; after the sweep that at the start of the run
    # weight, fixed (n, 8): Weights of a step, and those of the usual one
    weight: FloatArray
    fixed: FloatArray
    # state, forcing, density (3, n): At the end, middle and start of a step
    state: FloatArray
    forcing: FloatArray
    density: FloatArray
    place: FloatArray  # (3, 4 + n_tap): q, dq, u, U and X there
    # cuts, found: Fractions at which a step is cut, and moments
    cuts: FloatArray
    found: FloatArray


def new_room(modes: int, taps: int, values: int) -> Room:
    """Arrays for so many modes and taps, and values in one step."""
    return Room(
        np.zeros(modes), np.zeros((modes, 8)), np.zeros((modes, 8)), np.zeros((3, modes)), np.zeros((3, modes)),
        np.zeros(3), np.zeros((3, 4 + taps)), np.zeros(4 + MOST_PARTS * values), np.zeros(3),
    )  # fmt: skip


@jit_within
def _weigh(rates: FloatArray, h: float, found: FloatArray, out: FloatArray) -> None:
    """Decay over a half and a whole step of length `h`, then the weights of the forcing at 0, 1/2 and 1 for either."""
    for k in range(rates.size):
        for i, until in ((0, 0.5), (1, 1.0)):
            z = rates[k] * h * until
            moments(z, found)
            first, second, third = h * until * found[0], h * until**2 * found[1], h * until**3 * found[2]
            out[k, i] = math.exp(-z)
            out[k, 2 + 3 * i] = first - 3.0 * second + 2.0 * third
            out[k, 3 + 3 * i] = 4.0 * (second - third)
            out[k, 4 + 3 * i] = 2.0 * third - second


@jit_within
def _moved(mobile: bool, k_gap: float, area0: float, place: FloatArray, i: int) -> tuple[float, float]:
    """Derivatives of the gap voltage by the state's part of it and by the source, at fixed state."""
    if not mobile:
        return 1.0, k_gap
    margin = 1.0 - (place[i, 2] - k_gap * place[i, 3]) / place[i, 0] * place[i, 1]
    return area0 * place[i, 0] / margin, k_gap / margin


@jit_within
def _look(
    system: System, r: int, wanted: Wanted, inside: bool, place: FloatArray, state: FloatArray, out: FloatArray, i: int
) -> float:  # fmt: skip
    """Forcing of the adjoint state at place i, into `out[i]`; the derivative of J by the source there, less gain l."""
    model, n = system.model, state.shape[1]
    q, dq, u, s = place[i, 0], place[i, 1], place[i, 2], place[i, 3]
    z, e, pushed, density = q - system.q0[r], 0.0, 0.0, 0.0
    for k in range(n):
        out[i, k] = 0.0
    for t in range(system.tap_k.size):
        phi = 0.0
        for k in range(n):
            phi += system.feed[r, k, t] * state[i, k]
        e += phi * place[i, 4 + t]
        density += z * phi * system.tap_k[t]
        for k in range(n):
            out[i, k] += z * phi * system.tap[r, t, k]
    if model.mobile:
        for k in range(n):
            pushed += system.push[r, k] * state[i, k]
        pushed /= model.area0
        e -= s / (q * q) * pushed
        density += (1.0 / q - 1.0 / system.q0[r]) * pushed
    e *= dq
    if inside:
        e += wanted.by_force * system.stress * u * (2.0 - u * dq / q) / q - wanted.by_area * dq / (q * q)
    by_gap, by_source = _moved(model.mobile, model.k_gap, model.area0, place, i)
    for k in range(n):
        out[i, k] += system.gap[r, k] * by_gap * e
    return float(density + e * by_source)


@jit_within
def _place(system: System, c: Course, node: int, x: float, sign: float, out: FloatArray, i: int) -> None:
    """q, dq, u, U and X at a fraction of the step from `node`, on the branch with this sign, into `out[i]`."""
    model = system.model
    u = parabola(x, c.u[node], c.u[node + 1], c.u[node + 2])
    s = parabola(x, c.s[node], c.s[node + 1], c.s[node + 2])
    q, dq = inverse_area(sign * u, model.curve)
    if model.mobile:
        held = parabola(x, c.held[node], c.held[node + 1], c.held[node + 2])
        for _ in range(_NEWTON):
            u -= (u - model.k_gap * s - held * q) / (1.0 - held * sign * dq)
            q, dq = inverse_area(sign * u, model.curve)
    out[i, 0], out[i, 1], out[i, 2], out[i, 3] = q, sign * dq, u, s
    for t in range(c.x.shape[0]):
        out[i, 4 + t] = parabola(x, c.x[t, node], c.x[t, node + 1], c.x[t, node + 2])


@jit_within
def _at_node(c: Course, node: int, out: FloatArray, i: int) -> None:
    out[i, 0], out[i, 1], out[i, 2], out[i, 3] = c.q[node], c.dq[node], c.u[node], c.s[node]
    for t in range(c.x.shape[0]):
        out[i, 4 + t] = c.x[t, node]


@jit_within
def _through_modes(system: System, r: int, h: float, room: Room) -> tuple[float, float]:
    """Integrals over a step of gain l, and of that times the distance from its end over its length.

    A mode that decays within the step is integrated exactly, by its differential equation.
    """
    state, forcing, whole, weighed = room.state, room.forcing, 0.0, 0.0
    for k in range(state.shape[1]):
        rate, end, begin = system.rates[r, k], state[0, k], state[2, k]
        if rate * h > _DECAYS:
            total = (end - begin + h / 6.0 * (forcing[0, k] + 4.0 * forcing[1, k] + forcing[2, k])) / rate
            first = (h / 6.0 * (2.0 * forcing[1, k] + forcing[2, k]) - begin + total / h) / rate
        else:
            total = h / 6.0 * (end + 4.0 * state[1, k] + begin)
            first = h / 6.0 * (2.0 * state[1, k] + begin)
        whole += system.gain[r, k] * total
        weighed += system.gain[r, k] * first
    return whole, weighed


@jit_within
def _back(
    system: System, r: int, wanted: Wanted, inside: bool, tol: float, room: Room
) -> bool:  # fmt: skip
    """Take one step back from `room.state[0]`; the derivative of J by the source at its end, middle and start.

    False where the iteration for the forcing does not change the state by less than `tol`.
    """
    weight, state, forcing, density = room.weight, room.state, room.forcing, room.density
    n = state.shape[1]
    density[0] = _look(system, r, wanted, inside, room.place, state, forcing, 0)
    for k in range(n):
        forcing[1, k] = forcing[2, k] = forcing[0, k]
        state[2, k] = state[0, k]
    for _ in range(_MOST_SWEEPS):
        change = 0.0
        for k in range(n):
            before = state[2, k]
            for i in range(2):
                first = 2 + 3 * i
                state[1 + i, k] = weight[k, i] * state[0, k]
                for a in range(3):
                    state[1 + i, k] += weight[k, first + a] * forcing[a, k]
            change = max(change, abs(state[2, k] - before))
        for i in (1, 2):
            density[i] = _look(system, r, wanted, inside, room.place, state, forcing, i)
        if change <= tol:
            return True
        if not change < math.inf:
            return False
    return False


@jit
def sweep(
    system: System, r: int, c: Course, wanted: Wanted, tol: float, room: Room, by_sample: FloatArray
) -> int:  # fmt: skip
    """Go back through a run.

    Parameters
    ----------
    system : System
    r : int
        The reference area to use.
    c : Course
    wanted : Wanted
    tol : float
        Error of the iteration in every step, relative to the largest adjoint state.
    room : Room
    by_sample : ndarray, shape (n_sample,)
        To which the derivatives by the samples are added, 1/V.

    Returns
    -------
    int
        The number of the step whose iteration did not close, or -1.
    """
    system, c, wanted, room, by_sample = (
        borrow(system), borrow(c), borrow(wanted), borrow(room), borrow(by_sample)
    )  # fmt: skip
    state, density, fixed, found = room.reached, room.density, room.fixed, room.found
    n = state.size
    fastest = system.rates[r, 0]
    for k in range(1, n):
        fastest = max(fastest, system.rates[r, k])
    model, length, value, largest = system.model, math.nan, wanted.step.size - 1, 1e-300
    since, since_at = wanted.since
    state[:] = 0.0
    for j in range(c.h.size - 1, -1, -1):
        node, h = 2 * j, c.h[j]
        first_value = value
        count, value = cut(model, c, wanted, j, value, fastest * h, room.cuts)
        whole = count == 0 and not crosses(c, node)
        if not abs(h - length) <= _SAME * h:
            _weigh(system.rates[r], h, found, fixed)
            length = h
        upper, at_value = 1.0, first_value
        for piece in range(count, -1, -1):
            lower = room.cuts[piece - 1] if piece > 0 else 0.0
            middle = 0.5 * (lower + upper)
            if whole:
                for i in range(3):
                    _at_node(c, node + 2 - i, room.place, i)
                for k in range(n):
                    for i in range(8):
                        room.weight[k, i] = fixed[k, i]
            else:
                sign = 1.0 if parabola(middle, c.u[node], c.u[node + 1], c.u[node + 2]) >= 0.0 else -1.0
                _place(system, c, node, upper, sign, room.place, 0)
                _place(system, c, node, middle, sign, room.place, 1)
                _place(system, c, node, lower, sign, room.place, 2)
                _weigh(system.rates[r], h * (upper - lower), found, room.weight)
            low = c.share[j] + c.width[j] * lower
            high = c.share[j] + c.width[j] * upper
            i, after = c.sample[j], min(c.sample[j] + 1, by_sample.size - 1)
            while at_value > value and wanted.at[at_value] >= upper - SHORTEST:
                by_gap, by_source = _moved(model.mobile, model.k_gap, model.area0, room.place, 0)
                jump = wanted.weight[at_value]
                for k in range(n):
                    state[k] += jump * by_gap * system.gap[r, k]
                by_sample[i] += jump * by_source * (1.0 - high)
                by_sample[after] += jump * by_source * high
                at_value -= 1
            for k in range(n):
                room.state[0, k] = state[k]
                largest = max(largest, abs(state[k]))
            inside = j > since or (j == since and lower >= since_at - SHORTEST)
            if not _back(system, r, wanted, inside, tol * largest, room):
                return j
            for k in range(n):
                state[k] = room.state[2, k]
            # Simpson's rule: density times weight is a cubic where density is a parabola.
            share = h * (upper - lower) / 6.0
            end, between, begin = share * density[0], 4.0 * share * density[1], share * density[2]
            half, (whole_step, weighed) = 0.5 * (low + high), _through_modes(system, r, h * (upper - lower), room)
            later = whole_step * high - weighed * (high - low) + end * high + between * half + begin * low
            by_sample[i] += whole_step + end + between + begin - later
            by_sample[after] += later
            upper = lower
        while at_value > value:
            # Values at the start of the step.
            by_gap, by_source = _moved(model.mobile, model.k_gap, model.area0, room.place, 2)
            jump, low = wanted.weight[at_value], c.share[j]
            for k in range(n):
                state[k] += jump * by_gap * system.gap[r, k]
            i, after = c.sample[j], min(c.sample[j] + 1, by_sample.size - 1)
            by_sample[i] += jump * by_source * (1.0 - low)
            by_sample[after] += jump * by_source * low
            at_value -= 1
    return -1
