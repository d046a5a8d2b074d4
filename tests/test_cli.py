"""The command line: files, printed text, exit codes, and the keys of `--json` however a command ends."""

import contextlib
import csv
import fcntl
import io
import json
import math
import os
import re
import shlex
import shutil
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray
from PIL import Image

import fingerspice as fs
from commands import QUICK, Command, Result, tree
from deck_edits import edited
from fingerspice.circuit.devices import DEVICES
from fingerspice.circuit.laws import LAWS
from fingerspice.cli.terminal import COMMON, FIGURES, OWN
from fingerspice.netlist.expressions import FUNCTIONS
from fingerspice.netlist.reader import DIRECTIVES
from fingerspice.results.runfile import create
from scenes import CIRCUITS, listed, shipped

OUT = {"out", "out/.gitignore"}
"""What stands where nobody named a folder, besides the results."""


def figures(result: Result) -> Any:
    assert result.code == 0
    return json.loads(result.out)


def row(report: Any, signal: str) -> Any:
    """Figures of the only signal of that name."""
    (found,) = [row for row in report["signals"] if row["signal"] == signal]
    return found


def test_run_writes_data_and_picture_and_prints_a_table_with_the_gap_voltage(command: Command, tmp_path: Path) -> None:
    result = command("run", "pad.cir", "--out", "new/folder").ok()
    assert not result.lines
    table = result.out.splitlines()
    assert table[0] == "Fingerpad"
    expected = fs.simulate(fs.read_netlist("pad.cir"))
    row = next(line for line in table if line.startswith("gap voltage"))
    assert f"{expected.u_gap.max():.1f} V" in row  # type: ignore[union-attr]
    assert "status: success" in table
    assert table[-2:] == [f"wrote new/folder/pad.{kind}" for kind in ("nc", "png")]
    assert set(tree(tmp_path)) == {"pad.cir", "new", "new/folder", "new/folder/pad.nc", "new/folder/pad.png"}
    with xarray.open_dataset("new/folder/pad.nc") as data:
        xarray.testing.assert_identical(data.load(), expected.to_xarray())
    assert Path("new/folder/pad.png").read_bytes().startswith(b"\x89PNG\r\n")


def test_json_is_all_that_is_printed_and_null_stands_for_no_number(command: Command) -> None:
    report = figures(command("run", "pad.cir", "--json", "--no-plot", "--csv"))
    solution = fs.simulate(fs.read_netlist("pad.cir"))
    assert (report["success"], report["tier"]) == (True, "coupled")
    assert row(report, "u_gap")["amplitude"] == solution.summary()["u_gap_amplitude"]
    assert report["files"] == ["out/pad.csv"]
    assert set(tree(Path())) == {"pad.cir", *OUT, "out/pad.csv"}
    frozen = figures(command("ac", "pad.cir", "--area", "frozen", "--source", "DC 5", "--json", "--no-plot"))
    (sweep,) = frozen["sweeps"]
    assert sweep["amplitude"] is None
    assert sweep["u_gap"][0] is None
    assert sweep["gain"][0] > 0.0


def test_options_are_those_of_the_interface_and_values_change_all_at_once_in_any_case(command: Command) -> None:
    # Either exponent alone would be out of range on its way.
    changes = ["--set", "Xgap.m_exp=1.5", "--set", "xgap.N_EXP = 1.9", "--set", "Xcoat.r=inf"]
    words = ["--source", "PULSE(-150 150 0 0 0 2m 10m)", "--area", "30u", "--method", "radau"]
    words += ["--charge-law", "mobile", "--rtol", "1e-6", "--json", "--no-plot"]
    report = figures(command("run", "pad.cir", *changes, *words))
    circuit = fs.read_netlist("pad.cir").replace({"Xgap.m_exp": 1.5, "Xgap.n_exp": 1.9, "Xcoat.r": float("inf")})
    circuit = circuit.replace({"Vdrive": fs.Pulse(-150, 150, 0, 0, 0, 2e-3, 0.01)})
    solution = fs.simulate(circuit, area=30e-6, method="radau", charge_law="mobile", rtol=1e-6)
    assert row(report, "u_gap")["max"] == solution.summary()["u_gap_max"]
    assert row(report, "f_el")["mean"] == solution.summary()["f_el_mean"]
    with xarray.open_dataset("out/pad.nc") as data:
        assert json.loads(data.attrs["overrides"])["Xgap.m_exp"] == "1.5"
        used = {key: data.attrs[key] for key in ("method", "charge_law", "rtol", "area")}
    assert used == {"method": "radau", "charge_law": "mobile", "rtol": "1e-06", "area": "3e-05 m^2"}


def test_a_deck_without_gap_prints_its_layers_and_no_forces(command: Command) -> None:
    Path("flat.cir").write_text(
        "t\nV1 a 0 SIN(0 10 100)\nXcoat a 0 area LAYER d=1u eps_r=2 r=1k\nVarea area 0 35\n.tran 100u 20m uic\n"
    )
    result = command("run", "flat.cir", "--no-plot").ok()
    assert re.search(r"^Xcoat voltage +-10 V +10 V", result.out, re.MULTILINE)
    assert "force " not in result.out
    assert "gap voltage" not in result.out
    assert "no GAP, no forces" in result.out


def test_a_solve_that_fails_keeps_what_it_has_and_says_when_and_how_close(command: Command) -> None:
    words = ["run", "pad.cir", "--charge-law", "mobile", "--set", "Xgap.d=10n", "--no-plot"]
    result = command(*words, "--json")
    assert result.code == 1
    report = json.loads(result.out)
    assert report["success"] is False
    assert report["status"] == "FOLD"
    (line,) = result.lines
    said = re.fullmatch(
        r"fingerspice: stopped at t = (\S+) s: the mobile charge law .* use less voltage, more load, or the local law "
        r"\(at Xgap, just before: (\S+) V across the gap, area \S+ mm\^2, distance to the fold \S+\)",
        line,
    )
    assert said
    with xarray.open_dataset("out/pad.nc") as data:
        assert data.attrs["status"] == "FOLD"
        assert float(data.time[-1]) == pytest.approx(float(said[1]), rel=1e-9)
        assert f"{float(data.u_gap[-1]):.4g}" == said[2]
    keys = ("status", "cause", "action", "t", "step", "element", "u_gap", "area", "fold_margin", "tried")
    assert set(report["failure"]) == set(keys)
    assert set(report["failure"]["tried"][0]) == {"t", "step", "error"}
    plain = command(*words).out
    assert f"status: {report['message']}" in plain
    assert "last steps tried:" in plain


@pytest.mark.parametrize("name", ["run", "compare"])
def test_a_skin_at_another_frequency_or_too_much_voltage_is_warned_about_once(command: Command, name: str) -> None:
    result = command(name, "pad.cir", "--no-plot", "--set", "Xskin.f=200").ok()
    (line,) = result.lines
    assert line.startswith(
        "fingerspice: warning: Xskin takes its data at f = 200 Hz, the source's fundamental is 100 Hz"
    )
    assert line.endswith("Xskin.f=100 would match")
    assert not command(name, "pad.cir", "--no-plot", "--name", "matched").lines
    if name == "run":
        (line,) = command("run", "pad.cir", "--no-plot", "--set", "Vdrive.amplitude=500", "--overwrite").lines
        assert re.search(r"warning: the gap voltage reaches \d+(\.\d+)? V; air breaks down above about 300 V", line)


def test_what_the_reader_notices_is_printed_once_with_its_line(command: Command) -> None:
    lines = ".nodeset v(area)=35\n.backanno\n.plot tran v(top)\n.options reltol=1e-4 trtol=7\n.end"
    Path("pad.cir").write_text(edited(QUICK, ("r=1meg", "r=1MOhm"), (".end", lines)))
    result = command("ac", "pad.cir", "--no-plot", "--sweep", "lin 2 100 200")
    first, second = (line for line in result.lines if "note" not in line)
    assert "note: .options reltol, trtol: of no effect here, where rtol alone sets the error" in result.err
    assert first.startswith("fingerspice: warning: pad.cir:5:41: Xgap r: '1MOhm' is milli (0.001 ohm)")
    assert second == "fingerspice: warning: .plot has no effect here"
    for words in (["run"], ["run", "--stream", "--stop", "50m"], ["plan"]):
        again = command(*words, "pad.cir", "--json", *(["--no-plot"] if words != ["plan"] else []))
        assert again.err.count("of no effect here") == 1, words
        assert json.loads(again.out)["warnings"].count(result.err.partition("note: ")[2].partition("\n")[0]) == 1


def test_values_on_the_command_line_have_the_traps_of_the_deck(command: Command) -> None:
    words = ["ac", "pad.cir", "--no-plot", "--sweep", "lin 2 100 200", "--overwrite"]
    (line,) = command(*words, "--set", "Xcoat.r=0.2M").lines
    assert line.startswith("fingerspice: warning: Xcoat.r: '0.2M' is milli (0.0002 ohm)")
    first, *rest = command(*words, "--area", "35").lines
    assert first.startswith("fingerspice: warning: --area 35 is in m^2, 3.5e+07 mm^2")
    assert rest[-1].startswith("fingerspice: warning: the contact area reaches 35 m^2, over 0.001 m^2 (10 cm^2,")
    assert not command(*words, "--area", "35u").lines


def test_ac_sweeps_the_decks_line_or_the_one_given(command: Command) -> None:
    Path("pad.cir").write_text(edited((".end", ".ac dec 2 10 1k\n.end")))
    command("ac", "pad.cir").ok()
    assert set(tree(Path())) == {"pad.cir", *OUT, "out/pad_ac.csv", "out/pad_ac.png"}
    with Path("out/pad_ac.csv").open(newline="") as stream:
        head, *body = csv.reader(stream)
    assert head[:5] == ["frequency [Hz]", "gain [1]", "phase_deg [deg]", "u_gap [V]", "area [m^2]"]
    assert head[5:] == ["f_el_mean [N]", "amplitude [V]", "impedance [ohm]", "impedance_phase_deg [deg]"]
    table = np.array(body, float)
    np.testing.assert_allclose(table[:, 0], 10.0 ** np.arange(1.0, 3.01, 0.5), rtol=1e-12)
    expected = fs.phasor(fs.read_netlist("pad.cir"), table[:, 0])
    np.testing.assert_array_equal(table[:, 5], expected.f_el_mean)
    np.testing.assert_array_equal(table[:, 7], np.abs(expected.impedance))
    given = figures(command("ac", "pad.cir", "--sweep", "LIN 3 100 300", "--area", "frozen", "--json", "--no-plot"))
    assert given["sweeps"][0]["frequency"] == [100.0, 200.0, 300.0]
    assert given["files"] == ["out/pad_ac.csv"]


def test_compare_sets_the_transient_beside_the_phasor(command: Command) -> None:
    # Also of a deck that has no .tran line: a period needs none.
    Path("pad.cir").write_text(edited((".tran 10u 50m uic", "*")))
    result = command("compare", "pad.cir", "--rtol", "1e-7").ok()
    assert "gap voltage amplitude [V]" in result.out
    assert "-0.00 %" not in result.out
    assert set(tree(Path())) == {"pad.cir", *OUT, "out/pad_compare.png"}
    report = figures(command("compare", "pad.cir", "--json", "--no-plot"))
    assert report["transient_mean_area"]["f_el_mean"] == pytest.approx(report["phasor"]["f_el_mean"], rel=1e-5)
    assert report["transient_coupled"]["f_el_mean"] < 0.99 * report["phasor"]["f_el_mean"]


def test_export_writes_one_deck_with_the_changes_in_it(command: Command) -> None:
    result = command("export", "pad.cir", "-o", "sub/x.cir", "--set", "Xgap.d=4u", "--source", "SIN(0 50 70)")
    assert (result.code, result.out) == (0, "wrote sub/x.cir\n")
    text = Path("sub/x.cir").read_text()
    assert "d=4e-06" in text
    assert "SIN(0.0 50.0 70.0 0.0 0.0 0.0)" in text
    assert "fingerspice.lib - layers" in text
    assert "mobile - " not in text
    assert command("export", "pad.cir", "-o", "sub/y.cir", "--charge-law", "mobile").code == 0
    assert "* fingerspice_mobile.lib - " in Path("sub/y.cir").read_text()


NAMES = "run ac compare export figures explore sets help-deck check warm"


@pytest.mark.parametrize("name", NAMES.split())
def test_help_of_every_command_shows_an_example(command: Command, name: str) -> None:
    for flag in ("--help", "-h"):
        result = command(name, flag).ok()
        assert f"fingerspice {name} " in result.out.partition("Example")[2]
    assert command("--version") == Result(0, f"fingerspice {fs.__version__}\n", "")


def test_help_deck_lists_every_registry(command: Command) -> None:
    text, kinds = command("help-deck").out, json.loads(command("help-deck", "--json").out)["vocabulary"]
    rows = {tuple(re.findall(r"[\w]+", row)): row for row in kinds["elements and devices"]}
    for device in DEVICES.values():
        (words,) = (words for words in rows if device.name in words)
        assert {p.name for p in device.parameters if device.cells} <= set(words)
        assert device.what in rows[words]
    for known in (DIRECTIVES, FUNCTIONS, LAWS, *kinds.values()):
        assert all(word in text for word in known)
    assert "PULSE(V1 V2 TD TR TF PW PER)" in kinds["sources"]


def test_ac_with_the_area_coupled_sweeps_amplitudes_too(command: Command) -> None:
    Path("pad.cir").write_text(edited())
    result = command(
        "ac", "pad.cir", "--area", "coupled", "--sweep", "LIN 2 100 5000", "--amplitude", "1", "--amplitude", "200",
        "--json",
    )  # fmt: skip
    assert result.code == 0, result.err
    low, high = figures(result)["sweeps"]
    assert (low["amplitude"], high["amplitude"]) == (1.0, 200.0)
    # A small signal has the frozen area's gain; a large one its mean force, less than the phasor's by the ripple.
    frozen = fs.phasor(fs.read_netlist("pad.cir"), [100.0, 5000.0], area="frozen")
    np.testing.assert_allclose(low["gain"], np.abs(frozen.gain), rtol=1e-3)
    np.testing.assert_allclose(high["f_el_mean"], [0.1090, 0.1833], rtol=1e-3)
    assert set(tree(Path())) == {"pad.cir", *OUT, "out/pad_ac.csv", "out/pad_ac.png"}


def test_plan_says_which_model_and_why(command: Command) -> None:
    Path("pad.cir").write_text(edited())
    assert "model: coupled" in command("plan", "pad.cir").out
    frozen = figures(command("plan", "pad.cir", "--area", "frozen", "--json"))
    assert frozen["tier"] == "linear"
    assert frozen["reasons"]
    assert set(tree(Path())) == {"pad.cir"}


def test_stop_and_start_are_those_of_the_interface(command: Command) -> None:
    report = figures(command("run", "pad.cir", "--stop", "10m", "--start", "periodic", "--json", "--no-plot"))
    solution = fs.simulate(fs.read_netlist("pad.cir"), t_stop=0.01, start="periodic")
    assert row(report, "f_el")["mean"] == solution.summary()["f_el_mean"]
    # The run itself begins at 0.
    late = fs.parse_netlist(edited((".tran 10u 50m uic", ".tran 50u 18m 12m uic")))
    report = figures(command("run", "pad.cir", "--stop", "18m", "--start", "12m", "--json", "--no-plot", "--csv"))
    assert row(report, "f_el")["mean"] == pytest.approx(fs.simulate(late).f_el_mean, rel=1e-6)
    # A deck without .tran needs no more than an end.
    Path("endless.cir").write_text(edited((".tran 10u 50m uic", "*")))
    assert figures(command("run", "endless.cir", "--stop", "10m", "--json", "--no-plot"))["t_stop"] == 0.01
    assert figures(command("plan", "endless.cir", "--stop", "10m", "--json"))["tier"] == "coupled"


def test_each_of_several_sources_is_replaced_by_its_name(command: Command) -> None:
    text = edited(QUICK, ("Vdrive drive 0", "Vbias drive b DC 5\nVdrive b 0"))
    Path("pad.cir").write_text(text)
    words = ["run", "pad.cir", "--json", "--no-plot"]
    both = command(*words, "--source", "Vdrive=SQUARE(100 100)", "--source", "vbias = DC 7")
    assert row(figures(both), "u_source")["max"] == 107.0
    one = command(*words, "--source", "Vdrive=SQUARE(100 100)", "--name", "one")
    assert row(figures(one), "u_source")["max"] == 105.0
    assert one.lines == [
        "fingerspice: warning: sources names Vdrive only: Vbias stays on, as in the deck; 0 would switch it off"
    ]
    none = command(*words, "--source", "SQUARE(100 100)", "--name", "none").refused()
    assert "the circuit has Vbias, Vdrive; allowed: NAME=SPEC with one of these names" in none.err


def test_a_store_that_another_process_writes_is_refused(command: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("zarr")
    words, busy = (
        ("run", "pad.cir", "--stream", "--chunk", "10m"),
        "another process writes out/pad.zarr; allowed: to wait",
    )
    assert command(*words).code == 0
    before = tree(Path("out"))
    number = os.open("out/pad.zarr", os.O_RDONLY)
    fcntl.flock(number, fcntl.LOCK_EX)
    for more in ((), ("--overwrite",)):
        done = command(*words, *more)
        assert (done.code, done.out) == (2, "")
        assert busy in done.lines[-1]
    os.close(number)
    assert command(*words).code == 0
    shutil.move("out/pad.zarr", "pad.zarr")
    held = []

    def another(folder: Path) -> None:
        number = os.open("out/pad.zarr", os.O_RDONLY)
        with contextlib.suppress(BlockingIOError):
            fcntl.flock(number, fcntl.LOCK_EX | fcntl.LOCK_NB)
            held.append(folder)
        os.close(number)

    # A new store, too, is held by the process that writes it.
    monkeypatch.setattr("fingerspice.cli.store.settle_on_disk", another)
    assert command(*words).code == 0
    assert held == []
    shutil.rmtree("out/pad.zarr")

    def late(*given: object) -> None:
        # Another process is faster: it has created its store since this one began.
        shutil.copytree("pad.zarr", "out/pad.zarr")
        create(*given)  # type: ignore[arg-type]

    monkeypatch.setattr("fingerspice.results.runfile.create", late)
    done = command(*words)
    assert (done.code, done.out) == (2, "")
    assert busy in done.lines[-1]
    assert tree(Path("out")) == before


def test_a_deck_from_standard_input_runs_as_that_in_a_file(command: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    Path("part.inc").write_text(Path("pad.cir").read_text().partition("\n")[2].replace(".end\n", ""))
    deck = io.TextIOWrapper(io.BytesIO(b"Fingerpad\n.include part.inc\n.end\n"))
    monkeypatch.setattr(sys, "stdin", deck)
    report = figures(command("run", "-", "--json", "--no-plot"))
    assert report["files"] == ["out/stdin.nc"]
    assert row(report, "u_gap") == row(figures(command("run", "pad.cir", "--json", "--no-plot")), "u_gap")


def test_a_deck_from_a_pipe_runs_and_one_without_end_or_text_is_refused(command: Command) -> None:
    os.mkfifo("pipe")
    writer = threading.Thread(target=lambda: Path("pipe").write_bytes(Path("pad.cir").read_bytes()))
    writer.start()
    assert command("plan", "pipe").code == 0
    writer.join()
    for path, message in (("/dev/zero", "'/dev/zero' is larger than 64 MiB"), ("/dev/null", "'stdin' is empty")):
        command("run", path).refused(message)


def test_ac_without_a_gap_writes_the_node_voltages(command: Command) -> None:
    Path("rc.cir").write_text("RC\nV1 in 0 DC 0 AC 1\nR1 in out 1k\nC1 out 0 1u\n.ac dec 1 10 1k\n.end\n")
    (sweep,) = figures(command("ac", "rc.cir", "--json"))["sweeps"]
    expected = [1.0 / abs(1.0 + 2j * math.pi * f * 1e-3) for f in (10.0, 100.0, 1000.0)]
    assert sweep["v:out"] == pytest.approx(expected, rel=1e-12)
    assert "f_el_mean" not in sweep
    head = Path("out/rc_ac.csv").read_text().splitlines()[0]
    assert head.startswith(
        "frequency [Hz],v:in [V],phase_deg:in [deg],v:out [V],phase_deg:out [deg],amplitude [V],impedance"
    )


DOCUMENT = (Path(__file__).parents[1] / "docs" / "json.md").read_text()
FLAT = "t\nV1 a 0 SIN(0 10 100)\nXcoat a 0 area LAYER d=1u eps_r=2 r=1k\nVarea area 0 35\n.tran 100u 20m uic\n"
RC = "t\nV1 a 0 SIN(0 10 100)\nR1 a b 1k\nC1 b 0 1u\n.tran 100u 20m uic\n"


def answer(result: Result, command: str) -> Any:
    data = json.loads(result.out)
    assert set(data) == {*COMMON, *OWN[command]}
    assert data["command"] == command
    assert data["version"] == fs.__version__
    assert data["success"] is (result.code == 0)
    assert (data["status"] == "SUCCESS") is data["success"]
    assert isinstance(data["message"], str)
    assert (data["failure"] is not None) is (result.code == 1)
    for kind in ("warnings", "files"):
        assert isinstance(data[kind], list)
    return data


@pytest.mark.parametrize(("line", "code"), listed("json"))
def test_the_keys_are_the_same_however_a_command_ends(command: Command, line: str, code: int) -> None:
    Path("flat.cir").write_text(FLAT)
    Path("rc.cir").write_text(RC)
    Path("two_fingers.cir").write_text((CIRCUITS / "two_fingers.cir").read_text())
    words = shlex.split(line)
    result = command(*words, "--json")
    assert result.code == code
    if words[0] == "rnu":
        data = json.loads(result.out)
        assert (set(data), data["command"]) == (set(COMMON), None)
        assert data["message"].startswith("No such command 'rnu'")
    else:
        data = answer(result, words[0])
    assert all(Path(file).is_file() for file in data["files"])
    if code == 2:
        assert data["status"] == "BAD_INPUT"
        assert data["files"] == []


def test_an_answer_says_what_was_asked_changed_and_warned_of(command: Command) -> None:
    words = ["--set", "Xskin.f=200", "--source", "SQUARE(100 100)", "--charge-law", "mobile", "--rtol", "1e-6"]
    data = answer(command("run", "pad.cir", "--no-plot", "--json", *words), "run")
    assert (data["title"], data["charge_law"], data["method"], data["rtol"]) == (
        *("Fingerpad", "mobile", "exponential", 1e-6),
    )
    assert set(data["overrides"]) == {"Xskin.f", "Vdrive"}
    (said,) = data["warnings"]
    assert said.endswith("Xskin.f=100 would match")


def test_the_rows_are_the_figures_of_the_summary_by_element(command: Command) -> None:
    data = answer(command("run", str(CIRCUITS / "two_fingers.cir"), "--json", "--no-plot"), "run")
    solution = fs.simulate(shipped("two_fingers"))
    rows = {(row["signal"], row["element"]): row for row in data["signals"]}
    assert {element for signal, element in rows if signal == "f_el"} == set(solution.gaps)
    for i, name in enumerate(solution.gaps):
        assert rows["f_el", name]["mean"] == solution.summary()[f"f_el:{name}_mean"]
        assert rows["u_gap", name]["max"] >= solution.u_gap[:, i].max()  # type: ignore[index]
    for row in data["signals"]:
        assert set(row) == {"signal", "element", "unit", *FIGURES}
    pad = answer(command("run", "pad.cir", "--json", "--no-plot"), "run")
    assert [row["element"] for row in pad["signals"] if row["signal"] == "f_el"] == ["Xgap"]


def test_every_key_is_documented() -> None:
    for key in {*COMMON, *(key for keys in OWN.values() for key in keys), *FIGURES}:
        assert f"`{key}`" in DOCUMENT, key


def test_nothing_but_json_is_printed_with_stderr_closed_too(tmp_path: Path) -> None:
    (tmp_path / "pad.cir").write_text(edited((".end", ".meas tran top max v(top)\n.end")))
    for words, code in (
        ("run pad.cir --no-plot --charge-law mobile --set Xgap.d=10n --set Xskin.f=200 --json 0<&- 2>&-", 1),
        ("plan pad.cir --set Xskin.f=200 --json 2>&-", 0),
        ("run none.cir --json 2>&-", 2),
    ):
        line = f"{shlex.quote(sys.executable)} -m fingerspice {words}"
        done = subprocess.run(["sh", "-c", line], cwd=tmp_path, capture_output=True, text=True, timeout=60)
        assert (done.returncode, done.stderr) == (code, "")
        assert json.loads(done.stdout)["success"] is (code == 0)


# The folder and the names of results, and what is never replaced without a message -----------------------------


QUIET = ("run", "pad.cir", "--no-plot")


def test_results_stand_in_a_folder_that_git_ignores_unless_it_is_there_or_named(command: Command) -> None:
    assert command(*QUIET).code == 0
    assert {p for p in tree(Path()) if p != "pad.cir"} == {"out", "out/.gitignore", "out/pad.nc"}
    assert Path("out/.gitignore").read_text() == "*\n"
    Path("out/.gitignore").unlink()
    for words in ((), ("--out", "mine")):
        assert command(*QUIET, *words).code == 0
    assert not list(Path().rglob(".gitignore"))


def test_files_take_the_name_given(command: Command) -> None:
    assert command("run", "pad.cir", "--name", "thin gap").code == 0
    for name in ("pad.v1", "pad.v2"):
        Path(f"{name}.cir").write_text(Path("pad.cir").read_text())
        assert command("run", f"{name}.cir", "--no-plot").code == 0
    assert {"out/thin gap.nc", "out/thin gap.png", "out/pad.v1.nc", "out/pad.v2.nc"} <= set(tree(Path()))
    for name in ("a/b", "..", "", "../x", "a\nb"):
        result = command(*QUIET, "--name", name).refused()
        assert "allowed: a file's name" in result.lines[0]


def test_the_result_of_another_circuit_is_not_replaced(command: Command) -> None:
    assert command(*QUIET, "--set", "Xgap.d=5u").code == 0
    before = tree(Path())
    for words, said in (
        ((), "out/pad.nc holds a result with Xgap.d=5u, and this one is of the deck as it is; allowed"),
        (("--set", "Xgap.d=6u"), "with Xgap.d=5u, and this one is with Xgap.d=6u"),
        (("--set", "Xgap.d=5u", "--charge-law", "mobile"), "under the local law, and this one is under the mobile law"),
    ):
        result = command(*QUIET, *words).refused()
        assert said in result.lines[0]
        assert result.lines[0].endswith("allowed: --name NAME, another --out, or --overwrite")
        assert tree(Path()) == before
    # What is wrong with the request itself comes first.
    wrong = command(*QUIET, "--charge-law", "mobil")
    assert wrong.lines == ["fingerspice: charge_law is 'mobil'; allowed: 'local' or 'mobile'"]
    assert command(*QUIET, "--set", "Xgap.d=5u").code == 0
    assert command(*QUIET, "--overwrite").code == 0
    assert fs.load("out/pad.nc").circuit.overrides == {}


def test_another_deck_of_the_same_name_is_another_circuit(command: Command) -> None:
    assert command(*QUIET).code == 0
    Path("else").mkdir()
    Path("else/pad.cir").write_text(edited(("d=3.5u", "d=4u")))
    result = command("run", "else/pad.cir", "--no-plot").refused()
    assert "holds a result of the deck pad.cir, and this one is of else/pad.cir" in result.lines[0]


def test_a_deck_that_was_edited_replaces_its_own_results_and_says_so(command: Command) -> None:
    assert command("run", "pad.cir").code == 0
    assert not command("run", "pad.cir").lines
    Path("pad.cir").write_text(edited(("d=3.5u", "d=4u"), (".tran 10u 50m uic", ".tran 50u 20m uic")))
    result = command("run", "pad.cir").ok()
    (line,) = result.lines
    assert line == "fingerspice: note: the results in out are of an earlier text of pad.cir and are replaced"


@pytest.mark.parametrize("name", ["pad.nc", "pad.png"])
def test_a_file_that_nothing_is_known_of_is_left_alone(command: Command, name: str) -> None:
    Path("out").mkdir()
    Path("out", name).write_bytes(b"my own")
    result = command("run", "pad.cir").refused()
    assert "nothing says which circuit it is of" in result.lines[0]
    assert Path("out", name).read_bytes() == b"my own"


def test_a_table_is_known_by_the_picture_beside_it(command: Command) -> None:
    words = ("ac", "pad.cir", "--sweep", "lin 2 100 200")
    assert command(*words).code == 0
    assert not command(*words).lines
    assert command(*words, "--set", "Xgap.d=5u").code == 2
    Path("out/pad_ac.png").unlink()
    result = command(*words, "--no-plot", "--set", "Xgap.d=5u").ok()
    assert "note: out/pad_ac.csv is replaced" in result.lines[0]
    Path("out/pad.csv").write_text("time,mine\n")
    assert command(*QUIET, "--csv").code == 2
    assert Path("out/pad.csv").read_text() == "time,mine\n"


def test_reports_pictures_and_files_say_what_was_changed(command: Command) -> None:
    words = ("--set", "Xgap.d=5u", "--source", "SQUARE(200 100)")
    said = "Fingerpad (changed: Xgap.d = 5 um, Vdrive = Square(200 V, 100 Hz))"
    assert command("run", "pad.cir", *words).out.splitlines()[0] == said
    with Image.open("out/pad.png") as image:
        image.load()
        assert json.loads(image.text["overrides"])["Xgap.d"] == "5u"  # type: ignore[attr-defined]
    for name in ("run", "ac", "plan", "compare"):
        files = () if name == "plan" else ("--name", "plain", "--rtol", "1e-4", "--no-plot")
        assert command(name, "pad.cir", *words, *files).out.startswith(said)
        report = json.loads(command(name, "pad.cir", *words, *files, "--json").out)
        assert report["title"] == "Fingerpad"
        assert report["overrides"]["Xgap.d"] == "5u"
        assert report["overrides"]["Vdrive"].startswith("Square(")
