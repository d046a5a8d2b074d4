"""Waveforms made of straight pieces: `PWL`, and the base class of all such waveforms.

A subclass of `Ramps` only lists its knots.
"""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fingerspice.base.arrays import FloatArray, real_number, real_numbers
from fingerspice.base.errors import InputError
from fingerspice.waveforms.bounds import check_range, in_windows, runs_through
from fingerspice.waveforms.files import read_table
from fingerspice.waveforms.waveform import Waveform, require, terms_of

# A waveform with at most this many knots is not divided into windows, however close together its knots are.
FEW_KNOTS = 1000
# Most points that the text of a PWL shows.
MOST_SHOWN = 10_000


class Ramps(Waveform):
    """Straight lines between knots (t, v), constant outside them or repeated; two knots at one time are a jump.

    Subclasses implement `_knots`. A periodic waveform repeats its knots once per `period` from the time `_first` on,
    and they span exactly one period.
    """

    _first: float = 0.0

    @cached_property
    def knots(self) -> tuple[FloatArray, FloatArray]:
        """Times (s, ascending) and values (V) of the knots of one run or period."""
        return self._knots()

    @cached_property
    def _distinct(self) -> FloatArray:
        """Times of the knots, each once, s."""
        return _once(np.unique(self.knots[0]))

    def _knots(self) -> tuple[FloatArray, FloatArray]:
        """Times (s, ascending) and values (V) of the knots, shape (n,) each."""
        raise NotImplementedError

    def _phase(self, t: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Start of the period that contains each time, and the time since then, s."""
        if self.period is None:
            return np.zeros_like(t), t
        start = self._first + np.maximum(np.floor((t - self._first) / self.period), 0.0) * self.period
        return start, t - start

    def _times(self, t0: float, t1: float) -> FloatArray:
        """Times of a periodic waveform's knots (s, ascending) over [t0, t1] and a period beyond; jumps appear twice."""
        assert self.period is not None
        times, _ = self.knots
        low = max(0.0, np.floor((t0 - self._first) / self.period) - 1.0)
        high = max(low, np.ceil((t1 - self._first) / self.period) + 1.0)
        starts = self._first + runs_through(low, high, times.size, t0, t1) * self.period
        return np.asarray((starts[:, None] + times[None, :]).ravel())

    def _edges(self, t0: float, t1: float) -> FloatArray:
        if self.period is None:
            times = self._distinct
            return times[max(0, times.searchsorted(t0) - 1) : times.searchsorted(t1, "right") + 1]
        return _once(np.unique(self._times(t0, t1)))

    @property
    def course(self) -> tuple[float, float]:
        times, values = self.knots
        changes = np.flatnonzero(np.diff(values))
        if changes.size == 0:
            return math.inf, -math.inf
        if self.period:
            return self._first + float(times[changes[0]]), math.inf
        return float(times[changes[0]]), float(times[changes[-1] + 1])

    def breakpoints(self, t0: float, t1: float) -> FloatArray:
        times = self._edges(t0, t1)
        return times[(times >= t0) & (times <= t1)]

    def value(self, t: ArrayLike, side: str = "right") -> FloatArray:
        t = real_numbers("t", t, "times in s")
        flat = t.ravel()
        out = np.empty(flat.size)
        for window in in_windows(flat, self.breakpoint_rate() if self.period else 0.0):
            out[window] = self._values(flat[window], side)
        return out.reshape(t.shape)

    def _values(self, flat: FloatArray, side: str) -> FloatArray:
        """As `value`, at times (n_t,) within one window."""
        if self.period is None:
            return self._along(flat, side)
        edges = self._edges(flat.min(), flat.max())
        index = _place(edges, flat, side)
        bounds = np.concatenate([[-math.inf], edges, [math.inf]])
        start, stop = bounds[index], bounds[index + 1]
        v0, slope = self._line(start, stop)
        tau = np.where(np.isfinite(start), flat - np.where(np.isfinite(start), start, 0.0), 0.0)
        return np.asarray(v0 + slope * tau)

    def _along(self, flat: FloatArray, side: str) -> FloatArray:
        """Values (V) of a waveform without a period at times (n_t,), each from the knot before it."""
        times, values = self.knots
        if side == "right":
            return np.interp(flat, times, values)
        index = _place(times, flat, side)
        j = np.clip(index, 1, times.size - 1)
        # Outside the knots the two nearest may be a jump, between which there is no slope.
        with np.errstate(divide="ignore", invalid="ignore"):
            slope = (values[j] - values[j - 1]) / (times[j] - times[j - 1])
            inside = values[j - 1] + slope * (flat - times[j - 1])
        return np.where(index == 0, values[0], np.where(index == times.size, values[-1], inside))

    def _line(self, start: FloatArray, stop: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Values (V) at `start` and slopes (V/s) of the straight pieces between `start` and `stop` (s).

        A piece is identified by its midpoint, which rounding cannot move into a neighbour.
        """
        times, values = self.knots
        middle = 0.5 * (start + stop)
        run, tau = self._phase(np.where(np.isfinite(middle), middle, 0.0))
        index = np.searchsorted(times, tau, side="right")
        before = np.where(np.isfinite(middle), index == 0, start == -math.inf)
        after = np.where(np.isfinite(middle), index == times.size, start != -math.inf)
        j = np.clip(index, 1, times.size - 1)
        width = times[j] - times[j - 1]
        inside = ~before & ~after & (width > 0.0)
        slope = np.where(inside, (values[j] - values[j - 1]) / np.where(width > 0.0, width, 1.0), 0.0)
        offset = np.where(np.isfinite(start), start - run, 0.0) - times[j - 1]
        # A piece whose start differs from a knot only by rounding starts with exactly the knot's value.
        offset = np.where(np.abs(offset) <= 1e-9 * width, 0.0, offset)
        v0 = np.where(inside, values[j - 1] + slope * offset, np.where(before, values[0], values[-1]))
        return v0, slope

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
    """Ascending times (s) without each time that differs from the time before it only by rounding.

    The last knot of a period and the first knot of the next period are such a pair.
    """
    keep = np.ones(times.size, bool)
    keep[1:] = np.diff(times) > 1e-15 * np.abs(times[1:])
    return times[keep]


def _place(edges: FloatArray, t: FloatArray, side: str) -> NDArray[np.intp]:
    """Number of ascending edges before each time, one at the time itself among them where `side` is right."""
    return edges.searchsorted(t, "right" if side == "right" else "left")


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

    @property
    def period(self) -> float | None:  # type: ignore[override]
        return None if self.repeat is None else self.times[-1] - self.repeat

    @property
    def settled(self) -> float:
        return max(0.0, self.times[-1]) if self.repeat is not None else 0.0

    def _knots(self) -> tuple[FloatArray, FloatArray]:
        return np.asarray(self.times), np.asarray(self.values)

    # The part before `repeat` occurs only once, so that the knots span more than one period, and the base class's
    # `_phase` and `_times` do not apply.
    def _phase(self, t: FloatArray) -> tuple[FloatArray, FloatArray]:
        if self.repeat is None:
            return np.zeros_like(t), t
        period = self.times[-1] - self.repeat
        k = np.maximum(np.floor((t - self.repeat) / period), 0.0)
        return k * period, t - k * period

    def _times(self, t0: float, t1: float) -> FloatArray:
        assert self.repeat is not None
        times = np.asarray(self.times)
        period = self.times[-1] - self.repeat
        body = times[times >= self.repeat]
        low = max(1.0, np.floor((t0 - self.repeat) / period) - 1.0)
        high = max(low, np.ceil((t1 - self.repeat) / period) + 1.0)
        runs = (runs_through(low, high, body.size, t0, t1) * period)[:, None] + body[None, :]
        return np.concatenate([times, runs.ravel()])
