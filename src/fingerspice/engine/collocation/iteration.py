"""The iteration of a step of exponential collocation on its nonlinear term, for stacks and networks."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

from fingerspice.base.arrays import FloatArray
from fingerspice.base.compiled import jit, jit_by_kind, jit_rows, jit_within
from fingerspice.engine.many_areas.rows import evaluate_many
from fingerspice.engine.one_area.rows import evaluate_one
from fingerspice.numerics.lobatto import END, NODES, ROWS


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


@jit_by_kind(OneArea=evaluate_one, ManyAreas=evaluate_many)
def _evaluate(circuit: Any, state: Any) -> bool:
    """The nonlinear term at the modes of the step at hand; False beyond a fold."""
    raise NotImplementedError


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
