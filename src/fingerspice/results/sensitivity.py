"""How the signals of a run change with a parameter of its circuit, and a number with the samples of its source."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fingerspice.base.arrays import FloatArray
from fingerspice.results.record import Sealed

#: Signals and means that have derivatives.
SIGNALS = ("u_gap", "area", "f_el", "f_t", "friction")
MEANS = ("f_el_mean", "f_t_mean", "friction_mean", "area_mean")


@dataclass(frozen=True, repr=False)
class Sensitivity(Sealed):
    """Derivatives of a run's signals and means by one parameter, in the unit of the signal per unit of the parameter.

    Attributes
    ----------
    path, unit : str
        The parameter, as in `Circuit.parameters`, and its unit in the netlist.
    value : float
        Of the parameter, in that unit.
    u_gap, area, f_el, f_t, friction : ndarray, shape (n_t,)
        Derivatives of the signals of the same names at `Solution.t`.
    f_el_mean, f_t_mean, friction_mean, area_mean : float
        Derivatives of the means over the run, from TSTART to its end.
    """

    path: str
    unit: str
    value: float
    u_gap: FloatArray
    area: FloatArray
    f_el: FloatArray
    f_t: FloatArray
    friction: FloatArray
    f_el_mean: float
    f_t_mean: float
    friction_mean: float
    area_mean: float

    def __repr__(self) -> str:
        unit = f" {self.unit}" if self.unit else ""
        relative = f"{self.value * self.f_el_mean:.4g} N for a change of 100 %"
        return f"Sensitivity({self.path} = {self.value:g}{unit}: mean force {relative})"


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

    def __repr__(self) -> str:
        largest = float(np.abs(self.values).max(initial=0.0))
        return (
            f"SampleGradient({self.source}: {self.values.size} samples, largest {largest:.4g}, error {self.error:.1g})"
        )
