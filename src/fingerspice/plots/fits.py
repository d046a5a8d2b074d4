"""Picture of a fit: data and prediction, with the residuals below."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from fingerspice.base.arrays import FloatArray
from fingerspice.plots import drawing
from fingerspice.plots.picture import Picture

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Ratio of the largest to the smallest abscissa from which on the axis is logarithmic.
_WIDE = 20.0
# Letters of a legend across the page; beside other panels one curve needs none.
_ROOM = 90


class Curve(NamedTuple):
    """Data that belong together, shape (n,) each: abscissa, measured and fitted values, and standard deviations."""

    name: str
    x: FloatArray
    measured: FloatArray
    fitted: FloatArray
    sigma: FloatArray


class Panel(NamedTuple):
    """Curves of one quantity over one abscissa."""

    curves: Sequence[Curve]
    x_label: str
    quantity: str
    unit: str


def plot_fit(curves: Sequence[Curve], x_label: str, signal: str, unit: str) -> Picture:
    """Data with error bars (one standard deviation) and the fit, and the residuals over sigma below.

    Parameters
    ----------
    curves : sequence of Curve
        Each has a colour and a line.
    x_label, signal, unit : str

    Returns
    -------
    Picture
    """
    return plot_panels([Panel(curves, x_label, signal, unit)])


def plot_panels(panels: Sequence[Panel]) -> Picture:
    """Data with error bars and the fit of several quantities side by side, each with its residuals below."""
    count = len(panels)
    figure, axes = drawing.new_figure(2, count, height=4.2, sharex="col", height_ratios=(2.4, 1.0))
    for place, panel in enumerate(panels):
        _draw(axes[place], axes[count + place], panel, _ROOM // count, first=place == 0)
    drawing.caption(figure, "dots: measured, with one standard deviation; lines: fitted")
    return figure


def _draw(top: Axes, bottom: Axes, panel: Panel, room: int, *, first: bool) -> None:
    largest = np.concatenate([curve.measured for curve in panel.curves])
    # An area is shown in mm^2: a prefix would be squared with its unit.
    factor, shown = (1e6, "mm²") if panel.unit == "m^2" else (1.0, "")
    if panel.unit not in ("", "m^2"):
        factor, shown = drawing.engineering(drawing.peak_of(largest), panel.unit, 0.05)
    bottom.axhline(0.0, color=drawing.GREY, linewidth=0.8)
    for number, curve in enumerate(panel.curves):
        order, color = np.argsort(curve.x, kind="stable"), drawing.CYCLE[number % len(drawing.CYCLE)]
        x, measured, fitted, sigma = (values[order] for values in curve[1:])
        top.errorbar(
            x, factor * measured, factor * sigma, fmt="o", markersize=3.5, color=color, elinewidth=0.8, capsize=2.0,
            label=curve.name,
        )  # fmt: skip
        top.plot(x, factor * fitted, color=color, linewidth=1.3)
        bottom.plot(x, (measured - fitted) / sigma, "o", markersize=3.5, color=color)
    x = np.concatenate([curve.x for curve in panel.curves])
    if x.min() > 0.0 and x.max() > _WIDE * x.min():
        from matplotlib.ticker import LogFormatter

        bottom.set_xscale("log")
        # Plain numbers: 20, 50, 100, and no powers of ten.
        bottom.xaxis.set_major_formatter(LogFormatter())
        bottom.xaxis.set_minor_formatter(LogFormatter(minor_thresholds=(2.0, 0.5)))
    drawing.dress(top, f"{panel.quantity} [{shown}]" if shown else panel.quantity)
    if len(panel.curves) > 1 or room == _ROOM:
        drawing.legend_within(top, room)
    drawing.dress(bottom, "residual / sigma" if first else "", panel.x_label)
