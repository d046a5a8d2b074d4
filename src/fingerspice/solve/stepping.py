"""An integration by exponential steps in progress, of a stack or a network: settling, repeating, recorded steps."""

from __future__ import annotations

import math
from abc import abstractmethod
from functools import partial
from typing import Any

import numpy as np

from fingerspice.base.arrays import BoolArray, FloatArray
from fingerspice.engine import readout
from fingerspice.engine import repeat as repetition
from fingerspice.engine.network import Sources
from fingerspice.engine.pace import Pace
from fingerspice.results.outcome import Status
from fingerspice.results.record import bare_record
from fingerspice.results.steps import Recorded, Recorder
from fingerspice.solve.problem import Problem
from fingerspice.solve.runs import Integration, Run, excess_of
from fingerspice.solve.settling import Settling
from fingerspice.waveforms.sampling import same_time

# The largest error between nodes may stand beside the two points where it is looked for, and signs may cancel there.
SAFETY = 2.5
# The error allowed in a step, over the one asked for: the force doubles it, and steps add up.
LOCAL_SHARE = 0.15
# The smallest error of a step that is more than rounding, over the voltage scale.
FINEST = 4e-15
# Steps per shortest time scale of the source: the points of a step must not alias it.
LONGEST_STEP = 0.6
# Steps of a period that is kept, at most: 1 MB.
KEPT_STEPS = 2000
# Periods of the source after which a run's error is compared with its peaks for the first time.
TRIAL_PERIODS = 2.0


class OutOfRangeError(Exception):
    """A gap voltage left the range of its area's curve; `top` (V) is that range."""

    def __init__(self, top: float) -> None:
        self.top = top


class Stepping(Integration):
    """Exponential steps; `tol` is the error allowed in each of them, V.

    Attributes
    ----------
    pace : Pace
    settling : Settling
    control : ndarray
        As `engine.readout` has it.
    out : ndarray, shape (width, n_out)
        Takes the outputs.
    repeated : int
        Periods that others stand for.
    trial : float
        When the stated error is compared with `asked`, relative to the peaks, s: it goes by the gaps' own, which are
        not known before. A run that is not within it is to begin anew then, not at its end.
    """

    settling: Settling
    control: FloatArray
    trial, asked = math.inf, math.inf

    def __init__(
        self, problem: Problem, tol: float, t_out: FloatArray, left: BoolArray, shown: int, width: int,
        h_fixed: float = 0.0,
    ) -> None:  # fmt: skip
        super().__init__(problem, t_out, left)
        span = problem.t_stop - problem.t_start
        longest = h_fixed or min(LONGEST_STEP * problem.waveform.shortest_time(), span, problem.max_step)
        self.pace = Pace(tol, longest, h_fixed == 0.0, problem.charge)
        self.counters = np.zeros(readout.N_COUNTERS, np.int64)
        self.out = np.empty((width, t_out.size))
        self.repeated = 0
        self.recorder = Recorder(shown)
        self.keep(0)

    @property
    def t(self) -> float:
        return float(self.control[readout.T])

    @abstractmethod
    def _to(self, sources: Sources, t_end: float) -> Status:
        """March to `t_end` (s)."""

    @abstractmethod
    def _look(self) -> bool:
        """Whether the state has settled; see `Settling.look`."""

    @abstractmethod
    def _collected(self) -> Any:
        """What the charge's error has collected so far."""

    @abstractmethod
    def _pass(self, periods: int, alike: int, off: float, collected: Any) -> None:
        """Go on by whole periods whose outputs are written, `alike` more than the one that was integrated for them.

        They are `off` by so much (V); `collected` is what the charge's error was before that one.
        """

    @abstractmethod
    def stated_gaps(self) -> FloatArray:
        """See `Run.gaps`, so far."""

    @abstractmethod
    def stated(self, run: Run) -> None:
        """Write the stated errors and the margin into a run."""

    def leap(self, sources: Sources) -> None:
        """Let the periods that follow come from one map, if its error allows it."""

    def try_out(self, asked: float) -> None:
        """Look at the stated error after a few periods, where many are left."""
        start = self.settling.start
        if self.settling.periods_left(start) > 10.0 * TRIAL_PERIODS:
            self.trial, self.asked = start + TRIAL_PERIODS * self.settling.period, asked

    def through(self, sources: Sources, t_end: float) -> Status:
        edges, settling = sources.edges if sources.first.size == 2 else np.sort(sources.edges), self.settling
        while True:
            stop = min(settling.snapped(edges, min(settling.next, self.trial)), t_end)
            status = self._to(sources, stop)
            if status is not Status.SUCCESS:
                return status
            if stop >= self.trial - same_time(stop):
                self.trial = math.inf
                if excess_of(self.stated_gaps(), self.problem.largest) > self.asked:
                    return Status.ERROR_NOT_MET
            if stop >= settling.next - same_time(stop):
                self._settle(sources)
            if self.t >= t_end:
                return status

    def _settle(self, sources: Sources) -> None:
        """See whether the run has settled: then the next period is kept, and stands for those after it."""
        if not self._look():
            self.keep(0)
            if self.settling.may_leap:
                self.leap(sources)
        elif not len(self.kept.times):
            self.keep(KEPT_STEPS)
        else:
            # Where there were too many steps to keep, it goes on as it is.
            if self.keeps_all:
                self._repeat()
            self.keep(0)
            self.settling.next = np.inf

    def keep(self, steps: int) -> None:
        """Keep so many of the steps that follow."""
        self.kept = repetition.new_kept(steps, len(self.out))
        if steps:
            self.counters[readout.KEPT] = 0
            self.recorder.drain(self.counters)
            self.kept_from = len(self.recorder.parts)
            self.before = self.y[-self.s_before.size :].copy(), self._collected()

    @property
    def keeps_all(self) -> bool:
        """Whether all steps since `keep` are kept."""
        return 0 < int(self.counters[readout.KEPT]) <= len(self.kept.times)

    def _repeat(self) -> None:
        """Let the period that is kept stand for the whole ones that follow."""
        settling, n_s = self.settling, self.s_before.size
        periods, period = settling.periods_left(self.t), settling.period
        charge, collected = self.before
        drift = self.y[-n_s:] - charge
        drifts = np.zeros(len(self.out))
        if self.problem.charge:
            drifts[-2 * n_s : -n_s] = drift
        self.counters[readout.OUTPUT] = repetition.repeat(
            self.kept, int(self.counters[readout.KEPT]), period, periods, drifts, int(self.counters[readout.OUTPUT]),
            self.t_out, self.left, self.out,
        )  # fmt: skip
        self.y[-n_s:] += periods * drift
        self.recorder.drain(self.counters)
        self.recorder.repeat(self.kept_from, periods, period)
        self.control[readout.T] += periods * period
        self._pass(periods, periods, settling.remaining, collected)
        self.repeated += periods

    def charge_error(self, spread: float) -> float:
        """Estimated error of the charge, C, with what steps have left with signs that are not known, C^2.

        They are the same in every period, and so do not cancel between periods.
        """
        period = self.problem.waveform.period
        passed = self.t - self.problem.t_start
        alike = passed / period - self.repeated if period else 0.0
        known = float(self.control[readout.ERROR_Q])
        return SAFETY * math.sqrt(known**2 + max(alike - 1.0, 0.0) * spread)

    def recorded(self) -> Recorded | None:
        """The steps taken so far."""
        self.recorder.drain(self.counters)
        problem = self.problem
        shown = problem.scene.shown
        make = partial(bare_record, shown.network, shown.net)
        return self.recorder.finish(problem.first, problem.t_stop, make)
