"""Derivatives of a number by every sample of a recording, against fourth-order differences of runs at 1e-12."""

import math
from typing import Any

import numpy as np
import pytest

import fingerspice as fs
import recording_errors
from fingerspice.base.errors import InputError
from scenes import cases, dispersive_deck, every_law, floating, refuses, table1, table1_deck

RATE, COUNT = 48_000.0, 300
T_STOP = (COUNT - 1) / RATE
TIMES = np.linspace(0.0, T_STOP, 211)


def noise(seed: int, peak: float = 120.0, count: int = COUNT) -> np.ndarray:
    return peak * recording_errors.noise(seed, count, RATE, 50.0, 1000.0)


def number(run: fs.Solution, of: dict[str, Any]) -> float:
    return float(sum(np.sum(weight * getattr(run, name)) for name, weight in of.items()))


def check(
    circuit: fs.Circuit, volts: np.ndarray, of: list[dict[str, Any]], step: float, tol: float, rtol: float = 1e-9,
    some: slice = slice(None), **how: Any,
) -> None:  # fmt: skip
    """Derivatives of numbers along a random direction and by single samples (`some`), relative to the largest."""
    how = {"t_stop": T_STOP, "t_eval": TIMES, "charge": False, "tier": "coupled", **how}

    def run(x: np.ndarray, rtol: float) -> fs.Solution:
        return fs.simulate(circuit, sources=fs.Samples(x, RATE), rtol=rtol, **how)

    own = run(volts, rtol)
    found = [own.sample_gradient(**one) for one in of]
    largest = [np.abs(one.values).max() for one in found]
    for one, most in zip(found, largest, strict=True):
        assert one.values.shape == volts.shape
        assert 0.0 < one.error <= 10.0 * rtol * most
    ways = [np.random.default_rng(4).standard_normal(volts.size) / math.sqrt(volts.size)]
    ways += [np.eye(volts.size)[i] for i in (0, 1, 137, volts.size - 2, volts.size - 1)]
    for way in ways[some]:
        near = [run(volts + k * step * way, 1e-12) for k in (-2, -1, 1, 2)]
        for one, most, numbers in zip(found, largest, ([number(r, each) for r in near] for each in of), strict=True):
            expected = (numbers[0] - 8.0 * numbers[1] + 8.0 * numbers[2] - numbers[3]) / (12.0 * step)
            assert abs(one.values @ way - expected) <= tol * most


@pytest.fixture
def weights() -> np.ndarray:
    return np.random.default_rng(5).standard_normal(TIMES.size)


@every_law
def test_a_sum_over_a_signal(law: str, weights: np.ndarray) -> None:
    of = [{name: weights} for name in ("f_t", "u_gap", "area", "friction")]
    some = slice(None, None, cases(1, 2))
    check(table1(), 100.0 + noise(1, 40.0), of, 0.5, 1e-9, some=some, charge_law=law, start="dc")


@every_law
def test_means_and_a_signal_together(law: str, weights: np.ndarray) -> None:
    of = [{"f_el_mean": 3.0, "friction_mean": -1.0, "area_mean": 1e3, "f_el": 1e-3 * weights}]
    check(table1(), 100.0 + noise(2, 40.0), of, 0.5, 5e-9, charge_law=law)


@every_law
def test_voltages_through_zero_where_the_area_has_a_kink(law: str) -> None:
    of = [{"f_el_mean": 1.0}, {"f_t": np.sin(np.arange(TIMES.size))}]
    # A wider difference would move a zero across the time of an output.
    check(table1(), noise(3), of, 0.05, 1e-6, charge_law=law, some=slice(None, None, cases(1, 3)))


def test_the_stated_error_covers_voltages_through_zero() -> None:
    for seed in range(4):
        source = fs.Samples(np.random.default_rng(seed).uniform(-150.0, 150.0, COUNT), RATE)
        how = {"sources": source, "t_stop": T_STOP, "charge": False}
        own, finer = (fs.simulate(table1(), rtol=rtol, **how).sample_gradient(f_el_mean=1.0) for rtol in (1e-6, 1e-9))
        assert np.abs(own.values - finer.values).max() <= own.error


def test_a_dispersive_skin(weights: np.ndarray) -> None:
    # Outputs at samples: those between them would need another loop, which takes long to compile.
    at = {"t_eval": np.arange(0, COUNT, 2)[: weights.size] / RATE}
    of = [{"f_t": weights[: at["t_eval"].size]}]
    check(fs.parse_netlist(dispersive_deck()), 100.0 + noise(6, 40.0), of, 0.5, 5e-7, rtol=1e-7, **at)


@pytest.mark.parametrize("volts", [80.0 + noise(1, 60.0), noise(1, 60.0)], ids=["above", "through"])
def test_a_network(volts: np.ndarray, weights: np.ndarray) -> None:
    some = slice(None, None, cases(1, 3))
    check(floating(), volts, [{"f_t": weights, "f_el_mean": 1.0}], 0.05, 1e-8, rtol=1e-8, some=some)


def test_a_source_against_the_loop_a_late_recording_and_means_from_tstart() -> None:
    text = table1_deck(tran=f"10u {T_STOP!r} 1.00001m uic")
    turned = fs.parse_netlist(text.replace("Vdrive drive 0", "Vdrive 0 drive"))
    plain, volts = fs.parse_netlist(text), 50.0 + noise(7)
    late = {"t_stop": T_STOP, "rtol": 1e-9, "charge": False}
    one = fs.simulate(plain, sources=fs.Samples(volts, RATE, 3.3e-5), **late)
    two = fs.simulate(turned, sources=fs.Samples(-volts, RATE, 3.3e-5), **late)
    first, second = (run.sample_gradient(f_el_mean=1.0) for run in (one, two))
    np.testing.assert_allclose(second.values, -first.values, rtol=1e-9, atol=1e-9 * np.abs(first.values).max())
    # The means begin at TSTART, and what is left after the run's end counts for nothing.
    assert first.values[-1] == 0.0
    off = [
        fs.simulate(plain, sources=fs.Samples(volts + d, RATE, 3.3e-5), **late | {"rtol": 1e-12}) for d in (-0.01, 0.01)
    ]
    slope = (off[1].f_el_mean - off[0].f_el_mean) / 0.02
    assert first.values.sum() == pytest.approx(slope, rel=1e-6)


def test_points_on_an_even_grid_are_samples() -> None:
    volts = 100.0 + noise(8, 40.0)
    times = np.arange(COUNT) / RATE
    how = {"t_stop": T_STOP, "rtol": 1e-9, "t_eval": TIMES, "charge": False}
    one = fs.simulate(table1(), sources=fs.Samples(volts, RATE), **how)
    two = fs.simulate(table1(), sources=fs.PWL(times, volts), **how)
    found = [run.sample_gradient(f_t=np.ones(TIMES.size)) for run in (one, two)]
    np.testing.assert_allclose(found[1].values, found[0].values, rtol=1e-6)
    assert "Vdrive: 300 samples" in repr(found[0])


def test_what_has_no_such_derivatives_is_refused() -> None:
    volts = noise(9)
    how = {"t_stop": T_STOP, "t_eval": TIMES}
    run = fs.simulate(table1(), sources=fs.Samples(volts, RATE), **how)
    for of, said in (
        ({"force": 1.0}, "unknown signal 'force'; allowed: u_gap"),
        ({"f_t": 1.0}, r"f_t has the shape \(\); allowed: the shape \(211,\)"),
        ({"f_el_mean": TIMES}, r"f_el_mean has the shape \(211,\); allowed: the shape \(\)"),
        ({"f_t": np.full(TIMES.size, np.nan)}, "not finite"),
        ({"f_t": "high"}, "f_t is 'high'; allowed: numbers"),
        ({}, "no signal is given; allowed: u_gap"),
    ):
        refuses(said, run.sample_gradient, **of)
    with pytest.raises(InputError, match=r"of the circuit's 1 sources 0 are recordings; .* beside constant ones"):
        fs.simulate(table1()).sample_gradient(f_el_mean=1.0)
    wave = fs.Samples(volts, RATE)
    both = fs.parse_netlist(
        "two\nV1 a 0 0\nV2 b 0 0\nR1 a top 47k\nR2 b top 47k\n.include fingerspice.lib\n"
        "Xcoat top g area LAYER d=1u eps_r=3.9 r=0.2meg\nXgap g 0 area GAP r=1meg\n.end\n"
    )
    with pytest.raises(InputError, match=r"of the circuit's 2 sources 2 are recordings; .* beside sources of 0"):
        fs.simulate(both, sources={"V1": wave, "V2": wave}, **how).sample_gradient(f_el_mean=1.0)
    further = fs.simulate(table1(), sources=fs.Samples(volts, RATE), start=run, t_stop=2.0 * T_STOP)
    refuses("goes on from another one", further.sample_gradient, f_el_mean=1.0)
    held = fs.simulate(table1(), sources=fs.Samples(volts, RATE), area="frozen", **how)
    refuses("whose area is coupled", held.sample_gradient, f_el_mean=1.0)
