"""Phasors and sweeps: gains against Eqs. 11 to 15 and impedances by hand, what drives them, skin data and refusals."""

import cmath
import json
import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

import analytic as ref
import fingerspice as fs
from analytic import GAP, Layer, area, coupled_phasor, periodic_state, sine_segments, table1_layers
from commands import Command
from deck_edits import edited
from fingerspice.circuit.circuit import AcSweep
from fingerspice.circuit.network import network_of
from fingerspice.physics.phasor import settled_areas
from fingerspice.studies.steady import sweep_frequencies
from ngspice_tools import CIRCUITS, call_ngspice
from scenes import deck, listed, refuses, shipped, table1, table1_deck

MM2 = 1e6
FREQUENCIES = [1.0, 10.0, 100.0, 700.0, 5000.0, 1e5]
AREAS = [10e-6, 34.97e-6]


@pytest.mark.filterwarnings("ignore:the sweep goes")
@pytest.mark.parametrize("a", AREAS)
@pytest.mark.parametrize("f", FREQUENCIES)
def test_the_gain_is_equation_11_and_the_repaired_equations_12_and_13(f: float, a: float) -> None:
    solution = fs.phasor(table1(), f, area=a)
    (gain,) = solution.gain
    expected = ref.phasor_gains(f, a, ref.table1_layers(f))
    assert abs(gain / expected[ref.GAP] - 1.0) < 1e-13
    np.testing.assert_allclose(solution.layer_gain[0], expected, rtol=1e-13)
    assert abs(gain) == pytest.approx(ref.gap_gain_eq12(f, a), rel=1e-12)
    assert cmath.phase(gain) == pytest.approx(ref.gap_phase_eq13(f, a), abs=1e-12)


def with_materials_fixed(f_skin: float) -> fs.Circuit:
    """Table 1 with the skin as a SLAB of its values at `f_skin`: the limits are of a stack that stays."""
    skin = ref.table1_layers(f_skin)[2]
    values = f"d=350u eps_r={skin.c * ref.TABLE1.d_sc / ref.TABLE1.eps0!r} rho={skin.r_area / ref.TABLE1.d_sc!r}"
    return fs.parse_netlist(re.sub(r"SKIN .*", f"SLAB {values}", table1_deck()))


def test_the_gain_falls_to_the_resistive_limit_and_rises_to_the_capacitive_one() -> None:
    a = 34.97e-6
    low, high = fs.phasor(with_materials_fixed(100.0), [1e-6, 1e11], area=a).gain
    assert low.real == pytest.approx(ref.gap_limit_eq14(100.0, a), rel=1e-12)
    assert high.real == pytest.approx(ref.gap_limit_eq15(100.0), rel=1e-12)
    assert low.imag == pytest.approx(0.0, abs=1e-7)
    assert high.imag == pytest.approx(0.0, abs=1e-7)


def test_the_skin_is_evaluated_at_each_frequency_of_a_sweep_whatever_its_own_f() -> None:
    f = np.geomspace(10.0, 1e5, 9)
    sweep = fs.phasor(table1(f=100.0), f, area=35e-6)
    np.testing.assert_array_equal(sweep.frequency, f)
    assert sweep.gain.shape == sweep.u_gap.shape == sweep.area.shape == sweep.f_el_mean.shape == (9,)
    for i, x in enumerate(f):
        alone = fs.phasor(table1(f=float(x)), x, area=35e-6)
        assert alone.gain[0] == pytest.approx(sweep.gain[i], rel=1e-14)
        assert sweep.gain[i] == pytest.approx(
            ref.phasor_gains(x, 35e-6, ref.table1_layers(float(x)))[ref.GAP], rel=1e-13
        )


def test_a_gap_or_a_source_turned_round_turns_the_phasor() -> None:
    plain = fs.phasor(table1(), 100.0)
    text = table1().text
    turned = fs.phasor(fs.parse_netlist(text.replace("Xgap top skin", "Xgap skin top")), 100.0)
    driven = fs.phasor(fs.parse_netlist(text.replace("Vdrive drive 0", "Vdrive 0 drive")), 100.0)
    assert turned.u_gap[0] == pytest.approx(-plain.u_gap[0], rel=1e-13)
    assert driven.u_gap[0] == pytest.approx(-plain.u_gap[0], rel=1e-13)
    assert turned.f_el_mean[0] == pytest.approx(plain.f_el_mean[0], rel=1e-13)
    assert driven.f_el_mean[0] == pytest.approx(plain.f_el_mean[0], rel=1e-13)


@pytest.mark.parametrize("f", [10.0, 100.0, 5000.0, 1e4])
@pytest.mark.parametrize("amplitude", [1e-3, 140.0, 200.0, 1000.0])
def test_the_coupled_phasor_is_the_reference_iterated_to_rounding(f: float, amplitude: float) -> None:
    solution = fs.phasor(table1(f"SIN(0 {amplitude!r} {f!r})", f=f))
    expected = ref.coupled_phasor(f, amplitude)
    assert solution.area[0] == pytest.approx(expected.area, rel=1e-13)
    assert solution.gain[0] == pytest.approx(expected.gap_gain, rel=1e-13)
    assert solution.f_el_mean[0] == pytest.approx(expected.mean_force, rel=1e-13)
    assert solution.u_gap[0] == pytest.approx(amplitude * expected.gap_gain, rel=1e-13)
    assert solution.amplitude == amplitude
    assert solution.layers == ("Xcoat", "Xgap", "Xskin")


def test_the_reading_of_equation_7_reaches_the_coupled_area() -> None:
    held = fs.phasor(table1(extra=".options work=total"))
    assert held.area[0] == pytest.approx(ref.coupled_phasor(100.0, 200.0, k=ref.work_factor(100.0)).area, rel=1e-13)
    assert held.area[0] > fs.phasor(table1()).area[0]


@settings(max_examples=40, derandomize=True, deadline=None)
@given(amplitude=st.floats(0.0, 1e4), steepness=st.floats(-0.9, 3.0), reach=st.floats(1.0, 1e3))
@example(amplitude=2.0, steepness=2.0, reach=1.0)  # Iterating on the area swings between two values.
def test_the_coupled_area_solves_its_equation_for_any_monotone_area_and_gain(amplitude, steepness, reach):
    def area_at(a: float) -> float:
        return 1.0 / (1.0 + (amplitude * (0.2 + 0.7 * a ** (1.0 + steepness)) / math.sqrt(2.0) / reach) ** 2)

    (a,) = settled_areas(lambda a: np.array([area_at(a[0])]), np.ones(1))
    assert area_at(a) == pytest.approx(a, rel=1e-12)


def test_frozen_and_given_areas_are_used_as_they_are() -> None:
    frozen = fs.phasor(table1(), area="frozen")
    assert frozen.area[0] * MM2 == pytest.approx(34.9715871843, abs=5.1e-11)
    given_area = fs.phasor(table1(), area=20e-6)
    assert given_area.area[0] == 20e-6
    u = abs(given_area.u_gap[0])
    assert given_area.f_el_mean[0] == pytest.approx(8.854e-12 * u**2 * 20e-6 / (4.0 * 3.5e-6**2), rel=1e-13)


def test_an_area_fixed_by_the_deck_comes_before_mean_and_frozen_but_not_before_a_number() -> None:
    circuit = table1(gap={"a_fix": 30})
    for mode in ("mean", "frozen"):
        assert fs.phasor(circuit, area=mode).area[0] == pytest.approx(30e-6, rel=1e-15)
    assert fs.phasor(circuit, area=20e-6).area[0] == 20e-6


def test_a_source_that_is_no_sine_has_its_fundamentals_amplitude_and_phase() -> None:
    square = fs.phasor(table1("SQUARE(200 100)"))
    sine = fs.phasor(table1(f"SIN(0 {800.0 / math.pi!r} 100)"))
    assert square.frequency[0] == 100.0
    assert square.amplitude == pytest.approx(800.0 / math.pi, rel=1e-12)
    assert square.u_gap[0] == pytest.approx(sine.u_gap[0], rel=1e-11)
    assert square.area[0] == pytest.approx(sine.area[0], rel=1e-12)
    shifted = fs.phasor(table1("SIN(0 200 100 0 0 35)"))
    plain = fs.phasor(table1())
    assert shifted.gain[0] == pytest.approx(plain.gain[0], rel=1e-13)
    assert shifted.u_gap[0] == pytest.approx(plain.u_gap[0] * cmath.exp(1j * math.radians(35.0)), rel=1e-13)


def test_with_a_given_area_the_gain_is_defined_for_a_source_without_fundamental() -> None:
    circuit = table1("PWL(0 0 1m 100)")
    for mode in (35e-6, "frozen"):
        solution = fs.phasor(circuit, [100.0, 5000.0], area=mode)
        expected = [ref.phasor_gains(f, solution.area[0], ref.table1_layers(f))[ref.GAP] for f in (100.0, 5000.0)]
        np.testing.assert_allclose(solution.gain, expected, rtol=1e-13)
        assert np.isnan(solution.u_gap).all()
        assert math.isnan(solution.amplitude)


@pytest.mark.parametrize(
    ("source", "frequency", "area", "message"),
    [*listed("phasors"), ("PWL(0 0 1m 100)", None, 35e-6, "the source has no fundamental: give the frequencies in Hz")],
)
def test_what_has_no_phasor_is_refused_with_what_is_allowed(source, frequency, area, message: str) -> None:
    with pytest.raises(fs.InputError) as caught:
        fs.phasor(table1(source), frequency, area=area)
    assert message in str(caught.value)


def test_a_circuit_without_a_gap_has_the_phasors_of_its_nodes() -> None:
    circuit = deck("V1 in 0 AC 2 30", "R1 in out 1k", "C1 out 0 1u")
    f = np.array([1.0, 159.0, 1e4])
    found = fs.phasor(circuit, f)
    expected = 2.0 * np.exp(1j * np.pi / 6.0) / (1.0 + 2j * np.pi * f * 1e-3)
    np.testing.assert_allclose(found.v_nodes[:, found.nodes.index("out")], expected, rtol=1e-12)
    np.testing.assert_allclose(found.impedance, 1e3 + 1.0 / (2j * np.pi * f * 1e-6), rtol=1e-9)
    assert np.all(np.isnan(found.f_el_mean))


def test_a_stack_without_a_gap_divides_its_sine_as_its_admittances_say() -> None:
    layers = ("Xcoat a b area LAYER d=1u eps_r=4 r=1meg", "Xfilm b 0 area LAYER d=2u eps_r=4")
    circuit = deck("Vdrive a 0 SIN(0 3 100)", *layers, "Varea area 0 35")
    capacitance = 8.8541878128e-12 * 4.0 * 35e-6 / 1e-6
    y = 1e-6 + 2j * np.pi * 100.0 * capacitance
    expected = 3.0 * y / (y + 2j * np.pi * 100.0 * capacitance / 2.0)
    assert fs.phasor(circuit).v_nodes[0, 1] == pytest.approx(expected, rel=1e-5)


def test_sources_without_ac_are_silent_in_a_circuit_without_a_gap_as_in_ngspice(tmp_path: Path) -> None:
    lines = (
        "two",
        "V1 in 0 DC 5",
        "V2 mid 0 AC 1 90",
        "I1 0 out AC 1m",
        "R1 in out 1k",
        "R2 mid out 2k",
        "C1 out 0 1u",
    )
    text = "\n".join((*lines, "C2 out b 1n", "R3 b 0 1k"))
    found = fs.phasor(fs.parse_netlist(text), [10.0, 100.0, 1e3])
    block = ".ac dec 1 10 1k\n.control\nrun\nset numdgt=15\nwrdata out.txt v(out) v(b)\nquit 0\n.endc\n.end\n"
    (tmp_path / "deck.cir").write_text(f"{text}\n{block}")
    call_ngspice(tmp_path, "deck.cir")
    table = np.loadtxt(tmp_path / "out.txt")
    for column, node in ((1, "out"), (4, "b")):
        theirs = table[:, column] + 1j * table[:, column + 1]
        np.testing.assert_allclose(found.v_nodes[:, found.nodes.index(node)], theirs, rtol=1e-9)


def test_a_circuit_without_a_gap_says_where_its_skins_data_are_held_and_takes_no_other_area() -> None:
    skin = deck("V1 a 0 SIN(0 10 100)", "Xskin a 0 area SKIN d=350u f=100", "Varea area 0 35")
    held, alone = fs.phasor(skin, [50.0, 1e3], skin="own"), fs.phasor(skin, 100.0)
    assert held.notes == (
        "the skin's data are held at the deck's own frequency (Xskin f = 100 Hz) over the whole sweep",
    )
    assert held.circuit is skin
    np.testing.assert_allclose((1.0 / held.impedance).real, (1.0 / alone.impedance).real[0], rtol=1e-12)
    refuses("area is 'frozn'; allowed: 'mean', 'frozen' or a number", fs.phasor, skin, 100.0, area="frozn")
    with pytest.raises(fs.InputError, match="no source has an amplitude; allowed: AC on a source"):
        fs.phasor(deck("V1 in 0 5", "R1 in out 1k", "C1 out 0 1u"), 100.0)


@pytest.mark.parametrize(("sweep", "expected"), listed("ac_lines"))
def test_the_frequencies_of_an_ac_line_run_from_start_to_stop(sweep: list[Any], expected: list[float]) -> None:
    np.testing.assert_allclose(sweep_frequencies(AcSweep(*sweep)), expected, rtol=1e-12)


def test_the_source_sees_the_layers_in_series_and_what_stands_beside_them():
    f = np.array([20.0, 100.0, 5e3])
    swept = fs.phasor(table1(), f)

    def of_layers(x: float, area: float) -> complex:
        return ref.impedance(x, area, ref.table1_layers(x))

    known = np.array([of_layers(x, area) for x, area in zip(f, swept.area, strict=True)])
    np.testing.assert_allclose(swept.impedance, known, rtol=1e-12)
    # An amplifier's resistor before the finger, and a cable beside it; and the finger under a current.
    apart = table1_deck().replace("Vdrive drive 0", "Rout amp drive 47k\nCcable drive 0 150p\nVdrive amp 0")
    assert "Rout" in apart
    loaded = fs.phasor(fs.parse_netlist(apart), f)
    known = np.array([of_layers(x, area) for x, area in zip(f, loaded.area, strict=True)])
    beside = 47e3 + 1.0 / (1.0 / known + 2j * np.pi * f * 150e-12)
    np.testing.assert_allclose(loaded.impedance, beside, rtol=1e-10)
    driven = apart.replace("Rout amp drive 47k\n", "").replace("Vdrive amp 0", "Idrive 0 drive")
    current = fs.phasor(fs.parse_netlist(driven), f, area=36e-6)
    known = np.array([of_layers(x, 36e-6) for x in f])
    np.testing.assert_allclose(current.impedance, 1.0 / (1.0 / known + 2j * np.pi * f * 150e-12), rtol=1e-10)


WIDE = (20.0, 300.0, 5e3, 8e4)


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
    frequencies = WIDE if name != "current_drive" else (5e3, 2e4, 8e4)
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


def test_areas_settle_though_a_networks_rounding_moves_them() -> None:
    circuit = shipped("two_fingers").replace({"Xfirm.Xgap.d": 1e-7})
    p = fs.phasor(circuit, 100.0, finger="Xfirm.Xgap")
    own = dict(network_of(circuit).named_contacts)["Xfirm.Xgap"]
    assert p.area[0] == pytest.approx(float(own.area(abs(p.u_gap[0]) / math.sqrt(2.0))), rel=1e-11)


@pytest.mark.parametrize("given", [-35e-6, 0.0, math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("name", ["amplifier", "fingerpad"])
def test_an_area_that_is_none_is_refused_for_stacks_and_networks(name: str, given: float) -> None:
    circuit = fs.read_netlist(CIRCUITS / f"{name}.cir")
    refuses(r"area is \S+ m\^2; allowed: a positive area in m\^2", fs.phasor, circuit, area=given)


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
    refuses("skin is 'mine'; allowed: 'swept' or 'own'", fs.phasor, table1(), [100.0], skin="mine")


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
    refuses(r"the sweep has \S+ frequencies; allowed: at most 1000000", sweep_frequencies, sweep)


def test_three_hundred_decades_are_a_sweep() -> None:
    f = sweep_frequencies(AcSweep("dec", 1, 1e-150, 1e150))
    assert f.size == 301
    np.testing.assert_allclose(f[[0, -1]], [1e-150, 1e150], rtol=1e-12)


def test_the_command_says_what_drives_where_the_data_are_taken_and_where_they_end(command: Command) -> None:
    Path("pad.cir").write_text(edited(("SIN(0 200 100)", "SIN(0 200 100) AC 5 30")))
    result = command("ac", "pad.cir", "--sweep", "dec 1 1 100k", "--no-plot").ok()
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
