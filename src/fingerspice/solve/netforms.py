"""One finger in a network prepared for recordings: `solve.netmodal` in the form of `engine.lanestep`."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np
from numpy.polynomial.polynomial import polyder, polyval

from fingerspice.base.arrays import FloatArray
from fingerspice.circuit.circuit import Circuit
from fingerspice.engine.lanerows import FADED, Lanes
from fingerspice.physics.contact import inverse_area
from fingerspice.results.outcome import State
from fingerspice.solve.laneform import LaneForm, Shown, curves, slopes
from fingerspice.solve.netmodal import Reduced
from fingerspice.solve.problem import Problem
from fingerspice.solve.scenes import Scene
from fingerspice.waveforms.recorded import as_samples
from fingerspice.waveforms.samples import Samples
from fingerspice.waveforms.waveform import DC

# Number of frequencies at which the gap's share is looked at.
_FREQUENCIES = 65
# Least error that is followed where several modes fade in a sample, and the share in kappa from which on they count:
# what they leave together is known but for about 1e-8.
OF_MANY, ACTING = 1e-7, 0.05
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
        start, reduced, n = problem.initial, self.reduced, self.active
        x, s, net = start.y[:n], start.s_before, reduced.scene.net
        bend = self._bend_at(float(net.p[reduced.gap] @ x + net.q[reduced.gap] @ s))
        z = np.zeros(self.lanes.rates.size)
        z[:n] = reduced.modes.inverse @ (x + reduced.modes.follow @ s) - reduced.absorbed * bend
        held = self.rows.columns @ z + self.rows.bends * bend + self.rows.k * s[reduced.source]
        z[n:] = start.y[n : n + self.flows] - held[n:]
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
            out[self.active :] = problem.initial.y[self.active :, None]
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
    kinks = np.full(reduced.leaking.size + 1, polyval(-1.0, slope))
    kinks[-1] = 0.5 * scale**2 * polyval(-1.0, polyder(bend, 2))
    rates, gain, shape, taps, tap_s, bent, feed = map(np.ascontiguousarray, (
        modal.rates, modal.gain, modal.taps[0], modal.taps[1:-1], modal.tap_s[1:-1],
        modal.taps[1:-1, :n] @ reduced.absorbed, modal.drives,
    ))  # fmt: skip
    shares = np.abs(modal.taps[0, :n] * reduced.absorbed)
    fading = (reduced.modes.rates > FADED * wave.rate) & (shares > ACTING * reduced.kappa)
    if rtol < OF_MANY and np.count_nonzero(fading) > 1:
        return None
    lanes = Lanes(
        rates, gain, shape, float(modal.tap_s[0]), taps, tap_s, bent, feed, area, slope, bend, scale, -1.0, reduced.q0,
        reduced.kappa, kinks, float(polyval(-1.0, area)), float(polyval(-1.0, slope)),
        int(np.argmax(shares * reduced.modes.rates)),
    )  # fmt: skip
    still, moved = np.zeros(len(modal.nodes)), modal.nodes[:, :n] @ reduced.absorbed
    nodes = Shown(modal.nodes, still, moved, still > 0.0)
    return NetworkForm(
        lanes, n, False, Shown(modal.columns, modal.k, modal.bends, np.zeros(modal.k.size, bool)), nodes, m - n,
        float(contact.stress(1.0)), share, scene.u_top, missed, missed_bend,
        float(problem.network.capacitance(reduced.area0).sum()), reduced,
    )  # fmt: skip


def _largest_share(reduced: Reduced, rate: float, stop: float) -> float:
    """The gap's largest share of a sine of the source, over the frequencies that a recording may have."""
    omega = 2.0 * np.pi * np.geomspace(min(1.0 / stop, 0.4 * rate), 0.5 * rate, _FREQUENCIES)
    one = reduced.modal()
    response = one.tap_s[0] + (one.taps[0] * one.gain / (1j * omega[:, None] + one.rates)).sum(axis=1)
    return float(np.abs(response).max())
