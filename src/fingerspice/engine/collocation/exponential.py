"""A step of exponential collocation, for stacks and networks.

It has tables for its exact linear part, an iteration on its nonlinear term, and an estimate of its error.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from fingerspice.base.arrays import FloatArray, IntArray, aligned
from fingerspice.base.compiled import jit, jit_by_kind, jit_rows, jit_within
from fingerspice.engine.collocation.readout import Modal, row_of
from fingerspice.engine.many_areas.form import evaluate_many
from fingerspice.engine.one_area.rows import evaluate_one, largest_size
from fingerspice.numerics.lobatto import END, FIRST, LOBES, MISS, NODES, ROWS, SECOND, THIRD, fill_table
from fingerspice.numerics.modes import copy_to


@jit_rows
def free(decay: FloatArray, w0: FloatArray, out: FloatArray) -> None:
    """Decay of the modes from their values at the start of a step."""
    for k in range(w0.size):
        for i in range(ROWS):
            out[k, i] = decay[k, i] * w0[k]


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


# The nonlinear term of a circuit in a run at the modes of the step at hand or, to probe it, at others; False beyond a
# fold.
_evaluate = jit_by_kind(OneArea=evaluate_one, ManyAreas=evaluate_many)


@jit_within
def converge(circuit: Any, state: Any, tol: float) -> tuple[int, bool, float]:
    """Fill `w` with the collocation solution of a step, iterating on the nonlinear term; for the arrays see `Modal`.

    Returns the number of evaluations at all rows, whether the iteration converged to `tol` (V), and the factor by which
    the first iteration reduced the change of the nonlinear term: how strongly the areas answer to a change of the
    modes. `pull` is the nonlinear term at that solution, `used` the term from which the solution was computed. Their
    difference is measured, with the weight of each mode, by how far it moves the gap voltages.
    """
    x, phi = circuit.work.modal, circuit.tables.phi[state.step[0].slot]
    w, base, pull, used = x.w, x.base, x.pull, x.used
    weight, pull_before, left_before, u, guess = x.weight, x.pull_before, x.left_before, x.u, x.guess
    for k in range(used.shape[0]):
        for i in range(ROWS):
            w[k, i] = base[k, i]
            used[k, i] = 0.0
    slow = False
    step, answer = 0.0, 0.0
    # The loop includes the first evaluation: `evaluate` is inlined at each call, so that one call compiles once.
    for iteration in range(1, 41):
        if iteration > 1:
            step = move_on(pull, used, weight, pull_before, left_before, slow)
            respond(used, phi, base, w)
        if not _evaluate(circuit, state, w, pull, False):
            return iteration, False, answer
        if iteration == 1:
            copy_to(guess, u)
            continue
        change = moved(u, guess)
        # The next change of the gap voltages: their last one, times the ratio of the nonlinear term's changes.
        left = distance(pull, used, weight)
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


@jit_rows
def move_on(
    pull: FloatArray, used: FloatArray, weight: FloatArray, pull_before: FloatArray, left_before: FloatArray,
    mixed: bool,
) -> float:  # fmt: skip
    """Next nonlinear term of the iteration, into `used`, and what a later one needs; returns the size of the move.

    It is the last term (Picard) or, if `mixed`, made of the last two (Anderson 1965, one step back). In a stiff stack a
    Picard step reduces the residual by a factor, the area's share of the leakage. Mixing squares it.
    """
    share = _share(pull, used, weight, left_before) if mixed else 0.0
    total = 0.0
    for k in range(pull.shape[0]):
        size = 0.0
        for i in range(ROWS):
            left_before[k, i] = pull[k, i] - used[k, i]
            # What was before may be no number at the first step.
            new = pull[k, i] - share * (pull[k, i] - pull_before[k, i]) if share != 0.0 else pull[k, i]
            pull_before[k, i] = pull[k, i]
            move = new - used[k, i]
            size += move * move
            used[k, i] = new
        total += weight[k] * weight[k] * size
    return math.sqrt(total)


@jit_rows
def _share(pull: FloatArray, used: FloatArray, weight: FloatArray, left_before: FloatArray) -> float:
    """Share of the last term but one that leaves least of the residual."""
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
    return min(max(share, -1.0), 0.9)


@jit_rows
def distance(a: FloatArray, b: FloatArray, weight: FloatArray) -> float:
    """Norm of the difference of two nonlinear terms, with the weight of each mode."""
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
    level: IntArray  # (n_slots,): Reference area of each slot; -1: empty
    used: IntArray  # (1,): Slots in use
    # decay, phi, miss (n_slots, n, ...): The tables of `fill_table`, with `phi` and `miss` multiplied by h
    decay: FloatArray
    phi: FloatArray
    miss: FloatArray
    lobes: FloatArray  # A copy of `lobatto.LOBES`: the compiler makes no vectors of products with constants


def new_tables(n: int) -> Tables:
    """Empty tables for n modes."""
    slots = max(FEWEST_SLOTS, min(N_SLOTS, MOST_ENTRIES // max(n, 1)))
    shapes = (slots,), (slots, n, ROWS), (slots, n, NODES, ROWS), (slots, n, ROWS), LOBES.shape
    h, decay, phi, miss, lobes = aligned(shapes)
    lobes[:] = LOBES
    return Tables(h, np.full(slots, -1), np.zeros(1, np.int64), decay, phi, miss, lobes)


@jit_within
def take_tables(circuit: Any, state: Any, level: int, h: float, rates: FloatArray, gap: FloatArray) -> None:
    """Take the tables of a step of length h (s) around a reference; a unit of each mode moves the gap by `gap` (V)."""
    step, tables, weight = state.step[0], circuit.tables, circuit.work.modal.weight
    step.slot, step.tabled = _make_tables(tables, rates, level, h), h
    decay = tables.decay[step.slot]
    for k in range(rates.size):
        weight[k] = gap[k] * (h if rates[k] * h < 1e-9 else (1.0 - decay[k, END]) / rates[k])


@jit
def _make_tables(tables: Tables, rates: FloatArray, level: int, h: float) -> int:
    """The slot with the tables of a step, filled now if need be; when all are in use the oldest is overwritten."""
    count, slots = tables.used, tables.h.size
    for slot in range(min(count[0], slots)):
        if tables.h[slot] == h and tables.level[slot] == level:
            return slot
    slot = int(count[0] % slots)
    # A count beyond the slots tells only that all are in use and which is next: it is kept below twice their number.
    count[0] = count[0] + 1 if slot + 1 < slots else slots
    tables.h[slot] = h
    tables.level[slot] = level
    phi, miss = tables.phi[slot], tables.miss[slot]
    for k in range(rates.size):
        fill_table(rates[k] * h, tables.decay[slot, k], phi[k], miss[k])
        for i in range(ROWS):
            miss[k, i] *= h
            for j in range(NODES):
                phi[k, j, i] *= h
    return slot


@jit_rows
def between(lobes: FloatArray, values: FloatArray) -> tuple[float, float, float]:
    """Interpolation error at the three points between nodes; for `lobes` see `Tables`."""
    first, second, third = 0.0, 0.0, 0.0
    for j in range(ROWS):
        first += lobes[0, j] * values[j]
        second += lobes[1, j] * values[j]
        third += lobes[2, j] * values[j]
    return first, second, third


@jit_rows
def left_over(phi: FloatArray, pull: FloatArray, used: FloatArray, at: FloatArray) -> None:
    """Response of a mode to the residual of the iteration, at the points between nodes and the end, into `at` (4,)."""
    first, second, third, end = 0.0, 0.0, 0.0, 0.0
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
_SLIGHT = 0.02
# Most iterations, and the move over the shift below which the next iteration does not matter.
_PASSES, _ENOUGH = 6, 0.3


@jit_rows
def _add(a: FloatArray, factor: float, b: FloatArray, out: FloatArray) -> None:
    for k in range(out.shape[0]):
        for i in range(ROWS):
            out[k, i] = a[k, i] + factor * b[k, i]


@jit_within
def carry(circuit: Any, state: Any, gap: FloatArray, answer: float) -> None:
    """Carry the error of the modes from the start of a converged step to the points between and the end.

    With the areas held it decays with the modes. But an error of a gap voltage also changes 1/A, which forces the
    modes. This may oppose the error or amplify it: near an instability of the circuit (a layer's leakage that rises
    with the area, or an area that the stored charge drives on) errors grow thousandfold within a few steps. So the
    nonlinear term is evaluated once more at modes shifted by the error, and the response to its change is iterated as
    the step itself was (`converge`). `answer` is how strongly the areas answered there to a change of the modes: where
    they hardly do, the error decays with the modes. The shift is small beside the gap voltages, in which alone the
    nonlinear term is not linear; `gap` (n_area, n) is how far a mode moves them. The result is `carried`.
    """
    x, error, slot = circuit.work.modal, state.error, state.step[0].slot
    base, used, off, shifted, other = x.spare[0], x.spare[1], x.spare[2], x.spare[3], x.spare[4]
    decay, phi, carried, w = circuit.tables.decay[slot], circuit.tables.phi[slot], x.carried, x.w
    largest_u, reach = 0.0, 0.0
    for a in range(gap.shape[0]):
        largest_u = max(largest_u, largest_size(x.u[a]))
    for k in range(w.shape[0]):
        for p in range(4):
            carried[k, p] = decay[k, row_of(p + 1)] * error[k]
        for a in range(gap.shape[0]):
            # A slow area is a mode behind the others, in units of its area at 0 V.
            reach = max(reach, abs((gap[a, k] if k < gap.shape[1] else largest_u) * error[k]))
    shift = _SHIFT * largest_u
    if not (answer > _SLIGHT and 0.0 < shift / reach < math.inf):
        return
    scale = shift / reach
    for k in range(w.shape[0]):
        for i in range(ROWS):
            off[k, i] = base[k, i] = scale * decay[k, i] * error[k]
            used[k, i] = 0.0
    for iteration in range(_PASSES):
        _add(w, 1.0, off, shifted)
        if not _evaluate(circuit, state, shifted, other, True):
            break
        _add(other, -1.0, x.pull, shifted)
        move = move_on(shifted, used, x.weight, x.pull_before, x.left_before, iteration > 0)
        respond(used, phi, base, off)
        if not move > _ENOUGH * shift:
            break
    for k in range(w.shape[0]):
        for p in range(4):
            carried[k, p] = off[k, row_of(p + 1)] / scale


@jit_within
def mode_error(
    x: Modal, k: int, lin: tuple[float, float, float], tables: Tables, slot: int, rows: tuple[int, int, int, int],
    magnified: float, error: float, off: FloatArray,
) -> None:  # fmt: skip
    """Fill `places` with the errors of mode k at a step's start, the points between its nodes, and its end.

    They are the interpolation error of the forcing, of which `lin` is that of the linear part; the residual of the
    iteration; and the `error` at the start as carried on. The first has the response at `rows`, which goes into `off`
    (4, m); it and the second are `magnified`. The interpolation error of the mode itself goes into `brief`.
    """
    pull, left, miss = between(tables.lobes, x.pull[k]), x.spare[5, k], tables.miss[slot, k]
    places, carried, brief = x.places[k], x.carried[k], x.brief[k]
    missed = largest((lin[0] + pull[0]) / MISS[0], (lin[1] + pull[1]) / MISS[1], (lin[2] + pull[2]) / MISS[2])
    left_over(tables.phi[slot, k], x.pull[k], x.used[k], left)
    places[0] = error
    for p in range(4):
        off[p, k] = magnified * miss[rows[p]] * missed
        places[p + 1] = carried[p] + magnified * left[p] + off[p, k]
    brief[1], brief[2], brief[3] = between(tables.lobes, x.w[k])


@jit_rows
def node_error(node: FloatArray, node_s: FloatArray, places: FloatArray, off: FloatArray) -> float:
    """Largest error of any node's voltage over a step (V), from that of the modes and the sources.

    `off` (N_PLACES, m + n_s) has the interpolation errors of the sources behind those of the modes, and in its last row
    those of the modes at the start.
    """
    m, worst = places.shape[0], 0.0
    for i in range(node.shape[0]):
        start, first, second, third, end = 0.0, 0.0, 0.0, 0.0, 0.0
        for k in range(node.shape[1]):
            share = node[i, k]
            start += share * (places[k, 0] + off[4, k])
            first += share * places[k, 1]
            second += share * places[k, 2]
            third += share * places[k, 3]
            end += share * places[k, 4]
        for e in range(node_s.shape[1]):
            share = node_s[i, e]
            first += share * off[0, m + e]
            second += share * off[1, m + e]
            third += share * off[2, m + e]
        worst = max(worst, abs(start), abs(first), abs(second), abs(third), abs(end))
    return worst
