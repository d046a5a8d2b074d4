"""Picture of the skin's acceleration and of the threshold of perception, against frequency."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from fingerspice.plots import drawing
from fingerspice.plots.traces import stems

if TYPE_CHECKING:
    from fingerspice.plots.picture import Picture
    from fingerspice.studies.feel import Feel

_MARKERS = "osD^vP"
#: The vertical axis reaches down to the threshold, but spans at most this factor.
_DEPTH = 1e7
#: The frequency axis ends at this multiple of the threshold's highest frequency.
_BEYOND = 5.0
#: Largest number of lines whose level is written in the picture.
_NAMED = 6


def plot_feel(feels: Sequence[Feel]) -> Picture:
    """Acceleration of the skin over frequency, of one finger or several, against the threshold of the first.

    Parameters
    ----------
    feels : sequence of Feel
    """
    figure, (ax,) = drawing.new_figure(1, height=4.0)
    first = feels[0]
    table = first.threshold
    ends = max(float(table.frequency[0]), 1e-3), _BEYOND * float(table.frequency[-1])
    f = np.geomspace(ends[0], table.frequency[-1], 400)
    curve = table.acceleration(f)
    drawn = [(one.frequency >= ends[0]) & (one.frequency <= ends[1]) for one in feels]
    highest = max(drawing.peak_of(one.acceleration[some]) for one, some in zip(feels, drawn, strict=True))
    top = 3.0 * max(float(curve.max()), highest)
    bottom = max(top / _DEPTH, 0.3 * float(curve.min()))
    ax.fill_between(f, bottom, curve, color=drawing.GREY, alpha=0.15, linewidth=0.0)
    ax.plot(f, curve, color=drawing.BLACK, linewidth=1.4, label=table.name)
    for number, (one, some) in enumerate(zip(feels, drawn, strict=True)):
        style: dict[str, Any] = {"color": drawing.CYCLE[number % 6], "marker": _MARKERS[number % 6]}
        name = f"skin, {one.kind}" + (f" {one.signal.partition(':')[2]}" if ":" in one.signal else "")
        stems(ax, one.frequency[some], one.acceleration[some], bottom, label=name, **style)
        loud = np.flatnonzero(one.level >= 0.0)
        for i in loud[np.argsort(one.level[loud])[::-1][:_NAMED]]:
            place: dict[str, Any] = {
                "xytext": (0, 4),
                "textcoords": "offset points",
                "ha": "center",
                "fontsize": drawing.SMALL,
            }
            ax.annotate(f"{one.level[i]:+.0f}", (one.frequency[i], one.acceleration[i]), color=style["color"], **place)
    ax.set_xscale("log")
    ax.set_yscale("log")
    ax.set_xlim(*ends)
    ax.set_ylim(bottom, top)
    drawing.dress(ax, "Acceleration amplitude [m/s²]", "Frequency [Hz]")
    drawing.legend_above(ax, 3)
    m = first.mechanics
    said = "; ".join(one.verdict() for one in feels)
    low, high = table.frequency[[0, -1]]
    drawing.caption(
        figure,
        f"{said} · numbers: dB above the threshold; grey: not felt; nothing is known beyond {low:g} to {high:g} Hz · "
        f"threshold: {table.source} · skin: {m.name}, {1e3 * m.mass:g} g, {m.damping:g} N s/m, "
        f"{1e-3 * m.stiffness:g} N/mm",
    )
    return figure
