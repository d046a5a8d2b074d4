"""Decks written for LTspice, ngspice or by other authors: the supported ones load, the others get clear messages."""

import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import analytic as ref
import fingerspice as fs
from commands import Command
from deck_edits import DECK, edited
from fingerspice.circuit.circuit import Tran
from fingerspice.netlist.lexer import decimal_comma
from fingerspice.netlist.reader import ELSEWHERE, LIBRARIES, shipped_text
from ngspice_tools import beside, call_ngspice, with_max_step
from scenes import DECKS, heard, listed, warns

TRAN = ".tran 10u 50m uic"
OTHERS = sorted((DECKS / "others").glob("*.cir"))


def read(*changes: tuple[str, str]) -> tuple[fs.Circuit, list[str]]:
    """The deck, and what was said of it."""
    return heard(fs.parse_netlist, edited(*changes), "deck.cir")


def test_what_ltspice_saves_loads_and_is_the_same_circuit_as_ours() -> None:
    # As LTspice XVII saves a schematic: Latin-1, CRLF, SINE, two numbers less in .tran, parasitics, parts' data.
    theirs = fs.read_netlist(DECKS / "ltspice.net")
    assert theirs.title == "* C:\\Users\\M\xfcller\\finger.asc"
    assert theirs.warnings == ()
    assert theirs.unused == (".options plotwinsize", ".options numdgt")
    assert theirs.tran == Tran(1e-5, 0.02, 0.0, 1e-5)
    ours = fs.parse_netlist(
        "t\nV1 s 0 SIN(0 200 100)\nRs a s 1k\nXU1 a b area LAYER d=1u eps_r=3.9 r=0.2meg\n"
        "XU2 b c area GAP d=3.5u eps_r=1 r=1meg fn=0.5 mu=0.3 alpha=54.4 m_exp=0.52 beta=32 n_exp=1.41 c2=5000\n"
        "XU3 c 0 area SKIN d=350u f=100\nR1 a 0 10meg\nC1 e 0 100p\nRe a e 50\nRp a 0 1g\nCp a 0 1p\n"
        ".tran 10u 20m 0 10u\n"
    )
    one, other = fs.simulate(theirs, rtol=1e-9), fs.simulate(ours, rtol=1e-9)
    np.testing.assert_allclose(one.u_gap, other.u_gap, rtol=0, atol=1e-6)
    np.testing.assert_allclose(one.node_voltages["N001"], other.node_voltages["a"], rtol=0, atol=1e-6)
    assert {e.name for e in theirs.elements} >= {"V1.Rser", "C1.Rser", "C1.Rpar", "C1.Cpar"}


def test_a_source_with_rser_is_exported_with_it_and_runs_in_ngspice() -> None:
    circuit, said = read(("SIN(0 200 100)", "SIN(0 200 100) Rser=1meg Cpar=10p"), (TRAN, ".tran 10u 20m 0 2u uic"))
    assert said == []
    assert "RVdrive_Rser drive Vdrive_Rser 1000000.0" in fs.export_netlist(circuit)
    run, _, theirs, _ = beside(circuit, after=1e-4)
    assert np.abs(run.u_gap - theirs).max() <= 1e-4 * np.abs(run.u_gap).max()


def test_an_rser_is_the_resistor_that_it_stands_for_by_hand() -> None:
    # A capacitor behind 1 kohm, at a constant voltage: 5 (1 - exp(-t/RC)).
    circuit = fs.parse_netlist("t\nV1 a 0 5 Rser=400\nC1 a 0 1u Rser=600 IC=0 Lser=0\n.tran 10u 5m uic\n")
    solution = fs.simulate(circuit)
    v = solution.node_voltages["C1.Rser"]
    np.testing.assert_allclose(v, 5.0 * (1.0 - np.exp(-solution.t / 1e-3)), rtol=0, atol=1e-7)


@pytest.mark.parametrize("key", ["Rser=0", "Cpar=0", "Rser=0 Cpar=0"])
def test_no_parasitics_are_no_elements(key: str) -> None:
    circuit, said = read(("SIN(0 200 100)", f"SIN(0 200 100) {key}"))
    assert said == []
    assert len(circuit.elements) == 4


@pytest.mark.parametrize(("line", "tran", "noted"), listed("trans_of_ltspice"))
def test_ltspices_tran_needs_no_step(line: str, tran: dict[str, Any], noted: bool) -> None:
    circuit, said = read((TRAN, line))
    assert circuit.tran == Tran(**tran)
    expected = f"deck.cir:7:1: '{line}' has no TSTEP, which LTspice does not need: 10,000 outputs, one every 2e-06 s"
    assert said == ([expected] if noted else [])


@pytest.mark.parametrize(("source", "wave", "expected"), [
    ("SINE(1 200 100 1m 2 30)", fs.Sine(200.0, 100.0, 1.0, 30.0, 1e-3, 2.0), ""),
    (
        "PWL(0 0 1m 5 +2m 0)", fs.PWL((0.0, 1e-3, 2e-3), (0.0, 5.0, 0.0)),
        "the time +2m is counted from 0, as in ngspice; LTspice counts it from the point before",
    ),
    (
        "SIN(200 100)", fs.Sine(100.0, 20.0, 200.0),
        "SIN leaves out FREQ, which is 1/TSTOP then, 20 Hz; its values are VO VA FREQ",
    ),
])  # fmt: skip
def test_what_ltspice_reads_in_another_way_is_named(source: str, wave: fs.Waveform, expected: str) -> None:
    circuit, said = read(("SIN(0 200 100)", source))
    assert circuit["Vdrive"].waveform == wave
    assert said == ([f"deck.cir:3:16: Vdrive: {expected}"] if expected else [])


@pytest.mark.parametrize("beside", ["", "R9 drive 0 1k\n"], ids=["stack", "network"])
def test_a_run_whose_source_has_ac_alone_is_warned_about(beside: str) -> None:
    circuit, said = read(("SIN(0 200 100)", "AC 200 100"), (".end", f"{beside}.end"))
    assert said == []
    expected = r"0 all the time: Vdrive has AC alone, which drives sweeps .* SIN\("
    warns(expected, fs.simulate, circuit, t_stop=1e-4)


def test_a_netlist_in_utf_16_with_its_mark_is_read(tmp_path: Path) -> None:
    path = tmp_path / "finger.net"
    path.write_bytes(DECK.replace("3.5u", "3.5\u00b5").encode("utf-16"))
    assert fs.read_netlist(path)["Xgap"].values["d"] == 3.5e-6


@pytest.mark.parametrize(("line", "value"), listed("parts"))
def test_values_of_r_and_c_by_name_and_by_number_of_parts(line: str, value: float) -> None:
    circuit, said = read((".end", f".params g=10k\n{line}\n.end"))
    assert circuit[line[:2]].values["value"] == pytest.approx(value, rel=1e-15)
    assert said == []


def test_named_values_and_parts_are_those_of_ngspice() -> None:
    text = (
        "t\nV1 a 0 SIN(0 10 1k)\nR1 a b r=10k // behind a divider\nR2 b 0 10k m=2 ; two\nC1 b 0 c=2n m=5 $ five\n"
        ".tran 1u 2m 0 0.5u uic\n.end\n"
    )
    ours, theirs = beside(fs.parse_netlist(text), text).nodes["b"]
    assert np.abs(ours - theirs).max() <= 1e-5 * np.abs(ours).max()


def test_a_gap_has_the_librarys_defaults_which_are_table_1() -> None:
    values = " d=3.5u eps_r=1 r=1meg fn=0.5 mu=0.3 alpha=54.4 m_exp=0.52 beta=32 n_exp=1.41 c2=5000"
    short, said = read((values, " r=1meg"))
    assert said == []
    assert dict(short["Xgap"].values) == dict(fs.parse_netlist(DECK)["Xgap"].values)
    assert fs.simulate(short, area="frozen", t_stop=1e-3).area[0] == pytest.approx(float(ref.area(0.0)), rel=1e-12)


@pytest.mark.parametrize("word", ELSEWHERE)
def test_a_directive_of_another_simulator_says_the_way_here(word: str) -> None:
    with pytest.raises(fs.InputError) as caught:
        read((".end", f"{word} 1 2 3\n.end"))
    assert str(caught.value) == f"deck.cir:8:1: {word} is not supported: {ELSEWHERE[word]}"


@pytest.mark.parametrize("word", [".nodeset v(area)=35", ".backanno", ".NODESET v(top)=1 v(skin)=2"])
def test_what_only_ngspice_or_ltspice_needs_is_not_worth_a_word(word: str, command: Command) -> None:
    circuit, said = read((".end", f"{word}\n.end"))
    assert said == []
    assert circuit.unused == ()
    Path("pad.cir").write_text(edited((TRAN, ".tran 50u 1m uic"), (".end", f"{word}\n.end")))
    assert not command("run", "pad.cir", "--no-plot").lines


@pytest.mark.parametrize(("line", "said"), [*listed("commas"), *((line, None) for line in listed("right_commas"))])
def test_a_decimal_comma_is_named_and_a_comma_that_separates_is_right(line: str, said: str | None) -> None:
    found = decimal_comma(line)
    assert found is None if said is None else (found or "").endswith(said)


@pytest.mark.parametrize("name", LIBRARIES.values())
def test_a_changed_library_beside_the_deck_is_warned_about_for_it_is_not_read(name: str, tmp_path: Path) -> None:
    law = next(law for law, file in LIBRARIES.items() if file == name)
    path = tmp_path / "deck.cir"
    path.write_text(edited(("fingerspice.lib", name)))
    for text, expected in (
        (None, 0), (shipped_text(law), 0), (shipped_text(law).replace("\n", "\r\n") + "\r\n", 0),
        (shipped_text(law).replace("8.854e-12", "8.9e-12"), 1), ("", 1), ("x" * 10_000_000, 1),
    ):  # fmt: skip
        if text is not None:
            (tmp_path / name).write_text(text, newline="")
        circuit, told = heard(fs.read_netlist, path)
        said = (
            f"{path}:2:10: '{name}' differs from this version's and is not read: the devices are built in here, and "
            "only ngspice would run the changed ones"
        )
        assert told == [said][:expected]
        assert circuit.warnings == (said,)[:expected]
    assert circuit.charge_law == law


def test_a_library_outside_the_decks_folder_is_not_looked_at(tmp_path: Path) -> None:
    (tmp_path / "fingerspice.lib").write_text("changed")
    (tmp_path / "in").mkdir()
    path = tmp_path / "in" / "deck.cir"
    path.write_text(edited((".include fingerspice.lib", ".include ../fingerspice.lib")))
    (tmp_path / "in" / "fingerspice.lib").symlink_to(tmp_path / "fingerspice.lib")
    assert fs.read_netlist(path).warnings == ()
    path.write_text(DECK)
    assert fs.read_netlist(path).warnings == ()


@pytest.mark.filterwarnings("ignore:.*(has no effect here|usual range)")
@pytest.mark.parametrize("path", OTHERS, ids=lambda path: path.stem)
def test_decks_of_other_tools_have_ngspices_voltages(path: Path, tmp_path: Path) -> None:
    text = path.read_text("utf-8")
    circuit = fs.parse_netlist(text)
    stop = circuit.tran.stop
    block = (
        ".control\nrun\nset wr_singlescale\nset numdgt=15\nset wr_vecnames\nwrdata out.txt all\nquit 0\n.endc\n.end\n"
    )
    bare = re.sub(r"(?im)^\.end\s*$", "", with_max_step(text, stop / 20_000))
    (tmp_path / "deck.cir").write_text(f"{bare}\n{block}")
    call_ngspice(tmp_path, "deck.cir")
    head, *rows = (tmp_path / "out.txt").read_text().splitlines()
    names, table = head.split(), np.array([row.split() for row in rows], float)
    t, first = np.unique(np.minimum(table[:, 0], stop), return_index=True)
    t, first = t[1:], first[1:]
    ours = fs.simulate(circuit, t_eval=t, rtol=1e-9).node_voltages
    for node in {name for e in circuit.elements for name in e.node_names[:2]} - {"0", "GND"}:
        theirs = table[first, names.index(node.lower().rstrip(")"))]
        assert np.abs(ours[node] - theirs).max() <= 2e-3 * np.abs(theirs).max(), node


def test_a_pulse_charges_what_hangs_on_a_name_with_brackets() -> None:
    s = fs.simulate(fs.read_netlist(DECKS / "others" / "kicad_eagle_busses.cir"), t_eval=[1.005e-6 + 4e-6])
    assert s.node_voltages["Net-(C1-Pad1)"][0] == pytest.approx(1.0 - math.exp(-4.0 / 5.0), rel=1e-5)
