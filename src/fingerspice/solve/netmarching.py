"""One integration of a network by exponential steps: as `engine.loop` takes it."""

from __future__ import annotations

import math

import numpy as np

from fingerspice.base.arrays import BoolArray, FloatArray
from fingerspice.engine import loop, loopstate, netassess, readout
from fingerspice.engine.mesh import Mesh
from fingerspice.engine.netform import new_work
from fingerspice.engine.network import Sources
from fingerspice.engine.settling import Looks, no_looks
from fingerspice.engine.system import area_missed
from fingerspice.numerics.lobatto import integral_table
from fingerspice.results.outcome import Status
from fingerspice.solve.problem import Problem
from fingerspice.solve.references import known_references
from fingerspice.solve.runs import NetworkIntegration, Run
from fingerspice.solve.settling import looks_of
from fingerspice.solve.sources import held as held_at
from fingerspice.solve.stepping import SAFETY, Stepping

# Most steps for each edge and each shortest time of the sources; a run that needs more is left to another method. Where
# an area strongly affects the charge of a stiff mode, the fixed-point iteration converges only with steps of the
# mode's own time constant.
MOST_STEPS = 100


class March(Stepping, NetworkIntegration):
    """One integration in progress, with an error of at most `tol` times `u_scale` (V) in every step."""

    def __init__(
        self, problem: Problem, tol: float, rtol: float, u_scale: float, t_out: FloatArray, left: BoolArray,
        repeat: bool,
    ) -> None:  # fmt: skip
        scene, size = problem.scene, problem.initial.y.size
        n_s, n_area = len(scene.waveforms), scene.net.gap.size
        self.u_scale, self.decade = u_scale, int(np.floor(np.log10(rtol)))
        self.control = np.zeros(readout.N_CONTROL)
        self.control[readout.T] = problem.t_start
        self.control[readout.MAGNIFIED] = 1.0
        self.collected = np.zeros((2, n_s))
        width = size + n_s if problem.charge else size
        super().__init__(problem, tol * u_scale, t_out, left, size - n_s, width)
        self.rows = self.out.T
        self.error = np.zeros(self.n + self.n_slow)
        self.met = np.zeros((n_area + 1, 4))
        self.branch = np.tile([problem.t_start, math.inf], (n_area, 1))
        self.shortest = problem.waveform.shortest_time()
        self.integral = integral_table()
        self.references = known_references(scene, self.decade)
        self.form = self.references.form()
        cells = self.form.c.size
        self.work = new_work(self.n, self.n + self.n_slow, cells, n_area, n_s, self.y.size + n_s)
        scale = np.append(np.ones(self.n), np.full(self.n_slow, u_scale))
        self.looks = looks_of(problem, self.form.rates.copy(), self.pace.tol, scale, repeat)

    def march(self, sources: Sources, t_end: float, looks: Looks) -> int:
        taken = int(self.counters[readout.ACCEPTED] + self.counters[readout.REJECTED])
        more = MOST_STEPS * (4.0 + sources.edges.size + (t_end - self.t) / self.shortest)
        self.place[loopstate.MOST] = taken + int(more)
        while True:
            known = self.references
            mesh = Mesh(
                self.form, known.arrays, known.tables, self.work, self.integral, sources, self.u_scale, self.sign,
                self.s_before, self.branch, self.met, self.collected,
            )  # fmt: skip
            code = int(loop.march_on(mesh, self.pace, self.loop_state(), looks, t_end))
            if self.counters[readout.RECORDED] >= len(self.recorder.room.times):
                self.recorder.drain(self.counters)
            if code == loopstate.REFERENCE:
                self._add_reference()
            elif code != loopstate.PAUSED:
                return code

    def _collected(self) -> FloatArray:
        return self.collected.copy()

    def _pass(self, periods: int, off: float, owed: float, collected: FloatArray) -> None:
        self.branch[:, 0] += periods * self.period
        met = self.met
        met[:, netassess.ERROR_U] += off
        steepest = 2.0 * met[:, netassess.PEAK_F] / np.maximum(met[:, netassess.PEAK_U], 1e-300)
        met[:, netassess.ERROR_F] += off * steepest
        missed, spread = self.collected - collected
        self.collected[0] += periods * missed
        held = float(self.problem.network.capacitance(self.problem.scene.area0).sum())
        self.control[readout.ERROR_Q] += periods * float((np.abs(missed) + np.sqrt(spread)).max()) + held * owed

    def _failed(self, code: int, sources: Sources) -> Status:
        return Status.TOO_MANY_STEPS if code == loopstate.TOO_MANY else self.stuck()

    def jump(self, after: FloatArray) -> bool:
        return self.march(held_at(self.t, after), self.t, no_looks()) == loopstate.DONE

    def _add_reference(self) -> None:
        """Add the reference areas that the compiled loop needs next, and that it has written to `wanted`."""
        known, at = self.references, self.work.at
        wanted = tuple(map(int, known.arrays.wanted))
        if known.is_full:
            # Start a new set of references with the one in use; the tables and couplings of all others are dropped.
            levels = tuple(map(int, known.arrays.levels[at[0]]))
            self.references = known = known_references(self.problem.scene, self.decade, anew=True)
            if levels != (0,) * len(levels):
                known.add(self.problem.scene, levels)
            at[0] = known.count - 1
            self.work.own.keys[:] = self.work.own.key[:] = -1
        known.add(self.problem.scene, wanted)

    def stated_gaps(self) -> FloatArray:
        return self._stated()[list(self.problem.scene.network.fingers)]

    def _stated(self) -> FloatArray:
        """Peaks and stated errors of the gaps of all areas; the last row is that of the nodes."""
        gaps = self.met.copy()
        u_peak = gaps[:, netassess.PEAK_U]
        # Round-off, enlarged by the condition of the modes, adds to the truncation error.
        floor = 4e-16 * (self.references.magnified * (float(u_peak.max(initial=0.0)) + self.u_scale) + u_peak)
        steepest = 2.0 * gaps[:, netassess.PEAK_F] / np.where(u_peak > 0.0, u_peak, np.inf)
        gaps[:, netassess.ERROR_U] = SAFETY * gaps[:, netassess.ERROR_U] + floor
        gaps[:, netassess.ERROR_F] = SAFETY * gaps[:, netassess.ERROR_F] + floor * steepest
        return gaps

    def stated(self, run: Run) -> None:
        scene = self.problem.scene
        run.gaps = self.stated_gaps()
        run.node_error = float(self._stated()[-1, netassess.ERROR_U])
        run.margin = 1.0 / float(self.control[readout.MAGNIFIED])
        if self.problem.charge:
            steps = 1.0 + float(self.counters[readout.ACCEPTED])
            largest = self.u_scale + float(self.met[:, netassess.PEAK_U].max(initial=0.0))
            held = float(scene.network.capacitance(scene.area0).sum()) * largest
            # The relative error of the areas' polynomials is also a relative error of all charge moved.
            moved = held + float(np.abs(self.y[-self.s_before.size :]).max(initial=0.0))
            missed = max((area_missed(curve, self.decade) for curve in self.net.curves), default=0.0)
            error_q = self.charge_error(float(self.collected[1].max(initial=0.0)))
            run.charge_error = error_q + 4e-16 * held * steps + moved * missed
