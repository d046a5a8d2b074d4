"""Sweeps: their drive, the frequency of the skin's data, networks against hand-computed impedances, ngspice exports."""

import cmath
import json
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

import fingerspice as fs
from analytic import GAP, Layer, area, coupled_phasor, periodic_state, sine_segments, table1_layers
from commands import Command
from deck_edits import edited
from fingerspice.circuit.circuit import AcSweep
from fingerspice.studies.steady import sweep_frequencies
from ngspice_tools import CIRCUITS, call_ngspice
from scenes import table1

FREQUENCIES = (20.0, 300.0, 5e3, 8e4)


# A network's phasor, from impedances in series and in parallel ------------------------------------------------


def stack_impedances(f: float, a: float, f_skin: float) -> NDArray[np.complex128]:
    """Impedances of Table 1's layers at f (Hz) and area a (m^2), the skin's data those at `f_skin`."""
    layers: tuple[Layer, ...] = table1_layers(f_skin)
    return np.array([1.0 / (1.0 / x.r_total + a / x.r_area + 2j * math.pi * f * x.c * a) for x in layers])


# Of each deck the gap voltage over what its source gives, by 2 pi i f and the layers' impedances; and its amplitude.
BY_HAND: dict[str, tuple[Callable[[complex, NDArray[np.complex128]], complex], float]] = {
    # Behind 47 kohm, with 150 pF across the layers.
    "amplifier": (lambda s, z: z[GAP] / (z.sum() + 47e3 * (1.0 + s * 150e-12 * z.sum())), 200.0),
    # With 1.5 kohm and 150 pF in series with the layers.
    "ungrounded_user": (lambda s, z: z[GAP] / (z.sum() + 1.5e3 + 1.0 / (s * 150e-12)), 200.0),
    "current_drive": (lambda s, z: z[GAP], 500e-6),
}


def gain(name: str, f: float, a: float, f_skin: float) -> complex:
    """Of a deck at f (Hz) and area a (m^2), the skin's data those at `f_skin`."""
    return complex(BY_HAND[name][0](2j * math.pi * f, stack_impedances(f, a, f_skin)))


def by_hand(name: str, f: float) -> tuple[complex, float]:
    """Gain and mean area (m^2) of a deck at f (Hz): the area at the gap's rms voltage, the skin's data at f."""
    a = float(area(0.0))
    for _ in range(300):
        a = float(area(abs(gain(name, f, a, f)) * BY_HAND[name][1] / math.sqrt(2.0)))
    return gain(name, f, a, f), a


@pytest.mark.parametrize("name", BY_HAND)
def test_a_networks_phasor_has_its_mean_area_and_its_skins_data_at_each_frequency(name: str) -> None:
    circuit = fs.read_netlist(CIRCUITS / f"{name}.cir")
    # A current drives hundreds of volts below its own frequency.
    frequencies = FREQUENCIES if name != "current_drive" else (5e3, 2e4, 8e4)
    p = fs.phasor(circuit, frequencies)
    for i, f in enumerate(frequencies):
        expected, a = by_hand(name, f)
        assert p.gain[i] == pytest.approx(expected, rel=1e-11)
        assert p.area[i] == pytest.approx(a, rel=1e-11)
    # Far from the area at 0 V and from the data at one frequency.
    assert np.all(np.abs(p.area / float(area(0.0)) - 1.0) > 5e-4)
    held = fs.phasor(circuit, frequencies, skin="own", area="frozen")
    for i, f in enumerate(frequencies):
        assert held.gain[i] == pytest.approx(gain(name, f, float(area(0.0)), 5e3), rel=1e-11)
    assert abs(held.gain[-1] / p.gain[-1] - 1.0) > 1e-3


@pytest.mark.parametrize("given", [-35e-6, 0.0, math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("name", ["amplifier", "fingerpad"])
def test_an_area_that_is_none_is_refused_for_stacks_and_networks(name: str, given: float) -> None:
    circuit = fs.read_netlist(CIRCUITS / f"{name}.cir")
    with pytest.raises(fs.InputError, match=r"area is \S+ m\^2; allowed: a positive area in m\^2"):
        fs.phasor(circuit, area=given)


# AC ---------------------------------------------------------------------------------------------------------


def ac_in_ngspice(text: str, signal: str, folder: Path) -> tuple[NDArray[np.float64], NDArray[np.complex128]]:
    """Frequencies (Hz) and the phasor of a signal that a deck's .ac finds in ngspice."""
    control = [".control", "run", f"let x = real({signal})", f"let y = imag({signal})"]
    control += ["set wr_singlescale", "set numdgt=15", "wrdata out.txt x y", "quit 0", ".endc", ".end", ""]
    # Of subcircuits the ends stay.
    lines = [line for line in text.splitlines() if not line.startswith(".tran") and line.strip() != ".end"]
    (folder / "deck.cir").write_text("\n".join([*lines, *control]))
    done = call_ngspice(folder, "deck.cir")
    assert (folder / "out.txt").exists(), done.stdout + done.stderr
    f, x, y = np.loadtxt(folder / "out.txt").T
    return f, x + 1j * y


@pytest.mark.parametrize("words", ["AC 5 30", "AC -3", "AC 2 -90", "AC"])
@pytest.mark.parametrize("name", ["fingerpad", "fingerpad_dispersive", "amplifier", "current_drive"])
def test_ac_goes_along_in_an_export_and_drives_there_what_it_drives_here(name: str, words: str, tmp_path: Path) -> None:
    # ngspice takes the area at the source's first value, which is 0 without the phase.
    text = (CIRCUITS / f"{name}.cir").read_text().replace("5k 0 0 90", "5k")
    for line in text.splitlines():
        if line.startswith(("Vdrive", "Idrive")):
            text = text.replace(line, f"{line} {words}")
    circuit = fs.parse_netlist(text.replace(".tran", ".ac dec 3 10 100k\n.tran", 1))
    f, theirs = ac_in_ngspice(fs.export_netlist(circuit), "v(top)-v(skin)", tmp_path)
    assert f.size == 13
    ours = fs.phasor(circuit, f, skin="own", area="frozen")
    magnitude, degrees = {"AC 5 30": (5, 30), "AC -3": (3, 180), "AC 2 -90": (2, -90), "AC": (1, 0)}[words]
    assert ours.amplitude * cmath.exp(1j * ours.phase) == pytest.approx(cmath.rect(magnitude, math.radians(degrees)))
    assert ours.drive.startswith("AC ")
    # ngspice keeps the area at 0 V within a few digits of its tolerance.
    np.testing.assert_allclose(ours.u_gap, theirs, rtol=2e-5)


def test_ac_is_the_amplitude_that_the_area_is_coupled_to() -> None:
    circuit = table1("SIN(0 200 100) AC 50 20")
    p = fs.phasor(circuit, [100.0, 3e3])
    for i, f in enumerate((100.0, 3e3)):
        expected = coupled_phasor(f, 50.0)
        assert p.area[i] == pytest.approx(expected.area, rel=1e-13)
        assert p.f_el_mean[i] == pytest.approx(expected.mean_force, rel=1e-12)
        assert p.u_gap[i] == pytest.approx(50.0 * cmath.exp(1j * math.radians(20.0)) * expected.gap_gain, rel=1e-12)
    assert (p.amplitude, p.drive) == (pytest.approx(50.0, rel=1e-15), "AC 50 20 of Vdrive")
    # At the source's own fundamental, and of a source put in its place, its fundamental drives.
    assert fs.phasor(circuit).amplitude == 200.0
    other = fs.phasor(circuit.replace({"Vdrive": fs.Sine(70.0, 100.0)}), [100.0])
    assert (other.amplitude, other.drive) == (70.0, "the fundamental of Vdrive")
    # Nor does it need one.
    assert fs.phasor(table1("DC 5 AC 50"), [100.0]).area[0] == pytest.approx(coupled_phasor(100.0, 50.0).area)


def test_sources_with_ac_add_up_and_those_without_are_silent() -> None:
    text = table1("SIN(0 200 100) AC 3 90").text.replace("Vdrive drive 0", "Vb 0 low AC 4\nVc low m 7\nVdrive drive m")
    p = fs.phasor(fs.parse_netlist(text), [100.0], area=35e-6)
    plain = fs.phasor(table1("AC 1"), [100.0], area=35e-6)
    assert p.u_gap[0] == pytest.approx(plain.u_gap[0] * (3j - 4.0), rel=1e-12)
    assert set(p.drive.split(" and ")) == {"AC 4 0 of Vb", "AC 3 90 of Vdrive"}


def test_a_large_signal_sweep_is_driven_by_ac_too() -> None:
    (p,) = fs.large_signal(table1("SIN(0 200 100) AC 150 40"), [100.0])
    (plain,) = fs.large_signal(table1("SIN(0 200 100)"), [100.0], 150.0)
    assert (p.amplitude, p.drive, plain.drive) == (pytest.approx(150.0), "AC 150 40 of Vdrive", "the amplitude given")
    assert p.u_gap[0] == pytest.approx(plain.u_gap[0] * cmath.exp(1j * math.radians(40.0)), rel=1e-9)


# The skin's data --------------------------------------------------------------------------------------------


def test_a_sweep_says_where_the_skins_data_are_taken_and_how_far_outside_them() -> None:
    p = fs.phasor(table1(), [100.0])
    assert (p.notes, p.warnings) == ((), ())
    inside = fs.phasor(table1(), [10.0, 1e5])
    assert inside.notes == (
        "the skin's data are taken at each frequency of the sweep, not at the deck's own (Xskin f = 100 Hz)",
    )
    assert inside.warnings == ()
    with pytest.warns(fs.FingerspiceWarning, match="the sweep goes down to"):
        (far,) = fs.phasor(table1(), [1e-3, 1e9]).warnings
    assert "down to 0.001 Hz, 4 decades below and up to 1e+09 Hz, 4 decades above the 10 Hz to 100 kHz" in far
    with pytest.warns(fs.FingerspiceWarning, match="the sweep goes up to"):
        (above,) = fs.large_signal(table1(), [2e5], 1.0)[0].warnings
    assert "up to 200000 Hz, 0.3 decades above" in above
    held = fs.phasor(table1(), [1e-3, 1e9], skin="own")
    assert held.warnings == ()
    assert held.notes == (
        "the skin's data are held at the deck's own frequency (Xskin f = 100 Hz) over the whole sweep",
    )
    with pytest.raises(fs.InputError, match="skin is 'mine'; allowed: 'swept' or 'own'"):
        fs.phasor(table1(), [100.0], skin="mine")


@pytest.mark.parametrize("name", ["amplifier", "fingerpad"])
@pytest.mark.parametrize("mode", ["mean", "frozen", 35e-6])
def test_a_sweep_beyond_the_range_of_numbers_is_refused(name: str, mode: str | float) -> None:
    circuit = fs.read_netlist(CIRCUITS / f"{name}.cir")
    with pytest.raises(fs.InputError, match=r"the phasor at 1e\+308 Hz is beyond the range of numbers; allowed: "):
        fs.phasor(circuit, [100.0, 1e308], area=mode)


@pytest.mark.parametrize(
    "sweep", [AcSweep("dec", 1, 1e-300, 1e300), AcSweep("oct", 50_000, 1.0, 1e9), AcSweep("lin", 1_000_002, 1.0, 2.0)]
)
def test_a_sweep_of_too_many_frequencies_is_refused(sweep: AcSweep) -> None:
    with pytest.raises(fs.InputError, match=r"the sweep has \S+ frequencies; allowed: at most 1000000"):
        sweep_frequencies(sweep)


def test_three_hundred_decades_are_a_sweep() -> None:
    f = sweep_frequencies(AcSweep("dec", 1, 1e-150, 1e150))
    assert f.size == 301
    np.testing.assert_allclose(f[[0, -1]], [1e-150, 1e150], rtol=1e-12)


# The command ------------------------------------------------------------------------------------------------


def test_the_command_says_what_drives_where_the_data_are_taken_and_where_they_end(command: Command) -> None:
    Path("pad.cir").write_text(edited(("SIN(0 200 100)", "SIN(0 200 100) AC 5 30")))
    result = command("ac", "pad.cir", "--sweep", "dec 1 1 100k", "--no-plot")
    assert result.code == 0
    _, _, first, second, *_ = result.out.splitlines()
    assert first == "source amplitude 5 V, phase 30 deg: AC 5 30 of Vdrive"
    assert second.startswith("the skin's data are taken at each frequency of the sweep, not at the deck's own")
    (line,) = result.lines
    assert line.startswith("fingerspice: warning: the sweep goes down to 1 Hz, 1 decades below the 10 Hz to 100 kHz")
    report = json.loads(command("ac", "pad.cir", "--sweep", "lin 2 10 20", "--skin", "own", "--json", "--no-plot").out)
    (report,) = report["sweeps"]
    assert report["amplitude"] == pytest.approx(5.0)
    assert report["source_phase_deg"] == pytest.approx(30.0)
    assert report["drive"] == "AC 5 30 of Vdrive"
    assert "are held at the deck's own frequency" in report["notes"][0]


# Periodic states beside phasors -----------------------------------------------------------------------------


@pytest.mark.parametrize("degrees", [35.0, -120.0])
def test_compare_measures_leads_from_the_sources_own_phase(degrees: float) -> None:
    result = fs.compare(table1(f"SIN(0 200 100 0 0 {degrees!r})"))
    expected = math.degrees(cmath.phase(coupled_phasor(100.0, 200.0).gap_gain))
    assert result.phasor.phase_deg == pytest.approx(expected, abs=1e-9)
    assert result.mean.phase_deg == pytest.approx(expected, abs=1e-5)
    assert result.coupled.phase_deg == pytest.approx(expected, abs=1.0)


def test_a_large_signal_sweeps_area_is_the_mean_over_the_period() -> None:
    (p,) = fs.large_signal(table1(), [100.0], 200.0)
    t = np.linspace(0.0, 0.01, 4001)
    state = periodic_state(sine_segments(200.0, 100.0, 0.01), freq=100.0, t_out=t)
    mean = float(np.mean(0.5 * (state.area[1:] + state.area[:-1])))
    assert p.area[0] == pytest.approx(mean, rel=1e-6)
    # No instant's, and not the phasor's.
    assert np.ptp(state.area) > 0.04 * mean
    assert abs(p.area[0] / coupled_phasor(100.0, 200.0).area - 1.0) > 1e-3


def test_a_current_source_has_the_voltage_that_its_current_makes() -> None:
    text = "\n".join(["Idrive 0 drive SIN(0 1m 1k 0 0 90)", "R1 drive 0 4k", "C1 drive 0 1n", ".tran 1u 3m uic", ""])
    s = fs.simulate(fs.parse_netlist(f"a current into a resistor\n{text}"), t_eval=np.linspace(1e-3, 3e-3, 400))
    drive = 4.0 / (1.0 + 2j * math.pi * 1e3 * 4e3 * 1e-9)
    expected = np.real(drive * np.exp(2j * math.pi * 1e3 * s.t))
    # As it drives: out of its n node, against ground.
    np.testing.assert_allclose(s.u_source, expected, atol=1e-6)
    np.testing.assert_allclose(s.u_source, s.node_voltages["drive"], atol=1e-12)
