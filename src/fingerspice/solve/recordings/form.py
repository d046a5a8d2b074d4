"""A circuit with one finger prepared for lanes (`engine.lanes.step`): what it has to give, and the form of a stack.

One finger in a network, in the form of `engine.lanes.step`, so that a recording needs one step a sample there, too.

In modes at a reference area A0 a network is v' = -rates v + gain s + feed j, u = tap v + tap_s s, where each cell whose
area moves carries a current beside that at A0 (see `engine.many_areas.form`). Under the local law, and with e = A - A0,
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

import math
from abc import ABC, abstractmethod
from collections import Counter
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar, NamedTuple, Self, cast

import numpy as np
from numpy.polynomial import chebyshev as series_of
from numpy.polynomial.polynomial import polyder, polyval

from fingerspice.base.arrays import BoolArray, FloatArray, aligned
from fingerspice.circuit.circuit import Circuit
from fingerspice.circuit.network import network_modes
from fingerspice.circuit.statespace import Stack
from fingerspice.engine.lanes import rows as of_lanes
from fingerspice.engine.lanes.loops import polynomial_of
from fingerspice.engine.lanes.rows import FADED, Lanes, Marks
from fingerspice.engine.one_area.model import dot, ramp
from fingerspice.engine.one_area.system import System
from fingerspice.numerics import chebyshev
from fingerspice.physics.contact import inverse_area, inverse_area_array
from fingerspice.results.outcome import State
from fingerspice.solve.collocation import by_modes, gap_at, system_of
from fingerspice.solve.problem import Problem
from fingerspice.solve.scenes import BEYOND_PEAK, Scene
from fingerspice.solve.starting import from_loop
from fingerspice.waveforms.samples import Samples

# Number of lanes, each with a piece of a recording.
PIECES = 64
# Numbers of active modes that code is compiled for, as a new one takes 15 to 30 s: others get modes that stay at 0; the
# fewest in a network; and fewest leaks, of which the rest stays at 0, too.
SIZES, LEAST_MODES, LEAST_LEAKS = (2, 4, 7, 10, 14, 20, 28, 40, 56), 4, 2
# Relative error from which on steps in a stack have Simpson's nodes, and need two evaluations in the place of three.
BY_SIMPSON = 1e-5
# Largest degree of the polynomial for 1/A.
MOST_DEGREE = 28
# Truncation error allowed for the polynomial of 1/A, relative to the error asked for or to this one, if that is less:
# terms cost little.
_AREA_SHARE, _COARSEST = 0.003, 1e-5
# Number of Chebyshev points for the area over the gap voltage.
_POINTS = 64
# Ratio of reference areas, so large that there is one.
_ONE_REFERENCE = 1e12
# Number of frequencies at which the gap's share is looked at.
_FREQUENCIES = 65
# Least error that is followed where several modes fade in a sample, and the share in kappa from which on they count:
# what they leave together is known but for about 1e-8.
OF_MANY, ACTING = 1e-7, 0.05
# Reference area: that at this share of the largest gap voltage to expect.
_TYPICAL = 0.5


class Shown(NamedTuple):
    """Quantities k s + columns z + bends N; under `mobile` k s + columns z / A for voltages, columns z + bends A s."""

    columns: FloatArray  # (C, m)
    # k, bends (C,)
    k: FloatArray
    bends: FloatArray
    by_area: BoolArray  # (C,): Whether the modes' part has the factor 1/A


@dataclass(frozen=True)
class LaneForm(ABC):
    """A circuit prepared for recordings, for all tolerances of one decade."""

    lanes: Lanes
    active: int  # Number of modes that are not passive
    inner: int  # Number of nodes within a step
    mobile: bool  # Charge law
    rows: Shown  # What is recorded: voltages, and the charges
    judged: Shown  # What has an error of its own beside gap voltage and force: voltages of the nodes, and the charges
    flows: int  # Number of charges, whose rates are recorded, too
    stress: float  # Force per area and squared gap voltage, Pa/V^2
    gain: float  # Largest gap voltage to expect for a peak of the source of 1, V/V or V/A
    u_top: float  # Largest gap voltage that the polynomials cover, V
    # missed, missed_bend: Errors of the polynomials: of 1/A, relative, and of N, V m^2
    missed: float
    missed_bend: float
    held: float  # Capacitance of what stores the charges, F
    bent: ClassVar[bool] = False  # Whether N is a drive, as in a network

    @abstractmethod
    def start(self, problem: Problem) -> tuple[FloatArray, float]:
        """The modes (m,), behind them under `mobile` the gap voltage, and the source at the start of a run."""

    @abstractmethod
    def state(self, problem: Problem, z: FloatArray, t: float, u_last: float) -> State:
        """The state at modes as in `start` and `t` (s), where the source has the value `u_last`."""

    def marks(self, own: bool) -> Marks:
        """The lengths that the compiled code knows; `own` weights are those of each lane."""
        leaks = self.lanes.tap_s.size
        kind = of_lanes.MobileMarks if self.mobile else of_lanes.NetworkMarks if self.bent else of_lanes.StackMarks
        sizes = self.lanes.rates.size, self.active, self.inner, leaks, self.lanes.feed.shape[1] - leaks
        return kind(*((0,) * size for size in (*sizes, int(self.mobile), PIECES, int(own))))

    def roomy(self, least: int = 1) -> Self:
        """The form for as many modes and leaks as code is compiled for, with the charges behind the nodes in `judged`.

        What modes are multiplied with may leave out the passive ones at its end.
        """
        lanes, n, leaks, rows = self.lanes, self.active, self.lanes.tap_s.size, self.rows
        active, more = next((size for size in SIZES if size >= max(n, least)), n), [leaks] * max(LEAST_LEAKS - leaks, 0)

        def wide(x: FloatArray) -> FloatArray:
            out = np.zeros((*x.shape[:-1], active + self.lanes.rates.size - n))
            out[..., :n], out[..., active : active + x.shape[-1] - n] = x[..., :n], x[..., n:]
            return out

        lanes = lanes._replace(
            rates=wide(lanes.rates), gain=wide(lanes.gain), shape=wide(lanes.shape),
            taps=wide(np.insert(lanes.taps, more, 0.0, axis=0)), tap_s=np.insert(lanes.tap_s, more, 0.0),
            bent=np.insert(lanes.bent, more, 0.0), kinks=np.insert(lanes.kinks, more, 0.0),
            feed=wide(np.insert(lanes.feed, more, 0.0, axis=1).T).T.copy(),
        )  # fmt: skip
        rows, nodes = (shown._replace(columns=wide(shown.columns)) for shown in (rows, self.judged))
        charges = rows.k.size - self.flows
        judged = Shown(*(np.concatenate([a, b[charges:]]) for a, b in zip(nodes, rows, strict=True)))
        return replace(self, lanes=lanes, active=active, rows=rows, judged=judged)

    def room(self, own: bool) -> tuple[FloatArray, FloatArray]:
        """Arrays for the lanes' state, and for weights of steps (2, rows, 1 or lanes): of length 0, and by `weigh`."""
        marks, wide = self.marks(own), PIECES if own else 1
        count = of_lanes.weighed(*map(len, marks[:5])).end
        state, weights = aligned([(of_lanes.rows_of(marks).end * PIECES,), (2, count, wide)])
        self.weigh(np.zeros(wide), weights[0])
        return state, weights

    def weigh(self, h: FloatArray, out: FloatArray) -> None:
        """Weights of steps of the lengths h (s), shape (n,), into `out` (rows, n)."""
        of_lanes.weigh(self.lanes, self.active, self.inner, h, out)

    def polynomial(self, powers: FloatArray, xi: FloatArray) -> FloatArray:
        """One of `lanes` at xi (V)."""
        c, flat, out = self.lanes, np.ravel(xi), np.empty(np.size(xi))
        polynomial_of(powers, c.scale, c.shift, flat, out)
        return out.reshape(np.shape(xi))

    def inverse_area(self, xi: FloatArray) -> FloatArray:
        """1/A, 1/m^2."""
        return np.asarray(self.lanes.q0 + self.polynomial(self.lanes.area, xi))

    def bend(self, xi: FloatArray) -> FloatArray:
        """N, V m^2."""
        found = self.polynomial(self.lanes.bend, xi)
        return np.negative(found, out=found, where=xi < 0.0)

    def gap(self, xi: FloatArray) -> FloatArray:
        """Gap voltages, V."""
        return np.asarray(xi - self.lanes.kappa * self.bend(xi)) if self.lanes.kappa > 0.0 else xi

    def force(self, xi: FloatArray) -> FloatArray:
        """Force, N."""
        u = self.gap(xi)
        return np.asarray(self.stress * u * u / self.inverse_area(xi))

    def moved(self, xi: FloatArray, source: FloatArray) -> FloatArray:
        """What `Shown.bends` multiplies: N, or A s (V m^2)."""
        return np.asarray(source / self.inverse_area(xi)) if self.mobile else self.bend(xi)

    @cached_property
    def xi(self) -> FloatArray:
        """xi by the source and the modes; under `mobile` the gap voltage, which stands behind the modes."""
        c = self.lanes
        return np.append(0.0 * c.shape, [0.0, 1.0]) if self.mobile else np.append(c.k, c.shape)

    @cached_property
    def shown(self) -> FloatArray:
        """What is recorded, by the source and the modes (C, 1 + m), but for what depends on the area."""
        return np.column_stack([np.where(self.rows.by_area, 0.0, self.rows.k), self.rows.columns])

    def xi_at(self, z: FloatArray, source: float) -> float:
        """xi (V) at modes as in `start`."""
        return float(self.xi[0] * source + self.xi[1:] @ z)

    def held_at(self, z: FloatArray, xi: float, source: float) -> FloatArray:
        """What `rows` show (C,) of modes as in `start`; under `mobile` but for what depends on the area."""
        rows, bend = self.rows, 0.0 if self.mobile else self.bend(np.array(xi))
        return np.asarray(rows.columns @ z[: self.lanes.rates.size] + rows.bends * bend + rows.k * source)


def as_powers(series: FloatArray, tol: float) -> tuple[FloatArray, float]:
    """A Chebyshev series in powers, of a degree 4 k, and what that lacks; empty if more than `tol`."""
    for degree in range(4, MOST_DEGREE + 1, 4):
        off = float(np.abs(series[degree + 1 :]).sum())
        if off <= tol:
            out = np.empty(degree + 1)
            chebyshev.to_powers(series[: degree + 1], out)
            return out, off
    return np.empty(0), 0.0


def curves(
    curve: FloatArray, q0: float, kappa: float, top: float, rtol: float
) -> tuple[dict[str, Any], float, float] | None:
    """The polynomials of `Lanes` and what goes with them, up to the gap voltage `top` (V), and `LaneForm.missed` and
    `missed_bend`; None where no allowed degree is enough for errors of `rtol`."""
    tol = _AREA_SHARE * min(rtol, _COARSEST)
    at = series_of.chebpts1(_POINTS)
    to_series, u = np.linalg.inv(series_of.chebvander(at, _POINTS - 1)), 0.5 * top * (at + 1.0)
    area = to_series @ (1.0 / inverse_area_array(u, curve)[0])
    integral = series_of.chebint(area, lbnd=-1.0) * 0.5 * top
    # The range of xi ends where the gap voltage reaches `top`.
    xi_top = float(top + kappa * (integral.sum() - top / q0))
    xi = u * xi_top / top
    for _ in range(50):
        basis = series_of.chebvander(2.0 * u / top - 1.0, _POINTS)
        n, a = basis @ integral - u / q0, basis[:, :-1] @ area
        step = (u + kappa * n - xi) / (1.0 + kappa * (a - 1.0 / q0))
        if np.abs(step).max() <= 1e-15 * top:
            break
        u = np.clip(u - step, 0.0, top)
    inverse, bend = to_series @ (1.0 / a), to_series @ n
    one, off_one = as_powers(inverse, tol * abs(float(inverse[0])))
    # N acts at full strength, on charges too: compared with the whole integral of A. In a stack no step needs it.
    of_bend = tol if kappa > 0.0 else max(1e-3 * tol, min(tol, 1e-13))
    other, off_other = as_powers(bend, of_bend * xi_top / q0)
    if one.size == 0 or other.size == 0:
        return None
    one[0] -= q0
    other[0] -= polyval(-1.0, other)
    scale = 2.0 / xi_top
    slope = np.append(scale * polyder(one), 0.0)
    found = {
        "area": one, "slope": slope, "bend": other, "scale": scale, "shift": -1.0, "q0": q0, "kappa": kappa,
        "rest": float(polyval(-1.0, one)), "steep": float(polyval(-1.0, slope)),
    }  # fmt: skip
    return found, off_one / abs(float(inverse[0])), off_other


@dataclass(frozen=True)
class StackForm(LaneForm):
    """A stack prepared for recordings; the charge is its last mode, where it is wanted."""

    system: System

    def start(self, problem: Problem) -> tuple[FloatArray, float]:
        (y, u_gap), z, before = problem.inner, np.zeros(self.lanes.rates.size), float(problem.initial.s_before[0])
        z[: y.size - 1] = self.system.project[0] @ y[:-1]
        if self.flows:
            z[self.active] = y[-1] - self.held_at(z, u_gap, before)[-1]
        return np.append(z, u_gap) if self.mobile else z, before

    def after(self, z: FloatArray, to: float) -> float:
        """Under `mobile` the gap voltage (V) after a jump of the source to `to`; NaN where it meets a fold."""
        model = self.system.model
        return float(ramp(model, model.k_gap * to, dot(self.system.gap[0], z), float(z[-1])))

    def state(self, problem: Problem, z: FloatArray, t: float, u_last: float) -> State:
        (y, _), u_gap = problem.inner, self.xi_at(z, u_last)
        charge = self.held_at(z, u_gap, u_last)[-1] if self.flows else y[-1]
        y = np.append(self.system.live[0] @ z[: y.size - 1], charge)
        u_gap = gap_at(self.system.model, y, u_last, math.copysign(1.0, u_gap), u_gap)
        return from_loop(problem.scene, t, y, u_last, u_gap)


def rounded_peak(peak: float) -> float:
    """A peak (V) rounded up to one of four values an octave, so that recordings of about the same peak share forms."""
    return 2.0 ** (math.ceil(4.0 * math.log2(peak)) / 4.0) if peak > 0.0 else 0.0


def stack(problem: Problem, rtol: float) -> StackForm | None:
    """The stack prepared for recordings with about its peak; None where no polynomial represents 1/A well enough."""
    scene, decade = problem.scene, int(np.floor(np.log10(rtol)))
    peak = rounded_peak(scene.u_peak)
    system = system_of(scene, decade, BEYOND_PEAK * peak, _ONE_REFERENCE, peak)
    model, q0, stack = system.model, float(system.q0[0]), scene.network.stack
    found = curves(model.curve, q0, 0.0, system.u_top, rtol)
    assert stack is not None
    if found is None or stack.gap is None or (stack.g_area[stack.gap] > 0.0 and not model.mobile):
        return None
    curve, missed, missed_bend = found
    rates, gain, feed, taps, tap_s = system.rates[0], system.gain[0], system.feed[0], system.tap[0], system.tap_k
    n, area0, shape, kinks, by = rates.size, model.area0, system.gap[0], np.full(tap_s.size, curve["steep"]), 1.0
    if model.mobile:
        # The last drive is A - 1/q0 times the source.
        feed = np.column_stack([feed, system.push[0] / area0])
        kinks = np.append(kinks, -curve["steep"] / (q0 + curve["rest"]) ** 2)
        shape, by, missed_bend = area0 * q0 * shape, area0, missed * peak / q0
    moves = np.zeros(system.k_shown.size)
    columns, k, nodes = by * system.shown[0], system.k_shown, by * system.node[0]
    if problem.charge:
        column, stored, gain_of, feed_of, moved = _charge(system, stack)
        rates, gain, feed = np.append(rates, 0.0), np.append(gain, gain_of), np.vstack([feed, feed_of])
        columns = np.vstack([np.pad(columns, ((0, 0), (0, 1))), np.append(column, 1.0)])
        k, moves = np.append(k, stored), np.append(moves, moved)
    own = rates, gain, shape, float(model.k_gap), taps, tap_s, np.zeros(tap_s.size), feed
    shown = Shown(columns, k, moves, (np.arange(k.size) < system.k_shown.size) & model.mobile)
    of_nodes = Shown(nodes, system.k_node, 0.0 * system.k_node, np.full(system.k_node.size, model.mobile))
    return StackForm(
        Lanes(*own, kinks=kinks, fast=0, **curve), n, 1 if rtol >= BY_SIMPSON else 2, model.mobile, shown, of_nodes,
        int(problem.charge), system.stress, float(model.k_gap), system.u_top, missed, missed_bend,
        float(model.slow[-3]) * area0, system,
    ).roomy()  # fmt: skip


def _charge(system: System, stack: Stack) -> tuple[FloatArray, float, float, FloatArray, float]:
    """The charge as columns z + k s + y + moved N with y' = gain s + feed g, or with A s for N under `mobile`.

    Through the slowest layer, under `local` i = A0 (c v' + g v) + G v + j, where v = share s + own z is its voltage and
    j the current by the change of the area (`solve.recordings.form`): c_gap N' + A0 (q - q0) (G v - G_gap u). Under
    `mobile` i = (c A v)' + (g A + G) v, where v = share s + A0 q own z.
    """
    model, q0 = system.model, float(system.q0[0])
    rates, own, mobile = system.rates[0], system.slow[0], model.mobile
    share, c, g_area, g_total = cast("list[float]", model.slow[rates.size :].tolist())
    area0 = model.area0 if mobile else 1.0 / q0
    leak = (g_area * area0 + g_total * area0 * q0) * own
    over = np.divide(leak, rates, out=np.zeros_like(leak), where=rates > 0.0)
    order = np.array(stack.state_order)
    leaking = order[stack.g_total[order] > 0.0]
    slow = int(np.argmin(stack.leak_rates(model.area0)))
    turned = (leaking == slow).astype(float)
    gain = (g_area / q0 + g_total) * share + float(over @ system.gain[0])
    if mobile:
        feed = np.append(
            over @ system.feed[0] + area0 * stack.g_total[leaking] * turned,
            over @ system.push[0] / area0 + g_area * share,
        )  # fmt: skip
        return area0 * c * own - over, 0.0, gain, feed, c * share
    feed = over @ system.feed[0] + area0 * stack.g_total[leaking] * (turned - (leaking == stack.gap))
    return area0 * c * own - over, area0 * c * share, gain, feed, float(stack.c[stack.gap])


class Reduced:
    """A network with one moving area and one `source` that is not 0, in modes w at `area0`; behind them the charges."""

    def __init__(self, scene: Scene, source: int, area0: FloatArray, charge: bool) -> None:
        net, network = scene.net, scene.network
        self.source, modes = source, network_modes(network, area0)
        # The area that moves, and the cell whose voltage it follows.
        self.moving = int(np.flatnonzero(net.gap >= 0)[0])
        self.gap, self.q0, self.modes = int(net.gap[self.moving]), 1.0 / float(area0[self.moving]), modes
        n, n_s = modes.rates.size, modes.gains.shape[1] if charge else 0
        none = np.zeros((n, n_s))
        # Voltages of all cells, and what the sources deliver, from v and from the sources.
        by = by_modes(network, modes, area0)
        tap, tap_s = by["tap"], by["tap_s"]
        lost, lost_s, stored, stored_s = (by[name][:n_s] for name in ("lost", "lost_s", "stored", "stored_s"))
        # The cells whose area moves, and the direction of each along their path, relative to that of the gap: 1 or -1,
        # by the current that leaves nothing at the nodes inside the path.
        fed = np.flatnonzero(net.place == self.moving)
        pairs = [network.cells[i].nodes for i in fed]
        ends = Counter(node for pair in pairs for node in pair)
        inner = [[(a == node) - (b == node) for a, b in pairs] for node, count in ends.items() if count == 2]
        current = np.linalg.svd(np.array(inner, float).reshape(-1, fed.size))[2][-1]
        turn = np.round(current / current[fed == self.gap])
        # f c_gap of the module: v = w + absorbed N. Behind an ideal source kappa is 0, or rounding.
        self.absorbed = -modes.take[:, fed] @ turn * net.c[self.gap]
        self.kappa = max(-float(tap[self.gap] @ self.absorbed), 0.0)
        # The voltages of those of them that have a fixed leak, from w and the source: what 1/A - q0 multiplies.
        leaking = fed[net.g_total[fed] > 0.0]
        self.taps, self.tap_s, self.bent = tap[leaking], tap_s[leaking, source], tap[leaking] @ self.absorbed

        def leaks(through: FloatArray) -> FloatArray:
            """Forcing by (q - q0) times each of these voltages; `through` (rows, n_f) is that by the currents."""
            own = through[:, net.g_total[fed] > 0.0] - np.outer(through @ turn, leaking == self.gap)
            return np.asarray(own * (net.g_total[leaking] / self.q0))

        # A charge is z = stored v + stored_s s + passed c_gap N + y, where y' = lost v + lost_s s and the change of the
        # leaks. One more mode is y + sum over k of lost_k / rate_k w_k, which no other mode drives.
        through = network.through[:n_s]
        # Whether no mode that does not decay takes part in a current; else there is no such mode.
        self.decays = not np.any(lost[:, modes.rates == 0.0])
        over = np.divide(lost, modes.rates, out=np.zeros_like(lost), where=modes.rates > 0.0)
        # w' = -rates w + gain s + feed g, by (q - q0) times each tap, and last by N, which cancels in the charges.
        self.rates, gain = np.append(modes.rates, np.zeros(n_s)), modes.gains[:, source]
        by_leaks = leaks(-modes.take[:, fed])
        self.gain = np.append(gain, lost_s[:, source] + over @ gain)
        by_bend = np.append(-modes.rates * self.absorbed, np.zeros(n_s))
        self.feed = np.column_stack([np.vstack([by_leaks, leaks(through[:, fed]) + over @ by_leaks]), by_bend])
        # xi from w and the source; state voltages and charges from w, N and the source; voltages of the nodes.
        self.shape, self.k = tap[self.gap], float(tap_s[self.gap, source])
        moved = stored @ self.absorbed + through[:, fed] @ turn * net.c[self.gap]
        self.rows = Shown(
            np.block([[modes.shape, none], [stored - over, np.eye(n_s)]]),
            np.append(-modes.follow[:, source], stored_s[:, source]),
            np.append(modes.shape @ self.absorbed, moved), np.zeros(n + n_s, bool),
        )  # fmt: skip
        nodes, still = by["node"], np.zeros(len(by["node"]))
        self.nodes = Shown(nodes, still, nodes @ self.absorbed, still > 0.0)


def is_followed(scene: Scene, circuit: Circuit) -> bool:
    """Whether a network's scene has one area that moves, at once and under the local law, of cells in series."""
    net = scene.net
    moving = np.flatnonzero(net.gap >= 0)
    if net.mobile or moving.size != 1 or net.slow[moving[0]] >= 0 or net.g_area[net.gap[moving[0]]] > 0.0:
        return False
    own = {cell.element.name: cell.element.nodes[:2] for cell in scene.network.cells if cell.area == moving[0]}
    ends = Counter(node for nodes in own.values() for node in nodes)
    every = Counter(node for e in circuit.elements for node in e.nodes[:2])
    # A path of k elements has k - 1 nodes inside, which nothing else touches, and two ends.
    inner = [node for node, count in ends.items() if count == every[node] == 2]
    return len(ends) - 1 == len(own) == len(inner) + 1


@dataclass(frozen=True)
class NetworkForm(LaneForm):
    """A network prepared for recordings; the charges are its last modes, where they are wanted."""

    reduced: Reduced
    bent: ClassVar[bool] = True

    def start(self, problem: Problem) -> tuple[FloatArray, float]:
        start, reduced, c = problem.initial, self.reduced, self.lanes
        n = reduced.absorbed.size
        x, s, net = start.y[:n], start.s_before, problem.scene.net
        u = xi = float(net.p[reduced.gap] @ x + net.q[reduced.gap] @ s)
        # Newton's method from the gap voltage to xi.
        for _ in range(50):
            e = 1.0 / float(self.inverse_area(np.array(xi))) - 1.0 / c.q0
            step = (xi - c.kappa * float(self.bend(np.array(xi))) - u) * (1.0 + c.kappa * e)
            xi -= step
            if abs(step) <= 1e-15 * abs(xi):
                break
        z, source = np.zeros(c.rates.size), float(s[reduced.source])
        z[:n] = reduced.modes.inverse @ (x + reduced.modes.follow @ s) - reduced.absorbed * self.bend(np.array(xi))
        z[self.active :] = start.y[n : n + self.flows] - self.held_at(z, xi, source)[n:]
        return z, source

    def state(self, problem: Problem, z: FloatArray, t: float, u_last: float) -> State:
        xi, y = self.xi_at(z, u_last), problem.initial.y.copy()
        y[: self.rows.k.size] = self.held_at(z, xi, u_last)
        s, sign = np.zeros(len(problem.network.waveforms)), np.ones(problem.scene.net.gap.size)
        s[self.reduced.source], sign[self.reduced.moving] = u_last, 1.0 if xi >= 0.0 else -1.0
        return State(t, y, s, sign, problem.scene.charge_law)


def finger(problem: Problem, rtol: float, source: int, wave: Samples) -> NetworkForm | None:
    """The network under a recording as its source of that number; None where no form or no polynomial serves."""
    scene = problem.scene
    if not is_followed(scene, problem.circuit):
        return None
    # The gap's largest share of a sine of the source, over the frequencies that a recording may have.
    one, lowest = Reduced(scene, source, scene.net.area0, False), min(1.0 / problem.t_stop, 0.4 * wave.rate)
    omega = 2.0 * np.pi * np.geomspace(lowest, 0.5 * wave.rate, _FREQUENCIES)
    response = one.k + (one.shape * one.gain / (1j * omega[:, None] + one.rates)).sum(axis=1)
    share, moving = float(np.abs(response).max()), one.moving
    # The peak of a current is not known to the scene; that of a voltage has been looked up in the file already.
    typical = _TYPICAL * min(scene.u_top, share * (scene.u_peak or wave.peak(0.0, problem.t_stop)))
    area0 = scene.net.area0.copy()
    area0[moving] = 1.0 / inverse_area(typical, scene.net.curves[moving])[0]
    one = Reduced(scene, source, area0, problem.charge)
    polynomials = curves(scene.net.curves[moving], one.q0, one.kappa, scene.u_top, rtol)
    contact = problem.network.contacts[moving]
    if not one.decays or polynomials is None or contact is None:
        return None
    shares = np.abs(one.shape * one.absorbed)
    fading = (one.modes.rates > FADED * wave.rate) & (shares > ACTING * one.kappa)
    if rtol < OF_MANY and np.count_nonzero(fading) > 1:
        return None
    curve, missed, missed_bend = polynomials
    # 1/A - q0 has the kink of 1/A, and N the part N''(0) xi |xi| / 2.
    kinks = np.full(one.tap_s.size + 1, curve["steep"])
    kinks[-1] = 0.5 * curve["scale"] ** 2 * polyval(-1.0, polyder(curve["bend"], 2))
    fast = int(np.argmax(shares * one.modes.rates))
    own = one.rates, one.gain, one.shape, one.k, one.taps, one.tap_s, one.bent, one.feed
    return NetworkForm(
        Lanes(*own, kinks=kinks, fast=fast, **curve), one.absorbed.size, 2, False, one.rows, one.nodes,
        one.rates.size - one.absorbed.size, float(contact.stress(1.0)), share, scene.u_top, missed, missed_bend,
        float(problem.network.capacitance(area0).sum()), one,
    ).roomy(LEAST_MODES)  # fmt: skip
