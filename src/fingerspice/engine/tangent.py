"""Tangents of a series stack: how its voltages change with parameters, along the steps of a run that has been made.

With the leaked charges taken out (`engine.model`) a stack is x' = F(q) (k U* + x) with q = 1/A: layer i leaks
h_i = (rate_i + q rate0_i) (k_i U* + x_i), and F takes leaks to k sum(h) - h. U* is the source's voltage U under `local`
and U / q under `mobile`, whose state here is x A_0. A parameter moves k, the rates, the area's constants or U, so that
its tangent dx obeys

    dx' = F(q) dx + F(q) (dk U* + k dU*) + dF (k U* + x) + F_1 (k U* + x) dq,

a linear equation with the state's own fast part. The area in the run's steps is known. So the equation is solved in
the modes of the nearest reference area by the same exponential collocation, with the same iteration for the forcing by
the area as in `engine.exponential`. The zeros of the gap voltage add nothing, since q is continuous there.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from fingerspice.base.arrays import FloatArray, IntArray
from fingerspice.base.borrowing import borrow
from fingerspice.base.compiled import jit, jit_rows
from fingerspice.engine.exponential import Tables, distance, make_tables, mix, plain, respond, weigh
from fingerspice.engine.system import System
from fingerspice.numerics.lobatto import BARYCENTRIC, END, NODES, POINTS, ROWS
from fingerspice.physics.contact import N_PACKED, area_slopes, inverse_area

# Sweeps of a step at most, and how fast they have to close not to be mixed.
_MOST_SWEEPS, _SLOW = 80, 0.15


class Changes(NamedTuple):
    """Derivatives of a stack's constants by the parameters; the cells are in the order of `Model.k`."""

    layers: FloatArray  # (n_parameter, 3, n + 1): Of `Model.k`, `Model.rate` and `Model.rate0`
    k_gap: FloatArray  # (n_parameter,)
    contact: FloatArray  # (n_parameter, N_PACKED): Of `Contact.packed`


class Course(NamedTuple):
    """The steps of a run at the `ROWS` of each, gap and source voltage along the loop."""

    h: FloatArray  # (n_step,): Length of each different step, s
    order: IntArray  # (n,): Which step comes when; a period that stands for others occurs several times
    # u, s (n_step, ROWS): Gap voltage and source, V
    u: FloatArray
    s: FloatArray
    # (n_parameter, n, ROWS): Change of the source by each parameter, V per unit; of length 0 along the second axis
    # where none moves it
    moved: FloatArray


@jit
def _area_rows(u: FloatArray, curve: FloatArray, sign: float, q: FloatArray, slopes: FloatArray) -> None:
    """1/A at the rows of a step, and its derivatives (ROWS, 1 + N_PACKED): by u, and by the contact's constants.

    `sign` is the branch A(sign u), continued a little past 0 V; `curve` is a `Contact.curve`.
    """
    for i in range(ROWS):
        q[i], _ = inverse_area(sign * u[i], curve)
        area_slopes(sign * u[i], 1.0 / q[i], curve[2 : 2 + N_PACKED], slopes[i])
        for j in range(slopes.shape[1]):
            slopes[i, j] *= -q[i] * q[i]
        slopes[i, 0] *= sign


@jit_rows
def _live(live: FloatArray, w: FloatArray, x: FloatArray) -> None:
    """Voltages of all cells over k U* from the modes: the last one is minus the sum of the others."""
    n = w.shape[0]
    for i in range(ROWS):
        x[n, i] = 0.0
    for j in range(n):
        for i in range(ROWS):
            x[j, i] = 0.0
        for k in range(n):
            share = live[j, k]
            for i in range(ROWS):
                x[j, i] += share * w[k, i]
        for i in range(ROWS):
            x[n, i] -= x[j, i]


@jit_rows
def _forcing(
    q0: float, layers: FloatArray, by: FloatArray, project: FloatArray, q: FloatArray, x: FloatArray, v: FloatArray,
    source: FloatArray, moved: FloatArray, dq: FloatArray, pull: FloatArray,
) -> None:  # fmt: skip
    """Forcing of the modes besides their own decay, at every row: x' less F(q0) x.

    `layers` and `by` hold k, the rates and their changes, shape (3, n + 1), as in `Changes.layers`.
    `source` is U*, `moved` its change, `dq` that of q, and `v` the voltages k U* + x of the run's own state.
    """
    n = layers.shape[1] - 1
    k, by_k = layers[0], by[0]
    h, total, held = np.empty((n + 1, ROWS)), np.zeros(ROWS), np.zeros(ROWS)
    for j in range(n + 1):
        a, b, da, db, share, by_share = layers[1, j], layers[2, j], by[1, j], by[2, j], k[j], by_k[j]
        for i in range(ROWS):
            leak = a + q[i] * b
            h[j, i] = (
                (q[i] - q0) * b * x[j, i]
                + leak * (by_share * source[i] + share * moved[i])
                + (da + q[i] * db + dq[i] * b) * v[j, i]
            )
            total[i] += h[j, i]
            held[i] += leak * v[j, i]
    for m in range(n):
        for i in range(ROWS):
            pull[m, i] = 0.0
        for j in range(n):
            share = project[m, j]
            for i in range(ROWS):
                pull[m, i] += share * (k[j] * total[i] + by_k[j] * held[i] - h[j, i])


@jit_rows
def _moves(
    mobile: bool, k_gap: float, by_k_gap: float, s: FloatArray, ds: FloatArray, q: FloatArray, slope: FloatArray,
    by_contact: FloatArray, x_gap: FloatArray, own: FloatArray, out: FloatArray,
) -> None:  # fmt: skip
    """Changes of u, q and U*, into `out` (3, ROWS), from those of the source and of the gap's part of the state.

    These parts are `x_gap` and, in the run itself, `own`, V; q changes by `slope` with u and by `by_contact` directly.
    """
    du, dq, moved = out[0], out[1], out[2]
    for i in range(ROWS):
        at_once = by_k_gap * s[i] + k_gap * ds[i]
        if mobile:
            du[i] = (at_once + q[i] * x_gap[i] + own[i] * by_contact[i]) / (1.0 - own[i] * slope[i])
        else:
            du[i] = at_once + x_gap[i]
        dq[i] = slope[i] * du[i] + by_contact[i]
        moved[i] = (ds[i] - s[i] * dq[i] / q[i]) / q[i] if mobile else ds[i]


@jit
def _nearest(q0: FloatArray, q: FloatArray) -> int:
    lowest, highest = q[0], q[0]
    for i in range(q.size):
        lowest, highest = min(lowest, q[i]), max(highest, q[i])
    middle, best = math.sqrt(lowest * highest), 0
    for level in range(q0.size):
        if abs(math.log(q0[level] / middle)) < abs(math.log(q0[best] / middle)):
            best = level
    return best


@jit
def follow(
    system: System, tables: Tables, course: Course, changes: Changes, start: FloatArray, tol: float, out: FloatArray,
    ends: FloatArray,
) -> int:  # fmt: skip
    """Solve the state and its tangents along the steps of a run.

    Parameters
    ----------
    system : System
    tables : Tables
        Exponentials, kept from call to call.
    course : Course
    changes : Changes
    start : ndarray, shape (1 + n_parameter, n)
        The state x at the start (times A_0 under `mobile`), and its tangents.
    tol : float
        Error of every sweep, relative to what the forcing moves the gap voltage in the step.
    out : ndarray, shape (n_parameter, 2, n, NODES)
        Takes the changes of the gap voltage (V) and of 1/A (1/m^2) per unit of each parameter.
    ends : ndarray, shape (1 + n_parameter, n)
        Takes the state and its tangents at the end.

    Returns
    -------
    int
        The number of the step whose iteration did not close, or -1.
    """
    system, tables, course, changes = borrow(system), borrow(tables), borrow(course), borrow(changes)
    start, out, ends = borrow(start), borrow(out), borrow(ends)
    model = system.model
    n, columns = model.gap.size, start.shape[0]
    x_at = start.copy()
    w, pull, used, base, before, left_before = (
        np.zeros((n, ROWS)), np.zeros((n, ROWS)), np.zeros((n, ROWS)), np.zeros((n, ROWS)), np.zeros((n, ROWS)),
        np.zeros((n, ROWS)),
    )  # fmt: skip
    nothing, weight, w0 = np.zeros((n, ROWS)), np.zeros(n), np.zeros(n)
    x, v, none, layers = np.zeros((n + 1, ROWS)), np.zeros((n + 1, ROWS)), np.zeros((3, n + 1)), np.zeros((3, n + 1))
    for j in range(n + 1):
        layers[0, j], layers[1, j], layers[2, j] = model.k[j], model.rate[j], model.rate0[j]
    q, slopes, quiet = np.zeros(ROWS), np.zeros((ROWS, 1 + N_PACKED)), np.zeros(ROWS)
    slope, source, own, by_contact = np.zeros(ROWS), np.zeros(ROWS), np.zeros(ROWS), np.zeros(ROWS)
    x_gap, moves = np.zeros(ROWS), np.zeros((3, ROWS))
    for at in range(course.order.size):
        i = course.order[at]
        u, s, h = course.u[i], course.s[i], course.h[i]
        # A step lies on one side of 0 V: the branch of its middle.
        sign = 1.0 if u[NODES // 2] >= 0.0 else -1.0
        _area_rows(u, model.curve, sign, q, slopes)
        for j in range(ROWS):
            slope[j] = slopes[j, 0]
            source[j] = s[j] / q[j] if model.mobile else s[j]
            own[j] = (u[j] - model.k_gap * s[j]) / q[j] if model.mobile else 0.0
        level = _nearest(system.q0, q)
        rates, gap, live, project = system.rates[level], system.gap[level], system.live[level], system.project[level]
        slot = make_tables(
            rates, level, h, tables.h, tables.level, tables.used, tables.decay, tables.phi, tables.miss
        )  # fmt: skip
        decay, phi = tables.decay[slot], tables.phi[slot]
        weigh(rates, gap, decay, h, weight)
        for c in range(columns):
            for k in range(n):
                w0[k] = 0.0
                for j in range(n):
                    w0[k] += project[k, j] * x_at[c, j]
                for j in range(ROWS):
                    base[k, j] = decay[k, j] * w0[k]
                    used[k, j] = 0.0
            ds = course.moved[c - 1, at] if c > 0 and course.moved.shape[1] > 0 else quiet
            if c > 0:
                for j in range(ROWS):
                    by_contact[j] = 0.0
                    for p in range(N_PACKED):
                        by_contact[j] += slopes[j, 1 + p] * changes.contact[c - 1, p]
            closed, step, slow = False, 0.0, False
            for sweep in range(_MOST_SWEEPS):
                if sweep > 0:
                    if slow:
                        step = mix(pull, used, weight, before, left_before)
                    else:
                        step = plain(pull, used, weight, before, left_before)
                respond(used, phi, base, w)
                _live(live, w, x)
                if c == 0:
                    # The state's own equation is that of a tangent whose U* changes by all of itself.
                    _forcing(
                        system.q0[level], layers, none, project, q, x, x, source, source, quiet, pull
                    )  # fmt: skip
                else:
                    for j in range(ROWS):
                        x_gap[j] = 0.0
                        for k in range(n):
                            x_gap[j] += gap[k] * w[k, j]
                    _moves(
                        model.mobile, model.k_gap, changes.k_gap[c - 1], s, ds, q, slope, by_contact, x_gap, own, moves
                    )  # fmt: skip
                    _forcing(
                        system.q0[level], layers, changes.layers[c - 1], project, q, x, v, source, moves[2], moves[1],
                        pull,
                    )  # fmt: skip
                left = distance(pull, used, weight)
                if not left < math.inf:
                    break
                if left <= tol * distance(pull, nothing, weight):
                    closed = True
                    break
                slow = sweep > 1 and left > _SLOW * step
            if not closed:
                return at
            if c == 0:
                for j in range(n + 1):
                    for m in range(ROWS):
                        v[j, m] = model.k[j] * source[m] + x[j, m]
            else:
                for j in range(NODES):
                    out[c - 1, 0, at, j], out[c - 1, 1, at, j] = moves[0, j], moves[1, j]
            for j in range(n):
                x_at[c, j] = x[j, END]
    for c in range(columns):
        for j in range(n):
            ends[c, j] = x_at[c, j]
    return -1


@jit
def between_nodes(step: IntArray, fraction: FloatArray, at_nodes: FloatArray, out: FloatArray) -> None:
    """Polynomials through values at the nodes of steps (m, n, NODES), at fractions of steps, into `out` (m, n_t)."""
    weight = np.zeros(NODES)
    for i in range(step.size):
        total, hit = 0.0, -1
        for j in range(NODES):
            distance = fraction[i] - POINTS[j]
            if distance == 0.0:
                hit = j
            weight[j] = BARYCENTRIC[j] / distance if distance != 0.0 else 0.0
            total += weight[j]
        for c in range(out.shape[0]):
            values, value = at_nodes[c, step[i]], 0.0
            for j in range(NODES):
                value += weight[j] * values[j]
            out[c, i] = values[hit] if hit >= 0 else value / total
