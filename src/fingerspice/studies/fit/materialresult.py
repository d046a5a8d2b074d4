"""The result of a material's fit: a ladder, its misfit to the data and that of any material, its page and picture."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from fingerspice.base.arrays import ComplexArray, FloatArray
from fingerspice.base.pages import Page, Shown, Table
from fingerspice.base.units import format_si
from fingerspice.physics.ladder import Ladder
from fingerspice.physics.materials import EPS0
from fingerspice.waveforms.waveform import require

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class Consistency:
    """Distance of data from the nearest causal and passive material (relations of Kramers and Kronig).

    Attributes
    ----------
    rms, largest : float
        Misfit ``|y_fit / y - 1|`` of the best sum of Debye terms with densely placed poles.
    frequency, misfit : ndarray, shape (n,)
        The misfit at each frequency (Hz).
    systematic : float
        Correlation of the complex misfits of neighbouring frequencies: about 0 for noise, near 1 for a drift or a wrong
        scale of a column.
    """

    rms: float
    largest: float
    frequency: FloatArray
    misfit: FloatArray
    systematic: float


@dataclass(frozen=True, repr=False)
class MaterialFit(Shown):
    """A ladder fitted to data.

    Attributes
    ----------
    ladder : Ladder
    rms, largest : float
        Misfit ``|y_fit / y - 1|`` over the data.
    frequency : ndarray, shape (n,)
        Frequencies of the data, Hz.
    misfit : ndarray, shape (n,)
        Misfit at each frequency.
    kramers_kronig : Consistency
        Smallest misfit that any ladder can have.
    data : ndarray of complex, shape (n,)
        Admittivity of the data, S/m.
    """

    ladder: Ladder
    rms: float
    largest: float
    frequency: FloatArray
    misfit: FloatArray
    kramers_kronig: Consistency
    data: ComplexArray

    def _page(self) -> Page:
        ladder, f = self.ladder, self.frequency
        rows = [
            (format_si(p / (2.0 * math.pi), "Hz"), f"{k:.4g} S/m")
            for p, k in zip(ladder.poles, ladder.weights, strict=True)
        ]
        return Page(
            [
                f"material fitted at {f.size} frequencies from {format_si(float(f[0]), 'Hz')} to "
                f"{format_si(float(f[-1]), 'Hz')}",
                f"misfit of the admittivity: {100.0 * self.rms:.2g} % rms, {100.0 * self.largest:.2g} % at most",
                f"no causal and passive material comes nearer than {100.0 * self.kramers_kronig.rms:.2g} % rms",
                "",
                f"{ladder.conductivity:.4g} S/m at zero frequency, eps_r = {ladder.eps_inf:.4g} above all poles, and",
                Table(("pole", "weight"), rows),
            ]
        )

    def to_netlist(self, name: str) -> str:
        """A subcircuit of slabs in series with the thickness as parameter, for decks here and in ngspice.

        Write it to ``myskin.lib`` in the folder of the deck; ``.include myskin.lib`` and
        ``Xskin skin 0 area NAME d=350u`` then replace a SKIN.

        Raises
        ------
        InputError
            If the name is not allowed in a netlist.
        """
        require(name.isidentifier(), "name", repr(name), "letters, digits and _, not first a digit")
        eps_r, rho = self.ladder.cells()
        nodes = ["p", *(f"c{i}" for i in range(1, eps_r.size)), "n"]
        lines = [
            f"X{i + 1} {nodes[i]} {nodes[i + 1]} area SLAB d={{d}} eps_r={eps:.10g} rho={resistivity:.10g}"
            for i, (eps, resistivity) in enumerate(zip(eps_r, rho, strict=True))
        ]
        return "\n".join([f".subckt {name} p n area params: d=350u", *lines, ".ends", ""])

    def plot(self) -> Figure:
        """Resistivity and permittivity of the data and of the ladder, and the misfit, against frequency."""
        from fingerspice.plots import drawing

        figure, axes = drawing.new_figure(1, 3, height=2.7)
        limit, small, fine = self.kramers_kronig, drawing.FONT - 0.5, {"color": drawing.BLUE, "linewidth": 1.4}
        f = np.geomspace(self.frequency[0], self.frequency[-1], 400)
        measured = 1.0 / self.data.real, self.data.imag / (2.0 * np.pi * self.frequency * EPS0)
        fitted = self.ladder.resistivity(f), self.ladder.permittivity(f)
        for ax, points, line in zip(axes, measured, fitted, strict=False):
            ax.loglog(self.frequency, points, "o", color=drawing.GREY, markersize=2.5, label="data")
            ax.loglog(f, line, label=f"ladder of {len(self.ladder.poles)} poles", **fine)
        axes[2].semilogx(self.frequency, 100.0 * self.misfit, label="ladder", **fine)
        axes[2].semilogx(
            limit.frequency, 100.0 * limit.misfit, "--", color=drawing.VERMILION, linewidth=1.0, label="any material"
        )  # fmt: skip
        for ax, label in zip(axes, ("Resistivity [Ω m]", "Relative permittivity", "Misfit [%]"), strict=True):
            drawing.dress(ax, label, "Frequency [Hz]")
        for ax in (axes[0], axes[2]):
            ax.legend(fontsize=small, frameon=False)
        drawing.caption(
            figure,
            f"misfit {100.0 * self.rms:.2g} % rms; no causal and passive material is nearer than "
            f"{100.0 * limit.rms:.2g} % rms",
        )
        return figure
