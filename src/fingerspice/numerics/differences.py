"""Fourth-order central differences of closed formulas."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fingerspice.base.arrays import FloatArray

AT = (-2.0, -1.0, 1.0, 2.0)
"""Where a function is evaluated, in steps."""
STEP = 3e-4
"""Step relative to the argument, or to its scale, at which truncation and rounding are both about 1e-12."""
_WEIGHTS = (1.0 / 12.0, -8.0 / 12.0, 8.0 / 12.0, -1.0 / 12.0)


def derivative(values: Sequence[FloatArray | float], step: float) -> FloatArray:
    """Derivative from the values at `AT` times a step."""
    total = sum(weight * np.asarray(one, float) for weight, one in zip(_WEIGHTS, values, strict=True))
    return np.asarray(total / step)
