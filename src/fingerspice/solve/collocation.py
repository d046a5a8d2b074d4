"""Integration of stacks and networks by exponential steps, with smaller tolerances until the stated error is met.

`Track` and `March` are one integration of a stack and of a network, as `engine.collocation.loop` takes it. A network
has its modes at reference areas; a run whose areas change by much goes from one reference to another, so that the areas
stay near those of the modes.
"""

from __future__ import annotations

import math
import threading
from typing import Any, Literal

import numpy as np

from fingerspice.base.arrays import FloatArray, IntArray, views_of
from fingerspice.base.errors import InputError
from fingerspice.base.units import format_si
from fingerspice.circuit.network import Modes, Network
from fingerspice.engine.collocation import readout
from fingerspice.engine.collocation.exponential import Tables as StepTables
from fingerspice.engine.collocation.exponential import new_tables
from fingerspice.engine.collocation.loop import Looks, no_looks
from fingerspice.engine.collocation.step_control import enter
from fingerspice.engine.many_areas.form import REFERRED, Form, held, new_network_work
from fingerspice.engine.many_areas.step import ManyAreas, References
from fingerspice.engine.network import Sources, ramp
from fingerspice.engine.one_area import system as systems
from fingerspice.engine.one_area.model import Model, dot, gap_voltage
from fingerspice.engine.one_area.rows import Work, new_stack_work
from fingerspice.engine.one_area.step import OneArea
from fingerspice.engine.one_area.system import LEVEL_RATIO, System, area_error
from fingerspice.numerics.lobatto import integral_table
from fingerspice.physics.contact import LawContact, inverse_area_range, inverse_areas
from fingerspice.results.outcome import State, Status
from fingerspice.results.record import sided
from fingerspice.solve.problem import ROUNDING, Problem, Tables, values_at
from fingerspice.solve.runs import Progress, Run, excess_of, integrate
from fingerspice.solve.scenes import Scene
from fingerspice.solve.starting import as_shown, from_loop, model_of, to_loop
from fingerspice.solve.stepping import FINEST, LOCAL_SHARE, OutOfRangeError, Stepping

# Stated error of the charge over the estimate. It comes from a stack whose layers all leak fast: compared with a
# reference, the errors of gap voltage and charge were 1.5 times the estimates, because they peak between the points of
# the estimate; and from scene 7710 of tests/stress.py, whose area grows by a factor of 5e5 after every jump: 1.6 times.
CHARGE_SAFETY = 1.75
# Most references in a set, and most numbers in all of them (64 MB); a full set is replaced by a new one.
MOST_REFERENCES, MOST_NUMBERS = 256, 8_000_000
# Most steps for each edge and each shortest time of the sources; a run that needs more is left to another method: where
# an area strongly affects the charge of a stiff mode, only steps of the mode's own time constant converge.
MOST_STEPS = 100
ATTEMPTS = 6
GUESS = 1.0  # Voltage scale of a circuit whose sources give none, before any voltage has been computed, V


# Of the present thread, by number of modes: step tables, scratch arrays, and the system that the tables are of. Fresh
# arrays would cost a changed circuit some 50 us of its set-up, as the memory has to be mapped anew.
SCRATCH = threading.local()


def scratch_of(system: System) -> tuple[StepTables, Work]:
    """Tables and arrays for the next call of a compiled loop: another system's run may use them after that."""
    n = system.model.gap.size
    kept: dict[Any, tuple[StepTables, Work, System]] = vars(SCRATCH)
    tables, work, before = kept.get(n) or (new_tables(n), new_stack_work(n), None)
    if before is not system:
        kept[n] = tables, work, system
        tables.used[:] = 0
    return tables, work


def system_of(scene: Scene, decade: int, u_top: float = 0.0, ratio: float = LEVEL_RATIO, u_peak: float = 0.0) -> System:
    """The modal system of a scene for tolerances of a decade, with neighbouring reference areas in at most `ratio`.

    The area curve reaches `u_top` (V) and the reference areas `u_peak` (V) if these are above 0.
    """
    model, (contact,) = model_of(scene), scene.network.contacts
    assert scene.network.stack is not None
    if u_top > 0.0 and contact is not None:
        model = model._replace(curve=contact.curve(u_top))
    stress = 0.0 if contact is None else float(contact.stress(1.0))
    u_max, n = u_peak or max(scene.u_peak, u_top), model.gap.size
    nodes = scene.network.nodes[:, : n + 1] * np.append(scene.turn, 1.0)
    u_range = inverse_area_range(min(u_max, float(model.curve[1])), 17, model.curve)
    grouping = scene.shown.turn[:, None] * scene.network.stack.grouping
    return systems.build_system(model, area_error(decade), u_range, grouping, nodes, stress, ratio)


class Track(Stepping):
    """One integration of a stack: the loop's state is that of `engine.one_area.model`.

    The error of the gap voltage is at most `tol` (V) in every step; its area's curve reaches `top` (V) if not 0.
    """

    def __init__(self, problem: Problem, rtol: float, tol: float, top: float = 0.0) -> None:
        scene = problem.scene
        self.decade = decade = int(np.floor(np.log10(rtol)))
        # Similar runs share a system: there is one for each decade of tolerances, of up to 1 MB.
        self.system = scene.remember(("system", decade, top), lambda: system_of(scene, decade, top))
        self.curves, model, shown = self.system.model.curve[None], self.system.model, scene.shown.turn.size
        self.rates, self.n_error = self.system.rates, problem.initial.y.size
        self.gaps, self.largest, self.charge_safety = [0], scene.u_size, CHARGE_SAFETY
        self.capacitance = float(model.slow[-3]) * model.area0  # Of the layer through which the charge is computed
        super().__init__(problem, tol, shown, shown + 2 if problem.charge else shown)

    def begin(self, initial: State, tol: float) -> None:
        super().begin(initial, tol)
        began = self.problem.inner if initial is self.problem.initial else to_loop(self.problem.scene, initial)
        (self.y[:], u_gap), self.control["u_before"] = began, initial.s_before[0]
        # The sign along the loop, where a run under `mobile` goes on from a branch.
        self.sign[0] *= float(self.system.model.mobile)
        if self.sign[0] != 0.0:
            self.control["u_gap"], self.sign[0] = u_gap, math.copysign(1.0, u_gap)

    @property
    def rounding(self) -> list[float]:
        # Of the nodes, the peak is that of the gap.
        peak, size = float(self.peaks[0, readout.PEAK_U]), self.problem.scene.u_size
        return [4e-16 * (peak + self.system.model.k_gap * size), 4e-16 * (peak + size)]

    def circuit(self, sources: Sources) -> OneArea:
        return OneArea(self.system, *scratch_of(self.system), integral_table(), sources)

    def failed(self, code: int, sources: Sources) -> Status:
        if code == readout.OUT_OF_RANGE:
            (contact,), u_top = self.problem.network.contacts, self.system.u_top
            if isinstance(contact, LawContact) and contact.curve(1.1 * u_top)[1] <= u_top:
                raise InputError(f"at {format_si(self.t, 's')} {contact.ends(u_top)}")
            raise OutOfRangeError(u_top)
        if self.t > sources.edges[0]:
            # The loop updates the source's value at edges and at `t_end` only: a failed call leaves an old value.
            (self.control["u_before"],), _ = values_at(sources, self.t, "left")
        return super().failed(code, sources)

    def state(self) -> State:
        model, before, u_gap = self.system.model, float(self.control["u_before"]), float(self.control["u_gap"])
        if model.mobile:
            u_gap = gap_at(model, self.y, before, float(self.sign[0]) or 1.0, u_gap)
        return from_loop(self.problem.scene, self.t, self.y, before, u_gap)

    def jump(self, after: FloatArray) -> bool:
        met = enter(self.system.model, self.pace.charge, float(after[0]), self.y, self.control, self.sign, self.branch)
        self.control["u_before"] = after[0]
        return bool(met)

    def completed(self) -> None:
        model, shown = self.system.model, self.problem.scene.shown
        if self.pace.charge and model.mobile:
            n_out, n, (cell,) = int(self.counters[readout.OUTPUT]), shown.turn.size, shown.measured
            columns, network = self.out[:, :n_out], shown.network
            u = sided(self.problem.network.waveform, self.t_out[:n_out], self.left[:n_out])
            u_gap = np.einsum("kt,k->t", columns[:n], network.p[cell]) + network.q[cell, 0] * u
            columns[n] += u / inverse_areas(u_gap, model.curve) / model.s

    def row(self, state: State, sources: Sources, side: Literal["left", "right"]) -> FloatArray:
        row = super().row(state, sources, side)
        row[np.isnan(row)] = 0.0  # Past a fold there is no current.
        return as_shown(self.problem.scene, row)[: len(self.out)]


def gap_at(model: Model, y: FloatArray, u: float, sign: float, last: float) -> float:
    """Gap voltage (V) at a state under a source of u (V), on the branch with this sign and near its `last` value."""
    found = float(gap_voltage(model, model.k_gap * u, dot(model.gap, y), sign, last))
    # At a fold, the round-off of the time alone may leave the area equation without a solution: keep the last one.
    return last if math.isnan(found) else found


class Known:
    """The references of a scene that one thread has needed so far, and the step tables for them.

    The first has the areas at 0 V. The scene, with which this is cached, is not an attribute: two objects that hold
    each other are freed by garbage collection only.
    """

    def __init__(self, scene: Scene, decade: int) -> None:
        n_area, (numbers, magnified, self.shapes) = scene.net.area0.size, self._referred(scene, scene.net.area0)
        counts = np.zeros(1, np.int64), np.zeros(n_area, np.int64)
        room = max(3, min(MOST_REFERENCES, MOST_NUMBERS // numbers.size))
        # Memory that no reference has been written to yet costs nothing.
        self.arrays = References(np.empty((room, n_area), np.int64), np.empty((room, numbers.size)), *counts)
        self.tables = new_tables(self.shapes[0][0])
        # (n_area + 1,): Round-off of each gap's voltage, and last of the nodes' voltages, relative to the rounding of
        # the largest voltage; the maximum over all references
        self.magnified = np.zeros(magnified.size)
        network, net, n = scene.network, scene.net, scene.net.k.shape[0]
        slow, fed = net.slow >= 0, _fed(scene)
        cell = [int(np.flatnonzero(fed == i)[0]) if i >= 0 else -1 for i in net.gap]
        stress = np.array([0.0 if contact is None else float(contact.stress(1.0)) for contact in network.contacts])
        powers, slopes, lo, scale = systems.area_polynomials(net.curves, net.gap >= 0, area_error(decade))
        # The fields of a `Form` that are the same for all references
        self.fixed: dict[str, Any] = {
            "mobile": net.mobile, "c": net.c[fed], "g": net.g_area[fed], "home": net.place[fed],
            "first": np.searchsorted(net.place[fed], np.arange(n_area + 1)), "cell": np.array(cell, np.int64),
            "unit": scene.net.area0.copy(), "slow": np.where(slow, n + net.slow, -1),
            "pace": np.where(slow, 1.0 / np.where(slow, net.tau, 1.0), 0.0), "stress": stress,
            "powers": powers, "slopes": slopes, "lo": lo, "scale": scale, "curves": net.curves,
            "through": np.ascontiguousarray(network.through[:, fed]),
        }  # fmt: skip
        self.add(scene, (0,) * n_area)

    def add(self, scene: Scene, levels: tuple[int, ...]) -> None:
        """Add the reference whose areas are the scene's areas (fixed, or at 0 V) times LEVEL_RATIO to these powers."""
        arrays, one = self.arrays, int(self.arrays.used[0])
        area = scene.net.area0 * LEVEL_RATIO ** np.array(levels, float)
        arrays.numbers[one], magnified, _ = self._referred(scene, area)
        arrays.levels[one] = levels
        arrays.used[0] += 1
        np.maximum(self.magnified, magnified, out=self.magnified)

    @staticmethod
    def _referred(scene: Scene, area: FloatArray) -> tuple[FloatArray, FloatArray, list[tuple[int, ...]]]:
        key = ("referred", scene.fixed, area.tobytes())
        return scene.network.remember(key, lambda: _refer(scene, area))

    def form(self) -> Form:
        """A form for the areas at 0 V, with its own copy of the numbers: compiled code overwrites them."""
        numbers, views = views_of(self.shapes)
        numbers[:] = self.arrays.numbers[0]
        parts: dict[str, Any] = dict(zip(REFERRED, views, strict=True))
        return Form(numbers=numbers, **parts, **self.fixed)


def _fed(scene: Scene) -> IntArray:
    """Indices of the cells whose area follows a gap, sorted by area."""
    net = scene.net
    fed = np.flatnonzero([i >= 0 and net.gap[i] >= 0 for i in net.place])
    return fed[np.argsort(net.place[fed], kind="stable")]


def by_modes(network: Network, modes: Modes, area: FloatArray) -> dict[str, FloatArray]:
    """What the modes at these areas, and the sources, do: arrays with the names in `Form`, the taps of all cells."""
    n, n_s = modes.gains.shape
    tap, tap_s = network.p @ modes.shape, network.q - network.p @ modes.follow
    capacitance, leak = network.capacitance(area)[:, None], network.leak(area)[:, None]
    at_x, at_s = network.delivered[:, :n], network.delivered[:, n:]
    return {
        "tap": tap, "tap_s": tap_s, "node": network.nodes[:, :n] @ modes.shape,
        "node_s": network.nodes[:, n : n + n_s] - network.nodes[:, :n] @ modes.follow,
        "stored": network.through @ (capacitance * tap), "stored_s": network.through @ (capacitance * tap_s),
        "lost": network.through @ (leak * tap) + at_x @ modes.shape,
        "lost_s": network.through @ (leak * tap_s) - at_x @ modes.follow + at_s,
    }  # fmt: skip


def _refer(scene: Scene, area: FloatArray) -> tuple[FloatArray, FloatArray, list[tuple[int, ...]]]:
    """The arrays in `REFERRED` for reference areas (m^2) in one row, the round-off as in `Known`, and their shapes."""
    network, net = scene.network, scene.net
    modes = scene.modes_at(area) if area is not scene.net.area0 else scene.modes
    n, n_s = modes.gains.shape
    slow, fed, fingers = net.slow >= 0, _fed(scene), list(network.fingers)
    n_slow, cells = int(np.count_nonzero(slow)), np.array(network.finger_cells, int)
    parts = by_modes(network, modes, area)
    tap, tap_s = parts["tap"], parts["tap_s"]
    gap, gap_s = np.zeros((area.size, n)), np.zeros((area.size, n_s))
    gap[fingers], gap_s[fingers] = tap[cells], tap_s[cells]
    parts |= {
        "rates": np.append(modes.rates, 1.0 / net.tau[slow]), "gain": np.vstack([modes.gains, np.zeros((n_slow, n_s))]),
        "shape": modes.shape, "inverse": modes.inverse, "follow": modes.follow, "tap": tap[fed], "tap_s": tap_s[fed],
        "feed": np.vstack([-modes.take[:, fed], np.zeros((n_slow, fed.size))]), "area0": area,
        "gap": gap, "gap_s": gap_s, "size": np.linalg.norm(modes.shape, axis=0),
    }  # fmt: skip
    live = modes.rates[modes.rates > 0.0]
    # The eigenvectors of the slowest mode contain the round-off of the fastest one.
    spread = math.sqrt(float(live.max() / live.min())) if live.size else 0.0
    inverse = np.abs(modes.inverse)
    every = (np.abs(modes.shape) @ inverse).sum(axis=1).max(initial=1.0)
    # A voltage is a sum over modes and sources: the sum of the moduli of its terms measures the cancellation.
    of_gaps, of_nodes = (
        (np.abs(parts[name]) @ inverse).sum(axis=1) + np.abs(parts[f"{name}_s"]).sum(axis=1) for name in ("gap", "node")
    )
    own = np.append(of_gaps, of_nodes.max(initial=0.0))
    magnified = np.asarray((every + spread) * np.minimum(own / every, 1.0))
    numbers = np.concatenate([parts[name].ravel() for name in REFERRED])
    return numbers, magnified, [parts[name].shape for name in REFERRED]


class March(Stepping):
    """One integration of a network, with an error of at most `tol` times `u_scale` (V) in every step."""

    def __init__(self, problem: Problem, rtol: float, tol: float, u_scale: float) -> None:
        scene, size = problem.scene, problem.initial.y.size
        n_s, n_area = len(scene.network.waveforms), scene.net.gap.size
        self.u_scale, self.decade = u_scale, int(np.floor(np.log10(rtol)))
        self.gaps, self.largest, self.curves = list(scene.network.fingers), u_scale, scene.net.curves
        self.capacitance = float(problem.network.capacitance(scene.net.area0).sum())
        self.n_error = size - n_s
        super().__init__(problem, tol * u_scale, size - n_s, size + n_s if problem.charge else size)
        self.shortest = problem.network.waveform.shortest_time()
        # Each thread has its own set, because compiled code writes into the tables.
        key = ("references", self.decade, threading.get_ident())
        self.references = scene.remember(key, lambda: Known(scene, self.decade))
        self.form = self.references.form()
        self.rates, self.held, cells = self.form.rates, held(self.form), self.form.c.size
        self.work = new_network_work(self.n, self.n + self.n_slow, cells, n_area, n_s, self.y.size + n_s)

    @property
    def rounding(self) -> list[float]:
        u_peak = self.peaks[:, readout.PEAK_U]
        # Enlarged by the condition of the modes.
        floor = 4e-16 * (self.references.magnified * (float(u_peak.max()) + self.u_scale) + u_peak)
        return list(map(float, floor))

    @property
    def margin(self) -> float:
        return 1.0 / float(self.control["magnified"])

    def circuit(self, sources: Sources) -> ManyAreas:
        known = self.references
        return ManyAreas(
            self.form, self.held, known.arrays, known.tables, self.work, integral_table(), sources, self.u_scale,
            self.s_before,
        )  # fmt: skip

    def march(self, sources: Sources, t_end: float, looks: Looks) -> int:
        taken = int(self.counters[readout.ACCEPTED] + self.counters[readout.REJECTED])
        # A deck's TMAX asks for steps of its own.
        more = MOST_STEPS * (4.0 + sources.edges.size + (t_end - self.t) / self.shortest)
        more += 2.0 * (t_end - self.t) / self.longest
        self.step[0]["most"] = taken + int(more)
        while (code := super().march(sources, t_end, looks)) == readout.REFERENCE:
            # Add the reference areas that the compiled loop needs next, and that it has written to `wanted`.
            scene, known, at = self.problem.scene, self.references, self.work.at
            wanted = tuple(map(int, known.arrays.wanted))
            if known.arrays.used[0] == len(known.arrays.levels):
                # Start the set anew with the reference in use; the tables and couplings of all others are dropped.
                levels = tuple(map(int, known.arrays.levels[at[0]]))
                known.arrays.used[0], known.tables.used[:] = 1, 0
                if any(levels):
                    known.add(scene, levels)
                at[0] = known.arrays.used[0] - 1
                self.work.own.keys[:] = self.work.own.key[:] = -1
            known.add(scene, wanted)
        return code

    def jump(self, after: FloatArray) -> bool:
        # With sources that stay at these values.
        return self.march(ramp(after, after, self.t), self.t, no_looks()) == readout.DONE


def stepping(problem: Problem, rtol: float, tol: float, u_scale: float, top: float) -> Track | March:
    """An integration with an error of `tol` times `u_scale` (V) in every step; for `top` see `Track`."""
    if problem.network.stack is None:
        return March(problem, rtol, tol, u_scale)
    return Track(problem, rtol, tol * u_scale, top)


def solve(problem: Problem, rtol: float, progress: Progress | None = None, *, repeat: bool = True) -> Run:
    """Integrate until the stated error is within `rtol` of the peaks of every gap's voltage and force.

    The tolerance of the first attempt is a guess; each further one follows from the previous attempt's stated error.
    With `repeat`, later periods may repeat one period, once the state no longer changes from one to the next.
    """
    tables = Tables(problem, LOCAL_SHARE * rtol)
    is_stack, met, wave = problem.network.stack is not None, 0.0, problem.network.waveform
    if wave.is_sampled:
        # Also between the samples that a scene knows.
        voltages = (table for window in tables for table in window[: problem.network.n_voltage])
        met = max((table.scale for table in voltages), default=0.0) or problem.scene.u_peak
    elif is_stack:
        met = problem.scene.u_peak or wave.peak(problem.t_start, problem.t_stop)
    if is_stack:
        # The largest gap voltage to expect.
        u_scale = max(met * model_of(problem.scene).k_gap if met < math.inf else 0.0, problem.stored) or GUESS
    else:
        u_scale = max(problem.largest, met) or GUESS
    tol, top, nfev, attempts, tries_out = LOCAL_SHARE * rtol, 0.0, 0, 0, True
    # What is left of sources that cancel has fewer digits than these; what a gap takes of a source has as many as that.
    finest = FINEST * max(1.0, problem.scene.u_size / (met or u_scale))
    while True:
        one = stepping(problem, rtol, max(tol, finest), u_scale, top)
        one.look(rtol if tries_out else math.inf, repeat)
        try:
            run = integrate(one, tables, progress)
        except OutOfRangeError as error:
            top = 1.5 * error.args[0]
            continue
        run.by_layer = True
        run.end_where_it_stopped()
        run.nfev = nfev = nfev + run.nfev
        one.stated(run)
        attempts += 1
        worst = excess_of(run.gaps, problem.rounding) / rtol
        # An early judgement that predicts too large an error stops the run, with ERROR_NOT_MET.
        is_whole = run.status is not Status.ERROR_NOT_MET
        if is_whole and (run.status is not Status.SUCCESS or worst <= 1.0):
            return run
        peak = float(run.gaps[:, 0].max(initial=0.0))
        # A peak smaller than its own error may still vanish with a finer tolerance, so that case is not hopeless.
        hopeless = rtol * peak < ROUNDING / FINEST * finest * u_scale and run.error.u_gap < peak
        if hopeless or tol <= finest or attempts >= ATTEMPTS:
            if is_whole:
                run.status = Status.ERROR_NOT_MET
                return run
            tries_out = False
            continue
        finer = tol * min(0.3, 0.5 / worst)
        # If edges or zeros kept the steps short, their error is below `tol`, and only a tolerance below that error
        # shortens them. Not for a network: this could lead below the error of its areas' polynomials, made for `rtol`.
        tol = min(finer, 0.5 / worst * run.error.u_gap / u_scale) if is_stack else finer
