"""From a circuit to its reduced state space, by node incidence.

Per unit area, layer x has capacitance c_x, leak g_x = 1/(R_x A) (a total resistance) or 1/(rho d) (a material),
and S = sum 1/c_x. With the leaked charges taken out, u_x = k_x U + v_x with k_x = 1/(c_x S): a jump of U splits in
the ratio of 1/c_x, no derivative of U appears, and sum v_x = 0 fixes the neutral gauge of the leaked charges. So N
layers have N - 1 live states,

    v' = (k 1^T - I) diag(g/c) u.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fingerspice.circuit.circuit import Circuit, Element
from fingerspice.circuit.combinations import Product, Sum
from fingerspice.circuit.topology import Hop, find_loop
from fingerspice.circuit.waveforms import DC, Waveform
from fingerspice.physics.contact import Contact
from fingerspice.physics.materials import EPS0, skin_permittivity, skin_resistivity

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class Stack:
    """Layers in one series loop with an ideal source, sharing one area. SI throughout.

    Attributes
    ----------
    layers : tuple of Element
        In loop order, from the source's positive side.
    sign : ndarray, shape (n_layer,)
        +1 where a layer is written p to n along the loop, -1 where it is turned.
    c : ndarray, shape (n_layer,)
        Capacitance per area, F/m^2.
    g_total : ndarray, shape (n_layer,)
        Leakage conductance of fixed total, S.
    g_area : ndarray, shape (n_layer,)
        Leakage conductance per area, S/m^2.
    gap : int or None
        Index of the gap among the layers.
    contact : Contact or None
    area_given : float or None
        Area fixed by the deck, m^2.
    hops : tuple of Hop
        The loop as walked from ground.
    """

    layers: tuple[Element, ...]
    sign: FloatArray
    c: FloatArray
    g_total: FloatArray
    g_area: FloatArray
    gap: int | None
    contact: Contact | None
    area_given: float | None
    hops: tuple[Hop, ...]

    @property
    def sources(self) -> tuple[tuple[Element, float], ...]:
        """Voltage sources in the loop, each with the sign it adds to U with."""
        return tuple((h.element, -h.sign) for h in self.hops if h.element.device == "V")

    def node_voltages(self, u_layer: FloatArray, u_sources: dict[str, FloatArray]) -> dict[str, FloatArray]:
        """Voltage of every node of the loop against ground, from the layers' (n_t, n_layer) and the sources'."""
        column = {e.name: u_layer[:, i] for i, e in enumerate(self.layers)}
        out = {}
        potential = np.zeros(u_layer.shape[0])
        for hop in self.hops[:-1]:
            voltage = u_sources[hop.element.name] if hop.element.device == "V" else column[hop.element.name]
            potential = potential - hop.sign * voltage
            out[hop.node] = potential
        return out

    @property
    def s(self) -> float:
        """Sum of 1/c over the layers, m^2/F."""
        return float(np.sum(1.0 / self.c))

    @property
    def k(self) -> FloatArray:
        """Share of a jump of U that each layer takes, shape (n_layer,)."""
        return np.asarray(1.0 / (self.c * self.s))

    @property
    def waveform(self) -> Waveform:
        """Voltage around the loop: the sources with their signs."""
        parts: list[Waveform] = []
        for element, sign in self.sources:
            assert element.waveform is not None
            parts.append(element.waveform if sign > 0 else Product((DC(-1.0), element.waveform)))
        return parts[0] if len(parts) == 1 else Sum(tuple(parts))

    @property
    def state_order(self) -> tuple[int, ...]:
        """Layers in the order of the states; the last one's voltage is what the others leave of the source's.

        The layer left out is never the gap, so that the gap's voltage is a state of its own.
        """
        left_out = next((i for i in reversed(range(self.c.size)) if i != self.gap), 0)
        return (*(i for i in range(self.c.size) if i != left_out), left_out)

    def leak_rates(self, area: float) -> FloatArray:
        """Leak rate of each layer, g/c, at an area (m^2), 1/s, shape (n_layer,)."""
        return np.asarray((self.g_total / area + self.g_area) / self.c)

    def admittance(self, frequency: FloatArray, area: FloatArray) -> FloatArray:
        """Complex layer admittances (n_frequency, n_layer) in S, SKIN at each frequency (Eqs. 9, 16 to 19)."""
        f = np.atleast_1d(np.asarray(frequency, float))[:, None]
        a = np.broadcast_to(np.asarray(area, float), (f.shape[0],))[:, None]
        g = np.broadcast_to(self.g_total + self.g_area * a, (f.shape[0], self.c.size)).copy()
        c = np.broadcast_to(self.c * a, g.shape).copy()
        for i, layer in enumerate(self.layers):
            if layer.device == "SKIN":
                d = layer.values["d"]
                g[:, i] = (a / (skin_resistivity(f) * d))[:, 0]
                c[:, i] = (EPS0 * skin_permittivity(f) * a / d)[:, 0]
        return np.asarray(g + 2j * math.pi * f * c)


def layer_constants(layer: Element) -> tuple[float, float, float]:
    """c (F/m^2), total leakage (S) and leakage per area (S/m^2) of one layer."""
    v = layer.values
    if layer.device == "SKIN":
        f = v["f"]
        return EPS0 * float(skin_permittivity(f)) / v["d"], 0.0, 1.0 / (float(skin_resistivity(f)) * v["d"])
    c = EPS0 * v["eps_r"] / v["d"]
    if layer.device == "SLAB":
        return c, 0.0, 1.0 / (v["rho"] * v["d"])
    return c, 1.0 / v["r"], 0.0


def contact_of(gap: Element) -> Contact:
    """The contact of a GAP: the one place where the paper's mm become m."""
    v = gap.values
    return Contact(
        d=v["d"],
        eps_r=v["eps_r"],
        f_n=v["fn"],
        mu=v["mu"],
        alpha=v["alpha"] * 1e-6,
        m=v["m_exp"],
        beta=v["beta"] * 1e-6 * 1e3 ** v["n_exp"],
        n=v["n_exp"],
        c2=v["c2"] * 1e-12,
    )


def build_stack(circuit: Circuit) -> Stack:
    """The series stack of a circuit.

    Raises
    ------
    InputError
        For no source, no layer, a floating or dangling node, parallel sources, a loop of sources alone, two gaps
        or areas, and for topologies this version does not solve, naming the elements.
    """
    loop = find_loop(circuit)
    layers = [h.element for h in loop.hops if h.element.spec.is_layer]
    constants = np.array([layer_constants(e) for e in layers])
    contact = None if loop.gap is None else contact_of(loop.gap)
    if contact is not None and circuit.work == "total":
        d = np.array([e.values["d"] for e in layers])
        contact = contact.with_total_voltage_held(d, constants[:, 0] * d / EPS0)
    return Stack(
        layers=tuple(layers),
        sign=np.array([h.sign for h in loop.hops if h.element.spec.is_layer]),
        c=constants[:, 0],
        g_total=constants[:, 1],
        g_area=constants[:, 2],
        gap=None if loop.gap is None else layers.index(loop.gap),
        contact=contact,
        area_given=loop.area_given,
        hops=loop.hops,
    )
