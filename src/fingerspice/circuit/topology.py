"""Topology of a circuit: its areas, its series loop if it is one, and checks that it is a solvable network."""

from __future__ import annotations

import operator
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass
from difflib import get_close_matches
from types import MappingProxyType
from typing import Any

import numpy as np

from fingerspice.base.arrays import FloatArray
from fingerspice.base.errors import InputError
from fingerspice.circuit.circuit import Circuit, Element, T
from fingerspice.physics.materials import SKIN_LADDER
from fingerspice.waveforms.waveform import DC

#: Largest number of elements of a circuit, because every matrix of a network is dense.
MAX_ELEMENTS = 2000
#: Number of slabs of a dispersive skin.
SLABS = len(SKIN_LADDER.poles) + 1
_GROUNDS = ("gnd", "ground", "earth", "vss")


@dataclass(frozen=True)
class Hop:
    """One element on the way round the loop from ground; `sign` is +1 if its p node comes first."""

    element: Element
    sign: float
    node: str  # Name, as written, of the node after the element


@dataclass(frozen=True)
class Area:
    """A contact area of a circuit, with the GAP or the value that determines it."""

    node: str  # Canonical name of the area node
    gap: Element | None  # The GAP that drives it
    given: float | None  # m^2, from a DC source on the node or the gap's a_fix


def find_branches(circuit: Circuit) -> tuple[tuple[Area, ...], list[Element]]:
    """Areas of a circuit, and the elements that carry current; a circuit that has no solution is refused."""
    count = count_of(circuit)
    if count > MAX_ELEMENTS:
        counted = f", a SKIN_DISPERSIVE counted as its {SLABS} slabs" if count > len(circuit.elements) else ""
        raise InputError(f"the circuit has {count:,} elements{counted}; allowed: at most {MAX_ELEMENTS:,}")
    areas, drives = _areas(circuit), {e.name for e in driving(circuit)}
    branches = [e for e in circuit.elements if e.device not in "VI" or e.name in drives]
    if not drives:
        if not circuit.initial and all(e.initial is None for e in branches):
            raise InputError(
                "the circuit has no source; allowed: a V element that drives the stack, such as V1 drive 0 "
                "SIN(0 200 100), or a start, IC= of a capacitor or .ic v(node)="
            )
        # In place of a source, one of 0 A.
        nodes, names = branches[0].nodes[1::-1], branches[0].node_names[1::-1]
        branches.append(Element("none", "I", nodes, names, MappingProxyType({}), DC(0.0)))
    _refuse_floating(branches)
    _refuse_source_conflicts(branches)
    _refuse_current_without_path(branches)
    return areas, branches


def driving(circuit: Circuit) -> list[Element]:
    """The V and I elements that do not give an area, of any circuit."""
    areas = {e.nodes[2] for e in circuit.elements if e.spec.is_layer}
    return [e for e in circuit.by_device("V", "I") if areas.isdisjoint(e.nodes)]


def driving_sources(circuit: Circuit) -> list[Element]:
    """As `driving`, of a circuit that `find_branches` does not refuse."""
    if "solvable" not in circuit.related:
        find_branches(circuit)
        circuit.related["solvable"] = True
    return driving(circuit)


def shared(circuit: Circuit, key: Any, make: Callable[[], T]) -> T:
    """The result of `make`, kept for all related circuits that differ in the sources that carry current only."""
    drives = {e.name for e in driving(circuit)}
    passive = [e for e in circuit.elements if e.name not in drives]
    before, found = circuit.related.get(key, (None, None))
    if before is None or not all(map(operator.is_, before, passive)):
        circuit.related[key] = passive, (found := make())
    kept: T = found
    return kept


def loop_of(circuit: Circuit) -> tuple[tuple[Hop, ...], Area] | None:
    """The hops and the area of a circuit that is one series loop of sources and layers, from ground back to ground.

    None for any other circuit, and for an area that follows with delay. All circuits that `Circuit.replace` derives
    from one another share the way round the loop.
    """

    def make() -> tuple[tuple[Hop, ...], Area] | None:
        if "hops" not in circuit.related:
            circuit.related["hops"] = _find_hops(circuit)
        walked: tuple[Hop, ...] | None = circuit.related["hops"]
        if walked is None:
            return None
        (area,) = _areas(circuit)
        if area.gap is not None and area.gap.values["tau"] > 0.0 and area.given is None:
            return None
        now = {e.name: e for e in circuit.elements}
        return tuple(Hop(now[hop.element.name], hop.sign, hop.node) for hop in walked), area

    return circuit.remember("loop", make)


def _find_hops(circuit: Circuit) -> tuple[Hop, ...] | None:
    """The loop in the direction in which the n node of the first source comes before its p node."""
    areas, branches = find_branches(circuit)
    at = _incidence(branches)
    of_stacks = all(e.device == "V" or e.spec.is_layer for e in branches)
    if len(areas) != 1 or not of_stacks or max(map(len, at.values())) > 2:
        return None
    walks = []
    for start in at["0"]:
        hops, node, element = list[Hop](), "0", start
        while not hops or node != "0":
            if hops:
                element = next(e for e in at[node] if e is not element)
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
    """Number of elements of a circuit, each dispersive skin counted as its slabs."""
    return len(circuit.elements) + (SLABS - 1) * len(circuit.by_device("SKIN_DISPERSIVE"))


def _areas(circuit: Circuit) -> tuple[Area, ...]:
    layers = [e for e in circuit.elements if e.spec.is_layer]
    owners: dict[str, Element] = {}
    for gap in circuit.by_device("GAP"):
        node = gap.nodes[2]
        if node in owners:
            both = f"{owners[node].name} and {gap.name} both drive the area node {gap.node_names[2]!r}"
            raise InputError(f"{both}; allowed: one GAP per area", gap.where)
        owners[node] = gap
    at = _incidence(list(circuit.by_device("V", "I", "R", "C")))
    out = []
    for node, layer in {e.nodes[2]: e for e in reversed(layers)}.items():
        on_node = list({id(e): e for e in at.get(node, ())}.values())
        owner = owners.get(node)
        if owner is None:
            out.append(Area(node, None, _given_by_source(layer, on_node, list(owners.values()))))
            continue
        if on_node:
            raise InputError(
                f"{on_node[0].name} and {owner.name} both drive the area node {owner.node_names[2]!r}, which is a "
                f"signal; allowed: a_fix= on {owner.name} for a given area, another node for what carries current",
                on_node[0].where,
            )
        fixed = owner.values["a_fix"]
        out.append(Area(node, owner, fixed * 1e-6 if fixed > 0.0 else None))
    return tuple(reversed(out))


def _given_by_source(layer: Element, sources: list[Element], gaps: list[Element]) -> float:
    if len(sources) != 1:
        what = f"node {layer.node_names[2]!r} gives {layer.name} its area, but "
        what += "more than one source drives it" if sources else "no GAP and no DC source drives it"
        allowed = f"one GAP, or one V element such as 'Varea {layer.node_names[2]} 0 35' (mm^2)"
        driven = "".join(f"; {gap.name} drives {gap.node_names[2]!r}" for gap in gaps)
        raise InputError(f"{what}; allowed: {allowed}{driven}", layer.where)
    source = sources[0]
    if not isinstance(source.waveform, DC) or source.nodes[1] != "0" or not 1e-30 <= source.waveform.level <= 1e30:
        allowed = "allowed is a DC value above 0 (mm^2, from 1e-30 to 1e30) from the area node to 0"
        raise InputError(f"{source.name} drives an area: {allowed}", source.where)
    return source.waveform.level * 1e-6


def _incidence(branches: list[Element]) -> dict[str, list[Element]]:
    at: dict[str, list[Element]] = defaultdict(list)
    for element in branches:
        for node in element.nodes[:2]:
            at[node].append(element)
    return at


def _as_written(node: str, element: Element) -> str:
    return element.node_names[element.nodes.index(node)]


def _ways(branches: list[Element], start: str) -> dict[str, Element | None]:
    """The element by which one gets to each node that is connected to the start."""
    at = _incidence(branches)
    came: dict[str, Element | None] = {start: None}
    ahead = [start]
    while ahead:
        for element in at.get(ahead.pop(), ()):
            for node in element.nodes[:2]:
                if node not in came:
                    came[node] = element
                    ahead.append(node)
    return came


def _refuse_floating(branches: list[Element]) -> None:
    at = _incidence(branches)
    for element in branches:
        if element.nodes[0] == element.nodes[1]:
            raise InputError(f"{element.name} has both ends on node {element.node_names[0]!r}", element.where)
    # Ground comes last: a chain not connected to ground also has a free end elsewhere, which is the node to name.
    for node, elements in sorted(at.items(), key=lambda item: item[0] == "0"):
        if len(elements) == 1:
            e = elements[0]
            # Ground under another name, or a node of which this one may be a misspelling
            near = get_close_matches(node, [other for other in at if other not in (node, "0")], 1, 0.7)
            hint = f"; is {_as_written(near[0], at[near[0]][0])!r} the same node?" if near else ""
            hint = "; ground is 0 or gnd" if node.startswith(_GROUNDS) else hint
            alone = f"node {_as_written(node, e)!r} is floating: only {e.name} touches it"
            raise InputError(f"{alone}; allowed: two or more elements at every node{hint}", e.where)
    if "0" not in at:
        raise InputError("no element touches ground; allowed: one node must be 0 (or gnd)")
    reached = _ways(branches, "0")
    for node, elements in at.items():
        if node not in reached:
            what = f"node {_as_written(node, elements[0])!r} ({elements[0].name})"
            raise InputError(f"{what} is floating: nothing connects it to ground", elements[0].where)


class Tree:
    """A spanning tree that grows branch by branch."""

    def __init__(self) -> None:
        self._parent: dict[str, str] = {}
        # Of each node its branches: the other node, the branch's number, and the sign of its voltage from here
        self.branches: dict[str, list[tuple[str, int, float]]] = defaultdict(list)
        self._count = 0

    def _root(self, node: str) -> str:
        while self._parent.setdefault(node, node) != node:
            self._parent[node] = self._parent[self._parent[node]]
            node = self._parent[node]
        return node

    def add(self, p: str, n: str) -> bool:
        """Add a branch if it closes no loop, and return whether it was added."""
        a, b = self._root(p), self._root(n)
        if a == b:
            return False
        self._parent[a] = b
        self.branches[p].append((n, self._count, -1.0))
        self.branches[n].append((p, self._count, 1.0))
        self._count += 1
        return True

    def potentials(self) -> dict[str, FloatArray]:
        """Voltage of every node against ground, as a row of coefficients of the branch voltages."""
        out = {"0": np.zeros(self._count)}
        todo = ["0"]
        while todo:
            node = todo.pop()
            for other, branch, sign in self.branches[node]:
                if other not in out:
                    out[other] = out[node].copy()
                    out[other][branch] = sign
                    todo.append(other)
        return out


def _refuse_source_conflicts(branches: list[Element]) -> None:
    tree, before = Tree(), list[Element]()
    for element in (e for e in branches if e.device == "V"):
        if tree.add(*element.nodes[:2]):
            before.append(element)
            continue
        # The sources before form no loop: there is one way through them from one end to the other.
        came, others, node = _ways(before, element.nodes[0]), list[str](), element.nodes[1]
        while (step := came[node]) is not None:
            others.append(step.name)
            node = step.nodes[0] if step.nodes[1] == node else step.nodes[1]
        if len(others) == 1:
            raise InputError(f"{others[0]} and {element.name} are voltage sources in parallel", element.where)
        raise InputError(f"{element.name} closes a loop of voltage sources with {', '.join(others)}", element.where)


def _refuse_current_without_path(branches: list[Element]) -> None:
    """Refuse a current source at a node that is connected to ground through current sources only."""
    reached = _ways([e for e in branches if e.device != "I"], "0")
    for element in branches:
        for node in element.nodes[:2]:
            if element.device == "I" and node not in reached:
                where = f"node {_as_written(node, element)!r} is reached through current sources only"
                allowed = "an R, C or layer that takes the current to ground"
                problem = f"{element.name} is a current source without a path: {where}; allowed: {allowed}"
                raise InputError(problem, element.where)
