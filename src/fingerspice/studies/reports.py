"""Page and picture of a fitted material."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from fingerspice.base.pages import Page, Table
from fingerspice.base.units import format_si
from fingerspice.physics.materials import EPS0
from fingerspice.plots import drawing

if TYPE_CHECKING:
    from fingerspice.plots.picture import Picture
    from fingerspice.studies.fitting import MaterialFit


def plot_material(fit: MaterialFit) -> Picture:
    """Resistivity and permittivity as measured and as fitted, and the misfit of the admittivity, against frequency."""
    figure, axes = drawing.new_figure(1, 3, height=2.7)
    f = np.geomspace(fit.frequency[0], fit.frequency[-1], 400)
    measured = 1.0 / fit.data.real, fit.data.imag / (2.0 * np.pi * fit.frequency * EPS0)
    fitted = fit.ladder.resistivity(f), fit.ladder.permittivity(f)
    labels = "Resistivity [Ω m]", "Relative permittivity"
    for ax, points, line, label in zip(axes[:2], measured, fitted, labels, strict=True):
        ax.loglog(fit.frequency, points, color=drawing.GREY, marker="o", markersize=2.5, linestyle="none", label="data")
        ax.loglog(f, line, color=drawing.BLUE, linewidth=1.4, label=f"ladder of {len(fit.ladder.poles)} poles")
        drawing.dress(ax, label, "Frequency [Hz]")
    limit = fit.kramers_kronig
    axes[2].semilogx(fit.frequency, 100.0 * fit.misfit, color=drawing.BLUE, linewidth=1.4, label="ladder")
    axes[2].semilogx(
        limit.frequency,
        100.0 * limit.misfit,
        color=drawing.VERMILION,
        linewidth=1.0,
        linestyle="--",
        label="any material",
    )
    drawing.dress(axes[2], "Misfit [%]", "Frequency [Hz]")
    for ax in (axes[0], axes[2]):
        ax.legend(fontsize=drawing.FONT - 0.5, frameon=False)
    drawing.caption(
        figure,
        f"misfit {100.0 * fit.rms:.2g} % rms; no causal and passive material is nearer than "
        f"{100.0 * limit.rms:.2g} % rms",
    )
    return figure


def fit_page(fit: MaterialFit) -> Page:
    """A fitted ladder: its branches, and its misfit to the data."""
    ladder = fit.ladder
    rows = [
        (format_si(p / (2.0 * math.pi), "Hz"), f"{k:.4g} S/m")
        for p, k in zip(ladder.poles, ladder.weights, strict=True)
    ]
    f = fit.frequency
    return Page(
        [
            f"material fitted at {f.size} frequencies from {format_si(float(f[0]), 'Hz')} to "
            f"{format_si(float(f[-1]), 'Hz')}",
            f"misfit of the admittivity: {100.0 * fit.rms:.2g} % rms, {100.0 * fit.largest:.2g} % at most",
            f"no causal and passive material comes nearer than {100.0 * fit.kramers_kronig.rms:.2g} % rms",
            "",
            f"{ladder.conductivity:.4g} S/m at zero frequency, eps_r = {ladder.eps_inf:.4g} above all poles, and",
            Table(("pole", "weight"), rows),
        ]
    )
