"""`docs/netlist.md`: its decks and commands run, its numbers are right, and it lists all that a deck may contain."""

import math
import re
import warnings
import wave
from pathlib import Path

import numpy as np
import pytest

import fingerspice as fs
from fingerspice.base.units import SCALES, parse_number, spice_text
from fingerspice.circuit.devices import DEVICES, ParameterSpec
from fingerspice.circuit.devices import SOURCES as USUAL_OF_SOURCES
from fingerspice.netlist.reader import DIRECTIVES, ELSEWHERE
from fingerspice.netlist.sources import SOURCES
from ngspice_tools import CIRCUITS, run_ngspice

PAGE = (CIRCUITS.parent / "docs" / "netlist.md").read_text(encoding="utf-8")
EPS0 = 8.8541878128e-12


def blocks(language: str) -> list[str]:
    """The page's code blocks of a language."""
    return re.findall(rf"^```{language}\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)


def rows(heading: str) -> list[list[str]]:
    """Cells of the table whose first column has that heading."""
    table = PAGE.split(f"\n| {heading} | ", 1)[1].split("\n\n", 1)[0]
    return [[cell.strip() for cell in line.strip("| ").split(" | ")] for line in table.split("\n")[2:]]


FINGER, FILM, TWO_FINGERS, CREEP, LTSPICE = DECKS = blocks("spice")


def run(text: str) -> fs.Solution:
    """The run of a deck, which nothing is to be warned about."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        solution = fs.simulate(fs.parse_netlist(text))
    assert solution.success
    return solution


def area_at_rest(load: float) -> float:
    """The page's formula for the area at 0 V, m^2, with Table 1's contact."""
    unloaded = 54.4 * load**0.52
    return 1e-6 * (unloaded - 5000.0 * (0.3 * load) ** 2 / unloaded)


def test_the_finger_has_the_area_that_the_page_states() -> None:
    # Every code block is a deck or commands.
    assert PAGE.count("```") == 2 * (len(DECKS) + len(blocks("sh")))
    assert all(deck.endswith("\n.end\n") for deck in DECKS)
    solution = run(FINGER)
    assert solution.area[0] == pytest.approx(area_at_rest(0.5), rel=1e-12)
    assert f"{1e6 * solution.area[0]:.2f} mm²" in " ".join(PAGE.split())


def test_a_current_charges_the_film_by_its_capacitance() -> None:
    solution = run(FILM)
    slope = 1e-6 / (EPS0 * 3.0 * 35e-6 / 10e-6)
    np.testing.assert_allclose(solution.node_voltages["top"], slope * solution.t, rtol=0, atol=1e-4 * slope * 1e-3)


def test_two_fingers_have_an_area_and_parameters_each() -> None:
    solution = run(TWO_FINGERS)
    np.testing.assert_allclose(solution.area[0], [area_at_rest(0.5), area_at_rest(0.2)], rtol=1e-12)
    values = {path: p.value for path, p in solution.circuit.parameters.items()}
    assert (values["Xfirm.Xgap.r"], values["Xlight.Xgap.r"]) == (1e6, 2e6)
    assert values["Xfirm.Xcoat.r"] == values["Xlight.Xcoat.r"] == 2e5
    assert {"Xlight.Xgap.fn", "Xlight.Xgap.tau"} <= values.keys()
    assert "Xlight.top" in solution.node_voltages


def test_the_area_creeps_with_its_time_constant() -> None:
    solution = run(CREEP)
    # Resistances of 0.2 and 1 megohm share 100 V at rest.
    np.testing.assert_allclose(solution.u_gap, 100.0 / 1.2, rtol=1e-9)
    start, later, last = np.interp([0.0, 2e-3, 4e-3], solution.t, 1e6 * solution.area)
    assert start == pytest.approx(30.0, rel=1e-12)
    assert (last - later) / (later - start) == pytest.approx(math.exp(-1.0), rel=1e-6)


def test_a_deck_of_ltspice_runs_with_its_parasitics() -> None:
    solution = run(LTSPICE)
    values = {path: p.value for path, p in solution.circuit.parameters.items() if path.startswith(("V1.R", "C1."))}
    assert values == {"V1.Rser.value": 1e3, "C1.value": 150e-12, "C1.Rser.value": 10.0, "C1.Rpar.value": 1e9}
    assert solution.circuit["XU1"].values["d"] == 1e-6
    assert solution.area[0] == pytest.approx(area_at_rest(0.5), rel=1e-12)


@pytest.mark.parametrize("text", [FINGER, FILM, TWO_FINGERS, CREEP], ids=["finger", "film", "two fingers", "creep"])
def test_the_other_decks_run_unchanged_in_ngspice(text: str) -> None:
    ours = run(text)
    nodes = [node for node in ours.node_voltages if "." not in node]
    areas = {e.node_names[2] for e in ours.circuit.elements if e.spec.is_layer and "." not in e.node_names[2]}
    theirs = run_ngspice(text, signals=[f"v({node})" for node in [*nodes, *areas]])
    for node in nodes:
        peak = np.abs(ours.node_voltages[node]).max()
        assert theirs[f"v({node})"][-1] == pytest.approx(ours.node_voltages[node][-1], abs=2e-3 * peak)
    assert {round(theirs[f"v({node})"][-1], 1) for node in areas} == set(np.round(1e6 * np.ravel(ours.area[-1]), 1))


def test_the_table_of_parameters_is_that_of_the_devices() -> None:
    plain = ("m", "V/m", "ohm", "F", "Hz", "s")

    def shown(value: float, spec: ParameterSpec) -> str:
        return spice_text(value) if spec.unit in plain else f"{value:g}"

    expected = {}
    for device, entry in DEVICES.items():
        for spec in entry.parameters:
            default = "required" if spec.default is None else shown(spec.default, spec)
            legal = (">= 0" if spec.may_be_zero else "> 0") + (" or inf" if spec.may_be_infinite else "")
            assert spec.usual is not None
            usual = f"{shown(spec.usual.least, spec)} to {shown(spec.usual.most, spec)}"
            expected[device, f"`{spec.name}`"] = [spec.unit or "1", default, legal, usual]
    table = {(device, row[1]): row[2:6] for row in rows("device") for device in row[0].split(", ")}
    assert table == expected
    assert all(row[6] for row in rows("device"))
    others = {(s.least, s.most) for entry in DEVICES.values() for s in entry.parameters if s.name != "f"}
    frequency = DEVICES["SKIN"].parameter("f")
    assert others == {(1e-30, 1e30)}
    assert (frequency.least, frequency.most) == (parse_number("1m"), parse_number("1g"))


def test_every_device_source_and_directive_is_named() -> None:
    words = set(re.findall(r"[\w.]+", PAGE))
    assert DEVICES.keys() <= words
    assert {name.upper() for name in SOURCES} <= words
    assert {word for word in (*DIRECTIVES, *ELSEWHERE) if word not in words} == set()
    ranges = {unit: (usual.least, usual.most) for unit, usual in USUAL_OF_SOURCES.items()}
    assert ranges == {"V": (0.0, 10e3), "Hz": (10e-3, 10e6)}
    assert "Usual are up to 10 kV, and 10 mHz to 10 MHz." in " ".join(PAGE.split())
    assert {f"`{scale}`" for scale in SCALES if scale != "μ"} <= set(re.findall(r"`[^`]*`", PAGE))


@pytest.mark.parametrize("row", rows("example"), ids=lambda row: row[0])
def test_the_sources_are_read(row: list[str], tmp_path: Path) -> None:
    with wave.open(str(tmp_path / "a.wav"), "wb") as file:
        file.setparams((1, 2, 48000, 0, "NONE", ""))
        file.writeframes(np.arange(100, dtype="<i2").tobytes())
    (tmp_path / "a.csv").write_text("time (ms), drive [kV]\n0, 0\n1, 0.1\n")
    (tmp_path / "a.txt").write_text("0 0\n1m 100\n")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        circuit = fs.parse_netlist(FINGER.replace("SIN(0 200 100)", row[0].strip("`")), tmp_path / "finger.cir")
    assert fs.simulate(circuit, t_stop=2e-3).success


def test_the_page_of_the_house_names_every_package_and_only_files_and_names_that_exist() -> None:
    house = (CIRCUITS.parent / "docs" / "house.md").read_text(encoding="utf-8")
    source = CIRCUITS.parent / "src" / "fingerspice"
    packages = {p.parent.name for p in source.glob("*/__init__.py")}
    assert set(re.findall(r"^\| `(\w+)/` \|", house, re.MULTILINE)) == packages
    for path in re.findall(r"`((?:\w+/)+\w*(?:\.\w+)?)`", house):
        assert (source / path).exists() or (CIRCUITS.parent / path).exists(), path
    # The table's names stand in the files that they are said to stand in.
    for name, path in re.findall(r"`([A-Z_a-z]+)`, `(\w+/\w+\.py)`", house):
        assert re.search(rf"^(class |def )?{name}\b", (source / path).read_text(encoding="utf-8"), re.MULTILINE), name
