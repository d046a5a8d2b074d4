"""Warnings about a circuit before it runs: directives without effect, unsuitable skin data, sources that miss it."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from contextlib import suppress
from functools import partial

import numpy as np

from fingerspice.base.arrays import FloatArray
from fingerspice.base.errors import InputError
from fingerspice.circuit.circuit import Circuit
from fingerspice.circuit.loop import network_of
from fingerspice.circuit.spectrum import is_near, skin_error
from fingerspice.circuit.topology import driving, driving_sources
from fingerspice.circuit.usual import unusual_of_changed
from fingerspice.waveforms.ramps import PWL
from fingerspice.waveforms.samples import as_samples
from fingerspice.waveforms.waveform import Waveform

# Largest relative difference of frequencies that are the same; and the words by which a warning about a SKIN begins.
_SAME, _TAKES = 1e-9, "takes its data at f ="
# Text about the mean force if its error cannot be computed, and the smallest relative error that is given as a number.
_UNKNOWN, _LITTLE = "may be 5 to 10 % off", 0.005
# Directives that only ngspice needs, so that no warning is given about them.
_FOR_NGSPICE = (".nodeset", ".options")
# Smallest number of points that make a PWL a recording, which is meant to be run to its end and not to be a step in a
# longer run; and the smallest fraction of a run that a recording fills without a warning.
_RECORDED, _FILLED = 100, 0.01
# Times (s) from `_CLOCK` on are those of a clock (this is a day in 1973, counted from 1970); times beyond the end of a
# run by a factor of `_OTHER_UNIT` or more are probably in another unit.
_CLOCK, _OTHER_UNIT = 1e8, 20.0


def circuit_warnings(circuit: Circuit, t_stop: float | None) -> tuple[str, ...]:
    """Warnings about directives without effect, and about a SKIN whose single frequency does not suit its source.

    The run is taken to end at `t_stop` (s), or at the deck's own end where that is None.
    """
    stop = _end(circuit, t_stop)
    return circuit.remember(("notices", stop), lambda: (*directive_warnings(circuit), *_skin_warnings(circuit, stop)))


def _end(circuit: Circuit, t_stop: float | None) -> float:
    return t_stop or (circuit.tran.stop if circuit.tran is not None else math.nan)


def directive_warnings(circuit: Circuit) -> tuple[str, ...]:
    """Warnings about directives without effect."""
    return tuple(f"{name} has no effect here" for name in circuit.unused if not name.startswith(_FOR_NGSPICE))


def course_warnings(circuit: Circuit, start: float, stop: float, by_deck: bool) -> Iterator[str]:
    """Warnings about sources that miss the run from `start` to `stop` (s), fill little of it, or are cut off by it.

    A recording is cut off without a warning unless the deck's own TSTOP does it, as `by_deck` says.
    """
    for name, wave in ((e.name, e.waveform) for e in driving(circuit) if e.waveform is not None):
        (first, last), count = wave.course, _points(wave)
        if (count > 1 and last < start == 0.0) or stop <= first < math.inf:
            until = f" to {last:g} s" if last < math.inf else " on"
            yield (
                f"{name} changes from {first:g} s{until} only, and covers nothing of the run from {start:g} s to "
                f"{stop:g} s, in which it stays at {wave.value(stop, 'left'):.4g}{time_slip(first, last, stop)}"
            )
        elif count >= _RECORDED and last - first < _FILLED * (stop - start):
            yield (
                f"{name}: the recording, from {first:g} s to {last:g} s, is {100.0 * (last - first) / stop:.2g} % of "
                f"the run to {stop:g} s, and constant in the rest; its times, or its rate, are probably in another unit"
            )
        elif by_deck and count >= _RECORDED and last > stop + (last - first) / (count - 1):
            yield (
                f"{name}: the recording ends at {last:g} s, and the run at the deck's TSTOP = {stop:g} s; --stop "
                f"{last:.9g} takes all of it (in Python t_stop={last:.9g})"
            )


def _points(wave: Waveform) -> int:
    """Number of points of a recording or table; 0 of other waveforms."""
    found = as_samples(wave)
    if found is not None:
        return found.count
    return len(wave.times) if isinstance(wave, PWL) and wave.repeat is None else 0


def time_slip(first: float, last: float, stop: float) -> str:
    """End of a message about times from `first` to `last` (s) that are not in a run to `stop`: the likely slip."""
    if first >= _CLOCK:
        return "; its times are probably a clock's: subtract the first of them"
    beyond = (first if first > stop else last) / stop
    if _OTHER_UNIT <= beyond < math.inf:
        unit = "ms" if beyond <= 1e3 * (1.0 + 1e-9) else "ms or us"
        return f"; its times are probably in {unit}, and count as s here"
    return f"; a run to {last:g} s contains it" if stop < last < math.inf else ""


def scenes_warnings(
    circuit: Circuit, t_stop: float | None, scenes: Mapping[str, FloatArray], skin: str = "own"
) -> Iterator[str]:
    """Warnings about several scenes: unusual values, sources that miss the run, a SKIN whose single frequency is wrong.

    `t_stop` is as in `circuit_warnings`, `skin` as in `batch`, and `scenes` has the values (n,) of each parameter.
    """
    for path, values in scenes.items():
        for end in sorted({values.min(), values.max()}):
            # A scene that cannot be run says so itself.
            with suppress(InputError):
                yield from unusual_of_changed(circuit, circuit.varied({path: float(end)}))[1]
    stop = _end(circuit, t_stop)
    if not any(path.startswith(f"{e.name}.") for e in driving(circuit) for path in scenes):
        yield from course_warnings(circuit, 0.0, stop, t_stop is None)
    if skin != "own":
        return
    own = [f"{e.name}.f" for e in circuit.by_device("SKIN")]
    on = driving_sources(circuit) if own else []
    clocks = [f"{e.name}.{name}" for e in on for name in ("frequency", "carrier")]
    if not any(path in scenes for path in (*own, *clocks)):
        yield from (text for text in circuit_warnings(circuit, t_stop) if _TAKES in text)
    elif len(on) == 1 and on[0].waveform is not None and on[0].waveform.fundamental is not None:
        fixed = np.array(on[0].waveform.fundamental.frequency)
        at = next((scenes[path] for path in clocks if path in scenes), fixed)
        for path in own:
            f = scenes.get(path, np.array(circuit.parameters[path].value))
            if np.any(np.abs(f / at - 1.0) > _SAME):
                yield (
                    f"{path.removesuffix('.f')} {_TAKES} {_span(f)}, the source's fundamental is {_span(at)}; with "
                    "skin 'follow' they are taken at the fundamental"
                )


def _span(f: FloatArray) -> str:
    low, high = float(f.min()), float(f.max())
    return f"{low:g} Hz" if low == high else f"{low:g} to {high:g} Hz"


def _skin_warnings(circuit: Circuit, stop: float) -> Iterator[str]:
    skins = circuit.by_device("SKIN")
    waves = network_of(circuit).waveforms if skins else ()
    # With several sources only the user can know at which frequency the skin data should be taken.
    if len(waves) != 1:
        return
    (wave,), fundamental, known = waves, waves[0].fundamental, 0.0 < stop < math.inf
    for skin in skins:
        f = skin.values["f"]
        if fundamental is None:
            if not (known and circuit.remember(("near", f, stop), partial(is_near, wave, stop, f))):
                yield (
                    f"{skin.name} {_TAKES} {f:g} Hz, and the source has no fundamental: the mean force "
                    f"{_how_far(circuit, wave, stop) if known else _UNKNOWN}; SKIN_DISPERSIVE "
                    f"d={1e6 * skin.values['d']:g}u is right for any source"
                )
        elif abs(f / fundamental.frequency - 1.0) > _SAME:
            yield (
                f"{skin.name} {_TAKES} {f:g} Hz, the source's fundamental is "
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
