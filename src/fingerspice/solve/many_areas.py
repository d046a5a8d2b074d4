"""One integration of a network by exponential steps, as `loop` takes it; its modes at reference areas.

A run whose areas change by much goes from one reference to another, so that the areas stay near those of the modes.
"""

from __future__ import annotations

import math
import threading
from typing import Any

import numpy as np

from fingerspice.base.arrays import FloatArray, IntArray, views_of
from fingerspice.circuit.network import network_modes
from fingerspice.engine.collocation import readout
from fingerspice.engine.collocation.exponential import new_tables
from fingerspice.engine.collocation.loop import Looks, no_looks
from fingerspice.engine.many_areas.form import REFERRED, Form, new_network_work
from fingerspice.engine.many_areas.step import ManyAreas, References
from fingerspice.engine.network import Sources
from fingerspice.engine.one_area.system import LEVEL_RATIO, area_error, area_missed, area_polynomials
from fingerspice.numerics.lobatto import integral_table
from fingerspice.results.outcome import Status
from fingerspice.solve.problem import Problem, ramp
from fingerspice.solve.scenes import Scene, kept_with
from fingerspice.solve.stepping import Stepping

# Number of sets of references cached with a scene: one for each thread and decade of tolerances.
MOST_SETS = 16
# Most references in a set, and most numbers in all of them (64 MB); a full set is replaced by a new one.
MOST_REFERENCES, MOST_NUMBERS = 256, 8_000_000
# Number of references cached with the network, for runs with other sources.
MOST_KEPT = 16


class Known:
    """The references of a scene that one thread has needed so far, and the step tables for them.

    The first has the areas at 0 V. The scene, with which this is cached, is not an attribute: two objects that hold
    each other are freed by garbage collection only.
    """

    def __init__(self, scene: Scene, decade: int) -> None:
        numbers, magnified, self.shapes = _referred(scene, scene.area0)
        n_area = scene.area0.size
        counts = np.zeros(1, np.int64), np.zeros(n_area, np.int64)
        self.arrays = References(np.zeros((2, n_area), np.int64), np.zeros((2, numbers.size)), *counts)
        self.tables = new_tables(self.shapes[0][0])
        # (n_area + 1,): Round-off of each gap's voltage, and last of the nodes' voltages, relative to the rounding of
        # the largest voltage; the maximum over all references
        self.magnified = np.zeros(magnified.size)
        self.fixed = _fixed(scene, decade)  # The fields of a `Form` that are the same for all references
        self.add(scene, (0,) * n_area)

    @property
    def count(self) -> int:
        return int(self.arrays.used[0])

    def add(self, scene: Scene, levels: tuple[int, ...]) -> None:
        """Add the reference whose areas are the scene's areas (fixed, or at 0 V) times LEVEL_RATIO to these powers."""
        arrays, one = self.arrays, self.count
        if one == len(arrays.levels):
            more = np.zeros_like(arrays.levels), np.zeros_like(arrays.numbers)
            self.arrays = arrays = arrays._replace(
                levels=np.vstack([arrays.levels, more[0]]), numbers=np.vstack([arrays.numbers, more[1]])
            )
        area = scene.area0 * LEVEL_RATIO ** np.array(levels, float)
        arrays.numbers[one], magnified, _ = _referred(scene, area)
        arrays.levels[one] = levels
        arrays.used[0] += 1
        np.maximum(self.magnified, magnified, out=self.magnified)

    def form(self) -> Form:
        """A form for the areas at 0 V, with its own copy of the numbers: compiled code overwrites them."""
        numbers, views = views_of(self.shapes)
        numbers[:] = self.arrays.numbers[0]
        parts: dict[str, Any] = dict(zip(REFERRED, views, strict=True))
        return Form(numbers=numbers, **parts, **self.fixed)


def known_references(scene: Scene, decade: int, *, anew: bool = False) -> Known:
    """The references of a scene for tolerances of a decade."""
    # Each thread has its own set, because compiled code writes into the tables.
    key = ("references", decade, threading.get_ident())
    if anew:
        scene.prepared.pop(key, None)
    return kept_with(scene.prepared, key, MOST_SETS, lambda: Known(scene, decade))


def _fed(scene: Scene) -> IntArray:
    """Indices of the cells whose area follows a gap, sorted by area."""
    net = scene.net
    fed = np.flatnonzero([i >= 0 and net.gap[i] >= 0 for i in net.place])
    return fed[np.argsort(net.place[fed], kind="stable")]


def _fixed(scene: Scene, decade: int) -> dict[str, Any]:
    """The fields of a form that are the same for all references."""
    network, net = scene.network, scene.net
    n, n_area = net.k.shape[0], net.gap.size
    slow, fed = net.slow >= 0, _fed(scene)
    stress = np.zeros(n_area)
    for i in network.fingers:
        contact = network.contacts[i]
        assert contact is not None
        stress[i] = float(contact.stress(1.0))
    powers, slopes, lo, scale = area_polynomials(net.curves, net.gap >= 0, area_error(decade))
    return {
        "mobile": net.mobile,
        "c": net.c[fed],
        "g": net.g_area[fed],
        "home": net.place[fed],
        "first": np.searchsorted(net.place[fed], np.arange(n_area + 1)),
        "cell": np.array([int(np.flatnonzero(fed == i)[0]) if i >= 0 else -1 for i in net.gap], np.int64),
        "unit": scene.area0.copy(),
        "slow": np.where(slow, n + net.slow, -1),
        "pace": np.where(slow, 1.0 / np.where(slow, net.tau, 1.0), 0.0),
        "stress": stress,
        "powers": powers,
        "slopes": slopes,
        "lo": lo,
        "scale": scale,
        "curves": net.curves,
        "through": np.ascontiguousarray(network.through[:, fed]),
    }


def _referred(scene: Scene, area: FloatArray) -> tuple[FloatArray, FloatArray, list[tuple[int, ...]]]:
    """The arrays in `REFERRED` for reference areas (m^2) in one row, the round-off as in `Known`, and their shapes."""
    key = ("referred", scene.fixed, area.tobytes())
    return kept_with(scene.network.kept, key, MOST_KEPT, lambda: _refer(scene, area))


def _refer(scene: Scene, area: FloatArray) -> tuple[FloatArray, FloatArray, list[tuple[int, ...]]]:
    network, net = scene.network, scene.net
    modes = network_modes(network, area)
    n, n_s = modes.gains.shape
    slow, fed = net.slow >= 0, _fed(scene)
    n_slow = int(np.count_nonzero(slow))
    tap, tap_s = network.p @ modes.shape, network.q - network.p @ modes.follow
    gap, gap_s = np.zeros((area.size, n)), np.zeros((area.size, n_s))
    for i in network.fingers:
        cell = network.gaps[i]
        assert cell is not None
        gap[i], gap_s[i] = tap[cell], tap_s[cell]
    capacitance, leak = network.capacitance(area)[:, None], network.leak(area)[:, None]
    node = network.nodes[:, :n] @ modes.shape
    node_s = network.nodes[:, n : n + n_s] - network.nodes[:, :n] @ modes.follow
    at_x, at_s = network.delivered[:, :n], network.delivered[:, n:]
    parts = {
        "rates": np.append(modes.rates, 1.0 / net.tau[slow]),
        "gain": np.vstack([modes.gains, np.zeros((n_slow, n_s))]),
        "shape": modes.shape,
        "inverse": modes.inverse,
        "follow": modes.follow,
        "feed": np.vstack([-modes.take[:, fed], np.zeros((n_slow, fed.size))]),
        "tap": tap[fed],
        "tap_s": tap_s[fed],
        "area0": area,
        "gap": gap,
        "gap_s": gap_s,
        "node": node,
        "node_s": node_s,
        "size": np.linalg.norm(modes.shape, axis=0),
        "stored": network.through @ (capacitance * tap),
        "stored_s": network.through @ (capacitance * tap_s),
        "lost": network.through @ (leak * tap) + at_x @ modes.shape,
        "lost_s": network.through @ (leak * tap_s) - at_x @ modes.follow + at_s,
    }
    live = modes.rates[modes.rates > 0.0]
    # The eigenvectors of the slowest mode contain the round-off of the fastest one.
    spread = math.sqrt(float(live.max() / live.min())) if live.size else 0.0
    inverse = np.abs(modes.inverse)
    every = (np.abs(modes.shape) @ inverse).sum(axis=1).max(initial=1.0)
    # A voltage is a sum over modes and sources: the sum of the moduli of its terms measures the cancellation.
    of_gaps, of_nodes = (
        (np.abs(by_mode) @ inverse).sum(axis=1) + np.abs(by_source).sum(axis=1)
        for by_mode, by_source in ((gap, gap_s), (node, node_s))
    )
    own = np.append(of_gaps, of_nodes.max(initial=0.0))
    magnified = np.asarray((every + spread) * np.minimum(own / every, 1.0))
    numbers = np.concatenate([parts[name].ravel() for name in REFERRED])
    return numbers, magnified, [parts[name].shape for name in REFERRED]


# Most steps for each edge and each shortest time of the sources; a run that needs more is left to another method. Where
# an area strongly affects the charge of a stiff mode, the fixed-point iteration converges only with steps of the
# mode's own time constant.
MOST_STEPS = 100


class March(Stepping):
    """One integration in progress, with an error of at most `tol` times `u_scale` (V) in every step."""

    def __init__(self, problem: Problem, rtol: float, tol: float, u_scale: float, repeat: bool) -> None:
        scene, size = problem.scene, problem.initial.y.size
        n_s, n_area = len(scene.waveforms), scene.net.gap.size
        self.u_scale, self.decade = u_scale, int(np.floor(np.log10(rtol)))
        self.gaps, self.largest = list(scene.network.fingers), u_scale
        self.area_error = max((area_missed(curve, self.decade) for curve in scene.net.curves), default=0.0)
        self.capacitance = float(problem.network.capacitance(scene.area0).sum())
        super().__init__(problem, tol * u_scale, size - n_s, size + n_s if problem.charge else size)
        self.control["magnified"] = 1.0
        self.rows = self.out.T
        self.error = np.zeros(self.n + self.n_slow)
        self.branch = np.tile([problem.t_start, math.inf], (n_area, 1))
        self.shortest = problem.waveform.shortest_time()
        self.references = known_references(scene, self.decade)
        self.form = self.references.form()
        cells = self.form.c.size
        self.work = new_network_work(self.n, self.n + self.n_slow, cells, n_area, n_s, self.y.size + n_s)
        scale = np.append(np.ones(self.n), np.full(self.n_slow, u_scale))
        self.look_for_period(self.form.rates, scale, repeat)

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
            self.form, known.arrays, known.tables, self.work, integral_table(), sources, self.u_scale, self.sign,
            self.s_before, self.branch,
        )  # fmt: skip

    def march(self, sources: Sources, t_end: float, looks: Looks) -> int:
        taken = int(self.counters[readout.ACCEPTED] + self.counters[readout.REJECTED])
        more = MOST_STEPS * (4.0 + sources.edges.size + (t_end - self.t) / self.shortest)
        self.step[0]["most"] = taken + int(more)
        while (code := super().march(sources, t_end, looks)) == readout.REFERENCE:
            self._add_reference()
        return code

    def _failed(self, code: int, sources: Sources) -> Status:
        return Status.TOO_MANY_STEPS if code == readout.TOO_MANY else self.stuck()

    def jump(self, after: FloatArray) -> bool:
        # With sources that stay at these values.
        return self.march(ramp(after, after, self.t), self.t, no_looks()) == readout.DONE

    def _add_reference(self) -> None:
        """Add the reference areas that the compiled loop needs next, and that it has written to `wanted`."""
        known, at = self.references, self.work.at
        wanted = tuple(map(int, known.arrays.wanted))
        if known.count >= max(2, min(MOST_REFERENCES, MOST_NUMBERS // known.arrays.numbers.shape[1])):
            # Start a new set of references with the one in use; the tables and couplings of all others are dropped.
            levels = tuple(map(int, known.arrays.levels[at[0]]))
            self.references = known = known_references(self.problem.scene, self.decade, anew=True)
            if levels != (0,) * len(levels):
                known.add(self.problem.scene, levels)
            at[0] = known.count - 1
            self.work.own.keys[:] = self.work.own.key[:] = -1
        known.add(self.problem.scene, wanted)
