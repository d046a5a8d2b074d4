"""Tools of every picture: figure, axes, legend, caption, colours, units and file.

Figures are made with matplotlib's object API, without pyplot and its global state; matplotlib is imported when the
first figure is made.

Places of a circuit's elements in its schematic: nodes are rows, elements stand in columns between them.

A series stack becomes a ladder beside its source by the same rules as any network does.
"""

from __future__ import annotations

import itertools
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fingerspice.base.arrays import FloatArray
from fingerspice.base.errors import printable
from fingerspice.base.files import write_aside
from fingerspice.circuit.circuit import Circuit, Element

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from fingerspice.plots.picture import Picture


# The palette of Okabe and Ito, whose colours people with the common colour blindnesses can distinguish.
BLACK, GREY, BLUE, VERMILION = "#000000", "#777777", "#0072B2", "#D55E00"
GREEN, PURPLE, ORANGE, SKY = "#009E73", "#CC79A7", "#E69F00", "#56B4E9"

#: Font sizes (points) and width (inches) of a figure across a page.
FONT, SMALL, WIDTH = 8.5, 7.0, 7.0
#: Number of bins into which long curves are divided: larger than the number of dots across the page.
MAX_BINS = 4000
#: Largest number of characters of a name in a legend.
LONGEST_LABEL = 60
CYCLE = (BLUE, VERMILION, GREEN, PURPLE, ORANGE, SKY)
DASHES: tuple[Any, ...] = ("-", (0, (5, 1.5)), (0, (5, 1.5, 1, 1.5)), (0, (1, 1.2)))
_PREFIXES = {-12: "p", -9: "n", -6: "µ", -3: "m", 0: "", 3: "k", 6: "M", 9: "G"}


def new_figure(rows: int, columns: int = 1, height: float = 3.0, **options: Any) -> tuple[Picture, list[Axes]]:
    """A figure across a page, `height` inches high, and its panels row by row; `options` are of ``Figure.subplots``."""
    from fingerspice.plots.picture import Picture

    figure = Picture(figsize=(WIDTH, height), layout="constrained", facecolor="white")
    figure.get_layout_engine().set(w_pad=0.06, h_pad=0.05)  # type: ignore[union-attr, call-arg]
    axes = figure.subplots(rows, columns, squeeze=False, **options).ravel().tolist()
    for ax in axes:
        dress(ax)
    return figure, axes


def dress(ax: Axes, ylabel: str = "", xlabel: str = "") -> None:
    """Set the labels of a panel, a light grid, and no box around it."""
    if ylabel:
        ax.set_ylabel(ylabel, fontsize=FONT)
    if xlabel:
        ax.set_xlabel(xlabel, fontsize=FONT)
    ax.tick_params(labelsize=FONT - 0.5, color="#999999", which="both")
    ax.spines[["top", "right"]].set_visible(False)
    ax.spines[["left", "bottom"]].set_color("#999999")
    ax.grid(True, color="#E4E4E4", linewidth=0.6)
    ax.set_axisbelow(True)


def legend_above(ax: Axes, columns: int = 4, *, right: bool = False, math: bool = False) -> None:
    """Put a legend above the panel, where it hides no data; a ``$`` is a plain character unless `math` is set."""
    place: dict[str, Any] = {"loc": "lower right" if right else "lower left", "bbox_to_anchor": (right, 1.0)}
    place |= {"borderaxespad": 0.1, "borderpad": 0.2, "handlelength": 1.8, "columnspacing": 1.2}
    legend = ax.legend(ncols=columns, fontsize=FONT - 0.5, frameon=False, **place)
    for text in legend.get_texts():
        text.set_parse_math(math)
        text.set_text(drawable(text.get_text(), LONGEST_LABEL))


def legend_within(ax: Axes, room: int) -> None:
    """Put a legend above the panel, with as many columns as fit into a width of `room` letters."""
    names = ax.get_legend_handles_labels()[1]
    columns = next(n for n in range(len(names), 0, -1) if n == 1 or sum(_columns(names, n)) <= room)
    legend_above(ax, columns)


def _columns(names: list[str], columns: int) -> list[int]:
    """Widths (letters) of a legend's columns; entries fill column by column, and the first ones may hold one more."""
    rows, longer = divmod(len(names), columns)
    begins = [place * rows + min(place, longer) for place in range(columns + 1)]
    return [max(map(len, names[a:b])) + 6 for a, b in itertools.pairwise(begins)]


def drawable(text: str, longest: int = 1000) -> str:
    """Text of a deck for a picture: printable, shortened, and with a box for each character that the font lacks."""
    text = printable(text, longest)
    if text.isascii():
        return text
    from matplotlib import font_manager

    known = font_manager.get_font(font_manager.findfont(font_manager.FontProperties())).get_charmap()
    return "".join(c if ord(c) in known else "□" for c in text)


def caption(figure: Figure, text: str, color: str = GREY) -> None:
    """Put small print under the figure, wrapped to its width."""
    lines = textwrap.fill(drawable(text), 120, break_on_hyphens=False)
    small = figure.supxlabel(lines, x=0.012, ha="left", fontsize=SMALL, color=color)
    small.set_parse_math(False)


def save(figure: Figure, path: str | Path, *, about: Mapping[str, str] | None = None, dpi: float = 160.0) -> Path:
    """Write a figure as PNG, with the texts in `about`; the file is complete or absent."""
    options: dict[str, Any] = {"format": "png", "dpi": dpi, "pil_kwargs": {"compress_level": 3}}
    return write_aside(Path(path), lambda target: figure.savefig(target, metadata=dict(about or {}), **options))


def engineering(peak: float, unit: str, least: float = 1.0) -> tuple[float, str]:
    """Factor and prefixed unit that scale `peak` to between `least` and 1000 `least`: (1e3, "ms") for 0.05 s."""
    # Powers of a unit take no prefix: 1 kmm^2 would not be 1000 mm^2.
    if "^" in unit:
        return (1e6, "mm²") if unit == "m^2" else (1.0, unit)
    size = abs(peak) / least
    if not np.isfinite(size) or size == 0.0:
        return 1.0, unit
    power = int(np.clip(3 * np.floor(np.log10(size * (1.0 + 1e-12)) / 3.0), -12, 9))
    return 10.0**-power, _PREFIXES[power] + unit


def thin(t: FloatArray, x: FloatArray, bins: int = MAX_BINS) -> tuple[FloatArray, FloatArray]:
    """A curve that looks the same, with the first, last, smallest and largest point (n,) of each bin."""
    width = t.size // bins
    if width < 8:
        return t, x
    blocks = x[: width * bins].reshape(bins, width)
    start = width * np.arange(bins)
    tail = np.arange(width * bins, t.size)
    ends = (start, start + width - 1, start + blocks.argmin(1), start + blocks.argmax(1))
    keep = np.unique(np.concatenate([*ends, tail]))
    return t[keep], x[keep]


def peak_of(values: FloatArray) -> float:
    """Largest absolute value; 0 of an empty array."""
    return float(np.abs(values).max(initial=0.0))


def from_zero(ax: Axes) -> None:
    """Let the scale begin at 0, so that ripple is shown in proportion to the value, and end above the highest one."""
    highest = float(ax.dataLim.ymax)
    top = max(ax.get_ylim()[1], 1.05 * highest if np.isfinite(highest) else 0.0)
    ax.set_ylim(0.0, top if top > 0.0 else 1.0)


def flat(ax: Axes, values: FloatArray) -> None:
    """Widen the scale of a constant signal, which would otherwise show round-off."""
    if values.any() and np.ptp(values) <= 1e-6 * peak_of(values):
        ax.set_ylim(0.95 * values.flat[0], 1.05 * values.flat[0])


GROUND = "0"
Rows = Mapping[str, int]
Extent = tuple[int, int]


@dataclass(frozen=True)
class Place:
    """Where one element stands."""

    element: Element
    column: int
    # top, bottom: Rows of its upper and its lower node
    top: int
    bottom: int
    upright: bool  # Whether its first node is the upper one

    @property
    def gap(self) -> int:
        """The row below which the symbol stands, above the next one."""
        return (self.top + self.bottom - 1) // 2


@dataclass(frozen=True)
class Placement:
    """Places of all elements, the row of every node, and its first and last column."""

    places: tuple[Place, ...]
    rows: Rows
    extents: Mapping[str, Extent]


def place(circuit: Circuit) -> Placement:
    """Places in which no two elements, and no two nodes, meet."""
    level = _levels(circuit)
    order = list(_in_order(circuit, level))
    found = _place_columns(order, level)
    if found is None:
        # Nodes that cannot share a row get one each, and then every element has room in a new column.
        single = {node: row for row, node in enumerate(sorted(level, key=lambda node: level[node]))}
        found = _place_columns(order, single)
    assert found is not None
    return found


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
        sign = {"V": 1.0, "I": -1.0}.get(e.device, 0.0)
        driven[p] += sign
        driven[n] -= sign
    potential = np.linalg.lstsq(matrix, driven, rcond=None)[0].round(9)
    falling = sorted(nodes, key=lambda node: (node == GROUND, -potential[number[node]], number[node]))
    rank = {node: k for k, node in enumerate(falling)}
    above: dict[str, set[str]] = {node: set() for node in nodes}
    for e in circuit.elements:
        upper, lower = sorted(e.nodes[:2], key=lambda node: rank[node])
        above[lower].add(upper)
    level: dict[str, int] = {}
    for node in falling:
        level[node] = max((level[other] + 1 for other in above[node]), default=0)
    # `falling` has ground last, so that no other node's level depends on it.
    level[GROUND] = 1 + max(level[node] for node in nodes if node != GROUND)
    return level


def _in_order(circuit: Circuit, level: Rows) -> Iterator[tuple[Element, Element | None]]:
    """Elements in the order in which they get places, each with the one above it: sources, then chain by chain."""
    areas = {node for e in circuit.elements if e.spec.is_layer for node in e.nodes[2:]}
    fixing = [e for e in circuit.by_device("V", "I") if areas & set(e.nodes[:2])]
    sources = [e for e in circuit.by_device("V", "I") if e not in fixing]
    yield from ((e, None) for e in sources)
    below: dict[str, list[Element]] = {}
    for e in circuit.elements:
        if e.device not in "VI":
            below.setdefault(min(e.nodes[:2], key=lambda node: level[node]), []).append(e)
    for node in sorted(below, key=lambda node: level[node]):
        waiting: list[tuple[Element, Element | None]] = [(e, None) for e in reversed(below.pop(node, []))]
        while waiting:
            e, before = waiting.pop()
            yield e, before
            lower = max(e.nodes[:2], key=lambda node: level[node])
            waiting += [(other, e) for other in reversed(below.pop(lower, []))]
    yield from ((e, None) for e in fixing)


def _place_columns(order: Sequence[tuple[Element, Element | None]], rows: Rows) -> Placement | None:
    """Each element in the first column with room for it; None if nodes of one row would meet."""
    places: dict[str, Place] = {}
    taken: list[list[Place]] = []
    extents: dict[str, Extent] = {}
    for element, before in order:
        ends = element.nodes[:2]
        top, bottom = sorted(rows[node] for node in ends)
        preferred = [places[before.name].column] if before is not None else []
        for column in (*preferred, *range(len(taken) + 1)):
            room = column == len(taken) or all(p.bottom <= top or p.top >= bottom for p in taken[column])
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
        if column == len(taken):
            taken.append([])
        upright = rows[ends[0]] < rows[ends[1]]
        places[element.name] = Place(element, column, top, bottom, upright)
        taken[column].append(places[element.name])
        extents = after
    return Placement(tuple(places.values()), rows, extents)
