"""How a number that follows from a run changes with every sample of its source."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fingerspice.base.arrays import FloatArray
from fingerspice.results.record import Sealed, sealed


@dataclass(frozen=True, repr=False)
class SampleGradient(Sealed):
    """Derivatives of a number by the samples of a source; see `Solution.sample_gradient`.

    Attributes
    ----------
    source : str
        Name of the source.
    rate, start : float
        Samples per second, and the time of the first sample, s.
    values : ndarray, shape (n_sample,)
        Derivatives, in the unit of the number per volt.
    error : float
        Error of each of them that is stated, in the same unit.
    """

    source: str
    rate: float
    start: float
    values: FloatArray
    error: float

    def __post_init__(self) -> None:
        sealed(self.values)

    def __repr__(self) -> str:
        largest = float(np.abs(self.values).max(initial=0.0))
        return (
            f"SampleGradient({self.source}: {self.values.size} samples, largest {largest:.4g}, error {self.error:.1g})"
        )
