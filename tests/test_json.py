"""`--json`: the same keys for every circuit and every outcome of a command, and nothing else on stdout."""

import json
import shlex
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

import fingerspice as fs
from commands import Command, Result
from deck_edits import edited
from fingerspice.cli.terminal import COMMON, FIGURES, OWN
from scenes import CIRCUITS, listed, shipped

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


@pytest.mark.parametrize(
    ("line", "code"),
    listed("json"),
)
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
