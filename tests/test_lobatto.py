"""Tables of the exponential steps against integrals taken in many digits."""

from functools import cache

import mpmath as mp
import numpy as np
import pytest
from numpy.polynomial import chebyshev

from fingerspice.numerics import lobatto
from fingerspice.numerics.lobatto import BETWEEN, FIRST, MISS, NODES, POINTS, ROWS, SECOND, TO_SERIES
from fingerspice.solve.problem import ROUNDING

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
