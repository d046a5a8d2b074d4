"""A network by exponential steps; see `engine.netmarch.march`."""

from __future__ import annotations

import math
import threading
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fingerspice.circuit.network import Modes, network_modes
from fingerspice.engine import netassess, netmarch, readout
from fingerspice.engine.exponential import Tables, new_tables
from fingerspice.engine.netrows import Form, new_work
from fingerspice.engine.network import Sources
from fingerspice.engine.system import area_error, area_missed, area_polynomials
from fingerspice.numerics.lobatto import integral_table
from fingerspice.physics.contact import inverse_areas
from fingerspice.results.outcome import Status
from fingerspice.solve.problem import Problem
from fingerspice.solve.runs import NetworkIntegration, Run, kept_with
from fingerspice.solve.scenes import Scene
from fingerspice.solve.settling import Settling
from fingerspice.solve.sources import held as held_at
from fingerspice.solve.stepping import SAFETY, Stepping

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

# Ratio of neighbouring reference areas.
LEVEL_RATIO = 1.28
# Steps for each of the sources' edges and shortest times: what needs more is for another method. Where a mode follows
# at once and the area moves its charge strongly, the iteration closes on steps as short as the mode's own time only.
MOST_STEPS = 100
# References that stay with a scene.
MOST_REFERENCES = 64
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


def reference_at(scene: Scene, levels: tuple[int, ...], decade: int) -> Reference:
    """The reference whose areas are the fixed ones, or LEVEL_RATIO to these powers over those at 0 V."""
    # One for each thread: compiled code writes into its tables, and other threads run meanwhile.
    key = ("reference", levels, decade, threading.get_ident())
    area = scene.area0 * LEVEL_RATIO ** np.array(levels, float)
    found: Reference = kept_with(
        scene.prepared, key, MOST_REFERENCES, lambda: _make_reference(scene, area, area_error(decade))
    )
    return found


def _make_reference(scene: Scene, area: FloatArray, tol: float) -> Reference:
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


class March(Stepping, NetworkIntegration):
    """One integration in progress, with an error of `tol` times `u_scale` (V) in every step."""

    def __init__(
        self, problem: Problem, tol: float, rtol: float, u_scale: float, t_out: FloatArray, left: BoolArray,
        repeat: bool,
    ) -> None:  # fmt: skip
        scene, size = problem.scene, problem.initial.y.size
        n_s, n_area = len(scene.waveforms), scene.net.gap.size
        self.u_scale, self.decade = u_scale, int(np.floor(np.log10(rtol)))
        self.control = np.zeros(netmarch.MOST + 1)
        self.control[readout.T] = problem.t_start
        self.control[readout.MAGNIFIED] = 1.0
        self.collected = np.zeros((2, n_s))
        width = size + n_s if problem.charge else size
        super().__init__(problem, tol * u_scale, t_out, left, size - n_s, width)
        self.rows = self.out.T
        self.error = np.zeros(self.n + self.n_slow)
        self.met = np.zeros((n_area, 4))
        self.branch = np.tile([problem.t_start, math.inf], (n_area, 1))
        self.shortest = problem.waveform.shortest_time()
        self.integral = integral_table()
        self.levels = (0,) * n_area
        self.reference = reference_at(scene, self.levels, self.decade)
        cells = self.reference.form.c.size
        self.work = new_work(self.n, self.n + self.n_slow, cells, n_area, n_s, self.y.size + n_s)
        self.settling = Settling(problem, self.reference.form.rates, self.pace.tol)
        if not repeat:
            self.settling.next = math.inf

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

    def _look(self) -> bool:
        state = np.append(self.y[: self.n], self.u_scale * self.y[self.n : self.n + self.n_slow])
        return self.settling.look(state, float(self.control[readout.MAGNIFIED]))

    def _collected(self) -> FloatArray:
        return self.collected.copy()

    def _pass(self, periods: int, alike: int, off: float, collected: FloatArray) -> None:
        self.branch[:, 0] += periods * self.settling.period
        met = self.met
        met[:, netassess.ERROR_U] += off
        steepest = 2.0 * met[:, netassess.PEAK_F] / np.maximum(met[:, netassess.PEAK_U], 1e-300)
        met[:, netassess.ERROR_F] += off * steepest
        # What the kept period is off is off in every one that it stands for.
        missed, spread = self.collected - collected
        self.collected[0] += alike * missed
        held = float(self.problem.network.capacitance(self.problem.scene.area0).sum())
        self.control[readout.ERROR_Q] += alike * float((np.abs(missed) + np.sqrt(spread)).max()) + held * off

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
        return self._march(held_at(self.t, after), self.t) == netmarch.DONE

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

    def stated(self, run: Run) -> None:
        scene, gaps = self.problem.scene, self.met.copy()
        u_peak = gaps[:, netassess.PEAK_U]
        largest = float(u_peak.max(initial=0.0))
        # Rounding is an error too.
        floor = 4e-16 * (self.reference.magnified * (largest + self.u_scale) + u_peak)
        steepest = 2.0 * gaps[:, netassess.PEAK_F] / np.where(u_peak > 0.0, u_peak, np.inf)
        gaps[:, netassess.ERROR_U] = SAFETY * gaps[:, netassess.ERROR_U] + floor
        gaps[:, netassess.ERROR_F] = SAFETY * gaps[:, netassess.ERROR_F] + floor * steepest
        run.gaps = gaps[list(scene.network.fingers)]
        run.margin = 1.0 / float(self.control[readout.MAGNIFIED])
        if self.problem.charge:
            steps = 1.0 + float(self.counters[readout.ACCEPTED])
            held = float(scene.network.capacitance(scene.area0).sum()) * (self.u_scale + largest)
            # Whatever the areas' polynomials miss, all charge that is moved misses too.
            moved = held + float(np.abs(self.y[-self.s_before.size :]).max(initial=0.0))
            missed = max((area_missed(curve, self.decade) for curve in self.net.curves), default=0.0)
            error_q = 2.0 * SAFETY * float(self.control[readout.ERROR_Q])
            run.charge_error = error_q + 4e-16 * held * steps + moved * missed
