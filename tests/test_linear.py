"""Linear modes in closed form, and tables of exponential steps, against quadrature and integrals in many digits."""

import itertools
from functools import cache

import mpmath as mp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.polynomial import chebyshev

from fingerspice.numerics import lobatto
from fingerspice.numerics.linear import respond
from fingerspice.numerics.lobatto import BETWEEN, FIRST, MISS, NODES, POINTS, ROWS, SECOND, TO_SERIES
from fingerspice.solve.problem import ROUNDING

NO_SERIES = np.zeros((1, 0))


def term(c=1.0, p=0, a=0.0, omega=0.0, phi=0.0):
    return [c, p, a, omega, phi, 0.0]


def integrals(count, rate, sigma, tau):
    """Integrals of exp(-rate (tau - s)) s^p exp(sigma s) over [0, tau] for p < count, to 40 digits."""
    rate, sigma, tau = mp.mpf(rate), mp.mpmathify(sigma), mp.mpf(tau)
    mu = rate + sigma
    if abs(mu * tau) < 1e-40:
        return [mp.exp(sigma * tau) * tau ** (p + 1) / (p + 1) for p in range(count)]
    wave = mp.exp(sigma * tau)
    out = [(wave - mp.exp(-rate * tau)) / mu]
    for p in range(1, count):
        out.append((tau**p * wave - p * out[-1]) / mu)
    return out


def exact_term(rate, row, tau):
    """Response from rest to one term: the real part of this. Near a resonance a hundred digits cancel."""
    c, p, a, omega, phi, _ = row
    with mp.workdps(150):
        return complex(c * integrals(int(p) + 1, rate, mp.mpc(a, omega), tau)[-1] * mp.expj(mp.mpf(phi)))


@cache
def shifted(count):
    """Coefficients, ascending, of the Chebyshev polynomials on [0, 1], whole numbers."""
    rows = [[1], [-1, 2]]
    while len(rows) < count:
        twice = np.polynomial.polynomial.polymul(np.array([-2, 4], object), np.array(rows[-1], object))
        rows.append(list(np.polynomial.polynomial.polysub(twice, np.array(rows[-2], object))))
    return rows


def exact_series(rate, coefficients, length, tau):
    """Response from rest to a Chebyshev series on [0, length]."""
    with mp.workdps(600):
        length = mp.mpf(length)
        parts = integrals(len(coefficients), rate * length, 0, tau / length)
        answers = [mp.fdot(row, parts[: len(row)]) for row in shifted(len(coefficients))]
        return float(length * mp.fdot(map(mp.mpf, coefficients.tolist()), answers[: len(coefficients)]))


def one_segment(rates, rows, length, t, w0=None):
    w0 = np.zeros(len(rates)) if w0 is None else w0
    return respond(rates, np.ones(len(rates)), [0.0, length], [rows], NO_SERIES, w0, t)


def times(length, rate, rng):
    """Outputs over the segment, close to its start, and on the scale of the decay."""
    scale = [] if rate == 0.0 else np.minimum(length, 10.0 ** rng.uniform(-3.0, 1.5, 3) / rate)
    return np.unique(
        np.concatenate([length * rng.random(3), length * 10.0 ** rng.uniform(-9.0, 0.0, 3), [length], scale])
    )


def error(rows, expected):
    """Largest error of one mode relative to the peak; of what a turning phase lets through, of all of it."""
    return np.abs(rows[:, 0] - np.real(expected)).max() / np.abs(expected).max()


@pytest.mark.parametrize("off", [0.0, 1e-15, 1e-12, 1e-9, 1e-6, 1e-3, 0.1, 1.0, 3.0])
@pytest.mark.parametrize("p", [0, 1, 4])
def test_a_wave_that_decays_as_the_mode_does(p, off):
    for rate, omega in itertools.product((2.0, 300.0), (0.0, off)):
        row = term(1.0, p, -rate * (1.0 + off), omega, 0.4)
        t = np.array([1e-4, 1e-2, 0.3, 1.0]) * 5.0 / rate
        rows, _ = one_segment([rate], [row], t[-1], t)
        assert error(rows, [exact_term(rate, row, x) for x in t]) <= 1e-14


rates_strategy = st.one_of(
    st.sampled_from([0.0, 1.0, 1.0 + 1e-12, 1e3, 1e12, 5e-324, 1e-300]), st.floats(-6.0, 15.0).map(lambda x: 10.0**x)
)
exponents = st.one_of(
    st.just(0.0), st.floats(-3.0, 1.5).map(lambda x: 10.0**x), st.floats(-3.0, 9.0).map(lambda x: -(10.0**x))
)
frequencies = st.one_of(st.just(0.0), st.floats(-9.0, 7.0).map(lambda x: 10.0**x))
rows_strategy = st.tuples(st.floats(-2.0, 2.0), st.integers(0, 4), exponents, frequencies, st.floats(-7.0, 7.0)).map(
    lambda x: term(*x)
)


@settings(max_examples=80, deadline=None, derandomize=True)
@given(
    st.lists(rates_strategy, min_size=1, max_size=3),
    st.lists(rows_strategy, min_size=1, max_size=3),
    st.floats(-6.0, 1.0),
)
def test_any_rates_terms_and_lengths(rates, rows, decades):
    length = 10.0**decades
    t = length * np.array([1e-7, 1e-3, 0.11, 0.5, 1.0])
    w0 = np.linspace(1.0, 2.0, len(rates)) * length
    got, w_end = one_segment(rates, rows, length, t, w0)
    parts = np.array([[[exact_term(r, row, x) for r in rates] for x in t] for row in rows])
    free = np.exp(-np.outer(t, rates)) * w0
    scale = np.abs(parts).max(axis=1).sum(axis=0) + np.abs(w0)
    assert np.all(np.abs(got - parts.sum(axis=0).real - free).max(axis=0) <= 1e-14 * scale)
    assert np.array_equal(w_end, got[-1])


@pytest.mark.parametrize("count", [1, 2, 3, 8, 20, 33])
def test_a_chebyshev_series_at_any_rate(count):
    rng = np.random.default_rng(count)
    switch = 0.5 * count**2
    for reach in (0.0, 1e-12, 1e-5, 0.03, 1.0, 8.0, 15.9, 16.1, 0.97 * switch, 1.03 * switch, 500.0, 1e4, 1e8, 1e12):
        c = rng.standard_normal(count)
        length = 10.0 ** rng.uniform(-4.0, 1.0)
        rate = reach / length
        t = times(length, rate, rng)
        rows, _ = respond([rate], [1.0], [0.0, length], [[term(0.0)]], [c], [0.0], t)
        assert error(rows, [exact_series(rate, c, length, x) for x in t]) <= 3e-14


def test_a_hundred_thousand_segments_add_up_no_rounding():
    m = 100_000
    edges = np.arange(m + 1) * 1e-4
    terms = np.zeros((m, 1, 6))
    terms[:, 0, 0] = np.where(np.arange(m) % 2 == 0, 200.0, -60.0)
    rates = np.array([0.0, 1e-3, 1e-2, 0.1, 1.0])
    _, w_end = respond(rates, np.ones(5), edges, terms, np.zeros((m, 0)), np.zeros(5), [])
    exact = edges.astype(np.longdouble)
    for rate, w in zip(rates, w_end, strict=True):
        until = np.exp(-np.longdouble(rate) * (exact[-1] - exact[1:]))
        gained = np.diff(exact)
        if rate > 0.0:
            gained = -np.expm1(-np.longdouble(rate) * gained) / np.longdouble(rate)
        assert abs(w / np.sum(until * gained * terms[:, 0, 0]) - 1.0) <= 1e-15


def test_decayed_states_are_zero_and_never_denormal():
    edges = np.array([0.0, 1.0, 2.0, 3.0])
    t = np.linspace(0.0, 3.0, 2001)
    for rate in (300.0, 400.0, 650.0, 1e6, 1e15):
        terms = [[term(1.0, 0, -2.0 * rate)], [term(0.0)], [term(0.0)]]
        rows, w_end = respond([rate], [1.0], edges, terms, np.zeros((3, 0)), [1.0], t)
        assert np.all(rows[t >= 2.5] == 0.0)
        assert w_end[0] == 0.0
        assert not np.any((rows != 0.0) & (np.abs(rows) < 2.3e-308))


DIGITS = 60
# From no decay in a step to one that is over within a rounding of its start, past every change of branch.
Z = (0.0, 1e-12, 1e-3, 0.1, 1.0, 5.0, 20.0, 44.0, 46.0, 100.0, 689.0, 691.0, 1e4, 1e8, 1e12)


@cache
def moments(z: float, c: float) -> list[mp.mpf]:
    """Integrals over [0, c] of exp(-z (c - s)) s^degree ds, by degree from 0 to NODES."""
    with mp.workdps(2 * DIGITS):
        z, c = mp.mpf(z), mp.mpf(c)
        if z * c >= 1:
            total = [(1 - mp.exp(-z * c)) / z]
            for d in range(1, NODES + 1):
                total.append((c**d - d * total[-1]) / z)
            return total
        # sum of (-z)^k c^(degree + 1 + k) / ((degree + 1) ... (degree + 1 + k)), from the highest degree down
        term = total = c ** (NODES + 1) / (NODES + 1)
        k = NODES + 1
        while abs(term) > abs(total) * mp.mpf(10) ** -(2 * DIGITS):
            k += 1
            term *= -z * c / k
            total += term
        out = [total]
        for d in range(NODES, 0, -1):
            out.append((c**d - z * out[-1]) / d)
        return out[::-1]


def product(zeros: np.ndarray) -> list[mp.mpf]:
    """Coefficients, ascending, of the product of (s - c) over these c."""
    out = [mp.mpf(1)]
    for c in zeros:
        out = [a - mp.mpf(float(c)) * b for a, b in zip([mp.mpf(0), *out], [*out, mp.mpf(0)], strict=True)]
    return out


def value(coefficients: list[mp.mpf], x: float) -> mp.mpf:
    """Of a polynomial with ascending coefficients."""
    return mp.polyval(coefficients[::-1], mp.mpf(float(x)))


def test_the_nodes_are_those_of_gauss_and_lobatto_and_symmetric() -> None:
    with mp.workdps(40):
        inner = mp.polyroots(mp.taylor(lambda x: mp.diff(lambda y: mp.legendre(NODES - 1, y), x), 0, NODES - 2)[::-1])
        exact = sorted([mp.mpf(0), mp.mpf(1), *((1 + mp.re(x)) / 2 for x in inner)])
        worst = max(abs(mp.mpf(float(a)) - b) for a, b in zip(POINTS[:NODES], exact, strict=True))
    assert worst <= 1e-15
    np.testing.assert_allclose(POINTS[:NODES] + POINTS[NODES - 1 :: -1], 1.0, rtol=0, atol=2e-16)


@pytest.mark.parametrize("z", Z)
def test_tables_are_decays_and_integrals_of_the_polynomials_through_the_nodes(z: float) -> None:
    decay, phi, miss = np.full(ROWS, np.nan), np.full((NODES, ROWS), np.nan), np.full(ROWS, np.nan)
    lobatto.fill_table(z, decay, phi, miss)
    # Error over the largest entry that is none: with decay, the engine's own floor.
    rounding = 1e-15 if z <= 1.0 else ROUNDING
    with mp.workdps(DIGITS):
        for i, c in enumerate(POINTS):
            # The product z c is rounded, by half a unit in its last place; and there are no denormals.
            exact = float(mp.exp(-mp.mpf(z) * mp.mpf(float(c))))
            assert decay[i] == pytest.approx(exact, rel=3e-16 * (1.0 + z * c), abs=1e-299)
            assert decay[i] == 0.0 or decay[i] > 1e-300
        polynomials = [product(np.delete(POINTS[:NODES], j)) for j in range(NODES)]
        # Each is 1 at its node; the last is zero at all, and of size 1 at the second point between them.
        scales = [value(one, node) for one, node in zip(polynomials, POINTS, strict=False)]
        polynomials.append(product(POINTS[:NODES]))
        scales.append(abs(value(polynomials[-1], POINTS[SECOND])))
        for row, one, scale in zip([*phi, miss], polynomials, scales, strict=True):
            for i, c in enumerate(POINTS):
                exact = mp.fdot(one, moments(z, c)[: len(one)]) / scale
                assert abs(mp.mpf(float(row[i])) - exact) <= rounding * float(moments(z, c)[0])


def test_the_points_between_see_what_the_nodes_miss_in_the_ratio_of_miss() -> None:
    # x^13 is missed by the node polynomial times the scale of its highest coefficient, and nothing else.
    x = 2.0 * POINTS - 1.0
    missed = chebyshev.chebval(x, np.eye(NODES + 1)[NODES])
    seen = missed[FIRST:] - missed[:NODES] @ BETWEEN
    np.testing.assert_allclose(seen / MISS, seen[0] / MISS[0], rtol=1e-12)
    assert abs(MISS[1]) == np.abs(MISS).max() == pytest.approx(1.0, rel=1e-14)
    # The next few orders have zeros elsewhere: no mixture of three of them is small at all points.
    higher = chebyshev.chebval(x, np.eye(NODES + 3)[NODES:].T)
    seen = higher[:, FIRST:] - higher[:, :NODES] @ BETWEEN
    assert np.linalg.svd(seen, compute_uv=False).min() > 0.1


def test_values_between_nodes_and_series_are_exact_up_to_the_nodes_degree() -> None:
    values = chebyshev.chebval(2.0 * POINTS - 1.0, np.eye(NODES))
    np.testing.assert_allclose(values[:, :NODES] @ BETWEEN, values[:, FIRST:], rtol=0, atol=2e-15)
    # The last columns fill a vector.
    np.testing.assert_allclose(values[:, :NODES] @ TO_SERIES, np.eye(*TO_SERIES.shape), rtol=0, atol=5e-15)
