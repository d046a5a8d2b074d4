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
from fingerspice.circuit.topology import Area

_NOTHING: MappingProxyType[str, float] = MappingProxyType({})


def network_of(circuit: Circuit, skin_at: float | None = None) -> Network:
    """The network of a circuit; with `skin_at`, dispersive skins of a stack have their data at that frequency (Hz).

    Raises
    ------
    InputError
        As `build_network`.
    """

    def make() -> Network:
        if is_stack(circuit):
            return _of_stack(circuit, build_stack(circuit, skin_at), skin_at)
        network: Network = circuit.remember("network", lambda: _network(circuit))
        return network

    network: Network = circuit.remember(("network", skin_at), make)
    return network


def _network(circuit: Circuit) -> Network:
    """The network of a circuit, taken from a related circuit's network if the two differ in their sources only."""
    before: tuple[tuple[Element, ...], Network] | None = circuit.related.get("network")
    if before is not None:
        elements, network = before
        changed = {a.name: b for a, b in zip(elements, circuit.elements, strict=True) if a is not b}
        if changed.keys() <= {e.name for e in network.sources}:
            sources = tuple(changed.get(e.name, e) for e in network.sources)
            return dataclasses.replace(network, sources=sources)
    found = build_network(circuit)
    circuit.related["network"] = circuit.elements, found
    return found


def _of_stack(circuit: Circuit, stack: Stack, skin_at: float | None) -> Network:
    """The network of a stack, taken from that of a related circuit's stack if the two differ in their sources only."""
    key = ("loop network", skin_at)
    before: Network | None = circuit.related.get(key)
    if before is not None and before.stack is not None and before.stack.c is stack.c:
        return dataclasses.replace(before, sources=(_source(stack),), stack=stack)
    circuit.related[key] = found = loop_network(stack)
    return found


def _source(stack: Stack) -> Element:
    """The voltage around a stack's loop."""
    return Element("loop", "V", ("1", "0"), ("1", "0"), _NOTHING, stack.waveform)


def loop_network(stack: Stack) -> Network:
    """The network of a stack, its cells in the order of `Stack.state_order`, with voltages from p to n."""
    ends, order = ("1", "0"), stack.state_order
    n, sign = len(order) - 1, tuple(stack.sign.tolist())
    layers = [stack.layers[stack.layer_of(i)] for i in order]
    constants = list(zip(stack.c.tolist(), stack.g_total.tolist(), stack.g_area.tolist(), strict=True))
    area = stack.area_given if stack.contact is None or stack.area_given else stack.contact.area_at_rest
    assert area is not None
    # The delivered charge is computed at the cell that leaks most slowly, where cancellation costs fewest digits.
    slowest = int(np.argmin(stack.leak_rates(area)))
    hops = tuple((hop.element.device == "V", hop.sign) for hop in stack.hops)
    p, q, nodes = _voltages(hops, tuple(stack.layer_of(i) for i in order), tuple(sign[i] for i in order))
    gap = None if stack.gap_layer is None else stack.layers[stack.gap_layer]
    return Network(
        sources=(_source(stack),),
        n_voltage=1,
        cells=tuple(Cell(layer, ends, *constants[i], 0) for layer, i in zip(layers, order, strict=True)),
        layers=stack.layers,
        live=tuple(range(n)),
        areas=(Area(layers[0].nodes[2], gap, stack.area_given, None),),
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

    Parameters
    ----------
    hops : tuple of (bool, float)
        For each hop whether it is a source, and its sign.
    layers, sign : tuple
        Layer of each cell, counted along the loop, and sign of each cell; in the order of the states.

    Returns
    -------
    p, q : ndarray, shape (n_cell, n) and (n_cell, 1)
        Cell voltages from the states and from the loop's voltage.
    nodes : ndarray, shape (n_node, n + 1 + n_source)
        Node voltages from the states, the loop's voltage and each source; n_source is 0 for a single source.
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
