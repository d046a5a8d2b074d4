"""Samples at a constant rate: in memory, in a WAV file read by parts, and waveforms that are samples as well."""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from fingerspice.base.arrays import FloatArray, read_only, real_number, real_numbers, whole_number
from fingerspice.base.errors import InputError
from fingerspice.base.units import Hertz, Second
from fingerspice.waveforms.files import LARGEST_STREAMED, MAX_BYTES, WavLayout, check_count, read_table, wav_layout
from fingerspice.waveforms.periodic import FEW_KNOTS, PWL, Ramps
from fingerspice.waveforms.waveform import DC, RANGES, Product, Sum, Waveform, check_range, require

# Half-width of the filter in samples, beta of its Kaiser window: the gain is 1 within 0.02 % up to 0.46 of the rate.
_WING, _BETA = 32, 8.0
AT_ONCE = 1 << 20  # Number of samples of a file that are read at once.
ON_GRID, ROUNDING = 1e-9, 1e-15  # Largest distance of a time from the grid, in spacings, and its own rounding.
MOST_PER_POINT = 8  # Grid samples for each point of a PWL: beyond it, few long lines are faster taken one by one.


@dataclass(frozen=True, eq=False)
class Samples(Ramps):
    """Samples at a constant rate, linear between them, constant before the first and after the last.

    Parameters
    ----------
    values : array_like, shape (n,)
        V, n >= 2.
    rate : float
        Samples per second.
    start : float
        Time of the first sample, s.
    """

    values: FloatArray
    rate: Hertz
    start: Second = 0.0
    # Number of the sample `values[0]` in the whole recording, whose sample number 0 is at `start`.
    _number: ClassVar[int] = 0
    count: ClassVar[int]  #: Number of samples

    def __post_init__(self) -> None:
        values = read_only(real_numbers("the row of samples", self.values, "two or more numbers in V").copy())
        self._declare(values=values, count=values.size)
        require(values.ndim == 1 and values.size >= 2, "samples", f"shape {values.shape}", "one row of two or more")
        _check_samples(values, 0)
        super().__post_init__()
        require(self.rate > 0.0, "sample rate", f"{self.rate:g} Hz", "> 0")

    @classmethod
    def from_wav(cls, path: str | Path, gain: float, channel: int | None = None, *, at_once: bool = True) -> Samples:
        """One channel of a WAV file of integers (8 to 64 bits) or floats, at any rate.

        Parameters
        ----------
        path : str or Path
        gain : float
            V at full scale; full scale is half the range of the file's integers, or 1 for floats.
        channel : int, optional
            Counted from 0; needed where there are several.
        at_once : bool
            Whether all samples are kept in memory, 8 bytes each. Otherwise they are read from the file
            piece by piece when they are needed, and the file must not change meanwhile; `stream` then takes the same
            memory for an hour as for a second.

        Raises
        ------
        InputError
            If the file cannot be read or is broken, if it has several channels and none is chosen, or if it has no
            such channel.
        """
        gain = real_number("gain", gain, "a finite number of V at full scale")
        require(math.isfinite(gain), "gain", gain, "a finite number of V at full scale")
        # Samples of a float file that are no numbers, or become too large, are refused below without NumPy's warning.
        with np.errstate(over="ignore", invalid="ignore"):
            layout = wav_layout(path, channel, MAX_BYTES if at_once else LARGEST_STREAMED)
            if at_once:
                check_count(str(layout.path), layout.count)
                values = layout.read(0, layout.count)
            try:
                return cls(gain * values, float(layout.rate)) if at_once else _WavFile(layout, gain)
            except InputError as error:
                raise InputError(f"'{path}': {error}") from None

    @classmethod
    def from_table(cls, path: str | Path, rate: float | None = None, value: str | int | None = None) -> Samples:
        """A column of a table at a rate (see `waveforms.files.read_table`).

        Parameters
        ----------
        path : str or Path
        rate : float, optional
            Samples per second; needed where the file does not give it.
        value : str or int, optional
            Name of the column, or its number counted from 0; needed where there are several.

        Raises
        ------
        InputError
            If the file cannot be read (the message names the line), or has times and no rate.
        """
        values, rate, _ = read_table(path, None, value, rate)
        require(rate is not None, f"'{path}'", "a table with times", "one with a rate; fs.PWL.from_table")
        return cls(values, rate)  # type: ignore[arg-type]

    def upsampled(self, factor: int = 16) -> Samples:
        """The same recording at `factor` (2 to 64) times the rate, by band-limited interpolation.

        The straight lines between the new samples interpolate a tone at f with an error of up to
        (pi f / (factor rate))^2 / 2 of its amplitude: with a factor of 16 this is 0.08 % at f = 0.2 rate and 0.4 % at
        0.45 rate. The filter adds 0.02 % up to 0.46 rate, and attenuates higher frequencies. Before its first and
        after its last sample the recording counts as constant.

        Raises
        ------
        InputError
            If the factor is not a whole number from 2 to 64, or the result has too many samples.
        """
        from scipy.signal import firwin, resample_poly

        factor = whole_number("factor of upsampling", factor, 2, 64)
        check_count("the upsampled recording", factor * self.count)
        taps = firwin(2 * _WING * factor + 1, 1.0 / factor, window=("kaiser", _BETA))
        dense = resample_poly(self.values, factor, 1, window=taps, padtype="edge")[: (self.count - 1) * factor + 1]
        # The finite window makes the filter slightly inexact at the given samples: restore them.
        dense[::factor] = self.values
        return Samples(dense, factor * self.rate, self.start)

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        if "values" in state:
            self.values.flags.writeable = False  # NumPy unpickles every array as writable.

    def __repr__(self) -> str:
        return self._text

    @cached_property
    def _text(self) -> str:
        # Stores of runs that go on are told apart by this text where the samples are part of a sum: it names them all.
        return f"{str(self)[:-1]}, sha256 {self.digest()[:16]})"

    def __str__(self) -> str:
        return f"Samples({self.count} samples, rate={self.rate!r}, start={self.start!r})"

    def digest(self) -> str:
        """SHA-256 of the samples, rate and start, as a key of caches."""
        return hashlib.sha256(repr((self.rate, self.start)).encode() + self.values.tobytes()).hexdigest()

    def between(self, first: int, last: int) -> FloatArray:
        """Samples number `first` to `last` - 1, V; beyond the ends, the first or last one; maybe a part of `values`."""
        low, high = (min(max(n, 0), self.count - 1) for n in (first, last - 1))
        values = self._read(low, high + 1)
        return values if (low, high) == (first, last - 1) else values[np.clip(np.arange(first, last), low, high) - low]

    def _read(self, first: int, last: int) -> FloatArray:
        return self.values[first:last]

    def part(self, t0: float, t1: float) -> Samples:
        """The samples that determine the values between two times (s), as a waveform that needs no other samples."""
        low, high = self._around(t0, t1)
        out = object.__new__(Samples)
        values = read_only(self.between(low, high))
        out._declare(values=values, count=high - low, rate=self.rate, start=self.start, _number=self._number + low)
        return out

    def _number_of(self, t: float) -> float:
        """Index into `values` at a time (s), as a fractional number."""
        return (t - self.start) * self.rate - self._number

    def _times_of(self, low: int, high: int) -> FloatArray:
        return np.asarray(self.start + np.arange(self._number + low, self._number + high) / self.rate)

    def _around(self, t0: float, t1: float) -> tuple[int, int]:
        """First index into `values`, and the one after the last, of two samples or more that determine a span (s)."""
        low = math.floor(min(max(self._number_of(t0) - 2.0, 0.0), self.count - 2))
        return low, math.ceil(min(max(self._number_of(t1) + 3.0, low + 2), self.count))

    @property
    def course(self) -> tuple[float, float]:  # type: ignore[override]
        # Not from the values, which may lie in a file of an hour.
        return self.start, self.start + (self.count - 1) / self.rate

    @cached_property
    def knots(self) -> tuple[FloatArray, FloatArray]:
        return self._times_of(0, self.count), self.values

    def _edges(self, t0: float, t1: float) -> FloatArray:
        return self._times_of(*self._around(t0, t1))

    def peak(self, t0: float, t1: float) -> float:
        low = max(math.ceil(self._number_of(t0) - 1e-6), 0)
        high = min(math.floor(self._number_of(t1) + 1e-6) + 1, self.count)
        peak = float(np.abs(self.value([t0, t1])).max())
        for at in range(low, high, AT_ONCE):
            values = self.between(at, min(at + AT_ONCE, high))
            peak = max(peak, float(values.max()), -float(values.min()))
        return peak

    def breakpoint_rate(self) -> float:
        # The rate is only used to divide time into windows; so few breakpoints need none.
        return 0.0 if self.count <= FEW_KNOTS else self.count / ((self.count - 1) / self.rate)

    def _values(self, flat: FloatArray, side: str) -> FloatArray:
        low, high = self._around(float(flat.min()), float(flat.max()))
        values = self.between(low, high)
        if 16 * flat.size < high - low:
            # Few times need only the samples around each of them.
            at = np.clip((flat - self.start) * self.rate - self._number, low, high - 1).astype(int)
            near = np.unique(np.clip(at[:, None] + np.arange(-1, 3), low, high - 1))
            return np.interp(flat, self.start + (self._number + near) / self.rate, values[near - low])
        times = self._times_of(low, high)
        first = int(times.searchsorted(flat[0]))
        if np.array_equal(flat, times[first : first + flat.size]):
            return values[first : first + flat.size].copy()
        return np.interp(flat, times, values)


def _check_samples(values: FloatArray, first: int) -> None:
    """Refuse samples (V) that are not finite or too large; `first` is the number of the first of them."""
    ends = [values.min(), values.max()]  # An extreme value is NaN if any value is.
    if not np.all(np.isfinite(ends)):
        bad = np.flatnonzero(~np.isfinite(values))
        raise InputError(f"sample number {first + bad[0]} is {values[bad[0]]}; allowed: finite numbers")
    check_range("a sample", ends, "V")


class _WavFile(Samples):
    """Samples in a file, read in parts; the first use of `values` reads all samples and keeps them in memory."""

    layout: WavLayout
    gain: float

    def __init__(self, layout: WavLayout, gain: float) -> None:
        self._declare(layout=layout, gain=gain, rate=float(layout.rate), start=0.0, count=layout.count)
        require(self.count >= 2, "samples", f"shape ({self.count},)", "one row of two or more")
        sure = layout.kind[1] != "f" and abs(gain) <= RANGES["V"][0]  # Integers are finite, and within full scale.
        for first in range(0, 0 if sure else self.count, AT_ONCE):
            _check_samples(self.between(first, min(first + AT_ONCE, self.count)), first)

    def __str__(self) -> str:
        return f"Samples.from_wav({str(self.layout.path)!r}, {self.gain!r}, {self.layout.channel}, at_once=False)"

    __repr__ = __str__

    @cached_property
    def values(self) -> FloatArray:
        return read_only(self.between(0, self.count))

    def digest(self) -> str:
        with self.layout.path.open("rb") as file:
            found = hashlib.file_digest(file, "sha256")
        found.update(repr((self.gain, self.layout.channel)).encode())
        return found.hexdigest()

    def _read(self, first: int, last: int) -> FloatArray:
        if "values" in self.__dict__:
            return super()._read(first, last)
        return np.asarray(self.gain * self.layout.read(first, last))

    def terms(self, start: FloatArray, stop: FloatArray) -> FloatArray:
        return self.part(float(start.min()), float(stop.max())).terms(start, stop)


def as_samples(wave: Waveform) -> Samples | None:
    """The samples that a waveform consists of, or None.

    These are a recording; a PWL without jump and end whose intervals are multiples of its shortest one; sums of such
    waveforms and constants on one grid; and products of one of them with constants. The result is kept with `wave`.
    """
    if isinstance(wave, Samples):
        return wave
    if isinstance(wave, PWL):
        return wave.remember(("samples",), lambda: _of_points(wave))
    return wave.remember(("samples",), lambda: _of_parts(wave)) if isinstance(wave, Sum | Product) else None


def _of_parts(wave: Sum | Product) -> Samples | None:
    """A product of one recording and constants; or a sum of recordings on one grid, from the first sample of any to
    the last one, and constants."""
    constants = [part.level for part in wave.parts if isinstance(part, DC)]
    others = [as_samples(part) for part in wave.parts if not isinstance(part, DC)]
    parts = [part for part in others if part is not None]
    if not parts or len(parts) < len(others):
        return None
    first = min(parts, key=lambda part: part.start)
    rate = first.rate
    if isinstance(wave, Product):
        return Samples(float(np.prod(constants)) * first.values, rate, first.start) if len(parts) == 1 else None
    begins = [(part.start - first.start) * rate for part in parts]
    if any(part.rate != rate for part in parts) or any(abs(x - round(x)) > ON_GRID for x in begins):
        return None
    end = max(round(x) + part.count for x, part in zip(begins, parts, strict=True))
    # Recordings far apart would make a grid of mostly constant samples.
    if end > MOST_PER_POINT * sum(part.count for part in parts):
        return None
    total = np.full(end, float(sum(constants)))
    for x, part in zip(begins, parts, strict=True):
        total += part.between(-round(x), end - round(x))
    return Samples(total, rate, first.start)


def _of_points(wave: PWL) -> Samples | None:
    """The samples of a PWL on the grid of its shortest interval."""
    t = np.asarray(wave.times)
    if wave.repeat is not None or t.size < 2:
        return None
    shortest, length = float(np.diff(t).min()), float(t[-1] - t[0])
    if shortest <= 0.0 or length > MOST_PER_POINT * t.size * shortest:
        return None
    count = round(length / shortest)
    rate = count / length
    place = np.rint((t - t[0]) * rate)
    if np.any(np.abs(t[0] + place / rate - t) > ON_GRID / rate + ROUNDING * np.abs(t)):
        return None
    return Samples(np.interp(np.arange(count + 1), place, wave.values), rate, float(t[0]))
