"""Tables of the exponential steps against integrals taken in many digits."""

from __future__ import annotations

from functools import cache

import mpmath as mp
import numpy as np
import pytest
from numpy.polynomial import chebyshev

from fingerspice.numerics import lobatto
from fingerspice.numerics.lobatto import BETWEEN, END, FIRST, MISS, NODES, POINTS, ROWS, SECOND, TO_SERIES
from fingerspice.solve.problem import ROUNDING

DIGITS = 60
# From no decay in a step to one that is over within a rounding of its start, past every change of branch.
Z = (0.0, 1e-12, 1e-3, 0.1, 1.0, 5.0, 20.0, 44.0, 46.0, 100.0, 689.0, 691.0, 1e4, 1e8, 1e12)


def rounding(z: float) -> float:
    """Error of a table over the largest entry that is no error: with decay, the engine's own floor."""
    return 1e-15 if z <= 1.0 else ROUNDING


@cache
def table(z: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    decay, phi, miss = np.full(ROWS, np.nan), np.full((NODES, ROWS), np.nan), np.full(ROWS, np.nan)
    lobatto.fill_table(z, decay, phi, miss)
    return decay, phi, miss


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


def node_polynomial() -> list[mp.mpf]:
    """The product over the nodes as rounded, of size 1 at the second point between them."""
    out = product(POINTS[:NODES])
    size = abs(mp.polyval(out[::-1], mp.mpf(float(POINTS[SECOND]))))
    return [x / size for x in out]


def test_the_nodes_are_those_of_gauss_and_lobatto_and_symmetric() -> None:
    with mp.workdps(40):
        inner = mp.polyroots(mp.taylor(lambda x: mp.diff(lambda y: mp.legendre(NODES - 1, y), x), 0, NODES - 2)[::-1])
        exact = sorted([mp.mpf(0), mp.mpf(1), *((1 + mp.re(x)) / 2 for x in inner)])
        worst = max(abs(mp.mpf(float(a)) - b) for a, b in zip(POINTS[:NODES], exact, strict=True))
    assert worst <= 1e-15
    assert POINTS[0] == 0.0
    assert POINTS[END] == 1.0
    np.testing.assert_allclose(POINTS[:NODES] + POINTS[NODES - 1 :: -1], 1.0, rtol=0, atol=2e-16)


@pytest.mark.parametrize("z", Z)
def test_every_entry_is_the_integral_of_its_own_basis_polynomial(z: float) -> None:
    _, phi, _ = table(z)
    with mp.workdps(DIGITS):
        for j, node in enumerate(POINTS[:NODES]):
            others = product(np.delete(POINTS[:NODES], j))
            at_node = mp.polyval(others[::-1], mp.mpf(float(node)))
            basis = [x / at_node for x in others]
            for i, c in enumerate(POINTS):
                exact = mp.fdot(basis, moments(z, c)[:NODES])
                size = float(moments(z, c)[0])
                assert abs(mp.mpf(float(phi[j, i])) - exact) <= rounding(z) * size


@pytest.mark.parametrize("z", Z)
def test_the_decay_is_the_exponential_and_never_a_denormal(z: float) -> None:
    decay, _, _ = table(z)
    for value, c in zip(decay, POINTS, strict=True):
        exact = float(mp.exp(-mp.mpf(z) * mp.mpf(float(c))))
        # The product z c is rounded, by half a unit in its last place.
        assert value == pytest.approx(exact, rel=3e-16 * (1.0 + z * c), abs=1e-299)
        assert value == 0.0 or value > 1e-300


@pytest.mark.parametrize("z", Z)
def test_miss_is_the_answer_to_the_node_polynomial_of_size_one(z: float) -> None:
    _, _, miss = table(z)
    with mp.workdps(DIGITS):
        polynomial = node_polynomial()
        for i, c in enumerate(POINTS):
            exact = mp.fdot(polynomial, moments(z, c))
            size = float(moments(z, c)[0])
            assert abs(mp.mpf(float(miss[i])) - exact) <= rounding(z) * size


def test_without_decay_a_step_s_end_is_gauss_and_lobatto_s_rule() -> None:
    phi = lobatto.integral_table()
    _, zero, _ = table(0.0)
    np.testing.assert_array_equal(phi, zero)
    weights = phi[:, END]
    assert np.all(weights > 0.0)
    for degree in range(2 * NODES - 2):
        assert weights @ POINTS[:NODES] ** degree == pytest.approx(1.0 / (degree + 1), rel=2e-15)


def test_the_points_between_see_what_the_nodes_miss_in_the_ratio_of_miss() -> None:
    between = POINTS[FIRST:]
    assert between.size == MISS.size == BETWEEN.shape[1] == ROWS - NODES
    assert np.all((between > 0.0) & (between < 1.0))
    assert not np.isin(between, POINTS[:NODES]).any()
    with mp.workdps(DIGITS):
        polynomial = node_polynomial()[::-1]
        exact = [float(mp.polyval(polynomial, mp.mpf(float(x)))) for x in between]
        everywhere = max(abs(float(mp.polyval(polynomial, mp.mpf(x) / 997))) for x in range(998))
    np.testing.assert_allclose(MISS, exact, rtol=1e-12)
    assert abs(MISS[1]) == np.abs(MISS).max() == pytest.approx(1.0, rel=1e-14)
    assert everywhere <= 1.01, "the second point is where the node polynomial is largest, to a hundredth"
    # x^13 is missed by the node polynomial times the scale of its highest coefficient, and nothing else.
    x = 2.0 * POINTS - 1.0
    missed = chebyshev.chebval(x, np.eye(NODES + 1)[NODES])
    seen = missed[FIRST:] - missed[:NODES] @ BETWEEN
    np.testing.assert_allclose(seen / MISS, seen[0] / MISS[0], rtol=1e-12)
    # The next few orders have zeros elsewhere: no mixture of three of them is small at all points.
    higher = chebyshev.chebval(x, np.eye(NODES + 3)[NODES:].T)
    seen = higher[:, FIRST:] - higher[:, :NODES] @ BETWEEN
    assert np.linalg.svd(seen, compute_uv=False).min() > 0.1


def test_interpolation_to_the_points_between_is_exact_up_to_the_nodes_degree() -> None:
    values = chebyshev.chebval(2.0 * POINTS - 1.0, np.eye(NODES))
    np.testing.assert_allclose(values[:, :NODES] @ BETWEEN, values[:, FIRST:], rtol=0, atol=2e-15)


def test_a_series_gives_back_its_values_and_values_their_series() -> None:
    rng = np.random.default_rng(1)
    coefficients = rng.uniform(-1.0, 1.0, (50, NODES))
    values = chebyshev.chebval(2.0 * POINTS[:NODES] - 1.0, coefficients.T)
    np.testing.assert_allclose((values @ TO_SERIES)[:, :NODES], coefficients, rtol=0, atol=5e-15)
    assert not np.any(TO_SERIES[:, NODES:]), "the columns that fill a vector"
    values = rng.uniform(-1.0, 1.0, (50, NODES))
    back = chebyshev.chebval(2.0 * POINTS[:NODES] - 1.0, (values @ TO_SERIES).T)
    np.testing.assert_allclose(back, values, rtol=0, atol=5e-15)
