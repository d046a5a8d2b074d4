"""The schematic of a circuit: its layers as a ladder, each a resistor beside a capacitor, with names and values.

Nodes are rows, elements stand in columns between them: a series stack becomes a ladder beside its source by the same
rules as any network does. Symbols are strokes: points in inches around the symbol's centre, the first node above.
"""

from __future__ import annotations

import io
import itertools
import math
import operator
import textwrap
from collections.abc import Iterator, Mapping, Sequence, Set
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib import image, rc_context
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties
from matplotlib.patches import Rectangle

from fingerspice.base.files import write_aside
from fingerspice.circuit.circuit import Circuit, Element
from fingerspice.circuit.describe import waveform_text
from fingerspice.plots import drawing
from fingerspice.plots.picture import Picture
from fingerspice.waveforms.waveform import refuse

_GROUND = "0"


class Place(NamedTuple):
    """Where one element stands: its column, and the rows of its upper and its lower node."""

    element: Element
    column: int
    top: int
    bottom: int
    upright: bool  # Whether its first node is the upper one

    @property
    def gap(self) -> int:
        """The row below which the symbol stands, above the next one."""
        return (self.top + self.bottom - 1) // 2


class Placement(NamedTuple):
    """Places of all elements, the row of every node, and its first and last column."""

    places: list[Place]
    rows: Mapping[str, int]
    extents: dict[str, tuple[int, int]]


def place(circuit: Circuit) -> Placement:
    """Places in which no two elements, and no two nodes, meet."""
    level = _levels(circuit)
    order = list(_in_order(circuit, level))
    # Nodes that cannot share a row get one each, and then every element has room in a new column.
    single = {node: row for row, node in enumerate(sorted(level, key=level.__getitem__))}
    return next(found for rows in (level, single) if (found := _place_columns(order, rows)) is not None)


def _levels(circuit: Circuit) -> dict[str, int]:
    """Level of every node below the driven ones, ground the last; the nodes of an element have different levels."""
    nodes = list(dict.fromkeys(node for e in circuit.elements for node in e.nodes[:2]))
    number = {node: k for k, node in enumerate(nodes)}
    # With sources of 1 A and 1 ohm in place of every element, potentials fall from the driven nodes to ground.
    matrix, driven = np.zeros((len(nodes), len(nodes))), np.zeros(len(nodes))
    for e in circuit.elements:
        p, n = number[e.nodes[0]], number[e.nodes[1]]
        matrix[[p, n], [p, n]] += 1.0
        matrix[[p, n], [n, p]] -= 1.0
        driven[[p, n]] += np.array([1.0, -1.0]) * {"V": 1.0, "I": -1.0}.get(e.device, 0.0)
    potential = np.linalg.lstsq(matrix, driven, rcond=None)[0].round(9)
    level: dict[str, int] = {}
    # Ground is the last, so that no other node's level depends on it.
    for node in sorted(nodes, key=lambda node: (node == _GROUND, -potential[number[node]], number[node])):
        ends = (end for e in circuit.elements if node in e.nodes[:2] for end in e.nodes[:2])
        level[node] = 1 + max((level[end] for end in ends if end in level), default=-1)
    level[_GROUND] = 1 + max(level[node] for node in nodes if node != _GROUND)
    return level


def _in_order(circuit: Circuit, level: Mapping[str, int]) -> Iterator[tuple[Element, Element | None]]:
    """Elements in the order in which they get places, each with the one above it: sources, then chain by chain."""
    areas = {node for e in circuit.elements if e.spec.is_layer for node in e.nodes[2:]}
    fixing = [e for e in circuit.by_device("V", "I") if areas & set(e.nodes[:2])]
    yield from ((e, None) for e in circuit.by_device("V", "I") if e not in fixing)
    below: dict[str, list[Element]] = {}
    for e in circuit.elements:
        if e.device not in "VI":
            below.setdefault(min(e.nodes[:2], key=level.__getitem__), []).append(e)

    def chains(node: str, before: Element | None) -> Iterator[tuple[Element, Element | None]]:
        for e in below.pop(node, []):
            yield e, before
            yield from chains(max(e.nodes[:2], key=level.__getitem__), e)

    for node in sorted(below, key=level.__getitem__):
        yield from chains(node, None)
    yield from ((e, None) for e in fixing)


def _place_columns(order: Sequence[tuple[Element, Element | None]], rows: Mapping[str, int]) -> Placement | None:
    """Each element in the first column with room for it; None if nodes of one row would meet."""
    places: dict[str, Place] = {}
    extents: dict[str, tuple[int, int]] = {}
    for element, before in order:
        ends = element.nodes[:2]
        top, bottom = sorted(rows[node] for node in ends)
        preferred = [places[before.name].column] if before is not None else []
        for column in (*preferred, *range(len({p.column for p in places.values()}) + 1)):
            room = all(p.column != column or p.bottom <= top or p.top >= bottom for p in places.values())
            so_far = {node: extents.get(node, (column, column)) for node in ends}
            wider = {node: (min(lo, column), max(hi, column)) for node, (lo, hi) in so_far.items()}
            after = {**extents, **wider}
            if room and not any(
                rows[node] == rows[other] and node != other and lo <= after[other][1] and after[other][0] <= hi
                for node, (lo, hi) in wider.items()
                for other in after
            ):
                break
        else:
            return None
        places[element.name] = Place(element, column, top, bottom, rows[ends[0]] < rows[ends[1]])
        extents = after
    return Placement(list(places.values()), rows, extents)


Stroke = Sequence[tuple[float, float]]
_HALF, _APART, _RADIUS = 0.24, 0.17, 0.17  # Half a part's height, and half a resistor's distance from its capacitor
_ZIGZAG: Stroke = [(0.06 * (-1.0) ** k, 0.15 - 0.05 * (k + 0.5)) for k in range(6)]
_RESISTOR: list[Stroke] = [[(0.0, _HALF), (0.0, 0.15), *_ZIGZAG, (0.0, -0.15), (0.0, -_HALF)]]
_CAPACITOR: list[Stroke] = [
    *([(-0.11, s * 0.035), (0.11, s * 0.035)] for s in (1.0, -1.0)),
    *([(0.0, s * 0.035), (0.0, s * _HALF)] for s in (1.0, -1.0)),
]
_CIRCLE: list[Stroke] = [
    [(float(_RADIUS * np.cos(a)), float(_RADIUS * np.sin(a))) for a in np.linspace(0.0, 2.0 * np.pi, 61)],
    *([(0.0, s * _RADIUS), (0.0, s * _HALF)] for s in (1.0, -1.0)),
]
_HALF_TURN = np.linspace(0.0, np.pi, 16)
_PLUS_MINUS: list[Stroke] = [
    [(-0.045, 0.085), (0.045, 0.085)], [(0.0, 0.04), (0.0, 0.13)], [(-0.045, -0.085), (0.045, -0.085)]
]  # fmt: skip
_ARROW: list[Stroke] = [[(0.0, 0.11), (0.0, -0.11)], [(-0.045, -0.05), (0.0, -0.11), (0.045, -0.05)]]
_COIL: list[Stroke] = [
    [(float(0.06 * np.sin(a)), float(0.15 - 0.1 * k - 0.05 * (1.0 - np.cos(a)))) for k in range(3) for a in _HALF_TURN],
    *([(0.0, s * 0.15), (0.0, s * _HALF)] for s in (1.0, -1.0)),
]
_SWITCH: list[Stroke] = [[(0.0, _HALF), (0.0, 0.1)], [(0.0, -_HALF), (0.0, -0.1), (0.1, 0.08)]]
_DIAMOND: list[Stroke] = [
    [(0.0, _RADIUS), (_RADIUS, 0.0), (0.0, -_RADIUS), (-_RADIUS, 0.0), (0.0, _RADIUS)], *_CIRCLE[1:]
]  # fmt: skip
Symbol = tuple[list[Stroke], float, float]  # Strokes of a symbol, half its height, and half its width
#: Symbols of the parts. The arrow of a current points from the first node to the second.
_PARTS: dict[str, Symbol] = {
    "R": (_RESISTOR, _HALF, 0.08), "C": (_CAPACITOR, _HALF, 0.12),
    "V": (_CIRCLE + _PLUS_MINUS, _HALF, _RADIUS), "I": (_CIRCLE + _ARROW, _HALF, _RADIUS),
    "L": (_COIL, _HALF, 0.08), "S": (_SWITCH, _HALF, 0.1),
    **dict.fromkeys("EH", (_DIAMOND + _PLUS_MINUS, _HALF, _RADIUS)),
    **dict.fromkeys("GF", (_DIAMOND + _ARROW, _HALF, _RADIUS)),
}  # fmt: skip


def _symbol(element: Element) -> Symbol:
    if element.device in _PARTS:
        return _PARTS[element.device]
    if element.device in ("SKIN_DISPERSIVE", "CPE", "CPE_LAYER"):
        # Two cells stand for the many of the ladder, with dots in between.
        away = _HALF + 0.1
        dots: list[Stroke] = [[(0.0, y), (0.0, y + 0.02)] for y in (-0.06, -0.01, 0.04)]
        return [*_cell(away), *dots, *_cell(-away)], 2.0 * _HALF + 0.1, _APART + 0.12
    leak = element.values.get("r", element.values.get("rho", 0.0))
    return (_cell(0.0) if math.isfinite(leak) else _CAPACITOR), _HALF, _APART + 0.12


def _cell(y: float) -> list[Stroke]:
    """A capacitor, and a resistor beside it."""
    bars: list[Stroke] = [[(-_APART, y + s * _HALF), (_APART, y + s * _HALF)] for s in (1.0, -1.0)]
    return [*_moved(_RESISTOR, -_APART, y), *_moved(_CAPACITOR, _APART, y), *bars]


def _moved(strokes: Sequence[Stroke], x: float, y: float, up: float = 1.0) -> list[Stroke]:
    """Strokes around (x, y), upside down where `up` is -1."""
    return [[(x + dx, y + up * dy) for dx, dy in stroke] for stroke in strokes]


MOST_ELEMENTS = 200  # Largest number of elements that a picture can show
_LETTERS, _LONGEST, _LINES = 34, 40, 7  # Letters in a line of values and in a name, and lines of values at most
#: Inches: height of a line of text, from a symbol to its label, around everything, and around a label in its row.
_LINE, _BESIDE, _MARGIN, _ROOM = 0.135, 0.08, 0.15, 0.1
_LARGE, _LEAST = 1.3, 0.8  # Largest size of a schematic beside a picture, and least height of that, over their own
_TINTS = {"LAYER": drawing.SKY, "SLAB": drawing.SKY, "SKIN": drawing.ORANGE, "SKIN_DISPERSIVE": drawing.ORANGE}


class Schematic(Picture):
    """A picture that a notebook shows as SVG."""

    def _repr_svg_(self) -> str:
        content = io.StringIO()
        self._write_svg(content, {})
        return content.getvalue()

    def _content(self) -> tuple[dict[str, Any], dict[str, Any]]:
        return {"image/svg+xml": self._repr_svg_()}, {}

    def _write_svg(self, target: Path | io.StringIO, about: Mapping[str, str]) -> None:
        # Texts stay texts, and the same circuit gives the same file.
        with rc_context({"svg.fonttype": "none", "svg.hashsalt": "fingerspice"}):
            self.savefig(target, format="svg", metadata={"Date": None, **about})

    def write(self, path: str | Path, about: Mapping[str, str] | None = None) -> Path:
        """Write the schematic as SVG or PNG, whichever the path's end says; the file is complete or absent.

        Parameters
        ----------
        path : str or Path
        about : mapping, optional
            Texts that are stored in the file, under names that the format knows.

        Raises
        ------
        InputError
            If the path has another end, or the folder cannot be written.
        """
        path = Path(path)
        if path.suffix.lower() == ".png":
            return drawing.save(self, path, about=about, dpi=200.0)
        wrong = path.suffix.lower() != ".svg"
        refuse(wrong, f"the schematic's file is {str(path)!r}; allowed: a name that ends in .svg or .png")
        return write_aside(path, lambda target: self._write_svg(target, about or {}))


def put_beside(picture: Figure, circuit: Circuit) -> Figure:
    """The picture of a run with the circuit's schematic, small, on its right."""
    schematic = draw_circuit(circuit)
    width, height = picture.get_size_inches()
    wide, high = schematic.get_size_inches()
    height = min(height, max(_LEAST * height, _LARGE * high))
    shrunk = min(_LARGE, height / high)
    total = width + shrunk * wide
    picture.set_size_inches(total, height)
    picture.get_layout_engine().set(rect=(0.0, 0.0, width / total, 1.0))  # type: ignore[union-attr, call-arg]
    # Axes without a grid take no part in the layout.
    share = shrunk * high / height
    ax = picture.add_axes((width / total, 0.5 - 0.5 * share, shrunk * wide / total, share), label="schematic")
    ax.set_axis_off()
    ax.imshow(image.imread(io.BytesIO(schematic._repr_png_()[0])), aspect="auto", interpolation="antialiased")
    return picture


def draw_circuit(circuit: Circuit, path: str | Path | None = None) -> Schematic:
    """The schematic of a circuit; arguments as in `Circuit.draw`."""
    count, allowed = len(circuit.elements), f"at most {MOST_ELEMENTS} in a picture"
    refuse(count > MOST_ELEMENTS, f"the circuit has {count:,} elements; allowed: {allowed}")
    circuit = replace(circuit, elements=tuple(e for e in circuit.elements if e.nodes))  # A coupling has none.
    figure, placed = Schematic(facecolor="white"), place(circuit)
    pairs = [pair for e in circuit.elements for pair in zip(e.nodes[:2], e.node_names[:2], strict=True)]
    names = {node: drawing.drawable(name, _LONGEST) for node, name in reversed(pairs) if node != _GROUND}
    areas = {node for e in circuit.elements for node in e.nodes[2:]}
    # One area that no source gives goes without saying.
    told = areas if len(areas) > 1 or areas & set(names) else set()
    labelled = [(p, _symbol(p.element), _label(p.element, told)) for p in placed.places]
    title = textwrap.wrap(drawing.drawable(circuit.title), 60) or [""]
    columns, rows, width, height = _sheet(figure, placed, labelled, names, title)
    figure.set_size_inches(width, height)
    ax = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    ax.set(xlim=(0.0, width), ylim=(0.0, height))
    ax.set_axis_off()
    write = partial(ax.text, fontsize=drawing.FONT, color=drawing.BLACK, va="center", parse_math=False)
    for k, line in enumerate(title):
        write(_MARGIN, height - _MARGIN - (k + 0.5) * _LINE * 1.2, line, weight="bold")
    strokes, dots = _wires(placed, columns, rows)
    for p, (symbol, tall, wide), label in labelled:
        # The name of the node below needs the lowest line.
        x, y = columns[p.column], 0.5 * (rows[p.gap] + rows[p.gap + 1] + _LINE)
        if tint := _TINTS.get(p.element.device):
            corner = (x - wide - 0.02, y - tall)
            ax.add_patch(Rectangle(corner, 2.0 * wide + 0.04, 2.0 * tall, color=tint, alpha=0.2, linewidth=0))
        for k, line in enumerate(label):
            at = x + wide + _BESIDE, y + 0.5 * _LINE * len(label) - (k + 0.5) * _LINE
            write(*at, line, weight="normal" if k else "bold")
        strokes += _moved(symbol, x, y, 1.0 if p.upright else -1.0)
        strokes += [[(x, rows[p.top]), (x, y + tall)], [(x, y - tall), (x, rows[p.bottom])]]
    for node, name in names.items():
        write(columns[placed.extents[node][0]] + 0.07, rows[placed.rows[node]] + 0.08, name, color=drawing.BLUE)
    for stroke in strokes:
        ax.plot(*zip(*stroke, strict=True), color=drawing.BLACK, linewidth=1.0, solid_capstyle="round")
    for dot in dots:
        ax.plot(*dot, "o", color=drawing.BLACK, markersize=3.5)
    if path is not None:
        figure.write(path)
    return figure


def _sheet(
    figure: Figure, placed: Placement, labelled: Sequence[tuple[Place, Symbol, Sequence[str]]],
    names: Mapping[str, str], title: Sequence[str],
) -> tuple[list[float], list[float], float, float]:  # fmt: skip
    """Places of columns and rows, between which nothing meets, and width and height of the sheet (inches)."""
    renderer = figure.canvas.get_renderer()  # type: ignore[attr-defined]

    def size(text: str, weight: str = "normal") -> float:
        font = FontProperties(size=drawing.FONT, weight=weight)
        return float(renderer.get_text_width_height_descent(text, font, False)[0]) / float(figure.dpi)

    columns = 1 + max(p.column for p in placed.places)
    left, right, high = [0.2] * columns, [0.3] * columns, [0.0] * max(p.bottom for p in placed.places)
    for p, (_, tall, wide), label in labelled:
        beside = max(size(line, "normal" if k else "bold") for k, line in enumerate(label))
        left[p.column] = max(left[p.column], wide)
        right[p.column] = max(right[p.column], wide + _BESIDE + beside)
        high[p.gap] = max(high[p.gap], 2.0 * tall, _LINE * len(label))
    for node, name in names.items():
        column = placed.extents[node][0]
        right[column] = max(right[column], 0.07 + size(name))
    x = [_MARGIN + left[0]]
    for before, own in itertools.pairwise(zip(left, right, strict=True)):
        x.append(x[-1] + before[1] + _MARGIN + own[0])
    width = max(x[-1] + right[-1] + _MARGIN, max(size(line, "bold") for line in title) + 2.0 * _MARGIN)
    # Names of nodes stand above their rows, also above the first one; ground hangs below the last.
    above = [_MARGIN + 1.2 * _LINE * len(title) + _ROOM + _LINE, *(h + 2.0 * _ROOM + _LINE for h in high)]
    height = sum(above) + 0.24 + _MARGIN
    return x, [*itertools.accumulate(above, operator.sub, initial=height)][1:], width, height


def _label(element: Element, areas: Set[str]) -> tuple[str, ...]:
    """Name of an element, and lines of its values; of a layer also its area where it is among `areas`."""
    said = [element.device] if element.spec.is_layer else []
    for spec in element.spec.parameters:
        value = element.values[spec.name]
        # A default of 0 or infinity is an effect that the element does not have.
        if math.isinf(value) or (value == 0.0 and spec.default == 0.0):
            continue
        text = _quantity(value, spec.unit)
        said.append(text if spec.name == "value" else f"{spec.name} = {text}")
    unit = "A" if element.device == "I" else "mm^2" if areas & set(element.nodes[:2]) else "V"
    if element.waveform is not None:
        said.append(waveform_text(element.waveform, unit).replace(" u", " µ"))
    if element.ac is not None:
        said.append(f"AC = {_quantity(element.ac.magnitude, unit)}")
    if element.initial is not None:
        said.append(f"IC = {_quantity(element.initial, 'A' if element.device == 'L' else 'V')}")
    if areas & set(element.nodes[2:]):
        said.append(f"area = {element.node_names[2]}")
    pieces = [piece for text in said for piece in drawing.drawable(text).split(", ")]
    # A value that fits a line is not divided, since textwrap breaks at plain spaces only.
    kept = ", ".join(text.replace(" ", "\N{NO-BREAK SPACE}") if len(text) <= _LETTERS else text for text in pieces)
    lines = textwrap.wrap(kept, _LETTERS + 1, break_on_hyphens=False)
    if len(lines) > _LINES:
        lines = [*lines[: _LINES - 1], f"{lines[_LINES - 1][: _LETTERS - 4]} ..."]
    return (drawing.drawable(element.name, _LONGEST), *(line.replace("\N{NO-BREAK SPACE}", " ") for line in lines))


def _quantity(value: float, unit: str) -> str:
    factor, prefixed = drawing.engineering(value, unit) if unit else (1.0, "")
    return f"{factor * value:.4g} {prefixed}".rstrip().replace("ohm", "Ω")


def _wires(placed: Placement, x: Sequence[float], y: Sequence[float]) -> tuple[list[Stroke], Stroke]:
    """The rows of nodes with ground, and the points where three wires or more meet."""
    rows: list[Stroke] = []
    dots = []
    for node, (first, last) in placed.extents.items():
        height = y[placed.rows[node]]
        if last > first:
            rows.append([(x[first], height), (x[last], height)])
        ends = [p.column for p in placed.places if node in p.element.nodes[:2]]
        for column in sorted(set(ends)):
            meeting = ends.count(column) + (column > first) + (column < last)
            if meeting + (node == _GROUND and column == first) >= 3:
                dots.append((x[column], height))
    # Ground hangs from the first column of its row.
    lines: list[Stroke] = [[(0.0, 0.0), (0.0, -0.14)]]
    lines += [[(-w, -d), (w, -d)] for w, d in ((0.13, 0.14), (0.08, 0.19), (0.03, 0.24))]
    return [*rows, *_moved(lines, x[placed.extents[_GROUND][0]], y[placed.rows[_GROUND]])], dots
