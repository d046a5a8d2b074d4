"""A source's spectrum and the skin: the energy outside the skin's data, and the error of data at one frequency."""

from __future__ import annotations

import math

import numpy as np

from fingerspice.base.arrays import FloatArray
from fingerspice.circuit.circuit import Circuit
from fingerspice.circuit.statespace import build_stack
from fingerspice.physics.materials import SKIN_BAND
from fingerspice.physics.phasor import layer_gains
from fingerspice.waveforms.waveform import Waveform

# Largest number of samples of a spectrum, and number of periods that represent a longer run of a periodic source.
_MOST_SAMPLES = 2**19
_PERIODS = 16
# Share of the source's energy outside the band of the skin's data from which on a warning is given.
NOTABLE = 0.01
# The area's harmonics also meet the skin's data. Taken at the fundamental, these cause a further relative error of at
# most this times the relative change of the area: 0.004 was found where the area changes by a quarter (sine of 200 V
# and 100 Hz).
_COUPLING = 0.05


def _samples(waveform: Waveform, t0: float, t1: float, rate: float) -> FloatArray:
    """The source at the midpoints of equal intervals, `rate` or more per second unless that is too many."""
    count = int(min(_MOST_SAMPLES, max(1024, 2 ** math.ceil(math.log2((t1 - t0) * rate)))))
    return np.asarray(waveform.value(t0 + (np.arange(count) + 0.5) * ((t1 - t0) / count)))


def energy_outside(
    waveform: Waveform, t_stop: float, band: tuple[float, float] = SKIN_BAND
) -> tuple[float, float]:  # fmt: skip
    """Shares of the source's energy below and above a band (Hz), by default that of the skin's data.

    They are taken over one period of a periodic source, and else over the run to `t_stop` (s) with a Hann window, so
    that its ends are no jumps. A source that is not finite counts as inside.
    """
    low, high = band
    periodic = waveform.period is not None
    t0 = waveform.settled if periodic else 0.0
    span = waveform.period if waveform.period is not None else t_stop
    u = _samples(waveform, t0, t0 + span, 4.0 * high)
    if not np.all(np.isfinite(u)):
        return 0.0, 0.0
    if not periodic:
        u = u * np.hanning(u.size)
    energy = np.abs(np.fft.rfft(u)) ** 2
    energy[1:] *= 2.0
    f = np.arange(energy.size) / span
    total = float(energy.sum())
    # The window spreads a line over the neighbouring bins, so one bin below the band counts as inside.
    below = f < low - (0.0 if periodic else 1.0 / span)
    return (float(energy[below].sum() / total), float(energy[f > high].sum() / total)) if total > 0.0 else (0.0, 0.0)


def spectrum_warning(circuit: Circuit, waveform: Waveform, t_stop: float) -> str | None:
    """A warning where a dispersive skin is driven outside the band of its data, or None."""
    skins = circuit.by_device("SKIN_DISPERSIVE")
    if not skins or not (math.isfinite(t_stop) and t_stop > 0.0):
        return None
    below, above = circuit.remember(("outside", t_stop), lambda: energy_outside(waveform, t_stop))
    parts = [
        f"{100.0 * share:.{0 if share > 0.1 else 1}f} % {where}"
        for share, where in ((below, f"below {SKIN_BAND[0]:g} Hz"), (above, f"above {SKIN_BAND[1] / 1e3:g} kHz"))
        if share > NOTABLE
    ]
    if not parts:
        return None
    return f"of the source's energy {' and '.join(parts)} lie outside the band of the data behind {skins[0].name}"


def freezing_error(circuit: Circuit, frequency: float, area: float, sensitivity: float, t_stop: float) -> float:
    """Error of the gap voltage, relative to its peak, with a dispersive skin's data taken at one frequency.

    It is that of the linear response at one area from the uncharged start, by superposition of phasors, plus an
    estimate of what the change of the area adds.

    Parameters
    ----------
    circuit : Circuit
    frequency : float
        Hz.
    area : float
        m^2.
    sensitivity : float
        Relative change of the area over the run.
    t_stop : float
        s.
    """
    dispersive, frozen = build_stack(circuit), build_stack(circuit, skin_at=frequency)
    gap = dispersive.gap_layer
    assert gap is not None
    span = min(t_stop, _PERIODS / frequency)
    u = _samples(dispersive.waveform, 0.0, span, 200.0 * frequency)
    # The run is followed by silence of equal length, so that the discrete transform does not wrap its end round.
    lines = np.fft.rfft(u, 2 * u.size)
    f = np.arange(1, lines.size) / (2.0 * span)
    gains = [layer_gains(stack.admittance(f, np.array([area])))[:, gap] for stack in (dispersive, frozen)]
    right, missed = (
        np.fft.irfft(np.concatenate([[0.0], gain * lines[1:]]))[: u.size] for gain in (gains[0], gains[1] - gains[0])
    )
    peak = float(np.abs(right).max())
    if not (peak > 0.0 and math.isfinite(peak)):
        return math.inf
    return float(np.abs(missed).max()) / peak + _COUPLING * sensitivity
