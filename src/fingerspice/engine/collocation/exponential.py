"""A step of exponential collocation, for stacks and networks.

It has tables for its exact linear part, an iteration on its nonlinear term, and an estimate of its error.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from fingerspice.base.arrays import FloatArray, IntArray
from fingerspice.base.compiled import jit, jit_by_kind, jit_rows, jit_within
from fingerspice.engine.many_areas.form import evaluate_many, probe_many
from fingerspice.engine.one_area.rows import DQ, SOURCE, X_GAP, Q, U, Work, evaluate_one, largest_size, probe_one
from fingerspice.engine.one_area.system import System
from fingerspice.numerics.lobatto import BETWEEN, END, FIRST, MISS, NODES, ROWS, SECOND, THIRD, fill_table


@jit_rows
def respond(forcing: FloatArray, phi: FloatArray, base: FloatArray, w: FloatArray) -> None:
    """w = base + response to `forcing` (n, ROWS), of which only the values at the nodes are used."""
    for k in range(w.shape[0]):
        for i in range(ROWS):
            # Two independent sums: in a single one every addition would wait for the result of the last.
            total = base[k, i] + phi[k, NODES - 1, i] * forcing[k, NODES - 1]
            other = 0.0
            for j in range(0, NODES - 1, 2):
                total += phi[k, j, i] * forcing[k, j]
                other += phi[k, j + 1, i] * forcing[k, j + 1]
            w[k, i] = total + other


class Iterates(NamedTuple):
    """Arrays of the iteration, shape (m, ROWS) for the modes."""

    # w, base, pull, used: The modes, and those without the nonlinear term; this term at them, and as used for them
    w: FloatArray
    base: FloatArray
    pull: FloatArray
    used: FloatArray
    # pull_before, left_before: Nonlinear term and what was left of it an iteration before (see `mix`)
    pull_before: FloatArray
    left_before: FloatArray
    weight: FloatArray  # (m,): See `weigh`
    # u, guess (n_area, ROWS): Gap voltages now and an iteration before, V
    u: FloatArray
    guess: FloatArray


# The nonlinear term of a circuit in a run at the modes of the step at hand, False beyond a fold; and at other modes,
# with both as rows of `work.spare`.
_evaluate = jit_by_kind(OneArea=evaluate_one, ManyAreas=evaluate_many)
_probe = jit_by_kind(OneArea=probe_one, ManyAreas=probe_many)


@jit_within
def converge(circuit: Any, state: Any, x: Iterates, tol: float) -> tuple[int, bool, float]:
    """Fill `x.w` with the collocation solution of a step, iterating on the nonlinear term.

    Returns the number of evaluations at all rows, whether the iteration converged to `tol` (V), and the factor by which
    the first iteration reduced the change of the nonlinear term: how strongly the areas answer to a change of the
    modes. `x.pull` is the nonlinear term at that solution, `x.used` the term from which the solution was computed.
    Their difference is measured, with the weight of each mode, by how far it moves the gap voltages.
    """
    pull, used, phi = x.pull, x.used, circuit.tables.phi[state.step[0].slot]
    for k in range(used.shape[0]):
        for i in range(ROWS):
            x.w[k, i] = x.base[k, i]
            used[k, i] = 0.0
    slow = False
    step, answer = 0.0, 0.0
    # The loop includes the first evaluation: `evaluate` is inlined at each call, so that one call compiles once.
    for iteration in range(1, 41):
        if iteration > 1:
            if slow:
                step = mix(pull, used, x.weight, x.pull_before, x.left_before)
            else:
                step = plain(pull, used, x.weight, x.pull_before, x.left_before)
            respond(used, phi, x.base, x.w)
        if not _evaluate(circuit, state):
            return iteration, False, answer
        change = moved(x.u, x.guess)
        if iteration == 1:
            continue
        # The next change of the gap voltages: their last one, times the ratio of the nonlinear term's changes.
        left = distance(pull, used, x.weight)
        if iteration == 2 and step > 0.0:
            answer = left / step
        if not left < math.inf:
            return iteration, False, answer
        if change * left <= tol * step:
            return iteration, True, answer
        slow = left > 0.15 * step
    return 40, False, answer


@jit_rows
def moved(u: FloatArray, before: FloatArray) -> float:
    """Euclidean norm of u - before; then `before` becomes u."""
    total = 0.0
    for a in range(u.shape[0]):
        for i in range(ROWS):
            change = u[a, i] - before[a, i]
            total += change * change
            before[a, i] = u[a, i]
    return math.sqrt(total)


@jit
def weigh(rates: FloatArray, gap: FloatArray, decay: FloatArray, h: float, weight: FloatArray) -> None:
    """Move of the gap voltage over a step by a unit forcing of each mode, into `weight` (n,)."""
    for k in range(rates.size):
        weight[k] = gap[k] * (h if rates[k] * h < 1e-9 else (1.0 - decay[k, END]) / rates[k])


@jit_rows
def plain(
    pull: FloatArray, used: FloatArray, weight: FloatArray, pull_before: FloatArray, left_before: FloatArray
) -> float:
    """Picard step of the iteration, remembered for a later Anderson step (`mix`); returns the size of the move."""
    total = 0.0
    for k in range(pull.shape[0]):
        size = 0.0
        for i in range(ROWS):
            left = pull[k, i] - used[k, i]
            size += left * left
            left_before[k, i] = left
            pull_before[k, i] = pull[k, i]
            used[k, i] = pull[k, i]
        total += weight[k] * weight[k] * size
    return math.sqrt(total)


@jit_rows
def mix(
    pull: FloatArray, used: FloatArray, weight: FloatArray, pull_before: FloatArray, left_before: FloatArray
) -> float:
    """Next nonlinear term from the last two (Anderson 1965, one step back), into `used`; returns the size of the move.

    In a stiff stack a Picard step reduces the residual by a factor, the area's share of the leakage. Mixing squares it.
    """
    across = 0.0
    along = 0.0
    for k in range(pull.shape[0]):
        mine = 0.0
        size = 0.0
        for i in range(ROWS):
            left = pull[k, i] - used[k, i]
            difference = left - left_before[k, i]
            mine += left * difference
            size += difference * difference
        across += weight[k] * weight[k] * mine
        along += weight[k] * weight[k] * size
    share = across / along if along > 0.0 else 0.0
    share = min(max(share, -1.0), 0.9)
    total = 0.0
    for k in range(pull.shape[0]):
        size = 0.0
        for i in range(ROWS):
            left_before[k, i] = pull[k, i] - used[k, i]
            new = pull[k, i] - share * (pull[k, i] - pull_before[k, i])
            pull_before[k, i] = pull[k, i]
            move = new - used[k, i]
            size += move * move
            used[k, i] = new
        total += weight[k] * weight[k] * size
    return math.sqrt(total)


@jit_rows
def distance(a: FloatArray, b: FloatArray, weight: FloatArray) -> float:
    """Norm of the difference of two nonlinear terms, with the weight of each mode from `weigh`."""
    total = 0.0
    for k in range(a.shape[0]):
        size = 0.0
        for i in range(ROWS):
            size += (a[k, i] - b[k, i]) ** 2
        total += weight[k] * weight[k] * size
    return math.sqrt(total)


# Step lengths whose tables are kept; fewer where there are many modes, each of which takes 2 kB for a step length.
N_SLOTS, FEWEST_SLOTS, MOST_ENTRIES = 192, 8, 8_192


class Tables(NamedTuple):
    """Exponentials and their integrals, by step length and reference area, computed when first needed."""

    h: FloatArray  # (n_slots,): Step length of each slot, s
    # level, used: Reference area of each slot (-1: empty), and [slots in use, slot used last]
    level: IntArray
    used: IntArray
    # decay, phi, miss (n_slots, n, ...): The tables of `fill_table`, with `phi` and `miss` multiplied by h
    decay: FloatArray
    phi: FloatArray
    miss: FloatArray


def new_tables(n: int) -> Tables:
    """Empty tables for n modes."""
    slots = max(FEWEST_SLOTS, min(N_SLOTS, MOST_ENTRIES // max(n, 1)))
    return Tables(
        np.zeros(slots),
        np.full(slots, -1),
        np.zeros(2, np.int64),
        np.zeros((slots, n, ROWS)),
        np.zeros((slots, n, NODES, ROWS)),
        np.zeros((slots, n, ROWS)),
    )


def forget(tables: Tables) -> None:
    """Empty the tables."""
    tables.used[:] = 0


@jit_within
def take_tables(
    tables: Tables, level: int, h: float, rates: FloatArray, gap: FloatArray, state: Any, weight: FloatArray
) -> None:
    """Take the tables of a step of length h (s) around a reference, and what its modes do to the gap (see `weigh`)."""
    step = state.step[0]
    step.slot = _make_tables(
        rates, level, h, tables.h, tables.level, tables.used, tables.decay, tables.phi, tables.miss
    )  # fmt: skip
    step.tabled = h
    weigh(rates, gap, tables.decay[step.slot], h, weight)


@jit
def _make_tables(
    rates: FloatArray, level: int, h: float, keys_h: FloatArray, keys_level: IntArray, count: IntArray,
    decay: FloatArray, phi: FloatArray, miss: FloatArray,
) -> int:  # fmt: skip
    """The slot with the tables of a step, filled now if need be; when all are in use the oldest is overwritten."""
    slots = keys_h.size
    for slot in range(min(count[0], slots)):
        if keys_h[slot] == h and keys_level[slot] == level:
            count[1] = slot
            return slot
    slot = int(count[0] % slots)
    count[0] += 1
    # A count beyond the slots tells only that all are in use and which is next: it is kept below twice their number.
    if count[0] >= 2 * slots:
        count[0] -= slots
    count[1] = slot
    keys_h[slot] = h
    keys_level[slot] = level
    for k in range(rates.size):
        fill_table(rates[k] * h, decay[slot, k], phi[slot, k], miss[slot, k])
        for i in range(ROWS):
            miss[slot, k, i] *= h
            for j in range(NODES):
                phi[slot, k, j, i] *= h
    return slot


@jit_rows
def between(values: FloatArray) -> tuple[float, float, float]:
    """Interpolation error at the three points between nodes: values there less the polynomial through the nodes."""
    first = 0.0
    second = 0.0
    third = 0.0
    for j in range(NODES):
        first += BETWEEN[j, 0] * values[j]
        second += BETWEEN[j, 1] * values[j]
        third += BETWEEN[j, 2] * values[j]
    return values[FIRST] - first, values[SECOND] - second, values[THIRD] - third


@jit_rows
def left_over(phi: FloatArray, pull: FloatArray, used: FloatArray, at: FloatArray) -> None:
    """Response of a mode to the residual of the iteration, at the points between nodes and the end, into `at` (4,)."""
    first = 0.0
    second = 0.0
    third = 0.0
    end = 0.0
    for j in range(NODES):
        left = pull[j] - used[j]
        first += phi[j, FIRST] * left
        second += phi[j, SECOND] * left
        third += phi[j, THIRD] * left
        end += phi[j, END] * left
    at[0] = first
    at[1] = second
    at[2] = third
    at[3] = end


@jit
def largest(first: float, second: float, third: float) -> float:
    """The number of largest size, with its sign."""
    out = first if abs(first) > abs(second) else second
    return out if abs(out) > abs(third) else third


# Shift of the gap voltages for a difference, over the largest of them: half of the digits are left.
_SHIFT = 1e-7
# Answer of the areas up to which it is neglected: the error carried changes by at most 6 times as much of itself.
_SLIGHT = 0.01
# Most iterations, and the move over the shift below which the next iteration does not matter.
_PASSES, _ENOUGH = 6, 0.3


@jit_rows
def _add(a: FloatArray, factor: float, b: FloatArray, out: FloatArray) -> None:
    for k in range(out.shape[0]):
        for i in range(ROWS):
            out[k, i] = a[k, i] + factor * b[k, i]


@jit_within
def carry(circuit: Any, state: Any, x: Iterates, gap: FloatArray, answer: float) -> None:
    """Carry the error of the modes from the start of a converged step to the points between and the end.

    With the areas held it decays with the modes. But an error of a gap voltage also changes 1/A, which forces the
    modes. This may oppose the error or amplify it: near an instability of the circuit (a layer's leakage that rises
    with the area, or an area that the stored charge drives on) errors grow thousandfold within a few steps. So the
    nonlinear term is evaluated once more at modes shifted by the error, and the response to its change is iterated as
    the step itself was (`converge`). `answer` is how strongly the areas answered there to a change of the modes: where
    they hardly do, the error decays with the modes. The shift is small beside the gap voltages, in which alone the
    nonlinear term is not linear; `gap` (n_area, n) is how far a mode moves them. The result is `work.carried`.
    """
    work, error, slot = circuit.work, state.error, state.step[0].slot
    base, used, off, shifted, other = work.spare[0], work.spare[1], work.spare[2], work.spare[3], work.spare[4]
    decay, phi, carried = circuit.tables.decay[slot], circuit.tables.phi[slot], work.carried
    largest_u, reach = largest_size(x.u.ravel()), 0.0
    for k in range(x.w.shape[0]):
        for a in range(gap.shape[0]):
            # A slow area is a mode behind the others, in units of its area at 0 V.
            reach = max(reach, abs((gap[a, k] if k < gap.shape[1] else largest_u) * error[k]))
    shift = _SHIFT * largest_u
    answers = answer > _SLIGHT and 0.0 < shift / reach < math.inf
    scale = shift / reach if answers else 1.0
    for k in range(x.w.shape[0]):
        for i in range(ROWS):
            off[k, i] = base[k, i] = scale * decay[k, i] * error[k]
            used[k, i] = 0.0
    for iteration in range(_PASSES if answers else 0):
        _add(x.w, 1.0, off, shifted)
        if not _probe(circuit, state, shifted, other):
            break
        _add(other, -1.0, x.pull, shifted)
        if iteration > 0:
            move = mix(shifted, used, x.weight, x.pull_before, x.left_before)
        else:
            move = plain(shifted, used, x.weight, x.pull_before, x.left_before)
        respond(used, phi, base, off)
        if not move > _ENOUGH * shift:
            break
    for k in range(x.w.shape[0]):
        for p in range(3):
            carried[k, p] = off[k, NODES + p] / scale
        carried[k, 3] = off[k, END] / scale


@jit_within
def assess(
    system: System, tables: Tables, work: Work, slot: int, level: int, error: FloatArray
) -> tuple[float, float]:  # fmt: skip
    """Error of a converged step: interpolation error between the nodes, residual of the iteration, earlier error.

    `work.carried` is the error of the modes propagated to the points between nodes and to the end (see `carry`), and
    `error` (n,) that at the start, signed; `work.places` is filled with their error at the start, the points between
    and the end, that of the dense output included. `work.run` takes the whole error of the gap voltage there. Returned
    are the largest error of the gap voltage by this step's interpolation alone (V), which controls the step's length,
    and the largest ratio of a move of the gap voltage to the move of a state voltage that causes it.
    """
    r, w, pull, used, carried, places, sums = (
        work.r, work.w, work.pull, work.used, work.carried, work.places, work.sums
    )  # fmt: skip
    gain, gap, phi, miss = system.gain[level], system.gap[level], tables.phi[slot], tables.miss[slot]
    mobile, area0 = system.model.mobile, system.model.area0
    source_first, source_second, source_third = between(r[SOURCE])
    # Outputs are read from the polynomial through the gap voltages at the nodes: its interpolation error counts.
    sums[0, 0], sums[0, 1], sums[0, 2] = between(r[U])
    sums[0, 3] = 0.0
    for p in range(4):
        sums[1, p] = 0.0
        sums[2, p] = 0.0
    for k in range(gain.size):
        pull_first, pull_second, pull_third = between(pull[k])
        mode_first, mode_second, mode_third = between(w[k])
        missed = largest(
            (gain[k] * source_first + pull_first) / MISS[0],
            (gain[k] * source_second + pull_second) / MISS[1],
            (gain[k] * source_third + pull_third) / MISS[2],
        )
        left = sums[3]
        left_over(phi[k], pull[k], used[k], left)
        places[k, 0] = error[k]
        for p in range(4):
            row = FIRST + p if p < 3 else END
            fresh = miss[k, row] * missed
            places[k, p + 1] = carried[k, p] + left[p] + fresh
            sums[1, p] += gap[k] * fresh
            sums[2, p] += gap[k] * places[k, p + 1]
        places[k, 1] += mode_first
        places[k, 2] += mode_second
        places[k, 3] += mode_third
    step = 0.0
    magnified = 1.0
    work.run[0] = 0.0
    for p in range(4):
        row = FIRST + p if p < 3 else END
        factor = 1.0
        if mobile:
            # The modes' part of the gap voltage is multiplied by A_0 / A, and its error grows near the fold.
            factor = area0 * r[Q, row] / max(1.0 - area0 * r[X_GAP, row] * r[DQ, row], 1e-12)
            magnified = max(magnified, factor)
        step = max(step, abs(factor * sums[1, p] + sums[0, p]))
        work.run[p + 1] = abs(factor * sums[2, p] + sums[0, p])
    # The charge contains the integral of A dU: the interpolation error of 1/A counts times the change of the source.
    area_first, area_second, area_third = between(r[Q])
    swing = 0.3 * abs(r[SOURCE, END] - r[SOURCE, 0])
    missed = abs(largest(area_first / MISS[0], area_second / MISS[1], area_third / MISS[2]))
    charged = swing * missed / r[Q, 0]
    return max(step, charged), magnified
