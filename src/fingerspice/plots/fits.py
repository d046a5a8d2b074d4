"""Picture of a fit: data and prediction, with the residuals below."""

from __future__ import annotations

import numpy as np

from fingerspice.base.arrays import FloatArray, IntArray
from fingerspice.plots import drawing
from fingerspice.plots.picture import Picture

# Ratio of the largest to the smallest abscissa from which on the axis is logarithmic.
_WIDE = 20.0


def plot_fit(
    x: FloatArray, x_label: str, groups: IntArray, names: list[str], measured: FloatArray, predicted: FloatArray,
    sigma: FloatArray, signal: str, unit: str,
) -> Picture:  # fmt: skip
    """Data with error bars (one standard deviation) and the fit against `x`, and the residuals over sigma below.

    Parameters
    ----------
    x : ndarray, shape (n,)
    x_label : str
    groups : ndarray of int, shape (n,)
        Which data belong together; each group has a colour and a line, with the name in `names`.
    names : list of str
    measured, predicted, sigma : ndarray, shape (n,)
        In `unit`.
    signal, unit : str

    Returns
    -------
    Picture
    """
    figure, axes = drawing.new_figure(2, height=4.2, sharex=True, height_ratios=(2.4, 1.0))
    factor, shown = drawing.engineering(drawing.peak_of(measured), unit, 0.05) if unit else (1.0, "")
    axes[1].axhline(0.0, color=drawing.GREY, linewidth=0.8)
    for group, name in enumerate(names):
        own = np.flatnonzero(groups == group)
        own = own[np.argsort(x[own], kind="stable")]
        color = drawing.CYCLE[group % len(drawing.CYCLE)]
        axes[0].errorbar(
            x[own], factor * measured[own], factor * sigma[own], fmt="o", markersize=3.5, color=color, elinewidth=0.8,
            capsize=2.0, label=name,
        )  # fmt: skip
        axes[0].plot(x[own], factor * predicted[own], color=color, linewidth=1.3)
        axes[1].plot(x[own], (measured[own] - predicted[own]) / sigma[own], "o", markersize=3.5, color=color)
    if x.min() > 0.0 and x.max() > _WIDE * x.min():
        axes[1].set_xscale("log")
    drawing.dress(axes[0], f"{signal} [{shown}]" if shown else signal)
    drawing.legend_within(axes[0], 90)
    drawing.dress(axes[1], "residual / sigma", x_label)
    drawing.caption(figure, "dots: measured, with one standard deviation; lines: fitted")
    return figure
