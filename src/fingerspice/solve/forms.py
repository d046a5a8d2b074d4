"""Tables for recordings on a series stack: weights of the exponential Simpson steps, and 1/A as a polynomial.

They depend on the scene, the sample spacing and the error asked for only, so that they are made once for all blocks.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.polynomial import chebyshev as series_of
from numpy.polynomial.polynomial import polyval

from fingerspice.base.arrays import FloatArray
from fingerspice.engine import relaxation
from fingerspice.engine.relaxation import LEVELS, PLACES, Form
from fingerspice.engine.system import System
from fingerspice.numerics import chebyshev
from fingerspice.numerics.moments import weights
from fingerspice.physics.contact import N_PACKED
from fingerspice.solve.problem import Problem
from fingerspice.solve.track import Prepared, prepare_system

# Truncation error allowed for the polynomial of 1/A, relative to the error asked for.
AREA_SHARE = 0.02
# Matrix from values at Chebyshev nodes to the Chebyshev coefficients of the antiderivative of their interpolant.
_POINTS = 40
_AT = np.cos(np.pi * (np.arange(_POINTS) + 0.5) / _POINTS)
_INTEGRAL = series_of.chebint(np.linalg.inv(series_of.chebvander(_AT, _POINTS - 1)))


def _area(system: System, tol: float) -> FloatArray | None:
    """Coefficients of 1/A as a polynomial in the variable of `System`, with a relative error of at most `tol`.

    The degree is a multiple of 4, for the compiled evaluation; None if no degree up to MOST_DEGREE is enough.
    """
    series = np.asarray(system.model.curve[2 + N_PACKED :])
    if not system.scale > 0.0 or series.size < 2:
        return None
    for degree in range(4, min(relaxation.MOST_DEGREE, series.size + 2) + 1, 4):
        if np.abs(series[degree + 1 :]).sum() <= tol * np.abs(series[0]):
            kept = np.zeros(degree + 1)
            kept[: min(series.size, degree + 1)] = series[: degree + 1]
            out = np.empty(degree + 1)
            chebyshev.to_powers(kept, out)
            return out
    return None


def _moved(system: System, area: FloatArray, at_rest: float) -> FloatArray:
    """Part of the charge (C) that is a function of the gap voltage: a polynomial in the variable of 1/A, 0 at 0 V."""
    model, slow, n = system.model, system.model.slow, system.model.gap.size
    if model.mobile:
        return np.zeros(1)
    series = slow[n + 1] * slow[n] / model.k_gap / system.scale * (_INTEGRAL @ (1.0 / polyval(_AT, area)))
    kept = np.ascontiguousarray(series[: np.flatnonzero(np.abs(series) > 1e-16 * np.abs(series).max())[-1] + 1])
    powers = np.empty(kept.size)
    chebyshev.to_powers(kept, powers)
    powers[0] -= polyval(at_rest, powers)
    return powers


def form_of(system: System, area: FloatArray, spacing: float) -> Form:
    """The stack's modes at its reference areas, with weights for steps of one sample spacing and its halvings."""
    model = system.model
    h = spacing / 2.0 ** np.arange(LEVELS)[:, None]
    z = system.rates[:, None, :] * h
    n, slow = model.gap.size, model.slow
    feed, taps, tap_s = system.feed, [system.gap[:, None], system.tap], [model.k_gap, *system.tap_k]
    if model.mobile:
        feed = np.concatenate([feed, system.push[:, :, None] / model.area0], axis=2)
        taps.append(np.zeros((system.q0.size, 1, n)))
        tap_s = [0.0, *system.tap_k, 1.0]
    ratio = 0.0 if model.mobile else slow[n] / model.k_gap
    taps += [(system.slow - ratio * system.gap)[:, None], system.slow[:, None]]
    tap_s += [0.0, 0.0 if model.mobile else slow[n]]
    every, direct = np.concatenate(taps, axis=1), np.array(tap_s)
    gain = system.gain[:, None, :, None] * h[..., None]
    drives = feed[:, None, :, :, None] * h[..., None, None]

    def within(at: float) -> tuple[FloatArray, FloatArray, FloatArray]:
        own = every[:, None] * np.exp(-z * at)[:, :, None]
        of_s = np.einsum("rpk,rskj->rspj", every, gain * weights(z, (0.0, 1.0), at))
        of_s += direct[:, None] * np.array([1.0 - at, at])
        of_g = np.einsum("rpk,rsktj->rsptj", every, drives * weights(z, (0.0, 0.5, 1.0), at)[..., None, :])
        return own, of_s, of_g

    inner, inner_s, inner_g = (
        np.ascontiguousarray(np.stack(x, axis=2)) for x in zip(*map(within, PLACES), strict=True)
    )
    five = (0.0, 0.25, 0.5, 0.75, 1.0)
    quarters, early = (weights(z, five, until)[..., None, [1, 3]] for until in (1.0, 0.5))
    return Form(
        model.mobile, system.q0, system.rates, system.gain, np.exp(-z), gain * weights(z, (0.0, 1.0)),
        drives * weights(z, (0.0, 0.5, 1.0))[..., None, :], np.ascontiguousarray(feed), np.ascontiguousarray(every),
        direct, inner, inner_s, inner_g, np.ascontiguousarray(weights(z, (0.0, 0.5, 1.0))[..., 1:]), drives * quarters,
        np.einsum("rk,rsktj->rstj", system.gap, drives * early), area, system.scale, -system.lo * system.scale - 1.0,
        model.k_gap, model.area0,
    )  # fmt: skip


@dataclass(frozen=True)
class Followed:
    """A scene prepared for recordings, for all tolerances of one decade.

    Attributes
    ----------
    prepared : Prepared
    area : ndarray
        Polynomial of 1/A, see `Form.area`.
    at_rest, q_rest : float
        Variable of that polynomial, and 1/A (1/m^2), at 0 V.
    shown : relaxation.Shown
    """

    prepared: Prepared
    area: FloatArray
    at_rest: float
    q_rest: float
    shown: relaxation.Shown

    @property
    def system(self) -> System:
        return self.prepared.system

    def charge_with(self, u_gap: float) -> float:
        """Part of the charge (C) that is a function of the gap voltage (V)."""
        return math.copysign(float(polyval(abs(u_gap) * self.system.scale + self.at_rest, self.shown.moved)), u_gap)


def followed(problem: Problem, rtol: float) -> Followed | None:
    """The scene prepared for recordings; None where no polynomial represents 1/A well enough."""
    prepared = prepare_system(problem.scene, rtol)
    system = prepared.system
    area = _area(system, AREA_SHARE * rtol)
    if area is None:
        return None
    at_rest = -system.lo * system.scale - 1.0
    q_rest = float(polyval(at_rest, area))
    kink = float(polyval(at_rest, area[1:] * np.arange(1, area.size))) * system.scale
    kinks = np.full(system.tap_k.size, kink)
    if system.model.mobile:
        kinks = np.append(kinks, -kink / q_rest**2)
    shown = relaxation.Shown(
        system.shown, system.k_shown, system.node, system.slow, system.live, system.project, system.stress, kinks,
        -kink / q_rest**2, _moved(system, area, at_rest), problem.charge,
    )  # fmt: skip
    return Followed(prepared, area, at_rest, q_rest, shown)
