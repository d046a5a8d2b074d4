"""Waveforms of straight pieces: PWL, square, triangle, sawtooth, pulses; the chirp and the exponential pulse.

The base class of straight pieces is `Ramps`, of which a subclass only lists its knots.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fingerspice.base.arrays import FloatArray, real_number, real_numbers
from fingerspice.base.errors import InputError
from fingerspice.waveforms.files import read_table
from fingerspice.waveforms.waveform import TAU, Waveform, check_range, require, terms_of

# A waveform with at most this many knots is not divided into windows, however close together its knots are.
FEW_KNOTS = 1000
# Most points that the text of a PWL shows.
MOST_SHOWN = 10_000
#: Largest number of breakpoints listed at once; each takes about 40 bytes, the arrays computed from it included.
MOST_LISTED = 20_000_000
#: Number of breakpoints in a window of time; the values at all times in one window are looked up together.
_WINDOW = 1_000_000


def runs_through(first: float, last: float, count: int, t0: float, t1: float) -> FloatArray:
    """Indices of periods `first` to `last`, over t0 to t1 (s), of `count` breakpoints each; too many are refused."""
    total = (last - first + 1.0) * count
    if not total <= MOST_LISTED:
        raise InputError(
            f"the source has {total:.3g} breakpoints from {t0:g} s to {t1:g} s; allowed: at most {MOST_LISTED:.0e} at "
            "once: a shorter run, or a longer period"
        )
    return np.arange(first, last + 1.0)


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

    # Time (s) from which the waveform is periodic, and the time from which its knots' times are counted.
    _first: float = 0.0
    _origin: float = 0.0

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
        low = max(1.0, np.floor((t0 - self._first) / self.period) - 1.0)
        high = max(low, np.ceil((t1 - self._first) / self.period) + 1.0)
        starts = self._origin + runs_through(low, high, body.size, t0, t1) * self.period
        return np.concatenate([self._origin + times, (starts[:, None] + body).ravel()])

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
        # A piece is identified by its midpoint, which rounding cannot move into a neighbour.
        times, values = self.knots
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
            # The rate is only used to divide time into windows; so few breakpoints need none.
            return 0.0
        span = self.period or (times[-1] - times[0])
        return times.size / span if span > 0.0 else 0.0


def _once(times: FloatArray) -> FloatArray:
    """The times, ascending, each once; of those that differ only by rounding, as the end of a period and the start of
    the next, the first."""
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
        object.__setattr__(self, "times", tuple(t.tolist()))
        object.__setattr__(self, "values", tuple(v.tolist()))
        alike = t.ndim == 1 <= t.size and t.shape == v.shape
        require(alike, "PWL", f"{t.size} times and {v.size} values", "as many of each, in a row")
        for name, array in (("time", t), ("value", v)):
            bad = np.flatnonzero(~np.isfinite(array))
            if bad.size:
                raise InputError(f"PWL {name} number {bad[0] + 1} is {array[bad[0]]}; allowed: finite numbers")
        check_range("PWL time", t, "s")
        check_range("PWL value", v, "V")
        back = t[1:] < t[:-1]
        if np.any(back):
            i = int(np.argmax(back))
            raise InputError(f"PWL times decrease: {t[i + 1]:g} s follows {t[i]:g} s; allowed: not decreasing")
        thrice = t[2:] == t[:-2]
        if np.any(thrice):
            i = int(np.argmax(thrice))
            raise InputError(f"PWL time {t[i]:g} s stands three times; two equal times are a jump")
        if self.repeat is not None:
            object.__setattr__(self, "repeat", real_number("PWL repeat", self.repeat, "a number in s"))
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
        table = read_table(path, time, value, pairs=pairs)
        require(table.times is not None, f"'{path}'", "a table with a rate", "one with times; fs.Samples.from_table")
        return cls(table.times, table.values)  # type: ignore[arg-type]

    @cached_property
    def knots(self) -> tuple[FloatArray, FloatArray]:
        return np.asarray(self.times), np.asarray(self.values)


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
