"""Stacks prepared for recordings: `engine.system` at one reference area, in the form of `engine.lanestep`."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import cast

import numpy as np
from numpy.polynomial.polynomial import polyval

from fingerspice.base.arrays import FloatArray
from fingerspice.circuit.statespace import Stack
from fingerspice.engine.lanerows import Lanes
from fingerspice.engine.model import dot, ramp
from fingerspice.engine.system import System
from fingerspice.results.outcome import State
from fingerspice.solve.laneform import LaneForm, Shown, curves, slopes
from fingerspice.solve.problem import Problem
from fingerspice.solve.scenes import BEYOND_PEAK
from fingerspice.solve.stackstate import StackState, from_stack
from fingerspice.solve.track import as_recorded, on_branch, system_of

# Ratio of reference areas, so large that there is one.
_ONE_REFERENCE = 1e12


@dataclass(frozen=True)
class StackForm(LaneForm):
    """A stack prepared for recordings; the charge is its last mode, where it is wanted."""

    system: System

    def _rest(self, z: FloatArray, u_gap: float, source: float) -> float:
        """The charge (C) but for its mode, and under `mobile` but for A s."""
        charge = self.rows.columns[-1, : self.active] @ z[: self.active] + self.rows.k[-1] * source
        return float(charge + (0.0 if self.mobile else self.rows.bends[-1] * self.bend(np.array([u_gap]))[0]))

    def start(self, problem: Problem) -> tuple[FloatArray, float]:
        start = problem.inner
        z = self.system.project[0] @ start.y[:-1]
        if self.flows:
            z = np.append(z, start.y[-1] - self._rest(z, start.u_gap, start.u_before))
        return np.append(z, start.u_gap) if self.mobile else np.asarray(z), start.u_before

    def after(self, z: FloatArray, to: float) -> float:
        if not self.mobile:
            return super().after(z, to)
        model, active = self.system.model, self.active
        return float(ramp(model, model.k_gap * to, dot(self.system.gap[0], z[:active]), float(z[-1])))

    def state(self, problem: Problem, z: FloatArray, t: float, u_last: float) -> State:
        start = problem.inner
        u_gap = self.xi_at(z, u_last)
        charge = z[self.active] + self._rest(z, u_gap, u_last) if self.flows else start.y[-1]
        y = np.append(self.system.live[0] @ z[: self.active], charge)
        found = StackState(t, y, u_last, u_gap, start.offset)
        return from_stack(problem.scene, on_branch(self.system.model, found, math.copysign(1.0, u_gap)))

    def recorded(self, problem: Problem, out: FloatArray) -> FloatArray:
        rows = as_recorded(replace(problem, charge=False), self.system.model, out.T, np.empty(0))
        if self.flows and self.mobile:
            rows[:, self.rows.k.size - 1] -= problem.inner.offset
        return rows


def rounded_peak(peak: float) -> float:
    """A peak (V) rounded up to one of four values an octave, so that recordings of about the same peak share forms."""
    return 2.0 ** (math.ceil(4.0 * math.log2(peak)) / 4.0) if peak > 0.0 else 0.0


def stack(problem: Problem, rtol: float) -> StackForm | None:
    """The stack prepared for recordings with about its peak; None where no polynomial represents 1/A well enough."""
    scene, decade = problem.scene, int(np.floor(np.log10(rtol)))
    peak = rounded_peak(scene.u_peak)
    system = system_of(scene, decade, BEYOND_PEAK * peak, _ONE_REFERENCE, peak)
    model, q0, stack = system.model, float(system.q0[0]), scene.stack
    found = curves(model.curve, q0, 0.0, system.u_top, rtol)
    assert stack is not None
    if found is None or stack.gap is None or (stack.g_area[stack.gap] > 0.0 and not model.mobile):
        return None
    area, bend, scale, missed, missed_bend = found
    slope = slopes(area, scale)
    rest, steep = float(polyval(-1.0, area)), float(polyval(-1.0, slope))
    rates, gain, feed, taps, tap_s = system.rates[0], system.gain[0], system.feed[0], system.tap[0], system.tap_k
    n, area0, shape, kinks, by = rates.size, model.area0, system.gap[0], np.full(tap_s.size, steep), 1.0
    if model.mobile:
        # The last drive is A - 1/q0 times the source.
        feed, kinks = np.column_stack([feed, system.push[0] / area0]), np.append(kinks, -steep / (q0 + rest) ** 2)
        shape, by, missed_bend = area0 * q0 * shape, area0, missed * peak / q0
    columns, k, moves, nodes = by * system.shown[0], system.k_shown, np.zeros(system.k_shown.size), by * system.node[0]
    if problem.charge:
        column, stored, gain_of, feed_of, moved = _charge(system, stack)
        rates, gain, feed = np.append(rates, 0.0), np.append(gain, gain_of), np.vstack([feed, feed_of])
        columns = np.vstack([_wider(columns), np.append(column, 1.0)])
        k, moves, nodes = np.append(k, stored), np.append(moves, moved), _wider(nodes)
        taps, shape = _wider(taps), np.append(shape, 0.0)
    rates, gain, shape, taps, tap_s, feed = map(
        np.ascontiguousarray, (rates, gain, shape, taps, tap_s, feed)
    )  # fmt: skip
    lanes = Lanes(
        rates, gain, shape, float(model.k_gap), taps, tap_s, np.zeros(tap_s.size), feed, area, slope, bend, scale,
        -1.0, q0, 0.0, kinks, rest, steep, 0,
    )  # fmt: skip
    voltages = np.arange(k.size) < system.k_shown.size
    return StackForm(
        lanes, n, model.mobile, Shown(columns, k, moves, voltages & model.mobile),
        Shown(nodes, system.k_node, 0.0 * system.k_node, np.full(system.k_node.size, model.mobile)),
        int(problem.charge), system.stress, float(model.k_gap), system.u_top, missed, missed_bend,
        float(model.slow[-3]) * area0, system,
    )  # fmt: skip


def _wider(rows: FloatArray) -> FloatArray:
    """Rows (n, m) with a column of zeros behind them."""
    return np.hstack([rows, np.zeros((len(rows), 1))])


def _charge(system: System, stack: Stack) -> tuple[FloatArray, float, float, FloatArray, float]:
    """The charge as columns z + k s + y + moved N with y' = gain s + feed g, or with A s for N under `mobile`.

    Through the slowest layer, under `local` i = A0 (c v' + g v) + G v + j, where v = share s + own z is its voltage and
    j the current by the change of the area (`solve.netmodal`): c_gap N' + A0 (q - q0) (G v - G_gap u). Under `mobile`
    i = (c A v)' + (g A + G) v, where v = share s + A0 q own z.
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
