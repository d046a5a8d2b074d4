"""One finger in a network, in the form of `engine.lanes.step`, so that a recording needs one step a sample there, too.

In modes at a reference area A0 a network is v' = -rates v + gain s + feed j, u = tap v + tap_s s, where each cell whose
area moves carries a current beside that at A0 (see `engine.many_areas.rows`). Under the local law, and with e = A - A0,
it is e (c u' + g u). If all these cells are in series they carry one current. Then every c u' + g u equals that of the
gap, less the difference of the fixed leaks over A. With G the fixed leaks, and q = 1/A,

    j_b = c_gap N' + A0 (q - q0) (G_b u_b - G_gap u_gap),    N(u_gap) = integral of e over the gap voltage from 0 V.

N' is absorbed by the state: w = v - f c_gap N, f the sum of feed over these cells, has

    w' = -rates w + gain s - rates f c_gap N + sum over b of feed_b A0 (q - q0) (G_b u_b - G_gap u_gap),

without the slope of any voltage, so that w is continuous where the source jumps. The gap voltage follows from
xi = gap w + gap_s s by u_gap + kappa N(u_gap) = xi, kappa = -(gap f) c_gap, whose left side rises with u_gap. The
charge that a source has delivered is one more mode, of rate zero, and a sum of these quantities.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.polynomial.polynomial import polyder, polyval

from fingerspice.base.arrays import FloatArray, IntArray
from fingerspice.circuit.circuit import Circuit
from fingerspice.circuit.network import Modes, network_modes
from fingerspice.engine.lanes.rows import FADED, Lanes
from fingerspice.physics.contact import inverse_area
from fingerspice.results.outcome import State
from fingerspice.solve.problem import Problem
from fingerspice.solve.recordings.form import LEAST_LEAKS, LaneForm, Shown, curves, roomy, slopes
from fingerspice.solve.scenes import Scene
from fingerspice.waveforms.samples import Samples, as_samples
from fingerspice.waveforms.waveform import DC


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


# Number of frequencies at which the gap's share is looked at.
_FREQUENCIES = 65
# Least error that is followed where several modes fade in a sample, and the share in kappa from which on they count:
# what they leave together is known but for about 1e-8.
OF_MANY, ACTING = 1e-7, 0.05
# Fewest active modes that code is compiled for.
LEAST_MODES = 4
# Reference area: that at this share of the largest gap voltage to expect.
_TYPICAL = 0.5


def recording_of(problem: Problem) -> tuple[int, Samples] | None:
    """Number and samples of the one source of a network that is a recording, if all others are at 0."""
    found = None
    for i, wave in enumerate(problem.waveforms):
        samples = as_samples(wave)
        if samples is not None:
            if found is not None:
                return None
            found = i, samples
        elif not (isinstance(wave, DC) and wave.level == 0.0):
            return None
    return found


def is_followed(scene: Scene, circuit: Circuit) -> bool:
    """Whether a scene is a network with one area that moves, at once and under the local law, of cells in series."""
    net = scene.net
    moving = np.flatnonzero(net.gap >= 0)
    if scene.stack is not None or net.mobile or moving.size != 1 or net.slow[moving[0]] >= 0:
        return False
    cells = [cell for cell in scene.network.cells if cell.area == moving[0]]
    if net.g_area[net.gap[moving[0]]] > 0.0:
        return False
    own = {cell.element.name: cell.element.nodes[:2] for cell in cells}
    ends = Counter(node for nodes in own.values() for node in nodes)
    every = Counter(node for e in circuit.elements for node in e.nodes[:2])
    inner = [node for node, count in ends.items() if count == 2]
    # A path of k elements has k - 1 nodes inside, which nothing else touches, and two ends.
    return len(ends) == len(own) + 1 and len(inner) == len(own) - 1 and all(every[node] == 2 for node in inner)


@dataclass(frozen=True)
class NetworkForm(LaneForm):
    """A network prepared for recordings; the charges are its last modes, where they are wanted."""

    reduced: Reduced

    def _bend_at(self, u: float) -> float:
        """N at a gap voltage u (V), from xi by Newton's method."""
        xi, c = float(u), self.lanes
        for _ in range(50):
            at = np.array(xi)
            e = 1.0 / float(self.inverse_area(at)) - 1.0 / c.q0
            step = (xi - c.kappa * float(self.bend(at)) - u) * (1.0 + c.kappa * e)
            xi -= step
            if abs(step) <= 1e-15 * abs(xi):
                break
        return float(self.bend(np.array(xi)))

    def start(self, problem: Problem) -> tuple[FloatArray, float]:
        start, reduced, active = problem.initial, self.reduced, self.active
        n = reduced.absorbed.size
        x, s, net = start.y[:n], start.s_before, reduced.scene.net
        bend = self._bend_at(float(net.p[reduced.gap] @ x + net.q[reduced.gap] @ s))
        z = np.zeros(self.lanes.rates.size)
        z[:n] = reduced.modes.inverse @ (x + reduced.modes.follow @ s) - reduced.absorbed * bend
        held = self.rows.columns @ z + self.rows.bends * bend + self.rows.k * s[reduced.source]
        z[active:] = start.y[n : n + self.flows] - held[n:]
        return z, float(s[reduced.source])

    def state(self, problem: Problem, z: FloatArray, t: float, u_last: float) -> State:
        shown, xi, y = self.rows, self.xi_at(z, u_last), problem.initial.y.copy()
        y[: shown.k.size] = shown.columns @ z + shown.bends * float(self.bend(np.array(xi))) + shown.k * u_last
        s = np.zeros(len(problem.waveforms))
        s[self.reduced.source] = u_last
        sign = np.ones(problem.scene.net.gap.size)
        sign[self.reduced.moving] = 1.0 if xi >= 0.0 else -1.0
        return State(t, y, s, sign, problem.scene.charge_law)

    def width(self, problem: Problem) -> int:
        return super().width(problem) if self.flows else problem.initial.y.size

    def recorded(self, problem: Problem, out: FloatArray) -> FloatArray:
        if not self.flows:
            n = self.reduced.absorbed.size
            out[n:] = problem.initial.y[n:, None]
        return out.T


def finger(problem: Problem, rtol: float) -> NetworkForm | None:
    """The network prepared for recordings, or None where this form does not apply or no polynomial is good enough."""
    found, scene = recording_of(problem), problem.scene
    if found is None or not is_followed(scene, problem.circuit):
        return None
    source, wave = found
    share = _largest_share(Reduced(scene, source, scene.area0), wave.rate, problem.t_stop)
    (moving,) = np.flatnonzero(scene.net.gap >= 0)
    # The peak of a current is not known to the scene; that of a voltage has been looked up in the file already.
    typical = _TYPICAL * min(scene.u_top, share * (scene.u_peak or wave.peak(0.0, problem.t_stop)))
    area0 = scene.area0.copy()
    area0[moving] = 1.0 / inverse_area(typical, scene.net.curves[moving])[0]
    reduced = Reduced(scene, source, area0)
    one = reduced.modal()
    modal = reduced.with_charges(one) if problem.charge else one
    found_curves = curves(scene.net.curves[moving], reduced.q0, reduced.kappa, scene.u_top, rtol)
    contact = problem.network.contacts[moving]
    if modal is None or found_curves is None or contact is None:
        return None
    area, bend, scale, missed, missed_bend = found_curves
    slope, n, m = slopes(area, scale), reduced.absorbed.size, modal.rates.size
    # 1/A - q0 has the kink of 1/A, and N the part N''(0) xi |xi| / 2.
    active, wide = roomy(n, LEAST_MODES)
    more = [-1] * max(LEAST_LEAKS - reduced.leaking.size, 0)
    taps, feed = np.insert(modal.taps[1:], more, 0.0, axis=0), np.insert(modal.drives, more, 0.0, axis=1)
    tap_s, bent = np.insert(modal.tap_s[1:], more, 0.0)[:-1], (taps[:, :n] @ reduced.absorbed)[:-1]
    kinks = np.full(tap_s.size + 1, polyval(-1.0, slope))
    kinks[-1] = 0.5 * scale**2 * polyval(-1.0, polyder(bend, 2))
    shares = np.abs(modal.taps[0, :n] * reduced.absorbed)
    fading = (reduced.modes.rates > FADED * wave.rate) & (shares > ACTING * reduced.kappa)
    if rtol < OF_MANY and np.count_nonzero(fading) > 1:
        return None
    lanes = Lanes(
        wide(modal.rates), wide(modal.gain), wide(modal.taps[0]), float(modal.tap_s[0]), wide(taps[:-1]), tap_s, bent,
        wide(feed.T).T.copy(), area, slope, bend, scale, -1.0, reduced.q0, reduced.kappa, kinks,
        float(polyval(-1.0, area)), float(polyval(-1.0, slope)), int(np.argmax(shares * reduced.modes.rates)),
    )  # fmt: skip
    still, moved = np.zeros(len(modal.nodes)), modal.nodes[:, :n] @ reduced.absorbed
    rows = Shown(wide(modal.columns), modal.k, modal.bends, np.zeros(modal.k.size, bool))
    return NetworkForm(
        lanes, active, 2, False, rows, Shown(wide(modal.nodes), still, moved, still > 0.0), m - n,
        float(contact.stress(1.0)), share, scene.u_top, missed, missed_bend,
        float(problem.network.capacitance(reduced.area0).sum()), reduced,
    )  # fmt: skip


def _largest_share(reduced: Reduced, rate: float, stop: float) -> float:
    """The gap's largest share of a sine of the source, over the frequencies that a recording may have."""
    omega = 2.0 * np.pi * np.geomspace(min(1.0 / stop, 0.4 * rate), 0.5 * rate, _FREQUENCIES)
    one = reduced.modal()
    response = one.tap_s[0] + (one.taps[0] * one.gain / (1j * omega[:, None] + one.rates)).sum(axis=1)
    return float(np.abs(response).max())
