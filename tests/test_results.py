"""Folder and names of a command's results, and files that are never replaced without a message."""

import json
from pathlib import Path

import pytest
from PIL import Image

import fingerspice as fs
from commands import Command, tree
from deck_edits import edited

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
        result = command(*QUIET, "--name", name)
        assert result.code == 2
        assert "allowed: a file's name" in result.lines[0]


def test_the_result_of_another_circuit_is_not_replaced(command: Command) -> None:
    assert command(*QUIET, "--set", "Xgap.d=5u").code == 0
    before = tree(Path())
    for words, said in (
        ((), "out/pad.nc holds a result with Xgap.d=5u, and this one is of the deck as it is; allowed"),
        (("--set", "Xgap.d=6u"), "with Xgap.d=5u, and this one is with Xgap.d=6u"),
        (("--set", "Xgap.d=5u", "--charge-law", "mobile"), "under the local law, and this one is under the mobile law"),
    ):
        result = command(*QUIET, *words)
        assert result.code == 2
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
    result = command("run", "else/pad.cir", "--no-plot")
    assert result.code == 2
    assert "holds a result of the deck pad.cir, and this one is of else/pad.cir" in result.lines[0]


def test_a_deck_that_was_edited_replaces_its_own_results_and_says_so(command: Command) -> None:
    assert command("run", "pad.cir").code == 0
    assert not command("run", "pad.cir").lines
    Path("pad.cir").write_text(edited(("d=3.5u", "d=4u"), (".tran 10u 50m uic", ".tran 50u 20m uic")))
    result = command("run", "pad.cir")
    assert result.code == 0
    (line,) = result.lines
    assert line == "fingerspice: note: the results in out are of an earlier text of pad.cir and are replaced"


@pytest.mark.parametrize("name", ["pad.nc", "pad.png"])
def test_a_file_that_nothing_is_known_of_is_left_alone(command: Command, name: str) -> None:
    Path("out").mkdir()
    Path("out", name).write_bytes(b"my own")
    result = command("run", "pad.cir")
    assert result.code == 2
    assert "nothing says which circuit it is of" in result.lines[0]
    assert Path("out", name).read_bytes() == b"my own"


def test_a_table_is_known_by_the_picture_beside_it(command: Command) -> None:
    words = ("ac", "pad.cir", "--sweep", "lin 2 100 200")
    assert command(*words).code == 0
    assert not command(*words).lines
    assert command(*words, "--set", "Xgap.d=5u").code == 2
    Path("out/pad_ac.png").unlink()
    result = command(*words, "--no-plot", "--set", "Xgap.d=5u")
    assert result.code == 0
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
