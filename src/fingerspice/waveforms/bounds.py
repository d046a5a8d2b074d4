"""What the numbers of a source may be, and how much of it is looked at once: known before anything is spent on it."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import fields
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fingerspice.base.arrays import FloatArray
from fingerspice.base.errors import InputError

if TYPE_CHECKING:
    from fingerspice.waveforms.waveform import Waveform

#: Largest and smallest size of a number that is not 0, by unit: of voltages and currents, of angles, of all others.
RANGES = {"V": (1e12, 0.0), "deg": (1e9, 0.0)}
ANY_RANGE = (1e30, 1e-30)
#: Breakpoints that are listed at once; they and what is made of them take 40 bytes each.
MOST_LISTED = 20_000_000
#: Breakpoints among which values are looked up at once.
_WINDOW = 1_000_000


def check_finite(waveform: Waveform) -> None:
    """Refuse NaN, inf and what no calculation bears in any numeric field of a waveform dataclass."""
    for field in fields(waveform):  # type: ignore[arg-type]
        value = getattr(waveform, field.name)
        if isinstance(value, (float, int)):
            what = f"{type(waveform).__name__} {field.name}"
            if not math.isfinite(value):
                raise InputError(f"{what} is {value}; allowed: a finite number")
            check_range(what, value, waveform.units.get(field.name, ""))


def check_range(what: str, values: ArrayLike, unit: str) -> None:
    """Refuse finite numbers whose products and quotients would leave the range of a double."""
    largest, smallest = RANGES.get(unit, ANY_RANGE)
    size = np.abs(np.asarray(values, float))
    bad = np.flatnonzero(np.isfinite(size) & (((size < smallest) & (size > 0.0)) | (size > largest)))
    if bad.size:
        given = float(np.ravel(values)[bad[0]])
        allowed = f"0, or a size from {smallest:g} to {largest:g}" if smallest else f"a size up to {largest:g}"
        raise InputError(f"{what} is {given:g} {unit}".rstrip() + f"; allowed: {allowed}")


def runs_through(first: float, last: float, count: int, t0: float, t1: float) -> FloatArray:
    """Numbers `first` to `last` of the periods, of `count` breakpoints each, that hold the times from t0 to t1 (s).

    Raises
    ------
    InputError
        Where that are more breakpoints than are listed at once.
    """
    total = (last - first + 1.0) * count
    if not total <= MOST_LISTED:
        raise InputError(
            f"the source has {total:.3g} breakpoints from {t0:g} s to {t1:g} s; allowed: at most {MOST_LISTED:.0e} at "
            "once: a shorter run, or a longer period"
        )
    return np.arange(first, last + 1.0)


def in_windows(t: FloatArray, rate: float) -> Iterator[slice | NDArray[np.intp]]:
    """Times (s) in groups that no more than `_WINDOW` breakpoints lie between, of which there are `rate` a second.

    Ten times in a year of square waves are ten windows, and the breakpoints between them are never listed.
    """
    if t.size == 0:
        return
    window = np.floor(t * (rate / _WINDOW))
    if window.min() == window.max():
        yield slice(None)
        return
    order = np.argsort(window, kind="stable")
    yield from np.split(order, np.flatnonzero(np.diff(window[order])) + 1)
