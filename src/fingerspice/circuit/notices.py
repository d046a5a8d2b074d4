"""Warnings about a circuit before it runs: directives without effect, and skin data at an unsuitable frequency."""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import partial

from fingerspice.circuit.circuit import Circuit
from fingerspice.circuit.loop import network_of
from fingerspice.circuit.spectrum import energy_outside, skin_error, surely_wide
from fingerspice.waveforms.waveform import Waveform

# Half-width of a band around a frequency, relative to the frequency, in which the skin's data change by 3 %; and the
# fraction of the source's energy that may lie outside the band.
_BAND, _OUTSIDE = 0.05, 0.01
# Text about the mean force if its error cannot be computed, and the smallest relative error that is given as a number.
_UNKNOWN, _LITTLE = "may be 5 to 10 % off", 0.005
# Directives that only ngspice needs, so that no warning is given about them.
_FOR_NGSPICE = (".nodeset", ".options")


def circuit_warnings(circuit: Circuit, t_stop: float | None) -> tuple[str, ...]:
    """Warnings about directives without effect, and about a SKIN whose single frequency does not suit its source.

    The run is taken to end at `t_stop` (s), or at the deck's own end where that is None.
    """
    stop = t_stop or (circuit.tran.stop if circuit.tran is not None else math.nan)

    def make() -> tuple[str, ...]:
        return (*directive_warnings(circuit), *_skin_warnings(circuit, stop))

    found: tuple[str, ...] = circuit.remember(("notices", stop), make)
    return found


def directive_warnings(circuit: Circuit) -> tuple[str, ...]:
    """Warnings about directives without effect."""
    return tuple(f"{name} has no effect here" for name in circuit.unused if not name.startswith(_FOR_NGSPICE))


def _is_near(wave: Waveform, stop: float, f: float) -> bool:
    """Whether nearly all of a source's energy is close to a frequency (Hz), as for a carrier with a slow envelope."""
    if surely_wide(wave, stop, f):
        return False
    band = f * (1.0 - _BAND), f * (1.0 + _BAND)
    return sum(energy_outside(wave, stop, band)) < _OUTSIDE


def _skin_warnings(circuit: Circuit, stop: float) -> Iterator[str]:
    skins = circuit.by_device("SKIN")
    if not skins:
        return
    waves = network_of(circuit).waveforms
    if len(waves) > 1:
        # With several sources only the user can know at which frequency the skin data should be taken.
        return
    (wave,), fundamental = waves, waves[0].fundamental
    known = 0.0 < stop < math.inf
    for skin in skins:
        f = skin.values["f"]
        if fundamental is None:
            if not (known and circuit.remember(("near", f, stop), partial(_is_near, wave, stop, f))):
                yield (
                    f"{skin.name} takes its data at f = {f:g} Hz, and the source has no fundamental: the mean force "
                    f"{_how_far(circuit, wave, stop) if known else _UNKNOWN}; SKIN_DISPERSIVE "
                    f"d={1e6 * skin.values['d']:g}u is right for any source"
                )
        elif abs(f / fundamental.frequency - 1.0) > 1e-9:
            yield (
                f"{skin.name} takes its data at f = {f:g} Hz, the source's fundamental is "
                f"{fundamental.frequency:g} Hz; {skin.name}.f={fundamental.frequency:g} would match"
            )


def _how_far(circuit: Circuit, wave: Waveform, stop: float) -> str:
    """Text for a warning: the error of the mean force of a run to `stop` (s)."""
    error = circuit.remember(("skin error", stop), lambda: skin_error(circuit, wave, stop))
    if error is None:
        return _UNKNOWN
    if abs(error) < _LITTLE:
        return f"may be {100.0 * _LITTLE:g} % off"
    return f"is about {100.0 * abs(error):.2g} % too {'large' if error > 0.0 else 'small'}"
