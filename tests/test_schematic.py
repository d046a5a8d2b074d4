"""Schematics: every element drawn once, nothing over anything else, files and answers to wrong requests."""

import itertools
import json
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from matplotlib.text import Text
from matplotlib.transforms import Bbox

import fingerspice as fs
from fingerspice.plots.schematic import MOST_ELEMENTS, Schematic, place, put_beside
from scenes import CIRCUITS, DECKS, cases, refuses, shipped, table1

LADDER = "A ladder\nV1 n0 0 1\n" + "".join(
    f"R{k} n{k} n{k + 1} 1k\nC{k} n{k + 1} 0 1n\n" for k in range(12)
) + ".tran 1u 1m\n"  # fmt: skip
OTHERS = {"bridge": (DECKS / "bridge.cir").read_text("utf-8"), "ladder": LADDER}


@pytest.fixture(params=[*sorted(p.stem for p in CIRCUITS.glob("*.cir")), *OTHERS])
def circuit(request: pytest.FixtureRequest) -> fs.Circuit:
    name: str = request.param
    return fs.parse_netlist(OTHERS[name]) if name in OTHERS else shipped(name)


def texts(svg: str) -> list[str]:
    return ["".join(x.itertext()) for x in ET.fromstring(svg).iter("{http://www.w3.org/2000/svg}text")]


def test_every_element_is_drawn_once_with_its_name_and_values(circuit: fs.Circuit) -> None:
    check_places(circuit)
    figure = circuit.draw()
    said = texts(figure._repr_svg_())
    for element in circuit.elements:
        assert said.count(element.name) == 1
    assert "".join(said).startswith(circuit.title[:40])
    drawn = " ".join(said)
    for element in circuit.by_device("GAP"):
        assert f"d = {1e6 * element.values['d']:g} µm" in drawn
        assert f"fn = {1e3 * element.values['fn']:g} mN" in drawn
        assert "c2 = 5000 mm^4/N^2" in drawn
    found = [text for text in figure.axes[0].findobj(Text) if isinstance(text, Text) and text.get_text()]
    no_label_meets_another_one_or_a_line(circuit, figure, [(one.get_text(), one.get_window_extent()) for one in found])


def no_label_meets_another_one_or_a_line(circuit: fs.Circuit, figure: Schematic, found: list[tuple[str, Bbox]]) -> None:
    assert len(found) >= 2 * len(circuit.elements)
    page = figure.bbox
    for name, box in found:
        assert page.x0 <= box.x0 < box.x1 <= page.x1, name
        assert page.y0 <= box.y0 < box.y1 <= page.y1, name
    for (name, box), (other, near) in itertools.combinations(found, 2):
        # Boxes of lines of one label have the font's whole height and touch.
        assert not box.padded(-1.0).overlaps(near.padded(-1.0)), (name, other)
    for line in figure.axes[0].lines:
        path = line.get_transform().transform_path(line.get_path())
        for name, box in found:
            assert not path.intersects_bbox(box.padded(-1.0), filled=False), name


def check_places(circuit: fs.Circuit) -> None:
    """No two elements and no two nodes meet."""
    placed = place(circuit)
    assert {p.element.name for p in placed.places} == {e.name for e in circuit.elements}
    for p in placed.places:
        assert p.top < p.bottom
        assert {p.top, p.bottom} == {placed.rows[node] for node in p.element.nodes[:2]}
        assert p.upright == (placed.rows[p.element.nodes[0]] == p.top)
        for node in p.element.nodes[:2]:
            assert placed.extents[node][0] <= p.column <= placed.extents[node][1]
    for p, q in itertools.combinations(placed.places, 2):
        assert p.column != q.column or p.bottom <= q.top or q.bottom <= p.top
    for (a, x), (b, y) in itertools.combinations(placed.extents.items(), 2):
        assert placed.rows[a] != placed.rows[b] or x[1] < y[0] or y[1] < x[0]
    assert placed.rows["0"] == max(placed.rows.values())


@settings(max_examples=cases(60, 25), deadline=None)
@given(st.lists(st.tuples(st.integers(0, 7), st.integers(0, 7)), min_size=1, max_size=24), st.integers(1, 7))
def test_any_network_has_places(pairs: list[tuple[int, int]], driven: int) -> None:
    # Every node has a capacitor and a resistor to ground, so that none is floating.
    nodes = sorted({driven, *itertools.chain(*pairs)} - {0})
    lines = [f"V1 {driven} 0 1", *(f"C{n} {n} 0 1n\nRg{n} {n} 0 1k" for n in nodes)]
    lines += [f"R{k} {p} {n} 1k" for k, (p, n) in enumerate(pairs) if p != n]
    check_places(fs.parse_netlist("\n".join(["Any", *lines, ".tran 1u 1m"])))


def test_a_stack_is_one_ladder_beside_its_source() -> None:
    placed = place(table1())
    assert [(p.element.name, p.column, p.top, p.bottom) for p in placed.places] == [
        ("Vdrive", 0, 0, 3), ("Xcoat", 1, 0, 1), ("Xgap", 1, 1, 2), ("Xskin", 1, 2, 3),
    ]  # fmt: skip


def test_areas_are_said_where_a_source_gives_one_and_a_resistor_is_drawn_where_a_layer_leaks() -> None:
    said = [" ".join(texts(c.draw()._repr_svg_())) for c in (fs.parse_netlist(OTHERS["bridge"]), table1())]
    assert "area = spot" in said[0]
    assert "DC 100 mm^2" in said[0]
    assert "area" not in said[1]
    strokes = [len(table1().replace({"Xcoat.r": r}).draw().axes[0].lines) for r in (2e5, float("inf"))]
    assert strokes[0] > strokes[1]


def test_changed_values_are_drawn_and_changed_circuits_give_the_same_picture_again() -> None:
    changed = table1().replace({"Xgap.d": 5e-6, "Vdrive": "SQUARE(150 70)"})
    drawn = changed.draw()._repr_svg_()
    assert any("d = 5 µm" in text for text in texts(drawn))
    assert "Square(150 V, 70 Hz)" in texts(drawn)
    assert changed.draw()._repr_svg_() == drawn


def test_a_file_is_svg_or_png_by_its_end(tmp_path: Path) -> None:
    circuit = table1()
    circuit.draw(tmp_path / "a.svg")
    circuit.draw(str(tmp_path / "a.PNG"))
    assert "Xgap" in texts((tmp_path / "a.svg").read_text(encoding="utf-8"))
    assert (tmp_path / "a.PNG").read_bytes().startswith(b"\x89PNG")
    refuses(r"'.*a\.pdf'; allowed: a name that ends in \.svg or \.png", circuit.draw, tmp_path / "a.pdf")
    refuses("cannot write", circuit.draw, tmp_path / "a.svg" / "b.svg")


def test_a_title_of_another_kind_is_text_and_not_a_formula_or_markup() -> None:
    circuit = fs.parse_netlist("$\\frac{1}$ <b> & \N{SNOWMAN}\nV1 a_$x$ 0 1\nR1 a_$x$ 0 1k\n.tran 1u 1m\n")
    said = texts(circuit.draw()._repr_svg_())
    assert "$\\frac{1}$ <b> & \N{SNOWMAN}" in said
    assert "a_$x$" in said


def test_a_circuit_too_large_for_a_picture_is_refused() -> None:
    large = "Large\nV1 a 0 1\n" + "".join(f"R{k} a 0 1k\n" for k in range(MOST_ELEMENTS - 1))
    with pytest.raises(fs.InputError, match="the circuit has 201 elements; allowed: at most 200 in a picture"):
        fs.parse_netlist(f"{large}C1 a 0 1n\n.tran 1u 1m\n").draw()
    assert np.prod(fs.parse_netlist(f"{large}.tran 1u 1m\n").draw().get_size_inches()) < 1000.0


def test_the_picture_of_a_run_has_the_schematic_about_as_high_on_its_right() -> None:
    circuit = shipped("fingerpad")
    picture = fs.simulate(circuit).plot()
    width, height = picture.get_size_inches()
    whole = put_beside(picture, circuit)
    whole.draw_without_rendering()
    *panels, schematic = whole.axes
    wide, high = circuit.draw().get_size_inches()
    assert tuple(whole.get_size_inches()) == pytest.approx((width + 1.3 * wide, 0.8 * height))
    assert 0.75 < 1.3 * high / (0.8 * height) <= 1.0
    edge = schematic.get_position().x0
    renderer = whole.canvas.get_renderer()  # type: ignore[attr-defined]
    rights = [ax.get_tightbbox(renderer).x1 / whole.bbox.width for ax in panels]
    assert 0.9 * edge < max(rights) < edge
    (shown,) = schematic.images
    # It is drawn as it is: dark strokes on white, in its own proportions.
    assert shown.get_array().min() < 0.2 < 0.9 < shown.get_array().mean()
    high, wide = shown.get_array().shape[:2]
    box = schematic.get_position()
    assert box.width * whole.bbox.width / (box.height * whole.bbox.height) == pytest.approx(wide / high, rel=0.01)


def test_run_writes_the_schematic_beside_its_picture_and_keeps_that_of_another_circuit(command, tmp_path):
    run = ("run", str(CIRCUITS / "fingerpad.cir"), "--schematic", "--stop", "10m", "--out", str(tmp_path))
    file = tmp_path / "fingerpad_schematic.svg"
    for _ in range(2):
        done = command(*run, "--no-plot", "--json").ok()
        assert json.loads(done.out)["files"] == [str(tmp_path / "fingerpad.nc"), str(file)]
    assert "Xgap" in texts(file.read_text(encoding="utf-8"))
    refused = command(*run, "--csv", "--set", "Xgap.d=3u").refused()
    assert f"{file} holds a result of the deck as it is, and this one is with Xgap.d=3u" in refused.err
    file.write_text("<svg/>", encoding="utf-8")
    assert "nothing says which circuit it is of" in command(*run).err
    assert "--schematic does not go with --stream" in command(*run, "--stream").err
