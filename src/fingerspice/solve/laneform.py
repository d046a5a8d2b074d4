"""Circuits with one finger under `local`, prepared for steps in lanes (`engine.lanestep`): stacks."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import lru_cache
from typing import cast

import numpy as np
from numpy.polynomial import chebyshev as series_of
from numpy.polynomial.polynomial import polyder, polyval

from fingerspice.base.arrays import FloatArray
from fingerspice.circuit.statespace import Stack
from fingerspice.engine.blockforms import MOST_DEGREE
from fingerspice.engine.blockrows import area_rows
from fingerspice.engine.lanerows import NODES, PER_MODE, PER_MODE_BENT, Lanes, Marks, rows_of
from fingerspice.engine.lanes import weigh
from fingerspice.engine.system import System
from fingerspice.numerics import chebyshev
from fingerspice.physics.contact import N_PACKED
from fingerspice.results.outcome import State
from fingerspice.solve.problem import Problem
from fingerspice.solve.scenes import BEYOND_PEAK
from fingerspice.solve.stackstate import StackState, from_stack
from fingerspice.solve.track import as_recorded, system_of

# Number of lanes, whose rows fill the processor's vectors, and in which a recording goes as so many pieces.
LANES = 32
# Truncation error allowed for the polynomial of 1/A, relative to the error asked for.
AREA_SHARE = 0.003
# Matrix from values at Chebyshev nodes to the Chebyshev coefficients of the antiderivative of their interpolant.
_POINTS = 40
_NODES = np.cos(np.pi * (np.arange(_POINTS) + 0.5) / _POINTS)
_INTEGRAL = series_of.chebint(np.linalg.inv(series_of.chebvander(_NODES, _POINTS - 1)))
# Ratio of reference areas, so large that there is one.
_ONE_REFERENCE = 1e12


@dataclass(frozen=True)
class Shown:
    """Quantities k s + columns z + bends N."""

    columns: FloatArray  # (C, m)
    k: FloatArray  # (C,)
    bends: FloatArray  # (C,)


@dataclass(frozen=True)
class LaneForm(ABC):
    """A circuit prepared for recordings, for all tolerances of one decade."""

    lanes: Lanes
    active: int  # Number of modes that are not passive
    rows: Shown  # What is recorded: voltages, and the charges
    nodes: Shown
    flows: int  # Number of charges, whose rates are recorded, too
    stress: float  # Force per area and squared gap voltage, Pa/V^2
    gain: float  # Largest gap voltage to expect for a peak of the source of 1, V/V or V/A
    u_top: float  # Largest gap voltage that the polynomials cover, V
    # missed, missed_bend: Errors of the polynomials: of 1/A, relative, and of N, V m^2
    missed: float
    missed_bend: float
    held: float  # Capacitance of what stores the charges, F

    @abstractmethod
    def start(self, problem: Problem) -> tuple[FloatArray, float]:
        """The modes (m,) and the source at the start of a run."""

    @abstractmethod
    def state(self, problem: Problem, z: FloatArray, t: float, u_last: float) -> State:
        """The state at modes z (m,) and `t` (s), where the source has the value `u_last`."""

    @abstractmethod
    def recorded(self, problem: Problem, out: FloatArray) -> FloatArray:
        """Rows of a record from `out` (`width`, n), which begins with those of `rows` and of the charges' rates."""

    def width(self, problem: Problem) -> int:
        """Number of rows of the outputs."""
        return self.rows.k.size + self.flows

    def marks(self, own: bool) -> Marks:
        """The lengths that the compiled code knows; `own` weights are those of each lane."""
        leaks = self.lanes.tap_s.size
        return _marks(self.lanes.rates.size, self.active, leaks, self.lanes.feed.shape[1] - leaks, own)

    @property
    def _weights(self) -> int:
        modes, leaks = self.lanes.rates.size, self.lanes.tap_s.size
        bent = self.lanes.feed.shape[1] > leaks
        return modes * PER_MODE + 1 + (modes * PER_MODE_BENT + (NODES - 1) * (1 + leaks) if bent else 0)

    def room(self, own: bool) -> tuple[FloatArray, FloatArray]:
        """Arrays for the state of the lanes and for weights, which each lane has its `own` of, or all share."""
        return np.zeros(rows_of(self.marks(own)).end * LANES), np.zeros((self._weights, LANES if own else 1))

    def weights(self, h: FloatArray) -> FloatArray:
        """Weights of steps of the lengths h (s), shape (n,): all steps of one length share those of (1,)."""
        out = np.empty((self._weights, h.size))
        weigh(self.lanes, h, out)
        return out

    def _polynomial(self, powers: FloatArray, xi: FloatArray) -> FloatArray:
        c, flat, out = self.lanes, np.ravel(xi), np.empty(np.size(xi))
        area_rows(flat.size, powers, c.scale, c.shift, 0.0, flat, out)
        return out.reshape(np.shape(xi))

    def inverse_area(self, xi: FloatArray) -> FloatArray:
        """1/A, 1/m^2."""
        return np.asarray(self.lanes.q0 + self._polynomial(self.lanes.area, xi))

    def bend(self, xi: FloatArray) -> FloatArray:
        """N, V m^2."""
        found = self._polynomial(self.lanes.bend, xi)
        return np.where(xi >= 0.0, found, -found)

    def gap(self, xi: FloatArray) -> FloatArray:
        """Gap voltages, V."""
        return np.asarray(xi - self.lanes.kappa * self.bend(xi)) if self.lanes.kappa > 0.0 else xi

    def force(self, xi: FloatArray) -> FloatArray:
        """Force, N."""
        u = self.gap(xi)
        return np.asarray(self.stress * u * u / self.inverse_area(xi))

    def xi(self, z: FloatArray, source: float) -> float:
        """xi (V) at modes z (m,)."""
        return float(self.lanes.shape @ z + self.lanes.k * source)


@lru_cache(maxsize=64)
def _marks(modes: int, active: int, leaks: int, bend: int, own: bool) -> Marks:
    return Marks(*((0,) * size for size in (modes, active, leaks, bend, LANES, int(own))))


@dataclass(frozen=True)
class StackForm(LaneForm):
    """A stack prepared for recordings; the charge is its last mode, where it is wanted."""

    system: System

    def _rest(self, z: FloatArray, u_gap: float, source: float) -> float:
        """The charge (C) but for its mode."""
        charge = self.rows.columns[-1, : self.active] @ z[: self.active] + self.rows.k[-1] * source
        return float(charge + self.rows.bends[-1] * self.bend(np.array([u_gap]))[0])

    def start(self, problem: Problem) -> tuple[FloatArray, float]:
        start = problem.inner
        z = self.system.project[0] @ start.y[:-1]
        if self.flows:
            z = np.append(z, start.y[-1] - self._rest(z, start.u_gap, start.u_before))
        return np.asarray(z), start.u_before

    def state(self, problem: Problem, z: FloatArray, t: float, u_last: float) -> State:
        start, u_gap = problem.inner, self.xi(z, u_last)
        charge = z[-1] + self._rest(z, u_gap, u_last) if self.flows else start.y[-1]
        y = np.append(self.system.live[0] @ z[: self.active], charge)
        return from_stack(problem.scene, StackState(t, y, u_last, u_gap, start.offset))

    def recorded(self, problem: Problem, out: FloatArray) -> FloatArray:
        return as_recorded(problem, self.system.model, out.T, np.empty(0))


def rounded_peak(peak: float) -> float:
    """A peak (V) rounded up to one of four values an octave, so that recordings of about the same peak share forms."""
    return 2.0 ** (math.ceil(4.0 * math.log2(peak)) / 4.0) if peak > 0.0 else 0.0


def stack(problem: Problem, rtol: float) -> StackForm | None:
    """The stack prepared for recordings with about its peak; None where no polynomial represents 1/A well enough."""
    scene, decade = problem.scene, int(np.floor(np.log10(rtol)))
    peak = rounded_peak(scene.u_peak)
    system = system_of(scene, decade, BEYOND_PEAK * peak, _ONE_REFERENCE, peak)
    found = area_powers(system, AREA_SHARE * rtol)
    assert scene.stack is not None
    if found is None or scene.stack.gap is None or scene.stack.g_area[scene.stack.gap] > 0.0:
        return None
    area, missed = found
    model, shift, q0 = system.model, -system.lo * system.scale - 1.0, float(system.q0[0])
    area[0] -= q0
    slope = slopes(area, float(system.scale))
    rates, gain, feed, taps, shape = system.rates[0], system.gain[0], system.feed[0], system.tap[0], system.gap[0]
    n, nodes = rates.size, system.node[0]
    columns, k, moves = system.shown[0], system.k_shown, np.zeros(system.k_shown.size)
    if problem.charge:
        column, stored, gain_of, feed_of, moved = _charge(system, scene.stack)
        rates, gain, feed = np.append(rates, 0.0), np.append(gain, gain_of), np.vstack([feed, feed_of])
        columns = np.vstack([_wider(columns), np.append(column, 1.0)])
        k, moves, nodes = np.append(k, stored), np.append(moves, moved), _wider(nodes)
        taps, shape = _wider(taps), np.append(shape, 0.0)
    rates, gain, shape, taps, tap_s, feed = map(
        np.ascontiguousarray, (rates, gain, shape, taps, system.tap_k, feed)
    )  # fmt: skip
    leaks = tap_s.size
    lanes = Lanes(
        rates, gain, shape, float(model.k_gap), taps, tap_s, np.zeros(leaks), feed, area, slope, _bend(system, area),
        float(system.scale), float(shift), q0, 0.0, np.full(leaks, polyval(shift, slope)), 0,
    )  # fmt: skip
    return StackForm(
        lanes, n, Shown(columns, k, moves), Shown(nodes, system.k_node, 0.0 * system.k_node), int(problem.charge),
        system.stress, float(model.k_gap), system.u_top, missed, missed * system.u_top / q0,
        float(model.slow[-3]) * model.area0, system,
    )  # fmt: skip


def _wider(rows: FloatArray) -> FloatArray:
    """Rows (n, m) with a column of zeros behind them."""
    return np.hstack([rows, np.zeros((len(rows), 1))])


def _charge(system: System, stack: Stack) -> tuple[FloatArray, float, float, FloatArray, float]:
    """The charge as columns z + k s + y + moved N with y' = gain s + feed g.

    Through the slowest layer, i = A0 (c v' + g v) + G v + j, where v = share s + own z is its voltage and j the current
    by the change of the area (`solve.netmodal`): c_gap N' + A0 (q - q0) (G v - G_gap u).
    """
    model, area0 = system.model, 1.0 / float(system.q0[0])
    rates, own = system.rates[0], system.slow[0]
    share, c, g_area, g_total = cast("list[float]", model.slow[rates.size :].tolist())
    leak = (g_area * area0 + g_total) * own
    over = np.divide(leak, rates, out=np.zeros_like(leak), where=rates > 0.0)
    order = np.array(stack.state_order)
    leaking = order[stack.g_total[order] > 0.0]
    slow = int(np.argmin(stack.leak_rates(model.area0)))
    turned = (leaking == slow).astype(float) - (leaking == stack.gap)
    gain = (g_area * area0 + g_total) * share + float(over @ system.gain[0])
    feed = over @ system.feed[0] + area0 * stack.g_total[leaking] * turned
    return area0 * c * own - over, area0 * c * share, gain, feed, float(stack.c[stack.gap])


def slopes(area: FloatArray, scale: float) -> FloatArray:
    """Derivative by xi of a polynomial in `scale` xi, with as many terms."""
    return np.append(scale * polyder(area), 0.0)


def _bend(system: System, area: FloatArray) -> FloatArray:
    """N as a polynomial in the variable of `area`, which is 1/A - q0."""
    q0 = float(system.q0[0])
    q = polyval(_NODES, area)
    series = _INTEGRAL @ (-q / (q0 * (q0 + q))) / system.scale
    kept = series[: np.flatnonzero(np.abs(series) > 1e-16 * np.abs(series).max())[-1] + 1]
    # A number of terms that the compiled evaluation takes.
    kept = np.append(kept, np.zeros(-(kept.size - 1) % 4))
    powers = np.empty(kept.size)
    chebyshev.to_powers(kept, powers)
    powers[0] -= polyval(-system.lo * system.scale - 1.0, powers)
    return powers


def area_powers(system: System, tol: float) -> tuple[FloatArray, float] | None:
    """Coefficients of 1/A as a polynomial in the variable of `System`, and its relative error, at most `tol`.

    The degree is a multiple of 4, for the compiled evaluation; None if no degree up to MOST_DEGREE is enough.
    """
    series = np.asarray(system.model.curve[2 + N_PACKED :])
    if not system.scale > 0.0 or series.size < 2:
        return None
    least = abs(float(series[0]))
    powers, off = as_powers(series, tol * least)
    return (powers, off / least) if powers.size else None


def as_powers(series: FloatArray, tol: float) -> tuple[FloatArray, float]:
    """A Chebyshev series in powers, of a degree 4 k, and what that lacks; empty if more than `tol`."""
    for degree in range(4, MOST_DEGREE + 1, 4):
        off = float(np.abs(series[degree + 1 :]).sum())
        if off <= tol:
            kept = np.zeros(degree + 1)
            kept[: min(series.size, degree + 1)] = series[: degree + 1]
            out = np.empty(degree + 1)
            chebyshev.to_powers(kept, out)
            return out, off
    return np.empty(0), 0.0
