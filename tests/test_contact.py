"""Ridge contact area: Eqs. 1 to 7 against references of 30 and more digits, and the laws that the equations obey."""

import math

import mpmath as mp
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

import fingerspice as fs
from analytic import TABLE1, Parameters, area_mp, contact, jkr_area, jkr_parameters, work_factor
from fingerspice.circuit.statespace import build_stack
from fingerspice.physics.contact import JkrContact, inverse_area, ridge_area, universal_curve
from fingerspice.physics.materials import SKIN_LADDER
from scenes import cases, dispersive_deck, refuses, table1

SEARCH = settings(max_examples=60, derandomize=True, deadline=None)
MM2 = 1e6


def from_parameters(p: Parameters, work_ratio: float = 1.0) -> JkrContact:
    return JkrContact(p.d_a, p.eps_a, p.force_normal, p.mu0, p.alpha, p.m, p.beta, p.n, p.c2, work_ratio)


PAPER = from_parameters(TABLE1)


def curve_mp(x: float, inv_m: float, p: float, dps: int = 35) -> mp.mpf:
    """Root y > 1 of y^inv_m - x y^p = 1 by bisection in ln y: slow, and sure."""
    with mp.workdps(dps + 20):
        x, inv_m, p = mp.mpf(x), mp.mpf(inv_m), mp.mpf(p)

        def residual(log_y: mp.mpf) -> mp.mpf:
            return inv_m * log_y - mp.log1p(x * mp.exp(p * log_y))

        low, high = mp.mpf(0), mp.mpf(1)
        while residual(high) < 0:
            high *= 2
        # 60 bisections, then secant steps inside the bracket.
        for _ in range(60):
            middle = (low + high) / 2
            low, high = (middle, high) if residual(middle) < 0 else (low, middle)
        if x == 0:
            return mp.mpf(1)
        log_y = mp.findroot(residual, (low, high), solver="anderson", tol=mp.mpf(10) ** (-2 * dps), verify=False)
        assert low <= log_y <= high
        assert abs(residual(log_y)) < mp.mpf(10) ** (-dps) * (inv_m * log_y + mp.mpf(10) ** -320)
        return mp.exp(log_y)


RANGE = (0.0, 1e-300, 1e-16, 1e-8, 1e-3, 0.123, 0.55, 1.0, math.nextafter(1.0, 2.0), 1.3, 1.8, 1.98, 2.3, 4.6)


@pytest.mark.parametrize("x", [*RANGE, 50.0, 1e3, 1e6])
def test_the_universal_curve_of_the_papers_exponents_is_exact_to_1e_13_over_its_whole_range(x: float) -> None:
    inv_m = 1.0 / 0.52
    p = 0.5 * (1.0 + inv_m - 1.0 / 1.41)
    exact = curve_mp(x, inv_m, p)
    assert abs(universal_curve(x, inv_m, p) / exact - 1) < 1e-13


@settings(max_examples=40, derandomize=True, deadline=None)
@given(m=st.floats(0.02, 1.9), over=st.floats(1.01, 40.0), log_x=st.floats(-12.0, 6.0))
def test_the_universal_curve_is_exact_to_1e_13_for_any_legal_exponents(m: float, over: float, log_x: float) -> None:
    n = m * over
    inv_m = 1.0 / m
    p = 0.5 * (1.0 + inv_m - 1.0 / n)
    # Legal is 1/m + 1/n > 1. At the limit the rounding of 1/m and p alone costs more: stay 0.1 away, and leave
    # out areas of more than a million times the unloaded one.
    assume(1.0 / m + 1.0 / n > 1.1)
    x = 10.0**log_x
    exact = curve_mp(x, inv_m, p)
    assume(exact < 1e6)
    assert abs(universal_curve(x, inv_m, p) / exact - 1) < 1e-13


@pytest.mark.parametrize(("u", "a0", "a", "f_el", "f_t"), [
    (0.0, 37.9370277247, 34.9715871843, 0.0, 0.15),
    (100.0, 39.1785016088, 34.6867464471, 0.125353654303, 0.187606096291),
    (200.0, 40.4716667764, 30.5985185509, 0.442317197142, 0.282695159143),
])  # fmt: skip
@pytest.mark.parametrize("finger", ["python", "netlist"])
def test_table_1_gives_golden_areas_and_forces(finger, u, a0, a, f_el, f_t):
    c = PAPER if finger == "python" else build_stack(table1()).contact
    assert c is not None
    assert float(c.area_adhesive(u)) * MM2 == pytest.approx(a0, abs=5.1e-11)
    assert float(c.area(u)) * MM2 == pytest.approx(a, abs=5.1e-11)
    force = float(c.stress(u) * c.area(u))
    assert force == pytest.approx(f_el, abs=5.1e-13)
    assert c.mu * (c.f_n + force) == pytest.approx(f_t, abs=5.1e-13)


def test_area_leaves_zero_volts_with_a_slope_of_13_11_square_millimetres_per_kilovolt() -> None:
    # Closed form: y' = m at X = 0, and dA/dA0 = 1 + c2 mu^2 F^2 / A0^2; X/|u| from Eq. 4 in the paper's mm and N.
    p = 0.5 * (1.0 + 1.0 / 0.52 - 1.0 / 1.41)
    a0 = 54.4 * 0.5**0.52
    w = 0.5 * 8.854e-12 / 3.5e-6 / 1000.0
    x = math.sqrt(2.0 * w * 1.41**2 / (1.41 - 0.52) * 32.0 ** (1.0 / 1.41) * 54.4 ** (-1.0 / 0.52)) * a0**p / 0.5
    slope = 0.52 * x * a0 * (1.0 + 5000.0 * (0.3 * 0.5 / a0) ** 2)
    assert slope * 1000.0 == pytest.approx(13.11, abs=5e-3)
    _, d_inverse = inverse_area(0.0, PAPER.curve(200.0))
    assert -d_inverse * float(PAPER.area(0.0)) ** 2 * MM2 == pytest.approx(slope, rel=1e-10)
    ahead = (float(PAPER.area(1e-3)) - float(PAPER.area(0.0))) * MM2 / 1e-3
    behind = (float(PAPER.area(0.0)) - float(PAPER.area(-1e-3))) * MM2 / 1e-3
    assert ahead == pytest.approx(slope, rel=1e-4)
    assert behind == pytest.approx(-slope, rel=1e-4)


fingers = st.builds(
    Parameters,
    **{name: st.just(getattr(TABLE1, name)) for name in ("eps0", "eps_i", "d_i", "d_sc", "r_i", "r_a")},
    **{name: st.floats(*ends) for name, ends in {
        "mu0": (0.0, 0.6), "force_normal": (1e-3, 2.0), "eps_a": (1.0, 3.0), "d_a": (0.05e-6, 20e-6), "m": (0.3, 0.75),
        "n": (0.9, 2.2), "alpha": (20e-6, 120e-6), "beta": (0.1, 1.0), "c2": (0.0, 5e-9),
    }.items()},
)  # fmt: skip


@settings(max_examples=25, derandomize=True, deadline=None)
# Below 1e-100 V the square of the voltage underflows, and with it the force.
@given(p=fingers, u=st.just(0.0) | st.floats(1e-100, 1000.0), k=st.sampled_from([1.0, 1.1, 1.5]))
def test_any_fingers_area_agrees_with_equations_1_to_4_solved_to_40_digits(p: Parameters, u: float, k: float) -> None:
    c = from_parameters(p, k)
    assume(c.exists)
    a0, a, f_el, _ = area_mp(u, p, k=k)
    own, force = float(c.area(u)), float(c.stress(u) * c.area(u))
    assert abs(c.area_adhesive(u) / a0 - 1) < 1e-13
    assert abs(own / a - 1) < 1e-13
    assert abs(force - f_el) <= 1e-13 * f_el
    # Eqs. 1 and 3, and an even function of the voltage.
    left = float(a0 - p.c2 / a0 * (p.mu0 * (p.force_normal + force)) ** 2)
    assert own == pytest.approx(left, rel=1e-13, abs=1e-13 * float(a0))
    assert 0.0 < own <= float(c.area_adhesive(u))
    assert float(c.area(-u)) == own


@SEARCH
@given(
    radius=st.floats(1e-3, 30e-3),
    e_star=st.floats(1e3, 1e6),
    force=st.floats(0.01, 2.0),
    u=st.floats(0.0, 1000.0),
    d=st.floats(0.1e-6, 10e-6),
)
def test_hertz_exponents_give_the_area_of_jkr_theory(radius, e_star, force, u, d):
    m, n, alpha, beta = jkr_parameters(radius, e_star)
    c = JkrContact(d, 1.0, force, 0.0, alpha, m, beta, n, 0.0)
    w = 8.854e-12 * u**2 / (2.0 * d)
    assert float(c.area_adhesive(u)) == pytest.approx(jkr_area(force, w, e_star, radius), rel=1e-13)
    assert float(c.area(u)) == float(c.area_adhesive(u)), "without friction nothing is lost"


@pytest.mark.parametrize("u_max", [1e-30, 1e-3, 1.0, 43.0, 200.0, 500.0, 1000.0, 3000.0, 1e4])
def test_the_curve_agrees_with_the_exact_area_over_its_range_and_beyond_its_end(u_max: float) -> None:
    packed = PAPER.packed
    curve = PAPER.curve(u_max)
    for u in np.linspace(0.0, 3.0 * u_max, cases(601, 121)):
        assert inverse_area(u, curve)[0] * ridge_area(u, packed) == pytest.approx(1.0, abs=1e-13)
    for u in np.array([0.2, 0.99, 1.0, 1.01, 2.9]) * u_max:
        assert abs(inverse_area(u, curve)[0] * area_mp(u)[1] - 1) < 1e-13


@settings(max_examples=25, derandomize=True, deadline=None)
@given(p=fingers, u_max=st.floats(1e-3, 3000.0))
def test_the_curve_of_any_finger_agrees_with_its_exact_area(p: Parameters, u_max: float) -> None:
    c = from_parameters(p)
    assume(c.exists)
    curve, packed = c.curve(u_max), c.packed
    for u in np.linspace(0.0, 1.3 * u_max, 80):
        assert inverse_area(u, curve)[0] * ridge_area(u, packed) == pytest.approx(1.0, abs=1e-13)


def test_the_curve_goes_on_analytically_a_little_past_the_kink() -> None:
    curve = PAPER.curve(200.0)
    for u in (-1e-6, -1.0, -10.0):
        _, a, da, _ = contact(u)
        inverse, slope = inverse_area(u, curve)
        assert inverse * a == pytest.approx(1.0, abs=1e-13)
        assert slope == pytest.approx(-da / a**2, rel=1e-10)
    # not the even function, which turns there
    assert 1.0 / inverse_area(-10.0, curve)[0] < float(PAPER.area(0.0)) < float(PAPER.area(10.0))


@pytest.mark.parametrize("u_max", [20.0, 200.0, 500.0, 2000.0])
def test_the_curves_slope_is_the_derivative_of_one_over_the_area(u_max: float) -> None:
    curve = PAPER.curve(u_max)
    for u in np.linspace(0.0, 1.5, 31) * u_max:
        _, a, da, _ = contact(u)
        inverse, slope = inverse_area(u, curve)
        # on the scale of the curve: its slope crosses zero at 43 V
        assert slope * u_max / inverse == pytest.approx(float(-da / a) * u_max, rel=1e-10, abs=1e-12)


@pytest.mark.parametrize("f", [10.0, 100.0, 5000.0, 1e5])
def test_with_the_total_voltage_held_the_area_is_larger_by_less_than_a_percent(f: float) -> None:
    held = build_stack(table1(f=f, extra=".options work=total")).contact
    assert held is not None
    k = work_factor(f)
    assert held.work_ratio == pytest.approx(k, rel=1e-14)
    for u, low, high in ((200.0, 0.003, 0.006), (300.0, 0.005, 0.0091)):
        assert abs(held.area(u) / area_mp(u, k=k)[1] - 1) < 1e-13
        assert low < float(held.area(u) / PAPER.area(u)) - 1.0 < high
    assert float(held.area(0.0)) == pytest.approx(float(PAPER.area(0.0)), rel=1e-15)


def test_with_the_total_voltage_held_a_dispersive_skin_counts_with_its_permittivity_above_all_poles() -> None:
    circuit = fs.parse_netlist(dispersive_deck(extra=".options work=total"))
    # The sum of d / eps_r over coating, gap and skin, over the gap's.
    for skin_at, eps in ((None, 1004.82), (100.0, float(SKIN_LADDER.permittivity([100.0])[0]))):
        held = build_stack(circuit, skin_at).contact
        assert held is not None
        assert held.work_ratio == pytest.approx((1e-6 / 3.9 + 3.5e-6 + 350e-6 / eps) / 3.5e-6, rel=1e-13)


def test_the_gap_voltage_is_held_unless_the_deck_says_otherwise() -> None:
    plain, named = (build_stack(table1(extra=extra)).contact for extra in ("", ".options work=gap"))
    assert plain == named
    assert plain.work_ratio == 1.0  # type: ignore[union-attr]


def test_a_contact_that_friction_takes_away_is_refused_before_the_run_exactly_where_it_does() -> None:
    # A0^2 = c2 mu^2 F^2 in Table 1's numbers, mm and N: A0 = 37.937 mm^2 = sqrt(c2) mu fn at this mu.
    limit = 54.4 * 0.5**0.52 / (math.sqrt(5000.0) * 0.5)
    assert PAPER.exists
    assert not JkrContact(3.5e-6, 1.0, 0.5, limit * 1.0001, 54.4e-6, 0.52, TABLE1.beta, 1.41, 5e-9).exists
    assert table1(gap={"mu": limit * (1.0 - 1e-12)})["Xgap"].values["mu"] < limit
    with pytest.raises(fs.InputError, match=r"Xgap has no contact: .*A0\^2 > c2 mu\^2 fn\^2") as caught:
        table1(gap={"mu": limit * (1.0 + 1e-12)})
    assert "37.94 mm^2" in str(caught.value)
    assert caught.value.where is not None
    assert caught.value.where.line == 5
    refuses("Xgap has no contact", table1, gap={"fn": 0.5 * (limit / 0.3) ** (1.0 / 0.48) * 1.001})
    for path, value in (("mu", 1.1), ("c2", 5000.0 * (limit / 0.3) ** 2 * 1.0001)):
        refuses("Xgap has no contact", table1().replace, {f"Xgap.{path}": value})
