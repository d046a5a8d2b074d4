"""Source waveforms: value on either side of a jump, breakpoints, fundamental, and their form for compiled code.

Between two breakpoints every library waveform is a short sum of terms

    c tau^n exp(a tau) cos(phi + omega tau + beta tau^2 / 2),     tau = time since the segment's start,

a form closed under sums and products. A waveform without such a form (a user's function) is represented by
Chebyshev series instead: see `fingerspice.waveforms.sampling`.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from fingerspice.base.arrays import FloatArray
from fingerspice.base.errors import InputError
from fingerspice.waveforms.bounds import check_finite

TAU = 2.0 * math.pi


@dataclass(frozen=True)
class Fundamental:
    """Fundamental U_0 sin(2 pi f t + phase) of a waveform.

    Attributes
    ----------
    frequency : float
        Hz.
    amplitude : float
        V, not negative.
    phase : float
        rad.
    """

    frequency: float
    amplitude: float
    phase: float


class Waveform:
    """A voltage against time, defined for all times.

    Subclasses give `value`, `breakpoints` and, where it exists, `terms`; and `period`, `tone` where they apply.
    """

    units: ClassVar[dict[str, str]] = {}
    """Unit of each numeric field."""

    period: float | None = None
    """Period in s after any delay, or None."""

    def value(self, t: ArrayLike, side: str = "right") -> FloatArray:
        """Voltage (V) at times `t` (s); at a jump the limit from the `side` 'right' or 'left'."""
        raise NotImplementedError

    def __call__(self, t: ArrayLike) -> FloatArray:
        """Voltage (V) at times `t` (s), right-hand at jumps."""
        return self.value(t)

    def breakpoints(self, t0: float, t1: float) -> FloatArray:
        """Times in [t0, t1] (s, ascending) at which the waveform is not smooth."""
        return np.empty(0)

    def terms(self, start: FloatArray, stop: FloatArray) -> FloatArray | None:
        """Terms (m, k, 6) on segments free of breakpoints inside; None where the waveform has no such form."""
        return None

    def tone(self) -> float | None:
        """Frequency (Hz) of the fundamental, or None."""
        return 1.0 / self.period if self.period else None

    def shortest_time(self) -> float:
        """Shortest time scale (s) on which a smooth piece varies, inf for constants and ramps."""
        return math.inf

    def breakpoint_rate(self) -> float:
        """Breakpoints per second, an upper estimate that sizes the windows of a long run."""
        return 0.0

    @property
    def settled(self) -> float:
        """Time (s) from which the waveform is periodic."""
        return 0.0

    @property
    def half_wave(self) -> bool:
        """Whether, once settled, every half period is the one before with its sign turned."""
        return False

    @property
    def fundamental(self) -> Fundamental | None:
        """Fundamental of the periodic part, where there is one: the Fourier integral over its period."""
        frequency = self.tone()
        if frequency is None:
            return None
        period = self.period or 1.0 / frequency
        # Sine convention: U ~ Im(P exp(i Omega t)).
        start = self.settled
        p = 2j * fourier_integral(self, frequency, start, start + period) / period
        if abs(p) <= 1e-12 * self.peak(start, start + period):
            return None
        return Fundamental(frequency, abs(p), math.atan2(p.imag, p.real))

    def peak(self, t0: float, t1: float) -> float:
        """Largest |U| (V) over [t0, t1], to a few parts in a thousand where it is not at a breakpoint."""
        if self.period is not None:
            # Later periods are alike.
            t1 = min(t1, max(t0, self.settled) + self.period)
        values = [self.value(np.linspace(t0, t1, 513))]
        breakpoints = self.breakpoints(t0, t1)
        if breakpoints.size:
            values += [self.value(breakpoints), self.value(breakpoints, "left")]
        return float(np.abs(np.concatenate(values)).max())

    def __add__(self, other: Waveform | float) -> Waveform:
        return _combined("Sum", self, other)

    def __radd__(self, other: float) -> Waveform:
        return _combined("Sum", other, self)

    def __mul__(self, other: Waveform | float) -> Waveform:
        return _combined("Product", self, other)

    def __rmul__(self, other: float) -> Waveform:
        return _combined("Product", other, self)


def _combined(kind: str, first: Waveform | float, second: Waveform | float) -> Waveform:
    # The classes of combinations build on this module.
    from fingerspice.waveforms import combinations

    combination: Waveform = getattr(combinations, kind)((as_waveform(first), as_waveform(second)))
    return combination


def as_waveform(value: Waveform | float | Callable[[float], float]) -> Waveform:
    """A waveform from itself, a number (constant voltage) or a plain function of time.

    Raises
    ------
    InputError
        For anything else.
    """
    if isinstance(value, Waveform):
        return value
    if isinstance(value, (int, float, np.floating, np.integer)):
        return DC(float(value))
    if callable(value):
        from fingerspice.waveforms.sampling import Function

        return Function(value)
    kind = type(value).__name__
    if isinstance(value, (np.ndarray, list, tuple)):
        kind += "; values at a rate are fs.Samples(values, rate)"
    raise InputError(f"a source must be a waveform, a number or a function of time, got {kind}")


def require(condition: bool, what: str, given: Any, allowed: str) -> None:
    """Raise the one sentence of a bad waveform argument."""
    if not condition:
        raise InputError(f"{what} is {given}; allowed: {allowed}")


_GAUSS_X, _GAUSS_W = np.polynomial.legendre.leggauss(24)


def fourier_integral(waveform: Waveform, frequency: float, t0: float, t1: float) -> complex:
    """Integral of U(t) exp(-i 2 pi f t) over [t0, t1], by Gauss-Legendre panels between breakpoints."""
    inner = waveform.breakpoints(t0, t1)
    edges = np.unique(np.concatenate([[t0], inner[(inner > t0) & (inner < t1)], [t1]]))
    panel = min(0.5 / frequency, waveform.shortest_time())
    total = 0j
    for a, b in itertools.pairwise(edges):
        cuts = np.linspace(a, b, max(1, math.ceil((b - a) / panel)) + 1)
        half = 0.5 * np.diff(cuts)[:, None]
        t = 0.5 * (cuts[1:] + cuts[:-1])[:, None] + half * _GAUSS_X
        total += complex(np.sum(half * _GAUSS_W * waveform.value(t) * np.exp(-1j * TAU * frequency * t)))
    return total


def blank_terms(m: int, k: int) -> FloatArray:
    """Terms (m, k, 6), all zero."""
    return np.zeros((m, k, 6))


@dataclass(frozen=True)
class DC(Waveform):
    """A constant voltage, V."""

    level: float = 0.0
    units: ClassVar[dict[str, str]] = {"level": "V"}

    def __post_init__(self) -> None:
        check_finite(self)

    def value(self, t: ArrayLike, side: str = "right") -> FloatArray:
        return np.full(np.shape(t), self.level)

    def terms(self, start: FloatArray, stop: FloatArray) -> FloatArray:
        out = blank_terms(start.size, 1)
        out[:, 0, 0] = self.level
        return out


@dataclass(frozen=True)
class Sine(Waveform):
    """offset + amplitude exp(-damping (t - delay)) sin(2 pi f (t - delay) + phase); held before the delay.

    Parameters
    ----------
    amplitude : float
        V.
    frequency : float
        Hz, positive.
    offset : float
        V.
    phase_deg : float
        Degrees.
    delay : float
        s; before it the value is offset + amplitude sin(phase), as in SPICE.
    damping : float
        1/s, SPICE's THETA.
    """

    amplitude: float
    frequency: float
    offset: float = 0.0
    phase_deg: float = 0.0
    delay: float = 0.0
    damping: float = 0.0
    units: ClassVar[dict[str, str]] = {
        "amplitude": "V",
        "frequency": "Hz",
        "offset": "V",
        "phase_deg": "deg",
        "delay": "s",
        "damping": "1/s",
    }

    def __post_init__(self) -> None:
        check_finite(self)
        require(self.frequency > 0.0, "sine frequency", f"{self.frequency:g} Hz", "> 0")

    @property
    def period(self) -> float | None:  # type: ignore[override]
        return 1.0 / self.frequency if self.damping == 0.0 else None

    @property
    def settled(self) -> float:
        return max(0.0, self.delay)

    @property
    def half_wave(self) -> bool:
        return self.offset == 0.0 and self.damping == 0.0

    def _turns(self, t: FloatArray) -> FloatArray:
        turns = np.asarray(self.frequency * (t - self.delay))
        return turns - np.floor(turns)

    def value(self, t: ArrayLike, side: str = "right") -> FloatArray:
        since = np.maximum(np.asarray(t, float), self.delay)
        wave = np.sin(TAU * self._turns(since) + math.radians(self.phase_deg))
        if self.damping:
            wave = wave * np.exp(-self.damping * (since - self.delay))
        return np.asarray(self.offset + self.amplitude * wave)

    def breakpoints(self, t0: float, t1: float) -> FloatArray:
        return np.array([self.delay]) if t0 <= self.delay <= t1 and self.delay > 0.0 else np.empty(0)

    def terms(self, start: FloatArray, stop: FloatArray) -> FloatArray:
        out = blank_terms(start.size, 2)
        on = 0.5 * (start + stop) >= self.delay if self.delay > 0.0 else np.ones(start.size, bool)
        phase = math.radians(self.phase_deg)
        out[:, 0, 0] = np.where(on, self.offset, self.offset + self.amplitude * math.sin(phase))
        decay = np.exp(-self.damping * np.maximum(start - self.delay, 0.0))
        out[:, 1, 0] = np.where(on, self.amplitude * decay, 0.0)
        out[:, 1, 2] = -self.damping
        out[:, 1, 3] = TAU * self.frequency
        # A phase of exactly zero is how compiled code knows a term without a cosine: -pi/2 is not zero.
        out[:, 1, 4] = TAU * self._turns(start) + phase - 0.5 * math.pi
        return out

    def shortest_time(self) -> float:
        return 1.0 / self.frequency

    @property
    def fundamental(self) -> Fundamental | None:
        if self.period is None or self.amplitude == 0.0:
            return None
        phase = math.radians(self.phase_deg) - TAU * self.frequency * self.delay
        phase += math.pi if self.amplitude < 0.0 else 0.0
        return Fundamental(self.frequency, abs(self.amplitude), math.remainder(phase, TAU))


@dataclass(frozen=True)
class Chirp(Waveform):
    """amplitude sin(phi(t)) + offset, its frequency rising linearly from f0 to f1 over `duration`, then staying.

    Parameters
    ----------
    amplitude : float
        V.
    f0, f1 : float
        Hz, positive; at the start and from `duration` (s) on.
    offset : float
        V.
    phase_deg : float
        Degrees, at the start.
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
        check_finite(self)
        require(self.f0 > 0.0 and self.f1 > 0.0, "chirp frequencies", f"{self.f0:g}, {self.f1:g} Hz", "> 0")
        require(self.duration > 0.0, "chirp duration", f"{self.duration:g} s", "> 0")

    def _phase(self, t: FloatArray) -> FloatArray:
        sweep = np.clip(t, 0.0, self.duration)
        turns = (self.f0 + 0.5 * (self.f1 - self.f0) / self.duration * sweep) * sweep
        turns = turns + self.f1 * np.maximum(t - self.duration, 0.0) + self.f0 * np.minimum(t, 0.0)
        return np.asarray(TAU * (turns - np.floor(turns)) + math.radians(self.phase_deg))

    def value(self, t: ArrayLike, side: str = "right") -> FloatArray:
        return np.asarray(self.offset + self.amplitude * np.sin(self._phase(np.asarray(t, float))))

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
    """SPICE's EXP: rises from v1 towards v2 from `td1` with time constant `tau1`, back from `td2` with `tau2`.

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
        check_finite(self)
        require(
            self.tau1 > 0.0 and self.tau2 > 0.0,
            "EXP time constants",
            f"{self.tau1:g}, {self.tau2:g} s",
            "> 0",
        )
        require(self.td2 >= self.td1, "EXP td2", f"{self.td2:g} s", f">= td1 = {self.td1:g} s")

    def value(self, t: ArrayLike, side: str = "right") -> FloatArray:
        t = np.asarray(t, float)
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
