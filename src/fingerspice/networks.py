"""A network made ready to integrate: its numbers, its sources, how it starts. What `problem` is for a series stack."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from fingerspice.circuit.circuit import CHARGE_LAWS, Circuit
from fingerspice.circuit.combinations import Sum
from fingerspice.circuit.network import Modes, Network, build_network, network_modes
from fingerspice.circuit.sampling import is_sampled, on_breakpoint
from fingerspice.circuit.waveforms import Fundamental, Waveform, require
from fingerspice.engine.network import Net
from fingerspice.errors import InputError
from fingerspice.network_record import NetworkRecord
from fingerspice.outcome import NetworkState
from fingerspice.phasors import mean_network_areas
from fingerspice.physics.contact import N_PACKED
from fingerspice.solution import Solution
from fingerspice.times import run_times

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
# A current source may put any voltage across a gap; the curves of the areas reach this far (V), then the long way.
DRIVEN_BY_CURRENT = 300.0


@dataclass(frozen=True, eq=False)
class NetworkScene:
    """A network under one charge law and area mode, as numbers; kept with the circuit from run to run.

    Attributes
    ----------
    network : Network
    net : Net
    charge_law, area_mode : str
    fixed : tuple of float or None
        Each area where it is fixed, m^2.
    u_peak : float
        Sum of the largest |U| of the voltage sources, V.
    prepared : dict
        What integrators made ready for this scene.
    """

    network: Network
    net: Net
    charge_law: str
    area_mode: str
    fixed: tuple[float | None, ...]
    u_peak: float
    prepared: dict[Any, Any] = field(default_factory=dict)

    @cached_property
    def waveforms(self) -> tuple[Waveform, ...]:
        """Of each source, V or A."""
        waves = [e.waveform for e in self.network.sources]
        return tuple(w for w in waves if w is not None)

    @cached_property
    def waveform(self) -> Waveform:
        """All sources at once, for their common period, breakpoints and shortest time."""
        return self.waveforms[0] if len(self.waveforms) == 1 else Sum(self.waveforms)

    @cached_property
    def fundamental(self) -> Fundamental | None:
        """The source's, where there is only one."""
        return self.waveform.fundamental if len(self.waveforms) == 1 else None

    @property
    def is_sampled(self) -> bool:
        """Whether some source is a function that has to be looked at."""
        return any(is_sampled(w) for w in self.waveforms)

    @property
    def coupled(self) -> bool:
        """Whether some area follows its gap's voltage."""
        return any(area is None for area in self.fixed)

    @cached_property
    def modes(self) -> Modes:
        """Of the network with its areas fixed, or as they are at 0 V."""
        return network_modes(self.network, self.area0)

    @cached_property
    def area0(self) -> FloatArray:
        """The areas where they are fixed, else at 0 V, m^2."""
        return np.asarray(self.net.area0)


class Outputs(Protocol):
    """Times (n_t,), which of them are left-hand, and rows of the state."""

    t: FloatArray
    left: BoolArray
    rows: FloatArray


@dataclass(frozen=True)
class NetworkProblem:
    """What a solver of networks needs; attributes as in `problem.Problem`."""

    circuit: Circuit
    scene: NetworkScene
    t_start: float
    t_stop: float
    first: float
    step: float
    initial: NetworkState
    charge: bool = True

    @property
    def network(self) -> Network:
        return self.scene.network

    @property
    def waveform(self) -> Waveform:
        return self.scene.waveform

    @property
    def waveforms(self) -> tuple[Waveform, ...]:
        return self.scene.waveforms

    def record(self, run: Outputs) -> NetworkRecord:
        """The outputs of a run with what they mean."""
        scene = self.scene
        return NetworkRecord(
            scene.network, scene.net, scene.waveforms, run.t.copy(), run.left.copy(), run.rows.copy(), self.charge
        )

    def breakpoints(self) -> FloatArray:
        """The sources' breakpoints in the run, s."""
        return self.waveform.breakpoints(self.t_start, self.t_stop)

    @property
    def max_step(self) -> float:
        """Longest step (s) that the deck's .tran line allows."""
        tran = self.circuit.tran
        return math.inf if tran is None or tran.max_step is None else tran.max_step


def prepare_network(
    circuit: Circuit,
    *,
    t_stop: float | None,
    t_eval: FloatArray | None,
    charge_law: str | None,
    area: str | float,
    start: str | Solution,
    charge: bool,
) -> NetworkProblem:
    """Make a network ready, or refuse it.

    Raises
    ------
    InputError
        For anything in the request that cannot be run.
    """
    t_start = start.state.t if isinstance(start, Solution) else 0.0
    law = charge_law or circuit.charge_law or "local"
    require(law in CHARGE_LAWS, "charge_law", repr(law), " or ".join(map(repr, CHARGE_LAWS)))
    scene: NetworkScene = circuit.remember(
        ("network scene", law, area, t_stop), lambda: _scene(circuit, law, area, t_stop)
    )
    stop, step = run_times(circuit, t_start, t_stop, t_eval)
    stop = on_breakpoint(scene.waveform, stop)
    first = t_start + (circuit.tran.start if circuit.tran else 0.0)
    return NetworkProblem(circuit, scene, t_start, stop, first, step, _initial(circuit, scene, start), charge)


def _scene(circuit: Circuit, law: str, area: str | float, t_stop: float | None) -> NetworkScene:
    network = build_network(circuit)
    fixed, mode = _fixed_areas(circuit, network, area)
    stop = t_stop or (circuit.tran.stop if circuit.tran else 1.0)
    peak = 0.0
    for element in network.sources[: network.n_voltage]:
        assert element.waveform is not None
        largest = element.waveform.peak(0.0, stop) if math.isfinite(stop) and stop > 0.0 else 0.0
        peak += largest if math.isfinite(largest) else 0.0
    top = 1.3 * peak + (DRIVEN_BY_CURRENT if len(network.sources) > network.n_voltage else 0.0)
    return NetworkScene(network, _net(network, law, fixed, max(top, 1e-30)), law, mode, fixed, peak)


def _fixed_areas(circuit: Circuit, network: Network, area: str | float) -> tuple[tuple[float | None, ...], str]:
    """Each area (m^2) that does not follow its gap, and the mode's name."""
    given = [a.given for a in network.areas]
    if not isinstance(area, str):
        require(math.isfinite(area) and area > 0.0, "area", f"{area:g} m^2", "a positive area in m^2")
        return (float(area),) * len(given), f"{area:g} m^2"
    require(area in ("coupled", "mean", "frozen"), "area", repr(area), "'coupled', 'mean', 'frozen' or m^2")
    if not given:
        return (), "none"
    if all(x is not None for x in given):
        return tuple(given), "given by the deck"
    if area == "coupled":
        return tuple(given), area
    if area == "mean":
        return tuple(map(float, mean_network_areas(circuit, network))), area
    frozen = [
        float(c.area(0.0)) if c is not None and x is None else x for c, x in zip(network.contacts, given, strict=True)
    ]
    return tuple(frozen), area


def _net(network: Network, law: str, fixed: tuple[float | None, ...], u_top: float) -> Net:
    area0, tau, curves, gaps = [], [], [], []
    for x, contact, gap, area in zip(fixed, network.contacts, network.gaps, network.areas, strict=True):
        follows = x is None and contact is not None and gap is not None and area.gap is not None
        gaps.append(gap if follows else -1)
        area0.append(float(contact.area(0.0)) if follows and contact is not None else x)
        tau.append(area.gap.values["tau"] if follows and area.gap is not None else 0.0)
        curves.append(contact.curve(u_top) if follows and contact is not None else np.zeros(1))
    width = max((c.size for c in curves), default=1)
    slow, count = [], 0
    for t in tau:
        slow.append(count if t > 0.0 else -1)
        count += t > 0.0
    cells = network.cells
    return Net(
        mobile=law == "mobile",
        p=np.ascontiguousarray(network.p),
        q=np.ascontiguousarray(network.q),
        c=np.array([c.c for c in cells], float),
        g_total=np.array([c.g_total for c in cells], float),
        g_area=np.array([c.g_area for c in cells], float),
        place=np.array([-1 if c.area is None else c.area for c in cells], np.int64),
        k=np.ascontiguousarray(network.k),
        b=np.ascontiguousarray(network.b),
        through=np.ascontiguousarray(network.through),
        delivered=np.ascontiguousarray(network.delivered),
        gap=np.array(gaps, np.int64),
        area0=np.array(area0, float),
        tau=np.array(tau, float),
        slow=np.array(slow, np.int64),
        curves=np.array([_padded(c, width) for c in curves]).reshape(len(curves), width),
    )


def _padded(curve: FloatArray, width: int) -> FloatArray:
    """A curve as long as the others'; of one without a series no voltage is in reach."""
    out = np.pad(curve, (0, width - curve.size))
    if curve.size == 2 + N_PACKED:
        out[1] = -math.inf
    return out


def _initial(circuit: Circuit, scene: NetworkScene, start: str | Solution) -> NetworkState:
    """State just before the start; areas with dynamics of their own are NaN where they start at g(u(0+))."""
    network = scene.network
    n, n_s = network.b.shape
    n_slow = int(np.count_nonzero(scene.net.slow >= 0))
    if isinstance(start, Solution):
        state = start.state
        alike = isinstance(state, NetworkState) and state.y.size == n + n_slow + n_s and start.layers == tuple(
            e.name for e in network.layers
        )  # fmt: skip
        if not alike or start.charge_law != scene.charge_law:
            raise InputError(
                f"the solution to start from is another circuit's, or has the {start.charge_law} law; allowed: one of "
                f"this circuit under the {scene.charge_law} law"
            )
        assert isinstance(state, NetworkState)
        return state
    require(start in ("deck", "uncharged", "dc"), "start", repr(start), "'deck', 'uncharged', 'dc' or a Solution")
    given = {c.element.name: c.element.initial for c in network.cells if c.element.initial is not None}
    if start == "deck":
        uic = circuit.tran is None or circuit.tran.uic
        named = bool(circuit.initial) or (uic and bool(given))
        start = "given" if named else ("uncharged" if uic else "dc")
    y = np.concatenate([np.zeros(n), np.full(n_slow, np.nan), np.zeros(n_s)])
    s = np.zeros(n_s)
    if start == "given":
        y[:n], s = _given(circuit, network)
    elif start == "dc":
        s = np.array([float(w.value(0.0, "left")) for w in scene.waveforms])
        y[:n] = _operating_point(scene, s)
    return NetworkState(0.0, y, s, np.zeros(len(network.areas)))


def _given(circuit: Circuit, network: Network) -> tuple[FloatArray, FloatArray]:
    """Live voltages from ``.ic`` and ``IC=`` (nodes without: 0 V), and the sources' values that go with them."""
    known = {node for cell in network.cells for node in cell.element.nodes[:2]}
    u = np.zeros(len(network.cells))
    total: dict[str, float] = {}
    for cell in network.cells:
        total[cell.element.name] = total.get(cell.element.name, 0.0) + 1.0 / cell.c
    for node in circuit.initial:
        if node not in known:
            raise InputError(
                f".ic names node {node!r}, where no capacitor or layer ends: its voltage follows from others"
            )
    for i, cell in enumerate(network.cells):
        e = cell.element
        across = circuit.initial.get(e.nodes[0], 0.0) - circuit.initial.get(e.nodes[1], 0.0)
        if e.initial is not None and not circuit.initial:
            across = e.initial
        # The slabs of a dispersive layer share its voltage as in a jump.
        u[i] = across / cell.c / total[e.name]
    x = u[list(network.live)]
    s = np.linalg.lstsq(network.q, u - network.p @ x, rcond=None)[0] if network.q.size else np.zeros(network.q.shape[1])
    return np.asarray(x, float), np.asarray(s, float)


def _operating_point(scene: NetworkScene, s: FloatArray) -> FloatArray:
    """Live voltages of the DC operating point, the areas coupled.

    Raises
    ------
    InputError
        Where a node has no path for direct current, or the areas find no rest.
    """
    network = scene.network
    area = scene.area0.copy()
    for _ in range(200):
        k, b = network.stiffness(area)
        _refuse_floating_at_dc(network, area)
        x = np.linalg.solve(k, -b @ s) if k.size else np.zeros(0)
        u = network.p @ x + network.q @ s
        new = area.copy()
        for i in range(area.size):
            contact, gap = network.contacts[i], network.gaps[i]
            if scene.fixed[i] is None and contact is not None and gap is not None:
                new[i] = float(contact.area(abs(float(u[gap]))))
        if np.all(np.abs(new - area) <= 4e-16 * area):
            return np.asarray(x)
        # Halfway: a leak that scales with the area may make it swing.
        area = new if np.all(np.abs(new - area) <= 1e-3 * area) else 0.5 * (area + new)
    raise InputError("the areas find no DC operating point; allowed: uic in .tran, to start uncharged")


def _refuse_floating_at_dc(network: Network, area: FloatArray) -> None:
    """Voltages that only capacitors hold have no DC value."""
    factor = np.vstack([network.resistor_factor, np.sqrt(network.leak(area))[:, None] * network.p])
    if not factor.shape[1]:
        return
    # Columns of like size: conductances range over many decades.
    size = np.linalg.norm(factor, axis=0)
    _, sigma, turned = np.linalg.svd(factor / np.where(size > 0.0, size, 1.0))
    rank = int(np.count_nonzero(sigma > 1e-12 * max(1.0, sigma.max(initial=0.0))))
    if rank == factor.shape[1]:
        return
    held = np.abs(network.p @ turned[rank:].T).max(axis=1) > 1e-9
    names = dict.fromkeys(c.element.name for c, mark in zip(network.cells, held, strict=True) if mark)
    raise InputError(
        f"no DC operating point: {' and '.join(names)} leave nodes that are reached by capacitors only; allowed: a "
        "leakage (r=... or an R), or uic in .tran to start uncharged"
    )
