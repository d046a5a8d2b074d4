"""Perception of a run: the skin's motion under the friction's spectrum, and its level above a threshold."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from fingerspice.base.arrays import FloatArray
from fingerspice.base.errors import InputError
from fingerspice.base.pages import Page, Shown, Table
from fingerspice.base.units import format_si
from fingerspice.plots import drawing
from fingerspice.plots.traces import stems
from fingerspice.results.signals import Sealed
from fingerspice.studies.perception import (
    DIFFERENCE_DB,
    FASTEST_FELT,
    FINGERPAD,
    WEBER_FRICTION,
    SkinMechanics,
    Threshold,
    android_threshold,
)
from fingerspice.waveforms.waveform import require

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from fingerspice.results.solution import Solution
    from fingerspice.results.spectrum import Spectrum

#: Upper edge of a third-octave band, relative to its middle (one band's middle is 1 kHz); fewest bins in a band.
_EDGE, _FEWEST = 2.0 ** (1.0 / 6.0), 2
#: Lines weaker than this fraction of the strongest acceleration are round-off, and are left out.
_NOTHING = 1e-9
#: Largest number of rows in a report, and of lines whose level is written in the picture.
_SHOWN, _NAMED = 10, 6
_MARKERS = "osD^vP"
#: In the picture the vertical axis reaches down to the threshold, but spans at most the factor _DEPTH. The frequency
#: axis ends at _BEYOND times the threshold's highest frequency.
_DEPTH, _BEYOND = 1e7, 5.0


class Unjudged(NamedTuple):
    """Friction that the threshold cannot judge: outside its frequencies, or slower than the lowest band."""

    level: float  # Highest level above the threshold that it may have, dB (`Threshold.beyond`)
    force: float  # Amplitude, N
    frequency: float  # Hz; of what is slower than the lowest band, that band's lower edge
    slower: bool

    def __str__(self) -> str:
        part = f"{format_si(self.force, 'N')} {'below' if self.slower else 'at'} {format_si(self.frequency, 'Hz')}"
        why = "which only a longer run resolves" if self.slower else "outside the threshold's frequencies"
        too = "fast" if self.frequency > FASTEST_FELT and not self.slower else "weak"
        return f"{part}, {why}, {'may be felt' if self.level >= 0.0 else f'is too {too} to be felt'}"


@dataclass(frozen=True, repr=False)
class Feel(Sealed, Shown):
    """Estimated perception of a friction force: by spectral lines if it is periodic, else by third-octave bands.

    The threshold was measured with a device held in the hand, and the skin is modelled as one mass on a spring, so a
    level is an estimate for comparing drives, not a measurement. Sounds, warmth and edges are not modelled.

    Attributes
    ----------
    signal : str
        The friction force: ``f_t``, or ``f_t:GAP`` for one of several fingers.
    kind : str
        ``"lines"`` or ``"bands"``; the amplitude of a band is that of a sine with the same rms.
    frequency : ndarray, shape (n,)
        Frequencies of the lines, or middles of the bands, Hz.
    force, displacement, acceleration : ndarray, shape (n,)
        Amplitudes of the friction force (N), and of the skin's movement (m, m/s^2).
    level : ndarray, shape (n,)
        Level of the acceleration above the threshold, dB; NaN outside the threshold's frequencies.
    change : float
        Peak-to-peak change of the friction relative to its highest value, for a sine with the rms of the lines or bands
        within the threshold's frequencies.
    unjudged : Unjudged or None
        The friction that the threshold cannot judge and that may have the highest level.
    mechanics : SkinMechanics
    threshold : Threshold
    """

    signal: str
    kind: str
    frequency: FloatArray
    force: FloatArray
    displacement: FloatArray
    acceleration: FloatArray
    level: FloatArray
    change: float
    unjudged: Unjudged | None
    mechanics: SkinMechanics
    threshold: Threshold

    @property
    def _columns(self) -> tuple[FloatArray, ...]:
        return self.frequency, self.force, self.displacement, self.acceleration, self.level

    @property
    def strongest(self) -> int | None:
        """Index of the line or band with the highest level; None if none is within the threshold's frequencies."""
        return int(np.nanargmax(self.level)) if np.isfinite(self.level).any() else None

    @property
    def highest(self) -> float | None:
        """The highest level, dB; None if no line or band is within the threshold's frequencies."""
        return None if self.strongest is None else float(self.level[self.strongest])

    @property
    def felt(self) -> bool | None:
        """Whether some line or band reaches the threshold; None if none does, but what it cannot judge may be felt."""
        return self._or_unknown(self.highest is not None and self.highest >= 0.0)

    @property
    def change_felt(self) -> bool | None:
        """Whether the change reaches Weber's fraction of 0.11 (`perception.WEBER_FRICTION`); None as for `felt`."""
        return self._or_unknown(self.change >= WEBER_FRICTION)

    def _or_unknown(self, felt: bool) -> bool | None:
        """`felt`, or None where it is False and what cannot be judged may be felt."""
        return None if not felt and self.unjudged is not None and self.unjudged.level >= 0.0 else felt

    @property
    def steps(self) -> float | None:
        """The highest level in difference thresholds of 1.21 dB (`perception.DIFFERENCE_DB`); None if not felt."""
        return self.highest / DIFFERENCE_DB if self.highest is not None and self.felt else None

    def to_dict(self) -> dict[str, Any]:
        """The keys of ``--json``; lines outside the threshold's frequencies are left out."""
        rows = zip(*(x[np.isfinite(self.level)] for x in self._columns), strict=True)
        keys = ("frequency", "force", "displacement", "acceleration", "level_db")
        place = self.strongest
        return {
            "element": self.signal.partition(":")[2] or None,
            "felt": self.felt,
            "kind": self.kind,
            "strongest": None if place is None else float(self.frequency[place]),
            "level_db": self.highest,
            "unjudged": None if self.unjudged is None else self.unjudged._asdict(),
            "difference_steps": self.steps,
            "friction_change": self.change,
            "friction_change_felt": self.change_felt,
            "mechanics": dict(vars(self.mechanics)),
            "threshold": {"name": self.threshold.name, "source": self.threshold.source},
            "lines": [dict(zip(keys, map(float, row), strict=True)) for row in rows],
        }  # fmt: skip

    def _page(self) -> Page:
        what = "line" if self.kind == "lines" else "band around"
        blocks: list[str | Table] = [self.verdict()]
        judged = np.flatnonzero(np.isfinite(self.level))
        if judged.size:
            shown = np.sort(judged[np.argsort(self.level[judged])[::-1][:_SHOWN]])
            units = ("Hz", "N", "m", "m/s^2")
            rows = [
                (*(format_si(float(x[i]), unit) for x, unit in zip(self._columns, units, strict=False)),
                 f"{self.level[i]:+.1f} dB")
                for i in shown
            ]  # fmt: skip
            blocks += ["", Table((what, "friction", "skin moves", "accelerates", "above threshold"), rows), ""]
        blocks.append(
            f"friction changes by {100.0 * self.change:.3g} % within these frequencies; "
            f"{100.0 * WEBER_FRICTION:g} % are noticed as a transient reduction"
        )
        blocks.append(f"threshold: {self.threshold.name} ({self.threshold.source})")
        blocks.append(f"skin: {self.mechanics.name}: {self.mechanics.said}")
        return Page(blocks)

    def verdict(self) -> str:
        """A sentence: whether it is felt, at which frequency most, the level, and friction that cannot be judged."""
        finger = f"finger {self.signal.partition(':')[2]}: " if ":" in self.signal else ""
        place = self.strongest
        low, high = self.threshold.frequency[[0, -1]]
        if place is None:
            said = f"no part of the friction lies between {low:g} and {high:g} Hz"
        else:
            at = format_si(float(self.frequency[place]), "Hz")
            where = f"at {at}" if self.kind == "lines" else f"in the third octave around {at}"
            steps = "" if self.steps is None else f" ({self.steps:.0f} noticeable steps)"
            side = "above" if steps else "below"
            said = f"strongest {where}, {abs(self.level[place]):.1f} dB {side} the threshold{steps}"
        if self.unjudged is not None and (self.unjudged.level >= 0.0 or not self.felt):
            said += f"; {self.unjudged}"
        verdict = {True: "felt", False: "not felt", None: "not known whether felt"}[self.felt]
        return f"{finger}{verdict}: {said}"

    def plot(self, others: Sequence[Feel] = ()) -> Figure:
        """Draw the acceleration, also that of other fingers, and the threshold against frequency.

        Returns
        -------
        matplotlib.figure.Figure
            ``savefig("x.pdf")`` saves it, ``show()`` shows it.
        """
        fingers = [self, *others]
        figure, (ax,) = drawing.new_figure(1, height=4.0)
        table, m = self.threshold, self.mechanics
        low, high = map(float, table.frequency[[0, -1]])
        ends = max(low, 1e-3), _BEYOND * high
        f = np.geomspace(ends[0], high, 400)
        curve = table.acceleration(f)
        drawn = [(one.frequency >= ends[0]) & (one.frequency <= ends[1]) for one in fingers]
        highest = max(drawing.peak_of(one.acceleration[some]) for one, some in zip(fingers, drawn, strict=True))
        top = 3.0 * max(float(curve.max()), highest)
        bottom = max(top / _DEPTH, 0.3 * float(curve.min()))
        ax.fill_between(f, bottom, curve, color=drawing.GREY, alpha=0.15, linewidth=0.0)
        ax.plot(f, curve, color=drawing.BLACK, linewidth=1.4, label=table.name)
        for number, (one, some) in enumerate(zip(fingers, drawn, strict=True)):
            color, marker = drawing.CYCLE[number % 6], _MARKERS[number % 6]
            name = f"skin, {one.kind} {one.signal.partition(':')[2]}".rstrip()
            stems(ax, one.frequency[some], one.acceleration[some], bottom, label=name, color=color, marker=marker)
            loud = np.flatnonzero(one.level >= 0.0)
            for i in loud[np.argsort(one.level[loud])[::-1][:_NAMED]]:
                ax.annotate(
                    f"{one.level[i]:+.0f}", (one.frequency[i], one.acceleration[i]), xytext=(0, 4),
                    textcoords="offset points", ha="center", fontsize=drawing.SMALL, color=color,
                )  # fmt: skip
        ax.set(xscale="log", yscale="log", xlim=ends, ylim=(bottom, top))
        drawing.dress(ax, "Acceleration amplitude [m/s²]", "Frequency [Hz]")
        drawing.legend_above(ax, 3)
        said = "; ".join(one.verdict() for one in fingers)
        drawing.caption(
            figure,
            f"{said} · numbers: dB above the threshold; grey: not felt; nothing is known beyond {low:g} to {high:g} Hz "
            f"· threshold: {table.source} · skin: {m.name}, {m.said}",
        )
        return figure


def feel(
    solution: Solution,
    signal: str = "f_t",
    *,
    mechanics: SkinMechanics = FINGERPAD,
    threshold: Threshold | None = None,
) -> Feel:
    """Estimate what a hand may feel of a run, from the skin's motion under the friction and a threshold.

    The friction's spectral lines, or for a source without a period the third-octave bands of its spectral density (see
    `Solution.spectrum`), move the skin by its mechanics; the acceleration's amplitude is compared with the threshold.

    Parameters
    ----------
    solution : Solution
    signal : str
        ``"f_t"``, or ``"f_t:GAP"`` for one of several fingers.
    mechanics : SkinMechanics
        `fingerspice.studies.perception.FINGERPAD` by default.
    threshold : Threshold, optional
        Android's least perceptible acceleration by default, which is for a device held in the hand.

    Raises
    ------
    InputError
        If the signal is not a friction force, or the run's spectrum cannot be computed.
    """
    require(signal.partition(":")[0] == "f_t", "signal", repr(signal), "'f_t', the friction force, or 'f_t:GAP'")
    require(isinstance(mechanics, SkinMechanics), "mechanics", repr(mechanics), "a SkinMechanics")
    table = android_threshold() if threshold is None else threshold
    require(isinstance(table, Threshold), "threshold", repr(table), "a Threshold")
    if not solution.gaps:
        raise InputError("the circuit has no GAP, so there is no friction to feel; allowed: a circuit with a GAP")
    spectrum = solution.spectrum(signal)
    end = math.inf if spectrum.amplitude is None else float(spectrum.frequency[-1])
    if end < max(table.frequency[-1], 0.1 * FASTEST_FELT):
        # A long period has so many lines that the spectrum ends below the threshold's highest frequency, and they are
        # too close to be felt separately: use the spectral density.
        spectrum = solution.spectrum(signal, method="welch")
    elif end < FASTEST_FELT:
        spectrum = solution.spectrum(signal, highest=FASTEST_FELT)
    kind = "bands" if spectrum.amplitude is None else "lines"
    f, force, slower = _bands(spectrum) if spectrum.amplitude is None else (spectrum.frequency, spectrum.amplitude, 0.0)
    edge = float(f[0]) / _EDGE
    size = np.abs(mechanics.acceleration(f)) * force
    kept = size > _NOTHING * size.max(initial=0.0)
    f, force, size = f[kept], force[kept], size[kept]
    with np.errstate(divide="ignore"):
        level = 20.0 * np.log10(size / table.acceleration(f))
        most = 20.0 * np.log10(size / table.beyond(f))
    rows = zip(most, force, f, strict=True)
    unjudged = [Unjudged(float(x), float(n), float(at), slower=False) for x, n, at in rows if not np.isnan(x)]
    if slower > 0.0:
        # It may have any frequency below the lowest band.
        below = np.geomspace(1e-3 * edge, edge, 200)
        least = np.fmin(table.acceleration(below), table.beyond(below)) / np.abs(mechanics.acceleration(below))
        unjudged.append(Unjudged(20.0 * math.log10(slower / least.min()), slower, edge, slower=True))
    # Of the mean plus a sine with the rms of what is judged.
    sine = math.sqrt(float((force[np.isfinite(level)] ** 2).sum()))
    change = 2.0 * sine / (spectrum.mean + sine) if sine > 0.0 else 0.0
    return Feel(
        spectrum.signal, kind, f, force, np.abs(mechanics.displacement(f)) * force, size, level, change,
        max(unjudged, default=None), mechanics, table,
    )  # fmt: skip


def _bands(spectrum: Spectrum) -> tuple[FloatArray, FloatArray, float]:
    """Middles (Hz) of the third-octave bands that the density resolves, and amplitudes of sines with the bands' rms.

    The last value is the amplitude for all that is slower than the lowest band.
    """
    assert spectrum.density is not None
    width = spectrum.resolution
    # A bin belongs to the band that contains its middle; the lowest band is at least _FEWEST bins wide.
    lowest = math.ceil(3.0 * math.log2(_FEWEST * width / (_EDGE - 1.0 / _EDGE) / 1e3))
    highest = math.floor(3.0 * math.log2(float(spectrum.frequency[-1]) / _EDGE / 1e3))
    middle = 1e3 * 2.0 ** (np.arange(lowest, max(highest, lowest) + 1) / 3.0)
    edges = np.append(middle / _EDGE, middle[-1] * _EDGE)
    sums = np.append(0.0, np.cumsum(spectrum.density * width))[np.searchsorted(spectrum.frequency, edges)]
    return middle, np.sqrt(2.0 * np.diff(sums)), math.sqrt(2.0 * sums[0])
