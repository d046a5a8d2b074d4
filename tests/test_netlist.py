"""From decks to circuits: the meaning of devices, parameters and directives, ambiguous units, and warnings."""

import dataclasses
import math

import numpy as np
import pytest

import analytic as ref
import fingerspice as fs
from deck_edits import DECK, edited
from fingerspice.circuit.circuit import AcSweep, Tran
from scenes import DECKS, heard, listed, refuses, warns


def read(*changes: tuple[str, str]) -> fs.Circuit:
    return fs.parse_netlist(edited(*changes), "deck.cir")


def refusal(text: str) -> str:
    return refuses("", fs.parse_netlist, text, "deck.cir")


def warned(text: str) -> list[str]:
    """The reader's warnings; they are also in the circuit."""
    circuit, said = heard(fs.parse_netlist, text, "deck.cir")
    assert said == list(circuit.warnings)
    return said


def test_the_papers_deck_is_its_devices_and_its_parameters() -> None:
    circuit = read()
    devices = {"Vdrive": "V", "Xcoat": "LAYER", "Xgap": "GAP", "Xskin": "SKIN"}
    assert [(e.name, e.device) for e in circuit.elements] == list(devices.items())
    assert circuit["Vdrive"].waveform == fs.Sine(200.0, 100.0)
    assert dict(circuit["Xcoat"].values) == {"d": 1e-6, "eps_r": 3.9, "r": 2e5, "e_max": math.inf}
    assert dict(circuit["Xskin"].values) == {"d": 350e-6, "f": 100.0}
    gap = {"d": 3.5e-6, "eps_r": 1.0, "r": 1e6, "fn": 0.5, "mu": 0.3, "alpha": 54.4, "m_exp": 0.52}
    gap |= {"beta": 32.0, "n_exp": 1.41, "c2": 5000.0, "a_fix": 0.0, "tau": 0.0, "p_sat": math.inf}
    assert dict(circuit["Xgap"].values) == gap | dict.fromkeys(("slip", "v", "r_exp", "r_load", "q", "n_cpe"), 0.0)
    assert circuit["xGAP"].nodes == ("top", "skin", "area")
    assert circuit.title == "Fingerpad"
    assert circuit.warnings == circuit.unused == ()
    assert circuit.text == DECK


@pytest.mark.parametrize(
    ("written", "ohm"),
    [
        *((text, math.inf) for text in ("", "r=inf", "r=INF", "r=none", "r=None")),
        *((text, 2e5) for text in ("r=0.2MEG", "r=0.2megohm", "r=2e5", "r=200kOhm")),
    ],
)
def test_a_coating_leaks_as_written_in_any_right_way_or_not_at_all(written: str, ohm: float) -> None:
    assert read(("r=0.2meg", written))["Xcoat"].values["r"] == ohm


def test_names_are_read_in_any_case_and_shown_as_written() -> None:
    lower, upper = read(), fs.parse_netlist("\n".join([DECK.split("\n")[0], *DECK.upper().split("\n")[1:]]))
    assert [e.name for e in upper.elements] == ["VDRIVE", "XCOAT", "XGAP", "XSKIN"]
    assert upper["Xgap"].node_names == ("TOP", "SKIN", "AREA")
    for a, b in zip(lower.elements, upper.elements, strict=True):
        assert (a.nodes, dict(a.values), a.waveform) == (b.nodes, dict(b.values), b.waveform)
    assert upper.tran == lower.tran
    assert upper.charge_law == "local"


def test_subcircuits_with_parameters_give_the_circuit_of_the_flat_deck() -> None:
    stack = (DECKS / "fingerpad_in_parts.cir").read_text()
    nested, flat = fs.parse_netlist(stack), read()
    assert [e.name for e in nested.elements] == ["Vdrive", "Xcoat", "Xf.Xgap", "Xf.Xskin"]
    for a, b in zip(nested.elements, flat.elements, strict=True):
        assert a.device == b.device
        assert dict(a.values) == pytest.approx(dict(b.values), rel=1e-15)
        assert a.waveform == b.waveform
    ours, theirs = fs.simulate(nested, t_stop=2e-3), fs.simulate(flat, t_stop=2e-3)
    assert ours.u_gap is not None
    assert theirs.u_gap is not None
    np.testing.assert_allclose(ours.u_gap, theirs.u_gap, rtol=0, atol=1e-9)
    assert nested.replace({"Xf.Xgap.d": 5e-6})["Xf.Xgap"].values["d"] == 5e-6


def test_tran_has_spices_four_numbers_and_uic() -> None:
    for line, expected in listed("trans"):
        assert read((".tran 10u 50m uic", line)).tran == Tran(**expected)


def test_ac_asks_for_a_sweep() -> None:
    for word in ("dec", "OCT", "Lin"):
        circuit = read((".end", f".ac {word} 10 1 100k"))
        assert circuit.ac == AcSweep(word.lower(), 10, 1.0, 1e5)
    assert read().ac is None


def test_start_values_are_kept_by_node() -> None:
    circuit = read((".end", ".ic V(Top)=3 v(skin)={1+1} v(area)=34.97\n.ic v(drive)=5 v(gnd)=0"))
    assert circuit.initial == {"top": 3.0, "skin": 2.0, "drive": 5.0, "0": 0.0, "area": 34.97}
    assert circuit.unused == (".ic v(area)",)


def test_the_included_library_says_which_charge_law() -> None:
    assert read().charge_law == "local"
    assert read(("fingerspice.lib", "FingerSpice_mobile.lib")).charge_law == "mobile"
    assert read((".include fingerspice.lib", "* nothing")).charge_law is None
    both = refusal(edited((".include fingerspice.lib", ".include fingerspice.lib\n.lib fingerspice_mobile.lib")))
    assert both.startswith("deck.cir: both fingerspice.lib (local law) and fingerspice_mobile.lib (mobile law)")


def test_the_reading_of_eq_7_is_an_option_those_of_ngspice_are_listed_once_and_nodeset_is_not_worth_a_word() -> None:
    assert read().work == "gap"
    assert read((".end", ".options work=total")).work == "total"
    assert read((".end", ".option WORK=Gap")).work == "gap"
    circuit = read(
        (".end", ".options reltol=1e-4 trtol=7\n.options reltol=1e-3\n.nodeset v(area)=35\n.nodeset v(top)=1")
    )
    assert circuit.unused == (".options reltol", ".options trtol")


def test_a_deck_without_gap_has_voltages_and_no_forces() -> None:
    circuit = fs.parse_netlist(
        "t\nV1 a 0 SIN(0 10 100)\nX1 a b area LAYER d=1u eps_r=2 r=1meg\nX2 b 0 area SLAB d=2u eps_r=3 rho=1e6\n"
        "Varea area 0 35\n.tran 100u 20m uic\n"
    )
    solution = fs.simulate(circuit)
    assert solution.u_gap is solution.f_el is solution.f_t is solution.friction is None
    np.testing.assert_array_equal(solution.area, 35e-6)
    eps0 = ref.TABLE1.eps0
    layers = [ref.Layer(2.0 * eps0 / 1e-6, r_total=1e6), ref.Layer(3.0 * eps0 / 2e-6, r_area=1e6 * 2e-6)]
    expected = ref.sine_frozen_from_rest(100.0, 10.0, 35e-6, solution.t, layers)
    np.testing.assert_allclose(solution.u_layer, expected, rtol=0, atol=1e-11)
    assert set(solution.node_voltages) == {"a", "b"}


@pytest.mark.parametrize("written", ["0.2MOhm", "0.2M", "0.2Mohm"])
def test_a_capital_m_on_a_resistance_is_milli_and_warned_about(written: str) -> None:
    (said,) = warned(edited(("r=0.2meg", f"r={written}")))
    assert said.startswith("deck.cir:4:45: Xcoat r: ")
    assert written in said
    assert "(0.0002 ohm)" in said
    assert said.endswith("write 0.2meg")
    with pytest.warns(fs.FingerspiceWarning):
        assert read(("r=0.2meg", f"r={written}"))["Xcoat"].values["r"] == 2e-4


def test_a_capital_m_is_warned_about_through_a_parameter_and_on_a_resistivity() -> None:
    (said,) = warned(edited(("r=0.2meg", "r={rc}"), (".end", ".param rc=0.2M")))
    assert said.startswith("deck.cir:8:11: Xcoat r: '0.2M' is milli")
    (said,) = warned(edited(("LAYER d=1u eps_r=3.9 r=0.2meg", "SLAB d=1u eps_r=3.9 rho=1M")))
    assert "rho: '1M' is milli (0.001 ohm m)" in said
    for text in ("r=200k", "r=0.2MEG"):
        assert warned(edited(("r=0.2meg", text))) == []
    (said,) = warned(edited(("r=0.2meg", "r=0.2m")))
    assert "200 uohm, outside 1 ohm to 1e+15 ohm" in said


def test_a_title_that_swallows_the_source_is_named_with_the_error_it_causes() -> None:
    text = DECK.split("\n", 2)[2]
    said = refusal(text)
    assert said.startswith("deck.cir: the circuit has no source")
    assert "the first line is the title, but 'Vdrive drive 0 SIN(0 200 100)' reads like a statement" in said


BAD = [case for kind in ("devices", "values", "contact", "circuit", "directives", "sources") for case in listed(kind)]


@pytest.mark.parametrize(("change", "line", "parts"), BAD, ids=[change[1] for change, _, _ in BAD])
def test_what_is_wrong_is_a_sentence_with_its_line(change: tuple[str, str], line: int, parts: list[str]) -> None:
    said = refusal(edited(change))
    assert said.startswith(f"deck.cir:{line}:" if line else "deck.cir: ")
    assert [part for part in parts if part not in said] == []
    assert "\n" not in said
    assert len(said) < 400


CHANGED = (
    ("Xgap.d", "3u", 3e-6), ("xGAP.D", " 3.5um ", 3.5e-6), ("Xcoat.r", "inf", math.inf), ("Xcoat.r", "none", math.inf),
    ("Xcoat.r", "0.2meg", 2e5), ("Xskin.f", "1k", 1e3), ("Vdrive.amplitude", "0.15k", 150.0), ("Xgap.c2", 4000, 4e3),
    ("Vdrive.frequency", "2kHz", 2e3), ("Xgap.fn", np.float64(0.25), 0.25), ("Xgap.fn", np.array(0.25), 0.25),
)  # fmt: skip


@pytest.mark.parametrize(("path", "text", "value"), CHANGED)
def test_values_are_changed_by_numbers_and_in_spices_notation(path: str, text: object, value: float) -> None:
    changed = read().replace({path: text})  # type: ignore[dict-item]
    name = next(name for name in changed.parameters if name.lower() == path.lower())
    assert changed.parameters[name].value == value
    assert changed.warnings == ()


def test_what_is_doubtful_in_a_sources_text_is_warned_about() -> None:
    warns(r"'SIN\(0,5 200 100\)': 0,5 is two numbers, 0 and 5", read().replace, {"Vdrive": "SIN(0,5 200 100)"})
    warns(r"'SIN\(0 5\)': source: SIN leaves out FREQ", read().replace, {"Vdrive": "SIN(0 5)"})
    with pytest.raises(fs.InputError, match=r"frequency is 0 Hz; allowed: > 0; note 0,1k is two numbers, 0 and 1k"):
        read().replace({"Vdrive": "SIN(0 5 0,1k)"})


def test_a_source_is_changed_by_its_text() -> None:
    changed = read().replace({"vdrive": "SQUARE(150 1k)"})
    assert changed["Vdrive"].waveform == fs.Square(150.0, 1e3)
    assert changed.overrides == {"vdrive": "SQUARE(150 1k)"}


@pytest.mark.parametrize(
    ("path", "text", "said"),
    [
        *listed("changes"),
        ("Xgap.d", fs.DC(1.0), "Xgap.d is DC(level=1.0); allowed: a number m, or text such as '3.5u'"),
        ("Xgap.d", np.array([1e-6]), "allowed: a number m, or text such as '3.5u'"),
        ("Xgap.d", None, "Xgap.d is None; allowed: a number m"),
        ("Xgap.mu", 1j, "Xgap.mu is 1j; allowed: a number, or text"),
        ("Xgap.d", math.nan, "Xgap d is nan m; allowed: more than 0"),
    ],
)
def test_changes_that_are_no_values_are_one_sentence(path: str, text: object, said: str) -> None:
    with pytest.raises(fs.InputError) as caught:
        read().replace({path: text})  # type: ignore[dict-item]
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("given", [None, 5, ("deck.cir",), np.zeros(2)])
def test_what_is_no_path_and_no_text_is_one_sentence(given: object) -> None:
    refuses(r"read_netlist is given .*; allowed: the path of a netlist", fs.read_netlist, given)
    refuses(r"parse_netlist is given .*; allowed: a netlist's text", fs.parse_netlist, given)


def test_a_parameter_of_a_subcircuit_is_refused_with_the_elements_inside_it() -> None:
    circuit = fs.parse_netlist("t\nV1 a 0 5\n.subckt pair p n params: r=1k\nR1 p m {r}\nR2 m n 5\n.ends\nX1 a 0 pair\n")
    for path in ("X1.r", "x1.nothing", "X1"):
        refuses(r"is a subcircuit, whose own .* inside it \(X1\.R1, X1\.R2\)$", circuit.replace, {path: 5})
    assert circuit.replace({"X1.R1.value": 5})["X1.R1"].values["value"] == 5.0


def test_a_files_name_where_its_text_belongs_is_named() -> None:
    said = "parse_netlist is given 'circuits/fingerpad.cir', a file's name; allowed: read_netlist for a file"
    assert refusal("circuits/fingerpad.cir") == said


@pytest.mark.parametrize("changes", ["Xgap.d=3u", [("Xgap.d", 3e-6)], None, {5: 3e-6}])
def test_changes_that_are_no_mapping_are_one_sentence(changes: object) -> None:
    refuses(r"allowed: a mapping such as \{'Xgap.d': 3e-6\}", read().replace, changes)


def test_a_capital_m_in_a_change_is_milli_and_warned_about() -> None:
    changed = warns(r"Xcoat.R: '0.2M' is milli .* write 0.2meg", read().replace, {"Xcoat.R": "0.2M"})
    assert changed["Xcoat"].values["r"] == 2e-4


def test_a_rate_has_no_prefix_where_changes_are_told() -> None:
    changed = read().replace({"Vdrive": "SIN(0 200 100 0 5k)"}).replace({"Vdrive.damping": 2e-3})
    assert "Vdrive.damping = 0.002 1/s" in str(changed)


def test_a_circuit_cannot_be_changed_in_place() -> None:
    circuit = read()
    with pytest.raises(dataclasses.FrozenInstanceError):
        circuit.title = "another"  # type: ignore[misc]
    with pytest.raises(TypeError):
        circuit["Xgap"].values["d"] = 1.0  # type: ignore[index]
