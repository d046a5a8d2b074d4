"""A wanted force or friction, from arrays, waveforms, functions and tables, and the gap voltage that produces it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from fingerspice.base.arrays import FloatArray, positive_number, real_numbers
from fingerspice.base.errors import InputError
from fingerspice.physics.contact import Contact
from fingerspice.waveforms.columns import Columns, read_text_columns
from fingerspice.waveforms.files import MAX_TEXT_BYTES, checked_file
from fingerspice.waveforms.ramps import PWL
from fingerspice.waveforms.samples import Samples
from fingerspice.waveforms.waveform import Waveform, as_waveform, require

#: Types that may be given as a wanted force.
Wanted = ArrayLike | Waveform | Callable[[float], float]
# Number of amplitudes of the carrier between which the mean force is interpolated.
_GRID = 80


@dataclass(frozen=True)
class Profile:
    """A wanted quantity (N) against time, from 0 to `duration` (s); `rate` (Hz) is its sample rate, or None."""

    wave: Waveform
    duration: float
    rate: float | None


def as_profile(given: Wanted, what: str, rate: float | None, duration: float | None) -> Profile:
    """The profile that a caller gave; an array needs its `rate`, and a waveform without an end a `duration`."""
    if isinstance(given, Waveform) or callable(given):
        wave = as_waveform(given)
        own = wave.rate if isinstance(wave, Samples) else None
        end = duration
        if end is None and isinstance(wave, Samples):
            end = wave.start + (wave.values.size - 1) / wave.rate
        elif end is None and isinstance(wave, PWL) and wave.period is None:
            end = float(np.asarray(wave.times)[-1])
        if end is None:
            raise InputError(f"{what} is a waveform without an end; allowed: with duration= in s")
        return Profile(wave, positive_number("duration", end, "s"), own)
    values = real_numbers(what, given, "numbers in N, a waveform or a function")
    if rate is None:
        raise InputError(f"{what} is an array without a rate; allowed: with rate= in Hz, or fs.Samples({what}, rate)")
    require(values.ndim == 1 and values.size >= 2, what, f"an array of shape {values.shape}", "a row of two or more")
    bad = np.flatnonzero(~np.isfinite(values))
    if bad.size:
        raise InputError(f"{what}: row {bad[0]} is {values[bad[0]]}; allowed: finite numbers in N")
    return Profile(Samples(values, rate), (values.size - 1) / rate, rate)


def read_wanted(path: str | Path, rate: float | None = None) -> tuple[str, Profile]:
    """The wanted quantity of a table, ``"force"`` or ``"friction"``, and its profile.

    The header names a column ``force`` or ``friction`` (N or mN), and a column of times, ``t`` or ``time``, unless a
    `rate` (Hz) is given: ``time (ms), friction (N)``.
    """
    path = checked_file(path, MAX_TEXT_BYTES)
    found = read_text_columns(path)
    if not found.names:
        raise InputError(f"'{path}' has no header; allowed: a first line such as 'time (s), friction (N)'")
    kinds = [name.lower() for name in found.names]
    named = [kind for kind in ("force", "friction") if kind in kinds]
    if len(named) != 1:
        has = "columns force and friction" if named else "no column named force or friction"
        raise InputError(f"'{path}' has {has}; it has {found.listed()}; allowed: one column of these names")
    values = found.scaled(kinds.index(named[0]), "N")
    if values.size < 2:
        raise InputError(f"'{path}' has one row; allowed: two or more")
    timed = next((i for i, name in enumerate(kinds) if name in ("t", "time")), None)
    if timed is None:
        if rate is None:
            raise InputError(f"'{path}' has no column of times and no rate; allowed: a column time, or a rate in Hz")
        return named[0], as_profile(values, named[0], rate, None)
    return named[0], _timed(found, found.scaled(timed, "s"), values, rate)


def _timed(found: Columns, t: FloatArray, values: FloatArray, rate: float | None) -> Profile:
    """The profile of values at times; time 0 of the profile is the first of them."""
    back = np.flatnonzero(np.diff(t) <= 0.0)
    if back.size:
        i = int(back[0])
        raise InputError(f"{found.place(i + 1)}: the time {t[i + 1]:g} s follows {t[i]:g} s; allowed: rising times")
    t = t - t[0]
    own = (t.size - 1) / float(t[-1])
    even = bool(np.all(np.abs(t * own - np.arange(t.size)) < 1e-3))
    if even:
        if rate is not None and abs(rate - own) > 1e-3 * own:
            raise InputError(
                f"'{found.file}': its times are at {own:g} Hz, and the rate given is {rate:g} Hz; allowed: one of them"
            )
        return Profile(Samples(values, own), float(t[-1]), own)
    if rate is not None:
        raise InputError(f"'{found.file}': its times are uneven, and a rate is given; allowed: one of them")
    return Profile(PWL(tuple(t.tolist()), tuple(values.tolist())), float(t[-1]), None)


def force_of_friction(friction: FloatArray, contact: Contact) -> FloatArray:
    """F_el = F_T / mu - F_N (Eq. 1 with full slip), N."""
    if contact.mu == 0.0:
        raise InputError("the GAP has mu=0, so that no voltage makes friction; allowed: mu > 0, or a wanted force")
    return friction / contact.mu - contact.f_n


class ForceCurve:
    """Mean force over a period of the carrier against the carrier's amplitude; without a carrier, the force itself.

    `area` (m^2) is that fixed by the deck, if any; `points` the number of samples in a period of the carrier, between
    which the voltage is linear, or None without a carrier; `most` (N) the largest force that is needed.
    """

    def __init__(self, contact: Contact, area: float | None, points: float | None, most: float) -> None:
        from scipy.interpolate import CubicSpline

        self._contact, self._area = contact, area
        if points is None:
            self._shape, self._weight = np.ones(1), np.ones(1)
        else:
            count = round(points) if abs(points - round(points)) < 1e-9 else round(8 * points)
            at = np.sin(2.0 * np.pi * np.arange(count + 1) / points)
            self._shape = np.abs(np.concatenate([at[:-1], 0.5 * (at[1:] + at[:-1])]))
            # Simpson's rule between samples: the voltage is linear there, so the force is a parabola but for the change
            # of the area.
            self._weight = np.repeat([1.0 / 3.0, 2.0 / 3.0], count) / count
        top = 1.0
        while self.mean(np.array([top]))[0] < 1.01 * most:
            if top > 1e6:
                raise InputError(
                    f"the force wanted, {most:g} N, is reached by no voltage: at 1 MV the gap has "
                    f"{float(self.mean(np.array([1e6]))[0]):.3g} N; allowed: less"
                )
            top *= 1.4
        amplitude = top * np.arange(1, _GRID + 1) / _GRID
        force = self.mean(amplitude)
        rising = np.concatenate([[True], np.diff(force) > 0.0])
        last = _GRID if rising.all() else int(np.argmin(rising))
        root = np.sqrt(force[:last])
        if root[-1] ** 2 < most:
            raise InputError(f"the force wanted, {most:g} N, is reached by no voltage; allowed: at most "
                             f"{root[-1] ** 2:.3g} N")  # fmt: skip
        ratio = amplitude[:last] / root
        at_zero = math.sqrt(1.0 / float(self._weight @ self._shape**2) / self._scale(0.0))
        self._spline = CubicSpline(np.append(0.0, root), np.append(at_zero, ratio))

    def _scale(self, u: float) -> float:
        """Force divided by the square of the voltage, N/V^2."""
        return float(self.force(np.array([max(u, 1e-3)]))[0]) / max(u, 1e-3) ** 2

    def force(self, u: FloatArray) -> FloatArray:
        """Force at gap voltages, N."""
        area = self._contact.area(u) if self._area is None else self._area
        return np.asarray(self._contact.stress(u) * area)

    def mean(self, amplitude: FloatArray) -> FloatArray:
        """Mean force at amplitudes of the gap voltage (V, shape (n,)), N."""
        return np.asarray(self.force(amplitude[:, None] * self._shape) @ self._weight)

    def amplitude(self, force: FloatArray) -> FloatArray:
        """Amplitude (V) of the gap voltage for mean forces (N)."""
        root = np.sqrt(force)
        return np.asarray(root * self._spline(root))


def check_forces(force: FloatArray, times: FloatArray, what: str, contact: Contact) -> FloatArray:
    """The forces (N), checked to be attractive, with negative round-off set to 0."""
    floor = -1e-12 * max(1.0, float(np.abs(force).max()))
    bad = np.flatnonzero(~(force >= floor))
    if bad.size:
        i = int(bad[0])
        least = "0 N" if what == "force" else f"{contact.mu * contact.f_n:g} N, the friction without a voltage"
        value = force[i] if what == "force" else contact.mu * (force[i] + contact.f_n)
        raise InputError(
            f"{what}: {value:g} N at {times[i]:g} s is reached by no voltage, which only attracts; allowed: from "
            f"{least}"
        )
    return np.asarray(np.maximum(force, 0.0))
