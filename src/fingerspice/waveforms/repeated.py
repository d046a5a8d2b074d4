"""Waveforms that use a stretch of another waveform: once (`Burst`) or periodically (`Repeat`)."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike

from fingerspice.base.arrays import FloatArray, real_numbers
from fingerspice.waveforms.bounds import runs_through, take_numbers
from fingerspice.waveforms.waveform import Waveform, as_waveform, blank_terms, require

# A time within this relative distance of a breakpoint differs from it only by rounding, and is replaced by it.
_ROUNDING = 8e-16


class _Shifted(Waveform):
    """A waveform made of copies of the first stretch of another waveform, each shifted to the start of the copy."""

    waveform: Waveform

    def _stretch(self) -> float:
        """Length of a stretch, s."""
        raise NotImplementedError

    @cached_property
    def _marks(self) -> FloatArray:
        """Breakpoints of the other waveform within a stretch, and both ends of the stretch, s."""
        length = self._stretch()
        inner = self.waveform.breakpoints(0.0, length)
        return np.concatenate([[0.0], inner[(inner > 0.0) & (inner < length * (1.0 - _ROUNDING))], [length]])

    def _inner(self, t: FloatArray, begin: FloatArray | float) -> FloatArray:
        """Times (s) since the stretch began; a time that differs from a breakpoint only by rounding is set to it."""
        tau = np.asarray(t - begin, float)
        marks = self._marks
        right = np.clip(np.searchsorted(marks, tau), 1, marks.size - 1)
        near = np.where(tau - marks[right - 1] < marks[right] - tau, marks[right - 1], marks[right])
        return np.where(np.abs(tau - near) <= _ROUNDING * np.abs(t), near, tau)

    @property
    def precision(self) -> float:  # type: ignore[override]
        return self.waveform.precision

    def shortest_time(self) -> float:
        return self.waveform.shortest_time()

    def cancelling(self, t0: float, t1: float) -> float:
        return self.waveform.cancelling(0.0, self._stretch())


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
        object.__setattr__(self, "waveform", as_waveform(self.waveform))
        take_numbers(self)
        require(self.duration > 0.0, "burst duration", f"{self.duration:g} s", "> 0")
        require(self.delay >= 0.0, "burst delay", f"{self.delay:g} s", ">= 0")

    def _stretch(self) -> float:
        return self.duration

    @property
    def course(self) -> tuple[float, float]:
        return self.delay, self.delay + self.duration

    def value(self, t: ArrayLike, side: str = "right") -> FloatArray:
        t = real_numbers("t", t, "times in s")
        tau = self._inner(t, self.delay)
        on = (tau >= 0.0) & (tau < self.duration) if side == "right" else (tau > 0.0) & (tau <= self.duration)
        return np.where(on, self.waveform.value(np.where(on, tau, 0.0), side), 0.0)

    def breakpoints(self, t0: float, t1: float) -> FloatArray:
        times = self.delay + self._marks
        return times[(times >= t0) & (times <= t1)]

    def breakpoint_rate(self) -> float:
        return self.waveform.breakpoint_rate()

    def terms(self, start: FloatArray, stop: FloatArray) -> FloatArray | None:
        middle = 0.5 * (start + stop) - self.delay
        on = (middle >= 0.0) & (middle < self.duration)
        block = self.waveform.terms(self._inner(start[on], self.delay), self._inner(stop[on], self.delay))
        if block is None:
            return None
        out = blank_terms(start.size, block.shape[1])
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
        object.__setattr__(self, "waveform", as_waveform(self.waveform))
        take_numbers(self)
        require(self.period > 0.0, "repeat period", f"{self.period:g} s", "> 0")

    def _stretch(self) -> float:
        return self.period

    def value(self, t: ArrayLike, side: str = "right") -> FloatArray:
        t = real_numbers("t", t, "times in s")
        tau = self._inner(t, np.floor(t / self.period) * self.period)
        # By rounding, the start of a period may count as the end of the period before, or an end as a start.
        first, last = (0.0, self.period) if side == "right" else (self.period, 0.0)
        tau = np.where(tau == last, first, tau)
        return self.waveform.value(tau, side)

    def breakpoints(self, t0: float, t1: float) -> FloatArray:
        marks = self._marks[:-1]
        low, high = math.floor(t0 / self.period) - 1.0, math.ceil(t1 / self.period) + 1.0
        runs = runs_through(low, high, marks.size, t0, t1)
        times = (runs[:, None] * self.period + marks).ravel()
        return times[(times >= t0) & (times <= t1)]

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
