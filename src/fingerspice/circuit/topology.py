"""Topology of a circuit: its areas, its series loop if it is one, and checks that it is a solvable network."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from types import MappingProxyType

from fingerspice.base.errors import InputError
from fingerspice.circuit.circuit import Circuit, Element
from fingerspice.physics.ladder import SKIN_LADDER
from fingerspice.waveforms.waveform import DC

#: Largest number of elements of a circuit, because every matrix of a network is dense.
MAX_ELEMENTS = 2000
_GROUNDS = ("gnd", "ground", "earth", "vss")


@dataclass(frozen=True)
class Hop:
    """One element on the way round the loop from ground; `sign` is +1 if its p node comes first."""

    element: Element
    sign: float
    node: str
    """Name, as written, of the node after the element."""


@dataclass(frozen=True)
class Area:
    """A contact area of a circuit, with the GAP or the value that determines it."""

    node: str  # Canonical name of the area node
    gap: Element | None  # The GAP that drives it
    given: float | None  # m^2, from a DC source on the node or the gap's a_fix
    source: Element | None = None  # The DC source that gives the area, or None


@dataclass(frozen=True)
class Loop:
    """A series loop of sources and layers from ground back to ground, with the GAP or the value that gives its area."""

    hops: tuple[Hop, ...]
    gap: Element | None
    area_given: float | None
    """m^2, from a DC source on the area node or the gap's a_fix."""


def find_branches(circuit: Circuit) -> tuple[tuple[Area, ...], list[Element]]:
    """Areas of a circuit, and the elements that carry current.

    Raises
    ------
    InputError
        If there is neither source nor start, a floating node, a loop of voltage sources, a current source without a
        path, an area that no element or several elements drive, or too many elements; the message names those at fault.
    """
    _refuse_large(circuit)
    areas = _areas(circuit)
    on_areas = {id(area.source) for area in areas}
    branches = [e for e in circuit.elements if id(e) not in on_areas]
    if not any(e.device in "VI" for e in branches):
        if not circuit.initial and all(e.initial is None for e in branches):
            raise InputError(
                "the circuit has no source; allowed: a V element that drives the stack, such as V1 drive 0 "
                "SIN(0 200 100), or a start, IC= of a capacitor or .ic v(node)="
            )
        branches.append(_no_source(branches[0]))
    _refuse_floating(branches)
    _refuse_source_conflicts(branches)
    _refuse_current_without_path(branches)
    return areas, branches


def _no_source(beside: Element) -> Element:
    """A source of 0 A, which a circuit that only its start drives has in place of a source."""
    return Element("none", "I", beside.nodes[1::-1], beside.node_names[1::-1], MappingProxyType({}), DC(0.0))


def driving_sources(circuit: Circuit) -> list[Element]:
    """The sources of a circuit that carry current.

    Raises
    ------
    InputError
        As `find_branches`.
    """
    if "driving" not in circuit.related:
        circuit.related["driving"] = {e.name for e in find_branches(circuit)[1] if e.device in "VI"}
    return [e for e in circuit.elements if e.name in circuit.related["driving"]]


def find_loop(circuit: Circuit) -> Loop | None:
    """The loop of a circuit that consists of one series loop with one area; None for any other network.

    Raises
    ------
    InputError
        As `find_branches`.
    """
    areas, branches = find_branches(circuit)
    if len(areas) != 1 or any(e.device != "V" and not e.spec.is_layer for e in branches):
        return None
    if any(len(elements) > 2 for elements in _incidence(branches).values()):
        return None
    return Loop(_walk(branches), areas[0].gap, areas[0].given)


def same_loop(circuit: Circuit, before: Loop) -> Loop | None:
    """The loop of a circuit whose devices and nodes are those of a related circuit with a known loop.

    None if the area follows with a delay (tau > 0): such a circuit is not solved as a stack.

    Raises
    ------
    InputError
        If an area has no valid drive, as in `find_branches`.
    """
    now = {e.name: e for e in circuit.elements}
    gap = None if before.gap is None else now[before.gap.name]
    given = _areas(circuit)[0].given if gap is None else _area_fixed(gap)
    if gap is not None and gap.values["tau"] > 0.0 and given is None:
        return None
    return Loop(tuple(Hop(now[hop.element.name], hop.sign, hop.node) for hop in before.hops), gap, given)


def _refuse_large(circuit: Circuit) -> None:
    skins = len(circuit.by_device("SKIN_DISPERSIVE"))
    more = len(SKIN_LADDER.poles)
    count = len(circuit.elements) + skins * more
    if count > MAX_ELEMENTS:
        counted = f", a SKIN_DISPERSIVE counted as its {more + 1} slabs" if skins else ""
        raise InputError(f"the circuit has {count:,} elements{counted}; allowed: at most {MAX_ELEMENTS:,}")


def _areas(circuit: Circuit) -> tuple[Area, ...]:
    layers = [e for e in circuit.elements if e.spec.is_layer]
    owners: dict[str, Element] = {}
    for gap in circuit.by_device("GAP"):
        node = gap.nodes[2]
        if node in owners:
            raise InputError(
                f"{owners[node].name} and {gap.name} both drive the area node {gap.node_names[2]!r}; allowed: "
                "one GAP per area",
                gap.where,
            )
        owners[node] = gap
    at = _incidence(list(circuit.by_device("V", "I", "R", "C")))
    out = []
    for node, layer in {e.nodes[2]: e for e in reversed(layers)}.items():
        on_node = list({id(e): e for e in at.get(node, ())}.values())
        owner = owners.get(node)
        if owner is None:
            out.append(Area(node, None, *_given_by_source(layer, on_node, list(owners.values()))))
            continue
        if on_node:
            raise InputError(
                f"{on_node[0].name} and {owner.name} both drive the area node {owner.node_names[2]!r}, which is a "
                f"signal; allowed: a_fix= on {owner.name} for a given area, another node for what carries current",
                on_node[0].where,
            )
        out.append(Area(node, owner, _area_fixed(owner)))
    return tuple(reversed(out))


def _area_fixed(gap: Element) -> float | None:
    """The fixed area of a GAP, a_fix in m^2, or None."""
    a_fix = gap.values["a_fix"]
    return a_fix * 1e-6 if a_fix > 0.0 else None


def _given_by_source(layer: Element, sources: list[Element], gaps: list[Element]) -> tuple[float, Element]:
    if len(sources) != 1:
        driven = "".join(f"; {gap.name} drives {gap.node_names[2]!r}" for gap in gaps)
        raise InputError(
            f"node {layer.node_names[2]!r} gives {layer.name} its area, but "
            + ("no GAP and no DC source drives it" if not sources else "more than one source drives it")
            + f"; allowed: one GAP, or one V element such as 'Varea {layer.node_names[2]} 0 35' (mm^2){driven}",
            layer.where,
        )
    source = sources[0]
    if not isinstance(source.waveform, DC) or source.nodes[1] != "0" or not 1e-30 <= source.waveform.level <= 1e30:
        raise InputError(
            f"{source.name} drives an area: allowed is a DC value above 0 (mm^2, from 1e-30 to 1e30) from the area "
            "node to 0",
            source.where,
        )
    return source.waveform.level * 1e-6, source


def _incidence(branches: list[Element]) -> dict[str, list[Element]]:
    at: dict[str, list[Element]] = defaultdict(list)
    for element in branches:
        for node in element.nodes[:2]:
            at[node].append(element)
    return at


def _as_written(node: str, element: Element) -> str:
    return element.node_names[element.nodes.index(node)]


def _reached(at: dict[str, list[Element]]) -> set[str]:
    """Nodes with a path of elements to ground."""
    reached, todo = {"0"}, ["0"]
    while todo:
        for element in at.get(todo.pop(), ()):
            new = set(element.nodes[:2]) - reached
            reached |= new
            todo += new
    return reached


def _refuse_floating(branches: list[Element]) -> None:
    at = _incidence(branches)
    for element in branches:
        if element.nodes[0] == element.nodes[1]:
            raise InputError(f"{element.name} has both ends on node {element.node_names[0]!r}", element.where)
    # Ground comes last: a chain not connected to ground also has a free end elsewhere, which is the node to name.
    for node, elements in sorted(at.items(), key=lambda item: item[0] == "0"):
        if len(elements) == 1:
            e = elements[0]
            raise InputError(
                f"node {_as_written(node, e)!r} is floating: only {e.name} touches it; allowed: two or more elements "
                f"at every node{_lookalike(node, at)}",
                e.where,
            )
    if "0" not in at:
        raise InputError("no element touches ground; allowed: one node must be 0 (or gnd)")
    reached = _reached(at)
    for node, elements in at.items():
        if node not in reached:
            e = elements[0]
            raise InputError(
                f"node {_as_written(node, e)!r} ({e.name}) is floating: nothing connects it to ground",
                e.where,
            )


def _lookalike(node: str, at: Mapping[str, list[Element]]) -> str:
    """Hint for the message: ground under another name, or a node of which this one may be a misspelling."""
    if node.startswith(_GROUNDS):
        return "; ground is 0 or gnd"
    near = get_close_matches(node, [other for other in at if other not in (node, "0")], 1, 0.7)
    return f"; is {_as_written(near[0], at[near[0]][0])!r} the same node?" if near else ""


def _refuse_source_conflicts(branches: list[Element]) -> None:
    pairs: dict[frozenset[str], Element] = {}
    parent: dict[str, str] = {}

    def root(node: str) -> str:
        while parent.setdefault(node, node) != node:
            parent[node] = parent[parent[node]]  # path halving, so that a long path is walked only once
            node = parent[node]
        return node

    for element in branches:
        if element.device != "V":
            continue
        pair = frozenset(element.nodes[:2])
        if pair in pairs:
            raise InputError(f"{pairs[pair].name} and {element.name} are voltage sources in parallel", element.where)
        pairs[pair] = element
        a, b = root(element.nodes[0]), root(element.nodes[1])
        if a == b:
            others = ", ".join(e.name for e in _path(list(pairs.values())[:-1], *element.nodes[:2]))
            raise InputError(f"{element.name} closes a loop of voltage sources with {others}", element.where)
        parent[a] = b


def _path(branches: list[Element], start: str, end: str) -> list[Element]:
    """The branches on the path from one node to another; the given branches form no loop, so the path is unique."""
    at = _incidence(branches)
    came: dict[str, Element | None] = {start: None}
    ahead = [start]
    while end not in came:
        node = ahead.pop()
        for e in at[node]:
            for other in e.nodes[:2]:
                if other not in came:
                    came[other] = e
                    ahead.append(other)
    found = []
    node = end
    while (step := came[node]) is not None:
        found.append(step)
        node = step.nodes[0] if step.nodes[1] == node else step.nodes[1]
    return found


def _refuse_current_without_path(branches: list[Element]) -> None:
    """Refuse a current source at a node that is connected to ground through current sources only."""
    reached = _reached(_incidence([e for e in branches if e.device != "I"]))
    for element in branches:
        for node in element.nodes[:2]:
            if element.device == "I" and node not in reached:
                raise InputError(
                    f"{element.name} is a current source without a path: node {_as_written(node, element)!r} is "
                    "reached through current sources only; allowed: an R, C or layer that takes the current to ground",
                    element.where,
                )


def _walk(branches: list[Element]) -> tuple[Hop, ...]:
    """The loop from ground, in the direction in which the n node of the first source comes before its p node."""
    at = _incidence(branches)
    walks = [_walk_from(start, at) for start in at["0"]]
    for hops in walks:
        if next(h for h in hops if h.element.device == "V").sign < 0.0:
            return hops
    # With opposed sources, the p node of the first source may come first in both directions: the deck's first source
    # then decides.
    deciding = next(e for e in branches if e.device == "V")
    return next(hops for hops in walks if any(h.element is deciding and h.sign < 0.0 for h in hops))


def _walk_from(start: Element, at: dict[str, list[Element]]) -> tuple[Hop, ...]:
    """The loop from ground, beginning with the given one of the two elements at ground."""
    hops: list[Hop] = []
    node, element = "0", start
    while True:
        forward = element.nodes[0] == node
        node = element.nodes[1] if forward else element.nodes[0]
        hops.append(Hop(element, 1.0 if forward else -1.0, element.node_names[1 if forward else 0]))
        if node == "0":
            return tuple(hops)
        element = next(e for e in at[node] if e is not element)
