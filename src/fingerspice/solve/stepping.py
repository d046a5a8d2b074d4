"""The common part of exponential integrators of stacks and networks: periodicity test, repetition, recorded steps."""

from __future__ import annotations

import math
from abc import abstractmethod
from functools import partial

import numpy as np

from fingerspice.base.arrays import FloatArray
from fingerspice.base.units import format_si
from fingerspice.engine.collocation import loop, readout
from fingerspice.engine.collocation.loop import Circuit, Looks
from fingerspice.engine.collocation.readout import LoopState, Outputs
from fingerspice.engine.collocation.step_control import Pace
from fingerspice.engine.network import Sources
from fingerspice.engine.one_area.system import area_missed
from fingerspice.results.outcome import State, Status
from fingerspice.results.record import Record
from fingerspice.results.steps import Recorder
from fingerspice.solve.problem import Problem
from fingerspice.solve.runs import Integration, Run, excess_of, refuse_beyond_law, with_error
from fingerspice.waveforms.sampling import same_time

FEWEST_PERIODS = 6.0  # Runs of fewer periods are integrated throughout, because nothing would be saved
# Number of the source's periods after which a run's error is first compared with its peaks, where ten times as many
# are left: the tolerance was chosen before the peaks were known, and a run where it proves too large ends there.
TRIAL_PERIODS = 2.0
_SHARE = 1.0 / 3.0  # Remaining change allowed over all later periods, as a fraction of the error allowed in a step
# Ratio of stated to estimated error: the largest error of a step may lie beside the points at which it is estimated,
# and contributions of opposite sign may cancel at these points.
SAFETY = 2.5
# Error allowed in a step, relative to the error asked for: a relative error of the voltage counts twice in the force,
# and the errors of the steps add up.
LOCAL_SHARE = 0.15
FINEST = 4e-15  # Smallest error of a step above round-off, relative to the voltage scale
# Error allowed in a step, relative to the one before, once the voltages have settled and a period is to be repeated so
# often that the errors of its charge add up.
FINER = 0.01
# Longest step, relative to the source's shortest time scale: the collocation nodes must not alias the source.
LONGEST_STEP = 0.6
PARTS = 8  # Parts of a run under a chirp, in each of which the longest step is that of the highest frequency there
KEPT_STEPS = 2000  # Most steps of a period that is kept for repetition: 1 MB


class OutOfRangeError(Exception):
    """A gap voltage left the range of its area's curve: the argument, V."""


class Stepping(Integration):
    """One integration by exponential steps, with an error of at most `tol` (V) in each step."""

    n_error: int  # Size of `LoopState.error`
    gaps: list[int]  # Rows of `peaks` of the gaps whose errors are stated
    largest: float  # Voltage (V) beside the peaks that the round-off of the charge goes with
    decade: int  # Of the relative error asked for, which chooses the areas' polynomials
    curves: FloatArray  # (n_area, l): Of the areas, as in `Net`
    capacitance: float  # Capacitance of what holds the charge, at the areas at 0 V, F
    charge_safety = 1.0  # Stated error of the charge over the estimate
    rates: FloatArray  # Decay rates of the modes, among them those at 0 V, 1/s
    looks = loop.no_looks()  # Those of a run that `look` does not prepare

    def __init__(self, problem: Problem, tol: float, shown: int, width: int) -> None:
        super().__init__(problem)
        wave, span = problem.network.waveform, problem.t_stop - problem.t_start
        self.period = wave.period or math.inf
        self.longest = problem.longest_step(LONGEST_STEP, problem.t_start, problem.t_stop)
        first, last = (wave.shortest_time(t, t) for t in (problem.t_start, problem.t_stop))
        self.part = math.inf if first == last else span / PARTS
        self.out = np.empty((width, self.t_out.size))  # Output rows as columns
        self.rows = self.out.T
        self.outputs = Outputs(self.t_out, self.left, self.out)
        self.repeated = 0  # Number of periods that were not integrated but repeat another
        self.recorder = Recorder(shown)
        self.begin(problem.initial, tol)
        self.keep(0)

    def look(self, asked: float, repeat: bool) -> None:
        """Look for the periodic state, if the run is to `repeat` a period; judge its error early, against `asked`."""
        problem, values, self.asked = self.problem, np.zeros(loop.N_VALUES), asked
        start, live = max(problem.t_start, problem.network.waveform.settled), [x for x in self.rates.flat if x > 0.0]
        values[loop.START], values[loop.STOP], values[loop.PERIOD] = start, problem.t_stop, self.period
        values[loop.ALLOWED], values[loop.HAS_CHARGE] = _SHARE * self.pace.tol, problem.charge
        values[loop.LOOKED] = -1.0
        # A mode with rate 0 keeps its charge for ever, so that it does not limit the time to the periodic state.
        values[loop.RATE] = loop.RATE_SHARE * min(live, default=math.inf)
        values[loop.DISTANCE] = values[loop.REMAINING] = values[loop.TRIAL] = math.inf
        periods = (problem.t_stop - start) / self.period * (1.0 + 1e-12)
        values[loop.NEXT] = start if repeat and periods >= FEWEST_PERIODS else math.inf
        if asked < math.inf and periods >= 1.0 + 10.0 * TRIAL_PERIODS:
            values[loop.TRIAL] = start + TRIAL_PERIODS * self.period
            values[loop.ACCEPTABLE] = asked / SAFETY
        scale = np.ones(self.n + self.n_slow)
        scale[self.n :] = self.largest
        self.looks = Looks(values, np.zeros(scale.size), scale)

    def begin(self, initial: State, tol: float) -> None:
        """Go to the start, with an initial state and an error of a step (V)."""
        self.controls, self.step = np.zeros(1, readout.CONTROL), np.zeros(1, readout.STEP)
        self.control = self.controls[0]
        self.control["t"], self.control["margin"], self.control["magnified"] = self.problem.t_start, 1.0, 1.0
        self.branch = np.array([self.problem.t_start, math.inf] * self.net.gap.size).reshape(-1, 2)  # As in `LoopState`
        self.counters, self.error = np.zeros(readout.N_COUNTERS, np.int64), np.zeros(self.n_error)
        self.peaks, self.collected = np.zeros((self.net.gap.size + 1, 4)), np.zeros((2, self.s_before.size))
        self.y[:], self.s_before[:], self.sign[:] = initial.y, initial.s_before, initial.sign
        self.pace = Pace(tol, self.longest, True, self.problem.charge)
        self.recorder.parts.clear()

    @property
    def t(self) -> float:
        return float(self.control["t"])

    @abstractmethod
    def circuit(self, sources: Sources) -> Circuit:
        """The circuit as the compiled loop takes it, for one call."""

    @property
    @abstractmethod
    def rounding(self) -> list[float]:
        """Round-off of the voltage of every area's gap and, last, of the nodes, V."""

    @property
    def margin(self) -> float:
        """Smallest distance to a fold so far."""
        return float(self.control["margin"])

    def failed(self, code: int, sources: Sources) -> Status:
        """Status of a run whose loop ended with a code other than DONE; a contact law may have ended before."""
        for i in self.problem.network.fingers:
            refuse_beyond_law(self.problem, i, float(self.peaks[i, readout.PEAK_U]), f"at {format_si(self.t, 's')} ")
        return Status.TOO_MANY_STEPS if code == readout.TOO_MANY else self.stuck()

    def march(self, sources: Sources, t_end: float, looks: Looks) -> int:
        """Step to `t_end` (s) in the compiled loop, or to a look that has found something: a code of `readout`."""
        while True:
            state = LoopState(
                self.y, self.error, self.sign, self.branch, self.controls, self.counters, self.step, self.peaks,
                self.collected, self.outputs, self.kept, self.recorder.room, self.tried,
            )  # fmt: skip
            code = int(loop.march_on(self.circuit(sources), self.pace, state, looks, t_end))
            if self.counters[readout.RECORDED] >= len(self.recorder.room.times):
                self.recorder.drain(self.counters)
            if code != readout.PAUSED:
                return code

    def stated_peaks(self) -> list[list[float]]:
        """Peaks so far, of every area's gap and of the nodes, with their stated errors: estimates and round-off."""
        found = []
        for (u, f, u_error, f_error), floor in zip(self.peaks.tolist(), self.rounding, strict=True):
            # F ~ u^2 A, and A falls with u.
            steepest = 2.0 * f / u if u > 0.0 else 0.0
            found.append([u, f, SAFETY * u_error + floor, SAFETY * f_error + floor * steepest])
        return found

    def stated(self, run: Run) -> None:
        """Write the recorded steps, the stated errors and the margin into a run."""
        self.recorder.drain(self.counters)
        peaks, shown = self.stated_peaks(), self.problem.scene.shown
        run.continuous = self.recorder.finish(self.problem.first, partial(Record, shown.network, shown.net))
        run.stats["repeated"] = self.repeated
        run.gaps, run.margin = np.array([peaks[i] for i in self.gaps]).reshape(-1, 4), self.margin
        run.node_error = peaks[-1][readout.ERROR_U]
        if not self.pace.charge:
            return
        # Errors of unknown sign are the same in every period: they add up from one to the next, instead of cancelling.
        steps = 1.0 + float(self.counters[readout.ACCEPTED])
        alike = (self.t - self.problem.t_start) / self.period - self.repeated
        known, spread = float(self.control["error_q"]), max(self.collected[1].tolist(), default=0.0)
        estimate = SAFETY * math.sqrt(known**2 + max(alike - 1.0, 0.0) * spread)
        held = self.capacitance * (self.largest + max(peak[readout.PEAK_U] for peak in peaks))
        moved = max(float(self.control["peak_q"]), *map(abs, self.y[-self.s_before.size :].tolist()))
        # Every step adds the round-off of the charge that is held, and the relative error of the areas' polynomials is
        # also a relative error of all charge moved.
        missed = self.problem.scene.remember(
            ("missed", self.decade, self.curves.tobytes()),
            lambda: max((area_missed(curve, self.decade) for curve in self.curves), default=0.0),
        )
        run.charge_error = float(self.charge_safety * estimate + 4e-16 * held * steps + missed * (held + moved))

    def through(self, sources: Sources, t_end: float) -> Status:
        # A period that has been repeated may have led there already.
        while self.t < t_end:
            until = t_end if t_end - self.t < 1.5 * self.part else self.t + self.part
            if self.part < math.inf:
                self.pace = self.pace._replace(h_max=self.problem.longest_step(LONGEST_STEP, self.t, until))
            code = self.march(sources, until, self.looks)
            if code == readout.LOOKED_AT:
                self._settle()
            elif code == readout.EXCESSIVE:
                if excess_of(np.array(self.stated_peaks())[self.gaps], self.problem.rounding) > self.asked:
                    return Status.ERROR_NOT_MET
            elif code != readout.DONE:
                return self.failed(code, sources)
        return Status.SUCCESS

    def _settle(self) -> None:
        """Once the periodic state is reached, keep the next period and then repeat it to the end."""
        found = self.looks.values
        if found[loop.HAS_SETTLED] == 0.0:
            # The voltages have, and the charge has not.
            tol, finest = self.pace.tol, FINEST * float(self.peaks[self.gaps, readout.PEAK_U].max(initial=0.0))
            share = min(1.0, max(FINER, finest / tol))
            found[loop.ALLOWED], found[loop.FINE] = share * found[loop.ALLOWED], 1.0
            self.pace = self.pace._replace(tol=share * tol)
        elif not len(self.kept.times):
            self.keep(KEPT_STEPS)
        else:
            # A period of too many steps to keep is not repeated: all later periods are integrated.
            if 0 < int(self.counters[readout.KEPT]) <= len(self.kept.times):
                self._repeat()
            self.keep(0)
            found[loop.NEXT] = math.inf

    def keep(self, steps: int) -> None:
        """Keep the steps from now on, at most `steps` of them."""
        # The loop fills in what it keeps: zeros would take longer than all of these steps.
        self.kept = readout.new_steps(steps, len(self.out))
        if steps:
            self.counters[readout.KEPT] = 0
            self.recorder.drain(self.counters)
            self.kept_from = len(self.recorder.parts)
            self.before = self.y[-self.s_before.size :].copy(), self.collected.copy()

    def _repeat(self) -> None:
        """Repeat the kept period in place of all whole periods that follow."""
        found, n_s, period, stop = self.looks.values, self.s_before.size, self.period, self.problem.t_stop
        periods, off, owed = int(found[loop.LEFT]), float(found[loop.DISTANCE]), float(found[loop.REMAINING])
        drifts = np.zeros(len(self.out))
        if self.pace.charge:
            # Every period repeats the charge of the integrated one, and its error.
            charge, collected = self.before
            drift, (missed, spread) = self.y[-n_s:] - charge, self.collected - collected
            drifts[-2 * n_s : -n_s] = drift
            self.y[-n_s:] += periods * drift
            self.collected[0] += periods * missed
            added = periods * float((np.abs(missed) + np.sqrt(spread)).max())
            self.control["error_q"] += added + self.capacitance * owed
        self.counters[readout.OUTPUT] = readout.repeat(
            self.kept, int(self.counters[readout.KEPT]), period, periods, drifts, int(self.counters[readout.OUTPUT]),
            self.outputs,
        )  # fmt: skip
        self.recorder.drain(self.counters)
        self.recorder.repeat(self.kept_from, periods, period)
        # The end of a period may be the end of the run but for the rounding of both.
        reached = self.t + periods * period
        self.control["t"] = stop if abs(stop - reached) <= same_time(stop) else reached
        self.branch[:, 0] += periods * period
        # What the voltages, and the charge over the capacitance, are still off the periodic state: `off` and `owed`, V.
        self.peaks[:] = with_error(self.peaks, off)
        self.repeated += periods
