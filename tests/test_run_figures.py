"""The figures of a run (`Solution.summary`) against closed forms and the independent reference."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

import analytic as ref
import fingerspice as fs
from fingerspice.results import steps
from scenes import table1

AREA = 34.9715871843e-6
F, U, OFFSET, PHASE = 100.0, 200.0, 60.0, 140.0
STRESS = 8.854e-12 / (2.0 * 3.5e-6**2)


@pytest.fixture(scope="module")
def settled() -> dict[str, Any]:
    """Of two periods of the periodic state under a sine with offset and phase, the area fixed."""
    source = fs.Sine(U, F, offset=OFFSET, phase_deg=PHASE)
    run = fs.simulate(table1().replace({"Vdrive": source}), area=AREA, start="periodic", t_stop=2.0 / F, rtol=1e-10)
    return run.summary()


def gap() -> tuple[float, float]:
    """The gap voltage's mean and amplitude, V."""
    layers = ref.table1_layers(F)
    return float(ref.dc_operating_point(OFFSET, layers, frozen=AREA)[ref.GAP]), U * abs(
        ref.phasor_gains(F, AREA, layers)[ref.GAP]
    )


@pytest.mark.parametrize("over", ["", "_periodic"])
def test_rms_and_mean_of_a_sine_with_offset_are_the_closed_form(settled: dict[str, Any], over: str) -> None:
    mean, amplitude = gap()
    for name, m, a in (("u_source", OFFSET, U), ("u_gap", mean, amplitude)):
        assert settled[f"{name}_mean{over}"] == pytest.approx(m, abs=1e-6 * a)
        assert settled[f"{name}_rms{over}"] == pytest.approx(math.sqrt(m**2 + 0.5 * a**2), rel=1e-7)


def test_extremes_amplitude_and_phase_of_a_sine_with_offset_are_the_closed_form(settled: dict[str, Any]) -> None:
    mean, amplitude = gap()
    lead = math.degrees(np.angle(ref.phasor_gains(F, AREA, ref.table1_layers(F))[ref.GAP]))
    # Of a thousand outputs a period the nearest to the crest misses it by 5e-6 of the amplitude at most.
    assert settled["u_gap_max"] == pytest.approx(mean + amplitude, rel=1e-5)
    assert settled["u_gap_min"] == pytest.approx(mean - amplitude, rel=1e-5)
    assert settled["u_gap_peak"] == settled["u_gap_max"]
    assert settled["u_gap_amplitude"] == pytest.approx(amplitude, rel=1e-9)
    assert settled["u_source_amplitude"] == pytest.approx(U, rel=1e-9)
    assert settled["u_source_phase_deg"] == pytest.approx(PHASE, abs=1e-7)
    assert settled["u_gap_phase_deg"] == pytest.approx(PHASE + lead, abs=1e-7)
    assert settled["fundamental"] == F


def test_the_force_goes_with_the_mean_square_of_the_gap_voltage(settled: dict[str, Any]) -> None:
    mean, a = gap()
    # Of (m + a sin)^2 and of its square.
    square, fourth = mean**2 + 0.5 * a**2, mean**4 + 3.0 * mean**2 * a**2 + 0.375 * a**4
    force = STRESS * AREA
    assert settled["f_el_mean"] == pytest.approx(force * square, rel=1e-7)
    assert settled["f_el_rms"] == pytest.approx(force * math.sqrt(fourth), rel=1e-7)
    assert settled["f_el_ripple"] == pytest.approx(force * (mean + a) ** 2, rel=1e-5)
    assert settled["f_t_mean"] == pytest.approx(0.3 * (0.5 + force * square), rel=1e-7)
    assert settled["friction_mean_periodic"] == pytest.approx(0.3 * (1.0 + force * square / 0.5), rel=1e-7)
    assert settled["area_max"] == settled["area_min"] == pytest.approx(AREA, rel=1e-12, abs=0.0)


@pytest.mark.parametrize("law", ["local", "mobile"])
def test_figures_of_the_coupled_state_are_the_reference_s(law: str) -> None:
    run = fs.simulate(table1(), start="periodic", t_stop=1.0 / F, rtol=1e-9, charge_law=law)
    got = run.summary()
    t = np.arange(4000) / 4000.0 / F
    want = ref.periodic_state(ref.sine_segments(U, F, 1.0 / F), freq=F, law=law, t_out=t)
    ends = want.extremes(0.0, 1.0 / F)
    assert got["u_gap_rms"] == pytest.approx(math.sqrt(np.mean(want.u_gap**2)), rel=1e-6)
    assert got["f_el_mean"] == pytest.approx(want.mean_force(0.0, 1.0 / F), rel=1e-6)
    assert got["f_el_max"] == pytest.approx(ends["force_max"], rel=1e-5)
    assert got["area_mean"] == pytest.approx(np.mean(want.area), rel=1e-6, abs=0.0)
    assert got["area_min"] == pytest.approx(want.area.min(), rel=1e-6, abs=0.0)
    first = 2j * np.mean(want.u_gap * np.exp(-2j * np.pi * F * t))
    assert got["u_gap_amplitude"] == pytest.approx(abs(first), rel=1e-6)
    assert got["u_gap_phase_deg"] == pytest.approx(math.degrees(np.angle(first)), abs=1e-4)


@pytest.mark.parametrize("name", ["fingerpad_dispersive", "am_carrier", "amplifier", "two_fingers"])
def test_where_the_recorded_steps_fill_their_arrays_changes_nothing(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    # With room for one step they are full, too, where a period ends within the present window of the source.
    circuit = fs.read_netlist(f"circuits/{name}.cir")
    stop = 0.02 if name in ("amplifier", "two_fingers") else 0.1
    plain = fs.simulate(circuit, t_stop=stop, rtol=1e-6, charge=False)
    for capacity in (1, 7):
        monkeypatch.setattr(steps, "CAPACITY", capacity)
        run = fs.simulate(circuit, t_stop=stop, rtol=1e-6, charge=False)
        assert run.stats["steps"] == plain.stats["steps"]
        np.testing.assert_array_equal(run.u_gap, plain.u_gap)
        np.testing.assert_allclose(run.f_el_mean, plain.f_el_mean, rtol=1e-13)


@pytest.mark.parametrize("method", ["radau", "scipy:DOP853"])
@pytest.mark.parametrize("t_eval", [[0.02], [0.003, 0.0071, 0.02], None], ids=["one", "three", "deck"])
def test_figures_of_every_method_are_integrals_of_the_run(method: str, t_eval: list[float] | None) -> None:
    # Of the area held the last period is the closed form, of the coupled one the independent reference.
    held = fs.simulate(
        table1().replace({"Vdrive": fs.Sine(U, F)}), area=AREA, start="periodic", t_stop=0.02, t_eval=t_eval,
        method=method, rtol=1e-6,
    )  # fmt: skip
    amplitude = U * abs(ref.phasor_gains(F, AREA, ref.table1_layers(F))[ref.GAP])
    assert held.f_el_mean == pytest.approx(STRESS * AREA * amplitude**2 / 2.0, rel=3e-6)
    assert held.u_gap_peak == pytest.approx(amplitude, rel=2e-6)
    exact = ref.transient(ref.sine_segments(U, F, 0.02), [0.0, 0.02], freq=F)
    run = fs.simulate(table1(), t_stop=0.02, t_eval=t_eval, method=method, rtol=1e-6)
    assert run.summary()["figures_from"] == "steps"
    assert run.f_el_mean == pytest.approx(exact.mean_force(0.0, 0.02), rel=3e-6)
    assert run.summary()["f_el_max"] >= run.f_el.max()
