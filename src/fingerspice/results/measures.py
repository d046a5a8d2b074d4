"""Means, extremes and amplitudes of a run's signals, as integrals over its steps or its outputs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.polynomial import legendre

from fingerspice.base.arrays import FloatArray
from fingerspice.numerics.chebyshev import largest
from fingerspice.numerics.lobatto import NODES, POINTS
from fingerspice.results.signals import Signals
from fingerspice.results.steps import Panels, Recorded, missed

_NODES = POINTS[:NODES]
#: Smallest tolerance of the interpolation error of a panel, relative to the signal's peak.
_FINEST = 1e-12
#: Most halves of panels that are evaluated, in addition to four for each panel.
_MOST_CUT = 4096
#: Most times that one panel is halved.
_MOST_ROUNDS = 60
#: Gauss-Lobatto weights on [0, 1]: exact for polynomials of degree 23.
_WEIGHTS = 1.0 / (NODES * (NODES - 1) * legendre.Legendre.basis(NODES - 1)(2.0 * _NODES - 1.0) ** 2)


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
    """A run between two times (s), with weights and extremes of every signal, more exact than its error `rtol`.

    A panel is halved where it is longer than `longest` (s), or the polynomial through its nodes differs from the signal
    between them: steps resolve the gap voltage, and the area may change within a small part of the voltage's range.
    """

    def __init__(self, run: Recorded, since: float, until: float, rtol: float, longest: float = math.inf) -> None:
        self.run, self.span, self.rtol = run, (since, until), rtol
        self.panels = run.panels(since, until)
        while (long := self.panels.duration > longest).any():
            self.panels = _joined([self.panels.take(~long), self.panels.take(long).halved()])

    def weigh(self, name: str) -> Weighed:
        """A signal with weights for its means."""
        t, x = self.run.at_points(name, self.panels)
        error = missed(x) / (float(np.abs(x).max(initial=0.0)) or 1.0)
        share = self.panels.duration / self.panels.duration.sum()
        # Gauss-Lobatto weights integrate polynomials up to twice the degree of the interpolant exactly. If the terms of
        # the series fall geometrically, the quadrature error is about the interpolation error to the power 1.85; 1.5 is
        # on the safe side.
        if float((share * error**1.5).sum()) <= max(_FINEST, 1e-3 * self.rtol):
            return Weighed(t[:, :NODES], share[:, None] * _WEIGHTS, x[:, :NODES])
        return self._cut(name, _FINEST)[0]

    def extremes(self, name: str) -> tuple[float, float]:
        """Smallest and largest value of a signal, evaluated where its polynomials have their extremes."""
        # An interpolation error shifts the place of an extreme, which changes the signal there by its square only.
        weighed, panels = self._cut(name, max(_FINEST, 1e-3 * self.rtol))
        found = [largest(weighed.x, sign) for sign in (-1.0, 1.0)]
        panel, place = np.array([p for p, _, _ in found]), np.array([x for _, x, _ in found])
        panels = panels.take(panel)
        _, exact = self.run.values_at(name, panels.step, panels.fractions(place[:, None]))
        low, high = exact[:, 0].tolist()
        return min(low, float(weighed.x.min())), max(high, float(weighed.x.max()))

    def at_nodes(self, names: Sequence[str], tol: float) -> list[FloatArray]:
        """Times (s) and signals at the nodes (p, NODES) of panels on which each misses its polynomial by `tol`."""
        # Panels on which the rounding of the time alone is as much, as on an edge of 1 ns, are not cut.
        shortest = np.finfo(float).eps * abs(self.span[1]) / tol
        for name in names:
            self.panels = self._cut(name, tol, shortest)[1]
        found = [self.run.at_points(name, self.panels) for name in names]
        return [x[:, :NODES] for x in (found[0][0], *(x for _, x in found))]

    def _cut(self, name: str, tol: float, shortest: float = 0.0) -> tuple[Weighed, Panels]:
        """A signal, and panels on which its interpolation error is at most `tol` of its peak, or as short as told."""
        panels, parts = self.panels, []
        t, x = self.run.at_points(name, panels)
        smooth = tol * float(np.abs(x).max(initial=0.0))
        most = _MOST_CUT + 4 * panels.step.size
        for left in range(_MOST_ROUNDS, 0, -1):
            wrong = (missed(x) > smooth) & (panels.duration > shortest)
            if most <= 0 or left == 1:
                # Panels that are still not smooth hold round-off, or a jump that round-off has shifted across an end.
                wrong[:] = False
            parts.append((panels.take(~wrong), t[~wrong, :NODES], x[~wrong, :NODES]))
            if not wrong.any():
                break
            panels = panels.take(wrong).halved()
            most -= panels.step.size
            t, x = self.run.at_points(name, panels)
        every = _joined([part[0] for part in parts])
        t, x = (np.concatenate([part[i] for part in parts]) for i in (1, 2))
        share = every.duration / every.duration.sum()
        return Weighed(t, share[:, None] * _WEIGHTS, x), every


def _joined(parts: Sequence[Panels]) -> Panels:
    return Panels(*(np.concatenate(column) for column in zip(*parts, strict=True)))


class Outputs:
    """Outputs of a record from number `first` on; after interpolated ones at a time `start` (s) if that is given."""

    def __init__(self, record: Signals, first: int = 0, start: float | None = None) -> None:
        self.record, self.first, self.start = record, first, start

    def _values(self, name: str) -> tuple[FloatArray, FloatArray]:
        t, x = self.record.t, self.record.one(name)
        if self.start is None:
            return t[self.first :], x[self.first :]
        return np.append(self.start, t[self.first :]), np.append(np.interp(self.start, t, x), x[self.first :])

    def weigh(self, name: str) -> Weighed:
        """A signal with weights for its means."""
        return weigh_outputs(*self._values(name))

    def extremes(self, name: str) -> tuple[float, float]:
        """Smallest and largest value of a signal."""
        _, x = self._values(name)
        return float(x.min()), float(x.max())


def weigh_outputs(t: FloatArray, x: FloatArray) -> Weighed:
    """A signal's outputs at times t (s, ascending), with weights that are exact for cubics; a repeated time is a jump.

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
    return Weighed(t, weight / weight.sum(), x)
