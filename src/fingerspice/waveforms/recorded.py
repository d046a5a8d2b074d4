"""Waveforms that are samples at a constant rate under another name, found so that they run like a recording."""

from __future__ import annotations

import numpy as np

from fingerspice.waveforms.combinations import Product, Sum
from fingerspice.waveforms.ramps import PWL
from fingerspice.waveforms.samples import Samples
from fingerspice.waveforms.waveform import DC, Waveform

# Largest distance of a time from the grid, relative to the spacing; rounding of the times themselves comes on top.
ON_GRID, ROUNDING = 1e-9, 1e-15
# Largest number of grid samples for each point of a PWL: beyond it, few long lines are faster taken one by one.
MOST_PER_POINT = 8


def as_samples(wave: Waveform) -> Samples | None:
    """The samples that a waveform consists of, or None.

    These are a recording; a PWL without jump and end whose intervals are multiples of its shortest one; sums of such
    waveforms and constants on one grid; and products of one of them with constants. The result is kept with `wave`.
    """
    if isinstance(wave, Samples):
        return wave
    if "samples" not in wave.kept:
        of_parts = _of_parts(wave) if isinstance(wave, Sum | Product) else None
        wave.kept["samples"] = _of_points(wave) if isinstance(wave, PWL) else of_parts
    found: Samples | None = wave.kept["samples"]
    return found


def _of_parts(wave: Sum | Product) -> Samples | None:
    constants = [part.level for part in wave.parts if isinstance(part, DC)]
    others = [as_samples(part) for part in wave.parts if not isinstance(part, DC)]
    known = [part for part in others if part is not None]
    if not known or len(known) < len(others):
        return None
    if isinstance(wave, Sum):
        return _added(known, float(sum(constants)))
    only = known[0]
    return Samples(float(np.prod(constants)) * only.values, only.rate, only.start) if len(known) == 1 else None


def _of_points(wave: PWL) -> Samples | None:
    """The samples of a PWL on the grid of its shortest interval."""
    t = np.asarray(wave.times)
    if wave.repeat is not None or t.size < 2:
        return None
    shortest, length = float(np.diff(t).min()), float(t[-1] - t[0])
    if shortest <= 0.0 or length > MOST_PER_POINT * t.size * shortest:
        return None
    count = round(length / shortest)
    rate = count / length
    place = np.rint((t - t[0]) * rate)
    if np.any(np.abs(t[0] + place / rate - t) > ON_GRID / rate + ROUNDING * np.abs(t)):
        return None
    return Samples(np.interp(np.arange(count + 1), place, wave.values), rate, float(t[0]))


def _added(parts: list[Samples], constant: float) -> Samples | None:
    """Sum of recordings on one grid, over the time from the first sample of any to the last one; None on several."""
    first = min(parts, key=lambda part: part.start)
    rate = first.rate
    begins = [(part.start - first.start) * rate for part in parts]
    if any(part.rate != rate for part in parts) or any(abs(x - round(x)) > ON_GRID for x in begins):
        return None
    ends = [round(x) + part.count for x, part in zip(begins, parts, strict=True)]
    # Recordings far apart would make a grid of mostly constant samples.
    if max(ends) > MOST_PER_POINT * sum(part.count for part in parts):
        return None
    total = np.full(max(ends), constant)
    for x, part in zip(begins, parts, strict=True):
        total += part.between(-round(x), max(ends) - round(x))
    return Samples(total, rate, first.start)
