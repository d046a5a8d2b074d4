"""One finger in a network, in the form of `engine.relaxation`, so that a recording needs one step a sample there, too.

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

from collections import Counter
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.polynomial import chebyshev as series_of
from numpy.polynomial.polynomial import polyder, polyval

from fingerspice.base.arrays import BoolArray, FloatArray
from fingerspice.circuit.circuit import Circuit
from fingerspice.circuit.network import network_modes
from fingerspice.engine import relaxation
from fingerspice.engine.blockcharge import Course, new_charges
from fingerspice.engine.model import Model
from fingerspice.engine.relaxation import Form
from fingerspice.numerics import chebyshev
from fingerspice.physics.contact import inverse_area, inverse_area_array
from fingerspice.results.outcome import State
from fingerspice.solve.forms import AREA_SHARE, FADED, Follower, weighted
from fingerspice.solve.problem import Problem
from fingerspice.solve.scenes import Scene
from fingerspice.waveforms.recorded import as_samples
from fingerspice.waveforms.samples import Samples
from fingerspice.waveforms.waveform import DC

# Number of Chebyshev points for the area over the gap voltage, and frequencies at which the gap's share is looked at.
_POINTS, _FREQUENCIES = 64, 65
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
class Finger(Follower):
    """A network prepared for recordings.

    Attributes
    ----------
    scene : Scene
    source : int
        Number of the source that is a recording.
    rates, gain : ndarray, shape (m,)
        Of the modes w and, behind them, of the charges where these are wanted.
    feed, taps : ndarray, shape (m, T) and (1 + T, m)
    tap_s : ndarray, shape (1 + T,)
    inverse, follow, absorbed : ndarray
        w = inverse (x + follow s) - absorbed N.
    area, bend, bent : ndarray
        See `Form`, as kappa and `scale`.
    """

    scene: Scene
    source: int
    rates: FloatArray
    gain: FloatArray
    feed: FloatArray
    taps: FloatArray
    tap_s: FloatArray
    inverse: FloatArray
    follow: FloatArray
    absorbed: FloatArray
    area: FloatArray
    bend: FloatArray
    bent: FloatArray
    kappa: float
    scale: float
    q0: float

    def form(self, spacing: float) -> Form:
        return weighted(
            False, np.array([self.q0]), self.rates[None], self.gain[None], self.feed[None], self.taps[None], self.tap_s,
            spacing, self.area, self.scale, -1.0, float(self.tap_s[0]), 1.0 / self.q0, self.kappa, self.bend, self.bent,
            self._fast(spacing),
        )  # fmt: skip

    def _fast(self, spacing: float) -> int:
        """The mode with the largest share in kappa of those that decay within a small part of a spacing (s), or -1."""
        n = self.absorbed.size
        shares = np.where(self.rates[:n] * spacing > FADED, np.abs(self.taps[0, :n] * self.absorbed), 0.0)
        return int(np.argmax(shares)) if shares.max(initial=0.0) > 0.0 else -1

    @cached_property
    def _model(self) -> Model:
        """What the compiled loop reads of a stack's model."""
        nothing = np.zeros(0)
        return Model(
            False, True, np.zeros(1), np.zeros(1), np.zeros(1), float(self.tap_s[0]), nothing, 1.0, np.zeros(4),
            1.0 / self.q0, np.inf, self.scene.net.curves[0],
        )  # fmt: skip

    def _bend(self, xi: float) -> float:
        value = float(polyval(abs(xi) * self.scale - 1.0, self.bend))
        return value if xi >= 0.0 else -value

    def course(self, problem: Problem, form: Form) -> Course:
        start, n = problem.initial, self.follow.shape[0]
        m, drives = self.rates.size, self.feed.shape[1]
        s = start.s_before
        v = self.inverse @ (start.y[:n] + self.follow @ s)
        gap = int(self.scene.net.gap.max())
        u = float(self.scene.net.p[gap] @ start.y[:n] + self.scene.net.q[gap] @ s)
        bend = self._moved(u)
        w = np.append(v - self.absorbed * bend, np.zeros(m - n))
        if m > n:
            columns = self.shown.columns[0, n:]
            w[n:] = start.y[n:] - (columns @ w + self.shown.bend[n:] * bend + self.shown.k[n:] * s[self.source])
        control, counters = np.zeros(relaxation.N_CONTROL), np.zeros(relaxation.N_COUNTERS, np.int64)
        control[relaxation.MARGIN] = 1.0
        control[relaxation.U_GAP] = self.taps[0] @ w + self.tap_s[0] * s[self.source]
        return Course(
            self._model, form, self.shown, relaxation.new_room(m, drives, drives + 1), new_charges(),
            np.zeros((3, max(m, drives, 3))), w, np.zeros(m), control, counters,
        )  # fmt: skip

    def _moved(self, u: float) -> float:
        """N at a gap voltage u (V), from xi by Newton's method."""
        xi = float(u)
        for _ in range(50):
            bend = self._bend(xi)
            off = xi - self.kappa * bend - u
            e = 1.0 / polyval(abs(xi) * self.scale - 1.0, self.area) - 1.0 / self.q0
            step = float(off * (1.0 + self.kappa * e))
            xi -= step
            if abs(step) <= 1e-15 * abs(xi):
                break
        return self._bend(xi)

    def rows(self, problem: Problem, t: FloatArray, left: BoolArray, out: FloatArray) -> FloatArray:
        rows = out[:, : t.size].T
        if problem.charge:
            return rows
        return np.hstack([rows, np.tile(problem.initial.y[self.follow.shape[0] :], (t.size, 1))])

    def state(self, problem: Problem, course: Course, t: float, u_last: float) -> State:
        shown, xi = self.shown, float(course.control[relaxation.U_GAP])
        y = problem.initial.y.copy()
        y[: shown.k.size] = shown.columns[0] @ course.w + shown.bend * self._bend(xi) + shown.k * u_last
        s = np.zeros(len(problem.waveforms))
        s[self.source] = u_last
        sign = np.where(self.scene.net.gap >= 0, 1.0 if xi >= 0.0 else -1.0, 1.0)
        return State(t, y, s, sign, self.scene.charge_law)

    def charge_error(self, problem: Problem, course: Course, peak_u: float) -> float:
        held = self.shown.capacitance * (problem.largest + peak_u)
        return 4e-16 * held * (1.0 + int(course.counters[relaxation.STEPS]))


def finger(problem: Problem, rtol: float) -> Finger | None:
    """The network prepared for recordings, or None where this form does not apply or no polynomial is good enough."""
    found, scene = recording_of(problem), problem.scene
    if found is None or not is_followed(scene, problem.circuit):
        return None
    source, wave = found
    at_rest = network_modes(scene.network, scene.area0)
    gap = int(scene.net.gap.max())
    tap = scene.network.p @ at_rest.shape
    tap_s = scene.network.q - scene.network.p @ at_rest.follow
    share = _largest_share(
        at_rest.rates, at_rest.gains[:, source], tap[gap], float(tap_s[gap, source]), wave.rate, problem.t_stop
    )
    typical = _TYPICAL * min(scene.u_top, share * float(np.abs(wave.values).max(initial=0.0)))
    (moving,) = np.flatnonzero(scene.net.gap >= 0)
    q0 = float(inverse_area(typical, scene.net.curves[moving])[0])
    area0 = scene.area0.copy()
    area0[moving] = 1.0 / q0
    return _prepared(problem, source, area0, q0, share, rtol)


def _largest_share(
    rates: FloatArray, gain: FloatArray, gap: FloatArray, gap_s: float, rate: float, stop: float
) -> float:
    """The gap's largest share of a sine of the source, over the frequencies that a recording may have."""
    omega = 2.0 * np.pi * np.geomspace(min(1.0 / stop, 0.4 * rate), 0.5 * rate, _FREQUENCIES)
    response = gap_s + ((gap * gain) / (1j * omega[:, None] + rates)).sum(axis=1)
    return float(np.abs(response).max())


def _curves(
    curve: FloatArray, q0: float, kappa: float, top: float, tol: float
) -> tuple[FloatArray, FloatArray, float] | None:
    """1/A and N as polynomials in xi, and their `scale`; None where no degree up to MOST_DEGREE is enough."""
    at = np.cos(np.pi * (np.arange(_POINTS) + 0.5) / _POINTS)
    to_series = np.linalg.inv(series_of.chebvander(at, _POINTS - 1))
    area = to_series @ (1.0 / inverse_area_array(0.5 * top * (at + 1.0), curve)[0])
    integral = series_of.chebint(area, lbnd=-1.0) * 0.5 * top

    def n_at(u: FloatArray) -> FloatArray:
        return np.asarray(series_of.chebval(2.0 * u / top - 1.0, integral) - u / q0)

    def area_at(u: FloatArray) -> FloatArray:
        return np.asarray(series_of.chebval(2.0 * u / top - 1.0, area))

    # The range of xi ends where the gap voltage reaches `top`.
    xi_top = float(top + kappa * n_at(np.array(top)))
    xi = 0.5 * xi_top * (at + 1.0)
    u = xi * top / xi_top
    for _ in range(50):
        step = (u + kappa * n_at(u) - xi) / (1.0 + kappa * (area_at(u) - 1.0 / q0))
        u = np.clip(u - step, 0.0, top)
        if np.abs(step).max() <= 1e-15 * top:
            break
    inverse, bend = to_series @ (1.0 / area_at(u)), to_series @ n_at(u)
    one = _powers(inverse, tol * abs(float(inverse[0])))
    # Of N the voltage kappa N matters, and what it adds to the modes through f, which is of the same size.
    other = _powers(bend, tol * xi_top * q0 / max(kappa * q0, 1.0))
    if one is None or other is None:
        return None
    other[0] -= polyval(-1.0, other)
    return one, other, 2.0 / xi_top


def _powers(series: FloatArray, tol: float) -> FloatArray | None:
    """A Chebyshev series in powers, of a degree that is a multiple of 4; None where no degree is enough."""
    for degree in range(4, relaxation.MOST_DEGREE + 1, 4):
        if np.abs(series[degree + 1 :]).sum() <= tol:
            out = np.empty(degree + 1)
            chebyshev.to_powers(np.ascontiguousarray(series[: degree + 1]), out)
            return out
    return None


def _prepared(problem: Problem, source: int, area0: FloatArray, q0: float, share: float, rtol: float) -> Finger | None:
    scene, network, net = problem.scene, problem.network, problem.scene.net
    modes = network_modes(network, area0)
    n, n_s = modes.gains.shape
    (moving,), gap = np.flatnonzero(net.gap >= 0), int(net.gap.max())
    fed = np.flatnonzero(net.place == moving)
    turn = _turns([network.cells[i].nodes for i in fed], int(np.flatnonzero(fed == gap)[0]))
    feed, c_gap = -modes.take[:, fed], float(net.c[gap])
    tap, tap_s = network.p @ modes.shape, network.q - network.p @ modes.follow
    together = feed @ turn
    absorbed = together * c_gap
    kappa = -float(tap[gap] @ absorbed)
    contact = network.contacts[moving]
    assert contact is not None
    curves = _curves(net.curves[moving], q0, kappa, scene.u_top, AREA_SHARE * rtol)
    if curves is None or not kappa >= 0.0:
        return None
    area, bend, scale = curves
    # The drives: (q - q0) times the voltage of each cell with a fixed leak, and N.
    leaking = [i for i, cell in enumerate(fed) if net.g_total[cell] > 0.0]
    own = np.array([feed[:, i] - (together if fed[i] == gap else 0.0) for i in leaking]).reshape(len(leaking), n)
    strength = np.array([net.g_total[fed[i]] / q0 for i in leaking])
    drives = np.vstack([own * strength[:, None], -modes.rates * absorbed]).T
    taps = np.vstack([tap[gap], tap[fed[leaking]], np.zeros(n)])
    sources = np.append(np.append(tap_s[gap, source], tap_s[fed[leaking], source]), 0.0)
    columns, bends, k = modes.shape, modes.shape @ absorbed, -modes.follow[:, source]
    rates, gain = modes.rates, modes.gains[:, source]
    flows = n_s if problem.charge else 0
    if flows:
        capacitance, leak = network.capacitance(area0)[:, None], network.leak(area0)[:, None]
        lost = network.through @ (leak * tap) + network.delivered[:, :n] @ modes.shape
        if np.any(lost[:, rates == 0.0] != 0.0):
            return None
        lost_s = network.through @ (leak * tap_s) - network.delivered[:, :n] @ modes.follow + network.delivered[:, n:]
        stored, stored_s = (network.through @ (capacitance * x) for x in (tap, tap_s))
        over = np.divide(lost, rates, out=np.zeros_like(lost), where=rates > 0.0)
        through = network.through[:, fed]
        passed = through @ turn
        own_q = np.array([through[:, i] - (passed if fed[i] == gap else 0.0) for i in leaking]).reshape(-1, flows)
        drives_q = np.hstack([(own_q * strength[:, None]).T + over @ drives[:, :-1], np.zeros((flows, 1))])
        columns = np.block([[columns, np.zeros((n, flows))], [stored - over, np.eye(flows)]])
        bends = np.append(bends, stored @ absorbed + passed * c_gap)
        k = np.append(k, stored_s[:, source])
        gain = np.append(gain, lost_s[:, source] + over @ gain)
        rates, drives = np.append(rates, np.zeros(flows)), np.vstack([drives, drives_q])
        taps = np.hstack([taps, np.zeros((taps.shape[0], flows))])
    nodes = network.nodes[:, :n] @ modes.shape
    slope = float(polyval(-1.0, polyder(area))) * scale
    q_rest = float(polyval(-1.0, area))
    most = max(abs(1.0 / q_rest - 1.0 / q0), abs(1.0 / float(polyval(1.0, area)) - 1.0 / q0))
    moves = np.array([np.abs(nodes @ absorbed).max(initial=0.0), np.abs(bends[n:]).max(initial=0.0)]) * most
    shown = relaxation.Shown(
        columns[None], k, np.hstack([nodes, np.zeros((len(nodes), flows))])[None], np.zeros((1, rates.size)),
        np.zeros((1, rates.size, rates.size)), np.zeros((1, rates.size, rates.size)), float(contact.stress(1.0)),
        np.append(np.full(len(leaking), slope), 0.0), 0.0, np.zeros(1), False, bends, flows,
        float(network.capacitance(area0).sum()), moves,
    )  # fmt: skip
    return Finger(
        shown=shown, share=share, u_top=scene.u_top, q_rest=q_rest, scene=scene, source=source, rates=rates, gain=gain,
        feed=np.ascontiguousarray(drives), taps=taps, tap_s=sources, inverse=modes.inverse, follow=modes.follow,
        absorbed=absorbed, area=area, bend=bend, bent=taps[1:-1, :n] @ absorbed, kappa=kappa, scale=scale, q0=q0,
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
