"""Decks that other people have published, in our own words: here and in ngspice the same, measures and steps, too."""

import re
from pathlib import Path

import numpy as np
import pytest

import fingerspice as fs
from ngspice_tools import beside, call_ngspice
from scenes import DECKS, listed

PUBLISHED = DECKS / "published"


def measures_of_ngspice(text: str, folder: Path) -> dict[str, float]:
    (folder / "deck.cir").write_text(text)
    said = call_ngspice(folder, "deck.cir", timeout=120.0).stdout
    return {m[1]: float(m[2]) for m in re.finditer(r"^(\w+) +=\s+([-+.\deE]+)", said, re.MULTILINE)}


@pytest.mark.parametrize(("name", "step"), listed("published"))
@pytest.mark.filterwarnings("ignore:.*outside 1 nH:fingerspice.FingerspiceWarning")
def test_a_published_deck_runs_as_in_ngspice(name: str, step: float, tmp_path: Path) -> None:
    text = (PUBLISHED / f"{name}.cir").read_text()
    circuit = fs.parse_netlist(text)
    bare = re.sub(r"(?im)^\.(op|save|meas).*\n", "", text)
    found = beside(circuit, bare, max_step=step, after=20.0 * step, edge=5.0 * step)
    largest = max(float(np.abs(theirs).max()) for _, theirs in found.nodes.values())
    # ngspice changes a switch at the end of a step, so that its error is of first order there.
    allowed = 8e-3 if "driver" in name else 1e-6
    for node, (ours, theirs) in found.nodes.items():
        assert np.abs(ours - theirs).max() <= allowed * largest, node
    theirs = measures_of_ngspice(re.sub(r"(?im)^\.tran (\S+) (\S+)", rf".tran \1 \2 0 {step!r}", text), tmp_path)
    measures = fs.simulate(circuit).measures
    assert len(measures) >= 2
    for measure, value in measures.items():
        assert value == pytest.approx(theirs[measure.lower()], rel=max(allowed, 5e-6)), measure


#: Measures of a fine sweep there are compared with those of the deck's own here.
@pytest.mark.parametrize("name", ["worst_case", "differentiator", "of_an_l_and_a_c"])
def test_a_published_sweep_is_measured_as_in_ngspice(name: str, tmp_path: Path) -> None:
    text = (PUBLISHED / f"sweep_{name}.cir").read_text()
    circuit = fs.parse_netlist(text)
    found = fs.phasor(circuit, np.geomspace(circuit.ac.start, circuit.ac.stop, 101))
    theirs = measures_of_ngspice(re.sub(r"(?i)\.ac dec \d+", ".save all\n.ac dec 4000", text), tmp_path)
    assert len(found.measures) >= 2
    for measure, value in found.measures.items():
        assert value == pytest.approx(theirs[measure], rel=3e-5), measure
    if name == "of_an_l_and_a_c":
        # Q is 50: the summit between the points of a sweep.
        assert found.measures["peak"] == pytest.approx(50.0 / np.sqrt(1.0 - 1e-4), rel=1e-12)


def test_published_steps_of_an_operating_point(tmp_path: Path) -> None:
    """A loaded source (a course in KiCad), at every load as ngspice has it by itself, and in closed form."""
    loads = [10.0, 30.0, 100.0, 300.0, 900.0, 1e3, 3e3, 10e3, 1e6]
    body = "V1 vsrc 0 12\nRS vsrc vout 100\nRL vout 0 {RLOAD}\n.param RLOAD=900\n"
    step = ".step param RLOAD list 10 30 100 300 900 1k 3k 10k 1Meg\n.op\n"
    found = fs.operating_points(fs.parse_netlist(f"loads\n{body}{step}.end\n"))
    np.testing.assert_array_equal(found.rload, loads)
    np.testing.assert_allclose(found["v:vout"], 12.0 * np.array(loads) / (np.array(loads) + 100.0), rtol=1e-14)
    for place in (0, 4, 8):
        one = body.replace("RLOAD=900", f"RLOAD={loads[place]!r}")
        (tmp_path / "deck.cir").write_text(f"loads\n{one}.control\nop\nprint v(vout)\nquit 0\n.endc\n.end\n")
        said = call_ngspice(tmp_path, "deck.cir").stdout
        theirs = float(re.search(r"v\(vout\) = (\S+)", said)[1])  # type: ignore[index]
        assert found["v:vout"][place].item() == pytest.approx(theirs, rel=1e-6)
