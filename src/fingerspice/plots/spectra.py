"""Picture of a spectrum: lines, or a density with its uncertainty."""

from __future__ import annotations

from typing import TYPE_CHECKING

from fingerspice.plots import drawing, lines
from fingerspice.results.signals import SIGNALS

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from fingerspice.base.arrays import FloatArray
    from fingerspice.plots.picture import Picture
    from fingerspice.results.spectrum import Spectrum

#: Amplitudes below this fraction of the largest are not drawn: they are mostly numerical errors of the run.
_DRAWN = 1e-6


def plot_spectrum(spectrum: Spectrum) -> Picture:
    """Amplitudes of the lines, or the density with its confidence interval, against frequency, on logarithmic axes."""
    figure, (ax,) = drawing.new_figure(1, height=3.4)
    name = spectrum.signal.partition(":")[0]
    color, unit = lines.QUANTITIES[name].color, spectrum.unit.replace("^2", "²")
    label = f"{SIGNALS[name][1].capitalize()} {spectrum.signal.partition(':')[2]}".rstrip()
    if spectrum.amplitude is not None:
        least = _DRAWN * drawing.peak_of(spectrum.amplitude)
        stems(ax, spectrum.frequency, spectrum.amplitude, least, color=color)
        drawing.dress(ax, f"{label}: amplitude [{unit}]", "Frequency [Hz]")
        small = f"Fourier integrals over a period; {spectrum.frequency.size} lines, {spectrum.resolution:.4g} Hz apart"
    else:
        _band(ax, spectrum, color)
        drawing.dress(ax, f"{label}: density [{unit}²/Hz]", "Frequency [Hz]")
        small = (
            f"Welch's density, {spectrum.resolution:.4g} Hz wide, with the interval that holds the true one with a "
            f"probability of 95 %, as of {spectrum.segments:.3g} independent segments"
        )
    if not ax.lines:
        ax.text(0.5, 0.5, "constant", transform=ax.transAxes, ha="center", fontsize=drawing.FONT)
    rms = spectrum.variance**0.5
    drawing.caption(figure, f"{small} · mean {spectrum.mean:.4g} {unit}, rms about it {rms:.4g} {unit}")
    return figure


def _band(ax: Axes, spectrum: Spectrum, color: str) -> None:
    """Draw a density and its confidence interval at frequencies above 0 where the density is not zero."""
    assert spectrum.density is not None
    assert spectrum.lower is not None
    assert spectrum.upper is not None
    some = (spectrum.frequency > 0.0) & (spectrum.density > 0.0)
    if some.any():
        f = spectrum.frequency[some]
        ax.fill_between(f, spectrum.lower[some], spectrum.upper[some], color=color, alpha=0.25, linewidth=0.0)
        ax.loglog(f, spectrum.density[some], color=color, linewidth=1.2)


def stems(
    ax: Axes, f: FloatArray, size: FloatArray, least: float, *, color: str, marker: str = "o", label: str = "_"
) -> None:
    """Draw the lines of a spectrum that are larger than `least`, from the bottom of a logarithmic panel."""
    some = size > least
    if not some.any():
        return
    ax.set_xscale("log")
    ax.set_yscale("log")
    ax.plot(f[some], size[some], color=color, marker=marker, markersize=3.5, linestyle="none", label=label)
    ax.vlines(f[some], least, size[some], color=color, linewidth=1.0)
    ax.set_ylim(bottom=least)
