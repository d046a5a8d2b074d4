"""One integration of a series stack by exponential steps: as `engine.collocation.loop` takes it."""

from __future__ import annotations

import math
import threading
from typing import Literal

import numpy as np

from fingerspice.base.arrays import FloatArray
from fingerspice.engine.collocation import readout
from fingerspice.engine.collocation.exponential import Tables as StepTables
from fingerspice.engine.collocation.exponential import forget, new_tables
from fingerspice.engine.collocation.step_control import end_row
from fingerspice.engine.network import Sources, source
from fingerspice.engine.one_area.model import Model, dot, gap_voltage, write_row_at
from fingerspice.engine.one_area.rows import Work, new_stack_work
from fingerspice.engine.one_area.step import OneArea
from fingerspice.engine.one_area.system import LEVEL_RATIO, System, area_error, area_missed, area_range, build_system
from fingerspice.numerics.lobatto import integral_table
from fingerspice.physics.contact import inverse_areas
from fingerspice.results.outcome import State, Status
from fingerspice.results.record import sided
from fingerspice.solve.problem import Problem, segment_of
from fingerspice.solve.scenes import Scene, kept_with
from fingerspice.solve.starting import StackState, as_marched, from_stack, from_written, model_of, row_width, to_stack
from fingerspice.solve.stepping import OutOfRangeError, Stepping

# Number of modal systems cached with a scene, one for each decade of tolerances, of up to 1 MB each.
MOST_SYSTEMS = 16
# Stated error of the charge over the estimate. It comes from a stack whose layers all leak fast: compared with a
# reference, the errors of gap voltage and charge were 1.5 times the estimates, because they peak between the points of
# the estimate; and from scene 7710 of tests/stress.py, whose area grows by a factor of 5e5 after every jump: 1.6 times.
CHARGE_SAFETY = 1.75


class _Scratch(threading.local):
    """The present thread's step tables and scratch arrays by number of modes, and the systems that the tables are of.

    Fresh arrays would cost a changed circuit some 50 us of its set-up, as the memory has to be mapped anew.
    """

    def __init__(self) -> None:
        self.by_size: dict[int, tuple[StepTables, Work]] = {}
        self.system: dict[int, System] = {}

    def of(self, system: System) -> tuple[StepTables, Work]:
        """Tables and arrays for the next call of a compiled loop: another system's run may use them after that."""
        n = system.model.gap.size
        if n not in self.by_size:
            self.by_size[n] = new_tables(n), new_stack_work(n)
        if self.system.get(n) is not system:
            self.system[n] = system
            forget(self.by_size[n][0])
        return self.by_size[n]


SCRATCH = _Scratch()


def _prepared(scene: Scene, rtol: float, u_top: float) -> tuple[System, float]:
    """The modal system of a scene, made on first use, and the relative error of its area's polynomial."""
    # The cache distinguishes tolerances by their decade, so that similar runs share a system.
    decade = int(np.floor(np.log10(rtol)))

    def make() -> tuple[System, float]:
        system = system_of(scene, decade, u_top)
        return system, area_missed(system.model.curve, decade) if system.model.coupled else 0.0

    return kept_with(scene.prepared, ("system", decade, u_top), MOST_SYSTEMS, make)


def system_of(
    scene: Scene, decade: int, u_top: float = 0.0, ratio: float = LEVEL_RATIO, u_peak: float = 0.0
) -> System:  # fmt: skip
    """The modal system of a scene for tolerances of a decade, with neighbouring reference areas in at most `ratio`.

    The area curve reaches `u_top` (V) and the reference areas `u_peak` (V) if these are above 0.
    """
    model, (contact,) = model_of(scene), scene.network.contacts
    assert scene.stack is not None
    if u_top > 0.0:
        assert contact is not None
        model = model._replace(curve=contact.curve(u_top))
    stress = 0.0 if contact is None else float(contact.stress(1.0))
    u_max, n = u_peak or max(scene.u_peak, u_top), model.gap.size
    nodes = scene.network.nodes[:, : n + 1] * np.append(scene.turn, 1.0)
    u_range = area_range(model, u_max)
    return build_system(model, area_error(decade), u_range, scene.stack.grouping, nodes, stress, ratio)


class Track(Stepping):
    """One integration in progress, with an error of the gap voltage of at most `tol` (V) in every step.

    The area's curve reaches `top` (V) if that is above 0. The loop's state is that of `engine.one_area.model`; `state`
    and the outputs have the form used for all circuits.
    """

    def __init__(
        self, problem: Problem, rtol: float, tol: float, top: float = 0.0, repeat: bool = True, h_fixed: float = 0.0
    ) -> None:
        scene = problem.scene
        self.system, self.area_error = _prepared(scene, rtol, top)
        model, n, shown = self.system.model, problem.initial.y.size - 1, scene.shown.turn.size
        self.gaps, self.largest, self.charge_safety = [0], scene.u_size, CHARGE_SAFETY
        # Of the layer through which the charge is computed.
        self.capacitance = float(model.slow[-3]) * model.area0
        super().__init__(problem, tol, shown, shown + 2 if problem.charge else shown, h_fixed)
        self.error = np.zeros(n + 1)
        self.control["branch_length"] = np.inf
        self.control["margin"] = 1.0
        self._start_from(problem.inner)
        self.look_for_period(self.system.rates, np.ones(n), repeat and h_fixed == 0.0)

    def _start_from(self, start: StackState) -> None:
        self.start, self.y[:], self.control["u_before"] = start, start.y, start.u_before
        if self.system.model.mobile and self.sign[0] != 0.0:
            self.control["u_gap"], self.control["sign"] = start.u_gap, math.copysign(1.0, start.u_gap)

    def again(self, initial: State, tol: float) -> None:
        super().again(initial, tol)
        self._start_from(to_stack(self.problem.scene, initial))

    @property
    def rounding(self) -> list[float]:
        # Of the nodes, the peak is that of the gap.
        peak, size = float(self.peaks[0, readout.PEAK_U]), self.problem.scene.u_size
        return [4e-16 * (peak + self.system.model.k_gap * size), 4e-16 * (peak + size)]

    def circuit(self, sources: Sources) -> OneArea:
        return OneArea(self.system, *SCRATCH.of(self.system), integral_table(), sources)

    def _failed(self, code: int, sources: Sources) -> Status:
        if code == readout.OUT_OF_RANGE:
            raise OutOfRangeError(self.system.u_top)
        if self.t > sources.edges[0]:
            # The loop updates the source's value at edges and at `t_end` only: a failed call leaves an old value.
            self.control["u_before"], _ = source(*segment_of(sources, self.t, "left"))
        return Status.TOO_MANY_STEPS if code == readout.TOO_MANY else self.stuck()

    def state(self) -> State:
        c = self.control
        found = StackState(self.t, self.y.copy(), float(c["u_before"]), float(c["u_gap"]), self.start.offset)
        return from_stack(self.problem.scene, on_branch(self.system.model, found, float(c["sign"])))

    def written(self) -> FloatArray:
        n_out = int(self.counters[readout.OUTPUT])
        model = self.system.model
        wanted = self.pace.charge and model.mobile
        u = sided(self.problem.waveform, self.t_out[:n_out], self.left[:n_out]) if wanted else np.empty(0)
        return as_recorded(self.problem, model, self.out[:, :n_out].T, u)

    def finish(self, sources: Sources, after: Sources | None) -> None:
        first = int(self.counters[readout.OUTPUT])
        row = np.empty(row_width(self.problem.scene))
        segment, tau = segment_of(after or sources, self.problem.t_stop, "right")
        model = self.system.model
        # `end_row` applies a jump at the end to these copies, so that the final state remains the left-hand one.
        end_row(model, segment, tau, self.pace.charge, self.y.copy(), self.controls.copy(), row)
        self.out[:, first:] = as_marched(self.problem.scene, row[None, :])[0, : len(self.out), None]
        self.counters[readout.OUTPUT] = self.t_out.size

    def row(self, sources: Sources, side: Literal["left", "right"]) -> FloatArray:
        # This model's area curve may reach higher voltages than the curve of the scene's model.
        model, c = self.system.model, self.control
        segment, tau = segment_of(sources, self.t, side)
        row = np.empty(row_width(self.problem.scene))
        u, du = source(segment, tau)
        found = gap_voltage(model, model.k_gap * u, dot(model.gap, self.y), c["sign"], c["u_gap"])
        # At a fold, the round-off of the time alone may leave the area equation without a solution: keep the last one.
        write_row_at(model, u, du, self.y, c["sign"], found if found == found else c["u_gap"], row)
        return from_written(self.problem.scene, row[None, :], self.start.offset, by_layer=True)[0, : len(self.out)]


def on_branch(model: Model, state: StackState, sign: float) -> StackState:
    """The state with its gap voltage computed anew from the area equation, on the branch with this sign."""
    if not model.mobile:
        return state
    x_gap = dot(model.gap, state.y)
    found = float(gap_voltage(model, model.k_gap * state.u_before, x_gap, sign or 1.0, state.u_gap))
    # At a fold, the round-off of the time alone may leave the area equation without a solution: keep the last one.
    return state if found != found else state._replace(u_gap=found)


def as_recorded(problem: Problem, model: Model, rows: FloatArray, u: FloatArray) -> FloatArray:
    """Convert rows of the compiled loops to rows of `Record`, in place; `mobile` needs the source u (V) for charge."""
    shown = problem.scene.shown
    n = int(shown.turn.size)
    rows[:, :n] *= shown.turn
    if problem.charge and model.mobile:
        (cell,), network = shown.measured, shown.network
        u_gap = np.einsum("tk,k->t", rows[:, :n], network.p[cell]) + network.q[cell, 0] * u
        rows[:, n] += u / inverse_areas(u_gap, model.curve) / model.s - problem.inner.offset
    return rows


def scale_of(problem: Problem, peak: float) -> float:
    """Largest gap voltage to expect under a source with this peak, V."""
    start = problem.inner
    share = peak * model_of(problem.scene).k_gap if np.isfinite(peak) else 0.0
    return max(share, float(np.abs(start.y[:-1]).max(initial=0.0))) or 1.0
