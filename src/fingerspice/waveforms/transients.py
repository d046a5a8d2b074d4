"""Waveforms that are not periodic: a tone whose frequency rises, and SPICE's exponential pulse."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike

from fingerspice.base.arrays import FloatArray, real_numbers
from fingerspice.waveforms.bounds import take_numbers
from fingerspice.waveforms.waveform import TAU, Waveform, blank_terms, require


@dataclass(frozen=True)
class Chirp(Waveform):
    """offset + amplitude sin(phi(t)), whose frequency rises linearly from f0 to f1 over `duration` and then stays.

    Parameters
    ----------
    amplitude : float
        V.
    f0, f1 : float
        Hz, positive: at t = 0, and from `duration` on.
    duration : float
        s.
    offset : float
        V.
    phase_deg : float
        Degrees, at t = 0.
    """

    amplitude: float
    f0: float
    f1: float
    duration: float
    offset: float = 0.0
    phase_deg: float = 0.0
    units: ClassVar[dict[str, str]] = {
        "amplitude": "V",
        "f0": "Hz",
        "f1": "Hz",
        "duration": "s",
        "offset": "V",
        "phase_deg": "deg",
    }

    def __post_init__(self) -> None:
        take_numbers(self)
        require(self.f0 > 0.0 and self.f1 > 0.0, "chirp frequencies", f"{self.f0:g}, {self.f1:g} Hz", "> 0")
        require(self.duration > 0.0, "chirp duration", f"{self.duration:g} s", "> 0")

    def _phase(self, t: FloatArray) -> FloatArray:
        sweep = np.clip(t, 0.0, self.duration)
        turns = (self.f0 + 0.5 * (self.f1 - self.f0) / self.duration * sweep) * sweep
        turns = turns + self.f1 * np.maximum(t - self.duration, 0.0) + self.f0 * np.minimum(t, 0.0)
        return np.asarray(TAU * (turns - np.floor(turns)) + math.radians(self.phase_deg))

    def value(self, t: ArrayLike, side: str = "right") -> FloatArray:
        return np.asarray(self.offset + self.amplitude * np.sin(self._phase(real_numbers("t", t, "times in s"))))

    def breakpoints(self, t0: float, t1: float) -> FloatArray:
        return np.array([t for t in (0.0, self.duration) if t0 <= t <= t1])

    def terms(self, start: FloatArray, stop: FloatArray) -> FloatArray:
        out = blank_terms(start.size, 2)
        out[:, 0, 0] = self.offset
        out[:, 1, 0] = self.amplitude
        rate = (self.f1 - self.f0) / self.duration
        middle = 0.5 * (start + stop)
        inside = (middle >= 0.0) & (middle < self.duration)
        out[:, 1, 3] = TAU * (self.f0 + rate * np.clip(start, 0.0, self.duration))
        out[:, 1, 4] = self._phase(start) - 0.5 * math.pi
        out[:, 1, 5] = np.where(inside, TAU * rate, 0.0)
        return out

    def shortest_time(self) -> float:
        return 1.0 / max(self.f0, self.f1)


@dataclass(frozen=True)
class Exp(Waveform):
    """SPICE's EXP: from `td1` on towards v2 with time constant `tau1`, and from `td2` on back to v1 with `tau2`.

    Voltages in V, times in s; the time constants are positive and td2 >= td1.
    """

    v1: float
    v2: float
    td1: float
    tau1: float
    td2: float
    tau2: float
    units: ClassVar[dict[str, str]] = {
        "v1": "V",
        "v2": "V",
        "td1": "s",
        "tau1": "s",
        "td2": "s",
        "tau2": "s",
    }

    def __post_init__(self) -> None:
        take_numbers(self)
        require(
            self.tau1 > 0.0 and self.tau2 > 0.0,
            "EXP time constants",
            f"{self.tau1:g}, {self.tau2:g} s",
            "> 0",
        )
        require(self.td2 >= self.td1, "EXP td2", f"{self.td2:g} s", f">= td1 = {self.td1:g} s")

    @property
    def course(self) -> tuple[float, float]:
        return self.td1, math.inf

    def value(self, t: ArrayLike, side: str = "right") -> FloatArray:
        t = real_numbers("t", t, "times in s")
        rise = -np.expm1(-np.maximum(t - self.td1, 0.0) / self.tau1)
        fall = -np.expm1(-np.maximum(t - self.td2, 0.0) / self.tau2)
        return np.asarray(self.v1 + (self.v2 - self.v1) * (rise - fall))

    def breakpoints(self, t0: float, t1: float) -> FloatArray:
        return np.array([t for t in sorted({self.td1, self.td2}) if t0 <= t <= t1])

    def terms(self, start: FloatArray, stop: FloatArray) -> FloatArray:
        out = blank_terms(start.size, 3)
        step = self.v2 - self.v1
        first = 0.5 * (start + stop) >= self.td1
        second = 0.5 * (start + stop) >= self.td2
        out[:, 0, 0] = self.v1 + step * (first.astype(float) - second.astype(float))
        out[:, 1, 0] = np.where(first, -step * np.exp(-np.maximum(start - self.td1, 0.0) / self.tau1), 0.0)
        out[:, 1, 2] = -1.0 / self.tau1
        out[:, 2, 0] = np.where(second, step * np.exp(-np.maximum(start - self.td2, 0.0) / self.tau2), 0.0)
        out[:, 2, 2] = -1.0 / self.tau2
        return out

    def shortest_time(self) -> float:
        return min(self.tau1, self.tau2)
