"""Warnings of a circuit before it runs: directives without effect, and a skin taken at another frequency."""

from __future__ import annotations

import math
from collections.abc import Iterator

from fingerspice.circuit.circuit import Circuit
from fingerspice.circuit.loop import network_of
from fingerspice.circuit.spectrum import energy_outside
from fingerspice.waveforms.waveform import Waveform

# Half width of a band around a frequency, relative to it, in which the skin's data change by 3 %; and the share of the
# source's energy that may lie outside the band.
_BAND, _OUTSIDE = 0.05, 0.01
# Directives that only ngspice needs, of which no warning is given.
_FOR_NGSPICE = (".nodeset", ".options")


def circuit_warnings(circuit: Circuit) -> tuple[str, ...]:
    """Warnings of what has no effect in a deck, and of a SKIN whose frequency is not the source's fundamental."""
    return (*directive_warnings(circuit), *_skin_warnings(circuit))


def directive_warnings(circuit: Circuit) -> tuple[str, ...]:
    """Warnings of directives without effect."""
    return tuple(f"{name} has no effect here" for name in circuit.unused if not name.startswith(_FOR_NGSPICE))


def _is_near(circuit: Circuit, wave: Waveform, f: float) -> bool:
    """Whether nearly all of a source's energy is close to a frequency (Hz), as for a carrier with a slow envelope."""
    stop = circuit.tran.stop if circuit.tran is not None else math.nan
    band = f * (1.0 - _BAND), f * (1.0 + _BAND)
    return stop > 0.0 and sum(energy_outside(wave, stop, band)) < _OUTSIDE


def _skin_warnings(circuit: Circuit) -> Iterator[str]:
    skins = circuit.by_device("SKIN")
    if not skins:
        return
    waves = network_of(circuit).waveforms
    if len(waves) > 1:
        # With several sources only the user can know at which frequency the skin should be taken.
        return
    (wave,), fundamental = waves, waves[0].fundamental
    for skin in skins:
        f = skin.values["f"]
        if fundamental is None and _is_near(circuit, wave, f):
            continue
        if fundamental is None:
            yield (
                f"{skin.name} takes its data at f = {f:g} Hz, and the source has no fundamental: the mean force may be "
                f"5 to 10 % off; SKIN_DISPERSIVE d={1e6 * skin.values['d']:g}u is right for any source"
            )
        elif abs(f / fundamental.frequency - 1.0) > 1e-9:
            yield (
                f"{skin.name} takes its data at f = {f:g} Hz, the source's fundamental is "
                f"{fundamental.frequency:g} Hz; {skin.name}.f={fundamental.frequency:g} would match"
            )
