"""The rise with which a drive begins, and means of its force over the periods of a carrier."""

from __future__ import annotations

import numpy as np

from fingerspice.base.arrays import FloatArray


def rise(count: int) -> FloatArray:
    """A rise from 0 to 1 (left out) in `count` steps, with zero first and second derivative at both ends."""
    x = np.arange(count) / max(count, 1)
    return np.asarray(x**3 * (10.0 - 15.0 * x + 6.0 * x * x))


def means(fine: FloatArray, rate: float, edges: FloatArray) -> FloatArray:
    """Means between `edges` (s), by Simpson's rule, of values at samples of a rate (Hz) and midway between them."""
    parts = (fine[:-2:2] + 4.0 * fine[1::2] + fine[2::2]) / (6.0 * rate)
    total = np.append(0.0, np.cumsum(parts))
    return np.asarray(np.diff(np.interp(edges, np.arange(total.size) / rate, total)) / np.diff(edges))
