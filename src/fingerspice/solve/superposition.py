"""Runs of a network whose areas are fixed: its modes answered in closed form, source by source, and added up."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from fingerspice.circuit.network import Modes, Network
from fingerspice.engine.algebraic import source_at
from fingerspice.numerics import linear
from fingerspice.results.network_record import NetworkRecord
from fingerspice.results.outcome import ErrorEstimate, NetworkState, Status
from fingerspice.results.record import sided
from fingerspice.results.refined import ClosedForm
from fingerspice.solve.netruns import NetworkRun, first_unseen, gap_signals, source_tables, state_error
from fingerspice.solve.networks import NetworkProblem
from fingerspice.waveforms.sampling import SourceTable, breakpoints_at, source_table

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

# Of the closed forms, over the largest voltage of the run.
ROUNDING = 1e-12


def solve_fixed(problem: NetworkProblem, t_out: FloatArray, left: BoolArray) -> NetworkRun:
    """Outputs of a network whose areas are fixed, in closed form."""
    scene, network, start = problem.scene, problem.network, problem.initial
    modes = scene.modes
    n, n_s = modes.gains.shape
    v0 = modes.inverse @ (start.y[:n] + modes.follow @ start.s_before)
    v, v_end = np.zeros((t_out.size, n)), np.zeros(n)
    integral, slope = np.zeros((t_out.size, n_s)), np.zeros((t_out.size, n_s))
    # The sources' integrals ride along as modes of rate zero, for the charge.
    rates, gains = np.append(modes.rates, 0.0), np.vstack([modes.gains, np.ones(n_s)])
    states = [np.append(v0 if j == 0 else np.zeros(n), 0.0) for j in range(n_s)]
    first, last_tables, rough, unseen = 0, None, 0.0, None
    for tables in source_tables(problem, 1e-13, no_chirps=True):
        last_tables = tables
        end = min(float(table.edges[-1]) for table in tables)
        if any(table.edges.size < 2 for table in tables):
            break
        at = slice(first, _upto(t_out, left, end))
        for j, table in enumerate(tables):
            rows, states[j] = linear.respond(
                rates, gains[:, j], table.edges, table.terms, table.series, states[j], t_out[at], left[at]
            )
            v[at] += rows[:, :n]
            integral[at, j] = rows[:, n]
            slope[at, j] = source_at(table.edges, table.terms, table.series, t_out[at], left[at])[1]
            rough = max(rough, table.rough)
        unseen = unseen or first_unseen(problem, tables, t_out[at], 1e-13)
        first = at.stop
    stopped = [table.not_finite for table in last_tables or () if table.not_finite is not None]
    broken = min(stopped) if stopped else None
    done, end = (t_out.size, problem.t_stop) if broken is None else (first, problem.t_start)
    for j, table in enumerate(last_tables or ()):
        v_end += states[j][:n]
        if broken is None and first < t_out.size:
            v[first:] += states[j][:n]
            integral[first:, j] = states[j][n]
            slope[first:, j] = _slope_after(problem, j, table)
    integral_end = np.array([state[n] for state in states])
    t, side = t_out[:done], left[:done]
    if broken is not None:
        # What the sources that go on have moved after the last output is no result.
        v_end, integral_end = (v[done - 1], integral[done - 1]) if done else (v0, np.zeros(n_s))
        end = float(t[-1]) if done else end
    s = np.column_stack([sided(wave, t, side) for wave in scene.waveforms])
    s_end = np.array([float(wave.value(end, "left")) for wave in scene.waveforms])
    x = np.einsum("jk,tk->tj", modes.shape, v[:done]) - np.einsum("jk,tk->tj", modes.follow, s)
    x_end = modes.shape @ v_end - modes.follow @ s_end
    parts = [x]
    z_end = start.y[n:]
    if problem.charge:
        flow = _Charge(network, scene.area0, modes, v0, start, problem.t_start)
        parts += flow.at(t, x, v[:done], s, integral[:done], slope[:done])
        z_end = flow.at(np.array([end]), x_end[None], v_end[None], s_end[None], integral_end[None], np.zeros((1, n_s)))[
            0
        ][0]
    else:
        parts.append(np.zeros((done, n_s)))
    run = NetworkRun(
        t, side, np.hstack(parts), Status.SUCCESS if broken is None else Status.SOURCE_NOT_FINITE,
        ErrorEstimate(0.0, 0.0), np.zeros(len(network.areas)), 0, {},
        NetworkState(end, np.concatenate([x_end, z_end]), s_end, np.ones(len(network.areas))), broken,
    )  # fmt: skip
    run.unseen, run.rough = unseen, rough
    rounding, gaps = ROUNDING * max(scene.u_peak, float(np.abs(x).max(initial=0.0))), []
    for u, f in gap_signals(problem, run):
        peak, force = float(np.abs(u).max(initial=0.0)), float(f.max(initial=0.0))
        gaps.append((peak, force, rounding, 2.0 * rounding / peak * force if peak > 0.0 else 0.0))
    run.peaks[list(network.fingers)] = [gap[0] for gap in gaps[: len(network.fingers)]]
    state_error(run, np.array(gaps).reshape(-1, 4), scene.u_peak, None)
    run.error = run.error.at_least(rounding + rough, 0.0)
    if not scene.is_sampled:
        look = partial(_look, dataclasses.replace(problem, charge=False))
        run.continuous = ClosedForm(look, problem.waveform, problem.t_start, problem.first, problem.t_stop)
    return run


def _look(problem: NetworkProblem, t: FloatArray, left: BoolArray) -> NetworkRecord:
    return problem.record(solve_fixed(problem, t, left))


def _upto(t_out: FloatArray, left: BoolArray, end: float) -> int:
    """Number of outputs up to the end of a window, left-hand ones on it included."""
    last = int(np.searchsorted(t_out, end, side="left"))
    while last < t_out.size and t_out[last] == end and left[last]:
        last += 1
    return last


def _slope_after(problem: NetworkProblem, j: int, table: SourceTable) -> float:
    """Right-hand slope of a source at the very end of a run, 1/s of its unit."""
    stop, wave = problem.t_stop, problem.scene.waveforms[j]
    if breakpoints_at(wave, stop).size:
        table = source_table(wave, stop, stop + problem.step, 1e-10, problem.step)
    at = np.array([min(stop, float(table.edges[-1]))])
    _, slope = source_at(table.edges, table.terms, table.series, at, np.array([at[0] == table.edges[-1]]))
    return float(slope[0])


@dataclass(frozen=True)
class _Charge:
    """Charge that each source delivers, and its regular current, of a network with fixed areas."""

    network: Network
    area: FloatArray
    modes: Modes
    v_start: FloatArray
    start: NetworkState
    t_start: float

    def at(
        self, t: FloatArray, x: FloatArray, v: FloatArray, s: FloatArray, integral: FloatArray, slope: FloatArray
    ) -> list[FloatArray]:
        """Charges and currents (n_t, n_s) at times t, from the state, the sources, their integrals and slopes."""
        net, modes = self.network, self.modes
        n = modes.rates.size
        capacitance, leak = net.capacitance(self.area)[:, None], net.leak(self.area)[:, None]
        stored_x, stored_s = net.through @ (capacitance * net.p), net.through @ (capacitance * net.q)
        lost_x = net.through @ (leak * net.p) + net.delivered[:, :n]
        lost_s = net.through @ (leak * net.q) + net.delivered[:, n:]
        draining = modes.rates > 0.0
        passed = np.einsum("kj,tj->tk", modes.gains, integral) - (v - self.v_start)
        held = np.outer(t - self.t_start, self.v_start)
        # What nothing drains loses nothing either, so that its integral does not count.
        v_integral = np.where(draining, passed / np.where(draining, modes.rates, 1.0), held)
        x_integral = np.einsum("jk,tk->tj", modes.shape, v_integral) - np.einsum("jk,tk->tj", modes.follow, integral)
        dx = np.einsum("jk,tk->tj", modes.shape, np.einsum("kj,tj->tk", modes.gains, s) - modes.rates * v)
        dx -= np.einsum("jk,tk->tj", modes.follow, slope)

        def along(matrix: FloatArray, values: FloatArray) -> FloatArray:
            return np.asarray(np.einsum("kj,tj->tk", matrix, values))

        moved = along(stored_x, x - self.start.y[:n]) + along(stored_s, s - self.start.s_before)
        charge = self.start.y[n:] + moved + along(lost_x, x_integral) + along(lost_s, integral)
        current = along(stored_x, dx) + along(stored_s, slope) + along(lost_x, x) + along(lost_s, s)
        return [charge, current]
