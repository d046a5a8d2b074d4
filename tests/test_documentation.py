"""The documentation: the code of every page runs, its links lead somewhere, no public name is missing; the gallery."""

import contextlib
import importlib
import importlib.util
import io
import os
import re
import shlex
import shutil
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pytest

import fingerspice as fs
from commands import Command
from fingerspice.explorer.scene import EXAMPLES
from scenes import cases

ROOT = Path(__file__).parents[1]
CIRCUITS, DOCS = ROOT / "circuits", ROOT / "docs"
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
            result = command(*arguments, *(cases([], ["--points", "3"]) if map_of_folds else []))
            assert result.code == 0, (arguments, result.err)
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
    decks, scenes = CIRCUITS.glob("*.cir"), (f"scene-{example.name}" for example in EXAMPLES)
    assert set(entries) == {*(path.stem for path in decks), *scenes}
    assert all(f"]({name}.png)" in gallery.page() for name in entries)
    assert "where fingers feel best" in entries["click"].about
    for name in ("click", "scene-fold"):
        gallery.draw(entries[name], tmp_path / f"{name}.png")
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
    result = command("figures", "--gallery", "--out", "out")
    assert result.code == 0
    drawn = {path.stem for path in (tmp_path / "out" / "gallery").glob("*.png")}
    assert drawn == {"click", *(f"scene-{one.name}" for one in some)}
    assert all(name in result.out for name in drawn)
    result = command("figures", "--gallery", "--only", "4")
    assert result.code == 2
    assert "--only and --gallery are both given" in result.err


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
