"""Topology of a circuit, with checks that it is a solvable network; and the reduced state space of a series stack.

Per unit area, layer x has the capacitance c_x and the leakage conductance g_x = 1/(R_x A) (a total resistance) or
1/(rho d) (a material), and S = sum 1/c_x. With v_x, the part of the voltage due to the leaked charges,
u_x = k_x U + v_x, k_x = 1/(c_x S): a jump of U splits in the ratio of 1/c_x, no derivative of U appears, and
sum v_x = 0 fixes the neutral gauge of the leaked charges. So N layers have N - 1 live states,

    v' = (k 1^T - I) diag(g/c) u.
"""

from __future__ import annotations

import operator
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Set
from contextlib import suppress
from dataclasses import dataclass, field, replace
from difflib import get_close_matches
from functools import cached_property
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fingerspice.base.arrays import FloatArray, Remembering, T
from fingerspice.base.errors import InputError
from fingerspice.circuit.circuit import Circuit, Element
from fingerspice.circuit.devices import PHASE_POLES
from fingerspice.circuit.laws import acting_law
from fingerspice.physics.contact import Contact, JkrContact
from fingerspice.physics.materials import EPS0, SKIN_LADDER
from fingerspice.waveforms.waveform import DC, OFF, Product, Sum, Waveform, refuse

MAX_ELEMENTS = 2000  #: Largest number of elements of a circuit, because every matrix of a network is dense.
SLABS = len(SKIN_LADDER.poles) + 1  #: Number of slabs of a dispersive skin.
#: Devices that set a voltage, and those that set a current, while the network is reduced.
VOLTAGES, CURRENTS = "VEH", "IGFL"
_GROUNDS = ("gnd", "ground", "earth", "vss")


class Hop(NamedTuple):
    """One element on the way round the loop from ground; `sign` is +1 if its p node comes first."""

    element: Element
    sign: float
    node: str  # Name, as written, of the node after the element


class Area(NamedTuple):
    """A contact area of a circuit, with the GAP or the value that determines it."""

    node: str  # Canonical name of the area node
    gap: Element | None  # The GAP that drives it
    given: float | None  # m^2, from a DC source on the node or the gap's a_fix
    # What follows it in place of a ridge area: the gap's own capacitance ("closed"), or its leak ("leaking")
    own: str = ""


def find_branches(circuit: Circuit) -> tuple[tuple[Area, ...], list[Element]]:
    """Areas of a circuit, and the elements that carry current; a circuit that has no solution is refused."""
    count = count_of(circuit)
    counted = f", a SKIN_DISPERSIVE counted as its {SLABS} slabs" if count > len(circuit.elements) else ""
    refuse(count > MAX_ELEMENTS, f"the circuit has {count:,} elements{counted}; allowed: at most {MAX_ELEMENTS:,}")
    areas, drives = _areas(circuit), {e.name for e in driving(circuit)}
    branches = [e for e in circuit.elements if e.nodes and (e.device not in "VI" or e.name in drives)]
    ruled = [e for e in circuit.elements if e.control]
    if not drives:
        allowed = "a V element that drives the stack, such as V1 drive 0 SIN(0 200 100), or a start, IC= of a capacitor"
        still = not circuit.initial and all(e.initial is None for e in branches)
        refuse(still, f"the circuit has no source; allowed: {allowed} or .ic v(node)=")
        nodes, names = branches[0].nodes[1::-1], branches[0].node_names[1::-1]  # In place of a source, one of 0 A.
        branches.append(Element("none", "I", nodes, names, MappingProxyType({}), OFF))
    if ruled:
        _refuse_uncontrolled(ruled, branches)
    _refuse_unsolvable(branches, {node for e in ruled if len(e.control) > 1 for node in e.control})
    return areas, branches


def _refuse_uncontrolled(ruled: list[Element], branches: list[Element]) -> None:
    """Refuse what is controlled by a node or an element that is not there."""
    nodes = [*dict.fromkeys(node for e in branches for node in e.nodes), "0"]
    for e in ruled:
        kind = e.spec.control[0]
        device, what = {"node": ("", "a node that some element touches"), "inductor": ("L", "an L element"),
                        "source": ("V", "a V element, of 0 V where only its current counts")}[kind]  # fmt: skip
        known = [one.name.lower() for one in branches if one.device == device] if device else nodes
        for name in e.control:
            near = "".join(f"; is {x!r} meant?" for x in get_close_matches(name, known, 1, 0.7))
            refuse(name not in known, f"{e.name} names the {kind} {name!r}; allowed: {what}{near}", e)


def driving(circuit: Circuit) -> list[Element]:
    """The V and I elements that do not give an area, of any circuit."""

    def make() -> list[Element]:
        areas = {e.nodes[2] for e in circuit.elements if e.spec.is_layer}
        return [e for e in circuit.by_device("V", "I") if areas.isdisjoint(e.nodes)]

    return circuit.remember(("driving",), make)


def driving_sources(circuit: Circuit) -> list[Element]:
    """As `driving`, of a circuit that `find_branches` does not refuse."""
    loop_of(circuit)
    return driving(circuit)


def shared(circuit: Circuit, key: tuple[Any, ...], make: Callable[[], T]) -> T:
    """The result of `make`, kept for all related circuits that differ in the sources that carry current only."""

    def find() -> Remembering:
        drives = {e.name for e in driving(circuit)}
        passive = [e for e in circuit.elements if e.name not in drives]
        before, kept = circuit.related.kept.get("passive", ([], Remembering()))
        if not before or not all(map(operator.is_, before, passive)):
            circuit.related.kept["passive"] = passive, (kept := Remembering())
        return kept  # type: ignore[no-any-return]

    return circuit.remember(("passive",), find).remember(key, make)


def loop_of(circuit: Circuit) -> tuple[tuple[Hop, ...], Area] | None:
    """The hops and the area of a stack, a circuit of one series loop of sources and layers, from ground to ground.

    None for any other circuit, for an area that follows with delay, and for a gap with a constant-phase element beside
    it or with parts that do not follow its area. Related circuits share the way round the loop.
    """

    def make() -> tuple[tuple[Hop, ...], Area] | None:
        walked = circuit.related.remember(("hops",), lambda: _find_hops(circuit))
        if walked is None:
            return None
        area, *owned = shared(circuit, ("areas",), lambda: _areas(circuit))
        delayed = area.gap is not None and area.gap.values["tau"] > 0.0 and area.given is None
        if owned or delayed or (area.gap is not None and area.gap.values["q"] > 0.0):
            return None
        now = {e.name: e for e in circuit.elements}
        return tuple(hop._replace(element=now[hop.element.name]) for hop in walked), area

    return circuit.remember(("loop",), make)


def _find_hops(circuit: Circuit) -> tuple[Hop, ...] | None:
    """The loop in the direction in which the n node of the first source comes before its p node."""
    areas, branches = find_branches(circuit)
    at = _incidence(branches)
    of_stacks = all(e.device == "V" or e.spec.is_layer for e in branches)
    if sum(not area.own for area in areas) != 1 or not of_stacks or max(map(len, at.values())) > 2:
        return None
    walks = []
    for start in at["0"]:
        hops, node, element = list[Hop](), "0", start
        while not hops or node != "0":
            element = next(e for e in at[node] if e is not element) if hops else start
            end = 1 if element.nodes[0] == node else 0
            node = element.nodes[end]
            hops.append(Hop(element, 1.0 if end else -1.0, element.node_names[end]))
        walks.append(tuple(hops))
    for walk in walks:
        if next(hop for hop in walk if hop.element.device == "V").sign < 0.0:
            return walk
    # With opposed sources, the p node of the first source may come first in both directions: the deck's first source
    # then decides.
    deciding = next(e for e in branches if e.device == "V")
    return next(walk for walk in walks if any(hop.element is deciding and hop.sign < 0.0 for hop in walk))


def count_of(circuit: Circuit) -> int:
    """Number of elements of a circuit, each dispersive skin counted as its slabs, and likewise of constant phase."""
    slabs = (SLABS - 1) * len(circuit.by_device("SKIN_DISPERSIVE"))
    phases = len(circuit.by_device("CPE", "CPE_LAYER")) + sum(beside_gap(e) is not None for e in circuit.elements)
    return len(circuit.elements) + slabs + (PHASE_POLES.size + 1) * phases


def beside_gap(element: Element) -> Element | None:
    """The constant-phase element that a GAP has beside it; None without a `q`, and for other devices."""
    if element.device != "GAP" or element.values["q"] == 0.0:
        return None
    values = MappingProxyType({name: element.values[name] for name in ("q", "n_cpe")})
    return Element(f"{element.name}_cpe", "CPE", element.nodes[:2], element.node_names[:2], values)


def _areas(circuit: Circuit) -> tuple[Area, ...]:
    layers, owners = [e for e in circuit.elements if e.spec.is_layer], dict[str, Element]()
    for gap in circuit.by_device("GAP"):
        first = owners.setdefault(gap.nodes[2], gap)
        both = f"{first.name} and {gap.name} both drive the area node {gap.node_names[2]!r}"
        refuse(first is not gap, f"{both}; allowed: one GAP per area", gap)
    at = _incidence(list(circuit.by_device(*"VIRCLEGFHS")))
    out = []
    for node, layer in {e.nodes[2]: e for e in reversed(layers)}.items():
        on_node = list({id(e): e for e in at.get(node, ())}.values())
        owner = owners.get(node)
        if owner is not None and on_node:
            both = f"{on_node[0].name} and {owner.name} both drive the area node {owner.node_names[2]!r}"
            allowed = f"a_fix= on {owner.name} for a given area, another node for what carries current"
            raise InputError(f"{both}, which is a signal; allowed: {allowed}", on_node[0].where)
        if owner is None and len(on_node) != 1:
            what = f"node {layer.node_names[2]!r} gives {layer.name} its area, but "
            what += "more than one source drives it" if on_node else "no GAP and no DC source drives it"
            allowed = f"one GAP, or one V element such as 'Varea {layer.node_names[2]} 0 35' (mm^2)"
            driven = "".join(f"; {gap.name} drives {gap.node_names[2]!r}" for gap in owners.values())
            raise InputError(f"{what}; allowed: {allowed}{driven}", layer.where)
        wave = None if owner is not None else on_node[0].waveform
        if owner is not None:
            size = owner.values["a_fix"]
        elif isinstance(wave, DC) and on_node[0].nodes[1] == "0" and 1e-30 <= wave.level <= 1e30:
            size = wave.level
        else:
            allowed = "allowed is a DC value above 0 (mm^2, from 1e-30 to 1e30) from the area node to 0"
            raise InputError(f"{on_node[0].name} drives an area: {allowed}", on_node[0].where)
        out.append(Area(node, owner, size * 1e-6 if size > 0.0 else None))
    owned = (Area(f"{gap.nodes[2]} {own}", gap, None, own) for gap in owners.values() for own in owns(gap))
    return (*reversed(out), *owned)


def owns(gap: Element) -> tuple[str, ...]:
    """Which parts of a GAP follow its voltage otherwise than its ridge area does; see `Area.own`."""
    v, law = gap.values, acting_law(gap)
    follows = {"closed": law is not None and law.gap is not None, "leaking": v["r_exp"] > 0.0}
    found = tuple(own for own, does in follows.items() if does)
    if found:
        said = f"{gap.name} has {'a gap that closes' if 'closed' in found else 'an r that follows its load'}"
        refuse(v["a_fix"] > 0.0 or v["tau"] > 0.0, f"{said}; allowed: a_fix=0 and tau=0", gap)
    return found


def _incidence(branches: list[Element]) -> dict[str, list[Element]]:
    at: dict[str, list[Element]] = defaultdict(list)
    for element in branches:
        for node in element.nodes[:2]:
            at[node].append(element)
    return at


def _ways(branches: Iterable[tuple[str, ...]], start: str) -> dict[str, tuple[int, str]]:
    """Of each node connected to the start: the number of the branch by which one gets there, and the node before it."""
    at: dict[str, list[tuple[int, str]]] = defaultdict(list)
    for number, (p, n, *_) in enumerate(branches):
        at[p].append((number, n))
        at[n].append((number, p))
    came, ahead = {start: (0, start)}, [start]
    while ahead:
        before = ahead.pop()
        for number, node in at[before]:
            if node not in came:
                came[node] = number, before
                ahead.append(node)
    return came


def spanning_tree(branches: Iterable[tuple[str, ...]]) -> tuple[list[bool], dict[str, FloatArray]]:
    """Which branches, given by their nodes p and n, close no loop with those before: they form a tree.

    With it goes each node's voltage against ground, as a row of coefficients of the tree's voltages.
    """
    above, taken, tree = dict[str, str](), list[bool](), list[tuple[str, ...]]()

    def root(node: str) -> str:
        while (up := above.setdefault(node, node)) != node:
            above[node] = node = above[up]
        return node

    for branch in branches:
        p, n = map(root, branch[:2])
        taken.append(p != n)
        if p != n:
            above[p] = n
            tree.append(branch[:2])
    rows = {"0": np.zeros(len(tree))}
    for node, (number, before) in _ways(tree, "0").items():
        if node != before:
            rows[node] = rows[before].copy()
            rows[node][number] = 1.0 if node == tree[number][0] else -1.0
    return taken, {node: rows[node] for ends in tree for node in ends if node in rows}


def _refuse_unsolvable(branches: list[Element], felt: Set[str] = frozenset()) -> None:
    """Refuse what floats, loops of voltage sources, and current sources without a path for their current.

    The nodes `felt` control sources: one that a voltage source sets needs no other element.
    """

    def named(node: str, element: Element) -> str:
        return repr(element.node_names[element.nodes.index(node)])

    at = _incidence(branches)
    for e in branches:
        refuse(e.nodes[0] == e.nodes[1], f"{e.name} has both ends on node {e.node_names[0]!r}", e)
    # Ground comes last: a chain not connected to ground also has a free end elsewhere, which is the node to name.
    for node, (e, *others) in sorted(at.items(), key=lambda item: item[0] == "0"):
        if not others and not (e.device in VOLTAGES and node in felt):
            # Ground under another name, or a node of which this one may be a misspelling
            near = get_close_matches(node, [other for other in at if other not in (node, "0")], 1, 0.7)
            hint = f"; is {named(near[0], at[near[0]][0])} the same node?" if near else ""
            hint = "; ground is 0 or gnd" if node.startswith(_GROUNDS) else hint
            alone = f"node {named(node, e)} is floating: only {e.name} touches it"
            raise InputError(f"{alone}; allowed: two or more elements at every node{hint}", e.where)
    refuse("0" not in at, "no element touches ground; allowed: one node must be 0 (or gnd)")
    reached = _ways((e.nodes for e in branches), "0")
    for node, (e, *_) in at.items():
        refuse(node not in reached, f"node {named(node, e)} ({e.name}) is floating: nothing connects it to ground", e)
    voltages = [e for e in branches if e.device in VOLTAGES]
    taken, _ = spanning_tree(e.nodes for e in voltages)
    if not all(taken):
        # The sources before form no loop: there is one way through them from one end to the other.
        *before, e = voltages[: taken.index(False) + 1]
        came, names, node = _ways((b.nodes for b in before), e.nodes[0]), list[str](), e.nodes[1]
        while node != e.nodes[0]:
            number, node = came[node]
            names.append(before[number].name)
        refuse(len(names) == 1, f"{names[0]} and {e.name} are voltage sources in parallel", e)
        raise InputError(f"{e.name} closes a loop of voltage sources with {', '.join(names)}", e.where)
    reached = _ways((e.nodes for e in branches if e.device not in CURRENTS), "0")
    coils = any(e.device == "L" for e in branches)
    for source, node in ((e, node) for e in branches if e.device in CURRENTS for node in e.nodes[:2]):
        if node not in reached:
            where = f"node {named(node, source)} is reached through current sources {'and inductors ' * coils}only"
            kind = "an inductor" if source.device == "L" else "a current source"
            problem = f"{source.name} is {kind} without a path: {where}; allowed: an R, C or layer that takes"
            raise InputError(f"{problem} the current to ground", source.where)


# Series stacks


@dataclass(frozen=True)
class Stack(Remembering):
    """Layers in one series loop with an ideal source, sharing one area, each of one or several cells. SI throughout."""

    layers: tuple[Element, ...]  # In loop order, from the source's positive side
    cells: tuple[int, ...]  # Number of cells of each layer, which the arrays list one after the other
    sign: FloatArray  # (n_cell,): +1 for a layer whose p node comes first along the loop, -1 for the others
    c: FloatArray  # (n_cell,): Capacitance per area, F/m^2
    g_total: FloatArray  # (n_cell,): Leakage conductance independent of the area, S
    g_area: FloatArray  # (n_cell,): Leakage conductance per area, S/m^2
    gap: int | None  # Index of the gap among the cells
    gap_layer: int | None  # Index of the gap among the layers
    contact: Contact | None
    area_given: float | None  # Area fixed by the deck, m^2
    hops: tuple[Hop, ...]  # The elements of the loop in order, from ground to ground
    # Whatever else is computed from the layers alone, shared by stacks that differ in their sources only
    kept: dict[Any, Any] = field(default_factory=dict, compare=False, repr=False)

    @property
    def sources(self) -> tuple[tuple[Element, float], ...]:
        """Voltage sources in the loop, each with the sign of its voltage in the sum U."""
        return tuple((h.element, -h.sign) for h in self.hops if h.element.device == "V")

    @cached_property
    def first_cell(self) -> NDArray[np.intp]:
        """Index of the first cell of each layer."""
        return np.concatenate([[0], np.cumsum(self.cells)[:-1]]).astype(np.intp)

    def layers_of(self, cells: NDArray[np.bool_]) -> list[str]:
        """Names of the layers that have at least one marked cell."""
        return list(dict.fromkeys(self.layers[i].name for i in self.layer_of[cells].tolist()))

    @cached_property
    def s(self) -> float:
        """Sum of 1/c over the cells, m^2/F."""
        return float(np.sum(1.0 / self.c))

    @cached_property
    def k(self) -> FloatArray:
        """Fraction of a jump of U that each cell takes, shape (n_cell,)."""
        return np.asarray(1.0 / (self.c * self.s))

    @cached_property
    def waveform(self) -> Waveform:
        """Voltage around the loop: the sum of the sources with their signs."""
        # A source of 0 V only serves to measure a current.
        waves = [(e.waveform, sign) for e, sign in self.sources if e.waveform not in (None, OFF)]
        parts = tuple(wave if sign > 0 else Product((DC(-1.0), wave)) for wave, sign in waves if wave is not None)
        return Sum(parts) if len(parts) > 1 else parts[0] if parts else OFF

    @cached_property
    def state_order(self) -> tuple[int, ...]:
        """Cells in the order of the states; the last one has no state, as its voltage is the source's less all others.

        It is never the gap (unless the gap is the only cell), so that the gap voltage is a state of its own.
        """
        left_out = next((i for i in reversed(range(self.c.size)) if i != self.gap), 0)
        return (*(i for i in range(self.c.size) if i != left_out), left_out)

    @property
    def by_layer(self) -> Stack:
        """The stack with each layer as one capacitor without leak: its voltages are those that a run records."""
        if len(self.layers) == self.c.size:
            return self
        c, none = 1.0 / np.add.reduceat(1.0 / self.c, self.first_cell), np.zeros(len(self.layers))
        one, sign = (1,) * len(self.layers), self.sign[self.first_cell]
        return replace(self, cells=one, sign=sign, c=c, g_total=none, g_area=none, gap=self.gap_layer, kept={})

    @cached_property
    def grouping(self) -> FloatArray:
        """Matrix of 0 and 1 from live cells to recorded layers, shape (n_layer - 1, n_cell - 1)."""
        layers = np.array(self.by_layer.state_order[:-1], int)
        return np.asarray(layers[:, None] == self.layer_of[np.array(self.state_order[:-1], int)], float)

    @cached_property
    def layer_of(self) -> NDArray[np.intp]:
        """Index of the layer that each cell is part of."""
        return np.repeat(np.arange(len(self.cells)), self.cells)

    def leak_rates(self, area: float) -> FloatArray:
        """Leak rate of each cell, g/c, at an area (m^2), 1/s, shape (n_cell,)."""
        return np.asarray((self.g_total / area + self.g_area) / self.c)


def layer_constants(layer: Element, skin_at: float | None = None) -> FloatArray:
    """c (F/m^2), total leakage (S) and leakage per area (S/m^2) of a layer's cells, shape (n_cell, 3).

    With `skin_at` (Hz) a dispersive skin is one cell with its data at that frequency.
    """
    cells = layer.spec.cells
    assert cells is not None
    return layer.remember(("cells", skin_at), lambda: cells(layer.values, skin_at))


#: Units of contacts in mm, over those in m; that of beta, mm^(2 - n), depends on another parameter.
_IN_MM = {"mm^2": 1e-6, "mm^2/N": 1e-6, "mm^2/N^m": 1e-6, "mm^4/N^2": 1e-12}


def in_si(gap: Element, values: Mapping[str, Any]) -> dict[str, Any]:
    """Values of a GAP's parameters, numbers or arrays, in SI units; here, and nowhere else, mm are converted to m."""
    v = {p.name: values[p.name] * _IN_MM.get(p.unit, 1.0) for p in gap.spec.parameters}
    if "beta" in v:
        v["beta"] = values["beta"] * 1e-6 * 1e3 ** v.get("n_exp", 0.0)
    return v


def contact_of(gap: Element) -> Contact:
    """The contact of a GAP."""

    def make() -> Contact:
        # A product may overflow, or a logarithm be taken of one that underflows.
        with suppress(ArithmeticError, ValueError):
            v = in_si(gap, gap.values)
            if (law := acting_law(gap)) is not None:
                return law.contact(v)
            names = ("d", "eps_r", "fn", "mu", "alpha", "m_exp", "beta", "n_exp", "c2")
            contact = JkrContact(*(v[name] for name in names))
            if np.all(np.isfinite(contact.packed)):
                return contact
        what = f"{gap.name} has a contact whose constants are beyond the range of numbers"
        raise InputError(f"{what}; allowed: fn, alpha, m_exp, beta, n_exp nearer to Table 1's", gap.where)

    return gap.remember(("contact",), make)


def build_stack(circuit: Circuit, skin_at: float | None = None) -> Stack:
    """The series stack of a circuit; with `skin_at`, dispersive skins have their data at that frequency (Hz).

    If the deck holds the total voltage in Eq. 7, the contact uses the stack's capacitances alone: a dispersive skin
    enters with eps_inf, its permittivity above all poles, or with its permittivity at `skin_at`. A circuit that is no
    series stack is refused.
    """

    def build(hops: tuple[Hop, ...], area: Area) -> Stack:
        along = [hop for hop in hops if hop.element.spec.is_layer]
        layers = tuple(hop.element for hop in along)
        parts = [layer_constants(e, skin_at) for e in layers]
        cells = tuple(map(len, parts))
        c, g_total, g_area = np.concatenate(parts).T
        contact, gap, gap_layer = None, None, None
        if area.gap is not None:
            contact, gap_layer = contact_of(area.gap), layers.index(area.gap)
            gap = sum(cells[:gap_layer])
            if circuit.work == "total":
                if not isinstance(contact, JkrContact):
                    needed = f"work=total (Eq. 7) needs the paper's contact law, and {area.gap.name} has another"
                    raise InputError(f"{needed}; allowed: law=jkr, or work=gap", area.gap.where)
                d = np.repeat([e.values["d"] for e in layers], cells)
                contact = contact.with_total_voltage_held(d, c * d / EPS0)
        sign = np.repeat([hop.sign for hop in along], cells)
        return Stack(layers, cells, sign, c, g_total, g_area, gap, gap_layer, contact, area.given, hops)

    def make() -> Stack:
        loop = loop_of(circuit)
        if loop is None:
            needed = "this needs a series chain of LAYER, SLAB, SKIN and GAP driven by V sources"
            allowed = "for any network: simulate (run), plan, phasor (ac) and export"
            raise InputError(f"{needed}, and the circuit is another network; allowed {allowed}")
        found = shared(circuit, ("stack", skin_at, circuit.work), lambda: build(*loop))
        return found if found.hops is loop[0] else replace(found, hops=loop[0])

    return circuit.remember(("stack", skin_at), make)
