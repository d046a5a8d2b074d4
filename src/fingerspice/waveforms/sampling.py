"""A user's function of time as a waveform, and any waveform as a table for compiled code.

Between its breakpoints a function is represented by Chebyshev series, which are refined until they reproduce the
function at points that are not interpolation nodes. Where refining does not help there is a jump that was not
declared: its time is located and becomes an edge of a segment, with a warning.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from fingerspice.base.arrays import BoolArray, FloatArray, positive_number, real_numbers
from fingerspice.base.compiled import jit
from fingerspice.base.errors import InputError
from fingerspice.engine.collocation.loopstate import SAME_TIME
from fingerspice.waveforms.ramps import Ramps, in_windows, runs_through
from fingerspice.waveforms.refining import POINTS, Refiner
from fingerspice.waveforms.waveform import Waveform, require

#: Longest segment of an oscillation, in periods; longer ones are divided, since a phase's rounding error grows with it.
_PERIODS_PER_SEGMENT = 64.0
# Number of times compared between two looks whether one has missed.
_AT_ONCE = 1024
# Units in the last place of the time by which a function is looked at beside a break, for its limits there.
_ASIDE = 8.0


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
        try:
            # A function may work in place: it gets times of its own.
            out = self._taken(self.function(t.copy()))
            # A function written for one number may give wrong values for an array without raising: compare one value.
            if out.shape == t.shape and (
                t.size == 0 or np.array_equal(out.flat[t.size // 2], self._scalar(t.flat[t.size // 2]), True)
            ):
                return out
        except (TypeError, ValueError):
            pass
        self.kept["one by one"] = True
        return np.array([self._scalar(x) for x in t.ravel()]).reshape(t.shape)

    def _scalar(self, t: float) -> float:
        try:
            value = self.function(t)
        except (TypeError, IndexError):
            # A function of arrays only.
            value = self.function(np.array([t]))
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
        runs = runs_through(np.floor(t0 / self.repeat) - 1.0, np.ceil(t1 / self.repeat), len(self.breaks), t0, t1)
        return np.unique((runs[:, None] * self.repeat + np.array(self.breaks)).ravel())

    def breakpoint_rate(self) -> float:
        return len(self.breaks) / self.repeat if self.repeat else 0.0


@dataclass(frozen=True)
class SourceTable:
    """A waveform on a window of time, in the form that compiled code reads."""

    edges: FloatArray  # (m + 1,): Segment edges, s
    terms: FloatArray  # (m, k, 6)
    # (m, l): Chebyshev coefficients of each segment's series, which is added to its terms; l = 0 without series
    series: FloatArray
    scale: float = 0.0  # Largest |U| (V) at the points where the series were fitted and checked; 0 without series
    not_finite: float | None = None  # Time (s) of the first NaN or inf; the table then ends just before it
    # Largest misfit (V) that finer series do not reduce, because it is round-off of the function's own values
    rough: float = 0.0

    def values(self, t: FloatArray) -> FloatArray:
        """Values (V) of the series at times (s) within the table."""
        i = np.clip(np.searchsorted(self.edges, t, side="right") - 1, 0, self.edges.size - 2)
        x = 2.0 * (t - self.edges[i]) / (self.edges[i + 1] - self.edges[i]) - 1.0
        out = np.empty(t.size)
        for k in np.unique(i):
            here = i == k
            out[here] = np.polynomial.chebyshev.chebval(x[here], self.series[k])
        return out

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
        # Counted, not compared one by one: only so the compiler makes vector instructions of it.
        missed = 0
        for i in range(first, min(first + _AT_ONCE, t.size)):
            missed += not abs(t[i] - (start + i * step)) <= slack
        if missed > 0:
            return False
    return True


def misses(t: FloatArray, marks: FloatArray, slack: float) -> BoolArray:
    """For each mark, whether a time is within a share `slack` of it but not equal to it; times and marks ascend."""
    reach = slack * np.abs(marks)
    near = t.searchsorted(marks + reach, "right") - t.searchsorted(marks - reach)
    return np.asarray(near > t.searchsorted(marks, "right") - t.searchsorted(marks))


def breakpoints_at(waveform: Waveform, t: float) -> FloatArray:
    """Breakpoints that differ from `t` (s) at most by rounding."""
    return waveform.breakpoints(t - same_time(t), t + same_time(t))


def on_breakpoint(waveform: Waveform, t: float) -> float:
    """The breakpoint that differs from `t` (s) only by rounding, else `t`; so a run of three periods ends at a jump."""
    near = breakpoints_at(waveform, t)
    return float(near[0]) if near.size else t


def is_sampled(waveform: Waveform) -> bool:
    """Whether a waveform has no terms and is therefore represented by Chebyshev series."""
    if isinstance(waveform, Ramps):
        return False
    if "sampled" not in waveform.kept:
        waveform.kept["sampled"] = waveform.terms(np.zeros(1), np.ones(1)) is None
    return bool(waveform.kept["sampled"])


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
        edges = between
        if no_chirps and np.any(terms[:, :, 5] != 0.0):
            # The output step is not used here, so that no result depends on the outputs asked for.
            step = 0.1 * waveform.shortest_time()
        else:
            return SourceTable(edges, np.ascontiguousarray(terms), np.zeros((edges.size - 1, 0)))
    pieces = Refiner(waveform, tol, step, shortest, scale)
    for a, b in itertools.pairwise(edges):
        if not pieces.cover(float(a), float(b)):
            break
    if terms is None:
        pieces.warn()
    m = len(pieces.series)
    return SourceTable(
        np.array(pieces.edges) if m else np.array([t0]),
        np.zeros((m, 1, 6)),
        np.array(pieces.series).reshape(m, POINTS),
        pieces.scale,
        pieces.not_finite,
        pieces.rough,
    )
