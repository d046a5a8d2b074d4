"""Frequencies of a phasor sweep, its drive, and remarks and warnings about it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from fingerspice.base.arrays import FloatArray
from fingerspice.base.errors import InputError
from fingerspice.circuit.circuit import AcSweep, Circuit, Element
from fingerspice.physics.materials import SKIN_BAND
from fingerspice.waveforms.waveform import Fundamental

MAX_FREQUENCIES = 1_000_000


@dataclass(frozen=True)
class Drive:
    """The drive of a sweep.

    Attributes
    ----------
    amplitude : float
        V (A for a current source); NaN if there is neither AC nor a fundamental.
    phase : float
        rad.
    text : str
        Origin of amplitude and phase, in words.
    """

    amplitude: float
    phase: float
    text: str


def sweep_drive(sources: tuple[tuple[Element, float], ...], fundamental: Fundamental | None, swept: bool) -> Drive:
    """The drive of a circuit: in a sweep the ``AC`` of its sources, if the deck has it, and else the fundamental."""
    given = [(e, sign) for e, sign in sources if e.ac is not None]
    if swept and given:
        # As in ngspice, a source without AC has an AC amplitude of 0.
        total = sum(sign * e.ac.phasor for e, sign in given if e.ac is not None)
        words = [f"AC {e.ac.magnitude:g} {e.ac.phase_deg:g} of {e.name}" for e, _ in given if e.ac is not None]
        return Drive(abs(total), math.atan2(total.imag, total.real), " and ".join(words))
    names = " and ".join(e.name for e, _ in sources)
    if fundamental is None:
        return Drive(math.nan, 0.0, f"no fundamental of {names}")
    return Drive(fundamental.amplitude, fundamental.phase, f"the fundamental of {names}")


def sweep_notes(circuit: Circuit, f: FloatArray, skin: str = "swept") -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Remarks on the frequency of the skin's data, and warnings about extrapolation, for a sweep (Hz)."""
    skins = {e.name: e.values["f"] for e in circuit.by_device("SKIN")}
    own = ", ".join(f"{name} f = {x:g} Hz" for name, x in skins.items())
    notes: tuple[str, ...] = ()
    if skins and skin == "own":
        notes = (f"the skin's data are held at the deck's own frequency ({own}) over the whole sweep",)
    elif any(np.any(np.abs(f / x - 1.0) > 1e-9) for x in skins.values()):
        notes = (f"the skin's data are taken at each frequency of the sweep, not at the deck's own ({own})",)
    swept = bool(circuit.by_device("SKIN_DISPERSIVE")) or (bool(skins) and skin != "own")
    low, high = float(f.min()), float(f.max())
    beyond = []
    # The tolerance of 1e-6 allows for rounding of a sweep's end.
    if low < SKIN_BAND[0] * (1.0 - 1e-6):
        beyond.append(f"down to {low:g} Hz, {math.log10(SKIN_BAND[0] / low):.2g} decades below")
    if high > SKIN_BAND[1] * (1.0 + 1e-6):
        beyond.append(f"up to {high:g} Hz, {math.log10(high / SKIN_BAND[1]):.2g} decades above")
    if not swept or not beyond:
        return notes, ()
    return notes, (
        f"the sweep goes {' and '.join(beyond)} the 10 Hz to 100 kHz of the skin's data (Eqs. 18, 19): what it shows "
        "there is extrapolated",
    )


def sweep_frequencies(sweep: AcSweep) -> FloatArray:
    """Frequencies (Hz) of an ``.ac`` line.

    Raises
    ------
    InputError
        If there are more than `MAX_FREQUENCIES`.
    """
    base, ratio = (10.0 if sweep.scale == "dec" else 2.0), sweep.stop / sweep.start
    count = sweep.points - 1.0 if sweep.scale == "lin" else math.log(ratio) / math.log(base) * sweep.points
    if not count < MAX_FREQUENCIES:
        raise InputError(f"the sweep has {count + 1.0:.3g} frequencies; allowed: at most {MAX_FREQUENCIES}")
    if sweep.scale == "lin":
        return np.linspace(sweep.start, sweep.stop, sweep.points)
    n = math.floor(count + 1e-9)
    out = sweep.start * base ** (np.arange(n + 1) / sweep.points)
    return np.asarray(np.append(out, sweep.stop) if count - n > 1e-9 else out)
