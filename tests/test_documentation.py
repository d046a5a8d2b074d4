"""The documentation: its code, decks and commands run, its numbers, names and links are right."""

import contextlib
import importlib
import importlib.util
import io
import math
import os
import re
import shlex
import shutil
import warnings
import wave
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pytest

import fingerspice as fs
from commands import Command
from fingerspice.base.units import SCALES, parse_number, spice_text
from fingerspice.circuit.devices import DEVICES, ParameterSpec
from fingerspice.circuit.devices import SOURCES as USUAL_OF_SOURCES
from fingerspice.explorer.scene import EXAMPLES
from fingerspice.netlist.reader import DIRECTIVES, ELSEWHERE
from fingerspice.netlist.sources import SOURCES
from ngspice_tools import CIRCUITS, beside
from scenes import cases

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGES = sorted({ROOT / "README.md", ROOT / "CHANGELOG.md", *DOCS.rglob("*.md")} - {DOCS / "gallery" / "index.md"})
LANGUAGES = {"python", "sh", "spice", "text", "csv", "toml", "{toctree}"}
NOT_RUN = "<!-- not run:"
"""A comment before a block, with the reason, says that it is not run here."""


@dataclass(frozen=True)
class Block:
    """A fenced block: its language, its text, and the paragraph before it."""

    language: str
    text: str
    before: str


def blocks(text: str) -> list[Block]:
    """The fenced blocks of a page in their order, and its indented commands as blocks of the shell."""
    found: list[Block] = []
    language, inside, before, ended = "", None, "", False
    for line in text.splitlines():
        if line.startswith("```") and inside is None:
            language, inside = line[3:].strip(), []
        elif line.startswith("```") and inside is not None:
            found.append(Block(language, "\n".join(inside) + "\n", before))
            inside, before = None, ""
        elif inside is not None:
            inside.append(line)
        elif line.startswith("    fingerspice "):
            found.append(Block("sh", line.strip() + "\n", before))
        elif line.strip():
            before = f"{'' if ended else before} {line.strip()}".strip()
        ended = not line.strip()
    assert inside is None, "a block has no end"
    return found


def file_of(block: Block) -> str | None:
    """The file as which the paragraph before a block says to save it."""
    name = re.search(r"\b[Ss]ave\b.* as `([\w.]+)`", block.before)
    return name.group(1) if name and block.language in ("spice", "csv", "toml") else None


def commands_of(block: Block) -> list[list[str]]:
    """The arguments of every `fingerspice` command of a block, up to a pipe; without `explore`, which serves a page."""
    lines = re.sub(r"\\\n\s*", " ", block.text).splitlines()
    words = [shlex.split(line, comments=True) for line in lines if line.startswith("fingerspice ")]
    words = [one[1 : one.index("|")] if "|" in one else one[1:] for one in words]
    return [one for one in words if one[0] != "explore"]


def id_of(page: Path) -> str:
    return str(page.relative_to(ROOT))


RUNNING = [p for p in PAGES if any(b.language in ("python", "sh") for b in blocks(p.read_text(encoding="utf-8")))]


@pytest.mark.parametrize("page", RUNNING, ids=id_of)
def test_the_code_of_a_page_runs(page: Path, command: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    os.environ["MPLBACKEND"] = "Agg"
    few = cases({}, {"frequency": [50.0], "means": 3})
    monkeypatch.setattr("fingerspice.studies.limits.capability", partial(fs.capability, **few))
    shutil.copytree(CIRCUITS, tmp_path / "circuits")
    population = tmp_path / "circuits" / "population.toml"
    population.write_text(population.read_text().replace("n = 16384", f"n = {cases(16384, 256)}"))
    names: dict[str, object] = {"__name__": "__main__"}
    printed = ""
    for block in blocks(page.read_text(encoding="utf-8")):
        assert block.language in LANGUAGES, block.text
        if block.before.startswith(NOT_RUN):
            continue
        file = file_of(block)
        if file is not None:
            (tmp_path / file).write_text(block.text, encoding="utf-8")
        if block.language == "python":
            with contextlib.redirect_stdout(io.StringIO()) as out:
                exec(compile(block.text, id_of(page), "exec"), names)
            plt.close("all")
            printed = out.getvalue()
        for arguments in commands_of(block) if block.language == "sh" else []:
            map_of_folds = arguments[0] == "limits" and "--capability" not in arguments
            result = command(*arguments, *(cases([], ["--points", "3"]) if map_of_folds else [])).ok()
            printed = result.out
        if block.language == "text":
            # What a page shows was printed by the block before.
            assert [line for line in block.text.splitlines() if line not in printed] == [], printed


def anchors(text: str) -> set[str]:
    """The targets that a code host makes of a page's headings."""
    text = re.sub(r"^```.*?^```$", "", text, flags=re.MULTILINE | re.DOTALL)
    headings = re.findall(r"^#+ (.+)$", text, re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", h.lower()).strip().replace(" ", "-") for h in headings}


@pytest.mark.parametrize("page", PAGES, ids=id_of)
def test_every_link_of_a_page_leads_to_a_file_and_heading_that_exist(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    prose = re.sub(r"`[^`\n]*`", "", re.sub(r"^```.*?^```$", "", text, flags=re.MULTILINE | re.DOTALL))
    for target in re.findall(r"\]\(([^()\s]+)\)", prose):
        if re.match(r"\w+:", target):
            assert re.fullmatch(r"https://[\w.-]+(/[\w./%#?=&~-]*)?", target), target
            continue
        path, _, anchor = target.partition("#")
        file = (page.parent / path).resolve() if path else page
        assert file.is_relative_to(ROOT), target
        assert file.exists(), target
        if anchor:
            assert anchor in anchors(file.read_text(encoding="utf-8")), target


def test_the_reference_has_every_public_name_and_no_other() -> None:
    pages = "".join(p.read_text(encoding="utf-8") for p in (DOCS / "reference").glob("*.rst"))
    listed = re.findall(r"^\.\. auto(?:function|class|exception):: (\w+)$", pages, re.MULTILINE)
    assert sorted(listed) == sorted(set(fs.__all__) - {"__version__"})


def test_the_gallery_has_every_deck_and_every_scene(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.syspath_prepend(str(DOCS))
    gallery = importlib.import_module("gallery")
    entries = {entry.name: entry for _, entry, _ in gallery.entries()}
    decks, scenes = CIRCUITS.glob("*.cir"), (f"scene-{example['name']}" for example in EXAMPLES)
    assert set(entries) == {*(path.stem for path in decks), *scenes}
    assert all(f"]({name}.png)" in gallery.page() for name in entries)
    assert "where fingers feel best" in entries["click"].about
    for name in ("click", "scene-fold"):
        gallery.draw(entries[name].run, tmp_path / f"{name}.png")
        assert (tmp_path / f"{name}.png").stat().st_size > 10_000
    assert not entries["scene-fold"].run().success


@pytest.mark.parametrize("name", ["texture_recording", "click", "am_bump", "chirp", "burst"])
def test_every_deck_of_a_signal_runs_to_its_end_without_a_warning(name: str, recwarn: pytest.WarningsRecorder) -> None:
    run = fs.simulate(fs.read_netlist(CIRCUITS / f"{name}.cir"), rtol=1e-4)
    assert not recwarn.list
    assert run.warnings == ()
    assert run.t[-1] == run.t_stop
    # It can be felt: a friction that changes by a tenth of itself, well below the breakdown of air.
    assert np.ptp(run.f_t) > 0.1 * run.f_t.min()
    assert np.abs(run.u_gap).max() < 300.0


def test_the_recording_is_what_its_script_makes() -> None:
    spec = importlib.util.spec_from_file_location("texture", CIRCUITS / "texture.py")
    assert spec is not None
    assert spec.loader is not None
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    path = CIRCUITS / "texture.wav"
    shipped = fs.Samples.from_wav(path, 2.0**15)
    assert shipped.rate == script.RATE
    # The sine of another machine may round differently.
    np.testing.assert_allclose(shipped.values, script.texture(), atol=1)
    assert path.stat().st_size < 100_000


def test_the_command_draws_decks_and_scenes(tmp_path: Path, command: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "circuits").mkdir()
    shutil.copy(CIRCUITS / "click.cir", tmp_path / "circuits")
    some = EXAMPLES[:: cases(1, 7)]
    monkeypatch.setattr("fingerspice.explorer.scene.EXAMPLES", some)
    result = command("figures", "--gallery", "--out", "out").ok()
    drawn = {path.stem for path in (tmp_path / "out" / "gallery").glob("*.png")}
    assert drawn == {"click", *(f"scene-{one['name']}" for one in some)}
    assert all(name in result.out for name in drawn)
    command("figures", "--gallery", "--only", "4").refused("--only and --gallery are both given")


def test_every_picture_of_a_page_can_be_drawn_and_is_shown(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.syspath_prepend(str(DOCS))
    pictures = importlib.import_module("pictures")
    monkeypatch.setattr(pictures, "FOLDER", tmp_path / "pictures")
    monkeypatch.setattr("sys.argv", ["pictures.py"])
    pictures.main()
    drawn = {path.name for path in (tmp_path / "pictures").iterdir()}
    assert drawn == {path.name for path in (DOCS / "pictures").iterdir()}
    text = "".join(page.read_text(encoding="utf-8") for page in PAGES)
    assert all(f"pictures/{name})" in text for name in drawn)


def test_the_times_of_the_readme_are_those_of_the_measured_table() -> None:
    front = (ROOT / "README.md").read_text(encoding="utf-8").split("## How right and how fast")[1]
    measured = (DOCS / "proof.md").read_text(encoding="utf-8").split("## What a user waits for")[1]
    times = re.findall(r"\| ([\d.]+) (s|ms|ns)\b", front)
    assert len(times) == 3
    for number, unit in times:
        assert re.search(rf"[|/] {number}(?: /[^|]*)? {unit} \|", measured), (number, unit)


PAGE = (CIRCUITS.parent / "docs" / "netlist.md").read_text(encoding="utf-8")
EPS0 = 8.8541878128e-12


def blocks_of(language: str) -> list[str]:
    """The code blocks of the netlist's page of a language."""
    return re.findall(rf"^```{language}\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)


def rows(heading: str) -> list[list[str]]:
    """Cells of the table whose first column has that heading."""
    table = PAGE.split(f"\n| {heading} | ", 1)[1].split("\n\n", 1)[0]
    return [[cell.strip() for cell in line.strip("| ").split(" | ")] for line in table.split("\n")[2:]]


FINGER, FILM, AMPLIFIER, TWO_FINGERS, CREEP, LTSPICE = DECKS = blocks_of("spice")


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
    assert PAGE.count("```") == 2 * (len(DECKS) + len(blocks_of("sh")))
    assert all(deck.endswith("\n.end\n") for deck in DECKS)
    solution = run(FINGER)
    assert solution.area[0] == pytest.approx(area_at_rest(0.5), rel=1e-12)
    assert f"{1e6 * solution.area[0]:.2f} mm²" in " ".join(PAGE.split())


def test_a_current_charges_the_film_by_its_capacitance() -> None:
    solution = run(FILM)
    slope = 1e-6 / (EPS0 * 3.0 * 35e-6 / 10e-6)
    np.testing.assert_allclose(solution.node_voltages["top"], slope * solution.t, rtol=0, atol=1e-4 * slope * 1e-3)


def test_the_amplifier_and_its_transformer_have_their_gains() -> None:
    solution = run(AMPLIFIER)
    peaks = {node: float(np.abs(v[solution.t > 2e-3]).max()) for node, v in solution.node_voltages.items()}
    assert peaks["out"] == pytest.approx(10.0 / math.hypot(1.0, 2.0 * math.pi * 1e3 * 1e5 * 100e-12), rel=1e-3)
    assert peaks["sec"] / peaks["prim"] == pytest.approx(0.99 * 20.0, rel=0.1)
    assert solution.method == "radau"


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


@pytest.mark.parametrize("text", [FINGER, FILM, AMPLIFIER, TWO_FINGERS, CREEP], ids=lambda text: text[:9])
def test_the_other_decks_run_unchanged_in_ngspice(text: str) -> None:
    run, nodes, _, area = beside(fs.parse_netlist(text), text)
    for ours, theirs in nodes.values():
        assert theirs[-1] == pytest.approx(ours[-1], abs=2e-3 * np.abs(ours).max())
    np.testing.assert_allclose(area[-1], 1e6 * run.area[-1], rtol=0, atol=0.05)


def test_the_table_of_parameters_is_that_of_the_devices() -> None:
    plain = ("m", "V/m", "ohm", "F", "Hz", "s")

    def shown(value: float, spec: ParameterSpec) -> str:
        return spice_text(value) if spec.unit in plain else f"{value:g}"

    expected = {}
    for device, entry in DEVICES.items():
        for spec in entry.parameters:
            default = "required" if spec.default is None else shown(spec.default, spec)
            legal = ("any" if spec.least < 0.0 else ">= 0" if spec.may_be_zero else "> 0") + (
                " or inf" if spec.may_be_infinite else ""
            )
            assert spec.usual is not None
            usual = f"{shown(spec.usual.least, spec)} to {shown(spec.usual.most, spec)}"
            expected[device, f"`{spec.name}`"] = [spec.unit or "1", default, legal, usual]
    table = {(device, row[1]): row[2:6] for row in rows("device") for device in row[0].split(", ")}
    assert table == expected
    assert all(row[6] for row in rows("device"))
    own = "f", "n_cpe", "r_exp", "k"
    every = [s for entry in DEVICES.values() for s in entry.parameters if s.name not in own]
    others = {(abs(s.least) if s.least > 0.0 else 1e-30, s.most) for s in every}
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
