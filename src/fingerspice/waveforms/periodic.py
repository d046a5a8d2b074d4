"""Waveforms of straight pieces: PWL, square, triangle, sawtooth, pulses; and stretches that are used once or repeated.

The base class of straight pieces is `Ramps`, of which a subclass only lists its knots.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fingerspice.base.arrays import FloatArray, real_number, real_numbers
from fingerspice.base.errors import InputError
from fingerspice.base.units import Degree, Hertz, Ratio, Second, Volt
from fingerspice.waveforms.files import read_table
from fingerspice.waveforms.waveform import Waveform, as_waveform, check_range, require, terms_of

FEW_KNOTS = 1000  # With so many knots or less a waveform is not divided into windows, however close they are.
MOST_SHOWN = 10_000  # Most points that the text of a PWL shows.
MOST_LISTED = 20_000_000  #: Breakpoints listed at once; each takes about 40 bytes, with the arrays computed from it.
_WINDOW = 1_000_000  #: Breakpoints in a window of time; the values at all times in one are looked up together.


def runs_through(
    period: float, count: int, t0: float, t1: float, first: float = 0.0, least: float = -math.inf
) -> FloatArray:  # fmt: skip
    """Numbers (n, 1) of the periods from `first` (s) on that touch t0 to t1 (s), and of one more on either side.

    None is below `least`. Too many breakpoints, of which each period has `count`, are refused.
    """
    low = max(least, np.floor((t0 - first) / period) - 1.0)
    high = max(low, np.ceil((t1 - first) / period) + 1.0)
    total = (high - low + 1.0) * count
    if not total <= MOST_LISTED:
        problem = f"the source has {total:.3g} breakpoints from {t0:g} s to {t1:g} s"
        raise InputError(f"{problem}; allowed: at most {MOST_LISTED:.0e} at once: a shorter run, or a longer period")
    return np.arange(low, high + 1.0)[:, None]


def in_windows(t: FloatArray, rate: float) -> Iterator[slice | NDArray[np.intp]]:
    """Indices of times (s) by windows of `_WINDOW` breakpoints, so that ten values in a year of squares list few."""
    if t.size == 0:
        return
    window = np.floor(t * (rate / _WINDOW))
    if window.min() == window.max():
        yield slice(None)
        return
    order = np.argsort(window, kind="stable")
    yield from np.split(order, np.flatnonzero(np.diff(window[order])) + 1)


class Ramps(Waveform):
    """Straight lines between knots (t, v), constant outside them or repeated; two knots at one time are a jump.

    Subclasses have `knots`. The knots of a periodic one from the time `_first` on span one period and are repeated for
    ever; earlier knots occur once.
    """

    _first: float = 0.0  # Time (s) from which the waveform is periodic
    _origin: float = 0.0  # Time (s) from which the times of its knots are counted

    @cached_property
    def knots(self) -> tuple[FloatArray, FloatArray]:
        """Times (s, ascending) and values (V) of the knots, shape (n,) each."""
        raise NotImplementedError

    @cached_property
    def _distinct(self) -> FloatArray:
        """Times of the knots, each once, s."""
        return _once(self.knots[0])

    def _times(self, t0: float, t1: float) -> FloatArray:
        """Times of a periodic waveform's knots (s) over [t0, t1] and a period beyond; jumps appear twice."""
        assert self.period is not None
        times = self.knots[0]
        body = times[times >= self._first - self._origin]
        starts = self._origin + runs_through(self.period, body.size, t0, t1, self._first, least=1.0) * self.period
        return np.concatenate([self._origin + times, (starts + body).ravel()])

    def _edges(self, t0: float, t1: float) -> FloatArray:
        if self.period is None:
            return self._distinct[self._distinct.searchsorted(t0) : self._distinct.searchsorted(t1, "right")]
        return _once(self._times(t0, t1))

    @property
    def course(self) -> tuple[float, float]:  # type: ignore[override]
        times, values = self.knots
        changes = np.flatnonzero(np.diff(values))
        if changes.size == 0:
            return math.inf, -math.inf
        first = self._origin + float(times[changes[0]]) if self.period else float(times[changes[0]])
        return first, math.inf if self.period else float(times[changes[-1] + 1])

    def value(self, t: ArrayLike, side: str = "right") -> FloatArray:
        t = real_numbers("t", t, "times in s")
        flat = t.ravel()
        out = np.empty(flat.size)
        for window in in_windows(flat, self.breakpoint_rate()):
            out[window] = self._values(flat[window], side)
        return out.reshape(t.shape)

    def _values(self, flat: FloatArray, side: str) -> FloatArray:
        """As `value`, at times (n_t,) within one window."""
        times, values = self.knots
        if self.period is not None:
            edges = self._edges(flat.min(), flat.max())
            # Any time before the first edge, for what comes before it, and any time behind the last one.
            far = 1.0 + 2.0 * np.abs(edges[[0, -1]])
            bounds = np.concatenate([-far[:1], edges, far[1:]])
            index = edges.searchsorted(flat, "right" if side == "right" else "left")
            v0, slope = self._line(bounds[index], bounds[index + 1])
            return np.asarray(v0 + slope * (flat - bounds[index]))
        out = np.interp(flat, times, values)
        if side == "left":
            # At a knot its own value, and at a jump that of the first of two knots.
            j = np.minimum(times.searchsorted(flat), times.size - 1)
            out = np.where(times[j] == flat, values[j], out)
        return out

    def _line(self, start: FloatArray, stop: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Values (V) at `start` and slopes (V/s) of the straight pieces between `start` and `stop` (s)."""
        times, values = self.knots
        # A piece is identified by its midpoint, which rounding cannot move into a neighbour.
        middle = 0.5 * (start + stop)
        run = np.zeros(1)
        if self.period is not None:
            run = self._origin + np.maximum(np.floor((middle - self._first) / self.period), 0.0) * self.period
        index = times.searchsorted(middle - run, "right")
        j = np.clip(index, 1, times.size - 1)
        inside = (index > 0) & (index < times.size)
        width = np.where(inside, times[j] - times[j - 1], 1.0)
        slope = np.where(inside, (values[j] - values[j - 1]) / width, 0.0)
        offset = start - run - times[j - 1]
        # A piece whose start differs from a knot only by rounding starts with exactly the knot's value.
        offset = np.where(np.abs(offset) <= 1e-9 * width, 0.0, offset)
        return np.where(inside, values[j - 1] + slope * offset, np.where(index == 0, values[0], values[-1])), slope

    def terms(self, start: FloatArray, stop: FloatArray) -> FloatArray:
        value, slope = self._line(start, stop)
        return terms_of(start.size, (value,), (slope, 1.0))

    def peak(self, t0: float, t1: float) -> float:
        if self.period is not None:
            return super().peak(t0, t1)
        times, values = self.knots
        inside = values[times.searchsorted(t0) : times.searchsorted(t1, "right")]
        ends = np.append(self.value([t0, t1]), self.value([t0, t1], "left"))
        return float(max(np.abs(ends).max(), inside.max(initial=0.0), -inside.min(initial=0.0)))

    def breakpoint_rate(self) -> float:
        times, _ = self.knots
        if self.period is None and times.size <= FEW_KNOTS:
            return 0.0  # The rate is only used to divide time into windows; so few breakpoints need none.
        span = self.period or (times[-1] - times[0])
        return times.size / span if span > 0.0 else 0.0


def _once(times: FloatArray) -> FloatArray:
    """The times, ascending, each once; of those that differ only by rounding, as two periods do, the first."""
    times = np.unique(times)
    return times[np.diff(times, prepend=-np.inf) > 1e-15 * np.abs(times)]


@dataclass(frozen=True)
class PWL(Ramps):
    """Piecewise linear through (times, values), constant before and after them; two equal times are a jump.

    Parameters
    ----------
    times : tuple of float
        s, not decreasing, at most two equal in a row.
    values : tuple of float
        V.
    repeat : float, optional
        s; after the last time, the part from `repeat` to the last time is repeated for ever.
    """

    times: tuple[float, ...]
    values: tuple[float, ...]
    repeat: float | None = None

    def __post_init__(self) -> None:
        t = real_numbers("PWL times", self.times, "numbers in s")
        v = real_numbers("PWL values", self.values, "numbers in V")
        self._declare(times=tuple(t.tolist()), values=tuple(v.tolist()))
        alike = t.ndim == 1 <= t.size and t.shape == v.shape
        require(alike, "PWL", f"{t.size} times and {v.size} values", "as many of each, in a row")
        for name, array in (("time", t), ("value", v)):
            if (bad := np.flatnonzero(~np.isfinite(array))).size:
                raise InputError(f"PWL {name} number {bad[0] + 1} is {array[bad[0]]}; allowed: finite numbers")
        check_range("PWL time", t, "s")
        check_range("PWL value", v, "V")
        if (back := np.flatnonzero(t[1:] < t[:-1])).size:
            before, after = t[back[0] : back[0] + 2]
            raise InputError(f"PWL times decrease: {after:g} s follows {before:g} s; allowed: not decreasing")
        if (thrice := np.flatnonzero(t[2:] == t[:-2])).size:
            raise InputError(f"PWL time {t[thrice[0]]:g} s stands three times; two equal times are a jump")
        if self.repeat is not None:
            self._declare(repeat=real_number("PWL repeat", self.repeat, "a number in s"))
            own = t.size > 1 and self.repeat in t[:-1] and self.repeat < t[-1]
            require(own, "PWL repeat time", f"{self.repeat:g} s", "one of the PWL's own times before the last")
            self._declare(period=self.times[-1] - self.repeat, settled=max(0.0, self.times[-1]), _first=self.repeat)

    def __repr__(self) -> str:
        return self._text

    @cached_property
    def _text(self) -> str:
        if len(self.times) <= MOST_SHOWN:
            return f"PWL(times={self.times!r}, values={self.values!r}, repeat={self.repeat!r})"
        # Runs store this text to know which source they had: the digest stands for the points.
        digest = hashlib.sha256(np.array([self.times, self.values]).tobytes()).hexdigest()[:16]
        span = f"{self.times[0]:g} s to {self.times[-1]:g} s"
        return f"PWL({len(self.times)} points, {span}, sha256 {digest}, repeat={self.repeat!r})"

    @classmethod
    def from_table(
        cls, path: str | Path, time: str | int | None = None, value: str | int | None = None, *, pairs: bool = False
    ) -> PWL:
        """The points of a table with a column of times (see `waveforms.files.read_table`).

        Parameters
        ----------
        path : str or Path
        time, value : str or int, optional
            Names of the columns, or their numbers counted from 0; needed if there are more than two.
        pairs : bool
            Whether one row or column without a header holds alternating times and values, as ``PWL FILE=`` takes it.

        Raises
        ------
        InputError
            If the file cannot be read (the message names the line), or has a rate and no times.
        """
        values, _, times = read_table(path, time, value, pairs=pairs)
        require(times is not None, f"'{path}'", "a table with a rate", "one with times; fs.Samples.from_table")
        return cls(times, values)  # type: ignore[arg-type]

    @cached_property
    def knots(self) -> tuple[FloatArray, FloatArray]:
        return np.asarray(self.times), np.asarray(self.values)


@dataclass(frozen=True)
class _Periodic(Ramps):
    """A shape of straight pieces repeated for ever, shifted by `delay` and `phase_deg`."""

    amplitude: Volt
    frequency: Hertz
    offset: Volt = 0.0
    phase_deg: Degree = 0.0
    delay: Second = 0.0
    _shift: ClassVar[float]  # Time of the shape's start, s
    # Times of the knots in periods, values over the offset in amplitudes, whether one half is the other turned over
    _shape: ClassVar[tuple[tuple[float, ...], tuple[float, ...], bool]]

    def __post_init__(self) -> None:
        super().__post_init__()
        require(self.frequency > 0.0, f"{type(self).__name__.lower()} frequency", f"{self.frequency:g} Hz", "> 0")
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
        runs = runs_through(1.0 / self.frequency, x.size, t0, t1, self._shift)
        return np.asarray(((runs + x) / self.frequency + self._shift).ravel())

    def breakpoint_rate(self) -> float:
        return 4.0 * self.frequency


@dataclass(frozen=True)
class Square(_Periodic):
    """offset + amplitude for the fraction `duty` of each period, then offset - amplitude, with ideal edges.

    Amplitude and offset in V, frequency in Hz, duty between 0 and 1, phase in degrees, and delay, a shift, in s.
    """

    duty: Ratio = 0.5
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

    v1: Volt
    v2: Volt
    delay: Second = 0.0
    rise: Second = 0.0
    fall: Second = 0.0
    width: Second = math.inf
    pulse_period: Second = math.inf
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
        t = np.cumsum([0.0 if self.period else self.delay, self.rise, self.width, self.fall])
        v = np.array([self.v1, self.v2, self.v2, self.v1])
        if self.period and self.pulse_period > t[-1]:
            t, v = np.append(t, self.pulse_period), np.append(v, self.v1)
        return t[np.isfinite(t)], v[np.isfinite(t)]


_ROUNDING_OF_TIMES = 8e-16  # A time so near a breakpoint, relatively, differs from it by rounding: it is replaced.


class _Stretches(Waveform):
    """The first stretch of another waveform, once from `delay` (s) on or, with a period, for ever; 0 V elsewhere."""

    waveform: Waveform
    delay: float = 0.0
    _stretch: float  # Length of the stretch, s

    def __post_init__(self) -> None:
        wave = as_waveform(self.waveform)
        self._declare(waveform=wave, is_sampled=wave.is_sampled, _quick=wave.shortest_time())
        super().__post_init__()

    def _begin(self, t: FloatArray) -> FloatArray:
        """Start (s) of the stretch in which, or next to which, each time is."""
        return np.full(t.shape, self.delay) if self.period is None else np.floor(t / self.period) * self.period

    def _edges(self, t0: float, t1: float) -> FloatArray:
        if self.period is None:
            return np.asarray(self.delay + self._marks)
        marks = self._marks[:-1]
        return np.asarray((runs_through(self.period, marks.size, t0, t1) * self.period + marks).ravel())

    def breakpoint_rate(self) -> float:
        return self.waveform.breakpoint_rate() if self.period is None else self._marks.size / self.period

    @cached_property
    def _marks(self) -> FloatArray:
        """Breakpoints of the other waveform within the stretch, and both ends of the stretch, s."""
        inner = self.waveform.breakpoints(0.0, self._stretch)
        inner = inner[(inner > 0.0) & (inner < self._stretch * (1.0 - _ROUNDING_OF_TIMES))]
        return np.concatenate([[0.0], inner, [self._stretch]])

    def _inner(self, t: FloatArray, begin: FloatArray) -> FloatArray:
        """Times (s) since the stretch began; a time that differs from a breakpoint only by rounding is set to it."""
        tau = np.asarray(t - begin, float)
        marks = self._marks
        right = np.clip(np.searchsorted(marks, tau), 1, marks.size - 1)
        near = np.where(tau - marks[right - 1] < marks[right] - tau, marks[right - 1], marks[right])
        return np.where(np.abs(tau - near) <= _ROUNDING_OF_TIMES * np.abs(t), near, tau)

    def value(self, t: ArrayLike, side: str = "right") -> FloatArray:
        t = real_numbers("t", t, "times in s")
        tau = self._inner(t, self._begin(t))
        first, last = (0.0, self._stretch) if side == "right" else (self._stretch, 0.0)
        if self.period is not None:
            # By rounding, the start of a period may count as the end of the period before, or an end as a start.
            tau = np.where(tau == last, first, tau)
        on = (tau >= 0.0) & (tau <= self._stretch) & (tau != last)
        return np.where(on, self.waveform.value(np.where(on, tau, 0.0), side), 0.0)

    def terms(self, start: FloatArray, stop: FloatArray) -> FloatArray | None:
        middle = 0.5 * (start + stop)
        begin = self._begin(middle)
        on = (middle >= begin) & (middle - begin < self._stretch)
        block = self.waveform.terms(*(self._inner(t[on], begin[on]) for t in (start, stop)))
        if block is None:
            return None
        out = np.zeros((start.size, *block.shape[1:]))
        out[on] = block
        return out

    @property
    def precision(self) -> float:  # type: ignore[override]
        return self.waveform.precision

    def cancelling(self, t0: float, t1: float) -> float:
        return self.waveform.cancelling(0.0, self._stretch)


@dataclass(frozen=True)
class Burst(_Stretches):
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
    duration: Second
    delay: Second = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        require(self.duration > 0.0, "burst duration", f"{self.duration:g} s", "> 0")
        require(self.delay >= 0.0, "burst delay", f"{self.delay:g} s", ">= 0")
        self._declare(_stretch=self.duration, course=(self.delay, self.delay + self.duration))


@dataclass(frozen=True)
class Repeat(_Stretches):
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
    period: Second = field()

    def __post_init__(self) -> None:
        super().__post_init__()
        require(self.period > 0.0, "repeat period", f"{self.period:g} s", "> 0")
        self._declare(_stretch=self.period)

    def tone(self) -> float | None:
        tone = (self.waveform.waveform if isinstance(self.waveform, Burst) else self.waveform).tone()
        turns = 0.0 if tone is None else tone * self.period
        return tone if round(turns) >= 1 and abs(turns - round(turns)) < 1e-9 * turns else 1.0 / self.period
