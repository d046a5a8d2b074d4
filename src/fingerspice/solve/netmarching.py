"""Runs of a network by exponential collocation, with the error followed step by step; `marching` for networks."""

from __future__ import annotations

import math
import threading
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from fingerspice.circuit.network import Modes, network_modes
from fingerspice.engine import netassess, netmarch, readout
from fingerspice.engine import repeat as repetition
from fingerspice.engine.exponential import Tables, new_tables
from fingerspice.engine.netrows import Form, new_work
from fingerspice.engine.network import Sources
from fingerspice.engine.pace import Pace
from fingerspice.engine.system import area_error, area_missed, area_polynomials
from fingerspice.numerics.lobatto import integral_table
from fingerspice.physics.contact import inverse_areas
from fingerspice.results.network_record import bare_record
from fingerspice.results.outcome import Status
from fingerspice.results.steps import Recorded, Recorder
from fingerspice.solve.netruns import Integration, NetworkRun, held, integrate, state_error
from fingerspice.solve.networks import NetworkProblem, NetworkScene
from fingerspice.solve.runs import Progress, kept_with
from fingerspice.solve.settling import Settling
from fingerspice.waveforms.sampling import same_time

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

# As in `marching`.
SAFETY, LOCAL_SHARE, FINEST, LONGEST_STEP, ATTEMPTS = 2.5, 0.15, 4e-15, 0.6, 6
# Ratio of neighbouring reference areas.
LEVEL_RATIO = 1.28
# Steps for each of the sources' edges and shortest times: what needs more is for another method. Where a mode follows
# at once and the area moves its charge strongly, the iteration closes on steps as short as the mode's own time only.
MOST_STEPS = 100
# References that stay with a scene.
MOST_REFERENCES = 64
# Steps of a period that is kept, at most.
KEPT_STEPS = 2000
# A gap's voltage over the largest one of its sources' before it is known, V.
GUESS = 1.0


@dataclass(frozen=True)
class Reference:
    """A network around reference areas, with the tables it has needed so far.

    Attributes
    ----------
    form : Form
    tables : Tables
    size : ndarray, shape (n,)
        Voltage that each mode of the live voltages moves, V.
    tau : float
        Shortest time constant, s.
    magnified : ndarray, shape (n_area,)
        Rounding of each gap's voltage over that of the largest voltage.
    """

    form: Form
    tables: Tables
    size: FloatArray
    tau: float
    magnified: FloatArray


def reference_at(scene: NetworkScene, levels: tuple[int, ...], decade: int) -> Reference:
    """The reference whose areas are the fixed ones, or LEVEL_RATIO to these powers over those at 0 V."""
    # One for each thread: compiled code writes into its tables, and other threads run meanwhile.
    key = ("reference", levels, decade, threading.get_ident())
    area = scene.area0 * LEVEL_RATIO ** np.array(levels, float)
    found: Reference = kept_with(
        scene.prepared, key, MOST_REFERENCES, lambda: _make_reference(scene, area, area_error(decade))
    )
    return found


def _make_reference(scene: NetworkScene, area: FloatArray, tol: float) -> Reference:
    network, net = scene.network, scene.net
    modes = network_modes(network, area)
    n, n_s = modes.gains.shape
    slow = net.slow >= 0
    n_slow = int(np.count_nonzero(slow))
    follows = net.gap >= 0
    fed = np.flatnonzero([i >= 0 and follows[i] for i in net.place])
    fed = fed[np.argsort(net.place[fed], kind="stable")]
    tap, tap_s = network.p @ modes.shape, network.q - network.p @ modes.follow
    feed = np.vstack([-modes.take[:, fed], np.zeros((n_slow, fed.size))])
    gap, gap_s, stress = np.zeros((area.size, n)), np.zeros((area.size, n_s)), np.zeros(area.size)
    for i in network.fingers:
        cell, contact = network.gaps[i], network.contacts[i]
        assert cell is not None
        assert contact is not None
        gap[i], gap_s[i], stress[i] = tap[cell], tap_s[cell], float(contact.stress(1.0))
    powers, slopes, lo, scale = area_polynomials(net.curves, follows, tol)
    capacitance, leak = network.capacitance(area)[:, None], network.leak(area)[:, None]
    at_x, at_s = network.delivered[:, :n], network.delivered[:, n:]
    form = Form(
        mobile=net.mobile,
        rates=np.append(modes.rates, 1.0 / net.tau[slow]),
        gain=np.vstack([modes.gains, np.zeros((n_slow, n_s))]),
        shape=_packed(modes.shape),
        inverse=_packed(modes.inverse),
        follow=_packed(modes.follow),
        feed=_packed(feed),
        tap=_packed(tap[fed]),
        tap_s=_packed(tap_s[fed]),
        c=net.c[fed],
        g=net.g_area[fed],
        home=net.place[fed],
        first=np.searchsorted(net.place[fed], np.arange(area.size + 1)),
        cell=np.array([int(np.flatnonzero(fed == i)[0]) if i >= 0 else -1 for i in net.gap], np.int64),
        area0=area.copy(),
        unit=scene.area0.copy(),
        slow=np.where(slow, n + net.slow, -1),
        pace=np.where(slow, 1.0 / np.where(slow, net.tau, 1.0), 0.0),
        gap=gap,
        gap_s=gap_s,
        stress=stress,
        powers=powers,
        slopes=slopes,
        lo=lo,
        scale=scale,
        curves=net.curves,
        stored=_packed(network.through @ (capacitance * tap)),
        stored_s=_packed(network.through @ (capacitance * tap_s)),
        lost=_packed(network.through @ (leak * tap) + at_x @ modes.shape),
        lost_s=_packed(network.through @ (leak * tap_s) - at_x @ modes.follow + at_s),
        through=_packed(network.through[:, fed]),
    )
    fastest = float(form.rates.max(initial=0.0))
    return Reference(
        form, new_tables(n + n_slow), np.linalg.norm(modes.shape, axis=0),
        1.0 / fastest if fastest > 0.0 else math.inf,
        _magnified(modes, gap, gap_s),
    )  # fmt: skip


def _magnified(modes: Modes, gap: FloatArray, gap_s: FloatArray) -> FloatArray:
    """Rounding of each gap's voltage, a sum over modes and sources, over that of the largest voltage."""
    live = modes.rates[modes.rates > 0.0]
    # What the rounding of the fastest mode leaves in the slowest.
    spread = math.sqrt(float(live.max() / live.min())) if live.size else 0.0
    every = (np.abs(modes.shape) @ np.abs(modes.inverse)).sum(axis=1).max(initial=1.0)
    own = (np.abs(gap) @ np.abs(modes.inverse)).sum(axis=1) + np.abs(gap_s).sum(axis=1)
    return np.asarray((every + spread) * np.minimum(own / every, 1.0))


def _packed(x: FloatArray) -> FloatArray:
    return np.ascontiguousarray(x, float)


class March(Integration):
    """One integration in progress; see `engine.netmarch.march`."""

    def __init__(
        self, problem: NetworkProblem, tol: float, rtol: float, u_scale: float, t_out: FloatArray, left: BoolArray,
        repeat: bool,
    ) -> None:  # fmt: skip
        super().__init__(problem, tol, t_out, left)
        n_s, n_area = self.s_before.size, self.net.gap.size
        self.decade = int(np.floor(np.log10(rtol)))
        self.u_scale = u_scale
        self.out = np.full((self.width, t_out.size), np.nan)
        self.rows = self.out.T
        longest = min(LONGEST_STEP * problem.waveform.shortest_time(), problem.t_stop - problem.t_start)
        self.pace = Pace(tol * u_scale, min(longest, problem.max_step), True, problem.charge)
        self.error = np.zeros(self.n + self.n_slow)
        self.counters = np.zeros(readout.N_COUNTERS, np.int64)
        self.met = np.zeros((n_area, 4))
        self.peaks = self.met[:, netassess.PEAK_U]
        self.collected = np.zeros((2, n_s))
        self.control = np.zeros(netmarch.MOST + 1)
        self.control[readout.T] = problem.t_start
        self.branch = np.tile([problem.t_start, math.inf], (n_area, 1))
        self.shortest = problem.waveform.shortest_time()
        self.integral = integral_table()
        self.levels = (0,) * n_area
        self.reference = reference_at(problem.scene, self.levels, self.decade)
        cells = self.reference.form.c.size
        self.work = new_work(self.n, self.n + self.n_slow, cells, n_area, n_s, self.y.size + n_s)
        self.settling = Settling(problem, self.reference.form.rates, self.pace.tol)
        if not repeat:
            self.settling.next = math.inf
        self.repeated = 0
        self.recorder = Recorder(self.n + self.n_slow)
        self.keep(0)
        self.control[readout.MAGNIFIED] = 1.0

    @property
    def t(self) -> float:
        return float(self.control[readout.T])

    def _march(self, sources: Sources, t_end: float) -> int:
        reference = self.reference
        size = np.append(reference.size, np.full(self.n_slow, self.u_scale))
        taken = int(self.counters[readout.ACCEPTED] + self.counters[readout.REJECTED])
        self.control[netmarch.MOST] = taken + MOST_STEPS * (4.0 + sources.edges.size + (t_end - self.t) / self.shortest)
        while True:
            code = netmarch.march(
                reference.form, self.pace, reference.tables, self.work, self.integral, size, sources, reference.tau,
                t_end, self.y, self.error, self.sign, self.s_before, self.branch, self.control, self.counters, self.met,
                self.collected, self.t_out, self.left, self.out, self.kept, self.recorder.room, self.tried,
            )  # fmt: skip
            if self.counters[readout.RECORDED] >= len(self.recorder.room.times):
                self.recorder.drain(self.counters)
            if code != netmarch.PAUSED:
                return int(code)

    def through(self, sources: Sources, t_end: float) -> Status:
        edges, settling = np.sort(sources.edges), self.settling
        while True:
            stop = min(settling.snapped(edges, settling.next), t_end)
            status = self._to(sources, stop)
            if status is not Status.SUCCESS or stop < settling.next - same_time(stop):
                return status
            kept, room = int(self.counters[readout.KEPT]), len(self.kept.times)
            state = np.append(self.y[: self.n], self.u_scale * self.y[self.n : self.n + self.n_slow])
            if not settling.look(state, float(self.control[readout.MAGNIFIED])):
                self.keep(0)
            elif room == 0:
                self.keep(KEPT_STEPS)
            else:
                if 0 < kept <= room:
                    self._repeat(kept)
                self.keep(0)
                settling.next = math.inf
            if self.t >= t_end:
                return status

    def keep(self, steps: int) -> None:
        """Keep so many of the steps that follow."""
        self.kept = repetition.new_kept(steps, self.width)
        self.counters[readout.KEPT] = 0
        self.recorder.drain(self.counters)
        self.kept_from = len(self.recorder.parts)
        self.before = self.y.copy(), self.collected.copy()

    def _repeat(self, kept: int) -> None:
        """Let the period that is kept stand for the whole ones that follow."""
        settling, n_s = self.settling, self.s_before.size
        periods, span = settling.periods_left(self.t), settling.periods_left(self.t) * settling.period
        y, collected = self.before
        drifts = np.zeros(self.width)
        if self.problem.charge:
            drifts[self.y.size - n_s : self.y.size] = (self.y - y)[-n_s:]
        self.counters[readout.OUTPUT] = repetition.repeat(
            self.kept, kept, settling.period, periods, drifts, int(self.counters[readout.OUTPUT]), self.t_out,
            self.left, self.out,
        )  # fmt: skip
        self.y[-n_s:] += periods * (self.y - y)[-n_s:]
        self.control[readout.T] += span
        self.branch[:, 0] += span
        peaks = self.met
        peaks[:, netassess.ERROR_U] += settling.remaining
        steepest = 2.0 * peaks[:, netassess.PEAK_F] / np.maximum(peaks[:, netassess.PEAK_U], 1e-300)
        peaks[:, netassess.ERROR_F] += settling.remaining * steepest
        # What the kept period is off is off in every one that it stands for.
        missed, spread = self.collected - collected
        self.collected[0] += periods * missed
        held = float(self.problem.network.capacitance(self.problem.scene.area0).sum())
        self.control[readout.ERROR_Q] += (
            periods * float((np.abs(missed) + np.sqrt(spread)).max()) + held * settling.remaining
        )
        self.recorder.drain(self.counters)
        self.recorder.repeat(self.kept_from, periods, settling.period)
        self.repeated = periods

    def recorded(self) -> Recorded | None:
        """The steps taken so far."""
        self.recorder.drain(self.counters)
        problem = self.problem
        return self.recorder.finish(
            problem.first, problem.t_stop, partial(bare_record, problem.network, self.net, problem.scene.waveforms)
        )

    def _to(self, sources: Sources, t_end: float) -> Status:
        while True:
            code = self._march(sources, t_end)
            if code == netmarch.DONE:
                return Status.SUCCESS
            if code == netmarch.TOO_MANY:
                return Status.TOO_MANY_STEPS
            if code != netmarch.REFERENCE:
                return self.stuck()
            self._change_reference()

    def jump(self, after: FloatArray) -> bool:
        return self._march(held(self.t, after), self.t) == netmarch.DONE

    def _change_reference(self) -> None:
        """Go on around the reference nearest to the areas now, and carry the error of the modes over."""
        net, old = self.net, self.reference
        u = np.abs(net.p @ self.y[: self.n] + net.q @ self.s_before)
        levels = []
        for i, unit in enumerate(self.problem.scene.area0):
            area = unit
            if net.slow[i] >= 0:
                area = unit * self.y[self.n + net.slow[i]]
            elif net.gap[i] >= 0:
                area = 1.0 / inverse_areas(u[[net.gap[i]]], net.curves[i])[0]
            levels.append(round(math.log(area / unit) / math.log(LEVEL_RATIO)))
        self.levels = tuple(levels)
        self.reference = reference_at(self.problem.scene, self.levels, self.decade)
        self.error[: self.n] = self.reference.form.inverse @ (old.form.shape @ self.error[: self.n])
        for coupling in (self.work.own, self.work.whole, self.work.inside):
            coupling.stiff[0] = -1


def solve_network(
    problem: NetworkProblem,
    rtol: float,
    t_out: FloatArray,
    left: BoolArray,
    progress: Progress | None = None,
    *,
    repeat: bool = True,
) -> NetworkRun | None:
    """Integrate until the stated error is within `rtol` of the peaks of every gap's voltage and force.

    None where the steps find no way on, or not to that error: near a fold, and beyond what exponentials reach.
    """
    n = problem.network.k.shape[0]
    u_scale = max(problem.scene.u_peak, float(np.abs(problem.initial.y[:n]).max(initial=0.0))) or GUESS
    tol, nfev = LOCAL_SHARE * rtol, 0
    for _ in range(ATTEMPTS):
        one = March(problem, tol, rtol, u_scale, t_out, left, repeat)
        run = integrate(one, progress)
        nfev += run.nfev
        run.nfev = nfev
        run.stats["repeated"] = one.repeated
        run.continuous = one.recorded()
        if run.status in (Status.FOLD, Status.STEP_UNDERFLOW, Status.TOO_MANY_STEPS):
            return None
        worst = _stated(run, one, u_scale) / rtol
        if run.status is not Status.SUCCESS or worst <= 1.0:
            return run
        if tol <= FINEST:
            return None
        tol = max(tol * min(0.3, 0.5 / worst), FINEST)
    return None


def _stated(run: NetworkRun, one: March, u_scale: float) -> float:
    """Write the stated error into a run; returns it over the peaks of each gap, the larger of voltage and force."""
    gaps = one.met.copy()
    u_peak = gaps[:, netassess.PEAK_U]
    largest = float(u_peak.max(initial=0.0))
    # Rounding is an error too.
    floor = 4e-16 * (one.reference.magnified * (largest + u_scale) + u_peak)
    steepest = 2.0 * gaps[:, netassess.PEAK_F] / np.where(u_peak > 0.0, u_peak, np.inf)
    gaps[:, netassess.ERROR_U] = SAFETY * gaps[:, netassess.ERROR_U] + floor
    gaps[:, netassess.ERROR_F] = SAFETY * gaps[:, netassess.ERROR_F] + floor * steepest
    charge = None
    if one.problem.charge:
        steps = 1.0 + float(one.counters[readout.ACCEPTED])
        held = float(one.problem.network.capacitance(one.problem.scene.area0).sum()) * (u_scale + largest)
        # Whatever the areas' polynomials miss, all charge that is moved misses too.
        moved = held + float(np.abs(one.y[-one.s_before.size :]).max(initial=0.0))
        charge = 2.0 * SAFETY * float(one.control[readout.ERROR_Q]) + 4e-16 * held * steps
        charge += moved * max((area_missed(curve, one.decade) for curve in one.net.curves), default=0.0)
    run.margin = 1.0 / float(one.control[readout.MAGNIFIED])
    return state_error(run, gaps[list(one.problem.network.fingers)], u_scale, charge)
