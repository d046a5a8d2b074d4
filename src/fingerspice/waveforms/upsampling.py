"""Band-limited interpolation: samples at a whole multiple of their rate."""

from __future__ import annotations

import numpy as np

from fingerspice.base.arrays import FloatArray
from fingerspice.waveforms.files import check_count
from fingerspice.waveforms.waveform import require

# Samples to either side that the filter sees, and its Kaiser window's beta. Measured on tones: straight up to 0.46 of
# the rate within 0.02 %.
_WING, _BETA = 32, 8.0


def upsample(values: FloatArray, factor: int) -> FloatArray:
    """Samples (n,) at `factor` times their rate, ((n - 1) factor + 1,), held beyond their ends.

    Raises
    ------
    InputError
        For a factor that is no whole number from 2 to 64, or too many samples.
    """
    from scipy.signal import firwin, upfirdn

    require(factor == int(factor) and 2 <= factor <= 64, "factor of upsampling", factor, "a whole number from 2 to 64")
    factor = int(factor)
    check_count("the upsampled recording", factor * values.size)
    wing = _WING * factor
    taps = factor * firwin(2 * wing + 1, 1.0 / factor, window=("kaiser", _BETA))
    dense = upfirdn(taps, np.pad(values, _WING, mode="edge"), up=factor)
    dense = dense[2 * wing :][: (values.size - 1) * factor + 1]
    # At the given samples the filter is exact but for its window.
    dense[::factor] = values
    return np.asarray(dense)
