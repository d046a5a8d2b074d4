"""The error that comes with a result: at least the true one on 95 % of random scenes, and at most 30 times it."""

from __future__ import annotations

import numpy as np
import pytest

import fingerspice as fs
from scenes import table1

N = 50


def random_scene(rng):
    f = 10.0 ** rng.uniform(1.5, 4.0)
    amplitude = rng.uniform(20.0, 220.0)
    waveform = [
        fs.Sine(amplitude, f, offset=rng.uniform(-30.0, 30.0)),
        fs.Square(amplitude, f, duty=rng.uniform(0.2, 0.8)),
        fs.Triangle(amplitude, f),
        fs.AM(amplitude, 5.0 * f, f, depth=rng.uniform(0.2, 1.0)),
        fs.Sine(0.7 * amplitude, f) + fs.Sine(0.3 * amplitude, 3.0 * f, phase_deg=rng.uniform(0.0, 360.0)),
    ][rng.integers(5)]
    changes = {
        "Xgap.r": 10.0 ** rng.uniform(5.5, 8.0),
        "Xgap.d": rng.uniform(2.5e-6, 6e-6),
        "Xgap.fn": rng.uniform(0.2, 1.0),
        "Xcoat.r": 10.0 ** rng.uniform(4.0, 7.0),
        "Xskin.d": rng.uniform(2e-4, 4.5e-4),
    }
    rtol = 10.0 ** rng.uniform(-9.0, -3.0)
    law = ["local", "mobile"][rng.integers(2)]
    return table1().replace(changes), waveform, 4.0 / f, rtol, law


@pytest.fixture(scope="module")
def ratios():
    rng = np.random.default_rng(20261121)
    out = []
    for _ in range(N):
        circuit, waveform, stop, rtol, law = random_scene(rng)
        # Times that are no step ends and no multiples of the period.
        t = np.sort(rng.uniform(0.0, stop, 400))
        options = {"sources": {"Vdrive": waveform}, "t_stop": stop, "t_eval": t, "charge_law": law}
        solution = fs.simulate(circuit, rtol=rtol, **options)
        exact = fs.simulate(circuit, rtol=max(1e-4 * rtol, 2e-13), method="dop853", **options)
        true_u = np.abs(solution.u_gap - exact.u_gap).max()
        true_f = np.abs(solution.f_el - exact.f_el).max()
        peak_u, peak_f = np.abs(exact.u_gap).max(), exact.f_el.max()
        out.append(
            (
                solution.error.u_gap / true_u,
                solution.error.f_el / true_f,
                true_u / peak_u / rtol,
                true_f / peak_f / rtol,
            )
        )
    return np.array(out)


@pytest.mark.filterwarnings("ignore:the gap voltage reaches")
def test_the_estimate_covers_the_true_error_on_95_percent_of_scenes(ratios):
    assert np.mean(ratios[:, 0] >= 1.0) >= 0.95
    assert np.mean(ratios[:, 1] >= 1.0) >= 0.95


@pytest.mark.filterwarnings("ignore:the gap voltage reaches")
def test_the_estimate_is_at_most_thirty_times_the_true_error(ratios):
    assert np.mean(ratios[:, 0] <= 30.0) == 1.0
    assert np.mean(ratios[:, 1] <= 30.0) == 1.0


@pytest.mark.filterwarnings("ignore:the gap voltage reaches")
def test_the_error_asked_for_is_met(ratios):
    assert ratios[:, 2:].max() <= 1.0
