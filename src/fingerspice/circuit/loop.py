"""The network of any circuit; the network of a series stack has one source, the voltage around the loop."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from types import MappingProxyType

import numpy as np

from fingerspice.base.arrays import FloatArray
from fingerspice.circuit.circuit import Circuit, Element
from fingerspice.circuit.network import Cell, Network, build_network
from fingerspice.circuit.statespace import Stack, build_stack, is_stack
from fingerspice.circuit.topology import Area, shared
from fingerspice.circuit.usual import check


def network_of(circuit: Circuit, skin_at: float | None = None) -> Network:
    """The network of a circuit; with `skin_at`, dispersive skins of a stack have their data at that frequency (Hz)."""
    if is_stack(circuit):
        return circuit.remember(("network", skin_at), lambda: _of_stack(circuit, skin_at))

    def make() -> Network:
        network = shared(circuit, "network", lambda: build_network(circuit))
        now = {e.name: e for e in circuit.elements}
        return replace(network, sources=tuple(now.get(e.name, e) for e in network.sources))

    return circuit.remember("network", make)


def checked(circuit: Circuit) -> Circuit:
    """The circuit, refused if a value is not allowed or it has no solution."""
    check(circuit)
    network_of(circuit)
    return circuit


def _of_stack(circuit: Circuit, skin_at: float | None) -> Network:
    stack = build_stack(circuit, skin_at)
    network = shared(circuit, ("loop network", skin_at), lambda: loop_network(stack))
    return network if network.stack is stack else replace(network, sources=(_source(stack),), stack=stack)


def _source(stack: Stack) -> Element:
    """The voltage around a stack's loop."""
    return Element("loop", "V", ("1", "0"), ("1", "0"), MappingProxyType({}), stack.waveform)


def loop_network(stack: Stack) -> Network:
    """The network of a stack, its cells in the order of `Stack.state_order`, with voltages from p to n."""
    order, n = list(stack.state_order), stack.c.size - 1
    of_layer, sign = stack.layer_of[order], stack.sign[order]
    constants = np.stack([stack.c, stack.g_total, stack.g_area], axis=1)[order].tolist()
    area = stack.area_given if stack.contact is None or stack.area_given else stack.contact.area_at_rest
    assert area is not None
    # The delivered charge is computed at the cell that leaks most slowly, where cancellation costs fewest digits.
    slowest = np.array(order) == np.argmin(stack.leak_rates(area))
    hops = tuple((hop.element.device == "V", hop.sign) for hop in stack.hops)
    p, q, nodes = _voltages(hops, tuple(of_layer.tolist()), tuple(sign.tolist()))
    gap = None if stack.gap_layer is None else stack.layers[stack.gap_layer]
    return Network(
        sources=(_source(stack),),
        n_voltage=1,
        cells=tuple(
            Cell(stack.layers[i], ("1", "0"), c, g_total, g_area, 0)
            for i, (c, g_total, g_area) in zip(of_layer, constants, strict=True)
        ),
        layers=stack.layers,
        live=tuple(range(n)),
        areas=(Area(stack.layers[0].nodes[2], gap, stack.area_given),),
        contacts=(stack.contact,),
        gaps=(None if stack.gap is None else order.index(stack.gap),),
        p=p,
        q=q,
        k=np.zeros((n, n)),
        b=np.zeros((n, 1)),
        through=(sign * slowest)[None],
        delivered=np.zeros((1, n + 1)),
        resistor_factor=np.zeros((0, n)),
        resistor_factor_s=np.zeros((0, 1)),
        node_names=tuple(hop.node for hop in stack.hops[:-1]),
        nodes=nodes,
        stack=stack,
    )


@lru_cache(maxsize=64)
def _voltages(
    hops: tuple[tuple[bool, float], ...], layers: tuple[int, ...], sign: tuple[float, ...]
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Matrices that give the cell voltages and the node voltages of a loop.

    `hops` says of each whether it is a source, and its sign; `layers`, counted along the loop, and `sign` are those of
    each cell in the order of the states. The cell voltages follow from the states by the first matrix (n_cell, n) and
    from the loop's voltage by the second (n_cell, 1); the node voltages by the third (n_node, n + 1 + n_source) from
    the states, the loop's voltage and each source, where n_source is 0 for a single source.
    """
    n, several = len(sign) - 1, sum(is_source for is_source, _ in hops)
    across = np.zeros((n + 1, n + 1 + (several if several > 1 else 0)))
    across[:n, :n] = np.eye(n)
    across[n, :n], across[n, n] = -sign[n] * np.array(sign[:n]), sign[n]
    nodes, row, source, layer = [], np.zeros(across.shape[1]), 0, 0
    for is_source, turn in hops[:-1]:
        if not is_source:
            row = row - turn * across[[i == layer for i in layers]].sum(axis=0)
            layer += 1
        elif several > 1:
            row[n + 1 + source] -= turn
            source += 1
        else:
            row[n] += 1.0
        nodes.append(row.copy())
    return across[:, :n].copy(), across[:, n : n + 1].copy(), np.array(nodes).reshape(-1, row.size)
