"""Drives that make a wanted force: in runs here and of the independent reference, within limits, and as files."""

from __future__ import annotations

import re
import warnings
from pathlib import Path

import numpy as np
import pytest

import analytic
import fingerspice as fs
from scenes import table1_deck

CIRCUITS = Path(__file__).resolve().parent.parent / "circuits"
RATE = 48_000.0
AMPLIFIER = fs.read_netlist(CIRCUITS / "amplifier.cir")
STACK = fs.parse_netlist(table1_deck())
DISPERSIVE = fs.parse_netlist(re.sub(r"SKIN +d=350u f=\S+", "SKIN_DISPERSIVE d=350u", table1_deck()))


def profile(number: int, count: int = 2400, rate: float = RATE, highest: float = 150.0) -> np.ndarray:
    """A smooth random force that rises from 0, N."""
    rng = np.random.default_rng(number)
    t = np.arange(count) / rate
    wave = sum(rng.normal() * np.sin(2.0 * np.pi * f * t + rng.uniform(0.0, 6.3)) for f in rng.uniform(5.0, highest, 6))
    rise = 1.0 - np.exp(-((t / 8e-3) ** 2))
    return rng.uniform(0.005, 0.05) * rise * (1.0 + 0.95 * wave / np.abs(wave).max())


@pytest.mark.parametrize("law", ["local", "mobile"])
@pytest.mark.parametrize("circuit", [STACK, DISPERSIVE, AMPLIFIER], ids=["stack", "dispersive", "amplifier"])
@pytest.mark.parametrize("number", range(3))
def test_a_run_with_the_drive_has_the_force(circuit: fs.Circuit, law: str, number: int) -> None:
    wanted = profile(number)
    found = fs.inverse_drive(circuit, force=wanted, rate=RATE, charge_law=law)
    assert found.missed <= 1e-4 * wanted.max()
    stop = float(found.t[-1])
    again = fs.simulate(
        circuit, sources=found.drive, t_stop=stop, t_eval=found.t, charge_law=law, start="uncharged", rtol=1e-8
    )
    assert np.abs(again.f_el - wanted).max() <= 1e-4 * wanted.max()
    assert not found.limited.any()


@pytest.mark.parametrize("law", ["local", "mobile"])
def test_the_reference_has_the_force_too(law: str) -> None:
    wanted = profile(7, 160, 8000.0, 100.0)
    found = fs.inverse_drive(STACK, force=wanted, rate=8000.0, charge_law=law)
    points = list(zip(found.t.tolist(), found.drive.values.tolist(), strict=True))
    exact = analytic.transient(analytic.pwl_segments(points), found.t[1:-1].tolist(), law=law, freq=100.0)
    assert np.abs(exact.force - wanted[1:-1]).max() <= 1e-4 * wanted.max()


@pytest.mark.parametrize("circuit", [STACK, DISPERSIVE, AMPLIFIER], ids=["stack", "dispersive", "amplifier"])
def test_a_carrier_has_the_force_in_its_mean(circuit: fs.Circuit) -> None:
    wanted = profile(11, 960)
    found = fs.inverse_drive(circuit, force=wanted, rate=RATE, carrier=5000.0)
    assert found.drive.rate >= 64 * 5000.0
    assert found.missed_share <= 1e-4
    middle = np.isfinite(found.reached)
    assert middle.mean() > 0.95
    # The gap voltage changes its sign with the carrier.
    u = found.solution.u_gap
    assert (
        0.8 * 2 * 5000.0 * found.t[-1]
        < np.count_nonzero(np.diff(np.sign(u[u != 0.0])))
        < 1.2 * 2 * 5000.0 * found.t[-1]
    )


def test_friction_is_the_force_by_eq_1() -> None:
    wanted = profile(3)
    by_force = fs.inverse_drive(STACK, force=wanted, rate=RATE)
    by_friction = fs.inverse_drive(STACK, friction=0.3 * (0.5 + wanted), rate=RATE)
    assert np.allclose(by_force.drive.values, by_friction.drive.values, rtol=0.0, atol=1e-6)
    assert np.allclose(by_force.friction(by_force.reached), by_force.solution.f_t, rtol=1e-9)


def test_a_waveform_and_a_function_are_wanted_forces() -> None:
    wave = fs.Sine(0.01, 50.0, offset=0.01, phase_deg=-90.0)
    by_wave = fs.inverse_drive(STACK, force=wave, rate=RATE, t_stop=0.04)
    by_function = fs.inverse_drive(
        STACK, force=lambda t: 0.01 - 0.01 * np.cos(2.0 * np.pi * 50.0 * t), rate=RATE, t_stop=0.04
    )
    assert np.allclose(by_wave.drive.values, by_function.drive.values, rtol=0.0, atol=1e-5)


@pytest.mark.parametrize("law", ["local", "mobile"])
def test_a_limited_drive_is_as_near_as_the_past_lets_it_be(law: str) -> None:
    """At every sample that a limit decides, no other value within the limits brings that sample nearer."""
    wanted, limit, slew = profile(5, 120, 8000.0, 100.0), 60.0, 2e4
    found = fs.inverse_drive(STACK, force=wanted, rate=8000.0, limit=limit, slew=slew, charge_law=law)
    values = found.drive.values
    assert np.abs(values).max() <= limit * (1.0 + 1e-12)
    assert np.abs(np.diff(values)).max() <= slew / 8000.0 * (1.0 + 1e-9)
    assert 0.05 < found.limited_share < 1.0
    free = ~found.limited
    assert np.abs(found.reached - wanted)[free].max() <= 1e-4 * wanted.max() + 1e-9
    for k in np.flatnonzero(found.limited)[::9]:
        low = max(-limit, values[k - 1] - slew / 8000.0)
        high = min(limit, values[k - 1] + slew / 8000.0)
        near = abs(found.reached[k] - wanted[k])
        for other in np.linspace(low, high, 9):
            moved = values.copy()
            moved[k:] = other
            run = fs.simulate(
                STACK, sources=fs.Samples(moved, 8000.0), t_stop=float(found.t[-1]), t_eval=found.t[k : k + 1],
                charge_law=law, start="uncharged", rtol=1e-8,
            )  # fmt: skip
            assert abs(run.f_el[0] - wanted[k]) >= near - 1e-5 * wanted.max()


def test_slow_voltages_that_a_floating_body_does_not_pass_are_said() -> None:
    floating = fs.read_netlist(CIRCUITS / "ungrounded_user.cir")
    with pytest.warns(fs.FingerspiceWarning, match=r"misses the wanted force by .* % of its peak"):
        fs.inverse_drive(floating, force=profile(2, 480), rate=RATE)


def test_files_hold_the_drive(tmp_path: Path) -> None:
    found = fs.inverse_drive(STACK, force=profile(1, 480), rate=RATE)
    gain = found.to_wav(tmp_path / "drive.wav")
    assert gain == np.abs(found.drive.values).max()
    back = fs.Samples.from_wav(tmp_path / "drive.wav", gain)
    assert back.rate == RATE
    assert np.allclose(back.values, found.drive.values, rtol=0.0, atol=1e-6 * gain)
    table = np.loadtxt(found.to_csv(tmp_path / "drive.csv"), delimiter=",", skiprows=1)
    columns = found.t, found.drive.values, found.friction(found.wanted), found.friction(found.reached)
    assert np.allclose(table, np.column_stack(columns), rtol=1e-10, atol=1e-12)
    odd = fs.inverse_drive(STACK, force=profile(1, 480), rate=RATE + 0.5)
    with pytest.raises(fs.InputError, match=r"the rate is 48000\.5 Hz; allowed: a whole number"):
        odd.to_wav(tmp_path / "odd.wav")
    assert not (tmp_path / "odd.wav").exists()


def test_the_picture_and_the_page_tell_what_a_limit_costs() -> None:
    found = fs.inverse_drive(STACK, force=profile(5), rate=RATE, limit=50.0)
    text = str(found)
    assert f"{100.0 * found.limited_share:.3g} % of the time" in text
    assert f"{found.missed:.3g} N" in text
    labels = [ax.get_ylabel() for ax in found.plot().axes]
    assert labels == ["Drive Vdrive, V", "Friction, mN"]


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ({"force": [0.0, -0.01, 0.0], "rate": 1e3}, r"the wanted force goes from -0.01 to 0 N; allowed: .*0 N \(0 V\)"),
        ({"friction": [0.1, 0.2, 0.2], "rate": 1e3}, r"the wanted friction goes from 0.1 to 0.2 N; allowed: .* 0.15 N"),
        ({"force": [0.0, 1e9, 0.0], "rate": 1e3}, r"goes from 0 to 1e\+09 N; allowed"),
        ({"rate": 1e3}, "one of force= and friction=, N; given are none"),
        ({"force": [0.0, 0.1], "friction": [0.2, 0.2], "rate": 1e3}, "given are both"),
        ({"force": [0.0, 0.1, 0.1]}, "needs rate=, its values per second"),
        ({"force": fs.Sine(0.1, 50.0)}, "needs rate= .* and t_stop="),
        ({"force": [0.0, np.nan, 0.0], "rate": 1e3}, "nan"),
        ({"force": "much", "rate": 1e3}, "a wanted force is 'much'; allowed: numbers in N"),
        ({"force": [0.0, 0.01, 0.0], "rate": 1e3, "limit": -5.0}, "limit is -5 V; allowed: more than 0 V"),
        ({"force": [0.0, 0.01], "rate": 1e3, "t_stop": 1e-3}, "at least three samples"),
    ],
)
def test_what_no_drive_makes_is_refused_in_one_sentence(given: dict[str, object], says: str) -> None:
    with pytest.raises(fs.InputError, match=says):
        fs.inverse_drive(STACK, **given)  # type: ignore[arg-type]


def test_several_fingers_or_sources_and_given_areas_are_refused() -> None:
    wanted = profile(0, 100)
    with pytest.raises(fs.InputError, match="one GAP whose area follows its voltage, and this circuit has 2 GAPs"):
        fs.inverse_drive(fs.read_netlist(CIRCUITS / "two_fingers.cir"), force=wanted, rate=RATE)
    with pytest.raises(fs.InputError, match="needs one source, and this circuit has Vfast, Vdrive"):
        fs.inverse_drive(fs.read_netlist(CIRCUITS / "fingerpad_dispersive.cir"), force=wanted, rate=RATE)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", fs.FingerspiceWarning)
        given = STACK.replace({"Xgap.a_fix": 35.0})
    with pytest.raises(fs.InputError, match="one GAP whose area follows"):
        fs.inverse_drive(given, force=wanted, rate=RATE)
