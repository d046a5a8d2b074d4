"""Waveforms made of straight pieces: `PWL`, and their base class `Ramps`, of which a subclass only lists its knots."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fingerspice.base.arrays import FloatArray, real_number, real_numbers
from fingerspice.base.errors import InputError
from fingerspice.waveforms.files import read_table
from fingerspice.waveforms.waveform import Waveform, check_range, require, terms_of

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
