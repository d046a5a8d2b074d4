"""Response of linear modes to sampled input, against extended precision, mpmath and closed forms of ramps."""

from __future__ import annotations

import mpmath as mp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import lfilter

from fingerspice.numerics.linear import first_order_hold, respond

DT = 1e-6
# Stretches of the recursion begin after the first sample.
BLOCK = 500


def system(n, seed=0):
    """Rates, gains, direct part, weights and state of n modes."""
    rng = np.random.default_rng(seed)
    rates = 10.0 ** rng.uniform(2.0, 5.5, n)
    return rates, rates * rng.uniform(0.5, 2.0, n), 0.3, rng.standard_normal(n), rng.standard_normal(n)


def run(u, modes, dt=DT):
    """The one output of these modes, and their state at the last sample."""
    rates, gains, direct, weights, w0 = modes
    y, w_end = first_order_hold(u, dt, rates, gains, np.array([direct]), weights[None], w0)
    return y[0], w_end


def weights_to_40_digits(z):
    with mp.workdps(80):
        z = mp.mpf(z)
        if z < 1e-20:
            return mp.mpf(1) / 2, mp.mpf(1) / 2
        return (1 - (1 + z) * mp.exp(-z)) / z**2, (z - 1 + mp.exp(-z)) / z**2


def extended(u, modes, dt=DT):
    """y, w at the last sample and the largest |w|, by the serial recursion in extended precision."""
    rates, gains, direct, weights, w0 = modes
    u = np.asarray(u, np.longdouble)
    y, states, peaks = np.longdouble(direct) * u, [], []
    for rate, gain, weight, w in zip(rates, gains, weights, w0, strict=True):
        with mp.workdps(40):
            z = mp.mpf(float(rate)) * mp.mpf(dt)
            scale = mp.mpf(dt) * mp.mpf(float(gain))
            start, end = (np.longdouble(mp.nstr(x * scale, 25)) for x in weights_to_40_digits(z))
            fall = np.longdouble(mp.nstr(mp.exp(-z), 25)) if z < 1000 else np.longdouble(0)
        x = np.concatenate([[np.longdouble(w)], start * u[:-1] + end * u[1:]])
        history = lfilter(np.array([1], np.longdouble), np.array([1, -fall], np.longdouble), x)
        y = y + np.longdouble(weight) * history
        states.append(float(history[-1]))
        peaks.append(float(np.abs(history).max()))
    return y, np.array(states), np.array(peaks)


def deviation(y, expected):
    return float(np.abs(y - expected).max() / np.abs(expected).max())


@pytest.mark.parametrize(
    "rates", [[0.0, 1e-3], [0.0, 1.0, 1.0, 10.0], [1e3, 3e4], [1e5], [1e6, 2e6, 1e12, 1e18, 0.1]], ids=lambda r: f"{r}"
)
def test_a_million_samples_add_up_no_rounding(rates):
    m = 1_000_000
    rng = np.random.default_rng(0)
    n = len(rates)
    modes = np.array(rates), np.array(rates) + 1.0, 0.3, rng.uniform(0.5, 1.0, n), rng.standard_normal(n)
    for u in (rng.standard_normal(m), np.full(m, 0.1), np.sin(1e-3 * np.arange(m))):
        y, w_end = run(u, modes)
        expected, state, peak = extended(u, modes)
        assert deviation(y, expected) <= 1e-13
        assert np.all(np.abs(w_end - state) <= 1e-13 * peak)


@pytest.mark.parametrize("n", [0, 1, 2, 3, 8, 65])
def test_any_number_of_modes_and_any_length(n):
    modes = system(n, n)
    rng = np.random.default_rng(n)
    for m in (1, 2, BLOCK // 8, BLOCK - 1, BLOCK, BLOCK + 1, BLOCK + 2, 3 * BLOCK + 17):
        u = rng.standard_normal(m)
        y, w_end = run(u, modes)
        expected, state, peak = extended(u, modes)
        assert deviation(y, expected) <= 2e-15
        assert np.all(np.abs(w_end - state) <= 1e-14 * peak)


@settings(max_examples=40, deadline=None, derandomize=True)
@given(
    st.lists(st.one_of(st.just(0.0), st.floats(-3.0, 18.0).map(lambda x: 10.0**x)), min_size=1, max_size=4),
    st.lists(st.floats(-1.0, 1.0), min_size=2, max_size=30),
)
def test_samples_equal_ramps_in_closed_form(rates, samples):
    u = np.array([1.0, *samples])
    rates = np.array(rates)
    gains, w0 = rates + 1.0 / DT, np.linspace(0.5, 1.0, rates.size)
    t = DT * np.arange(u.size)
    terms = np.zeros((u.size - 1, 2, 6))
    terms[:, 0, 0] = u[:-1]
    terms[:, 1, 0] = np.diff(u) / np.diff(t)
    terms[:, 1, 1] = 1.0
    rows, w_end = respond(rates, gains, t, terms, np.zeros((u.size - 1, 0)), w0, t)
    y, state = run(u, (rates, gains, -1.0, np.ones(rates.size), w0))
    assert np.abs(y - (rows.sum(axis=1) - u)).max() <= 1e-14 * rates.size * np.abs(rows).max()
    assert np.all(np.abs(state - w_end) <= 1e-14 * np.abs(rows).max(axis=0))


def test_no_output_depends_on_later_samples():
    modes = system(3)
    u = np.random.default_rng(6).standard_normal(4 * BLOCK + 123)
    whole, _ = run(u, modes)
    for m in (1, 100, BLOCK - 1, BLOCK, BLOCK + 1, 2 * BLOCK + 700, 4 * BLOCK):
        assert np.array_equal(run(u[:m], modes)[0], whole[:m])


def test_silence_after_a_pulse_ends_in_zeros_not_in_denormals():
    u = np.zeros(1_000_000)
    u[:10] = 1.0
    for z in (0.01, 0.4, 0.7, 5.0):
        y, w_end = run(u, (np.array([z / DT]), np.array([1.0]), 0.0, np.array([1.0]), np.array([1.0])))
        assert w_end[0] == 0.0
        assert y[-1] == 0.0
        denormal = (y != 0.0) & (np.abs(y) < 2.3e-308)
        # A stretch may end in a few, none begins with them.
        assert np.count_nonzero(denormal) <= 125


@pytest.mark.parametrize("n", [1, 2, 3])
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("at", [0, 1, 124, 125, 999, 1000, 1500, 2600])
def test_what_is_not_finite_stays_and_changes_nothing_before(n, bad, at):
    rates, gains, direct, weights, w0 = system(n)
    # One mode forgets at once: exp(-rate dt) is zero.
    rates[-1] = 1e12
    modes = rates, gains, direct, weights, w0
    u = np.random.default_rng(10).standard_normal(2700)
    expected, _ = run(u, modes)
    u[at] = bad
    y, w_end = run(u, modes)
    assert np.array_equal(y[:at], expected[:at])
    assert not np.any(np.isfinite(y[at:]))
    assert not np.any(np.isfinite(w_end))
    if np.isnan(bad):
        assert np.all(np.isnan(y[at:]))
