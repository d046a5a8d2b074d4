"""Outputs of a run that was read from a file; its signals are stored, whereas `Record` computes them from states."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from fingerspice.base.arrays import FloatArray, IntArray
from fingerspice.numerics.lobatto import NODES, POINTS
from fingerspice.physics.contact import Contact
from fingerspice.results.measures import Panels, Read
from fingerspice.results.record import Sealed, sealed
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
