"""A user's function of time as a waveform, and any waveform as a table for compiled code.

Between its breakpoints a function is represented by Chebyshev series, which are refined until they reproduce the
function at points that are not interpolation nodes. Where refining does not help there is a jump that was not
declared: its time is located and becomes an edge of a segment, with a warning.
"""

from __future__ import annotations

import itertools
import math
import warnings
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from fingerspice.base.arrays import FloatArray, positive_number, real_numbers
from fingerspice.base.compiled import jit
from fingerspice.base.errors import FingerspiceWarning, InputError
from fingerspice.engine.collocation.readout import SAME_TIME
from fingerspice.numerics import chebyshev
from fingerspice.waveforms.periodic import in_windows, runs_through
from fingerspice.waveforms.waveform import DOUBLE, Waveform, refuse, require

_PERIODS_PER_SEGMENT = 64.0  #: Longest segment of an oscillation: a phase's rounding error grows with it.
_AT_ONCE = 1024  # Number of times compared between two looks whether one has missed.
_ASIDE = 8.0  # Units in the last place of the time by which a function is looked at beside a break.


@dataclass(frozen=True, eq=False)
class Function(Waveform):
    """A Python function of time, U(t) in V with t in s.

    It is called with arrays where it accepts them, and otherwise with one time after the other.

    Parameters
    ----------
    function : callable
        A function of a time, or of an array of times.
    breaks : tuple of float
        Times (s) at which the function jumps or has a kink; for a periodic function the times in its first period.
    repeat : float, optional
        Period (s) of a periodic function; without it the function has no fundamental.
    """

    function: Callable[..., object]
    breaks: tuple[float, ...] = ()
    repeat: float | None = None

    def __post_init__(self) -> None:
        require(callable(self.function), "source function", repr(self.function), "a function of time in s")
        breaks = set(real_numbers("function breaks", self.breaks, "times in s").ravel().tolist())
        if self.repeat is not None:
            self._declare(repeat=positive_number("function period", self.repeat, "s"))
            # The end of a period is the start of the next one.
            breaks = {math.fmod(b, self.repeat) if b >= self.repeat else b for b in breaks}
        self._declare(breaks=tuple(sorted(breaks)), period=self.repeat)

    def value(self, t: ArrayLike, side: str = "right") -> FloatArray:
        t = real_numbers("t", t, "times in s")
        if self.breaks:
            windows = [t.ravel()[window] for window in in_windows(t.ravel(), self.breakpoint_rate())]
            edges = np.concatenate([self.breakpoints(x.min(), x.max()) for x in windows if x.size] or [np.empty(0)])
            # At a break itself the rounding of its own arithmetic may put a function on either side.
            aside = (_ASIDE if side == "right" else -_ASIDE) * np.spacing(np.abs(t))
            t = np.where(np.isin(t, edges), t + aside, t)
        if t.ndim == 0:
            return np.asarray(self._scalar(np.float64(t)))
        with suppress(TypeError, ValueError):
            out = self._taken(self.function(t.copy()))  # A function may work in place: it gets times of its own.
            # A function written for one number may give wrong values for an array without raising: compare one value.
            one = slice(t.size // 2, t.size // 2 + 1)
            if out.shape == t.shape and np.array_equal(out.flat[one], list(map(self._scalar, t.flat[one])), True):
                return out
        self.kept["one by one"] = True
        return np.array([self._scalar(x) for x in t.ravel()]).reshape(t.shape)

    def _scalar(self, t: float) -> float:
        try:
            value = self.function(t)
        except (TypeError, IndexError):
            value = self.function(np.array([t]))  # A function of arrays only.
        try:
            return float(self._taken(value).item())
        except ValueError:  # InputError is one
            raise InputError(f"the source function returned {value!r} at t = {t:g} s; allowed: one number") from None

    def _taken(self, values: object) -> FloatArray:
        """What the function returned as doubles; the coarsest precision of its numbers is kept."""
        found, kind = real_numbers("", values, ""), np.asarray(values).dtype
        if kind.kind == "f" and kind.itemsize < 8:
            self._declare(precision=max(self.precision, float(np.finfo(kind).eps)))
        return found

    def _edges(self, t0: float, t1: float) -> FloatArray:
        if self.repeat is None or not self.breaks:
            return np.array(self.breaks)
        return np.unique(runs_through(self.repeat, len(self.breaks), t0, t1) * self.repeat + np.array(self.breaks))

    def breakpoint_rate(self) -> float:
        return len(self.breaks) / self.repeat if self.repeat else 0.0


@dataclass(frozen=True)
class SourceTable:
    """A waveform on a window of time, in the form that compiled code reads."""

    edges: FloatArray  # (m + 1,): Segment edges, s
    terms: FloatArray  # (m, k, 6)
    series: FloatArray  # (m, l): Chebyshev coefficients of each segment, added to its terms; l = 0 without series
    scale: float = 0.0  # Largest |U| (V) at the points where the series were fitted and checked; 0 without series
    not_finite: float | None = None  # Time (s) of the first NaN or inf; the table then ends just before it
    rough: float = 0.0  # Largest misfit (V) that finer series do not reduce: round-off of the function's own values

    def values(self, t: FloatArray) -> FloatArray:
        """Values (V) of the series at times (s) within the table."""
        i = np.clip(np.searchsorted(self.edges, t, side="right") - 1, 0, self.edges.size - 2)
        x = 2.0 * (t - self.edges[i]) / (self.edges[i + 1] - self.edges[i]) - 1.0
        return np.asarray(np.polynomial.chebyshev.chebval(x, self.series.T.take(i, 1), tensor=False))

    def unseen(self, waveform: Waveform, t: FloatArray, tol: float) -> tuple[float, float] | None:
        """The first of the times (s) at which a function differs from its table, and the difference (V), or None."""
        t = t[(t > self.edges[0]) & (t < self.edges[-1])]
        if t.size == 0 or self.series.size == 0:
            return None
        # At an edge the function may jump, and its left and right values are both correct: leave such times out.
        right = np.clip(np.searchsorted(self.edges, t), 1, self.edges.size - 1)
        near = np.minimum(np.abs(t - self.edges[right]), np.abs(t - self.edges[right - 1]))
        t = t[near > 8e-15 * np.abs(t)]
        difference = np.abs(waveform.value(t) - self.values(t))
        # Written with `not <=`, so that NaN counts as a difference.
        wrong = np.flatnonzero(~(difference <= max(1e3 * tol * self.scale, 30.0 * self.rough)))
        return (float(t[wrong[0]]), float(difference[wrong[0]])) if wrong.size else None


def same_time(t: float) -> float:
    """Distance (s) within which two times near `t` count as equal: a few units in the last place of t."""
    return SAME_TIME * abs(t)


@jit
def on_grid(t: FloatArray, start: float, step: float, slack: float) -> bool:
    """Whether the times `t` (s) are start, start + step, ..., each to within `slack` (s)."""
    for first in range(0, t.size, _AT_ONCE):
        missed = 0  # Counted, not compared one by one: only so the compiler makes vector instructions of it.
        for i in range(first, min(first + _AT_ONCE, t.size)):
            missed += not abs(t[i] - (start + i * step)) <= slack
        if missed > 0:
            return False
    return True


def breakpoints_at(waveform: Waveform, t: float) -> FloatArray:
    """Breakpoints that differ from `t` (s) at most by rounding."""
    return waveform.breakpoints(t - same_time(t), t + same_time(t))


def on_breakpoint(waveform: Waveform, t: float) -> float:
    """The breakpoint that differs from `t` (s) only by rounding, else `t`; so a run of three periods ends at a jump."""
    near = breakpoints_at(waveform, t)
    return float(near[0]) if near.size else t


def source_table(
    waveform: Waveform, t0: float, t1: float, tol: float, step: float, *, no_chirps: bool = False, scale: float = 0.0,
    shortest: float = math.inf,
) -> SourceTable:  # fmt: skip
    """Table of a waveform over [t0, t1] (s).

    A Chebyshev series may err by `tol` of the largest |U| seen, here or in earlier windows (`scale`, V). A function is
    sampled at each output step (s) at least, and meets events as short as `shortest` (s). With `no_chirps` a term with
    a changing frequency, which has no closed-form response, is represented by a series too.
    """
    inner = waveform.breakpoints(t0, t1)
    # A breakpoint that differs from an end of the window only by rounding is that end, and bounds no extra segment.
    inner = inner[(inner > t0 + same_time(t0)) & (inner < t1 - same_time(t1))]
    edges = np.concatenate([[t0], inner, [t1]])
    # Long segments are divided, so that the rounding error of a phase stays small within each.
    longest, between = _PERIODS_PER_SEGMENT * waveform.shortest_time(), edges
    if np.any(np.diff(edges) > longest):
        cuts = [np.linspace(a, b, max(1, math.ceil((b - a) / longest)) + 1)[:-1] for a, b in itertools.pairwise(edges)]
        between = np.concatenate([*cuts, edges[-1:]])
    terms = waveform.terms(between[:-1], between[1:])
    if terms is not None:
        if not (no_chirps and np.any(terms[:, :, 5] != 0.0)):
            return SourceTable(between, np.ascontiguousarray(terms), np.zeros((between.size - 1, 0)))
        # The output step is not used here, so that no result depends on the outputs asked for.
        edges, step = between, 0.1 * waveform.shortest_time()
    pieces = Refiner(waveform, tol, step, [float(t0)], shortest, scale)
    for a, b in itertools.pairwise(edges):
        if not pieces.cover(float(a), float(b)):
            break
    if terms is None:
        pieces.warn()
    found, series = np.array(pieces.edges), np.array(pieces.series).reshape(-1, POINTS)
    return SourceTable(found, np.zeros((len(series), 1, 6)), series, pieces.scale, pieces.not_finite, pieces.rough)


POINTS = 20
# Between the nodes a series is compared at irregular points: no periodic function agrees at all and differs elsewhere.
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
_STEEP = 0.05  # Least change over short series, relative to the largest |U|, that is told as an edge; a kink has less.
_NOTHING = 1e-290  # Smallest tolerance, V: below it doubles are nearly denormal, and no function appears smooth.
# An interval halved more than `_DEEP` times lies at a jump or a kink, around which some 60 such intervals are needed. A
# table may have `_MOST_DEEP` of them, and `_MOST_DEEP_EACH` more for each of its initial intervals.
_DEEP, _MOST_DEEP, _MOST_DEEP_EACH = 12, 10_000, 100


class _Interval(NamedTuple):
    """An interval (s) that waits for its series."""

    lo: float
    hi: float
    depth: int = 0  # Number of halvings that led to it
    misfit: float = math.inf  # V, before the last halving
    largest: float = 0.0  # V, the largest misfit before any of the halvings
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
    edges: list[float]  # Ends of the series' intervals, s: at first the start of them all
    shortest: float = math.inf  # Length (s) of the shortest event of the waveform that its samples have to meet
    scale: float = 0.0  # Largest |U| (V) seen
    steepest: float = 0.0  # Largest |dU/dt| (V/s) seen
    series: list[FloatArray] = field(default_factory=list)  # (POINTS,): Chebyshev coefficients on each interval
    # Times (s) at which neighbouring series differ, the difference (V), and whether bisection found the jump
    jumps: list[tuple[float, float, bool]] = field(default_factory=list)
    narrow: list[float] = field(default_factory=list)  # Times (s) of intervals much shorter than the output step
    short: list[tuple[float, float]] = field(default_factory=list)  # Start (s) of each short interval, its change (V)
    not_finite: float | None = None  # Time (s) of the first NaN or inf
    rough: float = 0.0  # Largest misfit (V) taken for round-off of the function's values
    deep: int = 0  # Number of intervals that were halved more than `_DEEP` times
    allowed: int = field(default_factory=lambda: _MOST_DEEP)  # Most of them

    def cover(self, a: float, b: float) -> bool:
        """Add series for [a, b] (s); False if the waveform has a NaN or inf inside."""
        # The ends of a window are breakpoints, where the waveform may jump: series use interior points only.
        longest = min(_LONGEST * self.step, 2.0 * self.waveform.shortest_time())
        count = max(1, math.ceil((b - a) / longest))
        waiting = [_Interval(lo, hi) for lo, hi in itertools.pairwise(np.linspace(a, b, count + 1).tolist())][::-1]
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
                self.jumps.append((hi, float(values[-1] - values[0]), True))
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
            self.jumps.append((piece.lo, change, False))
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
        said = f"gives {values[i]:.4g} V and then {again[i]:.4g} V at the same t = {t[i]:.9g} s"
        problem = f"the source function {said}; allowed: the same value at the same time; {remedy}"
        refuse(abs(again[i] - values[i]) > self._roughest, problem)
        said = f"{self.deep} pieces as short as {piece.hi - piece.lo:.2g} s were not smooth"
        problem = f"the source function is too rough to be followed near t = {piece.lo:.9g} s: {said}"
        allowed = "smooth between jumps that are few, or declared by Function(f, breaks=(...))"
        refuse(self.deep == self.allowed, f"{problem}; allowed: {allowed}; {remedy}")

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
        real = [(t, dv) for t, dv, _ in self.jumps if abs(dv) > self._least]
        # Around a jump, a kink, or a NaN short series are expected; report only the short ones far from all of these.
        known = [t for t, dv, located in self.jumps if located or abs(dv) > self._least]
        known += [] if self.not_finite is None else [self.not_finite]
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
            said = f"the source function jumps by {dv:.4g} V at t = {t:.9g} s{more}"
            told.append(f"{said}; it was not declared: give Function(f, breaks=(...)) the times for exact edges")
        if apart:
            said = f"has a feature narrower than the output step {self.step:.3g} s near t = {min(apart):.9g} s"
            advice = "others may be missed: give Function(f, breaks=(...)) its edges"
            told.append(f"the source function {said}; it was resolved where it was seen, but {advice}")
        for text in told:
            warnings.warn(text, FingerspiceWarning, stacklevel=2)
