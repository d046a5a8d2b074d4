"""The network of any circuit; the network of a series stack has one source, the voltage around the loop."""

from __future__ import annotations

import dataclasses
from functools import lru_cache
from types import MappingProxyType

import numpy as np

from fingerspice.base.arrays import FloatArray
from fingerspice.circuit.circuit import Circuit, Element
from fingerspice.circuit.network import Cell, Network, build_network
from fingerspice.circuit.statespace import Stack, build_stack, is_stack
from fingerspice.circuit.topology import Area, shared
from fingerspice.circuit.usual import check

_NOTHING: MappingProxyType[str, float] = MappingProxyType({})


def network_of(circuit: Circuit, skin_at: float | None = None) -> Network:
    """The network of a circuit; with `skin_at`, dispersive skins of a stack have their data at that frequency (Hz)."""
    if is_stack(circuit):
        return circuit.remember(("network", skin_at), lambda: _of_stack(circuit, skin_at))
    return circuit.remember("network", lambda: _network(circuit))


def checked(circuit: Circuit) -> Circuit:
    """The circuit, refused if a value is not allowed or it has no solution."""
    check(circuit)
    network_of(circuit)
    return circuit


def _network(circuit: Circuit) -> Network:
    network = shared(circuit, "network", lambda: build_network(circuit))
    now = {e.name: e for e in circuit.elements}
    return dataclasses.replace(network, sources=tuple(now.get(e.name, e) for e in network.sources))


def _of_stack(circuit: Circuit, skin_at: float | None) -> Network:
    stack = build_stack(circuit, skin_at)
    network = shared(circuit, ("loop network", skin_at), lambda: loop_network(stack))
    return network if network.stack is stack else dataclasses.replace(network, sources=(_source(stack),), stack=stack)


def _source(stack: Stack) -> Element:
    """The voltage around a stack's loop."""
    return Element("loop", "V", ("1", "0"), ("1", "0"), _NOTHING, stack.waveform)


def loop_network(stack: Stack) -> Network:
    """The network of a stack, its cells in the order of `Stack.state_order`, with voltages from p to n."""
    ends, order = ("1", "0"), stack.state_order
    layer_of = tuple(stack.layer_of[list(order)].tolist())
    n, sign = len(order) - 1, tuple(stack.sign.tolist())
    layers = [stack.layers[i] for i in layer_of]
    constants = list(zip(stack.c.tolist(), stack.g_total.tolist(), stack.g_area.tolist(), strict=True))
    area = stack.area_given if stack.contact is None or stack.area_given else stack.contact.area_at_rest
    assert area is not None
    # The delivered charge is computed at the cell that leaks most slowly, where cancellation costs fewest digits.
    slowest = int(np.argmin(stack.leak_rates(area)))
    hops = tuple((hop.element.device == "V", hop.sign) for hop in stack.hops)
    p, q, nodes = _voltages(hops, layer_of, tuple(sign[i] for i in order))
    gap = None if stack.gap_layer is None else stack.layers[stack.gap_layer]
    return Network(
        sources=(_source(stack),),
        n_voltage=1,
        cells=tuple(Cell(layer, ends, *constants[i], 0) for layer, i in zip(layers, order, strict=True)),
        layers=stack.layers,
        live=tuple(range(n)),
        areas=(Area(layers[0].nodes[2], gap, stack.area_given),),
        contacts=(stack.contact,),
        gaps=(None if stack.gap is None else order.index(stack.gap),),
        p=p,
        q=q,
        k=np.zeros((n, n)),
        b=np.zeros((n, 1)),
        through=np.array([[sign[i] * (i == slowest) for i in order]]),
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
