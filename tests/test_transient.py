"""The coupled transient against the independent reference of `analytic.py`, and the orders of its error control."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

import analytic as ref
import fingerspice as fs
from scenes import table1

CIRCUITS = Path(__file__).parents[1] / "circuits"

CHIRP_T = 0.01


def chirp_segments():
    rate = (2000.0 - 50.0) / CHIRP_T

    def phase(t):
        return 2.0 * math.pi * (50.0 + 0.5 * rate * t) * t

    def slope(t):
        return 150.0 * np.cos(phase(t)) * 2.0 * math.pi * (50.0 + rate * t)

    return [(0.0, CHIRP_T, lambda t: 150.0 * np.sin(phase(t)), slope)]


POINTS = [(0.0, 20.0), (2e-3, 150.0), (2e-3, -120.0), (5e-3, -40.0), (7e-3, 90.0), (7.3e-3, -60.0), (12e-3, -60.0)]
BIASED = fs.Sine(150.0, 5000.0, offset=40.0, phase_deg=30.0)
SCENES = {
    "sine 100 Hz": (fs.Sine(200.0, 100.0), ref.sine_segments(200.0, 100.0, 0.03), 100.0),
    "sine 5 kHz with offset": (BIASED, ref.sine_segments(150.0, 5000.0, 2e-3, phase=math.pi / 6, offset=40.0), 5000.0),
    "square 100 Hz": (fs.Square(200.0, 100.0), ref.square_segments(200.0, 100.0, 3), 100.0),
    "square 5 kHz, duty 0.3": (fs.Square(200.0, 5000.0, 0.3), ref.square_segments(200.0, 5000.0, 4, duty=0.3), 5000.0),
    "chirp 50 Hz to 2 kHz": (fs.Chirp(150.0, 50.0, 2000.0, CHIRP_T), chirp_segments(), 500.0),
    "PWL with a jump": (fs.PWL(*zip(*POINTS, strict=True)), ref.pwl_segments(POINTS), 100.0),
}
laws = pytest.mark.parametrize("law", ["local", "mobile"])


def output_times(segments):
    # Off the grid of periods, plus both sides of every jump (whose own time the two sides round differently).
    end = segments[-1][1]
    edges = np.array([s[0] for s in segments[1:]])
    grid = np.linspace(0.0, end, 301)[:-1] + 1e-3 * end / 301.0
    return np.unique(np.concatenate([[0.0], grid, edges - 1e-12, edges + 1e-12]))


@laws
@pytest.mark.parametrize("scene", SCENES)
def test_coupled_response_equals_the_reference_to_1e_9(scene, law):
    waveform, segments, f = SCENES[scene]
    t = output_times(segments)
    expected = ref.transient(segments, t, law=law, freq=f)
    how = {"t_eval": t, "t_stop": segments[-1][1], "charge_law": law, "rtol": 1e-10}
    solution = fs.simulate(table1(f=f), sources={"Vdrive": waveform}, **how)
    peak_u, peak_f = np.abs(expected.u_gap).max(), expected.force.max()
    assert expected.fold is None
    assert np.abs(solution.u_layer - expected.u).max() <= 1e-9 * peak_u
    assert np.abs(solution.f_el - expected.force).max() <= 1e-9 * peak_f
    assert_allclose(solution.area, expected.area, rtol=1e-9)
    assert np.abs(solution.q_source - expected.q).max() <= 1e-9 * np.abs(expected.q).max()
    assert solution.error.u_gap <= 1e-10 * np.abs(solution.u_gap).max() * 1.001


@laws
def test_source_current_equals_the_reference(law):
    segments = ref.sine_segments(200.0, 100.0, 0.02)
    t = np.linspace(1e-5, 0.0199, 57)
    expected = ref.transient(segments, t, law=law, freq=100.0)
    current = np.array([expected.current(x, float(segments[0][3](x))) for x in t])
    solution = fs.simulate(table1(), t_eval=t, t_stop=0.02, charge_law=law, rtol=1e-10)
    assert np.abs(solution.i_source - current).max() <= 1e-8 * np.abs(current).max()


@laws
def test_start_from_the_dc_operating_point(law):
    segments = ref.sine_segments(100.0, 100.0, 0.02, offset=80.0)
    t = np.linspace(0.0, 0.0199, 57)
    expected = ref.transient(segments, t, law=law, freq=100.0, start="dc")
    waveform = fs.Sine(100.0, 100.0, offset=80.0)
    circuit = table1(tran="10u 20m")
    solution = fs.simulate(circuit, sources={"Vdrive": waveform}, t_eval=t, charge_law=law, rtol=1e-10)
    assert np.abs(solution.u_layer - expected.u).max() <= 1e-9 * np.abs(expected.u_gap).max()


@laws
def test_work_of_adhesion_at_total_voltage_held(law):
    t = np.linspace(0.0, 0.0199, 57)
    k = ref.work_factor(100.0)
    expected = ref.transient(ref.sine_segments(200.0, 100.0, 0.02), t, law=law, freq=100.0, k=k)
    circuit = table1(extra=".options work=total")
    solution = fs.simulate(circuit, t_eval=t, t_stop=0.02, charge_law=law, rtol=1e-10)
    assert np.abs(solution.u_gap - expected.u_gap).max() <= 1e-9 * np.abs(expected.u_gap).max()
    plain = fs.simulate(table1(), t_eval=t, t_stop=0.02, charge_law=law, rtol=1e-10)
    assert np.abs(solution.u_gap - plain.u_gap).max() > 1e-5 * np.abs(expected.u_gap).max()


@pytest.mark.parametrize("method", ["exponential", "radau"])
@pytest.mark.parametrize("rtol", [1e-3, 1e-9])
def test_the_error_asked_for_is_met_by_every_own_stepper(method, rtol):
    segments = ref.square_segments(200.0, 100.0, 2)
    t = output_times(segments)
    expected = ref.transient(segments, t, law="local", freq=100.0)
    square = fs.Square(200.0, 100.0)
    solution = fs.simulate(table1(), sources=square, t_eval=t, t_stop=0.02, rtol=rtol, method=method)
    assert np.abs(solution.u_gap - expected.u_gap).max() <= rtol * np.abs(expected.u_gap).max()
    assert np.abs(solution.f_el - expected.force).max() <= rtol * expected.force.max()


@pytest.mark.parametrize("deck", ["fingerpad.cir", "amplifier.cir"])
@pytest.mark.parametrize("options", [{}, {"area": "frozen"}, {"method": "radau"}, {"charge_law": "mobile"}], ids=str)
@pytest.mark.parametrize("periods", [3, 7])
def test_a_run_that_ends_at_a_jump_but_for_rounding_ends_after_it(deck, options, periods):
    # Three periods of 0.2 ms are 0.6000000000000001 ms: the source is past its jump there, and so is the gap.
    circuit = fs.read_netlist(CIRCUITS / deck).replace({"Vdrive": fs.Square(200.0, 5000.0)})
    stop = periods * 2e-4
    for t in (np.linspace(0.0, stop, 31), np.array([0.0, periods * 0.2 / 1000.0])):
        short = fs.simulate(circuit, t_stop=max(stop, t[-1]), t_eval=t, rtol=1e-6, **options)
        longer = fs.simulate(circuit, t_stop=stop + 1e-5, t_eval=t, rtol=1e-6, **options)
        assert short.u_source[-1] == longer.u_source[-1] == 200.0
        assert abs(short.u_gap[-1] - longer.u_gap[-1]) <= 2e-6 * np.abs(longer.u_gap).max()


@laws
def test_a_gap_behind_an_insulating_coating_rests_at_zero_volt(law):
    # At DC the coating takes it all: what is left in the gap is the rounding of 100 V.
    circuit = table1().replace({"Vdrive": fs.DC(100.0), "Xcoat.r": math.inf})
    with pytest.warns(fs.FingerspiceWarning, match="no more than rounding of the source's voltage"):
        solution = fs.simulate(circuit, t_stop=0.01, start="dc", charge_law=law)
    assert np.abs(solution.u_gap).max() <= 1e-12
    assert solution.error.u_gap >= np.abs(solution.u_gap).max()


@laws
def test_a_run_may_start_from_a_gap_at_rest_behind_an_insulating_coating(law):
    circuit = table1().replace({"Vdrive": fs.Sine(50.0, 100.0, offset=100.0), "Xcoat.r": math.inf})
    t = np.linspace(0.0, 0.01, 101)[:-1]
    solution = fs.simulate(circuit, t_eval=t, t_stop=0.01, start="dc", charge_law=law)
    assert abs(solution.u_gap[0]) <= 1e-12
    # The offset stands on the coating alone.
    coat, *others = ref.table1_layers(100.0)
    segments = ref.sine_segments(50.0, 100.0, 0.01, offset=100.0)
    expected = ref.transient(segments, t, law=law, layers=(ref.Layer(coat.c), *others), start=[100.0, 0.0, 0.0])
    assert np.abs(solution.u_layer - expected.u).max() <= 1e-8 * np.abs(expected.u_gap).max()
    assert np.abs(solution.f_el - expected.force).max() <= 1e-8 * expected.force.max()
