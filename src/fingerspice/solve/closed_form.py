"""Runs in closed form: circuits whose areas are fixed or have negligible effect, and stacks without leakage.

The fold of a run under the `mobile` law: its time and the outputs up to it.

Let m be the distance to the fold. The gap voltage u obeys m u' = v, where v stays finite. As a function of time, u
either has a square-root singularity at the fold, or approaches it slowly while its time constant tends to 0; no step
length suits either case. With the variable s defined by dt/ds = m and du/ds = v, both are smooth: the path crosses
m = 0, or comes to rest there.
"""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from fingerspice.base.arrays import FloatArray
from fingerspice.circuit.network import Modes
from fingerspice.engine.network import Sources, at_sources, on_branch
from fingerspice.engine.one_area.model import dot, jump_charges, ramp, source_at, voltage_by_time
from fingerspice.numerics import linear
from fingerspice.physics.contact import inverse_areas, inverse_areas_with_slopes
from fingerspice.results.outcome import State, Status
from fingerspice.solve.collocation import by_modes
from fingerspice.solve.collocation import solve as solve_by_steps
from fingerspice.solve.problem import Problem, Tables, after_the_end, joined, segment_index, values_at
from fingerspice.solve.runs import PAST_FOLD, Run, closed_form, gap_signals
from fingerspice.solve.starting import as_shown, from_loop, model_of, to_loop
from fingerspice.waveforms.samples import Samples
from fingerspice.waveforms.sampling import breakpoints_at, on_grid, same_time

# Round-off of the closed forms relative to the run's largest voltage: for a stack, whose modes follow from a secular
# equation, and for a network, whose modes follow from matrices.
ROUNDING, ROUNDING_OF_MATRICES = 1e-13, 1e-12
# Number of sets of areas whose modes are cached with a scene.
MOST_MODES = 8


def solve_linear(problem: Problem, area: FloatArray | None = None, bound: float = 0.0) -> Run:
    """Outputs of a circuit with its areas fixed: the modes' responses to the single sources, superposed.

    Areas (n_area,) in m^2 are given for a stack that leaks, and a problem may ask for charge only if the circuit fixes
    them. Without leaks the layers share each change of the voltage in fixed ratios, whatever the area. `bound` is the
    error from holding the areas, relative to the peaks; 0 where they are exact or have no effect.
    """
    scene, start = problem.scene, problem.initial
    at_once, charge_error = scene.network.stack is not None and area is None, None
    area = scene.net.area0 if area is None else area
    tables = Tables(problem, 1e-12 if at_once else 1e-13, no_chirps=not at_once)
    modes = scene.remember(("modes", *area.tolist()), lambda: scene.modes_at(area), MOST_MODES)
    n = modes.rates.size
    v0, z_end, end = modes.inverse @ (start.y[:n] + modes.follow @ start.s_before), start.y[n:], problem.t_stop
    sampled = _at_samples(problem, modes, v0)
    if sampled is not None:
        rows, x_end, s_end = sampled
    else:
        answer, end = _answer(problem, tables, None if at_once else modes, v0)
        v, s, _, _ = answer
        x = _along(modes.shape, v) - _along(modes.follow, s)
        rows, x_end, s_end = x[:-1], x[-1], s[-1]
        if problem.charge:
            flow = partial(_loop_charge, problem) if at_once else partial(_charge, problem, area, modes, v0)
            z, current, charge_error = flow(answer)
            rows, z_end = np.hstack([rows, z[:-1], current[:-1]]), z[-1]
    state = State(end, np.append(x_end, z_end), s_end, np.zeros(area.size), scene.charge_law)
    status = Status.SUCCESS if tables.not_finite is None else Status.SOURCE_NOT_FINITE
    run = Run(
        problem.t_out[: len(rows)], problem.left[: len(rows)], rows, status, 0, {}, state, charge_error=charge_error,
        t_failed=tables.not_finite, unseen=tables.unseen, rough=tables.rough,
    )  # fmt: skip
    _state_errors(problem, run, bound)
    if not problem.network.waveform.is_sampled:
        # Not for a source given as a user's function: evaluating it between the outputs would cost too much.
        again = partial(solve_linear, area=None if at_once else area)
        run.continuous = closed_form(replace(problem, charge=False), again)
    return run


def _along(matrix: FloatArray, values: FloatArray) -> FloatArray:
    """A matrix times the values at each time; not by BLAS, whose threads cost more and may round otherwise."""
    return np.asarray(np.einsum("kj,tj->tk", matrix, values))


def _answer(problem: Problem, tables: Tables, modes: Modes | None, v0: FloatArray) -> tuple[list[FloatArray], float]:
    """Modes (n_t, n), and sources, their integrals and slopes (n_t, n_s), at the outputs reached; and an end, s.

    The last row is the left-hand response at the end of the windows.
    """
    t_out, left = problem.t_out, problem.left
    n, n_s, size = v0.size, len(problem.network.waveforms), t_out.size
    states = [np.append(v0 if j == 0 else np.zeros(n), 0.0) for j in range(n_s)]
    v, s, integral, slope = found = [np.zeros((size + 1, k)) for k in (n, n_s, n_s, n_s)]
    v[:], s[size], end, first = v0, problem.initial.s_before, problem.t_start, 0
    sources = None
    for window in tables:
        if any(table.edges.size < 2 for table in window):
            break
        sources, end = joined(window), min(float(table.edges[-1]) for table in window)
        # Evaluate at the window's end too: where one source's table ends there, the other tables continue past it.
        before, beyond = t_out.searchsorted(end), t_out.searchsorted(end, "right")
        at = np.append(np.arange(first, before + np.count_nonzero(left[before:beyond])), size)
        t, side = np.append(t_out[at[:-1]], end), np.append(left[at[:-1]], True)
        v[at] = 0.0 if modes is not None else v0
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
        s[first:size], slope[first:size] = values_at(after, end)
        first = size
    return [x[np.append(np.arange(first), size)] for x in found], end


def _at_samples(problem: Problem, modes: Modes, v0: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray] | None:
    """Live voltages (n_t, n), those (n,) and the source at the end, V, by a recursion; None for other outputs."""
    wave, t_out = problem.network.waveform, problem.t_out
    if problem.charge or not isinstance(wave, Samples) or not 1 < t_out.size <= wave.count:
        return None
    whole = wave.start == problem.t_start and t_out[-1] >= problem.t_stop * (1.0 - 1e-12)
    if not (whole and on_grid(t_out, wave.start, 1.0 / wave.rate, same_time(problem.t_stop))):
        return None
    count = round((problem.t_stop - wave.start) * wave.rate) + 1
    u, rates, gains = wave.values[:count], modes.rates, np.ascontiguousarray(modes.gains[:, 0])
    live, end = linear.first_order_hold(u, 1.0 / wave.rate, rates, gains, -modes.follow[:, 0], modes.shape, v0)
    s = np.array([float(wave.value(problem.t_stop, "left"))])
    return live.T, modes.shape @ end - modes.follow @ s, s


def _charge(
    problem: Problem, area: FloatArray, modes: Modes, v0: FloatArray, answer: list[FloatArray]
) -> tuple[FloatArray, FloatArray, float | None]:
    """Charge (C) and regular current (A) that each source has delivered, both (n_t, n_s), with no error known."""
    start, by, (v, s, given, slope) = problem.initial, by_modes(problem.network, modes, area), answer
    # A mode with rate 0 has no leakage current, so that any value of its integral will do.
    integral = (_along(modes.gains, given) - (v - v0)) / np.where(modes.rates > 0.0, modes.rates, np.inf)
    moved = _along(by["stored"], v - v0) + _along(by["stored_s"], s - start.s_before)
    charge = start.y[v0.size :] + moved + _along(by["lost"], integral) + _along(by["lost_s"], given)
    moving = _along(by["stored"], _along(modes.gains, s) - modes.rates * v) + _along(by["stored_s"], slope)
    current = moving + _along(by["lost"], v) + _along(by["lost_s"], s)
    return charge, current, None


def _state_errors(problem: Problem, run: Run, bound: float) -> None:
    """Peaks and stated errors of a run: round-off, and `bound` relative to the peaks."""
    largest = max(problem.largest, problem.scene.u_size)
    if problem.network.n_voltage < len(problem.network.sources):
        largest = max(largest, float(np.abs(run.rows[:, : problem.network.k.shape[0]]).max(initial=0.0)))
    rounding = (ROUNDING_OF_MATRICES if problem.network.stack is None else ROUNDING) * largest
    gaps, record = [], run.record(problem)
    for i, u in enumerate(record.each("u_gap")):
        place, peak = record.network.fingers[i], max(float(u.max(initial=0.0)), -float(u.min(initial=0.0)))
        if record.net.gap[place] < 0 and record.net.slow[place] < 0:
            # The area is fixed: the force grows with the voltage.
            force = record.fingers[i][1].per_volt * peak**2 * float(record.network.pulled(place, record.net.area0))
        else:
            force = float(record.each("f_el")[i].max(initial=0.0))
        share = 2.0 * rounding / (peak or math.inf) + 3.0 * bound
        gaps.append((peak, force, rounding + bound * peak, share * force))
    if not gaps:
        peak = max((float(np.abs(u).max(initial=0.0)) for u, _ in gap_signals(record)), default=0.0)
        gaps = [(peak, 0.0, rounding + bound * peak, 0.0)]
    run.gaps, run.node_error = np.array(gaps), rounding + bound * largest


def _loop_charge(problem: Problem, answer: list[FloatArray]) -> tuple[FloatArray, FloatArray, float | None]:
    """Charge (C) and current (A) of a stack without leaks, both (n_t, 1), and the error of the charge, C."""
    model, (y, _), (_, s, _, ds) = model_of(problem.scene), problem.inner, answer
    u, slope, x_gap, moved, error = s[:, 0].copy(), ds[:, 0], float(dot(model.gap, y)), np.empty(len(s)), 0.0
    u_gap = model.k_gap * u + x_gap
    inverse, bend = inverse_areas_with_slopes(u_gap, model.curve)
    held, current = u / inverse / model.s, slope / inverse / model.s
    if model.mobile:
        moved[:] = held
        current -= np.sign(u_gap) * bend * model.k_gap * slope / inverse * held
    else:
        # What flows between two source voltages depends on these two alone, not on the path between them.
        error = jump_charges(model, x_gap, float(problem.initial.s_before[0]), u, moved)
    carried = problem.initial.y[-1] + (0.0 if model.mobile else moved)
    most = float(np.abs(carried).max(initial=0.0) + np.abs(held).max(initial=0.0))
    return (y[-1] + moved)[:, None], current[:, None], error + ROUNDING * most


# Tolerance of a run towards a fold; and its stated error over the estimated one, which was as low as half the true one.
FINEST_RTOL, SAFETY = 1e-12, 4.0
# Where leaks are much faster than the path to the fold, their round-off makes a tight tolerance unattainable. The
# second attempt uses LOOSER_RTOL. The third, with LOOSEST_RTOL, is made only within the distance NEAR of the fold,
# where the path is too short to drift from the solution of the area equation.
LOOSER_RTOL, LOOSEST_RTOL, NEAR = 1e-9, 1e-6, 3e-3
# Distance at which the fold counts as reached, and the largest residual of the area equation there, relative to the gap
# voltage; largest value of s, in units of the shortest time constant, and number of evaluations of a path.
NOTHING_LEFT, STRAYED, LONGEST, MOST_EVALUATIONS = 1e-10, 1e-3, 1e12, 10_000


class _LostError(Exception):
    """A path took too many evaluations, found no step small enough, or no longer fulfils the area equation."""


def run_to_fold(problem: Problem) -> Run | None:
    """A run under the `mobile` law up to the fold that it reaches or jumps past; None where it reaches no fold."""
    run = solve_by_steps(problem, FINEST_RTOL, repeat=False)
    run.gaps[:, 2:] *= SAFETY
    jumped = run.t_failed is not None and breakpoints_at(problem.network.waveform, run.t_failed).size > 0
    # Where the gap voltage is as small as rounding, steps may cross a fold unseen: their end is not the fold.
    unseen = not jumped and run.record(problem).fold_margin.min(initial=1.0) < PAST_FOLD
    if run.status is Status.FOLD and not unseen:
        return lead_to_fold(problem, run)
    return run if run.status is Status.SUCCESS and not unseen else None


def lead_to_fold(problem: Problem, run: Run) -> Run | None:
    """Continue a run that stopped near a fold until it reaches the fold; None where it does not reach it."""
    t_out, (reached, path) = problem.t_out, _ahead(problem, run, FINEST_RTOL)
    if path is None:
        return run if reached else None
    # The last row of the run may be the point where the steps stopped, which is not an output time.
    stopped = run.t.size > 0 and (run.t.size > t_out.size or run.t[-1] != t_out[run.t.size - 1])
    done = run.t.size - int(stopped)
    later = t_out[done:]
    t = np.append(later[later < path.t], path.t)
    low, high = np.zeros(t.size), np.full(t.size, path.solution.t_max)
    # Time rises monotonically in s, but dt/ds tends to 0 at the fold: bisection is safe there, Newton is not.
    for _ in range(64):
        middle = 0.5 * (low + high)
        early = path.solution(middle)[-2] * path.scale[-2] < t - path.begin
        low, high = np.where(early, middle, low), np.where(early, high, middle)
    model, rows, z = model_of(problem.scene), list[FloatArray](), path.solution(high).T * path.scale
    for here, time in zip(z, t.tolist(), strict=True):
        s, ds = values_at(path.sources, time)
        u, du, y, u_gap, dy = s[0], ds[0], here[:-2].copy(), here[-1], np.empty(here.size - 2)
        run.state = from_loop(problem.scene, time, y, u, u_gap)
        margin, speed = voltage_by_time(model, u, du, y, math.copysign(1.0, u_gap), u_gap, dy)
        q, dq = on_branch(model.mobile, model.curve, math.copysign(1.0, u_gap), u_gap)
        # i = Q' with Q = A U / S + z, and u' from the area equation.
        current = dy[-1] + (du / q - dq * speed / margin * u / (q * q)) / model.s
        row = np.append(run.state.y, current)
        rows.append(as_shown(problem.scene, row) if run.by_layer else row)
    run.t, run.left = np.append(run.t[:done], t), np.append(problem.left[: done + t.size - 1], True)
    run.rows = np.vstack([run.rows[:done], np.array(rows)[:, : run.rows.shape[1]]])
    run.t_failed, run.margin, u_gaps = path.t, 0.0, z[:, -1]
    for _, contact in run.record(problem).fingers:
        force = contact.stress(u_gaps) / inverse_areas(u_gaps, model.curve)
        run.gaps[0, :2] = np.maximum(run.gaps[0, :2], (np.abs(u_gaps).max(), force.max()))
    return run


def meets_fold(problem: Problem, rtol: float) -> bool | None:
    """Whether a problem reaches a fold, or a jump of its source goes past one; None where exponential steps gave up.

    A run that stops near a fold and does not reach it counts as a run without a fold: its later course is not examined.
    """
    run = solve_by_steps(problem, rtol)
    if run.status is not Status.FOLD:
        return False if run.status is Status.SUCCESS else None
    return _ahead(problem, run, rtol)[0]


class _Path(NamedTuple):
    """State (n + 1,), time since `begin` (s) and gap voltage (V) as functions of the variable s, up to the fold."""

    begin: float
    t: float  # Time of the fold, s
    sources: Sources
    scale: FloatArray
    solution: Any  # An `OdeSolution` of scipy


def _ahead(problem: Problem, run: Run, rtol: float) -> tuple[bool, _Path | None]:
    """Whether a run that stopped reaches a fold, and the path to it where it is not there already."""
    model, t, (y, u) = model_of(problem.scene), run.state.t, to_loop(problem.scene, run.state)
    windows = list(map(joined, Tables(problem, FINEST_RTOL)))
    sources = next((one for one in windows if one.edges[-1] > t), windows[-1])
    (u_source,), (slope,) = values_at(sources, t)
    if t in sources.edges:
        u = float(ramp(model, model.k_gap * u_source, dot(model.gap, y), u))
    if u != 0.0 and not math.isnan(u):
        margin, _ = voltage_by_time(model, u_source, slope, y, math.copysign(1.0, u), u, np.empty(y.size))
        u = u if margin > 0.0 else math.nan
    # At the fold or past it, as after a jump of the source.
    if run.margin <= 0.0 or math.isnan(u):
        return True, None
    if u == 0.0:
        return False, None
    tries = (rtol, LOOSER_RTOL, LOOSEST_RTOL) if run.margin < NEAR else (rtol, LOOSER_RTOL)
    for tried in sorted({max(rtol, x) for x in tries}):
        with suppress(_LostError):
            path = _path(problem, t, y, sources, u, tried)
            return path is not None, path
    return False, None


def _path(problem: Problem, t: float, y: FloatArray, sources: Sources, u: float, rtol: float) -> _Path | None:
    """The path from the loop's state y at t (s), with the gap voltage u (V), to a fold; None where it meets none."""
    from scipy.integrate import solve_ivp

    model, n, sign = model_of(problem.scene), y.size, math.copysign(1.0, u)
    index, s, ds = segment_index(sources, t, "right"), np.empty(1), np.empty(1)
    start, stop = sources.edges[index[0] : index[0] + 2]
    pace = model.tau if math.isfinite(model.tau) else stop - start
    scale = np.append(np.full(n - 1, max(np.abs(y[:-1]).max(), abs(u))), [model.area0 / model.s * abs(u), pace, abs(u)])
    dy, left = np.empty(n), MOST_EVALUATIONS

    def at(z: FloatArray) -> tuple[float, float]:
        here = z * scale
        at_sources(sources, index, t, here[n], s, ds)
        margin, speed = voltage_by_time(model, s[0], ds[0], here[:n], sign, here[n + 1], dy)
        return float(margin), float(speed)

    def slope(_: float, z: FloatArray) -> FloatArray:
        nonlocal left
        left -= 1
        if left < 0:
            raise _LostError
        margin, speed = at(z)
        return np.asarray(np.concatenate([dy * margin, [margin, speed]]) * pace / scale)

    def jacobian(s: float, z: FloatArray) -> FloatArray:
        # By plain differences: scipy enlarges its own without limit for what nothing depends on.
        here, steps = slope(s, z), np.diag(1e-7 * np.abs(z) + 1e-13)
        return np.array([(slope(s, z + step) - here) / ((z + step)[i] - z[i]) for i, step in enumerate(steps)]).T

    begin = np.concatenate([y, [0.0, u]]) / scale
    far = 3.0 * at(begin)[0]
    # At the fold, where the gap voltage leaves its branch, at the end of the segment, and too far from the fold again.
    events: list[Any] = [
        lambda _, z: at(z)[0] - NOTHING_LEFT, lambda _, z: sign * float(z[n + 1]),
        lambda _, z: stop - t - float(z[n]) * pace, lambda _, z: far - at(z)[0],
    ]  # fmt: skip
    for event in events:
        event.terminal = True
    # Near the fold the mode that folds may be the stiffest of all: an explicit method would need too many steps.
    how = {"rtol": rtol, "atol": rtol, "jac": jacobian, "events": events, "dense_output": True}
    found = solve_ivp(slope, (0.0, LONGEST), begin, "Radau", **how)
    if found.status < 1:
        raise _LostError
    if not found.t_events[0].size:
        return None
    # The gap voltage was integrated from its rate, so check that it still solves the area equation.
    last = found.y[:, -1] * scale
    at_sources(sources, index, t, last[n], s, ds)
    q, _ = on_branch(model.mobile, model.curve, sign, last[n + 1])
    missed = last[n + 1] - model.k_gap * s[0] - model.area0 * q * dot(model.gap, last[:n])
    if abs(missed) > STRAYED * abs(last[n + 1]):
        raise _LostError
    return _Path(t, t + float(last[n]), sources, scale, found.sol)
