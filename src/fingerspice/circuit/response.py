"""Linear response of a circuit at one frequency: its layer voltages, and the contact areas at these voltages."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np

from fingerspice.base.arrays import ComplexArray, FloatArray
from fingerspice.base.errors import InputError
from fingerspice.circuit.circuit import Circuit, Element
from fingerspice.circuit.loop import network_of
from fingerspice.circuit.network import Network
from fingerspice.physics.contact import Contact
from fingerspice.physics.materials import skin_permittivity, skin_resistivity
from fingerspice.physics.phasor import coupled_area, layer_gains
from fingerspice.waveforms.waveform import Fundamental


@dataclass(frozen=True)
class LinearScene:
    """The data of a circuit that the phasors of one of its contacts depend on."""

    network: Network
    contact: Contact
    gap: int  # Index of the GAP among the layers
    finger: int  # Index of the GAP's area
    note: str  # Text that names the GAP if there are several; empty for one GAP

    @property
    def fixed(self) -> bool:
        """Whether the deck fixes the contact's area."""
        return self.network.areas[self.finger].given is not None

    @property
    def fundamental(self) -> Fundamental | None:
        """Fundamental of the source, or None."""
        return self.network.waveforms[0].fundamental

    @property
    def sources(self) -> tuple[tuple[Element, float], ...]:
        """Each source with its sign along the loop of a series stack; the sign is 1 for other networks."""
        stack = self.network.stack
        return tuple((e, 1.0) for e in self.network.sources) if stack is None else stack.sources

    @property
    def layers(self) -> tuple[str, ...]:
        return tuple(e.name for e in self.network.layers)

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
    contact, gap = network.contacts[place], network.areas[place].gap
    assert contact is not None
    assert gap is not None
    note = f"of several GAPs, {name}" if len(gaps) > 1 else ""
    return LinearScene(network, contact, network.layers.index(gap), place, note)


def with_skin_held(circuit: Circuit) -> Circuit:
    """The circuit with each SKIN replaced by a SLAB that has the skin's data at the SKIN's own frequency."""

    def held(skin: Element) -> Element:
        d, f = skin.values["d"], skin.values["f"]
        values = {"d": d, "eps_r": float(skin_permittivity(f)), "rho": float(skin_resistivity(f)), "e_max": math.inf}
        return replace(skin, device="SLAB", values=MappingProxyType(values))

    return replace(circuit, elements=tuple(held(e) if e.device == "SKIN" else e for e in circuit.elements))


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
