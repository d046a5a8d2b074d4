"""Picture of a drive and the friction that it makes."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from fingerspice.plots import drawing

if TYPE_CHECKING:
    from fingerspice.plots.picture import Picture
    from fingerspice.studies.inverse import InverseDrive


def plot_inverse(found: InverseDrive) -> Picture:
    """Drive, and wanted and reached friction, over time.

    Parameters
    ----------
    found : InverseDrive
    """
    figure, (top, bottom) = drawing.new_figure(2, height=4.4, sharex=True)
    second, unit_t = drawing.engineering(float(found.t[-1]), "s")
    volt, unit_u = drawing.engineering(drawing.peak_of(found.drive.values), "V")
    t, x = drawing.thin(found.t, found.drive.values)
    top.plot(second * t, volt * x, color=drawing.BLUE, linewidth=0.8)
    drawing.dress(top, f"Drive {found.source}, {unit_u}")
    wanted, reached = found.friction(found.wanted), found.friction(found.reached)
    newton, unit_f = drawing.engineering(drawing.peak_of(wanted[np.isfinite(wanted)]), "N")
    style = {"color": drawing.VERMILION, "linestyle": drawing.DASHES[1], "linewidth": 1.4}
    for values, name, how in (
        (reached, "reached", {"color": drawing.BLACK, "linewidth": 1.0}),
        (wanted, "wanted", style),
    ):
        t, x = drawing.thin(found.t[np.isfinite(values)], values[np.isfinite(values)])
        bottom.plot(second * t, newton * x, label=name, **how)
    for ax in (top, bottom):
        edges = np.flatnonzero(np.diff(np.concatenate([[False], found.limited, [False]]).astype(int)))
        for first, last in edges.reshape(-1, 2):
            ax.axvspan(
                second * found.t[first], second * found.t[last - 1], color=drawing.GREY, alpha=0.2, linewidth=0.0
            )
    drawing.dress(bottom, f"Friction, {unit_f}", f"Time, {unit_t}")
    drawing.legend_above(bottom)
    mean = "" if found.carrier is None else f" · mean over a period of the carrier of {found.carrier:g} Hz"
    limited = " · grey: a limit decides the drive" if found.limited.any() else ""
    drawing.caption(figure, f"wanted and reached differ by at most {100.0 * found.missed_share:.2g} % of the largest "
                    f"force wanted{mean}{limited}")  # fmt: skip
    figure.align_ylabels([top, bottom])
    return figure
