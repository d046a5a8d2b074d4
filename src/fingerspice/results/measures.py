"""Figures of a run: means, extremes and amplitudes of its signals, from its steps or from its outputs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.polynomial import legendre

from fingerspice.base.arrays import FloatArray, IntArray
from fingerspice.numerics.extremes import largest
from fingerspice.numerics.lobatto import BETWEEN, NODES, POINTS

#: From the outputs of a run, as it wrote them down, to the signal that figures are taken of, shape (n_t,).
Read = Callable[[Any], FloatArray]

_NODES = POINTS[:NODES]
#: What a polynomial need not meet of a signal, over its peak.
_FINEST = 1e-12
#: Halves of panels that are looked at, beside four for each panel.
_MOST_CUT = 4096
#: Halvings of one panel.
_MOST_ROUNDS = 60
#: Gauss-Lobatto weights on [0, 1]: exact for polynomials of degree 23.
_WEIGHTS = 1.0 / (NODES * (NODES - 1) * legendre.Legendre.basis(NODES - 1)(2.0 * _NODES - 1.0) ** 2)


class Panels(NamedTuple):
    """Parts of a run on each of which every signal is smooth.

    Attributes
    ----------
    step : ndarray of int, shape (p,)
    low, high : ndarray, shape (p,)
        Fractions of the step of that number.
    duration : ndarray, shape (p,)
        s; longer than the part itself where that stands for many.
    """

    step: IntArray
    low: FloatArray
    high: FloatArray
    duration: FloatArray

    def take(self, which: IntArray) -> Panels:
        """Some of them, by number."""
        return Panels(self.step[which], self.low[which], self.high[which], self.duration[which])

    def halved(self) -> Panels:
        """Both halves of each."""
        middle, half = 0.5 * (self.low + self.high), 0.5 * self.duration
        low, high = np.append(self.low, middle), np.append(middle, self.high)
        return Panels(np.tile(self.step, 2), low, high, np.tile(half, 2))

    def fractions(self, points: FloatArray) -> FloatArray:
        """Points in [0, 1] of each panel as fractions of its step, shape (p, n)."""
        # Not low + (high - low): the end has to be met exactly.
        return np.asarray(self.low[:, None] * (1.0 - points) + self.high[:, None] * points)


class Run(Protocol):
    """What figures are taken of."""

    def panels(self, since: float, until: float) -> Panels:
        """Parts of the run between two times, s."""

    def at_points(self, read: Read, panels: Panels) -> tuple[FloatArray, FloatArray]:
        """Times (s) and a signal at the `POINTS` of panels, shape (p, ROWS) each."""

    def values_at(self, read: Read, index: IntArray, fraction: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Times (s) and a signal at fractions (p, n) of the steps with these indices (p,), shape (p, n) each."""


@dataclass(frozen=True)
class Weighed:
    """A signal with the durations that its values stand for.

    Attributes
    ----------
    t, weight, x : ndarray, shape (n,)
        s, the share of the whole duration, and the signal's unit.
    """

    t: FloatArray
    weight: FloatArray
    x: FloatArray

    def mean(self, power: int = 1) -> float:
        """Mean of the signal, or of a power of it."""
        # Not by BLAS, whose threads cost more than the sum and may round otherwise.
        return float((self.weight * (self.x if power == 1 else self.x**power)).sum())

    def phasor(self, frequency: float) -> complex:
        """Complex amplitude P of a signal x ~ Im(P exp(i 2 pi f t)); the times are a whole number of periods."""
        turning = self.weight * np.exp(-2j * np.pi * frequency * self.t)
        return complex(2j * (turning * self.x).sum())


class Stretch:
    """A run between two times (s): each signal with its weights, and its extremes.

    Panels on which the polynomial through the nodes misses the signal between them are cut in halves: steps follow the
    gap voltage, and the area may change on a small part of its range.

    Parameters
    ----------
    run : Run
    since, until : float
        s.
    rtol : float
        Error of the run, relative to its peaks: figures are taken more exactly than that.
    """

    def __init__(self, run: Run, since: float, until: float, rtol: float) -> None:
        self.run, self.rtol = run, rtol
        self.panels = run.panels(since, until)
        self._share, self._shares = _shares(self.panels)

    def weigh(self, read: Read) -> Weighed:
        """A signal for means."""
        t, x = self.run.at_points(read, self.panels)
        peak = float(np.abs(x).max(initial=0.0)) or 1.0
        missed = _missed(x) / peak
        # The first term that a polynomial misses has no integral, nor have the next ten: were the terms to fall evenly,
        # the integral's error would be the 1.85th power of what is missed.
        if float((self._share * missed**1.5).sum()) <= max(_FINEST, 1e-3 * self.rtol):
            return Weighed(t[:, :NODES], self._shares, x[:, :NODES])
        return self._cut(read, t, x, _FINEST)[0]

    def extremes(self, read: Read) -> tuple[float, float]:
        """Smallest and largest value of a signal: where its polynomials have them, the signal itself."""
        # What the polynomials miss moves the place, and the value by the square of that.
        weighed, panels = self._cut(read, *self.run.at_points(read, self.panels), max(_FINEST, 1e-3 * self.rtol))
        found = [largest(weighed.x, sign) for sign in (-1.0, 1.0)]
        panel, place = np.array([p for p, _, _ in found]), np.array([x for _, x, _ in found])
        at = panels.low[panel] * (1.0 - place) + panels.high[panel] * place
        _, exact = self.run.values_at(read, panels.step[panel], at[:, None])
        low, high = exact[:, 0].tolist()
        return min(low, float(weighed.x.min())), max(high, float(weighed.x.max()))

    def _cut(self, read: Read, t: FloatArray, x: FloatArray, tol: float) -> tuple[Weighed, Panels]:
        """A signal, and the panels on which its polynomials miss it by at most `tol` of its peak."""
        smooth = tol * float(np.abs(x).max(initial=0.0))
        panels, parts = self.panels, []
        most = _MOST_CUT + 4 * panels.step.size
        for left in range(_MOST_ROUNDS, 0, -1):
            wrong = _missed(x) > smooth
            if most <= 0 or left == 1:
                # What still is not smooth is rounding, or a jump that rounding has put to the other side.
                wrong[:] = False
            parts.append((panels.take(np.flatnonzero(~wrong)), t[~wrong, :NODES], x[~wrong, :NODES]))
            if not wrong.any():
                break
            panels = panels.take(np.flatnonzero(wrong)).halved()
            most -= panels.step.size
            t, x = self.run.at_points(read, panels)
        every = Panels(*(np.concatenate(column) for column in zip(*(part[0] for part in parts), strict=True)))
        t, x = (np.concatenate([part[i] for part in parts]) for i in (1, 2))
        return Weighed(t, _shares(every)[1], x), every


def _missed(x: FloatArray) -> FloatArray:
    """Largest miss of the polynomial through the nodes of each panel, of values (p, ROWS), shape (p,)."""
    return np.asarray(np.abs(x[:, :NODES] @ BETWEEN - x[:, NODES:]).max(axis=1, initial=0.0))


def _shares(panels: Panels) -> tuple[FloatArray, FloatArray]:
    """Of the whole duration, what each panel is, shape (p,), and the value at each of its nodes, shape (p, NODES)."""
    share = panels.duration / panels.duration.sum()
    return share, share[:, None] * _WEIGHTS


def weigh_outputs(t: FloatArray, x: FloatArray) -> Weighed:
    """A signal's outputs for means, by cubics through neighbouring values; a repeated time is a jump."""
    weight = output_weights(t)
    return Weighed(t, weight / weight.sum(), x)


def output_weights(t: FloatArray) -> FloatArray:
    """Weights (n,) of values at times t (s, ascending) in the integral over them, exact for cubics between jumps.

    Trapezoidal between jumps that fewer than four values lie between.
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
    # Two Gauss points integrate a cubic; Lagrange's form gives it there.
    for at in (middle - half / np.sqrt(3.0), middle + half / np.sqrt(3.0)):
        for j in range(4):
            share = half.copy()
            for m in range(4):
                if m != j:
                    share *= (at - nodes[:, m]) / (nodes[:, j] - nodes[:, m])
            weight += np.bincount(index[:, j], share, t.size)
    return weight
