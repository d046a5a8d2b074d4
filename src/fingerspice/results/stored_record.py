"""Outputs of a run that was read from a file; its signals are stored, whereas `Record` computes them from states."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fingerspice.base.arrays import FloatArray
from fingerspice.physics.contact import Contact
from fingerspice.results.record import Sealed, sealed


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
