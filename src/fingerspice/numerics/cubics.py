"""Integrals of a signal given at times of a run, by cubics through neighbouring values; a repeated time is a jump."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


def mean(t: FloatArray, x: FloatArray) -> float:
    """Mean of x over t, both of shape (n,)."""
    span = t[-1] - t[0]
    if span <= 0.0:
        return float(x[-1])
    cuts = np.flatnonzero(np.diff(t) == 0.0) + 1
    pieces = zip(np.split(t, cuts), np.split(x, cuts), strict=True)
    return float(sum(_integral(a, b) for a, b in pieces) / span)


def _integral(t: FloatArray, x: FloatArray) -> Any:
    """Integral of x over t, exact for cubics; trapezoidal where there are too few points."""
    if t.size < 4:
        return np.trapezoid(x, t)
    first = np.clip(np.arange(t.size - 1) - 1, 0, t.size - 4)
    index = first[:, None] + np.arange(4)
    nodes, values = t[index], x[index]
    half, middle = 0.5 * np.diff(t), 0.5 * (t[1:] + t[:-1])
    total = 0.0
    # Two Gauss points integrate a cubic; Lagrange's form gives it there.
    for at in (middle - half / np.sqrt(3.0), middle + half / np.sqrt(3.0)):
        for i in range(4):
            weight = np.ones(at.size)
            for j in range(4):
                if j != i:
                    weight *= (at - nodes[:, j]) / (nodes[:, i] - nodes[:, j])
            total = total + np.sum(half * weight * values[:, i])
    return total


def fundamental(t: FloatArray, x: FloatArray, frequency: float) -> complex:
    """Complex amplitude P of x ~ Im(P exp(i 2 pi f t)) over the times given, a whole number of periods."""
    phase = 2.0 * np.pi * frequency * t
    # The mean of x exp(-i phase), in its two real parts.
    return 2j * complex(mean(t, x * np.cos(phase)), -mean(t, x * np.sin(phase)))
