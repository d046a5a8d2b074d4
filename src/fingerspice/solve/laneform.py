"""Stacks under `local` prepared for steps in lanes (`engine.lanestep`): modes, drives, the charge, and outputs."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import cast

import numpy as np
from numpy.polynomial import chebyshev as series_of
from numpy.polynomial.polynomial import polyder, polyval

from fingerspice.base.arrays import FloatArray
from fingerspice.engine.blockforms import MOST_DEGREE
from fingerspice.engine.lanes import weigh
from fingerspice.engine.lanestep import PER_MODE, Lanes, Marks, places
from fingerspice.engine.system import System
from fingerspice.numerics import chebyshev
from fingerspice.physics.contact import N_PACKED
from fingerspice.solve.problem import Problem
from fingerspice.solve.scenes import BEYOND_PEAK
from fingerspice.solve.track import system_of

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
class LaneForm:
    """A stack prepared for recordings, for all tolerances of one decade."""

    system: System
    lanes: Lanes
    charge: bool
    missed: float  # Relative error of the polynomial of 1/A

    @property
    def u_top(self) -> float:
        """Largest gap voltage that the polynomial covers, V."""
        return self.system.u_top

    def marks(self, own: bool) -> Marks:
        """The lengths that the compiled code knows; `own` weights are those of each lane."""
        return _marks(self.lanes.rates.size, self.lanes.tap_s.size, self.charge, own)

    def room(self, own: bool) -> tuple[FloatArray, FloatArray]:
        """Arrays for the state of the lanes and for weights, which each lane has its `own` of, or all share."""
        rows = self.lanes.rates.size * PER_MODE + 1
        return np.zeros(places(self.marks(own))[-1] * LANES), np.zeros((rows, LANES if own else 1))

    def weights(self, h: FloatArray) -> FloatArray:
        """Weights of steps of the lengths h (s), shape (n,): all steps of one length share those of (1,)."""
        out = np.empty((self.lanes.rates.size * PER_MODE + 1, h.size))
        weigh(self.lanes.rates, self.lanes.gain, h, out)
        return out

    def inverse_area(self, u: FloatArray) -> FloatArray:
        """1/A at gap voltages (V), 1/m^2."""
        c = self.lanes
        return np.asarray(c.q0 + polyval(np.abs(u) * c.scale + c.shift, c.area))

    def force(self, u: FloatArray) -> FloatArray:
        """Force (N) at gap voltages (V)."""
        return np.asarray(self.system.stress * u * u / self.inverse_area(u))

    def charge_at(self, z: FloatArray, u: float) -> float:
        """The charge (C) besides the rider, at modes z (m,) and a gap voltage u (V)."""
        c = self.lanes
        return float(c.held @ z) + math.copysign(float(polyval(abs(u) * c.scale + c.shift, c.moved)), u)


@lru_cache(maxsize=64)
def _marks(modes: int, drives: int, rider: bool, own: bool) -> Marks:
    sizes = (modes, drives, int(rider), LANES, int(own))
    return Marks(*((0,) * size for size in sizes))


def rounded_peak(peak: float) -> float:
    """A peak (V) rounded up to one of four values an octave, so that recordings of about the same peak share forms."""
    return 2.0 ** (math.ceil(4.0 * math.log2(peak)) / 4.0) if peak > 0.0 else 0.0


def prepared(problem: Problem, rtol: float) -> LaneForm | None:
    """The scene prepared for recordings with about its peak; None where no polynomial represents 1/A well enough."""
    scene, decade = problem.scene, int(np.floor(np.log10(rtol)))
    peak = rounded_peak(scene.u_peak)
    system = system_of(scene, decade, BEYOND_PEAK * peak, _ONE_REFERENCE, peak)
    found = area_powers(system, AREA_SHARE * rtol)
    if found is None:
        return None
    area, missed = found
    at_rest, q0 = -system.lo * system.scale - 1.0, float(system.q0[0])
    q_rest = float(polyval(at_rest, area))
    kink = float(polyval(at_rest, polyder(area))) * system.scale
    area[0] -= q0
    c = _constants(system, area, at_rest, kink, -kink / q_rest**2)
    return LaneForm(system, c, problem.charge, missed)


def area_powers(system: System, tol: float) -> tuple[FloatArray, float] | None:
    """Coefficients of 1/A as a polynomial in the variable of `System`, and its relative error, at most `tol`.

    The degree is a multiple of 4, for the compiled evaluation; None if no degree up to MOST_DEGREE is enough.
    """
    series = np.asarray(system.model.curve[2 + N_PACKED :])
    if not system.scale > 0.0 or series.size < 2:
        return None
    for degree in range(4, min(MOST_DEGREE, series.size + 2) + 1, 4):
        missed = float(np.abs(series[degree + 1 :]).sum() / np.abs(series[0]))
        if missed <= tol:
            kept = np.zeros(degree + 1)
            kept[: min(series.size, degree + 1)] = series[: degree + 1]
            out = np.empty(degree + 1)
            chebyshev.to_powers(kept, out)
            return out, missed
    return None


def _constants(system: System, area: FloatArray, shift: float, kink: float, area_kink: float) -> Lanes:
    model, rates, gain, feed, own = system.model, system.rates[0], system.gain[0], system.feed[0], system.slow[0]
    share, c, g_area, g_total = cast("list[float]", model.slow[rates.size :].tolist())
    # i = A (c v' + g_area v) + g_total v, where v = share s + own z is the slowest layer's voltage (`engine.model`), of
    # which v - (share / k) u does not depend on the source's slope.
    ratio = share / model.k_gap
    rest = c * (own - ratio * system.gap[0])
    by_modes, leak = g_area * own - rest * rates, g_total * own
    held = np.where(rates > 0.0, -(by_modes / system.q0[0] + leak) / np.where(rates > 0.0, rates, 1.0), 0.0)
    by_source = np.array([g_area * share + rest @ gain, 0.0])
    by_source[1] = by_source[0] / system.q0[0] + g_total * share - held @ gain
    by_drives = np.array([rest @ feed, rest @ feed / system.q0[0] - held @ feed])
    shape, taps, tap_s, feed = map(np.ascontiguousarray, (system.gap[0], system.tap[0], system.tap_k, feed))
    return Lanes(
        rates, gain, shape, float(model.k_gap), taps, tap_s, feed, area, float(system.scale), shift,
        float(system.q0[0]), kink, by_modes, by_source, by_drives, held, area_kink,
        _moved(system, area, shift, c * ratio), c * ratio,
    )  # fmt: skip


def _moved(system: System, area: FloatArray, at_rest: float, by: float) -> FloatArray:
    """`by` times the integral of A over the gap voltage: a polynomial in the variable of 1/A - q0, 0 at 0 V."""
    q = polyval(_NODES, area) + system.q0[0]
    series = by / system.scale * (_INTEGRAL @ (1.0 / q))
    kept = series[: np.flatnonzero(np.abs(series) > 1e-16 * np.abs(series).max())[-1] + 1]
    # A number of terms that the compiled evaluation takes.
    kept = np.append(kept, np.zeros(-(kept.size - 1) % 4))
    powers = np.empty(kept.size)
    chebyshev.to_powers(kept, powers)
    powers[0] -= polyval(at_rest, powers)
    return powers
