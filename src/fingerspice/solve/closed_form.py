"""Runs in closed form: circuits whose areas are fixed or have negligible effect, and stacks without leakage."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np

from fingerspice.base.arrays import FloatArray
from fingerspice.circuit.network import Modes
from fingerspice.engine.network import at_sources
from fingerspice.engine.one_area.model import follow, source_at
from fingerspice.numerics import hold, linear
from fingerspice.results.outcome import State, Status
from fingerspice.results.record import Record
from fingerspice.solve.initial import StackState, from_stack, from_written, model_of, row_width
from fingerspice.solve.problem import Problem
from fingerspice.solve.runs import Run, closed_form, gap_signals
from fingerspice.solve.scenes import kept_with
from fingerspice.solve.sources import Tables, after_the_end, joined, segment_index
from fingerspice.waveforms.samples import Samples
from fingerspice.waveforms.sampling import on_grid, same_time

# Round-off of the closed forms relative to the run's largest voltage: for a stack, whose modes follow from a secular
# equation, and for a network, whose modes follow from matrices.
ROUNDING, ROUNDING_OF_MATRICES = 1e-13, 1e-12
# Number of sets of areas whose modes are cached with a scene.
MOST_MODES = 8


def solve_linear(problem: Problem, area: FloatArray | None = None, bound: float = 0.0) -> Run:
    """Outputs of a circuit with its areas fixed: the modes' responses to the single sources, superposed.

    Areas (n_area,) in m^2 are the scene's by default, and a problem may ask for charge only if the circuit fixes them.
    `bound` is the error from holding them, relative to the peaks; 0 where they are exact or have no effect.
    """
    scene, start = problem.scene, problem.initial
    area = scene.area0 if area is None else area
    key = ("modes", *area.tolist())
    modes = kept_with(scene.prepared, key, MOST_MODES, lambda: scene.modes_at(area))
    n = modes.rates.size
    v0 = modes.inverse @ (start.y[:n] + modes.follow @ start.s_before)
    tables = Tables(problem, 1e-13, no_chirps=True)
    z_end = start.y[n:]
    if _is_sample_by_sample(problem):
        rows, last = _at_samples(problem, modes, v0)
        end = problem.t_stop
    else:
        answer, last, end = _answer(problem, tables, modes, v0)
        rows = answer.x(modes)
        if problem.charge:
            flow = partial(_charge, problem, area, modes, v0)
            rows = np.hstack([rows, *flow(problem.t_out[: len(rows)], answer)])
            z_end = flow(np.array([end]), last)[0][0]
    y = np.concatenate([last.x(modes)[0], z_end])
    state = State(end, y, last.s[0], np.zeros(area.size), scene.charge_law)
    return _finished(problem, tables, rows, state, bound, partial(solve_linear, area=area))


class _Answer(NamedTuple):
    """Response at n_t times: modes (n_t, n), and the sources, their integrals and their slopes (n_t, n_s)."""

    v: FloatArray
    s: FloatArray
    integral: FloatArray
    slope: FloatArray

    def x(self, modes: Modes) -> FloatArray:
        """Live voltages, V, shape (n_t, n)."""
        # Not by BLAS: its threads cost more than the product, and their number changes the rounding.
        return np.asarray(
            np.einsum("jk,tk->tj", modes.shape, self.v) - np.einsum("jk,tk->tj", modes.follow, self.s), float
        )


def _answer(
    problem: Problem, tables: Tables, modes: Modes | None, v0: FloatArray
) -> tuple[_Answer, _Answer, float]:  # fmt: skip
    """Response at the outputs reached, left-hand response at the end of the windows (n_t = 1), and that end, s.

    Without modes it is that of the sources alone, and not their integrals.
    """
    t_out, left = problem.t_out, problem.left
    n, n_s, size = v0.size, len(problem.waveforms), t_out.size
    states = [np.append(v0 if j == 0 else np.zeros(n), 0.0) for j in range(n_s)]
    v, s, integral, slope = (np.zeros((size + 1, k)) for k in (n, n_s, n_s, n_s))
    v[size], s[size], end, first = v0, problem.initial.s_before, problem.t_start, 0
    sources = None
    for window in tables:
        if any(table.edges.size < 2 for table in window):
            break
        sources, end = joined(window), min(float(table.edges[-1]) for table in window)
        # Evaluate at the window's end too: where one source's table ends there, the other tables continue past it.
        before, beyond = t_out.searchsorted(end), t_out.searchsorted(end, "right")
        at = np.append(np.arange(first, before + np.count_nonzero(left[before:beyond])), size)
        t, side = np.append(t_out[at[:-1]], end), np.append(left[at[:-1]], True)
        v[size] = 0.0
        for j, table in enumerate(window):
            given = table.edges, table.terms, table.series
            if modes is not None:
                # The charge needs the integrals of the sources: each is one more mode, with rate 0 and gain 1.
                rates, gains = np.append(modes.rates, 0.0), np.append(modes.gains[:, j], 1.0)
                rows, states[j] = linear.respond(rates, gains, *given, states[j], t, side)
                v[at] += rows[:, :n]
                integral[at, j] = rows[:, n]
            s[at, j], slope[at, j] = source_at(*given, t, side)
        first = at.size - 1 + first
    if tables.not_finite is None and first < size and sources is not None:
        after = after_the_end(problem) or sources
        v[first:size], integral[first:size] = v[size], integral[size]
        at_sources(after, segment_index(after, end, "right"), end, 0.0, s[first], slope[first])
        s[first:size], slope[first:size] = s[first], slope[first]
        first = size
    out, last = (_Answer(v[part], s[part], integral[part], slope[part]) for part in (slice(first), slice(size, None)))
    return out, last, end


def _is_sample_by_sample(problem: Problem) -> bool:
    """Whether the outputs are a recorded source's own sample times from the first one on: then a recursion serves."""
    wave, t_out = problem.waveform, problem.t_out
    if problem.charge or not isinstance(wave, Samples) or not 1 < t_out.size <= wave.count:
        return False
    if wave.start != problem.t_start or t_out[-1] < problem.t_stop * (1.0 - 1e-12):
        return False
    return bool(on_grid(t_out, wave.start, 1.0 / wave.rate, same_time(problem.t_stop)))


def _at_samples(problem: Problem, modes: Modes, v0: FloatArray) -> tuple[FloatArray, _Answer]:
    """Live voltages at the samples of a recorded source (n_t, n), V, and the response at the last sample."""
    wave = problem.waveform
    assert isinstance(wave, Samples)
    count = round((problem.t_stop - wave.start) * wave.rate) + 1
    u, rates, gains = wave.values[:count], modes.rates, np.ascontiguousarray(modes.gains[:, 0])
    live, end = hold.first_order_hold(u, 1.0 / wave.rate, rates, gains, -modes.follow[:, 0], modes.shape, v0)
    s = np.array([[float(wave.value(problem.t_stop, "left"))]])
    return live.T, _Answer(end[None], s, np.zeros((1, 1)), np.zeros((1, 1)))


def _charge(
    problem: Problem, area: FloatArray, modes: Modes, v0: FloatArray, t: FloatArray, answer: _Answer
) -> list[FloatArray]:
    """Charge (C) and regular current (A) that each source has delivered at times t, both (n_t, n_s)."""
    net, start = problem.network, problem.initial
    n, x, s = modes.rates.size, answer.x(modes), answer.s
    capacitance, leak = net.capacitance(area)[:, None], net.leak(area)[:, None]
    stored_x, stored_s = net.through @ (capacitance * net.p), net.through @ (capacitance * net.q)
    lost_x = net.through @ (leak * net.p) + net.delivered[:, :n]
    lost_s = net.through @ (leak * net.q) + net.delivered[:, n:]
    draining = modes.rates > 0.0
    passed = np.einsum("kj,tj->tk", modes.gains, answer.integral) - (answer.v - v0)
    held = np.outer(t - problem.t_start, v0)
    # A mode with rate 0 has no leakage current, so that any value of its integral will do.
    integral = np.where(draining, passed / np.where(draining, modes.rates, 1.0), held)
    x_integral = answer._replace(v=integral, s=answer.integral).x(modes)
    rate = np.einsum("kj,tj->tk", modes.gains, s) - modes.rates * answer.v
    dx = answer._replace(v=rate, s=answer.slope).x(modes)

    def along(matrix: FloatArray, values: FloatArray) -> FloatArray:
        return np.asarray(np.einsum("kj,tj->tk", matrix, values))

    moved = along(stored_x, x - start.y[:n]) + along(stored_s, s - start.s_before)
    charge = start.y[n:] + moved + along(lost_x, x_integral) + along(lost_s, answer.integral)
    current = along(stored_x, dx) + along(stored_s, answer.slope) + along(lost_x, x) + along(lost_s, s)
    return [charge, current]


def _finished(
    problem: Problem, tables: Tables, rows: FloatArray, state: State, bound: float, again: Callable[[Problem], Run]
) -> Run:
    """A run with its peaks and its stated errors: round-off, and `bound` relative to the peaks."""
    status = Status.SUCCESS if tables.not_finite is None else Status.SOURCE_NOT_FINITE
    t, left = problem.t_out[: len(rows)], problem.left[: len(rows)]
    run = Run(t, left, rows, status, 0, {}, state, t_failed=tables.not_finite)
    run.unseen, run.rough = tables.unseen, tables.rough
    largest = max(problem.largest, problem.scene.u_size)
    if problem.network.n_voltage < len(problem.network.sources):
        largest = max(largest, float(np.abs(rows[:, : problem.network.k.shape[0]]).max(initial=0.0)))
    rounding = (ROUNDING_OF_MATRICES if problem.scene.stack is None else ROUNDING) * largest
    gaps = []
    for peak, force in _peaks(run.record(problem)):
        share = rounding / peak if peak > 0.0 else 0.0
        gaps.append((peak, force, rounding + bound * peak, (2.0 * share + 3.0 * bound) * force))
    run.gaps = np.array(gaps or [(0.0, 0.0, rounding, 0.0)])
    run.node_error = rounding + bound * largest
    if not problem.scene.is_sampled:
        # Not for a source given as a user's function: evaluating it between the outputs would cost too much.
        run.continuous = closed_form(replace(problem, charge=False), again)
    return run


def _peaks(record: Record) -> Iterator[tuple[float, float]]:
    """Largest voltage (V) and force (N) of every gap, as of `gap_signals`."""
    for i, (place, (_, contact)) in enumerate(zip(record.network.fingers, record.fingers, strict=True)):
        u = record.finger_voltage(i)
        peak = max(float(u.max(initial=0.0)), -float(u.min(initial=0.0)))
        if record.net.gap[place] < 0 and record.net.slow[place] < 0:
            # The area is fixed: the force grows with the voltage.
            yield peak, float(contact.stress(peak) * record.net.area0[place])
        else:
            yield peak, float(record.finger_force(i).max(initial=0.0))
    if not record.fingers:
        yield from ((float(np.abs(u).max(initial=0.0)), 0.0) for u, _ in gap_signals(record))


def solve_algebraic(problem: Problem) -> Run:
    """Outputs of a stack without leakage: the layers share each change of the source's voltage in fixed ratios."""
    scene = problem.scene
    model, start, width = model_of(scene), problem.inner, row_width(scene)
    tables = Tables(problem, 1e-12)
    answer, last, end = _answer(problem, tables, None, np.zeros(0))
    rows, ended = np.empty((len(answer.s), width)), np.empty((1, width))
    charge_error = follow(model, answer.s[:, 0], answer.slope[:, 0], start.y, start.u_before, rows)
    # The final state is the left-hand one: it does not include a jump at the end.
    follow(model, last.s[:, 0], np.zeros(1), start.y, start.u_before, ended)
    y = np.append(start.y[:-1], ended[0, -1])
    state = from_stack(scene, StackState(end, y, float(last.s[0, 0]), float(ended[0, 1]), start.offset))
    shown = from_written(scene, rows, start.offset, by_layer=False)
    run = _finished(problem, tables, shown, state, 0.0, solve_algebraic)
    if problem.charge:
        moved, held = rows[:, -1], rows[:, 0] / rows[:, 2] / model.s
        most = float(np.abs(moved).max(initial=0.0) + np.abs(held).max(initial=0.0))
        run.charge_error = float(charge_error) + ROUNDING * most
    return run
