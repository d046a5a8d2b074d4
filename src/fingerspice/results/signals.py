"""The signals of a run by name: what its record holds, and what follows from that for each finger."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property

import numpy as np

from fingerspice.base.arrays import FloatArray
from fingerspice.base.errors import InputError
from fingerspice.physics.contact import Contact
from fingerspice.results.network_record import NetworkRecord
from fingerspice.results.record import Record, sealed
from fingerspice.results.stored_record import StoredRecord

AnyRecord = Record | NetworkRecord | StoredRecord

#: Unit and long name of each signal; layers and nodes are ``u_layer:NAME`` and ``v:NAME``.
SIGNALS = {
    "u_source": ("V", "source voltage"),
    "u_layer": ("V", "layer voltage"),
    "u_gap": ("V", "gap voltage"),
    "area": ("m^2", "ridge contact area"),
    "sigma_el": ("Pa", "electroadhesive stress"),
    "f_el": ("N", "electroadhesive force"),
    "f_t": ("N", "friction force"),
    "friction": ("1", "friction coefficient f_t / f_n"),
    "q_source": ("C", "charge delivered by the source"),
    "i_source": ("A", "source current, regular part"),
    "fold_margin": ("1", "distance to the fold of the mobile law"),
    "v": ("V", "node voltage"),
}
#: Signals that every gap has.
_OF_A_GAP = ("u_gap", "sigma_el", "f_el", "f_t", "friction")


class Signals:
    """Signals of a record, each made when first asked for; shapes and units as in `Solution`."""

    def __init__(self, record: AnyRecord) -> None:
        self.record = record

    @property
    def layers(self) -> tuple[str, ...]:
        return self.record.layers

    @property
    def gaps(self) -> tuple[str, ...]:
        return tuple(name for name, _ in self.record.fingers)

    @property
    def sources(self) -> tuple[str, ...]:
        return self.record.sources

    @property
    def u_source(self) -> FloatArray:
        return self.record.u_source

    @property
    def u_layer(self) -> FloatArray:
        return self.record.u_layer

    @property
    def area(self) -> FloatArray | None:
        return self.record.area

    @property
    def q_source(self) -> FloatArray | None:
        return self.record.charge

    @property
    def i_source(self) -> FloatArray | None:
        return self.record.current

    @property
    def fold_margin(self) -> FloatArray:
        return self.record.fold_margin

    @property
    def u_gap(self) -> FloatArray | None:
        return self.record.u_gap if self.record.fingers else None

    @property
    def f_el(self) -> FloatArray | None:
        return self.record.force if self.record.fingers else None

    @cached_property
    def sigma_el(self) -> FloatArray | None:
        return self._per_gap(self.u_gap, lambda contact, u: contact.stress(u))

    @cached_property
    def f_t(self) -> FloatArray | None:
        return self._per_gap(self.f_el, lambda contact, f: contact.mu * (contact.f_n + f))

    @cached_property
    def friction(self) -> FloatArray | None:
        return self._per_gap(self.f_t, lambda contact, f: f / contact.f_n)

    def _per_gap(self, x: FloatArray | None, make: Callable[[Contact, FloatArray], FloatArray]) -> FloatArray | None:
        """Another signal of every gap from one of them."""
        if x is None:
            return None
        contacts = [contact for _, contact in self.record.fingers]
        if len(contacts) == 1:
            return sealed(make(contacts[0], x))
        return sealed(np.column_stack([make(contact, x[:, i]) for i, contact in enumerate(contacts)]))

    def columns(self, key: str) -> tuple[str, ...]:
        """What the columns of a signal belong to: layers, gaps, sources or nodes."""
        if key == "v":
            return tuple(self.record.node_voltages)
        if key == "fold_margin":
            return ()
        return self.layers if key == "u_layer" else self.sources if key.endswith("_source") else self.gaps

    def names(self, key: str) -> tuple[str, ...]:
        """``key`` itself, or ``key:element`` where several elements have it; none where there is none.

        Raises
        ------
        InputError
            For a name that no signal has.
        """
        base, colon, _ = key.partition(":")
        if base not in SIGNALS or (colon and key not in self.names(base)):
            raise InputError(f"unknown signal {key!r}; allowed: {', '.join(SIGNALS)}")
        if colon:
            return (key,)
        several = self.columns(key)
        if key in ("u_layer", "v"):
            return tuple(f"{key}:{name}" for name in several)
        # Asking for a signal would make it.
        missing = not several if key in _OF_A_GAP else False
        if key in ("q_source", "i_source") or (key == "area" and not several):
            missing = getattr(self, key) is None
        return () if missing else (key,) if len(several) < 2 else tuple(f"{key}:{name}" for name in several)

    def one(self, name: str) -> FloatArray:
        """The signal of one of the `names`, shape (n_t,)."""
        key, colon, element = name.partition(":")
        if key == "v":
            return self.record.node_voltages[element]
        value: FloatArray = getattr(self, key)
        return value[:, self.columns(key).index(element)] if colon else value
