"""The network of any circuit. In that of a series stack the voltage around its loop is the one source."""

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
            return loop_network(build_stack(circuit, skin_at))
        network: Network = circuit.remember("network", lambda: _network(circuit))
        return network

    network: Network = circuit.remember(("network", skin_at), make)
    return network


def _network(circuit: Circuit) -> Network:
    """The network of a circuit, made of that of a related one where only sources differ."""
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


def loop_network(stack: Stack) -> Network:
    """The network of a stack, its cells in the order of `Stack.state_order`, with voltages from p to n."""
    ends, order = ("1", "0"), stack.state_order
    n, sign = len(order) - 1, tuple(stack.sign.tolist())
    layers = [stack.layers[stack.layer_of(i)] for i in order]
    constants = list(zip(stack.c.tolist(), stack.g_total.tolist(), stack.g_area.tolist(), strict=True))
    area = stack.area_given if stack.contact is None or stack.area_given else stack.contact.area_at_rest
    assert area is not None
    # The charge is that of the cell that leaks least, where it suffers least from cancellation.
    slowest = int(np.argmin(stack.leak_rates(area)))
    hops = tuple((hop.element.device == "V", hop.sign) for hop in stack.hops)
    p, q, nodes = _voltages(hops, tuple(stack.layer_of(i) for i in order), tuple(sign[i] for i in order))
    gap = None if stack.gap_layer is None else stack.layers[stack.gap_layer]
    return Network(
        sources=(Element("loop", "V", ends, ends, _NOTHING, stack.waveform),),
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
    """Voltages of a loop's cells (n_cell, n) and (n_cell, 1) from the states and the loop's voltage, and of its nodes.

    Those are (n_node, n + 1), or from the sources one by one as well, where there are several.

    Parameters
    ----------
    hops : tuple of (bool, float)
        Of each hop whether it is a source, and its sign.
    layers, sign : tuple
        The layer that each cell is part of, counted along the loop, and the cell's sign; in the order of the states.
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
