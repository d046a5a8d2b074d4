"""Runs of a network by exponential collocation, with the error followed step by step; `marching` for networks."""

from __future__ import annotations

import math
from functools import partial

import numpy as np
from numpy.typing import NDArray

from fingerspice.engine import netassess, netmarch, readout
from fingerspice.engine import repeat as repetition
from fingerspice.engine.netrows import new_work
from fingerspice.engine.network import Sources
from fingerspice.engine.pace import Pace
from fingerspice.engine.system import area_missed
from fingerspice.numerics.lobatto import integral_table
from fingerspice.results.network_record import bare_record
from fingerspice.results.outcome import Status
from fingerspice.results.steps import Recorded, Recorder
from fingerspice.solve.netruns import Integration, NetworkRun, excess_of, held, integrate, state_error
from fingerspice.solve.networks import NetworkProblem
from fingerspice.solve.references import known_references
from fingerspice.solve.runs import Progress
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
# Periods of the source after which a run's error is compared with its peaks for the first time.
TRIAL_PERIODS = 2.0


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
        self.references = known_references(problem.scene, self.decade)
        self.form = self.references.form()
        cells = self.form.c.size
        self.work = new_work(self.n, self.n + self.n_slow, cells, n_area, n_s, self.y.size + n_s)
        self.settling = Settling(problem, self.form.rates.copy(), self.pace.tol)
        # What is asked for goes by the gaps' own peaks, which are not known before: a run whose error is not within it
        # begins anew after a few periods, not at its end.
        has_trial = self.settling.periods_left(self.settling.start) > 2.0 * TRIAL_PERIODS
        self.trial = self.settling.start + TRIAL_PERIODS * self.settling.period if has_trial else math.inf
        self.rtol = rtol
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
        taken = int(self.counters[readout.ACCEPTED] + self.counters[readout.REJECTED])
        self.control[netmarch.MOST] = taken + MOST_STEPS * (4.0 + sources.edges.size + (t_end - self.t) / self.shortest)
        while True:
            known = self.references
            code = netmarch.march(
                self.form, known.arrays, self.pace, known.tables, self.work, self.integral, sources, self.u_scale,
                t_end, self.y, self.error, self.sign, self.s_before, self.branch, self.control, self.counters, self.met,
                self.collected, self.t_out, self.left, self.out, self.kept, self.recorder.room, self.tried,
            )  # fmt: skip
            if self.counters[readout.RECORDED] >= len(self.recorder.room.times):
                self.recorder.drain(self.counters)
            if code == netmarch.REFERENCE:
                self._add_reference()
            elif code != netmarch.PAUSED:
                return int(code)

    def through(self, sources: Sources, t_end: float) -> Status:
        edges, settling = np.sort(sources.edges), self.settling
        while True:
            stop = min(settling.snapped(edges, min(settling.next, self.trial)), t_end)
            status = self._to(sources, stop)
            if status is not Status.SUCCESS:
                return status
            if stop >= self.trial - same_time(stop):
                self.trial = math.inf
                if excess_of(self.stated_gaps(), self.u_scale) > self.rtol:
                    return Status.ERROR_NOT_MET
            if stop >= settling.next - same_time(stop):
                self._look()
            if self.t >= t_end:
                return status

    def _look(self) -> None:
        """See whether the run has settled: then the next period is kept, and stands for those after it."""
        settling = self.settling
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

    def stated_gaps(self) -> FloatArray:
        """Peaks of voltage (V) and force (N) of every gap and the stated errors of both, shape (n_gap, 4)."""
        gaps = self.met.copy()
        u_peak = gaps[:, netassess.PEAK_U]
        # Rounding is an error too.
        floor = 4e-16 * (self.references.magnified * (float(u_peak.max(initial=0.0)) + self.u_scale) + u_peak)
        steepest = 2.0 * gaps[:, netassess.PEAK_F] / np.where(u_peak > 0.0, u_peak, np.inf)
        gaps[:, netassess.ERROR_U] = SAFETY * gaps[:, netassess.ERROR_U] + floor
        gaps[:, netassess.ERROR_F] = SAFETY * gaps[:, netassess.ERROR_F] + floor * steepest
        return gaps[list(self.problem.network.fingers)]

    def recorded(self) -> Recorded | None:
        """The steps taken so far."""
        self.recorder.drain(self.counters)
        problem = self.problem
        return self.recorder.finish(
            problem.first, problem.t_stop, partial(bare_record, problem.network, self.net, problem.scene.waveforms)
        )

    def _to(self, sources: Sources, t_end: float) -> Status:
        code = self._march(sources, t_end)
        if code == netmarch.DONE:
            return Status.SUCCESS
        return Status.TOO_MANY_STEPS if code == netmarch.TOO_MANY else self.stuck()

    def jump(self, after: FloatArray) -> bool:
        return self._march(held(self.t, after), self.t) == netmarch.DONE

    def _add_reference(self) -> None:
        """Make the reference that the loop has looked for."""
        known, at = self.references, self.work.at
        wanted = tuple(map(int, known.arrays.wanted))
        if known.is_full:
            # The one in use comes along: tables and couplings of others are made again.
            levels = tuple(map(int, known.arrays.levels[at[0]]))
            self.references = known = known_references(self.problem.scene, self.decade, anew=True)
            if levels != (0,) * len(levels):
                known.add(levels)
            at[0] = known.count - 1
            self.work.own.keys[:] = self.work.own.key[:] = -1
        known.add(wanted)


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
        worst = _stated(run, one) / rtol
        if run.status is not Status.ERROR_NOT_MET and (run.status is not Status.SUCCESS or worst <= 1.0):
            return run
        if tol <= FINEST:
            return None
        tol = max(tol * min(0.3, 0.5 / worst), FINEST)
    return None


def _stated(run: NetworkRun, one: March) -> float:
    """Write the stated error into a run; returns it over the peaks of each gap, the larger of voltage and force."""
    gaps = one.stated_gaps()
    charge = None
    if one.problem.charge:
        steps = 1.0 + float(one.counters[readout.ACCEPTED])
        largest = float(gaps[:, netassess.PEAK_U].max(initial=0.0))
        held = float(one.problem.network.capacitance(one.problem.scene.area0).sum()) * (one.u_scale + largest)
        # Whatever the areas' polynomials miss, all charge that is moved misses too.
        moved = held + float(np.abs(one.y[-one.s_before.size :]).max(initial=0.0))
        charge = 2.0 * SAFETY * float(one.control[readout.ERROR_Q]) + 4e-16 * held * steps
        charge += moved * max((area_missed(curve, one.decade) for curve in one.net.curves), default=0.0)
    run.margin = 1.0 / float(one.control[readout.MAGNIFIED])
    return state_error(run, gaps, one.u_scale, charge)
