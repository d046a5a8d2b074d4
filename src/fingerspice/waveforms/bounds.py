"""Limits of a source: the range of its numbers, and how many of its breakpoints are handled at once."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fingerspice.base.arrays import FloatArray
from fingerspice.base.errors import InputError

#: Largest and smallest absolute value allowed of a nonzero number, by unit (the entry V also serves A).
RANGES = {"V": (1e12, 0.0), "deg": (1e9, 0.0)}
#: The same limits for all other units.
ANY_RANGE = (1e30, 1e-30)
#: Largest number of breakpoints listed at once; each takes about 40 bytes, the arrays computed from it included.
MOST_LISTED = 20_000_000
#: Number of breakpoints in a window of time; the values at all times in one window are looked up together.
_WINDOW = 1_000_000


def check_range(what: str, values: ArrayLike, unit: str) -> None:
    """Refuse finite numbers so large or so small that their products and quotients would overflow or underflow."""
    largest, smallest = RANGES.get(unit, ANY_RANGE)
    size = np.abs(values)
    bad = np.flatnonzero(np.isfinite(size) & (((size < smallest) & (size > 0.0)) | (size > largest)))
    if bad.size:
        given = float(np.ravel(values)[bad[0]])
        allowed = f"0, or a size from {smallest:g} to {largest:g}" if smallest else f"a size up to {largest:g}"
        raise InputError(f"{what} is {given:g} {unit}".rstrip() + f"; allowed: {allowed}")


def runs_through(first: float, last: float, count: int, t0: float, t1: float) -> FloatArray:
    """Indices of the periods `first` to `last`, which cover t0 to t1 (s); each has `count` breakpoints.

    More than `MOST_LISTED` breakpoints are refused.
    """
    total = (last - first + 1.0) * count
    if not total <= MOST_LISTED:
        raise InputError(
            f"the source has {total:.3g} breakpoints from {t0:g} s to {t1:g} s; allowed: at most {MOST_LISTED:.0e} at "
            "once: a shorter run, or a longer period"
        )
    return np.arange(first, last + 1.0)


def in_windows(t: FloatArray, rate: float) -> Iterator[slice | NDArray[np.intp]]:
    """Indices of the times (s), grouped by windows that hold `_WINDOW` breakpoints at `rate` breakpoints per second.

    The windows save memory: for the values at ten times in a year of square waves the breakpoints of at most ten
    windows are listed, instead of all breakpoints of the year.
    """
    if t.size == 0:
        return
    window = np.floor(t * (rate / _WINDOW))
    if window.min() == window.max():
        yield slice(None)
        return
    order = np.argsort(window, kind="stable")
    yield from np.split(order, np.flatnonzero(np.diff(window[order])) + 1)
