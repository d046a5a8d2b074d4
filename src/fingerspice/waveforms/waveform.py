"""Waveforms: values on either side of a jump, breakpoints, the fundamental, terms for compiled code; sums, products.

Between two breakpoints every library waveform is a short sum of terms

    c tau^n exp(a tau) cos(phi + omega tau + beta tau^2 / 2),     tau = time since the segment's start,

and sums and products of such sums are again of this form. A user's function has no such form, and is represented
by Chebyshev series instead: see `fingerspice.waveforms.sampling`.
"""

from __future__ import annotations

import inspect
import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property, reduce
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from fingerspice.base.arrays import FloatArray, Remembering, real_number, real_numbers
from fingerspice.base.errors import InputError, Where
from fingerspice.base.units import UNITS, Degree, Hertz, PerSecond, Ratio, Second, Volt

RANGES = {"V": (1e12, 0.0), "deg": (1e9, 0.0)}  #: Largest and smallest size of a number other than 0; V serves A, too.
ANY_RANGE = (1e30, 1e-30)  #: The same limits for all other units.
TAU = 2.0 * math.pi
# Places in [0, 1], both ends among them, one in each of 512 equal parts: so irregular that no carrier is 0 at all.
_SPREAD = np.append((np.arange(512) + np.modf(np.arange(512) * 0.6180339887498949)[0]) / 512.0, 1.0)
DOUBLE = 2.0**-52  #: Distance of neighbouring doubles, relative to their size.
_GAUSS_X, _GAUSS_W = np.polynomial.legendre.leggauss(24)
#: Most cycles of a part in a common period, and the largest relative rounding error of a ratio of two periods.
MOST_CYCLES, _ROUNDING = 10**6, 2e-15


@dataclass(frozen=True)
class Fundamental:
    """Fundamental amplitude sin(2 pi frequency t + phase) of a waveform."""

    frequency: float  # Hz
    amplitude: float  # V, not negative
    phase: float  # rad


class Waveform(Remembering):
    """A voltage against time, defined for all times.

    Subclasses implement `value`, `breakpoints` and, where the waveform has that form, `terms`; periodic ones also
    `period` and, where the fundamental is not 1 / period, `tone`. Those of this package declare what follows from their
    numbers, under the names of the attributes below, when they are made.
    """

    units: ClassVar[dict[str, str]] = {}  #: Unit of each numeric field, from its type
    period: float | None = None  #: Period in s after any delay, or None
    settled: float = 0.0  #: Time (s) from which the waveform is periodic
    precision: float = DOUBLE  #: Distance of neighbouring numbers of the kind that the values are computed in
    course: tuple[float, float] = (-math.inf, math.inf)  #: Before and after these times (s) it is constant
    is_sampled: bool = False  #: Whether it has no terms and is therefore represented by Chebyshev series
    half_wave: bool = False  #: Whether each half period after `settled` is the negative of the half period before it
    _breaks: tuple[float, ...] = ()  # Times (s, ascending) at which the waveform is not smooth
    _quick: float = math.inf  # Shortest time scale (s) between them
    _endless: ClassVar[tuple[str, ...]] = ()  # Names of fields that may be infinite.

    def __init_subclass__(cls) -> None:
        cls.units = cls.units | {x: UNITS[kind] for x, kind in inspect.get_annotations(cls).items() if kind in UNITS}
        cls.is_sampled = cls.terms is Waveform.terms

    def __post_init__(self) -> None:
        """Make doubles of the fields that have a unit, and refuse what is no number of it."""
        for name, unit in self.units.items():
            value, (largest, smallest) = getattr(self, name), RANGES.get(unit, ANY_RANGE)
            if type(value) is float and (value == 0.0 or smallest <= abs(value) <= largest):
                continue
            what = f"{type(self).__name__} {name}"
            value = real_number(what, value, f"a number of {unit}" if unit else "a number")
            fine = math.isfinite(value) or (value == math.inf and name in self._endless)
            require(fine, what, value, "a finite number")
            if value != 0.0 and not smallest <= abs(value) <= largest:
                check_range(what, value, unit)
            self._declare(**{name: value})

    def _declare(self, **facts: Any) -> None:
        self.__dict__.update(facts)

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

    def shortest_time(self, start: float = -math.inf, stop: float = math.inf) -> float:
        """Shortest time scale (s) of the waveform between breakpoints of an interval; inf for constants and ramps."""
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
        length = self.period or 1.0 / frequency
        start, stop = self.settled, self.settled + length
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
        p = 2j * total / length  # The phase refers to a sine: U ~ Im(P exp(i Omega t)).
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
        if quick < (t1 - t0) / 4.0:
            # A carrier is sampled too coarsely: its amplitude follows from values a quarter of a cycle apart. Look at
            # whole cycles where that is largest.
            amplitude = np.hypot(size, self.value(np.minimum(t + 0.25 * quick, t1)))
            about = t[np.argsort(amplitude)[-8:], None] + quick * np.linspace(-0.5, 0.5, 65)
            size = np.append(size, np.abs(self.value(np.clip(about, t0, t1))))
        breakpoints = self.breakpoints(t0, t1)
        at_breakpoints = [np.abs(self.value(breakpoints, side)).max(initial=0.0) for side in ("right", "left")]
        return float(np.max([size.max(), *at_breakpoints]))

    def cancelling(self, t0: float, t1: float) -> float:
        """Sum of the peaks (V) over [t0, t1] of parts that may cancel in U, for rounding errors; 0 of one part."""
        return 0.0

    def __add__(self, other: Waveform | float) -> Waveform:
        return Sum((self, as_waveform(other)))

    def __radd__(self, other: float) -> Waveform:
        return Sum((as_waveform(other), self))

    def __mul__(self, other: Waveform | float) -> Waveform:
        return Product((self, as_waveform(other)))

    def __rmul__(self, other: float) -> Waveform:
        return Product((as_waveform(other), self))

    def __neg__(self) -> Waveform:
        return -1.0 * self

    def __sub__(self, other: Waveform | float) -> Waveform:
        return self + -as_waveform(other)

    def __rsub__(self, other: float) -> Waveform:
        return other + -self


def as_waveform(value: Waveform | float | Callable[[float], float]) -> Waveform:
    """A waveform from a waveform, a number (a constant voltage) or a function of time; anything else is refused."""
    if isinstance(value, Waveform):
        return value
    if callable(value):
        from fingerspice.waveforms.sampling import Function

        return Function(value)
    allowed = "a waveform, a number or a function of time; values at a rate are fs.Samples(values, rate)"
    return DC(real_number("a source", value, allowed))


def check_range(what: str, values: ArrayLike, unit: str, where: Where | None = None) -> None:
    """Refuse finite numbers so large or so small that their products and quotients would overflow or underflow."""
    largest, smallest = RANGES.get(unit, ANY_RANGE)
    size = np.abs(values)
    bad = np.flatnonzero(np.isfinite(size) & (((size < smallest) & (size > 0.0)) | (size > largest)))
    if bad.size:
        given = float(np.ravel(values)[bad[0]])
        allowed = f"0, or a size from {smallest:g} to {largest:g}" if smallest else f"a size up to {largest:g}"
        raise InputError(f"{what} is {given:g} {unit}".rstrip() + f"; allowed: {allowed}", where)


def require(condition: bool, what: str, given: Any, allowed: str) -> None:
    """Refuse an argument that does not meet a condition: the message names the given value and the allowed ones."""
    if not condition:
        raise InputError(f"{what} is {given}; allowed: {allowed}")


def refuse(wrong: object, problem: str, place: Any = None) -> None:
    """Refuse what is wrong, at its place in a netlist: a `Where`, or what has one."""
    if wrong:
        raise InputError(problem, getattr(place, "where", place))


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

    level: Volt = 0.0
    course = math.inf, -math.inf

    def value(self, t: ArrayLike, side: str = "right") -> FloatArray:
        return np.full(real_numbers("t", t, "times in s").shape, self.level)

    def terms(self, start: FloatArray, stop: FloatArray) -> FloatArray:
        return terms_of(start.size, (self.level,))


OFF = DC(0.0)  #: A source that is switched off, or that only serves to measure a current


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

    amplitude: Volt
    frequency: Hertz
    offset: Volt = 0.0
    phase_deg: Degree = 0.0
    delay: Second = 0.0
    damping: PerSecond = 0.0

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
        angle = TAU * self._turns(start) + phase - 0.5 * math.pi  # Terms are cosines: sin(x) = cos(x - pi/2).
        wave = np.where(on, self.amplitude * decay, 0.0), 0.0, -self.damping, TAU * self.frequency, angle
        return terms_of(start.size, (level,), wave)

    @property
    def fundamental(self) -> Fundamental | None:
        if self.period is None or self.amplitude == 0.0:
            return None
        phase = math.radians(self.phase_deg) - TAU * self.frequency * self.delay
        phase += math.pi if self.amplitude < 0.0 else 0.0
        return Fundamental(self.frequency, abs(self.amplitude), math.remainder(phase, TAU))


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

    amplitude: Volt
    f0: Hertz
    f1: Hertz
    duration: Second
    offset: Volt = 0.0
    phase_deg: Degree = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        require(self.f0 > 0.0 and self.f1 > 0.0, "chirp frequencies", f"{self.f0:g}, {self.f1:g} Hz", "> 0")
        require(self.duration > 0.0, "chirp duration", f"{self.duration:g} s", "> 0")
        self._declare(_breaks=(0.0, self.duration))

    def shortest_time(self, start: float = -math.inf, stop: float = math.inf) -> float:
        ends = (min(max(t / self.duration, 0.0), 1.0) for t in (start, stop))
        return 1.0 / max(self.f0 + (self.f1 - self.f0) * part for part in ends)

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

    v1: Volt
    v2: Volt
    td1: Second
    tau1: Second
    td2: Second
    tau2: Second

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


class _Combination(Waveform):
    """A sum or product of parts."""

    parts: tuple[Waveform, ...]
    _joined: ClassVar[Callable[..., Any]]  # Sum or product of numbers or arrays
    _joined_terms: ClassVar[Callable[..., Any]]  # Terms (m, k, 6) of the sum or product of two parts, from theirs

    def __post_init__(self) -> None:
        super().__post_init__()
        settled = max(part.settled for part in self.parts)
        first, last = zip(*(part.course for part in self.parts), strict=True)
        course, sampled = (min(first), max(last)), any(part.is_sampled for part in self.parts)
        self._declare(period=_common_period(self.parts), settled=settled, course=course, is_sampled=sampled)

    def shortest_time(self, start: float = -math.inf, stop: float = math.inf) -> float:
        rate = sum(1.0 / part.shortest_time(start, stop) for part in self.parts)
        return 1.0 / rate if rate else math.inf

    def value(self, t: ArrayLike, side: str = "right") -> FloatArray:
        return np.asarray(self._joined(part.value(t, side) for part in self.parts))

    def cancelling(self, t0: float, t1: float) -> float:
        return float(self._joined(max(part.peak(t0, t1), part.cancelling(t0, t1)) for part in self.parts))

    def terms(self, start: FloatArray, stop: FloatArray) -> FloatArray | None:
        blocks = [part.terms(start, stop) for part in self.parts]
        return None if any(block is None for block in blocks) else reduce(self._joined_terms, blocks)

    def breakpoints(self, t0: float, t1: float) -> FloatArray:
        return np.unique(np.concatenate([part.breakpoints(t0, t1) for part in self.parts]))

    def breakpoint_rate(self) -> float:
        return sum(part.breakpoint_rate() for part in self.parts)

    @property
    def precision(self) -> float:  # type: ignore[override]
        return max(part.precision for part in self.parts)

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

    amplitude: Volt
    carrier: Hertz
    modulation: Hertz
    depth: Ratio = 1.0
    phase_deg: Degree = 0.0

    def __post_init__(self) -> None:
        Waveform.__post_init__(self)
        require(0.0 <= self.depth <= 1.0, "AM depth", f"{self.depth:g}", "0 to 1")
        super().__post_init__()

    @cached_property
    def parts(self) -> tuple[Waveform, ...]:  # type: ignore[override]
        share = self.amplitude / (1.0 + self.depth)
        envelope = Sine(share * self.depth, self.modulation, offset=share, phase_deg=self.phase_deg)
        return (envelope, Sine(1.0, self.carrier))
