"""Figures of a run: means, extremes and amplitudes of its signals, from its steps or from its outputs."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import NDArray

from fingerspice.numerics.extremes import largest
from fingerspice.numerics.lobatto import BETWEEN, NODES, POINTS

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
Signals = Mapping[str, FloatArray]
#: From the outputs of a run, as it wrote them down, to the signals that figures are taken of, shape (n_t,) each.
Read = Callable[[Any], Signals]

_NODES = POINTS[:NODES]
#: Halves of panels that are looked at, beside four for each panel.
_MOST_CUT = 4096
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

    def signals(self, read: Read, index: IntArray, fraction: FloatArray) -> tuple[FloatArray, Signals]:
        """Times (s) and signals at fractions (p, n) of the steps with these indices (p,), shape (p, n) each."""


@dataclass(frozen=True)
class Weighed:
    """Signals with the durations that their values stand for.

    Attributes
    ----------
    t, weight : ndarray, shape (n,)
        s.
    signals : mapping of str to ndarray, shape (n,)
    """

    t: FloatArray
    weight: FloatArray
    signals: Signals

    def mean(self, name: str, power: int = 1) -> float:
        """Mean of a signal, or of a power of it."""
        # Not by BLAS, whose threads cost more than the sum and may round otherwise.
        return float(np.sum(self.weight * self.signals[name] ** power) / self.weight.sum())

    def phasor(self, name: str, frequency: float) -> complex:
        """Complex amplitude P of a signal x ~ Im(P exp(i 2 pi f t)); the times are a whole number of periods."""
        turning = self.weight * np.exp(-2j * np.pi * frequency * self.t)
        return complex(2j * np.sum(turning * self.signals[name]) / self.weight.sum())


def weigh_run(
    run: Run, read: Read, since: float, until: float, tol: float
) -> tuple[Weighed, dict[str, tuple[float, float]]]:
    """Signals of a run between two times (s) for means, and the smallest and largest value of each.

    A panel on which a polynomial through the nodes misses some signal between them, by more than `tol` of its peak, is
    cut in halves: steps follow the gap voltage, and the area may change on a small part of its range.
    """
    panels, parts = run.panels(since, until), []
    most = _MOST_CUT + 4 * panels.step.size
    peaks: dict[str, float] = {}
    while panels.step.size:
        t, signals = run.signals(read, panels.step, panels.fractions(POINTS))
        wrong = np.zeros(panels.step.size, bool)
        for name, x in signals.items():
            peaks[name] = max(peaks.get(name, 0.0), float(np.abs(x).max()))
            missed = np.abs(x[:, :NODES] @ BETWEEN - x[:, NODES:]).max(axis=1)
            wrong |= missed > tol * peaks[name]
        if most <= 0:
            # What still is not smooth is rounding.
            wrong[:] = False
        kept = panels.take(np.flatnonzero(~wrong))
        parts.append((kept, t[~wrong, :NODES], {name: x[~wrong, :NODES] for name, x in signals.items()}))
        panels = panels.take(np.flatnonzero(wrong)).halved()
        most -= panels.step.size
    every = [part[0] for part in parts]
    panels = Panels(
        np.concatenate([p.step for p in every]), np.concatenate([p.low for p in every]),
        np.concatenate([p.high for p in every]), np.concatenate([p.duration for p in every]),
    )  # fmt: skip
    signals = {name: np.concatenate([part[2][name] for part in parts]) for name in peaks}
    t = np.concatenate([part[1] for part in parts])
    weight = panels.duration[:, None] * _WEIGHTS
    flat = {name: x.ravel() for name, x in signals.items()}
    return Weighed(t.ravel(), weight.ravel(), flat), _extremes(run, read, panels, signals)


def _extremes(run: Run, read: Read, panels: Panels, signals: Signals) -> dict[str, tuple[float, float]]:
    """Smallest and largest value of each signal: where its polynomials have them, the signals themselves."""
    sought = [(name, sign) for name in signals for sign in (-1.0, 1.0)]
    found = [largest(signals[name], sign) for name, sign in sought]
    panel = np.array([p for p, _, _ in found])
    # Its own time for each: looking at a run sorts them.
    low, high, place = panels.low[panel], panels.high[panel], np.array([x for _, x, _ in found])
    _, exact = run.signals(read, panels.step[panel], (low * (1.0 - place) + high * place)[:, None])
    ends = [sign * max(sign * float(exact[name][i, 0]), sign * float(_at_nodes(signals[name], sign)))
            for i, (name, sign) in enumerate(sought)]  # fmt: skip
    return {name: (ends[2 * i], ends[2 * i + 1]) for i, name in enumerate(signals)}


def _at_nodes(values: FloatArray, sign: float) -> float:
    return float(values.max() if sign > 0.0 else values.min())


def weigh_outputs(t: FloatArray, signals: Signals) -> Weighed:
    """Outputs for means, by cubics through neighbouring values; a repeated time is a jump."""
    return Weighed(t, output_weights(t), signals)


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
