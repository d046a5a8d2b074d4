"""A network made ready to integrate: its numbers, its sources, how it starts. What `problem` is for a series stack."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from fingerspice.base.errors import InputError
from fingerspice.circuit.circuit import CHARGE_LAWS, Circuit
from fingerspice.circuit.network import Modes, Network, build_network, network_modes
from fingerspice.circuit.response import mean_network_areas
from fingerspice.engine.network import Net
from fingerspice.physics.contact import inverse_area
from fingerspice.results.network_record import NetworkRecord
from fingerspice.results.outcome import NetworkState
from fingerspice.results.solution import Solution
from fingerspice.solve.starting import (
    ROUNDING,
    at_own_area,
    operating_point,
    settle,
    start_voltages,
    starts_uncharged,
)
from fingerspice.solve.times import run_times
from fingerspice.waveforms.combinations import Sum
from fingerspice.waveforms.sampling import is_sampled, on_breakpoint
from fingerspice.waveforms.waveform import Fundamental, Waveform, require

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
    """What a solver of networks needs; attributes as in `problem.Problem`.

    `begun` has what the start is off, as its effect on every gap's voltage and force (n_gap, 2), V and N: of a periodic
    state that was found to half of the error asked for. The run has the other half.
    """

    circuit: Circuit
    scene: NetworkScene
    t_start: float
    t_stop: float
    first: float
    step: float
    initial: NetworkState
    charge: bool = True
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
    """A curve as long as the others'."""
    return np.pad(curve, (0, width - curve.size))


def _initial(circuit: Circuit, scene: NetworkScene, start: str | Solution) -> NetworkState:
    """State just before the start."""
    network = scene.network
    size = sum(network.b.shape) + int(np.count_nonzero(scene.net.slow >= 0))
    if isinstance(start, Solution):
        state = start.state
        alike = isinstance(state, NetworkState) and state.y.size == size and start.layers == tuple(
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
    if start == "uncharged" or (start == "deck" and starts_uncharged(circuit)):
        u, area, s = _given(circuit, scene, start == "deck")
    else:
        u, area, s = _at_rest(circuit, scene, circuit.initial if start == "deck" else {})
    return _state(scene, u, area, s)


def _given(circuit: Circuit, scene: NetworkScene, asked: bool) -> tuple[FloatArray, FloatArray, FloatArray | None]:
    """Cell voltages (V) and areas (m^2) that a start with ``uic`` gives; None for the sources: their own at 0+.

    Areas are NaN where they follow, or start at rest.
    """
    network = scene.network
    area = np.full(len(network.areas), np.nan)
    if not asked:
        return np.zeros(len(network.cells)), area, None
    for i, one in enumerate(network.areas):
        if scene.net.slow[i] >= 0:
            area[i] = 1e-6 * circuit.initial.get(one.node, math.nan)
    cells = network.cells
    return start_voltages([c.element for c in cells], scene.net.c, circuit.initial), area, None


def _at_rest(
    circuit: Circuit, scene: NetworkScene, initial: Mapping[str, float]
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Cell voltages (V), areas (m^2) and sources of the operating point, the nodes in `initial` held."""
    network, net = scene.network, scene.net
    contacts = [c if gap >= 0 else None for c, gap in zip(network.contacts, net.gap, strict=True)]
    point = operating_point(circuit, network, scene.area0, contacts, initial)
    u = point.u.copy()
    if net.mobile:
        for i in np.flatnonzero(point.held & (net.slow < 0)):
            # Let go, the area goes its own way, and the charge stays.
            gap = net.gap[i]
            own = at_own_area(float(u[gap]), point.area[i], net.curves[i])
            rest = 1.0 / inverse_area(abs(own), net.curves[i])[0]
            u[net.place == i] *= point.area[i] / rest
            u[gap] = own
    return u, point.area, np.array([float(w.value(0.0, "left")) for w in scene.waveforms])


def _state(scene: NetworkScene, u: FloatArray, area: FloatArray, s: FloatArray | None) -> NetworkState:
    """State just before the start of cells that hold `u` (n_cell,) V, with the sources at `s` or else at what fits."""
    network, net = scene.network, scene.net
    slow = (area / net.area0)[net.slow >= 0]
    after = np.array([float(w.value(0.0)) for w in scene.waveforms])
    # A run of a source that is not finite says so itself.
    after[~np.isfinite(after)] = 0.0
    x, charge = u[list(network.live)], np.zeros(after.size)
    before = _fitting(network, u - network.p @ x) if s is None else s
    off = float(np.abs(u - network.p @ x - network.q @ before).max(initial=0.0))
    if off > ROUNDING * float(np.abs(u).max(initial=0.0)):
        before = after if s is None else s
        settled = settle(net, u, slow, before)
        x, slow, charge = settled.x, settled.slow, settled.charge
    elif np.any(np.isnan(slow)):
        # Areas with dynamics of their own start where they rest after the sources' first jump.
        slow = settle(net, u, slow, after).slow
    return NetworkState(0.0, np.concatenate([x, slow, charge]), before, np.zeros(len(network.areas)))


def _fitting(network: Network, u: FloatArray) -> FloatArray:
    """Values of the sources that leave the cells `u` (n_cell,) V, as nearly as they can."""
    if not network.q.size:
        return np.zeros(network.q.shape[1])
    return np.asarray(np.linalg.lstsq(network.q, u, rcond=None)[0], float)
