"""Outputs of a run, and every signal that follows from them, each computed when it is first asked for."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from fingerspice.base.arrays import BoolArray, FloatArray
from fingerspice.circuit.statespace import Stack
from fingerspice.engine.model import Model
from fingerspice.physics.contact import Contact, areas, forces, inverse_area_array
from fingerspice.waveforms.waveform import Waveform


def sealed(x: FloatArray) -> FloatArray:
    """The same array, read-only."""
    x.flags.writeable = False
    return x


class Sealed:
    """A result whose arrays are read-only, also after it was copied or unpickled, which makes arrays writable."""

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        for value in state.values():
            for array in value.values() if isinstance(value, dict) else (value,):
                if isinstance(array, np.ndarray):
                    sealed(array)


def sided(waveform: Waveform, t: FloatArray, left: BoolArray) -> FloatArray:
    """Values of a waveform at times t (s), from the left where `left` says so, shape (n_t,)."""
    out = np.array(waveform.value(t), float)
    if left.any():
        out[left] = waveform.value(t[left], "left")
    lost = ~np.isfinite(out)
    if lost.any():
        # A run ends where the source stops being finite, a time known to 1e-12; just before, the source was finite.
        out[lost] = waveform.value(t[lost] * (1.0 - 4e-12))
    return sealed(out)


@dataclass(frozen=True, eq=False)
class Record(Sealed):
    """Outputs of a series stack's run as they were computed, and the signals that follow from them.

    Attributes
    ----------
    stack : Stack
    waveform : Waveform
        Voltage around the loop.
    model : Model
    t : ndarray, shape (n_t,)
        s; at a jump two entries share a time.
    left : ndarray of bool, shape (n_t,)
        Whether an output is the left-hand value at a jump.
    live : ndarray, shape (n_layer - 1, n_t)
        Voltages along the loop of all layers except the last of `stack.layer_order`, V.
    z, current : ndarray, shape (n_t,), or None
        State of the charge (C), and the source's current without impulses (A); None where they were not asked for.
    charge_offset : float
        C, subtracted so that the charge starts at zero.
    """

    stack: Stack
    waveform: Waveform
    model: Model
    t: FloatArray
    left: BoolArray
    live: FloatArray
    z: FloatArray | None
    current: FloatArray | None
    charge_offset: float = 0.0

    def __post_init__(self) -> None:
        for array in (self.t, self.left, self.live, self.z, self.current):
            if array is not None:
                array.flags.writeable = False

    @property
    def layers(self) -> tuple[str, ...]:
        """Names of the layers, in the order of `u_layer`."""
        return tuple(e.name for e in self.stack.layers)

    @property
    def sources(self) -> tuple[str, ...]:
        """Name of the one source: the loop as a whole."""
        return ("loop",)

    @cached_property
    def fingers(self) -> tuple[tuple[str, Contact], ...]:
        """The GAP's name and contact."""
        gap, contact = self.stack.gap_layer, self.stack.contact
        return () if gap is None or contact is None else ((self.stack.layers[gap].name, contact),)

    @cached_property
    def u_source(self) -> FloatArray:
        """Voltage around the loop, V, shape (n_t,)."""
        return sided(self.waveform, self.t, self.left)

    @cached_property
    def u_layer(self) -> FloatArray:
        """Layer voltages from p to n (n_t, n_layer), V."""
        *live, last = self.stack.layer_order
        out = np.empty((self.t.size, len(live) + 1))
        out[:, live] = self.live.T
        # So the voltages of the layers add up to the source's exactly.
        out[:, last] = self.u_source - self.live.sum(axis=0)
        out *= self.stack.sign[self.stack.first_cell]
        return sealed(out)

    @cached_property
    def u_gap(self) -> FloatArray:
        """Gap voltage, V, shape (n_t,)."""
        gap = self.stack.gap_layer
        assert gap is not None
        *live, _ = self.stack.layer_order
        if gap in live:
            along = self.live[live.index(gap)]
            return sealed(along if self.stack.sign[self.stack.gap] > 0.0 else -along)
        # The gap is the last, or only, layer of `layer_order`.
        return sealed(self.u_layer[:, 0].copy())

    @cached_property
    def area(self) -> FloatArray:
        """Ridge contact area, m^2, shape (n_t,)."""
        if not self.model.coupled:
            return sealed(np.full(self.t.size, self.model.area0))
        return sealed(areas(self.u_gap, self.model.curve))

    @cached_property
    def force(self) -> FloatArray:
        """Electroadhesive force (Eq. 2 times A_R), N, shape (n_t,)."""
        assert self.stack.contact is not None
        u = self.u_gap
        stress = float(self.stack.contact.stress(1.0))
        if self.model.coupled:
            # Computed without `area`, so that the result does not depend on what was asked for before.
            return sealed(forces(u, self.model.curve, stress))
        return sealed(stress * u * self.area * u)

    @cached_property
    def charge(self) -> FloatArray | None:
        """Charge delivered by the source, C, shape (n_t,)."""
        if self.z is None:
            return None
        held = self.area * self.u_source / self.model.s if self.model.mobile else 0.0
        return sealed(held + self.z - self.charge_offset)

    @cached_property
    def fold_margin(self) -> FloatArray:
        """Distance to the fold of the `mobile` area equation, 1 without stored charge, shape (n_t,)."""
        if not (self.model.mobile and self.model.coupled):
            return sealed(np.ones(self.t.size))
        u = self.u_gap * self.stack.sign[self.stack.gap]
        q, slope = inverse_area_array(np.abs(u), self.model.curve)
        return sealed(1.0 - (u - self.model.k_gap * self.u_source) / q * slope * np.sign(u))

    @cached_property
    def node_voltages(self) -> dict[str, FloatArray]:
        """Voltage of every node against ground, V, shape (n_t,) each."""
        sources = {}
        for element, sign in self.stack.sources:
            assert element.waveform is not None
            single = len(self.stack.sources) == 1
            sources[element.name] = sign * self.u_source if single else sided(element.waveform, self.t, self.left)
        return {k: sealed(v) for k, v in self.stack.node_voltages(self.u_layer, sources).items()}


def stack_record(
    stack: Stack, waveform: Waveform, model: Model, t: FloatArray, left: BoolArray, live: FloatArray
) -> Record:  # fmt: skip
    """A record without charge."""
    return Record(stack, waveform, model, t, left, live, None, None)
