"""Data about perception: the skin's mechanics and thresholds of perception, each with its source and caveat."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fingerspice.base.arrays import FloatArray, positive_number, real_number, real_numbers
from fingerspice.base.errors import InputError
from fingerspice.results.signals import Sealed, sealed
from fingerspice.waveforms.waveform import require

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

    def displacement(self, frequency: FloatArray) -> NDArray[np.complex128]:
        """Displacement per force at frequencies (Hz), m/N, same shape."""
        omega = 2.0 * np.pi * np.asarray(frequency)
        return np.asarray(1.0 / (self.stiffness - self.mass * omega**2 + 1j * self.damping * omega))

    def acceleration(self, frequency: FloatArray) -> NDArray[np.complex128]:
        """Acceleration per force at frequencies (Hz), 1/kg, same shape."""
        return np.asarray(-((2.0 * np.pi * np.asarray(frequency)) ** 2) * self.displacement(frequency))


FINGERPAD = SkinMechanics(
    "fingerpad, sideways",
    mass=1e-4,
    damping=1.0,
    stiffness=1e3,
    source="Table 1 of 'Friction perception resulting from laterally vibrotactile stimuli', ROBOMECH Journal 2017, "
    "doi:10.1186/s40648-017-0080-8, values of a simulation; those of a person differ, and change with load and speed",
)
"""The fingerpad moved sideways: 0.1 g, 1 N s/m, 1 N/mm.

Source: values of a simulation, Table 1 of "Friction perception resulting from laterally vibrotactile stimuli", ROBOMECH
Journal (2017), doi:10.1186/s40648-017-0080-8. Caveat: one mass stands for a pad whose parts move differently. Stiffness
and moving mass rise with the sliding speed (Balasubramanian et al. 2025, arXiv:2505.11162: 4 N/m and 0.03 g per mm/s)
and differ between people. Measurements that are often quoted (Nakazawa, Ikeura and Inooka, "Characteristics of human
fingertips in the shearing direction", 2000) are said to lie at 1 to 2 N/mm, 1 to 3 N s/m and 0.1 to 0.2 g; these could
not be checked.
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
            object.__setattr__(self, what, sealed(values))
        f, level = self.frequency, self.level
        good = f.ndim == 1 and f.size >= 2 and f.shape == level.shape
        require(good, "threshold", f"shapes {f.shape} and {level.shape}", "two rows of equal length, two or more")
        bad = np.flatnonzero(~(np.isfinite(f) & np.isfinite(level)) | (f < 0.0) | np.append(False, np.diff(f) <= 0.0))
        if bad.size:
            raise InputError(
                f"threshold {self.name!r}: point {bad[0] + 1} is {f[bad[0]]} Hz, {level[bad[0]]} dB; allowed: finite "
                "numbers, with frequencies ascending from 0 or more"
            )
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
    return Threshold(
        "Android's least perceptible acceleration",
        frequency,
        level,
        reference=GRAVITY,
        source="Android Open Source Project, Apache-2.0: of a device held in the hand, not of a bare, sliding finger",
    )
