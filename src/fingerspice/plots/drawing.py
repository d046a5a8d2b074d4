"""Tools of every picture: figure, axes, legend, caption, colours, units and file.

Figures are made with matplotlib's object API, without pyplot and its global state; matplotlib is imported when the
first figure is made.
"""

from __future__ import annotations

import textwrap
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fingerspice.base.arrays import FloatArray
from fingerspice.base.errors import printable
from fingerspice.base.files import write_aside

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Figure

    from fingerspice.plots.picture import Picture as Picture


# The palette of Okabe and Ito, whose colours people with the common colour blindnesses can distinguish.
BLACK, GREY, BLUE, VERMILION = "#000000", "#777777", "#0072B2", "#D55E00"
GREEN, PURPLE, ORANGE, SKY = "#009E73", "#CC79A7", "#E69F00", "#56B4E9"

FONT, SMALL, WIDTH = 8.5, 7.0, 7.0  # Font sizes (points) and width (inches) of a figure across a page
MAX_BINS = 4000  # Number of bins into which long curves are divided: larger than the number of dots across the page
LONGEST_LABEL = 60  # Largest number of characters of a name in a legend
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


def dress(ax: Axes, ylabel: str = "", xlabel: str = "", **options: Any) -> None:
    """Set the labels of a panel, a light grid, no box around it, and `options` of ``Axes.set``: scales and limits."""
    if ylabel:
        ax.set_ylabel(ylabel, fontsize=FONT)
    if xlabel:
        ax.set_xlabel(xlabel, fontsize=FONT)
    ax.tick_params(labelsize=FONT - 0.5, color="#999999", which="both")
    ax.spines[["top", "right"]].set_visible(False)
    ax.spines[["left", "bottom"]].set_color("#999999")
    ax.grid(True, color="#E4E4E4", linewidth=0.6)
    ax.set_axisbelow(True)
    ax.set(**options)


def legend_above(ax: Axes, columns: int = 4, *, right: bool = False, math: bool = False) -> None:
    """Put a legend above the panel, where it hides no data; a ``$`` is a plain character unless `math` is set."""
    place: dict[str, Any] = {"loc": "lower right" if right else "lower left", "bbox_to_anchor": (right, 1.0)}
    place |= {"borderaxespad": 0.1, "borderpad": 0.2, "handlelength": 1.8, "columnspacing": 1.2}
    for text in ax.legend(ncols=columns, fontsize=FONT - 0.5, frameon=False, **place).get_texts():
        text.set_parse_math(math)
        text.set_text(drawable(text.get_text(), LONGEST_LABEL))


def legend_within(ax: Axes, room: int) -> None:
    """Put a legend above the panel, with as many columns as fit into a width of `room` letters."""
    names = ax.get_legend_handles_labels()[1]

    def width(columns: int) -> int:
        # Entries fill column by column, and the first ones may hold one more.
        return sum(max(map(len, column)) + 6 for column in np.array_split(names, columns))

    legend_above(ax, next(n for n in range(len(names), 0, -1) if n == 1 or width(n) <= room))


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
    figure.supxlabel(lines, x=0.012, ha="left", fontsize=SMALL, color=color, parse_math=False)


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
    ends = (start, start + width - 1, start + blocks.argmin(1), start + blocks.argmax(1))
    keep = np.unique(np.concatenate([*ends, np.arange(width * bins, t.size)]))
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
    """Plain numbers on the scale of a signal, and a wider one of a constant signal, which would show round-off."""
    ax.ticklabel_format(axis="y", useOffset=False)
    if values.any() and np.ptp(values) <= 1e-6 * peak_of(values):
        ax.set_ylim(0.95 * values.flat[0], 1.05 * values.flat[0])
