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
from dataclasses import dataclass

import numpy as np
from numpy.polynomial.polynomial import polyder, polyval

from fingerspice.base.arrays import FloatArray
from fingerspice.circuit.circuit import Circuit
from fingerspice.circuit.network import network_modes
from fingerspice.engine.lanes.rows import FADED, Lanes
from fingerspice.physics.contact import inverse_area
from fingerspice.results.outcome import State
from fingerspice.solve.problem import Problem
from fingerspice.solve.recordings.form import LaneForm, Shown, curves, roomy
from fingerspice.solve.scenes import Scene
from fingerspice.waveforms.samples import Samples, as_samples
from fingerspice.waveforms.waveform import DC


class Reduced:
    """A network with one moving area, in modes w at reference areas `area0`; behind them the charges, if wanted.

    Only source number `source` is not 0.
    """

    def __init__(self, scene: Scene, source: int, area0: FloatArray, charge: bool) -> None:
        net, network = scene.net, scene.network
        self.scene, self.source, self.area0, modes = scene, source, area0, network_modes(network, area0)
        # The area that moves, and the cell whose voltage it follows.
        self.moving = int(np.flatnonzero(net.gap >= 0)[0])
        self.gap, self.q0, self.modes = int(net.gap[self.moving]), 1.0 / float(area0[self.moving]), modes
        n, n_s = modes.rates.size, modes.gains.shape[1] if charge else 0
        none = np.zeros((n, n_s))
        # Voltages of all cells from v, and from the sources.
        tap, tap_s = network.p @ modes.shape, network.q - network.p @ modes.follow
        # The cells whose area moves, and the direction of each along their path, relative to that of the gap.
        fed = np.flatnonzero(net.place == self.moving)
        turn = _turns([network.cells[i].nodes for i in fed], int(np.flatnonzero(fed == self.gap)[0]))
        # f c_gap of the module: v = w + absorbed N. Behind an ideal source kappa is 0, or rounding.
        self.absorbed = -modes.take[:, fed] @ turn * net.c[self.gap]
        self.kappa = max(-float(tap[self.gap] @ self.absorbed), 0.0)
        # The voltages of those of them that have a fixed leak, from w and the source: what 1/A - q0 multiplies.
        leaking = fed[net.g_total[fed] > 0.0]
        taps, self.tap_s = tap[leaking], tap_s[leaking, source]
        self.taps, self.bent = np.pad(taps, ((0, 0), (0, n_s))), taps @ self.absorbed

        def leaks(through: FloatArray) -> FloatArray:
            """Forcing by (q - q0) times each of these voltages; `through` (rows, n_f) is that by the currents."""
            own = through[:, net.g_total[fed] > 0.0] - np.outer(through @ turn, leaking == self.gap)
            return np.asarray(own * (net.g_total[leaking] / self.q0))

        # A charge is z = stored v + stored_s s + passed c_gap N + y, where y' = lost v + lost_s s and the change of the
        # leaks. One more mode is y + sum over k of lost_k / rate_k w_k, which no other mode drives.
        capacitance, leak = network.capacitance(area0)[:, None], network.leak(area0)[:, None]
        through, at_x, at_s = network.through[:n_s], network.delivered[:n_s, :n], network.delivered[:n_s, n:]
        lost = through @ (leak * tap) + at_x @ modes.shape
        lost_s = through @ (leak * tap_s) - at_x @ modes.follow + at_s
        # Whether no mode that does not decay takes part in a current; else there is no such mode.
        self.decays = not np.any(lost[:, modes.rates == 0.0])
        over = np.divide(lost, modes.rates, out=np.zeros_like(lost), where=modes.rates > 0.0)
        stored, stored_s = through @ (capacitance * tap), through @ (capacitance * tap_s)
        # w' = -rates w + gain s + feed g, by (q - q0) times each tap, and last by N, which cancels in the charges.
        self.rates, gain = np.append(modes.rates, np.zeros(n_s)), modes.gains[:, source]
        by_leaks = leaks(-modes.take[:, fed])
        self.gain = np.append(gain, lost_s[:, source] + over @ gain)
        by_bend = np.append(-modes.rates * self.absorbed, np.zeros(n_s))
        self.feed = np.column_stack([np.vstack([by_leaks, leaks(through[:, fed]) + over @ by_leaks]), by_bend])
        # xi from w and the source; state voltages and charges from w, N and the source; voltages of the nodes.
        self.shape, self.k = np.append(tap[self.gap], np.zeros(n_s)), float(tap_s[self.gap, source])
        moved = stored @ self.absorbed + through[:, fed] @ turn * net.c[self.gap]
        self.rows = Shown(
            np.block([[modes.shape, none], [stored - over, np.eye(n_s)]]),
            np.append(-modes.follow[:, source], stored_s[:, source]),
            np.append(modes.shape @ self.absorbed, moved), np.zeros(n + n_s, bool),
        )  # fmt: skip
        nodes = network.nodes[:, :n] @ modes.shape
        still = np.zeros(len(nodes))
        self.nodes = Shown(np.pad(nodes, ((0, 0), (0, n_s))), still, nodes @ self.absorbed, still > 0.0)


def _turns(nodes: list[tuple[str, str]], first: int) -> FloatArray:
    """Direction of each cell of a path, 1 or -1, relative to that of cell `first`: a current that all of them carry."""
    ends = Counter(node for pair in nodes for node in pair)
    inner = [[(a == node) - (b == node) for a, b in nodes] for node, count in ends.items() if count == 2]
    current = np.linalg.svd(np.array(inner, float).reshape(-1, len(nodes)))[2][-1]
    return np.asarray(np.round(current / current[first]))


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

    def recorded(self, problem: Problem, out: FloatArray) -> FloatArray:
        # Charges that are not wanted stay as they are.
        held = problem.initial.y[len(out) :, None] + np.zeros(out.shape[1])
        return out.T if self.flows else np.concatenate([out, held]).T


def finger(problem: Problem, rtol: float) -> NetworkForm | None:
    """The network prepared for recordings, or None where this form does not apply or no polynomial is good enough."""
    found, scene = recording_of(problem), problem.scene
    if found is None or not is_followed(scene, problem.circuit):
        return None
    source, wave = found
    share = _largest_share(Reduced(scene, source, scene.area0, False), wave.rate, problem.t_stop)
    (moving,) = np.flatnonzero(scene.net.gap >= 0)
    # The peak of a current is not known to the scene; that of a voltage has been looked up in the file already.
    typical = _TYPICAL * min(scene.u_top, share * (scene.u_peak or wave.peak(0.0, problem.t_stop)))
    area0 = scene.area0.copy()
    area0[moving] = 1.0 / inverse_area(typical, scene.net.curves[moving])[0]
    one = Reduced(scene, source, area0, problem.charge)
    polynomials = curves(scene.net.curves[moving], one.q0, one.kappa, scene.u_top, rtol)
    contact = problem.network.contacts[moving]
    if not one.decays or polynomials is None or contact is None:
        return None
    shares = np.abs(one.shape[: one.absorbed.size] * one.absorbed)
    fading = (one.modes.rates > FADED * wave.rate) & (shares > ACTING * one.kappa)
    if rtol < OF_MANY and np.count_nonzero(fading) > 1:
        return None
    curve, missed, missed_bend = polynomials
    # 1/A - q0 has the kink of 1/A, and N the part N''(0) xi |xi| / 2.
    kinks = np.full(one.tap_s.size + 1, curve["steep"])
    kinks[-1] = 0.5 * curve["scale"] ** 2 * polyval(-1.0, polyder(curve["bend"], 2))
    fast = int(np.argmax(shares * one.modes.rates))
    own = one.rates, one.gain, one.shape, one.k, one.taps, one.tap_s, one.bent, one.feed
    lanes, active, wide = roomy(Lanes(*own, kinks=kinks, fast=fast, **curve), one.absorbed.size, LEAST_MODES)
    rows, nodes = (shown._replace(columns=wide(shown.columns)) for shown in (one.rows, one.nodes))
    return NetworkForm(
        lanes, active, 2, False, rows, nodes, one.rates.size - one.absorbed.size, float(contact.stress(1.0)), share,
        scene.u_top, missed, missed_bend, float(problem.network.capacitance(area0).sum()), one,
    )  # fmt: skip


def _largest_share(one: Reduced, rate: float, stop: float) -> float:
    """The gap's largest share of a sine of the source, over the frequencies that a recording may have."""
    omega = 2.0 * np.pi * np.geomspace(min(1.0 / stop, 0.4 * rate), 0.5 * rate, _FREQUENCIES)
    response = one.k + (one.shape * one.gain / (1j * omega[:, None] + one.rates)).sum(axis=1)
    return float(np.abs(response).max())
