"""Outputs of a run, and every signal that follows from them, each computed when it is first asked for."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from fingerspice.base.arrays import BoolArray, FloatArray
from fingerspice.circuit.network import Network
from fingerspice.engine.network import Net
from fingerspice.physics.contact import areas, forces, inverse_area_array
from fingerspice.results.signals import Signals, sealed, side_by_side
from fingerspice.waveforms.waveform import Waveform


def sided(waveform: Waveform, t: FloatArray, left: BoolArray) -> FloatArray:
    """Values of a waveform at times t (s), shape (n_t,); left-hand limits where `left` is true."""
    out = np.array(waveform.value(t), float)
    if left.any():
        out[left] = waveform.value(t[left], "left")
    lost = ~np.isfinite(out)
    if lost.any():
        # A run ends where the source stops being finite, at a time known to 1e-12: use the finite value just before.
        out[lost] = waveform.value(t[lost] * (1.0 - 4e-12))
    return sealed(out)


@dataclass(frozen=True, eq=False)
class Record(Signals):
    """Outputs of a run as they were computed, and the signals that follow from them.

    Signals of gaps and of sources have the shape (n_t,) where there is one of them, else (n_t, n).
    """

    network: Network
    net: Net
    t: FloatArray  # (n_t,): s; at a jump two entries share a time
    left: BoolArray  # (n_t,): Whether an output is the left-hand value at a jump
    # (n_t, size): The state as in `engine.network`; with `has_charge` the sources' currents follow in the last columns,
    # and without it the columns of the charges may be missing
    rows: FloatArray
    has_charge: bool

    def __post_init__(self) -> None:
        network = self.network
        found = ((network.areas[i].gap, network.contacts[i]) for i in network.fingers)
        fingers = tuple((gap.name, contact) for gap, contact in found if gap is not None and contact is not None)
        layers, sources = (tuple(e.name for e in some) for some in (network.layers, network.sources))
        vars(self).update(layers=layers, sources=sources, fingers=fingers)
        super().__post_init__()

    @cached_property
    def _x(self) -> FloatArray:
        # Methods store rows in different memory orders, on which the rounding of a sum over a row depends.
        return np.ascontiguousarray(self.rows[:, : self.network.k.shape[0]])

    @cached_property
    def _s(self) -> FloatArray:
        """Values of the sources, and of those within a loop, V or A, shape (n_t, n_s + n_inner)."""
        elements = (*self.network.sources, *self.network.inner)
        return np.column_stack([sided(e.waveform, self.t, self.left) for e in elements if e.waveform is not None])

    def _voltage(self, by_x: FloatArray, by_s: FloatArray) -> FloatArray:
        """A voltage (V), shape (n_t,), as a weighted sum of the live voltages and the sources."""
        weights = (*by_x.tolist(), *by_s.tolist())
        some = [i for i, weight in enumerate(weights) if weight != 0.0]
        n = by_x.size
        if len(some) >= 8:
            # Without BLAS, whose threads may round differently.
            return np.asarray((self._x * by_x).sum(1) + (self._s[:, : by_s.size] * by_s).sum(1))
        columns = [self.rows[:, i] if i < n else self._s[:, i - n] for i in reversed(some)]
        if len(some) == 1 and weights[some[0]] == 1.0:
            return np.ascontiguousarray(columns[0])
        out = weights[some[-1]] * columns[0] if some else np.zeros(self.t.size)
        for i, column in zip(some[-2::-1], columns[1:], strict=True):
            out += weights[i] * column
        return out

    def cell_voltage(self, cell: int) -> FloatArray:
        """Voltage of a cell from p to n, V, shape (n_t,)."""
        return self._voltage(self.network.p[cell], self.network.q[cell])

    def finger_voltage(self, finger: int) -> FloatArray:
        """Gap voltage of a finger, V, shape (n_t,)."""
        gap = self.network.gaps[self.network.fingers[finger]]
        assert gap is not None
        return self.cell_voltage(gap)

    def _area_of(self, i: int) -> FloatArray:
        if self.net.slow[i] >= 0:
            return np.asarray(self.rows[:, self._x.shape[1] + int(self.net.slow[i])] * self.net.area0[i])
        if self.net.gap[i] < 0:
            return np.full(self.t.size, self.net.area0[i])
        return areas(self.cell_voltage(int(self.net.gap[i])), self.net.curves[i])

    def finger_area(self, finger: int) -> FloatArray:
        """Contact area of a finger, m^2, shape (n_t,)."""
        return self._area_of(self.network.fingers[finger])

    def finger_force(self, finger: int) -> FloatArray:
        """Electroadhesive force (Eq. 2 times A_R) of a finger, N, shape (n_t,)."""
        _, contact = self.fingers[finger]
        i, u = self.network.fingers[finger], self.finger_voltage(finger)
        if self.net.gap[i] >= 0 and self.net.slow[i] < 0:
            return forces(u, self.net.curves[i], float(contact.stress(1.0)))
        return np.asarray(contact.stress(u) * self.finger_area(finger))

    @cached_property
    def u_source(self) -> FloatArray:
        """Voltage of each source, V: from p to n of a V, and from n to p of an I, the direction in which it drives."""
        n_v = self.network.n_voltage
        out = self._s[:, : len(self.network.sources)].copy()
        if n_v < out.shape[1]:
            at = {name.lower(): u for name, u in self.node_voltages.items()}
            for j, element in enumerate(self.network.sources[n_v:]):
                p, n = (at.get(node, 0.0) for node in element.nodes[:2])
                out[:, n_v + j] = n - p
        return side_by_side(out.T)

    @cached_property
    def u_layer(self) -> FloatArray:
        """Layer voltages from p to n, V, shape (n_t, n_layer)."""
        cells = np.column_stack(
            [np.zeros((self.t.size, 0)), *(self.cell_voltage(i) for i in range(len(self.network.cells)))]
        )
        return sealed(np.einsum("tc,lc->tl", cells, self.network.grouping))

    @cached_property
    def u_gap(self) -> FloatArray:
        """Gap voltage, V."""
        return side_by_side([self.finger_voltage(i) for i in range(len(self.fingers))])

    @cached_property
    def area(self) -> FloatArray | None:
        """Contact area of each GAP, m^2; without a GAP the circuit's first area; None where there is none."""
        shown = self.network.fingers or ((0,) if self.network.areas else ())
        return side_by_side([self._area_of(i) for i in shown]) if shown else None

    @cached_property
    def f_el(self) -> FloatArray:
        """Electroadhesive force, N."""
        return side_by_side([self.finger_force(i) for i in range(len(self.fingers))])

    @cached_property
    def q_source(self) -> FloatArray | None:
        """Charge (C) that each source has delivered at its p node, or at its n node if it is an I."""
        n_s = len(self.network.sources)
        end = self.rows.shape[1] - n_s
        return side_by_side(self.rows[:, end - n_s : end].T) if self.has_charge else None

    @cached_property
    def i_source(self) -> FloatArray | None:
        """Current (A) that each source delivers at that node, without the impulses at jumps."""
        return side_by_side(self.rows[:, -len(self.network.sources) :].T) if self.has_charge else None

    @cached_property
    def fold_margin(self) -> FloatArray:
        """Distance to the fold of the `mobile` law, 1 where no area feels a voltage, shape (n_t,).

        Ratio of the determinant of the differential capacitances to that of the capacitances at fixed areas.
        """
        net, n = self.net, self._x.shape[1]
        out = np.ones(self.t.size)
        if not net.mobile or not np.any((net.gap >= 0) & (net.slow < 0)):
            return sealed(out)
        area = np.column_stack([self._area_of(i) for i in range(net.gap.size)])
        held, met = np.zeros((2, self.t.size, n, n))
        for cell in range(net.c.size):
            i, row = int(net.place[cell]), net.p[cell]
            own = net.c[cell] * (np.ones(self.t.size) if i < 0 else area[:, i])
            held += own[:, None, None] * np.outer(row, row)
            if i >= 0 and net.gap[i] >= 0 and net.slow[i] < 0:
                u = self.cell_voltage(int(net.gap[i]))
                inverse, slope = inverse_area_array(np.abs(u), net.curves[i])
                cross = net.c[cell] * self.cell_voltage(cell) * -np.sign(u) * slope / inverse**2
                met += cross[:, None, None] * np.outer(row, net.p[net.gap[i]])
        return sealed(np.linalg.det(held + met) / np.linalg.det(held))

    @cached_property
    def node_voltages(self) -> dict[str, FloatArray]:  # type: ignore[override]
        """Voltage of every node against ground, V, shape (n_t,) each."""
        n = self._x.shape[1]
        rows = zip(self.network.node_names, self.network.nodes, strict=True)
        return {name: sealed(self._voltage(row[:n], row[n:])) for name, row in rows}


def bare_record(network: Network, net: Net, t: FloatArray, left: BoolArray, rows: FloatArray) -> Record:
    """A record without charge, from states as columns, shape (size, n_t)."""
    return Record(network, net, t, left, rows.T, False)
