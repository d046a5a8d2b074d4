"""Picture of a fit: data and prediction, with the residuals below."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from fingerspice.base.arrays import FloatArray
from fingerspice.plots import drawing
from fingerspice.plots.picture import Picture

# Ratio of the largest to the smallest abscissa from which on the axis is logarithmic.
_WIDE = 20.0


class Curve(NamedTuple):
    """Data that belong together, shape (n,) each: abscissa, measured and fitted values, and standard deviations."""

    name: str
    x: FloatArray
    measured: FloatArray
    fitted: FloatArray
    sigma: FloatArray


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
    figure, axes = drawing.new_figure(2, height=4.2, sharex=True, height_ratios=(2.4, 1.0))
    largest = np.concatenate([curve.measured for curve in curves])
    factor, shown = drawing.engineering(drawing.peak_of(largest), unit, 0.05) if unit else (1.0, "")
    axes[1].axhline(0.0, color=drawing.GREY, linewidth=0.8)
    for number, curve in enumerate(curves):
        order, color = np.argsort(curve.x, kind="stable"), drawing.CYCLE[number % len(drawing.CYCLE)]
        x, measured, fitted, sigma = (values[order] for values in curve[1:])
        axes[0].errorbar(
            x, factor * measured, factor * sigma, fmt="o", markersize=3.5, color=color, elinewidth=0.8, capsize=2.0,
            label=curve.name,
        )  # fmt: skip
        axes[0].plot(x, factor * fitted, color=color, linewidth=1.3)
        axes[1].plot(x, (measured - fitted) / sigma, "o", markersize=3.5, color=color)
    x = np.concatenate([curve.x for curve in curves])
    if x.min() > 0.0 and x.max() > _WIDE * x.min():
        axes[1].set_xscale("log")
    drawing.dress(axes[0], f"{signal} [{shown}]" if shown else signal)
    drawing.legend_within(axes[0], 90)
    drawing.dress(axes[1], "residual / sigma", x_label)
    drawing.caption(figure, "dots: measured, with one standard deviation; lines: fitted")
    return figure
