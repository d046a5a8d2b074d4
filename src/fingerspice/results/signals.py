"""Signals of a run by name: those of its record, or of a file, and further ones computed from them for each gap."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from fingerspice.base.arrays import FloatArray, IntArray
from fingerspice.base.errors import InputError
from fingerspice.numerics.lobatto import NODES, POINTS
from fingerspice.physics.contact import Contact
from fingerspice.results.measures import Panels, Read
from fingerspice.results.record import Record, Sealed, sealed
from fingerspice.results.steps import basis


@dataclass(frozen=True, eq=False)
class StoredRecord(Sealed):
    """Outputs of a run as they were read from a file.

    Attributes
    ----------
    t : ndarray, shape (n_t,)
        s; at a jump two entries share a time.
    layers, sources : tuple of str
    fingers : tuple of (str, Contact)
        Each GAP's name and contact.
    u_source, charge, current : ndarray, shape (n_t,) or (n_t, n_source)
        V, C and A; the last two None where the run left them out.
    u_layer : ndarray, shape (n_t, n_layer)
        V.
    u_gap, area, force : ndarray, shape (n_t,) or (n_t, n_gap)
        V, m^2 and N; `area` is None for a circuit without any area.
    fold_margin : ndarray, shape (n_t,)
    node_voltages : dict of str to ndarray, shape (n_t,)
        V.
    """

    t: FloatArray
    layers: tuple[str, ...]
    sources: tuple[str, ...]
    fingers: tuple[tuple[str, Contact], ...]
    u_source: FloatArray
    u_layer: FloatArray
    u_gap: FloatArray
    area: FloatArray | None
    force: FloatArray
    charge: FloatArray | None
    current: FloatArray | None
    fold_margin: FloatArray
    node_voltages: dict[str, FloatArray]

    def __post_init__(self) -> None:
        for value in vars(self).values():
            for array in value.values() if isinstance(value, dict) else (value,):
                if isinstance(array, np.ndarray):
                    sealed(array)


@dataclass(frozen=True, eq=False)
class StoredRun:
    """The last period of a run between its outputs, by polynomials on panels; see `measures.Run`."""

    since: float  # Start of the period, s
    nodes: StoredRecord  # Signals at the nodes of each panel, one panel after another

    def run(self, readers: Mapping[str, Read], since: float, until: float) -> StoredRun | None:
        """This period itself; None for any other part of the run."""
        return self if abs(since - self.since) <= 1e-9 * (until - self.since) else None

    def panels(self, since: float, until: float) -> Panels:
        """All panels."""
        t = self.nodes.t.reshape(-1, NODES)
        return Panels(np.arange(len(t)), np.zeros(len(t)), np.ones(len(t)), t[:, -1] - t[:, 0])

    def at_points(self, read: Read, panels: Panels) -> tuple[FloatArray, FloatArray]:
        """See `measures.Run`."""
        return self.values_at(read, panels.step, panels.fractions(POINTS))

    def values_at(self, read: Read, index: IntArray, fraction: FloatArray) -> tuple[FloatArray, FloatArray]:
        """See `measures.Run`; evaluates the polynomials."""
        t, x = (values.reshape(-1, NODES)[index] for values in (self.nodes.t, read(self.nodes)))
        return t[:, :1] + fraction * (t[:, -1:] - t[:, :1]), np.einsum("pn,pqn->pq", x, basis(fraction))


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
