"""The network of any circuit. In that of a series stack the voltage around its loop is the one source."""

from __future__ import annotations

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
        return _loop_network(build_stack(circuit, skin_at)) if is_stack(circuit) else build_network(circuit)

    network: Network = circuit.remember(("network", skin_at), make)
    return network


def _loop_network(stack: Stack) -> Network:
    """The network of a stack, its cells in the order of `Stack.state_order`, with voltages from p to n."""
    ends, order = ("1", "0"), list(stack.state_order)
    n = len(order) - 1
    sign = stack.sign[order]
    layers = [stack.layers[stack.layer_of(i)] for i in order]
    constants = np.column_stack([stack.c, stack.g_total, stack.g_area])[order].tolist()
    p, q, through = np.eye(n + 1, n), np.zeros((n + 1, 1)), np.zeros((1, n + 1))
    p[n], q[n] = -sign[n] * sign[:n], sign[n]
    area = stack.area_given if stack.contact is None or stack.area_given else float(stack.contact.area(0.0))
    assert area is not None
    # The charge is that of the cell that leaks least, where it suffers least from cancellation.
    slowest = order.index(int(np.argmin(stack.leak_rates(area))))
    through[0, slowest] = sign[slowest]
    several = [e for e, _ in stack.sources] if len(stack.sources) > 1 else []
    gap = None if stack.gap_layer is None else stack.layers[stack.gap_layer]
    names, nodes = [], np.zeros((len(stack.hops) - 1, n + 1 + len(several)))
    row = np.zeros(nodes.shape[1])
    for i, hop in enumerate(stack.hops[:-1]):
        if hop.element.device != "V":
            own = [j for j, layer in enumerate(layers) if layer is hop.element]
            row[: n + 1] -= hop.sign * np.append(p[own].sum(axis=0), q[own].sum())
        elif several:
            row[n + 1 + several.index(hop.element)] -= hop.sign
        else:
            row[n] += 1.0
        nodes[i] = row
        names.append(hop.node)
    return Network(
        sources=(Element("loop", "V", ends, ends, MappingProxyType({}), stack.waveform),),
        n_voltage=1,
        cells=tuple(Cell(e, ends, c, g, g_area, 0) for e, (c, g, g_area) in zip(layers, constants, strict=True)),
        layers=stack.layers,
        live=tuple(range(n)),
        areas=(Area(layers[0].nodes[2], gap, stack.area_given, None),),
        contacts=(stack.contact,),
        gaps=(None if stack.gap is None else order.index(stack.gap),),
        p=p,
        q=q,
        k=np.zeros((n, n)),
        b=np.zeros((n, 1)),
        through=through,
        delivered=np.zeros((1, n + 1)),
        resistor_factor=np.zeros((0, n)),
        resistor_factor_s=np.zeros((0, 1)),
        node_names=tuple(names),
        nodes=nodes,
        stack=stack,
    )
