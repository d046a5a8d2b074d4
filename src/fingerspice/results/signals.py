"""The signals of a run by name: the signals of its record, and further ones computed from them for each gap."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from fingerspice.base.arrays import FloatArray
from fingerspice.base.errors import InputError
from fingerspice.physics.contact import Contact
from fingerspice.results.record import Record, sealed
from fingerspice.results.stored_record import StoredRecord

AnyRecord = Record | StoredRecord

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
#: Attribute names in the record of signals that are named differently there.
_IN_RECORD = {"f_el": "force", "q_source": "charge", "i_source": "current"}
#: Signals that are computed from another one, with the contact of the gap.
_DERIVED: dict[str, tuple[str, Callable[[Contact, FloatArray], FloatArray]]] = {
    "sigma_el": ("u_gap", lambda contact, u: contact.stress(u)),
    "f_t": ("f_el", lambda contact, f: contact.mu * (contact.f_n + f)),
    "friction": ("f_t", lambda contact, f: f / contact.f_n),
}


class Signals:
    """Signals of a record by name, each computed when it is first asked for; shapes and units as in `Solution`."""

    def __init__(self, record: AnyRecord) -> None:
        self.record = record
        self._derived: dict[str, FloatArray] = {}

    @property
    def gaps(self) -> tuple[str, ...]:
        """Names of the GAPs."""
        return tuple(name for name, _ in self.record.fingers)

    def value(self, key: str) -> FloatArray | None:
        """A signal, shape (n_t,), or (n_t, n) where n elements have it; None where the run has no such signal."""
        if key in _OF_A_GAP and not self.gaps:
            return None
        if key in _DERIVED:
            if key not in self._derived:
                base, make = _DERIVED[key]
                self._derived[key] = self._per_gap(self.value(base), make)
            return self._derived[key]
        held: FloatArray | None = getattr(self.record, _IN_RECORD.get(key, key))
        return held

    def _per_gap(self, x: FloatArray | None, make: Callable[[Contact, FloatArray], FloatArray]) -> FloatArray:
        """A signal of every gap computed from another one."""
        assert x is not None
        contacts = [contact for _, contact in self.record.fingers]
        if len(contacts) == 1:
            return sealed(make(contacts[0], x))
        return sealed(np.column_stack([make(contact, x[:, i]) for i, contact in enumerate(contacts)]))

    def columns(self, key: str) -> tuple[str, ...]:
        """Names of the layers, gaps, sources or nodes to which the columns of a signal belong."""
        if key == "v":
            return tuple(self.record.node_voltages)
        if key == "fold_margin":
            return ()
        if key == "u_layer":
            return self.record.layers
        return self.record.sources if key.endswith("_source") else self.gaps

    def names(self, key: str) -> tuple[str, ...]:
        """``key`` itself, or ``key:element`` for each of several elements; empty where the run has no such signal.

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
        # Decide without computing the signal, where possible.
        missing = not several if key in _OF_A_GAP else False
        if key in ("q_source", "i_source") or (key == "area" and not several):
            missing = self.value(key) is None
        return () if missing else (key,) if len(several) < 2 else tuple(f"{key}:{name}" for name in several)

    def one(self, name: str) -> FloatArray:
        """The signal of one of the `names`, shape (n_t,)."""
        key, colon, element = name.partition(":")
        if key == "v":
            return self.record.node_voltages[element]
        value = self.value(key)
        assert value is not None
        return value[:, self.columns(key).index(element)] if colon else value
