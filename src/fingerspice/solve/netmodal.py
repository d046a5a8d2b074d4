"""One finger in a network, in the form of `engine.lanestep`, so that a recording needs one step a sample there, too.

In modes at a reference area A0 a network is v' = -rates v + gain s + feed j, u = tap v + tap_s s, where each cell whose
area moves carries a current beside that at A0 (see `engine.netrows`). Under the local law, and with e = A - A0, it is
e (c u' + g u). If all these cells are in series they carry one current. Then every c u' + g u equals that of the gap,
less the difference of the fixed leaks over A. With G the fixed leaks, and q = 1/A,

    j_b = c_gap N' + A0 (q - q0) (G_b u_b - G_gap u_gap),    N(u_gap) = integral of e over the gap voltage from 0 V.

N' is absorbed by the state: w = v - f c_gap N, f the sum of feed over these cells, has

    w' = -rates w + gain s - rates f c_gap N + sum over b of feed_b A0 (q - q0) (G_b u_b - G_gap u_gap),

without the slope of any voltage, so that w is continuous where the source jumps. The gap voltage follows from
xi = gap w + gap_s s by u_gap + kappa N(u_gap) = xi, kappa = -(gap f) c_gap, whose left side rises with u_gap. The
charge that a source has delivered is one more mode, of rate zero, and a sum of these quantities.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from fingerspice.base.arrays import FloatArray, IntArray
from fingerspice.circuit.network import Modes, network_modes
from fingerspice.solve.scenes import Scene


@dataclass(frozen=True)
class Modal:
    """Modes w of a network and, behind them, the charges of its sources where these are wanted."""

    # rates, gain (m,): w' = -rates w + gain s + drives g, for the one source that is not 0
    rates: FloatArray
    gain: FloatArray
    drives: FloatArray  # (m, T): By (q - q0) times each tap, and last by N
    # taps, tap_s (1 + T, m): xi, the voltages of the cells with a fixed leak, and xi again for N
    taps: FloatArray
    tap_s: FloatArray
    # columns, bends, k (C, m): State voltages and charges from w, N and the source
    columns: FloatArray
    bends: FloatArray
    k: FloatArray
    nodes: FloatArray  # (n_node, m): Voltages of the nodes from w


@dataclass(frozen=True)
class Reduced:
    """A network with one moving area, at a reference area."""

    scene: Scene
    source: int  # Number of the source that is not 0
    area0: FloatArray  # Every area, m^2; `q0` is the inverse of the one that moves

    @cached_property
    def moving(self) -> int:
        """Number of the area that moves."""
        return int(np.flatnonzero(self.scene.net.gap >= 0)[0])

    @property
    def gap(self) -> int:
        """The cell whose voltage it follows."""
        return int(self.scene.net.gap[self.moving])

    @property
    def q0(self) -> float:
        return 1.0 / float(self.area0[self.moving])

    @cached_property
    def modes(self) -> Modes:
        return network_modes(self.scene.network, self.area0)

    @cached_property
    def tap(self) -> FloatArray:
        """Voltages of all cells from v."""
        return np.asarray(self.scene.network.p @ self.modes.shape)

    @cached_property
    def tap_s(self) -> FloatArray:
        """The same from the sources."""
        return np.asarray(self.scene.network.q - self.scene.network.p @ self.modes.follow)

    @cached_property
    def fed(self) -> IntArray:
        """The cells whose area moves."""
        return np.flatnonzero(self.scene.net.place == self.moving)

    @cached_property
    def turn(self) -> FloatArray:
        """Direction of each of these cells along their path, relative to that of the gap."""
        nodes = [self.scene.network.cells[i].nodes for i in self.fed]
        return _turns(nodes, int(np.flatnonzero(self.fed == self.gap)[0]))

    @cached_property
    def absorbed(self) -> FloatArray:
        """f c_gap of the module: v = w + absorbed N."""
        return np.asarray(-self.modes.take[:, self.fed] @ self.turn * self.scene.net.c[self.gap])

    @property
    def kappa(self) -> float:
        # Behind an ideal source it is 0, or rounding.
        return max(-float(self.tap[self.gap] @ self.absorbed), 0.0)

    @cached_property
    def leaking(self) -> IntArray:
        """Those of the cells that have a fixed leak, as places in `fed`."""
        return np.flatnonzero(self.scene.net.g_total[self.fed] > 0.0)

    def _leaks(self, through: FloatArray) -> FloatArray:
        """Forcing by (q - q0) times the voltage of each leaking cell; `through` (rows, n_f) is that by the currents."""
        together = through @ self.turn
        own = [through[:, i] - (together if self.fed[i] == self.gap else 0.0) for i in self.leaking]
        strength = self.scene.net.g_total[self.fed[self.leaking]] / self.q0
        return np.array(own).reshape(len(own), len(through)).T * strength

    def modal(self) -> Modal:
        """The modes without charges."""
        modes, network, source = self.modes, self.scene.network, self.source
        n, cells = modes.rates.size, self.fed[self.leaking]
        drives = np.column_stack([self._leaks(-modes.take[:, self.fed]), -modes.rates * self.absorbed])
        return Modal(
            rates=modes.rates, gain=modes.gains[:, source], drives=drives,
            taps=np.vstack([self.tap[self.gap], self.tap[cells], self.tap[self.gap]]),
            tap_s=self.tap_s[[self.gap, *cells, self.gap], source],
            columns=modes.shape, bends=modes.shape @ self.absorbed, k=-modes.follow[:, source],
            nodes=network.nodes[:, :n] @ modes.shape,
        )  # fmt: skip

    def with_charges(self, one: Modal) -> Modal | None:
        """The modes with the charge of each source; None where a mode that does not decay takes part in a current.

        A charge is z = stored v + stored_s s + passed c_gap N + y, where y' = lost v + lost_s s and the change of the
        leaks. One more mode is y + sum over k of lost_k / rate_k w_k, which no other mode drives.
        """
        network, modes, source = self.scene.network, self.modes, self.source
        n, n_s = modes.gains.shape
        capacitance, leak = network.capacitance(self.area0)[:, None], network.leak(self.area0)[:, None]
        at_x, at_s = network.delivered[:, :n], network.delivered[:, n:]
        lost = network.through @ (leak * self.tap) + at_x @ modes.shape
        lost_s = network.through @ (leak * self.tap_s) - at_x @ modes.follow + at_s
        if np.any(lost[:, modes.rates == 0.0] != 0.0):
            return None
        over = np.divide(lost, modes.rates, out=np.zeros_like(lost), where=modes.rates > 0.0)
        through = network.through[:, self.fed]
        stored = network.through @ (capacitance * self.tap)
        stored_s = network.through @ (capacitance * self.tap_s)
        moved = stored @ self.absorbed + through @ self.turn * self.scene.net.c[self.gap]
        # N cancels in the additional modes.
        drives = np.column_stack([self._leaks(through) + over @ one.drives[:, :-1], np.zeros(n_s)])
        return replace(
            one, rates=np.append(one.rates, np.zeros(n_s)),
            gain=np.append(one.gain, lost_s[:, source] + over @ one.gain), drives=np.vstack([one.drives, drives]),
            taps=np.hstack([one.taps, np.zeros((len(one.taps), n_s))]),
            columns=np.block([[one.columns, np.zeros((n, n_s))], [stored - over, np.eye(n_s)]]),
            bends=np.append(one.bends, moved), k=np.append(one.k, stored_s[:, source]),
            nodes=np.hstack([one.nodes, np.zeros((len(one.nodes), n_s))]),
        )  # fmt: skip


def _turns(nodes: list[tuple[str, str]], first: int) -> FloatArray:
    """Direction of each cell of a path, 1 or -1, relative to that of cell `first`."""
    turn = np.zeros(len(nodes))
    turn[first] = 1.0
    todo = [first]
    while todo:
        i = todo.pop()
        for j in np.flatnonzero(turn == 0.0):
            if set(nodes[i]) & set(nodes[j]):
                head_to_tail = nodes[i][1] == nodes[j][0] or nodes[i][0] == nodes[j][1]
                turn[j] = turn[i] if head_to_tail else -turn[i]
                todo.append(int(j))
    return turn
