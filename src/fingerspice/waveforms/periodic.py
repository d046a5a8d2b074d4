"""Waveforms of straight pieces: square, triangle, sawtooth, pulses; the chirp and the exponential pulse."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike

from fingerspice.base.arrays import FloatArray, real_numbers
from fingerspice.waveforms.ramps import Ramps, runs_through
from fingerspice.waveforms.waveform import TAU, Waveform, require, terms_of


@dataclass(frozen=True)
class _Periodic(Ramps):
    """A shape of straight pieces repeated for ever, shifted by `delay` and `phase_deg`."""

    amplitude: float
    frequency: float
    offset: float = 0.0
    phase_deg: float = 0.0
    delay: float = 0.0
    _shift: ClassVar[float]  # Time of the shape's start, s
    # Times of the knots in periods, values over the offset in amplitudes, and whether half of it is the other half
    # turned over
    _shape: ClassVar[tuple[tuple[float, ...], tuple[float, ...], bool]]
    units: ClassVar[dict[str, str]] = {
        "amplitude": "V", "frequency": "Hz", "offset": "V", "phase_deg": "deg", "delay": "s"
    }  # fmt: skip

    def __post_init__(self) -> None:
        super().__post_init__()
        kind = type(self).__name__.lower()
        require(self.frequency > 0.0, f"{kind} frequency", f"{self.frequency:g} Hz", "> 0")
        period = 1.0 / self.frequency
        # Begin whole periods earlier, at or before t = 0: the delay shifts the shape, and holds nothing before it.
        shift = first = self.delay - self.phase_deg / 360.0 / self.frequency
        if shift > 0.0:
            first = shift - math.ceil(shift / period - 1e-12) * period
        turned = self.offset == 0.0 and self._shape[2]
        self._declare(period=period, half_wave=turned, _shift=shift, _first=first, _origin=first)

    @cached_property
    def knots(self) -> tuple[FloatArray, FloatArray]:
        x, y, _ = self._shape
        return np.array(x) * self.period, self.offset + self.amplitude * np.array(y)

    def _times(self, t0: float, t1: float) -> FloatArray:
        # Computed as (k + x) / f, an edge is rounded to the same double as the time that a user writes for it.
        x = self.knots[0] * self.frequency
        low, high = (np.floor((t0 - self._shift) * self.frequency), np.ceil((t1 - self._shift) * self.frequency))
        runs = runs_through(low - 1.0, high + 1.0, x.size, t0, t1)
        return np.asarray(((runs[:, None] + x) / self.frequency + self._shift).ravel())

    def breakpoint_rate(self) -> float:
        return 4.0 * self.frequency


@dataclass(frozen=True)
class Square(_Periodic):
    """offset + amplitude for the fraction `duty` of each period, then offset - amplitude, with ideal edges.

    Amplitude and offset in V, frequency in Hz, duty between 0 and 1, phase in degrees, and delay, a shift, in s.
    """

    duty: float = 0.5
    units: ClassVar[dict[str, str]] = {"amplitude": "V", "frequency": "Hz", "duty": "", **_Periodic.units}

    # Beside the frequency the duty comes first, as in netlists; the fields that all shapes have precede it otherwise.
    def __init__(
        self, amplitude: float, frequency: float, duty: float = 0.5, offset: float = 0.0, phase_deg: float = 0.0,
        delay: float = 0.0,
    ) -> None:  # fmt: skip
        object.__setattr__(self, "duty", duty)
        super().__init__(amplitude, frequency, offset, phase_deg, delay)
        require(0.0 < self.duty < 1.0, "square duty", f"{self.duty:g}", "between 0 and 1")

    @property
    def _shape(self) -> tuple[tuple[float, ...], tuple[float, ...], bool]:  # type: ignore[override]
        return (0.0, 0.0, self.duty, self.duty, 1.0), (-1.0, 1.0, 1.0, -1.0, -1.0), self.duty == 0.5


@dataclass(frozen=True)
class Triangle(_Periodic):
    """Triangle in phase with a sine: +amplitude at a quarter and -amplitude at three quarters of a period."""

    _shape = (0.0, 0.25, 0.75, 1.0), (0.0, 1.0, -1.0, 0.0), True


@dataclass(frozen=True)
class Sawtooth(_Periodic):
    """Rises from offset - amplitude to offset + amplitude over each period, and jumps back at its end."""

    _shape = (0.0, 0.0, 1.0), (1.0, -1.0, 1.0), False


@dataclass(frozen=True)
class Pulse(Ramps):
    """SPICE's PULSE: v1 until `delay`; then, in every `pulse_period`, a rise to v2, `width` at v2, a fall back to v1.

    Voltages in V, times in s. A rise or fall of 0 is an ideal jump. Without `pulse_period` there is one pulse.
    """

    v1: float
    v2: float
    delay: float = 0.0
    rise: float = 0.0
    fall: float = 0.0
    width: float = math.inf
    pulse_period: float = math.inf
    units: ClassVar[dict[str, str]] = {
        "v1": "V", "v2": "V", "delay": "s", "rise": "s", "fall": "s", "width": "s", "pulse_period": "s"
    }  # fmt: skip
    _endless = ("width", "pulse_period")

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("rise", "fall", "width"):
            require(getattr(self, name) >= 0.0, f"pulse {name}", f"{getattr(self, name):g} s", ">= 0")
        require(self.pulse_period > 0.0, "pulse period", f"{self.pulse_period:g} s", "> 0")
        busy, longest = self.rise + self.width + self.fall, f"at most the period, {self.pulse_period:g} s"
        require(busy <= self.pulse_period * (1.0 + 1e-12), "pulse rise + width + fall", f"{busy:g} s", longest)
        even = abs(2.0 * (self.rise + self.width) - self.pulse_period) <= 4e-16 * self.pulse_period
        self._declare(
            period=self.pulse_period if math.isfinite(self.pulse_period) else None,
            settled=max(0.0, self.delay),
            half_wave=even and self.v1 == -self.v2 and self.rise == self.fall,
            _first=self.delay,
            _origin=self.delay,
        )

    @cached_property
    def knots(self) -> tuple[FloatArray, FloatArray]:
        start = 0.0 if self.period else self.delay
        up = start + self.rise
        if not math.isfinite(self.width):
            return np.array([start, up]), np.array([self.v1, self.v2])
        t = [start, up, up + self.width, up + self.width + self.fall]
        v = [self.v1, self.v2, self.v2, self.v1]
        if self.period and self.pulse_period > t[-1]:
            t.append(self.pulse_period)
            v.append(self.v1)
        return np.array(t), np.array(v)


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
        "amplitude": "V", "f0": "Hz", "f1": "Hz", "duration": "s", "offset": "V", "phase_deg": "deg"
    }  # fmt: skip

    def __post_init__(self) -> None:
        super().__post_init__()
        require(self.f0 > 0.0 and self.f1 > 0.0, "chirp frequencies", f"{self.f0:g}, {self.f1:g} Hz", "> 0")
        require(self.duration > 0.0, "chirp duration", f"{self.duration:g} s", "> 0")
        self._declare(_breaks=(0.0, self.duration), _quick=1.0 / max(self.f0, self.f1))

    def _phase(self, t: FloatArray) -> FloatArray:
        sweep = np.clip(t, 0.0, self.duration)
        turns = (self.f0 + 0.5 * (self.f1 - self.f0) / self.duration * sweep) * sweep
        turns = turns + self.f1 * np.maximum(t - self.duration, 0.0) + self.f0 * np.minimum(t, 0.0)
        return np.asarray(TAU * (turns - np.floor(turns)) + math.radians(self.phase_deg))

    def value(self, t: ArrayLike, side: str = "right") -> FloatArray:
        return np.asarray(self.offset + self.amplitude * np.sin(self._phase(real_numbers("t", t, "times in s"))))

    def terms(self, start: FloatArray, stop: FloatArray) -> FloatArray:
        rate = (self.f1 - self.f0) / self.duration
        middle = 0.5 * (start + stop)
        rises = np.where((middle >= 0.0) & (middle < self.duration), TAU * rate, 0.0)
        omega = TAU * (self.f0 + rate * np.clip(start, 0.0, self.duration))
        wave = self.amplitude, 0.0, 0.0, omega, self._phase(start) - 0.5 * math.pi, rises
        return terms_of(start.size, (self.offset,), wave)


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
    units: ClassVar[dict[str, str]] = {"v1": "V", "v2": "V", "td1": "s", "tau1": "s", "td2": "s", "tau2": "s"}

    def __post_init__(self) -> None:
        super().__post_init__()
        require(self.tau1 > 0.0 and self.tau2 > 0.0, "EXP time constants", f"{self.tau1:g}, {self.tau2:g} s", "> 0")
        require(self.td2 >= self.td1, "EXP td2", f"{self.td2:g} s", f">= td1 = {self.td1:g} s")
        breaks = tuple(sorted({self.td1, self.td2}))
        self._declare(course=(self.td1, math.inf), _breaks=breaks, _quick=min(self.tau1, self.tau2))

    def value(self, t: ArrayLike, side: str = "right") -> FloatArray:
        t = real_numbers("t", t, "times in s")
        rise = -np.expm1(-np.maximum(t - self.td1, 0.0) / self.tau1)
        fall = -np.expm1(-np.maximum(t - self.td2, 0.0) / self.tau2)
        return np.asarray(self.v1 + (self.v2 - self.v1) * (rise - fall))

    def terms(self, start: FloatArray, stop: FloatArray) -> FloatArray:
        step = self.v2 - self.v1
        first = 0.5 * (start + stop) >= self.td1
        second = 0.5 * (start + stop) >= self.td2
        level = self.v1 + step * (first.astype(float) - second.astype(float))
        rise = np.where(first, -step * np.exp(-np.maximum(start - self.td1, 0.0) / self.tau1), 0.0)
        fall = np.where(second, step * np.exp(-np.maximum(start - self.td2, 0.0) / self.tau2), 0.0)
        return terms_of(start.size, (level,), (rise, 0.0, -1.0 / self.tau1), (fall, 0.0, -1.0 / self.tau2))
