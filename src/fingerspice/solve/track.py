"""One integration by exponential steps in progress: its state, its bookkeeping, and what it has written."""

from __future__ import annotations

import dataclasses
import threading
from functools import partial

import numpy as np

from fingerspice.engine import march, readout
from fingerspice.engine import repeat as repetition
from fingerspice.engine.exponential import Tables as StepTables
from fingerspice.engine.exponential import new_tables
from fingerspice.engine.pace import Pace
from fingerspice.engine.system import System, area_error, area_missed, area_range, build_system
from fingerspice.engine.work import Work, new_work
from fingerspice.numerics.lobatto import integral_table
from fingerspice.results.record import stack_record
from fingerspice.results.steps import Recorded, Recorder
from fingerspice.solve.problem import Problem, Scene
from fingerspice.solve.runs import BoolArray, FloatArray, after_the_end, from_rows, kept_with, row_width
from fingerspice.solve.settling import Settling
from fingerspice.waveforms.sampling import SourceTable

# The largest error between nodes may stand beside the two points where it is looked for, and signs may cancel there.
SAFETY = 2.5
# The smallest error of a step that is more than rounding, over the voltage scale.
FINEST = 4e-15
# Systems that stay with a scene: one for each thread and decade of tolerances, of up to 1 MB.
MOST_SYSTEMS = 64
# Steps of a period that is kept, at most: 1 MB.
KEPT_STEPS = 2000


@dataclasses.dataclass(frozen=True)
class Prepared:
    """A scene's system with the tables it has needed so far, and arrays to work in, for one thread."""

    system: System
    tables: StepTables
    work: Work
    integral: FloatArray
    # What the area's polynomial misses, relative.
    area_error: float


def prepare_system(scene: Scene, rtol: float, u_top: float = 0.0) -> Prepared:
    """The modal system of a scene, made on first use; with the area's curve up to `u_top` (V) if that is given."""
    # One system serves a decade of tolerances.
    decade = int(np.floor(np.log10(rtol)))
    # One for each thread: compiled code writes into its tables and its work, and other threads run meanwhile.
    key = ("system", decade, u_top, threading.get_ident())
    found: Prepared = kept_with(scene.prepared, key, MOST_SYSTEMS, lambda: _prepare(scene, decade, u_top))
    return found


def _prepare(scene: Scene, decade: int, u_top: float) -> Prepared:
    model = scene.model
    if u_top > 0.0:
        assert scene.stack.contact is not None
        model = model._replace(curve=scene.stack.contact.curve(u_top))
    contact = scene.stack.contact
    stress = 0.0 if contact is None else float(contact.stress(1.0))
    u_max = max(scene.u_peak, u_top)
    system = build_system(model, area_error(decade), area_range(model, u_max), scene.stack.grouping, stress)
    n = model.gap.size
    return Prepared(system, new_tables(n), new_work(n), integral_table(), area_missed(model.curve, decade))


@dataclasses.dataclass
class Track:
    """One integration in progress; see `engine.march.march`."""

    problem: Problem
    prepared: Prepared
    pace: Pace
    t_out: FloatArray
    left: BoolArray

    def __post_init__(self) -> None:
        start = self.problem.initial
        n = self.problem.model.gap.size
        self.y = start.y.copy()
        self.error = np.zeros(n + 1)
        self.control = np.zeros(readout.N_CONTROL)
        self.control[readout.T] = self.problem.t_start
        self.control[readout.U_BEFORE] = start.u_before
        self.control[readout.BRANCH_LENGTH] = np.inf
        self.control[readout.MARGIN] = 1.0
        if self.problem.model.mobile and abs(start.u_gap) > 0.0:
            self.control[readout.U_GAP], self.control[readout.SIGN] = start.u_gap, np.sign(start.u_gap)
        self.counters = np.zeros(readout.N_COUNTERS, np.int64)
        self.tried = np.zeros((readout.TRIED, 4))
        self.shown = self.prepared.system.k_shown.size
        self.out = np.empty((self.shown + 2 if self.pace.charge else self.shown, self.t_out.size))
        self.repeated = 0
        self.recorder = Recorder(self.shown)
        self.forget()

    @property
    def t(self) -> float:
        return float(self.control[readout.T])

    @property
    def capacitance(self) -> float:
        """Of the layer whose charge is followed, F."""
        model = self.prepared.system.model
        return float(model.slow[-3]) * model.area0

    def advance(self, table: SourceTable, t_end: float) -> int:
        """March to `t_end` (s) through a table."""
        p = self.prepared
        mine = (self.y, self.error, self.control, self.counters)
        while True:
            code = march.march(
                p.system, self.pace, p.tables, p.work, p.integral, table.edges, table.terms, table.series, t_end,
                *mine, self.t_out, self.left, self.out, self.kept, self.recorder.room, self.tried,
            )  # fmt: skip
            if code != march.PAUSED:
                return int(code)
            self.recorder.drain(self.counters)

    def forget(self) -> None:
        """Keep no steps."""
        self.kept = repetition.new_kept(0, self.out.shape[0])

    def keep(self, steps: int = KEPT_STEPS) -> None:
        """Keep so many of the steps that follow."""
        self.kept = repetition.new_kept(steps, self.out.shape[0])
        self.counters[readout.KEPT] = 0
        self.recorder.drain(self.counters)
        self.kept_from = len(self.recorder.parts)
        self.before = float(self.y[-1]), float(self.control[readout.COLLECTED]), float(self.control[readout.SPREAD])

    @property
    def keeps_all(self) -> bool:
        """Whether all steps since `keep` are kept."""
        return 0 < int(self.counters[readout.KEPT]) <= len(self.kept.times)

    def repeat(self, settling: Settling) -> None:
        """Let the period that is kept stand for the whole ones that follow."""
        periods, period = settling.periods_left(self.t), settling.period
        charge, collected, spread = self.before
        drift = float(self.y[-1]) - charge
        drifts = np.zeros(self.out.shape[0])
        if self.pace.charge:
            drifts[-2] = drift
        first, kept = int(self.counters[readout.OUTPUT]), int(self.counters[readout.KEPT])
        self.counters[readout.OUTPUT] = repetition.repeat(
            self.kept, kept, period, periods, drifts, first, self.t_out, self.left, self.out
        )
        self.y[-1] += periods * drift
        self.recorder.drain(self.counters)
        self.recorder.repeat(self.kept_from, periods, period)
        self._pass(periods, periods, settling, settling.remaining, collected, spread)
        self.forget()

    def leap(self, base: Track, state: FloatArray, periods: int, settling: Settling, off: float, owed: float) -> None:
        """Stand where a map of the period has led, in place of whole periods from here on.

        `base` has gone through the last of them; `state` is that after them, `off` what it may be off as a move of
        the gap voltage (V), and `owed` what the charge may be off for the map (C).
        """
        t, (collected, spread) = self.t, self.control[[readout.COLLECTED, readout.SPREAD]]
        self.y[:] = state
        self.error, self.control = base.error, base.control
        self.control[readout.T] = t
        self.control[readout.BRANCH_START] -= settling.period
        self.control[readout.ERROR_Q] += owed
        self._pass(periods, periods - 1, settling, off, collected, spread)

    def _pass(
        self, periods: int, alike: int, settling: Settling, off: float, collected: float, spread: float
    ) -> None:  # fmt: skip
        """Go on by whole periods whose outputs are written, `alike` more than the one that was integrated for them.

        They are `off` by so much (V); `collected` and `spread` are the charge's before that one (see `readout`).
        """
        self.control[readout.T] += periods * settling.period
        self.control[readout.BRANCH_START] += periods * settling.period
        self.control[readout.ERROR_U] += off
        if self.control[readout.PEAK_U] > 0.0:
            steepest = 2.0 * self.control[readout.PEAK_F] / self.control[readout.PEAK_U]
            self.control[readout.ERROR_F] += off * steepest
        if self.pace.charge:
            # What the one period is off is off in every one that it stands for.
            missed = self.control[readout.COLLECTED] - collected
            self.control[readout.COLLECTED] += alike * missed
            self.control[readout.ERROR_Q] += (
                alike * (abs(missed) + np.sqrt(self.control[readout.SPREAD] - spread))
                + self.capacitance * off
            )  # fmt: skip
        self.repeated += periods

    def recorded(self) -> Recorded | None:
        """The steps taken so far."""
        self.recorder.drain(self.counters)
        problem = self.problem
        return self.recorder.finish(
            problem.first, problem.t_stop, partial(stack_record, problem.stack, problem.waveform, problem.model)
        )

    def finish(self, table: SourceTable) -> None:
        """Write the right-hand outputs at the very end of the run."""
        first = int(self.counters[readout.OUTPUT])
        if first == self.t_out.size:
            return
        segment, tau = after_the_end(self.problem, table)
        # Copies take the charge of a jump that stands at the end; the state itself stays before it.
        row = np.empty(row_width(self.problem))
        march.end_row(
            self.prepared.system.model, segment, tau, self.pace.charge, self.y.copy(), self.control.copy(), row
        )
        live, z, current = from_rows(self.problem, row[None, :])
        n = live.shape[0]
        self.out[:n, first:] = live
        if self.pace.charge:
            self.out[n, first:] = z
            self.out[n + 1, first:] = current
        self.counters[readout.OUTPUT] = self.t_out.size
