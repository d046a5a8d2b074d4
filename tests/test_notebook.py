"""Display of results at Python's prompt, by print, and in an executed notebook."""

import html.parser
import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import fingerspice as fs
from fingerspice.base.pages import SCREEN, Page, Table
from fingerspice.circuit.describe import changes_text, drive_text, heading, waveform_text
from scenes import listed, shipped, table1

ROOT = Path(__file__).parents[1]
DECK = str(ROOT / "circuits" / "fingerpad.cir")
CELLS = (f"import fingerspice as fs\ncircuit = fs.read_netlist({DECK!r})\ncircuit", *listed("cells"))


@pytest.fixture(scope="module")
def outputs(tmp_path_factory: pytest.TempPathFactory) -> list[list[Any]]:
    """What every cell showed."""
    nbformat = pytest.importorskip("nbformat", reason="nbformat is not installed: pip install '.[test]'")
    nbclient = pytest.importorskip("nbclient", reason="nbclient is not installed: pip install '.[test]'")
    pytest.importorskip("ipykernel", reason="ipykernel is not installed: pip install '.[test]'")
    book = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(cell) for cell in CELLS])
    folder = tmp_path_factory.mktemp("notebook")
    client = nbclient.NotebookClient(book, timeout=300, resources={"metadata": {"path": str(folder)}})
    with pytest.MonkeyPatch.context() as patch:
        # The kernel imports what these tests import.
        import fingerspice

        here = str(Path(fingerspice.__file__).parents[1])
        patch.setenv("PYTHONPATH", os.pathsep.join([here, os.environ.get("PYTHONPATH", "")]))
        patch.setenv("IPYTHONDIR", str(folder / "ipython"))
        client.execute()
    return [cell.outputs for cell in book.cells]


def shown(cell: list[Any]) -> dict[str, str]:
    """The one thing that a cell shows, by kind."""
    assert all(output.output_type in ("execute_result", "display_data") for output in cell), cell
    (output,) = cell
    return dict(output.data)


@pytest.mark.parametrize("number", [2, 3, 5, 7, 9])
def test_a_picture_is_shown_once(outputs: list[list[Any]], number: int) -> None:
    assert len(shown(outputs[number])["image/png"]) > 10_000


@pytest.mark.parametrize(("number", "count"), [(15, 1), (16, 2), (17, 2), (18, 0)])
def test_pictures_in_a_loop_or_before_a_semicolon_are_shown_once_each(outputs, number, count):
    pictures = [shown([output])["image/png"] for output in outputs[number]]
    assert [len(picture) > 10_000 for picture in pictures] == [True] * count


@pytest.mark.parametrize(("number", "said"), listed("cell_tables"))
def test_a_result_is_shown_as_a_table(outputs: list[list[Any]], number: int, said: str) -> None:
    page = shown(outputs[number])["text/html"]
    assert "<table" in page
    assert said in page


def test_a_schematic_is_shown_as_svg(outputs: list[list[Any]]) -> None:
    picture = shown(outputs[10])["image/svg+xml"]
    assert all(f">{name}</text>" in picture for name in ("Vdrive", "Xcoat", "Xgap", "Xskin"))


def test_the_explorer_is_shown_as_a_frame_which_this_computers_pages_may_hold(outputs: list[list[Any]]) -> None:
    for number in (11, 13):
        page = shown(outputs[number])["text/html"]
        assert re.search(r'<iframe src="http://127\.0\.0\.1:\d+/[-\w]{32,}/"', page)
    policy = shown(outputs[12])["text/plain"].strip("'\"")
    allowed = "http://127.0.0.1:* http://localhost:* https://127.0.0.1:* https://localhost:*"
    assert policy.endswith(f"frame-ancestors {allowed}")


def test_a_notebook_keeps_a_bounded_number_of_explorers(outputs: list[list[Any]]) -> None:
    assert shown(outputs[14])["text/plain"] == "True"
    assert shown(outputs[-1])["text/plain"] == str([False] + 8 * [True])


MAKERS: dict[str, Callable[[], Any]] = {
    "circuit": table1,
    "solution": lambda: fs.simulate(table1(), t_stop=0.02),
    "steady": lambda: fs.steady_state(table1()),
    "comparison": lambda: fs.compare(table1()),
    "phasor": lambda: fs.phasor(table1(), np.geomspace(10.0, 1e5, 81)),
    "plan": lambda: fs.plan(table1()),
    "fit": lambda: fs.fit_material(fs.ColeCole(100.0, ((1e4, 1e-3, 0.1),), 1e-3)),
    "two fingers": lambda: fs.simulate(shipped("two_fingers")),
    "large circuit": lambda: fs.parse_netlist(
        "t\nV1 n0 0 1\n" + "".join(f"R{i} n{i} n{i + 1} 1k\n" for i in range(300)) + "C1 n300 0 1n\n.tran 1u 1m\n"
    ),
}


class Tags(html.parser.HTMLParser):
    """Whether every tag that opens closes, in its order."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tables = 0
        self.feed(text)
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: object) -> None:
        self.open.append(tag)
        self.tables += tag == "table"

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


@pytest.mark.parametrize("name", MAKERS)
def test_a_result_is_at_most_a_screen_and_is_whole_html(name: str) -> None:
    result = MAKERS[name]()
    text = repr(result)
    assert len(text.splitlines()) <= SCREEN
    assert max(map(len, text.splitlines())) <= 150
    assert "array(" not in text
    assert "object at 0x" not in text
    assert Tags(result._repr_html_()).tables >= (name != "plan")


def test_a_printed_solution_is_its_summary_and_a_long_page_is_cut_on_the_prompt_and_whole_in_print() -> None:
    solution = fs.simulate(table1(), t_stop=0.02)
    assert repr(solution) == str(solution) == solution._page()
    nodes = "".join(f"R{i} n{i} n{i + 1} 1k\n" for i in range(60))
    solution = fs.simulate(fs.parse_netlist(f"t\nV1 n0 0 1\n{nodes}C1 n60 0 1n\n.tran 10u 1m uic\n"))
    assert "node n60" in str(solution)
    assert repr(solution).splitlines()[-1].endswith("lines more: print() shows them")


def test_a_page_escapes_what_a_deck_writes() -> None:
    page = Page(["<script>\x1b[31m & co", Table(("", "a"), [("<b>", "1")])])
    assert "<script>" not in page.html
    assert "&lt;script&gt;\\x1b[31m &amp; co" in page.html
    assert "<b>" not in page.html
    assert page.splitlines()[1:] == ["     a", "------", "<b>  1"]


@pytest.mark.parametrize(
    ("waveform", "said"),
    [
        (fs.Sine(200, 100), "Sine(200 V, 100 Hz)"),
        (fs.Square(200, 5e3, duty=0.3, delay=1e-3), "Square(200 V, 5 kHz, delay 1 ms, duty 0.3)"),
        (fs.AM(200, 5000, 50), "AM(200 V, 5 kHz, 50 Hz)"),
        (fs.DC(150), "DC 150 V"),
        (fs.PWL((0, 1), (0, 2)), "PWL(2 points)"),
        (fs.Samples(np.zeros(44100), 44100), "Samples(44100 values, 44.1 kHz)"),
        (fs.Sine(1, 2) + 3.0, "(Sine(1 V, 2 Hz) + DC 3 V)"),
        (fs.Function(abs), "function abs"),
    ],
)
def test_a_waveform_in_words(waveform: fs.Waveform, said: str) -> None:
    assert waveform_text(waveform) == said


def test_what_was_changed_is_told_with_its_unit_and_once() -> None:
    circuit = table1()
    assert heading(circuit) == circuit.title
    assert drive_text(circuit) == "Vdrive: Sine(200 V, 100 Hz)"
    changed = circuit.replace({"Xgap.d": 5e-6}).replace({"xgap.D": 6e-6, "Xgap.a_fix": 35, "Vdrive.amplitude": 1500.0})
    assert changes_text(changed) == "Xgap.d = 6 um, Xgap.a_fix = 35 mm^2, Vdrive.amplitude = 1.5 kV"
    replaced = circuit.replace({"Vdrive": lambda t: 0.0 * t})
    assert changes_text(replaced) == "Vdrive = function <lambda>"
    # It stands there already.
    assert drive_text(replaced) == ""
