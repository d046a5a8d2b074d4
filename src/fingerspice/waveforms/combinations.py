"""Sums and products of waveforms, and the amplitude-modulated carrier."""

from __future__ import annotations

import math
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike

from fingerspice.base.arrays import FloatArray
from fingerspice.waveforms.bounds import take_numbers
from fingerspice.waveforms.waveform import DC, Sine, Waveform, blank_terms, require

#: Most cycles of a part in a common period.
MOST_CYCLES = 10**6
# Largest relative rounding error of a ratio of two periods.
_ROUNDING = 2e-15


class _Combination(Waveform):
    parts: tuple[Waveform, ...]

    def breakpoints(self, t0: float, t1: float) -> FloatArray:
        return np.unique(np.concatenate([part.breakpoints(t0, t1) for part in self.parts]))

    def shortest_time(self) -> float:
        rate = sum(1.0 / part.shortest_time() for part in self.parts)
        return 1.0 / rate if rate else math.inf

    def breakpoint_rate(self) -> float:
        return sum(part.breakpoint_rate() for part in self.parts)

    @property
    def precision(self) -> float:  # type: ignore[override]
        return max(part.precision for part in self.parts)

    @property
    def settled(self) -> float:
        return max(part.settled for part in self.parts)

    @property
    def course(self) -> tuple[float, float]:
        first, last = zip(*(part.course for part in self.parts), strict=True)
        return min(first), max(last)

    @cached_property
    def period(self) -> float | None:  # type: ignore[override]
        """Least common period of the parts (s); None unless it has at most `MOST_CYCLES` cycles of each."""
        total: float | None = None
        for part in self.parts:
            if isinstance(part, DC):
                continue
            if part.period is None:
                return None
            if total is None:
                total = part.period
                continue
            ratio = total / part.period
            fraction = Fraction(ratio).limit_denominator(MOST_CYCLES)
            if fraction.numerator > MOST_CYCLES or abs(float(fraction) - ratio) > _ROUNDING * ratio:
                return None
            total *= fraction.denominator
        return total

    def _tones(self) -> list[float]:
        return [tone for part in self.parts if (tone := part.tone()) is not None]


@dataclass(frozen=True)
class Sum(_Combination):
    """Sum of waveforms; its fundamental is the lowest tone of its parts, if all other tones are harmonics of it."""

    parts: tuple[Waveform, ...]

    def value(self, t: ArrayLike, side: str = "right") -> FloatArray:
        return np.asarray(sum(part.value(t, side) for part in self.parts))

    def cancelling(self, t0: float, t1: float) -> float:
        return sum(max(part.peak(t0, t1), part.cancelling(t0, t1)) for part in self.parts)

    def terms(self, start: FloatArray, stop: FloatArray) -> FloatArray | None:
        blocks = [part.terms(start, stop) for part in self.parts]
        known = [block for block in blocks if block is not None]
        return np.concatenate(known, axis=1) if len(known) == len(blocks) else None

    def tone(self) -> float | None:
        if self.period is None or any(part.tone() is None and not isinstance(part, DC) for part in self.parts):
            return None
        tones = self._tones()
        lowest = min(tones)
        return lowest if all(abs(t / lowest - round(t / lowest)) < 1e-9 for t in tones) else None


@dataclass(frozen=True)
class Product(_Combination):
    """Product of waveforms; its fundamental is the highest tone of its factors, which is the carrier's."""

    parts: tuple[Waveform, ...]

    def value(self, t: ArrayLike, side: str = "right") -> FloatArray:
        return np.asarray(math.prod(part.value(t, side) for part in self.parts))

    def cancelling(self, t0: float, t1: float) -> float:
        return math.prod(max(part.peak(t0, t1), part.cancelling(t0, t1)) for part in self.parts)

    def terms(self, start: FloatArray, stop: FloatArray) -> FloatArray | None:
        out: FloatArray | None = None
        for part in self.parts:
            block = part.terms(start, stop)
            if block is None:
                return None
            out = block if out is None else _multiply(out, block)
        return out

    def tone(self) -> float | None:
        tones = self._tones()
        return max(tones) if tones and self.period is not None else None


def _multiply(a: FloatArray, b: FloatArray) -> FloatArray:
    """Product of two blocks of terms, by cos x cos y = (cos(x + y) + cos(x - y)) / 2."""
    a = a[:, np.any(a[:, :, 0] != 0.0, axis=0)]
    b = b[:, np.any(b[:, :, 0] != 0.0, axis=0)]
    columns = []
    for i in range(a.shape[1]):
        for j in range(b.shape[1]):
            x, y = a[:, i], b[:, j]
            base = x + y
            base[:, 0] = x[:, 0] * y[:, 0]
            if np.any(x[:, 3:] != 0.0) and np.any(y[:, 3:] != 0.0):
                base[:, 0] *= 0.5
                other = base.copy()
                other[:, 3:] = x[:, 3:] - y[:, 3:]
                columns.append(other)
            columns.append(base)
    return np.stack(columns, axis=1) if columns else blank_terms(a.shape[0], 1)


@dataclass(frozen=True)
class AM(_Combination):
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
        "amplitude": "V",
        "carrier": "Hz",
        "modulation": "Hz",
        "depth": "",
        "phase_deg": "deg",
    }

    def __post_init__(self) -> None:
        take_numbers(self)
        require(0.0 <= self.depth <= 1.0, "AM depth", f"{self.depth:g}", "0 to 1")

    @cached_property
    def parts(self) -> tuple[Waveform, ...]:  # type: ignore[override]
        share = self.amplitude / (1.0 + self.depth)
        envelope = Sine(share * self.depth, self.modulation, offset=share, phase_deg=self.phase_deg)
        return (envelope, Sine(1.0, self.carrier))

    value = Product.value
    cancelling = Product.cancelling
    terms = Product.terms
    tone = Product.tone
