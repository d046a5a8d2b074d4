"""An executed notebook: results appear as tables and pictures without a magic line."""

import os
import re
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[1]
CELLS = (
    f"import fingerspice as fs\ncircuit = fs.read_netlist({str(ROOT / 'circuits' / 'fingerpad.cir')!r})\ncircuit",
    "solution = fs.simulate(circuit)\nsolution",
    "solution.plot()",
    "solution.plot('f_el', others=fs.simulate(circuit.replace({'Xgap.d': 5e-6})))",
    "fs.steady_state(circuit)",
    "comparison = fs.compare(circuit)\ncomparison.plot().show()",
    "fs.phasor(circuit, [100, 1e3, 1e4])",
    "fs.load(solution.to_netcdf('run.nc')).plot(window=(0.0, 0.02))",
    "solution.to_dataframe()[['u_gap', 'f_el']].describe()",
    "%matplotlib inline\nsolution.plot()",
    "circuit.draw()",
    "explorer = circuit.explore()\nexplorer",
    "import urllib.request\nurllib.request.urlopen(explorer.url).headers['Content-Security-Policy']",
    "fs.simulate(circuit, charge_law='mobile', rtol=1e-5, t_stop=0.03, area='frozen').explore()",
    "fs.explore(browser=False)._repr_html_() is None",
    "solution.plot();",
    "for signal in ('f_el', 'u_gap'):\n    solution.plot(signal)",
    "pictures = [solution.spectrum().plot() for _ in range(2)]\npictures[0].show()\npictures[1]",
    "kept = pictures[0].savefig('spectrum.png')",
    "explorers = [circuit.explore() for _ in range(9)]\n[one._thread.is_alive() for one in explorers]",
)


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
def test_pictures_in_a_loop_or_before_a_semicolon_are_shown_once_each(
    outputs: list[list[Any]], number: int, count: int
) -> None:
    pictures = [shown([output])["image/png"] for output in outputs[number]]
    assert [len(picture) > 10_000 for picture in pictures] == [True] * count


@pytest.mark.parametrize(
    ("number", "said"),
    [
        (0, "Sine(200 V, 100 Hz)"), (1, "electroadhesive force"), (4, "electroadhesive force"), (6, "mean force"),
        (8, "f_el"),
    ],
)  # fmt: skip
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
