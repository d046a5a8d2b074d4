"""Means, extremes and amplitudes of a run's signals, as integrals over its steps or its outputs."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.polynomial import legendre

from fingerspice.base.arrays import FloatArray, IntArray
from fingerspice.numerics.chebyshev import largest
from fingerspice.numerics.lobatto import BETWEEN, NODES, POINTS

#: From the record of a run to one of its signals, shape (n_t,).
Read = Callable[[Any], FloatArray]

_NODES = POINTS[:NODES]
#: Smallest tolerance of the interpolation error of a panel, relative to the signal's peak.
_FINEST = 1e-12
#: Most halves of panels that are evaluated, in addition to four for each panel.
_MOST_CUT = 4096
#: Most times that one panel is halved.
_MOST_ROUNDS = 60
#: Gauss-Lobatto weights on [0, 1]: exact for polynomials of degree 23.
_WEIGHTS = 1.0 / (NODES * (NODES - 1) * legendre.Legendre.basis(NODES - 1)(2.0 * _NODES - 1.0) ** 2)


class Panels(NamedTuple):
    """Parts of a run on each of which every signal is smooth."""

    step: IntArray  # (p,)
    # low, high (p,): The part of that step that the panel covers, as fractions of its length
    low: FloatArray
    high: FloatArray
    # (p,): Duration, s; longer than the panel itself if the panel represents several equal periods
    duration: FloatArray

    def take(self, which: IntArray) -> Panels:
        """The panels with these numbers."""
        return Panels(self.step[which], self.low[which], self.high[which], self.duration[which])

    def halved(self) -> Panels:
        """The two halves of every panel."""
        middle, half = 0.5 * (self.low + self.high), 0.5 * self.duration
        low, high = np.append(self.low, middle), np.append(middle, self.high)
        return Panels(np.tile(self.step, 2), low, high, np.tile(half, 2))

    def fractions(self, points: FloatArray) -> FloatArray:
        """Points in [0, 1] of each panel as fractions of its step, shape (p, n)."""
        # Written so that the points 0 and 1 give exactly `low` and `high`.
        return np.asarray(self.low[:, None] * (1.0 - points) + self.high[:, None] * points)


class Run(Protocol):
    """A run whose signals can be evaluated between its outputs."""

    def panels(self, since: float, until: float) -> Panels:
        """Parts of the run between two times, s."""

    def at_points(self, read: Read, panels: Panels) -> tuple[FloatArray, FloatArray]:
        """Times (s) and a signal at the `POINTS` of panels, shape (p, ROWS) each."""

    def values_at(self, read: Read, index: IntArray, fraction: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Times (s) and a signal at fractions (p, n) of the steps with these indices (p,), shape (p, n) each."""


@dataclass(frozen=True)
class Weighed:
    """Values of a signal with quadrature weights."""

    # t, weight, x (n,): Times (s), weights whose sum is 1, and the signal in its unit
    t: FloatArray
    weight: FloatArray
    x: FloatArray

    def mean(self, power: int = 1) -> float:
        """Mean of the signal, or of a power of it."""
        # Without BLAS, whose threads cost more than the sum and may round differently.
        return float((self.weight * (self.x if power == 1 else self.x**power)).sum())

    def phasor(self, frequency: float) -> complex:
        """Complex amplitude P of a signal x ~ Im(P exp(i 2 pi f t)); the times cover whole periods."""
        turning = self.weight * np.exp(-2j * np.pi * frequency * self.t)
        return complex(2j * (turning * self.x).sum())


class Stretch:
    """A run between two times (s), with weights and extremes of every signal.

    A panel is halved where the polynomial through its nodes differs from the signal between them: steps are chosen to
    resolve the gap voltage, and the area may change within a small part of the voltage's range.

    Parameters
    ----------
    run : Run
    since, until : float
        s.
    rtol : float
        Error of the run relative to its peaks; means and extremes are computed more exactly.
    longest : float
        s: panels are halved until none is longer.
    """

    def __init__(self, run: Run, since: float, until: float, rtol: float, longest: float = math.inf) -> None:
        self.run, self.span, self.rtol = run, (since, until), rtol
        self.panels = run.panels(since, until)
        while (long := self.panels.duration > longest).any():
            short, halves = self.panels.take(np.flatnonzero(~long)), self.panels.take(np.flatnonzero(long)).halved()
            self.panels = _joined([short, halves])
        self._share, self._shares = _shares(self.panels)

    def weigh(self, read: Read) -> Weighed:
        """A signal with weights for its means."""
        t, x = self.run.at_points(read, self.panels)
        peak = float(np.abs(x).max(initial=0.0)) or 1.0
        missed = _missed(x) / peak
        # Gauss-Lobatto weights integrate polynomials up to twice the degree of the interpolant exactly. If the terms of
        # the series fall geometrically, the quadrature error is about the interpolation error to the power 1.85; 1.5 is
        # on the safe side.
        if float((self._share * missed**1.5).sum()) <= max(_FINEST, 1e-3 * self.rtol):
            return Weighed(t[:, :NODES], self._shares, x[:, :NODES])
        return self._cut(read, t, x, _FINEST)[0]

    def extremes(self, read: Read) -> tuple[float, float]:
        """Smallest and largest value of a signal, evaluated where its polynomials have their extremes."""
        # An interpolation error shifts the place of an extreme, which changes the signal there by its square only.
        weighed, panels = self._cut(read, *self.run.at_points(read, self.panels), max(_FINEST, 1e-3 * self.rtol))
        found = [largest(weighed.x, sign) for sign in (-1.0, 1.0)]
        panel, place = np.array([p for p, _, _ in found]), np.array([x for _, x, _ in found])
        at = panels.low[panel] * (1.0 - place) + panels.high[panel] * place
        _, exact = self.run.values_at(read, panels.step[panel], at[:, None])
        low, high = exact[:, 0].tolist()
        return min(low, float(weighed.x.min())), max(high, float(weighed.x.max()))

    def at_nodes(self, reads: Sequence[Read], tol: float) -> list[FloatArray]:
        """Times (s) and these signals at the nodes of panels on which each misses its polynomial by `tol` of its peak.

        All have the shape (p, NODES). Panels on which the rounding of the time alone is as much, as on an edge of 1 ns,
        are not cut.
        """
        shortest = np.finfo(float).eps * abs(self.span[1]) / tol
        for read in reads:
            self.panels = self._cut(read, *self.run.at_points(read, self.panels), tol, shortest)[1]
        found = [self.run.at_points(read, self.panels) for read in reads]
        return [x[:, :NODES] for x in (found[0][0], *(x for _, x in found))]

    def _cut(
        self, read: Read, t: FloatArray, x: FloatArray, tol: float, shortest: float = 0.0
    ) -> tuple[Weighed, Panels]:
        """A signal, and panels on which its interpolation error is at most `tol` of its peak, or as short as told."""
        smooth = tol * float(np.abs(x).max(initial=0.0))
        panels, parts = self.panels, []
        most = _MOST_CUT + 4 * panels.step.size
        for left in range(_MOST_ROUNDS, 0, -1):
            wrong = (_missed(x) > smooth) & (panels.duration > shortest)
            if most <= 0 or left == 1:
                # Panels that are still not smooth hold round-off, or a jump that round-off has shifted across an end.
                wrong[:] = False
            parts.append((panels.take(np.flatnonzero(~wrong)), t[~wrong, :NODES], x[~wrong, :NODES]))
            if not wrong.any():
                break
            panels = panels.take(np.flatnonzero(wrong)).halved()
            most -= panels.step.size
            t, x = self.run.at_points(read, panels)
        every = _joined([part[0] for part in parts])
        t, x = (np.concatenate([part[i] for part in parts]) for i in (1, 2))
        return Weighed(t, _shares(every)[1], x), every


def _joined(parts: Sequence[Panels]) -> Panels:
    return Panels(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def _missed(x: FloatArray) -> FloatArray:
    """Largest interpolation error found between the nodes of each panel, from values (p, ROWS), shape (p,)."""
    return np.asarray(np.abs(x[:, :NODES] @ BETWEEN - x[:, NODES:]).max(axis=1, initial=0.0))


def _shares(panels: Panels) -> tuple[FloatArray, FloatArray]:
    """Weight of each panel, shape (p,), and of the values at its nodes, shape (p, NODES), in a mean."""
    share = panels.duration / panels.duration.sum()
    return share, share[:, None] * _WEIGHTS


def weigh_outputs(t: FloatArray, x: FloatArray) -> Weighed:
    """A signal's outputs with weights, by cubics through neighbouring values; a repeated time is a jump."""
    weight = output_weights(t)
    return Weighed(t, weight / weight.sum(), x)


def output_weights(t: FloatArray) -> FloatArray:
    """Weights (n,) of values at times t (s, ascending) in the integral over them, exact for cubics between jumps.

    Where fewer than four values lie between two jumps, the trapezoidal rule is used.
    """
    weight = np.zeros(t.size)
    begins = np.flatnonzero(np.append(True, np.diff(t) == 0.0))
    sizes = np.diff(np.append(begins, t.size))
    begin, size = np.repeat(begins, sizes), np.repeat(sizes, sizes)
    i = np.flatnonzero(np.append(np.diff(t) > 0.0, False))
    few = size[i] < 4
    for side in (0, 1):
        np.add.at(weight, i[few] + side, 0.5 * (t[i[few] + 1] - t[i[few]]))
    i = i[~few]
    first = np.clip(i - 1, begin[i], begin[i] + size[i] - 4)
    index = first[:, None] + np.arange(4)
    nodes = t[index]
    half, middle = 0.5 * (t[i + 1] - t[i]), 0.5 * (t[i + 1] + t[i])
    # Two Gauss points integrate a cubic exactly; it is evaluated there in Lagrange's form.
    for at in (middle - half / np.sqrt(3.0), middle + half / np.sqrt(3.0)):
        for j in range(4):
            share = half.copy()
            for m in range(4):
                if m != j:
                    share *= (at - nodes[:, m]) / (nodes[:, j] - nodes[:, m])
            weight += np.bincount(index[:, j], share, t.size)
    return weight
