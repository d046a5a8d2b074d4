"""How the signals of a run change with a parameter of its circuit."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from fingerspice.base.arrays import FloatArray
from fingerspice.results.record import Sealed, sealed


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

    def __post_init__(self) -> None:
        for array in (self.u_gap, self.area, self.f_el, self.f_t, self.friction):
            sealed(array)

    def __repr__(self) -> str:
        unit = f" {self.unit}" if self.unit else ""
        relative = f"{self.value * self.f_el_mean:.4g} N for a change of 100 %"
        return f"Sensitivity({self.path} = {self.value:g}{unit}: mean force {relative})"


class Tangents(NamedTuple):
    """Changes of the signals with a parameter, shape (n,) each; the gap voltage along the loop."""

    u_gap: FloatArray
    area: FloatArray
    f_el: FloatArray
    f_t: FloatArray
    friction: FloatArray


def tangents_at(
    packed: FloatArray, by_packed: FloatArray, u: FloatArray, area: FloatArray, du: FloatArray, dq: FloatArray
) -> Tangents:
    """Changes of the signals from those of the gap voltage (V) and of 1/A (1/m^2), each per unit of a parameter.

    Gap voltage `u` (V) and `area` (m^2) are the run's own; `packed` is `Contact.packed`, `by_packed` its change.
    """
    stress, f_n, mu = packed[4:7]
    by_stress, by_load, by_mu = by_packed[4:7]
    by_area = -(area**2) * dq
    f_el = stress * u**2 * area
    by_force = by_stress * u**2 * area + stress * u * (2.0 * area * du + u * by_area)
    by_friction = by_mu * (f_n + f_el) + mu * (by_load + by_force)
    coefficient = by_friction / f_n - mu * (f_n + f_el) * by_load / f_n**2
    return Tangents(du, by_area, by_force, by_friction, coefficient)


def sensitivity_of(
    path: str, unit: str, value: float, outputs: Tangents, inside: Tangents, weight: FloatArray, turn: float
) -> Sensitivity:
    """A sensitivity from the changes at the outputs, and those at the steps' nodes with weights whose sum is 1.

    `turn` is -1 where the gap is written against the loop.
    """
    means = (inside.f_el, inside.f_t, inside.friction, inside.area)
    f_el, f_t, friction, area = (float((weight * x).sum()) for x in means)
    return Sensitivity(
        path, unit, value, turn * outputs.u_gap, *outputs[1:],
        f_el_mean=f_el, f_t_mean=f_t, friction_mean=friction, area_mean=area,
    )  # fmt: skip
