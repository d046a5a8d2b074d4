"""Sums and products of waveforms, the amplitude-modulated carrier, and stretches that are used once or repeated."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from fractions import Fraction
from functools import cached_property, reduce
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from fingerspice.base.arrays import FloatArray, real_numbers
from fingerspice.waveforms.periodic import runs_through
from fingerspice.waveforms.waveform import DC, Sine, Waveform, as_waveform, require

#: Most cycles of a part in a common period.
MOST_CYCLES = 10**6
# Largest relative rounding error of a ratio of two periods.
_ROUNDING = 2e-15


class _Combination(Waveform):
    parts: tuple[Waveform, ...]
    _joined: ClassVar[Callable[..., Any]]  # Sum or product of numbers or arrays

    _joined_terms: ClassVar[Callable[..., Any]]  # Terms (m, k, 6) of the sum or product of two parts, from theirs

    def __post_init__(self) -> None:
        super().__post_init__()
        rate = sum(1.0 / part.shortest_time() for part in self.parts)
        settled = max(part.settled for part in self.parts)
        self._declare(period=_common_period(self.parts), settled=settled, _quick=1.0 / rate if rate else math.inf)

    def value(self, t: ArrayLike, side: str = "right") -> FloatArray:
        return np.asarray(self._joined(part.value(t, side) for part in self.parts))

    def cancelling(self, t0: float, t1: float) -> float:
        return float(self._joined(max(part.peak(t0, t1), part.cancelling(t0, t1)) for part in self.parts))

    def terms(self, start: FloatArray, stop: FloatArray) -> FloatArray | None:
        blocks = [part.terms(start, stop) for part in self.parts]
        known = [block for block in blocks if block is not None]
        return reduce(self._joined_terms, known) if len(known) == len(blocks) else None

    def breakpoints(self, t0: float, t1: float) -> FloatArray:
        return np.unique(np.concatenate([part.breakpoints(t0, t1) for part in self.parts]))

    def breakpoint_rate(self) -> float:
        return sum(part.breakpoint_rate() for part in self.parts)

    @property
    def precision(self) -> float:  # type: ignore[override]
        return max(part.precision for part in self.parts)

    @property
    def course(self) -> tuple[float, float]:  # type: ignore[override]
        first, last = zip(*(part.course for part in self.parts), strict=True)
        return min(first), max(last)

    def _tones(self) -> list[float]:
        return [tone for part in self.parts if (tone := part.tone()) is not None]


def _common_period(parts: tuple[Waveform, ...]) -> float | None:
    """Least common period of waveforms (s); None unless it has at most `MOST_CYCLES` cycles of each."""
    total: float | None = None
    for period in (part.period for part in parts if not isinstance(part, DC)):
        if period is None:
            return None
        ratio = 1.0 if total is None else total / period
        fraction = Fraction(ratio).limit_denominator(MOST_CYCLES)
        if fraction.numerator > MOST_CYCLES or abs(float(fraction) - ratio) > _ROUNDING * ratio:
            return None
        total = period if total is None else total * fraction.denominator
    return total


@dataclass(frozen=True)
class Sum(_Combination):
    """Sum of waveforms; its fundamental is the lowest tone of its parts, if all other tones are harmonics of it."""

    parts: tuple[Waveform, ...]
    _joined = staticmethod(sum)
    _joined_terms = staticmethod(lambda a, b: np.concatenate([a, b], axis=1))

    def tone(self) -> float | None:
        tones = self._tones()
        if self.period is None or len(tones) < sum(not isinstance(part, DC) for part in self.parts):
            return None
        lowest = min(tones)
        return lowest if all(abs(t / lowest - round(t / lowest)) < 1e-9 for t in tones) else None


class _OfFactors(_Combination):
    _joined = staticmethod(math.prod)

    @staticmethod
    def _joined_terms(a: FloatArray, b: FloatArray) -> FloatArray:
        """By cos x cos y = (cos(x + y) + cos(x - y)) / 2."""
        a = a[:, np.any(a[:, :, 0] != 0.0, axis=0)]
        b = b[:, np.any(b[:, :, 0] != 0.0, axis=0)]
        columns = []
        for x, y in itertools.product(a.swapaxes(0, 1), b.swapaxes(0, 1)):
            base = x + y
            base[:, 0] = x[:, 0] * y[:, 0]
            if np.any(x[:, 3:] != 0.0) and np.any(y[:, 3:] != 0.0):
                base[:, 0] *= 0.5
                other = base.copy()
                other[:, 3:] = x[:, 3:] - y[:, 3:]
                columns.append(other)
            columns.append(base)
        return np.stack(columns, axis=1) if columns else np.zeros((a.shape[0], 1, 6))

    def tone(self) -> float | None:
        tones = self._tones()
        return max(tones) if tones and self.period is not None else None


@dataclass(frozen=True)
class Product(_OfFactors):
    """Product of waveforms; its fundamental is the highest tone of its factors, which is the carrier's."""

    parts: tuple[Waveform, ...]


@dataclass(frozen=True)
class AM(_OfFactors):
    """Amplitude-modulated carrier: amplitude (1 + depth sin(2 pi f_m t + phase)) / (1 + depth) sin(2 pi f_c t).

    Parameters
    ----------
    amplitude : float
        Largest value of the envelope, V.
    carrier, modulation : float
        Hz, positive.
    depth : float
        From 0 (the carrier alone) to 1 (the envelope falls to zero).
    phase_deg : float
        Phase of the envelope, degrees.
    """

    amplitude: float
    carrier: float
    modulation: float
    depth: float = 1.0
    phase_deg: float = 0.0
    units: ClassVar[dict[str, str]] = {
        "amplitude": "V", "carrier": "Hz", "modulation": "Hz", "depth": "", "phase_deg": "deg"
    }  # fmt: skip

    def __post_init__(self) -> None:
        Waveform.__post_init__(self)
        require(0.0 <= self.depth <= 1.0, "AM depth", f"{self.depth:g}", "0 to 1")
        super().__post_init__()

    @cached_property
    def parts(self) -> tuple[Waveform, ...]:  # type: ignore[override]
        share = self.amplitude / (1.0 + self.depth)
        envelope = Sine(share * self.depth, self.modulation, offset=share, phase_deg=self.phase_deg)
        return (envelope, Sine(1.0, self.carrier))


# A time within this relative distance of a breakpoint differs from it only by rounding, and is replaced by it.
_ROUNDING_OF_TIMES = 8e-16


class _Shifted(Waveform):
    """A waveform made of copies of the first stretch of another waveform, each shifted to the start of the copy."""

    waveform: Waveform
    _stretch: float  # Length of a stretch, s

    def __post_init__(self) -> None:
        wave = as_waveform(self.waveform)
        self._declare(waveform=wave, _quick=wave.shortest_time())
        super().__post_init__()

    @cached_property
    def _marks(self) -> FloatArray:
        """Breakpoints of the other waveform within a stretch, and both ends of the stretch, s."""
        inner = self.waveform.breakpoints(0.0, self._stretch)
        inner = inner[(inner > 0.0) & (inner < self._stretch * (1.0 - _ROUNDING_OF_TIMES))]
        return np.concatenate([[0.0], inner, [self._stretch]])

    def _inner(self, t: FloatArray, begin: FloatArray | float) -> FloatArray:
        """Times (s) since the stretch began; a time that differs from a breakpoint only by rounding is set to it."""
        tau = np.asarray(t - begin, float)
        marks = self._marks
        right = np.clip(np.searchsorted(marks, tau), 1, marks.size - 1)
        near = np.where(tau - marks[right - 1] < marks[right] - tau, marks[right - 1], marks[right])
        return np.where(np.abs(tau - near) <= _ROUNDING_OF_TIMES * np.abs(t), near, tau)

    @property
    def precision(self) -> float:  # type: ignore[override]
        return self.waveform.precision

    def cancelling(self, t0: float, t1: float) -> float:
        return self.waveform.cancelling(0.0, self._stretch)


@dataclass(frozen=True)
class Burst(_Shifted):
    """The first `duration` of a waveform, beginning at `delay`; 0 V before and after.

    Parameters
    ----------
    waveform : Waveform
        Its time 0 is the beginning of the burst. A number or a function of time (s) is accepted, too.
    duration : float
        s, positive.
    delay : float
        s, not negative.
    """

    waveform: Waveform
    duration: float
    delay: float = 0.0
    units: ClassVar[dict[str, str]] = {"duration": "s", "delay": "s"}

    def __post_init__(self) -> None:
        super().__post_init__()
        require(self.duration > 0.0, "burst duration", f"{self.duration:g} s", "> 0")
        require(self.delay >= 0.0, "burst delay", f"{self.delay:g} s", ">= 0")
        self._declare(_stretch=self.duration, course=(self.delay, self.delay + self.duration))

    def value(self, t: ArrayLike, side: str = "right") -> FloatArray:
        t = real_numbers("t", t, "times in s")
        tau = self._inner(t, self.delay)
        on = (tau >= 0.0) & (tau < self.duration) if side == "right" else (tau > 0.0) & (tau <= self.duration)
        return np.where(on, self.waveform.value(np.where(on, tau, 0.0), side), 0.0)

    def _edges(self, t0: float, t1: float) -> FloatArray:
        return np.asarray(self.delay + self._marks)

    def breakpoint_rate(self) -> float:
        return self.waveform.breakpoint_rate()

    def terms(self, start: FloatArray, stop: FloatArray) -> FloatArray | None:
        middle = 0.5 * (start + stop) - self.delay
        on = (middle >= 0.0) & (middle < self.duration)
        block = self.waveform.terms(self._inner(start[on], self.delay), self._inner(stop[on], self.delay))
        if block is None:
            return None
        out = np.zeros((start.size, *block.shape[1:]))
        out[on] = block
        return out


@dataclass(frozen=True)
class Repeat(_Shifted):
    """The first `period` of a waveform, repeated for ever.

    The fundamental is the tone of the waveform, if a whole number of its cycles fits `period`, and else 1/period.

    Parameters
    ----------
    waveform : Waveform
        Used from its time 0 to `period`. A number or a function of time (s) is accepted, too.
    period : float
        s, positive.
    """

    waveform: Waveform
    period: float = field()
    units: ClassVar[dict[str, str]] = {"period": "s"}

    def __post_init__(self) -> None:
        super().__post_init__()
        require(self.period > 0.0, "repeat period", f"{self.period:g} s", "> 0")
        self._declare(_stretch=self.period)

    def value(self, t: ArrayLike, side: str = "right") -> FloatArray:
        t = real_numbers("t", t, "times in s")
        tau = self._inner(t, np.floor(t / self.period) * self.period)
        # By rounding, the start of a period may count as the end of the period before, or an end as a start.
        first, last = (0.0, self.period) if side == "right" else (self.period, 0.0)
        return self.waveform.value(np.where(tau == last, first, tau), side)

    def _edges(self, t0: float, t1: float) -> FloatArray:
        marks = self._marks[:-1]
        low, high = math.floor(t0 / self.period) - 1.0, math.ceil(t1 / self.period) + 1.0
        return np.asarray((runs_through(low, high, marks.size, t0, t1)[:, None] * self.period + marks).ravel())

    def breakpoint_rate(self) -> float:
        return self._marks.size / self.period

    def terms(self, start: FloatArray, stop: FloatArray) -> FloatArray | None:
        begin = np.floor(0.5 * (start + stop) / self.period) * self.period
        return self.waveform.terms(self._inner(start, begin), self._inner(stop, begin))

    def tone(self) -> float | None:
        inside = self.waveform.waveform if isinstance(self.waveform, Burst) else self.waveform
        tone = inside.tone()
        turns = 0.0 if tone is None else tone * self.period
        return tone if round(turns) >= 1 and abs(turns - round(turns)) < 1e-9 * turns else 1.0 / self.period
