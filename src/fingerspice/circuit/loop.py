"""The network of any circuit. In that of a series stack the voltage around its loop is the one source."""

from __future__ import annotations

import dataclasses
from itertools import zip_longest
from types import MappingProxyType

import numpy as np

from fingerspice.circuit.circuit import Circuit, Element
from fingerspice.circuit.network import Cell, Network, build_network
from fingerspice.circuit.statespace import Stack, build_stack, is_stack
from fingerspice.circuit.topology import Area


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
        network: Network = circuit.remember("network", lambda: _network(circuit))[1]
        return network

    network: Network = circuit.remember(("network", skin_at), make)
    return network


def _network(circuit: Circuit) -> tuple[tuple[Element, ...], Network]:
    """The elements of a circuit and its network: that of the circuit it was made of, if only sources have changed."""
    before: tuple[tuple[Element, ...], Network] | None = circuit.remember("of", dict).get("network")
    if before is not None:
        elements, network = before
        changed = {a.name: b for a, b in zip(elements, circuit.elements, strict=True) if a is not b}
        if changed.keys() <= {e.name for e in network.sources}:
            sources = tuple(changed.get(e.name, e) for e in network.sources)
            return circuit.elements, dataclasses.replace(network, sources=sources)
    return circuit.elements, build_network(circuit)


def loop_network(stack: Stack) -> Network:
    """The network of a stack, its cells in the order of `Stack.state_order`, with voltages from p to n."""
    ends, order = ("1", "0"), list(stack.state_order)
    n, sign = len(order) - 1, stack.sign.tolist()
    layers = [stack.layers[stack.layer_of(i)] for i in order]
    constants = list(zip(stack.c.tolist(), stack.g_total.tolist(), stack.g_area.tolist(), strict=True))
    # Of the states, then of the loop's voltage.
    across = [[float(i == j) for j in range(n + 1)] for i in range(n)]
    last = sign[order[n]]
    across.append([*(-last * sign[i] for i in order[:n]), last])
    area = stack.area_given if stack.contact is None or stack.area_given else float(stack.contact.area(0.0))
    assert area is not None
    # The charge is that of the cell that leaks least, where it suffers least from cancellation.
    slowest = int(np.argmin(stack.leak_rates(area)))
    through = [sign[i] * (i == slowest) for i in order]
    several = [e for e, _ in stack.sources] if len(stack.sources) > 1 else []
    gap = None if stack.gap_layer is None else stack.layers[stack.gap_layer]
    nodes, row = [], [0.0] * (n + 1 + len(several))
    for hop in stack.hops[:-1]:
        if hop.element.device != "V":
            for own, layer in zip(across, layers, strict=True):
                if layer is hop.element:
                    row = [x - hop.sign * y for x, y in zip_longest(row, own, fillvalue=0.0)]
        elif several:
            row[n + 1 + several.index(hop.element)] -= hop.sign
        else:
            row[n] += 1.0
        nodes.append(list(row))
    matrix = np.array(across)
    return Network(
        sources=(Element("loop", "V", ends, ends, MappingProxyType({}), stack.waveform),),
        n_voltage=1,
        cells=tuple(Cell(layer, ends, *constants[i], 0) for layer, i in zip(layers, order, strict=True)),
        layers=stack.layers,
        live=tuple(range(n)),
        areas=(Area(layers[0].nodes[2], gap, stack.area_given, None),),
        contacts=(stack.contact,),
        gaps=(None if stack.gap is None else order.index(stack.gap),),
        p=matrix[:, :n].copy(),
        q=matrix[:, n:].copy(),
        k=np.zeros((n, n)),
        b=np.zeros((n, 1)),
        through=np.array([through]),
        delivered=np.zeros((1, n + 1)),
        resistor_factor=np.zeros((0, n)),
        resistor_factor_s=np.zeros((0, 1)),
        node_names=tuple(hop.node for hop in stack.hops[:-1]),
        nodes=np.array(nodes).reshape(-1, len(row)),
        stack=stack,
    )
