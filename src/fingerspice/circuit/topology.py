"""The series loop of a circuit, found by node incidence, and the refusals of what is not one."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass

from fingerspice.circuit.circuit import Circuit, Element
from fingerspice.circuit.waveforms import DC
from fingerspice.errors import InputError


@dataclass(frozen=True)
class Hop:
    """One element of the loop as walked from ground: `sign` is +1 where it is met p first."""

    element: Element
    sign: float
    node: str
    """Node reached, as written."""


@dataclass(frozen=True)
class Loop:
    """A series loop of sources and layers from ground back to ground, and what gives its area."""

    hops: tuple[Hop, ...]
    gap: Element | None
    area_given: float | None
    """m^2, from a DC source on the area node or the gap's a_fix."""


def find_loop(circuit: Circuit) -> Loop:
    """The loop of a circuit.

    Raises
    ------
    InputError
        Naming the elements or nodes at fault.
    """
    if not circuit.by_device("V", "I"):
        raise InputError(
            "the circuit has no source; allowed: a V element that drives the stack, such as V1 drive 0 SIN(0 200 100)"
        )
    gap, area_given, area_source = _area(circuit)
    branches = [e for e in circuit.elements if e is not area_source]
    _refuse_floating(branches)
    _refuse_source_conflicts(branches)
    _refuse_unsupported(branches)
    return Loop(_walk(branches), gap, area_given)


def _area(circuit: Circuit) -> tuple[Element | None, float | None, Element | None]:
    """The gap, the area its deck fixes (m^2), and the source on the area node where there is no gap."""
    layers = [e for e in circuit.elements if e.spec.is_layer]
    if not layers:
        raise InputError("the circuit has no layer; allowed: LAYER, SLAB, SKIN and GAP between two nodes")
    gaps = [e for e in layers if e.device == "GAP"]
    owners: dict[str, Element] = {}
    for gap in gaps:
        node = gap.nodes[2]
        if node in owners:
            raise InputError(
                f"{owners[node].name} and {gap.name} both drive the area node {gap.node_names[2]!r}; allowed: "
                "one GAP per area",
                gap.where,
            )
        owners[node] = gap
    if len(gaps) > 1:
        names = " and ".join(g.name for g in gaps)
        raise InputError(f"{names}: circuits with several gaps are not solved by this version", gaps[1].where)
    nodes = {e.nodes[2]: e for e in layers}
    stray = [e for e in layers if e.nodes[2] not in owners] if gaps else []
    if stray:
        e = stray[0]
        raise InputError(
            f"{e.name} takes its area from node {e.node_names[2]!r}, which no GAP drives; {gaps[0].name} drives "
            f"{gaps[0].node_names[2]!r}",
            e.where,
        )
    on_area = [e for e in circuit.by_device("V") if set(e.nodes) & set(nodes)]
    if gaps:
        if on_area:
            raise InputError(
                f"{on_area[0].name} and {gaps[0].name} both drive the area node {gaps[0].node_names[2]!r}",
                on_area[0].where,
            )
        a_fix = gaps[0].values["a_fix"]
        return gaps[0], (a_fix * 1e-6 if a_fix > 0.0 else None), None
    return None, *_area_from_source(layers, on_area)


def _area_from_source(layers: list[Element], sources: list[Element]) -> tuple[float, Element]:
    first = layers[0]
    if len({e.nodes[2] for e in layers}) > 1:
        raise InputError("the layers of a loop must share one area node", layers[1].where)
    if len(sources) != 1:
        raise InputError(
            f"node {first.node_names[2]!r} gives {first.name} its area, but "
            + ("no GAP and no DC source drives it" if not sources else "more than one source drives it")
            + f"; allowed: one GAP, or one V element such as 'Varea {first.node_names[2]} 0 35' (mm^2)",
            first.where,
        )
    source = sources[0]
    if not isinstance(source.waveform, DC) or source.nodes[1] != "0" or not source.waveform.level > 0.0:
        raise InputError(
            f"{source.name} drives an area: allowed is a DC value above 0 (mm^2) from the area node to 0",
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


def _refuse_floating(branches: list[Element]) -> None:
    at = _incidence(branches)
    for element in branches:
        if element.nodes[0] == element.nodes[1]:
            raise InputError(f"{element.name} has both ends on node {element.node_names[0]!r}", element.where)
    # Ground last: a chain that misses it dangles at its own end too, and that is the node to name.
    for node, elements in sorted(at.items(), key=lambda item: item[0] == "0"):
        if len(elements) == 1:
            e = elements[0]
            raise InputError(
                f"node {_as_written(node, e)!r} is floating: only {e.name} touches it; allowed: two or more elements "
                "at every node",
                e.where,
            )
    if "0" not in at:
        raise InputError("no element touches ground; allowed: one node must be 0 (or gnd)")
    reached, todo = {"0"}, ["0"]
    while todo:
        for element in at[todo.pop()]:
            for node in element.nodes[:2]:
                if node not in reached:
                    reached.add(node)
                    todo.append(node)
    for node, elements in at.items():
        if node not in reached:
            e = elements[0]
            raise InputError(
                f"node {_as_written(node, e)!r} ({e.name}) is floating: nothing connects it to ground",
                e.where,
            )


def _refuse_source_conflicts(branches: list[Element]) -> None:
    pairs: dict[frozenset[str], Element] = {}
    parent: dict[str, str] = {}

    def root(node: str) -> str:
        while parent.setdefault(node, node) != node:
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
            raise InputError(f"{element.name} closes a loop of voltage sources", element.where)
        parent[a] = b


def _refuse_unsupported(branches: list[Element]) -> None:
    shape = "solved here is a series chain of LAYER, SLAB, SKIN and GAP driven by V sources"
    for element in branches:
        if element.device in ("R", "C", "I"):
            raise InputError(
                f"{element.name}: {element.device} elements are read, but not solved by this version; {shape}",
                element.where,
            )
    for node, elements in _incidence(branches).items():
        if len(elements) > 2:
            names = ", ".join(e.name for e in elements)
            raise InputError(
                f"node {_as_written(node, elements[0])!r} joins {len(elements)} elements ({names}); {shape}",
                elements[2].where,
            )


def _walk(branches: list[Element]) -> tuple[Hop, ...]:
    """Walk the loop from ground, in the direction that meets the first source n first."""
    at = _incidence(branches)
    for start in at["0"]:
        hops: list[Hop] = []
        node, element = "0", start
        while True:
            forward = element.nodes[0] == node
            node = element.nodes[1] if forward else element.nodes[0]
            hops.append(Hop(element, 1.0 if forward else -1.0, element.node_names[1 if forward else 0]))
            if node == "0":
                break
            element = next(e for e in at[node] if e is not element)
        first = next((h for h in hops if h.element.device == "V"), None)
        if first is not None and first.sign < 0.0:
            return tuple(hops)
    if first is None:
        raise InputError("the loop has no voltage source")
    return tuple(hops)
