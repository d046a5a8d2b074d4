"""Places of a circuit's elements in its schematic: nodes are rows, elements stand in columns between them.

A series stack becomes a ladder beside its source by the same rules as any network does.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from fingerspice.circuit.circuit import Circuit, Element

GROUND = "0"
Rows = Mapping[str, int]
Extent = tuple[int, int]


@dataclass(frozen=True)
class Place:
    """Where one element stands."""

    element: Element
    column: int
    # top, bottom: Rows of its upper and its lower node
    top: int
    bottom: int
    upright: bool  # Whether its first node is the upper one

    @property
    def gap(self) -> int:
        """The row below which the symbol stands, above the next one."""
        return (self.top + self.bottom - 1) // 2


@dataclass(frozen=True)
class Placement:
    """Places of all elements, the row of every node, and its first and last column."""

    places: tuple[Place, ...]
    rows: Rows
    extents: Mapping[str, Extent]


def place(circuit: Circuit) -> Placement:
    """Places in which no two elements, and no two nodes, meet."""
    level = _levels(circuit)
    order = list(_in_order(circuit, level))
    found = _columns(order, level)
    if found is None:
        # Nodes that cannot share a row get one each, and then every element has room in a new column.
        single = {node: row for row, node in enumerate(sorted(level, key=lambda node: level[node]))}
        found = _columns(order, single)
    assert found is not None
    return found


def _levels(circuit: Circuit) -> dict[str, int]:
    """Level of every node below the driven ones, ground the last; the nodes of an element have different levels."""
    nodes = list(dict.fromkeys(node for e in circuit.elements for node in e.nodes[:2]))
    number = {node: k for k, node in enumerate(nodes)}
    # With sources of 1 A and 1 ohm in place of every element, potentials fall from the driven nodes to ground.
    matrix, driven = np.zeros((len(nodes), len(nodes))), np.zeros(len(nodes))
    for e in circuit.elements:
        p, n = number[e.nodes[0]], number[e.nodes[1]]
        matrix[[p, n], [p, n]] += 1.0
        matrix[[p, n], [n, p]] -= 1.0
        sign = {"V": 1.0, "I": -1.0}.get(e.device, 0.0)
        driven[p] += sign
        driven[n] -= sign
    potential = np.linalg.lstsq(matrix, driven, rcond=None)[0].round(9)
    falling = sorted(nodes, key=lambda node: (node == GROUND, -potential[number[node]], number[node]))
    rank = {node: k for k, node in enumerate(falling)}
    above: dict[str, set[str]] = {node: set() for node in nodes}
    for e in circuit.elements:
        upper, lower = sorted(e.nodes[:2], key=lambda node: rank[node])
        above[lower].add(upper)
    level: dict[str, int] = {}
    for node in falling:
        level[node] = max((level[other] + 1 for other in above[node]), default=0)
    # `falling` has ground last, so that no other node's level depends on it.
    level[GROUND] = 1 + max(level[node] for node in nodes if node != GROUND)
    return level


def _in_order(circuit: Circuit, level: Rows) -> Iterator[tuple[Element, Element | None]]:
    """Elements in the order in which they get places, each with the one above it: sources, then chain by chain."""
    areas = {node for e in circuit.elements if e.spec.is_layer for node in e.nodes[2:]}
    fixing = [e for e in circuit.by_device("V", "I") if areas & set(e.nodes[:2])]
    sources = [e for e in circuit.by_device("V", "I") if e not in fixing]
    yield from ((e, None) for e in sources)
    below: dict[str, list[Element]] = {}
    for e in circuit.elements:
        if e.device not in "VI":
            below.setdefault(min(e.nodes[:2], key=lambda node: level[node]), []).append(e)
    for node in sorted(below, key=lambda node: level[node]):
        waiting: list[tuple[Element, Element | None]] = [(e, None) for e in reversed(below.pop(node, []))]
        while waiting:
            e, before = waiting.pop()
            yield e, before
            lower = max(e.nodes[:2], key=lambda node: level[node])
            waiting += [(other, e) for other in reversed(below.pop(lower, []))]
    yield from ((e, None) for e in fixing)


def _columns(order: Sequence[tuple[Element, Element | None]], rows: Rows) -> Placement | None:
    """Each element in the first column with room for it; None if nodes of one row would meet."""
    places: dict[str, Place] = {}
    taken: list[list[Place]] = []
    extents: dict[str, Extent] = {}
    for element, before in order:
        ends = element.nodes[:2]
        top, bottom = sorted(rows[node] for node in ends)
        preferred = [places[before.name].column] if before is not None else []
        for column in (*preferred, *range(len(taken) + 1)):
            room = column == len(taken) or all(p.bottom <= top or p.top >= bottom for p in taken[column])
            so_far = {node: extents.get(node, (column, column)) for node in ends}
            wider = {node: (min(lo, column), max(hi, column)) for node, (lo, hi) in so_far.items()}
            after = {**extents, **wider}
            if room and not any(
                rows[node] == rows[other] and node != other and lo <= after[other][1] and after[other][0] <= hi
                for node, (lo, hi) in wider.items()
                for other in after
            ):
                break
        else:
            return None
        if column == len(taken):
            taken.append([])
        upright = rows[ends[0]] < rows[ends[1]]
        places[element.name] = Place(element, column, top, bottom, upright)
        taken[column].append(places[element.name])
        extents = after
    return Placement(tuple(places.values()), rows, extents)
