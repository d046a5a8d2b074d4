"""The network of any circuit, that of a series stack with one source, the voltage around the loop; and its linear
response at one frequency: layer voltages, and the contact areas at these voltages.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np

from fingerspice.base.arrays import ComplexArray, FloatArray
from fingerspice.base.errors import InputError
from fingerspice.circuit.circuit import Circuit, Element
from fingerspice.circuit.devices import check
from fingerspice.circuit.network import Cell, Network, build_network
from fingerspice.circuit.statespace import Stack, build_stack, is_stack
from fingerspice.circuit.topology import Area, shared
from fingerspice.physics.contact import Contact
from fingerspice.physics.materials import skin_permittivity, skin_resistivity
from fingerspice.physics.phasor import coupled_area, layer_gains
from fingerspice.waveforms.waveform import Fundamental


def network_of(circuit: Circuit, skin_at: float | None = None) -> Network:
    """The network of a circuit; with `skin_at`, dispersive skins of a stack have their data at that frequency (Hz)."""

    def make() -> Network:
        stack = build_stack(circuit, skin_at) if is_stack(circuit) else None
        if stack is None:
            network = shared(circuit, "network", lambda: build_network(circuit))
            now = {e.name: e for e in circuit.elements}
            return replace(network, sources=tuple(now.get(e.name, e) for e in network.sources))
        network = shared(circuit, ("loop network", skin_at), lambda: loop_network(stack))
        return replace(network, sources=(_source(stack),), stack=stack)

    return circuit.remember(("network", skin_at), make)


def checked(circuit: Circuit) -> Circuit:
    """The circuit, refused if a value is not allowed or it has no solution."""
    check(circuit)
    network_of(circuit)
    return circuit


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
    # Cell voltages follow from the states and the loop's voltage, node voltages also from each of several sources.
    several = len(stack.sources) if len(stack.sources) > 1 else 0
    across = np.zeros((n + 1, n + 1 + several))
    across[:n, :n] = np.eye(n)
    across[n, :n], across[n, n] = -sign[n] * sign[:n], sign[n]
    rows, row, layer, source = list[FloatArray](), np.zeros(across.shape[1]), 0, n + 1
    for hop in stack.hops[:-1]:
        if hop.element.device != "V":
            row = row - hop.sign * across[of_layer == layer].sum(axis=0)
            layer += 1
        elif several:
            row[source] -= hop.sign
            source += 1
        else:
            row[n] += 1.0
        rows.append(row.copy())
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
        p=across[:, :n].copy(),
        q=across[:, n : n + 1].copy(),
        k=np.zeros((n, n)),
        b=np.zeros((n, 1)),
        through=(sign * slowest)[None],
        delivered=np.zeros((1, n + 1)),
        resistor_factor=np.zeros((0, n)),
        resistor_factor_s=np.zeros((0, 1)),
        node_names=tuple(hop.node for hop in stack.hops[:-1]),
        nodes=np.array(rows).reshape(-1, row.size),
        stack=stack,
    )


# Linear response


@dataclass(frozen=True)
class LinearScene:
    """The data of a circuit that the phasors of one of its contacts depend on."""

    network: Network
    contact: Contact
    gap: int  # Index of the GAP among the layers
    finger: int  # Index of the GAP's area
    note: str  # Text that names the GAP if there are several; empty for one GAP
    fixed: bool  # Whether the deck fixes the contact's area
    fundamental: Fundamental | None  # Of the source
    sources: tuple[tuple[Element, float], ...]  # Each with its sign along the loop of a stack; 1 in other networks
    layers: tuple[str, ...]

    def areas(self, f: float, area: str | float, amplitude: float) -> FloatArray:
        """Areas at one frequency (Hz), m^2, shape (n_area,)."""
        if not isinstance(area, str):
            return np.full(len(self.network.areas), area)
        return areas_at_rest(self.network) if area == "frozen" else coupled_areas(self.network, f, amplitude)

    def layer_gain(self, f: float, areas: FloatArray) -> ComplexArray:
        """Ratio of each layer's voltage (from p to n) to the source's, shape (n_layer,)."""
        network, stack = self.network, self.network.stack
        if stack is None:
            return np.asarray(network.grouping @ network.phasors(f, areas, np.ones(1, complex)))
        return np.asarray(layer_gains(stack.admittance(f, areas))[0] * stack.sign[stack.first_cell])


def linear_scene(circuit: Circuit, finger: str | None = None) -> LinearScene:
    """The linear scene of a circuit's GAP, which has to be named if there are several.

    Refused are names of no GAP, and networks with several sources, which have no common amplitude and frequency.
    """
    gaps = {e.name.lower(): e.name for e in circuit.by_device("GAP")}
    if finger is not None and finger.lower() not in gaps:
        known = ", ".join(gaps.values()) or "none: this circuit has no GAP"
        raise InputError(f"finger is {finger!r}; allowed: the name of a GAP, {known}")
    network = network_of(circuit)
    if not gaps:
        raise InputError("a phasor solution needs a GAP; this circuit has none")
    if len(network.sources) != 1:
        names = ", ".join(e.name for e in network.sources)
        raise InputError(f"a phasor solution needs one source, whose amplitude it takes; this circuit has {names}")
    if finger is None and len(gaps) > 1:
        raise InputError(f"this circuit has several GAPs; allowed: finger= one of {', '.join(gaps.values())}")
    name = next(iter(gaps.values())) if finger is None else gaps[finger.lower()]
    # Every GAP drives an area: `topology` refuses two on one.
    place = next(i for i, area in enumerate(network.areas) if area.gap is not None and area.gap.name == name)
    contact, area, stack = network.contacts[place], network.areas[place], network.stack
    assert contact is not None
    assert area.gap is not None
    return LinearScene(
        network,
        contact,
        gap=network.layers.index(area.gap),
        finger=place,
        note=f"of several GAPs, {name}" if len(gaps) > 1 else "",
        fixed=area.given is not None,
        fundamental=network.waveforms[0].fundamental,
        sources=tuple((e, 1.0) for e in network.sources) if stack is None else stack.sources,
        layers=tuple(e.name for e in network.layers),
    )


def with_skin_held(circuit: Circuit) -> Circuit:
    """The circuit with each SKIN replaced by a SLAB that has the skin's data at the SKIN's own frequency."""

    held: dict[str, Element] = {}
    for skin in circuit.by_device("SKIN"):
        d, f = skin.values["d"], skin.values["f"]
        values = {"d": d, "eps_r": float(skin_permittivity(f)), "rho": float(skin_resistivity(f)), "e_max": math.inf}
        held[skin.name] = replace(skin, device="SLAB", values=MappingProxyType(values))
    return replace(circuit, elements=tuple(held.get(e.name, e) for e in circuit.elements))


def mean_areas(network: Network) -> FloatArray:
    """Areas of a coupled phasor at its source's fundamental, m^2, shape (n_area,); refused if there is none."""
    several = len(network.sources) > 1
    fundamental = None if several else network.waveforms[0].fundamental
    if fundamental is not None:
        return coupled_areas(network, fundamental.frequency, fundamental.amplitude)
    what = "at the source's fundamental, and this source has none"
    if several:
        what = "of one source at its fundamental, and this circuit has several sources"
    raise InputError(f"area='mean' is the area of the phasor {what}; allowed: 'coupled', 'frozen' or an area in m^2")


def areas_at_rest(network: Network) -> FloatArray:
    """Areas at 0 V, or as the deck gives them, m^2, shape (n_area,)."""
    pairs = zip(network.areas, network.contacts, strict=True)
    return np.array([float(c.area(0.0)) if c is not None and a.given is None else a.given for a, c in pairs])


def coupled_areas(network: Network, f: float, amplitude: float) -> FloatArray:
    """Areas under one source's amplitude (V or A) at one frequency (Hz), each at its gap's rms voltage."""
    area = areas_at_rest(network)
    if all(a.given is not None for a in network.areas):
        return area
    stack, finger = network.stack, network.contacts[0]
    if stack is not None and finger is not None:

        def gain(area: float) -> float:
            return float(np.abs(layer_gains(stack.admittance(f, area))[0, stack.gap_layer]))

        return np.array([coupled_area(lambda u: float(finger.area(u)), gain, amplitude)])
    s = np.array([complex(amplitude)])
    for attempt in range(500):
        u, new = np.abs(network.phasors(f, area, s)), area.copy()
        for i, (contact, gap) in enumerate(zip(network.contacts, network.gaps, strict=True)):
            if network.areas[i].given is None and contact is not None and gap is not None:
                new[i] = float(contact.area(float(u[gap]) / math.sqrt(2.0)))
        # NaN and inf cannot converge: return them, for the caller to refuse.
        if np.all(np.abs(new - area) <= 4e-16 * area) or not np.all(np.isfinite(new)):
            return new
        # The fixed-point iteration may oscillate between two values: after 50 iterations, damp it by taking the mean.
        area = new if attempt < 50 else 0.5 * (area + new)
    raise InputError("the phasor's areas do not settle; allowed: area='frozen' or an area in m^2")
