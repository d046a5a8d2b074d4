"""One finger in a network prepared for recordings: `solve.netmodal` in the form of `engine.relaxation`."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.polynomial import chebyshev as series_of
from numpy.polynomial.polynomial import polyder, polyval

from fingerspice.base.arrays import BoolArray, FloatArray
from fingerspice.circuit.circuit import Circuit
from fingerspice.engine import blockforms
from fingerspice.engine.blockcourse import Course, new_charges
from fingerspice.engine.blockforms import Form
from fingerspice.engine.model import Model
from fingerspice.numerics import chebyshev
from fingerspice.physics.contact import inverse_area, inverse_area_array
from fingerspice.results.outcome import State
from fingerspice.solve.forms import FADED, Follower, weighted
from fingerspice.solve.laneform import AREA_SHARE
from fingerspice.solve.netmodal import Modal, Reduced
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
    """A network prepared for recordings."""

    reduced: Reduced
    modal: Modal
    # area, bend: 1/A and N, see `Form`; `scale` is that of their variable
    area: FloatArray
    bend: FloatArray
    scale: float
    missed_bend: float  # Error of N, V m^2

    def form(self, spacing: float) -> Form:
        one, reduced = self.modal, self.reduced
        n = reduced.absorbed.size
        return weighted(
            one.rates[None], one.gain[None], one.drives[None], one.taps[None], one.tap_s, spacing, self._fast(spacing),
            mobile=False, q0=np.array([reduced.q0]), area=self.area, scale=self.scale, shift=-1.0,
            k_gap=float(one.tap_s[0]), area0=1.0 / reduced.q0, kappa=reduced.kappa, bend=self.bend,
            bent=one.taps[1:-1, :n] @ reduced.absorbed,
        )  # fmt: skip

    def _fast(self, spacing: float) -> int:
        """The mode with the largest share in kappa of those that decay within a small part of a spacing (s), or -1."""
        rates, absorbed = self.reduced.modes.rates, self.reduced.absorbed
        shares = np.where(rates * spacing > FADED, np.abs(self.modal.taps[0, : rates.size] * absorbed), 0.0)
        return int(np.argmax(shares)) if shares.max(initial=0.0) > 0.0 else -1

    @cached_property
    def _model(self) -> Model:
        """What the compiled loop reads of a stack's model."""
        nothing, reduced = np.zeros(0), self.reduced
        return Model(
            False, True, np.zeros(1), np.zeros(1), np.zeros(1), float(self.modal.tap_s[0]), nothing, 1.0, np.zeros(4),
            1.0 / reduced.q0, np.inf, reduced.scene.net.curves[reduced.moving],
        )  # fmt: skip

    def _bend(self, xi: float) -> float:
        value = float(polyval(abs(xi) * self.scale - 1.0, self.bend))
        return value if xi >= 0.0 else -value

    def _bend_at(self, u: float) -> float:
        """N at a gap voltage u (V), from xi by Newton's method."""
        xi, kappa, q0 = float(u), self.reduced.kappa, self.reduced.q0
        for _ in range(50):
            e = 1.0 / polyval(abs(xi) * self.scale - 1.0, self.area) - 1.0 / q0
            step = float((xi - kappa * self._bend(xi) - u) * (1.0 + kappa * e))
            xi -= step
            if abs(step) <= 1e-15 * abs(xi):
                break
        return self._bend(xi)

    def course(self, problem: Problem, form: Form) -> Course:
        start, one, reduced = problem.initial, self.modal, self.reduced
        n, m, drives = reduced.absorbed.size, *one.drives.shape
        x, s, net = start.y[:n], start.s_before, reduced.scene.net
        bend = self._bend_at(float(net.p[reduced.gap] @ x + net.q[reduced.gap] @ s))
        w = np.zeros(m)
        w[:n] = reduced.modes.inverse @ (x + reduced.modes.follow @ s) - reduced.absorbed * bend
        held = one.columns @ w + one.bends * bend + one.k * s[reduced.source]
        w[n:] = start.y[n : start.y.size if m > n else n] - held[n:]
        control, counters = blockforms.new_control(), np.zeros(blockforms.N_COUNTERS, np.int64)
        control[blockforms.U_GAP] = one.taps[0] @ w + one.tap_s[0] * s[reduced.source]
        return Course(
            self._model, form, self.shown, blockforms.new_room(m, drives, drives + 1, self.shown), new_charges(),
            np.zeros((3, max(m, drives, 5))), w, np.zeros((2, m)), control, counters, blockforms.new_checks(self.shown),
        )  # fmt: skip

    def rows(self, problem: Problem, t: FloatArray, left: BoolArray, out: FloatArray) -> FloatArray:
        rows = out[:, : t.size].T
        if problem.charge:
            return rows
        return np.hstack([rows, np.tile(problem.initial.y[self.reduced.absorbed.size :], (t.size, 1))])

    def state(self, problem: Problem, course: Course, t: float, u_last: float) -> State:
        one, xi = self.modal, float(course.control[blockforms.U_GAP])
        y = problem.initial.y.copy()
        y[: one.k.size] = one.columns @ course.w + one.bends * self._bend(xi) + one.k * u_last
        s = np.zeros(len(problem.waveforms))
        s[self.reduced.source] = u_last
        sign = np.ones(problem.scene.net.gap.size)
        sign[self.reduced.moving] = 1.0 if xi >= 0.0 else -1.0
        return State(t, y, s, sign, problem.scene.charge_law)

    def charge_error(self, problem: Problem, course: Course, peak_u: float) -> float:
        held = self.shown.capacitance * (problem.largest + peak_u)
        missed = self.missed_bend * float(np.abs(self.modal.bends[self.reduced.absorbed.size :]).max(initial=0.0))
        return missed + 4e-16 * held * (1.0 + int(course.counters[blockforms.STEPS]))


def finger(problem: Problem, rtol: float) -> Finger | None:
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
    curves = _curves(scene.net.curves[moving], reduced.q0, reduced.kappa, scene.u_top, AREA_SHARE * rtol)
    if modal is None or curves is None:
        return None
    area, bend, scale, missed, missed_bend = curves
    q_rest, q_top = float(polyval(-1.0, area)), float(polyval(1.0, area))
    # 1/A - q0 has the kink of 1/A, and N the part N''(0) xi |xi| / 2.
    kinks = np.append(
        np.full(reduced.leaking.size, scale * float(polyval(-1.0, polyder(area)))),
        0.5 * scale**2 * float(polyval(-1.0, polyder(bend, 2))),
    )
    shown = _shown(problem, reduced, modal, kinks, 1.0 / q_rest, 1.0 / q_top)
    return Finger(
        shown,
        share,
        scene.u_top,
        q_rest,
        missed,
        reduced.kappa * missed_bend,
        reduced,
        modal,
        area,
        bend,
        scale,
        missed_bend,
    )


def _shown(
    problem: Problem, reduced: Reduced, modal: Modal, kinks: FloatArray, at_rest: float, at_top: float
) -> blockforms.Shown:
    """Constants of the outputs, from the kinks of the drives and the areas (m^2) at 0 V and at the top."""
    contact, n, m = problem.network.contacts[reduced.moving], reduced.absorbed.size, modal.rates.size
    assert contact is not None
    nodes = modal.nodes[:, :n] @ reduced.absorbed
    moves = max(abs(area - 1.0 / reduced.q0) for area in (at_rest, at_top)) * np.array(
        [np.abs(nodes).max(initial=0.0), np.abs(modal.bends[n:]).max(initial=0.0)]
    )
    none = np.zeros((1, m, m))
    return blockforms.Shown(
        modal.columns[None], modal.k, modal.nodes[None], nodes, none[0, :1], none, none, float(contact.stress(1.0)),
        kinks, 0.0, False, modal.bends, m - n,
        float(problem.network.capacitance(reduced.area0).sum()), moves,
    )  # fmt: skip


def _largest_share(reduced: Reduced, rate: float, stop: float) -> float:
    """The gap's largest share of a sine of the source, over the frequencies that a recording may have."""
    omega = 2.0 * np.pi * np.geomspace(min(1.0 / stop, 0.4 * rate), 0.5 * rate, _FREQUENCIES)
    one = reduced.modal()
    response = one.tap_s[0] + (one.taps[0] * one.gain / (1j * omega[:, None] + one.rates)).sum(axis=1)
    return float(np.abs(response).max())


def _curves(
    curve: FloatArray, q0: float, kappa: float, top: float, tol: float
) -> tuple[FloatArray, FloatArray, float, float, float] | None:
    """1/A and N as polynomials in xi, their `scale`, and their errors (relative, and in V m^2).

    None where no allowed degree is enough.
    """
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
    one, off_one = _powers(inverse, tol * abs(float(inverse[0])))
    # N acts at full strength, on charges too: compared with the whole integral of A.
    other, off_other = _powers(bend, tol * xi_top / q0)
    if one.size == 0 or other.size == 0:
        return None
    other[0] -= polyval(-1.0, other)
    return one, other, 2.0 / xi_top, off_one / abs(float(inverse[0])), off_other


def _powers(series: FloatArray, tol: float) -> tuple[FloatArray, float]:
    """A Chebyshev series in powers, of a degree that is a multiple of 4, and what it lacks; empty if too much."""
    for degree in range(4, blockforms.MOST_DEGREE + 1, 4):
        off = float(np.abs(series[degree + 1 :]).sum())
        if off <= tol:
            out = np.empty(degree + 1)
            chebyshev.to_powers(np.ascontiguousarray(series[: degree + 1]), out)
            return out, off
    return np.empty(0), 0.0
