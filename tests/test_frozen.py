"""Frozen area: the linear circuit, against impedances and matrix exponentials."""

from __future__ import annotations

import numpy as np
import pytest

import analytic as ref
import fingerspice as fs
from fingerspice.studies.steady import steady_state
from scenes import deck, table1
from test_steady import alone

AREA = 34.9715871843e-6


def fundamental(solution, x, f):
    """Complex amplitude of x ~ Im(P exp(i 2 pi f t)) over one period on an even grid."""
    t, x = solution.t[:-1], x[:-1]
    return 2j * np.mean(x * np.exp(-2j * np.pi * f * t))


@pytest.mark.filterwarnings("ignore:.*outside 10 Hz to 100 kHz")
@pytest.mark.parametrize("f", [1.0, 10.0, 100.0, 1e3, 5e3, 1e4, 1e5])
@pytest.mark.parametrize("law", ["local", "mobile"])
def test_periodic_sine_equals_eq_11_in_amplitude_and_phase(f, law):
    circuit = table1(f"SIN(0 200 {f!r})", f)
    solution = steady_state(circuit, area=AREA, charge_law=law, rtol=1e-12, points=400).solution
    gains = ref.phasor_gains(f, AREA, ref.table1_layers(f))
    got = fundamental(solution, solution.u_gap, f) / 200.0
    assert abs(got - gains[ref.GAP]) <= 1e-10 * abs(gains[ref.GAP])
    peak = 200.0 * abs(gains[ref.GAP])
    wave = peak * np.sin(2.0 * np.pi * f * solution.t + np.angle(gains[ref.GAP]))
    assert np.abs(solution.u_gap - wave).max() <= 1e-10 * peak


@pytest.mark.parametrize(("f", "duty"), [(100.0, 0.5), (5000.0, 0.5), (500.0, 0.2)])
@pytest.mark.parametrize("law", ["local", "mobile"])
def test_periodic_square_equals_the_matrix_exponential(f, duty, law):
    circuit = table1(f"SQUARE(200 {f!r} {duty!r})", f)
    solution = steady_state(circuit, area=AREA, charge_law=law, rtol=1e-12, points=200).solution
    inside = alone(solution.t)
    inside[[0, -1]] = False
    phase = solution.t[inside] - solution.t[0]
    expected = ref.square_frozen(f, 200.0, AREA, phase, layers=ref.table1_layers(f), duty=duty)
    assert np.abs(solution.u_layer[inside] - expected).max() <= 1e-10 * 200.0


def test_mean_and_frozen_areas_are_what_their_names_say():
    frozen = fs.simulate(table1(), area="frozen")
    assert frozen.area == pytest.approx(34.9715871843e-6, rel=1e-11, abs=0.0)
    mean = fs.simulate(table1(), area="mean")
    assert mean.area == pytest.approx(ref.coupled_phasor(100.0, 200.0).area, rel=1e-12, abs=0.0)
    with pytest.raises(fs.InputError, match="this source has none"):
        fs.simulate(table1(), sources={"Vdrive": fs.DC(10.0)}, area="mean")


@pytest.mark.filterwarnings("ignore:.*outside 10 Hz to 100 kHz")
@pytest.mark.parametrize(
    ("f", "skin", "limit"), [(0.01, 1.0, ref.gap_limit_eq14(1.0, AREA)), (1e8, 1e5, ref.gap_limit_eq15(1e5))]
)
def test_the_low_frequency_limit_is_resistive_and_the_high_one_capacitive_eqs_14_and_15(f, skin, limit):
    solution = steady_state(table1(f"SIN(0 200 {f!r})", skin), area=AREA, rtol=1e-10, points=200).solution
    assert abs(fundamental(solution, solution.u_gap, f)) / 200.0 == pytest.approx(limit, rel=1e-6)


def test_a_pure_capacitor_stack_follows_the_source_without_delay():
    lines = (
        "V1 a 0 SIN(0 10 1k)",
        "X1 a b area LAYER d=1u eps_r=2",
        "X2 b 0 area LAYER d=3u eps_r=2",
        "Varea area 0 40",
    )
    solution = fs.simulate(deck(*lines, ".tran 10u 2m uic"))
    assert np.abs(solution.u_layer[:, 0] - 0.25 * solution.u_source).max() <= 1e-13 * 10.0
    c = 8.854e-12 * 2.0 * 40e-6 / 4e-6
    assert np.abs(solution.q_source - c * solution.u_source).max() <= 1e-8 * c * 10.0
    assert solution.f_el is None
    assert solution.u_gap is None


@pytest.mark.parametrize("law", ["local", "mobile"])
@pytest.mark.parametrize("layers", [1, 2, 6, 12])
def test_any_number_of_layers_from_rest_and_in_the_periodic_state(layers, law):
    rng = np.random.default_rng(layers)
    d, eps, r = rng.uniform(1e-6, 1e-4, layers), rng.uniform(1.0, 50.0, layers), 10.0 ** rng.uniform(5.0, 7.0, layers)
    nodes = ["in", *(f"n{i}" for i in range(layers - 1)), "0"]
    lines = [
        f"X{i} {nodes[i]} {nodes[i + 1]} area LAYER d={d[i]:.17g} eps_r={eps[i]:.17g} r={r[i]:.17g}"
        for i in range(layers)
    ]
    circuit = deck("V1 in 0 SIN(0 10 500)", *lines, "Varea area 0 40", ".tran 10u 5m uic")
    stack = [ref.Layer(8.854e-12 * e / x, r_total=y) for e, x, y in zip(eps, d, r, strict=True)]
    t = np.linspace(0.0, 5e-3, 41)
    run = fs.simulate(circuit, t_eval=t, rtol=1e-10, charge_law=law)
    assert np.abs(run.u_layer - ref.sine_frozen_from_rest(500.0, 10.0, 40e-6, t, stack)).max() <= 1e-9 * 10.0
    state = steady_state(circuit, charge_law=law, rtol=1e-11)
    assert state.multipliers.shape == (layers - 1,)
    want = ref.periodic_sine_frozen(500.0, 10.0, 40e-6, layers=stack).u(state.solution.t)
    assert np.abs(state.solution.u_layer - want).max() <= 1e-11 * 10.0
