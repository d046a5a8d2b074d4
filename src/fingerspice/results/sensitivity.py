"""How the signals of a run change with a parameter of its circuit."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from fingerspice.base.arrays import FloatArray
from fingerspice.engine.model import Model
from fingerspice.engine.tangent import Changes, inverse_area_slopes
from fingerspice.physics.contact import N_PACKED
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


class Places(NamedTuple):
    """Places of a run along the loop, shape (n,) each: gap and source voltage (V), and what a parameter moves there.

    `moved` is the change of the source, `x_gap` that of the gap's part of the state (`engine.tangent`), V per unit.
    """

    u: FloatArray
    s: FloatArray
    moved: FloatArray
    x_gap: FloatArray


class Tangents(NamedTuple):
    """Changes of the signals with a parameter, shape (n,) each; the gap voltage along the loop."""

    u_gap: FloatArray
    area: FloatArray
    f_el: FloatArray
    f_t: FloatArray
    friction: FloatArray


def tangents_at(model: Model, packed: FloatArray, changes: Changes, i: int, at: Places) -> Tangents:
    """Changes of the signals at places of a run by parameter number `i`; `packed` as in `Contact.packed`."""
    q, slopes = np.empty(at.u.size), np.empty((at.u.size, 1 + N_PACKED))
    inverse_area_slopes(np.abs(at.u), packed, 1.0, q, slopes)
    slope, by_contact = np.sign(at.u) * slopes[:, 0], slopes[:, 1:] @ changes.contact[i]
    du = changes.k_gap[i] * at.s + model.k_gap * at.moved
    if model.mobile:
        own = (at.u - model.k_gap * at.s) / q
        du = (du + q * at.x_gap + own * by_contact) / (1.0 - own * slope)
    else:
        du = du + at.x_gap
    area = 1.0 / q
    by_area = -(area**2) * (slope * du + by_contact)
    stress, f_n, mu = packed[4:7]
    by_stress, by_load, by_mu = changes.contact[i, 4:7]
    f_el = stress * at.u**2 * area
    by_force = by_stress * at.u**2 * area + stress * at.u * (2.0 * area * du + at.u * by_area)
    f_t = mu * (f_n + f_el)
    by_friction = by_mu * (f_n + f_el) + mu * (by_load + by_force)
    return Tangents(du, by_area, by_force, by_friction, by_friction / f_n - f_t * by_load / f_n**2)


def sensitivity_of(
    path: str, unit: str, value: float, outputs: Tangents, inside: Tangents, weight: FloatArray, turn: float
) -> Sensitivity:
    """A sensitivity from the changes at the outputs, and those at the steps' nodes with weights whose sum is 1.

    `turn` is -1 where the gap is written against the loop.
    """
    f_el, f_t, friction, area = (
        float((weight * x).sum()) for x in (inside.f_el, inside.f_t, inside.friction, inside.area)
    )
    return Sensitivity(
        path, unit, value, turn * outputs.u_gap, *outputs[1:],
        f_el_mean=f_el, f_t_mean=f_t, friction_mean=friction, area_mean=area,
    )  # fmt: skip
