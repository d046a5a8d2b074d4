"""Tiers that need no steps: a stack that does not leak, and one whose area does not matter to its voltages."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial

import numpy as np

from fingerspice.engine.algebraic import follow, source_at
from fingerspice.engine.model import Model
from fingerspice.engine.system import System, build_system
from fingerspice.numerics import hold, linear
from fingerspice.physics.contact import areas, fixed_area_curve
from fingerspice.results.outcome import ErrorEstimate, State, Status
from fingerspice.results.record import Record
from fingerspice.results.refined import ClosedForm
from fingerspice.solve.problem import Problem
from fingerspice.solve.runs import BoolArray, FloatArray, Run, Tables, after_the_end, from_rows, row_width
from fingerspice.waveforms.ramps import Samples
from fingerspice.waveforms.sampling import SourceTable, same_time

# Of the closed forms, over the source's peak.
ROUNDING = 1e-13


def _windows(tables: Tables, t_out: FloatArray, left: BoolArray) -> Iterator[tuple[SourceTable, slice]]:
    """Each table of the source with the outputs that fall into it."""
    first = 0
    for table in tables:
        if table.edges.size < 2:
            return
        end = float(table.edges[-1])
        last = int(np.searchsorted(t_out, end, side="left"))
        while last < t_out.size and t_out[last] == end and left[last]:
            last += 1
        yield table, slice(first, last)
        first = last


def solve_algebraic(problem: Problem, t_out: FloatArray, left: BoolArray) -> Run:
    """Outputs of a stack without any leak: the layers keep their share of the source's voltage."""
    model, start = problem.model, problem.initial
    tables = Tables(problem, 1e-12, t_out=t_out)
    rows = np.empty((t_out.size, row_width(problem)))
    done, end, u_end, table = 0, problem.t_start, start.u_before, None
    charge_error = 0.0
    for table, where in _windows(tables, t_out, left):
        u, slope = source_at(table.edges, table.terms, table.series, t_out[where], left[where])
        charge_error = max(charge_error, follow(model, u, slope, start.y, start.u_before, rows[where]))
        done = where.stop
        end, u_end = _end_of(table)
    failed = tables.not_finite
    if failed is None and table is not None and done < t_out.size:
        u, slope = _after(problem, table)
        count = t_out.size - done
        last_error = follow(model, np.repeat(u, count), np.repeat(slope, count), start.y, start.u_before, rows[done:])
        charge_error = max(charge_error, last_error)
        done = t_out.size
    live, z, current = from_rows(problem, rows[:done])
    # The state is that before a jump at the end.
    ended = np.empty((1, rows.shape[1]))
    follow(model, np.array([u_end]), np.zeros(1), start.y, start.u_before, ended)
    y = np.append(start.y[:-1], ended[0, -1])
    u_gap = rows[:done, 1]
    force = problem.scene.force(u_gap, rows[:done, 2])
    run = _finished(problem, t_out[:done], left[:done], live, z, current, u_gap, force, State(
        end, y, u_end, start.charge_offset, problem.scene.charge_law), 0.0, failed)  # fmt: skip
    run.rough, run.unseen = tables.rough, tables.unseen
    if problem.charge:
        held = (
            float(np.abs(z).max(initial=0.0))
            + float(np.abs(rows[:done, 0] / rows[:done, 2]).max(initial=0.0)) / model.s
        )
        run.error = dataclasses.replace(run.error, q_source=charge_error + ROUNDING * held)
    run.continuous = _in_closed_form(problem, solve_algebraic)
    return run


def _in_closed_form(problem: Problem, solve: Callable[..., Run], *more: float) -> ClosedForm | None:
    """The run between its outputs; None where the source is a function, which costs too much to look at."""
    if problem.scene.is_sampled:
        return None
    bare = dataclasses.replace(problem, charge=False)
    look = partial(_look, bare, solve, more)
    return ClosedForm(look, problem.waveform, problem.t_start, problem.first, problem.t_stop)


def _look(
    problem: Problem, solve: Callable[..., Run], more: tuple[float, ...], t: FloatArray, left: BoolArray
) -> Record:  # fmt: skip
    return solve(problem, t, left, *more).record(problem)


def _finished(
    problem: Problem, t: FloatArray, left: BoolArray, live: FloatArray, z: FloatArray | None,
    current: FloatArray | None, u_gap: FloatArray, force: FloatArray, state: State, bound: float, failed: float | None,
) -> Run:  # fmt: skip
    """A run with its peaks and its error: rounding, and `bound` relative to the peaks."""
    peak_u, peak_f = float(np.abs(u_gap).max(initial=0.0)), float(force.max(initial=0.0))
    rounding = ROUNDING * problem.scene.u_peak
    share = rounding / peak_u if peak_u > 0.0 else 0.0
    return Run(
        t,
        left,
        live,
        z if problem.charge else None,
        current if problem.charge else None,
        status=Status.SUCCESS if failed is None else Status.SOURCE_NOT_FINITE,
        error=ErrorEstimate(rounding + bound * peak_u, (2.0 * share + 3.0 * bound) * peak_f),
        peak_u=peak_u,
        peak_f=peak_f,
        nfev=0,
        stats={},
        state=state,
        t_failed=failed,
    )


def linear_model(model: Model, area: float) -> Model:
    """The same stack with its area fixed, m^2."""
    return model._replace(coupled=False, area0=area, curve=fixed_area_curve(area))


def solve_linear(problem: Problem, t_out: FloatArray, left: BoolArray, area: float, bound: float) -> Run:
    """Outputs of a stack whose leaks are those at one area, in closed form.

    Parameters
    ----------
    problem : Problem
        Its charge is wanted only where the area is fixed.
    t_out, left : ndarray, shape (n_out,)
    area : float
        m^2.
    bound : float
        Error from taking this area, relative to the peaks; 0 where it is the area, or does not matter.
    """
    model = linear_model(problem.model, area)
    key = ("linear", area)
    if key not in problem.scene.prepared:
        problem.scene.prepared[key] = build_system(model, 1e-13, (1.0 / area, 1.0 / area), problem.stack.grouping)
    system: System = problem.scene.prepared[key]
    start = problem.initial
    w = system.project[0] @ start.y[:-1]
    wave, failed, tables = problem.waveform, None, Tables(problem, 1e-13, no_chirps=True, t_out=t_out)
    z = current = None
    z_end = float(start.y[-1])
    end, u_end = problem.t_stop, float(wave.value(problem.t_stop, "left"))
    if _is_sample_by_sample(problem, t_out):
        live, w_end = _at_samples(problem, system, w)
        t, side = t_out, left
        u_source = wave.value(t)
    else:
        flow = _Charge(system, w, problem.t_start, start.u_before, float(start.y[-1]))
        t, side, modes, slope, at_end, reached, failed = _closed_form(problem, tables, system, w, t_out, left)
        if failed is not None:
            end, u_end = reached
        w_end = at_end[:-1]
        u_source = np.array(wave.value(t))
        u_source[side] = wave.value(t[side], "left")
        # Not by BLAS, whose threads cost more than the product and may round otherwise.
        live = np.outer(system.k_shown, u_source) + np.einsum("lk,tk->lt", system.shown[0], modes[:, :-1])
        if problem.charge:
            z, current = flow.at(t, u_source, slope, modes)
            # The state is that before a jump at the end.
            z_end = flow.at(np.array([end]), np.array([u_end]), np.zeros(1), at_end[None, :])[0][0]
    u_gap = _probe_voltage(problem, live, u_source)
    inverse = 1.0 / areas(u_gap, problem.model.curve) if problem.model.coupled else np.full(u_gap.size, 1.0 / area)
    y = np.append(system.live[0] @ w_end, z_end)
    ended = State(end, y, u_end, start.charge_offset, problem.scene.charge_law)
    run = _finished(
        problem, t, side, live, z, current, u_gap, problem.scene.force(u_gap, inverse), ended, bound, failed
    )
    run.rough, run.unseen = tables.rough, tables.unseen
    run.continuous = _in_closed_form(problem, solve_linear, area, bound)
    return run


def _closed_form(
    problem: Problem, tables: Tables, system: System, w: FloatArray, t_out: FloatArray, left: BoolArray
) -> tuple[FloatArray, BoolArray, FloatArray, FloatArray, FloatArray, tuple[float, float], float | None]:
    """Outputs reached, the modes there with the source's integral last, its slope there, the modes at the end.

    Then the end itself, as time (s) and source voltage (V), and when the source stopped being finite.
    """
    n = w.size
    # The source's integral rides along as a mode of rate zero, for the charge.
    rates, gains = np.append(system.rates[0], 0.0), np.append(system.gain[0], 1.0)
    state = np.append(w, 0.0)
    modes = np.empty((t_out.size, n + 1))
    slope = np.zeros(t_out.size)
    done, end = 0, (problem.t_start, problem.initial.u_before)
    table = None
    for table, where in _windows(tables, t_out, left):
        modes[where], state = linear.respond(
            rates, gains, table.edges, table.terms, table.series, state, t_out[where], left[where]
        )
        if problem.charge:
            slope[where] = source_at(table.edges, table.terms, table.series, t_out[where], left[where])[1]
        done, end = where.stop, _end_of(table)
    failed = tables.not_finite
    if failed is None and table is not None and done < t_out.size:
        modes[done:] = state
        if problem.charge:
            slope[done:] = _after(problem, table)[1]
        done = t_out.size
    return t_out[:done], left[:done], modes[:done], slope[:done], state, end, failed


def _end_of(table: SourceTable) -> tuple[float, float]:
    """Time (s) and source voltage (V, left-hand) at the end of a table: finite, where the source may no longer be."""
    u, _ = source_at(table.edges, table.terms, table.series, table.edges[-1:], np.ones(1, bool))
    return float(table.edges[-1]), float(u[0])


def _after(problem: Problem, table: SourceTable) -> tuple[FloatArray, FloatArray]:
    """Source voltage and slope just after the end of a run, shape (1,) each."""
    segment, tau = after_the_end(problem, table)
    edges = np.array([segment.start, segment.start + segment.length])
    at, right = np.array([segment.start + tau]), np.zeros(1, bool)
    u, slope = source_at(edges, segment.terms[None], segment.series[None], at, right)
    return u, slope


def _is_sample_by_sample(problem: Problem, t_out: FloatArray) -> bool:
    """Whether a recorded source is wanted at its own samples from the first one on: then a recursion serves."""
    wave = problem.waveform
    if problem.charge or not isinstance(wave, Samples) or not 1 < t_out.size <= wave.values.size:
        return False
    if wave.start != problem.t_start or t_out[-1] < problem.t_stop * (1.0 - 1e-12):
        return False
    grid = wave.start + np.arange(t_out.size) / wave.rate
    return bool(np.all(np.abs(t_out - grid) <= same_time(problem.t_stop)))


def _at_samples(problem: Problem, system: System, w: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Live voltages at the samples of a recorded source, and the modes at the last."""
    wave = problem.waveform
    assert isinstance(wave, Samples)
    count = round((problem.t_stop - wave.start) * wave.rate) + 1
    u = wave.values[:count]
    live = np.empty((system.k_shown.size, u.size))
    end = w
    for i in range(system.k_shown.size):
        _, end = hold.first_order_hold(
            u, 1.0 / wave.rate, system.rates[0], system.gain[0], float(system.k_shown[i]), system.shown[0, i], w,
            out=live[i],
        )  # fmt: skip
    return live, end


def _probe_voltage(problem: Problem, live: FloatArray, u_source: FloatArray) -> FloatArray:
    """Voltage of the layer that errors are measured on, from the recorded ones."""
    place = problem.stack.layer_order.index(problem.scene.probe_layer)
    return np.asarray(live[place] if place < live.shape[0] else u_source - live.sum(axis=0))


@dataclass(frozen=True)
class _Charge:
    """Charge and current of a stack with its area fixed, through the layer that leaks slowest (see `Model.slow`)."""

    system: System
    w_start: FloatArray
    t_start: float
    u_before: float
    z_start: float

    def at(self, t: FloatArray, u: FloatArray, slope: FloatArray, modes: FloatArray) -> tuple[FloatArray, FloatArray]:
        """z and the current at times t, from U, its slope, and the modes (n_t, n + 1) with the integral of U last."""
        model, q = self.system.model, float(self.system.q0[0])
        n = self.w_start.size
        share, capacitance, g_area, g_total = model.slow[n:]
        leak = g_area + q * g_total
        w, u_integral = modes[:, :n], modes[:, n]
        rates, gain, row = self.system.rates[0], self.system.gain[0], self.system.slow[0]
        moved = w - self.w_start
        held = np.outer(t - self.t_start, self.w_start)
        decaying = rates > 0.0
        w_integral = np.where(decaying, (np.outer(u_integral, gain) - moved) / np.where(decaying, rates, 1.0), held)
        passed = capacitance * _weighed(moved, row) + leak * (share * u_integral + _weighed(w_integral, row))
        jumped = 0.0 if model.mobile else (u - self.u_before) / model.s
        rate = _weighed(np.outer(u, gain) - rates * w, row)
        lam = capacitance * rate + leak * (share * u + _weighed(w, row))
        return self.z_start + (passed + jumped) / q, (lam + slope / model.s) / q


def _weighed(rows: FloatArray, weights: FloatArray) -> FloatArray:
    """Sum over each row with weights; not by BLAS, whose rounding of a row depends on how many there are."""
    return np.asarray(np.einsum("tk,k->t", rows, weights))
