"""What the page sends and gets: recordings dropped on it, whose numbers come with each request; answers as JSON."""

from __future__ import annotations

import base64
import binascii
import json
import math
import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from fingerspice.base.arrays import FloatArray
from fingerspice.base.errors import InputError
from fingerspice.waveforms.ramps import PWL
from fingerspice.waveforms.samples import Samples
from fingerspice.waveforms.waveform import Waveform, require

#: Most numbers of a recording: four seconds at 48 kHz.
MOST_SAMPLES = 200_000
_KEYS = "an object with the keys name, values, and rate or times"


@dataclass(frozen=True, eq=False)
class Recording:
    """A file's numbers."""

    name: str  # Of the file, for the script that "Copy as Python" gives
    values: FloatArray  # From -1 to 1 for full scale of a recording; as in the file for a table
    rate: float | None = None  # Samples per second
    times: FloatArray | None = None  # Times of a table, s

    @property
    def duration(self) -> float:
        """Time of the last value, s."""
        return float(self.times[-1]) if self.times is not None else self.values.size / (self.rate or 1.0)

    def waveform(self, gain: float) -> Waveform:
        """The values times the gain (V) as a source."""
        if self.times is not None:
            return PWL(tuple(self.times.tolist()), tuple((gain * self.values).tolist()))
        assert self.rate is not None
        return Samples(gain * self.values, self.rate)

    def python(self, gain: float) -> str:
        """The same source from its file, as Python."""
        if self.times is not None:
            return f"{gain!r} * fs.PWL.from_table({self.name!r})"
        return f"fs.Samples.from_wav({self.name!r}, {gain!r}, channel=0)"


def recording_of(given: Any) -> Recording:
    """A recording from plain data.

    Raises
    ------
    InputError
        If a value is wrong.
    """
    require(isinstance(given, dict), "recording", type(given).__name__, _KEYS)
    name, rate = given.get("name"), given.get("rate")
    require(isinstance(name, str) and len(name) <= 200, "recording name", repr(name)[:80], "a file's name")
    values = _numbers("values", given.get("values"))
    if given.get("times") is not None:
        times = _numbers("times", given["times"])
        require(times.size == values.size, "recording", f"{times.size} times, {values.size} values", "as many of each")
        return Recording(name, values, times=times)
    good = isinstance(rate, (int, float)) and not isinstance(rate, bool) and 1.0 <= rate <= 1e7
    require(good, "recording rate", repr(rate)[:80], "1 to 1e7 samples per second")
    assert rate is not None
    return Recording(name, values, float(rate))


def _numbers(what: str, given: Any) -> FloatArray:
    """Numbers from base64 of little-endian doubles."""
    try:
        data = base64.b64decode(given if isinstance(given, str) else "?", validate=True)
        values = np.frombuffer(data, "<f8").astype(float)
    except (ValueError, binascii.Error):
        raise InputError(f"recording {what}: not base64 of doubles") from None
    allowed = f"2 to {MOST_SAMPLES:,}"
    require(2 <= values.size <= MOST_SAMPLES, f"recording {what}", f"{values.size:,} numbers", allowed)
    require(bool(np.isfinite(values).all()), f"recording {what}", "not finite", "finite numbers")
    return values


def as_json(data: Any) -> bytes:
    """Data as JSON: arrays of numbers as base64 of little-endian doubles, and null for what is not finite."""
    return _dumped(data, lambda x: {"f64": base64.b64encode(_doubles(x)).decode("ascii")})


def framed(data: Any) -> bytes:
    """Data as the JSON's length and the number of doubles (four bytes each), the JSON, and the doubles of all arrays.

    All numbers are little-endian. In the JSON an array is its place among the doubles, and its size. The doubles begin
    at a multiple of eight bytes, so that the page need not copy them.
    """
    arrays: list[bytes] = []
    places: dict[int, list[int]] = {}
    end = 0

    def place(x: Any) -> dict[str, list[int]]:
        nonlocal end
        if id(x) not in places:
            arrays.append(_doubles(x))
            places[id(x)] = [end, x.size]
            end += x.size
        return {"f64": places[id(x)]}

    text = _dumped(data, place)
    text += b" " * (-len(text) % 8)
    return b"".join([struct.pack("<II", len(text), end), text, *arrays])


def _doubles(x: Any) -> bytes:
    assert isinstance(x, np.ndarray)
    return np.ascontiguousarray(x, "<f8").tobytes()


def _dumped(data: Any, array: Callable[[Any], Any]) -> bytes:
    """Data as JSON, with `array` for its arrays, and null for what is not finite."""

    def finite(x: Any) -> Any:
        if isinstance(x, dict):
            return {key: finite(value) for key, value in x.items()}
        if isinstance(x, list | tuple):
            return [finite(value) for value in x]
        return x if not isinstance(x, float) or math.isfinite(x) else None

    try:
        return json.dumps(data, allow_nan=False, default=array).encode()
    except ValueError:
        # Seldom, and all data have to be gone through.
        return json.dumps(finite(data), allow_nan=False, default=array).encode()
