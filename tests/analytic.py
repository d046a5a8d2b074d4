"""Independent high-precision reference for the electroadhesive fingertip model.

Nothing here comes from the package: every formula is written from the paper (Forsbach & Heß, equation numbers in
brackets) in its repaired reading. SI units at every function boundary; the paper's mm and N occur only in
`PAPER_TABLE1`, where they are converted once, and inside `ridge_area_unloaded_mp`, which solves Eq. 4 as printed.

A transient's state are the leaked charges w_x (per area under `local`, total under `mobile`), so no derivative of U is
needed. Each smooth piece is solved by Radau IIA collocation (12 stages, order 23; or Gauss, order 24) with full Newton
and a step controlled by the decay of the Legendre coefficients (last two below 1e-14 of the peak voltage). Pieces end
at the edges of segments and on every zero of u_a, located to rounding, where A(|u_a|) has its kink; inside a piece the
area is continued analytically through u_a = 0. Outputs are values of the collocation polynomial. Gauge: one function
of time in all w_x changes no voltage; here the w of the gap stands still, and each step starts from the layer
voltages.
"""

from __future__ import annotations

import bisect
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from itertools import pairwise, product

import mpmath as mp
import numpy as np
from numpy.polynomial import legendre
from scipy.integrate import DOP853
from scipy.optimize import brentq
from scipy.special import roots_jacobi, roots_legendre

# 1. Parameters and materials ---------------------------------------------------------------------------------

PAPER_TABLE1 = {
    "mu0": 0.3, "F_N_N": 0.5, "eps_r_i": 3.9, "eps_r_a": 1.0, "eps0": 8.854e-12,
    "d_i_um": 1.0, "d_a_um": 3.5, "d_sc_um": 350.0, "R_a_ohm": 1e6, "R_i_ohm": 2e5,
    "m": 0.52, "n": 1.41, "alpha_mm2_per_Nm": 54.4, "beta_mm_2mn": 32.0, "c2_mm4_per_N2": 5000.0,
}  # fmt: skip
"""Table 1 exactly as printed, the printed unit in each key."""


@dataclass(frozen=True)
class Parameters:
    """One finger on one touchscreen, SI units."""

    mu0: float  # friction coefficient
    force_normal: float  # F_N, N
    eps0: float  # permittivity of free space, F/m (8.854e-12 as in Table 1, not CODATA)
    # eps_i, eps_a: relative permittivities of coating and gap
    eps_i: float
    eps_a: float
    # d_i, d_a, d_sc: thicknesses of coating, gap and stratum corneum, m
    d_i: float
    d_a: float
    d_sc: float
    # r_i, r_a: total resistances of coating and gap, Ohm (``math.inf``: no leakage)
    r_i: float
    r_a: float
    # m, n: exponents of Eqs. 5 and 6
    m: float
    n: float
    alpha: float  # m^2 / N^m, Eq. 5
    beta: float  # m^(2 - n), Eq. 6
    c2: float  # m^4 / N^2, Eq. 3


def parameters_from_paper(table: dict[str, float]) -> Parameters:
    """`Parameters` from a table in the paper's units (keys of `PAPER_TABLE1`): the only conversion."""
    return Parameters(
        mu0=table["mu0"],
        force_normal=table["F_N_N"],
        eps0=table["eps0"],
        eps_i=table["eps_r_i"],
        eps_a=table["eps_r_a"],
        d_i=table["d_i_um"] / 1e6,
        d_a=table["d_a_um"] / 1e6,
        d_sc=table["d_sc_um"] / 1e6,
        r_i=table["R_i_ohm"],
        r_a=table["R_a_ohm"],
        m=table["m"],
        n=table["n"],
        alpha=table["alpha_mm2_per_Nm"] / 1e6,
        beta=table["beta_mm_2mn"] / 10.0 ** (3.0 * (2.0 - table["n"])),
        c2=table["c2_mm4_per_N2"] / 1e12,
    )


TABLE1 = parameters_from_paper(PAPER_TABLE1)
"""Table 1 in SI."""


def rho_sc(f: float) -> float:
    """Resistivity of the stratum corneum at frequency f in Hz, Ohm m: Eq. 18 in the cubic reading."""
    z = math.log10(f)
    return 10.0 ** (-0.023 * z**3 + 0.0795 * z**2 - 0.2133 * z + 4.9229)


def eps_sc(f: float) -> float:
    """Relative permittivity of the stratum corneum at frequency f in Hz: Eq. 19 as printed."""
    z = math.log10(f)
    return 10.0 ** (-0.00286 * z**5 + 0.03564 * z**4 - 0.15785 * z**3 + 0.33963 * z**2 - 0.6235 * z + 4.1598)


@dataclass(frozen=True)
class Layer:
    """One series layer: a capacitance that scales with the ridge area, in parallel with leakage.

    Both resistances act in parallel; ``math.inf`` (default) leaves one out.
    """

    c: float  # capacitance per area, F/m^2 (Eq. 16 over A_R)
    r_total: float = math.inf  # leakage resistance of the whole layer, Ohm, independent of the area
    r_area: float = math.inf  # leakage resistance times area, Ohm m^2 (rho d of Eq. 17): in all r_area / A_R


GAP = 1
"""Index of the air gap in the layers of `table1_layers`."""


def table1_layers(freq: float, params: Parameters = TABLE1) -> tuple[Layer, Layer, Layer]:
    """Coating, gap and stratum corneum with the skin frozen at `freq` in Hz (Eqs. 16-19)."""
    p = params
    return (
        Layer(p.eps0 * p.eps_i / p.d_i, r_total=p.r_i),
        Layer(p.eps0 * p.eps_a / p.d_a, r_total=p.r_a),
        Layer(p.eps0 * eps_sc(freq) / p.d_sc, r_area=rho_sc(freq) * p.d_sc),
    )


def work_factor(freq: float, params: Parameters = TABLE1) -> float:
    """Factor k of the work of adhesion with the total voltage held (Eq. 7, capacitive stack, skin at `freq`).

    w = k sigma d_a, k = (sum of d_x / eps_x) / (d_a / eps_a). With the gap voltage held, the default
    reading, k = 1.
    """
    p = params
    total = p.d_i / p.eps_i + p.d_a / p.eps_a + p.d_sc / eps_sc(freq)
    return total / (p.d_a / p.eps_a)


# 2. Contact --------------------------------------------------------------------------------------------------


def ridge_area_unloaded_mp(u: float, params: Parameters = TABLE1, dps: int = 40, k: float = 1.0) -> mp.mpf:
    """A_R0 (m^2) at gap voltage u (V): the root of Eq. 4 as repaired (square root over all of it), to `dps` digits.

    `k` is 1 (gap voltage held) or `work_factor` (total voltage held). Inside, lengths are in mm and w in N/mm, the
    paper's units.
    """
    with mp.workdps(dps + 15):
        m, n, force = mp.mpf(params.m), mp.mpf(params.n), mp.mpf(params.force_normal)
        alpha = mp.mpf(params.alpha) * mp.mpf(10) ** 6
        beta = mp.mpf(params.beta) * mp.mpf(10) ** (3 * (2 - n))
        sigma = mp.mpf(params.eps0) * params.eps_a * mp.mpf(u) ** 2 / (2 * mp.mpf(params.d_a) ** 2)  # N/m^2
        w = k * sigma * mp.mpf(params.d_a) / 1000  # N/mm

        def residual(a: mp.mpf) -> mp.mpf:
            adhesion = mp.sqrt(2 * w * n**2 / (n - m) * beta ** (1 / n) * alpha ** (-1 / m) * a ** (1 + 1 / m - 1 / n))
            return alpha ** (-1 / m) * a ** (1 / m) - adhesion - force

        low = alpha * force**m
        if w == 0:
            return low / mp.mpf(10) ** 6
        high = 2 * low
        while residual(high) <= 0:
            high *= 2
        tol = mp.mpf(10) ** (-2 * dps)
        root = mp.findroot(residual, (low, high), solver="anderson", tol=tol, maxsteps=400)
        return root / mp.mpf(10) ** 6


def area_mp(
    u: float, params: Parameters = TABLE1, dps: int = 40, k: float = 1.0
) -> tuple[mp.mpf, mp.mpf, mp.mpf, mp.mpf]:
    """Contact at gap voltage u to `dps` digits: (A_R0 in m^2, A_R in m^2, F_el in N, F_T in N), Eqs. 1-4.

    A_R is the positive root of the quadratic that Eqs. 1 and 3 make together. Parameters as in
    `ridge_area_unloaded_mp`. Raises ValueError where no contact exists (A_R0^2 <= c2 mu0^2 F_N^2).
    """
    with mp.workdps(dps + 15):
        a0 = ridge_area_unloaded_mp(u, params, dps, k)
        force, mu = mp.mpf(params.force_normal), mp.mpf(params.mu0)
        sigma = mp.mpf(params.eps0) * params.eps_a * mp.mpf(u) ** 2 / (2 * mp.mpf(params.d_a) ** 2)
        # A + b (F + sigma A)^2 - A0 = 0 with b = c2 mu^2 / A0
        b = mp.mpf(params.c2) * mu**2 / a0
        rest = a0 - b * force**2
        if rest <= 0:
            raise ValueError(f"no contact at {u} V: A_R0^2 = {a0**2} m^4 <= c2 mu0^2 F_N^2")
        linear = 1 + 2 * b * sigma * force
        a = 2 * rest / (linear + mp.sqrt(linear**2 + 4 * b * sigma**2 * rest))
        f_el = sigma * a
        return a0, a, f_el, mu * (force + f_el)


def _universal_log(x: np.ndarray, m: float, p: float) -> np.ndarray:
    """ln y of the root of y^(1/m) - x y^p = 1, by Newton on L/m = log1p(x e^(pL)): monotone from L = 0."""
    log_y = np.zeros_like(x)
    last = np.inf
    for _ in range(60):
        e = x * np.exp(p * log_y)
        step = (log_y / m - np.log1p(e)) / (1.0 / m - p * e / (1.0 + e))
        log_y = log_y - step
        size = float(np.abs(step).max(initial=0.0))
        if size < 1e-16 or (size < 1e-13 and size >= last):
            return log_y
        last = size
    return log_y


@lru_cache(maxsize=256)
def _contact_constants(params: Parameters, k: float) -> tuple[float, float, float, float, float]:
    p_ = params
    p = 0.5 * (1.0 + 1.0 / p_.m - 1.0 / p_.n)
    a_hertz = p_.alpha * p_.force_normal**p_.m  # A_R0 at 0 V
    w_per_u2 = k * p_.eps0 * p_.eps_a / (2.0 * p_.d_a)  # w / u^2, N/m/V^2
    x_per_u = (
        math.sqrt(2.0 * w_per_u2 * p_.n**2 / (p_.n - p_.m) * p_.beta ** (1.0 / p_.n) * p_.alpha ** (-1.0 / p_.m))
        * a_hertz**p
        / p_.force_normal
    )
    sigma_per_u2 = p_.eps0 * p_.eps_a / (2.0 * p_.d_a**2)
    if a_hertz**2 <= p_.c2 * p_.mu0**2 * p_.force_normal**2:
        raise ValueError(
            f"no contact at 0 V: A_R0 = {a_hertz:.6g} m^2, but A_R0^2 must exceed c2 mu0^2 F_N^2 = "
            f"{p_.c2 * p_.mu0**2 * p_.force_normal**2:.6g} m^4"
        )
    return p, a_hertz, x_per_u, sigma_per_u2, p_.c2 * p_.mu0**2


def contact(v: np.ndarray | float, params: Parameters = TABLE1, k: float = 1.0) -> tuple[np.ndarray, ...]:
    """A_R0 (m^2, Eq. 4), A_R (m^2, Eqs. 1, 3), dA_R/dv (m^2/V) and F_el (N, Eqs. 1, 2) at gap voltages |u_a| = v (V).

    In double precision, from the definition by Newton (no table). Negative v give the analytic continuation of the
    branch v > 0 through v = 0 (A is smooth in v, with a kink only in |u|), cut off where the universal X falls below
    -0.9.
    """
    v = np.asarray(v, dtype=float)
    p, a_hertz, x_per_u, sigma_per_u2, c = _contact_constants(params, k)
    x = np.maximum(x_per_u * v, -0.9)
    log_y = _universal_log(x, params.m, p)
    a0 = a_hertz * np.exp(log_y)
    e = np.exp(p * log_y)
    da0 = a0 * e / (np.exp(log_y / params.m) / params.m - x * p * e) * x_per_u
    sigma, dsigma = sigma_per_u2 * v * v, 2.0 * sigma_per_u2 * v
    force = params.force_normal
    b = c / a0
    rest = a0 - b * force**2
    linear = 1.0 + 2.0 * b * sigma * force
    a = 2.0 * rest / (linear + np.sqrt(linear**2 + 4.0 * b * sigma**2 * rest))
    load = force + sigma * a
    da = (da0 * (1.0 + c * (load / a0) ** 2) - 2.0 * b * load * a * dsigma) / (1.0 + 2.0 * b * sigma * load)
    return a0, a, da, sigma * a


def area(u: np.ndarray | float, params: Parameters = TABLE1, k: float = 1.0) -> np.ndarray:
    """A_R in m^2 at gap voltage u in V, double precision (relative error below 2e-15 against `area_mp`)."""
    return contact(np.abs(u), params, k)[1]


@lru_cache(maxsize=1)
def _quadrature() -> tuple[np.ndarray, np.ndarray]:
    x, w = roots_legendre(40)
    return 0.5 * (x + 1.0), 0.5 * w


def area_primitive(u: np.ndarray | float, params: Parameters = TABLE1, k: float = 1.0) -> np.ndarray:
    """Integrals of A_R(|v|) dv from 0 to each u, m^2 V, odd in u.

    40-point Gauss on panels that double in length, the first as long as the voltage at which friction begins
    to take area away or X = 0.5, whichever is less.
    """
    x, w = _quadrature()
    _, a_hertz, x_per_u, sigma_per_u2, c = _contact_constants(params, k)
    b = c / a_hertz
    first = min(0.5 / x_per_u, math.sqrt(0.5 / (b * params.force_normal + math.sqrt(c)) / sigma_per_u2))
    size, edges = np.abs(np.asarray(u, dtype=float)), [0.0, first]
    while edges[-1] < size.max(initial=0.0):
        edges.append(2.0 * edges[-1])
    starts = np.minimum(edges, size[..., None])
    lengths = np.diff(starts)[..., None]
    nodes = starts[..., :-1, None] + lengths * x
    return np.copysign(np.sum(lengths * w * contact(nodes, params, k)[1], axis=(-2, -1)), u)


def jkr_parameters(radius: float, e_star: float) -> tuple[float, float, float, float]:
    """m, n, alpha (m^2 / N^(2/3)) and beta (m) that make Eqs. 5, 6 the Hertz contact of a sphere of R (m) and E* (Pa).

    Hertz: a^3 = 3 F R / (4 E*), so A = pi a^2 = pi (3 R / (4 E*))^(2/3) F^(2/3): m = 2/3 and alpha;
    delta = a^2 / R, so A = pi R delta: n = 1 and beta = pi R.
    """
    return 2.0 / 3.0, 1.0, math.pi * (3.0 * radius / (4.0 * e_star)) ** (2.0 / 3.0), math.pi * radius


def jkr_area(force: float, w: float, e_star: float, radius: float) -> float:
    """Contact area of the Johnson-Kendall-Roberts theory, m^2, in its closed form (stable branch).

    a^3 = 3R/(4E*) (F + 3 pi w R + sqrt(6 pi w R F + (3 pi w R)^2)), A = pi a^2. Arguments: F in N, w in N/m,
    E* in Pa, R in m. Independent of Eq. 4, which must reduce to it for the exponents of `jkr_parameters`.
    """
    pull = 3.0 * math.pi * w * radius
    a3 = 3.0 * radius / (4.0 * e_star) * (force + pull + math.sqrt(2.0 * pull * force + pull**2))
    return math.pi * a3 ** (2.0 / 3.0)


# 3. Phasors (frozen area, and the mean-area coupling) --------------------------------------------------------


def phasor_gains(f: float, a: float, layers: Sequence[Layer]) -> np.ndarray:
    """Complex U_x / U_0 of every layer at f in Hz and area a in m^2: impedances in series (Eqs. 9, 11).

    Time dependence e^(+i Omega t); f = 0 gives the resistive divider (at least one layer must conduct less
    than all).
    """
    omega = 2.0 * math.pi * f
    y = np.array([1.0 / x.r_total + a / x.r_area + 1j * omega * x.c * a for x in layers])
    if np.any(y == 0.0):
        return (y == 0.0) / np.count_nonzero(y == 0.0) + 0j
    z = 1.0 / y
    return z / z.sum()


def impedance(f: float, a: float, layers: Sequence[Layer]) -> complex:
    """What a source sees of layers in series, ohm, at f in Hz and area a in m^2 (Eq. 9)."""
    return sum(1.0 / (1.0 / x.r_total + a / x.r_area + 2j * math.pi * f * x.c * a) for x in layers)


def _table1_rc(f: float, a: float, params: Parameters) -> tuple[float, ...]:
    """(R_i, R_a, R_sc, C_i, C_a, C_sc) of Table 1 at frequency f and area a (Eqs. 16, 17)."""
    p = params
    c_i, c_a, c_sc = p.eps0 * p.eps_i * a / p.d_i, p.eps0 * p.eps_a * a / p.d_a, p.eps0 * eps_sc(f) * a / p.d_sc
    return p.r_i, p.r_a, rho_sc(f) * p.d_sc / a, c_i, c_a, c_sc


def gap_gain_eq12(f: float, a: float, params: Parameters = TABLE1) -> float:
    """U_a0 / U_0 by Eq. 12, with the repaired denominator 1 + tau_a^2 Omega^2 under R_a tau_a Omega."""
    r_i, r_a, r_s, c_i, c_a, c_s = _table1_rc(f, a, params)
    om = 2.0 * math.pi * f
    t_i, t_a, t_s = r_i * c_i, r_a * c_a, r_s * c_s
    q_i, q_a, q_s = 1.0 + (t_i * om) ** 2, 1.0 + (t_a * om) ** 2, 1.0 + (t_s * om) ** 2
    real = r_a / q_a + r_i / q_i + r_s / q_s
    imag = r_a * t_a * om / q_a + r_i * t_i * om / q_i + r_s * t_s * om / q_s
    return r_a / math.sqrt(q_a) / math.sqrt(real**2 + imag**2)


def gap_phase_eq13(f: float, a: float, params: Parameters = TABLE1) -> float:
    """Phase of the gap voltage against the source by Eq. 13, rad, positive when it leads."""
    r_i, r_a, r_s, c_i, c_a, c_s = _table1_rc(f, a, params)
    om = 2.0 * math.pi * f
    t_i, t_a, t_s = r_i * c_i, r_a * c_a, r_s * c_s
    q_i, q_s = 1.0 + (t_i * om) ** 2, 1.0 + (t_s * om) ** 2
    num = r_s * (t_s - t_a) * om / q_s + r_i * (t_i - t_a) * om / q_i
    den = r_a + r_s * (1.0 + t_a * t_s * om**2) / q_s + r_i * (1.0 + t_a * t_i * om**2) / q_i
    return math.atan(num / den)


def gap_limit_eq14(f: float, a: float, params: Parameters = TABLE1) -> float:
    """Resistive limit of U_a0 / U_0, Eq. 14, with rho_sc taken at f in Hz and area a in m^2."""
    r_i, r_a, r_s, *_ = _table1_rc(f, a, params)
    return r_a / (r_i + r_a + r_s)


def gap_limit_eq15(f: float, params: Parameters = TABLE1) -> float:
    """Capacitive limit of U_a0 / U_0, Eq. 15, with eps_sc taken at f in Hz (independent of the area)."""
    _, _, _, c_i, c_a, c_s = _table1_rc(f, 1.0, params)
    return c_i * c_s / (c_i * c_a + c_a * c_s + c_i * c_s)


@dataclass(frozen=True)
class CoupledPhasor:
    """Result of `coupled_phasor`: complex gains U_x/U_0 (n_layers,), area m^2, mean F_el in N."""

    gains: np.ndarray
    area: float
    mean_force: float

    @property
    def gap_gain(self) -> complex:
        """U_a0 / U_0 of the default stack, complex."""
        return complex(self.gains[GAP])


def coupled_phasor(f: float, u0: float, params: Parameters = TABLE1, *, k: float = 1.0) -> CoupledPhasor:
    """Phasors at f (Hz) and a source of u0 (V) with the mean-area coupling A = g(U_a0 / sqrt 2), iterated to rounding.

    The skin is evaluated at f. The mean force is eps0 eps_a U_a0^2 A / (4 d_a^2).
    """
    layers = table1_layers(f, params)
    a, last = float(area(0.0, params, k)), math.inf
    for _ in range(500):
        u_a0 = abs(phasor_gains(f, a, layers)[GAP]) * u0
        new = float(area(u_a0 / math.sqrt(2.0), params, k))
        change, a = abs(new - a), new
        if change == 0.0 or (change < 1e-14 * a and change >= last):
            break
        last = change
    gains = phasor_gains(f, a, layers)
    mean = params.eps0 * params.eps_a * (abs(gains[GAP]) * u0) ** 2 * a / (4.0 * params.d_a**2)
    return CoupledPhasor(gains, a, mean)


# 4. Frozen area: exact linear responses (mpmath) -------------------------------------------------------------


def periodic_sine_frozen(
    f: float, u0: float, a: float, t: np.ndarray, layers: Sequence[Layer] | None = None, *, phase: float = 0.0
) -> np.ndarray:
    """Periodic layer voltages (len(t), n), V, under u0 sin(2 pi f t + phase) at frozen area a (m^2): Eqs. 9 and 11."""
    gains = phasor_gains(f, a, table1_layers(f) if layers is None else layers)
    return np.imag((u0 * np.exp(1j * (2.0 * math.pi * f * t + phase)))[:, None] * gains)


DIGITS = 40
"""Working digits of the frozen circuit."""


class _FrozenCircuit:
    """du/dt = M u of the frozen stack under constant U, propagated by its eigenvectors in mpmath."""

    def __init__(self, layers: Sequence[Layer], a: float) -> None:
        self.n = len(layers)
        with mp.workdps(DIGITS):
            am = mp.mpf(a)
            cap = [am * mp.mpf(x.c) for x in layers]
            g = [
                (0 if math.isinf(x.r_total) else 1 / mp.mpf(x.r_total))
                + (0 if math.isinf(x.r_area) else am / mp.mpf(x.r_area))
                for x in layers
            ]
            total = mp.fsum(1 / c for c in cap)
            self.divider = mp.matrix([1 / c / total for c in cap])
            self.matrix = mp.matrix(self.n, self.n)
            for i in range(self.n):
                for j in range(self.n):
                    self.matrix[i, j] = g[j] / cap[j] / cap[i] / total - (g[i] / cap[i] if i == j else 0)
            values, vectors = mp.eig(self.matrix)
            self.modes = None
            if abs(mp.det(vectors)) > mp.mpf(10) ** (-DIGITS // 3):
                self.modes = (values, vectors, mp.inverse(vectors))

    def propagator(self, dt: float | mp.mpf) -> mp.matrix:
        """Matrix exponential of M dt."""
        with mp.workdps(DIGITS):
            if self.modes is None:
                return mp.expm(self.matrix * mp.mpf(dt))
            values, vectors, inverse = self.modes
            return vectors * mp.diag([mp.exp(v * mp.mpf(dt)) for v in values]) * inverse

    def advance(self, u: mp.matrix, dt: float | mp.mpf) -> mp.matrix:
        """Layer voltages dt seconds after `u` under constant U."""
        with mp.workdps(DIGITS):
            return self.propagator(dt) * u


def _as_float(u: mp.matrix) -> list[float]:
    return [float(mp.re(x)) for x in u]


def piecewise_constant_frozen(
    edges: Sequence[float],
    levels: Sequence[float],
    t_out: Sequence[float],
    a: float,
    layers: Sequence[Layer],
    *,
    periodic: bool = False,
) -> np.ndarray:
    """Exact layer voltages (len(t_out), n) of the frozen stack under a piecewise-constant source, from 0 V on.

    Level k (V) holds on [t_k, t_(k+1)) of the edges (s). A jump of the source splits by 1/c_x; values at an edge are
    right-hand ones (at the last: left-hand). With `periodic` the state is that of the edges' period instead.
    """
    circuit = _FrozenCircuit(layers, a)
    n = len(layers)
    with mp.workdps(DIGITS):
        ts, lev = [mp.mpf(t) for t in edges], [mp.mpf(v) for v in levels]
        if periodic:
            phi, shift, previous = mp.eye(n), mp.zeros(n, 1), lev[-1]
            for k, level in enumerate(lev):
                e = circuit.propagator(ts[k + 1] - ts[k])
                phi, shift, previous = e * phi, e * (shift + circuit.divider * (level - previous)), level
            system, rhs = mp.eye(n) - phi, shift  # singular along the DC state: fix the sum instead
            for j in range(n):
                system[0, j] = 1
            rhs[0] = lev[-1]
            u = mp.lu_solve(system, rhs)
        else:
            u = mp.matrix([0] * n)
        starts = []
        for k, level in enumerate(lev):
            u = u + circuit.divider * (level - mp.fsum(u))
            starts.append(u)
            u = circuit.advance(u, ts[k + 1] - ts[k])
        out = []
        for t in t_out:
            k = min(max(bisect.bisect_right(edges, t) - 1, 0), len(lev) - 1)
            out.append(_as_float(circuit.advance(starts[k], mp.mpf(t) - ts[k])))
    return np.array(out)


def sine_frozen_from_rest(
    f: float, u0: float, a: float, t_out: Sequence[float], layers: Sequence[Layer], *, phase: float = 0.0
) -> np.ndarray:
    """Exact layer voltages (len(t_out), n) under u0 sin(2 pi f t + phase) from the uncharged state at t = 0.

    Periodic phasor plus the decaying modes of the circuit; the jump at t = 0 (phase != 0) splits by 1/c_x.
    """
    circuit = _FrozenCircuit(layers, a)
    with mp.workdps(DIGITS):
        om, am = 2 * mp.pi * mp.mpf(f), mp.mpf(a)
        z = [1 / (1 / mp.mpf(x.r_total) + am / mp.mpf(x.r_area) + 1j * om * mp.mpf(x.c) * am) for x in layers]
        total = mp.fsum(z)

        def steady(t: float) -> mp.matrix:
            wave = mp.mpf(u0) * mp.expj(om * mp.mpf(t) + mp.mpf(phase))
            return mp.matrix([mp.im(wave * zx / total) for zx in z])

        rest = circuit.divider * (mp.mpf(u0) * mp.sin(mp.mpf(phase))) - steady(0.0)
        return np.array([_as_float(steady(t) + circuit.advance(rest, t)) for t in t_out])


# 5. Sources: segments (t0, t1, U), smooth on each closed segment ---------------------------------------------

Waveform = Callable[[np.ndarray], np.ndarray]
Segment = tuple[float, float, Waveform]


def _hold(level: float) -> Waveform:
    return lambda t: level + 0.0 * np.asarray(t)


def constant_segments(edges: Sequence[float], levels: Sequence[float]) -> list[Segment]:
    """Piecewise-constant source: levels[k] V on [edges[k], edges[k+1]) s."""
    return [(edges[k], edges[k + 1], _hold(v)) for k, v in enumerate(levels)]


def sine_segments(
    u0: float, f: float, t_end: float, *, phase: float = 0.0, offset: float = 0.0, t_start: float = 0.0
) -> list[Segment]:
    """One segment of offset + u0 sin(2 pi f t + phase), V; phase in rad, times in s."""
    return [(t_start, t_end, lambda t: offset + u0 * np.sin(2.0 * math.pi * f * np.asarray(t) + phase))]


def square_segments(u0: float, f: float, periods: int, *, duty: float = 0.5) -> list[Segment]:
    """Ideal square wave, +u0 V on [0, duty/f), -u0 V on the rest of each period, from t = 0."""
    edges, levels = [0.0], []
    for j in range(periods):
        edges += [(j + duty) / f, (j + 1) / f]
        levels += [u0, -u0]
    return constant_segments(edges, levels)


def pwl_segments(points: Sequence[tuple[float, float]]) -> list[Segment]:
    """Piecewise-linear source through (t in s, U in V); two equal times are an ideal jump."""

    def ramp(t0: float, v0: float, slope: float) -> Waveform:
        return lambda t: v0 + slope * (np.asarray(t) - t0)

    return [(t0, t1, ramp(t0, v0, (v1 - v0) / (t1 - t0))) for (t0, v0), (t1, v1) in pairwise(points) if t1 > t0]


# 6. The stack as an ODE in the leaked charges ----------------------------------------------------------------


class FoldError(ValueError):
    """The `mobile` law has no gap voltage: by how much the source is past the fold (V, negative), and the fold (V)."""

    def __init__(self, margin: float, u_gap: float) -> None:
        super().__init__(f"mobile law: no gap voltage, {margin:.6g} V beyond the fold at u_a = {u_gap:.6g} V")
        self.margin, self.u_gap = margin, u_gap


def fold_margin(
    p: float, kk: float, params: Parameters = TABLE1, k: float = 1.0, branch: float | None = None
) -> tuple[float, float]:
    """How far, V, the mobile equation u = p + kk A(0)/A(|u|) is from the fold of its branch, and u there, V.

    `p` is U/(S c_a), the capacitive share of the source, and `kk` the leaked part, (sum l_x/c_x / S - l_a)/(c_a A(0)),
    both in V; `branch` is the sign of u, by default that of p + kk. With s that sign and v = |u| the residual is
    r(v) = v - s p - s kk A(0)/A(v). Where s kk > 0 the stable root is the first one and ends at the first maximum of
    r; where s kk < 0 and r falls at v = 0, which only tiny loads give, it is the last one and ends at the minimum of
    r. The margin is r at that maximum, or minus r at that minimum: so far the source's share may move. It is negative
    where there is no solution, and ``inf`` where the branch has no fold.
    """
    s = math.copysign(1.0, p + kk if branch is None else branch)
    a_zero = float(contact(0.0, params, k)[1])

    def slope(v: float) -> float:
        _, a, da, _ = contact(v, params, k)
        return float(1.0 + s * kk * a_zero * da / a**2)

    up = slope(0.0) > 0.0
    if s * kk == 0.0 or (s * kk < 0.0 and up):
        return math.inf, s * math.inf
    low, high = 0.0, 1e-3 * (abs(p) + abs(kk))
    while (slope(high) > 0.0) == up:
        low, high = high, 1.1 * high
        if high > 1e7:
            return math.inf, s * math.inf
    v = float(brentq(slope, low, high, xtol=1e-14 * high, rtol=1e-15))
    r = v - s * p - s * kk * a_zero / float(contact(v, params, k)[1])
    return (r if up else -r), s * v


def mobile_gap_voltage(
    p: float, kk: float, params: Parameters = TABLE1, k: float = 1.0, branch: float | None = None
) -> float:
    """Stable root u of u = p + kk A(0)/A(|u|), V, by bracketing; arguments as in `fold_margin`.

    `branch` is the sign of u before the change. The root on that branch is taken where it exists; where u has
    passed through zero on the way (r rises at v = 0, so the passage is regular), the root of the other sign.
    The bracket: from 0 to the first maximum of r (s kk > 0), from the minimum of r or 0 to |p| (s kk < 0).
    Raises FoldError when the branch has ended.
    """
    if p + kk == 0.0 and (branch is None or p == 0.0):
        return 0.0
    s = math.copysign(1.0, p + kk if branch is None else branch)
    a_zero = float(contact(0.0, params, k)[1])

    def residual(v: float) -> float:
        return float(v - s * p - s * kk * a_zero / contact(v, params, k)[1])

    margin, u_fold = fold_margin(p, kk, params, k, s)
    if margin < 0.0:
        raise FoldError(margin, u_fold)
    falls = s * kk < 0.0 and not math.isinf(margin)
    if not falls and residual(0.0) > 0.0:
        return mobile_gap_voltage(p, kk, params, k, -s) if residual(0.0) > 1e-14 * abs(p) else 0.0
    if margin == 0.0:
        return u_fold
    low, high = (abs(u_fold), s * p) if falls else (0.0, abs(u_fold))
    if math.isinf(margin):
        high = max(1e-300, s * (p + kk))
        while residual(high) < 0.0:
            high *= 2.0
    return s * float(brentq(residual, low, high, xtol=1e-14 * max(abs(p), abs(kk)), rtol=1e-15))


class _NoStep(RuntimeError):
    """The collocation equations were not solved; try a shorter step."""


class _Stack:
    """Voltages, rates and Jacobians of N layers in terms of the leaked charges w.

    local:  u_x = U/(S c_x) + B_x/c_x,     w_x' = u_x (1/(R_x A) + 1/r_x)          (w = lambda, C/m^2)
    mobile: u_x = U/(S c_x) + B_x/(c_x A), w_x' = u_x (1/R_x + A/r_x)              (w = l, C)
    with B_x = sum_y w_y/c_y / S - w_x, A = g(|u_a|) or a constant.
    """

    def __init__(
        self, layers: Sequence[Layer], gap: int, law: str, params: Parameters, k: float, frozen: float | None
    ) -> None:
        if law not in ("local", "mobile"):
            raise ValueError(f"law must be 'local' or 'mobile', got {law!r}")
        self.c = np.array([x.c for x in layers])
        self.g_total = np.array([1.0 / x.r_total for x in layers])
        self.g_area = np.array([1.0 / x.r_area for x in layers])
        self.n, self.gap, self.params, self.k, self.frozen = len(layers), gap, params, k, frozen
        self.mobile = law == "mobile" and frozen is None  # area frozen: both laws are one linear circuit
        self.elastance = float(np.sum(1.0 / self.c))
        self.share = 1.0 / self.c / self.elastance
        self.b_of_w = np.outer(np.ones(self.n), self.share) - np.eye(self.n)
        self.a_zero = float(frozen if frozen is not None else contact(0.0, params, k)[1])
        self.sigma_per_u2 = params.eps0 * params.eps_a / (2.0 * params.d_a**2)

    def area(self, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """A and dA/dv at v = s u_a (continued through 0)."""
        if self.frozen is not None:
            return np.full_like(v, self.frozen), np.zeros_like(v)
        _, a, da, _ = contact(v, self.params, self.k)
        return a, da

    def _mobile_v(self, sp: np.ndarray, skk: np.ndarray, v: np.ndarray) -> np.ndarray:
        """v = s u_a, the root of the mobile equation connected to a v at hand, by Newton.

        The residual is neither convex nor concave all the way: a step is shortened until the area changes by a third
        at most and the residual still rises, so no fold is stepped over.
        """
        last = np.inf
        a, da = self.area(v)
        slope = 1.0 + skk * self.a_zero * da / a**2
        for _ in range(100):
            if not np.all(slope > 0.0):
                break
            step = -(v - sp - skk * self.a_zero / a) / slope
            size = float(np.max(np.abs(step)))
            scale = float(np.max(np.abs(v)) + np.max(np.abs(sp)) + np.max(np.abs(skk)))
            # Close to a fold v is as uncertain as rounding over the slope.
            left = size * float(np.min(slope))
            if left <= 1e-16 * scale or (left < 1e-12 * scale and size >= last):
                return v
            last = size
            for _ in range(60):
                a_new, da_new = self.area(v + step)
                slope_new = 1.0 + skk * self.a_zero * da_new / a_new**2
                fair = (slope_new > 0.0) & (np.abs(np.log(a_new / a)) < 0.3)
                if np.all(fair):
                    break
                step = np.where(fair, step, 0.5 * step)
            v, a, da, slope = v + step, a_new, da_new, slope_new
        raise _NoStep("fold")

    def fields(
        self, source: np.ndarray, w: np.ndarray, s: float, v: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """u (m, n), A (m,), dA/dv (m,) for source (m,), w (m, n) and the sign s of u_a on this piece.

        `mobile` takes v = s u_a (m,) as it is given, whether it solves the area equation or not (see `closed`).
        """
        b = w @ self.b_of_w.T
        free = source[:, None] * self.share
        if not self.mobile:
            u = free + b / self.c
            a, da = self.area(s * u[:, self.gap])
            return u, a, da
        j = self.gap
        a, da = self.area(v)
        u = free + b / (self.c * a[:, None])
        u[:, j] = s * v
        return u, a, da

    def closed(
        self, source: np.ndarray, w: np.ndarray, s: float, v: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """`fields` with the area equation solved from a v nearby."""
        if self.mobile:
            j = self.gap
            kk = w @ self.b_of_w[j] / (self.c[j] * self.a_zero)
            v = self._mobile_v(s * source * self.share[j], s * kk, v)
        return self.fields(source, w, s, v)

    def equation(
        self, source: np.ndarray, w: np.ndarray, s: float, v: np.ndarray, a: np.ndarray, da: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """What the area equation of `mobile` misses, V, and its slopes by w (m, n) and by v (m,), 0 at a fold."""
        j = self.gap
        b = w @ self.b_of_w[j]
        miss = v - s * source * self.share[j] - s * b / (self.c[j] * a)
        by_w = -s * self.b_of_w[j] / (self.c[j] * a[:, None])
        return miss, by_w, 1.0 + s * b * da / (self.c[j] * a**2)

    def rates(self, u: np.ndarray, a: np.ndarray) -> np.ndarray:
        """w' (m, n)."""
        if self.mobile:
            return u * (self.g_total + a[:, None] * self.g_area)
        return u * (self.g_total / a[:, None] + self.g_area)

    def rates_jacobian(self, w: np.ndarray, u: np.ndarray, a: np.ndarray, da: np.ndarray, s: float) -> np.ndarray:
        """d w' / d w, (m, n, n); under `mobile` at a v held, with d w' / d v after it, (m, n, n + 1)."""
        j = self.gap
        if self.mobile:
            b = w @ self.b_of_w.T
            du = np.empty((len(a), self.n, self.n + 1))
            du[:, :, :-1] = self.b_of_w[None] / (self.c * a[:, None])[:, :, None]
            du[:, :, -1] = -b / self.c * (da / a**2)[:, None]
            du[:, j, :-1], du[:, j, -1] = 0.0, s
            du *= (self.g_total + a[:, None] * self.g_area)[:, :, None]
            du[:, :, -1] += u * self.g_area * da[:, None]
            return du
        du = np.broadcast_to(self.b_of_w / self.c[:, None], (len(a), self.n, self.n))
        dadw = (s * da)[:, None] * du[:, j, :]
        g = self.g_total / a[:, None] + self.g_area
        return g[:, :, None] * du - (u * self.g_total / a[:, None] ** 2)[:, :, None] * dadw[:, None, :]

    def gauge(self, u: np.ndarray) -> np.ndarray:
        """Leaked charges that stand for the layer voltages u in the gauge D = 0 (Q = 0)."""
        return -self.w_scale(u) * u

    def w_scale(self, u: np.ndarray) -> np.ndarray:
        """w per volt, for tolerances, at layer voltages u."""
        if not self.mobile:
            return self.c
        return self.c * float(self.area(np.abs(u[self.gap : self.gap + 1]))[0][0])

    def jump(self, u: np.ndarray, source: float) -> np.ndarray:
        """Layer voltages after the source has jumped to `source` from layer voltages u."""
        if not self.mobile:
            return u + self.share * (source - float(np.sum(u)))
        b = self.b_of_w @ self.gauge(u)
        j = self.gap
        ua = self._ramped(source * self.share[j], float(b[j]) / (self.c[j] * self.a_zero), float(u[j]))
        a = float(self.area(np.array([abs(ua)]))[0][0])
        after = source * self.share + b / (self.c * a)
        after[j] = ua
        return after

    def rises(self, u: np.ndarray, kk: np.ndarray, side: float) -> np.ndarray:
        """d p / d u of the mobile equation p = u - kk A(0)/A(|u|), on the given side of 0: 0 at a fold."""
        a, da = self.area(np.abs(u))
        return 1.0 + np.copysign(1.0, np.where(u == 0.0, side, u)) * kk * self.a_zero * da / a**2

    def rise(self, u: float, kk: float, side: float) -> float:
        """`rises` at one voltage."""
        return float(self.rises(np.array([u]), np.array([kk]), side)[0])

    def margin_kk(self, u: np.ndarray) -> np.ndarray:
        """kk of `fold_margin` for layer voltages u (m, n)."""
        j = self.gap
        leaked = -(u * self.c) * self.area(np.abs(u[:, j]))[0][:, None]
        return leaked @ self.b_of_w[j] / (self.c[j] * self.a_zero)

    def _ramped(self, p: float, kk: float, u: float) -> float:
        """Gap voltage where the source's share has gone to p along a ramp too fast for any leak.

        With kk held, u moves along p(u) = u - kk A(0)/A(|u|) as long as that rises. Raises FoldError where it ends.
        """

        def miss(v: float) -> float:
            return v - kk * self.a_zero / float(self.area(np.array([abs(v)]))[0][0]) - p

        d = -math.copysign(1.0, miss(u))
        _, _, x_per_u, sigma_per_u2, c = _contact_constants(self.params, self.k)
        knee = min(0.5 / x_per_u, 0.5 / math.sqrt(sigma_per_u2 * math.sqrt(c)))
        while d * miss(u) < 0.0:
            ahead = u + d * max(0.02 * abs(u), 0.01 * knee)
            if ahead * u < 0.0:
                ahead = 0.0
            if self.rise(u, kk, d) <= 0.0:
                raise FoldError(d * miss(u), u)
            if self.rise(ahead, kk, -d) <= 0.0:
                side = math.copysign(1.0, u or d)
                ahead = float(brentq(self.rise, u or d * 1e-300, ahead, args=(kk, side)))
                if d * miss(ahead) < 0.0:
                    raise FoldError(d * miss(ahead), ahead)
            if d * miss(ahead) >= 0.0:
                return float(brentq(miss, u, ahead, xtol=1e-300, rtol=1e-15))
            u = ahead
        return u

    def stored(self, u: np.ndarray | float) -> np.ndarray:
        """Charge taken up by the gap capacitor between 0 and u, C: c_a int A du (local), c_a A u (mobile)."""
        if self.frozen is not None:
            return self.c[self.gap] * self.frozen * u
        if self.mobile:
            return self.c[self.gap] * area(u, self.params, self.k) * u
        return self.c[self.gap] * area_primitive(u, self.params, self.k)


# 7. Collocation ----------------------------------------------------------------------------------------------


class _Nodes:
    """Collocation nodes on (0, 1], integration matrix, interpolation through start value and stages."""

    def __init__(self, family: str, stages: int) -> None:
        if family == "radau":
            inner, _ = roots_jacobi(stages - 1, 1.0, 0.0)
            x = np.append(inner, 1.0)
        elif family == "gauss":
            x, _ = roots_legendre(stages)
        else:
            raise ValueError(f"method must be 'radau' or 'gauss', got {family!r}")
        self.x, self.tau = x, 0.5 * (x + 1.0)
        self.to_legendre = np.linalg.inv(legendre.legvander(x, stages - 1))
        self.integrate = self._antiderivative(x) @ self.to_legendre
        self.weights = (self._antiderivative(np.array([1.0])) @ self.to_legendre)[0]
        full = np.append(-1.0, x)
        self.tail = np.linalg.inv(legendre.legvander(full, stages))[-2:]
        difference = full[:, None] - full[None, :]
        np.fill_diagonal(difference, 1.0)
        self.full, self.bary = full, 1.0 / np.prod(2.0 * difference, axis=1)

    def _antiderivative(self, x: np.ndarray) -> np.ndarray:
        """Rows: integrals from 0 to tau(x) of the Legendre polynomials, with respect to tau."""
        p = legendre.legvander(x, len(self.x))
        degrees = np.arange(1, len(self.x))
        return 0.5 * np.column_stack([p[:, 0] + p[:, 1], (p[:, 2:] - p[:, :-2]) / (2 * degrees + 1)])

    def antiderivative(self, x: np.ndarray) -> np.ndarray:
        """Matrix (len(x), stages): integral from 0 to tau(x) of the interpolant through stage values."""
        return self._antiderivative(x) @ self.to_legendre

    def interpolation(self, x: np.ndarray) -> np.ndarray:
        """Matrix (len(x), stages + 1): values at x in [-1, 1] from the start value and the stage values."""
        d = x[:, None] - self.full
        hit = d == 0.0
        d[hit] = 1.0
        rows = self.bary / d
        rows[hit.any(axis=1)] = hit[hit.any(axis=1)]
        return rows / rows.sum(axis=1, keepdims=True)


@lru_cache(maxsize=8)
def _nodes(family: str, stages: int) -> _Nodes:
    return _Nodes(family, stages)


@dataclass(frozen=True)
class _Step:
    t: float
    h: float
    s: float
    source: Waveform
    w: np.ndarray  # (stages + 1, n): start value and stages
    v: np.ndarray  # (stages + 1,): s u_a there
    leak: np.ndarray  # (stages,): current through the gap resistance, A
    force: np.ndarray  # (stages,): F_el, N
    q_leak: float  # integrals up to t
    force_integral: float
    u_end: np.ndarray


@dataclass(frozen=True)
class Fold:
    """Where the `mobile` law lost its solution: time s, gap voltage V, source V just before, and what was left.

    `margin`: of the rise of p(u) (see `_Stack.rise`), 0 at the fold; past it, after a jump, how far p is off, V.
    """

    t: float
    u_gap: float
    source: float
    margin: float


@dataclass(frozen=True)
class Transient:
    """Result of `transient`."""

    t: np.ndarray  # (m,) output times, s
    u: np.ndarray  # (m, n_layers) layer voltages, V; right-hand values at jumps; NaN after a fold
    area: np.ndarray  # (m,) ridge area, m^2
    force: np.ndarray  # (m,) electroadhesive force F_el, N
    q: np.ndarray  # (m,) charge through the terminals since before the start, a jump at the start included, C
    fold: Fold | None
    zeros: tuple[float, ...]  # times of the zero crossings of u_a that ended a step, s
    stack: _Stack = field(repr=False)
    nodes: _Nodes = field(repr=False)
    steps: tuple[_Step, ...] = field(repr=False)
    u_before: float = field(repr=False)

    @property
    def u_gap(self) -> np.ndarray:
        """Gap voltage, V."""
        return self.u[:, self.stack.gap]

    def at(self, t: Sequence[float] | np.ndarray, side: str = "right") -> Transient:
        """The same run at other output times (s); `side` 'right' or 'left' chooses the value at a jump."""
        return _sample(self, np.atleast_1d(np.asarray(t, dtype=float)), side)

    def force_integral(self, t: float) -> float:
        """Integral of F_el from the start to t, N s, by the collocation quadrature."""
        step = self.steps[_place(self.steps, t, "left")]
        x = np.array([2.0 * (t - step.t) / step.h - 1.0])
        return step.force_integral + step.h * float((self.nodes.antiderivative(x) @ step.force)[0])

    def mean_force(self, t0: float, t1: float) -> float:
        """Mean of F_el over [t0, t1], N."""
        return (self.force_integral(t1) - self.force_integral(t0)) / (t1 - t0)

    def current(self, t: float, slope: float) -> float:
        """Regular part of the current through the terminals at t (right-hand), A; `slope` = dU/dt in V/s."""
        stack, step = self.stack, self.steps[_place(self.steps, t, "right")]
        u, a, da = (x[0] for x in _fields_on_step(stack, self.nodes, step, np.array([t])))
        j, c = stack.gap, stack.c[stack.gap]
        leak = u * (stack.g_total + a * stack.g_area)
        share_of_leaks = float(stack.b_of_w[j] @ leak)  # d B_gap / dt, times A under `local`
        if not stack.mobile:
            return slope / stack.elastance * a + share_of_leaks + leak[j]
        b = (u[j] - float(step.source(np.float64(t))) * stack.share[j]) * c * a
        du = (slope * stack.share[j] + share_of_leaks / (c * a)) / (1.0 + step.s * b * da / (c * a**2))
        return c * (a * du + step.s * da * du * u[j]) + leak[j]

    def extremes(self, t0: float, t1: float, samples: int = 60) -> dict[str, float]:
        """Extremes over [t0, t1] of |u_a| (V) and F_el (N), one-sided values at jumps included."""
        lows: dict[str, float] = {}
        steps = [step for step in self.steps if step.t + step.h > t0 and step.t < t1]
        for name, sign in product(("u_gap", "force"), (1.0, -1.0)):
            best, sampled = math.inf, []
            for step in steps:
                x = np.linspace(max(0.0, (t0 - step.t) / step.h), min(1.0, (t1 - step.t) / step.h), samples)
                sampled.append((step, x, sign * self.at_fractions(step, x, name)))
            least = min((float(y.min()) for _, _, y in sampled), default=math.inf)
            for step, x, y in sampled:
                # Between two samples the signal goes no further beyond them than it goes from one to the next.
                if y.min() - np.abs(np.diff(y)).max() <= least:
                    best = min(best, _refine(lambda f, s=step, q=name, k=sign: k * self.at_fractions(s, f, q), x, y))
            lows[f"{name}_{'min' if sign > 0.0 else 'max'}"] = sign * best
        return lows

    def at_fractions(self, step: _Step, theta: np.ndarray, name: str) -> np.ndarray:
        """|u_a| (V) or F_el (N) at fractions of a step, whose length may be a rounding of its time."""
        u, a, _ = _fields_at(self.stack, self.nodes, step, theta)
        ua = np.abs(u[:, self.stack.gap])
        return ua if name == "u_gap" else self.stack.sigma_per_u2 * ua**2 * a


def _refine(function: Callable[[np.ndarray], np.ndarray], x: np.ndarray, y: np.ndarray) -> float:
    """Minimum of a smooth function on [0, 1] near its smallest sample: five rounds of zoomed sampling."""
    for _ in range(5):
        j = int(np.argmin(y))
        if j in (0, len(x) - 1) and x[-1] - x[0] < 1e-12:
            break
        x = np.linspace(x[max(j - 1, 0)], x[min(j + 1, len(x) - 1)], 21)
        y = function(x)
    return float(np.min(y))


def _place(steps: Sequence[_Step], t: float, side: str) -> int:
    """Number of the step that a time is in."""
    found = (bisect.bisect_right if side == "right" else bisect.bisect_left)(steps, t, key=lambda step: step.t)
    return max(found - 1, 0)


def _fields_on_step(stack: _Stack, nodes: _Nodes, step: _Step, t: np.ndarray) -> tuple[np.ndarray, ...]:
    """Layer voltages (m, n), area (m,) and dA/d(s u_a) (m,) at times t inside one step."""
    return _fields_at(stack, nodes, step, np.clip((t - step.t) / step.h, 0.0, 1.0))


def _fields_at(stack: _Stack, nodes: _Nodes, step: _Step, theta: np.ndarray) -> tuple[np.ndarray, ...]:
    """As `_fields_on_step`, at fractions of the step: its length may be a rounding of its time."""
    x = 2.0 * theta - 1.0
    w = nodes.interpolation(x) @ step.w
    nearby = step.v[np.argmin(np.abs(x[:, None] - nodes.full), axis=1)]
    drive = np.asarray(step.source(step.t + theta * step.h), dtype=float) + np.zeros_like(theta)
    return stack.closed(drive, w, step.s, nearby)


def _sample(run: Transient, t: np.ndarray, side: str) -> Transient:
    stack, nodes = run.stack, run.nodes
    u, a, q = np.full((len(t), stack.n), np.nan), np.full(len(t), np.nan), np.full(len(t), np.nan)
    if not run.steps:
        return replace(run, t=t, u=u, area=a, force=a.copy(), q=q)
    t_end = run.steps[-1].t + run.steps[-1].h
    groups: dict[int, list[int]] = {}
    for i, ti in enumerate(t):
        if not run.steps[0].t <= ti <= t_end * (1.0 + 1e-15):
            if run.fold is not None and ti > t_end:
                continue
            raise ValueError(f"output time {ti} s outside [{run.steps[0].t}, {t_end}] s")
        groups.setdefault(_place(run.steps, ti, side), []).append(i)
    for j, index in groups.items():
        step = run.steps[j]
        ti = t[index]
        try:
            u[index], a[index], _ = _fields_on_step(stack, nodes, step, ti)
        except _NoStep:
            # The last step before a fold may pass it by rounding.
            if run.fold is None:
                raise RuntimeError(f"no voltages at t = {ti[0]} s, in a step that has them at its nodes") from None
            continue
        x = np.clip(2.0 * (ti - step.t) / step.h - 1.0, -1.0, 1.0)
        q[index] = step.q_leak + step.h * (nodes.antiderivative(x) @ step.leak)
    known = ~np.isnan(q)
    q[known] += stack.stored(u[known, stack.gap]) - stack.stored(run.u_before)
    force = stack.sigma_per_u2 * u[:, stack.gap] ** 2 * a
    return replace(run, t=t, u=u, area=a, force=force, q=q)


def _collocate(
    stack: _Stack, nodes: _Nodes, t: float, h: float, u: np.ndarray, source: Waveform, s: float, scale: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Solve one step: w (stages + 1, n), stage voltages (stages, n), stage areas (stages,)."""
    m, n = len(nodes.tau), stack.n
    w0 = stack.gauge(u)
    drive = np.asarray(source(t + h * nodes.tau), dtype=float) + np.zeros(m)
    if not np.all(np.isfinite(drive)):
        raise ValueError(f"source is not finite in [{t}, {t + h}] s")
    z, unit, v = np.zeros((m, n)), stack.w_scale(u), np.full(m, s * u[stack.gap])
    # The gap voltage is an unknown of its own under `mobile`: at a fold it does not follow from w any more.
    extra = m if stack.mobile else 0
    for _ in range(60):
        us, a, da = stack.fields(drive, w0 + z, s, v)
        f = stack.rates(us, a)
        f = f - f[:, stack.gap, None]  # gauge: the gap's w stands still, so w is constant at DC
        jac = stack.rates_jacobian(w0 + z, us, a, da, s)
        jac = (jac - jac[:, stack.gap, None, :]) / unit[:, None]
        jac[:, :, :n] *= unit
        blocks = nodes.integrate[:, None, :, None] * jac[:, :, :n].transpose(1, 0, 2)[None]
        system = np.eye(m * n + extra)
        system[: m * n, : m * n] -= h * blocks.reshape(m * n, m * n)
        left, slope = [((h * nodes.integrate @ f - z) / unit).ravel()], 1.0
        if stack.mobile:
            miss, by_w, slope = stack.equation(drive, w0 + z, s, v, a, da)
            by_v = nodes.integrate[:, None, :] * jac[None, :, :, n].transpose(0, 2, 1)
            system[: m * n, m * n :] = -h * by_v.reshape(m * n, m)
            system[m * n :, : m * n] = (np.eye(m)[:, :, None] * (by_w * unit)[:, None, :]).reshape(m, m * n)
            system[m * n :, m * n :] = np.diag(slope)
            left.append(-miss)
        if not np.all(np.isfinite(system)):
            raise _NoStep("newton")
        try:
            delta = np.linalg.solve(system, np.concatenate(left))
        except np.linalg.LinAlgError:
            raise _NoStep("newton") from None
        if not np.all(np.isfinite(delta)):
            raise _NoStep("newton")
        damping = 1.0
        if stack.mobile:
            # No farther at once than the area changes by a third.
            while damping > 1e-6 and not np.all(np.abs(np.log(stack.area(v + damping * delta[m * n :])[0] / a)) < 0.3):
                damping *= 0.5
            v = v + damping * delta[m * n :]
        z = z + damping * delta[: m * n].reshape(m, n) * unit
        if damping == 1.0 and np.max(np.abs(delta)) <= 1e-9 * scale:
            if not np.all(slope > 0.0):
                raise _NoStep("fold")
            us, a, _ = stack.fields(drive, w0 + z, s, v)
            return np.vstack([w0, w0 + z]), us, a
    raise _NoStep("newton")


def _first_zero(stack: _Stack, nodes: _Nodes, step: _Step, scale: float, us: np.ndarray) -> float | None:
    """Fraction of the step at which s u_a first falls through zero, or None."""
    j, tau = stack.gap, np.linspace(0.0, 1.0, 2 * len(nodes.tau) + 1)[1:]
    noise = 1e-12 * scale
    inside = np.append(step.s * us[:, j], step.s * step.u_end[j])
    if np.min(inside) > -noise:
        return None

    def value(x: float) -> float:
        return float(step.s * _fields_at(stack, nodes, step, np.array([x]))[0][0, j])

    grid = np.union1d(np.append(nodes.tau, 1.0), tau)
    values = step.s * _fields_at(stack, nodes, step, grid)[0][:, j]
    bad = int(np.argmax(values < -noise))
    if values[bad] >= -noise:
        return None
    low = float(grid[bad - 1]) if bad > 0 else 0.0
    if value(low) <= 0.0:
        return low if low > 0.0 else None
    return float(brentq(value, low, float(grid[bad]), xtol=1e-15, rtol=1e-15))


class NoStepError(RuntimeError):
    """The collocation finds no step beyond the time `t`, s, and no fold there either."""

    def __init__(self, t: float, message: str) -> None:
        self.t = t
        super().__init__(message)


class _Run:
    """The state of one transient while it is computed."""

    def __init__(self, stack: _Stack, nodes: _Nodes, scale: float, tol: float) -> None:
        self.stack, self.nodes, self.scale, self.tol = stack, nodes, scale, tol
        self.steps: list[_Step] = []
        self.zeros: list[float] = []
        self.q_leak = self.force_integral = 0.0
        self.fold: Fold | None = None

    def attempt(self, t: float, h: float, u: np.ndarray, source: Waveform, s: float) -> tuple[_Step, np.ndarray]:
        """One collocation step, not yet accepted."""
        stack = self.stack
        w, us, a = _collocate(stack, self.nodes, t, h, u, source, s, self.scale)
        g = stack.g_total[stack.gap] + a * stack.g_area[stack.gap]
        ua = us[:, stack.gap]
        v, force = s * np.append(u[stack.gap], ua), stack.sigma_per_u2 * ua**2 * a
        step = _Step(t, h, s, source, w, v, g * ua, force, self.q_leak, self.force_integral, us[-1])
        end = _fields_at(stack, self.nodes, step, np.array([1.0]))[0][0]
        if stack.mobile:
            # Newton's iteration may have leapt past a fold to voltages that no motion leads to.
            before, after = np.array([u, *us]), np.array([*us, end])
            one, other, kk = before[:, stack.gap], after[:, stack.gap], stack.margin_kk(after)
            leapt = (one * other > 0.0) & (np.abs(one - other) > 0.1 * np.minimum(np.abs(one), np.abs(other)))
            between = np.geomspace(one[leapt], other[leapt], 200)
            at = np.concatenate([one, other, between.ravel()])
            held = np.concatenate([kk, kk, np.broadcast_to(kk[leapt], between.shape).ravel()])
            if stack.rises(at, held, s).min() <= 0.0:
                raise _NoStep("fold")
        return replace(step, u_end=end), us

    def sign(self, t: float, h: float, u: np.ndarray, source: Waveform) -> float:
        """Sign of u_a on the piece that starts at t."""
        ua, j = u[self.stack.gap], self.stack.gap
        if abs(ua) > 1e-12 * self.scale:
            return math.copysign(1.0, ua)
        for _ in range(60):
            try:
                _, us = self.attempt(t, h, u, source, 1.0)
                return 1.0 if us[0, j] >= 0.0 else -1.0
            except _NoStep:
                h *= 0.25
        return 1.0

    def segment(self, start: float, t1: float, u: np.ndarray, source: Waveform) -> np.ndarray:
        """Integrate over one smooth segment; returns the voltages at its end (left-hand).

        Time is counted from the start of the segment: what decays there may be faster than the rounding of t1.
        """
        stack, nodes = self.stack, self.nodes
        length = t1 - start
        tau, h = 0.0, length
        s = self.sign(start, 1e-3 * h, u, source)
        while tau < length:
            last = h >= (length - tau) * (1.0 - 1e-12)
            h = length - tau if last else h
            t = start + tau
            least = 1e-12 * tau + 1e-25 * length
            try:
                step, us = self.attempt(t, h, u, source, s)
                tail = np.abs(nodes.tail @ (step.w - step.w[0])) / stack.w_scale(u)
                error = float(np.max(tail)) / (self.tol * self.scale)
                cut = _first_zero(stack, nodes, step, self.scale, us) if error <= 1.0 else None
            except _NoStep as reason:
                if h < least:
                    self.fold_at(t, u, source, s, str(reason))
                    return u
                h *= 0.4
                continue
            if error > 1.0:
                h *= max(0.2, 0.8 * error ** (-1.0 / len(nodes.tau)))
                if h < least:
                    raise RuntimeError(f"step underflow at t = {t} s")
                continue
            h_next = h * min(3.0, 0.85 * max(error, 1e-12) ** (-1.0 / len(nodes.tau)))
            if cut is not None:
                h_cut = h * cut
                try:
                    for _ in range(2):  # once more: the cut step is not the same polynomial
                        step, _ = self.attempt(t, h_cut, u, source, s)
                        h_cut = self.polish(step)
                    step, _ = self.attempt(t, h_cut, u, source, s)
                except _NoStep as reason:
                    raise RuntimeError(f"no step to the zero at t = {t + h_cut} s: {reason}") from None
                last = False
            u = step.u_end
            self.steps.append(step)
            self.q_leak += step.h * float(nodes.weights @ step.leak)
            self.force_integral += step.h * float(nodes.weights @ step.force)
            tau = length if last else tau + step.h
            h = max(h_next - step.h, 0.2 * h_next) if cut is not None else h_next
            if cut is not None:
                self.zeros.append(start + tau)
                s = -s
                if stack.mobile and stack.rise(0.0, self.stored(u), s) <= 0.0:
                    # The area turns at 0 V, and with it the equation: no voltage leads on.
                    now = start + tau
                    self.fold = Fold(now, 0.0, float(source(np.float64(now))), 0.0)
                    return u
            elif abs(u[stack.gap]) <= 1e-12 * self.scale and tau < length:
                s = self.sign(start + tau, 1e-3 * min(h, length - tau), u, source)
        return u

    def polish(self, step: _Step) -> float:
        """Step length after one Newton correction onto u_a = 0 at its end."""
        j, d = self.stack.gap, 1e-3
        ends = _fields_at(self.stack, self.nodes, step, np.array([1.0 - d, 1.0]))[0][:, j]
        slope = (ends[1] - ends[0]) / d
        if slope == 0.0:
            return step.h
        return step.h * (1.0 - float(np.clip(ends[1] / slope, -d, d)))

    def stored(self, u: np.ndarray) -> float:
        """kk of `fold_margin` for layer voltages u."""
        return float(self.stack.margin_kk(u[None])[0])

    def fold_at(self, t: float, u: np.ndarray, source: Waveform, s: float, reason: str) -> None:
        """Record the fold, which steps have come up to until they were rounding of the time."""
        stack = self.stack
        rise = stack.rise(float(u[stack.gap]), self.stored(u), s) if stack.mobile else math.inf
        if not rise < 1e-3:
            raise NoStepError(t, f"collocation failed at t = {t} s ({reason}), u = {u} V, {rise} from a fold")
        self.fold = Fold(t, float(u[stack.gap]), float(source(np.float64(t))), rise)


def dc_operating_point(
    source: float,
    layers: Sequence[Layer],
    params: Parameters = TABLE1,
    *,
    gap: int = GAP,
    k: float = 1.0,
    frozen: float | None = None,
) -> np.ndarray:
    """Layer voltages at DC, V: resistances in series, R = r_area / A for area-scaled leakage, A = g(|u_a|).

    Raises ValueError where the divider is undefined (two or more layers without leakage).
    """
    blocked = [math.isinf(x.r_total) and math.isinf(x.r_area) for x in layers]
    if sum(blocked) > 1:
        raise ValueError("DC operating point undefined: two layers or more without leakage")

    def divide(a: float) -> np.ndarray:
        if any(blocked):
            return source * np.array(blocked, dtype=float)
        r = np.array([1.0 / (1.0 / x.r_total + a / x.r_area) for x in layers])
        return source * r / r.sum()

    if frozen is not None or any(blocked):
        return divide(frozen if frozen is not None else 1.0)
    sign = 1.0 if source >= 0.0 else -1.0

    def miss(v: float) -> float:
        return v - sign * divide(float(area(v, params, k)))[gap]

    high, xtol = abs(source) + 1e-300, 1e-15 * abs(source) + 1e-300
    v = brentq(miss, 0.0, high, xtol=xtol, rtol=1e-15) if source else 0.0
    return divide(float(area(v, params, k)))


def transient(
    segments: Sequence[Segment],
    t_out: Sequence[float],
    *,
    law: str = "local",
    params: Parameters = TABLE1,
    freq: float | None = None,
    layers: Sequence[Layer] | None = None,
    gap: int = GAP,
    area_mode: str | float = "coupled",
    k: float = 1.0,
    start: str | Sequence[float] = "uncharged",
    method: str = "radau",
    stages: int = 12,
    tol: float = 1e-14,
) -> Transient:
    """Transient of N layers in series under an ideal source, to about 1e-13 of the peak voltage.

    `segments` are (t0, t1, U) in order, without holes, U smooth on each and a function of arrays in s, or a
    number. The skin of the default stack is evaluated at `freq` (Hz); `layers` and `gap` are another stack and the
    index of its gap. `area_mode` is 'coupled' (A = g(|u_a|) at every instant), 'frozen' (A = g(0), friction included)
    or an area in m^2; `start` is 'uncharged' (all layers at 0 V; U(t0) then jumps in, split by 1/c_x), 'dc' (operating
    point of U(t0)), or the layer voltages before t0 in V. `method`, `stages` and `tol` are the collocation family
    'radau' or 'gauss', its stages, and the bound on the last two Legendre coefficients of every step relative to the
    peak source (or start) voltage. Values at a jump are right-hand values; at the last time, left-hand ones. Under
    `mobile` a fold ends the run: `fold` says where, later outputs are NaN.

    Charge: q = c_a (G(u_a) - G(u_a before)) + int u_a / R_a dt with G the primitive of A(|u|), exact also across jumps
    (`local`); c_a A u_a replaces c_a G under `mobile`. Accuracy, relative to the peak: Radau 12, Gauss 16 and Radau 9
    agree to 3e-15, and with DOP853 at 1e-13 to 1.6e-13, its own error. Fold times: 1e-11 of the period where u_a runs
    into the fold (10 nm gap), 1e-7 at F_N = 1e-4 N (slaved gap).
    """
    if layers is None:
        if freq is None:
            raise ValueError("freq (Hz) is required when layers are not given")
        layers = table1_layers(freq, params)
    if isinstance(area_mode, str) and area_mode not in ("coupled", "frozen"):
        raise ValueError(f"area_mode must be 'coupled', 'frozen' or an area in m^2, got {area_mode!r}")
    frozen = None
    if area_mode != "coupled":
        frozen = float(area(0.0, params, k) if area_mode == "frozen" else area_mode)
    stack, nodes = _Stack(layers, gap, law, params, k, frozen), _nodes(method, stages)
    parts = [(float(s[0]), float(s[1]), s[2] if callable(s[2]) else _hold(float(s[2]))) for s in segments]
    first = float(parts[0][2](np.float64(parts[0][0])))
    if isinstance(start, str):
        if start not in ("uncharged", "dc"):
            raise ValueError(f"start must be 'uncharged', 'dc' or voltages, got {start!r}")
        u = np.zeros(stack.n)
        if start == "dc":
            u = dc_operating_point(first, layers, params, gap=gap, k=k, frozen=frozen)
    else:
        u = np.asarray(start, dtype=float)
    peak = max(float(np.max(np.abs(p[2](np.linspace(p[0], p[1], 65))))) for p in parts)
    scale = max(peak, float(np.max(np.abs(u))), 1e-300)
    run, u_before = _Run(stack, nodes, scale, tol), float(u[gap])
    for t0, t1, source in parts:
        try:
            u = stack.jump(u, float(source(np.float64(t0))))
        except FoldError as fold:
            run.fold = Fold(t0, fold.u_gap, float(source(np.float64(t0))), fold.margin)
            break
        u = run.segment(t0, t1, u, source)
        if run.fold is not None:
            break
    none = [np.empty(0)] * 5
    return Transient(*none, run.fold, tuple(run.zeros), stack, nodes, tuple(run.steps), u_before).at(t_out)


def periodic_state(segments: Sequence[Segment], *, t_out: Sequence[float] = (), **options: object) -> Transient:
    """One period, that of `segments`, whose start reproduces its end (to about 1e-13 of the peak voltage).

    Options are as in `transient`.
    """

    def end(u: str | np.ndarray) -> np.ndarray:
        run = transient(segments, [], start=u, **options)
        if run.fold is not None:
            raise FoldError(run.fold.margin, run.fold.u_gap)
        return run.steps[-1].u_end

    # Two periods from the uncharged state, before the Newton iteration on the period map
    u = end(end("uncharged"))
    n, scale = u.size, max(1e-300, float(np.max(np.abs(u))))
    basis = (np.eye(n) - 1.0 / n)[:, : n - 1]  # directions that keep the sum of the voltages
    base = end(u)
    size = 1e-5 * scale
    columns = [np.linalg.lstsq(basis, (end(u + size * d) - base) / size, rcond=None)[0] for d in basis.T]
    chord = np.linalg.inv(np.eye(n - 1) - np.array(columns).T)
    last = math.inf
    for _ in range(25):
        defect = np.linalg.lstsq(basis, base - u, rcond=None)[0]
        worst = float(np.max(np.abs(defect)))
        if worst < 2e-15 * scale or (worst < 1e-12 * scale and worst >= last):
            break
        last = worst
        u = u + basis @ (chord @ defect)
        base = end(u)
    else:
        raise RuntimeError(f"period map did not converge: defect {worst} V")
    return transient(segments, t_out, start=u, **options)


# 8. The same equations by DOP853, in two other forms: the check of section 7 ------------------------------------


@np.errstate(all="ignore")
def _dop_pieces(
    rhs: Callable[[float, np.ndarray, float], np.ndarray],
    gap_voltage: Callable[[float, np.ndarray, float], float],
    t: float,
    y: np.ndarray,
    stops: Sequence[float],
    rtol: float,
    atol: np.ndarray,
    scale: float,
) -> list[np.ndarray]:
    """States at `stops`, by DOP853, restarted on every stop and on every zero of the gap voltage.

    A trial step far too long may overflow (less area, faster leakage): its error is then not finite and
    scipy's step control shortens it, so the floating-point warnings are switched off here.
    """
    out, first = [], None
    ua = gap_voltage(t, y, 1.0)
    s = math.copysign(1.0, ua)
    if abs(ua) < 1e-12 * scale:
        t_try = t + 1e-6 * (stops[-1] - t)
        s = 1.0 if gap_voltage(t_try, y + (t_try - t) * rhs(t, y, 1.0), 1.0) >= 0.0 else -1.0
    for stop in stops:
        while t < stop:
            begin = None if first is None else min(first, stop - t)
            solver = DOP853(lambda t, y, s=s: rhs(t, y, s), t, y, stop, rtol=rtol, atol=atol, first_step=begin)
            while solver.status == "running":
                message = solver.step()
                if solver.status == "failed":
                    raise RuntimeError(f"DOP853 failed at t = {solver.t} s: {message}")
                if solver.t < stop:
                    first = solver.step_size
                if s * gap_voltage(solver.t, solver.y, s) < -1e-13 * scale:
                    break
            ended = s * gap_voltage(solver.t, solver.y, s)
            if ended >= -1e-13 * scale:
                t, y = solver.t, solver.y
                continue
            dense, t_old = solver.dense_output(), solver.t_old
            y_old = dense(t_old)
            zero = brentq(
                lambda t, s=s, dense=dense: gap_voltage(t, dense(t), s), t_old, solver.t, xtol=1e-18, rtol=1e-15
            )
            for tries in range(4):  # land on the zero by steps, not by the (less accurate) dense output
                cut = DOP853(lambda t, y, s=s: rhs(t, y, s), t_old, y_old, zero, rtol=rtol, atol=atol)
                while cut.status == "running":
                    cut.step()
                miss = gap_voltage(zero, cut.y, s)
                d = 1e-4 * (zero - t_old)
                slope = (gap_voltage(zero + d, cut.y + d * rhs(zero, cut.y, s), s) - miss) / d
                if abs(miss) < 1e-14 * scale or slope == 0.0 or zero - miss / slope == zero or tries == 3:
                    break
                zero -= miss / slope
            t, y, s, first = zero, cut.y, -s, cut.step_size
        out.append(y.copy())
    return out


def dop853_leak(
    segments: Sequence[Segment], t_out: Sequence[float], *, freq: float, law: str = "local", rtol: float
) -> tuple[np.ndarray, np.ndarray]:
    """Leaked charge of either law by DOP853 from rest, in an absolute gauge.

    `local`: lambda_x' = u_x/(R_x A), D = (U + sum lambda/c)/S. `mobile`: l_x' = u_x/R_x, Q = (A U + sum l/c)/S with
    the gap voltage from the bracketed scalar equation. Arguments as in `transient`, but every output lies inside a
    segment or on its edge (right-hand value). Returns the layer voltages, (len(t_out), 3) in V, and D in
    C/m^2 (`local`) or Q in C (`mobile`; here the charge through the terminals).
    """
    layers = table1_layers(freq)
    c = np.array([x.c for x in layers])
    elastance = float(np.sum(1.0 / c))
    a_zero = float(area(0.0))

    def fields(source: float, w: np.ndarray, s: float | None) -> tuple[np.ndarray, float, float]:
        if law == "local":
            d = (source + float(np.sum(w / c))) / elastance
            u = (d - w) / c
            return u, float(contact(abs(u[GAP]) if s is None else s * u[GAP])[1]), d
        leaked = (float(np.sum(w / c)) / elastance - w[GAP]) / (c[GAP] * a_zero)
        ua = mobile_gap_voltage(source / elastance / c[GAP], leaked, branch=s)
        a = float(area(ua))
        q = (a * source + float(np.sum(w / c))) / elastance
        return (q - w) / (a * c), a, q

    w, found = np.zeros(3), {}
    for t0, t1, source in segments:

        def rhs(t: float, w: np.ndarray, s: float, source: Waveform = source) -> np.ndarray:
            u, a, _ = fields(float(source(t)), w, s)
            g = np.array([1.0 / x.r_total + a / x.r_area for x in layers])
            return u * g / a if law == "local" else u * g

        def gap_voltage(t: float, w: np.ndarray, s: float, source: Waveform = source) -> float:
            return float(fields(float(source(t)), w, s)[0][GAP])

        scale = max(abs(float(source(t))) for t in np.linspace(t0, t1, 33))
        atol = rtol * scale * c * (1.0 if law == "local" else a_zero)
        stops = [t for t in sorted(set(t_out)) if t0 < t < t1] + [t1]
        states = _dop_pieces(rhs, gap_voltage, t0, w, stops, rtol, atol, scale)
        for t, state in zip([t0, *stops], [w, *states], strict=True):
            found[t] = fields(float(source(t)), state, None)[::2]
        w = states[-1]
    return np.array([found[t][0] for t in t_out]), np.array([found[t][1] for t in t_out])
