"""Periodic waveforms made of straight pieces: square, triangle and sawtooth."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from fingerspice.base.arrays import FloatArray
from fingerspice.waveforms.bounds import check_finite, runs_through
from fingerspice.waveforms.ramps import Ramps
from fingerspice.waveforms.waveform import require


@dataclass(frozen=True)
class _Periodic(Ramps):
    """A shape of straight pieces repeated for ever, shifted by `delay` and `phase_deg`."""

    amplitude: float
    frequency: float
    offset: float = 0.0
    phase_deg: float = 0.0
    delay: float = 0.0
    units: ClassVar[dict[str, str]] = {
        "amplitude": "V",
        "frequency": "Hz",
        "duty": "",
        "offset": "V",
        "phase_deg": "deg",
        "delay": "s",
    }

    def __post_init__(self) -> None:
        check_finite(self)
        kind = type(self).__name__.lower()
        require(self.frequency > 0.0, f"{kind} frequency", f"{self.frequency:g} Hz", "> 0")

    @property
    def period(self) -> float | None:  # type: ignore[override]
        return 1.0 / self.frequency

    def _times(self, t0: float, t1: float) -> FloatArray:
        # Computed as (k + x) / f, an edge is rounded to the very number that a user writes for its time.
        x = self._knots()[0] * self.frequency
        shift = self.delay - self.phase_deg / 360.0 / self.frequency
        low = np.floor((t0 - shift) * self.frequency) - 1.0
        high = np.ceil((t1 - shift) * self.frequency) + 1.0
        runs = runs_through(low, high, x.size, t0, t1)
        return np.asarray(((runs[:, None] + x) / self.frequency + shift).ravel())

    @property
    def _first(self) -> float:  # type: ignore[override]
        # Begin a whole number of periods earlier, at or before t = 0: the delay shifts the shape, and delays nothing.
        shift = self.delay - self.phase_deg / 360.0 / self.frequency
        period = 1.0 / self.frequency
        return shift - math.ceil(shift / period - 1e-12) * period if shift > 0.0 else shift

    def breakpoint_rate(self) -> float:
        return 4.0 * self.frequency


@dataclass(frozen=True)
class Square(_Periodic):
    """offset + amplitude for the fraction `duty` of each period, then offset - amplitude, with ideal edges.

    Amplitude and offset in V, frequency in Hz, duty between 0 and 1, phase in degrees, and delay, a shift, in s.
    """

    duty: float = 0.5

    def __init__(
        self,
        amplitude: float,
        frequency: float,
        duty: float = 0.5,
        offset: float = 0.0,
        phase_deg: float = 0.0,
        delay: float = 0.0,
    ) -> None:
        for name, value in (
            ("amplitude", amplitude),
            ("frequency", frequency),
            ("duty", duty),
            ("offset", offset),
            ("phase_deg", phase_deg),
            ("delay", delay),
        ):
            object.__setattr__(self, name, value)
        self.__post_init__()
        require(0.0 < duty < 1.0, "square duty", f"{duty:g}", "between 0 and 1")

    @property
    def half_wave(self) -> bool:
        return self.offset == 0.0 and self.duty == 0.5

    def _knots(self) -> tuple[FloatArray, FloatArray]:
        period = 1.0 / self.frequency
        t = np.array([0.0, 0.0, self.duty, self.duty, 1.0]) * period
        sign = np.array([-1.0, 1.0, 1.0, -1.0, -1.0])
        return t, self.offset + self.amplitude * sign


@dataclass(frozen=True)
class Triangle(_Periodic):
    """Triangle in phase with a sine: +amplitude at a quarter and -amplitude at three quarters of a period."""

    @property
    def half_wave(self) -> bool:
        return self.offset == 0.0

    def _knots(self) -> tuple[FloatArray, FloatArray]:
        period = 1.0 / self.frequency
        t = np.array([0.0, 0.25, 0.75, 1.0]) * period
        return t, self.offset + self.amplitude * np.array([0.0, 1.0, -1.0, 0.0])


@dataclass(frozen=True)
class Sawtooth(_Periodic):
    """Rises from offset - amplitude to offset + amplitude over each period, and jumps back at its end."""

    def _knots(self) -> tuple[FloatArray, FloatArray]:
        period = 1.0 / self.frequency
        t = np.array([0.0, 0.0, 1.0]) * period
        return t, self.offset + self.amplitude * np.array([1.0, -1.0, 1.0])
