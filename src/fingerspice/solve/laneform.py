"""A circuit with one finger, prepared for steps in lanes (`engine.lanestep`)."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.polynomial import chebyshev as series_of
from numpy.polynomial.polynomial import polyder, polyval

from fingerspice.base.arrays import BoolArray, FloatArray, aligned
from fingerspice.engine.lanereadout import polynomial_of
from fingerspice.engine.lanerows import (
    Lanes,
    Marks,
    MobileMarks,
    NetworkMarks,
    StackMarks,
    Weighed,
    rows_of,
    weighed,
)
from fingerspice.engine.laneweights import weigh
from fingerspice.numerics import chebyshev
from fingerspice.physics.contact import inverse_area_array
from fingerspice.results.outcome import State
from fingerspice.solve.problem import Problem

# Number of lanes, each with a piece of a recording: of a stack, and of a network, whose rows would not all fit into the
# processor's nearest memory.
OF_STACK, OF_NETWORK = 64, 32
# Largest degree of the polynomial for 1/A.
MOST_DEGREE = 28
# Truncation error allowed for the polynomial of 1/A, relative to the error asked for or to this one, if that is less:
# terms cost little.
_AREA_SHARE, _COARSEST = 0.003, 1e-5
# Number of Chebyshev points for the area over the gap voltage.
_POINTS = 64


@dataclass(frozen=True)
class Shown:
    """Quantities k s + columns z + bends N; under `mobile` k s + columns z / A for voltages, columns z + bends A s."""

    columns: FloatArray  # (C, m)
    # k, bends (C,)
    k: FloatArray
    bends: FloatArray
    by_area: BoolArray  # (C,): Whether the modes' part has the factor 1/A

    def behind(self, first: int) -> Shown:
        """The quantities from number `first` on."""
        return Shown(self.columns[first:], self.k[first:], self.bends[first:], self.by_area[first:])


@dataclass(frozen=True)
class LaneForm(ABC):
    """A circuit prepared for recordings, for all tolerances of one decade."""

    lanes: Lanes
    active: int  # Number of modes that are not passive
    mobile: bool  # Charge law
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
        """The modes (m,), behind them under `mobile` the gap voltage, and the source at the start of a run."""

    @abstractmethod
    def state(self, problem: Problem, z: FloatArray, t: float, u_last: float) -> State:
        """The state at modes as in `start` and `t` (s), where the source has the value `u_last`."""

    @abstractmethod
    def recorded(self, problem: Problem, out: FloatArray) -> FloatArray:
        """Rows of a record from `out` (`width`, n), which begins with those of `rows` and of the charges' rates."""

    def width(self, problem: Problem) -> int:
        """Number of rows of the outputs."""
        return self.rows.k.size + self.flows

    def marks(self, own: bool) -> Marks:
        """The lengths that the compiled code knows; `own` weights are those of each lane."""
        leaks = self.lanes.tap_s.size
        return _marks(
            self.lanes.rates.size, self.active, leaks, self.lanes.feed.shape[1] - leaks, int(self.mobile), self.pieces,
            int(own),
        )  # fmt: skip

    @property
    def bent(self) -> bool:
        """Whether N is a drive, as in a network."""
        return not self.mobile and self.lanes.feed.shape[1] > self.lanes.tap_s.size

    @property
    def weighed(self) -> Weighed:
        """Rows of the weights."""
        modes, leaks = self.lanes.rates.size, self.lanes.tap_s.size
        return weighed(modes, self.active, leaks, self.lanes.feed.shape[1] - leaks)

    @property
    def pieces(self) -> int:
        """Number of lanes."""
        return OF_NETWORK if self.bent else OF_STACK

    def room(self, own: bool) -> tuple[FloatArray, FloatArray]:
        """Arrays for the state of the lanes and for weights, which each lane has its `own` of, or all share."""
        state, weights = aligned(
            [(rows_of(self.marks(own)).end * self.pieces,), (self.weighed.end, self.pieces if own else 1)]
        )
        state[:], weights[:] = 0.0, 0.0
        return state, weights

    def weights(self, h: FloatArray) -> FloatArray:
        """Weights of steps of the lengths h (s), shape (n,): all steps of one length share those of (1,)."""
        out = np.empty((self.weighed.end, h.size))
        weigh(self.lanes, self.active, h, out)
        return out

    def _polynomial(self, powers: FloatArray, xi: FloatArray) -> FloatArray:
        c, flat, out = self.lanes, np.ravel(xi), np.empty(np.size(xi))
        polynomial_of(powers, c.scale, c.shift, flat, out)
        return out.reshape(np.shape(xi))

    def inverse_area(self, xi: FloatArray) -> FloatArray:
        """1/A, 1/m^2."""
        return np.asarray(self.lanes.q0 + self._polynomial(self.lanes.area, xi))

    def slope(self, xi: FloatArray) -> FloatArray:
        """Derivative of 1/A by |xi|, 1/m^2/V."""
        return self._polynomial(self.lanes.slope, xi)

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

    def moved(self, xi: FloatArray, source: FloatArray) -> FloatArray:
        """What `Shown.bends` multiplies: N, or A s (V m^2)."""
        return np.asarray(source / self.inverse_area(xi)) if self.mobile else self.bend(xi)

    @property
    def xi(self) -> tuple[float, FloatArray]:
        """xi as k s + columns z; under `mobile` the gap voltage, which stands behind the modes."""
        c = self.lanes
        return (0.0, np.append(0.0 * c.shape, 1.0)) if self.mobile else (c.k, c.shape)

    def xi_at(self, z: FloatArray, source: float) -> float:
        """xi (V) at modes as in `start`."""
        k, columns = self.xi
        return float(k * source + columns @ z)

    def after(self, z: FloatArray, to: float) -> float:
        """Gap voltage (V) after a jump of the source to `to`; NaN where it meets a fold."""
        return float(self.gap(np.array(self.xi_at(z, to))))


@lru_cache(maxsize=64)
def _marks(modes: int, active: int, leaks: int, bend: int, mobile: int, pieces: int, own: int) -> Marks:
    kind = MobileMarks if mobile else NetworkMarks if bend else StackMarks
    return kind(*((0,) * size for size in (modes, active, leaks, bend, mobile, pieces, own)))


def slopes(area: FloatArray, scale: float) -> FloatArray:
    """Derivative by xi of a polynomial in `scale` xi, with as many terms."""
    return np.append(scale * polyder(area), 0.0)


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


def curves(
    curve: FloatArray, q0: float, kappa: float, top: float, rtol: float
) -> tuple[FloatArray, FloatArray, float, float, float] | None:
    """1/A - q0 and N as polynomials in `scale` xi - 1, the scale, and their errors (of 1/A relative, and V m^2).

    They reach the gap voltage `top` (V). None where no allowed degree is enough for errors of `rtol`.
    """
    tol = _AREA_SHARE * min(rtol, _COARSEST)
    at = np.cos(np.pi * (np.arange(_POINTS) + 0.5) / _POINTS)
    to_series = np.linalg.inv(_chebyshev(at, _POINTS))
    area = to_series @ (1.0 / inverse_area_array(0.5 * top * (at + 1.0), curve)[0])
    integral = series_of.chebint(area, lbnd=-1.0) * 0.5 * top
    # The range of xi ends where the gap voltage reaches `top`.
    xi_top = float(top + kappa * (integral.sum() - top / q0))
    xi = 0.5 * xi_top * (at + 1.0)
    u = xi * top / xi_top
    for _ in range(50):
        basis = _chebyshev(2.0 * u / top - 1.0, _POINTS + 1)
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
    return one, other, 2.0 / xi_top, off_one / abs(float(inverse[0])), off_other


def _chebyshev(x: FloatArray, count: int) -> FloatArray:
    """The first Chebyshev polynomials at x (n,) from -1 to 1, shape (n, count)."""
    return np.asarray(np.cos(np.arange(count) * np.arccos(np.clip(x, -1.0, 1.0))[:, None]))
