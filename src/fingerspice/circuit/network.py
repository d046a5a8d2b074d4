"""Reduced state space of any connected netlist, by modified nodal analysis on a normal tree.

The tree takes voltage sources first, then capacitors, then resistors. The voltages x of its capacitors are the live
states; with the sources' voltages s every capacitor has u = P x + Q s, and the voltages of the tree's resistors, which
depend algebraically on x and s, are eliminated. Kirchhoff's current law on the cuts of the tree's capacitors remains,

    P^T i + K x + B s = 0,    i the currents of all capacitors with their leaks, s with the current sources' currents.

The same law on the cuts of the voltage sources gives the currents that these deliver. Controlled sources and inductors
count as sources first, and are then eliminated (`controlled`): P^T becomes another matrix than that of the voltages,
and K is no longer symmetric.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache, partial
from itertools import count, pairwise
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from fingerspice.base.arrays import ComplexArray, FloatArray, Remembering
from fingerspice.base.errors import InputError
from fingerspice.circuit import statespace
from fingerspice.circuit.circuit import Circuit, Element
from fingerspice.circuit.controlled import Matrices, closed
from fingerspice.circuit.devices import PHASE_POLES, check
from fingerspice.circuit.statespace import Area, Stack, build_stack, contact_of, find_branches, shared
from fingerspice.circuit.switching import Course
from fingerspice.physics.contact import Contact
from fingerspice.physics.materials import EPS0, skin_permittivity, skin_resistivity
from fingerspice.physics.phasor import layer_gains, settled_areas
from fingerspice.waveforms.waveform import OFF, Sum, Waveform, refuse, require

_ROUNDING = 1e-13  # A current of a source that is this small, relative to what it is the difference of, is rounding.


class Cell(NamedTuple):
    """A capacitor with its parallel leak: a C, a layer, or one of the slabs of a dispersive layer."""

    element: Element
    nodes: tuple[str, str]
    area: int | None
    c: float  # Capacitance, F; with an area per area, F/m^2
    g_total: float
    g_area: float  # The leak is this times the area plus `g_total`


@dataclass(frozen=True)
class Network(Remembering):
    """A connected network of capacitors, resistors, sources and layers. SI throughout.

    n live states, one for each capacitor of the tree; n_s sources, voltage sources first.
    """

    sources: tuple[Element, ...]
    n_voltage: int  # Number of voltage sources among them
    cells: tuple[Cell, ...]
    layers: tuple[Element, ...]  # Elements whose capacitance scales with an area, in deck order
    live: tuple[int, ...]  # Index of the cell whose voltage is the live state, for each live state
    areas: tuple[Area, ...]
    contacts: tuple[Contact | None, ...]  # Contact of each area; None for an area without GAP
    gaps: tuple[int | None, ...]  # Index of the cell of each area's GAP
    # p (n_cell, n), q (n_cell, n_s): u = p x + q s
    p: FloatArray
    q: FloatArray
    cut: FloatArray  # (n_cell, n): The cells' currents enter the cuts by its transpose; p unless sources are controlled
    # k (n, n), b (n, n_s): Currents of resistors and current sources into the cuts of the live capacitors, S
    k: FloatArray
    b: FloatArray
    through: FloatArray  # (n_s, n_cell)
    # (n_s, n + n_s): The current that each source delivers (a V out of its p node, an I out of its n node) is through @
    # i + delivered @ (x, s), with the currents i of the cells
    delivered: FloatArray
    # resistor_factor (n_r, n), resistor_factor_s (n_r, n_s): Factors f and f_s with k = f^T f and, in the columns of
    # the voltage sources, b = f^T f_s; f_s is zero in the columns of the current sources
    resistor_factor: FloatArray
    resistor_factor_s: FloatArray
    node_names: tuple[str, ...]
    # (n_node, n + n_s + n_inner): Node voltages from x, s and the inner sources; where they follow the currents that
    # sources deliver (`senses`), from x, s and these
    nodes: FloatArray
    # The series stack if this is its network: modes and phasors are then computed from it, to full relative precision
    stack: Stack | None = None
    # Whether modes may oscillate, grow or change, with inductors, amplifiers and switches: not for exponential steps
    active: bool = False
    # (n_voltage,): Largest voltage of a controlled source over that of the source that it follows, or 1; empty for 1
    lift: tuple[float, ...] = ()
    course: Course | None = None  # When switches change, which are as they are before time 0 here
    coils: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))  # As `Closed.flux`, of the last states
    # Cache of results that do not depend on the sources, shared by networks that differ in their sources only
    kept: dict[Any, Any] = field(default_factory=dict, compare=False, repr=False)

    @property
    def drives(self) -> tuple[tuple[Element, float], ...]:
        """The deck's sources, each with its sign along the loop of a stack, and 1 in other networks."""
        return tuple((e, 1.0) for e in self.sources) if self.stack is None else self.stack.sources

    @cached_property
    def inner(self) -> tuple[Element, ...]:
        """Sources of a series loop that has several; their sum is the network's one source."""
        return tuple(e for e, _ in self.drives) if len(self.drives) > len(self.sources) else ()

    @cached_property
    def waveforms(self) -> tuple[Waveform, ...]:
        """Waveform of each source, V or A."""
        return tuple(e.waveform for e in self.sources if e.waveform is not None)

    @cached_property
    def waveform(self) -> Waveform:
        """All sources at once, for their common period, breakpoints and shortest time."""
        return self.waveforms[0] if len(self.waveforms) == 1 else Sum(self.waveforms)

    @cached_property
    def grouping(self) -> FloatArray:
        """Matrix of 0 and 1 from cells to layers, shape (n_layer, n_cell)."""
        rows = [[float(cell.element is layer) for cell in self.cells] for layer in self.layers]
        return np.array(rows).reshape(len(self.layers), len(self.cells))

    @property
    def areas_at_rest(self) -> FloatArray:
        """Areas at 0 V, or as the deck gives them, m^2, shape (n_area,)."""
        pairs = zip(self.areas, self.contacts, strict=True)
        return np.array([float(c.area(0.0)) if c is not None and a.given is None else a.given for a, c in pairs])

    @property
    def arrays(self) -> tuple[Any, ...]:
        """The arrays of an `engine.network.Net` that depend on neither areas nor sources."""

        def make() -> tuple[Any, ...]:
            constants = np.array([(c.c, c.g_total, c.g_area) for c in self.cells], float).reshape(-1, 3).T.copy()
            place = np.array([-1 if c.area is None else c.area for c in self.cells], np.int64)
            matrices = self.p, self.q, *constants, place, self.k, self.b, self.through, self.delivered, self.cut
            return tuple(map(np.ascontiguousarray, matrices))

        return self.remember(("arrays",), make)

    @cached_property
    def fingers(self) -> tuple[int, ...]:
        """Indices of the ridge areas that a GAP drives."""
        return tuple(i for i, gap in enumerate(self.gaps) if gap is not None and not self.areas[i].own)

    @cached_property
    def finger_cells(self) -> tuple[int, ...]:
        """Index of the cell of each finger's GAP."""
        return tuple(cell for i in self.fingers if (cell := self.gaps[i]) is not None)

    @property
    def owned(self) -> bool:
        """Whether a GAP's own capacitance or leak follows its voltage otherwise than its ridge area does."""
        return any(area.own for area in self.areas)

    def switched(self, on: tuple[bool, ...]) -> Network:
        """This network with these switches on."""

        def make() -> Network:
            assert self.course is not None
            other = build_network(self.course.circuit, on=on)
            alike = all(np.allclose(getattr(self, x), getattr(other, x), 1e-12, 1e-300) for x in ("p", "q", "cut"))
            said = f"{self.course.switches[0].name} changes how a controlled source drives a capacitor"
            refuse(not alike, f"{said}; allowed: an R between them", self.course.switches[0])
            return other

        return self.remember(("switched", on), make, 64)

    @property
    def alone(self) -> Network:
        """For phasors: the network of its one source, if the others are 0 V and only serve to measure currents."""
        on = [i for i, e in enumerate(self.sources) if e.waveform != OFF or e.ac is not None]
        # The voltages of nodes may follow what those measure.
        read = self.senses and (not self.fingers or on[:1] >= [self.n_voltage])
        if len(on) != 1 or len(self.sources) == 1 or read:
            return self
        columns = [*range(self.k.shape[1]), self.k.shape[1] + on[0]]
        return replace(
            self, sources=(self.sources[on[0]],), n_voltage=int(on[0] < self.n_voltage), q=self.q[:, on],
            b=self.b[:, on], through=self.through[on], delivered=self.delivered[on][:, columns], lift=(), kept={},
            resistor_factor_s=self.resistor_factor_s[:, on], nodes=self.nodes[:, columns],
        )  # fmt: skip

    @cached_property
    def senses(self) -> bool:
        """Whether nodes' voltages follow currents that sources deliver."""
        return bool(self.nodes.shape[1] > sum(self.b.shape) + len(self.inner))

    @cached_property
    def named_contacts(self) -> tuple[tuple[str, Contact], ...]:
        """Name and contact of each GAP."""
        found = ((self.areas[i].gap, self.contacts[i]) for i in self.fingers)
        return tuple((gap.name, contact) for gap, contact in found if gap is not None and contact is not None)

    def held(self, area: float) -> FloatArray:
        """All areas (n_area,) in m^2 where every ridge area is this one, and gaps and leaks are those at 0 V."""
        rest, out = self.areas_at_rest, np.full(len(self.areas), area)
        for i, one in enumerate(self.areas):
            if one.own:
                ridge = next(j for j, other in enumerate(self.areas) if other.gap is one.gap)
                out[i] = rest[i] * (area / rest[ridge] if one.own == "closed" else 1.0)
        return out

    def pulled(self, finger: int, area: FloatArray) -> FloatArray:
        """Area (m^2) on which the stress across a gap of height `d` gives a finger's force, from all areas (n_area,).

        It is A (d/h)^2 where the gap closes to the height h.
        """
        own = self.areas[finger]
        closed = (area[i] / area[finger] for i, a in enumerate(self.areas) if a.own == "closed" and a.gap is own.gap)
        return np.asarray(area[finger] * next(closed, 1.0) ** 2)

    def capacitance(self, area: FloatArray) -> FloatArray:
        """Capacitance of every cell at areas (n_area,) in m^2, F, shape (n_cell,)."""
        return np.array([c.c if c.area is None else c.c * area[c.area] for c in self.cells])

    def leak(self, area: FloatArray) -> FloatArray:
        """Leakage conductance of every cell at areas (n_area,) in m^2, S, shape (n_cell,)."""
        return np.array([c.g_total + (0.0 if c.area is None else c.g_area * area[c.area]) for c in self.cells])

    def stiffness(self, y: ArrayLike) -> tuple[Any, Any]:
        """Matrices of the currents into the cuts from x (..., n, n) and s (..., n, n_s), S, at y (..., n_cell), S."""
        y = np.asarray(y)[..., None]
        return self.k + self.cut.T @ (y * self.p), self.b + self.cut.T @ (y * self.q)

    def decay(self, area: FloatArray) -> ComplexArray:
        """Complex rates at which modes decay at areas (n_area,) in m^2, 1/s; where one grows the real part is < 0."""
        mass = self.cut.T @ (self.capacitance(area)[:, None] * self.p)
        return np.asarray(np.linalg.eigvals(np.linalg.solve(mass, self.stiffness(self.leak(area))[0])), complex)

    def admittances(self, frequency: ArrayLike, area: FloatArray) -> ComplexArray:
        """Complex admittance of every cell at frequencies (Hz), with SKIN's data there, S, shape (..., n_cell)."""
        f = np.asarray(frequency, float)
        y = self.leak(area) + 2j * np.pi * f[..., None] * self.capacitance(area)
        for i, cell in enumerate(self.cells):
            v, size = cell.element.values, 1.0 if cell.area is None else area[cell.area]
            if cell.element.device == "SKIN":
                per_area = 1.0 / skin_resistivity(f) + 2j * np.pi * f * EPS0 * skin_permittivity(f)
                y[..., i] = per_area * size / v["d"]
            elif cell.element.device in ("CPE", "CPE_LAYER"):
                # Equal shares of q s^n, of as many cells as its ladder has in series.
                y[..., i] = (PHASE_POLES.size + 2) * v["q"] * (2j * np.pi * f) ** v["n_cpe"] * size
        return np.asarray(y)

    def phasors(self, frequency: ArrayLike, area: FloatArray, s: ComplexArray) -> ComplexArray:
        """Cell voltages (..., n_cell) at frequencies (Hz) and areas (n_area,) in m^2 for source phasors s (n_s,)."""
        return np.asarray(self._live(self.admittances(frequency, area), s) @ self.p.T + self.q @ s)

    def _live(self, y: ComplexArray, s: ComplexArray) -> ComplexArray:
        """Phasors of the live voltages (..., n) for cells of the admittances y (..., n_cell)."""
        k, b = self.stiffness(y)
        return np.asarray(np.linalg.solve(k, -(b @ s)[..., None])[..., 0])

    def node_phasors(self, frequency: float, area: FloatArray, s: ComplexArray) -> ComplexArray:
        """Node voltages (n_node,) at a frequency (Hz) and areas (n_area,) in m^2 for source phasors s (n_s,)."""
        y = self.admittances(frequency, area)
        both = np.concatenate([x := self._live(y, s), s])
        if self.senses:
            both = np.append(both, self.through @ (y * (self.p @ x + self.q @ s)) + self.delivered @ both)
        return np.asarray(self.nodes[:, : both.size] @ both)

    def layer_gain(self, frequency: float, area: FloatArray) -> ComplexArray:
        """Ratio of each layer's voltage (from p to n) to the one source's, shape (n_layer,)."""
        if (stack := self.stack) is None:
            return np.asarray(self.grouping @ self.phasors(frequency, area, np.ones(1, complex)))
        gains = layer_gains(self.admittances(frequency, area)) * stack.sign[list(stack.state_order)]
        return np.asarray(self.grouping @ gains)

    def impedance(self, frequency: float, area: FloatArray) -> complex:
        """Voltage of the one source over the current that it delivers, at a frequency (Hz), ohm."""
        one, y = np.ones(1, complex), self.admittances(frequency, area)
        if self.n_voltage:
            x = self._live(y, one)
            current = self.through[0] @ (y * (self.p @ x + self.q @ one)) + self.delivered[0] @ np.append(x, one)
            return complex(1.0 / current) if current != 0.0 else complex(np.inf)
        at = dict(zip(self.node_names, self.node_phasors(frequency, area, one), strict=True))
        p, n = (at.get(name, 0.0) for name in self.sources[0].node_names[:2])
        return complex(n - p)


def build_network(circuit: Circuit, held: tuple[Element, ...] = (), on: tuple[bool, ...] | None = None) -> Network:
    """The network of a circuit, or its refusal.

    The voltage sources in `held` are added, to hold the voltages of nodes; they may close no loop of voltage sources.
    Switches are as `on` says, by default as they are before time 0.
    """
    areas, carrying = find_branches(circuit)
    branches = [*carrying, *held]
    problem = ".options work=total holds the voltage across a series stack, and this circuit is none; allowed: work=gap"
    refuse(circuit.work == "total" and any(area.gap for area in areas), problem)
    place = {area.node: i for i, area in enumerate(areas)}
    # The gaps come first, so that the tree contains them and their voltages are states.
    cells = sorted((cell for e in branches for cell in _cells(e, place)), key=lambda cell: cell.element.device != "GAP")
    kinds = statespace.VOLTAGES, statespace.CURRENTS, "RS"
    voltages, currents, resistors = ([e for x in kind for e in branches if e.device == x] for kind in kinds)
    n_v, n_i, n_c = len(voltages), len(currents), len(cells)
    ends = [*(e.nodes for e in voltages), *(cell.nodes for cell in cells), *(e.nodes for e in resistors)]
    taken, potential = statespace.spanning_tree(ends)
    assert all(taken[:n_v])
    live = [i for i in range(n_c) if taken[n_v + i]]
    n, n_e = len(live), len(live) + n_v
    # The tree's branches are voltage sources, capacitors and resistors: their voltages are s, x and r.
    order = [*range(n_v, n_e), *range(n_v)]

    def rows(pairs: list[tuple[str, ...]]) -> FloatArray:
        """Matrix from the voltages of the tree's branches, in the tree's order, to the voltages between node pairs."""
        return np.array([potential[a] - potential[b] for a, b, *_ in pairs]).reshape(len(pairs), sum(taken))

    across, over_currents = rows([cell.nodes for cell in cells])[:, order], rows([e.nodes for e in currents])
    over_e, over_r = np.hsplit(rows([e.nodes for e in resistors]), [n_e])
    course = Course(circuit) if any(e.device == "S" for e in resistors) else None
    conductance = 1.0 / np.array([_resistance(e, course, on) for e in resistors])[:, None]
    weight = np.sqrt(conductance)
    # Given e = (s, x), the voltages r minimise the power.
    orthogonal, upper = np.linalg.qr(weight * over_r)
    from_e = -np.linalg.solve(upper, orthogonal.T @ (weight * over_e))
    from_i = -np.linalg.solve(upper, np.linalg.solve(upper.T, over_currents[:, n_e:].T))
    by_e, by_i = over_e + over_r @ from_e, over_r @ from_i
    # Currents into the cuts of e by (x, s) and by the currents of the current sources.
    into_e, into_i = by_e.T @ (conductance * by_e), over_e.T @ (conductance * by_i) + over_currents[:, :n_e].T
    into = np.hstack([into_e[:, order], into_i])
    # The current of a small resistance suffers from cancellation. Adding to a source's cut the combination of the
    # capacitors' cuts with the least contribution of resistors takes the source's current from the cells instead.
    factor, together = (weight * by_e)[:, order], np.zeros((n_v, n))
    if factor.size:
        together = np.asarray(-np.linalg.lstsq(factor[:, :n], factor[:, n:], rcond=None)[0].T, float)
    delivered: FloatArray = np.vstack([into[:n_v] + together @ into[n_v:], np.eye(n_i, n_e + n_i, n_e)])
    size = np.linalg.norm(factor, axis=0)
    delivered[:n_v, :n_e][np.abs(delivered[:n_v, :n_e]) <= _ROUNDING * np.outer(size[n:], size)] = 0.0
    through = np.zeros((n_v + n_i, n_c))
    through[:n_v] = across[:, n:].T + together @ across[:, :n].T
    written = {node: name for el in branches for node, name in zip(el.nodes, el.node_names, strict=True)}
    names = [node for node in potential if node in written and node != "0"]
    at_e, at_r = np.hsplit(rows([(name, "0") for name in names]), [n_e])
    network = Network(
        sources=(*voltages, *currents), n_voltage=n_v, cells=tuple(cells), live=tuple(live),
        layers=tuple(e for e in branches if e.spec.is_layer), areas=areas,
        contacts=tuple(map(_contact, areas)),
        gaps=tuple(next((i for i, c in enumerate(cells) if c.element is a.gap), None) for a in areas),
        p=(p := np.ascontiguousarray(across[:, :n])), q=np.hstack([across[:, n:], np.zeros((n_c, n_i))]), cut=p,
        k=into[n_v:, :n], b=into[n_v:, n:], through=through, delivered=delivered,
        resistor_factor=factor[:, :n], resistor_factor_s=np.hstack([factor[:, n:], np.zeros((len(resistors), n_i))]),
        node_names=tuple(written[name] for name in names),
        nodes=np.hstack([(at_e + at_r @ from_e)[:, order], at_r @ from_i]),
    )  # fmt: skip
    return _closed(network if course is None else replace(network, active=True, course=course), circuit)


def _resistance(element: Element, course: Course | None, on: tuple[bool, ...] | None) -> float:
    """Resistance of an R, or of a switch in its state, ohm."""
    if course is None or element.device == "R":
        return element.values["value"]
    closed = dict(zip((e.name for e in course.switches), on or course.changes(0.0)[1][0], strict=True))
    return element.values["ron" if closed[element.name] else "roff"]


def _closed(network: Network, circuit: Circuit) -> Network:
    """The network with its controlled sources and inductors eliminated, if it has any."""
    sources, coils = network.sources, [e for e in network.sources if e.device == "L"]
    if all(e.device in "VI" for e in sources):
        return network
    held = [c for c in network.capacitance(network.areas_at_rest).tolist() if c > 0.0]
    # Between the capacitors in size, so that errors of all states count alike; without any, from a resistor's time.
    widest = max((e.values["value"] for e in circuit.by_device("R")), default=1.0)
    between = math.sqrt(min(held) * max(held)) if held else max([e.values["value"] for e in coils] or [1.0]) / widest**2
    found = Matrices(*(getattr(network, name) for name in Matrices._fields))
    made = closed(found, sources, network.node_names, circuit.by_device("K"), between)
    own, states, n_all = [i for i, e in enumerate(sources) if e.device in "VI"], len(made.flux), network.n_voltage
    alike = np.pad(network.resistor_factor, ((0, 0), (0, states)))
    through = (Cell(e, (e.nodes[0], e.nodes[1]), None, between, 0.0, 0.0) for e in coils[:states])
    out = replace(
        network, **made.matrices._asdict(), sources=tuple(sources[i] for i in own),
        n_voltage=sum(sources[i].device == "V" for i in own), cells=(*network.cells, *through),
        live=(*network.live, *range(len(network.cells), len(network.cells) + states)),
        resistor_factor=alike, resistor_factor_s=network.resistor_factor_s @ made.sources,
        active=network.active or not made.reciprocal, coils=made.flux,
        kept={}, lift=tuple(np.abs(made.sources[:n_all, : len(own)]).max(axis=0, initial=1.0).tolist()),
    )  # fmt: skip
    mass = out.cut.T @ (out.capacitance(out.areas_at_rest)[:, None] * out.p)
    size = np.abs(out.cut).T @ (out.capacitance(out.areas_at_rest)[:, None] * np.abs(out.p))
    scale = 1.0 / np.sqrt(np.diag(size))
    if mass.size and not np.linalg.det(scale[:, None] * mass * scale) > _ROUNDING:
        named = [e for e in sources if e.device in "EGFH"]
        said = f"behind {', '.join(e.name for e in named)} a node has no capacitance, or less than none"
        raise InputError(f"{said}; allowed: less gain, or an R in series with the capacitor", named[0].where)
    return out


def _contact(area: Area) -> Contact | None:
    if area.gap is None:
        return None
    contact, v = contact_of(area.gap), area.gap.values
    if area.own == "closed":
        return contact.closed()
    return contact.leaking(v["r_exp"], v["r_load"] or v["fn"]) if area.own else contact


def _cells(element: Element, place: dict[str, int]) -> list[Cell]:
    a, b, *area = element.nodes
    if element.device == "C":
        return [Cell(element, (a, b), None, element.values["value"], 0.0, 0.0)]
    constants = [] if element.spec.cells is None else statespace.layer_constants(element).tolist()
    # The nodes between an element's cells have names that no netlist can write.
    path = [a, *(f"{element.name.lower()} {i}" for i in range(1, len(constants))), b]
    on = place[area[0]] if area else None
    if (closed := place.get(f"{area[0]} closed") if element.device == "GAP" else None) is not None:
        on = closed
    cells = [Cell(element, ends, on, *own) for own, ends in zip(constants, pairwise(path), strict=False)]
    if element.device == "GAP" and (leaking := place.get(f"{area[0]} leaking")) is not None:
        leak = replace(element, name=f"{element.name}_r", device="R", nodes=(a, b), node_names=element.node_names[:2])
        cells = [cells[0]._replace(g_total=0.0), Cell(leak, (a, b), leaking, 0.0, 0.0, cells[0].g_total)]
    return cells + (_cells(beside, place) if (beside := statespace.beside_gap(element)) is not None else [])


class Modes(NamedTuple):
    """Modes v of a network with fixed areas: x = shape v - follow s, with v_k' = -rates_k v_k + gains_k s."""

    rates: FloatArray  # (n,): 1/s; zero for a charge that no conductance drains
    gains: FloatArray  # (n, n_s)
    # shape, inverse (n, n): v = inverse (x + follow s)
    shape: FloatArray
    inverse: FloatArray
    follow: FloatArray  # (n, n_s): A jump ds of the sources changes x by -follow ds, and v not at all
    # (n, n_cell): Currents j (A) through the cells in addition to their linear ones contribute -take j to v'
    take: FloatArray


def network_modes(network: Network, area: FloatArray) -> Modes:
    """Modes at areas (n_area,) in m^2.

    The rates are squares of the singular values of the conductance matrix's factor, not eigenvalues of the matrix: so a
    slow mode beside a fast one has its rate, and its drive by the sources, with twice as many digits.
    """
    capacitance, weight = network.capacitance(area)[:, None], np.sqrt(network.leak(area))[:, None]
    (n, n_s), n_v = network.b.shape, network.n_voltage
    lower = np.linalg.cholesky(network.p.T @ (capacitance * network.p))
    factor = np.vstack([network.resistor_factor, weight * network.p])
    factor_s = np.vstack([network.resistor_factor_s, weight * network.q])
    left, sigma, turned = np.linalg.svd(np.linalg.solve(lower, factor.T).T)
    rates, pushed = np.zeros(n), np.zeros((n, n_s))
    rates[: sigma.size] = sigma**2
    # The computed rate of a charge that no conductance drains is round-off.
    rates[rates < 1e-28 * rates.max(initial=0.0)] = 0.0
    take = turned @ np.linalg.solve(lower, network.p.T)
    moved, shape = take @ (capacitance * network.q), np.linalg.solve(lower.T, turned.T)
    pushed[: sigma.size] = sigma[:, None] * (left[:, : sigma.size].T @ factor_s)
    pushed[:, n_v:] += turned @ np.linalg.solve(lower, network.b[:, n_v:])
    gains = rates[:, None] * moved - pushed
    return Modes(*(np.asarray(x, float) for x in (rates, gains, shape, turned @ lower.T, shape @ moved, take)))


# Networks of circuits


def network_of(circuit: Circuit, skin_at: float | None = None) -> Network:
    """The network of a circuit; with `skin_at`, dispersive skins of a stack have their data at that frequency (Hz)."""

    def make() -> Network:
        if statespace.loop_of(circuit) is None:
            # Switches follow the sources, in which networks that are shared may differ.
            keeper = circuit.remember if circuit.by_device("S") else partial(shared, circuit)
            network = keeper(("reduced",), lambda: build_network(circuit))
            now = {e.name: e for e in circuit.elements}
            return replace(network, sources=tuple(now.get(e.name, e) for e in network.sources))
        stack = build_stack(circuit, skin_at)
        network = shared(circuit, ("loop network", skin_at), lambda: loop_network(stack))
        if network.stack is not stack:
            around = replace(network.sources[0], waveform=stack.waveform)
            network = replace(network, sources=(around,), stack=stack)
        return network

    return circuit.remember(("network", skin_at), make)


def checked(circuit: Circuit) -> Circuit:
    """The circuit, refused if a value is not allowed or it has no solution."""
    check(circuit)
    # Of a stack the network follows from its cells, and cannot fail.
    (build_stack if statespace.loop_of(circuit) else network_of)(circuit)
    return circuit


@lru_cache(maxsize=64)
def _loop_voltages(
    hops: tuple[tuple[bool, float], ...], of_layer: tuple[int, ...], sign: tuple[float, ...]
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """`Network.p`, `q`, `nodes` of a loop: from each hop's sign, and whether it is a source, and from each cell's."""
    # Cell voltages follow from the states and the loop's voltage, node voltages also from each of several sources.
    n, sources, layer = len(sign) - 1, sum(is_source for is_source, _ in hops), count()
    across = np.eye(n + 1, n + 1 + (sources if sources > 1 else 0))
    across[n, :n], across[n, n] = -sign[n] * np.array(sign[:n]), sign[n]
    own = iter(np.eye(across.shape[1])[n + (sources > 1) :])
    drops = [
        turn * (next(own) if is_source else across[np.equal(of_layer, next(layer))].sum(axis=0))
        for is_source, turn in hops[:-1]
    ]
    return across[:, :n].copy(), across[:, n : n + 1].copy(), 0.0 - np.cumsum(drops, axis=0)


def loop_network(stack: Stack) -> Network:
    """The network of a stack, its cells in the order of `Stack.state_order`, with voltages from p to n."""
    order, n = list(stack.state_order), stack.c.size - 1
    of_layer, sign = stack.layer_of[order].tolist(), stack.sign[order]
    constants = np.stack([stack.c, stack.g_total, stack.g_area], axis=1)[order].tolist()
    area = stack.area_given if stack.contact is None or stack.area_given else stack.contact.area_at_rest
    assert area is not None
    # The delivered charge is computed at the cell that leaks most slowly, where cancellation costs fewest digits.
    slowest = np.array(order) == np.argmin(stack.leak_rates(area))
    p, q, nodes = _loop_voltages(tuple((h.element.device == "V", h.sign) for h in stack.hops), (*of_layer,), (*sign,))
    gap = None if stack.gap_layer is None else stack.layers[stack.gap_layer]
    cells = [Cell(stack.layers[i], ("1", "0"), 0, *own) for i, own in zip(of_layer, constants, strict=True)]
    around = Element("loop", "V", ("1", "0"), ("1", "0"), MappingProxyType({}), stack.waveform)
    return Network(
        sources=(around,), n_voltage=1, cells=tuple(cells), layers=stack.layers, live=tuple(range(n)),
        areas=(Area(stack.layers[0].nodes[2], gap, stack.area_given),), contacts=(stack.contact,),
        gaps=(None if stack.gap is None else order.index(stack.gap),),
        p=p, q=q, cut=p, k=np.zeros((n, n)), b=np.zeros((n, 1)),
        through=(sign * slowest)[None], delivered=np.zeros((1, n + 1)),
        resistor_factor=np.zeros((0, n)), resistor_factor_s=np.zeros((0, 1)),
        node_names=tuple(hop.node for hop in stack.hops[:-1]), nodes=nodes, stack=stack,
    )  # fmt: skip


# Linear response


class LinearScene(NamedTuple):
    """A network with one source, and the contact whose phasors are wanted."""

    network: Network
    contact: Contact
    gap: int  # Index of the GAP among the layers
    finger: int  # Index of the GAP's area
    note: str  # Text that names the GAP if there are several; empty for one GAP


def linear_scene(circuit: Circuit, finger: str | None = None) -> LinearScene:
    """The linear scene of a circuit's GAP, which has to be named if there are several.

    Refused are names of no GAP, and networks with several sources, which have no common amplitude and frequency.
    """
    gaps = {e.name.lower(): e.name for e in circuit.by_device("GAP")}
    known = ", ".join(gaps.values()) or "none: this circuit has no GAP"
    require(finger is None or finger.lower() in gaps, "finger", repr(finger), f"the name of a GAP, {known}")
    network = network_of(circuit).alone
    refuse(not gaps, "a phasor solution needs a GAP; this circuit has none")
    names, problem = ", ".join(e.name for e in network.sources), "a phasor solution needs one source"
    refuse(len(network.sources) != 1, f"{problem}, whose amplitude it takes; this circuit has {names}")
    refuse(finger is None and len(gaps) > 1, f"this circuit has several GAPs; allowed: finger= one of {known}")
    name = next(iter(gaps.values())) if finger is None else gaps[finger.lower()]
    # Every GAP drives an area: `find_branches` refuses two on one.
    place = next(i for i, area in enumerate(network.areas) if area.gap is not None and area.gap.name == name)
    contact, gap = network.contacts[place], [e.name for e in network.layers].index(name)
    assert contact is not None
    return LinearScene(network, contact, gap, place, f"of several GAPs, {name}" if len(gaps) > 1 else "")


def with_skin_held(circuit: Circuit) -> Circuit:
    """The circuit with each SKIN replaced by a SLAB that has the skin's data at the SKIN's own frequency."""
    held: dict[str, Element] = {}
    for skin in circuit.by_device("SKIN"):
        d, f = skin.values["d"], skin.values["f"]
        values = {"d": d, "eps_r": float(skin_permittivity(f)), "rho": float(skin_resistivity(f)), "e_max": math.inf}
        held[skin.name] = replace(skin, device="SLAB", values=MappingProxyType(values))
    return replace(circuit, elements=tuple(held.get(e.name, e) for e in circuit.elements))


def mean_areas(network: Network) -> FloatArray:
    """Areas of a coupled phasor at its source's fundamental, m^2, shape (n_area,); refused if there is none."""
    if len((network := network.alone).sources) > 1:
        what = "of one source at its fundamental, and this circuit has several sources"
    elif fundamental := network.waveforms[0].fundamental:
        return phasor_areas(network, "mean", fundamental.frequency, fundamental.amplitude)
    else:
        what = "at the source's fundamental, and this source has none"
    raise InputError(f"area='mean' is the area of the phasor {what}; allowed: 'coupled', 'frozen' or an area in m^2")


def phasor_areas(network: Network, mode: str | float, f: float, amplitude: float) -> FloatArray:
    """Areas under one source's amplitude (V or A) at one frequency (Hz), m^2, shape (n_area,).

    They are those of the gaps' rms voltages, unless `mode` is ``frozen`` or one area in m^2.
    """
    area = network.areas_at_rest if isinstance(mode, str) else network.held(mode)
    if mode != "mean" or all(a.given is not None for a in network.areas):
        return area
    names, fingers = [e.name for e in network.layers], enumerate(zip(network.areas, network.contacts, strict=True))
    free = [(i, names.index(a.gap.name), c) for i, (a, c) in fingers if a.given is None and a.gap and c is not None]

    def following(area: FloatArray) -> FloatArray:
        u, new = np.abs(amplitude * network.layer_gain(f, area)) / math.sqrt(2.0), area.copy()
        for i, layer, contact in free:
            new[i] = contact.area(u[layer])
        return new

    return settled_areas(following, area)
