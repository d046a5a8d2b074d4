"""Integrals of decaying exponentials times powers, the weights of inputs between samples."""

from __future__ import annotations

import math

from fingerspice.base.arrays import FloatArray
from fingerspice.base.compiled import jit

# Beyond, each moment follows from the one below; before, that would lose digits, and they follow from the highest.
_LATE = 4.0


@jit
def moments(z: float, out: FloatArray) -> None:
    """Integrals of exp(-z (1 - x)) x^j over [0, 1] for z >= 0 into `out` (count,), j from 0; to a few roundings."""
    count = out.size
    if z > _LATE:
        out[0] = -math.expm1(-z) / z
        for j in range(1, count):
            out[j] = (1.0 - j * out[j - 1]) / z
        return
    # exp(-z) sum of z^k / (k! (k + count)): all terms are positive, and once one is small the next are smaller.
    total, term, k = 0.0, 1.0, 0.0
    while term > 1e-17 * total:
        total += term / (k + count)
        k += 1.0
        term *= z / k
    out[count - 1] = math.exp(-z) * total
    for j in range(count - 1, 0, -1):
        out[j - 1] = (1.0 - z * out[j]) / j
