"""A function as Chebyshev series, refined until they reproduce it at points that they were not built from."""

from __future__ import annotations

import itertools
import math
import warnings
from dataclasses import dataclass, field

import numpy as np

from fingerspice.base.arrays import FloatArray
from fingerspice.base.errors import FingerspiceWarning, InputError
from fingerspice.numerics import chebyshev
from fingerspice.waveforms.waveform import Waveform

POINTS = 20
# Points between the nodes at which a series has to prove itself; irregular, so that no period hides from them.
_AT_START = (-1.0) ** np.arange(POINTS)
_PROOF = 2.0 * np.modf(np.arange(1, 28) * 0.6180339887498949)[0] - 1.0
_PLACES = np.concatenate([chebyshev.nodes(POINTS, -1.0, 1.0), _PROOF])
_NODE_STEPS = np.diff(_PLACES[:POINTS])

# Halvings in a row that mend nothing, and the misfit over the largest |U| that may then be called rounding.
_IDLE, _ROUGHEST = 3, 1e-8
# Change over the largest |U| that makes a short series an edge, and not one of those that stand around a kink.
_STEEP = 0.05
# V; below, doubles lose their digits, and no function is smooth.
_NOTHING = 1e-290
# Halvings beyond which an interval is one around a jump or a kink, which takes about 60 intervals of that depth; and
# how many of these a table may have, at once and for each interval that it starts from.
_DEEP, _MOST_DEEP, _MOST_DEEP_EACH = 12, 10_000, 100


@dataclass
class Refiner:
    """Covers intervals with Chebyshev series by bisection."""

    waveform: Waveform
    tol: float
    step: float
    scale: float = 0.0
    steepest: float = 0.0
    edges: list[float] = field(default_factory=list)
    series: list[FloatArray] = field(default_factory=list)
    jumps: list[tuple[float, float]] = field(default_factory=list)
    located: list[float] = field(default_factory=list)
    narrow: list[float] = field(default_factory=list)
    short: list[tuple[float, float]] = field(default_factory=list)
    not_finite: float | None = None
    rough: float = 0.0
    allowed: int = _MOST_DEEP
    deep: int = 0

    def cover(self, a: float, b: float) -> bool:
        """Add series for [a, b]; False where the waveform stops being finite inside."""
        if not self.edges:
            self.edges.append(a)
        # A window between breakpoints is open at its ends: the series use inner points only.
        longest = min(8.0 * self.step, 2.0 * self.waveform.shortest_time())
        count = max(1, math.ceil((b - a) / longest))
        cuts = np.linspace(a, b, count + 1)
        # Intervals with how often they were halved, the misfit before the last halving, the largest before any, and how
        # often halving was no use.
        stack = [(float(x), float(y), 0, math.inf, 0.0, 0) for x, y in itertools.pairwise(cuts)][::-1]
        self.allowed += _MOST_DEEP_EACH * count
        while stack:
            lo, hi, depth, before, most, idle = stack.pop()
            series, values, misfit = self._try(lo, hi, depth)
            if depth > _DEEP and series is None and np.all(np.isfinite(values)):
                self._mind_noise(lo, hi, values)
            idle = idle + 1 if misfit > 0.7 * before else 0
            if series is None and idle >= _IDLE and misfit <= _ROUGHEST * self.scale:
                # A smooth function's misfit falls by 2^20, that of a kink by two: this is the rounding of its values.
                self.rough = max(self.rough, misfit)
                series = chebyshev.coefficients(values)
            if not np.all(np.isfinite(values)):
                if hi - lo <= 1e-12 * max(abs(hi), self.step) or depth > 60:
                    self.not_finite = lo if lo == self.edges[0] else hi
                    return False
                middle = 0.5 * (lo + hi)
                stack += [(middle, hi, depth + 1, math.inf, most, 0), (lo, middle, depth + 1, math.inf, most, 0)]
                continue
            floor = max(4e-15 * max(abs(lo), abs(hi)), 1e-13 * self.step)
            if series is None and hi - lo <= floor:
                # What does not refine at this width is a jump (or a kink): an edge, not a steep ramp.
                self.jumps.append((hi, float(values[-1] - values[0])))
                self.located.append(hi)
                if self.series:
                    self.edges[-1] = hi
                continue
            if series is None:
                middle = 0.5 * (lo + hi)
                most = max(most, misfit)
                stack += [(middle, hi, depth + 1, misfit, most, idle), (lo, middle, depth + 1, misfit, most, idle)]
                continue
            if hi - lo < 0.75 * self.step and most > _ROUGHEST * self.scale:
                self.narrow.append(0.5 * (lo + hi))
            if hi - lo < 0.75 * self.step:
                self.short.append((lo, float(series.sum() - series @ _AT_START)))
            if self.series and lo > a and not (self.jumps and self.jumps[-1][0] >= lo):
                # A jump, or a steep edge, may stand on a cut, where no point of either side sees it.
                change = float(series @ _AT_START - self.series[-1].sum())
                if abs(change) > self._least and hi - lo > floor:
                    first, middle, behind = self.edges[-2], 0.5 * (lo + hi), 0.5 * (self.edges[-2] + lo)
                    stack += [(middle, hi, depth + 1, math.inf, most, 0), (lo, middle, depth + 1, math.inf, most, 0)]
                    if lo - first > floor:
                        del self.edges[-1], self.series[-1]
                        stack += [
                            (behind, lo, depth + 1, math.inf, most, 0),
                            (first, behind, depth + 1, math.inf, most, 0),
                        ]
                    continue
                self.jumps.append((lo, change))
            self.edges.append(hi)
            self.series.append(series)
        return True

    @staticmethod
    def _places(lo: float, hi: float) -> FloatArray:
        """Where an interval is looked at: the nodes, then the points of the proof, s."""
        return 0.5 * (lo + hi) + 0.5 * (hi - lo) * _PLACES

    def _try(self, lo: float, hi: float, depth: int) -> tuple[FloatArray | None, FloatArray, float]:
        """Series of one interval if it proves itself, the values at its nodes, and its misfit between them, V."""
        t = self._places(lo, hi)
        values = self.waveform.value(t)
        if not np.all(np.isfinite(values)):
            return None, values, math.inf
        self.scale = max(self.scale, float(np.abs(values).max()))
        c = chebyshev.coefficients(values[:POINTS])
        proof = np.polynomial.chebyshev.chebval(_PROOF, c)
        if depth == 0:
            self.steepest = float(np.abs(np.diff(values[:POINTS]) / (0.5 * (hi - lo) * _NODE_STEPS)).max())
        # A function cannot be smoother than the rounding of its own argument lets it be.
        noise = 2e-15 * max(abs(lo), abs(hi)) * self.steepest
        misfit = float(np.abs(proof - values[POINTS:]).max())
        good = misfit <= max(self.tol * self.scale, noise, _NOTHING)
        return (c if good else None), values[:POINTS], misfit

    def _mind_noise(self, lo: float, hi: float, values: FloatArray) -> None:
        """Count an interval that will not refine; refuse what no refining would ever end with."""
        self.deep += 1
        if self.deep not in (1, self.allowed):
            return
        t = self._places(lo, hi)
        again = self.waveform.value(t)[:POINTS]
        i = int(np.argmax(np.abs(again - values)))
        remedy = "of noise draw the values once and give fs.Samples(values, rate)"
        # Not to the last digit: a function of arrays may sum in another order.
        if abs(again[i] - values[i]) > _ROUGHEST * self.scale:
            raise InputError(
                f"the source function gives {values[i]:.4g} V and then {again[i]:.4g} V at the same t = {t[i]:.9g} s; "
                f"allowed: the same value at the same time; {remedy}"
            )
        if self.deep == self.allowed:
            raise InputError(
                f"the source function is too rough to be followed near t = {lo:.9g} s: {self.deep} pieces as short as "
                f"{hi - lo:.2g} s were not smooth; allowed: smooth between jumps that are few, or declared by "
                f"Function(f, breaks=(...)); {remedy}"
            )

    @property
    def _least(self) -> float:
        """Smallest change that is a jump, V."""
        return max(1e3 * self.tol * self.scale, 10.0 * self.rough)

    def warn(self) -> None:
        """One warning for the jumps, one for the narrow features, found and not declared."""
        real = [(t, dv) for t, dv in self.jumps if abs(dv) > self._least]
        if real:
            t, dv = real[0]
            warnings.warn(
                f"the source function jumps by {dv:.4g} V at t = {t:.9g} s"
                + (f" and {len(real) - 1} more times" if len(real) > 1 else "")
                + "; it was not declared: give Function(f, breaks=(...)) the times for exact edges",
                FingerspiceWarning,
                stacklevel=2,
            )
        # Around a jump, a kink or the end of what is finite, short series are natural.
        known = [*self.located, *(t for t, _ in real), *([] if self.not_finite is None else [self.not_finite])]
        apart = [t for t in self.narrow if all(abs(t - k) > 8.0 * self.step for k in known)]
        apart = sorted(apart + self._edges_found())
        if apart:
            warnings.warn(
                f"the source function has a feature narrower than the output step {self.step:.3g} s "
                f"near t = {apart[0]:.9g} s; it was resolved where it was seen, but others may be missed: "
                "give Function(f, breaks=(...)) its edges",
                FingerspiceWarning,
                stacklevel=2,
            )

    def _edges_found(self) -> list[float]:
        """Where short series change much within a tenth of a step: edges that were not declared, and resolved."""
        if not self.short:
            return []
        t, change = np.array(self.short).T
        total = np.concatenate([[0.0], np.cumsum(change)])
        after = np.searchsorted(t, t + 0.1 * self.step)
        steep = np.flatnonzero(np.abs(total[after] - total[:-1]) > _STEEP * self.scale)
        return [float(t[i + np.argmax(np.abs(change[i : after[i]]))]) for i in steep[:1]]
