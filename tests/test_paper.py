"""The claims of the paper's section 4, computed; a claim that is not reproduced is a strict xfail with its reason."""

import functools

import numpy as np
import pytest

import analytic as ref
import fingerspice as fs
from fingerspice.circuit.statespace import build_stack
from fingerspice.studies.steady import steady_state
from scenes import dispersive_deck, table1


@functools.cache
def phasor_at(f, amplitude=200.0, **changes):
    circuit = table1(f"SIN(0 {amplitude} 100)")
    if changes:
        circuit = circuit.replace({k.replace("__", "."): v for k, v in changes.items()})
    return fs.phasor(circuit, f)


@functools.cache
def square(f):
    return steady_state(table1(f"SQUARE(200 {f!r})", f), rtol=1e-9, points=2000).solution


def rise(low=100.0, high=1e4, **changes):
    return float(phasor_at(high, 140.0, **changes).f_el_mean[0] / phasor_at(low, 140.0, **changes).f_el_mean[0])


@pytest.mark.parametrize(("f", "size", "phase"), [(100.0, 0.6653, 7.94), (5000.0, 0.8768, 1.37)])
def test_gap_voltage_leads_by_some_degrees_at_100_hz_and_is_in_phase_at_5_khz(f, size, phase):
    (gain,) = phasor_at(f).gain
    assert abs(gain) == pytest.approx(size, abs=5e-5)
    assert np.degrees(np.angle(gain)) == pytest.approx(phase, abs=5e-3)


def test_gap_voltage_of_the_coupled_run_at_100_hz_is_a_little_less_than_the_phasors():
    run = steady_state(table1(), points=2000).solution
    turned = np.exp(-2j * np.pi * 100.0 * run.t)
    gain = np.trapezoid(run.u_gap * turned, run.t) / np.trapezoid(run.u_source * turned, run.t)
    assert abs(gain) == pytest.approx(0.6632, abs=5e-5)
    assert np.degrees(np.angle(gain)) == pytest.approx(8.04, abs=5e-3)


def test_with_the_skins_data_at_every_frequency_a_square_of_100_hz_gives_less_force():
    dispersive = fs.parse_netlist(dispersive_deck("SQUARE(200 100)"))
    found = steady_state(dispersive, rtol=1e-9, points=2000).solution.summary()
    own = square(100.0).summary()
    assert found["f_el_mean"] / own["f_el_mean"] == pytest.approx(1.0 - 0.019, abs=5e-4)
    assert found["f_el_max"] / own["f_el_max"] == pytest.approx(1.0 - 0.048, abs=5e-4)


@pytest.mark.xfail(reason="no physical rho(100 Hz) gives less than 64.6 % at this area; ours is 66.5 %")
def test_gap_voltage_at_100_hz_is_approximately_60_percent():
    assert abs(phasor_at(100.0).gain[0]) == pytest.approx(0.60, abs=0.03)


@pytest.mark.xfail(reason="with Table 1 the mean force rises by 72 %; other gap resistances give 3.1 to 0.9 times")
def test_force_rises_by_80_percent_with_table_1():
    assert rise() == pytest.approx(1.80, abs=0.03)


def test_the_force_rises_by_72_percent_from_100_hz_to_10_khz_and_hardly_above_2_khz():
    assert rise() == pytest.approx(1.724, abs=5e-4)
    assert rise(low=2000.0) == pytest.approx(1.03, abs=5e-3)
    for r_gap, expected in ((0.5e6, 3.06), (1e6, 1.72), (2e6, 1.21), (7e6, 0.91)):
        assert rise(Xgap__r=r_gap) == pytest.approx(expected, abs=5e-3)


def test_the_force_rises_by_45_percent_from_30_to_230_hz_where_newer_data_see_little_change():
    assert rise(30.0, 230.0) == pytest.approx(1.45, abs=5e-3)
    low, high = (ref.coupled_phasor(f, 140.0).mean_force for f in (30.0, 230.0))
    assert rise(30.0, 230.0) == pytest.approx(high / low, rel=1e-12)


def test_ridge_area_without_adhesion_is_about_37_square_millimetres():
    contact = build_stack(table1()).contact
    assert contact is not None
    assert 1e6 * contact.area_unloaded == pytest.approx(37.94, abs=5e-3)
    # Eq. 4 at 0 V, solved in 40 digits.
    assert float(contact.area_adhesive(0.0)) == pytest.approx(
        float(ref.ridge_area_unloaded_mp(0.0)), rel=1e-14, abs=0.0
    )


@pytest.mark.parametrize(("f", "force"), [(100.0, (0.1845, 0.5826, 0.2278)), (5000.0, (0.3326, 0.3829, 0.3550))])
def test_a_square_gives_a_very_volatile_force_at_100_hz_and_an_almost_constant_one_at_5_khz(f, force):
    s = square(f)
    found = s.f_el.min(), s.f_el.max(), s.summary()["f_el_mean_periodic"]
    assert found == pytest.approx(force, abs=5e-5)
    assert (np.ptp(s.f_el) < 0.15 * s.f_el.mean()) == (f == 5000.0)


@pytest.mark.parametrize(
    ("f", "transient", "phasor", "share"), [(100.0, 0.1090, 0.1113, -0.021), (5000.0, 0.1833, 0.1893, -0.032)]
)
def test_the_transient_s_mean_force_is_below_the_phasor_s_by_the_ripple(f, transient, phasor, share):
    result = fs.compare(table1(f"SIN(0 200 {f!r})", f))
    assert result.coupled.f_el_mean == pytest.approx(transient, abs=5.5e-5)
    assert result.phasor.f_el_mean == pytest.approx(phasor, abs=5.5e-5)
    assert result.coupled.f_el_mean / result.phasor.f_el_mean - 1.0 == pytest.approx(share, abs=5e-4)
    # With the phasor's area held, nothing of the difference is left.
    assert result.mean.f_el_mean == pytest.approx(result.phasor.f_el_mean, rel=1e-9)
    assert result.mean.amplitude == pytest.approx(result.phasor.amplitude, rel=1e-9)


@pytest.mark.parametrize(
    ("source", "f", "share"),
    [("SIN(0 200 100)", 100.0, -0.0019), ("SIN(0 200 5k)", 5000.0, -0.0001), ("SQUARE(200 5k)", 5000.0, 0.0006),
     ("SQUARE(200 100)", 100.0, 0.063)],
)  # fmt: skip
def test_peak_gap_voltage_of_the_mobile_law_against_the_local(source, f, share):
    circuit = table1(source, f)
    peaks = [
        np.abs(steady_state(circuit, charge_law=law, points=4000).solution.u_gap).max() for law in ("local", "mobile")
    ]
    assert peaks[1] / peaks[0] - 1.0 == pytest.approx(share, abs=6e-5 if abs(share) < 0.01 else 5e-4)


def test_dc_divides_by_the_resistances():
    with pytest.warns(fs.FingerspiceWarning, match="outside 10 Hz to 100 kHz"):
        circuit = table1("DC 1", 1.0)
    solution = fs.simulate(circuit, start="dc", t_stop=1e-3)
    assert solution.u_gap[-1] == pytest.approx(0.49, abs=5e-3)
    assert fs.simulate(table1("DC 1", 10.0), start="dc", t_stop=1e-3).u_gap[-1] == pytest.approx(0.56, abs=5e-3)
