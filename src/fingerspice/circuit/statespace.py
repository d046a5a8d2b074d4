"""Reduced state space of a series stack.

Per unit area, layer x has the capacitance c_x and the leakage conductance g_x = 1/(R_x A) (a total resistance) or
1/(rho d) (a material), and S = sum 1/c_x. With v_x, the part of the voltage due to the leaked charges,
u_x = k_x U + v_x, k_x = 1/(c_x S): a jump of U splits in the ratio of 1/c_x, no derivative of U appears, and
sum v_x = 0 fixes the neutral gauge of the leaked charges. So N layers have N - 1 live states,

    v' = (k 1^T - I) diag(g/c) u.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fingerspice.base.arrays import ComplexArray, FloatArray
from fingerspice.base.errors import InputError
from fingerspice.circuit.circuit import Circuit, Element
from fingerspice.circuit.topology import Area, Hop, loop_of, shared
from fingerspice.physics.contact import Contact
from fingerspice.physics.materials import EPS0, skin_permittivity, skin_resistivity
from fingerspice.waveforms.combinations import Product, Sum
from fingerspice.waveforms.waveform import DC, Waveform


@dataclass(frozen=True)
class Stack:
    """Layers in one series loop with an ideal source, sharing one area. SI throughout.

    A layer is one cell, which is a capacitor parallel to a resistor, or, for a dispersive material, several in series.
    """

    layers: tuple[Element, ...]  # In loop order, from the source's positive side
    # Number of cells of each layer; the arrays below list the cells of a layer one after the other
    cells: tuple[int, ...]
    # (n_cell,): +1 for a layer whose p node comes first along the loop, -1 for a layer whose n node does
    sign: FloatArray
    c: FloatArray  # (n_cell,): Capacitance per area, F/m^2
    g_total: FloatArray  # (n_cell,): Leakage conductance independent of the area, S
    g_area: FloatArray  # (n_cell,): Leakage conductance per area, S/m^2
    gap: int | None  # Index of the gap among the cells
    contact: Contact | None
    area_given: float | None  # Area fixed by the deck, m^2
    hops: tuple[Hop, ...]  # The elements of the loop in order, from ground to ground
    # Whatever else is computed from the layers alone, shared by stacks that differ in their sources only
    kept: dict[Any, Any] = field(default_factory=dict, compare=False, repr=False)

    @property
    def sources(self) -> tuple[tuple[Element, float], ...]:
        """Voltage sources in the loop, each with the sign of its voltage in the sum U."""
        return tuple((h.element, -h.sign) for h in self.hops if h.element.device == "V")

    @cached_property
    def first_cell(self) -> NDArray[np.intp]:
        """Index of the first cell of each layer."""
        return np.concatenate([[0], np.cumsum(self.cells)[:-1]]).astype(np.intp)

    @property
    def gap_layer(self) -> int | None:
        """Index of the gap among the layers."""
        return None if self.gap is None else int(self.layer_of[self.gap])

    def layers_of(self, cells: NDArray[np.bool_]) -> list[str]:
        """Names of the layers that have at least one marked cell."""
        marked = np.logical_or.reduceat(cells, self.first_cell)
        return [e.name for e, mark in zip(self.layers, marked, strict=True) if mark]

    @cached_property
    def s(self) -> float:
        """Sum of 1/c over the cells, m^2/F."""
        return float(np.sum(1.0 / self.c))

    @cached_property
    def k(self) -> FloatArray:
        """Fraction of a jump of U that each cell takes, shape (n_cell,)."""
        return np.asarray(1.0 / (self.c * self.s))

    @cached_property
    def waveform(self) -> Waveform:
        """Voltage around the loop: the sum of the sources with their signs."""
        # A source of 0 V only serves to measure a current.
        waves = [(e.waveform, sign) for e, sign in self.sources if e.waveform not in (None, DC(0.0))]
        parts = tuple(wave if sign > 0 else Product((DC(-1.0), wave)) for wave, sign in waves if wave is not None)
        return Sum(parts) if len(parts) > 1 else parts[0] if parts else DC(0.0)

    @property
    def state_order(self) -> tuple[int, ...]:
        """Cells in the order of the states; the last one has no state, as its voltage is the source's less all others.

        It is never the gap (unless the gap is the only cell), so that the gap voltage is a state of its own.
        """
        left_out = next((i for i in reversed(range(self.c.size)) if i != self.gap), 0)
        return (*(i for i in range(self.c.size) if i != left_out), left_out)

    @property
    def by_layer(self) -> Stack:
        """The stack with each layer as one capacitor without leak: its voltages are those that a run records."""
        # Not cached where it is this one: an object that holds itself is freed by garbage collection only.
        return self if len(self.layers) == self.c.size else self._of_whole_layers

    @cached_property
    def _of_whole_layers(self) -> Stack:
        c, none = 1.0 / np.add.reduceat(1.0 / self.c, self.first_cell), np.zeros(len(self.layers))
        one, sign = (1,) * len(self.layers), self.sign[self.first_cell]
        return replace(self, cells=one, sign=sign, c=c, g_total=none, g_area=none, gap=self.gap_layer, kept={})

    @cached_property
    def grouping(self) -> FloatArray:
        """Matrix of 0 and 1 from live cells to recorded layers, shape (n_layer - 1, n_cell - 1)."""
        layers = np.array(self.by_layer.state_order[:-1], int)
        return np.asarray(layers[:, None] == self.layer_of[np.array(self.state_order[:-1], int)], float)

    @cached_property
    def layer_of(self) -> NDArray[np.intp]:
        """Index of the layer that each cell is part of."""
        return np.repeat(np.arange(len(self.cells)), self.cells)

    def leak_rates(self, area: float) -> FloatArray:
        """Leak rate of each cell, g/c, at an area (m^2), 1/s, shape (n_cell,)."""
        return np.asarray((self.g_total / area + self.g_area) / self.c)

    def admittance(self, frequency: ArrayLike, area: ArrayLike) -> ComplexArray:
        """Complex layer admittances (n_frequency, n_layer), S; SKIN has data at each frequency (Eqs. 9, 16 to 19)."""
        f = np.atleast_1d(np.asarray(frequency, float))[:, None]
        a = np.broadcast_to(np.asarray(area, float), (f.shape[0],))[:, None]
        y = self.g_total + self.g_area * a + 2j * math.pi * f * self.c * a
        if len(self.layers) < self.c.size:
            y = 1.0 / np.add.reduceat(1.0 / y, self.first_cell, axis=1)
        for i, layer in enumerate(self.layers):
            if layer.device == "SKIN":
                y[:, i] = skin_admittance(layer, f, a)[:, 0]
        return np.asarray(y)


def skin_admittance(skin: Element, frequency: FloatArray, area: FloatArray) -> ComplexArray:
    """Complex admittance of a SKIN with its data at each frequency (Hz), S; `area` (m^2) is broadcast."""
    f = frequency
    per_area = 1.0 / skin_resistivity(f) + 2j * math.pi * f * EPS0 * skin_permittivity(f)
    return np.asarray(per_area * area / skin.values["d"])


def layer_constants(layer: Element, skin_at: float | None = None) -> FloatArray:
    """c (F/m^2), total leakage (S) and leakage per area (S/m^2) of a layer's cells, shape (n_cell, 3).

    With `skin_at` (Hz) a dispersive skin is one cell with its data at that frequency.
    """
    cells = layer.spec.cells
    assert cells is not None
    return layer.remember(("cells", skin_at), lambda: cells(layer.values, skin_at))


def contact_with(v: Mapping[str, Any]) -> Contact:
    """The contact with a GAP's values, or arrays of them; here, and nowhere else, the paper's mm are converted to m."""
    alpha, beta, c2 = v["alpha"] * 1e-6, v["beta"] * 1e-6 * 1e3 ** v["n_exp"], v["c2"] * 1e-12
    return Contact(v["d"], v["eps_r"], v["fn"], v["mu"], alpha, v["m_exp"], beta, v["n_exp"], c2)


def contact_of(gap: Element) -> Contact:
    """The contact of a GAP."""

    def make() -> Contact:
        # A product may overflow, or a logarithm be taken of one that underflows.
        with suppress(ArithmeticError, ValueError):
            contact = contact_with(gap.values)
            if np.all(np.isfinite(contact.packed)):
                return contact
        raise InputError(
            f"{gap.name} has a contact whose constants are beyond the range of numbers; allowed: fn, alpha, m_exp, "
            "beta, n_exp nearer to Table 1's",
            gap.where,
        )

    return gap.remember("contact", make)


def is_stack(circuit: Circuit) -> bool:
    """Whether a circuit is one series loop of sources and layers, with one area that follows the voltage without delay.

    A circuit that `topology.find_branches` refuses is refused.
    """
    return loop_of(circuit) is not None


def build_stack(circuit: Circuit, skin_at: float | None = None) -> Stack:
    """The series stack of a circuit; with `skin_at`, dispersive skins have their data at that frequency (Hz).

    If the deck holds the total voltage in Eq. 7, the contact uses the stack's capacitances alone: a dispersive skin
    enters with eps_inf, its permittivity above all poles, or with its permittivity at `skin_at`. A circuit that is no
    series stack is refused.
    """

    def make() -> Stack:
        loop = loop_of(circuit)
        if loop is None:
            raise InputError(
                "this needs a series chain of LAYER, SLAB, SKIN and GAP driven by V sources, and the circuit is "
                "another network; allowed for any network: simulate (run), plan, phasor (ac) and export"
            )
        hops, area = loop
        found = shared(circuit, ("stack", skin_at, circuit.work), lambda: _build(hops, area, skin_at, circuit.work))
        return replace(found, hops=hops)

    return circuit.remember(("stack", skin_at), make)


def _build(hops: tuple[Hop, ...], area: Area, skin_at: float | None, work: str) -> Stack:
    layers = tuple(hop.element for hop in hops if hop.element.spec.is_layer)
    parts = [layer_constants(e, skin_at) for e in layers]
    cells = tuple(len(part) for part in parts)
    c, g_total, g_area = np.concatenate(parts).T
    contact = None if area.gap is None else contact_of(area.gap)
    if contact is not None and work == "total":
        d = np.repeat([e.values["d"] for e in layers], cells)
        contact = contact.with_total_voltage_held(d, c * d / EPS0)
    sign = np.repeat([hop.sign for hop in hops if hop.element.spec.is_layer], cells)
    gap = None if area.gap is None else sum(cells[: layers.index(area.gap)])
    return Stack(layers, cells, sign, c, g_total, g_area, gap, contact, area.given, hops)
