"""Modes of relaxation elements under one constraint, against dense eigenvalues in many digits."""

from __future__ import annotations

from dataclasses import dataclass

import mpmath as mp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fingerspice.numerics.modes import modes

SEARCH = settings(max_examples=60, derandomize=True, deadline=None)
# Rates twelve decades apart, squared in the characteristic polynomial, with room to spare.
DIGITS = 80


@dataclass(frozen=True)
class Dense:
    """Rates ascending, without the neutral direction's zero, and each mode's share (n, n + 1) in x of a unit U."""

    rates: list[mp.mpf]
    residues: list[list[mp.mpf]]


def dense(r: np.ndarray, k: np.ndarray) -> Dense:
    """x' = (k 1^T - I) diag(r) (x + k U), nothing reduced: eigenvalues of the whole matrix."""
    with mp.workdps(DIGITS):
        n = r.size
        total = mp.fsum(k.tolist())
        share = [mp.mpf(x) / total for x in k.tolist()]
        matrix = (mp.matrix(share) * mp.ones(1, n) - mp.eye(n)) * mp.diag(r.tolist())
        values, left, right = mp.eig(matrix, left=True, right=True)
        drive = matrix * mp.matrix(share)
        found = sorted(range(n), key=lambda m: abs(values[m]))[1:]
        residues = []
        for m in found:
            norm = mp.fsum(left[m, i] * right[i, m] for i in range(n))
            push = mp.fsum(left[m, i] * drive[i] for i in range(n))
            residues.append([mp.re(right[i, m] * push / norm) for i in range(n)])
        return Dense([-mp.re(values[m]) for m in found], residues)


def symmetric(x: np.ndarray, k: np.ndarray) -> np.ndarray:
    """D^-1 x D with D^2 = diag(k): on this scale modes are orthogonal and no entry of a projection is large."""
    return x * np.sqrt(k[None, :] / k[:, None])


def check_all(r: np.ndarray, k: np.ndarray) -> None:
    rates, gain, feed, shape = modes(r, k)
    n = r.size
    assert (rates.shape, gain.shape, feed.shape, shape.shape) == ((n - 1,), (n - 1,), (n, n - 1), (n, n - 1))
    assert np.all(rates >= 0.0)
    # x = shape @ w keeps the sum of zero, and `feed` followed by `shape` is p -> -p + k sum(p).
    one = shape.sum(axis=0)
    np.testing.assert_allclose(one, 0.0, rtol=0, atol=1e-13 * np.abs(shape).max(initial=1e-300))
    projection = symmetric(shape @ feed.T, k)
    root = np.sqrt(k)
    np.testing.assert_allclose(projection, np.outer(root, root) - np.eye(n), rtol=0, atol=1e-13)
    for m in range(n - 1):
        check_mode(r, k, float(rates[m]), float(gain[m]), feed[:, m], shape[:, m])


def check_mode(r: np.ndarray, k: np.ndarray, rate: float, gain: float, feed: np.ndarray, shape: np.ndarray) -> None:
    """(-I + k 1^T) diag(r) shape = -rate shape and gain = (r k) @ feed, both sums taken without rounding."""
    with mp.workdps(DIGITS):
        r_, k_, shape_, feed_ = (np.array([mp.mpf(float(x)) for x in row]) for row in (r, k, shape, feed))
        h, parts = r_ * shape_, r_ * k_ * feed_
        left = (k_ * h.sum() - h).astype(float)
        got, size = float(parts.sum()), float(np.abs(parts).sum())
        scale = np.abs(h).astype(float) + rate * np.abs(shape)
    bound = float((scale / np.sqrt(k)).max(initial=0.0)) + 1e-300
    np.testing.assert_allclose((left + rate * shape) / np.sqrt(k), 0.0, rtol=0, atol=1e-13 * bound)
    assert got == pytest.approx(gain, rel=0, abs=1e-13 * size + 1e-300)


def shares(seed: int, n: int, decades: float) -> np.ndarray:
    k = 10.0 ** np.random.default_rng(seed).uniform(-decades, 0.0, n)
    return np.asarray(k / k.sum())


@SEARCH
@given(st.integers(2, 9), st.integers(0, 2**32 - 1), st.floats(0.0, 4.0))
def test_every_rate_has_thirteen_digits_though_they_are_twelve_decades_apart(n: int, seed: int, decades: float) -> None:
    rng = np.random.default_rng(seed)
    r = 10.0 ** rng.uniform(-4.0, 8.0, n)
    r[rng.permutation(n)[:2]] = [1e-4, 1e8]
    k = shares(seed, n, decades)
    rates, gain, _, shape = modes(r, k)
    want = dense(r, k)
    order = np.argsort(rates)
    for m, exact, residue in zip(order, want.rates, want.residues, strict=True):
        assert abs(rates[m] - exact) <= 1e-13 * exact
        got = shape[:, m] * gain[m]
        size = max(float(abs(x)) / np.sqrt(q) for x, q in zip(residue, k, strict=True))
        for value, x, q in zip(got, residue, k, strict=True):
            assert abs(value - x) <= 1e-13 * size * np.sqrt(q)
    check_all(r, k)


@SEARCH
@given(st.integers(2, 9), st.integers(0, 2**32 - 1))
def test_rates_that_coincide_or_nearly_do_are_told_apart_as_far_as_they_can_be(n: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    base = 10.0 ** rng.uniform(0.0, 6.0, max(1, n // 3))
    r = base[rng.integers(base.size, size=n)] * (1.0 + rng.choice([0.0, 0.0, 2.3e-16, 1e-13, 1e-9, 1e-4], n))
    k = shares(seed, n, 3.0)
    check_all(r, k)
    rates = np.sort(modes(r, k)[0])
    for got, exact in zip(rates, dense(r, k).rates, strict=True):
        # Two rates that differ by one rounding are one.
        assert abs(got - exact) <= 5e-16 * float(r.max()) + 1e-13 * exact


@SEARCH
@given(st.integers(1, 9), st.integers(0, 9), st.integers(0, 2**32 - 1))
def test_elements_that_do_not_relax_leave_one_rate_of_zero_less_than_they_are(n: int, zeros: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    r = 10.0 ** rng.uniform(-2.0, 6.0, n)
    zeros = min(zeros, n)
    r[rng.permutation(n)[:zeros]] = 0.0
    k = shares(seed, n, 2.0)
    rates = modes(r, k)[0]
    assert np.count_nonzero(rates == 0.0) == max(zeros - 1, 0)
    check_all(r, k)
    for got, exact in zip(np.sort(rates), dense(r, k).rates, strict=True):
        assert abs(got - exact) <= 1e-13 * exact + 1e-60


def test_a_single_element_has_no_mode_and_two_have_their_weighted_mean_rate() -> None:
    assert [x.shape for x in modes(np.array([3.0]), np.array([1.0]))] == [(0,), (0,), (1, 0), (1, 0)]
    rates, gain, _, shape = modes(np.array([2.0, 50.0]), np.array([0.3, 0.7]))
    # v' = (k (g1 u1 + g2 u2) - g u) with u1 + u2 = U: the shares are exchanged.
    assert rates[0] == pytest.approx(0.7 * 2.0 + 0.3 * 50.0, rel=1e-15)
    assert shape[0, 0] * gain[0] == pytest.approx(0.3 * 0.7 * 48.0, rel=1e-15)
