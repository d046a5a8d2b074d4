"""Fit of a function by Chebyshev series, refined until they reproduce it at points that are not their nodes."""

from __future__ import annotations

import itertools
import math
import warnings
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from fingerspice.base.arrays import FloatArray
from fingerspice.base.errors import FingerspiceWarning, InputError
from fingerspice.numerics import chebyshev
from fingerspice.waveforms.waveform import DOUBLE, Waveform

POINTS = 20
# The points `_PROOF` between the nodes, at which a series is compared with the function, are irregular: so no periodic
# function can agree with its series at all of them and differ elsewhere.
_AT_START = (-1.0) ** np.arange(POINTS)
_PROOF = 2.0 * np.modf(np.arange(1, 28) * 0.6180339887498949)[0] - 1.0
_PLACES = np.concatenate([chebyshev.nodes(POINTS, -1.0, 1.0), _PROOF])
_NODE_STEPS = np.diff(_PLACES[:POINTS])
# Longest interval, output steps; and the largest distance between neighbouring points in it, which is 0.41 steps.
_LONGEST = 8.0
WIDEST = 0.5 * _LONGEST * float(np.diff(np.sort(_PLACES)).max())

# After `_IDLE` halvings in a row that do not reduce the misfit, a misfit below `_ROUGHEST` (relative to the largest
# |U|, for values in doubles) is taken for round-off of the function's values.
_IDLE, _ROUGHEST = 3, 1e-8
# Smallest change over short series, relative to the largest |U|, that is reported as an edge; at a kink it is smaller.
_STEEP = 0.05
# Smallest tolerance, V: below it doubles are nearly denormal and lose digits, so that no function appears smooth.
_NOTHING = 1e-290
# An interval halved more than `_DEEP` times lies at a jump or a kink, around which some 60 such intervals are needed. A
# table may have `_MOST_DEEP` of them, and `_MOST_DEEP_EACH` more for each of its initial intervals.
_DEEP, _MOST_DEEP, _MOST_DEEP_EACH = 12, 10_000, 100


class _Interval(NamedTuple):
    """An interval (s) that waits for its series."""

    lo: float
    hi: float
    depth: int = 0  # Number of halvings that led to it
    # misfit, largest: Misfit (V) before the last halving, and the largest misfit before any of the halvings
    misfit: float = math.inf
    largest: float = 0.0
    idle: int = 0  # Number of halvings in a row that did not reduce the misfit

    def halves(self, misfit: float = math.inf, largest: float = 0.0, idle: int = 0) -> list[_Interval]:
        """Both halves, the later one first, because they are put on a stack."""
        middle, known = 0.5 * (self.lo + self.hi), (self.depth + 1, misfit, max(largest, self.largest), idle)
        return [_Interval(middle, self.hi, *known), _Interval(self.lo, middle, *known)]

    def points(self) -> FloatArray:
        """Times (s) at which the waveform is evaluated: the nodes, then the points between them."""
        return 0.5 * (self.lo + self.hi) + 0.5 * (self.hi - self.lo) * _PLACES


@dataclass
class Refiner:
    """Covers intervals with Chebyshev series by bisection."""

    waveform: Waveform
    tol: float  # Allowed error of a series, relative to `scale`
    step: float  # Output step, s
    shortest: float = math.inf  # Length (s) of the shortest event of the waveform that its samples have to meet
    # scale, steepest: Largest |U| (V) and |dU/dt| (V/s) seen
    scale: float = 0.0
    steepest: float = 0.0
    edges: list[float] = field(default_factory=list)  # Ends of the series' intervals, s
    series: list[FloatArray] = field(default_factory=list)  # (POINTS,): Chebyshev coefficients on each interval
    # Times (s) at which neighbouring series differ, and the difference (V)
    jumps: list[tuple[float, float]] = field(default_factory=list)
    # located, narrow: Times (s) of the jumps found by bisection, and of intervals much shorter than the output step
    located: list[float] = field(default_factory=list)
    narrow: list[float] = field(default_factory=list)
    # Start (s) of each short interval, and the change (V) over it
    short: list[tuple[float, float]] = field(default_factory=list)
    not_finite: float | None = None  # Time (s) of the first NaN or inf
    rough: float = 0.0  # Largest misfit (V) taken for round-off of the function's values
    # allowed, deep: Largest allowed and present number of intervals that were halved more than `_DEEP` times
    allowed: int = _MOST_DEEP
    deep: int = 0

    def cover(self, a: float, b: float) -> bool:
        """Add series for [a, b] (s); False if the waveform has a NaN or inf inside."""
        if not self.edges:
            self.edges.append(a)
        # The ends of a window are breakpoints, where the waveform may jump: series use interior points only.
        longest = min(_LONGEST * self.step, 2.0 * self.waveform.shortest_time())
        count = max(1, math.ceil((b - a) / longest))
        cuts = np.linspace(a, b, count + 1).tolist()
        waiting = [_Interval(lo, hi) for lo, hi in itertools.pairwise(cuts)][::-1]
        self.allowed += _MOST_DEEP_EACH * count
        while waiting:
            piece = waiting.pop()
            lo, hi = piece.lo, piece.hi
            series, values, misfit = self._try(piece)
            if not np.all(np.isfinite(values)):
                if hi - lo <= 1e-12 * max(abs(hi), self.step) or piece.depth > 60:
                    self.not_finite = lo if lo == self.edges[0] else hi
                    return False
                waiting += piece.halves()
                continue
            idle = piece.idle + 1 if misfit > 0.7 * piece.misfit else 0
            if series is None:
                if piece.depth > _DEEP:
                    self._refuse_noise(piece, values)
                if idle >= _IDLE and misfit <= self._roughest:
                    # Halving divides the misfit of a smooth function by 2^20 and the misfit at a kink by 2. A misfit
                    # that halving does not reduce is round-off of the function's own values.
                    self.rough = max(self.rough, misfit)
                    series = chebyshev.coefficients(values)
            floor = max(4e-15 * max(abs(lo), abs(hi)), 1e-13 * self.step)
            if series is not None:
                waiting += self._add(piece, series, floor, first=lo == a)
            elif hi - lo > floor:
                waiting += piece.halves(misfit, misfit, idle)
            else:
                # An interval of this width without a good series holds a jump (or a kink), which becomes an edge.
                self.jumps.append((hi, float(values[-1] - values[0])))
                self.located.append(hi)
                if self.series:
                    self.edges[-1] = hi
        return True

    def _add(self, piece: _Interval, series: FloatArray, floor: float, first: bool) -> list[_Interval]:
        """Add an interval's series; if the waveform jumps at its start, return the intervals to refine instead."""
        if piece.hi - piece.lo < 0.75 * self.step:
            self.short.append((piece.lo, float(series.sum() - series @ _AT_START)))
            if piece.largest > self._roughest:
                self.narrow.append(0.5 * (piece.lo + piece.hi))
        if self.series and not first and not (self.jumps and self.jumps[-1][0] >= piece.lo):
            # A jump or a steep edge may lie exactly on a cut, so that the points of neither interval show it: refine
            # both intervals until they are short.
            change = float(series @ _AT_START - self.series[-1].sum())
            if abs(change) > self._least and piece.hi - piece.lo > floor:
                again = piece.halves()
                before = _Interval(self.edges[-2], piece.lo, piece.depth)
                if before.hi - before.lo > floor:
                    del self.edges[-1], self.series[-1]
                    again += before.halves(largest=piece.largest)
                return again
            self.jumps.append((piece.lo, change))
        self.edges.append(piece.hi)
        self.series.append(series)
        return []

    def _try(self, piece: _Interval) -> tuple[FloatArray | None, FloatArray, float]:
        """Series (None if it errs too much), values at its nodes (or if one is not finite at all points), error, V."""
        lo, hi = piece.lo, piece.hi
        t, proven = piece.points(), _PROOF
        count = math.ceil((hi - lo) / self.shortest)
        if WIDEST * (hi - lo) > _LONGEST * self.shortest:
            finer = (2.0 * np.arange(count) + 1.0) / count - 1.0
            t, proven = np.append(t, 0.5 * (lo + hi) + 0.5 * (hi - lo) * finer), np.append(_PROOF, finer)
        values = self.waveform.value(t)
        if not np.all(np.isfinite(values)):
            return None, values, math.inf
        self.scale = max(self.scale, float(np.abs(values).max()))
        c = chebyshev.coefficients(values[:POINTS])
        proof = np.polynomial.chebyshev.chebval(proven, c)
        if piece.depth == 0:
            self.steepest = float(np.abs(np.diff(values[:POINTS]) / (0.5 * (hi - lo) * _NODE_STEPS)).max())
        # The rounding of the time itself changes the value by up to `noise`; so does that of coarse values.
        precision = self.waveform.precision
        noise = 9.0 * precision * max(abs(lo), abs(hi)) * self.steepest
        if precision > DOUBLE:
            noise += 4.0 * precision * self.scale
        misfit = float(np.abs(proof - values[POINTS:]).max())
        good = misfit <= max(self.tol * self.scale, noise, _NOTHING)
        if good and precision > DOUBLE:
            self.rough = max(self.rough, misfit + 0.5 * precision * self.scale)
        return (c if good else None), values[:POINTS], misfit

    def _refuse_noise(self, piece: _Interval, values: FloatArray) -> None:
        """Count an interval that stays rough; refuse noise, and so many of them that refining would not end."""
        self.deep += 1
        if self.deep not in (1, self.allowed):
            return
        t = piece.points()
        again = self.waveform.value(t)[:POINTS]
        i = int(np.argmax(np.abs(again - values)))
        remedy = "of noise draw the values once and give fs.Samples(values, rate)"
        # A function of arrays may sum in another order at the second call, so allow the last digits to differ.
        if abs(again[i] - values[i]) > self._roughest:
            raise InputError(
                f"the source function gives {values[i]:.4g} V and then {again[i]:.4g} V at the same t = {t[i]:.9g} s; "
                f"allowed: the same value at the same time; {remedy}"
            )
        if self.deep == self.allowed:
            raise InputError(
                f"the source function is too rough to be followed near t = {piece.lo:.9g} s: {self.deep} pieces as "
                f"short as {piece.hi - piece.lo:.2g} s were not smooth; allowed: smooth between jumps that are few, or "
                f"declared by Function(f, breaks=(...)); {remedy}"
            )

    @property
    def _roughest(self) -> float:
        """Largest misfit that is taken for round-off, V."""
        return _ROUGHEST * math.sqrt(self.waveform.precision / DOUBLE) * self.scale

    @property
    def _least(self) -> float:
        """Smallest change between neighbouring series that counts as a jump, V."""
        return max(1e3 * self.tol * self.scale, 10.0 * self.rough)

    def warn(self) -> None:
        """Warn once of jumps, and once of narrow features, that were found without having been declared."""
        real = [(t, dv) for t, dv in self.jumps if abs(dv) > self._least]
        # Around a jump, a kink, or a NaN short series are expected; report only the short ones far from all of these.
        known = [*self.located, *(t for t, _ in real), *([] if self.not_finite is None else [self.not_finite])]
        apart = [t for t in self.narrow if all(abs(t - k) > 8.0 * self.step for k in known)]
        if self.short:
            # The first edge: short series whose change sums to more than `_STEEP` in a tenth of a step.
            start, change = np.array(self.short).T
            total = np.concatenate([[0.0], np.cumsum(change)])
            after = np.searchsorted(start, start + 0.1 * self.step)
            steep = np.flatnonzero(np.abs(total[after] - total[:-1]) > _STEEP * self.scale)
            apart += [float(start[i + np.argmax(np.abs(change[i : after[i]]))]) for i in steep[:1]]
        told = []
        if real:
            t, dv = real[0]
            more = f" and {len(real) - 1} more times" if len(real) > 1 else ""
            told.append(
                f"the source function jumps by {dv:.4g} V at t = {t:.9g} s{more}; it was not declared: "
                "give Function(f, breaks=(...)) the times for exact edges"
            )
        if apart:
            told.append(
                f"the source function has a feature narrower than the output step {self.step:.3g} s "
                f"near t = {min(apart):.9g} s; it was resolved where it was seen, but others may be missed: "
                "give Function(f, breaks=(...)) its edges"
            )
        for text in told:
            warnings.warn(text, FingerspiceWarning, stacklevel=2)
