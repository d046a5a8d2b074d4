"""A run prepared for integration: its scene, start and end, output spacing and initial state."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from fingerspice.base.arrays import FloatArray
from fingerspice.circuit.arguments import area_given
from fingerspice.circuit.circuit import Circuit
from fingerspice.circuit.network import Network
from fingerspice.results.outcome import State
from fingerspice.results.solution import Solution
from fingerspice.solve.initial import initial_state
from fingerspice.solve.scenes import Scene, scene_of
from fingerspice.solve.stackstate import StackState, to_stack
from fingerspice.solve.times import run_times
from fingerspice.waveforms.sampling import on_breakpoint
from fingerspice.waveforms.waveform import Waveform

# Round-off of a gap voltage relative to the voltages that cancel in it; finer steps cannot reduce the error below that.
ROUNDING = 2e-14
# Largest number of breakpoints cached with a waveform (64 kB).
KEPT_BREAKPOINTS = 8192


@dataclass(frozen=True)
class Problem:
    """All data that an integrator needs."""

    circuit: Circuit
    scene: Scene
    # t_start, t_stop, first, step: Start and end of the run, first output and spacing of the outputs, s
    t_start: float
    t_stop: float
    first: float
    step: float
    initial: State
    charge: bool = True  # Whether charge and current are wanted
    start: str = "deck"  # How the run starts, as in `simulate`; ``"given"`` for the end of another run
    by_deck: bool = False  # Whether the run ends at the deck's own TSTOP
    # (n_gap, 2): Error of a periodic start, as its effect on every gap's voltage and force, V and N. The start was
    # computed with half of the error asked for; the other half is left to the run.
    begun: FloatArray | None = None

    @property
    def network(self) -> Network:
        return self.scene.network

    @property
    def waveform(self) -> Waveform:
        return self.scene.waveform

    @property
    def waveforms(self) -> tuple[Waveform, ...]:
        return self.scene.waveforms

    @cached_property
    def largest(self) -> float:
        """Larger one of the sources' peak and the largest live voltage of the start, V."""
        n = self.scene.network.k.shape[0]
        return max(self.scene.u_peak, float(np.abs(self.initial.y[:n]).max(initial=0.0)))

    @property
    def rounding(self) -> float:
        """Round-off of a gap's voltage, V: a smaller voltage is 0, and has no sign."""
        return ROUNDING * max(self.largest, self.scene.u_size)

    @cached_property
    def inner(self) -> StackState:
        """The start of a stack in the form of its own equations; the scene caches the last one."""
        state, inner = self.scene.prepared.get("inner", (None, None))
        if state is not self.initial:
            state, inner = self.scene.prepared["inner"] = self.initial, to_stack(self.scene, self.initial)
        assert isinstance(inner, StackState)
        return inner

    def breakpoints(self) -> FloatArray:
        """The sources' breakpoints in the run, s; the waveform caches them if they are few."""
        span = self.t_start, self.t_stop
        # Key and value are one entry, because another thread may replace it at any time.
        kept, edges = self.waveform.kept.get("breakpoints", (None, np.empty(0)))
        if kept != span:
            edges = self.waveform.breakpoints(*span)
            if edges.size <= KEPT_BREAKPOINTS:
                self.waveform.kept["breakpoints"] = span, edges
        return np.asarray(edges)

    @property
    def max_step(self) -> float:
        """Longest step (s) that the deck's .tran line allows."""
        tran = self.circuit.tran
        return math.inf if tran is None or tran.max_step is None else tran.max_step


def prepare(
    circuit: Circuit,
    *,
    t_stop: float | None,
    t_eval: FloatArray | None,
    charge_law: str | None,
    area: str | float,
    start: str | Solution,
    charge: bool = True,
    rtol: float = 0.0,
) -> Problem:
    """Prepare a run, or refuse it; `rtol` decides whether a dispersive skin's data may be taken at one frequency.

    Raises
    ------
    InputError
        For anything in the request that cannot be run.
    """
    t_start = start.state.t if isinstance(start, Solution) else 0.0
    scene = scene_of(circuit, charge_law, area_given(area), t_stop, rtol)
    stop, step = run_times(circuit, t_start, t_stop, t_eval)
    # Key and value are one entry, because another thread may replace it at any time.
    kept = scene.waveform.kept
    asked, ends = kept.get("end", (math.nan, math.nan))
    if asked != stop:
        asked, ends = kept["end"] = stop, on_breakpoint(scene.waveform, stop)
    first = t_start + (circuit.tran.start if circuit.tran else 0.0)
    how, initial = start if isinstance(start, str) else "given", initial_state(circuit, scene, start)
    by_deck = t_stop is None and circuit.tran is not None
    return Problem(circuit, scene, t_start, ends, first, step, initial, charge, how, by_deck)
