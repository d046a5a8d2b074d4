"""Values that are legal but unusual: warnings from Python and from the command line, and values without a warning."""

import math
import re
import warnings
from collections.abc import Callable
from pathlib import Path

import pytest

import fingerspice as fs
from commands import QUICK, Command
from deck_edits import edited
from fingerspice.base.units import parse_number, spice_text
from fingerspice.circuit.devices import DEVICES, REST_AREA, SOURCES, ParameterSpec
from scenes import deck, table1


def said_by(make: Callable[[], object]) -> list[str]:
    """Warnings of a call."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        make()
    assert all(w.category is fs.FingerspiceWarning for w in caught)
    return [str(w.message) for w in caught]


# What is said

#: A change of the deck, its path and value, what the warning says, and what was likely meant.
SLIPS = {
    "gap in m": (("d=3.5u", "d=3.5"), ("Xgap.d", 3.5), "Xgap d is 3.5 m, outside 10 nm to 100 um", "3.5u"),
    "gap in mm": (("d=3.5u", "d=3.5m"), ("Xgap.d", 3.5e-3), "Xgap d is 3.5 mm, outside 10 nm to 100 um", "3.5u"),
    "skin in nm": (("d=350u", "d=350n"), ("Xskin.d", 350e-9), "Xskin d is 350 nm, outside 1 um to 2 mm", "350u"),
    "coating in m": (("d=1u", "d=1"), ("Xcoat.d", 1.0), "Xcoat d is 1 m, outside 10 nm to 10 mm", "1m or 1u"),
    "load in mN": (("fn=0.5 mu=0.3", "fn=50 mu=0"), None, "Xgap fn is 50 N, outside 1 mN to 49.9 N", "50m"),
    "alpha too large": (
        ("alpha=54.4", "alpha=54.4meg"), ("Xgap.alpha", 54.4e6), "Xgap alpha is 5.44e+07 mm^2/N^m, outside", "54.4",
    ),
    "permittivity": (("eps_r=3.9", "eps_r=0.39"), ("Xcoat.eps_r", 0.39), "Xcoat eps_r is 0.39, outside 1 to", None),
    "fixed area": (("c2=5000", "c2=5000 a_fix=1u"), ("Xgap.a_fix", 1e-6), "Xgap a_fix is 1e-06 mm^2, outside 0.1", "1"),
    "resistance": (("r=0.2meg", "r=0.2"), ("Xcoat.r", 0.2), "Xcoat r is 200 mohm, outside", "200, 200k or 200meg"),
    "frequency": (("SIN(0 200 100)", "SIN(0 200 100meg)"), None, "Vdrive frequency is 100 MHz, outside 10 mHz", "100k"),
    "voltage": (("SIN(0 200 100)", "SIN(0 200k 100)"), None, "Vdrive amplitude is 200 kV, outside 0 V to 10 kV", "200"),
    "skin's f": (("f=100", "f=1meg"), ("Xskin.f", 1e6), "Xskin f is 1 MHz, outside 10 Hz to 100 kHz", "1k"),
}  # fmt: skip
each_slip = pytest.mark.parametrize("name", SLIPS)


@each_slip
def test_a_likely_slip_is_named_with_its_place_the_range_and_what_was_meant(name: str) -> None:
    change, _, expected, meant = SLIPS[name]
    circuits: list[fs.Circuit] = []
    (said,) = said_by(lambda: circuits.append(fs.parse_netlist(edited(change), "deck.cir")))
    place, _, text = said.partition(": ")
    assert re.fullmatch(r"deck\.cir:[34567]:\d+", place)
    assert text.startswith(expected)
    assert "the usual range (" in text
    assert ("meant?" in text) == (meant is not None)
    if meant is not None:
        assert f"; was {meant}" in text
    assert circuits[0].warnings == (said,)


@pytest.mark.parametrize("name", [name for name, slip in SLIPS.items() if slip[1] is not None])
def test_a_change_in_python_and_on_the_command_line_is_warned_about_as_in_the_deck(name: str, command: Command) -> None:
    _, change, expected, _ = SLIPS[name]
    assert change is not None
    path, value = change
    changed: list[fs.Circuit] = []
    (said,) = said_by(lambda: changed.append(table1().replace({path: value})))
    assert said.startswith(expected)
    assert changed[0].warnings == (said,)
    (line,) = command("plan", "pad.cir", "--set", f"{path}={value!r}").lines[:1]
    assert line == f"fingerspice: warning: {said}"


def test_what_is_put_right_is_not_warned_about_any_more() -> None:
    with pytest.warns(fs.FingerspiceWarning):
        wrong = fs.parse_netlist(edited(("d=3.5u", "d=3.5"), ("eps_r=1 ", "eps_r=1e5 ")), "deck.cir")
    assert len(wrong.warnings) == 2
    half: list[fs.Circuit] = []
    assert said_by(lambda: half.append(wrong.replace({"Xgap.d": "3.5u"}))) == []
    assert [text.partition(" is ")[0] for text in half[0].warnings] == ["deck.cir:5:36: Xgap eps_r"]
    assert half[0].replace({"Xgap.eps_r": 1}).warnings == ()


def test_a_number_with_a_trap_in_it_gets_one_word() -> None:
    for change in (("r=0.2meg", "r=0.2M"), ("d=350u", "d=1e-4\u00b5")):
        (said,) = said_by(lambda c=change: fs.parse_netlist(edited(c)))  # type: ignore[misc]
        assert "usual" not in said
    assert "1e-4\u00b5 is 1e-10: exponent and scale both count" in said


def test_sources_of_screens_are_usual() -> None:
    for source in ("SIN(0 200 1)", "SIN(0 200 100k)", "DC 0", "PULSE(-150 150 0 1n 1n 4m 10m)"):
        assert said_by(lambda s=source: fs.parse_netlist(edited(("SIN(0 200 100)", s)))) == []  # type: ignore[misc]


def test_a_deck_that_is_wholly_unusual_does_not_flood() -> None:
    chain = [f"R{i} n{i} n{i + 1} 1u" for i in range(250)]
    said = said_by(lambda: fs.parse_netlist("\n".join(["t", "V1 n0 0 5", *chain, "Re n250 0 1k", ".tran 1m 1"])))
    assert len(said) == 101
    assert said[-1] == "150 more warnings are not shown"


def test_an_area_that_a_source_or_a_start_gives_in_m2_is_warned_about() -> None:
    lines = ["t", "V1 a 0 5", "X1 a 0 area LAYER d=1u eps_r=2", "Varea area 0 35u", ".tran 1m 10m"]
    (said,) = said_by(lambda: fs.parse_netlist("\n".join(lines), "d.cir"))
    assert said.startswith("d.cir:4:1: Varea, an area, is 3.5e-05 mm^2, outside 0.1 to 2000 mm^2")
    assert said.endswith("it is in mm^2, not m^2; was 35 meant?")
    (said, *_) = said_by(lambda: fs.parse_netlist(edited((".end", ".ic v(area)=35u\n.end"))))
    assert said.startswith(".ic v(area) is 3.5e-05 mm^2, outside 0.1 to 2000 mm^2")


def test_a_finger_too_small_by_values_that_are_each_usual_is_warned_about() -> None:
    (said,) = said_by(lambda: table1(gap={"alpha": 1, "fn": "10m", "mu": 0.5, "m_exp": 0.5, "c2": 320, "n_exp": 1.4}))
    # Eqs. 3 and 5 without voltage: alpha fn^m_exp = 0.1 mm^2, less c2 (mu fn)^2 over that.
    area = 0.1 - 320 * (0.5 * 0.01) ** 2 / 0.1
    assert f"Xgap area at 0 V is {area:.4g} mm^2, outside 0.1 to 2000 mm^2" in said


def test_a_load_that_leaves_no_contact_is_refused_with_the_likely_slip() -> None:
    for make in (lambda: fs.parse_netlist(edited(("fn=0.5", "fn=50"))), lambda: table1().replace({"Xgap.fn": 50})):
        with pytest.raises(fs.InputError, match=r"has no contact: .* it is in newton, not millinewton; was 50m meant"):
            make()


# Results


def test_results_out_of_this_world_are_warned_about() -> None:
    with pytest.warns(fs.FingerspiceWarning):
        circuit = table1(gap={"alpha": "54.4meg"}, tran="50u 10m uic")
    said = said_by(lambda: fs.large_signal(circuit, [1e3], rtol=1e-4))
    assert sum("force reaches" in text or "area reaches" in text for text in said) == 2
    for said in (said_by(lambda: fs.simulate(circuit)), said_by(lambda: fs.phasor(circuit))):
        force, ridges = (text.partition(": ") for text in said if "reaches" in text)
        assert force[0].startswith("the electroadhesive force reaches ")
        assert force[0].endswith("N, over 100 N (as much as a finger bears)")
        area = re.fullmatch(r"the contact area reaches (\S+) m\^2, over 0\.001 m\^2 \(10 cm\^2, .*\)", ridges[0])
        assert area is not None
        # At rest it is alpha fn^m_exp; adhesion makes it larger.
        assert 54.4 * 0.5**0.52 <= float(area[1]) < 100.0
        assert force[2] == ridges[2] == "some value is probably in another unit"


@pytest.mark.parametrize("beside", ["", "Rbeside a 0 1meg"], ids=["stack", "network"])
def test_a_pressure_that_no_layer_bears_is_warned_about_from_10_mpa_on(beside: str) -> None:
    # eps0 (u/d)^2 / 2 = 10 MPa at 1.503 GV/m; the gap alone takes the source's voltage.
    limit = math.sqrt(2.0 * 10e6 / 8.854e-12) * 50e-9
    for factor, expected in ((0.999, 0), (1.001, 1)):
        lines = (f"V1 a 0 {factor * limit!r}", "Xgap a 0 area GAP d=50n a_fix=1", ".tran 10u 100u uic", beside)
        said = said_by(lambda lines=lines: fs.simulate(deck(*lines)))  # type: ignore[misc]
        (*pressure,) = (text for text in said if "electric pressure" in text)
        assert len(pressure) == expected
        assert all(text.startswith("the electric pressure reaches 10.02 MPa, over 10 MPa (") for text in pressure)


def test_a_batch_of_gaps_in_the_wrong_unit_is_warned_about_once() -> None:
    said = said_by(lambda: fs.batch(table1(), {"Xgap.d": [2.0, 3.0, 4.0]}, rtol=1e-3, t_stop=1e-2))
    assert sum("Xgap d is" in text and "the usual range" in text for text in said) == 2


def test_an_area_given_in_mm2_in_python_is_warned_about() -> None:
    said = said_by(lambda: fs.simulate(table1(tran="50u 10m uic"), area=35.0))
    assert "the contact area reaches 35 m^2, over 0.001 m^2 (10 cm^2, more than a finger has)" in " ".join(said)


# What is not said


def test_shipped_decks_are_usual() -> None:
    for path in sorted((Path(__file__).parents[1] / "circuits").glob("*.cir")):
        said = said_by(lambda d=path: fs.simulate(fs.read_netlist(d), t_stop=2e-4))  # type: ignore[misc]
        # Some begin with a rest, which is all of so short a run.
        assert [text for text in said if "covers nothing of the run" not in text] == []


def test_a_sweep_of_this_package_is_not_warned_about_value_by_value(command: Command) -> None:
    Path("pad.cir").write_text(edited(QUICK))
    said = said_by(lambda: fs.large_signal(table1(), [200e3], rtol=1e-4))
    assert not [text for text in said if "the usual range" in text]


# The table


PARAMETERS = [(device, p) for device, spec in DEVICES.items() for p in spec.parameters]
every_parameter = pytest.mark.parametrize(("device", "spec"), PARAMETERS, ids=[f"{d}.{p.name}" for d, p in PARAMETERS])


@every_parameter
def test_every_parameter_has_a_usual_range_with_its_source_inside_the_legal_one(
    device: str, spec: ParameterSpec
) -> None:
    assert spec.usual is not None
    assert spec.least <= spec.usual.least < spec.usual.most <= spec.most
    assert len(spec.usual.source) > 10
    if spec.default is not None:
        assert spec.unusual("X", spec.default) is None
    for inside in (spec.usual.least, spec.usual.most):
        assert spec.unusual("X", inside) is None
    for outside in (spec.usual.least * (1 - 1e-9), spec.usual.most * (1 + 1e-9)):
        assert f"X {spec.name} is " in (spec.unusual("X", outside) or "")


def test_none_and_endless_are_not_unusual() -> None:
    for usual in (REST_AREA, *SOURCES.values()):
        assert usual.warning("X", 0.0, "V") is usual.warning("X", math.inf, "V") is None


def test_a_number_as_spice_writes_it_reads_as_itself() -> None:
    for value in (3.5e-6, 2e5, 54.4, 1e-3, 999.9, 1e-15, 4e9, 7e12, 123456.0):
        assert parse_number(spice_text(value)) == value
