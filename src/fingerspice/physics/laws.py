"""Ridge areas by other laws than the paper's, at gap voltages of 0 V or more; SI units."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from fingerspice.base.arrays import FloatArray
from fingerspice.physics.materials import EPS0

if TYPE_CHECKING:
    from fingerspice.physics.contact import Contact

Values = Mapping[str, Any]
_FRICTION = math.sqrt(math.pi / 8.0)  # Over mu p_sat A_real, by which it is mu times the load where A_real is small


def stress(u: FloatArray, v: Values) -> FloatArray:
    """Electroadhesive stress sigma_el (Eq. 2), Pa, from the gap's `d` (m) and `eps_r`."""
    return np.asarray(0.5 * EPS0 * v["eps_r"] * (u / v["d"]) ** 2)


def root(residual: Callable[..., ArrayLike], low: ArrayLike, high: ArrayLike, *values: ArrayLike) -> FloatArray:
    """The root between `low` and `high` of ``residual(x, *values)``, to rounding; all are broadcast, NaN without one.

    By Chandrupatla (Adv. Eng. Softw. 28, 145, 1997), to the bits of `scipy.optimize.elementwise.find_root`, whose own
    account of the elements took nine tenths of a run under such a law.
    """
    a, b, *given = np.broadcast_arrays(*(np.asarray(x, float) for x in (low, high, *values)))
    f_a, f_b = (np.asarray(residual(x, *given)) for x in (a, b))
    # The root lies between a, the newest of the points, and b; c is the third.
    c, f_c, found, sought = a, f_a, np.full(a.shape, math.nan), np.sign(f_a) * np.sign(f_b) <= 0.0
    with np.errstate(divide="ignore", invalid="ignore"):
        while np.any(sought):
            best, length = np.where(np.abs(f_a) < np.abs(f_b), a, b), np.abs(b - a)
            least = 4e-16 * np.abs(best)
            met = sought & ((f_a == 0.0) | (f_b == 0.0) | (length <= least))
            found, sought = np.where(met, best, found), sought & ~met & ~(np.isnan(f_a) & np.isnan(f_b))
            xi, phi = (a - b) / (c - b), (f_a - f_b) / (f_c - f_b)
            share = f_a / (f_b - f_a) * f_c / (f_b - f_c) + (c - a) / (b - a) * f_a / (f_c - f_a) * f_b / (f_c - f_b)
            curved, edge = (phi**2 < xi) & ((1.0 - phi) ** 2 < 1.0 - xi), 0.5 * least / length
            x = a + np.where(curved, np.clip(share, edge, 1.0 - edge), 0.5) * (b - a)
            f_x = np.asarray(residual(x, *given))
            beyond = np.sign(f_x) == np.sign(f_a)
            c, f_c = np.where(beyond, a, b), np.where(beyond, f_a, f_b)
            b, f_b = np.where(beyond, b, a), np.where(beyond, f_b, f_a)
            a, f_a = x, f_x
    return found


def real_area(contact: Contact, f_el: ArrayLike, area: ArrayLike) -> FloatArray:
    """Real contact area, m^2, under an electroadhesive force (N) on a ridge area (m^2); 0 without `p_sat`."""
    return _real_area(contact.f_n + np.asarray(f_el), np.asarray(area), contact.p_sat)


def friction(contact: Contact, f_el: ArrayLike, area: ArrayLike = math.nan) -> FloatArray:
    """Friction force, N, likewise: mu (F_N + F_el) (Eq. 1), and with `p_sat` in proportion to the real area."""
    if math.isinf(contact.p_sat):
        return np.asarray(contact.mu * (contact.f_n + np.asarray(f_el)))
    return _FRICTION * contact.mu * contact.p_sat * real_area(contact, f_el, area)


def _real_area(load: FloatArray, area: FloatArray, p_sat: FloatArray | float) -> FloatArray:
    """A erf(sqrt(2) N / (A p_sat)) (Persson 2001), where p_sat is the modulus times the rms slope of the asperities."""
    from scipy.special import erf

    return np.asarray(area * erf(math.sqrt(2.0) * load / (area * p_sat)))


def dmt(u: FloatArray, v: Values) -> FloatArray:
    """Eq. 5 under the load with the attraction, N = F_N + sigma A: a Derjaguin-Muller-Toporov contact."""
    alpha, m, load, sigma = v["alpha"], v["m_exp"], v["fn"], stress(u, v)

    def missing(n: FloatArray, s: FloatArray, alpha: FloatArray, m: FloatArray, load: FloatArray) -> FloatArray:
        return n - s * alpha * n**m - load

    # Left of the root the load is too small for its area, and right of both of these too large.
    high = np.maximum(2.0 * load, (2.0 * sigma * alpha) ** (1.0 / (1.0 - m)))
    return np.asarray(alpha * root(missing, load, high, sigma, alpha, m, load) ** m)


def linear(u: FloatArray, v: Values) -> FloatArray:
    """An area in proportion to the load with the attraction, up to a largest one, as in Persson's theory.

    A = a_max erf(sqrt(pi)/2 slope N / a_max), N = F_N + sigma A.
    """
    from scipy.special import erf

    most, load, per_load = v["a_max"], v["fn"], 0.5 * np.sqrt(np.pi) * v["slope"] / v["a_max"]

    def missing(a: FloatArray, s: FloatArray, most: FloatArray, load: FloatArray, per: FloatArray) -> FloatArray:
        return np.asarray(most * erf(per * (load + s * a)) - a)

    return root(missing, 0.0, most, stress(u, v), most, load, per_load)


def paper_constants(v: Values) -> tuple[FloatArray, FloatArray]:
    """X at 1 V (see `fingerspice.physics.contact`) and the area A0 = alpha F_N^m (Eq. 5) of the paper's law."""
    m, n, area = v["m_exp"], v["n_exp"], v["alpha"] * np.asarray(v["fn"]) ** v["m_exp"]
    p, per_volt = 0.5 * (1.0 + 1.0 / m - 1.0 / n), EPS0 * v["eps_r"] / v["d"]
    x = np.sqrt(per_volt * (n * n / (n - m)) * v["beta"] ** (1.0 / n) * v["alpha"] ** (-1.0 / m)) * area**p / v["fn"]
    return x, area


def two_scales(u: FloatArray, v: Values) -> FloatArray:
    """Eqs. 1 and 4 with friction in proportion to the real contact area, F_T = sqrt(pi/8) mu p_sat A_real.

    A = A0 - (c2 / A0) F_T^2, and F_T grows with A, so that there is one root.
    """

    def missing(a: FloatArray, most: FloatArray, s: FloatArray, load: FloatArray, c: FloatArray, p: FloatArray) -> Any:
        return a - most + c / most * (p * _real_area(load + s * a, a, p)) ** 2

    adhesive, loss = paper(u, {**v, "c2": 0.0}), v["c2"] * (_FRICTION * np.asarray(v["mu"])) ** 2
    return root(missing, 1e-9 * adhesive, adhesive, adhesive, stress(u, v), v["fn"], loss, v["p_sat"])


_PAPERS = ("d", "eps_r", "fn", "mu", "alpha", "m_exp", "beta", "n_exp", "c2")


def paper(u: FloatArray, v: Values) -> FloatArray:
    """Eqs. 1 to 4 at values that may differ from one gap voltage to the next."""
    from fingerspice.physics.contact import ridge_area_rows

    x, at_rest = paper_constants(v)
    m, n, mu = (np.asarray(v[name]) for name in ("m_exp", "n_exp", "mu"))
    own = x, at_rest, 1.0 / m, 0.5 * (1.0 + 1.0 / m - 1.0 / n), stress(np.ones(1), v), v["fn"], mu, v["c2"] * mu**2
    *rows, u = np.broadcast_arrays(*own, u)
    return np.asarray(ridge_area_rows(u.ravel(), np.stack([row.ravel() for row in rows], axis=1)).reshape(u.shape))


_CLOSING = (*_PAPERS, "u0", "p_ref")


def closing_gap(u: FloatArray, v: Values) -> FloatArray:
    """Height of a gap whose asperities carry the pressure p = p_ref exp((d - h)/u0) at height h (Persson 2007).

    It is the largest root of F_N/A + sigma = p, with the paper's area under the attraction across that height. Beyond
    pull-in, where the attraction grows faster than the pressure as the gap closes, there is none.
    """
    values = [np.atleast_1d(np.asarray(v[name], float)) for name in _CLOSING]
    rest, closed = _heights(tuple(tuple(value.tolist()) for value in values))
    with np.errstate(all="ignore"):
        # A ridge area that grows at first takes pressure off the gap, which then opens a little.
        return root(_pressure_left, closed, rest + values[-2], u, *values)


def _pressure_left(h: FloatArray, u: FloatArray, *values: FloatArray) -> FloatArray:
    own = dict(zip(_CLOSING, values, strict=True))
    here, pressure = {**own, "d": h}, own["p_ref"] * np.exp((own["d"] - h) / own["u0"])
    return np.asarray(pressure - own["fn"] / paper(u, here) - stress(u, here))


@lru_cache(maxsize=32)
def _heights(values: tuple[tuple[float, ...], ...]) -> tuple[FloatArray, FloatArray]:
    """Height without voltage, and the one at pull-in: of each height's voltage, the largest has it."""
    from scipy.optimize.elementwise import find_minimum

    def less_voltage(h: FloatArray, *values: FloatArray) -> FloatArray:
        own = dict(zip(_CLOSING, values, strict=True))
        alone = h * np.sqrt(2.0 * own["p_ref"] / (EPS0 * own["eps_r"])) * np.exp(0.5 * (own["d"] - h) / own["u0"])
        return -root(lambda u, h, *values: _pressure_left(h, u, *values), 0.0, alone, h, *values)

    given = [np.array(value) for value in values]
    own = dict(zip(_CLOSING, given, strict=True))
    with np.errstate(all="ignore"):
        rest = own["d"] + own["u0"] * np.log(own["p_ref"] * paper(np.zeros(1), own) / own["fn"])
        # Not so far down that the pressure is e^200 times that of the reference.
        lowest = np.maximum(0.01 * rest, own["d"] - 200.0 * own["u0"])
        heights = lowest + (rest - lowest) * np.linspace(1.0, 0.0, 65)[:, None]
        # At rest the voltage is 0, to which rounding adds.
        tried = np.vstack([np.zeros((1, rest.size)), less_voltage(heights[1:], *given)])
        low = np.clip(np.argmin(tried, axis=0), 1, 63)
        nearest = tuple(np.take_along_axis(heights, low[None] + k, 0)[0] for k in (1, 0, -1))
        found = find_minimum(less_voltage, nearest, args=tuple(given))
        return rest, np.where(found.success, found.x, heights[-1])


def pullin(u: FloatArray, v: Values) -> FloatArray:
    """The paper's area with a gap that closes under load."""
    return paper(u, {**v, "d": closing_gap(u, v)})
