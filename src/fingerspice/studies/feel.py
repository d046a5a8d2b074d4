"""Perception of a run: the skin's motion under the friction, and thresholds of perception, with their sources."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from fingerspice.base.arrays import ComplexArray, FloatArray, positive_number, read_only, real_number, real_numbers
from fingerspice.base.errors import InputError
from fingerspice.base.pages import Page, Shown, Table
from fingerspice.base.units import format_si
from fingerspice.plots import drawing
from fingerspice.plots.traces import stems
from fingerspice.results.record import Sealed
from fingerspice.results.solution import Solution
from fingerspice.waveforms.waveform import refuse, require

#: Standard gravity, m/s^2.
GRAVITY = 9.80665
DIFFERENCE_DB = 1.21
"""Smallest difference of two electrovibrations that is noticed, dB of the stimulus.

Source: S. Ryu et al., "Mechanical vibration influences the perception of electrovibration", Scientific Reports 8, 4555
(2018), doi:10.1038/s41598-018-22865-x: an average, in the range of Weber's law. Caveat: only the abstract was at hand.
It does not say whether the decibels are of voltage or of force; the force is proportional to the square of the voltage,
so that a step in decibels of voltage is twice as many decibels of force.
"""
WEBER_FRICTION = 0.11
"""Smallest reduction of the friction force that is noticed, relative to the force before it.

Source: D. Gueorguiev et al., "The tactile perception of transient changes in friction", Journal of the Royal Society
Interface 14, 20170641 (2017), doi:10.1098/rsif.2017.0641: in all conditions. Caveat: the experiment reduced friction
for a short time by ultrasonic lubrication of a passive finger, while electroadhesion increases friction.
"""
FASTEST_FELT = 1000.0
"""Highest frequency that may be felt, Hz: nothing faster is, whatever its amplitude.

Assumed: receptors of the skin are commonly said to respond up to about 1 kHz, without a threshold at that frequency.
"""


@dataclass(frozen=True)
class SkinMechanics:
    """Lateral motion of the skin under a tangential force: one mass on a spring and a damper.

    Parameters
    ----------
    name : str
    mass, damping, stiffness : float
        kg, N s/m and N/m.
    source : str
        Origin of the values, and their limits.
    """

    name: str
    mass: float
    damping: float
    stiffness: float
    source: str = ""

    def __post_init__(self) -> None:
        for what, unit in (("mass", "kg"), ("damping", "N s/m"), ("stiffness", "N/m")):
            value = real_number(what, getattr(self, what), f"a number of {unit}")
            object.__setattr__(self, what, value)
            require(0.0 <= value < np.inf, what, f"{value} {unit}", f"finite, 0 or more {unit}")
        require(self.stiffness > 0.0, "stiffness", f"{self.stiffness} N/m", "more than 0 N/m")

    @property
    def said(self) -> str:
        """The three values in words."""
        return f"{1e3 * self.mass:g} g, {self.damping:g} N s/m, {1e-3 * self.stiffness:g} N/mm"

    def displacement(self, frequency: FloatArray) -> ComplexArray:
        """Displacement per force at frequencies (Hz), m/N, same shape."""
        omega = 2.0 * np.pi * np.asarray(frequency)
        return np.asarray(1.0 / (self.stiffness - self.mass * omega**2 + 1j * self.damping * omega))

    def acceleration(self, frequency: FloatArray) -> ComplexArray:
        """Acceleration per force at frequencies (Hz), 1/kg, same shape."""
        return np.asarray(-((2.0 * np.pi * np.asarray(frequency)) ** 2) * self.displacement(frequency))


FINGERPAD = SkinMechanics(
    "fingerpad, sideways", 1e-4, 1.0, 1e3,
    "Table 1 of 'Friction perception resulting from laterally vibrotactile stimuli', ROBOMECH Journal 2017, "
    "doi:10.1186/s40648-017-0080-8, values of a simulation; those of a person differ, and change with load and speed",
)  # fmt: skip
"""The fingerpad moved sideways: 0.1 g, 1 N s/m, 1 N/mm; `source` says whence.

Caveat: one mass stands for a pad whose parts move differently. Stiffness and moving mass rise with the sliding speed
(Balasubramanian et al. 2025, arXiv:2505.11162: 4 N/m and 0.03 g per mm/s) and differ between people. Measurements that
are often quoted (Nakazawa, Ikeura and Inooka, "Characteristics of human fingertips in the shearing direction", 2000)
are said to lie at 1 to 2 N/mm, 1 to 3 N s/m and 0.1 to 0.2 g; these could not be checked.
"""


@dataclass(frozen=True)
class Threshold(Sealed):
    """Smallest amplitude of a vibration that is felt, against frequency; undefined outside the table's frequencies.

    Parameters
    ----------
    name : str
    frequency : array_like, shape (n,)
        Hz, ascending, two or more.
    level : array_like, shape (n,)
        dB: 20 log10 of the acceleration's amplitude in `reference`; linear in frequency between the points.
    reference : float
        m/s^2; 1 by default.
    source : str
        Origin of the values, and their limits.
    """

    name: str
    frequency: FloatArray
    level: FloatArray
    reference: float = 1.0
    source: str = ""

    def __post_init__(self) -> None:
        for what in ("frequency", "level"):
            values = real_numbers(f"threshold's {what}", getattr(self, what), "numbers").copy()
            object.__setattr__(self, what, read_only(values))
        f, level = self.frequency, self.level
        good = f.ndim == 1 and f.size >= 2 and f.shape == level.shape
        require(good, "threshold", f"shapes {f.shape} and {level.shape}", "two rows of equal length, two or more")
        bad = np.flatnonzero(~(np.isfinite(f) & np.isfinite(level)) | (f < 0.0) | np.append(False, np.diff(f) <= 0.0))
        if bad.size:
            said = f"threshold {self.name!r}: point {bad[0] + 1} is {f[bad[0]]} Hz, {level[bad[0]]} dB"
            raise InputError(f"{said}; allowed: finite numbers, with frequencies ascending from 0 or more")
        object.__setattr__(self, "reference", positive_number("reference", self.reference, "m/s^2"))

    def acceleration(self, frequency: FloatArray) -> FloatArray:
        """Amplitude that is just felt at frequencies (Hz), m/s^2, same shape; NaN beyond the table."""
        level = np.interp(frequency, self.frequency, self.level, left=np.nan, right=np.nan)
        return np.asarray(self.reference * 10.0 ** (level / 20.0))

    def beyond(self, frequency: FloatArray) -> FloatArray:
        """Amplitude that may be felt beyond the table's frequencies (Hz), m/s^2, same shape; NaN within the table.

        Below the table it has the displacement of the first point, and above it the acceleration of the last one, as
        a threshold in these terms hardly falls there. Above `FASTEST_FELT` it is infinite.
        """
        f, (low, high) = np.asarray(frequency, float), self.frequency[[0, -1]]
        first, last = self.acceleration(self.frequency[[0, -1]])
        above = np.where(f > high, np.where(f <= FASTEST_FELT, last, np.inf), np.nan)
        return np.where(f < low, first * (f / low) ** 2 if low > 0.0 else np.nan, above)


@cache
def android_threshold() -> Threshold:
    """Least perceptible acceleration as published by Android: 41 points, 0.4 to 400 Hz.

    Source: the Android Open Source Project, Apache License 2.0; the head of `least_perceptible_acceleration.csv` names
    its files. Caveats: the threshold is that of a device held in the hand, not of a bare finger that slides, and
    Android gives neither the experiment nor whether the acceleration is a peak or an rms value. Here it is taken as a
    peak; if it is an rms value, the threshold is 3 dB higher, and every level above it 3 dB lower.
    """
    path = Path(__file__).with_name("least_perceptible_acceleration.csv")
    # The first row has the names of the columns.
    frequency, level = np.genfromtxt(path, delimiter=",", encoding="utf-8", unpack=True)[:, 1:]
    source = "Android Open Source Project, Apache-2.0: of a device held in the hand, not of a bare, sliding finger"
    return Threshold("Android's least perceptible acceleration", frequency, level, GRAVITY, source)


#: Upper edge of a third-octave band, relative to its middle (one band's middle is 1 kHz); fewest bins in a band.
_EDGE, _FEWEST = 2.0 ** (1.0 / 6.0), 2
#: Lines weaker than this fraction of the strongest acceleration are round-off, and are left out.
_NOTHING = 1e-9
#: Largest number of rows in a report, and of lines whose level is written in the picture.
_SHOWN, _NAMED = 10, 6
#: Units of the columns of lines or bands, beside the level.
_UNITS = {"frequency": "Hz", "force": "N", "displacement": "m", "acceleration": "m/s^2"}
#: Largest span of the picture's vertical axis; and end of its frequency axis over the threshold's highest frequency.
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
    def strongest(self) -> int | None:
        """Index of the line or band with the highest level; None if none is within the threshold's frequencies."""
        return int(np.nanargmax(self.level)) if np.isfinite(self.level).any() else None

    @property
    def highest(self) -> float | None:
        """The highest level, dB; None if no line or band is within the threshold's frequencies."""
        return None if (place := self.strongest) is None else float(self.level[place])

    @property
    def felt(self) -> bool | None:
        """Whether some line or band reaches the threshold; None if none does, but what it cannot judge may be felt."""
        return self._or_unknown(bool(np.any(self.level >= 0.0)))

    @property
    def change_felt(self) -> bool | None:
        """Whether the change reaches Weber's fraction of 0.11 (`feel.WEBER_FRICTION`); None as for `felt`."""
        return self._or_unknown(self.change >= WEBER_FRICTION)

    def _or_unknown(self, felt: bool) -> bool | None:
        """`felt`, or None where it is False and what cannot be judged may be felt."""
        return None if not felt and self.unjudged is not None and self.unjudged.level >= 0.0 else felt

    @property
    def steps(self) -> float | None:
        """The highest level in difference thresholds of 1.21 dB (`feel.DIFFERENCE_DB`); None if not felt."""
        return self.highest / DIFFERENCE_DB if self.felt and self.highest is not None else None

    def to_dict(self) -> dict[str, Any]:
        """The keys of ``--json``; lines outside the threshold's frequencies are left out."""
        place = self.strongest
        columns = {**{name: getattr(self, name) for name in _UNITS}, "level_db": self.level}
        return {
            "element": self.signal.partition(":")[2] or None, "felt": self.felt, "kind": self.kind,
            "strongest": None if place is None else float(self.frequency[place]), "level_db": self.highest,
            "unjudged": None if self.unjudged is None else self.unjudged._asdict(), "difference_steps": self.steps,
            "friction_change": self.change, "friction_change_felt": self.change_felt,
            "mechanics": dict(vars(self.mechanics)),
            "threshold": {"name": self.threshold.name, "source": self.threshold.source},
            "lines": [{k: float(x[i]) for k, x in columns.items()} for i in np.flatnonzero(np.isfinite(self.level))],
        }  # fmt: skip

    def _page(self) -> Page:
        what, blocks = "line" if self.kind == "lines" else "band around", list[str | Table]([self.verdict()])
        judged = np.flatnonzero(np.isfinite(self.level))
        if judged.size:
            shown = np.sort(judged[np.argsort(self.level[judged])[::-1][:_SHOWN]])
            texts = [[format_si(float(x), unit) for x in getattr(self, k)[shown]] for k, unit in _UNITS.items()]
            rows = list(zip(*texts, [f"{x:+.1f} dB" for x in self.level[shown]], strict=True))
            blocks += ["", Table((what, "friction", "skin moves", "accelerates", "above threshold"), rows), ""]
        change = f"friction changes by {100.0 * self.change:.3g} % within these frequencies"
        blocks.append(f"{change}; {100.0 * WEBER_FRICTION:g} % are noticed as a transient reduction")
        blocks.append(f"threshold: {self.threshold.name} ({self.threshold.source})")
        return Page([*blocks, f"skin: {self.mechanics.name}: {self.mechanics.said}"])

    def verdict(self) -> str:
        """A sentence: whether it is felt, at which frequency most, the level, and friction that cannot be judged."""
        finger = f"finger {self.signal.partition(':')[2]}: " if ":" in self.signal else ""
        low, high = self.threshold.frequency[[0, -1]]
        said = f"no part of the friction lies between {low:g} and {high:g} Hz"
        if (place := self.strongest) is not None:
            at = format_si(float(self.frequency[place]), "Hz")
            where = f"at {at}" if self.kind == "lines" else f"in the third octave around {at}"
            steps = "" if self.steps is None else f" ({self.steps:.0f} noticeable steps)"
            side = "above" if steps else "below"
            said = f"strongest {where}, {abs(self.level[place]):.1f} dB {side} the threshold{steps}"
        if self.unjudged is not None and (self.unjudged.level >= 0.0 or not self.felt):
            said += f"; {self.unjudged}"
        verdict = {True: "felt", False: "not felt", None: "not known whether felt"}[self.felt]
        return f"{finger}{verdict}: {said}"

    def plot(self, others: Sequence[Feel] = ()) -> drawing.Picture:
        """Draw the acceleration, also that of other fingers, and the threshold against frequency."""
        fingers = [self, *others]
        figure, (ax,) = drawing.new_figure(1, height=4.0)
        table, m = self.threshold, self.mechanics
        low, high = table.frequency[[0, -1]].tolist()
        ends = max(low, 1e-3), _BEYOND * high
        curve = table.acceleration(f := np.geomspace(ends[0], high, 400))
        drawn = [(one.frequency >= ends[0]) & (one.frequency <= ends[1]) for one in fingers]
        peaks = [drawing.peak_of(one.acceleration[some]) for one, some in zip(fingers, drawn, strict=True)]
        top = 3.0 * max(float(curve.max()), *peaks)
        bottom = max(top / _DEPTH, 0.3 * float(curve.min()))
        ax.fill_between(f, bottom, curve, color=drawing.GREY, alpha=0.15, linewidth=0.0)
        ax.plot(f, curve, color=drawing.BLACK, linewidth=1.4, label=table.name)
        for number, (one, some) in enumerate(zip(fingers, drawn, strict=True)):
            color, marker = drawing.CYCLE[number % 6], "osD^vP"[number % 6]
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
        said += " · numbers: dB above the threshold; grey: not felt; nothing is known beyond "
        said += f"{low:g} to {high:g} Hz · threshold: {table.source} · skin: {m.name}, {m.said}"
        drawing.caption(figure, said)
        return figure


def feel(
    solution: Solution, signal: str = "f_t", *, mechanics: SkinMechanics = FINGERPAD, threshold: Threshold | None = None
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
        `fingerspice.studies.feel.FINGERPAD` by default.
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
    refuse(not solution.gaps, "the circuit has no GAP, so there is no friction to feel; allowed: a circuit with a GAP")
    spectrum = solution.spectrum(signal)
    end = math.inf if spectrum.amplitude is None else spectrum.frequency[-1]
    if end < max(table.frequency[-1], 0.1 * FASTEST_FELT):
        # A long period has so many lines that the spectrum ends below the threshold's highest frequency, and they are
        # too close to be felt separately: use the spectral density.
        spectrum = solution.spectrum(signal, method="welch")
    elif end < FASTEST_FELT:
        spectrum = solution.spectrum(signal, highest=FASTEST_FELT)
    kind, f, slower = "lines", spectrum.frequency, 0.0
    if (force := spectrum.amplitude) is None:
        assert spectrum.density is not None
        kind, width = "bands", spectrum.resolution
        # A bin belongs to the band that contains its middle; the lowest band is at least _FEWEST bins wide.
        lowest = math.ceil(3.0 * math.log2(_FEWEST * width / (_EDGE - 1.0 / _EDGE) / 1e3))
        highest = math.floor(3.0 * math.log2(float(f[-1]) / _EDGE / 1e3))
        middle = 1e3 * 2.0 ** (np.arange(lowest, max(highest, lowest) + 1) / 3.0)
        edges = np.append(middle / _EDGE, middle[-1] * _EDGE)
        sums = np.append(0.0, np.cumsum(spectrum.density * width))[np.searchsorted(f, edges)]
        # Amplitudes of sines of the rms of every band, and of all below them.
        f, force, slower = middle, np.sqrt(2.0 * np.diff(sums)), math.sqrt(2.0 * sums[0])
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
