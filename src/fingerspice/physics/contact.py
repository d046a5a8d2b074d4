"""Ridge contact area under electroadhesion and friction (Eqs. 1 to 7).

With y = A_R0 / (alpha F_N^m) and p = (1 + 1/m - 1/n) / 2, Eq. 4 is one universal curve per pair of exponents,

    y^(1/m) - X y^p = 1,        X = xi |u_gap|,

and Eqs. 1 and 3 are then a quadratic in A_R. So A_R = g(|u_gap|) is one function of one number per contact.
All functions take and return SI units.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property, partial

import numpy as np
from numpy.typing import ArrayLike

from fingerspice.base.arrays import FloatArray, read_only, real_numbers
from fingerspice.base.compiled import jit, jit_rows
from fingerspice.base.errors import InputError
from fingerspice.numerics import chebyshev
from fingerspice.physics.materials import EPS0

N_PACKED = 8
"""Length of the parameter vector that the compiled functions take."""
# Terms that a curve may have, and its error, relative to the largest 1/A. Of a rough function's: that error, the one of
# any area at the places where it is checked, and terms.
_SIZES, _ERROR, _CHECKED = (32, 48), 2e-15, 1025
_ROUGH = ((1e-12, 1e-10, (96, 192)), (1e-9, 1e-8, (384, 768)), (1e-6, 1e-4, (768,)))
# How far below 0 V the curve of an even function reaches, and where a curve ends before the end of the areas: both over
# the largest voltage.
_EVEN, _BEFORE_END = 0.3, (0.999, 0.99, 0.95)


@dataclass(frozen=True)
class Contact:
    """A fingerpad pressed on a screen across an air gap, in full slip: what all contact laws have.

    Parameters
    ----------
    d : float
        Gap thickness, m.
    eps_r : float
        Relative permittivity of the gap.
    f_n : float
        Applied normal force, N.
    mu : float
        Friction coefficient.
    p_sat : float
        Pressure, Pa, far beyond which the real contact area is the ridge area; without a limit by default.
    """

    d: float
    eps_r: float
    f_n: float
    mu: float
    p_sat: float = field(default=math.inf, kw_only=True)

    @cached_property
    def packed(self) -> FloatArray:
        """Parameters as the compiled functions take them, shape (8,): those of an area that is always that at 0 V."""
        return np.array([0.0, self.area_at_rest, 1.0, *np.zeros(N_PACKED - 3)])

    @cached_property
    def area_at_rest(self) -> float:
        """Ridge contact area without voltage, m^2."""
        return float(self.area(0.0))

    def area(self, u_gap: ArrayLike) -> FloatArray:
        """Ridge contact area in full slip, A_R, m^2, at gap voltage `u_gap` (V)."""
        raise NotImplementedError

    def given(self, u: FloatArray) -> FloatArray:
        """Areas at gap voltages of 0 V or more, (n,); NaN where there is none."""
        return self.area(u)

    def height(self, u_gap: ArrayLike) -> FloatArray | float:
        """Gap height, m, at gap voltage `u_gap` (V): `d`, unless the contact law says otherwise."""
        return self.d

    @property
    def per_volt(self) -> float:
        """Electroadhesive stress across a gap of height `d` at 1 V, Pa."""
        return float(0.5 * EPS0 * self.eps_r / self.d**2)

    def stress(self, u_gap: ArrayLike) -> FloatArray:
        """Electroadhesive stress sigma_el (Eq. 2), Pa, at gap voltage `u_gap` (V)."""
        return np.asarray(self.per_volt * np.asarray(u_gap, float) ** 2 * (self.d / self.height(u_gap)) ** 2)

    def closed(self) -> LawContact:
        """The ridge area times `d` over the gap height, with which the gap's own capacitance and leak scale."""
        return self._followed(partial(_closed, self))

    def leaking(self, exponent: float, load: float) -> LawContact:
        """The gap's conductance over that under a normal force `load` (N): its force over that, to this power."""
        return self._followed(partial(_leaking, self, exponent, load))

    def _followed(self, function: Callable[[FloatArray, Mapping[str, float]], ArrayLike]) -> LawContact:
        return LawContact(self.d, self.eps_r, self.f_n, self.mu, "of the GAP", function, {})

    def reach(self, u_max: float) -> float:
        """The gap voltage (V) up to which there is an area, at most `u_max`."""
        return u_max

    def curve(self, u_max: float) -> FloatArray:
        """1/A_R as one Chebyshev series over |u_gap| <= `u_max` (V), for `inverse_area`.

        The series reaches a little past the kink at 0 V on its analytic continuation, so that a step across the kink
        stays smooth.
        """
        raise NotImplementedError


def _closed(contact: Contact, u: FloatArray, _: Mapping[str, float]) -> FloatArray:
    return contact.given(u) * contact.d / contact.height(u)


def _leaking(contact: Contact, exponent: float, load: float, u: FloatArray, _: Mapping[str, float]) -> FloatArray:
    return np.asarray(((contact.f_n + contact.stress(u) * contact.given(u)) / load) ** exponent)


@dataclass(frozen=True)
class JkrContact(Contact):
    """The paper's contact (Eqs. 1 to 7, Table 1).

    Parameters
    ----------
    d, eps_r, f_n, mu
        As of a `Contact`.
    alpha, m : float
        Ridge area against normal force, A = alpha F^m (Eq. 5); alpha in m^2/N^m.
    beta, n : float
        Ridge area against indentation, A = beta delta^n (Eq. 6); beta in m^(2-n).
    c2 : float
        Loss of area under tangential load (Eq. 3), m^4/N^2.
    work_ratio : float
        Work of adhesion over sigma d: 1 with the gap voltage held (default), k of `total_work_ratio`
        with the total voltage held.
    """

    alpha: float
    m: float
    beta: float
    n: float
    c2: float
    work_ratio: float = 1.0

    @property
    def area_unloaded(self) -> float:
        """Ridge area without voltage and friction, alpha F_N^m (Eq. 5), m^2."""
        return float(self.alpha * self.f_n**self.m)

    @property
    def exists(self) -> bool:
        """Whether friction leaves an area at 0 V: A0^2 > c2 mu^2 F_N^2."""
        return self.area_unloaded**2 > self.c2 * (self.mu * self.f_n) ** 2

    @cached_property
    def packed(self) -> FloatArray:
        """Parameters as the compiled functions take them, shape (8,), SI."""
        p = 0.5 * (1.0 + 1.0 / self.m - 1.0 / self.n)
        area = self.area_unloaded
        # Eq. 4 divided by F_N; w = sigma d k = eps0 eps_r k u^2 / (2 d), so X is proportional to |u|.
        log_x2 = (
            math.log(EPS0 * self.eps_r * self.work_ratio / self.d)
            + math.log(self.n**2 / (self.n - self.m))
            + math.log(self.beta) / self.n
            - math.log(self.alpha) / self.m
            + 2.0 * p * math.log(area)
            - 2.0 * math.log(self.f_n)
        )
        stress = 0.5 * EPS0 * self.eps_r / self.d**2
        return np.array(
            [math.exp(0.5 * log_x2), area, 1.0 / self.m, p, stress, self.f_n, self.mu, self.c2 * self.mu**2]
        )

    def area(self, u_gap: ArrayLike) -> FloatArray:
        """Ridge contact area in full slip, A_R (Eqs. 1 to 4), m^2, at gap voltage `u_gap` (V)."""
        u = np.abs(np.asarray(u_gap, float))
        return np.asarray(ridge_area_array(u.ravel(), self.packed)).reshape(u.shape)

    def area_adhesive(self, u_gap: ArrayLike) -> FloatArray:
        """Ridge contact area under normal load alone, A_R0 (Eq. 4), m^2, at gap voltage `u_gap` (V)."""
        packed = self.packed
        x = packed[0] * np.abs(np.asarray(u_gap, float))
        return packed[1] * universal_curve_array(x.ravel(), packed[2], packed[3]).reshape(x.shape)  # type: ignore[no-any-return]

    def with_total_voltage_held(self, d: ArrayLike, eps_r: ArrayLike) -> JkrContact:
        """The same contact with w at total voltage held (Eq. 7, capacitive stack of layers d, eps_r)."""
        thickness = float(np.sum(np.asarray(d, float) / np.asarray(eps_r, float)))
        return replace(self, work_ratio=thickness / (self.d / self.eps_r))

    def curve(self, u_max: float) -> FloatArray:
        """As of a `Contact`; without a short series that reaches rounding the exact solution is used instead."""
        # The continuation exists while 1 + x y^p > 0; x = -0.2 is well inside for every legal exponent pair.
        lo, packed = -min(0.3 * u_max, 0.2 / float(self.packed[0])), self.packed
        with np.errstate(all="ignore"):
            series = chebyshev.fit(lambda u: 1.0 / ridge_area_array(u, packed), lo, u_max, _ERROR, _SIZES)
        return np.concatenate([[lo, u_max], packed, () if series is None else series])


@dataclass(frozen=True)
class LawContact(Contact):
    """A contact whose area is a function of the gap voltage that someone gives.

    Parameters
    ----------
    d, eps_r, f_n, mu
        As of a `Contact`.
    law : str
        Name of the function, for messages.
    function : callable
        Ridge area, m^2, shape (n,), at gap voltages of 0 V or more, shape (n,), and with `values`.
    values : mapping
        Its parameters by name.
    gap : callable, optional
        Gap height, m, likewise; `d` by default.
    """

    law: str
    function: Callable[[FloatArray, Mapping[str, float]], ArrayLike]
    values: Mapping[str, float]
    gap: Callable[[FloatArray, Mapping[str, float]], ArrayLike] | None = None

    def height(self, u_gap: ArrayLike) -> FloatArray | float:
        """As of a `Contact`."""
        u = np.abs(np.asarray(u_gap, float))
        return self.d if self.gap is None else np.asarray(self.gap(u.ravel(), dict(self.values))).reshape(u.shape)

    def given(self, u: FloatArray) -> FloatArray:
        """The function's areas at gap voltages of 0 V or more, (n,); NaN for those that are no positive number."""
        with np.errstate(all="ignore"):
            found = self.function(u.copy(), dict(self.values))
        area = real_numbers(f"the area of the contact law {self.law}", found, "real numbers, shape (n,)")
        if area.shape != u.shape:
            said = f"the contact law {self.law} gives areas of shape {area.shape} at {u.size} gap voltages"
            raise InputError(f"{said}; allowed: one for each of the voltages (n,), in m^2")
        return np.where((area > 0.0) & (area < math.inf), area, math.nan)

    @cached_property
    def digest(self) -> str:
        """What tells two laws of one name apart: their areas at some gap voltages, to nine digits."""
        return " ".join(f"{x:.9g}" for x in self.given(np.linspace(0.0, 1000.0, 129)).tolist())

    def area(self, u_gap: ArrayLike) -> FloatArray:
        """Ridge contact area, m^2, at gap voltage `u_gap` (V).

        Raises
        ------
        InputError
            Where the function's area is no positive number.
        """
        u = np.abs(np.asarray(u_gap, float))
        area = self.given(u.ravel()).reshape(u.shape)
        if np.isnan(area).any():
            said = f"the contact law {self.law} has no area above 0 at {u[np.isnan(area)].min():.4g} V across the gap"
            raise InputError(f"{said}; allowed: a smaller source, or a law that reaches further")
        return area

    def ends(self, known: float) -> str:
        """The message about a gap voltage (V) that passes the largest one whose areas are known."""
        said = f"the gap voltage passes {known:.4g} V, up to which areas of the contact law {self.law} are known"
        if self.gap is not None:
            said = f"{said}: beyond it the gap closes (pull-in)"
        return f"{said}; allowed: a smaller source, or a law that reaches further"

    def reach(self, u_max: float) -> float:
        """The gap voltage (V) up to which there is an area, at most `u_max`."""
        u = np.linspace(0.0, u_max, 65)
        none = np.flatnonzero(np.isnan(self.given(u)))
        if not none.size:
            return u_max
        low, high = u[max(none[0] - 1, 0)], u[none[0]]
        while low < (middle := 0.5 * (low + high)) < high:
            low, high = (low, middle) if np.isnan(self.given(np.array([middle]))[0]) else (middle, high)
        return float(low)

    def curve(self, u_max: float) -> FloatArray:
        """As of a `Contact`, as far as there are areas; of a rough function as exact as 768 terms make it.

        Raises
        ------
        InputError
            If these do not give 1e-4 of every area, and without an area at 0 V.
        """
        reach = self.reach(u_max)
        # Where the areas end, their slope may have none: the curve then ends a little before.
        shares, missed = _BEFORE_END if reach < u_max else (1.0,), math.inf
        for share in shares:
            hi = share * reach
            between = np.linspace(0.0, hi, _CHECKED)
            areas = self.area(between)
            for error, allowed, sizes in ((_ERROR, 1e-11, _SIZES), *_ROUGH):
                # An even function is its own continuation.
                for lo in (-_EVEN * hi, 0.0):
                    series = chebyshev.fit(lambda u: 1.0 / self.area(u), lo, hi, error, sizes)
                    if series is not None:
                        at = 2.0 * (between - lo) / (hi - lo) - 1.0
                        missed = float(np.abs(np.polynomial.chebyshev.chebval(at, series) * areas - 1.0).max())
                        if missed <= allowed:
                            return _continued(lo, hi, series, self.packed)
        said = f"the contact law {self.law} is too rough up to {reach:.4g} V: {_ROUGH[-1][-1][-1]} terms miss some area"
        raise InputError(f"{said} by {min(missed, 1.0):.2g}; allowed: 1e-4, so areas without jumps and in usual units")


def _continued(lo: float, hi: float, series: FloatArray, packed: FloatArray) -> FloatArray:
    """A curve of a series; one that begins at 0 V is the same polynomial from a little below on."""
    if lo == 0.0:
        # There a term of degree n grows within 1/n^2 of the range.
        lo = -min(_EVEN, 1.0 / series.size**2) * hi
        at = 2.0 * chebyshev.nodes(series.size, lo, hi) / hi - 1.0
        series = chebyshev.coefficients(np.asarray(np.polynomial.chebyshev.chebval(at, series), float))
    return np.concatenate([[lo, hi], packed, series])


def fixed_area_curve(area: float) -> FloatArray:
    """The curve of an area that does not depend on the voltage, `area` in m^2, for `inverse_area`."""
    return np.concatenate([[-math.inf, math.inf], np.zeros(N_PACKED), [1.0 / area]])


@jit
def universal_curve(x: float, inv_m: float, p: float) -> float:
    """Root y of y^(1/m) - x y^p = 1 for one x (no unit); analytic through x = 0, so small x < 0 are allowed.

    Newton on f(L) = L/m - log(1 + x e^(pL)), L = ln y. For x > 0, f is concave and rising (legal exponents), so
    from the left of the root the iteration is monotone: no safeguard is needed. Both starting values are left of it.
    """
    log_y = 0.0
    if x > 1.0:
        log_y = math.log(x) / (inv_m - p)
    for _ in range(60):
        if x > 1.0:
            # log(1 + x e^(pL)) without overflow: the exponential dominates here.
            e = math.exp(-p * log_y) / x
            share = 1.0 / (1.0 + e)
            value = inv_m * log_y - (math.log(x) + p * log_y + math.log1p(e))
        else:
            e = x * math.exp(p * log_y)
            share = e / (1.0 + e)
            value = inv_m * log_y - math.log1p(e)
        step = value / (inv_m - p * share)
        log_y -= step
        if abs(step) <= 1e-16 + 2e-16 * abs(log_y):
            break
    return math.exp(log_y)


@jit
def ridge_area(u: float, contact: FloatArray) -> float:
    """A_R (m^2) at gap voltage u >= 0 (V); a small u < 0 gives the analytic continuation through the kink."""
    a0 = contact[1] * universal_curve(contact[0] * u, contact[2], contact[3])
    sigma = contact[4] * u * u
    f_n = contact[5]
    k = contact[7] / a0
    # k s^2 A^2 + (1 + 2 k F s) A - (A0 - k F^2) = 0, in the form that is stable as s -> 0.
    b = 1.0 + 2.0 * k * f_n * sigma
    root = math.sqrt(1.0 + 4.0 * k * sigma * (f_n + sigma * a0))
    area: float = 2.0 * (a0 - k * f_n * f_n) / (b + root)
    return area


@jit
def ridge_area_array(u: FloatArray, contact: FloatArray) -> FloatArray:
    """`ridge_area` over an array, shape (n,)."""
    out = np.empty_like(u)
    for i in range(u.size):
        out[i] = ridge_area(u[i], contact)
    return out


@jit
def ridge_area_rows(u: FloatArray, contacts: FloatArray) -> FloatArray:
    """`ridge_area` over an array, shape (n,), each with its own contact, shape (n, 8)."""
    out = np.empty_like(u)
    for i in range(u.size):
        out[i] = ridge_area(u[i], contacts[i])
    return out


@jit
def universal_curve_array(x: FloatArray, inv_m: float, p: float) -> FloatArray:
    """`universal_curve` over an array, shape (n,)."""
    out = np.empty_like(x)
    for i in range(x.size):
        out[i] = universal_curve(x[i], inv_m, p)
    return out


@jit
def inverse_area(u: float, curve: FloatArray) -> tuple[float, float]:
    """1/A_R (1/m^2) and its slope (1/(m^2 V)) at gap voltage u >= 0 (V), or a little below on the continuation."""
    n = curve.size - 2 - N_PACKED
    if n == 1:
        return curve[-1], 0.0
    lo = curve[0]
    hi = curve[1]
    # Where none was found, but those of other areas are kept beside it, zeros stand in the series' place.
    if n > 1 and lo <= u <= hi and curve[2 + N_PACKED] > 0.0:
        scale = 2.0 / (hi - lo)
        value, slope = chebyshev.evaluate(curve[2 + N_PACKED :], (u - lo) * scale - 1.0)
        return value, slope * scale
    area, slope = _ridge_area_slope(u, curve[2 : 2 + N_PACKED])
    return 1.0 / area, -slope / (area * area)


def inverse_areas(u: FloatArray, curve: FloatArray) -> FloatArray:
    """1/A_R (1/m^2) at gap voltages |u| (V), shape (n,), from a `Contact.curve`."""
    u = read_only(np.ascontiguousarray(u))
    lo, hi, series = float(curve[0]), float(curve[1]), curve[2 + N_PACKED :]
    if series.size == 1:
        return np.full(u.shape, series[0])
    if series.size and series[0] > 0.0 and max(u.max(initial=0.0), -u.min(initial=0.0)) <= hi:
        out = np.empty(u.size)
        chebyshev.evaluate_array(series, u, lo, 2.0 / (hi - lo), out)
        return out
    return np.asarray(inverse_area_array(np.abs(u), curve)[0])


def inverse_areas_with_slopes(u: FloatArray, curve: FloatArray) -> tuple[FloatArray, FloatArray]:
    """1/A_R (1/m^2) and its slope by |u| (1/(m^2 V)) at gap voltages |u| (V), shape (n,), from a `Contact.curve`."""
    q, series = inverse_areas(u, curve), curve[2 + N_PACKED :]
    if series.size < 2 or not series[0] > 0.0 or np.abs(u).max(initial=0.0) > curve[1]:
        return q, inverse_area_array(np.abs(u), curve)[1]
    slope, scale = np.empty(u.size), 2.0 / float(curve[1] - curve[0])
    by_u = np.asarray(scale * np.polynomial.chebyshev.chebder(series), float)
    chebyshev.evaluate_array(by_u, read_only(np.ascontiguousarray(u)), float(curve[0]), scale, slope)
    return q, slope


def forces(u: FloatArray, curve: FloatArray, stress: float) -> FloatArray:
    """Force (N) at gap voltages u (V), shape (n,), from a `Contact.curve` and the stress at 1 V, Pa."""
    out = inverse_areas(u, curve)
    _force_from_inverse(read_only(u), stress, out)
    return out


@jit_rows
def _force_from_inverse(u: FloatArray, stress: float, out: FloatArray) -> None:
    # In place and in one pass: fresh memory costs more than arithmetic.
    for i in range(u.size):
        out[i] = stress * (u[i] * u[i]) / out[i]


def areas(u: FloatArray, curve: FloatArray) -> FloatArray:
    """A_R (m^2) at gap voltages |u| (V), shape (n,), from a `Contact.curve`."""
    q = inverse_areas(u, curve)
    return np.divide(1.0, q, out=q)


@jit
def inverse_area_range(u_max: float, points: int, curve: FloatArray) -> tuple[float, float]:
    """Smallest and largest 1/A_R (1/m^2) at so many gap voltages from 0 to `u_max` (V)."""
    least, largest = math.inf, 0.0
    for i in range(points):
        q = inverse_area(u_max * i / (points - 1), curve)[0]
        least, largest = min(least, q), max(largest, q)
    return least, largest


@jit
def inverse_area_array(u: FloatArray, curve: FloatArray) -> tuple[FloatArray, FloatArray]:
    """`inverse_area` over an array, shape (n,)."""
    q = np.empty_like(u)
    slope = np.empty_like(u)
    for i in range(u.size):
        q[i], slope[i] = inverse_area(u[i], curve)
    return q, slope


@jit
def _ridge_area_slope(u: float, contact: FloatArray) -> tuple[float, float]:
    """A_R (m^2) and dA_R/du (m^2/V): `ridge_area` differentiated."""
    x = contact[0] * u
    y = universal_curve(x, contact[2], contact[3])
    a0 = contact[1] * y
    power = y ** contact[3]
    # From y^(1/m) - x y^p = 1, with e = y^p / y^(1/m): d ln y / dx = e / (1/m - p x e).
    e = power / (1.0 + x * power)
    a0_slope = a0 * contact[0] * e / (contact[2] - contact[3] * x * e)
    sigma = contact[4] * u * u
    area = ridge_area(u, contact)
    load = contact[5] + sigma * area
    k = contact[7] / a0
    # From A = A0 - (c2 mu^2 / A0) (F + sigma A)^2.
    rise = a0_slope * (1.0 + contact[7] * (load / a0) ** 2) - 4.0 * k * load * area * contact[4] * u
    return area, rise / (1.0 + 2.0 * k * sigma * load)
