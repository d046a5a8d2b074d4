"""The fold of a run under the `mobile` law: its time and the outputs up to it.

Let m be the distance to the fold. The gap voltage u obeys m u' = v, where v stays finite. As a function of time, u
either has a square-root singularity at the fold, or approaches it slowly while its time constant tends to 0; no step
length suits either case. With the variable s defined by dt/ds = m and du/ds = v, both are smooth: the path crosses
m = 0, or comes to rest there.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from scipy.integrate import OdeSolution, solve_ivp

from fingerspice.base.arrays import FloatArray
from fingerspice.engine.network import Segment, source
from fingerspice.engine.one_area.model import branch_area, dot, ramp, voltage_by_time, write_row_at
from fingerspice.results.outcome import Failure, SolveError, Status, last_tried
from fingerspice.solve.initial import StackState, from_stack, from_written, model_of, row_width, to_stack
from fingerspice.solve.marching import solve as solve_marching
from fingerspice.solve.problem import Problem
from fingerspice.solve.runs import PAST_FOLD, Run
from fingerspice.solve.sources import Tables, joined, segment_of
from fingerspice.waveforms.sampling import breakpoints_at

FINEST_RTOL = 1e-12
# Stated over estimated error of such a run towards a fold: alone, the estimate was as low as half the true error.
SAFETY = 4.0
# Where leaks are much faster than the path to the fold, their round-off makes a tight tolerance unattainable. The
# second attempt uses LOOSER_RTOL. The third, with LOOSEST_RTOL, is made only within the distance NEAR of the fold,
# where the path is too short to drift from the solution of the area equation.
LOOSER_RTOL, LOOSEST_RTOL, NEAR = 1e-9, 1e-6, 3e-3
# Largest residual of the area equation at the end of a path, relative to the gap voltage.
STRAYED = 1e-3
# Distance at which the fold counts as reached, and largest value of s in units of the shortest time constant.
NOTHING_LEFT, LONGEST = 1e-10, 1e12
# Limit of the evaluations of a path; most paths to a fold take a few thousand.
MOST_EVALUATIONS = 10_000


class _LostError(Exception):
    """A path took too many evaluations, found no step small enough, or no longer fulfils the area equation."""


def run_to_fold(problem: Problem) -> Run | None:
    """A run under the `mobile` law up to the fold that it reaches or jumps past; None where it reaches no fold."""
    run = solve_marching(problem, FINEST_RTOL, repeat=False)
    run.gaps[:, 2:] *= SAFETY
    jumped = run.t_failed is not None and breakpoints_at(problem.waveform, run.t_failed).size > 0
    if not jumped and run.record(problem).fold_margin.min(initial=1.0) < PAST_FOLD:
        # Where the gap voltage is as small as rounding, steps may cross a fold unseen: their end is not the fold.
        return None
    if run.status is Status.FOLD:
        return lead_to_fold(problem, run)
    return run if run.status is Status.SUCCESS else None


def lead_to_fold(problem: Problem, run: Run) -> Run | None:
    """Continue a run that stopped near a fold until it reaches the fold; None where it does not reach it."""
    state, t_out = to_stack(problem.scene, run.state), problem.t_out
    reached, path = _ahead(problem, run, state, FINEST_RTOL)
    if path is None:
        return run if reached else None
    # The last row of the run may be the point where the steps stopped, which is not an output time.
    stopped = run.t.size > 0 and (run.t.size > t_out.size or run.t[-1] != t_out[run.t.size - 1])
    done = run.t.size - int(stopped)
    later = t_out[done:]
    t = np.append(later[later < path.t], path.t)
    written = path.rows(problem, t)
    rows = from_written(problem.scene, written, state.offset, run.by_layer)[:, : run.rows.shape[1]]
    run.t, run.left = np.append(run.t[:done], t), np.append(problem.left[: done + t.size - 1], True)
    run.rows = np.vstack([run.rows[:done], rows])
    run.t_failed, run.margin = path.t, 0.0
    for _, contact in run.record(problem).fingers:
        force = contact.stress(written[:, 1]) / written[:, 2]
        run.gaps[0, :2] = np.maximum(run.gaps[0, :2], (np.abs(written[:, 1]).max(), force.max()))
    u, u_gap = written[-1, :2].tolist()
    n = model_of(problem.scene).gap.size
    end = StackState(path.t, written[-1, -n - 1 :].copy(), u, u_gap, state.offset)
    run.state = from_stack(problem.scene, end)
    return run


def meets_fold(problem: Problem, rtol: float) -> bool:
    """Whether a problem reaches a fold, or a jump of its source goes past one.

    A run that stops near a fold and does not reach it counts as a run without a fold: its later course is not examined.

    A run that fails for another reason than a fold is a `SolveError`.
    """
    run = solve_marching(problem, rtol)
    if run.status is Status.SUCCESS:
        return False
    if run.status is not Status.FOLD:
        tried = last_tried(run.tried)
        raise SolveError(Failure(run.status, run.status.cause, run.status.action, run.t_failed, tried=tried))
    return _ahead(problem, run, to_stack(problem.scene, run.state), rtol)[0]


class _Path(NamedTuple):
    """State (n + 1,), time since `begin` (s) and gap voltage (V) as functions of the variable s, up to the fold."""

    begin: float
    segment: Segment
    sign: float
    scale: FloatArray
    solution: OdeSolution

    @property
    def t(self) -> float:
        """Time of the fold, s."""
        return self.begin + float(self.solution(self.solution.t_max)[-2] * self.scale[-2])

    def rows(self, problem: Problem, t: FloatArray) -> FloatArray:
        """Rows of `engine.one_area.model.write_row` at times (s) on the path."""
        low, high = np.zeros(t.size), np.full(t.size, self.solution.t_max)
        # Time rises monotonically in s, but dt/ds tends to 0 at the fold: bisection is safe there, Newton is not.
        for _ in range(64):
            middle = 0.5 * (low + high)
            early = self.solution(middle)[-2] * self.scale[-2] < t - self.begin
            low, high = np.where(early, middle, low), np.where(early, high, middle)
        rows = np.empty((t.size, row_width(problem.scene)))
        for row, z, time in zip(rows, (self.solution(high).T * self.scale), t, strict=True):
            u, du = source(self.segment, time - self.segment.start)
            write_row_at(model_of(problem.scene), u, du, z[:-2].copy(), self.sign, z[-1], row)
        return rows


def _start(problem: Problem, state: StackState) -> tuple[Segment, float, float]:
    """Start of a path: segment of the source, sign of the area's branch, and gap voltage (V).

    The voltage is NaN where the start is at the fold or past it, as after a jump of the source.
    """
    model, u = model_of(problem.scene), state.u_gap
    windows = list(Tables(problem, FINEST_RTOL))
    window = next((one for one in windows if one[0].edges[-1] > state.t), windows[-1])
    segment, since = segment_of(joined(window), state.t, "right")
    if since == 0.0:
        u_source, _ = source(segment, 0.0)
        u = float(ramp(model, model.k_gap * u_source, dot(model.gap, state.y), u))
    sign = math.copysign(1.0, u)
    if u != 0.0 and not math.isnan(u):
        u_source, slope = source(segment, since)
        margin, _ = voltage_by_time(model, u_source, slope, state.y, sign, u, np.empty(state.y.size))
        u = u if margin > 0.0 else math.nan
    return segment, sign, u


def _ahead(problem: Problem, run: Run, state: StackState, rtol: float) -> tuple[bool, _Path | None]:
    """Whether a run that stopped in this state reaches a fold, and the path to it where it is not there already."""
    begun = _start(problem, state)
    if run.margin <= 0.0 or math.isnan(begun[-1]):
        return True, None
    tries = (rtol, LOOSER_RTOL, LOOSEST_RTOL) if run.margin < NEAR else (rtol, LOOSER_RTOL)
    for tried in sorted({max(rtol, x) for x in tries}):
        try:
            path = _path(problem, state, begun, tried)
        except _LostError:
            continue
        return path is not None, path
    return False, None


def _jacobian(slope: Callable[[float, FloatArray], FloatArray], s: float, z: FloatArray) -> FloatArray:
    """Derivative of a slope by plain differences: scipy enlarges its own without limit for what nothing depends on."""
    here, columns = slope(s, z), []
    for i in range(z.size):
        moved = z.copy()
        moved[i] += 1e-7 * abs(z[i]) + 1e-13
        columns.append((slope(s, moved) - here) / (moved[i] - z[i]))
    return np.array(columns).T


def _path(problem: Problem, state: StackState, begun: tuple[Segment, float, float], rtol: float) -> _Path | None:
    t, y, model, n = state.t, state.y, model_of(problem.scene), state.y.size
    segment, sign, u = begun
    if u == 0.0:
        return None
    pace = model.tau if math.isfinite(model.tau) else segment.length
    scale = np.concatenate([
        np.full(n - 1, max(np.abs(y[:-1]).max(), abs(u))), [model.area0 / model.s * abs(u), pace, abs(u)]
    ])  # fmt: skip
    dy = np.empty(n)

    def at(z: FloatArray) -> tuple[float, float]:
        here = z * scale
        u_here, du_here = source(segment, t - segment.start + here[n])
        margin, speed = voltage_by_time(model, u_here, du_here, here[:n], sign, here[n + 1], dy)
        return float(margin), float(speed)

    left = MOST_EVALUATIONS

    def slope(_: float, z: FloatArray) -> FloatArray:
        nonlocal left
        left -= 1
        if left < 0:
            raise _LostError
        margin, speed = at(z)
        along: FloatArray = np.concatenate([dy * margin, [margin, speed]]) * pace / scale
        return along

    begin = np.concatenate([y, [0.0, u]]) / scale
    far = 3.0 * at(begin)[0]
    # At the fold, at the end of the segment, and too far from the fold again.
    left_over = segment.start + segment.length - t
    events: list[Any] = [
        lambda _, z: at(z)[0] - NOTHING_LEFT, lambda _, z: left_over - float(z[n]) * pace, lambda _, z: far - at(z)[0]
    ]  # fmt: skip
    for event in events:
        event.terminal = True

    # Near the fold the mode that folds may be the stiffest of all: an explicit method would need too many steps.
    found = solve_ivp(
        slope, (0.0, LONGEST), begin, "Radau",
        rtol=rtol, atol=rtol, jac=partial(_jacobian, slope), events=events, dense_output=True,
    )  # fmt: skip
    if found.status < 1:
        raise _LostError
    if not found.t_events[0].size:
        return None
    # The gap voltage was integrated from its rate, so check that it still solves the area equation.
    last = found.y[:, -1] * scale
    q, _ = branch_area(model, sign, last[n + 1])
    k_u = model.k_gap * source(segment, t - segment.start + last[n])[0]
    if abs(last[n + 1] - k_u - model.area0 * q * dot(model.gap, last[:n])) > STRAYED * abs(last[n + 1]):
        raise _LostError
    return _Path(t, segment, sign, scale, found.sol)
