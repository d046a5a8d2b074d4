"""Source waveforms: values on either side of a jump, breakpoints, the fundamental, and terms for compiled code.

Between two breakpoints every library waveform is a short sum of terms

    c tau^n exp(a tau) cos(phi + omega tau + beta tau^2 / 2),     tau = time since the segment's start,

and sums and products of such sums are again of this form. A user's function has no such form, and is represented
by Chebyshev series instead: see `fingerspice.waveforms.sampling`.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from fingerspice.base.arrays import FloatArray, real_number, real_numbers
from fingerspice.base.errors import InputError

#: Largest and smallest absolute value allowed of a nonzero number, by unit (the entry V also serves A).
RANGES = {"V": (1e12, 0.0), "deg": (1e9, 0.0)}
#: The same limits for all other units.
ANY_RANGE = (1e30, 1e-30)
TAU = 2.0 * math.pi
# Places in [0, 1], both ends among them, one in each of 512 equal parts: so irregular that no carrier is 0 at all.
_SPREAD = np.append((np.arange(512) + np.modf(np.arange(512) * 0.6180339887498949)[0]) / 512.0, 1.0)
#: Distance of neighbouring doubles, relative to their size.
DOUBLE = 2.0**-52
_GAUSS_X, _GAUSS_W = np.polynomial.legendre.leggauss(24)


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

    Subclasses implement `value`, `breakpoints` and, where the waveform has that form, `terms`; periodic ones also
    `period` and, where the fundamental is not 1 / period, `tone`. Those of this package declare what follows from their
    numbers, under the names of the attributes below, when they are made.
    """

    units: ClassVar[dict[str, str]] = {}
    """Unit of each numeric field."""

    period: float | None = None
    """Period in s after any delay, or None."""

    precision: float = DOUBLE
    """Distance of neighbouring numbers of the kind that the values are computed in, relative to their size."""

    settled: float = 0.0
    """Time (s) from which the waveform is periodic."""

    course: tuple[float, float] = (-math.inf, math.inf)
    """Times (s) before the first and after the second of which the waveform is constant."""

    half_wave: bool = False
    """Whether each half period after `settled` is the negative of the half period before it."""

    # Times (s, ascending) at which the waveform is not smooth, and the shortest time scale (s) between them.
    _breaks: tuple[float, ...] = ()
    _quick: float = math.inf
    # Names of fields that may be infinite.
    _endless: ClassVar[tuple[str, ...]] = ()

    def __post_init__(self) -> None:
        """Make doubles of the fields that have a unit, and refuse what is no number of it."""
        for name in (field.name for field in fields(self) if field.name in self.units):  # type: ignore[arg-type]
            what, unit = f"{type(self).__name__} {name}", self.units[name]
            value = real_number(what, getattr(self, name), f"a number of {unit}" if unit else "a number")
            if not (math.isfinite(value) or (value == math.inf and name in self._endless)):
                raise InputError(f"{what} is {value}; allowed: a finite number")
            largest, smallest = RANGES.get(unit, ANY_RANGE)
            if value != 0.0 and not smallest <= abs(value) <= largest:
                check_range(what, value, unit)
            self._declare(**{name: value})

    def _declare(self, **facts: Any) -> None:
        self.__dict__.update(facts)

    def __getstate__(self) -> dict[str, Any]:
        """All but what is computed when it is first asked for."""
        found = {name: getattr(type(self), name, None) for name in vars(self)}
        return {name: value for name, value in vars(self).items() if not isinstance(found[name], cached_property)}

    @cached_property
    def kept(self) -> dict[Any, Any]:
        """Cache of results about this waveform, shared by all circuits that use it."""
        return {}

    def value(self, t: ArrayLike, side: str = "right") -> FloatArray:
        """Voltage (V) at times `t` (s); at a jump the limit from the right or from the left, as `side` says."""
        raise NotImplementedError

    def __call__(self, t: ArrayLike) -> FloatArray:
        """Voltage (V) at times `t` (s); at a jump the limit from the right."""
        return self.value(t)

    def breakpoints(self, t0: float, t1: float) -> FloatArray:
        """Times in [t0, t1] (s, ascending) at which the waveform is not smooth."""
        times = self._edges(t0, t1)
        return times[(times >= t0) & (times <= t1)]

    def _edges(self, t0: float, t1: float) -> FloatArray:
        """The breakpoints in [t0, t1] (s), and maybe others."""
        return np.array(self._breaks)

    def terms(self, start: FloatArray, stop: FloatArray) -> FloatArray | None:
        """Coefficients of the waveform's terms on segments that contain no breakpoint in their interior.

        Parameters
        ----------
        start, stop : ndarray, shape (m,)
            Ends of the segments, s.

        Returns
        -------
        ndarray, shape (m, k, 6), or None
            c, n, a, omega, phi and beta of each of k terms (see the module's text); None where the waveform has no
            such form.
        """
        return None

    def tone(self) -> float | None:
        """Frequency (Hz) of the fundamental, or None."""
        return 1.0 / self.period if self.period else None

    def shortest_time(self) -> float:
        """Shortest time scale (s) on which the waveform varies between breakpoints; inf for constants and ramps."""
        return self._quick

    def breakpoint_rate(self) -> float:
        """Upper bound of the number of breakpoints per second; it sets the windows into which long runs are divided."""
        return 0.0

    @cached_property
    def fundamental(self) -> Fundamental | None:
        """Fundamental of the periodic part, from the Fourier integral over one period; None where there is none."""
        frequency = self.tone()
        if frequency is None:
            return None
        start, stop = self.settled, self.settled + (self.period or 1.0 / frequency)
        inner = self.breakpoints(start, stop)
        edges = np.unique(np.concatenate([[start], inner[(inner > start) & (inner < stop)], [stop]]))
        panel = min(0.5 / frequency, self.shortest_time())
        total = 0j
        for a, b in itertools.pairwise(edges):
            # Gauss-Legendre quadrature of U(t) exp(-i Omega t) on panels between breakpoints.
            cuts = np.linspace(a, b, max(1, math.ceil((b - a) / panel)) + 1)
            half = 0.5 * np.diff(cuts)[:, None]
            t = 0.5 * (cuts[1:] + cuts[:-1])[:, None] + half * _GAUSS_X
            total += complex(np.sum(half * _GAUSS_W * self.value(t) * np.exp(-1j * TAU * frequency * t)))
        # The phase refers to a sine: U ~ Im(P exp(i Omega t)).
        p = 2j * total / (self.period or 1.0 / frequency)
        if abs(p) <= 1e-12 * self.peak(start, stop):
            return None
        return Fundamental(frequency, abs(p), math.atan2(p.imag, p.real))

    def peak(self, t0: float, t1: float) -> float:
        """Largest ``|U|`` (V) over [t0, t1]; exact at breakpoints, within a percent elsewhere."""
        if self.period is not None:
            # All periods after `settled` are equal, so that the first of them gives the peak of all.
            t1 = min(t1, max(t0, self.settled) + self.period)
        t = t0 + (t1 - t0) * _SPREAD
        size = np.abs(self.value(t))
        quick = self.shortest_time()
        if quick < (t1 - t0) / 64.0:
            # A carrier is sampled too coarsely: its amplitude follows from values a quarter of a cycle apart. Look at
            # whole cycles where that is largest.
            amplitude = np.hypot(size, self.value(np.minimum(t + 0.25 * quick, t1)))
            about = t[np.argsort(amplitude)[-8:], None] + quick * np.linspace(-0.5, 0.5, 65)
            size = np.append(size, np.abs(self.value(np.clip(about, t0, t1))))
        breakpoints = self.breakpoints(t0, t1)
        values = [size, *(np.abs(self.value(breakpoints, side)) for side in ("right", "left") if breakpoints.size)]
        return float(np.concatenate(values).max())

    def cancelling(self, t0: float, t1: float) -> float:
        """Sum of the peaks (V) over [t0, t1] of parts that may cancel in U; 0 for a waveform of one part.

        Rounding errors of U are relative to this sum.
        """
        return 0.0

    def __add__(self, other: Waveform | float) -> Waveform:
        return _combined("Sum", self, other)

    def __radd__(self, other: float) -> Waveform:
        return _combined("Sum", other, self)

    def __mul__(self, other: Waveform | float) -> Waveform:
        return _combined("Product", self, other)

    def __rmul__(self, other: float) -> Waveform:
        return _combined("Product", other, self)

    def __neg__(self) -> Waveform:
        return -1.0 * self

    def __sub__(self, other: Waveform | float) -> Waveform:
        return self + -as_waveform(other)

    def __rsub__(self, other: float) -> Waveform:
        return other + -self


def _combined(kind: str, first: Waveform | float, second: Waveform | float) -> Waveform:
    # Imported here because `combinations` imports this module.
    from fingerspice.waveforms import combinations

    combination: Waveform = getattr(combinations, kind)((as_waveform(first), as_waveform(second)))
    return combination


def as_waveform(value: Waveform | float | Callable[[float], float]) -> Waveform:
    """A waveform from a waveform, a number (a constant voltage) or a function of time; anything else is refused."""
    if isinstance(value, Waveform):
        return value
    if callable(value):
        from fingerspice.waveforms.sampling import Function

        return Function(value)
    allowed = "a waveform, a number or a function of time; values at a rate are fs.Samples(values, rate)"
    return DC(real_number("a source", value, allowed))


def check_range(what: str, values: ArrayLike, unit: str) -> None:
    """Refuse finite numbers so large or so small that their products and quotients would overflow or underflow."""
    largest, smallest = RANGES.get(unit, ANY_RANGE)
    size = np.abs(values)
    bad = np.flatnonzero(np.isfinite(size) & (((size < smallest) & (size > 0.0)) | (size > largest)))
    if bad.size:
        given = float(np.ravel(values)[bad[0]])
        allowed = f"0, or a size from {smallest:g} to {largest:g}" if smallest else f"a size up to {largest:g}"
        raise InputError(f"{what} is {given:g} {unit}".rstrip() + f"; allowed: {allowed}")


def require(condition: bool, what: str, given: Any, allowed: str) -> None:
    """Refuse an argument that does not meet a condition: the message names the given value and the allowed ones."""
    if not condition:
        raise InputError(f"{what} is {given}; allowed: {allowed}")


def terms_of(m: int, *terms: tuple[FloatArray | float, ...]) -> FloatArray:
    """Terms (m, k, 6) of m segments from the first coefficients of each of k terms: numbers, or one a segment."""
    out = np.zeros((m, len(terms), 6))
    for k, coefficients in enumerate(terms):
        for i, coefficient in enumerate(coefficients):
            out[:, k, i] = coefficient
    return out


@dataclass(frozen=True)
class DC(Waveform):
    """A constant voltage, V."""

    level: float = 0.0
    units: ClassVar[dict[str, str]] = {"level": "V"}
    course = math.inf, -math.inf

    def value(self, t: ArrayLike, side: str = "right") -> FloatArray:
        return np.full(real_numbers("t", t, "times in s").shape, self.level)

    def terms(self, start: FloatArray, stop: FloatArray) -> FloatArray:
        return terms_of(start.size, (self.level,))


@dataclass(frozen=True)
class Sine(Waveform):
    """offset + amplitude exp(-damping (t - delay)) sin(2 pi f (t - delay) + phase), constant before the delay.

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
        "amplitude": "V", "frequency": "Hz", "offset": "V", "phase_deg": "deg", "delay": "s", "damping": "1/s"
    }  # fmt: skip

    def __post_init__(self) -> None:
        super().__post_init__()
        require(self.frequency > 0.0, "sine frequency", f"{self.frequency:g} Hz", "> 0")
        self._declare(
            period=1.0 / self.frequency if self.damping == 0.0 else None,
            settled=max(0.0, self.delay),
            course=(self.delay, math.inf),
            half_wave=self.offset == 0.0 and self.damping == 0.0,
            _breaks=(self.delay,) if self.delay > 0.0 else (),
            _quick=1.0 / self.frequency,
        )

    def peak(self, t0: float, t1: float) -> float:
        if self.damping or t1 - max(t0, self.delay) < (1.0 - 1e-9) / self.frequency:
            return super().peak(t0, t1)
        return abs(self.offset) + abs(self.amplitude)

    def _turns(self, t: FloatArray) -> FloatArray:
        turns = np.asarray(self.frequency * (t - self.delay))
        return turns - np.floor(turns)

    def value(self, t: ArrayLike, side: str = "right") -> FloatArray:
        since = np.maximum(real_numbers("t", t, "times in s"), self.delay)
        wave = np.sin(TAU * self._turns(since) + math.radians(self.phase_deg))
        if self.damping:
            wave = wave * np.exp(-self.damping * (since - self.delay))
        return np.asarray(self.offset + self.amplitude * wave)

    def terms(self, start: FloatArray, stop: FloatArray) -> FloatArray:
        on = 0.5 * (start + stop) >= self.delay if self.delay > 0.0 else np.ones(start.size, bool)
        phase = math.radians(self.phase_deg)
        level = np.where(on, self.offset, self.offset + self.amplitude * math.sin(phase))
        decay = np.exp(-self.damping * np.maximum(start - self.delay, 0.0))
        # Terms are cosines: sin(x) = cos(x - pi/2).
        angle = TAU * self._turns(start) + phase - 0.5 * math.pi
        wave = np.where(on, self.amplitude * decay, 0.0), 0.0, -self.damping, TAU * self.frequency, angle
        return terms_of(start.size, (level,), wave)

    @property
    def fundamental(self) -> Fundamental | None:
        if self.period is None or self.amplitude == 0.0:
            return None
        phase = math.radians(self.phase_deg) - TAU * self.frequency * self.delay
        phase += math.pi if self.amplitude < 0.0 else 0.0
        return Fundamental(self.frequency, abs(self.amplitude), math.remainder(phase, TAU))
